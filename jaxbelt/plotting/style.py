"""The manner of the pictures: colours, keys, a journal's page; and axes to draw into.

The colours are those of Okabe and Ito, which colour-blind readers can tell apart. Only the modules
of this folder import matplotlib, and `import jaxbelt` imports none of them.
"""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

#: One colour a belt: blue, vermillion, bluish green, reddish purple, orange (Okabe and Ito).
BELT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
#: What a phase portrait may hold, in the order of its key.
KEY_ORDER = (
    "orbit",
    "stable cycle",
    "unstable cycle",
    "stable separatrix",
    "unstable separatrix",
    "sliding set",
    "stable fixed point",
    "unstable fixed point",
    "stable pseudo-focus",
    "unstable pseudo-focus",
    "pseudo-equilibria",
    "saddle",
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


def journal_style():
    """A context in which figures are made, drawn and saved in the manner of a journal."""
    return matplotlib.rc_context(JOURNAL)


def journal_figure(width: float, height: float) -> Figure:
    """An empty figure, in inches, that leaves the settings and windows of pyplot alone."""
    return Figure(figsize=(width, height), layout="constrained")


def draw_key(figure: Figure | SubFigure, note: str = "", *, ncols: int | None = None) -> None:
    """Below the axes of a figure a note, and one key for all that they label, in so many columns
    (None: in one line)."""
    by_label: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            by_label.setdefault(label, handle)
    first = [label for label in by_label if label.startswith(("to ", "belt "))]
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


def belt_colour(belt: int) -> str:
    """The colour of a belt; they repeat after five belts."""
    return BELT_COLOURS[belt % len(BELT_COLOURS)]


def spread(wanted: np.ndarray, gap: float) -> np.ndarray:
    """Positions as near to the wanted ones, in order, as a gap between them allows."""
    at = wanted.copy()
    for _ in range(200):
        for i in range(1, len(at)):
            lack = gap - (at[i] - at[i - 1])
            if lack > 1e-9:
                at[i - 1] -= lack / 2
                at[i] += lack / 2
    return at


def figure_of(ax: Axes) -> Figure:
    """The figure that the axes belong to; `ValueError` where they were removed from it."""
    figure = ax.get_figure(root=True)
    if figure is None:
        raise ValueError("ax must be part of a figure, got axes that were removed from theirs")
    return figure


def new_axes() -> Axes:
    """Axes in a new window of pyplot."""
    return new_figure().subplots()


def new_figure() -> Figure:
    """A new window of pyplot, in which nothing overlaps."""
    # Imported here only: a window is for people at a notebook or a prompt.
    from matplotlib import pyplot

    return pyplot.figure(layout="constrained")
