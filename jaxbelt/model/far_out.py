"""What loops far out do: whether they grow or shrink.

Of a loop of large amplitude A, nearly a circle, viscous damping takes the energy pi zeta A^2, and
dry friction, which opposes motion, some more, D(A) > 0. Far out loops shrink where

    zeta + lim D(A) / (pi A^2) > 0

and grow where that is negative.

The limit is 0 for friction that is bounded. Where mu(r) grows as p2 r^2 it is 2/pi u0 p2 omega^2
for each unit of length of the contact interval, if that is finite; if it is not, D(A) grows as A^3,
and no loop far out grows. Where mu(r) grows as c r it is u0 c omega for contact everywhere, half of
that for contact to one side.
"""

import jax.numpy as jnp
from jaxtyping import Array

from ..numerics.compiling import jit
from .friction import AbstractFriction
from .oscillator import Oscillator

#: Relative velocities at which laws are as they are far out; to both they are to have one growth.
FAST = (1e6, 1e8)
#: Coefficients of growth below these are those of bounded friction.
LEAST_LINEAR, LEAST_QUADRATIC = 1e-7, 1e-13


def contraction_far_out(osc: Oscillator) -> Array:
    """The rate at which loops far out shrink, as a damping: negative where they grow, inf where
    friction grows beyond all bounds there."""
    contraction = osc.damping
    for belt in osc.belts:
        linear, quadratic = _growth(belt.friction)
        length = belt.upper - belt.lower
        sides = sum(jnp.where(jnp.isinf(end), 0.5, 0.0) for end in (belt.lower, belt.upper))
        finite = jnp.where(jnp.isfinite(length), length, 0.0)
        taken = osc.omega * linear * sides + 2 / jnp.pi * osc.omega**2 * quadratic * finite
        unbounded = (sides > 0) & (belt.load * quadratic > 0)
        contraction = contraction + jnp.where(unbounded, jnp.inf, belt.load * taken)
    return contraction


def _growth(law: AbstractFriction, r: float = FAST[1]) -> tuple[Array, Array]:
    """Coefficients of r and r^2 in mu(r), by its values at r, 2r and 3r."""
    once, twice, thrice = (law.mu(jnp.asarray(k * r)) for k in (1.0, 2.0, 3.0))
    quadratic = 0.5 * (once - 2 * twice + thrice) / r**2
    linear = (-2.5 * once + 4 * twice - 1.5 * thrice) / r
    rounding = 1e-14 * jnp.abs(quadratic) * r
    none = jnp.zeros_like(once)
    linear = jnp.where(linear > LEAST_LINEAR + rounding, linear, none)
    return linear, jnp.where(quadratic > LEAST_QUADRATIC, quadratic, none)


def has_limit(law: AbstractFriction) -> Array:
    """Whether these numbers determine its growth: those of a square root do not."""
    pairs = zip(*(_growth(law, r) for r in FAST), strict=True)
    return jnp.all(jnp.stack([jnp.abs(a - b) <= 1e-4 * (a + b) for a, b in pairs]))


@jit
def is_bounded(osc: Oscillator) -> Array:
    """Whether loops far out shrink: where these rates are in balance, too, by what D(A) is more."""
    return contraction_far_out(osc) >= 0
