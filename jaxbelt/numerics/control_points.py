"""Whether a polynomial comes to zero between 0 and 1, by its control points.

In the basis of Bernstein a polynomial lies within its control points, and it has no more roots,
and no more extrema, than these have changes of sign, or of direction. So the polynomial is positive
if its control points are positive, if they only rise, or if they rise and then fall to a positive
value. It passes zero once if they end below zero and have fallen, or risen once before, or after.
In all other cases the caller has to ask again on a shorter interval.
"""

import functools
from collections.abc import Callable, Sequence
from itertools import pairwise
from math import comb
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .compiling import where_any
from .polynomials import Jet, jet

#: Largest error of a polynomial, over its range of values, with which its rises and falls are
#: trusted.
TRUSTED = 0.25
#: Newton steps to a root, or an extremum, from its estimate by the control points.
ROOT_STEPS = 3


class RootPassage(NamedTuple):
    """Whether a function that is positive at 0 comes to zero in (0, 1], arrays of the batch shape.

    once: it passes zero once, at `there`, and is negative at 1. cut: it may pass zero and come
    back, or may not: the caller has to ask again on the interval up to `there`.
    """

    once: Array
    cut: Array
    there: Array


class Polynomial(NamedTuple):
    """A polynomial on [0, 1].

    points: its control points. coefficients: c0, c1, ... of c0 + c1 theta + ..., where known: its
    values by them take a third of the operations.
    """

    points: list[Array]
    coefficients: list[Array] | None = None

    @classmethod
    def of(cls, coefficients: list[Array]) -> "Polynomial":
        """The polynomial c0 + c1 theta + c2 theta^2 ..."""
        n = len(coefficients) - 1
        points = [
            functools.reduce(
                jnp.add, [coefficients[k] * (comb(i, k) / comb(n, k)) for k in range(i + 1)]
            )
            for i in range(n + 1)
        ]
        return cls(points, coefficients)

    def at(self, theta: Array) -> Jet:
        """Its value at theta, and its first two derivatives."""
        if self.coefficients is not None:
            return jet(self.coefficients, theta)
        return self._by_de_casteljau(theta)

    def _by_de_casteljau(self, theta: Array) -> Jet:
        n, row = len(self.points) - 1, list(self.points)
        while len(row) > 3:
            row = [p + theta * (q - p) for p, q in pairwise(row)]
        first, second = row[1] - row[0], row[2] - row[1]
        slope = first + theta * (second - first)
        value = row[0] + theta * first + theta * slope
        return value, n * slope, n * (n - 1) * (second - first)


@functools.cache
def through(nodes: tuple[float, ...]) -> np.ndarray:
    """The matrix [n, n] that makes control points from values at n nodes in [0, 1]."""
    x, n = np.array(nodes)[:, None], len(nodes) - 1
    k = np.arange(n + 1)
    binomials = np.array([comb(n, i) for i in k], dtype=float)
    return np.linalg.inv(binomials * x**k * (1 - x) ** (n - k))


def highest_difference(points: Sequence[Array]) -> Array:
    """The coefficient of the highest power of theta."""
    n = len(points) - 1
    terms = [(-1) ** (n - i) * comb(n, i) * point for i, point in enumerate(points)]
    return functools.reduce(jnp.add, terms)


def passage(
    curve: Polynomial, doubt: Array, rounding: Array, trust: Array, keep: Callable[[Array], Array]
) -> RootPassage:
    """Whether a function comes to zero in [0, 1], by a polynomial `curve` that is close to it.

    doubt: error of the polynomial inside; its ends are exact up to `rounding`. trust: mask of where
    its shape is trusted whatever the doubt, because the interval is as short as can be. keep: has a
    value computed once for all of its uses, see `lanes.materialise`.
    """
    curve, doubt, rounding = lax.stop_gradient((curve, doubt, rounding))
    points = curve.points
    above = functools.reduce(jnp.minimum, points[1:]) > doubt + rounding
    clear = above & (points[0] > -rounding)
    no = clear & ~clear
    nothing = RootPassage(no, no, jnp.ones_like(points[0]))
    found = where_any(~clear, lambda: _passage(curve, doubt, rounding, trust, keep), nothing)
    return RootPassage(found.once & ~clear, found.cut & ~clear, found.there)


def _passage(curve: Polynomial, doubt, rounding, trust, keep) -> RootPassage:
    """`passage`, where the signs of the control points do not show that there is no root."""
    points = curve.points
    steps = [q - p for p, q in pairwise(points)]
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
    once = known & below & ~(peak & dip)
    stays = known & ~below & ~dip
    root = _first_passage(points, -rounding)
    dips = known & ~below & dip & ~peak
    guess = keep(jnp.where(dips, _first_passage([-d for d in steps], rounding), root))
    theta, lowest = map(keep, _root_step(curve, guess, dips))
    passes = dips & (lowest < -jnp.maximum(doubt, rounding))
    inside = jnp.minimum(theta, 1 - theta) > 1e-3
    splits = dips & ~passes & (lowest <= doubt + rounding) & inside & ~trust
    unclear = ~(once | stays | dips)
    # Newton's method may converge to the root at 0, where the interval begins.
    there = jnp.where(dips, theta, jnp.maximum(theta, 0.1 * root))
    there = jnp.where(passes, jnp.minimum(root, theta), there)
    # A function that is below zero by rounding at 0, and falls from there, passes zero at 0: cut to
    # where it is below by more than rounding, the interval would become shorter and shorter.
    there = jnp.where(once & (points[0] < 0) & ~seen_rise, 0.0, there)
    return RootPassage(once, passes | splits | unclear, jnp.where(unclear, 0.5, there))


def _first_passage(points: Sequence[Array], level: Array) -> Array:
    """Where the line through the control points first falls below `level`; 0 if it begins there."""
    n = len(points) - 1
    before, ahead, fall = jnp.zeros_like(points[0]) + n, jnp.zeros_like(points[0]), jnp.ones(())
    for i in reversed(range(n)):
        p, q = points[i], points[i + 1]
        goes_below = (p >= level) & (q < level)
        before = jnp.where(goes_below, i, before)
        ahead, fall = jnp.where(goes_below, p, ahead), jnp.where(goes_below, p - q, fall)
    found = (before + jnp.clip(ahead / fall, 0.0, 1.0)) / n
    return jnp.where(points[0] < level, 0.0, found)


def _root_step(curve: Polynomial, theta: Array, extreme: Array) -> tuple[Array, Array]:
    """The root near theta, in [0, 1], or the extremum where `extreme`, and the value there."""
    for _ in range(ROOT_STEPS):
        value, slope, bend = curve.at(theta)
        over, under = jnp.where(extreme, slope, value), jnp.where(extreme, bend, slope)
        moved = theta - over / jnp.where(under == 0, 1.0, under)
        theta = jnp.clip(jnp.where(jnp.isfinite(moved), moved, theta), 0.0, 1.0)
    return theta, curve.at(theta)[0]
