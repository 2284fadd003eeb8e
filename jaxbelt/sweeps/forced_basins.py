"""Labels of starts by the attractors of a forced oscillator; see `basins.basins`.

Runs lead to one periodic motion if Newton's method, from their states at a strobe, finds the same
one; runs whose states agree within their errors share one call of it. All chaotic motions have one
label, and all quasiperiodic ones another: no result of a run distinguishes two of them.
"""

from typing import TYPE_CHECKING

import numpy as np

from ..cycles.attractors import RUN, distance
from ..cycles.clocked import turns_of
from ..cycles.followed import PERIODS_AT_ONCE
from ..cycles.periodic import PeriodicMotion, nothing_found, periodic
from ..model.oscillator import Oscillator
from ..results import Status
from .datasets import decoded
from .naming import Found, told_apart, words_for

if TYPE_CHECKING:
    import xarray

#: Extents and the state at the strobe: runs for which these agree lead to one motion.
PLACES = ("x1_min", "x1_max", "x2_min", "x2_max", "x1_strobe", "x2_strobe")
#: Largest distance at the strobe between a run and its motion, over the size of the motion.
OF_RUN = 1e-3


def forced_labels(osc: Oscillator, dataset: "xarray.Dataset") -> list[Found]:
    """The attractors that runs lead to, see `told_apart`."""
    kinds = np.asarray(decoded(dataset[["kind"]])["kind"])
    columns = [np.asarray(dataset[name]) for name in PLACES]
    places, periods = np.nan_to_num(np.stack(columns, axis=-1)), np.asarray(dataset["periods"])
    sticks = np.asarray(dataset["sticks"]).astype(bool)
    error, length = RUN * float(dataset.attrs["rtol"]), float(dataset.attrs["length"])

    def of_run(first: tuple[int, ...]) -> Found:
        kind, motion = kinds[first], None
        same = np.all(sticks == sticks[first], axis=-1)
        if kind == "periodic":
            same &= periods == periods[first]
            same &= distance(places, places[first]) < error
            motion = _motion_near(osc, places[first], int(periods[first]))
            kind = f"{periods[first]}-periodic"
        elif kind == "equilibrium":
            same &= distance(places, places[first], length) < error
        return Found(words_for(kind, sticks[first], places[first][0], length), same, motion)

    return told_apart(kinds, of_run)


def _motion_near(osc: Oscillator, place: np.ndarray, n: int) -> PeriodicMotion:
    """The n-periodic motion that a run has come to; with the status NO_CONVERGENCE where Newton's
    method finds none, or another one, or n exceeds `PERIODS_AT_ONCE`."""
    if n > PERIODS_AT_ONCE:
        return nothing_found(osc, turns_of(osc), Status.NO_CONVERGENCE.value)
    motion = periodic(osc, place[4:], periods=n)
    if int(motion.status) == Status.OK:
        size = max(float(np.ptp(place[:2])), float(np.ptp(place[2:4])))
        gaps = np.max(np.abs(np.asarray(motion.starts) - place[4:]), axis=-1)
        if np.min(gaps) <= OF_RUN * size:
            return motion
    return nothing_found(osc, turns_of(osc), Status.NO_CONVERGENCE.value)
