"""Moments at which a reducer is updated: events, extrema, crossings of a section, fixed times.

A reducer lists them in its attribute `at`, a tuple. A section is a function of the state, and its
moments are where the value passes 0; extrema are sections, too: x1 is extreme where x2 = 0, and x2
where x2' = 0.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import as_array, require, require_callable, require_one_of, require_value
from ..model.forcing import Oscillating
from ..model.modes import Mode, mode_acceleration, without_rounding
from ..model.oscillator import Oscillator, clock_frequency, has_clock
from ..numerics.polynomials import derivative, polynomial, quintic
from .observers import as_given


@dataclass(frozen=True)
class AtEvents:
    """Every event: stick, slip onset, crossing, contact edge."""


@dataclass(frozen=True)
class AtExtrema:
    """Every extremum of a coordinate.

    An event at which x2 turns from rising to falling, or back, is an extremum of x2; an extremum
    that lasts for a stick phase is reported at the end of the phase.

    Attributes:
        of: "x1" or "x2".
    """

    of: str

    def __post_init__(self):
        require_one_of(self.of, ("x1", "x2"), "of")


@dataclass(frozen=True)
class AtSection:
    """Every crossing of a section.

    Attributes:
        function: Function of the oscillator and scalars x1, x2, traced; its value passes 0 at a
            crossing. It has to be smooth wherever runs come, also across boundaries of belts: a
            jump, such as the sign of a relative velocity or `jnp.where`, is no passage, and a run
            that comes to it may end there, with the status TOO_MANY_STEPS.
        direction: 1 where the value rises, -1 where it falls, 0 for both.
    """

    function: Any
    direction: int = 0

    def __post_init__(self):
        require_callable(self.function, "function", "a function of osc, x1 and x2")
        require_value(self.direction in (-1, 0, 1), "direction", "-1, 0 or 1", self.direction)


@dataclass(frozen=True)
class AtTimes:
    """Fixed times; those after a run's end are left out.

    Attributes:
        times: Increasing, >= 0, shape [n].
    """

    times: Any

    def __post_init__(self):
        try:
            times = np.asarray(self.times, dtype=float)
        except (TypeError, ValueError):
            times = np.zeros(0)
        require_value(times.ndim == 1 and times.size > 0, "times", "numbers, [n]", self.times)
        fits = np.all(np.diff(times) > 0) and times[0] >= 0 and np.isfinite(times[-1])
        require_value(fits, "times", "finite, >= 0 and increasing", times)
        object.__setattr__(self, "times", tuple(times.tolist()))

    def next_time(self, osc: Oscillator, passed: Array) -> Array:
        """The next time when `passed` of the times are past; inf when all are past."""
        return jnp.asarray((*self.times, np.inf))[jnp.minimum(passed, len(self.times))]

    def passed_at(self, osc: Oscillator, t: Array, count: Array) -> Array:
        """Number of times before the start t of runs, of the type of `count`; 0 without a clock."""
        if not has_clock(osc):
            return jnp.zeros_like(count)
        early = [jnp.where(time < t, 1, 0) for time in self.times]
        return functools.reduce(jnp.add, early, jnp.zeros_like(count)).astype(count.dtype)


@dataclass(frozen=True)
class AtPhase:
    """Once in each period of the forcing: a stroboscopic section.

    The moments are the times t at which Omega t is the phase up to whole turns, Omega the frequency
    of the first force whose frequency is not 0, or, without one, of the first velocity or load that
    oscillates. So the phase 0 is at t = 0.

    Attributes:
        phase: An angle.

    Example:
        diagram = jb.orbit_diagram(osc, where, (1.6, 1.8), at=jb.AtPhase())
    """

    phase: float = 0.0

    def __post_init__(self):
        phase = float(as_array(self.phase, "phase"))
        require_value(np.isfinite(phase), "phase", "a finite angle", self.phase)
        object.__setattr__(self, "phase", phase)

    def next_time(self, osc: Oscillator, passed: Array) -> Array:
        """The time of moment number `passed`; at moment 0 Omega t is the phase itself."""
        frequency = clock_frequency(osc)
        return (self.phase + 2 * np.pi * passed.astype(frequency.dtype)) / frequency

    def passed_at(self, osc: Oscillator, t: Array, count: Array) -> Array:
        """Number of the first moment at t or later, of the type of `count`."""
        turns = (clock_frequency(osc) * t - self.phase) / (2 * np.pi)
        return jnp.ceil(turns - 1e-12 * (1 + jnp.abs(turns))).astype(count.dtype)


MOMENTS = (AtEvents, AtExtrema, AtSection, AtTimes, AtPhase)


def checked(at: Any) -> tuple[Any, ...]:
    """Returns the moments of a reducer, or raises a `ValueError`."""
    fits = isinstance(at, tuple) and at and all(isinstance(one, MOMENTS) for one in at)
    names = ", ".join(kind.__name__ for kind in MOMENTS)
    require_value(fits, "observe.at", f"a tuple of {names}", at)
    return at


def check_moments(at: tuple[Any, ...], osc: Oscillator) -> None:
    """Raises a `ValueError` where a moment is not possible for the oscillator."""
    clock = has_clock(osc)
    steady = not any(isinstance(belt.velocity, Oscillating) for belt in osc.belts)
    for moment in at:
        expected = "AtEvents() alone where the velocity of a belt oscillates"
        require(steady or isinstance(moment, AtEvents), "at", expected, repr(moment))
        if isinstance(moment, AtPhase):
            require(clock, "at", "for an oscillator without forcing no AtPhase", repr(moment))
        if isinstance(moment, AtExtrema) and moment.of == "x2":
            expected = 'AtExtrema("x1") or a section: extrema of x2 are for those without a clock'
            require(not clock, "at", expected, repr(moment))


def section_of(moment: AtSection | AtExtrema) -> Callable[..., Array]:
    """The function of (osc, mode, x1, x2), arrays [lanes], whose zeros are the moments."""
    if isinstance(moment, AtExtrema):
        return _velocity if moment.of == "x1" else _x2_rate
    function = moment.function

    def value(osc, mode, x1, x2):
        return as_given(function, osc, x1, x2)

    return value


def _velocity(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> Array:
    return x2


def _x2_rate(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> Array:
    a = jnp.where(mode.any_stuck, 0.0, mode_acceleration(osc, mode, x1, x2))
    return without_rounding(a, x1)


def value_and_rate(
    function: Callable[..., Array], osc: Oscillator, mode: Mode, x1: Array, x2: Array, a: Array
) -> tuple[Array, Array]:
    """Value of a section and its derivative by time, where x2' = a."""
    value, rate, *_ = jax.jvp(lambda x1, x2: function(osc, mode, x1, x2), (x1, x2), (x2, a))
    return value, rate


def side_of(value: Array, rate: Array, before: Array) -> Array:
    """Side of a section, 1 or -1.

    Where the value is 0 it is the side that the motion goes to; where the rate is 0, too, `before`.
    """
    return jnp.where(value != 0, jnp.sign(value), jnp.where(rate != 0, jnp.sign(rate), before))


# --- where a section is crossed -------------------------------------------------------------------

#: Number of equal parts of a step, and of a stick phase, in which crossings of a section are
#: searched. In a part with at most one extremum of the value all crossings are found.
PARTS_OF_STEP, PARTS_OF_HOLD = 4, 8
#: Smallest part of a step that a cut may leave at one of its ends.
LEAST_CUT = 1e-3


class Course(NamedTuple):
    """The state along a step or a stick phase, for theta from 0 to 1, arrays [lanes].

    Attributes:
        x1: Coefficients of a polynomial in theta.
        x2: The constant velocity of a stick phase; None for a step: x2 follows from x1.
        duration: Duration of the step or phase.
    """

    x1: tuple[Array, ...]
    x2: Array | None
    duration: Array

    @classmethod
    def of_step(cls, starts, ends, h: Array) -> "Course":
        """The quintic through starts and ends, (x1, x2, x2') each, of a step of size h."""
        start, end = ((x1, h * x2, h * h * a) for x1, x2, a in (starts, ends))
        return cls(quintic(start, end), None, h)

    def velocity(self, theta) -> tuple[Array, Array]:
        """x2 within a step, and its derivative by theta."""
        slopes = derivative(self.x1)
        h = jnp.where(self.duration > 0, self.duration, 1.0)
        return polynomial(slopes, theta) / h, polynomial(derivative(slopes), theta) / h

    def sample(self, function, osc, mode, theta) -> tuple[Array, Array]:
        """Value of a section, and its derivative by theta."""
        x1, slope = (polynomial(one, theta) for one in (self.x1, derivative(self.x1)))
        if self.x2 is not None:
            x2, bend = self.x2, jnp.zeros_like(x1)
        else:
            x2, bend = self.velocity(theta)
        state, tangents = (x1, x2), (slope, bend)
        value, rate, *_ = jax.jvp(lambda x1, x2: function(osc, mode, x1, x2), state, tangents)
        return value, rate


class Parts(NamedTuple):
    """Samples of a section at the ends of equal parts of a course, lists of arrays [lanes].

    Attributes:
        values: Values of the section, one more than there are parts.
        slopes: Derivatives by theta, likewise.
        sides: Sides, likewise; the first one is that before the course.
        crosses: Whether the side changes in a part.
        dips: Whether the value comes nearer to 0 in a part and goes away again, so that it may pass
            0 twice.
    """

    values: list[Array]
    slopes: list[Array]
    sides: list[Array]
    crosses: list[Array]
    dips: list[Array]

    @classmethod
    def of(cls, samples: Sequence[tuple[Array, Array]], side: Array) -> "Parts":
        values, slopes = (list(part) for part in zip(*samples, strict=True))
        sides = [side]
        for value, slope in zip(values[1:], slopes[1:], strict=True):
            sides.append(side_of(value, slope, sides[-1]))
        pairs = list(pairwise(range(len(values))))
        crosses = [sides[i] != sides[j] for i, j in pairs]
        dips = [
            ~cross & (sides[i] * slopes[i] < 0) & (sides[i] * slopes[j] > 0)
            for cross, (i, j) in zip(crosses, pairs, strict=True)
        ]
        return cls(values, slopes, sides, crosses, dips)


class Cut(NamedTuple):
    """Where a step should be cut for a section.

    theta: fraction of the step to keep; 1: no cut is needed. at_start: whether the cut step crosses
    the section near its start, not near its end.
    """

    theta: Array
    at_start: Array


def cut_of_step(side: Array, samples: Sequence[tuple[Array, Array]], h: Array, reach: Array) -> Cut:
    """Where a step of size h should be cut, so that it crosses a section at most once, near an end.

    Within a part the value is approximated by the cubic through its values and slopes: the step is
    repeated and ends nearer to the crossing each time, until it is near enough.

    Args:
        side: Side of the section before the step.
        samples: Value and derivative by theta at the ends of the parts, from the interpolant.
        h: Size of the step.
        reach: Time from an end of the step within which a Taylor step finds a crossing.
    """
    side, samples, h, reach = lax.stop_gradient((side, samples, h, reach))
    parts = Parts.of(samples, side)
    n = len(parts.crosses)
    depth = functools.reduce(jnp.maximum, [side * value for value in parts.values])
    found, picked = [], None
    for k in reversed(range(n)):
        cubic = _cubic(parts, k, 1 / n)
        extremum = _extremum_of(cubic)
        least = parts.sides[k] * polynomial(cubic, extremum)
        place = (k + extremum) / n
        inside = (place > LEAST_CUT) & (place < 1 - LEAST_CUT)
        # The interpolant is not exact: a value that comes near to 0 may pass it.
        dips = parts.dips[k] & (least < 0.1 * (depth - least)) & inside
        here = parts.crosses[k] | dips
        one = (jnp.full_like(h, k), parts.sides[k], parts.crosses[k], place, *cubic)
        picked = (
            one if picked is None else tuple(map(functools.partial(jnp.where, here), one, picked))
        )
        found.append(here)
    assert picked is not None
    k, at_part, crosses, extremum, *cubic = picked
    root = (k + _bisected(lambda theta: polynomial(cubic, theta), at_part)) / n
    count = sum(here.astype(jnp.int32) for here in found)

    (g0, r0), (g1, r1) = samples[0], samples[-1]
    near = reach / jnp.where(h > 0, h, 1.0)
    at_start = parts.crosses[0] & (side * r0 < 0) & (jnp.abs(g0) <= near * jnp.abs(r0))
    at_end = parts.crosses[-1] & (parts.sides[-1] * r1 > 0) & (jnp.abs(g1) <= near * jnp.abs(r1))
    stays = (count == 0) | ((count == 1) & (at_start | at_end))
    # For a crossing near the start the step is cut to its first part.
    theta = jnp.where(crosses, jnp.where(at_start, 1 / n, root), extremum)
    # Where a section is only touched, no end is ever near; cuts stop at steps of 0.1 `reach`.
    theta = jnp.where(stays | (h <= 0.1 * reach), 1.0, theta)
    nearer = jnp.abs(g0 * r1) < jnp.abs(g1 * r0)
    return Cut(theta, at_start | (~at_end & nearer))


def crossings_held(
    sample: Callable[[Array], tuple[Array, Array]], side: Array, direction: int, holds: Array
) -> tuple[Array, Array, Array]:
    """Crossings of a section in stick phases: at most two in each of `PARTS_OF_HOLD` parts.

    x1 is linear in theta, so all are found if the value has at most one extremum in a part; else
    pairs of crossings may be missed.

    Args:
        sample: sample(theta) is the value and its derivative by theta, for theta from 0 to 1.
        side: Side before the phase.
        direction: Direction of the crossings to find, 0 for both.
        holds: Lanes that stick.

    Returns:
        The side at the end, [lanes], and theta of the first and of the second crossing in each
        part, both [parts, lanes], inf where there is none.
    """
    n = PARTS_OF_HOLD
    samples = [sample(jnp.full_like(side, k / n)) for k in range(n + 1)]
    parts = Parts.of(samples, side)
    sides = jnp.stack(parts.sides[:-1])
    dips = jnp.stack([dip & holds for dip in parts.dips])
    some = jnp.stack([cross & holds for cross in parts.crosses]) | dips
    numbers = jnp.arange(n)
    none = jnp.full(sides.shape, jnp.inf)

    def following(i):
        later = jnp.any(some, axis=1) & (numbers >= i)
        return jnp.where(jnp.any(later), jnp.argmax(later), n)

    def search(state):
        i, first, second = state
        here = (numbers == i)[:, None]
        start = jnp.sum(jnp.where(here, sides, 0.0), axis=0)
        dip = jnp.any(here & dips, axis=0)

        def at(theta):
            return sample((i.astype(theta.dtype) + theta) / n)

        extremum = _bisected(lambda theta: -at(theta)[1], start)
        twice = dip & (start * at(extremum)[0] < 0)
        end = jnp.where(twice, extremum, 1.0)
        root = end * _bisected(lambda theta: at(end * theta)[0], start)
        back = end + (1 - end) * _bisected(lambda theta: at(end + (1 - end) * theta)[0], -start)
        once = jnp.any(here & some, axis=0) & (~dip | twice)
        once, twice = once & (start * direction <= 0), twice & (start * direction >= 0)
        root, back = ((i.astype(theta.dtype) + theta) / n for theta in (root, back))
        first = jnp.where(here & once[None], root[None], first)
        second = jnp.where(here & twice[None], back[None], second)
        return following(i + 1), first, second

    start = following(jnp.zeros((), int)), none, none
    _, first, second = lax.while_loop(lambda state: state[0] < n, search, start)
    return jnp.where(holds, parts.sides[-1], side), first, second


def _cubic(parts: Parts, k: int, length: float) -> tuple[Array, ...]:
    """Coefficients of the cubic through the values and slopes at both ends of a part."""
    g0, g1 = parts.values[k], parts.values[k + 1]
    d0, d1 = length * parts.slopes[k], length * parts.slopes[k + 1]
    return g0, d0, 3 * (g1 - g0) - 2 * d0 - d1, d0 + d1 - 2 * (g1 - g0)


def _extremum_of(cubic: Sequence[Array]) -> Array:
    """Extremum in [0, 1] of a cubic whose slope changes its sign there; else 1."""
    _, d0, c2, c3 = cubic
    d1 = d0 + 2 * c2 + 3 * c3
    divisor = jnp.sign(d0) * jnp.sqrt(jnp.maximum(c2 * c2 - 3 * c3 * d0, 0.0)) - c2
    safe = (d0 * d1 < 0) & (divisor != 0)
    return jnp.where(safe, jnp.clip(d0 / jnp.where(safe, divisor, 1.0), 0.0, 1.0), 1.0)


def _bisected(function: Callable[[Array], Array], side: Array) -> Array:
    """Place in (0, 1), by bisection, where the function leaves the given side."""

    def halve(_, ends):
        low, high = ends
        middle = 0.5 * (low + high)
        still = side * function(middle) > 0
        return jnp.where(still, middle, low), jnp.where(still, high, middle)

    ends = jnp.zeros_like(side), jnp.ones_like(side)
    return lax.fori_loop(0, 50, halve, ends)[1]
