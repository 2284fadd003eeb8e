"""Pictures: time histories, phase portraits, vector fields, and the model itself.

Every function draws one kind of result into the matplotlib axes that it is given (`ax=None` makes
new ones) and returns the axes. What is drawn is shown in the manner of the paper:

- a discontinuity boundary Sigma_Fi, x2 = nu_i/omega, as a line over the contact interval of its
  belt, in the colour of the belt; the part where the mass sticks (the sliding set) is a wide pale
  band behind it. Finite contact edges sigma are dotted vertical lines.
- stable cycles as thick solid, unstable ones as dashed lines, other orbits thin and grey;
- stable fixed points filled, unstable ones open, pseudo-foci as diamonds in the same way, a segment
  of pseudo-equilibria as a thick bar.

The colours are those of Okabe and Ito, which colour-blind readers can tell apart. This is the only
module that imports matplotlib, and `import jaxbelt` does not import this module.
"""

import itertools
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import matplotlib
import matplotlib.colors
import numpy as np
import xarray as xr
from jaxtyping import Array
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Polygon, Rectangle
from matplotlib.patheffects import withStroke
from scipy import ndimage

from ..bifurcations.curves import BifurcationCurve
from ..bifurcations.diagrams import BifurcationDiagram, Branch, RegionMap, interior
from ..checks import require
from ..cycles.cycle import Cycle
from ..model.equilibria import Equilibria, EquilibriumKind
from ..model.equilibria import equilibria as find_equilibria
from ..model.friction import AbstractFriction
from ..model.modes import mode_acceleration, mode_of_state
from ..model.oscillator import Oscillator
from ..motion.simulate import Trajectory
from ..numerics.compiling import jit
from ..sweeps.basins import Basins
from ..sweeps.datasets import decoded

#: One colour a belt: blue, vermillion, bluish green, reddish purple, orange (Okabe and Ito).
BELT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
#: Attractors of a sweep, those with the shortest names first (Okabe and Ito).
ATTRACTOR_COLOURS = ("#F0F0F0", "#56B4E9", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#999999")
#: A second mark of the belts, for print without colour.
BELT_HATCHES = ("", "////", "....", "xxxx", "\\\\\\\\")
ORBIT_COLOUR = "0.55"
#: What a phase portrait may hold, in the order of its key.
KEY_ORDER = (
    "orbit",
    "stable cycle",
    "unstable cycle",
    "sliding set",
    "stable fixed point",
    "unstable fixed point",
    "stable pseudo-focus",
    "unstable pseudo-focus",
    "pseudo-equilibria",
)

#: Settings for a journal's page, see `journal_style`.
JOURNAL: dict[Any, Any] = {
    "font.family": "STIXGeneral",
    "mathtext.fontset": "stix",
    "font.size": 9,
    "axes.labelsize": 9,
    "axes.titlesize": 9,
    "axes.linewidth": 0.6,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "hatch.linewidth": 0.4,
}


@runtime_checkable
class ClosedOrbit(Protocol):
    """What `plot_phase_portrait` wants of a cycle: its stability, and states all around it."""

    @property
    def stable(self) -> Any: ...

    def sample(self, n: int, /) -> Any:
        """About n states (x1, x2) once around, [samples, 2]."""
        ...


# --- time histories -----------------------------------------------------------------------------


def plot_time_history(trajectory: Trajectory, ax: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Displacement x1 and velocity x2 over time, stick phases shaded in the colour of their belt.

    trajectory: from `simulate`. ax: two axes, for x1 and for x2. Returns the two.
    """
    if ax is None:
        ax = tuple(_new_figure().subplots(2, sharex=True))
    t, ys = _path(trajectory)
    upper, lower = ax
    for axes, component, name in ((upper, 0, "displacement $x_1$"), (lower, 1, "velocity $x_2$")):
        axes.plot(t, ys[:, component], color="black", linewidth=0.9)
        axes.set_ylabel(name)
        axes.margins(x=0)
    for belt, begin, end in stick_phases(trajectory):
        for axes in ax:
            axes.axvspan(
                begin, end, label=f"sticks to belt {belt}", zorder=0, **_belt_shading(belt)
            )
    upper.tick_params(labelbottom=False)
    lower.set_xlabel(r"time $\tau$")
    _figure_of(lower).align_ylabels(ax)
    handles, labels = upper.get_legend_handles_labels()
    by_label = dict(sorted(zip(labels, handles, strict=True), key=lambda item: item[0]))
    if by_label:
        upper.legend(
            by_label.values(),
            by_label.keys(),
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=len(by_label),
            frameon=False,
            borderaxespad=0.2,
        )
    return ax


def stick_phases(trajectory: Trajectory) -> list[tuple[int, float, float]]:
    """The stick phases of a trajectory as (belt, begin, end), in order of their beginnings."""
    # Approximate formulations have no arcs; their samples have to do.
    if trajectory.arcs.t.size:
        begins = np.asarray(trajectory.arcs.t)
        ends = begins + np.asarray(trajectory.arcs.duration)
        modes = np.asarray(trajectory.arcs.mode)
    else:
        begins, ends = np.asarray(trajectory.ts)[:-1], np.asarray(trajectory.ts)[1:]
        modes = np.asarray(trajectory.modes)[:-1]
    stuck = (modes == 0) & np.isfinite(begins)[:, None]
    phases: list[tuple[int, float, float]] = []
    for belt in range(stuck.shape[1]):
        # A phase is several arcs where another belt comes or goes meanwhile.
        switches = np.flatnonzero(np.diff(stuck[:, belt], prepend=False, append=False))
        for first, after in switches.reshape(-1, 2):
            phases.append((belt, float(begins[first]), float(ends[after - 1])))
    return sorted(phases, key=lambda phase: phase[1])


def _belt_shading(belt: int) -> dict[str, Any]:
    colour = matplotlib.colors.to_rgba(_belt_colour(belt))
    pale = tuple(1 - 0.28 * (1 - channel) for channel in colour[:3])
    hatch = BELT_HATCHES[belt % len(BELT_HATCHES)]
    return {"facecolor": pale, "edgecolor": (*colour[:3], 0.45), "linewidth": 0.0, "hatch": hatch}


def _belt_colour(belt: int) -> str:
    return BELT_COLOURS[belt % len(BELT_COLOURS)]


def _path(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Times and states of a trajectory, its events among the samples so that corners are sharp."""
    t = np.concatenate([trajectory.ts, trajectory.events.t])
    ys = np.concatenate([trajectory.ys, trajectory.events.y])
    known = np.isfinite(t) & np.all(np.isfinite(ys), axis=1)
    order = np.argsort(t[known], kind="stable")
    return t[known][order], ys[known][order]


# --- phase portraits ----------------------------------------------------------------------------


def plot_phase_portrait(
    osc: Oscillator,
    trajectories: Trajectory | Sequence[Trajectory] = (),
    *,
    cycles: Sequence[ClosedOrbit] = (),
    equilibria: Equilibria | None = None,
    xlim: tuple[float, float] | None = None,
    ylim: tuple[float, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Orbits in the plane of displacement x1 and velocity x2, with the boundaries of `osc`.

    trajectories: one or several from `simulate`, thin. cycles: see `ClosedOrbit`; stable ones are
    thick and solid, unstable ones dashed. equilibria: None takes those of `osc`. xlim, ylim: the
    window; None fits what is drawn. Returns the axes.
    """
    if isinstance(trajectories, Trajectory):
        trajectories = (trajectories,)
    ax = _new_axes() if ax is None else ax
    paths = [_path(trajectory)[1] for trajectory in trajectories]
    loops = [np.asarray(cycle.sample(400)) for cycle in cycles]
    equilibria = find_equilibria(osc) if equilibria is None else equilibria
    window = _window(osc, [*paths, *loops], equilibria, xlim, ylim)
    ax.set(xlim=window[0], ylim=window[1])
    plot_boundaries(osc, ax)
    for path in paths:
        ax.plot(*path.T, color=ORBIT_COLOUR, linewidth=0.7, zorder=2, label="orbit")
        _draw_arrowheads(ax, path, ORBIT_COLOUR, [_index_at_distance(ax, path, 0.22)])
    for cycle, loop in zip(cycles, loops, strict=True):
        if cycle.stable:
            style = {"linewidth": 1.7, "label": "stable cycle"}
        else:
            style = {"linewidth": 1.0, "linestyle": (0, (4, 2.2)), "label": "unstable cycle"}
        ax.plot(*loop.T, color="black", solid_joinstyle="round", zorder=4, **style)
        _draw_arrowheads(ax, loop, "black", [int(np.argmin(loop[:, 1]))])
    for equilibrium in equilibria:
        _draw_equilibrium(ax, equilibrium)
    ax.set_xlabel("displacement $x_1$")
    ax.set_ylabel("velocity $x_2$")
    return ax


def plot_boundaries(osc: Oscillator, ax: Axes) -> Axes:
    """The discontinuity boundaries and contact edges of `osc`, in the present window of the axes.

    Sigma_Fi, x2 = nu_i/omega, eqs. (8) and (17) of the paper, over the contact interval of belt i,
    its sliding set as a pale band. A boundary that reaches the right-hand side of the axes has its
    name outside of them, another one has it at its left end.
    """
    left, right = ax.get_xlim()
    outside: list[tuple[float, int]] = []
    levels: list[float] = []
    for i, belt in enumerate(osc.belts):
        level = float(belt.velocity / osc.omega)
        ends = np.clip([float(belt.lower), float(belt.upper)], left, right)
        bottom, top = ax.get_ylim()
        if ends[0] == ends[1] or not bottom < level < top:
            continue
        colour = _belt_colour(i)
        # Where two boundaries are one, both colours show.
        dashes = (0, (5, 5)) if level in levels else "-"
        ax.plot(ends, [level, level], color=colour, linewidth=0.9, linestyle=dashes, zorder=1.5)
        levels.append(level)
        x1 = np.linspace(ends[0], ends[1], 1201)
        sticks = _sliding_set(osc, jnp.asarray(x1), jnp.full(x1.size, belt.velocity / osc.omega), i)
        band = np.where(sticks, level, np.nan)
        style = {"linewidth": 4.5, "alpha": 0.25, "solid_capstyle": "butt"}
        ax.plot(x1, band, color=colour, zorder=1.2, label="sliding set", **style)
        if ends[1] == right:
            outside.append((level, i))
        else:
            _name_boundary(ax, i, (ends[0], level), (3, 2.5), "left", "bottom")
    _name_boundaries_outside(ax, outside)
    for edge in {float(e) for b in osc.belts for e in (b.lower, b.upper)}:
        if left < edge < right:
            ax.axvline(edge, color="0.25", linewidth=0.8, linestyle=":", zorder=1.4)
            ax.annotate(
                _edge_name(osc, edge),
                (edge, 0.0),
                xycoords=ax.get_xaxis_transform(),
                xytext=(3, 4),
                textcoords="offset points",
                path_effects=[withStroke(linewidth=2.5, foreground="white")],
                zorder=6,
            )
    return ax


@jit
def _sliding_set(osc, x1, x2, belt):
    return jnp.stack(mode_of_state(osc, x1, x2).stuck)[belt]


def _edge_name(osc: Oscillator, edge: float) -> str:
    """sigma where all intervals end at one edge, else the paper's sigma0, sigma1 in order."""
    edges = sorted(
        {float(e) for b in osc.belts for e in (b.lower, b.upper) if np.isfinite(float(e))}
    )
    return r"$\sigma$" if len(edges) == 1 else rf"$\sigma_{{{edges.index(edge)}}}$"


def _name_boundary(ax: Axes, belt: int, xy, offset, ha: str, va: str, xycoords: Any = "data"):
    ax.annotate(
        rf"$\Sigma_{{\mathrm{{F}}{belt}}}$",
        xy,
        xycoords=xycoords,
        xytext=offset,
        textcoords="offset points",
        ha=ha,
        va=va,
        color=_belt_colour(belt),
        path_effects=[withStroke(linewidth=2, foreground="white")],
        annotation_clip=False,
        zorder=6,
    )


def _name_boundaries_outside(ax: Axes, names: list[tuple[float, int]]) -> None:
    """Names beside the right-hand side of the axes, at least a line of text apart."""
    bottom, top = ax.get_ylim()
    height = ax.get_window_extent().height * 72 / _figure_of(ax).dpi
    line = 1.25 * matplotlib.rcParams["font.size"]
    names = sorted(names)
    at = np.array([(level - bottom) / (top - bottom) * height for level, _ in names])
    for (level, belt), shift in zip(names, _spread(at, line) - at, strict=True):
        _name_boundary(
            ax, belt, (1.0, level), (3, shift), "left", "center", ax.get_yaxis_transform()
        )


def _window(osc, paths, equilibria, xlim, ylim):
    """The given limits, or those that hold all that is drawn with a margin."""
    ends = [] if equilibria is None else [*equilibria.x1_lower, *equilibria.x1_upper]
    x1 = [float(x) for x in ends]
    x1 += [x for path in paths for x in (path[:, 0].min(), path[:, 0].max())]
    if not paths:
        # Nothing but the oscillator: every fixed point lies within the reach of friction.
        reach = 1 + sum(float(b.load) * float(b.friction.static) for b in osc.belts)
        x1 += [-reach, reach]
    x1 += [float(e) for b in osc.belts for e in (b.lower, b.upper) if np.isfinite(float(e))]
    x2 = [0.0, *(float(b.velocity) / float(osc.omega) for b in osc.belts)]
    x2 += [x for path in paths for x in (path[:, 1].min(), path[:, 1].max())]
    if not paths:
        x2 += [-1.0, 1.0]
    return (xlim or _with_margin(x1)), (ylim or _with_margin(x2))


def _with_margin(values: Sequence[float]) -> tuple[float, float]:
    margin = 0.08 * (max(values) - min(values)) or 0.5
    return min(values) - margin, max(values) + margin


def _draw_equilibrium(ax: Axes, row: Equilibria) -> None:
    face = "black" if row.stable else "white"
    ends = [float(row.x1_lower), float(row.x1_upper)]
    if row.kind == EquilibriumKind.SEGMENT:
        bar = {"solid_capstyle": "butt", "zorder": 5}
        ax.plot(ends, [0, 0], color="black", linewidth=3.5, label="pseudo-equilibria", **bar)
        ax.plot(ends, [0, 0], color=face, linewidth=1.9, **bar)
        return
    is_focus = row.kind == EquilibriumKind.PSEUDO_FOCUS
    stability = "stable" if row.stable else "unstable"
    ax.plot(
        ends[:1],
        [0.0],
        label=f"{stability} {'pseudo-focus' if is_focus else 'fixed point'}",
        linestyle="none",
        marker="D" if is_focus else "o",
        markersize=5,
        markerfacecolor=face,
        markeredgecolor="black",
        markeredgewidth=1.0,
        zorder=6,
    )


def _index_at_distance(ax: Axes, path: np.ndarray, distance: float) -> int:
    """Where a path has gone so far, as a fraction of the axes, or half its length if shorter."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    steps = np.diff(path, axis=0) / [right - left, top - bottom]
    gone = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
    return int(np.searchsorted(gone, min(distance, gone[-1] / 2)))


def _draw_arrowheads(ax: Axes, path: np.ndarray, colour: str, indices: Sequence[int]) -> None:
    for i in indices:
        before, after = path[max(i - 1, 0)], path[min(i + 1, len(path) - 1)]
        if np.all(before == after):
            continue
        ax.annotate(
            "",
            xy=tuple(after),
            xytext=tuple(before),
            arrowprops={
                "arrowstyle": "-|>,head_length=0.55,head_width=0.22",
                "color": colour,
                "linewidth": 0.5,
                "shrinkA": 0,
                "shrinkB": 0,
                "mutation_scale": 7.5,
            },
            zorder=4,
        )


# --- vector field -------------------------------------------------------------------------------


def plot_vector_field(
    osc: Oscillator,
    *,
    kind: str = "streamlines",
    xlim: tuple[float, float] | None = None,
    ylim: tuple[float, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """The vector field of `osc`, eqs. (2) and (11) of the paper, with its boundaries.

    kind: "streamlines", or "arrows" of one length that show the direction. The field jumps at the
    boundaries. On a sliding set it points along the boundary. xlim, ylim: the window; None takes
    one that holds all fixed points. Returns the axes.
    """
    if kind not in ("streamlines", "arrows"):
        raise ValueError(f'kind must be "streamlines" or "arrows", got {kind!r}')
    ax = _new_axes() if ax is None else ax
    (left, right), (bottom, top) = _window(osc, [], None, xlim, ylim)
    ax.set(xlim=(left, right), ylim=(bottom, top))
    columns, rows = (201, 201) if kind == "streamlines" else (21, 17)
    x1, x2 = np.meshgrid(np.linspace(left, right, columns), np.linspace(bottom, top, rows))
    v1, v2 = _field(osc, jnp.asarray(x1), jnp.asarray(x2))
    if kind == "streamlines":
        ax.streamplot(
            x1, x2, np.asarray(v1), np.asarray(v2),
            color="0.65", linewidth=0.6, arrowsize=0.6, density=0.9, zorder=1,
        )  # fmt: skip
    else:
        # One length on paper: scaled by the window, then normed.
        v1, v2 = v1 / (right - left), v2 / (top - bottom)
        size = np.hypot(v1, v2)
        ax.quiver(
            x1, x2, v1 / size, v2 / size,
            color="0.6", pivot="mid", scale=28, width=0.003, headwidth=4, zorder=1,
        )  # fmt: skip
    plot_boundaries(osc, ax)
    ax.set_xlabel("displacement $x_1$")
    ax.set_ylabel("velocity $x_2$")
    return ax


@jit
def _field(osc, x1, x2):
    mode = mode_of_state(osc, x1, x2)
    return x2, jnp.where(mode.any_stuck, 0.0, mode_acceleration(osc, mode, x1, x2))


# --- bifurcation diagrams -----------------------------------------------------------------------

UNSTABLE_COLOUR = "0.6"
#: Parameters by the end of their path in the oscillator; % is the number of the belt.
SYMBOLS = {
    "damping": r"\zeta",
    "omega": r"\omega",
    "velocity": r"\nu_%",
    "load": r"u_{0,%}",
    "lower": r"\mathrm{lower\ edge}_%",
    "upper": r"\mathrm{upper\ edge}_%",
    "static": r"\mu_{s,%}",
    "residual": r"p_{1,%}",
    "quadratic": r"p_{2,%}",
    "steepness": r"p_{3,%}",
}
WORDS = {"damping": "damping", "velocity": "belt velocity", "load": "load"}
#: What is said of a special point above it.
POINT_NAMES = {
    "Hopf": "Hopf",
    "NonsmoothFold": "fold, belt {belt}",
    "GrazingSliding": "grazing, belt {belt}",
    "CrossingSliding": "crossing-sliding, belt {belt}",
    "SlidingExchange": "sliding exchange",
    "SuddenSliding": "belt {belt} at rest",
    "BeltAtRest": "belt {belt} at rest",
    "FoldOfCycles": "fold of cycles",
    "GrazingEdge": "edge grazing, belt {belt}",
    "CornerCollision": "corner, belt {belt}",
    "BoundaryEquilibrium": "rest on edge, belt {belt}",
    "PseudoHopf": "pseudo-Hopf, belt {belt}",
    "Unexplained": "unexplained",
}


def parameter_symbol(name: str) -> str:
    """The paper's symbol of a parameter, by its path such as "belts[0].velocity"."""
    *_, last = name.split(".")
    belt = name.partition("[")[2].partition("]")[0]
    return SYMBOLS[last].replace("%", belt) if last in SYMBOLS else rf"\mathrm{{{last}}}"


def plot_diagram(
    diagram: BifurcationDiagram, ax: Axes | None = None, *, quantity: str = "x2"
) -> Axes:
    """A bifurcation diagram in the manner of the paper's Figs. 3 and 7.

    quantity: "x2": equilibria are drawn at x2 = 0, cycles that stick by the velocity of each belt
    that they stick to, two of these joined by double arrows where they belong to one cycle, other
    cycles by their largest x2. "x1": smallest and largest x1; "period". Stable is black, unstable
    grey; unstable cycles are dashed. Dotted lines are the special points, the names of the regions
    between them stand at the upper edge. Returns the axes.
    """
    known = ("x2", "x1", "period")
    if quantity not in known:
        raise ValueError(f"quantity must be one of {', '.join(known)}, got {quantity!r}")
    ax = _new_axes() if ax is None else ax
    for branch in diagram.branches:
        for rows in _stretches_of(branch.stable):
            _draw_rows(ax, branch, rows, quantity)
    first, last = diagram.regions[0][0], diagram.regions[-1][1]
    ax.set_xlim(first, last)
    ax.margins(y=0.08)
    ax.autoscale_view(scalex=False)
    if quantity == "x2":
        _join_stick_phases(ax, diagram)
    _name_points(ax, diagram)
    _name_regions(ax, diagram)
    *_, last_part = diagram.name.split(".")
    word = WORDS.get(last_part, "parameter")
    ax.set_xlabel(f"{word} ${parameter_symbol(diagram.name)}$")
    labels = {"x2": "velocity $x_2$", "x1": "displacement $x_1$", "period": "period"}
    ax.set_ylabel(labels[quantity])
    return ax


def _stretches_of(flags: np.ndarray) -> list[slice]:
    """The rows between changes of a flag; each includes the first of the next, to be joined."""
    ends = [0, *(np.flatnonzero(flags[1:] != flags[:-1]) + 1), len(flags)]
    return [slice(a, b) for a, b in pairwise(ends)]


def _draw_rows(ax: Axes, branch: Branch, rows: slice, quantity: str) -> None:
    stable, values = bool(branch.stable[rows][0]), branch.values[rows]
    is_cycle = branch.kind == "cycle"
    style: dict[str, Any] = {
        "color": "black" if stable else UNSTABLE_COLOUR,
        "linewidth": (2.0 if stable else 1.2) if is_cycle else 1.1,
        "linestyle": (0, (4, 2)) if is_cycle and not stable else "-",
        "solid_capstyle": "butt",
        "zorder": 3 if stable else 2.5,
        "label": f"{'' if stable else 'un'}stable {'cycle' if is_cycle else 'fixed point'}",
    }
    if quantity == "period":
        curves = [branch.period[rows]] if is_cycle else []
    elif quantity == "x1":
        curves = [branch.x1_min[rows], branch.x1_max[rows]]
    else:
        stuck = ~np.isnan(branch.stick_velocities[rows])
        any_stuck = np.any(stuck, axis=1)
        curves = [
            column for column in branch.stick_velocities[rows].T if not np.all(np.isnan(column))
        ]
        curves.append(np.where(any_stuck, np.nan, branch.x2_max[rows]))
    for curve in curves:
        if not np.all(np.isnan(curve)):
            ax.plot(values, curve, **style)


def _join_stick_phases(ax: Axes, diagram: BifurcationDiagram) -> None:
    """Double arrows between the velocities that one cycle sticks at in turn."""
    for first, last, _ in diagram.regions:
        count = max(1, round(8 * (last - first) / (diagram.regions[-1][1] - diagram.regions[0][0])))
        for at in first + (last - first) * (np.arange(count) + 0.5) / count:
            for branch in diagram.branches:
                inside = (branch.values > first) & (branch.values < last) & branch.stable
                if not np.any(inside):
                    continue
                row = np.flatnonzero(inside)[np.argmin(np.abs(branch.values[inside] - at))]
                levels = np.sort(branch.stick_velocities[row])
                levels = levels[~np.isnan(levels)]
                for low, high in pairwise(levels):
                    arrow = {"arrowstyle": "<->", "color": "0.35", "linewidth": 0.7}
                    style = {**arrow, "shrinkA": 1.5, "shrinkB": 1.5, "mutation_scale": 7}
                    ax.annotate("", (at, high), (at, low), arrowprops=style, zorder=2)


def _name_points(ax: Axes, diagram: BifurcationDiagram) -> None:
    width = ax.get_window_extent().width * 72 / _figure_of(ax).dpi
    first, last = ax.get_xlim()
    values = np.array([float(point.value) for point in diagram.points])
    at = (values - first) / (last - first) * width
    shifts = _spread(at, matplotlib.rcParams["font.size"]) - at
    for point, value, shift in zip(diagram.points, values, shifts, strict=True):
        ax.axvline(value, color="0.45", linewidth=0.6, linestyle=":", zorder=1)
        name = POINT_NAMES[point.kind].format(belt=getattr(point.condition, "belt", ""))
        ax.annotate(
            name,
            (value, 1.0),
            xycoords=ax.get_xaxis_transform(),
            xytext=(shift, 9),
            textcoords="offset points",
            rotation=90,
            ha="center",
            va="bottom",
            fontsize="x-small",
            arrowprops={"arrowstyle": "-", "color": "0.45", "linewidth": 0.5, "shrinkB": 0},
            annotation_clip=False,
        )


def _name_regions(ax: Axes, diagram: BifurcationDiagram) -> None:
    bottom, top = ax.get_ylim()
    ax.set_ylim(bottom, top + 0.09 * (top - bottom))
    for first, last, name in diagram.regions:
        ax.annotate(
            name,
            ((first + last) / 2, 1.0),
            xycoords=ax.get_xaxis_transform(),
            xytext=(0, -4),
            textcoords="offset points",
            ha="center",
            va="top",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
            zorder=5,
        )


def _spread(wanted: np.ndarray, gap: float) -> np.ndarray:
    """Positions as near to the wanted ones, in order, as a gap between them allows."""
    at = wanted.copy()
    for _ in range(200):
        for i in range(1, len(at)):
            lack = gap - (at[i] - at[i - 1])
            if lack > 1e-9:
                at[i - 1] -= lack / 2
                at[i] += lack / 2
    return at


# --- curves and region maps ---------------------------------------------------------------------

#: How the curve of each kind of point is drawn.
CURVE_STYLES: dict[str, dict[str, Any]] = {
    "Hopf": {"color": "#009E73", "linestyle": (0, (5, 1.5)), "label": "Hopf"},
    "NonsmoothFold": {"color": "black", "linestyle": "-", "label": "nonsmooth fold"},
    "GrazingSliding": {"color": "#CC79A7", "linestyle": "-", "label": "grazing"},
    "CrossingSliding": {
        "color": "#CC79A7",
        "linestyle": (0, (5, 1.5)),
        "label": "crossing-sliding",
    },
    "SlidingExchange": {"color": "black", "linestyle": (0, (3, 1, 1, 1)), "label": "exchange"},
    "SuddenSliding": {"color": "black", "linestyle": (0, (1, 1.2)), "label": "belt at rest"},
    "BeltAtRest": {"color": "black", "linestyle": (0, (1, 1.2)), "label": "belt at rest"},
    "FoldOfCycles": {"color": "#E69F00", "linestyle": "-", "label": "fold of cycles"},
    "GrazingEdge": {"color": "#56B4E9", "linestyle": "-", "label": "edge grazing"},
    "CornerCollision": {"color": "#56B4E9", "linestyle": (0, (3, 1, 1, 1)), "label": "corner"},
    "BoundaryEquilibrium": {"color": "#D55E00", "linestyle": "-", "label": "rest on edge"},
    "PseudoHopf": {"color": "#D55E00", "linestyle": (0, (5, 1.5)), "label": "pseudo-Hopf"},
}


def plot_curves(curves: Sequence[BifurcationCurve], ax: Axes | None = None) -> Axes:
    """Curves of bifurcation points in the plane of their parameters, special points as dots.

    Each kind has its line; where a fold turns into a grazing point the line changes. Returns the
    axes.
    """
    ax = _new_axes() if ax is None else ax
    for curve in curves:
        path = curve.path
        # Rows and special points in order; a special point has the kind of the row before it.
        kinds = _kinds_along(curve, path)
        for rows in _stretches_of(kinds):
            rows = slice(rows.start, min(rows.stop + 1, len(path)))
            style = CURVE_STYLES[str(kinds[rows.start])]
            ax.plot(*path[rows].T, linewidth=1.3, zorder=4, **style)
        for point in curve.special:
            if point.kind not in ("EqualVelocities", "BeltAtRest"):
                dot = {"marker": "o", "markersize": 3.5, "color": "black", "zorder": 5}
                ax.plot(*point.values, linestyle="none", label="double sliding", **dot)
    if curves:
        words = [WORDS.get(name.rpartition(".")[2], "parameter") for name in curves[0].names]
        symbols = [parameter_symbol(name) for name in curves[0].names]
        ax.set_xlabel(f"{words[0]} ${symbols[0]}$")
        ax.set_ylabel(f"{words[1]} ${symbols[1]}$")
    return ax


def _kinds_along(curve: BifurcationCurve, path: np.ndarray) -> np.ndarray:
    kinds, row = [], 0
    for at in path:
        is_row = row < len(curve) and bool(np.all(at == curve.values[row]))
        kinds.append(curve.kinds[min(row, len(curve) - 1)] if is_row or not kinds else kinds[-1])
        row += is_row
    return np.array(kinds)


def plot_region_map(regions: RegionMap, ax: Axes | None = None) -> Axes:
    """The regions of a plane of two parameters by name, and the curves that bound them.

    The colour tells what the stable cycle sticks to (that of the belt; both: violet; none: white),
    paler where an equilibrium is stable, too. Without `ax` a figure is made that shows the portrait
    of every region beside the map, as the paper's Fig. 6 does. Returns the axes of the map.
    """
    if ax is None:
        figure = _new_figure()
        figure.set_size_inches(7.2, 9.4)
        return draw_region_map(regions, figure)
    (x, y), label = regions.values, regions.label
    known = sorted(set(np.unique(label).tolist()))
    colours = np.array([_region_colour(name) for name in known])
    image = colours[np.searchsorted(known, label)]
    ax.pcolormesh(x, y, np.swapaxes(image, 0, 1), shading="nearest", rasterized=True, zorder=0)
    plot_curves(regions.curves, ax)
    for name in regions.regions:
        parts: Any = ndimage.label(label == name)[0]  # type: ignore[index]
        for part in range(1, int(np.max(parts)) + 1):
            # Strips one cell wide, such as the line of equal velocities, are left unnamed.
            inside = parts == part
            if not np.any(ndimage.binary_erosion(inside)):
                continue
            row, column = interior(inside)
            halo = [withStroke(linewidth=2.5, foreground="white")]
            style = {"ha": "center", "va": "center", "path_effects": halo, "zorder": 6}
            ax.text(x[row], y[column], name, **style)
    ax.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    if not regions.curves:
        ax.set(xlabel=regions.names[0], ylabel=regions.names[1])
    return ax


def _region_colour(name: str) -> tuple[float, float, float]:
    """Pale for cycles, paler where an equilibrium is stable beside them; white for no cycle."""
    letters = {"a": BELT_COLOURS[0], "b": BELT_COLOURS[1], "c": "#7F5FA8"}
    if not name or name[0] in "16":
        return (1.0, 1.0, 1.0)
    colour = np.array(matplotlib.colors.to_rgb(letters.get(name[1:2], "#555555")))
    strength = 0.18 if name[0] in "25" else 0.38
    red, green, blue = 1 - strength * (1 - colour)
    return float(red), float(green), float(blue)


def draw_region_map(regions: RegionMap, figure: Figure, note: str = "") -> Axes:
    """The map above, below it a sketch of the phase portrait of each region, in its example."""
    names = [name for name in regions.regions if _has_area(regions, name)]
    columns = 5
    rows = -(-len(names) // columns)
    parts: Any = figure.subfigures(2, 1, height_ratios=(6, 1.25 * rows))
    upper, lower = parts
    ax = upper.subplots()
    plot_region_map(regions, ax)
    ax.set_aspect("equal")
    handles, labels = ax.get_legend_handles_labels()
    by_label = dict(zip(labels, handles, strict=True))
    upper.legend(by_label.values(), by_label.keys(), loc="outside right center", handlelength=2.4)
    axes = lower.subplots(rows, columns, squeeze=False)
    for axis in axes.flat[len(names) :]:
        axis.axis("off")
    for axis, name in zip(axes.flat, names, strict=False):
        _draw_sketch(axis, regions.oscillator(name), regions.cycles[name], name)
    if note:
        lower.supxlabel(note, fontsize="small")
    return ax


def _has_area(regions: RegionMap, name: str) -> bool:
    return bool(np.any(ndimage.binary_erosion(regions.label == name)))


def _draw_sketch(ax: Axes, osc: Oscillator, cycles: Sequence[Cycle], name: str) -> None:
    loops = [np.asarray(cycle.sample(300)) for cycle in cycles]
    rests = find_equilibria(osc)
    x1 = float(rests.x1[0])
    for i, belt in enumerate(osc.belts):
        level = float(belt.velocity / osc.omega)
        ax.axhline(level, color=_belt_colour(i), linewidth=0.9, zorder=1)
    for cycle, loop in zip(cycles, loops, strict=True):
        style: dict[str, Any] = {"linewidth": 1.4}
        if not cycle.stable:
            style = {"linewidth": 0.9, "linestyle": (0, (3, 2))}
        ax.plot(*loop.T, color="black", zorder=3, **style)
    for row in rests:
        _draw_equilibrium(ax, row)
    reach = max([0.5, *(1.2 * float(np.max(np.abs(loop[:, 0] - x1))) for loop in loops)])
    ax.set(xlim=(x1 - reach, x1 + reach), ylim=(-0.85, 0.85), xticks=[], yticks=[])
    ax.set_title(name, pad=2)


# --- the model ----------------------------------------------------------------------------------


@jit
def _coefficient(friction: AbstractFriction, speed: Array) -> Array:
    return friction.mu(speed)


def plot_friction_law(
    friction: AbstractFriction, ax: Axes | None = None, *, speed: float = 1.0
) -> Axes:
    """Friction coefficient mu(|nu_R|) sgn(nu_R) over the relative velocity nu_R, up to `speed`.

    A stuck mass takes any value on the vertical bar at nu_R = 0. Returns the axes.
    """
    ax = _new_axes() if ax is None else ax
    r = jnp.linspace(0.0, speed, 401)
    mu, static = np.asarray(_coefficient(friction, r)), float(friction.static)
    ax.axhline(0, color="0.7", linewidth=0.6)
    ax.axvline(0, color="0.7", linewidth=0.6)
    for sign in (1, -1):
        ax.plot(sign * r, sign * mu, color="black", linewidth=1.4)
    ax.plot([0, 0], [-static, static], color="black", linewidth=1.4)
    ax.set_xlim(-speed, speed)
    ax.set_xlabel(r"relative velocity $\nu_{\mathrm{R}}$")
    ax.set_ylabel(r"friction coefficient $\mu\,\mathrm{sgn}\,\nu_{\mathrm{R}}$")
    return ax


def plot_convergence(
    widths: np.ndarray, errors: dict[str, np.ndarray], ax: Axes | None = None
) -> Axes:
    """Largest error of approximate formulations over the width of their band, by label.

    A thin line of slope one goes along. Returns the axes.
    """
    ax = _new_axes() if ax is None else ax
    for belt, (label, values) in enumerate(errors.items()):
        marker = ("o", "s", "^", "D")[belt % 4]
        ax.loglog(widths, values, marker=marker, color=_belt_colour(belt), label=label)
    smallest = min(values.min() for values in errors.values())
    guide = 0.4 * smallest * widths / widths.min()
    ax.loglog(widths, guide, color="0.5", linewidth=0.7, linestyle=":", label="slope 1")
    ax.set_xlabel(r"half-width of the band $v_\ast$ or $\varepsilon$")
    ax.set_ylabel(r"largest error of $(x_1, x_2)$")
    ax.legend(frameon=False)
    return ax


def draw_mechanical_model(ax: Axes | None = None) -> Axes:
    """The double-belt oscillator, Fig. 1 of the paper: a mass on spring and dashpot, two belts.

    The mass touches belt 0 while x < sigma1 and belt 1 while x > sigma0; drawn is the overlapping
    class (d). Returns the axes.
    """
    ax = _new_axes() if ax is None else ax
    ax.set(xlim=(-0.2, 10.6), ylim=(-4.75, 4.1), aspect="equal")
    ax.axis("off")
    line = {"color": "black", "linewidth": 1.0, "solid_capstyle": "butt"}
    x_mass, sigma0, sigma1 = 5.7, 4.3, 7.6

    # The axis of x, and the lines that tell where the belts end.
    _draw_arrow(ax, (3.0, -4.0), (9.4, -4.0))
    ax.text(9.55, -4.0, "$x$", ha="left", va="center")
    for x, top, name in (
        (sigma0, 1.3, r"$\sigma_0$"),
        (x_mass, -1.3, "$x(t)$"),
        (sigma1, -1.3, r"$\sigma_1$"),
    ):
        ax.plot([x, x], [-4.1, top], color="0.45", linewidth=0.7, linestyle=":", zorder=0)
        ax.plot([x, x], [-4.1, -3.9], **line)
        ax.text(x, -4.2, name, ha="center", va="top")

    # Fixed support, spring k, dashpot c.
    ax.plot([0.3, 0.3], [-1.1, 1.1], **line)
    for y in np.linspace(-0.8, 1.1, 7):
        ax.plot([0.3, 0.0], [y, y - 0.3], color="black", linewidth=0.6)
    coil = np.array([0.5, *([0.9, 0.1] * 4), 0.5])
    ax.plot([0.3, *np.linspace(1.3, 3.5, coil.size), 4.8], [0.5, *coil, 0.5], **line)
    ax.plot([0.3, 1.4], [-0.5, -0.5], **line)
    ax.plot([2.1, 1.4, 1.4, 2.1], [-0.2, -0.2, -0.8, -0.8], **line)
    ax.plot([1.8, 1.8], [-0.72, -0.28], color="black", linewidth=2.0, solid_capstyle="butt")
    ax.plot([1.8, 4.8], [-0.5, -0.5], **line)
    ax.text(2.4, 1.05, "$k$", ha="center", va="bottom")
    ax.text(1.75, -0.95, "$c$", ha="center", va="top")

    # The mass, with a foot on each side at x, where it touches.
    ax.add_patch(Rectangle((4.8, -0.9), 1.8, 1.8, facecolor="0.9", edgecolor="black", lw=1.0))
    for side in (1, -1):
        foot = [(-0.3, 0.9), (-0.15, 1.3), (0.15, 1.3), (0.3, 0.9)]
        corners = [(x_mass + x, side * y) for x, y in foot]
        ax.add_patch(Polygon(corners, facecolor="0.55", edgecolor="black", lw=0.8))
    ax.text(x_mass, 0.0, "$m$", ha="center", va="center")

    _draw_belt(ax, 0, (3.1, sigma1), run=-1.3, side=-1, force_at=x_mass)
    _draw_belt(ax, 1, (sigma0, 8.8), run=1.3, side=1, force_at=x_mass)
    return ax


def _draw_belt(ax: Axes, belt: int, ends, run: float, side: int, force_at: float) -> None:
    """A belt on two rollers: its run at the height `run`, the rest above (side 1) or below (-1)."""
    radius, colour = 0.6, _belt_colour(belt)
    middle, far = run + side * radius, run + side * 2 * radius
    angle = np.linspace(np.pi / 2, 3 * np.pi / 2, 40)
    loop_x = np.concatenate([ends[0] + radius * np.cos(angle), ends[1] - radius * np.cos(angle)])
    loop_y = np.concatenate([middle + radius * np.sin(angle), middle - radius * np.sin(angle)])
    ax.add_patch(
        Polygon(
            np.column_stack([loop_x, loop_y]), facecolor="white", edgecolor=colour, lw=1.8, zorder=2
        )
    )
    for x in ends:
        ax.add_patch(Circle((x, middle), 0.4, facecolor="0.9", edgecolor="black", lw=0.8, zorder=3))
        ax.add_patch(Circle((x, middle), 0.07, facecolor="black", zorder=4))
    centre = (ends[0] + ends[1]) / 2
    text = {"va": "center", "color": colour, "zorder": 4}
    ax.text(centre, middle + side * 0.26, f"belt {belt}", ha="center", fontsize="small", **text)
    at = run + side * 0.3
    _draw_arrow(ax, (centre - 0.8, at), (centre + 0.4, at), color=colour)
    ax.text(centre + 0.55, at, rf"$\nu_{belt}$", ha="left", **text)
    # The normal force presses the belt against the mass.
    _draw_arrow(ax, (force_at, far + side * 1.05), (force_at, far + side * 0.06))
    ax.text(
        force_at + 0.2, far + side * 0.65, rf"$F_{{\mathrm{{n}}{belt}}}$", ha="left", va="center"
    )


def _draw_arrow(ax: Axes, start, end, color: str = "black") -> None:
    style = {"arrowstyle": "-|>", "color": color, "linewidth": 1.0, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", xy=end, xytext=start, arrowprops={**style, "mutation_scale": 8}, zorder=5)


# --- basins of attraction -----------------------------------------------------------------------


def plot_basins(basins: Basins, ax: Axes | None = None) -> Axes:
    """Which start leads where, with the cycles, and the unstable one between the basins dashed.

    basins: from `basins`. Basins of cycles are pale blue and green, those of equilibria pale
    orange, undecided starts white. Returns the axes.
    """
    ax = _new_axes() if ax is None else ax
    labels = np.asarray(basins.label)
    x1, x2 = np.asarray(basins.dataset["x1"]), np.asarray(basins.dataset["x2"])
    colours = _basin_colours(basins.attractors)
    palette = matplotlib.colors.ListedColormap(["white", *colours])
    mesh = ax.pcolormesh(x1, x2, labels.T, cmap=palette, vmin=-1.5, vmax=len(colours) - 0.5)
    mesh.set_rasterized(True)
    ax.set(xlim=(x1[0], x1[-1]), ylim=(x2[0], x2[-1]))
    for colour, name in zip(colours, basins.attractors, strict=True):
        ax.add_patch(Rectangle((0, 0), 0, 0, facecolor=colour, edgecolor="0.4", label=f"to {name}"))
    plot_phase_portrait(
        basins.oscillator,
        cycles=[c for c in (*basins.cycles, basins.boundary) if int(c.status) == 0],
        xlim=(x1[0], x1[-1]),
        ylim=(x2[0], x2[-1]),
        ax=ax,
    )
    return ax


def _basin_colours(attractors: Sequence[str]) -> list[str]:
    """Pale, so that lines stay visible; light enough apart for print without colour."""
    cycles, others = (
        iter(["#B5D6EC", "#A9DCC8", "#D5E8F5"]),
        iter(["#F6C98F", "#F3DCE8", "#F5E9A9"]),
    )
    return [next(cycles if name.startswith("cycle") else others, "#DDDDDD") for name in attractors]


# --- figures ------------------------------------------------------------------------------------


def journal_style():
    """A context in which figures are made, drawn and saved in the manner of a journal."""
    return matplotlib.rc_context(JOURNAL)


def plot_sweep(dataset: xr.Dataset, variable: str, ax: Axes | None = None) -> Axes:
    """A variable of a sweep over its two axes longer than one, or along its one.

    dataset: what `sweep` returned; variable: a name in it. "kind" shows equilibria, and cycles by
    the belts that they stick to, as the letters of the paper's Fig. 6. `ValueError` if the axes of
    the sweep are not one or two.
    """
    ax = _new_axes() if ax is None else ax
    values = _attractors(dataset) if variable == "kind" else dataset[variable].squeeze(drop=True)
    require(values.ndim in (1, 2), "dataset", "a sweep with one or two axes", f"{values.ndim}")
    names = [f"{dataset[name].long_name}  {_math_name(name)}" for name in map(str, values.dims)]
    if values.ndim == 1:
        ax.plot(dataset[values.dims[0]], values, color="black", linewidth=0.8)
        ax.set(xlabel=names[0], ylabel=dataset[variable].long_name)
        return ax
    x, y = (dataset[name].values for name in values.dims)
    if variable != "kind":
        mesh = ax.pcolormesh(x, y, values.T, cmap="viridis", rasterized=True)
        _figure_of(ax).colorbar(mesh, ax=ax, label=dataset[variable].long_name)
    else:
        present, codes = np.unique(values.values.astype(str), return_inverse=True)
        order = sorted(range(len(present)), key=lambda i: (len(present[i]), present[i]))
        colours = [ATTRACTOR_COLOURS[rank % len(ATTRACTOR_COLOURS)] for rank in range(len(order))]
        rank = np.argsort(order)
        shades = matplotlib.colors.ListedColormap(colours)
        codes = rank[codes].reshape(values.shape)
        top = len(order) - 0.5
        ax.pcolormesh(x, y, codes.T, cmap=shades, rasterized=True, vmin=-0.5, vmax=top)
        keys = [Patch(color=colour) for colour in colours]
        _figure_of(ax).legend(
            keys, [present[i] for i in order], loc="outside lower center", ncols=2, fontsize="small"
        )
    ax.set(xlabel=names[0], ylabel=names[1])
    return ax


def _math_name(name: str) -> str:
    """An argument of a class such as nu0 as a formula."""
    letters, digits = name.rstrip("0123456789"), name[len(name.rstrip("0123456789")) :]
    greek = {"nu": r"\nu", "sigma": r"\sigma"}
    return (
        f"${greek.get(letters, letters)}_{{{digits}}}$" if digits else f"${greek.get(name, name)}$"
    )


def _attractors(dataset: xr.Dataset) -> xr.DataArray:
    """What each run leads to, in words."""
    kind = decoded(dataset[["kind"]]).kind
    words = kind.astype(object)
    for belts in itertools.product((False, True), repeat=dataset.sizes["belt"]):
        stuck = [str(i) for i, sticks in enumerate(belts) if sticks]
        where = (
            f"cycle, sticks to belt {' and '.join(stuck)}" if stuck else "cycle without sticking"
        )
        same = (dataset.sticks == np.array(belts)).all("belt") & (kind == "cycle")
        words = words.where(~same, where)
    return words.squeeze(drop=True)


def draw_basins(basins: Basins) -> Figure:
    """Basins of attraction on a page, with a key."""
    figure = journal_figure(4.6, 4.4)
    plot_basins(basins, ax=figure.subplots())
    draw_key(figure, ncols=2)
    return figure


def journal_figure(width: float, height: float) -> Figure:
    """An empty figure, in inches, that leaves the settings and windows of pyplot alone."""
    return Figure(figsize=(width, height), layout="constrained")


def draw_overview(
    osc: Oscillator, trajectory: Trajectory, *, cycles: Sequence[ClosedOrbit] = ()
) -> Figure:
    """One trajectory on a page: its time histories, and beside them its phase portrait."""
    figure = journal_figure(7.2, 3.2)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.35, 1))
    x1 = figure.add_subplot(grid[0, 0])
    x2 = figure.add_subplot(grid[1, 0], sharex=x1)
    plot_time_history(trajectory, (x1, x2))
    plot_phase_portrait(osc, trajectory, cycles=cycles, ax=figure.add_subplot(grid[:, 1]))
    return figure


def draw_key(figure: Figure, note: str = "", *, ncols: int | None = None) -> None:
    """Below the axes of a figure a note, and one key for all that they label, in so many columns
    (None: in one line)."""
    by_label: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            by_label.setdefault(label, handle)
    first = [label for label in by_label if label.startswith("to ")]
    labels = [*first, *(label for label in KEY_ORDER if label in by_label)]
    figure.legend(
        [by_label[label] for label in labels],
        labels,
        loc="outside lower center",
        ncols=ncols or len(labels),
        handlelength=1.8,
        columnspacing=1.4,
        title=note or None,
        title_fontsize="small",
    )


def save(figure: Figure, path: Path, dpi: int = 220) -> None:
    """Write a figure as PNG (or what else the ending of the path says)."""
    figure.savefig(path, dpi=dpi)


def _figure_of(ax: Axes) -> Figure:
    figure = ax.get_figure(root=True)
    if figure is None:
        raise ValueError("ax must be part of a figure, got axes that were removed from theirs")
    return figure


def _new_axes() -> Axes:
    return _new_figure().subplots()


def _new_figure() -> Figure:
    # Imported here only: a window is for people at a notebook or a prompt.
    from matplotlib import pyplot

    return pyplot.figure(layout="constrained")
