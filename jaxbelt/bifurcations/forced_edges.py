"""Contact edges and periodic motions of forced oscillators: `GrazingEdge`, `CornerCollision`.

An arc ends in two events at once: one of them is the end of the arc, and the guard of the other one
is the condition. A motion that touches an edge is cut where x2 = 0, and the condition is that x1 is
on the edge there. A motion that goes beyond the edge, where its belt comes or goes, has one more
arc, whose duration goes like the square root of the distance: it is left out of the guess. In a
corner an edge and a boundary, or slip onset, come together.
"""

import itertools
from collections.abc import Iterator
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..cycles.clocked import TimedChain
from ..cycles.periodic import PeriodicMotion
from ..cycles.shooting import end_guard
from ..model.forcing import Oscillating
from ..model.modes import STUCK, edges, mode_acceleration, mode_of
from ..model.oscillator import Oscillator, at_time
from ..model.own_units import in_own_units
from ..model.variations import Variation
from ..motion.arcs import Ends
from ..results import Status
from .arc_rows import ArcRows
from .base import AbstractCondition, BifurcationPoint
from .forced import AbstractForcedCondition, Beginning, minima_of_guards, without_one_of
from .timed_systems import ARRIVES, TimedSystem

#: Durations of arcs beyond an edge with which motions beyond a touch are sought, in own units.
EXCURSIONS = (3e-2, 1e-2, 3e-3)
#: A motion nearer to an edge than ON_THE_EDGE touches it; one with a step within MAY_TOUCH may.
ON_THE_EDGE, MAY_TOUCH = 1e-6, 1e-2


class TwoEvents(TimedSystem):
    """The guard of `end` vanishes in the mode of `codes` where the arc `row` ends."""

    chain: TimedChain
    row: Array
    codes: Array
    end: Array

    def condition(self, osc, z):
        return end_guard(osc, self.codes, self.end, z[self.row + 1, :3])


class ArcOfDuration(TimedSystem):
    """The arc `row` lasts for a given time."""

    chain: TimedChain
    row: Array
    duration: Array

    def condition(self, osc, z):
        return z[self.row, 3] - self.duration


class AbstractTimedEdge(AbstractForcedCondition):
    """A condition on an edge with a clock; public: its class without a clock."""

    belt: int
    public: type[AbstractCondition] = eqx.field(static=True)

    def ends_of_edges(self, osc: Oscillator) -> Iterator[tuple[int, np.ndarray]]:
        """For each finite edge of the belt, its number in `Ends` and those of all edges at its
        place; the oscillator has to be known."""
        n, places = len(osc.belts), _edge_places(osc)
        for edge in (self.belt, n + self.belt):
            if np.isfinite(places[edge]):
                yield n + edge, _at_same_place(osc, n + edge)


def _both(
    rows: ArcRows, distance: float, row: int, end: int, codes: np.ndarray | None = None
) -> Beginning:
    """A guess: the arc of a row ends in the event `end` as well, in its own mode or in `codes`."""
    codes = rows.codes[row] if codes is None else codes
    numbers = [jnp.asarray(one) for one in (row, codes, end)]
    return Beginning(rows, distance, lambda chain: TwoEvents(chain, *numbers))


class TimedEdgeGrazing(AbstractTimedEdge):
    """`GrazingEdge` with a clock."""

    def beginnings_of(self, osc, motion, known=False):
        rows, names = ArcRows.of(motion), Ends(len(osc.belts))
        for edge, same in self.ends_of_edges(osc):
            # These include arcs to the boundary of a belt at rest: x1 is extreme there, too.
            for row in _turning(rows):
                yield _both(rows, _off_edge(osc, rows, row, edge), row, edge)
            if known:
                continue
            short = [r for r in range(1, len(rows.ends) - 1) if _is_excursion(rows, r, same)]
            for shorter, row, value in without_one_of(rows, short, names.extremum_x1):
                yield _both(shorter, value, row, edge)
            own_guard = slice(edge, edge + 1)
            for row, since, state, value in minima_of_guards(osc, motion, own_guard):
                cut = rows.cut(row, since, state, names.extremum_x1)
                yield _both(cut, value, row, edge)

    def motions_beyond(
        self, variation: Variation, point: BifurcationPoint
    ) -> Iterator[BifurcationPoint]:
        """Motions that go beyond the edge for a short time, each as a point with its value.

        If the motion of the point touches other edges, too, as symmetric ones do, those that go
        beyond all of the edges come first.
        """
        value = np.array([float(point.value)])
        osc, rows = in_own_units(variation.oscillator(value)), ArcRows.of(point.cycle)
        for edge, _ in self.ends_of_edges(osc):
            for row in _turning(rows):
                if _off_edge(osc, rows, row, edge) > ON_THE_EDGE:
                    continue
                touched = _touching_all(osc, point.cycle, row, edge)
                ways = [touched] * (len(touched[1]) > 1) + [(rows, [(row, edge)])]
                for (cut, touches), duration in itertools.product(ways, EXCURSIONS):
                    beyond = _with_excursions(osc, cut, touches, duration)
                    if beyond is None:
                        continue
                    numbers = jnp.asarray(touches[0][0] + 1), jnp.asarray(duration)

                    def system(chain, numbers=numbers):
                        return ArcOfDuration(chain, *numbers)

                    found = self.point_of(variation, osc, value, Beginning(beyond, 0.0, system))
                    if int(found.status) == Status.OK:
                        yield found


class TimedCorner(AbstractTimedEdge):
    """`CornerCollision` with a clock."""

    def point_of(self, variation, osc, value, beginning):
        point = super().point_of(variation, osc, value, beginning)
        if int(point.status) != Status.OK:
            return point
        # A motion that only touches the edge meets the equations, too.
        motion, osc = lax.stop_gradient((point.cycle, point.oscillator))
        rows, own = ArcRows.of(motion), in_own_units(osc)
        touches = any(
            _off_edge(own, rows, row, edge) < ON_THE_EDGE
            for edge, _ in self.ends_of_edges(own)
            for row in _turning(rows)
        )
        return replace(point, status=jnp.asarray(Status.OTHER_KIND.value)) if touches else point

    def beginnings_of(self, osc, motion, known=False):
        rows, n = ArcRows.of(motion), len(osc.belts)
        onset = Ends(n).onset
        for edge, same in self.ends_of_edges(osc):
            for row, end in enumerate(rows.ends[:-1].tolist()):
                if end < n or end == onset:
                    yield _both(rows, _off_edge(osc, rows, row, edge), row, edge)
                elif end in same:
                    y = jnp.asarray(rows.z[row + 1, :3])
                    before, after = rows.codes[row : row + 2]
                    for codes, other in self._others_on_edge(before, after, onset):
                        guard = end_guard(osc, jnp.asarray(codes), jnp.asarray(other), y)
                        yield _both(rows, abs(float(guard)), row, other, codes)

    def _others_on_edge(
        self, before: np.ndarray, after: np.ndarray, onset: int
    ) -> Iterator[tuple[np.ndarray, int]]:
        """Second events of an arc that ends on an edge: codes of the mode in which each has its
        guard, and its number in `Ends`."""
        if np.any(before == STUCK):
            held = np.where((before == STUCK) & (np.abs(after) < 2), STUCK, after)
            yield from ((codes, onset) for codes in (before, held) if np.any(codes == STUCK))
        else:
            touched = (np.abs(before) < 2) | (np.abs(after) < 2)
            yield from ((before, belt) for belt in np.flatnonzero(touched).tolist())


def _touching_all(
    osc: Oscillator, motion: PeriodicMotion, row: int, edge: int
) -> tuple[ArcRows, list[tuple[int, int]]]:
    """The arcs of a motion, cut where it touches edges other than `edge`, on which the arc `row`
    ends; and (row, edge) of all arcs that touch an edge, in order."""
    rows, names, n = ArcRows.of(motion), Ends(len(osc.belts)), len(osc.belts)
    places, known, others = _edge_places(osc), _at_same_place(osc, edge).tolist(), []
    for other in (n + np.flatnonzero(np.isfinite(places))).tolist():
        if other in known:
            continue
        known += _at_same_place(osc, other).tolist()
        for at, since, state, value in minima_of_guards(osc, motion, slice(other, other + 1)):
            if value < MAY_TOUCH:
                others.append((at, since, np.array([places[other - n], 0.0, state[2]]), other))
    touches, own = [], row
    for cuts, (at, since, state, end) in enumerate(sorted(others, key=lambda one: one[:2])):
        rows = rows.cut(at + cuts, since, state, names.extremum_x1)
        touches.append((at + cuts, end))
        own += at <= row
    return rows, sorted([*touches, (own, edge)])


def _with_excursions(
    osc: Oscillator, rows: ArcRows, touches: list[tuple[int, int]], duration: float
) -> ArcRows | None:
    """`_with_excursion` for all touches, (row, edge), which are in order."""
    beyond: ArcRows | None = rows
    for row, edge in reversed(touches):
        same = _at_same_place(osc, edge)
        beyond = beyond and _with_excursion(osc, beyond, row, edge, same, duration)
    return beyond


def _with_excursion(
    osc: Oscillator, rows: ArcRows, row: int, edge: int, same: np.ndarray, duration: float
) -> ArcRows | None:
    """The arcs with one more, beyond the edge that the arc `row` touches; None where the mass does
    not come back from there."""
    n, place = len(osc.belts), _edge_places(osc)[edge - len(osc.belts)]
    time, codes = rows.z[row + 1, 2], rows.codes[row].copy()
    now = at_time(osc, jnp.asarray(time))
    way = np.sign(place - rows.z[row, 0])
    for belt, is_upper in ((int(one) % n, one >= 2 * n) for one in same):
        outside = np.abs(codes[belt]) == 2
        velocity = float(now.belts[belt].velocity)
        if outside and velocity == 0:
            return None
        codes[belt] = np.sign(velocity) if outside else (2 if is_upper else -2)
    still = jnp.asarray(place), jnp.zeros(())
    pull = float(mode_acceleration(now, mode_of(jnp.asarray(codes)), *still))
    if pull * way >= 0:
        return None
    half = 0.5 * duration
    before, after = rows.z[row].copy(), rows.z[row + 1]
    before[3] -= half
    beyond = np.array([place, -half * pull, time - half, duration])
    then = np.array([place, half * pull, time + half, after[3] - half])
    arcs = (rows.codes[row], edge, before), (codes, edge, beyond)
    return rows.put(row, row + 1, *arcs, (rows.codes[row + 1], rows.ends[row + 1], then))


def _turning(rows: ArcRows) -> list[int]:
    """Rows of the arcs that end where x2 = 0."""
    return np.flatnonzero(np.abs(rows.z[1:, 1]) < ARRIVES).tolist()


def _off_edge(osc: Oscillator, rows: ArcRows, row: int, end: int) -> float:
    """Distance of the end of an arc from the edge of number `end`."""
    return abs(_edge_places(osc)[end - len(osc.belts)] - rows.z[row + 1, 0])


def _is_excursion(rows: ArcRows, row: int, ends: np.ndarray) -> bool:
    """Whether an arc begins and ends on an edge, between two arcs of one mode."""
    passes = rows.ends[row - 1] in ends and rows.ends[row] in ends
    return bool(passes and np.array_equal(rows.codes[row - 1], rows.codes[row + 1]))


def _at_same_place(osc: Oscillator, end: int) -> np.ndarray:
    """The numbers in `Ends` of all edges at the place of the edge `end`."""
    n, places = len(osc.belts), _edge_places(osc)
    return n + np.flatnonzero(places == places[end - n])


def _edge_places(osc: Oscillator) -> np.ndarray:
    return np.array([float(place) for place in edges(osc)])


def edged_belts(osc: Oscillator) -> list[int]:
    """Numbers of the belts of a known oscillator that have a finite contact edge and a load."""
    edged = np.any(np.isfinite(_edge_places(osc).reshape(2, -1)), axis=0)
    loads = [belt.load for belt in osc.belts]
    loaded = [isinstance(load, Oscillating) or float(load) != 0 for load in loads]
    return np.flatnonzero(edged & loaded).tolist()
