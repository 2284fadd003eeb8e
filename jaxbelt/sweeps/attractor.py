"""The observer of attractors: what each run leads to, reported as soon as it is certain."""

import functools
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..cycles.settling import REPEATED, way_left
from ..kernel.events import append, event_kinds, word_events
from ..kernel.lanes import Lanes, Observer, Passage, Variable, materialise
from ..kernel.marks import Mark
from ..model.events import signature_name
from ..model.modes import select
from ..model.own_units import OwnOscillator
from ..model.rest import is_neutral, settling_margin
from ..model.transitions import begins_at_rest
from ..results import Status

#: Kinds of attractors, in the order of their codes.
KINDS = ("undecided", "equilibrium", "cycle", "stuck")
UNDECIDED, EQUILIBRIUM, CYCLE, STUCK_FOR_EVER = range(4)
#: Internal code of a closed orbit in a continuum of such; `finish` reports it as undecided.
IN_CONTINUUM = len(KINDS)


def signature(word: int, belts: int) -> str:
    """Name of a cycle's signature; "none" at rest, "long" if it has too many events for a word."""
    if word < 1:
        return "none" if word == 0 else "long"
    return signature_name(word_events(word, belts))


class _LoopSoFar(eqx.Module):
    """The loop since the mark, and the attractor once found, arrays [lanes].

    Attributes:
        mark: State that later ones are compared with.
        x1_min: Smallest x1.
        x1_max: Largest x1.
        sticks: Time stuck to each belt.
        word: The events of the loop as a number, see `events.word_events`.
        tops: Number of maxima of x1 since the last stick phase.
        previous: x1 at the last maximum.
        previous_t: Time of the last maximum.
        change: Difference of x1 at the last two maxima.
        wake: Time before which steps do not end at maxima.
        kind: Kind of the attractor, once found.
        period: Its period, once found.
        transient: Time at which it was reached; of a cycle, the beginning of the repeated loop.
        loop_events: Number of events in one loop.
    """

    mark: Mark
    x1_min: Array
    x1_max: Array
    sticks: tuple[Array, ...]
    word: Array
    tops: Array
    previous: Array
    previous_t: Array
    change: Array
    wake: Array
    kind: Array
    period: Array
    transient: Array
    loop_events: Array


def _extended(osc: OwnOscillator, loop: _LoopSoFar, lanes: Lanes, passage: Passage) -> _LoopSoFar:
    """The loop with the passage added: extrema of x1, time stuck, events."""
    sticks = tuple(
        total + jnp.where(stuck, passage.duration, 0.0)
        for total, stuck in zip(loop.sticks, passage.mode.stuck, strict=True)
    )
    word = loop.word
    for happened, kind, belt in event_kinds(lanes, passage):
        longer = append(word, kind, belt, len(osc.belts))
        word = jnp.where(happened & (belt >= 0), longer, word)
    x1_min, x1_max = jnp.minimum(loop.x1_min, lanes.x1), jnp.maximum(loop.x1_max, lanes.x1)
    return replace(loop, x1_min=x1_min, x1_max=x1_max, sticks=sticks, word=word)


class Attractor(Observer):
    """Observer of the attractor that a run leads to; the run ends as soon as it is known.

    - A cycle that sticks repeats the state at the end of a stick phase; from there the orbit is a
      function of the parameters alone, so it repeats to the last bits. A cycle that does not stick
      is approached; it is found when a top (a maximum of x1, where x2 = 0) repeats, see `settling`.
    - An equilibrium: the run begins on one, or the orbit has entered a disc that a fixed point
      attracts, see `rest.settling_margin`. A pseudo-focus is recognised by `is_captured`.
    - Stuck for ever: on a belt at rest.
    - None of these: a closed orbit in a continuum, as around a centre, see `rest.is_neutral`. It
      attracts nothing, and the run ends undecided with the status NEUTRAL.

    The signature of a cycle, (kind, belt) event by event, is a number, see `word_events`. The
    variables of the attractor are NaN where it is undecided, and `sticks` is false.
    """

    variables: ClassVar[Mapping[str, Variable]] = {
        "kind": Variable("what the run leads to", "int8", meanings=dict(enumerate(KINDS))),
        "signature": Variable("events of one loop of the cycle", "int64", name_of=signature),
        "sticks": Variable("whether the attractor sticks to the belt", "bool", per_belt=True),
        "period": Variable("period of the cycle", dimension="time"),
        "stick_duration": Variable(
            "time stuck to the belt in one loop", per_belt=True, dimension="time"
        ),
        "x1_min": Variable("smallest displacement on the attractor", dimension="length"),
        "x1_max": Variable("largest displacement on the attractor", dimension="length"),
        "x2_min": Variable("smallest velocity on the attractor", dimension="velocity"),
        "x2_max": Variable("largest velocity on the attractor", dimension="velocity"),
        "transient": Variable("time at which the attractor was reached", dimension="time"),
        "n_events": Variable("number of events (of a cycle: in one loop)", "int32"),
    }
    #: States at the ends of two stick phases count as equal if x1 differs by no more than this
    #: times the amplitude; only rounding separates them.
    EXACT: ClassVar[float] = 1e-9
    #: A top that moves by less than this many tolerances, relative to the amplitude, moves by
    #: rounding alone.
    STANDS: ClassVar[float] = 30.0
    #: Motion smaller than this many tolerances, in own units, is an error of the integrator.
    RESOLVED: ClassVar[float] = 1e3
    #: Time before which steps do not end at extrema, unless a stick phase has ended: about two
    #: loops, which are transient in nearly every run.
    SETTLING: ClassVar[float] = 12.0
    #: A spiral is slow if the ratio of the last two moves of the top is between these and the move
    #: is larger than FAR times the amplitude: it takes 40 more loops until tops repeat.
    SLOW: ClassVar[tuple[float, float]] = (0.8, 1.25)
    FAR: ClassVar[float] = 1e-3
    #: Number of loops for which the steps of a slow spiral do not end at tops.
    ASLEEP: ClassVar[int] = 16
    #: Number of tops without a stick phase after which a run counts as one that no longer sticks.
    SMOOTH: ClassVar[int] = 2

    def extrema(self, lanes):
        return ~jnp.isnan(lanes.memory.mark.x1) | (lanes.t > lanes.memory.wake)

    def start(self, osc, lanes):
        zero = jnp.zeros_like(lanes.t)
        count = jnp.zeros_like(lanes.events)
        nothing = zero + jnp.nan
        rests = begins_at_rest(osc, lanes.x1, lanes.x2)
        return _LoopSoFar(
            mark=Mark.none(lanes.t),
            x1_min=lanes.x1,
            x1_max=lanes.x1,
            sticks=tuple(zero for _ in osc.belts),
            word=zero + 1,
            tops=count,
            previous=nothing,
            previous_t=nothing,
            change=nothing,
            wake=zero + self.SETTLING,
            kind=count + jnp.where(rests, EQUILIBRIUM, UNDECIDED).astype(count.dtype),
            period=nothing,
            transient=jnp.where(rests, 0.0, nothing),
            loop_events=count,
        )

    def watch(self, osc, lanes, passage, ones, t1, tol):
        loop: _LoopSoFar = lanes.memory
        seen = _extended(osc, loop, lanes, passage)
        # x1 is extreme where x2 = 0, and a step ends there.
        top = materialise(passage.landed & (lanes.x2 == 0) & (lanes.a < 0) & ~lanes.done, ones)
        released = materialise(passage.released & ~lanes.mode.any_stuck & ~lanes.done, ones)
        tops = jnp.where(released, 0, loop.tops + jnp.where(top, 1, 0))
        section = released | (top & (tops > self.SMOOTH))
        change = lanes.x1 - loop.previous
        met, kind = self._kind(seen, lanes, passage, section, released, change, tol)
        going_on = (loop.kind == UNDECIDED) & (lanes.run >= 0)
        kind = materialise(jnp.where(going_on, kind, UNDECIDED), ones).astype(loop.kind.dtype)
        found = kind != UNDECIDED
        resting = found & (kind != CYCLE)
        cycle = found & ~resting
        mark = loop.mark
        slow = self._is_slow(loop, change, seen)
        sleeps = materialise(top & (tops > self.SMOOTH) & ~found & slow, ones)
        # An orbit that is back at its mark but not settled gets a new mark, so that the next loop
        # is compared with this one.
        renewed, new = mark.renewed(lanes, section & ~found, lanes.events, ones, met)
        # Extrema are reset: an attractor at rest is a point, and a new mark begins a new loop.
        fresh = new | resting
        asleep = self.ASLEEP * (lanes.t - loop.previous_t)
        memory = _LoopSoFar(
            mark=select(sleeps, Mark.none(lanes.t), renewed),
            x1_min=jnp.where(fresh, lanes.x1, seen.x1_min),
            x1_max=jnp.where(fresh, lanes.x1, seen.x1_max),
            sticks=tuple(
                jnp.where(found & passage.forever & stuck, jnp.inf, jnp.where(fresh, 0.0, total))
                for total, stuck in zip(seen.sticks, passage.mode.stuck, strict=True)
            ),
            word=jnp.where(fresh, 1.0, seen.word),
            tops=jnp.where(sleeps, 0, tops),
            previous=jnp.where(top, jnp.where(sleeps, jnp.nan, lanes.x1), loop.previous),
            previous_t=jnp.where(top, lanes.t, loop.previous_t),
            change=jnp.where(top, change, loop.change),
            wake=jnp.where(sleeps, lanes.t + asleep, loop.wake),
            kind=jnp.where(found, kind, loop.kind),
            period=jnp.where(cycle, lanes.t - mark.t, loop.period),
            transient=jnp.where(found, jnp.where(resting, passage.t, mark.t), loop.transient),
            loop_events=jnp.where(cycle, lanes.events - mark.count, loop.loop_events),
        )
        # Decided lanes keep their results until these are collected.
        memory = select(loop.kind == UNDECIDED, memory, loop)
        return replace(
            lanes,
            lower=jnp.where(fresh, lanes.x2, lanes.lower),
            upper=jnp.where(fresh, lanes.x2, lanes.upper),
            done=lanes.done | (memory.kind != UNDECIDED),
            memory=memory,
        )

    def _is_slow(self, loop: _LoopSoFar, change, seen: _LoopSoFar) -> Array:
        """Whether tops move as in a slow spiral, so that they cannot repeat soon."""
        way, before, (least, most) = jnp.abs(change), jnp.abs(loop.change), self.SLOW
        alike = (change * loop.change > 0) & (way > least * before) & (way < most * before)
        return alike & (way > self.FAR * (seen.x1_max - seen.x1_min))

    def _kind(
        self, loop: _LoopSoFar, lanes, passage, section, released, change, tol
    ) -> tuple[Array, Array]:
        """Mask of lanes that are back at their marks, and kinds of attractors found, [lanes].

        section: lanes in a state to compare with their marks; released: lanes at the end of a stick
        phase; change: change of x1 since the last top.
        """
        amplitude = loop.x1_max - loop.x1_min
        left = way_left(change, loop.change)
        moved, close = jnp.abs(lanes.x1 - loop.mark.x1), amplitude * REPEATED
        # A top may drift with moves below the tolerance, each a little smaller than the last one.
        on_its_way = (change * loop.change > 0) & (moved * left < amplitude)
        stands = (moved < self.STANDS * tol * amplitude) & ~on_its_way
        # Around a pseudo-focus the moves of a slow spiral shrink like the square of its size.
        converged = (moved * left <= close) | stands & (amplitude > jnp.sqrt(tol))
        exact = self.EXACT * amplitude
        met = section & loop.mark.met_by(lanes, jnp.where(released, exact, close))
        repeats = met & (released | converged)

        kind = jnp.where(repeats, CYCLE, UNDECIDED)
        # Motion that the tolerance does not resolve is at rest if it repeats or shrinks; but an
        # orbit that sticks is on a cycle, however small.
        small = jnp.maximum(amplitude, lanes.upper - lanes.lower) < self.RESOLVED * tol
        shrinks = section & (change < 0) & (loop.change < 0)
        kind = jnp.where(small & ~released & (repeats | shrinks), EQUILIBRIUM, kind)
        kind = jnp.where(passage.captured | passage.rests, EQUILIBRIUM, kind)
        return met, jnp.where(passage.forever, STUCK_FOR_EVER, kind)

    def watch_rarely(self, osc, lanes, ones):
        loop: _LoopSoFar = lanes.memory
        margin, x1_rest, lost = settling_margin(osc, lanes.mode, lanes.x1, lanes.x2)
        slips = ~lanes.mode.any_stuck & ~lanes.done
        found = materialise(jnp.where(slips, margin, 0.0), ones) > 0
        extent = (loop.x1_min, loop.x1_max), (lanes.lower, lanes.upper)
        time = jnp.where(loop.period > 0, loop.period, 1.0)
        stuck = functools.reduce(jnp.maximum, loop.sticks) / time
        neutral = (loop.kind == CYCLE) & is_neutral(osc, *extent, stuck)
        kind = jnp.where(neutral, IN_CONTINUUM, jnp.where(found, EQUILIBRIUM, loop.kind))
        memory = replace(
            loop,
            kind=kind.astype(loop.kind.dtype),
            x1_min=jnp.where(found, x1_rest, loop.x1_min),
            x1_max=jnp.where(found, x1_rest, loop.x1_max),
            sticks=tuple(jnp.where(found, 0.0, total) for total in loop.sticks),
            transient=jnp.where(found, lanes.t, loop.transient),
        )
        return replace(
            lanes,
            lower=jnp.where(found, 0.0, lanes.lower),
            upper=jnp.where(found, 0.0, lanes.upper),
            # An orbit at a repelling equilibrium up to rounding would stay until t1: undecided.
            done=lanes.done | found | (lost & slips),
            memory=memory,
        )

    def finish(self, osc, lanes):
        loop: _LoopSoFar = lanes.memory
        neutral = loop.kind == IN_CONTINUUM
        undecided = (loop.kind == UNDECIDED) | neutral
        unsettled = undecided & (lanes.status == Status.OK.value)
        reason = jnp.where(neutral, Status.NEUTRAL.value, Status.NOT_SETTLED.value)
        status = jnp.where(unsettled, reason, lanes.status)
        word = jnp.where(jnp.isinf(loop.word), -1.0, loop.word)

        def of_attractor(value):
            """The value, or NaN where the run is undecided: its last loop is no attractor."""
            return jnp.where(undecided, jnp.nan, value)

        return {
            "kind": jnp.where(neutral, UNDECIDED, loop.kind).astype(loop.kind.dtype),
            "signature": jnp.where(loop.kind == CYCLE, word, 0.0),
            "sticks": tuple((total > 0) & ~undecided for total in loop.sticks),
            "period": of_attractor(loop.period),
            "stick_duration": tuple(of_attractor(total) for total in loop.sticks),
            "x1_min": of_attractor(loop.x1_min),
            "x1_max": of_attractor(loop.x1_max),
            "x2_min": of_attractor(lanes.lower),
            "x2_max": of_attractor(lanes.upper),
            "transient": of_attractor(loop.transient),
            "n_events": jnp.where(loop.kind == CYCLE, loop.loop_events, lanes.events),
            "status": status,
        }
