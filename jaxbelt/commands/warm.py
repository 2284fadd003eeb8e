"""`jaxbelt warm`: compiles the programs of functions and commands, once for each machine."""

import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

import typer

import jaxbelt as jb

from .cache import what_is_kept
from .options import Json, make_console, plain_errors, say, steps_bar, turn_on_float64

#: Start of the runs of the commands and of the paper.
START = (3.0, 0.0)
#: The paper's span, and few points for other axes: programs do not depend on their number.
SPAN = (-0.7, 0.7)
FEW, GRID = 3, [-3.0, 0.0, 3.0]


def warm(
    threads: Annotated[
        int | None,
        typer.Option(min=1, help="Programs compiled side by side; default: a core each."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compile what the functions and commands need, and keep it on disk.

    Once for each machine and version of jaxbelt; afterwards the first call of each function loads
    its programs in place of compiling them. For one belt and two, with contact edges and without,
    and the laws Conti, Stribeck and Coulomb; every table of a Tabulated law is a program of its
    own. Takes some ten minutes on two cores. What was compiled before an interrupt is kept.

    Example: **jaxbelt warm**
    """
    with plain_errors():
        turn_on_float64()
        from ..numerics import programs

        if programs.folder() is None:
            raise ValueError(
                "compiled programs must be kept on disk for this, but JAXBELT_CACHE=0 is set or "
                "the folder cannot be used: see `jaxbelt cache`"
            )
    todo = jobs()
    jb.show_progress(False)
    with (
        plain_errors(),
        steps_bar(make_console(), 40, as_json) as progress,
        ThreadPoolExecutor(threads or os.cpu_count()) as pool,
    ):
        task = progress.add_task("", total=len(todo))

        def do(name: str, job: Callable[[], Any]) -> None:
            progress.update(task, description=name)
            job()
            progress.update(task, advance=1)

        futures = [pool.submit(do, *one) for one in todo]
        try:
            for future in futures:
                future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    words, data = what_is_kept()
    say([words], as_json=as_json, data=data)


def jobs() -> list[tuple[str, Callable[[], Any]]]:
    """The calls whose programs are compiled, by name; the most frequent ones first."""
    import equinox as eqx
    import numpy as np

    def where(osc):
        return osc.belts[0].velocity

    def swept(osc):
        def make(nu0):
            return eqx.tree_at(where, osc, nu0)

        axes = {"nu0": np.linspace(0.1, 0.6, FEW)}
        for observe in ("attractor", "final"):
            jb.sweep(make, axes, y0=START, t1=100.0, observe=observe, progress=False)

    motions: dict[str, Callable[[Any], Any]] = {
        "simulate": lambda osc: jb.simulate(osc, START, 100.0),
        "find_cycle": lambda osc: jb.find_cycle(osc, START),
        "sweep": swept,
        "basins": lambda osc: jb.basins(osc, x1=GRID, x2=GRID, progress=False),
        "portrait": jb.portrait,
    }
    # Paths need many programs, so they are compiled for the paper's law only.
    paths: dict[str, Callable[[Any], Any]] = {
        "scan": lambda osc: jb.scan(osc, where, SPAN),
        "bifurcation_diagram": lambda osc: jb.bifurcation_diagram(osc, where, SPAN),
    }
    found = []
    for name, law in _laws().items():
        for shape, osc in _of_shapes(law).items():
            for function, call in (motions | paths if name == "Conti" else motions).items():
                words = f"{function}, {shape}, {name}"
                found.append((words, lambda call=call, osc=osc: call(osc)))

    def planes():
        nus = np.linspace(*SPAN, 8)
        return jb.region_map(jb.presets.class_b, {"nu0": nus, "nu1": nus})

    def paper():
        from ..paper import reproduce

        with tempfile.TemporaryDirectory() as folder:
            return reproduce(Path(folder), lambda _: None)

    return [*found, ("region_map", planes), ("reproduce", paper)]


def _laws() -> dict[str, Any]:
    return {
        "Conti": jb.Conti(static=1.0, residual=0.6, steepness=10.0),
        "Stribeck": jb.Stribeck(static=1.0, kinetic=0.6, velocity=0.1),
        "Coulomb": jb.Coulomb(static=1.0, kinetic=0.6),
    }


def _of_shapes(law: Any) -> "dict[str, jb.Oscillator]":
    def made(*belts):
        return jb.Oscillator(damping=0.5, belts=belts)

    return {
        "one belt": made(jb.Belt(0.2, law)),
        "two belts": made(jb.Belt(0.45, law), jb.Belt(0.35, law)),
        "two belts with edges": made(jb.Belt(0.2, law, upper=1.0), jb.Belt(0.4, law, lower=0.5)),
    }
