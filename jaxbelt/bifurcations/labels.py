"""What the oscillator does at one value of a parameter: `Label`, and each `AttractingCycle`."""

from collections import Counter
from collections.abc import Hashable
from typing import NamedTuple

from ..cycles.attractors import Itinerary, sticks
from ..cycles.chains import Loop
from ..model.equilibria import EquilibriumKind
from ..model.events import events_of
from ..results import EventKind


class Label(NamedTuple):
    """What there is at one value: (kind, stable, contact codes) of the equilibria from left to
    right, the itineraries of the attracting cycles in order, the marks of further conditions that
    `scan` was asked to look for, the courses of the orbits that leave saddles of contact edges, see
    `connections`, and whether loops far out shrink, see `infinity`."""

    equilibria: tuple[tuple[int, bool, tuple[int, ...]], ...]
    cycles: tuple[Itinerary, ...]
    marks: tuple[Hashable, ...] = ()
    courses: tuple[Hashable, ...] = ()
    bounded: bool = True

    def is_as(self, other: "Label") -> bool:
        """Whether two labels tell the same.

        Courses are compared where there are as many saddles: one that begins to be there is told by
        the equilibria, and just there it is not one yet.
        """
        courses = other.courses if len(self.courses) == len(other.courses) else self.courses
        return self == other._replace(courses=courses)

    def events(self, kind: EventKind) -> Counter[int]:
        """How often there is an event of a kind in the cycles, by its belt."""
        return Counter(belt for path in self.cycles for one, belt in events_of(path) if one == kind)

    @property
    def foci(self) -> int:
        """How many equilibria attract, but for segments."""
        return sum(
            stable and kind != EquilibriumKind.SEGMENT for kind, stable, _ in self.equilibria
        )

    @property
    def smooth(self) -> int:
        """How many cycles stick to no belt; one that is only taken to be there is none."""
        return sum(bool(path) and not sticks(path) for path in self.cycles)


class AttractingCycle(NamedTuple):
    """An attracting cycle: its itinerary, and a loop of it, with room for more arcs.

    The loop of one that does not stick solves the equations of the cycle, but where `approach` did
    not tell where the orbit settles.
    """

    path: Itinerary
    loop: Loop
