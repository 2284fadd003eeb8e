"""A trajectory, its events and its arcs over time; stick phases are shaded."""

from collections.abc import Sequence
from typing import Any

import matplotlib.colors
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.ticker import MaxNLocator

from ..checks import require, require_value
from ..motion.simulate import Arcs, Events, Trajectory
from ..results import EventKind
from ..tables import require_single
from .style import (
    COORDINATES,
    TIME,
    belt_colour,
    figure_of,
    key_columns,
    key_entries,
    new_axes,
    new_figure,
)

#: Hatches that identify the belts in print without colour.
BELT_HATCHES = ("", "////", "....", "xxxx", "\\\\\\\\")
#: Marks of events, and their names.
EVENT_MARKS = {
    EventKind.STICK: ("v", "sticks to belt {}"),
    EventKind.SLIP: ("^", "slips from belt {}"),
    EventKind.CROSS: ("x", "crosses boundary {}"),
    EventKind.EDGE: ("s", "edge of belt {}"),
}
#: Styles of contacts by their code (Okabe and Ito), and their names.
CONTACT_STYLES = {
    0: ("#222222", "", "sticks"),
    1: ("#56B4E9", "", "slips, belt faster"),
    -1: ("#E69F00", "", "slips, mass faster"),
    2: ("white", "////", "does not touch"),
}


def plot_time_history(trajectory: Trajectory, ax: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draws displacement x1 and velocity x2 over time, stick phases shaded in the colour of their
    belt.

    Args:
        trajectory: From `simulate`.
        ax: Two axes, for x1 and for x2; None makes new ones.

    Returns:
        The two axes.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    check_trajectory(trajectory, "trajectory")
    is_pair = isinstance(ax, Sequence | np.ndarray) and len(ax) == 2
    pair = ax is None or (is_pair and all(isinstance(one, Axes) for one in ax))
    require_value(pair, "ax", "two axes of matplotlib, such as plt.subplots(2)[1], or None", ax)
    t, ys = path_of(trajectory)
    if ax is None:
        ax = tuple(new_figure().subplots(2, sharex=True))
    upper, lower = ax
    for axes, values, name in zip(ax, ys.T, COORDINATES.values(), strict=True):
        axes.plot(t, values, color="black", linewidth=0.9)
        axes.set_ylabel(name)
        axes.margins(x=0)
    _shade_stick_phases(trajectory, ax)
    upper.tick_params(labelbottom=False)
    lower.set_xlabel(TIME)
    figure_of(lower).align_ylabels(ax)
    entries = key_entries([upper])
    if entries:
        labels = sorted(entries)
        width = upper.get_window_extent().width * 72 / figure_of(upper).dpi
        upper.legend(
            [entries[label] for label in labels],
            labels,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=key_columns(width, labels),
            frameon=False,
            borderaxespad=0.2,
        )
    return ax


def check_trajectory(trajectory: Any, field: str) -> None:
    """Raises a `ValueError` that names the field unless it is a trajectory."""
    expected = "a Trajectory, such as jb.simulate(...)"
    require_value(isinstance(trajectory, Trajectory), field, expected, trajectory)


def stick_phases(trajectory: Trajectory) -> list[tuple[int, float, float]]:
    """Stick phases of a trajectory as (belt, begin, end), in order of their beginnings."""
    # Approximate formulations have no arcs; their samples are used.
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
        # A phase consists of several arcs if another belt begins or ends contact meanwhile.
        switches = np.flatnonzero(np.diff(stuck[:, belt], prepend=False, append=False))
        for first, after in switches.reshape(-1, 2):
            phases.append((belt, float(begins[first]), float(ends[after - 1])))
    return sorted(phases, key=lambda phase: phase[1])


def _shade_stick_phases(trajectory: Trajectory, every: Sequence[Axes]) -> None:
    """Shades the stick phases in axes over time, those of a belt as one artist of its colour."""
    phases = np.array(stick_phases(trajectory)).reshape(-1, 3)
    for belt in np.unique(phases[:, 0]).astype(int).tolist():
        spans = phases[phases[:, 0] == belt, 1:]
        corners: Any = np.stack(
            np.broadcast_arrays(spans[:, [0, 0, 1, 1]], [0.0, 1.0, 1.0, 0.0]), axis=-1
        )
        style = {"label": f"sticks to belt {belt}", "zorder": 0, **_belt_shading(belt)}
        for ax in every:
            # From the bottom to the top of the axes, whatever their limits.
            shades = PolyCollection(corners, transform=ax.get_xaxis_transform(), **style)
            ax.add_collection(shades, autolim=False)
            ax.update_datalim(corners.reshape(-1, 2), updatey=False)
            ax.autoscale_view(scaley=False)


def _belt_shading(belt: int) -> dict[str, Any]:
    """Style of the stick phases of a belt: pale, with hatches for print without colour."""
    colour = matplotlib.colors.to_rgba(belt_colour(belt))
    pale = tuple(1 - 0.28 * (1 - channel) for channel in colour[:3])
    hatch = BELT_HATCHES[belt % len(BELT_HATCHES)]
    return {"facecolor": pale, "edgecolor": (*colour[:3], 0.45), "linewidth": 0.0, "hatch": hatch}


def path_of(trajectory: Trajectory, field: str = "trajectory") -> tuple[np.ndarray, np.ndarray]:
    """Times and states of a trajectory, its events among the samples so that corners are sharp;
    a `ValueError` that names the field where there is none."""
    t = np.concatenate([trajectory.ts, trajectory.events.t])
    ys = np.concatenate([trajectory.ys, trajectory.events.y])
    known = np.isfinite(t) & np.all(np.isfinite(ys), axis=1)
    if not np.any(known):
        require(False, field, "a run with finite samples", repr(trajectory))
    order = np.argsort(t[known], kind="stable")
    return t[known][order], ys[known][order]


def plot_trajectory(trajectory: Trajectory, ax: Axes | None = None) -> Axes:
    """Displacement and velocity over time, stick phases shaded in the colour of their belt."""
    require_single(trajectory, trajectory.ts, 1)
    t, ys = path_of(trajectory)
    ax = new_axes() if ax is None else ax
    ax.plot(t, ys[:, 0], color="black", linewidth=1.1, label=COORDINATES["x1"])
    ax.plot(t, ys[:, 1], color="0.35", linewidth=0.9, linestyle="--", label=COORDINATES["x2"])
    _shade_stick_phases(trajectory, [ax])
    ax.margins(x=0)
    ax.set(xlabel=TIME, ylabel=", ".join(COORDINATES.values()))
    return ax


def plot_events(events: Events, ax: Axes | None = None) -> Axes:
    """The events over time, a line for each kind and belt."""
    ax = new_axes() if ax is None else ax
    table = events.table()
    lines = sorted({(int(belt), EventKind[kind]) for kind, belt in zip(table.kind, table.belt)})
    for height, (belt, kind) in enumerate(lines):
        t = table.t[(table.kind == kind.name) & (table.belt == belt)]
        marker, _ = EVENT_MARKS[kind]
        style = {"color": belt_colour(belt), "markersize": 5, "linestyle": "none"}
        ax.plot(t, np.full(len(t), height), marker=marker, **style)
    names = [EVENT_MARKS[kind][1].format(belt) for belt, kind in lines]
    ax.set_yticks(range(len(lines)), names)
    ax.set(xlabel=TIME, ylabel="event", ylim=(-0.6, len(lines) - 0.4))
    return ax


def plot_arcs(arcs: Arcs, ax: Axes | None = None) -> Axes:
    """The contact of each belt over time, as a bar."""
    ax = new_axes() if ax is None else ax
    table = arcs.table()
    spans = np.array(table[["t", "duration"]])
    # An arc of infinite duration is drawn a little longer than the others.
    known = spans[np.isfinite(spans[:, 1])]
    last = np.max(known.sum(axis=1), initial=np.max(spans[:, 0], initial=0.0))
    spans[:, 1] = np.minimum(spans[:, 1], 1.05 * last + 1.0 - spans[:, 0])
    belts = [name for name in table if str(name).startswith("contact_")]
    for belt, name in enumerate(belts):
        for code, (colour, hatch, words) in CONTACT_STYLES.items():
            wanted = table[name].abs() == 2 if code == 2 else table[name] == code
            bars = spans[wanted.to_numpy()]
            if len(bars):
                style = {"facecolor": colour, "hatch": hatch, "edgecolor": "0.6", "linewidth": 0.0}
                ax.broken_barh(bars.tolist(), (belt - 0.35, 0.7), label=words, **style)
    ax.set_yticks(range(len(belts)), [f"belt {belt}" for belt in range(len(belts))])
    ax.set(xlabel=TIME, ylabel="contact", ylim=(-0.6, len(belts) - 0.4))
    ax.xaxis.set_major_locator(MaxNLocator(8))
    ax.margins(x=0)
    return ax
