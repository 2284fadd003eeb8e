"""Curves of bifurcation points in two parameters: `bifurcation_curve`.

A condition's own system of equations, regular at the point, stays regular along its curve. With one
more unknown, the second parameter, pseudo-arclength continuation follows it (see `continuation`),
turning points included. The signature is fixed while it lasts. Functions that vanish where two
conditions hold at once are watched: the velocities of the belts and their differences on every
curve, and those that the condition's system names. Where one changes its sign, the system is solved
for its zero, a point of codimension two. There the signature may change; the condition is then
refined anew just beyond, and the curve goes on with the signature that is found.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import numpy as np

from ..activity import announced, note_progress
from ..checks import (
    as_array,
    as_interval,
    as_positive,
    as_whole,
    outside_of_traces,
    require,
    require_value,
)
from ..cycles.attractors import PLACE_DIMENSIONS, SAME_CYCLE
from ..model.oscillator import Oscillator
from ..model.own_units import own_length, quantity, rescaled
from ..model.parameters import leaf_index
from ..model.variations import Variation
from ..numerics.continuation import CurvePoint, Stop, continue_curve
from ..numerics.newton import HOLDS
from ..results import Status, draw
from ..tables import table_of
from .base import AbstractCondition, BifurcationPoint
from .changes import (
    SAME_POINT_AGAIN,
    CurveProblem,
    CurveRow,
    begun_again,
    begun_off_events_at,
    beyond_change,
    just_ahead,
    named_once,
    parameters_apart,
    where_it_ends,
)
from .forced import AbstractForcedCondition, UnitCircle
from .forced_ends import border_at, meeting_point
from .special import (
    CREEPS,
    SpecialPoint,
    Trail,
    is_elsewhere,
    where_belts_stop,
    where_edge_is_touched,
)
from .systems import RestSystem, Seen
from .tracks import Track, special_between, special_on

if TYPE_CHECKING:
    import pandas

#: A curve ends where steps shorter than this fraction of the longest would be needed: a curve of
#: nonsmooth folds has a turning point with a radius of a hundredth of a step.
SHORTEST_PART = 1e-3
#: Number of points after which the integration steps are distributed anew.
REMESH = 10


class BifurcationCurve(eqx.Module):
    """A curve of bifurcation points in two parameters; what `bifurcation_curve` returns.

    `path`, `table()` and `plot()` have rows and special points together.

    Attributes:
        condition: The condition of the point where it began.
        values: Values of the two parameters, [rows, 2].
        classes: Class of the condition that holds at each row.
        multiplier: Multiplier of the cycle without the stick phase that vanishes, [rows], NaN where
            there is none.
        residual: Largest error in the defining equations, [rows].
        places: Smallest and largest x1, the same of x2, and the period, of the cycle or the fixed
            point, [rows, 5], NaN where there is none.
        special: Points of codimension two, in order.
        ends: Why the curve ends at the first and the last row.
        names: Names of the parameters.
    """

    condition: AbstractCondition = eqx.field(static=True)
    values: np.ndarray
    classes: tuple[type[AbstractCondition], ...] = eqx.field(static=True)
    multiplier: np.ndarray
    residual: np.ndarray
    places: np.ndarray = eqx.field(metadata=quantity(*PLACE_DIMENSIONS))
    special: tuple[SpecialPoint, ...] = eqx.field(static=True)
    ends: tuple[Stop, Stop] = eqx.field(static=True)
    names: tuple[str, str] = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.values)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the conditions that hold at the rows."""
        return tuple(kind.__name__ for kind in self.classes)

    @property
    def path(self) -> np.ndarray:
        """The values with those of the special points among them, [rows + special, 2]."""
        at = (i.values if isinstance(i, SpecialPoint) else self.values[i] for i in self.in_order())
        return np.array(list(at))

    def table(self, names: tuple[str, str] | None = None) -> "pandas.DataFrame":
        """Returns a row for each row of the curve and each special point, in order.

        Columns: condition, belts (of the condition), the two parameters, multiplier, residual,
        special (kind and belts of a special point, else "").

        Args:
            names: Names for the columns of the parameters; None: those of the curve.
        """
        belts, kinds = self.condition.belts_concerned, self.kinds
        rows, kind = [], kinds[0]
        for item in self.in_order():
            if isinstance(item, SpecialPoint):
                values, multiplier, residual = item.values, np.nan, item.residual
                special = " ".join(map(str, (item.kind, *item.belts)))
            else:
                kind, values, special = kinds[item], self.values[item].tolist(), ""
                multiplier, residual = float(self.multiplier[item]), float(self.residual[item])
            rows.append(
                {
                    "condition": kind,
                    "belts": " ".join(map(str, belts)),
                    **dict(zip(names or self.names, values, strict=True)),
                    "multiplier": multiplier,
                    "residual": residual,
                    "special": special,
                }
            )
        return table_of(rows)

    def in_order(self) -> list[int | SpecialPoint]:
        """Numbers of the rows, with the special points at their places among them."""
        path, order = self.values, list[int | SpecialPoint](range(len(self)))
        for point in self.special:
            at = np.array(point.values)
            ends = [np.hypot(*(path[i] - at)) for i in (0, -1)]
            gaps = np.hypot(*(path[1:] - path[:-1]).T)
            detour = np.hypot(*(path[:-1] - at).T) + np.hypot(*(path[1:] - at).T) - gaps
            # Before the first or after the last row, if that row is nearer than the least detour.
            places = [ends[0], *np.maximum(detour, 0), ends[1]]
            place = int(np.argmin(places)) if ends[1] else len(path)
            path = np.insert(path, place, at, axis=0)
            order.insert(place, point)
        return order

    def is_named(self, end: int) -> bool:
        """Whether the end at its first row (0) or last row (-1) is a special point."""
        return isinstance(self.in_order()[end], SpecialPoint)

    def plot(self, ax: Any = None) -> Any:
        """Draws the curve in the plane of the two parameters.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        first, last = (f"({p:.6g}, {q:.6g})" for p, q in self.values[[0, -1]])
        special = ", ".join(point.kind for point in self.special) or "none"
        cut_off = ", cut off at max_points" if Stop.POINT_COUNT in self.ends else ""
        return (
            f"BifurcationCurve({self.condition!r}, {len(self)} rows, {first} to {last}, "
            f"special: {special}{cut_off})"
        )


def given_curve(curve: BifurcationCurve, variation: Variation) -> BifurcationCurve:
    """A curve that was found in own units, converted to the units of the given variation."""
    if variation.units is None:
        return curve
    length, units = variation.units.length, variation.units.parameters
    special = tuple(one.measured_in(units) for one in curve.special)
    found = rescaled(curve, length)
    return replace(found, values=curve.values * units, special=special)


@announced("bifurcation_curve")
@outside_of_traces
def bifurcation_curve(
    point: BifurcationPoint,
    where: tuple[Callable[[Oscillator], Any], Callable[[Oscillator], Any]]
    | Callable[..., Oscillator],
    span: tuple[tuple[float, float], tuple[float, float]],
    *,
    at: tuple[float, float] | None = None,
    step: float = 0.01,
    max_points: int = 1000,
) -> BifurcationCurve:
    """Follows a bifurcation point in two parameters, to both sides.

    With a function `make(p, q)` the curve begins where make(p, q) is the oscillator of the point,
    however the point was found: with `make` at a fixed q, or in any other way.

    Args:
        point: From `refine` or `scan`, with status OK.
        where: Selects the two parameters; or a function of both that returns the oscillator,
            `make(p, q)`.
        span: First and last value of each parameter.
        at: Values (p, q) near the point; needed only where several places of the plane have the
            same oscillator (as for a function of `p**2`).
        step: Largest distance between neighbours, in units of the parameters in which a change by 1
            changes some number of the dimensionless oscillator by 1, and none by more; up to a
            factor of two, by the unit of length.
        max_points: Largest number of points on each side; `ends` says where it cut the curve off.

    Returns:
        The `BifurcationCurve`.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    require_value(
        isinstance(point, BifurcationPoint),
        "point",
        "a BifurcationPoint, such as jb.refine(...)",
        point,
    )
    if int(point.status) != Status.OK:
        require(False, "point", "one with status OK", repr(point))
    two = isinstance(span, tuple | list | np.ndarray) and len(span) == 2 and np.ndim(span[0]) > 0
    require_value(two, "span", "((first, last), (first, last)), one pair a parameter", span)
    limits = np.array([as_interval(ends, f"span[{i}]") for i, ends in enumerate(span)])
    step = as_positive(step, "step")
    max_points = as_whole(max_points, "max_points")
    near = None if at is None else np.asarray(as_array(at, "at", (2,)))
    given = _varied_by_two(point.oscillator, where, near, limits)
    length = own_length(point.oscillator)
    variation = given.in_units(length, np.mean(limits, axis=1) if near is None else near)
    own = variation.own.of(point.oscillator)
    point = rescaled(point, 1 / length, lambda _: own)
    units = variation.own.parameters
    start = variation.values_of(
        own, limits / units[:, None], None if near is None else near / units
    )
    if start is None:
        raise ValueError(
            "where must be a function that gives the oscillator of the point, got one that does so "
            f"at no values near those of the span {limits.tolist()}"
        )
    known = start * units
    inside = np.all((limits[:, 0] <= known) & (known <= limits[:, 1]))
    require(inside, "span", f"around the point {known.tolist()}", limits.tolist())
    limits = limits / units[:, None]
    curve = follow_point(variation, point, start, limits, step=step, max_points=max_points)
    return given_curve(curve, variation)


def _varied_by_two(osc: Oscillator, where: Any, at: Any, limits: np.ndarray) -> Variation:
    """The variation of two leaves of the oscillator, or of a function's two arguments."""
    if callable(where):
        values = tuple(np.mean(limits, axis=1).tolist() if at is None else at.tolist())
        make: Any = where
        return Variation.of_function(make, values, "where", forced=True)
    two = isinstance(where, tuple | list) and len(where) == 2
    require_value(two, "where", "two functions, or one of both parameters", where)
    require_value(at is None, "at", "left out where `where` selects the parameters", at)
    numbers = [leaf_index(osc, one) for one in where]
    require(numbers[0] != numbers[1], "where", "two different parameters", "one twice")
    return Variation.of_leaves(osc, numbers)


def follow_point(
    variation: Variation,
    point: BifurcationPoint,
    start: np.ndarray,
    limits: np.ndarray,
    *,
    step: float,
    max_points: int = 1000,
) -> BifurcationCurve:
    """The curve of a point at `start`, [2], within limits, [2, 2].

    step: in units in which both parameters change the oscillator equally.
    """
    units = np.asarray(variation.family(start).units)
    measured, ends = variation.measured_in(units), limits / units[:, None]
    condition = point.condition.applied_to(point.oscillator)
    problem = CurveProblem(condition, measured, ends, step, max_points)
    start = start / units
    ahead = _side(problem, point, start, 1.0)
    closed = ahead.end is Stop.CLOSED
    behind = (
        _OneSide(ahead.rows[:1], [], Stop.CLOSED) if closed else _side(problem, point, start, -1.0)
    )
    rows = [*reversed(behind.rows[1:]), *ahead.rows]
    special = [*reversed(behind.special), *ahead.special]
    return BifurcationCurve(
        condition=point.condition,
        values=units * np.array([row.values for row in rows]),
        classes=tuple(row.kind for row in rows),
        multiplier=np.array([row.multiplier for row in rows]),
        residual=np.array([row.residual for row in rows]),
        places=np.array([row.place for row in rows]),
        special=tuple(one.measured_in(units) for one in named_once(special)),
        ends=(behind.end, ahead.end),
        names=(variation.names[0], variation.names[1]),
    )


# --- going along ----------------------------------------------------------------------------------


class _Home(NamedTuple):
    """Where a curve begins: both parameters, the direction in them, and the place of the motion."""

    values: np.ndarray
    direction: np.ndarray
    place: np.ndarray


class _OneSide(NamedTuple):
    rows: list[CurveRow]
    special: list[SpecialPoint]
    end: Stop


def _side(
    problem: CurveProblem, point: BifurcationPoint, start: np.ndarray, sign: float
) -> _OneSide:
    """The curve to one side of a point: leg by leg, each with one signature and one mesh."""
    track, u = Track.begun(problem.variation, point, start)
    direction = sign * track.tangent(u)
    home = _Home(u[-2:], direction[-2:], track.place(u))
    rows: list[CurveRow] = []
    seen_last: list[tuple[CurvePoint, Seen]] = []
    special: list[SpecialPoint] = []
    is_forced, has_turned = isinstance(problem.condition, AbstractForcedCondition), False
    while True:
        note_progress(f"{len(rows)} points on one side")
        most = min(REMESH, problem.max_points - max(len(rows) - 1, 0))
        is_start = sign > 0 and not rows
        leg = _leg(problem, track, u, direction, home, most, is_start=is_start)
        points, beyond, end = leg.points, leg.beyond, leg.end
        rows += [_row_at(problem, track, at.u, seen) for at, seen in points[min(len(rows), 1) :]]
        passed = [*special, *leg.special]
        special = [*passed, *leg.at_change]
        seen_last = [*seen_last, *points[min(len(seen_last), 1) :]][-2:]
        last = points[-1][0].u if points else u
        turned = None
        if beyond is not None and points and not (has_turned and len(points) == 1):
            turned = begun_off_events_at(track, points[-1][0], beyond)
        has_turned = turned is not None
        if turned is not None:
            (track, u, direction), special = turned, passed
            continue
        if not rows:
            return _OneSide(rows, special, end)
        trail = _trail(problem, track, rows, last, end)
        limit = None if end is Stop.LEFT_SPAN else problem.condition.limit(trail)
        if limit is not None and problem.contains(limit):
            rows += _towards(problem, rows[-1].values, limit)
            return _OneSide(rows, [*special, limit], Stop.STOPPED)
        creeping = None if end is Stop.LEFT_SPAN else _end_at_rest(problem, rows, CREEPS)
        if creeping is not None and problem.contains(creeping):
            return _OneSide(rows, [*special, creeping], Stop.STOPPED)
        if len(rows) >= problem.max_points:
            return _ended(problem, rows, special, trail._replace(end=Stop.POINT_COUNT))
        changes = leg.at_change
        if not points or end is Stop.STEP_TOO_SMALL:
            trail = trail._replace(end=Stop.STEP_TOO_SMALL)
            # With forcing, zeros of watched functions do not change the signature; the curve of a
            # multiplier ends where the signature does.
            changes = [] if is_forced else just_ahead(seen_last, problem.step)
            special += changes
            goes_on = is_forced and not isinstance(problem.condition, UnitCircle) and points
            if not changes and not (goes_on and meeting_point(problem.condition, trail) is None):
                return _ended(problem, rows, special, trail)
        elif beyond is None and end is not Stop.POINT_COUNT:
            return _ended(problem, rows, special, trail)
        elif beyond is None:
            # The same curve goes on with a new mesh, or with arcs that end where x2 is extreme.
            at, seen = points[-1]
            begun = None if seen.is_cut else begun_again(problem, track, at)
            track, u, direction = begun or track.remeshed(last, at.tangent)
            continue
        # The signature changes here, or between the last two points.
        known, error = last, SHORTEST_PART * problem.step
        if beyond is not None:
            known, error = where_it_ends(track, points[-1][0], beyond)
        centre = np.array(changes[-1].values) if changes else known[-2:]
        rests = isinstance(track.system, RestSystem)
        is_end = problem.condition.ends_at_contact and (bool(changes) or rests)
        way = (points[-1][0].tangent if points else direction)[-2:]
        further = None if is_end else beyond_change(problem, track, rows, last, centre, way)
        if further is None and (rests or is_forced) and beyond is not None:
            at_end = [
                one for one in leg.at_change if parameters_apart(one.values, known) < 2 * error
            ]
            step = points[-1], beyond
            return _ended_between(problem, track, rows, (passed, at_end), trail, step, known)
        if further is None:
            return _ended(problem, rows, special, trail)
        special += [] if changes else border_at(problem.condition, trail, further[0], centre, error)
        track, u = Track.begun(problem.variation, *further)
        direction = track.tangent(u)
        direction = direction * np.sign(direction[-2:] @ (u[-2:] - centre))
        rows.append(_row_at(problem, track, u, track.seen_at(u)))
        seen_last = []


def _ended(
    problem: CurveProblem, rows: list[CurveRow], special: list[SpecialPoint], trail: Trail
) -> _OneSide:
    if trail.end in (Stop.LEFT_SPAN, Stop.CLOSED):
        return _OneSide(rows, special, trail.end)
    limit = _end_at_rest(problem, rows, 2 * problem.step)
    if limit is None and trail.end is Stop.STEP_TOO_SMALL:
        last = [np.stack(column) for column in zip(*((row.values, row.place) for row in rows[-2:]))]
        limit = where_edge_is_touched(problem.variation, last[0], last[1], 1e-2 * problem.step)
    if limit is None and trail.end is not Stop.POINT_COUNT:
        limit = meeting_point(problem.condition, trail)
    if limit is not None and not problem.contains(limit):
        limit = None
    known = [one.values for one in special if limit and one.kind == limit.kind]
    apart = [np.hypot(*np.subtract(limit.values, one)) for one in known] if limit else [0.0]
    named = [] if min(apart, default=np.inf) < problem.step else [limit]
    return _OneSide(rows, [*special, *filter(None, named)], trail.end)


def _ended_between(
    problem: CurveProblem,
    track: Track,
    rows: list[CurveRow],
    special: tuple[list[SpecialPoint], list[SpecialPoint]],
    trail: Trail,
    step: tuple[tuple[CurvePoint, Seen], CurvePoint],
    u: np.ndarray,
) -> _OneSide:
    """The side of a curve of states of rest, or of forced motions, that ends at u, with a row at u.

    special: up to the last point, and at u; step: from that point to one where no motion exists.
    """
    (passed, known), (last, beyond) = special, step
    end = beyond._replace(u=u), track.seen_at(u)
    if beyond.end is Stop.LEFT_SPAN and parameters_apart(u[-2:], beyond.u) < SAME_POINT_AGAIN:
        trail = trail._replace(end=Stop.LEFT_SPAN)
    # Watched functions may vanish at the end without a change of sign.
    tests, behind, pair = end[1].tests, track.seen_at(beyond.u).tests, (float(u[-2]), float(u[-1]))
    at_end = {(one.kind, one.belts): one for one in known} | {
        name: SpecialPoint(*name, pair, abs(value))
        for name, value in tests.items()
        if abs(value) < HOLDS and not abs(behind[name]) < HOLDS
    }
    between = special_between(track, problem.limits, last, end)
    passed = [*passed, *(one for one in between if (one.kind, one.belts) not in at_end)]
    side = _ended(problem, rows, [*passed, *at_end.values()], trail)
    is_row = parameters_apart(u[-2:], last[0].u) < SAME_POINT_AGAIN
    return side._replace(rows=[*rows, *([] if is_row else [_row_at(problem, track, u, end[1])])])


def _end_at_rest(problem: CurveProblem, rows: list[CurveRow], near: float) -> SpecialPoint | None:
    values = np.array([row.values for row in rows[-3:]])
    return where_belts_stop(problem.variation, values, near, 3 * problem.step)


class _Leg(NamedTuple):
    """A leg of a curve.

    points: those where the motion exists, and what is `Seen` there; special: points of codimension
    two between them; beyond: the next point, where the motion does not exist; at_change: points of
    codimension two between the last of the points and `beyond`.
    """

    points: list[tuple[CurvePoint, Seen]]
    special: list[SpecialPoint]
    at_change: list[SpecialPoint]
    beyond: CurvePoint | None
    end: Stop


def _leg(
    problem: CurveProblem,
    track: Track,
    u,
    direction,
    home: _Home,
    most: int,
    *,
    is_start: bool,
) -> _Leg:
    """A leg of at most `most` points, which ends early where x2 is extreme within an arc; is_start:
    whether its first point is the start of the curve, and no leg has been there."""
    points, special = [], []
    for at in _points_along(problem, track, u, direction, most):
        if points:
            at = _closing(track, points[-1][0], at, home) or at
        new = at, track.seen_at(at.u)
        found = special_between(track, problem.limits, points[-1], new) if points else []
        if not new[1].exists:
            return _Leg(points, special, found, at, Stop.STOPPED)
        if points or is_start:
            aside = SHORTEST_PART * problem.step
            found += special_on(track, problem.limits, aside, new, *points[-1:])
        points.append(new)
        special += found
        if at.end is not None:
            return _Leg(points, special, [], None, at.end)
        if len(points) > 1 and not new[1].is_cut:
            return _Leg(points, special, [], None, Stop.POINT_COUNT)
    return _Leg(points, special, [], None, Stop.STEP_TOO_SMALL)


def _closing(track: Track, before: CurvePoint, after: CurvePoint, home: _Home) -> CurvePoint | None:
    """The point where the curve began, if the step from `before` to `after` passes it."""
    chord = (after.u - before.u)[-2:]
    part = (home.values - before.u[-2:]) @ chord / (chord @ chord)
    if not 1e-9 < part <= 1:
        return None
    guess = before.u + part * (after.u - before.u)
    normal = np.append(np.zeros(guess.size - 2), chord)
    at = track.corrected(guess, normal / np.linalg.norm(chord), 0.0)
    away = np.linalg.norm(at.u[-2:] - home.values) > 1e-6 * np.linalg.norm(chord)
    if not at.found or away or at.tangent[-2:] @ home.direction < 0:
        return None
    if is_elsewhere(track.place(at.u), home.place, SAME_CYCLE):
        return None
    return after._replace(u=at.u, tangent=at.tangent, end=Stop.CLOSED)


def _points_along(
    problem: CurveProblem, track: Track, u: np.ndarray, direction: np.ndarray, most: int
):
    span = np.full((2, u.size), np.inf) * np.array([[-1.0], [1.0]])
    span[:, -2:] = problem.limits.T
    return continue_curve(
        track.corrected,
        u,
        direction,
        span=(span[0], span[1]),
        step=problem.step,
        min_step=SHORTEST_PART * problem.step,
        max_step=problem.step,
        max_points=most,
    )


def _row_at(problem: CurveProblem, track: Track, u: np.ndarray, seen: Seen) -> CurveRow:
    osc = problem.variation.oscillator(u[-2:])
    kind = problem.condition.kind_along(osc, seen.multiplier)
    return CurveRow(u[-2:], kind, seen.multiplier, seen.residual, track.place(u))


def _trail(problem: CurveProblem, track: Track, rows: list[CurveRow], u, end: Stop) -> Trail:
    """The last stretch of a curve up to its point u."""
    values = np.array([row.values for row in rows[-3:]])
    return Trail(problem.variation, problem.step, values, track.system, track.unknowns(u), end)


def _towards(problem: CurveProblem, last: np.ndarray, limit: SpecialPoint) -> list[CurveRow]:
    """Rows between the last one and a belt at rest, where the curve bends.

    Each is half as far from the end as the one before.
    """
    condition, end = problem.condition, np.array(limit.values)
    if not condition.bends:
        return []
    rows = []
    held = int(np.argmin(np.abs(end)))
    for part in 0.5 ** np.arange(1, 6):
        guess = end + part * (last - end)
        along = problem.variation.held(held, float(guess[held]))
        point = condition.named_point_from(along, float(guess[1 - held]))
        if point is None or abs(float(point.value) - guess[1 - held]) > problem.step:
            break
        guess[1 - held] = float(point.value)
        numbers = float(point.multiplier), float(point.residual)
        rows.append(CurveRow(guess, type(point.condition), *numbers, point.place))
    return rows
