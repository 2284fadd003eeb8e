"""Lanes: the state of the runs that one kernel advances together, and the base of its observers.

An `Observer` says which results a run hands in and when it may end. A `Program` is everything that
is fixed when the kernel is compiled.
"""

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..model.modes import Mode
from ..model.own_units import OwnOscillator
from ..numerics.compiling import where_any
from ..numerics.widths import is_cpu

#: Lanes that `in_few` serves at once: of 128 some thirty come to an event in four steps, and as one
#: force drives them all, at times more; a lane that is not served waits for the next four steps.
SERVED = 48
#: Larger states are taken for unbounded growth. Conti's law cubes the velocity, which overflows
#: above 5.6e102: steps would become ever smaller there.
GROWN = 1e100


class Lanes(eqx.Module):
    """The state of all lanes, arrays [lanes].

    run: number of the run, -1 for none; first_pass: the pass of the kernel's loop in which it
    began; t, x1, x2, a: time, state and x2'; h: next step size, negative where the lane has landed
    on a bound of its mode and waits for `events.pass_events`; pace: inverse of the largest step
    that the last error would have allowed; mode; events: how many there were; status; done. lower,
    upper: extrema of x2 since the observer reset them, where it asks for extrema. memory: of the
    observer. integrals: of the rates that the observer gives to the steps, see `Observer.follow`,
    from 0 to t. hit: with a clock, the guard that a lane has landed on, as numbered in `instants`,
    or that its stick phase ends at, or -1; until: the time when that phase ends, see `holds`.
    """

    run: Array
    first_pass: Array
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
    integrals: Any = None
    hit: Any = None
    until: Any = None


class Passage(eqx.Module):
    """What one call of `events.pass_events` did to the lanes, arrays [lanes].

    landed: the last step ended on a guard or where x2 = 0. fired: it ended on a guard; number: of
    that guard, see `guard_passed`; before, mode: the modes on both sides of the guard; t, x1, x2:
    where it was passed. captured: by a pseudo-focus. rests: at rest up to rounding. stuck: a stick
    phase followed; duration: of that phase; released: the phase ended before t1, by slip onset or
    at an edge; forever: it never ends.
    """

    landed: Array
    fired: Array
    number: Array
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
    forever: Array


def choose(condition: Array, on_true: Any, on_false: Any) -> Any:
    """One of two trees of arrays [lanes, ...], lane by lane; condition: [lanes]."""

    def pick(a, b):
        return jnp.where(condition.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return jax.tree.map(pick, on_true, on_false)


def are_finite(lanes: Lanes) -> Array:
    """Mask of the lanes whose state and x2' are numbers, below `GROWN` in size."""
    return (jnp.abs(lanes.x1) < GROWN) & (jnp.abs(lanes.x2) < GROWN) & (jnp.abs(lanes.a) < GROWN)


def code_of(mode: Mode) -> Array:
    """A mode as one number, whose digits to the base 5 are its contact codes plus 2."""
    total = jnp.zeros(())
    for i, code in enumerate(mode.codes):
        total = total + (code + 2) * 5.0**i
    return total


def codes_in(number: Array, belts: int) -> list[Array]:
    """The contact codes, one a belt, of a number that `code_of` made."""
    codes = []
    for _ in range(belts):
        codes.append(number % 5 - 2)
        number = number // 5
    return codes


def in_few(flags: Array, function: Callable[..., Any], args: Any, otherwise: Any) -> Any:
    """function(*args) in the first `SERVED` lanes that have a flag, and `otherwise` in the others.

    Pays where the function costs more than picking lanes out. On accelerators, or with few lanes,
    all flagged lanes are served. args: trees of numbers and arrays [lanes].
    """
    if not is_cpu() or flags.size <= 2 * SERVED:
        return choose(flags, where_any(flags, lambda: function(*args), otherwise), otherwise)
    rank = jnp.cumsum(flags.astype(jnp.int32))
    chosen = flags & (rank <= SERVED)

    def of_few():
        source = jnp.searchsorted(rank, jnp.arange(1, SERVED + 1, dtype=jnp.int32))
        part = jax.tree.map(lambda x: x.at[source].get(mode="clip") if jnp.ndim(x) else x, args)
        place = jnp.clip(rank - 1, 0, SERVED - 1)
        return jax.tree.map(lambda x: x[place], function(*part))

    return choose(chosen, where_any(chosen, of_few, otherwise), otherwise)


def materialise(value: Array, ones: Array) -> Array:
    """The value, computed once; ones: an array of ones, an argument of the kernel.

    XLA on the CPU computes cheap values, and all that they depend on, again in each place that uses
    them. It holds a division to be expensive and keeps its result; dividing by ones that it does
    not know to be ones changes no bit.
    """
    if value.dtype == bool:
        return jnp.where(value, 1.0, 0.0) / ones > 0
    return value / ones


@dataclass(frozen=True)
class Variable:
    """Description of a result.

    per_belt: whether it has a number a belt. A category is an integer and has meanings, from values
    to names; or name_of(code, belts), if its codes are numbered only when all runs are known.
    dimension: see `dimensions.quantity`; None where there is none, or only its author knows it.
    """

    long_name: str
    dtype: str = "float64"
    per_belt: bool = False
    meanings: Mapping[int, str] | None = None
    name_of: Callable[[int, int], str] | None = None
    dimension: str | None = None


class Observer(eqx.Module):
    """What a run hands in, and when it may end early: subclasses are static settings.

    variables: descriptions of the results, by name, in the order in which datasets show them.
    steps_while_stuck: whether stick phases under a clock are stepped through, for observers that
    look at times within them; else they are passed at once, as those without a clock always are.
    """

    variables: ClassVar[Mapping[str, Variable]] = {}
    steps_while_stuck: ClassVar[bool] = False

    def extrema(self, lanes: Lanes) -> Array | None:
        """Mask of the lanes whose steps are to end at extrema of x2; None: no lanes."""
        return None

    @abc.abstractmethod
    def start(self, osc: OwnOscillator, lanes: Lanes) -> Any:
        """The memory of runs that begin, a tree of arrays [lanes].

        lanes: at their starts, memory None.
        """

    def integrals(self, osc: OwnOscillator, lanes: Lanes) -> Any:
        """The integrals of runs that begin, a tree of zeros [lanes]; None: no integrals."""
        return None

    def follow(
        self, take_step: Callable, osc, window, ones: Array, lanes: Lanes, t1, rtol, atol
    ) -> Lanes:
        """The lanes after `step.take_step`; for observers that look between the events."""
        return take_step(osc, window, ones, lanes, t1, rtol, atol)

    @abc.abstractmethod
    def watch(
        self, osc: OwnOscillator, lanes: Lanes, passage: Passage, ones: Array, t1: Array, tol: Array
    ) -> Lanes:
        """The lanes after `events.pass_events`, before the next steps.

        lanes: after the call; passage: what it did. ones: for `materialise`; t1: the runs' end;
        tol: the relative tolerance of a step; scalars. Returns `lanes` with a new `memory`, and
        with `done` where a run may end; lanes whose run is -1, or that are done, may hold anything.
        """

    def watch_rarely(self, osc: OwnOscillator, lanes: Lanes, ones: Array) -> Lanes:
        """The lanes before each refill, every dozen steps or so; for costly checks."""
        return lanes

    @abc.abstractmethod
    def finish(self, osc: OwnOscillator, lanes: Lanes) -> dict[str, Any]:
        """The results of runs that ended, by the names in `variables`.

        Arrays [lanes, ...], or tuples of arrays [lanes]; the entries of other lanes are not used.
        """


class Program(eqx.Module):
    """Everything that is fixed when the kernel is compiled.

    structure: that of the oscillator's tree; mapped: which leaves differ from run to run; edges:
    whether a contact edge may be met; captures: whether a run ends where a pseudo-focus captures
    it; derivatives: whether derivatives of the results are computed, too; own_t0: whether each run
    begins at a time of its own, a column of the queue behind x1 and x2. made_of: distinguishes
    programs whose user code is the same, but reads different values.
    """

    structure: Any = eqx.field(static=True)
    mapped: tuple[bool, ...] = eqx.field(static=True)
    observer: Observer = eqx.field(static=True)
    edges: bool = eqx.field(static=True)
    captures: bool = eqx.field(static=True, default=True)
    derivatives: bool = eqx.field(static=True, default=False)
    own_t0: bool = eqx.field(static=True, default=False)
    made_of: Any = eqx.field(static=True, default=None)

    @property
    def columns(self) -> int:
        """How many columns the queue has: starts, and the leaves that differ from run to run."""
        return 2 + self.own_t0 + sum(self.mapped)
