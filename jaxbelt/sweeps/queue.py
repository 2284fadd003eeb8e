"""The queue: one compiled loop that works through many runs, a few lanes at a time.

A pass of the loop is

- *refill*: lanes whose run has ended hand in their result and take the next run from the queue;
- *events*: lanes that stand on a guard change their mode by the rules of `modes`, and stick
  phases are passed in closed form;
- *steps*: a few Runge-Kutta steps of the lanes that slip.

Derivatives in some directions go through the same loops beside the values: each refill, check for
events and step is made once, for values and derivatives, see `derivatives.in_directions`.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..kernel import clocked, events, rounds, step, timed_events
from ..kernel.lanes import Lanes, Observer, Program, are_finite, choose
from ..kernel.rounds import STEPS_PER_ROUND
from ..model.oscillator import has_clock
from ..model.own_units import OwnOscillator, in_units, without_edges
from ..model.rest import start_at_focus
from ..numerics.compiling import jit, one_kernel
from ..numerics.derivatives import in_directions
from ..numerics.widths import SideBySide
from ..results import Status

#: Checks for events between two refills: a refill costs about as much as a step, and a lane that
#: waits for one is idle.
ROUNDS_PER_PASS = 4
#: Passes between two checks of whether there is more to do. An accelerator waits for the host at
#: these checks only; passes that find nothing to do change nothing.
PASSES_PER_LOOK = SideBySide(on_cpu=1, elsewhere=4)

#: The default absolute tolerance of a step, in own units.
DEFAULT_TOLERANCE = 1e-8


def _oscillators(program: Program, shared, rows: tuple[Array, ...]) -> OwnOscillator:
    """The oscillators of the lanes: leaves that differ from run to run are arrays [lanes]."""
    leaves, column = [], 2 + program.own_t0
    others = iter(shared)
    for is_mapped in program.mapped:
        if is_mapped:
            leaves.append(rows[column])
            column += 1
        else:
            leaves.append(next(others))
    osc = jax.tree.unflatten(program.structure, leaves)
    return osc if program.edges else without_edges(osc)


def _moves_of(osc: OwnOscillator, observer: Observer) -> tuple[Callable, Callable, Callable]:
    """`pass_events`, `window_of` and `take_step` for lanes with a clock, or without one."""
    if has_clock(osc):
        jumps = not observer.steps_while_stuck
        pass_events = functools.partial(timed_events.pass_timed_events, jumps=jumps)
        return pass_events, clocked.timed_window_of, clocked.take_timed_step
    return events.pass_events, step.window_of, step.take_step


def _begin(program: Program, osc, run, x1, x2, passes, rtol, t0=None) -> Lanes:
    """Lanes at the start of their runs."""
    x1, x2 = x1 / osc.units.length, x2 / osc.units.length
    if has_clock(osc):
        lanes = clocked.timed_lanes_at_start(osc, run, x1, x2, passes, rtol, t0)
    else:
        if program.derivatives:
            x1, x2 = start_at_focus(osc, x1, x2)
        lanes = rounds.lanes_at_start(osc, run, x1, x2, passes, rtol)
    memory, integrals = program.observer.start(osc, lanes), program.observer.integrals(osc, lanes)
    return replace(lanes, memory=memory, integrals=integrals)


class Stream(eqx.Module):
    """The kernel between two calls: lanes, the rows of the queue that they work on, the number of
    passes that its loop has made, and ones for `lanes.materialise`."""

    lanes: Lanes
    rows: tuple[Array, ...]
    passes: Array
    ones: Array


@jit
def idle(program: Program, shared, width: int, columns: int) -> Stream:
    """A stream whose lanes have nothing to do."""
    rows = tuple(jnp.zeros(width) for _ in range(columns))
    osc = _oscillators(program, shared, rows)
    run = jnp.full(width, -1, dtype=jnp.int32)
    start = rows[0], rows[1], jnp.zeros((), jnp.int32), jnp.ones(()), 0.0
    lanes = _begin(program, osc, run, *start)
    lanes = eqx.tree_at(lambda n: n.done, lanes, jnp.ones(width, dtype=bool))
    stream = Stream(lanes, rows, jnp.zeros((), jnp.int32), jnp.ones(width))
    # Strong types, as the kernel returns: weak types of a reducer would compile it twice.
    return jax.tree.map(lambda leaf: lax.convert_element_type(leaf, leaf.dtype), stream)


def differentiable(stream: Stream) -> Stream:
    """The leaves of a stream that may have derivatives; None in place of all others."""
    floats = eqx.filter(stream, eqx.is_inexact_array)
    pairs = (_floats_of_lanes(stream.lanes), None)
    return eqx.tree_at(lambda s: (s.lanes, s.ones), floats, pairs)


def _floats_of_lanes(lanes: Lanes) -> Lanes:
    floats = eqx.filter(lanes, eqx.is_inexact_array)
    return eqx.tree_at(lambda n: [n.h, n.pace, *n.mode.codes], floats, replace_fn=lambda _: None)


def _floats_of_round(begun):
    lanes, window = begun
    floats = eqx.filter(window, eqx.is_inexact_array)
    floats = eqx.tree_at(lambda w: w.signs, floats, (None,) * len(window.signs))
    return _floats_of_lanes(lanes), floats


def _ordered(values: dict[str, Any]) -> list[str]:
    return sorted(values)


def _handed_in(observer: Observer, osc: OwnOscillator, lanes: Lanes) -> dict[str, Any]:
    """The observer's results for the lanes, in the units in which their runs were given."""
    found = observer.finish(osc, lanes)
    for name, value in found.items():
        known = observer.variables.get(name)
        if known is not None and known.dimension:
            found[name] = jax.tree.map(lambda x, to=known.dimension: osc.units.back(x, to), value)
    return found


def _columns(values: dict[str, Any]) -> list[Array]:
    """Results by sorted names as float columns [lanes], one for each entry of a tuple or vector."""
    columns = []
    for name in _ordered(values):
        for value in jax.tree.leaves(values[name]):
            value = value.astype(jnp.float64)
            columns += [value] if value.ndim == 1 else list(value.reshape(value.shape[0], -1).T)
    return columns


class Common(eqx.Module):
    """What all runs of a call have in common.

    shared: the leaves of the oscillator that do not differ from run to run; t1; rtol; atol: in the
    units in which runs are given, NaN for the default; limit: how many passes a run may take. t0:
    with a clock, the time at which runs begin, unless each has its own; None: 0.
    """

    shared: list[Array]
    t1: Any
    rtol: Any
    atol: Any
    limit: Any
    t0: Any = None


class _Block(eqx.Module):
    """The next runs of the queue: no more than there are lanes.

    rows: their columns [lanes] of the queue; first: number of the first one; available: number of
    these runs. until: number of the pass before which the inner loop ends; drain: whether it goes
    on until all lanes are idle, and not only until these runs are taken.
    """

    rows: tuple[Array, ...]
    first: Array
    available: Array
    until: Array
    drain: Array


class _Desk(eqx.Module):
    """The stream, and the results that its lanes have handed in: no more than there are lanes.

    taken: how many runs of the block were taken; filled: how many results were handed in; numbers,
    columns: the numbers of their runs, and the results, arrays [lanes].
    """

    stream: Stream
    taken: Array
    filled: Array
    numbers: Array
    columns: list[Array]


def _floats_of(desk: _Desk) -> _Desk:
    """The leaves of a desk that may have derivatives; None in place of all others."""
    floats = eqx.filter(desk, eqx.is_inexact_array)
    return eqx.tree_at(lambda d: d.stream, floats, differentiable(desk.stream))


def _refill(program: Program, common: Common, block: _Block, desk: _Desk) -> _Desk:
    """Hands in the results of finished runs and starts new runs in free lanes."""
    observer, ones = program.observer, desk.stream.ones
    slots = jnp.arange(ones.size, dtype=jnp.int32)
    lanes, passes = desk.stream.lanes, desk.stream.passes
    osc = _oscillators(program, common.shared, desk.stream.rows)
    lanes = _give_up(observer.watch_rarely(osc, lanes, ones), passes, common.limit)
    finished = lanes.done & (lanes.run >= 0)
    finished = finished & (_rank(finished) < ones.size - desk.filled)
    # Finished lanes in order, behind the results that are already there.
    source = jnp.searchsorted(_rank(finished), slots - desk.filled)
    new = [lanes.run, *_columns(_handed_in(observer, osc, lanes))]
    pairs = zip([desk.numbers, *desk.columns], new, strict=True)
    handed = [
        jnp.where(slots < desk.filled, old, value.at[source].get(mode="fill", fill_value=-1))
        for old, value in pairs
    ]

    free = lanes.done & (finished | (lanes.run < 0))
    place = desk.taken + _rank(free)
    takes = free & (place < block.available)
    place = jnp.where(takes, place, 0)
    pairs = zip(block.rows, desk.stream.rows, strict=True)
    rows = tuple(jnp.where(takes, column[place], row) for column, row in pairs)
    osc = _oscillators(program, common.shared, rows)
    numbers = passes, common.rtol, rows[2] if program.own_t0 else common.t0
    fresh = _begin(program, osc, block.first + place, rows[0], rows[1], *numbers)
    lanes = choose(takes, fresh, replace(lanes, run=jnp.where(free, -1, lanes.run)))
    return _Desk(
        Stream(lanes, rows, passes + 1, ones),
        desk.taken + jnp.sum(takes, dtype=jnp.int32),
        desk.filled + jnp.sum(finished, dtype=jnp.int32),
        handed[0],
        handed[1:],
    )


def _work(program: Program, common: Common, stream: Stream, slopes: Sequence[Stream]):
    """The stream after ROUNDS_PER_PASS rounds, each a passage of events and STEPS_PER_ROUND
    steps, and its derivatives, one for each direction."""
    observer, ones = program.observer, stream.ones
    t1, rtol = common.t1, common.rtol
    rules = dict(captures=program.captures, derivatives=program.derivatives)

    def begin(rows, lanes):
        osc = _oscillators(program, common.shared, rows)
        pass_events, window_of, _ = _moves_of(osc, observer)
        lanes, passage = pass_events(osc, lanes, t1, rtol, **rules)
        lanes = observer.watch(osc, lanes, passage, ones, t1, rtol)
        return lanes, window_of(osc, lanes, extrema=observer.extrema(lanes))

    def go(rows, lanes, window):
        osc = _oscillators(program, common.shared, rows)
        atol = in_units(common.atol, osc.units.length, DEFAULT_TOLERANCE)
        forward = functools.partial(_moves_of(osc, observer)[2], derivatives=program.derivatives)
        return observer.follow(forward, osc, window, ones, lanes, t1, rtol, atol)

    rows, rows_slopes = stream.rows, [one.rows for one in slopes]

    def round_(_, state):
        lanes, slopes = state
        begun = list(zip(rows_slopes, slopes, strict=True))
        (lanes, window), slopes = in_directions(begin, (rows, lanes), begun, _floats_of_round)

        def go_on(_, state):
            lanes, own = state
            begun = [(r, one, w) for r, one, (_, w) in zip(rows_slopes, own, slopes, strict=True)]
            return in_directions(go, (rows, lanes, window), begun, _floats_of_lanes)

        return lax.fori_loop(0, STEPS_PER_ROUND, go_on, (lanes, [one for one, _ in slopes]))

    begun = stream.lanes, [one.lanes for one in slopes]
    lanes, own = lax.fori_loop(0, ROUNDS_PER_PASS, round_, begun)
    pairs = zip(slopes, own, strict=True)
    slopes = [eqx.tree_at(lambda s: s.lanes, one, lanes) for one, lanes in pairs]
    return replace(stream, lanes=lanes), slopes


def _at_work(stream: Stream) -> Array:
    return jnp.any((stream.lanes.run >= 0) | ~stream.lanes.done)


def _fill(program: Program, common: Common, block: _Block, desk: _Desk, slopes):
    """The inner loop: works until the block of runs is taken, the desk is full, or the last pass.

    slopes: derivatives of the block's rows and of the desk, (rows, desk) for each direction.
    Returns the desk and its derivatives. It closes over no array, so that it can be one piece of
    machine code.
    """

    def unfinished(state):
        desk, _ = state
        more = (desk.taken < block.available) | (block.drain & _at_work(desk.stream))
        return more & (desk.filled < desk.numbers.size) & (desk.stream.passes - block.until < 0)

    def refill(rows, desk):
        return _refill(program, common, replace(block, rows=rows), desk)

    def go_on(state):
        desk, own = state
        begun = [(rows, one) for (rows, _), one in zip(slopes, own, strict=True)]
        desk, own = in_directions(refill, (block.rows, desk), begun, _floats_of)
        stream, streams = _work(program, common, desk.stream, [one.stream for one in own])
        pairs = zip(own, streams, strict=True)
        own = [eqx.tree_at(lambda d: d.stream, one, stream) for one, stream in pairs]
        return replace(desk, stream=stream), own

    def some_passes(state):
        passes = PASSES_PER_LOOK.here
        if passes == 1:
            return go_on(state)
        return lax.fori_loop(0, passes, lambda _, state: go_on(state), state)

    return lax.while_loop(unfinished, some_passes, (desk, [one for _, one in slopes]))


class Call(eqx.Module):
    """The arguments of one call of the kernel: scalars, all but `drain` int32.

    first: number of the first run in the queue; count: how many runs there are; taken: how many of
    them earlier calls took; passes: how many passes of the loop this call may make; drain: whether
    to go on until all lanes are idle, and not only until all runs are taken.
    """

    first: Any
    count: Any
    taken: Any
    passes: Any
    drain: Any


def advance(program: Program, common: Common, queue, call: Call, streams):
    """Works through the queue, or as far as the call's passes go.

    queue: [1 + directions, columns, runs + lanes], the starts and the parameters that differ, and
    their derivatives; streams: the stream, and its derivatives, see `differentiable`, in each
    direction. Returns the streams, the number of runs taken, whether there is more to do, and, in
    order of completion, numbers of runs (-1 where there is none) and results [1 + directions,
    columns, runs + 3 lanes].

    Two loops, because on the CPU only loops on small arrays can be one kernel. The inner loop sees
    small ones only: as many new runs, and as many results, as there are lanes. On accelerators
    there are as many lanes as a device does at once, nothing is written to places that lanes choose
    (no write waits for another), and the host has to read the conditions of the two loops only.
    """
    program = replace(program, derivatives=len(queue) > 1)
    width, columns = streams[0].ones.size, _columns_of(program, common.shared)
    size = queue.shape[-1] + 2 * width
    one_piece = one_kernel(functools.partial(_fill, program))
    columns_of_queue = [tuple(own) for own in queue]
    # Pass numbers may overflow; their differences stay right.
    until = streams[0].passes + call.passes

    def rows_at(taken, columns):
        return tuple(lax.dynamic_slice_in_dim(column, taken, width, axis=-1) for column in columns)

    def put(wholes, parts, written):
        pairs = zip(wholes, parts, strict=True)
        return [lax.dynamic_update_slice_in_dim(a, b, written, axis=-1) for a, b in pairs]

    def outer(state):
        (stream, slopes), taken, written, numbers, results = state
        zero, none = jnp.zeros_like(taken), jnp.full(width, -1, dtype=jnp.int32)
        available = jnp.minimum(call.count - taken, width)
        drain = call.drain & (taken + available >= call.count)
        rows, *rows_slopes = (rows_at(taken, own) for own in columns_of_queue)
        block = _Block(rows, call.first + taken, available, until, drain)
        blank = [jnp.zeros(width)] * columns
        desk = _Desk(stream, zero, zero, none, blank)
        desks = [eqx.tree_at(lambda d: d.stream, _floats_of(desk), one) for one in slopes]
        desk, desks = one_piece(common, block, desk, list(zip(rows_slopes, desks, strict=True)))
        numbers = lax.dynamic_update_slice(numbers, desk.numbers, (written,))
        pairs = zip(results, [desk, *desks], strict=True)
        results = [put(wholes, one.columns, written) for wholes, one in pairs]
        taken, written = taken + desk.taken, written + desk.filled
        return (desk.stream, [one.stream for one in desks]), taken, written, numbers, results

    def more(stream, taken):
        return (taken < call.count) | (call.drain & _at_work(stream))

    def unfinished(state):
        (stream, _), taken, *_ = state
        return more(stream, taken) & (stream.passes - until < 0)

    numbers = jnp.full(size, -1, dtype=jnp.int32)
    results = [[jnp.full(size, jnp.nan) for _ in range(columns)] for _ in queue]
    start = streams, call.taken, jnp.zeros((), jnp.int32), numbers, results
    streams, taken, _, numbers, results = lax.while_loop(unfinished, outer, start)
    results = jnp.stack([jnp.stack(own) for own in results])
    return streams, taken, more(streams[0], taken), numbers, results


def _columns_of(program: Program, shared) -> int:
    """Number of columns of the results."""
    return sum(math.prod(shape) for shape in layout(program, shared).values())


def _rank(flags: Array) -> Array:
    """For each set flag, the number of set flags before it."""
    return jnp.cumsum(flags.astype(jnp.int32)) - 1


def _give_up(lanes: Lanes, passes, limit) -> Lanes:
    """Ends runs that took too many steps, or whose state is not finite."""
    finite = are_finite(lanes)
    lost = ~lanes.done & (~finite | (passes - lanes.first_pass > limit))
    reason = jnp.where(finite, Status.TOO_MANY_STEPS.value, Status.NOT_FINITE.value)
    status = jnp.where(lost, reason.astype(lanes.status.dtype), lanes.status)
    return eqx.tree_at(lambda n: (n.status, n.done), lanes, (status, lanes.done | lost))


def layout(program: Program, shared: list[Array]) -> dict[str, tuple[int, ...]]:
    """The results of a run in the order of their columns: the shape of each by name."""
    return dict(_layout(program, tuple((leaf.shape, leaf.dtype) for leaf in shared)))


@functools.lru_cache(maxsize=128)
def _layout(program: Program, shared: tuple[Any, ...]) -> dict[str, tuple[int, ...]]:
    """The layout of a program; shared: shape and type of each leaf that does not vary."""

    def finish(shared):
        stream = idle(program, shared, 1, program.columns)
        osc = _oscillators(program, shared, stream.rows)
        return _handed_in(program.observer, osc, stream.lanes)

    values = jax.eval_shape(finish, [jax.ShapeDtypeStruct(*leaf) for leaf in shared])
    shapes = {}
    for name in _ordered(values):
        value = values[name]
        if any(jnp.issubdtype(part.dtype, jnp.complexfloating) for part in jax.tree.leaves(value)):
            raise TypeError(
                f"observe.finish must be a method that returns real results, got complex numbers "
                f"for {name}; let their real and their imaginary part be two results"
            )
        is_tuple = isinstance(value, tuple)
        shapes[name] = (len(value),) if is_tuple else value.shape[1:]
    return shapes


def column_of(layout: dict[str, tuple[int, ...]], name: str) -> int:
    """The number of a result's first column."""
    names = list(layout)
    return sum(math.prod(layout[before]) for before in names[: names.index(name)])


def by_name(layout: dict[str, tuple[int, ...]], columns: np.ndarray) -> dict[str, np.ndarray]:
    """Columns [..., columns, runs] as results by name, [..., runs] and the shape of each."""
    results, first = {}, 0
    for name, shape in layout.items():
        part = np.moveaxis(columns[..., first : first + math.prod(shape), :], -2, -1)
        results[name] = part.reshape(*part.shape[:-1], *shape)
        first += math.prod(shape)
    return results
