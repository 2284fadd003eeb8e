"""Polynomials given by their coefficients, the lowest order first."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array

#: A value, and its first two derivatives.
Jet = tuple[Array, Array, Array]


def polynomial(coefficients: Sequence[Array], x: Array) -> Array:
    """The value at x, by Horner's rule."""
    total = coefficients[-1]
    for one in reversed(coefficients[:-1]):
        total = total * x + one
    return total


def jet(coefficients: Sequence[Array], x: Array) -> Jet:
    """The value and the first two derivatives at x, by Horner's rule in one pass."""
    value, slope = coefficients[-1], jnp.zeros_like(x)
    half_bend = slope
    for one in reversed(coefficients[:-1]):
        half_bend = half_bend * x + slope
        slope = slope * x + value
        value = value * x + one
    return value, slope, 2 * half_bend


def derivative(coefficients: Sequence[Array]) -> list[Array]:
    """The coefficients of the derivative."""
    return [k * one for k, one in enumerate(coefficients)][1:]


def quintic(start: Jet, end: Jet) -> tuple[Array, ...]:
    """The coefficients of the quintic with the given values and derivatives at 0 and at 1."""
    (p0, v0, a0), (p1, v1, a1) = start, end
    d, e, f = p1 - p0 - v0 - 0.5 * a0, v1 - v0 - a0, a1 - a0
    last = 10 * d - 4 * e + 0.5 * f, -15 * d + 7 * e - f, 6 * d - 3 * e + 0.5 * f
    return p0, v0, 0.5 * a0, *last
