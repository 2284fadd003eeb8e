"""The shortest way between two curves, in any direction or along x2: `shortest_between`.

x1 and x2 are monotone on every piece, as arcs end at extrema. So a part of a piece lies in the box
between its ends, and two boxes bound the distance between their contents from below and from above.
Only pairs of parts that may be nearest are examined: the shortest way between them is where two
equations hold (see `Meeting`), which Newton's method solves.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..model.modes import ABOVE
from ..model.oscillator import Oscillator
from ..numerics.compiling import each, jit
from .outlines import Outline, Pieces, place_on

#: Parts of a piece; pairs of parts that are solved for in one batch, and pieces that are sampled.
PARTS, PAIRS, PIECES = 16, 64, 32
#: Newton steps within a pair of parts, and the longest, in parts.
WITHIN, LONGEST_IN_PARTS = 16, 2.0
#: Largest last step, as a fraction of the piece; also the largest error in x1 along x2.
FOUND = 1e-9
#: A solution that is so far beyond its parts is accepted, too: in parts.
BEYOND = 0.25


class Meeting(eqx.Module):
    """Where two curves are nearest to one another.

    With P on the first curve, Q on the second and d = P - Q two equations hold. In any direction: d
    is normal to either curve, where that is not in a corner. Along x2: d1 = 0, and where neither is
    in a corner, the curves are parallel; or both are in corners, where one curve ends in the other.

    pieces: number of the piece of each, [2]; fractions: places on these, [2]; fixed: whether that
    is an end of the piece, where the curve may have a corner, [2].
    """

    pieces: Array
    fractions: Array
    fixed: Array


class _PieceParts(NamedTuple):
    """Parts of pieces.

    piece: the piece of each; begin, width: where on it they begin and their length, as fractions;
    low, high: corners of their boxes, [parts, 2].
    """

    piece: np.ndarray
    begin: np.ndarray
    width: np.ndarray
    low: np.ndarray
    high: np.ndarray


class _Tries(NamedTuple):
    """Guesses for Newton's method.

    parts: of both curves, [n, 2]; fractions; fixed: which of these are fixed; least: lower bound of
    the distance.
    """

    parts: np.ndarray
    fractions: np.ndarray
    fixed: np.ndarray
    least: np.ndarray


class Sampled(NamedTuple):
    """A curve at one oscillator, and the parts of its pieces; see `sampled_curve`."""

    pieces: Pieces
    parts: _PieceParts


def shortest_between(
    osc: Oscillator, first: Sampled, second: Sampled, *, along_x2: bool
) -> tuple[float, Meeting | None]:
    """The shortest way from one curve to another, and where it is; inf and None if there is none.

    along_x2: only ways between points with one x1. NaN and None where Newton's method finds none
    that is as short as the known bound.
    """
    parts = first.parts, second.parts
    tries, limit = _tries_of(*parts, along_x2)
    if not np.isfinite(limit):
        return np.inf, None
    best, where = np.inf, None
    while len(tries.least):
        now = _Tries(*(column[:PAIRS] for column in tries))
        numbers = np.stack([parts[k].piece[now.parts[:, k]] for k in (0, 1)], axis=1)
        fractions, lengths = _solved_for(osc, (first, second), now, numbers, along_x2)
        shortest = int(np.argmin(lengths))
        if lengths[shortest] < best:
            best = float(lengths[shortest])
            where = numbers[shortest], fractions[shortest], now.fixed[shortest]
        left = np.arange(len(tries.least)) >= PAIRS
        tries = _Tries(*(column[left & (tries.least < best)] for column in tries))
    if where is None or best > limit * (1 + 1e-9):
        return np.nan, None
    return best, Meeting(*jax.device_put(where))


# --- parts, and pairs of them that may be nearest -------------------------------------------------


def sampled_curve(osc: Oscillator, outline: Outline) -> Sampled:
    """The curve of an outline at a known oscillator."""
    pieces = outline.pieces(osc)
    return Sampled(pieces, _parts_of(osc, pieces))


def end_of_way(osc: Oscillator, second: Sampled, meeting: Meeting) -> np.ndarray:
    """End of a shortest way on its second curve, [2]."""
    piece = jax.tree.map(lambda leaf: leaf[meeting.pieces[1]], second.pieces)
    return np.asarray(_place_of_row(osc, piece, meeting.fractions[1]))


@jit
def _place_of_row(osc: Oscillator, piece: Pieces, fraction: Array) -> Array:
    return place_on(osc, piece, fraction)[0]


def sampled_point(osc: Oscillator, y: np.ndarray) -> Sampled:
    """A state (x1, x2) as a curve."""
    one, belts = jnp.ones(1), len(osc.belts)
    place = jnp.asarray(np.array(y))[None]
    pieces = Pieces(one, jnp.full((1, belts), float(ABOVE)), one[None], place, 0 * one, 0 * one)
    zero = np.zeros(1)
    return Sampled(pieces, _PieceParts(np.zeros(1, int), zero, zero, y[None], y[None]))


def _parts_of(osc: Oscillator, pieces: Pieces) -> _PieceParts:
    durations, lengths = np.asarray(pieces.durations), np.asarray(pieces.lengths)
    is_point = (durations == 0) & (lengths == 0)
    # Pieces without an extent are left out, unless the curve is a point.
    used = np.ones(1, bool) if len(is_point) == 1 else ~is_point
    states = []
    for begin in range(0, len(used), PIECES):
        rows = np.minimum(np.arange(begin, begin + PIECES), len(used) - 1)
        states.append(_states_of(osc, jax.tree.map(lambda leaf, rows=rows: leaf[rows], pieces)))
    states = np.concatenate(states)[: len(used)][used]
    number = np.flatnonzero(used)
    grid = np.linspace(0.0, 1.0, PARTS + 1)
    ends = np.stack([states[:, :-1], states[:, 1:]])
    low, high = ends.min(axis=0), ends.max(axis=0)
    if len(is_point) == 1 and is_point[0]:
        return _PieceParts(number, np.zeros(1), np.zeros(1), low[:, 0], high[:, 0])
    return _PieceParts(
        number.repeat(PARTS),
        np.tile(grid[:-1], len(number)),
        np.full(len(number) * PARTS, 1 / PARTS),
        low.reshape(-1, 2),
        high.reshape(-1, 2),
    )


@jit
def _states_of(osc: Oscillator, pieces: Pieces) -> Array:
    """States at the ends of the parts, [pieces, PARTS + 1, 2]."""

    def along(piece):
        fractions = jnp.linspace(0.0, 1.0, PARTS + 1)
        return lax.map(lambda fraction: place_on(osc, piece, fraction)[0], fractions)

    return lax.map(along, pieces)


def _tries_of(one: _PieceParts, other: _PieceParts, along_x2: bool) -> tuple[_Tries, float]:
    """Pairs of parts to solve for, likely ones first, and an upper bound of the distance.

    The bound is inf where there are none.
    """
    apart = one.low[:, None] - other.high, other.low - one.high[:, None]
    least = np.maximum(np.maximum(*apart), 0.0)
    most = np.maximum(other.high - one.low[:, None], one.high[:, None] - other.low)
    if along_x2:
        meets = least[..., 0] == 0
        least, most = (np.where(meets, size[..., 1], np.inf) for size in (least, most))
    else:
        least, most = (np.hypot(size[..., 0], size[..., 1]) for size in (least, most))
    limit = float(np.min(most, initial=np.inf))
    pairs = np.argwhere((least <= limit) & np.isfinite(least))
    pairs = pairs[np.argsort(most[pairs[:, 0], pairs[:, 1]], kind="stable")]
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    choices = [_choices(parts, pairs[:, k]) for k, parts in enumerate((one, other))]
    for s, s_fixed, s_there in choices[0]:
        for t, t_fixed, t_there in choices[1]:
            possible = s_there & t_there
            fractions = np.stack([s, t], axis=1)[possible]
            fixed = np.stack([s_fixed, t_fixed], axis=1)[possible]
            found.append((np.flatnonzero(possible), fractions, fixed))
    rows, fractions, fixed = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.argsort(rows, kind="stable")
    rows = rows[order]
    bound = least[pairs[rows, 0], pairs[rows, 1]]
    return _Tries(pairs[rows], fractions[order], fixed[order], bound), limit


def _choices(parts: _PieceParts, rows: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """Possible places of the nearest point: somewhere in the part, or at an end of the piece.

    Returns a fraction, whether it is fixed, and whether it is a choice.
    """
    begin, width = parts.begin[rows], parts.width[rows]
    none, whole = np.zeros(len(rows), bool), np.ones(len(rows), bool)
    return [
        (begin + 0.5 * width, none, width > 0),
        (np.zeros(len(rows)), whole, begin == 0),
        (np.ones(len(rows)), whole, begin + width == 1),
    ]


# --- the equations --------------------------------------------------------------------------------


def places_on(osc: Oscillator, first: Pieces, second: Pieces, fractions: Array):
    """`place_on` for a row of each curve, at two fractions, [2]: three arrays [2, 2].

    The first rows of these are of the first curve.
    """
    steps = max(piece.mesh.shape[-1] for piece in (first, second))
    # Steps that are added are of length zero. One program does both.
    first, second = (
        eqx.tree_at(lambda p: p.mesh, one, jnp.pad(one.mesh, (0, steps - one.mesh.shape[-1])))
        for one in (first, second)
    )
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), first, second)
    return lax.map(lambda row: place_on(osc, *row), (both, fractions))


def equations_of(places: tuple[Array, Array, Array], stay: Array, fixed: Array, along_x2: bool):
    """The two equations of a `Meeting`, [2], and their derivatives by the fractions, [2, 2].

    places: result of `places_on`. A fixed fraction is an equation alone: along x2 it replaces the
    second one, in any direction its own; fixed: which fractions are, [2]; stay: their distances
    from their values, [2].
    """
    (p, q), (dp, dq), (ddp, ddq) = places
    d, unit = p - q, jnp.eye(2)
    if along_x2:
        second = dp[0] * dq[1] - dp[1] * dq[0]
        row = jnp.stack([ddp[0] * dq[1] - ddp[1] * dq[0], dp[0] * ddq[1] - dp[1] * ddq[0]])
        for k in (0, 1):
            second = jnp.where(fixed[k], stay[k], second)
            row = jnp.where(fixed[k], unit[k], row)
        rows = jnp.stack([jnp.stack([dp[0], -dq[0]]), row])
        both = jnp.all(fixed)
        return jnp.where(both, stay, jnp.stack([d[0], second])), jnp.where(both, unit, rows)
    values, mixed = jnp.stack([d @ dp, -(d @ dq)]), -(dp @ dq)
    diagonal = dp @ dp + d @ ddp, dq @ dq - d @ ddq
    rows = jnp.stack([jnp.stack([diagonal[0], mixed]), jnp.stack([mixed, diagonal[1]])])
    return jnp.where(fixed, stay, values), jnp.where(fixed[:, None], unit, rows)


def solved_step(values: Array, rows: Array) -> Array:
    """The step of Newton's method for two equations."""
    (a, b), (c, d) = rows
    determinant = a * d - b * c
    inverse = jnp.stack([jnp.stack([d, -b]), jnp.stack([-c, a])])
    return -(inverse @ values) / jnp.where(determinant == 0, jnp.nan, determinant)


def _solved_for(
    osc: Oscillator,
    curves: tuple[Sampled, Sampled],
    tries: _Tries,
    numbers: np.ndarray,
    along_x2: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Fractions where the equations hold, [n, 2], and the lengths of the ways, inf where there is
    none.

    numbers: of the pieces, [n, 2].
    """
    n = len(numbers)
    rows = np.minimum(np.arange(PAIRS), n - 1)
    columns = [(curve.parts.begin, curve.parts.width) for curve in curves]
    begin, width = (
        np.stack([columns[k][c][tries.parts[:, k]] for k in (0, 1)], axis=1)[rows] for c in (0, 1)
    )
    both = [
        jax.tree.map(lambda leaf, k=k: leaf[numbers[rows, k]], curve.pieces)
        for k, curve in enumerate(curves)
    ]
    start, fixed = tries.fractions[rows], tries.fixed[rows]
    found = _newton_in_parts(osc, *both, *jax.device_put((start, fixed, width)), along_x2)
    fractions, d, last = (np.asarray(one) for one in found)
    low, high = begin - BEYOND * width, begin + (1 + BEYOND) * width
    # Where a piece ends above the other curve, as on an edge, rounding decides on which side of it.
    inside = np.maximum(low, -FOUND) <= fractions
    inside &= fractions <= np.minimum(high, 1.0 + FOUND)
    good = np.all(inside | fixed, axis=1) & (last < FOUND)
    if along_x2:
        good &= np.abs(d[:, 0]) < FOUND
    lengths = np.abs(d[:, 1]) if along_x2 else np.hypot(d[:, 0], d[:, 1])
    return np.clip(fractions[:n], 0.0, 1.0), np.where(good, lengths, np.inf)[:n]


@jit
def _newton_in_parts(
    osc: Oscillator,
    first: Pieces,
    second: Pieces,
    start: Array,
    fixed: Array,
    width: Array,
    along_x2: bool,
):
    """Newton's method for each row: fractions, d there, and the length of the last step."""

    def one(first, second, start, fixed, width):
        def improve(_, state):
            fractions, _ = state
            places = places_on(osc, first, second, fractions)
            values, rows = equations_of(places, fractions - start, fixed, along_x2)
            step = solved_step(values, rows)
            longest = jnp.max(jnp.abs(step) / jnp.where(width > 0, width, 1.0))
            step = step * jnp.minimum(1.0, LONGEST_IN_PARTS / jnp.where(longest > 0, longest, 1.0))
            # Arcs do not continue far beyond their ends.
            new = jnp.clip(fractions + step, -0.1, 1.1)
            return jnp.where(fixed, start, new), jnp.max(jnp.abs(step))

        fractions, last = lax.fori_loop(0, WITHIN, improve, (start, jnp.inf))
        p, q = places_on(osc, first, second, fractions)[0]
        return fractions, p - q, last

    return each(one)(first, second, start, fixed, width)


# --- where the way is shortest, as a function of the oscillator -----------------------------------


class ShortestWay(eqx.Module):
    """The shortest way between two outlines, known where it is at one oscillator.

    first, second: the outlines; meeting: see `Meeting`; along_x2: whether it is along x2.
    """

    first: Outline
    second: Outline
    meeting: Meeting
    along_x2: bool = eqx.field(static=True)

    def ends(self, osc: Oscillator) -> tuple[Array, Array]:
        """Beginning and end of the way, [2] each, with first derivatives by every parameter."""
        return _ends_of(osc, self)


@jit
def _ends_of(osc: Oscillator, way: ShortestWay) -> tuple[Array, Array]:
    first, second = (
        jax.tree.map(lambda leaf, k=k: leaf[way.meeting.pieces[k]], outline.pieces(osc))
        for k, outline in enumerate((way.first, way.second))
    )
    known, fixed = lax.stop_gradient((way.meeting.fractions, way.meeting.fixed))
    places = places_on(osc, first, second, known)
    values, rows = equations_of(places, jnp.zeros(2), fixed, way.along_x2)
    # The derivative of the implicit function: one step with a matrix that is kept.
    late = solved_step(values, lax.stop_gradient(rows))
    begin, end = places[0] + late[:, None] * lax.stop_gradient(places[1])
    return begin, end
