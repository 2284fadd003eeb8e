"""Orbits that come to rest: which states are at rest, or nearly, and which will be."""

import functools

import jax.numpy as jnp
from jaxtyping import Array

from .modes import Mode, boundary_guards, edge_guards, force_rounding, mode_acceleration
from .oscillator import Oscillator

#: Radius of the smallest disc that is checked: in smaller ones the rounding of x1 counts.
SMALLEST_DISC = 1e-6
#: Speeds, as fractions of the radius, at which an attracting disc is checked.
DISC = tuple(sign * j / 8 for j in range(1, 9) for sign in (1, -1))


#: Below this speed and force derivatives are taken at a fixed time: the time at which such a slow
#: state passes a place is good to some 1e-16 over its speed, here 1e-12.
SLOW_MOTION = 1e-4


def is_at_rest(x1: Array, x2: Array, a: Array) -> Array:
    """Whether x2 and x2' = a vanish, up to rounding."""
    return jnp.maximum(jnp.abs(x2), jnp.abs(a)) < force_rounding(x1)


def is_slow(x2: Array, a: Array) -> Array:
    """Whether a state moves so slowly that its derivatives are better taken at a fixed time.

    Where x2 and x2' = a vanish, the time at which it passes a place has derivatives without bounds.
    Faster states keep those of their events' times, by which all that no longer depends on the
    start has derivatives that are exactly 0.
    """
    return jnp.maximum(jnp.abs(x2), jnp.abs(a)) < SLOW_MOTION


def settling_margin(
    osc: Oscillator, mode: Mode, x1: Array, x2: Array
) -> tuple[Array, Array, Array]:
    """Positive where an orbit of a slip mode has entered a disc that its fixed point attracts, or
    is there up to rounding: a node on an edge, or on the boundary of a belt at rest, has no disc.

    And that fixed point's x1; and whether the orbit stands there up to rounding though everything
    near it is repelled, as where slip begins on a belt that creeps: where it goes is not known.

    In a slip mode x1'' = -(x1 - x1_rest) + f(x2) with f(0) = 0, so E = (x1 - x1_rest)^2 + x2^2
    obeys E' = 2 x2 f(x2). If v f(v) < 0 for all 0 < |v| <= radius, and the disc lies within the
    mode's boundaries and edges, E falls until the orbit is at rest. The sign is checked at 16
    speeds; a law that wiggles on a scale below radius/8 could deceive that.
    """
    zero = jnp.zeros_like(x1)
    x1_rest = mode_acceleration(osc, mode, zero, zero)
    radius = jnp.maximum(jnp.hypot(x1 - x1_rest, x2), SMALLEST_DISC)
    losses = _losses(osc, mode, x1_rest, radius)
    at_rest = jnp.maximum(jnp.abs(x1 - x1_rest), jnp.abs(x2)) < force_rounding(x1)
    repelled = functools.reduce(jnp.maximum, losses) < 0
    margin = functools.reduce(jnp.minimum, [*losses, *_clearances(osc, mode, x1_rest, radius)])
    margin = jnp.where(at_rest & ~repelled, radius, margin)
    return margin, x1_rest, at_rest & repelled


def settles(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> Array:
    """Whether an orbit comes to rest at the fixed point of a slip mode, see `settling_margin`."""
    return ~mode.any_stuck & (settling_margin(osc, mode, x1, x2)[0] > 0)


#: So much of the range of speeds, and of the time, may a loop touch or stick to a belt by the
#: error of an integrated orbit: that of the largest circle, which is tangent to the boundary.
TOUCH_SHARE, STICK_SHARE = 1e-6, 1e-3


def is_neutral(
    osc: Oscillator, x1: tuple[Array, Array], x2: tuple[Array, Array], stuck: Array
) -> Array:
    """Whether a closed orbit is one of a continuum of such.

    It is where no force depends on the speed, so that energy is kept: without damping, for
    constant friction of belts that no speed of the loop reaches. x1, x2: the smallest and the
    largest of the loop; stuck: how much of the time it sticks.
    """
    zero = jnp.zeros_like(x2[0])
    speeds = [x2[0] + j / 8 * (x2[1] - x2[0]) for j in range(9)]
    always = [-osc.damping * v for v in speeds]
    neutral = stuck < STICK_SHARE
    slack = TOUCH_SHARE * osc.omega * (x2[1] - x2[0])
    for belt in osc.belts:
        pulls = belt.load != 0
        touches = pulls & (belt.lower < x1[1]) & (belt.upper > x1[0])
        within = pulls & (belt.lower <= x1[0]) & (belt.upper >= x1[1])
        r = [belt.velocity - osc.omega * v for v in speeds]
        sign = jnp.sign(r[4])
        reached = jnp.minimum(sign * r[0], sign * r[8]) < -slack
        forces = [belt.load * sign * belt.friction.mu(jnp.abs(one)) for one in r]
        # Where a static limit beyond mu(0) holds the mass for a while it is a cycle of its own.
        holds = belt.load * (belt.friction.static - belt.friction.mu(zero)) > 0
        neutral = neutral & ~(touches & holds & (stuck > 0))
        kept = _range_of(forces) <= force_rounding(zero, belt.load)
        neutral = neutral & ~(touches & (reached | ~within & ~kept))
        always = [a + jnp.where(within, f, 0.0) for a, f in zip(always, forces, strict=True)]
    return neutral & (_range_of(always) <= force_rounding(zero))


def _range_of(values: list[Array]) -> Array:
    return functools.reduce(jnp.maximum, values) - functools.reduce(jnp.minimum, values)


def _losses(osc: Oscillator, mode: Mode, x1_rest: Array, radius: Array) -> list[Array]:
    """-v f(v) at the speeds of `DISC`."""
    speeds = [fraction * radius for fraction in DISC]
    return [-v * mode_acceleration(osc, mode, x1_rest, v) for v in speeds]


def _clearances(osc: Oscillator, mode: Mode, x1_rest: Array, radius: Array) -> list[Array]:
    """How far the disc stays away from the boundaries and edges of its mode."""
    margins = []
    pulls = [belt.load != 0 for belt in osc.belts]  # no other belt is an obstacle
    for v in (radius, -radius):
        bounds = boundary_guards(osc, mode, v) + edge_guards(osc, mode, x1_rest + v)
        margins += [
            jnp.where(matters, bound, jnp.inf)
            for matters, bound in zip(pulls * 3, bounds, strict=True)
        ]
    return margins
