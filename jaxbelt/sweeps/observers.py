"""Observers: final states, and what a reducer of the user's makes of the events."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.modes import Mode, select
from .events import event_kinds
from .lanes import Lanes, Observer, choose, once

# --- what repeats ---------------------------------------------------------------------------------


class Mark(eqx.Module):
    """A state of a run that later ones are compared with, arrays [lanes].

    When it is 1, 2, 4, ... states old, the next one takes its place (Brent's method), so a cycle of
    any number of such states is found at their first repetition or soon after.
    """

    x1: Array
    x2: Array
    code: Array
    t: Array
    events: Array
    age: Array
    limit: Array


def no_mark(lanes: Lanes) -> Mark:
    """Marks that nothing returns to."""
    zero, count = jnp.zeros_like(lanes.t), jnp.zeros_like(lanes.events)
    return Mark(zero + jnp.nan, zero, zero, zero, count, count, count)


def returned(mark: Mark, lanes: Lanes, close: Array | float) -> Array:
    """Whether the lanes are in the marked state again: mode, x2, and x1 to `close`.

    x2 is that of a belt, or 0, on both occasions, and so it is the same to the last bit.
    """
    same = (lanes.x2 == mark.x2) & (code_of(lanes.mode) == mark.code)
    return same & (jnp.abs(lanes.x1 - mark.x1) <= close)


def renew(mark: Mark, lanes: Lanes, at: Array, one: Array) -> tuple[Mark, Array]:
    """The marks after the lanes `at` such a state, and which of them are new."""
    age = mark.age + jnp.where(at, 1, 0)
    new = once(at & (age >= mark.limit), one)
    here = Mark(
        lanes.x1,
        lanes.x2,
        code_of(lanes.mode),
        lanes.t,
        lanes.events,
        jnp.zeros_like(age),
        jnp.maximum(2 * mark.limit, 1),
    )
    return select(new, here, eqx.tree_at(lambda m: m.age, mark, age)), new


def code_of(mode: Mode) -> Array:
    """A mode as one number."""
    total = jnp.zeros(())
    for i, code in enumerate(mode.codes):
        total = total + (code + 2) * 5.0**i
    return total


# --- final states ---------------------------------------------------------------------------------


class Final(Observer):
    """The state at t1.

    At the end of a stick phase the state is a function of the parameters alone. Where it repeats,
    everything repeats, to the last bit; so the run then goes on a whole number of loops at once
    (unless `skip` is false).
    """

    skip: bool = eqx.field(static=True, default=True)

    def start(self, osc, lanes):
        return no_mark(lanes)

    def watch(self, osc, lanes, passage, one, t1, tol):
        if not self.skip:
            return lanes
        mark: Mark = lanes.memory
        released = passage.released & ~lanes.mode.any_stuck
        period = lanes.t - mark.t
        repeats = released & returned(mark, lanes, 0.0) & (period > 0)
        loops = jnp.floor((t1 - lanes.t) / jnp.where(repeats, period, jnp.inf))
        loops = lax.stop_gradient(jnp.maximum(loops, 0.0))
        per_loop = lanes.events - mark.events
        t = jnp.where(repeats, lanes.t + loops * period, lanes.t)
        events = lanes.events + jnp.where(repeats, loops.astype(per_loop.dtype) * per_loop, 0)
        lanes = eqx.tree_at(lambda n: (n.t, n.events), lanes, (t, events))
        return eqx.tree_at(lambda n: n.memory, lanes, renew(mark, lanes, released, one)[0])

    def finish(self, osc, lanes):
        return {
            "x1_end": lanes.x1,
            "x2_end": lanes.x2,
            "mode_end": lanes.mode.codes,
            "n_events": lanes.events,
            "status": lanes.status,
        }


# --- a reducer of the user's ----------------------------------------------------------------------


class Event(eqx.Module):
    """An event of a run, as a reducer sees it: scalars t, x1, x2, kind (`EventKind`) and belt."""

    t: Array
    x1: Array
    x2: Array
    kind: Array
    belt: Array


class End(eqx.Module):
    """The end of a run, as a reducer sees it: scalars t, x1, x2 and status."""

    t: Array
    x1: Array
    x2: Array
    status: Array


class Reduce(Observer):
    """What a reducer of the user's makes of the events of a run; see `sweep.sweep`."""

    reducer: Any = eqx.field(static=True)

    def start(self, osc, lanes):
        axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, osc)
        return jax.vmap(self.reducer.init, in_axes=(axes, 0, 0))(osc, lanes.x1, lanes.x2)

    def watch(self, osc, lanes, passage, one, t1, tol):
        memory, busy = lanes.memory, lanes.run >= 0
        (fired, kind, belt), (released, *release) = event_kinds(lanes, passage)
        event = Event(passage.t, passage.x1, passage.x2, kind, belt)
        memory = self._update(memory, event, fired & busy)
        event = Event(lanes.t, lanes.x1, lanes.x2, *release)
        memory = self._update(memory, event, released & busy)
        return replace(lanes, memory=memory)

    def _update(self, memory, event, happened):
        return choose(happened, jax.vmap(self.reducer.update)(memory, event), memory)

    def finish(self, osc, lanes):
        end = End(lanes.t, lanes.x1, lanes.x2, lanes.status)
        return {**jax.vmap(self.reducer.finish)(lanes.memory, end), "status": lanes.status}
