"""Event-driven trajectories: `simulate` and its result, `Trajectory`.

A trajectory is a chain of arcs. In a slip arc the orbit runs in the smooth field of its mode until
a guard of the mode vanishes; a stick arc is known in closed form. The chain is a `lax.scan` of
segments, an arc each, so that it works under `jit`, `vmap`, and derivatives forward and reverse.

Slip arcs are those of `arcs`, integrated by diffrax. The arcs end at extrema where a boundary or an
edge is within reach, and else after the time MAX_ARC. So no root hides within a step: between two
zeros of x2' lies a zero of x2, since x2'' = -x2 there, and two extrema of x2 in one step would take
half a loop around a focus within it, which `MAX_ARC` and `MAX_FRACTION` exclude.

Samples at given times are taken from the arcs afterwards, in parallel.
"""

import functools
import math
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

from ..checks import as_numbers, check_finite, check_positive, is_concrete, require
from ..model.events import event_between
from ..model.modes import Mode, at_focus, contact, has_edges, mode_of_state, select, stick_velocity
from ..model.oscillator import Oscillator, check_oscillator
from ..numerics.compiling import any_lane, jit, one_kernel
from ..numerics.derivatives import forward_jacobian
from ..results import EventKind, Status, describe
from .arcs import ArcEnd, Signs, SlipArc, after_slip, signs_after, slip_arc, stick_arc
from .integrators import Adaptive, State, slip_field
from .smoothing import integrate, smooth_field, switch_field, switch_mode

#: Local errors of an arc that is followed to its end are kept below this fraction of the tolerance,
#: because near-grazing events amplify them.
SAFETY = 0.03
#: Longest slip arc, well below half a loop; longer ones are cut.
MAX_ARC = 1.0
#: Segments are run in blocks of so many; the budget is rounded up to whole blocks.
BLOCK = 32
#: Lanes in which samples are computed.
SAMPLED = 32


class Events(eqx.Module):
    """The events of a trajectory in order; under a transformation padded to a common length.

    t: times (NaN where padded), shape [events]; y: states (x1, x2), [events, 2]; kind: an
    `EventKind` (0 where padded); belt: index of the belt concerned (-1 where padded), for EDGE
    the belt whose interval ends or begins there, the lowest index where several are concerned.
    """

    t: Array
    y: Array
    kind: Array
    belt: Array

    def __repr__(self) -> str:
        if not is_concrete(self.t) or self.t.ndim != 1:
            return f"Events(t={self.t.shape})"
        counts = [f"{np.sum(np.asarray(self.kind) == kind)} {kind.name}" for kind in EventKind]
        return f"Events({', '.join(counts)})"


class Arcs(eqx.Module):
    """The arcs of a trajectory: smooth pieces, each in one mode; padded like `Events`.

    t: entry times, [arcs]; y: entry states, [arcs, 2]; mode: contact codes, [arcs, belts]
    (+1/-1 slip with that sign of r, 0 stuck, -2/+2 mass below/above the belt's interval);
    duration: [arcs]. Consecutive arcs of one mode occur: an arc also ends at an extremum.
    """

    t: Array
    y: Array
    mode: Array
    duration: Array


class Trajectory(eqx.Module):
    """What `simulate` returns.

    ts: sample times, [samples]; ys: states (x1, x2) there, [samples, 2]; modes: contact codes of
    each belt from that time on, [samples, belts] (+1/-1 slip with that sign of r_i, 0 stuck,
    -2/+2 mass below/above the belt's interval); events: `Events`; arcs: `Arcs`; status: a
    `Status` code. Samples that were not reached are NaN.
    """

    ts: Array
    ys: Array
    modes: Array
    events: Events
    arcs: Arcs
    status: Array

    def __repr__(self) -> str:
        if not is_concrete(self.ts) or self.ts.ndim != 1:
            return f"Trajectory(ts={self.ts.shape}, ys={self.ys.shape})"
        return (
            f"Trajectory(t {self.ts[0]:.6g} to {self.ts[-1]:.6g}, {self.ts.size} samples, "
            f"{self.events!r}, status {Status(int(self.status)).name}: {describe(self.status)})"
        )


# --- slip arcs ------------------------------------------------------------------------------------


@forward_jacobian
@one_kernel
def _adaptive_slip_arc(osc, mode, signs, y, integrator) -> SlipArc:
    return slip_arc(osc, mode, signs, y, integrator, every_extremum=False)


@forward_jacobian
@one_kernel
def _slip_flow(osc, mode, y, integrator):
    """The state after the integrator's span in the slip field of the mode."""
    return integrator.flow(functools.partial(slip_field, osc, mode), y)


# --- segments -------------------------------------------------------------------------------------


class _RunState(eqx.Module):
    """Where a run is: time, state, mode, the signs of x2' and x2, and how it stands."""

    t: Array
    y: State
    mode: Mode
    signs: Signs
    status: Array
    done: Array


def _slip_segment(osc: Oscillator, state: _RunState, t1, rtol, atol) -> tuple[ArcEnd, Array]:
    """A slip arc; and whether the run ends at its end."""
    left = t1 - state.t
    span = jnp.minimum(left, MAX_ARC)
    integrator = Adaptive(span, SAFETY * rtol, SAFETY * atol)
    arc = _adaptive_slip_arc(osc, state.mode, state.signs, state.y, integrator)
    end = after_slip(osc, state.mode, state.signs, arc)
    return end, end.captured | (end.fired < 0) & (left <= MAX_ARC)


def _stick_segment(osc: Oscillator, state: _RunState, t1) -> tuple[ArcEnd, Array]:
    end = stick_arc(osc, state.mode, state.y, t1 - state.t)
    return end, end.fired < 0


class _ArcRecord(eqx.Module):
    """What a segment leaves behind: its arc and the event at its end."""

    t: Array
    y: Array
    mode: Array
    duration: Array
    kind: Array
    belt: Array
    event_t: Array
    event_y: Array


def _stacked_codes(mode: Mode) -> Array:
    return jnp.stack([jnp.asarray(code, dtype=jnp.int8) for code in mode.codes])


def _segment(osc: Oscillator, state: _RunState, t1, rtol, atol) -> tuple[_RunState, _ArcRecord]:
    stuck = state.mode.any_stuck
    # Under vmap both branches run; lanes that are stuck or done then have no slip arc to follow.
    slip_until = jnp.where(stuck | state.done, state.t, t1)
    end, done = lax.cond(
        stuck,
        lambda: _stick_segment(osc, state, t1),
        lambda: _slip_segment(osc, state, slip_until, rtol, atol),
    )
    kind, belt = event_between(state.mode.codes, end.mode.codes)
    # At t1 itself, where no event is before: the sum of the arcs may be short of it by rounding.
    t = jnp.where(done & (kind == 0), t1, state.t + end.duration)
    record = _ArcRecord(
        t=state.t,
        y=jnp.stack(state.y),
        mode=_stacked_codes(state.mode),
        duration=end.duration,
        kind=kind,
        belt=belt,
        event_t=t,
        event_y=jnp.stack(end.y),
    )
    finite = jnp.isfinite(t) & jnp.isfinite(end.y[0]) & jnp.isfinite(end.y[1])
    status = jnp.where(end.captured, Status.PSEUDO_FOCUS, Status.OK)
    status = jnp.where(end.forever, Status.STUCK_FOREVER, status)
    status = jnp.where(end.failed, Status.TOO_MANY_STEPS, status)
    status = jnp.where(finite, status, Status.NOT_FINITE)
    done = done | (t >= t1) | (status != Status.OK)
    # At a pseudo-focus the mass is in no mode; it is told in the one that it came by.
    mode = select(end.captured, state.mode, end.mode)
    return _RunState(t, end.y, mode, end.signs, status, done), record


def _arcs_of_run(
    osc: Oscillator, y0, t0, t1, rtol, atol, max_segments: int
) -> tuple[_RunState, _ArcRecord]:
    """The chain of arcs from y0: the final state and the stacked records, NaN where unused."""
    y = (y0[0], y0[1])
    mode = mode_of_state(osc, *y)
    finite = jnp.all(jnp.isfinite(y0))
    for leaf in jax.tree.leaves(osc):
        finite = finite & jnp.all(~jnp.isnan(leaf))
    status = jnp.where(at_focus(osc, *y), Status.PSEUDO_FOCUS.value, Status.OK.value)
    status = jnp.where(finite, status, Status.NOT_FINITE.value)
    start = _RunState(t0, y, mode, signs_after(osc, mode, y), status, status != Status.OK)

    def segment(given, state):
        osc, t1, rtol, atol = given
        blank = _unused(len(osc.belts))

        def advance():
            new, record = _segment(osc, state, t1, rtol, atol)
            keep = functools.partial(jnp.where, state.done)
            return jax.tree.map(keep, state, new), jax.tree.map(keep, blank, record)

        # A true branch under vmap too: once every lane is done nothing more is computed.
        return lax.cond(any_lane(~state.done), advance, lambda: (state, blank))

    # In blocks, because stepping over what is left of the budget is not free.
    length = min(BLOCK, max_segments)
    blank = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (length, *leaf.shape)), _unused(len(osc.belts))
    )

    @one_kernel
    def segments(given, state):
        return lax.scan(lambda state, _: segment(given, state), state, length=length)

    def block(state, _):
        return lax.cond(
            any_lane(~state.done),
            lambda: segments((osc, t1, rtol, atol), state),
            lambda: (state, blank),
        )

    final, records = lax.scan(block, start, length=-(-max_segments // length))
    records = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), records)
    # A run that begins at a pseudo-focus has one arc, of duration zero.
    blank, zero = _unused(len(osc.belts)), jnp.zeros(())
    rest = replace(blank, t=t0, y=jnp.stack(y), mode=_stacked_codes(mode), duration=zero)
    at_rest = start.status == Status.PSEUDO_FOCUS
    records = jax.tree.map(
        lambda leaf, first: leaf.at[0].set(jnp.where(at_rest, first, leaf[0])), records, rest
    )
    unfinished = jnp.where(final.done, final.status, Status.TOO_MANY_SEGMENTS.value)
    return eqx.tree_at(lambda s: s.status, final, unfinished), records


def _unused(belts: int) -> _ArcRecord:
    """The record of a segment that is not needed."""
    nan, pair, none = jnp.full((), jnp.nan), jnp.full(2, jnp.nan), jnp.zeros((), int)
    mode = jnp.zeros(belts, jnp.int8)
    return _ArcRecord(nan, pair, mode, nan, none, none, event_t=nan, event_y=pair)


def _states_at(osc: Oscillator, final: _RunState, records: _ArcRecord, ts, rtol, atol):
    """States and modes at the times ts, each from the arc that it lies in."""
    entries = jnp.where(jnp.isnan(records.t), jnp.inf, lax.stop_gradient(records.t))
    wanted = ts.size
    if wanted:
        ts = jnp.pad(ts, (0, -wanted % SAMPLED), mode="edge")
    # Past the end of the last arc the run either rests, with a reason, or is unknown.
    rests = (final.status == Status.PSEUDO_FOCUS) | (final.status == Status.STUCK_FOREVER)

    numbers = jnp.maximum(jnp.searchsorted(entries, ts, side="right") - 1, 0)
    arcs = jax.tree.map(lambda leaf: leaf[numbers], records)
    beyond = ts > final.t
    since = jnp.where(beyond, 0.0, ts - arcs.t)
    stuck = jnp.any(arcs.mode == 0, axis=1)

    def at(osc, rtol, atol, arc, since, stuck, goes_on, before, y):
        mode = Mode(tuple(arc.mode[j].astype(float) for j in range(len(osc.belts))))
        start = select(goes_on, (y[0], y[1]), (arc.y[0], arc.y[1]))
        duration = jnp.where(stuck, 0.0, since - jnp.where(goes_on, before, 0.0))
        flown = _slip_flow(osc, mode, start, Adaptive(duration, rtol, atol))
        v = stick_velocity(osc, mode, jnp.zeros(())) / osc.omega
        carried = arc.y[0] + v * since, v
        return jnp.stack(select(stuck, carried, flown))

    # As many pieces of the times as lanes. Each lane goes from one of its samples to the next, or
    # from where the next one's arc begins; so, too, where under a trace the times do not increase.
    first = jnp.arange(ts.size) % max(ts.size // SAMPLED, 1) == 0
    before = jnp.roll(since, 1)
    goes_on = (numbers == jnp.roll(numbers, 1)) & (before <= since) & ~beyond & ~first
    rows = jax.tree.map(
        lambda leaf: jnp.swapaxes(leaf.reshape(SAMPLED, -1, *leaf.shape[1:]), 0, 1),
        (arcs, since, stuck, goes_on, before),
    )
    some = one_kernel(jax.vmap(at, (None, None, None, 0, 0, 0, 0, 0, 0)))

    def advance(y, row):
        y = some(osc, rtol, atol, *row, y)
        return y, y

    _, ys = lax.scan(advance, jnp.zeros((SAMPLED, 2)), rows)
    ys = jnp.swapaxes(ys, 0, 1).reshape(-1, 2)
    afterwards = jnp.where(rests, jnp.stack(final.y), jnp.nan)
    ys = jnp.where(jnp.isnan(arcs.t)[:, None], jnp.nan, ys)
    modes = jnp.where(beyond[:, None], _stacked_codes(final.mode), arcs.mode)
    return jnp.where(beyond[:, None], afterwards, ys)[:wanted], modes[:wanted]


@jit
def _smoothed(osc, y0, t0, t1, ts, rtol, atol, *, width, formulation, resolution) -> Trajectory:
    """A trajectory of the switch or the smooth formulation: samples without events or arcs."""
    if ts is None:
        ts = t0 + (t1 - t0) * jnp.linspace(0.0, 1.0, resolution)
    field = switch_field if formulation == "switch" else smooth_field
    ys = integrate(field, osc, width, y0, t0, ts, rtol, atol)

    def mode_at(y):
        if formulation == "switch":
            return _stacked_codes(switch_mode(osc, y[0], y[1], width))
        return _stacked_codes(contact(osc, y[0], y[1], rightward=True))

    known = jnp.all(jnp.isfinite(ys))
    start_known = jnp.all(jnp.isfinite(y0))
    failure = jnp.where(start_known, Status.TOO_MANY_STEPS.value, Status.NOT_FINITE.value)
    integers, states = jnp.zeros(0, dtype=int), jnp.zeros((0, 2))
    return Trajectory(
        ts,
        ys,
        jax.vmap(mode_at)(ys),
        Events(jnp.zeros(0), states, integers, integers),
        Arcs(jnp.zeros(0), states, jnp.zeros((0, len(osc.belts)), jnp.int8), jnp.zeros(0)),
        jnp.where(known, Status.OK.value, failure),
    )


@jit
def _filippov(osc, y0, t0, t1, ts, rtol, atol, *, max_segments, resolution) -> Trajectory:
    final, records = _arcs_of_run(osc, y0, t0, t1, rtol, atol, max_segments)
    # Events first, in a stable order; the rest is padding.
    has_event = records.kind > 0
    order = jnp.argsort(~has_event, stable=True)
    has_event = has_event[order]
    events = Events(
        t=jnp.where(has_event, records.event_t[order], jnp.nan),
        y=jnp.where(has_event[:, None], records.event_y[order], jnp.nan),
        kind=jnp.where(has_event, records.kind[order], 0),
        belt=jnp.where(has_event, records.belt[order], -1),
    )
    if ts is None:
        # An even grid, and between its points the entries of the arcs, which are known already.
        grid = t0 + (t1 - t0) * jnp.linspace(0.0, 1.0, resolution)
        ys, modes = _states_at(osc, final, records, grid, rtol, atol)
        unused = jnp.isnan(records.t)
        ts = jnp.concatenate([grid, jnp.where(unused, t1, records.t)])
        ys = jnp.concatenate([ys, jnp.where(unused[:, None], ys[-1], records.y)])
        modes = jnp.concatenate([modes, jnp.where(unused[:, None], modes[-1], records.mode)])
        order = jnp.argsort(ts)
        ts, ys, modes = ts[order], ys[order], modes[order]
    else:
        ys, modes = _states_at(osc, final, records, ts, rtol, atol)
    arcs = Arcs(records.t, records.y, records.mode, records.duration)
    return Trajectory(ts, ys, modes, events, arcs, final.status)


def simulate(
    osc: Oscillator,
    y0: ArrayLike | tuple,
    t1: ArrayLike,
    *,
    t0: ArrayLike = 0.0,
    ts: ArrayLike | None = None,
    rtol: ArrayLike = 1e-10,
    atol: ArrayLike = 1e-10,
    formulation: str = "filippov",
    v_star: ArrayLike = 1e-3,
    eps: ArrayLike = 1e-3,
    max_segments: int | None = None,
) -> Trajectory:
    """The motion of the oscillator from y0 over [t0, t1].

    osc: `Oscillator`. y0: start (x1, x2), shape [2]. t0 < t1: time span (dimensionless time
    tau = omega t). ts: the times wanted, increasing, shape [n]; None gives an even grid with the
    ends of all arcs in it. rtol, atol: tolerances of the integrator per step.

    formulation: "filippov", the exact event-driven motion; "switch", the paper's switch model,
    eqs. (21)-(23), with a band of half-width v_star around each boundary; "smooth", with
    tanh(r/eps) in place of sgn(r). The last two have no events.

    max_segments: budget of arcs; None chooses one from the time span. A run that uses it up
    returns what it has, with the status TOO_MANY_SEGMENTS.

    Works under `jax.jit`, `jax.vmap` (batches), `jax.jacfwd` and `jax.jacrev`. There the lengths
    are padded (see `Events`); outside they are cut to what happened.

    `ValueError` names the argument that is impossible. See `Trajectory` for what comes back.
    """
    check_oscillator(osc)
    y0 = as_numbers(y0, "y0", (2,))
    check_finite(y0, "y0")
    t0, t1 = as_numbers(t0, "t0"), as_numbers(t1, "t1")
    check_finite(t0, "t0")
    check_finite(t1, "t1")
    if is_concrete((t0, t1)) and not t1 > t0:
        require(False, "t1", f"> t0 = {t0}", t1)
    rtol, atol = as_numbers(rtol, "rtol"), as_numbers(atol, "atol")
    check_positive(rtol, "rtol")
    check_positive(atol, "atol")
    if ts is not None:
        ts = as_numbers(ts, "ts", (None,))
        check_finite(ts, "ts")
        if is_concrete((ts, t0, t1)):
            if np.any(np.asarray(ts) < t0) or np.any(np.asarray(ts) > t1):
                require(False, "ts", f"within [t0, t1] = [{t0}, {t1}]", ts)
            require(np.all(np.diff(ts) >= 0), "ts", "increasing", ts)
    require(
        formulation in ("filippov", "switch", "smooth"),
        "formulation",
        '"filippov", "switch" or "smooth"',
        repr(formulation),
    )
    span = float(t1 - t0) if is_concrete((t0, t1)) else 100.0
    resolution = 0 if ts is not None else _power_of_two(10 * span, 512)
    if formulation != "filippov":
        name = "v_star" if formulation == "switch" else "eps"
        width = as_numbers(v_star if formulation == "switch" else eps, name)
        check_positive(width, name)
        return _smoothed(
            osc,
            y0,
            t0,
            t1,
            ts,
            rtol,
            atol,
            width=width,
            formulation=formulation,
            resolution=resolution,
        )
    if max_segments is None:
        # Around a pseudo-focus at a contact edge a run has many short arcs.
        max_segments = _power_of_two((64 if has_edges(osc) else 8) * span, 512)
    require(
        isinstance(max_segments, int) and max_segments > 0,
        "max_segments",
        "a positive integer",
        max_segments,
    )
    trajectory = _filippov(
        osc, y0, t0, t1, ts, rtol, atol, max_segments=max_segments, resolution=resolution
    )
    return _without_padding(trajectory, trim_samples=ts is None)


def _power_of_two(value: float, least: int) -> int:
    return max(least, 2 ** math.ceil(math.log2(min(value, 2.0**20))))


def _without_padding(trajectory: Trajectory, *, trim_samples: bool) -> Trajectory:
    """Cut the padding off where lengths are known, that is, outside of transformations."""
    if not is_concrete(trajectory) or trajectory.ts.ndim != 1:
        return trajectory
    known = jax.tree.map(np.asarray, trajectory)

    def rows(tree, numbers):
        return jax.tree.map(lambda leaf: leaf[numbers], tree)

    samples = (known.ts, known.ys, known.modes)
    if trim_samples:
        samples = rows(samples, np.flatnonzero(np.diff(known.ts, prepend=-np.inf)))
    events = rows(known.events, np.flatnonzero(known.events.kind))
    arcs = rows(known.arcs, np.flatnonzero(~np.isnan(known.arcs.t)))
    # Put there as they are: jnp.asarray compiles a program for every shape.
    (ts, ys, modes), events, arcs = jax.device_put((samples, events, arcs))
    return Trajectory(ts, ys, modes, events, arcs, trajectory.status)
