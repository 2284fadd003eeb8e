"""Periodic motions of forced oscillators, and Lyapunov exponents."""

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from ..checks import require
from ..cycles.exponents import Exponents
from ..cycles.periodic import PeriodicMotion
from ..model.oscillator import at_time
from ..results import Status
from ..tables import require_single
from .style import BELT_COLOURS, new_axes

#: Points of a curve, for each period of the forcing.
SAMPLES_OF_PERIOD = 257


def plot_motion(motion: PeriodicMotion, ax: Axes | None = None) -> Axes:
    """Draws a periodic motion in the phase plane, dashed where it is unstable, with a dot at the
    phase 0 of each period, and the velocities of belts that run steadily."""
    require_single(motion, motion.residual, 0)
    status = Status(int(motion.status))
    require(status == Status.OK, "motion", "one with status OK, to be drawn", status.name)
    ax = new_axes() if ax is None else ax
    states = np.asarray(motion.sample(SAMPLES_OF_PERIOD * motion.periods))
    style = "-" if bool(motion.stable) else "--"
    ax.plot(*states.T, color="black", linestyle=style, linewidth=1.2)
    ax.plot(*np.asarray(motion.starts).T, "o", color="black", markersize=4, label="phase 0")
    osc = motion.oscillator
    for number, belt in enumerate(at_time(osc, jnp.zeros(())).belts):
        if type(belt).__name__ == "Belt":
            velocity = float(belt.velocity) / float(osc.omega)
            colour = BELT_COLOURS[number % len(BELT_COLOURS)]
            ax.axhline(velocity, color=colour, linewidth=0.8, label=f"belt {number}")
    ax.set_xlabel("displacement $x_1$")
    ax.set_ylabel("velocity $x_2$")
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
