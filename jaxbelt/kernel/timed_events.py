"""Events of lanes of oscillators with a clock; `events` has those of lanes without.

What follows at a guard is decided by `model.instants`, lane by lane.
"""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array

from ..model.instants import (
    is_held_for_ever,
    on_guard_at,
    passed_guard,
)
from ..model.modes import (
    Mode,
    any_of,
    select,
    without_rounding,
)
from ..model.oscillator import Oscillator
from ..numerics.compiling import where_any
from ..results import Status
from .clocked import SHORTEST_TIMED_STEP, needed_or_rate, of_lanes
from .holds import FirstEnd, hold_from, is_steady
from .lanes import Lanes, Passage, in_few
from .step import (
    LANDING,
    LONGEST_STEP,
    STEP_SAFETY,
    first_step,
)


def pass_timed_events(
    osc: Oscillator,
    lanes: Lanes,
    t1: Array,
    rtol: Array,
    *,
    captures: bool,
    derivatives: bool,
    jumps: bool,
) -> tuple[Lanes, Passage]:
    """The lanes past the guards that they stand on, as from `events.pass_events`.

    jumps: whether a stick phase whose end is known is passed at once; else it is stepped through,
    for observers that look at times between the events.
    """
    landed = (lanes.h < 0) & ~lanes.done
    no, zero = jnp.zeros_like(landed), jnp.zeros_like(lanes.t)
    still = Passage(
        landed=no,
        fired=no,
        number=lanes.hit,
        before=lanes.mode,
        mode=lanes.mode,
        t=lanes.t,
        x1=lanes.x1,
        x2=lanes.x2,
        captured=no,
        rests=no,
        stuck=no,
        duration=zero,
        released=no,
        forever=no,
    )
    bare = replace(lanes, memory=None, integrals=None)

    def go_on(osc, lanes, t1):
        return _through_guards(osc, lanes, t1, rtol, captures, jumps)

    # Lanes that `in_few` does not serve wait for the next call.
    after, passage = in_few(landed, go_on, (osc, bare, t1), (bare, still))
    own = dict(memory=lanes.memory, integrals=lanes.integrals)
    return replace(after, done=after.done | (after.t >= t1), **own), passage


def _through_guards(
    osc: Oscillator, lanes: Lanes, t1, rtol, captures: bool, jumps: bool
) -> tuple[Lanes, Passage]:
    """`pass_timed_events` of lanes that have all landed."""
    fired = lanes.hit >= 0

    def through_guard(osc, mode, hit, x1, x2, t):
        after = passed_guard(osc, mode, hit, on_guard_at(osc, mode, hit, (x1, x2, t)))
        codes = Mode(tuple(code + jnp.zeros(()) for code in after.mode.codes))
        forever = is_held_for_ever(osc, codes, after.y)
        a = needed_or_rate(osc, codes, t, *after.y[:2])
        return after.y[0], after.y[1], a, codes, after.captured, forever

    args = lanes.mode, lanes.hit, lanes.x1, lanes.x2, lanes.t
    no = jnp.zeros_like(fired)
    state = lanes.x1, lanes.x2, lanes.a, lanes.mode, no, no
    passed = of_lanes(through_guard, osc, *args)
    x1, x2, a, mode, captured, forever = select(fired, passed, state)
    captured = captured & captures
    # Slip onset is tangent: x2' = 0 there up to rounding, for a law without a jump.
    a = jnp.where(fired & ~mode.any_stuck, without_rounding(a, x1), a)
    changed = any_of([p != q for p, q in zip(lanes.mode.codes, mode.codes, strict=True)])
    happened = fired & changed
    status = jnp.where(captured, Status.PSEUDO_FOCUS.value, lanes.status)
    status = jnp.where(forever, Status.STUCK_FOREVER.value, status).astype(lanes.status.dtype)
    # Where the guard vanishes with its slope, rounding chooses the mode, and may choose the same
    # one again and again: the shortest step is made without that guard.
    stays = fired & ~changed & ~mode.any_stuck
    shortest = SHORTEST_TIMED_STEP * LANDING * jnp.sqrt(rtol)
    begun = jnp.where(stays, shortest, first_step(rtol))
    # The motion of a mass that sticks is known: its first step need not be short.
    h = jnp.where(fired, jnp.where(mode.any_stuck, LONGEST_STEP, begun), abs(lanes.h))
    after = replace(
        lanes,
        x1=x1,
        x2=x2,
        a=a,
        h=h,
        pace=jnp.where(fired, STEP_SAFETY / first_step(rtol), lanes.pace),
        # At a pseudo-focus the mass is in no mode; the mode before is reported.
        mode=select(captured, lanes.mode, mode),
        events=lanes.events + jnp.where(happened, 1, 0).astype(lanes.events.dtype),
        status=status,
        done=captured,
        hit=jnp.where(stays, lanes.hit, -1).astype(lanes.hit.dtype),
    )
    stuck = released = no
    if is_steady(osc):
        after = _planned(osc, after, t1)
        if jumps:
            stuck = mode.any_stuck & ~after.done
            after, released = _jumped(osc, after, stuck, t1, rtol)
    passage = Passage(
        landed=~no,
        fired=happened,
        number=lanes.hit,
        before=lanes.mode,
        mode=mode,
        t=lanes.t,
        x1=x1,
        x2=x2,
        captured=captured,
        rests=no,
        stuck=stuck,
        duration=after.t - lanes.t,
        released=released,
        forever=forever,
    )
    return after, passage


def _planned(osc: Oscillator, lanes: Lanes, t1: Array) -> Lanes:
    """The lanes with the ends, `until` and `hit`, of the stick phases that begin or whose end was
    not found by the search before."""
    begins = lanes.mode.any_stuck & ~lanes.done
    asked = begins & (lanes.status != Status.STUCK_FOREVER.value)
    remaining = t1 - lanes.t
    found = hold_from(osc, lanes.mode, asked, lanes.x1, lanes.x2, lanes.t, remaining)
    never = FirstEnd(remaining, jnp.full_like(lanes.hit, -1))
    duration, number = select(asked, found, never)
    goes_on = (number < 0) & (duration >= remaining)
    return replace(
        lanes,
        until=jnp.where(begins, jnp.where(goes_on, jnp.inf, lanes.t + duration), lanes.until),
        hit=jnp.where(begins, number, lanes.hit).astype(lanes.hit.dtype),
        # A phase that ends at once: the lane has landed without a step.
        h=jnp.where(begins & ~goes_on & (duration <= 0), -LONGEST_STEP, lanes.h),
    )


def _jumped(osc: Oscillator, lanes: Lanes, stuck: Array, t1, rtol) -> tuple[Lanes, Array]:
    """The stuck lanes moved to the ends of their phases, and the mask of those that begin to slip
    there; lanes that come to an edge, or whose end is not known yet, have landed."""
    n = len(osc.belts)
    released = stuck & (lanes.until <= t1) & (lanes.hit >= 3 * n)
    t = jnp.where(stuck, jnp.minimum(lanes.until, t1), lanes.t)
    x1 = jnp.where(stuck, lanes.x1 + lanes.x2 * (t - lanes.t), lanes.x1)
    mode = select(
        released, lanes.mode.slipping(jnp.where(lanes.hit > 3 * n, 1.0, -1.0)), lanes.mode
    )
    a = where_any(stuck, lambda: needed_or_rate(osc, mode, t, x1, lanes.x2), lanes.a)
    h = jnp.where(stuck, jnp.where(released, first_step(rtol), -LONGEST_STEP), lanes.h)
    lanes = replace(
        lanes,
        t=t,
        x1=x1,
        a=jnp.where(stuck, jnp.where(released, without_rounding(a, x1), a), lanes.a),
        h=h,
        mode=mode,
        events=lanes.events + jnp.where(released, 1, 0).astype(lanes.events.dtype),
        hit=jnp.where(released, -1, lanes.hit).astype(lanes.hit.dtype),
    )
    return lanes, released
