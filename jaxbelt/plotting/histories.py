"""A trajectory, its events and its arcs over time, each in one pair of axes."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ..motion.simulate import Arcs, Events, Trajectory
from ..results import EventKind
from ..tables import require_single
from .phase import belt_shading, path_of, stick_phases
from .style import COORDINATES, TIME, belt_colour, new_axes

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


def plot_trajectory(trajectory: Trajectory, ax: Axes | None = None) -> Axes:
    """Displacement and velocity over time, stick phases shaded in the colour of their belt."""
    require_single(trajectory, trajectory.ts, 1)
    t, ys = path_of(trajectory)
    ax = new_axes() if ax is None else ax
    ax.plot(t, ys[:, 0], color="black", linewidth=1.1, label=COORDINATES["x1"])
    ax.plot(t, ys[:, 1], color="0.35", linewidth=0.9, linestyle="--", label=COORDINATES["x2"])
    # sorted, so that the key has the belts in order
    for belt, begin, end in sorted(stick_phases(trajectory)):
        ax.axvspan(begin, end, label=f"sticks to belt {belt}", zorder=0, **belt_shading(belt))
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
