"""`jaxbelt sweep`: an oscillator from every point of a grid."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

import jaxbelt as jb

from .description import Description, describes
from .files import FromFile
from .options import (
    BYTES_OF_RUN,
    Json,
    Start,
    check_count,
    check_number,
    check_out,
    check_word,
    option,
    picture,
    plain_errors,
    say,
    tolerance_of,
    tolerances,
    turn_on_float64,
)

#: Variables of the dataset by the value of `--observe`; the picture shows the first by default.
VARIABLES = {
    "attractor": (
        *("kind", "signature", "sticks", "period", "stick_duration", "x1_min", "x1_max"),
        *("x2_min", "x2_max", "transient", "n_events", "status"),
    ),
    "final": ("x1_end", "x2_end", "mode_end", "n_events", "status"),
}
#: The same for forced oscillators.
VARIABLES_FORCED = {
    "attractor": (
        *("kind", "periods", "sticks", "period", "stick_duration", "x1_min", "x1_max"),
        *("x2_min", "x2_max", "winding", "x1_strobe", "x2_strobe", "exponent"),
        *("exponent_error", "transient", "n_events", "status"),
    ),
    "final": VARIABLES["final"],
    "lyapunov": ("exponent", "exponent_error", "n_events", "status"),
}
#: Default t1 by `--observe`; None: that of `jaxbelt.sweep`.
ENDS = {"attractor": None, "final": 100.0, "lyapunov": 1000.0}
#: Variables with a number for each belt: too many for a picture.
OF_BELTS = ("sticks", "stick_duration", "mode_end")
#: Bytes of memory that a run of a store takes: where a variable is drawn, and where only the
#: statuses are counted.
BYTES_DRAWN, BYTES_COUNTED = 100, 8


@describes("system", "belt", "damping", "omega", "force", "file")
def sweep(
    axes: Annotated[
        list[str],
        typer.Argument(
            metavar="AXIS...",
            help="One axis or more, NAME=FROM:TO:COUNT or NAME=VALUE: arguments of the class, nu0, "
            "nu1, ..., zeta, or paths of parameters, such as belts[1].friction.steepness, and x1 "
            "and x2 for starts.",
        ),
    ],
    described: Description,
    observe: Annotated[
        str,
        typer.Option(
            help="attractor (what each run leads to), final (where it ends) or, with --force, "
            "lyapunov (its largest exponent)."
        ),
    ] = "attractor",
    variable: Annotated[
        str | None,
        option(
            "What the picture shows, a variable of the dataset.", "kind, of the final state x1_end"
        ),
    ] = None,
    start: Start = None,
    t1: Annotated[
        float | None,
        option(
            "End of each run; of a machine in s.",
            "30000 for attractors, 100 for the final state, 1000 for exponents, dimensionless",
        ),
    ] = None,
    tolerance: Annotated[float | None, tolerance_of("1e-8")] = None,
    out: Annotated[
        Path,
        typer.Option(
            help="Where to write: NetCDF if it ends in .nc; if in .zarr, a store, from which the "
            "same command goes on where it was interrupted. A store of a machine is in the "
            "oscillator's own units; the whole is written in SI units to the same name with .nc. "
            "Folders that are missing are made."
        ),
    ] = Path("sweep.nc"),
    blocks: Annotated[
        str | None,
        typer.Option(
            metavar="FROM:TO",
            show_default="all",
            help="Do only these blocks of a store, 0:64 for the first 64; other processes may do "
            "others at the same time. --dry-run shows how many there are.",
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only show how much it is and how long it will take.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Run an oscillator from every point of a grid; write the data and a picture.

    - **OUT**: the dataset, labelled, with its origin in its attributes.

    - the same name with **.png**: a picture, for one or two axes.

    Takes some seconds to compile; **--dry-run** estimates how long the runs will take.

    An oscillator is described as for **simulate**. What is not an axis has the value given there,
    or the default of **simulate**. Of a machine all is in SI units; its mass and stiffness, which
    make the units of the others, are no axes.

    Examples:

    - jaxbelt sweep nu0=-0.7:0.7:512 nu1=-0.7:0.7:512 --out plane.nc

    - jaxbelt sweep x1=-2:2:200 x2=-2:2:200 --observe final --t1 50 --out starts.zarr

    - jaxbelt sweep nu0=0:1:64 "belts[0].friction.kinetic=0.2:0.8:64" --belt
      0.5,law=coulomb,static=0.8,kinetic=0.5 --damping 0.1

    - jaxbelt sweep "forcing[0].frequency=0.5:2:64" nu0=0.1:1:64 --class a --force 0.5,1.2

    - jaxbelt sweep "belts[0].normal_force=5:30:64" --file machine.toml --start 0.05 0

    - jaxbelt sweep nu0=-0.7:0.7:8192 nu1=-0.7:0.7:8192 --out plane.zarr --blocks 0:64
    """
    with plain_errors():
        if out.suffix not in (".nc", ".zarr"):
            raise ValueError(f"out must end in .nc or .zarr, got {out}")
        part = None if blocks is None else parse_blocks(blocks)
        if part and out.suffix != ".zarr":
            raise ValueError(f"out must end in .zarr where blocks are given, got {out}")
        parsed = list(map(parse_axis, axes))
        described.check_axes([name for name, _ in parsed], others=("x1", "x2"))
        values = dict(parsed)
        known = VARIABLES_FORCED if described.is_forced else VARIABLES
        check_word("observe", observe, known)
        shown = variable or known[observe][0]
        drawn = part is None and sum(len(axis) > 1 for axis in values.values()) in (1, 2)
        check_word("variable", shown, [name for name in known[observe] if name not in OF_BELTS])
        machine = described.machine
        # Without --blocks the store will be complete, so its dataset can be converted to SI units.
        file = out.with_suffix(".nc") if machine and part is None else out
        y0 = described.start(start)
        asked: dict[str, Any] = dict(y0=y0, observe=observe, **tolerances(tolerance))
        if t1 is not None:
            check_number("t1", t1)
        if not dry_run:
            each = BYTES_OF_RUN if file.suffix == ".nc" else BYTES_DRAWN if drawn else BYTES_COUNTED
            check_count("product of all COUNTs", math.prod(map(len, values.values())), each=each)
        if file.suffix == ".nc":
            check_out(file)
        check_out(out.with_suffix(".png"))
        turn_on_float64()
        own = [name for name in values if name not in ("x1", "x2")]
        described.check_ends({name: values[name] for name in own})
        make = described.along(own)
        asked["t1"] = ENDS[observe] if t1 is None else described.dimensionless(t1, "time")
        for name, quantity in (("x1", "length"), ("x2", "velocity")):
            if name in values:
                values[name] = [described.dimensionless(one, quantity) for one in values[name]]
        if dry_run:
            estimate = jb.explain(make, values, **asked)
            say([repr(estimate)], as_json=as_json, data=asdict(estimate))
            return
        store = dict(store=out, blocks=part) if out.suffix == ".zarr" else {}
        dataset = jb.sweep(make, values, **asked, **store)
        written = [out]
        if file.suffix == ".nc":
            if described.source and machine:
                dataset = _of_machine(dataset, described.source, own, y0)
            file.parent.mkdir(parents=True, exist_ok=True)
            # Version 3 of the format needs no library but SciPy.
            dataset.to_netcdf(file, engine="scipy")
            written = [*dict.fromkeys((out, file))]
        if drawn:
            written.append(out.with_suffix(".png"))
            from ..plotting.sweeps import plot_sweep

            with picture(written[-1], 4.6, 4.4) as figure:
                plot_sweep(dataset, shown, figure.subplots())
    say([repr(dataset)], written, as_json=as_json, data=_counts_as_data(dataset))


def _of_machine(dataset: Any, source: FromFile, axes: list[str], y0: tuple[float, float]) -> Any:
    """The dataset of a machine in SI units, with the units of its axes and of its start.

    axes: the parameters among the axes; their values are in the units of the file already.
    """
    machine: Any = source.machine
    units = machine.units
    found = jb.in_si(dataset, (lambda **_: units) if axes else machine)
    for name in axes:
        if unit := source.unit(name)[0]:
            found[name].attrs["units"] = unit
    start = {"x1": (y0[0] * units.length, "m"), "x2": (y0[1] * units.velocity, "m/s")}
    fixed = {name: of for name, of in start.items() if name not in found.dims}
    if words := [f"{name} = {value:.6g} {unit}" for name, (value, unit) in fixed.items()]:
        _, among, several = found.attrs["start"].partition(": of several")
        found.attrs["start"] = ", ".join(words) + among + several
    return found.assign_attrs(machine=repr(machine))


def _counts_as_data(dataset: Any) -> dict[str, Any]:
    """Number of runs, and how they ended."""
    import numpy as np

    from ..sweeps.datasets import words_of

    statuses, numbers = np.unique(dataset.status.values, return_counts=True)
    words = words_of(statuses, dataset.status.attrs).tolist()
    counts = {name or "not run": n for name, n in sorted(zip(words, numbers.tolist(), strict=True))}
    sizes = {str(name): size for name, size in dataset.sizes.items()}
    return {"sizes": sizes, "variables": [str(name) for name in dataset], "status": counts}


def parse_blocks(text: str) -> tuple[int, int]:
    """Parses `0:64`: number of the first block, and of the one behind the last."""
    first, colon, last = text.partition(":")
    if not (colon and first.isdecimal() and last.isdecimal() and int(first) < int(last)):
        raise ValueError(f"blocks must be FROM:TO, two integers with FROM < TO, got {text!r}")
    return int(first), int(last)


def parse_axis(text: str) -> tuple[str, list[float]]:
    """Parses an axis such as `nu0=-0.7:0.7:512` or `nu1=0.35`: its name and its values."""
    name, equals, words = text.partition("=")
    parts, count = words.split(":"), 0
    try:
        if equals and len(parts) == 1 and not math.isnan(float(words)):
            return name, [float(words)]
        finite = all(map(math.isfinite, map(float, parts)))
        if equals and finite and len(parts) == 3:
            count = int(parts[2])
    except ValueError:
        pass
    if count < 1:
        raise ValueError(f"an axis must be NAME=FROM:TO:COUNT or NAME=VALUE, got {text!r}")
    check_count(f"COUNT of axis {name}", count)
    from ..numerics.spacing import evenly_spaced

    return name, evenly_spaced(float(parts[0]), float(parts[1]), count).tolist()
