"""Bifurcation points near a guess: `refine`.

Newton's method starts from the guess. If it fails, or ends far away, the point is bracketed: the
search of `scan` is done on small intervals around the guess, from short to long.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..activity import announced
from ..checks import (
    as_finite,
    as_whole,
    is_concrete,
    require,
    require_outside_of_jit,
    require_value,
)
from ..cycles.cycle import warn_of_extrapolation
from ..model.oscillator import Oscillator, check_oscillator, has_clock
from ..model.parameters import leaf_index
from ..model.variations import Variation, varied
from ..numerics.compiling import compiled_beside, is_outermost
from ..results import Status
from .base import AbstractCondition, BifurcationPoint, given_point
from .conditions import AbstractCycleCondition
from .forced import forced_point
from .path import ParameterPath
from .scan import MOST_ATTEMPTS, more_exact, search

#: Points found in two ways count as one if their values differ by no more than this.
SAME_POINT = 1e-9
#: If Newton's method ends this near to the guess after a first step that is no longer than
#: SHORT_STEP, no nearer point is searched. Of three thousand guesses four led past the nearest
#: point to another one: 0.008, 0.018 and 0.029 away, after first steps of 0.4 and 0.5, and to a
#: corner 0.004 away beside another one.
QUITE_NEAR, SHORT_STEP = 0.05, 0.25
#: The limit in place of QUITE_NEAR after a longer first step, and for conditions that may have
#: several points close together: one fold of cycles was passed for another one 5e-4 farther off.
BESIDE_OTHERS = 1e-4
#: Reaches of the search on both sides of the guess, in order, and its number of intervals. All
#: distances here and above are in units of the parameter, see `Family.unit`.
REACHES, INTERVALS = (2e-3, 1.2e-2, 5e-2, 0.2), 15


@announced("refine")
def refine(
    condition: AbstractCondition,
    osc: Oscillator | Callable[..., Oscillator],
    *,
    where: Callable[[Oscillator], Any] | None = None,
    at: Any = None,
    start: Any = None,
    max_arcs: int | None = None,
) -> BifurcationPoint:
    """The bifurcation point near an oscillator, by Newton's method with exact derivatives.

    Newton's method follows one cycle: of the attracting ones at the guess the one that is nearest
    to the condition. So of points on coexisting cycles it need not find the nearest; `scan` finds
    all. Of several states of rest, as on two edges, all are solved for, and the nearest point (for
    a function the nearest along its tangent) is taken.

    Where Newton's method does not converge, the search of `scan` is done around the guess, up to
    0.2 to both sides, and the nearest point of that kind is taken, of any cycle. The same happens
    where it ends farther from the guess than 0.05, or than 1e-4 after a first step of more than
    0.25 and for folds of cycles and conditions on edges (in units of the parameter). This takes
    some tenths of a second to two seconds rather than milliseconds.

    Works under `jax.vmap` (a thousand points of a curve in one call) and `jax.jit`, without the
    second search. `value` and `cycle` are differentiable with respect to the other parameters.

    For forced oscillators the conditions are those on a periodic motion: `PeriodDoubling()`,
    `Fold()`, `SymmetryBreaking()`, `Torus()`, `GrazingSliding(belt)`, `CrossingSliding(belt)`,
    `SwitchingSliding(belt)`, `AddingSliding(belt)`, `GrazingEdge(belt)` and
    `CornerCollision(belt)`. The nearest point is taken; not under `jax.vmap` and `jax.jit`.

    Args:
        condition: `Hopf()`, `NonsmoothFold(belt)`, `GrazingSliding(belt)`,
            `SlidingExchange(belts)`, `CrossingSliding(belt)`, `SuddenSliding(belt)`,
            `BeltAtRest(belt)`, `FoldOfCycles()`, `HopfAtInfinity()`; for a belt with a contact edge
            `GrazingEdge(belt)`, `CornerCollision(belt)`, `BoundaryEquilibrium(belt)`,
            `PseudoHopf(belt)` or `SaddleConnection(belt)`; for two such belts `EdgeExchange(belts)`
            or `MeetingEdges(belts)`; or your own condition.
        osc: A rough guess, on either side of the point; or a function of the parameter that returns
            the oscillator and that JAX can differentiate.
        where: Selects the parameter that is varied, such as `lambda osc: osc.belts[0].velocity`;
            None with a function.
        at: With a function: the value of the parameter to begin from.
        max_arcs: Room for the arcs of one loop (default 16; 32 where edges are passed).
        start: For a forced oscillator only: the motion to begin from, or a start (x1, x2) at t = 0
            that leads to it; None: the motions to which some starts lead. Of a motion with an even
            number of periods the motion with half as many, which it may have left, is tried, too.

    Returns:
        The `BifurcationPoint`. Without a point near the guess its status says why, and its value is
        NaN; where something changes nearby that no condition explains, `sides` says what there is
        below and above.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    fits = isinstance(condition, AbstractCondition)
    require_value(fits, "condition", "such as jb.Hopf()", condition)
    room = None if max_arcs is None else as_whole(max_arcs, "max_arcs")
    variation, near, value = _begun(condition, osc, where, at)
    if has_clock(near):
        hint = "points of forced oscillators are not for jit or vmap"
        require_outside_of_jit("refine", hint, osc=osc, at=at, start=start)
        return given_point(forced_point(condition, variation, value, start), variation)
    # Points of cycles take long to compile, and many are bracketed afterwards: both programs are
    # compiled side by side.
    of_cycle = isinstance(condition, AbstractCycleCondition)
    ahead = [partial(_label_near, condition, variation, value)] if of_cycle else []
    with compiled_beside("refine", (condition, near, value), ahead):
        point = condition.point(variation, near, value, room or condition.room)
    if not is_outermost(near, value, point):
        return given_point(point, variation)
    point = more_exact(_bracketed(point, variation, value), variation)
    point = given_point(point, variation)
    warn_of_extrapolation([point.cycle])
    return point


def _bracketed(point: BifurcationPoint, variation: Variation, value: Any) -> BifurcationPoint:
    """The point, or one of its kind that is nearer to the guess, from the search of `scan`."""
    condition, guess = point.condition, float(value[0])
    if int(point.status) == Status.DEGENERATE:
        return point
    unit = float(variation.family(np.asarray(value)).unit)
    away = _away(point, guess)
    is_direct = bool(np.asarray(point.steps)[0] <= SHORT_STEP) and not condition.has_several
    if away <= unit * (QUITE_NEAR if is_direct else BESIDE_OTHERS):
        return point
    attempts, unexplained = 0, []
    for reach in (unit * each for each in REACHES):
        path = _path_near(condition, variation, guess, min(reach, away))
        if path is None:
            break
        # near=1.0: points are solved for from any interval, as these paths are short.
        path.attempts = attempts
        searched = search(path, INTERVALS, near=1.0, known=unexplained)
        attempts = path.attempts
        unexplained += [one for one in searched if int(one.status) == Status.UNEXPLAINED]
        found = [one for one in searched if int(one.status) == Status.OK]
        # The search may report the point as one of another kind, or of the other one of two belts
        # with one velocity, or only one of two points that are close together.
        values = [
            float(one.value)
            for one in found
            if condition.has_several
            or (isinstance(one.condition, type(condition)) and not condition.covers(one))
        ]
        values += [beside for value in values for beside in path.beside(value)]
        within = (value for value in values if path.first <= value <= path.last)
        also = (condition.named_point_from(variation, value) for value in within)
        found += [one for one in also if one is not None]
        # A point beyond the reach does not count: others, not searched yet, may be nearer.
        of_kind = [one for one in found if condition.covers(one) and _away(one, guess) <= reach]
        if of_kind:
            nearest = min(of_kind, key=lambda one: _away(one, guess))
            nearest = more_exact(nearest, variation)
            is_nearer = _away(nearest, guess) < away - unit * SAME_POINT
            return replace(nearest, condition=condition) if is_nearer else point
        if away <= reach or attempts > MOST_ATTEMPTS:
            break
    if int(point.status) != Status.OK and unexplained:
        nearest = min(unexplained, key=lambda one: abs(float(one.value) - guess))
        return replace(point, sides=nearest.sides)
    return point


def points_within(
    condition: AbstractCondition, variation: Variation, guess: float, reach: float
) -> list[BifurcationPoint]:
    """The points of the condition that the search of `scan` finds up to `reach` on both sides of a
    guess; for oscillators without forcing."""
    path = _path_near(condition, variation, guess, reach)
    found = [] if path is None else search(path, INTERVALS, near=1.0)
    return [one for one in found if int(one.status) == Status.OK and condition.covers(one)]


def _path_near(
    condition: AbstractCondition, variation: Variation, guess: float, reach: float
) -> ParameterPath | None:
    """The path up to `reach` on both sides of the guess, as far as oscillators are possible."""
    ends = (guess + side * reach for side in (-1, 1))
    first, last = (_possible(variation, guess, end) for end in ends)
    return ParameterPath(variation, None, (first, last), [condition]) if first < last else None


def _label_near(condition: AbstractCondition, variation: Variation, value: Any) -> None:
    """Labels the guess, which compiles the program that `_bracketed` needs."""
    path = _path_near(condition, variation, float(value[0]), REACHES[0])
    if path is not None:
        path.find_labels([float(value[0])])


def _away(point: BifurcationPoint, guess: float) -> float:
    return abs(float(point.value) - guess) if int(point.status) == Status.OK else np.inf


def _possible(variation: Variation, guess: float, end: float) -> float:
    """`end`, or a value nearer to the guess, where the oscillator is possible; else the guess."""
    for _ in range(8):
        try:
            variation.check(end)
        except ValueError:
            end = 0.5 * (guess + end)
        else:
            return end
    return guess


def _begun(
    condition: AbstractCondition, osc: Any, where: Any, at: Any
) -> tuple[Variation, Oscillator, Any]:
    """The variation, and the oscillator and the value, [1], to begin from, in own units."""
    if isinstance(osc, Oscillator) or not callable(osc):
        require_value(at is None, "at", "left out where osc is an Oscillator", at)
        check_oscillator(osc)
        number = leaf_index(osc, where)
        condition.check(osc)
        value = jnp.asarray(jax.tree.leaves(osc)[number], dtype=jnp.float64).reshape(1)
        variation = Variation.of_leaves(osc, [number]).in_own_units(lax.stop_gradient(value))
        own = variation.own.of(osc)
        return variation, own, value / variation.own.parameters
    require_value(
        where is None, "where", "left out where osc is a function of the parameter", where
    )
    require(at is not None, "at", "the value of the parameter to begin from", "None")
    at = as_finite(at, "at")
    variation = varied(osc, where, (at,), forced=True)
    if is_concrete(at):
        variation.check(float(at))
    value = at.reshape(1)
    condition.check(variation.oscillator(value))
    variation = variation.in_own_units(lax.stop_gradient(value))
    value = value / variation.own.parameters
    return variation, variation.oscillator(value), value
