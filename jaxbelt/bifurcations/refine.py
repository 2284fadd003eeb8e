"""Bifurcation points refined by Newton's method: `refine`, and the conditions that it solves.

A condition is one more equation, in one more unknown: the parameter. It is written so that the
whole system is regular at the point, which "stick duration of the cycle = 0" is not: solved for
the cycle at every parameter, the duration goes like a square root and Newton's method fails. In the
unknowns of fixed-signature shooting (see `cycles`) the same equation is harmless:

- `NonsmoothFold`, `GrazingSliding`: the arc before the stick phase meets the boundary tangentially,
  r = 0 and x2' = 0, which for a law without a jump is the very point of slip onset. That arc is
  followed backwards from the point of tangency, so trial solutions cannot overshoot. Both
  kinds are this same event. What tells them apart is the multiplier m of the cycle at the point
  with that stick arc left out. The return map has slope 0 where the
  cycle sticks and slope m where it does not: for m > 1 both its fixed points lie on one side and
  vanish together (fold); for m < 1, one lies on either side, and the cycle goes on (grazing). A
  cycle with another stick phase has m = 0. Where the law jumps, static > mu(0+), the stick phase
  that begins at the tangency lasts, and without it the orbit is another one: the return map jumps,
  m = inf, and the cycle ends there.
- `CrossingSliding`: the cycle arrives at a boundary r_k = 0 just at an end of the stretch of it on
  which the mass sticks. To one side of it the mass sticks, to the other the boundary is crossed:
  a crossing-sliding bifurcation (M. di Bernardo, C. Budd, A. Champneys, P. Kowalczyk,
  Piecewise-smooth Dynamical Systems, 2008). Linear in the unknowns, x1 = rest +- capacity.
- `SlidingExchange`: nu_i = nu_j, and a cycle that sticks to i or j. The friction of each mode keeps
  its sign, so the cycle with its signature fixed goes smoothly through the point.
- `SuddenSliding`: nu_k = 0, with the mass at rest on the belt, x2' = x2 = 0: an equilibrium lies on
  the boundary. No cycle can be an unknown here: as nu_k goes to zero the stick phase lasts ever
  longer, the slip arc takes ever longer to leave the equilibrium, and in the limit there is none.
- `BeltAtRest`: the same, if no cycle sticks to the belt: an equilibrium jumps.
- `Hopf`: trace zero at a fixed point (its determinant is always one).
- `FoldOfCycles`: the multiplier of a cycle that does not stick is one. There the equations of the
  cycle alone are singular; with this one, and the parameter, they are not. (A cycle that sticks
  has the multiplier zero and takes part in nonsmooth folds only.)
- `GrazingEdge`, `CornerCollision`: an arc of a cycle ends on a contact edge and in something else
  at once. With an extremum of x1, the orbit is tangent to the edge, x2 = 0; with a boundary r_k = 0
  or slip onset, it runs into the corner of that and the edge. To one side of the point the edge
  ends the arc, to the other that does: the equation is that the other's guard vanishes, which is
  linear in the unknowns. A cycle that passes the edge and turns back soon after has that
  excursion left out: with it the equation is of second order in the velocity at the edge.
- `BoundaryEquilibrium`: at rest on an edge, the force on one of its sides is zero, or as large as
  belts at rest there can hold: a fixed point, or the end of a segment, comes to lie on the edge.
- `PseudoHopf`: at a pseudo-focus the leading term by which loops grow or shrink is zero.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..checks import is_concrete, require
from ..cycles.cycle import (
    SIZES,
)
from ..model.oscillator import Oscillator, check_oscillator
from ..model.parameters import leaf_index
from .conditions import (
    AbstractCondition,
    BeltCondition,
    BifurcationPoint,
)
from .crossings import CrossingSliding, SlidingExchange, at_crossing, at_exchange
from .edges import CornerCollision, GrazingEdge, at_edge, at_edge_unstable
from .folds import FoldOfCycles, at_fold_of_cycles
from .rests import (
    BeltAtRest,
    BoundaryEquilibrium,
    Hopf,
    PseudoHopf,
    SuddenSliding,
    at_boundary_equilibrium,
    at_hopf,
    at_pseudo_hopf,
    at_rest,
    at_reversal,
)
from .tangencies import GrazingSliding, NonsmoothFold, at_tangency


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
    `BoundaryEquilibrium(belt)` or `PseudoHopf(belt)`. osc: a rough guess, on either side of the
    point. where: selects the parameter that is varied, such as
    `lambda osc: osc.belts[0].velocity`. max_arcs: room for the arcs of one loop (default
    16; where edges are passed 32).

    Works under `jax.vmap` (a thousand points of a curve in one call) and `jax.jit`; `value` and
    `cycle` are differentiable with respect to the other parameters. A guess that leads to no such
    point gives a status that says why, and NaN. `ValueError` names an impossible argument.
    """
    require(isinstance(condition, AbstractCondition), "condition", "such as jb.Hopf()", condition)
    check_oscillator(osc)
    n = len(osc.belts)
    belts = condition.belts if isinstance(condition, SlidingExchange) else (0, 0)
    belts = (condition.belt,) * 2 if isinstance(condition, BeltCondition) else belts
    for belt in belts:
        require(isinstance(belt, int) and 0 <= belt < n, "belt", f"0 to {n - 1}", repr(belt))
    solve = solver_of(condition)
    at_an_edge = solve in (at_edge, at_edge_unstable, at_boundary_equilibrium, at_pseudo_hopf)
    if at_an_edge and is_concrete(osc):
        ends = [osc.belts[belts[0]].lower, osc.belts[belts[0]].upper]
        require(np.any(np.isfinite(ends)), "belt", "one with a finite edge", repr(belts[0]))
    size = max_arcs or room_for(solve)
    # Parameter and belts are data: the same programs serve all of them.
    data = leaf_index(osc, where), belts, _SIDES.get(type(condition), 0.0)
    index, pair, wanted = (jnp.asarray(np.array(one)) for one in data)
    return replace(solve(osc, index, pair, wanted, size), condition=condition)


def room_for(solve: Callable) -> int:
    """Room for the arcs of one loop: passing edges takes more of them."""
    return SIZES[1] if solve in (at_edge, at_crossing) else SIZES[0]


#: What solves for a condition, if not `at_tangency`; and which of two kinds that finds is meant.
_SOLVERS = {
    Hopf: at_hopf,
    SlidingExchange: at_exchange,
    CrossingSliding: at_crossing,
    SuddenSliding: at_rest,
    BeltAtRest: at_reversal,
    FoldOfCycles: at_fold_of_cycles,
    GrazingEdge: at_edge,
    CornerCollision: at_edge,
    BoundaryEquilibrium: at_boundary_equilibrium,
    PseudoHopf: at_pseudo_hopf,
}
_SIDES = {NonsmoothFold: 1.0, GrazingSliding: -1.0, GrazingEdge: 1.0, CornerCollision: -1.0}


def solver_of(condition: AbstractCondition) -> Callable:
    """What solves for a condition."""
    if isinstance(condition, GrazingEdge) and condition.unstable:
        return at_edge_unstable
    return _SOLVERS.get(type(condition), at_tangency)
