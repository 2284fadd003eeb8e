"""Sweeps, and basins of attraction."""

import itertools
from collections.abc import Sequence
from typing import Any

import matplotlib.colors
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from ..checks import require, require_one_of, require_value
from ..sweeps.basins import Basins, BasinStability
from ..sweeps.datasets import decoded
from ..sweeps.store import Verified
from ..sweeps.sweep import Explanation
from .phase import plot_phase_portrait
from .style import (
    add_key,
    belt_colour,
    draw_key,
    figure_of,
    journal_figure,
    new_axes,
    parameter_label,
)

#: Attractors of a sweep, those with the shortest names first (Okabe and Ito).
ATTRACTOR_COLOURS = ("#F0F0F0", "#56B4E9", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#999999")

#: Axes of datasets that are no parameters.
COUNTED = ("belt", "attractor")


def plot_sweep(dataset: xr.Dataset, variable: str, ax: Axes | None = None) -> Axes:
    """A variable of a sweep over its two axes longer than one, or along its one.

    dataset: what `sweep` or `attractors` returned; variable: a name in it. "kind" shows
    equilibria, and cycles by the belts that they stick to. Along one axis a variable of each belt,
    or of each attractor, is as many lines. Returns the axes. `ValueError` if there is no such
    variable, or if its axes are not one or two: choose with `dataset.isel(belt=0)` and the like.
    """
    require_one_of(variable, map(str, dataset.data_vars), "variable")
    ax = new_axes() if ax is None else ax
    values = (
        _words_for_kinds(dataset) if variable == "kind" else dataset[variable].squeeze(drop=True)
    )
    require(values.ndim in (1, 2), "dataset", "a sweep with one or two axes", f"{values.ndim}")
    names = [
        dataset[name].attrs.get("long_name", name) if name in COUNTED else parameter_label(name)
        for name in map(str, values.dims)
    ]
    label = dataset[variable].attrs.get("long_name", variable)
    (last,) = values.dims[-1:]
    if values.ndim == 1 or (last in COUNTED and variable != "kind"):
        x, lines = dataset[values.dims[0]], values.values.reshape(values.shape[0], -1).T
        for i, line in enumerate(lines):
            style: dict[str, Any] = {"color": "black", "linewidth": 1.1}
            style["drawstyle"] = "steps-mid" if variable == "kind" else "default"
            if len(lines) > 1:
                style |= {"color": belt_colour(i), "label": f"{last} {i}"}
            ax.plot(x, line, linestyle=("-", "--", ":", "-.")[i % 4], **style)
        ax.set(xlabel=names[0], ylabel=label)
        add_key(ax)
        return ax
    x, y = (dataset[name].values for name in values.dims)
    if variable != "kind":
        mesh = ax.pcolormesh(x, y, values.T, cmap="viridis", rasterized=True)
        figure_of(ax).colorbar(mesh, ax=ax, label=label)
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
        figure_of(ax).legend(
            keys, [present[i] for i in order], loc="outside lower center", ncols=2, fontsize="small"
        )
    ax.set(xlabel=names[0], ylabel=names[1])
    return ax


def _words_for_kinds(dataset: xr.Dataset) -> xr.DataArray:
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


def plot_basins(basins: Basins, ax: Axes | None = None) -> Axes:
    """Which start leads where, with the cycles, and the unstable one between the basins dashed.

    basins: from `basins`. Basins of cycles are pale blue and green, those of equilibria pale
    orange, undecided starts white. Returns the axes.
    """
    require_value(isinstance(basins, Basins), "basins", "what jb.basins returns", basins)
    ax = new_axes() if ax is None else ax
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


def draw_basins(basins: Basins) -> Figure:
    """Basins of attraction on a page, with a key."""
    figure = journal_figure(4.6, 4.4)
    plot_basins(basins, ax=figure.subplots())
    draw_key(figure, ncols=2)
    return figure


def plot_stability(stability: BasinStability, ax: Axes | None = None) -> Axes:
    """The fractions of the starts as bars, with their standard errors."""
    ax = new_axes() if ax is None else ax
    kinds, fractions = list(stability.fractions), list(stability.fractions.values())
    errors = [stability.standard_errors[kind] for kind in kinds]
    style = {"color": "#A9CCE3", "edgecolor": "black", "linewidth": 0.8, "capsize": 4}
    ax.bar(kinds, fractions, yerr=errors, width=0.6, **style)
    for place, fraction in enumerate(fractions):
        above = {"xytext": (0, 6), "textcoords": "offset points", "ha": "center"}
        ax.annotate(f"{fraction:.3g}", (place, fraction + errors[place]), **above)
    words = f"fraction of {stability.n:,} starts"
    ax.set(xlabel="what they lead to", ylabel=words, ylim=(0.0, 1.12))
    return ax


def plot_explanation(explanation: Explanation, ax: Axes | None = None) -> Axes:
    """How long the compilation and the runs of a sweep take, as bars."""
    ax = new_axes() if ax is None else ax
    seconds = {"compilation": explanation.compile_seconds, "runs": explanation.seconds}
    bars = ax.barh(list(seconds), list(seconds.values()), color="#A9CCE3", edgecolor="black")
    ax.bar_label(bars, fmt="%.3g s", padding=4)
    ax.invert_yaxis()
    ax.margins(x=0.15)
    runs, blocks = explanation.runs, explanation.blocks
    told = f"{runs:,} run{'s' * (runs != 1)}, {blocks:,} block{'s' * (blocks != 1)}"
    ax.set_title(f"{told}, {explanation.bytes / 1e6:,.3g} MB", fontsize="medium")
    ax.set(xlabel="time in seconds", ylabel="part of the sweep")
    return ax


def plot_blocks(verified: Verified, ax: Axes | None = None) -> Axes:
    """The blocks of a store in rows, each coloured by its state."""
    ax = new_axes() if ax is None else ax
    states = {"right": "#009E73", "to do": "#D9D9D9", "bad": "#D55E00"}
    table = verified.table()
    columns = max(1, int(np.ceil(np.sqrt(len(table)))))
    rows = max(1, -(-len(table) // columns))
    image = np.full(rows * columns, -1)
    image[: len(table)] = [list(states).index(state) for state in table.state]
    palette = matplotlib.colors.ListedColormap(["white", *states.values()])
    grid = image.reshape(rows, columns)
    ax.imshow(grid, cmap=palette, vmin=-1.5, vmax=2.5, aspect="auto", interpolation="nearest")
    for (state, colour), blocks in zip(
        states.items(), (verified.done, verified.to_do, verified.bad), strict=True
    ):
        ax.add_patch(Rectangle((0, 0), 0, 0, color=colour, label=f"{state}: {len(blocks):,}"))
    for axis, name in ((ax.xaxis, "block in its row"), (ax.yaxis, f"row of {columns} blocks")):
        axis.set_major_locator(MaxNLocator(integer=True))
        axis.set_label_text(name)
    return ax
