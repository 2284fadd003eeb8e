"""The command line, `jaxbelt reproduce`, `jaxbelt simulate` and the rest."""

from typing import Annotated

import typer

import jaxbelt

from .commands.basins import basins
from .commands.diagram import diagram
from .commands.map import region_map
from .commands.reproduce import reproduce
from .commands.simulate import simulate
from .commands.sweep import sweep
from .commands.verify import verify

app = typer.Typer(name="jaxbelt", no_args_is_help=True, rich_markup_mode="markdown")


def show_version(wanted: bool) -> bool:
    """Print the version and end, where that is wanted."""
    if wanted:
        print(f"jaxbelt {jaxbelt.__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def main(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=show_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Belt-driven dry-friction oscillators: simulation and bifurcation analysis.

    All quantities are dimensionless: displacement x1, velocity x2, time tau = omega t, belt
    velocities nu0, nu1. **jaxbelt COMMAND --help** explains a command.
    """


for name, command in (
    ("reproduce", reproduce),
    ("simulate", simulate),
    ("diagram", diagram),
    ("map", region_map),
    ("sweep", sweep),
    ("basins", basins),
    ("verify", verify),
):
    app.command(name)(command)
