"""Circle maps of sticking motions: from the phase of one slip onset to that of the next.

At slip onset x2 is the belt's velocity, and x1 follows from needed = +-capacity: the phase of the
clock determines the whole state. So the sticking motions of a forced oscillator are orbits of a map
of the circle. One sweep follows an onset at each of many phases to the next one at the same
belt and limit, with a tangent along the run, which gives the map's slope. The map jumps where a
stick phase is skipped, and its slope is singular beside a jump. Its fixed points are periodic
motions, which `periodic` solves for.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..activity import announced
from ..checks import (
    as_positive,
    as_tolerance,
    as_whole,
    check_belt,
    outside_of_traces,
    require,
    require_value,
)
from ..cycles.clocked import forcing_period, turns_of
from ..cycles.followed import PERIODS_AT_ONCE
from ..cycles.periodic import PeriodicMotion, periodic_from
from ..kernel.clocked import of_lanes
from ..kernel.lanes import Observer, Variable
from ..model.forcing import Oscillating
from ..model.instants import are_mates, field_at, is_faster
from ..model.modes import BELOW, STUCK, Mode, capacity, edges, mode_acceleration
from ..model.oscillator import Oscillator, at_time, check_clock, check_oscillator
from ..model.own_units import OwnOscillator, in_given_units, in_units_of_run
from ..motion.arcs import Ends
from ..motion.simulate import SIMULATION_TOLERANCE, simulate
from ..numerics.compiling import jit, power_of_two, where_any
from ..results import Status, draw
from ..tables import table_of
from .growth import Growth, course_of_step, delay_of_event, grown, grown_past
from .runs_in_memory import results_from

if TYPE_CHECKING:
    import pandas

#: Parts into which an interval is cut where the map changes much; parts into which one with a fixed
#: point is cut, and how often: to 1e-6 of its length.
PARTS_OF_INTERVAL, PARTS_OF_CUT, CUTS = 32, 4, 10
#: Intervals over which the periods to the next onset change by more than this, or at one end of
#: which no onset follows, are searched for fixed points with finer phases.
ROUGH = 0.02
#: Smallest number of phases for which onset states are computed, so that few shapes are compiled.
FEWEST_PHASES = 1024
#: The rise of the map over the last interval around a fixed point is below this part of its rise
#: over the first one where the map is continuous, even beside a square root, not where it jumps.
STILL_RISES = 0.1
#: Longest step with a tangent: slopes then have relative errors of some 1e-7.
LONGEST_WITH_TANGENT = 0.1
#: The onset of a solved motion has to lie in its interval up to this phase.
SAME_PHASE = 1e-6


class CircleMap(eqx.Module):
    """The phases of slip onset, and those of the next one; what `circle_map` returns.

    Attributes:
        phases: Phases of the clock, evenly spaced in [0, 2 pi), [n].
        elapsed: Times from an onset at each phase to the next one (the `iterate`-th next one), [n];
            NaN where no onset can be at this phase, or none follows.
        slopes: Derivatives of the map, [n].
        is_onset: Whether a stick phase can end at this limit, for each phase, [n].
        fixed_points: Phases that the map takes to themselves, increasing.
        motions: The periodic motion of each of them.
        unsolved: Phases of further fixed points, found by a change of sign, for which Newton's
            method found no motion.
        period: Period of the clock.
        belt: Number of the belt.
        limit: 1 where needed = capacity at the onsets, so that the mass runs ahead of the belt, -1
            where needed = -capacity, and it falls behind.
        iterate: k, where the map leads to the k-th next onset.
    """

    phases: np.ndarray
    elapsed: np.ndarray
    slopes: np.ndarray
    is_onset: np.ndarray
    fixed_points: np.ndarray
    motions: tuple[PeriodicMotion, ...]
    unsolved: np.ndarray
    period: float
    belt: int = eqx.field(static=True)
    limit: int = eqx.field(static=True)
    iterate: int = eqx.field(static=True, default=1)

    @property
    def next_phases(self) -> np.ndarray:
        """The phases of the next onset, in [0, 2 pi), [n]."""
        return self._lift % (2 * np.pi)

    @property
    def periods(self) -> np.ndarray:
        """How often the clock passes the phase 0 before the next onset, [n]."""
        return self._lift // (2 * np.pi)

    @property
    def _lift(self) -> np.ndarray:
        return self.phases + 2 * np.pi * self.elapsed / self.period

    @property
    def multipliers(self) -> np.ndarray:
        """Of each motion the multiplier that is not 0: the slope of the first iterate of the map
        that takes its phase to itself."""
        return np.array([float(one.multipliers[0].real) for one in self.motions])

    @property
    def stable(self) -> np.ndarray:
        """Which of the fixed points are stable."""
        return np.array([bool(one.stable) for one in self.motions], bool)

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each phase and each fixed point, by phase.

        Columns: phase, next_phase, periods (how often the clock passes the phase 0 before the next
        onset; of a fixed point those of its motion), slope (of a fixed point its multiplier),
        is_onset, fixed_point. NaN where no onset follows.
        """
        fixed = np.repeat([False, True], [len(self.phases), len(self.motions)])
        columns = {
            "phase": (self.phases, self.fixed_points),
            "next_phase": (self.next_phases, self.fixed_points),
            "periods": (self.periods, [float(one.periods) for one in self.motions]),
            "slope": (self.slopes, self.multipliers),
            "is_onset": (self.is_onset, [True] * len(self.motions)),
        }
        rows = {name: np.concatenate(parts) for name, parts in columns.items()}
        order = np.argsort(rows["phase"], kind="stable")
        rows = {name: column[order] for name, column in rows.items()}
        return table_of({**rows, "is_onset": rows["is_onset"] > 0, "fixed_point": fixed[order]})

    def plot(self, ax: Any = None) -> Any:
        """Draws the map over the circle, with gaps where it jumps, and its fixed points: filled
        where they are stable.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        sign = "" if self.limit > 0 else "-"
        iterate = f", iterate {self.iterate}" if self.iterate > 1 else ""
        known = int(np.sum(np.isfinite(self.elapsed)))
        rows = zip(self.fixed_points, self.motions, self.stable, self.multipliers, strict=True)
        names = "; ".join(
            f"{phase:.6g} ({motion.periods} periods, {'' if is_stable else 'un'}stable, multiplier "
            f"{multiplier:.6g})"
            for phase, motion, is_stable, multiplier in rows
        )
        missed = f", {len(self.unsolved)} not solved for" if len(self.unsolved) else ""
        return (
            f"CircleMap(belt {self.belt}, needed = {sign}capacity{iterate}, {known} of "
            f"{len(self.phases)} phases lead on, fixed points: {names or 'none'}{missed})"
        )


@announced("circle_map")
@outside_of_traces
def circle_map(
    osc: Oscillator,
    belt: int = 0,
    *,
    limit: int | None = None,
    iterate: int = 1,
    n: int = 400,
    periods: int = PERIODS_AT_ONCE,
    rtol: ArrayLike = SIMULATION_TOLERANCE,
    atol: ArrayLike | None = None,
) -> CircleMap:
    """The circle map of the sticking motions of a forced oscillator, with its fixed points.

    It takes the phase of a slip onset to that of the next onset at the same belt and limit, in
    whatever ways the mass slips, crosses, and sticks elsewhere in between. The phase is that of the
    clock, 2 pi t / T, T the common period of all forces, velocities and loads. Fixed points are
    motions that repeat after one onset; they are searched where the map crosses the diagonal
    between two of the n phases, or, where it is steep or jumps, between phases a thirty-second of
    that apart. So two fixed points nearer to one another are missed, and so are most of those
    where jumps accumulate.

    Args:
        osc: An `Oscillator` with forcing.
        belt: Number of the belt that the mass sticks to.
        limit: 1 where stick phases end with needed = capacity, so that the mass runs ahead of the
            belt, -1 where needed = -capacity, and it falls behind. None: the limit to which a
            steady belt carries the mass, -1 where its (mean) velocity is positive, else 1.
        iterate: With k the map is taken to the k-th next onset: its fixed points are then motions
            that repeat after k onsets, too, each at k phases.
        n: Number of phases, evenly spaced, 0 among them.
        periods: Number of periods, 32 at most, within which the next onset has to follow; else
            `elapsed` is NaN.
        rtol: Relative tolerance of a step.
        atol: Absolute tolerance of a step; None: 1e-8 of the oscillator's own size.

    Returns:
        The `CircleMap`.

    Raises:
        ValueError: If an argument is impossible; if the frequencies have no common period; if the
            contact interval of another belt begins or ends within that of this one, as x1 would
            then not follow from the phase.

    Example:
        found = jb.circle_map(jb.presets.di_bernardo(1.68))
        found.fixed_points, found.multipliers, found.motions
    """
    check_oscillator(osc)
    check_clock(osc, "circle_map", "jb.find_cycle, as sticking cycles have the multiplier 0")
    check_belt(belt, len(osc.belts))
    is_side = limit is not None and np.ndim(limit) == 0 and limit in (-1, 1)
    fits = limit is None or (is_side and not isinstance(limit, bool))
    require_value(fits, "limit", "1, -1 or None", limit)
    n, iterate = as_whole(n, "n", 2), as_whole(iterate, "iterate")
    periods = as_whole(periods, "periods")
    require(periods <= PERIODS_AT_ONCE, "periods", f"at most {PERIODS_AT_ONCE}", periods)
    numbers = {"rtol": as_positive(rtol, "rtol"), "atol": as_tolerance(atol, "atol")}
    velocity, load = (
        float(wave.mean if isinstance(wave, Oscillating) else wave)
        for wave in (osc.belts[belt].velocity, osc.belts[belt].load)
    )
    held, came = load * float(osc.belts[belt].friction.static), f"belt {belt}"
    require(held > 0, "belt", "one with a load and static friction above 0", came)
    others = range(len(osc.belts))
    clear = all(_touches_wherever(osc, i, belt) or _keeps_off(osc, i, belt) for i in others)
    expected = "one within whose contact no contact of another belt begins or ends"
    require(clear, "belt", expected, came)
    limit = limit or (-1 if velocity > 0 else 1)
    own, turns = in_units_of_run(osc), turns_of(osc)
    mapping = _Mapping(own, turns, belt, limit, iterate, periods, numbers)
    phases = 2 * np.pi * np.arange(n) / n
    found = mapping.of_phases(phases)
    places, motions, unsolved = mapping.fixed_points(phases, found["turns"])
    return CircleMap(
        phases=phases,
        elapsed=found["turns"] * mapping.period,
        slopes=found["slope"],
        is_onset=found["is_onset"],
        fixed_points=places,
        motions=tuple(in_given_units(one, osc, own) for one in motions),
        unsolved=unsolved,
        period=mapping.period,
        belt=belt,
        limit=limit,
        iterate=iterate,
    )


def _touches_wherever(osc: Oscillator, i: int, belt: int) -> Any:
    """Whether belt i touches the mass wherever belt `belt` does."""
    ends, n = edges(osc), len(osc.belts)
    return (ends[i] <= ends[belt]) & (ends[n + i] >= ends[n + belt])


def _keeps_off(osc: Oscillator, i: int, belt: int) -> Any:
    """Whether belt i touches the mass nowhere where belt `belt` does."""
    ends, n = edges(osc), len(osc.belts)
    return (ends[i] >= ends[n + belt]) | (ends[n + i] <= ends[belt])


# --- the state at slip onset ----------------------------------------------------------------------


def _onset_state(osc: OwnOscillator, belt: int, limit: Any, t: Array) -> tuple[Array, Array]:
    """The state (x1, x2) of a mass that is stuck to a belt at its limit, at the time t."""
    now = at_time(osc, t)
    velocities = [one.velocity for one in now.belts]
    codes = []
    for i, velocity in enumerate(velocities):
        rises = velocity - velocities[belt]
        sign = jnp.where(rises == 0, is_faster(osc, i, belt, t), jnp.sign(rises))
        touching = jnp.where(are_mates(osc, i, belt), STUCK, sign)
        codes.append(jnp.where(_touches_wherever(osc, i, belt), touching, BELOW))
    mode, x2 = Mode(tuple(codes)), velocities[belt] / osc.omega
    needed = mode_acceleration(now, mode, jnp.zeros_like(t), x2)  # at x1 = 0
    return needed - limit * capacity(now, mode), x2 + jnp.zeros_like(t)


@jit
def _onset_states(osc: OwnOscillator, belt: int, limit: Array, t: Array) -> Array:
    """`_onset_state` at times [n], [2, n]."""
    return jax.vmap(lambda t: jnp.stack(_onset_state(osc, belt, limit, t)), out_axes=1)(t)


class _ToNextOnset(eqx.Module):
    """Memory of the observer, arrays [lanes].

    growth: the tangent, the derivative of the state by the time of the first onset; sign: sign of
    the slip that begins there, 0 where none begins; elapsed: time from the first onset to the next,
    NaN before that; slope: derivative of the time of the next onset by that of the first.
    """

    growth: Growth
    sign: Array
    elapsed: Array
    slope: Array


class NextOnset(Observer):
    """Observer of a run from a slip onset to the next one at the same belt and limit, its end.

    Steps are short, because the tangent is integrated with a lower order than the state.
    """

    variables: ClassVar[Mapping[str, Variable]] = {
        "elapsed": Variable("time from onset to onset"),
        "slope": Variable("its derivative by the time of the first, and 1"),
        "sign": Variable("of the slip that the run begins with, 0 where it sticks", "int8"),
    }
    steps_while_stuck: ClassVar[bool] = True
    belt: int = eqx.field(static=True)

    def start(self, osc, lanes):
        code = lanes.mode.codes[self.belt]
        sign = jnp.where(jnp.abs(code) == 1, code, 0.0)

        def tangent(osc, mode, sign, t):
            """Derivative of the state at a fixed time by the time of the onset."""
            one = jnp.ones_like(t)
            y, moved = jax.jvp(lambda t: _onset_state(osc, self.belt, -sign, t), (t,), (one,))
            rates = field_at(osc, mode, (*y, t))
            return moved[0] - rates[0], moved[1] - rates[1]

        d1, d2 = of_lanes(tangent, osc, lanes.mode, sign, lanes.t)
        growth = replace(Growth.none(lanes), d1=d1, d2=d2)
        nan = jnp.full_like(lanes.t, jnp.nan)
        return _ToNextOnset(growth, sign, nan, nan)

    def follow(self, take_step, osc, window, ones, lanes, t1, rtol, atol):
        window = replace(window, longest=jnp.minimum(window.longest, LONGEST_WITH_TANGENT))
        new = take_step(osc, window, ones, lanes, t1, rtol, atol)
        course = course_of_step(osc, lanes, new, ones)
        growth = grown(osc, lanes.memory.growth, lanes, course, course.duration, ones)
        return replace(new, memory=replace(lanes.memory, growth=growth))

    def watch(self, osc, lanes, passage, ones, t1, tol):
        seen: _ToNextOnset = lanes.memory
        growth = seen.growth
        at_limit = passage.number == jnp.where(seen.sign < 0, 0, 1) + 3 * len(osc.belts)
        here = passage.fired & passage.before.stuck[self.belt] & at_limit & (seen.sign != 0)

        def late():
            state = (passage.x1, passage.x2, passage.t), (growth.d1, growth.d2)
            return of_lanes(delay_of_event, osc, passage.before, passage.number, *state)

        slope = where_any(here, late, jnp.zeros_like(lanes.t)) * jnp.exp(growth.log)
        memory = _ToNextOnset(
            grown_past(osc, growth, lanes, passage, t1),
            seen.sign,
            jnp.where(here, passage.t - growth.began, seen.elapsed),
            jnp.where(here, slope, seen.slope),
        )
        forever = lanes.status == Status.STUCK_FOREVER.value
        return replace(lanes, memory=memory, done=lanes.done | here | forever | (seen.sign == 0))

    def finish(self, osc, lanes):
        seen: _ToNextOnset = lanes.memory
        good = lanes.status == Status.OK.value
        return {
            "elapsed": jnp.where(good, seen.elapsed, jnp.nan),
            "slope": jnp.where(good, seen.slope, jnp.nan),
            "sign": seen.sign,
            "status": lanes.status,
        }


# --- the map and its fixed points -----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Mapping:
    """The map of an oscillator in own units. turns: `common_turns`; numbers: rtol and atol."""

    own: OwnOscillator
    turns: int
    belt: int
    limit: int
    iterate: int
    periods: int
    numbers: dict[str, Any]

    @property
    def period(self) -> float:
        """The period of the clock."""
        return float(forcing_period(self.own, self.turns))

    def states(self, phases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Times of the phases in the first period, [n], and the onset states then, [2, n]."""
        t, limit = phases / (2 * np.pi) * self.period, jnp.asarray(float(self.limit))
        # Padded to a power of two, so that few shapes are compiled.
        padded = jnp.asarray(np.resize(t, power_of_two(len(t), FEWEST_PHASES)))
        return t, np.asarray(_onset_states(self.own, self.belt, limit, padded))[:, : len(t)]

    def of_phases(self, phases: np.ndarray) -> dict[str, np.ndarray]:
        """For onsets at phases, [n] each: turns, the periods to the next onset; slope; is_onset."""
        whole = self._once(phases)
        for _ in range(self.iterate - 1):
            found = self._once((phases + 2 * np.pi * whole["turns"]) % (2 * np.pi))
            whole["turns"] = whole["turns"] + found["turns"]
            whole["slope"] = whole["slope"] * found["slope"]
        late = ~(whole["turns"] <= self.periods)
        whole["turns"][late] = whole["slope"][late] = np.nan
        return whole

    def _once(self, phases: np.ndarray) -> dict[str, np.ndarray]:
        t, states = self.states(phases)
        starts = np.concatenate([np.asarray(self.own.units.length) * states, t[None]])
        t1 = (2 + self.periods) * self.period
        found = results_from(self.own, NextOnset(self.belt), starts, **self.numbers, t1=t1)
        is_onset = found["sign"] == -self.limit
        turns, slope = (np.where(is_onset, found[name], np.nan) for name in ("elapsed", "slope"))
        return {"turns": turns / self.period, "slope": slope, "is_onset": is_onset}

    def fixed_points(
        self, phases: np.ndarray, turns: np.ndarray
    ) -> tuple[np.ndarray, list[PeriodicMotion], np.ndarray]:
        """Phases of fixed points in order, their motions, and phases of unsolved ones."""
        found: list[tuple[float, PeriodicMotion]] = []
        unsolved = []
        ends = (np.append(phases, 2 * np.pi), np.append(turns, turns[0]))
        ends = [np.stack([one[:-1], one[1:]], axis=1) for one in ends]
        known = np.isfinite(ends[1])
        # A branch of the map may begin or end between a fixed point and the next phase.
        rough = np.any(known, axis=1) & ~(np.abs(np.ptp(ends[1], axis=1)) <= ROUGH)
        parts = (
            _crossings(*(one[~rough] for one in ends)),
            _crossings(*self._between(ends[0][rough], ends[1][rough], PARTS_OF_INTERVAL)),
        )
        places, values, counts, _ = (np.concatenate(both) for both in zip(*parts))
        first = np.abs(np.diff(values))[:, 0]
        for _ in range(CUTS):
            inner = self._between(places, values, PARTS_OF_CUT)
            places, values, counts, rows = _crossings(*inner, counts)
            first = first[rows]
        goes_on = np.abs(np.diff(values))[:, 0] < STILL_RISES * first
        for (low, high), count, is_point in zip(places, counts, goes_on):
            if not is_point:
                continue
            motion, onsets = self._motion(0.5 * (low + high), int(count))
            off = (onsets - low + SAME_PHASE) % (2 * np.pi)
            here = onsets[off <= high - low + 2 * SAME_PHASE]
            if motion is not None and len(here):
                found.append((here[0], motion))
            else:
                unsolved.append(low % (2 * np.pi))
        found.sort(key=lambda one: one[0])
        places = np.array([place for place, _ in found])
        return places, [motion for _, motion in found], np.array(unsolved)

    def _between(
        self, ends: np.ndarray, values: np.ndarray, parts: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Phases that cut intervals into equal parts, and the periods to the next onsets.

        ends, values: phases and periods at both ends of the intervals, [rows, 2]. Returns two
        arrays [rows, parts + 1].
        """
        shares = np.arange(parts + 1) / parts
        places = ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * shares
        inner = self.of_phases(places[:, 1:-1].ravel())["turns"].reshape(-1, parts - 1)
        return places, np.concatenate([values[:, :1], inner, values[:, 1:]], axis=1)

    def _motion(self, phase: float, periods: int) -> tuple[PeriodicMotion | None, np.ndarray]:
        """The motion that repeats after `periods` periods near an onset at `phase`, or None, and
        the phases of its onsets at the belt and limit."""
        (t,), states = self.states(np.array([phase]))
        cuts = self.period * np.arange(1, PERIODS_AT_ONCE + 1)
        run = simulate(self.own, states[:, 0], cuts[-1], t0=t, ts=cuts)
        start = np.asarray(run.ys[0])
        if not np.all(np.isfinite(start)):
            return None, np.zeros(0)
        motion = periodic_from(self.own, start, periods, self.turns)
        if int(motion.status) != Status.OK:
            return None, np.zeros(0)
        used = np.asarray(motion.chain.used)
        codes = np.asarray(motion.chain.codes)[used][:, self.belt]
        ends = np.asarray(motion.chain.ends)[used] == Ends(len(self.own.belts)).onset
        here = ends & (codes == STUCK) & (np.roll(codes, -1) == -self.limit)
        onsets = 2 * np.pi * np.roll(np.asarray(motion.unknowns)[used, 2], -1)[here] / self.period
        # A motion with fewer onsets than `iterate` repeats after proportionally fewer periods.
        fits = motion.periods * self.iterate == periods * len(onsets)
        return (motion, onsets) if fits else (None, onsets)


def _crossings(phases: np.ndarray, turns: np.ndarray, counts: Any = None) -> list[np.ndarray]:
    """Intervals between phases, [rows, k], in which `turns` passes a whole number of periods:
    phases at both ends, turns there, that number, and the row. counts: the only whole number to
    look for in each row, [rows]; None: all."""
    before, after = turns[:, :-1], turns[:, 1:]
    known, found = np.isfinite(before) & np.isfinite(after), []
    for m in range(1, PERIODS_AT_ONCE + 1):
        passes = known & ((before >= m) != (after >= m))
        rows, i = np.nonzero(passes if counts is None else passes & (counts == m)[:, None])
        ends, values = (
            np.stack([one[rows, i], one[rows, i + 1]], axis=1) for one in (phases, turns)
        )
        found.append((ends, values, np.full(len(rows), m), rows))
    return [np.concatenate(parts) for parts in zip(*found, strict=True)]
