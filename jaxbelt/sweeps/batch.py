"""The throughput kernel behind sweeps: many short runs at once, a lane each.

One embedded Runge-Kutta step advances all lanes; each has its own time, step size and mode. A pass
of the loop is

- *refill*: lanes whose run has ended hand in their result and take the next run from the queue;
- *events*: lanes that stand on a guard of their mode go on by the rules of `modes`, and stick
  phases are passed in closed form;
- *steps*: a few Runge-Kutta steps of the lanes that slip.

A step is kept only if no guard vanishes in it. Within a step the velocity is known as a polynomial
of degree four (its values and slopes at both ends, and its integral, the displacement). If that
leaves the interval in which the mode holds, at the end or at an extremum on the way, the step is
made again, shorter, so that it ends on the first root; what is then left of the way, less than
`LANDING * sqrt(tolerance)`, is bridged by one Taylor step. So the states at events are as good as
the integration, not as its interpolant, and excursions within one step are found. Where a contact
edge may be met (or extrema are wanted), steps also end where x2 = 0: x1 is then monotone on each.

The Runge-Kutta stages are written for x1' = x2 (Nystroem's form: the accelerations alone are kept),
and each acceleration is one quotient, with the division last. That is for XLA on the CPU, which
computes everything that it deems cheap again in each place where it is used; a division it keeps.

Derivatives are forward mode (`jax.jvp` through the loop): step sizes carry none, the landing's
Taylor step gives event times and states their exact ones, and so does the last step, t1 - t.
"""

import abc
import functools
import math
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..model.modes import (
    ABOVE,
    BELOW,
    SMALLEST_DISC,
    TANGENT,
    ULPS,
    Mode,
    at_focus,
    begins_at_rest,
    disc_margin,
    first_of,
    guard_passed,
    leave_slip,
    leave_stick,
    mode_acceleration,
    mode_of_state,
    select,
    stick_phase,
)
from ..model.oscillator import Oscillator
from ..numerics.compiling import one_kernel
from ..results import EventKind, Status

#: First step of a run and after each event, at a tolerance of 1e-8.
FIRST_STEP = 0.1
#: Longest step: a quarter of a loop, so that x2 has at most one extremum in it.
MAX_STEP = 1.5
#: Errors over the tolerance below this one are taken for it: they may be rounding.
LEAST = 1e-5
#: The way that a Taylor step may bridge to a guard, over the square root of the tolerance.
LANDING = 0.1
#: Speed over |x2'| below which a slow passage of an edge begins.
SLOW = 0.1
#: A lane whose step is to be shorter than this one stands on a bound of its mode; if it is also as
#: slow as AT_REST and leaves through no guard, it is at rest there.
NO_STEP, AT_REST = 1e-15, 1e-12
#: Steps between two looks at the events, and events between two refills.
STEPS, ROUNDS = 4, 4

#: Steps that a run may take for each 100 units of time before it is given up.
MAX_STEPS = 100_000
#: Runs that the kernel is given at once.
CHUNK = 2**14
#: Lanes. On the CPU few, which stay near the processor, but more than is lost at each refill.
WIDTH = {"cpu": 128}

#: Of order eight: twice the stages of order five for a third of the steps at 1e-8, and what a step
#: costs beside its stages (its path, bounds, choices) is the larger part.
_TABLEAU = diffrax.Dopri8.tableau


def _nystroem() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The tableau for x'' = a: weights of the stages' accelerations in x2 and in x1.

    A row a stage, the last one the solution, and the same of the error estimate.
    """
    n = _TABLEAU.b_sol.size
    a = np.zeros((n, n))
    for i, row in enumerate(_TABLEAU.a_lower):
        a[i + 1, : row.size] = row
    return a, a @ a, a.sum(axis=1), _TABLEAU.b_error, _TABLEAU.b_error @ a


_A, _AA, _C, _E, _EA = _nystroem()


# --- what is watched ------------------------------------------------------------------------------


class Lanes(eqx.Module):
    """The state of all lanes, arrays [lanes].

    run: number of the run, -1 for none; begun: the pass in which it began; t, x1, x2, a: time,
    state and x2'; h: next step size; negative where the lane has landed on a bound of its mode and
    waits for what follows; pace: the inverse of the step that would have met the tolerance; mode;
    events: their number; status; done. lower, upper: extrema of x2 since `memory` was cleared,
    where the observer tracks them. memory: the observer's own.
    """

    run: Array
    begun: Array
    t: Array
    x1: Array
    x2: Array
    a: Array
    h: Array
    pace: Array
    mode: Mode
    events: Array
    status: Array
    done: Array
    lower: Array
    upper: Array
    memory: Any


class Passage(eqx.Module):
    """What happened to the lanes in one look at the events, arrays [lanes].

    landed: a step ended on a guard or where x2 = 0. fired: it was a guard, its number is `guard`,
    and `mode` is what followed, at (t, x1, x2). captured: by a pseudo-focus. rests: it is at rest
    but for rounding. stuck: there was a stick phase, of that duration; released: it ended, by slip
    onset or at an edge.
    """

    landed: Array
    fired: Array
    guard: Array
    before: Mode
    mode: Mode
    t: Array
    x1: Array
    x2: Array
    captured: Array
    rests: Array
    stuck: Array
    duration: Array
    released: Array
    slips: Array
    forever: Array


def choose(condition: Array, on_true: Any, on_false: Any) -> Any:
    """Lane by lane one of two trees of arrays [lanes, ...]."""

    def pick(a, b):
        return jnp.where(condition.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return jax.tree.map(pick, on_true, on_false)


class Observer(eqx.Module):
    """What a run hands in, and when it may end early: subclasses are static settings."""

    def extrema(self, lanes: Lanes) -> Array | None:
        """Where the extrema of a run are wanted, for then steps end at them; None: nowhere."""
        return None

    @abc.abstractmethod
    def start(self, osc: Oscillator, lanes: Lanes) -> Any:
        """The memory of runs that begin, a tree of arrays [lanes]."""

    @abc.abstractmethod
    def watch(
        self, osc: Oscillator, lanes: Lanes, passage: Passage, one: Array, t1: Array, tol: Array
    ) -> Lanes:
        """The lanes after a look at the events; sets `memory`, and `done` to end a run.

        one: an array of ones. What is divided by it is computed once, see the module's text."""

    def rest(self, osc: Oscillator, lanes: Lanes, one: Array) -> Lanes:
        """The same at each refill, for what costs more."""
        return lanes

    @abc.abstractmethod
    def finish(self, osc: Oscillator, lanes: Lanes) -> dict[str, Any]:
        """The results of runs that ended, arrays [lanes, ...] or tuples of arrays [lanes]."""


# --- one step -------------------------------------------------------------------------------------


class _Window(eqx.Module):
    """Where the mode of a lane holds: bounds of x1 and x2; extrema: where they are wanted; active:
    it slips; and for its field."""

    x1: tuple[Array, Array] | None
    x2: tuple[Array, Array]
    extrema: Array | None
    signs: tuple[Array, ...]
    pulls: tuple[Array, ...]
    active: Array


def _window(osc: Oscillator, lanes: Lanes, *, edges: bool, extrema: Array | None) -> _Window:
    """The bounds of the current modes. Where x1 has to be monotone x2 is bounded by 0, too."""
    mode, inf = lanes.mode, jnp.full_like(lanes.t, jnp.inf)
    low, high = -inf, inf
    for belt, code in zip(osc.belts, mode.codes, strict=True):
        boundary = belt.velocity / osc.omega
        high = jnp.where(code == 1, jnp.minimum(high, boundary), high)
        low = jnp.where(code == -1, jnp.maximum(low, boundary), low)
    x1, loops = None, jnp.zeros_like(lanes.done) if extrema is None else extrema
    if edges:
        left, right = -inf, inf
        for belt, code, touches in zip(osc.belts, mode.codes, mode.touching, strict=True):
            left = jnp.where(touches, jnp.maximum(left, belt.lower), left)
            left = jnp.where(code == ABOVE, jnp.maximum(left, belt.upper), left)
            right = jnp.where(touches, jnp.minimum(right, belt.upper), right)
            right = jnp.where(code == BELOW, jnp.minimum(right, belt.lower), right)
        x1 = left, right
        # Far from the edges, as measured by the motion, no loop matters. Without this a lane that
        # comes to rest would loop for ever, with steps as small as rounding.
        reach = 4 * (jnp.abs(lanes.x2) + jnp.abs(lanes.a))
        loops = loops | (jnp.minimum(lanes.x1 - left, right - lanes.x1) <= reach)
    if edges or extrema is not None:
        up = loops & ((lanes.x2 > 0) | ((lanes.x2 == 0) & (lanes.a > 0)))
        down = loops & ((lanes.x2 < 0) | ((lanes.x2 == 0) & (lanes.a < 0)))
        low = jnp.where(up, jnp.maximum(low, 0.0), low)
        high = jnp.where(down, jnp.minimum(high, 0.0), high)
    signs = mode.signs
    pulls = tuple(belt.load * sign for belt, sign in zip(osc.belts, signs, strict=True))
    return _Window(x1, (low, high), extrema, signs, pulls, ~lanes.done & ~mode.any_stuck)


def _once(flag: Array, one: Array) -> Array:
    """A flag that XLA computes once, not again in each place where it is used."""
    return jnp.where(flag, 1.0, 0.0) / one > 0


def _acceleration(osc: Oscillator, window: _Window, one: Array, x1: Array, x2: Array) -> Array:
    """`oscillator.acceleration` as a single quotient; one: an array of ones that XLA cannot see
    through, for laws that are no quotient themselves."""
    numerator, denominator = -x1 - osc.damping * x2, one
    for belt, sign, pull in zip(osc.belts, window.signs, window.pulls, strict=True):
        top, bottom = belt.friction.fraction(sign * (belt.velocity - osc.omega * x2))
        numerator = numerator * bottom + pull * top * denominator
        denominator = denominator * bottom
    return numerator / denominator


def _combine(weights: np.ndarray, arrays: list[Array]) -> Array:
    terms = [w * array for w, array in zip(weights.tolist(), arrays, strict=False) if w != 0]
    return functools.reduce(jnp.add, terms)


class _Attempt(eqx.Module):
    """A step of size h, not yet accepted: state and x2' at its end, and its error over the
    tolerance."""

    h: Array
    x1: Array
    x2: Array
    a: Array
    error: Array


def _attempt(osc, window: _Window, one: Array, lanes: Lanes, h, rtol, atol) -> _Attempt:
    """One Runge-Kutta step of all lanes."""
    x1, x2, stages = lanes.x1, lanes.x2, [lanes.a]
    for row, row1, c in zip(_A[1:-1], _AA[1:-1], _C[1:-1].tolist(), strict=True):
        drift = c * x2 + h * _combine(row1, stages) if np.any(row1) else c * x2
        x2_stage = x2 + h * _combine(row, stages)
        stages.append(_acceleration(osc, window, one, x1 + h * drift, x2_stage))
    # The weights of the solution are those of the last stage, which is the next step's first.
    y1 = (x1 + h * (x2 + h * _combine(_AA[-1], stages))) / one
    y2 = (x2 + h * _combine(_A[-1], stages)) / one
    stages.append(_acceleration(osc, window, one, y1, y2))
    scale1 = atol + rtol * jnp.maximum(jnp.abs(x1), jnp.abs(y1))
    scale2 = atol + rtol * jnp.maximum(jnp.abs(x2), jnp.abs(y2))
    error1, error2 = jnp.abs(h * h * _combine(_EA, stages)), jnp.abs(h * _combine(_E, stages))
    error = jnp.maximum(error1 * scale2, error2 * scale1) / (scale1 * scale2)
    return _Attempt(h, y1, y2, stages[-1], lax.stop_gradient(error))


class _Path(eqx.Module):
    """x2 within a step, x2 + k1 theta + ... + k4 theta^4 for theta from 0 to 1, and its extremum.

    has_extremum: whether there is one inside, at theta = extremum; x2_extremum: x2 there, or at
    the end if there is none.
    """

    k: tuple[Array, Array, Array, Array]
    has_extremum: Array
    extremum: Array
    x2_extremum: Array


def _path(one: Array, lanes: Lanes, new: _Attempt) -> _Path:
    """Hermite's cubic and the term that makes the integral of x2 the change of x1."""
    h, x2, m0, m1 = new.h, lanes.x2, new.h * lanes.a, new.h * new.a
    rise, mean = new.x2 - x2, 0.5 * (x2 + new.x2) + (m0 - m1) / 12
    k4 = 30 * (new.x1 - lanes.x1 - h * mean) / jnp.where(h > 0, h, 1.0)
    c2, c3 = 3 * rise - 2 * m0 - m1, m0 + m1 - 2 * rise
    k = (m0, c2 + k4, c3 - 2 * k4, k4)
    # Where the cubic is extreme: of an error there only the square counts.
    has_extremum = lanes.a * new.a < 0
    divisor = jnp.sign(m0) * jnp.sqrt(jnp.maximum(c2 * c2 - 3 * c3 * m0, 0.0)) - c2
    safe = has_extremum & (divisor != 0)
    extremum = lax.stop_gradient(jnp.where(safe, m0, 1.0) / jnp.where(safe, divisor, 1.0))
    x2_extremum = x2 + extremum * (k[0] + extremum * (k[1] + extremum * (k[2] + extremum * k[3])))
    return _Path(k, has_extremum, extremum, jnp.where(has_extremum, x2_extremum, new.x2) / one)


class _Landing(eqx.Module):
    """What a step has to do with the bounds of its mode.

    reached: it ends so near to one that the time `delta` is left to (x1, x2) on it; blocked: it
    ends beyond one, or has its extremum there; theta: the fraction of it that ends on the bound.
    on_edge: the bound is a contact edge.
    """

    reached: Array
    delta: Array
    x1: Array
    x2: Array
    on_edge: Array
    blocked: Array
    theta: Array


def _landing(window: _Window, one, lanes: Lanes, new: _Attempt, path: _Path, rtol) -> _Landing:
    low, high = window.x2
    beyond_extremum = path.has_extremum & ((path.x2_extremum > high) | (path.x2_extremum < low))
    peak = jnp.where(beyond_extremum, path.x2_extremum, new.x2)
    reach = LANDING * jnp.sqrt(rtol)
    bound = jnp.where(new.a > 0, high, low)
    reached = ~beyond_extremum & (jnp.abs(bound - new.x2) <= reach * jnp.abs(new.a))
    slope = jnp.where(reached, new.a, 1.0)
    delta = jnp.where(reached, bound - new.x2, 1e300) / slope
    # The next term, too: it counts where x2' is small, and there x2'' is -x2.
    delta = jnp.where(reached, delta + 0.5 * bound * delta**2 / slope, delta)
    # A quarter where the bound is x2 = 0: what is left there is the rounding of x2' in a step.
    rounding = ULPS * (0.25 + jnp.abs(peak))
    outside = (peak > high + rounding) | (peak < low - rounding)
    blocked = outside & ~reached
    target = jnp.where(peak > high, high, low)
    k = lax.stop_gradient(path.k)
    start, end, poly = lanes.x2, peak, k
    on_edge, edge = jnp.zeros_like(reached), lanes.x1
    if window.x1 is not None:
        left, right = window.x1
        edge = jnp.where(new.x2 > 0, right, left)
        # Slow passages are bridged over less of the way, for there x2' counts more than x2.
        way, speed = edge - new.x1, jnp.abs(new.x2)
        near = jnp.abs(way) * jnp.maximum(speed, SLOW * jnp.abs(new.a)) < reach * speed * speed
        there = jnp.abs(way) <= ULPS * jnp.abs(new.x1)
        slope = jnp.where(near, new.x2, 1.0)
        delta1 = jnp.where(near, way, jnp.where(there, 0.0, 1e300)) / slope
        delta1 = jnp.where(near, delta1 - 0.5 * new.a * delta1**2 / slope, delta1)
        near = near | there
        on_edge = near & (delta1 < delta)
        reached, delta = reached | near, jnp.minimum(delta, delta1)
        # x1 over the step is the integral of x2; x2 keeps its sign, so x1 is monotone.
        h = new.h
        integral = (h * lanes.x2, h * k[0] / 2, h * k[1] / 3, h * k[2] / 4, h * k[3] / 5)
        beyond = ((new.x1 > right) | (new.x1 < left)) & ~near
        use = beyond & ~blocked
        poly = lax.stop_gradient(select(use, integral, (*poly, jnp.zeros_like(peak))))
        start, end = jnp.where(use, lanes.x1, start), jnp.where(use, new.x1, end)
        target = jnp.where(use, jnp.where(new.x1 > right, right, left), target)
        blocked = blocked | beyond
    until = jnp.where(beyond_extremum, path.extremum, 1.0)
    theta = _first_root(poly, start - target, until, end - target)
    # An extremum that close to a bound is no matter for an interpolant, nor is one that is wanted:
    # split the step there. The terms that the interpolant leaves out are far smaller than its last
    # ones, and near the ends of a step it is exact to the second order.
    doubt = jnp.abs(path.k[3]) + 0.1 * jnp.abs(path.k[2])
    inside = jnp.minimum(path.extremum, 1 - path.extremum)
    grazes = (path.x2_extremum > high - doubt) | (path.x2_extremum < low + doubt)
    grazes = grazes & (inside * new.h > reach)
    if window.extrema is not None:
        further = (path.extremum > lanes.upper) | (path.extremum < lanes.lower)
        grazes = grazes | (window.extrema & further & (inside > 1e-3))
    grazes = grazes & path.has_extremum & ~beyond_extremum
    return _Landing(
        reached=reached,
        delta=delta,
        x1=edge,
        x2=bound,
        on_edge=on_edge,
        blocked=blocked | grazes,
        theta=jnp.where(blocked, theta, path.extremum) / one,
    )


def _step(osc, window: _Window, one: Array, lanes: Lanes, t1, rtol, atol) -> Lanes:
    """One step of the lanes that slip: kept, shortened to end on a bound, or rejected."""
    left = t1 - lanes.t
    going = window.active & (lanes.h > 0) & (left > 0)
    h = jnp.where(going, jnp.minimum(lanes.h, left), 0.0)
    new = _attempt(osc, window, one, lanes, h, rtol, atol)
    path = _path(one, lanes, new)
    at = _landing(window, one, lanes, new, path, rtol)

    last = h >= left
    accepted = going & (new.error <= 1)
    lands = accepted & ~at.blocked & at.reached & ~(last & (at.delta > 0))
    # As a number, divided: what many results depend on is then computed once.
    outcome = jnp.where(accepted, jnp.where(at.blocked, -1.0, 1.0), 0.0)
    outcome = jnp.where(lands, 2.0, outcome) / one
    shortened, kept, lands = outcome < 0, outcome > 0, outcome > 1
    delta = jnp.where(lands, at.delta, 0.0) / one

    # The Taylor step to the bound, if there is one.
    x1 = new.x1 + delta * (new.x2 + 0.5 * delta * new.a)
    x2 = jnp.where(lands & ~at.on_edge, at.x2, new.x2 + delta * new.a)
    if window.x1 is not None:
        x1 = jnp.where(lands & at.on_edge, at.x1, x1)
    t = jnp.where(last & ~lands, t1, lanes.t + h + delta)
    # NaN is a large error, too. The error is of order eight in h.
    size = jnp.where(new.error < 1e5, jnp.maximum(new.error, LEAST), 1e5)
    # No power, and no quotient by a root: XLA's are no vector operations.
    pace = jnp.sqrt(jnp.sqrt(jnp.sqrt(size))) / jnp.where(going, h, 1.0)
    # A step that was cut short tells little: the pace is at most that.
    pace = jnp.where(new.error <= LEAST, jnp.minimum(pace, lanes.pace), pace)
    # What has become slower goes on to do so, on the way to a boundary with its bend of the law.
    trend = jnp.where(accepted, jnp.maximum(pace, lanes.pace) / lanes.pace, 1.0)
    proposed = jnp.minimum(0.9 / (pace * trend), MAX_STEP)
    stands = shortened & (at.theta * h < NO_STEP)
    proposed = jnp.where(shortened, at.theta * h, proposed)
    proposed = jnp.where(stands, NO_STEP, proposed)
    proposed = jnp.where(lands | stands, -proposed, proposed)
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
    )


def _first_step(rtol):
    return FIRST_STEP * (1e8 * rtol) ** 0.125


def _first_root(poly, g_start, end, g_end):
    """Root in (0, end] of g_start + poly[0] theta + poly[1] theta^2 ..., by Newton's method."""
    # A lane that moves away from the bound at first comes back to it late in the step. So does one
    # that has just left it, where g vanishes but for rounding: that root is not the one.
    nears = (g_start * poly[0] < 0) & (jnp.abs(g_start) > 1e-9 * jnp.abs(g_end))
    ratio = jnp.abs(g_start) / (jnp.abs(g_start) + jnp.abs(g_end))
    straight = jnp.abs(g_start) / jnp.where(nears, jnp.abs(poly[0]), 1.0)
    theta = jnp.where(nears, jnp.minimum(straight, ratio * end), end)
    for _ in range(3):
        value, slope = poly[-1], jnp.zeros_like(theta)
        for k in (*reversed(poly[:-1]), g_start):
            value, slope = value * theta + k, slope * theta + value
        theta = theta - value / jnp.where(slope == 0, 1.0, slope)
    good = (theta > 0) & (theta <= end)
    return lax.stop_gradient(jnp.where(good, theta, 0.5 * end))


# --- events ---------------------------------------------------------------------------------------


def _pass_events(
    program: "Program", osc: Oscillator, lanes: Lanes, t1: Array, rtol: Array
) -> tuple[Lanes, Passage]:
    """Lanes that stand on a guard go on; stick phases are passed to their end, or to t1."""
    landed = (lanes.h < 0) & ~lanes.done
    # A lane may also have landed where x2 = 0, which is no guard.
    number = guard_passed(osc, lanes.mode, lanes.x1, lanes.x2)
    fired = landed & (number >= 0)
    after = leave_slip(osc, lanes.mode, jnp.where(fired, number, -1), lanes.x1, lanes.x2)
    captured = fired & after.captured & program.captures
    x1, x2 = after.x1, jnp.where(captured, 0.0, after.x2)
    slow = jnp.maximum(jnp.abs(lanes.x2), jnp.abs(lanes.a)) < AT_REST * (1 + jnp.abs(lanes.x1))
    rests = landed & ~fired & (lanes.h >= -NO_STEP) & slow

    stuck = after.mode.any_stuck & ~captured & ~lanes.done
    phase = stick_phase(osc, after.mode, x1)
    left = t1 - lanes.t
    ends = phase.duration >= left
    duration = jnp.where(stuck, jnp.where(ends, left, phase.duration), 0.0)
    released = stuck & ~ends
    mode = select(released, leave_stick(osc, after.mode, phase, x2), after.mode)
    mode = select(captured, lanes.mode, mode)
    new_x1 = jnp.where(stuck, jnp.where(ends, x1 + x2 * left, phase.x1), x1)
    t = jnp.where(stuck & ends | rests, t1, lanes.t + duration)

    # Slip onset is tangent: x2' = 0 there, for a law without a jump, but for rounding.
    a = mode_acceleration(osc, mode, new_x1, x2)
    a = jnp.where(jnp.abs(a) < TANGENT * (1 + jnp.abs(new_x1)), 0.0, a)
    moved = landed | stuck
    h = jnp.where(fired, _first_step(rtol), jnp.abs(lanes.h))
    if program.edges:
        # In a corner one event follows the other at once: a lane that stands on the next guard,
        # and goes on through it, has landed there.
        corner = (fired | released) & ~mode.any_stuck & (guard_passed(osc, mode, new_x1, x2) >= 0)
        h = jnp.where(corner, -h, h)
    forever = stuck & jnp.isinf(phase.duration)
    status = jnp.where(captured, Status.PSEUDO_FOCUS.value, lanes.status)
    status = jnp.where(forever, Status.STUCK_FOREVER.value, status)
    passage = Passage(
        landed=landed,
        fired=fired,
        guard=number,
        before=lanes.mode,
        mode=after.mode,
        t=lanes.t,
        x1=x1,
        x2=x2,
        captured=captured,
        rests=rests,
        stuck=stuck,
        duration=duration,
        released=released,
        slips=released & phase.slips,
        forever=forever,
    )
    lanes = eqx.tree_at(
        lambda n: (n.t, n.x1, n.x2, n.a, n.h, n.pace, n.mode, n.events, n.status, n.done),
        lanes,
        (
            t,
            new_x1,
            x2,
            jnp.where(moved, a, lanes.a),
            # The field is new after an event, and so is the step size.
            h,
            jnp.where(fired, 0.9 / _first_step(rtol), lanes.pace),
            mode,
            lanes.events + jnp.where(fired, 1, 0) + jnp.where(released, 1, 0),
            status,
            lanes.done | captured | (t >= t1),
        ),
    )
    return lanes, passage


# --- the loop -------------------------------------------------------------------------------------


class Program(eqx.Module):
    """What is fixed when the kernel is compiled."""

    structure: Any = eqx.field(static=True)
    mapped: tuple[bool, ...] = eqx.field(static=True)
    observer: Observer = eqx.field(static=True)
    edges: bool = eqx.field(static=True)
    #: Whether a run that a pseudo-focus captures ends there.
    captures: bool = eqx.field(static=True, default=True)


def _oscillator(program: Program, shared, rows: tuple[Array, ...]) -> Oscillator:
    """The oscillators of the lanes: leaves that differ from run to run are arrays [lanes]."""
    leaves, column = [], 2
    others = iter(shared)
    for is_mapped in program.mapped:
        if is_mapped:
            leaves.append(rows[column])
            column += 1
        else:
            leaves.append(next(others))
    osc = jax.tree.unflatten(program.structure, leaves)
    if program.edges:
        return osc
    # Known to be infinite while the kernel is compiled; see `modes.has_edges`.
    with jax.ensure_compile_time_eval():
        lower, upper = jnp.asarray(-jnp.inf), jnp.asarray(jnp.inf)
    belts = tuple(
        eqx.tree_at(lambda b: (b.lower, b.upper), belt, (lower, upper)) for belt in osc.belts
    )
    return eqx.tree_at(lambda o: o.belts, osc, belts)


def _begin(program: Program, osc, run, x1, x2, passes, rtol) -> Lanes:
    """Lanes at the start of their runs."""
    mode = mode_of_state(osc, x1, x2)
    finite = jnp.isfinite(x1) & jnp.isfinite(x2)
    for leaf in jax.tree.leaves(osc):
        finite = finite & ~jnp.isnan(leaf)
    rests = at_focus(osc, x1, x2) if program.edges else jnp.zeros_like(finite)
    status = jnp.where(rests, Status.PSEUDO_FOCUS.value, Status.OK.value)
    status = jnp.where(finite, status, Status.NOT_FINITE.value)
    zero = jnp.zeros_like(x1)
    lanes = Lanes(
        run=run,
        begun=jnp.full_like(run, passes),
        t=zero,
        x1=x1,
        x2=x2,
        a=mode_acceleration(osc, mode, x1, x2) + zero,
        h=zero + _first_step(rtol),
        pace=zero + 0.9 / _first_step(rtol),
        mode=Mode(tuple(code + zero for code in mode.codes)),
        events=jnp.zeros_like(run),
        status=status.astype(run.dtype),
        done=~finite | rests,
        lower=x2,
        upper=x2,
        memory=None,
    )
    return replace(lanes, memory=program.observer.start(osc, lanes))


class Stream(eqx.Module):
    """The kernel between two calls: lanes, the rows of the queue that they work on, and passes."""

    lanes: Lanes
    rows: tuple[Array, ...]
    passes: Array
    one: Array


@functools.partial(jax.jit, static_argnums=(0, 2, 3))
def _idle(program: Program, shared, width: int, columns: int) -> Stream:
    """Lanes with nothing to do."""
    rows = tuple(jnp.zeros(width) for _ in range(columns))
    osc = _oscillator(program, shared, rows)
    run = jnp.full(width, -1, dtype=jnp.int32)
    lanes = _begin(program, osc, run, rows[0], rows[1], jnp.zeros((), jnp.int32), jnp.ones(()))
    lanes = eqx.tree_at(lambda n: n.done, lanes, jnp.ones(width, dtype=bool))
    return Stream(lanes, rows, jnp.zeros((), jnp.int32), jnp.ones(width))


def _ordered(values: dict[str, Any]) -> list[str]:
    return sorted(values)


def _columns(values: dict[str, Any]) -> list[Array]:
    """Results as columns [lanes] of floats: what is a tuple has a column each."""
    columns = []
    for name in _ordered(values):
        for value in jax.tree.leaves(values[name]):
            value = value.astype(jnp.float64)
            columns += [value] if value.ndim == 1 else list(value.reshape(value.shape[0], -1).T)
    return columns


class _Desk(eqx.Module):
    """What lies ready for the lanes, and what they have handed in: no more than there are lanes.

    begun: runs taken; filled: rows handed in, of numbers and of columns of results.
    """

    stream: Stream
    begun: Array
    filled: Array
    numbers: Array
    columns: list[Array]


def _refill(program: Program, shared, rtol, limit, block, begun, available, desk: _Desk) -> _Desk:
    """Hand in what is done and take new runs, numbered from `begun`."""
    observer, one = program.observer, desk.stream.one
    slots = jnp.arange(one.size, dtype=jnp.int32)
    lanes, passes = desk.stream.lanes, desk.stream.passes
    osc = _oscillator(program, shared, desk.stream.rows)
    lanes = _give_up(observer.rest(osc, lanes, one), passes, limit)
    finished = lanes.done & (lanes.run >= 0)
    finished = finished & (_rank(finished) < one.size - desk.filled)
    # In order, behind what is there.
    source = jnp.searchsorted(_rank(finished), slots - desk.filled)
    new = [lanes.run, *_columns(observer.finish(osc, lanes))]
    pairs = zip([desk.numbers, *desk.columns], new, strict=True)
    handed = [
        jnp.where(slots < desk.filled, old, value.at[source].get(mode="fill", fill_value=-1))
        for old, value in pairs
    ]

    free = lanes.done & (finished | (lanes.run < 0))
    place = desk.begun + _rank(free)
    takes = free & (place < available)
    place = jnp.where(takes, place, 0)
    pairs = zip(block, desk.stream.rows, strict=True)
    rows = tuple(jnp.where(takes, column[place], row) for column, row in pairs)
    osc = _oscillator(program, shared, rows)
    fresh = _begin(program, osc, begun + place, rows[0], rows[1], passes, rtol)
    lanes = choose(takes, fresh, replace(lanes, run=jnp.where(free, -1, lanes.run)))
    return _Desk(
        Stream(lanes, rows, passes + 1, one),
        desk.begun + jnp.sum(takes, dtype=jnp.int32),
        desk.filled + jnp.sum(finished, dtype=jnp.int32),
        handed[0],
        handed[1:],
    )


def _work(program: Program, shared, rows, lanes: Lanes, one, t1, rtol, atol) -> Lanes:
    """ROUNDS times: past the events, and some steps."""
    osc, observer = _oscillator(program, shared, rows), program.observer

    def round_(_, lanes):
        lanes, passage = _pass_events(program, osc, lanes, t1, rtol)
        lanes = observer.watch(osc, lanes, passage, one, t1, rtol)
        window = _window(osc, lanes, edges=program.edges, extrema=observer.extrema(lanes))

        def step(_, lanes):
            return _step(osc, window, one, lanes, t1, rtol, atol)

        return lax.fori_loop(0, STEPS, step, lanes)

    return lax.fori_loop(0, ROUNDS, round_, lanes)


def _advance(
    program: Program, shared, t1, rtol, atol, limit, queue, first, count, stream: Stream, drain
):
    """Work through the queue; with `drain` until all lanes are idle.

    queue: columns [runs + lanes], the starts and the parameters that differ; the runs are numbered
    from `first`, `count` of them are real. Returns the lanes, and, in order of completion, numbers
    (-1 where there is none) and results [columns, runs + 3 lanes].

    Two loops, because on the CPU only loops on small arrays can be one kernel. The inner loop sees
    small ones only: as many new runs, and as many results, as there are lanes.
    """
    width = stream.one.size
    size = queue[0].size + 2 * width

    def at_work(stream):
        return jnp.any((stream.lanes.run >= 0) | ~stream.lanes.done)

    @one_kernel
    def fill(shared, t1, rtol, atol, limit, block, begun, available, last, desk):
        """Work until the block of runs is taken or the desk is full."""

        def unfinished(desk):
            left = (desk.begun < available) | (last & at_work(desk.stream))
            return left & (desk.filled < width)

        def go_on(desk):
            desk = _refill(program, shared, rtol, limit, block, begun, available, desk)
            stream = desk.stream
            lanes = _work(program, shared, stream.rows, stream.lanes, stream.one, t1, rtol, atol)
            return replace(desk, stream=replace(stream, lanes=lanes))

        return lax.while_loop(unfinished, go_on, desk)

    def outer(state):
        stream, taken, written, numbers, results = state
        zero = jnp.zeros_like(taken)
        block = tuple(lax.dynamic_slice(column, (taken,), (width,)) for column in queue)
        available = jnp.minimum(count - taken, width)
        last = drain & (taken + available >= count)
        nothing = [jnp.zeros_like(stream.one) for _ in results]
        desk = _Desk(stream, zero, zero, jnp.full(width, -1, dtype=jnp.int32), nothing)
        desk = fill(shared, t1, rtol, atol, limit, block, first + taken, available, last, desk)
        numbers = lax.dynamic_update_slice(numbers, desk.numbers, (written,))
        pairs = zip(results, desk.columns, strict=True)
        results = [lax.dynamic_update_slice(whole, part, (written,)) for whole, part in pairs]
        return desk.stream, taken + desk.begun, written + desk.filled, numbers, results

    def unfinished(state):
        stream, taken, *_ = state
        return (taken < count) | (drain & at_work(stream))

    n_columns = sum(math.prod(shape) for shape in layout(program, shared).values())
    none = jnp.zeros((), jnp.int32)
    numbers = jnp.full(size, -1, dtype=jnp.int32)
    results = [jnp.full(size, jnp.nan) for _ in range(n_columns)]
    start = (stream, none, none, numbers, results)
    stream, _, _, numbers, results = lax.while_loop(unfinished, outer, start)
    return stream, numbers, jnp.stack(results)


def _rank(flags: Array) -> Array:
    """How many flags are set before each one."""
    return jnp.cumsum(flags.astype(jnp.int32)) - 1


def _give_up(lanes: Lanes, passes, limit) -> Lanes:
    """End runs that took too many steps, or whose state is not finite."""
    finite = jnp.isfinite(lanes.x1) & jnp.isfinite(lanes.x2) & jnp.isfinite(lanes.a)
    lost = ~lanes.done & (~finite | (passes - lanes.begun > limit))
    reason = jnp.where(finite, Status.TOO_MANY_STEPS.value, Status.NOT_FINITE.value)
    status = jnp.where(lost, reason.astype(lanes.status.dtype), lanes.status)
    return eqx.tree_at(lambda n: (n.status, n.done), lanes, (status, lanes.done | lost))


# --- runs in bulk ---------------------------------------------------------------------------------


def _kernel(program: Program, derivatives: int) -> Callable:
    """The compiled kernel of a program, one for all threads and all sweeps."""
    return _compiled(program, derivatives > 0, _options())


@functools.lru_cache(maxsize=32)
def _compiled(program, derivatives, options):
    advance = _advance_with_derivatives if derivatives else _advance
    return jax.jit(functools.partial(advance, program), compiler_options=dict(options) or None)


def _advance_with_derivatives(
    program, shared, t1, rtol, atol, limit, queue, first, count, stream, drain
):
    """`_advance` to the end, with derivatives in the directions queue[1:] of the rows queue[0]."""

    def of_rows(rows):
        stream_out, numbers, results = _advance(
            program, shared, t1, rtol, atol, limit, rows, first, count, stream, True
        )
        return results, (stream_out, numbers)

    def column(direction):
        return jax.jvp(of_rows, (queue[0],), (direction,), has_aux=True)

    out = jax.vmap(column, out_axes=(None, 0, None))(queue[1:])
    results, columns, (stream_out, numbers) = out
    return stream_out, numbers, jnp.concatenate([results[None], columns])


def layout(program: Program, shared: list[Array]) -> dict[str, tuple[int, ...]]:
    """The results of a run in the order of their columns: the shape of each by name."""

    def finish():
        stream = _idle(program, shared, 1, 2 + sum(program.mapped))
        osc = _oscillator(program, shared, stream.rows)
        return program.observer.finish(osc, stream.lanes)

    values = jax.eval_shape(finish)
    shapes = {}
    for name in _ordered(values):
        value = values[name]
        is_tuple = isinstance(value, tuple)
        shapes[name] = (len(value),) if is_tuple else value.shape[1:]
    return shapes


def by_name(layout: dict[str, tuple[int, ...]], columns: np.ndarray) -> dict[str, np.ndarray]:
    """Columns [..., columns, runs] as results by name, [..., runs] and the shape of each."""
    results, first = {}, 0
    for name, shape in layout.items():
        part = np.moveaxis(columns[..., first : first + math.prod(shape), :], -2, -1)
        results[name] = part.reshape(*part.shape[:-1], *shape)
        first += math.prod(shape)
    return results


@functools.lru_cache(maxsize=1)
def _options() -> tuple[tuple[str, Any], ...]:
    """Compiler options of the kernel: wide vectors where the processor has them."""
    if jax.default_backend() != "cpu":
        return ()
    try:
        wide = "avx512f" in Path("/proc/cpuinfo").read_text()
    except OSError:
        return ()
    options = {"xla_cpu_prefer_vector_width": 512}
    try:
        if wide:
            jax.jit(lambda: 0, compiler_options=options)()
            return tuple(options.items())
    except jax.errors.JaxRuntimeError:
        pass  # a version of XLA that does not know the option
    return ()


def workers() -> int:
    """Threads that run the kernel: one a core on the CPU, one a device elsewhere."""
    if jax.default_backend() != "cpu":
        return jax.local_device_count()
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run(
    program: Program,
    shared: list[Array],
    rows_of: Callable[[int, int], np.ndarray],
    runs: int,
    put: Callable[[np.ndarray, np.ndarray], None],
    *,
    t1: float,
    rtol: float,
    atol: float,
    derivatives: int = 0,
    budget: float = 1.0,
) -> None:
    """Do all runs: rows_of(first, last) gives the queue, [1 + derivatives, columns, runs]:
    the starts and the parameters that vary, and their derivatives in so many directions;
    put(numbers, results) takes results [1 + derivatives, columns, runs] in any order. budget: the
    share of `MAX_STEPS` that a run may take.

    Every thread feeds chunks to one compiled kernel (which lets go of Python's lock) on its own
    lanes. Long runs stay in their lanes while the next chunk is worked on.
    """
    limit = int(budget * MAX_STEPS * max(1.0, t1 / 100)) // (STEPS * ROUNDS)
    settings = (t1, rtol, atol, np.int32(limit))
    kernel = functools.partial(_kernel(program, derivatives), shared, *settings)
    columns = 2 + sum(program.mapped)
    threads = workers()
    # The queue is of one size, for one compiled program; short work is shared out all the same.
    share = min(CHUNK, -(-runs // threads))
    width = WIDTH.get(jax.default_backend(), 2**17)
    chunks = iter([(i, min(i + share, runs)) for i in range(0, runs, share)])
    lock = threading.Lock()

    def take():
        with lock:
            return next(chunks, None)

    def work(device) -> None:
        with jax.default_device(device):
            stream, todo = _idle(program, shared, width, columns), take()
            while todo is not None:
                (first, last), todo = todo, take()
                rows = np.zeros((1 + derivatives, columns, CHUNK + width))
                rows[:, :, : last - first] = rows_of(first, last)
                rows = rows if derivatives else rows[0]
                span = np.int32(first), np.int32(last - first)
                stream, numbers, results = kernel(rows, *span, stream, todo is None)
                numbers = np.asarray(numbers)
                done = np.flatnonzero(numbers >= 0)
                results = np.asarray(results).reshape(1 + derivatives, -1, len(numbers))
                with lock:
                    put(numbers[done], results[:, :, done])

    devices = jax.local_devices()
    if not runs:
        return
    # Compiled here, once, and not by each thread; on a device as there, or they would do it again.
    nothing = np.zeros((1 + derivatives, columns, CHUNK + width))
    with jax.default_device(devices[0]):
        idle = _idle(program, shared, width, columns)
        kernel(nothing if derivatives else nothing[0], np.int32(0), np.int32(0), idle, False)
    with ThreadPoolExecutor(threads) as pool:
        started = [pool.submit(work, devices[i % len(devices)]) for i in range(threads)]
        for future in started:
            future.result()


# --- events as they are told ----------------------------------------------------------------------


def _event_kinds(lanes: Lanes, passage: Passage) -> tuple[tuple[Array, Array, Array], ...]:
    """(happened, kind, belt) of the event that ended a step, and of that which ended a stick phase
    after it."""
    sticks = jnp.where(passage.mode.any_stuck, EventKind.STICK.value, EventKind.CROSS.value)
    at_edge = passage.guard >= len(lanes.mode.codes)
    kind = jnp.where(at_edge, EventKind.EDGE.value, sticks)
    release = jnp.where(passage.slips, EventKind.SLIP.value, EventKind.EDGE.value)
    return (
        (passage.fired, kind, _belt(passage.before, passage.mode, at_edge)),
        (passage.released, release, _belt(passage.mode, lanes.mode, ~passage.slips)),
    )


def _belt(before: Mode, after: Mode, at_edge: Array) -> Array:
    """The lowest belt whose contact changed, or, at an edge, that came or went."""
    numbers = [jnp.asarray(i) for i in range(len(before.codes))]

    def first_change(a, b):
        return first_of([p != q for p, q in zip(a, b, strict=True)], numbers, jnp.asarray(-1))

    came = first_change(before.touching, after.touching)
    return jnp.where(at_edge, came, first_change(before.codes, after.codes))


def _append(word: Array, kind: Array, belt: Array, belts: int) -> Array:
    """A word with one more event; inf if it would no longer be a whole number to the last bit."""
    longer = word * (len(EventKind) * belts + 1) + (1 + (kind - 1) * belts + belt)
    return jnp.where(longer < 2.0**53, longer, jnp.inf)


def word_events(word: int, belts: int) -> tuple[tuple[EventKind, int], ...]:
    """The events, (kind, belt) each, that the word of an attractor's signature stands for.

    A word is a number in the base 4 belts + 1: a leading 1, then for each event
    1 + (kind - 1) belts + belt.
    """
    events = []
    while word > 1:
        word, digit = divmod(word, len(EventKind) * belts + 1)
        kind, belt = divmod(digit - 1, belts)
        events.append((EventKind(kind + 1), belt))
    return tuple(reversed(events))


# --- what repeats ---------------------------------------------------------------------------------


class _Mark(eqx.Module):
    """A state of a run that later ones are compared with, arrays [lanes].

    When it is 1, 2, 4, ... states old, the next one takes its place (Brent's method), so a cycle of
    any number of such states is found at their first repetition or soon after.
    """

    x1: Array
    x2: Array
    code: Array
    t: Array
    events: Array
    age: Array
    limit: Array


def _no_mark(lanes: Lanes) -> _Mark:
    zero, count = jnp.zeros_like(lanes.t), jnp.zeros_like(lanes.events)
    return _Mark(zero + jnp.nan, zero, zero, zero, count, count, count)


def _returned(mark: _Mark, lanes: Lanes, close: Array | float) -> Array:
    """Whether the lanes are in the marked state again: mode, x2, and x1 to `close`.

    x2 is that of a belt, or 0, on both occasions, and so it is the same to the last bit.
    """
    same = (lanes.x2 == mark.x2) & (_code(lanes.mode) == mark.code)
    return same & (jnp.abs(lanes.x1 - mark.x1) <= close)


def _renew(mark: _Mark, lanes: Lanes, at: Array, one: Array) -> tuple[_Mark, Array]:
    """The marks after the lanes `at` such a state, and which of them are new."""
    age = mark.age + jnp.where(at, 1, 0)
    new = _once(at & (age >= mark.limit), one)
    here = _Mark(
        lanes.x1,
        lanes.x2,
        _code(lanes.mode),
        lanes.t,
        lanes.events,
        jnp.zeros_like(age),
        jnp.maximum(2 * mark.limit, 1),
    )
    return select(new, here, eqx.tree_at(lambda m: m.age, mark, age)), new


def _code(mode: Mode) -> Array:
    """A mode as one number."""
    total = jnp.zeros(())
    for i, code in enumerate(mode.codes):
        total = total + (code + 2) * 5.0**i
    return total


# --- final states ---------------------------------------------------------------------------------


class Final(Observer):
    """The state at t1.

    At the end of a stick phase the state is a function of the parameters alone. Where it repeats,
    everything repeats, to the last bit; so the run then goes on a whole number of loops at once
    (unless `skip` is false).
    """

    skip: bool = eqx.field(static=True, default=True)

    def start(self, osc, lanes):
        return _no_mark(lanes)

    def watch(self, osc, lanes, passage, one, t1, tol):
        if not self.skip:
            return lanes
        mark: _Mark = lanes.memory
        released = passage.released & ~lanes.mode.any_stuck
        period = lanes.t - mark.t
        repeats = released & _returned(mark, lanes, 0.0) & (period > 0)
        loops = jnp.floor((t1 - lanes.t) / jnp.where(repeats, period, jnp.inf))
        loops = lax.stop_gradient(jnp.maximum(loops, 0.0))
        per_loop = lanes.events - mark.events
        t = jnp.where(repeats, lanes.t + loops * period, lanes.t)
        events = lanes.events + jnp.where(repeats, loops.astype(per_loop.dtype) * per_loop, 0)
        lanes = eqx.tree_at(lambda n: (n.t, n.events), lanes, (t, events))
        return eqx.tree_at(lambda n: n.memory, lanes, _renew(mark, lanes, released, one)[0])

    def finish(self, osc, lanes):
        return {
            "x1_end": lanes.x1,
            "x2_end": lanes.x2,
            "mode_end": lanes.mode.codes,
            "n_events": lanes.events,
            "status": lanes.status,
        }


# --- attractors -----------------------------------------------------------------------------------

#: What a run leads to, in the order of their codes.
KINDS = ("undecided", "equilibrium", "cycle", "stuck")
UNDECIDED, EQUILIBRIUM, CYCLE, STUCK_FOR_EVER = range(4)


class _Loop(eqx.Module):
    """The loop under way, since the last mark; arrays [lanes], sticks one a belt.

    tops: how many there were since the last stick phase; previous, change: the top before, and how
    far it was from the one before that; word: the events,
    see `Attractor`; period and transient are set when the attractor is found.
    """

    mark: _Mark
    x1_min: Array
    x1_max: Array
    sticks: tuple[Array, ...]
    word: Array
    tops: Array
    previous: Array
    change: Array
    kind: Array
    period: Array
    transient: Array
    loop_events: Array


class Attractor(Observer):
    """Where the run leads; it ends as soon as that is known.

    - A cycle: an orbit that sticks repeats the end of a stick phase; from there it is a function of
      the parameters alone, so it does so to the last bits. One that does not stick converges: its
      top (a maximum of x1, where x2 = 0) has repeated when what is left of the way to the limit, by
      the ratio of its last two changes, is below `REPEATED` times the amplitude.
    - An equilibrium: the run begins on one, or the orbit has entered a disc that is attracted by a
      fixed point, see `modes.disc_margin`. A pseudo-focus is recognised by `modes.is_captured`.
    - Stuck for ever: on a belt at rest.

    The signature of a cycle, (kind, belt) event by event, comes as a number, see `word_events`.
    """

    REPEATED: ClassVar[float] = 1e-7
    #: Motion that is smaller than so many tolerances is the integrator's.
    RESOLVED: ClassVar[float] = 1e3
    #: Until then extrema are left out, unless a stick phase has ended: about two loops.
    SETTLING: ClassVar[float] = 12.0
    #: Tops without a stick phase after which a run is taken to stick no more.
    SMOOTH: ClassVar[int] = 2

    def extrema(self, lanes):
        return ~jnp.isnan(lanes.memory.mark.x1) | (lanes.t > self.SETTLING)

    def start(self, osc, lanes):
        zero = jnp.zeros_like(lanes.t)
        count = jnp.zeros_like(lanes.events)
        nothing = zero + jnp.nan
        rests = begins_at_rest(osc, lanes.x1, lanes.x2)
        return _Loop(
            mark=_no_mark(lanes),
            x1_min=lanes.x1,
            x1_max=lanes.x1,
            sticks=tuple(zero for _ in osc.belts),
            word=zero + 1,
            tops=count,
            previous=nothing,
            change=nothing,
            kind=count + jnp.where(rests, EQUILIBRIUM, UNDECIDED).astype(count.dtype),
            period=nothing,
            transient=jnp.where(rests, 0.0, nothing),
            loop_events=count,
        )

    def watch(self, osc, lanes, passage, one, t1, tol):
        loop: _Loop = lanes.memory
        sticks = tuple(
            total + jnp.where(stuck, passage.duration, 0.0)
            for total, stuck in zip(loop.sticks, passage.mode.stuck, strict=True)
        )
        word = loop.word
        for happened, kind, belt in _event_kinds(lanes, passage):
            longer = _append(word, kind, belt, len(osc.belts))
            word = jnp.where(happened & (belt >= 0), longer, word)
        # x1 is extreme where x2 = 0, and a step ends there.
        x1_min, x1_max = jnp.minimum(loop.x1_min, lanes.x1), jnp.maximum(loop.x1_max, lanes.x1)
        top = _once(passage.landed & (lanes.x2 == 0) & (lanes.a < 0) & ~lanes.done, one)

        mark, amplitude = loop.mark, x1_max - x1_min
        change = lanes.x1 - loop.previous
        ratio = jnp.abs(change / jnp.where(loop.change == 0, 1.0, loop.change))
        left = jnp.where(ratio < 1, ratio / jnp.where(ratio < 1, 1 - ratio, 1.0), jnp.inf)
        moved, close = jnp.abs(lanes.x1 - mark.x1), amplitude * self.REPEATED
        converged = (moved * left <= close) | (moved < 30 * tol * amplitude)
        released = _once(passage.released & ~lanes.mode.any_stuck & ~lanes.done, one)
        tops = jnp.where(released, 0, loop.tops + jnp.where(top, 1, 0))
        section = released | (top & (tops > self.SMOOTH))
        repeats = section & _returned(mark, lanes, jnp.where(released, 1e-9 * amplitude, close))
        repeats = repeats & (released | converged)

        kind = jnp.where(repeats, CYCLE, UNDECIDED)
        # Motion that the tolerance does not resolve is at rest if it repeats or shrinks; but an
        # orbit that sticks is on a cycle, however small.
        small = jnp.maximum(amplitude, lanes.upper - lanes.lower) < self.RESOLVED * tol
        shrinks = section & (change < 0) & (loop.change < 0)
        kind = jnp.where(small & ~released & (repeats | shrinks), EQUILIBRIUM, kind)
        kind = jnp.where(passage.captured | passage.rests, EQUILIBRIUM, kind)
        kind = jnp.where(passage.forever, STUCK_FOR_EVER, kind)
        going_on = (loop.kind == UNDECIDED) & (lanes.run >= 0)
        kind = (jnp.where(going_on, kind, UNDECIDED) / one).astype(loop.kind.dtype)
        found = kind != UNDECIDED
        resting = found & (kind != CYCLE)
        renewed, new = _renew(mark, lanes, section & ~found, one)
        # An attractor at rest is a point; a new mark begins a new loop.
        fresh = new | resting
        memory = _Loop(
            mark=renewed,
            x1_min=jnp.where(fresh, lanes.x1, x1_min),
            x1_max=jnp.where(fresh, lanes.x1, x1_max),
            sticks=tuple(
                jnp.where(found & passage.forever & stuck, jnp.inf, jnp.where(fresh, 0.0, total))
                for total, stuck in zip(sticks, passage.mode.stuck, strict=True)
            ),
            word=jnp.where(fresh, 1.0, word),
            tops=tops,
            previous=jnp.where(top, lanes.x1, loop.previous),
            change=jnp.where(top, change, loop.change),
            kind=jnp.where(found, kind, loop.kind),
            period=jnp.where(found & ~resting, lanes.t - mark.t, loop.period),
            transient=jnp.where(found, jnp.where(resting, passage.t, mark.t), loop.transient),
            loop_events=jnp.where(found & ~resting, lanes.events - mark.events, loop.loop_events),
        )
        # Decided lanes may have to wait until their result is taken.
        memory = select(loop.kind == UNDECIDED, memory, loop)
        return eqx.tree_at(
            lambda n: (n.lower, n.upper, n.done, n.memory),
            lanes,
            (
                jnp.where(fresh, lanes.x2, lanes.lower),
                jnp.where(fresh, lanes.x2, lanes.upper),
                lanes.done | (memory.kind != UNDECIDED),
                memory,
            ),
        )

    def rest(self, osc, lanes, one):
        loop: _Loop = lanes.memory
        zero = jnp.zeros_like(lanes.t)
        x1_rest = mode_acceleration(osc, lanes.mode, zero, zero)
        radius = jnp.maximum(jnp.hypot(lanes.x1 - x1_rest, lanes.x2), SMALLEST_DISC)
        margin = disc_margin(osc, lanes.mode, x1_rest, radius)
        margin = jnp.where(lanes.mode.any_stuck | lanes.done, 0.0, margin) / one
        found = margin > 0
        memory = eqx.tree_at(
            lambda m: (m.kind, m.x1_min, m.x1_max, m.sticks, m.transient),
            loop,
            (
                jnp.where(found, EQUILIBRIUM, loop.kind).astype(loop.kind.dtype),
                jnp.where(found, x1_rest, loop.x1_min),
                jnp.where(found, x1_rest, loop.x1_max),
                tuple(jnp.where(found, 0.0, total) for total in loop.sticks),
                jnp.where(found, lanes.t, loop.transient),
            ),
        )
        return eqx.tree_at(
            lambda n: (n.lower, n.upper, n.done, n.memory),
            lanes,
            (
                jnp.where(found, 0.0, lanes.lower),
                jnp.where(found, 0.0, lanes.upper),
                lanes.done | found,
                memory,
            ),
        )

    def finish(self, osc, lanes):
        loop: _Loop = lanes.memory
        undecided = (loop.kind == UNDECIDED) & (lanes.status == Status.OK.value)
        status = jnp.where(undecided, Status.NOT_SETTLED.value, lanes.status)
        word = jnp.where(jnp.isinf(loop.word), -1.0, loop.word)
        return {
            "kind": loop.kind,
            "signature": jnp.where(loop.kind == CYCLE, word, 0.0),
            "sticks": tuple(total > 0 for total in loop.sticks),
            "period": loop.period,
            "stick_duration": loop.sticks,
            "x1_min": loop.x1_min,
            "x1_max": loop.x1_max,
            "x2_min": lanes.lower,
            "x2_max": lanes.upper,
            "transient": loop.transient,
            "n_events": jnp.where(loop.kind == CYCLE, loop.loop_events, lanes.events),
            "status": status,
        }


# --- a reducer of the user's ----------------------------------------------------------------------


class Event(eqx.Module):
    """An event of a run, as a reducer sees it: scalars t, x1, x2, kind (`EventKind`) and belt."""

    t: Array
    x1: Array
    x2: Array
    kind: Array
    belt: Array


class End(eqx.Module):
    """The end of a run, as a reducer sees it: scalars t, x1, x2 and status."""

    t: Array
    x1: Array
    x2: Array
    status: Array


class Reduce(Observer):
    """What a reducer of the user's makes of the events of a run; see `sweep.sweep`."""

    reducer: Any = eqx.field(static=True)

    def start(self, osc, lanes):
        axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, osc)
        return jax.vmap(self.reducer.init, in_axes=(axes, 0, 0))(osc, lanes.x1, lanes.x2)

    def watch(self, osc, lanes, passage, one, t1, tol):
        memory, busy = lanes.memory, lanes.run >= 0
        (fired, kind, belt), (released, *release) = _event_kinds(lanes, passage)
        event = Event(passage.t, passage.x1, passage.x2, kind, belt)
        memory = self._update(memory, event, fired & busy)
        event = Event(lanes.t, lanes.x1, lanes.x2, *release)
        memory = self._update(memory, event, released & busy)
        return replace(lanes, memory=memory)

    def _update(self, memory, event, happened):
        return choose(happened, jax.vmap(self.reducer.update)(memory, event), memory)

    def finish(self, osc, lanes):
        end = End(lanes.t, lanes.x1, lanes.x2, lanes.status)
        return {**jax.vmap(self.reducer.finish)(lanes.memory, end), "status": lanes.status}
