"""`jaxbelt diagram`: equilibria, cycles and bifurcation points along a parameter."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

import jaxbelt as jb

from .description import Description, describes
from .options import (
    BYTES_OF_ROW,
    Interval,
    Json,
    Out,
    Vary,
    VarySpan,
    as_json_value,
    check_count,
    check_range,
    check_word,
    option,
    outputs,
    picture,
    plain_errors,
    say,
    turn_on_float64,
)
from .tables import headed, in_columns, write_columns

#: Quantities that a diagram can show.
DRAWABLE = ("amplitude", "x1", "x2", "period")
#: Fields of a branch that are columns of the table.
FIELDS = ("stable", "x1_min", "x1_max", "x2_min", "x2_max", "period", "multiplier")


@describes()
def diagram(
    described: Description,
    parameter: Vary = "nu0",
    span: VarySpan = (-0.7, 0.7),
    start: Annotated[
        Interval | None,
        typer.Option(
            metavar="X1 X2",
            help="With forcing: a start that leads to the motion in the middle of the span; of a "
            "machine in m and m/s.",
            show_default="from where one is found",
        ),
    ] = None,
    rows: Annotated[int, typer.Option(help="About how many values are computed.")] = 160,
    quantity: Annotated[
        str | None,
        option(
            "What is drawn: amplitude, x1, x2 or period.",
            "amplitude where a cycle sticks, else x2, or x1 where there is no cycle",
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

    With forcing it is the branch of one periodic motion, stable and unstable, and what leaves it at
    period doublings: the motion that **--start** leads to in the middle of the span, or one that is
    found. Values at which a branch could not be followed further, and no point says why, are
    printed, and are the open_ends of --json. Of a machine all is in SI units.

    An oscillator is described as for **simulate**; the parameter that varies needs no value. Takes
    some ten seconds, mostly to compile; longer with contact edges.

    Examples:

    - jaxbelt diagram --nu1 0.35

    - jaxbelt diagram --nu0 -0.2 --nu1 0.35 --vary zeta --span 0 1.5 --quantity x1

    - jaxbelt diagram --class c --nu0 0.35 --nu1 -0.25 --vary sigma --span -1 1

    - jaxbelt diagram --class a --force 0.5,1.2 --vary "forcing[0].frequency" --span 0.8 1.6

    - jaxbelt diagram --file machine.toml --vary "belts[0].velocity" --span 0.05 0.3
    """
    with plain_errors():
        check_count("rows", rows, 1, each=BYTES_OF_ROW)
        if quantity is not None:
            check_word("quantity", quantity, DRAWABLE)
        check_range("span", span)
        written = outputs(out, ".png", ".csv", "_points.csv")
        described.check_parameter(parameter)
        turn_on_float64()
        given = None if start is None else described.start(start)
        path = described.path_along(parameter, span)
        found = jb.bifurcation_diagram(*path, start=given, rows=rows)
        if path[1] is None:
            found = replace(found, name=parameter)
        from ..plotting.diagrams import plot_diagram
        from ..plotting.style import draw_key

        with picture(written[0], 7.2, 4.2) as figure:
            if described.machine:
                jb.plot_in_si(found, described.machine, figure.subplots(), quantity=quantity)
            else:
                plot_diagram(found, figure.subplots(), quantity=quantity)
                draw_key(figure)
        unit = described.unit(parameter)
        write_columns(branches_of(found, described.machine), written[1])
        points = points_of(found.points, *unit)
        write_columns(points, written[2])
    symbol, size = unit
    regions = [{"from": a * size, "to": b * size, "name": name} for a, b, name in found.regions]
    rows_of_points = _as_rows(points)
    open_ends = [end * size for end in found.open_ends]
    data = {"parameter": found.name, "points": rows_of_points, "regions": regions}
    data |= {"open_ends": open_ends}
    lines = [repr(found), *map(repr, found.points)]
    if described.machine:
        data |= {"parameter": parameter, "unit": symbol}
        counts = f"{len(found.points)} points, {len(found.branches)} branches"
        if open_ends:
            counts += f", not followed beyond {', '.join(f'{end:.6g}' for end in open_ends)}"
        lines = [f"{headed(parameter, symbol)} from {span[0]:g} to {span[1]:g}: {counts}"]
        lines += [
            ", ".join(f"{k} {v}" for k, v in row.items() if v != "") for row in rows_of_points
        ]
    say(lines, written, as_json=as_json, data=data)


def points_of(points: "tuple[jb.BifurcationPoint, ...]", unit: str, size: float) -> dict[str, Any]:
    """Columns value, kind, belts, type, error and status, a row for each bifurcation point.

    unit: unit of the parameter. size: size of the oscillator's unit of the parameter in it.
    """
    return {
        headed("value", unit): [float(point.value) * size for point in points],
        "kind": [point.kind for point in points],
        "belts": [" ".join(map(str, point.condition.belts_concerned)) for point in points],
        "type": [point.type for point in points],
        headed("error", unit): [float(point.error) * size for point in points],
        "status": [jb.Status(int(point.status)).name for point in points],
    }


def _as_rows(columns: dict[str, list[Any]]) -> list[dict[str, Any]]:
    """Rows of a table of points, for JSON."""
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    return [
        {k: as_json_value(v) if isinstance(v, float) else v for k, v in row.items()} for row in rows
    ]


def branches_of(found: "jb.BifurcationDiagram", machine: "jb.Machine | None") -> dict[str, Any]:
    """Columns of the branches, a row for each equilibrium or cycle; see `jaxbelt diagram --help`.

    With a machine they are in SI units.
    """
    sticks = (f"stick_duration_{i}" for i in range(len(found.oscillator.belts)))
    names = ["branch", "kind", "value", *FIELDS, *sticks]
    if machine:
        rows = jb.in_si(found, machine)
        columns = in_columns(rows.isel(row=rows.branch.values >= 0), names)
    else:
        table: Any = found.table().reindex(columns=names)
        columns = dict(table[table.branch.notna()].items())
    return {name.replace("duration_", "duration"): one for name, one in columns.items()}
