"""Periodic motions of forced oscillators, Lyapunov exponents, and circle maps."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from ..checks import require
from ..cycles.exponents import Exponents
from ..cycles.periodic import PeriodicMotion
from ..model.oscillator import at_time
from ..results import Status
from ..sweeps.circle_map import CircleMap
from ..tables import require_single
from .style import belt_colour, label_plane, new_axes

#: Points of a curve, for each period of the forcing.
SAMPLES_OF_PERIOD = 257
#: A circle map counts as continuous between neighbouring phases if its rise is at most this factor
#: times step times the larger of the slopes at both; the factor beside a square root is 2.
STEEPEST = 2.5


def check_found(result: Any, name: str) -> None:
    """Raises a `ValueError` unless the status of a result is OK."""
    status = Status(int(result.status))
    require(status == Status.OK, name, "one with status OK, to be drawn", status.name)


def plot_motion(motion: PeriodicMotion, ax: Axes | None = None) -> Axes:
    """Draws a periodic motion in the phase plane, dashed where it is unstable, with a dot at the
    phase 0 of each period, and the velocities of belts that run steadily."""
    require_single(motion, motion.residual, 0)
    check_found(motion, "motion")
    ax = new_axes() if ax is None else ax
    states = np.asarray(motion.sample(SAMPLES_OF_PERIOD * motion.periods))
    ax.plot(*states.T, color="black", linestyle="-" if motion.stable else "--", linewidth=1.2)
    ax.plot(*np.asarray(motion.starts).T, "o", color="black", markersize=4, label="phase 0")
    osc = motion.oscillator
    for number, belt in enumerate(at_time(osc, jnp.zeros(())).belts):
        if type(belt).__name__ == "Belt":
            style = {"color": belt_colour(number), "linewidth": 0.8, "label": f"belt {number}"}
            ax.axhline(float(belt.velocity) / float(osc.omega), **style)
    label_plane(ax)
    ax.legend(fontsize="small")
    return ax


def plot_exponents(found: Exponents, ax: Axes | None = None) -> Axes:
    """Draws the exponents that are finite, with three standard errors."""
    require_single(found, found.exponents, 1)
    ax = new_axes() if ax is None else ax
    values, errors = np.asarray(found.exponents), np.asarray(found.standard_errors)
    known = np.flatnonzero(np.isfinite(values))
    ax.errorbar(known, values[known], 3 * errors[known], fmt="o", color="black", capsize=3)
    ax.axhline(0.0, color="grey", linewidth=0.8)
    ax.set_xticks([0, 1], ["first", "second"])
    ax.set_xlabel("number")
    ax.set_ylabel("Lyapunov exponent")
    return ax


def plot_circle_map(found: CircleMap, ax: Axes | None = None) -> Axes:
    """Draws a circle map and its fixed points; see `CircleMap.plot`."""
    ax = new_axes() if ax is None else ax
    turn, step = 2 * np.pi, found.phases[1]
    ax.plot([0, turn], [0, turn], color="0.6", linewidth=0.8, label="diagonal")
    x, slopes = (np.append(one, one[0]) for one in (found.phases, found.slopes))
    y, lift = (np.append(one, one[0]) for one in (found.next_phases, found.elapsed))
    x[-1] = turn
    # Rise of the unwrapped map from each phase to the next, also from the last to 2 pi.
    rise = step + turn * np.diff(lift) / found.period
    slopes = np.abs(slopes)
    breaks = np.abs(rise) > STEEPEST * step * np.maximum(slopes[1:], slopes[:-1])
    around = ~np.isclose(np.diff(y), rise, rtol=0.0, atol=1e-6)
    ends = breaks | around | ~np.isfinite(rise)
    x, y = np.insert(x, at := np.flatnonzero(ends) + 1, np.nan), np.insert(y, at, np.nan)
    ax.plot(x, y, color="black", linewidth=1.0, label="next onset")
    alone = ends & np.roll(ends, 1)
    style: dict[str, Any] = dict(color="black", markersize=2.0)
    ax.plot(found.phases[alone], found.next_phases[alone], ".", **style)
    for is_stable, fill, word in ((True, "black", "stable"), (False, "white", "unstable")):
        places = found.fixed_points[found.stable == is_stable]
        if len(places):
            style = dict(markeredgecolor="black", markerfacecolor=fill, markersize=4.5, zorder=3)
            ax.plot(places, places, "o", **style, label=f"{word} fixed point")
    if not np.all(found.is_onset):
        edges = np.append(found.phases, turn) - 0.5 * step
        none = np.append(~found.is_onset, ~found.is_onset[0])
        span: dict[str, Any] = dict(
            transform=ax.get_xaxis_transform(), color="0.92", linewidth=0, zorder=0
        )
        ax.fill_between(edges, 0, 1, where=none, step="post", **span, label="no onset")
    quarters = np.arange(5) * turn / 4
    names = ["0", r"$\pi/2$", r"$\pi$", r"$3\pi/2$", r"$2\pi$"]
    ax.set_xticks(quarters, names)
    ax.set_yticks(quarters, names)
    ax.set(xlim=(0, turn), ylim=(0, turn), aspect="equal")
    ax.set_xlabel(r"phase of slip onset $\varphi_n$")
    word = "next one" if found.iterate == 1 else f"{found.iterate}-th next one"
    ax.set_ylabel(rf"phase of the {word} $\varphi_{{n+{found.iterate}}}$")
    return ax
