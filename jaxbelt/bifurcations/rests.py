"""Equilibria that change, and belts that come to rest.

There is no cycle at these points, and the equations are few: in the parameter and x1 of the state
of rest, or in the parameter alone.

- `Hopf`: trace zero at a fixed point (its determinant is always one).
- `SuddenSliding`: nu_k = 0, with the mass at rest on the belt, x2' = x2 = 0: an equilibrium lies on
  the boundary. No cycle can be an unknown here: as nu_k goes to zero the stick phase lasts ever
  longer, the slip arc takes ever longer to leave the equilibrium, and in the limit no cycle exists.
- `BeltAtRest`: nu_k = 0, too, but no cycle sticks to the belt: an equilibrium jumps, or a
  pseudo-focus on an edge changes its stability or vanishes.

Hopf points are eqs. (27), (28) of the paper, and sudden sliding is its name. Bifurcations on
contact edges are in `edge_rests`.
"""

import abc
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

from ..checks import pick
from ..cycles.orbits import Orbit
from ..cycles.shooting import trace_of
from ..model.equilibria import Equilibria, EquilibriumKind, candidates, edge_rounding
from ..model.families import Family
from ..model.modes import (
    STUCK,
    boundary_guards,
    capacity,
    edge_at,
    edge_guards,
    edges,
    mode_acceleration,
    mode_of,
    velocity_of,
)
from ..model.oscillator import Oscillator
from ..model.parameters import leaf_index
from ..model.pseudofocus import edge_focus
from ..model.transitions import contact_beside
from ..model.variations import Variation
from ..numerics.compiling import jit
from ..numerics.newton import HOLDS
from ..results import Status
from .base import AbstractCondition, Line, point_without_cycle
from .guesses import HINT_BUDGET, orbit_after_stick
from .special import SpecialPoint, Trail
from .systems import RestSystem, judged_by, small_newton, third_derivative

#: The unknowns of a system in the parameter alone.
NOTHING = np.zeros(0)
#: Guess of a condition on several states of rest: any of them.
ANY = np.array(-1)
#: A coefficient smaller than this, relative to its terms, is zero: points are good to some 1e-12.
DEGENERATE = 1e-9
#: Sudden sliding is solved for from these distances to the value at which the belt is at rest:
#: orbits converge quickly from the larger ones, but other points may lie nearer than these.
BESIDE = (1e-2, -1e-2, 1e-4, -1e-4)

# --- conditions on a state of rest ----------------------------------------------------------------


class AbstractRestCondition(AbstractCondition):
    """A condition on a state of rest, at which there is no cycle."""

    #: Status of the cycle of a point: why there is none.
    no_cycle: ClassVar[Status] = Status.EQUILIBRIUM

    @abc.abstractmethod
    def system(self, osc: Oscillator, guess: Any) -> tuple[RestSystem, Any, Array]:
        """The system near a guess, its unknowns there, and a status; compiled."""

    def prepared(self, osc, guess):
        return _prepared_rest(self, osc, guess)

    def point_near(self, family, system, x, p, status):
        why = jnp.asarray(self.no_cycle.value)
        return _solved_rest(family, system, x, p, status, why)

    def system_at(self, point):
        osc, data = point.oscillator, self.as_data()
        return data.prepared(osc, data.guess(osc, self.room))[:2]


@jit
def _prepared_rest(condition: AbstractRestCondition, osc: Oscillator, guess):
    return condition.system(lax.stop_gradient(osc), guess)


def _rest_point(family: Family, system: RestSystem, x0, p0, status, why):
    def equations(given, u):
        family, system = given
        return system.residual(family.at(u[-1:]), u[:-1])

    given, guess = (family, system), jnp.append(x0, p0)
    u, steps, size, error = small_newton(equations, given, guess, family.unit)
    x, p = u[:-1], u[-1:]
    exists = system.exists(family.at(p), x)
    judged = jnp.where(exists, Status.OK.value, system.otherwise.value)
    judged = jnp.where(size < HOLDS, judged, Status.NO_CONVERGENCE.value)
    status = judged_by(error, family, jnp.where(status == Status.OK, judged, status))
    x1 = system.x1(family.at(p), x)
    return point_without_cycle(family, p, steps, size, error, status, why, x1), (x, p)


_solved_rest = jit(_rest_point)


class AbstractRestOfSeveral(AbstractRestCondition):
    """A condition on any of several states of rest: the point nearest to the guess counts.

    For a function of the parameter it is the nearest along its tangents. The guess is the number of
    the state of rest, or ANY.
    """

    @abc.abstractmethod
    def systems(self, osc: Oscillator) -> tuple[RestSystem, Any, Array]:
        """The systems of all states of rest, their unknowns and statuses, [rows]; compiled."""

    def system(self, osc, guess):
        systems, x, status = self.systems(osc)
        is_meant = (guess < 0) | (jnp.arange(status.size) == guess)
        return systems, x, jnp.where(is_meant, status, Status.NOT_TOUCHED.value)

    def guess(self, osc, size):
        return ANY

    def guess_near(self, beginning):
        return beginning

    def beginnings(self, osc, cycles):
        systems, x, status = self.as_data().prepared(osc, ANY)
        order = np.argsort(np.asarray(_misses(systems, osc, x)))
        return [np.array(row) for row in order if np.asarray(status)[row] == Status.OK]

    def point_near(self, family, system, x, p, status):
        return _solved_nearest(family, system, x, p, status, jnp.asarray(self.no_cycle.value))

    def system_at(self, point):
        systems, x, status = self.as_data().prepared(point.oscillator, ANY)
        row = _row_that_holds(systems, point.oscillator, x, status, point.x1, point.member)
        return _of_row((systems, x), row)


_of_row = jit(pick)


@jit
def _misses(systems: RestSystem, osc: Oscillator, x: Array) -> Array:
    """Largest error in the equations of each system, [rows]; inf where it has no state of rest."""
    missed = jax.vmap(lambda system, x: jnp.max(jnp.abs(system.residual(osc, x))))(systems, x)
    return jnp.where(jnp.isfinite(missed), missed, jnp.inf)


@jit
def _row_that_holds(
    systems: RestSystem, osc: Oscillator, x: Array, status: Array, x1: Array, row: ArrayLike
) -> Array:
    """Number of the system whose equations hold with the mass at rest at x1.

    If several hold, it is `row` if that is among them: the system of the other side of an edge may
    hold, too, whatever the parameter is.
    """
    places = jax.vmap(lambda system, x: system.x1(osc, x))(systems, x)
    misses = _misses(systems, osc, x) + jnp.abs(places - x1)
    misses = jnp.where(status == Status.OK, misses, jnp.inf)
    holds = misses[row] < jnp.min(misses) + HOLDS
    return jnp.where(holds, row, jnp.argmin(misses))


@jit
def _solved_nearest(family: Family, systems: RestSystem, x0, p0, status, why):
    """The point nearest to the guess among those of all systems.

    If no system has a point, the result of the one with the smallest errors at the guess.
    """

    def at_row(family, row):
        system, x, said = pick((systems, x0, status), row)
        return _rest_point(family, system, x, p0, said, why)

    # The choice has no derivative. The chosen row is solved once more, alone: in a batch with rows
    # of NaN the point would have no derivative either.
    fixed = lax.stop_gradient(family)
    points, _ = jax.vmap(lambda row: at_row(fixed, row))(jnp.arange(status.size))
    misses = jnp.where(status == Status.OK, _misses(systems, fixed.at(p0), x0), jnp.inf)
    away = jnp.where(points.status == Status.OK, jnp.abs(points.value - p0[0]), jnp.inf)
    row = jnp.where(jnp.any(jnp.isfinite(away)), jnp.argmin(away), jnp.argmin(misses))
    point, (x, p) = at_row(family, row)
    return replace(point, member=row), (x0.at[row].set(x), p)


# --- the Hopf point -------------------------------------------------------------------------------


class HopfSystem(RestSystem):
    """Rest and a trace of zero in the mode of `codes`; the unknown is x1."""

    codes: Array

    def residual(self, osc, x):
        mode, rest = mode_of(self.codes), jnp.zeros(())
        needed = mode_acceleration(osc, mode, x[0], rest)
        return jnp.append(needed[None], trace_of(osc, mode, x[0], rest))

    def exists(self, osc, x):
        # A fixed point on an edge, where it may lie all along a path, counts, too: on its side of
        # the edge loops grow on one side of the Hopf point, and shrink on the other.
        slips = jnp.stack(boundary_guards(osc, mode_of(self.codes), jnp.zeros(()))) > 0
        # A belt at rest that can hold nothing is no obstacle.
        holds = jnp.stack([belt.load * belt.friction.static > 0 for belt in osc.belts])
        return jnp.all(slips | ~holds) & (self._nearest_edge(osc, x) >= -edge_rounding(x[0]))

    def _nearest_edge(self, osc, x):
        return jnp.min(jnp.stack(edge_guards(osc, mode_of(self.codes), x[0])))

    def is_on_edge(self, osc: Oscillator, x: Array) -> Array:
        """Whether the fixed point lies on a contact edge, up to rounding."""
        return self._nearest_edge(osc, x) <= edge_rounding(x[0])

    def tests(self, osc, x):
        nearest = self._nearest_edge(osc, x)
        return {
            ("DegenerateHopf", ()): third_derivative(osc, self.codes, x[0]),
            ("BoundaryHopf", ()): jnp.where(jnp.isfinite(nearest), nearest, jnp.nan),
        }

    def place(self, osc, x):
        return np.array([x[0], x[0], 0.0, 0.0, 0.0])


class Hopf(AbstractRestOfSeveral):
    """A fixed point changes its stability: eqs. (27), (28) of the paper, for any friction law."""

    caption: ClassVar[str] = "Hopf"
    line: ClassVar[Line] = Line("Hopf", "#009E73", (0, (5, 1.5)))

    def systems(self, osc):
        rests = lax.stop_gradient(candidates(osc))
        fixed = rests.kind == EquilibriumKind.FIXED_POINT
        status = jnp.where(fixed, Status.OK.value, Status.NO_FIXED_POINT.value)
        x1 = jnp.where(fixed, rests.x1, 0.0)
        return HopfSystem(rests.modes.astype(float)), x1[:, None], status

    @classmethod
    def between(cls, before, after, edged):
        return [cls()] if before.equilibria != after.equilibria else []

    def is_slow_at(self, point):
        # The cycle around a fixed point on an edge attracts, or repels, only weakly.
        return bool(_is_on_edge(point.oscillator, point.x1))

    def type_of(self, point):
        return criticality(*_hopf_growth(*self.system_at(point), point.oscillator))

    def coefficient(self, point):
        return _hopf_growth(*self.system_at(point), point.oscillator)[0]

    def place(self, point):
        return np.array([point.x1, point.x1, 0.0, 0.0, 0.0])


@jit
def _is_on_edge(osc: Oscillator, x1: Array) -> Array:
    away = jnp.abs(jnp.stack(edges(osc)) - x1)
    return jnp.any(away <= edge_rounding(x1))


def criticality(coefficient: Array, size: Array) -> str:
    """Type of a point at which a cycle is born; size: of the terms of the coefficient."""
    if not abs(coefficient) > DEGENERATE * size:
        return "degenerate"
    return "subcritical" if coefficient > 0 else "supercritical"


@jit
def _hopf_growth(system: HopfSystem, x1: Array, osc: Oscillator) -> tuple[Array, Array]:
    """The first Lyapunov coefficient at a Hopf point, x1 [1], and the size of its terms.

    NaN on a contact edge: every loop, however small, crosses it.
    """
    sizes = []
    for belt, code in zip(osc.belts, system.codes, strict=True):
        alone = eqx.tree_at(lambda o: o.belts, osc, (belt,))
        third = third_derivative(alone, code[None], x1[0])
        sizes.append(jnp.where(jnp.abs(code) == 1, jnp.abs(third), 0.0))
    third = third_derivative(osc, system.codes, x1[0])
    known = jnp.where(system.is_on_edge(osc, x1), jnp.nan, third / 16)
    return known, jnp.sum(jnp.stack(sizes)) / 16


def hopf_limit(kind: str, trail: Trail, vanishes: Callable, *args: Array) -> SpecialPoint | None:
    """The point where the cycle of a curve has shrunk to an equilibrium, if that is near.

    The cycle's own equations are singular there; those of a Hopf point, together with the equation
    vanishes(osc, codes, x1, *args) = 0, are not.
    """
    x1 = trail.x[:, 0]
    if np.ptp(x1) > 5 * trail.step:
        return None
    codes = trail.system.chain.codes[0]

    def attempt(family, unknowns):
        start = jnp.concatenate([jnp.asarray(one) for one in unknowns])
        found, residual = _special_hopf(family, codes, start, vanishes, *args)
        return (found, residual), (found[:1], found[1:])

    guess = x1[:1], trail.values[-1]
    return limit_near(trail, attempt, guess, trail.values[-1], 2 * trail.step, kind)


def limit_near(
    trail: Trail, attempt: Callable, guess: tuple, ahead, away: float, kind: str, *belts: int
) -> SpecialPoint | None:
    """The point that a curve leads to, if it is found and no farther than `away` from `ahead`.

    attempt: see `Variation.relinearised`; it finds (unknowns, residual), with both parameters last
    among the unknowns.
    """
    (found, residual), agrees = trail.variation.relinearised(attempt, guess)
    values = np.asarray(found)[-2:]
    if not (agrees and residual < HOLDS and np.linalg.norm(values - ahead) < away):
        return None
    return SpecialPoint(kind, belts, (float(values[0]), float(values[1])), float(residual))


@jit
def _special_hopf(family: Family, codes, guess: Array, vanishes, *args):
    """(x1, both parameters) of a Hopf point at which `vanishes` is zero, and the residual."""

    def equations(given, u):
        family, codes, *args = given
        osc = family.at(u[1:])
        also = vanishes(osc, codes, u[0], *args)
        return jnp.append(HopfSystem(codes).residual(osc, u[:1]), also)

    u, _, residual, _ = small_newton(equations, (family, codes, *args), guess)
    return u, residual


# --- belts that come to rest ----------------------------------------------------------------------


class RestingBelt(RestSystem):
    """A belt comes to rest, and the mass rests on it in the mode of `codes`; the unknown is x1.

    side: sign of the belt's velocity where the stuck belts hold all they can, 0 where they hold
    nothing; sticks: whether a solution counts; edge: number of the edge on which the mass rests at
    a pseudo-focus, -1 where there is none.
    """

    belt: int | Array
    codes: Array
    side: Array
    sticks: Array
    edge: Array

    @property
    def otherwise(self):
        return Status.NOT_TOUCHED

    def residual(self, osc, x):
        mode = mode_of(self.codes)
        limit = self.side * capacity(osc, mode)
        needed = mode_acceleration(osc, mode, x[0], jnp.zeros(()))
        away = x[0] - edge_at(osc, self.edge)
        rests = jnp.where(self.edge < 0, needed + limit, away)
        return jnp.stack([rests, velocity_of(osc, self.belt)])

    def exists(self, osc, x):
        return self.sticks


class StoppedBelt(RestSystem):
    """The velocity of a belt is zero, wherever the mass rests: one equation, no unknown x1."""

    belt: int | Array

    def residual(self, osc, x):
        return velocity_of(osc, self.belt)[None]

    def exists(self, osc, x):
        return jnp.asarray(True)

    def tests(self, osc, x):
        # This belt is at rest all along the curve.
        return {
            ("BeltAtRest", (i,)): jnp.where(self.belt == i, jnp.nan, one.velocity)
            for i, one in enumerate(osc.belts)
        }


class _RestingBeltCondition(AbstractRestCondition):
    """A belt comes to rest; the kind depends on whether a cycle on either side sticks to it."""

    belt: int | Array

    group: ClassVar[str] = "rest"
    joins: ClassVar[bool] = False

    @classmethod
    def at_coincidence(cls, belts):
        return [cls(*belts)] if len(belts) == 1 else []

    def system_at(self, point):
        return StoppedBelt(jnp.asarray(self.belt)), NOTHING

    def kind_along(self, osc, multiplier):
        number = leaf_index(osc, lambda osc: osc.belts[int(self.belt)].velocity)
        velocity, sudden = Variation.of_leaves(osc, [number]), SuddenSliding(self.belt)
        found = (sudden.named_point_from(velocity, value) for value in sudden.values(0.0, 0.0))
        return BeltAtRest if next(filter(None, found), None) is None else SuddenSliding


class SuddenSliding(_RestingBeltCondition):
    """A belt comes to rest: the time that the mass sticks to it in each loop goes to infinity.

    Args:
        belt: Number of the belt.
    """

    no_cycle: ClassVar[Status] = Status.STUCK_FOREVER
    line: ClassVar[Line] = Line("sudden sliding", "black", (0, (4, 1.2)))
    caption: ClassVar[str] = "sudden sliding, belt {belt}"

    def guess(self, osc, size):
        return orbit_after_stick(osc, self.belt)

    def system(self, osc, guess: tuple[Oscillator, Array, Orbit]):
        moving, start, orbit = lax.stop_gradient(guess)
        rows = jnp.arange(HINT_BUDGET)
        loop = (rows > orbit.repeats) & (rows < orbit.count)
        sticks = (orbit.status == Status.OK) & jnp.any(loop & (orbit.codes[:, self.belt] == 0))
        # The contacts in the first arc, up to slip onset, are those at the equilibrium.
        side = jnp.sign(velocity_of(moving, self.belt))
        system = RestingBelt(self.belt, orbit.codes[0], side, sticks, jnp.asarray(-1))
        return system, start[:1], jnp.asarray(Status.OK.value)

    def values(self, a, b):
        return [0.5 * (a + b) + offset for offset in BESIDE]


class BeltAtRest(_RestingBeltCondition):
    """A belt comes to rest where the mass is at rest on it, too, and no cycle sticks to it.

    Beyond the point its friction has the other direction: the equilibrium jumps, or vanishes. A
    pseudo-focus on an edge stays, with another stability: it repels on one side of the point at
    least, and attracts at the point, so a cycle around it shrinks to it; or the pseudo-focus
    vanishes.

    Args:
        belt: Number of the belt.
    """

    line: ClassVar[Line] = Line("belt at rest", "black", (0, (1, 1.2)))
    caption: ClassVar[str] = "belt {belt} at rest"

    def guess(self, osc, size):
        return candidates(osc)

    def system(self, osc, guess: Equilibria):
        rests = lax.stop_gradient(guess)
        on_edge = rests.kind == EquilibriumKind.PSEUDO_FOCUS
        touches = (rests.kind > 0) & ~on_edge & (jnp.abs(rests.modes[:, self.belt]) < 2)
        changes = on_edge & jax.vmap(lambda x1: _focus_changes(osc, self.belt, x1))(rests.x1)
        row = jnp.where(jnp.any(touches), jnp.argmax(touches), jnp.argmax(changes))
        load = jnp.stack([one.load for one in osc.belts])[self.belt]
        found = touches[row] | changes[row]
        exists = found & (load > 0)
        codes, nothing = rests.modes[row].astype(float), jnp.zeros(())
        nearest = jnp.argmin(jnp.abs(jnp.stack(edges(osc)) - rests.x1[row]))
        edge = jnp.where(touches[row], -1, nearest)
        system = RestingBelt(self.belt, codes, nothing, exists, edge)
        status = jnp.where(exists, Status.OK.value, Status.NOT_TOUCHED.value)
        return system, jnp.where(found, rests.x1[row], jnp.nan)[None], status


def _focus_changes(osc: Oscillator, belt: int | Array, edge: Array) -> Array:
    """Whether the pseudo-focus on an edge changes where the velocity of a belt passes zero.

    It does not where it attracts for both signs of the velocity, nor where another belt at rest
    brakes the mass there.
    """
    rest = jnp.zeros(())
    beside = [contact_beside(osc, edge, rest, rightward=right) for right in (False, True)]
    sides = [jnp.stack(mode.codes) for mode in beside]
    loads, others = jnp.stack([one.load for one in osc.belts]), jnp.arange(len(osc.belts)) != belt
    touched, braked, attracts = (jnp.asarray(flag) for flag in (False, False, True))
    for codes in sides:
        touched = touched | (jnp.abs(codes[belt]) < 2)
        braked = braked | jnp.any(others & (codes == STUCK) & (loads > 0))
    for sign in (1.0, -1.0):
        turned = [jnp.where(jnp.abs(codes[belt]) < 2, sign, codes[belt]) for codes in sides]
        left, right = (mode_of(c.at[belt].set(t)) for c, t in zip(sides, turned, strict=True))
        focus = edge_focus(osc, left, right, edge)
        attracts = attracts & focus.exists & (focus.rate < 0)
    return touched & ~braked & ~attracts
