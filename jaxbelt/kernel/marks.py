"""Marks: a state of each run that later ones are compared with, to find what repeats.

At the end of a stick phase the state is a function of the parameters alone. Where it repeats,
everything repeats, to the last bit; so a run need not follow the same loop again.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.modes import select
from .lanes import code_of, materialise

#: Least part of a loop that a run still follows behind the loops that it skips: so it ends within a
#: loop, and not at the end of one up to rounding.
LEAST_REST = 1e-6


class Mark(eqx.Module):
    """A state of a run that later ones are compared with, arrays [lanes].

    When it is 1, 2, 4, ... states old, the next one takes its place (Brent's method), so a cycle of
    any number of such states is found at their first repetition or soon after. count: a count along
    the run, of its events, say, at the mark; age: states since; limit: age at which it is replaced.
    """

    x1: Array
    x2: Array
    code: Array
    t: Array
    count: Array
    age: Array
    limit: Array

    @classmethod
    def none(cls, t: Array) -> "Mark":
        """Marks to which no run returns; t: times of the runs."""
        zero, count = jnp.zeros_like(t), jnp.zeros_like(t, jnp.int32)
        return cls(zero + jnp.nan, zero, zero, zero, count, count, count)

    def met_by(self, run: Any, close: Array | float) -> Array:
        """Whether the runs are in the marked state again: mode, x2, and x1 to `close`.

        run: has the state of the runs, x1, x2, and mode. x2 is the velocity of a belt, or 0, both
        times, and so it is the same to the last bit.
        """
        same = (run.x2 == self.x2) & (code_of(run.mode) == self.code)
        return same & (jnp.abs(run.x1 - self.x1) <= close)

    def loops_left(self, run: Any, released: Array, t1: Array) -> Array:
        """How many loops, as since its mark, a run can skip before t1 with a part of one left; 0
        where it is not `released` from a stick phase in the marked state."""
        period = run.t - self.t
        repeats = released & self.met_by(run, 0.0) & (period > 0)
        left = (t1 - run.t) / jnp.where(repeats, period, jnp.inf)
        loops = jnp.maximum(jnp.floor(left - LEAST_REST), 0.0)
        return lax.stop_gradient(jnp.where(repeats, loops, 0.0))

    def behind(self, run: Any, loops: Array) -> Array:
        """The times of the runs after `loops` more passes of the loop since their marks."""
        return jnp.where(loops > 0, run.t + loops * (run.t - self.t), run.t)

    def renewed(
        self, run: Any, at: Array, count: Array, ones: Array, met: Array | bool = False
    ) -> tuple["Mark", Array]:
        """The marks after the runs of the mask `at` came to a state to compare, and which are new.

        met: mask of the runs that have come back to their mark; of those in `at` it is set anew.
        """
        age = self.age + jnp.where(at, 1, 0)
        old = age >= self.limit
        new = materialise(at & (old | met), ones)
        here = Mark(
            run.x1,
            run.x2,
            code_of(run.mode),
            run.t,
            count,
            jnp.zeros_like(age),
            jnp.where(old, jnp.maximum(2 * self.limit, 1), self.limit),
        )
        return select(new, here, eqx.tree_at(lambda m: m.age, self, age)), new


class LoopSearch(eqx.Module):
    """A search for a loop that a run repeats, and what it has found, arrays [lanes].

    number: how many arcs, or rounds, of the run there were so far; first, last: `number` where the
    loop began and where it first ended; t: the time of that end; period: of the loop; loops: how
    many more times the run passes it from there on, 0 where no loop was found.
    """

    mark: Mark
    number: Array
    first: Array
    last: Array
    loops: Array
    t: Array
    period: Array

    @classmethod
    def none(cls, t: Array) -> "LoopSearch":
        """Searches that have found nothing yet; t: times of the runs."""
        zero, count = jnp.zeros_like(t), jnp.zeros_like(t, jnp.int32)
        return cls(Mark.none(t), count, count, count, count, zero, zero)

    def advanced(
        self, run: Any, released: Array, t1: Array, ones: Array, room: int | None = None
    ) -> tuple["LoopSearch", Array]:
        """The search after the runs' present states, and the times at which the runs go on: behind
        all loops that they would only repeat.

        room: the largest `number` at t1 of a run that skips loops; a run that would exceed it skips
        none.
        """
        mark = self.mark
        loops = mark.loops_left(run, released, t1)
        if room is not None:
            number, length = (n.astype(float) for n in (self.number, self.number - mark.count))
            loops = jnp.where(number + (loops + 1) * length <= room, loops, 0.0)
        found = loops > 0
        return LoopSearch(
            mark=mark.renewed(run, released, self.number, ones)[0],
            number=self.number,
            first=jnp.where(found, mark.count, self.first),
            last=jnp.where(found, self.number, self.last),
            loops=jnp.where(found, loops.astype(self.loops.dtype), self.loops),
            t=jnp.where(found, run.t, self.t),
            period=jnp.where(found, run.t - mark.t, self.period),
        ), mark.behind(run, loops)


def time_back(ts: Array, loops: Array, t: Array, period: Array) -> Array:
    """How long before each of the times ts a run was in the same state on the first pass of the
    loop that it repeats.

    loops, t, period: see `LoopSearch`. The answer is 0 before t and behind the last of these loops.
    """
    since, loops = ts - t, loops.astype(float)
    period = jnp.where(loops > 0, period, 1.0)
    again = jnp.clip(jnp.ceil(since / period), 0.0, loops)
    return lax.stop_gradient(jnp.where(since > loops * period, 0.0, again)) * period
