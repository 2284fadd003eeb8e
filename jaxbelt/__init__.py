"""Belt-driven dry-friction oscillators: exact, batched, differentiable simulation in JAX.

Everything a user needs is `import jaxbelt as jb`. Turn 64-bit floats on first:
`jax.config.update("jax_enable_x64", True)`.

Inside, data goes one way: parameters, modes, motion, cycles, bifurcations, pictures. The code is a
ladder that shows it. Read from top to bottom, a module imports only what stands before it:

    results         status codes and what to do about them
    numerics/       compiling
    checks          arguments, checked at the public edge
    numerics/       derivatives extrapolation newton continuation roots
    model/          friction oscillator machine parameters variations modes events equilibria
    presets         the published systems
    kernel/         lanes step events rounds
    motion/         integrators arcs sensitivities sampling batches runs smoothing simulate
    cycles/         settling shooting orbits cycle attractors functionals
    cycles/         backwards returns separatrices portrait
    sweeps/         marks observers moments along attractor queue threads audit
    sweeps/         grid datasets question locks store progress work clusters sweep shares basins
    bifurcations/   labels systems guesses conditions tangencies crossings rests edges folds
    bifurcations/   path scan refine curves diagrams switch_folds
    inverse/        selection record fit design
    si              results in SI units
    plotting/       style phase diagrams sweeps model draw si explorer
    paper           the paper's table and figures
    __init__        the public names
    commands/       options reproduce simulate diagram map sweep basins verify
    cli             the command line
"""

import importlib.metadata
from typing import TYPE_CHECKING, Any

from . import presets
from .bifurcations.conditions import BifurcationPoint, SpecialPoint
from .bifurcations.crossings import CrossingSliding, SlidingExchange
from .bifurcations.curves import BifurcationCurve, bifurcation_curve
from .bifurcations.diagrams import (
    BifurcationDiagram,
    RegionMap,
    bifurcation_diagram,
    region_map,
)
from .bifurcations.edges import CornerCollision, GrazingEdge
from .bifurcations.folds import FoldOfCycles
from .bifurcations.refine import refine
from .bifurcations.rests import BeltAtRest, BoundaryEquilibrium, Hopf, PseudoHopf, SuddenSliding
from .bifurcations.scan import scan
from .bifurcations.tangencies import GrazingSliding, NonsmoothFold
from .cycles.cycle import Cycle, find_cycle, unstable_cycle
from .cycles.functionals import (
    amplitude,
    energy_dissipated,
    energy_fed,
    gap,
    peak,
    period,
    slip_duration,
    stick_duration,
    stick_fraction,
)
from .cycles.portrait import Portrait, portrait
from .cycles.separatrices import Separatrix
from .inverse.design import Design, design, distance_to
from .inverse.fit import Fit, fit
from .model.equilibria import Equilibria, EquilibriumKind, equilibria, lyapunov_coefficient
from .model.friction import AbstractFriction, Conti, Coulomb, Stribeck
from .model.machine import Machine, PhysicalBelt, Units
from .model.oscillator import Belt, Oscillator
from .motion.simulate import Arcs, Events, Trajectory, simulate
from .results import EventKind, Status, describe, draw_with
from .si import in_si
from .sweeps.basins import Basins, BasinStability, basin_stability, basins
from .sweeps.datasets import decoded
from .sweeps.moments import AtEvents, AtExtrema, AtSection, AtTimes
from .sweeps.shares import attractors
from .sweeps.store import Verified, verify
from .sweeps.sweep import Explanation, explain, sweep

if TYPE_CHECKING:
    from .plotting.explorer import explore
    from .plotting.model import plot_friction_law
    from .plotting.phase import plot_phase_portrait, plot_time_history, plot_vector_field
    from .plotting.si import plot_in_si
    from .plotting.sweeps import plot_basins

__version__ = importlib.metadata.version("jaxbelt")

__all__ = [
    "AbstractFriction",
    "Arcs",
    "AtEvents",
    "AtExtrema",
    "AtSection",
    "AtTimes",
    "BasinStability",
    "Basins",
    "Belt",
    "BeltAtRest",
    "BifurcationCurve",
    "BifurcationDiagram",
    "BifurcationPoint",
    "BoundaryEquilibrium",
    "Conti",
    "CornerCollision",
    "Coulomb",
    "CrossingSliding",
    "Cycle",
    "Design",
    "Equilibria",
    "EquilibriumKind",
    "EventKind",
    "Events",
    "Explanation",
    "Fit",
    "FoldOfCycles",
    "GrazingEdge",
    "GrazingSliding",
    "Hopf",
    "Machine",
    "NonsmoothFold",
    "Oscillator",
    "PhysicalBelt",
    "Portrait",
    "PseudoHopf",
    "RegionMap",
    "Separatrix",
    "SlidingExchange",
    "SpecialPoint",
    "Status",
    "Stribeck",
    "SuddenSliding",
    "Trajectory",
    "Units",
    "Verified",
    "amplitude",
    "attractors",
    "basin_stability",
    "basins",
    "bifurcation_curve",
    "bifurcation_diagram",
    "decoded",
    "describe",
    "design",
    "distance_to",
    "energy_dissipated",
    "energy_fed",
    "equilibria",
    "explain",
    "explore",
    "find_cycle",
    "fit",
    "gap",
    "in_si",
    "lyapunov_coefficient",
    "peak",
    "period",
    "plot_basins",
    "plot_friction_law",
    "plot_in_si",
    "plot_phase_portrait",
    "plot_time_history",
    "plot_vector_field",
    "portrait",
    "presets",
    "refine",
    "region_map",
    "scan",
    "simulate",
    "slip_duration",
    "stick_duration",
    "stick_fraction",
    "sweep",
    "unstable_cycle",
    "verify",
]


# Matplotlib is imported when something is drawn, not before.


def _with_matplotlib(result: Any, ax: Any, **options: Any) -> Any:
    from .plotting.draw import draw_result

    return draw_result(result, ax, **options)


draw_with(_with_matplotlib)


def __getattr__(name: str) -> Any:
    if name in _drawing():
        from .plotting import explorer, model, phase, si, sweeps

        modules = (explorer, model, phase, si, sweeps)
        return next(getattr(m, name) for m in modules if hasattr(m, name))
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *_drawing()]


def _drawing() -> list[str]:
    return [name for name in __all__ if name.startswith("plot_") or name == "explore"]
