"""`jaxbelt map`: the regions of a plane of two parameters."""

from pathlib import Path
from typing import Annotated, Any

import typer

import jaxbelt as jb

from .description import Description, describes
from .options import (
    BYTES_OF_CELL,
    Interval,
    Json,
    Out,
    check_count,
    check_range,
    from_to,
    outputs,
    picture,
    plain_errors,
    say,
    turn_on_float64,
)
from .tables import write_columns, write_table


@describes()
def region_map(
    described: Description,
    axes: Annotated[
        tuple[str, str],
        typer.Option(
            metavar="P Q",
            help="The two parameters: arguments of the class, nu0, nu1, ..., zeta, or paths, such "
            "as belts[1].friction.steepness.",
        ),
    ] = ("nu0", "nu1"),
    p: Annotated[Interval, from_to("Values of the first one.")] = (-0.7, 0.7),
    q: Annotated[Interval, from_to("Values of the second one.")] = (-0.7, 0.7),
    cells: Annotated[
        int,
        typer.Option(help="Cells along each side, about; at most as many as there is memory for."),
    ] = 200,
    out: Out = Path("map"),
    as_json: Json = False,
) -> None:
    """The regions of a plane of two parameters, and the curves that bound them: Fig. 6.

    - **OUT.png**: the map, and a sketch of the phase portrait of each region.

    - **OUT.csv**: a row for each cell: both parameters, the name of the region, its meaning in the
      words of the picture's key, and on_line: 1 where a belt is at rest or without load, or two
      belts have one velocity, unless this is so in all cells; the picture leaves such cells out.

    - **OUT_curves.csv**: a row for each point of a curve: curve, condition, belts, both parameters,
      multiplier of the cycle without the stick phase that vanishes, residual, special. Points of
      codimension two stand at their places, named in the last column.

    An oscillator is described as for **simulate**; parameters that vary need no value. Takes a
    minute or more, mostly to compile and for the curves: the cells cost little.

    Examples:

    - jaxbelt map --class b --cells 400

    - jaxbelt map --axes nu0 zeta --p 0 0.6 --q 0.1 1 --nu1 0.35
    """
    with plain_errors():
        described.refuse_machine("map")
        described.check_axes(axes)
        check_count("cells", cells, 2, each=BYTES_OF_CELL, sides=2)
        check_range("p", p)
        check_range("q", q)
        written = outputs(out, ".png", ".csv", "_curves.csv")
        turn_on_float64()
        from ..numerics.spacing import evenly_spaced

        make = described.along(axes)
        pairs = zip(axes, (p, q), cells_along(cells), strict=True)
        values = {name: evenly_spaced(*span, n) for name, span, n in pairs}
        found = jb.region_map(make, values)
        from ..plotting.regions import draw_region_map

        with picture(written[0], 7.2, 9.0) as figure:
            draw_region_map(found, figure)
        write_cells(found, written[1])
        write_table(found.table(), written[2])
    cells_of = {name: int((found.label == name).sum()) for name in found.regions}
    words = {name: found.words[name] for name in cells_of}
    data = {"axes": list(found.names), "cells": cells_of, "words": words}
    data["curves"] = len(found.curves)
    say([repr(found)], written, as_json=as_json, data=data)


def cells_along(cells: int) -> tuple[int, int]:
    """Number of cells along each axis.

    Even numbers, so that no cells of a symmetric range lie on 0, where a belt is at rest; and
    different ones, so that none lie where both parameters are equal.
    """
    even = cells + cells % 2
    return even, even + 2


def write_cells(found: "jb.RegionMap", path: Path) -> None:
    """Writes both parameters, name and meaning of the region, and `on_line`, a row for each
    cell."""
    import numpy as np

    places = [one.ravel() for one in np.meshgrid(*found.values, indexing="ij")]
    columns: dict[str, Any] = dict(zip(found.names, places, strict=True))
    columns["region"] = found.label.ravel()
    words = {"": "undecided", **found.words}
    columns["words"] = [words[name] for name in columns["region"]]
    columns["on_line"] = found.on_line.ravel().astype(int)
    write_columns(columns, path)
