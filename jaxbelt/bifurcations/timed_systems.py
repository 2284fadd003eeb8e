"""Systems of a periodic motion of a forced oscillator and one condition, see `forced`."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..cycles.chains import first_failure
from ..cycles.clocked import (
    TimedChain,
    arc_maps,
    guard_slope,
    monodromy,
    monodromy_and_slopes,
    states_at_phase,
    timed_blocks,
    timed_chain,
    timed_residual,
)
from ..cycles.periodic import (
    PeriodicMotion,
    extrema_of,
    motion_at,
)
from ..cycles.shooting import jacobian
from ..model.instants import guards_trend
from ..model.modes import capacity, mode_acceleration, mode_of
from ..model.oscillator import Oscillator, at_time
from ..results import Status
from .systems import PARTS_OF_ARC, AbstractChainSystem, Seen, Tests

#: A multiplier that is off by less is the one that the condition requires.
ON_CIRCLE = 1e-6
#: Motions count as symmetric up to this error, relative to their size.
SYMMETRIC = 1e-8
#: A motion arrives at a boundary, and does not only touch it, if |r'| is larger (own units).
ARRIVES = 1e-6


class TimedSystem(AbstractChainSystem):
    """A condition on a periodic motion; the unknowns are those of the motion, [N, 4]."""

    def condition(self, osc: Oscillator, z: Array) -> Array:
        """The expression that vanishes at a solution."""
        raise NotImplementedError

    def condition_and_slopes(self, osc_of: Any, z: Array, p: Array) -> Any:
        """The condition at the parameters p, and its derivatives by z and p."""
        return jax.value_and_grad(lambda z, p: self.condition(osc_of(p), z), (0, 1))(z, p)

    def judge(self, osc: Oscillator, motion: PeriodicMotion) -> Array:
        """The status of a solution."""
        return motion.status

    def residual(self, osc, x):
        value = timed_residual(osc, self.chain, x)
        return jnp.append(value.reshape(-1), self.condition(osc, x))

    def linearized(self, osc_of, x, p):
        osc, along = osc_of(p), jax.jacfwd(osc_of)(p)
        value, blocks = timed_blocks(osc, along, self.chain, x)
        last, (by_z, by_p) = self.condition_and_slopes(osc_of, x, p)
        by_parameter = blocks[..., 4:].reshape(-1, p.size)
        rows = jnp.concatenate([jacobian(blocks[..., :4]), by_parameter], axis=1)
        row = jnp.append(by_z.reshape(-1), by_p)
        return jnp.append(value.reshape(-1), last), jnp.concatenate([rows, row[None]])

    def seen_at(self, osc, x):
        error = jnp.max(jnp.abs(self.residual(osc, x)))
        motion = motion_at(osc, self.chain, x, error, jnp.asarray(0), jnp.asarray(0))
        exists = (motion.status == Status.OK) & (self.judge(osc, motion) == Status.OK)
        tests = self.tests(motion) | self.tests_anywhere(osc, x)
        return Seen(tests, exists, jnp.real(motion.multipliers[0]), error)

    def tests(self, motion: PeriodicMotion) -> Tests:
        """Functions to watch along a curve, see `Seen`."""
        return {(kind, ()): value for kind, value in unit_circle_tests(motion).items()}

    def tests_anywhere(self, osc: Oscillator, x: Array) -> Tests:
        """Functions to watch that have values even at solutions that are not admissible motions."""
        return {}

    def motion(self, osc: Oscillator, x: Any) -> PeriodicMotion:
        """The motion with the unknowns x of a solution, without its multipliers."""
        none = jnp.full(2, jnp.nan, complex)
        numbers = jnp.zeros(()), jnp.asarray(0), jnp.asarray(Status.OK.value)
        return PeriodicMotion(osc, self.chain, jnp.asarray(x), none, *numbers)

    def place(self, osc, x):
        return place_of_motion(self.motion(osc, x))

    def remeshed(self, osc, x):
        # The mesh has been cut by `refined`, and will be once more.
        size = self.chain.mesh.shape[-1] // PARTS_OF_ARC
        chain = self.chain
        chain, _ = timed_chain(osc, chain.loop(x), size, chain.turns, chain.share)
        return eqx.tree_at(lambda system: system.chain, self, chain).refined(osc, x)

    def error_of_steps(self, osc, x):
        values = self.chain.on_both_meshes(lambda chain: timed_residual(osc, chain, x))
        return jnp.max(jnp.abs(values[0] - values[1]), axis=-1)


class OnUnitCircle(TimedSystem):
    """parts[0] + parts[1] trace + parts[2] determinant of the monodromy matrix vanishes.

    parts: (1, 1, 1) a multiplier -1, (1, -1, 1) a multiplier 1, (-1, 0, 1) a determinant of 1.
    """

    chain: TimedChain
    parts: Array

    def _of(self, matrix: Array) -> Array:
        trace = matrix[0, 0] + matrix[1, 1]
        det = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
        det = jnp.where(self.chain.sticks, 0.0, det)
        return self.parts[0] + self.parts[1] * trace + self.parts[2] * det

    def condition(self, osc, z):
        return self._of(monodromy(osc, self.chain, z))

    def condition_and_slopes(self, osc_of, z, p):
        along = jax.jacfwd(osc_of)(p)
        matrix, by_z, by_p = monodromy_and_slopes(osc_of(p), along, self.chain, z)
        value, by_matrix = jax.value_and_grad(self._of)(matrix)
        contracted = functools.partial(jnp.tensordot, by_matrix, axes=2)
        return value, (contracted(by_z), contracted(by_p))

    def tests(self, motion):
        trace, det = _trace_and_determinant(motion)
        multipliers = unit_circle_tests(motion)
        on_fold, on_torus, on_doubling = (self.parts[1] == sign for sign in (-1, 0, 1))

        def on(wanted, value):
            return jnp.where(wanted, value, jnp.nan)

        return {
            ("PeriodDoubling", ()): on(on_fold, multipliers["PeriodDoubling"]),
            ("Fold", ()): on(on_doubling, multipliers["Fold"]),
            # Off torus curves one multiplier is 1 or -1: det = 1 where the other one equals it.
            ("Resonance1to1", ()): jnp.where(on_torus, trace - 2, on(on_fold, det - 1)),
            ("Resonance1to2", ()): jnp.where(on_torus, trace + 2, on(on_doubling, det - 1)),
            ("Resonance1to3", ()): on(on_torus, trace + 1),
            ("Resonance1to4", ()): on(on_torus, trace),
        }

    def judge(self, osc, motion):
        # A multiplier -1 or 1 if parts[1] is not 0, else a complex pair.
        wanted = jnp.where(self.parts[1] > 0, -1.0, 1.0)
        found = motion.multipliers
        is_there = jnp.min(jnp.abs(found - wanted.astype(complex))) < ON_CIRCLE
        is_pair = jnp.abs(jnp.imag(found[0])) > ON_CIRCLE
        fits = jnp.where(self.parts[1] == 0, is_pair, is_there)
        return first_failure(motion.status, fits, Status.OTHER_KIND)


class OnBreakingSymmetry(OnUnitCircle):
    """A symmetric motion has a multiplier 1, whose direction breaks the symmetry.

    Where symmetric and asymmetric motions meet, the equations of a motion are singular; those of a
    symmetric motion are not: of the last mismatch the component along `direction`, which vanishes
    by symmetry, is replaced by that of the asymmetry. direction: approximate direction of the state
    in which asymmetric motions leave, [2].
    """

    direction: Array

    def residual(self, osc, x):
        return self._of_symmetric(super().residual(osc, x), self._asymmetry(osc, x))

    def linearized(self, osc_of, x, p):
        value, matrix = super().linearized(osc_of, x, p)
        away, (by_x, by_p) = jax.value_and_grad(lambda x, p: self._asymmetry(osc_of(p), x), (0, 1))(
            x, p
        )
        rows = self._of_symmetric(matrix, jnp.append(by_x.reshape(-1), by_p))
        return self._of_symmetric(value, away), rows

    def judge(self, osc, motion):
        z = motion.unknowns
        whole = jnp.max(jnp.abs(timed_residual(osc, self.chain, z)[-1]))
        away = jnp.max(jnp.abs(asymmetry(osc, self.chain, z)))
        fits = jnp.maximum(whole, away) < SYMMETRIC * (1 + jnp.max(jnp.abs(z[:, :2])))
        fits = fits & (self._change_of_asymmetry(osc, z) > 1.0)
        return first_failure(super().judge(osc, motion), fits, Status.OTHER_KIND)

    def _change_of_asymmetry(self, osc: Oscillator, z: Array) -> Array:
        """Change of the asymmetry in the direction of the multiplier 1, relative to that of the
        start: 2 where asymmetric motions leave, 0 in a fold of symmetric ones."""
        maps = arc_maps(osc, self.chain, z)

        def times(moved, one):
            return one @ moved, moved

        last, entries = lax.scan(times, jnp.eye(3), maps)
        off = last[:2, :2] - jnp.eye(2)
        rows = jnp.stack([-off[:, 1], off[:, 0]], axis=1)
        along = rows[jnp.argmax(jnp.sum(rows**2, axis=1))]
        moved = jnp.pad(entries[:, :, :2] @ along, ((0, 0), (0, 1)))
        found = jax.jvp(lambda z: asymmetry(osc, self.chain, z), (z,), (moved,))[1]
        return jnp.linalg.norm(found) / jnp.linalg.norm(along)

    def _asymmetry(self, osc: Oscillator, z: Array) -> Array:
        return jnp.dot(self.direction, asymmetry(osc, self.chain, z))

    def _of_symmetric(self, rows: Array, row: Array) -> Array:
        at = self.chain.ends.size * 4 - 4
        across = self.direction[0] * rows[at + 1] - self.direction[1] * rows[at]
        return rows.at[at].set(across).at[at + 1].set(row)


class Touching(TimedSystem):
    """r = 0 at the end of the arc `row`, which is an extremum: r' = 0."""

    chain: TimedChain
    row: Array
    belt: Array

    def condition(self, osc, z):
        y = z[self.row + 1]
        velocities = jnp.stack([belt.velocity for belt in at_time(osc, y[2]).belts])
        return velocities[self.belt] - osc.omega * y[1]


class AtLimit(TimedSystem):
    """The needed force of stuck belts equals their capacity at the end of the arc `row`.

    codes: contact codes of the mode in which they stick; rises: 1 if the size of the needed force
    has to rise there, -1 if it has to fall, 0 for either.
    """

    chain: TimedChain
    row: Array
    codes: Array
    rises: Array

    def condition(self, osc, z):
        y, mode = z[self.row + 1], mode_of(self.codes)
        now = at_time(osc, y[2])
        return jnp.abs(mode_acceleration(now, mode, y[0], y[1])) - capacity(now, mode)

    def tests_anywhere(self, osc, x):
        # Where the needed force neither rises nor falls, crossing turns into switching.
        rate, arrives_at = self._rate(osc, x), self.chain.ends[self.row]
        turns_into = {"SwitchingSliding": self.rises > 0, "CrossingSliding": self.rises < 0}
        return {
            (kind, (belt,)): jnp.where(does & (arrives_at == belt), rate, jnp.nan)
            for kind, does in turns_into.items()
            for belt in range(self.codes.size)
        }

    def _rate(self, osc: Oscillator, z: Array) -> Array:
        """Rate of change of |needed force| - capacity."""
        at = guards_trend(osc, mode_of(self.codes), z[self.row + 1])
        return -jnp.where(at.value[-2] < at.value[-1], at.slope[-2], at.slope[-1])

    def judge(self, osc, motion):
        y, rises = motion.unknowns[self.row + 1], self._rate(osc, motion.unknowns)
        # A motion that only touches the boundary grazes it, which is another condition.
        codes, end = motion.chain.codes[self.row], motion.chain.ends[self.row]
        arrives = (self.rises == 0) | (guard_slope(osc, codes, end, y) < -ARRIVES)
        fits = (self.rises * rises >= 0) & arrives
        return first_failure(motion.status, fits, Status.OTHER_KIND)


def unit_circle_tests(motion: PeriodicMotion) -> dict[str, Array]:
    """Functions that vanish where multipliers cross the unit circle, by the kind of the point."""
    trace, det = _trace_and_determinant(motion)
    is_pair = jnp.imag(motion.multipliers[0]) != 0
    torus = jnp.where(is_pair, det - 1, jnp.nan)
    return {"PeriodDoubling": 1 + trace + det, "Fold": 1 - trace + det, "Torus": torus}


def asymmetry(osc: Oscillator, chain: TimedChain, z: Array) -> Array:
    """Sum of the states at the beginning of a chain of an odd number of periods and half of its
    duration later, [2]; zero if the motion is its own image under x1 -> -x1, half of it later."""
    share = jnp.zeros(()) if chain.share is None else chain.share
    later = states_at_phase(osc, chain, z, (share + 0.5) % 1.0)
    passes = ~jnp.isnan(later[:, 0])
    middle = (jnp.sum(passes) - 1) // 2
    is_half_way = passes & (jnp.cumsum(passes) - 1 == middle)
    half_way = jnp.where(is_half_way[:, None], later, 0.0)
    return z[0, :2] + jnp.sum(half_way, axis=0)


def _trace_and_determinant(motion: PeriodicMotion) -> tuple[Array, Array]:
    """Trace and determinant of the monodromy matrix, from the multipliers."""
    return jnp.real(jnp.sum(motion.multipliers)), jnp.real(jnp.prod(motion.multipliers))


def place_of_motion(motion: PeriodicMotion) -> np.ndarray:
    """Smallest and largest x1, the same of x2, and the period, [5]."""
    if int(motion.status) != Status.OK:
        return np.full(5, np.nan)
    return np.append(np.asarray(extrema_of(motion)), float(motion.period))
