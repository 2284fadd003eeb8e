"""`jaxbelt sweep`: a class of the paper from every point of a grid."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import jaxbelt as jb

from .options import Class, check_out, class_along, make_console, plain_errors, say


def sweep(
    axes: Annotated[
        list[str],
        typer.Argument(
            metavar="AXIS...",
            help="One axis or more, NAME=FROM:TO:COUNT or NAME=VALUE: arguments of the class, and "
            "x1 and x2 for starts.",
        ),
    ],
    system: Class = "b",
    observe: Annotated[
        str, typer.Option(help="attractor (what each run leads to) or final (where it ends).")
    ] = "attractor",
    variable: Annotated[
        str | None, typer.Option(help="What the picture shows [kind, or x1_end]")
    ] = None,
    start: Annotated[
        tuple[float, float],
        typer.Option(metavar="X1 X2", help="Displacement x1 and velocity x2 at tau = 0."),
    ] = (3.0, 0.0),
    t1: Annotated[
        float | None, typer.Option(help="End of each run [30000 for attractors, 100]")
    ] = None,
    tolerance: Annotated[
        float, typer.Option(help="Relative and absolute tolerance of the integrator.")
    ] = 1e-8,
    out: Annotated[
        Path,
        typer.Option(
            help="Where to write: NetCDF if it ends in .nc; if in .zarr, a store, from which the "
            "same command goes on where it was interrupted."
        ),
    ] = Path("sweep.nc"),
    blocks: Annotated[
        str | None,
        typer.Option(
            metavar="FROM:TO",
            help="Do only these blocks of a store, 0:64 for the first 64; other processes may do "
            "others at the same time. --dry-run tells how many there are.",
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only tell how much it is and how long it will take.")
    ] = False,
) -> None:
    """Run one of the paper's classes from every point of a grid; write the data and a picture.

    - **OUT**: the dataset, labelled, with what it came from in its attributes.

    - the same name with **.png**: a picture, for one or two axes.

    The other arguments of the class have the values that **simulate** takes for them.

    Examples:

    - jaxbelt sweep nu0=-0.7:0.7:512 nu1=-0.7:0.7:512 --out plane.nc

    - jaxbelt sweep x1=-2:2:200 x2=-2:2:200 --observe final --t1 50 --out starts.zarr

    - jaxbelt sweep nu0=-0.7:0.7:8192 nu1=-0.7:0.7:8192 --out plane.zarr --blocks 0:64
    """
    console = make_console()
    with plain_errors():
        if out.suffix not in (".nc", ".zarr"):
            raise ValueError(f"out must end in .nc or .zarr, got {out}")
        part = None if blocks is None else parse_blocks(blocks)
        if part and out.suffix != ".zarr":
            raise ValueError(f"out must end in .zarr where blocks are given, got {out}")
        values = dict(map(parse_axis, axes))
        make = class_along(system, values, ("x1", "x2"))
        if t1 is None and observe != "attractor":
            t1 = 100.0
        asked: dict[str, Any] = dict(
            y0=start, t1=t1, rtol=tolerance, atol=tolerance, observe=observe
        )
        if dry_run:
            console.print(repr(jb.explain(make, values, **asked)), highlight=False, soft_wrap=True)
            return
        if out.suffix == ".zarr":
            dataset = jb.sweep(make, values, **asked, store=out, blocks=part)
        else:
            check_out(out)
            dataset = jb.sweep(make, values, **asked)
            # Version 3 of the format, which needs no library but SciPy.
            dataset.to_netcdf(out, engine="scipy")
        written = [out]
        if part is None and sum(len(axis) > 1 for axis in values.values()) in (1, 2):
            written.append(out.with_suffix(".png"))
            shown = variable or ("kind" if observe == "attractor" else "x1_end")
            _draw(dataset, shown, written[1])
    say(console, [repr(dataset)], written)


def _draw(dataset: Any, variable: str, out: Path) -> None:
    from ..plotting.style import journal_figure, journal_style, save
    from ..plotting.sweeps import plot_sweep

    with journal_style():
        figure = journal_figure(4.6, 4.4)
        plot_sweep(dataset, variable, figure.subplots())
        save(figure, out)


def parse_blocks(text: str) -> tuple[int, int]:
    """The first block and the one behind the last that a text such as `0:64` names."""
    first, colon, last = text.partition(":")
    if not (colon and first.isdecimal() and last.isdecimal() and int(first) < int(last)):
        raise ValueError(f"blocks must be FROM:TO, two integers with FROM < TO, got {text!r}")
    return int(first), int(last)


def parse_axis(text: str) -> tuple[str, np.ndarray]:
    """The name and the values that a text such as `nu0=-0.7:0.7:512` or `nu1=0.35` describes."""
    name, equals, words = text.partition("=")
    parts = words.split(":")
    try:
        if equals and len(parts) == 1:
            return name, np.array([float(words)])
        if equals and len(parts) == 3 and int(parts[2]) > 0:
            return name, np.linspace(float(parts[0]), float(parts[1]), int(parts[2]))
    except ValueError:
        pass
    raise ValueError(f"an axis must be NAME=FROM:TO:COUNT or NAME=VALUE, got {text!r}")
