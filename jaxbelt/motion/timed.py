"""One arc with a clock: from a state to the first guard that vanishes, and how it goes on there.

Without a clock the extrema of x2 and of x1 tell how often a guard can vanish, see `arcs`; with one
they do not: x2'' is not -x2 where x2' = 0, and boundaries move. So each step has to prove that none
of its guards vanishes within, from the guards at both ends: value, slope and curvature along the
motion, by derivatives of the field. A quintic has these values; in the basis of Bernstein it lies
within its six control points. Where these, less the error of the quintic, are positive, the guard
is positive. Where the guard is negative at the end and the control points fall, it has one root.
Otherwise the step is halved. The error of the quintic is at most |g(6)| h^6/46080, g(n) being the
derivative of order n of a guard. The control points of the quintic are |g(4)| h^4/240 away from
those of the cubic with the same values and slopes, and a quarter of that, `QUINTIC_SHARE`, is taken
for the error: for a wave of frequency Omega it is 48 over (Omega h)^2 times as much, and no step is
longer than half a radian of the fastest wave. Slip and stick phases are proved in the same way; in
stick phases the state is in closed form. A double root, where control points are negative by
rounding only, is touched, and the arc goes on.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.instants import (
    GUARD_ROUNDING,
    TimedState,
    Trend,
    blur,
    carried,
    field_at,
    guard_sizes,
    guards_trend,
    is_held_for_ever,
    on_guard_at,
    passed_guard,
)
from ..model.modes import Mode, select
from ..model.oscillator import Oscillator, fastest
from ..numerics.extrapolation import increments, scheme
from ..numerics.implicit import step_to_root
from ..numerics.roots import first_root
from .arcs import ArcEnd

#: Longest step, times the highest frequency; first step of an arc, over the longest one.
LONGEST_OF_WAVE, FIRST_OF_WAVE = 0.5, 0.05
#: Steps are not halved below this; whether a guard vanishes in so short a step is rounding.
SHORTEST_STEP = 1e-8
#: Part of the distance between cubic and quintic that bounds the error of the quintic.
QUINTIC_SHARE = 0.25
#: A guard above minus this, times `guard_sizes`, has not passed zero.
TOUCH = 0.1 * GUARD_ROUNDING
#: Newton steps for the root beside a zero at which an arc began; and the shortest such arc, times
#: `blur` of the time, at whose end the guard falls beyond rounding.
STEPS_BESIDE_ZERO, SHORTEST_BESIDE_ZERO = 6, 1e-11
#: Largest number of steps of an arc; then it is given up.
MOST_TIMED_STEPS = 20_000
#: Longest slip arc; longer ones are cut.
LONGEST_TIMED_ARC = 1.0
_BOTH_ORDERS, _BESIDE_ZERO = scheme((2, 4, 6, 8), (2, 4, 6)), scheme((2, 4), (2,))


class _March(NamedTuple):
    """Where a march is: the time passed, the state, the guards there, shifts that are added to
    guards that began at zero, and the next step h. hit: a guard vanishes within this next step.
    """

    passed: Array
    y: TimedState
    at: Trend
    shifts: Array
    h: Array
    hit: Array
    stops: Array
    failed: Array
    steps: Array


def _stepped(osc: Oscillator, mode: Mode, y: TimedState, h: Array, orders=_BOTH_ORDERS):
    """The state a time h later, and an estimate of its error in x1 and x2."""
    field = functools.partial(field_at, osc, mode)
    best, lower = increments(field, y, h, orders)
    slipped = y[0] + best[0], y[1] + best[1], y[2] + best[2]
    errors = tuple(jnp.abs(a - b) for a, b in zip(best[:2], lower[:2], strict=True))
    stuck = mode.any_stuck
    zero = jnp.zeros_like(h)
    return select(stuck, (carried(osc, mode, y, h), (zero, zero)), (slipped, errors))


def _control_points(at: Trend, end: Trend, h: Array) -> tuple[Array, Array]:
    """The control points of the quintics through both ends, [6, guards], and their error."""
    b = [at.value, at.value + 0.2 * h * at.slope]
    b += [at.value + 0.4 * h * at.slope + 0.05 * h**2 * at.curvature]
    b += [end.value - 0.4 * h * end.slope + 0.05 * h**2 * end.curvature]
    b += [end.value - 0.2 * h * end.slope, end.value]
    # The two middle control points of the cubic, raised to degree five.
    p = [at.value, at.value + h * at.slope / 3, end.value - h * end.slope / 3, end.value]
    third = (p[0] + 6 * p[1] + 3 * p[2]) / 10
    fourth = (3 * p[1] + 6 * p[2] + p[3]) / 10
    away = jnp.maximum(jnp.abs(b[2] - third), jnp.abs(b[3] - fourth))
    return jnp.stack(b), QUINTIC_SHARE * away


def _finite(at: Trend) -> Trend:
    """The trend of guards, with guards that do not exist (inf) replaced by ones that stay at 1."""
    there = jnp.isfinite(at.value)
    return Trend(
        jnp.where(jnp.isposinf(at.value), 1.0, at.value),
        jnp.where(there, at.slope, 0.0),
        jnp.where(there, at.curvature, 0.0),
    )


def first_vanishing(osc: Oscillator, mode: Mode, y: TimedState, longest: Array, rtol, atol):
    """The motion of a mode until a guard vanishes, or for the time `longest`.

    Returns its duration, its end, the number of the guard in `guards_at` or -1, and whether it was
    given up. A slip arc also ends, with -1, behind a minimum of the distance to a boundary, where
    friction bends most, so that each arc bends most at one of its ends.
    """
    n = len(osc.belts)
    most = LONGEST_OF_WAVE / fastest(osc)
    sizes = guard_sizes(osc, y)
    stuck = mode.any_stuck

    def look(y):
        return _finite(guards_trend(osc, mode, y))

    def unfinished(state: _March):
        going = (state.passed < longest) & ~state.hit & ~state.stops & ~state.failed
        return going & (state.steps < MOST_TIMED_STEPS)

    def advance(state: _March) -> _March:
        rest = longest - state.passed
        h = jnp.minimum(state.h, rest)
        y, errors = _stepped(osc, mode, state.y, h)
        end = look(y)
        larger = [jnp.maximum(jnp.abs(a), jnp.abs(b)) for a, b in zip(state.y[:2], y[:2])]
        terms = [e / (atol + rtol * size) for e, size in zip(errors, larger, strict=True)]
        error = functools.reduce(jnp.maximum, terms)
        accurate = (error <= 1) | (h <= SHORTEST_STEP) & jnp.isfinite(error)
        # Prove whether guards vanish within the step.
        shifted = state.at.value + state.shifts, end.value + state.shifts
        points, astray = _control_points(
            state.at._replace(value=shifted[0]), end._replace(value=shifted[1]), h
        )
        none = jnp.min(points, axis=0) - astray > -TOUCH * sizes
        falls = jnp.max(jnp.diff(points, axis=0), axis=0) + 2 * astray < 0
        tiny = h <= SHORTEST_STEP
        negative = shifted[1] < -TOUCH * sizes
        once = ~none & negative & (falls | tiny)
        clear = none | once | tiny
        good = accurate & jnp.all(clear)
        hit = good & jnp.any(once)
        moves = good & ~hit
        # Behind a minimum of a distance to a boundary.
        turned = (state.at.slope[:n] < 0) & (end.slope[:n] > 0)
        stops = moves & ~stuck & jnp.any(turned)
        growth = jnp.clip(0.9 * jnp.maximum(error, 1e-8) ** (-1 / 7), 0.2, 2.0)
        growth = jnp.where(jnp.isfinite(growth), growth, 0.25)
        shorter = jnp.where(accurate, 0.5, jnp.minimum(growth, 0.8))
        h_next = jnp.where(good, jnp.minimum(h * growth, most), h * shorter)
        # The last step is made once more, for its root.
        h_next = jnp.where(hit, h, h_next)
        passed = jnp.where(moves, jnp.where(h >= rest, longest, state.passed + h), state.passed)
        shifts = jnp.where(moves & (end.value > state.shifts), 0.0, state.shifts)
        return _March(
            passed,
            select(moves, y, state.y),
            select(moves, end, state.at),
            shifts,
            h_next,
            hit,
            stops,
            ~accurate & (h <= SHORTEST_STEP),
            state.steps + 1,
        )

    at = look(y)
    shifts = jnp.where(jnp.abs(at.value) <= GUARD_ROUNDING * sizes, 2 * GUARD_ROUNDING * sizes, 0.0)
    no = jnp.asarray(False)
    start = _March(jnp.zeros(()), y, at, shifts, FIRST_OF_WAVE * most, no, no, no, jnp.asarray(0))
    last = lax.while_loop(unfinished, advance, start)
    length = jnp.where(last.hit, last.h, 0.0)

    def guards(h):
        y, _ = _stepped(osc, mode, last.y, h)
        at = look(y)
        return at.value + last.shifts, at.slope

    values, slopes = guards(length)
    at_end = jnp.where(last.hit, values, jnp.inf), slopes
    at_start = last.at.value + last.shifts, last.at.slope
    h, number = first_root(guards, at_start, length, at_end, extrema=0)
    number = jnp.where(last.hit, number, -1)
    h = jnp.where(number >= 0, h, length)
    y_end, _ = _stepped(osc, mode, last.y, h)
    y_end = select(last.hit, y_end, last.y)
    failed = last.failed | (last.steps >= MOST_TIMED_STEPS)
    # Beside a zero at which the arc began a guard's value is only rounding, but its slope is not:
    # the guard vanishes again where its mean slope vanishes, taken here from a cubic.
    beside = (number >= 0) & (last.shifts[number] > 0)
    longest = last.passed + h
    shortest = jnp.minimum(SHORTEST_BESIDE_ZERO * blur(y[2]), longest)

    def nearer(state):
        duration, _, steps = state
        y_end, _ = _stepped(osc, mode, y, duration, _BESIDE_ZERO)
        end = look(y_end)
        first, final = at.slope[number], end.slope[number]
        bends = at.curvature[number] - end.curvature[number]
        mean = 0.5 * (first + final) + duration * bends / 12
        change = step_to_root(mean, (final - mean) / duration, where=final < mean)
        return jnp.clip(duration + change, shortest, longest), y_end, steps + 1

    def is_going(state):
        return beside & (state[-1] < STEPS_BESIDE_ZERO)

    begun = longest, y_end, jnp.asarray(0)
    duration, y_end, _ = lax.while_loop(is_going, nearer, begun)
    return duration, y_end, number, failed


class TimedArc(eqx.Module):
    """end: how an arc ends and how the orbit goes on; done: whether the run ends with it."""

    end: ArcEnd
    done: Array


def timed_arc(osc: Oscillator, mode: Mode, y: TimedState, t1: Array, rtol, atol) -> TimedArc:
    """The arc from y, up to t1, and how the orbit goes on."""
    stuck = mode.any_stuck
    remaining = t1 - y[2]
    forever = stuck & is_held_for_ever(osc, mode, y)
    # Slip arcs are cut, because they are integrated once more for their derivatives.
    longest = jnp.where(stuck, remaining, jnp.minimum(remaining, LONGEST_TIMED_ARC))
    looked = jnp.where(forever, 0.0, longest)
    duration, y_end, number, failed = first_vanishing(osc, mode, y, looked, rtol, atol)
    y_end = select(forever, carried(osc, mode, y, remaining), y_end)
    duration = jnp.where(forever, remaining, duration)
    y_end = on_guard_at(osc, mode, number, y_end)
    after = passed_guard(osc, mode, number, y_end)
    in_time = (number < 0) & (duration >= remaining)
    ones = jnp.ones_like(remaining)
    end = ArcEnd(
        duration=duration,
        y=after.y,
        mode=after.mode,
        signs=(ones, ones),
        ended_by=number,
        captured=after.captured,
        forever=forever,
        failed=failed,
    )
    return TimedArc(end, in_time | after.captured)
