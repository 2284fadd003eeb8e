"""Curves of solutions followed by pseudo-arclength: `continue_curve`. It knows no friction.

A residual R^(n+1) -> R^n that is regular vanishes along a curve. From a point u of it and its unit
tangent t, the kernel of the Jacobian, the next point is where the residual vanishes in the plane
that is normal to t at the distance of one step. Newton's method solves these n + 1 equations,

    F(v) = 0,    t . (v - u) = step,

which are regular where the curve turns round with respect to any of its coordinates, too. The
tangent comes from the exact Jacobian, the same one that Newton's method ends with. The step grows
where Newton's method is quick, and is halved where it is slow, fails, or the tangent turns by more
than an angle; that is the control of the error as well, for every point is a solution to rounding.
Along a regular curve the determinant of the n + 1 equations keeps its sign, so where it does not,
the step has gone over to another branch, and is halved, too.
"""

import enum
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..checks import as_finite, require
from .compiling import jit
from .newton import newton

#: Most Newton steps to correct a point; half as many are quick.
CORRECTIONS = 8
#: A correction of this size is rounding, in unknowns of size one and systems that amplify it.
SMALLEST_CORRECTION = 1e-12
#: Cosine of the largest angle between the tangents of two neighbours.
STRAIGHT = 0.95


class Stop(enum.Enum):
    """Why a curve ends where it does."""

    LEFT_SPAN = "it leaves the given span"
    STEP_TOO_SMALL = "no step is short enough for Newton's method"
    STOPPED = "the condition that it is of no longer holds"
    CLOSED = "it is closed, and back where it began"
    POINT_COUNT = "the number of points asked for is reached"


class CurvePoint(NamedTuple):
    """A point of a curve.

    u: the solution, [n + 1]; tangent: of unit length, in the direction of travel, [n + 1];
    iterations: Newton steps that it took; end: why the curve ends here, None where it goes on;
    orientation: sign of the determinant of the n + 1 equations.
    """

    u: np.ndarray
    tangent: np.ndarray
    iterations: int
    end: Stop | None
    orientation: float


def continue_curve(
    solve: Callable[..., "Corrected"],
    start: ArrayLike | tuple,
    direction: ArrayLike | tuple,
    *,
    span: tuple[Any, Any] | None = None,
    step: float = 0.01,
    min_step: float = 1e-8,
    max_step: float = 0.1,
    max_points: int = 1000,
) -> Iterator[CurvePoint]:
    """The points of the curve F(u) = 0 from near `start`, as they are found.

    solve: gives the point of the curve of (u, tangent, length), such as
    `functools.partial(corrected, linearized, args)`. start: a guess of the first point. direction:
    [n + 1]; of the two tangents there the curve follows the one at an acute angle to it. span:
    smallest and largest u, numbers or [n + 1]; the curve ends on the first side that it meets.
    step, min_step, max_step: lengths of the first, the shortest and the longest chord.

    The last point says why it is the last. Where Newton's method fails at the start there is no
    point. `ValueError` names an impossible argument.
    """
    u0 = as_finite(start, "start", (None,))
    way = as_finite(direction, "direction", u0.shape)
    require(np.any(np.asarray(way) != 0), "direction", "not zero", way)
    steps = (min_step, step, max_step)
    ordered = 0 < min_step <= step <= max_step
    require(ordered, "step", "such that 0 < min_step <= step <= max_step", steps)
    lower, upper = (-np.inf, np.inf) if span is None else span
    limits = np.broadcast_to(lower, u0.shape), np.broadcast_to(upper, u0.shape)

    first = solve(u0, way / np.linalg.norm(way), 0.0)
    if not first.found:
        return
    point = _point(first)
    for _ in range(max_points - 1):
        new, step = _next_point(solve, point, step, (min_step, max_step))
        if new is None:
            yield point._replace(end=Stop.STEP_TOO_SMALL)
            return
        leaves = np.any(new.u < limits[0]) or np.any(new.u > limits[1])
        if leaves:
            new = _at_limit(solve, point, new, limits)
            if new is None:
                yield point._replace(end=Stop.STEP_TOO_SMALL)
                return
        # A point that lies on the side already is the last one; it is not repeated.
        if not leaves or np.max(np.abs(new.u - point.u)) > SMALLEST_CORRECTION:
            yield point
        point = new
        if leaves:
            yield point._replace(end=Stop.LEFT_SPAN)
            return
    yield point._replace(end=Stop.POINT_COUNT)


def _point(solved: "Corrected") -> CurvePoint:
    iterations, orientation = int(solved.iterations), float(solved.orientation)
    return CurvePoint(solved.u, solved.tangent, iterations, None, orientation)


def _next_point(solve, point: CurvePoint, step: float, steps) -> tuple[CurvePoint | None, float]:
    """The next point, None where no step is short enough, and the step to try after it."""
    shortest, longest = steps
    while step >= shortest:
        solved = solve(point.u, point.tangent, step)
        turned = float(solved.tangent @ point.tangent)
        same_branch = float(solved.orientation) == point.orientation
        if solved.found and turned > STRAIGHT and same_branch:
            new = _point(solved)
            quick = new.iterations <= CORRECTIONS // 2 and turned > 0.5 * (1 + STRAIGHT)
            return new, min(longest, 1.5 * step if quick else step)
        step *= 0.5
    return None, step


def _at_limit(solve, point: CurvePoint, beyond: CurvePoint, limits) -> CurvePoint | None:
    """The point where the curve meets the first side of the span, from `point` to `beyond`; None
    where Newton's method fails."""
    # Newton's method in the plane of that side: its normal is along a coordinate.
    change, short, far = beyond.u - point.u, beyond.u < limits[0], beyond.u > limits[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        parts = (np.where(short, limits[0], limits[1]) - point.u) / change
    # A point on the side may be beyond it by rounding.
    parts = np.where(short | far, np.maximum(parts, 0.0), np.inf)
    axis = int(np.argmin(parts))
    guess = point.u + parts[axis] * change
    normal = np.zeros_like(guess)
    normal[axis] = np.sign(change[axis])
    solved = solve(guess, normal, 0.0)
    return _point(solved) if solved.found else None


class Corrected(NamedTuple):
    """The point that Newton's method ends at, see `CurvePoint`; found: whether it converged."""

    u: Any
    tangent: Any
    iterations: Any
    orientation: Any
    found: Any


def corrected(linearized, args, u, tangent, length) -> Corrected:
    """The point of the curve in the plane normal to the tangent, `length` ahead of u; in NumPy.

    linearized: gives F, [n], and its matrix, [n, n + 1], at u, [n + 1], and args, and is traced
    once; keep the function and pass what varies as `args`, any pytree of arrays.
    """
    given = (jnp.asarray(u), jnp.asarray(tangent), jnp.asarray(length))
    return jax.tree.map(np.asarray, _correct(linearized, args, *given))


@jit
def _correct(linearized, args, u: Array, tangent: Array, step: Array) -> Corrected:
    """Newton's method in the plane normal to the tangent, `step` ahead of u."""

    # n equations and that of the plane, for n + 1 unknowns:
    #   | matrix, [n, n + 1] |        | value                    |
    #   | tangent, [n + 1]   | dv = - | tangent . (v - u) - step |
    def squared(v):
        value, matrix = linearized(v, args)
        value = jnp.append(value, tangent @ (v - u) - step)
        return value, jnp.concatenate([matrix, tangent[None]])

    solved = newton(
        squared,
        u + step * tangent,
        steps=CORRECTIONS,
        longest=jnp.inf,
        settled=lambda last, before: last <= SMALLEST_CORRECTION,
    )
    # The kernel of `matrix`, for the tangent: what the same equations give for (0, .., 0, 1).
    kernel = jnp.linalg.solve(solved.matrix, jnp.zeros_like(u).at[-1].set(1.0))
    sign, _ = jnp.linalg.slogdet(solved.matrix)
    size = solved.lengths[solved.iterations - 1]
    found = (size <= 1e3 * SMALLEST_CORRECTION) & jnp.all(jnp.isfinite(kernel))
    tangent = kernel / jnp.linalg.norm(kernel)
    return Corrected(solved.z, tangent, solved.iterations, sign, found)
