"""Marks: a state of each lane that later ones are compared with, to find what repeats."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..kernel.lanes import Lanes, code_of, materialise
from ..model.modes import select


class Mark(eqx.Module):
    """A state of a run that later ones are compared with, arrays [lanes].

    When it is 1, 2, 4, ... states old, the next one takes its place (Brent's method), so a cycle of
    any number of such states is found at their first repetition or soon after.
    """

    x1: Array
    x2: Array
    code: Array
    t: Array
    events: Array
    age: Array
    limit: Array

    @classmethod
    def none(cls, lanes: Lanes) -> "Mark":
        """Marks to which no lane returns."""
        zero, count = jnp.zeros_like(lanes.t), jnp.zeros_like(lanes.events)
        return cls(zero + jnp.nan, zero, zero, zero, count, count, count)

    def met_by(self, lanes: Lanes, close: Array | float) -> Array:
        """Whether the lanes are in the marked state again: mode, x2, and x1 to `close`.

        x2 is that of a belt, or 0, on both occasions, and so it is the same to the last bit.
        """
        same = (lanes.x2 == self.x2) & (code_of(lanes.mode) == self.code)
        return same & (jnp.abs(lanes.x1 - self.x1) <= close)

    def renewed(
        self, lanes: Lanes, at: Array, ones: Array, met: Array | bool = False
    ) -> tuple["Mark", Array]:
        """The marks when the lanes `at` are in a state to compare, and which of them are new.

        met: lanes that have come back to their mark, and are to go on from there.
        """
        age = self.age + jnp.where(at, 1, 0)
        old = age >= self.limit
        new = materialise(at & (old | met), ones)
        here = Mark(
            lanes.x1,
            lanes.x2,
            code_of(lanes.mode),
            lanes.t,
            lanes.events,
            jnp.zeros_like(age),
            jnp.where(old, jnp.maximum(2 * self.limit, 1), self.limit),
        )
        return select(new, here, eqx.tree_at(lambda m: m.age, self, age)), new
