"""Points of codimension two, which curves of bifurcation points pass or end in: `SpecialPoint`.

`Trail` is the last stretch of a curve, from which its condition finds the point in which it ends.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..cycles.attractors import distance
from ..model.oscillator import has_clock
from ..model.variations import Variation
from ..numerics.continuation import Stop
from ..results import draw
from ..tables import table_of

if TYPE_CHECKING:
    import pandas

#: A curve that comes so near, in the parameters, to a belt at rest arrives in no number of steps.
CREEPS = 1e-6
#: A cycle that reaches beyond an edge by less than TOUCHES hardly touches it; less than TOUCHED is
#: rounding.
TOUCHES, TOUCHED = 1e-5, 1e-13
#: Largest change of a cycle or fixed point in a step, relative to its size. Along curves of classes
#: (b), (c) and (d) it was 0.15 at most.
FAR = 0.2


class SpecialPoint(NamedTuple):
    """A point of codimension two on a curve.

    Kinds are "DegenerateHopf" (first Lyapunov coefficient 0: a fold of cycles shrinks to a Hopf
    point), "DegeneratePseudoHopf" (the same at a pseudo-focus), "DoubleBoundaryEquilibrium" (both
    sides of the edge have their equilibrium on it: persistence turns into annihilation),
    "FoldGrazing" (a cycle of multiplier 1 touches a boundary: a nonsmooth fold turns into a grazing
    point, and a fold of cycles ends), "DoubleSliding" (another boundary is touched, too, or met
    where the cycle passes an edge), "EdgeTouch" (on an edge a cycle turns back, is tangent to a
    boundary, or begins to slip), "BoundaryHopf" (a Hopf point on a contact edge: there the curves
    of boundary equilibria and of pseudo-Hopf points meet its own), "BoundaryEquilibrium" (a side of
    a saddle ceases to push away, and its connection ends; or the mass ceases to rest where edges
    meet), "MeetingEdges" (the saddles of a connection come together), "BeltAtRest",
    "EqualVelocities", or a function that your own condition watches. With forcing: a condition that
    holds, too ("PeriodDoubling", "Fold", "Torus", "GrazingSliding", "CrossingSliding",
    "SwitchingSliding", "AddingSliding", "GrazingEdge", "CornerCollision"; the events of the motion
    change there), or a strong resonance ("Resonance1to1" to "Resonance1to4": the multipliers of a
    torus are 1 and 1, -1 and -1, third or fourth roots of 1; Y. A. Kuznetsov, Elements of Applied
    Bifurcation Theory, chapter 9).

    Attributes:
        kind: The kind.
        belts: Numbers of the belts concerned.
        values: Values of the two parameters.
        residual: Largest error in all equations; where the end of a curve is extrapolated, or the
            events of a motion change, the error of the values.
    """

    kind: str
    belts: tuple[int, ...]
    values: tuple[float, float]
    residual: float

    def measured_in(self, units: np.ndarray) -> "SpecialPoint":
        """The same point with its values converted from these units of the parameters, [2]."""
        first, second = (value * float(unit) for value, unit in zip(self.values, units))
        return self._replace(values=(first, second))

    def table(self) -> "pandas.DataFrame":
        """Returns one row; columns: kind, belts, value_0 and value_1 of the two parameters,
        residual."""
        belts, (first, second) = " ".join(map(str, self.belts)), self.values
        row = {"kind": self.kind, "belts": belts, "value_0": first, "value_1": second}
        return table_of([row | {"residual": self.residual}])

    def plot(self, ax: Any = None) -> Any:
        """Draws the point as a dot with its name in the plane of the two parameters.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)


def is_elsewhere(place: np.ndarray, other: np.ndarray, far: float) -> bool:
    """Whether the places of two points, a step or less apart, are of different motions; False where
    a place is NaN."""
    return bool(distance(place[:4], other[:4], least=far) > far)


def extrapolated_to_zero(x: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Value at x = 0 of the polynomial through `values`, [rows] or [rows, k], at x, [rows]."""
    from scipy.interpolate import KroghInterpolator  # half a second that only curves need

    return np.asarray(KroghInterpolator(x, values)(0.0))


def where_belts_stop(
    variation: Variation, values: np.ndarray, near: float, far: float
) -> SpecialPoint | None:
    """The point where belts come to rest at the end of a curve, if a belt is near to rest.

    The time that the mass sticks goes to infinity there, so no step leads there. If two belts come
    to rest, their velocities determine both parameters, else one: the limit of the other one is
    extrapolated, and the residual is the difference between a parabola and a line there.

    Args:
        variation: Of both parameters.
        values: Values in the last rows, [rows, 2].
        near: Distance in the parameters up to which a belt counts as near to rest.
        far: Largest distance of the point from the last row.
    """
    if len(values) < 3 or has_clock(variation.oscillator(values[-1])):
        return None
    family = variation.family(values[-1])
    belts = range(len(family.oscillator.belts))
    slopes = np.array([family.belt_slopes(belt, "velocity") for belt in belts], float)
    oscs = [variation.oscillator(row) for row in values[-3:]]
    v = np.array([[float(osc.belts[belt].velocity) for osc in oscs] for belt in belts])
    size = np.abs(v)
    falls = (0 < size[:, 2]) & (size[:, 2] < size[:, 1]) & (size[:, 1] < size[:, 0])
    stop = np.flatnonzero(falls & (size[:, 2] < near * np.linalg.norm(slopes, axis=1)))
    if not stop.size:
        return None
    if np.linalg.matrix_rank(slopes[stop]) == 2:
        at = values[-1] - np.linalg.lstsq(slopes[stop], v[stop, 2], rcond=None)[0]
        error = 0.0
    else:
        part = v[stop[0]] / v[stop[0], 2]
        line, at = (extrapolated_to_zero(part[-n:], values[-n:]) for n in (2, 3))
        error = float(np.max(np.abs(at - line)))
    if np.linalg.norm(at - values[-1]) > far:
        return None
    return SpecialPoint("BeltAtRest", tuple(stop.tolist()), (float(at[0]), float(at[1])), error)


def where_edge_is_touched(
    variation: Variation, values: np.ndarray, places: np.ndarray, far: float
) -> SpecialPoint | None:
    """The point where the part of a cycle beyond a contact edge vanishes at the end of a curve.

    The duration of that part is like the square root of its extent beyond the edge, so no step
    leads there; the parameters are extrapolated as linear functions of that root. The residual is
    the distance of the point from the last row.

    Args:
        variation: Of both parameters.
        values: Values in the last rows, [rows, 2].
        places: Places in the last rows, [rows, 5].
        far: Largest distance of the point from the last row.
    """
    belts = variation.oscillator(values[-1]).belts
    edges = {float(edge) for belt in belts for edge in (belt.lower, belt.upper)}
    reaches = [
        reach
        for edge in edges - {np.inf, -np.inf}
        for reach in (places[-2:, 1] - edge, edge - places[-2:, 0])
        if len(reach) == 2 and TOUCHED < reach[1] < min(reach[0], TOUCHES)
    ]
    if not reaches:
        return None
    before, last = np.sqrt(min(reaches, key=lambda reach: reach[1]))
    at = values[-1] + (values[-1] - values[-2]) * last / (before - last)
    error = float(np.max(np.abs(at - values[-1])))
    if error > far:
        return None
    return SpecialPoint("EdgeTouch", (), (float(at[0]), float(at[1])), error)


class Trail(NamedTuple):
    """The last stretch of a curve, from which its condition finds the point it leads to.

    variation: of the two parameters; step: between rows; values: of the parameters in the last
    rows, three at most, [rows, 2]; system, x: system and its unknowns in the last row; end: why the
    stretch ends there.
    """

    variation: Variation
    step: float
    values: np.ndarray
    system: Any
    x: np.ndarray
    end: Stop

    def stopping(self) -> "Stopping | None":
        """The belt that comes to rest, if its velocity depends on one parameter alone, or None."""
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

    held: number of the parameter that its velocity depends on, 0 or 1; belt: number of the belt;
    value: value of that parameter where the belt is at rest; velocities: in the last rows, [rows].
    """

    held: int
    belt: int
    value: float
    velocities: np.ndarray
