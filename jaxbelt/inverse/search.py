"""First guesses of `fit`, from which the exact motion is followed.

The record is cut into windows shorter than half a loop, over which no phase is lost. Each window
starts from the record itself, by a local polynomial. The user's guess comes first. Where it does
not lead to the record, the misfit of the smooth formulation (tanh for sgn, a fixed step) is
minimised by Adam (optax) from several starts under `vmap`. The result is biased, by the smoothing
and by the windows' starts, but near; less near where a law changes faster than the smoothing.
"""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from ..model.oscillator import Oscillator, at_time
from ..model.own_units import in_own_units
from ..motion.smoothing import smooth_field
from ..numerics.compiling import jit
from .record import Record, quickest
from .selection import Selection

#: Steps of the search, and its learning rate in units of a parameter's size.
SEARCH_STEPS, LEARNING_RATE = 60, 0.1


def _smooth_misfit(unknown, selection: Selection, osc: Oscillator, record: Record, eps, steps: int):
    """Misfit of the smooth formulation over all windows, about |error| / (0.02 `record.scale`)."""
    u, shift = unknown
    osc = in_own_units(selection.put(osc, selection.values(u)), record.length)
    h = record.times[:, -1] / steps

    def field(y):
        return smooth_field(osc, y, eps)

    def advance(y, _):
        def ahead(slope, fraction):
            return tuple(a + fraction * h * b for a, b in zip(y, slope, strict=True))

        k1 = field(y)
        k2 = field(ahead(k1, 0.5))
        k3 = field(ahead(k2, 0.5))
        k4 = field(ahead(k3, 1.0))
        slope = tuple((a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(k1, k2, k3, k4))
        new = ahead(slope, 1.0)
        return new, jnp.stack(new[:2], axis=-1)

    start = (record.starts[:, 0] + shift * record.lacks, record.starts[:, 1])
    if record.clock is not None:
        start = (*start, record.clock[:, 0])
    _, path = lax.scan(advance, start, None, length=steps)
    path = jnp.concatenate([jnp.stack(start[:2], axis=-1)[None], path])
    # Linear interpolation between steps at the times of the data is accurate enough here.
    at = jnp.clip(record.times[:, :-1] / h[:, None], 0.0, steps)
    before = jnp.minimum(at.astype(int), steps - 1)
    piece = jnp.arange(h.size)[:, None]
    rest = (at - before.astype(float))[..., None]
    predicted = (1 - rest) * path[before, piece] + rest * path[before + 1, piece]
    scale = jnp.broadcast_to(0.02 * record.scale, predicted.shape)
    off = jnp.where(record.weights > 0, (predicted - record.values) / scale, 0.0)
    # The misfit grows like |off| only, so windows that are far off do not outvote the others.
    return jnp.mean(jnp.sqrt(1 + off**2) - 1)


@jit
def _adam(starts, selection: Selection, osc: Oscillator, record: Record, eps, steps: int):
    """Adam from many starts, (u [starts, p], shift [starts]); returns ends and misfits."""
    import optax  # import takes a quarter of a second, which only this search needs

    optimizer = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, SEARCH_STEPS))

    def misfit(unknown):
        return _smooth_misfit(unknown, selection, osc, record, eps, steps)

    @jax.vmap
    def slopes(unknown):
        # Forward mode: there are few unknowns, and reverse mode would have to keep every step.
        numbers, unravel = ravel_pytree(unknown)
        return unravel(jax.jacfwd(lambda numbers: misfit(unravel(numbers)))(numbers))

    def improve(state, _):
        unknown, memory = state
        slope = slopes(unknown)
        # Optax multiplies its integer counts with floats.
        with jax.numpy_dtype_promotion("standard"):
            change, memory = optimizer.update(slope, memory)
        return (optax.apply_updates(unknown, change), memory), None

    state = (starts, optimizer.init(starts))
    (unknown, _), _ = lax.scan(improve, state, None, length=SEARCH_STEPS)
    return unknown, jax.vmap(misfit)(unknown)


def first_guesses(
    selection: Selection, u, osc: Oscillator, record: Record, starts: int
) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """Yields the guess, then the ends of the search, best first; ends close to another count once.

    Each comes with the starts of its windows and its misfit (NaN for the guess).
    """
    yield np.asarray(u), np.asarray(record.starts), np.nan
    # eps is the velocity over which tanh changes its sign. A record of one velocity, of a mass that
    # sticks throughout, has no scale of velocity; that of x1 replaces it. Steps of the scheme are
    # stable up to 2.8 over the slope of the friction; two belts with one velocity double that
    # slope.
    eps = 0.1 * max(float(record.scale[1]), 0.1 * float(record.scale[0]))
    own = in_own_units(osc, record.length)
    now = own if record.clock is None else at_time(own, record.clock)
    slope = max(np.max(belt.load * belt.friction.static) for belt in now.belts) / eps
    rate = max(20.0 * quickest(osc), slope / 1.3)
    steps = 16 * int(np.ceil(float(jnp.max(record.times)) * rate / 16))
    rng = np.random.default_rng(0)
    spread = rng.standard_normal((starts, u.size + 1))
    spread[0] = 0.0
    first = (jnp.asarray(u + 0.3 * spread[:, :-1]), jnp.asarray(spread[:, -1]))
    found: Any = _adam(first, selection, osc, record, jnp.asarray(eps), steps)
    ends, shifts, misfits = map(np.asarray, jax.tree.leaves(found))
    chosen: list[int] = []
    for i in np.argsort(misfits):
        near = any(np.max(np.abs(ends[i] - ends[j])) < 0.1 for j in chosen)
        if np.isfinite(misfits[i]) and not near:
            chosen.append(int(i))
    shift = np.array([float(record.lacks), 0.0])
    for i in chosen:
        yield ends[i], np.asarray(record.starts) + shifts[i] * shift, misfits[i]
