"""Minimal fatal shocks: a closed form, what has no boundary, and the independent engine.

The campaign is `python -m tests.campaign shocks`; what it found is in docs/checked.md.
"""

import jax
import numpy as np
import pytest

import jaxbelt as jb
from tests.campaign import derivatives, shocks
from tests.campaign.cases import Case

#: The mass rests at sigma -+ 0.7, mu(0.3) = 0.6 + 0.4/4; between is the saddle at the edge, 0.
SADDLE = (-0.3, 0.3, 0.0)


@pytest.fixture(scope="module")
def told() -> jb.Portrait:
    return jb.portrait(jb.presets.class_c(*SADDLE))


@pytest.mark.slow(first=True)
def test_shock_to_a_saddle_is_in_closed_form(told):
    shock = jb.minimal_fatal_shock(told, (0.7, 0.0))
    assert int(shock.status) == jb.Status.OK
    assert (shock.attractor, shock.beyond) == ("equilibrium 2", "equilibrium 0")
    assert told.separatrices[int(shock.boundary.split()[1])].stable
    assert float(shock.distance) == pytest.approx(0.7, abs=1e-15)
    assert np.asarray(shock.start) == pytest.approx([0.7, 0.0], abs=1e-15)
    assert np.asarray(shock.shock) == pytest.approx([-0.7, 0.0], abs=1e-15)
    (row,) = shock.at_phases(5).to_dict("records")
    assert row["distance"] == pytest.approx(0.7, abs=1e-15) and row["t"] == 0


@pytest.mark.slow(first=True)
def test_shocks_of_the_velocity_are_longer_and_point_symmetric(told):
    right, left = (jb.minimal_fatal_shock(told, (x1, 0.0), direction="x2") for x1 in (0.7, -0.7))
    assert float(right.distance) > 0.7 and float(right.shock[0]) == pytest.approx(0, abs=1e-12)
    assert float(left.distance) == pytest.approx(float(right.distance), abs=1e-12)
    assert np.asarray(left.shock) == pytest.approx(-np.asarray(right.shock), abs=1e-12)


@pytest.mark.slow(first=True)
def test_one_attractor_has_no_boundary():
    shock = jb.minimal_fatal_shock(jb.presets.class_b(0.1, 0.35), (3.0, 0.0))
    assert int(shock.status) == jb.Status.OK and shock.boundary == shock.beyond == "none"
    assert float(shock.distance) == np.inf and np.all(np.isnan(shock.shock))
    assert np.all(np.isinf(shock.at_phases(3).distance))
    assert "inf" in repr(shock)


def test_traced_oscillators_are_refused():
    with pytest.raises(ValueError, match="osc must be known"):
        jax.jit(lambda nu: jb.minimal_fatal_shock(jb.presets.class_b(nu, 0.35), (3.0, 0.0)))(0.2)


# --- slow ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "of",
    [
        pytest.param(jax.grad, marks=pytest.mark.slow(first=True)),
        pytest.param(jax.jacfwd, marks=pytest.mark.slow),
    ],
)
def test_derivatives_are_those_of_the_closed_form(of):
    """mu(nu1) - sigma, and mu'(0.3) = -0.4 10 / 4^2."""

    def distance(nu0, nu1, sigma):
        return jb.minimal_fatal_shock(jb.presets.class_c(nu0, nu1, sigma), (0.7, 0.0)).distance

    assert of(distance, (0, 1, 2))(*SADDLE) == pytest.approx((0.0, -0.25, -1.0), abs=1e-14)


@pytest.mark.slow
def test_what_goes_to_infinity_is_told():
    osc = jb.Oscillator(-0.1, jb.presets.class_a(0.3).belts)
    told = jb.portrait(osc)
    shock = jb.minimal_fatal_shock(told, (1.0, 0.0))
    assert shock.boundary == "unstable cycle 0" and shock.beyond == "infinity"
    outside = jb.minimal_fatal_shock(told, (20.0, 0.0))
    assert int(outside.status) == jb.Status.NOT_SETTLED and np.isnan(float(outside.distance))


@pytest.mark.slow
def test_phases_of_a_cycle_have_the_smallest_among_them():
    shock = jb.minimal_fatal_shock(jb.presets.class_b(0.45, 0.35), (3.0, 0.0))
    rows = shock.at_phases(64)
    least = rows.loc[rows.distance.idxmin()]
    # Phases are a tenth of a time unit apart, and the distance is as smooth as the cycle.
    assert float(shock.distance) <= least.distance < float(shock.distance) + 5e-3
    away = np.hypot(*(np.asarray(shock.start) - [least.x1, least.x2]))
    assert away < 0.1


@pytest.mark.slow
def test_design_finds_the_velocity_for_a_shock():
    margin = jb.distance_to_basin_boundary("x2")
    osc = jb.presets.class_b(0.45, 0.35)
    plan = jb.design(osc, [(margin, 0.1)], where=lambda o: o.belts[0].velocity)
    assert int(plan.status) == jb.Status.OK
    shock = jb.minimal_fatal_shock(plan.oscillator, (3.0, 0.0), direction="x2")
    assert float(shock.distance) == pytest.approx(0.1, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_shocks_are_the_engines(seed):
    rng = np.random.default_rng(seed)
    _, osc, y0, direction, told = shocks.random_shock(rng)
    assert shocks.differences(osc, y0, direction, told)[0] == []
    slopes = shocks.slope_error(osc, y0, direction, derivatives.directions(Case(osc, y0), rng))
    assert slopes is None or slopes[0] < shocks.SAME_SLOPE * (1 + slopes[1])
