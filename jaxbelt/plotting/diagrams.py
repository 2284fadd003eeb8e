"""Bifurcation diagrams, curves of bifurcation points, and region maps.

How each kind of point is named and its curve drawn its condition tells, see `conditions`; the
symbols of parameters stand in `SYMBOLS`.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import matplotlib
import matplotlib.colors
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from scipy import ndimage

from ..bifurcations.curves import BifurcationCurve
from ..bifurcations.diagrams import BifurcationDiagram, Branch
from ..bifurcations.regions import RegionMap, interior
from ..cycles.cycle import Cycle
from ..model.equilibria import equilibria as find_equilibria
from ..model.oscillator import Oscillator
from .phase import draw_equilibrium
from .style import BELT_COLOURS, belt_colour, draw_key, figure_of, new_axes, new_figure, spread

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


# --- diagrams -----------------------------------------------------------------------------------


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
    ax = new_axes() if ax is None else ax
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
    width = ax.get_window_extent().width * 72 / figure_of(ax).dpi
    first, last = ax.get_xlim()
    values = np.array([float(point.value) for point in diagram.points])
    at = (values - first) / (last - first) * width
    shifts = spread(at, matplotlib.rcParams["font.size"]) - at
    for point, value, shift in zip(diagram.points, values, shifts, strict=True):
        ax.axvline(value, color="0.45", linewidth=0.6, linestyle=":", zorder=1)
        ax.annotate(
            point.condition.words,
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


# --- curves and region maps ---------------------------------------------------------------------


def plot_curves(curves: Sequence[BifurcationCurve], ax: Axes | None = None) -> Axes:
    """Curves of bifurcation points in the plane of their parameters, special points as dots.

    Each kind has its line; where a fold turns into a grazing point the line changes. Returns the
    axes.
    """
    ax = new_axes() if ax is None else ax
    for curve in curves:
        path = curve.path
        # Rows and special points in order; a special point has the kind of the row before it.
        kinds: Any = _kinds_along(curve, path)
        for rows in _stretches_of(kinds):
            rows = slice(rows.start, min(rows.stop + 1, len(path)))
            line = kinds[rows.start].line
            style = {"color": line.colour, "linestyle": line.style, "label": line.name}
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
        kinds.append(curve.classes[min(row, len(curve) - 1)] if is_row or not kinds else kinds[-1])
        row += is_row
    return np.array(kinds)


def plot_region_map(regions: RegionMap, ax: Axes | None = None) -> Axes:
    """The regions of a plane of two parameters by name, and the curves that bound them.

    The colour tells what the stable cycle sticks to (that of the belt; both: violet; none: white),
    paler where an equilibrium is stable, too. Without `ax` a figure is made that shows the portrait
    of every region beside the map, as the paper's Fig. 6 does. Returns the axes of the map.
    """
    if ax is None:
        figure = new_figure()
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


def draw_region_map(regions: RegionMap, figure: Figure) -> Axes:
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
    draw_key(lower)
    return ax


def _has_area(regions: RegionMap, name: str) -> bool:
    return bool(np.any(ndimage.binary_erosion(regions.label == name)))


def _draw_sketch(ax: Axes, osc: Oscillator, cycles: Sequence[Cycle], name: str) -> None:
    loops = [np.asarray(cycle.sample(300)) for cycle in cycles]
    rests = find_equilibria(osc)
    x1 = float(rests.x1[0])
    for i, belt in enumerate(osc.belts):
        level = float(belt.velocity / osc.omega)
        ax.axhline(level, color=belt_colour(i), linewidth=0.9, zorder=1, label=f"belt {i}")
    for cycle, loop in zip(cycles, loops, strict=True):
        style: dict[str, Any] = {"linewidth": 1.4, "label": "stable cycle"}
        if not cycle.stable:
            style = {"linewidth": 0.9, "linestyle": (0, (3, 2)), "label": "unstable cycle"}
        ax.plot(*loop.T, color="black", zorder=3, **style)
    for row in rests:
        draw_equilibrium(ax, row)
    reach = max([0.5, *(1.2 * float(np.max(np.abs(loop[:, 0] - x1))) for loop in loops)])
    ax.set(xlim=(x1 - reach, x1 + reach), ylim=(-0.85, 0.85), xticks=[], yticks=[])
    ax.set_title(name, pad=2)
