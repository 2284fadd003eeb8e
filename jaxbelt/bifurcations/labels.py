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
        equilibria: (kind, stable, contact codes) of each equilibrium, from left to right.
        cycles: Itineraries of the attracting cycles, sorted.
        marks: `AbstractCondition.mark` of each of the user's own conditions.
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

        Courses are compared only if both labels have the same number of saddles: a saddle that
        appears changes the equilibria, too, and at exactly that value it does not exist yet.
        """
        courses = other.courses if len(self.courses) == len(other.courses) else self.courses
        return self == other._replace(courses=courses)

    def events(self, kind: EventKind) -> Counter[int]:
        """Number of events of one kind in all cycles, by belt."""
        return Counter(belt for path in self.cycles for one, belt in events_of(path) if one == kind)

    @property
    def foci(self) -> int:
        """Number of stable equilibria, segments not counted."""
        return sum(
            stable and kind != EquilibriumKind.SEGMENT for kind, stable, _ in self.equilibria
        )

    @property
    def smooth(self) -> int:
        """Number of cycles that stick to no belt, not counting assumed ones (empty itineraries)."""
        return sum(bool(path) and not sticks(path) for path in self.cycles)


class AttractingCycle(NamedTuple):
    """An attracting cycle: its itinerary, () if it is only assumed, and a loop of it, padded.

    The loop of a cycle that does not stick solves the equations of the cycle. That of an assumed
    cycle does not: it is the last loop of an orbit for which `approach` found no repetition.
    """

    path: Itinerary
    loop: Loop
