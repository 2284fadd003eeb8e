"""Samples of a run at given times: each from the arc that it lies in, all in parallel."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.instants import carried
from ..model.modes import Mode, select, stick_velocity
from ..model.oscillator import Oscillator, has_clock
from ..numerics.compiling import one_kernel
from ..numerics.padding import longer
from .integrators import Adaptive, slip_field

#: Lanes in which samples are computed.
SAMPLED = 32


@one_kernel
def _slip_flow(osc, mode, y, integrator):
    """The state after the integrator's span in the slip field of the mode."""
    return integrator.flow(functools.partial(slip_field, osc, mode), y)


def arcs_at(records, ts: Array) -> tuple[Any, Array, Array]:
    """For each time the arc that it lies in, this arc's number, and the time since its entry.

    records: arcs as a tree of arrays [arcs, ..], among them t and duration, NaN where unused.
    """
    entries = jnp.where(jnp.isnan(records.t), jnp.inf, lax.stop_gradient(records.t))
    numbers = jnp.maximum(jnp.searchsorted(entries, ts, side="right") - 1, 0)
    arcs = jax.tree.map(lambda leaf: leaf[numbers], records)
    return arcs, numbers, ts - arcs.t


def sampled(osc: Oscillator, records, ts: Array, rtol, atol) -> Array:
    """The states at the times ts, [samples, 2]; past the end of an arc those at its end."""
    wanted = ts.size
    if not wanted:
        return jnp.zeros((0, 2))
    ts = longer(ts, -(-wanted // SAMPLED) * SAMPLED)
    arcs, numbers, since = arcs_at(records, ts)
    since = jnp.minimum(since, arcs.duration)
    stuck = jnp.any(arcs.mode == 0, axis=1)
    return _flown_in_pieces(osc, rtol, atol, numbers, arcs, since, stuck)[:wanted]


def _flown_in_pieces(osc: Oscillator, rtol, atol, numbers, arcs, since, stuck) -> Array:
    """The states at times `since` the entries of arcs, [samples, 2]; numbers: those of the arcs."""

    def at(osc, rtol, atol, arc, since, stuck, goes_on, before, y):
        mode = Mode(tuple(arc.mode[j].astype(float) for j in range(len(osc.belts))))
        entry = tuple(arc.y[i] for i in range(y.size))
        start = select(goes_on, tuple(y[i] for i in range(y.size)), entry)
        duration = jnp.where(stuck, 0.0, since - jnp.where(goes_on, before, 0.0))
        flown = _slip_flow(osc, mode, start, Adaptive(osc, mode, duration, rtol, atol))
        if has_clock(osc):
            return jnp.stack(select(stuck, carried(osc, mode, entry, since), flown))
        v = stick_velocity(osc, mode, jnp.zeros(())) / osc.omega
        moved = arc.y[0] + v * since, v
        return jnp.stack(select(stuck, moved, flown))

    # The times are cut into one piece per lane. A lane goes from each sample to its next one, or
    # from the entry of the next one's arc; so, too, if under a trace the times do not increase.
    first = jnp.arange(since.size) % max(since.size // SAMPLED, 1) == 0
    before = jnp.roll(since, 1)
    goes_on = (numbers == jnp.roll(numbers, 1)) & (before <= since) & ~first
    rows = jax.tree.map(
        lambda leaf: jnp.swapaxes(leaf.reshape(SAMPLED, -1, *leaf.shape[1:]), 0, 1),
        (arcs, since, stuck, goes_on, before),
    )
    some = one_kernel(jax.vmap(at, (None, None, None, 0, 0, 0, 0, 0, 0)))

    def advance(y, row):
        y = some(osc, rtol, atol, *row, y)
        return y, y

    parts = arcs.y.shape[1]
    _, ys = lax.scan(advance, jnp.zeros((SAMPLED, parts)), rows)
    ys = jnp.swapaxes(ys, 0, 1).reshape(-1, parts)
    return ys if parts == 2 else ys[:, :2]
