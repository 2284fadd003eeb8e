"""The public names, and everything behind them.

`import jaxbelt` alone imports nothing: the package takes its names from here when the first one is
used, so that the command line answers at once what it can answer without computing.
"""

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from jaxtyping import ArrayLike

from . import presets
from .activity import show_progress
from .bifurcations.base import BifurcationPoint
from .bifurcations.connections import SaddleConnection
from .bifurcations.crossings import CrossingSliding, SlidingExchange
from .bifurcations.curves import BifurcationCurve, bifurcation_curve
from .bifurcations.diagrams import BifurcationDiagram, bifurcation_diagram
from .bifurcations.edge_rests import BoundaryEquilibrium, PseudoHopf
from .bifurcations.edges import CornerCollision, GrazingEdge
from .bifurcations.folds import FoldOfCycles
from .bifurcations.forced import AddingSliding, Fold, PeriodDoubling, SwitchingSliding, Torus
from .bifurcations.infinity import HopfAtInfinity
from .bifurcations.meetings import EdgeExchange, MeetingEdges
from .bifurcations.refine import refine
from .bifurcations.regions import RegionMap, region_map
from .bifurcations.rests import BeltAtRest, Hopf, SuddenSliding
from .bifurcations.scan import scan
from .bifurcations.special import SpecialPoint
from .bifurcations.symmetry import SymmetryBreaking
from .bifurcations.tangencies import GrazingSliding, NonsmoothFold
from .cycles.cycle import Cycle, find_cycle
from .cycles.exponents import Exponents, lyapunov
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
from .cycles.periodic import PeriodicMotion, periodic
from .cycles.portrait import Portrait, portrait
from .cycles.separatrices import Separatrix
from .cycles.shocks import FatalShock, minimal_fatal_shock
from .cycles.unstable import unstable_cycle
from .inverse.design import Design, design, distance_to
from .inverse.fit import Fit, fit
from .inverse.margins import distance_to_basin_boundary
from .model.equilibria import Equilibria, EquilibriumKind, equilibria, lyapunov_coefficient
from .model.forcing import AbstractForce, BaseMotion, Harmonic, Oscillating
from .model.friction import AbstractFriction, Conti, Coulomb, Cubic, Stribeck, Tabulated
from .model.machine import Machine, PhysicalBelt, Units
from .model.oscillator import Belt, Oscillator
from .motion.simulate import Arcs, Events, Trajectory, simulate
from .results import EventKind, Status, describe
from .si import in_si
from .sweeps.basins import Basins, BasinStability, basin_stability, basins
from .sweeps.circle_map import CircleMap, circle_map
from .sweeps.datasets import decoded
from .sweeps.fractions import BasinFractions, basin_fractions
from .sweeps.moments import AtEvents, AtExtrema, AtPhase, AtSection, AtTimes
from .sweeps.orbit_diagram import OrbitDiagram, orbit_diagram
from .sweeps.shares import attractors
from .sweeps.sweep import Explanation, explain, sweep
from .sweeps.verification import Verified, verify

if TYPE_CHECKING:
    from .plotting.explorer import explore
    from .plotting.histories import plot_time_history
    from .plotting.model import plot_friction_law
    from .plotting.phase import plot_phase_portrait, plot_vector_field
    from .plotting.si import plot_in_si
    from .plotting.sweeps import plot_basins, plot_sweep

__all__ = [
    "AbstractForce",
    "AbstractFriction",
    "AddingSliding",
    "Arcs",
    "AtEvents",
    "AtExtrema",
    "AtPhase",
    "AtSection",
    "AtTimes",
    "BaseMotion",
    "BasinFractions",
    "BasinStability",
    "Basins",
    "Belt",
    "BeltAtRest",
    "BifurcationCurve",
    "BifurcationDiagram",
    "BifurcationPoint",
    "BoundaryEquilibrium",
    "CircleMap",
    "Conti",
    "CornerCollision",
    "Coulomb",
    "CrossingSliding",
    "Cubic",
    "Cycle",
    "Design",
    "EdgeExchange",
    "Equilibria",
    "EquilibriumKind",
    "EventKind",
    "Events",
    "Explanation",
    "Exponents",
    "FatalShock",
    "Fit",
    "Fold",
    "FoldOfCycles",
    "GrazingEdge",
    "GrazingSliding",
    "Harmonic",
    "Hopf",
    "HopfAtInfinity",
    "Machine",
    "MeetingEdges",
    "NonsmoothFold",
    "OrbitDiagram",
    "Oscillating",
    "Oscillator",
    "PeriodDoubling",
    "PeriodicMotion",
    "PhysicalBelt",
    "Portrait",
    "PseudoHopf",
    "RegionMap",
    "SaddleConnection",
    "Separatrix",
    "SlidingExchange",
    "SpecialPoint",
    "Status",
    "Stribeck",
    "SuddenSliding",
    "SwitchingSliding",
    "SymmetryBreaking",
    "Tabulated",
    "Torus",
    "Trajectory",
    "Units",
    "Verified",
    "amplitude",
    "attractors",
    "basin_fractions",
    "basin_stability",
    "basins",
    "bifurcation_curve",
    "bifurcation_diagram",
    "circle_map",
    "decoded",
    "describe",
    "design",
    "distance_to",
    "distance_to_basin_boundary",
    "energy_dissipated",
    "energy_fed",
    "equilibria",
    "explain",
    "explore",
    "find_cycle",
    "fit",
    "gap",
    "in_si",
    "lyapunov",
    "lyapunov_coefficient",
    "minimal_fatal_shock",
    "orbit_diagram",
    "peak",
    "period",
    "periodic",
    "plot_basins",
    "plot_friction_law",
    "plot_in_si",
    "plot_phase_portrait",
    "plot_sweep",
    "plot_time_history",
    "plot_vector_field",
    "portrait",
    "presets",
    "refine",
    "region_map",
    "scan",
    "show_progress",
    "simulate",
    "slip_duration",
    "stick_duration",
    "stick_fraction",
    "sweep",
    "unstable_cycle",
    "verify",
]


class _Words:
    """An annotation as `help` shows it."""

    def __init__(self, text: str):
        self.text = text

    def __repr__(self) -> str:
        return self.text


def _let_help_be_read(function: Callable) -> None:
    """Makes `help` show ArrayLike by its name instead of the long union that it is."""
    signature = inspect.signature(function)
    arrays = inspect.formatannotation(ArrayLike).removeprefix("Union[").removesuffix("]")

    def in_words(annotation: Any) -> Any:
        text = inspect.formatannotation(annotation)
        short = text.replace(f"Union[{arrays}]", "ArrayLike").replace(arrays, "ArrayLike")
        return annotation if short == text else _Words(short)

    parameters = [
        one.replace(annotation=in_words(one.annotation)) for one in signature.parameters.values()
    ]
    function.__dict__["__signature__"] = signature.replace(parameters=parameters)


for _name in __all__:
    if inspect.isfunction(_one := globals().get(_name)):
        _let_help_be_read(_one)
