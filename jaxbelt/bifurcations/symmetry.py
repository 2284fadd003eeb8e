"""Motions that are their own images, and how they lose this symmetry: `SymmetryBreaking`.

Where belts and forces look the same from both sides (x1 -> -x1, half of a period of the forcing
later) each motion has an image, which may be the motion itself. Along a branch of such symmetric
motions a multiplier may pass 1 though the branch does not turn back: a pitchfork, in which two
asymmetric motions leave, images of each other.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ..cycles.clocked import forcing_period
from ..cycles.periodic import PeriodicMotion, monodromy_of, periodic_from, state_near_start
from ..model.oscillator import Oscillator, at_time, constant_force
from ..results import Status
from .arc_rows import ArcRows
from .base import Line
from .forced import Beginning, UnitCircle
from .timed_systems import SYMMETRIC, OnBreakingSymmetry

#: Fractions of a period at which an oscillator is compared with its image, and the tolerance.
SAMPLED_PARTS, ROUNDING_OF_BELTS = (0.0, 0.13, 0.37, 0.71), 1e-12


class SymmetryBreaking(UnitCircle):
    """A multiplier of a symmetric motion is 1, and two asymmetric motions leave: a pitchfork.

    A motion is symmetric if its image under x1 -> -x1 is itself, half of its period later. It goes
    on through the point, stable on one side only.
    """

    caption: ClassVar[str] = "symmetry breaking"
    line: ClassVar[Line] = Line("symmetry breaking", "#CC79A7")
    parts: ClassVar = (1.0, -1.0, 1.0)

    def beginnings_of(self, osc, motion, known=False):
        motion = motion if known else symmetric_near(osc, motion)
        if motion is None:
            return
        values, vectors = np.linalg.eig(monodromy_of(osc, motion.chain, motion.unknowns))
        nearest = np.argmin(np.abs(values - 1))
        direction = np.real(vectors[:, nearest])
        direction = jnp.asarray(direction / np.linalg.norm(direction))
        yield Beginning(
            ArcRows.of(motion),
            float(np.abs(values[nearest] - 1)),
            lambda chain: OnBreakingSymmetry(chain, jnp.asarray(self.parts), direction),
        )


def asymmetry_of(osc: Oscillator, motion: PeriodicMotion) -> np.ndarray | None:
    """Sum of the states of a motion at the phase 0 and half of its period later, [2]; None for an
    even number of periods, as no symmetric motion has it."""
    half, odd = divmod(motion.periods, 2)
    if not odd:
        return None
    return np.asarray(motion.start) + state_near_start(osc, motion, 0.5, later=half)


def is_symmetric(osc: Oscillator, motion: PeriodicMotion) -> bool:
    """Whether a motion is its own image, half of its period later."""
    away = asymmetry_of(osc, motion)
    size = 1 + np.max(np.abs(np.asarray(motion.unknowns)[:, :2]))
    return away is not None and bool(np.max(np.abs(away)) < SYMMETRIC * size)


def symmetric_near(osc: Oscillator, motion: PeriodicMotion) -> PeriodicMotion | None:
    """The motion itself if it is symmetric, else the symmetric one between it and its image, or
    None."""
    away = asymmetry_of(osc, motion)
    if away is None or is_symmetric(osc, motion):
        return None if away is None else motion
    start = np.asarray(motion.start) - 0.5 * away
    found = periodic_from(osc, start, motion.periods, motion.chain.turns)
    fine = int(found.status) == Status.OK and found.periods == motion.periods
    return found if fine and is_symmetric(osc, found) else None


def image_of(osc: Oscillator, motion: PeriodicMotion) -> PeriodicMotion:
    """The image under x1 -> -x1 of a motion with an odd number of periods."""
    later = state_near_start(osc, motion, 0.5, later=motion.periods // 2)
    return periodic_from(osc, -later, motion.periods, motion.chain.turns)


def looks_the_same(osc: Oscillator, turns: int) -> bool:
    """Whether an oscillator is its own image half of a period of the forcing later."""
    period = float(forcing_period(osc, turns))
    for part in SAMPLED_PARTS:
        now, later = (at_time(osc, jnp.asarray((part + p) * period)) for p in (0.0, 0.5))
        pushes = [float(sum(constant_force(one))) for one in (now, later)]
        images = [_belt_or_image(belt, -1.0) for belt in later.belts]
        for belt in (_belt_or_image(belt, 1.0) for belt in now.belts):
            same = next((one for one in images if _is_equal_belt(belt, one)), None)
            if same is None:
                return False
            images.remove(same)
        if abs(sum(pushes)) > ROUNDING_OF_BELTS * (1 + abs(pushes[0])):
            return False
    return True


def _belt_or_image(belt, way: float) -> tuple:
    """Structure and numbers of a belt at an instant, or of its image (way -1), to compare."""
    edges = (belt.lower, belt.upper) if way > 0 else (-belt.upper, -belt.lower)
    law, structure = jax.tree.flatten(belt.friction)
    numbers = [way * belt.velocity, belt.load, *edges, *law]
    return structure, tuple(float(x) for leaf in numbers for x in np.ravel(leaf))


def _is_equal_belt(one: tuple, other: tuple) -> bool:
    numbers = np.array(one[1]), np.array(other[1])
    return one[0] == other[0] and np.allclose(
        *numbers, rtol=ROUNDING_OF_BELTS, atol=ROUNDING_OF_BELTS
    )
