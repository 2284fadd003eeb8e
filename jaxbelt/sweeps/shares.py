"""Which attractors there are: what a sweep over several starts says at each point of the others.

`attractors` takes the dataset of a sweep with `x1` or `x2` among its axes and puts, in the place of
the starts, an axis of attractors, each with the fraction of the starts that lead to it.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..checks import require
from ..cycles.attractors import APART, Runs
from .attractor import CYCLE, STUCK_FOR_EVER, UNDECIDED

if TYPE_CHECKING:
    import xarray

#: Starts that are compared at once, at most.
AT_ONCE = 2**18
#: Variables of a sweep that say nothing of an attractor.
OF_RUNS = ("transient", "status")


def attractors(dataset: "xarray.Dataset") -> "xarray.Dataset":
    """The attractors at each point of a sweep, the one that most starts lead to first.

    dataset: of `sweep(..., observe="attractor")` with `x1`, `x2` or both among its axes.
    Returns a dataset over the other axes and `attractor`: fraction, of the starts that lead there,
    and kind, signature, sticks, period, stick_duration, n_events and the extrema, of one of its
    runs. Where there are fewer attractors than elsewhere fraction is 0 and kind is undecided. What
    fractions lack to 1 are runs that were undecided.

    Two runs lead to one cycle if it has the same events and extent, to a hundredth of its size; to
    one equilibrium if it is at the same place; what is stuck for ever is one attractor for each set
    of belts.
    """
    require("kind" in dataset, "dataset", 'that of sweep(..., observe="attractor")', "one without")
    starts = [name for name in ("x1", "x2") if name in dataset.kind.dims]
    require(starts, "dataset", "one with an axis x1 or x2 of starts", f"{dataset.kind.dims}")
    others = [name for name in dataset.kind.dims if name not in starts]
    labels = _labels_of_starts(dataset, others, starts)
    order = (*others, *starts)
    sizes = [dataset.sizes[name] for name in others]
    count = int(labels.max(initial=0)) + 1
    numbers = np.arange(count)
    fractions = np.mean(labels[..., None] == numbers, axis=-2)
    # The first run of each attractor; where there is none, any.
    first = np.argmax(labels[..., None] == numbers, axis=-2)
    ranks = np.argsort(-fractions, axis=-1, kind="stable")
    fractions, first = (np.take_along_axis(part, ranks, axis=-1) for part in (fractions, first))
    coordinates: dict[str, Any] = {name: dataset.coords[name] for name in others}
    told = {"long_name": "fraction of the starts that lead there", "units": "1"}
    variables: dict[str, Any] = {"fraction": ((*others, "attractor"), fractions, told)}
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
    named = {"long_name": "number of the attractor", "units": "1"}
    coordinates["attractor"] = ("attractor", numbers, named)
    return dataset.drop_dims(order).assign_coords(coordinates).assign(variables)


def _nothing(dtype: np.dtype) -> np.ndarray:
    """What stands for an attractor that is not there."""
    return np.asarray(np.nan if np.issubdtype(dtype, np.floating) else 0, dtype)


def _labels_of_starts(
    dataset: "xarray.Dataset", others: list[str], starts: list[str]
) -> np.ndarray:
    """Numbers of the attractors, [.., starts], in the order in which they are met, or -1."""
    order = (*others, *starts)
    sizes = [dataset.sizes[name] for name in others]
    runs = Runs.of(dataset, order)
    kinds = dataset["kind"].transpose(*order).values.reshape(np.prod(sizes, dtype=int), -1)
    sticks = dataset["sticks"].transpose(*order, "belt").values.astype(bool)
    sticks = sticks.reshape(*kinds.shape, -1)
    places, signatures = runs.places.reshape(*kinds.shape, -1), runs.signatures.reshape(kinds.shape)
    labels = np.empty(kinds.shape, int)
    step = max(1, AT_ONCE // kinds.shape[1])
    for i in range(0, len(kinds), step):
        part = slice(i, i + step)
        of_part = Runs(places[part], signatures[part], runs.error)
        labels[part] = _labels_of(kinds[part], sticks[part], of_part)
    return labels.reshape(*sizes, -1)


def _labels_of(kinds: np.ndarray, sticks: np.ndarray, runs: Runs) -> np.ndarray:
    """The same of points by starts: the first start that has no number yet is compared with all."""
    labels, number = np.full(kinds.shape, -1), 0
    left = kinds != UNDECIDED
    rows = np.arange(len(kinds))
    while np.any(left):
        one = np.argmax(left, axis=1)
        there = rows[:, None], one[:, None]
        same = left & (kinds == kinds[there]) & np.all(sticks == sticks[there], axis=-1)
        first = Runs(runs.places[there], runs.signatures[there], runs.error)
        same &= _same_place(kinds, runs, first)
        labels[same & left[there]] = number
        left &= ~same
        number += 1
    return labels


def _same_place(kinds: np.ndarray, runs: Runs, one: Runs) -> np.ndarray:
    gap = np.max(np.abs(runs.places - one.places), axis=-1)
    size = np.ptp(one.places[..., :4], axis=-1)
    cycles = (runs.signatures == one.signatures) & (gap < APART * size)
    middle = np.abs(runs.places[..., 0] - one.places[..., 0])
    rests = middle < runs.error * (1 + np.abs(one.places[..., 0]))
    return np.where(kinds == CYCLE, cycles, rests | (kinds == STUCK_FOR_EVER))
