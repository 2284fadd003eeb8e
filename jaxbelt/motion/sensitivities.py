"""Derivatives of a run, from its arcs.

Once the arcs of a run are known (entry, mode, duration, and what ended each) its derivatives need
no search for events and no control of steps. Each arc is flown again by a fixed number of steps,
many arcs at once, for its Jacobian: of its end and its duration, by its entry, by the time that is
left, and by the parameters. Where a guard ended it, the duration follows from the guard (implicit
function theorem). The sensitivities of all entries are then a linear recurrence over the arcs.

The tangent of a run is its sensitivities times those of its inputs, a product that reverse mode
transposes; so both modes, and any number of derivatives by one run, cost about the same.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.modes import (
    Mode,
    boundary_guards,
    edge_guards,
    first_of,
    foremost,
    mode_of,
    select,
    stick_velocity,
)
from ..model.oscillator import Oscillator
from ..model.rest import is_slow
from ..model.transitions import on_guard
from ..numerics.compiling import LARGEST, any_lane, more_rows, one_kernel, with_batches
from ..numerics.extrapolation import increments, scheme
from .arcs import stick_arc
from .integrators import State, density, slip_field

#: A step of order twelve times the density of steps that is wanted there. Of 5,000 arcs of random
#: oscillators nine in ten were then right to 1e-12, all to 1e-8.
LENGTH = 0.3
#: Most steps of an arc, in groups of groups: most arcs need a few, stiff ones, and those that begin
#: in the bend of the law with a large acceleration, thousands.
GROUPS = (8, 32, 16, 4)
MOST_STEPS = math.prod(GROUPS)
#: Arcs that are flown side by side, at most.
SIDE_BY_SIDE = 64
#: Runs, at most, and arcs of each, that are sorted by their numbers of steps together; and how many
#: arcs these are, at most.
RUNS, ROWS, MOST_FLIGHTS = 128, 128, 2048
#: Groups into which these are divided, at least.
LEAST_GROUPS = 16
#: Largest density of steps, so that all numbers stay finite.
DENSEST = 1e4
#: Along an arc the steps vary by the ratio of the densities at its ends to this power: between the
#: ends the law bends less than in the middle between them.
POWER = 1.5

_ORDER_12 = scheme((2, 4, 6, 8, 10, 12))


class Arc(eqx.Module):
    """An arc that is known: its entry and end, contact codes [belts], and duration.

    The end helps to place the steps. ended_by: a number of `arcs.Ends`, -1 for none; in_time:
    whether the run ended with it, in time; captured: whether the mass came to rest in a
    pseudo-focus at its end; used: whether there was such an arc at all. begins_loop, again: where
    the loop that the run repeats begins behind it, and how many more times it is passed behind it.
    """

    entry: State
    end: State
    codes: Array
    duration: Array
    ended_by: Array
    in_time: Array
    captured: Array
    used: Array
    begins_loop: Array
    again: Array

    @property
    def mode(self) -> Mode:
        """The mode of the arc."""
        return mode_of(self.codes.astype(float))


class Sensitivity(eqx.Module):
    """Derivatives of a state (x1, x2) and of the time at which it is passed, arrays [..., inputs].

    The inputs are x1 and x2 at the start, t0, t1, and the parameters that vary.
    """

    x1: Array
    x2: Array
    t: Array

    def along(self, inputs: Array) -> "Sensitivity":
        """The derivatives along one direction of the inputs, arrays [...]."""
        return jax.tree.map(lambda slopes: slopes @ inputs, self)


class _Steps(NamedTuple):
    """Steps that are fixed beforehand: how many, and how they are graded, see `_steps_of`."""

    number: Array
    is_even: Array
    ratio: Array


def _steps_of(osc: Oscillator, arc: Arc) -> _Steps:
    """The steps from the entry of an arc to its end; they have no derivatives.

    Their number and their grading follow from the density of steps that is wanted at both.
    """
    osc, arc = lax.stop_gradient((osc, arc))
    mode, duration, y, end = arc.mode, arc.duration, arc.entry, arc.end
    first, last = (
        jnp.clip(jnp.nan_to_num(density(osc, mode, *at), nan=1.0), 1.0, DENSEST) for at in (y, end)
    )
    is_even = jnp.abs(last - first) < 1e-3 * first
    ratio = jnp.where(is_even, 2.0, last / first)
    mean = jnp.where(is_even, first, (last - first) / jnp.log(ratio))
    number = jnp.ceil(jnp.abs(duration) * mean / LENGTH)
    return _Steps(jnp.where(mode.any_stuck, 0.0, number), is_even, ratio)


def flown(osc: Oscillator, mode: Mode, y: State, duration: Array, steps: _Steps) -> State:
    """The state after a time in the field of a slip mode, by steps that are fixed beforehand.

    NaN where MOST_STEPS are too few.
    """
    number, is_even, ratio = steps

    def place(passed):
        # As if the logarithm of the density were linear: of that density the integral up to s is
        # proportional to ratio^s - 1.
        share = jnp.minimum(passed / jnp.maximum(number, 1.0), 1.0)
        graded = jnp.log1p(share * (ratio**POWER - 1)) / jnp.log(ratio**POWER)
        return jnp.where(is_even, share, graded)

    def field(y):
        return slip_field(osc, mode, y)

    def advance(passed, y, groups):
        """Past the steps behind those that are passed, as many as fit into the groups."""
        if not groups:
            h = duration * (place(passed + 1) - place(passed))
            (change,) = increments(field, y, h, _ORDER_12)
            return y[0] + change[0], y[1] + change[1]
        size, *parts = groups

        def some(i, y):
            begin = passed + i * math.prod(parts)
            # In groups, for stepping over the steps that an arc does not need is not free.
            return lax.cond(any_lane(begin < number), advance_some, lambda *_: y, begin, y)

        def advance_some(begin, y):
            return advance(begin, y, parts)

        # Made again, not kept, where a derivative of a derivative comes back through them.
        return lax.fori_loop(0, size, jax.checkpoint(some, prevent_cse=False), y)

    x1, x2 = advance(0, y, GROUPS)
    known = jnp.where(number <= MOST_STEPS, 1.0, jnp.nan)
    return x1 * known, x2 * known


def _flown_again(osc: Oscillator, arc: Arc, steps: _Steps, x1: Array, x2: Array) -> State:
    """The end of an arc that is known, where it slips, by oscillator and entry near those of it."""
    return flown(osc, arc.mode, (x1, x2), jnp.where(arc.mode.any_stuck, 0.0, arc.duration), steps)


def _carried(osc: Oscillator, arc: Arc, end: State, y: State, since: Array) -> State:
    """The state a time after the entry y, in the mode of an arc, near its end.

    end: as `_flown_again` gives it.
    """
    mode = arc.mode
    late, slopes = since - arc.duration, slip_field(osc, mode, end)
    v = stick_velocity(osc, mode, jnp.zeros(())) / osc.omega
    slipped = end[0] + late * slopes[0], end[1] + late * slopes[1]
    return select(mode.any_stuck, (y[0] + v * since, v), slipped)


def _passed(osc: Oscillator, arc: Arc, end: State, y: State, remaining: Array) -> tuple[Array, ...]:
    """Where the orbit goes on after an arc that is known, x1 and x2, and the arc's duration.

    As functions of the oscillator, of the entry y, and of the time left, near those of the arc;
    end: as `_flown_again` gives it.
    """
    mode = arc.mode
    stuck = mode.any_stuck
    # The numbers of the run itself, so that the field is the same here and at the next entry.
    end = _with_numbers_of(arc.end[0], end[0]), _with_numbers_of(arc.end[1], end[1])

    def fired_guard(x1, x2):
        n = len(osc.belts)
        guards = [*boundary_guards(osc, mode, x2), *edge_guards(osc, mode, x1)]
        hit = first_of([arc.ended_by == i for i in range(3 * n)], guards, jnp.zeros(()))
        same = [
            (guard == hit) & ((arc.ended_by < n) == (i < n)) & (arc.ended_by >= 0)
            for i, guard in enumerate(guards)
        ]
        return foremost(osc, same, guards, hit)

    # By how much later than after `duration` the arc ends: nothing, with the right derivatives.
    slopes = slip_field(osc, mode, end)
    guard, slope = jax.jvp(fired_guard, end, slopes)
    late = (lax.stop_gradient(guard) - guard) / jnp.where(slope == 0, 1.0, slope)
    late = jnp.where(arc.in_time, remaining - arc.duration, late)
    x1, x2 = on_guard(osc, mode, arc.ended_by, end[0] + late * slopes[0], end[1] + late * slopes[1])
    slipped = x1, jnp.where(arc.captured, 0.0, x2), arc.duration + late
    phase = stick_arc(osc, mode, y, remaining)
    return select(stuck, (*phase.y, phase.duration), slipped)


def _with_numbers_of(known: Array, found: Array) -> Array:
    """The known number, with the derivatives of the one that was found."""
    return lax.stop_gradient(known) + (found - lax.stop_gradient(found))


def _creep(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> tuple[Array, Array, Array]:
    """Whether the mass slips but hardly moves, see `rest.is_slow`; and the field, (x2, x2')."""
    _, a = slip_field(osc, mode, (x1, x2))
    return ~mode.any_stuck & is_slow(x2, a), x2, a


def count(varied) -> int:
    """How many numbers there are in a tree."""
    return sum(leaf.size for leaf in jax.tree.leaves(varied))


def split(osc: Oscillator, slopes) -> tuple[Oscillator, Oscillator]:
    """The leaves of the oscillator that have a slope, and the others, each with None elsewhere."""
    moves = jax.tree.map(lambda slope: slope is not None, slopes, is_leaf=_is_none)
    return eqx.partition(osc, moves)


def _is_none(leaf) -> bool:
    return leaf is None


def in_one_row(*slopes) -> Array:
    """The numbers of some trees, one after the other."""
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(slopes)])


# --- many runs side by side -----------------------------------------------------------------------


def _side_by_side(function: Callable, by_run) -> Callable:
    """function(by_run, varied, rest, *rows) of runs side by side, as a function of the others.

    rows are arrays [runs, ..], and so are the leaves of the oscillator for which by_run, a tree of
    flags like (varied, rest), says it. A batch of it is so many more runs.
    """

    def call(varied, rest, *rows):
        return function(by_run, varied, rest, *rows)

    def batch(_, size, batched, *args):
        flags = *by_run, *jax.tree.map(lambda _: True, args[2:])
        leaf, is_batched = jax.tree.leaves(args[2:])[0], jax.tree.leaves(batched[2:])[0]
        runs = leaf.shape[1 if is_batched else 0]

        differ = jax.tree.map(lambda a, b: a or b, by_run, tuple(batched[:2]))
        merged = functools.partial(more_rows, size, runs)
        out = _side_by_side(function, differ)(*jax.tree.map(merged, args, flags, tuple(batched)))
        return jax.tree.map(lambda leaf: leaf.reshape(size, runs, *leaf.shape[1:]), out)

    return with_batches(call, batch)


def _of_one_run(function: Callable, varied, rest, *rows):
    """The function of runs side by side, see `_side_by_side`, for one run."""
    call = _side_by_side(function, jax.tree.map(lambda _: False, (varied, rest)))
    out = call(varied, rest, *jax.tree.map(lambda leaf: leaf[None], rows))
    return jax.tree.map(lambda leaf: leaf[0], out)


def _sizes(by_run, varied) -> list[int]:
    """How many numbers each leaf has for one run."""
    pairs = zip(jax.tree.leaves(varied), jax.tree.leaves(by_run[0]), strict=True)
    return [leaf.size // leaf.shape[0] if flag else leaf.size for leaf, flag in pairs]


def _largest_power(number: int) -> int:
    """The largest that is not above the number, 1 or more."""
    return 1 << (number.bit_length() - 1)


def _slopes(result, by_run, varied, rest, run, arcs: Arc, times, steps: _Steps):
    """Derivatives of flights, arrays [flights, 3 + varied] for each number of the result: by x1 and
    x2 of the entry, by a time, and by the parameters.

    result(osc, arc, end, y, time): of one flight, scalars, see `_carried`; arcs: the flights, their
    leaves arrays [flights, ..]; times: arrays [flights]; run: to which run each belongs; steps: of
    each, for those of about as many are made side by side; a number of -1: it is not wanted.
    """
    flights, columns = times.size, 3 + sum(_sizes(by_run, varied))
    most = min(SIDE_BY_SIDE, _largest_power(max(1, LARGEST // columns)))
    # A few groups at least, for all of a group wait for the longest.
    size = min(most, max(1, flights // LEAST_GROUPS))
    short = jnp.clip(jnp.nan_to_num(steps.number), -1, MOST_STEPS).astype(jnp.int32) + 1
    # Sorted with their places as one number: a sort of pairs takes ten times as long.
    in_order = jnp.sort(short * flights + jnp.arange(flights, dtype=jnp.int32))
    order, wanted = in_order % flights, in_order >= flights
    places = jnp.zeros_like(order).at[order].set(jnp.arange(flights, dtype=jnp.int32))
    own, shared = eqx.partition((varied, rest), by_run)
    own = jax.tree.map(lambda leaf: leaf[run], own)
    rows = jax.tree.map(lambda leaf: leaf[order], (own, arcs, steps, times))
    rows = jax.tree.map(lambda leaf: leaf.reshape(-1, size, *leaf.shape[1:]), (*rows, wanted))

    @one_kernel
    def made(shared, own, arcs, steps, times):
        varied, rest = eqx.combine(shared, own)
        axes = jax.tree.map(lambda flag: 0 if flag else None, by_run)

        def each(function, varied, *rows):
            def of_one(varied, rest, *rows):
                return function(eqx.combine(varied, rest), *rows)

            return jax.vmap(of_one, (*axes, *[0] * len(rows)))(varied, rest, *rows)

        def ends(varied, x1, x2):
            return each(_flown_again, varied, arcs, steps, x1, x2)

        def results(varied, end, x1, x2, times):
            def of_one(osc, arc, end, x1, x2, time):
                return result(osc, arc, end, (x1, x2), time)

            return each(of_one, varied, arcs, end, x1, x2, times)

        def parts(direction):
            by_entry = [jnp.full_like(a, 1.0) * b for a, b in zip(arcs.entry, direction[:2])]
            return _directed(by_run[0], varied, direction[2:]), *by_entry

        def flight(direction):
            return jax.jvp(ends, (varied, *arcs.entry), parts(direction))

        def column(moved, direction, time):
            along, *by_entry = parts(direction)
            slopes = along, moved, *by_entry, jnp.full_like(times, 1.0) * time
            return jax.jvp(results, (varied, end, *arcs.entry, times), slopes)[1]

        # The time has no part in the flight itself.
        directions = jnp.eye(columns - 1)
        end, moved = jax.vmap(flight, out_axes=(None, 0))(directions)

        def with_time(leaf, own):
            row = jnp.broadcast_to(own, (1, *leaf.shape[1:]))
            return jnp.concatenate([leaf[:2], row, leaf[2:]])

        moved = jax.tree.map(lambda leaf: with_time(leaf, 0.0), moved)
        is_time = jnp.where(jnp.arange(columns) == 2, 1.0, 0.0)
        return jax.vmap(column)(moved, with_time(directions, 0.0), is_time)

    def group(rows):
        *rows, wanted = rows
        shapes = jax.eval_shape(made, shared, *rows)
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), shapes)
        # A kernel that is not in a branch of its own has no second derivatives in a loop (JAX
        # 0.10).
        return lax.cond(any_lane(jnp.any(wanted)), lambda: made(shared, *rows), lambda: nothing)

    # In one array, so that a flight's numbers stand side by side.
    slopes = jnp.concatenate(lax.map(group, rows), axis=1)
    slopes = jnp.moveaxis(slopes, 1, 2).reshape(flights, -1)[places]
    return tuple(jnp.split(slopes, slopes.shape[1] // columns, axis=1))


def _directed(by_run, varied, numbers: Array):
    """A tree like `varied`, of these numbers, the same for all runs."""
    leaves, structure = jax.tree.flatten(varied)
    parts, before = [], 0
    for leaf, flag in zip(leaves, jax.tree.leaves(by_run), strict=True):
        shape = leaf.shape[1:] if flag else leaf.shape
        part = numbers[before : before + math.prod(shape)].reshape(shape)
        parts.append(jnp.broadcast_to(part, leaf.shape))
        before += math.prod(shape)
    return jax.tree.unflatten(structure, parts)


# --- from arc to arc ------------------------------------------------------------------------------


def sensitivities(varied, rest, arcs: Arc, remaining: Array) -> Sensitivity:
    """Sensitivities of a run at the ends of its arcs, [arcs, inputs].

    varied, rest: leaves of the oscillator, see `split`; remaining: the time from each entry to t1.
    Behind the arcs that were used nothing is told, but in the last row that of the last one.
    """
    return _of_one_run(_sensitivities, varied, rest, arcs, remaining)


def _sensitivities(by_run, varied, rest, arcs: Arc, remaining: Array) -> Sensitivity:
    """`sensitivities` of runs side by side, [runs, arcs, inputs]."""
    runs, rows = remaining.shape
    inputs = 4 + sum(_sizes(by_run, varied))
    width = min(_largest_power(2 * runs - 1), _largest_power(max(1, LARGEST // inputs)), RUNS)
    depth = min(ROWS, max(1, MOST_FLIGHTS // width))
    blocks, chunks = -(-runs // width), -(-rows // depth)
    padding = (0, blocks * width - runs), (0, chunks * depth - rows)

    def padded(leaf):
        return jnp.pad(leaf, (*padding, *[(0, 0)] * (leaf.ndim - 2)))

    arcs, remaining = jax.tree.map(padded, (arcs, remaining))
    own, shared = eqx.partition((varied, rest), by_run)
    own = jax.tree.map(
        lambda leaf: jnp.pad(leaf, (padding[0], *[(0, 0)] * (leaf.ndim - 1)), "edge"), own
    )
    first = Sensitivity(*jnp.broadcast_to(jnp.eye(inputs)[:3, None], (3, width, inputs)))

    def block(ends, number):
        of_block = jax.tree.map(lambda leaf: _part(leaf, (number * width, width)), own)
        varied, rest = eqx.combine(shared, of_block)

        def chunk(state, k):
            carry, ends = state
            place = number * width, k * depth
            some, left = jax.tree.map(
                lambda leaf: _part(leaf, (place[0], width), (place[1], depth)), (arcs, remaining)
            )

            def work():
                return _past_chunk(by_run, varied, rest, some, left, carry)

            def nothing():
                told = jnp.zeros((width, depth, inputs))
                return carry, Sensitivity(told, told, told)

            carry, told = lax.cond(any_lane(jnp.any(some.used)), work, nothing)
            ends = jax.tree.map(
                lambda a, b: lax.dynamic_update_slice(a, b, (*place, 0)), ends, told
            )
            return (carry, ends), None

        (carry, ends), _ = lax.scan(chunk, ((first, first.t), ends), jnp.arange(chunks))
        last = number * width, rows - 1, 0
        put = functools.partial(lax.dynamic_update_slice, start_indices=last)
        ends = jax.tree.map(lambda a, b: put(a, b[:, None]), ends, carry[0])
        return ends, None

    blank = jnp.zeros((blocks * width, chunks * depth, inputs))
    ends, _ = lax.scan(block, Sensitivity(blank, blank, blank), jnp.arange(blocks))
    return jax.tree.map(lambda leaf: leaf[:runs, :rows], ends)


def _part(leaf: Array, *spans) -> Array:
    """Of each of the first axes the part (first, how many)."""
    for axis, (first, size) in enumerate(spans):
        leaf = lax.dynamic_slice_in_dim(leaf, first, size, axis)
    return leaf


#: Sensitivities of runs where they stand, and those of the time when the loop began, arrays [runs,
#: inputs].
Carry = tuple[Sensitivity, Array]


def _past_chunk(by_run, varied, rest, arcs: Arc, remaining, carry: Carry):
    """Sensitivities of runs side by side after some arcs, and at their ends, [runs, arcs, inputs];
    carry: before the first one."""
    width, depth = remaining.shape
    flat = jax.tree.map(
        lambda leaf: jnp.swapaxes(leaf, 0, 1).reshape(-1, *leaf.shape[2:]), (arcs, remaining)
    )
    arcs, remaining = _made_safe(flat[0]), flat[1]
    run = jnp.arange(remaining.size) % width
    of_runs = jax.tree.map(lambda leaf, flag: leaf[run] if flag else leaf, (varied, rest), by_run)
    axes = jax.tree.map(lambda flag: 0 if flag else None, by_run)

    def looked(parts, arc):
        osc = eqx.combine(*parts)
        return _steps_of(osc, arc), _creep(osc, arc.mode, *arc.entry)

    steps, creeps = jax.vmap(looked, (axes, 0))(of_runs, arcs)
    steps = steps._replace(number=jnp.where(arcs.used, steps.number, -1.0))
    slopes = _slopes(_passed, by_run, varied, rest, run, arcs, remaining, steps)
    # As many rows at once as fit into one piece of machine code.
    size = min(depth, _largest_power(max(1, LARGEST // carry[1].size)))
    rows = jax.tree.map(
        lambda leaf: leaf.reshape(depth // size, size, width, *leaf.shape[1:]),
        (slopes, arcs.used, creeps, arcs.begins_loop, arcs.again.astype(float)),
    )
    carry, ends = lax.scan(lambda carry, rows: _past_rows(carry, rows), carry, rows)
    ends = jax.tree.map(lambda leaf: jnp.moveaxis(leaf.reshape(depth, width, -1), 0, 1), ends)
    return carry, ends


@one_kernel
def _past_rows(carry: Carry, rows):
    """The sensitivities past some arcs, and at the end of each, [arcs, runs, inputs]; rows: of each
    the derivatives, whether it was used, `_creep`, and what loop begins and ends behind it."""

    def advance(carry, row):
        before, began = carry
        slopes, used, (creeps, x2, a), begins_loop, again = row
        x2, a = x2[:, None], a[:, None]
        moved = before.x1 - x2 * before.t, before.x2 - a * before.t
        fixed = Sensitivity(*moved, jnp.zeros_like(before.t))
        before = select(creeps[:, None], fixed, before)
        is_t1 = jnp.where(jnp.arange(before.t.shape[1]) == 3, 1.0, 0.0)[None]

        def through(slopes):
            by_entry = slopes[:, :1] * before.x1 + slopes[:, 1:2] * before.x2
            nothing = jnp.zeros((slopes.shape[0], 4))
            by_parameters = jnp.concatenate([nothing, slopes[:, 3:]], axis=1)
            return by_entry + slopes[:, 2:3] * (is_t1 - before.t) + by_parameters

        x1, x2, duration = (through(part) for part in slopes)
        after = select(used[:, None], Sensitivity(x1, x2, before.t + duration), before)
        began = jnp.where(begins_loop[:, None], after.t, began)
        late = again[:, None] * (after.t - began)
        return (replace(after, t=after.t + late), began), after

    return lax.scan(advance, carry, rows)


def _made_safe(arcs: Arc) -> Arc:
    """The arcs, with numbers instead of NaN for those that were not used."""

    def fill(leaf):
        return jnp.where(arcs.used, leaf, jnp.zeros_like(leaf))

    entry, end, duration = jax.tree.map(fill, (arcs.entry, arcs.end, arcs.duration))
    codes = jnp.where(arcs.used[:, None], arcs.codes, 1)
    return replace(arcs, entry=entry, end=end, duration=duration, codes=codes)


# --- samples --------------------------------------------------------------------------------------


@eqx.filter_custom_jvp
def with_derivatives(osc: Oscillator, entries: Array, since: Array, codes: Array, states: Array):
    """The states, [samples, 2], with derivatives: each is reached in the mode of its codes,
    [belts], from its entry, (x1, x2), after a time since then."""
    return states


@with_derivatives.def_jvp
def _(primals, tangents):
    osc, entries, since, codes, states = primals
    along, entries_along, since_along, *_ = tangents
    varied, rest = split(osc, along)
    rows = entries, since, codes, lax.stop_gradient(states)
    slopes = _of_one_run(_slopes_of_samples, varied, rest, *rows)
    by_x1, by_x2, by_time, *by_parameters = jnp.moveaxis(slopes, -1, 0)
    if since_along is not None:
        modes = mode_of(jnp.moveaxis(codes.astype(float), -1, 0))
        creeps, *field = _creep(osc, modes, entries[:, 0], entries[:, 1])
        earlier = jnp.where(creeps, since_along, 0.0)
        field = jnp.stack(field, axis=1) * earlier[:, None]
        entries_along = field if entries_along is None else entries_along + field
        since_along = since_along - earlier
    moved = jnp.zeros(states.shape)
    if entries_along is not None:
        moved = moved + by_x1 * entries_along[:, :1] + by_x2 * entries_along[:, 1:]
    if since_along is not None:
        moved = moved + by_time * since_along[:, None]
    for slope, by in zip(in_one_row(along) if by_parameters else (), by_parameters, strict=True):
        moved = moved + slope * by
    return with_derivatives(*primals), moved


def _slopes_of_samples(by_run, varied, rest, entries: Array, since: Array, codes: Array, ends):
    """Derivatives of samples, [runs, samples, 2, 3 + parameters]: by the entry, the time since it,
    and the parameters."""
    runs, samples = since.shape
    total = runs * samples
    size = min(MOST_FLIGHTS, _largest_power(2 * total - 1))

    def chunks(leaf):
        leaf = leaf.reshape(total, *leaf.shape[2:])
        padding = (0, -total % size), *[(0, 0)] * (leaf.ndim - 1)
        return jnp.pad(leaf, padding, "edge").reshape(-1, size, *leaf.shape[1:])

    run = jnp.broadcast_to(jnp.arange(runs)[:, None], since.shape)
    axes = jax.tree.map(lambda flag: 0 if flag else None, by_run)

    def of_chunk(rows):
        run, entries, since, codes, ends = rows
        known = ~jnp.isnan(since)
        never = jnp.zeros_like(known)
        arcs = Arc(
            entry=(entries[:, 0], entries[:, 1]),
            end=(ends[:, 0], ends[:, 1]),
            codes=codes,
            duration=since,
            ended_by=jnp.full(since.shape, -1),
            in_time=never,
            captured=never,
            used=known,
            begins_loop=never,
            again=jnp.zeros(since.shape, int),
        )

        def looked(parts, arc):
            return _steps_of(eqx.combine(*parts), arc)

        of_runs = jax.tree.map(
            lambda leaf, flag: leaf[run] if flag else leaf, (varied, rest), by_run
        )
        steps = jax.vmap(looked, (axes, 0))(of_runs, arcs)
        steps = steps._replace(number=jnp.where(known, steps.number, -1.0))
        slopes = _slopes(_carried, by_run, varied, rest, run, arcs, since, steps)
        return jnp.where(known[:, None, None], jnp.stack(slopes, axis=1), 0.0)

    slopes = lax.map(of_chunk, tuple(map(chunks, (run, entries, since, codes, ends))))
    return slopes.reshape(-1, *slopes.shape[2:])[:total].reshape(runs, samples, *slopes.shape[2:])
