"""Criteria by which an orbit has reached its attractor, shared by the search for cycles and by
runs.

An orbit has come to rest where it enters a disc that a fixed point attracts
(`rest.settling_margin`), where a pseudo-focus captures it (`is_captured`), or where its loops
shrink and are smaller than can be distinguished from rest. It is on a cycle where a loop repeats.
A loop that sticks repeats exactly, because slip onset is a function of the parameters alone; so it
is a cycle however small it is. An orbit that does not stick comes ever nearer to its cycle, and is
measured at its tops, the maxima of x1. It is on a cycle

- as a guess for Newton's method, where a top is within REPEATED times the amplitude of an earlier
  one in the same mode;
- as a run that is reported as it is, where the rest of the way to the limit, estimated from the
  ratio of the last two changes, see `way_left`, is within the tolerance.
"""

import jax.numpy as jnp
from jaxtyping import Array

#: A loop that repeats to this fraction of its amplitude has repeated.
REPEATED = 1e-7
#: Tops with a smaller relative difference may be equal up to rounding.
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
    """Remaining way of the tops to their limit, as a multiple of their last change.

    It is the sum of a geometric series with the ratio of `change` to `before`, the change before
    that; inf where it does not converge.
    """
    ratio = jnp.abs(change / jnp.where(before == 0, 1.0, before))
    return jnp.where(ratio < 1, ratio / jnp.where(ratio < 1, 1 - ratio, 1.0), jnp.inf)
