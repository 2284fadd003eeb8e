"""The motions of the oscillator at one value of a parameter: `Label`, and each
`AttractingCycle`."""

from collections import Counter
from collections.abc import Hashable
from typing import NamedTuple

from ..cycles.attractors import Itinerary, sticks
from ..cycles.chains import Loop
from ..model.equilibria import EquilibriumKind
from ..model.events import events_of
from ..results import EventKind


class Label(NamedTuple):
    """The motions at one value of the parameter.

    Attributes:
        equilibria: (kind, stable, contact codes), from left to right.
        cycles: Itineraries of the attracting cycles, in order.
        marks: Marks of further conditions that `scan` looks for.
        courses: Courses of the orbits that leave saddles of contact edges, see `connections`.
        bounded: Whether loops far out shrink, see `infinity`.
    """

    equilibria: tuple[tuple[int, bool, tuple[int, ...]], ...]
    cycles: tuple[Itinerary, ...]
    marks: tuple[Hashable, ...] = ()
    courses: tuple[Hashable, ...] = ()
    bounded: bool = True

    def is_as(self, other: "Label") -> bool:
        """Whether two labels are the same.

        Courses are compared only if there are as many saddles: a new saddle shows in the
        equilibria, and exactly there it does not exist yet.
        """
        courses = other.courses if len(self.courses) == len(other.courses) else self.courses
        return self == other._replace(courses=courses)

    def events(self, kind: EventKind) -> Counter[int]:
        """Number of events of a kind in the cycles, by belt."""
        return Counter(belt for path in self.cycles for one, belt in events_of(path) if one == kind)

    @property
    def foci(self) -> int:
        """Number of equilibria that attract, without segments."""
        return sum(
            stable and kind != EquilibriumKind.SEGMENT for kind, stable, _ in self.equilibria
        )

    @property
    def smooth(self) -> int:
        """Number of cycles that stick to no belt, without those that are only assumed."""
        return sum(bool(path) and not sticks(path) for path in self.cycles)


class AttractingCycle(NamedTuple):
    """An attracting cycle: its itinerary, and a loop of it, with room for more arcs.

    The loop of a cycle that does not stick solves the equations of the cycle, except where
    `approach` did not find where the orbit repeats.
    """

    path: Itinerary
    loop: Loop
