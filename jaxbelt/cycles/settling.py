"""Criteria for an orbit that has reached its attractor: one rule for orbits behind cycles and for
runs.

It has come to rest where it enters a disc that a fixed point attracts (`rest.settling_margin`),
where a pseudo-focus captures it (`is_captured`), or where its loops shrink and are smaller than can
be distinguished from rest. It is on a cycle where a loop repeats. One that sticks repeats exactly,
because slip onset is a function of the parameters alone; so it is on a cycle however small it is.
One that does not stick comes ever nearer to its cycle, and is measured at its tops, the maxima of
x1:

- an orbit that is to be a guess for Newton's method, where a top is within REPEATED times the
  amplitude of an earlier one in the same mode;
- a run that is reported as it is, where the rest of the way to the limit, by the ratio of its last
  two changes, see `way_left`, is within the tolerance.
"""

import jax.numpy as jnp
from jaxtyping import Array

#: A loop that repeats to this fraction of its amplitude has repeated.
REPEATED = 1e-7
#: Tops that differ by this part of themselves may be equal.
TOP_ROUNDING = 1e-15
#: Loops of this amplitude that shrink come to rest: Newton's method does not distinguish a smaller
#: cycle from an equilibrium, as its equations hold to 1e-9 and the multiplier of both is near 1.
AT_REST = 1e-5


def has_repeated(change: Array, amplitude: Array, top: Array) -> Array:
    """Whether a top that differs from an earlier one by `change` repeats it.

    Tops that differ by their rounding are equal.
    """
    return jnp.abs(change) < jnp.maximum(REPEATED * amplitude, TOP_ROUNDING * jnp.abs(top))


def way_left(change: Array, before: Array) -> Array:
    """Way of the tops to their limit, as a multiple of their last change.

    The sum of a geometric series, from the last change and the one before; inf where it does not
    converge.
    """
    ratio = jnp.abs(change / jnp.where(before == 0, 1.0, before))
    return jnp.where(ratio < 1, ratio / jnp.where(ratio < 1, 1 - ratio, 1.0), jnp.inf)
