"""Events of the lanes: how a lane goes on where its step has landed, and what each event is called.

The rules of `model.transitions` decide how it goes on; stick phases are passed in closed form. A
sequence of events is kept as one number, its word.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..model.events import Signature, event_between
from ..model.modes import Mode, has_edges, mode_acceleration, select, without_rounding
from ..model.oscillator import Oscillator
from ..model.rest import is_at_rest, is_slow
from ..model.transitions import guard_passed, leave_slip, leave_stick, stick_phase
from ..numerics.compiling import where_any
from ..results import EventKind, Status
from .lanes import Lanes, Passage
from .step import NO_STEP, STEP_SAFETY, first_step


def pass_events(
    osc: Oscillator,
    lanes: Lanes,
    t1: Array,
    rtol: Array,
    *,
    captures: bool,
    derivatives: bool,
) -> tuple[Lanes, Passage]:
    """The lanes past the guards that they stand on, and past stick phases, to their end or to t1.

    captures: whether a run ends where a pseudo-focus captures it; derivatives: see
    `step.take_step`; with them, lanes at rest go on.
    """
    landed = (lanes.h < 0) & ~lanes.done
    # A lane may also have landed where x2 = 0, which is no guard.
    number = guard_passed(osc, lanes.mode, lanes.x1, lanes.x2)
    # At rest a lane stays, even on a guard.
    at_rest = is_at_rest(lanes.x1, lanes.x2, lanes.a)
    fired = landed & (number >= 0) & ~at_rest
    stands = (number >= 0) | (lanes.h >= -NO_STEP)
    rests = jnp.zeros_like(landed) if derivatives else landed & at_rest & stands
    after = leave_slip(osc, lanes.mode, jnp.where(fired, number, -1), lanes.x1, lanes.x2)
    captured = fired & after.captured & captures
    x1, x2 = after.x1, jnp.where(captured, 0.0, after.x2)

    stuck = after.mode.any_stuck & ~captured & ~lanes.done
    hold = where_any(
        stuck,
        lambda: _held(osc, after.mode, stuck, x1, x2, t1 - lanes.t),
        _Hold(after.mode, x1, x2, jnp.zeros_like(x1), stuck, stuck),
    )
    x2, released = hold.x2, hold.released
    mode = select(captured, lanes.mode, hold.mode)
    new_x1 = hold.x1
    t = jnp.where(stuck & ~released | rests, t1, lanes.t + hold.duration)
    if derivatives:
        a = mode_acceleration(osc, mode, new_x1, x2)
        creeps = (landed | released) & ~mode.any_stuck & ~captured & is_slow(x2, a)
        t, new_x1, x2 = _at_fixed_time(creeps, t, new_x1, x2, a)
    a, h = _set_off(osc, lanes, mode, new_x1, x2, fired, released, rtol)
    status = jnp.where(captured, Status.PSEUDO_FOCUS.value, lanes.status)
    passage = Passage(
        landed=landed,
        fired=fired,
        number=number,
        before=lanes.mode,
        mode=after.mode,
        t=lanes.t,
        x1=x1,
        x2=x2,
        captured=captured,
        rests=rests,
        stuck=stuck,
        duration=hold.duration,
        released=released,
        forever=hold.forever,
    )
    lanes = replace(
        lanes,
        t=t,
        x1=new_x1,
        x2=x2,
        a=jnp.where(landed | stuck, a, lanes.a),
        # The field is new after an event, and so is the step size.
        h=h,
        pace=jnp.where(fired, STEP_SAFETY / first_step(rtol), lanes.pace),
        mode=mode,
        events=lanes.events + jnp.where(fired, 1, 0) + jnp.where(released, 1, 0),
        status=jnp.where(hold.forever, Status.STUCK_FOREVER.value, status),
        done=lanes.done | captured | (t >= t1),
    )
    return lanes, passage


class _Hold(NamedTuple):
    """What a stick phase does to the lanes that are stuck, see `Passage`; mode, x1, x2: after it,
    unchanged in lanes that are not stuck."""

    mode: Mode
    x1: Array
    x2: Array
    duration: Array
    released: Array
    forever: Array


def _held(osc: Oscillator, mode: Mode, stuck, x1, x2, remaining) -> _Hold:
    """The stick phases of the lanes that are stuck, to their end or for the remaining time."""
    phase = stick_phase(osc, mode, x1)
    x2 = jnp.where(stuck, phase.x2, x2)
    outlasts = phase.duration >= remaining
    released = stuck & ~outlasts
    x1_after = jnp.where(outlasts, x1 + x2 * remaining, phase.x1)
    return _Hold(
        mode=select(released, leave_stick(osc, mode, phase), mode),
        x1=jnp.where(stuck, x1_after, x1),
        x2=x2,
        duration=jnp.where(stuck, jnp.where(outlasts, remaining, phase.duration), 0.0),
        released=released,
        forever=stuck & jnp.isinf(phase.duration),
    )


@jax.custom_jvp
def _at_fixed_time(creeps: Array, t: Array, x1: Array, x2: Array, a: Array):
    """t, x1, x2, with their derivatives at a fixed time where a lane creeps."""
    return t, x1, x2


@_at_fixed_time.defjvp
def _(primals, tangents):
    creeps, t, x1, x2, a = primals
    _, d_t, d_x1, d_x2, _ = tangents
    away = jnp.where(creeps, d_t, 0.0)
    return (t, x1, x2), (d_t - away, d_x1 - x2 * away, d_x2 - a * away)


def _set_off(osc, lanes, mode: Mode, x1, x2, fired, released, rtol) -> tuple[Array, Array]:
    """x2' and the step size with which the lanes go on in a mode."""
    a = mode_acceleration(osc, mode, x1, x2)
    # Slip onset is tangent: x2' = 0 there up to rounding, for a law without a jump.
    a = without_rounding(a, x1)
    h = jnp.where(fired, first_step(rtol), jnp.abs(lanes.h))
    if has_edges(osc):
        # Where a boundary meets an edge, one event follows the other at once: a lane that stands on
        # the next guard, and goes on through it, has landed there.
        corner = (fired | released) & ~mode.any_stuck & (guard_passed(osc, mode, x1, x2) >= 0)
        h = jnp.where(corner, -h, h)
    return a, h


def event_kinds(lanes: Lanes, passage: Passage) -> tuple[tuple[Array, Array, Array], ...]:
    """(happened, kind, belt) of the event that ended a step, and of the event that ended the stick
    phase after it."""
    return (
        (passage.fired, *event_between(passage.before.codes, passage.mode.codes)),
        (passage.released, *event_between(passage.mode.codes, lanes.mode.codes)),
    )


def append(word: Array, kind: Array, belt: Array, belts: int) -> Array:
    """A word with one more event; inf where a float64 would no longer hold it exactly."""
    longer = word * (len(EventKind) * belts + 1) + (1 + (kind - 1) * belts + belt)
    return jnp.where(longer < 2.0**53, longer, jnp.inf)


def word_events(word: int, belts: int) -> Signature:
    """The events, (kind, belt) each, that the word of an attractor's signature stands for.

    A word is a number in the base 4 belts + 1: a leading 1, then for each event
    1 + (kind - 1) belts + belt.
    """
    events = []
    while word > 1:
        word, digit = divmod(word, len(EventKind) * belts + 1)
        kind, belt = divmod(digit - 1, belts)
        events.append((EventKind(kind + 1), belt))
    return tuple(reversed(events))
