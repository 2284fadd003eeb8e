"""Bifurcations of periodic motions of forced oscillators.

Beside the 4N equations of a periodic motion, see `cycles.clocked`, stands one more, in one more
unknown, the parameter:

- `PeriodDoubling`, `Fold`, `Torus`: a multiplier of -1 or 1, or a pair of modulus 1, in terms of
  trace and determinant of the monodromy matrix M: 1 + tr + det = 0, 1 - tr + det = 0, det = 1.
- `GrazingSliding`: a slip arc touches the boundary of a belt, r = r' = 0.
- `CrossingSliding`, `SwitchingSliding`: a slip arc arrives at the boundary where the force needed
  to stick is just what the belt can hold, with the sign with which it arrives; that force rises
  (crossing) or falls (switching).
- `AddingSliding`: inside a stick phase the force needed to stick touches the limit of the belt.

M. di Bernardo, P. Kowalczyk, A. Nordmark, Int. J. Bifurcation Chaos 13 (2003) 2935, have the four
sliding bifurcations; contact edges are in `forced_edges`. The guess of a motion that touches has an
arc that is cut where it nearly touches, or lacks the short arc beyond.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import as_finite, is_concrete, require
from ..cycles.clocked import guards_along, timed_chain_of, turns_of
from ..cycles.periodic import (
    PeriodicMotion,
    begun_off_events,
    motion_at,
    motion_between_halves,
    nothing_found,
    of_least_periods,
    periodic_from,
    periods_of,
    state_at_phase_0,
)
from ..cycles.reached import attracted, motions_of
from ..model.friction import friction_jumps
from ..model.instants import guards_trend
from ..model.modes import STUCK, mode_of
from ..model.oscillator import Oscillator, check_clock
from ..model.own_units import OwnOscillator, in_own_units, rescaled
from ..model.variations import Variation
from ..motion.arcs import Ends
from ..numerics.compiling import jit
from ..results import Status
from .arc_rows import ArcRows
from .base import AbstractCondition, BifurcationPoint, Line, point_of, point_without_cycle
from .systems import solve_system
from .timed_systems import AtLimit, OnUnitCircle, TimedSystem, Touching, place_of_motion

#: Number of guesses from a motion from which a condition is solved, the most promising ones first.
TRIED = 4
#: A minimum of a guard earlier than this part of an arc is that of the event at which it began.
AT_ONSET = 1e-6
#: Arcs whose durations differ by less than this part may be images of one another.
ALIKE_ARCS = 0.1
#: Effects of jumps from static to kinetic friction, in own units, count as zero below this.
SMALLEST_JUMP = 1e-6
#: A point with a larger error, in units of the parameter, is solved again with integration steps
#: that suit its own motion.
EXACT_POINT = 1e-11
#: States from which motions are looked for, in own units.
STARTS_OF_MOTIONS = (
    (0.5, 0.0),
    (0.0, 0.0),
    (-0.5, 0.0),
    (1.5, 0.0),
    (-1.5, 0.0),
    (0.0, 0.5),
    (3.0, 0.0),
)


# --- what conditions have in common ---------------------------------------------------------------


class Beginning(NamedTuple):
    """A guess: arcs, their estimated distance from a point, and a function from chain to system."""

    rows: ArcRows
    distance: float
    system: Any


class AbstractForcedCondition(AbstractCondition):
    """A condition on a periodic motion of a forced oscillator."""

    def check(self, osc):
        super().check(osc)
        check_clock(osc, type(self).__name__, "the conditions for oscillators without")

    def with_clock(self):
        return self

    def kind_along(self, osc, multiplier) -> type[AbstractCondition]:
        # A condition that exists without a clock, too, has that class as its field `public`.
        return getattr(self, "public", type(self))

    def beginnings_of(
        self, osc: Oscillator, motion: PeriodicMotion, known: bool = False
    ) -> Iterator[Beginning]:
        """Guesses for the condition from a motion of a known oscillator in own units.

        known: whether the motion is that of a solved point of the condition.
        """
        raise NotImplementedError

    def points(
        self, variation: Variation, value: Any, motion: PeriodicMotion
    ) -> list[BifurcationPoint]:
        """The points that are found from a motion at a value, [1], of the parameter."""
        osc = lax.stop_gradient(variation.oscillator(value))
        motion = begun_off_events(osc, motion)
        some = sorted(self.beginnings_of(osc, motion), key=lambda one: one.distance)
        found = [self.point_of(variation, osc, value, one) for one in some[:TRIED]]
        return [point for one in found for point in self._of_least_periods(variation, one)]

    def _of_least_periods(
        self, variation: Variation, point: BifurcationPoint
    ) -> list[BifurcationPoint]:
        """The point; or, where its motion of more periods has shrunk onto one of fewer, the points
        found from the latter."""
        if int(point.status) != Status.OK:
            return [point]
        osc, value, motion = lax.stop_gradient((point.oscillator, point.value, point.cycle))
        least = of_least_periods(osc, motion, motion.chain.turns)
        if least.periods == motion.periods:
            return [point]
        return self.points(variation, value[None], least) if int(least.status) == Status.OK else []

    def point_of(
        self, variation: Variation, osc: Oscillator, value: Any, beginning: Beginning
    ) -> BifurcationPoint:
        """The point that is found from one guess."""
        point = self.solve(variation, osc, value, beginning)
        bound = EXACT_POINT * variation.family(value).unit
        if int(point.status) != Status.OK or float(point.error) <= float(bound):
            return point
        # The integration steps suit the motion at the beginning, which may be far away.
        near, at, motion = lax.stop_gradient((point.oscillator, point.value, point.cycle))
        closer = beginning._replace(rows=ArcRows.of(motion))
        again = self.solve(variation, near, at[None], closer)
        finer = int(again.status) == Status.OK and float(again.error) < float(point.error)
        return again if finer else point

    def guess(self, osc, size):
        raise NotImplementedError

    def named_point_beside(self, variation, value, osc, system, x):
        # Start from the motion at this value, which may have another signature.
        chain, at = system.chain, np.array([value])
        start, periods = state_at_phase_0(osc, chain, jnp.asarray(x)), periods_of(chain)
        motion = periodic_from(variation.oscillator(at), start, periods, chain.turns)
        if int(motion.status) != Status.OK or motion.periods != periods:
            return None
        found = [p for p in self.points(variation, at, motion) if int(p.status) == Status.OK]
        nearest = min(found, key=lambda point: abs(float(point.value) - value), default=None)
        return None if nearest is None else replace(nearest, condition=self)

    def prepared(self, osc, guess):
        rows = guess.rows
        chain, z = timed_chain_of(osc, rows.loop(), turns_of(osc), rows.share)
        system = guess.system(chain)
        return _refined(system, osc, z), z, jnp.asarray(Status.OK.value)

    def point_near(self, family, system, x, p, status):
        return _solved_timed_point(family, system, x, p, status)

    def system_at(self, point):
        motion = point.cycle
        some = min(
            self.beginnings_of(point.oscillator, motion, known=True), key=lambda one: one.distance
        )
        return eqx.tree_at(lambda s: s.chain, some.system(motion.chain), motion.chain), (
            motion.unknowns
        )

    def place(self, point):
        return place_of_motion(point.cycle)


_refined = jit(TimedSystem.refined)


@jit
def _solved_timed_point(family, system, z0, p0, status):
    solution = solve_system(family, system, z0, p0, status)
    osc, z = family.at(solution.p), solution.z
    numbers = solution.residual, solution.iterations, solution.status
    motion = motion_at(osc, system.chain, z, *numbers)
    status = system.judge(lax.stop_gradient(osc), lax.stop_gradient(motion))
    return point_of(family, solution, motion, jnp.asarray(jnp.nan), status), (z, solution.p)


def forced_point(
    condition: AbstractCondition, variation: Variation, value: Any, start: Any
) -> BifurcationPoint:
    """The nearest point of a condition that is found from the motions at a value, [1].

    start: one of these motions, or a state at the phase 0 that leads to one; None: all motions that
    are found from `STARTS_OF_MOTIONS`.
    """
    timed = condition.with_clock()
    # A point does not depend on where the search for it begins.
    value = lax.stop_gradient(value)
    near = lax.stop_gradient(variation.oscillator(value))
    require(
        is_concrete((near, value)),
        "osc",
        "known, as points of forced oscillators are",
        "a traced one",
    )
    own, turns = in_own_units(near), turns_of(near)
    motions = motions_to_begin_from(own, start, turns)

    def points_from(motions):
        found = [p for motion in motions for p in timed.points(variation, value, motion)]
        return found, [point for point in found if int(point.status) == Status.OK]

    found, fine = points_from(motions)
    if isinstance(start, PeriodicMotion) and not fine:
        # A given motion may have the arcs of another value, or of a point.
        again = [periodic_from(own, np.asarray(m.start), m.periods, turns) for m in motions]
        found, fine = points_from(m for m in again if int(m.status) == Status.OK)
    guess = float(np.asarray(lax.stop_gradient(value))[0])
    if fine:
        nearest = min(fine, key=lambda one: abs(float(lax.stop_gradient(one.value)) - guess))
        return replace(nearest, condition=condition)
    if found:
        return replace(found[0], condition=condition)
    nan, none = jnp.asarray(jnp.nan), jnp.asarray(Status.NOT_TOUCHED.value)
    family, steps = variation.family(value), jnp.full(1, jnp.nan)
    point = point_without_cycle(family, value, steps, nan, nan, none, none)
    nothing = nothing_found(own, turns, Status.NOT_TOUCHED)
    return replace(point, condition=condition, oscillator=own, cycle=nothing)


def motions_to_begin_from(osc: OwnOscillator, start: Any, turns: int) -> Sequence[PeriodicMotion]:
    """The motions to begin from; for each one of an even number of periods also the motion between
    its halves, which it may have left in a period doubling."""
    if isinstance(start, PeriodicMotion):
        status = Status(int(start.status))
        is_motion = status in (Status.OK, Status.NEUTRAL)
        require(is_motion, "start", "a motion with status OK", status.name)
        return [rescaled(start, 1 / osc.units.length, lambda _: osc)]
    if start is not None:
        start = as_finite(start, "start", (2,))
        motion = attracted(osc, np.asarray(osc.units.into(start)), turns)
        found = [motion] if int(motion.status) == Status.OK else []
    else:
        found = motions_of(osc, STARTS_OF_MOTIONS, turns)
    between = [motion_between_halves(osc, motion, turns) for motion in found]
    return found + [motion for motion in between if motion is not None]


# --- multipliers ----------------------------------------------------------------------------------


class UnitCircle(AbstractForcedCondition):
    """Multipliers of a motion are on the unit circle; parts: see `OnUnitCircle`."""

    parts: ClassVar[tuple[float, float, float]]

    def beginnings_of(self, osc, motion, known=False):
        first, second = np.asarray(motion.multipliers)
        wanted = -1.0 if self.parts[1] > 0 else 1.0
        near = min(abs(first - wanted), abs(second - wanted))
        distance = near if self.parts[1] else abs(abs(first) - 1)
        parts = jnp.asarray(self.parts)
        yield Beginning(
            ArcRows.of(motion), float(distance), lambda chain: OnUnitCircle(chain, parts)
        )


class PeriodDoubling(UnitCircle):
    """A multiplier of a periodic motion is -1.

    The motion goes on, stable on one side only, and one of twice as many periods leaves it.
    """

    caption: ClassVar[str] = "period doubling"
    line: ClassVar[Line] = Line("period doubling", "#0072B2")
    parts: ClassVar = (1.0, 1.0, 1.0)


class Fold(UnitCircle):
    """A multiplier of a periodic motion is 1: two motions meet and vanish."""

    caption: ClassVar[str] = "fold"
    line: ClassVar[Line] = Line("fold", "#E69F00")
    parts: ClassVar = (1.0, -1.0, 1.0)


class Torus(UnitCircle):
    """A pair of multipliers has modulus 1: the motion loses its stability to a torus around it.

    The motion on the torus is quasi-periodic, or locked to the forcing. Sticking motions have none.
    """

    caption: ClassVar[str] = "torus"
    line: ClassVar[Line] = Line("torus", "#009E73")
    parts: ClassVar = (-1.0, 0.0, 1.0)


# --- sliding --------------------------------------------------------------------------------------


class TimedGrazing(AbstractForcedCondition):
    """`GrazingSliding` with a clock; public: that class."""

    belt: int
    public: type[AbstractCondition] = eqx.field(static=True)

    def beginnings_of(self, osc, motion, known=False):
        rows, k = ArcRows.of(motion), int(self.belt)
        names = Ends(rows.codes.shape[1])

        def system(row):
            belt = jnp.asarray(k)
            return lambda chain: Touching(chain, jnp.asarray(row), belt)

        if known:
            row = int(np.flatnonzero(rows.ends == names.tangent + k)[0])
            yield Beginning(rows, 0.0, system(row))
            return
        inner = range(1, len(rows.ends) - 1)
        short, *others = (
            [row for row in inner if self._may_end(rows, row, belt)]
            for belt in (k, *(i for i in range(len(osc.belts)) if i != k))
        )
        others = [row for row in itertools.chain(*others) if row not in short]
        for shorter, row, value in without_one_of(rows, short, names.tangent + k, others):
            yield Beginning(shorter, value, system(row))
        for row, since, state, value in minima_of_guards(osc, motion, slice(k, k + 1)):
            if abs(rows.codes[row, k]) == 1:
                cut = rows.cut(row, since, state, names.tangent + k)
                yield Beginning(cut, value, system(row))
        for row in range(len(rows.ends) - 1):
            before, after = rows.codes[row : row + 2]
            if rows.ends[row] == k and abs(before[k]) == 1 and after[k] == STUCK:
                speed = self._jump_at(osc, before, after, jnp.asarray(rows.z[row + 1, :3]))
                if speed is not None:
                    touching = rows.ending(row, names.tangent + k)
                    yield Beginning(touching, speed**2, system(row))

    def _jump_at(self, osc: Oscillator, before: Any, after: Any, y: Array) -> float | None:
        """|r'| where the mass comes to the boundary and begins to stick; None where the law of
        friction does not jump, so that a mass that only touched would not stick."""
        excess, _ = _excess(osc, jnp.asarray(after), y)
        slopes = _guard_slopes(osc, jnp.asarray(before), y)
        speed = abs(float(slopes[self.belt]))
        return speed if -float(excess) > speed + SMALLEST_JUMP else None

    @staticmethod
    def _may_end(rows: ArcRows, row: int, belt: int) -> bool:
        """Whether an arc is a stick phase to a belt (and others of its velocity) after which the
        mass slips on in the mode before it."""
        codes = rows.codes[row - 1 : row + 2]
        before, here, after = codes[:, belt]
        differ = codes[:, np.any(codes != codes[:, [belt]], axis=0)]
        alone = (
            here == STUCK and before == after and abs(before) == 1 and not np.ptp(differ, 0).any()
        )
        onset = Ends(rows.codes.shape[1]).onset
        return bool(alone and rows.ends[row - 1] == belt and rows.ends[row] == onset)


class _AtArrival(AbstractForcedCondition):
    belt: int
    rises: ClassVar[float]

    def beginnings_of(self, osc, motion, known=False):
        rows, k, way = ArcRows.of(motion), int(self.belt), jnp.asarray(self.rises)

        soon = _short_crossings(rows)

        def system(row, held):
            return lambda chain: AtLimit(chain, jnp.asarray(row), held, way)

        for row in range(len(rows.ends) - 1):
            before, after = rows.codes[row], rows.codes[row + 1]
            if rows.ends[row] != k or np.any(before == STUCK) or abs(before[k]) != 1:
                continue
            changed = (before != after) & (np.abs(after) < 2)
            held = jnp.asarray(np.where(changed, STUCK, after))
            distance, rises = _excess(osc, held, jnp.asarray(rows.z[row + 1, :3]))
            if not (known or float(rises) * self.rises > 0 or abs(float(distance)) > 0.1):
                continue
            yield Beginning(rows, abs(float(distance)), system(row, held))
            if row in soon:
                # The excursion may vanish at the point; those of a symmetric motion do so together.
                gone = rows.z[row + 1, 3]
                alike = [r for r in soon if abs(rows.z[r + 1, 3] - gone) <= ALIKE_ARCS * gone]
                for some in [alike, [row]] if len(alike) > 1 else [[row]]:
                    at = row - sum(r < row for r in some)
                    there = _without_crossings(rows, some)
                    yield Beginning(there, max(abs(float(distance)), gone), system(at, held))


def _short_crossings(rows: ArcRows) -> list[int]:
    """Rows of arcs after which the mass crosses the boundary of a belt, comes back, and sticks."""
    found = []
    for row, belt in enumerate(rows.ends[:-2].tolist()):
        if belt < rows.codes.shape[1] and rows.ends[row + 1] == belt:
            before, beyond, after = rows.codes[row : row + 3, belt]
            if abs(before) == 1 and beyond == -before and after == STUCK:
                found.append(row)
    return found


def _without_crossings(rows: ArcRows, some: list[int]) -> ArcRows:
    """The arcs without the excursions after the rows `some`: the mass sticks there at once."""
    for row in reversed(some):
        gone, phase = rows.z[row + 1], rows.z[row + 2]
        longer = np.append(gone[:3], phase[3] + gone[3])
        rows = rows.put(row + 1, row + 2, (rows.codes[row + 2], rows.ends[row + 2], longer))
    return rows


@jit
def _excess(osc: Oscillator, codes: Array, y: Array) -> tuple[Array, Array]:
    """Force needed to stick minus what the stuck belts can hold, and its rate of change."""
    mode = mode_of(codes)
    at = guards_trend(osc, mode, y)
    value, slope = at.value[-2:], at.slope[-2:]
    nearest = jnp.argmin(value)
    return -value[nearest], -slope[nearest]


@jit
def _guard_slopes(osc: Oscillator, codes: Array, y: Array) -> Array:
    return guards_trend(osc, mode_of(codes), y).slope


class TimedCrossing(_AtArrival):
    """`CrossingSliding` with a clock; public: that class."""

    public: type[AbstractCondition] = eqx.field(static=True)

    rises: ClassVar[float] = 1.0


class SwitchingSliding(_AtArrival):
    """A motion arrives at the boundary of a belt where it could just begin to stick.

    The force that is needed to stick falls there: to one side of the point the mass sticks at once,
    to the other it crosses the boundary, comes back soon, and sticks then. Where the belt's static
    friction is above its kinetic friction it does not come back soon: the motion ends at the point,
    on whichever side it is.

    Args:
        belt: Number of the belt.
    """

    caption: ClassVar[str] = "switching-sliding, belt {belt}"
    line: ClassVar[Line] = Line("switching-sliding", "#D55E00")
    rises: ClassVar[float] = -1.0


class AddingSliding(AbstractForcedCondition):
    """Inside a stick phase the force that is needed touches what the belt can hold.

    Beyond the point there are two phases: in between the mass slips and sticks again. Where the
    belt's static friction is above its kinetic friction the slip is not short; then a phase that
    ends in slip onset only touches the limit at the point, and goes on beyond the point.

    Args:
        belt: Number of the belt.
    """

    belt: int

    caption: ClassVar[str] = "adding-sliding, belt {belt}"
    line: ClassVar[Line] = Line("adding-sliding", "#56B4E9", (0, (5, 1.5)))

    def beginnings_of(self, osc, motion, known=False):
        rows, k = ArcRows.of(motion), int(self.belt)
        names = Ends(rows.codes.shape[1])

        def system(row, codes):
            held, any_way = jnp.asarray(codes), jnp.zeros(())
            return lambda chain: AtLimit(chain, jnp.asarray(row), held, any_way)

        if known:
            row = int(np.flatnonzero(rows.ends == names.nearest_limit)[0])
            yield Beginning(rows, 0.0, system(row, rows.codes[row]))
            return
        short = []
        for row in range(1, len(rows.ends) - 1):
            before, here, after = rows.codes[row - 1 : row + 2]
            alone = before[k] == STUCK and np.all(before == after) and abs(here[k]) == 1
            if alone and rows.ends[row - 1] == names.onset and rows.ends[row] == k:
                short.append(row)
        for shorter, row, value in without_one_of(rows, short, names.nearest_limit):
            yield Beginning(shorter, value, system(row, shorter.codes[row]))
        for row, since, state, value in minima_of_guards(osc, motion, slice(-2, None)):
            if rows.codes[row, k] == STUCK:
                cut = rows.cut(row, since, state, names.nearest_limit)
                yield Beginning(cut, value, system(row, rows.codes[row]))
        for row in range(len(rows.ends) - 1 if friction_jumps(osc.belts[k].friction) else 0):
            here, after = rows.codes[row : row + 2]
            if rows.ends[row] == names.onset and here[k] == STUCK and abs(after[k]) == 1:
                _, rate = _excess(osc, jnp.asarray(here), jnp.asarray(rows.z[row + 1, :3]))
                touching = rows.ending(row, names.nearest_limit)
                yield Beginning(touching, float(rate) ** 2, system(row, here))


def without_one_of(
    rows: ArcRows, short: list[int], end: int, others: Sequence[int] = ()
) -> Iterator[tuple[ArcRows, int, float]]:
    """The arcs without one of the `short` ones, cut there by `end`; the row that is cut; and the
    square of the duration that is left out.

    Arcs of one duration are left out together first: those of a symmetric motion vanish at once,
    and one touches only where the others do. others: arcs of other kinds, of any duration, that may
    vanish at once with these, as those of two belts do where a motion touches both boundaries.
    """
    for row in short:
        duration, alike = rows.z[row, 3], [row]
        for i in short:
            # Of neighbouring arcs only one is left out: it lies between the other ones.
            beside = any(abs(i - k) < 2 for k in alike)
            if not beside and abs(rows.z[i, 3] - duration) < ALIKE_ARCS * duration:
                alike.append(i)
        near = [i for i in others if rows.z[i, 3] < 1 / ALIKE_ARCS * duration]
        near = [i for i in near if not any(abs(i - k) < 2 for k in alike)]
        some = [[*alike, *near], alike, [row]]
        for gone in [one for i, one in enumerate(some) if one not in some[:i]]:
            shorter = rows
            for i in sorted(gone, reverse=True):
                shorter = shorter.without(i, end if i == row else None)
            yield shorter, row - 1 - 2 * sum(i < row for i in gone), float(duration) ** 2


def minima_of_guards(osc: Oscillator, motion: PeriodicMotion, some: slice) -> Iterator[tuple]:
    """Minima inside of arcs of the guards in the slice `some` of their order: the row, the time
    since the entry of the arc, the state (x1, x2, t), and the value of the guard there."""
    found = guards_along(osc, motion.chain, motion.unknowns)
    states, value, slope = map(np.asarray, found)
    for row in np.flatnonzero(np.asarray(motion.chain.used)).tolist():
        for values, slopes in zip(value[row].T[some], slope[row].T[some], strict=True):
            times = states[row, :, 2]
            falls = (slopes[:-1] < 0) & (slopes[1:] > 0) & np.isfinite(values[:-1])
            for i in np.flatnonzero(falls & (np.diff(times) > 0)).tolist():
                part = slopes[i] / (slopes[i] - slopes[i + 1])
                state = states[row, i] + part * (states[row, i + 1] - states[row, i])
                since = float(state[2] - times[0])
                # At slip onset a guard begins at a minimum, and its slope is rounding there.
                if since > AT_ONSET * (times[-1] - times[0]):
                    yield row, since, state, abs(float(min(values[i], values[i + 1])))
