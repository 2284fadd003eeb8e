"""Modes: which belts touch, slip or stick; and the one set of rules that leads between them.

A mode holds one contact code a belt:

    +1, -1   slipping, with that sign of the relative velocity r_i = nu_i - omega x2
     0       stuck: the mass moves with the belt
    -2, +2   not touching: the mass is below (above) the belt's contact interval

In a slip mode the friction keeps the sign of the mode, not sgn(r_i). So the field of a mode is
smooth across the mode's own boundaries, and events, derivatives and Newton iterations are right.
An orbit leaves a mode where one of its guards, positive inside, vanishes. What follows is decided
by `leave_slip` and `leave_stick`, and both leave the question "stuck or not" to `settle`: whether
the contacts that are to be stuck can hold the force needed.

Everything here is elementwise: codes and states may be scalars (the trajectories of `simulate`)
or arrays of lanes (the kernel of `sweeps.queue`), belts are unrolled.
"""

import functools
from collections.abc import Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import is_concrete
from .oscillator import Oscillator, acceleration

Tree = TypeVar("Tree")
STUCK, BELOW, ABOVE = 0.0, -2.0, 2.0
#: Numbers that differ by less than this fraction are equal: so much do nu and omega (nu/omega).
ULPS = 4e-16
#: Speed at the edge above which no orbit counts as captured by a stable pseudo-focus there.
FOCUS_RADIUS = 1e-2
#: Speed at the edge below which loops around it, as wide as its square, are rounding of x1.
FOCUS_ROUNDING = 1e-7


class Mode(eqx.Module):
    """Contact codes, one array a belt (float64, any common batch shape); see the module's text."""

    codes: tuple[Array, ...]

    @property
    def touching(self) -> tuple[Array, ...]:
        return tuple(jnp.abs(code) < 1.5 for code in self.codes)

    @property
    def stuck(self) -> tuple[Array, ...]:
        return tuple(code == STUCK for code in self.codes)

    @property
    def any_stuck(self) -> Array:
        return any_of(self.stuck)

    @property
    def signs(self) -> tuple[Array, ...]:
        """The signs for `acceleration`: 0 for the stuck and the absent."""
        return tuple(
            jnp.where(touches, code, 0.0)
            for code, touches in zip(self.codes, self.touching, strict=True)
        )


def any_of(flags: Sequence[Any]) -> Any:
    """Elementwise `or` of at least one array of booleans, of JAX or of NumPy."""
    out = flags[0]
    for flag in flags[1:]:
        out = out | flag
    return out


def first_of(flags: Sequence[Array], values: Sequence[Array], default: Array) -> Array:
    """Elementwise the value of the first flag that is set, or `default`."""
    out = default
    for flag, value in zip(reversed(flags), reversed(values), strict=True):
        out = jnp.where(flag, value, out)
    return out


def foremost(
    osc: Oscillator, flags: Sequence[Array], values: Sequence[Array], default: Array
) -> Array:
    """Elementwise the value of the belt with the largest load of those whose flag is set.

    The values of these are equal, for their belts act at one place; the derivatives are then those
    of a belt that exerts a force. flags, values: one a belt, or one a belt several times over.
    `default` where no flag is set.
    """
    out, load = default, jnp.asarray(-jnp.inf)
    belts = osc.belts * (len(flags) // len(osc.belts))
    for belt, flag, value in zip(belts, flags, values, strict=True):
        out, load = select(flag & (belt.load > load), (value, belt.load), (out, load))
    return out


def select(condition: Array, on_true: Tree, on_false: Tree) -> Tree:
    """Elementwise choice between two modes, or two tuples of arrays."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), on_true, on_false)


def mode_of(codes: Array) -> Mode:
    """The mode with these contact codes, [belts]."""
    return Mode(tuple(codes[i] for i in range(codes.shape[0])))


def mode_acceleration(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> Array:
    """x2' of a slip mode; of a mode with stuck belts, the force `needed` that they have to hold."""
    return acceleration(osc, mode.signs, x1, x2)


def fastest_rate(a_by_x2: Array) -> Array:
    """How fast disturbances change: the largest |eigenvalue| of ((0, 1), (-1, d x2'/d x2))."""
    half = 0.5 * jnp.abs(a_by_x2)
    return jnp.where(half > 1, half + jnp.sqrt(jnp.maximum(half * half - 1, 0.0)), 1.0)


def capacity(osc: Oscillator, mode: Mode) -> Array:
    """The largest force that the stuck belts can hold together, the sum of u0_k mus_k."""
    total = jnp.zeros(())
    for belt, stuck in zip(osc.belts, mode.stuck, strict=True):
        total = total + jnp.where(stuck, belt.load * belt.friction.static, 0.0)
    return total


def force_rounding(x1: Array, scale: Array | float = 1.0) -> Array:
    """A force, or x2', below this is 0 up to rounding, wherever that is asked.

    Forces at x1 are sums of terms of size `scale` and |x1|, each good to some 1e-16 of itself; but
    x1 and x2 may come from an integrated arc, whose end is found to about 1e-13.
    """
    return 1e-12 * (scale + jnp.abs(x1))


def without_rounding(a: Array, x1: Array) -> Array:
    """x2' at x1, and 0 where it is 0 up to rounding, as at slip onset; its derivatives stay."""
    return jnp.where(jnp.abs(a) < force_rounding(x1), a - lax.stop_gradient(a), a)


def settle(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> Mode:
    """Keep the stuck belts of `mode` stuck if they can hold the needed force, else let them slip.

    They slip with sign -sgn(needed): friction opposed the needed force until the limit. That one
    rule serves arrivals at a boundary (not held: the orbit crosses), contact edges met while
    sticking (not held: torn off) and starts on a boundary. Belts of equal velocity are stuck
    together, their capacities add and their signs flip together. What can hold nothing never
    sticks; where no force is needed either, r'' = omega^2 x2 gives the sign.
    """
    needed = mode_acceleration(osc, mode, x1, x2)
    held = capacity(osc, mode)
    rounding = force_rounding(x1, held)
    slips = (jnp.abs(needed) > held + rounding) | (held == 0)
    onward = jnp.where(x2 < 0, -1.0, 1.0)
    sign = jnp.where(jnp.abs(needed) <= rounding, onward, -jnp.sign(needed))
    codes = tuple(
        jnp.where(stuck & slips, sign, code)
        for code, stuck in zip(mode.codes, mode.stuck, strict=True)
    )
    return Mode(codes)


def stick_velocity(osc: Oscillator, mode: Mode, default: Array) -> Array:
    """Velocity nu_k of the belts that are stuck, or `default` where none is."""
    return foremost(osc, mode.stuck, [belt.velocity for belt in osc.belts], default)


# --- guards: positive inside a mode ---------------------------------------------------------------


def boundary_guards(osc: Oscillator, mode: Mode, x2: Array) -> list[Array]:
    """For every belt s_i r_i, positive while it slips with sign s_i; inf where it does not slip."""
    slipping = [touches & ~stuck for touches, stuck in zip(mode.touching, mode.stuck, strict=True)]
    return [
        jnp.where(slips, code * (belt.velocity - osc.omega * x2), jnp.inf)
        for belt, code, slips in zip(osc.belts, mode.codes, slipping, strict=True)
    ]


def edge_guards(osc: Oscillator, mode: Mode, x1: Array) -> list[Array]:
    """Distances to the edges that bound the mode: the lower ones of all belts, then the upper."""
    lower = [
        jnp.where(code == ABOVE, jnp.inf, jnp.where(code == BELOW, -1.0, 1.0) * (x1 - belt.lower))
        for belt, code in zip(osc.belts, mode.codes, strict=True)
    ]
    upper = [
        jnp.where(code == BELOW, jnp.inf, jnp.where(code == ABOVE, -1.0, 1.0) * (belt.upper - x1))
        for belt, code in zip(osc.belts, mode.codes, strict=True)
    ]
    return lower + upper


def bounds_rightward(mode: Mode) -> list[Array]:
    """For each of `edge_guards`, whether the edge bounds the mode on its right-hand side."""
    lower = [code == BELOW for code in mode.codes]
    return lower + list(mode.touching)


def bounds_leftward(mode: Mode) -> list[Array]:
    """For each of `edge_guards`, whether the edge bounds the mode on its left-hand side."""
    upper = [code == ABOVE for code in mode.codes]
    return list(mode.touching) + upper


def edges_ahead(mode: Mode, v: Array) -> list[Array]:
    """For each of `edge_guards`, whether a mass with the velocity v (or its sign) moves to it."""
    sides = zip(bounds_rightward(mode), bounds_leftward(mode), strict=True)
    return [(v > 0) & on_right | (v < 0) & on_left for on_right, on_left in sides]


def edges(osc: Oscillator) -> list[Array]:
    """Positions of the contact edges in the order of `edge_guards`."""
    return [belt.lower for belt in osc.belts] + [belt.upper for belt in osc.belts]


def has_edges(osc: Oscillator) -> bool:
    """Whether there may be a contact edge: one is finite, or not known to be infinite.

    Known inside a trace, too, where the bounds are constants: what edges need is then left out.
    """
    return not is_concrete(edges(osc)) or bool(np.any(np.isfinite(edges(osc))))


# --- transitions ----------------------------------------------------------------------------------

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

    The guard has to vanish there, and to fall: one that vanishes and rises bounds what the orbit
    has just entered. Numbered as in `leave_slip`; of several the first.
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
    """The mode in which a mass at r_k = 0 of the belt with hit[k] set is held by all belts that
    touch it and have that velocity, and x2 = nu_k/omega."""
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
    codes = []
    for belt, code, touches in zip(osc.belts, mode.codes, mode.touching, strict=True):
        at_lower, at_upper = belt.lower == edge, belt.upper == edge
        arrives = jnp.where(rightward, at_lower & (code == BELOW), at_upper & (code == ABOVE))
        leaves = touches & jnp.where(rightward, at_upper, at_lower)
        code = jnp.where(arrives, _slip_sign(belt.velocity, speed), code)
        codes.append(jnp.where(leaves, jnp.where(rightward, ABOVE, BELOW), code))
    # Slip may have set in just before; a belt of that very velocity that arrives asks anew.
    after = Mode(tuple(codes))
    velocity = stick_velocity(osc, after, jnp.full_like(edge, jnp.nan))
    return settle(osc, _held_by(osc, after, velocity), edge, x2)


def _slip_sign(velocity: Array, speed: Array) -> Array:
    """Sign of velocity - speed; 0 where they are equal but for the rounding of nu/omega."""
    same = jnp.abs(velocity - speed) <= ULPS * jnp.abs(velocity)
    return jnp.where(same, STUCK, jnp.sign(velocity - speed))


class StickPhase(eqx.Module):
    """A stick phase in closed form, from its entry to its end (arrays of the batch shape).

    duration: inf where it never ends (a belt at rest); x1: where it ends; x2: of the mass in all of
    it, which moves with the belt (a start that sticks has the same number, but not its
    derivatives); slips: it ends by slip onset; edge: which of `edges` ends it otherwise, one flag
    each.
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

    side: 1 the end on the right of where the mass sticks, -1 that on the left.
    """
    v = stick_velocity(osc, mode, jnp.zeros(())) / osc.omega
    return mode_acceleration(osc, mode, jnp.zeros(()), v) + side * capacity(osc, mode)


def stick_phase(osc: Oscillator, mode: Mode, x1: Array) -> StickPhase:
    """How the stick phase of `mode` that is at x1 goes on: x1 moves with x2 = nu_k/omega.

    It ends at slip onset or at the first contact edge ahead. Where both are at one place but for
    rounding it ends at the edge, and `pass_edge` tells whether the mass sticks beyond.
    """
    v = stick_velocity(osc, mode, jnp.zeros(())) / osc.omega
    moves = v != 0
    v_or_one = jnp.where(moves, v, 1.0)
    x1_onset = onset_position(osc, mode)
    onset_distance = jnp.where(moves, jnp.sign(v) * (x1_onset - x1), jnp.inf)

    edge_distances = [
        jnp.where(is_ahead, guard, jnp.inf)
        for is_ahead, guard in zip(edges_ahead(mode, v), edge_guards(osc, mode, x1), strict=True)
    ]
    to_edge = functools.reduce(jnp.minimum, edge_distances)
    rounding = ON_GUARD * (1 + jnp.abs(x1_onset) + capacity(osc, mode))
    slips = (onset_distance + rounding < to_edge) | jnp.isinf(to_edge)
    at_edge = [~slips & (distance <= to_edge) for distance in edge_distances]
    x1_end = jnp.where(slips, x1_onset, foremost(osc, at_edge, edges(osc), x1))
    # Not distance/|v|: x1_end does not depend on x1, and so neither do its derivatives.
    duration = (x1_end - x1) / v_or_one
    # Negative by rounding only; its derivatives are those of the quotient there, too.
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

    mode, x1, x2: from there on, x2 = nu/omega (x1 = edge) put exactly on a boundary (an edge);
    captured: by a pseudo-focus at the edge, see `is_captured`.
    """

    mode: Mode
    x1: Array
    x2: Array
    at_boundary: Array
    at_edge: Array
    captured: Array


def leave_slip(osc: Oscillator, mode: Mode, guard: Array, x1: Array, x2: Array) -> Departure:
    """What follows where the guard of that number of a slip mode vanishes at (x1, x2).

    The n `boundary_guards` come first, then the 2n `edge_guards`; any other number is no
    transition.
    """
    n = len(osc.belts)
    at_boundary, at_edge = (guard >= 0) & (guard < n), (guard >= n) & (guard < 3 * n)
    hit = [guard == i for i in range(n)]
    held, x2_boundary = held_at_boundary(osc, mode, hit)
    after_boundary = settle(osc, held, x1, x2_boundary)
    if not has_edges(osc):
        x2 = jnp.where(at_boundary, x2_boundary, x2)
        after_boundary = select(at_boundary, after_boundary, mode)
        return Departure(after_boundary, x1, x2, at_boundary, at_edge, at_edge)
    edge_hit = [guard == n + i for i in range(2 * n)]
    edge = first_of(edge_hit, edges(osc), x1)
    edge = foremost(osc, [other == edge for other in edges(osc)], edges(osc), edge)
    flags = zip(edge_hit, bounds_rightward(mode), strict=True)
    rightward = any_of([hit & right for hit, right in flags])
    after_edge = pass_edge(osc, mode, edge, x2, rightward)
    left, right = select(rightward, (mode, after_edge), (after_edge, mode))
    released, end = _released_at_edge(osc, held, x1, x2_boundary)
    needed = mode_acceleration(osc, held, end, x2_boundary)
    on_end = at_boundary & released
    beyond = pass_edge(osc, held, end, x2_boundary, needed > 0)
    after_boundary = select(on_end, beyond, after_boundary)
    return Departure(
        mode=select(at_boundary, after_boundary, select(at_edge, after_edge, mode)),
        x1=jnp.where(at_edge, edge, jnp.where(on_end, end, x1)),
        x2=jnp.where(at_boundary, x2_boundary, x2),
        at_boundary=at_boundary,
        at_edge=at_edge,
        captured=at_edge & is_captured(osc, left, right, edge, x2),
    )


def _released_at_edge(osc: Oscillator, held: Mode, x1: Array, x2: Array) -> tuple[Array, Array]:
    """Whether a mass that comes to rest on belts at rest does so up to rounding at their limit and
    at the edge towards which it is pulled: beyond the edge they hold nothing, so the segment that
    they hold has no length, and the mass goes on as from a start there. And that edge.
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
    side does: the mass goes right if that is positive, else left. Where the left-hand side pushes
    it back it stays: on the right if it can rest there, else at a pseudo-focus, see `at_focus`.
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
    """The modes just right and just left of a state; where it is on no edge they are the same."""
    sides = (contact(osc, x1, x2, rightward=side) for side in (True, False))
    right, left = (settle(osc, mode, x1, x2) for mode in sides)
    return right, left


def _pull_at_rest(osc: Oscillator, mode: Mode, x1: Array) -> Array:
    """x2' at rest, (x1, 0): 0 where a belt holds the mass, and where it is but rounding."""
    a = mode_acceleration(osc, mode, x1, jnp.zeros_like(x1))
    return jnp.where(mode.any_stuck, 0.0, without_rounding(a, x1))


def contact(osc: Oscillator, x1: Array, x2: Array, *, rightward: bool) -> Mode:
    """Which belts touch at a state, and the sign of each r_i; 0 on the boundary r_i = 0 itself.

    An edge that x1 lies on counts as passed to the right (rightward) or to the left.
    """
    codes = []
    for belt in osc.belts:
        is_below = x1 < belt.lower if rightward else x1 <= belt.lower
        is_above = x1 >= belt.upper if rightward else x1 > belt.upper
        sign = _slip_sign(belt.velocity, osc.omega * x2)
        codes.append(jnp.where(is_below, BELOW, jnp.where(is_above, ABOVE, sign)))
    return Mode(tuple(codes))


# --- the pseudo-focus at a contact edge -----------------------------------------------------------


class EdgeFocus(eqx.Module):
    """Motion around a point (edge, 0) with the field a_L on its left, a_R on its right.

    exists: a_L > 0 > a_R, so that the mass at rest there is pushed back from both sides. The
    velocity r = |x2| at the crossings obeys r' = rate r + coefficient r^3 + O(r^4); bend is a bound
    of the coefficient's size.
    """

    exists: Array
    rate: Array
    coefficient: Array
    bend: Array


def field_at_rest(osc: Oscillator, mode: Mode, x1: Array) -> tuple[Array, Array, Array, Array]:
    """Taylor coefficients of x2' of a slip mode in x2, from (x1, 0): of order 0 to 3."""
    rest = jnp.zeros_like(x1)

    def derivative(fn):
        return lambda x2: jax.jvp(fn, (x2,), (jnp.ones_like(x2),))[1]

    def a(x2):
        return mode_acceleration(osc, mode, x1, x2)

    first = derivative(a)
    second = derivative(first)
    return a(rest), first(rest), second(rest) / 2, derivative(second)(rest) / 6


def edge_focus(osc: Oscillator, left: Mode, right: Mode, edge: Array) -> EdgeFocus:
    """The pseudo-focus at x1 = edge between the slip modes to its left and right.

    Of the half-loop on one side, from (edge, v) to (edge, -w), with x2' = -a - (x1 - edge) +
    b x2 + c x2^2 + d x2^3 there: 1/w = 1/v - k - e v^2 + O(v^3), where k = 2 b / (3 a) and
    e = 2 d/(5 a) + 2 b c/(15 a^2) + 4 b^3/(135 a^3) - 2 b/(15 a^3), with -c for c on the left, by
    inserting the series into the orbit x1(x2). Both sides add up, and a loop takes
    (2/a_L + 2/|a_R|) |x2|: rate and coefficient are the sums of k and of e over that factor.
    """
    sides = [field_at_rest(osc, mode, edge) for mode in (left, right)]
    exists = (sides[0][0] > 0) & (sides[1][0] < 0)
    k, e, bend, slowness = (jnp.zeros(()),) * 4
    for (a, b, c, d), turn in zip(sides, (-1.0, 1.0), strict=True):
        a = jnp.where(exists, jnp.abs(a), 1.0)
        k, slowness = k + 2 * b / (3 * a), slowness + 2 / a
        even = turn * b * c / (7.5 * a**2)
        terms = (2 * d / (5 * a), even, 4 * (b / a) ** 3 / 135, -b / (7.5 * a**3))
        e, bend = e + sum(terms), bend + sum(map(jnp.abs, terms))
    return EdgeFocus(exists, k / slowness, e / slowness, bend / slowness)


def is_captured(osc: Oscillator, left: Mode, right: Mode, edge: Array, x2: Array) -> Array:
    """Whether an orbit that crosses the edge with velocity x2 is captured by a pseudo-focus there.

    The leading term of a loop must outweigh the next one by ten (see `EdgeFocus`), and no boundary
    may be near. With a belt at rest, or with a fixed point on the edge, the loops shrink to
    rounding.
    """
    focus = edge_focus(osc, left, right, edge)
    size = jnp.abs(x2)
    nearest = jnp.inf
    for belt, is_left, is_right in zip(osc.belts, left.touching, right.touching, strict=True):
        rubs = (is_left | is_right) & (belt.load != 0)
        nearest = jnp.minimum(nearest, jnp.where(rubs, jnp.abs(belt.velocity), jnp.inf))
    captured = (
        focus.exists
        & (focus.rate < 0)
        & (10 * size**2 * focus.bend < -focus.rate)
        & (size < FOCUS_RADIUS)
        & (2 * osc.omega * size < nearest)
    )
    a_left, trace_left, *_ = field_at_rest(osc, left, edge)
    a_right, trace_right, *_ = field_at_rest(osc, right, edge)
    rounding = force_rounding(edge)
    pushed = (a_left > -rounding) & (a_right < rounding) & (a_left - a_right > rounding)
    shrinks = trace_right * jnp.maximum(a_left, 0) - trace_left * jnp.minimum(a_right, 0) < 0
    captured = captured | pushed & (shrinks | (nearest == 0)) & (size < FOCUS_ROUNDING)
    return captured & ~left.any_stuck & ~right.any_stuck
