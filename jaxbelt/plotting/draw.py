"""The picture of each type of result: what `result.plot()` draws."""

from collections.abc import Callable
from typing import Any

from matplotlib.axes import Axes

from ..bifurcations.base import BifurcationPoint
from ..bifurcations.curves import BifurcationCurve
from ..bifurcations.diagrams import BifurcationDiagram
from ..bifurcations.regions import RegionMap
from ..bifurcations.special import SpecialPoint
from ..cycles.cycle import Cycle
from ..cycles.exponents import Exponents
from ..cycles.periodic import PeriodicMotion
from ..cycles.portrait import Portrait
from ..cycles.separatrices import Separatrix
from ..cycles.shocks import FatalShock
from ..inverse.design import Design
from ..inverse.fit import Fit
from ..model.equilibria import Equilibria
from ..motion.simulate import Arcs, Events, Trajectory
from ..sweeps.basins import Basins, BasinStability
from ..sweeps.circle_map import CircleMap
from ..sweeps.fractions import BasinFractions
from ..sweeps.orbit_diagram import OrbitDiagram
from ..sweeps.sweep import Explanation
from ..sweeps.verification import Verified
from .diagrams import plot_curves, plot_diagram, plot_special_point
from .forced import plot_circle_map, plot_exponents, plot_motion
from .histories import plot_arcs, plot_events, plot_trajectory
from .inverse import plot_fit
from .orbits import plot_orbits
from .phase import plot_portrait, plot_separatrix
from .points import plot_cycle, plot_design, plot_equilibria, plot_point, plot_shock
from .regions import plot_region_map
from .style import add_key, figure_of, require_axes
from .sweeps import plot_basins, plot_blocks, plot_explanation, plot_fractions, plot_stability

PICTURES: dict[type, Callable[..., Axes]] = {
    Arcs: plot_arcs,
    BasinFractions: plot_fractions,
    Basins: plot_basins,
    BasinStability: plot_stability,
    BifurcationCurve: lambda curve, ax=None: plot_curves([curve], ax),
    BifurcationDiagram: plot_diagram,
    BifurcationPoint: plot_point,
    CircleMap: plot_circle_map,
    Cycle: plot_cycle,
    Design: plot_design,
    Equilibria: plot_equilibria,
    Events: plot_events,
    Explanation: plot_explanation,
    Exponents: plot_exponents,
    FatalShock: plot_shock,
    Fit: plot_fit,
    OrbitDiagram: plot_orbits,
    PeriodicMotion: plot_motion,
    Portrait: plot_portrait,
    RegionMap: plot_region_map,
    Separatrix: plot_separatrix,
    SpecialPoint: plot_special_point,
    Trajectory: plot_trajectory,
    Verified: plot_blocks,
}


def draw_result(result: Any, ax: Axes | None, **options: Any) -> Axes:
    """Draws a result, with a key below the axes.

    Args:
        result: Any result with a `plot` method.
        ax: Axes; None makes new ones.
        options: Options of the `plot` method of the result.

    Returns:
        The axes.
    """
    picture = PICTURES.get(type(result))
    if picture is None:
        raise TypeError(f"result must be one that has a picture, got {type(result).__name__}")
    require_axes(ax)
    drawn = picture(result, ax, **options)
    # A new figure with several axes already has its key.
    if ax is not None or not figure_of(drawn).legends:
        add_key(drawn)
    return drawn
