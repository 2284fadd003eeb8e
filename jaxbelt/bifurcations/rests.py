"""Equilibria that change, and belts that come to rest."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..cycles.cycle import (
    Orbit,
    trace_of,
)
from ..model.equilibria import Equilibria, EquilibriumKind, candidates
from ..model.modes import (
    Mode,
    boundary_guards,
    capacity,
    contact,
    edge_guards,
    edges,
    field_at_rest,
    mode_acceleration,
    mode_of,
    select,
)
from ..model.oscillator import Oscillator
from ..model.parameters import parameter, vary
from ..numerics.compiling import jit
from ..results import Status
from .conditions import AbstractCondition, BeltCondition, BifurcationPoint, point_without_cycle
from .guesses import HINT_BUDGET, orbit_after_stick
from .systems import small_newton, velocity_of


class Hopf(AbstractCondition):
    """A fixed point changes its stability: eqs. (27), (28) of the paper, for any friction law."""


class SuddenSliding(BeltCondition):
    """A belt comes to rest: the time that the mass sticks to it in each loop goes to infinity."""


class BeltAtRest(BeltCondition):
    """A belt comes to rest where the mass is at rest on it, too, and no cycle sticks to it.

    On the other side its friction pulls the other way: the equilibrium jumps, or there is none.
    """


class BoundaryEquilibrium(BeltCondition):
    """A fixed point, or the end of a segment, lies on a contact edge of a belt."""


class PseudoHopf(BeltCondition):
    """The pseudo-focus at a contact edge of a belt changes its stability."""


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
    return point_without_cycle(osc, index, u[1], steps, size, error, status, Status.EQUILIBRIUM)


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
    return point_without_cycle(osc, index, u[0], steps, size, error, status, Status.EQUILIBRIUM)


def at_rest(osc: Oscillator, index: int | Array, belts, wanted, size) -> BifurcationPoint:
    """The first of the belts comes to rest, and a cycle sticks to it."""
    return _belt_at_rest(osc, index, belts, *orbit_after_stick(osc, belts))


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
        nu = velocity_of(osc, belt)
        limit = jnp.sign(velocity_of(moving, belt)) * capacity(osc, mode)
        return jnp.stack([mode_acceleration(osc, mode, u[0], rest) + limit, nu])

    p0 = parameter(osc, index)
    u, steps, size, error = small_newton(equations, osc, jnp.stack([start[0], p0]))
    status = jnp.where(sticks, Status.OK.value, Status.NOT_TOUCHED.value)
    status = jnp.where(size < 1e-9, status, Status.NO_CONVERGENCE.value)
    return point_without_cycle(osc, index, u[1], steps, size, error, status, Status.STUCK_FOREVER)


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
        return jnp.stack([needed, velocity_of(osc, belt)])

    guess = jnp.stack([jnp.where(touches[row], rests.x1[row], jnp.nan), parameter(osc, index)])
    u, steps, size, error = small_newton(equations, osc, guess)
    exists = touches[row] & (load > 0)
    status = jnp.where(exists, Status.OK.value, Status.NOT_TOUCHED.value)
    status = jnp.where(exists & ~(size < 1e-9), Status.NO_CONVERGENCE.value, status)
    return point_without_cycle(osc, index, u[1], steps, size, error, status, Status.EQUILIBRIUM)
