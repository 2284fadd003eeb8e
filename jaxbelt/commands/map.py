"""`jaxbelt map`: the regions of a plane of two parameters."""

import csv
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import jaxbelt as jb

from .options import Class, class_along, make_console, plain_errors, say


def region_map(
    system: Class = "b",
    axes: Annotated[
        tuple[str, str], typer.Option(metavar="P Q", help="The two arguments of the class.")
    ] = ("nu0", "nu1"),
    p: Annotated[
        tuple[float, float], typer.Option(metavar="FROM TO", help="Values of the first one.")
    ] = (-0.7, 0.7),
    q: Annotated[
        tuple[float, float], typer.Option(metavar="FROM TO", help="Values of the second one.")
    ] = (-0.7, 0.7),
    cells: Annotated[int, typer.Option(help="Cells along each side.")] = 200,
    out: Annotated[
        Path, typer.Option(help="Where to write, without an ending: OUT.png, OUT.csv, ...")
    ] = Path("map"),
) -> None:
    """The regions of a plane of two parameters, and the curves that bound them: Fig. 6.

    - **OUT.png**: the map, and a sketch of the phase portrait of each region.

    - **OUT.csv**: both parameters and the region's name, a row a cell.

    - **OUT_curves.csv**: curve, condition, belts, both parameters, multiplier of the cycle without
      the stick phase that vanishes, residual, special, a row a point of a curve. Points of
      codimension two stand at their places, named in the last column.

    The other arguments of the class have the values that **simulate** takes for them.

    Example: jaxbelt map --class b --cells 400
    """
    from ..plotting.regions import draw_region_map
    from ..plotting.style import journal_figure, journal_style, save

    console = make_console()
    with plain_errors():
        make = class_along(system, axes)
        if cells < 2:
            raise ValueError(f"cells must be at least 2, got {cells}")
        # Other numbers of cells, lest cells lie on the line where both are the same.
        values = {axes[0]: np.linspace(*p, cells), axes[1]: np.linspace(*q, cells + 1)}
        with console.status("sweeping, then following curves (the first minutes are compilation)"):
            found = jb.region_map(make, values)
        with journal_style():
            figure = journal_figure(7.2, 9.0)
            draw_region_map(found, figure)
            out.parent.mkdir(parents=True, exist_ok=True)
            ends = (".png", ".csv", "_curves.csv")
            written = [out.with_name(out.name + end) for end in ends]
            save(figure, written[0])
        write_cells(found, written[1])
        write_table(found.table(), written[2])
    say(console, [repr(found)], written)


def write_cells(found: jb.RegionMap, path: Path) -> None:
    """Both parameters and the name of the region, a row a cell."""
    first, second = (np.asarray(values).tolist() for values in found.values)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*found.names, "region"])
        for (i, j), name in np.ndenumerate(found.label):
            writer.writerow([first[i], second[j], name])


def write_table(table: Any, path: Path) -> None:
    """A table of a result, every number to the last digit."""
    table.to_csv(path, index=False, na_rep="nan")
