"""Lyapunov exponents of forced oscillators: `lyapunov` and what it returns, `Exponents`.

The orbit is followed period by period. The derivative of the state at the end of a period by that
at its beginning is the product of the maps of its arcs, which include saltation, see `clocked`. A
tangent is carried along, and the first exponent is the mean logarithm of its growth. The sum of
both exponents is that of areas, which follows from the divergence of the field and is not lost in
rounding where one direction shrinks much faster than the other. Behind a stick phase the maps have
rank one: the second exponent is set to -inf wherever a stick arc occurs.
"""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..activity import announced
from ..checks import as_finite, as_whole, check_key, is_concrete, number, outside_of_traces
from ..model.modes import STUCK
from ..model.oscillator import Oscillator, check_clock, check_oscillator
from ..model.own_units import in_own_units
from ..motion.arcs import Ends
from ..numerics.compiling import jit
from ..results import Status, describe, draw
from ..tables import require_single, table_of
from .chains import Loop
from .clocked import (
    arc_maps,
    forcing_period,
    least_steps,
    logs_of_areas,
    timed_chain,
    turns_of,
)
from .followed import Followed, after_period, arcs_over

if TYPE_CHECKING:
    import pandas

#: Number of blocks of periods; the scatter of their means gives the standard errors.
BLOCKS = 25
#: Error of an exponent per period that integration steps leave where all periods are alike.
LEAST_STANDARD_ERROR = 1e-12


class Exponents(eqx.Module):
    """Lyapunov exponents of a motion of a forced oscillator, the larger one first.

    Attributes:
        exponents: Per unit of time, [2]; -inf where tangents vanish, as the second exponent of a
            motion that sticks.
        per_period: Exponents per period of the forcing, [2].
        standard_errors: Of `exponents`, from the means of blocks of periods, [2]; 0 for -inf.
        periods: Number of periods averaged over.
        sticks: Whether the mass sticks.
        end: State at the end, at the phase 0, [2].
        status: A `Status` code; where it is not OK every number is NaN.
    """

    exponents: Array
    per_period: Array
    standard_errors: Array
    periods: int = eqx.field(static=True)
    sticks: Array
    end: Array
    status: Array

    def table(self) -> "pandas.DataFrame":
        """A row for each exponent: exponent, per_period, standard_error, status."""
        require_single(self, self.exponents, 1)
        rows = zip(self.exponents, self.per_period, self.standard_errors, strict=True)
        names = ("exponent", "per_period", "standard_error")
        status = Status(int(self.status)).name
        return table_of(
            [dict(zip(names, map(float, row), strict=True), status=status) for row in rows]
        )

    def plot(self, ax: Any = None) -> Any:
        """Draw both exponents with three standard errors into the axes `ax` (None: new ones), which
        are returned."""
        return draw(self, ax)

    def __repr__(self) -> str:
        if not is_concrete(self.exponents):
            return f"Exponents({self.exponents.shape})"
        if int(self.status) != Status.OK:
            return f"Exponents({Status(int(self.status)).name}: {describe(self.status)})"
        text = " and ".join(
            f"{number(value)} +- {float(error):.1g}" if np.isfinite(value) else "-inf"
            for value, error in zip(np.asarray(self.exponents), self.standard_errors, strict=True)
        )
        return f"Exponents({text}, {self.periods} periods)"


@announced("lyapunov")
@outside_of_traces
def lyapunov(
    osc: Oscillator,
    y0: ArrayLike | tuple,
    *,
    periods: int = 1000,
    transient: int = 200,
    key: Any = None,
) -> Exponents:
    """Lyapunov exponents of the motion of a forced oscillator that a start leads to.

    Args:
        osc: An `Oscillator` with forcing.
        y0: Start (x1, x2) at the phase 0, that is, at t = 0, shape [2].
        periods: Number of periods of the forcing to average over.
        transient: Number of periods before these that are skipped.
        key: A key of `jax.random` for the first tangent; None: always the same one.

    Returns:
        Both exponents with standard errors. A motion that stays bounded, and has settled, is
        chaotic if the first one is more than three standard errors above zero, attracts
        quasi-periodically if it is zero within three, and is periodic if it is more than three
        below: then it is `log(abs(multiplier))` over the period. An orbit that leaves an unstable
        motion, or grows without bounds, has a first exponent above zero, too.

    Raises:
        ValueError: If an argument is impossible, or if the frequencies have no common period.

    Example:
        found = jb.lyapunov(osc, (0.5, 0.0))
        is_chaotic = found.exponents[0] > 3 * found.standard_errors[0]
    """
    check_oscillator(osc)
    check_clock(osc, "lyapunov", "the multiplier of jb.find_cycle")
    y0 = as_finite(y0, "y0", (2,))
    periods = as_whole(periods, "periods", BLOCKS)
    transient = as_whole(transient, "transient", 0)
    if key is not None:
        check_key(key)
    own, turns = in_own_units(osc), turns_of(osc)
    length = 1.0 if own is osc else own.units.length
    y, skipped, passed = np.asarray(y0) / np.asarray(length), 0, 0
    logs, sticks, status = [], False, Status.OK.value
    tangent = _first_tangent(key)
    while passed < periods:
        followed = arcs_over(own, y, turns)
        reached = len(followed.starts) - 1
        if followed.status != Status.OK or reached == 0:
            status = followed.status or Status.NOT_FINITE.value
            break
        used = min(reached - min(transient - skipped, reached), periods - passed)
        skipped = min(transient, skipped + reached)
        if used > 0:
            sticks = sticks or bool(np.any(followed.last(used).codes == STUCK))
        tangent, grown = _followed_tangent(own, followed, turns, tangent, used)
        logs.append(grown)
        passed += used
        y = after_period(own, followed)
    return _averaged(
        np.concatenate(logs) if logs else np.zeros((0, 2)),
        sticks,
        status,
        periods,
        float(forcing_period(own, turns)),
        jnp.asarray(y) * length,
    )


def _first_tangent(key: Any) -> np.ndarray:
    angle = 1.0 if key is None else float(jax.random.uniform(key, maxval=2 * np.pi))
    return np.array([np.cos(angle), np.sin(angle)])


def _followed_tangent(
    osc: Oscillator, followed: Followed, turns: int, tangent: np.ndarray, used: int
) -> tuple[np.ndarray, np.ndarray]:
    """The tangent at the end of an orbit, of length one, and for each of the last `used` periods
    the logarithms of its growth and of the growth of areas over it, [used, 2]."""
    loop = followed.loop()
    found = _maps(osc, loop, least_steps(osc, loop), turns)
    maps, areas = (np.asarray(one)[: len(followed.ends)] for one in found)
    ends = np.flatnonzero(followed.ends == Ends(followed.codes.shape[1]).period)
    begins = [0, *(ends[:-1] + 1).tolist()]
    logs = []
    for first, last in zip(begins, ends.tolist(), strict=True):
        moved = np.append(tangent, 0.0)
        for one in maps[first : last + 1]:
            moved = one @ moved
        size = np.hypot(*moved[:2])
        tangent = moved[:2] / size if size > 0 else tangent
        with np.errstate(divide="ignore", invalid="ignore"):
            grown = np.log(size)
            logs.append([grown, np.sum(areas[first : last + 1]) - grown])
    return tangent, np.array(logs[len(logs) - used :]).reshape(-1, 2)


@jit
def _maps(osc: Oscillator, loop: Loop, size: int, turns: int) -> tuple[Array, Array]:
    chain, z = timed_chain(osc, loop, size, turns)
    return arc_maps(osc, chain, z), logs_of_areas(osc, chain, z)


def _averaged(logs, sticks, status, periods, period, end) -> Exponents:
    known = 1.0 if status == Status.OK else np.nan
    means, errors = np.full(2, np.nan), np.full(2, np.nan)
    if status == Status.OK:
        blocks = np.array([np.mean(rows, axis=0) for rows in np.array_split(logs, BLOCKS)])
        means = np.mean(logs, axis=0)
        with np.errstate(invalid="ignore"):
            errors = np.std(blocks, axis=0, ddof=1) / np.sqrt(BLOCKS)
        if sticks:
            means[1] = -np.inf
        errors = np.where(np.isfinite(means), np.maximum(errors, LEAST_STANDARD_ERROR), 0.0)
        order = np.argsort(-means)
        means, errors = means[order], errors[order]
    return Exponents(
        exponents=jnp.asarray(means / period),
        per_period=jnp.asarray(means),
        standard_errors=jnp.asarray(errors / period),
        periods=periods,
        sticks=jnp.asarray(bool(sticks)),
        end=end * known,
        status=jnp.asarray(status),
    )
