"""`jaxbelt diagram`: equilibria, cycles and bifurcation points along a parameter."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

import jaxbelt as jb

from ..spelling import did_you_mean
from .options import (
    Description,
    Interval,
    Json,
    Out,
    as_json_value,
    check_range,
    describes,
    from_to,
    make_console,
    names_in_words,
    outputs,
    plain_errors,
    say,
    turn_on_float64,
)

#: Arguments of classes that may be varied besides velocities: an edge of two belts, or of one.
EDGES = ("sigma", "sigma0", "sigma1")
#: Quantities that a diagram can show.
DRAWABLE = ("amplitude", "x1", "x2", "period")
POINT_COLUMNS = ("value", "kind", "belts", "type", "error", "status")


@describes()
def diagram(
    described: Description,
    parameter: Annotated[
        str,
        typer.Option(
            "--vary",
            help="The parameter: nu0, nu1, ..., zeta, sigma, sigma0, sigma1, or its path, such as "
            "belts[1].friction.steepness.",
        ),
    ] = "nu0",
    span: Annotated[Interval, from_to("Its first and last value.")] = (-0.7, 0.7),
    rows: Annotated[int, typer.Option(help="About how many values are computed.")] = 160,
    quantity: Annotated[
        str | None,
        typer.Option(
            help="What is drawn: amplitude, x1, x2 or period.",
            show_default="amplitude where a cycle sticks, else x2, or x1 where there is no cycle",
        ),
    ] = None,
    out: Out = Path("diagram"),
    as_json: Json = False,
) -> None:
    """Equilibria and cycles along a parameter, and every bifurcation point, found without a guess.

    - **OUT.png**: the diagram: stable black, unstable grey, unstable cycles dashed; the regions
      between the points have the paper's names. With --quantity x2 as in the paper's Figs. 3 and 7.

    - **OUT.csv**: the branches: branch, kind, value, stable, x1_min, x1_max, x2_min, x2_max,
      period, multiplier, stick_duration of each belt.

    - **OUT_points.csv**: value, kind, belts, type (such as subcritical; "" where the kind has only
      one), error (a bound), status of every bifurcation point.

    An oscillator is described as for **simulate**; the parameter that varies needs no value. Takes
    some ten seconds, mostly to compile; longer with contact edges.

    Examples:

    - jaxbelt diagram --nu1 0.35

    - jaxbelt diagram --nu0 -0.2 --nu1 0.35 --vary zeta --span 0 1.5 --quantity x1

    - jaxbelt diagram --class c --nu0 0.35 --nu1 -0.25 --vary sigma --span -1 1
    """
    console = make_console()
    with plain_errors():
        if rows < 1:
            raise ValueError(f"rows must be at least 1, got {rows}")
        if quantity is not None and quantity not in DRAWABLE:
            raise ValueError(f"quantity must be one of {', '.join(DRAWABLE)}, got {quantity}")
        check_range("span", span)
        written = outputs(out, ".png", ".csv", "_points.csv")
        described.check(**({parameter: span[0]} if parameter in EDGES else {}))
        paths, short = described.parameters(), described.short_names
        if parameter not in (*short, *paths):
            known, meant = names_in_words(short, paths), did_you_mean(parameter, (*short, *paths))
            raise ValueError(f"vary must be {known}, got {parameter}{meant}")
        turn_on_float64()

        def along(p):
            return described.oscillator(**{parameter: p})

        if parameter in EDGES:
            found = jb.bifurcation_diagram(along, span=span, rows=rows)
            found = replace(found, name=parameter)
        else:
            osc = described.oscillator()
            found = jb.bifurcation_diagram(osc, _where(osc, paths[parameter]), span, rows=rows)
        from ..plotting.diagrams import plot_diagram
        from ..plotting.style import draw_key, journal_figure, journal_style, save

        with journal_style():
            figure = journal_figure(7.2, 4.2)
            plot_diagram(found, figure.subplots(), quantity=quantity)
            draw_key(figure)
            out.parent.mkdir(parents=True, exist_ok=True)
            save(figure, written[0])
        write_branches(found, written[1])
        write_points(found.points, written[2])
    regions = [{"from": a, "to": b, "name": name} for a, b, name in found.regions]
    data = {"parameter": found.name, "points": _points_as_data(found.points), "regions": regions}
    lines = [repr(found), *map(repr, found.points)]
    say(console, lines, written, as_json=as_json, data=data)


def _where(osc: "jb.Oscillator", path: str) -> Any:
    """Function that selects the parameter with this path."""
    import jax

    from ..model.parameters import names_of

    place = names_of(osc).index(path)
    return lambda osc: jax.tree.leaves(osc)[place]


def write_points(points, path: Path) -> None:
    """Writes value, kind, belts, type, error and status, one row for each bifurcation point."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(POINT_COLUMNS)
        writer.writerows(map(_in_columns, points))


def _in_columns(point: "jb.BifurcationPoint") -> list[Any]:
    belts = " ".join(map(str, point.condition.belts_concerned))
    status = jb.Status(int(point.status)).name
    return [float(point.value), point.kind, belts, point.type, float(point.error), status]


def _points_as_data(points) -> list[dict[str, Any]]:
    """Rows of `write_points`, for JSON."""
    rows = [dict(zip(POINT_COLUMNS, _in_columns(point), strict=True)) for point in points]
    return [row | {name: as_json_value(row[name]) for name in ("value", "error")} for row in rows]


def write_branches(found: "jb.BifurcationDiagram", path: Path) -> None:
    """Writes one row for each equilibrium or cycle, see `jaxbelt diagram --help`."""
    fields = ("values", "stable", "x1_min", "x1_max", "x2_min", "x2_max", "period", "multiplier")
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        belts = range(len(found.oscillator.belts))
        names = [f"stick_duration{i}" for i in belts]
        writer.writerow(["branch", "kind", "value", *fields[1:], *names])
        for number, branch in enumerate(found.branches):
            columns = [getattr(branch, name).tolist() for name in fields]
            sticks = branch.stick_durations.tolist()
            for row, durations in zip(zip(*columns, strict=True), sticks, strict=True):
                writer.writerow([number, branch.kind, *row, *durations])
