"""Measures of basins: entropy and finite-time stability, against closed forms and `simulate`."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import expm

import jaxbelt as jb

# --- finite-time basin stability ------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_a_linear_oscillator_comes_near_when_its_solution_does():
    """Constant friction of a belt that is always faster: a damped oscillator around x1 = 1."""
    osc = jb.Oscillator(0.4, (jb.Belt(5.0, jb.Stribeck(1.0, 1.0, 0.5)),))
    axes = {"x1": np.linspace(-0.5, 2.5, 31), "x2": np.linspace(-1.5, 1.5, 29)}
    found = jb.basins(osc, **axes, progress=False)
    assert found.attractors == ("rest at 1.000",)
    starts = np.stack(np.meshgrid(*axes.values(), indexing="ij"), axis=-1) - [1.0, 0.0]
    shares = []
    for t in (1e-6, 2.0, 5.0, 12.0):
        there = starts @ expm(t * np.array([[0.0, 1.0], [-1.0, -0.4]])).T
        away = np.hypot(there[..., 0], there[..., 1])
        assert np.min(np.abs(away - 0.31)) > 1e-6  # no start is in doubt
        shares.append(np.mean(away < 0.31))
        assert found.finite_time_stability(t, 0.31).tolist() == [shares[-1]]
    assert shares[0] < shares[1] < shares[2] < shares[3] == 1


@pytest.mark.slow(first=True)
def test_near_a_cycle_is_near_to_one_of_its_states():
    osc = jb.presets.class_b(0.45, 0.35)
    x1, x2 = np.linspace(1.0, 1.7, 7), np.array([-0.2, 0.03])
    found = jb.basins(osc, x1=x1, x2=x2, progress=False)
    assert [name.split()[0] for name in found.attractors] == ["rest", "cycle"]
    labels, rest = np.asarray(found.label), [float(jb.equilibria(osc).x1[0]), 0.0]
    # By other means: chords of a fine polygon are shorter than 1e-4.
    polygon = np.asarray(found.cycles[0].sample(100_000))
    for t, within in ((2.0, 0.03), (6.0, 0.02), (30.0, 0.01)):
        near = np.zeros(2)
        for (i, j), label in np.ndenumerate(labels):
            end = np.asarray(jb.simulate(osc, (x1[i], x2[j]), t, ts=np.array([t])).ys[-1])
            away = np.min(np.hypot(*(end - (polygon if label == 1 else [rest])).T))
            assert abs(away - within) > 1e-4
            near[label] += away < within
        told = found.finite_time_stability(t, within)
        np.testing.assert_allclose(told, near / labels.size, rtol=0, atol=1e-15)
    ever = [np.mean(labels == 0), np.mean(labels == 1)]
    np.testing.assert_allclose(found.finite_time_stability(1000.0, 1e-3), ever, atol=1e-15)
    with pytest.raises(ValueError, match=r"t must be > 0, got 0\.0"):
        found.finite_time_stability(0.0, 0.1)
    with pytest.raises(ValueError, match=r"within must be > 0, got -1\.0"):
        found.finite_time_stability(1.0, -1.0)


@pytest.mark.slow(first=True)
def test_a_mass_that_is_held_is_at_its_segment_wherever_on_it():
    osc = jb.Oscillator(0.1, (jb.Belt(0.0, jb.Stribeck(1.0, 0.5, 0.5)),))
    found = jb.basins(osc, x1=np.array([-0.6, 0.3, 2.0]), x2=np.array([0.0]), progress=False)
    assert found.attractors == ("stuck to belt 0",)
    # Two begin there and stay; the third is on its way.
    assert found.finite_time_stability(0.5, 1e-6).tolist() == [2 / 3]
    assert found.finite_time_stability(50.0, 1e-6).tolist() == [1.0]


# --- basin entropy --------------------------------------------------------------------------------


def entropy_of(labels, side):
    """Of basins of which only the labels are known."""
    return jb.Basins.entropy(SimpleNamespace(label=np.asarray(labels)), side)


def test_one_basin_has_no_entropy():
    entropy = entropy_of(np.zeros((6, 4), int), 2)
    assert entropy.basins == 0 and np.isnan(entropy.boundary)


def test_a_straight_boundary():
    """Through the middles of one column of boxes of three."""
    labels = np.zeros((20, 12), int)
    labels[10:] = 1
    entropy = entropy_of(labels, 4)
    assert entropy.boundary == pytest.approx(np.log(2), abs=1e-15)
    assert entropy.basins == pytest.approx(np.log(2) / 5, abs=1e-15)
    # On the edges of boxes it is not seen.
    assert entropy_of(labels, (10, 4)).basins == 0
    # A quarter of each box.
    labels[9:] = 1
    quarter = -0.25 * np.log(0.25) - 0.75 * np.log(0.75)
    assert entropy_of(labels, 4).boundary == pytest.approx(quarter, abs=1e-15)


def test_a_checkerboard_and_more_than_two_labels():
    board = np.indices((8, 6)).sum(axis=0) % 2
    assert entropy_of(board, 2) == pytest.approx((np.log(2), np.log(2)), abs=1e-15)
    three = np.tile([[-1, 0, 1]], (4, 2))
    assert entropy_of(three, (2, 3)) == pytest.approx((np.log(3),) * 2, abs=1e-15)
    assert entropy_of(three, 1).basins == 0


@pytest.mark.parametrize(
    ("side", "message"),
    [
        (5, r"side must be one that divides the 8 x 6 starts, got 5"),
        ((2, 4), r"side must be one that divides the 8 x 6 starts, got \(2, 4\)"),
        (0, "side must be a positive integer, got 0"),
        ((2, -1), "side must be a positive integer, got -1"),
    ],
)
def test_impossible_boxes_are_named(side, message):
    with pytest.raises(ValueError, match=message):
        entropy_of(np.zeros((8, 6), int), side)
