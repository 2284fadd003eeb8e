"""Cycles that cross a boundary beside where they would stick, and belts that change places.

- `CrossingSliding`: the cycle arrives at a boundary r_k = 0 exactly at an end of the stretch of it
  on which the mass sticks. On one side of that end the mass sticks, on the other the boundary is
  crossed: a crossing-sliding bifurcation (M. di Bernardo, C. Budd, A. Champneys, P. Kowalczyk,
  Piecewise-smooth Dynamical Systems, 2008). The equation is linear in the unknowns, x1 = rest +-
  capacity.
- `SlidingExchange`: nu_i = nu_j, and a cycle that sticks to i or j. The friction of each mode keeps
  its sign, so the cycle with its signature fixed goes smoothly through the point. The name is the
  paper's.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..checks import is_concrete
from ..cycles.chains import SIZES, Chain, Loop, cut, first_failure
from ..cycles.cycle import Cycle
from ..cycles.shooting import meshed
from ..model.friction import friction_jumps
from ..model.modes import any_of, mode_of, select, velocity_of
from ..model.oscillator import Belt, Oscillator
from ..model.transitions import stick_limit
from ..motion.arcs import Ends
from ..numerics.compiling import jit
from ..results import EventKind, Status
from .base import Line, check_two_belts
from .conditions import AbstractCycleCondition, AbstractStickCondition
from .forced import TimedCrossing
from .guesses import nearest, orbit_after_stick, repeated_loop, without_arcs
from .special import SpecialPoint
from .systems import (
    CycleSystem,
    contact_tests,
    nearest_contacts,
    stick_phase_from,
)
from .tangencies import Encounter

# --- crossing a boundary, or sticking to it -------------------------------------------------------


class StickLimit(CycleSystem):
    """A cycle whose arc `row` arrives at a boundary at an end of the stretch where the mass sticks.

    codes: of the mode in which it sticks there; side: 1 for the end on the right, -1 on the left.
    """

    chain: Chain
    row: Array
    codes: Array
    side: Array

    def condition(self, osc, z, miss):
        x1 = z[(self.row + 1) % z.shape[0], 0]
        return x1 - stick_limit(osc, mode_of(self.codes), self.side)

    def watch(self, osc, z, slope):
        return arrival_tests(osc, self.chain, z, self.row), True, jnp.nan


def arrival_tests(osc: Oscillator, chain: Chain, z: Array, row: Array, own: bool | Array = False):
    """Functions to watch for a cycle with two events at once at the end of the arc `row`.

    A stick phase that begins or ends there may have no duration. own: mask of the boundaries that
    are part of the coincidence, at the ends of arcs, [arcs, belts].
    """
    others = chain.used & ~stick_phase_from(osc, chain, (row + 1) % jnp.sum(chain.used))
    here = jnp.arange(others.size) == row
    others = others & ~here & jnp.any(chain.codes == 0, axis=-1)
    nearest, _ = nearest_contacts(osc, chain, z, others, here[:, None] | own)
    return contact_tests("DoubleSliding", nearest, jnp.ones(nearest.shape, bool))


class CrossingSliding(AbstractStickCondition):
    """The cycle crosses the boundary of a belt and begins to stick to it at the crossing.

    It arrives at one end of the stretch where the mass sticks. At the end of slip onset a stick
    phase begins with no duration (crossing). From the other end the mass sticks all the way; on the
    other side of the point the cycle crosses the boundary, comes back soon and sticks then
    (buckling). Where the static limit exceeds mu(0), the orbit goes far beyond the boundary at
    once, and may not come back (jump).

    Args:
        belt: Number of the belt.
    """

    caption: ClassVar[str] = "crossing-sliding, belt {belt}"
    line: ClassVar[Line] = Line("crossing-sliding", "#CC79A7", (0, (5, 1.5)))

    def with_clock(self):
        return TimedCrossing(int(self.belt), type(self))

    @property
    def room(self):
        return SIZES[1]  # passing edges needs more arcs

    def guess(self, osc, size):
        return nearest(osc, size, self)

    def distance(self, osc: Oscillator, loop: Loop) -> Array:
        """Distance of the loop's nearest arrival from an end of a stretch where the mass sticks."""
        return arrival_near_limit(osc, loop, self.belt).distance

    def system(self, osc, loop, status):
        near = arrival_near_limit(osc, loop, self.belt)
        status = first_failure(status, jnp.isfinite(near.distance), Status.NOT_TOUCHED)
        # Having crossed, the orbit may come back to the boundary soon and stick. The equations of
        # that excursion are of second order, so it is left out.
        count = jnp.maximum(jnp.sum(loop.used), 1)
        after = (near.row + 1 + jnp.arange(3)) % count
        returns = (loop.ends[after[0]] == Ends(len(osc.belts)).extremum_x2) & (count > 3)
        returns = returns & (loop.ends[after[1]] == loop.ends[near.row])
        returns = returns & (loop.codes[after[2], self.belt] == 0)
        shorter = without_arcs(loop, near.row, jnp.asarray(2))
        loop, row = select(returns, shorter, (loop, near.row))
        chain, z = meshed(osc, loop)
        return StickLimit(chain, row, near.codes, near.side), z, status

    def type_of(self, point):
        side, jumps = _limit_met(point.cycle, self.belt)
        # The mass leaves the stretch where it sticks in the direction in which the belt moves.
        if side * velocity_of(point.oscillator, self.belt) > 0:
            return "crossing"
        return "jump" if jumps else "buckling"

    @classmethod
    def between(cls, before, after, edged):
        one, other = (label.events(EventKind.CROSS) for label in (before, after))
        return [cls(belt) for belt in (one - other) + (other - one)]


class Arrival(eqx.Module):
    """An arc that arrives at a boundary.

    distance: from an end of the stretch where the mass sticks; row: of the arc; codes, side: as in
    `StickLimit`.
    """

    distance: Array
    row: Array
    codes: Array
    side: Array


def arrival_near_limit(osc: Oscillator, loop: Loop, belt: int | Array) -> Arrival:
    """The arc of a loop that arrives at a belt's boundary nearest to an end of where it can stick.

    That end has the side -sgn(r): at the other one the orbit would arrive tangentially.
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


@jit
def _limit_met(cycle: Cycle, belt: int | Array) -> tuple[Array, Array]:
    """The side of the stretch at which a cycle arrives, see `StickLimit`, and whether the static
    limit of a belt that sticks there exceeds mu(0)."""
    osc, loop = cycle.oscillator, cycle.chain.loop(cycle.unknowns)
    near = arrival_near_limit(osc, loop, belt)
    jumps = [(near.codes[i] == 0) & has_jump(one) for i, one in enumerate(osc.belts)]
    return near.side, any_of(jumps)


def has_jump(belt: Belt) -> Array:
    """Whether the force at which a belt lets go exceeds its friction just after."""
    return (belt.load != 0) & friction_jumps(belt.friction)


# --- belts that change places ---------------------------------------------------------------------


@jit
def _loop_together(osc: Oscillator, belts: Array) -> tuple[Loop, Array]:
    """The loop of the cycle that sticks to two belts at once, with one velocity, and a status.

    The second belt gets the velocity of the first.
    """
    velocity = velocity_of(osc, belts[0])
    velocities = [
        jnp.where(belts[1] == i, velocity, one.velocity) for i, one in enumerate(osc.belts)
    ]
    equal = eqx.tree_at(lambda o: [one.velocity for one in o.belts], osc, velocities)
    _, _, orbit = orbit_after_stick(equal, belts[0])
    loop, status = repeated_loop(orbit, SIZES[0], len(osc.belts))
    held = jnp.any(loop.used & jnp.all(loop.codes[:, belts] == 0, axis=-1))
    return loop, first_failure(status, held, Status.NOT_TOUCHED)


class SlidingExchange(AbstractCycleCondition):
    """Two belts have one velocity: where both touch, the cycle changes from one to the other.

    With laws that jump, or belts that hold differently, there may be another cycle beyond, or none.
    Where it sticks to both belts, one after the other, the duration of the slip arc between them
    vanishes at the point like the square root of the difference of the velocities; then the cycle
    that sticks to both at once is found.

    Args:
        belts: Numbers of the two belts.
    """

    belts: tuple[int, int]

    caption: ClassVar[str] = "sliding exchange"
    line: ClassVar[Line] = Line("exchange", "black", (0, (3, 1, 1, 1)))

    def check(self, osc):
        check_two_belts(self.belts)
        super().check(osc)

    def guess(self, osc, size):
        _, _, orbit = orbit_after_stick(osc, self.belts[0])
        return repeated_loop(orbit, size, len(osc.belts))

    def system(self, osc, loop, status):
        chain, z = meshed(osc, loop)
        belts = jnp.stack(self.belts)
        sticks = jnp.any(loop.codes[:, belts] == 0, axis=-1)
        both_touch = jnp.all(jnp.abs(loop.codes[:, belts]) < 1.5, axis=-1)
        exchanges = jnp.any(loop.used & sticks & both_touch)
        status = first_failure(status, exchanges, Status.NOT_TOUCHED)
        return Encounter(chain, belts, jnp.asarray(-1), jnp.zeros(())), z, status

    def solve(self, variation, osc, value, guess):
        point = super().solve(variation, osc, value, guess)
        if not is_concrete(point.status) or int(point.status) == Status.OK:
            return point
        loop, status = _loop_together(osc, jnp.stack(self.belts))
        found = super().solve(variation, osc, value, (cut([loop])[0], status))
        return found if int(found.status) == Status.OK else point

    @classmethod
    def at_coincidence(cls, belts):
        return [cls((min(belts), max(belts)))] if len(belts) == 2 else []

    def limit(self, trail):
        stopping = trail.stopping()
        if stopping is None:
            return None
        # Both belts come to rest at once, so the free parameter varies in proportion to the
        # velocity.
        (before, last), v = trail.values[1:, 1 - stopping.held], stopping.velocities
        free = float(last - v[-1] * ((last - before) / (v[-1] - v[-2])))
        values = (free, stopping.value) if stopping.held else (stopping.value, free)
        return SpecialPoint("BeltAtRest", self.belts, values, 0.0)
