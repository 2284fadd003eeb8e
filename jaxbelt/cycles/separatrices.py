"""Orbits that bound basins, from the points in which they end: `Separatrix`.

On an edge x1 = sigma the velocity is x1' = x2 on both sides, so orbits turn at (sigma, 0): those of
a side that pulls away from the edge touch it there. Where neither side draws the mass in, orbits
that pass the edge just below that point, or above it, go on, and those that miss it turn. The orbit
that ends in the point, one from each side, separates them: the stable separatrices, reached in
finite time. Where a side pushes away an orbit leaves from the point, an unstable separatrix. Where
both do the point is a saddle; where a belt at rest holds the mass on one side, a segment ends in
it.

Where a segment ends elsewhere, at the limit of what belts at rest hold, orbits that stop within it
stay, and those that stop beyond turn back. These are caught, too, if they stop near enough, unless
friction falls so steeply that the end is an unstable node of the field in which they turn, or the
static limit exceeds mu(0). Then the orbit that arrives at that end bounds the basin.

Where the static limit of a belt exceeds mu(0) an orbit that touches its boundary separates those
that pass by from those that stick, as these stick until the static limit. It ends in the point
where it touches, and continues as both.

Stable separatrices are followed backwards: in reversed time, t -> -t and x2 -> -x2, an oscillator
with the signs of its damping, loads and velocities changed. Backwards, too, an orbit continues in
one way as long as it slips, for it comes to a boundary only where orbits cross it: the mass leaves
a stick phase in one place only, slip onset. With a law whose static limit exceeds mu(0), orbits
leave upwards or downwards all along a piece of the boundary beyond slip; then the separatrix ends
there, and that piece of the boundary itself divides the motions.
"""

from collections.abc import Callable
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import number
from ..model.equilibria import Equilibria, EquilibriumKind, at_rest_beside, equilibria
from ..model.modes import (
    STUCK,
    Mode,
    capacity,
    distinct_places,
    edges,
    force_rounding,
    mode_acceleration,
    mode_of,
    select,
    velocity_of,
    zone_ends,
)
from ..model.oscillator import Oscillator
from ..model.own_units import quantity
from ..model.transitions import contact, contact_beside, mode_of_state
from ..motion.arcs import Ends
from ..motion.integrators import STRIDE, density
from ..numerics.compiling import each, jit
from ..results import Status, draw
from ..tables import table_of
from .backwards import reversed_in_time
from .chains import Loop
from .orbits import Orbit, follow_finely, place_of_rest
from .shooting import flow, trace_of

if TYPE_CHECKING:
    import pandas

#: Arcs for which a separatrix is followed, some 40 loops; and for a stable one whose loops still
#: grow then, as where damping is weak and loops pass many edges.
SEPARATRIX_ARCS, MORE_ARCS = 256, 2048
#: Tops that move by less, relative to the distance from the origin, are converging.
SETTLING = 1e-6
#: Samples of each arc; largest number of integration steps, of order 12, in one arc.
ARC_SAMPLES, STEPS_ALONG = 32, 100_000


class Separatrix(eqx.Module):
    """An orbit that leaves, or ends in, a point that divides motions.

    The point is (sigma, 0) of a contact edge, an end of a segment, a point where the orbit touches
    the boundary of a belt whose static limit exceeds mu(0), or one where an edge cuts off the piece
    of such a boundary on which only that limit holds the mass.

    Attributes:
        point: The point (x1, x2).
        side: "left" or "right": the side of the point on which the orbit is there.
        stable: Whether it ends in the point, and so may bound basins, or leaves it.
        ts: Times, 0 at the point, in order, [samples].
        ys: States (x1, x2), [samples, 2], good to 1e-9. Ends of arcs are among the samples.
        end: The other end, where an unstable one leads to and a stable one comes from:
            "equilibrium" (or an end of a segment), "cycle", "outside" (of `|x1|`, `|x2|` < reach,
            see `Portrait`), "boundary" (of a belt whose static limit exceeds mu(0): it leaves this
            boundary beside a piece where the mass sticks), or "unsettled" (it approaches its end
            too slowly).
        to: Number of that equilibrium, or of that attracting or unstable cycle, in the portrait;
            else -1.
        arcs: The arcs in the order in which they were followed from its point; for a stable one
            those of the oscillator reversed in time. The end of the last arc, if it is not an
            event, is "unused".
    """

    point: Array = eqx.field(metadata=quantity("length", "velocity"))
    side: str = eqx.field(static=True)
    stable: bool = eqx.field(static=True)
    ts: Array
    ys: Array = eqx.field(metadata=quantity("length", "velocity"))
    end: str = eqx.field(static=True)
    to: int = eqx.field(static=True)
    arcs: Loop

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each sample, in the order of time; columns: t, x1, x2."""
        x1, x2 = np.asarray(self.ys).T
        return table_of({"t": self.ts, "x1": x1, "x2": x2})

    def plot(self, ax: Any = None) -> Any:
        """Draws the separatrix in the phase plane, with its point.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        way = "from" if self.stable else "to"
        number_of = f" {self.to}" if self.to >= 0 else ""
        return (
            f"Separatrix({'stable' if self.stable else 'unstable'}, {self.side} of ("
            f"{number(self.point[0])}, {number(self.point[1])}), {way} {self.end}{number_of})"
        )


class TracedSeparatrix(NamedTuple):
    """A separatrix as it was followed: backwards, with x2 reversed, where it is stable.

    tops: its maxima of x1 in the order in which it reached them; y: its last state; rest: x1 where
    it came to rest, else NaN; status: of the orbit; cut: whether it came to a piece of a boundary
    where the mass sticks; arcs: see `Separatrix`.
    """

    point: tuple[float, float]
    side: str
    stable: bool
    ts: np.ndarray
    ys: np.ndarray
    tops: np.ndarray
    y: np.ndarray
    rest: float
    status: Status
    cut: bool
    arcs: Loop


def branches(osc: Oscillator, rests: Equilibria, reach: float) -> list[TracedSeparatrix]:
    """All separatrices of an oscillator, followed as long as |x1| and |x2| are < reach.

    rests: states of rest.
    """
    positions = np.asarray(jnp.stack(edges(osc)))
    found: list[TracedSeparatrix | None] = []
    parting: list[float] = []
    for x1 in positions[distinct_places(positions)].tolist():
        if not _orbits_part(osc, jax.device_put(np.array([x1]))):
            continue
        parting.append(x1)
        for stable, side in product((False, True), ("left", "right")):
            found.append(_at_rest(osc, x1, side, stable, reach))
    for rest in rests:
        if int(rest.kind) != EquilibriumKind.SEGMENT:
            continue
        for x1, side in ((float(rest.x1_lower), "right"), (float(rest.x1_upper), "left")):
            if x1 not in parting and _repels(osc, *_as_arrays(x1, side == "right")):
                found.append(_at_rest(osc, x1, side, True, reach))
    for belt in range(len(osc.belts)):
        for ends_of in (tangencies, corners):
            points, codes = map(np.asarray, ends_of(osc, *_as_arrays(belt)))
            for (x1, x2), mode in zip(points.tolist(), codes, strict=True):
                if np.isfinite(x1):
                    side = "left" if x2 > 0 else "right"
                    found.append(_branch(osc, (x1, x2), mode, side, True, reach))
    unique = {(b.point, b.side, b.stable): b for b in found if b is not None}
    return sorted(unique.values(), key=lambda branch: branch.point)


def _as_arrays(*numbers: float | int | bool) -> list[Array]:
    """Numbers as arrays of one type, so that one program serves all."""
    return [jnp.asarray(np.array(number)) for number in numbers]


@jit
def _orbits_part(osc: Oscillator, x1: Array) -> Array:
    """Whether an edge, x1 [1], divides orbits: one side pushes the mass away, and the other one
    does, too, or a belt holds the mass there.

    A fixed point that lies on the edge, up to rounding, does not divide them.
    """
    (left, a_left), (right, a_right) = (
        at_rest_beside(osc, x1, rightward=side) for side in (False, True)
    )
    holds = left.any_stuck & right.any_stuck
    parts = (left.any_stuck | (a_left < 0)) & (right.any_stuck | (a_right > 0)) & ~holds
    return parts[0]


@jit
def _repels(osc: Oscillator, x1: Array, rightward: Array) -> Array:
    """Whether orbits that turn just beyond an end of a segment, on the given side, leave it."""
    zero = jnp.zeros(())
    mode = mode_onward(osc, x1, rightward)
    (trace,) = trace_of(osc, mode, x1, zero)
    pull = mode_acceleration(osc, mode, x1, zero)
    pushes = jnp.where(rightward, pull, -pull) > force_rounding(x1)
    is_node = trace > 2 - force_rounding(0.0)
    return pushes | (jnp.abs(pull) < force_rounding(x1)) & is_node


def mode_onward(osc: Oscillator, x1: Array, rightward: Array) -> Mode:
    """The slip mode beside (x1, 0) on one side; a belt at rest opposes motion to that side."""
    sides = (contact_beside(osc, x1, jnp.zeros(()), rightward=side) for side in (True, False))
    mode = select(rightward, *sides)
    backward = jnp.where(rightward, -1.0, 1.0)
    return mode.slipping(backward)


@jit
def _leaves(osc: Oscillator, x1: Array, rightward: Array) -> tuple[Array, Array]:
    """Whether an orbit leaves (x1, 0) to a side, and the mode in which it would, [belts]."""
    mode = mode_onward(osc, x1, rightward)
    pull = mode_acceleration(osc, mode, x1, jnp.zeros(()))
    return jnp.where(rightward, pull, -pull) > 0, jnp.stack(mode.codes)


@jit
def tangencies(osc: Oscillator, belt: Array) -> tuple[Array, Array]:
    """Points where orbits touch the boundary of a belt whose static limit exceeds mu(0).

    One point for each zone between contact edges, [zones, 2], NaN where there is none; and the
    modes of these orbits, [zones, belts]. x2'' = -x2 there, so they are orbits that slip with the
    sign of the belt's velocity.
    """
    v = velocity_of(osc, belt) / osc.omega
    lower, upper = zone_ends(osc)
    stuck = contact(osc, lower, v, rightward=True)
    slips = stuck.slipping(jnp.sign(v))
    zero = jnp.zeros_like(lower)
    x1 = mode_acceleration(osc, slips, zero, v)
    kinetic = jnp.abs(x1 - mode_acceleration(osc, stuck, zero, v))
    exists = (jnp.stack(stuck.codes)[belt] == STUCK) & (lower < x1) & (x1 < upper) & (v != 0)
    exists = exists & (capacity(osc, stuck) - kinetic > force_rounding(x1))
    x1, x2 = jnp.where(exists, x1, jnp.nan), jnp.full_like(x1, v)
    return jnp.stack([x1, x2], axis=-1), jnp.stack(slips.codes, axis=-1)


@jit
def corners(osc: Oscillator, belt: Array) -> tuple[Array, Array]:
    """Points where a contact edge cuts off a piece of a belt's boundary that only static friction
    holds.

    On that piece only a static limit that exceeds mu(0) holds the mass. Returns for each zone
    between edges the point where the mass enters the piece, [zones, 2], NaN where there is none;
    and the modes of the orbits that arrive there, [zones, belts]. On one side of such an orbit the
    mass is held, on the other it slips away.
    """
    v = velocity_of(osc, belt) / osc.omega
    lower, upper = zone_ends(osc)
    x1 = jnp.where(v > 0, lower, upper)
    inside, before = (_beside(osc, x1, v, rightward=side) for side in (v > 0, v < 0))
    slips = inside.slipping(jnp.sign(v))
    pull = mode_acceleration(osc, inside, x1, v)
    kinetic = jnp.abs(mode_acceleration(osc, slips, x1, v) - pull)
    exists = (jnp.stack(inside.codes)[belt] == STUCK) & (v != 0)
    exists = exists & (upper - lower > force_rounding(x1))
    exists = exists & jnp.isfinite(x1) & (jnp.abs(pull) - kinetic > force_rounding(x1))
    exists = exists & (capacity(osc, inside) - jnp.abs(pull) > force_rounding(x1))
    # The orbit comes from the side to which the mass slips away; or, where it crosses the boundary
    # there, from the other one.
    away = -jnp.sign(pull)
    modes = [before.slipping(sign) for sign in (away, -away)]
    comes = [
        sign * mode_acceleration(osc, mode, x1, v) > 0 for sign, mode in zip((away, -away), modes)
    ]
    free = ~jnp.any(jnp.stack(before.codes) == STUCK, axis=0)
    exists = exists & (free | comes[0] | comes[1])
    mode = select(free | comes[0], *modes)
    x1, x2 = jnp.where(exists, x1, jnp.nan), jnp.full_like(x1, v)
    return jnp.stack([x1, x2], axis=-1), jnp.stack(mode.codes, axis=-1)


def _beside(osc: Oscillator, x1: Array, x2: Array, *, rightward: Array) -> Mode:
    sides = (contact(osc, x1, x2, rightward=side) for side in (True, False))
    return select(rightward, *sides)


def end_points(osc: Oscillator) -> Array:
    """All points in which separatrices may begin or end, [points, 2], NaN where there is none.

    First come the points on contact edges, then those on boundaries of belts, last the ends of
    equilibria and segments, whose number is not known under a trace.
    """
    points = [
        ends_of(osc, *_as_arrays(belt))[0]
        for belt in range(len(osc.belts))
        for ends_of in (tangencies, corners)
    ]
    rests = equilibria(osc)
    ends = jnp.stack([rests.x1_lower, rests.x1_upper], axis=1).reshape(-1)
    on_edges, at_rest = (
        jnp.stack([x1, jnp.zeros_like(x1)], axis=1) for x1 in (jnp.stack(edges(osc)), ends)
    )
    return jnp.concatenate([on_edges, *points, at_rest])


def _at_rest(
    osc: Oscillator, x1: float, side: str, stable: bool, reach: float
) -> TracedSeparatrix | None:
    """The separatrix of a point (x1, 0) on one side of it, or None if there is none."""
    moving = reversed_in_time(osc) if stable else osc
    leaves, mode = map(np.asarray, _leaves(moving, *_as_arrays(x1, side == "right")))
    # In reversed time all relative velocities have the opposite sign.
    mode = np.where(np.abs(mode) == 1, -mode, mode) if stable else mode
    return _branch(osc, (x1, 0.0), mode, side, stable, reach) if leaves else None


def places_along(
    osc: Oscillator, codes: Array, y: Array, duration: Array, rate: Callable, marks: Array
) -> tuple[Array, Array]:
    """Times since the entry of an arc, [n], and states, [n, 2], at which an integral over time
    reaches marks.

    rate: the integrand, a function of the state; marks: increasing, [n]. For marks that are not
    reached the end of the arc is returned.
    """
    mode = mode_of(codes)

    def to(carry, mark):
        def before(carry):
            _, left, total = carry
            # Where the rate is NaN, the arc ends.
            return (left > 0) & ~(total >= mark)

        def step(carry):
            y, left, total = carry
            wanted = jnp.maximum(STRIDE / density(osc, mode, *y), duration / STEPS_ALONG)
            length, pace = jnp.minimum(wanted, left), rate(y)
            passes = total + pace * length > mark
            length = jnp.where(passes, (mark - total) / pace, length)
            total = jnp.where(passes, mark, total + pace * length)
            return flow(osc, codes, jnp.ones(1), y, length), left - length, total

        carry = lax.while_loop(before, step, carry)
        y, left, _ = carry
        return carry, (duration - left, y)

    return lax.scan(to, (y, duration, jnp.zeros(())), marks)[1]


def arc_samples(
    osc: Oscillator, codes: Array, y: Array, exit_: Array, duration: Array, n: int
) -> tuple[Array, Array]:
    """Times and states of n samples of an arc, the last at its end.

    Three quarters of them are spread evenly along its way in the plane, the others evenly in time.
    The length of the way is |dx1| + |dx2| between the ends, as x1 and x2 are monotone along arcs.
    """
    mode = mode_of(codes)
    way = jnp.sum(jnp.abs(exit_ - y))

    def rate(y):
        pull = jnp.where(mode.any_stuck, 0.0, mode_acceleration(osc, mode, *y))
        return 0.75 * (jnp.abs(y[1]) + jnp.abs(pull)) / way + 0.25 / duration

    marks = jnp.append(jnp.arange(1, n) / n, jnp.inf)
    return places_along(osc, codes, y, duration, rate, marks)


@jit
def _orbit_from(osc: Oscillator, y: Array, codes: Array, reach: Array, budget: int):
    """The orbit from a state in a mode, its place of rest, and samples of its arcs.

    Samples are times since the entry, [arcs, samples], and states there.
    """
    orbit = follow_finely(osc, mode_of(codes), y, budget, reach)
    rest = place_of_rest(osc, orbit)
    used = jnp.arange(budget) < orbit.count
    durations = jnp.where(used & jnp.isfinite(orbit.durations), orbit.durations, 0.0)

    def samples(codes, entry, exit_, duration):
        return arc_samples(osc, codes, entry, exit_, duration, ARC_SAMPLES)

    return orbit, rest, *each(samples)(orbit.codes, orbit.entries, orbit.exits, durations)


@jit
def _is_held(osc: Oscillator, ys: Array) -> Array:
    return mode_of_state(osc, ys[:, 0], ys[:, 1]).any_stuck


def _still_grows(orbit: Orbit) -> bool:
    """Whether the loops of an orbit still grew when its budget of arcs was used up."""
    tops = np.asarray(orbit.tops)[: int(orbit.count)]
    tops = tops[~np.isnan(tops)]
    is_left = int(orbit.status) == Status.NOT_SETTLED and tops.size > 1
    return bool(is_left and tops[-1] - tops[-2] > SETTLING * (1 + abs(tops[-1])))


def _branch(
    osc: Oscillator,
    point: tuple[float, float],
    codes: np.ndarray,
    side: str,
    stable: bool,
    reach: float,
) -> TracedSeparatrix:
    """The separatrix that leaves, or comes to, a point in a mode."""
    way = np.array([1.0, -1.0 if stable else 1.0])
    start = np.array(point) * way, np.where(np.abs(codes) == 1, codes * way[1], codes)
    moving = reversed_in_time(osc) if stable else osc
    given = moving, *jax.device_put(start), *_as_arrays(reach)
    found = _orbit_from(*given, SEPARATRIX_ARCS)
    if stable and _still_grows(found[0]):
        found = _orbit_from(*given, MORE_ARCS)
    orbit, rest, since, states = jax.tree.map(np.asarray, found)
    count, was_cut, y = int(orbit.count), False, orbit.y
    if stable:
        following = np.concatenate([orbit.entries[1:], orbit.y[None]])
        following[count - 1] = orbit.y
        at_boundary = (np.arange(len(following)) < count) & (orbit.ends < len(osc.belts))
        at_boundary &= orbit.ends >= 0
        stuck = np.flatnonzero(
            at_boundary & np.asarray(_is_held(osc, jax.device_put(following * way)))
        )
        if stuck.size:
            count, was_cut = int(stuck[0]) + 1, True
            y = following[count - 1]
    begins = np.append(0.0, np.cumsum(since[:count, -1]))[:-1]
    ts = np.concatenate([[0.0], (begins[:, None] + since[:count]).ravel()])
    ys = np.concatenate([[point], states[:count].reshape(-1, 2) * way])
    tops = orbit.tops[:count]
    if stable:
        ts, ys = -ts[::-1], ys[::-1]
    # The last arc has no end event, unless it came to a boundary where the mass sticks.
    known = np.arange(count) < count - (not was_cut)
    ends = np.where(known, orbit.ends[:count], Ends(len(osc.belts)).unused)
    # An arc that creeps was followed in pieces; these are one arc.
    whole = min(count, int(np.argmax(np.append(ends, -1) < 0)) + 1)
    durations = np.append(since[: whole - 1, -1], np.sum(since[whole - 1 : count, -1]))
    ends = np.where(ends < 0, Ends(len(osc.belts)).unused, ends)
    columns = orbit.codes[:whole], ends[:whole], orbit.entries[:whole], durations
    arcs = Loop(*jax.device_put(columns))
    end = tops[~np.isnan(tops)], y, float(rest), Status(int(orbit.status))
    return TracedSeparatrix(point, side, stable, ts, ys, *end, was_cut, arcs)
