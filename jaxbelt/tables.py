"""Results as tables: the form that the method `table` of every result returns.

A table is always a `pandas.DataFrame` (pandas comes with xarray). It has a row for each thing of
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


def table_of(
    rows: Mapping[str, Any] | Sequence[Mapping[str, Any]],
    quantities: Mapping[str, str] | None = None,
) -> "pandas.DataFrame":
    """A table from columns by name, or from rows that have the same names.

    quantities: dimensions of columns, for `in_si`; they stand in the attributes of the table.
    """
    import pandas  # import takes a quarter of a second, which only tables need

    if isinstance(rows, Mapping):
        table = pandas.DataFrame({name: np.asarray(column) for name, column in rows.items()})
    else:
        table = pandas.DataFrame(list(rows))
    table.attrs["quantities"] = dict(quantities or {})
    return table


def per_belt(name: str, values: Any) -> dict[str, Any]:
    """Columns of a quantity that each belt has, [.., belts]."""
    columns = np.moveaxis(np.asarray(values), -1, 0)
    return {f"{name}_{i}": column for i, column in enumerate(columns)}


def require_single(result: Any, leaf: Any, *dimensions: int) -> None:
    """Raises a `ValueError` unless a result is a single one and not traced, as tables and pictures
    need it.

    leaf: one of its arrays, which has to be concrete and to have one of the given `dimensions`.
    """
    name = type(result).__name__
    require(
        is_concrete(leaf) and np.ndim(leaf) in dimensions,
        name,
        "a single one, outside of transformations, for a table or a picture",
        "a batch; take one of its rows with jax.tree.map" if is_concrete(leaf) else "a traced one",
    )
