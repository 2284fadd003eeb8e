"""`jaxbelt basins`: which start leads where."""

from pathlib import Path
from typing import Annotated, Any

import typer

import jaxbelt as jb

from .description import Description, describes
from .options import (
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
from .tables import write_columns


@describes()
def basins(
    described: Description,
    x1: Annotated[Interval, from_to("Displacements of the starts.")] = (0.0, 3.0),
    x2: Annotated[Interval, from_to("Velocities of the starts.")] = (-1.0, 1.0),
    points: Annotated[
        int,
        typer.Option(
            help="Starts along each side of the grid; their square is run, at most as many as "
            "there is memory for."
        ),
    ] = 201,
    starts: Annotated[
        int, typer.Option(help="Random starts for the basin stability of the window; 0: none.")
    ] = 10_000,
    seed: Annotated[int, typer.Option(help="Of the random starts.")] = 0,
    out: Out = Path("basins"),
    as_json: Json = False,
) -> None:
    """Where each start leads: basins of attraction, and the unstable cycle between them.

    - **OUT.png**: a window of the phase plane, coloured by the attractor that a start leads to,
      with the stable cycles, and the unstable one dashed.

    - **OUT.csv**: x1, x2 and label of every start of the grid.

    - **OUT.nc**: the same and all that is known of each run, as **sweep** writes it.

    Prints the fraction of the window that leads to each kind of attractor, with its standard error
    (basin stability), from random starts. An oscillator is described as for **simulate**. Takes
    some ten seconds, mostly to compile.

    Examples:

    - jaxbelt basins --nu0 0.45 --nu1 0.35 --x1 0.5 2.5 --x2 -0.8 0.8

    - jaxbelt basins --belt 1.4,law=stribeck,static=1,kinetic=0.5,stribeck_velocity=0.5
      --damping 0.1 --x1 -2 2 --x2 0 2
    """
    with plain_errors():
        check_count("points", points, 2, sides=2)
        check_count("starts", starts, 0)
        check_range("x1", x1)
        check_range("x2", x2)
        written = outputs(out, ".png", ".csv", ".nc")
        described.check()
        described.refuse_machine("basins")
        turn_on_float64()
        osc = described.oscillator()
        import jax
        import numpy as np

        from ..numerics.spacing import evenly_spaced

        grid = [evenly_spaced(*span, points) for span in (x1, x2)]
        found = jb.basins(osc, x1=grid[0], x2=grid[1])
        lines, data = [repr(found)], _shares_as_data(found)
        if starts:
            key = jax.random.key(seed)
            stability = jb.basin_stability(osc, box=(x1, x2), n=starts, key=key)
            lines.append(repr(stability))
            data["stability"] = {
                "starts": starts,
                "fractions": stability.fractions,
                "standard_errors": stability.standard_errors,
            }
        with picture(written[0], 4.6, 4.4) as figure:
            jb.plot_basins(found, figure.subplots())
        # Version 3 of the format needs no library but SciPy.
        found.dataset.to_netcdf(written[2], engine="scipy")
        places = [one.ravel() for one in np.meshgrid(*grid, indexing="ij")]
        columns = {"x1": places[0], "x2": places[1], "label": found.label.values.ravel()}
        write_columns(columns, written[1])
    say(lines, written, as_json=as_json, data=data)


def _shares_as_data(found: "jb.Basins") -> dict[str, Any]:
    """Fractions of the starts of the grid by the name of their attractor, for JSON."""
    labels = found.label.values
    shares = {name: float((labels == i).mean()) for i, name in enumerate(found.attractors)}
    return {"attractors": shares, "undecided": float((labels < 0).mean())}
