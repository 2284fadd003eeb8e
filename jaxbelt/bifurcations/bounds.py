"""The curves that bound the regions of a plane of two parameters: `Bounds`.

Points are found by `scan` along a few lines across the plane, and their curves are followed. This
misses curves that no line meets. Therefore cells are compared: where two neighbours differ and no
curve passes between them, the points on the line between them are searched and their curves
followed, until no such pair is left, or only pairs between which nothing is found. At last every
end of a curve gets a name: where it has none, the end is named after the point of codimension two
in which the curve meets another one.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from ..activity import note_progress
from ..model.variations import Variation
from ..numerics.compiling import compiled_beside
from ..numerics.continuation import Stop
from ..numerics.widths import as_here
from ..results import Status
from .base import BifurcationPoint
from .changes import from_chords, is_on_rows
from .curves import BifurcationCurve, follow_point
from .faces import densely
from .path import ParameterPath
from .scan import calls_ahead, search
from .special import SpecialPoint, is_elsewhere

#: A curve bounds two neighbouring cells if it passes the line between them this near, in cells: the
#: chords of a bent curve miss the curve itself by less.
PASSES_BY = 0.1
#: If nothing is found between two cells, other pairs with the same two motions that are this near,
#: in cells, are not searched either.
ALIKE = 3.0
#: Number of points per cell at which distances are computed, on the line between two cells and on
#: curves.
PER_CELL = 8
#: Number of values at which the search between two cells begins.
BETWEEN = 6

#: Curves count as one where this many successive rows of one of them lie on the other.
DOUBLED = 4
#: Places of the same cycle, in rows of two curves that are a step apart, differ by less than this,
#: relative to its size.
SAME_PLACE = 0.05
#: A curve ends in a known point at most MEETS steps away if the parabola through its last END_ROWS
#: rows misses the point by no more than MISSES times the distance.
MEETS, MISSES, END_ROWS = 4.0, 0.2, 4

#: Two neighbouring cells: the parameters (p, q) of each.
Pair = tuple[tuple[float, float], tuple[float, float]]


class Bounds:
    """The curves in a plane, found so far.

    variation: of both parameters; values: the values of each along its axis, increasing; step:
    between the points of curves, in units in which both sides of the plane have the length 1.4.
    """

    def __init__(self, variation: Variation, values: Sequence[np.ndarray], step: float):
        self.variation, self.values = variation, values
        self.limits = np.array([(float(along[0]), float(along[-1])) for along in values])
        self.step = step
        #: Unit of each parameter for distances.
        self.unit = np.ptp(self.limits, axis=1) / 1.4
        #: The mean size of a cell.
        self.cell = np.ptp(self.limits, axis=1) / [len(along) - 1 for along in values]
        self.curves: list[BifurcationCurve] = []

    def search_lines(self, lines: int) -> None:
        """Follows the curves of all points on `lines` lines parallel to each axis."""
        across = [
            (along, float(fixed))
            for along in (0, 1)
            for a, b in [self.limits[1 - along]]
            for fixed in a + (b - a) * (np.arange(lines) + 0.37) / lines
        ]
        # The next lines are searched while curves are followed from the lines before.
        with ThreadPoolExecutor(1) as ahead:
            searches = [
                (line, ahead.submit(as_here(self._points), *line, self.limits[line[0]]))
                for line in across
            ]
            for count, ((along, fixed), found) in enumerate(searches, 1):
                source = f"{count} of {len(across)} lines"
                self._follow(found.result(), along, fixed, source)

    def search_between(self, motions: np.ndarray, left_out: np.ndarray) -> tuple[Pair, ...]:
        """Follows curves between neighbouring cells that differ; returns pairs without any curve.

        motions: a number for the motions in each cell, [n, m], negative where they are not known;
        left_out: mask of cells that are not compared, [n, m].
        """
        rows = neighbours_that_differ(motions, left_out)
        rows = rows[self.away(rows) > PASSES_BY]
        untried = np.ones(len(rows), bool)
        while np.any(untried):
            away = np.where(untried, self.away(rows), -1.0)
            # Next: the pair farthest from known curves, and so from points of codimension two.
            at = int(np.argmax(away))
            row, column, along = rows[at].tolist()
            note_progress(
                f"{len(self.curves)} curves, {int(untried.sum())} pairs of cells without one"
            )
            fixed = float(self.values[1 - along][(row, column)[1 - along]])
            first = (row, column)[along]
            ends = self.values[along][first : first + 2]
            known = len(self.curves)
            self._follow(self._points(along, fixed, ends, BETWEEN), along, fixed, "pairs of cells")
            untried[at] = False
            if len(self.curves) > known:
                left = self.away(rows) > PASSES_BY
                rows, untried = rows[left], untried[left]
            else:
                untried &= ~_alike(rows, at, motions)
        return tuple(self.pair(row) for row in rows.tolist())

    def name_ends(self) -> None:
        """Names each end without a name after the point in which it meets another curve."""
        for number, curve in enumerate(self.curves):
            others = [other for other in self.curves if other is not curve]
            known = [point for other in others for point in other.special]
            for end in (0, -1):
                if (point := _meeting_at_end(curve, end, known, self.step, self.unit)) is not None:
                    where = (point, *curve.special) if end == 0 else (*curve.special, point)
                    curve = replace(curve, special=where)
            self.curves[number] = curve

    def _points(self, along: int, fixed: float, ends, resolution: int = 0):
        """Points on a line along the axis `along`, the other parameter being fixed."""
        span = float(ends[0]), float(ends[1])
        path = ParameterPath(self.variation.held(1 - along, fixed), None, span, basins=False)
        if resolution:  # a short line: Newton's method starts from intervals of any width
            return search(path, resolution, near=1.0)
        with compiled_beside("scan", path.at(path.first), calls_ahead(path)):
            return search(path)

    def _follow(
        self, points: Sequence[BifurcationPoint], along: int, fixed: float, source: str
    ) -> None:
        """Follows the curves of points on no known curve; source: their origin, in words."""
        for point in points:
            note_progress(f"{len(self.curves)} curves from {source}")
            pair = np.empty(2)
            pair[along], pair[1 - along] = float(point.value), fixed
            if point.status == Status.OK and not any(
                _lies_on(point, pair, curve, self.step, self.unit) for curve in self.curves
            ):
                # `self.step` in the units in which curves are followed.
                step = self.step * np.max(self.unit / self.variation.family(pair).units)
                curve = follow_point(self.variation, point, pair, self.limits, step=float(step))
                self.curves.append(_without_known(curve, pair, self.curves, self.step, self.unit))

    def away(self, rows: np.ndarray) -> np.ndarray:
        """Distance of the nearest curve from the line between two cells, in cells, [pairs]."""
        from scipy.spatial import KDTree  # late, as only maps need it

        if not self.curves or not len(rows):
            return np.full(len(rows), np.inf)
        paths = [densely(curve.path / self.cell, 1 / PER_CELL) for curve in self.curves]
        ends = np.array([self.pair(row) for row in rows.tolist()]) / self.cell
        parts = np.linspace(0, 1, PER_CELL + 1)[:, None, None]
        ways = (1 - parts) * ends[None, :, 0] + parts * ends[None, :, 1]
        away, _ = KDTree(np.concatenate(paths)).query(ways)
        return np.min(away, axis=0)

    def pair(self, row: Sequence[int]) -> Pair:
        """The two cells of a row of `neighbours_that_differ`."""
        i, j, along = row
        p, q = self.values
        other = (i + 1, j) if along == 0 else (i, j + 1)
        return (float(p[i]), float(q[j])), (float(p[other[0]]), float(q[other[1]]))


def neighbours_that_differ(motions: np.ndarray, left_out: np.ndarray) -> np.ndarray:
    """Neighbouring cells that differ: row and column of the first one, and the axis, [pairs, 3]."""
    known = (motions >= 0) & ~left_out
    found = []
    for along in (0, 1):
        a, b = (np.moveaxis(array, along, 0) for array in (motions, known))
        differ = (a[1:] != a[:-1]) & b[1:] & b[:-1]
        first, other = np.nonzero(differ)
        places = (first, other) if along == 0 else (other, first)
        found.append(np.column_stack([*places, np.full(len(first), along)]))
    return np.concatenate(found)


def _alike(rows: np.ndarray, at: int, motions: np.ndarray) -> np.ndarray:
    """Mask of the pairs that are near to the pair `at` and have the same two motions, [pairs]."""
    first = motions[rows[:, 0], rows[:, 1]]
    second = motions[rows[:, 0] + (rows[:, 2] == 0), rows[:, 1] + (rows[:, 2] == 1)]
    low, high = np.minimum(first, second), np.maximum(first, second)
    near = np.max(np.abs(rows[:, :2] - rows[at, :2]), axis=1) <= ALIKE
    return near & (low == low[at]) & (high == high[at])


def _without_known(
    curve: BifurcationCurve,
    start: np.ndarray,
    known: Sequence[BifurcationCurve],
    step: float,
    unit: np.ndarray,
) -> BifurcationCurve:
    """The part of a curve, around its start, that lies on no known curve.

    Curves of one kind may coincide beyond a point of codimension two in which they meet.
    """
    doubled = np.zeros(len(curve), bool)
    for other in known:
        if other.condition.lineage == curve.condition.lineage and len(other) > 1:
            doubled |= _rows_on(curve, other, 0.02 * step, unit)
    begun = int(np.argmin(np.hypot(*((curve.values - start) / unit).T)))
    first, last = 0, len(curve) - 1
    # Where two curves cross, a few rows of one may lie near the other.
    for row in range(begun, -1, -1):
        if row >= DOUBLED and np.all(doubled[row - DOUBLED + 1 : row + 1]):
            first = min(row + 1, begun)
            break
    for row in range(begun, len(curve)):
        if row + DOUBLED <= len(curve) and np.all(doubled[row : row + DOUBLED]):
            last = max(row - 1, begun)
            break
    return _shortened(curve, first, last)


def _rows_on(
    curve: BifurcationCurve, other: BifurcationCurve, near: float, unit: np.ndarray
) -> np.ndarray:
    """Mask of the rows of a curve that lie on another one, with the same motion, [rows]."""
    path, rows, found = other.path / unit, other.values / unit, np.zeros(len(curve), bool)
    for row, (at, place) in enumerate(zip(curve.values / unit, curve.places, strict=True)):
        away, _ = from_chords(at, path)
        there = other.places[int(np.argmin(np.hypot(*(rows - at).T)))]
        found[row] = np.min(away) < near and not is_elsewhere(place, there, SAME_PLACE)
    return found


def _shortened(curve: BifurcationCurve, first: int, last: int) -> BifurcationCurve:
    """The part of a curve from its row `first` to its row `last`, both included."""
    if (first, last) == (0, len(curve) - 1):
        return curve
    special, row = [], -1
    for item in curve.in_order():
        if isinstance(item, SpecialPoint):
            # Special points between a row left out and the first or last row kept are its ends.
            if first - 1 <= row <= last:
                special.append(item)
        else:
            row = item
    kept = slice(first, last + 1)
    ends = [
        end if row == whole else Stop.STOPPED
        for end, row, whole in zip(curve.ends, (first, last), (0, len(curve) - 1), strict=True)
    ]
    return replace(
        curve,
        values=curve.values[kept],
        classes=curve.classes[kept],
        multiplier=curve.multiplier[kept],
        residual=curve.residual[kept],
        places=curve.places[kept],
        special=tuple(special),
        ends=(ends[0], ends[1]),
    )


def _meeting_at_end(
    curve: BifurcationCurve,
    end: int,
    known: Sequence[SpecialPoint],
    step: float,
    unit: np.ndarray,
) -> SpecialPoint | None:
    """The known point in which a curve ends, unless its end has a reason or a name already.

    end: 0 for its first row, -1 for its last one. The point has to be near, and a parabola through
    the last rows has to lead to it.
    """
    if curve.ends[end] in (Stop.LEFT_SPAN, Stop.CLOSED) or curve.is_named(end):
        return None
    values = curve.values / unit
    rows = values[:END_ROWS] if end == 0 else values[::-1][:END_ROWS]
    gone = np.append(0.0, np.cumsum(np.hypot(*np.diff(rows, axis=0).T)))
    degree = min(2, len(rows) - 1)
    # A curve that was cut may have gone a little beyond the point.
    ahead = np.linspace(step, -MEETS * step, 200)
    fits = [np.polyfit(gone, column, degree) for column in rows.T]
    path = np.column_stack([np.polyval(fit, ahead) for fit in fits])
    found = []
    for point in known:
        at = np.array(point.values) / unit
        gap = float(np.hypot(*(at - rows[0])))
        miss = float(np.min(np.hypot(*(path - at).T)))
        if gap < MEETS * step and miss < MISSES * max(gap, 0.1 * step):
            found.append((gap, point))
    return min(found, key=lambda one: one[0])[1] if found else None


def _lies_on(
    point: BifurcationPoint,
    at: np.ndarray,
    curve: BifurcationCurve,
    step: float,
    unit: np.ndarray,
) -> bool:
    """Whether a point, at parameters `at`, lies on a known curve of its own kind and belts."""
    if point.condition.lineage != curve.condition.lineage:
        return False
    return is_on_rows(at / unit, point.place, curve.values / unit, curve.places, 0.3 * step)
