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
    """Distance of a cycle from the boundary of its basin; a functional of cycles.

    Attributes:
        direction: Direction of the shock, see `minimal_fatal_shock`.
        way: Shortest way to the boundary, where `at` has found it for a nearby oscillator.
        otherwise: Value where `at` found no way: inf without a boundary, NaN where that is unknown.
        length: Unit of length of `way`.
    """

    direction: str = eqx.field(static=True)
    way: ShortestWay | None = None
    otherwise: Array | None = None
    length: Array | None = None

    def at(self, osc: Oscillator, y0: Array) -> "BasinMargin":
        """Returns the margin of the cycle that a start of a concrete oscillator leads to.

        For oscillators near that one the margin is a function that JAX can trace.
        """
        own = in_units_of_run(osc)
        length = own.units.length
        known = portrait(own)
        (end,) = leads_to(known, np.asarray(y0 / length)[None])
        way, _, status = shortest_way_out(known, end, along_x2=self.direction == "x2")
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
    """A functional for `design`: size of the smallest shock that makes the mass leave the cycle.

    See `minimal_fatal_shock`. For a cycle whose basin has no boundary it is inf.

    Args:
        direction: "both", a change of x1 and x2, or "x2", a change of the velocity alone.

    Returns:
        A function of a `Cycle`.

    Raises:
        ValueError: If the direction is neither.
    """
    require_one_of(direction, DIRECTIONS, "direction")
    return BasinMargin(direction)
