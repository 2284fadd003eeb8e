"""Derivatives of integrations: forward Jacobians that reverse mode can use too, and derivatives in
several directions beside a value."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Array


def moving_and_fixed(tree: Any, tangents: Any) -> tuple[Any, Any]:
    """The leaves that have a tangent, and those that have none, two trees with None elsewhere."""
    has_one = jax.tree.map(lambda t: t is not None, tangents, is_leaf=lambda t: t is None)
    return eqx.partition(tree, has_one)


def forward_jacobian(fn: Callable[..., Any]) -> Callable[..., Any]:
    """`fn` with derivatives that come from its forward-mode Jacobian, in both modes.

    An integration with an unknown number of steps has forward derivatives only. A segment has few
    inputs, so its Jacobian with respect to those that are perturbed is formed in forward mode;
    the tangent is then a matrix product, which reverse mode can transpose.
    """
    wrapped = eqx.filter_custom_jvp(fn)

    @wrapped.def_jvp
    def _(primals, tangents):
        perturbed, rest = moving_and_fixed(primals, tangents)
        flat, unravel = jax.flatten_util.ravel_pytree(perturbed)
        flat_tangent, _ = jax.flatten_util.ravel_pytree(tangents)

        def of_flat(flat):
            out = fn(*eqx.combine(unravel(flat), rest))
            inexact, other = eqx.partition(out, eqx.is_inexact_array)
            return inexact, other

        def column(direction):
            out, tangent, other = jax.jvp(of_flat, (flat,), (direction,), has_aux=True)
            return out, tangent, other

        basis = jnp.eye(flat.size, dtype=flat.dtype)
        inexact, columns, other = jax.vmap(column, out_axes=(None, -1, None))(basis)
        tangent_out = jax.tree.map(lambda jacobian: jacobian @ flat_tangent, columns)
        out = eqx.combine(inexact, other)
        nothing = jax.tree.map(lambda _: None, other)
        return out, eqx.combine(tangent_out, nothing)

    return wrapped


def in_directions(
    function: Callable[..., Any],
    args: tuple[Any, ...],
    slopes: Sequence[tuple[Any, ...]],
    differentiable: Callable[[Any], Any],
) -> tuple[Any, list[Any]]:
    """The value of a function, and its derivative in each of some directions.

    args: its arguments, trees; slopes: for each direction the change of each, with None in place of
    what does not change. differentiable(value): the value with None in place of what does not
    change, as in the derivatives. The value is computed once for all directions. By `jax.jvp`, in a
    batch or one after another, XLA would compute it again for each: it moves the constants of each
    copy out of the loop, and no longer sees that two copies are the same.
    """
    if not slopes:
        return function(*args), []
    moving, fixed = moving_and_fixed(args, slopes[0])

    def of_moving(moving):
        value = function(*eqx.combine(moving, fixed))
        return moving_and_fixed(value, differentiable(value))

    changing, linear, others = jax.linearize(of_moving, moving, has_aux=True)
    return eqx.combine(changing, others), [linear(slope) for slope in slopes]


def nan_unless(known: Array, of: Any) -> Array:
    """0 where `known`, else NaN, also in its derivatives by the numbers of the tree `of`.

    To be added to results: a NaN that `jnp.where` selects has the derivative 0, which looks like an
    extremum; and what multiplies a NaN, as in padding, has the derivative NaN in reverse mode.
    known: one truth value.
    """
    numbers = [jnp.asarray(leaf) for leaf in jax.tree.leaves(of) if eqx.is_inexact_array(leaf)]
    # Some numbers are infinite though the result is known: those of missing edges.
    usable = [jnp.where(known & ~jnp.isfinite(leaf), 0.0, leaf) for leaf in numbers]
    return sum(map(jnp.sum, usable), jnp.zeros(())) * jnp.where(known, 0.0, jnp.nan)
