"""`design`: parameters for which a cycle, or a forced periodic motion, meets given targets.

Damped Newton steps on functionals of the cycle, within bounds.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

from ..activity import announced
from ..bifurcations.base import AbstractCondition, check_conditions
from ..bifurcations.refine import refine
from ..checks import (
    as_finite,
    as_numbers,
    outside_of_traces,
    require,
    require_callable,
    require_value,
    shape_in_words,
    traceable,
)
from ..cycles.clocked import turns_of
from ..cycles.cycle import Cycle, cycle_from, cycle_of_zeros
from ..cycles.periodic import PeriodicMotion, nothing_found
from ..cycles.reached import motion_reached
from ..model.oscillator import Oscillator, check_oscillator, frequencies, has_clock, refuse_clock
from ..model.parameters import leaf_index
from ..numerics.compiling import jit
from ..results import Status, describe, draw
from ..tables import table_of
from .margins import BasinMargin
from .selection import ITERATIONS, LONGEST_CHANGE, Selection, progress_reporter, selection_of

if TYPE_CHECKING:
    import pandas

#: A target counts as met if the miss is less than this fraction of the target, or of the value of
#: the first cycle where that is larger; of 1 where both are 0.
MET = 1e-9


class Design(eqx.Module):
    """Parameters for which functionals of the cycle meet their targets; what `design` returns.

    Attributes:
        oscillator: The designed oscillator.
        cycle: Its cycle; of a forced one its `PeriodicMotion`.
        names: Names of the parameters, in the order of `where`.
        values: Their values, [p].
        achieved: Values of the functionals, [targets].
        targets: Target values, [targets]; for an interval its nearer end, or the achieved value
            where that is inside.
        iterations: Number of Newton steps.
        status: OK; UNREACHABLE, where the nearest design that was found is returned; or the reason
            why there is no cycle to begin with.
    """

    oscillator: Oscillator
    cycle: Cycle | PeriodicMotion
    names: tuple[str, ...] = eqx.field(static=True)
    values: Array
    achieved: Array
    targets: Array
    iterations: int
    status: Array

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each parameter, then one for each target, in order.

        Columns: what ("parameter" or "target"), name, value (of a target: what was achieved),
        wanted (NaN for a parameter).
        """
        count = len(self.targets)
        return table_of(
            {
                "what": ["parameter"] * len(self.names) + ["target"] * count,
                "name": [*self.names, *(f"target {i}" for i in range(count))],
                "value": np.concatenate([self.values, self.achieved]),
                "wanted": np.concatenate([np.full(len(self.names), np.nan), self.targets]),
            }
        )

    def plot(self, ax: Any = None) -> Any:
        """Draws the designed cycle, see `Cycle.plot` and `PeriodicMotion.plot`.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        status = Status(int(self.status))
        chosen = ", ".join(f"{n} = {float(v):.12g}" for n, v in zip(self.names, self.values))
        rows = [
            f"  achieved {float(a):.12g}, wanted {float(b):.12g}, off by {float(a - b):+.1e}"
            for a, b in zip(self.achieved, self.targets)
        ]
        advice = [] if status == Status.OK else [f"  {describe(status)}"]
        head = f"Design({status.name}: {chosen}; {self.iterations} iterations)"
        return "\n".join([head, *rows, *advice])


@dataclass(frozen=True, eq=False)
class _BifurcationMargin:
    """The functional that `distance_to` returns."""

    conditions: tuple[AbstractCondition, ...]
    where: Callable[[Oscillator], Any]

    def check(self, osc: Oscillator) -> None:
        """Raises a `ValueError` where an oscillator has no such parameter or condition."""
        leaf_index(osc, self.where)
        for condition in self.conditions:
            condition.check(osc)
            condition.applied_to(osc)

    def __call__(self, cycle: Cycle | PeriodicMotion) -> Array:
        osc = cycle.oscillator
        value = jax.tree.leaves(osc)[leaf_index(osc, self.where)]
        # Points of a forced oscillator are found from one of its motions.
        start = cycle if isinstance(cycle, PeriodicMotion) else None
        distances = []
        for condition in self.conditions:
            point = refine(condition, osc, where=self.where, start=lax.stop_gradient(start))
            found = point.status == Status.OK
            distances.append(
                jnp.where(found, jnp.abs(jnp.where(found, point.value, 0.0) - value), jnp.inf)
            )
        return functools.reduce(jnp.minimum, distances)


def distance_to(
    *conditions: AbstractCondition, where: Callable[[Oscillator], Any]
) -> Callable[[Cycle | PeriodicMotion], Array]:
    """A functional for `design`: distance of a parameter to the nearest of some bifurcations.

    Each point is found by `refine` from the oscillator of the cycle; a point that is not found
    counts as infinitely far.

    Args:
        conditions: Conditions such as `jb.NonsmoothFold(belt=1)`; for a forced oscillator those of
            forced motions, such as `jb.PeriodDoubling()`.
        where: Selects the parameter.

    Returns:
        A function of a `Cycle`, or of a `PeriodicMotion` (not under `jax.jit` and `jax.vmap`).

    Raises:
        ValueError: If there is no condition, or `where` is no function.
    """

    require(len(conditions) > 0, "conditions", "one or more, such as jb.Hopf()", "none")
    check_conditions(conditions)
    require_callable(where, "where", "a function such as `lambda osc: osc.belts[0].velocity`")
    return _BifurcationMargin(conditions, where)


@announced("design")
@outside_of_traces
def design(
    oscillator: Oscillator,
    targets: Sequence[Any],
    *,
    where: Callable[[Oscillator], Any],
    bounds: Sequence[Any] | None = None,
    y0: ArrayLike | tuple = (3.0, 0.0),
    report: Callable[[str], None] | None = None,
) -> Design:
    """Parameters for which functionals of the cycle have given values.

    The method is Newton's, damped, with exact derivatives; with fewer targets than parameters it
    takes the shortest steps. The status is UNREACHABLE where these steps find no choice within the
    bounds that meets the targets: the returned design may be the best only locally, and targets may
    lie behind a bifurcation at which the cycle vanishes. Then begin with another oscillator.

    For a forced oscillator the cycle is the stable `PeriodicMotion` that y0 leads to. It is
    followed: each trial starts on the motion of the last accepted trial. A trial that leads to no
    periodic motion, as in chaos, is not accepted.

    Args:
        oscillator: The oscillator to begin with; it needs a cycle.
        targets: Pairs of a functional of the `Cycle`, such as `jb.amplitude` or `lambda c:
            jb.stick_duration(c, 1)`, and its value, or an interval (lower, upper). The functional
            `distance_to` keeps a bifurcation away; `distance_to_basin_boundary` lets the cycle
            withstand shocks (without forcing only). Of a forced motion `lambda motion:
            abs(motion.multipliers[0])` is how much it attracts.
        where: Selects the parameters that may change, as for `fit`.
        bounds: Their bounds, as for `fit`.
        y0: Start (x1, x2) that leads to the cycle, shape [2]; of a forced oscillator at t = 0.
        report: Function that is called with lines on the progress, such as `print`.

    Returns:
        The `Design`.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    check_oscillator(oscillator, "oscillator")
    y0 = as_finite(y0, "y0", (2,))
    functionals, intervals = _checked_targets(targets)
    for functional in functionals:
        _check_functional(functional, oscillator)
    note = progress_reporter(report)
    selection, u = selection_of(oscillator, where, bounds)
    if has_clock(oscillator):
        _check_frequencies(oscillator, selection, u)

    def evaluate(u, y0):
        u = jnp.asarray(u)
        beside = selection.put(oscillator, selection.values(u))
        ready = tuple(f.at(beside, y0) if isinstance(f, BasinMargin) else f for f in functionals)
        # Forced motions are found outside of compiled programs.
        achieved = _achieved if has_clock(oscillator) else _achieved_in_one
        return achieved(ready, selection, oscillator, y0, u)

    def start_of(cycle):
        return cycle.start if isinstance(cycle, PeriodicMotion) else y0

    def wanted_near(achieved):
        # Where the achieved value is NaN, only a target that is one value is known.
        single = np.where(np.ptp(intervals, axis=1) == 0, intervals[:, 0], np.nan)
        return np.where(np.isnan(achieved), single, np.clip(achieved, *intervals.T))

    def off(achieved):
        # A distance may be infinite, and so may its target: then the miss is 0.
        wanted, away = wanted_near(achieved), np.zeros(len(sizes))
        np.subtract(achieved, wanted, where=achieved != wanted, out=away)
        return away / sizes, wanted

    def improved(slopes, miss, damping):
        matrix = np.nan_to_num(np.where(miss[:, None] != 0, slopes / sizes[:, None], 0.0))
        gram = matrix @ matrix.T
        # Damping vanishes with the miss, for quadratic convergence.
        damping = damping * np.max(gram) * np.max(np.abs(miss)) + 1e-14
        step = -matrix.T @ np.linalg.solve(gram + damping * np.eye(len(miss)), miss)
        return u + step * min(1.0, LONGEST_CHANGE / max(np.max(np.abs(step)), 1e-300))

    achieved, slopes, cycle = evaluate(u, y0)
    # The units of misses; for an interval its nearer end counts.
    known = np.stack([np.asarray(achieved), wanted_near(np.asarray(achieved))])
    largest = np.max(np.abs(np.where(np.isfinite(known), known, 0.0)), axis=0)
    sizes = np.where(largest > 0, largest, 1.0)
    miss, wanted = off(np.asarray(achieved))
    damping, iterations, idle = 1e-3, 0, 0
    while iterations < 2 * ITERATIONS and idle < 5:
        if not np.all(np.isfinite(miss)) or np.max(np.abs(miss)) < MET or damping > 1e8:
            break
        new = improved(np.asarray(slopes), miss, damping)
        trial = evaluate(new, start_of(cycle))
        new_miss, new_wanted = off(np.asarray(trial[0]))
        iterations += 1
        gain = 1 - np.linalg.norm(new_miss) / np.linalg.norm(miss)
        if gain > 0:
            u, (achieved, slopes, cycle), miss, wanted = new, trial, new_miss, new_wanted
            damping, idle = max(damping / 4, 1e-12), idle + 1 if gain < 1e-5 else 0
            note(f"step {iterations}: off by {np.max(np.abs(miss)):.1e}")
        else:
            damping *= 10
    values = selection.values(jnp.asarray(u))
    met = np.all(np.isfinite(miss)) and np.max(np.abs(miss)) < MET
    status = int(cycle.status) or (Status.OK if met else Status.UNREACHABLE).value
    return Design(
        oscillator=selection.put(oscillator, values),
        cycle=cycle,
        names=selection.names,
        values=values,
        achieved=jnp.asarray(achieved),
        targets=jnp.asarray(wanted),
        iterations=iterations,
        status=jnp.asarray(status),
    )


def _achieved(functionals, selection: Selection, osc: Oscillator, y0, u):
    """Functionals of the cycle (NaN where there is none), their derivatives, and the cycle."""
    reached = motion_reached if has_clock(osc) else cycle_from

    def achieved(u):
        cycle = reached(selection.put(osc, selection.values(u)), y0)
        values = jnp.stack([functional(cycle) for functional in functionals])
        values = jnp.where(cycle.status == Status.OK, values, jnp.nan)
        return values, (values, cycle)

    slopes, (values, cycle) = jax.jacfwd(achieved, has_aux=True)(u)
    return values, slopes, cycle


_achieved_in_one = jit(_achieved)


def _check_functional(functional: Callable[[Any], Any], osc: Oscillator) -> None:
    """Raises a `ValueError` unless a functional returns one number for a cycle."""
    if isinstance(functional, BasinMargin):
        return refuse_clock(osc, "distance_to_basin_boundary")
    if isinstance(functional, _BifurcationMargin) and has_clock(osc):
        return functional.check(osc)
    field, expected = "functional of targets", "a function of a cycle that returns one number"
    shaped = _motion_of_zeros(osc) if has_clock(osc) else cycle_of_zeros

    def tried(osc: Oscillator) -> Any:
        return functional(shaped(osc))

    value = traceable(lambda: jax.eval_shape(tried, osc), field, expected)
    fits = isinstance(value, jax.ShapeDtypeStruct) and value.shape == ()
    require(fits, field, expected, f"one that returns {shape_in_words(value)}")


def _motion_of_zeros(osc: Oscillator) -> Callable[[Oscillator], PeriodicMotion]:
    """The counterpart of `cycle_of_zeros` for oscillators with the forcing of `osc`."""
    turns = turns_of(osc)
    return lambda osc: nothing_found(osc, turns, Status.OK.value)


def _check_frequencies(osc: Oscillator, selection: Selection, u: np.ndarray) -> None:
    """Raises a `ValueError` if the selection can change the ratio of two frequencies."""
    moved = selection.put(osc, selection.values(jnp.asarray(u + 1e-3 * np.arange(1, u.size + 1))))
    before, after = (np.array(list(map(float, frequencies(one)))) for one in (osc, moved))
    fits = np.allclose(before * after[:1], after * before[:1], rtol=1e-14, atol=0)
    expected = "such that all frequencies keep a period in common"
    require(fits, "where", expected, f"{', '.join(selection.names)}, which change them apart")


def _checked_targets(targets):
    expected = "a list of pairs (functional, value), such as [(jb.amplitude, 1.0)]"
    is_many = isinstance(targets, Sequence) and len(targets) > 0
    require_value(is_many, "targets", expected, targets)
    intervals = []
    for pair in targets:
        fine = isinstance(pair, tuple | list) and len(pair) == 2 and callable(pair[0])
        require_value(fine, "targets", expected, targets)
        wanted = pair[1] if isinstance(pair[1], tuple | list) else (pair[1], pair[1])
        name = f"target of {getattr(pair[0], '__name__', 'functional')}"
        require_value(np.shape(wanted) == (2,), name, "a value or (lower, upper)", pair[1])
        lower, upper = np.asarray(as_numbers(wanted, name, (2,))).tolist()
        expected = "a value or (lower, upper), lower <= upper"
        require_value(lower <= upper, name, expected, pair[1])
        intervals.append((lower, upper))
    return tuple(functional for functional, _ in targets), np.array(intervals)
