"""Lanes of oscillators with a clock: their starts and steps; `timed_events` has their events.

`step`, `events` and `rounds` are for oscillators without a clock. They do not serve here, for three
reasons: where x2' = 0 the next derivative is not -x2, boundaries may move, and stick phases do not
end in closed form. So a step tests by the control points of each guard of its mode, see
`control_points`, whether the guard may vanish. A mass that sticks is stepped as well: its stages
follow the belt, and their x2' is the force that the stuck belts have to hold. A step has the
derivatives of the motion at a fixed time; those of event times are not in it.

Guards are numbered as in `instants.guards_at`. Boundary and edge guards are polynomials through
their values and slopes at both ends of a step, with the right integral, as in `step`. The force
that stuck belts have to hold is known at the times of the stages to the last bits, and is taken as
a polynomial of degree eight.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..model.instants import (
    begun_at,
    blur,
    is_held_for_ever,
)
from ..model.modes import (
    Mode,
    bounds_leftward,
    bounds_rightward,
    edges,
    first_of,
    foremost,
    has_edges,
    mode_acceleration,
    select,
    share_of_tolerance,
)
from ..model.oscillator import Oscillator, at_time, fastest, has_possible_numbers
from ..numerics.compiling import where_any
from ..numerics.control_points import Polynomial, highest_difference, passage, through
from ..results import Status
from .holds import NEEDED_ROUNDING, is_steady
from .lanes import Lanes, materialise
from .rounds import lanes_in
from .step import (
    LANDING,
    LANDS_WITHIN,
    LONGEST_STEP,
    NEVER,
    NO_STEP,
    SLOW,
    as_quotient,
    combine,
    integrated,
    next_size,
    nystroem,
    shortened_or_landed,
)
from .waves import StepClock, StepWave

#: Longest step of a mass that sticks, times the highest frequency: the polynomial of the needed
#: force is then good to 1e-9, and steps are made again to end at its root.
LONGEST_STUCK = 1.2
#: Relative rounding error of boundary and edge guards.
GUARD_DOUBT = 1e-15
#: In steps shorter than this, polynomials are made of values and slopes alone: the integral would
#: add only rounding.
SHORT_TIMED_STEP = 1e-3
#: Steps shorter than this, over the longest time that a Taylor step bridges, are not cut for doubt.
SHORTEST_TIMED_STEP = 1e-4
#: A step that would be shortened to more than this share of itself is halved.
NO_SHORTER = 0.99
#: Error of the polynomial of the needed force, over its highest coefficient.
LAST_TERM = 1e-4
#: Largest error of an onset time that needs no shorter step, over `LANDS_WITHIN` * tolerance.
STRAIGHT_GUARD = 1.0
#: Numbers of the stages that, with the start (0), are the nodes of the polynomial of the needed
#: force; with all stages as nodes its rounding would be a thousand times as large.
TIMED_STAGES = (2, 6, 4, 7, 8, 9, 10, 13)


def of_lanes(function: Callable, osc: Oscillator, *args: Any) -> Any:
    """function(osc, *args) lane by lane; leaves of `osc` that are scalars serve all lanes."""
    axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, osc)
    return jax.vmap(function, in_axes=(axes, *(0 for _ in args)))(osc, *args)


def needed_or_rate(osc: Oscillator, mode: Mode, t: Array, x1: Array, x2: Array) -> Array:
    """x2' of lanes that slip; the needed force of lanes that stick."""
    return mode_acceleration(at_time(osc, t), mode, x1, x2)


def timed_lanes_at_start(osc: Oscillator, run, x1, x2, passes, rtol, t0: Any) -> Lanes:
    """Lanes at the start of their runs, at the time t0, without memory and integrals."""
    t = jnp.zeros_like(x1) + t0

    def start(osc, x1, x2, t):
        y = x1, x2, t
        mode, focus = begun_at(osc, y)
        mode = Mode(tuple(code + jnp.zeros(()) for code in mode.codes))
        return mode, focus & jnp.asarray(True), is_held_for_ever(osc, mode, y)

    mode, rests, forever = of_lanes(start, osc, x1, x2, t)
    finite = jnp.isfinite(x1) & jnp.isfinite(x2) & has_possible_numbers(osc)
    status = jnp.where(forever, Status.STUCK_FOREVER.value, Status.OK.value)
    a = needed_or_rate(osc, mode, t, x1, x2)
    lanes = lanes_in(mode, a, finite, rests, status, run, x1, x2, passes, rtol)
    # Negative, as after a landing: `timed_events` finds the end of a steady stick phase first.
    h = jnp.where(mode.any_stuck, -lanes.h, lanes.h) if is_steady(osc) else lanes.h
    return replace(lanes, t=t, h=h, hit=lanes.events - 1, until=jnp.full_like(t, jnp.inf))


class TimedWindow(eqx.Module):
    """What does not change until the next event, arrays [lanes].

    signs: of the mode; stuck: lanes that stick; active: lanes that are to be stepped; longest: the
    longest step; edges: (left, right), where the mode ends; numbers: of their guards; None: no
    edges.
    """

    signs: tuple[Array, ...]
    stuck: Array
    active: Array
    longest: Array
    edges: tuple[Array, Array] | None
    numbers: tuple[Array, Array] | None


def timed_window_of(osc: Oscillator, lanes: Lanes, *, extrema: Array | None = None) -> TimedWindow:
    """The bounds of the current modes."""
    mode, n = lanes.mode, len(osc.belts)
    stuck = mode.any_stuck
    most = jnp.where(stuck, LONGEST_STUCK, LONGEST_STEP) / fastest(osc)
    found, numbers = None, None
    if has_edges(osc):
        found, numbers = [], []
        sides = (
            (bounds_leftward(mode), jnp.maximum, -jnp.inf),
            (
                bounds_rightward(mode),
                jnp.minimum,
                jnp.inf,
            ),
        )
        for flags, pick, none in sides:
            places = [
                jnp.where(flag, edge, none) for flag, edge in zip(flags, edges(osc), strict=True)
            ]
            edge = functools.reduce(pick, places)
            hit = [flag & (place == edge) for flag, place in zip(flags, places, strict=True)]
            names = [jnp.asarray(n + i) for i in range(2 * n)]
            numbers.append(first_of(hit, names, jnp.asarray(-1)))
            found.append(foremost(osc, hit, edges(osc), edge))
        found, numbers = tuple(found), tuple(numbers)
    return TimedWindow(mode.signs, stuck, ~lanes.done, most, found, numbers)


class _TimedAttempt(eqx.Module):
    """A step of size h, not yet accepted, as `step._Attempt`; rate: x2' at the end, in lanes that
    stick the belt's; needed: the needed force at the start and at `TIMED_STAGES`."""

    h: Array
    x1: Array
    x2: Array
    a: Array
    rate: Array
    error: Array
    integrals: Any
    needed: list[Array]


def _timed_attempt(
    osc, clock: StepClock, window: TimedWindow, lanes: Lanes, rtol, atol, rates
) -> _TimedAttempt:
    """One Runge-Kutta step of all lanes that slip; those that stick follow their belt."""
    own, h, ones, mode, stuck = nystroem(), clock.h, clock.ones, lanes.mode, window.stuck
    x1, x2, stages = lanes.x1, lanes.x2, [lanes.a]

    def placed(c, x1_slip, x2_slip):
        return select(stuck, clock.carried(mode, x1, c), (x1_slip, x2_slip))

    def field(c, x1, x2):
        now = clock.at(c)
        signs = window.signs
        pulls = tuple(belt.load * sign for belt, sign in zip(now.belts, signs, strict=True))
        a = as_quotient(now, signs, pulls, ones, x1, x2)
        return a - rate_of_stick(now, mode) if _moves(now) else a

    slopes = [rates(osc, mode, lanes.t, x1, x2)] if rates else []
    for row, row1, c in zip(own.a[1:-1], own.aa[1:-1], own.c[1:-1].tolist(), strict=True):
        drift = c * x2 + h * combine(row1, stages) if np.any(row1) else c * x2
        state = placed(c, x1 + h * drift, x2 + h * combine(row, stages))
        stages.append(field(c, *state))
        if rates:
            slopes.append(rates(osc, mode, lanes.t + c * h, *state))
    y1 = x1 + h * (x2 + h * combine(own.aa[-1], stages))
    y2 = x2 + h * combine(own.a[-1], stages)
    y1, y2 = (materialise(y, ones) for y in placed(1.0, y1, y2))
    stages.append(field(1.0, y1, y2))
    scale1 = atol + rtol * jnp.maximum(jnp.abs(x1), jnp.abs(y1))
    scale2 = atol + rtol * jnp.maximum(jnp.abs(x2), jnp.abs(y2))
    error1, error2 = jnp.abs(h * h * combine(own.ea, stages)), jnp.abs(h * combine(own.e, stages))
    scale2 = scale2 * _least_share(osc, lanes, clock, y2 - x2, stages[-1], rtol)
    error = jnp.maximum(error1 * scale2, error2 * scale1) / (scale1 * scale2)
    error = jnp.where(stuck, jnp.where(jnp.isfinite(stages[-1]), 0.0, jnp.inf), error)
    integrals = jax.tree.map(lambda i, *s: i + h * combine(own.a[-1], s), lanes.integrals, *slopes)
    end = clock.at(1.0)
    rate = jnp.where(stuck, rate_of_stick(end, mode), stages[-1])
    needed = [stages[i] for i in (0, *TIMED_STAGES)]
    return _TimedAttempt(h, y1, y2, stages[-1], rate, lax.stop_gradient(error), integrals, needed)


def _least_share(osc: Oscillator, lanes: Lanes, clock: StepClock, rise, a_end, rtol) -> Array:
    """The least `share_of_tolerance`, of x2 and of x2 relative to each moving belt."""
    shares = [share_of_tolerance(rise, lanes.a, a_end, rtol)]
    for wave in clock.velocities:
        if isinstance(wave, StepWave):
            rates = [wave.rate(c) / osc.omega for c in (0.0, 1.0)]
            course = (wave.at(1.0) - wave.at(0.0)) / osc.omega
            a = lanes.a - rates[0], a_end - rates[1]
            shares.append(share_of_tolerance(rise - course, *a, rtol))
    return functools.reduce(jnp.minimum, shares)


def _moves(now: Oscillator) -> bool:
    return any(hasattr(belt, "rate") for belt in now.belts)


def rate_of_stick(now: Oscillator, mode: Mode) -> Array:
    """Acceleration of the belt that the mass sticks to, over omega; 0 where it slips."""
    zero = jnp.zeros_like(mode.codes[0])
    if not _moves(now):
        return zero
    rates = [zero + getattr(belt, "rate", 0.0) for belt in now.belts]
    return foremost(now, mode.stuck, rates, zero) / now.omega


class _GuardMeeting(eqx.Module):
    """How a step meets one guard, arrays [lanes].

    once, cut, there: see `control_points.RootPassage`; delta: the time from the end of the step to
    the root of the guard, NEVER where no Taylor step bridges it. number: of the guard.
    """

    once: Array
    cut: Array
    there: Array
    delta: Array
    number: Array

    def unless(self, passed: Array) -> "_GuardMeeting":
        """The meeting, but none in the lanes that have passed the guard already."""
        delta = jnp.where(passed, NEVER, self.delta)
        return replace(self, once=self.once & ~passed, cut=self.cut & ~passed, delta=delta)


def _meeting(
    curve: Polynomial, doubt, rounding, ends, clock: StepClock, room, reach, number
) -> _GuardMeeting:
    """How a step meets a guard. ends: its (value, time derivative) at the start and at the end;
    curve, doubt, rounding: see `passage`; reach, room: see `step.LANDING`, `step.LANDS_WITHIN`."""
    (_, slope0), (value, slope) = ends
    h, keep = clock.h, functools.partial(materialise, ones=clock.ones)
    met = passage(curve, doubt, rounding, h < SHORTEST_TIMED_STEP * reach, keep)
    bend = (slope - slope0) * _per_step(h)
    falls = slope < 0
    near = jnp.abs(value) * jnp.maximum(-slope, SLOW * jnp.abs(bend)) <= reach * slope * slope
    straight = value * value * jnp.abs(bend) * h <= room * slope * slope
    # Where the guard only touches zero, within rounding, no Taylor step leads to its root.
    depth = jnp.where(bend > 0, 0.5 * slope * slope / jnp.where(bend > 0, bend, 1.0), jnp.inf)
    near = near & falls & straight & (value - depth < -rounding)
    per_slope = 1.0 / jnp.where(near, slope, 1.0)
    delta = -value * per_slope
    delta = delta - 0.5 * bend * delta * delta * per_slope
    return _GuardMeeting(
        met.once, met.cut, met.there, jnp.where(near, delta, NEVER), jnp.asarray(number)
    )


def _per_step(h: Array) -> Array:
    """1/h, and 1 in lanes that make no step: one division serves all guards."""
    return 1.0 / jnp.where(h > 0, h, 1.0)


def _quartic(start, end, change, h) -> list[Array]:
    """Coefficients of a function over a step, a quartic in theta from 0 to 1, by its (value, time
    derivative) at both ends and its integral over the step, `change`."""
    (f0, s0), (f1, s1) = start, end
    m0, m1 = h * s0, h * s1
    rise = f1 - f0
    k4 = 30 * (change * _per_step(h) - 0.5 * (f0 + f1) - (m0 - m1) / 12)
    k4 = jnp.where(h < SHORT_TIMED_STEP, 0.0, k4)
    c2, c3 = 3 * rise - 2 * m0 - m1, m0 + m1 - 2 * rise
    return [f0, m0, c2 + k4, c3 - 2 * k4, k4]


def _meetings(
    osc, clock: StepClock, window: TimedWindow, lanes: Lanes, new: _TimedAttempt, rtol, atol, lands
):
    """How the step meets each guard of its mode; lands: see `_limit_of_stick`."""
    h, n, ones = clock.h, len(osc.belts), clock.ones
    reach = LANDING * jnp.sqrt(rtol)
    room = LANDS_WITHIN * (atol + rtol * jnp.abs(new.x2)) * h
    start = clock.at(0.0)
    stuck, mode = window.stuck, lanes.mode
    rate0 = jnp.where(stuck, rate_of_stick(start, mode), lanes.a)
    own = _quartic((lanes.x2, rate0), (new.x2, new.rate), new.x1 - lanes.x1, h)
    own = [materialise(k, ones) for k in own]
    found, fuzz = [], GUARD_DOUBT * blur(lanes.t)
    steady = is_steady(osc)
    for i, code in enumerate(mode.codes):
        slips = jnp.abs(code) == 1
        if steady:
            slips = slips & ~stuck
        v = clock.velocities[i]
        ends = (v.at(0.0), v.rate(0.0)), (v.at(1.0), v.rate(1.0))
        wave = [ends[0][0]]
        if _moves(start):
            wave = _quartic(*ends, v.integral(1.0, h), h)
        # Where the belt does not slip, the mode has no such guard: the constant 1 serves instead.
        guard = [w - osc.omega * k for w, k in zip(wave, own)] + [
            -osc.omega * k for k in own[len(wave) :]
        ]
        there = [jnp.where(slips, code * k, 0.0) for k in guard]
        there[0] = jnp.where(slips, there[0], 1.0)
        doubt = jnp.abs(there[4]) + 0.1 * jnp.abs(there[3])
        size = 1 + jnp.abs(ends[1][0]) + jnp.abs(new.x2)
        by_time = [
            (code * (value - osc.omega * x2), code * (rate - osc.omega * a))
            for (value, rate), x2, a in zip(ends, (lanes.x2, new.x2), (rate0, new.rate))
        ]
        by_time = [(jnp.where(slips, g, 1.0), jnp.where(slips, slope, 0.0)) for g, slope in by_time]
        curve = Polynomial.of(there)
        found.append(_meeting(curve, doubt, fuzz * size, by_time, clock, room, reach, i))
    if window.edges is not None and window.numbers is not None:
        x1 = [lanes.x1, *(h * k / (j + 1) for j, k in enumerate(own))]
        for side, (edge, number) in enumerate(zip(window.edges, window.numbers, strict=True)):
            way, there = (1.0, -1.0)[side], jnp.isfinite(edge)
            if steady:
                there = there & ~stuck
            place = jnp.where(there, edge, 0.0)
            guard = [jnp.where(there, way * k, 0.0) for k in (x1[0] - place, *x1[1:])]
            guard[0] = jnp.where(there, guard[0], 1.0)
            doubt = jnp.abs(guard[5]) + 0.1 * jnp.abs(guard[4])
            size = 1 + jnp.abs(new.x1)
            by_time = [
                (jnp.where(there, way * (x - place), 1.0), jnp.where(there, way * v, 0.0))
                for x, v in ((lanes.x1, lanes.x2), (new.x1, new.x2))
            ]
            curve = Polynomial.of(guard)
            found.append(_meeting(curve, doubt, fuzz * size, by_time, clock, room, reach, number))
    if steady:  # the end of a stick phase is known beforehand
        return found
    none = jnp.zeros_like(h)
    no = none > 0
    limit = where_any(
        stuck,
        lambda: _limit_of_stick(osc, clock, lanes, new, room, reach, lands),
        _GuardMeeting(no, no, none + 1, none + NEVER, jnp.full_like(lanes.hit, 3 * n)),
    )
    asked = stuck & (lanes.status != Status.STUCK_FOREVER.value)
    once, cut, delta = limit.once & asked, limit.cut & asked, jnp.where(asked, limit.delta, NEVER)
    found.append(replace(limit, once=once, cut=cut, delta=delta))
    return found


def _limit_of_stick(
    osc, clock: StepClock, lanes, new: _TimedAttempt, room, reach, lands: bool
) -> _GuardMeeting:
    """How a step meets the nearer limit of stuck belts, capacity - needed or capacity + needed.

    Where it may meet both, it is cut. lands: whether a step has to end near the root; else a step
    that has passed the root may go back to it, however far that is.
    """
    own, n, h = nystroem(), len(osc.belts), clock.h
    nodes = tuple(round(float(own.c[i]), 12) for i in (0, *TIMED_STAGES))
    matrix = through(nodes)
    needed = [materialise(combine(row, new.needed), clock.ones) for row in matrix]

    def capacity(c):
        now = clock.at(c)
        total = jnp.zeros_like(h)
        for belt, stuck in zip(now.belts, lanes.mode.stuck, strict=True):
            total = total + jnp.where(stuck, belt.load * belt.friction.static, 0.0)
        return total

    if any(isinstance(load, StepWave) for load in clock.loads):
        capacities = [capacity(c) for c in nodes]
        held = [combine(row, capacities) for row in matrix]
    else:
        held = [capacity(1.0)] * len(nodes)
    pairs = list(zip(held, needed, strict=True))
    least = [functools.reduce(jnp.minimum, [c + way * x for c, x in pairs]) for way in (-1.0, 1.0)]
    way = jnp.where(least[0] < least[1], -1.0, 1.0)
    points = [c + way * x for c, x in pairs]
    size = 1 + jnp.abs(held[-1]) + jnp.abs(lanes.x1)
    fuzz = NEEDED_ROUNDING * blur(lanes.t) * size
    doubt = LAST_TERM * jnp.abs(highest_difference(points)) + fuzz
    safe = jnp.where(h > 0, h, 1.0)
    ends = [(p, (len(points) - 1) * (q - p) / safe) for p, q in (points[:2], points[-2:])]
    ends[1] = (points[-1], ends[1][1])
    number = jnp.where(way < 0, 3 * n, 3 * n + 1).astype(lanes.hit.dtype)
    curve = Polynomial(points)
    one = _meeting(curve, doubt, fuzz, ends, clock, room, reach, number)
    both = (jnp.maximum(*least) <= doubt) & (h > SHORTEST_TIMED_STEP * reach)
    one = replace(one, cut=one.cut | both, there=jnp.where(both, 0.5 * one.there, one.there))
    if lands or any(isinstance(v, StepWave) for v in clock.velocities):
        return one
    # x1 is linear in the time: the state at the root is as good as that at the end of the step.
    _, slope, _ = curve.at(one.there)
    sharp = doubt * safe <= STRAIGHT_GUARD * room * jnp.abs(slope)
    back = jnp.where(one.once & ~one.cut & sharp, (one.there - 1) * h, one.delta)
    return replace(one, delta=back)


def take_timed_step(
    osc,
    window: TimedWindow,
    ones: Array,
    lanes: Lanes,
    t1,
    rtol,
    atol,
    rates: Callable | None = None,
    *,
    derivatives: bool = False,
) -> Lanes:
    """One step of all lanes: kept, shortened to end on a guard, or rejected; see
    `step.take_step`."""
    remaining = t1 - lanes.t
    going = window.active & (lanes.h > 0) & (remaining > 0)
    h = jnp.where(going, jnp.minimum(jnp.minimum(lanes.h, window.longest), remaining), 0.0)
    to_end = jnp.where(window.stuck, lanes.until - lanes.t, jnp.inf)
    ends_hold = going & (h >= to_end)
    h = jnp.minimum(h, to_end)
    clock = StepClock.of(osc, ones, lanes.t, h)
    new = _timed_attempt(osc, clock, window, lanes, rtol, atol, rates)
    # Integrals are known only at the ends of steps, and near them.
    found = _meetings(osc, clock, window, lanes, new, rtol, atol, rates is not None)
    # The guard at which the mode did not change, see `timed_events`, is left out.
    passed = jnp.where(window.stuck, -1, lanes.hit)
    found = [one.unless(one.number == passed) for one in found]
    delta = functools.reduce(jnp.minimum, [one.delta for one in found])
    number = first_of(
        [one.delta == delta for one in found], [one.number for one in found], jnp.asarray(-1)
    )
    reached = delta < NEVER
    no = jnp.zeros_like(reached)
    theta, cuts = jnp.ones_like(h), no
    for one in found:
        blocks = one.cut | (one.once & (one.delta >= NEVER))
        # A shortened step has to be shorter, also where rounding puts the root at its end.
        there = jnp.where(one.there > NO_SHORTER, 0.5, one.there)
        sooner = blocks & (there < theta)
        theta, cuts = jnp.where(sooner, there, theta), cuts | blocks
        # A lane that stands on the guard at the start of the step lands on it.
        number = jnp.where(sooner & (there * h < NO_STEP), one.number, number)

    last = h >= remaining
    accepted = going & (new.error <= 1)
    lands = accepted & ~cuts & reached & ~(last & (delta > 0))
    delta, ends_hold = jnp.where(lands, delta, 0.0), ends_hold & accepted
    lands, number = lands | ends_hold, jnp.where(ends_hold, lanes.hit, number)
    outcome = jnp.where(accepted, jnp.where(cuts, -1.0, 1.0), 0.0)
    outcome = materialise(jnp.where(lands, 2.0, outcome), ones)
    shortened, kept, lands = outcome < 0, outcome > 0, outcome > 1
    theta = materialise(theta, ones)
    delta = lax.stop_gradient(materialise(delta, ones))
    x1 = new.x1 + delta * (new.x2 + 0.5 * delta * new.rate)
    x2 = new.x2 + delta * new.rate
    t = jnp.where(last & ~lands, t1, lanes.t + h + delta)
    t = jnp.where(ends_hold, lanes.until, t)
    pace, proposed = next_size(lanes, new, going, accepted)
    proposed = jnp.where(window.stuck & accepted, 4 * h, proposed)
    proposed, stands = shortened_or_landed(proposed, shortened, theta * h, lands)
    return replace(
        lanes,
        t=jnp.where(kept, t, lanes.t),
        x1=jnp.where(kept, x1, lanes.x1),
        x2=jnp.where(kept, x2, lanes.x2),
        a=jnp.where(kept, new.a, lanes.a),
        h=lax.stop_gradient(jnp.where(going, proposed, lanes.h)),
        pace=lax.stop_gradient(jnp.where(accepted & ~window.stuck, pace, lanes.pace)),
        hit=jnp.where(
            lands | stands, number, jnp.where(kept & ~window.stuck, -1, lanes.hit)
        ).astype(lanes.hit.dtype),
        integrals=integrated(rates, osc, lanes, new, delta, x1, x2, kept) if rates else None,
    )
