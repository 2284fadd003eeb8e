"""The pseudo-focus at a contact edge, and when it captures an orbit."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .modes import (
    ABOVE,
    BELOW,
    Mode,
    force_rounding,
    mode_acceleration,
)
from .oscillator import Oscillator

#: Speed at the edge above which no orbit counts as captured by a stable pseudo-focus there.
FOCUS_RADIUS = 1e-2
#: The same limit relative to the largest of |edge| and the speeds of touching belts: a heavy belt
#: makes the own unit of length larger than the motion.
FOCUS_SHARE = 4 * FOCUS_RADIUS
#: Speed at the edge below which loops around it, about speed^2 wide, are rounding of x1.
FOCUS_ROUNDING = 1e-7
#: A loop is short if it takes less than this times 1 / (highest frequency of the forces).
SHORT_LOOP = 0.1


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


def derivatives_at_rest(osc: Oscillator, mode: Mode, x1: Array) -> tuple[Array, ...]:
    """x2' of a slip mode at (x1, 0), and its first three derivatives by x2.

    At a fixed point the third one is 16 times the first Lyapunov coefficient.
    """

    def a(x2):
        return mode_acceleration(osc, mode, x1, x2)

    def with_slope(fn):
        return lambda x2: jax.jvp(fn, (x2,), (jnp.ones_like(x2),))

    all_orders = with_slope(with_slope(with_slope(a)))
    ((value, first), (_, second)), (_, (_, third)) = all_orders(jnp.zeros_like(x1))
    return value, first, second, third


def field_at_rest(osc: Oscillator, mode: Mode, x1: Array) -> tuple[Array, Array, Array, Array]:
    """Taylor coefficients of x2' of a slip mode in x2, from (x1, 0): of order 0 to 3."""
    value, first, second, third = derivatives_at_rest(osc, mode, x1)
    return value, first, second / 2, third / 6


def edge_focus(osc: Oscillator, left: Mode, right: Mode, edge: Array) -> EdgeFocus:
    """The pseudo-focus at x1 = edge between the slip modes to its left and right.

    Of the half-loop on one side, from (edge, v) to (edge, -w), with x2' = -a - (x1 - edge) +
    b x2 + c x2^2 + d x2^3 there: 1/w = 1/v - k - e v^2 + O(v^3), where k = 2 b / (3 a) and
    e = 2 d/(5 a) + 2 b c/(15 a^2) + 4 b^3/(135 a^3) - 2 b/(15 a^3), with -c for c on the left, by
    inserting the series into the orbit x1(x2). Both sides add up, and a loop takes
    (2/a_L + 2/|a_R|) |x2|: rate and coefficient are the sums of k and of e over that factor.
    """
    return _edge_focus(*(field_at_rest(osc, mode, edge) for mode in (left, right)))


def _edge_focus(*sides: tuple[Array, ...]) -> EdgeFocus:
    exists = (sides[0][0] > 0) & (sides[1][0] < 0)
    k, e, bend, slowness = (jnp.zeros(()),) * 4
    for (a, b, c, d), turn in zip(sides, (-1.0, 1.0), strict=True):
        a = jnp.where(exists, jnp.abs(a), 1.0)
        k, slowness = k + 2 * b / (3 * a), slowness + 2 / a
        even = turn * b * c / (7.5 * a**2)
        terms = (2 * d / (5 * a), even, 4 * (b / a) ** 3 / 135, -b / (7.5 * a**3))
        e, bend = e + sum(terms), bend + sum(map(jnp.abs, terms))
    return EdgeFocus(exists, k / slowness, e / slowness, bend / slowness)


class ForceRange(eqx.Module):
    """Forces that depend on the time, relative to the oscillator of an instant.

    least, most: bounds of what they add, at all times, to the acceleration at that instant;
    frequency: the highest one of the forces.
    """

    least: Array
    most: Array
    frequency: Array


def is_captured(
    osc: Oscillator,
    left: Mode,
    right: Mode,
    edge: Array,
    x2: Array,
    forces: ForceRange | None = None,
) -> Array:
    """Whether an orbit that crosses the edge with velocity x2 is captured by a pseudo-focus there.

    The leading term of a loop must outweigh the next one by ten (see `EdgeFocus`), and no boundary
    and no other edge may be near; edges that are equal up to rounding are passed together. Where a
    belt at rest touches, or a fixed point is on the edge, the loops must have shrunk to rounding.

    With forces all this must hold for the least and for the largest one. The sign of the rate is
    that of a function linear in the force, so it holds between them. Loops must be short beside a
    period of the forces; then v^3 (1/a_L + 1/|a_R|) changes by the rate alone, and while the force
    goes round, the velocity v may grow by the cube root of how much 1/a_L + 1/|a_R| varies.
    """
    left = _past_all(osc, left, edge, x2)
    right = _past_all(osc, right, edge, x2, rightward=True)
    sides = jax.tree.map(lambda *codes: jnp.stack(codes), left, right)
    fields = jax.vmap(lambda mode: field_at_rest(osc, mode, edge))(sides)
    on_left, on_right = (tuple(part[i] for part in fields) for i in range(2))
    nearest, largest = jnp.asarray(jnp.inf), jnp.abs(edge)
    for belt, is_left, is_right in zip(osc.belts, left.touching, right.touching, strict=True):
        rubs, speed = (is_left | is_right) & (belt.load != 0), jnp.abs(belt.velocity) / osc.omega
        nearest = jnp.minimum(nearest, jnp.where(rubs, speed, jnp.inf))
        largest = jnp.maximum(largest, jnp.where(rubs, speed, 0.0))
    size = jnp.abs(x2)
    slips = ~left.any_stuck & ~right.any_stuck
    if forces is None:
        return slips & _is_captured(osc, edge, (on_left, on_right), (size, nearest, largest))
    pushes, rounding = jnp.stack([forces.least, forces.most]), force_rounding(edge)
    pushed_back = (on_left[0] + pushes > rounding) & (on_right[0] + pushes < -rounding)
    # 1/a_L + 1/|a_R| is convex in the force, and least where both are equal.
    slowness = jnp.max(1 / (on_left[0] + pushes) - 1 / (on_right[0] + pushes), axis=0)
    varies = 0.25 * slowness * (on_left[0] - on_right[0])
    speeds = size * jnp.cbrt(varies), nearest, largest

    def of_push(push):
        sides = tuple((side[0] + push, *side[1:]) for side in (on_left, on_right))
        return _is_captured(osc, edge, sides, speeds)

    is_short = 2 * size * slowness * forces.frequency < SHORT_LOOP
    return slips & is_short & jnp.all(pushed_back & jax.vmap(of_push)(pushes), axis=0)


def _is_captured(
    osc: Oscillator,
    edge: Array,
    sides: tuple[tuple[Array, ...], ...],
    speeds: tuple[Array, Array, Array],
) -> Array:
    """`is_captured` from the Taylor coefficients of the fields on both sides; speeds: that of the
    mass, the least one of touching belts, and the largest of these and |edge|."""
    (on_left, on_right), (size, nearest, largest) = sides, speeds
    focus = _edge_focus(on_left, on_right)
    captured = (
        focus.exists
        & (focus.rate < 0)
        & (10 * size**2 * focus.bend < -focus.rate)
        & (size < FOCUS_RADIUS)
        & (size < FOCUS_SHARE * largest)
        & (2 * size < nearest)
        & _is_alone(osc, edge, size**2 / on_left[0], size**2 / -on_right[0])
    )
    (a_left, trace_left, *_), (a_right, trace_right, *_) = on_left, on_right
    rounding = force_rounding(edge)
    pushed = (a_left > -rounding) & (a_right < rounding) & (a_left - a_right > rounding)
    shrinks = trace_right * jnp.maximum(a_left, 0) - trace_left * jnp.minimum(a_right, 0) < 0
    return captured | pushed & (shrinks | (nearest == 0)) & (size < FOCUS_ROUNDING)


def _past_all(
    osc: Oscillator, mode: Mode, edge: Array, x2: Array, *, rightward: bool = False
) -> Mode:
    """The mode of a slow mass that is beside an edge, and beyond all edges that are equal to it up
    to rounding."""
    rounding, codes = force_rounding(edge), []
    for belt, code in zip(osc.belts, mode.codes, strict=True):
        at_lower, at_upper = (jnp.abs(x - edge) <= rounding for x in (belt.lower, belt.upper))
        outside, touches = (at_upper, at_lower) if rightward else (at_lower, at_upper)
        sign = jnp.sign(jnp.where(belt.velocity == 0, -x2, belt.velocity))
        code = jnp.where(touches & (jnp.abs(code) > 1), sign, code)
        codes.append(jnp.where(outside, ABOVE if rightward else BELOW, code))
    return Mode(tuple(codes))


def _is_alone(osc: Oscillator, edge: Array, to_left: Array, to_right: Array) -> Array:
    """Whether no other edge of a belt with a load is near: a focus that attracts orbits that pass
    one edge may repel those that pass both.

    to_left, to_right: size^2 over the push towards the edge; a loop reaches half as far.
    """
    alone = jnp.asarray(True)
    for belt in osc.belts:
        for other in (belt.lower, belt.upper):
            away, rounding = other - edge, force_rounding(edge)
            near = (-to_left < away) & (away < to_right) & (jnp.abs(away) > rounding)
            alone = alone & ~(near & (belt.load != 0))
    return alone
