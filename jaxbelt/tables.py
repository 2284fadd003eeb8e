"""Results as tables: the one kind that the method `table` of every result gives.

A table is a `pandas.DataFrame`, always: pandas comes with xarray. It has a row for each thing of
one sort (samples, events, cycles, blocks), and columns of plain numbers and words: NaN where there
is no number, "" where there is no word, a column for each belt named with its number at the end.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .checks import require
from .numerics.compiling import is_concrete

if TYPE_CHECKING:
    import pandas


def table_of(rows: Mapping[str, Any] | Sequence[Mapping[str, Any]]) -> "pandas.DataFrame":
    """A table of columns by their names, or of rows that have the same names."""
    import pandas  # a quarter of a second that only tables need

    if isinstance(rows, Mapping):
        return pandas.DataFrame({name: np.asarray(column) for name, column in rows.items()})
    return pandas.DataFrame(list(rows))


def per_belt(name: str, values: Any) -> dict[str, Any]:
    """The columns of a quantity that each belt has its own of, [.., belts]."""
    columns = np.moveaxis(np.asarray(values), -1, 0)
    return {f"{name}_{i}": column for i, column in enumerate(columns)}


def require_single(result: Any, leaf: Any, *dimensions: int) -> None:
    """`ValueError` unless a result is a single known one, as tables and pictures show: one of its
    arrays, known, with so many dimensions."""
    name = type(result).__name__
    require(
        is_concrete(leaf) and np.ndim(leaf) in dimensions,
        name,
        "a single one, outside of transformations, for a table or a picture",
        "a batch; take one of its rows with jax.tree.map" if is_concrete(leaf) else "a traced one",
    )
