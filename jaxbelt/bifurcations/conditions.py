"""Conditions on a cycle, and the base classes for a user's own condition.

`AbstractCycleCondition` has what conditions on a cycle have in common, as
`rests.AbstractRestCondition` has for a state of rest; `AbstractStickCondition` allows for two belts
that act together all along. A functional of an attracting cycle that has a given value is a
`CycleEquation`, for which a class with one method is enough.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import require_one_float, traceable
from ..cycles.chains import SIZES, Chain, Loop, cut
from ..cycles.cycle import Cycle, cycle_of
from ..cycles.shooting import ARC_STEPS, meshed
from ..model.families import Family
from ..model.oscillator import Oscillator
from ..numerics.compiling import jit
from ..results import Status
from .base import AbstractCondition, point_of
from .base import Line as Line  # for users' own conditions
from .guesses import nearest
from .systems import CycleSystem, Tests, solve_system


class AbstractCycleCondition(AbstractCondition):
    """A condition on a cycle. Its guess is a loop near the cycle, and a status."""

    #: Number of arcs that `system` may add to a loop.
    more_arcs: ClassVar[int] = 0

    @abc.abstractmethod
    def guess(self, osc: Oscillator, size: int) -> tuple[Loop, Array]:
        """A loop near the cycle, in `size` arcs, and a status."""

    @abc.abstractmethod
    def system(
        self, osc: Oscillator, loop: Loop, status: Array
    ) -> tuple[CycleSystem, Array, Array]:
        """The system of the cycle near a loop, its unknowns there, and a status; it is compiled."""

    def prepared(self, osc, guess):
        return _prepared(self, osc, *guess)

    def point_near(self, family, system, x, p, status):
        return _solved_point(family, system, x, p, status)

    def guess_near(self, beginning):
        return cut([beginning], more=self.more_arcs)[0], jnp.asarray(Status.OK.value)

    def beginnings(self, osc, cycles):
        return [one.loop for one in cycles]

    def system_at(self, point):
        chain = point.cycle.chain
        loop = chain.loop(point.cycle.unknowns)
        ok, data = jnp.asarray(Status.OK.value), self.sought.as_data()
        system, x, _ = _prepared(data, point.oscillator, loop, ok)
        # The integration steps are those with which the point was found.
        return eqx.tree_at(lambda system: system.chain.mesh, system, chain.mesh), x


@jit
def _prepared(condition: AbstractCycleCondition, osc: Oscillator, loop: Loop, status: Array):
    osc = lax.stop_gradient(osc)
    system, x, status = condition.system(osc, loop, status)
    return system.refined(osc, x), x, status


@jit
def _solved_point(family: Family, system: CycleSystem, z0, p0, status):
    """The solution near a guess (z0, p0) of the unknowns; one program serves a kind of system."""
    solution = solve_system(family, system, z0, p0, status)
    osc, z = family.at(solution.p), solution.z
    numbers = solution.iterations, solution.status, solution.residual
    cycle, slope = cycle_of(osc, system.ordinary, z, *numbers)
    status, multiplier = system.judge(osc, z, cycle, slope)
    return point_of(family, solution, cycle, multiplier, status), (z, solution.p)


class AbstractStickCondition(AbstractCycleCondition):
    """A condition on how a cycle begins, or ends, to stick to a belt.

    If two belts have one velocity and equal contacts all along, a point of one is one of the other.
    """

    belt: int | Array

    def covers(self, point):
        if super().covers(point):
            return True
        named = point.condition
        if not isinstance(named, AbstractStickCondition) or type(self) is not type(named):
            return False
        pair = np.array([self.belt, named.belt])
        one, other = (float(point.oscillator.belts[belt].velocity) for belt in pair)
        return one == other and bool(_touch_alike(point.cycle.chain, pair))


@jit
def _touch_alike(chain: Chain, pair: Array) -> Array:
    """Whether two belts have equal contacts in all arcs, so that the same happens to both."""
    one, other = chain.codes[:, pair].T
    return jnp.all((one == other) | ~chain.used)


class CycleEquation(AbstractCycleCondition):
    """A functional of an attracting cycle has a given value: one more equation for its unknowns.

    The guess is the cycle with the smallest error. `scan` looks for the condition if asked to, by
    the sign of the equation in each attracting cycle.
    """

    @abc.abstractmethod
    def equation(self, osc: Oscillator, chain: Chain, z: Array) -> Array:
        """Returns the expression that vanishes.

        z: unknowns of the cycle, (x1, x2, duration) of each arc, [N, 3]. Rows outside of
        `chain.used` are padding, with a duration of zero.
        """

    def check(self, osc):
        super().check(osc)
        field, arcs = f"equation of {type(self).__name__}", SIZES[0]

        def shaped(*shape: int, dtype: Any = float) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct(shape, dtype)

        def equation(osc: Oscillator, z: Array, *columns: Array) -> Array:
            return data.equation(osc, Chain(*columns), z)

        def value() -> Any:
            columns = shaped(arcs, len(osc.belts)), shaped(arcs, dtype=int), shaped(arcs, ARC_STEPS)
            return jax.eval_shape(equation, osc, shaped(arcs, 3), *columns)

        data = self.as_data()
        found = traceable(value, field, "a function of the oscillator, the chain and the unknowns")
        require_one_float(found, field, "a function that returns one float64")

    def judge(self, osc: Oscillator, z: Array, cycle: Cycle, slope: Array) -> tuple[Array, Array]:
        """As `CycleSystem.judge`."""
        return cycle.status, jnp.asarray(jnp.nan)

    def watch(self, osc: Oscillator, chain: Chain, z: Array, slope: Array) -> Tests:
        """Functions to watch along its curve; slope: the multiplier of the cycle."""
        return {}

    def distance(self, osc: Oscillator, loop: Loop) -> Array:
        """Error of the equation for a loop."""
        return jnp.abs(self.equation(osc, *meshed(osc, loop)))

    def guess(self, osc, size):
        return nearest(osc, size, self)

    def system(self, osc, loop, status):
        chain, z = meshed(osc, loop)
        return _Equation(chain, self), z, status

    def mark(self, osc, cycles):
        misses = (float(_miss(self.as_data(), osc, loop)) for loop in cycles)
        return tuple(int(np.sign(np.nan_to_num(miss))) for miss in misses)


@jit
def _miss(condition: CycleEquation, osc: Oscillator, loop: Loop) -> Array:
    return condition.equation(osc, *meshed(osc, loop))


class _Equation(CycleSystem):
    chain: Chain
    of: CycleEquation

    def condition(self, osc, z, miss):
        return self.of.equation(osc, self.chain, z)

    def judge(self, osc, z, cycle, slope):
        return self.of.judge(osc, z, cycle, slope)

    def watch(self, osc, z, slope):
        return self.of.watch(osc, self.chain, z, slope), True, jnp.nan
