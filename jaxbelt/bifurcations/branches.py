"""Branches of periodic motions of forced oscillators along one parameter: `forced_branches`.

A branch with a fixed signature is a curve in the unknowns of its motions and the parameter, which
pseudo-arclength follows, round folds, too. Where a function of the multipliers changes its sign
between two motions, the point between them is solved for. Where a motion leaves its signature, the
conditions on sliding and on edges are solved from the last motion before, and at the nearest of
these points the branch continues with another signature: on the other side of the point, or back on
the same one. At a period doubling, and where symmetry breaks, the other branches that meet this one
are followed, too.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from ..activity import note_progress
from ..cycles.periodic import (
    PeriodicMotion,
    is_same_motion,
    motion_between_halves,
    periodic_from,
    state_near_start,
)
from ..model.events import of_one_loop
from ..model.friction import friction_jumps
from ..model.own_units import OwnOscillator
from ..results import Status
from .base import AbstractCondition, BifurcationPoint
from .edges import GrazingEdge
from .forced import (
    AbstractForcedCondition,
    AddingSliding,
    Fold,
    PeriodDoubling,
    SwitchingSliding,
    Torus,
)
from .forced_ends import borders_of
from .legs import ForcedLine, MotionBranch, MotionLeg, MotionRow
from .symmetry import SymmetryBreaking, asymmetry_of, image_of, is_symmetric
from .tangencies import GrazingSliding
from .timed_systems import unit_circle_tests

#: First, shortest and longest step; a step's change of the parameter is relative to the span.
FIRST_STEP_OF_BRANCH, SHORTEST_STEP_OF_BRANCH, LONGEST_STEP_OF_BRANCH = 2e-3, 1e-7, 2e-2
#: The conditions on sliding are solved again only when steps are shorter by this factor.
SEARCH_AGAIN = 2e-3
#: Number of rows after a failed one before steps become longer again.
STRAIGHT_ROWS = 3
#: Smallest cosine of the angle between the tangents of neighbouring motions.
STRAIGHT_BRANCH = 0.95
#: Largest number of motions on each side.
MOST_MOTIONS = 400
#: A motion counts as unbounded if it is larger than 1 + the first one of its branch by this factor.
UNBOUNDED = 1e3
#: A gap wider than WIDE_GAP of the span that no branch reaches is searched for another branch, at
#: most MOST_FURTHER times.
WIDE_GAP, MOST_FURTHER = 0.02, 4
#: Distances beyond a point where motions with another signature are sought, in parts of the span.
BEYOND_POINT = (1e-5, 1e-4, 1e-3)
#: Phases, as fractions of a period, at which guesses for motions are made.
SOME_PHASES = (0.0, 0.25, 0.5, 0.75)
#: A motion beyond a point is accepted if its state at the phase 0 is this near to the point's.
NEAR_POINT = 0.1
#: A motion is between two successive ones if it is off their chord by at most this part of it.
STRAIGHT_WAY = 0.1
#: The halves of a motion are equal if they differ by less than this part of what they did before.
GONE_OVER = 1e-4
#: If a motion differs by less than this from itself half of its periods later, or from its image, a
#: point is near in which it has left another motion.
ALIKE_HALVES = 0.03
#: Largest difference of the multipliers, over 1 + their size, of two motions of one branch between
#: which only events change.
ALIKE_MULTIPLIERS = 0.1
#: Distances from a point at which motions that leave another one, and that other one, are sought.
LEAVES = (1e-3, 1e-2, 5e-2)


def forced_branches(
    line: ForcedLine, begun: MotionRow, further: Callable[[float], MotionRow | None] | None
) -> tuple[list[MotionBranch], list[BifurcationPoint]]:
    """The branches from a motion within a span, and the points on them, all in own units.

    These are the branch of `begun`, to both sides, and those that meet it in period doublings and
    where symmetry breaks. further: finds a motion, whose branch is followed, too, at a value that
    no branch reaches.
    """
    branches, found, waiting = [], [], [(begun, True)]
    looked = 0
    while waiting:
        row, is_first = waiting.pop(0)
        if any(_is_on_branch(line, row, one) for one in branches):
            continue
        sides = [_side_of_point(line, row, -1.0)]
        around = sides[0][0].is_closed
        sides += [(MotionBranch([row], []), [])] if around else [_side_of_point(line, row, 1.0)]
        behind, ahead = (side for side, _ in sides)
        ends = [*behind.open_ends, *ahead.open_ends]
        branches.append(MotionBranch([*reversed(behind.rows[1:]), *ahead.rows], ends))
        for point in (point for _, points in sides for point in points):
            if any(_is_known_motion(point, one, line) for one in found):
                continue
            found.append(point)
            if is_first:
                waiting += [(other, False) for other in _other_branches(line, point, row)]
        if further and not waiting and looked < MOST_FURTHER:
            looked += 1
            width, middle = _widest_gap(line, branches)
            other = further(middle) if width > WIDE_GAP * line.length else None
            waiting += [(other, True)] if other is not None else []
    return branches, sorted(found, key=lambda point: float(point.value))


def _is_on_branch(line: ForcedLine, row: MotionRow, branch: MotionBranch) -> bool:
    """Whether a motion belongs to a branch."""
    near = min(branch.rows, key=lambda one: abs(one.value - row.value))
    # Where a symmetric motion, an asymmetric one and its image meet, Newton's method may converge
    # to any of them.
    if line.is_symmetric and _side_of_symmetry(line, row) != _side_of_symmetry(line, near, row):
        return False
    return _has_passed(branch.rows, row.value, line.at(row.value), row.motion)


def _side_of_symmetry(line: ForcedLine, row: MotionRow, like: MotionRow | None = None) -> float:
    """0 for a symmetric motion; for an asymmetric one the sign of its asymmetry relative to `like`.

    1 where there is no `like` to compare with, and for motions of an even number of periods.
    """
    osc = line.at(row.value)
    away = asymmetry_of(osc, row.motion)
    if away is None or is_symmetric(osc, row.motion):
        return float(away is None)
    other = None if like is None else asymmetry_of(line.at(like.value), like.motion)
    return 1.0 if other is None else float(np.sign(away @ other))


def _widest_gap(line: ForcedLine, branches: list[MotionBranch]) -> tuple[float, float]:
    """Width and middle of the widest interval of the span that no branch reaches."""
    ranges = [[row.value for row in one.rows] for one in branches] + [[line.last]]
    reached, gaps = line.first, []
    for low, high in sorted((min(values), max(values)) for values in ranges):
        gaps.append((low - reached, 0.5 * (reached + low)))
        reached = max(reached, high)
    return max(gaps)


def _is_known_motion(point: BifurcationPoint, other: BifurcationPoint, line: ForcedLine) -> bool:
    close = abs(float(point.value) - float(other.value)) < 1e-8 * line.length
    alike = type(point.condition) is type(other.condition)
    return bool(close and alike and is_same_motion(point.cycle, other.cycle))


# --- leg by leg -----------------------------------------------------------------------------------


def _side_of_point(
    line: ForcedLine, row: MotionRow, sign: float
) -> tuple[MotionBranch, list[BifurcationPoint]]:
    """The branch to one side of a motion, leg by leg, and the points on it."""
    rows, points = [row], []
    while len(rows) < MOST_MOTIONS:
        note_progress(f"{len(rows)} motions on one side")
        ahead, found, further = _branch_leg(line, rows, sign)
        rows += ahead
        points += found
        if rows[-1] is row and len(rows) > 1:
            return MotionBranch(rows, [], is_closed=True), points
        if further is None:
            return MotionBranch(rows, []), points
        if not isinstance(further, tuple):
            return MotionBranch(rows, [further]), points
        new, sign = further
        rows.append(new)
    return MotionBranch(rows, [rows[-1].value]), points


def _branch_leg(
    line: ForcedLine, behind: list[MotionRow], sign: float
) -> tuple[list[MotionRow], list[BifurcationPoint], tuple[MotionRow, float] | float | None]:
    """The motions after the last one of `behind` with its signature, the points among them, and how
    the branch goes on.

    Where the signature ends: the first motion with another one, and the sense in which the
    parameter goes from it. None where the branch leaves the span, ends in a point (also where it
    comes back to the branch that it has left in a period doubling), or comes back to the first
    motion of `behind`, then its last row. A value of the parameter where it ends otherwise.
    """
    home, row = behind[0], behind[-1]
    leg, begun = MotionLeg.begun(line, row)
    if not begun.found:
        return [], [], row.value
    u, tangent = begun.u, sign * begun.tangent * np.sign(begun.tangent[-1])
    rows, points, step, straight = [], [], FIRST_STEP_OF_BRANCH, STRAIGHT_ROWS
    last, borders, searched = row, [], np.inf
    size = np.max(np.abs(np.asarray(home.motion.unknowns)[:, :2]))
    while len(rows) < MOST_MOTIONS and step > SHORTEST_STEP_OF_BRANCH:
        solved = leg.corrected(u, tangent, step)
        if not solved.found or solved.tangent @ tangent < STRAIGHT_BRANCH:
            step *= 0.5
            continue
        new = leg.row(solved.u)
        if np.max(np.abs(leg.start(solved.u))) > UNBOUNDED * (1 + size):
            return rows, points, last.value
        if not line.first <= new.value <= line.last:
            end = line.first if new.value < line.first else line.last
            at_end = _at_end(leg, u, solved.u, end, line)
            if at_end is None:
                step, straight = 0.5 * step, 0
                continue
            points += list(_points_between(line, last, at_end))
            return [*rows, at_end], points, None
        merging = _merging_between(line, last, new)
        if merging is not None:
            return rows, [*points, merging], None
        if int(new.motion.status) != Status.OK:
            start = leg.start(solved.u)
            if step < SEARCH_AGAIN * searched:
                borders, searched = _borders(line, last), step
            point = _border(line, borders, last, new.value, start)
            if point is not None:
                ends, further = _through_point(line, [*behind, *rows], point, tangent[-1])
                return rows, [*points, *ends], further
            step, straight = 0.5 * step, 0
            continue
        points += list(_points_between(line, last, new))
        if home is not last and _is_on_the_way(home, last, new):
            return [*rows, home], points, None
        rows.append(new)
        straight += 1
        # Towards a border steps become shorter and shorter.
        step = min(LONGEST_STEP_OF_BRANCH, 1.5 * step) if straight > STRAIGHT_ROWS else step
        leg, u, tangent = leg.going_on(new, solved.u, solved.tangent)
        last = new
    if len(rows) < MOST_MOTIONS:
        # Newton's method may fail before the signature ends.
        ahead = u + FIRST_STEP_OF_BRANCH * tangent
        value, start = float(line.length * ahead[-1]), leg.start(ahead)
        within = FIRST_STEP_OF_BRANCH * line.length
        near = [p for p in _borders(line, last) if abs(float(p.value) - last.value) < within]
        point = _border(line, near, last, value, start)
        if point is not None:
            ends, further = _through_point(line, [*behind, *rows], point, tangent[-1])
            return rows, [*points, *ends], further
        further = _past_corner(line, [*behind, *rows], value, start)
        if further is not None:
            return rows, points, (further, float(np.sign(value - last.value)))
    return rows, points, last.value


def _at_end(
    leg: MotionLeg, u: np.ndarray, beyond: np.ndarray, end: float, line: ForcedLine
) -> MotionRow | None:
    """The motion at an end of the span, between two points of a leg; None where its signature has
    ended before."""
    part = (end / line.length - u[-1]) / (beyond[-1] - u[-1])
    solved = leg.corrected(u + part * (beyond - u), np.eye(u.size)[-1], 0.0)
    row = leg.row(solved.u) if solved.found else None
    return row if row is not None and int(row.motion.status) == Status.OK else None


# --- points ---------------------------------------------------------------------------------------


def _tests(motion: PeriodicMotion) -> dict[type[AbstractForcedCondition], float]:
    """Functions that vanish at the points where multipliers meet the unit circle."""
    tests = unit_circle_tests(motion)
    return {kind: float(tests[kind.__name__]) for kind in (PeriodDoubling, Fold, Torus)}


def _points_between(
    line: ForcedLine, one: MotionRow, other: MotionRow
) -> Iterator[BifurcationPoint]:
    """The points between two motions of one signature where multipliers meet the unit circle."""
    before, after = _tests(one.motion), _tests(other.motion)
    for kind in before:
        if not before[kind] * after[kind] < 0:
            continue
        start = np.asarray(other.motion.start)
        rows = sorted((one, other), key=lambda row: abs(_tests(row.motion)[kind]))
        # Between two signatures the multiplier may jump: from the farther motion an earlier point
        # would be found again.
        for row in rows if one.motion.signature == other.motion.signature else rows[:1]:
            found = _points(line, kind(), row)
            if kind is Fold and line.is_symmetric:
                found = [*_points(line, SymmetryBreaking(), row), *found]
            fine = [p for p in found if _is_between(line, p, one, other.value, start)]
            yield from fine[:1]
            if fine:
                break


def _points(
    line: ForcedLine, condition: AbstractCondition, row: MotionRow
) -> list[BifurcationPoint]:
    timed = condition.with_clock()
    found = timed.points(line.variation, np.array([row.value]), row.motion)
    return [replace(p, condition=condition) for p in found if int(p.status) == Status.OK]


def _is_between(
    line: ForcedLine, point: BifurcationPoint, one: MotionRow, value: float, start: np.ndarray
) -> bool:
    """Whether a point is about as near to the motion `one` as the value and the state `start` (at
    the phase 0) are."""
    apart = np.max(np.abs(np.asarray(one.motion.start) - start)) + 1e-6
    reach = 2 * abs(value - one.value) + 2 * LONGEST_STEP_OF_BRANCH * line.length
    away = np.max(np.abs(np.asarray(point.cycle.start) - np.asarray(one.motion.start)))
    return abs(float(point.value) - one.value) <= reach and bool(away <= 5 * apart + 0.01)


def _merging_between(line: ForcedLine, last: MotionRow, new: MotionRow) -> BifurcationPoint | None:
    """The point between two successive motions in which a branch merges with the one it has left.

    Behind a period doubling the branch has its own motions again, half of their periods later;
    behind a symmetry breaking it has their images. So the point has been passed where both halves,
    or the motion and its image, have changed places. It is near where both are alike and `new` was
    not found, as Newton's method is singular there.
    """
    is_known = int(new.motion.status) == Status.OK
    for condition in (PeriodDoubling(), SymmetryBreaking()):
        halves = _apart(line, condition, last)
        if halves is None:
            continue
        ahead, size = _apart(line, condition, new) if is_known else None, np.max(np.abs(halves))
        # Newton's method may also have converged to the motion that the branch has left.
        is_over = ahead is None or np.max(np.abs(ahead)) < GONE_OVER * size
        if is_known and not is_over and np.sum(halves * ahead) >= 0:
            continue
        if not is_known and size > ALIKE_HALVES:
            continue
        middle = np.asarray(last.motion.start) - 0.5 * halves[0]
        if isinstance(condition, PeriodDoubling):
            motion = motion_between_halves(line.at(last.value), last.motion, line.turns)
            between = None if motion is None else MotionRow(last.value, motion)
        else:
            between = _symmetric_beside(line, last.value, middle, last.motion)
        found = [] if between is None else _points(line, condition, between)
        near = [p for p in found if np.max(np.abs(np.asarray(p.cycle.start) - middle)) < size]
        if near:
            return near[0]
    return None


def _is_on_the_way(one: MotionRow, last: MotionRow, new: MotionRow) -> bool:
    """Whether the motion `one` lies between two successive motions of a branch."""
    change, periods = new.value - last.value, last.motion.periods
    if change == 0 or one.motion.periods != periods or new.motion.periods != periods:
        return False
    part = (one.value - last.value) / change
    at, before, after = (np.asarray(row.motion.starts) for row in (one, last, new))
    way = after - before
    away = np.max(np.abs(at - before - part * way))
    return bool(0 <= part <= 1 and away <= STRAIGHT_WAY * np.max(np.abs(way)))


def _symmetric_beside(
    line: ForcedLine, value: float, start: np.ndarray, like: PeriodicMotion
) -> MotionRow | None:
    """A symmetric motion beside a value, from the start of `like` or from `start`: at the value,
    where asymmetric motions leave it, the equations are singular."""
    for size, side in itertools.product(LEAVES, (1.0, -1.0)):
        there = value + side * size * line.length
        if line.first <= there <= line.last:
            osc = line.at(there)
            for begun in (np.asarray(like.at(osc).start), start):
                if not np.all(np.isfinite(begun)):
                    continue
                row = MotionRow(there, periodic_from(osc, begun, like.periods, line.turns))
                if _is_motion(row) and is_symmetric(osc, row.motion):
                    return row
    return None


def _apart(line: ForcedLine, condition: AbstractCondition, row: MotionRow) -> np.ndarray | None:
    """Differences of the states at the phase 0 from those half of the periods later, or from those
    of the image, [states, 2]; None if the motion cannot have left another one in such a point."""
    half, odd = divmod(row.motion.periods, 2)
    if isinstance(condition, PeriodDoubling):
        starts = np.asarray(row.motion.starts)
        return None if odd else starts - np.roll(starts, -half, axis=0)
    if not line.is_symmetric or is_symmetric(osc := line.at(row.value), row.motion):
        return None
    away = asymmetry_of(osc, row.motion)
    return None if away is None else away[None]


def _past_corner(
    line: ForcedLine, rows: list[MotionRow], value: float, start: np.ndarray
) -> MotionRow | None:
    """The motion at a value with about the state `start` at the phase 0, if the branch may go on
    with it: it is as near to `start` as the last row, has nearly the same multipliers, and is not
    on the branch yet.

    Its events may differ: they change where a mass comes to a contact edge with the velocity of a
    belt, or two belts have one velocity.
    """
    if not line.first <= value <= line.last:
        return None
    osc, last = line.at(value), rows[-1]
    motion = periodic_from(osc, start, last.motion.periods, line.turns)
    if int(motion.status) != Status.OK or motion.periods != last.motion.periods:
        return None
    found, before = np.asarray(motion.multipliers), np.asarray(last.motion.multipliers)
    alike = np.max(np.abs(found - before)) < ALIKE_MULTIPLIERS * (1 + np.max(np.abs(before)))
    apart = np.max(np.abs(start - np.asarray(last.motion.start)))
    away = np.max(np.abs(np.asarray(motion.start) - start))
    if not alike or away > apart or _has_passed(rows, value, osc, motion):
        return None
    row = MotionRow(value, motion)
    return row if _begins(line, row) else None


def _borders(line: ForcedLine, row: MotionRow) -> list[BifurcationPoint]:
    """Points near a motion at which its signature may end."""
    borders = borders_of(line.at(row.value))
    return [point for one in borders for point in _points(line, one, row)]


def _border(
    line: ForcedLine,
    borders: list[BifurcationPoint],
    last: MotionRow,
    value: float,
    start: np.ndarray,
) -> BifurcationPoint | None:
    """The nearest of the points `borders` on the way from the last motion to the value and the
    state `start` at the phase 0; its signature ends there. None if no point is on the way."""
    near = [p for p in borders if _is_between(line, p, last, value, start)]
    change = value - last.value
    ahead = [p for p in near if (float(p.value) - last.value) * change >= -1e-9 * line.length]
    return min(ahead, key=lambda p: abs(float(p.value) - last.value), default=None)


def _through_point(
    line: ForcedLine, rows: list[MotionRow], point: BifurcationPoint, direction: float
) -> tuple[list[BifurcationPoint], tuple[MotionRow, float] | None]:
    """The points from the last row up to `point`, in which its signature ends, and how the branch
    goes on from there, see `_beyond_point`."""
    last, end = rows[-1], MotionRow(float(point.value), point.cycle)
    beyond, further = [], None
    if _breaks_symmetry(line, point) and not is_symmetric(line.at(last.value), last.motion):
        return [*_points_between(line, last, end), point], None
    if isinstance(point.condition, GrazingEdge):
        # Motions that pass the edge differ from the touching one by the root of the distance.
        beyond = point.condition.with_clock().motions_beyond(line.variation, point)
    for one in beyond:
        row = MotionRow(float(one.value), one.cycle)
        osc = line.at(row.value)
        if is_same_motion(last.motion.at(osc), row.motion):
            # Here the multiplier grows beyond all bounds; the motion that touches has another one.
            end = row
        elif further is None and not _has_passed(rows, row.value, osc, row.motion):
            sense = float(np.sign(row.value - float(point.value)))
            further = (row, sense) if _begins(line, row) else None
    if further is None:
        further = _beyond_point(line, rows, point, direction)
    return [*_points_between(line, last, end), point], further


def _beyond_point(
    line: ForcedLine, rows: list[MotionRow], point: BifurcationPoint, direction: float
) -> tuple[MotionRow, float] | None:
    """A motion beyond the point in which the signature of the last row ended, and the sense in
    which the parameter goes from it; None if no new one is found.

    direction: its sign is the sense in which the parameter went up to the point."""
    if _jumps_at(point):
        return None
    last = rows[-1]
    direction, value = float(np.sign(direction)), float(point.value)
    periods, start = last.motion.periods, np.asarray(point.cycle.start)
    # Between a guess and the next phase 0 its error may grow a thousandfold.
    for share, side, part in itertools.product(SOME_PHASES, (1.0, -1.0), BEYOND_POINT):
        at, before = (
            state_near_start(line.at(where), motion, share)
            for where, motion in ((value, point.cycle), last[:2])
        )
        there = value + side * direction * part * line.length
        if line.first <= there <= line.last:
            osc = line.at(there)
            for stretch in (0.0, part, -part):
                guess = at + stretch * (at - before)
                motion = periodic_from(osc, guess, periods, line.turns, share)
                fine = int(motion.status) == Status.OK and motion.periods == periods
                if not fine or np.max(np.abs(np.asarray(motion.start) - start)) > NEAR_POINT:
                    continue
                row = MotionRow(there, motion)
                # Beyond the point the signature that has ended may still solve, by rounding.
                ended = of_one_loop(motion.signature) == of_one_loop(last.motion.signature)
                if (side > 0 and ended) or _has_passed(rows, there, osc, motion):
                    continue
                if _begins(line, row):
                    return row, side * direction
    return None


def _has_passed(
    rows: list[MotionRow], value: float, osc: OwnOscillator, motion: PeriodicMotion
) -> bool:
    """Whether a motion at a value is on the branch so far: equal to its last row, or a row beside
    a place where the branch has passed the value."""
    pairs = itertools.pairwise(rows)
    beside = [pair for pair in pairs if (pair[0].value - value) * (pair[1].value - value) <= 0]
    near = [rows[-1], *(row for pair in beside for row in pair)]
    return any(is_same_motion(row.motion.at(osc), motion) for row in near)


def _jumps_at(point: BifurcationPoint) -> bool:
    """Whether a branch ends at a point because friction jumps: to one side of the point the belt
    holds, or lets go, for a time that is not short."""
    condition = point.condition
    may_jump = isinstance(condition, AddingSliding | GrazingSliding | SwitchingSliding)
    return may_jump and bool(friction_jumps(point.oscillator.belts[int(condition.belt)].friction))


def _other_branches(line: ForcedLine, point: BifurcationPoint, begun: MotionRow) -> list[MotionRow]:
    """One motion of each other branch that meets the branch of `begun` in a point: of those that
    leave it there, or of the one that it has left there."""
    value, cycle = float(point.value), point.cycle
    if isinstance(point.condition, PeriodDoubling):
        goes_on = cycle.periods < begun.motion.periods
        other = MotionRow(value, cycle) if goes_on else next(_leaving(line, point), None)
        return [] if other is None else [other]
    if not _breaks_symmetry(line, point):
        return []
    if not is_symmetric(line.at(begun.value), begun.motion):
        symmetric = _symmetric_beside(line, value, np.asarray(cycle.start), cycle)
        return [one for one in (symmetric, _image(line, begun)) if one is not None]
    touches = isinstance(point.condition, GrazingEdge)
    leaving = _asymmetric_beyond(line, point) if touches else _leaving(line, point)
    pairs = ((one, _image(line, one)) for one in leaving)
    return next(([one, image] for one, image in pairs if image is not None), [])


def _breaks_symmetry(line: ForcedLine, point: BifurcationPoint) -> bool:
    """Whether asymmetric motions leave a symmetric one in a point; they do so also where it touches
    edges on both sides."""
    if isinstance(point.condition, SymmetryBreaking):
        return True
    touches = line.is_symmetric and isinstance(point.condition, GrazingEdge)
    return touches and is_symmetric(line.at(float(point.value)), point.cycle)


def _asymmetric_beyond(line: ForcedLine, point: BifurcationPoint) -> Iterator[MotionRow]:
    """Motions that go beyond one of the edges that a symmetric motion touches."""
    for one in point.condition.with_clock().motions_beyond(line.variation, point):
        row = MotionRow(float(one.value), one.cycle)
        if not is_symmetric(line.at(row.value), row.motion) and _begins(line, row):
            yield row


def _begins(line: ForcedLine, row: MotionRow) -> bool:
    """Whether a branch can begin with a motion: near some points its equations are singular."""
    return _is_motion(row) and bool(MotionLeg.begun(line, row)[1].found)


def _image(line: ForcedLine, row: MotionRow) -> MotionRow | None:
    """The image of an asymmetric motion, if a branch can begin with it."""
    image = MotionRow(row.value, image_of(line.at(row.value), row.motion))
    return image if _begins(line, image) else None


def _is_motion(row: MotionRow) -> bool:
    return int(row.motion.status) == Status.OK


def _leaving(line: ForcedLine, point: BifurcationPoint) -> Iterator[MotionRow]:
    """Motions beside a point that leave the motion of the point: at a period doubling of twice its
    period, else asymmetric ones."""
    value, doubles = float(point.value), isinstance(point.condition, PeriodDoubling)
    periods = point.cycle.periods * (2 if doubles else 1)
    for share, size, side in itertools.product(SOME_PHASES, LEAVES, (1.0, -1.0)):
        at = state_near_start(line.at(value), point.cycle, share)
        there = value + side * size**2 * line.length
        if not line.first <= there <= line.last:
            continue
        osc = line.at(there)
        for angle in np.linspace(0, np.pi, 4, endpoint=False):
            guess = at + size * np.array([np.cos(angle), np.sin(angle)])
            motion = periodic_from(osc, guess, periods, line.turns, share)
            row = MotionRow(there, motion)
            fine = _is_motion(row) and motion.periods == periods
            if fine and (doubles or not is_symmetric(osc, motion)) and _begins(line, row):
                yield row
