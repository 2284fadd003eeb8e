"""What cycles and periodic motions of forced oscillators have in common: `ClosedMotion`."""

import abc
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks import as_whole, is_concrete, pick, require
from ..model.events import Signature
from ..model.modes import STUCK
from ..model.oscillator import Oscillator
from ..motion.simulate import Arcs
from ..numerics.compiling import jit
from ..results import Status
from .chains import Chain, loop_events
from .shooting import flow


class ClosedMotion(eqx.Module):
    """A chain of arcs that repeats.

    unknowns: entry state (d numbers) and duration of every arc, [arcs, d + 1].
    """

    oscillator: eqx.AbstractVar[Oscillator]
    chain: eqx.AbstractVar[Any]
    unknowns: eqx.AbstractVar[Array]
    status: eqx.AbstractVar[Array]

    @property
    def x1_min(self) -> Array:
        """Smallest displacement."""
        return self._extremum(0)

    @property
    def x1_max(self) -> Array:
        """Largest displacement."""
        return self._extremum(1)

    @property
    def x2_min(self) -> Array:
        """Smallest velocity."""
        return self._extremum(2)

    @property
    def x2_max(self) -> Array:
        """Largest velocity."""
        return self._extremum(3)

    @abc.abstractmethod
    def _extremum(self, number: int) -> Array:
        """By number: smallest x1 (0), largest x1 (1), smallest x2 (2), largest x2 (3)."""

    @property
    def stick_durations(self) -> Array:
        """Time for which the mass sticks to each belt until the motion repeats, [belts]."""
        # A product, so that NaN stays, also for a belt that the mass does not stick to.
        stuck = jnp.where(self.chain.codes == STUCK, 1.0, 0.0)
        return jnp.sum(self.unknowns[..., -1:] * stuck, axis=-2)

    @property
    def arcs(self) -> Arcs:
        """The arcs, smooth pieces in one mode each. Unused ones are NaN under a trace or in a
        batch, and cut off otherwise."""
        used, durations = self.chain.used, self.unknowns[..., -1]
        nan = functools.partial(jnp.where, used)
        arcs = Arcs(
            t=nan(jnp.cumsum(durations, axis=-1) - durations, jnp.nan),
            y=jnp.where(used[..., None], self.unknowns[..., :2], jnp.nan),
            mode=self.chain.codes,
            duration=nan(durations, jnp.nan),
        )
        if is_concrete(self.unknowns) and used.ndim == 1:
            arcs = pick(arcs, slice(int(np.sum(used))))
        return arcs

    @property
    def signature(self) -> Signature:
        """Its events, ((kind, belt), ...); outside of transformations only."""
        fits = is_concrete(self.chain) and self.chain.ends.ndim == 1
        expected = "asked of one motion outside of transformations"
        require(fits, "signature", expected, "a traced or batched motion")
        return loop_events(self.chain) if int(self.status) == Status.OK else ()

    def sample(self, n: int) -> Array:
        """States evenly spread in time until it repeats.

        Args:
            n: Number of states, ends included.

        Returns:
            The states (x1, x2), [n, 2].
        """
        given = self.oscillator, self.chain, self.unknowns
        return sampled_chain(*given, as_whole(n, "n"), self.since_beginning)

    @property
    def since_beginning(self) -> Array | None:
        """Time from the beginning of the chain to the beginning of the samples; None: 0."""
        return None


@jit
def sampled_chain(
    osc: Oscillator, chain: Chain, z: Array, n: int, since_beginning: Array | None = None
) -> Array:
    """States (x1, x2) at n times evenly spread over a closed chain with the unknowns z, [n, 2].

    since_beginning: see `ClosedMotion`.
    """
    durations = z[:, -1]
    ends = jnp.cumsum(durations)

    def at(t):
        i = jnp.minimum(jnp.searchsorted(ends, t).astype(int), jnp.sum(chain.used) - 1)
        since = t - ends[i] + durations[i]
        return flow(osc, chain.codes[i], chain.mesh[i], z[i, :-1], since)[:2]

    times = jnp.linspace(0.0, 1.0, n) * ends[-1]
    if since_beginning is not None:
        times = (times + since_beginning) % ends[-1]
    return jax.vmap(at)(times)
