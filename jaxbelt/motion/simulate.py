"""Event-driven trajectories: `simulate` and its result, `Trajectory`.

A trajectory is a chain of arcs. In a slip arc the orbit runs in the smooth field of its mode until
a guard of the mode vanishes; a stick arc is known in closed form. The chain is a `lax.scan` of
segments, an arc each, so that it works under `jit`, `vmap`, and derivatives forward and reverse.

Slip arcs are integrated by `diffrax.diffeqsolve` with one scalar event, the smallest guard. It is
looked at after each step; where it is negative, the step is made once more, shorter, so that it
ends on the first root of a guard, see `roots`. That root cannot hide within the step: besides the
boundaries and edges, an arc also ends where the acceleration changes its sign (and, before a
contact edge, where the velocity does), unless no boundary (no edge) is within reach. Between two
such extrema x2 (x1) is monotone, so the sign at the end of a step tells all, and the sign at the
extremum itself whether an orbit that grazes a boundary (an edge) meets it. Between two zeros of x2'
lies a zero of x2, since x2'' = -x2 there: two extrema of x2 in one step would take half a loop
around a focus within it, which `MAX_ARC` and `MAX_STEP` exclude.

Samples at given times are taken from the arcs afterwards, in parallel.
"""

import functools
import math
from dataclasses import replace
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

from ..checks import as_numbers, check_finite, check_positive, is_concrete, require
from ..model.modes import (
    Mode,
    at_focus,
    boundary_guards,
    bounds_leftward,
    bounds_rightward,
    contact,
    edge_guards,
    first_of,
    leave_slip,
    leave_stick,
    mode_acceleration,
    mode_of_state,
    select,
    stick_phase,
    stick_velocity,
)
from ..model.oscillator import Oscillator, check_oscillator
from ..numerics.compiling import any_lane, jit, one_kernel
from ..numerics.derivatives import forward_jacobian
from ..numerics.extrapolation import increments, scheme
from ..numerics.roots import first_root
from ..results import EventKind, Status, describe
from .smoothing import integrate, smooth_field, switch_field, switch_mode

#: Longest and first step, as fractions of the time that is integrated over, MAX_ARC at most.
MAX_STEP, FIRST_STEP = 0.5, 0.2
#: Local errors of an arc that is followed to its end are kept below this fraction of the tolerance,
#: because near-grazing events amplify them.
SAFETY = 0.03
#: Longest slip arc, well below half a loop; longer ones are cut.
MAX_ARC = 1.0
#: Segments are run in blocks of so many; the budget is rounded up to whole blocks.
BLOCK = 32
#: Lanes in which samples are computed.
SAMPLED = 32
#: Steps that one segment may take before it is given up.
MAX_STEPS = 100_000


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


class _Extrapolation(diffrax.AbstractAdaptiveSolver):
    """The midpoint rule extrapolated to order eight, the error from the extrapolation to six.

    Its state is where its last step began and where it ended, (t, x1, x2) each.
    """

    scheme: ClassVar = scheme((2, 4, 6, 8), (2, 4, 6))
    term_structure = diffrax.ODETerm
    interpolation_cls = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return 7  # that of the controlled error

    def init(self, terms, t0, t1, y0, args):
        return (t0, *y0), (t0, *y0)

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        def field(y):
            return terms.vf(t0, y, args)

        best, lower = increments(field, y0, t1 - t0, self.scheme)
        y1 = tuple(a + b for a, b in zip(y0, best, strict=True))
        error = tuple(a - b for a, b in zip(best, lower, strict=True))
        last = (t0, *y0), (t1, *y1)
        return y1, error, {"y0": y0, "y1": y1}, last, diffrax.RESULTS.successful


def _velocity(osc, mode, y):
    x1, x2 = y
    return x2, mode_acceleration(osc, mode, x1, x2)


def _single_step(osc, mode, y, h):
    """The state one step of size h after y, in the field of the mode."""
    best, _ = increments(functools.partial(_velocity, osc, mode), y, h, _Extrapolation.scheme)
    return tuple(a + b for a, b in zip(y, best, strict=True))


def _integrate(osc, mode, y, span, rtol, atol, left=None):
    """From y in the slip field for the time `span`, or until left(t, y, ...).

    Returns the last step's beginning and end, (t, x1, x2) each, t as a fraction of the span, and
    whether it left. In units of the span the times are plain numbers: where they are not, diffrax
    checks them with a callback, and that has no place in one kernel. Nor have the writes into
    arrays that saving a result is in a batch; so the result is the solver's state.
    """

    def field(t, y, args):
        return tuple(span * slope for slope in _velocity(osc, mode, y))

    def norm(y):
        # A lane that has nothing to do, and may be NaN, must not keep a batch waiting.
        return jnp.where(span > 0, jnp.maximum(*(jnp.abs(part) for part in y)), 0.0)

    # Where no event is looked for, a step may be as long as its error allows.
    first, longest = (1.0, 1.0) if left is None else (FIRST_STEP, MAX_STEP)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        _Extrapolation(),
        t0=0.0,
        t1=1.0,
        dt0=first,
        y0=y,
        saveat=diffrax.SaveAt(solver_state=True),
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=atol, dtmax=longest, norm=norm),
        event=None if left is None else diffrax.Event(left),
        adjoint=diffrax.ForwardMode(),
        max_steps=MAX_STEPS,
        throw=False,
    )
    last: Any = solution.solver_state
    return *last, solution.event_mask


def _all_guards(osc: Oscillator, mode: Mode, extremum: tuple[Array, Array], y) -> Array:
    """The guards of a slip mode: boundaries, edges, then the extremum of x2 and of x1."""
    x1, x2 = y
    a = mode_acceleration(osc, mode, x1, x2)
    guards = [*boundary_guards(osc, mode, x2), *edge_guards(osc, mode, x1)]
    return jnp.stack([*guards, extremum[0] * a, extremum[1] * x2])


def _that_count(osc: Oscillator, mode: Mode, extremum: tuple[Array, Array], guards: Array) -> Array:
    """The same, larger where they do not count.

    A boundary or edge from which the orbit moves away until its next extremum does not, nor does an
    extremum while what it protects is out of reach of one step.
    """
    n = len(osc.belts)
    boundary, edge, extremum_x2, extremum_x1 = guards[:n], guards[n : 3 * n], guards[-2], guards[-1]
    reach = jnp.abs(extremum_x2) + jnp.abs(extremum_x1)
    extremum_x2 = jnp.maximum(extremum_x2, jnp.min(boundary) / osc.omega - reach)
    extremum_x1 = jnp.maximum(extremum_x1, jnp.min(edge) - reach)
    nears_boundary = extremum[0] * jnp.stack(mode.codes) > 0
    rightward, leftward = jnp.stack(bounds_rightward(mode)), jnp.stack(bounds_leftward(mode))
    nears_edge = jnp.where(extremum[1] > 0, rightward, leftward)
    nears = jnp.concatenate([nears_boundary, nears_edge])
    return jnp.append(jnp.where(nears, guards[:-2], jnp.inf), jnp.stack([extremum_x2, extremum_x1]))


class _SlipArc(eqx.Module):
    """End of a slip arc: its duration and state, the guard that fired (-1: none), failure."""

    duration: Array
    y: tuple[Array, Array]
    fired: Array
    failed: Array


@forward_jacobian
@one_kernel
def _slip_arc(osc, mode, extremum, y, span, rtol, atol) -> _SlipArc:
    """Follow the slip arc from y until a guard fires or the time span is over."""

    def left_mode(t, y, args, **kwargs):
        # A rejected first step leaves t = 0, where a guard may vanish.
        guards = _that_count(osc, mode, extremum, _all_guards(osc, mode, extremum, y))
        return (t > 0) & (jnp.min(guards) < 0)

    started, reached, hit = _integrate(osc, mode, y, span, SAFETY * rtol, SAFETY * atol, left_mode)
    (t_start, *start), (t_end, *y_end) = started, reached
    hit = jnp.asarray(hit)
    finished = hit | (t_end >= 1)
    t_start, t_end = span * t_start, span * t_end

    # Make the last step once more, to the root instead of beyond it.
    start, y_end = tuple(start), tuple(y_end)
    last = lax.stop_gradient(t_end - t_start)
    still = lax.stop_gradient((osc, mode, start))
    f_osc, f_mode, f_extremum, f_end = lax.stop_gradient((osc, mode, extremum, y_end))

    def guards_at(y):
        def guards(*y):
            return _all_guards(f_osc, f_mode, f_extremum, y)

        values, slopes = jax.jvp(guards, y, _velocity(f_osc, f_mode, y))
        return _that_count(f_osc, f_mode, f_extremum, values), slopes

    values, slopes = guards_at(f_end)
    root, fired = first_root(
        lambda h: guards_at(_single_step(*still, h)),
        guards_at(still[-1]),
        last,
        (jnp.where(hit, values, jnp.inf), slopes),
        extrema=2,
    )
    # An extremum is invisible: nothing depends on where the arc is split.
    is_event = hit & (fired < 3 * len(osc.belts))

    def guard_fired(*y):
        guards = _all_guards(osc, mode, extremum, y)
        return jnp.sum(jnp.where(jnp.arange(guards.size) == fired, guards, 0.0))

    # Two Newton steps, small ones: the digits that are left, and derivatives to second order.
    def polish(carry, _):
        h = carry[0]
        y = _single_step(osc, mode, start, h)
        guard, slope = jax.jvp(guard_fired, y, _velocity(osc, mode, y))
        regular = jnp.abs(slope) * 1e-3 * last > jnp.abs(lax.stop_gradient(guard))
        shift = jnp.where(regular, guard / jnp.where(regular, slope, 1.0), 0.0)
        return (h - jnp.where(is_event, shift, 0.0), h, y), None

    h = jnp.where(hit, root, jnp.where(finished, span - t_start, last))
    (_, h, y), _ = lax.scan(polish, (h, h, start), length=3)
    return _SlipArc(
        duration=t_start + h,
        y=y,
        fired=jnp.where(hit, fired, -1),
        failed=~finished,
    )


@forward_jacobian
@one_kernel
def _flow(osc, mode, y, duration, rtol, atol):
    """The state after `duration` in the slip field of the mode, no events looked for."""
    _, (_, *y_end), _ = _integrate(osc, mode, y, duration, rtol, atol)
    return tuple(y_end)


# --- segments -------------------------------------------------------------------------------------


class _State(eqx.Module):
    """Where a run is: time, state, mode, the extremum signs of x2' and x2, and how it stands."""

    t: Array
    y: tuple[Array, Array]
    mode: Mode
    extremum: tuple[Array, Array]
    status: Array
    done: Array


class _Step(eqx.Module):
    """An arc's end: duration, state, next mode, the event, extremum signs where they are known."""

    duration: Array
    y: tuple[Array, Array]
    mode: Mode
    extremum: tuple[Array, Array]
    kind: Array
    status: Array
    done: Array


def _sign(value, tie):
    return jnp.where(value == 0, tie, jnp.sign(value))


def _extremum_signs(osc, mode, y):
    """Signs of x2' and x2 just after y. Where x2' = 0, as at slip onset, x2'' = -x2 decides."""
    x1, x2 = y
    a = mode_acceleration(osc, mode, x1, x2)
    tangent = jnp.abs(a) < 1e-12 * (1 + jnp.abs(x1))
    a = jnp.where(tangent, -x2, a)
    return lax.stop_gradient((_sign(a, 1.0), _sign(x2, _sign(a, 1.0))))


def _slip_segment(osc: Oscillator, state: _State, t1, rtol, atol) -> _Step:
    n = len(osc.belts)
    left = t1 - state.t
    span = jnp.minimum(left, MAX_ARC)
    arc = _slip_arc(osc, state.mode, state.extremum, state.y, span, rtol, atol)
    fired = arc.fired
    ended = (fired < 0) & (left <= MAX_ARC)

    after = leave_slip(osc, state.mode, fired, *arc.y)
    x1, x2 = after.x1, jnp.where(after.captured, 0.0, after.x2)
    kind = jnp.where(
        after.at_boundary,
        jnp.where(after.mode.any_stuck, EventKind.STICK, EventKind.CROSS),
        jnp.where(after.at_edge, EventKind.EDGE, 0),
    )
    flipped = (
        jnp.where(fired == 3 * n, -state.extremum[0], state.extremum[0]),
        jnp.where(fired == 3 * n + 1, -state.extremum[1], state.extremum[1]),
    )
    fresh = _extremum_signs(osc, after.mode, (x1, x2))
    status = jnp.where(after.captured, Status.PSEUDO_FOCUS, Status.OK)
    status = jnp.where(arc.failed, Status.TOO_MANY_STEPS, status)
    return _Step(
        duration=arc.duration,
        y=(x1, x2),
        mode=after.mode,
        extremum=select(after.at_boundary | after.at_edge, fresh, flipped),
        kind=kind,
        status=status,
        done=ended | after.captured,
    )


def _stick_segment(osc: Oscillator, state: _State, t1) -> _Step:
    x1, x2 = state.y
    phase = stick_phase(osc, state.mode, x1)
    left = t1 - state.t
    ended = phase.duration >= left
    duration = jnp.where(ended, left, phase.duration)
    x1_end = jnp.where(ended, x1 + x2 * left, phase.x1)
    mode = select(ended, state.mode, leave_stick(osc, state.mode, phase, x2))
    forever = jnp.isinf(phase.duration)
    return _Step(
        duration=duration,
        y=(x1_end, x2),
        mode=mode,
        extremum=_extremum_signs(osc, mode, (x1_end, x2)),
        kind=jnp.where(ended, 0, jnp.where(phase.slips, EventKind.SLIP, EventKind.EDGE)),
        status=jnp.where(forever, Status.STUCK_FOREVER, Status.OK),
        done=ended,
    )


def _first_change(before, after) -> Array:
    """The lowest index of a belt for which two tuples of arrays differ, or -1."""
    changed = [a != b for a, b in zip(before, after, strict=True)]
    return first_of(changed, [jnp.asarray(i) for i in range(len(changed))], jnp.asarray(-1))


class _Record(eqx.Module):
    """What a segment leaves behind: its arc and the event at its end."""

    t: Array
    y: Array
    mode: Array
    duration: Array
    kind: Array
    belt: Array
    event_t: Array
    event_y: Array


def _codes(mode: Mode) -> Array:
    return jnp.stack([jnp.asarray(code, dtype=jnp.int8) for code in mode.codes])


def _segment(osc: Oscillator, state: _State, t1, rtol, atol) -> tuple[_State, _Record]:
    stuck = state.mode.any_stuck
    # Under vmap both branches run; lanes that are stuck or done then have no slip arc to follow.
    slip_until = jnp.where(stuck | state.done, state.t, t1)
    step = lax.cond(
        stuck,
        lambda: _stick_segment(osc, state, t1),
        lambda: _slip_segment(osc, state, slip_until, rtol, atol),
    )
    # At t1 itself, where no event is before: the sum of the arcs may be short of it by rounding.
    out_of_time = step.done & (step.kind == 0)
    t = jnp.where(out_of_time, t1, state.t + step.duration)
    finite = jnp.isfinite(t) & jnp.isfinite(step.y[0]) & jnp.isfinite(step.y[1])
    status = jnp.where(finite, step.status, Status.NOT_FINITE)
    belt = jnp.where(
        step.kind == EventKind.EDGE,
        _first_change(state.mode.touching, step.mode.touching),
        _first_change(state.mode.codes, step.mode.codes),
    )
    record = _Record(
        t=state.t,
        y=jnp.stack(state.y),
        mode=_codes(state.mode),
        duration=step.duration,
        kind=step.kind,
        belt=jnp.where(step.kind == 0, -1, belt),
        event_t=t,
        event_y=jnp.stack(step.y),
    )
    done = step.done | (t >= t1) | (status != Status.OK)
    new = _State(t, step.y, step.mode, step.extremum, status, done)
    return new, record


def _run(osc: Oscillator, y0, t0, t1, rtol, atol, max_segments: int) -> tuple[_State, _Record]:
    """The chain of arcs from y0: the final state and the stacked records, NaN where unused."""
    y = (y0[0], y0[1])
    mode = mode_of_state(osc, *y)
    finite = jnp.all(jnp.isfinite(y0))
    for leaf in jax.tree.leaves(osc):
        finite = finite & jnp.all(~jnp.isnan(leaf))
    status = jnp.where(at_focus(osc, *y), Status.PSEUDO_FOCUS.value, Status.OK.value)
    status = jnp.where(finite, status, Status.NOT_FINITE.value)
    start = _State(t0, y, mode, _extremum_signs(osc, mode, y), status, status != Status.OK)

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
    rest = replace(blank, t=t0, y=jnp.stack(y), mode=_codes(mode), duration=zero)
    at_rest = start.status == Status.PSEUDO_FOCUS
    records = jax.tree.map(
        lambda leaf, first: leaf.at[0].set(jnp.where(at_rest, first, leaf[0])), records, rest
    )
    unfinished = jnp.where(final.done, final.status, Status.TOO_MANY_SEGMENTS.value)
    return eqx.tree_at(lambda s: s.status, final, unfinished), records


def _unused(belts: int) -> _Record:
    """The record of a segment that is not needed."""
    nan, pair, none = jnp.full((), jnp.nan), jnp.full(2, jnp.nan), jnp.zeros((), int)
    mode = jnp.zeros(belts, jnp.int8)
    return _Record(nan, pair, mode, nan, none, none, event_t=nan, event_y=pair)


def _sample(osc: Oscillator, final: _State, records: _Record, ts, rtol, atol):
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
        flown = _flow(osc, mode, start, duration, rtol, atol)
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
    modes = jnp.where(beyond[:, None], _codes(final.mode), arcs.mode)
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
            return _codes(switch_mode(osc, y[0], y[1], width))
        return _codes(contact(osc, y[0], y[1], rightward=True))

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
    final, records = _run(osc, y0, t0, t1, rtol, atol, max_segments)
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
        ys, modes = _sample(osc, final, records, grid, rtol, atol)
        unused = jnp.isnan(records.t)
        ts = jnp.concatenate([grid, jnp.where(unused, t1, records.t)])
        ys = jnp.concatenate([ys, jnp.where(unused[:, None], ys[-1], records.y)])
        modes = jnp.concatenate([modes, jnp.where(unused[:, None], modes[-1], records.mode)])
        order = jnp.argsort(ts)
        ts, ys, modes = ts[order], ys[order], modes[order]
    else:
        ys, modes = _sample(osc, final, records, ts, rtol, atol)
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
        max_segments = _power_of_two((64 if _has_edges(osc) else 8) * span, 512)
    require(
        isinstance(max_segments, int) and max_segments > 0,
        "max_segments",
        "a positive integer",
        max_segments,
    )
    trajectory = _filippov(
        osc, y0, t0, t1, ts, rtol, atol, max_segments=max_segments, resolution=resolution
    )
    return _trim(trajectory, trim_samples=ts is None)


def _has_edges(osc: Oscillator) -> bool:
    """Whether a contact edge is finite, or not known to be infinite."""
    bounds = [(belt.lower, belt.upper) for belt in osc.belts]
    return not is_concrete(bounds) or bool(np.any(np.isfinite(np.asarray(bounds))))


def _power_of_two(value: float, least: int) -> int:
    return max(least, 2 ** math.ceil(math.log2(min(value, 2.0**20))))


def _trim(trajectory: Trajectory, *, trim_samples: bool) -> Trajectory:
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
