"""The observer of forced oscillators: whether a run comes back, and how its neighbours move off.

Two tangents of each run are carried along: by the derivative of its steps at fixed times, and at
events by saltation, d+ = d + (f- - f+) d_tau, where d_tau is how much later the neighbour meets the
guard. Once in each period of the first frequency they are made orthogonal; the mean logarithms of
what they grew by are the exponents, and blocks of periods tell their standard errors. Behind a
stick phase one number is left of the start, the time, and the second exponent is -inf.

A motion is periodic where its whole state at the phase 0 comes back to one that is kept, and goes
on to do so until the end of the run, and its first exponent is below zero by three standard errors:
counting points alone would take narrow bands of chaos for points.
"""

import functools
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..kernel.clocked import flown
from ..kernel.lanes import Lanes, Observer, Passage, Variable, choose, code_of
from ..model.instants import field_at, guards_at
from ..model.oscillator import frequencies
from ..results import Status
from .moments import AtPhase

#: What a run of a forced oscillator leads to, in the order of their codes.
FORCED_KINDS = ("undecided", "periodic", "quasiperiodic or chaotic", "stuck")
UNDECIDED, PERIODIC, IRREGULAR, STUCK_FOR_EVER = range(4)
#: The first part of a run, over the whole, in which nothing is averaged.
TRANSIENT = 0.25
#: Periods in a block.
BLOCK = 8
#: A state has come back that is so many tolerances away, over the size of the motion.
CLOSE = 1e3
#: Times that it has to come back.
REPEATS = 4
#: Standard errors by which an exponent has to differ from zero.
SURE = 3.0
#: Phases of further frequencies have come back up to this angle.
SAME_PHASE = 1e-6


class _Frame(eqx.Module):
    """What is known of the runs, arrays [lanes].

    number: of the next phase 0. first, second: the tangents (x1, x2). grown: the logarithms of the
    block under way; blocks: how many there were; mean, spread: of the first exponent, its mean over
    the blocks and the sum of the squares of its distances from it; second_mean: of the second.
    x1, x2, code, t: the kept state; at: its number; n: after how many periods it was met; times:
    how often in a row; found: n as the last kept state had it; extent: extrema of x1 and x2 since
    then; sticks: whether the mass stuck to each belt behind the transient.
    """

    number: Array
    first: tuple[Array, Array]
    second: tuple[Array, Array]
    grown: tuple[Array, Array]
    in_block: Array
    blocks: Array
    mean: Array
    spread: Array
    second_mean: Array
    x1: Array
    x2: Array
    code: Array
    t: Array
    at: Array
    n: Array
    times: Array
    extent: tuple[Array, Array, Array, Array]
    sticks: tuple[Array, ...]


class Exponents(Observer):
    """The Lyapunov exponents of runs of forced oscillators, averaged from a quarter of them on."""

    variables: ClassVar[Mapping[str, Variable]] = {
        "exponent": Variable("largest Lyapunov exponent per unit of time"),
        "exponent_error": Variable("its standard error"),
        "second_exponent": Variable("second Lyapunov exponent, -inf where the mass sticks"),
        "sticks": Variable("whether the motion sticks to the belt", "bool", per_belt=True),
        "n_events": Variable("number of events", "int32"),
    }

    def start(self, osc, lanes):
        zero, count = jnp.zeros_like(lanes.t), jnp.zeros_like(lanes.events)
        one, nothing = zero + 1, zero + jnp.nan
        # The next phase 0, not that at which a run begins.
        turns = AtPhase().passed_at(osc, lanes.t, count)
        begins = AtPhase().next_time(osc, turns) <= lanes.t + 1e-12 * (1 + jnp.abs(lanes.t))
        return _Frame(
            number=turns + jnp.where(begins, 1, 0).astype(count.dtype),
            first=(one * np.cos(1.0), one * np.sin(1.0)),
            second=(-one * np.sin(1.0), one * np.cos(1.0)),
            grown=(zero, zero),
            in_block=count,
            blocks=count,
            mean=zero,
            spread=zero,
            second_mean=zero,
            x1=nothing,
            x2=nothing,
            code=zero,
            t=zero,
            at=count,
            n=count,
            times=count,
            extent=(lanes.x1, lanes.x1, lanes.x2, lanes.x2),
            sticks=tuple(zero > 1 for _ in osc.belts),
        )

    def follow(self, take_step, osc, window, ones, lanes: Lanes, t1, rtol, atol):
        frame: _Frame = lanes.memory
        next_time = AtPhase().next_time(osc, frame.number)
        until = jnp.minimum(t1, next_time)

        new = take_step(osc, window, ones, lanes, until, rtol, atol, None)
        h = lax.stop_gradient(new.t - lanes.t)
        way = functools.partial(flown, osc, window, ones, lanes, h)
        _, along = jax.linearize(way, lanes.x1, lanes.x2)
        first, second = along(*frame.first), along(*frame.second)
        x1_min, x1_max, x2_min, x2_max = frame.extent
        extent = (
            jnp.minimum(x1_min, new.x1),
            jnp.maximum(x1_max, new.x1),
            jnp.minimum(x2_min, new.x2),
            jnp.maximum(x2_max, new.x2),
        )
        frame = replace(frame, first=first, second=second, extent=extent)
        due = (lanes.h > 0) & (new.t >= next_time) & ~new.done
        return replace(new, memory=self._at_phase(osc, frame, new, due, t1, rtol))

    def _at_phase(self, osc, frame: _Frame, lanes: Lanes, due, t1, rtol) -> _Frame:
        """The frame after a phase 0 of the lanes that are there."""
        (a, b), (c, d) = frame.first, frame.second
        size = jnp.hypot(a, b)
        size = jnp.where(size > 0, size, 1e-300)
        u, v = a / size, b / size
        area = jnp.abs(c * -v + d * u)
        logs = jnp.log(size), jnp.log(jnp.maximum(area, 1e-300))
        counts = due & (lanes.t >= self._from(lanes, t1))
        grown = tuple(g + jnp.where(counts, x, 0.0) for g, x in zip(frame.grown, logs))
        in_block = frame.in_block + jnp.where(counts, 1, 0)
        full = in_block >= BLOCK
        blocks = frame.blocks + jnp.where(full, 1, 0)
        many = jnp.maximum(blocks, 1)
        mean, second = frame.mean, frame.second_mean
        off = grown[0] / BLOCK - mean
        new_mean = jnp.where(full, mean + off / many, mean)
        spread = frame.spread + jnp.where(full, off * (grown[0] / BLOCK - new_mean), 0.0)
        second = jnp.where(full, second + (grown[1] / BLOCK - second) / many, second)

        # Whether the state is back.
        x1_min, x1_max, x2_min, x2_max = frame.extent
        close = CLOSE * rtol
        code = code_of(lanes.mode)
        back = jnp.abs(lanes.x1 - frame.x1) <= close * (x1_max - x1_min)
        back = back & (jnp.abs(lanes.x2 - frame.x2) <= close * (x2_max - x2_min))
        back = back & (code == frame.code)
        passed = lanes.t - frame.t
        for frequency in frequencies(osc)[1:]:
            turns = frequency * passed / (2 * np.pi)
            back = back & (jnp.abs(turns - jnp.round(turns)) * 2 * np.pi <= SAME_PHASE)
        since = frame.number - frame.at
        fresh = frame.n == 0
        expected = ~fresh & (since % jnp.maximum(frame.n, 1) == 0)
        n = jnp.where(fresh & back, since, frame.n)
        times = jnp.where(back & (fresh | expected), frame.times + 1, frame.times)
        # What does not come back when it should is not periodic, up to now.
        lost = expected & ~back
        n, times = jnp.where(lost, 0, n), jnp.where(lost, 0, times)
        # Kept states are 1, 2, 4, ... periods old when the next one takes their place, and longer
        # where they are met again.
        age = since >= jnp.maximum(1, frame.at)
        renew = due & (jnp.isnan(frame.x1) | (age & (n == 0)) | lost)

        def kept(new, old):
            return jnp.where(renew, new, old)

        here = replace(
            frame,
            number=frame.number + jnp.where(due, 1, 0).astype(frame.number.dtype),
            first=(u, v),
            second=(-v, u),
            grown=tuple(jnp.where(full, 0.0, g) for g in grown),
            in_block=jnp.where(full, 0, in_block),
            blocks=blocks,
            mean=new_mean,
            spread=spread,
            second_mean=second,
            x1=kept(lanes.x1, frame.x1),
            x2=kept(lanes.x2, frame.x2),
            code=kept(code, frame.code),
            t=kept(lanes.t, frame.t),
            at=kept(frame.number, frame.at),
            n=jnp.where(renew, 0, n),
            times=jnp.where(renew, 0, times),
            extent=tuple(
                kept(x, old)
                for x, old in zip((lanes.x1, lanes.x1, lanes.x2, lanes.x2), frame.extent)
            ),
        )
        here = jax.tree.map(lambda new, old: new.astype(old.dtype), here, frame)
        return choose(due, here, frame)

    def _from(self, lanes: Lanes, t1):
        return TRANSIENT * t1

    def watch(self, osc, lanes, passage: Passage, ones, t1, tol):
        frame: _Frame = lanes.memory
        y = passage.x1, passage.x2, passage.t
        before, after = (field_at(osc, mode, y) for mode in (passage.before, passage.mode))

        def guard(*y):
            rows = guards_at(osc, passage.before, y)
            number = jnp.clip(passage.number, 0, rows.shape[0] - 1)
            return jnp.take_along_axis(rows, number[None], axis=0)[0]

        _, rate = jax.jvp(guard, y, before)

        def saltated(d):
            _, change = jax.jvp(guard, y, (*d, jnp.zeros_like(passage.t)))
            late = -change / jnp.where(rate == 0, 1.0, rate)
            late = jnp.where(passage.fired, late, 0.0)
            moved = (x + (f - g) * late for x, f, g in zip(d, before, after))
            x1, x2 = moved
            # A mass that sticks goes with its belt.
            return x1, jnp.where(passage.fired & passage.mode.any_stuck, 0.0, x2)

        late = lanes.t >= self._from(lanes, t1)
        sticks = tuple(
            known | (stuck & late)
            for known, stuck in zip(frame.sticks, lanes.mode.stuck, strict=True)
        )
        frame = replace(
            frame, first=saltated(frame.first), second=saltated(frame.second), sticks=sticks
        )
        return replace(lanes, memory=frame)

    def _exponents(self, osc, lanes):
        frame: _Frame = lanes.memory
        per_time = frequencies(osc)[0] / (2 * np.pi)
        known = (frame.blocks > 1) & (lanes.status == Status.OK.value)
        many = jnp.maximum(frame.blocks, 2)
        error = jnp.sqrt(jnp.maximum(frame.spread, 0.0) / (many * (many - 1)))
        sticks = jnp.any(jnp.stack(frame.sticks), axis=0)
        second = jnp.where(sticks, -jnp.inf, frame.second_mean)
        numbers = (jnp.where(known, x, jnp.nan) for x in (frame.mean, error, second))
        return tuple(x * per_time for x in numbers), sticks

    def finish(self, osc, lanes):
        (mean, error, second), _ = self._exponents(osc, lanes)
        return {
            "exponent": mean,
            "exponent_error": error,
            "second_exponent": second,
            "sticks": lanes.memory.sticks,
            "n_events": lanes.events,
            "status": lanes.status,
        }


class ForcedAttractor(Exponents):
    """What a run of a forced oscillator leads to, as far as it is told by t1, see the module."""

    variables: ClassVar[Mapping[str, Variable]] = {
        "kind": Variable("what the run leads to", "int8", meanings=dict(enumerate(FORCED_KINDS))),
        "periods": Variable("periods of the forcing in one of the motion, 0: unknown", "int32"),
        **Exponents.variables,
    }

    def finish(self, osc, lanes):
        frame: _Frame = lanes.memory
        found = super().finish(osc, lanes)
        mean, error = found["exponent"], found["exponent_error"]
        repeats = (frame.n > 0) & (frame.times >= REPEATS)
        # All of the last quarter of the run, too.
        long = (frame.number - frame.at) >= 0.25 * frame.number
        sinks = mean + SURE * error < 0
        periodic = repeats & long & sinks
        stuck = lanes.status == Status.STUCK_FOREVER.value
        irregular = ~periodic & (mean > SURE * error) & (mean > 0)
        kind = jnp.where(periodic, PERIODIC, jnp.where(irregular, IRREGULAR, UNDECIDED))
        kind = jnp.where(stuck, STUCK_FOR_EVER, kind)
        unsettled = (kind == UNDECIDED) & (lanes.status == Status.OK.value)
        status = jnp.where(unsettled, Status.NOT_SETTLED.value, lanes.status)
        return {
            **found,
            "kind": kind.astype(lanes.events.dtype),
            "periods": jnp.where(periodic, frame.n, 0).astype(lanes.events.dtype),
            "status": status.astype(lanes.status.dtype),
        }
