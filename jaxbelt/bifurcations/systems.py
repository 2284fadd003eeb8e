"""Systems of a cycle and one condition, and Newton's method for them."""

import abc
import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..cycles.cycle import (
    Chain,
    Ends,
    jacobian,
    newton,
    residual,
    residual_and_blocks,
)
from ..model.oscillator import Oscillator
from ..model.parameters import vary

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


def velocity_of(osc: Oscillator, belt: int | Array) -> Array:
    """The velocity of a belt, by its number."""
    return jnp.stack([one.velocity for one in osc.belts])[belt]


class Encounter(System):
    """Two belts run at one velocity; if they are the same, an arc is tangent to its boundary."""

    chain: Chain
    belts: Array

    def condition(self, osc: Oscillator, z: Array, miss: Array) -> Array:
        difference = velocity_of(osc, self.belts[0]) - velocity_of(osc, self.belts[1])
        return jnp.where(self.belts[0] != self.belts[1], difference, miss)


@eqx.filter_custom_jvp
def solve_system(osc, index, system, z0, p0):
    """Unknowns, the parameter, the steps of Newton's method and the matrix of the last one."""

    def step(unknowns):
        value, matrix = system.linearized(functools.partial(vary, osc, index), *unknowns)
        change = jnp.linalg.solve(matrix, -value)
        return (change[:-1].reshape(z0.shape), change[-1:]), jnp.max(jnp.abs(value)), matrix

    solved = newton(step, (z0, p0))
    return (*solved.z, solved.lengths, solved.matrix)


@solve_system.def_jvp
def _(primals, tangents):
    osc, index, system, z0, p0 = primals
    z, p, steps, matrix = solve_system(osc, index, system, z0, p0)
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


def accuracy(osc: Oscillator, system: System, z: Array, matrix: Array):
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


def small_newton(equations, osc, unknowns):
    """Newton's method for a few equations(osc, unknowns).

    Returns the solution, its steps, its residual and the error of the last unknown.
    """

    def step(u):
        value = equations(lax.stop_gradient(osc), u)
        matrix = jax.jacfwd(lambda u: equations(lax.stop_gradient(osc), u))(u)
        return jnp.linalg.solve(matrix, -value), jnp.max(jnp.abs(value)), matrix

    solved = newton(step, lax.stop_gradient(unknowns))
    u = lax.stop_gradient(solved.z)
    # One more step carries the derivatives with respect to the other parameters.
    matrix = jax.jacfwd(lambda u: equations(osc, u))(u)
    value = equations(osc, u)
    u = u - jnp.linalg.solve(matrix, value)
    weights = jnp.linalg.solve(matrix.T, jnp.zeros(u.size).at[-1].set(1.0))
    error = 1e-15 * (1 + jnp.max(jnp.abs(u))) * jnp.sum(jnp.abs(weights))
    return u, solved.lengths, jnp.max(jnp.abs(value)), error
