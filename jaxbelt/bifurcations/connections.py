"""Orbits from one saddle of a contact edge to another, or back to the same one: `SaddleConnection`.

At (sigma, 0) of an edge from which both sides push away two orbits begin and two end, in finite
time: its unstable and its stable separatrices, see `cycles.separatrices`. Where an orbit that
begins at a saddle ends at a saddle, the basins beside it change. An orbit back to the same saddle
is a cycle of finite period that passes a point where orbits part: an unstable or an attracting
cycle is born or vanishes there.

The orbit from the saddle is an open chain of arcs. It has as many equations as a cycle with these
arcs, see `cycles.shooting`: the two equations of closing are replaced by those of beginning at the
saddle, and one more says that the orbit ends at a saddle. On one side of the point it turns just
before the edge, on the other side it passes the edge; the last arc is made to end where x2 = 0, so
that the additional equation, x1 = sigma there, is linear in the unknowns.

Between two values the orbits from the saddles are compared by their courses: between which saddles
each of their extrema of x1 lies, one after the other. These change where an extremum lies on a
saddle, and nowhere else, for an orbit depends continuously on the parameter until it comes to a
saddle. This fails where the static limit of a belt exceeds mu(0), or a belt is at rest; courses
are not compared there.

Connections of two-folds are described by M. Guardia, T. Seara, M. Teixeira, Generic bifurcations of
low codimension of planar Filippov systems, J. Differential Equations 250 (2011) 1967-2023, and
those of pseudo-saddles by Yu. Kuznetsov, S. Rinaldi, A. Gragnani, One-parameter bifurcations in
planar Filippov systems, Int. J. Bifurcation and Chaos 13 (2003) 2157-2188.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import check_belt, is_concrete, pick
from ..cycles.attractors import extent
from ..cycles.chains import SIZES, Chain, Loop, cut, first_failure
from ..cycles.closure import admissible
from ..cycles.cycle import cycle_of
from ..cycles.orbits import Orbit, follow_from, place_of_rest
from ..cycles.separatrices import mode_onward
from ..cycles.shooting import flow, meshed
from ..model.equilibria import pushes_away, saddles
from ..model.families import Family
from ..model.modes import distinct_places, edge_at, edges, mode_acceleration, mode_of
from ..model.oscillator import Oscillator
from ..motion.arcs import Ends
from ..numerics.compiling import each, jit
from ..numerics.continuation import Stop
from ..numerics.newton import HOLDS, newton
from ..results import Status
from .base import AbstractCondition, Line, point_of
from .crossings import has_jump
from .edge_rests import check_edge
from .rests import hopf_limit
from .systems import (
    CycleSystem,
    Seen,
    contact_tests,
    nearest_contacts,
    solve_system,
    velocity_tests,
)

#: Number of arcs for which the orbits from saddles are followed: some ten loops.
ARCS = SIZES[2] - 1
#: States along each arc of a connection that is drawn.
CONNECTION_SAMPLES = 33
#: Number of extrema of x1 in a course. There may be five arcs between two of them.
EXTREMA = 12


class Connection(CycleSystem):
    """An orbit from the saddle of one edge to that of another.

    leaves, arrives: numbers of the edges, see `modes.edges`. The last row of the chain is no arc:
    its state is the end of the orbit.
    """

    chain: Chain
    leaves: Array
    arrives: Array

    def condition(self, osc, z, miss):
        return z[-1, 0] - edge_at(osc, self.arrives)

    def _beginning(self, osc: Oscillator, entry: Array) -> Array:
        """Difference of the first state of the orbit from the saddle that it leaves, [2]."""
        return entry - jnp.stack([edge_at(osc, self.leaves), jnp.zeros(())])

    def residual(self, osc, x):
        closed = super().residual(osc, x)
        return closed.at[self._closing(x)].set(self._beginning(osc, x[0, :2]))

    def _closing(self, x: Array) -> slice:
        """Rows of the two equations by which a chain closes."""
        return slice(x.size - 3, x.size - 1)

    def linearized(self, osc_of, x, p):
        value, matrix = super().linearized(osc_of, x, p)

        def begins(u):
            return self._beginning(osc_of(u[2:]), u[:2])

        u, rows = jnp.append(x[0, :2], p), self._closing(x)
        slopes = jax.jacfwd(begins)(u)
        row = jnp.zeros((2, matrix.shape[1]))
        row = row.at[:, :2].set(slopes[:, :2]).at[:, x.size :].set(slopes[:, 2:])
        return value.at[rows].set(begins(u)), matrix.at[rows].set(row)

    def exists(self, osc: Oscillator, x: Array) -> Array:
        """Whether the orbit is admissible, and both of its ends are saddles."""
        ends = jnp.stack([self.leaves, self.arrives])
        return admissible(osc, self.chain, x) & jnp.all(saddles(osc)[ends])

    def closes(self, osc: Oscillator) -> Array:
        """Whether the orbit comes back to the saddle that it leaves."""
        positions = jnp.stack(edges(osc))
        return positions[self.leaves] == positions[self.arrives]

    def place(self, osc, x):
        # The state at the end of the orbit counts, too.
        used = np.asarray(self.chain.used)
        return extent(np.concatenate([x[used], x[-1:]]))

    def seen_at(self, osc, x):
        error = jnp.max(jnp.abs(self.residual(osc, x)))
        exists = (error < HOLDS) & self.exists(osc, x)
        sticks = self.chain.used & jnp.any(self.chain.codes == 0, axis=-1)
        nearest, _ = nearest_contacts(osc, self.chain, x, sticks)
        tests = velocity_tests(osc) | contact_tests("DoubleSliding", nearest, jnp.isfinite(nearest))
        # The weakest push away from either saddle.
        away = jnp.stack(pushes_away(osc))[:, jnp.stack([self.leaves, self.arrives])]
        tests["BoundaryEquilibrium", ()] = jnp.min(away)
        leaves, arrives = edge_at(osc, jnp.stack([self.leaves, self.arrives]))
        tests["MeetingEdges", ()] = jnp.where(leaves == arrives, jnp.nan, leaves - arrives)
        return Seen(tests, exists, jnp.asarray(jnp.nan), error)


class SaddleConnection(AbstractCondition):
    """A separatrix that leaves a saddle, (sigma, 0) of a contact edge, ends in a saddle.

    Where it is the same saddle, `cycle` of the point is the connection itself, a cycle that is born
    or vanishes there. Two belts may share the edge: either may be named.

    Args:
        belt: Number of the belt whose edge it leaves.
        to: Number of the belt at whose edge it ends, the same or another one; None: any.
    """

    belt: int | Array
    to: int | Array | None = None

    caption: ClassVar[str] = "saddle connection, belt {belt}"
    line: ClassVar[Line] = Line("saddle connection", "#CC79A7", (0, (4, 1, 1, 1)))
    has_several: ClassVar[bool] = True

    @property
    def belts_concerned(self):
        return tuple(int(belt) for belt in dict.fromkeys([self.belt, self.to]) if belt is not None)

    @property
    def lineage(self):
        return type(self).__name__, (int(self.belt),)

    @property
    def sought(self):
        return SaddleConnection(self.belt)

    def named(self, point):
        belts = self._belts_reached(point)
        return SaddleConnection(self.belt, self.belt if self.belt in belts else belts[0])

    def covers(self, point):
        other = point.condition
        if not isinstance(other, SaddleConnection) or self.belt != other.belt:
            return False
        return self.to is None or self.to in other._belts_reached(point)

    def _belts_reached(self, point) -> list[int]:
        """Belts at whose edge the connection at a point ends."""
        system, _ = self.system_at(point)
        positions = np.asarray(jnp.stack(edges(point.oscillator)))
        is_there = (positions == positions[int(system.arrives)]).reshape(2, -1)
        return np.flatnonzero(np.any(is_there, axis=0)).tolist()

    def check(self, osc):
        if self.to is not None:
            check_belt(self.to, len(osc.belts), "to", ", or None")
        super().check(osc)
        check_edge(osc, self.belt)
        if self.to is not None:
            check_edge(osc, self.to, "to")

    def as_data(self):
        # One program serves all belts; -1 stands for None.
        to = -1 if self.to is None else self.to
        return SaddleConnection(*(jnp.asarray(np.array(one)) for one in (self.belt, to)))

    @property
    def room(self):
        return SIZES[2]

    def guess(self, osc, size):
        loop, *rest = _nearest_connection(osc, self.belt, self.to, size)
        # As few rows as the orbit needs, if their number is known; one more holds its end.
        return cut([loop], more=1)[0] if is_concrete(loop) else loop, *rest

    def prepared(self, osc, guess):
        return _with_mesh(osc, *guess)

    def point_near(self, family, system, x, p, status):
        return _solved_connection(family, system, x, p, status)

    def system_at(self, point):
        osc, data = point.oscillator, self.as_data()
        system, x, _ = data.prepared(osc, data.guess(osc, self.room))
        return system, _solved_at(osc, system, x)

    def type_of(self, point):
        return "homoclinic" if int(point.cycle.status) == Status.OK else "heteroclinic"

    def place(self, point):
        system, x = self.system_at(point)
        return system.place(point.oscillator, np.asarray(x))

    def orbit(self, point):
        system, x = self.system_at(point)
        states = np.asarray(_states_on(point.oscillator, system, x))
        return states[np.asarray(system.chain.used)].reshape(-1, 2)

    def limit(self, trail):
        """The Hopf point on the edge to which the connection, with its saddle, has shrunk."""
        if trail.end is Stop.POINT_COUNT:
            return None
        return hopf_limit("BoundaryHopf", trail, _from_edge, trail.system.leaves)

    @classmethod
    def between(cls, before, after, edged):
        differ = len(before.courses) == len(after.courses) and before.courses != after.courses
        return [cls(belt) for belt in edged] if differ else []


def _from_edge(osc: Oscillator, codes: Array, x1: Array, edge: Array) -> Array:
    return x1 - edge_at(osc, edge)


@jit
def _with_mesh(osc: Oscillator, loop: Loop, leaves: Array, arrives: Array, status: Array):
    osc = lax.stop_gradient(osc)
    chain, z = meshed(osc, loop)
    return Connection(chain, leaves, arrives).refined(osc, z), z, status


@jit
def _solved_connection(family: Family, system: Connection, z0, p0, status):
    solution = solve_system(family, system, z0, p0, status)
    osc, z, status = family.at(solution.p), solution.z, solution.status
    status = first_failure(status, system.exists(osc, z), Status.NOT_ADMISSIBLE)
    closes = jnp.where(system.closes(osc), status, Status.EQUILIBRIUM.value)
    cycle, _ = cycle_of(osc, system.chain, z, solution.iterations, closes, solution.residual)
    return point_of(family, solution, cycle, jnp.asarray(jnp.nan), status), (z, solution.p)


@jit
def _solved_at(osc: Oscillator, system: Connection, x: Array) -> Array:
    """Unknowns of the orbit that leaves the saddle, at a fixed parameter, up to where x2 = 0."""

    def linearized(x):
        value, matrix = system.linearized(lambda _: osc, x.reshape(-1, 3), jnp.zeros(1))
        return value[:-1], matrix[:-1, :-1]

    return newton(linearized, x.reshape(-1)).z.reshape(-1, 3)


@jit
def _states_on(osc: Oscillator, system: Connection, x: Array) -> Array:
    """States along each arc, its ends included, [arcs, samples, 2]."""

    def arc(row):
        codes, mesh, (x1, x2, duration) = row

        def at(fraction):
            return flow(osc, codes, mesh, jnp.stack([x1, x2]), fraction * duration)

        return lax.map(at, jnp.linspace(0.0, 1.0, CONNECTION_SAMPLES))

    return lax.map(arc, (system.chain.codes, system.chain.mesh, x))


def _departing(osc: Oscillator, edge: Array, rightward: Array, parts: Array, budget: int) -> Orbit:
    """The orbit that leaves the saddle of an edge to one side; parts: whether it is a saddle."""
    x1 = jnp.where(parts, edge_at(osc, edge), 0.0)
    status = jnp.where(parts, Status.OK.value, Status.NOT_FINITE.value)
    y = jnp.stack([x1, jnp.zeros(())])
    return follow_from(osc, mode_onward(osc, x1, rightward), y, status, budget)


def _turns_back(osc: Oscillator, orbit: Orbit) -> Array:
    """Mask [arcs] of those that end in an extremum of x1, or on the boundary of a belt at rest."""
    n, velocities = len(osc.belts), jnp.stack([belt.velocity for belt in osc.belts])
    meets_rest = (orbit.ends < n) & (velocities[jnp.clip(orbit.ends, 0, n - 1)] == 0)
    return (orbit.ends == Ends(n).extremum_x1) | meets_rest


@jit
def _nearest_connection(osc: Oscillator, belt: Array, to: Array, size: int):
    """The orbit from the saddles of a belt that comes nearest to a saddle.

    Returns the orbit up to there as a loop, the numbers of both edges, and a status. to: the belt
    of the saddle at the end; -1: any.
    """
    osc = lax.stop_gradient(osc)
    n, names, parts = len(osc.belts), Ends(len(osc.belts)), saddles(osc)
    positions = jnp.stack(edges(osc))
    numbers = jnp.arange(2 * n)
    shared = positions == jnp.where(to < 0, jnp.nan, positions[to])
    shared = shared | (positions == jnp.where(to < 0, jnp.nan, positions[n + to]))
    wanted = parts & ((to < 0) | shared)

    def one(start):
        edge, rightward = start
        orbit = _departing(osc, edge, rightward, parts[edge], size - 1)
        exits = orbit.exits
        turns = jnp.where(_turns_back(osc, orbit), 0.0, jnp.inf)
        turned = jnp.abs(exits[:, :1] - positions[None]) + turns[:, None]
        # An orbit that passes an edge: how much farther it would have gone, in its mode, to x2 = 0.
        on_edge = (orbit.ends >= n) & (orbit.ends < 3 * n)
        at = positions[jnp.clip(orbit.ends - n, 0, 2 * n - 1)]
        push = jax.vmap(
            lambda codes, x1: mode_acceleration(osc, mode_of(codes), x1, jnp.zeros(()))
        )(orbit.codes, jnp.where(on_edge, at, 0.0))
        further = 0.5 * exits[:, 1] ** 2 / jnp.where(push == 0, jnp.nan, jnp.abs(push))
        passed = jnp.where(
            on_edge[:, None] & (at[:, None] == positions[None]), further[:, None], jnp.inf
        )
        used = (jnp.arange(orbit.ends.size) < orbit.count)[:, None]
        distance = jnp.where(used & wanted[None], jnp.fmin(turned, passed), jnp.inf)
        row, arrives = jnp.divmod(jnp.argmin(distance), 2 * n)
        rows = jnp.arange(size)
        last = jnp.where(jnp.isfinite(turns[row]), orbit.ends[row], names.extremum_x1)
        ends = jnp.where(rows < row, jnp.append(orbit.ends, names.unused), names.unused)
        ends = jnp.where(rows == row, last, ends)
        end = jnp.where(rows[:, None] <= row, 0.0, exits[row])
        entries = jnp.where(rows[:, None] <= row, jnp.append(orbit.entries, end[-1:], axis=0), end)
        durations = jnp.where(rows <= row, jnp.append(orbit.durations, 0.0), 0.0)
        codes = jnp.append(orbit.codes, orbit.codes[:1], axis=0)
        return distance[row, arrives], Loop(codes, ends, entries, durations), arrives

    own = jnp.stack([belt, n + belt])
    starts = jnp.tile(own, 2), jnp.repeat(jnp.array([False, True]), 2)
    distances, loops, arrives = each(one)(starts)
    best = jnp.argmin(distances)
    status = jnp.where(jnp.isfinite(distances[best]), Status.OK.value, Status.NOT_TOUCHED.value)
    loop = pick(loops, best)
    return loop, numbers[starts[0][best]], arrives[best], status


# --- courses --------------------------------------------------------------------------------------

#: For each of the first `EXTREMA` extrema of x1, the number of saddles to the left of it.
SaddleCourse = tuple[int, ...]


class _Courses(eqx.Module):
    """What courses are made of, for each edge and each side, [edges, sides].

    positions: of the edges, [edges]; leaves: mask of those with a saddle whose orbits are compared,
    [edges]; extrema: x1 at the ends of arcs that are extrema of x1, else NaN, [edges, sides, arcs];
    repeats: the row after which the orbit repeats, or -1; rest: x1 where it ended at rest, or NaN.
    """

    positions: Array
    leaves: Array
    extrema: Array
    repeats: Array
    rest: Array


@jit
def _all_saddles(oscs: Oscillator) -> Array:
    return eqx.filter_vmap(saddles)(oscs)


@jit
def _courses_of(oscs: Oscillator) -> _Courses:
    def at(osc):
        osc = lax.stop_gradient(osc)
        n, parts = len(osc.belts), saddles(osc)
        smooth = [(belt.velocity != 0) & ~has_jump(belt) for belt in osc.belts]
        parts = parts & jnp.all(jnp.stack(smooth))

        def one(start):
            edge, rightward = start
            orbit = _departing(osc, edge, rightward, parts[edge], ARCS)
            extrema = jnp.where(_turns_back(osc, orbit), orbit.exits[:, 0], jnp.nan)
            return extrema, orbit.repeats, place_of_rest(osc, orbit)

        starts = jnp.repeat(jnp.arange(2 * n), 2), jnp.tile(jnp.array([False, True]), 2 * n)
        found = jax.tree.map(
            lambda leaf: leaf.reshape(2 * n, 2, *leaf.shape[1:]), each(one)(starts)
        )
        return _Courses(jnp.stack(edges(osc)), parts, *found)

    return each(at)(oscs)


def courses_of(oscs: Oscillator) -> list[tuple[SaddleCourse, ...]]:
    """Courses of the orbits that leave saddles, for each oscillator of a batch.

    Saddles are in order from left to right; of each, the orbit to the left comes first.
    """
    if not np.any(_all_saddles(oscs)):
        return [()] * len(oscs.damping)
    seen = jax.tree.map(np.asarray, _courses_of(oscs))
    return [
        _courses_at(jax.tree.map(lambda leaf, lane=lane: leaf[lane], seen))
        for lane in range(len(seen.positions))
    ]


def _courses_at(seen: _Courses) -> tuple[SaddleCourse, ...]:
    rows = distinct_places(np.where(seen.leaves, seen.positions, np.nan))
    at = seen.positions[rows]
    return tuple(
        _course(at, *(one[row, side] for one in (seen.extrema, seen.repeats, seen.rest)))
        for row in rows
        for side in (0, 1)
    )


def _course(at: Any, extrema: Any, repeats: Any, rest: Any) -> SaddleCourse:
    """The course of an orbit between saddles at the places `at`."""
    known = ~np.isnan(extrema)
    letters = np.searchsorted(at, extrema[known]).tolist()
    if not np.isnan(rest):
        again = [int(np.searchsorted(at, rest))]
    elif repeats >= 0:
        again = letters[-max(int(np.sum(known[int(repeats) + 1 :])), 1) :]
    else:
        again = letters[-2:]  # not yet converged: its last extrema, on both sides
    while again and len(letters) < EXTREMA:
        letters += again
    return tuple(letters[:EXTREMA])
