"""Systems of equations of a motion and one condition, and Newton's method for them.

A `CycleSystem` has 3N + 1 equations: those of a cycle with a fixed signature, see `cycles`, and a
condition. A `RestSystem` has k + 1 equations in the k unknowns of a state of rest. With one more
unknown, a parameter, Newton's method finds a point; with two parameters the solutions are a curve,
which is followed. `seen_at` of both judges a solution: whether it is a motion that exists, and the
functions to watch along a curve.
"""

import abc
import functools
from collections.abc import Callable
from itertools import combinations
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..cycles.attractors import extent
from ..cycles.chains import Chain, after_each, first_failure, following_codes
from ..cycles.closure import passes_extremum
from ..cycles.cycle import Cycle, cycle_of
from ..cycles.shooting import jacobian, meshed, residual, residual_and_blocks
from ..model.families import Family
from ..model.modes import capacity, edge_guards, mode_acceleration, mode_of
from ..model.oscillator import Oscillator
from ..model.pseudofocus import derivatives_at_rest
from ..motion.arcs import Ends
from ..numerics.implicit import Equations, solution
from ..numerics.newton import HOLDS, STEP_ROUNDING, is_settled, newton, solve
from ..numerics.padding import longer
from ..results import Status

#: Weight of the unknowns of a cycle in the length of a step along a curve, beside the two
#: parameters; large unknowns count less, as durations of stick phases go to infinity where a belt
#: comes to rest. Of seven curves of class (b) one ends too early with a tenth of this weight; with
#: three times as much they take half as many points again.
WEIGHT = 0.1
#: Equations determine the parameter if its error, in its units, is smaller: at a double root it is
#: some 1e-7, and where the equations hold for all values of the parameter 1 and more.
DETERMINED = 1e-3
#: The integration steps of an arc are cut into PARTS_OF_ARC parts if their error in its equations,
#: relative to the motion, exceeds EXACT_ARC: beside a slow belt and under a steep law the error was
#: 1e-8, which moved the point by 1e-6, and 1e-15 with the parts.
PARTS_OF_ARC, EXACT_ARC = 8, 1e-13
#: The place, see `place_of`, where there is no motion to compare.
NOWHERE = np.full(5, np.nan)
#: Values of functions, by the name of the special point where each vanishes and its belts.
Tests = dict[tuple[str, tuple[int, ...]], Any]


class Seen(NamedTuple):
    """What is computed at a point of a curve.

    tests: values of the functions to watch; exists: whether the solution is a motion that exists;
    multiplier: of the cycle, or NaN; residual: the largest error in all equations; is_cut: whether
    an arc ends at every extremum of x2.
    """

    tests: Tests
    exists: Any
    multiplier: Any
    residual: Any
    is_cut: Any = True


class AbstractSystem(eqx.Module):
    """Equations in the unknowns of a motion, one more than there are unknowns."""

    def has_signature_of(self, other: "AbstractSystem") -> bool:
        """Whether both systems have one signature; False for states of rest, which have none."""
        return False

    @abc.abstractmethod
    def residual(self, osc: Oscillator, x: Array) -> Array:
        """The equations at the unknowns x, in one array."""

    @abc.abstractmethod
    def linearized(
        self, osc_of: Callable[[Array], Oscillator], x: Array, p: Array
    ) -> tuple[Array, Array]:
        """The residual at the parameters p, [k], and its Jacobian with respect to (x, p)."""

    @abc.abstractmethod
    def seen_at(self, osc: Oscillator, x: Array) -> Seen:
        """What is seen at a solution x."""

    @abc.abstractmethod
    def place(self, osc: Oscillator, x: np.ndarray) -> np.ndarray:
        """Place of the motion, as `attractors.place_of`; NaN where it is not to be compared."""

    @abc.abstractmethod
    def shaped(self, x: Array) -> Array:
        """The unknowns in their shape, from a flat array."""

    @abc.abstractmethod
    def weights(self, x: Array) -> Array:
        """Weight of each unknown in the length of a step along a curve."""

    @abc.abstractmethod
    def remeshed(self, osc: Oscillator, x: Array) -> "AbstractSystem":
        """The same system with new integration steps, if it has any."""


def velocity_tests(osc: Oscillator) -> Tests:
    """The velocities of the belts and their differences, which are watched on every curve."""
    velocities = [belt.velocity for belt in osc.belts]
    tests: Tests = {("BeltAtRest", (i,)): nu for i, nu in enumerate(velocities)}
    for (i, a), (j, b) in combinations(enumerate(velocities), 2):
        tests["EqualVelocities", (i, j)] = a - b
    return tests


# --- systems of a state of rest -------------------------------------------------------------------


class RestSystem(AbstractSystem):
    """k + 1 equations in the k unknowns of a state of rest, which are x1 or none."""

    @property
    def otherwise(self) -> Status:
        """Status of a solution for which `exists` is False."""
        return Status.NOT_ADMISSIBLE

    @abc.abstractmethod
    def exists(self, osc: Oscillator, x: Array) -> Array:
        """Whether a solution is a state of rest of this kind."""

    def tests(self, osc: Oscillator, x: Array) -> Tests:
        """Functions to watch along its curve."""
        return {}

    def x1(self, osc: Oscillator, x: Array) -> Array:
        """Displacement of the mass at rest, NaN where it is not known."""
        return x[0] if x.size else jnp.asarray(jnp.nan)

    def linearized(self, osc_of, x, p):
        def value(u):
            return self.residual(osc_of(u[x.size :]), u[: x.size])

        u = jnp.append(x, p)
        return value(u), jax.jacfwd(value)(u)

    def seen_at(self, osc, x):
        tests = {**velocity_tests(osc), **self.tests(osc, x)}
        error = jnp.max(jnp.abs(self.residual(osc, x)))
        return Seen(tests, self.exists(osc, x), jnp.asarray(jnp.nan), error)

    def place(self, osc, x):
        return NOWHERE

    def shaped(self, x):
        return x

    def weights(self, x):
        return jnp.ones(x.size)

    def remeshed(self, osc, x):
        return self


# --- systems of a closed chain of arcs ------------------------------------------------------------


class AbstractChainSystem(AbstractSystem):
    """A fixed signature and a condition; the unknowns are those of the arcs, [N, 3] or [N, 4]."""

    chain: eqx.AbstractVar[Any]

    @abc.abstractmethod
    def error_of_steps(self, osc: Oscillator, x: Array) -> Array:
        """The error of the integration steps in the equations of each arc at x, [N]."""

    def has_signature_of(self, other: AbstractSystem) -> bool:
        """Whether both have the same arcs, and conditions on the same arc, belt and edge."""
        if type(other) is not type(self):
            return False
        own, others = _numbers_in(self), _numbers_in(other)
        return all(map(np.array_equal, own, others))

    def shaped(self, x):
        return x.reshape(self.chain.ends.size, -1)

    def weights(self, x):
        return WEIGHT / (1 + jnp.abs(x.reshape(-1)))

    def refined(self, osc: Oscillator, x: Array) -> Any:
        """The same system with shorter integration steps on arcs that need them.

        The error of the steps in the equations at x decides; steps of length zero pad the other
        arcs.
        """
        mesh = self.chain.mesh
        fine = jnp.repeat(mesh / PARTS_OF_ARC, PARTS_OF_ARC, axis=-1)
        coarse = longer(mesh, fine.shape[-1], axis=-1, fill=0.0)
        is_exact = self.error_of_steps(osc, x) < EXACT_ARC * (1 + jnp.max(jnp.abs(x[:, :2])))
        mesh = jnp.where(is_exact[:, None], coarse, fine)
        return eqx.tree_at(lambda system: system.chain.mesh, self, lax.stop_gradient(mesh))


def _numbers_in(system: AbstractChainSystem) -> list[np.ndarray]:
    """The codes of the arcs, and all arrays of integers or booleans in a system."""
    numbers = [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(system, eqx.is_array))]
    return [np.asarray(system.chain.codes), *(one for one in numbers if one.dtype.kind in "biu")]


def third_derivative(osc: Oscillator, codes: Array, x1: Array) -> Array:
    """The third derivative of x2' by x2 at a fixed point."""
    return derivatives_at_rest(osc, mode_of(codes), x1)[3]


class CycleSystem(AbstractChainSystem):
    """A condition on a cycle; the unknowns are those of the cycle, [N, 3]."""

    @abc.abstractmethod
    def condition(self, osc: Oscillator, z: Array, miss: Array) -> Array:
        """The expression that vanishes; miss: error of tangent arcs, see `shooting.residual`."""

    def judge(self, osc: Oscillator, z: Array, cycle: Cycle, slope: Array) -> tuple[Array, Array]:
        """Status of a solution, and the multiplier to report; slope: multiplier with stick phases
        left out."""
        return cycle.status, jnp.asarray(jnp.nan)

    def watch(self, osc: Oscillator, z: Array, slope: Array) -> tuple[Tests, Any, Any]:
        """Functions to watch along its curve, whether the solution counts, and the multiplier to
        report."""
        return {}, True, jnp.nan

    def residual(self, osc, x):
        """The 3N + 1 equations at the unknowns z of the cycle, [N, 3]."""
        value, miss = residual(osc, self.chain, x)
        return jnp.append(value.reshape(-1), self.condition(osc, x, miss))

    def linearized(self, osc_of, x, p):
        osc, along = osc_of(p), jax.jacfwd(osc_of)(p)
        value, miss, blocks = residual_and_blocks(osc, along, self.chain, x)
        of_state, of_parameter = blocks[:, :, :3], blocks[:, :, 3:]
        last, (by_z, by_p, by_miss) = self.condition_and_slopes(osc_of, x, p, miss)
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

    def seen_at(self, osc, x):
        ok, error = jnp.asarray(Status.OK.value), jnp.max(jnp.abs(self.residual(osc, x)))
        cycle, slope = cycle_of(osc, self.ordinary, x, jnp.asarray(0), ok, error)
        tests, is_meant, multiplier = self.watch(osc, x, slope)
        exists = (cycle.status == Status.OK) & (error < HOLDS) & is_meant
        is_cut = ~passes_extremum(osc, self.chain, x)
        return Seen({**velocity_tests(osc), **tests}, exists, multiplier, error, is_cut)

    def place(self, osc, x):
        return extent(x[np.asarray(self.chain.used)])

    def remeshed(self, osc, x):
        chain, _ = meshed(osc, self.chain.loop(x))
        return eqx.tree_at(lambda system: system.chain, self, chain).refined(osc, x)

    def error_of_steps(self, osc, x):
        values, misses = self.chain.on_both_meshes(lambda chain: residual(osc, chain, x))
        error = jnp.max(jnp.abs(values[0] - values[1]), axis=-1)
        is_tangent = self.chain.ends >= Ends(self.chain.codes.shape[-1]).tangent
        return jnp.where(is_tangent, jnp.maximum(error, jnp.abs(misses[0] - misses[1])), error)


def stick_phase_from(osc: Oscillator, chain: Chain, row: Array) -> Array:
    """Mask, [arcs], of the stick phase that begins with the arc `row`; it has several arcs where it
    passes edges."""
    stuck = chain.used & jnp.any(chain.codes == 0, axis=-1)
    rows = jnp.arange(stuck.size)
    before = (rows - 1) % jnp.maximum(jnp.sum(chain.used), 1)
    phase, goes_on = rows == row, stuck & stuck[before]
    for _ in range(2 * len(osc.belts)):
        phase = phase | (goes_on & phase[before])
    return phase


def nearest_contacts(
    osc: Oscillator, chain: Chain, z: Array, sticks: Array, without: bool | Array = False
) -> tuple[Array, Array]:
    """Distance of a cycle from a change of its signature at each belt, and whether it sticks to the
    belt, [belts] each.

    The distance is the duration of the shortest stick phase, among the arcs of the mask `sticks`;
    without a stick phase it is r at the extremum of x2 nearest to the boundary. Where the cycle
    slips over a contact edge it is r there, if that is less: at zero the cycle meets edge and
    boundary at once. inf where none of these exists. without: belts that are ignored where arcs
    pass an edge, [arcs, belts].
    """
    n, without = len(osc.belts), jnp.broadcast_to(without, chain.codes.shape)
    following = after_each(chain, z)
    extrema = chain.used & (chain.ends == Ends(n).extremum_x2)
    passes = (chain.ends >= n) & (chain.ends < 3 * n)
    # The equations have solutions beyond a point to which the cycle shrinks, too, with entries on
    # the other side of the edge; these do not count.
    passes = passes & jax.vmap(functools.partial(_is_within, osc))(chain.codes, z[:, 0])
    after = following_codes(chain)
    nearest, stuck = [], []
    for belt, one in enumerate(osc.belts):
        own = sticks & (chain.codes[:, belt] == 0)
        shortest = jnp.min(jnp.where(own, z[:, 2], jnp.inf))
        r = one.velocity - osc.omega * following[:, 1]
        signs, signs_after = chain.codes[:, belt], after[:, belt]
        slips = jnp.abs(signs) == 1
        gap = jnp.min(jnp.where(extrema & slips, signs * r, jnp.inf))
        # Where the mass sticks before or after the edge it is on the boundary anyway.
        sign = jnp.where(slips, signs, signs_after)
        moves = passes & (signs != 0) & (signs_after != 0) & (jnp.abs(sign) == 1)
        moves = moves & ~without[:, belt]
        at_edge = jnp.min(jnp.where(moves, sign * r, jnp.inf))
        stuck.append(jnp.any(own))
        nearest.append(jnp.minimum(jnp.where(stuck[-1], shortest, gap), at_edge))
    return jnp.stack(nearest), jnp.stack(stuck)


def _is_within(osc: Oscillator, codes: Array, x1: Array) -> Array:
    """Whether x1 lies between the contact edges of a mode, or on one of them."""
    return jnp.min(jnp.stack(edge_guards(osc, mode_of(codes), x1))) >= -HOLDS


def contact_tests(name: str, nearest: Array, watched: Array) -> Tests:
    """The distances `nearest`, [belts], as tests of a name, NaN unless watched and finite."""
    known = jnp.where(watched & jnp.isfinite(nearest), nearest, jnp.nan)
    return {(name, (belt,)): known[belt] for belt in range(nearest.size)}


def nearest_edge(osc: Oscillator, chain: Chain, z: Array, without: bool | Array = False) -> Array:
    """Distance of a cycle from a change at a contact edge, NaN where there is none.

    The least distance of an extremum of x1, of a tangency to a boundary, or of a slip onset, from
    an edge of its mode; or the excess of the force over the holding force where an edge tears the
    mass off. without: arcs whose ends are ignored, [arcs].
    """
    n = chain.codes.shape[-1]
    kinds = Ends(n)
    following = after_each(chain, z)

    def distance(codes, end, after, y):
        gap = jnp.min(jnp.stack(edge_guards(osc, mode_of(codes), y[0])))
        relevant = (end == kinds.extremum_x1) | (end == kinds.onset) | (end >= kinds.tangent)
        torn = (codes == 0) & (jnp.abs(after) == 1) & (end >= n) & (end < 3 * n)
        held = mode_of(jnp.where(torn, 0.0, after))
        excess = jnp.abs(mode_acceleration(osc, held, y[0], y[1])) - capacity(osc, held)
        tears = jnp.any(torn) & jnp.all(after != 0)
        return jnp.where(relevant, gap, jnp.where(tears, excess, jnp.inf))

    columns = chain.codes, chain.ends, following_codes(chain), following
    asked = chain.used & ~jnp.asarray(without)
    nearest = jnp.min(jnp.where(asked, jax.vmap(distance)(*columns), jnp.inf))
    return jnp.where(jnp.isfinite(nearest), nearest, jnp.nan)


# --- Newton's method ------------------------------------------------------------------------------


class _InParameter(Equations):
    """The equations of a system in its own unknowns and one parameter, that in `Family.unit`."""

    system: Any

    def residual(self, given, z):
        own, p = z
        return self.system.residual(given.at(given.unit * p), own)

    def linearized(self, given, z):
        return self.system.linearized(lambda p: given.at(given.unit * p), *z)


class Solution(NamedTuple):
    """A solution of a system near a guess, by Newton's method.

    z: unknowns; p: parameter, [1]; steps: length of each step, NaN padded; iterations: number of
    steps; residual: the largest error in the equations; error: a bound on the error of p; status:
    that of the guess, where it was not OK, else whether the steps converged.
    """

    z: Array
    p: Array
    steps: Array
    iterations: Array
    residual: Array
    error: Array
    status: Array


def solve_system(family: Family, system: Any, z0, p0, status: Array) -> Solution:
    """The solution of a system near (z0, p0); status: of that guess."""
    # Without a guess Newton's method ends at once.
    z0 = jnp.where(status == Status.OK, z0, jnp.nan)
    unit = family.unit
    solved = solve(_InParameter(system), family, (z0, lax.stop_gradient(p0) / unit))
    z, p, steps = solved.z[0], unit * solved.z[1], solved.lengths
    iterations = jnp.sum(~jnp.isnan(steps))
    # Convergence is judged by the last steps: the residual costs an integration, not always needed.
    last, before = steps[jnp.maximum(iterations - 1, 0)], steps[jnp.maximum(iterations - 2, 0)]
    converged = is_settled(last, before, HOLDS) | (last < STEP_ROUNDING) | (status != Status.OK)
    status = jnp.where(converged, status, Status.NO_CONVERGENCE.value)
    at_point, system, at, matrix = lax.stop_gradient((family.at(p), system, z, solved.matrix))
    residual, error = _accuracy(at_point, system, at, matrix)
    return Solution(z, p, steps, iterations, residual, unit * error, status)


def _accuracy(osc: Oscillator, system: Any, z: Array, matrix: Array):
    """The largest residual, and a bound on the error of p, in its units.

    The bound is the effect on p of the residuals, with the integration steps as they are and with
    halved ones (by their sizes, as rounding has any sign), and of rounding in the unknowns.
    """

    def value(chain):
        return eqx.tree_at(lambda s: s.chain, system, chain).residual(osc, z)

    values = system.chain.on_both_meshes(value)
    weights = jnp.linalg.solve(matrix.T, jnp.zeros(values.shape[1]).at[-1].set(1.0))
    # Rounding of states and times; that of a long duration is multiplied by a small velocity.
    rounding = 2e-15 * (1 + jnp.max(jnp.abs(z[:, :-1]))) * jnp.sum(jnp.abs(weights))
    effect = jnp.max(jnp.abs(values) @ jnp.abs(weights))
    return jnp.max(jnp.abs(values[0])), 2 * effect + rounding


def judged_by(error: Array, family: Family, status: Array) -> Array:
    """The status of a point whose parameter has this error.

    DEGENERATE in place of OK where the equations hold and do not determine the parameter.
    """
    return first_failure(status, error < DETERMINED * family.unit, Status.DEGENERATE)


class _FewEquations(Equations):
    """function(given, units * u) in the unknowns u."""

    function: Callable = eqx.field(static=True)
    units: Array

    def residual(self, given, z):
        return self.function(given, self.units * z)


def small_newton(function, given, unknowns, unit: Any = 1.0):
    """Newton's method for a few equations, function(given, unknowns), differentiable by `given`.

    unit: of the last unknown. Returns the solution, its steps, its residual and the error of the
    last unknown.
    """
    units = jnp.ones(unknowns.size).at[-1].set(unit)
    equations, still = _FewEquations(function, units), lax.stop_gradient(given)

    def determined(u):
        return _determined(u, *equations.linearized(still, u))

    solved = newton(determined, lax.stop_gradient(unknowns) / units)
    u = solved.z
    # One more step, for the last digit.
    value, matrix = equations.linearized(still, u)
    change = jnp.linalg.solve(matrix, value)
    # Towards a multiple root steps shrink by a half or a third only.
    error = _rounding(u, matrix) + 2 * jnp.abs(change[-1])
    u = jnp.where(error < DETERMINED, solution(equations, given, u - change), u)
    return units * u, solved.lengths, jnp.max(jnp.abs(value)), unit * error


def _rounding(u: Array, matrix: Array) -> Array:
    """Effect of rounding on the last of the unknowns."""
    weights = jnp.linalg.solve(matrix.T, jnp.zeros(u.size).at[-1].set(1.0))
    return 1e-15 * (1 + jnp.max(jnp.abs(u))) * jnp.sum(jnp.abs(weights))


def _determined(u: Array, value: Array, matrix: Array) -> tuple[Array, Array]:
    """The equations; where they do not determine the parameter, changed so that the next Newton
    step leaves it unchanged.

    They do not determine it where they hold and the matrix is singular.
    """
    fails = ~(_rounding(u, matrix) < DETERMINED) & jnp.all(jnp.abs(value) < HOLDS)
    own = matrix.at[:, -1].set(0.0)
    normal = own.T @ own + 1e-14 * jnp.maximum(jnp.sum(own**2), 1.0) * jnp.eye(u.size)
    change = jnp.linalg.solve(normal, own.T @ value)
    return jnp.where(fails, change, value), jnp.where(fails, jnp.eye(u.size), matrix)
