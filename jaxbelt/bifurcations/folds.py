"""Folds of cycles that do not stick."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..cycles.cycle import (
    Chain,
    Cycle,
    Loop,
    closure,
    first_loop,
    loop_of,
    meshed,
    multiplier_and_slopes,
)
from ..model.equilibria import Equilibria, EquilibriumKind, candidates
from ..model.oscillator import Oscillator
from ..numerics.compiling import each, jit
from ..results import Status
from .conditions import AbstractCondition, BifurcationPoint, solved_point
from .systems import System


class FoldOfCycles(AbstractCondition):
    """Two cycles that do not stick, a stable and an unstable one, meet and vanish.

    Near a degenerate Hopf point, where both shrink to the equilibrium, small ones are not found. In
    the case of the tests, those with x1_max - x1_min above 0.006 are, from guesses some two times
    as far from the point as that is from the Hopf point.
    """


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
    return solved_point(osc, index, *_closing(osc, loop, status))


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
