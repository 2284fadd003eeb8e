"""`fit`: parameters from a measured record, by gradients.

A record of stick-slip motion is hard to fit from afar: with a wrong period the motion slips by
whole loops against the record, and the sum of squares has a minimum for each of these. Hence three
stages:

1. *Search* for guesses, see `search`: the record is cut into windows shorter than half a loop, over
   which no phase is lost.
2. *Windows*: the same windows in the exact, event-driven motion, each with an unknown start
   (multiple shooting). A damped Gauss-Newton (Levenberg-Marquardt) iteration for

       p + 2W unknowns   p parameters, and the start (x1, x2) of every window
       N equations       one for each datum, weighted with its noise

   whose matrix is an arrow: the starts are eliminated window by window.
3. *Joining*: three neighbouring windows become one, again and again, until the whole record is one
   motion from one unknown start. (Candidates that are far off in windows are joined only where no
   other candidate leads to the record.) The last iteration goes on until the sum of squares has
   nothing left to gain. Its Gauss-Newton matrix gives the standard errors.

All derivatives of stages 2 and 3 are those of `simulate`, through every stick, slip and crossing.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..activity import announced
from ..checks import as_array, as_finite, as_whole, outside_of_traces, require, require_value
from ..model.oscillator import Oscillator, check_oscillator
from ..model.own_units import own_length, quantity, rescaled
from ..results import Status, describe, draw
from ..tables import table_of
from .record import OVERESTIMATED, WINDOW, Record, Verdict, quickest, record_of, verdict_on
from .search import first_guesses
from .selection import (
    own_units_of,
    parameter_sizes,
    progress_reporter,
    selection_of,
)
from .windows import (
    GAIN_LEFT,
    FitPoint,
    Linearization,
    at_bounds,
    fit_windows,
    free_part,
    gain_left,
    known_directions,
)
from .witnesses import contradicted

if TYPE_CHECKING:
    import pandas

#: Number of neighbouring windows that are joined at each stage.
JOIN = 3
#: Candidates with a larger chi^2 per datum in windows are followed last, if no other one fits.
FAR_OFF = 6.0
#: A parameter belongs to an undetermined direction if one standard error along that direction
#: changes it by more than this fraction of its size.
LEAST_PART = 0.3


# --- fit ------------------------------------------------------------------------------------------


class Fit(eqx.Module):
    """Estimated parameters with their standard errors; what `fit` returns.

    The standard errors are those of the linearised problem: right where the model is right and the
    errors are small. With the status MISFIT they mean nothing, and `table` and the text leave them
    out.

    Attributes:
        oscillator: The oscillator with the estimates in it.
        names: Names of the parameters, in the order of `where`.
        estimates: Their estimates, [p].
        standard_errors: Standard errors of the estimates, [p]; 0 for a parameter at a bound beyond
            which the record would fit better: it is held there, and the others' errors are for
            this fixed value.
        covariance: Covariance of the estimates, [p, p].
        y0: Estimated state (x1, x2) at the first time, [2].
        y0_standard_errors: Its standard errors, [2].
        ts: Times of the record, [samples].
        ys: Fitted motion at these times, [samples, 2].
        residuals: Datum minus motion, [samples, 2], NaN where there is no datum.
        noise: Standard deviations of the data in x1 and in x2, as given or estimated, [2].
        reduced_chi_squared: About 1 +- sqrt(2/data) where model and noise are right.
        plausibility: Probability that noise alone makes chi^2 this large.
        autocorrelation: Of the residuals at lag one, about 0 +- 1/sqrt(data); where it is larger,
            the residuals have a shape that noise has not.
        candidates: Number of starts that were followed.
        evaluations: Number of evaluations of the motion and its Jacobian.
        status: OK; MISFIT (plausibility below 1e-6, or, where the noise was estimated, residuals of
            its size with an autocorrelation that noise has not); NOT_IDENTIFIED (no misfit, and a
            standard error that is infinite, or larger than its parameter and than 0.1 of its unit;
            it is infinite, too, where values that it excludes fit nearly as well: chi^2 rises less
            than a quarter of what it says, and by less than 25);
            NO_CONVERGENCE (a further step would move the estimates by a third of a standard error);
            or NOT_FINITE.
        noise_was_estimated: Whether the noise of at least one column was estimated.
    """

    oscillator: Oscillator
    names: tuple[str, ...] = eqx.field(static=True)
    estimates: Array
    standard_errors: Array
    covariance: Array
    y0: Array = eqx.field(metadata=quantity("length", "velocity"))
    y0_standard_errors: Array = eqx.field(metadata=quantity("length", "velocity"))
    ts: Array
    ys: Array = eqx.field(metadata=quantity("length", "velocity"))
    residuals: Array = eqx.field(metadata=quantity("length", "velocity"))
    noise: Array = eqx.field(metadata=quantity("length", "velocity"))
    reduced_chi_squared: Array
    plausibility: Array
    autocorrelation: Array
    candidates: int
    evaluations: int
    status: Array
    noise_was_estimated: bool = eqx.field(static=True, default=False)

    @property
    def undetermined(self) -> tuple[tuple[str, ...], ...]:
        """Parameters that the record does not determine, by name, in groups.

        A group of one name is a parameter that is not determined; of a larger group at least one
        combination is not. Empty unless the status is NOT_IDENTIFIED.
        """
        if int(self.status) != Status.NOT_IDENTIFIED:
            return ()
        sizes = parameter_sizes(self.estimates, own_units_of(self.oscillator, self.names))
        return _undetermined(self.names, self.covariance, sizes)

    def intervals(self, level: float = 0.95) -> Array:
        """Confidence intervals of the parameters.

        Args:
            level: Confidence level, between 0 and 1.

        Returns:
            (lower, upper) for each parameter, [p, 2].
        """
        reach = _standard_errors_in(level) * self.standard_errors
        return jnp.stack([self.estimates - reach, self.estimates + reach], axis=1)

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each parameter, and for x1 and x2 at the first time.

        Columns: name, estimate, standard_error, lower, upper (the confidence interval of 95 per
        cent); the last three are NaN where the status is MISFIT.
        """
        names = (*self.names, "x1 at the start", "x2 at the start")
        estimates = np.concatenate([self.estimates, self.y0])
        errors = np.concatenate([self.standard_errors, self.y0_standard_errors])
        errors = np.where(int(self.status) == Status.MISFIT, np.nan, errors)
        reach = _standard_errors_in(0.95) * errors
        return table_of(
            {
                "name": names,
                "estimate": estimates,
                "standard_error": errors,
                "lower": estimates - reach,
                "upper": estimates + reach,
            }
        )

    def plot(self, ax: Any = None) -> Any:
        """Draws the record and the fitted motion over time.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        status = Status(int(self.status))
        fits = status != Status.MISFIT
        rows = [
            f"  {name} = {float(value):.6g} "
            + (f"+- {float(error):.2g}" if fits else "(a misfit: without a standard error)")
            for name, value, error in zip(self.names, self.estimates, self.standard_errors)
        ]
        head = (
            f"Fit({status.name}: reduced chi^2 {float(self.reduced_chi_squared):.3f}, "
            f"autocorrelation {float(self.autocorrelation):+.3f}, {self.evaluations} evaluations)"
        )
        advice = [] if status == Status.OK else [f"  {describe(status)}"]
        if self.noise_was_estimated and float(self.reduced_chi_squared) < OVERESTIMATED:
            advice += [
                "  The noise was estimated too large, and with it these errors: there is hardly "
                "any, or the record is coarse against its motion. Give noise=."
            ]
        advice += [
            f"  Not determined: {group[0]}."
            if len(group) == 1
            else f"  Of these only a combination is determined, none alone: {', '.join(group)}."
            for group in self.undetermined
        ]
        return "\n".join([head, *rows, *advice])


def _undetermined(names: Sequence[str], covariance: ArrayLike, sizes: np.ndarray):
    """Parameters whose standard errors exceed their sizes, in groups.

    Parameters that an error in one direction changes together are in one group.
    """
    scaled = np.asarray(covariance) / sizes[:, None] / sizes
    infinite = np.isinf(np.diag(scaled))
    alone = [tuple(np.array(names)[infinite].tolist())] if np.any(infinite) else []
    values, vectors = np.linalg.eigh(scaled[np.ix_(~infinite, ~infinite)])
    # Parameters that change along a direction in which the error is too large.
    wide = (np.abs(vectors) * np.sqrt(np.maximum(values, 0.0)))[:, values > 1] > LEAST_PART
    kept = np.array(names)[~infinite]
    groups: list[set[str]] = []
    for column in wide.T:
        group = set(kept[column].tolist())
        for other in [one for one in groups if one & group]:
            groups.remove(other)
            group |= other
        groups.append(group)
    return (*alone, *(tuple(name for name in names if name in group) for group in groups))


def _standard_errors_in(level: float) -> float:
    """Number of standard errors from the estimate to an end of a confidence interval."""
    return float(jax.scipy.stats.norm.ppf(0.5 + 0.5 * level))


@announced("fit")
@outside_of_traces
def fit(
    oscillator: Oscillator,
    ts: ArrayLike,
    x1: ArrayLike | None = None,
    x2: ArrayLike | None = None,
    *,
    where: Callable[[Oscillator], Any],
    noise: ArrayLike | tuple[ArrayLike | None, ArrayLike | None] | None = None,
    bounds: Sequence[Any] | None = None,
    starts: int = 8,
    report: Callable[[str], None] | None = None,
) -> Fit:
    """Parameters of an oscillator from a measured record of its motion, with standard errors.

    A record determines the velocity of a belt that the mass sticks to, its static friction and the
    damping well; the kinetic law where slip speeds vary; and the velocity of a belt that is never
    stuck to or crossed hardly (it trades with the friction law). Belts with tied friction may
    exchange their velocities.

    All numbers are dimensionless, as in `simulate`. The state at the first time is estimated, too.

    The amplitudes, frequencies and phases of a forced oscillator are parameters like others. A
    record does not tell at which phase of the forcing it begins: fit a phase. A frequency should be
    known so well that the forcing is not shifted by more than a radian or two over the record.

    Args:
        oscillator: The guess. One that is 30 per cent off is mostly near enough for a stick-slip
            record of many loops. The status MISFIT may mean that it was not: give a nearer one, or
            more starts.
        ts: Times tau, increasing, [samples]; with forcing, the times in its cosines.
        x1: Displacements, [samples], NaN where a datum is missing; or None.
        x2: Velocities, likewise. One of x1 and x2 has to be given.
        where: Selects the parameters, as in `equinox.tree_at`: one number of the oscillator, or a
            tuple with one entry for each parameter. An entry may be a tuple of numbers that are
            kept equal, as in `lambda o: (o.damping, (o.belts[0].load, o.belts[1].load))`.
        noise: Standard deviation of the data, a pair where both x1 and x2 are given. None estimates
            it from the scatter of neighbouring data about a smooth curve, for which a loop needs
            some tens of data.
        bounds: For each parameter (lower, upper) or None; None keeps the oscillator possible: a
            parameter that cannot be negative stays positive, and a contact edge stays on its side
            of the other one if that is not selected, too. Parameters stay inside by a change of
            variables, so an estimate at a bound is one that would be outside without it.
        starts: Number of starts of the search, spread about the guess.
        report: Function that is called with lines on the progress, such as `print`.

    Returns:
        The `Fit`; its `status` says whether to trust it.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    check_oscillator(oscillator, "oscillator")
    times, values, sigmas = _checked_record(ts, x1, x2, noise)
    starts = as_whole(starts, "starts")
    note = progress_reporter(report)
    until = float(np.max(np.abs(times)))
    selection, u = selection_of(oscillator, where, bounds, until)

    # The record and its motions are in the own units of the guess.
    length = float(own_length(oscillator))
    values, sigmas = values / length, [one if one is None else one / length for one in sigmas]
    record = record_of(times, values, sigmas, length, oscillator)
    problem = Linearization(selection, oscillator, record)

    data = int(np.sum(np.isfinite(values)))
    freedom = data - u.size - 2
    require(freedom > 0, "ts", f"more data than the {u.size + 2} unknowns", data)
    window = f"{WINDOW / quickest(oscillator):.3g}"
    note(f"search: {starts} starts, {len(record.starts)} windows of {window} time units")
    estimated = any(
        sigma is None and np.any(np.isfinite(column))
        for sigma, column in zip(sigmas, values.T, strict=True)
    )

    def judged(point: FitPoint) -> Verdict:
        off = (values - _motion_of(point, values)) * _weights_of(record, values)
        return verdict_on(off, point.chi2, freedom, estimated)

    guesses = first_guesses(selection, u, oscillator, record, starts)
    followed: list[FitPoint] = []
    for point in _motions_from(problem, guesses, data, note):
        followed.append(point)
        if judged(point).is_noise:
            break
    best = min(followed, key=_misfit_of)
    found = _result(problem, times, values, best, judged(best), estimated, len(followed))
    result = rescaled(found, length)
    note(repr(result).splitlines()[0])
    return result


def _checked_record(ts, x1, x2, noise):
    times = np.asarray(as_finite(ts, "ts", (None,)))
    require(len(times) >= 8, "ts", "at least 8 times", len(times))
    require_value(np.all(np.diff(times) > 0), "ts", "increasing", times)
    require(x1 is not None or x2 is not None, "x1", "given, or x2", None)
    columns = []
    for name, column in (("x1", x1), ("x2", x2)):
        if column is None:
            columns.append(np.full(len(times), np.nan))
            continue
        columns.append(np.asarray(as_array(column, name, (len(times),))))
        require_value(not np.any(np.isinf(columns[-1])), name, "finite, or NaN", columns[-1])
        known = int(np.sum(np.isfinite(columns[-1])))
        require(known >= 8, name, "at least 8 data", known)
    given = [column[np.isfinite(column)] for column in columns]
    moves = any(np.ptp(column) > 0 for column in given if column.size)
    name = "x1" if x1 is not None else "x2"
    require(moves, name, "a record that changes", "one number throughout")
    both = x1 is not None and x2 is not None
    if isinstance(noise, tuple):
        sigmas = noise
    else:
        require_value(not both or noise is None, "noise", "a pair, for x1 and x2", noise)
        sigmas = (noise, noise)
    require_value(len(sigmas) == 2, "noise", "a number or a pair", noise)
    sigmas = [None if sigma is None else float(as_array(sigma, "noise")) for sigma in sigmas]
    for sigma in sigmas:
        require(sigma is None or 0 < sigma < np.inf, "noise", "> 0", sigma)
    return times, np.stack(columns, axis=1), sigmas


def _motions_from(problem, guesses, data: int, note) -> Iterator[FitPoint]:
    """Fitted motions, one for each guess.

    First come those whose windows come near the record, then the others, last the motion from the
    first guess: the start is fitted before the parameters, in windows and without them.
    """
    guess, far = next(guesses), []
    for number, (u, starts, misfit) in enumerate(itertools.chain([guess], guesses), 1):
        came = "the guess" if np.isnan(misfit) else f"misfit {misfit:.3g} of the smooth formulation"
        note(f"candidate {number}: {came}")
        point = _in_windows(problem, u, starts, data, note)
        if point.chi2 < FAR_OFF * data:
            yield _as_one_motion(problem, point, data, note)
        else:
            far.append((number, point))
    for number, point in sorted(far, key=lambda one: _misfit_of(one[1])):
        note(f"candidate {number}, from afar")
        yield _as_one_motion(problem, point, data, note)
    note("the guess itself")
    u, starts, _ = guess
    whole = np.arange(len(starts)) == 0
    ways = [fit_windows(problem, u, starts, whole, 0.0, np.inf, held=True)]
    windows = fit_windows(problem, u, starts, np.full(len(starts), True), 0.0, np.inf, held=True)
    ways.append(_as_one_motion(problem, windows, data, note, held=True))
    best = min(ways, key=_misfit_of)
    yield fit_windows(problem, u, best.starts, whole, 0.0, np.inf)


def _misfit_of(point: FitPoint) -> float:
    """chi^2 of a point, inf where it is NaN."""
    return float(np.nan_to_num(point.chi2, nan=np.inf))


def _in_windows(problem, u, starts, data: int, note) -> FitPoint:
    """Fits all windows as separate motions."""
    fresh = np.full(len(starts), True)
    point = fit_windows(problem, u, starts, fresh, 3e-3, FAR_OFF * data)
    if not point.chi2 < FAR_OFF * data:
        # The iteration may have stopped while it crept along a valley.
        point = fit_windows(problem, point.u, point.starts, fresh, 0.0, FAR_OFF * data)
    note(f"  {len(starts)} windows: chi^2 per datum {point.chi2 / data:.3f}")
    return point


def _as_one_motion(problem, point: FitPoint, data: int, note, held: bool = False) -> FitPoint:
    """Joins windows until one is left. held: whether the parameters keep their values."""
    pieces, every = len(point.starts), 1
    while True:
        every = min(JOIN * every, pieces)
        fresh, relative = np.arange(pieces) % every == 0, 0.0 if every == pieces else 3e-3
        point = fit_windows(
            problem, point.u, point.starts, fresh, relative, FAR_OFF * data, held=held
        )
        note(f"  {np.sum(fresh)} windows: chi^2 per datum {point.chi2 / data:.3f}")
        if every == pieces:
            return point


def _motion_of(point: FitPoint, values: np.ndarray) -> np.ndarray:
    """Fitted motion at the times of the data, [samples, 2]."""
    return point.ys.reshape(-1, 2)[: len(values)]


def _weights_of(record: Record, values: np.ndarray) -> np.ndarray:
    return np.asarray(record.weights).reshape(-1, 2)[: len(values)]


def _result(problem, ts, values, point, verdict: Verdict, estimated: bool, candidates: int) -> Fit:
    selection, p = problem.selection, point.u.size
    u = jnp.asarray(point.u)
    estimates = selection.values(u)
    slopes = np.append(np.diag(jax.jacfwd(selection.values)(u)), [1.0, 1.0])
    free = np.append(~at_bounds(selection, point), [True] * 2)
    block = free_part(selection, point)
    covariance = np.zeros((p + 2, p + 2))
    covariance[np.ix_(free, free)] = _inverted(block[:-1, :-1])
    covariance *= slopes[:, None] * slopes
    errors = np.sqrt(np.diag(covariance))
    ys, weights = _motion_of(point, values), _weights_of(problem.record, values)
    status = Status.OK if verdict.is_noise else Status.MISFIT
    if status == Status.OK:  # Errors of a misfit mean nothing.
        if not np.all(errors[:p] <= parameter_sizes(estimates, selection.unit)):
            status = Status.NOT_IDENTIFIED
        elif not gain_left(block) < GAIN_LEFT:
            status = Status.NO_CONVERGENCE
        else:
            unknown = np.flatnonzero(contradicted(problem, point, covariance))
            covariance[unknown, unknown] = errors[unknown] = np.inf
            status = Status.NOT_IDENTIFIED if unknown.size else Status.OK
    status = status if np.isfinite(point.chi2) else Status.NOT_FINITE
    with np.errstate(divide="ignore"):
        noise = 1 / np.max(weights, axis=0)
    return Fit(
        oscillator=selection.put(problem.oscillator, estimates),
        names=selection.names,
        estimates=estimates,
        standard_errors=jnp.asarray(errors[:p]),
        covariance=jnp.asarray(covariance[:p, :p]),
        y0=jnp.asarray(point.starts[0]),
        y0_standard_errors=jnp.asarray(errors[p:]),
        ts=jnp.asarray(ts),
        ys=jnp.asarray(ys),
        residuals=jnp.asarray(values - ys),
        noise=jnp.asarray(np.where(np.isfinite(noise), noise, np.nan)),
        reduced_chi_squared=jnp.asarray(verdict.reduced_chi_squared),
        plausibility=jnp.asarray(verdict.plausibility),
        autocorrelation=jnp.asarray(verdict.autocorrelation),
        candidates=candidates,
        evaluations=problem.evaluations,
        status=jnp.asarray(status.value),
        noise_was_estimated=estimated,
    )


def _inverted(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a Gauss-Newton matrix; variances of undetermined unknowns are infinite."""
    scale, values, vectors = known_directions(matrix)
    inverse = (vectors / values) @ vectors.T / scale[:, None] / scale
    known = np.sum(vectors**2, axis=1)
    lost = (1 - known > 1e-8) | (np.diag(matrix) == 0)
    inverse[lost, lost] = np.inf
    return inverse
