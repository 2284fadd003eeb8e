"""Derivatives of a run, from its arcs.

Once the arcs of a run are known (entry, mode, duration, and what ended each) its derivatives need
no search for events and no control of steps. Each arc is flown again by a fixed number of steps,
many arcs at once, for its Jacobian: of its end and its duration, by its entry, by the time that is
left, and by the parameters. Where a guard ended it, the duration follows from the guard (implicit
function theorem). The sensitivities of all entries are then a linear recurrence over the arcs.

The tangent of a run is its sensitivities times those of its inputs, a product that reverse mode
transposes; so both modes, and any number of derivatives by one run, cost about the same.
"""

import math
from dataclasses import replace

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
    leave_slip,
    mode_of,
    select,
    stick_velocity,
)
from ..model.oscillator import Oscillator
from ..model.rest import is_slow
from ..numerics.compiling import any_lane, in_turn, one_kernel
from ..numerics.extrapolation import increments, scheme
from .arcs import stick_arc
from .integrators import State, density, slip_field

#: A step of order twelve times the density of steps that is wanted there. Of 5,000 arcs of random
#: oscillators nine in ten were then right to 1e-12, all to 1e-8.
LENGTH = 0.3
#: Most steps of an arc, in groups of groups: most arcs need a few, stiff ones thousands.
GROUPS = (32, 16, 4)
MOST_STEPS = math.prod(GROUPS)
#: Arcs that are flown at once.
ROWS = 32
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
    pseudo-focus at its end; used: whether there was such an arc at all.
    """

    entry: State
    end: State
    codes: Array
    duration: Array
    ended_by: Array
    in_time: Array
    captured: Array
    used: Array

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


def flown(osc: Oscillator, mode: Mode, y: State, duration: Array, end: State) -> State:
    """The state after a time in the field of a slip mode, by steps that are fixed beforehand.

    Their number and their grading follow from the density of steps that is wanted at y and at the
    end, which is known already. NaN where MOST_STEPS are too few.
    """
    given = lax.stop_gradient((osc, mode))
    first, last = (
        jnp.clip(jnp.nan_to_num(density(*given, *lax.stop_gradient(at)), nan=1.0), 1.0, DENSEST)
        for at in (y, end)
    )
    is_even = jnp.abs(last - first) < 1e-3 * first
    ratio = jnp.where(is_even, 2.0, last / first)
    mean = jnp.where(is_even, first, (last - first) / jnp.log(ratio))
    steps = jnp.ceil(jnp.abs(lax.stop_gradient(duration)) * mean / LENGTH)

    def place(number):
        # As if the logarithm of the density were linear: of that density the integral up to s is
        # proportional to ratio^s - 1.
        share = jnp.minimum(number / jnp.maximum(steps, 1.0), 1.0)
        graded = jnp.log1p(share * (ratio**POWER - 1)) / jnp.log(ratio**POWER)
        return jnp.where(is_even, share, graded)

    def field(y):
        return slip_field(osc, mode, y)

    def advance(number, y, groups):
        """Past the steps from that number on, as many as fit into the groups."""
        if not groups:
            h = duration * (place(number + 1) - place(number))
            (change,) = increments(field, y, h, _ORDER_12)
            return y[0] + change[0], y[1] + change[1]
        size, *parts = groups

        def some(i, y):
            begin = number + i * math.prod(parts)
            # In groups, for stepping over the steps that an arc does not need is not free.
            return lax.cond(any_lane(begin < steps), advance_some, lambda *_: y, begin, y)

        def advance_some(begin, y):
            return advance(begin, y, parts)

        # Made again, not kept, where a derivative of a derivative comes back through them.
        return lax.fori_loop(0, size, jax.checkpoint(some, prevent_cse=False), y)

    x1, x2 = advance(0, y, GROUPS)
    known = jnp.where(steps <= MOST_STEPS, 1.0, jnp.nan)
    return x1 * known, x2 * known


def _carried(osc: Oscillator, mode: Mode, y: State, duration: Array, end: State) -> State:
    """The state after a time in a mode, slip or stick, near `end`."""
    stuck = mode.any_stuck
    v = stick_velocity(osc, mode, jnp.zeros(())) / osc.omega
    slipped = flown(osc, mode, y, jnp.where(stuck, 0.0, duration), end)
    return select(stuck, (y[0] + v * duration, v), slipped)


def _passed(osc: Oscillator, arc: Arc, y: State, remaining: Array) -> tuple[Array, Array, Array]:
    """Where the orbit goes on after an arc that is known, x1 and x2, and the arc's duration.

    As functions of the oscillator, of the entry y, and of the time left, near those of the arc.
    """
    mode = arc.mode
    stuck = mode.any_stuck
    end = flown(osc, mode, y, jnp.where(stuck, 0.0, arc.duration), arc.end)
    # The numbers of the run itself, so that the field is the same here and at the next entry.
    end = _with_numbers_of(arc.end[0], end[0]), _with_numbers_of(arc.end[1], end[1])

    def fired_guard(*y):
        n = len(osc.belts)
        guards = [*boundary_guards(osc, mode, y[1]), *edge_guards(osc, mode, y[0])]
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
    after = leave_slip(
        osc, mode, arc.ended_by, end[0] + late * slopes[0], end[1] + late * slopes[1]
    )
    slipped = after.x1, jnp.where(arc.captured, 0.0, after.x2), arc.duration + late
    phase = stick_arc(osc, mode, y, remaining)
    return select(stuck, (*phase.y, phase.duration), slipped)


def _with_numbers_of(known: Array, found: Array) -> Array:
    """The known number, with the derivatives of the one that was found."""
    return lax.stop_gradient(known) + (found - lax.stop_gradient(found))


@one_kernel
def _sensitivities_at_ends(
    varied, rest, arcs: Arc, remaining: Array, entry: Sensitivity
) -> Sensitivity:
    """Sensitivities at the ends of some arcs, [arcs, inputs], from that at the entry of the first.

    varied, rest: leaves of the oscillator.
    """

    def jacobian(row):
        arc, remaining = row

        def passed(varied, x1, x2, remaining):
            return _passed(eqx.combine(varied, rest), arc, (x1, x2), remaining)

        return _slopes_of(passed, varied, *arc.entry, remaining)

    is_t1 = jnp.where(jnp.arange(entry.t.size) == 3, 1.0, 0.0)

    def creep(arc):
        return _creep(eqx.combine(varied, rest), arc.mode, *arc.entry)

    def advance(before, row):
        jacobian, used, (creeps, x2, a) = row
        moved = before.x1 - x2 * before.t, before.x2 - a * before.t
        fixed = Sensitivity(*moved, jnp.zeros_like(before.t))
        before = select(creeps, fixed, before)

        def through(slopes):
            by_entry = slopes[0] * before.x1 + slopes[1] * before.x2
            by_parameters = jnp.concatenate([jnp.zeros(4), slopes[3:]])
            return by_entry + slopes[2] * (is_t1 - before.t) + by_parameters

        x1, x2, duration = (through(slopes) for slopes in jacobian)
        after = select(used, Sensitivity(x1, x2, before.t + duration), before)
        return after, after

    # One arc after another, for they need different numbers of steps.
    rows = lax.map(jacobian, (arcs, remaining)), arcs.used, jax.vmap(creep)(arcs)
    return lax.scan(advance, entry, rows)[1]


def _creep(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> tuple[Array, Array, Array]:
    """Whether the mass slips but hardly moves, see `rest.is_slow`; and the field, (x2, x2')."""
    _, a = slip_field(osc, mode, (x1, x2))
    return ~mode.any_stuck & is_slow(x2, a), x2, a


def _slopes_of(function, varied, *numbers):
    """The derivatives of a function's results, scalars: of each by the numbers and then by what
    varies, [numbers + varied]."""
    first, total = len(numbers), len(numbers) + count(varied)
    basis = jnp.eye(total)

    def column(direction):
        slopes = [direction[i] for i in range(first)]
        along = _like(varied, direction[first:]), *slopes
        return jax.jvp(function, (varied, *numbers), along)[1]

    return jax.vmap(column)(basis)


def _like(varied, numbers: Array):
    """A tree like the first one, of these numbers."""
    leaves, structure = jax.tree.flatten(varied)
    parts, before = [], 0
    for leaf in leaves:
        parts.append(numbers[before : before + leaf.size].reshape(leaf.shape))
        before += leaf.size
    return jax.tree.unflatten(structure, parts)


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


def _in_blocks(rows):
    """Arrays [rows, ...] as blocks, [blocks, ROWS, ...]; the last one is filled up with zeros."""

    def blocks(leaf):
        padding = jnp.zeros((-leaf.shape[0] % ROWS, *leaf.shape[1:]), leaf.dtype)
        return jnp.concatenate([leaf, padding]).reshape(-1, ROWS, *leaf.shape[1:])

    return jax.tree.map(blocks, rows)


def _in_rows(blocks, count: int):
    """The first rows of what is in blocks."""
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:count], blocks)


def sensitivities(varied, rest, arcs: Arc, remaining: Array) -> tuple[Sensitivity, Sensitivity]:
    """Sensitivities of a run at the entries and at the ends of its arcs, [arcs, inputs].

    varied, rest: leaves of the oscillator, see `split`; left: the time from each entry to t1.
    """
    first = jnp.eye(4 + count(varied))
    start = Sensitivity(first[0], first[1], first[2])

    def advance(entry, block):
        arcs, remaining = block

        def work():
            return _sensitivities_at_ends(varied, rest, arcs, remaining, entry)

        def nothing():
            return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (ROWS, *leaf.shape)), entry)

        ends = lax.cond(any_lane(jnp.any(arcs.used)), work, nothing)
        return jax.tree.map(lambda leaf: leaf[-1], ends), ends

    _, ends = lax.scan(advance, start, _in_blocks((_made_safe(arcs), remaining)))
    ends = _in_rows(ends, remaining.size)
    entries = jax.tree.map(lambda one, rows: jnp.concatenate([one[None], rows[:-1]]), start, ends)
    return entries, ends


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
    slopes = in_turn(_slopes_of_samples)(varied, rest, *rows)
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


def _slopes_of_samples(varied, rest, entries: Array, since: Array, codes: Array, ends: Array):
    """Derivatives of samples, [samples, 2, 3 + parameters]: by the entry, the time since it, and
    the parameters."""

    def slopes_of(block):
        def work():
            return _slopes_of_some(varied, rest, *block)

        # Never skipped but where no sample is known. A kernel that is not in a branch of its own
        # has no second derivatives in a loop (JAX 0.10).
        nothing = jnp.zeros((ROWS, 2, 3 + count(varied)))
        return lax.cond(any_lane(jnp.any(~jnp.isnan(block[1]))), work, lambda: nothing)

    blocks = _in_blocks((entries, since, codes, ends))
    return _in_rows(lax.map(slopes_of, blocks), since.size)


@one_kernel
def _slopes_of_some(varied, rest, entries: Array, since: Array, codes: Array, ends: Array) -> Array:
    """`_slopes_of_samples` of as many as fit into one piece of machine code."""

    def of_sample(row):
        entry, since, codes, end = row
        mode = mode_of(codes.astype(float))

        def carried(varied, x1, x2, since):
            osc = eqx.combine(varied, rest)
            return _carried(osc, mode, (x1, x2), since, (end[0], end[1]))

        return jnp.stack(_slopes_of(carried, varied, entry[0], entry[1], since))

    return lax.map(of_sample, (entries, since, codes, ends))
