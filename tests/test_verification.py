"""Verification: harmed axes and metadata are found, and named with what to do."""

import functools
import shutil

import numpy as np
import pytest
import xarray as xr
import zarr
from typer.testing import CliRunner

import jaxbelt as jb
from jaxbelt.cli import app
from jaxbelt.sweeps import store as stores

AXES = {"nu0": np.linspace(-0.6, 0.55, 5), "nu1": np.array([0.35, -0.2, 0.1])}
sweep = functools.partial(jb.sweep, jb.presets.class_b, observe="attractor", progress=False)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A finished store of five blocks."""
    path = tmp_path_factory.mktemp("original") / "a.zarr"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stores, "BLOCK_RUNS", 4)
        sweep(AXES, store=path)
    return path


@pytest.fixture
def path(original, tmp_path):
    return shutil.copytree(original, tmp_path / "a.zarr")


@pytest.fixture(scope="module")
def whole():
    return sweep(AXES)


def removed(file):
    file.unlink()


def emptied(file):
    file.write_bytes(b"")


def flipped(file):
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


def other(file):
    """A chunk that can be read, with other values."""
    axis = zarr.open_array(file.parent.parent, mode="r+")
    axis[1] = np.nextafter(axis[1], 9) if axis.dtype.kind == "f" else 7


def unknown(file):
    shutil.rmtree(file.parent.parent)


@pytest.mark.parametrize("harm", [removed, emptied, flipped, other, unknown])
@pytest.mark.parametrize("name", ["nu0", "belt"])
def test_harmed_axes_are_told_and_written_again(path, whole, name, harm):
    kept = xr.open_zarr(path).load()
    harm(path / name / "c" / "0")
    for repair in (False, True):
        found = jb.verify(path, repair)
        assert found == jb.Verified((0, 1, 2, 3, 4), (), (), False, (name,))
        again = "which the call that made the store writes again"
        assert repr(found).endswith(f"0 bad; bad axes {name}, {again}; not finished)")
    assert sweep(AXES, store=path).equals(whole) and xr.open_zarr(path).identical(kept)
    assert jb.verify(path).finished and not jb.verify(path).axes


def test_a_finished_store_with_harmed_axes_is_mended_by_the_sweep_alone(path, whole):
    kept = xr.open_zarr(path).load()
    flipped(path / "nu1" / "c" / "0")
    found = sweep(AXES, store=path)
    assert found.equals(whole) and found.load().identical(kept)
    assert np.all(found.nu1.values == AXES["nu1"])


def test_another_question_does_not_mend(path):
    removed(path / "nu0" / "c" / "0")
    for axes in ({**AXES, "nu0": AXES["nu0"] + 0.01}, {**AXES, "nu0": np.full(5, np.nan)}):
        with pytest.raises(ValueError, match=r"got that of another one .* differs in axis nu0"):
            sweep(axes, store=path)
    emptied(path / "nu0" / "c" / "0")
    with pytest.raises(ValueError, match=r"got that of another one .* differs in axis nu0"):
        sweep({**AXES, "nu0": AXES["nu0"] + 0.01}, store=path)
    assert jb.verify(path).axes == ("nu0",)


@pytest.mark.parametrize("harm", [removed, emptied])
@pytest.mark.parametrize(
    "part", ["ledger", "ledger/blocks", "ledger/signature_codes", "signature", "x1_max"]
)
def test_harmed_metadata_are_named_by_their_file(path, part, harm):
    file = path / part / "zarr.json"
    harm(file)
    calls = jb.verify, functools.partial(jb.verify, repair=True), lambda p: sweep(AXES, store=p)
    for call in calls:
        with pytest.raises(ValueError, match="store must have metadata that can be read") as told:
            call(path)
        assert str(file) in str(told.value) and "from a copy of the store" in str(told.value)
        assert told.value.__suppress_context__


@pytest.mark.parametrize(
    ("attribute", "part"),
    [("jaxbelt_question", ""), ("jaxbelt_hash", ""), ("shape", "ledger"), ("block", "ledger")],
)
def test_attributes_that_lack_or_do_not_fit_are_named_by_their_file(path, attribute, part):
    group = zarr.open_group(path / part, mode="r+", use_consolidated=False)
    kept = dict(group.attrs)
    for value in ("{}", None):
        group.attrs.put({**kept, attribute: value})
        if value is None:
            group.attrs.put({k: v for k, v in kept.items() if k != attribute})
        for call in (jb.verify, lambda p: sweep(AXES, store=p)):
            with pytest.raises(ValueError, match="metadata that can be read") as told:
                call(path)
            assert str(path / part / "zarr.json") in str(told.value)


def test_an_array_of_another_shape_is_named(path):
    shutil.copy(path / "ledger" / "blocks" / "zarr.json", path / "x1_max" / "zarr.json")
    for call in (jb.verify, lambda p: sweep(AXES, store=p)):
        with pytest.raises(ValueError, match=r"x1_max/zarr.json \(ValueError: shape \(5, 4\)"):
            call(path)


def test_the_command_tells_harmed_axes_and_metadata(path):
    emptied(path / "nu0" / "c" / "0")
    told = CliRunner().invoke(app, ["verify", str(path)])
    assert told.exit_code == 1 and "bad axes nu0" in told.stdout
    emptied(path / "x1_max" / "zarr.json")
    told = CliRunner().invoke(app, ["verify", str(path), "--repair"])
    assert (told.exit_code, told.stdout) == (2, "") and told.stderr.count("\n") == 1
    assert told.stderr.startswith("Error: store must have metadata that can be read, got harmed")
