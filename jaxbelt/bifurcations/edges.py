"""Cycles that touch a contact edge."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..cycles.cycle import (
    AT_REST,
    Chain,
    Cycle,
    Ends,
    Loop,
    end_guard,
    following_codes,
    meshed,
    separating_loop,
)
from ..model.equilibria import candidates
from ..model.modes import (
    edges,
    mode_acceleration,
    mode_of,
    onset_position,
)
from ..model.oscillator import Oscillator
from ..numerics.compiling import jit
from ..results import Status
from .conditions import BeltCondition, BifurcationPoint, solved_point
from .guesses import nearest, settled_loops, without_arcs
from .systems import System


class GrazingEdge(BeltCondition):
    """The cycle is tangent to a contact edge of a belt: a loop, an extremum of x1, touches it.

    Beyond, the cycle passes the edge; or there is none, where the edge pushes away to both sides.
    There, too, a cycle that passes the edge ends, with the velocity zero on it.
    unstable: of the cycle from `unstable_cycle`, not of an attracting one.
    """

    unstable: bool = eqx.field(static=True, default=False)


class CornerCollision(BeltCondition):
    """The cycle runs into a corner of a contact edge of a belt and a boundary r_k = 0.

    It begins, or ceases, to stick to a belt there, or crosses its boundary: beyond, these come in
    another order, or another event comes instead; or, like at a nonsmooth fold, there is no cycle.
    A guess has to lie on a side where there is a cycle; `scan` tries both.
    """


class EdgeContact(System):
    """A cycle of which an arc, `row`, ends on an edge and in something else at once.

    One of the two ends the arc; of the other one, `end`, the guard vanishes there in the mode of
    `codes`.
    """

    chain: Chain
    row: Array
    end: Array
    codes: Array

    def condition(self, osc: Oscillator, z: Array, miss: Array) -> Array:
        following = (self.row + 1) % z.shape[0]  # unused arcs hand the state on
        return end_guard(osc, self.codes, self.end, z[following, :2])


class EdgeEnd(eqx.Module):
    """The end of an arc that comes nearest to an edge and something else at once.

    distance: from that, inf if there is none; row, end, codes: as for `EdgeContact`; grazes:
    whether the orbit would be tangent to the edge, else it would run into a corner.
    """

    distance: Array
    row: Array
    end: Array
    codes: Array
    grazes: Array


@jit
def end_near_edge(osc: Oscillator, loop: Loop, belt: Array, wanted: Array) -> EdgeEnd:
    """Of the ends of the arcs of a loop that nearest to an edge of the belt and something else.

    wanted: 1 tangent to the edge, -1 in a corner, 0 either.
    """
    n = len(osc.belts)
    names = Ends(n)
    positions = jnp.stack(edges(osc))
    lower, upper = positions[belt], positions[n + belt]
    following = following_codes(loop)

    def distances(codes, end, entry, after, at):
        """From every end that this arc might have as well; those of stick phases in two modes."""
        x1, x2 = at
        on_edge = (end >= n) & (end < 3 * n)
        edge = positions[jnp.clip(end - n, 0, 2 * n - 1)]
        on_edge = on_edge & ((edge == lower) | (edge == upper))
        stuck = jnp.any(codes == 0)
        # What ends it is something else: how far it is to an edge.
        loops, meets = end == names.extremum_x1, (end < n) | (end == names.onset)
        to_edges = [jnp.where(loops | meets, jnp.abs(x1 - e), jnp.inf) for e in (lower, upper)]
        # An edge ends it. If that pushes away to both sides: how much further on the orbit would
        # loop as it was.
        # It moves there as x1 does on this arc; x2 itself may be zero.
        ahead = jnp.sign(x1 - entry[0])
        push = [ahead * mode_acceleration(osc, mode_of(c), x1, x2) for c in (codes, after)]
        passes = on_edge & ~stuck & (push[0] < 0) & (push[1] > 0)
        to_extremum = jnp.where(passes, 0.5 * x2**2 / jnp.where(passes, -push[0], 1.0), jnp.inf)
        # A boundary may be near that the arc did not begin at: x2 is monotone on it.
        to_boundaries = []
        for i, one in enumerate(osc.belts):
            r, began = (one.velocity - osc.omega * v for v in (x2, entry[1]))
            touches = (jnp.abs(codes[i]) < 1.5) | (jnp.abs(after[i]) < 1.5)
            near = on_edge & ~stuck & touches & (jnp.abs(began) > 1e-9)
            to_boundaries.append(jnp.where(near, jnp.abs(r), jnp.inf))
        # Slip onset may be: in the mode before the edge, or, if it is left by it, in that after.
        held = jnp.where((codes == 0) & (jnp.abs(after) < 1.5), 0.0, after)
        to_onsets = []
        for one in (codes, held):
            may = on_edge & stuck & jnp.any(one == 0)
            away = jnp.abs(x1 - onset_position(osc, mode_of(one)))
            to_onsets.append(jnp.where(may, away, jnp.inf))
        found = jnp.stack([*to_edges, to_extremum, *to_boundaries, *to_onsets])
        grazes = jnp.stack([loops, loops, True, *[False] * (n + 2)])
        usable = (end != names.unused) & jnp.where(grazes, wanted >= 0, wanted <= 0)
        return jnp.where(usable & jnp.isfinite(found), found, jnp.inf), grazes, held

    rows = loop.codes, loop.ends, loop.entries, following, loop.exits
    found, grazes, held = jax.vmap(distances)(*rows)
    row, which = jnp.divmod(jnp.argmin(found), found.shape[1])
    own = jnp.stack([n + belt, 2 * n + belt])
    others = jnp.array([names.extremum_x1, *range(n), names.onset, names.onset])
    end = jnp.concatenate([own, others])[which]
    codes = jnp.where(which == found.shape[1] - 1, held[row], loop.codes[row])
    return EdgeEnd(found[row, which], row, end, codes, grazes[row, which])


def _without_excursion(osc: Oscillator, loop: Loop, near: EdgeEnd) -> tuple[Loop, Array]:
    """The loop without what lies beyond the edge, if all of that is the extremum of x1 that ends a
    row; and the row that then ends in that extremum."""
    row = near.row
    n = len(osc.belts)
    names = Ends(n)
    rows, count = jnp.arange(loop.ends.size), jnp.maximum(jnp.sum(loop.used), 1)
    passes = (loop.ends >= n) & (loop.ends < 3 * n)
    edge = jnp.stack(edges(osc))[jnp.clip(near.end - n, 0, 2 * n - 1)]
    passes = passes & (loop.exits[:, 0] == edge)
    # The events before and after; extremum of x2 are none.
    events = loop.used & (loop.ends != names.extremum_x2) & (rows != row)
    before = jnp.argmin(jnp.where(events, (row - rows) % count, rows.size))
    after = jnp.argmin(jnp.where(events, (rows - row) % count, rows.size))
    is_excursion = (loop.ends[row] == names.extremum_x1) & passes[before] & passes[after]
    is_excursion = is_excursion & (before != after)
    without, last = without_arcs(loop, before, (after - before) % count)
    without = eqx.tree_at(lambda t: t.ends, without, without.ends.at[last].set(names.extremum_x1))
    loop = jax.tree.map(lambda a, b: jnp.where(is_excursion, a, b), without, loop)
    return loop, jnp.where(is_excursion, last, row)


def at_edge(osc: Oscillator, index: int | Array, belts: Array, wanted: Array, size: int):
    """An attracting cycle of which an arc ends on an edge of the first belt, not by that edge.

    wanted: 1 a loop ends it (grazing), -1 a boundary or slip onset (a corner), 0 either. Of all
    these cycles that which comes nearest to this is taken.
    """
    distance = eqx.Partial(_distance_to_edge, belts, wanted)
    loop, status = nearest(osc, *settled_loops(osc, candidates(osc), size), distance)
    return edge_contact(osc, index, belts, wanted, loop, status, repels=False)


def _distance_to_edge(belts, wanted, osc: Oscillator, loop: Loop) -> Array:
    return end_near_edge(osc, loop, belts[0], wanted).distance


def at_edge_unstable(osc: Oscillator, index: int | Array, belts: Array, wanted, size: int):
    """The unstable cycle around a stable equilibrium, with a loop on an edge of the first belt."""
    loop, status, _ = separating_loop(osc, size)
    return edge_contact(osc, index, belts, wanted, loop, status, repels=True)


def edge_contact(
    osc: Oscillator, index: int | Array, belts, wanted, loop: Loop, status: Array, *, repels: bool
) -> BifurcationPoint:
    """The cycle near a loop of which an arc ends on an edge of the first belt.

    wanted: as for `at_edge`; status: of the loop; repels: whether the cycle is to be unstable.
    """
    unstable = jnp.asarray(np.array(repels))
    return solved_point(osc, index, *_touching_edge(osc, belts, wanted, loop, status, unstable))


@jit
def _touching_edge(osc: Oscillator, belts: Array, wanted, loop: Loop, status: Array, repels):
    """The system of `edge_contact` with a guess of its unknowns, a status, and the judge."""
    still = lax.stop_gradient(osc)
    near = end_near_edge(still, loop, belts[0], wanted)
    exists = (status != Status.OK) | jnp.isfinite(near.distance)
    status = jnp.where(exists, status, Status.NOT_TOUCHED.value)
    loop, row = _without_excursion(still, loop, near)
    chain, z = meshed(still, loop)
    system = EdgeContact(chain, row, near.end, near.codes)
    return system, z, status, eqx.Partial(_judge_contact, row, repels)


def _judge_contact(row, repels, osc: Oscillator, z, cycle: Cycle, slope):
    # A loop at once after the edge is passed solves the equations, too, but they are singular;
    # and a cycle that has shrunk to a pseudo-focus meets everything there.
    loops = cycle.chain.ends[row] == Ends(len(osc.belts)).extremum_x1
    shrunk = jnp.ptp(z[:, 0]) < AT_REST
    fails = loops & (z[row, 2] < 1e-6) | shrunk
    solved = cycle.status == Status.OK
    status = jnp.where(solved & fails, Status.NO_CONVERGENCE.value, cycle.status)
    none = repels & (solved & ~(slope > 1) | shrunk & (status == Status.NO_CONVERGENCE))
    return jnp.where(none, Status.NO_UNSTABLE_CYCLE.value, status), jnp.asarray(jnp.nan)
