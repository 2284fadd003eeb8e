"""Reducers that see the smooth stretches of a motion, too: moments in it and integrals over it.

Steps are those of `step.take_step`. One that passes a section is made again, shorter, until an end
of it is so near to the crossing that a Taylor step leads there; the run itself goes on from the
step's end. Stick phases are known in closed form. Integrals are summed by the stages of the steps,
as the motion is, and over stick phases by Gauss's rule.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..kernel.events import event_kinds
from ..kernel.lanes import Lanes, Observer, choose
from ..kernel.step import LANDING
from ..model.modes import Mode, mode_acceleration
from ..model.oscillator import Oscillator
from .moments import (
    AtEvents,
    AtTimes,
    checked,
    cut_of_step,
    per_lane,
    root_between,
    section_of,
    side_of,
    value_and_rate,
)
from .observers import RunEnd, RunEvent

#: Parts of a stick phase in which a crossing of a section is looked for.
PARTS = 4
#: Nodes and weights of Gauss's rule on [0, 1].
NODES = [(0.5 * (1 + x), 0.5 * w) for x, w in zip(*np.polynomial.legendre.leggauss(8), strict=True)]


class Motion(eqx.Module):
    """A state of a run, as `rates` sees it: scalars t, x1, x2, a (which is x2'), and forces, the
    friction force of each belt on the mass, [belts]."""

    t: Array
    x1: Array
    x2: Array
    a: Array
    forces: Array


class _Watched(eqx.Module):
    """What is known of the runs: the reducer's state, the side of each section, and the number of
    fixed times that are past, each [lanes]."""

    state: Any
    sides: tuple[Array, ...]
    passed: tuple[Array, ...]


class Along(Observer):
    """What a reducer with moments or integrals makes of a run; see `sweep.sweep`."""

    reducer: Any = eqx.field(static=True)

    @property
    def at(self) -> tuple[Any, ...]:
        return checked(getattr(self.reducer, "at", (AtEvents(),)))

    def _sections(self) -> list[tuple[int, int, Callable]]:
        """Number, direction and function of the moments that are sections."""
        return [
            (i, getattr(one, "direction", 0), section_of(one))
            for i, one in enumerate(self.at)
            if not isinstance(one, AtEvents | AtTimes)
        ]

    def _times(self) -> list[tuple[int, tuple[float, ...]]]:
        return [(i, tuple(one.times)) for i, one in enumerate(self.at) if isinstance(one, AtTimes)]

    # --- integrals

    def rates(self, osc: Oscillator, mode: Mode, t, x1, x2) -> Any:
        """The reducer's rates, a tree of arrays [lanes], or None if it has none."""
        if not hasattr(self.reducer, "rates"):
            return None
        residual = mode_acceleration(osc, mode, x1, x2)
        motion = Motion(
            t=t,
            x1=x1,
            x2=x2,
            a=jnp.where(mode.any_stuck, 0.0, residual),
            forces=jnp.stack(_forces(osc, mode, x2, residual), axis=-1),
        )
        return jax.vmap(self.reducer.rates, in_axes=(per_lane(osc), 0))(osc, motion)

    def start(self, osc, lanes):
        init = jax.vmap(self.reducer.init, in_axes=(per_lane(osc), 0, 0))
        sides = []
        for _, _, function in self._sections():
            value, rate = value_and_rate(function, osc, lanes.mode, lanes.x1, lanes.x2)
            sides.append(side_of(value, rate, jnp.ones_like(value)))
        passed = tuple(jnp.zeros_like(lanes.events) for _ in self._times())
        return _Watched(init(osc, lanes.x1, lanes.x2), tuple(sides), passed)

    def integrals(self, osc, lanes):
        """Zeros: integrals of runs that begin."""
        return jax.tree.map(
            jnp.zeros_like, self.rates(osc, lanes.mode, lanes.t, lanes.x1, lanes.x2)
        )

    # --- steps

    def follow(self, take_step, osc, window, one, lanes, t1, rtol, atol):
        seen: _Watched = lanes.memory
        until = t1
        for (_, times), passed in zip(self._times(), seen.passed, strict=True):
            until = jnp.minimum(until, _next(times, passed))
        rates = self.rates if hasattr(self.reducer, "rates") else None
        new = take_step(osc, window, one, lanes, until, rtol, atol, rates)
        h, reach = new.t - lanes.t, LANDING * jnp.sqrt(rtol)
        theta, found = jnp.ones_like(h), []
        for (_, _, function), side in zip(self._sections(), seen.sides, strict=True):
            starts = value_and_rate(function, osc, lanes.mode, lanes.x1, lanes.x2)
            ends = value_and_rate(function, osc, lanes.mode, new.x1, new.x2)
            theta = jnp.minimum(theta, cut_of_step(side, starts, ends, h, reach))
            found.append((starts, ends))
        cut = (h > 0) & (theta < 1)
        new = choose(cut, replace(lanes, h=theta * h), new)
        kept = (h > 0) & ~cut
        return self._asked_in_step(osc, lanes, new, kept, found)

    def _asked_in_step(self, osc, lanes: Lanes, new: Lanes, kept, found) -> Lanes:
        seen, sides = new.memory, []
        parts = zip(self._sections(), seen.sides, found, strict=True)
        for (number, direction, _), side, (starts, ends) in parts:
            # The end that is nearer, and from there by a Taylor step.
            (g0, r0), (g1, r1) = starts, ends
            now = jnp.where(kept, side_of(g1, r1, side), side)
            first = jnp.abs(g0 * r1) < jnp.abs(g1 * r0)
            near = choose(first, lanes, new)
            value, rate = jnp.where(first, g0, g1), jnp.where(first, r0, r1)
            delta = -value / jnp.where(rate == 0, 1.0, rate)
            delta = jnp.clip(delta, lanes.t - near.t, new.t - near.t)
            wanted = (now != side) & (now * direction >= 0)
            seen = self._ask(seen, osc, near, delta, wanted, number)
            sides.append(now)
        passed = []
        for (number, times), count in zip(self._times(), seen.passed, strict=True):
            due = kept & (new.t >= _next(times, count))
            seen = self._ask(seen, osc, new, jnp.zeros_like(new.t), due, number)
            passed.append(count + jnp.where(due, 1, 0))
        memory = replace(seen, sides=tuple(sides), passed=tuple(passed))
        return replace(new, memory=memory)

    def _ask(self, seen: _Watched, osc, lanes: Lanes, delta, wanted, number: int) -> _Watched:
        """The state after an update at a moment that is `delta` away from the lanes."""
        a = jnp.where(lanes.mode.any_stuck, 0.0, lanes.a)
        t, x1 = lanes.t + delta, lanes.x1 + delta * (lanes.x2 + 0.5 * delta * a)
        x2 = lanes.x2 + delta * a
        ends = [
            self.rates(osc, lanes.mode, *state)
            for state in ((lanes.t, lanes.x1, lanes.x2), (t, x1, x2))
        ]
        totals = jax.tree.map(lambda i, *r: i + 0.5 * delta * sum(r), lanes.integrals, *ends)
        none = jnp.zeros(t.shape, int)
        return self._update(seen, (t, x1, x2, none, none - 1), number, totals, wanted)

    def _update(self, seen: _Watched, place: Any, number: int, totals, wanted) -> _Watched:
        """The state after an update where it is wanted; place: t, x1, x2, kind and belt."""
        t, x1, x2, kind, belt = place
        event = RunEvent(t, x1, x2, kind, belt, jnp.full(t.shape, number), totals)
        state = jax.vmap(self.reducer.update)(seen.state, event)
        return replace(seen, state=choose(wanted, state, seen.state))

    # --- events and stick phases

    def watch(self, osc, lanes, passage, one, t1, tol):
        busy = lanes.run >= 0
        events = [i for i, one in enumerate(self.at) if isinstance(one, AtEvents)]
        (fired, *first), (released, *second) = event_kinds(lanes, passage)
        before = replace(lanes, t=passage.t, x1=passage.x1, x2=passage.x2, mode=passage.mode)
        seen = lanes.memory
        for number in events:
            place = passage.t, passage.x1, passage.x2, *first
            seen = self._update(seen, place, number, lanes.integrals, fired & busy)
        holds = busy & (lanes.t > passage.t)
        seen = self._held(seen, osc, before, lanes, holds)
        totals = self._over_hold(osc, before, lanes, holds)
        for number in events:
            place = lanes.t, lanes.x1, lanes.x2, *second
            seen = self._update(seen, place, number, totals, released & busy)
        lanes = replace(lanes, integrals=totals)
        sides = []
        for (number, direction, function), side in zip(self._sections(), seen.sides, strict=True):
            # Where the field jumps, its extrema do.
            value = value_and_rate(function, osc, lanes.mode, lanes.x1, lanes.x2)
            now = jnp.where(busy & ~lanes.done, side_of(*value, side), side)
            wanted = (now != side) & (now * direction >= 0)
            seen = self._ask(seen, osc, lanes, jnp.zeros_like(lanes.t), wanted, number)
            sides.append(now)
        return replace(lanes, memory=replace(seen, sides=tuple(sides)))

    def _over_hold(self, osc, before: Lanes, after: Lanes, holds) -> Any:
        """The integrals after a stick phase, or rest."""
        duration = jnp.where(holds, after.t - before.t, 0.0)
        totals = after.integrals
        for node, weight in NODES if totals is not None else ():
            t, x1 = before.t + node * duration, before.x1 + node * (after.x1 - before.x1)
            rates = self.rates(osc, before.mode, t, x1, before.x2)
            totals = jax.tree.map(
                lambda i, r, w=weight: i + jnp.where(holds, w * duration * r, 0.0), totals, rates
            )
        return totals

    def _held(self, seen: _Watched, osc, before: Lanes, after: Lanes, holds) -> _Watched:
        """Moments within a stick phase, or rest: x1 moves evenly."""

        def at(theta):
            t = before.t + theta * (after.t - before.t)
            x1 = before.x1 + theta * (after.x1 - before.x1)
            part = replace(before, t=t, x1=x1)
            return replace(part, integrals=self._over_hold(osc, before, part, holds))

        sides = []
        for (number, direction, function), side in zip(self._sections(), seen.sides, strict=True):

            def look(i, carry, number=number, direction=direction, function=function):
                seen, side = carry
                i = i.astype(side.dtype)

                def value(theta):
                    place = at_x1((i + theta) / PARTS)
                    return function(osc, before.mode, place, before.x2)

                end = value(jnp.ones_like(side))
                now = jnp.where(holds & (end != 0), jnp.sign(end), side)
                moment = at((i + root_between(value, side)) / PARTS)
                wanted = (now != side) & (now * direction >= 0)
                seen = self._ask(seen, osc, moment, jnp.zeros_like(side), wanted, number)
                return seen, now

            def at_x1(theta):
                return before.x1 + theta * (after.x1 - before.x1)

            seen, side = lax.fori_loop(0, PARTS, look, (seen, side))
            sides.append(side)
        seen = replace(seen, sides=tuple(sides))
        for k, (number, times) in enumerate(self._times()):
            seen = self._times_held(seen, osc, at, before, after, k, number, times)
        return seen

    def _times_held(
        self, seen: _Watched, osc, at, before, after, k: int, number: int, times
    ) -> _Watched:
        """The fixed times of a stick phase; and those at the start of a run."""
        busy = after.run >= 0

        def due(seen):
            return busy & (_next(times, seen.passed[k]) <= after.t)

        def ask(seen):
            wanted = due(seen)
            t = jnp.where(wanted, _next(times, seen.passed[k]), after.t)
            duration = after.t - before.t
            moment = at((t - before.t) / jnp.where(duration > 0, duration, 1.0))
            moment = replace(moment, t=t)
            seen = self._ask(seen, osc, moment, jnp.zeros_like(t), wanted, number)
            count = seen.passed[k] + jnp.where(wanted, 1, 0)
            return eqx.tree_at(lambda s: s.passed[k], seen, count)

        return lax.while_loop(lambda seen: jnp.any(due(seen)), ask, seen)

    def finish(self, osc, lanes):
        end = RunEnd(lanes.t, lanes.x1, lanes.x2, lanes.status, lanes.integrals)
        results = jax.vmap(self.reducer.finish)(lanes.memory.state, end)
        return {**results, "status": lanes.status}


def _next(times: tuple[float, ...], passed: Array) -> Array:
    """The next of the fixed times; inf when all are past."""
    return jnp.asarray((*times, np.inf))[jnp.minimum(passed, len(times))]


def _forces(osc: Oscillator, mode: Mode, x2: Array, residual: Array) -> list[Array]:
    """The friction force of each belt on the mass; stuck belts share what is needed by capacity."""
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
