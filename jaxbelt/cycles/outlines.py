"""Curves of the phase plane in smooth pieces, as functions of the oscillator: `Outline`.

A cycle, a separatrix and a segment of equilibria are such curves. An outline keeps the discrete
data of a curve, the modes and the ends of its arcs, which do not change when the oscillator changes
a little; the place of the curve follows from the oscillator, and so do its derivatives: for a cycle
those of the shooting equations, for a separatrix those of its arcs one after another, each of which
ends where the guard of its end vanishes.

A point of a curve is given by the number of its piece and a fraction, from 0 at the beginning of
the piece to 1.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..model.equilibria import equilibria
from ..model.modes import (
    ABOVE,
    STUCK,
    capacity,
    force_rounding,
    mode_acceleration,
    mode_of,
    velocity_of,
    zone_ends,
)
from ..model.oscillator import Oscillator
from ..model.transitions import contact
from ..motion.arcs import Ends
from ..motion.integrators import density
from ..numerics.compiling import each, jit, power_of_two
from ..numerics.implicit import step_to_root
from ..numerics.padding import filled_up
from .backwards import BackwardCycle, moved_in_time
from .chains import Chain, Loop
from .cycle import Cycle
from .separatrices import Separatrix, end_points, places_along
from .shooting import closed, end_guard, flow, meshed

#: Integration steps in an arc of a separatrix, or in a piece of one; largest integral of the
#: density of steps over a piece, for which these suffice.
STEPS, PIECE = 16, 8.0
#: Pieces that are cut off each arc in one compiled call.
CUT_AT_ONCE = 32
#: Least number of rows of the arrays of arcs and pieces, so that few shapes are compiled.
FEWEST = 16


class Pieces(eqx.Module):
    """Pieces of curves, a row each: arcs of orbits, or straight lines along the x1 axis.

    Attributes:
        way: 1, or -1 for an arc of the oscillator reversed in time, the x2 of which is reversed,
            too.
        codes: Contact codes, [pieces, belts].
        mesh: Steps as fractions, [pieces, steps].
        entries: Where it begins, (x1, x2) or (x1, -x2), [pieces, 2].
        durations: Duration of the arc, 0 for a line.
        lengths: Length of the line, 0 for an arc.
    """

    way: Array
    codes: Array
    mesh: Array
    entries: Array
    durations: Array
    lengths: Array


def straight(osc: Oscillator, x1: Array, to: Array, x2: Array) -> Pieces:
    """A straight line along x1, or a point; all belts count as not touching, to save work."""
    one, away = jnp.ones(1), jnp.full((1, len(osc.belts)), float(ABOVE))
    return Pieces(one, away, one[None], jnp.stack([x1, x2])[None], 0 * one, (to - x1) * one)


def place_on(osc: Oscillator, piece: Pieces, fraction: Array) -> tuple[Array, Array, Array]:
    """A point (x1, x2) of a piece, and its first and second derivatives by the fraction.

    piece: one row of `Pieces`.
    """
    moving, mode = moved_in_time(osc, piece.way), mode_of(piece.codes)
    y = flow(moving, piece.codes, piece.mesh, piece.entries, fraction * piece.durations)

    def field(y):
        pull = mode_acceleration(moving, mode, y[0], y[1])
        return jnp.stack([y[1], jnp.where(mode.any_stuck, 0.0, pull)])

    slope = field(y)
    _, bend = jax.jvp(field, (y,), (slope,))
    turned = jnp.stack([jnp.ones(()), piece.way])
    line = jnp.stack([piece.lengths, jnp.zeros(())])
    rate = piece.durations * turned
    return turned * y + fraction * line, rate * slope + line, rate * piece.durations * bend


class Outline(eqx.Module):
    """A curve that moves with the oscillator; see the module."""

    def pieces(self, osc: Oscillator) -> Pieces:
        """Its pieces, with derivatives by every parameter."""
        raise NotImplementedError


class StraightOutline(Outline):
    """A straight line along x1, or a point.

    Attributes:
        belt: Belt on whose boundary it lies, see `jumps`; -1: it consists of equilibria.
        first: Row of `jumps`, or of `equilibria`, where it begins.
        last: Row where it ends.
    """

    belt: int = eqx.field(static=True)
    first: int = eqx.field(static=True)
    last: int = eqx.field(static=True)

    def pieces(self, osc: Oscillator) -> Pieces:
        if self.belt < 0:
            rests = equilibria(osc)
            lower, upper, x2 = rests.x1_lower, rests.x1_upper, jnp.zeros(())
        else:
            lower, upper, x2 = jumps(osc, jnp.asarray(np.array(self.belt)))
        return straight(osc, lower[self.first], upper[self.last], x2)


@jit
def jumps(osc: Oscillator, belt: Array) -> tuple[Array, Array, Array]:
    """Pieces of the boundary of a belt that divide motions.

    Where the static limit of a belt exceeds mu(0), a mass that reaches its boundary from one side
    is held up to the static limit, and a mass on the other side slips away. In each zone there is
    one such piece where the needed force pulls to the left, and one where it pulls to the right.

    Returns:
        The least and the largest x1 of each piece, [2 * zones], first of the pieces at smaller x1
        of all zones, NaN where there is none; and x2 of the boundary.
    """
    v = velocity_of(osc, belt) / osc.omega
    low, high = zone_ends(osc)
    stuck = contact(osc, low, v, rightward=True)
    slips = stuck.slipping(1.0)
    zero = jnp.zeros_like(low)
    middle = mode_acceleration(osc, stuck, zero, v)
    kinetic = jnp.abs(mode_acceleration(osc, slips, zero, v) - middle)
    held = capacity(osc, stuck)
    exists = (jnp.stack(stuck.codes)[belt] == STUCK) & (held - kinetic > force_rounding(middle))
    lower = jnp.clip(jnp.stack([middle - held, middle + kinetic]), low[None], high[None])
    upper = jnp.clip(jnp.stack([middle - kinetic, middle + held]), low[None], high[None])
    there = exists[None] & (lower < upper)
    lower, upper = (jnp.where(there, x1, jnp.nan).reshape(-1) for x1 in (lower, upper))
    return lower, upper, v


class ClosedOutline(Outline):
    """A cycle; way: -1 where it was solved for in reversed time, else 1."""

    chain: Chain
    unknowns: Array
    way: float = eqx.field(static=True)

    @classmethod
    def of(cls, cycle: Cycle) -> "ClosedOutline":
        """The outline of a cycle with status OK."""
        if isinstance(cycle, BackwardCycle):
            return cls(cycle.backwards_chain, cycle.backwards_unknowns, -1.0)
        return cls(cycle.chain, cycle.unknowns, 1.0)

    def pieces(self, osc: Oscillator) -> Pieces:
        z = _closed_chain(moved_in_time(osc, self.way), self.chain, self.unknowns)
        none = jnp.zeros(len(z))
        return Pieces(none + self.way, self.chain.codes, self.chain.mesh, z[:, :2], z[:, 2], none)


_closed_chain = jit(closed)


class OpenOutline(Outline):
    """A stable separatrix, followed backwards from its point.

    Attributes:
        chain: Its arcs, or pieces of them. One without an end event ("unused") continues in the
            next, and the last one may be cut off.
        durations: Their durations.
        origin: Row of its point among `end_points`.
    """

    chain: Chain
    durations: Array
    origin: int = eqx.field(static=True)

    @classmethod
    def of(cls, osc: Oscillator, separatrix: Separatrix) -> "OpenOutline":
        """The outline of a stable separatrix."""
        away = np.abs(np.asarray(end_points(osc)) - np.asarray(separatrix.point)).sum(axis=1)
        moving = moved_in_time(osc, -1.0)
        loop = _cut_finely(moving, separatrix.arcs)
        return cls(_chain_of(moving, loop), loop.durations, int(np.nanargmin(away)))

    def pieces(self, osc: Oscillator) -> Pieces:
        point = end_points(osc)[self.origin] * jnp.array([1.0, -1.0])
        moving = moved_in_time(osc, -1.0)
        entries, durations = _one_after_another(moving, self.chain, self.durations, point)
        none = jnp.zeros(len(durations))
        return Pieces(none - 1.0, self.chain.codes, self.chain.mesh, entries, durations, none)


@jit
def _one_after_another(osc: Oscillator, chain: Chain, durations: Array, y: Array):
    """Entries and durations of the arcs of an open chain, from its beginning.

    The given durations are exact up to rounding. One Newton step gives each its first derivatives.
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
        late = step_to_root(end_guard(osc, codes, end, last), rate, where=end != unused)
        return last + late * slope, (y, known + late)

    return lax.scan(through, y, (chain.codes, chain.ends, chain.mesh, durations))[1]


@jit
def _chain_of(osc: Oscillator, loop: Loop) -> Chain:
    return meshed(osc, loop, STEPS)[0]


def _cut_finely(osc: Oscillator, loop: Loop) -> Loop:
    """Successive arcs, those that need more than STEPS steps cut into pieces.

    A piece that is not the last of its arc has no end event ("unused"). Rows of padding have the
    duration zero. An arc may creep: to a node on the boundary of a belt, for example, near which it
    stays for a hundred times as long as it moved.
    """
    count = len(loop.ends)
    padded = filled_up(loop, np.arange(count), power_of_two(count, FEWEST))
    entries, left = map(np.array, (padded.entries, padded.durations))
    left[count:] = 0.0
    idle = np.flatnonzero(left[:count] == 0)
    found = [(idle, entries[idle], left[idle])]
    while np.any(left > 0):
        # Arcs that are cut to their ends take no step.
        cut = _first_pieces(osc, padded.codes, *jax.device_put((entries, left)))
        ts, states = map(np.asarray, cut)
        begins = np.concatenate([entries[:, None], states[:, :-1]], axis=1)
        durations = np.diff(ts, prepend=0.0, axis=1)
        arcs, columns = np.nonzero(durations > 0)
        found.append((arcs, begins[arcs, columns], durations[arcs, columns]))
        entries, left = states[:, -1], left - ts[:, -1]
    rows, begins, durations = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.argsort(rows, kind="stable")
    is_last = np.append(np.diff(rows[order]) != 0, True)
    size = np.arange(power_of_two(len(order), FEWEST))
    own, at = size < len(order), np.minimum(size, len(order) - 1)
    rows, ends = rows[order[at]], np.asarray(loop.ends)
    ends = np.where(own & is_last[at], ends[rows], Ends(len(osc.belts)).unused)
    durations = np.where(own, durations[order[at]], 0.0)
    codes = np.asarray(loop.codes)[rows]
    return Loop(*jax.device_put((codes, ends, begins[order[at]], durations)))


@jit
def _first_pieces(osc: Oscillator, codes: Array, entries: Array, durations: Array):
    def of_arc(codes, y, duration):
        def wanted(y):
            return density(osc, mode_of(codes), *y)

        marks = PIECE * jnp.arange(1.0, CUT_AT_ONCE + 1)
        return places_along(osc, codes, y, duration, wanted, marks)

    return each(of_arc)(codes, entries, durations)
