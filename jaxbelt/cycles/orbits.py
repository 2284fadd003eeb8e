"""Orbits followed until a loop repeats, for the signature of a cycle and a guess of it.

An orbit is followed arc by arc, see `arcs`; every extremum ends an arc.
"""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.equilibria import repelling_foci
from ..model.modes import (
    STUCK,
    Mode,
    capacity,
    first_of,
    force_rounding,
    mode_acceleration,
    mode_of,
    select,
    velocity_of,
    zone,
    zone_ends,
)
from ..model.oscillator import Oscillator, has_possible_numbers
from ..model.rest import settles
from ..model.transitions import at_focus, begins_at_rest, contact, mode_of_state, onset_position
from ..motion.arcs import ArcEnd, Ends, Signs, SlipArc, after_slip, signs_after, slip_arc, stick_arc
from ..motion.integrators import STRIDE, Graded
from ..numerics.compiling import any_lane, lanes_in_one_kernel, one_kernel_alone
from ..results import Status
from .chains import Loop
from .settling import AT_REST, has_repeated

#: Largest number of arcs for which an orbit is followed: some 100 loops.
MOST_ARCS = 1024
#: The stride of `Graded` with which every arc is accurate to 1e-12; with STRIDE it is to some 1e-8.
FINE_STRIDE = 0.05
#: The speed |x2| down to which `follow_finely` follows a creeping orbit.
CREEPING_SPEED = 1e-6
#: Distance from its equilibrium within which `follow_finely` ends an orbit.
SEEN_AT_REST = 1e-2


class Orbit(eqx.Module):
    """The arcs of an orbit, in rows up to `count`: entry, duration, codes, and end event.

    tops: x1 where an arc ended in a maximum of x1, a top, else NaN. repeats: row of the top that
    the last arc's top repeats, else -1. y, code, signs: present state. top: `tops` of the last arc;
    top_before: x1 of the latest top, NaN where there was none. low: smallest x1 since the latest
    top; low_before: smallest x1 between that and the top before. sticks: whether the mass has stuck
    since the latest top. repellers: x1 of the pseudo-foci to which no loop shrinks.
    """

    entries: Array
    durations: Array
    codes: Array
    ends: Array
    tops: Array
    count: Array
    y: Array
    code: Array
    signs: Signs
    top: Array
    top_before: Array
    low: Array
    low_before: Array
    sticks: Array
    repellers: Array
    repeats: Array
    status: Array
    done: Array

    @property
    def exits(self) -> Array:
        """States at the ends of the arcs, [arcs, 2]."""
        last = jnp.arange(self.ends.size) == self.count - 1
        return jnp.where(last[:, None], self.y, jnp.roll(self.entries, -1, axis=0))


def _arc(osc: Oscillator, orbit: Orbit, stride: float | Array, reach: float | Array) -> ArcEnd:
    """The next arc of an orbit; it ends at the next extremum at the latest."""
    mode, y = mode_of(orbit.code), (orbit.y[0], orbit.y[1])

    def slip():
        bounds = jnp.asarray(stride), jnp.asarray(reach)
        arc = _graded_slip_arc(osc, mode, orbit.signs, y, *bounds)
        return after_slip(osc, mode, orbit.signs, arc)

    return lax.cond(mode.any_stuck, lambda: stick_arc(osc, mode, y, jnp.asarray(jnp.inf)), slip)


@lanes_in_one_kernel
def _graded_slip_arc(
    osc: Oscillator, mode: Mode, signs: Signs, y, stride: Array, reach: Array
) -> SlipArc:
    integrator = Graded(osc, mode, stride, reach)
    return slip_arc(osc, mode, signs, y, integrator, every_extremum=True)


def _next_arc(
    osc: Oscillator, orbit: Orbit, stride: float | Array, reach: float | Array
) -> tuple[dict[str, Array], Orbit]:
    """The next arc as a row, by column name, and the orbit after it, that row not yet written."""
    codes = orbit.code
    stuck = mode_of(codes).any_stuck
    end = _arc(osc, orbit, stride, reach)
    y_end = jnp.stack(end.y)
    code = jnp.stack([jnp.asarray(c, dtype=orbit.y.dtype) for c in end.mode.codes])

    # Any guard may end an arc in a top, that of extrema or that of a boundary (of a belt at rest).
    # On a creeping belt x2 is set back to the belt's velocity and may change sign without falling.
    is_top = ~stuck & (orbit.signs[1] > 0) & ~end.mode.any_stuck & (end.signs[1] < 0)
    is_top = is_top & (end.signs[0] < 0)
    top = jnp.where(is_top, y_end[0], jnp.nan)
    amplitude = top - orbit.low

    def repeated():
        same = has_repeated(orbit.tops - top, amplitude, top)
        same = same & jnp.all(orbit.codes == codes[None], axis=-1)
        return jnp.max(jnp.where(same, jnp.arange(orbit.tops.size), -1))

    # Two arcs that both end at one top are no loop.
    loops = amplitude > force_rounding(y_end[0])
    # Nothing repeats where the arc ends in no top, which is NaN.
    repeats = lax.cond(any_lane(is_top), repeated, lambda: jnp.asarray(-1))
    repeats = jnp.where(loops, repeats, -1)
    shrinks = amplitude < orbit.top_before - orbit.low_before
    # An orbit that sticks is on a cycle, however small: it repeats exactly. Around a pseudo-focus a
    # loop is as wide as its velocity squared.
    repelled = jnp.any((orbit.low <= orbit.repellers) & (orbit.repellers <= y_end[0]))
    resting = is_top & ~orbit.sticks & loops & shrinks & (amplitude < AT_REST) & ~repelled
    resting = (resting | settles(osc, end.mode, *end.y)) & ~end.forever

    status = jnp.where(end.forever, Status.STUCK_FOREVER.value, Status.OK.value)
    status = jnp.where(end.captured, Status.PSEUDO_FOCUS.value, status)
    status = jnp.where(end.failed, Status.NOT_SETTLED.value, status)
    status = jnp.where(resting, Status.EQUILIBRIUM.value, status)
    status = jnp.where(jnp.all(jnp.isfinite(y_end)), status, Status.NOT_FINITE.value)
    row = dict(entries=orbit.y, durations=end.duration, codes=codes, ends=end.ended_by, tops=top)
    return row, replace(
        orbit,
        count=orbit.count + 1,
        y=y_end,
        code=code,
        signs=end.signs,
        top=top,
        top_before=jnp.where(is_top, top, orbit.top_before),
        low=jnp.where(is_top, y_end[0], jnp.minimum(orbit.low, y_end[0])),
        low_before=jnp.where(is_top, orbit.low, orbit.low_before),
        sticks=~is_top & (orbit.sticks | stuck),
        repeats=repeats,
        status=status,
        done=(status != Status.OK) | (repeats >= 0),
    )


def _followed_while(
    going: Callable[[Orbit], Array],
    osc: Oscillator,
    start: Orbit,
    stride: float | Array = STRIDE,
    reach: float | Array = jnp.inf,
) -> Orbit:
    """Follows an orbit without arcs yet, arc by arc, while there is room and `going` holds.

    An arc also ends where |x1| or |x2| reaches `reach`.
    """

    def unfinished(orbit):
        return going(orbit) & (orbit.count < orbit.tops.size)

    def turn(state):
        number, orbit = state
        row, after = _next_arc(osc, orbit, stride, reach)
        # Only one row of the long columns is written, the same one in all lanes of a batch.
        own = unfinished(orbit)
        columns = {name: getattr(orbit, name) for name in row}
        written = {
            name: lax.dynamic_update_index_in_dim(
                column, jnp.where(own, row[name], column[number]), number, 0
            )
            for name, column in columns.items()
        }
        after = select(own, replace(after, **columns), orbit)
        return number + 1, replace(after, **written)

    def unfinished_lanes(state):
        return any_lane(unfinished(state[1]))

    return lax.while_loop(unfinished_lanes, turn, (jnp.zeros((), jnp.int32), start))[1]


@one_kernel_alone
def _follow_from(osc: Oscillator, start: Orbit, stride: Array) -> Orbit:
    return _followed_while(lambda orbit: ~orbit.done, osc, start, stride)


@one_kernel_alone
def _to_top_from(osc: Oscillator, start: Orbit) -> Orbit:
    def going(orbit):
        return ~orbit.done & jnp.isnan(orbit.top)

    return _followed_while(going, osc, start)


@one_kernel_alone
def _finely_from(osc: Oscillator, start: Orbit, reach: Array) -> Orbit:
    def going(orbit):
        near = jnp.max(jnp.abs(orbit.y)) < reach
        # The place of rest is known before the orbit is there.
        away = jnp.hypot(orbit.y[0] - place_of_rest(osc, orbit), orbit.y[1])
        on_the_way = (orbit.status == Status.EQUILIBRIUM) & (away > SEEN_AT_REST)
        # An arc that takes too many steps creeps to a node, on a boundary for example, and goes on.
        creeps = (orbit.status == Status.NOT_SETTLED) & (jnp.abs(orbit.y[1]) > CREEPING_SPEED)
        return (~orbit.done | on_the_way | creeps) & near

    return _followed_while(going, osc, start, FINE_STRIDE, reach)


def follow(osc: Oscillator, y0: Array, budget: int, stride: float | Array = STRIDE) -> Orbit:
    """The orbit from y0 until a loop repeats, it comes to rest, or the budget is used up."""
    osc, y0 = lax.stop_gradient((osc, y0))
    start = _beginning(osc, y0, budget, has_possible_numbers(osc))
    return _settled_or_not(_follow_from(osc, start, jnp.asarray(stride)))


def follow_from(osc: Oscillator, mode: Mode, y0: Array, status: Array, budget: int) -> Orbit:
    """The orbit that leaves y0 in a mode, as in `follow`; no arcs where the status is not OK."""
    osc, mode, y0 = lax.stop_gradient((osc, mode, y0))
    start = _standing(osc, mode, y0, status, budget)
    return _settled_or_not(_follow_from(osc, start, jnp.asarray(STRIDE)))


def follow_to_top(osc: Oscillator, y0: Array, budget: int) -> tuple[Orbit, Array]:
    """The orbit from y0 to its first top, or until it comes to rest; and x1 of the top, NaN where
    there is none.

    osc: with possible numbers (`has_possible_numbers`), or such an oscillator reversed in time.
    """
    osc, y0 = lax.stop_gradient((osc, y0))
    orbit = _to_top_from(osc, _beginning(osc, y0, budget, jnp.asarray(True)))
    return orbit, orbit.top


def follow_finely(osc: Oscillator, mode: Mode, y0: Array, budget: int, reach: Array) -> Orbit:
    """The orbit that leaves y0 in a mode, as in `follow`, with every arc accurate to 1e-12.

    It is followed nearly to its place of rest, as long as |x1| and |x2| are < reach.
    """
    osc, mode, y0 = lax.stop_gradient((osc, mode, y0))
    start = _standing(osc, mode, y0, jnp.asarray(Status.OK.value), budget)
    return _settled_or_not(_finely_from(osc, start, reach))


def place_of_rest(osc: Oscillator, orbit: Orbit) -> Array:
    """x1 where an orbit has come to rest, up to rounding; NaN where it has not."""
    last = jnp.arange(orbit.tops.size) == orbit.count - 1
    held = jnp.sum(jnp.where(last, orbit.entries[:, 0], 0.0))
    mode = mode_of(orbit.code)
    fixed = mode_acceleration(osc, mode, jnp.zeros(()), jnp.zeros(()))
    # The fixed point of the mode's field lies beyond an edge where the orbit circles a pseudo-focus
    # there.
    lower, upper = zone(osc, mode)
    fixed = jnp.where(fixed < lower, lower, jnp.where(fixed > upper, upper, fixed))
    ways = (Status.STUCK_FOREVER, Status.PSEUDO_FOCUS, Status.EQUILIBRIUM)
    places = (held, orbit.y[0], fixed)
    return first_of([orbit.status == way for way in ways], places, jnp.asarray(jnp.nan))


def _settled_or_not(orbit: Orbit) -> Orbit:
    status = jnp.where(orbit.done, orbit.status, Status.NOT_SETTLED.value)
    return eqx.tree_at(lambda orbit: orbit.status, orbit, status)


def _beginning(osc: Oscillator, y0: Array, budget: int, possible: Array) -> Orbit:
    """An orbit at y0 without arcs yet, with room for `budget` arcs."""
    rests = begins_at_rest(osc, y0[0], y0[1])
    focus = at_focus(osc, y0[0], y0[1])
    status = jnp.where(rests, Status.EQUILIBRIUM.value, Status.OK.value)
    status = jnp.where(focus, Status.PSEUDO_FOCUS.value, status)
    finite = jnp.all(jnp.isfinite(y0)) & possible
    status = jnp.where(finite, status, Status.NOT_FINITE.value)
    return _standing(osc, mode_of_state(osc, y0[0], y0[1]), y0, status, budget)


def _standing(osc: Oscillator, mode: Mode, y0: Array, status: Array, budget: int) -> Orbit:
    n = len(osc.belts)
    return Orbit(
        entries=jnp.zeros((budget, 2)),
        durations=jnp.zeros(budget),
        codes=jnp.ones((budget, n)),
        ends=jnp.full(budget, Ends(n).unused),
        tops=jnp.full(budget, jnp.nan),
        count=jnp.asarray(0),
        y=y0,
        code=jnp.stack([jnp.asarray(c, dtype=y0.dtype) for c in mode.codes]),
        signs=signs_after(osc, mode, (y0[0], y0[1])),
        top=jnp.full_like(y0[0], jnp.nan),
        top_before=jnp.full_like(y0[0], jnp.nan),
        low=y0[0],
        low_before=jnp.full_like(y0[0], jnp.inf),
        sticks=jnp.asarray(False),
        repellers=repelling_foci(osc),
        repeats=jnp.asarray(-1),
        status=status,
        done=status != Status.OK,
    )


def last_loop(orbit: Orbit) -> tuple[Array, Array]:
    """(first row, number of rows) of the loop that repeats, rows counted from the repeated top.

    It begins at the end of the longest stick phase; if there is none, at the top. Rows are to be
    taken modulo their number, see `loop_of`.
    """
    rows = jnp.arange(orbit.durations.size)
    size = orbit.count - 1 - orbit.repeats
    inside = (rows > orbit.repeats) & (rows < orbit.count)
    stuck = inside & jnp.any(orbit.codes == 0, axis=-1)
    longest = jnp.argmax(jnp.where(stuck, orbit.durations, -1.0))
    shift = jnp.where(jnp.any(stuck), longest - orbit.repeats, 0)
    return shift, size


def loop_of(orbit: Orbit, size: int, n: int) -> Loop:
    """The loop that repeats, padded to `size` arcs, of an oscillator with n belts."""
    shift, count = last_loop(orbit)
    rows = jnp.arange(size)
    used = rows < count
    source = orbit.repeats + 1 + jnp.where(used, shift + rows, shift) % jnp.maximum(count, 1)
    ends = jnp.where(used, orbit.ends[source], Ends(n).unused)
    durations = jnp.where(used, orbit.durations[source], 0.0)
    return Loop(orbit.codes[source], ends, orbit.entries[source], durations)


def first_loop(osc: Oscillator, x1: Array, distance: Array, size: int):
    """The orbit from (x1 + distance, 0) to its first maximum of x1, within `size` arcs.

    Returns the orbit as if that loop repeated, whether the loop meets a boundary, and x1 of the
    maximum (NaN: there is none).
    """
    orbit = follow(osc, jnp.stack([x1 + distance, jnp.zeros(())]), size)
    is_top = ~jnp.isnan(orbit.tops)
    row = jnp.where(jnp.any(is_top), jnp.argmax(is_top), size)
    meets = jnp.any((jnp.arange(size) <= row) & (orbit.ends < len(osc.belts)))
    top = jnp.where(row < size, orbit.tops[jnp.minimum(row, size - 1)], jnp.nan)
    closed = (jnp.asarray(-1), row + 1)
    return eqx.tree_at(lambda o: (o.repeats, o.count), orbit, closed), meets, top


def before_stick_ends(osc: Oscillator, belt: int | Array) -> Array:
    """States stuck to a belt at the ends of stick phases, one for each zone between contact edges,
    [zones, 2].

    They lie shortly before slip onset, or on the edge where the zone ends first. NaN where neither
    exists, or the belt does not touch.
    """
    v = velocity_of(osc, belt) / osc.omega
    lower, upper = zone_ends(osc)
    mode = contact(osc, lower, v, rightward=True)
    onset, held = onset_position(osc, mode), capacity(osc, mode)
    before, ahead = select(v > 0, (lower, upper), (upper, lower))
    slips = (lower < onset) & (onset < upper)
    # The mass sticks between x1 = onset - 2 sgn(v) held and x1 = onset.
    meets = jnp.isfinite(ahead) & ~slips & (jnp.abs(onset - held * jnp.sign(v) - ahead) <= held)
    near = jnp.minimum(0.01 * held, 0.5 * jnp.abs(onset - before))
    exists = (jnp.stack(mode.codes)[belt] == STUCK) & (lower < upper)
    x1 = jnp.where(slips, onset - near * jnp.sign(v), jnp.where(meets, ahead, jnp.nan))
    states = jnp.stack([x1, jnp.full_like(x1, v)], axis=1)
    return jnp.where(exists[:, None], states, jnp.nan)
