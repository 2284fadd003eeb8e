"""Results in SI units: `in_si`.

The name of a variable determines its dimension. Variables with other names, such as results of a
user's observable, stay as they are.
"""

import functools
import inspect
import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Union

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .activity import announced
from .bifurcations.base import BifurcationPoint
from .bifurcations.curves import BifurcationCurve
from .bifurcations.diagrams import BifurcationDiagram
from .checks import in_words, outside_of_traces, require
from .cycles.cycle import Cycle
from .cycles.functionals import energy_dissipated
from .cycles.periodic import PeriodicMotion
from .cycles.portrait import Portrait
from .cycles.shocks import FatalShock
from .inverse.fit import Fit
from .model.equilibria import Equilibria
from .model.forcing import BaseMotion, ConstantForce, Harmonic
from .model.friction import LawInUnits
from .model.machine import Machine, Units
from .model.modes import STUCK, mode_acceleration, mode_of, stick_rate
from .model.oscillator import Oscillator, at_time, constant_force, wave_at
from .model.parameters import names_of
from .motion.simulate import Trajectory
from .results import EventKind, Status
from .sweeps.basins import Basins, BasinStability
from .sweeps.datasets import flags
from .sweeps.fractions import BasinFractions
from .sweeps.orbit_diagram import OrbitDiagram

if TYPE_CHECKING:
    import pandas
    import xarray

#: Dimensions of the variables of this package, by name.
DIMENSIONS = {
    **dict.fromkeys(("t", "t_event", "period", "transient", "stick_duration"), "time"),
    **dict.fromkeys(("x1", "x1_event", "x1_end", "x1_min", "x1_max", "amplitude"), "length"),
    **dict.fromkeys(("x2", "x2_event", "x2_end", "x2_min", "x2_max"), "velocity"),
    **{"x1_residual": "length", "x2_residual": "velocity"},
    **{"shock_x1": "length", "shock_x2": "velocity"},
    **{"x1_strobe": "length", "x2_strobe": "velocity"},
    **dict.fromkeys(("exponent", "exponent_error"), "rate"),
    "force": "force",
    "energy": "energy",
}
#: Units of the numbers of oscillators, by field: the unit, and the value of 1 in it.
UNITS_OF_FIELDS: dict[str, tuple[str, Callable[[Units], Any]]] = {
    "damping": ("N s m-1", lambda units: units.force / units.velocity),
    "velocity": ("m s-1", lambda units: units.velocity),
    "load": ("N", lambda units: units.force),
    **dict.fromkeys(("lower", "upper"), ("m", lambda units: units.length)),
    "frequency": ("rad s-1", lambda units: 1 / units.time),
    "phase": ("rad", lambda units: jnp.ones(())),
}
#: Likewise of the amplitude of a force; numbers of a user's force have units that its author knows.
UNITS_OF_FORCES = {
    **dict.fromkeys((Harmonic, ConstantForce), ("N", lambda units: units.force)),
    BaseMotion: ("m", lambda units: units.length),
}
#: Relative accuracy to which a number of a friction law has to follow a power of the unit of speed.
POWER_ROUNDING = 1e-12
#: Relative difference up to which numbers of a machine's oscillator and of a result's count as
#: equal: they may have been computed in different ways.
SAME_MACHINE = 1e-9
#: Results along a parameter.
AlongParameter = BifurcationDiagram | OrbitDiagram | BasinFractions
SYMBOLS = {
    **{"time": "s", "length": "m", "velocity": "m s-1", "force": "N", "energy": "J"},
    "rate": "s-1",
}


#: Where the mass rests, at the end of the words for an attractor of `basins`.
REST = re.compile(r"(?<=rest.at.)-?\d+(\.\d+)?(e[+-]\d+)?$")
#: Advice for results that `in_si` does not take.
INSTEAD = {
    BifurcationPoint: "; its value is in the unit of the argument where a function was given in "
    "place of an oscillator, else multiply it by machine.units.velocity, say; for its cycle write "
    "jb.in_si(point.cycle, machine(point.value))",
    BifurcationCurve: "; its values are in the units of the arguments where a function was given, "
    "else multiply them by machine.units.velocity, say",
    Equilibria: "; write jb.in_si(jb.portrait(osc), machine), which has them among its rows",
}


@announced("in_si")
@functools.partial(outside_of_traces, instead="; multiply by machine.units instead")
def in_si(
    result: Union[
        Trajectory,
        Cycle,
        PeriodicMotion,
        Portrait,
        FatalShock,
        Basins,
        BasinStability,
        Fit,
        BifurcationDiagram,
        OrbitDiagram,
        BasinFractions,
        "xarray.Dataset",
    ],
    machine: Machine | Units | Callable[..., Machine | Units],
) -> "xarray.Dataset":
    """A result in SI units, as a dataset whose variables carry their units.

    The variables are, for

    - a trajectory: `t` in s, `x1` in m, `x2` in m/s, `force`, the friction on the mass, in N (exact
      formulation only), and `mode` at each sample, after the event where a sample falls on one (the
      limit of a jump of the force from the left is no sample); `t_event`, `x1_event`, `x2_event`,
      `event_kind` and `event_belt`.
    - a cycle: `period`, `stick_duration` of each belt, `x1_min`, `x1_max`, `x2_min`, `x2_max`,
      `amplitude`, and `energy`, which friction and dashpot turn into heat in one period.
    - a forced motion: the same without `energy`, `x1` and `x2` at the phase 0, and `periods`.
    - a portrait: over `row`, the columns of its `table()`, `rate` in 1/s.
    - a shock: `x1` and `x2` of its start, `shock_x1`, `shock_x2`, and `distance`, in m/s where it
      changes the velocity alone. A distance that combines both stays dimensionless.
    - a basin stability: its `table()`, which has no units.
    - a fit: over `parameter`, the names in its table, `estimate`, `standard_error`, `lower` and
      `upper` (the confidence interval of 95 per cent), each in the `unit` beside it (a `load` is
      the normal force). A parameter of a user's friction law is in the power of m/s that follows
      from the law's `in_units_of`, or stays as the law has it, with the unit ""; so does one of a
      user's force. Over `t`: the fitted motion, `x1` and `x2`, and `x1_residual` and `x2_residual`,
      datum minus motion.
    - a diagram, or fractions: over `row`, the columns of its `table()`; a special point is a row
      with the branch -1. `value`, of the parameter, is in m/s for the velocity of a belt, in N for
      a load (the normal force), in m for a contact edge, in N s/m for the damping, in rad/s for the
      frequency of a force, in N for its amplitude (in m for that of a support); the argument of a
      function stays as the function takes it.
    - a dataset: its own variables, with derivatives by starts and parameters where the units are
      the same in all runs. Results of a user's observable stay dimensionless, and so does the
      attribute `start`; the words for `label` of basins say in m where the mass rests.

    Where a function was given in place of an oscillator, the value of a `BifurcationPoint` and
    those of a `BifurcationCurve` are in the units of its arguments already; the cycle at a point is
    `in_si(point.cycle, machine(point.value))`. `Equilibria` are among the rows of
    `in_si(portrait(osc), machine)`. Under `jit`, `vmap` and derivatives multiply by `machine.units`
    instead.

    Args:
        result: A result for the machine's oscillator: a `Trajectory`, a `Cycle`, a `Portrait`, a
            `PeriodicMotion`, a `FatalShock`, `Basins`, `BasinStability`, a `Fit`, a
            `BifurcationDiagram`, an `OrbitDiagram`, `BasinFractions`, or the dataset of a sweep.
        machine: The `Machine`. Where a sweep has axes other than starts, or a function was given in
            place of an oscillator: a function of these that returns the machine, as its units may
            differ from run to run. `machine.units` in place of the machine only converts and
            compares nothing, for an oscillator with other numbers in the same units; a trajectory
            then comes without `force`.

    Returns:
        The dataset, an `xarray.Dataset`.

    Raises:
        ValueError: If the oscillator of the machine is not that of the result, apart from what was
            fitted or varied. Of a trajectory, which keeps no oscillator, only the velocity at which
            it sticks is compared; of basin stabilities, fractions and datasets nothing.
        TypeError: If the result is of any other type.
    """
    import xarray

    one: Any = machine  # its type is checked where it is used
    match result:
        case Trajectory():
            return _trajectory(result, one)
        case Cycle() | PeriodicMotion():
            return _cycle(result, one)
        case Portrait():
            return _of_portrait(result, one)
        case FatalShock():
            return _of_shock(result, one)
        case Basins():
            check_machine(result, machine)
            return _dataset(result.dataset, machine)
        case BasinStability():
            return _rows_in_units(result.table(), units_of(machine))
        case Fit():
            return _fitted(result, one)
        case BifurcationDiagram() | OrbitDiagram() | BasinFractions():
            return _along(result, machine)
        case xarray.Dataset():
            present = {variable.attrs.get("units") for variable in result.variables.values()}
            is_done = bool(present & set(SYMBOLS.values()))
            require(not is_done, "result", "dimensionless", "a dataset that is in SI units")
            return _dataset(result, machine)
    raise TypeError(
        "result must be a Trajectory, a Cycle, a PeriodicMotion, a Portrait, a FatalShock, Basins, "
        "BasinStability, a Fit, a BifurcationDiagram, an OrbitDiagram, BasinFractions, or the "
        "dataset of a sweep, "
        f"got {type(result).__name__}{INSTEAD.get(type(result), '')}"
    )


def units_of(machine: Any) -> Units:
    """The units of a machine, or `machine` itself if it is units; a `ValueError` for anything
    else."""
    if isinstance(machine, Machine | Units):
        return machine if isinstance(machine, Units) else machine.units
    along = "what is along an argument of it: a diagram, fractions, the dataset of a sweep"
    hint = f"; a function is for {along}" if callable(machine) else ""
    raise ValueError(f"machine must be a Machine, got {in_words(machine)}{hint}")


def rest_in_m(words: str, units: Units) -> str:
    """The words for an attractor with the place of rest in m, to the digits that are known."""

    def in_m(found: re.Match) -> str:
        digits = len(found[0].partition("e")[0].replace(".", "").lstrip("-0"))
        return f"{float(found[0]) * float(units.length):.{max(1, digits)}g} m"

    return REST.sub(in_m, words)


def check_machine(result: Any, machine: Any) -> None:
    """Raises a `ValueError` if a result keeps its oscillator and that of the machine is another
    one.

    Parameters that were fitted, or varied along a path, may differ. For a function the oscillator
    at the first value is compared; for a trajectory, which keeps none, the belts; for units alone
    nothing.
    """
    free: set[str] = set()
    match result:
        case BifurcationDiagram() | OrbitDiagram() | BasinFractions():
            osc, free = _at_first_value(result), {result.name}
            if osc is None:
                return
            if result.is_argument:
                machine = machine(**{result.name: _first_value(result)})
        case Fit():
            osc = result.oscillator
            free = {name for tied in result.names for name in tied.split(" = ")}
        case Cycle() | PeriodicMotion() | Basins() | Portrait():
            osc = result.oscillator
        case FatalShock():
            osc = result.portrait.oscillator
        case Trajectory():
            _check_belts(result, machine)
            return
        case _:
            return
    if not isinstance(machine, Machine):
        return
    own, belts = machine.oscillator, len(osc.belts)
    require(len(own.belts) == belts, "machine", f"of {belts} belts", f"{len(own.belts)} belts")
    one, other = _numbers_of(own), _numbers_of(osc)
    for name in one.keys() | other.keys():
        require(name in one and name in other, "machine", "with the laws of the result", machine)
    for name, value in other.items():
        fits = name in free or np.allclose(one[name], value, rtol=SAME_MACHINE, atol=0)
        expected = f"the one of the result, whose oscillator has {name} = {value:.12g}"
        came = f"{one[name]:.12g}; in place of it machine.units takes its units alone"
        require(fits, "machine", expected, came)


def _first_value(result: BifurcationDiagram | OrbitDiagram | BasinFractions) -> float:
    is_diagram = isinstance(result, BifurcationDiagram)
    return float(result.regions[0][0] if is_diagram else result.values[0])


def _at_first_value(result: AlongParameter) -> Oscillator | None:
    """The oscillator of a result at the first value of its parameter, where it keeps one."""
    if isinstance(result, BifurcationDiagram):
        return result.oscillator
    if isinstance(result, OrbitDiagram) and result.sampling is not None:
        return result.sampling.variation.oscillator(np.array([_first_value(result)]))
    return None


def _numbers_of(osc: Oscillator) -> dict[str, float]:
    pairs = zip(names_of(osc), jax.tree.leaves(osc), strict=True)
    return {name: float(leaf) for name, leaf in pairs if np.ndim(leaf) == 0}


def _variable(dims: Any, values: Any, name: str, units: Units, long_name: str) -> tuple:
    quantity = DIMENSIONS[name]
    scaled = np.asarray(values) * np.asarray(getattr(units, quantity))
    return dims, scaled, {"long_name": long_name, "units": SYMBOLS[quantity]}


@jax.jit
def _friction_force(osc: Oscillator, codes: Array, ys: Array, ts: Array) -> Array:
    """Force of all belts on the mass, [samples], for modes [samples, belts], in k times length.

    It balances spring, dashpot, inertia and forcing; where the mass sticks it is accelerated with
    its belt.
    """

    def at(codes, y, t):
        now, mode, (x1, x2) = at_time(osc, t), mode_of(codes), y
        rate = stick_rate(now, mode) / osc.omega
        a = jnp.where(mode.any_stuck, rate, mode_acceleration(now, mode, x1, x2))
        return sum((-push for push in constant_force(now)), start=a + x1 + osc.damping * x2)

    return jax.vmap(at)(codes.astype(jnp.float64), ys, ts)


def _trajectory(run: Trajectory, machine: Machine | Units) -> "xarray.Dataset":
    import xarray

    units, belts = units_of(machine), run.modes.shape[-1]
    require(run.ts.ndim == 1, "result", "one trajectory, not a batch", repr(run))
    check_machine(run, machine)

    def variable(dims, values, name, long_name):
        return _variable(dims, values, name, units, long_name)

    events = run.events
    found = {
        "x1": variable("t", run.ys[:, 0], "x1", "displacement"),
        "x2": variable("t", run.ys[:, 1], "x2", "velocity"),
        "mode": (("t", "belt"), np.asarray(run.modes), {"long_name": "contact with the belt"}),
        "t_event": variable("event", events.t, "t", "time of the event"),
        "x1_event": variable("event", events.y[:, 0], "x1", "displacement at the event"),
        "x2_event": variable("event", events.y[:, 1], "x2", "velocity at the event"),
        "event_kind": (
            "event",
            np.asarray(events.kind, np.int8),
            flags({kind.value: kind.name.lower() for kind in EventKind}, "int8"),
        ),
        "event_belt": ("event", np.asarray(events.belt), {"long_name": "belt of the event"}),
    }
    if run.arcs.t.size and isinstance(machine, Machine):
        force = _friction_force(machine.oscillator, run.modes, run.ys, run.ts)
        found["force"] = variable("t", force, "force", "friction on the mass")
    time = variable("t", run.ts, "t", "time")
    attrs = {"status": Status(int(run.status)).name}
    return xarray.Dataset(found, {"t": time, "belt": np.arange(belts)}, attrs)


def _check_belts(run: Trajectory, machine: Any) -> None:
    """Raises if a trajectory does not fit the belts of a machine.

    It keeps no oscillator: compared are the number of belts, and the velocity at which it sticks.
    """
    if not isinstance(machine, Machine):
        return
    osc, own = machine.oscillator, len(machine.belts)
    fits = np.asarray(run.modes).shape[-1] == own
    require(fits, "result", f"of a machine of {own} belts", repr(run))
    if run.ts.ndim != 1 or not run.arcs.t.size:
        return
    stuck = np.asarray(run.modes) == STUCK
    for belt, held in enumerate(stuck.T):
        velocity = np.asarray(wave_at(osc.belts[belt].velocity, run.ts))
        own, its = np.broadcast_to(velocity, held.shape)[held], np.asarray(run.ys)[held, 1]
        fits = np.allclose(its, own, rtol=SAME_MACHINE, atol=SAME_MACHINE)
        if not fits:
            came = f"one that sticks to belt {belt} at {its[0]:.12g}"
            expected = f"of the machine, its belt {belt} at velocity {own[0]:.12g}"
            require(False, "result", expected, came)


def _cycle(cycle: Cycle | PeriodicMotion, machine: Machine | Units) -> "xarray.Dataset":
    import xarray

    units = units_of(machine)
    require(cycle.unknowns.ndim == 2, "result", "one cycle, not a batch", repr(cycle))
    check_machine(cycle, machine)
    x1_min, x1_max = cycle.x1_min, cycle.x1_max
    variables = {
        "period": ((), cycle.period, "period"),
        "stick_duration": ("belt", cycle.stick_durations, "time stuck to the belt in one loop"),
        "x1_min": ((), x1_min, "smallest displacement"),
        "x1_max": ((), x1_max, "largest displacement"),
        "x2_min": ((), cycle.x2_min, "smallest velocity"),
        "x2_max": ((), cycle.x2_max, "largest velocity"),
        "amplitude": ((), (x1_max - x1_min) / 2, "half of the span of displacement"),
    }
    attrs: dict[str, Any] = {"status": Status(int(cycle.status)).name}
    if isinstance(cycle, PeriodicMotion):
        attrs["periods"] = cycle.periods
        for i, word in enumerate(("displacement", "velocity")):
            variables[f"x{i + 1}"] = ((), cycle.start[i], f"{word} at the phase 0")
    else:
        energy = energy_dissipated(cycle)
        variables["energy"] = ((), energy, "energy dissipated in one period")
    found = {
        name: _variable(dims, values, name, units, long_name)
        for name, (dims, values, long_name) in variables.items()
    }
    return xarray.Dataset(found, {"belt": np.arange(len(cycle.oscillator.belts))}, attrs)


def _of_portrait(portrait: Portrait, machine: Machine | Units) -> "xarray.Dataset":
    check_machine(portrait, machine)
    units, table = units_of(machine), portrait.table()
    rate = table["rate"].to_numpy(float) / float(units.time)
    attributes = {"long_name": "rate at which small motions about it grow", "units": "s-1"}
    found = _rows_in_units(table.drop(columns="rate"), units).assign(rate=("row", rate, attributes))
    return found.assign_attrs(status=Status(int(portrait.status)).name)


def _of_shock(shock: FatalShock, machine: Machine | Units) -> "xarray.Dataset":
    check_machine(shock, machine)
    table, units = shock.table(), units_of(machine)
    distance, attributes = float(shock.distance), {"long_name": "size of the shock"}
    if shock.direction == "x2":
        distance, attributes["units"] = distance * float(units.velocity), SYMBOLS["velocity"]
    words = ("attractor", "direction", "boundary", "beyond", "status")
    found = _rows_in_units(table.drop(columns=["distance", *words]), units).squeeze("row")
    attrs = {name: table[name][0] for name in words}
    return found.assign(distance=((), distance, attributes)).assign_attrs(attrs)


def _fitted(fit: Fit, machine: Machine | Units) -> "xarray.Dataset":
    import xarray

    check_machine(fit, machine)
    units, table = units_of(machine), fit.table()
    known = [
        *(unit_of(name, fit.oscillator, units) for name in fit.names),
        *_units_of_start(units),
    ]
    symbols, sizes = zip(*known, strict=True)
    columns = ("estimate", "standard_error", "lower", "upper")
    found: dict[str, Any] = {
        name: ("parameter", table[name].to_numpy() * np.array(sizes)) for name in columns
    }
    motions = {"": fit.ys, "_residual": fit.residuals}
    for i, word in enumerate(("displacement", "velocity")):
        for end, values in motions.items():
            name, words = f"x{i + 1}{end}", f"residual of the {word}" if end else f"fitted {word}"
            found[name] = _variable("t", values[:, i], name, units, words)
    time = _variable("t", fit.ts, "t", units, "time")
    coordinates = {
        "parameter": table["name"].tolist(),
        "unit": ("parameter", list(symbols)),
        "t": time,
    }
    chi2 = float(fit.reduced_chi_squared)
    attrs = {"status": Status(int(fit.status)).name, "reduced_chi_squared": chi2}
    return xarray.Dataset(found, coordinates, attrs)


def unit_of(name: str, osc: Oscillator, units: Units) -> tuple[str, float]:
    """Unit of a parameter of a fit, and the value of 1 in it; tied parameters must have the
    same."""
    found = set()
    for path in name.split(" = "):
        if ".friction." in path:
            found.add(_unit_in_law(path, osc, units))
        else:
            symbol, size = _unit_of_field(path, osc)
            found.add((symbol, float(size(units))))
    require(len(found) == 1, "result", "of tied parameters with one unit", name)
    return found.pop()


def _unit_of_field(path: str, osc: Oscillator) -> tuple[str, Callable[[Units], Any]]:
    """As `UNITS_OF_FIELDS`, for a number that is in no friction law."""
    owner, _, field = path.rpartition(".")
    if owner.startswith("forcing["):
        force = osc.forcing[int(owner.removeprefix("forcing[").partition("]")[0])]
        known = UNITS_OF_FORCES.get(type(force))
        if known is None:
            return "", lambda units: 1.0
        return known if field == "amplitude" else UNITS_OF_FIELDS[field]
    # The mean and the amplitude of a wave are what the field is that oscillates.
    return UNITS_OF_FIELDS[owner.rpartition(".")[2] if field in ("mean", "amplitude") else field]


def _unit_in_law(path: str, osc: Oscillator, units: Units) -> tuple[str, float]:
    """Unit of a number of a friction law, and the value of 1 in it.

    It follows from how the number changes when speeds are given in another unit; "" and 1 where the
    law takes speeds in a unit that only its author knows.
    """
    number = names_of(osc).index(path)
    leaves, structure = jax.tree.flatten(osc)
    if not np.any(leaves[number]):
        leaves[number] = jnp.ones(())
        osc = jax.tree.unflatten(structure, leaves)
    index = int(path.removeprefix("belts[").partition("]")[0])
    law = osc.belts[index].friction
    halved = law.in_units_of(jnp.asarray(2.0))
    if isinstance(law, LawInUnits) or type(halved) is not type(law):
        return "", 1.0
    scaled = eqx.tree_at(lambda o: o.belts[index].friction, osc, halved)
    ratio = float(jax.tree.leaves(scaled)[number] / leaves[number])
    power = round(np.log2(ratio)) if ratio > 0 else 0
    is_power = abs(ratio / 2.0**power - 1) < POWER_ROUNDING
    require(is_power, "result", "of what goes with a power of the speed in in_units_of", path)
    symbol = " ".join(
        unit + (str(n) if n != 1 else "")
        for n, unit in sorted(((power, "s"), (-power, "m")), reverse=True)
        if n
    )
    return symbol or "1", float(units.velocity) ** -power


def _units_of_start(units: Units) -> list[tuple[str, float]]:
    return [(SYMBOLS[name], float(getattr(units, name))) for name in ("length", "velocity")]


def _along(result: AlongParameter, machine: Any) -> "xarray.Dataset":
    table = result.table()
    values = table["value"].to_numpy(float)
    units, (symbol, size) = units_along(result, values, machine)
    check_machine(result, machine)
    attributes = {"long_name": result.name, **({"units": symbol} if symbol else {})}
    rest = _rows_in_units(table.drop(columns="value"), units)
    return rest.assign(value=("row", values * size, attributes))


def _rows_in_units(table: "pandas.DataFrame", units: Units) -> "xarray.Dataset":
    """Columns of a table over `row`, converted where they have a unit."""
    import xarray

    found: dict[str, Any] = {}
    for name in map(str, table.columns):
        quantity = "stick_duration" if name.startswith("stick_duration_") else name
        if quantity in DIMENSIONS:
            words = name.replace("_", " ")
            found[name] = _variable("row", table[name].to_numpy(float), quantity, units, words)
        else:
            missing = {"branch": -1, "stable": False, "neutral": False}.get(name)
            column = table[name] if missing is None else table[name].fillna(missing)
            plain = column.to_numpy({"branch": int, "stable": bool, "neutral": bool}.get(name))
            found[name] = ("row", plain.astype(str) if plain.dtype == object else plain)
    return xarray.Dataset(found)


def units_along(
    result: AlongParameter, values: np.ndarray, machine: Any
) -> tuple[Units, tuple[str, float]]:
    """Units at values of the parameter of a result; and the unit of the parameter, with the value
    of 1.

    The latter is "" and 1 where only the author of the function knows it. values: a number or
    several; the units have the same shape.
    """
    if result.is_argument:
        given = {result.name: values}
        expected = f"a function of {result.name} that returns the Machine at a value of it"
        require(not isinstance(machine, Machine | Units), "machine", expected, "one Machine")
        return _units_at(machine, given), ("", 1.0)
    units, kept = units_of(machine), _at_first_value(result)
    osc: Any = machine.oscillator if isinstance(machine, Machine) else kept
    require(osc is not None, "machine", "a Machine, as the result keeps no oscillator", "its units")
    name, belts = result.name, len(osc.belts)
    belt = name.removeprefix("belts[").partition("]")[0] if name.startswith("belts[") else "0"
    require(int(belt) < belts, "machine", f"of a belt {belt}, of which result is", f"{belts} belts")
    known = "the velocity, load, edges or law of a belt, a force, or the damping"
    require(name != "omega", "result", f"along {known}", "one along omega, 1 in every machine")
    return units, unit_of(name, osc, units)


def _dataset(dataset: "xarray.Dataset", machine: Any) -> "xarray.Dataset":
    axes = [str(name) for name in dataset.dims if name in dataset.coords]
    own = [name for name in axes if name not in ("x1", "x2", "belt")]
    units = _units_of_runs(dataset, machine, own)
    vary = sorted(name for name in SYMBOLS if np.ptp(np.asarray(getattr(units, name))) > 0)
    changed = {}
    for name in [*map(str, dataset.data_vars), *(axis for axis in axes if axis in DIMENSIONS)]:
        of, _, by = name.removeprefix("d_").partition("_d_") if name[:2] == "d_" else (name, "", "")
        if of not in DIMENSIONS:
            continue
        # Units that vary with a parameter have a derivative, too; and the starts are one axis.
        fits = not vary or (of == name and name not in axes)
        require(fits, "result", f"without {name} where the units of {', '.join(vary)} vary", name)
        unit = getattr(units, DIMENSIONS[of])
        attributes = {"units": SYMBOLS[DIMENSIONS[of]]}
        if by in DIMENSIONS:
            unit = unit / getattr(units, DIMENSIONS[by])
            attributes["units"] += f" / ({SYMBOLS[DIMENSIONS[by]]})"
        elif by:
            attributes["units"] += f" / (unit of {by})"
        if name in axes:
            unit = float(np.ravel(unit)[0])
        old = dataset[name]
        values = (old * unit).transpose(*old.dims).values
        changed[name] = (old.dims, values, old.attrs | attributes)
    if words := dataset["label"].attrs.get("flag_meanings") if "label" in dataset else None:
        in_m = " ".join(rest_in_m(word, units).replace(" ", "_") for word in words.split())
        changed["label"] = dataset["label"].assign_attrs(flag_meanings=in_m).variable
    coordinates = {name: changed.pop(name) for name in axes if name in changed}
    notes = {"units": "SI where a variable says so; else dimensionless"}
    if str(start := dataset.attrs.get("start", "")).startswith("x"):  # not along the axes
        notes["start"] = f"dimensionless: {start}"
    return dataset.assign(changed).assign_coords(coordinates).assign_attrs(notes)


def _units_of_runs(dataset: "xarray.Dataset", machine: Any, own: list[str]) -> Units:
    """Units of every run, arrays over the axes that are not starts."""
    import xarray

    if isinstance(machine, Machine | Units):
        expected = f"a function of {', '.join(own)} that returns the Machine of a run"
        require(not own, "machine", expected, "one Machine")
        return jax.tree.map(np.asarray, units_of(machine))
    if not own:
        return _units_at(machine, {})
    grid = xarray.broadcast(*(dataset[name] for name in own))
    found = _units_at(machine, dict(zip(own, map(np.ravel, grid), strict=True)))
    shape = grid[0].shape
    return jax.tree.map(lambda leaf: grid[0].copy(data=leaf.reshape(shape)), found)


def _units_at(machine: Any, values: Mapping[str, np.ndarray]) -> Units:
    """Units of the machines that a function returns for arguments [n] each; without arguments,
    of one."""
    require(callable(machine), "machine", "a Machine, or a function that returns one", machine)
    try:
        inspect.signature(machine).bind(**values)
    except TypeError as error:
        names = ", ".join(values) or "nothing"
        expected = f"a function of {names} that returns the Machine of a run"
        raise ValueError(f"machine must be {expected}, got another: {error}") from error

    def units(arguments):
        found = machine(**arguments)
        fits = isinstance(found, Machine | Units)
        require(fits, "machine", "a function that returns a Machine", found)
        return units_of(found)

    given = {name: jnp.asarray(column) for name, column in values.items()}
    return jax.tree.map(np.asarray, jax.vmap(units)(given) if given else units(given))
