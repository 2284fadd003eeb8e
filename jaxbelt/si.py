"""Results in SI units: `in_si`.

Variables of datasets and columns of tables state their dimensions, see `dimensions`; what states
none, such as the results of a user's observable, stays as it is.
"""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Union

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .activity import announced
from .bifurcations.base import BifurcationPoint
from .bifurcations.curves import BifurcationCurve
from .bifurcations.diagrams import BifurcationDiagram
from .bifurcations.regions import RegionMap
from .checks import in_words, outside_of_traces, require, require_one_of
from .cycles.cycle import Cycle
from .cycles.exponents import Exponents
from .cycles.functionals import energy_dissipated
from .cycles.periodic import PeriodicMotion
from .cycles.portrait import Portrait
from .cycles.shocks import FatalShock
from .inverse.design import Design
from .inverse.fit import Fit
from .model.equilibria import Equilibria
from .model.instants import field_at
from .model.machine import SI_UNITS, Machine, Units
from .model.modes import STUCK, mode_of
from .model.oscillator import Oscillator, at_time, constant_force, wave_at
from .model.parameters import names_of, unit_of
from .motion.simulate import Trajectory
from .results import EventKind, Status
from .sweeps.basins import Basins, BasinStability
from .sweeps.circle_map import CircleMap
from .sweeps.datasets import flags
from .sweeps.fractions import BasinFractions
from .sweeps.naming import rest_in_m
from .sweeps.orbit_diagram import OrbitDiagram
from .sweeps.question import quantities_of

if TYPE_CHECKING:
    import pandas
    import xarray

#: Relative difference up to which numbers of a machine's oscillator and of a result's count as
#: equal: they may have been computed in different ways.
SAME_MACHINE = 1e-9
#: Results along a parameter.
AlongParameter = BifurcationDiagram | OrbitDiagram | BasinFractions
#: Advice for results that `in_si` does not take.
INSTEAD = {
    BifurcationPoint: "; its value is in the unit of the argument where a function was given in "
    "place of an oscillator, else multiply it by machine.units.velocity, say; for its cycle write "
    "jb.in_si(point.cycle, machine(point.value))",
    BifurcationCurve: "; its values are in the units of the arguments where a function was given, "
    "else multiply them by machine.units.velocity, say",
    Equilibria: "; write jb.in_si(jb.portrait(osc), machine), which has them among its rows",
    RegionMap: "; its values are in the units of the arguments of its function: draw it by its own "
    ".plot()",
    CircleMap: "; its phases have no unit: draw it by its own .plot(), and for a motion write "
    "jb.in_si(found.motions[0], machine)",
    Exponents: "; multiply its values by machine.units.rate",
    Design: "; write machine.of_oscillator(plan.oscillator)",
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
      function stays as the function takes it. The `open_ends` of a diagram are an attribute.
    - a dataset: its own variables, with derivatives by starts and parameters where the units are
      the same in all runs. Results of a user's observable stay dimensionless unless they state
      their dimension, `dataset.largest.attrs["quantity"] = "length"`, and so does the attribute
      `start`; the words for `label` of basins say in m where the mass rests.

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

    match result:
        case Trajectory():
            return _trajectory(result, machine)
        case Cycle() | PeriodicMotion():
            return _cycle(result, machine)
        case Portrait():
            return _of_portrait(result, machine)
        case FatalShock():
            return _of_shock(result, machine)
        case Basins():
            check_machine(result, machine)
            return _dataset(result.dataset, machine)
        case BasinStability():
            return _rows_in_units(result.table(), units_of(machine))
        case Fit():
            return _fitted(result, machine)
        case BifurcationDiagram() | OrbitDiagram() | BasinFractions():
            return _along(result, machine)
        case xarray.Dataset():
            present = {variable.attrs.get("units") for variable in result.variables.values()}
            is_done = bool(present & {symbol for symbol, _ in SI_UNITS.values()})
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
            (first, osc), free = _at_first_value(result), {result.name}
            if osc is None:
                return
            if result.is_argument:
                machine = machine(**{result.name: first})
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
    fits = one.keys() == other.keys()
    require(fits, "machine", "with the laws of the result", machine)
    for name, value in other.items():
        fits = name in free or np.allclose(one[name], value, rtol=SAME_MACHINE, atol=0)
        expected = f"the one of the result, whose oscillator has {name} = {value:.12g}"
        came = f"{one[name]:.12g}; in place of it machine.units takes its units alone"
        require(fits, "machine", expected, came)


def _at_first_value(result: AlongParameter) -> tuple[float, Oscillator | None]:
    """The first value of the parameter of a result, and the oscillator there, if it keeps one."""
    if isinstance(result, BifurcationDiagram):
        return float(result.regions[0][0]), result.oscillator
    first, osc = float(result.values[0]), None
    if isinstance(result, OrbitDiagram) and result.sampling is not None:
        osc = result.sampling.variation.oscillator(np.array([first]))
    return first, osc


def _numbers_of(osc: Oscillator) -> dict[str, float]:
    pairs = zip(names_of(osc), jax.tree.leaves(osc), strict=True)
    return {name: float(leaf) for name, leaf in pairs if np.ndim(leaf) == 0}


def _variable(units: Units, dims: Any, values: Any, dimension: str, long_name: str) -> tuple:
    symbol, size = SI_UNITS[dimension]
    scaled = np.asarray(values) * np.asarray(size(units))
    return dims, scaled, {"long_name": long_name, "units": symbol}


@jax.jit
def _friction_force(osc: Oscillator, codes: Array, ys: Array, ts: Array) -> Array:
    """Force of all belts on the mass, [samples], for modes [samples, belts], in k times length.

    It balances spring, dashpot, inertia and forcing; where the mass sticks it is accelerated with
    its belt.
    """

    def at(codes, y, t):
        _, a, _ = field_at(osc, mode_of(codes), (*y, t))
        pushes = constant_force(at_time(osc, t))
        return sum((-push for push in pushes), start=a + y[0] + osc.damping * y[1])

    return jax.vmap(at)(codes.astype(jnp.float64), ys, ts)


def _trajectory(run: Trajectory, machine: Any) -> "xarray.Dataset":
    import xarray

    units, belts = units_of(machine), run.modes.shape[-1]
    require(run.ts.ndim == 1, "result", "one trajectory, not a batch", repr(run))
    check_machine(run, machine)
    events, variable = run.events, functools.partial(_variable, units)
    found = {
        "x1": variable("t", run.ys[:, 0], "length", "displacement"),
        "x2": variable("t", run.ys[:, 1], "velocity", "velocity"),
        "mode": (("t", "belt"), np.asarray(run.modes), {"long_name": "contact with the belt"}),
        "t_event": variable("event", events.t, "time", "time of the event"),
        "x1_event": variable("event", events.y[:, 0], "length", "displacement at the event"),
        "x2_event": variable("event", events.y[:, 1], "velocity", "velocity at the event"),
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
    coordinates = {"t": variable("t", run.ts, "time", "time"), "belt": np.arange(belts)}
    return xarray.Dataset(found, coordinates, {"status": Status(int(run.status)).name})


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
        if not np.allclose(its, own, rtol=SAME_MACHINE, atol=SAME_MACHINE):
            came = f"one that sticks to belt {belt} at {its[0]:.12g}"
            expected = f"of the machine, its belt {belt} at velocity {own[0]:.12g}"
            require(False, "result", expected, came)


def _cycle(cycle: Cycle | PeriodicMotion, machine: Any) -> "xarray.Dataset":
    import xarray

    units = units_of(machine)
    require(cycle.unknowns.ndim == 2, "result", "one cycle, not a batch", repr(cycle))
    check_machine(cycle, machine)
    x1_min, x1_max, sticks = cycle.x1_min, cycle.x1_max, cycle.stick_durations
    variable, half = functools.partial(_variable, units), (x1_max - x1_min) / 2
    found = {
        "period": variable((), cycle.period, "time", "period"),
        "stick_duration": variable("belt", sticks, "time", "time stuck to the belt in one loop"),
        "x1_min": variable((), x1_min, "length", "smallest displacement"),
        "x1_max": variable((), x1_max, "length", "largest displacement"),
        "x2_min": variable((), cycle.x2_min, "velocity", "smallest velocity"),
        "x2_max": variable((), cycle.x2_max, "velocity", "largest velocity"),
        "amplitude": variable((), half, "length", "half of the span of displacement"),
    }
    attrs: dict[str, Any] = {"status": Status(int(cycle.status)).name}
    if isinstance(cycle, PeriodicMotion):
        attrs["periods"], (x1, x2) = cycle.periods, cycle.start
        found["x1"] = variable((), x1, "length", "displacement at the phase 0")
        found["x2"] = variable((), x2, "velocity", "velocity at the phase 0")
    else:
        energy = energy_dissipated(cycle)
        found["energy"] = variable((), energy, "energy", "energy dissipated in one period")
    return xarray.Dataset(found, {"belt": np.arange(len(cycle.oscillator.belts))}, attrs)


def _of_portrait(portrait: Portrait, machine: Any) -> "xarray.Dataset":
    check_machine(portrait, machine)
    found = _rows_in_units(portrait.table(), units_of(machine))
    found["rate"].attrs["long_name"] = "rate at which small motions about it grow"
    return found.assign_attrs(status=Status(int(portrait.status)).name)


def _of_shock(shock: FatalShock, machine: Any) -> "xarray.Dataset":
    check_machine(shock, machine)
    found = _rows_in_units(shock.table(), units_of(machine)).squeeze("row")
    found["distance"].attrs["long_name"] = "size of the shock"
    words = ["attractor", "direction", "boundary", "beyond", "status"]
    return found.drop_vars(words).assign_attrs({name: found[name].item() for name in words})


def _fitted(fit: Fit, machine: Any) -> "xarray.Dataset":
    import xarray

    check_machine(fit, machine)
    units, table = units_of(machine), fit.table()
    start = [SI_UNITS[dimension] for dimension in ("length", "velocity")]
    known = [unit_of(name, fit.oscillator, units) for name in fit.names]
    known += [(symbol, float(size(units))) for symbol, size in start]
    symbols, sizes = zip(*known, strict=True)
    columns = ("estimate", "standard_error", "lower", "upper")
    found: dict[str, Any] = {
        name: ("parameter", table[name].to_numpy() * np.array(sizes)) for name in columns
    }
    variable, ys, residuals = functools.partial(_variable, units), fit.ys, fit.residuals
    found |= {
        "x1": variable("t", ys[:, 0], "length", "fitted displacement"),
        "x1_residual": variable("t", residuals[:, 0], "length", "residual of the displacement"),
        "x2": variable("t", ys[:, 1], "velocity", "fitted velocity"),
        "x2_residual": variable("t", residuals[:, 1], "velocity", "residual of the velocity"),
    }
    coordinates = {
        **{"parameter": table["name"].tolist(), "unit": ("parameter", list(symbols))},
        "t": variable("t", fit.ts, "time", "time"),
    }
    chi2 = float(fit.reduced_chi_squared)
    attrs = {"status": Status(int(fit.status)).name, "reduced_chi_squared": chi2}
    return xarray.Dataset(found, coordinates, attrs)


def _along(result: AlongParameter, machine: Any) -> "xarray.Dataset":
    table = result.table()
    values = table["value"].to_numpy(float)
    units, (symbol, size) = units_along(result, values, machine)
    check_machine(result, machine)
    attributes = {"long_name": result.name, **({"units": symbol} if symbol else {})}
    found = _rows_in_units(table, units).assign(value=("row", values * size, attributes))
    if isinstance(result, BifurcationDiagram) and result.open_ends:
        found.attrs["open_ends"] = [end * size for end in result.open_ends]
    return found


def _rows_in_units(table: "pandas.DataFrame", units: Units) -> "xarray.Dataset":
    """Columns of a table over `row`, converted where they state a dimension."""
    import xarray

    found, quantities = {}, table.attrs["quantities"]
    for name in map(str, table.columns):
        if name in quantities:
            column, words = table[name].to_numpy(float), name.replace("_", " ")
            found[name] = _variable(units, "row", column, quantities[name], words)
        else:
            missing = {"Int64": -1, "boolean": False}.get(str(table[name].dtype))
            column = table[name] if missing is None else table[name].fillna(missing)
            plain = column.to_numpy(None if missing is None else type(missing))
            found[name] = ("row", plain.astype(str) if plain.dtype == object else plain)
    return xarray.Dataset(found)


def units_along(
    result: AlongParameter, values: np.ndarray, machine: Any
) -> tuple[Units, tuple[str, float]]:
    """Units at values of the parameter of a result; and the symbol of the parameter's unit, with
    the size of 1 in it.

    The latter are "" and 1 where only the author of the function knows the unit. values: a number
    or several; the units have the same shape.
    """
    if result.is_argument:
        given = {result.name: values}
        expected = f"a function of {result.name} that returns the Machine at a value of it"
        require(not isinstance(machine, Machine | Units), "machine", expected, "one Machine")
        return _units_at(machine, given), ("", 1.0)
    units, (_, kept) = units_of(machine), _at_first_value(result)
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
    own = [name for name in axes if name not in ("x1", "x2", "belt", "attractor")]
    units = _units_of_runs(dataset, machine, own)
    vary = sorted(name for name, unit in vars(units).items() if np.ptp(np.asarray(unit)) > 0)
    changed, axes_in_si = {}, {}
    for name, quantity in quantities_of(dataset).items():
        of, _, by = quantity.partition(" / ")
        require_one_of(of, SI_UNITS, f"quantity of {name}")
        (symbol, size), is_axis = SI_UNITS[of], name in dataset.coords
        # Units that vary have derivatives of their own, and an axis of starts has one unit only.
        fits = not vary or not (by or is_axis)
        require(fits, "result", f"without {name} where the units of {', '.join(vary)} vary", name)
        divisor, divisor_size = SI_UNITS.get(by, (by, lambda _: 1.0))
        unit = size(units) / divisor_size(units)
        old = dataset[name]
        if is_axis:
            unit = axes_in_si[name] = float(np.ravel(unit)[0])
        values = old * unit
        attributes = old.attrs | {"units": f"{symbol} / ({divisor})" if by else symbol}
        attributes.pop("quantity", None)
        changed[name] = (old.dims, values.transpose(*old.dims).values, attributes)
    if words := dataset["label"].attrs.get("flag_meanings") if "label" in dataset else None:
        in_m = " ".join(rest_in_m(word, units.length).replace(" ", "_") for word in words.split())
        changed["label"] = dataset["label"].assign_attrs(flag_meanings=in_m).variable
    coordinates = {name: changed.pop(name) for name in [*changed] if name in dataset.coords}
    notes = {"units": "SI where a variable says so; else dimensionless"}
    if str(start := dataset.attrs.get("start", "")).startswith("x"):  # not along the axes
        notes["start"] = f"dimensionless: {start}"
    if axes_in_si and "call" in dataset.attrs:
        given = f"dataset[name] / {axes_in_si}.get(name, 1.0) for name in"
        notes["call"] = dataset.attrs["call"].replace("dataset[name] for name in", given)
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
