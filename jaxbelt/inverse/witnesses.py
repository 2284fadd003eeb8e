"""Whether chi^2 rises beside an estimate as the standard errors of `fit` say.

Standard errors come from derivatives at the estimate. A contact that only noise suggests is lost
close by, and in a bent valley other values fit nearly as well: the record allows what the errors
exclude. Such values are looked for parameter by parameter, along the profile of chi^2: a parameter
is moved and held, and the p + 1 other unknowns of the whole record are fitted anew.
"""

import jax.numpy as jnp
import numpy as np

from .selection import parameter_sizes
from .windows import FitPoint, Linearization, at_bounds, fit_windows

#: A parameter is moved by so many standard errors, at least by this part of its size, and at most
#: by this part of the way to its bound.
MOVED, LEAST_MOVE, INSIDE = 10.0, 1e-3, 0.9
#: Standard error, in sizes, of a parameter that is at a bound and has none.
ERROR_AT_BOUND = 0.2
#: A value D > 1 standard errors off has to raise chi^2 by (LEAST_SHARE D)^2; CLEAR^2 is enough.
LEAST_SHARE, CLEAR = 0.5, 5.0
#: Where chi^2 rises more than BENT^2 times as fast as the linearised problem says, the profile is
#: followed in these parts of the way.
BENT, ON_THE_WAY = 2.0, (0.25, 0.5, 1.0)


def contradicted(problem: Linearization, point: FitPoint, covariance: np.ndarray) -> np.ndarray:
    """Parameters whose standard errors chi^2 contradicts, [p].

    Args:
        problem: The fit.
        point: Its solution for the whole record.
        covariance: Covariance of the parameters and of the start, [p + 2, p + 2].
    """
    selection, p = problem.selection, point.u.size
    values = np.asarray(selection.values(jnp.asarray(point.u)))
    sizes = parameter_sizes(values, selection.unit)
    fixed = at_bounds(selection, point)
    errors = np.where(fixed, ERROR_AT_BOUND * sizes, np.sqrt(np.diag(covariance)[:p]))
    lowest = values - INSIDE * (values - np.asarray(selection.lower))
    highest = values + INSIDE * (np.asarray(selection.upper) - values)
    whole = np.arange(len(point.starts)) == 0

    def distances(new):
        """Distances of values from the estimates, in standard errors, [p]."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.nan_to_num(np.abs(new - values) / errors, posinf=np.inf)

    def fitted(i, change, straight):
        """Changes of all unknowns, distance and rise of chi^2 with parameter i held.

        straight: whether to give up where a Gauss-Newton step from `change` is not enough.
        """
        new = np.clip(values + change[:p], lowest, highest)
        distance = float(distances(new)[i])
        enough = least_rise(distance)
        u = np.where(new == values, point.u, np.asarray(selection.unbounded(jnp.asarray(new))))
        starts, held = point.starts + whole[:, None] * change[p:], np.arange(p) == i
        hopeless = point.chi2 + (enough if straight else np.inf)
        end = fit_windows(
            problem,
            u,
            starts,
            whole,
            0.0,
            point.chi2 + CLEAR**2,
            held=held,
            enough=point.chi2 + enough,
            hopeless=hopeless,
        )
        ends = np.asarray(selection.values(jnp.asarray(end.u)))
        changed = np.append(ends - values, end.starts[0] - point.starts[0])
        return changed, distance, end.chi2 - point.chi2

    def witnessed_by(i, change):
        """Whether values of the profile contradict each parameter, [p]."""
        changed, distance, rise = fitted(i, change, straight=True)
        if distance <= 1:
            return False
        if not (rise < least_rise(distance) or rise < (BENT * distance) ** 2):
            changed = change
            for part in ON_THE_WAY:
                changed[i] = change[i]
                changed, distance, rise = fitted(i, part * changed, straight=False)
                if rise < least_rise(distance) or not rise < CLEAR**2:
                    break
                changed = changed / part
        limits = [least_rise(one) for one in distances(values + changed[:p])]
        return rise < np.array(limits)

    found = np.full(p, False)
    for i in range(p):
        change = np.zeros(p + 2)
        if not fixed[i] and covariance[i, i] > 0:
            change = covariance[:, i] / covariance[i, i]
        change[i] = 1.0
        change *= max(MOVED * errors[i], LEAST_MOVE * sizes[i])
        for sign in (-1.0, 1.0):
            if not found[i]:
                found |= witnessed_by(i, sign * change)
    return found


def least_rise(distance: float) -> float:
    """What chi^2 has to rise by, so many standard errors off; of nearer values nothing is asked."""
    return min(LEAST_SHARE * distance, CLEAR) ** 2 if distance > 1 else -np.inf
