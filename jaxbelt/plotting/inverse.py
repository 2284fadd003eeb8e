"""Fits: the record, and the motion that was fitted to it."""

import numpy as np
from matplotlib.axes import Axes

from ..inverse.fit import Fit
from .style import COORDINATES, TIME, new_axes


def plot_fit(fit: Fit, ax: Axes | None = None) -> Axes:
    """Data as dots, the fitted motion as lines, over time, for each recorded component."""
    ax = new_axes() if ax is None else ax
    t, ys, residuals = (np.asarray(x) for x in (fit.ts, fit.ys, fit.residuals))
    words = list(COORDINATES.values())
    known = [i for i in (0, 1) if np.any(np.isfinite(residuals[:, i]))]
    for i in known:
        dot, line = (("#56B4E9", "black"), ("#E69F00", "#D55E00"))[i]
        data = ys[:, i] + residuals[:, i]
        name = f", $x_{i + 1}$" if len(known) > 1 else ""
        style = {"color": dot, "markersize": 3.5, "linestyle": "none", "zorder": 2}
        ax.plot(t, data, marker=".", label=f"record{name}", **style)
        style = {"linestyle": ("-", "--")[i], "linewidth": 1.1, "zorder": 3}
        ax.plot(t, ys[:, i], color=line, label=f"fit{name}", **style)
    ax.margins(x=0)
    ax.set(xlabel=TIME, ylabel=", ".join(words[i] for i in known))
    return ax
