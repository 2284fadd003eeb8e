"""Cycles that come from infinity: `HopfAtInfinity`.

Where loops far out neither grow nor shrink, see `model.far_out`, a cycle goes to infinity: it
separates motions that grow beyond all bounds from those that do not. It exists on the side of less
damping, and repels.

Such points are known as Hopf bifurcations at infinity: J. N. Glover, Hopf bifurcations at infinity,
Nonlinear Analysis 13 (1989) 1393-1398.
"""

from typing import ClassVar

import jax.numpy as jnp

from ..model.far_out import contraction_far_out, has_limit
from ..model.modes import any_of
from ..results import Status
from .base import Line
from .rests import NOTHING, AbstractRestCondition
from .systems import RestSystem


class FarOut(RestSystem):
    """Loops far out neither grow nor shrink: one equation, in the parameter alone."""

    @property
    def otherwise(self):
        return Status.NOT_TOUCHED

    def residual(self, osc, x):
        return contraction_far_out(osc)[None]

    def exists(self, osc, x):
        # Without any friction every loop is a cycle, and none comes from infinity.
        rubs = any_of([belt.load * belt.friction.static > 0 for belt in osc.belts])
        return rubs & jnp.all(jnp.stack([has_limit(belt.friction) for belt in osc.belts]))


class HopfAtInfinity(AbstractRestCondition):
    """An unstable cycle around all other motions comes from infinity, mostly where the damping is
    zero.

    On the side of less damping, motions that start outside of it grow beyond all bounds.
    """

    caption: ClassVar[str] = "Hopf at infinity"
    line: ClassVar[Line] = Line("Hopf at infinity", "#009E73", (0, (1, 1.2)))
    no_cycle: ClassVar[Status] = Status.NOT_FINITE
    ends_at_contact: ClassVar[bool] = True

    def guess(self, osc, size):
        return None

    def system(self, osc, guess):
        return FarOut(), NOTHING, jnp.asarray(Status.OK.value)

    @classmethod
    def between(cls, before, after, edged):
        return [cls()] if before.bounded != after.bounded else []
