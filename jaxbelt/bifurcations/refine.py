"""Bifurcation points refined by Newton's method: `refine`."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..checks import require
from ..model.oscillator import Oscillator, check_oscillator
from ..model.parameters import leaf_index
from .conditions import AbstractCondition, BifurcationPoint


def refine(
    condition: AbstractCondition,
    osc: Oscillator,
    *,
    where: Callable[[Oscillator], Any],
    max_arcs: int | None = None,
) -> BifurcationPoint:
    """The bifurcation point near an oscillator, by Newton's method with exact derivatives.

    condition: `Hopf()`, `NonsmoothFold(belt)`, `GrazingSliding(belt)`, `SlidingExchange(belts)`,
    `CrossingSliding(belt)`, `SuddenSliding(belt)`, `BeltAtRest(belt)`, `FoldOfCycles()`, or of a
    belt with a contact edge `GrazingEdge(belt)`, `CornerCollision(belt)`,
    `BoundaryEquilibrium(belt)` or `PseudoHopf(belt)`; or one of your own. osc: a rough guess, on
    either side of the point. where: selects the parameter that is varied, such as
    `lambda osc: osc.belts[0].velocity`. max_arcs: room for the arcs of one loop (default
    16; where edges are passed 32).

    Works under `jax.vmap` (a thousand points of a curve in one call) and `jax.jit`; `value` and
    `cycle` are differentiable with respect to the other parameters. A guess that leads to no such
    point gives a status that says why, and NaN. `ValueError` names an impossible argument.
    """
    require(isinstance(condition, AbstractCondition), "condition", "such as jb.Hopf()", condition)
    check_oscillator(osc)
    condition.check(osc)
    # Parameter and belts are data: the same programs serve all of them.
    index = jnp.asarray(np.array(leaf_index(osc, where)))
    return condition.point(osc, index, max_arcs or condition.room)
