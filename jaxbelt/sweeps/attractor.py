"""The observer of attractors: where each run leads."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..model.modes import (
    SMALLEST_DISC,
    begins_at_rest,
    disc_margin,
    mode_acceleration,
    select,
)
from ..results import Status
from .events import append, event_kinds
from .lanes import Observer, once
from .observers import Mark, no_mark, renew, returned

#: What a run leads to, in the order of their codes.
KINDS = ("undecided", "equilibrium", "cycle", "stuck")
UNDECIDED, EQUILIBRIUM, CYCLE, STUCK_FOR_EVER = range(4)


class _Loop(eqx.Module):
    """The loop under way, since the last mark; arrays [lanes], sticks one a belt.

    tops: how many there were since the last stick phase; previous, change: the top before, and how
    far it was from the one before that; word: the events,
    see `Attractor`; period and transient are set when the attractor is found.
    """

    mark: Mark
    x1_min: Array
    x1_max: Array
    sticks: tuple[Array, ...]
    word: Array
    tops: Array
    previous: Array
    change: Array
    kind: Array
    period: Array
    transient: Array
    loop_events: Array


class Attractor(Observer):
    """Where the run leads; it ends as soon as that is known.

    - A cycle: an orbit that sticks repeats the end of a stick phase; from there it is a function of
      the parameters alone, so it does so to the last bits. One that does not stick converges: its
      top (a maximum of x1, where x2 = 0) has repeated when what is left of the way to the limit, by
      the ratio of its last two changes, is below `REPEATED` times the amplitude.
    - An equilibrium: the run begins on one, or the orbit has entered a disc that is attracted by a
      fixed point, see `modes.disc_margin`. A pseudo-focus is recognised by `modes.is_captured`.
    - Stuck for ever: on a belt at rest.

    The signature of a cycle, (kind, belt) event by event, comes as a number, see `word_events`.
    """

    REPEATED: ClassVar[float] = 1e-7
    #: Motion that is smaller than so many tolerances is the integrator's.
    RESOLVED: ClassVar[float] = 1e3
    #: Until then extrema are left out, unless a stick phase has ended: about two loops.
    SETTLING: ClassVar[float] = 12.0
    #: Tops without a stick phase after which a run is taken to stick no more.
    SMOOTH: ClassVar[int] = 2

    def extrema(self, lanes):
        return ~jnp.isnan(lanes.memory.mark.x1) | (lanes.t > self.SETTLING)

    def start(self, osc, lanes):
        zero = jnp.zeros_like(lanes.t)
        count = jnp.zeros_like(lanes.events)
        nothing = zero + jnp.nan
        rests = begins_at_rest(osc, lanes.x1, lanes.x2)
        return _Loop(
            mark=no_mark(lanes),
            x1_min=lanes.x1,
            x1_max=lanes.x1,
            sticks=tuple(zero for _ in osc.belts),
            word=zero + 1,
            tops=count,
            previous=nothing,
            change=nothing,
            kind=count + jnp.where(rests, EQUILIBRIUM, UNDECIDED).astype(count.dtype),
            period=nothing,
            transient=jnp.where(rests, 0.0, nothing),
            loop_events=count,
        )

    def watch(self, osc, lanes, passage, one, t1, tol):
        loop: _Loop = lanes.memory
        sticks = tuple(
            total + jnp.where(stuck, passage.duration, 0.0)
            for total, stuck in zip(loop.sticks, passage.mode.stuck, strict=True)
        )
        word = loop.word
        for happened, kind, belt in event_kinds(lanes, passage):
            longer = append(word, kind, belt, len(osc.belts))
            word = jnp.where(happened & (belt >= 0), longer, word)
        # x1 is extreme where x2 = 0, and a step ends there.
        x1_min, x1_max = jnp.minimum(loop.x1_min, lanes.x1), jnp.maximum(loop.x1_max, lanes.x1)
        top = once(passage.landed & (lanes.x2 == 0) & (lanes.a < 0) & ~lanes.done, one)

        mark, amplitude = loop.mark, x1_max - x1_min
        change = lanes.x1 - loop.previous
        ratio = jnp.abs(change / jnp.where(loop.change == 0, 1.0, loop.change))
        left = jnp.where(ratio < 1, ratio / jnp.where(ratio < 1, 1 - ratio, 1.0), jnp.inf)
        moved, close = jnp.abs(lanes.x1 - mark.x1), amplitude * self.REPEATED
        converged = (moved * left <= close) | (moved < 30 * tol * amplitude)
        released = once(passage.released & ~lanes.mode.any_stuck & ~lanes.done, one)
        tops = jnp.where(released, 0, loop.tops + jnp.where(top, 1, 0))
        section = released | (top & (tops > self.SMOOTH))
        repeats = section & returned(mark, lanes, jnp.where(released, 1e-9 * amplitude, close))
        repeats = repeats & (released | converged)

        kind = jnp.where(repeats, CYCLE, UNDECIDED)
        # Motion that the tolerance does not resolve is at rest if it repeats or shrinks; but an
        # orbit that sticks is on a cycle, however small.
        small = jnp.maximum(amplitude, lanes.upper - lanes.lower) < self.RESOLVED * tol
        shrinks = section & (change < 0) & (loop.change < 0)
        kind = jnp.where(small & ~released & (repeats | shrinks), EQUILIBRIUM, kind)
        kind = jnp.where(passage.captured | passage.rests, EQUILIBRIUM, kind)
        kind = jnp.where(passage.forever, STUCK_FOR_EVER, kind)
        going_on = (loop.kind == UNDECIDED) & (lanes.run >= 0)
        kind = (jnp.where(going_on, kind, UNDECIDED) / one).astype(loop.kind.dtype)
        found = kind != UNDECIDED
        resting = found & (kind != CYCLE)
        renewed, new = renew(mark, lanes, section & ~found, one)
        # An attractor at rest is a point; a new mark begins a new loop.
        fresh = new | resting
        memory = _Loop(
            mark=renewed,
            x1_min=jnp.where(fresh, lanes.x1, x1_min),
            x1_max=jnp.where(fresh, lanes.x1, x1_max),
            sticks=tuple(
                jnp.where(found & passage.forever & stuck, jnp.inf, jnp.where(fresh, 0.0, total))
                for total, stuck in zip(sticks, passage.mode.stuck, strict=True)
            ),
            word=jnp.where(fresh, 1.0, word),
            tops=tops,
            previous=jnp.where(top, lanes.x1, loop.previous),
            change=jnp.where(top, change, loop.change),
            kind=jnp.where(found, kind, loop.kind),
            period=jnp.where(found & ~resting, lanes.t - mark.t, loop.period),
            transient=jnp.where(found, jnp.where(resting, passage.t, mark.t), loop.transient),
            loop_events=jnp.where(found & ~resting, lanes.events - mark.events, loop.loop_events),
        )
        # Decided lanes may have to wait until their result is taken.
        memory = select(loop.kind == UNDECIDED, memory, loop)
        return eqx.tree_at(
            lambda n: (n.lower, n.upper, n.done, n.memory),
            lanes,
            (
                jnp.where(fresh, lanes.x2, lanes.lower),
                jnp.where(fresh, lanes.x2, lanes.upper),
                lanes.done | (memory.kind != UNDECIDED),
                memory,
            ),
        )

    def rest(self, osc, lanes, one):
        loop: _Loop = lanes.memory
        zero = jnp.zeros_like(lanes.t)
        x1_rest = mode_acceleration(osc, lanes.mode, zero, zero)
        radius = jnp.maximum(jnp.hypot(lanes.x1 - x1_rest, lanes.x2), SMALLEST_DISC)
        margin = disc_margin(osc, lanes.mode, x1_rest, radius)
        margin = jnp.where(lanes.mode.any_stuck | lanes.done, 0.0, margin) / one
        found = margin > 0
        memory = eqx.tree_at(
            lambda m: (m.kind, m.x1_min, m.x1_max, m.sticks, m.transient),
            loop,
            (
                jnp.where(found, EQUILIBRIUM, loop.kind).astype(loop.kind.dtype),
                jnp.where(found, x1_rest, loop.x1_min),
                jnp.where(found, x1_rest, loop.x1_max),
                tuple(jnp.where(found, 0.0, total) for total in loop.sticks),
                jnp.where(found, lanes.t, loop.transient),
            ),
        )
        return eqx.tree_at(
            lambda n: (n.lower, n.upper, n.done, n.memory),
            lanes,
            (
                jnp.where(found, 0.0, lanes.lower),
                jnp.where(found, 0.0, lanes.upper),
                lanes.done | found,
                memory,
            ),
        )

    def finish(self, osc, lanes):
        loop: _Loop = lanes.memory
        undecided = (loop.kind == UNDECIDED) & (lanes.status == Status.OK.value)
        status = jnp.where(undecided, Status.NOT_SETTLED.value, lanes.status)
        word = jnp.where(jnp.isinf(loop.word), -1.0, loop.word)
        return {
            "kind": loop.kind,
            "signature": jnp.where(loop.kind == CYCLE, word, 0.0),
            "sticks": tuple(total > 0 for total in loop.sticks),
            "period": loop.period,
            "stick_duration": loop.sticks,
            "x1_min": loop.x1_min,
            "x1_max": loop.x1_max,
            "x2_min": lanes.lower,
            "x2_max": lanes.upper,
            "transient": loop.transient,
            "n_events": jnp.where(loop.kind == CYCLE, loop.loop_events, lanes.events),
            "status": status,
        }
