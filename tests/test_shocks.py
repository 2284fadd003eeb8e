"""Minimal fatal shocks: a closed form, what has no boundary, and the independent engine.

The campaign is `python -m tests.campaign shocks`; what it found is in docs/checked.md.
"""

from dataclasses import replace

import jax
import numpy as np
import oracle
import pytest

import jaxbelt as jb
from tests.campaign import derivatives, engine, package, shocks
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


#: Slip on the boundary of a belt at rest, steep there, is a node in the end of its segment, and on
#: the edge that cuts this off is a saddle; the belt that touches beyond drives to the right.
NODE = engine.Oscillator(
    0.1,
    (
        engine.Belt(0.0, ("conti", 1.25, 0.55, 13.0, 0.0), 1.7, upper=-0.35),
        engine.Belt(0.75, ("conti", 0.95, 0.35, 9.0, 0.2), 0.35, lower=-0.35),
    ),
)
#: A pseudo-focus on an edge, over which the separatrix of the other edge passes.
ON_AN_EDGE = engine.Oscillator(
    0.7,
    (
        engine.Belt(0.0, ("conti", 1.05, 0.63, 14.5, 0.0), 1.5, lower=0.2),
        engine.Belt(-0.55, ("conti", 1.0, 0.6, 12.5, 0.0), 1.3, lower=-0.25),
    ),
)


def _bisected(osc: engine.Oscillator, x1: float, outer: float) -> float:
    """The x2, between 0 and outer, from which on runs end elsewhere than those from (x1, 0)."""

    def end(x2):
        return round(engine.attractor(osc, (x1, x2)).x1[0], 3)

    rest, inner = end(0.0), 0.0
    assert end(outer) != rest
    while abs(outer - inner) > 1e-10:
        middle = 0.5 * (inner + outer)
        inner, outer = (middle, outer) if end(middle) == rest else (inner, middle)
    return abs(outer)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(("numbers", "outer"), [(NODE, -1.5), (ON_AN_EDGE, 1.5)])
def test_shocks_where_separatrices_creep_and_where_attractors_lie_on_edges(numbers, outer):
    """Against bisection with the engine, and the derivative against differences of that."""
    osc = package.oscillator(numbers)
    x1 = float(jb.equilibria(osc).x1[0 if numbers is ON_AN_EDGE else 1])

    def distance(osc):
        return jb.minimal_fatal_shock(osc, (x1, 0.0), direction="x2")

    shock = distance(osc)
    assert int(shock.status) == jb.Status.OK
    assert float(shock.distance) == pytest.approx(_bisected(numbers, x1, outer), abs=1e-8)
    slope = float(jax.grad(lambda osc: distance(osc).distance)(osc).belts[0].load)

    def bisected(load):
        first, second = numbers.belts
        return _bisected(replace(numbers, belts=(replace(first, load=load), second)), x1, outer)

    expected, error = oracle.richardson(bisected, numbers.belts[0].load, 4e-3, levels=2)
    assert error < 1e-6 and slope == pytest.approx(float(expected), abs=1e-6)


@pytest.mark.slow(first=True)
def test_a_segment_ends_in_its_boundary():
    """Of a velocity, too, the smallest shock is none: in a corner of either curve."""
    law = jb.Conti(1.0, 0.6, 10.0)
    belts = jb.Belt(0.0, law, 2.0), jb.Belt(1.5, law, lower=-1.4, upper=0.55)
    told = jb.portrait(jb.Oscillator(1.0, belts))
    for direction in ("x2", "both"):
        shock = jb.minimal_fatal_shock(told, (-1.7, 0.0), direction=direction)
        assert int(shock.status) == jb.Status.OK and float(shock.distance) == 0

    # It ends there whatever the load.
    def distance(load):
        osc = jb.Oscillator(1.0, (jb.Belt(0.0, law, load), belts[1]))
        return jb.minimal_fatal_shock(osc, (-1.7, 0.0), direction="x2").distance

    assert float(jax.grad(distance)(2.0)) == 0
