"""Observers of whole runs: the state at t1, and the results of a user's reducer of events."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernel.events import event_kinds
from ..kernel.lanes import Observer, Variable, choose
from ..kernel.marks import Mark
from ..model.oscillator import has_clock
from ..model.own_units import OwnOscillator, in_units_of_user
from ..results import Status

#: Meanings of contact codes.
CONTACTS = {
    -2: "below the belt's interval",
    -1: "slips with nu < omega x2",
    0: "stuck",
    1: "slips with nu > omega x2",
    2: "above the belt's interval",
}


class Final(Observer):
    """The state at t1.

    At the end of a stick phase the state is a function of the parameters alone. Once it repeats,
    everything repeats to the last bit; the run then skips all whole loops that are left (unless
    `skip` is false).
    """

    variables: ClassVar[Mapping[str, Variable]] = {
        "x1_end": Variable("displacement at t1", dimension="length"),
        "x2_end": Variable("velocity at t1", dimension="velocity"),
        "mode_end": Variable(
            "contact at t1, as in Trajectory.modes", "int8", per_belt=True, meanings=CONTACTS
        ),
        "n_events": Variable("number of events", "int32"),
    }
    skip: bool = eqx.field(static=True, default=True)

    def start(self, osc, lanes):
        return Mark.none(lanes.t)

    def watch(self, osc, lanes, passage, ones, t1, tol):
        # With a clock the state does not repeat where x1 and x2 do.
        if not self.skip or has_clock(osc):
            return lanes
        mark: Mark = lanes.memory
        released = passage.released & ~lanes.mode.any_stuck
        loops = mark.loops_left(lanes, released, t1)
        events = lanes.events + loops.astype(mark.count.dtype) * (lanes.events - mark.count)
        renewed, _ = mark.renewed(lanes, released, lanes.events, ones)
        return replace(lanes, t=mark.behind(lanes, loops), events=events, memory=renewed)

    def finish(self, osc, lanes):
        known = jnp.where(lanes.status == Status.NOT_FINITE.value, jnp.nan, 1.0)
        return {
            "x1_end": known * lanes.x1,
            "x2_end": known * lanes.x2,
            "mode_end": lanes.mode.codes,
            "n_events": lanes.events,
            "status": lanes.status,
        }


def as_given(
    function: Callable[..., Any], osc: OwnOscillator, x1: Array, x2: Array, *more: Array
) -> Any:
    """Calls a user's function for each lane, with an oscillator and a state in the user's units.

    more: further arguments, [lanes, ...], which are in the user's units already.
    """

    def of_lane(osc, x1, x2, *more):
        length = osc.units.length
        return function(in_units_of_user(osc), length * x1, length * x2, *more)

    # Leaves that differ from lane to lane are arrays [lanes]; the others are scalars.
    axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, osc)
    in_axes = (axes, 0, 0, *(0 for _ in more))
    return jax.vmap(of_lane, in_axes=in_axes)(osc, x1, x2, *more)


class RunEvent(eqx.Module):
    """A moment of a run, as a reducer sees it; scalars.

    Attributes:
        t: Time.
        x1: Displacement.
        x2: Velocity.
        kind: An `EventKind`; 0 at moments that are no events.
        belt: Number of the belt; -1 at moments that are no events.
        moment: For a reducer with `at` or `rates`: number of the moment in `at`.
        integrals: Likewise: integrals of the rates from the start of the run to t.
    """

    t: Array
    x1: Array
    x2: Array
    kind: Array
    belt: Array
    moment: Any = None
    integrals: Any = None


class RunEnd(eqx.Module):
    """The end of a run, as a reducer sees it; scalars.

    Attributes:
        t: Time.
        x1: Displacement.
        x2: Velocity.
        status: A `Status` code.
        integrals: For a reducer with `at` or `rates`: integrals of the rates over the run.
    """

    t: Array
    x1: Array
    x2: Array
    status: Array
    integrals: Any = None


class Reduce(Observer):
    """Observer of a user's reducer of events; see `sweep.sweep`."""

    reducer: Any = eqx.field(static=True)

    def start(self, osc, lanes):
        return as_given(self.reducer.init, osc, lanes.x1, lanes.x2)

    def watch(self, osc, lanes, passage, ones, t1, tol):
        memory, busy = lanes.memory, lanes.run >= 0
        (fired, kind, belt), (released, *release) = event_kinds(lanes, passage)
        length = osc.units.length
        event = RunEvent(passage.t, length * passage.x1, length * passage.x2, kind, belt)
        memory = self._update(memory, event, fired & busy)
        event = RunEvent(lanes.t, length * lanes.x1, length * lanes.x2, *release)
        memory = self._update(memory, event, released & busy)
        return replace(lanes, memory=memory)

    def _update(self, memory, event, happened):
        return choose(happened, jax.vmap(self.reducer.update)(memory, event), memory)

    def finish(self, osc, lanes):
        length = osc.units.length
        end = RunEnd(lanes.t, length * lanes.x1, length * lanes.x2, lanes.status)
        return {**jax.vmap(self.reducer.finish)(lanes.memory, end), "status": lanes.status}
