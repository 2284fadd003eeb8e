"""Basins of attraction: which starts lead where, as a picture and as a number.

`basins` labels a grid of starts by their attractors, and finds the unstable cycle that separates
them, where there is one. `basin_stability` returns the fraction of a box of starts that leads to
each kind of attractor, with its standard error (P. J. Menck, J. Heitzig, N. Marwan, J. Kurths, How
basin stability complements the linear-stability paradigm, Nature Physics 9 (2013) 89-92). Measures
of labelled grids are their entropy, and the fraction of starts that are near to their attractor at
some time. All use the kernel behind `sweep`, where a run ends as soon as its attractor is known.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..activity import Activity, announced, note_progress
from ..checks import (
    as_finite,
    as_interval,
    as_positive,
    as_whole,
    check_key,
    check_no_start,
    outside_of_traces,
    refuse_interval,
    require,
    require_value,
    require_wish,
)
from ..cycles.attractors import Runs
from ..cycles.cycle import Cycle, cycle_from
from ..cycles.periodic import PeriodicMotion
from ..cycles.unstable import from_starts, unstable_cycle
from ..model.equilibria import EquilibriumKind, equilibria
from ..model.oscillator import Oscillator, check_oscillator, has_clock, refuse_clock
from ..model.own_units import in_given_units, in_own_units, in_units_of_run
from ..numerics.compiling import compiled_beside
from ..results import Status, draw
from ..tables import table_of
from .attractor import KINDS, Attractor
from .datasets import decoded, flags
from .forced_basins import forced_labels
from .naming import Found, is_cycle, told_apart, words_for
from .question import LONG_ENOUGH, as_start, settings_of_runs
from .runs_in_memory import results_from
from .strobes import FORCED_KINDS, ForcedAttractor
from .sweep import sweep

if TYPE_CHECKING:
    import pandas
    import xarray


#: Columns of the table of basins that only cycles have.
OF_CYCLES = ("x1_min", "x1_max", "x2_min", "x2_max", "period", "multiplier")
#: Columns of the table of basins that only periodic motions of forced oscillators have.
OF_MOTIONS = ("periods", "period", "x1", "x2", "multiplier_0", "multiplier_1")


class BasinEntropy(NamedTuple):
    """Basin entropy: mean over all boxes, and over boxes with more than one label."""

    basins: float
    boundary: float


class Basins(eqx.Module):
    """A grid of starts, labelled by attractors; what `basins` returns.

    Attributes:
        oscillator: The oscillator.
        dataset: `xarray.Dataset` over x1 and x2 with all variables of `sweep(...,
            observe="attractor")`, and `label`, the number of the attractor, from 0, the most
            frequent first (-1: undecided).
        attractors: A few words for each label.
        cycles: The cycles among the attractors, in the same order; of a forced oscillator each is a
            `PeriodicMotion`.
        boundary: The unstable cycle, with the status NO_UNSTABLE_CYCLE where there is none; None
            for a forced oscillator.
    """

    oscillator: Oscillator
    dataset: "xarray.Dataset" = eqx.field(static=True)
    attractors: tuple[str, ...] = eqx.field(static=True)
    cycles: tuple[Cycle | PeriodicMotion, ...]
    boundary: Cycle | None

    @property
    def label(self) -> "xarray.DataArray":
        """Number of the attractor of each start, -1 for undecided ones."""
        return self.dataset["label"]

    def entropy(self, side: int | tuple[int, int]) -> BasinEntropy:
        """Basin entropy: how uncertain the attractor of a start is if only its box is known.

        In a box in which the shares p_j of the starts lead to the attractors j the entropy is -sum
        p_j log p_j, with natural logarithms. The basin entropy S_b is its mean over all boxes, the
        boundary basin entropy S_bb over those with more than one label (NaN where there is none).
        Undecided starts count as one more attractor. Both depend on the size of the boxes: compare
        at one size. A boundary with S_bb > log 2 is fractal (A. Daza, A. Wagemakers, B. Georgeot,
        D. Guery-Odelin, M. A. F. Sanjuan, Basin entropy: a new tool to analyze uncertainty in
        dynamical systems, Scientific Reports 6 (2016) 31416).

        Args:
            side: Side of the boxes into which the grid is cut, in starts, along x1 and x2 alike or
                (along x1, along x2); it has to divide the numbers of starts.

        Returns:
            A tuple with S_b, `.basins`, and S_bb, `.boundary`.

        Raises:
            ValueError: If the side is impossible.
        """
        sides = side if isinstance(side, tuple) and len(side) == 2 else (side, side)
        across, along = (as_whole(one, "side") for one in sides)
        labels = np.asarray(self.label)
        fits = labels.shape[0] % across == 0 and labels.shape[1] % along == 0
        expected = f"one that divides the {labels.shape[0]} x {labels.shape[1]} starts"
        require_value(fits, "side", expected, side)
        shape = labels.shape[0] // across, across, labels.shape[1] // along, along
        boxes = labels.reshape(shape).swapaxes(1, 2).reshape(-1, across * along)
        entropy, mixed = np.zeros(len(boxes)), np.zeros(len(boxes), bool)
        for label in np.unique(labels):
            p = np.mean(boxes == label, axis=1)
            mixed |= (p > 0) & (p < 1)
            entropy -= p * np.log(np.where(p > 0, p, 1.0))
        boundary = float(np.mean(entropy[mixed])) if np.any(mixed) else float("nan")
        return BasinEntropy(float(np.mean(entropy)), boundary)

    @announced("finite_time_stability")
    def finite_time_stability(self, t: ArrayLike, within: ArrayLike) -> np.ndarray:
        """Finite-time basin stability of each attractor.

        It is the fraction of all starts that lead to the attractor and are near to it at time t;
        for long times the fraction that leads there at all (P. Schultz, F. Hellmann, K. N. Webster,
        J. Kurths, Bounding the first exit from the basin: Independence times and finite-time basin
        stability, Chaos 28 (2018) 043102). A run that was near before and is not at time t does not
        count.

        Args:
            t: Time since the start, dimensionless.
            within: Largest distance of the state (x1, x2) at that time from the nearest state of
                the attractor, dimensionless.

        Returns:
            The fractions, [attractors]; NaN for a cycle that shooting did not find.

        Raises:
            ValueError: If an argument is not positive.
        """
        refuse_clock(self.oscillator, "finite_time_stability", 'observe="final" of jb.sweep')
        t, within = as_positive(t, "t"), as_positive(within, "within")
        settings = {name: self.dataset.attrs.get(name) for name in ("rtol", "atol")}
        axes = {name: self.dataset[name].values for name in ("x1", "x2")}
        ends = sweep(lambda: self.oscillator, axes, t1=t, progress=False, **settings)
        states = np.stack([ends[name].values for name in ("x1_end", "x2_end")], axis=-1)
        labels, cycles = np.asarray(self.label), iter(self.cycles)
        low, high = (self.dataset[name].values for name in ("x1_min", "x1_max"))
        rest, segment, pieces = rest_reached(self.oscillator, 0.5 * (low + high))
        found = []
        for number, name in enumerate(self.attractors):
            of_it = labels == number
            if name.startswith("cycle"):
                away = _away_from_cycle(next(cycles), states[of_it])
            else:
                held = len(pieces) and name.startswith("stuck")
                ends_of_it = pieces[segment[of_it]] if held else rest[of_it][:, None]
                nearest = np.clip(states[of_it, 0], ends_of_it[:, 0], ends_of_it[:, -1])
                away = np.hypot(states[of_it, 0] - nearest, states[of_it, 1])
            found.append(np.nan if np.any(np.isnan(away)) else np.sum(away <= within) / labels.size)
        return np.array(found)

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each attractor, and one for undecided starts.

        Columns: label, attractor (its words), fraction of the starts, and for a cycle x1_min,
        x1_max, x2_min, x2_max, period, multiplier and signature; of a forced oscillator periods,
        period, x1 and x2 at the phase 0, multipliers and signature. The last row is the unstable
        cycle, label -2, where there is one. `basins.dataset.to_dataframe()` has a row for every
        start.
        """
        labels, cycles = np.asarray(self.label), iter(self.cycles)
        rows = []
        for number, name in enumerate(self.attractors):
            rows.append((number, name, next(cycles).row() if is_cycle(name) else {}))
        rows.append((-1, "undecided", {}))
        if self.boundary is not None and int(self.boundary.status) == Status.OK:
            rows.append((-2, "unstable cycle", self.boundary.row()))
        columns = OF_MOTIONS if has_clock(self.oscillator) else OF_CYCLES
        return table_of(
            [
                {
                    "label": number,
                    "attractor": name,
                    "fraction": float(np.mean(labels == number)),
                    **{key: of_cycle.get(key, np.nan) for key in columns},
                    "signature": of_cycle.get("signature", ""),
                }
                for number, name, of_cycle in rows
            ]
        )

    def plot(self, ax: Any = None) -> Any:
        """Draws which start leads where, with the cycles and a key: the picture of `plot_basins`.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        labels = np.asarray(self.label)
        parts = [f"{np.mean(labels == i):.1%} {name}" for i, name in enumerate(self.attractors)]
        if np.any(labels < 0):
            parts.append(f"{np.mean(labels < 0):.1%} undecided")
        return f"Basins({labels.shape[0]} x {labels.shape[1]} starts: {', '.join(parts)})"


#: Number of samples of a cycle, which straight lines join.
CHORDS = 4000


def _away_from_cycle(cycle: Any, states: np.ndarray) -> np.ndarray:
    """Distances of states, [n, 2], from a cycle, [n]; NaN where there is no cycle."""
    from scipy.spatial import KDTree  # late, as only this needs it

    if int(cycle.status) != Status.OK:
        return np.full(max(1, len(states)), np.nan)
    # The last sample repeats the first one.
    points = np.asarray(cycle.sample(CHORDS))[:-1]
    nearest = KDTree(points).query(states)[1]
    away = np.full(len(states), np.inf)
    for first, second in ((nearest - 1, nearest), (nearest, nearest + 1)):
        begin, end = points[first], points[second % len(points)]
        way, offset = end - begin, states - begin
        length = np.sum(way**2, axis=-1)
        share = np.sum(offset * way, axis=-1) / np.where(length > 0, length, 1.0)
        across = offset - np.clip(share, 0, 1)[:, None] * way
        away = np.minimum(away, np.hypot(*across.T))
    return away


class BasinStability(eqx.Module):
    """Fractions of the starts by kind of attractor; what `basin_stability` returns.

    The standard error of a fraction 0 or 1 is 0; a kind that none of the n starts met has a
    fraction below 3/n, with a confidence of 95 per cent.

    Attributes:
        fractions: Dictionary with the keys "equilibrium", "cycle", "stuck" and "undecided"; of a
            forced oscillator "periodic", "quasiperiodic", "chaotic" in place of "cycle".
        standard_errors: Standard errors, with the same keys.
        n: Number of starts.
    """

    fractions: dict[str, float]
    standard_errors: dict[str, float]
    n: int

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each kind; columns: kind, fraction, standard_error, n."""
        return table_of(
            {
                "kind": list(self.fractions),
                "fraction": list(self.fractions.values()),
                "standard_error": [self.standard_errors[kind] for kind in self.fractions],
                "n": [self.n] * len(self.fractions),
            }
        )

    def plot(self, ax: Any = None) -> Any:
        """Draws the fractions as bars, with their standard errors.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        parts = [
            f"{kind} {fraction:.5f} +- {self.standard_errors[kind]:.5f}"
            for kind, fraction in self.fractions.items()
            if 0 < fraction < 1
        ]
        # If all starts agree, the standard error is 0 and says nothing about other kinds.
        parts += [
            f"all {kind}, a fraction above {max(0.0, 1 - 3 / self.n):.5f} with 95% confidence"
            for kind, fraction in self.fractions.items()
            if fraction == 1
        ]
        return f"BasinStability({', '.join(parts)}; {self.n} starts)"


@outside_of_traces
def basins(
    oscillator: Oscillator,
    *,
    x1: ArrayLike | Sequence[float],
    x2: ArrayLike | Sequence[float],
    t1: float = LONG_ENOUGH,
    t0: float = 0.0,
    rtol: float = 1e-8,
    atol: float | None = None,
    progress: bool | None = None,
) -> Basins:
    """Labels a grid of starts by their attractors, and finds the unstable cycle between them.

    Starts of a forced oscillator are at the time t0, and no unstable cycle is searched for, as the
    basins may have fractal boundaries. Its attractors are periodic motions, named by their number
    of periods of the forcing, and chaotic and quasiperiodic motions; all chaotic motions have one
    label, and all quasiperiodic ones another.

    Args:
        oscillator: The oscillator.
        x1: Displacements of the starts, increasing, [n], dimensionless.
        x2: Velocities of the starts, increasing, [m], dimensionless.
        t1: Time at which a run ends that has reached no attractor; for a forced oscillator the
            run's largest exponent then decides.
        t0: Time of the starts, for a forced oscillator.
        rtol: Relative tolerance of a step, as in `sweep`.
        atol: Absolute tolerance of a step, as in `sweep`.
        progress: Whether to show a bar, as in `sweep`.

    Returns:
        The `Basins`.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    check_oscillator(oscillator, "oscillator")
    axes = {name: _starts_along(values, name) for name, values in (("x1", x1), ("x2", x2))}
    require_wish(progress, "progress")
    numbers = {"t1": t1, "rtol": rtol, "atol": atol}
    if has_clock(oscillator):
        return _forced_basins(oscillator, axes, progress, numbers | {"t0": t0})
    check_no_start(t0)
    with Activity("basins", progress):
        own = in_own_units(oscillator)
        start = jnp.asarray(np.zeros(2))
        ahead = [lambda: cycle_from(own, start), lambda: from_starts(own)]
        with compiled_beside("basins", own, ahead):
            dataset = sweep(lambda: oscillator, axes, observe="attractor", **numbers)
        note_progress("telling the attractors apart")
        found = _labels(oscillator, dataset)
        # With one attractor an unstable cycle is unlikely, and `unstable_cycle`, which searches all
        # cycles, takes time.
        boundary = (unstable_cycle if len(found) > 1 else from_starts)(own)
        boundary = in_given_units(boundary, oscillator, own)
    cycles = [in_given_units(one.cycle, oscillator, own) for one in found if one.cycle is not None]
    return _labelled(oscillator, dataset, found, cycles, boundary)


def _forced_basins(osc: Oscillator, axes: Any, progress: Any, numbers: Any) -> Basins:
    with Activity("basins", progress):
        dataset = sweep(lambda: osc, axes, observe="attractor", **numbers)
        note_progress("telling the attractors apart")
        found = forced_labels(osc, dataset)
    cycles = [one.cycle for one in found if one.cycle is not None]
    return _labelled(osc, dataset, found, cycles, None)


def _labelled(
    oscillator: Oscillator,
    dataset: "xarray.Dataset",
    found: Sequence[Found],
    cycles: Sequence[Any],
    boundary: Cycle | None,
) -> Basins:
    """Labels the dataset by the attractors, the most frequent first, and makes the `Basins`."""
    labels = np.full(dataset["kind"].shape, -1, "int32")
    for i, one in enumerate(found):
        labels[one.runs] = i
    attractors = tuple(one.name for one in found)
    dataset["label"] = (
        ("x1", "x2"),
        labels,
        {"long_name": "number of the attractor"}
        | flags({-1: "undecided", **dict(enumerate(attractors))}, "int32"),
    )
    known = (name for name in ("t1", "t0", "rtol", "atol") if name in dataset.attrs)
    settings = ", ".join(f"{name}={dataset.attrs[name]!r}" for name in known)
    dataset.attrs["call"] = (
        f'jaxbelt.basins(oscillator, x1=dataset["x1"], x2=dataset["x2"], {settings})'
    )
    return Basins(oscillator, dataset, attractors, tuple(cycles), boundary)


def _starts_along(values: Any, name: str) -> np.ndarray:
    """Checks the starts along one axis."""
    refuse_interval(values, name)
    along = np.asarray(as_finite(values, name, (None,)))
    require(along.size > 0, name, "one value or more", "none")
    require_value(np.all(np.diff(along) > 0), name, "increasing", along)
    return along


def _labels(osc: Oscillator, dataset: "xarray.Dataset") -> list[Found]:
    """The attractors that runs lead to, see `told_apart`, their cycles in own units."""
    kinds = np.asarray(decoded(dataset[["kind"]])["kind"])
    sticks = np.asarray(dataset["sticks"]).astype(bool)
    low, high = np.asarray(dataset["x1_min"]), np.asarray(dataset["x1_max"])
    rest, held, _ = rest_reached(osc, 0.5 * (low + high))
    runs = Runs.of(dataset, ("x1", "x2"))
    own, length = in_own_units(osc, np.asarray(dataset.attrs["length"])), dataset.attrs["length"]

    def of_run(first: tuple[int, ...]) -> Found:
        kind, stuck, cycle = kinds[first], sticks[first], None
        if kind == "cycle":
            start = np.array([dataset.x1[first[0]], dataset.x2[first[1]]]) / length
            cycle, same = cycle_from(own, jnp.asarray(start)), runs.same(runs.at(first))[0]
        else:
            # A mass that is stuck for ever may be anywhere on a segment.
            place = rest if kind == "equilibrium" else held
            same = np.all(sticks == stuck, axis=-1) & (place == place[first])
        return Found(words_for(kind, stuck, rest[first], length), same, cycle)

    return told_apart(kinds, of_run)


#: Largest distance of the end of a run from the equilibrium that captures it, in own units.
NEAR_REST = 1e-2


def rest_reached(osc: Oscillator, x1: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Equilibria, and segments of equilibria, near which runs have ended.

    x1: where runs have ended, any shape. Where no equilibrium is near, x1 itself is returned,
    rounded to `NEAR_REST`. Pieces of a segment across a contact edge are joined.

    Returns:
        x1 of the equilibrium of each run, the number of the segment nearest to each run, and the
        ends of all segments, [segments, 2].
    """
    own = in_own_units(osc)
    length = 1.0 if own is osc else float(own.units.length)
    near_rest, found = NEAR_REST * length, equilibria(osc)
    is_segment = np.asarray(found.kind) == EquilibriumKind.SEGMENT
    is_point = ~is_segment & (np.asarray(found.kind) != EquilibriumKind.SADDLE)
    lower, upper = np.asarray(found.x1_lower), np.asarray(found.x1_upper)
    rest, pieces = np.round(x1 / near_rest) * near_rest, np.stack([lower, upper], 1)[is_segment]
    segment, ends = np.zeros(x1.shape, int), np.zeros((0, 2))
    for which in (is_point, is_point & np.asarray(found.stable)):
        points = np.asarray(found.x1)[which]
        if len(points):
            nearest = points[np.argmin(np.abs(x1[..., None] - points), axis=-1)]
            rest = np.where(np.abs(nearest - x1) < near_rest, nearest, rest)
    if len(pieces):
        begins = np.append(True, pieces[1:, 0] > pieces[:-1, 1])
        outside = np.maximum(pieces[:, 0] - x1[..., None], x1[..., None] - pieces[:, 1])
        segment = (np.cumsum(begins) - 1)[np.argmin(outside, axis=-1)]
        ends = np.stack([pieces[begins, 0], pieces[np.append(begins[1:], True), 1]], axis=1)
    return rest, segment, ends


@announced("basin_stability")
@outside_of_traces
def basin_stability(
    oscillator: Oscillator,
    *,
    box: Any,
    n: int = 10_000,
    key: Array,
    t1: float = LONG_ENOUGH,
    t0: float = 0.0,
    rtol: float = 1e-8,
    atol: float | None = None,
) -> BasinStability:
    """Fraction of a box of starts that leads to each kind of attractor.

    The standard error of a fraction f is sqrt(f (1 - f) / n).

    Args:
        oscillator: The oscillator.
        box: ((x1 from, to), (x2 from, to)), dimensionless.
        n: Number of starts, drawn uniformly.
        key: Random key, from `jax.random.key`.
        t1: Time at which a run ends that has reached no attractor.
        t0: Time of the starts, for a forced oscillator.
        rtol: Relative tolerance of a step, as in `sweep`.
        atol: Absolute tolerance of a step, as in `sweep`.

    Returns:
        The `BasinStability`.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    check_oscillator(oscillator, "oscillator")
    corners, n = as_box(box), as_whole(n, "n")
    check_key(key)
    numbers = settings_of_runs(t1, rtol, atol)
    names: tuple[str, ...] = KINDS
    if has_clock(oscillator):
        names, numbers["t0"] = FORCED_KINDS, as_start(t0, numbers["t1"])
    kinds = _kinds(oscillator, starts_in(corners, n, key), **numbers)
    fractions = {name: float(np.mean(kinds == i)) for i, name in enumerate(names)}
    errors = {name: float(standard_error(f, n)) for name, f in fractions.items()}
    return BasinStability(fractions, errors, n)


def standard_error(fraction: Any, n: int) -> Any:
    """Standard error of fractions of n starts."""
    return np.asarray(np.sqrt(np.clip(fraction * (1 - np.asarray(fraction)), 0, None) / n))


def as_box(box: Any) -> np.ndarray:
    """Corners of a box of starts, [2, 2], x1 and x2 from and to, or a `ValueError`."""
    require_value(np.shape(box) == (2, 2), "box", "((x1 from, to), (x2 from, to))", box)
    return np.array([as_interval(ends, f"box[{i}], x{i + 1}") for i, ends in enumerate(box)])


def starts_in(corners: np.ndarray, n: int, key: Array) -> np.ndarray:
    """Starts drawn uniformly from a box, [2, n]."""
    low, high = corners[:, :1], corners[:, 1:]
    return np.asarray(jax.random.uniform(key, (2, n), minval=low, maxval=high))


def _kinds(osc: Oscillator, starts: np.ndarray, **numbers: Any) -> np.ndarray:
    """Codes of the kinds of attractors for starts [2, n], in the order of the starts."""
    observer = ForcedAttractor() if has_clock(osc) else Attractor()
    return results_from(in_units_of_run(osc), observer, starts, **numbers)["kind"].astype(int)
