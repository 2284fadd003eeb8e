"""Lanes at the start of their runs, and recorded rounds: events, then a few steps."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.modes import Mode, has_edges, mode_acceleration
from ..model.oscillator import Oscillator, has_possible_numbers
from ..model.transitions import at_focus, mode_of_state
from ..results import Status
from .events import pass_events
from .lanes import Lanes, code_of
from .step import STEP_SAFETY, attempt, first_step, take_step, window_of

#: Steps between two calls of `pass_events`: a call costs about as much as a step, and a lane that
#: waits for it is idle.
STEPS_PER_ROUND = 4


def lanes_in(mode: Mode, a, finite, rests, status, run, x1, x2, passes, rtol) -> Lanes:
    """Lanes that begin in a mode at the time 0, without memory and integrals.

    a: x2' at the start; finite: whether the start is finite; rests: whether it is a pseudo-focus;
    status: of starts that are finite and no pseudo-focus.
    """
    zero, count = jnp.zeros_like(x1), jnp.zeros_like(run)
    status = jnp.where(rests, Status.PSEUDO_FOCUS.value, status)
    status = jnp.where(finite, status, Status.NOT_FINITE.value)
    h = zero + first_step(rtol)
    return Lanes(
        run=run,
        first_pass=jnp.full_like(run, passes),
        t=zero,
        x1=x1,
        x2=x2,
        a=a + zero,
        h=h,
        pace=STEP_SAFETY / h,
        mode=Mode(tuple(code + zero for code in mode.codes)),
        events=count,
        status=status.astype(run.dtype),
        done=~finite | rests,
        lower=x2,
        upper=x2,
        memory=None,
    )


def lanes_at_start(osc: Oscillator, run, x1, x2, passes, rtol) -> Lanes:
    """Lanes at the start of their runs, without memory and integrals."""
    mode = mode_of_state(osc, x1, x2)
    finite = jnp.isfinite(x1) & jnp.isfinite(x2) & has_possible_numbers(osc)
    rests = at_focus(osc, x1, x2) if has_edges(osc) else jnp.zeros_like(finite)
    a = mode_acceleration(osc, mode, x1, x2)
    return lanes_in(mode, a, finite, rests, Status.OK.value, run, x1, x2, passes, rtol)


class Round(eqx.Module):
    """What happened to the lanes in a round, arrays [.., lanes].

    t, x1, x2, fired, number, captured, stuck, released, rests: of the events that it began with,
    see `lanes.Passage`; mode: the code of the mode after the guard, before a stick phase, see
    `code_of`. ts, x1s, x2s: before the first step and after each, steps + 1 arrays; mode_after: the
    code of the mode of these steps.
    """

    t: Array
    x1: Array
    x2: Array
    fired: Array
    number: Array
    captured: Array
    mode: Array
    stuck: Array
    released: Array
    rests: Array
    ts: tuple[Array, ...]
    x1s: tuple[Array, ...]
    x2s: tuple[Array, ...]
    mode_after: Array


def one_round(osc: Oscillator, lanes: Lanes, ones, t1, rtol, atol):
    """The lanes past the events and STEPS_PER_ROUND steps further, and the `Round`.

    Their memory is a `marks.LoopSearch` that counts rounds: at the end of a stick phase a lane
    skips all loops that it would repeat.
    """
    lanes, passage = pass_events(osc, lanes, t1, rtol, captures=True, derivatives=False)
    released = passage.released & ~lanes.mode.any_stuck
    repeat, t = lanes.memory.advanced(lanes, released, t1, ones)
    lanes = replace(lanes, t=t, memory=replace(repeat, number=repeat.number + 1))
    window = window_of(osc, lanes, extrema=None)

    def step(lanes, _):
        lanes = take_step(osc, window, ones, lanes, t1, rtol, atol)
        return lanes, (lanes.t, lanes.x1, lanes.x2)

    first = lanes.t, lanes.x1, lanes.x2
    after, rest = lax.scan(step, lanes, length=STEPS_PER_ROUND)
    ts, x1s, x2s = ((a, *(b[i] for i in range(STEPS_PER_ROUND))) for a, b in zip(first, rest))
    kept = Round(
        t=passage.t,
        x1=passage.x1,
        x2=passage.x2,
        fired=passage.fired,
        number=passage.number,
        captured=passage.captured,
        mode=code_of(passage.mode),
        stuck=passage.stuck,
        released=passage.released,
        rests=passage.rests,
        ts=ts,
        x1s=x1s,
        x2s=x2s,
        mode_after=code_of(lanes.mode),
    )
    return after, kept


def flown_on(osc: Oscillator, ones, mode: Mode, x1, x2, h) -> tuple[Array, Array]:
    """The states (x1, x2) one step of size h later, in the field of a slip mode, arrays [lanes]."""
    run = jnp.zeros(x1.shape, jnp.int32)
    lanes = lanes_at_start(osc, run, x1, x2, jnp.zeros((), jnp.int32), jnp.ones(()))
    a = mode_acceleration(osc, mode, x1, x2)
    lanes = eqx.tree_at(lambda n: (n.mode, n.a), lanes, (mode, a))
    window = window_of(osc, lanes, extrema=None)
    new = attempt(osc, window, ones, lanes, h, jnp.ones(()), jnp.ones(()), None)
    return new.x1, new.x2
