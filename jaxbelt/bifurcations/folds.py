"""Folds of cycles that do not stick: `FoldOfCycles`.

The multiplier of such a cycle is one. There the equations of the cycle alone are singular; with
this equation, and the parameter as an unknown, they are regular. (A cycle that sticks has the
multiplier zero and takes part in nonsmooth folds only.) Yu. Kuznetsov, Elements of Applied
Bifurcation Theory, chapter 5, has the fold of a cycle in smooth systems.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..checks import pick
from ..cycles.attractors import sticks
from ..cycles.chains import Chain
from ..cycles.closure import closure, multiplier_and_slopes
from ..cycles.orbits import first_loop, loop_of
from ..cycles.shooting import meshed
from ..model.equilibria import Equilibria, EquilibriumKind, candidates
from ..model.oscillator import Oscillator
from ..numerics.compiling import each, jit
from ..numerics.continuation import Stop
from ..results import Status
from .base import Line
from .conditions import AbstractCycleCondition
from .edge_rests import pseudo_hopf_limit
from .rests import hopf_limit
from .systems import CycleSystem, contact_tests, nearest_contacts, third_derivative

#: Number of starts whose first loops are compared. With 12 to 96 the same folds of a smooth law are
#: found, down to cycles of amplitude 0.03, in 11 to 32 ms.
STARTS = 48


class UnitMultiplier(CycleSystem):
    """A cycle with multiplier one; width: range of x1 of the guess."""

    chain: Chain
    width: Array

    def condition(self, osc, z, miss):
        return closure(osc, self.chain, z)[1] - 1

    def condition_and_slopes(self, osc_of, z, p, miss):
        along = jax.jacfwd(osc_of)(p)
        product, by_z, by_p = multiplier_and_slopes(osc_of(p), along, self.chain, z)
        return product - 1, (by_z, by_p, jnp.zeros_like(miss))

    def judge(self, osc, z, cycle, slope):
        # A cycle that has shrunk to the equilibrium has multiplier one too: a Hopf point.
        shrunk = jnp.ptp(z[:, 0]) < 0.2 * self.width
        other = (cycle.status == Status.OK) & ~(jnp.abs(slope - 1) < 1e-6)
        solved = (cycle.status == Status.OK) | (cycle.status == Status.NO_CONVERGENCE)
        fails = other | (shrunk & solved)
        return jnp.where(fails, Status.NO_FOLD.value, cycle.status), jnp.asarray(jnp.nan)

    def watch(self, osc, z, slope):
        sticks = self.chain.used & jnp.any(self.chain.codes == 0, axis=-1)
        nearest, _ = nearest_contacts(osc, self.chain, z, sticks)
        tests = contact_tests("FoldGrazing", nearest, jnp.ones(nearest.shape, bool))
        # Largest x1 minus its mean. Beyond an equilibrium the equations still have solutions, with
        # the largest and the smallest x1 exchanged.
        size = z[0, 0] - jnp.mean(z[:, 0], where=self.chain.used)
        return tests, size > 0, jnp.where(jnp.any(sticks), 0.0, slope)


class FoldOfCycles(AbstractCycleCondition):
    """Two cycles that do not stick, a stable and an unstable one, meet and vanish.

    Near a degenerate Hopf point, where both shrink to the equilibrium, small cycles are not found.
    In the tests' example cycles with x1_max - x1_min above 0.006 are found, from guesses about
    twice as far from the point as the point is from the Hopf point.
    """

    caption: ClassVar[str] = "fold of cycles"
    line: ClassVar[Line] = Line("fold of cycles", "#E69F00")
    #: Beyond a fold orbits pass the place of the cycles slowly, as if these existed.
    slow: ClassVar[bool] = True
    has_several: ClassVar[bool] = True
    ends_at_contact: ClassVar[bool] = True

    def guess(self, osc, size):
        return _extremal_loop(osc, candidates(osc), size)

    def system(self, osc, loop, status):
        chain, z = meshed(osc, loop)
        return UnitMultiplier(chain, jnp.ptp(z[:, 0])), z, status

    @classmethod
    def between(cls, before, after, edged):
        return [cls()] if before.smooth != after.smooth else []

    def beginnings(self, osc, cycles):
        return [*(one.loop for one in cycles if one.path and not sticks(one.path)), None]

    def limit(self, trail):
        """The point where the cycle has shrunk to an equilibrium.

        That is a degenerate Hopf or pseudo-Hopf point.
        """
        if trail.end is Stop.POINT_COUNT:
            return None
        limit = hopf_limit("DegenerateHopf", trail, third_derivative)
        return limit or pseudo_hopf_limit(trail)


@jit
def _extremal_loop(osc: Oscillator, rests: Equilibria, size: int):
    """A loop that nearly closes, as do its neighbours, near where two cycles meet; and a status.

    It is the first loop of an orbit whose growth is extremal among those of its neighbours; of
    several such loops the one that closes best. Near a fixed point with eigenvalues rate +- i
    frequency the growth tends to 2 pi rate/frequency, and has an extremum there that is only an
    effect of where loops begin: it differs from that limit by a term of second order in the rate.
    """
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
        # The neighbours of an extremum may stick, the extremum itself may not.
        extremal = (change[1:] * change[:-1] < 0) & ~sticks[1:-1]
        extremal = extremal & (jnp.abs(growth - limit) > 0.05 * jnp.abs(growth))[1:-1]
        at = 1 + jnp.argmin(jnp.where(extremal, jnp.abs(growth[1:-1]), jnp.inf))
        found = jnp.any(extremal)
        bracket = jnp.where(found, jnp.stack([distances[at - 1], distances[at + 1]]), bracket)
        return bracket, (pick(orbits, at), found)

    _, (orbits, found) = lax.scan(narrow, jnp.array([1e-3, 10.0]), None, length=2)
    orbit, found = pick((orbits, found), -1)
    status = jnp.where(jnp.any(eligible) & found, Status.OK.value, Status.NO_FOLD.value)
    return loop_of(orbit, size, len(osc.belts)), status
