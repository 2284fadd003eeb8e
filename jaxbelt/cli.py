"""The command line, `jaxbelt reproduce`, `jaxbelt simulate` and the rest."""

import jax
import typer

from .commands.basins import basins
from .commands.diagram import diagram
from .commands.map import region_map
from .commands.reproduce import reproduce
from .commands.simulate import simulate
from .commands.sweep import sweep
from .commands.verify import verify

app = typer.Typer(
    name="jaxbelt",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
)


@app.callback()
def main() -> None:
    """Belt-driven dry-friction oscillators: simulation and bifurcation analysis.

    All quantities are dimensionless: displacement x1, velocity x2, time tau = omega t, belt
    velocities nu0, nu1. **jaxbelt COMMAND --help** explains a command.
    """
    # The package never touches JAX's settings; a program of its own may.
    jax.config.update("jax_enable_x64", True)


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
