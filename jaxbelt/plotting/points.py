"""Single results in the phase plane: a cycle, a bifurcation point, equilibria."""

import numpy as np
from matplotlib.axes import Axes

from ..bifurcations.base import BifurcationPoint
from ..cycles.cycle import Cycle
from ..cycles.periodic import PeriodicMotion
from ..cycles.shocks import FatalShock
from ..inverse.design import Design
from ..model.equilibria import Equilibria
from ..results import Status
from ..tables import require_single
from .forced import check_found, plot_motion
from .phase import draw_equilibrium, draw_orbit, plot_phase_portrait, plot_portrait
from .style import BELT_COLOURS, label_plane, new_axes

#: Colour of the arrow of a shock: that of a fourth belt, which no class has.
SHOCK = BELT_COLOURS[3]


def plot_cycle(cycle: Cycle, ax: Axes | None = None) -> Axes:
    """Draws a cycle with the boundaries and equilibria of its oscillator."""
    require_single(cycle, cycle.period, 0)
    check_found(cycle, "cycle")
    return plot_phase_portrait(cycle.oscillator, cycles=[cycle], ax=ax)


def plot_design(design: Design, ax: Axes | None = None) -> Axes:
    """Draws the designed cycle, or forced motion."""
    if isinstance(design.cycle, PeriodicMotion):
        return plot_motion(design.cycle, ax)
    return plot_cycle(design.cycle, ax)


def plot_point(point: BifurcationPoint, ax: Axes | None = None) -> Axes:
    """Draws the phase plane at a bifurcation point, with the cycle where there is one."""
    require_single(point, point.value, 0)
    check_found(point, "point")
    if isinstance(point.cycle, PeriodicMotion):
        drawn = plot_motion(point.cycle, ax)
    else:
        cycles = [point.cycle] if int(point.cycle.status) == Status.OK else []
        drawn: Axes = plot_phase_portrait(point.oscillator, cycles=cycles, ax=ax)
        if (orbit := point.orbit) is not None and not cycles:
            draw_orbit(drawn, orbit, point.condition.line.name or point.kind)
    drawn.set_title(f"{point.condition.words} at {float(point.value):.6g}", fontsize="medium")
    return drawn


def plot_shock(shock: FatalShock, ax: Axes | None = None) -> Axes:
    """Draws the portrait, and the smallest fatal shock as an arrow, where there is one."""
    ax = plot_portrait(shock.portrait, ax)
    if np.isfinite(float(shock.distance)):
        start = np.asarray(shock.start)
        end = start + np.asarray(shock.shock)
        line = {"color": SHOCK, "linewidth": 1.6, "zorder": 6}
        ax.plot(*np.stack([start, end], axis=1), label="minimal fatal shock", **line)
        arrow = {"arrowstyle": "-|>", "color": SHOCK, "shrinkA": 0, "shrinkB": 0}
        ax.annotate("", tuple(end), tuple(start), arrowprops=arrow, zorder=6)
    return ax


def plot_equilibria(equilibria: Equilibria, ax: Axes | None = None) -> Axes:
    """Draws equilibria on the line x2 = 0, stable ones filled."""
    table = equilibria.table()
    rows = [equilibria] if equilibria.kind.ndim == 0 else list(equilibria)
    ax = new_axes() if ax is None else ax
    ax.axhline(0.0, color="0.7", linewidth=0.6, zorder=1)
    for row in rows:
        if int(row.kind):
            draw_equilibrium(ax, row)
    if len(table):
        left, right = float(table.x1_lower.min()), float(table.x1_upper.max())
        margin = 0.2 * (right - left) or 0.5
        ax.set(xlim=(left - margin, right + margin), ylim=(-1.0, 1.0))
    label_plane(ax)
    return ax
