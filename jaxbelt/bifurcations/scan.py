"""Bifurcation points along a path in one parameter, found without a guess: `scan`.

Where the labels of two values differ, or cycles do not continue (see `path`), the interval is
narrowed until Newton's method converges from its ends. The conditions that could cause this
difference are solved from there; a solution inside the interval is a bifurcation point. The rest of
the interval on either side is treated in the same way, so that points are found that lie closer
together than the first values. A difference that no condition explains is narrowed as far as
rounding allows, and reported.

Labels describe attractors. Points where the unstable cycle in a diagram touches contact edges are
found in the same way from the cycle's itinerary, see `edges_touched`.
"""

import functools
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice, pairwise, takewhile
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..activity import announced, note_progress
from ..checks import as_whole, number, outside_of_traces
from ..cycles.attractors import SAME_CYCLE, distance, is_same, itinerary, place_of
from ..cycles.chains import blank_loop
from ..cycles.cycle import EXACT, as_loop, warn_of_extrapolation
from ..model.oscillator import Oscillator
from ..model.variations import Variation
from ..numerics.compiling import compiled_beside
from ..numerics.newton import NEWTON_STEPS
from ..results import Status
from .base import (
    UNNAMED,
    AbstractCondition,
    BifurcationPoint,
    given_point,
    point_without_cycle,
)
from .beside import sides_of
from .conditions import AbstractCycleCondition
from .connections import SaddleConnection
from .crossings import CrossingSliding, SlidingExchange
from .edge_rests import BoundaryEquilibrium, PseudoHopf
from .edges import GrazingEdge
from .folds import FoldOfCycles
from .infinity import HopfAtInfinity
from .meetings import EdgeExchange, MeetingEdges
from .path import ROOM, ParameterPath
from .rests import ANY, AbstractRestCondition, BeltAtRest, Hopf, SuddenSliding
from .tangencies import GrazingSliding

#: Kinds that are searched; first those that are likelier and whose programs compile sooner.
LOOKED_FOR: tuple[type[AbstractCondition], ...] = (
    Hopf,
    GrazingSliding,
    CrossingSliding,
    SlidingExchange,
    SuddenSliding,
    BeltAtRest,
    BoundaryEquilibrium,
    PseudoHopf,
    EdgeExchange,
    MeetingEdges,
    GrazingEdge,
    FoldOfCycles,
    SaddleConnection,
    HopfAtInfinity,
)
#: How often Newton's method is begun in one search, at most. The paper's path takes 26 attempts, a
#: point that stays unexplained 130; an attempt takes some 10 ms.
MOST_ATTEMPTS = 2000
#: A point with an error above EXACT is solved again from guesses at this distance on both sides, in
#: units of the parameter.
BESIDE_IT = 1e-3
#: Intervals narrower than this fraction of the span are good guesses for Newton's method. On the
#: paper's path 1/100 finds the same points as fast, 1/1600 in a third more time.
NEAR = 1 / 400


@announced("scan")
@outside_of_traces
def scan(
    osc: Oscillator | Callable[..., Oscillator],
    where: Callable[[Oscillator], Any] | None = None,
    span: tuple[float, float] | None = None,
    *,
    resolution: int = 96,
    conditions: Sequence[AbstractCondition] = (),
) -> tuple[BifurcationPoint, ...]:
    """Every bifurcation point along a path in one parameter, in order.

    Two points, of which the second one undoes the change at the first, are seen if one of the first
    values lies between them. Of points closer together than 2e-6 of the span and of the size of the
    parameter, or than 3e-5 beside a fold of cycles, only one may be reported.

    Bifurcations at contact edges are searched where there are any; points where only an unstable
    cycle touches them are in `bifurcation_diagram`, as the attractors stay the same. Where
    something changes and no condition explains it, there is a point of kind `Unexplained`, with the
    status UNEXPLAINED and the value where it happens, good to about 1e-9 of the span; its `sides`
    say what there is below and above, and how far apart the branches end. A search ends, with a
    warning, when it has begun Newton's method two thousand times: each interval that it did not
    look into is a point of kind `Unexplained` with the status INCOMPLETE, whose value and error are
    the middle and half the length of the interval. A condition that holds all along a range, as
    where an edge moves with an equilibrium, is reported once, with the status DEGENERATE; its value
    and error are the middle and half the length of that range, and changes there that Newton's
    method does not find at once are not reported.

    Args:
        osc: The oscillator; or a function of the parameter that returns the oscillator and that JAX
            can differentiate, such as `lambda s: jb.presets.class_c(-0.3, 0.3, sigma=s)`.
        where: Selects the parameter, such as `lambda osc: osc.belts[0].velocity`; None with a
            function.
        span: First and last value of the parameter, dimensionless like the parameter.
        resolution: Number of intervals whose ends are compared first.
        conditions: Your own conditions, which are searched, too.

    Returns:
        A tuple of `BifurcationPoint`, each as from `refine`.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    resolution = as_whole(resolution, "resolution")
    path = ParameterPath(osc, where, span, conditions)
    with compiled_beside("scan", path.at(path.first), calls_ahead(path)):
        points = search(path, resolution)
    points = tuple(given_point(point, path.variation) for point in points)
    warn_of_extrapolation((point.cycle for point in points), depth=5)
    return points


def search(
    path: ParameterPath,
    resolution: int = 96,
    near: float = NEAR,
    known: Sequence[BifurcationPoint] = (),
) -> tuple[BifurcationPoint, ...]:
    """Every bifurcation point on a path, in order; the path keeps its labels.

    near: points are solved for from the ends of intervals narrower than this fraction of the path.
    known: unexplained points of another path, around which nothing is searched again.
    """
    points = [point for at in path.breaks for point in _at_break(path, at)]
    first, last = path.inside(path.first), path.inside(path.last)
    ends = [first, *(v for at in path.breaks for v in path.beside(at)), last]
    width = (path.last - path.first) / resolution
    stretches = [np.empty(0)]  # a short span may have none beside a break
    for a, b in zip(ends[::2], ends[1::2], strict=True):
        if b > a:
            stretches.append(np.linspace(a, b, 1 + max(1, round((b - a) / width))))
    path.find_labels(np.concatenate(stretches))
    explained = [path.beside(float(point.value)) for point in known]
    path.find_labels([value for ends in explained for value in ends])
    # A label beside a point may lie beyond the span.
    explained += [(-np.inf, first), (last, np.inf)]
    margins: list[tuple[float, float]] = []
    for at in path.breaks:
        inner, wide = _inner_and_margins(path, at, *path.beside(at))
        explained.append(inner)
        margins += wide
    path.find_labels([value for margin in margins for value in margin])
    while intervals := path.changes(explained):
        if path.attempts > MOST_ATTEMPTS:
            points += _left(path, intervals)
            break
        note_progress(f"{len(path.labels)} values seen, {len(points)} points found")
        values: list[float] = []
        again: list[float] = []
        for a, b in intervals:
            is_narrow, is_near = b - a <= NEAR * path.length, b - a <= near * path.length
            point = _explained(path, a, b) if is_near else None
            is_beside = any(low <= a and b <= high for low, high in margins)
            if point is not None and _accepts(path, a, b, point, only_inside=is_beside):
                point = more_exact(point, path.variation)
                # The interval on the other side of a fold may have led to it already.
                for one in (point, *_beside_it(path, a, b, point)):
                    if not any(_is_same_point(one, other) for other in points):
                        points.append(one)
                before, after = _explained_range(path, a, b, point)
                inner, wide = _inner_and_margins(path, float(point.value), before, after)
                explained.append(inner)
                margins += wide
                values += [max(a, before), min(b, after), *(v for one in wide for v in one)]
            elif is_beside:
                # Narrowing it takes long there, and leads to what the first point explains.
                if is_near or b - a <= path.closest:
                    explained.append((a, b))
                else:
                    values.append(0.5 * (a + b))
            elif is_near and point is None and _is_degenerate(path, a, b, points):
                explained.append((a, b))
            elif b - a <= 1e-9 * path.length and not path.is_fine(a, b):
                again.append(0.5 * (a + b))
            elif b - a <= 1e-9 * path.length:
                points.append(_unexplained(path, a, b))
                explained.append((a, b))
            else:
                values += np.linspace(a, b, 3 if is_narrow else 9).tolist()
        path.find_labels(values)
        for value in again:
            path.find_labels_finely(value, NEAR * path.length)
    return by_value(points)


def calls_ahead(path: ParameterPath) -> Iterator[Callable[[], Any]]:
    """Calls that compile the programs that nearly every path needs: those for the belts' velocities
    that coincide or vanish on this path, for Hopf points, and for cycles that begin to stick."""
    belts = len(path.at(path.first).belts)
    loop, value = blank_loop(ROOM, belts), path.inside(path.first)
    ahead: list[tuple[AbstractCondition, float]] = []
    for at in path.breaks:
        for pair in path.coinciding(at):
            likely = (one for kind in LOOKED_FOR for one in kind.at_coincidence(pair))
            ahead += [(one, at) for one in islice(likely, 1)]
    ahead += [(Hopf(), value), (GrazingSliding(0), value)]
    for condition, at in ahead:
        is_of_cycle = isinstance(condition, AbstractCycleCondition)
        beginning = loop if is_of_cycle else ANY if isinstance(condition, Hopf) else None
        yield functools.partial(condition.point_from, path.variation, at, beginning)


def _left(path: ParameterPath, intervals: Sequence[tuple[float, float]]) -> list[BifurcationPoint]:
    """Points for the intervals that were not looked into; warns of them."""
    unit = 1.0 if path.variation.units is None else float(path.variation.own.parameters[0])
    where = ", ".join(f"{number(a * unit)} to {number(b * unit)}" for a, b in intervals)
    warnings.warn(
        f"the search was left after {path.attempts} attempts of Newton's method; something changes "
        f"that was not looked into in {where}: see the points with the status INCOMPLETE, or ask "
        "of a shorter span",
        stacklevel=4,
    )
    middles = [(0.5 * (a + b), 0.5 * (b - a)) for a, b in intervals]
    return [_unsolved_point(path, *one, why=Status.INCOMPLETE) for one in middles]


def is_at_one_value(point: BifurcationPoint, other: BifurcationPoint) -> bool:
    """Whether the values of two points are the same, within their errors."""
    error = float(point.error) + float(other.error)
    return abs(float(point.value) - float(other.value)) <= error


def _is_same_point(point: BifurcationPoint, other: BifurcationPoint) -> bool:
    """Whether two points have the same condition, value, and cycle or equilibrium."""
    if point.condition != other.condition or not is_at_one_value(point, other):
        return False
    if int(point.cycle.status) != Status.OK:
        return not _is_another(point, other)
    return is_same(point.cycle, other.cycle)


def more_exact(point: BifurcationPoint, variation: Variation) -> BifurcationPoint:
    """The point, solved again from guesses on both sides of it where that is more exact.

    The integration steps suit the motion at the guess. And from afar Newton's method may end at a
    double root where an arc vanishes; from the other side of the point there is no such root.
    """
    if int(point.status) != Status.OK:
        return point
    value = float(point.value)
    unit = float(variation.family(np.array([value])).unit)
    for shift in (-BESIDE_IT, BESIDE_IT):
        if not float(point.error) > unit * EXACT:
            break
        try:
            variation.check(value + shift * unit)
        except ValueError:
            continue  # there is no oscillator on that side
        again = point.condition.named_point_from(variation, value + shift * unit)
        if again is not None and point.condition.covers(again) and is_at_one_value(point, again):
            again = replace(again, condition=point.condition)
            point = min(point, again, key=lambda one: float(one.error))
    return point


def by_value(points: Sequence[BifurcationPoint]) -> tuple[BifurcationPoint, ...]:
    """The points in order of their values."""
    return tuple(sorted(points, key=lambda point: float(point.value)))


def edges_touched(
    path: ParameterPath, values: np.ndarray, around: int
) -> tuple[BifurcationPoint, ...]:
    """Points where the unstable cycle begins or ceases to pass a contact edge.

    values: increasing, without other bifurcations between them; those at which no unstable cycle is
    found are skipped. around: number of the equilibrium, see `unstable_cycle`.
    """
    if not path.edged:
        return ()
    path.unstable_along(values, around)

    def unstable(value):
        return path.unstable(value, around)

    def found_at(*values):
        return all(one.status == Status.OK for one in path.unstable_along(values, around))

    def modes(value):
        return itinerary(path.idle(value), unstable(value))

    def changes(values):
        known = [v for v in map(float, values) if unstable(v).status == Status.OK]
        return [(a, b) for a, b in pairwise(known) if a < b and modes(a) != modes(b)]

    points, intervals = [], changes(values)
    while intervals:
        if path.attempts > MOST_ATTEMPTS:
            points += _left(path, intervals)
            break
        a, b = intervals.pop()
        solved = (
            condition.named_point_from(path.variation, value, loop)
            for value in (a, b)
            for loop in [as_loop(unstable(value), ROOM)]
            for kind in LOOKED_FOR
            for condition in kind.of_unstable_cycles(path.edged)
        )
        path.attempts += 1
        points_inside = (point for point in solved if point is not None and a < point.value < b)
        point = next(points_inside, None)
        middle = 0.5 * (a + b)
        if point is not None:
            points.append(point)
            path.unstable_cycles[float(point.value), around] = point.cycle
            before, after = path.beside(float(point.value))
            intervals += changes([a, max(a, before)]) + changes([min(b, after), b])
        elif b - a > 1e-9 * path.length and found_at(a, middle, b):
            intervals += changes([a, middle, b])
        else:
            points.append(_unsolved_point(path, middle, b - a))
    return by_value(points)


# --- what causes the difference between two values ------------------------------------------------


def _explained_range(
    path: ParameterPath, a: float, b: float, point: BifurcationPoint
) -> tuple[float, float]:
    """The range around a point in which it explains differences; it explains that of a and b.

    A slow point may lie just outside of the interval from a to b. Then it explains the half of the
    interval next to it, or all of a narrow interval: labels so near to it are not reliable.
    """
    value = float(point.value)
    before, after = path.beside(value, slow=point.condition.is_slow_at(point))
    is_narrow, middle = b - a <= after - before, 0.5 * (a + b)
    if value > b:
        before = min(before, a if is_narrow else middle)
    elif value < a:
        after = max(after, b if is_narrow else middle)
    return before, after


def _inner_and_margins(
    path: ParameterPath, value: float, before: float, after: float
) -> tuple[tuple[float, float], list[tuple[float, float]]]:
    """The part of the range around a point that it explains in any case, and the rest of the range,
    as far as it is in the span.

    In the rest labels may be wrong, as motions converge slowly. What differs there is searched, as
    another point may be there; only what leads to none is explained by the first point.
    """
    first, last = path.inside(path.first), path.inside(path.last)
    low, high = value - path.closest, value + path.closest
    inner = low if first < low else before, high if high < last else after
    margins = (max(before, first), low), (high, min(after, last))
    return inner, [(a, b) for a, b in margins if a < b]


def _accepts(
    path: ParameterPath, a: float, b: float, point: BifurcationPoint, *, only_inside: bool
) -> bool:
    """Whether to accept the point for this interval.

    A point just outside is not accepted as long as the interval can be narrowed: another point may
    be inside. only_inside: nor then, as that point is known.
    """
    is_narrow = b - a <= 2 * path.closest and not only_inside
    return is_narrow or _is_inside(a, b, point)


def _is_inside(a: float, b: float, point: BifurcationPoint) -> bool:
    """Whether a point is in an interval, within its error.

    A point at an end of the interval lies inside of it or outside by rounding only.
    """
    value, error = float(point.value), float(point.error)
    return a - error <= value <= b + error


def _explained(path: ParameterPath, a: float, b: float) -> BifurcationPoint | None:
    """A bifurcation point between two values with different motions, or None."""
    marks = zip(path.conditions, path.label(a).marks, path.label(b).marks, strict=True)
    own = [condition for condition, mark, other in marks if mark != other]
    return _first_found(path, a, b, [*own, *_possible_kinds(path, a, b)])


def _possible_kinds(path: ParameterPath, a: float, b: float) -> list[AbstractCondition]:
    """Conditions that could cause the difference between the labels of two values."""
    labels = path.label(a), path.label(b)
    return [condition for kind in LOOKED_FOR for condition in kind.between(*labels, path.edged)]


def _beside_it(
    path: ParameterPath, a: float, b: float, point: BifurcationPoint
) -> list[BifurcationPoint]:
    """Other points at the value of a point: of the same kind for other belts, or other motions, as
    several coincide where there is a symmetry; and what makes a state of rest begin or cease to be,
    which a change of its stability does not."""
    sought = point.condition.sought
    found = [point]
    ceases = len(path.label(a).equilibria) != len(path.label(b).equilibria)
    for condition in _possible_kinds(path, a, b):
        is_of_rest = ceases and isinstance(condition, AbstractRestCondition)
        if is_of_rest or type(condition.sought) is type(sought):
            for one in _all_found(path, a, b, condition):
                if is_at_one_value(one, point) and all(_is_apart(one, other) for other in found):
                    found.append(one)
    return found[1:]


def _is_apart(point: BifurcationPoint, other: BifurcationPoint) -> bool:
    """Whether two points at one value differ in their condition, belts or motion."""
    return point.condition.sought != other.condition.sought or _is_another(point, other)


def _is_another(point: BifurcationPoint, other: BifurcationPoint) -> bool:
    """Whether two points at one value have different cycles, or different equilibria."""
    if all(int(one.cycle.status) == Status.OK for one in (point, other)):
        return bool(distance(place_of(point.cycle), place_of(other.cycle)) >= SAME_CYCLE)
    places = ([float(one.x1), 0.0] for one in (point, other))
    return bool(distance(*places, least=1.0) > SAME_CYCLE)


def _first_found(
    path: ParameterPath, a: float, b: float, conditions: Sequence[AbstractCondition]
) -> BifurcationPoint | None:
    """The first point found within an interval, else the first one found just outside, or None."""
    outside = None
    for condition in conditions:
        for point in _all_found(path, a, b, condition):
            if _is_inside(a, b, point):
                return point
            outside = outside or point
    return outside


def _all_found(
    path: ParameterPath, a: float, b: float, condition: AbstractCondition
) -> Iterator[BifurcationPoint]:
    """Points where a condition holds within an interval, solved for from each of its beginnings.

    Points of a slow condition may lie just outside. Several beginnings may give the same point.
    """
    slow = condition.slow
    low, high = (path.beside(a, slow=True)[0], path.beside(b, slow=True)[1]) if slow else (a, b)
    for value in condition.values(a, b):
        for one in condition.beginnings(path.at(value), path.cycles.get(value, [])):
            path.attempts += 1
            point = condition.named_point_from(path.variation, value, one)
            if point is not None and _is_inside(low, high, point):
                yield point


def _at_break(path: ParameterPath, value: float) -> list[BifurcationPoint]:
    """Points where the varied belt is at rest or has the velocity of another one, or edges meet."""
    interval = path.beside(value)
    path.find_labels(interval)
    labels = [path.label(side) for side in interval]
    found = []
    for belts in path.coinciding(value):
        conditions = [condition for kind in LOOKED_FOR for condition in kind.at_coincidence(belts)]
        found.append(_first_found(path, *interval, conditions))
    # Where more than two edges meet, one pair of each kind is reported.
    for kind in LOOKED_FOR:
        conditions = [
            condition
            for belts in path.meeting(value)
            for condition in kind.at_meeting(belts, *labels)
        ]
        found.append(_first_found(path, *interval, conditions))
    points = [point for point in found if point is not None]
    if not points and not labels[0].is_as(labels[1]):
        # A bifurcation of another kind may happen at exactly this value.
        point = _explained(path, *interval)
        unknown = replace(
            _unexplained(path, *interval), value=jnp.asarray(value), error=jnp.zeros(())
        )
        points = [point or unknown]
    return points


# --- what Newton's method does not find -----------------------------------------------------------


def _is_degenerate(path: ParameterPath, a: float, b: float, points: list[BifurcationPoint]) -> bool:
    """Whether a condition that could cause the difference holds all along the interval.

    If so, rounding decides on which side of it the labels are. A point in the middle of the range
    where the condition holds is added to `points`, once.
    """
    for condition in _possible_kinds(path, a, b):
        if all(_holds_along(path, value, condition) for value in (a, b)):
            break
    else:
        return False
    for point in points:
        if int(point.status) == Status.DEGENERATE and point.condition == condition:
            if abs(float(point.value) - 0.5 * (a + b)) <= float(point.error):
                return True
    looked_at = sorted(path.labels)
    sides = [v for v in looked_at if v <= a][::-1], [v for v in looked_at if v >= b]
    low, high = (_last_along(path, values, condition) for values in sides)
    middle, width = 0.5 * (low + high), 0.5 * (high - low)
    points.append(_unsolved_point(path, middle, width, condition, Status.DEGENERATE))
    return True


def _last_along(
    path: ParameterPath, values: Sequence[float], condition: AbstractCondition
) -> float:
    """The last of the values up to which, from the first one on, a condition holds all along."""
    along = takewhile(lambda value: _holds_along(path, value, condition), values)
    return list(along)[-1]


def _holds_along(path: ParameterPath, value: float, condition: AbstractCondition) -> bool:
    """Whether a condition holds at a value and all along the path beside it (DEGENERATE)."""
    beginnings = condition.beginnings(path.at(value), path.cycles[value])
    points = (condition.point_from(path.variation, value, one) for one in beginnings)
    return any(int(point.status) == Status.DEGENERATE for point in points)


def _unexplained(path: ParameterPath, a: float, b: float) -> BifurcationPoint:
    """An unexplained point between two close values, with the motions below and above it."""
    # As far off as `beside` is: nearer to the point it may be impossible to solve for a cycle.
    before, after = path.beside(0.5 * (a + b))
    ends = max(before, path.inside(path.first)), min(after, path.inside(path.last))
    path.find_labels(ends)
    oscs = path.at(ends[0]), path.at(ends[1])
    cycles = path.cycles[ends[0]], path.cycles[ends[1]]
    return replace(_unsolved_point(path, 0.5 * (a + b), b - a), sides=sides_of(ends, oscs, cycles))


def _unsolved_point(
    path: ParameterPath,
    value: float,
    width: float,
    condition: AbstractCondition = UNNAMED,
    why: Status = Status.UNEXPLAINED,
) -> BifurcationPoint:
    """A point of a change that is not solved for; width: its error; why: its status."""
    p, none = np.array([value]), jnp.asarray(jnp.nan)
    ok, steps = jnp.asarray(Status.OK.value), jnp.full(NEWTON_STEPS, jnp.nan)
    status, family = jnp.asarray(why.value), path.variation.family(p)
    error = jnp.asarray(width)
    point = point_without_cycle(family, jnp.asarray(p), steps, none, error, ok, status)
    return replace(point, condition=condition, status=status)
