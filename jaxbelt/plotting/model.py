"""The model: its friction laws, its formulations side by side, and the machine itself."""

from typing import Any

import numpy as np
from jaxtyping import Array
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon, Rectangle

from ..activity import announced
from ..checks import as_positive, require_value
from ..model.friction import AbstractFriction
from ..model.machine import PhysicalBelt
from ..numerics.compiling import jit
from .style import add_key, belt_colour, new_axes, require_axes


@jit
def _coefficient(friction: AbstractFriction, speed: Array) -> Array:
    return friction.mu(speed)


@announced("plot_friction_law")
def plot_friction_law(
    friction: AbstractFriction | PhysicalBelt,
    ax: Axes | None = None,
    *,
    speed: float | None = None,
    unit: str | None = None,
) -> Axes:
    """Draws the friction coefficient `mu(|nu_R|) sgn(nu_R)` over the relative velocity nu_R.

    A stuck mass takes any value on the vertical bar at nu_R = 0.

    Args:
        friction: The law, or a `PhysicalBelt`, whose law takes speeds in m/s.
        ax: Axes; None makes new ones.
        speed: Largest speed. None: where the table of a `Tabulated` ends, 1 for any other law.
            Beyond the end of a table the curve is dashed: an extrapolation.
        unit: Unit of the speeds that the law takes, for the label of the axis. None: m/s for a
            `PhysicalBelt`, no unit for a law.

    Returns:
        The axes.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    if isinstance(friction, PhysicalBelt):
        friction, unit = friction.friction, "m/s" if unit is None else unit
    law = "a law such as jb.Conti(...), or a PhysicalBelt"
    require_value(isinstance(friction, AbstractFriction), "friction", law, friction)
    end = float(np.asarray(friction.measured_to))
    speed = (end if np.isfinite(end) else 1.0) if speed is None else as_positive(speed, "speed")
    unit = "" if unit is None else unit
    require_value(isinstance(unit, str), "unit", 'a text such as "m/s"', unit)
    require_axes(ax)
    is_new, ax = ax is None, new_axes() if ax is None else ax
    r = np.union1d(np.linspace(0.0, speed, 401), min(end, speed))
    mu, static = np.asarray(_coefficient(friction, r)), float(friction.static)
    ax.axhline(0, color="0.7", linewidth=0.6)
    ax.axvline(0, color="0.7", linewidth=0.6)
    known, beyond = r <= end, r >= end
    for sign in (1, -1):
        ax.plot(sign * r[known], sign * mu[known], color="black", linewidth=1.4)
        if end < speed:
            style: dict[str, Any] = {"color": "black", "linewidth": 1.4, "linestyle": (0, (2, 1.5))}
            style["label"] = "extrapolated" if sign > 0 else None
            ax.plot(sign * r[beyond], sign * mu[beyond], **style)
            ax.axvline(sign * end, color="0.5", linewidth=0.7, linestyle=":")
    ax.plot([0, 0], [-static, static], color="black", linewidth=1.4)
    ax.set_xlim(-speed, speed)
    symbol = "R" if unit else r"\nu_{\mathrm{R}}"
    ax.set_xlabel(f"relative velocity ${symbol}$" + f" ({unit})" * bool(unit))
    ax.set_ylabel(rf"friction coefficient $\mu\,\mathrm{{sgn}}\,{symbol}$")
    if is_new:
        add_key(ax)
    return ax


def plot_convergence(
    widths: np.ndarray, errors: dict[str, np.ndarray], ax: Axes | None = None
) -> Axes:
    """Draws the largest error of approximate formulations over the width of their band.

    widths: half-widths [n]. errors: [n] each, by label. A thin line has slope 1. Returns the axes.
    """
    ax = new_axes() if ax is None else ax
    for belt, (label, values) in enumerate(errors.items()):
        marker = ("o", "s", "^", "D")[belt % 4]
        ax.loglog(widths, values, marker=marker, color=belt_colour(belt), label=label)
    smallest = min(values.min() for values in errors.values())
    guide = 0.4 * smallest * widths / widths.min()
    ax.loglog(widths, guide, color="0.5", linewidth=0.7, linestyle=":", label="slope 1")
    ax.set_xlabel(r"half-width of the band $v_\ast$ or $\varepsilon$")
    ax.set_ylabel(r"largest error of $(x_1, x_2)$")
    ax.legend(frameon=False)
    return ax


def draw_mechanical_model(ax: Axes | None = None) -> Axes:
    """Draws the double-belt oscillator, Fig. 1 of the paper: a mass on spring and dashpot, two
    belts.

    The mass touches belt 0 while x < sigma1 and belt 1 while x > sigma0, the overlapping class (d).
    Returns the axes.
    """
    ax = new_axes() if ax is None else ax
    ax.set(xlim=(-0.2, 10.6), ylim=(-4.75, 4.1), aspect="equal")
    ax.axis("off")
    line = {"color": "black", "linewidth": 1.0, "solid_capstyle": "butt"}
    x_mass, sigma0, sigma1 = 5.7, 4.3, 7.6

    # The axis of x, and the lines at which the belts end.
    _draw_arrow(ax, (3.0, -4.0), (9.4, -4.0))
    ax.text(9.55, -4.0, "$x$", ha="left", va="center")
    for x, top, name in (
        (sigma0, 1.3, r"$\sigma_0$"),
        (x_mass, -1.3, "$x(t)$"),
        (sigma1, -1.3, r"$\sigma_1$"),
    ):
        ax.plot([x, x], [-4.1, top], color="0.45", linewidth=0.7, linestyle=":", zorder=0)
        ax.plot([x, x], [-4.1, -3.9], **line)
        ax.text(x, -4.2, name, ha="center", va="top")

    # Fixed support, spring k, dashpot c.
    ax.plot([0.3, 0.3], [-1.1, 1.1], **line)
    for y in np.linspace(-0.8, 1.1, 7):
        ax.plot([0.3, 0.0], [y, y - 0.3], color="black", linewidth=0.6)
    coil = np.array([0.5, *([0.9, 0.1] * 4), 0.5])
    ax.plot([0.3, *np.linspace(1.3, 3.5, coil.size), 4.8], [0.5, *coil, 0.5], **line)
    ax.plot([0.3, 1.4], [-0.5, -0.5], **line)
    ax.plot([2.1, 1.4, 1.4, 2.1], [-0.2, -0.2, -0.8, -0.8], **line)
    ax.plot([1.8, 1.8], [-0.72, -0.28], color="black", linewidth=2.0, solid_capstyle="butt")
    ax.plot([1.8, 4.8], [-0.5, -0.5], **line)
    ax.text(2.4, 1.05, "$k$", ha="center", va="bottom")
    ax.text(1.75, -0.95, "$c$", ha="center", va="top")

    # The mass, with a foot on each side at x, where it touches the belts.
    ax.add_patch(Rectangle((4.8, -0.9), 1.8, 1.8, facecolor="0.9", edgecolor="black", lw=1.0))
    for side in (1, -1):
        foot = [(-0.3, 0.9), (-0.15, 1.3), (0.15, 1.3), (0.3, 0.9)]
        corners = [(x_mass + x, side * y) for x, y in foot]
        ax.add_patch(Polygon(corners, facecolor="0.55", edgecolor="black", lw=0.8))
    ax.text(x_mass, 0.0, "$m$", ha="center", va="center")

    _draw_belt(ax, 0, (3.1, sigma1), run=-1.3, side=-1, force_at=x_mass)
    _draw_belt(ax, 1, (sigma0, 8.8), run=1.3, side=1, force_at=x_mass)
    return ax


def _draw_belt(ax: Axes, belt: int, ends, run: float, side: int, force_at: float) -> None:
    """Draws a belt on two rollers: touching side at height `run`, the rest at `side` (1: above)."""
    radius, colour = 0.6, belt_colour(belt)
    middle, far = run + side * radius, run + side * 2 * radius
    angle = np.linspace(np.pi / 2, 3 * np.pi / 2, 40)
    loop_x = np.concatenate([ends[0] + radius * np.cos(angle), ends[1] - radius * np.cos(angle)])
    loop_y = np.concatenate([middle + radius * np.sin(angle), middle - radius * np.sin(angle)])
    ax.add_patch(
        Polygon(
            np.column_stack([loop_x, loop_y]), facecolor="white", edgecolor=colour, lw=1.8, zorder=2
        )
    )
    for x in ends:
        ax.add_patch(Circle((x, middle), 0.4, facecolor="0.9", edgecolor="black", lw=0.8, zorder=3))
        ax.add_patch(Circle((x, middle), 0.07, facecolor="black", zorder=4))
    centre = (ends[0] + ends[1]) / 2
    text = {"va": "center", "color": colour, "zorder": 4}
    ax.text(centre, middle + side * 0.26, f"belt {belt}", ha="center", fontsize="small", **text)
    at = run + side * 0.3
    _draw_arrow(ax, (centre - 0.8, at), (centre + 0.4, at), color=colour)
    ax.text(centre + 0.55, at, rf"$\nu_{belt}$", ha="left", **text)
    # The normal force presses the belt against the mass.
    _draw_arrow(ax, (force_at, far + side * 1.05), (force_at, far + side * 0.06))
    ax.text(
        force_at + 0.2, far + side * 0.65, rf"$F_{{\mathrm{{n}}{belt}}}$", ha="left", va="center"
    )


def _draw_arrow(ax: Axes, start, end, color: str = "black") -> None:
    style = {"arrowstyle": "-|>", "color": color, "linewidth": 1.0, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", xy=end, xytext=start, arrowprops={**style, "mutation_scale": 8}, zorder=5)
