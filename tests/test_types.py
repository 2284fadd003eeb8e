"""The types of bifurcation points, and the coefficients of those at which a cycle is born."""

import jax
import numpy as np
import pytest
from laws import BELL, bell
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxbelt as jb
from jaxbelt import EquilibriumKind

CONTI = jb.Conti(1.0, 0.6, 10.0)


def beside_rest(nu):
    """A belt that moves to the left of the edge, one at rest to its right, which holds 0.5."""

    def make(sigma):
        belts = jb.Belt(nu, CONTI, upper=sigma), jb.Belt(0.0, jb.Coulomb(0.5, 0.5), lower=sigma)
        return jb.Oscillator(0.5, belts)

    return make


FIXED, SEGMENT, FOCUS, SADDLE = (kind.value for kind in EquilibriumKind)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("make", "at", "below", "above", "expected"),
    [
        # A fixed point becomes the pseudo-focus, or meets the saddle.
        (lambda s: jb.presets.class_c(0.3, -0.3, s), 0.7, {FOCUS}, {FIXED}, "persistence"),
        (lambda s: jb.presets.class_c(-0.3, 0.3, s), 0.7, {FIXED, SADDLE}, set(), "annihilation"),
        (lambda s: jb.presets.class_c(-0.3, 0.3, s), -0.7, set(), {FIXED, SADDLE}, "annihilation"),
        # A segment shrinks to its upper end, from which the other side pulls away, or does not.
        (beside_rest(0.3), 0.5, {SEGMENT}, {FOCUS}, "persistence"),
        (beside_rest(-0.3), 0.5, {SEGMENT}, set(), "annihilation"),
        # Its lower end comes to the edge, where it is cut from then on.
        (beside_rest(0.3), -0.5, {SEGMENT}, {SEGMENT}, "persistence"),
        (beside_rest(-0.3), -0.5, {SEGMENT, SADDLE}, {SEGMENT}, "persistence"),
        # From either side one comes to the edge.
        (lambda s: jb.presets.class_c(0.3, 0.3, s), 0.7, {FIXED}, {FIXED}, "degenerate"),
    ],
)
def test_what_goes_on_beyond_a_boundary_equilibrium(make, at, below, above, expected):
    """By what there is near the edge a little before and after."""
    for value, kinds in ((at - 1e-3, below), (at + 1e-3, above)):
        rests = jb.equilibria(make(value))
        near = (rests.x1_lower < value + 0.01) & (rests.x1_upper > value - 0.01)
        assert set(rests.kind[near].tolist()) == kinds
    point = jb.refine(jb.BoundaryEquilibrium(0), make, at=at + 0.02)
    assert point.value == pytest.approx(at, abs=1e-12) and point.type == expected
    assert np.isnan(point.coefficient)
    assert point.table().type[0] == expected and f", {expected}, value" in repr(point)


# --- pseudo-Hopf points ---------------------------------------------------------------------------


def belled(sigma, nu=0.3):
    """Belt 0 to the left of the edge, with a law that bends both ways; belt 1 to its right."""
    right = jb.Belt(-0.5, jb.Coulomb(0.8, 0.8), lower=sigma)
    return jb.Oscillator(0.3, (jb.Belt(nu, BELL, upper=sigma), right))


def belled_pulls(nu=0.3):
    return 0.3, lambda x2: bell(nu - x2), lambda x2: -0.8


def overlapping(sigma):
    return jb.presets.class_d(0.35, 0.2, 0.0, sigma)


def overlapping_pulls():
    def conti(r):
        return 0.6 + 0.4 / (1 + 10 * r)

    return 0.5, lambda x2: conti(0.35 - x2) + conti(0.2 - x2), lambda x2: conti(0.2 - x2)


def returned(sigma, speed, zeta, left, right):
    """The velocity with which an orbit comes back to the edge that leaves it with this one to the
    right, and the time that it takes; by SciPy."""
    y, time = [sigma, speed], 0.0
    for pull, side in ((right, -1), (left, 1)):

        def field(t, y, pull=pull):
            return [y[1], -y[0] - zeta * y[1] + pull(y[1])]

        def back(t, y):
            return y[0] - sigma

        back.terminal, back.direction = True, side
        # It begins on the edge.
        first = solve_ivp(field, (0, speed), y, "DOP853", rtol=1e-13, atol=1e-16)
        run = solve_ivp(
            field, (0, 20), first.y[:, -1], "DOP853", events=back, rtol=1e-13, atol=1e-16
        )
        y, time = [sigma, run.y[1, -1]], time + speed + run.t[-1]
    return y[1], time


CASES = [
    (belled, belled_pulls(), 0.0, "supercritical"),
    (overlapping, overlapping_pulls(), 0.9, "subcritical"),
]


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(("make", "pulls", "guess", "expected"), CASES)
def test_the_cycle_that_is_born_at_a_pseudo_hopf_point(make, pulls, guess, expected):
    point = jb.refine(jb.PseudoHopf(0), make, at=guess)
    assert point.type == expected
    exact, a = float(point.value), float(point.coefficient)
    # At the point 1/|x2| falls by a |x2| times the time of a loop, up to a power more of |x2|.
    speeds = np.array([0.01, 0.02])
    loops = [returned(exact, speed, *pulls) for speed in speeds]
    seen = [
        (1 / v - 1 / w) / (v * time) for v, (w, time) in zip(speeds.tolist(), loops, strict=True)
    ]
    # What is left is of second order in |x2|, and rounding some 1e-6.
    assert a == pytest.approx(2 * seen[0] - seen[1], rel=5e-3)
    # Beside it there is the cycle on one side, with |x2|^2 = -rate/a.
    rates = [float(rate_on_edge(make(exact + offset))) for offset in (-1e-4, 1e-4)]
    side = int(np.argmin(a * np.array(rates)))
    speed = np.sqrt(-rates[side] / a)

    def miss(v):
        return returned(exact + (-1e-4, 1e-4)[side], v, *pulls)[0] - v

    assert brentq(miss, 0.8 * speed, 1.2 * speed) == pytest.approx(speed, rel=0.02)
    # It attracts if loops inside of it grow.
    assert (rates[side] > 0) == (expected == "supercritical") == (miss(0.9 * speed) > 0)


def rate_on_edge(osc):
    rests = jb.equilibria(osc)
    (rate,) = rests.rate[rests.kind == FOCUS]
    return rate


@pytest.mark.slow(first=True)
def test_derivatives_of_the_coefficient():
    def coefficient(nu):
        make = lambda sigma: jb.presets.class_d(0.35, nu, 0.0, sigma)  # noqa: E731
        return jb.refine(jb.PseudoHopf(0), make, at=0.92).coefficient

    # A central difference: of second order, with rounding of 1e-13/1e-5.
    expected = (coefficient(0.2 + 1e-5) - coefficient(0.2 - 1e-5)) / 2e-5
    assert jax.jacfwd(coefficient)(0.2) == pytest.approx(float(expected), rel=1e-6)


SPAN = (-0.3, 0.8), (0.2, 0.56)


@pytest.fixture(scope="module")
def degenerate():
    """Where the coefficient changes its sign on a curve."""
    point = jb.refine(jb.PseudoHopf(0), belled, at=0.0)
    return jb.bifurcation_curve(point, belled, SPAN).special


@pytest.mark.slow(first=True)
def test_degenerate_pseudo_hopf_points(degenerate):
    assert [one.kind for one in degenerate] == ["DegeneratePseudoHopf"] * 2
    sigma, nu = degenerate[0].values
    at = jb.refine(jb.PseudoHopf(0), lambda s: belled(s, nu), at=sigma + 1e-3)
    assert at.type == "degenerate" and at.value == pytest.approx(sigma, abs=1e-12)
    assert at.coefficient == pytest.approx(0.0, abs=1e-12)


@pytest.mark.slow
def test_a_fold_of_cycles_ends_at_a_degenerate_pseudo_hopf_point(degenerate):
    fold, hopf = jb.scan(lambda s: belled(s, 0.47), span=(0.32, 0.36), resolution=8)
    assert (fold.kind, hopf.type) == ("FoldOfCycles", "subcritical")
    (end,) = jb.bifurcation_curve(fold, belled, SPAN).special
    assert end.kind == "DegeneratePseudoHopf"
    assert end.values == pytest.approx(degenerate[0].values, abs=1e-10)


# --- other kinds ----------------------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_hopf_points():
    """A bell bends both ways, a law without a slope not at all."""
    nu0 = lambda osc: osc.belts[0].velocity  # noqa: E731
    cases = (
        (jb.Oscillator(0.4, (jb.Belt(0.1, BELL),)), nu0, "supercritical"),
        (
            jb.Oscillator(0.01, (jb.Belt(0.1, jb.Coulomb(0.5, 0.5)),)),
            lambda osc: osc.damping,
            "degenerate",
        ),
    )
    for osc, where, expected in cases:
        point = jb.refine(jb.Hopf(), osc, where=where)
        assert point.type == expected
        (a,) = jb.lyapunov_coefficient(point.oscillator)
        assert point.coefficient == pytest.approx(float(a), rel=1e-12)


@pytest.mark.slow
def test_crossing_where_the_law_jumps():
    """Beyond, the orbit goes far beyond the boundary at once; with Conti's law it does not."""

    def make(load, law=CONTI):
        left = jb.Belt(-0.1, jb.Conti(1.0, 0.4, 12.0), load=1.1)
        return jb.Oscillator(0.45, (left, jb.Belt(0.035, law, load=load)))

    def above(osc):
        cycle = jb.find_cycle(osc, (3.0, 0.0))
        return float(cycle.x2_max) - 0.035

    jumps = jb.Coulomb(1.0, 0.8)
    for law, expected in ((CONTI, "buckling"), (jumps, "jump")):
        point = jb.refine(jb.CrossingSliding(1), lambda load, law=law: make(load, law), at=0.22)
        assert point.type == expected
        beside = [above(make(float(point.value) + offset, law)) for offset in (-1e-6, 1e-6)]
        assert beside[1] == pytest.approx(0.0, abs=1e-9)
        assert (beside[0] > 0.01) == (expected == "jump")


def test_a_kind_of_one_type():
    point = jb.refine(
        jb.SuddenSliding(0), jb.presets.class_b(0.01, 0.35), where=lambda o: o.belts[0].velocity
    )
    assert point.type == "" and np.isnan(point.coefficient)
    row = point.table().iloc[0]
    assert row.type == "" and np.isnan(row.coefficient)
