"""The attractors of a sweep over several starts, with their shares, at each point of the other
axes.

`attractors` takes the dataset of a sweep with `x1` or `x2` among its axes and replaces the starts
by an axis of attractors, each with the fraction of the starts that lead to it.
`numbers_of_attractors` decides which runs at one point lead to the same attractor.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from ..activity import announced
from ..checks import require, require_callable
from ..cycles.attractors import Runs, is_same
from ..cycles.cycle import cycle_from
from ..model.oscillator import Oscillator
from ..model.own_units import in_own_units
from ..results import Status
from .attractor import CYCLE, EQUILIBRIUM, UNDECIDED
from .datasets import check_dataset

if TYPE_CHECKING:
    import xarray

#: Largest number of starts that are compared at once.
AT_ONCE = 2**18
#: Variables of a sweep that do not describe an attractor.
OF_RUNS = ("transient", "status")
#: Coordinates that are no arguments of the function of the sweep.
NO_PARAMETERS = ("x1", "x2", "belt")


@announced("attractors")
def attractors(
    dataset: "xarray.Dataset", make: Callable[..., Oscillator] | None = None
) -> "xarray.Dataset":
    """The attractors at each point of a sweep, in the order of their fractions of starts.

    Two runs lead to one cycle if they agree in events, extrema and period, to a thousand times the
    tolerance of the sweep; to one equilibrium if it is at the same place; a mass that is stuck for
    ever has one attractor for each set of belts. Cycles that differ by more than that, but by less
    than a hundredth of their size, may be one that attracts weakly, or several: shooting decides,
    and cycles that it does not find are undecided.

    Args:
        dataset: From `sweep(..., observe="attractor")` with `x1`, `x2` or both among its axes.
        make: The function of the sweep; only cycles that are very near to one another need it.

    Returns:
        A dataset over the other axes and `attractor`. Its variables are fraction, of the starts
        that lead there, and kind, signature, sticks, period, stick_duration, n_events and the
        extrema, of one of its runs. Where there are fewer attractors than elsewhere the fraction
        is 0 and the kind undecided. Fractions add up to 1 minus the share of undecided runs.

    Raises:
        ValueError: If the dataset is not of such a sweep, or if `make` is needed and not given.
    """
    check_dataset(dataset)
    require("kind" in dataset, "dataset", 'that of sweep(..., observe="attractor")', "one without")
    forced = "periods" in dataset
    require(
        not forced, "dataset", "of oscillators without a clock", "one of forced ones: jb.basins"
    )
    missing = int(np.sum(dataset["kind"].values < UNDECIDED))
    require(
        not missing, "dataset", "of a sweep that is done", f"one with {missing:,} runs not done"
    )
    if make is not None:
        require_callable(make, "make", "the function of the sweep")
    starts = [name for name in ("x1", "x2") if name in dataset.kind.dims]
    require(starts, "dataset", "one with an axis x1 or x2 of starts", f"{dataset.kind.dims}")
    others = [name for name in dataset.kind.dims if name not in starts]
    order = (*others, *starts)
    sizes = [dataset.sizes[name] for name in others]
    runs = Runs.of(dataset, order)
    shape = -1, int(np.prod([dataset.sizes[name] for name in starts]))
    runs = replace(
        runs, places=runs.places.reshape(*shape, 5), signatures=runs.signatures.reshape(shape)
    )
    kinds = dataset["kind"].transpose(*order).values.reshape(shape)
    sticks = dataset["sticks"].transpose(*order, "belt").values.astype(bool)

    def oscillator(point: int) -> Oscillator:
        assert make is not None
        place = dict(zip(others, np.unravel_index(point, sizes), strict=True))
        here = dataset.isel({name: int(i) for name, i in place.items()})
        given = (str(name) for name in here.coords if name not in NO_PARAMETERS)
        numbers = {name: float(here[name]) for name in given}
        return in_own_units(make(**numbers), np.asarray(dataset.attrs["length"]))

    known = None if make is None else oscillator
    labels = numbers_of_attractors(kinds, sticks.reshape(*kinds.shape, -1), runs, known)
    labels = labels.reshape(*sizes, -1)
    count = int(labels.max(initial=0)) + 1
    numbers = np.arange(count)
    fractions = np.mean(labels[..., None] == numbers, axis=-2)
    # The first run of each attractor; where there is none, any run.
    first = np.argmax(labels[..., None] == numbers, axis=-2)
    ranks = np.argsort(-fractions, axis=-1, kind="stable")
    fractions, first = (np.take_along_axis(part, ranks, axis=-1) for part in (fractions, first))
    coordinates: dict[str, Any] = {name: dataset.coords[name] for name in others}
    attributes = {"long_name": "fraction of the starts that lead there"}
    variables: dict[str, Any] = {"fraction": ((*others, "attractor"), fractions, attributes)}
    for name, one in dataset.items():
        if name in OF_RUNS or not set(order) <= set(one.dims):
            continue
        extra = [dim for dim in one.dims if dim not in order]
        values = one.transpose(*order, *extra).values
        values = values.reshape(*sizes, -1, *values.shape[len(order) :])
        index = first.reshape(*first.shape, *[1] * len(extra))
        values = np.take_along_axis(values, index, axis=len(sizes))
        missing = (fractions == 0).reshape(index.shape)
        values = np.where(missing, _nothing(values.dtype), values)
        variables[str(name)] = ((*others, "attractor", *extra), values, one.attrs)
    named = {"long_name": "number of the attractor"}
    coordinates["attractor"] = ("attractor", numbers, named)
    return dataset.drop_dims(order).assign_coords(coordinates).assign(variables)


def _nothing(dtype: np.dtype) -> np.ndarray:
    """Value of a variable for an attractor that does not exist."""
    return np.asarray(np.nan if np.issubdtype(dtype, np.floating) else 0, dtype)


def _labels_of(kinds: np.ndarray, sticks: np.ndarray, runs: Runs) -> np.ndarray:
    """Numbers of the attractors, [points, starts], or -1.

    The first start without a number is compared with all others, again and again.
    """
    labels, number = np.full(kinds.shape, -1), 0
    unnumbered = kinds != UNDECIDED
    rows = np.arange(len(kinds))
    while np.any(unnumbered):
        there = rows[:, None], np.argmax(unnumbered, axis=1)[:, None]
        same = kinds == kinds[there]
        first = runs.at(there)
        middle = np.abs(runs.places[..., 0] - first.places[..., 0])
        rests = middle < runs.error * (1 + np.abs(first.places[..., 0]))
        stuck = np.all(sticks == sticks[there], axis=-1)
        rests = np.where(kinds == EQUILIBRIUM, rests, stuck)
        same &= np.where(kinds == CYCLE, runs.same(first)[0], rests)
        labels[same & unnumbered & unnumbered[there]] = number
        unnumbered &= ~same
        number += 1
    return labels


def numbers_of_attractors(
    kinds: np.ndarray,
    sticks: np.ndarray,
    runs: Runs,
    oscillator: Callable[[int], Oscillator] | None,
) -> np.ndarray:
    """Numbers of the attractors of the runs at each point, in the order in which they are met, or
    -1.

    Args:
        kinds: Codes, [points, runs].
        sticks: Codes that distinguish attractors of masses stuck for ever, [points, runs, ..].
        runs: Places of the attractors.
        oscillator: Returns the oscillator of a point; None: an error where shooting has to decide.

    Returns:
        The numbers, [points, runs].
    """
    labels = np.empty(kinds.shape, int)
    step = max(1, AT_ONCE // kinds.shape[1])
    for i in range(0, len(kinds), step):
        part = slice(i, i + step)
        labels[part] = _labels_of(kinds[part], sticks[part], runs.at((part,)))
    doubts = _doubts(kinds, labels, runs)
    if doubts and oscillator is None:
        needed = "given, the function of the sweep, for cycles that only shooting tells apart"
        require(False, "make", needed, f"None; there are such at {len(doubts)} points")
    for point, pairs in doubts.items():
        assert oscillator is not None
        labels[point] = _decided(oscillator(point), labels[point], runs.places[point], pairs)
    return labels


# --- cycles that the runs do not distinguish ------------------------------------------------------


def _decided(
    osc: Oscillator, labels: np.ndarray, places: np.ndarray, pairs: list[tuple[int, int]]
) -> np.ndarray:
    """The numbers at a point after shooting has decided which of the pairs are one cycle."""
    cycles, decided = {}, labels.copy()
    for number in sorted({number for pair in pairs for number in pair}):
        # Shooting starts where the cycle turns back, at (x1_max, 0): runs know this state best.
        x1_max = places[np.argmax(labels == number), 1]
        cycles[number] = cycle_from(osc, jnp.asarray(np.array([x1_max, 0.0])))
        if int(cycles[number].status) != Status.OK or not bool(cycles[number].stable):
            decided[labels == number] = -1
    for one, other in pairs:
        if is_same(cycles[one], cycles[other]):
            first, second = (decided[np.argmax(labels == number)] for number in (one, other))
            decided[decided == second] = first
    known = decided >= 0
    decided[known] = np.unique(decided[known], return_inverse=True)[1]
    return decided


def _doubts(kinds: np.ndarray, labels: np.ndarray, runs: Runs) -> dict[int, list[tuple[int, int]]]:
    """For each point in doubt the pairs of numbers that may belong to one cycle."""
    rows = np.arange(len(labels))
    numbers = range(int(labels.max(initial=-1)) + 1)
    there = [(rows, np.argmax(labels == number, axis=1)) for number in numbers]
    cycle = [np.any((labels == k) & (kinds == CYCLE), axis=1) for k in numbers]
    doubts: dict[int, list[tuple[int, int]]] = {}
    for one, other in combinations(numbers, 2):
        open_ = runs.at(there[one]).same(runs.at(there[other]))[1]
        for point in np.flatnonzero(cycle[one] & cycle[other] & open_).tolist():
            doubts.setdefault(point, []).append((one, other))
    return doubts
