"""The exact motion in windows of a record, each with an unknown start: stages 2 and 3 of `fit`."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import ArrayLike

from ..model.oscillator import Oscillator, has_clock
from ..model.own_units import in_own_units
from ..motion.simulate import simulate
from ..numerics.compiling import jit
from .record import Record
from .selection import (
    ITERATIONS,
    LONGEST_CHANGE,
    Selection,
    parameter_sizes,
)

TOLERANCE = 1e-8
#: The last stage may take LONGER * ITERATIONS steps. It ends when a Gauss-Newton step promises to
#: lower chi^2 by less than GAIN_ENOUGH, the square of an error in standard errors; it has not
#: converged where the step promises more than GAIN_LEFT.
LONGER, GAIN_ENOUGH, GAIN_LEFT = 10, 1e-5, 1e-1
#: A parameter nearer to its bound than this fraction of its size is at the bound.
AT_BOUND = 1e-6
#: Factors by which the damping shrinks and grows: with large ones every other step along a bent
#: valley is refused.
LESS_DAMPED, MORE_DAMPED = 3.0, 4.0


@jit
def _linearized(selection: Selection, osc: Oscillator, record: Record, u, starts, fresh):
    """Motion at the times of the record, [pieces, samples, 2], and blocks of the Gauss-Newton
    matrix.

    A piece begins at its start where it is `fresh`, else where the previous piece ends. The blocks,
    [pieces, p + 3, p + 3], are sums over the data of a piece: products of the columns of the
    Jacobian (p parameters, the two components of the start of its window) and of the weighted
    residual.
    """

    def motion(u, starts):
        moved = in_own_units(selection.put(osc, selection.values(u)), record.length)

        def piece(y, row):
            times, clock, start, is_fresh = row
            y = jnp.where(is_fresh, start, y)
            # Without forcing every piece begins at 0.
            t0, times = (0.0, times) if clock is None else (clock[0], clock)
            run = simulate(
                moved,
                y,
                times[-1],
                t0=t0,
                ts=times,
                rtol=TOLERANCE,
                atol=TOLERANCE,
                max_segments=128,
            )
            return run.ys[-1], run.ys[:-1]

        rows = record.times, record.clock, starts, fresh
        return lax.scan(piece, starts[0], rows)[1]

    p, pieces = u.size, starts.shape[0]
    du = jnp.concatenate([jnp.eye(p), jnp.zeros((2, p))])
    each = jnp.broadcast_to(jnp.eye(2)[:, None], (2, pieces, 2))
    dstarts = jnp.concatenate([jnp.zeros((p, pieces, 2)), each])

    def column(du, dstarts):
        return jax.jvp(motion, (u, starts), (du, dstarts))

    ys, columns = jax.vmap(column, out_axes=(None, -1))(du, dstarts)
    off = (ys - record.values)[..., None]
    columns = record.weights[..., None] * jnp.concatenate([columns, off], axis=-1)
    return ys, jnp.einsum("csij,csik->cjk", columns, columns)


def _squares(blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums of squared sensitivities of the data, to parameters, [p], and starts, [windows, 2]."""
    p = blocks.shape[-1] - 3
    both = np.sum(blocks[:, :p, :p], axis=0), blocks[:, p:-1, p:-1]
    return np.diag(both[0]), np.einsum("wii->wi", both[1])


def _damped_step(
    blocks: np.ndarray, damping: float, squares: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Levenberg-Marquardt step of the parameters, [p], and of the starts, [windows, 2].

    squares: as from `_squares`; damping adds a multiple of them to the diagonal.
    """
    p = blocks.shape[-1] - 3
    a, g = np.sum(blocks[:, :p, :p], axis=0), np.sum(blocks[:, :p, -1], axis=0)
    c, d, h = blocks[:, :p, p:-1], blocks[:, p:-1, p:-1], blocks[:, p:-1, -1:]
    a = a + np.diag(damping * squares[0] + 1e-12)
    d = d + (damping * squares[1] + 1e-9)[..., None] * np.eye(2)
    eliminate = c @ np.linalg.inv(d)
    matrix = a - np.sum(eliminate @ c.transpose(0, 2, 1), axis=0)
    du = np.linalg.solve(matrix, np.sum(eliminate @ h, axis=0)[:, 0] - g)
    dstarts = -np.linalg.solve(d, h + (c.transpose(0, 2, 1) @ du)[..., None])[..., 0]
    return du, dstarts


@dataclass
class Linearization:
    """`_linearized` for one record, with a count of its evaluations."""

    selection: Selection
    oscillator: Oscillator
    record: Record
    evaluations: int = 0

    def linearized(self, u, starts, fresh):
        self.evaluations += 1
        return _linearized(self.selection, self.oscillator, self.record, u, starts, fresh)


class FitPoint(eqx.Module):
    """State of the iteration: unknowns, motion, Gauss-Newton blocks of the windows, chi^2."""

    u: np.ndarray
    starts: np.ndarray
    ys: np.ndarray
    blocks: np.ndarray
    chi2: float


def fit_windows(
    problem: Linearization,
    u,
    starts,
    fresh: np.ndarray,
    relative: float,
    far: float,
    *,
    held: ArrayLike = False,
    enough: float = -np.inf,
    hopeless: float = np.inf,
) -> FitPoint:
    """Levenberg-Marquardt iteration for one division of the record into windows.

    It ends when chi^2 falls by less than the fraction `relative`; for the whole record, when
    nothing is left to gain, or when chi^2 stays above `far`.

    Args:
        problem: The fit.
        u: Parameters to begin with, [p].
        starts: Starts of the pieces, [pieces, 2].
        fresh: Pieces that begin a window, [pieces].
        relative: See above.
        far: See above.
        held: Parameters that keep their values, [p] or one for all. The blocks have zeros for them.
        enough: For the whole record, a smaller chi^2 ends the iteration.
        hopeless: For the whole record, so does a larger one that a Gauss-Newton step promises.
    """
    window = np.cumsum(fresh) - 1
    frees = np.append(np.broadcast_to(~np.asarray(held), len(u)), [True] * 3)

    def at(u, starts):
        ys, pieces = problem.linearized(jnp.asarray(u), jnp.asarray(starts), jnp.asarray(fresh))
        pieces = np.where(frees[:, None] & frees, pieces, 0.0)
        blocks = np.zeros((window[-1] + 1, *pieces.shape[1:]))
        np.add.at(blocks, window, pieces)
        chi2 = float(np.sum(blocks[:, -1, -1]))
        return FitPoint(u, starts, np.asarray(ys), blocks, chi2)

    point = at(u, starts)
    damping, is_last = 1e-2, np.sum(fresh) == 1
    keeps, squares = has_clock(problem.oscillator), _squares(point.blocks)
    for number in range(LONGER * ITERATIONS if is_last else ITERATIONS):
        if not np.isfinite(point.chi2) or damping > 1e5:
            break
        if number >= ITERATIONS and point.chi2 > far:
            break
        if is_last:
            gain = gain_left(free_part(problem.selection, point))
            if gain < GAIN_ENOUGH or point.chi2 < enough or point.chi2 - gain > hopeless:
                break
        # The x2 of a start at which the mass sticks loses its effect on the way there: so with a
        # clock the largest squares of the iteration damp its steps (More, 1978).
        now = _squares(point.blocks)
        if keeps:
            now = np.maximum(squares[0], now[0]), np.maximum(squares[1], now[1])
        squares = now
        du, dstarts = _damped_step(point.blocks, damping, squares)
        shorter = min(1.0, LONGEST_CHANGE / max(np.max(np.abs(du)), 1e-300))
        moved = point.starts.copy()
        moved[fresh] += np.clip(shorter * dstarts, -0.5, 0.5)
        trial = at(point.u + shorter * du, moved)
        if trial.chi2 < point.chi2:
            gain = point.chi2 - trial.chi2
            point, damping = trial, max(damping / LESS_DAMPED, 1e-9)
            if not is_last and gain < max(1e-2, relative * point.chi2):
                break
        else:
            damping *= MORE_DAMPED
    return point


def at_bounds(selection: Selection, point: FitPoint) -> np.ndarray:
    """Mask [p] of parameters at a bound beyond which the whole record would fit better."""
    p = point.u.size
    values = np.asarray(selection.values(jnp.asarray(point.u)))
    reached = AT_BOUND * np.asarray(parameter_sizes(values, selection.unit))
    slope = point.blocks[0, :p, -1]
    lower, upper = np.asarray(selection.lower), np.asarray(selection.upper)
    return ((values - lower < reached) & (slope > 0)) | ((upper - values < reached) & (slope < 0))


def free_part(selection: Selection, point: FitPoint) -> np.ndarray:
    """The Gauss-Newton block of a whole record without the parameters that are at bounds."""
    free = np.append(~at_bounds(selection, point), [True] * 3)
    return point.blocks[0][np.ix_(free, free)]


def gain_left(block: np.ndarray) -> float:
    """Decrease of chi^2 that a Gauss-Newton step on a whole record promises (linear estimate)."""
    scale, values, vectors = known_directions(block[:-1, :-1])
    slopes = vectors.T @ (block[:-1, -1] / scale)
    return float(np.sum(slopes**2 / values))


def known_directions(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scales of the unknowns, [n], and the directions that the record determines.

    The directions are eigenvectors, as columns, of the matrix in units of these scales; they come
    with their eigenvalues.
    """
    size = np.sqrt(np.diag(matrix))
    scale = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(np.nan_to_num(matrix / scale[:, None] / scale))
    known = values > 1e-12 * np.max(values, initial=0.0)
    return scale, values[known], vectors[:, known]
