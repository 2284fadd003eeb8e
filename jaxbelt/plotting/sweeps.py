"""Sweeps, and basins of attraction."""

from collections.abc import Sequence
from itertools import cycle
from typing import Any

import matplotlib.colors
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from ..activity import announced
from ..checks import require, require_one_of, require_value
from ..cycles.periodic import PeriodicMotion
from ..sweeps.basins import Basins, BasinStability, standard_error
from ..sweeps.datasets import decoded
from ..sweeps.fractions import BasinFractions
from ..sweeps.naming import is_cycle
from ..sweeps.sweep import Explanation
from ..sweeps.verification import Verified
from .categories import LINE, draw_categories, words_of_runs
from .phase import plot_phase_portrait
from .style import (
    add_key,
    belt_colour,
    figure_of,
    in_fractions,
    label_plane,
    new_axes,
    parameter_label,
    require_axes,
)

#: Axes of datasets that number belts or attractors, and are not parameters.
COUNTED = ("belt", "attractor")
#: Axes of datasets along which starts differ.
AXES_OF_STARTS = ("x1", "x2")
#: Variables that measure one loop of a cycle or a periodic motion; datasets hold 0 for all other
#: attractors.
OF_LOOPS = ("stick_duration", "d_stick_duration")


def plot_sweep(
    dataset: xr.Dataset, variable: str, ax: Axes | None = None, *, share: str | None = None
) -> Axes:
    """Draws a variable of a sweep over its axes longer than one, which are one or two.

    "kind" shows equilibria, and cycles by the belts that they stick to, each kind in the same
    colour in every picture. Other categories, such as "signature", have a key of the most frequent
    ones; the rest is "other" (along one axis: numbers of the categories where their words are
    long). Along one axis a variable of belts or attractors has a line for each of them. Runs of
    an unfinished store that are not done are left white, and so are runs without a cycle in stick
    durations. The title of a sweep of attractors with one start at each point says so: other starts
    may lead elsewhere.

    Args:
        dataset: Result of `sweep` or `attractors`, also as `in_si` returns it.
        variable: Name of one of its variables.
        ax: Axes; None makes new ones.
        share: A word of a category, such as "cycle" of "kind", for a sweep with axes x1 or x2. The
            picture then shows the share of the starts along these axes that have it.

    Returns:
        The axes.

    Raises:
        ValueError: If there is no such variable, or if it has not one or two axes (choose with
            `dataset.isel(belt=0)` and the like).
    """
    known = isinstance(dataset, xr.Dataset)
    require_value(known, "dataset", "an xarray.Dataset, such as sweep(...) returns", dataset)
    require_one_of(variable, map(str, dataset.data_vars), "variable")
    require_axes(ax)
    if share is not None:
        dataset, variable = _shares_of(dataset, variable, share), "share"
    attributes = dataset[variable].attrs
    is_category = variable == "kind" or "flag_meanings" in attributes
    # Signatures get numbers only once all runs are done.
    fits = is_category or variable != "signature"
    require(fits, "dataset", "of a sweep that is done for its signatures", "one that is not")
    values = (words_of_runs if is_category else _numbers_of_runs)(dataset, variable)
    values = values.squeeze(drop=True)
    _check_axes(values)
    last = values.dims[-1]
    are_lines = values.ndim == 1 or (last in COUNTED and variable != "kind")
    if are_lines and is_category and max(map(len, values.values.flat)) > LINE // 2:
        # Long words do not fit beside an axis; the numbers of the categories replace them.
        values = _numbers_of_runs(dataset, variable).squeeze(drop=True)
    ax = new_axes() if ax is None else ax
    names = [_axis_label(dataset[name]) for name in map(str, values.dims)]
    label = _with_unit(attributes.get("long_name", variable), attributes)
    if dataset.attrs.get("observe") == "attractor" and not {*AXES_OF_STARTS} & {
        *map(str, dataset.dims)
    }:
        start = str(dataset.attrs.get("start", "")).partition(": of several")[0]
        ax.set_title(f"from one start, {start}", fontsize="medium")
    if are_lines:
        x, lines = dataset[values.dims[0]], values.values.reshape(values.shape[0], -1).T
        for i, line in enumerate(lines):
            style: dict[str, Any] = {"color": "black", "linewidth": 1.1}
            style["drawstyle"] = "steps-mid" if is_category else "default"
            if len(lines) > 1:
                style |= {"color": belt_colour(i), "label": f"{last} {i}"}
            ax.plot(x, line, linestyle=("-", "--", ":", "-.")[i % 4], **style)
        # The window shows all that was swept, also where there is nothing to draw.
        ends = [float(x.min()), float(x.max())]
        ax.update_datalim(np.column_stack([ends, ends]), updatey=False)
        ax.autoscale_view(scaley=False)
        ax.set(xlabel=names[0], ylabel=label)
        add_key(ax)
        return ax
    x, y = (dataset[name].values for name in values.dims)
    if is_category:
        draw_categories(ax, x, y, values.values)
    else:
        mesh = ax.pcolormesh(x, y, values.values.T, cmap="viridis", rasterized=True)
        figure_of(ax).colorbar(mesh, ax=ax, label=label)
    ax.set(xlabel=names[0], ylabel=names[1])
    return ax


def _shares_of(dataset: xr.Dataset, variable: str, word: str) -> xr.Dataset:
    """Dataset with the variable `share`: fraction of the starts whose category is `word`."""
    starts = [name for name in AXES_OF_STARTS if name in dataset[variable].dims]
    expected = "None, or asked of a sweep with axes x1 or x2 for several starts"
    require(starts, "share", expected, f"{word!r} of one without")
    known = dataset[variable].attrs.get("flag_meanings", "").split()
    require_one_of(word, known or ["None"], "share")
    is_it = (decoded(dataset[[variable]])[variable] == word).astype(float)
    share = is_it.where(dataset.status >= 0).mean(starts)
    share.attrs["long_name"] = f"share of starts: {word.replace('_', ' ')}"
    # Without attributes such as the title's start: the label says what the share is.
    return xr.Dataset({"share": share})


def _numbers_of_runs(dataset: xr.Dataset, variable: str) -> xr.DataArray:
    """A variable as floats, NaN where the run is not done or leads to no cycle."""
    values = dataset[variable].astype(float)
    if variable.startswith(OF_LOOPS) and "kind" in dataset:
        values = values.where(decoded(dataset[["kind"]]).kind.isin(["cycle", "periodic"]))
    return values if "status" not in dataset else values.where(dataset.status >= 0)


def _check_axes(values: xr.DataArray) -> None:
    """Raises a `ValueError` unless there are one or two axes, and says how to choose."""
    axes = list(map(str, values.dims))
    one = next((name for name in axes if name in COUNTED), axes[-1] if axes else "")
    expected = "a sweep with one or two axes longer than one"
    advice = f"; choose with dataset.isel({one}=0), say" if axes else ""
    require(len(axes) in (1, 2), "dataset", expected, f"{len(axes)} ({', '.join(axes)}){advice}")


def _axis_label(axis: xr.DataArray) -> str:
    """Label of an axis, with its unit if it has one."""
    name = str(axis.name)
    if name in COUNTED or "units" in axis.attrs:
        return _with_unit(axis.attrs.get("long_name", name), axis.attrs)
    return parameter_label(name)


def _with_unit(words: str, attributes: dict[str, Any]) -> str:
    return f"{words} ({in_fractions(attributes['units'])})" if "units" in attributes else words


@announced("plot_basins")
def plot_basins(basins: Basins, ax: Axes | None = None) -> Axes:
    """Draws which start leads where, with the cycles; the unstable cycle between basins is dashed.

    For a forced oscillator it draws the states of the periodic motions at the phase 0.

    Basins of cycles are pale blue and green, those of equilibria pale orange, undecided starts
    white. Below the axes is a key, as in `Basins.plot`.

    Args:
        basins: From `basins`.
        ax: Axes; None makes new ones.

    Returns:
        The axes.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    require_value(isinstance(basins, Basins), "basins", "what jb.basins returns", basins)
    require_axes(ax)
    ax = new_axes() if ax is None else ax
    labels = np.asarray(basins.label)
    x1s, x2s = np.asarray(basins.dataset["x1"]), np.asarray(basins.dataset["x2"])
    colours = _basin_colours(basins.attractors)
    palette = matplotlib.colors.ListedColormap(["white", *colours])
    mesh = ax.pcolormesh(x1s, x2s, labels.T, cmap=palette, vmin=-1.5, vmax=len(colours) - 0.5)
    mesh.set_rasterized(True)
    limits: dict[str, Any] = dict(xlim=(x1s[0], x1s[-1]), ylim=(x2s[0], x2s[-1]))
    ax.set(**limits)
    for colour, name in zip(colours, basins.attractors, strict=True):
        ax.add_patch(Rectangle((0, 0), 0, 0, facecolor=colour, edgecolor="0.4", label=f"to {name}"))
    if basins.boundary is None:
        names = [name for name in basins.attractors if is_cycle(name)]
        marks = zip(basins.cycles, names, cycle("osD^v"), strict=False)
        for motion, name, mark in marks:
            assert isinstance(motion, PeriodicMotion)
            x1, x2 = np.asarray(motion.starts).T
            seen = (x1 >= x1s[0]) & (x1 <= x1s[-1]) & (x2 >= x2s[0]) & (x2 <= x2s[-1])
            if np.any(seen):
                # Filled marks, because all motions in `cycles` are attractors.
                ax.plot(x1, x2, marker=mark, color="black", ls="none", label=name)
        label_plane(ax)
        ax.set(**limits)
    else:
        cycles = [one for one in (*basins.cycles, basins.boundary) if int(one.status) == 0]
        plot_phase_portrait(basins.oscillator, cycles=cycles, **limits, ax=ax)
    add_key(ax)
    return ax


def _basin_colours(attractors: Sequence[str]) -> list[str]:
    """Pale colours, so that lines stay visible; of different lightness for print without colour."""
    cycles, others = (
        iter(["#B5D6EC", "#A9DCC8", "#D5E8F5", "#8FB8D8", "#7FC4A8"]),
        iter(["#F6C98F", "#F3DCE8", "#F5E9A9", "#E3A56B", "#DDB5CB"]),
    )
    return [next(cycles if is_cycle(name) else others, "#DDDDDD") for name in attractors]


def plot_stability(stability: BasinStability, ax: Axes | None = None) -> Axes:
    """Draws the fractions of the starts as bars, with their standard errors."""
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


def plot_fractions(fractions: BasinFractions, ax: Axes | None = None) -> Axes:
    """Draws the fractions as bands over the parameter; see `BasinFractions.plot`."""
    ax = new_axes() if ax is None else ax
    values, undecided = fractions.values, fractions.undecided
    shares = np.column_stack([fractions.fractions, undecided])
    # Equilibria lie at the bottom, undecided starts on top; the rest in the order of the names.
    names = [*fractions.attractors, "undecided"]
    order = np.argsort([_layer(name) for name in names], kind="stable")
    x, shares = _with_steps(values, shares[:, order])
    tops = np.cumsum(shares, axis=1)
    colours = [*_basin_colours(fractions.attractors), "#FFFFFF"]
    errors: Any = {"color": "black", "alpha": 0.3, "linewidth": 0, "zorder": 2.5}  # above the bands
    bottom, is_uncertain = np.zeros(len(x)), False
    for place, number in enumerate(order):
        met, top = shares[:, place] > 0, tops[:, place]
        if np.any(met):
            style = {"facecolor": colours[number], "edgecolor": "0.4", "linewidth": 0.5}
            ax.fill_between(x, bottom, top, where=met.tolist(), label=names[number], **style)
        inner = (top > 0) & (top < 1)
        spread = 2 * standard_error(top, fractions.n)
        ends = np.clip([top - spread, top + spread], 0, 1)
        ax.fill_between(x, *ends, where=inner.tolist(), **errors)
        is_uncertain |= bool(np.any(inner))
        bottom = top
    if is_uncertain:
        ax.fill_between(x[:1], 0, 0, label="two standard errors", **errors)
    ax.set(xlim=(values[0], values[-1]), ylim=(0, 1))
    ax.set(xlabel=parameter_label(fractions.name), ylabel=f"fraction of {fractions.n:,} starts")
    return ax


def _layer(name: str) -> int:
    """Position of an attractor in the stack of bands."""
    return ("equilibrium", "stuck", "cycle", "undecided").index(name.split()[0])


def _with_steps(values: np.ndarray, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shares [values, bands] over the parameter, with steps.

    Where the set of bands changes between two values, shares step at the middle of both values,
    which occurs twice in the result.
    """
    changes = np.flatnonzero(np.any((shares[1:] > 0) != (shares[:-1] > 0), axis=1))
    middles = 0.5 * (values[changes] + values[changes + 1])
    x = np.concatenate([values, middles, middles])
    rows = np.concatenate([np.arange(len(values)), changes, changes + 1])
    # Points with equal x are in the order of their rows.
    order = np.lexsort((rows, x))
    return x[order], shares[rows[order]]


def plot_explanation(explanation: Explanation, ax: Axes | None = None) -> Axes:
    """Draws how long compilation and runs of a sweep take, as bars."""
    ax = new_axes() if ax is None else ax
    seconds = {"compilation": explanation.compile_seconds, "runs": explanation.seconds}
    bars = ax.barh(list(seconds), list(seconds.values()), color="#A9CCE3", edgecolor="black")
    ax.bar_label(bars, fmt="%.3g s", padding=4)
    ax.invert_yaxis()
    ax.margins(x=0.15)
    runs, blocks = explanation.runs, explanation.blocks
    size_text = f"{runs:,} run{'s' * (runs != 1)}, {blocks:,} block{'s' * (blocks != 1)}"
    ax.set_title(f"{size_text}, {explanation.bytes / 1e6:,.3g} MB", fontsize="medium")
    ax.set(xlabel="time in seconds", ylabel="part of the sweep")
    return ax


def plot_blocks(verified: Verified, ax: Axes | None = None) -> Axes:
    """Draws the blocks of a store in rows, each coloured by its state."""
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
