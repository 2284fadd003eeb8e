"""Orbits followed until a loop repeats: how the signature of a cycle, and a guess of it, are found.

An orbit is followed arc by arc, see `arcs`, every extremum the end of one.
"""

import functools

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.modes import (
    at_focus,
    begins_at_rest,
    force_rounding,
    mode_of,
    mode_of_state,
    settles,
)
from ..model.oscillator import Oscillator
from ..motion.arcs import ArcEnd, Ends, Signs, after_slip, signs_after, slip_arc, stick_arc
from ..motion.integrators import Graded
from ..numerics.compiling import one_kernel
from ..results import Status
from .settling import AT_REST, has_repeated
from .shooting import Loop

#: Arcs that an orbit is followed for before it is given up: some 100 loops.
MOST_ARCS = 1024


class Orbit(eqx.Module):
    """The arcs of an orbit, in rows up to `count`: entry, duration, codes, and what ended each.

    tops: x1 where an arc ended in a maximum of x1, else NaN. repeats: row of the top that the last
    one repeats, else -1. y, code, signs: where it stands now. low, low_before: the smallest x1
    since the last top, and between that and the one before.
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
    low: Array
    low_before: Array
    repeats: Array
    status: Array
    done: Array


def _arc(osc: Oscillator, orbit: Orbit) -> ArcEnd:
    """The next arc of an orbit, to an extremum at most."""
    mode, y = mode_of(orbit.code), (orbit.y[0], orbit.y[1])

    def slip():
        arc = slip_arc(osc, mode, orbit.signs, y, Graded(osc, mode), every_extremum=True)
        return after_slip(osc, mode, orbit.signs, arc)

    return lax.cond(mode.any_stuck, lambda: stick_arc(osc, mode, y, jnp.asarray(jnp.inf)), slip)


def _next_arc(osc: Oscillator, orbit: Orbit) -> Orbit:
    codes = orbit.code
    stuck = mode_of(codes).any_stuck
    end = _arc(osc, orbit)
    y_end = jnp.stack(end.y)
    code = jnp.stack([jnp.asarray(c, dtype=orbit.y.dtype) for c in end.mode.codes])

    # Whatever ends the arc: at the boundary of a belt at rest it is not the guard of extrema.
    is_top = ~stuck & (orbit.signs[1] > 0) & ~end.mode.any_stuck & (end.signs[1] < 0)
    top = jnp.where(is_top, y_end[0], jnp.nan)
    amplitude = top - orbit.low
    rows = jnp.arange(orbit.tops.size)
    same = has_repeated(orbit.tops - top, amplitude)
    same = same & jnp.all(orbit.codes == codes[None], axis=-1)
    repeats = jnp.max(jnp.where(same, rows, -1))
    before = jnp.max(jnp.where(jnp.isnan(orbit.tops), -1, rows))
    # An orbit that sticks is on a cycle, however small: it repeats exactly.
    stuck_since = jnp.any((rows > before) & jnp.any(orbit.codes == 0, axis=-1))
    shrinks = amplitude < orbit.tops[before] - orbit.low_before
    # Two arcs that both end at one top are no loop.
    loops = amplitude > force_rounding(y_end[0])
    resting = is_top & loops & shrinks & (amplitude < AT_REST) & ~stuck_since
    resting = (resting | settles(osc, end.mode, *end.y)) & ~end.forever

    status = jnp.where(end.forever, Status.STUCK_FOREVER.value, Status.OK.value)
    status = jnp.where(end.captured, Status.PSEUDO_FOCUS.value, status)
    status = jnp.where(end.failed, Status.NOT_SETTLED.value, status)
    status = jnp.where(resting, Status.EQUILIBRIUM.value, status)
    status = jnp.where(jnp.all(jnp.isfinite(y_end)), status, Status.NOT_FINITE.value)
    own = rows == orbit.count

    def put(column, value):  # column.at[i].set would be a scatter in batches
        return jnp.where(own.reshape(-1, *[1] * value.ndim), value, column)

    return Orbit(
        entries=put(orbit.entries, orbit.y),
        durations=put(orbit.durations, end.duration),
        codes=put(orbit.codes, codes),
        ends=put(orbit.ends, end.fired),
        tops=put(orbit.tops, top),
        count=orbit.count + 1,
        y=y_end,
        code=code,
        signs=end.signs,
        low=jnp.where(is_top, y_end[0], jnp.minimum(orbit.low, y_end[0])),
        low_before=jnp.where(is_top, orbit.low, orbit.low_before),
        repeats=repeats,
        status=status,
        done=(status != Status.OK) | (repeats >= 0),
    )


@one_kernel
def _follow_from(osc: Oscillator, start: Orbit) -> Orbit:
    def going(orbit):
        return ~orbit.done & (orbit.count < orbit.tops.size)

    return lax.while_loop(going, functools.partial(_next_arc, osc), start)


def follow(osc: Oscillator, y0: Array, budget: int) -> Orbit:
    """The orbit from y0 until a loop repeats, it comes to rest, or the budget is used up."""
    osc, y0 = lax.stop_gradient((osc, y0))
    n = len(osc.belts)
    mode = mode_of_state(osc, y0[0], y0[1])
    rests = begins_at_rest(osc, y0[0], y0[1])
    focus = at_focus(osc, y0[0], y0[1])
    status = jnp.where(rests, Status.EQUILIBRIUM.value, Status.OK.value)
    status = jnp.where(focus, Status.PSEUDO_FOCUS.value, status)
    start = Orbit(
        entries=jnp.zeros((budget, 2)),
        durations=jnp.zeros(budget),
        codes=jnp.ones((budget, n)),
        ends=jnp.full(budget, Ends(n).unused),
        tops=jnp.full(budget, jnp.nan),
        count=jnp.asarray(0),
        y=y0,
        code=jnp.stack([jnp.asarray(c, dtype=y0.dtype) for c in mode.codes]),
        signs=signs_after(osc, mode, (y0[0], y0[1])),
        low=y0[0],
        low_before=jnp.full_like(y0[0], jnp.inf),
        repeats=jnp.asarray(-1),
        status=status,
        done=status != Status.OK,
    )
    orbit = _follow_from(osc, start)
    status = jnp.where(orbit.done, orbit.status, Status.NOT_SETTLED.value)
    return eqx.tree_at(lambda orbit: orbit.status, orbit, status)


def last_loop(orbit: Orbit) -> tuple[Array, Array]:
    """(first row, number of rows) of the loop that repeats; it begins at the end of a stick phase.

    That of the longest one, if there are several; if there is none, at the top. Rows are to be
    taken modulo the number, see `loop_of`.
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

    Returns it as if that loop repeated, whether it meets a boundary, and x1 there (NaN: none).
    """
    orbit = follow(osc, jnp.stack([x1 + distance, jnp.zeros(())]), size)
    is_top = ~jnp.isnan(orbit.tops)
    row = jnp.where(jnp.any(is_top), jnp.argmax(is_top), size)
    meets = jnp.any((jnp.arange(size) <= row) & (orbit.ends < len(osc.belts)))
    top = jnp.where(row < size, orbit.tops[jnp.minimum(row, size - 1)], jnp.nan)
    closed = (jnp.asarray(-1), row + 1)
    return eqx.tree_at(lambda o: (o.repeats, o.count), orbit, closed), meets, top
