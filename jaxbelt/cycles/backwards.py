"""Motion backwards in time, and unstable cycles that are solved for in reversed time.

In reversed time, t -> -t and x2 -> -x2, an oscillator is one with the signs of its damping, loads
and velocities changed. It never sticks: orbits that do not stick continue backwards uniquely.

Slow belts with steep friction laws make cycles whose multiplier is 1e20. They pass along a
boundary, just off it, for a long time; forwards no floating-point start leads to such a cycle,
backwards all of them do.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks import as_whole
from ..model.oscillator import Oscillator
from ..model.own_units import quantity
from ..results import Status
from .chains import Chain, Loop, cut
from .cycle import Cycle, exactly
from .motions import sampled_chain


class BackwardCycle(Cycle):
    """An unstable cycle that was solved for in reversed time, without derivatives.

    backwards_chain, backwards_unknowns: the attracting cycle of the oscillator reversed in time.
    """

    backwards_chain: Chain
    backwards_unknowns: Array = eqx.field(metadata=quantity("length", "velocity", "time"))

    def sample(self, n: int) -> Array:
        """States (x1, x2) at n times evenly spread over one period, ends included, [n, 2]."""
        behind = reversed_in_time(self.oscillator)
        given = self.backwards_chain, self.backwards_unknowns, as_whole(n, "n")
        states = sampled_chain(behind, *given)
        return jnp.flip(states, axis=0) * jnp.array([[1.0, -1.0]])


def moved_in_time(osc: Oscillator, way: Array | float) -> Oscillator:
    """The oscillator itself for way = 1, or reversed in time for way = -1."""
    return eqx.tree_at(
        lambda o: [o.damping, *(b.velocity for b in o.belts), *(b.load for b in o.belts)],
        osc,
        replace_fn=lambda leaf: leaf * way,
    )


def reversed_in_time(osc: Oscillator) -> Oscillator:
    """The oscillator whose motion (x1, -x2) is the motion of `osc` backwards."""
    return moved_in_time(osc, -1.0)


def solved(osc: Oscillator, loop: Loop) -> Cycle:
    """The cycle near a loop of concrete arrays."""
    return exactly(osc, cut([loop])[0], jnp.asarray(np.array(Status.OK.value)))


def forwards(osc: Oscillator, cycle: Cycle) -> BackwardCycle:
    """The unstable cycle of an oscillator, from the attracting cycle of the reversed oscillator.

    Each arc begins at its former end, and takes the kind of end of the arc that preceded it.
    """
    chain, z = cycle.chain, np.asarray(cycle.unknowns)
    n = int(np.sum(np.asarray(chain.used)))
    rows = np.arange(len(z))
    own = rows < n
    arc = np.where(own, n - 1 - rows, rows)
    codes = np.asarray(chain.codes)[arc]
    ends = np.asarray(chain.ends)[np.where(own, (arc - 1) % n, rows)]
    entries = z[np.where(own, (arc + 1) % n, 0), :2] * [1.0, -1.0]
    return BackwardCycle(
        oscillator=osc,
        chain=Chain(
            jnp.asarray(np.where(np.abs(codes) == 1, -codes, codes)),
            jnp.asarray(ends),
            jnp.asarray(np.asarray(chain.mesh)[arc, ::-1]),
        ),
        unknowns=jnp.asarray(np.column_stack([entries, z[arc, 2]])),
        multiplier=1 / cycle.multiplier,
        residual=cycle.residual,
        iterations=cycle.iterations,
        status=cycle.status,
        backwards_chain=chain,
        backwards_unknowns=cycle.unknowns,
    )
