"""A path in one parameter, and the motions of the oscillator along it: `ParameterPath`.

A label sums up the motions at one value of the parameter: the kind and the stability of every
equilibrium, and the itinerary of every attracting cycle, that is, the modes that it passes in one
loop, see `attractors`. A cycle that sticks passes a place where a stick phase ends, in slip onset
or on a contact edge, so it is found by following the orbits from there; a few starts beside the
equilibria find the other cycles. One compiled program computes labels in batches.

Where contact edges have saddles a label also has the courses of the orbits that leave them, see
`connections`.

Between two values with the same label nothing is assumed to happen if each cycle at one of them
continues to a cycle at the other. A cycle that sticks does so if its itinerary occurs at both.
Several cycles that do not stick may share an itinerary: each is followed to where its derivative by
the parameter leads.
"""

import functools
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from ..checks import is_concrete, require
from ..cycles.attractors import (
    GOES_ON,
    LEAST_MOMENT,
    SAME_CYCLE,
    Itinerary,
    distance,
    idle_belts,
    itinerary,
    place_of,
    sticks,
    without_idle,
)
from ..cycles.backwards import solved
from ..cycles.chains import SIZES, Loop, cut
from ..cycles.cycle import Cycle, as_loop, cycle_from, polish
from ..cycles.orbits import FINE_STRIDE
from ..cycles.settling import AT_REST
from ..cycles.unstable import among_all, from_starts
from ..model.equilibria import EquilibriumKind, candidates
from ..model.far_out import is_bounded
from ..model.oscillator import Oscillator
from ..model.variations import as_span, varied
from ..motion.integrators import STRIDE
from ..numerics.compiling import each, jit
from ..numerics.padding import each_row
from ..results import Status
from .base import AbstractCondition, check_conditions
from .connections import SaddleCourse, courses_of
from .guesses import repeated_loops
from .labels import AttractingCycle, Label

#: Values of the parameter in one batch.
BATCH = 16
#: Room for the arcs of one loop.
ROOM = SIZES[1]
#: Values closer than CLOSE * (unit + span) count as equal.
CLOSE = 1e-6
#: The derivative of a cycle by the parameter is a difference over this fraction of a step along the
#: path, but no less than CLOSE: a cycle that hardly attracts is known to 1e-5 of its size only.
DIFFERENCE = 1e-3
#: Unstable cycles are searched at every eighth value of a stretch, and followed in between.
FOLLOWED_VALUES = 8
#: A cycle is at its expected place if it is no farther from there, relative to its size, than this
#: plus 0.3 of its expected move. Where a cycle moves like a square root, intervals get shorter.
EXPECTED = 1e-3


class ParameterPath:
    """A path in one parameter: its labels, each computed once, and loops of the cycles in them."""

    def __init__(
        self, osc, where, span, conditions: Sequence[AbstractCondition] = (), *, basins: bool = True
    ):
        #: Whether labels contain courses and `bounded`; they affect basins, but no attractor.
        self.basins = basins
        first, last = as_span(osc, where, span)
        given = varied(osc, where, (first,))
        known = "of known numbers: paths are not for jit, vmap or derivatives"
        at_first = given.oscillator(np.array([first]))
        require(is_concrete(at_first), "osc", known, "a traced one")
        conditions = check_conditions(conditions)
        #: The variation in own units, those of the parameter included; so is all that follows.
        self.variation = given.over(first, last)
        #: The given oscillator, or the one at the first value.
        self.osc = osc if isinstance(osc, Oscillator) else at_first
        for condition in conditions:
            condition.check(self.osc)
        self._oscillators: dict[float, Oscillator] = {}
        self._idle: dict[float, np.ndarray] = {}
        measured = 1.0 if given.units is not None else float(self.variation.own.parameters[0])
        self.first, self.last = first / measured, last / measured
        self.conditions = conditions
        self.length = self.last - self.first
        #: Natural unit of the parameter, see `Family.units`.
        self.unit = float(self.variation.family(np.array([0.5 * (self.first + self.last)])).unit)
        (self.name,) = self.variation.names
        self.labels: dict[float, Label] = {}
        self.cycles: dict[float, list[AttractingCycle]] = {}
        self.unstable_cycles: dict[tuple[float, int], Cycle] = {}
        #: How often Newton's method was begun for a point on this path.
        self.attempts = 0
        self._searched: set[tuple[float, int]] = set()
        # By (value, other value): for the number of each cycle that does not stick the number of
        # the cycle at the other value that it continues to, or None.
        self._goes_on: dict[tuple[float, float], dict[int, int | None]] = {}
        # Whether a pseudo-focus exists, by the value.
        self._pseudo_foci: dict[float, bool] = {}
        # Intervals in which labels are computed by fine orbits, with the stride FINE_STRIDE.
        self._fine: list[tuple[float, float]] = []
        self._coincidences = self.variation.coincidences(self.first, self.last)
        self._meetings = self.variation.meetings(self.first, self.last)
        self.breaks = sorted(self._coincidences.keys() | self._meetings.keys())

    def inside(self, end: float) -> float:
        """An end of the span; where a load vanishes there, a value just inside of the span.

        Labels leave out belts without load, so the label at the end would differ for no reason.
        """
        middle = 0.5 * (self.first + self.last)
        here, there = ([float(b.load) for b in self.at(at).belts] for at in (end, middle))
        vanishes = any(a == 0 and b != 0 for a, b in zip(here, there, strict=True))
        return end + CLOSE * (middle - end) if vanishes else end

    def at(self, value: float) -> Oscillator:
        """The oscillator at a value, made once."""
        if value not in self._oscillators:
            self._oscillators[value] = self.variation.oscillator(np.array([value]))
        return self._oscillators[value]

    def idle(self, value: float) -> np.ndarray:
        """`idle_belts` at a value; labelled values need not make their oscillator for it."""
        if value not in self._idle:
            self._idle[value] = idle_belts(self.at(value))
        return self._idle[value]

    def unstable(self, value: float, around: int) -> Cycle:
        """The unstable cycle at a value around an equilibrium, computed once; its status says why
        there is none."""
        if (value, around) not in self.unstable_cycles:
            self.unstable_cycles[value, around] = from_starts(self.at(value), around=around)
        return self.unstable_cycles[value, around]

    def unstable_along(self, values: Sequence[float] | np.ndarray, around: int) -> list[Cycle]:
        """Unstable cycles at increasing values without other bifurcations between them.

        They are searched at some of the values, and followed from one of these to the next, where
        the cycle has to agree with the one that the search finds; else every value is searched. The
        search, from starts near the equilibrium, may find no cycle, or pass over it to one farther
        out; there the cycles at neighbouring values are continued.
        """
        order = [float(value) for value in values]
        known = self.unstable_cycles
        searched = sorted({*range(0, len(order), FOLLOWED_VALUES), len(order) - 1})
        for first, last in pairwise(searched):
            self._follow_unstable(order[first : last + 1], around)
        if not any(_is_found(self.unstable(value, around)) for value in order):
            middle = order[len(order) // 2]
            if (middle, around) not in self._searched:
                self._searched.add((middle, around))
                found = among_all(self.at(middle), around)
                known[middle, around] = known[middle, around] if found is None else found
        for before, value in (*pairwise(order), *pairwise(order[::-1])):
            one, beside = self.unstable(value, around), self.unstable(before, around)
            if _is_found(beside) and not _is_beside(beside, one):
                found = _gone_on(self.at(value), beside)
                if found is not None and _width(found) <= _width(one):
                    known[value, around] = found
        return [known[value, around] for value in order]

    def _follow_unstable(self, order: Sequence[float], around: int) -> None:
        """Follows the unstable cycle from the first value to the last one, and keeps the cycles in
        between if it arrives at the cycle that is found at the last value."""
        cycle, end = (self.unstable(value, around) for value in (order[0], order[-1]))
        is_known = all((value, around) in self.unstable_cycles for value in order)
        if is_known or not (_is_found(cycle) and _is_found(end)):
            return
        followed: dict[tuple[float, int], Cycle] = {}
        for value in order[1:]:
            found = _gone_on(self.at(value), cycle)
            if found is None:
                return
            cycle = followed[value, around] = found
        if distance(place_of(cycle), place_of(end)) < SAME_CYCLE:
            for key, one in followed.items():
                self.unstable_cycles.setdefault(key, one)

    @property
    def closest(self) -> float:
        """Distance of two values that are told apart where motions converge fast."""
        # Not closer in a short span: a loop counts as repeated when it repeats to 1e-7.
        return CLOSE * (self.unit + self.length)

    def beside(self, value: float, *, slow: bool = False) -> tuple[float, float]:
        """Values just below and above `value`; slow: farther off, as motions converge slowly."""
        distance = self.closest
        far = value - 30.0 * distance, value + 30.0 * distance
        if slow:
            return far
        # Loops around a pseudo-focus with a velocity below some 1e-5 are lost in rounding.
        if value in self.breaks and any(map(self._has_pseudo_focus, far)):
            return value - 100.0 * distance, value + 100.0 * distance
        return value - distance, value + distance

    def _has_pseudo_focus(self, value: float) -> bool:
        if value not in self._pseudo_foci:
            kinds = candidates(self.at(value)).kind if self.edged else ()
            self._pseudo_foci[value] = EquilibriumKind.PSEUDO_FOCUS in np.asarray(kinds)
        return self._pseudo_foci[value]

    @functools.cached_property
    def edged(self) -> list[int]:
        """Belts with a finite contact edge and a load, one for each set of shared edges.

        Of belts that share their edges the one in a user's condition is taken, if there is one.
        """
        own_first = [belt for one in self.conditions for belt in one.belts_concerned]
        belts: list[int] = []
        # At one value a load may be zero, or two edges may meet that are not shared.
        spread = [self.first + part * self.length for part in (0.0, 0.29, 0.61, 1.0)]
        along = [*zip(*(self.at(value).belts for value in spread), strict=True)]
        pressed = [k for k, same in enumerate(along) if any(float(b.load) != 0 for b in same)]
        known: set[tuple[float, ...]] = set()
        for number in dict.fromkeys([*own_first, *pressed]):
            ends = (
                tuple(float(getattr(belt, name)) for belt in along[number])
                for name in ("lower", "upper")
            )
            own = {end for end in ends if np.all(np.isfinite(end))}
            if own - known:
                belts.append(number)
            known |= own
        return belts

    def coinciding(self, value: float) -> list[tuple[int, ...]]:
        """Pairs of belts whose velocities become equal at a value, and single belts that come to
        rest there."""
        return self._coincidences.get(value, [])

    def meeting(self, value: float) -> list[tuple[int, ...]]:
        """Pairs of belts with contact edges that meet at a value."""
        return self._meetings.get(value, [])

    def find_labels(self, values: Sequence[float] | np.ndarray) -> None:
        """Computes the labels at these values, in batches."""
        new = sorted({float(v) for v in values} - self.labels.keys())
        for stride in (STRIDE, FINE_STRIDE):
            own = np.array([v for v in new if self._is_fine(v) == (stride == FINE_STRIDE)])
            for batch in (own[i : i + BATCH] for i in range(0, own.size, BATCH)):
                self._label_batch(batch, stride)
        self._agree_on_moments()
        self._share()

    def find_labels_finely(self, value: float, away: float) -> None:
        """Computes all labels within `away` of a value again, by orbits that are accurate to 1e-12.

        Later labels there are computed in the same way. Where two events of a cycle come close
        together the error of ordinary orbits, some 1e-8, decides which event is first.
        """
        self._fine.append((value - away, value + away))
        again = [v for v in self.labels if abs(v - value) <= away]
        for v in again:
            del self.labels[v], self.cycles[v]
        known = self._goes_on.items()
        self._goes_on = {pair: to for pair, to in known if not set(pair) & set(again)}
        self.find_labels(again)

    def _is_fine(self, value: float) -> bool:
        return any(low <= value <= high for low, high in self._fine)

    def is_fine(self, a: float, b: float) -> bool:
        """Whether the labels at both values are computed by fine orbits."""
        return self._is_fine(a) and self._is_fine(b)

    def _label_batch(self, batch: np.ndarray, stride: float) -> None:
        filled = np.concatenate([batch, np.full(BATCH - batch.size, np.nan)])
        oscs = self.variation.oscillators(filled[:, None])
        seen = _motions(oscs, np.asarray(stride))
        courses = courses_of(oscs) if self.basins and self.edged else [()] * BATCH
        rows = each_row(jax.tree.map(np.asarray, (idle_belts(oscs), seen)))
        for value, (idle, one), course in zip(batch.tolist(), rows, courses, strict=False):
            self._take(value, idle, one, course)

    def changes(self, explained: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        """Intervals between neighbouring labelled values whose motions differ, except those inside
        of an explained interval."""
        return [
            (a, b)
            for a, b in pairwise(sorted(self.labels))
            if not any(low <= a and b <= high for low, high in explained)
            and not (self.labels[a].is_as(self.labels[b]) and self._all_go_on(a, b))
        ]

    def _take(
        self, value: float, idle: np.ndarray, seen: "_Motions", courses: tuple[SaddleCourse, ...]
    ) -> None:
        """Stores the label and the cycles of a value from its motions; idle: see `idle_belts`."""
        self._idle[value] = idle
        exists = seen.kind > 0
        codes = without_idle(idle, seen.modes[exists])
        # The sign of slip at a pseudo-focus makes no difference: a label always has 1.
        is_focus = seen.kind[exists, None] == EquilibriumKind.PSEUDO_FOCUS
        codes = np.where(is_focus & (codes == -1), 1, codes)
        columns = (seen.kind, seen.stable, seen.x1_lower, seen.x1_upper)
        rows = (x[exists].tolist() for x in columns)
        rests = _joined_rests(zip(*rows, map(tuple, codes.tolist()), strict=True))
        found: list[AttractingCycle] = []
        loops = [*each_row(seen.loop)]
        for loop, status in zip(loops, seen.status.tolist(), strict=True):
            one = self._attracting_cycle(value, loop) if status == Status.OK else None
            if one is not None and _number_among(one, found) is None:
                found.append(one)
        if not found and not any(stable for _, stable, _ in rests):
            # The orbits are confined, so there is a cycle that they approach slowly.
            found.append(
                self._attracting_cycle(value, loops[-1], closes=False)
                or AttractingCycle((), loops[-1])
            )
        self.cycles[value] = found
        self.labels[value] = Label(rests, (), (), courses, not self.basins or bool(seen.bounded))
        self._name(value)

    def _name(self, value: float) -> None:
        """Updates the cycles and the marks in the label at a value."""
        cycles = sorted(self.cycles[value], key=lambda one: one.path)
        loops = [one.loop for one in cycles if one.path]
        marks = tuple(condition.mark(self.at(value), loops) for condition in self.conditions)
        paths = tuple(one.path for one in cycles)
        self.labels[value] = self.labels[value]._replace(cycles=paths, marks=marks)

    def _attracting_cycle(
        self, value: float, loop: Loop, *, closes: bool = True
    ) -> AttractingCycle | None:
        """The attracting cycle near a loop, or the one that the orbit from there leads to, or None.

        A loop that closes and sticks is a loop of the cycle itself. Any other may only seem to
        repeat, so the cycle is solved for. closes: whether an orbit was seen to repeat the loop.
        """
        if closes and sticks(path := itinerary(self.idle(value), loop)):
            return AttractingCycle(path, loop)
        osc, ok = self.at(value), jnp.asarray(Status.OK.value)
        # Where the cycle has another signature than the loop, or meets a boundary, Newton's method
        # fails, and the orbit is followed.
        ways = (lambda: polish(osc, cut([loop])[0], ok), lambda: cycle_from(osc, loop.entries[0]))
        for cycle in (way() for way in ways[0 if closes else 1 :]):
            if int(cycle.status) == Status.OK and abs(float(cycle.multiplier)) < 1:
                if _is_off_rest(cycle):
                    loop = jax.tree.map(np.asarray, as_loop(cycle, ROOM))
                    return AttractingCycle(itinerary(self.idle(value), loop), loop)
        return None

    def _agree_on_moments(self) -> None:
        """Makes neighbouring labels agree on arcs that take hardly any time.

        Such an arc counts if it does at the neighbouring value: it vanishes at a bifurcation point
        that may be some way off, not where its duration falls below `MOMENT`.
        """
        values = sorted(self.labels)
        for pairs in (pairwise(values), pairwise(values[::-1])):
            for a, b in pairs:
                known = {one.path for one in self.cycles[a]}
                others = self.cycles[b]
                for i, one in enumerate(others):
                    if one.path and one.path not in known:
                        path = itinerary(self.idle(b), one.loop, LEAST_MOMENT)
                        if path in known:
                            others[i] = one._replace(path=path)
                            self._name(b)

    def _share(self) -> None:
        """Adds attracting cycles that were found at a neighbouring value only.

        A cycle that sticks is always found, from the end of its stick phase. A cycle that does not
        stick may be missed.
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
        """Whether each cycle at `a` that does not stick continues to a cycle at `b`, and no two of
        them to the same one."""
        ahead = self._goes_on[a, b] | {
            i: j for j, i in self._goes_on[b, a].items() if i is not None
        }
        reached = [j for j in ahead.values() if j is not None]
        smooth = [i for i, one in enumerate(self.cycles[a]) if one.path and not sticks(one.path)]
        return len(set(reached)) == len(smooth) and all(ahead.get(i) is not None for i in smooth)

    def _followed(self, known: float, value: float, number: int) -> int | None:
        """Number of the cycle at `value` that cycle `number` at `known` continues to, or None.

        The cycle is solved for from its expected place, which the derivative gives.
        """
        path, loop = self.cycles[known][number]
        step = value - known
        part = max(DIFFERENCE, CLOSE * (self.unit + self.length) / abs(step))
        nearby = self._attracting_cycle(known + part * step, loop)
        expected = loop
        if nearby is not None and nearby.path == path and _fits(nearby.loop, loop):
            parts = ((t.entries, t.durations) for t in (loop, nearby.loop))
            moved = [a + (b - a) / part for a, b in zip(*parts, strict=True)]
            expected = eqx.tree_at(lambda t: (t.entries, t.durations), loop, tuple(moved))
        found = self._attracting_cycle(value, expected)
        if found is None or found.path != path:
            return None
        places = [place_of(one) for one in (loop, expected, found.loop)]
        way = distance(places[0], places[1])
        if distance(places[1], places[2]) > EXPECTED * (1 + 300 * way):
            return None
        at = _number_among(found, self.cycles[value])
        if at is None:
            others = self.cycles[value]
            # Replaces a cycle that was only assumed.
            at = 0 if others and not others[0].path else len(others)
            others[at : at + 1] = [found]
            self._name(value)
        return at

    def strands(self, values: Sequence[float]) -> list[dict[float, Loop]]:
        """Loops of the attracting cycles, by the value, for each cycle that continues.

        values: increasing, without bifurcations between them.
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
        """Number of the cycle at the value before that continues to the smooth cycle `number`."""
        if before is None:
            return None
        back = self._goes_on[value, before].get(number)
        ahead = self._goes_on[before, value].items()
        return back if back is not None else next((i for i, j in ahead if j == number), None)

    def label(self, value: float) -> Label:
        """The label at a value, which `find_labels` has computed."""
        return self.labels[float(value)]


def _joined_rests(rows: Iterable[tuple]) -> tuple[tuple, ...]:
    """(kind, stable, codes) of every equilibrium, from left to right.

    rows: (kind, stable, x1_lower, x1_upper, codes) of each. A segment in pieces, divided by the
    edge of a belt without load, becomes one.
    """
    rests: list[tuple] = []
    end = np.nan  # x1_upper of the last row, if that is a segment
    for kind, attracts, low, high, code in rows:
        if kind == EquilibriumKind.SEGMENT and low == end and rests[-1][2] == code:
            attracts |= rests.pop()[1]
        rests.append((kind, attracts, code))
        end = high if kind == EquilibriumKind.SEGMENT else np.nan
    return tuple(rests)


def _is_found(cycle: Cycle) -> bool:
    return int(cycle.status) == Status.OK


def _gone_on(osc: Oscillator, beside: Cycle) -> Cycle | None:
    """The cycle that an unstable cycle at a neighbouring value continues to, or None."""
    cycle = solved(osc, jax.tree.map(np.asarray, as_loop(beside, ROOM)))
    return cycle if _is_beside(beside, cycle) and float(cycle.multiplier) > 1 else None


def _is_beside(cycle: Cycle, other: Cycle) -> bool:
    """Whether `other` has been found, so near that `cycle` continues to it."""
    return _is_found(other) and bool(distance(place_of(cycle), place_of(other)) < GOES_ON)


def _width(cycle: Cycle) -> float:
    return float(cycle.x1_max - cycle.x1_min) if _is_found(cycle) else np.inf


def _is_off_rest(cycle: Cycle) -> bool:
    """Whether a cycle has not shrunk to an equilibrium.

    Its size is the larger one of its ranges of x1 and of x2: around a pseudo-focus the range of x1
    is proportional to the square of that of x2.
    """
    return float(np.max(np.ptp(np.asarray(cycle.unknowns)[:, :2], axis=0))) > AT_REST


def _number_among(cycle: AttractingCycle, among: Sequence[AttractingCycle]) -> int | None:
    """Number of a cycle among others, or None.

    Two cycles at the same place are one, whatever their modes: just before a corner that the cycle
    passes with a short stick phase, a loop without that phase solves the equations within errors.
    """
    place = place_of(cycle.loop)
    for number, other in enumerate(among):
        if not other.path:  # only assumed
            continue
        if other.path == cycle.path and sticks(cycle.path):
            return number
        if distance(place, place_of(other.loop)) < SAME_CYCLE:
            return number
    return None


def _fits(loop: Loop, other: Loop) -> bool:
    """Whether two loops have the same arcs in the same order."""
    return np.array_equal(loop.codes, other.codes) and np.array_equal(loop.ends, other.ends)


class _Motions(NamedTuple):
    """Columns of the equilibria, [rows]; status, [starts], and last loop, [starts, ROOM], of every
    orbit; bounded: whether loops far out shrink."""

    kind: Any
    stable: Any
    modes: Any
    x1_lower: Any
    x1_upper: Any
    status: Any
    loop: Any
    bounded: Any


@jit
def _motions(oscs: Oscillator, stride: ArrayLike) -> _Motions:
    def at(osc: Oscillator) -> _Motions:
        rests = candidates(osc)
        loop, status = repeated_loops(osc, rests, ROOM, stride)
        known = (rests.kind, rests.stable, rests.modes, rests.x1_lower, rests.x1_upper)
        return _Motions(*known, status, loop, is_bounded(osc))

    return each(at)(oscs)
