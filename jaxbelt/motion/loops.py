"""The loop that a run repeats: which of its arcs were followed once and are passed again."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..kernel.marks import time_back


class RepeatedLoop(eqx.Module):
    """The loop that a run repeats: its arcs, by their numbers among those that were followed.

    The loop's arcs are `first` to `last` - 1. After them the run passes the loop `loops` more
    times, which are not followed; then the arc `last` begins. loops = 0: there is no such loop.
    """

    first: Array
    last: Array
    loops: Array

    def end(self, event_t: Array) -> tuple[Array, Array]:
        """When the loop first ended, and its period; event_t: the ends of the followed arcs."""
        repeats = self.loops > 0
        first, last = (event_t[jnp.maximum(number - 1, 0)] for number in (self.first, self.last))
        return jnp.where(repeats, last, 0.0), jnp.where(repeats, last - first, 0.0)

    def total(self, counts: Array) -> Array:
        """Number of things, arcs or events, in the whole run; counts: their number up to the end of
        each followed arc."""
        return counts[-1] + self.loops * self._in_loop(counts)

    def _in_loop(self, counts: Array) -> Array:
        first, last = (counts[jnp.maximum(number - 1, 0)] for number in (self.first, self.last))
        return jnp.where(self.loops > 0, last - first, 0)

    def place(self, wanted: Array, counts: Array) -> tuple[Array, Array]:
        """For things with these numbers, from 1 on: indices of the followed arcs in which they lie,
        and how many periods later than there they happen; counts: see `total`."""
        each = self._in_loop(counts)
        beyond = wanted - counts[jnp.maximum(self.last - 1, 0)]
        again = jnp.clip((beyond - 1) // jnp.maximum(each, 1) + 1, 0, self.loops)
        again = jnp.where(each > 0, again, 0)
        rows = jnp.searchsorted(counts, wanted - again * each)
        later = jnp.where(beyond > self.loops * each, 0, again).astype(float)
        return jnp.minimum(rows, counts.size - 1), later

    def followed(self, ts: Array, event_t: Array) -> Array:
        """The times ts, but times in loops that were not followed replaced by those at which the
        followed loop is in the same state."""
        return ts - time_back(ts, self.loops, *self.end(event_t))
