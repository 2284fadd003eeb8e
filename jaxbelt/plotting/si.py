"""Pictures in SI units: the axes of any picture of this package, relabelled."""

import re
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import AutoLocator, FuncFormatter

from ..checks import require
from ..model.machine import Units
from ..si import AlongParameter, check_machine, units_along, units_of
from .draw import draw_result
from .style import figure_of, in_fractions, parameter_label, require_axes

#: By the beginning of its label, what an axis shows, and its label in SI units.
LABELS = {
    "time": ("time", "time $t$ (s)"),
    "period": ("time", "period (s)"),
    "displacement $x_1$": ("length", "displacement $X$ (m)"),
    "amplitude": ("length", "amplitude (m)"),
    "velocity $x_2$": ("velocity", r"velocity $\dot X$ (m/s)"),
    "relative velocity": ("velocity", r"relative velocity $R$ (m/s)"),
}
#: Parameters of an oscillator that have another symbol in SI units, by the end of their path.
SI_PARAMETERS = {
    "damping": "damping $c$",
    "velocity": "belt velocity $V_%$",
    "load": "normal force $N_%$",
}


#: A displacement in a key: where the mass rests, see `basins`.
REST = re.compile(r"(?<=rest at )-?\d+\.\d+$")


class _RoundInUnits(AutoLocator):
    """Ticks where value times unit is a round number."""

    def __init__(self, unit: float):
        super().__init__()
        self.unit = unit

    def tick_values(self, vmin: float, vmax: float) -> Any:
        return np.asarray(super().tick_values(vmin * self.unit, vmax * self.unit)) / self.unit


def plot_in_si(result: Any, machine: Any, ax: Axes | None = None, **options: Any) -> Any:
    """A picture with times in s, displacements in m and velocities in m/s, also in its key.

    result: of the machine's oscillator, anything that has a `.plot()`, drawn into the axes (None:
    new ones); or the axes, one or several, that another function of this package has drawn into.
    machine: the `Machine`, or its units alone, see `in_si`; for a diagram or fractions along the
    argument of a function, a function of that which returns it. options: of that `.plot()`. Returns
    the axes.

    The parameter of a diagram or of fractions is in SI units, too: that of a function's argument as
    the function takes it, whose unit only you know: `ax.set_xlabel("belt velocity $V$ (m/s)")`.
    Other axes that show something else, or tell their unit, stay as they are. `ValueError` where
    no axis can be converted, as in the picture of a sweep (draw what `in_si` returns instead),
    where the units vary along the parameter, and for a wrong argument.
    """
    require_axes(ax)
    units, parameter = _units_of_picture(result, machine)
    several = isinstance(result, Sequence) and all(isinstance(one, Axes) for one in result)
    is_drawn = isinstance(result, Axes) or several
    axes: Any = result if is_drawn else draw_result(result, ax, **options)
    every = [axes] if isinstance(axes, Axes) else list(axes)
    done = [_relabel(axis, units) for one in every for axis in (one.xaxis, one.yaxis)]
    if parameter is not None:
        unit, label = parameter
        _rescale(axes.xaxis, unit, label)
    expected = (
        "a picture with an axis of time, displacement, velocity, amplitude or period (that of a "
        "sweep is jb.plot_sweep(jb.in_si(dataset, machine), ...))"
    )
    shown = [repr(axis.get_label_text()) for one in every for axis in (one.xaxis, one.yaxis)]
    fits = any(done) or isinstance(result, AlongParameter)
    require(fits, "result", expected, f"axes of {', '.join(shown)}")
    for one in every:
        _relabel_key(one, units)
    return axes


def _units_of_picture(result: Any, machine: Any) -> tuple[Units, tuple[float, str] | None]:
    """The units of a picture; and of its parameter what 1 is, and its label, where it has one that
    is not in SI units anyway."""
    if not isinstance(result, AlongParameter):
        check_machine(result, machine)
        return units_of(machine), None
    values = result.table()["value"].to_numpy(float)
    units, (symbol, size) = units_along(result, values, machine)
    check_machine(result, machine)
    vary = sorted(name for name, unit in vars(units).items() if np.ptp(np.asarray(unit)) > 0)
    expected = "along a parameter on which no unit depends (jb.in_si converts each row)"
    require(not vary, "result", expected, f"along {result.name}, with other {', '.join(vary)}")
    units = jax.tree.map(lambda unit: jnp.ravel(unit)[0], units)
    if symbol in ("", "1"):
        return units, None
    words = SI_PARAMETERS.get(result.name.rpartition(".")[2])
    if words is None or result.name.endswith("friction.velocity"):
        words = parameter_label(result.name)
    words = words.replace("%", result.name.partition("[")[2].partition("]")[0])
    return units, (size, f"{words} ({in_fractions(symbol)})")


def _relabel_key(ax: Axes, units: Units) -> None:
    unit = float(units.length)

    def in_m(found: re.Match) -> str:
        # With the digits that are known.
        digits = len(found[0].replace(".", "").lstrip("-0"))
        return f"{float(found[0]) * unit:.{max(1, digits)}g} m"

    for artist in ax.get_children():
        if REST.search(label := str(artist.get_label())):
            artist.set_label(REST.sub(in_m, label))
    for key in [ax.get_legend(), *figure_of(ax).legends]:
        for text in key.get_texts() if key else ():
            text.set_text(REST.sub(in_m, text.get_text()))


def _relabel(axis: Axis, units: Units) -> bool:
    """Put an axis in SI units, if it shows one quantity that has some; whether it does."""
    text = axis.get_label_text()
    if text.endswith(")"):  # it tells its unit
        return False
    shown = [
        LABELS[begins] for part in text.split(", ") for begins in LABELS if part.startswith(begins)
    ]
    if len(shown) != 1:  # two quantities on one axis have no common unit
        return False
    ((quantity, label),) = shown
    _rescale(axis, float(getattr(units, quantity)), label)
    return True


def _rescale(axis: Axis, unit: float, label: str) -> None:
    axis.set_major_locator(_RoundInUnits(unit))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value * unit:.6g}"))
    axis.set_label_text(label)
