"""Pictures in SI units: the axes of any picture of this package, relabelled."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import AutoLocator, FuncFormatter

from ..checks import require
from ..model.machine import Machine
from .draw import draw_result
from .style import figure_of

#: By the beginning of its label, what an axis shows, and its label in SI units.
LABELS = {
    "time": ("time", "time $t$ (s)"),
    "period": ("time", "period (s)"),
    "displacement": ("length", "displacement $X$ (m)"),
    "amplitude": ("length", "amplitude (m)"),
    "velocity $x_2$": ("velocity", r"velocity $\dot X$ (m/s)"),
    "relative velocity": ("velocity", r"relative velocity $R$ (m/s)"),
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


def plot_in_si(result: Any, machine: Machine, ax: Axes | None = None, **options: Any) -> Any:
    """A picture with times in s, displacements in m and velocities in m/s, also in its key.

    result: of the machine's oscillator, anything that has a `.plot()`, drawn into the axes (None:
    new ones); or the axes, one or several, that another function of this package has drawn into.
    options: of that `.plot()`. Returns the axes. Axes that show something else (a parameter, in
    the units of whoever varies it) stay as they are. `ValueError` names a wrong argument.
    """
    require(isinstance(machine, Machine), "machine", "a Machine", repr(machine))
    several = isinstance(result, Sequence) and all(isinstance(one, Axes) for one in result)
    is_drawn = isinstance(result, Axes) or several
    axes: Any = result if is_drawn else draw_result(result, ax, **options)
    for one in [axes] if isinstance(axes, Axes) else axes:
        _relabel(one.xaxis, machine)
        _relabel(one.yaxis, machine)
        _relabel_key(one, machine)
    return axes


def _relabel_key(ax: Axes, machine: Machine) -> None:
    unit = float(machine.units.length)

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


def _relabel(axis: Axis, machine: Machine) -> None:
    text = axis.get_label_text()
    shown = [
        LABELS[begins] for part in text.split(", ") for begins in LABELS if part.startswith(begins)
    ]
    if len(shown) == 1:  # two quantities on one axis have no common unit
        ((quantity, label),) = shown
        unit = float(getattr(machine.units, quantity))
        axis.set_major_locator(_RoundInUnits(unit))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value * unit:.6g}"))
        axis.set_label_text(label)
