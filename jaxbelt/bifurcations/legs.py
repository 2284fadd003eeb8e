"""Legs of a branch of forced motions: motions with one signature along a parameter, `MotionLeg`.

With a fixed signature a branch is a curve in the unknowns of its motions and the parameter, which
pseudo-arclength continuation follows, around folds too; see `branches`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..cycles.clocked import TimedChain, timed_blocks
from ..cycles.periodic import (
    PeriodicMotion,
    begun_off_events,
    motion_at_unknowns,
    state_at_phase_0,
)
from ..cycles.shooting import jacobian
from ..model.families import Family
from ..model.own_units import OwnOscillator, in_own_units
from ..model.variations import Variation
from ..numerics.continuation import Corrected
from .systems import WEIGHT
from .tracks import corrected_among

#: Length of the step along a tangent over which `_course` takes differences.
SHORT_WAY = 1e-6


class MotionRow(NamedTuple):
    """A motion of a branch and its value of the parameter."""

    value: float
    motion: PeriodicMotion


class MotionBranch(NamedTuple):
    """Motions along a branch; open_ends: values inside of the span at which it ends without a
    bifurcation point; is_closed: whether it comes back to its first motion."""

    rows: list[MotionRow]
    open_ends: list[float]
    is_closed: bool = False


class ForcedLine(NamedTuple):
    """The variation of a parameter from `first` to `last`; turns: see `TimedChain`; is_symmetric:
    whether its oscillators look the same from both sides, see `symmetry`."""

    variation: Variation
    first: float
    last: float
    turns: int
    is_symmetric: bool = False

    @property
    def length(self) -> float:
        return self.last - self.first

    def at(self, value: float) -> OwnOscillator:
        return in_own_units(self.variation.oscillator(np.array([value])))


class MotionLeg(NamedTuple):
    """Motions of one signature along a line: a curve u = (weights * unknowns, value / length)."""

    line: ForcedLine
    chain: TimedChain
    weights: Array

    @classmethod
    def of(cls, line: ForcedLine, row: MotionRow) -> tuple["MotionLeg", np.ndarray]:
        z = np.asarray(row.motion.unknowns)
        weights = WEIGHT / (1 + np.abs(z.reshape(-1)))
        u = np.append(weights * z.reshape(-1), row.value / line.length)
        return cls(line, row.motion.chain, jnp.asarray(weights)), u

    @classmethod
    def begun(cls, line: ForcedLine, row: MotionRow) -> tuple["MotionLeg", Corrected]:
        """The leg of a row, with a chain that begins off events, and u and the tangent at the row,
        if Newton's method finds them."""
        motion = begun_off_events(line.at(row.value), row.motion)
        leg, u = cls.of(line, row._replace(motion=motion))
        return leg, leg.corrected(u, np.eye(u.size)[-1], 0.0)

    def corrected(self, u: np.ndarray, tangent: np.ndarray, length: float) -> Corrected:
        """See `continuation.corrected`: the point of the leg `length` ahead of u."""
        units = np.array([self.line.length])
        args = self.chain, self.weights, jnp.asarray(units[0])
        given = _linearized_motion, args, units
        return corrected_among(self.line.variation, *given, u, tangent, length)

    def row(self, u: np.ndarray) -> MotionRow:
        z = jnp.asarray(u[:-1] / np.asarray(self.weights)).reshape(-1, 4)
        value = float(self.line.length * u[-1])
        return MotionRow(value, motion_at_unknowns(self.line.at(value), self.chain, z))

    def going_on(
        self, row: MotionRow, u: np.ndarray, tangent: np.ndarray
    ) -> tuple["MotionLeg", np.ndarray, np.ndarray]:
        """The leg with the weights and the integration steps of one of its rows, and u and the
        tangent of the row in these weights. Where an event has come near to the phase at which the
        chain begins, the chain is begun at another phase."""
        moved = row._replace(motion=begun_off_events(self.line.at(row.value), row.motion))
        if moved.motion is not row.motion:
            leg, begun = MotionLeg.begun(self.line, moved)
            if begun.found:
                same = leg._course(begun.u, begun.tangent) @ self._course(u, tangent) > 0
                return leg, begun.u, begun.tangent if same else -begun.tangent
        leg, u = MotionLeg.of(self.line, row)
        tangent = tangent * np.append(np.asarray(leg.weights / self.weights), 1.0)
        return leg, u, tangent / np.linalg.norm(tangent)

    def _course(self, u: np.ndarray, tangent: np.ndarray) -> np.ndarray:
        """Change of the state at the phase 0 and of the parameter along a tangent, [3]; it does not
        depend on the phase at which the chain begins."""
        ahead = u + SHORT_WAY * tangent
        return np.append(self.start(ahead) - self.start(u), ahead[-1] - u[-1])

    def start(self, u: np.ndarray) -> np.ndarray:
        """The state at the phase 0, [2], even where u is not an admissible motion."""
        z = jnp.asarray(u[:-1] / np.asarray(self.weights)).reshape(-1, 4)
        return state_at_phase_0(self.line.at(float(self.line.length * u[-1])), self.chain, z)


def _linearized_motion(
    u: Array, args: tuple[Family, TimedChain, Array, Array]
) -> tuple[Array, Array]:
    family, chain, weights, unit = args
    z, p = (u[:-1] / weights).reshape(-1, 4), unit * u[-1:]
    value, blocks = timed_blocks(family.at(p), jax.jacfwd(family.at)(p), chain, z)
    own = jacobian(blocks[..., :4]) / weights[None]
    return value.reshape(-1), jnp.append(own, unit * blocks[..., 4:].reshape(-1, 1), axis=1)
