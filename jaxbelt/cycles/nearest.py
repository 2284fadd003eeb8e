"""The shortest way between two curves, in any direction or along x2: `shortest_between`.

x1 and x2 are monotone on every piece, as arcs end at extrema. So a part of a piece lies in the box
between its ends, and two boxes bound the distance between their contents from below and from above.
Newton's method solves for the shortest way (see `Meeting`) between those pairs of parts only
that these bounds leave.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..model.modes import select
from ..model.oscillator import Oscillator
from ..numerics.compiling import each, jit
from ..numerics.implicit import Equations, solution
from ..numerics.newton import solve
from ..numerics.padding import filled_up, in_batches, longer
from .outlines import Outline, Pieces, place_on

#: Parts of a piece; pairs of parts solved for in one batch; pieces sampled in one batch.
PARTS, PAIRS, PIECES = 16, 64, 32
#: Longest Newton step, as a fraction of a piece: two parts.
LONGEST_PART = 2 / PARTS
#: How far a solution may still move, as a fraction of a piece; also the largest difference in x1
#: between the ends of a way along x2.
FOUND = 1e-9
#: A solution outside its part by no more than this fraction of a piece is accepted, too.
BEYOND = 0.25 / PARTS


class Meeting(eqx.Module):
    """Where two curves are nearest to one another.

    Attributes:
        pieces: Number of the piece of each curve, [2].
        fractions: Place on each piece, [2].
        fixed: Whether the place is an end of the piece, where the curve may have a corner, [2].
    """

    pieces: Array
    fractions: Array
    fixed: Array


class Normal(Equations):
    """The two equations of a `Meeting` in its fractions.

    With P on the first curve, Q on the second and d = P - Q: in any direction d is normal to both
    curves; along x2 d1 = 0, and the curves are parallel. A fixed fraction replaces the equation of
    its own curve by z = known, along x2 the second equation; two fixed fractions replace both.

    given: oscillator; the two pieces, rows of `Pieces` stacked; the known fractions; fixed.
    """

    along_x2: bool = eqx.field(static=True)

    def residual(self, given: tuple, z: Array) -> Array:
        return self.linearized(given, z)[0]

    def linearized(self, given: tuple, z: Array) -> tuple[Array, Array]:
        osc, pieces, known, fixed = given
        (p, q), (dp, dq), (ddp, ddq) = places_on(osc, pieces, z)
        d, stay, unit = p - q, z - known, jnp.eye(2)
        if not self.along_x2:
            values, mixed = jnp.stack([d @ dp, -(d @ dq)]), -(dp @ dq)
            rows = jnp.array([[dp @ dp + d @ ddp, mixed], [mixed, dq @ dq - d @ ddq]])
            return jnp.where(fixed, stay, values), jnp.where(fixed[:, None], unit, rows)
        parallel, row = _cross(dp, dq), jnp.stack([_cross(ddp, dq), _cross(dp, ddq)])
        for k in (0, 1):
            parallel, row = select(fixed[k], (stay[k], unit[k]), (parallel, row))
        values = jnp.stack([d[0], parallel])
        rows = jnp.stack([jnp.stack([dp[0], -dq[0]]), row])
        return select(jnp.all(fixed), (stay, unit), (values, rows))


def _cross(one: Array, other: Array) -> Array:
    return one[0] * other[1] - one[1] * other[0]


def places_on(osc: Oscillator, pieces: Pieces, fractions: Array) -> tuple[Array, Array, Array]:
    """`place_on` for two pieces at a fraction each: three arrays [2, 2], a row for each piece."""
    return lax.map(lambda row: place_on(osc, *row), (pieces, fractions))


class Sampled(NamedTuple):
    """A curve of a concrete oscillator in parts; see `in_parts`.

    pieces: of the curve. Of each part, piece: number of its piece; begin: fraction of the piece at
    which the part begins; low, high: corners of the part's box, [parts, 2].
    """

    pieces: Pieces
    piece: np.ndarray
    begin: np.ndarray
    low: np.ndarray
    high: np.ndarray


def in_parts(osc: Oscillator, pieces: Pieces) -> Sampled:
    """A curve of a concrete oscillator, each of its pieces cut into PARTS parts."""
    has_extent = (np.asarray(pieces.durations) != 0) | (np.asarray(pieces.lengths) != 0)
    # A point is one piece, of one part.
    is_point = not np.any(has_extent)
    has_extent[0] |= is_point
    numbers = np.flatnonzero(has_extent)
    batches = in_batches(pieces, numbers, PIECES)
    found = [np.asarray(_states_of(osc, some))[: len(batch)] for batch, some in batches]
    states = np.concatenate(found)
    ends = np.stack([states[:, :-1], states[:, 1:]]).reshape(2, -1, 2)
    begin = np.tile(np.arange(PARTS) / PARTS, len(numbers))
    parts = numbers.repeat(PARTS), begin, ends.min(axis=0), ends.max(axis=0)
    return Sampled(pieces, *(column[: 1 if is_point else None] for column in parts))


@jit
def _states_of(osc: Oscillator, pieces: Pieces) -> Array:
    """States at the ends of the parts, [pieces, PARTS + 1, 2]."""

    def along(piece):
        fractions = jnp.linspace(0.0, 1.0, PARTS + 1)
        return lax.map(lambda fraction: place_on(osc, piece, fraction)[0], fractions)

    return lax.map(along, pieces)


def shortest_between(
    osc: Oscillator, first: Sampled, second: Sampled, *, along_x2: bool
) -> tuple[float, np.ndarray, Meeting | None]:
    """The shortest way from one curve to another.

    Args:
        osc: A concrete oscillator.
        first: Curve where the way begins.
        second: Curve where it ends.
        along_x2: Whether x1 has to stay constant along the way.

    Returns:
        Its length, its end, [2], and where it is. inf, NaN and None if there is none; NaN, NaN and
        None where Newton's method finds none as short as the upper bound from the boxes.
    """
    curves = first, second
    parts, fractions, fixed, least, limit = _tries_of(first, second, along_x2)
    best, end, where = np.inf, np.full(2, np.nan), None
    left = np.arange(len(least))
    while left.size:
        now, left = left[:PAIRS], left[PAIRS:]
        number = np.stack([curves[k].piece[parts[now, k]] for k in (0, 1)], axis=1)
        begin = np.stack([curves[k].begin[parts[now, k]] for k in (0, 1)], axis=1)
        pieces = [filled_up(curves[k].pieces, number[:, k], PAIRS) for k in (0, 1)]
        found = _solved_for(osc, *pieces, *filled_up((fractions, fixed), now, PAIRS), along_x2)
        z, to, d, moves = (np.asarray(one)[: now.size] for one in found)
        # Where a piece ends just above the other curve, as on an edge, rounding decides on which
        # side of that end the solution lies.
        inside = np.maximum(begin - BEYOND, -FOUND) <= z
        inside &= z <= np.minimum(begin + 1 / PARTS + BEYOND, 1 + FOUND)
        good = np.all(inside | fixed[now], axis=1) & (moves < FOUND)
        good &= (np.abs(d[:, 0]) < FOUND) | (not along_x2)
        lengths = np.where(good, np.abs(d[:, 1]) if along_x2 else np.hypot(*d.T), np.inf)
        row = int(np.argmin(lengths))
        if lengths[row] < best:
            best, end = float(lengths[row]), to[row]
            where = number[row], np.clip(z[row], 0.0, 1.0), fixed[now[row]]
        left = left[least[left] < best]
    if where is None or best > limit * (1 + 1e-9):
        return np.nan if np.isfinite(limit) else np.inf, np.full(2, np.nan), None
    return best, end, Meeting(*jax.device_put(where))


def _tries_of(one: Sampled, other: Sampled, along_x2: bool) -> tuple[Any, ...]:
    """Guesses for Newton's method, likely ones first.

    Returns the parts of both curves, fractions, and which are fixed, [n, 2] each; lower bounds of
    the lengths, [n]; and an upper bound of the shortest way, inf if there is none.
    """
    apart = one.low[:, None] - other.high, other.low - one.high[:, None]
    least = np.maximum(np.maximum(*apart), 0.0)
    most = -np.minimum(*apart)
    if along_x2:
        meets = least[..., 0] == 0
        least, most = (np.where(meets, size[..., 1], np.inf) for size in (least, most))
    else:
        least, most = (np.hypot(size[..., 0], size[..., 1]) for size in (least, most))
    limit = np.min(most, initial=np.inf)
    pairs = np.argwhere((least <= limit) & np.isfinite(least))
    pairs = pairs[np.argsort(most[pairs[:, 0], pairs[:, 1]], kind="stable")]
    # Each point is in the middle of its part at first, or fixed at an end of its piece.
    begins = [curve.begin[pairs[:, k]] for k, curve in enumerate((one, other))]
    guesses = [np.stack([b + 0.5 / PARTS, 0 * b, 0 * b + 1], axis=1) for b in begins]
    chosen = [np.stack([b == b, b == 0, b == 1 - 1 / PARTS], axis=1) for b in begins]
    row, i, j = np.nonzero(chosen[0][:, :, None] & chosen[1][:, None, :])
    fractions = np.stack([guesses[0][row, i], guesses[1][row, j]], axis=1)
    fixed = np.stack([i > 0, j > 0], axis=1)
    return pairs[row], fractions, fixed, least[pairs[row, 0], pairs[row, 1]], limit


@jit
def _solved_for(
    osc: Oscillator, first: Pieces, second: Pieces, start: Array, fixed: Array, along_x2
):
    """For each row the fractions, the end of the way, d = P - Q, and how far fractions still
    move."""

    def one(first, second, start, fixed):
        pieces = _both_pieces(first, second)
        found = solve(Normal(along_x2), (osc, pieces, start, fixed), start, longest=LONGEST_PART)
        p, q = places_on(osc, pieces, found.z)[0]
        return found.z, q, p - q, found.unsettled

    return each(one)(first, second, start, fixed)


def _both_pieces(*two: Pieces) -> Pieces:
    """Two rows of `Pieces`, stacked; the shorter mesh is padded by steps of length zero."""
    steps = max(one.mesh.shape[-1] for one in two)
    padded = [
        eqx.tree_at(lambda p: p.mesh, one, longer(one.mesh, steps, axis=-1, fill=0.0))
        for one in two
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *padded)


class ShortestWay(eqx.Module):
    """The shortest way between two outlines, located for one oscillator.

    Attributes:
        first: Outline on which it begins.
        second: Outline on which it ends.
        meeting: Where on these it begins and ends, for that oscillator.
        along_x2: Whether it is along x2.
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
    meeting = lax.stop_gradient(way.meeting)
    first, second = (
        jax.tree.map(lambda leaf, k=k: leaf[meeting.pieces[k]], outline.pieces(osc))
        for k, outline in enumerate((way.first, way.second))
    )
    given = osc, _both_pieces(first, second), meeting.fractions, meeting.fixed
    fractions = solution(Normal(way.along_x2), given, meeting.fractions)
    begin, end = places_on(osc, given[1], fractions)[0]
    return begin, end
