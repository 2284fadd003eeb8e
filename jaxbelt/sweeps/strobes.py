"""The observer of attractors of forced runs, from their states once in each period of the forcing.

At these moments, the strobes, all forces, velocities and loads are as they were a period before: a
motion repeats if its state at a strobe is that at an earlier one. `ForcedAttractor` looks for such
repeats and ends a run as soon as one is certain. Where there is none until the end of the run, its
largest exponent decides.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..cycles.settling import way_left
from ..kernel.lanes import Lanes, Observer, Variable, choose, materialise
from ..model.instants import blur
from ..model.oscillator import clock_frequency, common_turns, repeating
from ..model.own_units import OwnOscillator
from ..numerics.implicit import step_to_root
from ..results import Status
from .attractor import EQUILIBRIUM, STUCK_FOR_EVER, UNDECIDED, Attractor
from .growth import UNMEASURED, Growth, course_of_step, grown, grown_past
from .moments import LEAST_CUT, Course
from .winding import Winding

#: Kinds of attractors of forced oscillators, in the order of their codes.
FORCED_KINDS = ("undecided", "equilibrium", "periodic", "stuck", "quasiperiodic", "chaotic")
PERIODIC, QUASIPERIODIC, CHAOTIC = 2, 4, 5
#: Internal code of a motion in a continuum of such; `finish` reports it as undecided.
FORCED_CONTINUUM = len(FORCED_KINDS)
#: Results that `Attractor` has, too.
OF_LOOPS_AND_MOTIONS = (
    "sticks",
    "period",
    "stick_duration",
    "x1_min",
    "x1_max",
    "x2_min",
    "x2_max",
)

#: States at two strobes are the same if they differ by less than this, over the size of the motion.
SAME = 1e-6
#: Differences below this many tolerances of a step count as errors of integration.
ERRORS = 10.0
#: Strobes, and twice its period at least, over which a motion must repeat to count as periodic.
CONFIRMED = 16
#: Two points of a motion are distinct if they differ by more than APART times the rest of its
#: approach plus APART_OF_ERRORS times the errors.
APART, APART_OF_ERRORS = 10.0, 1000.0
#: Strobes for which the first reference state is kept without a repeat; each next one twice as
#: long as the last.
FIRST_PATIENCE = 8
#: An exponent is zero within so many standard errors, or within its error of computation per
#: period; for a quasiperiodic motion the larger of the two has to be below RESOLVED per period.
DEVIATIONS, COMPUTED, RESOLVED = 3.0, 1e-12, 0.01
#: Largest relative difference between the two halves of a run in the largest distance from the
#: origin, quasiperiodic and chaotic; beyond it the motion has not settled, or grows without bound.
STEADY, STEADY_CHAOS = 0.01, 0.2
#: Least growth of a tangent, its logarithm, while the exponent of chaos is measured: a motion that
#: itself grew as much would be seen to grow.
GROWTH_OF_CHAOS = 10.0
#: Growth of a tangent, its logarithm, that is rounding; its error per unit of time, which hardly
#: depends on the tolerance: 4e-6 were seen with steep laws of friction, 1e-9 with Coulomb's. The
#: modulus of complex multipliers follows from areas, in which errors are smaller.
STILL, ERRORS_OF_GROWTH, ERRORS_OF_AREAS = 1e-9, 1e-5, 1e-7
#: Share of the time without sticking, and difference of states, that count as rounding.
CARRIED, STANDS_STILL = 1e-9, 1e-13
#: An extremum is computed from a point this near in time; steps are cut until there is one. Where
#: x2 or its slope changes by less than HARDLY_CHANGES, times `blur` and the size of the motion, in
#: a quarter of a step, an apparent extremum is rounding, as in a stick phase.
NEAR_EXTREMUM, HARDLY_CHANGES = 1e-3, 1e-13


class _Repeats(eqx.Module):
    """The search for a repeat, arrays [lanes].

    x1, x2: the reference state, of the strobe `at`; patience: strobes without a repeat after which
    it is replaced; n: strobes after which the motion seems to repeat, 0: none yet; confirmed:
    strobes over which it has; asked: `confirmed` when half of the strobes needed were over, 0:
    before; log, d1, d2: growth and direction of the tangent at that time; moved: distance of the
    last repeat from its reference state; nearest: smallest distance of a strobe in between.
    """

    x1: Array
    x2: Array
    at: Array
    patience: Array
    n: Array
    confirmed: Array
    asked: Array
    log: Array
    d1: Array
    d2: Array
    moved: Array
    nearest: Array


class _Extent(eqx.Module):
    """The motion since the reference state of `_Repeats`, arrays [lanes].

    low, high: least and largest (x1, x2); sticks: time stuck to each belt; events, rises: number of
    events, and `Winding.rises_begun`, at that state; top: (x1, x2) at the strobe of largest x1.
    """

    low: tuple[Array, Array]
    high: tuple[Array, Array]
    sticks: tuple[Array, ...]
    events: Array
    rises: Array
    top: tuple[Array, Array]

    @classmethod
    def none(cls, lanes: Lanes, belts: int, rises: Array) -> "_Extent":
        zero, state = jnp.zeros_like(lanes.t), (lanes.x1, lanes.x2)
        return cls(state, state, (zero,) * belts, lanes.events, rises, (zero - jnp.inf, zero))

    def with_point(self, x1: Array, x2: Array) -> "_Extent":
        lows = zip(self.low, (x1, x2), strict=True)
        highs = zip(self.high, (x1, x2), strict=True)
        low = tuple(jnp.minimum(a, b) for a, b in lows)
        high = tuple(jnp.maximum(a, b) for a, b in highs)
        return replace(self, low=low, high=high)


class _RunSoFar(eqx.Module):
    """Memory of the observers, arrays [lanes].

    strobes: number of the next strobe, counted from t = 0; turns: periods of the clock between two
    strobes, see `common_turns`, 0: the frequencies have no common period. farthest: largest
    distance from the origin in each half of the time in which exponents are measured. kind,
    periods, loop_events, loop_rises: of the attractor, once known; transient: the time then.
    """

    strobes: Array
    turns: Array
    repeats: _Repeats
    extent: _Extent
    farthest: tuple[Array, Array]
    growth: Growth
    winding: Winding
    kind: Array
    periods: Array
    loop_events: Array
    loop_rises: Array
    transient: Array


class ForcedAttractor(Observer):
    """Observer of the attractor that a forced run leads to; the run ends once it is known.

    - A periodic motion: its states at strobes repeat, all of them, over `CONFIRMED` strobes and two
      of its periods; no state in between is the same; the rest of the approach, by the rate at
      which it shrinks, is below `SAME` of its size; and multipliers show that it attracts.
    - None of these: one of a continuum of motions, where a tangent keeps its size while the motion
      repeats, or over the whole run. It attracts nothing: the run ends undecided, NEUTRAL.
    - Stuck for ever, or at rest on an edge that pushes back from both sides at all times.
    - Where no repeat is found until the end of the run its largest exponent decides: the motion is
      chaotic where the exponent is more than three standard errors above zero, quasiperiodic where
      it is zero within these, nothing seems to repeat, and the mass never sticks or the maxima of
      x1 keep their order on the circle of phases. Else it is undecided, with the status
      NOT_SETTLED; so is a motion that still grows or shrinks.
    """

    variables: ClassVar[Mapping[str, Variable]] = {
        "kind": Variable("what the run leads to", "int8", meanings=dict(enumerate(FORCED_KINDS))),
        "periods": Variable("periods of the forcing until the motion repeats", "int32"),
        **{name: Attractor.variables[name] for name in OF_LOOPS_AND_MOTIONS},
        "winding": Variable("maxima of x1 in a period of the forcing, on average"),
        "x1_strobe": Variable("displacement at the strobe where it is largest", dimension="length"),
        "x2_strobe": Variable("velocity at that strobe", dimension="velocity"),
        "exponent": Variable(
            "largest Lyapunov exponent, where no period was found", dimension="rate"
        ),
        "exponent_error": Variable("its standard error", dimension="rate"),
        "transient": Variable("time at which the attractor was known", dimension="time"),
        "n_events": Variable("number of events (of a periodic motion: in one period)", "int32"),
    }
    steps_while_stuck: ClassVar[bool] = True

    def start(self, osc, lanes):
        zero, count = jnp.zeros_like(lanes.t), jnp.zeros_like(lanes.events)
        rates = [jnp.broadcast_to(one, count.shape) for one in repeating(osc)]
        turns = common_turns(rates).astype(count.dtype)
        passed = jnp.floor(lanes.t / _strobe_period(osc, turns) * (1 + 1e-14) + 1e-12)
        nowhere, never = zero + jnp.nan, jnp.full_like(count, -1)
        patience = count + FIRST_PATIENCE
        far = zero + jnp.inf
        tangent = zero, zero, zero
        repeats = _Repeats(
            nowhere, nowhere, never, patience, count, count, count, *tangent, zero, far
        )
        winding = Winding.none(lanes)
        rests = lanes.status == Status.PSEUDO_FOCUS.value
        return _RunSoFar(
            strobes=(passed + 1).astype(count.dtype),
            turns=turns,
            repeats=repeats,
            extent=_Extent.none(lanes, len(osc.belts), winding.rises_begun),
            farthest=(zero, zero),
            growth=Growth.none(lanes, has_second=True),
            winding=winding,
            kind=jnp.where(rests, EQUILIBRIUM, count),
            periods=count,
            loop_events=count,
            loop_rises=count,
            transient=jnp.where(rests, lanes.t, nowhere),
        )

    # --- steps

    def follow(self, take_step, osc, window, ones, lanes, t1, rtol, atol):
        seen: _RunSoFar = lanes.memory
        period = _strobe_period(osc, seen.turns)
        strobe = seen.strobes.astype(lanes.t.dtype) * period
        until = jnp.where(strobe > lanes.t, jnp.minimum(t1, strobe), t1)
        new = take_step(osc, window, ones, lanes, until, rtol, atol)
        course = course_of_step(osc, lanes, new, ones)
        theta = self._cut(seen, course, new.t, ones)
        cut = theta < 1
        new = choose(cut, replace(lanes, h=theta * course.duration), new)
        h = jnp.where(cut, 0.0, course.duration)
        growth = grown(osc, seen.growth, lanes, course, h, ones)
        # Decided lanes keep their results until these are collected.
        going_on = seen.kind == UNDECIDED
        extent = self._extended(seen.extent, lanes, new, course)
        seen = replace(seen, growth=growth, extent=choose(going_on & ~cut, extent, seen.extent))
        first_at = growth.began + UNMEASURED * (t1 - growth.began)
        winding = seen.winding.followed(lanes, new, course, first_at, period, ones)
        seen = replace(seen, winding=choose(going_on & ~cut, winding, seen.winding))
        share = (new.t - growth.began) / (t1 - growth.began)
        second = share >= 0.5 * (1 + UNMEASURED)
        halves = (share >= UNMEASURED) & ~second, second
        distance = jnp.hypot(new.x1, new.x2)
        farthest = tuple(
            jnp.where(inside, jnp.maximum(far, distance), far)
            for far, inside in zip(seen.farthest, halves, strict=True)
        )
        seen = replace(seen, farthest=farthest)
        due = (h > 0) & (new.t >= strobe) & (seen.turns > 0) & going_on
        return replace(new, memory=self._strobed(osc, seen, new, due, rtol))

    def _extended(self, extent: _Extent, lanes: Lanes, new: Lanes, course: Course) -> _Extent:
        """The extent with a step added: both of its ends, and extrema near to one of them."""
        h = course.duration
        sticks = tuple(
            total + jnp.where(one, h, 0.0)
            for total, one in zip(extent.sticks, lanes.mode.stuck, strict=True)
        )
        extent = replace(extent, sticks=sticks)
        safe = jnp.where(h > 0, h, 1.0)
        rates = [course.velocity(jnp.full_like(h, theta))[1] / safe for theta in (0.0, 1.0)]
        jerk = (rates[1] - rates[0]) / safe
        for one, a in zip((lanes, new), rates, strict=True):
            x1, x2 = one.x1, one.x2
            extent = extent.with_point(x1, x2)
            way = _way_to_zero(x2, a, h)
            x1 = x1 + way * (x2 + 0.5 * way * a)
            way = _way_to_zero(a, jerk, h)
            extent = extent.with_point(x1, x2 + way * (a + 0.5 * way * jerk))
        return extent

    def _cut(self, seen: _RunSoFar, course: Course, t: Array, ones: Array) -> Array:
        """The fraction of a step to the time t at which its first extremum of x1 or x2 lies; 1
        where none is inside, or where the lane needs none."""
        h = course.duration
        theta = jnp.ones_like(h)
        asked = (seen.repeats.n > 0) & (seen.kind == UNDECIDED) & (h > NEAR_EXTREMUM)
        size = 1 + sum(b - a for a, b in zip(seen.extent.low, seen.extent.high, strict=True))
        least = HARDLY_CHANGES * blur(t) * size
        at = [course.velocity(jnp.full_like(h, k / 4)) for k in range(5)]
        for values in zip(*at, strict=True):
            for k in reversed(range(4)):
                a, b = values[k], values[k + 1]
                crosses = ((a * b < 0) | (b == 0)) & (jnp.abs(a - b) > least) & asked
                root = (k + a / jnp.where(crosses, a - b, 1.0)) / 4
                near = jnp.minimum(root, 1 - root)
                inside = crosses & (near * h > 0.5 * NEAR_EXTREMUM) & (near > LEAST_CUT)
                theta = jnp.where(inside, jnp.minimum(theta, root), theta)
        return materialise(theta, ones)

    # --- strobes

    def _strobed(
        self, osc: OwnOscillator, seen: _RunSoFar, lanes: Lanes, due: Array, tol: Array
    ) -> _RunSoFar:
        """The memory behind a strobe in lanes where one is due."""
        now, known = seen.strobes, seen.repeats
        extent, x1, x2 = seen.extent, lanes.x1, lanes.x2
        is_top = x1 > extent.top[0]
        top = tuple(jnp.where(is_top, a, b) for a, b in zip((x1, x2), extent.top, strict=True))
        extent = replace(extent, top=top)
        size = extent.high[0] - extent.low[0] + extent.high[1] - extent.low[1]
        errors = ERRORS * tol * (1 + size)
        close = SAME * size + errors
        away = jnp.maximum(jnp.abs(x1 - known.x1), jnp.abs(x2 - known.x2))
        since = now - known.at
        back = away <= close
        sooner = back & ((known.n == 0) | (since < known.n))
        turn = (known.n > 0) & (since == known.n)
        left = away * way_left(away, known.moved)
        shrinks = (away <= errors) | (away < known.moved)
        again = turn & back & shrinks & ~sooner
        lost = turn & ~again & ~sooner
        expired = (known.n == 0) & ~back & (since >= known.patience) | (known.at < 0)
        fresh = sooner | again | lost | expired
        confirmed = jnp.where(again, known.confirmed + known.n, known.confirmed)
        confirmed = jnp.where(sooner | lost | expired, 0, confirmed)
        n = jnp.where(sooner, since, jnp.where(lost | expired, 0, known.n))
        here = (known.n > 0) & ~turn
        nearest = jnp.where(here, jnp.minimum(known.nearest, away), known.nearest)
        settled = (away <= errors) | (left <= close)
        # Errors hide the rest of a slow approach from alternate sides.
        still = jnp.where(away <= errors, 0.0, APART * left)
        alone = (known.n == 1) | (nearest > still + APART_OF_ERRORS * errors)
        least = jnp.maximum(CONFIRMED, 2 * known.n)
        found = again & settled & alone & (confirmed >= least)
        # A mass that sticks all the time repeats only if its state is equal up to rounding.
        elapsed = since.astype(x1.dtype) * _strobe_period(osc, seen.turns)
        carried = sum(extent.sticks) >= (1 - CARRIED) * elapsed
        found = found & (~carried | (away <= STANDS_STILL * (1 + jnp.abs(x1))))
        # A motion in a continuum of motions that repeat attracts nothing, and one with a growing
        # tangent is no attractor. A tangent may vanish in a stick phase of the transient, once; so
        # multipliers are those of the second half of the strobes over which the motion repeats.
        growth = seen.growth
        vanished = growth.size == -jnp.inf
        gained, is_complex = growth.multiplier_since(known.d1, known.d2, known.log)
        gained = jnp.where(vanished, -jnp.inf, gained)
        asked_for = (confirmed - known.asked).astype(x1.dtype) * _strobe_period(osc, seen.turns)
        doubt = STILL + jnp.where(is_complex, ERRORS_OF_AREAS, ERRORS_OF_GROWTH) * asked_for
        asks = again & (known.asked == 0) & (2 * confirmed >= least) & ~vanished
        found = found & ~asks & (gained < doubt) & ((known.asked > 0) | vanished)
        kind = jnp.where(gained < -doubt, PERIODIC, FORCED_CONTINUUM)
        length = jnp.hypot(growth.d1, growth.d2)
        asked = jnp.where(asks, confirmed, jnp.where(fresh & ~again, 0, known.asked))
        repeats = _Repeats(
            x1=jnp.where(fresh, x1, known.x1),
            x2=jnp.where(fresh, x2, known.x2),
            at=jnp.where(fresh, now, known.at),
            patience=jnp.where(expired & (known.at >= 0), 2 * known.patience, known.patience),
            n=n.astype(known.n.dtype),
            confirmed=confirmed.astype(known.n.dtype),
            asked=asked.astype(known.n.dtype),
            log=jnp.where(asks, growth.size, known.log),
            d1=jnp.where(asks, growth.d1 / length, known.d1),
            d2=jnp.where(asks, growth.d2 / length, known.d2),
            moved=jnp.where(again | sooner, away, jnp.where(fresh, jnp.inf, known.moved)),
            nearest=jnp.where(fresh, jnp.inf, nearest),
        )
        found = found & due
        rises = seen.winding.rises_begun
        empty = _Extent.none(lanes, len(extent.sticks), rises)
        empty = replace(empty, top=(x1, x2))
        kept = choose(fresh & ~found, empty, extent)
        return replace(
            seen,
            strobes=jnp.where(due, now + 1, now).astype(now.dtype),
            repeats=choose(due, repeats, known),
            growth=growth.with_normal(due & asks),
            extent=choose(due, kept, seen.extent),
            loop_events=jnp.where(found, lanes.events - extent.events, seen.loop_events),
            loop_rises=jnp.where(found, rises - extent.rises, seen.loop_rises),
            kind=jnp.where(found, kind, seen.kind).astype(seen.kind.dtype),
            periods=jnp.where(found, known.n, seen.periods).astype(seen.periods.dtype),
            transient=jnp.where(found, lanes.t, seen.transient),
        )

    # --- events

    def watch(self, osc, lanes, passage, ones, t1, tol):
        seen: _RunSoFar = lanes.memory
        growth = grown_past(osc, seen.growth, lanes, passage, t1)
        resting = jnp.where(passage.captured, EQUILIBRIUM, seen.kind)
        forever = lanes.status == Status.STUCK_FOREVER.value
        kind = jnp.where(forever & (seen.kind == UNDECIDED), STUCK_FOR_EVER, resting)
        new = (kind != UNDECIDED) & (seen.kind == UNDECIDED)
        transient = jnp.where(new, lanes.t, seen.transient)
        memory = replace(
            seen, growth=growth, kind=kind.astype(seen.kind.dtype), transient=transient
        )
        return replace(lanes, memory=memory, done=lanes.done | (kind != UNDECIDED))

    def finish(self, osc, lanes):
        seen: _RunSoFar = lanes.memory
        extent, growth = seen.extent, seen.growth
        exponent, error = growth.exponent()
        still = jnp.abs(growth.size) < STILL
        neutral = (seen.kind == FORCED_CONTINUUM) | (seen.kind == UNDECIDED) & still
        open_ = (seen.kind == UNDECIDED) & (lanes.status == Status.OK.value) & ~neutral
        resolved = open_ & jnp.isfinite(exponent)
        once = _strobe_period(osc, seen.turns)
        doubt = jnp.maximum(DEVIATIONS * error, COMPUTED / once)
        low, high = jnp.minimum(*seen.farthest), jnp.maximum(*seen.farthest)
        growth_seen = (1 - UNMEASURED) * (lanes.t - growth.began) * exponent
        chaotic = resolved & (exponent > doubt) & (growth_seen >= GROWTH_OF_CHAOS)
        chaotic = chaotic & (high - low <= STEADY_CHAOS * high)
        ordered = seen.winding.is_ordered & (seen.turns > 0)
        even = resolved & (jnp.abs(exponent) <= doubt) & (doubt * once < RESOLVED)
        even = even & (~growth.sticks | ordered)
        even = even & (seen.repeats.n == 0) & (high - low <= STEADY * high)
        kind = jnp.where(chaotic, CHAOTIC, jnp.where(even, QUASIPERIODIC, seen.kind))
        kind = jnp.where(neutral, UNDECIDED, kind)
        lost = open_ & (kind == UNDECIDED)
        status = jnp.where(lost, Status.NOT_SETTLED.value, lanes.status)
        neutral = neutral & (lanes.status == Status.OK.value)
        status = jnp.where(neutral, Status.NEUTRAL.value, status)
        periods, rises = (one.astype(lanes.t.dtype) for one in (seen.periods, seen.loop_rises))
        period, loops = periods * once, rises / jnp.maximum(periods, 1.0)
        wound = seen.winding.number(ordered)
        repeats, holds = kind == PERIODIC, kind == STUCK_FOR_EVER
        rests = holds | (kind == EQUILIBRIUM)

        def of_attractor(value, at_rest):
            return jnp.where(repeats, value, jnp.where(rests, at_rest, jnp.nan))

        sticks = [jnp.where(stuck & holds, jnp.inf, 0.0) for stuck in lanes.mode.stuck]
        sticks = [of_attractor(one, rest) for one, rest in zip(extent.sticks, sticks, strict=True)]
        return {
            "kind": kind.astype(seen.kind.dtype),
            "periods": jnp.where(repeats, seen.periods, 0),
            "sticks": tuple(one > 0 for one in sticks),
            "period": jnp.where(repeats, period, jnp.nan),
            "stick_duration": tuple(sticks),
            "x1_min": of_attractor(extent.low[0], lanes.x1),
            "x1_max": of_attractor(extent.high[0], lanes.x1),
            "x2_min": of_attractor(extent.low[1], lanes.x2),
            "x2_max": of_attractor(extent.high[1], lanes.x2),
            "winding": jnp.where(kind > STUCK_FOR_EVER, wound, of_attractor(loops, 0.0)),
            "x1_strobe": of_attractor(extent.top[0], lanes.x1),
            "x2_strobe": of_attractor(extent.top[1], lanes.x2),
            "exponent": jnp.where(open_, exponent, jnp.nan),
            "exponent_error": jnp.where(open_, error, jnp.nan),
            "transient": of_attractor(seen.transient, seen.transient),
            "n_events": jnp.where(repeats, seen.loop_events, lanes.events),
            "status": status,
        }


def _strobe_period(osc: OwnOscillator, turns: Array) -> Array:
    """Time between two strobes; one period of the clock where there is no common period."""
    frequency = jnp.abs(clock_frequency(osc))
    return 2 * np.pi * jnp.maximum(turns, 1).astype(frequency.dtype) / frequency


def _way_to_zero(value: Array, slope: Array, h: Array) -> Array:
    """Time to where a value of this slope vanishes, 0 if farther than `NEAR_EXTREMUM`."""
    way = step_to_root(value, slope)
    return jnp.where((jnp.abs(way) <= NEAR_EXTREMUM) & (h > 0), way, 0.0)
