"""Points of codimension two, which curves of bifurcation points pass or end in: `SpecialPoint`; and
the last stretch of a curve, by which its condition tells what it ends in: `Trail`."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..model.variations import Variation
from ..numerics.continuation import Stop
from ..results import draw
from ..tables import table_of

if TYPE_CHECKING:
    import pandas


class SpecialPoint(NamedTuple):
    """A point of codimension two on a curve.

    kind: "DegenerateHopf" (first Lyapunov coefficient 0: a fold of cycles shrinks to a Hopf point),
    "FoldGrazing" (a cycle of multiplier 1 touches a boundary: a nonsmooth fold turns into a grazing
    point, and a fold of cycles ends), "DoubleSliding" (another boundary is touched, too),
    "BoundaryHopf" (a Hopf point on a contact edge: there the curves of boundary equilibria and of
    pseudo-Hopf points meet its own), "BoundaryEquilibrium" (a side of a saddle ceases to push away,
    and its connection ends), "MeetingEdges" (the saddles of a connection come together),
    "BeltAtRest", "EqualVelocities", or what a condition of your own watches; belts: concerned;
    values: of the two parameters; residual: the largest error in all
    equations.
    """

    kind: str
    belts: tuple[int, ...]
    values: tuple[float, float]
    residual: float

    def table(self) -> "pandas.DataFrame":
        """One row: kind, belts, value_0 and value_1 of the two parameters, residual."""
        belts, (first, second) = " ".join(map(str, self.belts)), self.values
        row = {"kind": self.kind, "belts": belts, "value_0": first, "value_1": second}
        return table_of([row | {"residual": self.residual}])

    def plot(self, ax: Any = None) -> Any:
        """Draw it as a dot with its name in the plane of the two parameters, into the axes `ax`
        (None: new ones), which are returned."""
        return draw(self, ax)


class Trail(NamedTuple):
    """The last stretch of a curve, as its condition is asked where it leads.

    variation: of the two parameters; step: between rows; values: of the parameters in the last
    rows, three at most, [rows, 2]; system, x: of the last row; end: why the stretch ends there.
    """

    variation: Variation
    step: float
    values: np.ndarray
    system: Any
    x: np.ndarray
    end: Stop

    def stopping(self) -> "Stopping | None":
        """A belt that comes to rest and whose velocity one of the parameters alone decides."""
        if len(self.values) < 3:
            return None
        oscs = [self.variation.oscillator(row) for row in self.values]
        family = self.variation.family(self.values[-1])
        slopes = [family.belt_slopes(belt, "velocity") for belt in range(len(oscs[0].belts))]
        for held in (0, 1):
            for belt, slope in enumerate(slopes):
                v = np.array([float(osc.belts[belt].velocity) for osc in oscs])
                near = 0 < abs(v[-1]) < min(abs(v[-2]), 2 * self.step * abs(slope[held]))
                if slope[held] != 0 and slope[1 - held] == 0 and near:
                    along = self.variation.held(1 - held, self.values[-1, 1 - held])
                    return Stopping(held, belt, along.rest_of(belt, self.values[-1, held]), v)
        return None


class Stopping(NamedTuple):
    """A belt that comes to rest at the end of a curve.

    held: which parameter decides its velocity, 0 or 1; belt: its number; value: of that parameter
    where it is at rest; velocities: in the last rows.
    """

    held: int
    belt: int
    value: float
    velocities: np.ndarray
