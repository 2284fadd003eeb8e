"""Samples of a run at given times: each from the arc that it lies in, all in parallel."""

import functools

import jax
import jax.numpy as jnp
from jax import lax

from ..model.modes import Mode, select, stick_velocity
from ..model.oscillator import Oscillator
from ..numerics.compiling import in_turn, one_kernel
from ..results import Status
from .integrators import Adaptive, slip_field
from .runs import ArcRecord, RunState, stacked_codes
from .sensitivities import with_derivatives

#: Lanes in which samples are computed.
SAMPLED = 32


@one_kernel
def _slip_flow(osc, mode, y, integrator):
    """The state after the integrator's span in the slip field of the mode."""
    return integrator.flow(functools.partial(slip_field, osc, mode), y)


def states_at(osc: Oscillator, final: RunState, records: ArcRecord, ts, rtol, atol):
    """States and modes at the times ts, each from the arc that it lies in."""
    entries = jnp.where(jnp.isnan(records.t), jnp.inf, lax.stop_gradient(records.t))
    wanted = ts.size
    if wanted:
        ts = jnp.pad(ts, (0, -wanted % SAMPLED), mode="edge")
    # Past the end of the last arc the run either rests, with a reason, or is unknown.
    rests = (final.status == Status.PSEUDO_FOCUS) | (final.status == Status.STUCK_FOREVER)

    numbers = jnp.maximum(jnp.searchsorted(entries, ts, side="right") - 1, 0)
    arcs = jax.tree.map(lambda leaf: leaf[numbers], records)
    beyond = ts > final.t
    since = jnp.where(beyond, 0.0, ts - arcs.t)
    stuck = jnp.any(arcs.mode == 0, axis=1)
    given = lax.stop_gradient((osc, rtol, atol, numbers, arcs, beyond, since, stuck))
    ys = in_turn(_sampled)(*given)
    ys = with_derivatives(osc, arcs.y, since, arcs.mode, ys)
    afterwards = jnp.where(rests, jnp.stack(final.y), jnp.nan)
    ys = jnp.where(jnp.isnan(arcs.t)[:, None], jnp.nan, ys)
    modes = jnp.where(beyond[:, None], stacked_codes(final.mode), arcs.mode)
    return jnp.where(beyond[:, None], afterwards, ys)[:wanted], modes[:wanted]


def _sampled(osc: Oscillator, rtol, atol, numbers, arcs: ArcRecord, beyond, since, stuck):
    """The states at a time `since` the entries of arcs, [samples, 2]; numbers: of the arcs."""

    def at(osc, rtol, atol, arc, since, stuck, goes_on, before, y):
        mode = Mode(tuple(arc.mode[j].astype(float) for j in range(len(osc.belts))))
        start = select(goes_on, (y[0], y[1]), (arc.y[0], arc.y[1]))
        duration = jnp.where(stuck, 0.0, since - jnp.where(goes_on, before, 0.0))
        flown = _slip_flow(osc, mode, start, Adaptive(duration, rtol, atol))
        v = stick_velocity(osc, mode, jnp.zeros(())) / osc.omega
        carried = arc.y[0] + v * since, v
        return jnp.stack(select(stuck, carried, flown))

    # As many pieces of the times as lanes. Each lane goes from one of its samples to the next, or
    # from where the next one's arc begins; so, too, where under a trace the times do not increase.
    first = jnp.arange(since.size) % max(since.size // SAMPLED, 1) == 0
    before = jnp.roll(since, 1)
    goes_on = (numbers == jnp.roll(numbers, 1)) & (before <= since) & ~beyond & ~first
    rows = jax.tree.map(
        lambda leaf: jnp.swapaxes(leaf.reshape(SAMPLED, -1, *leaf.shape[1:]), 0, 1),
        (arcs, since, stuck, goes_on, before),
    )
    some = one_kernel(jax.vmap(at, (None, None, None, 0, 0, 0, 0, 0, 0)))

    def advance(y, row):
        y = some(osc, rtol, atol, *row, y)
        return y, y

    _, ys = lax.scan(advance, jnp.zeros((SAMPLED, 2)), rows)
    return jnp.swapaxes(ys, 0, 1).reshape(-1, 2)
