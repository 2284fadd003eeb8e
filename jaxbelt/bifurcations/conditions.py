"""What all conditions share: the base class and `BifurcationPoint`."""

import functools
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..checks import is_concrete, number
from ..cycles.cycle import (
    NEWTON_STEPS,
    SIZES,
    Chain,
    Cycle,
    Ends,
    cycle_of,
)
from ..model.oscillator import Oscillator
from ..model.parameters import parameter, vary
from ..numerics.compiling import jit
from ..results import Status, describe
from .systems import accuracy, solve_system


class AbstractCondition(eqx.Module):
    """What is to happen at a bifurcation point."""


class BeltCondition(AbstractCondition):
    """What is to happen at one belt."""

    belt: int = eqx.field(static=True)


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


@jit
def solved_point(osc, index, system, z0, status, judge) -> BifurcationPoint:
    """Solve; judge(osc, z, cycle, slope), slope the cycle's multiplier with stick phases left out,
    gives the status and the multiplier to be told. It carries its data with it, as `eqx.Partial`:
    one program serves a kind of system."""
    p0 = lax.stop_gradient(parameter(osc, index)[None])
    # Without a guess Newton's method ends at once.
    z0 = jnp.where(status == Status.OK, z0, jnp.nan)
    z, p, steps, matrix = solve_system(osc, index, system, z0, p0)
    iterations = jnp.sum(~jnp.isnan(steps))
    at_point = vary(osc, index, p)
    # By the last steps: the residual costs an integration more, and who asks for it gets it.
    last, before = steps[jnp.maximum(iterations - 1, 0)], steps[jnp.maximum(iterations - 2, 0)]
    converged = (status != Status.OK) | (last * jnp.minimum(last / before, 1.0) < 1e-9)
    status = jnp.where(converged, status, Status.NO_CONVERGENCE.value)
    size, error = accuracy(*lax.stop_gradient((at_point, system, z, matrix)))
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


def point_without_cycle(osc, index, p, steps, size, error, status, why):
    """A point of an equilibrium; why: the status of its cycle."""
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
    point = point_without_cycle(
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
