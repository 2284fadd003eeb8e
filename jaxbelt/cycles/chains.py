"""Closed chains of arcs, and loops of orbits as guesses of chains.

The number of arcs is padded to a few fixed sizes, and their modes and ends are data, so that one
compiled program serves all signatures.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..model.events import Signature, events_of
from ..model.own_units import quantity
from ..motion.arcs import Ends
from ..numerics.compiling import power_of_two
from ..results import Status

#: Sizes of chains: the number of arcs is rounded up to one of these; under a trace the first one.
SIZES = (16, 32, 64)


def first_failure(status: Array, fine: Any, code: Status) -> Array:
    """The status, in which OK is replaced by `code` where `fine` is false."""
    return jnp.where((status == Status.OK) & ~fine, code.value, status)


def after_each(chain: "Chain | Loop", rows: Array) -> Array:
    """For each arc the row of the next arc; after the last used arc comes the first."""
    last = jnp.arange(chain.ends.size) == jnp.sum(chain.used) - 1
    last = last.reshape(-1, *[1] * (rows.ndim - 1))
    return jnp.where(last, rows[0], jnp.roll(rows, -1, axis=0))


class Chain(eqx.Module):
    """A closed sequence of arcs: contact codes [arcs, belts], ends [arcs], mesh [arcs, steps].

    ends: numbers of `arcs.Ends`; mesh: integration steps as fractions of the arc's duration. An
    unused arc has a duration of zero."""

    codes: Array
    ends: Array
    mesh: Array

    @property
    def used(self) -> Array:
        return self.ends != Ends(self.codes.shape[-1]).unused

    @property
    def sticks(self) -> Array:
        """Whether there is a stick phase."""
        return jnp.any(self.used[:, None] & (self.codes == 0))

    @property
    def halved(self) -> "Chain":
        """The same chain with every integration step halved."""
        return replace(self, mesh=jnp.repeat(self.mesh / 2, 2, axis=-1))

    def loop(self, z: Array) -> "Loop":
        """The loop with the unknowns z: entry state and duration of each arc, [arcs, d + 1]."""
        return Loop(self.codes, self.ends, z[:, :-1], z[:, -1])

    def on_both_meshes(self, value: Callable[[Any], Any]) -> Any:
        """value(chain) for the mesh as it is, and with all steps halved, stacked: [2, ..]."""
        # The first mesh is padded by steps of length zero to the shape of the second.
        as_it_is = jnp.concatenate([self.mesh, jnp.zeros_like(self.mesh)], axis=1)
        meshes = jnp.stack([as_it_is, self.halved.mesh])
        return lax.map(lambda mesh: value(replace(self, mesh=mesh)), meshes)


class Loop(eqx.Module):
    """One loop of an orbit, arc by arc, padded.

    Codes and ends as in a `Chain`, and a guess of its unknowns: entry states and durations.
    """

    codes: Array
    ends: Array
    entries: Array = eqx.field(metadata=quantity("length", "velocity"))
    durations: Array

    @property
    def used(self) -> Array:
        return self.ends != Ends(self.codes.shape[-1]).unused

    @property
    def exits(self) -> Array:
        """States at the ends of the arcs; after the last used arc comes the first."""
        return after_each(self, self.entries)


def blank_loop(size: int, belts: int) -> Loop:
    """A loop of unused arcs, for code that needs its shapes."""
    unused = np.full(size, Ends(belts).unused)
    arrays = np.ones((size, belts)), unused, np.zeros((size, 2)), np.zeros(size)
    return Loop(*map(jnp.asarray, arrays))


def padded_loop(
    codes: np.ndarray, ends: np.ndarray, entries: np.ndarray, durations: np.ndarray
) -> Loop:
    """NumPy arcs as a loop, padded to one of `SIZES`, or to a power of two above these."""
    count = len(ends)
    size = next((one for one in SIZES if one >= count), power_of_two(count, SIZES[-1]))
    more = size - count
    return Loop(
        codes=jnp.asarray(np.pad(codes, [(0, more), (0, 0)], constant_values=1.0)),
        ends=jnp.asarray(np.pad(ends, (0, more), constant_values=Ends(codes.shape[-1]).unused)),
        # After the last used arc comes the first one.
        entries=jnp.asarray(np.concatenate([entries, entries[[0] * more]])),
        durations=jnp.asarray(np.pad(durations, (0, more))),
    )


def modes_of(loop: Chain | Loop) -> np.ndarray:
    """Contact codes of the used arcs of one loop, [arcs, belts]."""
    codes, ends = np.asarray(loop.codes), np.asarray(loop.ends)
    return codes[ends != Ends(codes.shape[-1]).unused].astype(int)


def loop_events(loop: Chain | Loop) -> Signature:
    """The events of one loop, (kind, belt) each; for EDGE the lowest belt that comes or goes."""
    return events_of(modes_of(loop))


def following_codes(chain: Chain | Loop) -> Array:
    """Contact codes of the arc after each; after the last used arc comes the first."""
    return after_each(chain, chain.codes)


def room_of(arcs: int) -> int:
    """The smallest size of a chain that holds this number of arcs, which is at most SIZES[-1]."""
    return next(size for size in SIZES if size >= arcs)


def cut(loops: Sequence[Loop], *, more: int = 0) -> list[Loop]:
    """Concrete loops cut to the size that the longest of them needs with `more` spare rows."""
    unused = Ends(loops[0].codes.shape[-1]).unused
    longest = max(int(np.sum(np.asarray(loop.ends) != unused)) for loop in loops)
    room = slice(room_of(min(longest + more, SIZES[-1])))
    return [jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[room]), loop) for loop in loops]
