"""Derivatives of integrations: forward Jacobians that reverse mode can use too."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp


def forward_jacobian(fn: Callable[..., Any]) -> Callable[..., Any]:
    """`fn` with derivatives that come from its forward-mode Jacobian, in both modes.

    An integration with an unknown number of steps has forward derivatives only. A segment has few
    inputs, so its Jacobian with respect to those that are perturbed is formed in forward mode;
    the tangent is then a matrix product, which reverse mode can transpose.
    """
    wrapped = eqx.filter_custom_jvp(fn)

    @wrapped.def_jvp
    def _(primals, tangents):
        perturbed, rest = eqx.partition(
            primals, jax.tree.map(lambda t: t is not None, tangents, is_leaf=lambda t: t is None)
        )
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
