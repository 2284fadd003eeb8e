"""Points of codimension two, which curves of bifurcation points pass or end in: `SpecialPoint`."""

from typing import TYPE_CHECKING, Any, NamedTuple

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
