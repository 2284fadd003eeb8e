"""Orbits that come to rest: when it is known that they will, and how neighbours of one move."""

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .modes import Mode, boundary_guards, edge_guards, force_rounding, mode_acceleration
from .oscillator import Oscillator

#: Radius of the smallest disc that is checked: in smaller ones the rounding of x1 counts.
SMALLEST_DISC = 1e-6
#: Speeds, as fractions of the radius, at which an attracting disc is checked.
DISC = tuple(sign * j / 8 for j in range(1, 9) for sign in (1, -1))


def settling_margin(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> tuple[Array, Array]:
    """Positive where an orbit of a slip mode has entered a disc that its fixed point attracts, or
    is there up to rounding: a node on an edge, or on the boundary of a belt at rest, has no disc.

    And that fixed point's x1.
    """
    zero = jnp.zeros_like(x1)
    x1_rest = mode_acceleration(osc, mode, zero, zero)
    radius = jnp.maximum(jnp.hypot(x1 - x1_rest, x2), SMALLEST_DISC)
    at_rest = jnp.maximum(jnp.abs(x1 - x1_rest), jnp.abs(x2)) < force_rounding(x1)
    return jnp.where(at_rest, radius, disc_margin(osc, mode, x1_rest, radius)), x1_rest


def settles(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> Array:
    """Whether an orbit comes to rest at the fixed point of a slip mode, see `settling_margin`."""
    return ~mode.any_stuck & (settling_margin(osc, mode, x1, x2)[0] > 0)


def disc_margin(osc: Oscillator, mode: Mode, x1_rest: Array, radius: Array) -> Array:
    """Positive where all orbits in the disc around the fixed point (x1_rest, 0) come to rest there.

    In a slip mode x1'' = -(x1 - x1_rest) + f(x2) with f(0) = 0, so E = (x1 - x1_rest)^2 + x2^2
    obeys E' = 2 x2 f(x2). If v f(v) < 0 for all 0 < |v| <= radius, and the disc lies within the
    mode's boundaries and edges, E falls until the orbit is at rest. The sign is checked at 16
    speeds; a law that wiggles on a scale below radius/8 could deceive that.
    """
    margins = []
    for fraction in DISC:
        v = fraction * radius
        margins.append(-v * mode_acceleration(osc, mode, x1_rest, v))
    pulls = [belt.load != 0 for belt in osc.belts]  # no other belt is an obstacle
    for v in (radius, -radius):
        bounds = boundary_guards(osc, mode, v) + edge_guards(osc, mode, x1_rest + v)
        margins += [
            jnp.where(matters, bound, jnp.inf)
            for matters, bound in zip(pulls * 3, bounds, strict=True)
        ]
    return functools.reduce(jnp.minimum, margins)


@jax.custom_jvp
def kept_at_rest(
    osc: Oscillator, mode: Mode, rests: Array, x1: Array, x2: Array, time: Array
) -> tuple[Array, Array]:
    """The state (x1, x2) at which a mass rests in a slip mode, after a time: the same numbers.

    Where `rests` is set, their derivatives are those of the linearised motion over that time.
    """
    return x1, x2


@kept_at_rest.defjvp
def _(primals, tangents):
    osc, mode, rests, x1, x2, time = primals
    d_osc, _, _, d_x1, d_x2, _ = tangents

    def moved():
        _, rate = jax.jvp(
            lambda x2: mode_acceleration(osc, mode, x1, x2), (x2,), (jnp.ones_like(x2),)
        )
        # The equilibrium moves as x2' does at a fixed state, for d x2'/d x1 = -1.
        _, away = jax.jvp(lambda osc: mode_acceleration(osc, mode, x1, x2), (osc,), (d_osc,))
        cosine, sine = _linear_flow(0.5 * rate, jnp.where(rests, time, 0.0))
        y1, y2 = d_x1 - away, d_x2
        z1 = away + cosine * y1 + sine * (y2 - 0.5 * rate * y1)
        z2 = cosine * y2 + sine * (0.5 * rate * y2 - y1)
        return jnp.where(rests, z1, d_x1), jnp.where(rests, z2, d_x2)

    return (x1, x2), lax.cond(jnp.any(rests), moved, lambda: (d_x1, d_x2))


def _linear_flow(half: Array, time: Array) -> tuple[Array, Array]:
    """c and s with exp(A t) = c I + s (A - half I), of A = ((0, 1), (-1, 2 half))."""
    square = half * half - 1
    is_node, w = square > 0, jnp.sqrt(jnp.abs(square))
    # The eigenvalues of a node are half +- w, of which the smaller one would be lost in rounding.
    larger = jnp.where(is_node, half + jnp.copysign(w, half), 1.0)
    one, other = jnp.exp(larger * time), jnp.exp(time / larger)
    grown, angle = jnp.exp(half * time), w * time
    cosine = jnp.where(is_node, 0.5 * (one + other), grown * jnp.cos(angle))
    sine = jnp.where(is_node, 0.5 * jnp.abs(one - other), grown * jnp.sin(angle))
    # Where they are nearly one, by the series.
    close = angle < 1e-2
    series = grown * time * (1 + square * time * time / 6)
    return cosine, jnp.where(close, series, sine / jnp.where(close, 1.0, w))
