"""`distance_to_basin_boundary`: the smallest fatal shock as a functional for `design`."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import require_one_of
from ..cycles.cycle import Cycle
from ..cycles.nearest import ShortestWay
from ..cycles.portrait import portrait
from ..cycles.shocks import DIRECTIONS, length_of, minimal_fatal_shock, shortest_way_out
from ..cycles.sides import leads_to
from ..model.oscillator import Oscillator
from ..model.own_units import in_own_units, in_units_of_run
from ..results import Status


class BasinMargin(eqx.Module):
    """How far a cycle is from the boundary of its basin.

    direction: of the shock, see `minimal_fatal_shock`. Where the oscillator is known beforehand,
    way: the shortest way there, and the unit of length that it is told in; or, where there is none,
    otherwise: inf, or NaN for one that is not known.
    """

    direction: str = eqx.field(static=True)
    way: ShortestWay | None = None
    otherwise: Array | None = None
    length: Array | None = None

    def at(self, osc: Oscillator, y0: Array) -> "BasinMargin":
        """The margin of the cycle that a start of a known oscillator leads to.

        For oscillators beside that one it is a function that JAX can trace.
        """
        own = in_units_of_run(osc)
        length = own.units.length
        told = portrait(own)
        (end,) = leads_to(told, np.asarray(y0 / length)[None])
        way, _, status = shortest_way_out(told, end, along_x2=self.direction == "x2")
        if status != Status.OK:
            way, value = None, np.nan
        else:
            value = np.inf
        return BasinMargin(self.direction, way, jnp.asarray(np.array(value)), jnp.asarray(length))

    def __call__(self, cycle: Cycle) -> Array:
        if self.way is not None:
            own = in_own_units(cycle.oscillator, self.length)
            begin, end = self.way.ends(own)
            size = length_of(end - begin, self.direction)
            return size if own is cycle.oscillator else size * own.units.length
        if self.otherwise is not None:
            return self.otherwise
        y0 = lax.stop_gradient(cycle.unknowns[0, :2])
        return minimal_fatal_shock(cycle.oscillator, y0, direction=self.direction).distance


def distance_to_basin_boundary(direction: str = "both") -> BasinMargin:
    """A functional for `design`: the size of the smallest shock that makes the mass leave the cycle
    for good, see `minimal_fatal_shock`.

    direction: "both", a change of x1 and x2, or "x2", of the velocity alone. Of a cycle with one
    basin without a boundary it is inf. `ValueError` names a direction that is neither.
    """
    require_one_of(direction, DIRECTIONS, "direction")
    return BasinMargin(direction)
