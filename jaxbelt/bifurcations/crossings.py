"""Crossing-sliding, and the exchange of two belts."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..cycles.cycle import (
    Chain,
    Cycle,
    Ends,
    Loop,
    meshed,
)
from ..model.equilibria import candidates
from ..model.modes import (
    mode_of,
    stick_limit,
)
from ..model.oscillator import Oscillator
from ..numerics.compiling import jit
from ..results import Status
from .conditions import AbstractCondition, BeltCondition, solved_point
from .guesses import nearest, orbit_after_stick, repeated_loop, settled_loops, without_arcs
from .systems import Encounter, System
from .tangencies import judge_encounter


class CrossingSliding(BeltCondition):
    """The cycle crosses the boundary of a belt, and begins to stick to it where it did.

    It arrives at one end of where the mass sticks: that of slip onset, at which a stick phase
    begins with no duration, or the other one, from which it then sticks all the way.
    """


class SlidingExchange(AbstractCondition):
    """Two belts run at one velocity: where both touch, the cycle changes from one to the other.

    With laws that jump, or belts that hold differently, there may be another cycle beyond, or none.
    """

    belts: tuple[int, int] = eqx.field(static=True)


def at_exchange(osc: Oscillator, index: int | Array, belts: Array, wanted, size: int):
    """A cycle that sticks to one of two belts which run at one velocity, and touches both."""
    _, _, orbit = orbit_after_stick(osc, belts)
    return exchange_near(osc, index, belts, *repeated_loop(orbit, size, len(osc.belts)))


def exchange_near(osc: Oscillator, index: int | Array, belts: Array, loop: Loop, status: Array):
    """The exchange of two belts by the cycle near a loop; status: of the loop."""
    return solved_point(osc, index, *_exchanging(osc, belts, loop, status))


@jit
def _exchanging(osc: Oscillator, belts: Array, loop: Loop, status: Array):
    """The system of `exchange_near` with a guess of its unknowns, a status, and the judge."""
    chain, z = meshed(lax.stop_gradient(osc), loop)
    sticks = jnp.any(loop.codes[:, belts] == 0, axis=-1)
    exchanges = jnp.any(loop.used & sticks & _both_touch(loop.codes, belts))
    meant = (status != Status.OK) | exchanges
    status = jnp.where(meant, status, Status.NOT_TOUCHED.value)
    either, row = jnp.zeros(()), jnp.asarray(0)
    return Encounter(chain, belts), z, status, eqx.Partial(judge_encounter, belts, either, row)


def _both_touch(codes: Array, belts: Array) -> Array:
    """Whether two belts both touch, by the contact codes of each arc."""
    return jnp.all(jnp.abs(codes[:, belts]) < 1.5, axis=-1)


class StickLimit(System):
    """A cycle of which the arc `row` arrives at a boundary at an end of where the mass sticks.

    codes: of the mode in which it sticks there; side: 1 the end on the right, -1 on the left.
    """

    chain: Chain
    row: Array
    codes: Array
    side: Array

    def condition(self, osc: Oscillator, z: Array, miss: Array) -> Array:
        x1 = z[(self.row + 1) % z.shape[0], 0]
        return x1 - stick_limit(osc, mode_of(self.codes), self.side)


class Arrival(eqx.Module):
    """An arc that arrives at a boundary: how far from an end of where the mass sticks, its row, and
    the rest of a `StickLimit`."""

    distance: Array
    row: Array
    codes: Array
    side: Array


def arrival_near_limit(osc: Oscillator, loop: Loop, belt: Array) -> Arrival:
    """Of the arcs of a loop that arrive at the boundary of a belt that nearest to such an end.

    At the other end the orbit would arrive tangentially, with the other sign of r.
    """
    velocities = jnp.stack([one.velocity for one in osc.belts])
    same = velocities == velocities[belt]

    def one(codes, end, x1):
        held = jnp.where(same & (jnp.abs(codes) < 1.5), 0.0, codes)
        side = -codes[belt]
        arrives = (end < len(osc.belts)) & same[jnp.clip(end, 0, len(osc.belts) - 1)]
        distance = jnp.abs(x1 - stick_limit(osc, mode_of(held), side))
        arrives = arrives & (jnp.abs(codes[belt]) == 1)
        return jnp.where(arrives, distance, jnp.inf), held, side

    distance, held, side = jax.vmap(one)(loop.codes, loop.ends, loop.exits[:, 0])
    row = jnp.argmin(distance)
    return Arrival(distance[row], row, held[row], side[row])


def at_crossing(osc: Oscillator, index: int | Array, belts: Array, wanted, size: int):
    """An attracting cycle that arrives at the boundary of the first belt at such an end."""
    distance = eqx.Partial(_distance_to_limit, belts)
    loop, status = nearest(osc, *settled_loops(osc, candidates(osc), size), distance)
    return crossing_near(osc, index, belts, loop, status)


def _distance_to_limit(belts, osc: Oscillator, loop: Loop) -> Array:
    return arrival_near_limit(osc, loop, belts[0]).distance


def crossing_near(osc: Oscillator, index: int | Array, belts: Array, loop: Loop, status: Array):
    """The cycle near a loop that arrives at such an end; status: of the loop."""
    return solved_point(osc, index, *_arriving(osc, belts, loop, status))


@jit
def _arriving(osc: Oscillator, belts: Array, loop: Loop, status: Array):
    """The system of `crossing_near` with a guess of its unknowns, a status, and the judge."""
    still = lax.stop_gradient(osc)
    near = arrival_near_limit(still, loop, belts[0])
    exists = (status != Status.OK) | jnp.isfinite(near.distance)
    status = jnp.where(exists, status, Status.NOT_TOUCHED.value)
    # Having crossed, the orbit may come back to the boundary soon and stick. The equations of that
    # excursion are of second order, and it is left out.
    count = jnp.maximum(jnp.sum(loop.used), 1)
    after = (near.row + 1 + jnp.arange(3)) % count
    returns = (loop.ends[after[0]] == Ends(len(osc.belts)).extremum_x2) & (count > 3)
    returns = returns & (loop.ends[after[1]] == loop.ends[near.row])
    returns = returns & (loop.codes[after[2], belts[0]] == 0)
    shorter = without_arcs(loop, near.row, jnp.asarray(2))
    loop, row = jax.tree.map(lambda a, b: jnp.where(returns, a, b), shorter, (loop, near.row))
    chain, z = meshed(still, loop)
    return StickLimit(chain, row, near.codes, near.side), z, status, eqx.Partial(_judge_arrival)


def _judge_arrival(osc: Oscillator, z, cycle: Cycle, slope):
    return cycle.status, jnp.asarray(jnp.nan)
