"""Curves of the phase plane in smooth pieces, as functions of the oscillator: `Outline`.

A cycle, a separatrix and a segment of equilibria are such curves. An outline keeps what is discrete
of one, the modes and the ends of its arcs, which do not change where the oscillator does a little;
where the curve is follows from the oscillator, and so do its derivatives: of a cycle those of the
shooting equations, of a separatrix those of its arcs one after another, each of which ends where
the guard of its end vanishes.

A point of a curve has the number of its piece and a fraction, from 0 where the piece begins to 1.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import pick
from ..model.equilibria import equilibria
from ..model.modes import (
    ABOVE,
    STUCK,
    Mode,
    capacity,
    edges,
    force_rounding,
    mode_acceleration,
    mode_of,
)
from ..model.oscillator import Oscillator
from ..model.transitions import contact
from ..motion.arcs import Ends
from ..numerics.compiling import jit, power_of_two
from .backwards import BackwardCycle
from .chains import Chain, Loop
from .creeping import FEWEST, cut_finely
from .cycle import Cycle
from .separatrices import Separatrix, tangencies
from .shooting import end_guard, flow, meshed, solve_closed

#: Integration steps in an arc of a separatrix, or in a piece of one.
STEPS = 16


class Pieces(eqx.Module):
    """Pieces of curves, a row each: arcs of orbits, or straight lines along the x1 axis.

    way: 1, or -1 for an arc of the oscillator reversed in time, the x2 of which is reversed, too;
    codes: contact codes, [pieces, belts]; mesh: steps as fractions, [pieces, steps]; entries: where
    it begins, (x1, x2) or (x1, -x2), [pieces, 2]; durations: of the arc, 0 of a line; lengths: of
    the line, 0 of an arc.
    """

    way: Array
    codes: Array
    mesh: Array
    entries: Array
    durations: Array
    lengths: Array


def moved_in_time(osc: Oscillator, way: Array) -> Oscillator:
    """The oscillator, or for way = -1 that reversed in time, see `backwards`."""
    return eqx.tree_at(
        lambda o: [o.damping, *(b.velocity for b in o.belts), *(b.load for b in o.belts)],
        osc,
        replace_fn=lambda leaf: leaf * way,
    )


def place_on(osc: Oscillator, piece: Pieces, fraction: Array) -> tuple[Array, Array, Array]:
    """A point (x1, x2) of a piece, one row of `Pieces`, and its first and second derivatives by the
    fraction, [2] each."""
    moving, mode = moved_in_time(osc, piece.way), mode_of(piece.codes)
    y = flow(moving, piece.codes, piece.mesh, piece.entries, fraction * piece.durations)

    def field(y):
        pull = mode_acceleration(moving, mode, y[0], y[1])
        return jnp.stack([y[1], jnp.where(mode.any_stuck, 0.0, pull)])

    slope = field(y)
    _, bend = jax.jvp(field, (y,), (slope,))
    turned = jnp.stack([jnp.ones(()), piece.way])
    line = jnp.stack([piece.lengths, jnp.zeros(())])
    duration = piece.durations
    return (
        turned * y + fraction * line,
        duration * turned * slope + line,
        duration**2 * turned * bend,
    )


class Outline(eqx.Module):
    """A curve that moves with the oscillator; see the module."""

    def pieces(self, osc: Oscillator) -> Pieces:
        """Where its pieces are, with derivatives by every parameter."""
        raise NotImplementedError


class Rest(Outline):
    """Where the mass can rest at one place: a point, or the line of a segment.

    first, last: numbers of its rows in `equilibria`.
    """

    first: int = eqx.field(static=True)
    last: int = eqx.field(static=True)

    def pieces(self, osc: Oscillator) -> Pieces:
        rests = equilibria(osc)
        x1 = rests.x1_lower[self.first]
        return Pieces(
            way=jnp.ones(1),
            # Of belts that do not touch there is nothing to compute.
            codes=jnp.full((1, len(osc.belts)), float(ABOVE)),
            mesh=jnp.ones((1, 1)),
            entries=jnp.stack([x1, jnp.zeros_like(x1)])[None],
            durations=jnp.zeros(1),
            lengths=(rests.x1_upper[self.last] - x1)[None],
        )


class JumpOutline(Outline):
    """Of the boundary of a belt whose static limit exceeds mu(0) a piece where a mass that is stuck
    is held, though the friction of one that slips is too weak for that: see `jumps`.

    upper: whether it is the one where the needed force, in the belt's direction, is the largest.
    """

    belt: int = eqx.field(static=True)
    zone: int = eqx.field(static=True)
    upper: bool = eqx.field(static=True)

    def pieces(self, osc: Oscillator) -> Pieces:
        lower, upper, velocity = _jumps_of(osc, jnp.asarray(np.array(self.belt)))
        x1, to = (ends[int(self.upper)][self.zone] for ends in (lower, upper))
        return Pieces(
            way=jnp.ones(1),
            codes=jnp.full((1, len(osc.belts)), float(ABOVE)),
            mesh=jnp.ones((1, 1)),
            entries=jnp.stack([x1, velocity])[None],
            durations=jnp.zeros(1),
            lengths=(to - x1)[None],
        )


@jit
def _jumps_of(osc: Oscillator, belt: Array) -> tuple[Array, Array, Array]:
    """Of the boundary of a belt, in each zone between contact edges, the x1 between which a mass is
    held though friction at rest, mu(0), would not do, [2, zones] each, where that pulls to the left
    and to the right; NaN where there are none; and the x2 of the boundary."""
    v = jnp.stack([one.velocity for one in osc.belts])[belt] / osc.omega
    positions, end = jnp.sort(jnp.stack(edges(osc))), jnp.full(1, jnp.inf)
    low, high = jnp.concatenate([-end, positions]), jnp.concatenate([positions, end])
    stuck = contact(osc, low, v, rightward=True)
    slips = Mode(tuple(jnp.where(code == STUCK, 1.0, code) for code in stuck.codes))
    zero = jnp.zeros_like(low)
    middle = mode_acceleration(osc, stuck, zero, v)
    kinetic = jnp.abs(mode_acceleration(osc, slips, zero, v) - middle)
    held = capacity(osc, stuck)
    exists = (jnp.stack(stuck.codes)[belt] == STUCK) & (held - kinetic > force_rounding(middle))
    lower = [jnp.clip(x1, low, high) for x1 in (middle - held, middle + kinetic)]
    upper = [jnp.clip(x1, low, high) for x1 in (middle - kinetic, middle + held)]
    there = [exists & (first < last) for first, last in zip(lower, upper, strict=True)]
    lower, upper = (
        jnp.stack([jnp.where(one, x1, jnp.nan) for one, x1 in zip(there, ends, strict=True)])
        for ends in (lower, upper)
    )
    return lower, upper, v


def jumps(osc: Oscillator) -> list[tuple[int, int, bool]]:
    """The pieces of boundaries that part motions themselves: belt, zone between contact edges, and
    whether it is the upper one of the two there.

    Where the static limit of a belt exceeds mu(0) a mass that comes to its boundary from one side
    is held up to the static limit, and one that is on the other side slips away.
    """
    found = []
    for belt in range(len(osc.belts)):
        lower = np.asarray(_jumps_of(osc, jnp.asarray(np.array(belt)))[0])
        found += [(belt, int(zone), bool(up)) for up, zone in np.argwhere(np.isfinite(lower))]
    return found


class ClosedOutline(Outline):
    """A cycle; way: -1 where it was solved for backwards."""

    chain: Chain
    unknowns: Array
    way: float = eqx.field(static=True)

    def pieces(self, osc: Oscillator) -> Pieces:
        moving = moved_in_time(osc, jnp.asarray(self.way))
        z = _solved_anew(moving, self.chain, self.unknowns)
        none = jnp.zeros(len(z))
        return Pieces(none + self.way, self.chain.codes, self.chain.mesh, z[:, :2], z[:, 2], none)


@jit
def _solved_anew(osc: Oscillator, chain: Chain, z: Array) -> Array:
    return solve_closed(osc, chain, z)[0]


class OpenOutline(Outline):
    """A stable separatrix, followed backwards from its point.

    chain: its arcs, or pieces of them: one that ends by nothing ("unused") goes on in the next, and
    the last one may be cut off so; durations: theirs. origin: of which sort its point is and
    numbers that say which: "edge", its number; "segment", the row of `equilibria`, and 0 for its
    lower and 1 for its upper end; "boundary", the belt, and the zone between edges; "corner", the
    belt, and the edge.
    """

    chain: Chain
    durations: Array
    origin: tuple[Any, ...] = eqx.field(static=True)

    def pieces(self, osc: Oscillator) -> Pieces:
        way = jnp.asarray(-1.0)
        point = self._point(osc) * jnp.array([1.0, -1.0])
        moving = moved_in_time(osc, way)
        entries, durations = _one_after_another(moving, self.chain, self.durations, point)
        none = jnp.zeros(len(durations))
        return Pieces(none - 1.0, self.chain.codes, self.chain.mesh, entries, durations, none)

    def _point(self, osc: Oscillator) -> Array:
        sort, *numbers = self.origin
        if sort == "boundary":
            belt, zone = numbers
            return tangencies(osc, jnp.asarray(np.array(belt)))[0][zone]
        if sort == "corner":
            belt, number = numbers
            return jnp.stack([edges(osc)[number], osc.belts[belt].velocity / osc.omega])
        if sort == "edge":
            x1 = edges(osc)[numbers[0]]
        else:
            rests = equilibria(osc)
            x1 = (rests.x1_lower, rests.x1_upper)[numbers[1]][numbers[0]]
        return jnp.stack([x1, jnp.zeros_like(x1)])


@jit
def _one_after_another(osc: Oscillator, chain: Chain, durations: Array, y: Array):
    """Entries and durations of the arcs of a chain that is open, from where it begins.

    Known durations are good to rounding. One Newton step gives each its first derivative.
    """
    unused = Ends(len(osc.belts)).unused

    def through(y, row):
        codes, end, mesh, known = row
        known = lax.stop_gradient(known)
        mode = mode_of(codes)
        last = flow(osc, codes, mesh, y, known)
        at_end = lax.stop_gradient((osc, last))
        slope = jnp.stack([at_end[1][1], mode_acceleration(at_end[0], mode, *at_end[1])])
        _, rate = jax.jvp(lambda y: end_guard(at_end[0], codes, end, y), (at_end[1],), (slope,))
        meets = (end != unused) & (rate != 0)
        late = jnp.where(meets, end_guard(osc, codes, end, last), 0.0)
        late = late / jnp.where(meets, rate, 1.0)
        return last - late * slope, (y, known - late)

    return lax.scan(through, y, (chain.codes, chain.ends, chain.mesh, durations))[1]


# --- outlines of what a portrait tells ------------------------------------------------------------


def outline_of_cycle(cycle: Cycle) -> ClosedOutline:
    """The outline of a cycle with status OK."""
    if isinstance(cycle, BackwardCycle):
        return ClosedOutline(cycle.backwards_chain, cycle.backwards_unknowns, -1.0)
    return ClosedOutline(cycle.chain, cycle.unknowns, 1.0)


def outline_of_separatrix(osc: Oscillator, separatrix: Separatrix) -> OpenOutline:
    """The outline of a stable separatrix."""
    arcs = cut_finely(moved_in_time(osc, jnp.asarray(-1.0)), separatrix.arcs)
    count = len(arcs.durations)
    rooms = np.arange(power_of_two(count, FEWEST))
    rows, own = np.minimum(rooms, count - 1), rooms < count
    loop = pick(arcs, rows)
    ends = np.where(own, np.asarray(loop.ends), Ends(len(osc.belts)).unused)
    durations = np.where(own, np.asarray(loop.durations), 0.0)
    loop = eqx.tree_at(lambda a: (a.ends, a.durations), loop, jax.device_put((ends, durations)))
    return OpenOutline(_backward_chain(osc, loop), loop.durations, _origin_of(osc, separatrix))


@jit
def _backward_chain(osc: Oscillator, loop: Loop) -> Chain:
    return meshed(moved_in_time(osc, jnp.asarray(-1.0)), loop, STEPS)[0]


def _origin_of(osc: Oscillator, separatrix: Separatrix) -> tuple[Any, ...]:
    x1, x2 = np.asarray(separatrix.point).tolist()
    if x2 != 0:
        for belt in range(len(osc.belts)):
            points = np.asarray(tangencies(osc, jnp.asarray(np.array(belt)))[0])
            zones = np.flatnonzero(np.all(points == [x1, x2], axis=1))
            if zones.size:
                return "boundary", belt, int(zones[0])
    places = np.asarray(edges(osc))
    if x2 != 0:
        levels = [float(belt.velocity / osc.omega) for belt in osc.belts]
        return "corner", levels.index(x2), int(np.flatnonzero(places == x1)[0])
    rests = equilibria(osc)
    for end, ends in enumerate((rests.x1_lower, rests.x1_upper)):
        rows = np.flatnonzero((np.asarray(ends) == x1) & (np.asarray(rests.kind) == 2))
        if rows.size and x1 not in places:
            return "segment", int(rows[0]), end
    return "edge", int(np.flatnonzero(places == x1)[0])
