"""Which picture belongs to which result: what `result.plot()` draws."""

from typing import Any

from matplotlib.axes import Axes

from ..bifurcations.curves import BifurcationCurve
from ..bifurcations.diagrams import BifurcationDiagram
from ..bifurcations.regions import RegionMap
from ..cycles.portrait import Portrait
from .diagrams import plot_curves, plot_diagram, plot_region_map
from .phase import plot_portrait


def draw_result(result: Any, ax: Axes | None, **options: Any) -> Axes:
    """Draw a result into the axes (None: new ones), which are returned; options: of its `plot`."""
    match result:
        case BifurcationCurve():
            return plot_curves([result], ax, **options)
        case BifurcationDiagram():
            return plot_diagram(result, ax, **options)
        case RegionMap():
            return plot_region_map(result, ax, **options)
        case Portrait():
            return plot_portrait(result, ax, **options)
    raise TypeError(f"result must be one that has a picture, got {type(result).__name__}")
