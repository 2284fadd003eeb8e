"""`GrazingEdge` of forced oscillators: a periodic motion that touches a contact edge.

The arc that touches is cut where x2 = 0, and one more equation has x1 on the edge there. Beyond the
edge, where its belt comes or goes, a motion has one more arc, which lasts for the square root of
the distance: it is left out.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..cycles.clocked import TimedChain
from ..model.modes import edge_at, edges
from ..model.oscillator import Oscillator
from ..motion.arcs import Ends
from .base import AbstractCondition
from .forced import AbstractForcedCondition, ArcRows, Beginning, minima_of_guards, without_one_of
from .timed_systems import TimedSystem


class OnEdge(TimedSystem):
    """x1 is on the edge of that number at the end of the arc `row`, at which x2 = 0."""

    chain: TimedChain
    row: Array
    edge: Array

    def condition(self, osc, z):
        return z[self.row + 1, 0] - edge_at(osc, self.edge)


class TimedEdgeGrazing(AbstractForcedCondition):
    """`GrazingEdge` with a clock; public: that class."""

    belt: int
    public: type[AbstractCondition] = eqx.field(static=True)

    def kind_along(self, osc, multiplier) -> type[AbstractCondition]:
        return self.public

    def beginnings_of(self, osc, motion, known=False):
        rows, n = ArcRows.of(motion), len(osc.belts)
        names, places = Ends(n), np.array([float(place) for place in edges(osc)])
        own = [edge for edge in (self.belt, n + self.belt) if np.isfinite(places[edge])]

        def system(row, edge):
            return lambda chain: OnEdge(chain, jnp.asarray(row), jnp.asarray(edge))

        if known:
            row = int(np.flatnonzero(rows.ends == names.extremum_x1)[0])
            edge = min(own, key=lambda edge: abs(places[edge] - rows.z[row + 1, 0]))
            yield Beginning(rows, 0.0, system(row, edge))
            return
        for edge in own:
            # Edges of other belts may be at the same place.
            same = n + np.flatnonzero(places == places[edge])
            short = [r for r in range(1, len(rows.ends) - 1) if _is_excursion(rows, r, same)]
            for shorter, row, value in without_one_of(rows, short, names.extremum_x1):
                yield Beginning(shorter, value, system(row, edge))
            own_guard = slice(n + edge, n + edge + 1)
            for row, since, state, value in minima_of_guards(osc, motion, own_guard):
                cut = rows.cut(row, since, state, names.extremum_x1)
                yield Beginning(cut, value, system(row, edge))


def _is_excursion(rows: ArcRows, row: int, ends: np.ndarray) -> bool:
    """Whether an arc begins and ends on an edge, and the one before it goes on behind it."""
    passes = rows.ends[row - 1] in ends and rows.ends[row] in ends
    return bool(passes and np.array_equal(rows.codes[row - 1], rows.codes[row + 1]))


def edged_belts(osc: Oscillator) -> list[int]:
    """The numbers of the belts that have a contact edge, of a known oscillator."""
    n = len(osc.belts)
    places = np.array([float(place) for place in edges(osc)]).reshape(2, n)
    return np.flatnonzero(np.any(np.isfinite(places), axis=0)).tolist()
