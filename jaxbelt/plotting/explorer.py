"""An oscillator with a slider for each of its numbers, in a notebook: `explore`."""

import io
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..activity import announced
from ..checks import as_numbers, check_finite, check_positive
from ..model.friction import LawInUnits
from ..model.machine import Machine, PhysicalBelt, Units
from ..model.oscillator import Oscillator, check_oscillator, refuse_clock
from ..model.parameters import names_of
from ..motion.simulate import simulate
from ..results import Status, describe
from .histories import plot_time_history
from .model import plot_friction_law
from .phase import plot_phase_portrait
from .si import plot_in_si
from .style import belt_colour

#: Smallest ranges of sliders by the end of a name; others have 0 to 1. Every range is extended to
#: include twice the initial value.
RANGES = {
    "friction.velocity": (0.0, 1.0),
    "velocity": (-1.0, 1.0),
    "lower": (-2.0, 2.0),
    "upper": (-2.0, 2.0),
    "steepness": (0.0, 20.0),
    "omega": (0.1, 2.0),
    "x1": (-4.0, 4.0),
    "x2": (-3.0, 3.0),
}


class Explorer:
    """Sliders beside a picture of the motion, which follows them; see `explore`.

    A cell of a notebook that ends in an explorer shows it.

    Attributes:
        sliders: Widgets of ipywidgets by name, one for each finite number of the oscillator or
            machine ("damping", "belts[0].velocity") and for the start ("x1", "x2").
        figure: The figure.
        message: How the run ended, or why there is none.
        widget: Sliders and picture together.
    """

    def __init__(self, osc: Oscillator | Machine, start: tuple[float, float], t1: float):
        try:
            import ipywidgets
        except ImportError:
            raise ImportError("explore needs ipywidgets: pip install ipywidgets") from None

        self._leaves, self._structure = jax.tree.flatten(osc)
        self._names, self._t1 = names_of(osc), t1
        numbers = dict(zip(self._names, map(float, self._leaves), strict=True))
        for number, belt in enumerate(osc.belts):
            # the unit of speeds is not a parameter of the law and gets no slider
            if isinstance(belt.friction, LawInUnits):
                numbers.pop(f"belts[{number}].friction.unit")
        numbers |= {"x1": start[0], "x2": start[1]}
        units = osc.units if isinstance(osc, Machine) else None
        self.sliders = {
            name: _slider(ipywidgets, name, value, units)
            for name, value in numbers.items()
            if np.isfinite(value)
        }
        self.figure = Figure(figsize=(8.4, 4.6), dpi=80, layout="constrained")
        halves: Any = self.figure.subfigures(1, 2, width_ratios=(1, 1.15))
        beside = halves[0].subplots(2, height_ratios=(2, 1))
        self._axes = *beside, *halves[1].subplots(2, sharex=True)
        self.message = ipywidgets.Label()
        self._picture = ipywidgets.Image(format="png")
        for slider in self.sliders.values():
            slider.observe(self._follow, names="value")
        column = ipywidgets.VBox(list(self.sliders.values()))
        self.widget = ipywidgets.HBox([column, ipywidgets.VBox([self._picture, self.message])])
        self.redraw()

    @property
    def shown(self) -> Oscillator | Machine:
        """The oscillator or machine that the sliders show; raises a `ValueError` if it is
        impossible."""
        values = [
            jnp.asarray(self.sliders[name].value) if name in self.sliders else leaf
            for name, leaf in zip(self._names, self._leaves, strict=True)
        ]
        shown = jax.tree.unflatten(self._structure, values)
        if isinstance(shown, Machine):  # built again, so that its checks run
            belts = [PhysicalBelt(**vars(belt)) for belt in shown.belts]
            return Machine(shown.mass, shown.stiffness, shown.damping, belts, shown.forcing)
        check_oscillator(shown)
        return shown

    @property
    def oscillator(self) -> Oscillator:
        """The oscillator that the sliders show; raises a `ValueError` if it is impossible."""
        shown = self.shown
        osc = shown.oscillator if isinstance(shown, Machine) else shown
        check_oscillator(osc)
        return osc

    def redraw(self) -> None:
        """Draws the motion of the oscillator that the sliders show."""
        try:
            shown, osc = self.shown, self.oscillator
        except ValueError as error:
            self.message.value = str(error)
            return
        start, t1 = (self.sliders["x1"].value, self.sliders["x2"].value), self._t1
        if isinstance(shown, Machine):
            start, t1 = shown.start(*start), shown.tau(t1)
        run = simulate(osc, start, t1)
        portrait, laws, upper, lower = self._axes
        for axes in self._axes:
            _empty(axes)
            axes.autoscale(True)
        plot_phase_portrait(osc, run, ax=portrait)
        _draw_laws(shown, laws)
        plot_time_history(run, (upper, lower))
        if isinstance(shown, Machine):
            plot_in_si([portrait, upper, lower], shown)
        page = io.BytesIO()
        # print_png draws once; savefig draws twice.
        FigureCanvasAgg(self.figure).print_png(page)
        # The layout is computed once: it takes as long as all the rest, and nothing should jump.
        self.figure.set_layout_engine("none")
        self._picture.value = page.getvalue()
        self.message.value = f"{Status(int(run.status)).name}: {describe(run.status)}"

    def _follow(self, _: Any) -> None:
        self.redraw()

    def _ipython_display_(self) -> None:
        from IPython.display import display

        display(self.widget)


@announced("explore")
def explore(
    osc: Oscillator | Machine,
    start: ArrayLike | tuple | None = None,
    *,
    t1: ArrayLike | None = None,
) -> Explorer:
    """A live picture of an oscillator, in a notebook, with a slider for each of its numbers.

    Phase portrait, time history and friction laws are drawn anew as the sliders move.

    Args:
        osc: An `Oscillator`, or a `Machine`, for which sliders and pictures are in SI units.
        start: State (x1, x2) at the beginning, dimensionless (None: 1.5 units of length, at rest);
            for a `Machine` in m and m/s.
        t1: End of the motion in dimensionless time (None: 60); for a `Machine` in s.

    Returns:
        An object with `sliders` by name, the `oscillator` that they show, its `figure`, and a
        `message` that says how the run ended.

    Raises:
        ImportError: If ipywidgets is not installed.
        ValueError: If an argument is impossible; the message names it.
    """
    length, time = 1.0, 1.0
    if isinstance(osc, Machine):
        length, time = float(osc.units.length), float(osc.units.time)
    else:
        check_oscillator(osc)
    refuse_clock(osc.oscillator if isinstance(osc, Machine) else osc, "explore", "jb.simulate")
    start = (1.5 * length, 0.0) if start is None else start
    t1 = 60.0 * time if t1 is None else t1
    state, until = as_numbers(start, "start", (2,)), as_numbers(t1, "t1")
    check_finite(state, "start")
    check_positive(until, "t1")
    return Explorer(osc, (float(state[0]), float(state[1])), float(until))


def _empty(ax: Axes) -> None:
    """Removes what was drawn and keeps the axes: making new ones takes longer."""
    legend = [ax.get_legend()] if ax.get_legend() is not None else []
    for artist in [*ax.lines, *ax.patches, *ax.collections, *ax.texts, *legend]:
        artist.remove()
    ax.relim()


def _slider(ipywidgets: Any, name: str, value: float, units: Units | None) -> Any:
    *_, last = path = name.split(".")
    least, most = RANGES.get(".".join(path[-2:]), RANGES.get(last, (0.0, 1.0)))
    if units is not None:
        # A machine scales RANGES by its units; other numbers range to twice their initial value.
        quantity = {"x1": "length", "lower": "length", "upper": "length", "x2": "velocity"}
        quantity |= {"velocity": "velocity"}
        unit = float(getattr(units, quantity[last])) if last in quantity else 0.0
        least, most = (unit * end for end in (least, most))
        if last in ("mass", "stiffness"):
            least = 0.1 * value
    least, most = min(least, 2 * value), max(most, 2 * value)
    most = most if most > least else 1.0
    return ipywidgets.FloatSlider(
        value,
        description=name.removeprefix("belts"),
        min=least,
        max=most,
        step=(most - least) / 400,
        readout_format=".3g",
        style={"description_width": "9em"},
    )


def _draw_laws(shown: Oscillator | Machine, ax: Any) -> None:
    speed = 2.0 * float(shown.units.velocity) if isinstance(shown, Machine) else 2.0
    for number, belt in enumerate(shown.belts):
        before = len(ax.lines)
        law = belt if isinstance(belt, PhysicalBelt) else belt.friction
        plot_friction_law(law, ax, speed=speed)
        for line in ax.lines[before:]:
            line.set_color(belt_colour(number) if len(line.get_xdata()) > 2 else "0.7")
    symbol = "R" if isinstance(shown, Machine) else r"\nu_{\mathrm{R}}"
    ax.set_ylabel(rf"$\mu\,\mathrm{{sgn}}\,{symbol}$")
