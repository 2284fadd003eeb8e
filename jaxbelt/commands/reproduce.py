"""`jaxbelt reproduce`: the paper's table and figures, recomputed."""

from pathlib import Path
from typing import Annotated

import rich.table
import typer

from .options import Json, check_out, make_console, plain_errors, say, steps_bar, turn_on_float64


def reproduce(
    out: Annotated[
        Path, typer.Option(help="Folder for the files; made where it is not there.")
    ] = Path("reproduction"),
    as_json: Json = False,
) -> None:
    """Recompute the table and the figures of Casini and Vestroni (2004).

    Writes **critical_values.json** (the critical belt velocities of sections 3.2 and 3.3
    of the paper: printed, computed, residual, iterations) and the figures as **figNN.png**,
    numbered as in the paper, and prints the table. Takes one to two minutes, most of them
    compilation.

    Example: **jaxbelt reproduce --out results**
    """
    console = make_console()
    with plain_errors():
        if out.exists() and not out.is_dir():
            raise ValueError(f"out must be a folder, got the file {out}")
        check_out(out / "critical_values.json")
        turn_on_float64()
        # Imported late, because matplotlib comes with it, to keep `--help` quick.
        from .. import paper

    with plain_errors(), steps_bar(console, 32, as_json) as progress:
        task = progress.add_task("", total=paper.steps())
        started = False

        def report(description: str) -> None:
            nonlocal started
            progress.update(task, advance=int(started), description=description)
            started = True

        values = paper.reproduce(out, report)
        progress.update(task, advance=1, description="done")
    if as_json:
        names = ["critical_values.json", *(f"{name}.png" for name in paper.FIGURES)]
        data = {"critical_values": paper.table_as_json(values)}
        say([], [out / name for name in names], as_json=True, data=data)
        return
    console.print(_rich_table(values))
    for line in (
        *paper.REMARKS,
        f"Written to {out}: critical_values.json, {', '.join(paper.FIGURES)}",
    ):
        console.print(line, markup=False, highlight=False, soft_wrap=not console.is_terminal)


def _rich_table(values) -> rich.table.Table:
    table = rich.table.Table(title="Critical velocities nu0 of the paper, recomputed")
    for name in ("class", "point", "kind"):
        table.add_column(name)
    for name in ("printed", "computed", "difference", "residual", "iterations"):
        table.add_column(name, justify="right")
    for value in values:
        table.add_row(
            value.system,
            value.point,
            value.kind,
            f"{value.printed:.5g}",
            f"{value.computed:.12f}",
            f"{value.computed - value.printed:+.1e}",
            f"{value.residual:.0e}",
            str(value.iterations),
        )
    return table
