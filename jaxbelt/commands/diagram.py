"""`jaxbelt diagram`: equilibria, cycles and bifurcation points along a parameter."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import typer

import jaxbelt as jb
from jaxbelt.model.parameters import names_of

from .options import (
    Belts,
    Class,
    Damping,
    Nu0,
    Nu1,
    Omega,
    Sigma,
    Sigma0,
    Sigma1,
    make_console,
    oscillator,
    plain_errors,
    say,
)

#: Arguments of classes that may be varied, other than velocities: an edge of two belts, or of one.
EDGES = ("sigma", "sigma0", "sigma1")
#: Short names of parameters that may be varied.
PARAMETERS = {"nu0": "belts[0].velocity", "nu1": "belts[1].velocity", "zeta": "damping"}


def diagram(
    system: Class = "b",
    nu0: Nu0 = None,
    nu1: Nu1 = None,
    sigma: Sigma = None,
    sigma0: Sigma0 = None,
    sigma1: Sigma1 = None,
    belt: Belts = None,
    damping: Damping = 0.5,
    omega: Omega = 1.0,
    parameter: Annotated[
        str,
        typer.Option(
            "--vary",
            help="The parameter: nu0, nu1, zeta, sigma, sigma0, sigma1, or its path, such as "
            "belts[1].friction.steepness.",
        ),
    ] = "nu0",
    span: Annotated[
        tuple[float, float], typer.Option(metavar="FROM TO", help="Its first and last value.")
    ] = (-0.7, 0.7),
    rows: Annotated[int, typer.Option(help="About how many values are computed.")] = 160,
    quantity: Annotated[str, typer.Option(help="What is drawn: x2, x1 or period.")] = "x2",
    out: Annotated[
        Path, typer.Option(help="Where to write, without an ending: OUT.png, OUT.csv, ...")
    ] = Path("diagram"),
) -> None:
    """Equilibria and cycles along a parameter, and every bifurcation point, found by itself.

    - **OUT.png**: the diagram in the manner of the paper's Figs. 3 and 7: stable black, unstable
      grey, unstable cycles dashed; the regions between the points have the paper's names.

    - **OUT.csv**: the branches: branch, kind, value, stable, x1_min, x1_max, x2_min, x2_max,
      period, multiplier, stick_duration of each belt.

    - **OUT_points.csv**: value, kind, belts, error (a bound), status of every bifurcation point.

    An oscillator is described as for **simulate**; what is varied needs no value.

    Examples:

    - jaxbelt diagram --nu1 0.35

    - jaxbelt diagram --nu0 -0.2 --nu1 0.35 --vary zeta --span 0 1.5 --quantity x1

    - jaxbelt diagram --class c --nu0 0.35 --nu1 -0.25 --vary sigma --span -1 1
    """
    from ..plotting.diagrams import plot_diagram
    from ..plotting.style import draw_key, journal_figure, journal_style, save

    console = make_console()
    with plain_errors():
        arguments = {"nu0": nu0, "nu1": nu1, "sigma": sigma, "sigma0": sigma0, "sigma1": sigma1}

        def along(p):
            return oscillator(system, {**arguments, parameter: p}, belt, damping, omega)

        with console.status("looking along the parameter (the first minute is compilation)"):
            if parameter in EDGES:
                found = jb.bifurcation_diagram(along, span=span, rows=rows)
                found = replace(found, name=parameter)
            else:
                osc = oscillator(system, arguments, belt, damping, omega)
                found = jb.bifurcation_diagram(osc, _where(osc, parameter), span, rows=rows)
        with journal_style():
            figure = journal_figure(7.2, 4.2)
            plot_diagram(found, figure.subplots(), quantity=quantity)
            draw_key(figure)
            out.parent.mkdir(parents=True, exist_ok=True)
            written = [out.with_name(out.name + end) for end in (".png", ".csv", "_points.csv")]
            save(figure, written[0])
        write_branches(found, written[1])
        write_points(found.points, written[2])
    say(console, [repr(found), *map(repr, found.points)], written)


def _where(osc: jb.Oscillator, name: str) -> Any:
    """What selects the parameter of that name or path."""
    paths = names_of(osc)
    path = PARAMETERS.get(name, name)
    if path not in paths:
        edges = ", ".join(EDGES)
        raise ValueError(
            f"vary must be nu0, nu1, zeta, {edges} or one of {', '.join(paths)}, got {name}"
        )
    return lambda osc: jax.tree.leaves(osc)[paths.index(path)]


def write_points(points, path: Path) -> None:
    """value, kind, belts, error and status, a row a bifurcation point."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["value", "kind", "belts", "error", "status"])
        for point in points:
            status = jb.Status(int(point.status)).name
            belts = " ".join(map(str, point.condition.belts_concerned))
            row = [float(point.value), point.kind, belts, float(point.error)]
            writer.writerow([*row, status])


def write_branches(found: jb.BifurcationDiagram, path: Path) -> None:
    """A row an equilibrium or cycle, see `jaxbelt diagram --help`."""
    fields = ("values", "stable", "x1_min", "x1_max", "x2_min", "x2_max", "period", "multiplier")
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        belts = range(len(found.oscillator.belts))
        names = [f"stick_duration{i}" for i in belts]
        writer.writerow(["branch", "kind", "value", *fields[1:], *names])
        for number, branch in enumerate(found.branches):
            columns = [np.asarray(getattr(branch, name)).tolist() for name in fields]
            sticks = np.asarray(branch.stick_durations).tolist()
            for row, durations in zip(zip(*columns, strict=True), sticks, strict=True):
                writer.writerow([number, branch.kind, *row, *durations])
