"""Newton's method, as one loop for all systems of the package."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

NEWTON_STEPS = 12
#: Longer Newton steps are cut to this length: guesses are good to that.
LONGEST = 0.5


class Newton(eqx.Module):
    """State of a Newton iteration: unknowns, largest residual, steps made, how long each was,
    [NEWTON_STEPS], NaN where there was none, and the matrix of the last one."""

    z: Any
    residual: Array
    iterations: Array
    lengths: Array
    matrix: Array


def newton(step: Callable[[Any], tuple[Any, Array, Array]], start: Any) -> Newton:
    """Newton's method: step(z) gives the correction, the residual at z and the matrix.

    Steps longer than LONGEST are cut. Ends where steps are as small as rounding lets them be, and
    where they are not finite.
    """

    def unfinished(n):
        last = n.lengths[n.iterations - 1]
        before = n.lengths[jnp.maximum(n.iterations - 2, 0)]
        # The next step is shorter by the same factor at least: not worth making below rounding.
        settled = last * jnp.minimum(last / before, 1.0) < 1e-13
        going = (n.iterations < NEWTON_STEPS) & ~settled & jnp.isfinite(last)
        return going | (n.iterations == 0)

    def improve(n):
        change, size, matrix = step(n.z)
        length = jnp.max(jnp.stack([jnp.max(jnp.abs(c)) for c in jax.tree.leaves(change)]))
        shorter = jnp.minimum(1.0, LONGEST / length)
        z = jax.tree.map(lambda a, b: a + shorter * b, n.z, change)
        lengths = n.lengths.at[n.iterations].set(length)
        return Newton(z, size, n.iterations + 1, lengths, matrix)

    none = jnp.full(NEWTON_STEPS, jnp.nan)
    size = sum(leaf.size for leaf in jax.tree.leaves(start))
    matrix = jnp.zeros((size, size))
    first = Newton(start, jnp.zeros(()), jnp.asarray(0), none, matrix)
    return lax.while_loop(unfinished, improve, first)
