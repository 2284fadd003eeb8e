"""Folds of the switch model against a return map of it, by SciPy."""

import jax
import numpy as np
import oracle
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, minimize_scalar
from where import nu0

import jaxbelt as jb
from notebooks.switch_folds import switch_band, switch_fold


@pytest.fixture(scope="module")
def point():
    return jb.refine(jb.NonsmoothFold(0), jb.presets.class_a(0.26), where=nu0)


def return_map(nu, v_star, x1):
    """Where an orbit of class (a) that enters the band r <= v_star at x1 enters it again.

    Eqs. (21)-(23) of the paper; beyond the boundary nothing happens, the orbit never gets there.
    """
    mu, static = oracle.conti(1.0, 0.6, 10.0)
    zeta = 0.5

    def velocity(t):
        return nu - v_star * np.exp(-t)

    # In the band x1' = nu; it holds until the needed force -x1 - zeta x2 falls to -mus.
    onset = brentq(lambda t: x1 + nu * t + zeta * velocity(t) - static, 0.0, 5.0, xtol=1e-15)

    def field(t, y):
        return y[1], -y[0] - zeta * y[1] + mu(max(nu - y[1], -0.05))

    def enters(t, y):
        return nu - y[1] - v_star

    enters.terminal, enters.direction = True, -1
    start = (x1 + nu * onset, velocity(onset))
    # Released inside the band, it has to leave that first.
    out = solve_ivp(field, (0, 2.0), start, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    run = solve_ivp(field, (0, 20.0), out, "DOP853", rtol=1e-12, atol=1e-12, events=enters)
    return run.y_events[0][0][0] if run.t_events[0].size else None


@pytest.mark.slow(first=True)
def test_fold_is_that_of_the_return_map(point):
    """Two cycles meet where the smallest of R(x1) - x1 over the entries x1 is zero."""
    v_star = 1e-3
    mu, _ = oracle.conti(1.0, 0.6, 10.0)

    def smallest(nu):
        last = mu(v_star) - 0.5 * (nu - v_star)  # entered there, x2' = 0

        def excess(gap):
            again = return_map(nu, v_star, last - gap)
            return 1.0 if again is None else again - (last - gap)

        found = minimize_scalar(excess, bounds=(0.004, 0.03), method="bounded")
        return found.fun

    expected = brentq(smallest, 0.2655, 0.2662, xtol=1e-12)
    fold = switch_fold(point, v_star, where=nu0)
    # The extremum is good to 1e-10, the integrations to 1e-11.
    assert fold.value == pytest.approx(expected, abs=1e-8)
    assert fold.residual < 1e-12


@pytest.mark.slow(first=True)
def test_band_and_fold_are_inverse(point):
    band = switch_band(point, 0.26704, where=nu0)
    assert switch_fold(point, band.v_star, where=nu0).value == pytest.approx(0.26704, abs=1e-12)
    # As the band vanishes the fold goes to the exact one.
    narrow = switch_fold(point, 1e-6, where=nu0)
    assert narrow.value == pytest.approx(float(point.value), abs=2e-6)


@pytest.mark.slow(first=True)
def test_the_fold_is_differentiable(point):
    def fold(v_star):
        return switch_fold(point, v_star, where=nu0).value

    slope, near = jax.grad(fold)(1e-4), 1e-6
    difference = (fold(1e-4 + near) - fold(1e-4 - near)) / (2 * near)
    assert slope == pytest.approx(float(difference), rel=1e-6)


@pytest.mark.slow(first=True)
def test_what_is_no_such_fold_is_refused(point):
    hopf = jb.refine(jb.Hopf(), jb.presets.class_a(0.19), where=nu0)
    with pytest.raises(ValueError, match="point must be a nonsmooth fold"):
        switch_fold(hopf, 1e-3, where=nu0)
    with pytest.raises(ValueError, match="v_star must be > 0"):
        switch_fold(point, 0.0, where=nu0)
