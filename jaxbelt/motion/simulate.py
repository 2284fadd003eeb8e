"""Event-driven trajectories: `simulate` and its result, `Trajectory`.

A trajectory is a chain of arcs, see `runs`; samples at given times are taken from them afterwards.
"""

import math
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

from ..activity import announced
from ..checks import (
    as_numbers,
    as_positive_number,
    as_size,
    as_whole,
    check_finite,
    is_concrete,
    require,
    require_one_of,
)
from ..model.modes import has_edges
from ..model.oscillator import (
    Oscillator,
    at_time,
    check_oscillator,
    fastest,
    has_clock,
    has_possible_numbers,
)
from ..model.own_units import (
    in_given_units,
    in_units,
    in_units_of_run,
    quantity,
    without_edges,
)
from ..model.rest import start_at_focus
from ..model.transitions import contact
from ..numerics.compiling import jit, power_of_two
from ..numerics.derivatives import nan_unless
from ..results import EventKind, Status, describe, draw
from ..tables import per_belt, require_single, table_of
from .runs import Rules, arcs_of_run, stacked_codes, state_at_end, states_at
from .smoothing import integrate, smooth_field, switch_field, switch_mode

if TYPE_CHECKING:
    import pandas


class Events(eqx.Module):
    """The events of a trajectory in order; under a transformation padded to a common length.

    Attributes:
        t: Times, [events], NaN where padded.
        y: States (x1, x2), [events, 2].
        kind: An `EventKind`, [events], 0 where padded.
        belt: Number of the belt, [events], -1 where padded. For EDGE it is the belt whose interval
            ends or begins there, the lowest number where several do.
    """

    t: Array
    y: Array = eqx.field(metadata=quantity("length", "velocity"))
    kind: Array
    belt: Array

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each event, in order; columns: t, x1, x2, kind (an `EventKind`'s
        name), belt."""
        require_single(self, self.t, 1)
        happened = np.asarray(self.kind) > 0
        t, y, kind, belt = (np.asarray(x)[happened] for x in (self.t, self.y, self.kind, self.belt))
        names = [EventKind(int(one)).name for one in kind]
        return table_of({"t": t, "x1": y[:, 0], "x2": y[:, 1], "kind": names, "belt": belt})

    def plot(self, ax: Any = None) -> Any:
        """Draws the events over time, a line for each kind and belt.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        if not is_concrete(self.t) or self.t.ndim != 1:
            return f"Events(t={self.t.shape})"
        counts = [f"{np.sum(np.asarray(self.kind) == kind)} {kind.name}" for kind in EventKind]
        return f"Events({', '.join(counts)})"


class Arcs(eqx.Module):
    """The arcs of a trajectory: smooth pieces, each in one mode; padded like `Events`.

    Consecutive arcs of one mode occur: an arc also ends at an extremum.

    Attributes:
        t: Entry times, [arcs].
        y: Entry states (x1, x2), [arcs, 2].
        mode: Contact codes, [arcs, belts] (+1/-1 slip with that sign of r, 0 stuck, -2/+2 mass
            below/above the belt's interval).
        duration: Durations, [arcs].
    """

    t: Array
    y: Array = eqx.field(metadata=quantity("length", "velocity"))
    mode: Array
    duration: Array

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each arc, in order.

        Columns: t, x1, x2 at its entry, duration, and contact_0, contact_1, ..., the contact code
        of each belt.
        """
        require_single(self, self.t, 1)
        used = ~np.isnan(np.asarray(self.t))
        t, y, mode, duration = (
            np.asarray(x)[used] for x in (self.t, self.y, self.mode, self.duration)
        )
        columns = {"t": t, "x1": y[:, 0], "x2": y[:, 1], "duration": duration}
        return table_of(columns | per_belt("contact", mode))

    def plot(self, ax: Any = None) -> Any:
        """Draws the contact of each belt over time, as a bar.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)


class Trajectory(eqx.Module):
    """The motion over a time span; what `simulate` returns.

    Attributes:
        ts: Sample times tau, [samples].
        ys: States (x1, x2) there, [samples, 2], NaN where samples were not reached.
        modes: Contact codes of each belt from that time on, [samples, belts] (+1/-1 slip with that
            sign of r_i, 0 stuck, -2/+2 mass below/above the belt's interval).
        events: The `Events`.
        arcs: The `Arcs`.
        status: A `Status` code.
    """

    ts: Array
    ys: Array = eqx.field(metadata=quantity("length", "velocity"))
    modes: Array
    events: Events
    arcs: Arcs
    status: Array

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each sample.

        Columns: t, x1, x2, and contact_0, contact_1, ..., the contact code of each belt.
        `trajectory.events.table()` and `trajectory.arcs.table()` have the events and arcs.
        """
        require_single(self, self.ts, 1)
        x1, x2 = np.asarray(self.ys).T
        columns = {"t": self.ts, "x1": x1, "x2": x2}
        return table_of(columns | per_belt("contact", self.modes))

    def plot(self, ax: Any = None) -> Any:
        """Draws displacement and velocity over time, stick phases shaded.

        `plot_time_history` has axes for each of the two, `plot_phase_portrait` the plane of both.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        if not is_concrete(self.ts) or self.ts.ndim != 1:
            return f"Trajectory(ts={self.ts.shape}, ys={self.ys.shape})"
        ts = np.asarray(self.ts)
        known = ts[np.all(np.isfinite(self.ys), axis=1)]
        until = f", known up to {known[-1]:.6g}" if known.size else ", nothing of it known"
        until = until if known.size < ts.size else ""
        span = f"t {ts[0]:.6g} to {ts[-1]:.6g}{until}, " if ts.size else ""
        return (
            f"Trajectory({span}{ts.size} samples, {self.events!r}, "
            f"status {Status(int(self.status)).name}: {describe(self.status)})"
        )


#: Default tolerances of a step, and default width of the band of the switch model and of the smooth
#: one's tanh, in own units.
SIMULATION_TOLERANCE, BAND_WIDTH = 1e-10, 1e-3


@jit
def _smoothed(given, y0, t0, t1, ts, rtol, atol, *, width, formulation, resolution) -> Trajectory:
    """A trajectory of the switch or the smooth formulation: samples without events or arcs."""
    own = osc = in_units_of_run(given)
    y0 = y0 / osc.units.length
    atol = in_units(atol, osc.units.length, SIMULATION_TOLERANCE)
    width = in_units(width, osc.units.velocity, BAND_WIDTH)
    if ts is None:
        ts = t0 + (t1 - t0) * jnp.linspace(0.0, 1.0, resolution)
    field = switch_field if formulation == "switch" else smooth_field
    start_known = jnp.all(jnp.isfinite(y0)) & has_possible_numbers(osc)
    ys = integrate(field, osc, width, y0, t0, ts, rtol, atol)
    ys = ys + nan_unless(start_known, (given, y0, t0, t1, ts))

    def mode_at(y, *t):
        osc = at_time(own, *t) if t else own
        if formulation == "switch":
            return stacked_codes(switch_mode(osc, y[0], y[1], width))
        return stacked_codes(contact(osc, y[0], y[1], rightward=True))

    known = jnp.all(jnp.isfinite(ys))
    failure = jnp.where(start_known, Status.TOO_MANY_STEPS.value, Status.NOT_FINITE.value)
    integers, states = jnp.zeros(0, dtype=int), jnp.zeros((0, 2))
    found = Trajectory(
        ts,
        ys,
        jax.vmap(mode_at)(ys, ts) if has_clock(own) else jax.vmap(mode_at)(ys),
        Events(jnp.zeros(0), states, integers, integers),
        Arcs(jnp.zeros(0), states, jnp.zeros((0, len(osc.belts)), jnp.int8), jnp.zeros(0)),
        jnp.where(known, Status.OK.value, failure),
    )
    return in_given_units(found, given, osc)


@jit
def _filippov(
    given, y0, t0, t1, ts, rtol, atol, *, rules, max_events, resolution, ends_at_t1, last=None
) -> Trajectory:
    """The trajectory of the exact formulation. last: number of the sample at the end of the run, -1
    for none; given as data, so that it is no part of the program."""
    osc = in_units_of_run(given)
    y0 = y0 / osc.units.length
    atol = in_units(atol, osc.units.length, SIMULATION_TOLERANCE)
    if ts is None:
        wanted_times = t0 + (t1 - t0) * jnp.linspace(0.0, 1.0, resolution)[:-1]
    else:
        wanted_times = ts[:-1] if ends_at_t1 else ts
    if not has_clock(osc):
        y0 = jnp.stack(start_at_focus(osc, *y0))
    possible = jnp.all(jnp.isfinite(y0)) & has_possible_numbers(osc)
    nothing = nan_unless(possible, (given, y0, t0, t1, ts))
    final, records, loop, samples = arcs_of_run(osc, y0, t0, t1, wanted_times, rtol, atol, rules)
    _, period = loop.end(records.event_t)
    count = jnp.cumsum(records.kind > 0)
    wanted = jnp.arange(1, max_events + 1)
    happened = wanted <= loop.total(count)
    rows, later = loop.place(wanted, count)
    events = Events(
        t=jnp.where(happened, records.event_t[rows] + later * period, jnp.nan) + nothing,
        y=jnp.where(happened[:, None], _without_clock(records.event_y)[rows], jnp.nan) + nothing,
        kind=jnp.where(happened, records.kind[rows], 0),
        belt=jnp.where(happened, records.belt[rows], -1),
    )
    too_many = loop.total(count) > max_events
    status = jnp.where(too_many, Status.TOO_MANY_SEGMENTS.value, final.status)
    ys, modes = states_at(osc, final, records, loop, samples, wanted_times)
    ys = ys + nothing
    numbers = jnp.arange(1, max(rules.max_segments, count.size) + 1)
    rows, later = loop.place(numbers, numbers[: count.size])
    t = records.t[rows] + later * period + nothing
    y, durations = _without_clock(records.y)[rows] + nothing, records.duration[rows] + nothing
    arcs = Arcs(t, y, records.mode[rows], durations)
    if last is not None:
        y1, mode1 = state_at_end(final, records, loop, t1)
        y1 = y1 + nothing
        is_last = (jnp.arange(ys.shape[0]) == last)[:, None]
        ys, modes = jnp.where(is_last, y1, ys), jnp.where(is_last, mode1, modes)
    rows = wanted_times, ys, modes
    if ends_at_t1:
        # The last row is separate: where it alone is used, no other sample is computed.
        y1, mode1 = state_at_end(final, records, loop, t1)
        y1 = y1 + nothing
        if ts is None:
            # An even grid, and between its points the entries of the arcs, which are known already.
            unused = jnp.isnan(arcs.t)
            entries = (
                jnp.where(unused, t1, arcs.t),
                jnp.where(unused[:, None], y1, arcs.y),
                jnp.where(unused[:, None], mode1, arcs.mode),
            )
            # Entries in loops that were not followed may be out of order by a rounding.
            order = _merged(wanted_times, lax.cummax(lax.stop_gradient(entries[0])))
            rows = jax.tree.map(lambda *both: jnp.concatenate(both)[order], rows, entries)
        ends = t1, y1, mode1
        rows = jax.tree.map(lambda leaf, end: jnp.concatenate([leaf, end[None]]), rows, ends)
    ts, ys, modes = rows
    return in_given_units(Trajectory(ts, ys, modes, events, arcs, status), given, osc)


def _without_clock(states: Array) -> Array:
    """The states (x1, x2), [rows, 2], without the time that states with a clock have."""
    return states if states.shape[1] == 2 else states[:, :2]


def _merged(first: Array, second: Array) -> Array:
    """Indices that sort the concatenation of two arrays, each of which is sorted already."""
    places = [
        jnp.arange(rows.size) + jnp.searchsorted(others, rows, side=side).astype(int)
        for rows, others, side in ((first, second, "left"), (second, first, "right"))
    ]
    places = jnp.concatenate(places)
    return jnp.zeros_like(places).at[places].set(jnp.arange(places.size), unique_indices=True)


@announced("simulate")
def simulate(
    osc: Oscillator,
    y0: ArrayLike | tuple,
    t1: ArrayLike,
    *,
    t0: ArrayLike = 0.0,
    ts: ArrayLike | list | tuple | None = None,
    rtol: ArrayLike = SIMULATION_TOLERANCE,
    atol: ArrayLike | None = None,
    formulation: str = "filippov",
    v_star: ArrayLike | None = None,
    eps: ArrayLike | None = None,
    max_segments: int | None = None,
    max_events: int | None = None,
) -> Trajectory:
    """The motion of the oscillator from y0 over [t0, t1].

    The formulation "filippov" is exact and event-driven. "switch" is the paper's switch model, eqs.
    (21)-(23), with a band of half-width v_star around each boundary; "smooth" has tanh(r/eps) in
    place of sgn(r). The last two return no events; contact edges are found in them as well. A run
    that passes an edge ever faster, as around a pseudo-focus, ends there with TOO_MANY_STEPS, and
    NaN from there on.

    Works under `jax.jit`, `jax.vmap` (batches), `jax.jacfwd` and `jax.jacrev`. There the lengths
    are padded (see `Events`); outside they are cut. Derivatives are those of the arcs in their
    present order. Where this order changes exactly at the given numbers, as where two belts have
    one velocity or an orbit grazes a boundary, the derivatives of the two sides differ, and the
    returned one may be neither: step aside by 1e-6 for that of one side. Velocities that stay equal
    are varied together. Derivatives of "smooth" are right by every number, edges included. Those of
    "switch" have the jumps at edges and lack those at the band, so that after the first time that a
    run enters or leaves a band all derivatives but the last state's by t1 are wrong, and the
    derivative by v_star is 0: take them from "filippov" or "smooth".

    Args:
        osc: The oscillator.
        y0: Start (x1, x2), dimensionless, shape [2].
        t1: End of the time span in dimensionless time tau = omega t, the time of which forces,
            velocities and loads are functions.
        t0: Beginning of the time span.
        ts: Sample times, increasing, shape [n]; None: an even grid with the ends of all arcs in it,
            and t1 last. For the reverse mode of a function of the final state alone give ts=[t1];
            otherwise the derivatives of every sample are computed.
        rtol: Relative tolerance of the integrator per step; in a batch the smallest one holds for
            all.
        atol: Absolute tolerance, a length, likewise; None: 1e-10 of the oscillator's own size, see
            `own_units`.
        formulation: "filippov", "switch" or "smooth".
        v_star: Half-width of the switch model's band, a velocity; None: 1e-3 of the oscillator's
            own. For the formulation "switch" alone.
        eps: Width of the smooth formulation, likewise.
        max_segments: Budget of arcs; None chooses one from the time span. A run that uses it up
            returns what it has, with the status TOO_MANY_SEGMENTS. A loop behind a stick phase that
            repeats to the last digit is followed once, and its arcs count every time.
        max_events: Largest number of returned events, with the same status if there were more.
            None: all; under a transformation, where there has to be room for them, about 4 (16
            where edges are passed) for each unit of time.

    Returns:
        The `Trajectory`.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    check_oscillator(osc)
    y0 = as_numbers(y0, "y0", (2,))
    check_finite(y0, "y0")
    t0, t1 = as_numbers(t0, "t0"), as_numbers(t1, "t1")
    check_finite(t0, "t0")
    check_finite(t1, "t1")
    if is_concrete((t0, t1)) and not t1 > t0:
        require(False, "t1", f"> t0 = {t0}", t1)
    rtol = as_positive_number(rtol, "rtol")
    if ts is not None:
        ts = _checked_times(ts, t0, t1)
    require_one_of(formulation, ("filippov", "switch", "smooth"), "formulation")
    for name, width, of in (("v_star", v_star, "switch"), ("eps", eps, "smooth")):
        expected = f'left out unless formulation="{of}"'
        require(width is None or formulation == of, name, expected, width)
    width, name = (v_star, "v_star") if formulation == "switch" else (eps, "eps")
    # Sizes that are left out become NaN.
    sizes = [rtol, *(one for one in (atol, width) if one is not None)]
    atol, width = as_size(atol, "atol"), as_size(width, name)
    padded = not is_concrete((osc, y0, t0, t1, ts, *sizes))
    if padded:
        y0 = jnp.asarray(y0)
        y0 = y0 + nan_unless(_are_possible(t0, t1, ts, sizes), (y0, sizes))
    ends_at_t1 = ts is None or (
        is_concrete((ts, t1)) and np.size(ts) > 0 and bool(np.asarray(ts)[-1] == t1)
    )
    samples = None
    if ts is not None and not padded and np.size(ts) > 1:
        samples = np.size(ts)
        ts = np.pad(np.asarray(ts), (0, _rows_for(samples) - samples), mode="edge")
    given = y0, t0, t1, ts, rtol, atol
    span = float(t1 - t0) if is_concrete((t0, t1)) else 100.0
    resolution = 0 if ts is not None else _room_for(10 * span, 512)
    if formulation != "filippov":
        fixed = dict(formulation=formulation, resolution=resolution)
        found = _smoothed(osc, *given, width=width, **fixed)
        return found if samples is None else _first_samples(found, samples)
    edges = has_edges(osc)
    busy = span * _busyness(osc)
    rules, max_events = _budgets(max_segments, max_events, busy, len(osc.belts), edges, padded)
    last = None if samples is None else np.asarray(samples - 1 if ends_at_t1 else -1)
    trajectory = _filippov(
        osc if edges else without_edges(osc),
        *given,
        rules=rules,
        max_events=max_events,
        resolution=resolution,
        ends_at_t1=ends_at_t1 and samples is None,
        last=last,
    )
    return _without_padding(trajectory, trim_samples=ts is None, samples=samples)


def _are_possible(t0: Any, t1: Any, ts: Any, sizes: list[Any]) -> Array:
    """Whether traced arguments are possible: values for which known ones would not raise.

    sizes: tolerances and widths that are given.
    """
    given = jnp.stack([jnp.asarray(size) for size in sizes])
    possible = (t1 > t0) & jnp.all((given > 0) & jnp.isfinite(given))
    if ts is None:
        return possible
    ts, rounding = jnp.asarray(ts), 1e-14 * (jnp.abs(t0) + jnp.abs(t1))
    inside = jnp.all((ts >= t0 - rounding) & (ts <= t1 + rounding))
    return possible & inside & jnp.all(jnp.diff(ts) >= 0)


def _busyness(osc: Oscillator) -> float:
    """Factor by which a clock may multiply the number of arcs, from its fastest wave."""
    if not has_clock(osc):
        return 1.0
    if not is_concrete(osc):
        return 2.0
    with jax.ensure_compile_time_eval():  # known numbers are so in a trace, too
        return float(fastest(osc))


def _budgets(
    max_segments: int | None,
    max_events: int | None,
    span: float,
    belts: int,
    edges: bool,
    padded: bool,
) -> tuple[Rules, int]:
    """Largest numbers of arcs and of returned events, by default or as given, or a `ValueError`.

    padded: whether there has to be room for all of them.
    """
    is_default = max_segments is None
    if max_segments is None:
        # Around a pseudo-focus at a contact edge a run has many short arcs.
        max_segments = _room_for((64 if edges else 8) * span, 512)
    max_segments = as_whole(max_segments, "max_segments")
    followed = max_segments
    if is_default and padded and not edges:
        # Padding costs more than the arcs here. No arc is longer than a unit of time; and a loop,
        # which takes 2 pi or so, has two more for its extrema, and three for each belt, where the
        # mass sticks to it and crosses it: 1 + (2 + 3 belts) / (2 pi), or less.
        rate = 1.5 + 0.5 * belts
        followed = min(max_segments, max(128, 64 * math.ceil(rate * span / 64)))
    if max_events is None:
        room = _room_for((16 if edges else 4) * span, 64) if padded else max_segments
        max_events = min(max_segments, room)
    return Rules(max_segments, followed), as_whole(max_events, "max_events")


def _checked_times(ts: ArrayLike | list | tuple, t0: ArrayLike, t1: ArrayLike) -> ArrayLike:
    """Checks the sample times."""
    ts = as_numbers(ts, "ts", (None,))
    check_finite(ts, "ts")
    if is_concrete((ts, t0, t1)):
        if np.any(np.asarray(ts) < t0) or np.any(np.asarray(ts) > t1):
            require(False, "ts", f"within [t0, t1] = [{t0}, {t1}]", ts)
        require(np.all(np.diff(ts) >= 0), "ts", "increasing", ts)
    return ts


def _room_for(value: float, least: int) -> int:
    return power_of_two(math.ceil(min(value, 2.0**20)), least)


#: Fewest rows of samples, the number of lanes in which rows are computed.
FEWEST_SAMPLES = 32


def _rows_for(samples: int) -> int:
    """Number of rows to compute for this many sample times, rounded up to share few programs."""
    room = power_of_two(samples, FEWEST_SAMPLES)
    less = 3 * room // 4
    return less if samples <= less and less % FEWEST_SAMPLES == 0 else room


def _first_samples(trajectory: Trajectory, count: int) -> Trajectory:
    known = (trajectory.ts, trajectory.ys, trajectory.modes)
    rows = jax.device_put([np.asarray(leaf)[:count] for leaf in known])
    return eqx.tree_at(lambda one: (one.ts, one.ys, one.modes), trajectory, tuple(rows))


def _without_padding(
    trajectory: Trajectory, *, trim_samples: bool, samples: int | None = None
) -> Trajectory:
    """Cut the padding off where lengths are known, that is, outside of transformations.

    samples: how many rows were wanted; None: all.
    """
    if not is_concrete(trajectory) or trajectory.ts.ndim != 1:
        return trajectory
    known = jax.tree.map(np.asarray, trajectory)

    def rows(tree, numbers):
        return jax.tree.map(lambda leaf: leaf[numbers], tree)

    wanted = rows((known.ts, known.ys, known.modes), slice(samples))
    if trim_samples:
        wanted = rows(wanted, np.flatnonzero(np.diff(known.ts, prepend=-np.inf)))
    events = rows(known.events, np.flatnonzero(known.events.kind))
    arcs = rows(known.arcs, np.flatnonzero(~np.isnan(known.arcs.t)))
    # By device_put, because jnp.asarray compiles a program for every shape.
    (ts, ys, modes), events, arcs = jax.device_put((wanted, events, arcs))
    return Trajectory(ts, ys, modes, events, arcs, trajectory.status)
