"""Bifurcation points refined by Newton's method: `refine`, and the conditions that it solves.

A condition is one more equation, in one more unknown: the parameter. It is written so that the
whole system is regular at the point, which "stick duration of the cycle = 0" is not: solved for
the cycle at every parameter, the duration goes like a square root and Newton's method fails. In the
unknowns of fixed-signature shooting (see `cycles`) the same equation is harmless:

- `NonsmoothFold`, `GrazingSliding`: the arc before the stick phase meets the boundary tangentially,
  r = 0 and x2' = 0, which for a law without a jump is the very point of slip onset. That arc is
  followed backwards from the point of tangency, so trial solutions cannot overshoot. Both
  kinds are this same event. What tells them apart is the multiplier m of the cycle at the point
  with that stick arc left out. The return map has slope 0 where the
  cycle sticks and slope m where it does not: for m > 1 both its fixed points lie on one side and
  vanish together (fold); for m < 1, one lies on either side, and the cycle goes on (grazing). A
  cycle with another stick phase has m = 0. Where the law jumps, static > mu(0+), the stick phase
  that begins at the tangency lasts, and without it the orbit is another one: the return map jumps,
  m = inf, and the cycle ends there.
- `CrossingSliding`: the cycle arrives at a boundary r_k = 0 just at an end of the stretch of it on
  which the mass sticks. To one side of it the mass sticks, to the other the boundary is crossed:
  a crossing-sliding bifurcation (M. di Bernardo, C. Budd, A. Champneys, P. Kowalczyk,
  Piecewise-smooth Dynamical Systems, 2008). Linear in the unknowns, x1 = rest +- capacity.
- `SlidingExchange`: nu_i = nu_j, and a cycle that sticks to i or j. The friction of each mode keeps
  its sign, so the cycle with its signature fixed goes smoothly through the point.
- `SuddenSliding`: nu_k = 0, with the mass at rest on the belt, x2' = x2 = 0: an equilibrium lies on
  the boundary. No cycle can be an unknown here: as nu_k goes to zero the stick phase lasts ever
  longer, the slip arc takes ever longer to leave the equilibrium, and in the limit there is none.
- `BeltAtRest`: the same, if no cycle sticks to the belt: an equilibrium jumps.
- `Hopf`: trace zero at a fixed point (its determinant is always one).
- `FoldOfCycles`: the multiplier of a cycle that does not stick is one. There the equations of the
  cycle alone are singular; with this one, and the parameter, they are not. (A cycle that sticks
  has the multiplier zero and takes part in nonsmooth folds only.)
- `GrazingEdge`, `CornerCollision`: an arc of a cycle ends on a contact edge and in something else
  at once. With an extremum of x1, the orbit is tangent to the edge, x2 = 0; with a boundary r_k = 0
  or slip onset, it runs into the corner of that and the edge. To one side of the point the edge
  ends the arc, to the other that does: the equation is that the other's guard vanishes, which is
  linear in the unknowns. A cycle that passes the edge and turns back soon after has that
  excursion left out: with it the equation is of second order in the velocity at the edge.
- `BoundaryEquilibrium`: at rest on an edge, the force on one of its sides is zero, or as large as
  belts at rest there can hold: a fixed point, or the end of a segment, comes to lie on the edge.
- `PseudoHopf`: at a pseudo-focus the leading term by which loops grow or shrink is zero.
"""

import abc
import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import is_concrete, number, require
from ..cycles.cycle import Cycle, cycle_of, separating_loop
from ..cycles.orbits import Orbit, first_loop, follow, last_loop, loop_of
from ..cycles.settling import AT_REST
from ..cycles.shooting import (
    SIZES,
    Chain,
    Ends,
    Loop,
    closure,
    end_guard,
    following_codes,
    jacobian,
    meshed,
    multiplier_and_slopes,
    residual,
    residual_and_blocks,
    trace_of,
)
from ..model.equilibria import Equilibria, EquilibriumKind, candidates
from ..model.modes import (
    STUCK,
    Mode,
    boundary_guards,
    capacity,
    contact,
    edge_guards,
    edges,
    field_at_rest,
    mode_acceleration,
    mode_of,
    onset_position,
    select,
    stick_limit,
)
from ..model.oscillator import Oscillator, check_oscillator
from ..model.parameters import leaf_index, parameter, vary
from ..numerics.compiling import each, jit
from ..numerics.newton import NEWTON_STEPS, newton
from ..results import Status, describe

#: Arcs for which the orbit from slip onset is followed in search of the signature.
HINT_BUDGET = 32
#: Arcs for which each orbit is followed that may lead to a cycle.
FOLLOWED = 96
#: How often an orbit is followed, from what it approaches, or on, until it has settled.
ATTEMPTS = 6
#: Where some of them start to the right of an equilibrium, so far from it.
DISTANCES = (0.02, 0.3, 3.0)


class AbstractCondition(eqx.Module):
    """What is to happen at a bifurcation point."""


class Hopf(AbstractCondition):
    """A fixed point changes its stability: eqs. (27), (28) of the paper, for any friction law."""


class _BeltCondition(AbstractCondition):
    belt: int = eqx.field(static=True)


class NonsmoothFold(_BeltCondition):
    """The stick phase on a belt shrinks to a point and the cycle vanishes with an unstable one."""


class GrazingSliding(_BeltCondition):
    """The cycle touches the boundary of a belt and begins to stick to it there, but goes on."""


class CrossingSliding(_BeltCondition):
    """The cycle crosses the boundary of a belt, and begins to stick to it where it did.

    It arrives at one end of where the mass sticks: that of slip onset, at which a stick phase
    begins with no duration, or the other one, from which it then sticks all the way.
    """


class SuddenSliding(_BeltCondition):
    """A belt comes to rest: the time that the mass sticks to it in each loop goes to infinity."""


class BeltAtRest(_BeltCondition):
    """A belt comes to rest where the mass is at rest on it, too, and no cycle sticks to it.

    On the other side its friction pulls the other way: the equilibrium jumps, or there is none.
    """


class FoldOfCycles(AbstractCondition):
    """Two cycles that do not stick, a stable and an unstable one, meet and vanish.

    Near a degenerate Hopf point, where both shrink to the equilibrium, small ones are not found. In
    the case of the tests, those with x1_max - x1_min above 0.006 are, from guesses some two times
    as far from the point as that is from the Hopf point.
    """


class SlidingExchange(AbstractCondition):
    """Two belts run at one velocity: where both touch, the cycle changes from one to the other.

    With laws that jump, or belts that hold differently, there may be another cycle beyond, or none.
    """

    belts: tuple[int, int] = eqx.field(static=True)


class GrazingEdge(_BeltCondition):
    """The cycle is tangent to a contact edge of a belt: a loop, an extremum of x1, touches it.

    Beyond, the cycle passes the edge; or there is none, where the edge pushes away to both sides.
    There, too, a cycle that passes the edge ends, with the velocity zero on it.
    unstable: of the cycle from `unstable_cycle`, not of an attracting one.
    """

    unstable: bool = eqx.field(static=True, default=False)


class CornerCollision(_BeltCondition):
    """The cycle runs into a corner of a contact edge of a belt and a boundary r_k = 0.

    It begins, or ceases, to stick to a belt there, or crosses its boundary: beyond, these come in
    another order, or another event comes instead; or, like at a nonsmooth fold, there is no cycle.
    A guess has to lie on a side where there is a cycle; `scan` tries both.
    """


class BoundaryEquilibrium(_BeltCondition):
    """A fixed point, or the end of a segment, lies on a contact edge of a belt."""


class PseudoHopf(_BeltCondition):
    """The pseudo-focus at a contact edge of a belt changes its stability."""


class Unexplained(AbstractCondition):
    """What the oscillator does changes, and no other condition explains it; from `scan` only."""


class BifurcationPoint(eqx.Module):
    """What `refine` returns.

    condition: the condition that holds there; value: of the parameter; residual: largest error in
    the defining equations; iterations: Newton steps; steps: how far each went, NaN padded; error: a
    bound on |value - exact value|, from the same equations with every integration step halved, and
    rounding; oscillator: at the point;
    cycle: at the point, with a status that says why where there is none (at a Hopf point it has
    shrunk to the equilibrium, at `SuddenSliding` its period is infinite); multiplier: of the cycle
    on the side where it does not stick to the belt, for `NonsmoothFold` and `GrazingSliding`, else
    NaN; status: a `Status` code. Where it is not OK the value is NaN.
    """

    condition: AbstractCondition
    value: Array
    residual: Array
    iterations: Array
    steps: Array
    error: Array
    multiplier: Array
    oscillator: Oscillator
    cycle: Cycle
    status: Array

    @property
    def kind(self) -> str:
        """Name of the condition."""
        return type(self.condition).__name__

    def __repr__(self) -> str:
        if not is_concrete(self.value) or self.value.ndim:
            return f"BifurcationPoint({self.condition!r}, value={self.value.shape})"
        if int(self.status) != Status.OK:
            name = Status(int(self.status)).name
            return f"BifurcationPoint({self.condition!r}, {name}: {describe(self.status)})"
        return (
            f"BifurcationPoint({self.condition!r}, value {number(self.value)}, "
            f"residual {float(self.residual):.1e}, {int(self.iterations)} iterations, "
            f"error < {float(self.error):.1e})"
        )


def refine(
    condition: AbstractCondition,
    osc: Oscillator,
    *,
    where: Callable[[Oscillator], Any],
    max_arcs: int | None = None,
) -> BifurcationPoint:
    """The bifurcation point near an oscillator, by Newton's method with exact derivatives.

    condition: `Hopf()`, `NonsmoothFold(belt)`, `GrazingSliding(belt)`, `SlidingExchange(belts)`,
    `CrossingSliding(belt)`, `SuddenSliding(belt)`, `BeltAtRest(belt)`, `FoldOfCycles()`, or of a
    belt with a contact edge `GrazingEdge(belt)`, `CornerCollision(belt)`,
    `BoundaryEquilibrium(belt)` or `PseudoHopf(belt)`. osc: a rough guess, on either side of the
    point. where: selects the parameter that is varied, such as
    `lambda osc: osc.belts[0].velocity`. max_arcs: room for the arcs of one loop (default
    16; where edges are passed 32).

    Works under `jax.vmap` (a thousand points of a curve in one call) and `jax.jit`; `value` and
    `cycle` are differentiable with respect to the other parameters. A guess that leads to no such
    point gives a status that says why, and NaN. `ValueError` names an impossible argument.
    """
    require(isinstance(condition, AbstractCondition), "condition", "such as jb.Hopf()", condition)
    check_oscillator(osc)
    n = len(osc.belts)
    belts = condition.belts if isinstance(condition, SlidingExchange) else (0, 0)
    belts = (condition.belt,) * 2 if isinstance(condition, _BeltCondition) else belts
    for belt in belts:
        require(isinstance(belt, int) and 0 <= belt < n, "belt", f"0 to {n - 1}", repr(belt))
    solve = solver_of(condition)
    at_an_edge = solve in (at_edge, at_edge_unstable, at_boundary_equilibrium, at_pseudo_hopf)
    if at_an_edge and is_concrete(osc):
        ends = [osc.belts[belts[0]].lower, osc.belts[belts[0]].upper]
        require(np.any(np.isfinite(ends)), "belt", "one with a finite edge", repr(belts[0]))
    size = max_arcs or room_for(solve)
    # Parameter and belts are data: the same programs serve all of them.
    data = leaf_index(osc, where), belts, _SIDES.get(type(condition), 0.0)
    index, pair, wanted = (jnp.asarray(np.array(one)) for one in data)
    return replace(solve(osc, index, pair, wanted, size), condition=condition)


def room_for(solve: Callable) -> int:
    """Room for the arcs of one loop: passing edges takes more of them."""
    return SIZES[1] if solve in (at_edge, at_crossing) else SIZES[0]


# --- systems of a cycle and one condition ---------------------------------------------------------

# 3N + 1 equations: those of the cycle, and a condition. Unknown are the cycle and a parameter; or
# two parameters, along a curve.


class System(eqx.Module):
    """A fixed signature and a condition."""

    chain: eqx.AbstractVar[Chain]

    @abc.abstractmethod
    def condition(self, osc: Oscillator, z: Array, miss: Array) -> Array:
        """What vanishes there; miss: that of the tangent arcs, see `cycles.residual`."""

    def residual(self, osc: Oscillator, z: Array) -> Array:
        """The 3N + 1 equations at the unknowns z of the cycle, [N, 3]."""
        value, miss = residual(osc, self.chain, z)
        return jnp.append(value.reshape(-1), self.condition(osc, z, miss))

    def linearized(
        self, osc_of: Callable[[Array], Oscillator], z: Array, p: Array
    ) -> tuple[Array, Array]:
        """The residual at the parameters p, [k], and its Jacobian with respect to (z, p)."""
        osc, along = osc_of(p), jax.jacfwd(osc_of)(p)
        value, miss, blocks = residual_and_blocks(osc, along, self.chain, z)
        of_state, of_parameter = blocks[:, :, :3], blocks[:, :, 3:]
        last, (by_z, by_p, by_miss) = self.condition_and_slopes(osc_of, z, p, miss)
        by_parameter = of_parameter[:, :3].reshape(-1, p.size)
        rows = jnp.concatenate([jacobian(of_state[:, :3]), by_parameter], axis=1)
        row = jnp.append(
            (by_z + by_miss * of_state[:, 3]).reshape(-1),
            by_p + by_miss * jnp.sum(of_parameter[:, 3], axis=0),
        )
        return jnp.append(value.reshape(-1), last), jnp.concatenate([rows, row[None]])

    def condition_and_slopes(self, osc_of: Callable[[Array], Oscillator], z, p: Array, miss):
        """The condition at the parameters p, and its derivatives with respect to z, p and miss."""

        def condition(z, p, miss):
            return self.condition(osc_of(p), z, miss)

        return jax.value_and_grad(condition, (0, 1, 2))(z, p, miss)

    @property
    def ordinary(self) -> Chain:
        """The chain with every tangency as an ordinary arrival at the boundary."""
        tangent = Ends(self.chain.codes.shape[-1]).tangent
        ends = jnp.where(self.chain.ends >= tangent, self.chain.ends - tangent, self.chain.ends)
        return Chain(self.chain.codes, ends, self.chain.mesh)


class Encounter(System):
    """Two belts run at one velocity; if they are the same, an arc is tangent to its boundary."""

    chain: Chain
    belts: Array

    def condition(self, osc: Oscillator, z: Array, miss: Array) -> Array:
        difference = _velocity(osc, self.belts[0]) - _velocity(osc, self.belts[1])
        return jnp.where(self.belts[0] != self.belts[1], difference, miss)


@eqx.filter_custom_jvp
def _solve_system(osc, index, system, z0, p0):
    """Unknowns, the parameter, the steps of Newton's method and the matrix of the last one."""

    def linearized(unknowns):
        return system.linearized(functools.partial(vary, osc, index), *unknowns)

    solved = newton(linearized, (z0, p0))
    return (*solved.z, solved.lengths, solved.matrix)


@_solve_system.def_jvp
def _(primals, tangents):
    osc, index, system, z0, p0 = primals
    z, p, steps, matrix = _solve_system(osc, index, system, z0, p0)
    moved, fixed = eqx.partition(
        osc, jax.tree.map(lambda t: t is not None, tangents[0], is_leaf=lambda t: t is None)
    )
    _, shift = jax.jvp(
        lambda moved: system.residual(vary(eqx.combine(moved, fixed), index, p), z),
        (moved,),
        (tangents[0],),
    )
    _, slopes = system.linearized(functools.partial(vary, osc, index), z, p)
    change = jnp.linalg.solve(slopes, -shift)
    return (z, p, steps, matrix), (change[:-1].reshape(z.shape), change[-1:], None, None)


def _accuracy(osc: Oscillator, system: System, z: Array, matrix: Array):
    """The residual, and a bound on the error of p: what the residual with halved steps and rounding
    do to it."""
    mesh = system.chain.mesh
    # The steps as they are, and halved; padded by steps of length zero to one shape.
    meshes = jnp.stack(
        [jnp.concatenate([mesh, jnp.zeros_like(mesh)], axis=1), jnp.repeat(0.5 * mesh, 2, axis=1)]
    )

    def value(mesh):
        return eqx.tree_at(lambda s: s.chain.mesh, system, mesh).residual(osc, z)

    values = lax.map(value, meshes)
    weights = jnp.linalg.solve(matrix.T, jnp.zeros(values.shape[1]).at[-1].set(1.0))
    rounding = 1e-15 * (1 + jnp.max(jnp.abs(z))) * jnp.sum(jnp.abs(weights))
    return jnp.max(jnp.abs(values[0])), 2 * jnp.abs(jnp.sum(weights * values[1])) + rounding


@jit
def _solved_point(osc, index, system, z0, status, judge) -> BifurcationPoint:
    """Solve; judge(osc, z, cycle, slope), slope the cycle's multiplier with stick phases left out,
    gives the status and the multiplier to be told. It carries its data with it, as `eqx.Partial`:
    one program serves a kind of system."""
    p0 = lax.stop_gradient(parameter(osc, index)[None])
    # Without a guess Newton's method ends at once.
    z0 = jnp.where(status == Status.OK, z0, jnp.nan)
    z, p, steps, matrix = _solve_system(osc, index, system, z0, p0)
    iterations = jnp.sum(~jnp.isnan(steps))
    at_point = vary(osc, index, p)
    # By the last steps: the residual costs an integration more, and who asks for it gets it.
    last, before = steps[jnp.maximum(iterations - 1, 0)], steps[jnp.maximum(iterations - 2, 0)]
    converged = (status != Status.OK) | (last * jnp.minimum(last / before, 1.0) < 1e-9)
    status = jnp.where(converged, status, Status.NO_CONVERGENCE.value)
    size, error = _accuracy(*lax.stop_gradient((at_point, system, z, matrix)))
    cycle, slope = cycle_of(at_point, system.ordinary, z, iterations, status, size)
    status, multiplier = judge(at_point, z, cycle, slope)
    known = functools.partial(jnp.where, status == Status.OK)
    return BifurcationPoint(
        condition=AbstractCondition(),
        value=known(p[0], jnp.nan),
        residual=known(size, jnp.nan),
        iterations=iterations,
        steps=steps,
        error=known(error, jnp.nan),
        multiplier=known(multiplier, jnp.nan),
        oscillator=vary(osc, index, known(p, jnp.nan)),
        cycle=cycle,
        status=status,
    )


# --- touching a boundary, and two boundaries that change places -----------------------------------


def _velocity(osc: Oscillator, belt: int | Array) -> Array:
    return jnp.stack([one.velocity for one in osc.belts])[belt]


def before_stick_ends(osc: Oscillator, belt: int | Array) -> Array:
    """States stuck to a belt where stick phases end, one for each zone between contact edges.

    Shortly before slip onset; or, where the zone ends first, on the edge. NaN where neither is, or
    the belt does not touch. [zones, 2].
    """
    v = _velocity(osc, belt) / osc.omega
    positions, end = jnp.sort(jnp.stack(edges(osc))), jnp.full(1, jnp.inf)
    lower, upper = jnp.concatenate([-end, positions]), jnp.concatenate([positions, end])
    mode = contact(osc, lower, v, rightward=True)
    onset, held = onset_position(osc, mode), capacity(osc, mode)
    before, ahead = select(v > 0, (lower, upper), (upper, lower))
    slips = (lower < onset) & (onset < upper)
    # It holds between onset - 2 sgn(v) held and onset.
    meets = jnp.isfinite(ahead) & ~slips & (jnp.abs(onset - held * jnp.sign(v) - ahead) <= held)
    near = jnp.minimum(0.01 * held, 0.5 * jnp.abs(onset - before))
    exists = (jnp.stack(mode.codes)[belt] == STUCK) & (lower < upper)
    x1 = jnp.where(slips, onset - near * jnp.sign(v), jnp.where(meets, ahead, jnp.nan))
    states = jnp.stack([x1, jnp.full_like(x1, v)], axis=1)
    return jnp.where(exists[:, None], states, jnp.nan)


def starts(osc: Oscillator, rests: Equilibria) -> Array:
    """Where the orbits start that find the cycles, [starts, 2].

    Where stick phases end, and at several distances from an equilibrium. NaN: no such start.
    """
    exists = rests.kind > 0
    repels = exists & ~rests.stable
    row = jnp.where(jnp.any(repels), jnp.argmax(repels), jnp.maximum(jnp.sum(exists) - 1, 0))
    centre = jnp.where(jnp.any(exists), rests.x1[row], 0.0)
    ends = [before_stick_ends(osc, belt) for belt in range(len(osc.belts))]
    others = [jnp.stack([centre + distance, jnp.zeros(())])[None] for distance in DISTANCES]
    return jnp.concatenate([*ends, *others])


def approach(osc: Oscillator, rests: Equilibria, start: Array) -> Orbit:
    """The orbit from a start until it settles, with the status OK where that is on a cycle.

    If it has not settled, it is followed on, from what it approaches where that can be told: the
    differences of the last three tops form a geometric sequence, so its limit is known (Aitken). If
    that is much nearer to the last top than this is to any equilibrium, the orbit from there is
    followed next, for on the way there may be a boundary. What even then has not settled counts as
    settled, its last loop as the one that repeats.
    """

    def attempt(state):
        number, start, *_ = state
        orbit = follow(osc, start, FOLLOWED)
        rows = jnp.arange(orbit.tops.size)
        last = jnp.sort(jnp.where(jnp.isnan(orbit.tops), -1, rows))[-3:]
        tops = orbit.tops[last]
        before, after = tops[1] - tops[0], tops[2] - tops[1]
        ratio = after / jnp.where(before == 0, 1.0, before)
        limit = tops[2] + after * ratio / (1 - ratio)
        distance = jnp.min(jnp.where(rests.kind > 0, jnp.abs(tops[2] - rests.x1), jnp.inf))
        away = jnp.abs(limit - tops[2]) < 0.2 * distance
        pending = orbit.status == Status.NOT_SETTLED
        is_cycle = pending & (last[0] >= 0) & (before != 0) & (jnp.abs(ratio) < 1) & away
        start = jnp.where(is_cycle, jnp.stack([limit, jnp.zeros(())]), orbit.y)
        return number + 1, start, orbit, last, pending, is_cycle

    def unsettled(state):
        number, *_, pending, _ = state
        return (number == 0) | (pending & (number < ATTEMPTS))

    none = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype),
        jax.eval_shape(attempt, (jnp.asarray(0), start)),
    )
    first = (jnp.asarray(0), start, *none[2:])
    _, _, orbit, last, _, is_cycle = lax.while_loop(unsettled, attempt, first)
    ended = eqx.tree_at(
        lambda o: (o.repeats, o.count, o.status),
        orbit,
        (last[1], last[2] + 1, jnp.asarray(Status.OK.value)),
    )
    return jax.tree.map(lambda a, b: jnp.where(is_cycle, a, b), ended, orbit)


@jit
def settled_loops(osc: Oscillator, rests: Equilibria, size: int) -> tuple[Loop, Array]:
    """The loops that the orbits from `starts` repeat, in `size` arcs each, and their status."""

    def run(start):
        orbit = approach(osc, rests, start)
        _, count = last_loop(orbit)
        fits = (orbit.status != Status.OK) | (count <= size)
        status = jnp.where(fits, orbit.status, Status.TOO_MANY_ARCS.value)
        return loop_of(orbit, size, len(osc.belts)), status

    osc, rests = lax.stop_gradient((osc, rests))
    return each(run)(starts(osc, rests))


@jit
def _nearest(osc: Oscillator, loops: Loop, status: Array, distance: Callable) -> tuple[Loop, Array]:
    """Of the loops that were found the one for which distance(osc, loop) is least, and a status."""
    distances = jax.vmap(functools.partial(distance, lax.stop_gradient(osc)))(loops)
    distances = jnp.where(status == Status.OK, distances, jnp.inf)
    at, large = jnp.argmin(distances), jnp.any(status == Status.TOO_MANY_ARCS)
    none = jnp.where(large, Status.TOO_MANY_ARCS.value, Status.NOT_TOUCHED.value)
    found = jnp.isfinite(distances[at])
    return jax.tree.map(lambda x: x[at], loops), jnp.where(found, Status.OK.value, none)


@jit
def _orbit_after_stick(osc: Oscillator, belts: Array) -> tuple[Oscillator, Array, Orbit]:
    """The orbit from where a stick phase on the first of the belts ends, its start, the oscillator.

    Of several the one that comes back most nearly tangent to its boundary to stick there; if none
    does, the one that comes nearest to it. The oscillator is the one given but for the velocity of
    that belt: where it is at rest, no orbit leaves.
    """
    velocities = [
        jnp.where((belts[0] == i) & (one.velocity == 0), 1e-2, one.velocity)
        for i, one in enumerate(osc.belts)
    ]
    moving = eqx.tree_at(lambda o: [one.velocity for one in o.belts], osc, velocities)
    moving = lax.stop_gradient(moving)
    n = len(osc.belts)
    velocity, extremum_x2 = _velocity(moving, belts[0]), Ends(n).extremum_x2
    states = before_stick_ends(moving, belts[0])
    exists = jnp.isfinite(states[:, 0])
    states = states[jnp.argsort(~exists)]

    def attempt(tried):
        number, best, kept = tried
        orbit = follow(moving, states[number], HINT_BUDGET)
        _, push = least_push(moving, loop_of(orbit, HINT_BUDGET, n), belts[0])
        x2 = jnp.roll(orbit.entries[:, 1], -1).at[orbit.count - 1].set(orbit.y[1])
        loops = (orbit.ends == extremum_x2) & (x2 * velocity > 0) & (jnp.arange(HINT_BUDGET) > 0)
        gap = jnp.min(jnp.where(loops, jnp.abs(velocity - osc.omega * x2), jnp.inf))
        sticks = (orbit.status == Status.OK) & jnp.isfinite(push)
        size = jnp.where(sticks, push, 1e6 + gap)
        better = (number == 0) | (size < best)
        new = (size, (states[number], orbit))
        best, kept = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, (best, kept))
        return number + 1, best, kept

    empty = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype),
        jax.eval_shape(lambda y: (y, follow(moving, y, HINT_BUDGET)), states[0]),
    )
    none = jnp.asarray(0), jnp.asarray(jnp.inf), empty
    several = jnp.maximum(jnp.sum(exists), 1)
    _, _, (start, orbit) = lax.while_loop(lambda tried: tried[0] < several, attempt, none)
    return moving, start, orbit


def at_tangency(osc: Oscillator, index: int | Array, belts: Array, wanted: Array, size: int):
    """A cycle tangent to the boundary of the first belt.

    wanted: 1 a fold, -1 grazing, 0 either; its multiplier tells which it is.
    """
    _, _, orbit = _orbit_after_stick(osc, belts)
    return _solved_point(osc, index, *_touching(osc, orbit, belts, wanted, size))


@jit
def _touching(osc: Oscillator, orbit: Orbit, belts: Array, wanted: Array, size: int):
    """The system of `at_tangency` with a guess of its unknowns, a status, and the judge."""
    belt = belts[0]
    n = len(osc.belts)
    names = Ends(n)
    still = lax.stop_gradient(osc)
    velocity = _velocity(still, belt)
    repeated = orbit.status == Status.OK

    # Either a cycle was found, or the orbit left the boundary for good: then its first loop from
    # slip onset to the next extremum of x2 on that side, closed there, is nearly the cycle.
    exits = jnp.roll(orbit.entries, -1, axis=0).at[orbit.count - 1].set(orbit.y)
    rows = jnp.arange(HINT_BUDGET)
    near = (orbit.ends == names.extremum_x2) & (exits[:, 1] * jnp.sign(velocity) > 0) & (rows > 0)
    last = jnp.argmax(near)
    first_loop = eqx.tree_at(lambda o: (o.repeats, o.count), orbit, (jnp.asarray(0), last + 1))
    returns = jnp.any(near) & ~jnp.any(
        (rows > 0) & (rows <= last) & jnp.any(orbit.codes == 0, axis=-1)
    )
    orbit = jax.tree.map(lambda a, b: jnp.where(repeated, a, b), orbit, first_loop)
    _, count = last_loop(orbit)
    status = jnp.where(repeated | returns, Status.OK.value, Status.NOT_TOUCHED.value)
    # It may need one arc more.
    status = jnp.where((status == Status.OK) & (count >= size), Status.TOO_MANY_ARCS.value, status)
    return _tangent(still, belts, wanted, loop_of(orbit, size, n), status)


def tangency_near(osc: Oscillator, index: int | Array, belts: Array, loop: Loop, status: Array):
    """The cycle near a loop that is tangent to the boundary of a belt; status: of the loop."""
    return _solved_point(osc, index, *_tangent_cycle(osc, belts, loop, status))


@jit
def _tangent_cycle(osc: Oscillator, belts: Array, loop: Loop, status: Array):
    fits = jnp.sum(loop.used) < loop.ends.size
    status = jnp.where(fits | (status != Status.OK), status, Status.TOO_MANY_ARCS.value)
    return _tangent(lax.stop_gradient(osc), belts, jnp.zeros(()), loop, status)


def _tangent(osc: Oscillator, belts: Array, wanted: Array, loop: Loop, status: Array):
    """The system of a tangency with a guess of its unknowns, a status, and the judge."""
    belt = belts[0]
    loop, row, found = _with_stick(osc, loop, belt)
    chain, z = meshed(osc, loop)
    status = jnp.where(found | (status != Status.OK), status, Status.NOT_TOUCHED.value)
    status = jnp.where(_velocity(osc, belt) == 0, Status.STUCK_FOREVER.value, status)
    # The arc before the stick arc is the one that becomes tangent.
    before = (row - 1) % jnp.maximum(jnp.sum(chain.used), 1)
    ends = chain.ends.at[before].set(Ends(len(osc.belts)).tangent + belt)
    system = Encounter(Chain(chain.codes, ends, chain.mesh), jnp.stack([belt, belt]))
    return system, z, status, eqx.Partial(_judge_encounter, belts, wanted, row)


def at_exchange(osc: Oscillator, index: int | Array, belts: Array, wanted, size: int):
    """A cycle that sticks to one of two belts which run at one velocity, and touches both."""
    _, _, orbit = _orbit_after_stick(osc, belts)
    return exchange_near(osc, index, belts, *_repeated_loop(orbit, size, len(osc.belts)))


@jit
def _repeated_loop(orbit: Orbit, size: int, n: int) -> tuple[Loop, Array]:
    """The loop that an orbit repeats, and a status."""
    _, count = last_loop(orbit)
    status = jnp.where(count <= size, Status.OK.value, Status.TOO_MANY_ARCS.value)
    status = jnp.where(orbit.status == Status.OK, status, Status.NOT_TOUCHED.value)
    return loop_of(orbit, size, n), status


def exchange_near(osc: Oscillator, index: int | Array, belts: Array, loop: Loop, status: Array):
    """The exchange of two belts by the cycle near a loop; status: of the loop."""
    return _solved_point(osc, index, *_exchanging(osc, belts, loop, status))


@jit
def _exchanging(osc: Oscillator, belts: Array, loop: Loop, status: Array):
    """The system of `exchange_near` with a guess of its unknowns, a status, and the judge."""
    chain, z = meshed(lax.stop_gradient(osc), loop)
    sticks = jnp.any(loop.codes[:, belts] == 0, axis=-1)
    exchanges = jnp.any(loop.used & sticks & _both_touch(loop.codes, belts))
    meant = (status != Status.OK) | exchanges
    status = jnp.where(meant, status, Status.NOT_TOUCHED.value)
    either, row = jnp.zeros(()), jnp.asarray(0)
    return Encounter(chain, belts), z, status, eqx.Partial(_judge_encounter, belts, either, row)


def _both_touch(codes: Array, belts: Array) -> Array:
    """Whether two belts both touch, by the contact codes of each arc."""
    return jnp.all(jnp.abs(codes[:, belts]) < 1.5, axis=-1)


def _judge_encounter(belts, wanted, row, osc: Oscillator, z, cycle: Cycle, slope):
    belt, other = belts[0], belts[1]
    exchange, chain = belt != other, cycle.chain
    stuck = jnp.any(chain.codes == 0, axis=-1) & chain.used
    phase = stick_phase_from(osc, chain, row)
    slope = jnp.where(z[row, 2] > 1e-6, jnp.inf, slope)  # a square root of rounding is no phase
    slope = jnp.where(jnp.any(stuck & ~phase), 0.0, slope)
    # A tangency is of one kind.
    is_wanted = (wanted == 0) | (wanted * (slope - 1) >= 0)  # the slope may be infinite
    fits = exchange | is_wanted
    slope = jnp.where(exchange, jnp.nan, slope)
    other_kind = (cycle.status == Status.OK) & ~fits
    return jnp.where(other_kind, Status.OTHER_KIND.value, cycle.status), slope


def stick_phase_from(osc: Oscillator, chain: Chain, row: Array) -> Array:
    """A row, and the arcs after it in the stick phase that it begins: one that passes edges."""
    stuck = chain.used & jnp.any(chain.codes == 0, axis=-1)
    rows = jnp.arange(stuck.size)
    before = (rows - 1) % jnp.maximum(jnp.sum(chain.used), 1)
    phase, goes_on = rows == row, stuck & stuck[before]
    for _ in range(2 * len(osc.belts)):
        phase = phase | (goes_on & phase[before])
    return phase


def least_push(osc: Oscillator, loop: Loop, belt: Array) -> tuple[Array, Array]:
    """The arc that arrives to stick to a belt with the least x2': its row, and the size of that.

    From the side on which that vanishes where the orbit is tangent to the boundary; inf: none.
    """
    side = jnp.sign(_velocity(osc, belt))
    arrives = loop.used & (following_codes(loop)[:, belt] == 0) & (loop.codes[:, belt] == side)

    def push(codes, y):
        return jnp.abs(mode_acceleration(osc, mode_of(codes), y[0], y[1]))

    pushes = jnp.where(arrives, jax.vmap(push)(loop.codes, loop.exits), jnp.inf)
    return jnp.argmin(pushes), jnp.min(pushes)


def _with_stick(osc: Oscillator, loop: Loop, belt: Array) -> tuple[Loop, Array, Array]:
    """A loop with a stick arc on the belt, its row, whether there is one.

    Its own that begins most nearly by a tangency, or one of duration zero where x2 comes closest to
    the boundary from inside.
    """
    velocity = _velocity(osc, belt)
    rows = jnp.arange(loop.ends.size)
    names = Ends(len(osc.belts))
    arrival, push = least_push(osc, loop, belt)
    has_own = jnp.isfinite(push)
    own = (arrival + 1) % jnp.maximum(jnp.sum(loop.used), 1)

    following = loop.exits
    loops = loop.used & (loop.ends == names.extremum_x2)
    loops = loops & (loop.codes[:, belt] == jnp.sign(velocity))
    loops = loops & (following[:, 1] * jnp.sign(velocity) > 0)
    distance = jnp.abs(velocity - osc.omega * following[:, 1])
    at = jnp.argmin(jnp.where(loops, distance, jnp.inf))

    def inserted(array, new):
        shifted = jnp.roll(array, 1, axis=0)
        after = (rows > at + 1).reshape(-1, *[1] * (array.ndim - 1))
        return jnp.where(after, shifted, array).at[at + 1].set(new)

    # Where all rows are in use the last one is shifted out; the caller knows.
    new = Loop(
        codes=inserted(loop.codes, loop.codes[at].at[belt].set(STUCK)),
        ends=inserted(loop.ends.at[at].set(belt), jnp.asarray(names.onset)),
        entries=inserted(loop.entries, jnp.stack([following[at, 0], velocity / osc.omega])),
        durations=inserted(loop.durations, jnp.zeros(())),
    )
    loop = jax.tree.map(lambda a, b: jnp.where(has_own, a, b), loop, new)
    return loop, jnp.where(has_own, own, at + 1), has_own | jnp.any(loops)


# --- crossing a boundary, or sticking to it -------------------------------------------------------


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
    loop, status = _nearest(osc, *settled_loops(osc, candidates(osc), size), distance)
    return crossing_near(osc, index, belts, loop, status)


def _distance_to_limit(belts, osc: Oscillator, loop: Loop) -> Array:
    return arrival_near_limit(osc, loop, belts[0]).distance


def crossing_near(osc: Oscillator, index: int | Array, belts: Array, loop: Loop, status: Array):
    """The cycle near a loop that arrives at such an end; status: of the loop."""
    return _solved_point(osc, index, *_arriving(osc, belts, loop, status))


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
    shorter = _without(loop, near.row, jnp.asarray(2))
    loop, row = jax.tree.map(lambda a, b: jnp.where(returns, a, b), shorter, (loop, near.row))
    chain, z = meshed(still, loop)
    return StickLimit(chain, row, near.codes, near.side), z, status, eqx.Partial(_judge_arrival)


def _judge_arrival(osc: Oscillator, z, cycle: Cycle, slope):
    return cycle.status, jnp.asarray(jnp.nan)


# --- touching a contact edge ----------------------------------------------------------------------


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
    without, last = _without(loop, before, (after - before) % count)
    without = eqx.tree_at(lambda t: t.ends, without, without.ends.at[last].set(names.extremum_x1))
    loop = jax.tree.map(lambda a, b: jnp.where(is_excursion, a, b), without, loop)
    return loop, jnp.where(is_excursion, last, row)


def _without(loop: Loop, row: Array, removed: Array) -> tuple[Loop, Array]:
    """The loop without so many arcs after a row; and that row, which is its last one then."""
    rows, count = jnp.arange(loop.ends.size), jnp.maximum(jnp.sum(loop.used), 1)
    left, first = count - removed, row + removed + 1
    source = jnp.where(rows < left, first + rows, first) % count
    ends = jnp.where(rows < left, loop.ends[source], Ends(loop.codes.shape[-1]).unused)
    durations = jnp.where(rows < left, loop.durations[source], 0.0)
    return Loop(loop.codes[source], ends, loop.entries[source], durations), left - 1


def at_edge(osc: Oscillator, index: int | Array, belts: Array, wanted: Array, size: int):
    """An attracting cycle of which an arc ends on an edge of the first belt, not by that edge.

    wanted: 1 a loop ends it (grazing), -1 a boundary or slip onset (a corner), 0 either. Of all
    these cycles that which comes nearest to this is taken.
    """
    distance = eqx.Partial(_distance_to_edge, belts, wanted)
    loop, status = _nearest(osc, *settled_loops(osc, candidates(osc), size), distance)
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
    return _solved_point(osc, index, *_touching_edge(osc, belts, wanted, loop, status, unstable))


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


# --- the fold of cycles ---------------------------------------------------------------------------

#: Starts of which the first loops are compared.
STARTS = 48


class UnitMultiplier(System):
    """A cycle with multiplier one."""

    chain: Chain

    def condition(self, osc: Oscillator, z: Array, miss: Array) -> Array:
        return closure(osc, self.chain, z)[1] - 1

    def condition_and_slopes(self, osc_of: Callable[[Array], Oscillator], z, p: Array, miss):
        along = jax.jacfwd(osc_of)(p)
        product, by_z, by_p = multiplier_and_slopes(osc_of(p), along, self.chain, z)
        return product - 1, (by_z, by_p, jnp.zeros_like(miss))


def at_fold_of_cycles(osc: Oscillator, index: int | Array, belts, wanted, size) -> BifurcationPoint:
    """Two cycles meet where a loop neither grows nor shrinks, and neither do its neighbours.

    So the guess is the first loop whose growth is extremal among its neighbours'; of several the
    one that closes best. Near a fixed point with eigenvalues rate +- i frequency the growth tends
    to 2 pi rate/frequency, and it has an extremum there that is no more than an effect of where
    loops begin: it differs from that limit by a term of second order in the rate.
    """
    return fold_near(osc, index, *_extremal_loop(osc, candidates(osc), size))


@jit
def _extremal_loop(osc: Oscillator, rests: Equilibria, size: int):
    """The loop of `at_fold_of_cycles`, and a status."""
    still, rests = lax.stop_gradient((osc, rests))
    eligible = (rests.kind != EquilibriumKind.SEGMENT) & (rests.kind > 0)
    row = jnp.argmax(eligible)
    x1 = jnp.where(jnp.any(eligible), rests.x1[row], 0.0)
    rate = jnp.where(rests.kind[row] == EquilibriumKind.FIXED_POINT, rests.rate[row], 0.0)
    limit = 2 * jnp.pi * rate / jnp.sqrt(jnp.maximum(1 - rate**2, 1e-12))

    def loop(distance):
        orbit, _, top = first_loop(still, x1, distance, size)
        rows = jnp.arange(size) < orbit.count
        sticks = jnp.any(rows & jnp.any(orbit.codes == 0, axis=-1))
        return orbit, jnp.log((top - x1) / distance), sticks

    def narrow(bracket, _):
        distances = jnp.exp(jnp.linspace(jnp.log(bracket[0]), jnp.log(bracket[1]), STARTS))
        orbits, growth, sticks = each(loop)(distances)
        change = jnp.diff(growth)
        # Its neighbours may stick; what is extremal lies beside them.
        extremal = (change[1:] * change[:-1] < 0) & ~sticks[1:-1]
        extremal = extremal & (jnp.abs(growth - limit) > 0.05 * jnp.abs(growth))[1:-1]
        at = 1 + jnp.argmin(jnp.where(extremal, jnp.abs(growth[1:-1]), jnp.inf))
        found = jnp.any(extremal)
        bracket = jnp.where(found, jnp.stack([distances[at - 1], distances[at + 1]]), bracket)
        return bracket, (jax.tree.map(lambda leaf: leaf[at], orbits), found)

    _, (orbits, found) = lax.scan(narrow, jnp.array([1e-3, 10.0]), None, length=2)
    orbit, found = jax.tree.map(lambda leaf: leaf[-1], (orbits, found))
    status = jnp.where(jnp.any(eligible) & found, Status.OK.value, Status.NO_FOLD.value)
    return loop_of(orbit, size, len(osc.belts)), status


def fold_near(osc: Oscillator, index: int | Array, loop: Loop, status: Array) -> BifurcationPoint:
    """The cycle near a loop that is to have multiplier one; status: of the loop."""
    return _solved_point(osc, index, *_closing(osc, loop, status))


@jit
def _closing(osc: Oscillator, loop: Loop, status: Array):
    """The system of `fold_near` with a guess of its unknowns, a status, and the judge."""
    chain, z = meshed(lax.stop_gradient(osc), loop)
    return UnitMultiplier(chain), z, status, eqx.Partial(_judge_fold, jnp.ptp(z[:, 0]))


def _judge_fold(width, osc: Oscillator, z, cycle: Cycle, slope):
    # A cycle that has shrunk to the equilibrium has multiplier one too: a Hopf point.
    shrunk = jnp.ptp(z[:, 0]) < 0.2 * width
    other = (cycle.status == Status.OK) & ~(jnp.abs(slope - 1) < 1e-6)
    solved = (cycle.status == Status.OK) | (cycle.status == Status.NO_CONVERGENCE)
    fails = other | (shrunk & solved)
    return jnp.where(fails, Status.NO_FOLD.value, cycle.status), jnp.asarray(jnp.nan)


# --- points without a cycle -----------------------------------------------------------------------


def small_newton(equations, osc, unknowns):
    """Newton's method for a few equations(osc, unknowns).

    Returns the solution, its steps, its residual and the error of the last unknown.
    """

    def linearized(u):
        still = functools.partial(equations, lax.stop_gradient(osc))
        return still(u), jax.jacfwd(still)(u)

    solved = newton(linearized, lax.stop_gradient(unknowns))
    u = lax.stop_gradient(solved.z)
    # One more step carries the derivatives with respect to the other parameters.
    matrix = jax.jacfwd(lambda u: equations(osc, u))(u)
    value = equations(osc, u)
    u = u - jnp.linalg.solve(matrix, value)
    weights = jnp.linalg.solve(matrix.T, jnp.zeros(u.size).at[-1].set(1.0))
    error = 1e-15 * (1 + jnp.max(jnp.abs(u))) * jnp.sum(jnp.abs(weights))
    return u, solved.lengths, jnp.max(jnp.abs(value)), error


def _point_without_cycle(osc, index, p, steps, size, error, status, why):
    iterations = jnp.sum(~jnp.isnan(steps))
    known = functools.partial(jnp.where, status == Status.OK)
    at_point = vary(osc, index, known(p, jnp.nan)[None])
    nan = jnp.full((SIZES[0], 3), jnp.nan)
    n = len(osc.belts)
    chain = Chain(
        jnp.ones((SIZES[0], n)), jnp.full(SIZES[0], Ends(n).unused), jnp.zeros((SIZES[0], 1))
    )
    none = jnp.asarray(jnp.nan)
    cycle = Cycle(at_point, chain, nan, none, none, iterations, jnp.asarray(why.value))
    return BifurcationPoint(
        condition=AbstractCondition(),
        value=known(p, jnp.nan),
        residual=known(size, jnp.nan),
        iterations=iterations,
        steps=steps,
        error=known(error, jnp.nan),
        multiplier=none,
        oscillator=at_point,
        cycle=cycle,
        status=status,
    )


def unexplained_point(osc: Oscillator, index: int, value: float, width: float) -> BifurcationPoint:
    """A point where something changes, within an interval of that width, that nothing explains."""
    p, error, none = jnp.asarray(value), jnp.asarray(width), jnp.asarray(jnp.nan)
    point = _point_without_cycle(
        osc,
        index,
        p,
        jnp.full(NEWTON_STEPS, jnp.nan),
        none,
        error,
        jnp.asarray(Status.OK.value),
        Status.UNEXPLAINED,
    )
    status = jnp.asarray(Status.UNEXPLAINED.value)
    return replace(point, condition=Unexplained(), status=status)


def at_hopf(osc: Oscillator, index: int | Array, belts, wanted, size) -> BifurcationPoint:
    """A fixed point whose trace vanishes."""
    return _hopf_point(osc, index, candidates(osc))


@jit
def _hopf_point(osc: Oscillator, index: int | Array, rests: Equilibria) -> BifurcationPoint:
    rests = lax.stop_gradient(rests)
    fixed = rests.kind == EquilibriumKind.FIXED_POINT
    row = jnp.argmin(jnp.where(fixed, jnp.abs(rests.rate), jnp.inf))
    codes = rests.modes[row].astype(float)
    mode = mode_of(codes)
    rest = jnp.zeros(())

    def equations(osc, u):
        osc = vary(osc, index, u[1:])
        return jnp.append(
            mode_acceleration(osc, mode, u[0], rest)[None], trace_of(osc, mode, u[0], rest)
        )

    p0 = parameter(osc, index)
    x1 = jnp.where(fixed[row], rests.x1[row], 0.0)
    u, steps, size, error = small_newton(equations, osc, jnp.stack([x1, p0]))
    at_point = vary(osc, index, u[1:])
    inside = [*boundary_guards(at_point, mode, rest), *edge_guards(at_point, mode, u[0])]
    status = jnp.where(jnp.all(jnp.stack(inside) > 0), Status.OK.value, Status.NOT_ADMISSIBLE.value)
    status = jnp.where(size < 1e-9, status, Status.NO_CONVERGENCE.value)
    status = jnp.where(jnp.any(fixed), status, Status.NO_FIXED_POINT.value)
    return _point_without_cycle(osc, index, u[1], steps, size, error, status, Status.EQUILIBRIUM)


class EdgeRest(eqx.Module):
    """What vanishes where an equilibrium lies on an edge, by the number of the edge.

    The needed force at rest on one side of it, less what belts at rest there can hold, in one of
    the two directions (0 where none is at rest).
    """

    edge: Array
    rightward: Array
    limit: Array
    codes: Array

    def __call__(self, osc: Oscillator) -> Array:
        at, mode = jnp.stack(edges(osc))[self.edge], mode_of(self.codes)
        needed = mode_acceleration(osc, mode, at, jnp.zeros(()))
        return needed + self.limit * capacity(osc, mode)

    def meets_hopf(self, osc: Oscillator) -> Array:
        """What vanishes where the curve of this meets that of a Hopf point; NaN for a segment."""
        mode = mode_of(self.codes)
        _, trace, *_ = field_at_rest(osc, mode, jnp.stack(edges(osc))[self.edge])
        return jnp.where(mode.any_stuck, jnp.nan, trace)

    def exists(self, osc: Oscillator) -> Array:
        """Whether the contacts on that side are those."""
        at = jnp.stack(edges(osc))[self.edge]
        left, right = _beside_edge(osc, at)
        return jnp.all(jnp.stack(select(self.rightward, right, left).codes) == self.codes)


class EdgeBalance(eqx.Module):
    """What vanishes where the pseudo-focus at an edge is neither stable nor unstable."""

    edge: Array
    left: Mode
    right: Mode

    def _sides(self, osc: Oscillator):
        at = jnp.stack(edges(osc))[self.edge]
        return field_at_rest(osc, self.left, at)[:2], field_at_rest(osc, self.right, at)[:2]

    def __call__(self, osc: Oscillator) -> Array:
        # The contraction of `modes.edge_focus` times both pushes: regular where one of them is 0.
        (a_left, trace_left), (a_right, trace_right) = self._sides(osc)
        return trace_right * a_left - trace_left * a_right

    def exists(self, osc: Oscillator) -> Array:
        """Whether there is a pseudo-focus, and no belt at rest touches."""
        return (self.meets_hopf(osc) > 0) & ~self.left.any_stuck & ~self.right.any_stuck

    def meets_hopf(self, osc: Oscillator) -> Array:
        """What vanishes where the curve of this meets that of a Hopf point: the weaker of the two
        pushes towards the edge, negative where one pushes away."""
        (a_left, _), (a_right, _) = self._sides(osc)
        return jnp.minimum(a_left, -a_right)


def _edges_of(osc: Oscillator, belt: Array) -> tuple[Array, Array]:
    """The numbers of the lower and the upper edge of a belt."""
    return belt, belt + jnp.asarray(len(osc.belts))


def _beside_edge(osc: Oscillator, at: Array) -> tuple[Mode, Mode]:
    """The contacts at rest to the left and to the right of an edge."""
    rest = jnp.zeros_like(at)
    return contact(osc, at, rest, rightward=False), contact(osc, at, rest, rightward=True)


def edge_rest(osc: Oscillator, belt: Array) -> EdgeRest:
    """The equation of a boundary equilibrium at an edge of a belt that is nearest to hold."""
    cases = []
    for edge in _edges_of(osc, belt):
        sides = _beside_edge(osc, jnp.stack(edges(osc))[edge])
        cases += [
            EdgeRest(edge, jnp.asarray(rightward), jnp.asarray(limit), jnp.stack(mode.codes))
            for rightward, mode in zip((False, True), sides, strict=True)
            for limit in (-1.0, 1.0)
        ]
    missing = jnp.stack([jnp.abs(case(osc)) for case in cases])
    at = jnp.argmin(jnp.where(jnp.isfinite(missing), missing, jnp.inf))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[at], *cases)


def edge_balance(osc: Oscillator, belt: Array) -> EdgeBalance:
    """The equation of the pseudo-focus at an edge of a belt, of two the one nearer to balance."""
    positions = jnp.stack(edges(osc))
    cases = [
        EdgeBalance(edge, *_beside_edge(osc, positions[edge])) for edge in _edges_of(osc, belt)
    ]
    size = [jnp.where(case.exists(osc), jnp.abs(case(osc)), jnp.inf) for case in cases]
    at = jnp.argmin(jnp.stack(size))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[at], *cases)


@jit
def at_boundary_equilibrium(osc: Oscillator, index: int | Array, belts, wanted, size):
    """An equilibrium, or the end of a segment of them, lies on an edge of the first belt."""
    return _rest_on_edge(osc, index, edge_rest(lax.stop_gradient(osc), belts[0]))


@jit
def at_pseudo_hopf(osc: Oscillator, index: int | Array, belts, wanted, size):
    """The pseudo-focus at an edge of the first belt is neither stable nor unstable."""
    return _rest_on_edge(osc, index, edge_balance(lax.stop_gradient(osc), belts[0]))


def _rest_on_edge(osc, index, equation: EdgeRest | EdgeBalance) -> BifurcationPoint:
    """One equation in the parameter alone."""

    def equations(osc, u):
        return equation(vary(osc, index, u))[None]

    u, steps, size, error = small_newton(equations, osc, parameter(osc, index)[None])
    at_point = vary(osc, index, u)
    exists = equation.exists(at_point)
    status = jnp.where(exists, Status.OK.value, Status.NOT_ADMISSIBLE.value)
    status = jnp.where(size < 1e-9, status, Status.NO_CONVERGENCE.value)
    has_edge = jnp.isfinite(jnp.stack(edges(at_point))[equation.edge])
    status = jnp.where(has_edge, status, Status.NOT_TOUCHED.value)
    return _point_without_cycle(osc, index, u[0], steps, size, error, status, Status.EQUILIBRIUM)


def at_rest(osc: Oscillator, index: int | Array, belts, wanted, size) -> BifurcationPoint:
    """The first of the belts comes to rest, and a cycle sticks to it."""
    return _belt_at_rest(osc, index, belts, *_orbit_after_stick(osc, belts))


@jit
def _belt_at_rest(osc, index, belts, moving: Oscillator, start: Array, orbit: Orbit):
    belt = belts[0]
    rows = jnp.arange(HINT_BUDGET)
    loop = (rows > orbit.repeats) & (rows < orbit.count)
    sticks = (orbit.status == Status.OK) & jnp.any(loop & (orbit.codes[:, belt] == 0))
    # The contacts at slip onset are those at the equilibrium that it meets.
    mode = Mode(tuple(orbit.codes[0, i] for i in range(len(osc.belts))))
    rest = jnp.zeros(())

    def equations(osc, u):
        osc = vary(osc, index, u[1:])
        nu = _velocity(osc, belt)
        limit = jnp.sign(_velocity(moving, belt)) * capacity(osc, mode)
        return jnp.stack([mode_acceleration(osc, mode, u[0], rest) + limit, nu])

    p0 = parameter(osc, index)
    u, steps, size, error = small_newton(equations, osc, jnp.stack([start[0], p0]))
    status = jnp.where(sticks, Status.OK.value, Status.NOT_TOUCHED.value)
    status = jnp.where(size < 1e-9, status, Status.NO_CONVERGENCE.value)
    return _point_without_cycle(osc, index, u[1], steps, size, error, status, Status.STUCK_FOREVER)


def at_reversal(osc: Oscillator, index: int | Array, belts, wanted, size) -> BifurcationPoint:
    """The first of the belts comes to rest, and the mass is at rest on it."""
    return _reversed_belt(osc, index, belts, candidates(osc))


@jit
def _reversed_belt(osc, index, belts, rests: Equilibria) -> BifurcationPoint:
    belt = belts[0]
    touches = (rests.kind > 0) & (jnp.abs(rests.modes[:, belt]) < 2)
    row, load = jnp.argmax(touches), jnp.stack([one.load for one in osc.belts])[belt]
    mode, rest = mode_of(rests.modes[row].astype(float)), jnp.zeros(())

    def equations(osc, u):
        osc = vary(osc, index, u[1:])
        needed = mode_acceleration(osc, mode, u[0], rest)
        return jnp.stack([needed, _velocity(osc, belt)])

    guess = jnp.stack([jnp.where(touches[row], rests.x1[row], jnp.nan), parameter(osc, index)])
    u, steps, size, error = small_newton(equations, osc, guess)
    exists = touches[row] & (load > 0)
    status = jnp.where(exists, Status.OK.value, Status.NOT_TOUCHED.value)
    status = jnp.where(exists & ~(size < 1e-9), Status.NO_CONVERGENCE.value, status)
    return _point_without_cycle(osc, index, u[1], steps, size, error, status, Status.EQUILIBRIUM)


#: What solves for a condition, if not `at_tangency`; and which of two kinds that finds is meant.
_SOLVERS = {
    Hopf: at_hopf,
    SlidingExchange: at_exchange,
    CrossingSliding: at_crossing,
    SuddenSliding: at_rest,
    BeltAtRest: at_reversal,
    FoldOfCycles: at_fold_of_cycles,
    GrazingEdge: at_edge,
    CornerCollision: at_edge,
    BoundaryEquilibrium: at_boundary_equilibrium,
    PseudoHopf: at_pseudo_hopf,
}
_SIDES = {NonsmoothFold: 1.0, GrazingSliding: -1.0, GrazingEdge: 1.0, CornerCollision: -1.0}


def solver_of(condition: AbstractCondition) -> Callable:
    """What solves for a condition."""
    if isinstance(condition, GrazingEdge) and condition.unstable:
        return at_edge_unstable
    return _SOLVERS.get(type(condition), at_tangency)
