"""Inverse problems by gradients: `fit` parameters to a measured record, `design` a cycle.

**Fitting.** A record of stick-slip motion is hard to fit from afar: a guess with a wrong period
slips by whole loops against the record, and the sum of squares has a minimum for each of them. So

1. *search*: the record is cut into windows shorter than half a loop, over which no phase is lost.
   Each starts from the record itself, from a local polynomial. The misfit of the smooth formulation
   (tanh for sgn, a fixed step) is minimised by Adam (optax) from several starts under `vmap`. Its
   answer is biased, by the smoothing and by the starts, but near.
2. *windows*: the same windows in the exact, event-driven motion, and each with an unknown start
   (multiple shooting). A damped Gauss-Newton (Levenberg-Marquardt) iteration for

       p + 2W unknowns   p parameters, and the start (x1, x2) of every window
       N equations       one a datum, weighted with its noise

   whose matrix is an arrow: the starts are eliminated window by window.
3. *joining*: three neighbouring windows become one, again and again, until one is left: the whole
   record as one motion from one unknown start. Its Gauss-Newton matrix gives the standard errors.

All derivatives of 2 and 3 are those of `simulate`, through every stick, slip and crossing.

**Design** is Newton's method on functionals of the cycle, damped, within bounds.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

from ..bifurcations.conditions import AbstractCondition
from ..bifurcations.refine import refine
from ..checks import as_array, check_finite, require
from ..cycles.cycle import Cycle, find_cycle
from ..model.oscillator import Oscillator, check_oscillator
from ..model.parameters import leaf_groups, leaf_index, names_of, parameter
from ..motion.simulate import simulate
from ..motion.smoothing import smooth_field
from ..numerics.compiling import jit
from ..results import Status, describe

#: Length of the first windows, less than half a loop: no phase is lost over it.
WINDOW = 2.5
#: Each stage joins so many neighbouring windows.
JOIN = 3
#: Steps of the search, and its learning rate in units of a parameter's size.
SEARCH_STEPS, LEARNING_RATE = 200, 0.05
#: Steps of one damped Gauss-Newton iteration, and how far one may move a parameter.
ITERATIONS, LONGEST = 40, 0.4
#: A start whose windows are further off than this (chi^2 per datum) is not followed further.
HOPELESS = 6.0
#: A fit as bad as this happens once in a million records, by noise.
IMPLAUSIBLE = 1e-6
TOLERANCE = 1e-8


# --- which parameters, within which bounds --------------------------------------------------------


class Selection(eqx.Module):
    """Parameters of an oscillator: for each the numbers of the leaves that it sets, and bounds.

    Each is a function of an unbounded variable u: lower + exp(u), upper - exp(-u), between two
    bounds a logistic function of u, without bounds size u.
    """

    leaves: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    lower: Array
    upper: Array
    size: Array

    def values(self, u: Array) -> Array:
        has_lower, has_upper = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        low, high = jnp.where(has_lower, self.lower, 0.0), jnp.where(has_upper, self.upper, 0.0)
        one_sided = jnp.where(has_lower, low + jnp.exp(u), high - jnp.exp(-u))
        between = low + (high - low) * jax.nn.sigmoid(u)
        bounded = jnp.where(has_lower & has_upper, between, one_sided)
        return jnp.where(has_lower | has_upper, bounded, self.size * u)

    def unbounded(self, values: ArrayLike) -> Array:
        """The u that belong to values within the bounds."""
        has_lower, has_upper = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        above = jnp.log(jnp.where(has_lower, values - self.lower, 1.0))
        below = -jnp.log(jnp.where(has_upper, self.upper - values, 1.0))
        return jnp.where(has_lower | has_upper, above + below, values / self.size)

    def put(self, osc: Oscillator, values: Array) -> Oscillator:
        """The oscillator with the parameters set to these values."""
        leaves, structure = jax.tree.flatten(osc)
        for i, numbers in enumerate(self.leaves):
            for leaf in numbers:
                leaves[leaf] = values[i]
        return jax.tree.unflatten(structure, leaves)


def _select(osc: Oscillator, where: Callable, bounds) -> tuple[Selection, np.ndarray]:
    """What `where` selects, a leaf or a tuple of leaves kept equal for each parameter; and u."""
    groups, leaves = leaf_groups(osc, where), jax.tree.leaves(osc)
    if bounds is None:
        bounds = [None] * len(groups)
    require(len(bounds) == len(groups), "bounds", f"{len(groups)} pairs or None", repr(bounds))
    named = names_of(osc)
    names = tuple(" = ".join(named[leaf] for leaf in group) for group in groups)
    values = np.array([float(leaves[group[0]]) for group in groups])
    pairs = []
    for group, name, value, pair in zip(groups, names, values, bounds, strict=True):
        lower, upper = (_least(osc, group[0]), np.inf) if pair is None else map(float, pair)
        require(lower < value < upper, name, f"inside of its bounds {lower}, {upper}", value)
        pairs.append((lower, upper))
    lower, upper = jnp.asarray(pairs).T
    size = jnp.asarray(np.maximum(np.abs(values), 0.1))
    selection = Selection(groups, names, lower, upper, size)
    return selection, np.asarray(selection.unbounded(jnp.asarray(values)))


def _least(osc: Oscillator, leaf: int) -> float:
    """0 for a leaf that may not be negative, by the oscillator's own checks, else -inf."""
    leaves, structure = jax.tree.flatten(osc)
    leaves[leaf] = jnp.asarray(-1.0)
    try:
        jax.tree.unflatten(structure, leaves).check()
    except ValueError:
        return 0.0
    return -np.inf


# --- the record -----------------------------------------------------------------------------------


class Record(eqx.Module):
    """Data in pieces of equal number, the first windows.

    times: since the start of the piece, the last one the start of the next, [pieces, samples + 1];
    values: x1 and x2, [pieces, samples, 2]; weights: 1/noise, 0 where there is no datum, the same;
    starts: states at the starts of the pieces as the record has them, [pieces, 2]; scale: of each
    component, [2]; lacks: 1.0 where only velocities are known, so that the x1 of the starts lack a
    common constant, else 0.0.
    """

    times: Array
    values: Array
    weights: Array
    starts: Array
    scale: Array
    lacks: Array


def _record_of(ts: np.ndarray, values: np.ndarray, noise: Sequence[float | None]) -> Record:
    """values: [samples, 2], NaN where there is no datum; noise: None to be estimated."""
    n = len(ts)
    step = (ts[-1] - ts[0]) / (n - 1)
    size = int(np.clip(round(WINDOW / step), 1, n))
    pieces = -(-n // size)
    begin = np.arange(pieces) * size
    smoothed = [_local_cubics(ts, column) for column in values.T]
    known = np.isfinite(values)
    given = [i for i in (0, 1) if np.any(known[:, i])]
    if 0 in given:
        states = np.stack(smoothed[0][:2], axis=1)
    else:
        v = smoothed[1][0]
        steps = 0.5 * (v[1:] + v[:-1]) * np.diff(ts)
        states = np.stack([np.concatenate([[0.0], np.cumsum(steps)]), v], axis=1)
    if 1 in given:
        states[:, 1] = smoothed[1][0]
    weights = np.zeros_like(values)
    for i in given:
        sigma = noise[i]
        sigma = smoothed[i][2] if sigma is None else sigma
        weights[:, i] = np.where(known[:, i], 1 / sigma, 0.0)

    missing = pieces * size - n
    ts = np.concatenate([ts, np.full(missing, ts[-1]), [ts[-1] + step]])
    padding = ((0, missing), (0, 0))
    return Record(
        times=jnp.asarray(np.stack([ts[i : i + size + 1] - ts[i] for i in begin])),
        values=jnp.asarray(np.pad(np.where(known, values, 0.0), padding).reshape(pieces, size, 2)),
        weights=jnp.asarray(np.pad(weights, padding).reshape(pieces, size, 2)),
        starts=jnp.asarray(states[begin]),
        scale=jnp.asarray(np.std(states, axis=0)),
        lacks=jnp.asarray(float(0 not in given)),
    )


def _local_cubics(ts: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Value and slope at every time of a cubic through the data near it; their noise.

    Near: a third of a time unit on either side, at least seven data.
    """
    known = np.isfinite(column)
    if np.sum(known) < 7:
        return np.zeros_like(ts), np.zeros_like(ts), np.nan
    t, x = ts[known], column[known]
    half = max(3, round(0.35 / np.median(np.diff(t))))
    half = min(half, (len(t) - 1) // 2)
    centre = np.searchsorted(t, ts)
    rows = np.clip(centre - half, 0, len(t) - 2 * half - 1)[:, None] + np.arange(2 * half + 1)
    powers = (t[rows] - ts[:, None])[..., None] ** np.arange(4)
    inverse = np.linalg.pinv(powers)
    cubics = np.einsum("tpi,ti->tp", inverse, x[rows])
    off = x[rows] - np.einsum("tip,tp->ti", powers, cubics)
    # The median: corners of the motion are no noise.
    noise = np.sqrt(np.median(np.sum(off**2, axis=1) / (2 * half - 3)))
    return cubics[:, 0], cubics[:, 1], float(noise)


# --- 1: the search --------------------------------------------------------------------------------


def _smooth_misfit(unknown, selection: Selection, osc: Oscillator, record: Record, eps, steps: int):
    """Misfit of the smooth formulation over all windows, of size one where it is off by `scale`."""
    u, shift = unknown
    osc = selection.put(osc, selection.values(u))
    h = record.times[:, -1] / steps

    def field(y):
        return smooth_field(osc, y, eps)

    def advance(y, _):
        def ahead(slope, fraction):
            return tuple(a + fraction * h * b for a, b in zip(y, slope, strict=True))

        k1 = field(y)
        k2 = field(ahead(k1, 0.5))
        k3 = field(ahead(k2, 0.5))
        k4 = field(ahead(k3, 1.0))
        slope = tuple((a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(k1, k2, k3, k4))
        new = ahead(slope, 1.0)
        return new, jnp.stack(new, axis=-1)

    start = (record.starts[:, 0] + shift * record.lacks, record.starts[:, 1])
    _, path = lax.scan(advance, start, None, length=steps)
    path = jnp.concatenate([jnp.stack(start, axis=-1)[None], path])
    # To the times of the data: linear between steps is good enough here.
    at = jnp.clip(record.times[:, :-1] / h[:, None], 0.0, steps)
    before = jnp.minimum(at.astype(int), steps - 1)
    piece = jnp.arange(h.size)[:, None]
    rest = (at - before.astype(float))[..., None]
    predicted = (1 - rest) * path[before, piece] + rest * path[before + 1, piece]
    scale = jnp.broadcast_to(0.02 * record.scale, predicted.shape)
    off = jnp.where(record.weights > 0, (predicted - record.values) / scale, 0.0)
    # Grows like |off|: windows that are hopeless from here do not outvote the others.
    return jnp.mean(jnp.sqrt(1 + off**2) - 1)


@jit
def _search(starts, selection: Selection, osc: Oscillator, record: Record, eps, steps: int):
    """Adam from many starts, (u [starts, p], shift [starts]): where each ends, and its misfit."""
    import optax  # a quarter of a second that only this search needs

    optimizer = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, SEARCH_STEPS))

    def misfit(unknown):
        return _smooth_misfit(unknown, selection, osc, record, eps, steps)

    gradient = jax.vmap(jax.value_and_grad(misfit))

    def improve(state, _):
        unknown, memory = state
        _, slope = gradient(unknown)
        # Optax multiplies its integer counts with floats.
        with jax.numpy_dtype_promotion("standard"):
            change, memory = optimizer.update(slope, memory)
        return (optax.apply_updates(unknown, change), memory), None

    state = (starts, optimizer.init(starts))
    (unknown, _), _ = lax.scan(improve, state, None, length=SEARCH_STEPS)
    return unknown, gradient(unknown)[0]


def _candidates(selection, u, osc, record: Record, starts: int):
    """The ends of the search, best first, each with its window starts; near ones count once."""
    # The velocity over which tanh loops. Steps of the scheme are stable up to 2.8 over the slope of
    # the friction there; two belts of one velocity double it.
    eps = 0.1 * float(record.scale[1])
    slope = max(float(b.load * b.friction.static * osc.omega) for b in osc.belts) / eps
    steps = 16 * int(np.ceil(float(jnp.max(record.times)) * max(20.0, slope / 1.3) / 16))
    rng = np.random.default_rng(0)
    spread = rng.standard_normal((starts, u.size + 1))
    spread[0] = 0.0
    first = (jnp.asarray(u + 0.3 * spread[:, :-1]), jnp.asarray(spread[:, -1]))
    found: Any = _search(first, selection, osc, record, jnp.asarray(eps), steps)
    ends, shifts, misfits = map(np.asarray, jax.tree.leaves(found))
    chosen: list[int] = []
    for i in np.argsort(misfits):
        near = any(np.max(np.abs(ends[i] - ends[j])) < 0.1 for j in chosen)
        if np.isfinite(misfits[i]) and not near:
            chosen.append(int(i))
    shift = np.array([float(record.lacks), 0.0])
    return [(ends[i], np.asarray(record.starts) + shifts[i] * shift, misfits[i]) for i in chosen]


# --- 2 and 3: windows of the exact motion ---------------------------------------------------------


@jit
def _linearized(selection: Selection, osc: Oscillator, record: Record, u, starts, fresh):
    """The motion at the times of the record, [pieces, samples, 2], and Gauss-Newton blocks.

    A piece begins at its start where it is `fresh`, else where the one before it ends. Blocks, for
    each piece: sums over its data of products of the columns of the Jacobian (p parameters, the two
    components of the start of its window) and of the weighted residual, [pieces, p + 3, p + 3].
    """

    def motion(u, starts):
        moved = selection.put(osc, selection.values(u))

        def piece(y, row):
            times, start, is_fresh = row
            y = jnp.where(is_fresh, start, y)
            run = simulate(
                moved,
                y,
                times[-1],
                ts=times,
                rtol=TOLERANCE,
                atol=TOLERANCE,
                max_segments=128,
            )
            return run.ys[-1], run.ys[:-1]

        return lax.scan(piece, starts[0], (record.times, starts, fresh))[1]

    p, pieces = u.size, starts.shape[0]
    du = jnp.concatenate([jnp.eye(p), jnp.zeros((2, p))])
    each = jnp.broadcast_to(jnp.eye(2)[:, None], (2, pieces, 2))
    dstarts = jnp.concatenate([jnp.zeros((p, pieces, 2)), each])

    def column(du, dstarts):
        return jax.jvp(motion, (u, starts), (du, dstarts))

    ys, columns = jax.vmap(column, out_axes=(None, -1))(du, dstarts)
    off = (ys - record.values)[..., None]
    columns = record.weights[..., None] * jnp.concatenate([columns, off], axis=-1)
    return ys, jnp.einsum("csij,csik->cjk", columns, columns)


def _damped_step(blocks: np.ndarray, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """The Levenberg-Marquardt step of the parameters, [p], and of the starts, [windows, 2]."""
    p = blocks.shape[-1] - 3
    a, g = np.sum(blocks[:, :p, :p], axis=0), np.sum(blocks[:, :p, -1], axis=0)
    c, d, h = blocks[:, :p, p:-1], blocks[:, p:-1, p:-1], blocks[:, p:-1, -1:]
    a = a + np.diag(damping * np.diag(a) + 1e-12)
    d = d + (damping * np.einsum("wii->wi", d) + 1e-9)[..., None] * np.eye(2)
    eliminate = c @ np.linalg.inv(d)
    matrix = a - np.sum(eliminate @ c.transpose(0, 2, 1), axis=0)
    du = np.linalg.solve(matrix, np.sum(eliminate @ h, axis=0)[:, 0] - g)
    dstarts = -np.linalg.solve(d, h + (c.transpose(0, 2, 1) @ du)[..., None])[..., 0]
    return du, dstarts


class _Point(eqx.Module):
    """Where the iteration stands: unknowns, motion, blocks of the windows, chi^2, evaluations."""

    u: np.ndarray
    starts: np.ndarray
    ys: np.ndarray
    blocks: np.ndarray
    chi2: float
    evaluations: int


def _fit_windows(linearized, u, starts, fresh: np.ndarray, relative: float) -> _Point:
    """Levenberg-Marquardt for one division into windows, until chi^2 falls by less than that."""
    window = np.cumsum(fresh) - 1

    def at(u, starts, evaluations):
        ys, pieces = linearized(jnp.asarray(u), jnp.asarray(starts), jnp.asarray(fresh))
        blocks = np.zeros((window[-1] + 1, *pieces.shape[1:]))
        np.add.at(blocks, window, np.asarray(pieces))
        chi2 = float(np.sum(blocks[:, -1, -1]))
        return _Point(u, starts, np.asarray(ys), blocks, chi2, evaluations)

    point = at(u, starts, 1)
    damping = 1e-2
    for _ in range(ITERATIONS):
        if not np.isfinite(point.chi2) or damping > 1e5:
            break
        du, dstarts = _damped_step(point.blocks, damping)
        shorter = min(1.0, LONGEST / max(np.max(np.abs(du)), 1e-300))
        moved = point.starts.copy()
        moved[fresh] += np.clip(shorter * dstarts, -0.5, 0.5)
        trial = at(point.u + shorter * du, moved, point.evaluations + 1)
        if trial.chi2 < point.chi2:
            gain = point.chi2 - trial.chi2
            point, damping = trial, max(damping / 10, 1e-9)
            if gain < max(1e-2, relative * point.chi2):
                break
        else:
            point = eqx.tree_at(lambda q: q.evaluations, point, trial.evaluations)
            damping *= 10
    return point


# --- fit ------------------------------------------------------------------------------------------


class Fit(eqx.Module):
    """What `fit` returns.

    oscillator: with the estimates in it; names, estimates, standard_errors, [p]: of the parameters,
    in the order of `where`; covariance, [p, p]; y0, y0_standard_errors, [2]: the start, the state
    at the first time; ys: the fitted motion at the times of the record, [samples, 2]; residuals:
    datum minus motion, [samples, 2], NaN where there is no datum; noise: standard deviation of the
    data in x1 and in x2, as given or estimated, [2].

    Diagnostics of the residuals: reduced_chi_squared, about 1 +- sqrt(2/data) where model and noise
    are right; plausibility, the chance that noise alone makes it this large; autocorrelation, at
    lag one, about 0 +- 1/sqrt(data): what is left has a shape where it is larger.

    candidates: how many starts were followed; evaluations: of the motion and its Jacobian; status:
    OK, NOT_IDENTIFIED (an infinite standard error), MISFIT (plausibility below 1e-6),
    NO_CONVERGENCE or NOT_FINITE. Standard errors are those of the linearised problem: right where
    the model is and the errors are small.
    """

    oscillator: Oscillator
    names: tuple[str, ...] = eqx.field(static=True)
    estimates: Array
    standard_errors: Array
    covariance: Array
    y0: Array
    y0_standard_errors: Array
    ys: Array
    residuals: Array
    noise: Array
    reduced_chi_squared: Array
    plausibility: Array
    autocorrelation: Array
    candidates: int
    evaluations: int
    status: Array

    def intervals(self, level: float = 0.95) -> Array:
        """Confidence intervals of the parameters, (lower, upper) each, [p, 2]."""
        reach = jax.scipy.stats.norm.ppf(0.5 + 0.5 * level) * self.standard_errors
        return jnp.stack([self.estimates - reach, self.estimates + reach], axis=1)

    def __repr__(self) -> str:
        status = Status(int(self.status))
        rows = [
            f"  {name} = {float(value):.6g} +- {float(error):.2g}"
            for name, value, error in zip(self.names, self.estimates, self.standard_errors)
        ]
        head = (
            f"Fit({status.name}: reduced chi^2 {float(self.reduced_chi_squared):.3f}, "
            f"autocorrelation {float(self.autocorrelation):+.3f}, {self.evaluations} evaluations)"
        )
        advice = [] if status == Status.OK else [f"  {describe(status)}"]
        return "\n".join([head, *rows, *advice])


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
    report: Callable[[str], None] | None = print,
) -> Fit:
    """Parameters of an oscillator from a measured record of its motion, with standard errors.

    oscillator: the guess; 30 per cent off is near enough for a stick-slip record of many loops.
    ts: the times, increasing, [samples]; x1, x2: displacement, velocity, or both, [samples], NaN
    where a datum is missing. All dimensionless, as in `simulate`. The start of the motion, its
    state at ts[0], is estimated too.

    where: selects the parameters, as in `equinox.tree_at`: a tuple with one entry each. An entry is
    a number of the oscillator, or a tuple of numbers that are to be equal:

        lambda o: (o.damping, (o.belts[0].friction.static, o.belts[1].friction.static))

    noise: standard deviation of the data, of x1 and x2 as a pair where both are given; None
    estimates it from how far neighbouring data scatter about a smooth curve. bounds: for each
    parameter (lower, upper) or None, which keeps positive what cannot be negative; a parameter
    stays inside by reparametrisation, so an estimate at a bound is one that wants to leave. starts:
    of the search, spread about the guess. report: is told of the progress; None for silence.

    What can be told from a record: the velocity of a belt that the mass sticks to, its static
    friction and the damping, well; the kinetic law where slip speeds vary; the velocity of a belt
    that is never stuck to or crossed, hardly (it trades with the friction law). Belts with tied
    friction may exchange their velocities. See `Fit.status`. `ValueError` names an argument that is
    impossible.
    """
    check_oscillator(oscillator, "oscillator")
    times, values, sigmas = _checked_record(ts, x1, x2, noise)
    require(isinstance(starts, int) and starts > 0, "starts", "a positive integer", starts)
    selection, u = _select(oscillator, where, bounds)
    tell = report or (lambda text: None)

    record = _record_of(times, values, sigmas)
    linearized = functools.partial(_linearized, selection, oscillator, record)
    data = int(np.sum(np.isfinite(values)))
    freedom = data - u.size - 2
    require(freedom > 0, "ts", f"more data than the {u.size + 2} unknowns", data)
    tell(f"search: {starts} starts, {len(record.starts)} windows of {WINDOW} time units")
    best, count, evaluations = None, 0, 0
    for guess, states, misfit in _candidates(selection, u, oscillator, record, starts):
        count += 1
        tell(f"candidate {count}: misfit {misfit:.3g} of the smooth formulation")
        point, joined = _follow_up(linearized, guess, states, data, tell)
        evaluations += point.evaluations
        if joined and (best is None or point.chi2 < best.chi2):
            best = point
            if _plausibility(point.chi2, freedom) > IMPLAUSIBLE:
                break
    if best is None:
        # Nothing came near: what the guess itself gives, with a status that says so.
        whole = np.arange(len(record.starts)) == 0
        best = _fit_windows(linearized, np.asarray(u), np.asarray(record.starts), whole, 0.0)
        evaluations += best.evaluations
    result = _result(oscillator, selection, record, values, best, freedom, count, evaluations)
    tell(repr(result).splitlines()[0])
    return result


def _checked_record(ts, x1, x2, noise):
    times = np.asarray(as_array(ts, "ts", (None,)))
    check_finite(times, "ts")
    require(len(times) >= 8, "ts", "at least 8 times", len(times))
    require(np.all(np.diff(times) > 0), "ts", "increasing", times)
    require(x1 is not None or x2 is not None, "x1", "given, or x2", None)
    columns = []
    for name, column in (("x1", x1), ("x2", x2)):
        if column is None:
            columns.append(np.full(len(times), np.nan))
            continue
        columns.append(np.asarray(as_array(column, name, (len(times),))))
        require(not np.any(np.isinf(columns[-1])), name, "finite, or NaN", column)
        known = int(np.sum(np.isfinite(columns[-1])))
        require(known >= 8, name, "at least 8 data", known)
    both = x1 is not None and x2 is not None
    if isinstance(noise, tuple):
        sigmas = noise
    else:
        require(not both or noise is None, "noise", "a pair, for x1 and x2", noise)
        sigmas = (noise, noise)
    require(len(sigmas) == 2, "noise", "a number or a pair", noise)
    sigmas = [None if sigma is None else float(as_array(sigma, "noise")) for sigma in sigmas]
    for sigma in sigmas:
        require(sigma is None or 0 < sigma < np.inf, "noise", "> 0", sigma)
    return times, np.stack(columns, axis=1), sigmas


def _follow_up(linearized, u, starts, data: int, tell) -> tuple[_Point, bool]:
    """Windows, joined until one is left; ended early, and False, where that is hopeless."""
    pieces, every, spent = len(starts), 1, 0
    while True:
        fresh = np.arange(pieces) % every == 0
        last = every >= pieces
        point = _fit_windows(linearized, u, starts, fresh, 0.0 if last else 3e-3)
        spent += point.evaluations
        tell(f"  {np.sum(fresh)} windows: chi^2 per datum {point.chi2 / data:.3f}")
        hopeless = not point.chi2 < HOPELESS * data
        if last or (every == 1 and hopeless):
            point = eqx.tree_at(lambda q: q.evaluations, point, spent)
            return point, last and bool(np.isfinite(point.chi2))
        u, starts, every = point.u, point.starts, min(JOIN * every, pieces)


def _plausibility(chi2, freedom: int) -> float:
    return float(jax.scipy.special.gammaincc(0.5 * freedom, 0.5 * chi2))


def _result(oscillator, selection, record, values, point: _Point, freedom, count, evaluations):
    p = point.u.size
    u = jnp.asarray(point.u)
    estimates = selection.values(u)
    slopes = np.append(np.diag(jax.jacfwd(selection.values)(u)), [1.0, 1.0])
    covariance = _inverse(point.blocks[0, :-1, :-1]) * slopes[:, None] * slopes
    errors = np.sqrt(np.diag(covariance))
    ys = point.ys.reshape(-1, 2)[: len(values)]
    weights = np.asarray(record.weights).reshape(-1, 2)[: len(values)]
    off = values - ys
    plausibility = _plausibility(point.chi2, freedom)
    status = Status.OK if plausibility > IMPLAUSIBLE else Status.MISFIT
    status = status if np.all(np.isfinite(errors[:p])) else Status.NOT_IDENTIFIED
    status = status if np.isfinite(point.chi2) else Status.NOT_FINITE
    with np.errstate(divide="ignore"):
        noise = 1 / np.max(weights, axis=0)
    return Fit(
        oscillator=selection.put(oscillator, estimates),
        names=selection.names,
        estimates=estimates,
        standard_errors=jnp.asarray(errors[:p]),
        covariance=jnp.asarray(covariance[:p, :p]),
        y0=jnp.asarray(point.starts[0]),
        y0_standard_errors=jnp.asarray(errors[p:]),
        ys=jnp.asarray(ys),
        residuals=jnp.asarray(off),
        noise=jnp.asarray(np.where(np.isfinite(noise), noise, np.nan)),
        reduced_chi_squared=jnp.asarray(point.chi2 / freedom),
        plausibility=jnp.asarray(plausibility),
        autocorrelation=jnp.asarray(_autocorrelation(off * weights)),
        candidates=count,
        evaluations=evaluations,
        status=jnp.asarray(status.value),
    )


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """The inverse of a Gauss-Newton matrix; infinite for what the record does not tell."""
    size = np.sqrt(np.diag(matrix))
    seen = size > 0
    scale = np.where(seen, size, 1.0)
    values, vectors = np.linalg.eigh(np.nan_to_num(matrix / scale[:, None] / scale))
    blind = values < 1e-12 * np.max(values, initial=0.0)
    inverse = (vectors[:, ~blind] / values[~blind]) @ vectors[:, ~blind].T
    inverse = inverse / scale[:, None] / scale
    lost = np.any(np.abs(vectors[:, blind]) > 1e-4, axis=1) | ~seen
    inverse[lost, lost] = np.inf
    return inverse


def _autocorrelation(off: np.ndarray) -> float:
    """Of neighbouring weighted residuals, both components together."""
    pairs = np.isfinite(off[1:]) & np.isfinite(off[:-1])
    products = np.where(pairs, off[1:] * off[:-1], 0.0)
    squares = np.where(pairs, 0.5 * (off[1:] ** 2 + off[:-1] ** 2), 0.0)
    return float(np.sum(products) / np.sum(squares))


# --- design ---------------------------------------------------------------------------------------

#: Targets are met to this fraction of their size (or of one, where they are smaller).
MET = 1e-9


class Design(eqx.Module):
    """What `design` returns.

    oscillator: the one designed; cycle: its cycle; names, values, [p]: of the parameters in the
    order of `where`; achieved, targets, [targets]: the functionals, and what they were to be (the
    nearer end of an interval, or the value itself inside of it); iterations; status: OK,
    UNREACHABLE, where the nearest that was found is given, or why there is no cycle to begin with.
    """

    oscillator: Oscillator
    cycle: Cycle
    names: tuple[str, ...] = eqx.field(static=True)
    values: Array
    achieved: Array
    targets: Array
    iterations: int
    status: Array

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


def distance_to(
    *conditions: AbstractCondition, where: Callable[[Oscillator], Any]
) -> Callable[[Cycle], Array]:
    """A functional for `design`: how far a parameter is from the nearest of some bifurcations.

    conditions: such as `jb.NonsmoothFold(belt=1)`; where: selects the parameter. Each point is
    found by `refine` from the oscillator of the cycle; one that is not there is infinitely far.
    """

    def distance(cycle: Cycle) -> Array:
        osc = cycle.oscillator
        value = parameter(osc, leaf_index(osc, where))
        distances = []
        for condition in conditions:
            point = refine(condition, osc, where=where)
            found = point.status == Status.OK
            distances.append(
                jnp.where(found, jnp.abs(jnp.where(found, point.value, 0.0) - value), jnp.inf)
            )
        return functools.reduce(jnp.minimum, distances)

    return distance


def design(
    oscillator: Oscillator,
    targets: Sequence[Any],
    *,
    where: Callable[[Oscillator], Any],
    bounds: Sequence[Any] | None = None,
    y0: ArrayLike | tuple = (3.0, 0.0),
    report: Callable[[str], None] | None = print,
) -> Design:
    """Parameters for which functionals of the cycle have wanted values.

    oscillator: where to begin; it has to have a cycle. targets: pairs of a functional of the
    `Cycle`, such as `jb.amplitude` or `lambda c: jb.stick_duration(c, 1)`, and its value, or an
    interval (lower, upper) that it is to lie in; `distance_to` is the functional that keeps a
    bifurcation away. where, bounds: the parameters that may be changed, as for `fit`. y0: the
    start (x1, x2) that leads to the cycle. report: is told of the progress; None for silence.

    Damped Newton steps with exact derivatives; with fewer targets than parameters, the shortest
    ones. What no choice within the bounds reaches ends with the status UNREACHABLE, and so does
    what lies behind a bifurcation at which the cycle vanishes. `ValueError` names an argument that
    is impossible.
    """
    check_oscillator(oscillator, "oscillator")
    y0 = as_array(y0, "y0", (2,))
    check_finite(y0, "y0")
    functionals, intervals = _checked_targets(targets)
    selection, u = _select(oscillator, where, bounds)
    tell = report or (lambda text: None)

    def evaluate(u):
        return _achieved(functionals, selection, oscillator, y0, jnp.asarray(u))

    def off(achieved):
        wanted = np.clip(achieved, *intervals.T)
        return (achieved - wanted) / np.maximum(1.0, np.abs(wanted)), wanted

    def improved(slopes, miss, wanted, damping):
        size = np.maximum(1.0, np.abs(wanted))[:, None]
        matrix = np.nan_to_num(np.where(miss[:, None] != 0, slopes / size, 0.0))
        gram = matrix @ matrix.T
        # Damping vanishes with the miss, for quadratic convergence.
        damping = damping * np.max(gram) * np.max(np.abs(miss)) + 1e-14
        step = -matrix.T @ np.linalg.solve(gram + damping * np.eye(len(miss)), miss)
        return u + step * min(1.0, LONGEST / max(np.max(np.abs(step)), 1e-300))

    achieved, slopes, cycle = evaluate(u)
    miss, wanted = off(np.asarray(achieved))
    damping, iterations, idle = 1e-3, 0, 0
    while iterations < 2 * ITERATIONS and idle < 5:
        if not np.all(np.isfinite(miss)) or np.max(np.abs(miss)) < MET or damping > 1e8:
            break
        new = improved(np.asarray(slopes), miss, wanted, damping)
        trial = evaluate(new)
        new_miss, new_wanted = off(np.asarray(trial[0]))
        iterations += 1
        gain = 1 - np.linalg.norm(new_miss) / np.linalg.norm(miss)
        if gain > 0:
            u, (achieved, slopes, cycle), miss, wanted = new, trial, new_miss, new_wanted
            damping, idle = max(damping / 4, 1e-12), idle + 1 if gain < 1e-5 else 0
            tell(f"step {iterations}: off by {np.max(np.abs(miss)):.1e}")
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


@jit
def _achieved(functionals, selection: Selection, osc: Oscillator, y0, u):
    """The functionals of the cycle, NaN where there is none, their derivatives, and the cycle."""

    def achieved(u):
        cycle = find_cycle(selection.put(osc, selection.values(u)), y0)
        values = jnp.stack([functional(cycle) for functional in functionals])
        values = jnp.where(cycle.status == Status.OK, values, jnp.nan)
        return values, (values, cycle)

    slopes, (values, cycle) = jax.jacfwd(achieved, has_aux=True)(u)
    return values, slopes, cycle


def _checked_targets(targets):
    pairs = list(targets)
    require(len(pairs) > 0, "targets", "at least one pair (functional, value)", targets)
    intervals = []
    for pair in pairs:
        fine = isinstance(pair, tuple) and len(pair) == 2 and callable(pair[0])
        require(fine, "targets", "pairs (functional, value)", repr(pair))
        lower, upper = pair[1] if isinstance(pair[1], tuple) else (pair[1], pair[1])
        require(float(lower) <= float(upper), "targets", "intervals (lower, upper)", repr(pair[1]))
        intervals.append((float(lower), float(upper)))
    return tuple(functional for functional, _ in pairs), np.array(intervals)
