"""Standard errors that chi^2 contradicts, of residuals in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt.inverse.fit import _inverted
from jaxbelt.inverse.selection import Selection
from jaxbelt.inverse.windows import Linearization, fit_windows
from jaxbelt.inverse.witnesses import contradicted


class Given(Linearization):
    """Residuals as functions of two parameters, in place of those of a record."""

    def __init__(self, residuals, lower):
        nothing, ones = jnp.full(2, np.inf), jnp.ones(2)
        lowest = jnp.array([lower, -np.inf])
        selection = Selection(((0,), (1,)), ("a", "b"), lowest, nothing, ones, ones)
        self.selection, self.oscillator, self.residuals = (
            selection,
            jb.presets.class_b(0.45, 0.35),
            residuals,
        )

    def linearized(self, u, starts, fresh):
        def off(u, start):
            return jnp.concatenate([jnp.stack(self.residuals(*self.selection.values(u))), start])

        start, r = jnp.asarray(starts[0]), off(jnp.asarray(u), jnp.asarray(starts[0]))
        slopes = jax.jacfwd(off, argnums=(0, 1))(jnp.asarray(u), start)
        columns = jnp.concatenate([*slopes, r[:, None]], axis=1)
        return jnp.zeros((1, 1, 2)), (columns.T @ columns)[None]


@pytest.mark.parametrize(
    ("residuals", "lower", "expected"),
    [
        pytest.param(lambda a, b: (10 * (a - 1), 20 * (b - 3)), -np.inf, (), id="as derivatives"),
        # chi^2 rises to 4 at most, and the standard error of a is 0.1.
        pytest.param(
            lambda a, b: (2 * jnp.tanh(5 * (a - 1)), 20 * (b - 3)), -np.inf, (0,), id="lost nearby"
        ),
        # It is followed: on straight lines chi^2 is 1e9 there.
        pytest.param(
            lambda a, b: (10 * (a - 1), 1e4 * (b - 3 * a**2)), -np.inf, (), id="bent valley"
        ),
        # Of a parameter at a bound with no error, and a size of 0.1.
        pytest.param(lambda a, b: (1 + 100 * a, 20 * (b - 3)), 0.0, (), id="at its bound"),
        pytest.param(lambda a, b: (1 + 0.1 * a, 20 * (b - 3)), 0.0, (0,), id="anywhere above it"),
    ],
)
def test_errors_that_chi2_contradicts(residuals, lower, expected):
    problem = Given(residuals, lower)
    u = np.array([1.0 if lower else -40.0, 3.0])
    point = fit_windows(problem, u, np.zeros((1, 2)), np.array([True]), 0.0, np.inf)
    slopes = np.append(np.diag(jax.jacfwd(problem.selection.values)(jnp.asarray(point.u))), [1, 1])
    covariance = _inverted(point.blocks[0][:-1, :-1]) * slopes[:, None] * slopes
    found = contradicted(problem, point, covariance)
    assert tuple(np.flatnonzero(found).tolist()) == expected
