"""One step: an embedded Runge-Kutta step of all lanes that slip, and where it ends.

A step is kept only if no guard vanishes in it. Within a step the velocity is known as a polynomial
of degree four (its values and slopes at both ends, and its integral, the displacement). If this
polynomial leaves the interval in which the mode holds, at the end or at an extremum on the way, the
step is made again, shorter, so that it ends near the first root; the time that is left to the root,
less than `LANDING * sqrt(tolerance)`, is bridged by one Taylor step. So the states at events are as
good as the integration, not as its interpolant, and excursions within one step are found. Where a
contact edge lies ahead (or the observer asks for extrema), steps also end where x2 = 0: then no
extremum of x1 within a step is beyond the edge.

The Runge-Kutta stages are written for x1' = x2 (Nystroem's form: the accelerations alone are kept),
and each acceleration is one quotient, with the division last. That is for XLA on the CPU, which
computes everything that it deems cheap again in each place where it is used; a division it keeps.

Derivatives are forward mode (see `derivatives.in_directions`): step sizes carry none; the Taylor
step to the guard, and the last step, t1 - t, give times and states their exact derivatives. Near
rest any step will do for the state, but not for its derivatives. So where these are computed, a
step also has to keep the tolerance for a motion of size one in the linearised field.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from operator import methodcaller
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from ..model.modes import (
    ULPS,
    bounds_leftward,
    bounds_rightward,
    fastest_rate,
    foremost,
    has_edges,
    select,
    share_of_tolerance,
)
from ..model.modes import edges as edge_positions
from ..model.oscillator import Oscillator, constant_force
from ..model.rest import is_at_rest
from ..numerics.compiling import the_solvers
from .lanes import Lanes, choose, materialise

#: First step of a run and after each event, at a tolerance of 1e-8: about what the tolerance allows
#: where the friction law bends.
INITIAL_STEP = 0.1
#: Longest step: a quarter of a loop, so that x2 has at most one extremum in it.
LONGEST_STEP = 1.5
#: Share of the step that the last error would have allowed.
STEP_SAFETY = 0.9
#: Bounds of error/tolerance. Smaller values may be rounding; larger ones, and NaN, shrink a step by
#: no more than a factor of 100000^(1/8), 4.2.
LEAST_ERROR, LARGEST_ERROR = 1e-5, 1e5
#: Longest time that a Taylor step to a guard bridges, over the square root of the tolerance: where
#: x2'' is of order one, the terms that it leaves out are far below the tolerance then.
LANDING = 0.1
#: Largest of the terms left out, x2'' delta^2, over the tolerance: heavy belts change x2' faster.
LANDS_WITHIN = 0.1
#: Speed over |x2'| below which an edge is passed slowly: over a way d, the terms that the Taylor
#: step leaves out grow like (|x2'| d / x2^2)^2.
SLOW = 0.1
#: A lane whose next step would be shorter than this stands on a bound of its mode.
NO_STEP = 1e-15
#: A time that no Taylor step bridges; it is finite so that derivatives are finite, too.
NEVER = 1e300


class _Tableau(NamedTuple):
    """Weights of the stages' accelerations for x'' = a: in x2 (`a`) and in x1 (`aa`), a row a
    stage, the last one the solution; the stages' times `c`; the weights of the error estimates of
    x2 and x1 (`e`, `ea`).

    linear: a bound of the error of a step of y' = k y, over (h k)^8 y, for h k up to 0.9: a quarter
    of its estimate, which is sixteen times the error at 0.7 and nine times at 0.9.
    """

    a: np.ndarray
    aa: np.ndarray
    c: np.ndarray
    e: np.ndarray
    ea: np.ndarray
    linear: float


@functools.cache
def nystroem() -> _Tableau:
    """The weights of the steps: Dormand's and Prince's method of order eight."""
    # Order eight takes twice the stages of order five and a third of the steps at 1e-8, and most of
    # a step's cost is not in its stages but in its interpolant, bounds and choices.
    tableau = the_solvers().Dopri8.tableau
    n, e = tableau.b_sol.size, tableau.b_error
    a = np.zeros((n, n))
    for i, row in enumerate(tableau.a_lower):
        a[i + 1, : row.size] = row
    linear = 0.25 * float(np.abs(e @ np.linalg.matrix_power(a, 7) @ np.ones(e.size)))
    return _Tableau(a, a @ a, a.sum(axis=1), e, e @ a, linear)


class _Window(eqx.Module):
    """Bounds of the modes, arrays [lanes].

    x1, x2: (lower, upper); x1 is None where there are no edges. stops_at: lanes whose steps end at
    (minima, maxima) of x1; None: no lanes. extrema: lanes whose extrema the observer asks for.
    signs, pulls: constants of the mode's field, one a belt. active: lanes that slip.
    """

    x1: tuple[Array, Array] | None
    x2: tuple[Array, Array]
    stops_at: tuple[Array, Array] | None
    extrema: Array | None
    signs: tuple[Array, ...]
    pulls: tuple[Array, ...]
    active: Array


def window_of(osc: Oscillator, lanes: Lanes, *, extrema: Array | None) -> _Window:
    """The bounds of the current modes."""
    mode, inf = lanes.mode, jnp.full_like(lanes.t, jnp.inf)

    def innermost(pick, flags, bounds, none):
        """The largest or smallest of the flagged bounds, as `pick` says, or `none`."""
        pairs = list(zip(flags, bounds, strict=True))
        found = functools.reduce(pick, [jnp.where(flag, bound, none) for flag, bound in pairs])
        return foremost(osc, [flag & (bound == found) for flag, bound in pairs], bounds, found)

    boundaries = [belt.velocity / osc.omega for belt in osc.belts]
    low = innermost(jnp.maximum, [code == -1 for code in mode.codes], boundaries, -inf)
    high = innermost(jnp.minimum, [code == 1 for code in mode.codes], boundaries, inf)
    x1, stops_at = None, None if extrema is None else (extrema, extrema)
    if has_edges(osc):
        left = innermost(jnp.maximum, bounds_leftward(mode), edge_positions(osc), -inf)
        right = innermost(jnp.minimum, bounds_rightward(mode), edge_positions(osc), inf)
        x1 = left, right
        # An extremum far from the edge, as measured by the motion, is not beyond it. Steps that
        # ended at every x2 = 0 would become as small as rounding where a lane comes to rest.
        reach = 4 * (jnp.abs(lanes.x2) + jnp.abs(lanes.a))
        stops_at = lanes.x1 - left <= reach, right - lanes.x1 <= reach
        if extrema is not None:
            stops_at = stops_at[0] | extrema, stops_at[1] | extrema
    signs = mode.signs
    pulls = tuple(belt.load * sign for belt, sign in zip(osc.belts, signs, strict=True))
    active = ~lanes.done & ~mode.any_stuck
    return _Window(x1, (low, high), stops_at, extrema, signs, pulls, active)


def _bounds_of_x2(window: _Window, ones: Array, lanes: Lanes) -> tuple[Array, Array]:
    """The bounds of x2 for the next step; 0 where the step is to end at an extremum of x1."""
    low, high = window.x2
    if window.stops_at is None:
        return low, high
    at_minimum, at_maximum = window.stops_at
    rises = (lanes.x2 > 0) | ((lanes.x2 == 0) & (lanes.a > 0))
    falls = (lanes.x2 < 0) | ((lanes.x2 == 0) & (lanes.a < 0))
    # The boundary of a belt at rest, already 0, is kept with its derivatives.
    low = jnp.where(at_maximum & rises & (low < 0), 0.0, low)
    high = jnp.where(at_minimum & falls & (high > 0), 0.0, high)
    return materialise(low, ones), materialise(high, ones)


def _quotient(osc: Oscillator, window: _Window, ones: Array, x1: Array, x2: Array) -> Array:
    """`oscillator.acceleration` as a single quotient; ones: see `lanes.materialise`."""
    return as_quotient(osc, window.signs, window.pulls, ones, x1, x2)


@jax.custom_jvp
def as_quotient(osc: Oscillator, signs, pulls, ones: Array, x1: Array, x2: Array) -> Array:
    """`oscillator.acceleration` as a single quotient; pulls: the signs times the loads."""
    numerator, denominator = -x1 - osc.damping * x2, ones
    for push in constant_force(osc):
        numerator = numerator + push
    for belt, sign, pull in zip(osc.belts, signs, pulls, strict=True):
        top, bottom = belt.friction.fraction(sign * (belt.velocity - osc.omega * x2))
        numerator = numerator * bottom + pull * top * denominator
        denominator = denominator * bottom
    return numerator / denominator


@functools.partial(as_quotient.defjvp, symbolic_zeros=True)
def _(primals, tangents):
    """The slope of each belt's force has a division, so it is computed once for all directions. One
    more division keeps their sum."""
    osc, signs, pulls, ones, _, x2 = primals
    d_osc, _, d_pulls, _, d_x1, d_x2 = tangents
    pushed = _value_and_change(
        osc.forcing, d_osc.forcing, lambda forces: [one.push for one in forces]
    )
    pushes = [(1.0, d_push) for d_push in pushed[1]] if pushed else []
    total = _sum_of_changes((-1.0, d_x1), (-osc.damping, d_x2), (-x2, d_osc.damping), *pushes)
    forces = zip(osc.belts, d_osc.belts, signs, pulls, d_pulls, strict=True)
    for belt, d_belt, sign, pull, d_pull in forces:
        law, speed = belt.friction, sign * (belt.velocity - osc.omega * x2)
        (top, bottom), (d_top, d_bottom) = jax.jvp(law.fraction, (speed,), (jnp.ones_like(speed),))
        square = bottom * bottom * ones
        slope = sign * pull * (d_top * bottom - top * d_bottom) / square
        relative = ((1.0, d_belt.velocity), (-osc.omega, d_x2), (-x2, d_osc.omega))
        total = total + slope * _sum_of_changes(*relative)
        total = total + _sum_of_changes((top * bottom / square, d_pull))
        if changed := _value_and_change(law, d_belt.friction, methodcaller("fraction", speed)):
            (top, bottom), (d_top, d_bottom) = changed
            total = total + pull * ((d_top * bottom - top * d_bottom) / square)
    return as_quotient(*primals), materialise(total, ones)


def _sum_of_changes(*pairs: tuple[Any, Any]) -> Any:
    """The sum of weight * change over the pairs whose change is not a symbolic zero."""
    known = [weight * change for weight, change in pairs if not isinstance(change, SymbolicZero)]
    return functools.reduce(jnp.add, known) if known else 0.0


def _value_and_change(
    tree: Any, change: Any, function: Callable[[Any], Any]
) -> tuple[Any, Any] | None:
    """function(tree) and its derivative along `change`; None if all changes are symbolic zeros."""
    leaves, structure = jax.tree.flatten(tree)
    changes = jax.tree.leaves(change)
    if all(isinstance(one, SymbolicZero) for one in changes):
        return None
    pairs = zip(leaves, changes, strict=True)
    full = [jnp.zeros_like(x) if isinstance(dx, SymbolicZero) else dx for x, dx in pairs]
    return jax.jvp(lambda leaves: function(structure.unflatten(leaves)), (leaves,), (full,))


def combine(weights: np.ndarray, arrays: Sequence[Array]) -> Array:
    """The weighted sum of the first arrays, without those of weight 0."""
    terms = [w * array for w, array in zip(weights.tolist(), arrays, strict=False) if w != 0]
    return functools.reduce(jnp.add, terms)


class _Attempt(eqx.Module):
    """A step of size h, not yet accepted: state and x2' at its end, its error over the tolerance,
    and the integrals that the observer asks for."""

    h: Array
    x1: Array
    x2: Array
    a: Array
    error: Array
    integrals: Any


def attempt(
    osc, window: _Window, ones: Array, lanes: Lanes, h, rtol, atol, rates, derivatives=False
) -> _Attempt:
    """One Runge-Kutta step of all lanes; rates, derivatives: see `take_step`."""
    x1, x2, stages = lanes.x1, lanes.x2, [lanes.a]
    slopes = [rates(osc, lanes.mode, lanes.t, x1, x2)] if rates else []
    own = nystroem()
    for row, row1, c in zip(own.a[1:-1], own.aa[1:-1], own.c[1:-1].tolist(), strict=True):
        drift = c * x2 + h * combine(row1, stages) if np.any(row1) else c * x2
        x2_stage = x2 + h * combine(row, stages)
        stages.append(_quotient(osc, window, ones, x1 + h * drift, x2_stage))
        if rates:
            slopes.append(rates(osc, lanes.mode, lanes.t + c * h, x1 + h * drift, x2_stage))
    # The weights of the solution are those of the last stage, which is the next step's first.
    y1 = materialise(x1 + h * (x2 + h * combine(own.aa[-1], stages)), ones)
    y2 = materialise(x2 + h * combine(own.a[-1], stages), ones)
    stages.append(_quotient(osc, window, ones, y1, y2))
    scale1 = atol + rtol * jnp.maximum(jnp.abs(x1), jnp.abs(y1))
    scale2 = atol + rtol * jnp.maximum(jnp.abs(x2), jnp.abs(y2))
    error1, error2 = jnp.abs(h * h * combine(own.ea, stages)), jnp.abs(h * combine(own.e, stages))
    scale2 = scale2 * share_of_tolerance(y2 - x2, lanes.a, stages[-1], rtol)
    error = jnp.maximum(error1 * scale2, error2 * scale1) / (scale1 * scale2)
    if derivatives:
        ends = (x1, x2), (y1, y2)
        fastest = functools.reduce(jnp.maximum, [_rate(osc, window, ones, *end) for end in ends])
        error = jnp.maximum(error, own.linear / rtol * ((h * fastest) ** 2) ** 4)
    integrals = jax.tree.map(lambda i, *s: i + h * combine(own.a[-1], s), lanes.integrals, *slopes)
    return _Attempt(h, y1, y2, stages[-1], lax.stop_gradient(error), integrals)


def _rate(osc: Oscillator, window: _Window, ones: Array, x1: Array, x2: Array) -> Array:
    """The `fastest_rate` at a state; it has no derivatives."""
    osc, window, x1, x2 = lax.stop_gradient((osc, window, x1, x2))
    along = (x2,), (jnp.ones_like(x2),)
    return fastest_rate(jax.jvp(lambda x2: _quotient(osc, window, ones, x1, x2), *along)[1])


class _Interpolant(eqx.Module):
    """x2 within a step, x2 + k1 theta + ... + k4 theta^4 for theta from 0 to 1, and its extremum.

    has_extremum: whether there is one inside, at theta = extremum; x2_extremum: x2 there, or at
    the end if there is none.
    """

    k: tuple[Array, Array, Array, Array]
    has_extremum: Array
    extremum: Array
    x2_extremum: Array


def _interpolate(ones: Array, lanes: Lanes, new: _Attempt) -> _Interpolant:
    """Hermite's cubic and the term that makes the integral of x2 the change of x1."""
    h, x2, m0, m1 = new.h, lanes.x2, new.h * lanes.a, new.h * new.a
    rise, mean = new.x2 - x2, 0.5 * (x2 + new.x2) + (m0 - m1) / 12
    k4 = 30 * (new.x1 - lanes.x1 - h * mean) / jnp.where(h > 0, h, 1.0)
    c2, c3 = 3 * rise - 2 * m0 - m1, m0 + m1 - 2 * rise
    k = (m0, c2 + k4, c3 - 2 * k4, k4)
    # Place of the cubic's extremum: its error enters the value of x2 there only as a square.
    has_extremum = lanes.a * new.a < 0
    divisor = jnp.sign(m0) * jnp.sqrt(jnp.maximum(c2 * c2 - 3 * c3 * m0, 0.0)) - c2
    safe = has_extremum & (divisor != 0)
    extremum = lax.stop_gradient(jnp.where(safe, m0, 1.0) / jnp.where(safe, divisor, 1.0))
    x2_extremum = x2 + extremum * (k[0] + extremum * (k[1] + extremum * (k[2] + extremum * k[3])))
    x2_extremum = materialise(jnp.where(has_extremum, x2_extremum, new.x2), ones)
    return _Interpolant(k, has_extremum, extremum, x2_extremum)


class _Landing(eqx.Module):
    """How a step meets the bounds of its mode.

    reached: it ends so near to a bound that a Taylor step over the time `delta` lands on it; x1,
    x2: the edge and the boundary ahead; on_edge: the bound is the edge. blocked: the step ends
    beyond a bound, or has its extremum there; theta: the fraction of it that ends on the bound.
    """

    reached: Array
    delta: Array
    x1: Array
    x2: Array
    on_edge: Array
    blocked: Array
    theta: Array


def _landing(
    window: _Window, ones, lanes: Lanes, new: _Attempt, path: _Interpolant, rtol, atol
) -> _Landing:
    low, high = _bounds_of_x2(window, ones, lanes)
    beyond_extremum = path.has_extremum & ((path.x2_extremum > high) | (path.x2_extremum < low))
    peak = jnp.where(beyond_extremum, path.x2_extremum, new.x2)
    reach = LANDING * jnp.sqrt(rtol)
    bound = jnp.where(new.a > 0, high, low)
    room = LANDS_WITHIN * (atol + rtol * jnp.abs(new.x2)) * new.h

    def is_straight(way, speed):
        """Whether x2'' over the step is small enough to be left out on that way."""
        return way * way * jnp.abs(new.a - lanes.a) <= room * speed * speed

    reached = ~beyond_extremum & (jnp.abs(bound - new.x2) <= reach * jnp.abs(new.a))
    reached = reached & is_straight(bound - new.x2, new.a)
    slope = jnp.where(reached, new.a, 1.0)
    delta = jnp.where(reached, bound - new.x2, NEVER) / slope
    # The next term counts where x2' is small, and there x2'' is -x2.
    delta = jnp.where(reached, delta + 0.5 * bound * delta**2 / slope, delta)
    # The 0.25 is for the bound x2 = 0: the rounding of x2' in a step is left there.
    rounding = ULPS * (0.25 + jnp.abs(peak))
    outside = (peak > high + rounding) | (peak < low - rounding)
    blocked = outside & ~reached
    target = jnp.where(peak > high, high, low)
    poly = lax.stop_gradient(path.k)
    start, end = lanes.x2, peak
    on_edge, edge = jnp.zeros_like(reached), lanes.x1
    if window.x1 is not None:
        reached = reached & ~_passes_edge(window.x1, new, delta)
        delta = jnp.where(reached, delta, NEVER)
        blocked = outside & ~reached
        edge, near, delta1 = _way_to_edge(window.x1, new, reach, is_straight)
        on_edge = near & (delta1 < delta)
        reached, delta = reached | near, jnp.minimum(delta, delta1)
        integral, beyond, side = _beyond_edge(window.x1, lanes, new, near, poly)
        use = beyond & ~blocked
        poly = lax.stop_gradient(select(use, integral, (*poly, jnp.zeros_like(peak))))
        start, end = jnp.where(use, lanes.x1, start), jnp.where(use, new.x1, end)
        target = jnp.where(use, side, target)
        blocked = blocked | beyond
    until = jnp.where(beyond_extremum, path.extremum, 1.0)
    theta = _root_in_step(poly, start - target, until, end - target)
    grazes = _grazes(window, (low, high), lanes, new, path, reach) & ~beyond_extremum
    return _Landing(
        reached=reached,
        delta=delta,
        x1=edge,
        x2=bound,
        on_edge=on_edge,
        blocked=blocked | grazes,
        theta=materialise(jnp.where(blocked, theta, path.extremum), ones),
    )


def _passes_edge(x1: tuple[Array, Array], new: _Attempt, delta) -> Array:
    """Whether the Taylor step onward to a boundary would pass an edge, and not by rounding only."""
    left, right = x1
    end = new.x1 + delta * (new.x2 + 0.5 * delta * new.a)
    rounding = ULPS * (1 + jnp.abs(end))
    passes_right = (new.x1 <= right) & (end > right + rounding)
    passes_left = (new.x1 >= left) & (end < left - rounding)
    return (delta > 0) & (passes_right | passes_left)


def _way_to_edge(
    x1: tuple[Array, Array], new: _Attempt, reach, is_straight: Callable[[Array, Array], Array]
) -> tuple[Array, Array, Array]:
    """The edge ahead, whether a Taylor step bridges the way to it, and the time that it takes."""
    left, right = x1
    edge = jnp.where(new.x2 > 0, right, left)
    # Slow passages are bridged over less of the way, for there x2' counts more than x2.
    way, speed = edge - new.x1, jnp.abs(new.x2)
    near = jnp.abs(way) * jnp.maximum(speed, SLOW * jnp.abs(new.a)) < reach * speed * speed
    near = near & is_straight(way, speed)
    there = jnp.abs(way) <= ULPS * jnp.abs(new.x1)
    slope = jnp.where(near, new.x2, 1.0)
    delta = jnp.where(near, way, jnp.where(there, 0.0, NEVER)) / slope
    delta = jnp.where(near, delta - 0.5 * new.a * delta**2 / slope, delta)
    return edge, near | there, delta


def _beyond_edge(x1: tuple[Array, Array], lanes: Lanes, new: _Attempt, near: Array, k):
    """x1 over the step as a polynomial, whether it ends beyond an edge, and that edge.

    x1 is the integral of x2. It has one extremum in the step at most, and none on the side of an
    edge that is near (see `window_of`): what passes an edge in the step ends beyond it.
    """
    left, right = x1
    h = new.h
    integral = (h * lanes.x2, h * k[0] / 2, h * k[1] / 3, h * k[2] / 4, h * k[3] / 5)
    beyond = ((new.x1 > right) | (new.x1 < left)) & ~near
    return integral, beyond, jnp.where(new.x1 > right, right, left)


def _grazes(
    window: _Window, x2: tuple[Array, Array], lanes: Lanes, new: _Attempt, path: _Interpolant, reach
) -> Array:
    """Whether x2 has an extremum in the step at which the step should be split.

    That is, one so close to a bound that the interpolant cannot tell on which side it is, one
    between two extrema of x1, or one that the observer wants. The terms that the interpolant leaves
    out are far smaller than its last ones, and near the ends of a step it is exact to the second
    order.
    """
    low, high = x2
    doubt = jnp.abs(path.k[3]) + 0.1 * jnp.abs(path.k[2])
    inside = jnp.minimum(path.extremum, 1 - path.extremum)
    grazes = (path.x2_extremum > high - doubt) | (path.x2_extremum < low + doubt)
    grazes = grazes & (inside * new.h > reach)
    if window.x1 is not None:
        back_and_forth = (path.x2_extremum * lanes.x2 < 0) & (path.x2_extremum * new.x2 < 0)
        grazes = grazes | back_and_forth
    if window.extrema is not None:
        further = (path.x2_extremum > lanes.upper) | (path.x2_extremum < lanes.lower)
        grazes = grazes | (window.extrema & further & (inside > 1e-3))
    return grazes & path.has_extremum


def take_step(
    osc,
    window: _Window,
    ones: Array,
    lanes: Lanes,
    t1,
    rtol,
    atol,
    rates: Callable | None = None,
    *,
    derivatives: bool = False,
) -> Lanes:
    """One step of the lanes that slip: kept, shortened to end on a bound, or rejected.

    rates(osc, mode, t, x1, x2), a tree of arrays [lanes], is integrated with the motion.
    derivatives: whether the derivatives of the result have to keep the tolerance, too.
    """
    remaining = t1 - lanes.t
    going = window.active & (lanes.h > 0) & (remaining > 0)
    h = jnp.where(going, jnp.minimum(lanes.h, remaining), 0.0)
    new = attempt(osc, window, ones, lanes, h, rtol, atol, rates, derivatives)
    path = _interpolate(ones, lanes, new)
    at = _landing(window, ones, lanes, new, path, rtol, atol)
    blocked, reached = at.blocked, at.reached
    if derivatives:
        # The bounds of a lane at rest are ignored: they do not affect how its neighbours move.
        rests = is_at_rest(lanes.x1, lanes.x2, lanes.a)
        blocked, reached = blocked & ~rests, reached & ~rests

    last = h >= remaining
    accepted = going & (new.error <= 1)
    lands = accepted & ~blocked & reached & ~(last & (at.delta > 0))
    # One number, materialised once, because many results depend on it.
    outcome = jnp.where(accepted, jnp.where(blocked, -1.0, 1.0), 0.0)
    outcome = materialise(jnp.where(lands, 2.0, outcome), ones)
    shortened, kept, lands = outcome < 0, outcome > 0, outcome > 1
    delta = materialise(jnp.where(lands, at.delta, 0.0), ones)

    bound = at.x2 if window.x1 is None else jnp.where(at.on_edge, at.x1, at.x2)
    x1, x2 = _bridged(lands, at.on_edge, delta, bound, new)
    a_end = _quotient(osc, window, ones, x1, x2)
    moves = lands & ~is_at_rest(x1, x2, a_end)
    delta, x1, x2 = _with_its_derivatives(moves, at.on_edge, delta, bound, new, (x1, x2, a_end))
    t = jnp.where(last & ~lands, t1, lanes.t + h + delta)
    pace, proposed = next_size(lanes, new, going, accepted)
    proposed, _ = shortened_or_landed(proposed, shortened, at.theta * h, lands)
    lower, upper = lanes.lower, lanes.upper
    if window.extrema is not None:
        extremum = jnp.where(path.has_extremum, path.x2_extremum, x2)
        lower = jnp.where(kept, jnp.minimum(lower, jnp.minimum(x2, extremum)), lower)
        upper = jnp.where(kept, jnp.maximum(upper, jnp.maximum(x2, extremum)), upper)
    return replace(
        lanes,
        t=jnp.where(kept, t, lanes.t),
        x1=jnp.where(kept, x1, lanes.x1),
        x2=jnp.where(kept, x2, lanes.x2),
        a=jnp.where(kept, new.a, lanes.a),
        h=lax.stop_gradient(jnp.where(going, proposed, lanes.h)),
        pace=lax.stop_gradient(jnp.where(accepted, pace, lanes.pace)),
        lower=lower,
        upper=upper,
        integrals=integrated(rates, osc, lanes, new, delta, x1, x2, kept) if rates else None,
    )


def _bridged(lands, on_edge, delta, bound, new: _Attempt) -> tuple[Array, Array]:
    """The state after the Taylor step to a bound, of lanes that land on one; else at its start."""
    x1 = new.x1 + delta * (new.x2 + 0.5 * delta * new.a)
    x2 = new.x2 + delta * new.a
    return jnp.where(lands & on_edge, bound, x1), jnp.where(lands & ~on_edge, bound, x2)


@jax.custom_jvp
def _with_its_derivatives(lands, on_edge, delta, bound, new: _Attempt, end):
    """The time delta of the Taylor step and (x1, x2) at its end, (x1, x2, x2'), as they are given.

    Their derivatives are those of the exact passage, to the second order in delta. Derivatives of
    the series that gives delta would lack the first order.
    """
    return delta, *end[:2]


@_with_its_derivatives.defjvp
def _(primals, tangents):
    lands, on_edge, delta, _, _, (x1, x2, a) = primals
    _, _, _, d_bound, d_new, _ = tangents
    moved1 = d_new.x1 + delta * (d_new.x2 + 0.5 * delta * d_new.a)
    moved2 = d_new.x2 + delta * d_new.a
    slope = jnp.where(on_edge, x2, a)
    way = d_bound - jnp.where(on_edge, moved1, moved2)
    late = jnp.where(lands, way / jnp.where(slope == 0, 1.0, slope), 0.0)
    d_x1 = jnp.where(lands & on_edge, d_bound, moved1 + late * x2)
    d_x2 = jnp.where(lands & ~on_edge, d_bound, moved2 + late * a)
    return (delta, x1, x2), (late, d_x1, d_x2)


def integrated(rates, osc, lanes: Lanes, new: Any, delta, x1, x2, kept) -> Any:
    """The integrals after a step and the Taylor step behind it."""
    t = lanes.t + new.h
    ends = [(t, new.x1, new.x2), (t + delta, x1, x2)]
    slopes = [rates(osc, lanes.mode, *end) for end in ends]
    totals = jax.tree.map(lambda i, *s: i + 0.5 * delta * sum(s), new.integrals, *slopes)
    return choose(kept, totals, lanes.integrals)


def next_size(lanes: Lanes, new: Any, going, accepted) -> tuple[Array, Array]:
    """The lanes' pace after a step, and the size of the next step by the error of this one."""
    # NaN is a large error, too; the error is of order eight in h.
    error = jnp.where(new.error < LARGEST_ERROR, jnp.maximum(new.error, LEAST_ERROR), LARGEST_ERROR)
    # The eighth root as roots of roots: XLA's power and its quotient by a root are no vector
    # operations.
    pace = jnp.sqrt(jnp.sqrt(jnp.sqrt(error))) / jnp.where(going, new.h, 1.0)
    # A step with next to no error, cut short at a bound perhaps, says only that more is allowed.
    pace = jnp.where(new.error <= LEAST_ERROR, jnp.minimum(pace, lanes.pace), pace)
    # Towards a boundary the law bends more and more: a step that had to shrink will have to again.
    trend = jnp.where(accepted, jnp.maximum(pace, lanes.pace) / lanes.pace, 1.0)
    return pace, jnp.minimum(STEP_SAFETY / (pace * trend), LONGEST_STEP)


def shortened_or_landed(proposed, shortened, shorter, lands) -> tuple[Array, Array]:
    """The size of the next step, `shorter` where one was shortened, negative in lanes that landed
    or stand on a bound at once; and the mask of those that stand on one at once."""
    stands = shortened & (shorter < NO_STEP)
    proposed = jnp.where(shortened, shorter, proposed)
    proposed = jnp.where(stands, NO_STEP, proposed)
    return jnp.where(lands | stands, -proposed, proposed), stands


def first_step(rtol):
    """First step of a run and after each event."""
    return INITIAL_STEP * (1e8 * rtol) ** 0.125


def _root_in_step(poly, g_start, end, g_end):
    """Root in (0, end] of g_start + poly[0] theta + poly[1] theta^2 ..., by Newton's method."""
    # A lane that moves away from the bound at first comes back to it late in the step. So does one
    # that has just left it: there g vanishes up to rounding, far below 1e-9 of its change, and that
    # root is not wanted.
    nears = (g_start * poly[0] < 0) & (jnp.abs(g_start) > 1e-9 * jnp.abs(g_end))
    ratio = jnp.abs(g_start) / (jnp.abs(g_start) + jnp.abs(g_end))
    straight = jnp.abs(g_start) / jnp.where(nears, jnp.abs(poly[0]), 1.0)
    theta = jnp.where(nears, jnp.minimum(straight, ratio * end), end)
    for _ in range(3):  # the step is then made again: the root need not be exact
        value, slope = poly[-1], jnp.zeros_like(theta)
        for k in (*reversed(poly[:-1]), g_start):
            value, slope = value * theta + k, slope * theta + value
        theta = theta - value / jnp.where(slope == 0, 1.0, slope)
    good = (theta > 0) & (theta <= end)
    return lax.stop_gradient(jnp.where(good, theta, 0.5 * end))
