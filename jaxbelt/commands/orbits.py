"""`jaxbelt orbits`: an orbit diagram, the points of attractors along a parameter."""

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

import jaxbelt as jb

from .description import Description, describes
from .options import (
    BYTES_OF_ROW,
    Json,
    Out,
    Start,
    Vary,
    VarySpan,
    check_count,
    check_range,
    check_word,
    outputs,
    picture,
    plain_errors,
    say,
    turn_on_float64,
)
from .tables import headed, in_columns, write_columns


@describes()
def orbits(
    described: Description,
    parameter: Vary = "nu0",
    span: VarySpan = (-0.7, 0.7),
    rows: Annotated[int, typer.Option(help="How many values, evenly spread.")] = 400,
    start: Start = None,
    also: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X1,X2",
            help="A further start; give it once a start. Where attractors coexist, each start "
            "shows its own.",
            show_default="none",
        ),
    ] = None,
    sense: Annotated[
        str | None,
        typer.Option(
            help="up, down or both: each value begins from the attractor of the one before it, as "
            "the parameter rises or falls; with both, up is start 0 and down is start 1.",
            show_default="each value begins from --start",
        ),
    ] = None,
    quantity: Annotated[
        str, typer.Option(help="x1 or x2: whose extrema the points are, and what is drawn.")
    ] = "x1",
    out: Out = Path("orbits"),
    as_json: Json = False,
) -> None:
    """The points of attractors along a parameter, from given starts, by brute force.

    At each value the starts are followed until their attractors are known. Points of a cycle are
    the extrema in one loop; with forcing they are the states once in each of its periods.

    - **OUT.png**: the points over the parameter.

    - **OUT.csv**: value, start (its number), kind, period, x1, x2 of every point.

    An oscillator is described as for **simulate**; the parameter that varies needs no value. Of a
    machine all is in SI units. Unstable motions are in **diagram** only.

    Examples:

    - jaxbelt orbits --class b --nu1 0.35 --span 0 0.7

    - jaxbelt orbits --belt 1,law=coulomb,static=1,kinetic=0.6 --damping 0.1 --force 0.5,1
      --vary "forcing[0].frequency" --span 0.4 0.8 --also 0,0.5

    - jaxbelt orbits --class b --nu1 0.35 --span 0 0.7 --sense both

    - jaxbelt orbits --file machine.toml --vary "belts[0].normal_force" --span 5 30
    """
    with plain_errors():
        check_count("rows", rows, 2, each=BYTES_OF_ROW)
        check_word("quantity", quantity, ("x1", "x2"))
        check_range("span", span)
        further = list(map(parse_start, also or ()))
        written = outputs(out, ".png", ".csv")
        described.check_parameter(parameter)
        turn_on_float64()
        y0 = [described.start(one) for one in (start, *further)]
        path = described.path_along(parameter, span)
        at = None if described.is_forced else jb.AtExtrema(quantity)
        found = jb.orbit_diagram(*path, at=at, y0=y0, rows=rows, sense=sense)
        if path[1] is None:
            found = replace(found, name=parameter)
        with picture(written[0], 7.2, 4.2) as figure:
            ax = figure.subplots()
            if described.machine:
                jb.plot_in_si(found, described.machine, ax, quantity=quantity)
            else:
                found.plot(ax, quantity=quantity)
        columns: dict[str, Any] = {str(name): one for name, one in found.table().items()}
        if described.machine:
            columns = in_columns(jb.in_si(found, described.machine), [*columns])
        write_columns(columns, written[1])
    kinds = found.kind.ravel().tolist()
    counts = dict(Counter(kinds))
    data = {"parameter": parameter, "runs": len(kinds), "kinds": counts}
    lines = [repr(found)]
    if described.machine:
        symbol = described.unit(parameter)[0]
        words = ", ".join(f"{count} {kind}" for kind, count in counts.items())
        ends = f"{span[0]:g} to {span[1]:g}"
        lines = [f"{headed(parameter, symbol)} from {ends}, {len(kinds)} runs: {words}"]
        data["unit"] = symbol
    say(lines, written, as_json=as_json, data=data)


def parse_start(text: str) -> tuple[float, float]:
    """Parses a start such as `0.5,-1`."""
    try:
        x1, x2 = map(float, text.split(","))
    except ValueError:
        x1 = x2 = math.nan
    if not math.isfinite(x1 + x2):
        raise ValueError(f"also must be X1,X2, two finite numbers, got {text!r}")
    return x1, x2
