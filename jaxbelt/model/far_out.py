"""Loops far out, of large amplitude: whether they grow or shrink.

From a loop of large amplitude A, nearly a circle, viscous damping takes the energy pi zeta A^2, and
dry friction a further D(A); a law that falls below zero gives energy, D(A) < 0. Loops far out
shrink where

    zeta + lim D(A) / (pi A^2) > 0

and grow where this sum is negative.

The limit is 0 for friction that is bounded. Where mu(r) grows as p2 r^2 it is 2/pi u0 p2 omega^2
for each unit of length of the contact interval, if this is finite; otherwise D(A) grows as A^3,
and its sign decides. Where mu(r) grows as c r it is u0 c omega for contact everywhere, half of
that for contact to one side.
"""

import jax.numpy as jnp
from jaxtyping import Array

from ..numerics.compiling import jit
from .friction import AbstractFriction
from .oscillator import Oscillator

#: Relative velocities at which the growth of a law is measured; it has to be the same at both.
FAST = (1e6, 1e8)
#: Coefficients of growth below these count as zero: the friction is bounded.
LEAST_LINEAR, LEAST_QUADRATIC = 1e-7, 1e-13


def contraction_far_out(osc: Oscillator) -> Array:
    """The sum above, as a damping: positive where loops far out shrink, negative where they grow,
    inf or -inf where D(A) grows as A^3."""
    contraction = osc.damping
    for belt in osc.belts:
        linear, quadratic = _growth(belt.friction)
        length = belt.upper - belt.lower
        sides = sum(jnp.where(jnp.isinf(end), 0.5, 0.0) for end in (belt.lower, belt.upper))
        finite = jnp.where(jnp.isfinite(length), length, 0.0)
        taken = osc.omega * linear * sides + 2 / jnp.pi * osc.omega**2 * quadratic * finite
        unbounded = jnp.where(sides > 0, belt.load * quadratic, 0.0)
        limitless = jnp.sign(unbounded) * jnp.inf
        contraction = contraction + jnp.where(unbounded != 0, limitless, belt.load * taken)
    return contraction


def _growth(law: AbstractFriction, r: float = FAST[1]) -> tuple[Array, Array]:
    """Coefficients of r and r^2 in mu(r), by its values at r, 2r and 3r."""
    once, twice, thrice = (law.mu(jnp.asarray(k * r)) for k in (1.0, 2.0, 3.0))
    quadratic = 0.5 * (once - 2 * twice + thrice) / r**2
    linear = (-2.5 * once + 4 * twice - 1.5 * thrice) / r
    rounding = 1e-14 * jnp.abs(quadratic) * r
    none = jnp.zeros_like(once)
    linear = jnp.where(jnp.abs(linear) > LEAST_LINEAR + rounding, linear, none)
    return linear, jnp.where(jnp.abs(quadratic) > LEAST_QUADRATIC, quadratic, none)


def has_limit(law: AbstractFriction) -> Array:
    """Whether the growth of a law is the same at both speeds `FAST`; a square root's is not."""
    pairs = zip(*(_growth(law, r) for r in FAST), strict=True)
    close = [jnp.abs(a - b) <= 1e-4 * jnp.maximum(jnp.abs(a), jnp.abs(b)) for a, b in pairs]
    return jnp.all(jnp.stack(close))


@jit
def is_bounded(osc: Oscillator) -> Array:
    """Whether loops far out shrink; if the sum is 0 they do, by the lower-order terms of D(A)."""
    return contraction_far_out(osc) >= 0
