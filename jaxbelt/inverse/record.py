"""A measured record of a motion, cut into windows, and the judgement of residuals.

The windows are those that a fit begins with; `verdict_on` decides whether residuals may be noise.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..model.oscillator import Oscillator, frequencies, has_clock

#: Length of the first windows, less than half a loop, over which no phase is lost; half the time
#: that a local cubic spans. Forcing faster than 1 shortens both by its frequency.
WINDOW, SMOOTHED = 2.5, 0.35
#: Plausibility at or below which residuals are no noise: noise alone gets there once in a million
#: records.
IMPLAUSIBLE = 1e-6
#: Residuals with a larger autocorrelation, in units of 1/sqrt(data), are not noise.
MOST_CORRELATED = 6.0
#: With a smaller reduced chi^2 the noise was overestimated.
OVERESTIMATED = 0.2


class Record(eqx.Module):
    """Data in pieces of equal length, the first windows.

    Attributes:
        times: Times since the start of the piece, the last one being the start of the next piece,
            [pieces, samples + 1].
        values: x1 and x2, [pieces, samples, 2].
        weights: 1/noise, 0 where there is no datum, [pieces, samples, 2].
        starts: Measured states at the starts of the pieces, [pieces, 2].
        scale: Standard deviation of each component of the measured states, [2].
        lacks: 1.0 where only velocities are known, so that the x1 of all starts lack a common
            constant, else 0.0.
        length: Unit of length of all of these.
        clock: `times` as the times of the forcing; None without forcing.
    """

    times: Array
    values: Array
    weights: Array
    starts: Array
    scale: Array
    lacks: Array
    length: Array
    clock: Array | None = None


def record_of(
    ts: np.ndarray,
    values: np.ndarray,
    noise: Sequence[float | None],
    length: float,
    osc: Oscillator,
) -> Record:
    """Cuts a record into pieces.

    Args:
        ts: Times, [samples].
        values: x1 and x2, [samples, 2], NaN where there is no datum.
        noise: Standard deviations for x1 and x2; None is estimated.
        length: Unit of length of values and noise.
        osc: A guess of the oscillator; its frequencies shorten the windows.
    """
    n = len(ts)
    step = (ts[-1] - ts[0]) / (n - 1)
    quick = quickest(osc)
    size = int(np.clip(round(WINDOW / quick / step), 1, n))
    pieces = -(-n // size)
    begin = np.arange(pieces) * size
    smoothed = [local_cubics(ts, column, SMOOTHED / quick) for column in values.T]
    known = np.isfinite(values)
    given = [i for i in (0, 1) if np.any(known[:, i])]
    if 0 in given:
        states = np.stack(smoothed[0][:2], axis=1)
    else:
        v = smoothed[1][0]
        steps = 0.5 * (v[1:] + v[:-1]) * np.diff(ts)
        states = np.stack([np.concatenate([[0.0], np.cumsum(steps)]), v], axis=1)
    if 1 in given:
        states[:, 1] = smoothed[1][0]
    weights = np.zeros_like(values)
    for i in given:
        sigma = noise[i]
        sigma = smoothed[i][2] if sigma is None else sigma
        weights[:, i] = np.where(known[:, i], 1 / sigma, 0.0)

    missing = pieces * size - n
    padding = ((0, missing), (0, 0))
    ts = np.concatenate([ts, np.full(missing, ts[-1]), [ts[-1] + step]])
    clock = np.stack([ts[i : i + size + 1] for i in begin])
    return Record(
        times=jnp.asarray(clock - clock[:, :1]),
        values=jnp.asarray(np.pad(np.where(known, values, 0.0), padding).reshape(pieces, size, 2)),
        weights=jnp.asarray(np.pad(weights, padding).reshape(pieces, size, 2)),
        starts=jnp.asarray(states[begin]),
        scale=jnp.asarray(np.std(states, axis=0)),
        lacks=jnp.asarray(float(0 not in given)),
        length=jnp.asarray(np.float64(length)),
        clock=jnp.asarray(clock) if has_clock(osc) else None,
    )


def quickest(osc: Oscillator) -> float:
    """The highest frequency of the forcing; at least 1, the natural frequency."""
    return max([1.0, *map(float, frequencies(osc))])


def local_cubics(
    ts: np.ndarray, column: np.ndarray, near: float = SMOOTHED
) -> tuple[np.ndarray, np.ndarray, float]:
    """Local cubic fit to the data near every time: its value and slope there, and the noise.

    near: time on either side whose data are fitted; at least seven data are.
    """
    known = np.isfinite(column)
    if np.sum(known) < 7:
        return np.zeros_like(ts), np.zeros_like(ts), np.nan
    t, x = ts[known], column[known]
    half = max(3, round(near / np.median(np.diff(t))))
    half = min(half, (len(t) - 1) // 2)
    centre = np.searchsorted(t, ts)
    rows = np.clip(centre - half, 0, len(t) - 2 * half - 1)[:, None] + np.arange(2 * half + 1)
    powers = (t[rows] - ts[:, None])[..., None] ** np.arange(4)
    inverse = np.linalg.pinv(powers)
    cubics = np.einsum("tpi,ti->tp", inverse, x[rows])
    off = x[rows] - np.einsum("tip,tp->ti", powers, cubics)
    from scipy.special import gammaincinv  # late, as only fits need it

    # The median, because corners of the motion are not noise. The median of chi^2 is less than its
    # mean, the number of degrees of freedom.
    freedom = 2 * half - 3
    median = 2 * gammaincinv(0.5 * freedom, 0.5)
    noise = np.sqrt(np.median(np.sum(off**2, axis=1)) / median)
    return cubics[:, 0], cubics[:, 1], float(noise)


class Verdict(NamedTuple):
    """Diagnostics of residuals, see `Fit`; is_noise: whether they may be noise."""

    reduced_chi_squared: float
    plausibility: float
    autocorrelation: float
    is_noise: bool


def verdict_on(off: np.ndarray, chi2: float, freedom: int, estimated: bool) -> Verdict:
    """Diagnostics of weighted residuals.

    Args:
        off: Weighted residuals, [samples, 2], NaN where there is no datum.
        chi2: Sum of their squares.
        freedom: Degrees of freedom.
        estimated: Whether the noise of at least one column was estimated.
    """
    if not np.isfinite(chi2):
        return Verdict(np.nan, np.nan, np.nan, False)
    from scipy.special import gammaincc  # late, as only fits need it

    plausibility = float(gammaincc(0.5 * freedom, 0.5 * chi2))
    correlation = _autocorrelation(off)
    # Noise that was estimated from the record proves nothing: it may be part of the motion.
    has_shape = abs(correlation) > MOST_CORRELATED / np.sqrt(np.sum(np.isfinite(off)))
    suspect = estimated and has_shape and chi2 > OVERESTIMATED * freedom
    return Verdict(
        chi2 / freedom, plausibility, correlation, plausibility > IMPLAUSIBLE and not suspect
    )


def _autocorrelation(off: np.ndarray) -> float:
    """Autocorrelation of neighbouring weighted residuals, both components together."""
    pairs = np.isfinite(off[1:]) & np.isfinite(off[:-1])
    products = np.where(pairs, off[1:] * off[:-1], 0.0)
    squares = np.where(pairs, 0.5 * (off[1:] ** 2 + off[:-1] ** 2), 0.0)
    return float(np.sum(products) / np.sum(squares))
