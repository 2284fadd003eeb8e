"""Equilibria on contact edges that change: `BoundaryEquilibrium` and `PseudoHopf`.

There is no cycle at these points, and no unknown but the parameter.

- `BoundaryEquilibrium`: at rest on an edge, the force on one of its sides is zero, or as large as
  belts at rest there can hold: a fixed point, or the end of a segment, comes to lie on the edge. It
  continues beyond the point (persistence) if the other side of the edge pushes towards it, as a
  pseudo-focus, or holds the mass; if that side pushes away, it meets the saddle of the edge and
  both vanish (annihilation). Where the static limit of a belt at rest exceeds mu(0), orbits end
  only in that part of the segment where mu(0) is enough; the end of that part may come to the edge,
  too.
- `PseudoHopf`: at a pseudo-focus the leading term by which loops grow or shrink is zero. With the
  next one, of third order, `|x2|` at the edge obeys r' = rate r + a r^3, see `edge_focus`, and the
  cycle that is born has r^2 = -rate/a.

Boundary equilibria and the pseudo-Hopf point are those of M. di Bernardo, C. Budd, A. Champneys, P.
Kowalczyk, Piecewise-smooth Dynamical Systems, 2008.
"""

import functools
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks import is_concrete, require_value
from ..model.equilibria import EquilibriumKind
from ..model.families import Family
from ..model.modes import (
    Mode,
    capacity,
    edge_at,
    edges,
    force_rounding,
    kinetic_capacity,
    mode_acceleration,
    mode_of,
    select,
    settle,
    velocity_of,
)
from ..model.oscillator import Oscillator
from ..model.pseudofocus import edge_focus, field_at_rest
from ..model.transitions import contact_beside
from ..numerics.compiling import jit
from ..numerics.newton import HOLDS
from ..results import Status
from .base import AbstractCondition, Line
from .rests import NOTHING, AbstractRestOfSeveral, criticality, limit_near
from .special import SpecialPoint, Trail, extrapolated_to_zero
from .systems import RestSystem, Tests, small_newton

#: A cycle around a pseudo-focus is as small as a velocity if the range of its x2 is at most this
#: many times the velocity.
AS_LARGE = 3.0


class _EdgeSystem(RestSystem):
    """One equation, for a state of rest on the edge of number `edge`."""

    edge: eqx.AbstractVar[Array]

    def balance(self, osc: Oscillator) -> Array:
        """The expression that vanishes."""
        raise NotImplementedError

    def meets_hopf(self, osc: Oscillator) -> Array:
        """An expression that vanishes where the curve meets one of Hopf points, else NaN."""
        raise NotImplementedError

    def residual(self, osc, x):
        return self.balance(osc)[None]

    def x1(self, osc, x):
        return edge_at(osc, self.edge)

    def tests(self, osc, x):
        return {("BoundaryHopf", ()): self.meets_hopf(osc), **self.type_tests(osc)}

    def type_tests(self, osc: Oscillator) -> Tests:
        """Functions to watch along its curve that vanish where the type changes."""
        raise NotImplementedError


class EdgeRest(_EdgeSystem):
    """The equation of an equilibrium on an edge.

    It is the force needed at rest on one side of the edge, minus what belts at rest there can hold
    in one of the two directions (0 where none is at rest). kinetic: whether they hold with their
    kinetic friction, which limits that part of a segment in which orbits end.
    """

    edge: Array
    rightward: Array
    limit: Array
    kinetic: Array
    codes: Array

    def balance(self, osc):
        at, mode = edge_at(osc, self.edge), mode_of(self.codes)
        needed = mode_acceleration(osc, mode, at, jnp.zeros(()))
        return needed + self.limit * self._held(osc, mode)

    def _held(self, osc: Oscillator, mode: Mode) -> Array:
        return select(self.kinetic, kinetic_capacity(osc, mode), capacity(osc, mode))

    def meets_hopf(self, osc):
        # The end of a segment meets no Hopf point.
        at, mode = edge_at(osc, self.edge), mode_of(self.codes)
        trace = field_at_rest(osc, _where_nothing_holds(osc, mode, at), at)[1]
        return jnp.where(capacity(osc, mode) > 0, jnp.nan, trace)

    def type_tests(self, osc):
        push, persists = self.across(osc)
        return {("DoubleBoundaryEquilibrium", ()): jnp.where(persists, jnp.nan, push)}

    def across(self, osc: Oscillator) -> tuple[Array, Array]:
        """Acceleration of the other side towards the edge, and whether the equilibrium persists
        regardless.

        It does where belts at rest hold the mass on the other side, and where the end of a segment
        that lies on the edge is the near one, which comes to the edge first.
        """
        at, rest = edge_at(osc, self.edge), jnp.zeros(())
        sides = _beside_edge(osc, at)
        left, right = (settle(osc, mode, at, rest, self._held(osc, mode)) for mode in sides)
        other = select(self.rightward, left, right)
        push = select(self.rightward, 1.0, -1.0) * mode_acceleration(osc, other, at, rest)
        # A segment to the right has its lower end where the needed force is what the belts hold.
        rests = capacity(osc, mode_of(self.codes)) > 0
        stays = rests & (self.limit == select(self.rightward, -1.0, 1.0))
        return push, stays | other.any_stuck

    def exists(self, osc, x):
        # The contacts on that side have to be `codes`; a kinetic limit has to be a separate one.
        at, mode = edge_at(osc, self.edge), mode_of(self.codes)
        left, right = _beside_edge(osc, at)
        jumps = capacity(osc, mode) - kinetic_capacity(osc, mode) > force_rounding(at)
        same = jnp.all(jnp.stack(select(self.rightward, right, left).codes) == self.codes)
        return same & (~self.kinetic | jumps)


class EdgeBalance(_EdgeSystem):
    """The equation of a pseudo-focus that is neither stable nor unstable."""

    edge: Array
    left: Mode
    right: Mode

    def _slipping(self, osc: Oscillator) -> tuple[Array, Mode, Mode]:
        """The place of the edge, and the slip modes beside it."""
        at = edge_at(osc, self.edge)
        left, right = (_where_nothing_holds(osc, mode, at) for mode in (self.left, self.right))
        return at, left, right

    def _sides(self, osc: Oscillator):
        at, left, right = self._slipping(osc)
        return field_at_rest(osc, left, at)[:2], field_at_rest(osc, right, at)[:2]

    def balance(self, osc):
        # The rate of `edge_focus` up to factors: regular where one of the pushes is 0.
        (a_left, trace_left), (a_right, trace_right) = self._sides(osc)
        return trace_right * a_left - trace_left * a_right

    def exists(self, osc, x):
        # A pseudo-focus has to exist between these contacts, and no belt at rest may brake.
        same = [
            jnp.all(jnp.stack(here.codes) == jnp.stack(mode.codes))
            for here, mode in zip(
                _beside_edge(osc, edge_at(osc, self.edge)), (self.left, self.right)
            )
        ]
        brakes = sum(capacity(osc, mode) for mode in (self.left, self.right)) > 0
        return (self.meets_hopf(osc) > 0) & ~brakes & same[0] & same[1]

    def meets_hopf(self, osc):
        # The weaker of the two pushes towards the edge, negative where one pushes away.
        (a_left, _), (a_right, _) = self._sides(osc)
        return jnp.minimum(a_left, -a_right)

    def type_tests(self, osc):
        return {("DegeneratePseudoHopf", ()): self.growth(osc)[0]}

    def growth(self, osc: Oscillator) -> tuple[Array, Array]:
        """The coefficient of third order, and the size of its terms; NaN without a pseudo-focus."""
        at, left, right = self._slipping(osc)
        focus = edge_focus(osc, left, right, at)
        known = functools.partial(jnp.where, focus.exists)
        return known(focus.coefficient, jnp.nan), known(focus.bend, jnp.nan)


def pseudo_hopf_limit(trail: Trail) -> SpecialPoint | None:
    """The point where the cycle of a curve has shrunk to a degenerate pseudo-focus, if that is
    near.

    There the rate and the coefficient are zero, and the cycle's own equations are singular.
    """
    passed = _edges_passed(trail)
    if np.ptp(trail.x[:, 0]) > 5 * trail.step or not passed.size:
        return None
    edge = jnp.asarray(passed[0])

    def attempt(family, unknowns):
        found, residual = _degenerate_focus(family, edge, jnp.asarray(unknowns[0]))
        return (found, residual), (found,)

    last = trail.values[-1]
    return limit_near(trail, attempt, (last,), last, 2 * trail.step, "DegeneratePseudoHopf")


@jit
def _degenerate_focus(family: Family, edge: Array, guess: Array) -> tuple[Array, Array]:
    """Both parameters of a degenerate pseudo-focus on an edge, and its residual."""

    def equations(given, p):
        family, edge = given
        osc = family.at(p)
        system = EdgeBalance(edge, *_beside_edge(osc, edge_at(osc, edge)))
        return jnp.stack([system.balance(osc), system.growth(osc)[0]])

    found, _, residual, _ = small_newton(equations, (family, edge), guess)
    return found, residual


def slow_focus_limit(trail: Trail, belt: int) -> SpecialPoint | None:
    """The point where a belt comes to rest and a cycle has shrunk to a pseudo-focus, if that is
    near.

    The cycle around an edge is as large as the velocity of the belt, and the pseudo-focus has the
    rate zero. The equations of the cycle lose their digits on the way, like a third power of the
    velocity. In the limit its growth is that of the pseudo-focus, as beside a pseudo-Hopf point.
    """
    if len(trail.values) < 3:
        return None
    oscs = [trail.variation.oscillator(row) for row in trail.values]
    v = np.array([float(osc.belts[belt].velocity) for osc in oscs])
    falls = 0 < abs(v[2]) < abs(v[1]) < abs(v[0])
    passed = _edges_passed(trail)
    if not falls or np.ptp(trail.x[:, 1]) > AS_LARGE * abs(v[2]) or not passed.size:
        return None
    edge, number = jnp.asarray(passed[0]), jnp.asarray(belt)
    sides = _beside_edge(oscs[-1], jnp.stack(edges(oscs[-1]))[edge])

    def attempt(family, unknowns):
        guess = jnp.asarray(unknowns[0])
        found, residual = _slow_focus(family, EdgeBalance(edge, *sides), number, guess)
        return (found, residual), (found,)

    ahead = extrapolated_to_zero(v, trail.values)
    guess = (trail.values[-1],)
    return limit_near(trail, attempt, guess, ahead, 3 * trail.step, "BeltAtRest", belt)


@jit
def _slow_focus(family: Family, system: EdgeBalance, belt: Array, guess: Array):
    """Both parameters where a belt is at rest and the rate of a pseudo-focus 0, and the residual.

    The contacts of the pseudo-focus are those beside it while the belt moves.
    """

    def equations(given, p):
        family, system, belt = given
        osc = family.at(p)
        return jnp.stack([system.balance(osc), velocity_of(osc, belt)])

    found, _, residual, _ = small_newton(equations, (family, system, belt), guess)
    return found, residual


def _edges_passed(trail: Trail) -> np.ndarray:
    """Numbers of the edges that the cycle of a curve passes."""
    chain = trail.system.chain
    n, ends = chain.codes.shape[-1], np.asarray(chain.ends)
    return ends[(ends >= n) & (ends < 3 * n)] - n


class _EdgeCondition(AbstractRestOfSeveral):
    """A condition on a state of rest on a contact edge of a belt."""

    belt: int | Array

    def check(self, osc):
        super().check(osc)
        check_edge(osc, self.belt)

    def _systems_at_edges(self, osc: Oscillator) -> tuple[_EdgeSystem, Array]:
        """Systems for the edges of the belt, a row each, and a mask of those that can hold."""
        raise NotImplementedError

    def systems(self, osc):
        systems, can_hold = self._systems_at_edges(osc)
        can_hold &= jnp.isfinite(jnp.stack(edges(osc)))[systems.edge]
        status = jnp.where(can_hold, Status.OK.value, Status.NOT_TOUCHED.value)
        return systems, jnp.zeros((status.size, 0)), status

    @classmethod
    def between(cls, before, after, edged) -> Sequence[AbstractCondition]:
        return [cls(belt) for belt in edged] if before.equilibria != after.equilibria else []


class BoundaryEquilibrium(_EdgeCondition):
    """A fixed point, or the end of a segment, lies on a contact edge of a belt.

    Where the static limit of a belt exceeds mu(0), it may also be the end of that part of a segment
    in which orbits end.

    Args:
        belt: Number of the belt.
    """

    caption: ClassVar[str] = "rest on edge, belt {belt}"
    line: ClassVar[Line] = Line("rest on edge", "#D55E00")

    def _systems_at_edges(self, osc):
        return _edge_rests(osc, self.belt)

    @classmethod
    def between(cls, before, after, edged):
        # An equilibrium passing an edge changes kind or contacts, or a segment attracts no more.
        there, then = (
            [
                (kind, stable and kind == EquilibriumKind.SEGMENT, modes)
                for kind, stable, modes in label.equilibria
            ]
            for label in (before, after)
        )
        return super().between(before, after, edged) if there != then else []

    def type_of(self, point):
        push, persists = _across_edge(self.system_at(point)[0], point.oscillator)
        if not persists and abs(push) < HOLDS:
            return "degenerate"
        return "persistence" if persists or push > 0 else "annihilation"


class PseudoHopf(_EdgeCondition):
    """The pseudo-focus at a contact edge of a belt changes its stability.

    Args:
        belt: Number of the belt.
    """

    #: Loops around the pseudo-focus keep their size; a cycle near it is lost in rounding.
    slow: ClassVar[bool] = True

    caption: ClassVar[str] = "pseudo-Hopf, belt {belt}"
    line: ClassVar[Line] = Line("pseudo-Hopf", "#D55E00", (0, (5, 1.5)))

    def _systems_at_edges(self, osc):
        systems = _edge_balances(osc, self.belt)
        return systems, jnp.ones(systems.edge.size, bool)

    def type_of(self, point):
        return criticality(*_loop_growth(self.system_at(point)[0], point.oscillator))

    def coefficient(self, point):
        return _loop_growth(self.system_at(point)[0], point.oscillator)[0]


def check_edge(osc: Oscillator, belt: Any, field: str = "belt") -> None:
    """Raises a `ValueError` if a belt has no finite contact edge."""
    if is_concrete(osc):
        ends = [osc.belts[belt].lower, osc.belts[belt].upper]
        require_value(np.any(np.isfinite(ends)), field, "one with a finite edge", belt)


def _edges_of(osc: Oscillator, belt: int | Array) -> tuple[Array, Array]:
    """Numbers of the lower and the upper edge of a belt."""
    return jnp.asarray(belt), jnp.asarray(belt + len(osc.belts))


def _beside_edge(osc: Oscillator, at: Array) -> tuple[Mode, Mode]:
    """The contacts at rest to the left and to the right of an edge."""
    rest = jnp.zeros_like(at)
    left, right = (contact_beside(osc, at, rest, rightward=side) for side in (False, True))
    return left, right


def _where_nothing_holds(osc: Oscillator, mode: Mode, at: Array) -> Mode:
    """The contacts at rest on an edge, as a slip mode where belts at rest cannot hold the mass."""
    return settle(osc, mode, at, jnp.zeros_like(at))


def _edge_rests(osc: Oscillator, belt: int | Array) -> tuple[EdgeRest, Array]:
    """Equations of boundary equilibria at the edges of a belt, and a mask of the distinct ones."""
    cases = []
    for edge in _edges_of(osc, belt):
        sides = _beside_edge(osc, edge_at(osc, edge))
        cases += [
            EdgeRest(
                edge=edge,
                rightward=jnp.asarray(rightward),
                limit=jnp.asarray(limit),
                kinetic=jnp.asarray(kinetic),
                codes=jnp.stack(mode.codes),
            )
            for rightward, mode in zip((False, True), sides, strict=True)
            for limit in (-1.0, 1.0)
            for kinetic in (False, True)
        ]
    # Where no belt holds anything, the two limits are one equation.
    exists = jnp.stack(
        [
            case.exists(osc, jnp.asarray(NOTHING))
            & ((case.limit < 0) | (capacity(osc, mode_of(case.codes)) > 0))
            for case in cases
        ]
    )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases), exists


_across_edge = jit(EdgeRest.across)
_loop_growth = jit(EdgeBalance.growth)


def _edge_balances(osc: Oscillator, belt: int | Array) -> EdgeBalance:
    """Equations of the pseudo-foci at the edges of a belt, a row each."""
    positions = jnp.stack(edges(osc))
    cases = [
        EdgeBalance(edge, *_beside_edge(osc, positions[edge])) for edge in _edges_of(osc, belt)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases)
