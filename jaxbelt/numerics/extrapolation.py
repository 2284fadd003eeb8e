"""Integration steps of high order that compile fast: the midpoint rule, extrapolated.

Gragg's method: the midpoint rule is made over one step with several numbers of substeps, and the
results, whose errors are even in the substep's length, are extrapolated to length zero. As a loop
over substeps it compiles to one small kernel. A Runge-Kutta scheme of that order does not: its
stages, written out, take minutes to compile, and as an array they make a step ten times as slow.

Source: E. Hairer, S. P. Nørsett, G. Wanner, Solving Ordinary Differential Equations I, sec. II.9.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

Components = Any
#: Columns of a table with a row for two substeps: the length of one, whether they are the first of
#: their rule, and, in the last row of a rule, the weights of its result in those of the scheme.
Scheme = tuple[np.ndarray, ...]


def scheme(*results: tuple[int, ...]) -> Scheme:
    """The scheme of some results; each is given by the even numbers of substeps of its rules.

    k numbers give order 2k. All have to be among those of the first result.
    """
    rows = []
    for n in results[0]:
        weights = [_weight(n, sizes) if n in sizes else 0.0 for sizes in results]
        pairs = n // 2
        rows += [
            (1 / n, float(k == 0), *(w * (k == pairs - 1) for w in weights)) for k in range(pairs)
        ]
    return tuple(np.array(rows).T)


def _weight(n: int, sizes: tuple[int, ...]) -> float:
    return float(np.prod([n**2 / (n**2 - m**2) for m in sizes if m != n]))


def increments(
    field: Callable[[Components], Components], start: Components, h: ArrayLike, scheme: Scheme
) -> tuple[Components, ...]:
    """What each result of the scheme adds to the state in one step of size h.

    Components of the state are kept apart, as scalars: so a batch is an array for each of them.
    """

    # `way` is the change from the start: it is smaller than the state, and so is its rounding.
    def slopes(way):
        return field(tuple(a + b for a, b in zip(start, way, strict=True)))

    def two_substeps(carry, row):
        before, now, totals = carry
        length, first, *weights = row
        goes_on = 1.0 - first
        now = tuple(goes_on * way for way in now)
        before = tuple(goes_on * way for way in before)
        stride = 2 * length * h
        # The first substep of a rule leaps from its own place, half as far.
        middle = _leapt(before, (1 - 0.5 * first) * stride, slopes(now))
        new = _leapt(now, stride, slopes(middle))
        totals = tuple(
            tuple(sum_ + weight * way for sum_, way in zip(total, new, strict=True))
            for weight, total in zip(weights, totals, strict=True)
        )
        return (middle, new, totals), None

    nothing = tuple(jnp.zeros_like(part) for part in start)
    rows = tuple(map(jnp.asarray, scheme))
    begun = nothing, nothing, (nothing,) * (len(rows) - 2)
    (_, _, totals), _ = lax.scan(two_substeps, begun, rows)
    return totals


def _leapt(y: Components, h: Array, slopes: Components) -> Components:
    return tuple(a + h * slope for a, slope in zip(y, slopes, strict=True))
