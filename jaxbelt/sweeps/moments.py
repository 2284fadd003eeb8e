"""Moments at which a reducer is asked: events, extrema, crossings of a section, fixed times.

They stand in a reducer's attribute `at`, a tuple. A section is a function of the state, and its
moments are where the value passes 0; extrema are sections, too: x1 is extreme where x2 = 0, and x2
where x2' = 0.
"""

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import CodeType, FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import require
from ..model.modes import Mode, force_rounding, mode_acceleration
from ..model.oscillator import Oscillator


@dataclass(frozen=True)
class AtEvents:
    """Every event: stick, slip onset, crossing, contact edge."""


@dataclass(frozen=True)
class AtExtrema:
    """Every extremum of a coordinate; of: "x1" or "x2".

    Where x2 jumps from rising to falling at an event, that is an extremum; one that lasts for a
    stick phase is met at its end.
    """

    of: str

    def __post_init__(self):
        require(self.of in ("x1", "x2"), "of", '"x1" or "x2"', repr(self.of))


@dataclass(frozen=True, repr=False)
class AtSection:
    """Every crossing of a section.

    function: of the oscillator and scalars x1, x2, traced; its value passes 0 there. It has to be
    differentiable. direction: 1 where the value rises, -1 where it falls, 0 for both.
    """

    function: Any
    direction: int = 0

    def __post_init__(self):
        require(callable(self.function), "function", "a function of osc, x1 and x2", self.function)
        require(self.direction in (-1, 0, 1), "direction", "-1, 0 or 1", repr(self.direction))

    def __repr__(self) -> str:
        """The same for the same function, in any process: stores compare it."""
        told = repr(self.function)
        if isinstance(self.function, FunctionType):
            held = [cell.cell_contents for cell in self.function.__closure__ or ()]
            told = f"{bytecode(self.function.__code__)} {self.function.__defaults__} {held}"
        told = re.sub(r" at 0x[0-9a-fA-F]+", "", told)
        digest = hashlib.sha256(told.encode()).hexdigest()[:16]
        return f"AtSection({digest}, {self.direction})"


@dataclass(frozen=True)
class AtTimes:
    """Fixed times; times: increasing, >= 0, shape [n]; those after a run's end are left out."""

    times: Any

    def __post_init__(self):
        times = np.asarray(self.times, dtype=float)
        require(times.ndim == 1 and times.size > 0, "times", "of shape (n)", times.shape)
        fits = np.all(np.diff(times) > 0) and times[0] >= 0 and np.isfinite(times[-1])
        require(fits, "times", "finite, >= 0 and increasing", times)
        object.__setattr__(self, "times", tuple(times.tolist()))


def bytecode(code: CodeType) -> str:
    """What a compiled function does, without where it came from."""
    constants = [bytecode(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts]
    return f"{code.co_code.hex()} {code.co_names} {constants}"


MOMENTS = (AtEvents, AtExtrema, AtSection, AtTimes)


def checked(at: Any) -> tuple[Any, ...]:
    """The moments of a reducer, or a `ValueError`."""
    fits = isinstance(at, tuple) and at and all(isinstance(one, MOMENTS) for one in at)
    names = ", ".join(kind.__name__ for kind in MOMENTS)
    require(fits, "observe.at", f"a tuple of {names}", repr(at))
    return at


def per_lane(osc: Oscillator) -> Any:
    """The axes of `jax.vmap` for an oscillator of which some leaves differ from lane to lane."""
    return jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, osc)


def section_of(moment: AtSection | AtExtrema) -> Callable[..., Array]:
    """The function of (osc, mode, x1, x2), arrays [lanes], whose zeros are the moments."""
    if isinstance(moment, AtExtrema):
        return _velocity if moment.of == "x1" else _x2_rate
    function = moment.function

    def value(osc, mode, x1, x2):
        return jax.vmap(function, in_axes=(per_lane(osc), 0, 0))(osc, x1, x2)

    return value


def _velocity(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> Array:
    return x2


def _x2_rate(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> Array:
    """x2', and 0 where it is 0 but for rounding, as at slip onset; its derivative stays."""
    a = jnp.where(mode.any_stuck, 0.0, mode_acceleration(osc, mode, x1, x2))
    return jnp.where(jnp.abs(a) < force_rounding(x1), a - lax.stop_gradient(a), a)


def value_and_rate(
    function: Callable[..., Array], osc: Oscillator, mode: Mode, x1: Array, x2: Array
) -> tuple[Array, Array]:
    """A section's value and its derivative by time, along the field of the mode."""
    a = jnp.where(mode.any_stuck, 0.0, mode_acceleration(osc, mode, x1, x2))
    value, rate, *_ = jax.jvp(lambda x1, x2: function(osc, mode, x1, x2), (x1, x2), (x2, a))
    return value, rate


def side_of(value: Array, rate: Array, before: Array) -> Array:
    """The side of a section, 1 or -1: on it, where the motion goes; at rest on it, as before."""
    return jnp.where(value != 0, jnp.sign(value), jnp.where(rate != 0, jnp.sign(rate), before))


# --- within a step --------------------------------------------------------------------------------

#: A cut that would leave less of a step at one of its ends, over the step, is not made.
LEAST_CUT = 1e-3


def cut_of_step(side, starts, ends, h: Array, reach: Array) -> Array:
    """Where a step of size h should be cut for a section, from 0 to 1; 1: it may stay as it is.

    side: of the section, before the step; starts, ends: the section's value and rate at both ends;
    reach: an end that is nearer to a crossing than this time tells the crossing by a Taylor step.
    Between its ends the value is taken for the cubic that has these values and rates: the step is
    made again, and its end then is nearer, until it is near enough.
    """
    (g0, r0), (g1, r1) = starts, ends
    d0, d1 = h * r0, h * r1
    cubic = (g0, d0, 3 * (g1 - g0) - 2 * d0 - d1, d0 + d1 - 2 * (g1 - g0))
    crosses = side_of(g1, r1, side) != side
    near = (jnp.abs(g0) <= reach * jnp.abs(r0)) | (jnp.abs(g1) <= reach * jnp.abs(r1))
    root = _bisected(lambda theta: _polynomial(cubic, theta), side)
    # A value that comes near to 0 and goes away again may have crossed twice.
    nears = ~crosses & (side * d0 < 0) & (side * d1 > 0)
    derivative = (d0, 2 * cubic[2], 3 * cubic[3])
    extremum = _bisected(lambda theta: -_polynomial(derivative, theta), side)
    least = side * _polynomial(cubic, extremum)
    doubt = 0.1 * jnp.maximum(side * g0 - least, side * g1 - least)
    inside = (extremum > LEAST_CUT) & (extremum < 1 - LEAST_CUT)
    theta = jnp.where(crosses & ~near, root, 1.0)
    theta = jnp.where(nears & (least < doubt) & inside, extremum, theta)
    # Where a section is only touched, no end is ever near; the step is then as short as `reach`.
    return lax.stop_gradient(jnp.where(h > 0.1 * reach, theta, 1.0))


def _polynomial(coefficients: Sequence[Array], theta: Array) -> Array:
    total = jnp.zeros_like(theta)
    for k in reversed(coefficients):
        total = total * theta + k
    return total


def _bisected(function: Callable[[Array], Array], side: Array) -> Array:
    """Where in (0, 1) the function is no longer on that side."""

    def halve(_, ends):
        low, high = ends
        middle = 0.5 * (low + high)
        still = side * function(middle) > 0
        return jnp.where(still, middle, low), jnp.where(still, high, middle)

    ends = jnp.zeros_like(side), jnp.ones_like(side)
    return lax.fori_loop(0, 50, halve, ends)[1]


def root_between(function: Callable[[Array], Array], side: Array) -> Array:
    """The same, for a function that is given and no interpolant."""
    return lax.stop_gradient(_bisected(function, side))
