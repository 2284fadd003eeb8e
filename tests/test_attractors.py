"""`attractors`: which there are at each point of a sweep over starts, and how many lead to each."""

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from laws import Bump

import jaxbelt as jb

STARTS = {"x1": np.linspace(0.5, 3.0, 6), "x2": np.array([0.0, 0.3])}


@pytest.fixture(scope="module")
def dataset():
    axes = {"nu0": [0.1, 0.45], "nu1": [0.35], **STARTS}
    return jb.sweep(jb.presets.class_b, axes, observe="attractor")


@pytest.mark.slow(first=True)
def test_attractors_and_fractions_are_those_of_basins(dataset):
    found = jb.attractors(dataset)
    assert found.fraction.dims == ("nu0", "nu1", "attractor") and found.attractor.size == 2
    words = jb.decoded(found)
    basins = jb.basins(jb.presets.class_b(0.45, 0.35), **STARTS)
    shares = [float(np.mean(basins.label == k)) for k in range(2)]
    assert found.fraction[1, 0].values.tolist() == shares and min(shares) > 0
    for k, name in enumerate(basins.attractors):
        kind = str(words.kind[1, 0, k].values)
        assert name.startswith("cycle" if kind == "cycle" else "rest")
        one = dataset.isel(nu0=1, nu1=0).where(basins.label == k)
        np.testing.assert_allclose(found.x1_max[1, 0, k], one.x1_max.mean(), atol=1e-5)
        assert np.array_equal(found.sticks[1, 0, k], one.sticks.max(["x1", "x2"]))
    absent = found.isel(nu0=0, nu1=0, attractor=1)
    assert absent.fraction == 0 and np.isnan(absent.period) and words.kind[0, 0, 1] == "undecided"


@pytest.mark.slow(first=True)
def test_they_can_be_drawn_and_written(dataset, tmp_path):
    found = jb.attractors(dataset)
    found.kind.isel(nu1=0).plot()
    found.to_netcdf(tmp_path / "a.nc", engine="scipy")
    found.to_zarr(tmp_path / "a.zarr", consolidated=False)
    read = xr.open_dataset(tmp_path / "a.nc", engine="scipy")
    assert read.equals(found) and jb.decoded(read).equals(jb.decoded(found))
    assert xr.open_zarr(tmp_path / "a.zarr", consolidated=False).equals(found)


@pytest.mark.slow
def test_two_cycles_with_one_sequence_of_events_are_two():
    """Both stick to belt 0 once a loop, to the left of where belt 1 begins and to the right."""

    def make(nu0):
        return jb.presets.class_d(nu0, 0.5073, -0.49694, 0.61855)

    starts = {"x1": np.linspace(-2.0, 2.0, 9), "x2": np.linspace(-1.0, 1.0, 5)}
    runs = jb.sweep(make, {"nu0": [-0.06341], **starts}, observe="attractor")
    found = jb.attractors(runs).isel(nu0=0)
    assert np.all(jb.decoded(found).signature == "stick0-slip0")
    assert found.period.values == pytest.approx([10.9019400715, 9.9148027860], abs=1e-7)
    assert found.fraction.values.tolist() == [40 / 45, 5 / 45]


@pytest.mark.slow(first=True)
def test_runs_that_leave_it_open_are_told_apart_by_shooting(dataset):
    """As far apart as runs of one cycle that attracts weakly, or of two cycles."""
    moved = dataset.copy(deep=True)
    moved.x1_max.values[0, 0, 3:] += 1e-3
    with pytest.raises(ValueError, match=r"make must be given, .* got None; .* at 1 points"):
        jb.attractors(moved)
    found = jb.attractors(moved, jb.presets.class_b)
    assert found.equals(jb.attractors(dataset))


@pytest.mark.slow(first=True)
def test_near_cycles_are_two_and_a_weak_one_is_one():
    """Two that are a four-hundredth of their size apart, and one whose runs differ by as much."""

    def make(gain, bump):
        belt = jb.Belt(1.0, Bump(jnp.asarray(3.0), jnp.asarray(gain), jnp.asarray(bump)))
        return jb.Oscillator(0.5, (belt,))

    starts = {"x1": np.linspace(1.684, 1.716, 11)}
    axes = {"gain": [0.0002, 0.03], "bump": [0.0, 6.0], **starts}
    # The weak one attracts by a thousandth of the way a loop: where its runs end is rounding.
    runs = jb.sweep(make, axes, y0=(0.0, 0.0), t1=1e5, observe="attractor")
    runs.x1_max.values[0, 0] = 1.7 + np.linspace(-1e-4, 1e-4, 11)
    weak, pair = runs.isel(gain=0, bump=0), runs.isel(gain=1, bump=1)
    for doubtful in (weak, pair):
        assert 5e-5 < np.ptp(doubtful.x1_max.values) < 5e-3
        with pytest.raises(ValueError, match="make must be given"):
            jb.attractors(doubtful)
    assert jb.attractors(weak, make).fraction.values.tolist() == [1.0]
    found = jb.attractors(pair, make)
    assert found.fraction.values.tolist() == [6 / 11, 5 / 11]
    # By the return map of the same field, integrated by SciPy.
    assert found.x1_max.values == pytest.approx([1.700785, 1.704355], abs=2e-6)
    every = jb.attractors(runs, make)
    assert np.sum(every.fraction > 0, axis=-1).values.tolist() == [[1, 1], [1, 2]]


@pytest.mark.slow(first=True)
def test_undecided_runs_are_no_attractor(dataset):
    some = dataset.copy(deep=True)
    some.kind[0, 0, 0, 0] = 0
    assert float(jb.attractors(some).fraction[0].sum()) == pytest.approx(11 / 12)


@pytest.mark.slow(first=True)
def test_impossible_datasets_are_named(dataset):
    with pytest.raises(ValueError, match="dataset must be one with an axis x1 or x2 of starts"):
        jb.attractors(dataset.isel(x1=0, x2=0))
    with pytest.raises(ValueError, match="dataset must be that of sweep"):
        jb.attractors(dataset.drop_vars("kind"))
