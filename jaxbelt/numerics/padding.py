"""Rows of trees of arrays: taken apart, and padded, so that few shapes are compiled or groups have
one size."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks import pick


def filled_up(tree: Any, rows: Any, size: int) -> Any:
    """The given rows of a tree of concrete arrays, filled up to `size` with the last of them."""
    return pick(tree, np.asarray(rows)[np.minimum(np.arange(size), len(rows) - 1)])


def in_batches(tree: Any, rows: np.ndarray, size: int) -> Iterator[tuple[np.ndarray, Any]]:
    """Batches of the given rows of a tree of concrete arrays: (row numbers, `filled_up` tree)."""
    for first in range(0, len(rows), size):
        batch = rows[first : first + size]
        yield batch, filled_up(tree, batch, size)


def each_row(tree: Any) -> Iterator[Any]:
    """The rows of a tree of NumPy arrays, one after another."""
    leaves, structure = jax.tree.flatten(tree)
    return (structure.unflatten(row) for row in zip(*leaves, strict=True))


def longer(tree: Any, size: int, *, axis: int = 0, fill: int | float | None = None) -> Any:
    """The arrays of a tree padded along an axis, up to `size`.

    fill: the number to pad with; None: the last row of each array.
    """

    def one(leaf: Array) -> Array:
        widths = [(0, 0)] * leaf.ndim
        widths[axis] = (0, size - leaf.shape[axis])
        if fill is None:
            return jnp.pad(leaf, widths, "edge")
        return jnp.pad(leaf, widths, constant_values=fill)

    return jax.tree.map(one, tree)


def in_groups_of(size: int, tree: Any, *, fill: int | float | None = None) -> Any:
    """The rows of a tree of arrays in groups, [groups, size, ..], the last one made `longer`."""

    def one(leaf: Array) -> Array:
        groups = -(-len(leaf) // size)
        return longer(leaf, groups * size, fill=fill).reshape(groups, size, *leaf.shape[1:])

    return jax.tree.map(one, tree)
