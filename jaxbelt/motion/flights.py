"""Flights: arcs that are known, integrated again for their derivatives, many side by side.

Each takes a number of steps that is fixed beforehand, so there are no events to search for and no
step sizes to control; flights of about as many steps are made together, in one piece of machine
code.
"""

import functools
import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..kernel.lanes import materialise
from ..model.modes import Mode, mode_of
from ..model.oscillator import Oscillator
from ..numerics.compiling import (
    LARGEST,
    any_lane,
    axes_of,
    more_rows,
    one_kernel,
    with_batches,
)
from ..numerics.extrapolation import increments, scheme
from ..numerics.widths import SideBySide
from .integrators import State, density, slip_field

#: Length of a step of order twelve, times the density of steps that is wanted there. Of 5,000 arcs
#: of random oscillators nine in ten were then right to 1e-12, all to 1e-8.
LENGTH = 0.3
#: Largest number of steps of an arc, in groups of groups: most arcs need a few. Stiff arcs, and
#: arcs that begin in the bend of the law with a large acceleration, need thousands.
GROUPS = (8, 32, 16, 4)
MOST_STEPS = math.prod(GROUPS)
#: Arcs that are flown side by side, at most.
FLOWN_AT_ONCE = SideBySide(on_cpu=64, elsewhere=2**16)
#: Most runs, and most arcs of each, that are sorted by their numbers of steps together; and most
#: arcs that these may be: their number times `MOST_STEPS` has to fit into 32 bits, for sorting.
RUNS, ROWS = SideBySide(on_cpu=128, elsewhere=2**14), 128
MOST_FLIGHTS = SideBySide(on_cpu=2**11, elsewhere=2**16)
#: Arcs whose `Steps` are computed at once.
LOOKED_AT = SideBySide(on_cpu=128, elsewhere=2**16)
#: Least number of groups into which arcs that are sorted together are divided.
LEAST_GROUPS = SideBySide(on_cpu=16, elsewhere=1)
#: Largest density of steps; it keeps all numbers finite.
DENSEST = 1e4
#: Along an arc the steps vary by the ratio of the densities at its ends to this power: in between
#: the law bends less than the mean of both ends.
POWER = 1.5

_ORDER_12 = scheme((2, 4, 6, 8, 10, 12))


class Arc(eqx.Module):
    """An arc that is known: its entry and end, contact codes [belts], and duration.

    The end helps to place the steps. ended_by: a number of `arcs.Ends`, -1 for none; in_time:
    whether the run ended with it, in time; captured: whether the mass came to rest in a
    pseudo-focus at its end; used: whether this row holds an arc. begins_loop: whether the loop that
    the run repeats begins at its end; again: how many more times the run passes this loop there.
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


class Steps(NamedTuple):
    """Steps that are fixed beforehand: their number, and how they are graded, see `steps_of`."""

    number: Array
    is_even: Array
    ratio: Array


def steps_of(osc: Oscillator, arc: Arc, ones: Array) -> Steps:
    """The steps from the entry of an arc to its end; they have no derivatives.

    Their number and their grading follow from the density of steps that is wanted at both. ones:
    see `materialise`.
    """
    osc, arc = lax.stop_gradient((osc, arc))
    mode, duration, y, end = arc.mode, arc.duration, arc.entry, arc.end
    # Both ends in one call, which takes half as long to compile.
    wanted = jax.vmap(lambda *y: density(osc, mode, *y))(
        *(jnp.stack(pair) for pair in zip(y, end, strict=True))
    )
    first, last = materialise(jnp.clip(jnp.nan_to_num(wanted, nan=1.0), 1.0, DENSEST), ones)
    is_even = jnp.abs(last - first) < 1e-3 * first
    ratio = jnp.where(is_even, 2.0, last / first)
    mean = jnp.where(is_even, first, (last - first) / jnp.log(ratio))
    number = jnp.ceil(jnp.abs(duration) * mean / LENGTH)
    return Steps(jnp.where(mode.any_stuck, 0.0, number), is_even, ratio)


def flown(osc: Oscillator, mode: Mode, y: State, duration: Array, steps: Steps) -> State:
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
        """The state after more steps than the `passed` ones, as many as fit into the groups."""
        if not groups:
            h = duration * (place(passed + 1) - place(passed))
            (change,) = increments(field, y, h, _ORDER_12)
            return tuple(a + b for a, b in zip(y, change, strict=True))
        size, *parts = groups

        def some(i, y):
            begin = passed + i * math.prod(parts)
            # In groups, because skipping the steps that an arc does not need is not free.
            return lax.cond(any_lane(begin < number), advance_some, lambda *_: y, begin, y)

        def advance_some(begin, y):
            return advance(begin, y, parts)

        # Recomputed, not stored, where reverse mode comes back through them (second derivatives).
        return lax.fori_loop(0, size, jax.checkpoint(some, prevent_cse=False), y)

    end = advance(0, y, GROUPS)
    known = jnp.where(number <= MOST_STEPS, 1.0, jnp.nan)
    return tuple(part * known for part in end)


def _flown_again(osc: Oscillator, arc: Arc, steps: Steps, *y: Array) -> State:
    """The end of a known arc, if it slips, as a function of oscillator and entry near its own."""
    return flown(osc, arc.mode, y, jnp.where(arc.mode.any_stuck, 0.0, arc.duration), steps)


# --- many runs side by side -----------------------------------------------------------------------


def _side_by_side(function: Callable, by_run) -> Callable:
    """function(by_run, varied, rest, *rows) of runs side by side, as a function of varied, rest and
    rows; under `vmap` a batch becomes so many more runs.

    rows: arrays [runs, ..]; so are those leaves of the oscillator that are flagged in by_run, a
    tree of flags like (varied, rest).
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


def of_one_run(function: Callable, varied, rest, *rows):
    """A function of runs side by side, see `_side_by_side`, applied to one run."""
    call = _side_by_side(function, jax.tree.map(lambda _: False, (varied, rest)))
    out = call(varied, rest, *jax.tree.map(lambda leaf: leaf[None], rows))
    return jax.tree.map(lambda leaf: leaf[0], out)


def sizes_of(by_run, varied) -> list[int]:
    """How many numbers each leaf of `varied` has for one run."""
    pairs = zip(jax.tree.leaves(varied), jax.tree.leaves(by_run[0]), strict=True)
    return [leaf.size // leaf.shape[0] if flag else leaf.size for leaf, flag in pairs]


def largest_power(number: int) -> int:
    """The largest power of two <= number, for number >= 1."""
    return 1 << (number.bit_length() - 1)


def slopes_of(result, by_run, varied, rest, run, arcs: Arc, times, wanted):
    """Derivatives of flights, arrays [flights, d + 1 + varied] for each number of the result: by
    the d parts of the entry, by a time, and by the parameters.

    result(osc, arc, end, y, time): numbers of one flight, scalars, from its end; arcs: the flights,
    their leaves arrays [flights, ..]; times, and whether each is wanted: arrays [flights], with a
    power of two of flights; run: the run of each flight, [flights]. Flights of about as many steps
    are made side by side.
    """
    flights, count = times.size, len(arcs.entry) + 1 + sum(sizes_of(by_run, varied))
    own, shared = eqx.partition((varied, rest), by_run)
    own = jax.tree.map(lambda leaf: leaf[run], own)
    # In one array, because XLA gathers and slices every array by itself.
    table, unpack = _packed((own, arcs, times))

    number, is_even, ratio = _all_steps(by_run, shared, table, unpack)
    short = jnp.clip(jnp.nan_to_num(number), 0, MOST_STEPS).astype(jnp.int32) + 1
    short = jnp.where(wanted, short, 0)
    numbers = jnp.arange(flights, dtype=jnp.int32)
    # Sorted with their places as one number: a sort of pairs takes ten times as long.
    order = jnp.sort(short * flights + numbers) % flights
    places = jnp.zeros_like(order).at[order].set(numbers, unique_indices=True)
    # A few groups at least, because all flights of a group wait for the longest.
    most = min(FLOWN_AT_ONCE.here, largest_power(max(1, LARGEST.here // count)))
    size = min(most, max(1, flights // LEAST_GROUPS.here))
    graded = jnp.stack([number, is_even, ratio, wanted.astype(float)], axis=1)
    table = _as_columns(jnp.concatenate([table, graded], axis=1)[order], size)

    @one_kernel
    def made(shared, columns):
        (own, arcs, times), (number, is_even, ratio, _) = unpack(columns[:-4]), columns[-4:]
        steps = Steps(number, is_even > 0, ratio)
        varied, rest = eqx.combine(shared, own)
        return _slopes_together(result, by_run, varied, rest, arcs, times, steps)

    def group(columns):
        shapes = jax.eval_shape(made, shared, columns)
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), shapes)
        # In a branch, because a kernel outside of one has no second derivatives in a loop (JAX
        # 0.10).
        some = any_lane(jnp.any(columns[-1] > 0))
        return lax.cond(some, lambda: made(shared, columns), lambda: nothing)

    # In one array, so that a flight's numbers stand side by side.
    slopes = jnp.concatenate(lax.map(group, table), axis=1)
    slopes = jnp.moveaxis(slopes, 1, 2).reshape(flights, -1)[places]
    return tuple(jnp.split(slopes, slopes.shape[1] // count, axis=1))


def _all_steps(by_run, shared, table: Array, unpack: Callable) -> Array:
    """`steps_of` all flights, [3, flights]: number, is_even as a number, ratio; see `_packed`."""
    axes = axes_of(by_run)

    def of_one(varied, rest, arc, one):
        steps = steps_of(eqx.combine(varied, rest), arc, one)
        return jnp.stack([leaf.astype(float) for leaf in steps])

    @one_kernel
    def looked(shared, columns, ones):
        own, arcs, _ = unpack(columns)
        varied, rest = eqx.combine(shared, own)
        return jax.vmap(of_one, (*axes, 0, 0), 1)(varied, rest, arcs, ones)

    size = min(len(table), LOOKED_AT.here)
    groups = _as_columns(table, size)
    steps = lax.map(lambda columns: looked(shared, columns, jnp.ones(size)), groups)
    return jnp.moveaxis(steps, 1, 0).reshape(3, -1)


def _as_columns(table: Array, size: int) -> Array:
    """The rows of a table in groups of `size`, as columns, [groups, columns, size]."""
    return jnp.swapaxes(table.reshape(-1, size, table.shape[1]), 1, 2)


def _packed(tree) -> tuple[Array, Callable]:
    """The numbers of a tree of arrays [rows, ..] as one array, [rows, numbers]; and a function that
    restores the tree from columns, [numbers, rows]."""
    leaves, structure = jax.tree.flatten(tree)
    rows = leaves[0].shape[0]
    parts = [leaf.reshape(rows, -1).astype(float) for leaf in leaves]
    ends = list(itertools.accumulate(part.shape[1] for part in parts))

    def unpack(columns):
        found = [
            jnp.moveaxis(
                columns[first:end].reshape(*leaf.shape[1:], columns.shape[1]), -1, 0
            ).astype(leaf.dtype)
            for first, end, leaf in zip([0, *ends], ends, leaves)
        ]
        return jax.tree.unflatten(structure, found)

    return jnp.concatenate(parts, axis=1), unpack


def _slopes_together(result, by_run, varied, rest, arcs: Arc, times, steps: Steps):
    """The derivatives of flights that are computed together, arrays [d + 1 + varied, flights], see
    `slopes_of`."""
    axes, parts_of_entry = axes_of(by_run), len(arcs.entry)

    def each(function, varied, *rows):
        def of_one(varied, rest, *rows):
            return function(eqx.combine(varied, rest), *rows)

        return jax.vmap(of_one, (*axes, *[0] * len(rows)))(varied, rest, *rows)

    def ends(varied, *y):
        return each(_flown_again, varied, arcs, steps, *y)

    def results(varied, end, *y_and_times):
        def of_one(osc, arc, end, *y_and_time):
            *y, time = y_and_time
            return result(osc, arc, end, tuple(y), time)

        return each(of_one, varied, arcs, end, *y_and_times)

    def parts(direction):
        of_entry, of_parameters = direction[:parts_of_entry], direction[parts_of_entry:]
        by_entry = [jnp.full_like(a, 1.0) * b for a, b in zip(arcs.entry, of_entry)]
        return _directed(by_run[0], varied, of_parameters), *by_entry

    def flight(direction):
        return jax.jvp(ends, (varied, *arcs.entry), parts(direction))

    def column(moved, direction, time):
        along, *by_entry = parts(direction)
        slopes = along, moved, *by_entry, jnp.full_like(times, 1.0) * time
        return jax.jvp(results, (varied, end, *arcs.entry, times), slopes)[1]

    # The flight itself does not depend on the time.
    directions = jnp.eye(parts_of_entry + sum(sizes_of(by_run, varied)))
    end, moved = jax.vmap(flight, out_axes=(None, 0))(directions)

    def with_time(leaf, own):
        row = jnp.broadcast_to(own, (1, *leaf.shape[1:]))
        return jnp.concatenate([leaf[:parts_of_entry], row, leaf[parts_of_entry:]])

    moved = jax.tree.map(lambda leaf: with_time(leaf, 0.0), moved)
    is_time = jnp.where(jnp.arange(len(directions) + 1) == parts_of_entry, 1.0, 0.0)
    return jax.vmap(column)(moved, with_time(directions, 0.0), is_time)


def _directed(by_run, varied, numbers: Array):
    """A tree like `varied`, made of these numbers, the same for all runs."""
    leaves, structure = jax.tree.flatten(varied)
    parts, before = [], 0
    for leaf, flag in zip(leaves, jax.tree.leaves(by_run), strict=True):
        shape = leaf.shape[1:] if flag else leaf.shape
        part = numbers[before : before + math.prod(shape)].reshape(shape)
        parts.append(jnp.broadcast_to(part, leaf.shape))
        before += math.prod(shape)
    return jax.tree.unflatten(structure, parts)
