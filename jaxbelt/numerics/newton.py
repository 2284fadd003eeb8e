"""Newton's method, as one loop; `implicit` has the derivatives of what it finds.

For shooting, for conditions on an oscillator, and for the points of a curve. Where there are a few
unknowns only, one step more costs nothing, and gives the last digit: see
`bifurcations.systems.small_newton`.

Optimistix's Newton, handed the same matrices through a derivative rule, takes a sixth longer, and
gives back neither the lengths of its steps nor its last matrix, by which points judge convergence
and bound their errors.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .implicit import Equations, solution

#: Most steps: five or six do from a guess good to LONGEST_NEWTON_STEP, from farther off none do.
NEWTON_STEPS = 12
#: Longer Newton steps are cut to this length: guesses are good to that.
LONGEST_NEWTON_STEP = 0.5
#: Equations with smaller residuals hold. For 337 cycles of oscillators at random Newton's method
#: left 3e-13 at most; from bad guesses it converged, too, or left 7e-4 and more.
HOLDS = 1e-9
#: Steps of this length are rounding: unknowns are of size one.
STEP_ROUNDING = 1e-13
#: Number of last steps by which `Newton.unsettled` measures how far the unknowns still move.
LAST = 4
#: Steps of larger unknowns, such as the time stuck to a belt that hardly moves, are measured
#: relative to them.
LARGE = 100.0


class Newton(eqx.Module):
    """What Newton's method ends with.

    z: the unknowns; residual: the largest one before the last step; iterations: steps made;
    lengths: of all steps, [steps], NaN where none was made, for unknowns beyond LARGE in units of
    |z| / LARGE; matrix: of the last step; rounding: how far errors of rounding in the equations
    move each unknown, [n].
    """

    z: Any
    residual: Array
    iterations: Array
    lengths: Array
    matrix: Array
    rounding: Array

    @property
    def last_two(self) -> tuple[Array, Array]:
        """The lengths of the last step and of the one before; after one step the same twice."""
        before = jnp.maximum(self.iterations - 2, 0)
        return self.lengths[self.iterations - 1], self.lengths[before]

    @property
    def unsettled(self) -> Array:
        """How far the unknowns still move: the longest of the LAST steps, or zero where the next
        one would be rounding."""
        steps = jnp.arange(len(self.lengths))
        last = (self.iterations - LAST <= steps) & (steps < self.iterations)
        longest = jnp.max(jnp.where(last, self.lengths, 0.0))
        return jnp.where(is_settled(*self.last_two), 0.0, longest)


def is_settled(last: Array, before: Array, bound: float = STEP_ROUNDING) -> Array:
    """Whether the next Newton step would be rounding, by the lengths of the last two.

    The next step is shorter by the same factor at least. bound: shorter steps are rounding.
    """
    return last * jnp.minimum(last / before, 1.0) < bound


def newton(
    linearized: Callable[[Any], tuple[Array, Array]],
    start: Any,
    *,
    steps: int = NEWTON_STEPS,
    longest: float = LONGEST_NEWTON_STEP,
    settled: Callable[[Array, Array], Array] = is_settled,
) -> Newton:
    """Newton's method from `start`, a tree of arrays with n numbers.

    linearized: n equations at given unknowns, and their matrix [n, n]. It ends where
    settled(last, before) says so of the lengths of the last two steps, after `steps`, or where a
    step is not finite.
    """
    flat, unravel = jax.flatten_util.ravel_pytree(start)

    def unfinished(n):
        last, before = n.last_two
        going = (n.iterations < steps) & ~settled(last, before) & jnp.isfinite(last)
        return going | (n.iterations == 0)

    def improve(n):
        value, matrix = linearized(unravel(n.z))
        changes = jnp.linalg.solve(matrix, jnp.stack([-value, errors], axis=1))
        change, rounding = changes[:, 0], jnp.abs(changes[:, 1])
        length = jnp.max(jnp.abs(change) / jnp.maximum(1.0, jnp.abs(n.z) / LARGE))
        z = n.z + jnp.minimum(1.0, longest / length) * change
        lengths = n.lengths.at[n.iterations].set(length)
        largest = jnp.max(jnp.abs(value))
        return Newton(z, largest, n.iterations + 1, lengths, matrix, rounding)

    # One error of rounding in each equation, of any size and sign.
    errors = jnp.asarray(np.finfo(float).eps * np.cos(np.arange(flat.size)))
    none, matrix = jnp.full(steps, jnp.nan), jnp.zeros((flat.size, flat.size))
    first = Newton(flat, jnp.zeros(()), jnp.asarray(0), none, matrix, jnp.zeros(flat.size))
    solved = lax.while_loop(unfinished, improve, first)
    return eqx.tree_at(lambda n: n.z, solved, unravel(solved.z))


def solve(
    equations: Equations, given: Any, start: Any, *, longest: float = LONGEST_NEWTON_STEP
) -> Newton:
    """The solution of the equations near `start`, differentiable with respect to `given`.

    By the implicit function theorem, in forward and reverse mode. `start` is a guess: nothing
    depends on it.
    """
    still, start = lax.stop_gradient((given, start))
    solved = lax.stop_gradient(
        newton(lambda z: equations.linearized(still, z), start, longest=longest)
    )
    return eqx.tree_at(lambda n: n.z, solved, solution(equations, given, solved.z))
