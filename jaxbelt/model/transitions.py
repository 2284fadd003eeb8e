"""Transitions: how an orbit goes on where a guard of its mode vanishes, and from a start.

An orbit leaves a mode where one of its guards, positive inside, vanishes. `leave_slip` and
`leave_stick` decide what follows; both leave the question "stuck or not", whether the contacts that
are to be stuck can hold the force needed, to `modes.settle`.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics.compiling import where_any
from .modes import (
    ABOVE,
    BELOW,
    STUCK,
    ULPS,
    Mode,
    any_of,
    boundary_guards,
    bounds_rightward,
    capacity,
    edge_guards,
    edges,
    edges_ahead,
    first_of,
    force_rounding,
    foremost,
    has_edges,
    mode_acceleration,
    select,
    settle,
    stick_velocity,
    without_rounding,
)
from .oscillator import Oscillator
from .pseudofocus import FOCUS_RADIUS, is_captured

#: A guard this small, over 1 + |nu| or 1 + |x1|, is 0: orbits are put on a guard exactly, so this
#: is the rounding of a difference.
ON_GUARD = 1e-14


def directions(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> tuple[Array, Array]:
    """Signs of x2' and of x2 just after (x1, x2) in a slip mode.

    Where x2' = 0, as at slip onset, x2'' = -x2 decides; where x2 = 0, x2' does. Both are 0 at an
    equilibrium only.
    """
    a = mode_acceleration(osc, mode, x1, x2)
    tangent = (jnp.abs(a) < force_rounding(x1)) & (x2 != 0)
    a_sign = jnp.sign(jnp.where(tangent, -x2, a))
    return a_sign, jnp.where(x2 == 0, a_sign, jnp.sign(x2))


def guard_passed(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> Array:
    """The number of the guard through which an orbit leaves a slip mode at (x1, x2), or -1.

    The guard has to vanish there, and to fall: one that vanishes and rises bounds the mode that it
    has just entered. Numbered as in `leave_slip`; of several guards the first.
    """
    a_sign, v_sign = directions(osc, mode, x1, x2)
    guards = boundary_guards(osc, mode, x2)
    passed = [
        (guard <= ON_GUARD * (1 + jnp.abs(belt.velocity))) & (code * a_sign > 0)
        for belt, code, guard in zip(osc.belts, mode.codes, guards, strict=True)
    ]
    if has_edges(osc):
        guards, ahead = edge_guards(osc, mode, x1), edges_ahead(mode, v_sign)
        passed += [
            (guard <= ON_GUARD * (1 + jnp.abs(x1))) & is_ahead
            for guard, is_ahead in zip(guards, ahead, strict=True)
        ]
    numbers = [jnp.asarray(i) for i in range(len(passed))]
    return first_of(passed, numbers, jnp.asarray(-1))


def held_at_boundary(osc: Oscillator, mode: Mode, hit: Sequence[Array]) -> tuple[Mode, Array]:
    """The mode in which a mass at r_k = 0, of the belt k with hit[k] set, is held by all touching
    belts of the velocity nu_k, and x2 = nu_k/omega."""
    velocities = [belt.velocity for belt in osc.belts]
    velocity = first_of(hit, velocities, velocities[0])
    held = _held_by(osc, mode, velocity)
    return held, foremost(osc, held.stuck, velocities, velocity) / osc.omega


def _held_by(osc: Oscillator, mode: Mode, velocity: Array) -> Mode:
    """The mode in which all touching belts of a velocity hold the mass."""
    rows = zip(osc.belts, mode.codes, mode.touching, strict=True)
    return Mode(
        tuple(jnp.where(on & (belt.velocity == velocity), STUCK, code) for belt, code, on in rows)
    )


def pass_edge(osc: Oscillator, mode: Mode, edge: Array, x2: Array, rightward: Array) -> Mode:
    """The mode after the mass passed a contact edge at x1 = edge, rightward or leftward.

    Belts whose interval ends there leave, those whose interval begins there arrive with the sign
    of their relative velocity. If the mass was stuck it may stay so, be torn off, or, where the
    belt that it was stuck to is left, slip on.
    """
    speed = stick_velocity(osc, mode, osc.omega * x2)
    # Slip may have set in just before; an arriving belt of the same velocity may hold the mass.
    after = codes_past_edge(osc, mode, edge, speed, rightward)
    velocity = stick_velocity(osc, after, jnp.full_like(edge, jnp.nan))
    return settle(osc, _held_by(osc, after, velocity), edge, x2)


def codes_past_edge(
    osc: Oscillator, mode: Mode, edge: Array, speed: Array, rightward: Array
) -> Mode:
    """The contact codes beyond an edge that the mass passes at omega x2 = speed; an arriving belt
    with r = 0 is stuck, and whether it holds the mass is left to the caller."""
    codes = []
    for belt, code, touches in zip(osc.belts, mode.codes, mode.touching, strict=True):
        at_lower, at_upper = belt.lower == edge, belt.upper == edge
        arrives = jnp.where(rightward, at_lower & (code == BELOW), at_upper & (code == ABOVE))
        leaves = touches & jnp.where(rightward, at_upper, at_lower)
        code = jnp.where(arrives, _slip_sign(belt.velocity, speed), code)
        codes.append(jnp.where(leaves, jnp.where(rightward, ABOVE, BELOW), code))
    return Mode(tuple(codes))


def acting_edge(osc: Oscillator, mode: Mode, flags: Sequence[Array], default: Array) -> Array:
    """x1 of the `edges` whose flag is set, which are all at one place.

    Its derivatives are those of the edge of the belt that the mass is stuck to, if this edge is
    among them, for the mass slips on from there; else those of `foremost`.
    """
    own = [flag & stuck for flag, stuck in zip(flags, (*mode.stuck, *mode.stuck), strict=True)]
    leaves = any_of(own)
    flags = [jnp.where(leaves, one, flag) for one, flag in zip(own, flags, strict=True)]
    return foremost(osc, flags, edges(osc), default)


def edge_of_guard(osc: Oscillator, mode: Mode, guard: Array) -> Array:
    """x1 of the edge whose guard has this number, see `leave_slip`; 0 for other guards."""
    none = jnp.zeros(())
    if not has_edges(osc):
        return none
    numbers = [guard == len(osc.belts) + i for i in range(2 * len(osc.belts))]
    place = first_of(numbers, edges(osc), none)
    flags = [any_of(numbers) & (edge == place) for edge in edges(osc)]
    return acting_edge(osc, mode, flags, none)


def is_passed_rightward(mode: Mode, guard: Array) -> Array:
    """Whether the edge whose guard has this number is passed rightward; False for other guards."""
    first = len(mode.codes)
    flags = enumerate(bounds_rightward(mode), first)
    return any_of([(guard == number) & right for number, right in flags])


@eqx.filter_custom_jvp
def late_contacts(
    osc: Oscillator, mode: Mode, edge: Array, x2: Array, rightward: Array | bool
) -> Array:
    """0, but with derivatives: the change of x2 in slip when edges at the same place move apart, so
    that the mass passes the others a little sooner or later than this one.

    A belt whose contact changes x2' by a does so (its edge - edge) / x2 later; the changes of x2
    by several belts add up.
    """
    return jnp.zeros_like(x2)


@late_contacts.def_jvp
def _(primals, tangents):
    osc, mode, edge, x2, rightward = primals
    along, _, edge_along, *_ = tangents
    none = jnp.zeros_like(x2)
    if along is None or len(osc.belts) == 1:
        return none, none
    after = codes_past_edge(osc, mode, edge, osc.omega * x2, rightward)
    total = none
    for belt, moved, old, new in zip(osc.belts, along.belts, mode.signs, after.signs, strict=True):
        leaves, arrives = (old != 0) & (new == 0), (old == 0) & (new != 0)
        more = (new - old) * belt.load * belt.friction.mu(jnp.abs(belt.velocity - osc.omega * x2))
        lower, upper, here = (
            one if eqx.is_array(one) else none for one in (moved.lower, moved.upper, edge_along)
        )
        later = jnp.where(leaves == rightward, upper, lower) - here
        total = total - jnp.where(leaves | arrives, more * later, 0.0)
    slips = ~mode.any_stuck & ~after.any_stuck & (x2 != 0)
    return none, jnp.where(slips, total / jnp.where(slips, x2, 1.0), 0.0)


def _slip_sign(velocity: Array, speed: Array) -> Array:
    """Sign of velocity - speed; 0 where they are equal but for the rounding of nu/omega."""
    same = jnp.abs(velocity - speed) <= ULPS * jnp.abs(velocity)
    return jnp.where(same, STUCK, jnp.sign(velocity - speed))


class StickPhase(eqx.Module):
    """A stick phase in closed form, from its entry to its end (arrays of the batch shape).

    duration: inf where it never ends (a belt at rest); x1: where it ends; x2: velocity of the mass,
    that of the belt (a start that sticks has the same number, but not its derivatives); slips:
    whether it ends by slip onset; edge: flags, one for each of `edges`, of those that end it
    otherwise.
    """

    duration: Array
    x1: Array
    x2: Array
    slips: Array
    edge: list[Array]


def onset_position(osc: Oscillator, mode: Mode) -> Array:
    """x1 where a stick phase of the mode comes to slip onset, eqs. (10), (19), (20).

    The needed force is linear in x1, needed = rest - x1; it reaches the capacity there.
    """
    return stick_limit(osc, mode, jnp.sign(stick_velocity(osc, mode, jnp.zeros(()))))


def stick_limit(osc: Oscillator, mode: Mode, side: Array) -> Array:
    """x1 where the needed force is as large as the stuck belts of the mode can hold.

    side: 1 for the right end of the positions at which the mass sticks, -1 for the left end.
    """
    v = stick_velocity(osc, mode, jnp.zeros(())) / osc.omega
    return mode_acceleration(osc, mode, jnp.zeros(()), v) + side * capacity(osc, mode)


def stick_phase(osc: Oscillator, mode: Mode, x1: Array) -> StickPhase:
    """The rest of a stick phase of `mode` from x1 on, where x1 moves with x2 = nu_k/omega.

    It ends at slip onset or at the first contact edge ahead. If both are at one place up to
    rounding it ends at the edge, and `pass_edge` decides whether the mass sticks beyond.
    """
    v = stick_velocity(osc, mode, jnp.zeros(())) / osc.omega
    moves = v != 0
    v_or_one = jnp.where(moves, v, 1.0)
    x1_onset = onset_position(osc, mode)
    x1_end, slips = x1_onset, jnp.ones_like(moves)
    at_edge = [~slips] * (2 * len(osc.belts))
    if has_edges(osc):
        onset_distance = jnp.where(moves, jnp.sign(v) * (x1_onset - x1), jnp.inf)
        guards = zip(edges_ahead(mode, v), edge_guards(osc, mode, x1), strict=True)
        distances = [jnp.where(is_ahead, guard, jnp.inf) for is_ahead, guard in guards]
        to_edge = functools.reduce(jnp.minimum, distances)
        rounding = ON_GUARD * (1 + jnp.abs(x1_onset) + capacity(osc, mode))
        slips = (onset_distance + rounding < to_edge) | jnp.isinf(to_edge)
        at_edge = [~slips & (distance <= to_edge) for distance in distances]
        x1_end = jnp.where(slips, x1_onset, acting_edge(osc, mode, at_edge, x1))
    # Not distance/|v|: x1_end does not depend on x1, and so neither do its derivatives.
    duration = (x1_end - x1) / v_or_one
    # A negative duration is rounding; its derivatives are those of the quotient there, too.
    duration = duration + lax.stop_gradient(jnp.maximum(duration, 0.0) - duration)
    duration = jnp.where(moves, duration, jnp.inf)
    return StickPhase(duration, x1_end, v, slips, at_edge)


def leave_stick(osc: Oscillator, mode: Mode, phase: StickPhase) -> Mode:
    """The mode after a stick phase at its end: slip onset, or an edge passed while sticking.

    Slip onset is tangent to the boundary; the new sign is -sgn(needed) = sgn(nu_k).
    """
    slipping = Mode(
        tuple(
            jnp.where(stuck, jnp.sign(phase.x2), code)
            for code, stuck in zip(mode.codes, mode.stuck, strict=True)
        )
    )
    if not has_edges(osc):
        return slipping
    return select(phase.slips, slipping, pass_edge(osc, mode, phase.x1, phase.x2, phase.x2 > 0))


class Departure(eqx.Module):
    """How an orbit goes on after a guard of its slip mode vanished (arrays of the batch shape).

    mode, x1, x2: mode and state from there on, put exactly on a boundary (x2 = nu/omega) or an edge
    (x1 = edge); captured: whether by a pseudo-focus at the edge, see `is_captured`.
    """

    mode: Mode
    x1: Array
    x2: Array
    at_boundary: Array
    at_edge: Array
    captured: Array


class _Guard(NamedTuple):
    """Where a guard of a slip mode vanishes: on a boundary or at an edge, with (x1, x2) put on it.

    held: the mode in which belts hold the mass on the boundary; on_end: whether they let it go at
    once, at the edge `end`, see `_released_at_edge`; rightward: whether the edge is passed to the
    right.
    """

    at_boundary: Array
    at_edge: Array
    x1: Array
    x2: Array
    held: Mode
    x2_boundary: Array
    edge: Array
    rightward: Array
    on_end: Array
    end: Array


def _guard_of(osc: Oscillator, mode: Mode, guard: Array, x1: Array, x2: Array) -> _Guard:
    n = len(osc.belts)
    at_boundary, at_edge = (guard >= 0) & (guard < n), (guard >= n) & (guard < 3 * n)
    held, x2_boundary = held_at_boundary(osc, mode, [guard == i for i in range(n)])
    x2_after = jnp.where(at_boundary, x2_boundary, x2)
    if not has_edges(osc):
        edgeless = x1, at_edge, at_edge, x1
        return _Guard(at_boundary, at_edge, x1, x2_after, held, x2_boundary, *edgeless)
    edge, rightward = edge_of_guard(osc, mode, guard), is_passed_rightward(mode, guard)
    released, end = _released_at_edge(osc, held, x1, x2_boundary)
    on_end = at_boundary & released
    x1_after = jnp.where(at_edge, edge, jnp.where(on_end, end, x1))
    x2_after = x2_after + jnp.where(at_edge, late_contacts(osc, mode, edge, x2, rightward), 0.0)
    there = edge, rightward, on_end, end
    return _Guard(at_boundary, at_edge, x1_after, x2_after, held, x2_boundary, *there)


def on_guard(osc: Oscillator, mode: Mode, guard: Array, x1: Array, x2: Array):
    """(x1, x2) put exactly on the boundary or the edge of a guard, see `leave_slip`."""
    found = _guard_of(osc, mode, guard, x1, x2)
    return found.x1, found.x2


def leave_slip(osc: Oscillator, mode: Mode, guard: Array, x1: Array, x2: Array) -> Departure:
    """How an orbit goes on where the guard of this number of a slip mode vanishes at (x1, x2).

    The n `boundary_guards` come first, then the 2n `edge_guards`; any other number is no
    transition.
    """
    at = _guard_of(osc, mode, guard, x1, x2)
    # `where_any`: few lanes are at an event at a time, and fewer at one of a kind. Modes are
    # piecewise constant, so they have no derivatives.
    still, place, mode, v = lax.stop_gradient((osc, at, mode, x2))

    def from_boundary():
        return settle(still, place.held, lax.stop_gradient(x1), place.x2_boundary)

    after_boundary = where_any(at.at_boundary, from_boundary, mode)
    if not has_edges(osc):
        after = select(at.at_boundary, after_boundary, mode)
        return Departure(after, at.x1, at.x2, at.at_boundary, at.at_edge, at.at_edge)

    def past_edge():
        return pass_edge(still, mode, place.edge, v, place.rightward)

    def past_end():
        needed = mode_acceleration(still, place.held, place.end, place.x2_boundary)
        return pass_edge(still, place.held, place.end, place.x2_boundary, needed > 0)

    after_edge = where_any(at.at_edge, past_edge, mode)
    left, right = select(at.rightward, (mode, after_edge), (after_edge, mode))

    def capture():
        return is_captured(still, left, right, place.edge, v)

    slow = at.at_edge & (jnp.abs(x2) < FOCUS_RADIUS)
    beyond = where_any(at.on_end, past_end, after_boundary)
    after_boundary = select(at.on_end, beyond, after_boundary)
    return Departure(
        mode=select(at.at_boundary, after_boundary, select(at.at_edge, after_edge, mode)),
        x1=at.x1,
        x2=at.x2,
        at_boundary=at.at_boundary,
        at_edge=at.at_edge,
        captured=slow & where_any(slow, capture, jnp.zeros_like(slow)),
    )


def _released_at_edge(osc: Oscillator, held: Mode, x1: Array, x2: Array) -> tuple[Array, Array]:
    """Whether belts at rest, on which a mass comes to rest, are at their limit and at the edge to
    which the mass is pulled, both up to rounding; and that edge.

    Beyond the edge they hold nothing, so the segment that they hold has no length, and the mass
    goes on as from a start there.
    """
    needed = mode_acceleration(osc, held, x1, x2)
    limit = capacity(osc, held)
    rounding = ON_GUARD * (1 + jnp.abs(x1) + limit)
    at_limit = (x2 == 0) & (jnp.abs(jnp.abs(needed) - limit) <= rounding)
    ends = zip(edge_guards(osc, held, x1), edges_ahead(held, needed), strict=True)
    near = [is_ahead & (guard <= rounding) for guard, is_ahead in ends]
    return at_limit & any_of(near), foremost(osc, near, edges(osc), x1)


# --- starts ---------------------------------------------------------------------------------------


def mode_of_state(osc: Oscillator, x1: Array, x2: Array) -> Mode:
    """The mode in which an orbit goes on from the state (x1, x2), on a boundary or an edge too.

    On an edge the velocity decides which side; at rest there, the acceleration on the right-hand
    side does: the mass goes right if that is positive, else left. If the left-hand side pushes it
    back it stays: on the right if it can rest there, else at a pseudo-focus, see `at_focus`.
    """
    right, left = _sides(osc, x1, x2)
    a_right, a_left = (_pull_at_rest(osc, mode, x1) for mode in (right, left))
    goes_right = (a_right > 0) | (a_right == 0) & (a_left > 0)
    return select((x2 > 0) | (x2 == 0) & goes_right, right, left)


def at_focus(osc: Oscillator, x1: Array, x2: Array) -> Array:
    """Whether the state (x1, x2) is a pseudo-focus: at rest on an edge, pushed back by both sides,
    or by one of them where the other lets it rest.

    Stable or not, it is an equilibrium: an orbit that starts there stays there.
    """
    right, left = _sides(osc, x1, x2)
    a_right, a_left = (_pull_at_rest(osc, mode, x1) for mode in (right, left))
    slips = ~right.any_stuck & ~left.any_stuck
    return (x2 == 0) & slips & (a_left >= 0) & (a_right <= 0) & (a_left > a_right)


def begins_at_rest(osc: Oscillator, x1: Array, x2: Array) -> Array:
    """Whether a start (x1, x2) is a fixed point or a pseudo-focus, up to rounding."""
    mode = mode_of_state(osc, x1, x2)
    fixed = (x2 == 0) & ~mode.any_stuck & (_pull_at_rest(osc, mode, x1) == 0)
    return fixed | at_focus(osc, x1, x2)


def _sides(osc: Oscillator, x1: Array, x2: Array) -> tuple[Mode, Mode]:
    """The modes just right and just left of a state; away from edges they are the same."""
    sides = (contact(osc, x1, x2, rightward=side) for side in (True, False))
    right, left = (settle(osc, mode, x1, x2) for mode in sides)
    return right, left


def _pull_at_rest(osc: Oscillator, mode: Mode, x1: Array) -> Array:
    """x2' of a mass at rest at x1: 0 where a belt holds it, and where x2' is only rounding."""
    a = mode_acceleration(osc, mode, x1, jnp.zeros_like(x1))
    return jnp.where(mode.any_stuck, 0.0, without_rounding(a, x1))


def contact(osc: Oscillator, x1: Array, x2: Array, *, rightward: bool) -> Mode:
    """Which belts touch at a state, and the sign of each r_i; 0 on the boundary r_i = 0 itself.

    An edge that x1 lies on counts as passed to the right (rightward) or to the left.
    """
    signs = [_slip_sign(belt.velocity, osc.omega * x2) for belt in osc.belts]
    if not has_edges(osc):
        shape = jnp.broadcast_shapes(jnp.shape(x1), jnp.shape(x2))
        return Mode(tuple(jnp.broadcast_to(sign, shape) for sign in signs))
    codes = []
    for belt, sign in zip(osc.belts, signs, strict=True):
        is_below = x1 < belt.lower if rightward else x1 <= belt.lower
        is_above = x1 >= belt.upper if rightward else x1 > belt.upper
        codes.append(jnp.where(is_below, BELOW, jnp.where(is_above, ABOVE, sign)))
    return Mode(tuple(codes))


def contact_beside(osc: Oscillator, x1: Array, x2: Array, *, rightward: bool) -> Mode:
    """`contact` just beside x1, past all edges that are equal to x1 up to rounding."""
    away = jnp.where(jnp.isfinite(x1), force_rounding(x1), 0.0)
    return contact(osc, x1 + away if rightward else x1 - away, x2, rightward=rightward)
