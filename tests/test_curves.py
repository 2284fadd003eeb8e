"""Curves in two parameters: against refined points, closed forms, the oracle and symmetry."""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest
from laws import BELL, bell
from scipy.optimize import brentq
from where import nu0, nu1, zeta

import jaxbelt as jb
from jaxbelt.bifurcations.systems import Seen
from jaxbelt.bifurcations.tangencies import _departure
from jaxbelt.bifurcations.tracks import Track, special_between
from jaxbelt.model.parameters import leaf_index
from jaxbelt.model.variations import Variation
from jaxbelt.numerics.continuation import Corrected, CurvePoint, Stop
from tests.campaign import engine

PLANE = ((-0.7, 0.7), (-0.7, 0.7))


@pytest.fixture(scope="module")
def points():
    """Those of class (b) along nu1 = 0.35, by their order."""
    return jb.scan(jb.presets.class_b(0.3, 0.35), nu0, (-0.7, 0.7))


@pytest.fixture(scope="module")
def fold(points):
    """The fold on belt 1 at nu0 = -0.5613 and what becomes of it."""
    return jb.bifurcation_curve(points[0], (nu0, nu1), PLANE, step=0.02)


@pytest.mark.slow(first=True)
def test_the_hopf_curve_is_that_of_the_closed_form(points):
    curve = jb.bifurcation_curve(points[5], (nu0, nu1), PLANE, step=0.02)
    a, b = curve.values.T
    # The trace of two belts, eq. (27): 4 / (1 + 10 nu)^2 each; slopes up to 10 times rounding.
    assert np.allclose(4 / (1 + 10 * a) ** 2 + 4 / (1 + 10 * b) ** 2, 0.5, rtol=0, atol=1e-14)
    assert curve.ends == (Stop.LEFT_SPAN, Stop.LEFT_SPAN) and set(curve.kinds) == {"Hopf"}
    assert np.all(np.max(np.abs(curve.values[[0, -1]]), axis=1) == pytest.approx(0.7, abs=1e-12))
    (special,) = curve.special
    assert special.kind == "EqualVelocities" and special.values == pytest.approx((0.3, 0.3))


def errors(curve, osc, where, condition, rows):
    """How far rows of a curve are from what is refined near them.

    Refined over the parameter that the curve crosses, the other one as in the row.
    """
    found = []
    both = Variation.of_leaves(osc, [leaf_index(osc, one) for one in where])
    for row in rows:
        values, chord = curve.values[row], curve.values[row + 1] - curve.values[row - 1]
        free = int(np.argmin(np.abs(chord)))
        held = both.held(1 - free, float(values[1 - free]))
        solved = [
            condition.named_point_from(held, float(values[free]) + offset)
            for offset in (-1e-3, 1e-3)
        ]
        points = [point for point in solved if point is not None]
        assert curve.kinds[row] in {point.kind for point in points}
        found.append(np.nanmin([abs(float(point.value) - values[free]) for point in points]))
    return found


@pytest.mark.slow(first=True)
def test_every_row_is_what_refine_finds(fold):
    rows = range(3, len(fold) - 3, len(fold) // 8)
    osc = jb.presets.class_b(-0.5, 0.35)
    # Both are exact up to the error of the integration, some 1e-12.
    assert max(errors(fold, osc, (nu0, nu1), jb.GrazingSliding(1), rows)) < 1e-9
    assert np.max(fold.residual) < 1e-12 and np.all(np.isfinite(fold.values))


def steepness(osc):
    return osc.belts[0].friction.steepness


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("number", "where", "span", "step"),
    [
        (7, (nu0, zeta), ((0.3, 0.7), (0.3, 0.7)), 0.02),
        (7, (nu0, steepness), ((0.4, 0.6), (9.0, 11.0)), 0.1),
        (1, (steepness, zeta), ((9.0, 10.2), (0.3, 0.7)), 0.1),
    ],
)
def test_curves_in_other_parameters(points, number, where, span, step):
    curve = jb.bifurcation_curve(points[number], where, span, step=step)
    assert curve.ends == (Stop.LEFT_SPAN, Stop.LEFT_SPAN) and len(curve) > 12
    rows = range(2, len(curve) - 2, len(curve) // 5)
    found = errors(curve, points[number].oscillator, where, points[number].condition, rows)
    assert max(found) < 1e-9


@pytest.mark.slow(first=True)
def test_a_closed_curve_ends_where_it_began():
    """A trace of zero, -mu'(nu0) - mu'(nu1) = zeta: a closed curve, for -mu' has a maximum."""
    osc = jb.Oscillator(1.2, (jb.Belt(0.2, BELL), jb.Belt(0.2, BELL)))
    point = jb.refine(jb.Hopf(), osc, where=nu0)
    curve = jb.bifurcation_curve(point, (nu0, nu1), ((0.0, 1.0), (0.0, 1.0)), step=0.02)
    assert curve.ends == (Stop.CLOSED, Stop.CLOSED)
    x, y = curve.values.T / 0.4
    assert np.allclose(2 * x / (1 + x**2) ** 2 + 2 * y / (1 + y**2) ** 2, 1.2, rtol=0, atol=1e-14)
    assert np.allclose(curve.values[0], curve.values[-1], rtol=0, atol=1e-14)
    # Once round, the first row and the last being one.
    middle = np.mean(curve.values[1:], axis=0)
    angles = np.unwrap(np.arctan2(*(curve.values - middle).T))
    assert abs(angles[-1] - angles[0]) == pytest.approx(2 * np.pi)
    assert [special.kind for special in curve.special] == ["EqualVelocities"] * 2


@pytest.mark.slow(first=True)
def test_folds_of_cycles_end_at_a_degenerate_hopf_point():
    """Where -mu' = zeta and the third derivative is 0: for this law at nu = 0.4 and zeta = 1/2."""
    point = jb.refine(jb.FoldOfCycles(), jb.Oscillator(0.4, (jb.Belt(0.483, BELL),)), where=nu0)
    curve = jb.bifurcation_curve(point, (nu0, zeta), ((0.3, 0.7), (0.3, 0.6)), step=0.03)
    assert set(curve.ends) == {Stop.STOPPED, Stop.LEFT_SPAN}
    (end,) = curve.special
    assert end.kind == "DegenerateHopf" and end.residual < 1e-13
    assert end.values == pytest.approx((0.4, 0.5), abs=1e-13)
    assert np.allclose(curve.multiplier, 1, rtol=0, atol=1e-11) and np.max(curve.residual) < 1e-12
    # Up to where the cycle nearly touches the boundary and its outer neighbours stick, nu = 0.64.
    for value, damping in curve.values[curve.values[:, 0] > 0.41][::-2]:
        osc = jb.Oscillator(float(damping), (jb.Belt(float(value) + 5e-3, BELL),))
        again = jb.refine(jb.FoldOfCycles(), osc, where=nu0)
        assert again.value == pytest.approx(value, abs=1e-9)

    value, damping = (float(number) for number in curve.values[-2])
    expected = oracle_cycles.fold_of_cycles(
        lambda nu: oracle.Oscillator(damping, (oracle.Belt(nu, bell, 1.0, 1.0),), 1.0),
        (value - 0.004, value + 0.004),
        (0.2, 0.8),
    )
    assert value == pytest.approx(expected, abs=1e-11)


@pytest.mark.slow
def test_folds_of_cycles_end_where_the_cycle_touches_a_boundary():
    """That of a second belt with constant friction."""
    osc = jb.Oscillator(0.4, (jb.Belt(0.49, BELL), jb.Belt(0.37, jb.Coulomb(1.0, 1.0), load=0.02)))
    point = jb.refine(jb.FoldOfCycles(), osc, where=nu0)
    curve = jb.bifurcation_curve(point, (nu0, zeta), ((0.3, 0.7), (0.2, 0.6)), step=0.02)
    grazing, _ = sorted(curve.special, key=lambda special: -special.values[0])

    def make(nu, damping):
        belts = (
            oracle.Belt(nu, bell, 1.0, 1.0),
            oracle.Belt(0.37, lambda r: 1.0 + 0 * r, 1.0, 0.02),
        )
        return oracle.Oscillator(damping, belts, 1.0)

    def tangency(damping):
        bracket = (grazing.values[0] - 0.01, grazing.values[0] + 0.01)
        return oracle_cycles.nonsmooth_fold(lambda nu: make(nu, damping), bracket, 1)

    def growth(damping):
        return oracle_cycles.growth_from_tangency(make(tangency(damping), damping), 1)

    assert (grazing.kind, grazing.belts) == ("FoldGrazing", (1,))
    expected = brentq(growth, grazing.values[1] - 0.004, grazing.values[1] + 0.004, xtol=1e-12)
    # The oracle's growth is good to some 1e-12.
    assert grazing.values == pytest.approx((tangency(expected), expected), abs=1e-9)
    assert curve.ends == (Stop.STOPPED, Stop.STOPPED)


@pytest.mark.slow(first=True)
def test_a_fold_becomes_grazing_where_both_belts_are_touched(fold):
    """At nu0 = -nu1 by symmetry; there the fold of one belt goes over into the grazing point."""
    double = fold.special[0]
    assert double.kind == "DoubleSliding" and double.belts == (0,)
    assert double.values[0] == pytest.approx(-double.values[1], abs=1e-9)
    changes = [i for i in range(1, len(fold)) if fold.kinds[i] != fold.kinds[i - 1]]
    assert len(changes) == 1 and {fold.kinds[0], fold.kinds[-1]} == {
        "NonsmoothFold",
        "GrazingSliding",
    }
    assert np.all((fold.multiplier > 1) == (np.array(fold.kinds) == "NonsmoothFold"))
    # It runs through both points of the line nu1 = 0.35, and one that the oracle finds on another.
    for value, nu in ((-0.561302406210, 0.35), (-0.078804734107, 0.35)):
        gap = np.min(np.hypot(fold.values[:, 0] - value, fold.values[:, 1] - nu))
        assert gap < 0.011  # half a step
    expected = oracle_cycles.grazing(lambda nu: oracle.class_b(nu, 0.45), (-0.35, -0.32), 1)
    near = np.argsort(np.abs(fold.values[:, 1] - 0.45) + 9 * (fold.values[:, 0] < -0.45))[:4]
    order = near[np.argsort(fold.values[near, 1])]
    found = np.polyval(np.polyfit(fold.values[order, 1], fold.values[order, 0], 3), 0.45)
    # Interpolated by a cubic in steps of 0.02.
    assert found == pytest.approx(expected, abs=1e-5)
    rest = fold.special[1]
    assert (rest.kind, rest.belts) == ("BeltAtRest", (0,)) and Stop.STOPPED in fold.ends
    expected = brentq(
        lambda nu: oracle_cycles.gap_from_rest(oracle.class_b(0.0, nu), 0, -1, 1),
        0.28,
        0.29,
        xtol=1e-13,
    )
    # The oracle's start is good to 1e-11.
    assert rest.values == pytest.approx((0.0, expected), abs=1e-10) and rest.residual < 1e-12
    # The curve bends on its way there, and rows follow it.
    bend = fold.values[np.abs(fold.values[:, 0]) < 0.02]
    assert len(bend) >= 4 and np.min(np.abs(bend[:, 0])) < 0.04 / 2**5
    for nu, value in bend[:3].tolist():
        bracket = (value - 0.003, value + 0.003)
        expected = oracle_cycles.grazing(lambda nu1, nu=nu: oracle.class_b(nu, nu1), bracket, 1)
        assert value == pytest.approx(expected, abs=1e-9)


@pytest.mark.slow
def test_a_limit_at_a_belt_at_rest_whose_law_jumps():
    """Slip onset is away from the equilibrium there, by static - kinetic."""
    belts = (jb.Belt(-0.05, jb.Coulomb(1.0, 0.6)), jb.Belt(0.395, jb.Conti(1.0, 0.6, 10.0)))
    point = jb.refine(jb.GrazingSliding(1), jb.Oscillator(0.5, belts), where=nu1)
    curve = jb.bifurcation_curve(point, (nu0, nu1), ((-0.1, 0.1), (0.05, 0.7)), step=0.02)
    (rest,) = curve.special
    mu, static = oracle.conti(1.0, 0.6, 10.0)

    def gap(nu):
        belts = (oracle.Belt(0.0, lambda r: 0.6, 1.0, 1.0), oracle.Belt(nu, mu, static, 1.0))
        osc = oracle.Oscillator(0.5, belts, 1.0)
        onset = oracle.acceleration(osc, (0, 1))(0.0, 0.0) - 1.0
        return oracle_cycles.gap_from(osc, (onset, 0.0), (-1, 1), (0, 1))

    assert (rest.kind, rest.belts) == ("BeltAtRest", (0,))
    expected = brentq(gap, 0.39, 0.42, xtol=1e-14)
    assert rest.values == pytest.approx((0.0, expected), abs=1e-11) and rest.residual < 1e-12


@pytest.mark.slow(first=True)
def test_a_table_has_rows_and_special_points_in_order(fold):
    columns = fold.table(("nu0", "nu1"))
    table = columns.to_dict("records")
    assert " ".join(columns) == "condition belts nu0 nu1 multiplier residual special"
    values = np.array([(row["nu0"], row["nu1"]) for row in table])
    assert np.array_equal(values, fold.path) and len(table) == len(fold) + 2
    named = [row["special"] for row in table if row["special"]]
    assert named == ["DoubleSliding 0", "BeltAtRest 0"]
    # They stand where they belong: no step is longer than one between rows, 0.02, but for those
    # that go on to the belt at rest, each half as far from there.
    steps = np.hypot(*np.diff(values, axis=0).T)
    assert np.max(steps[:-6]) < 0.0201 and np.all(np.diff(steps[-6:-1]) < 0) and steps[-6] < 0.03
    assert {row["belts"] for row in table} == {"1"}
    assert [row["condition"] for row in table if not row["special"]] == list(fold.kinds)
    assert "belts[0].velocity" in fold.table()


@pytest.mark.slow(first=True)
def test_curves_have_the_symmetries_of_the_plane(points, fold):
    """The mirror image nu -> -nu, row by row; the belts exchanged, in the special points."""
    mirrored = jb.scan(jb.presets.class_b(0.3, -0.35), nu0, (0.5, 0.6))
    (start,) = mirrored
    image = jb.bifurcation_curve(start, (nu0, nu1), PLANE, step=0.02)
    assert len(image) == len(fold)
    same = image.values if np.allclose(image.values[0], -fold.values[0]) else image.values[::-1]
    assert np.allclose(same, -fold.values, rtol=0, atol=1e-9)

    other = jb.bifurcation_curve(points[1], (nu0, nu1), PLANE, step=0.02)
    assert points[1].condition == jb.GrazingSliding(0)
    (double,) = (point for point in other.special if point.kind == "DoubleSliding")
    assert double.belts == (1,)
    assert double.values == pytest.approx(fold.special[0].values, abs=1e-9)


@pytest.mark.slow(first=True)
def test_an_exchange_ends_where_the_cycle_does(points):
    curve = jb.bifurcation_curve(points[6], (nu0, nu1), PLANE, step=0.05)
    assert np.allclose(curve.values[:, 0], curve.values[:, 1], rtol=0, atol=1e-13)
    rest, end = curve.special
    assert rest.kind == "BeltAtRest" and end.kind == "DoubleSliding"
    # Equal belts at one velocity are one belt of twice the load: the fold is the oracle's.
    expected = oracle_cycles.nonsmooth_fold(
        lambda nu: oracle.class_a(nu, load=2.0), (0.48, 0.50), 0
    )
    assert end.values[0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("where", "span", "message"),
    [
        ((nu0, nu0), PLANE, "where must be two different parameters"),
        ((nu0, nu1), ((0.0, 0.7), (-0.7, 0.7)), "span must be around the point"),
        ((nu0, nu1), ((-0.7, np.nan), (-0.7, 0.7)), "be finite"),
    ],
)
def test_impossible_arguments_are_named(points, where, span, message):
    with pytest.raises(ValueError, match=message):
        jb.bifurcation_curve(points[0], where, span)


@pytest.mark.slow(first=True)
def test_nothing_departs_from_a_belt_at_rest_in_a_focus():
    """The cycle there shrinks with the velocity of the belt, in a ratio that is known."""
    law = jb.Conti(1.0, 0.6, 2.0)

    def gentle(nu):
        return jb.Oscillator(0.3, (jb.Belt(-0.2, law), jb.Belt(nu, law)))

    codes, resting = jnp.array([-1.0, 1.0]), jnp.asarray(1)
    assert np.all(np.isnan(_departure(gentle(0.0), codes, resting)))
    a = 0.5 * (0.8 + 0.8 / 1.4**2 - 0.3)  # half the trace; the determinant is one
    for nu in (1e-4, 1e-5):
        cycle = jb.find_cycle(gentle(nu), (0.32, nu))
        assert [belt for _, belt in cycle.signature] == [1, 1]
        # Where the law bends counts in first order.
        expected = -np.exp(np.pi * a / np.sqrt(1 - a**2))
        assert cycle.x2_min / nu == pytest.approx(expected, rel=20 * nu)

    # With real eigenvalues the orbit is followed backwards to the equilibrium, along their line.
    osc = jb.presets.class_b(-0.3, 0.0)
    y = np.asarray(_departure(osc, codes, resting))
    rest = 1 - 0.6 - 0.4 / 4
    trace = 4 + 4 / 4**2 - 0.5
    strong = 0.5 * trace + np.sqrt(0.25 * trace**2 - 1)
    assert y[1] < 0 and (y[0] - rest) / y[1] == pytest.approx(1 / strong, rel=1e-3)


@pytest.mark.slow(first=True)
def test_a_curve_ends_where_its_cycle_shrinks_to_a_point():
    # A cycle around the edge x1 = 0 that touches the boundary of belt 0 there is as small as that
    # velocity. With both belts at rest it is a point, in which its equations are singular.
    osc = jb.presets.class_c(nu0=0.1665, nu1=-0.171837304014, sigma=0.0)
    point = jb.refine(jb.CornerCollision(0), osc, where=nu1)
    curve = jb.bifurcation_curve(point, (nu0, nu1), ((-0.02, 0.2), (-0.2, 0.02)), step=0.02)
    assert np.all(np.abs(curve.values) > 0.005)  # the last step goes across
    found = {(special.kind, special.belts): special for special in curve.special}
    at_rest = {("BeltAtRest", (0,)), ("BeltAtRest", (1,)), ("EqualVelocities", (0, 1))}
    assert set(found) == at_rest
    for special in found.values():
        assert special.residual < 1e-8
        assert special.values == pytest.approx((0.0, 0.0), abs=special.residual)
    assert curve.ends == (Stop.STOPPED, Stop.LEFT_SPAN)


@pytest.mark.parametrize(
    ("watched", "values"),
    [
        (lambda nu: nu - 0.3, [0.3]),
        (lambda nu: np.cbrt(nu - 0.3), [0.3]),
        (lambda nu: 1.0 if nu > 0.3 else -1.0, []),
        (lambda nu: 1e-16 * (nu - 0.3), []),
    ],
    ids=["smooth", "steep", "jump", "rounding"],
)
def test_what_jumps_over_zero_or_is_zero_all_along_is_no_special_point(watched, values):
    found = special_along({("Special", ()): watched})
    assert [point.values[0] for point in found] == pytest.approx(values, abs=1e-12)


@pytest.mark.parametrize(("away", "told"), [(1e-7, 1), (0.1, 2)])
def test_what_vanishes_where_a_belt_comes_to_rest_is_no_second_contact(away, told):
    """Beside a belt at rest nothing is solved for, so that point is extrapolated."""
    watched = {
        ("BeltAtRest", (1,)): lambda nu: np.nan if abs(nu - 0.3) < 0.02 else np.sinh(nu - 0.3),
        ("DoubleSliding", (1,)): lambda nu: nu - 0.3 - away,
    }
    found = special_along(watched)
    rest = next(point for point in found if point.kind == "BeltAtRest")
    assert rest.residual > 2e-7 and rest.values[0] == pytest.approx(0.3, abs=rest.residual)
    assert len(found) == told


def special_along(watched):
    """The special points where functions of nu, by their names, are watched from 0 to 1."""

    class Straight(Track):
        def corrected(self, u, tangent, length):
            return Corrected(np.asarray(u) + length * np.asarray(tangent), tangent, 1, 1.0, True)

        def seen_at(self, u):
            return Seen({name: one(u[-2]) for name, one in watched.items()}, True, np.nan, 0.0)

    nothing: Any = None
    track, tangent = Straight(nothing, nothing, nothing), np.array([1.0, 0.0])
    ends = [
        (CurvePoint(np.array([nu, 0.1]), tangent, 1, None, 1.0), track.seen_at([nu, 0.1]))
        for nu in (0.0, 1.0)
    ]
    return special_between(track, np.array([[-1.0, 1.0], [-1.0, 1.0]]), *ends)


def class_d(p, q):
    return jb.presets.class_d(p, q, sigma0=0.2, sigma1=0.9)


@pytest.mark.slow(first=True)
def test_belts_of_two_velocities_do_not_hold_the_mass_together():
    """From a guess where they are equal: there is no corner on nu1 = 0.2, where the onset on belt 1
    alone is on the edge, as the mass sticks to the slower belt 0."""
    point = jb.refine(jb.CornerCollision(0), lambda q: class_d(0.195, q), at=0.195)
    assert abs(float(point.value) - 0.2) > 1e-3
    cycle = jb.find_cycle(class_d(0.195, 0.2), (3.0, 0.0))
    assert cycle.x2_max == 0.195 and float(cycle.stick_durations[1]) == 0


@pytest.mark.slow(first=True)
def test_a_curve_turns_where_a_slip_onset_comes_to_an_edge():
    """The edge tears the mass off belt 0. Where it would still hold, the cycle is another one."""
    point = jb.refine(jb.CornerCollision(1), lambda q: class_d(0.3798, q), at=-0.4225)
    curve = jb.bifurcation_curve(point, class_d, ((0.25, 0.4), (-0.5, -0.3)), step=0.02)
    # x1 + zeta nu0 + mu(nu0 - nu1) = 1 at the edge x1 = 0.2.
    excess = [0.5 * p + 0.4 / (1 + 10 * (p - q)) - 0.2 for p, q in curve.values]
    assert min(excess) > -1e-13
    (turn,) = (special for special in curve.special if special.kind == "EdgeTouch")
    p, q = turn.values
    assert 0.5 * p + 0.4 / (1 + 10 * (p - q)) == pytest.approx(0.2, abs=1e-13)
    assert curve.ends == (Stop.LEFT_SPAN, Stop.LEFT_SPAN)
    for p, q in curve.values[1:-1:4].tolist():
        again = jb.refine(jb.CornerCollision(1), lambda v, p=p: class_d(p, v), at=q + 1e-3)
        assert again.value == pytest.approx(q, abs=1e-12)


@pytest.mark.slow(first=True)
def test_a_curve_of_corners_ends_where_its_cycle_shrinks_with_a_belt_to_a_pseudo_focus():
    """Class (c), sigma = -1/2, at (0, -1/2): a_L = 1/2 + mu(0), tr_L = 4 - zeta there, and a_R =
    1/2 - mu(1/2), tr_R = 4/36 - zeta, so that tr_L/a_L = 7/3 = -tr_R/|a_R|: the rate is zero."""

    def make(p, q):
        return jb.presets.class_c(p, q, sigma=-0.5)

    point = jb.refine(jb.CornerCollision(0), lambda p: make(p, -0.4), at=0.0112)
    curve = jb.bifurcation_curve(point, make, ((-0.1, 0.02), (-0.6, -0.36)))
    (rest,) = curve.special
    assert (rest.kind, rest.belts) == ("BeltAtRest", (0,)) and rest.residual < 1e-14
    # The slopes of the two equations are of size one.
    assert rest.values == pytest.approx((0.0, -0.5), abs=1e-14)
    assert set(curve.ends) == {Stop.STOPPED, Stop.LEFT_SPAN}
    # Its rows from nu0 = 0.013 to 0.006 lead there; polynomials of degrees 3 and 4 differ by 6e-4.
    p, q = curve.values[np.argsort(curve.values[:, 0])[:9]].T
    assert np.polyval(np.polyfit(p, q, 4), 0.0) == pytest.approx(-0.5, abs=6e-4)


@pytest.mark.slow(first=True)
def test_a_corner_is_no_second_contact_of_its_own():
    """Seen from one side, the cycle passes the edge and meets the boundary at once: what lies
    between takes no time, up to rounding. `scan` comes from both sides."""
    osc = jb.presets.class_d(0.09, -0.0009, -1.0, 0.2)
    points = jb.scan(osc, nu0, (0.09, 0.095), resolution=8)
    corners = [point for point in points if point.condition == jb.CornerCollision(0)]
    assert corners
    for corner in corners:
        spans = (0.09, 0.0935), (-0.005, 0.001)
        curve = jb.bifurcation_curve(corner, (nu0, nu1), spans, step=0.005)
        (rest,) = curve.special
        assert (rest.kind, rest.belts) == ("BeltAtRest", (1,)) and rest.residual < 1e-8


@pytest.mark.slow(first=True)
def test_the_boundary_of_another_belt_may_come_to_a_corner():
    """Where both belts have one velocity."""
    point = jb.refine(jb.CornerCollision(0), lambda q: class_d(0.3, q), at=0.325)
    curve = jb.bifurcation_curve(point, class_d, ((0.25, 0.4), (0.25, 0.4)))
    assert {one.kind for one in curve.special} == {"EqualVelocities", "DoubleSliding"}
    for one in curve.special:
        assert one.values[0] == pytest.approx(one.values[1], abs=1e-12) and one.residual < 1e-12


@pytest.mark.slow(first=True)
def test_a_point_where_the_cycle_passes_an_edge_in_two_corners_is_told_along_all_curves_there():
    """Of class (c): on the way to the right it passes the edge with the velocity of belt 0, on the
    way back with that of belt 1. Four curves of corners meet; on one of them the cycle sticks to
    both belts beside the point, on two to one, on one to none."""

    def make(nu0, nu1):
        return jb.presets.class_c(nu0, nu1, -0.5)

    found = []
    for velocity, guess in ((-0.2343, 0.255), (-0.2383, 0.235), (-0.2322, 0.23), (-0.2291, 0.23)):
        point = jb.refine(jb.CornerCollision(0), functools.partial(make, nu1=velocity), at=guess)
        curve = jb.bifurcation_curve(point, make, ((0.225, 0.26), (-0.25, -0.22)))
        (double,) = curve.special
        assert double.kind == "DoubleSliding" and double.residual < 1e-12
        found.append(double.values)
    assert np.max(np.ptp(found, axis=0)) < 1e-11
    # An orbit of the engine passes both corners in turn; errors do not grow on a loop.
    law, values = ("conti", 1.0, 0.6, 10.0), found[0]
    belts = engine.Belt(values[0], law, upper=-0.5), engine.Belt(values[1], law, lower=-0.5)
    run = engine.simulate(engine.Oscillator(0.5, belts), (-0.5, values[0]), 4.0)
    passed = run.y[run.kind == engine.EDGE]
    np.testing.assert_allclose(passed[:3, 1], [values[1], values[0], values[1]], atol=1e-10)
    assert np.all(passed[:, 0] == -0.5)


@pytest.mark.slow(first=True)
def test_a_curve_is_the_same_in_any_units():
    """In thousandths and in thousands, as of velocities in mm/s and forces in kN."""

    def curve(*units, most=200):
        def make(p, q):
            return jb.presets.class_b(p / units[0], q / units[1])

        part = (0.1, 0.4), (0.2, 0.5)
        at, span = 0.27 * units[0], [(a * u, b * u) for u, (a, b) in zip(units, part, strict=True)]
        point = jb.refine(jb.Hopf(), lambda p: make(p, 0.35 * units[1]), at=at)
        return jb.bifurcation_curve(point, make, tuple(span), max_points=most)

    one, other = curve(1.0, 1.0), curve(1e3, 1e-3)
    assert len(one) == len(other) > 30 and one.ends == other.ends
    np.testing.assert_allclose(other.values / [1e3, 1e-3], one.values, rtol=1e-9)
    assert "cut off" not in repr(one)
    assert "cut off at max_points" in repr(curve(1.0, 1.0, most=5))


@pytest.fixture(scope="module")
def grazing():
    return jb.refine(jb.GrazingSliding(0), lambda v: jb.presets.class_b(v, 0.35), at=-0.45)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("step", [0.02, 0.03, 0.04, 0.06])
def test_a_curve_goes_on_behind_a_second_contact_whatever_the_step_is(grazing, step):
    """With every other step it ended there, as too few distances behind were tried."""
    curve = jb.bifurcation_curve(grazing, jb.presets.class_b, ((-0.7, 0.7), (0.05, 0.6)), step=step)
    assert curve.ends == (Stop.LEFT_SPAN, Stop.LEFT_SPAN)
    ends = [[-0.3339897401171, 0.6], [-0.3339577470966, 0.05]]
    np.testing.assert_allclose(curve.values[[0, -1]], ends, rtol=0, atol=1e-11)


def with_an_edge(sigma, velocity):
    return jb.presets.class_d(0.35, velocity, 0.0, sigma)


def corner(at):
    return jb.refine(jb.CornerCollision(0), lambda sigma: with_an_edge(sigma, 0.2), at=at)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("step", [0.01, 0.02])
@pytest.mark.parametrize("is_swapped", [False, True])
def test_a_curve_goes_on_where_its_cycle_is_there_only_just_beside_it(step, is_swapped):
    """Behind belts of one velocity guesses from which to begin are few; both orders agree."""
    make, span = with_an_edge, ((0.3, 1.5), (-0.3, 0.6))
    if is_swapped:
        make, span = (lambda v, s: with_an_edge(s, v)), span[::-1]
    curve = jb.bifurcation_curve(corner(0.6), make, span, step=step)
    values = curve.values[:, ::-1] if is_swapped else curve.values
    assert Stop.LEFT_SPAN in curve.ends
    last = values[np.argmax(values[:, 0])]
    np.testing.assert_allclose(last, [1.5, 0.4210273673315], rtol=0, atol=1e-11)


@pytest.mark.slow
def test_places_are_those_of_the_cycles_beside():
    """Where x2 has got an extremum within an arc its smallest value was that of an event."""
    span = (0.55, 1.0), (0.04, 0.3)
    curve = jb.bifurcation_curve(corner(0.9), with_an_edge, span, step=0.03)
    known = 0
    for (sigma, velocity), place in zip(curve.values, curve.places, strict=True):
        for side in (1e-7, -1e-7):
            cycle = jb.find_cycle(with_an_edge(sigma + side, velocity), (1.0, 0.0))
            numbers = cycle.x1_min, cycle.x1_max, cycle.x2_min, cycle.x2_max, cycle.period
            if int(cycle.status) == jb.Status.OK and abs(cycle.x1_max - place[1]) < 1e-3:
                np.testing.assert_allclose(numbers, place, rtol=0, atol=2e-4)
                known += 1
    assert known > len(curve) // 2 and np.ptp(curve.places[:, 2]) > 0.05


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("count", [1, 2, 11, 12])
def test_a_curve_has_as_many_points_as_asked_for(points, count):
    curve = jb.bifurcation_curve(
        points[0], (nu0, nu1), ((-0.7, 0.7), (0.05, 0.6)), max_points=count
    )
    assert len(curve) == 2 * count - 1
