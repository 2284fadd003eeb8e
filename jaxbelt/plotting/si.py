"""Pictures in SI units: any picture of this package in s, m and m/s."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import Collection
from matplotlib.lines import Line2D
from matplotlib.text import Annotation, Text
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Affine2D, Bbox, Transform

from ..bifurcations.base import BifurcationPoint
from ..bifurcations.diagrams import BifurcationDiagram
from ..bifurcations.regions import RegionMap
from ..checks import require
from ..cycles.functionals import MEASURED_IN
from ..model.machine import SI_UNITS, Units
from ..si import INSTEAD, AlongParameter, check_machine, units_along, units_of
from ..sweeps.circle_map import CircleMap
from ..sweeps.naming import rest_in_m
from .diagrams import QUANTITIES
from .draw import draw_result
from .style import TIME, figure_of, in_fractions, parameter_label, require_axes

#: For each label of an axis: its quantity, and its label in SI units.
LABELS = {
    TIME: ("time", "time $t$ (s)"),
    QUANTITIES["period"]: ("time", "period (s)"),
    QUANTITIES["x1"]: ("length", "displacement $X$ (m)"),
    QUANTITIES["amplitude"]: ("length", "amplitude of $X$ (m)"),
    QUANTITIES["x2"]: ("velocity", r"velocity $\dot X$ (m/s)"),
    r"relative velocity $\nu_{\mathrm{R}}$": ("velocity", r"relative velocity $R$ (m/s)"),
}
#: Labels in SI units of parameters of an oscillator, by the end of their path.
SI_PARAMETERS = {
    "damping": "damping $c$",
    "velocity": "belt velocity $V_%$",
    "load": "normal force $N_%$",
}


def plot_in_si(result: Any, machine: Any, ax: Axes | None = None, **options: Any) -> Any:
    """Draws a picture with times in s, displacements in m and velocities in m/s, also in its key.

    Limits and coordinates of the axes are in SI units, so that a measurement can be drawn over the
    picture: `ax.plot(t_in_s, X_in_m)`; what was in `ax` before is taken to be in SI units. Where
    one axis shows displacement and velocity, as in the picture of a trajectory, it becomes that of
    displacement, and velocity gets its own axis at the right, in other axes of the same figure.

    The parameter of a diagram or of fractions is in SI units, too; an argument of a function stays
    as the function takes it, and you label it: `ax.set_xlabel("belt velocity $V$ (m/s)")`. A
    `quantity` is in SI units where it is a functional of this package, such as `energy_fed`, also
    in `functools.partial`; the values of your own function stay as they are, and the label says
    "(dimensionless)". Other axes that show something else, or name their unit, stay as they are.
    The title of a `BifurcationPoint` names its kind only, as the unit of its value is not known.

    Args:
        result: A result of the machine's oscillator with a `.plot()`; or the axes, one or several,
            that another function of this package has drawn into.
        machine: The `Machine`, or its units alone, see `in_si`; for a diagram or fractions along
            the argument of a function, a function of that argument that returns the machine.
        ax: Axes for the `.plot()` of the result; None makes new ones.
        options: Options of that `.plot()`.

    Returns:
        The axes.

    Raises:
        ValueError: If no axis can be converted, as in the picture of a sweep (draw what `in_si`
            returns instead), if the units vary along the parameter, or if an argument is
            impossible.
    """
    require_axes(ax)
    is_without = isinstance(result, RegionMap | CircleMap)
    came = f"a {type(result).__name__}{INSTEAD.get(type(result), '')}"
    require(not is_without, "result", "one with a dimension in its picture", came)
    units, parameter = _units_of_picture(result, machine)
    is_list = isinstance(result, Sequence | np.ndarray)
    several = is_list and all(isinstance(one, Axes) for one in result)
    is_drawn = isinstance(result, Axes) or several
    picture = _Picture(units)
    if ax is not None and not is_drawn:
        picture.convert([ax])
        picture.keep(ax)
    try:
        axes: Any = result if is_drawn else draw_result(result, ax, **options)
        every = [axes] if isinstance(axes, Axes) else list(axes)
        shown = [repr(axis.get_label_text()) for one in every for axis in (one.xaxis, one.yaxis)]
        is_done = picture.convert(every)
        quantity = options.get("quantity")
        if isinstance(result, BifurcationDiagram) and callable(quantity) and not is_done:
            picture.convert_functional(axes, quantity)
        if parameter is not None:
            picture.scale(axes, 0, *parameter)
        if isinstance(result, BifurcationPoint):
            # The unit of its value is not known: a point does not record its parameter.
            axes.title.set_text(result.condition.words)
    finally:
        picture.join()
    # Axes do not record which functional, parameter or result they show.
    expected = (
        "a picture with an axis of time, displacement, velocity, amplitude or period, or what it "
        "shows itself: jb.plot_in_si(diagram, machine, quantity=jb.stick_fraction), "
        "jb.plot_sweep(jb.in_si(dataset, machine), ...)"
    )
    fits = is_done or isinstance(result, AlongParameter)
    require(fits, "result", expected, f"axes of {', '.join(shown)}")
    for one in every:
        _relabel_key(one, units)
    return axes


def _units_of_picture(result: Any, machine: Any) -> tuple[Units, tuple[float, str] | None]:
    """Units of a picture; and for its parameter (size of the unit in SI, label of the axis).

    The latter is None without a parameter, and where the unit of the parameter is 1 or unknown.
    """
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
    for artist in ax.get_children():
        if (words := rest_in_m(label := str(artist.get_label()), units.length)) != label:
            artist.set_label(words)
    for key in [ax.get_legend(), *figure_of(ax).legends]:
        for text in key.get_texts() if key else ():
            words = rest_in_m(text.get_text(), units.length)
            text.set_text(words.replace("$x_1$", "$X$").replace("$x_2$", r"$\dot X$"))


class _Picture:
    """Converts axes to SI units, except artists in SI units that one of them held before."""

    def __init__(self, units: Units):
        self.units, self.ax = units, None
        self.kept: set[Artist] = set()

    def keep(self, ax: Axes) -> None:
        """Records artists and limits of axes before a drawing; these artists stay unscaled."""
        self.ax, self.kept = ax, {*_artists(ax)}
        self.limits = ax.get_xlim(), ax.get_ylim()
        self.held = ax.dataLim.get_points().copy()
        ax.dataLim.set_points(Bbox.null().get_points())

    def join(self) -> None:
        """Extends automatic limits to hold what was there before and what is new, both in SI
        units."""
        if self.ax is None:
            return
        lower, upper = zip(self.held, self.ax.dataLim.get_points(), strict=True)
        self.ax.dataLim.set_points(np.array([np.min(lower, axis=0), np.max(upper, axis=0)]))
        self.ax.autoscale_view()

    def convert(self, every: Sequence[Axes]) -> bool:
        """Converts axes that show a quantity with a unit; returns whether there are any."""
        is_any = False
        for one in every:
            for number in (0, 1):
                shown = _axis(one, number).get_label_text().split(", ")
                if not all(part in LABELS for part in shown):
                    continue
                quantity, label = LABELS[shown[0]]
                if len(shown) == 2:
                    self.put_velocity_aside(one, LABELS[shown[1]][1])
                self.scale(one, number, float(getattr(self.units, quantity)), label)
                is_any = True
        return is_any

    def convert_functional(self, ax: Axes, functional: Callable) -> None:
        """Converts the values of a functional of cycles where their unit is known."""
        name, coordinate = ax.get_ylabel(), "x1"
        if isinstance(functional, functools.partial):
            coordinate = functional.keywords.get("coordinate", coordinate)
            functional = functional.func
        # Compared by identity, because a user's functional may have no hash.
        known = [quantity for one, quantity in MEASURED_IN.items() if one is functional]
        if not known:
            ax.set_ylabel(f"{name} (dimensionless)")
        elif (quantity := known[0]) != "number":
            if quantity == "coordinate":
                quantity = {"x1": "length", "x2": "velocity"}[coordinate]
            symbol, size = SI_UNITS[quantity]
            self.scale(ax, 1, float(size(self.units)), f"{name} ({in_fractions(symbol)})")

    def put_velocity_aside(self, ax: Axes, label: str) -> None:
        """Moves the velocities of axes that show displacements, too, to an axis at the right."""
        unit, limits = float(self.units.velocity), ax.get_ylim()
        lines = [line for line in ax.lines if "$x_2$" in str(line.get_label())]
        aside = _right_of(ax, label)
        for line in lines:
            if line not in self.kept:
                _scale_artist(line, ax, np.array([1.0, unit]))
                line.remove()
                line.set_transform(aside.transData)
                aside.add_line(line)
        ax.relim()
        if self.ax is None:
            aside.set_ylim(limits[0] * unit, limits[1] * unit, auto=None)
        else:
            aside.autoscale_view(scalex=False)

    def scale(self, ax: Axes, number: int, unit: float, label: str) -> None:
        """Scales what is drawn along the x (0) or y axis (1), and its limits."""
        sizes = np.where(np.arange(2) == number, unit, 1.0)
        limits = (ax.get_xlim(), ax.get_ylim())[number]
        shared = (ax.get_shared_x_axes, ax.get_shared_y_axes)[number]().get_siblings(ax)
        for one in shared if self.ax is None else [ax]:
            one.dataLim.set_points(one.dataLim.get_points() * sizes)
            for artist in _artists(one):
                if artist not in self.kept:
                    _scale_artist(artist, one, sizes)
            if _axis(one, number).get_label_text():
                _axis(one, number).set_label_text(label)
        if self.ax is None or limits != self.limits[number]:
            first, last = limits
            (ax.set_xlim, ax.set_ylim)[number](first * unit, last * unit, auto=None)
        if number == 0:
            # Numbers such as 0.0015 need more room than Matplotlib leaves between them.
            count = max(2, int(0.65 * ax.xaxis.get_tick_space()))
            ax.xaxis.set_major_locator(MaxNLocator(count, steps=[1, 2, 5, 10]))


def _right_of(ax: Axes, label: str) -> Axes:
    """The axes with this label on top of others; made if they do not exist."""
    for one in ax.get_shared_x_axes().get_siblings(ax):
        here = np.allclose(one.get_position().bounds, ax.get_position().bounds)
        if one is not ax and here and one.get_ylabel() == label:
            return one
    aside = ax.twinx()
    aside.set_xmargin(ax.get_xmargin())
    aside.set_ylabel(label)
    return aside


def _axis(ax: Axes, number: int) -> Axis:
    return (ax.xaxis, ax.yaxis)[number]


def _artists(ax: Axes) -> list[Artist]:
    return [*ax.lines, *ax.patches, *ax.collections, *ax.images, *ax.texts]


def _scale_artist(artist: Artist, ax: Axes, sizes: np.ndarray) -> None:
    """Scales the coordinates of an artist that are in units of the data, by sizes (x, y)."""
    # Matplotlib before 3.11 misspells the name of this method.
    names = ("contains_branch_separately", "contains_branch_seperately")
    in_data = next(name for name in names if hasattr(Transform, name))

    def of_data(transform: Any) -> np.ndarray:
        transform = ax.transData if transform == "data" else transform
        known = isinstance(transform, Transform)
        return np.where(known and getattr(transform, in_data)(ax.transData), sizes, 1.0)

    def scaled(place: Any, transform: Any) -> tuple[float, float]:
        x, y = place * of_data(transform)
        return float(x), float(y)

    # The method of the base class: that of a patch would include the patch's own shape.
    transform = Artist.get_transform(artist)
    for edges, size in zip(artist.sticky_edges, of_data(transform), strict=True):
        edges[:] = [edge * size for edge in edges]
    match artist:
        case Line2D():
            x, y = np.transpose(artist.get_xydata())
            by_x, by_y = of_data(transform)
            artist.set_data(x * by_x, y * by_y)
        case Annotation():
            artist.xy = scaled(artist.xy, artist.xycoords)
            artist.xyann = scaled(artist.xyann, artist.anncoords)
        case Text():
            artist.set_position(scaled(artist.get_position(), transform))
        case _:
            artist.set_transform(Affine2D().scale(*of_data(transform)) + transform)
    if isinstance(artist, Collection):
        offsets = artist.get_offset_transform()
        artist.set_offset_transform(Affine2D().scale(*of_data(offsets)) + offsets)
