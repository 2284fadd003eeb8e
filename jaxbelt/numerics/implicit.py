"""Derivatives of solutions found by iteration, by the implicit function theorem.

An iteration gives a solution as a number. Its derivatives follow from the equations that it solves:
`solution` gives those of many unknowns, of every order; `step_to_root` and `delay_of_root` those of
the root of one equation, to first order, inside of kernels, where there is room for one step only.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .derivatives import moving_and_fixed


class Equations(eqx.Module):
    """As many equations as unknowns, for `newton.solve`; its own fields have no derivatives."""

    @abc.abstractmethod
    def residual(self, given: Any, z: Any) -> Array:
        """The equations at the unknowns z, [n]."""

    def linearized(self, given: Any, z: Any) -> tuple[Array, Array]:
        """The equations, and their derivatives with respect to the n unknowns, [n, n]."""
        flat, unravel = jax.flatten_util.ravel_pytree(z)

        def of_flat(flat):
            return self.residual(given, unravel(flat))

        return of_flat(flat), jax.jacfwd(of_flat)(flat)

    def moved(self, given: Any, z: Any, tangents: Any) -> tuple[Array, Array]:
        """The derivative of the equations along the tangents of `given`, None where it is fixed,
        [n]; and their derivatives with respect to the unknowns, [n, n]."""
        moving, fixed = moving_and_fixed(given, tangents)

        def of_moving(moving):
            return self.residual(eqx.combine(moving, fixed), z)

        _, change = jax.jvp(of_moving, (moving,), (tangents,))
        _, matrix = self.linearized(given, z)
        return change, matrix


@eqx.filter_custom_jvp
def solution(equations: Equations, given: Any, z: Any) -> Any:
    """z, which solves the equations; differentiable with respect to `given`, forwards and
    backwards."""
    return z


@solution.def_jvp
def _(primals, tangents):
    equations, given, z = primals
    z = solution(equations, given, z)  # for derivatives of derivatives
    shift, matrix = equations.moved(given, z, tangents[1])
    _, unravel = jax.flatten_util.ravel_pytree(z)
    return z, unravel(jnp.linalg.solve(matrix, -shift))


def step_to_root(value: Array, slope: Array, where: Any = True) -> Array:
    """The Newton step to the root of an equation; 0 where the slope is 0 or `where` is false.

    At a root that was found without derivatives the step is rounding, and has the derivatives of
    the root.
    """
    where = where & (slope != 0)
    return -jnp.where(where, value / jnp.where(where, slope, 1.0), 0.0)


def delay_of_root(function: Callable[..., Array], y: Any, rates: Any) -> Array:
    """The time from y, at a root of a function, to the root: 0, with the derivatives of that time.

    y: the arguments of the function, which change at the `rates`.
    """
    value, slope = jax.jvp(function, y, rates)
    return step_to_root(value - lax.stop_gradient(value), slope)
