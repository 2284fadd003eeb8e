"""Belt-driven dry-friction oscillators: exact, batched, differentiable simulation in JAX.

Everything a user needs is `import jaxbelt as jb`. Turn 64-bit floats on first:
`jax.config.update("jax_enable_x64", True)`.

Inside, data goes one way: parameters, modes, motion, cycles, bifurcations, pictures. The code is a
ladder that shows it. Read from top to bottom, a module imports only what stands before it:

    spelling        suggestions for unknown words
    results         status codes and advice
    activity        progress of functions that take long
    identity        fingerprints of values and functions
    interrupts      interrupts that are not lost
    numerics/       spacing widths programs usercode compiling
    checks          arguments, checked at the public edge
    dimensions      dimensions of fields and results
    tables          results as tables
    numerics/       padding derivatives implicit extrapolation newton continuation
    numerics/       roots polynomials control_points
    model/          friction forcing oscillator own_units machine parameters families
    model/          variations modes pseudofocus transitions instants rest events equilibria
    model/          far_out
    presets         the published systems
    kernel/         lanes marks step events rounds waves holds clocked timed_events
    motion/         integrators arcs flights sensitivities sampling loops batches timed runs
    motion/         smoothing simulate
    cycles/         chains settling shooting motions closure clocked followed periodic reached
    cycles/         exponents
    cycles/         orbits cycle attractors functionals backwards returns separatrices portrait
    cycles/         unstable outlines nearest sides shocks
    sweeps/         observers moments along reducers attractor growth winding strobes queue
    sweeps/         threads runs_in_memory audit grid datasets question locks store progress work
    sweeps/         clusters sweep verification shares
    sweeps/         naming forced_basins basins fractions orbit_diagram circle_map
    bifurcations/   special labels beside systems timed_systems guesses base conditions arc_rows
    bifurcations/   forced symmetry forced_edges tangencies crossings rests edge_rests edges folds
    bifurcations/   meetings connections infinity path scan refine tracks forced_ends changes curves
    bifurcations/   cells faces bounds regions legs branches pieces diagrams
    inverse/        selection record search windows witnesses fit margins design
    si              results in SI units
    plotting/       style histories phase forced points diagrams regions categories sweeps orbits
    plotting/       inverse model draw si explorer
    paper           the paper's table and figures
    api             the public names
    __init__        the public names, imported when the first one is used
    commands/       belts files options description tables reproduce simulate diagram orbits
    commands/       map sweep basins verify cache warm
    cli             the command line
    __main__        the command line by `python -m jaxbelt`
"""

import os
import sys
from typing import TYPE_CHECKING, Any

from .results import draw_with

if TYPE_CHECKING:
    from .api import *  # noqa: F403


def __getattr__(name: str) -> Any:
    if name == "__version__":
        import importlib.metadata

        return importlib.metadata.version("jaxbelt")
    # Submodules are not public names; while `api` is imported, Python asks for it here.
    if name == "api" or (name.startswith("__") and name != "__all__"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import api

    if name in api.__all__ and (name.startswith("plot_") or name == "explore"):
        # Matplotlib is imported when something is drawn, not before.
        from .activity import Activity

        with Activity("matplotlib") as activity:
            activity.say("imported")
            from .plotting import explorer, histories, model, phase, si, sweeps

        modules = explorer, histories, model, phase, si, sweeps
        globals()[name] = value = next(getattr(m, name) for m in modules if hasattr(m, name))
        return value
    if name == "__all__" or name in api.__all__:
        globals()[name] = value = getattr(api, name)
        return value
    from .spelling import did_you_mean

    meant = did_you_mean(name, api.__all__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{meant}")


def __dir__() -> list[str]:
    from . import api

    # Names for completion: the public ones, without what this file imports.
    return [*api.__all__, *(name for name in globals() if name.startswith("__"))]


def _with_matplotlib(result: Any, ax: Any, **options: Any) -> Any:
    from .activity import Activity

    with Activity("plot"):  # the first time, Matplotlib is imported
        from .plotting.draw import draw_result

        return draw_result(result, ax, **options)


draw_with(_with_matplotlib)


def _before_fork() -> None:
    """Records for the child that JAX was in use, even if nothing of jaxbelt was until then."""
    if "jax" in sys.modules:
        from .numerics import compiling as compiling


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork)
