"""Identity of attractors: `itinerary`, `place_of`, `distance` and `is_same`.

The events of one loop do not identify a cycle: there may be two cycles with one sequence of events.
Two properties do:

- Its itinerary: the modes that it passes, whole ones, with the contact of every belt in each. So it
  says on which side of every contact edge the mass sticks, and with which sign of r it slips. A
  stick phase ends at a place that its modes determine, and the orbit goes on from there in one way
  only: of cycles that stick there is one with each itinerary.
- Its place: its extent, and its period. Orbits that do not stick do not meet, so of two such cycles
  one lies inside of the other, or beside it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..model.events import of_one_loop
from ..model.modes import ABOVE
from ..model.oscillator import Oscillator
from ..model.own_units import rescaled_quantity
from ..motion.arcs import Ends
from ..results import Status
from .chains import Chain, Loop, modes_of
from .cycle import Cycle

if TYPE_CHECKING:
    import xarray

#: The modes of one loop, contact codes of all belts each, beginning with the least of their orders.
Itinerary = tuple[tuple[int, ...], ...]
#: Arcs that take no longer exist by rounding only: those between two events at one place take
#: 1e-26, and where a bifurcation is narrowed to 1e-9 of a span some 1e-9.
MOMENT = 1e-13
#: An arc that vanishes as the square of a distance may take more than MOMENT at one value of a
#: parameter and less at the next one; it counts at both if it takes longer than this.
LEAST_MOMENT = 1e-16
#: Distance below which two cycles that shooting solved for are the same: its equations hold to
#: 1e-9, and beside a fold a cycle moves by ten thousand times that.
SAME_CYCLE = 1e-5
#: The same for runs of a sweep, times its tolerance: its errors are ten to a thousand times that.
RUN = 1e3
#: Distance below which two motions may be the same: ends of two pieces of one branch; runs whose
#: distance or events leave it open, which shooting then decides.
MAYBE_SAME = 1e-2
#: Distance below which an unstable cycle goes on to one at the next value of a parameter.
GOES_ON = 0.3


def itinerary(idle: np.ndarray, loop: Cycle | Loop, moment: float = MOMENT) -> Itinerary:
    """The modes of one loop in order, from whatever place it was begun.

    idle: see `idle_belts`.
    Modes that last no longer than `moment` are left out: where slip onset lies on an edge rounding
    decides which comes first.
    """
    chain, rows = arcs_of(loop)
    modes, lasts = modes_of(chain), rows[:, 2] > moment
    modes = without_idle(idle, modes[lasts] if np.any(lasts) else modes)
    changes = [
        tuple(mode.tolist())
        for before, mode in zip(np.roll(modes, 1, axis=0), modes, strict=True)
        if np.any(mode != before)
    ]
    return of_one_loop(changes or [tuple(modes[0].tolist())])


def idle_belts(osc: Oscillator) -> np.ndarray:
    """Which belts have no load, so that they do nothing, [.., belts]."""
    return np.stack([np.asarray(belt.load) == 0 for belt in osc.belts], axis=-1)


def without_idle(idle: np.ndarray, modes: np.ndarray) -> np.ndarray:
    """Contact codes, [.., belts], in which belts that do nothing are absent."""
    return np.where(idle, int(ABOVE), modes)


def sticks(path: Itinerary) -> bool:
    """Whether the mass sticks to a belt."""
    return any(0 in mode for mode in path)


def stuck_belts(path: Itinerary) -> frozenset[int]:
    """The belts that the mass sticks to."""
    return frozenset(belt for mode in path for belt, code in enumerate(mode) if code == 0)


#: The dimensions of a place, see `own_units.quantity`.
PLACE_DIMENSIONS = ("length", "length", "velocity", "velocity", "time")


def place_of(cycle: Cycle | Loop) -> np.ndarray:
    """Place of a cycle: smallest and largest x1, smallest and largest x2, period."""
    return extent(arcs_of(cycle)[1])


def arcs_of(cycle: Cycle | Loop) -> tuple[Chain | Loop, np.ndarray]:
    """The arcs of a cycle, and (x1, x2, T) of those that are used, [arcs, 3]."""
    if isinstance(cycle, Cycle):
        loop, rows = cycle.chain, np.asarray(cycle.unknowns)
    else:
        loop, rows = cycle, np.column_stack([cycle.entries, cycle.durations])
    return loop, rows[np.asarray(loop.ends) != Ends(loop.codes.shape[-1]).unused]


def extent(rows: np.ndarray) -> np.ndarray:
    """`place_of` from (x1, x2, T) of the arcs that are used, [arcs, 3]."""
    x1, x2, durations = rows.T
    return np.array([x1.min(), x1.max(), x2.min(), x2.max(), durations.sum()])


def distance(place: ArrayLike, other: ArrayLike, least: float = 0.0) -> Any:
    """Distance between motions by their places, [.., 5], or the first numbers of them.

    It is relative to the size of the larger motion, its largest extent; to `least` where that is
    larger.
    """
    one, two = np.asarray(place), np.asarray(other)
    size = np.maximum(np.ptp(one[..., :4], axis=-1), np.ptp(two[..., :4], axis=-1))
    size = np.maximum(size, least)
    return np.max(np.abs(one - two), axis=-1) / np.where(size > 0, size, 1.0)


def is_same(cycle: Cycle, other: Cycle) -> bool:
    """Whether two cycles of one oscillator are the same; both with status OK."""
    if int(cycle.status) != Status.OK or int(other.status) != Status.OK:
        return False
    modes, others = (itinerary(idle_belts(one.oscillator), one) for one in (cycle, other))
    return modes == others and bool(distance(place_of(cycle), place_of(other)) < SAME_CYCLE)


def distinct(cycles: Sequence[Cycle]) -> list[Cycle]:
    """Each of the cycles with status OK once."""
    found: list[Cycle] = []
    for cycle in cycles:
        known = any(is_same(cycle, other) for other in found)
        if int(cycle.status) == Status.OK and not known:
            found.append(cycle)
    return found


# --- attractors of the runs of a sweep ------------------------------------------------------------


def error_of_runs(numbers: Mapping[str, Any], length: float) -> float:
    """Largest distance of places of one cycle, relative to its size, in runs with such
    tolerances."""
    atol = numbers.get("atol")
    return RUN * max(numbers["rtol"], 0.0 if atol is None else atol / length)


@dataclass(frozen=True)
class Runs:
    """Places of the attractors of the runs of a sweep, and their events, in own units.

    places: as `place_of`, [.., 5], with the period 0 at rest; signatures: names, [..]; error:
    largest distance of places of one cycle, relative to its size.
    """

    places: np.ndarray
    signatures: np.ndarray
    error: float

    @classmethod
    def of(cls, dataset: "xarray.Dataset", dims: Sequence[str]) -> "Runs":
        names = ("x1_min", "x1_max", "x2_min", "x2_max", "period")
        columns = [dataset[name].transpose(*dims).values for name in names]
        places = rescaled_quantity(
            np.nan_to_num(np.stack(columns, axis=-1)),
            1 / np.asarray(dataset.attrs["length"]),
            PLACE_DIMENSIONS,
        )
        meanings = np.array(dataset["signature"].attrs["flag_meanings"].split())
        signatures = meanings[dataset["signature"].transpose(*dims).values]
        return cls(places, signatures, error_of_runs(dataset.attrs, dataset.attrs["length"]))

    def at(self, index: Any) -> "Runs":
        """Some of the runs, by an index of the arrays."""
        return Runs(self.places[index], np.asarray(self.signatures[index]), self.error)

    def same(self, others: "Runs") -> tuple[np.ndarray, np.ndarray]:
        """Which pairs of runs lead to one cycle, and for which pairs this is not certain."""
        away = distance(self.places, others.places)
        fits = self.signatures == others.signatures
        same = fits & (away < self.error)
        return same, ~same & (away < max(MAYBE_SAME, 10 * self.error))
