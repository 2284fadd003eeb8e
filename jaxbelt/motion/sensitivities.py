"""Derivatives of a run, from its arcs.

Once the arcs of a run are known (entry, mode, duration, and what ended each) its derivatives need
no search for events and no control of steps. Each arc is flown again by a fixed number of steps,
many arcs at once, for its Jacobian: the derivatives of its end and its duration by its entry, by
the time that is left, and by the parameters. Where a guard ended it, the duration follows from the
guard (implicit function theorem). The sensitivities of all entries are then a linear recurrence
over the arcs.

The tangent of a run is its sensitivities times the tangent of its inputs, a product that reverse
mode transposes; so both modes, and any number of derivatives by one run, cost about the same.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.instants import TimedState, carried, field_at, guards_at, on_guard_at
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
from ..model.oscillator import Oscillator, has_clock
from ..model.rest import is_slow
from ..model.transitions import edge_of_guard, on_guard
from ..numerics.compiling import LARGEST, any_lane, axes_of, one_kernel
from ..numerics.derivatives import moving_and_fixed
from ..numerics.implicit import delay_of_root
from ..numerics.padding import in_groups_of, longer
from .arcs import stick_arc
from .flights import (
    MOST_FLIGHTS,
    ROWS,
    RUNS,
    Arc,
    largest_power,
    of_one_run,
    sizes_of,
    slopes_of,
)
from .integrators import State, slip_field


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


def _state_since(osc: Oscillator, arc: Arc, end: State, y: State, since: Array) -> State:
    """The state a time `since` after the entry y, in the mode of an arc, near its end.

    end: as `_flown_again` gives it.
    """
    if has_clock(osc):
        return _later(osc, arc, _timed_end(osc, arc, end, y), since - arc.duration)
    mode = arc.mode
    late, slopes = since - arc.duration, slip_field(osc, mode, end)
    v = stick_velocity(osc, mode, jnp.zeros(())) / osc.omega
    slipped = end[0] + late * slopes[0], end[1] + late * slopes[1]
    return select(mode.any_stuck, (y[0] + v * since, v), slipped)


def _passed(osc: Oscillator, arc: Arc, end: State, y: State, remaining: Array) -> tuple[Array, ...]:
    """Where the orbit goes on after a known arc, x1 and x2, and the arc's duration.

    All are functions of the oscillator, of the entry y, and of the time that is left, near those of
    the arc; end: as `_flown_again` gives it.
    """
    if has_clock(osc):
        return _passed_in_time(osc, arc, end, y, remaining)
    mode = arc.mode
    stuck = mode.any_stuck
    # The values of the run itself, so that the field is the same here and at the next entry.
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

    # How much later than after `duration` the arc ends: 0, with the right derivatives.
    slopes = slip_field(osc, mode, end)
    late = delay_of_root(fired_guard, end, slopes)
    late = jnp.where(arc.in_time, remaining - arc.duration, late)
    x1, x2 = on_guard(osc, mode, arc.ended_by, end[0] + late * slopes[0], end[1] + late * slopes[1])
    slipped = x1, jnp.where(arc.captured, 0.0, x2), arc.duration + late
    phase = stick_arc(osc, mode, y, remaining)
    return select(stuck, (*phase.y, phase.duration), slipped)


def _timed_end(osc: Oscillator, arc: Arc, end: State, y: State) -> TimedState:
    """With a clock: the end of an arc, stuck or not, see `_state_since`."""
    x1, x2, t = select(arc.mode.any_stuck, carried(osc, arc.mode, _timed(y), arc.duration), end)
    return x1, x2, t


def _timed(y: State) -> TimedState:
    x1, x2, t = y
    return x1, x2, t


def _later(osc: Oscillator, arc: Arc, y: TimedState, late: Array) -> TimedState:
    """The state a small time `late` later, to first order."""
    slopes = field_at(osc, arc.mode, y)
    x1, x2, t = (part + late * slope for part, slope in zip(y, slopes, strict=True))
    return x1, x2, t


def _passed_in_time(
    osc: Oscillator, arc: Arc, end: State, y: State, remaining: Array
) -> tuple[Array, ...]:
    """`_passed` with a clock: the duration follows from the guard, for a stick phase, too."""
    mode = arc.mode
    found = _timed_end(osc, arc, end, y)
    x1, x2, t = (_with_numbers_of(a, b) for a, b in zip(_timed(arc.end), found, strict=True))
    known = x1, x2, t

    def fired_guard(x1, x2, t):
        n, guards = len(osc.belts), guards_at(osc, mode, (x1, x2, t))
        fired = jnp.sum(jnp.where(jnp.arange(guards.size) == arc.ended_by, guards, 0.0))
        at_edge = (arc.ended_by >= n) & (arc.ended_by < 3 * n)
        return jnp.where(at_edge, x1 - edge_of_guard(osc, mode, arc.ended_by), fired)

    late = delay_of_root(fired_guard, known, field_at(osc, mode, known))
    late = jnp.where(arc.in_time, remaining - arc.duration, late)
    x1, x2, _ = on_guard_at(osc, mode, arc.ended_by, _later(osc, arc, known, late))
    return x1, jnp.where(arc.captured, 0.0, x2), arc.duration + late


def _with_numbers_of(known: Array, found: Array) -> Array:
    """The known number, with the derivatives of the one that was found."""
    return lax.stop_gradient(known) + (found - lax.stop_gradient(found))


def _creep(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> tuple[Array, Array, Array]:
    """Whether the mass slips but hardly moves, see `rest.is_slow`; and the field, (x2, x2')."""
    if has_clock(osc):
        # With a clock the forces change even while the mass hardly moves: no state counts as slow.
        return mode.any_stuck & False, x2, x2
    _, a = slip_field(osc, mode, (x1, x2))
    return ~mode.any_stuck & is_slow(x2, a), x2, a


def parts_of_states(states: Array) -> State:
    """The parts of states, [rows, parts]."""
    return tuple(states[:, i] for i in range(states.shape[1]))


def in_one_row(*slopes) -> Array:
    """The numbers of some trees in one array, one after the other."""
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(slopes)])


# --- from arc to arc ------------------------------------------------------------------------------


def sensitivities(varied, rest, arcs: Arc, remaining: Array) -> Sensitivity:
    """Sensitivities of a run at the ends of its arcs, [arcs, inputs].

    varied, rest: leaves of the oscillator, see `moving_and_fixed`; remaining: the time from each
    entry to t1.
    Rows of unused arcs have no meaning, but for the last row, which is that of the last used arc.
    """
    return of_one_run(_sensitivities, varied, rest, arcs, remaining)


def _sensitivities(by_run, varied, rest, arcs: Arc, remaining: Array) -> Sensitivity:
    """`sensitivities` of runs side by side, [runs, arcs, inputs]."""
    runs, rows = remaining.shape
    inputs = 4 + sum(sizes_of(by_run, varied))
    fitting = largest_power(max(1, LARGEST.here // inputs))
    width = min(largest_power(2 * runs - 1), fitting, RUNS.here)
    depth = min(ROWS, max(1, MOST_FLIGHTS.here // width))
    blocks, chunks = -(-runs // width), -(-rows // depth)
    more_rows = longer((arcs, remaining), chunks * depth, axis=1, fill=0)
    arcs, remaining = longer(more_rows, blocks * width, fill=0)
    own, shared = eqx.partition((varied, rest), by_run)
    own = longer(own, blocks * width)
    first = Sensitivity(*jnp.broadcast_to(jnp.eye(inputs)[:3, None], (3, width, inputs)))

    def block(_, number):
        of_block = jax.tree.map(lambda leaf: _part(leaf, (number * width, width)), own)
        varied, rest = eqx.combine(shared, of_block)

        def chunk(carry, k):
            place = (number * width, width), (k * depth, depth)
            some, left = jax.tree.map(lambda leaf: _part(leaf, *place), (arcs, remaining))

            def work():
                return _past_chunk(by_run, varied, rest, some, left, carry)

            def nothing():
                none = jnp.zeros((width, depth, inputs))
                return carry, Sensitivity(none, none, none)

            return lax.cond(any_lane(jnp.any(some.used)), work, nothing)

        (last, _), ends = lax.scan(chunk, (first, first.t), jnp.arange(chunks))

        def in_rows(chunked, last):
            flat = jnp.moveaxis(chunked, 0, 1).reshape(width, chunks * depth, inputs)
            return flat.at[:, rows - 1].set(last)

        return None, jax.tree.map(in_rows, ends, last)

    _, ends = lax.scan(block, None, jnp.arange(blocks))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:runs, :rows], ends)


def _part(leaf: Array, *spans) -> Array:
    """The slice (first, size) of each of the first axes of an array."""
    for axis, (first, size) in enumerate(spans):
        leaf = lax.dynamic_slice_in_dim(leaf, first, size, axis)
    return leaf


#: Sensitivities of runs at the arc reached, and those of the time when the loop began, arrays
#: [runs, inputs].
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
    axes = axes_of(by_run)

    def creep(parts, arc):
        return _creep(eqx.combine(*parts), arc.mode, *arc.entry[:2])

    creeps = jax.vmap(creep, (axes, 0))(of_runs, arcs)
    slopes = slopes_of(_passed, by_run, varied, rest, run, arcs, remaining, arcs.used)
    # As many rows at once as fit into one piece of machine code.
    size = min(depth, largest_power(max(1, LARGEST.here // carry[1].size)))
    rows = jax.tree.map(
        lambda leaf: leaf.reshape(depth // size, size, width, *leaf.shape[1:]),
        (slopes, arcs.used, creeps, arcs.begins_loop, arcs.again.astype(float)),
    )
    carry, ends = lax.scan(lambda carry, rows: _past_rows(carry, rows), carry, rows)
    ends = jax.tree.map(lambda leaf: jnp.moveaxis(leaf.reshape(depth, width, -1), 0, 1), ends)
    return carry, ends


@one_kernel
def _past_rows(carry: Carry, rows):
    """The sensitivities after some arcs, and at the end of each, [arcs, runs, inputs]; rows: for
    each arc its derivatives, whether it is used, its `_creep`, and `begins_loop` and `again`."""

    def advance(carry, row):
        before, began = carry
        slopes, used, (creeps, x2, a), begins_loop, again = row
        x2, a = x2[:, None], a[:, None]
        moved = before.x1 - x2 * before.t, before.x2 - a * before.t
        fixed = Sensitivity(*moved, jnp.zeros_like(before.t))
        before = select(creeps[:, None], fixed, before)
        is_t1 = jnp.where(jnp.arange(before.t.shape[1]) == 3, 1.0, 0.0)[None]

        def through(slopes):
            d = 3 + slopes.shape[1] - before.t.shape[1]
            by_entry = slopes[:, :1] * before.x1 + slopes[:, 1:2] * before.x2
            if d == 3:
                by_entry = by_entry + slopes[:, 2:3] * before.t
            nothing = jnp.zeros((slopes.shape[0], 4))
            by_parameters = jnp.concatenate([nothing, slopes[:, d + 1 :]], axis=1)
            return by_entry + slopes[:, d : d + 1] * (is_t1 - before.t) + by_parameters

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
def with_derivatives(
    osc: Oscillator, entries: Array, since: Array, numbers: Array, codes: Array, states: Array
):
    """The states, [samples, 2], with derivatives. Each is reached from the entry (x1, x2), with a
    clock (x1, x2, t), of the arc with the number in `numbers`, in the mode `codes`, [belts], after
    the time `since`."""
    return states


@with_derivatives.def_jvp
def _(primals, tangents):
    osc, entries, since, numbers, codes, _ = primals
    along, entries_along, since_along, *_ = tangents
    states = with_derivatives(*primals)
    if not states.size:
        return states, jnp.zeros(states.shape)
    varied, rest = moving_and_fixed(osc, along)
    if entries_along is None:
        entries_along = jnp.zeros_like(entries)
    if since_along is None:
        since_along = jnp.zeros_like(since)
    d = entries.shape[1]
    reached = states
    if d == 3:
        reached = jnp.concatenate([states, (entries[:, 2] + since)[:, None]], axis=1)
    # While the mass hardly moves, a later entry time has the effect of another entry state.
    modes = mode_of(jnp.moveaxis(codes.astype(float), -1, 0))
    creeps, *field = _creep(osc, modes, entries[:, 0], entries[:, 1])
    earlier = jnp.where(creeps, since_along, 0.0)
    if d == 2:
        entries_along = entries_along + jnp.stack(field, axis=1) * earlier[:, None]
    since_along = since_along - earlier
    # From the sample before, if it lies in the same arc: the flight is shorter.
    before = jnp.roll(since, 1)
    goes_on = (numbers == jnp.roll(numbers, 1)) & (before <= since)
    goes_on = goes_on.at[0].set(False)
    starts = jnp.where(goes_on[:, None], jnp.roll(reached, 1, axis=0), entries)
    times = since - jnp.where(goes_on, before, 0.0)
    times_along = since_along - jnp.where(goes_on, jnp.roll(since_along, 1), 0.0)
    rows = starts, times, codes, lax.stop_gradient(reached)
    slopes = of_one_run(_slopes_of_samples, varied, rest, *rows)
    by_start, by_time, by_parameters = slopes[..., :d], slopes[..., d], slopes[..., d + 1 :]
    moved = by_time * times_along[:, None]
    if by_parameters.shape[2]:
        moved = moved + by_parameters @ in_one_row(along)

    def advance(before, row):
        goes_on, entry, by_start, moved = row
        after = by_start @ jnp.where(goes_on, before, entry) + moved
        return after, after

    _, moved = lax.scan(advance, jnp.zeros(d), (goes_on, entries_along, by_start, moved))
    return states, moved if d == 2 else moved[:, :2]


def _slopes_of_samples(by_run, varied, rest, starts: Array, since: Array, codes: Array, ends):
    """Derivatives of samples, [runs, samples, d, d + 1 + parameters]: by the state that each is
    reached from, the time since then, and the parameters; d: 2, with a clock 3."""
    runs, samples = since.shape
    total = runs * samples
    size = min(MOST_FLIGHTS.here, largest_power(2 * total - 1))

    def chunks(leaf):
        return in_groups_of(size, leaf.reshape(total, *leaf.shape[2:]))

    run = jnp.broadcast_to(jnp.arange(runs)[:, None], since.shape)

    def of_chunk(rows):
        run, starts, since, codes, ends = rows
        known = ~jnp.isnan(since)
        never = jnp.zeros_like(known)
        arcs = Arc(
            entry=parts_of_states(starts),
            end=parts_of_states(ends),
            codes=codes,
            duration=since,
            ended_by=jnp.full(since.shape, -1),
            in_time=never,
            captured=never,
            used=known,
            begins_loop=never,
            again=jnp.zeros(since.shape, int),
        )

        slopes = slopes_of(_state_since, by_run, varied, rest, run, arcs, since, known)
        return jnp.where(known[:, None, None], jnp.stack(slopes, axis=1), 0.0)

    slopes = lax.map(of_chunk, tuple(map(chunks, (run, starts, since, codes, ends))))
    return slopes.reshape(-1, *slopes.shape[2:])[:total].reshape(runs, samples, *slopes.shape[2:])
