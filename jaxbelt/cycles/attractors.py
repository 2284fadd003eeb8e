"""Identity of attractors: `itinerary`, `place_of`, `distance` and `is_same`.

The events of one loop do not identify a cycle: there may be two cycles with one sequence of events.
Two properties do:

- Its itinerary: the sequence of its modes, each with the contact code of every belt. So it tells on
  which side of every contact edge the mass sticks, and with which sign of r it slips. The modes
  determine where a stick phase ends, and from there the orbit continues in one way only: there is
  at most one sticking cycle with each itinerary.
- Its place: its extent in x1 and x2, and its period. Orbits that do not stick never meet, so of two
  such cycles one lies inside the other, or beside it.
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

#: The modes of one loop, each the contact codes of all belts, in their least cyclic order.
Itinerary = tuple[tuple[int, ...], ...]
#: Arcs no longer than this exist by rounding only: arcs between two events at one place last 1e-26,
#: arcs beside a bifurcation that is narrowed to 1e-9 of a span some 1e-9.
MOMENT = 1e-13
#: An arc that vanishes as the square of a distance may take more than MOMENT at one value of a
#: parameter and less at the next one; it counts at both if it lasts longer than LEAST_MOMENT.
LEAST_MOMENT = 1e-16
#: Distance below which two cycles found by shooting are the same: the shooting equations hold to
#: 1e-9, and beside a fold a cycle moves by ten thousand times that error.
SAME_CYCLE = 1e-5
#: For runs of a sweep this distance is RUN * tolerance: errors are 10 to 1000 times the tolerance.
RUN = 1e3
#: Distance below which two motions may be the same: ends of two pieces of one branch, or runs of
#: which neither distance nor events decide this, so that shooting has to.
MAYBE_SAME = 1e-2
#: Distance below which unstable cycles at two successive values of a parameter are one branch.
GOES_ON = 0.3


def itinerary(idle: np.ndarray, loop: Cycle | Loop, moment: float = MOMENT) -> Itinerary:
    """The modes of one loop in order, the same whichever arc the loop begins with.

    idle: mask [belts] of belts without load, see `idle_belts`.
    Modes that last no longer than `moment` are left out: where slip onset lies on an edge, rounding
    decides which of the two events comes first.
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
    """Mask [.., belts] of belts without load, which exert no friction."""
    return np.stack([np.asarray(belt.load) == 0 for belt in osc.belts], axis=-1)


def without_idle(idle: np.ndarray, modes: np.ndarray) -> np.ndarray:
    """Contact codes, [.., belts], in which the idle belts count as not touching."""
    return np.where(idle, int(ABOVE), modes)


def sticks(path: Itinerary) -> bool:
    """Whether the mass sticks to some belt along this itinerary."""
    return any(0 in mode for mode in path)


def stuck_belts(path: Itinerary) -> frozenset[int]:
    """Numbers of the belts that the mass sticks to along this itinerary."""
    return frozenset(belt for mode in path for belt, code in enumerate(mode) if code == 0)


#: The dimensions of the five numbers of a place, see `own_units.quantity`.
PLACE_DIMENSIONS = ("length", "length", "velocity", "velocity", "time")


def place_of(cycle: Cycle | Loop) -> np.ndarray:
    """Place of a cycle: smallest and largest x1, smallest and largest x2, period."""
    return extent(arcs_of(cycle)[1])


def arcs_of(cycle: Cycle | Loop) -> tuple[Chain | Loop, np.ndarray]:
    """The chain or loop of a cycle, and (x1, x2, T) of its used arcs, [arcs, 3]."""
    if isinstance(cycle, Cycle):
        loop, rows = cycle.chain, np.asarray(cycle.unknowns)
    else:
        loop, rows = cycle, np.column_stack([cycle.entries, cycle.durations])
    return loop, rows[np.asarray(loop.ends) != Ends(loop.codes.shape[-1]).unused]


def extent(rows: np.ndarray) -> np.ndarray:
    """`place_of` from (x1, x2, T) of the used arcs, [arcs, 3]."""
    x1, x2, durations = rows.T
    return np.array([x1.min(), x1.max(), x2.min(), x2.max(), durations.sum()])


def distance(place: ArrayLike, other: ArrayLike, least: float = 0.0) -> Any:
    """Relative distance between motions by their places, [.., 5], or the first numbers of places.

    It is the largest difference, divided by the size of the larger motion (the range of its first
    four numbers), or by `least` where that is larger.
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
    """Largest `distance` between places of one and the same cycle in runs with these tolerances.

    numbers: rtol and atol, as in the attributes of a sweep. length: unit of length of atol."""
    atol = numbers.get("atol")
    return RUN * max(numbers["rtol"], 0.0 if atol is None else atol / length)


@dataclass(frozen=True)
class Runs:
    """Places, in own units, and signatures of the attractors that the runs of a sweep reach.

    places: as `place_of`, [.., 5], with the period 0 at rest; signatures: names, [..]; error: see
    `error_of_runs`.
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
        """Masks of the pairs of runs that lead to one cycle, and of the uncertain pairs."""
        away = distance(self.places, others.places)
        fits = self.signatures == others.signatures
        same = fits & (away < self.error)
        return same, ~same & (away < max(MAYBE_SAME, 10 * self.error))
