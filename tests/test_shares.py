"""`attractors`: which there are at each point of a sweep over starts, and how many lead to each."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr

import jaxbelt as jb

STARTS = {"x1": np.linspace(0.5, 3.0, 6), "x2": np.array([0.0, 0.3])}


@pytest.fixture(scope="module")
def dataset():
    axes = {"nu0": [0.1, 0.45], "nu1": [0.35], **STARTS}
    return jb.sweep(jb.presets.class_b, axes, observe="attractor")


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


def test_they_can_be_drawn_and_written(dataset, tmp_path):
    found = jb.attractors(dataset)
    found.kind.isel(nu1=0).plot()
    plt.close("all")
    found.to_netcdf(tmp_path / "a.nc", engine="scipy")
    found.to_zarr(tmp_path / "a.zarr", consolidated=False)
    read = xr.open_dataset(tmp_path / "a.nc", engine="scipy")
    assert read.equals(found) and jb.decoded(read).equals(jb.decoded(found))
    assert xr.open_zarr(tmp_path / "a.zarr", consolidated=False).equals(found)


def test_undecided_runs_are_no_attractor(dataset):
    some = dataset.copy(deep=True)
    some.kind[0, 0, 0, 0] = 0
    assert float(jb.attractors(some).fraction[0].sum()) == pytest.approx(11 / 12)


def test_impossible_datasets_are_named(dataset):
    with pytest.raises(ValueError, match="dataset must be one with an axis x1 or x2 of starts"):
        jb.attractors(dataset.isel(x1=0, x2=0))
    with pytest.raises(ValueError, match="dataset must be that of sweep"):
        jb.attractors(dataset.drop_vars("kind"))
