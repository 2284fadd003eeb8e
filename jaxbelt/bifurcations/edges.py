"""Cycles that touch a contact edge: `GrazingEdge` and `CornerCollision`.

An arc of a cycle ends on a contact edge and in a second event at once. If the second event is an
extremum of x1, the orbit is tangent to the edge, x2 = 0; if it is a boundary r_k = 0 or slip onset,
the orbit runs into the corner of both. On one side of the point the edge ends the arc, on the other
side the second event does. The equation is that the guard of the event that does not end the arc
vanishes, which is linear in the unknowns. If a cycle passes the edge and turns back soon after,
that excursion is left out: with it the equation is of second order in the velocity at the edge.

Grazing and corner collision are the names of M. di Bernardo, C. Budd, A. Champneys, P. Kowalczyk,
Piecewise-smooth Dynamical Systems, 2008.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks import is_concrete, require_value
from ..cycles.chains import SIZES, Chain, Loop, first_failure, following_codes
from ..cycles.settling import AT_REST
from ..cycles.shooting import end_guard, meshed
from ..cycles.unstable import separating_loop
from ..model.modes import edge_at, edges, mode_acceleration, mode_of, select
from ..model.oscillator import Oscillator
from ..model.transitions import onset_position
from ..motion.arcs import Ends
from ..numerics.compiling import jit
from ..numerics.continuation import Stop
from ..numerics.newton import HOLDS
from ..results import Status
from .base import Line
from .conditions import AbstractCycleCondition
from .crossings import arrival_tests
from .edge_rests import check_edge, slow_focus_limit
from .forced_edges import TimedCorner, TimedEdgeGrazing
from .guesses import nearest, without_arcs
from .rests import hopf_limit
from .systems import CycleSystem, nearest_edge


class EdgeContact(CycleSystem):
    """A cycle whose arc `row` ends on an edge and in a second event at once.

    One of the two ends the arc; the guard of the other one, `end`, vanishes there in the mode of
    `codes`. repels: whether the cycle has to be unstable.
    """

    chain: Chain
    row: Array
    end: Array
    codes: Array
    repels: Array

    def condition(self, osc, z, miss):
        following = (self.row + 1) % z.shape[0]  # unused arcs pass the state on
        return end_guard(osc, self.codes, self.end, z[following, :2])

    def judge(self, osc, z, cycle, slope):
        # A cycle with an extremum of x1 at once after the edge solves the equations, too, but they
        # are singular there; a cycle that has shrunk to a pseudo-focus satisfies every condition.
        turns = cycle.chain.ends[self.row] == Ends(len(osc.belts)).extremum_x1
        shrunk = jnp.ptp(z[:, 0]) < AT_REST
        fails = turns & (z[self.row, 2] < 1e-6) | shrunk
        solved = cycle.status == Status.OK
        status = jnp.where(solved & fails, Status.NO_CONVERGENCE.value, cycle.status)
        none = solved & ~(slope > 1) | shrunk & (status == Status.NO_CONVERGENCE)
        status = jnp.where(self.repels & none, Status.NO_UNSTABLE_CYCLE.value, status)
        return status, jnp.asarray(jnp.nan)

    def watch(self, osc, z, slope):
        own = self._ends_there(z)
        # The boundary of the corner itself is not watched; that of another belt may come there.
        belts = jnp.arange(len(osc.belts))
        belts = (belts == self.chain.ends[self.row]) | (belts == self.end)
        tests = arrival_tests(osc, self.chain, z, self.row, own[:, None] & belts[None])
        tests["EdgeTouch", ()] = nearest_edge(osc, self.chain, z, own)
        return tests, True, jnp.nan

    def _ends_there(self, z: Array) -> Array:
        """Mask of the arcs that end where and when the arc `row` does, [arcs].

        These are the arc itself, and the one before or after it that ends in the other event with
        no time between them.
        """
        rows, count = jnp.arange(self.chain.ends.size), jnp.sum(self.chain.used)
        before, after = (self.row - 1) % count, (self.row + 1) % count
        is_there = rows == self.row
        for arc, between in ((before, self.row), (after, after)):
            at_once = (self.chain.ends[arc] == self.end) & (jnp.abs(z[between, 2]) < HOLDS)
            is_there = is_there | (rows == arc) & at_once
        return is_there


class AbstractEdgeTouch(AbstractCycleCondition):
    """An arc of a cycle ends on an edge of a belt and in a second event at once.

    The guess is the attracting cycle that comes nearest to it. wanted: 1 for an extremum of x1
    (grazing), -1 for a boundary or slip onset (a corner), 0 for either. repels: the cycle is
    the one from `unstable_cycle`, not an attracting one. farther: only ends of arcs at a distance
    from both events larger than this count.
    """

    belt: int | Array

    wanted = 0.0
    farther = -1.0
    repels = False
    has_several: ClassVar[bool] = True

    @property
    def room(self):
        return SIZES[0] if self.repels else SIZES[1]

    @property
    def sought(self):
        return EdgeTouch(self.belt, repels=self.repels)

    def check(self, osc):
        super().check(osc)
        require_value(isinstance(self.repels, bool), "unstable", "True or False", self.repels)
        check_edge(osc, self.belt)

    def as_data(self):
        # One program serves both kinds.
        numbers = (self.belt, self.wanted, self.farther)
        belt, wanted, farther = (jnp.asarray(np.array(one)) for one in numbers)
        return EdgeTouch(belt, wanted, farther, self.repels)

    def named(self, point):
        if self.repels:
            return GrazingEdge(self.belt, unstable=True)
        loop = point.cycle.chain.loop(point.cycle.unknowns)
        belt, either = jnp.asarray(self.belt), jnp.zeros(())
        near = end_near_edge(point.oscillator, loop, belt, either)
        return (GrazingEdge if near.grazes else CornerCollision)(self.belt)

    def guess(self, osc, size):
        if self.repels:
            return separating_loop(osc, size)[:2]
        return nearest(osc, size, self)

    def guess_near(self, beginning):
        # In as many rows as the loop of `guess`, so that one program serves both.
        return beginning, jnp.asarray(Status.OK.value)

    def distance(self, osc: Oscillator, loop: Loop) -> Array:
        """Distance of the nearest end of an arc from both events at once."""
        return self._nearest_end(osc, loop).distance

    def _nearest_end(self, osc: Oscillator, loop: Loop) -> "EdgeEnd":
        return end_near_edge(osc, loop, self.belt, self.wanted, self.farther)

    def solve(self, variation, osc, value, guess):
        point = super().solve(variation, osc, value, guess)
        if not is_concrete(point.status) or int(point.status) != Status.NO_CONVERGENCE:
            return point
        loop, _ = guess
        # Slip onset may be on the edge whatever the parameter is, as happens at round numbers.
        if float(self._nearest_end(osc, loop).distance) > HOLDS:
            return point
        others = EdgeTouch(self.belt, self.wanted, jnp.asarray(np.array(HOLDS)), self.repels)
        found = super(AbstractEdgeTouch, others).solve(variation, osc, value, guess)
        return found if int(found.status) == Status.OK else point

    def system(self, osc, loop, status):
        near = self._nearest_end(osc, loop)
        status = first_failure(status, jnp.isfinite(near.distance), Status.NOT_TOUCHED)
        loop, row = _without_excursion(osc, loop, near)
        chain, z = meshed(osc, loop)
        repels = jnp.asarray(np.array(self.repels))
        return EdgeContact(chain, row, near.end, near.codes, repels), z, status


class EdgeTouch(AbstractEdgeTouch):
    """The condition with either second event, as data of the compiled programs."""

    wanted: float | Array = 0.0
    farther: float | Array = -1.0
    repels: bool = eqx.field(static=True, default=False)


class GrazingEdge(AbstractEdgeTouch):
    """The cycle is tangent to a contact edge of a belt: an extremum of x1 touches it.

    Beyond the point the cycle passes the edge; where the edge pushes away to both sides, there is
    no cycle. A cycle that passes the edge ends there, too, with the velocity zero on it. With
    forcing it is a periodic motion that touches.

    Args:
        belt: Number of the belt.
        unstable: Whether the cycle is the one from `unstable_cycle`, not an attracting one; not
            with forcing, where motions of any stability touch.
    """

    unstable: bool = eqx.field(static=True, default=False)

    wanted = 1.0
    caption: ClassVar[str] = "edge grazing, belt {belt}"
    line: ClassVar[Line] = Line("edge grazing", "#56B4E9")

    @property
    def repels(self):
        return self.unstable

    def with_clock(self):
        require_value(not self.unstable, "condition", "stable, as osc is forced", self)
        return TimedEdgeGrazing(int(self.belt), type(self))

    @classmethod
    def between(cls, before, after, edged):
        # Whether an arc ends on the edge with an extremum or in a corner shows at the solution.
        return [cls(belt) for belt in edged] if before.cycles != after.cycles else []

    @classmethod
    def of_unstable_cycles(cls, edged):
        return [cls(belt, unstable=True) for belt in edged]

    def limit(self, trail):
        """The point where the cycle has shrunk to an equilibrium on the edge."""
        if trail.end is Stop.POINT_COUNT:
            return None
        return hopf_limit("BoundaryHopf", trail, _guard_at_rest, trail.system.end)


class CornerCollision(AbstractEdgeTouch):
    """The cycle runs into a corner of a contact edge of a belt and a boundary r_k = 0.

    There it begins, or ceases, to stick to a belt, or crosses its boundary. Beyond the point these
    events come in another order, or another event comes instead; or, like at a nonsmooth fold,
    there is no cycle. A guess has to lie on a side with a cycle; `scan` tries both. With forcing
    it is a periodic motion, which goes on beyond the point.

    Args:
        belt: Number of the belt.
    """

    wanted = -1.0
    caption: ClassVar[str] = "corner, belt {belt}"
    line: ClassVar[Line] = Line("corner", "#56B4E9", (0, (3, 1, 1, 1)))

    def with_clock(self):
        return TimedCorner(int(self.belt), type(self))

    def limit(self, trail):
        """The point where the cycle shrinks to a pseudo-focus with the velocity of the
        boundary's belt."""
        system = trail.system
        belt = min(int(system.end), int(system.chain.ends[system.row]))
        if trail.end is Stop.POINT_COUNT or belt >= system.chain.codes.shape[-1]:
            return None
        return slow_focus_limit(trail, belt)


def _guard_at_rest(osc: Oscillator, codes: Array, x1: Array, end: Array) -> Array:
    return end_guard(osc, codes, end, jnp.stack([x1, jnp.zeros(())]))


# --- the end of an arc nearest to an edge and something else --------------------------------------


class EdgeEnd(eqx.Module):
    """The end of an arc that comes nearest to an edge and a second event at once.

    distance: from both, inf if there is no such end; row, end, codes: as for `EdgeContact`; grazes:
    whether the orbit would be tangent to the edge, else it would run into a corner.
    """

    distance: Array
    row: Array
    end: Array
    codes: Array
    grazes: Array


@jit
def end_near_edge(
    osc: Oscillator,
    loop: Loop,
    belt: int | Array,
    wanted: float | Array,
    farther: float | Array = -1.0,
) -> EdgeEnd:
    """The end of an arc of a loop that is nearest to an edge of the belt and a second event.

    wanted: 1 tangent to the edge, -1 in a corner, 0 either. farther: only ends that are farther
    than this.
    """
    n = len(osc.belts)
    names = Ends(n)
    positions = jnp.stack(edges(osc))
    lower, upper = positions[belt], positions[n + belt]
    following = following_codes(loop)
    # At the boundary of a belt at rest x1 is extreme; without a load the boundary is nothing else.
    idle = [(one.velocity == 0) & (one.load == 0) for one in osc.belts]
    extreme = jnp.array([*range(n), names.extremum_x1])
    extreme = jnp.where(jnp.stack([*idle, jnp.asarray(True)]), extreme, names.extremum_x1)

    def distances(codes, end, entry, after, at):
        """Distances from every other end that this arc might have; slip onset in two modes."""
        x1, x2 = at
        on_edge = (end >= n) & (end < 3 * n)
        edge = positions[jnp.clip(end - n, 0, 2 * n - 1)]
        on_edge = on_edge & ((edge == lower) | (edge == upper))
        stuck = jnp.any(codes == 0)
        # The second event ends the arc: its distance from an edge.
        turns, meets = jnp.any(end == extreme), (end < n) | (end == names.onset)
        to_edges = [jnp.where(turns | meets, jnp.abs(x1 - e), jnp.inf) for e in (lower, upper)]
        # An edge ends the arc. If the edge pushes away to both sides: distance to the extremum of
        # x1 that the orbit would reach without the edge. It moves there in the direction of x1 on
        # this arc; x2 itself may be zero.
        ahead = jnp.sign(x1 - entry[0])
        push = [ahead * mode_acceleration(osc, mode_of(c), x1, x2) for c in (codes, after)]
        passes = on_edge & ~stuck & (push[0] < 0) & (push[1] > 0)
        to_extremum = jnp.where(passes, 0.5 * x2**2 / jnp.where(passes, -push[0], 1.0), jnp.inf)
        # A boundary at which the arc did not begin may be near: x2 is monotone on the arc.
        to_boundaries = []
        for i, one in enumerate(osc.belts):
            r, began = (one.velocity - osc.omega * v for v in (x2, entry[1]))
            touches = (jnp.abs(codes[i]) < 1.5) | (jnp.abs(after[i]) < 1.5)
            near = on_edge & ~stuck & touches & (jnp.abs(began) > HOLDS)
            to_boundaries.append(jnp.where(near, jnp.abs(r), jnp.inf))
        # Slip onset may be near: in the mode before the edge, or in the mode after it with the
        # stuck belts still stuck.
        held = jnp.where((codes == 0) & (jnp.abs(after) < 1.5), 0.0, after)
        to_onsets = []
        for one in (codes, held):
            may = on_edge & stuck & jnp.any(one == 0)
            away = jnp.abs(x1 - onset_position(osc, mode_of(one)))
            to_onsets.append(jnp.where(may, away, jnp.inf))
        found = jnp.stack([*to_edges, to_extremum, *to_boundaries, *to_onsets])
        grazes = jnp.stack([turns, turns, True, *[False] * (n + 2)])
        usable = (end != names.unused) & jnp.where(grazes, wanted >= 0, wanted <= 0)
        usable = usable & jnp.isfinite(found) & (found > farther)
        return jnp.where(usable, found, jnp.inf), grazes, held

    rows = loop.codes, loop.ends, loop.entries, following, loop.exits
    found, grazes, held = jax.vmap(distances)(*rows)
    row, which = jnp.divmod(jnp.argmin(found), found.shape[1])
    own = jnp.stack([n + belt, 2 * n + belt])
    others = jnp.array([names.extremum_x1, *range(n), names.onset, names.onset])
    end = jnp.concatenate([own, others])[which]
    codes = jnp.where(which == found.shape[1] - 1, held[row], loop.codes[row])
    return EdgeEnd(found[row, which], row, end, codes, grazes[row, which])


def _without_excursion(osc: Oscillator, loop: Loop, near: EdgeEnd) -> tuple[Loop, Array]:
    """The loop without its excursion beyond the edge, and the row that then ends in the extremum.

    The excursion is left out only if the extremum of x1 at the end of a row is its only event.
    """
    row = near.row
    n = len(osc.belts)
    names = Ends(n)
    rows, count = jnp.arange(loop.ends.size), jnp.maximum(jnp.sum(loop.used), 1)
    passes = (loop.ends >= n) & (loop.ends < 3 * n)
    edge = edge_at(osc, jnp.clip(near.end - n, 0, 2 * n - 1))
    passes = passes & (loop.exits[:, 0] == edge)
    # The events before and after the row; extrema of x2 do not count.
    events = loop.used & (loop.ends != names.extremum_x2) & (rows != row)
    before = jnp.argmin(jnp.where(events, (row - rows) % count, rows.size))
    after = jnp.argmin(jnp.where(events, (rows - row) % count, rows.size))
    is_excursion = (loop.ends[row] == names.extremum_x1) & passes[before] & passes[after]
    is_excursion = is_excursion & (before != after)
    without, last = without_arcs(loop, before, (after - before) % count)
    without = eqx.tree_at(lambda t: t.ends, without, without.ends.at[last].set(names.extremum_x1))
    return select(is_excursion, (without, last), (loop, row))
