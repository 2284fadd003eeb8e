"""Many runs of `simulate` at once, through the lanes of `kernel`.

Runs are followed in groups, side by side. A round of a group is some steps of all its lanes; the
events of all rounds are recorded in a book. The arcs of a run, their events and its samples are
then taken from this record. A loop that a run repeats is followed once, see `kernel.marks`.

The kernel cannot finish a few runs, such as those at rest on a guard; they are run again one by
one.
"""

import functools
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..kernel.lanes import Lanes, are_finite, codes_in
from ..kernel.marks import LoopSearch, time_back
from ..kernel.rounds import Round, flown_on, lanes_at_start, one_round
from ..model.events import event_between
from ..model.modes import Mode
from ..model.oscillator import Oscillator
from ..numerics.compiling import any_lane, one_kernel
from ..numerics.widths import SideBySide
from ..results import Status
from .loops import RepeatedLoop

#: Lanes of a group, at most.
LANES_AT_ONCE = SideBySide(on_cpu=128, elsewhere=2**14)
#: Rounds that one piece of machine code makes.
PAGE = 8
#: An arc of a batch ends where a multiple of this time is passed: longer arcs would take more steps
#: for derivatives, those of the whole arc and those of samples within.
LONGEST_ARC = 2.0
#: Arcs of each run that are looked up at once: most runs have far fewer than there is room for.
ARCS_AT_ONCE = 64
#: Capacity of a book, in rounds of single lanes, of 180 bytes each; if a lane may need many rounds,
#: a group has fewer lanes.
BOOK = SideBySide(on_cpu=2**20, elsewhere=2**24)
#: The tolerance of a lane's steps over that of the run. A run by itself is far more accurate than
#: its tolerance, and has to be the same in a batch; at order eight a hundred times the accuracy
#: takes 1.8 times the steps.
SHARE = 1e-2
#: Smallest tolerance of a lane's steps; smaller ones would ask for less than rounding.
LEAST_TOLERANCE = 1e-13


class Batch(NamedTuple):
    """Sizes that all groups of a batch have in common.

    width: lanes of a group; rounds: capacity of its book; rows: capacity for the arcs of a run that
    are followed; most: largest number of arcs of a run; belts: number of belts.
    """

    width: int
    rounds: int
    rows: int
    most: int
    belts: int


class Group(NamedTuple):
    """The runs of a group, arrays [.., lanes].

    lanes: at the end of the runs; arcs: columns of `runs.ArcRecord` by name, [rows, lanes]; used:
    mask of the rows that hold an arc, [rows, lanes]; loop: the loops that the runs repeat; samples:
    [samples, 2, lanes]; alone: mask of runs that have to be followed one by one.
    """

    lanes: Lanes
    arcs: dict[str, Any]
    used: Array
    loop: RepeatedLoop
    samples: Array
    alone: Array


def blank_book(osc, batch: Batch) -> Round:
    """An empty book for the rounds of a group, [rounds, ..]; osc: an oscillator of the lanes."""
    ones = jnp.ones(batch.width)

    def kept(osc):
        lanes = _first_lanes(osc, (ones, ones), ones[0], batch)
        return one_round(osc, lanes, ones, ones, ones[0], ones[0])[1]

    shapes = jax.eval_shape(kept, osc)
    return jax.tree.map(lambda s: jnp.zeros((batch.rounds, *s.shape), s.dtype), shapes)


def _first_lanes(osc, y0, rtol, batch: Batch) -> Lanes:
    run, (x1, x2) = jnp.zeros(batch.width, jnp.int32), y0
    passes = jnp.zeros((), jnp.int32)
    lanes = lanes_at_start(osc, run, x1, x2, passes, rtol)
    return replace(lanes, memory=LoopSearch.none(lanes.t))


def followed_together(
    osc: Oscillator, y0, span, ts, rtol, atol, batch: Batch, book: Round
) -> tuple[Group, Round]:
    """The runs of a group, and its book, which takes the place of the `book` given.

    osc: leaves are scalars or [lanes]; y0: (x1, x2), [lanes] each; span: t1 - t0, [lanes]; ts:
    times since t0, [samples, lanes].
    """
    ones = jnp.ones(batch.width)
    tolerances = [jnp.maximum(SHARE * tol, LEAST_TOLERANCE) for tol in (rtol, atol)]
    lanes = _first_lanes(osc, y0, tolerances[0], batch)
    lanes, book, rounds = _written(osc, lanes, ones, span, tolerances, batch, book)
    inside = (jnp.arange(batch.rounds) < rounds)[:, None]
    repeat: LoopSearch = lanes.memory
    arcs, used, loop, fits = _arcs(book, inside, repeat, batch)
    passed = (leaf[None] for leaf in (repeat.loops, repeat.t, repeat.period))
    ts = ts - time_back(ts, *passed)
    samples = _samples(osc, book, inside, ones, ts, batch)
    begins_nowhere = lanes.status == Status.NOT_FINITE.value
    known = lanes.done & fits & ~jnp.any(book.rests & inside, axis=0) & are_finite(lanes)
    return Group(lanes, arcs, used, loop, samples, ~known & ~begins_nowhere), book


def _written(osc, lanes, ones, span, tolerances, batch: Batch, book) -> tuple[Lanes, Round, Array]:
    """Makes rounds until all lanes are done or the book is full: returns the lanes at the end, the
    book, and the number of rounds."""

    @one_kernel
    def page(osc, lanes, ones, span, rtol, atol):
        def advance(lanes, _):
            return one_round(osc, lanes, ones, span, rtol, atol)

        return lax.scan(advance, lanes, length=PAGE)

    def unfinished(state):
        lanes, _, number = state
        return jnp.any(~lanes.done & are_finite(lanes)) & (number < batch.rounds)

    def turn(state):
        lanes, book, number = state
        lanes, new = page(osc, lanes, ones, span, *tolerances)
        put = functools.partial(lax.dynamic_update_slice_in_dim, start_index=number, axis=0)
        return lanes, jax.tree.map(put, book, new), number + PAGE

    return lax.while_loop(unfinished, turn, (lanes, book, jnp.asarray(0)))


class _Chains(NamedTuple):
    """The arcs of the lanes, as chains of the phases of their rounds.

    A round has two phases, of which one may be empty: a stick phase, and the lane's steps. begun,
    ended: how many arcs have begun, and ended, by the end of each phase, [2 rounds, lanes]; fires:
    whether the steps of a round end on a guard, [rounds, lanes].
    """

    begun: Array
    ended: Array
    fires: Array


def _chains(book: Round, inside: Array) -> _Chains:
    """Which phases belong to one arc: steps in one mode, while x2 moves one way."""
    # What ended the steps of a round is recorded in the next round.
    fires = _row_after(book.fired & inside)
    first, last = book.ts[0], book.ts[-1]
    slips, sticks = inside & ((last > first) | fires), book.stuck & inside
    # Arcs are cut at extrema of x2, so that the law bends most at one of their ends.
    way, part = book.x2s[-1] >= book.x2s[0], jnp.floor(first / LONGEST_ARC)
    goes_on = (way == _row_after(way)) & (part == _row_after(part)) & _row_after(slips & ~sticks)
    goes_on = slips & ~fires & goes_on
    goes_on = goes_on.at[-1].set(False)
    follows = jnp.roll(goes_on, 1, axis=0)

    def counted(sticks, slips):
        phases = jnp.stack([sticks, slips], axis=1).reshape(-1, sticks.shape[1])
        return _running_total(phases.astype(jnp.int32))

    return _Chains(counted(sticks, slips & ~follows), counted(sticks, slips & ~goes_on), fires)


def _row_after(rows: Array) -> Array:
    """The rows shifted by one, each replaced by the next; the last, never used, by the first."""
    return jnp.roll(rows, -1, axis=0)


def _running_total(rows: Array) -> Array:
    """The sum of the rows up to each, [rows, lanes]; in pages, for XLA sums long columns slowly."""
    pages = rows.reshape(-1, 2 * PAGE, rows.shape[1])
    within = jnp.cumsum(pages, axis=1)
    before = jnp.cumsum(within[:, -1], axis=0) - within[:, -1]
    return (within + before[:, None]).reshape(rows.shape)


def _arcs(book: Round, inside: Array, repeat: LoopSearch, batch: Batch):
    """The arcs of the lanes, which rows are used, the loops that they repeat, and whether there was
    room for all."""
    chains = _chains(book, inside)
    total, size = chains.begun[-1], min(ARCS_AT_ONCE, batch.rows)

    def some(first):
        return _arcs_from(first, size, book, chains, repeat, batch)

    def nothing(first):
        shapes = jax.eval_shape(some, first)
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def looked_up(first):
        return lax.cond(any_lane(jnp.any(first < total)), some, nothing, first)

    parts = lax.map(looked_up, jnp.arange(0, batch.rows, size, dtype=jnp.int32))
    arcs, used = jax.tree.map(lambda leaf: leaf.reshape(-1, batch.width)[: batch.rows], parts)

    def behind(number):
        """Number of arcs that have ended by the end of the stick phase of a round."""
        return jnp.take_along_axis(chains.ended, 2 * number[None], axis=0)[0]

    loop = RepeatedLoop(behind(repeat.first), behind(repeat.last), repeat.loops)
    fits = (total > 0) & (total <= batch.rows)
    fits = fits & (total + loop.loops * (loop.last - loop.first) <= batch.most)
    return arcs, used, loop, fits


def _arcs_from(first, size: int, book: Round, chains: _Chains, repeat: LoopSearch, batch: Batch):
    """The `size` arcs of each lane after its first `first` ones, and a mask of existing ones."""
    wanted, total = first + jnp.arange(1, size + 1, dtype=jnp.int32), chains.begun[-1]
    there = wanted[:, None] <= total[None]

    def place(counts):
        return jnp.where(there, _searched(counts, wanted[:, None], "left"), 0)

    begin, end = place(chains.begun), place(chains.ended)
    row, last_row, is_slip = begin // 2, end // 2, begin % 2 == 1
    after = jnp.minimum(last_row + 1, batch.rounds - 1)

    def at(column, row):
        return jnp.take_along_axis(column, row, axis=0)

    def either(slip, stick):
        return jnp.where(is_slip, slip, stick)

    fires, leaves = is_slip & at(chains.fires, last_row), ~is_slip & at(book.released, row)
    happens = fires | leaves
    codes = codes_in(either(at(book.mode_after, row), at(book.mode, row)), batch.belts)
    next_codes = codes_in(either(at(book.mode, after), at(book.mode_after, row)), batch.belts)
    kind, belt = event_between(tuple(codes), tuple(next_codes))
    begins = at(book.ts[0], row)
    # After the stick phase at whose end a loop repeats, the run goes on behind the last loop.
    repeats = (repeat.loops > 0)[None] & (row == repeat.last[None])
    released = jnp.where(repeats, repeat.t[None], begins)
    t, t_end = either(begins, at(book.t, row)), either(at(book.ts[-1], last_row), released)
    x1_start, x2_start = at(book.x1s[0], row), at(book.x2s[0], row)
    x2_end = either(at(book.x2s[-1], last_row), x2_start)
    arcs = dict(
        t=t,
        y=(either(x1_start, at(book.x1, row)), either(x2_start, at(book.x2, row))),
        mode=codes,
        duration=t_end - t,
        kind=jnp.where(happens, kind, 0),
        belt=jnp.where(happens, belt, 0),
        event_t=t_end,
        event_y=(
            either(at(book.x1s[-1], last_row), x1_start),
            jnp.where(fires, at(book.x2, after), x2_end),
        ),
        ended_by=jnp.where(fires, at(book.number, after), -1),
        in_time=(wanted[:, None] == total[None]) & ~happens,
        captured=fires & at(book.captured, after),
    )
    return arcs, there


def _searched(columns: Array, values: Array, side: str) -> Array:
    """`searchsorted` in each of the columns [.., lanes], for values [.., lanes or 1]."""
    find = functools.partial(jnp.searchsorted, side=side, method="scan")
    values = jnp.broadcast_to(values, (values.shape[0], columns.shape[1]))
    return jax.vmap(find, (1, 1), 1)(columns, values)


def _samples(osc, book: Round, inside: Array, ones, ts, batch: Batch) -> Array:
    """The states of the lanes at the times ts, each taken from the step that it lies in."""

    passed = _searched(jnp.where(inside, book.t, jnp.inf), ts, "right")
    row = jnp.maximum(passed - 1, 0)

    def at(column):
        return jnp.take_along_axis(column, row, axis=0)

    begins = [at(column) for column in (book.t, *book.ts[:-1])]
    # The place of each time in its round: 0 in the stick phase, else the number of the step.
    place = sum((begin <= ts).astype(jnp.int32) for begin in begins[1:])
    is_first = place == 0

    def in_place(columns):
        found = columns[0]
        for i, column in enumerate(columns[1:], 1):
            found = jnp.where(place == i, column, found)
        return found

    x1 = in_place([at(column) for column in (book.x1, *book.x1s[:-1])])
    x2 = in_place([at(column) for column in (book.x2, *book.x2s[:-1])])
    begin_t, ends = in_place(begins), in_place([at(column) for column in book.ts])
    since = jnp.clip(ts - begin_t, 0.0, ends - begin_t)
    mode = at(book.mode_after)

    @one_kernel
    def sample(osc, ones, x1, x2, since, mode, is_first):
        slip = Mode(tuple(jnp.where(is_first, 1.0, c) for c in codes_in(mode, batch.belts)))
        flown = flown_on(osc, ones, slip, x1, x2, since)
        # At place 0 a lane is stuck.
        carried = x1 + x2 * since, x2
        return tuple(jnp.where(is_first, a, b) for a, b in zip(carried, flown, strict=True))

    each = x1, x2, since, mode, is_first
    return lax.map(lambda row: jnp.stack(sample(osc, ones, *row)), each)
