"""One oscillator in its phase plane: portraits, vector fields, and a page with the histories.

Every function draws into the matplotlib axes `ax` (None makes new ones) and returns the axes. The
conventions are the paper's:

- A discontinuity boundary Sigma_Fi, x2 = nu_i/omega, is a line over the contact interval of its
  belt, in the colour of the belt; the part where the mass sticks (the sliding set) is a wide pale
  band behind it. Finite contact edges sigma are dotted vertical lines.
- Stable cycles are thick solid lines, unstable ones dashed, other orbits thin and grey.
- Stable fixed points are filled, unstable ones open, neutral ones grey; pseudo-foci are diamonds
  filled likewise, a segment of pseudo-equilibria is a thick bar, saddles are crosses.
- Stable separatrices, which bound basins, are purple, unstable ones grey and dash-dotted.
"""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from ..activity import announced
from ..checks import as_interval, require_one_of, require_value
from ..cycles.cycle import Cycle
from ..cycles.portrait import Portrait
from ..cycles.separatrices import Separatrix
from ..model.equilibria import Equilibria, EquilibriumKind, stability
from ..model.equilibria import equilibria as find_equilibria
from ..model.modes import mode_acceleration
from ..model.oscillator import (
    Oscillator,
    check_oscillator,
    constant_force,
    has_clock,
    refuse_clock,
)
from ..model.transitions import mode_of_state
from ..motion.simulate import Trajectory
from ..numerics.compiling import jit
from .histories import check_trajectory, path_of, plot_time_history
from .style import (
    add_key,
    belt_colour,
    figure_of,
    journal_figure,
    label_plane,
    new_axes,
    require_axes,
    spread,
)

ORBIT_COLOUR = "0.55"
#: Style of the pieces of a boundary where the mass sticks, in the colour of the belt.
SLIDING_SET: dict[str, Any] = {"linewidth": 4.5, "alpha": 0.25, "solid_capstyle": "butt"}
#: Distance of the arrow of a separatrix from its point, as a fraction of the axes.
ARROW_DISTANCE = 0.3
#: Styles of separatrices: reddish purple of Okabe and Ito, and grey.
STABLE_SEPARATRIX = {"color": "#CC79A7", "linewidth": 1.3, "label": "stable separatrix"}
UNSTABLE_SEPARATRIX = {
    "color": "0.45",
    "linewidth": 0.8,
    "linestyle": (0, (5, 1.6, 1, 1.6)),
    "label": "unstable separatrix",
}


@runtime_checkable
class ClosedOrbit(Protocol):
    """Interface of a cycle for `plot_phase_portrait`: its stability, and states all around it."""

    @property
    def stable(self) -> Any: ...

    def sample(self, n: int, /) -> Any:
        """About n states (x1, x2) of one loop, [samples, 2]."""
        ...


# --- phase portraits ----------------------------------------------------------------------------


def path_around(cycle: ClosedOrbit) -> np.ndarray:
    """States [states, 2] of one loop, those at events of a `Cycle` included, for sharp corners."""
    ys = np.asarray(cycle.sample(400))
    if not isinstance(cycle, Cycle):
        return ys
    t = np.concatenate([np.linspace(0.0, float(cycle.period), len(ys)), cycle.arcs.t])
    return np.concatenate([ys, cycle.arcs.y])[np.argsort(t, kind="stable")]


@announced("plot_phase_portrait")
def plot_phase_portrait(
    osc: Oscillator,
    trajectories: Trajectory | Sequence[Trajectory] = (),
    *,
    cycles: Sequence[ClosedOrbit] = (),
    equilibria: Equilibria | None = None,
    xlim: tuple[float, float] | None = None,
    ylim: tuple[float, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draws orbits in the plane of displacement x1 and velocity x2, with the boundaries of `osc`.

    Args:
        osc: The oscillator.
        trajectories: One or several results of `simulate`; drawn as thin lines.
        cycles: Cycles, see `find_cycle`; stable ones are thick and solid, unstable ones dashed.
        equilibria: Equilibria to draw; None takes those of `osc`.
        xlim: Window in x1; None fits what is drawn.
        ylim: Window in x2, likewise.
        ax: Axes. None makes new ones, with a key below them; for other axes call `ax.legend()`.

    Returns:
        The axes.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    check_oscillator(osc)
    refuse_clock(osc, "plot_phase_portrait", "plot_time_history(trajectory)")
    if isinstance(trajectories, Trajectory):
        trajectories = (trajectories,)
    many = isinstance(trajectories, Sequence)
    require_value(many, "trajectories", "one or several of simulate", trajectories)
    for trajectory in trajectories:
        check_trajectory(trajectory, "trajectories")
    fits = isinstance(cycles, Sequence) and all(hasattr(cycle, "sample") for cycle in cycles)
    require_value(fits, "cycles", "a list of cycles, such as [jb.find_cycle(...)]", cycles)
    known = equilibria is None or isinstance(equilibria, Equilibria)
    require_value(known, "equilibria", "what jb.equilibria returns, or None", equilibria)
    _check_window(xlim, ylim)
    require_axes(ax)
    paths = [path_of(trajectory, "trajectories")[1] for trajectory in trajectories]
    is_new, ax = ax is None, new_axes() if ax is None else ax
    loops = [path_around(cycle) for cycle in cycles]
    rests: Equilibria = find_equilibria(osc) if equilibria is None else equilibria
    window = _window(osc, [*paths, *loops], rests, xlim, ylim)
    ax.set(xlim=window[0], ylim=window[1])
    plot_boundaries(osc, ax)
    for path in paths:
        ax.plot(*path.T, color=ORBIT_COLOUR, linewidth=0.7, zorder=2, label="orbit")
        _draw_arrowheads(ax, path, ORBIT_COLOUR, [_index_at_distance(ax, path, 0.22)])
    for cycle, loop in zip(cycles, loops, strict=True):
        if cycle.stable:
            style = {"linewidth": 1.7, "label": "stable cycle"}
        else:
            style = {"linewidth": 1.0, "linestyle": (0, (4, 2.2)), "label": "unstable cycle"}
        ax.plot(*loop.T, color="black", solid_joinstyle="round", zorder=4, **style)
        _draw_arrowheads(ax, loop, "black", _lowest(loop))
    for equilibrium in rests:
        draw_equilibrium(ax, equilibrium)
    label_plane(ax)
    if is_new:
        add_key(ax)
    return ax


def draw_orbit(ax: Axes, path: np.ndarray, words: str) -> None:
    """Draws an orbit [samples, 2] that is not closed, and extends the window to hold it."""
    for limits, extend, x in ((ax.get_xlim(), ax.set_xlim, 0), (ax.get_ylim(), ax.set_ylim, 1)):
        margin = 0.05 * np.ptp(path[:, x])
        extend(min(limits[0], path[:, x].min() - margin), max(limits[1], path[:, x].max() + margin))
    ax.plot(*path.T, color="black", linewidth=1.7, zorder=4, label=words)
    _draw_arrowheads(ax, path, "black", [len(path) // 2])


def plot_portrait(portrait: Portrait, ax: Axes | None = None) -> Axes:
    """Draws a portrait: cycles and equilibria as in `plot_phase_portrait`, and separatrices.

    Each separatrix has an arrow in the direction of time. Returns the axes.
    """
    ax = new_axes() if ax is None else ax
    osc, cycles = portrait.oscillator, [*portrait.cycles, *portrait.unstable]
    paths = [np.asarray(one.ys) for one in portrait.separatrices if not one.stable]
    paths += [path_around(cycle) for cycle in cycles]
    x1, x2 = (_with_margin(ends) for ends in _window(osc, paths, portrait.equilibria, None, None))
    shown = {"equilibria": portrait.equilibria, "xlim": x1, "ylim": x2}
    plot_phase_portrait(osc, cycles=cycles, ax=ax, **shown)
    for one in portrait.separatrices:
        _draw_separatrix(ax, one)
    return ax


def plot_separatrix(separatrix: Separatrix, ax: Axes | None = None) -> Axes:
    """Draws a separatrix and its point, with an arrow in the direction of time; returns the
    axes."""
    ax = new_axes() if ax is None else ax
    x1, x2 = np.asarray(separatrix.ys).T
    ax.set(xlim=_with_margin([x1.min(), x1.max()]), ylim=_with_margin([x2.min(), x2.max()]))
    _draw_separatrix(ax, separatrix)
    words = "its end" if separatrix.stable else "its beginning"
    dot = {"marker": "o", "markersize": 5, "color": "black", "linestyle": "none", "zorder": 5}
    ax.plot(*np.asarray(separatrix.point)[:, None], label=words, **dot)
    label_plane(ax)
    return ax


def _draw_separatrix(ax: Axes, one: Separatrix) -> None:
    path, (left, right), (bottom, top) = np.asarray(one.ys), ax.get_xlim(), ax.get_ylim()
    style = STABLE_SEPARATRIX if one.stable else UNSTABLE_SEPARATRIX
    ax.plot(*path.T, zorder=3, **style)
    # The path from the separatrix's point outwards, whatever the direction of time.
    away = path[::-1] if one.stable else path
    outside = (away < [left, bottom]) | (away > [right, top])
    leaves = np.append(np.flatnonzero(np.any(outside, axis=1)), len(away))[0]
    index = _index_at_distance(ax, away[: max(leaves - 1, 1)], ARROW_DISTANCE)
    index = len(path) - 1 - index if one.stable else index
    _draw_arrowheads(ax, path, style["color"], [index])


def plot_boundaries(osc: Oscillator, ax: Axes) -> Axes:
    """Draws the discontinuity boundaries and contact edges of `osc` in the present window of the
    axes.

    Sigma_Fi, x2 = nu_i/omega, eqs. (8) and (17) of the paper, is drawn over the contact interval of
    belt i, its sliding set as a pale band. A boundary that reaches the right-hand side of the axes
    is named outside of them, any other at its left end.
    """
    left, right = ax.get_xlim()
    outside: list[tuple[float, int]] = []
    levels: list[float] = []
    for i, belt in enumerate(osc.belts):
        level = float(belt.velocity / osc.omega)
        ends = np.clip([float(belt.lower), float(belt.upper)], left, right)
        bottom, top = ax.get_ylim()
        if ends[0] == ends[1] or not bottom < level < top:
            continue
        colour = belt_colour(i)
        # Where two boundaries coincide, both colours show.
        dashes = (0, (5, 5)) if level in levels else "-"
        ax.plot(ends, [level, level], color=colour, linewidth=0.9, linestyle=dashes, zorder=1.5)
        levels.append(level)
        x1 = np.linspace(ends[0], ends[1], 1201)
        sticks = _sliding_set(osc, jnp.asarray(x1), jnp.full(x1.size, belt.velocity / osc.omega), i)
        band = np.where(sticks, level, np.nan)
        label = "sliding set" if np.any(sticks) else None
        ax.plot(x1, band, color=colour, zorder=1.2, label=label, **SLIDING_SET)
        if ends[1] == right:
            outside.append((level, i))
        else:
            _name_boundary(ax, i, (ends[0], level), (3, 2.5), "left", "bottom")
    _name_boundaries_outside(ax, outside)
    _draw_edges(ax, osc)
    return ax


@jit
def _sliding_set(osc, x1, x2, belt):
    return jnp.stack(mode_of_state(osc, x1, x2).stuck)[belt]


def _draw_edges(ax: Axes, osc: Oscillator) -> None:
    """Draws finite contact edges in the window: sigma for a single one, else sigma0, sigma1, ...

    A name that would touch the one on its left stands a line of text higher.
    """
    # Lower edges first: class (d) then has the paper's numbers, whichever edge is the larger one.
    known = [float(e) for side in ("lower", "upper") for e in (getattr(b, side) for b in osc.belts)]
    numbers = {edge: n for n, edge in enumerate(dict.fromkeys(filter(np.isfinite, known)))}
    left, right = ax.get_xlim()
    size = matplotlib.rcParams["font.size"]
    width = ax.get_window_extent().width * 72 / figure_of(ax).dpi
    end, line = -np.inf, 0
    for edge, number in sorted(numbers.items()):
        if not left < edge < right:
            continue
        at = (edge - left) / (right - left) * width
        line = line + 1 if at < end else 0
        end = at + 1.6 * size
        ax.axvline(edge, color="0.25", linewidth=0.8, linestyle=":", zorder=1.4)
        ax.annotate(
            r"$\sigma$" if len(numbers) == 1 else rf"$\sigma_{{{number}}}$",
            (edge, 0.0),
            xycoords=ax.get_xaxis_transform(),
            xytext=(3, 4 + 1.25 * size * line),
            textcoords="offset points",
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
            zorder=6,
        )


def _name_boundary(ax: Axes, belt: int, xy, offset, ha: str, va: str, xycoords: Any = "data"):
    ax.annotate(
        rf"$\Sigma_{{\mathrm{{F}}{belt}}}$",
        xy,
        xycoords=xycoords,
        xytext=offset,
        textcoords="offset points",
        ha=ha,
        va=va,
        color=belt_colour(belt),
        path_effects=[withStroke(linewidth=2, foreground="white")],
        annotation_clip=False,
        zorder=6,
    )


def _name_boundaries_outside(ax: Axes, names: list[tuple[float, int]]) -> None:
    """Names boundaries beside the right-hand side of the axes, at least a line of text apart."""
    bottom, top = ax.get_ylim()
    height = ax.get_window_extent().height * 72 / figure_of(ax).dpi
    line = 1.25 * matplotlib.rcParams["font.size"]
    names = sorted(names)
    at = np.array([(level - bottom) / (top - bottom) * height for level, _ in names])
    for (level, belt), shift in zip(names, spread(at, line) - at, strict=True):
        _name_boundary(
            ax, belt, (1.0, level), (3, shift), "left", "center", ax.get_yaxis_transform()
        )


def _window(osc, paths, equilibria, xlim, ylim):
    """Limits of x1 and x2: the given ones, or limits that hold all that is drawn, with a margin."""
    ends = [] if equilibria is None else [*equilibria.x1_lower, *equilibria.x1_upper]
    x1 = [float(x) for x in ends]
    x1 += [x for path in paths for x in (path[:, 0].min(), path[:, 0].max())]
    if not paths:
        # Without orbits: every fixed point lies within the reach of friction.
        reach = 1 + sum(float(b.load) * float(b.friction.static) for b in osc.belts)
        middle = float(sum(constant_force(osc)))
        x1 += [middle - reach, middle + reach]
    x1 += [float(e) for b in osc.belts for e in (b.lower, b.upper) if np.isfinite(float(e))]
    x2 = [0.0, *(float(b.velocity) / float(osc.omega) for b in osc.belts)]
    x2 += [x for path in paths for x in (path[:, 1].min(), path[:, 1].max())]
    if not paths:
        x2 += [-1.0, 1.0]
    return (xlim or _with_margin(x1)), (ylim or _with_margin(x2))


def _with_margin(values: Sequence[float]) -> tuple[float, float]:
    margin = 0.08 * (max(values) - min(values)) or 0.5
    return min(values) - margin, max(values) + margin


def draw_equilibrium(ax: Axes, row: Equilibria) -> None:
    """Draws one row of equilibria; filled where stable, grey where neutral."""
    face = "black" if row.stable else "0.6" if row.neutral else "white"
    ends = [float(row.x1_lower), float(row.x1_upper)]
    if row.kind == EquilibriumKind.SEGMENT:
        bar = {"solid_capstyle": "butt", "zorder": 5}
        ax.plot(ends, [0, 0], color="black", linewidth=3.5, label="pseudo-equilibria", **bar)
        ax.plot(ends, [0, 0], color=face, linewidth=1.9, **bar)
        return
    if row.kind == EquilibriumKind.SADDLE:
        cross = {"marker": "x", "markersize": 5.5, "markeredgewidth": 1.6, "linestyle": "none"}
        ax.plot(ends[:1], [0.0], color="black", label="saddle", zorder=6, **cross)
        return
    is_focus = row.kind == EquilibriumKind.PSEUDO_FOCUS
    ax.plot(
        ends[:1],
        [0.0],
        label=f"{stability(row)} {'pseudo-focus' if is_focus else 'fixed point'}",
        linestyle="none",
        marker="D" if is_focus else "o",
        markersize=5,
        markerfacecolor=face,
        markeredgecolor="black",
        markeredgewidth=1.0,
        zorder=6,
    )


def _index_at_distance(ax: Axes, path: np.ndarray, distance: float) -> int:
    """Index at which a path has gone `distance`, a fraction of the axes, or half its length if
    shorter."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    steps = np.diff(path, axis=0) / [right - left, top - bottom]
    gone = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
    return int(np.searchsorted(gone, min(distance, gone[-1] / 2)))


def _lowest(path: np.ndarray) -> list[int]:
    """Index of the lowest point of a path, as a list.

    Where the lowest stretch is level, as along a belt, the index of its middle. Empty for a path of
    NaN.
    """
    x2 = path[:, 1]
    (lowest,) = np.nonzero(x2 <= x2.min() + 1e-6 * np.ptp(x2))
    middle = len(lowest) // 2
    return lowest[middle : middle + 1].tolist()


def _draw_arrowheads(ax: Axes, path: np.ndarray, colour: str, indices: Sequence[int]) -> None:
    for i in indices:
        before, after = path[max(i - 1, 0)], path[min(i + 1, len(path) - 1)]
        if np.all(before == after):
            continue
        ax.annotate(
            "",
            xy=tuple(after),
            xytext=tuple(before),
            arrowprops={
                "arrowstyle": "-|>,head_length=0.55,head_width=0.22",
                "color": colour,
                "linewidth": 0.5,
                "shrinkA": 0,
                "shrinkB": 0,
                "mutation_scale": 7.5,
            },
            zorder=4,
        )


def _check_window(xlim: Any, ylim: Any) -> None:
    for name, limits in (("xlim", xlim), ("ylim", ylim)):
        if limits is not None:
            as_interval(limits, name)


# --- vector field -------------------------------------------------------------------------------


@announced("plot_vector_field")
def plot_vector_field(
    osc: Oscillator,
    *,
    kind: str = "streamlines",
    xlim: tuple[float, float] | None = None,
    ylim: tuple[float, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draws the vector field of `osc`, eqs. (2) and (11) of the paper, with its boundaries.

    The field jumps at the boundaries. On a sliding set it points along the boundary.

    Args:
        osc: The oscillator.
        kind: "streamlines", or "arrows" of one length that show the direction.
        xlim: Window in x1; None takes one that holds all fixed points.
        ylim: Window in x2, likewise.
        ax: Axes; None makes new ones.

    Returns:
        The axes.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    check_oscillator(osc)
    refuse_clock(osc, "plot_vector_field", "plot_time_history(trajectory)")
    require_one_of(kind, ("streamlines", "arrows"), "kind")
    _check_window(xlim, ylim)
    require_axes(ax)
    ax = new_axes() if ax is None else ax
    (left, right), (bottom, top) = _window(osc, [], None, xlim, ylim)
    ax.set(xlim=(left, right), ylim=(bottom, top))
    columns, rows = (201, 201) if kind == "streamlines" else (21, 17)
    x1, x2 = np.meshgrid(np.linspace(left, right, columns), np.linspace(bottom, top, rows))
    v1, v2 = _vector_field(osc, jnp.asarray(x1), jnp.asarray(x2))
    if kind == "streamlines":
        ax.streamplot(
            x1, x2, np.asarray(v1), np.asarray(v2),
            color="0.65", linewidth=0.6, arrowsize=0.6, density=0.9, zorder=1,
        )  # fmt: skip
    else:
        # Arrows of one length on paper: scaled by the window, then normalised.
        v1, v2 = v1 / (right - left), v2 / (top - bottom)
        size = np.hypot(v1, v2)
        ax.quiver(
            x1, x2, v1 / size, v2 / size,
            color="0.6", pivot="mid", scale=28, width=0.003, headwidth=4, zorder=1,
        )  # fmt: skip
    plot_boundaries(osc, ax)
    label_plane(ax)
    return ax


@jit
def _vector_field(osc, x1, x2):
    mode = mode_of_state(osc, x1, x2)
    return x2, jnp.where(mode.any_stuck, 0.0, mode_acceleration(osc, mode, x1, x2))


def draw_overview(
    osc: Oscillator, trajectory: Trajectory, *, cycles: Sequence[ClosedOrbit] = ()
) -> Figure:
    """One trajectory on a page: its time histories, and beside them its phase portrait.

    With a clock the phase plane shows the orbit alone, because its boundaries depend on time.
    """
    figure = journal_figure(7.2, 3.2)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.35, 1))
    x1 = figure.add_subplot(grid[0, 0])
    x2 = figure.add_subplot(grid[1, 0], sharex=x1)
    plot_time_history(trajectory, (x1, x2))
    plane = figure.add_subplot(grid[:, 1])
    if has_clock(osc):
        plane.plot(*path_of(trajectory)[1].T, color=ORBIT_COLOUR, linewidth=0.7)
        label_plane(plane)
    else:
        plot_phase_portrait(osc, trajectory, cycles=cycles, ax=plane)
    return figure
