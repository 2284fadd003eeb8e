"""Bifurcation points along a path in one parameter, found without a guess: `scan`.

What the oscillator does at one value of the parameter is summed up in a label: the kind and the
stability of every equilibrium, and the itinerary of every attracting cycle, that is, the modes that
it passes in one loop, see `attractors`. A
cycle that sticks comes by a place where a stick phase ends, in slip onset or on a contact edge, so
it is found by following the orbits from there; a few starts beside the equilibria find the rest.

Between two values with one label nothing is taken to happen, if each cycle at one of them goes on
to one at the other. One that sticks does so if they have one itinerary. Of those that do not stick
several may have it: each is followed to where its derivative by the parameter leads. Where labels
differ, or cycles do not go on, the interval is
narrowed until Newton's method converges from its ends. The conditions that could make this
difference are refined from there, and what is found inside the interval is a bifurcation point. The
same is then asked of what is left of the interval on either side, so that points are found that lie
closer together than the first values did. A difference that no condition explains is narrowed as
far as numbers go, and reported. Values are looked at in batches by one compiled program.

Labels know what attracts. Where contact edges are touched by the unstable cycle that a diagram
shows is found in the same way from its signature, see `edges_touched`.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks import as_array, check_finite, require
from ..cycles.attractors import (
    SOLVED,
    Itinerary,
    apart,
    is_same,
    itinerary,
    place_of,
    sticks,
    without_idle,
)
from ..cycles.cycle import Cycle, as_loop, find_cycle, polish, unstable_cycle
from ..cycles.settling import AT_REST
from ..cycles.shooting import SIZES, Loop, cut
from ..model.equilibria import EquilibriumKind, equilibria
from ..model.events import events_of
from ..model.oscillator import Oscillator, check_oscillator
from ..model.parameters import leaf_index, names_of, vary
from ..numerics.compiling import each, jit
from ..results import EventKind, Status
from .refine import (
    AbstractCondition,
    BeltAtRest,
    BifurcationPoint,
    BoundaryEquilibrium,
    CornerCollision,
    CrossingSliding,
    FoldOfCycles,
    GrazingEdge,
    GrazingSliding,
    Hopf,
    NonsmoothFold,
    PseudoHopf,
    SlidingExchange,
    SuddenSliding,
    at_crossing,
    at_edge,
    at_edge_unstable,
    at_exchange,
    at_fold_of_cycles,
    at_tangency,
    crossing_near,
    edge_contact,
    end_near_edge,
    exchange_near,
    fold_near,
    room_for,
    settled_loops,
    solver_of,
    tangency_near,
    unexplained_point,
)

#: Values of the parameter in one batch.
BATCH = 32
#: Room for the arcs of one loop.
ROOM = SIZES[1]
#: Intervals narrower than this fraction of the span are good guesses for Newton's method.
NEAR = 1 / 400
#: Nothing closer than this, and this fraction of the span, is told apart.
CLOSE = 1e-6
#: The fraction of a step along the path by which the derivative of a cycle is taken.
DIFFERENCE = 1e-3
#: A cycle is where it is expected if it is no further from there, relative to its size, or than
#: a third of the way that it is expected to go. Nearer to a square root, intervals get smaller.
EXPECTED = 1e-3


def scan(
    osc: Oscillator,
    where: Callable[[Oscillator], Any],
    span: tuple[float, float],
    *,
    resolution: int = 96,
) -> tuple[BifurcationPoint, ...]:
    """Every bifurcation point along a path in one parameter, in order, each as from `refine`.

    osc: the oscillator; where: selects the parameter, such as `lambda osc: osc.belts[0].velocity`;
    span: its first and last value, dimensionless like itself; resolution: how many intervals are
    looked at first. Points of which one undoes what the other did are seen if one of these values
    lies between them.

    Each point has `kind`, `value`, and the rest of a `BifurcationPoint`. What happens at contact
    edges is looked for where there are any; where an unstable cycle touches them only
    `bifurcation_diagram` says, as what attracts stays the same. Where something changes and no
    condition explains it, there is a point of kind `Unexplained`, with the status UNEXPLAINED and
    the value where it happens, good to about 1e-9 of the span. `ValueError` names an impossible
    argument.
    """
    return search(Path(osc, where, span), resolution)


def search(path: "Path", resolution: int = 96) -> tuple[BifurcationPoint, ...]:
    """Every bifurcation point on a path, in order; its labels are kept with it."""
    points = [point for at in path.breaks for point in _at_break(path, at)]
    ends = [path.first, *(v for at in path.breaks for v in path.beside(at)), path.last]
    width = (path.last - path.first) / resolution
    stretches = []
    for a, b in zip(ends[::2], ends[1::2], strict=True):
        if b > a:
            stretches.append(np.linspace(a, b, 1 + max(1, round((b - a) / width))))
    path.look(np.concatenate(stretches))
    settled = [path.beside(at) for at in path.breaks]
    while intervals := path.changes(settled):
        found = _explain(path, [(a, b) for a, b in intervals if b - a <= NEAR * path.length])
        values: list[float] = []
        for a, b in intervals:
            point = found.get((a, b))
            if point is not None:
                # The interval on the other side of a fold may have led to it already.
                if not any(_is_same_point(point, other) for other in points):
                    points.append(point)
                slow = isinstance(point.condition, FoldOfCycles)
                before, after = path.beside(float(point.value), slow=slow)
                settled.append((before, after))
                values += [max(a, before), min(b, after)]
            elif b - a <= 1e-9 * path.length:
                points.append(unexplained_point(path.osc, int(path.index), 0.5 * (a + b), b - a))
                settled.append((a, b))
            else:
                values += np.linspace(a, b, 3 if b - a <= NEAR * path.length else 9).tolist()
        path.look(values)
    return by_value(points)


def _is_same_point(point: BifurcationPoint, other: BifurcationPoint) -> bool:
    """Whether two points are of one condition, at one value, and of one cycle."""
    at, error = float(point.value), float(point.error) + float(other.error)
    if point.condition != other.condition or not abs(at - float(other.value)) <= error:
        return False
    is_rest = int(point.cycle.status) != Status.OK
    return is_rest or is_same(point.cycle, other.cycle)


def by_value(points: Sequence[BifurcationPoint]) -> tuple[BifurcationPoint, ...]:
    """The points in order."""
    return tuple(sorted(points, key=lambda point: float(point.value)))


def edges_touched(path: "Path", values: np.ndarray, around: int) -> tuple[BifurcationPoint, ...]:
    """Where the unstable cycle begins or ceases to pass a contact edge.

    values: in order, in a stretch in which nothing else happens. Those at which no such cycle is
    found are passed over. around: the number of the equilibrium, see `unstable_cycle`.
    """

    def unstable(value):
        return path.unstable(value, around)

    def modes(value):
        return itinerary(path.osc, unstable(value).chain)

    def changes(values):
        known = [v for v in map(float, values) if unstable(v).status == Status.OK]
        return [(a, b) for a, b in pairwise(known) if a < b and modes(a) != modes(b)]

    points, intervals = [], changes(values) if path.edged else []
    while intervals:
        a, b = intervals.pop()
        solved = (
            refined(path.osc, path.index, value, GrazingEdge(belt, unstable=True), loop)
            for value in (a, b)
            for loop in [as_loop(unstable(value), ROOM)]
            for belt in path.edged
        )
        points_inside = (point for point in solved if point is not None and a < point.value < b)
        point = next(points_inside, None)
        middle = 0.5 * (a + b)
        if point is not None:
            points.append(point)
            path.unstable_cycles[float(point.value), around] = point.cycle
            before, after = path.beside(float(point.value))
            intervals += changes([a, max(a, before)]) + changes([min(b, after), b])
        elif unstable(middle).status == Status.OK and b - a > 1e-9 * path.length:
            intervals += changes([a, middle, b])
        else:
            points.append(unexplained_point(path.osc, int(path.index), middle, b - a))
    return by_value(points)


# --- what the oscillator does at one value --------------------------------------------------------


class Label(NamedTuple):
    """What there is at one value: (kind, stable, contact codes) of the equilibria from left to
    right, and the itineraries of the attracting cycles in order."""

    equilibria: tuple[tuple[int, bool, tuple[int, ...]], ...]
    cycles: tuple[Itinerary, ...]

    def events(self, kind: EventKind) -> Counter[int]:
        """How often there is an event of a kind in the cycles, by its belt."""
        return Counter(belt for path in self.cycles for one, belt in events_of(path) if one == kind)

    @property
    def foci(self) -> int:
        """How many equilibria attract, but for segments."""
        return sum(
            stable and kind != EquilibriumKind.SEGMENT for kind, stable, _ in self.equilibria
        )

    @property
    def smooth(self) -> int:
        """How many cycles stick to no belt."""
        return sum(not sticks(path) for path in self.cycles)


class Found(NamedTuple):
    """An attracting cycle: its itinerary, and a loop of it, with ROOM arcs.

    The loop of one that does not stick solves the equations of the cycle, but where `approach` did
    not tell where the orbit settles.
    """

    path: Itinerary
    loop: Loop


class Path:
    """A path in one parameter: its labels, each computed once, and loops of the cycles in them."""

    def __init__(self, osc, where, span):
        check_oscillator(osc)
        span = as_array(span, "span", (2,))
        check_finite(span, "span")
        self.first, self.last = (float(end) for end in span)
        require(self.first < self.last, "span", "(first, last) with first < last", tuple(span))
        # As an array: one program serves all parameters.
        self.osc, self.index = osc, jnp.asarray(np.array(leaf_index(osc, where)))
        for value in (self.first, self.last):
            self.at(value).check()
        self.length = self.last - self.first
        self.name = names_of(osc)[int(self.index)]
        self.labels: dict[float, Label] = {}
        self.cycles: dict[float, list[Found]] = {}
        self.unstable_cycles: dict[tuple[float, int], Cycle] = {}
        # From which value to which other one, from which cycle to which, of those that do not
        # stick; None where there is none.
        self._goes_on: dict[tuple[float, float], dict[int, int | None]] = {}
        self.breaks = self._coincidences()

    def at(self, value: float) -> Oscillator:
        """The oscillator there."""
        # Of one type, whichever that of the value: else programs are compiled twice.
        return vary(self.osc, self.index, jnp.asarray(np.array([value])))

    def unstable(self, value: float, around: int) -> Cycle:
        """The unstable cycle there around an equilibrium, or why there is none; computed once."""
        if (value, around) not in self.unstable_cycles:
            self.unstable_cycles[value, around] = unstable_cycle(self.at(value), around=around)
        return self.unstable_cycles[value, around]

    def beside(self, value: float, *, slow: bool = False) -> tuple[float, float]:
        """The values just below and just above; farther off where motions are slow to settle."""
        # Not nearer in a short span: a loop counts as repeated when it does so to 1e-7.
        distance = CLOSE * (1.0 + self.length)
        # Loops around a pseudo-focus with a velocity below 1e-5 are lost in rounding.
        if slow or (value in self.breaks and self.edged):
            distance *= 30.0
        return value - distance, value + distance

    @property
    def belt(self) -> int:
        """The belt whose velocity is varied, or -1."""
        for belt in range(len(self.osc.belts)):
            if leaf_index(self.osc, lambda osc, belt=belt: osc.belts[belt].velocity) == self.index:
                return belt
        return -1

    @property
    def edged(self) -> list[int]:
        """Belts with a finite contact edge; one for each place if they share their edges."""
        belts: list[int] = []
        known: set[float] = set()
        for number, belt in enumerate(self.at(0.5 * (self.first + self.last)).belts):
            own = {float(edge) for edge in (belt.lower, belt.upper) if np.isfinite(edge)}
            if own - known:
                belts.append(number)
            known |= own
        return belts

    def _coincidences(self) -> list[float]:
        """Where the belt that is varied is at rest, or runs with another one."""
        if self.belt < 0:
            return []
        others = [float(b.velocity) for i, b in enumerate(self.osc.belts) if i != self.belt]
        inside = [v for v in {0.0, *others} if self.first <= v <= self.last]
        return sorted(inside)

    def look(self, values: Sequence[float] | np.ndarray) -> None:
        """Find the labels there, in batches."""
        new = np.array(sorted({float(v) for v in values} - self.labels.keys()))
        for batch in (new[i : i + BATCH] for i in range(0, new.size, BATCH)):
            filled = np.concatenate([batch, np.full(BATCH - batch.size, np.nan)])
            seen = jax.tree.map(np.asarray, _look(self.osc, self.index, jnp.asarray(filled)))
            for lane, value in enumerate(batch.tolist()):
                self._take(value, jax.tree.map(lambda x, i=lane: x[i], seen))
        self._share()

    def changes(self, settled: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        """The intervals between values looked at that differ, but for those that are settled."""
        return [
            (a, b)
            for a, b in pairwise(sorted(self.labels))
            if not any(low <= a and b <= high for low, high in settled)
            and not (self.labels[a] == self.labels[b] and self._all_go_on(a, b))
        ]

    def _take(self, value: float, seen: "_Seen") -> None:
        """Label a value by what was seen there."""
        exists = seen.kind > 0
        modes = map(tuple, without_idle(self.at(value), seen.modes[exists]).tolist())
        rests = tuple(
            zip(seen.kind[exists].tolist(), seen.stable[exists].tolist(), modes, strict=True)
        )
        found: list[Found] = []
        loops = [jax.tree.map(lambda x, i=i: x[i], seen.loop) for i in range(len(seen.status))]
        for loop, status in zip(loops, seen.status.tolist(), strict=True):
            one = self._settled(value, loop) if status == Status.OK else None
            if one is not None and _number(one, found) is None:
                found.append(one)
        if not found and not any(stable for _, stable, _ in rests):
            # Nothing holds the orbits but a cycle that they approach slowly.
            found.append(self._settled(value, loops[-1], closes=False) or Found((), loops[-1]))
        self.cycles[value] = found
        self._name(value, rests)

    def _name(self, value: float, rests) -> None:
        self.labels[value] = Label(rests, tuple(sorted(one.path for one in self.cycles[value])))

    def _settled(self, value: float, loop: Loop, *, closes: bool = True) -> Found | None:
        """The attracting cycle that a loop is nearly one of, or else leads to, or None.

        A loop that sticks is one of it. Any other may only seem to repeat. closes: whether it is
        known to be one loop.
        """
        osc, ok = self.at(value), jnp.asarray(Status.OK.value)
        if closes and sticks(path := itinerary(osc, loop)):
            return Found(path, loop)
        # Where the cycle has other loops than those from which it is solved for, or meets a
        # boundary, it is followed.
        ways = (lambda: polish(osc, cut([loop])[0], ok), lambda: find_cycle(osc, loop.entries[0]))
        for cycle in (way() for way in ways[0 if closes else 1 :]):
            if int(cycle.status) == Status.OK and abs(float(cycle.multiplier)) < 1:
                # Not the equilibrium, to which a cycle may shrink.
                if np.ptp(np.asarray(cycle.unknowns)[:, 0]) > AT_REST:
                    loop = jax.tree.map(np.asarray, as_loop(cycle, ROOM))
                    return Found(itinerary(osc, loop), loop)
        return None

    def _share(self) -> None:
        """Let values know cycles that attract at the ones beside them.

        A cycle that sticks is always reached, from where that ends. One that does not may be
        missed.
        """
        values = sorted(self.labels)
        for pairs in (pairwise(values), pairwise(values[::-1])):
            for a, b in pairs:
                known, come = self._goes_on.setdefault((a, b), {}), self._goes_on.get((b, a), {})
                known |= {i: j for j, i in come.items() if i is not None}
                for i, one in enumerate(self.cycles[a]):
                    if i not in known and one.path and not sticks(one.path):
                        known[i] = self._followed(a, b, i)

    def _all_go_on(self, a: float, b: float) -> bool:
        """Whether the cycles at one value that do not stick go on to those at another, one each."""
        ahead = self._goes_on[a, b] | {
            i: j for j, i in self._goes_on[b, a].items() if i is not None
        }
        reached = [j for j in ahead.values() if j is not None]
        smooth = [i for i, one in enumerate(self.cycles[a]) if one.path and not sticks(one.path)]
        return len(set(reached)) == len(smooth) and all(ahead.get(i) is not None for i in smooth)

    def _followed(self, known: float, value: float, number: int) -> int | None:
        """The number of the cycle at one value to which one at another value goes on, or None.

        It is looked for where that is expected to be, by its derivative.
        """
        path, loop = self.cycles[known][number]
        step = value - known
        nearby = self._settled(known + DIFFERENCE * step, loop)
        expected = loop
        if nearby is not None and nearby.path == path and _fits(nearby.loop, loop):
            parts = ((t.entries, t.durations) for t in (loop, nearby.loop))
            moved = [a + (b - a) / DIFFERENCE for a, b in zip(*parts, strict=True)]
            expected = eqx.tree_at(lambda t: (t.entries, t.durations), loop, tuple(moved))
        found = self._settled(value, expected)
        if found is None or found.path != path:
            return None
        places = [place_of(one) for one in (loop, expected, found.loop)]
        if apart(places[1], places[2]) > EXPECTED * (1 + 300 * apart(places[0], places[1])):
            return None
        at = _number(found, self.cycles[value])
        if at is None:
            others = self.cycles[value]
            # In place of one that was only taken to be there.
            at = 0 if others and not others[0].path else len(others)
            others[at : at + 1] = [found]
            self._name(value, self.labels[value].equilibria)
        return at

    def followed(self, values: Sequence[float]) -> list[dict[float, Loop]]:
        """The attracting cycles at these values, in order, in which nothing else happens.

        Of each that goes on from value to value its loops, by the value.
        """
        strands: list[dict[float, Loop]] = []
        sticking: dict[Itinerary, dict[float, Loop]] = {}
        before, smooth = None, {}
        for value in sorted(v for v in self.labels if values[0] <= v <= values[-1]):
            here = {}
            for number, one in enumerate(self.cycles[value]):
                origin = self._origin(before, value, number)
                known = sticking.get(one.path) if sticks(one.path) else smooth.get(origin)
                strand: dict[float, Loop] = {} if known is None else known
                if known is None:
                    strands.append(strand)
                here[number] = strand
                if sticks(one.path):
                    sticking[one.path] = strand
                if value in values:
                    strand[value] = one.loop
            before, smooth = value, here
        return [strand for strand in strands if strand]

    def _origin(self, before: float | None, value: float, number: int) -> int | None:
        """The number of the cycle at the value before that goes on to one that does not stick."""
        if before is None:
            return None
        back = self._goes_on[value, before].get(number)
        ahead = self._goes_on[before, value].items()
        return back if back is not None else next((i for i, j in ahead if j == number), None)

    def label(self, value: float) -> Label:
        """The label there, which `look` has found."""
        return self.labels[float(value)]


def _number(cycle: Found, among: Sequence[Found]) -> int | None:
    """The number of a cycle among others, or None."""
    for number, other in enumerate(among):
        if other.path == cycle.path:
            if sticks(cycle.path) or apart(place_of(cycle.loop), place_of(other.loop)) < SOLVED:
                return number
    return None


def _fits(loop: Loop, other: Loop) -> bool:
    """Whether two loops have the same arcs in the same order."""
    return np.array_equal(loop.codes, other.codes) and np.array_equal(loop.ends, other.ends)


class _Seen(NamedTuple):
    """Equilibria, [rows], and of every orbit its status and last loop, [starts, ROOM]."""

    kind: Any
    stable: Any
    modes: Any
    status: Any
    loop: Any


@jit
def _look(osc: Oscillator, index: Array, values: Array) -> _Seen:
    return each(lambda p: _look_at(vary(osc, index, p[None])))(values)


def _look_at(osc: Oscillator) -> _Seen:
    rests = equilibria(osc)
    loop, status = settled_loops(osc, rests, ROOM)
    return _Seen(rests.kind, rests.stable, rests.modes, status, loop)


# --- what makes the difference between two values -------------------------------------------------


def _explain(path: Path, intervals) -> dict[tuple[float, float], BifurcationPoint | None]:
    """For every interval a bifurcation point inside it, or None."""
    found: dict[tuple[float, float], BifurcationPoint | None] = dict.fromkeys(intervals)
    # A fold is looked for last: most intervals in which smooth cycles come or go have another
    # point, and its program takes longest to compile.
    for conditions_of in (_local_conditions, _edge_conditions, _fold_conditions):
        for a, b in intervals:
            if found[a, b] is None:
                conditions = conditions_of(path, path.label(a), path.label(b))
                found[a, b] = _explained(path, a, b, conditions)
    return found


def _explained(path: Path, a: float, b: float, conditions) -> BifurcationPoint | None:
    """The first of the conditions that holds within an interval."""
    for condition in conditions:
        low, high = a, b
        if isinstance(condition, FoldOfCycles):
            # Beyond a fold orbits pass the place of the cycles slowly, as if they were there.
            low, high = path.beside(a, slow=True)[0], path.beside(b, slow=True)[1]
        for value in (a, b):
            for loop in _loops(path, value, condition):
                point = refined(path.osc, path.index, value, condition, loop)
                if point is not None and low <= point.value <= high:
                    return point
    return None


def _loops(path: Path, value: float, condition: AbstractCondition) -> Sequence[Loop | None]:
    """Those of the attracting cycles there, for what needs one; None for what finds its own."""
    cycles, solve = path.cycles[value], solver_of(condition)
    loops = [one.loop for one in cycles if not sticks(one.path) or solve is not at_fold_of_cycles]
    if solve is at_tangency:
        return [None, *loops]
    if solve is at_fold_of_cycles:
        return [*loops, None]
    return loops if solve in (at_edge, at_exchange, at_crossing) else [None]


def _local_conditions(path: Path, before: Label, after: Label) -> list[AbstractCondition]:
    conditions: list[AbstractCondition] = []
    if before.equilibria != after.equilibria:
        conditions.append(Hopf())
    # Whether a tangency is a fold or grazing is seen when it is found.
    for event, kind in ((EventKind.STICK, GrazingSliding), (EventKind.CROSS, CrossingSliding)):
        one, other = before.events(event), after.events(event)
        conditions += [kind(belt) for belt in (one - other) + (other - one)]
    return conditions


def _edge_conditions(path: Path, before: Label, after: Label) -> list[AbstractCondition]:
    conditions: list[AbstractCondition] = []
    if before.equilibria != after.equilibria:
        kinds = (BoundaryEquilibrium, PseudoHopf)
        conditions += [kind(belt) for kind in kinds for belt in path.edged]
    if before.cycles != after.cycles:
        # Whether an end of an arc on an edge is a loop or a corner is seen when it is found.
        conditions += [GrazingEdge(belt) for belt in path.edged]
    return conditions


def _fold_conditions(path: Path, before: Label, after: Label) -> list[AbstractCondition]:
    return [FoldOfCycles()] if before.smooth != after.smooth else []


def _at_break(path: Path, value: float) -> list[BifurcationPoint]:
    """The points where the varied belt is at rest or runs with another one."""
    belt, interval = path.belt, path.beside(value)
    path.look(interval)
    found: list[BifurcationPoint | None] = []
    for other, its in enumerate(path.osc.belts):
        if other != belt and float(its.velocity) == value:
            pair = SlidingExchange((min(belt, other), max(belt, other)))
            found.append(_explained(path, *interval, [pair]))
    if value == 0:
        rests = (refined(path.osc, path.index, at, BeltAtRest(belt)) for at in interval)
        sudden = sudden_sliding(path.osc, path.index, belt)
        found += [sudden] if sudden else [next(filter(None, rests), None)]
    points = [point for point in found if point is not None]
    if not points and path.label(interval[0]) != path.label(interval[1]):
        # Something else may happen just there.
        point = _explain(path, [interval])[interval]
        points = [point or unexplained_point(path.osc, int(path.index), value, 0.0)]
    return points


def sudden_sliding(osc: Oscillator, index: Array, belt: int) -> BifurcationPoint | None:
    """Sudden sliding where a belt is at rest, whose velocity has that number, or None."""
    # Orbits that settle soon first; other points may be nearer than where they do.
    beside = (1e-2, -1e-2, 1e-4, -1e-4)
    found = (refined(osc, index, at, SuddenSliding(belt)) for at in beside)
    return next(filter(None, found), None)


def refined(
    osc: Oscillator,
    index: Array,
    value: float,
    condition: AbstractCondition,
    loop: Loop | None = None,
) -> BifurcationPoint | None:
    """The point that is found from that value of the parameter, or None.

    A tangency, or an end of an arc on an edge, of whichever kind it is looked for, is returned as
    what it is. loop: of the cycle that may touch an edge or fold, where it is known, with ROOM
    arcs.
    """
    p, belts, either = (jnp.asarray(np.array(x)) for x in ([value], _belts(condition), 0.0))
    at, known = vary(osc, index, p), jnp.asarray(Status.OK.value)
    if loop is None:
        solve = solver_of(condition)
        point = solve(at, index, belts, either, room_for(solve))
    elif isinstance(condition, FoldOfCycles):
        point = fold_near(at, index, cut([loop])[0], known)
    elif isinstance(condition, NonsmoothFold | GrazingSliding):
        point = tangency_near(at, index, belts, cut([loop], more=1)[0], known)
    elif isinstance(condition, SlidingExchange):
        point = exchange_near(at, index, belts, cut([loop])[0], known)
    elif isinstance(condition, CrossingSliding):
        point = crossing_near(at, index, belts, cut([loop])[0], known)
    else:
        repels = solver_of(condition) is at_edge_unstable
        point = edge_contact(at, index, belts, either, loop, known, repels=repels)
    if int(point.status) != Status.OK:
        return None
    return replace(point, condition=_kind_found(condition, point))


def _kind_found(condition: AbstractCondition, point: BifurcationPoint) -> AbstractCondition:
    if isinstance(condition, GrazingSliding | NonsmoothFold):
        return (NonsmoothFold if point.multiplier > 1 else GrazingSliding)(condition.belt)
    if isinstance(condition, GrazingEdge | CornerCollision) and solver_of(condition) is at_edge:
        chain, z = point.cycle.chain, point.cycle.unknowns
        loop = Loop(chain.codes, chain.ends, z[:, :2], z[:, 2])
        belt, either = jnp.asarray(condition.belt), jnp.zeros(())
        near = end_near_edge(point.oscillator, loop, belt, either)
        return (GrazingEdge if near.grazes else CornerCollision)(condition.belt)
    return condition


def _belts(condition: AbstractCondition) -> tuple[int, int]:
    if isinstance(condition, SlidingExchange):
        return condition.belts
    belt = getattr(condition, "belt", 0)
    return belt, belt
