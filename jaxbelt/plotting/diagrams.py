"""Bifurcation diagrams, curves of bifurcation points, and points of codimension two.

The condition of each kind of point carries its name and the style of its curve, see `conditions`.
"""

import functools
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from scipy.interpolate import Akima1DInterpolator

from ..bifurcations.curves import BifurcationCurve
from ..bifurcations.diagrams import BifurcationDiagram
from ..bifurcations.pieces import Branch
from ..bifurcations.special import SpecialPoint
from ..checks import require
from ..cycles.cycle import Cycle
from ..cycles.functionals import amplitude, period
from ..spelling import did_you_mean
from .style import COORDINATES, figure_of, make_room, new_axes, parameter_label, spread

UNSTABLE_COLOUR = "0.6"


# --- diagrams -----------------------------------------------------------------------------------


#: Quantities that have a name, and the labels of their axes.
QUANTITIES = {
    "amplitude": "amplitude of $x_1$",
    **COORDINATES,
    "period": "period $T$",
}
Quantity = str | Callable[[Cycle], Any]


def plot_diagram(
    diagram: BifurcationDiagram, ax: Axes | None = None, *, quantity: Quantity | None = None
) -> Axes:
    """Draws a bifurcation diagram in the manner of the paper's Figs. 3 and 7.

    Stable branches are black, unstable ones grey; unstable cycles are dashed. Dotted lines are the
    special points; in the plane of the paper's Fig. 6 the names of the regions between them stand
    at the upper edge. In "x2" a double arrow joins the velocities of two belts that one cycle
    sticks to. Lines are interpolated between rows, separately between special points.

    Args:
        diagram: From `bifurcation_diagram`.
        ax: Axes; None makes new ones.
        quantity: Quantity to draw, see `BifurcationDiagram.plot`.

    Returns:
        The axes.
    """
    quantity = _default_quantity(diagram) if quantity is None else quantity
    if isinstance(quantity, str) or not callable(quantity):
        expected = f"one of {', '.join(QUANTITIES)}, or a function of a cycle"
        came = repr(quantity) + did_you_mean(quantity, QUANTITIES)
        require(quantity in list(QUANTITIES), "quantity", expected, came)
    # The quantities of these names are defined for equilibria, too, the functionals are not.
    named = ((amplitude, "amplitude"), (period, "period"))
    quantity = next((name for one, name in named if quantity is one), quantity)
    curves = [_curves_of(branch, quantity) for branch in diagram.branches]
    ax = new_axes() if ax is None else ax
    special = np.array([float(point.value) for point in diagram.points])
    for branch, drawn in zip(diagram.branches, curves, strict=True):
        for rows in _stretches_of(branch.stable + 2 * branch.neutral):
            ends = [_up_to_neighbours(branch.values, curve, rows, special) for curve in drawn]
            lines = [_between_rows(*one, special) for one in ends]
            _draw_rows(ax, branch, rows, lines)
    first, last = diagram.regions[0][0], diagram.regions[-1][1]
    ax.set_xlim(first, last)
    ax.margins(y=0.08)
    ax.autoscale_view(scalex=False)
    if quantity == "x2":
        _join_stick_phases(ax, diagram)
    _name_points(ax, diagram)
    if diagram.as_paper:
        _name_regions(ax, diagram)
    ax.set_xlabel(parameter_label(diagram.name))
    ax.set_ylabel(QUANTITIES[quantity] if isinstance(quantity, str) else _name_of(quantity))
    return ax


def _default_quantity(diagram: BifurcationDiagram) -> str:
    cycles = [branch for branch in diagram.branches if branch.kind == "cycle"]
    if not cycles:
        return "x1"
    sticks = any(np.any(np.isfinite(branch.stick_durations)) for branch in cycles)
    return "amplitude" if sticks else "x2"


def _curves_of(branch: Branch, quantity: Quantity) -> list[np.ndarray]:
    """Curves [rows] to draw for a branch; NaN in rows where the quantity is not defined."""
    if not isinstance(quantity, str):
        return [branch.evaluated(quantity)]
    if quantity == "x1":
        return [branch.x1_min, branch.x1_max]
    if quantity == "x2":
        stuck = np.any(~np.isnan(branch.stick_velocities), axis=1)
        return [*branch.stick_velocities.T, np.where(stuck, np.nan, branch.x2_max)]
    return [getattr(branch, quantity)]


def _name_of(functional: Any) -> str:
    """Name of a functional in words, with the arguments that a `functools.partial` fixes."""
    if isinstance(functional, functools.partial):
        given = [*map(repr, functional.args), *(f"{k} {v}" for k, v in functional.keywords.items())]
        return f"{_name_of(functional.func)} ({', '.join(given)})"
    name = getattr(functional, "__name__", type(functional).__name__)
    return "quantity" if name == "<lambda>" else name.strip("_").replace("_", " ")


def _stretches_of(flags: np.ndarray) -> list[slice]:
    """Slices of consecutive rows with equal flags."""
    changes = np.flatnonzero(flags[1:] != flags[:-1]) + 1
    ends = [0, *changes.tolist(), len(flags)]
    return [slice(a, b) for a, b in pairwise(ends)]


def _up_to_neighbours(
    values: np.ndarray, curve: np.ndarray, rows: slice, special: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Values and curve at the rows of a stretch, and where it meets the stretches beside it: at the
    special value between their rows, else in the middle."""

    def meeting(i: int) -> list[tuple[float, float]]:
        """The point between the rows i - 1 and i, if there are both."""
        if not 0 < i < len(values):
            return []
        low, high = sorted(values[i - 1 : i + 1])
        between = special[(special > low) & (special < high)]
        value = between[0] if between.size else 0.5 * (low + high)
        share = (value - values[i - 1]) / (values[i] - values[i - 1]) if high > low else 0.5
        return [(value, curve[i - 1] + share * (curve[i] - curve[i - 1]))]

    own = zip(values[rows], curve[rows], strict=True)
    x, y = zip(*meeting(rows.start), *own, *meeting(rows.stop), strict=True)
    return np.array(x), np.array(y)


#: Points drawn between two rows of a curve.
BETWEEN_ROWS = 8


def _between_rows(
    values: np.ndarray, curve: np.ndarray, special: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Values of the parameter and of a curve at the rows, with interpolated points between them.

    Each piece between special values and turning points is interpolated separately. Akima's cubics,
    which do not swing where a curve bends suddenly, interpolate the distance of the piece from its
    chord, over an angle in which a branch that ends like a square root is smooth.
    """
    way = np.sign(np.diff(values))
    passed = np.searchsorted(np.sort(special), values)
    is_special = np.isin(values, special)
    breaks = (passed[1:] != passed[:-1]) & ~is_special[:-1] & ~is_special[1:]
    turns = np.append(False, way[1:] != way[:-1])
    # A piece begins at the first row behind a special value, at a row on one, or at a turn.
    behind, at = np.flatnonzero(breaks) + 1, np.flatnonzero(turns | is_special[:-1])
    begins = sorted({0, *behind.tolist(), *at.tolist()})
    pieces = []
    for first, last in pairwise([*begins, len(values)]):
        x, y = values[first : last + 1], curve[first : last + 1]
        if last < len(values) and breaks[last - 1]:
            x, y = x[:-1], y[:-1]
        pieces.append(_smooth_piece(x, y))
    x, y = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    return x, y


def _smooth_piece(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if len(x) < 3 or not np.all(np.isfinite(y)):
        return x, y
    angle = np.arccos(np.clip(1 - 2 * (x - x[0]) / (x[-1] - x[0]), -1, 1))
    if not np.all(np.diff(angle) > 0):
        return x, y
    rows = np.arange(len(x))
    dense = np.interp(np.linspace(0, rows[-1], BETWEEN_ROWS * rows[-1] + 1), rows, angle)
    share, at_rows = (0.5 * (1 - np.cos(one)) for one in (dense, angle))
    away = y - y[0] - (y[-1] - y[0]) * at_rows
    bend = Akima1DInterpolator(angle, away, method="makima")(dense)
    return x[0] + (x[-1] - x[0]) * share, y[0] + (y[-1] - y[0]) * share + bend


def _draw_rows(
    ax: Axes, branch: Branch, rows: slice, lines: Sequence[tuple[np.ndarray, np.ndarray]]
) -> None:
    stable, neutral = bool(branch.stable[rows][0]), bool(branch.neutral[rows][0])
    is_cycle = branch.kind == "cycle"
    stability = "stable" if stable else "neutral" if neutral else "unstable"
    style: dict[str, Any] = {
        "color": "black" if stable else UNSTABLE_COLOUR,
        "linewidth": (2.0 if stable else 1.2) if is_cycle else 1.1,
        "linestyle": (0, (4, 2)) if is_cycle and not stable else "-",
        "solid_capstyle": "butt",
        "zorder": 3 if stable else 2.5,
        "label": f"{stability} {'cycle' if is_cycle else 'fixed point'}",
    }
    for values, curve in lines:
        if not np.all(np.isnan(curve)):
            ax.plot(values, curve, **style)


def _join_stick_phases(ax: Axes, diagram: BifurcationDiagram) -> None:
    """Draws double arrows between the velocities that one cycle sticks at in turn."""
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


#: Height of the names of special points above the axes, in typographic points; where names are
#: moved aside, all names are raised by STEEPNESS times the largest move.
NAMES_ABOVE, STEEPNESS = 9.0, 0.5


def _name_points(ax: Axes, diagram: BifurcationDiagram) -> None:
    figure = figure_of(ax)
    make_room(figure)
    width = ax.get_window_extent().width * 72 / figure.dpi
    first, last = ax.get_xlim()
    points = sorted(diagram.points, key=lambda point: float(point.value))
    values = np.array([float(point.value) for point in points])
    at = (values - first) / (last - first) * width
    shifts = spread(at, 1.15 * matplotlib.rcParams["font.size"]) - at
    above = NAMES_ABOVE + STEEPNESS * np.max(np.abs(shifts), initial=0.0)
    for point, value, shift in zip(points, values, shifts, strict=True):
        ax.axvline(value, color="0.45", linewidth=0.6, linestyle=":", zorder=1)
        ax.annotate(
            point.condition.words,
            (value, 1.0),
            xycoords=ax.get_xaxis_transform(),
            xytext=(shift, above),
            textcoords="offset points",
            rotation=90,
            ha="center",
            va="bottom",
            fontsize="x-small",
            arrowprops={
                "arrowstyle": "-",
                "color": "0.45",
                "linewidth": 0.5,
                "shrinkA": 1.5,
                "shrinkB": 0,
                "relpos": (0.5, 0.0),
            },
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


# --- curves ---------------------------------------------------------------------------------------


def plot_curves(curves: Sequence[BifurcationCurve], ax: Axes | None = None) -> Axes:
    """Draws curves of bifurcation points in the plane of their parameters.

    Special points are dots, filled for double sliding, else open. Each kind of bifurcation has its
    own line style, which changes where a fold turns into a grazing point. Returns the axes.
    """
    ax = new_axes() if ax is None else ax
    for curve in curves:
        path = curve.path
        # `path` holds rows and special points; a special point gets the kind of the row before it.
        kinds: Any = _kinds_along(curve, path)
        for rows in _stretches_of(kinds):
            rows = slice(rows.start, min(rows.stop + 1, len(path)))
            line = kinds[rows.start].line
            label = line.name or kinds[rows.start].__name__
            style = {"color": line.colour, "linestyle": line.style, "label": label}
            ax.plot(*path[rows].T, linewidth=1.3, zorder=4, **style)
        for point in curve.special:
            if point.kind not in ("EqualVelocities", "BeltAtRest"):
                dot = {"marker": "o", "markersize": 3.5, "color": "black", "zorder": 5}
                label = "double sliding"
                if point.kind != "DoubleSliding":
                    label, dot["markerfacecolor"] = "codimension two", "white"
                ax.plot(*point.values, linestyle="none", label=label, **dot)
    if curves:
        first, second = map(parameter_label, curves[0].names)
        ax.set(xlabel=first, ylabel=second)
    return ax


def _kinds_along(curve: BifurcationCurve, path: np.ndarray) -> np.ndarray:
    kinds, row = [], 0
    for at in path:
        is_row = row < len(curve) and bool(np.all(at == curve.values[row]))
        kinds.append(curve.classes[min(row, len(curve) - 1)] if is_row or not kinds else kinds[-1])
        row += is_row
    return np.array(kinds)


def plot_special_point(point: SpecialPoint, ax: Axes | None = None) -> Axes:
    """Draws a point of codimension two in the plane of the two parameters; returns the axes."""
    ax = new_axes() if ax is None else ax
    words = "".join(f" {one.lower()}" if one.isupper() else one for one in point.kind).strip()
    belts = f", belt{'s' * (len(point.belts) > 1)} {' and '.join(map(str, point.belts))}"
    ax.plot(*point.values, marker="o", markersize=4.5, color="black", linestyle="none")
    ax.annotate(
        words + belts * bool(point.belts),
        point.values,
        xytext=(6, 4),
        textcoords="offset points",
    )
    ax.set(xlabel="first parameter", ylabel="second parameter")
    return ax
