"""Orbit diagrams; zooming into one computes it anew."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from ..checks import require_one_of, require_value
from ..sweeps.moments import AtExtrema
from ..sweeps.orbit_diagram import NOT_PERIODIC, OrbitDiagram
from .style import COORDINATES, add_key, figure_of, new_axes, parameter_label

#: Marks of each kind of attractor (Okabe and Ito), and its name in the key. Undecided starts have
#: no points; ticks at the lower edge mark the parameter values at which they occur.
DOTS: dict[str, dict[str, Any]] = {
    "equilibrium": {"color": "#0072B2", "marker": ".", "label": "equilibrium"},
    "cycle": {"color": "black", "marker": ".", "label": "cycle"},
    NOT_PERIODIC: {"color": "#666666", "marker": ".", "label": "no period found"},
    "stuck": {"color": "#D55E00", "marker": ".", "label": "stuck for ever"},
    "undecided": {"color": "#CC79A7", "marker": "|", "label": "undecided"},
}
#: Colours of points found while the parameter falls, beside those found while it rises.
FALLING = {"equilibrium": "#56B4E9", "cycle": "#E69F00", NOT_PERIODIC: "#F5CF80"}


class _Dots(NamedTuple):
    """The line with the points of one kind of attractor from some starts; label: for the key."""

    kind: str
    starts: tuple[int, ...]
    label: str
    line: Line2D


def plot_orbits(
    diagram: OrbitDiagram,
    ax: Axes | None = None,
    *,
    quantity: str | None = None,
    zoom: bool = False,
) -> Axes:
    """Draws the points of an orbit diagram over its parameter; see `OrbitDiagram.plot`."""
    if quantity is None:
        quantity = diagram.at.of if isinstance(diagram.at, AtExtrema) else "x1"
    require_one_of(quantity, COORDINATES, "quantity")
    require_value(isinstance(zoom, bool), "zoom", "True or False", zoom)
    ax = new_axes() if ax is None else ax
    lines = _lines(ax, diagram)
    _put(lines, diagram, quantity)
    for one in lines:
        ax.update_datalim(one.line.get_xydata(), updatey=one.kind != "undecided")
    ax.autoscale_view()
    ax.set_xlim(diagram.values[0], diagram.values[-1])
    ax.set(xlabel=parameter_label(diagram.name), ylabel=COORDINATES[quantity])
    if zoom:
        _Zoom(diagram, ax, lines, quantity)
    return ax


def _lines(ax: Axes, diagram: OrbitDiagram) -> list[_Dots]:
    """Lines without points: one for each kind, or for each kind and sense of a two-way sweep."""
    everywhere = tuple(range(diagram.kind.shape[1]))
    both = diagram.sampling is not None and diagram.sampling.senses == ("up", "down")
    lines = []
    for kind, look in DOTS.items():
        if both and kind in FALLING:
            falling = {"color": FALLING[kind], "label": f"{look['label']}, parameter falling"}
            lines.append(_dots(ax, kind, (1,), **look | falling))
            lines.append(_dots(ax, kind, (0,), **look))
        else:
            lines.append(_dots(ax, kind, everywhere, **look))
    return lines


def _dots(ax: Axes, kind: str, starts: tuple[int, ...], label: str, **look: Any) -> _Dots:
    place: dict[str, Any] = {"transform": ax.get_xaxis_transform()} if kind == "undecided" else {}
    size = 7.0 if kind == "undecided" else 2.5
    (line,) = ax.plot([], [], linestyle="none", markersize=size, **place, **look)
    return _Dots(kind, starts, label, line)


def _put(
    lines: list[_Dots],
    diagram: OrbitDiagram,
    quantity: str,
    sizes: tuple[float, float] = (1.0, 1.0),
) -> None:
    """Sets the points of each line, scaled by sizes (x, y); only lines with points have a label."""
    heights = diagram.x1 if quantity == "x1" else diagram.x2
    values = np.broadcast_to(diagram.values[:, None, None], heights.shape)
    for kind, starts, label, line in lines:
        of_kind = (diagram.kind == kind) & np.isin(np.arange(diagram.kind.shape[1]), starts)
        of_kind = np.broadcast_to(of_kind[..., None], heights.shape)
        if kind == "undecided":
            x = np.unique(values[of_kind])
            y = np.zeros_like(x)
        else:
            x, y = (one[of_kind & ~np.isnan(heights)] for one in (values, heights))
        line.set_data(x * sizes[0], y * sizes[1])
        line.set_label(label if len(x) else "_none")


class _Zoom:
    """Computes an orbit diagram anew over the limits of its axes, whenever these change.

    Nothing is computed while a button of the mouse is held, as in panning.
    """

    def __init__(self, diagram: OrbitDiagram, ax: Axes, lines: list[_Dots], quantity: str):
        self.diagram, self.ax, self.lines, self.quantity = diagram, ax, lines, quantity
        # Empty text whose position is the scale of the axes: (1, 1) unless `plot_in_si` changes it.
        self.one = ax.text(1.0, 1.0, "")
        self.shown, self.is_held = ax.get_xlim(), False
        self.note = ax.text(0.5, 0.5, "", transform=ax.transAxes, ha="center", wrap=True)
        canvas = figure_of(ax).canvas
        # Functions, because matplotlib keeps only weak references to methods, and nothing else
        # would refer to these.
        ax.callbacks.connect("xlim_changed", lambda _: self.follow())
        canvas.mpl_connect("button_press_event", lambda _: self.hold(True))
        canvas.mpl_connect("button_release_event", lambda _: self.hold(False))

    def hold(self, is_held: bool) -> None:
        """Called when a button of the mouse is pressed or released."""
        self.is_held = is_held
        self.follow()

    def follow(self) -> None:
        """Draws the points between the present limits, unless they are shown already."""
        sizes = self.one.get_position()
        limits = tuple(np.array(self.ax.get_xlim()) / sizes[0])
        if self.is_held or np.allclose(limits, self.shown, rtol=1e-12, atol=0):
            return
        self.shown = limits
        try:
            diagram = self.diagram.over((min(limits), max(limits)))
        except ValueError as error:
            # The old points stay, with the reason why there are no new ones.
            self.note.set_text(str(error))
        else:
            self.note.set_text("")
            _put(self.lines, diagram, self.quantity, sizes)
            self.ax.relim()
            self.ax.autoscale_view(scalex=False)
            add_key(self.ax)
        figure_of(self.ax).canvas.draw_idle()
