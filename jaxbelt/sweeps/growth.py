"""Tangents of forced runs, and the largest Lyapunov exponent that follows from their growth.

- Along a slip arc a tangent d solves d1' = d2, d2' = -d1 + c(t) d2 with c the derivative of x2' by
  x2. Each half step is made by the exponential of Magnus's series of order four, with c at its ends
  and in its middle; the trace of the matrix is left out of the exponential and added to `log`.
- At an event d jumps by the saltation of the guard h that fires: d_tau = -(h_x d) / (h_t + h_x f-),
  d+ = d + (f- - f+) d_tau, with the fields f- before and f+ behind. While the mass sticks d2 = 0.

Magnus's series: S. Blanes, F. Casas, J. A. Oteo, J. Ros, Physics Reports 470, 2009, 151, sec. 5.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..cycles.exponents import BLOCKS
from ..kernel.clocked import of_lanes, rate_of_stick
from ..kernel.lanes import Lanes, Observer, Passage, Variable, choose, in_few, materialise
from ..model.instants import field_at, guards_at
from ..model.modes import Mode, any_of, mode_acceleration, select
from ..model.oscillator import at_time
from ..model.own_units import OwnOscillator
from ..numerics.implicit import step_to_root
from ..results import Status
from .moments import Course

#: Tangents, (d1, d2) each.
Tangents = tuple[tuple[Array, Array], ...]
#: Share of a run that passes before its exponent is measured.
UNMEASURED = 0.25


class Growth(eqx.Module):
    """The tangent and the logarithms of its growth, arrays [lanes].

    d1, d2: the first tangent, normalised after each look at the events; second: another tangent on
    the same scale, (d1, d2), or None; log: logarithm of the first one's growth, without its present
    size; since, before: the time at which the present block began, and `log` then; began: start of
    the run; blocks: number of blocks done, -1 before the first; total, squares: sums over blocks of
    the rates of growth and of their squares; sticks: whether the mass stuck since the first block.
    """

    d1: Array
    d2: Array
    second: tuple[Array, Array] | None
    log: Array
    since: Array
    before: Array
    began: Array
    blocks: Array
    total: Array
    squares: Array
    sticks: Array

    @classmethod
    def none(cls, lanes: Lanes, *, has_second: bool = False) -> "Growth":
        zero = jnp.zeros_like(lanes.t)
        return cls(
            d1=zero + np.cos(1.0),
            d2=zero + np.sin(1.0),
            second=(zero - np.sin(1.0), zero + np.cos(1.0)) if has_second else None,
            log=zero,
            since=lanes.t,
            before=zero,
            began=lanes.t,
            blocks=jnp.full_like(lanes.events, -1),
            total=zero,
            squares=zero,
            sticks=zero > 0,
        )

    @property
    def size(self) -> Array:
        """The logarithm of the tangent's growth until now; -inf where it has vanished."""
        return self.log + jnp.log(jnp.hypot(self.d1, self.d2))

    @property
    def tangents(self) -> Tangents:
        return ((self.d1, self.d2), *(() if self.second is None else (self.second,)))

    def with_tangents(self, tangents: Tangents) -> "Growth":
        (d1, d2), *others = tangents
        return replace(self, d1=d1, d2=d2, second=others[0] if others else None)

    def with_normal(self, flags: Array) -> "Growth":
        """The growth with a second tangent that is normal to the first, in lanes with a flag."""
        return replace(self, second=choose(flags, (-self.d2, self.d1), self.second))

    def multiplier_since(self, d1: Array, d2: Array, log: Array) -> tuple[Array, Array]:
        """The logarithm of the modulus of the larger multiplier of the map of tangents since the
        last call of `with_normal`, and whether the multipliers are complex.

        d1, d2: the first tangent at that call, of size one; log: its `size` then.
        """
        first, second = self.tangents
        scale = jnp.exp(self.log - log)
        trace = scale * (d1 * first[0] + d2 * first[1] - d2 * second[0] + d1 * second[1])
        area = scale * scale * (first[0] * second[1] - first[1] * second[0])
        inner = 0.25 * trace * trace - area
        real = 0.5 * jnp.abs(trace) + jnp.sqrt(jnp.maximum(inner, 0.0))
        return jnp.where(inner < 0, 0.5 * jnp.log(jnp.abs(area)), jnp.log(real)), inner < 0

    def exponent(self) -> tuple[Array, Array]:
        """The largest exponent per unit of time, and its standard error; NaN without blocks."""
        count = self.blocks.astype(self.total.dtype)
        safe = jnp.maximum(count, 2.0)  # one block has no spread
        mean = self.total / safe
        spread = jnp.maximum(self.squares / safe - mean * mean, 0.0) / (safe - 1)
        known = count >= 2
        return jnp.where(known, mean, jnp.nan), jnp.where(known, jnp.sqrt(spread), jnp.nan)


class LargestExponent(Observer):
    """The largest Lyapunov exponent of a forced run, over its last three quarters."""

    variables: ClassVar[Mapping[str, Variable]] = {
        "exponent": Variable("largest Lyapunov exponent per unit of time", dimension="rate"),
        "exponent_error": Variable("its standard error", dimension="rate"),
        "n_events": Variable("number of events", "int32"),
    }

    def start(self, osc, lanes):
        return Growth.none(lanes)

    def follow(self, take_step, osc, window, ones, lanes, t1, rtol, atol):
        new = take_step(osc, window, ones, lanes, t1, rtol, atol)
        course = course_of_step(osc, lanes, new, ones)
        growth = grown(osc, lanes.memory, lanes, course, course.duration, ones)
        return replace(new, memory=growth)

    def watch(self, osc, lanes, passage, ones, t1, tol):
        return replace(lanes, memory=grown_past(osc, lanes.memory, lanes, passage, t1))

    def finish(self, osc, lanes):
        exponent, error = lanes.memory.exponent()
        good = lanes.status == Status.OK.value
        return {
            "exponent": jnp.where(good, exponent, jnp.nan),
            "exponent_error": jnp.where(good, error, jnp.nan),
            "n_events": lanes.events,
            "status": lanes.status,
        }


def grown(osc, growth: Growth, lanes: Lanes, course: Course, h: Array, ones) -> Growth:
    """The growth after a step of size h; along a slip arc the trace of the field is added to
    `log`."""
    mode, tangents, log = lanes.mode, growth.tangents, growth.log
    along = jnp.where(mode.any_stuck, 0.0, h)
    rates = []
    for k in range(5):
        now = at_time(osc, lanes.t + 0.25 * k * along)
        x2 = course.velocity(jnp.full_like(h, 0.25 * k))[0]

        def field(x2, now=now):
            return mode_acceleration(now, mode, lanes.x1, x2)

        rates.append(materialise(jax.jvp(field, (x2,), (jnp.ones_like(x2),))[1], ones))
    half = 0.5 * along
    for start, middle, end in (rates[:3], rates[2:]):
        mean, change = (start + 4 * middle + end) / 6, end - start
        # Omega = half (0, 1; -1, mean) - half^2 / 12 change (0, 1; 1, 0), without half its trace.
        twist = half * half * change / 12
        p, q, r = -0.5 * half * mean, half - twist, -half - twist
        square = p * p + q * r
        even, odd = jnp.ones_like(square), jnp.ones_like(square)
        for k in reversed(range(1, 9)):
            even = 1 + square * even / ((2 * k - 1) * (2 * k))
            odd = 1 + square * odd / (2 * k * (2 * k + 1))
        tangents = tuple(
            (even * a + odd * (p * a + q * b), even * b + odd * (r * a - p * b))
            for a, b in tangents
        )
        log = log + 0.5 * half * mean
    tangents = tuple((materialise(a, ones), materialise(b, ones)) for a, b in tangents)
    return replace(growth.with_tangents(tangents), log=log)


def grown_past(osc, growth: Growth, lanes: Lanes, passage: Passage, t1: Array) -> Growth:
    """The growth behind the events of a passage: tangents jumped and normalised, `log` updated."""
    n, tangents = len(osc.belts), growth.tangents
    busy = lanes.run >= 0
    fired, released = passage.fired & busy, passage.released & busy

    def jumped(osc, passage, state, mode, fired, released, before):
        first = passage.before, passage.mode, passage.number
        d = of_lanes(_saltation, osc, *first, (passage.x1, passage.x2, passage.t), before)
        d = select(fired, d, before)
        upward = any_of([stuck & (code > 0) for stuck, code in zip(passage.mode.stuck, mode.codes)])
        number = jnp.where(upward, 3 * n + 1, 3 * n)
        return select(released, of_lanes(_saltation, osc, passage.mode, mode, number, state, d), d)

    args = passage, (lanes.x1, lanes.x2, lanes.t), lanes.mode, fired, released, tangents
    tangents = in_few(fired | released, jumped, (osc, *args), tangents)
    sticks = growth.sticks | passage.mode.any_stuck | lanes.mode.any_stuck
    return _counted(replace(growth.with_tangents(tangents), sticks=sticks), lanes.t, t1)


def _counted(growth: Growth, t: Array, t1: Array) -> Growth:
    """The growth with its first tangent normalised, and with the block closed that is over."""
    size = jnp.hypot(growth.d1, growth.d2)
    size = jnp.where((size > 0) & jnp.isfinite(size), size, 1.0)
    log = growth.log + jnp.log(size)
    first = growth.began + UNMEASURED * (t1 - growth.began)
    length = (t1 - first) / BLOCKS
    over = t >= first + (growth.blocks + 1).astype(t.dtype) * length - 1e-9 * length
    elapsed = t - growth.since
    counts = over & (growth.blocks >= 0) & (elapsed > 0)
    rate = jnp.where(counts, (log - growth.before) / jnp.where(counts, elapsed, 1.0), 0.0)
    return replace(
        growth.with_tangents(tuple((a / size, b / size) for a, b in growth.tangents)),
        log=log,
        since=jnp.where(over, t, growth.since),
        before=jnp.where(over, log, growth.before),
        blocks=jnp.where(over & (growth.blocks < BLOCKS), growth.blocks + 1, growth.blocks).astype(
            growth.blocks.dtype
        ),
        total=growth.total + rate,
        squares=growth.squares + rate * rate,
        sticks=growth.sticks & ~(over & (growth.blocks < 0)),
    )


def _saltation(
    osc: OwnOscillator, before: Mode, after: Mode, number: Array, y, tangents: Tangents
) -> Tangents:
    """Tangents of one lane behind an event: guard `number` fired at the state y = (x1, x2, t)."""
    entry, exit_ = field_at(osc, before, y), field_at(osc, after, y)

    def behind(d):
        late = delay_of_event(osc, before, number, y, d)
        d1 = d[0] + (entry[0] - exit_[0]) * late
        d2 = d[1] + (entry[1] - exit_[1]) * late
        return d1, jnp.where(after.any_stuck, 0.0, d2)

    return tuple(behind(d) for d in tangents)


def delay_of_event(osc: OwnOscillator, before: Mode, number: Array, y, d) -> Array:
    """How much later guard `number` fires for the tangent d; 0 where it is only touched."""

    def guard(*y):
        guards = guards_at(osc, before, y)
        return jnp.sum(jnp.where(jnp.arange(guards.size) == number.astype(int), guards, 0.0))

    _, moved = jax.jvp(guard, y, (*d, jnp.zeros_like(d[0])))
    _, slope = jax.jvp(guard, y, field_at(osc, before, y))
    return step_to_root(moved, slope)


def course_of_step(osc: OwnOscillator, lanes: Lanes, new: Lanes, ones: Array) -> Course:
    """The `Course` of the lanes in a step."""
    ends = [(one.x1, one.x2, _x2_slope(osc, lanes.mode, one)) for one in (lanes, new)]
    return Course.of_step(ends[0], ends[1], materialise(new.t - lanes.t, ones))


def _x2_slope(osc: OwnOscillator, mode: Mode, lanes: Lanes) -> Array:
    """x2' in a mode. Where the mass sticks it is the belt's; `a` is then what friction holds."""
    rate = rate_of_stick(at_time(osc, lanes.t), mode)
    return jnp.where(mode.any_stuck, rate, lanes.a)
