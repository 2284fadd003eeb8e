"""The command line, `jaxbelt reproduce`, `jaxbelt simulate` and the rest: words in, files out."""

import csv
import functools
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

import jaxbelt as jb
from jaxbelt.model.parameters import names_of

app = typer.Typer(
    name="jaxbelt",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
)

#: The arguments of the four classes of the paper, and what they are unless given.
CLASSES = {
    "a": {"nu0": 0.2},
    "b": {"nu0": 0.45, "nu1": 0.35},
    "c": {"nu0": 0.2, "nu1": 0.4, "sigma": 0.8},
    "d": {"nu0": 0.2, "nu1": 0.4, "sigma0": 0.5, "sigma1": 1.0},
}
#: The friction laws by name, and what their arguments are unless given.
LAWS: dict[str, tuple[type[jb.AbstractFriction], dict[str, float | None]]] = {
    "conti": (jb.Conti, {"static": 1.0, "residual": 0.6, "steepness": 10.0, "quadratic": 0.0}),
    "coulomb": (jb.Coulomb, {"static": None, "kinetic": None}),
    "stribeck": (jb.Stribeck, {"static": None, "kinetic": None, "stribeck_velocity": None}),
}


@app.callback()
def main() -> None:
    """Belt-driven dry-friction oscillators: simulation and bifurcation analysis.

    All quantities are dimensionless: displacement x1, velocity x2, time tau = omega t, belt
    velocities nu0, nu1. **jaxbelt COMMAND --help** explains a command.
    """
    # The package never touches JAX's settings; a program of its own may.
    jax.config.update("jax_enable_x64", True)


@contextmanager
def _plain_errors() -> Iterator[None]:
    """What a user did wrong is told in its one sentence, with exit code 2; an interrupt, with the
    shells' 130."""
    try:
        yield
    except KeyboardInterrupt as error:
        typer.secho(str(error) or "interrupted", err=True, fg=typer.colors.RED)
        # At once: an exit by an exception would wait for a compilation under way.
        sys.stdout.flush()
        os._exit(130)
    except (ValueError, OSError) as error:
        typer.secho(f"Error: {error}", err=True, fg=typer.colors.RED)
        raise typer.Exit(2) from None


def _console() -> Console:
    # A file has no width that lines would have to be folded to.
    console = Console()
    return console if console.is_terminal else Console(width=200)


# --- options that describe an oscillator --------------------------------------------------------

Class = Annotated[str, typer.Option("--class", help="The paper's class of contact: a, b, c or d.")]
Nu0 = Annotated[float | None, typer.Option(help="Velocity of belt 0.")]
Nu1 = Annotated[float | None, typer.Option(help="Velocity of belt 1 (classes b, c, d).")]
Sigma = Annotated[float | None, typer.Option(help="Edge between the belts (class c).")]
Sigma0 = Annotated[float | None, typer.Option(help="Where belt 1 begins (class d).")]
Sigma1 = Annotated[float | None, typer.Option(help="Where belt 0 ends (class d).")]
Belts = Annotated[
    list[str] | None,
    typer.Option(
        "--belt",
        help="A belt in full, instead of a class; give it once a belt. A velocity, then "
        "name=value with commas between: load, lower, upper (its contact interval), law.",
    ),
]
Damping = Annotated[float, typer.Option(help="zeta = c / sqrt(k m).")]
Omega = Annotated[float, typer.Option(help="sqrt(k / m).")]


# --- reproduce ----------------------------------------------------------------------------------


@app.command()
def reproduce(
    out: Annotated[
        Path, typer.Option(help="Folder for the files; made where it is not there.")
    ] = Path("reproduction"),
) -> None:
    """Recompute the table and the figures of Casini and Vestroni (2004).

    Writes **critical_values.json** (the critical belt velocities of sections 3.2 and 3.3
    of the paper: printed, computed, residual, iterations) and the figures as **figNN.png**,
    numbered as in the paper, and prints the table. Takes one to two minutes, most of them
    compilation.

    Example: **jaxbelt reproduce --out results**
    """
    # Imported late, with matplotlib behind it, to keep `--help` quick.
    from . import paper

    console = _console()
    columns = (
        TextColumn("{task.description:<32}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with _plain_errors(), Progress(*columns, console=console) as progress:
        task = progress.add_task("", total=paper.steps())
        started = False

        def report(description: str) -> None:
            nonlocal started
            progress.update(task, advance=int(started), description=description)
            started = True

        values = paper.reproduce(out, report)
        progress.update(task, advance=1, description="done")
    console.print(_table_of(values))
    for line in (
        *paper.REMARKS,
        f"Written to {out}: critical_values.json, {', '.join(paper.FIGURES)}",
    ):
        console.print(line, markup=False, highlight=False, soft_wrap=not console.is_terminal)


def _table_of(values) -> Table:
    table = Table(title="Critical velocities nu0 of the paper, recomputed")
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


# --- simulate -----------------------------------------------------------------------------------


@app.command()
def simulate(
    system: Class = "b",
    nu0: Nu0 = None,
    nu1: Nu1 = None,
    sigma: Sigma = None,
    sigma0: Sigma0 = None,
    sigma1: Sigma1 = None,
    belt: Belts = None,
    damping: Damping = 0.5,
    omega: Omega = 1.0,
    start: Annotated[
        tuple[float, float],
        typer.Option(metavar="X1 X2", help="Displacement x1 and velocity x2 at tau = 0."),
    ] = (3.0, 0.0),
    t1: Annotated[float, typer.Option(help="End of the time span, which begins at 0.")] = 100.0,
    samples: Annotated[
        int, typer.Option(help="How many times, evenly spread over the span, are written.")
    ] = 2001,
    formulation: Annotated[
        str,
        typer.Option(
            help="filippov (exact), switch (the paper's switch model) or smooth (tanh for sgn)."
        ),
    ] = "filippov",
    v_star: Annotated[float, typer.Option(help="Half-width of the switch model's band.")] = 1e-3,
    eps: Annotated[float, typer.Option(help="Width of the smooth model's tanh.")] = 1e-3,
    tolerance: Annotated[
        float, typer.Option(help="Relative and absolute tolerance of the integrator.")
    ] = 1e-10,
    out: Annotated[
        Path, typer.Option(help="Where to write, without an ending: OUT.png, OUT.csv, ...")
    ] = Path("trajectory"),
) -> None:
    """Follow one oscillator from one start; write a picture and the numbers.

    - **OUT.png**: time histories with the stick phases shaded, and the phase portrait.

    - **OUT.csv**: t, x1, x2 and the contact of each belt: 1 or -1 slip with that sign of the
      relative velocity nu - omega x2, 0 stuck, -2 or 2 the mass below or above the belt's interval.

    - **OUT_events.csv**: t, x1, x2, kind (STICK, SLIP, CROSS, EDGE) and belt of every event.

    The classes have the friction of the paper (Conti's law, mus = 1, p1 = 0.6, p3 = 10):

    - a: one belt. Give --nu0.

    - b: two belts that always touch. Give --nu0 --nu1.

    - c: belt 0 below sigma, belt 1 above it. Give --nu0 --nu1 --sigma.

    - d: belt 0 below sigma1, belt 1 above sigma0. Give --nu0 --nu1 --sigma0 --sigma1.

    The laws of a --belt are conti (static, residual, steepness, quadratic; those of the paper
    unless given), coulomb (static, kinetic) and stribeck (static, kinetic, stribeck_velocity).

    Examples:

    - jaxbelt simulate --class a --nu0 0.2 --start 1.5 0 --t1 60

    - jaxbelt simulate --class d --nu1 -0.3 --sigma0 0 --sigma1 0.5 --out overlap

    - jaxbelt simulate --belt 0.3 --belt 0.5,law=coulomb,static=0.8,kinetic=0.5,lower=0.2
    """
    from .paper import steady_cycle
    from .plotting import plotting

    console = _console()
    with _plain_errors():
        if samples < 2:
            raise ValueError(f"samples must be at least 2, got {samples}")
        arguments = {"nu0": nu0, "nu1": nu1, "sigma": sigma, "sigma0": sigma0, "sigma1": sigma1}
        osc = _oscillator(system, arguments, belt, damping, omega)
        with console.status("simulating (the first seconds are compilation)"):
            trajectory = jb.simulate(
                osc,
                start,
                t1,
                ts=np.array([t1 * i / (samples - 1) for i in range(samples)]),
                rtol=tolerance,
                atol=tolerance,
                formulation=formulation,
                v_star=v_star,
                eps=eps,
            )
        out.parent.mkdir(parents=True, exist_ok=True)
        written = [out.with_name(out.name + end) for end in (".png", ".csv", "_events.csv")]
        cycle = steady_cycle(trajectory)
        with plotting.journal_style():
            figure = plotting.draw_overview(osc, trajectory, cycles=[cycle] if cycle else [])
            plotting.save(figure, written[0])
        write_samples(trajectory, written[1])
        write_events(trajectory, written[2])
    for line in (repr(trajectory), f"Written: {', '.join(map(str, written))}"):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    if int(trajectory.status) >= jb.Status.TOO_MANY_SEGMENTS:
        raise typer.Exit(1)


def _oscillator(system, arguments, belt, damping, omega) -> jb.Oscillator:
    given = {name: value for name, value in arguments.items() if value is not None}
    belts = _belts_of_class(system, given) if not belt else _belts_in_full(belt, given)
    return jb.Oscillator(damping, belts, omega)


def _belts_of_class(system: str, given: dict[str, float]) -> tuple[jb.Belt, ...]:
    if system not in CLASSES:
        raise ValueError(f"class must be a, b, c or d, got {system}")
    arguments = CLASSES[system]
    for name in given:
        if name not in arguments:
            raise ValueError(f"class {system} must have only {', '.join(arguments)}, got {name}")
    make = getattr(jb.presets, f"class_{system}")
    return make(**{**arguments, **given}).belts


def _belts_in_full(texts: list[str], given: dict[str, float]) -> list[jb.Belt]:
    if given:
        raise ValueError(f"with --belt no class must be described, got {', '.join(given)}")
    return [parse_belt(text) for text in texts]


def parse_belt(text: str) -> jb.Belt:
    """The belt that a text such as `0.3,load=0.5,law=coulomb,static=0.8,kinetic=0.5` describes."""
    velocity, *parts = text.split(",")
    words = dict.fromkeys(["velocity"], velocity)
    for part in parts:
        name, equals, value = part.partition("=")
        if not equals:
            raise ValueError(f"belt {text!r} must have name=value after its velocity, got {part!r}")
        words[name.strip()] = value
    name_of_law = words.pop("law", "conti").strip()
    if name_of_law not in LAWS:
        raise ValueError(f"law of belt {text!r} must be {', '.join(LAWS)}, got {name_of_law}")
    law, defaults = LAWS[name_of_law]
    known = ("velocity", "load", "lower", "upper", *defaults)
    numbers: dict[str, Any] = {}
    for name, word in words.items():
        if name not in known:
            raise ValueError(f"belt {text!r} must have only {', '.join(known)}, got {name}")
        try:
            numbers[name] = float(word)
        except ValueError:
            raise ValueError(f"{name} of belt {text!r} must be a number, got {word!r}") from None
    friction = {}
    for name, default in defaults.items():
        friction[name.removeprefix("stribeck_")] = numbers.pop(name, default)
        if friction[name.removeprefix("stribeck_")] is None:
            raise ValueError(f"belt {text!r} must have {name}, which {name_of_law} needs")
    return jb.Belt(friction=law(**friction), **numbers)


def write_samples(trajectory: jb.Trajectory, path: Path) -> None:
    """t, x1, x2 and the contact code of every belt, a row a sample; numbers to the last digit."""
    modes = np.asarray(trajectory.modes)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "x1", "x2", *(f"mode{i}" for i in range(modes.shape[1]))])
        ts, ys = np.asarray(trajectory.ts).tolist(), np.asarray(trajectory.ys).tolist()
        for t, y, mode in zip(ts, ys, modes.tolist(), strict=True):
            writer.writerow([t, *y, *mode])


def write_events(trajectory: jb.Trajectory, path: Path) -> None:
    """t, x1, x2, kind and belt, a row an event."""
    events = trajectory.events
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "x1", "x2", "kind", "belt"])
        columns = (np.asarray(events.t).tolist(), np.asarray(events.y).tolist())
        kinds = [jb.EventKind(kind).name for kind in np.asarray(events.kind).tolist()]
        for t, y, kind, belt in zip(*columns, kinds, np.asarray(events.belt).tolist(), strict=True):
            writer.writerow([t, *y, kind, belt])


# --- diagram and map ----------------------------------------------------------------------------

#: Short names of parameters that may be varied.
PARAMETERS = {"nu0": "belts[0].velocity", "nu1": "belts[1].velocity", "zeta": "damping"}


@app.command()
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
            help="The parameter: nu0, nu1, zeta, or its path, such as belts[1].friction.steepness.",
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
    """
    from .plotting import plotting

    console = _console()
    with _plain_errors():
        arguments = {"nu0": nu0, "nu1": nu1, "sigma": sigma, "sigma0": sigma0, "sigma1": sigma1}
        osc = _oscillator(system, arguments, belt, damping, omega)
        with console.status("looking along the parameter (the first minute is compilation)"):
            found = jb.bifurcation_diagram(osc, _where(osc, parameter), span, rows=rows)
        with plotting.journal_style():
            figure = plotting.journal_figure(7.2, 4.2)
            plotting.plot_diagram(found, figure.subplots(), quantity=quantity)
            plotting.draw_key(figure)
            out.parent.mkdir(parents=True, exist_ok=True)
            written = [out.with_name(out.name + end) for end in (".png", ".csv", "_points.csv")]
            plotting.save(figure, written[0])
        write_branches(found, written[1])
        write_points(found.points, written[2])
    lines = [repr(found), *map(repr, found.points)]
    for line in (*lines, f"Written: {', '.join(map(str, written))}"):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _where(osc: jb.Oscillator, name: str) -> Any:
    """What selects the parameter of that name or path."""
    paths = names_of(osc)
    path = PARAMETERS.get(name, name)
    if path not in paths:
        raise ValueError(f"vary must be nu0, nu1, zeta or one of {', '.join(paths)}, got {name}")
    return lambda osc: jax.tree.leaves(osc)[paths.index(path)]


def _belts_of(condition: Any) -> str:
    belts = getattr(condition, "belts", (condition.belt,) if hasattr(condition, "belt") else ())
    return " ".join(map(str, belts))


def write_points(points, path: Path) -> None:
    """value, kind, belts, error and status, a row a bifurcation point."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["value", "kind", "belts", "error", "status"])
        for point in points:
            status = jb.Status(int(point.status)).name
            row = [float(point.value), point.kind, _belts_of(point.condition), float(point.error)]
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


@app.command("map")
def region_map(
    system: Class = "b",
    axes: Annotated[
        tuple[str, str], typer.Option(metavar="P Q", help="The two arguments of the class.")
    ] = ("nu0", "nu1"),
    p: Annotated[
        tuple[float, float], typer.Option(metavar="FROM TO", help="Values of the first one.")
    ] = (-0.7, 0.7),
    q: Annotated[
        tuple[float, float], typer.Option(metavar="FROM TO", help="Values of the second one.")
    ] = (-0.7, 0.7),
    cells: Annotated[int, typer.Option(help="Cells along each side.")] = 200,
    out: Annotated[
        Path, typer.Option(help="Where to write, without an ending: OUT.png, OUT.csv, ...")
    ] = Path("map"),
) -> None:
    """The regions of a plane of two parameters, and the curves that bound them: Fig. 6.

    - **OUT.png**: the map, and a sketch of the phase portrait of each region.

    - **OUT.csv**: both parameters and the region's name, a row a cell.

    - **OUT_curves.csv**: curve, condition, belts, both parameters, multiplier of the cycle without
      the stick phase that vanishes, residual, special, a row a point of a curve. Points of
      codimension two stand at their places, named in the last column.

    The other arguments of the class have the values that **simulate** takes for them.

    Example: jaxbelt map --class b --cells 400
    """
    from .plotting import plotting

    console = _console()
    with _plain_errors():
        if system not in CLASSES:
            raise ValueError(f"class must be a, b, c or d, got {system}")
        for name in axes:
            if name not in CLASSES[system]:
                known = ", ".join(CLASSES[system])
                raise ValueError(f"axes of class {system} must be among {known}, got {name}")
        if cells < 2:
            raise ValueError(f"cells must be at least 2, got {cells}")
        fixed = {name: value for name, value in CLASSES[system].items() if name not in axes}
        make = functools.partial(getattr(jb.presets, f"class_{system}"), **fixed)
        # Other numbers of cells, lest cells lie on the line where both are the same.
        values = {axes[0]: np.linspace(*p, cells), axes[1]: np.linspace(*q, cells + 1)}
        with console.status("sweeping, then following curves (the first minutes are compilation)"):
            found = jb.region_map(make, values)
        with plotting.journal_style():
            figure = plotting.journal_figure(7.2, 9.0)
            plotting.draw_region_map(found, figure)
            out.parent.mkdir(parents=True, exist_ok=True)
            ends = (".png", ".csv", "_curves.csv")
            written = [out.with_name(out.name + end) for end in ends]
            plotting.save(figure, written[0])
        write_cells(found, written[1])
        write_rows(found.table(), written[2])
    for line in (repr(found), f"Written: {', '.join(map(str, written))}"):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def write_cells(found: jb.RegionMap, path: Path) -> None:
    """Both parameters and the name of the region, a row a cell."""
    first, second = (np.asarray(values).tolist() for values in found.values)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*found.names, "region"])
        for (i, j), name in np.ndenumerate(found.label):
            writer.writerow([first[i], second[j], name])


def write_rows(rows: list[dict[str, Any]], path: Path) -> None:
    """Dictionaries that have the same keys, a row each."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows(rows)


# --- sweep --------------------------------------------------------------------------------------


@app.command()
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
        float | None, typer.Option(help="End of each run [3000 for attractors, 100]")
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
    """
    from .plotting import plotting

    console = _console()
    with _plain_errors():
        if system not in CLASSES:
            raise ValueError(f"class must be a, b, c or d, got {system}")
        if out.suffix not in (".nc", ".zarr"):
            raise ValueError(f"out must end in .nc or .zarr, got {out}")
        values = dict(map(parse_axis, axes))
        for name in values:
            if name not in (*CLASSES[system], "x1", "x2"):
                known = ", ".join((*CLASSES[system], "x1", "x2"))
                raise ValueError(f"axes of class {system} must be among {known}, got {name}")
        fixed = {name: value for name, value in CLASSES[system].items() if name not in values}
        make = functools.partial(getattr(jb.presets, f"class_{system}"), **fixed)
        if t1 is None and observe != "attractor":
            t1 = 100.0
        asked: dict[str, Any] = dict(
            y0=start, t1=t1, rtol=tolerance, atol=tolerance, observe=observe
        )
        if dry_run:
            console.print(repr(jb.explain(make, values, **asked)), highlight=False, soft_wrap=True)
            return
        if out.suffix == ".zarr":
            dataset = jb.sweep(make, values, **asked, store=out)
        else:
            _check_out(out)
            dataset = jb.sweep(make, values, **asked)
            # Version 3 of the format, which needs no library but SciPy.
            dataset.to_netcdf(out, engine="scipy")
        written = [out]
        if sum(len(axis) > 1 for axis in values.values()) in (1, 2):
            written.append(out.with_suffix(".png"))
            shown = variable or ("kind" if observe == "attractor" else "x1_end")
            with plotting.journal_style():
                figure = plotting.journal_figure(4.6, 4.4)
                plotting.plot_sweep(dataset, shown, figure.subplots())
                plotting.save(figure, written[1])
    for line in (repr(dataset), f"Written: {', '.join(map(str, written))}"):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _check_out(out: Path) -> None:
    """Raise unless a file can be written there; before the computing, not after."""
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.is_dir():
        raise IsADirectoryError(f"out must be a file, got the folder {out}")
    if not os.access(out if out.exists() else out.parent, os.W_OK):
        raise PermissionError(f"out must be a place that can be written to, got {out}")


@app.command()
def verify(
    store: Annotated[Path, typer.Argument(help="A store that sweep wrote, such as plane.zarr.")],
    repair: Annotated[
        bool, typer.Option("--repair", help="Mark bad blocks, so that the sweep does them again.")
    ] = False,
) -> None:
    """Compute the checksums of a store again and tell which of its blocks are right.

    Exit code 1 if there are bad ones and they are not repaired. After a repair the command or the
    call that made the store does the marked blocks again.

    Example: **jaxbelt verify plane.zarr --repair**
    """
    with _plain_errors():
        found = jb.verify(store, repair)
    _console().print(repr(found), highlight=False, soft_wrap=True)
    if found.bad and not repair:
        raise typer.Exit(1)


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


# --- basins -------------------------------------------------------------------------------------


@app.command()
def basins(
    system: Class = "b",
    nu0: Nu0 = None,
    nu1: Nu1 = None,
    sigma: Sigma = None,
    sigma0: Sigma0 = None,
    sigma1: Sigma1 = None,
    belt: Belts = None,
    damping: Damping = 0.5,
    omega: Omega = 1.0,
    x1: Annotated[
        tuple[float, float], typer.Option(metavar="FROM TO", help="Displacements of the starts.")
    ] = (0.0, 3.0),
    x2: Annotated[
        tuple[float, float], typer.Option(metavar="FROM TO", help="Velocities of the starts.")
    ] = (-1.0, 1.0),
    points: Annotated[
        int, typer.Option(help="Starts along each side of the grid; their square is run.")
    ] = 201,
    starts: Annotated[
        int, typer.Option(help="Random starts for the basin stability of the window; 0: none.")
    ] = 10_000,
    seed: Annotated[int, typer.Option(help="Of the random starts.")] = 0,
    out: Annotated[
        Path, typer.Option(help="Where to write, without an ending: OUT.png, OUT.csv.")
    ] = Path("basins"),
) -> None:
    """Where each start leads: basins of attraction, and the unstable cycle between them.

    - **OUT.png**: a window of the phase plane, coloured by the attractor that a start leads to,
      with the stable cycles, and the unstable one dashed.

    - **OUT.csv**: x1, x2 and label of every start of the grid.

    Prints the fraction of the window that leads to each kind of attractor, with its standard error
    (basin stability), from random starts. An oscillator is described as for **simulate**.

    Examples:

    - jaxbelt basins --nu0 0.45 --nu1 0.35 --x1 0.5 2.5 --x2 -0.8 0.8

    - jaxbelt basins --belt 1.4,law=stribeck,static=1,kinetic=0.5,stribeck_velocity=0.5
      --damping 0.1 --x1 -2 2 --x2 0 2
    """
    from .plotting import plotting

    console = _console()
    with _plain_errors():
        if points < 2:
            raise ValueError(f"points must be at least 2, got {points}")
        arguments = {"nu0": nu0, "nu1": nu1, "sigma": sigma, "sigma0": sigma0, "sigma1": sigma1}
        osc = _oscillator(system, arguments, belt, damping, omega)
        grid = [np.linspace(*span, points) for span in (x1, x2)]
        written = [out.with_name(out.name + end) for end in (".png", ".csv")]
        for path in written:
            _check_out(path)
        with console.status("following the starts (the first seconds are compilation)"):
            found = jb.basins(osc, x1=grid[0], x2=grid[1], progress=False)
            lines = [repr(found)]
            if starts:
                key = jax.random.key(seed)
                lines.append(repr(jb.basin_stability(osc, box=(x1, x2), n=starts, key=key)))
        with plotting.journal_style():
            plotting.save(plotting.draw_basins(found), written[0])
        with written[1].open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["x1", "x2", "label"])
            for (i, j), label in np.ndenumerate(np.asarray(found.label)):
                writer.writerow([float(grid[0][i]), float(grid[1][j]), int(label)])
    for line in (*lines, f"Written: {', '.join(map(str, written))}"):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
