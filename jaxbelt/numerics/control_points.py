"""Whether a polynomial comes to zero between 0 and 1, by its control points.

In the basis of Bernstein a polynomial lies within its control points, and it has no more roots,
and no more extrema, than these have changes of sign, or of direction. So control points that are
positive show that the polynomial is; those that only rise, or rise and then fall to a positive
value, likewise; and those that are negative at the end and have fallen, or risen once before, or
after, that it has passed zero once. What else there may be the caller asks of a shorter way.
"""

import functools
from collections.abc import Sequence
from math import comb
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

#: Part of its range that a polynomial may be wrong by, and still be trusted to rise and fall as it
#: does.
TRUSTED = 0.25
#: Newton steps to a root, or an extremum, from that of the control points.
NEWTON_STEPS = 3


class Passage(NamedTuple):
    """Whether a function that is positive at 0 comes to zero up to 1, arrays of the batch shape.

    once: it passes zero once, and is negative at 1; there: where. cut: it may pass zero and come
    back, or may not, and is to be asked again up to `there`.
    """

    once: Array
    cut: Array
    there: Array


def from_monomials(coefficients: Sequence[Array]) -> list[Array]:
    """The control points of c0 + c1 theta + c2 theta^2 ..."""
    n = len(coefficients) - 1
    return [
        functools.reduce(
            jnp.add, [coefficients[k] * (comb(i, k) / comb(n, k)) for k in range(i + 1)]
        )
        for i in range(n + 1)
    ]


@functools.cache
def through(nodes: tuple[float, ...]) -> np.ndarray:
    """The matrix that makes control points of values at as many nodes in [0, 1]."""
    x, n = np.array(nodes)[:, None], len(nodes) - 1
    k = np.arange(n + 1)
    binomials = np.array([comb(n, i) for i in k], dtype=float)
    return np.linalg.inv(binomials * x**k * (1 - x) ** (n - k))


def highest_difference(points: Sequence[Array]) -> Array:
    """The coefficient of the highest power of theta."""
    n = len(points) - 1
    terms = [(-1) ** (n - i) * comb(n, i) * point for i, point in enumerate(points)]
    return functools.reduce(jnp.add, terms)


def value_at(points: Sequence[Array], theta: Array) -> tuple[Array, Array]:
    """The polynomial and its derivative at theta."""
    *_, (p, q) = _levels(points, theta)
    return p + theta * (q - p), (len(points) - 1) * (q - p)


def _levels(points: Sequence[Array], theta: Array):
    """What de Casteljau's algorithm has, until two points are left."""
    row = list(points)
    while len(row) > 2:
        yield row
        row = [p + theta * (q - p) for p, q in zip(row, row[1:])]
    yield row


def passage(points: Sequence[Array], doubt: Array, rounding: Array, trust: Array) -> Passage:
    """Whether a function comes to zero, of which a polynomial with these control points is known.

    doubt: how far the polynomial may be off inside; its ends are exact up to `rounding`. trust:
    where its shape is trusted whatever the doubt, because the way is as short as can be.
    """
    points, doubt, rounding = lax.stop_gradient((list(points), doubt, rounding))
    steps = [q - p for p, q in zip(points, points[1:])]
    rises, falls = ([way * d > rounding for d in steps] for way in (1.0, -1.0))
    seen_rise, seen_fall, peak, dip = rises[0], falls[0], None, None
    for up, down in zip(rises[1:], falls[1:]):
        peak = seen_rise & down if peak is None else peak | seen_rise & down
        dip = seen_fall & up if dip is None else dip | seen_fall & up
        seen_rise, seen_fall = seen_rise | up, seen_fall | down
    assert peak is not None and dip is not None
    least = functools.reduce(jnp.minimum, points)
    spread = functools.reduce(jnp.maximum, points) - least
    known = trust | (doubt <= TRUSTED * spread + rounding)
    below = points[-1] < -rounding
    above = functools.reduce(jnp.minimum, points[1:]) > doubt + rounding
    once = known & below & ~(peak & dip)
    stays = above & (points[0] > -rounding) | known & ~below & ~dip
    root = _first_passage(points, -rounding)
    dips = known & ~below & dip & ~peak & ~stays
    bottom = _newton(_derivative(steps), _first_passage([-d for d in steps], rounding))
    lowest = value_at(points, bottom)[0]
    passes = dips & (lowest < -jnp.maximum(doubt, rounding))
    inside = jnp.minimum(bottom, 1 - bottom) > 1e-3
    splits = dips & ~passes & (lowest <= doubt + rounding) & inside & ~trust
    unclear = ~(once | stays | dips)
    root = jnp.where(passes, jnp.minimum(root, bottom), root)
    # Newton's method may come to the root at 0 that began the way.
    root = jnp.maximum(_newton(points, root), 0.1 * root)
    there = jnp.where(splits, bottom, jnp.where(unclear, 0.5, root))
    return Passage(once, passes | splits | unclear, there)


def _derivative(steps: Sequence[Array]) -> list[Array]:
    n = len(steps)
    return [n * d for d in steps]


def _first_passage(points: Sequence[Array], level: Array) -> Array:
    """Where the line through the control points first goes below zero; 0 where it begins there."""
    n = len(points) - 1
    found = jnp.ones_like(points[0])
    for i in reversed(range(n)):
        p, q = points[i], points[i + 1]
        part = jnp.clip(p / jnp.where(p > q, p - q, 1.0), 0.0, 1.0)
        found = jnp.where((p >= level) & (q < level), (i + part) / n, found)
    return jnp.where(points[0] < level, 0.0, found)


def _newton(points: Sequence[Array], theta: Array) -> Array:
    """The root near theta, in [0, 1]."""
    for _ in range(NEWTON_STEPS):
        value, slope = value_at(points, theta)
        moved = theta - value / jnp.where(slope == 0, 1.0, slope)
        theta = jnp.clip(jnp.where(jnp.isfinite(moved), moved, theta), 0.0, 1.0)
    return theta
