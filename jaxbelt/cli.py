"""The command line, `jaxbelt reproduce`, `jaxbelt simulate` and the rest."""

from dataclasses import fields
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

import jaxbelt

from .commands.basins import basins
from .commands.cache import cache
from .commands.description import CLASSES, Description
from .commands.diagram import diagram
from .commands.map import region_map
from .commands.options import plain_errors
from .commands.orbits import orbits
from .commands.reproduce import reproduce
from .commands.simulate import simulate
from .commands.sweep import sweep
from .commands.verify import verify
from .commands.warm import warm
from .spelling import near


class Command(TyperCommand):
    """A command that suggests a known option, or an axis of `sweep`, for an unknown option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        given = list(args)
        try:
            rest = super().parse_args(ctx, args)
        except Exception as error:
            # The module of this class depends on the version of typer.
            if type(error).__name__ == "NoSuchOption":
                name = error.__dict__["option_name"]
                # For -nu0 the name in the error is -n.
                words = [name] if name.startswith("--") else [one for one in given if name in one]
                error.__dict__["possibilities"] = self._meant(words[0] if words else name)
            raise
        with plain_errors():
            if ctx.params.get("belt") and self._given(ctx, ["system"]):
                system = ctx.params["system"]
                raise ValueError(f"with --belt no class must be described, got --class {system}")
            describing = [field.name for field in fields(Description) if field.name != "file"]
            if ctx.params.get("file") and (given := self._given(ctx, describing)):
                came = ", ".join(given)
                raise ValueError(f"with --file nothing else must be described, got {came}")
        return rest

    def _given(self, ctx: Any, names: list[str]) -> list[str]:
        """The options of these parameters that stand on the command line."""
        sources = {one: ctx.get_parameter_source(one.name) for one in self.params}
        return [
            one.opts[0]
            for one, source in sources.items()
            if one.name in names and source is not None and source.name == "COMMANDLINE"
        ]

    def _meant(self, word: str) -> list[str]:
        """Similar options, compared without dashes, which all options have."""
        names = [name for one in self.params for name in one.opts]
        known = {name[2:]: name for name in names if name.startswith("--")}
        if "--damping" in names:
            known["zeta"] = "--damping"
        if "axes" in names:
            own = {name for one in CLASSES.values() for name in one} | {"x1", "x2", "zeta"}
            known |= {name: f"{name}=..." for name in sorted(own)}
        return [known[name] for name in near(word.strip("-").partition("=")[0], known)]


app = typer.Typer(name="jaxbelt", no_args_is_help=True, rich_markup_mode="markdown")


def show_version(wanted: bool) -> bool:
    """Prints the version and exits, for `--version`."""
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
    velocities nu0, nu1; or in SI units, where a file describes a machine. **jaxbelt COMMAND
    --help** explains a command.
    """


for name, command in (
    ("reproduce", reproduce),
    ("simulate", simulate),
    ("diagram", diagram),
    ("orbits", orbits),
    ("map", region_map),
    ("sweep", sweep),
    ("basins", basins),
    ("verify", verify),
    ("warm", warm),
    ("cache", cache),
):
    app.command(name, cls=Command)(command)
