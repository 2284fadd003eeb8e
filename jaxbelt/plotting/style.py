"""Style of the pictures: colours, keys, a journal's page; and axes to draw into.

The colours are those of Okabe and Ito, which colour-blind readers can distinguish. Only the modules
of this folder import matplotlib, and `import jaxbelt` imports none of them.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation

from ..checks import require_value

#: One colour for each belt: blue, vermillion, bluish green, reddish purple, orange (Okabe and Ito).
BELT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
#: Entries of the key of a phase portrait, in order.
KEY_ORDER = (
    "orbit",
    "stable cycle",
    "unstable cycle",
    "stable separatrix",
    "unstable separatrix",
    "sliding set",
    "stable fixed point",
    "unstable fixed point",
    "neutral fixed point",
    "stable pseudo-focus",
    "unstable pseudo-focus",
    "neutral pseudo-focus",
    "pseudo-equilibria",
    "saddle",
)

#: Labels of the axes of time and of the coordinates.
TIME = r"time $\tau$"
COORDINATES = {"x1": "displacement $x_1$", "x2": "velocity $x_2$"}
#: What all keys look like.
KEY: dict[str, Any] = {
    "handler_map": {tuple: HandlerTuple(ndivide=None, pad=0.0)},
    "frameon": False,
    "columnspacing": 1.4,
}
#: Names and symbols of parameters, by the end of their path in the oscillator, or by the name of a
#: function's argument without its number; % is the number of the belt.
PARAMETERS = {
    "damping": ("damping", r"\zeta"),
    "omega": ("frequency", r"\omega"),
    "velocity": ("belt velocity", r"\nu_%"),
    "load": ("load", r"u_{0,%}"),
    "lower": ("lower contact edge of belt %", ""),
    "upper": ("upper contact edge of belt %", ""),
    "static": ("static friction", r"\mu_{s,%}"),
    "kinetic": ("kinetic friction", r"\mu_{k,%}"),
    "residual": ("residual friction", r"p_{1,%}"),
    "quadratic": ("quadratic friction", r"p_{2,%}"),
    "steepness": ("steepness of friction", r"p_{3,%}"),
    "friction.velocity": ("Stribeck velocity", r"v_{s,%}"),
    "velocity.mean": ("mean belt velocity", r"\nu_%"),
    "velocity.amplitude": ("amplitude of belt velocity", r"a_%"),
    "load.mean": ("mean load", r"u_{0,%}"),
    "load.amplitude": ("amplitude of load", ""),
    "amplitude": ("amplitude of forcing", "F"),
    "frequency": ("frequency of forcing", r"\Omega"),
    "phase": ("phase of forcing", r"\varphi"),
    "nu": ("belt velocity", r"\nu_%"),
    "sigma": ("contact edge", r"\sigma_%"),
    "zeta": ("damping", r"\zeta"),
    "x1": ("displacement at the start", "x_1"),
    "x2": ("velocity at the start", "x_2"),
}

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


def journal_style():
    """A context in which figures are made, drawn and saved in the style of a journal."""
    return matplotlib.rc_context(JOURNAL)


def journal_figure(width: float, height: float) -> Figure:
    """An empty figure, size in inches, that leaves the settings and windows of pyplot alone."""
    return Figure(figsize=(width, height), layout="constrained")


def key_entries(axes: Sequence[Axes]) -> dict[str, Any]:
    """Labels in axes, each once, with a tuple of artists: one for each colour of the label.

    Labels of a phase portrait come last, in the order of `KEY_ORDER`.
    """
    drawn: dict[str, dict[Any, Any]] = {}
    for one in axes:
        for handle, label in zip(*one.get_legend_handles_labels(), strict=True):
            colour = handle.get_color() if isinstance(handle, Line2D) else None
            drawn.setdefault(label, {}).setdefault(colour, handle)
    found = {name: tuple(one.values()) for name, one in drawn.items()}
    known = [label for label in KEY_ORDER if label in found]
    return {label: found[label] for label in [*(x for x in found if x not in known), *known]}


def draw_key(figure: Figure, note: str = "", *, leave_out: Axes | None = None) -> None:
    """Draws a note below the axes of a figure, and one key for all that they label.

    The key has as many columns as fit. leave_out: axes that have their own key.
    """
    entries = key_entries([axes for axes in figure.axes if axes is not leave_out])
    if not entries and not note:
        return
    figure.legend(
        entries.values(),
        entries.keys(),
        loc="outside lower center",
        ncols=key_columns(72 * figure.get_size_inches()[0], list(entries)),
        handlelength=1.8,
        title=note or None,
        title_fontsize="small",
        **KEY,
    )


def make_room(figure: Figure) -> None:
    """Makes room for what stands outside of the axes, a key or names.

    A figure without a layout engine, as `matplotlib.pyplot.subplots` makes it, gets the constrained
    one; any other figure is left alone.
    """
    if figure.get_layout_engine() is None:
        figure.set_layout_engine("constrained")


def add_key(ax: Axes) -> None:
    """Draws a key below the axes for all that they label, each thing once."""
    entries = key_entries([ax])
    if not entries:
        return
    make_room(figure_of(ax))
    # Below the numbers and the label of the axis, whatever the height of the axes.
    figure, size = figure_of(ax), matplotlib.rcParams["font.size"]
    below = ScaledTranslation(0, -(3.4 * size + 4) / 72, figure.dpi_scale_trans)
    width, grid = ax.get_window_extent().width * 72 / figure.dpi, ax.get_gridspec()
    room = 72 * figure.get_size_inches()[0] / grid.ncols if grid else width
    ax.legend(
        entries.values(),
        entries.keys(),
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        bbox_transform=ax.transAxes + below,
        borderaxespad=0.0,
        ncols=key_columns(width, list(entries), room),
        handlelength=2.2,
        **KEY,
    )


def key_columns(width: float, labels: Sequence[str], room: float = 0.0) -> int:
    """Number of columns of a key that fit into a width, in points.

    Where only one column fits into the width, two are taken if they fit into `room`, which includes
    the space beside the axes.
    """
    size = matplotlib.rcParams["font.size"]
    letters = 0.48 * size * np.array([len(label.replace("$", "")) for label in labels])
    count = len(labels)
    while count > 1 and np.sum(np.sort(letters)[-count:]) + 4.0 * size * count > width:
        count -= 1
    if count == 1 < len(labels):
        halves = sum(np.max(half) for half in np.array_split(letters, 2))
        return 2 if halves + 8.0 * size < room else 1
    rows = -(-len(labels) // count)
    return -(-len(labels) // rows)


def label_plane(ax: Axes) -> None:
    """Labels the axes of the phase plane."""
    ax.set(xlabel=COORDINATES["x1"], ylabel=COORDINATES["x2"])


def parameter_label(name: str) -> str:
    """Label of the axis of a parameter: word and symbol.

    name: path of the parameter in the oscillator, such as "belts[0].velocity", or the name of the
    argument of a function, such as nu0.
    """
    path, belt = name.split("."), name.partition("[")[2].partition("]")[0]
    ends = (".".join(path[-2:]), path[-1], name.rstrip("0123456789"))
    known = next((end for end in ends if end in PARAMETERS), None)
    if known is None:
        return f"parameter ${name}$" if len(name) == 1 else f"parameter {name}"
    word, symbol = PARAMETERS[known]
    belt = belt or name[len(name.rstrip("0123456789")) :]
    symbol = symbol.replace("%", belt) if belt else symbol.replace(",%", "").replace("_%", "")
    return f"{word.replace('%', belt)} ${symbol}$" if symbol else word.replace("%", belt)


def in_fractions(unit: str) -> str:
    """A unit such as "m s-1" as pictures show it: "m/s"."""
    above = [part for part in unit.split() if "-" not in part]
    below = [part.replace("-1", "").replace("-2", "$^2$") for part in unit.split() if "-" in part]
    above = [part.replace("2", "$^2$") for part in above]
    return " ".join(above or ["1"]) + "".join(f"/{part}" for part in below)


def save(figure: Figure, path: Path) -> None:
    """Writes a figure in the format that the suffix of the path names; PNG without one."""
    figure.savefig(path, dpi=220)


def belt_colour(belt: int) -> str:
    """Colour of a belt; the colours repeat after five belts."""
    return BELT_COLOURS[belt % len(BELT_COLOURS)]


def spread(wanted: np.ndarray, gap: float) -> np.ndarray:
    """Positions as close to the desired ones, in order, as a minimum gap between them allows."""
    at = wanted.copy()
    for _ in range(200):
        for i in range(1, len(at)):
            lack = gap - (at[i] - at[i - 1])
            if lack > 1e-9:
                at[i - 1] -= lack / 2
                at[i] += lack / 2
    return at


def require_axes(ax: Any) -> None:
    """Raises a `ValueError` unless `ax` is axes to draw into, or None."""
    expected = "axes of matplotlib, such as plt.subplots()[1], or None"
    require_value(ax is None or isinstance(ax, Axes), "ax", expected, ax)


def figure_of(ax: Axes) -> Figure:
    """The figure of the axes; raises a `ValueError` if they were removed from it."""
    figure = ax.get_figure(root=True)
    if figure is None:
        raise ValueError("ax must be part of a figure, got axes that were removed from theirs")
    return figure


def new_axes() -> Axes:
    """New axes in a new window of pyplot."""
    return new_figure().subplots()


def new_figure() -> Figure:
    """A new window of pyplot, with a layout in which nothing overlaps."""
    # Imported here only: a window is for people at a notebook or a prompt.
    from matplotlib import pyplot

    return pyplot.figure(layout="constrained")
