"""Dimensions of the numbers in results: `quantity`.

A field of a module states its dimension in its metadata, by `quantity`; a column of a table does in
`tables.table_of`, and a variable of a dataset in its attribute `quantity`.
"""

#: Dimensions, as powers of the unit of length; time has none.
POWERS = {
    **{"time": 0, "length": 1, "velocity": 1, "force": 1, "energy": 2, "coefficient": -2},
    **{"rate": 0, "frequency": 0, "angle": 0, "damping": 0},
}
#: Dimensions of the columns with the smallest and largest x1 and x2 of a motion.
EXTENT = {"x1_min": "length", "x1_max": "length", "x2_min": "velocity", "x2_max": "velocity"}


def quantity(*dimensions: str) -> dict[str, tuple[str, ...]]:
    """The metadata of a field that has a dimension, for `eqx.field`.

    One of `POWERS`; several stand for the columns of an array's last axis.
    """
    return {"dimensions": dimensions}
