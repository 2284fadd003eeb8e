"""A run: the chain of arcs from its start to t1, or to where it ends before.

In a slip arc the orbit runs in the smooth field of its mode until a guard of the mode vanishes; a
stick arc is known in closed form. How the arcs are followed depends on what is asked:

- a run by itself (`_alone`): a `lax.scan` of segments, one arc of `arcs` each, with slip arcs
  integrated by diffrax (`integrators.Adaptive`);
- a batch, under `vmap` (`_together`): lanes of the kernel, see `batches` and `kernel.step`, at one
  tolerance for all, the smallest;
- with a clock: a run by itself, of arcs of `timed`; a batch is as many runs by themselves;
- derivatives (the rule of `arcs_of_run`): the known arcs are integrated once more, see
  `sensitivities`.

A loop that a run repeats is followed once, see `kernel.marks` and `loops`.

The arcs of a run by itself end at extrema where a boundary or an edge is within reach, and else
after the time MAX_ARC. So no root hides within a step: between two zeros of x2' lies a zero of x2,
since x2'' = -x2 there, and two extrema of x2 in one step would take half a loop around a focus
within it, which `MAX_ARC` and `MAX_FRACTION` exclude.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..kernel.marks import LoopSearch
from ..model.events import event_between
from ..model.instants import begun_at
from ..model.modes import Mode, mode_acceleration, select
from ..model.oscillator import Oscillator, has_clock, has_possible_numbers
from ..model.rest import is_at_rest
from ..model.transitions import at_focus, mode_of_state
from ..numerics.compiling import any_lane, more_rows, of_lane, one_kernel, with_batches
from ..numerics.derivatives import moving_and_fixed
from ..numerics.padding import in_groups_of
from ..results import Status
from .arcs import ArcEnd, Signs, SlipArc, after_slip, signs_after, slip_arc, stick_arc
from .batches import BOOK, LANES_AT_ONCE, PAGE, Batch, Group, blank_book, followed_together
from .integrators import Adaptive, State
from .loops import RepeatedLoop
from .sampling import arcs_at, sampled
from .sensitivities import (
    Arc,
    Sensitivity,
    in_one_row,
    parts_of_states,
    sensitivities,
    with_derivatives,
)
from .timed import TimedArc, timed_arc

#: Local errors of an arc that is followed to its end are kept below this fraction of the tolerance,
#: because near-grazing events amplify them.
SAFETY = 0.03
#: Longest slip arc, well below half a loop; longer ones are cut.
MAX_ARC = 1.0
#: Segments are run in blocks of so many; the budget is rounded up to whole blocks.
BLOCK = 32


@one_kernel
def _adaptive_slip_arc(osc, mode, signs, y, integrator) -> SlipArc:
    return slip_arc(osc, mode, signs, y, integrator, every_extremum=False)


class RunState(eqx.Module):
    """Where a run is: time, state, mode, signs of x2' and x2, status, and whether it is done."""

    t: Array
    y: State
    mode: Mode
    signs: Signs
    status: Array
    done: Array

    @property
    def x1(self) -> Array:
        """Displacement."""
        return self.y[0]

    @property
    def x2(self) -> Array:
        """Velocity."""
        return self.y[1]


def _slip_segment(osc: Oscillator, state: RunState, t1, rtol, atol) -> tuple[ArcEnd, Array]:
    """The next slip arc, and whether the run ends with it."""
    remaining = t1 - state.t
    span = jnp.minimum(remaining, MAX_ARC)
    integrator = Adaptive(osc, state.mode, span, SAFETY * rtol, SAFETY * atol)
    arc = _adaptive_slip_arc(osc, state.mode, state.signs, state.y, integrator)
    # At rest up to rounding the mass stays, even on a guard.
    a = mode_acceleration(osc, state.mode, *arc.y)
    rests = (arc.ended_by >= 0) & is_at_rest(arc.y[0], arc.y[1], a)
    stays = replace(
        arc, duration=jnp.maximum(arc.duration, span), ended_by=jnp.full_like(arc.ended_by, -1)
    )
    end = after_slip(osc, state.mode, state.signs, select(rests, stays, arc))
    return end, end.captured | (end.ended_by < 0) & (remaining <= MAX_ARC)


def _stick_segment(osc: Oscillator, state: RunState, t1) -> tuple[ArcEnd, Array]:
    end = stick_arc(osc, state.mode, state.y, t1 - state.t)
    return end, end.ended_by < 0


class ArcRecord(eqx.Module):
    """The record of a segment: its arc, the event at the arc's end, and what ended the arc.

    ended_by, in_time, captured: as in `flights.Arc`.
    """

    t: Array
    y: Array
    mode: Array
    duration: Array
    kind: Array
    belt: Array
    event_t: Array
    event_y: Array
    ended_by: Array
    in_time: Array
    captured: Array


def stacked_codes(mode: Mode) -> Array:
    """The contact codes of a mode, [belts]."""
    return jnp.stack([jnp.asarray(code, dtype=jnp.int8) for code in mode.codes])


def _segment(osc: Oscillator, state: RunState, t1, rtol, atol) -> tuple[RunState, ArcRecord]:
    if has_clock(osc):
        return _timed_segment(osc, state, t1, rtol, atol)
    stuck = state.mode.any_stuck
    # Under vmap both branches run; lanes that are stuck or done then have no slip arc to follow.
    slip_until = jnp.where(stuck | state.done, state.t, t1)
    end, done = lax.cond(
        stuck,
        lambda: _stick_segment(osc, state, t1),
        lambda: _slip_segment(osc, state, slip_until, rtol, atol),
    )
    return _after_arc(state, end, done, t1)


@one_kernel
def _timed_in_one_piece(osc, mode, y, until, rtol, atol) -> TimedArc:
    return timed_arc(osc, mode, y, until, rtol, atol)


def _timed_segment(osc: Oscillator, state: RunState, t1, rtol, atol):
    """`_segment` with a clock."""
    x1, x2, t = state.y
    until = jnp.where(state.done, state.t, t1)
    arc = _timed_in_one_piece(osc, state.mode, (x1, x2, t), until, SAFETY * rtol, SAFETY * atol)
    return _after_arc(state, arc.end, arc.done, t1)


def _after_arc(state: RunState, end: ArcEnd, done: Array, t1) -> tuple[RunState, ArcRecord]:
    kind, belt = event_between(state.mode.codes, end.mode.codes)
    # A run that ends without an event ends at t1 itself: rounding may leave the sum of arcs short.
    t = jnp.where(done & (kind == 0), t1, state.t + end.duration)
    if len(end.y) == 3:
        end = replace(end, y=(*end.y[:2], t))
    record = ArcRecord(
        t=state.t,
        y=jnp.stack(state.y),
        mode=stacked_codes(state.mode),
        duration=end.duration,
        kind=kind,
        belt=belt,
        event_t=t,
        event_y=jnp.stack(end.y),
        ended_by=end.ended_by,
        in_time=done & ~end.captured,
        captured=end.captured,
    )
    finite = jnp.isfinite(t) & jnp.isfinite(end.y[0]) & jnp.isfinite(end.y[1])
    status = jnp.where(end.captured, Status.PSEUDO_FOCUS, Status.OK)
    status = jnp.where(end.forever, Status.STUCK_FOREVER, status)
    status = jnp.where(end.failed, Status.TOO_MANY_STEPS, status)
    status = jnp.where(finite, status, Status.NOT_FINITE)
    done = done | (t >= t1) | (status != Status.OK)
    # At a pseudo-focus the mass is in no mode; the mode before is reported.
    mode = select(end.captured, state.mode, end.mode)
    return RunState(t, end.y, mode, end.signs, status, done), record


class Rules(NamedTuple):
    """What is fixed when runs are compiled.

    max_segments: largest number of arcs of a run; followed: largest number of arcs that are
    followed, without those of loops that are only repeated.
    """

    max_segments: int
    followed: int


def _followed_arcs(
    osc: Oscillator, y0, t0, t1, rtol, atol, rules: Rules
) -> tuple[RunState, ArcRecord, RepeatedLoop]:
    y: State = (y0[0], y0[1])
    ones = jnp.ones_like(y0[0])
    if has_clock(osc):
        y = (*y, t0)
        mode, rests = begun_at(osc, (y0[0], y0[1], t0))
    else:
        mode, rests = mode_of_state(osc, *y), at_focus(osc, *y)
    finite = jnp.all(jnp.isfinite(y0)) & has_possible_numbers(osc)
    status = jnp.where(rests, Status.PSEUDO_FOCUS.value, Status.OK.value)
    status = jnp.where(finite, status, Status.NOT_FINITE.value)
    signs = (ones, ones) if has_clock(osc) else signs_after(osc, mode, y)
    start = RunState(t0, y, mode, signs, status, status != Status.OK)

    def segment(given, carry):
        (osc, t1, rtol, atol), (state, repeat) = given, carry
        blank = _unused(len(osc.belts), len(y))

        def advance():
            new, record = _segment(osc, state, t1, rtol, atol)
            keep = functools.partial(jnp.where, state.done)
            if has_clock(osc):
                # No search for a loop: the forces need not repeat when the mass does.
                after = jax.tree.map(keep, state, new), repeat
                return after, jax.tree.map(keep, blank, record)
            ended = replace(repeat, number=repeat.number + 1)
            released = state.mode.any_stuck & ~new.mode.any_stuck & ~new.done
            found, t = ended.advanced(new, released, t1, jnp.ones(()), rules.max_segments)
            after = jax.tree.map(keep, carry, (replace(new, t=t), found))
            return after, jax.tree.map(keep, blank, record)

        # A true branch under vmap too: once every lane is done nothing more is computed.
        return lax.cond(any_lane(~state.done), advance, lambda: (carry, blank))

    # In blocks, because skipping the rest of the budget arc by arc is not free.
    length = min(BLOCK, rules.followed)
    blank = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (length, *leaf.shape)),
        _unused(len(osc.belts), len(y)),
    )

    @one_kernel
    def segments(given, carry):
        return lax.scan(lambda carry, _: segment(given, carry), carry, length=length)

    def block(carry, _):
        return lax.cond(
            any_lane(~carry[0].done),
            lambda: segments((osc, t1, rtol, atol), carry),
            lambda: (carry, blank),
        )

    blocks = -(-rules.followed // length)
    (final, repeat), records = lax.scan(block, (start, LoopSearch.none(t0)), length=blocks)
    records = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), records)
    # A run that begins at a pseudo-focus has one arc, of duration zero.
    blank, zero = _unused(len(osc.belts), len(y)), jnp.zeros(())
    rest = replace(blank, t=t0, y=jnp.stack(y), mode=stacked_codes(mode), duration=zero)
    at_rest = start.status == Status.PSEUDO_FOCUS
    records = jax.tree.map(
        lambda leaf, first: leaf.at[0].set(jnp.where(at_rest, first, leaf[0])), records, rest
    )
    unfinished = jnp.where(final.done, final.status, Status.TOO_MANY_SEGMENTS.value)
    loop = RepeatedLoop(*(n.astype(int) for n in (repeat.first, repeat.last, repeat.loops)))
    return eqx.tree_at(lambda s: s.status, final, unfinished), records, loop


def _alone(osc: Oscillator, y0, t0, t1, ts, rtol, atol, *, rules: Rules):
    """`arcs_of_run` of one run."""
    final, records, loop = _followed_arcs(osc, y0, t0, t1, rtol, atol, rules)
    ts = loop.followed(ts, records.event_t)
    return final, records, loop, sampled(osc, records, ts, rtol, atol)


def _together(lane, axis_size, batched, *args, rules: Rules):
    """`arcs_of_run` of a batch."""
    leaves, structure = jax.tree.flatten(args)
    flags = tuple(jax.tree.leaves(batched))
    return _rows_together(lane, structure, flags, axis_size, rules)(*leaves)


def _rows_together(lane, structure, flags, count: int, rules: Rules) -> Callable:
    """`arcs_of_run` of `count` rows, as a function of the leaves of its arguments: [rows, ..] where
    flagged, else the same for all. Under `vmap` a batch becomes so many more rows."""

    def call(*leaves):
        batched = jax.tree.unflatten(structure, flags)
        return _followed_rows(lane, count, batched, jax.tree.unflatten(structure, leaves), rules)

    def batch(_, size, outer, *leaves):
        differ = tuple(a or b for a, b in zip(flags, outer, strict=True))
        rows = map(functools.partial(more_rows, size, count), leaves, flags, outer)
        out = _rows_together(lane, structure, differ, size * count, rules)(*rows)
        return jax.tree.map(lambda leaf: leaf.reshape(size, count, *leaf.shape[1:]), out)

    return with_batches(call, batch)


def _followed_rows(lane, axis_size: int, batched, args, rules: Rules):
    osc, y0, t0, t1, ts, rtol, atol = args
    one, rows = of_lane(lane, batched, args)
    shapes = jax.eval_shape(one, [leaf[0] for leaf in rows])
    room = shapes[1].t.shape[0]
    rounds = -(-room // PAGE) * PAGE
    width = min(LANES_AT_ONCE.here, -(-axis_size // 8) * 8, max(8, BOOK.here // rounds))
    batch = Batch(width, rounds, room, rules.max_segments, len(osc.belts))
    groups = -(-axis_size // width)

    def by_group(leaf):
        # Spare lanes, which fill up the last group, start at NaN and do nothing.
        return in_groups_of(width, leaf, fill=jnp.nan)

    def spread(leaf, flag):
        return leaf if flag else jnp.broadcast_to(leaf, (axis_size, *jnp.shape(leaf)))

    y0, t0, t1, ts = (
        spread(leaf, flag) for leaf, flag in zip(args[1:5], batched[1:5], strict=True)
    )
    # One tolerance for all: the smallest.
    rtol, atol = jnp.min(rtol), jnp.min(atol)
    of_group, leaves = of_lane(lambda osc: osc, (batched[0],), (osc,))

    def group(book, rows):
        leaves, y0, t0, t1, ts = rows
        osc = of_group(leaves)
        out, book = followed_together(
            osc, (y0[:, 0], y0[:, 1]), t1 - t0, (ts - t0[:, None]).T, rtol, atol, batch, book
        )
        return book, _as_runs(out, t0, t1, shapes)

    rows_of_groups = jax.tree.map(by_group, (leaves, y0, t0, t1, ts))
    blank = blank_book(of_group([leaf[0] for leaf in rows_of_groups[0]]), batch)
    _, (found, alone) = lax.scan(group, blank, rows_of_groups)
    found, alone = jax.tree.map(
        lambda leaf: leaf.reshape(groups * width, *leaf.shape[2:])[:axis_size], (found, alone)
    )

    def again():
        def turn(row):
            alone, found, rows = row
            return lax.cond(alone, lambda: one(rows), lambda: found)

        return lax.map(turn, (alone, found, rows))

    return lax.cond(jnp.any(alone), again, lambda: found)


def _as_runs(group: Group, t0: Array, t1: Array, shapes) -> tuple[Any, Array]:
    """The runs of a group as `arcs_of_run` returns them, [lanes, ..], and which to follow alone."""
    lanes, arcs, used = group.lanes, group.arcs, group.used

    def column(name, blank):
        value = (
            jnp.stack(arcs[name], axis=-1) if isinstance(arcs[name], tuple | list) else arcs[name]
        )
        there = used.reshape(*used.shape, *[1] * (value.ndim - 2))
        blank = jnp.broadcast_to(blank, value.shape).astype(value.dtype)
        return jnp.where(there, value, blank)

    blank = _unused(shapes[1].mode.shape[1])
    records = {name: column(name, getattr(blank, name)) for name in arcs}
    for name in ("t", "event_t"):
        records[name] = records[name] + t0[None]
    # As in a run by itself, an arc that ends the run in time ends at t1 itself.
    is_end = used & arcs["in_time"]
    records["event_t"] = jnp.where(is_end, t1[None], records["event_t"])
    records = ArcRecord(**{name: jnp.swapaxes(value, 0, 1) for name, value in records.items()})
    ended = lanes.status == Status.PSEUDO_FOCUS.value
    nowhere = lanes.status == Status.NOT_FINITE.value
    final = RunState(
        t=jnp.where(lanes.done & ~ended & ~nowhere, t1, t0 + lanes.t),
        y=(lanes.x1, lanes.x2),
        mode=lanes.mode,
        signs=(jnp.ones_like(lanes.x1), jnp.ones_like(lanes.x1)),
        status=lanes.status,
        done=lanes.done,
    )
    samples = jnp.moveaxis(jnp.where(nowhere[None, None], jnp.nan, group.samples), -1, 0)
    out = jax.tree.map(
        lambda leaf, like: leaf.astype(like.dtype), (final, records, group.loop, samples), shapes
    )
    return out, group.alone


@eqx.filter_custom_jvp
def arcs_of_run(osc: Oscillator, y0, t0, t1, ts, rtol, atol, rules: Rules):
    """The chain of arcs from y0: the final state, the stacked records of the arcs that were
    followed, NaN where unused, the `RepeatedLoop`, and the states at the times ts, [samples, 2],
    without derivatives (those past the end are undefined)."""
    numbers = map(jnp.asarray, (y0, t0, t1, ts, rtol, atol))
    if has_clock(osc):
        return _alone(osc, *numbers, rules=rules)
    return _followed_by(rules)(osc, *numbers)


@functools.cache
def _followed_by(rules: Rules) -> Callable:
    return with_batches(*(functools.partial(part, rules=rules) for part in (_alone, _together)))


@arcs_of_run.def_jvp
def _(primals, tangents):
    osc, y0, t0, t1, *_ = primals
    final, records, loop, samples = arcs_of_run(*primals)
    varied, rest = moving_and_fixed(osc, tangents[0])
    used = ~jnp.isnan(records.event_t)
    behind = jnp.arange(1, used.size + 1)
    again = jnp.where(behind == loop.last, loop.loops, 0)
    arcs = Arc(
        entry=parts_of_states(records.y),
        end=parts_of_states(records.event_y),
        codes=records.mode,
        duration=records.duration,
        ended_by=records.ended_by,
        in_time=records.in_time,
        captured=records.captured,
        used=used,
        begins_loop=behind == loop.first,
        again=again,
    )
    start = [
        jnp.zeros_like(value) if slope is None else slope
        for value, slope in zip((y0, t0, t1), tangents[1:4], strict=True)
    ]
    inputs = in_one_row(*start, tangents[0])
    ends = sensitivities(varied, rest, arcs, t1 - records.t).along(inputs)
    # The first entry varies as the start does, each other one as the end before it. After a loop,
    # entries also vary by the periods that were not followed.
    late = again.astype(float) * (ends.t - ends.t[jnp.maximum(loop.first - 1, 0)])
    entries = jax.tree.map(
        lambda first, rows: jnp.append(first, rows[:-1]),
        Sensitivity(start[0][0], start[0][1], start[1]),
        replace(ends, t=ends.t + late),
    )
    nothing = jax.tree.map(lambda _: None, (final, records, loop, samples))
    last = jax.tree.map(lambda leaf: leaf[-1], ends)

    def rows(leaf):
        known = ~jnp.isnan(records.t)
        return jnp.where(known.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, 0.0)

    def parts(one):
        return (one.x1, one.x2, one.t)[: records.y.shape[1]]

    def states(one):
        return jnp.stack(parts(one), axis=1)

    def places(run):
        final, records, *_ = run
        events = records.event_t, records.event_y
        return final.t, final.y, records.t, records.y, records.duration, *events

    moved = [entries.t, states(entries), ends.t - entries.t, ends.t, states(ends)]
    moved = last.t, parts(last), *map(rows, moved)
    moved = eqx.tree_at(places, nothing, moved, is_leaf=lambda leaf: leaf is None)
    return (final, records, loop, samples), moved


def _unused(belts: int, parts: int = 2) -> ArcRecord:
    """The record of an unused segment; parts: numbers in a state, three with a clock."""
    nan, pair, none = jnp.full((), jnp.nan), jnp.full(parts, jnp.nan), jnp.zeros((), int)
    mode = jnp.zeros(belts, jnp.int8)
    return ArcRecord(
        t=nan,
        y=pair,
        mode=mode,
        duration=nan,
        kind=none,
        belt=none,
        event_t=nan,
        event_y=pair,
        ended_by=none - 1,
        in_time=none > 0,
        captured=none > 0,
    )


def states_at(
    osc: Oscillator,
    final: RunState,
    records: ArcRecord,
    loop: RepeatedLoop,
    samples: Array,
    ts: Array,
):
    """States and modes at the times ts, with derivatives; samples: these states, without."""
    arcs, numbers, since = arcs_at(records, loop.followed(ts, records.event_t))
    beyond = ts > final.t
    since = jnp.where(beyond, 0.0, since)
    rows = arcs.y, since, numbers, arcs.mode
    ys = with_derivatives(osc, *rows, lax.stop_gradient(samples))
    modes = jnp.where(beyond[:, None], stacked_codes(final.mode), arcs.mode)
    return jnp.where(beyond[:, None], _afterwards(final), ys), modes


def _afterwards(final: RunState) -> Array:
    """The state past the end of the last arc: the last one if the mass rests there, else NaN."""
    rests = (final.status == Status.PSEUDO_FOCUS) | (final.status == Status.STUCK_FOREVER)
    return jnp.where(rests, jnp.stack(final.y[:2]), jnp.nan)


def state_at_end(final: RunState, records: ArcRecord, loop: RepeatedLoop, t1: Array):
    """State and mode at t1, with derivatives: those at the end of the last arc."""
    beyond = t1 > final.t
    arcs, *_ = arcs_at(records, loop.followed(t1[None], records.event_t))
    mode = jnp.where(beyond, stacked_codes(final.mode), arcs.mode[0])
    return jnp.where(beyond, _afterwards(final), jnp.stack(final.y[:2])), mode
