"""Lanes: the state of the many runs that one kernel advances at once, and who looks at them.

An `Observer` says what is wanted of a run. A `Program` is all that is fixed when the kernel is
compiled for it.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..model.modes import Mode
from ..model.oscillator import Oscillator


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


class Program(eqx.Module):
    """What is fixed when the kernel is compiled."""

    structure: Any = eqx.field(static=True)
    mapped: tuple[bool, ...] = eqx.field(static=True)
    observer: Observer = eqx.field(static=True)
    edges: bool = eqx.field(static=True)
    #: Whether a run that a pseudo-focus captures ends there.
    captures: bool = eqx.field(static=True, default=True)


def once(flag: Array, one: Array) -> Array:
    """A flag that XLA computes once, not again in each place where it is used."""
    return jnp.where(flag, 1.0, 0.0) / one > 0
