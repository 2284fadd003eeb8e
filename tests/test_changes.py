"""How curves go on where the signature of their motion changes, or end there: the same whatever the
order of the parameters, the length of steps and the direction."""

import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt.numerics.continuation import Stop


def both_ways(make, kind, along, span, **options):
    """The curve of the first point of a kind along the first parameter, at the second one's value,
    with the parameters in both orders."""
    first, value = along

    def swapped(q, p):
        return make(p, q)

    found = jb.scan(lambda p: make(p, value), span=first)
    point = next(one for one in found if one.kind == kind)
    curve = jb.bifurcation_curve(point, make, span, **options)
    other = jb.bifurcation_curve(point, swapped, span[::-1], **options)
    values, others = curve.values, other.values[:, ::-1]
    if np.linalg.norm(values[0] - others[0]) > np.linalg.norm(values[0] - others[-1]):
        return curve, values, others[::-1], other
    return curve, values, others, other


def doubled(values):
    """How many rows lie on chords between rows that are not beside them."""
    count = 0
    for row, at in enumerate(values):
        a, b = values[:-1], values[1:]
        part = np.clip(np.sum((at - a) * (b - a), axis=1) / np.sum((b - a) ** 2, axis=1), 0, 1)
        away = np.linalg.norm(at - a - part[:, None] * (b - a), axis=1)
        away[max(0, row - 2) : row + 2] = np.inf
        count += np.min(away) < 1e-5
    return count


@pytest.mark.slow
def test_a_curve_of_folds_does_not_turn_back_where_it_ends():
    law = jb.presets.paper_friction()

    def make(load, damping):
        return jb.Oscillator(damping, (jb.Belt(0.3, law), jb.Belt(0.1, law, load=load)))

    span = (0.0, 0.6), (0.0, 1.0)
    curve, values, others, other = both_ways(make, "FoldOfCycles", ((0.01, 0.3), 0.05), span)
    assert {*curve.ends} == {*other.ends} == {Stop.STOPPED, Stop.LEFT_SPAN}
    np.testing.assert_allclose(values, others, rtol=0, atol=1e-10)
    assert values[-1] == pytest.approx((0.0626486510, 0.0), abs=1e-9) and doubled(values) == 0
    # SciPy's return map of tops at the damping 0.02 has two cycles above this load, none below it.
    at = np.interp(0.02, values[::-1, 1], values[::-1, 0])
    assert at == pytest.approx(0.0568885, abs=1e-4)


@pytest.mark.slow
def test_a_turning_point_may_be_much_sharper_than_a_step():
    def make(velocity, steepness):
        law = jb.Conti(1.0, 0.6, steepness)
        return jb.Oscillator(0.5, (jb.Belt(velocity, law), jb.Belt(0.35, law)))

    span = (0.05, 0.65), (30.0, 36.0)
    found = both_ways(make, "NonsmoothFold", ((0.21, 0.345), 36.0), span, max_points=3000)
    curve, values, others, _ = found
    assert curve.ends == (Stop.LEFT_SPAN, Stop.LEFT_SPAN)
    np.testing.assert_allclose(values[[0, -1]], others[[0, -1]], rtol=0, atol=1e-10)
    assert sorted(values[[0, -1], 0]) == pytest.approx([0.290543013, 0.323939750], abs=1e-8)
    assert values[:, 1].min() == pytest.approx(34.8709, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.01, 0.02])
def test_special_points_lie_in_the_span(step):
    span = (-0.2, 0.62), (0.02, 0.61)
    kind, along = "SlidingExchange", ((0.1, 0.3), 0.2)
    found = both_ways(jb.presets.class_b, kind, along, span, step=step)
    curve, values, _, other = found
    assert np.min(values[:, 1]) == pytest.approx(0.02, abs=1e-12)
    for one in (curve, other):
        assert "BeltAtRest" not in [special.kind for special in one.special]
        assert np.min(one.path) > 0.02 - 1e-12


@pytest.mark.slow
def test_a_curve_of_corners_goes_on_where_its_cycle_touches_an_edge():
    def make(edge, velocity):
        first = jb.Belt(velocity, jb.Conti(1.0, 0.656664, 6.898148), upper=0.510321)
        other = jb.Belt(-0.379154, jb.Conti(1.0, 0.6, 10.0), load=0.902374, lower=edge)
        return jb.Oscillator(0.393725, (first, other))

    span, along = ((-1.0, 0.5), (-0.6, 0.6)), ((0.04, 0.1), 0.028901)
    curve, values, others, other = both_ways(make, "CornerCollision", along, span)
    touched = [one.values for one in curve.special if one.kind == "EdgeTouch"]
    assert any(at == pytest.approx((0.27319, 0.36185), abs=2e-5) for at in touched)
    assert {*curve.ends} == {*other.ends} == {Stop.LEFT_SPAN, Stop.STOPPED}
    np.testing.assert_allclose(values, others, rtol=0, atol=1e-6)
    right = values[np.argmax(values[:, 0])]
    assert right == pytest.approx((0.5, 0.26570785), abs=1e-7)
    # What a path across it finds there.
    found = jb.scan(lambda edge: make(edge, 0.3), span=(0.4, 0.5))
    (corner,) = [float(one.value) for one in found if one.kind == "CornerCollision"]
    beyond = values[values[:, 0] > 0.4]
    beyond = beyond[np.argsort(beyond[:, 1])]
    assert np.interp(0.3, beyond[:, 1], beyond[:, 0]) == pytest.approx(corner, abs=1e-4)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("step", [0.5, 0.1])
def test_a_curve_at_infinity_goes_on_until_nothing_rubs(step):
    """zeta = -2/pi p2 u0 for a contact interval of length 1, down to the load 0."""
    law = jb.Conti(1.0, 0.6, 10.0, 0.3)

    def make(damping, load=1.0):
        return jb.Oscillator(damping, (jb.Belt(0.3, law, load=load, lower=-0.5, upper=0.5),))

    point = jb.refine(jb.HopfAtInfinity(), make, at=-0.1)
    expected = np.array([2.0, 0.0])
    for least, end in ((0.0, Stop.LEFT_SPAN), (-1.0, Stop.STOPPED)):
        curve = jb.bifurcation_curve(point, make, ((-1.0, 1.0), (least, 2.0)), step=step)
        assert curve.ends == (Stop.LEFT_SPAN, end) and curve.special == ()
        assert curve.values[[0, -1], 1] == pytest.approx(expected, abs=1e-12)
        slope = -0.6 / np.pi
        # The growth of mu is that of its values at speeds of 1e8.
        np.testing.assert_allclose(curve.values[:, 0], slope * curve.values[:, 1], atol=1e-9)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("step", [0.1, 0.03])
def test_a_curve_of_pseudo_foci_has_a_row_at_its_ends_and_all_special_points(step):
    """From the Hopf point of belt 1 alone on the edge of belt 0 to that of both belts."""
    law = jb.presets.paper_friction()

    def make(upper, velocity):
        belts = jb.Belt(0.35, law, upper=upper), jb.Belt(velocity, law, lower=0.1)
        return jb.Oscillator(0.5, belts)

    point = jb.refine(jb.PseudoHopf(0), lambda upper: make(upper, 0.25), at=1.4)
    curve = jb.bifurcation_curve(point, make, ((-2.0, 2.5), (-1.0, 1.0)), step=step)
    kinds = [one.kind for one in curve.special]
    assert kinds == ["BoundaryHopf", "DegeneratePseudoHopf", "BoundaryHopf"]
    alone, both = (np.sqrt(8) - 1) / 10, (np.sqrt(4 / (0.5 - 4 / 4.5**2)) - 1) / 10
    pull = 0.6 + 0.4 / (1 + 10 * np.array([alone, both]))
    expected = [(pull[0], alone), (0.6 + 0.4 / 4.5 + pull[1], both)]
    np.testing.assert_allclose(curve.values[[0, -1]], expected, rtol=0, atol=1e-12)
