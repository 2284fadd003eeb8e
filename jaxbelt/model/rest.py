"""Coming to rest: which states are at rest, or nearly, and which are sure to come to rest."""

import functools
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .modes import (
    Mode,
    boundary_guards,
    edge_guards,
    edges,
    force_rounding,
    foremost,
    has_edges,
    mode_acceleration,
)
from .oscillator import Belt, Oscillator
from .transitions import at_focus

#: Radius of the smallest disc that is checked: on smaller ones rounding of x1 would decide.
SMALLEST_DISC = 1e-6
#: Speeds, as fractions of the radius, at which an attracting disc is checked.
DISC = tuple(sign * j / 8 for j in range(1, 9) for sign in (1, -1))


#: Where speed and x2' are below this, derivatives are taken at a fixed time: the time at which such
#: a slow state passes a place is accurate to some 1e-16 over its speed only, here 1e-12.
SLOW_MOTION = 1e-4


def is_at_rest(x1: Array, x2: Array, a: Array) -> Array:
    """Whether x2 and x2' = a vanish, up to rounding."""
    return jnp.maximum(jnp.abs(x2), jnp.abs(a)) < force_rounding(x1)


def is_slow(x2: Array, a: Array) -> Array:
    """Whether a state moves so slowly that its derivatives are better taken at a fixed time.

    Where x2 and x2' = a vanish, the time at which it passes a place has derivatives without bounds.
    Faster states keep the derivatives of the times of their events, so that results that no longer
    depend on the start have derivatives that are exactly 0.
    """
    return jnp.maximum(jnp.abs(x2), jnp.abs(a)) < SLOW_MOTION


def start_at_focus(osc: Oscillator, x1: Array, x2: Array) -> tuple[Array, Array]:
    """The start (x1, x2); at a pseudo-focus its derivatives are those of the edge it lies on.

    Orbits that start beside a pseudo-focus are soon back there, or never.
    """
    if not has_edges(osc):
        return x1, x2
    edge = foremost(osc, [x1 == edge for edge in edges(osc)], edges(osc), x1)
    there = at_focus(osc, x1, x2)
    # Not a choice between edge and x1, which are equal there: XLA never ends simplifying it.
    fixed1, fixed2 = lax.stop_gradient((x1, x2))
    slope = edge - lax.stop_gradient(edge)
    return jnp.where(there, fixed1 + slope, x1), jnp.where(there, fixed2, x2)


def settling_margin(
    osc: Oscillator, mode: Mode, x1: Array, x2: Array
) -> tuple[Array, Array, Array]:
    """Margin and x1 of a slip mode's fixed point, and whether an orbit stands at a repelling one.

    The margin is positive where the orbit has entered a disc that the fixed point attracts, or is
    at the fixed point up to rounding: a node on an edge, or on the boundary of a belt at rest, has
    no disc. A fixed point repels where slip begins on a belt that creeps, say; an orbit that stands
    there up to rounding may go anywhere.

    In a slip mode x1'' = -(x1 - x1_rest) + f(x2) with f(0) = 0, so E = (x1 - x1_rest)^2 + x2^2
    obeys E' = 2 x2 f(x2). If v f(v) < 0 for all 0 < |v| <= radius, and the disc lies within the
    mode's boundaries and edges, E falls until the orbit is at rest. The sign is checked at 16
    speeds; a law that wiggles on a scale below radius/8 could deceive this check.
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


#: Shares of the range of speeds by which a loop may pass a belt's boundary, and of the time that it
#: may stick, by integration errors alone: the largest circle is tangent to the boundary.
TOUCH_SHARE, STICK_SHARE = 1e-6, 1e-3


def is_neutral(
    osc: Oscillator, x1: tuple[Array, Array], x2: tuple[Array, Array], stuck: Array
) -> Array:
    """Whether a closed orbit is one of a continuum of closed orbits.

    It is one if it passes no belt's boundary and these forces are even in x2, see `_is_balanced`:
    that of each belt that touches only a part of the loop, and the sum of damping and of the belts
    that always touch. Then time reversed maps (x1, x2) to (x1, -x2), and every such orbit closes.
    x1, x2: the smallest and the largest on the loop; stuck: the share of the time that it sticks.
    """
    zero = jnp.zeros_like(x2[0])
    neutral = stuck < STICK_SHARE
    slack = TOUCH_SHARE * osc.omega * (x2[1] - x2[0])
    fastest = jnp.maximum(-x2[0], x2[1])
    always = []
    for belt in osc.belts:
        pulls = belt.load != 0
        touches = within = pulls
        if has_edges(osc):
            touches = pulls & (belt.lower < x1[1]) & (belt.upper > x1[0])
            within = pulls & (belt.lower <= x1[0]) & (belt.upper >= x1[1])
        sign = jnp.sign(belt.velocity - 0.5 * osc.omega * (x2[0] + x2[1]))
        r = [sign * (belt.velocity - osc.omega * v) for v in x2]
        reached = jnp.minimum(*r) < -slack
        # A loop that a static limit beyond mu(0) holds for a while is an isolated cycle.
        holds = belt.load * (belt.friction.static - belt.friction.mu(zero)) > 0
        neutral = neutral & ~(touches & holds & (stuck > 0))
        undamped = eqx.tree_at(lambda o: o.damping, osc, zero)
        kept = _is_balanced(undamped, [(belt, sign)], fastest, force_rounding(zero, belt.load))
        neutral = neutral & ~(touches & (reached | ~within & ~kept))
        always.append((belt, jnp.where(within, sign, 0.0)))
    return neutral & _is_balanced(osc, always, fastest, force_rounding(zero))


def is_centre(osc: Oscillator, mode: Mode) -> Array:
    """Whether orbits around rest in a slip mode are closed: all its forces together are even in x2
    up to the speed of the slowest belt that touches, see `is_neutral`.

    Forces that are even in x2 up to their own rounding count as even.
    """
    slowest = jnp.inf
    signs = []
    for belt, code in zip(osc.belts, mode.codes, strict=True):
        pulls = (jnp.abs(code) <= 1) & (belt.load != 0)
        signs.append((belt, jnp.where(pulls, code, 0.0)))
        speed = jnp.abs(belt.velocity) / osc.omega
        slowest = jnp.minimum(slowest, jnp.where(pulls, speed, jnp.inf))
    # If a belt at rest touches, the range of speeds is empty: no centre.
    fastest = jnp.where(jnp.isinf(slowest), 1.0, slowest)
    return (fastest > 0) & _is_balanced(osc, signs, fastest, None)


def _is_balanced(
    osc: Oscillator, signs: Sequence[tuple[Belt, Array]], fastest: Array, error: Array | None
) -> Array:
    """Whether damping and belts, with their signs of r (0: none), pull alike at x2 and -x2.

    Checked up to the speed `fastest`. error: difference that counts as 0; None: the rounding of the
    forces that are not exactly even.
    """
    balanced = jnp.ones_like(fastest, dtype=bool)
    for j in range(1, 5):
        v = j / 4 * fastest
        uneven, rounding = -2 * osc.damping * v, jnp.zeros_like(fastest)
        for belt, sign in signs:
            r = [jnp.abs(belt.velocity - osc.omega * speed) for speed in (v, -v)]
            forces = [belt.load * sign * belt.friction.mu(one) for one in r]
            uneven += forces[0] - forces[1]
            larger = jnp.maximum(*map(jnp.abs, forces))
            rounding += jnp.where(forces[0] != forces[1], larger, 0.0)
        rounding = 16 * np.finfo(float).eps * rounding
        balanced = balanced & (jnp.abs(uneven) <= (rounding if error is None else error))
    return balanced


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
