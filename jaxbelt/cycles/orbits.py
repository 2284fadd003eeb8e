"""Orbits followed until a loop repeats: how the signature of a cycle, and a guess of it, are found.

An orbit is followed with the steps of `shooting` and with the transition rules of `modes`.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.modes import (
    at_focus,
    begins_at_rest,
    boundary_guards,
    bounds_leftward,
    bounds_rightward,
    edge_guards,
    first_of,
    leave_slip,
    leave_stick,
    mode_acceleration,
    mode_of,
    mode_of_state,
    select,
    settles,
    stick_phase,
)
from ..model.oscillator import Oscillator
from ..numerics.compiling import one_kernel
from ..numerics.roots import first_root
from ..results import Status
from .shooting import _MEDIUM, Ends, Loop, _field, _step, density

#: Arcs that an orbit is followed for before it is given up.
BUDGET = 1024
#: A loop that repeats to this fraction of the amplitude has repeated; Newton does the rest.
REPEATED = 1e-7
#: Amplitudes below this one are an equilibrium, up to what can be told.
AT_REST = 1e-5


class Orbit(eqx.Module):
    """The arcs of an orbit, in rows up to `count`: entry, duration, codes, and what ended each.

    tops: x1 where an arc ended in a maximum of x1, else NaN. repeats: row of the top that the last
    one repeats, else -1. y, code: where it stands now. low, low_before: the smallest x1 since the
    last top, and between that and the one before.
    """

    entries: Array
    durations: Array
    codes: Array
    ends: Array
    tops: Array
    count: Array
    y: Array
    code: Array
    low: Array
    low_before: Array
    repeats: Array
    status: Array
    done: Array


def _after(osc: Oscillator, codes: Array, y: Array):
    """Sign of x2' and x2 just after y; where x2' = 0, x2'' = -x2 decides."""
    a = mode_acceleration(osc, mode_of(codes), y[0], y[1])
    still, moving = jnp.abs(a) < 1e-9 * (1 + jnp.abs(y[0])), jnp.abs(y[1]) >= 1e-9
    return jnp.sign(jnp.where(still, -y[1], a)), jnp.sign(jnp.where(moving, y[1], a))


def _slip_to_guard(osc: Oscillator, codes: Array, y: Array):
    """Follow a slip arc to the first of its guards: duration, end state, index of the guard."""
    mode = mode_of(codes)
    a_sign, v_sign = _after(osc, codes, y)
    field = functools.partial(_field, osc, codes)

    # Others are moved away from until the next loop.
    nears_edge = jnp.where(
        v_sign > 0, jnp.stack(bounds_rightward(mode)), jnp.stack(bounds_leftward(mode))
    )
    nears = jnp.concatenate([a_sign * codes > 0, nears_edge])

    def guards(y):
        a = mode_acceleration(osc, mode, y[0], y[1])
        values = jnp.stack([*boundary_guards(osc, mode, y[1]), *edge_guards(osc, mode, y[0])])
        loops = jnp.stack([a_sign * a, v_sign * y[1]])
        return jnp.append(jnp.where(nears, values, jnp.inf), loops)

    def inside(state):
        _, _, _, y_end, steps = state
        # A stuck lane has no slip arc to follow; it must not keep a batch waiting.
        going = (steps < 200) & ~mode.any_stuck & jnp.all(jnp.isfinite(y_end))
        return ((steps == 0) | jnp.all(guards(y_end) >= 0)) & going

    def advance(state):
        t, _, h, y, steps = state
        h_new = 0.2 / density(osc, codes, y)
        return t + h, y, h_new, _step(field, y, h_new, _MEDIUM), steps + 1

    zero = jnp.zeros(())
    t, y0, h, y1, steps = lax.while_loop(inside, advance, (zero, y, zero, y, jnp.asarray(0)))

    def guards_at(y):
        return jax.jvp(guards, (y,), (field(y),))

    values, slopes = guards_at(y1)
    h_root, fired = first_root(
        lambda h: guards_at(_step(field, y0, h, _MEDIUM)),
        guards_at(y0),
        h,
        (jnp.where(mode.any_stuck, jnp.inf, values), slopes),
        extrema=2,
    )
    # Newton's method adds the last digits, but at a tangency.
    values, slopes = guards_at(_step(field, y0, h_root, _MEDIUM))
    own = jnp.arange(values.size) == fired
    value, slope = (jnp.sum(jnp.where(own, part, 0.0)) for part in (values, slopes))
    regular = jnp.abs(slope) > 1e-6
    h_root = h_root - jnp.where(regular, value / jnp.where(regular, slope, 1.0), 0.0)
    return t + h_root, _step(field, y0, h_root, _MEDIUM), fired, steps >= 200


def _next_arc(osc: Oscillator, orbit: Orbit) -> Orbit:
    n = len(osc.belts)
    names = Ends(n)
    y, codes = orbit.y, orbit.code
    mode = mode_of(codes)
    stuck = mode.any_stuck

    phase = stick_phase(osc, mode, y[0])
    stick_end = jnp.stack([phase.x1, y[1]])
    forever = jnp.isinf(phase.duration)
    edge_indices = [jnp.asarray(n + i) for i in range(2 * n)]
    stick_fired = first_of(phase.edge, edge_indices, jnp.asarray(names.onset))

    t_slip, slip_end, fired, lost = _slip_to_guard(osc, codes, y)
    after = leave_slip(osc, mode, fired, slip_end[0], slip_end[1])
    slip_end = jnp.stack([after.x1, after.x2])

    y_end = jnp.where(stuck, stick_end, slip_end)
    end = jnp.where(stuck, stick_fired, fired)
    new = select(stuck, leave_stick(osc, mode, phase, y[1]), after.mode)
    code = jnp.stack([jnp.asarray(c, dtype=y.dtype) for c in new.codes])
    duration = jnp.where(stuck, phase.duration, t_slip)

    # Whatever ends the arc: at the boundary of a belt at rest it is not the guard of loops.
    falls = ~new.any_stuck & (_after(osc, code, y_end)[1] < 0)
    is_top = ~stuck & (_after(osc, codes, y)[1] > 0) & falls
    top = jnp.where(is_top, y_end[0], jnp.nan)
    amplitude = top - orbit.low
    rows = jnp.arange(orbit.tops.size)
    same = jnp.abs(orbit.tops - top) < REPEATED * amplitude
    same = same & jnp.all(orbit.codes == codes[None], axis=-1)
    repeats = jnp.max(jnp.where(same, rows, -1))
    before = jnp.max(jnp.where(jnp.isnan(orbit.tops), -1, rows))
    # An orbit that sticks is on a cycle, however small: it repeats exactly.
    stuck_since = jnp.any((rows > before) & jnp.any(orbit.codes == 0, axis=-1))
    shrinks = amplitude < orbit.tops[before] - orbit.low_before
    resting = is_top & shrinks & (amplitude < AT_REST) & ~stuck_since
    resting = resting | settles(osc, new, y_end[0], y_end[1])

    status = jnp.where(stuck & forever, Status.STUCK_FOREVER.value, Status.OK.value)
    status = jnp.where(~stuck & after.captured, Status.PSEUDO_FOCUS.value, status)
    status = jnp.where(resting, Status.EQUILIBRIUM.value, status)
    astray = ~stuck & lost & ~resting
    status = jnp.where(astray, Status.NOT_SETTLED.value, status)
    status = jnp.where(jnp.all(jnp.isfinite(y_end)), status, Status.NOT_FINITE.value)
    own = rows == orbit.count

    def put(column, value):  # column.at[i].set would be a scatter in batches
        return jnp.where(own.reshape(-1, *[1] * value.ndim), value, column)

    return Orbit(
        entries=put(orbit.entries, y),
        durations=put(orbit.durations, duration),
        codes=put(orbit.codes, codes),
        ends=put(orbit.ends, end),
        tops=put(orbit.tops, top),
        count=orbit.count + 1,
        y=y_end,
        code=code,
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
