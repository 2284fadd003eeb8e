"""Oscillators with a clock: events at an instant, and the smooth motion between events.

A state is y = (x1, x2, t), t' = 1. At an instant the oscillator is the one that `at_time` gives,
and its forces, guards and contacts hold. Belts whose velocity or load oscillates add the following:

- Belts are mates, and hold the mass together, only if their velocities are the same at all times;
  where belts that are no mates have one velocity for an instant, the mass may stick to one of them.
- A stuck mass follows its belt; x1 is the integral of the belt's velocity.
- A stick phase ends where capacity - needed or capacity + needed vanishes, at an edge, or where the
  relative velocity of another touching belt passes zero, after which the mass sticks on, goes over
  to that belt, or slips.

`guards_at` has all of these guards, and those of slip modes, in one row: n boundaries, 2n edges,
and the two limits of a stick phase.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike

from ..numerics.compiling import where_any
from .forcing import ConstantForce, Oscillating
from .modes import (
    ABOVE,
    BELOW,
    STUCK,
    Mode,
    any_of,
    boundary_guards,
    capacity,
    edge_guards,
    edges,
    first_of,
    foremost,
    has_edges,
    mode_acceleration,
    select,
    stick_rate,
    stick_velocity,
)
from .oscillator import MovingBelt, Oscillator, at_time, fastest
from .pseudofocus import ForceRange, is_captured
from .transitions import codes_past_edge, edge_of_guard, is_passed_rightward, late_contacts

#: A state with a clock, (x1, x2, t).
TimedState = tuple[Array, Array, Array]
#: A guard below GUARD_ROUNDING times the size of its terms is zero up to rounding; velocities that
#: differ by less than the fraction EQUAL_VELOCITY are equal at an instant.
GUARD_ROUNDING, EQUAL_VELOCITY = 1e-14, 2e-15
#: Slopes and curvatures of a limit below these count as zero; then its value LATER on decides.
LEAST_SLOPE, LEAST_CURVATURE, LATER = 1e-12, 1e-10, 1e-3


def blur(t: Array) -> Array:
    """Factor by which the rounding of waves is larger at the time t than at 0."""
    return 1 + 0.1 * jnp.abs(t)


# --- the smooth motion of a mode ------------------------------------------------------------------


def field_at(osc: Oscillator, mode: Mode, y: TimedState) -> TimedState:
    """The field (x1', x2', t') of a mode; a stuck mass moves with its belt."""
    x1, x2, t = y
    now = at_time(osc, t)
    rate = stick_rate(now, mode) / osc.omega
    a = jnp.where(mode.any_stuck, rate, mode_acceleration(now, mode, x1, x2))
    return x2, a, jnp.ones_like(t)


def carried(osc: Oscillator, mode: Mode, y: TimedState, duration: Array) -> TimedState:
    """The state of a stuck mass after `duration`, in closed form."""
    x1, _, t = y
    now, later = at_time(osc, t), at_time(osc, t + duration)
    ways = [
        v.integral(t, duration) if isinstance(v, Oscillating) else v * duration
        for v in (belt.velocity for belt in osc.belts)
    ]
    way = foremost(now, mode.stuck, ways, jnp.zeros(()))
    velocity = stick_velocity(later, mode, jnp.zeros(()))
    return x1 + way / osc.omega, velocity / osc.omega, t + duration


def guards_at(osc: Oscillator, mode: Mode, y: TimedState) -> Array:
    """The guards of a mode, positive inside, inf where there is none: n boundaries (while the mass
    sticks, those of the other belts), 2n edges, capacity - needed and capacity + needed."""
    x1, x2, t = y
    now = at_time(osc, t)
    others = [*boundary_guards(now, mode, x2), *edge_guards(now, mode, x1)]
    return jnp.stack([*others, *_limits(now, mode, x1, x2)])


def _limits(now: Oscillator, mode: Mode, x1: Array, x2: Array) -> list[Array]:
    needed, limit = mode_acceleration(now, mode, x1, x2), capacity(now, mode)
    stuck = mode.any_stuck
    return [jnp.where(stuck, limit + way * needed, jnp.inf) for way in (-1.0, 1.0)]


class Trend(NamedTuple):
    """Values of guards, and their first two derivatives by the time along the motion."""

    value: Array
    slope: Array
    curvature: Array


def trend_of(
    osc: Oscillator, mode: Mode, guards: Callable[[TimedState], Array], y: TimedState
) -> Trend:
    """Guards at a state and how they change along the motion of the mode."""

    def rate(*y):
        return jax.jvp(lambda *y: guards(y), y, field_at(osc, mode, y))

    (value, slope), (_, curvature) = jax.jvp(rate, y, field_at(osc, mode, y))
    return Trend(value, slope, curvature)


def guards_trend(osc: Oscillator, mode: Mode, y: TimedState | Array) -> Trend:
    """`trend_of` the guards of a mode at a state, a tuple or an array [3]."""
    return trend_of(osc, mode, lambda y: guards_at(osc, mode, y), (y[0], y[1], y[2]))


def guard_sizes(osc: Oscillator, y: TimedState) -> Array:
    """Size of the terms of the guards, times `blur`: the scale of the guards' rounding."""
    x1, x2, t = y
    now = at_time(osc, t)
    forces = [belt.load * belt.friction.static for belt in now.belts]
    forces += [jnp.abs(belt.velocity) / osc.omega for belt in now.belts]
    forces += [jnp.abs(force.force(t)) for force in now.forcing]
    return blur(t) * (1 + jnp.abs(x1) + jnp.abs(x2) + functools.reduce(jnp.add, forces))


# --- which belts hold -----------------------------------------------------------------------------


def are_mates(osc: Oscillator, i: int, k: int) -> Array:
    """Whether two belts have the same velocity at all times."""
    if i == k:
        return jnp.asarray(True)
    one, other = (_wave_numbers(osc.belts[j].velocity) for j in (i, k))
    constant = (one[1] == 0) & (other[1] == 0)
    alike = functools.reduce(jnp.logical_and, [a == b for a, b in zip(one[1:], other[1:])])
    return (one[0] == other[0]) & (constant | alike)


def _wave_numbers(velocity) -> tuple[Array, ...]:
    if isinstance(velocity, Oscillating):
        return velocity.mean, velocity.amplitude, velocity.frequency, velocity.phase
    return (velocity, *[jnp.zeros(())] * 3)


def is_faster(osc: Oscillator, i: int, k: int, t: Array) -> Array:
    """1 where belt i is faster than belt k just after they had the same velocity, else -1."""
    one, other = osc.belts[i].velocity, osc.belts[k].velocity
    size = 1e-13 * (1 + sum(abs(x) for v in (one, other) for x in _wave_numbers(v)[:2]))
    sign = jnp.ones(())
    for order in (3, 2, 1):
        rates = [
            v.derivative(t, order) if isinstance(v, Oscillating) else jnp.zeros(())
            for v in (one, other)
        ]
        difference = rates[0] - rates[1]
        sign = jnp.where(jnp.abs(difference) > size, jnp.sign(difference), sign)
    return sign


def _holds(osc: Oscillator, mode: Mode, y: TimedState) -> Array:
    """Whether the belts that are stuck in a mode hold the mass from now on.

    At a limit itself the mass is held if capacity -+ needed grows from there.
    """
    osc, mode, y = lax.stop_gradient((osc, mode, y))

    def limits(y):
        return jnp.stack(_limits(at_time(osc, y[2]), mode, *y[:2]))

    value, limit = limits(y), capacity(at_time(osc, y[2]), mode)
    at_limit = jnp.abs(value) <= GUARD_ROUNDING * blur(y[2]) * (1 + jnp.abs(y[0]) + limit)

    def goes_in():
        _, slope, curvature = trend_of(osc, mode, limits, y)
        later = limits(carried(osc, mode, y, jnp.asarray(LATER)))
        bends = jnp.where(
            jnp.abs(curvature) > LEAST_CURVATURE, curvature > 0, later >= value - 1e-13
        )
        return jnp.where(jnp.abs(slope) > LEAST_SLOPE, slope > 0, bends)

    held = jnp.where(at_limit, where_any(at_limit, goes_in, at_limit), value > 0)
    return jnp.all(held) & (limit > 0)


def resolved(
    osc: Oscillator, mode: Mode, zero: Sequence[Array], first: Sequence[Array], y: TimedState
) -> tuple[Mode, Array]:
    """The mode in which the motion goes on from a state where some belts have r = 0, and its x2'.

    zero: masks, one per belt, of touching belts with r = 0; their codes in `mode` do not count.
    Each velocity among them is tried: the belts of that velocity have to hold the mass, and the
    others slip with their signs just afterwards. first: numbers of belts that are tried before the
    others, -1 for none. Where no belt holds, the mass slips with signs that fit its acceleration.
    """
    n, t = len(osc.belts), y[2]
    now = at_time(osc, t)
    x2 = y[1]
    mates = [[are_mates(osc, i, k) for k in range(n)] for i in range(n)]
    faster = [[is_faster(osc, i, k, t) for k in range(n)] for i in range(n)]

    def with_signs(codes: Sequence[Array]) -> Mode:
        rows = zip(zero, codes, mode.codes, strict=True)
        return Mode(tuple(jnp.where(is_zero, new, old) for is_zero, new, old in rows))

    sticks = [
        with_signs([jnp.where(mates[i][k], STUCK, faster[i][k]) for i in range(n)])
        for k in range(n)
    ]
    held = [zero[k] & _holds(osc, sticks[k], y) for k in range(n)]
    # The acceleration of each belt, over omega; then the candidates for the slip mode.
    rates = [
        belt.rate / osc.omega if isinstance(belt, MovingBelt) else jnp.zeros(())
        for belt in now.belts
    ]
    slips = [with_signs([jnp.ones(())] * n)]
    slips += [
        with_signs([jnp.where(mates[i][k] | (faster[i][k] < 0), -1.0, 1.0) for i in range(n)])
        for k in range(n)
    ]
    best, after, a_after = jnp.inf, slips[0], mode_acceleration(now, slips[0], y[0], x2)
    for number, slip in enumerate(slips):
        a = mode_acceleration(now, slip, y[0], x2)
        misses = [
            jnp.where(is_zero, jnp.maximum(code * (a - rate), 0.0), 0.0)
            for is_zero, code, rate in zip(zero, slip.codes, rates, strict=True)
        ]
        wrong = functools.reduce(jnp.maximum, misses)
        wrong = jnp.where(zero[number - 1], wrong, jnp.inf) if number else wrong
        better = wrong < best
        best = jnp.where(better, wrong, best)
        after, a_after = select(better, (slip, a), (after, a_after))
    for k in reversed(range(n)):
        after, a_after = select(held[k], (sticks[k], rates[k]), (after, a_after))
    for number in reversed(first):
        for k in range(n):
            chosen = held[k] & (number == k)
            after, a_after = select(chosen, (sticks[k], rates[k]), (after, a_after))
    return after, a_after


def at_zero(osc: Oscillator, mode: Mode, y: TimedState, k: Array) -> list[Array]:
    """Masks, one per belt, of touching belts with r = 0; k: number of one of them, or -1."""
    _, x2, t = y
    n = len(osc.belts)
    now = at_time(osc, t)
    velocity = first_of([k == i for i in range(n)], [b.velocity for b in now.belts], osc.omega * x2)
    found = []
    for i, (belt, touches) in enumerate(zip(now.belts, mode.touching, strict=True)):
        mate = any_of([(k == j) & are_mates(osc, i, j) for j in range(n)])
        amplitude = _wave_numbers(osc.belts[i].velocity)[1]
        size = jnp.abs(belt.velocity) + jnp.abs(velocity) + jnp.abs(amplitude)
        near = jnp.abs(belt.velocity - velocity) <= EQUAL_VELOCITY * blur(t) * size
        found.append(touches & (mate | near))
    return found


# --- starts ---------------------------------------------------------------------------------------


def begun_at(osc: Oscillator, y: TimedState) -> tuple[Mode, Array]:
    """The mode of a start, and whether the start is a pseudo-focus: at rest on an edge, with both
    sides pushing the mass to it at all times."""
    sides = [_start_on_side(osc, y, rightward) for rightward in (False, True)]
    (left, a_left), (right, a_right) = sides
    if not has_edges(osc):
        return right, jnp.asarray(False)
    same = functools.reduce(
        jnp.logical_and, [a == b for a, b in zip(left.codes, right.codes, strict=True)]
    )
    rests = y[1] == 0
    goes_right = (a_right > 0) | (a_right == 0) & right.any_stuck & (a_left >= 0)
    to_right = jnp.where(rests, goes_right, y[1] > 0)
    on_edge = any_of([y[0] == edge for edge in edges(osc)])
    focus = on_edge & rests & ~same & (a_left > 0) & (a_right < 0)
    focus = focus & _pushes_for_ever(osc, left, y, 1.0) & _pushes_for_ever(osc, right, y, -1.0)
    return select(to_right, right, left), focus


def _start_on_side(osc: Oscillator, y: TimedState, rightward: bool) -> tuple[Mode, Array]:
    x1, x2, t = y
    now = at_time(osc, t)
    codes = []
    for belt in now.belts:
        sign = jnp.where(belt.velocity > osc.omega * x2, 1.0, -1.0)
        if has_edges(osc):
            is_below = x1 < belt.lower if rightward else x1 <= belt.lower
            is_above = x1 >= belt.upper if rightward else x1 > belt.upper
            sign = jnp.where(is_below, BELOW, jnp.where(is_above, ABOVE, sign))
        codes.append(sign)
    mode = Mode(tuple(codes))
    zero = at_zero(osc, mode, y, jnp.asarray(-1))
    return resolved(osc, mode, zero, [], y)


# --- events ---------------------------------------------------------------------------------------


class Instant(NamedTuple):
    """How a motion goes on from an instant: state, mode, and whether a pseudo-focus captured it."""

    y: TimedState
    mode: Mode
    captured: Array


def on_guard_at(osc: Oscillator, mode: Mode, guard: Array, y: TimedState) -> TimedState:
    """The state put exactly on the boundary or edge whose guard vanishes there."""
    n = len(osc.belts)
    x1, x2, t = y
    now = at_time(osc, t)
    velocities = [belt.velocity for belt in now.belts]
    hit = [guard == i for i in range(n)]
    x2_slip = jnp.where(any_of(hit), first_of(hit, velocities, velocities[0]) / osc.omega, x2)
    x2 = stick_velocity(now, mode, osc.omega * x2_slip) / osc.omega
    if not has_edges(osc):
        return x1, jnp.where(mode.any_stuck, x2, x2_slip), t
    at_edge = (guard >= n) & (guard < 3 * n)
    x1 = jnp.where(at_edge, edge_of_guard(osc, mode, guard), x1)
    late = late_contacts(now, mode, x1, x2, is_passed_rightward(mode, guard))
    late = jnp.where(at_edge, late, 0.0)
    return x1, jnp.where(mode.any_stuck, x2, x2_slip + late), t


def passed_guard(osc: Oscillator, mode: Mode, guard: Array, y: TimedState) -> Instant:
    """How the motion goes on where the guard of this number in `guards_at` vanishes; -1: no guard.

    y: the state, which `on_guard_at` has put on the guard.
    """
    n = len(osc.belts)
    x2, t = y[1], y[2]
    stuck = mode.any_stuck
    held_by = first_of(mode.stuck, [jnp.asarray(i) for i in range(n)], jnp.asarray(-1))
    # At a boundary (of another belt, while the mass sticks) all belts with r = 0 are decided anew.
    at_boundary = (guard >= 0) & (guard < n)
    k = jnp.where(stuck, held_by, guard)
    zero = at_zero(osc, mode, y, k)
    mates = [any_of([(guard == j) & are_mates(osc, i, j) for j in range(n)]) for i in range(n)]
    rows = zip(zero, mates, mode.touching, strict=True)
    zero = [one | mate & touches for one, mate, touches in rows]
    met, _ = resolved(osc, mode, zero, [k, guard], y)
    after = select(at_boundary, met, mode)
    # At a limit of a stick phase slip begins; friction has opposed the needed force until then.
    upper, lower = guard == 3 * n, guard == 3 * n + 1
    sign = jnp.where(upper, -1.0, 1.0)
    slip = mode.slipping(sign)
    after = select(upper | lower, slip, after)
    captured = jnp.zeros_like(stuck)
    if has_edges(osc):
        at_edge = (guard >= n) & (guard < 3 * n)
        rightward = is_passed_rightward(mode, guard)
        beyond = codes_past_edge(at_time(osc, t), mode, y[0], osc.omega * x2, rightward)
        # Belts with r = 0 get a provisional sign; they are resolved below.
        beyond = beyond.slipping(1.0)
        beyond = Mode(
            tuple(
                jnp.where(was_stuck & is_there, STUCK, code)
                for was_stuck, is_there, code in zip(
                    mode.stuck, beyond.touching, beyond.codes, strict=True
                )
            )
        )
        zero = at_zero(osc, beyond, y, jnp.where(stuck, held_by, -1))
        arrived = any_of([one & ~touched for one, touched in zip(zero, mode.touching, strict=True)])
        asks = stuck | arrived
        zero = [one & asks for one in zero]
        past, _ = resolved(osc, beyond, zero, [held_by], y)
        after = select(at_edge, past, after)
        left, right = select(rightward, (mode, past), (past, mode))
        captured = at_edge & is_captured(
            at_time(osc, t), left, right, y[0], x2, _forces_around(osc, t)
        )
        captured = captured & _are_constant(osc, left) & _are_constant(osc, right)
    return Instant((y[0], jnp.where(captured, 0.0, x2), t), after, captured)


def is_held_for_ever(osc: Oscillator, mode: Mode, y: TimedState) -> Array:
    """Whether a mass stays stuck at all times: its belts are at rest, the other touching belts are
    constant, and the needed force with all forces at their largest is within the capacity.

    False where this is not known.
    """
    still, limit = mode.any_stuck, jnp.zeros(())
    for belt, touches, stuck in zip(osc.belts, mode.touching, mode.stuck, strict=True):
        v, load = belt.velocity, belt.load
        rests = (v == 0) if not isinstance(v, Oscillating) else (v.mean == 0) & (v.amplitude == 0)
        constant = not isinstance(v, Oscillating) and not isinstance(load, Oscillating)
        still = still & (~touches | jnp.where(stuck, rests, jnp.asarray(constant)))
        least = load.mean - jnp.abs(load.amplitude) if isinstance(load, Oscillating) else load
        limit = limit + jnp.where(stuck, least * belt.friction.static, 0.0)

    def holds():
        rest, bound = _pushes(osc, mode, y)
        return jnp.abs(rest) + bound <= limit * (1 + GUARD_ROUNDING)

    still = still & (limit > 0)
    return still & where_any(still, holds, still)


def _pushes_for_ever(osc: Oscillator, mode: Mode, y: TimedState, sign: ArrayLike) -> Array:
    """Whether the acceleration of a slip mode at the state y has this sign at all times.

    False where this is not known, as with belts that oscillate.
    """
    rest, bound = _pushes(osc, mode, y)
    return _are_constant(osc, mode) & (sign * rest > bound)


def _are_constant(osc: Oscillator, mode: Mode) -> Array:
    """Whether no belt that touches the mass changes its velocity or its load."""
    constant = jnp.asarray(True)
    for belt, touches in zip(osc.belts, mode.touching, strict=True):
        if isinstance(belt.velocity, Oscillating) or isinstance(belt.load, Oscillating):
            constant = constant & ~touches
    return constant


def _pushes(osc: Oscillator, mode: Mode, y: TimedState) -> tuple[Array, Array]:
    """Acceleration of a mode without the forces that have a clock, and a bound of their sum."""
    now, (force, bound) = at_time(osc, y[2]), _force_and_bound(osc, y[2])
    return mode_acceleration(now, mode, y[0], y[1]) - force, bound


def _force_and_bound(osc: Oscillator, t: Array) -> tuple[Array, Array]:
    """The sum of the forces that have a clock at the time t, and a bound of it at all times."""
    waves, zero = [one for one in osc.forcing if not isinstance(one, ConstantForce)], jnp.zeros(())
    forces = [one.on_mass(t, osc.damping) for one in waves]
    bounds = [one.bound(osc.damping) for one in waves]
    return functools.reduce(jnp.add, forces, zero), functools.reduce(jnp.add, bounds, zero)


def _forces_around(osc: Oscillator, t: Array) -> ForceRange:
    """Range of the change of the forces that have a clock from the time t to any other time."""
    force, bound = _force_and_bound(osc, t)
    return ForceRange(-bound - force, bound - force, fastest(osc))
