"""The observer of reducers that are also updated between events, and integrals along the motion.

Steps are those of `step.take_step`. A step that passes a section is repeated with a shorter length
until one of its ends is so near to the crossing that a Taylor step leads there; the run itself goes
on from the end of the step. Stick phases are known in closed form. Integrals are advanced by
the Runge-Kutta stages, like the state, and over stick phases by Gauss's rule.

The search for the time of a moment carries no derivatives. One more Newton step, of size 0 but for
rounding, gives that time the derivative of the implicit function, so results have the right
derivatives.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..kernel.events import event_kinds
from ..kernel.lanes import Lanes, Observer, choose, materialise
from ..kernel.step import LANDING
from ..model.instants import field_at
from ..model.modes import Mode, mode_acceleration
from ..model.oscillator import Oscillator, at_time, has_clock
from ..model.own_units import OwnOscillator
from ..numerics.implicit import step_to_root
from .moments import (
    PARTS_OF_STEP,
    AtEvents,
    AtPhase,
    AtTimes,
    Course,
    Cut,
    checked,
    crossings_held,
    cut_of_step,
    section_of,
    side_of,
    value_and_rate,
)
from .observers import RunEnd, RunEvent, as_given

#: Nodes and weights of Gauss's rule on [0, 1].
NODES = [(0.5 * (1 + x), 0.5 * w) for x, w in zip(*np.polynomial.legendre.leggauss(8), strict=True)]


class Motion(eqx.Module):
    """State of a run as `rates` sees it.

    Attributes:
        t: Time, scalar.
        x1: Displacement, scalar.
        x2: Velocity, scalar.
        a: Acceleration x2', scalar.
        forces: Friction force of each belt on the mass, [belts].
    """

    t: Array
    x1: Array
    x2: Array
    a: Array
    forces: Array


def rates_of(reducer: Any, osc: Oscillator, motion: Motion) -> Any:
    """The rates of a reducer; integers and booleans become floats, because their integrals are."""

    def integrand(rate):
        rate = jnp.asarray(rate)
        return rate if jnp.iscomplexobj(rate) else rate.astype(motion.x1.dtype)

    return jax.tree.map(integrand, reducer.rates(osc, motion))


class _Watched(eqx.Module):
    """Memory of the observer, arrays [lanes].

    state: the reducer's state; sides: the side of each section, 1 or -1; passed: for each `AtTimes`
    or `AtPhase` the number of its next time.
    """

    state: Any
    sides: tuple[Array, ...]
    passed: tuple[Array, ...]


class Along(Observer):
    """Observer of a reducer with moments or integrals; see `sweep.sweep`."""

    steps_while_stuck: ClassVar[bool] = True
    reducer: Any = eqx.field(static=True)

    @property
    def at(self) -> tuple[Any, ...]:
        return checked(getattr(self.reducer, "at", (AtEvents(),)))

    def _sections(self) -> list[tuple[int, int, Callable]]:
        """(number in `at`, direction, function) of each moment that is a section."""
        return [
            (i, getattr(moment, "direction", 0), section_of(moment))
            for i, moment in enumerate(self.at)
            if not isinstance(moment, AtEvents | AtTimes | AtPhase)
        ]

    def _times(self) -> list[tuple[int, AtTimes | AtPhase]]:
        return [
            (i, moment) for i, moment in enumerate(self.at) if isinstance(moment, AtTimes | AtPhase)
        ]

    # --- integrals

    def rates(self, osc: OwnOscillator, mode: Mode, t, x1, x2) -> Any:
        """The reducer's rates, a tree of arrays [lanes], or None without a method `rates`."""
        if not hasattr(self.reducer, "rates"):
            return None
        now = at_time(osc, t)
        residual = mode_acceleration(now, mode, x1, x2)
        length = osc.units.length
        a = length * _field(osc, mode, x1, x2, *_clock(osc, t))
        forces = jnp.stack([length * f for f in _forces(now, mode, x2, residual)], axis=-1)

        def rates(osc, x1, x2, *rest):
            return rates_of(self.reducer, osc, Motion(rest[0], x1, x2, *rest[1:]))

        return as_given(rates, osc, x1, x2, t, a, forces)

    def start(self, osc, lanes):
        sides = []
        for _, _, function in self._sections():
            value, rate = _seen(function, osc, lanes, lanes.x1, lanes.x2)
            sides.append(side_of(value, rate, jnp.ones_like(value)))
        passed = tuple(one.passed_at(osc, lanes.t, lanes.events) for _, one in self._times())
        state = as_given(self.reducer.init, osc, lanes.x1, lanes.x2)
        return _Watched(state, tuple(sides), passed)

    def integrals(self, osc, lanes):
        """Zeros in the structure of the rates: the integrals of runs that begin."""
        return jax.tree.map(
            jnp.zeros_like, self.rates(osc, lanes.mode, lanes.t, lanes.x1, lanes.x2)
        )

    # --- steps

    def follow(self, take_step, osc, window, ones, lanes, t1, rtol, atol):
        seen: _Watched = lanes.memory
        until = t1
        for (_, times), passed in zip(self._times(), seen.passed, strict=True):
            until = jnp.minimum(until, times.next_time(osc, passed))
        rates = self.rates if hasattr(self.reducer, "rates") else None
        new = take_step(osc, window, ones, lanes, until, rtol, atol, rates)
        h, reach = lax.stop_gradient(new.t - lanes.t), LANDING * jnp.sqrt(rtol)
        starts, ends = (
            tuple(materialise(x, ones) for x in _state_and_rate(osc, end)) for end in (lanes, new)
        )
        course = Course.of_step(starts, ends, materialise(h, ones))
        cuts = []
        for (_, _, function), side in zip(self._sections(), seen.sides, strict=True):
            looks = [
                course.sample(function, osc, lanes.mode, jnp.full_like(h, k / PARTS_OF_STEP))
                for k in range(PARTS_OF_STEP + 1)
            ]
            looks = [(materialise(v, ones), materialise(r, ones)) for v, r in looks]
            cuts.append(cut_of_step(side, looks, h, reach))
        theta = functools.reduce(jnp.minimum, [cut.theta for cut in cuts], jnp.ones_like(h))
        theta = lax.stop_gradient(materialise(theta, ones))
        cut = (h > 0) & (theta < 1)
        new = choose(cut, replace(lanes, h=theta * h), new)
        return self._asked_in_step(osc, ones, lanes, new, (h > 0) & ~cut, cuts)

    def _asked_in_step(self, osc, ones, lanes: Lanes, new: Lanes, kept, cuts: list[Cut]) -> Lanes:
        seen, sides, found = new.memory, [], []
        parts = zip(self._sections(), seen.sides, cuts, strict=True)
        for (number, direction, function), side, cut in parts:
            now = _seen(function, osc, new, new.x1, new.x2)
            now = jnp.where(kept, side_of(*now, side), side)
            # A Taylor step leads to the crossing from the end of the step that is nearer to it.
            near = choose(cut.at_start, lanes, new)
            delta = jnp.zeros_like(near.t)
            for _ in range(2):
                delta = _to_section(function, osc, near, delta, lanes.t - near.t, new.t - near.t)
                delta = materialise(delta, ones)
            wanted = (now != side) & (now * direction >= 0)
            time = jnp.where(wanted, lax.stop_gradient(near.t + delta), jnp.inf)
            found.append((time, jnp.full_like(lanes.events, number), cut.at_start, delta))
            sides.append(now)
        for _ in found:
            # In order of time: one section may be crossed near the start, another near the end.
            time, number, at_start, delta = functools.reduce(_sooner, found)
            wanted = jnp.isfinite(time)
            seen = self._ask(seen, osc, choose(at_start, lanes, new), delta, wanted, number)
            found = [(jnp.where(one[1] == number, jnp.inf, one[0]), *one[1:]) for one in found]
        passed = []
        for (number, times), count in zip(self._times(), seen.passed, strict=True):
            due = kept & (new.t >= times.next_time(osc, count))
            seen = self._ask(seen, osc, new, jnp.zeros_like(new.t), due, number)
            passed.append(count + jnp.where(due, 1, 0))
        memory = replace(seen, sides=tuple(sides), passed=tuple(passed))
        return replace(new, memory=memory)

    def _ask(self, seen: _Watched, osc, lanes: Lanes, delta, wanted, number) -> _Watched:
        """The memory after `update` a time `delta` after the lanes, where `wanted` holds."""
        t, (x1, x2) = lanes.t + delta, _moved(osc, lanes, delta)
        ends = [
            self.rates(osc, lanes.mode, *state)
            for state in ((lanes.t, lanes.x1, lanes.x2), (t, x1, x2))
        ]
        totals = jax.tree.map(lambda i, *r: i + 0.5 * delta * sum(r), lanes.integrals, *ends)
        none = jnp.zeros(t.shape, int)
        place = t, x1, x2, none, none - 1
        return self._update(seen, osc, place, number, totals, wanted)

    def _update(self, seen: _Watched, osc, place: Any, number, totals, wanted) -> _Watched:
        """The memory after `update` where `wanted` holds; place: (t, x1, x2, kind, belt)."""
        t, x1, x2, kind, belt = place
        number = jnp.broadcast_to(jnp.asarray(number, int), t.shape)
        length = osc.units.length
        event = RunEvent(t, length * x1, length * x2, kind, belt, number, totals)
        state = jax.vmap(self.reducer.update)(seen.state, event)
        return replace(seen, state=choose(wanted, state, seen.state))

    # --- events and stick phases

    def watch(self, osc, lanes, passage, ones, t1, tol):
        busy = lanes.run >= 0
        events = [i for i, moment in enumerate(self.at) if isinstance(moment, AtEvents)]
        (fired, *first), (released, *second) = event_kinds(lanes, passage)
        before = replace(lanes, t=passage.t, x1=passage.x1, x2=passage.x2, mode=passage.mode)
        seen = lanes.memory
        for number in events:
            place = passage.t, passage.x1, passage.x2, *first
            seen = self._update(seen, osc, place, number, lanes.integrals, fired & busy)
        holds = busy & (lanes.t > passage.t)
        seen = self._held(seen, osc, ones, before, lanes, holds)
        totals = self._over_hold(osc, before, lanes, holds)
        for number in events:
            place = lanes.t, lanes.x1, lanes.x2, *second
            seen = self._update(seen, osc, place, number, totals, released & busy)
        lanes = replace(lanes, integrals=totals)
        sides = []
        for (number, direction, function), side in zip(self._sections(), seen.sides, strict=True):
            # Where the field jumps at an event, a section such as x2' = 0 may be passed by a jump.
            value = _seen(function, osc, lanes, lanes.x1, lanes.x2)
            now = jnp.where(busy & ~lanes.done, side_of(*value, side), side)
            wanted = (now != side) & (now * direction >= 0)
            seen = self._ask(seen, osc, lanes, jnp.zeros_like(lanes.t), wanted, number)
            sides.append(now)
        return replace(lanes, memory=replace(seen, sides=tuple(sides)))

    def _over_hold(self, osc, before: Lanes, after: Lanes, holds) -> Any:
        """The integrals after a stick phase, or rest, in lanes where `holds`."""
        duration = jnp.where(holds, after.t - before.t, 0.0)
        totals = after.integrals
        for node, weight in NODES if totals is not None else ():
            t, x1 = before.t + node * duration, before.x1 + node * (after.x1 - before.x1)
            rates = self.rates(osc, before.mode, t, x1, before.x2)
            totals = jax.tree.map(
                lambda i, r, w=weight: i + jnp.where(holds, w * duration * r, 0.0), totals, rates
            )
        return totals

    def _held(self, seen: _Watched, osc, ones, before: Lanes, after: Lanes, holds) -> _Watched:
        """The memory after the moments within a stick phase, or rest; x1 is linear in time."""
        frozen, start, end = lax.stop_gradient((osc, before, after))
        course = Course((start.x1, end.x1 - start.x1), start.x2, end.t - start.t)
        tables, sides = [], []
        for (_, direction, function), side in zip(self._sections(), seen.sides, strict=True):

            def sample(theta, function=function):
                values = course.sample(function, frozen, start.mode, theta)
                return materialise(values[0], ones), materialise(values[1], ones)

            side, *table = crossings_held(sample, side, direction, holds)
            sides.append(side)
            tables.append(tuple(table))
        seen = replace(seen, sides=tuple(sides))

        def pending(state):
            _, tables, due = state
            flags = [*due, *(jnp.isfinite(_first(table)) for table in tables)]
            return jnp.any(functools.reduce(jnp.logical_or, flags, jnp.zeros_like(after.done)))

        # `_due` once per pass: a second computation rounded differently, and the loop never ended.
        def ask(state):
            seen, tables, due = state
            seen, tables = self._ask_next_held(seen, tables, due, osc, before, after, holds)
            return seen, tables, self._due(seen, osc, after)

        return lax.while_loop(pending, ask, (seen, tables, self._due(seen, osc, after)))[0]

    def _due(self, seen: _Watched, osc: OwnOscillator, after: Lanes) -> list[Array]:
        """For each `AtTimes` or `AtPhase` the mask of runs at or past its next time."""
        return [
            (after.run >= 0) & (times.next_time(osc, passed) <= after.t)
            for (_, times), passed in zip(self._times(), seen.passed, strict=True)
        ]

    def _ask_next_held(self, seen: _Watched, tables, dues, osc, before, after, holds):
        """The memory after the next moment of each lane, and the tables without that moment.

        tables: crossings of each section, from `crossings_held`; dues: from `_due`.
        """
        duration = after.t - before.t
        safe = jnp.where(duration > 0, duration, 1.0)
        theta, number = jnp.full_like(duration, jnp.inf), jnp.zeros(duration.shape, int)
        for (moment, _, _), table in zip(self._sections(), tables, strict=True):
            first = _first(table)
            number = jnp.where(first < theta, moment, number)
            theta = jnp.minimum(theta, first)
        exact, passed = before.t + jnp.where(jnp.isfinite(theta), theta, 0.0) * duration, []
        for (moment, times), count, due in zip(self._times(), seen.passed, dues, strict=True):
            time = jnp.where(due, times.next_time(osc, count), after.t)
            earlier = due & ((time - before.t) / safe <= lax.stop_gradient(theta))
            theta = jnp.where(earlier, (time - before.t) / safe, theta)
            exact, number = jnp.where(earlier, time, exact), jnp.where(earlier, moment, number)
            passed.append((due, moment))
        wanted = jnp.isfinite(theta)
        theta = jnp.where(wanted, theta, 0.0)

        part = replace(before, t=exact, x1=before.x1 + theta * (after.x1 - before.x1))
        part = replace(part, integrals=self._over_hold(osc, before, part, holds))
        delta = jnp.zeros_like(theta)
        for moment, _, function in self._sections():
            way = _to_section(function, osc, part, delta, delta, delta)
            delta = jnp.where(number == moment, way, delta)
        seen = self._ask(seen, osc, part, delta, wanted, number)
        counts = tuple(
            count + jnp.where(due & (number == moment), 1, 0)
            for count, (due, moment) in zip(seen.passed, passed, strict=True)
        )
        tables = [
            tuple(
                jnp.where((number == moment)[None] & (t <= theta[None]), jnp.inf, t) for t in table
            )
            for (moment, _, _), table in zip(self._sections(), tables, strict=True)
        ]
        return replace(seen, passed=counts), tables

    def finish(self, osc, lanes):
        x1, x2 = osc.units.length * lanes.x1, osc.units.length * lanes.x2
        end = RunEnd(lanes.t, x1, x2, lanes.status, lanes.integrals)
        results = jax.vmap(self.reducer.finish)(lanes.memory.state, end)
        return {**results, "status": lanes.status}


def _sooner(one: tuple[Array, ...], other: tuple[Array, ...]) -> tuple[Array, ...]:
    """Lane by lane the earlier of two moments, tuples of arrays [lanes] with the time first."""
    later = other[0] < one[0]
    return tuple(jnp.where(later, b, a) for a, b in zip(one, other, strict=True))


def _first(table: tuple[Array, ...]) -> Array:
    """Theta of the earliest crossing in each lane, [lanes]; inf where there is none."""
    return functools.reduce(jnp.minimum, [jnp.min(part, axis=0) for part in table])


def _state_and_rate(osc: OwnOscillator, lanes: Lanes) -> tuple[Array, Array, Array]:
    """x1, x2 and x2' of slipping lanes in their mode, without derivatives."""
    osc, lanes = lax.stop_gradient((osc, lanes))
    if has_clock(osc):
        return lanes.x1, lanes.x2, _field(osc, lanes.mode, lanes.x1, lanes.x2, lanes.t)
    return lanes.x1, lanes.x2, mode_acceleration(osc, lanes.mode, lanes.x1, lanes.x2)


def _field(osc: OwnOscillator, mode: Mode, x1: Array, x2: Array, t: Array | None = None) -> Array:
    """x2' in a mode; x2' of the belt where the mass sticks. t: the time; None without a clock."""
    if t is not None:
        return field_at(osc, mode, (x1, x2, t))[1]
    return jnp.where(mode.any_stuck, 0.0, mode_acceleration(osc, mode, x1, x2))


def _clock(osc: OwnOscillator, t: Array) -> tuple[Array, ...]:
    return (t,) if has_clock(osc) else ()


def _seen(function, osc: OwnOscillator, lanes: Lanes, x1: Array, x2: Array):
    """A section's value and its rate in time at the state (x1, x2), in the lanes' mode."""
    a = _field(osc, lanes.mode, x1, x2, *_clock(osc, lanes.t))
    return value_and_rate(function, osc, lanes.mode, x1, x2, a)


def _moved(osc: OwnOscillator, lanes: Lanes, delta: Array) -> tuple[Array, Array]:
    """The state a time `delta` later, by Taylor's formula of order 3 in x1 and 2 in x2."""
    field = functools.partial(_field, osc, lanes.mode)
    x1, x2 = lanes.x1, lanes.x2
    clock = _clock(osc, lanes.t)
    a = field(x1, x2, *clock)
    ways = x2, a, *map(jnp.ones_like, clock)
    _, jerk = jax.jvp(field, (x1, x2, *clock), ways)
    x1 = x1 + delta * (x2 + delta / 2 * (a + delta / 3 * jerk))
    return x1, x2 + delta * (a + delta / 2 * jerk)


def _to_section(function, osc, lanes: Lanes, delta, low, high) -> Array:
    """Time to a section: one Newton step from `delta`, clipped to [low, high].

    Its derivatives are those of the implicit function, even where it is clipped.
    """
    delta = lax.stop_gradient(delta)
    later = replace(lanes, t=lanes.t + delta) if has_clock(osc) else lanes
    value, rate = _seen(function, osc, later, *_moved(osc, lanes, delta))
    step = step_to_root(value, lax.stop_gradient(rate))
    return lax.stop_gradient(jnp.clip(delta + step, low, high) - step) + step


def _forces(osc: Oscillator, mode: Mode, x2: Array, residual: Array) -> list[Array]:
    """Friction force of each belt on the mass; stuck belts share the holding force by capacity."""
    limits = [
        jnp.where(stuck, belt.load * belt.friction.static, 0.0)
        for belt, stuck in zip(osc.belts, mode.stuck, strict=True)
    ]
    total = sum(limits, start=jnp.zeros_like(x2))
    share = -residual / jnp.where(total > 0, total, 1.0)
    forces = []
    for belt, sign, limit in zip(osc.belts, mode.signs, limits, strict=True):
        speed = belt.velocity - osc.omega * x2
        speed = jnp.where(sign == 0, jnp.abs(speed), sign * speed)
        forces.append(sign * (belt.load * belt.friction.mu(speed)) + limit * share)
    return forces
