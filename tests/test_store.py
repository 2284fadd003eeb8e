"""Stores: what is resumed, what is refused, and that kills, full disks and lies do no harm."""

import dataclasses
import errno
import functools
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import kills
import numpy as np
import pytest
import xarray as xr
import zarr

import jaxbelt as jb
from jaxbelt.sweeps import question as questions
from jaxbelt.sweeps import store as stores
from jaxbelt.sweeps.grid import Blocks, Grid
from jaxbelt.sweeps.locks import locked
from jaxbelt.sweeps.question import Question
from jaxbelt.sweeps.store import CHECKSUM

TESTS = Path(__file__).parent
AXES = {"nu0": np.linspace(-0.6, 0.55, 5), "nu1": np.array([0.35, -0.2, 0.1])}
OPTIONS = dict(observe="attractor", progress=False)


RUNS_OF_BLOCK = stores.BLOCK_RUNS


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(stores, "BLOCK_RUNS", 4)


@pytest.fixture(scope="module")
def whole():
    return jb.sweep(jb.presets.class_b, AXES, **OPTIONS)


@pytest.fixture
def path(tmp_path):
    """A finished store of five blocks."""
    path = tmp_path / "results.zarr"
    assert jb.sweep(jb.presets.class_b, AXES, store=path, **OPTIONS).nu0.size == 5
    return path


def again(path, **options):
    return jb.sweep(jb.presets.class_b, AXES, **(OPTIONS | options), store=path)


def ledger(path):
    return zarr.open_group(path, mode="r+", use_consolidated=False)["ledger"]


def chunk(path, name, block):
    """The file of a block of a variable; a block is a row of the grid here."""
    return path / name / "c" / str(block) / "0"


def undone(path, *blocks):
    """Make the store as if these blocks had never been done."""
    for block in blocks:
        ledger(path)["blocks"][block] = np.zeros(4)
    ledger(path).attrs["finished"] = False


@pytest.mark.parametrize(
    "shape, size, box",
    [
        ((5, 3), 4, (1, 3)),
        ((5, 3), 6, (2, 3)),
        ((5, 3), 2, (1, 2)),
        ((5, 3), 100, (5, 3)),
        ((10,), 4, (4,)),
        ((10,), 6, (5,)),
        ((4, 3, 2), 5, (1, 2, 2)),
        ((7,), 1, (1,)),
    ],
)
def test_blocks_are_boxes_that_hold_every_run_once(shape, size, box):
    blocks = Blocks(shape, size)
    assert blocks.box == box and np.prod(box) <= size
    runs = [blocks.runs(b, np.arange(blocks.size(b))) for b in range(len(blocks))]
    assert sorted(np.concatenate(runs).tolist()) == list(range(int(np.prod(shape))))
    grid = np.arange(np.prod(shape)).reshape(shape)
    for b, part in enumerate(runs):
        assert np.array_equal(grid[blocks.slices(b)].ravel(), part)


@pytest.mark.parametrize(
    ("shape", "count"),
    [((64,), 1), ((65,), 2), ((1000,), 8), ((256, 512), 8), ((1024, 1024), 8), ((4096, 1024), 32)],
)
def test_a_store_has_eight_blocks_or_more_unless_it_has_few_runs(monkeypatch, shape, count):
    monkeypatch.setattr(stores, "BLOCK_RUNS", RUNS_OF_BLOCK)
    axes = dict(zip(("nu0", "nu1"), map(np.linspace, (-0.7, -0.6), (0.7, 0.6), shape)))
    make = jb.presets.class_b if len(shape) == 2 else jb.presets.class_a
    assert len(stores.blocks_of(Grid(make, axes, (3.0, 0.0)))) == count


def test_the_docs_tell_how_many_runs_a_block_has():
    pages = [(TESTS.parent / page).read_text("utf-8") for page in ("README.md", "docs/clusters.md")]
    for page in [*pages, jb.sweep.__doc__]:
        words = " ".join(page.split())
        assert "an eighth of the runs" in words and f"{RUNS_OF_BLOCK:,} at most" in words
    assert stores.FEW_BLOCKS == 8


def test_a_store_is_what_the_sweep_gives(path, whole):
    plain = xr.open_zarr(path)
    assert plain.load().equals(whole)
    for name, variable in whole.variables.items():
        assert plain[name].dtype == variable.dtype and plain[name].dims == variable.dims
        assert plain[name].attrs.keys() == variable.attrs.keys()
    assert jb.decoded(plain).equals(jb.decoded(whole))
    told = plain.attrs
    assert (
        told["jaxbelt_schema"] == stores.SCHEMA
        and "jaxbelt.sweep(jaxbelt.presets.class_b" in told["call"]
    )
    assert " at 0x" not in json.dumps({k: str(v) for k, v in told.items()})
    assert jb.verify(path) == jb.Verified((0, 1, 2, 3, 4), (), (), True)


@pytest.mark.parametrize(
    "observe",
    [
        pytest.param("final", marks=pytest.mark.slow(first=True)),
        pytest.param("attractor", marks=pytest.mark.slow),
    ],
)
def test_derivatives_and_vectors_are_kept(tmp_path, observe):
    options = dict(t1=20.0, observe=observe, derivatives=("nu0",), progress=False)
    expected = jb.sweep(jb.presets.class_b, AXES, **options)
    found = jb.sweep(jb.presets.class_b, AXES, **options, store=tmp_path / "a.zarr")
    assert found.equals(expected) and jb.verify(tmp_path / "a.zarr").finished


def test_a_finished_store_is_returned_at_once(path, whole, monkeypatch):
    def never(*_, **__):
        raise AssertionError("nothing is to be run")

    monkeypatch.setattr("jaxbelt.sweeps.work.run", never)
    assert again(path).equals(whole)


def test_a_store_keeps_the_blocks_that_it_was_made_with(tmp_path, whole, monkeypatch):
    unfinished = tmp_path / "a.zarr"
    jb.sweep(jb.presets.class_b, AXES, **OPTIONS, store=unfinished, blocks=(0, 2))
    blocks = len(jb.verify(unfinished).done) + len(jb.verify(unfinished).to_do)
    monkeypatch.setattr(stores, "BLOCK_RUNS", 6)
    assert again(unfinished).equals(whole)
    assert len(jb.verify(unfinished).done) == blocks


def test_only_what_is_not_done_is_done(path, whole):
    undone(path, 1, 3)
    mark = zarr.open_group(path, mode="r+", use_consolidated=False)["x1_min"]
    mark[:] = 7.0
    found = again(path)
    assert np.all(found.x1_min[[0, 2, 4]] == 7.0)
    assert np.array_equal(found.x1_min[[1, 3]], whole.x1_min[[1, 3]])
    assert ledger(path)["blocks"][:, 2].tolist() == [1, 1, 1, 1, 1]
    assert jb.verify(path).bad == (0, 2, 4)
    assert jb.verify(path, repair=True).bad == (0, 2, 4)
    assert jb.verify(path).to_do == (0, 2, 4) and not jb.verify(path).finished
    assert again(path).equals(whole) and jb.verify(path).finished


def test_runs_that_are_not_done_are_told_apart(tmp_path):
    path = tmp_path / "a.zarr"
    asked = (jb.presets.class_b, AXES, (3.0, 0.0))
    stores._create(path, Question.of(*asked, None, 1e-8, 1e-8, "attractor", ()))
    empty = xr.open_zarr(path)
    assert np.all(empty.status == -1) and np.all(empty.kind == -1)
    assert np.all(jb.decoded(empty).status == "not_done")
    assert np.all(jb.decoded(empty).kind == "not_done")
    for name in ("status", "kind"):
        told = empty[name].attrs
        assert told["flag_values"][0] == -1 and told["flag_meanings"].startswith("not_done ")
    # A code of the contact may be negative, too.
    final = Question.of(*asked, 9.0, 1e-8, 1e-8, "final", ()).table
    told = final.attributes("mode_end")
    assert final.empty("mode_end") == told["flag_values"][0] < min(told["flag_values"][1:])
    starts = empty.expand_dims(x1=[1.0, 2.0])
    with pytest.raises(ValueError, match=r"dataset must be of a sweep that is done, got one .* 30"):
        jb.attractors(starts)


@pytest.mark.slow(first=True)
def test_an_audit_of_a_store(path):
    found = again(path, audit=1.0)
    assert (found.attrs["audited"], found.attrs["audit_differed"]) == (15, 0)
    assert xr.open_zarr(path).attrs["audited"] == 15


class Constant(jb.AbstractFriction):
    """A law of a user's own."""

    static: jnp.ndarray

    def mu(self, speed):
        return self.static + 0 * speed


class Count:
    """How many events there were, in units of a number."""

    def __init__(self, unit):
        self.unit = unit

    def init(self, osc, x1, x2):
        return jnp.zeros(())

    def update(self, state, event):
        return state + 1

    def finish(self, state, end):
        return {"count": state / self.unit}


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(rtol=1e-7), r"which differs in rtol: 1e-08 there, 1e-07 here"),
        (dict(t1=10.0), r"which differs in t1: 30000.0 there, 10.0 here"),
        (dict(y0=(2.0, 0.0)), r"which differs in y0: \(3.0, 0.0\) there, \(2.0, 0.0\) here"),
        (
            dict(observe="final", t1=30_000.0),
            r"which differs in observe: 'attractor' there, 'final'",
        ),
        (
            dict(axes={**AXES, "nu1": AXES["nu1"] + 1e-9}),
            r"which differs in axis nu1: \S+ there, \S+ here and \d+ more",
        ),
        (dict(axes={**AXES, "x1": [1.0]}), r"which differs in axes"),
        (
            dict(
                make=lambda nu, nu1: jb.presets.class_b(nu, nu1),
                axes={"nu": AXES["nu0"], "nu1": AXES["nu1"]},
            ),
            r"which differs in axes: nu0 \(\d+\), nu1 .* there, nu \(\d+\), nu1 .* here",
        ),
        (dict(axes={**AXES, "nu1": AXES["nu1"][:1]}), r"axis nu1: \d+ entries there, 1 here"),
        (dict(make=lambda nu0, nu1: jb.presets.class_b(nu0, nu1 * 2)), r"which differs in "),
        (dict(derivatives="nu0"), r"which differs in derivatives"),
    ],
)
def test_a_store_of_another_sweep_is_refused_by_what_differs(path, change, message):
    asked = dict(make=jb.presets.class_b, axes=AXES, **OPTIONS) | change
    with pytest.raises(ValueError, match="store must be .* " + message):
        jb.sweep(asked.pop("make"), asked.pop("axes"), **asked, store=path)
    assert jb.verify(path).finished


def test_a_zero_of_the_other_sign_is_refused_too(tmp_path):
    def sweep(zero):
        axes = {"nu0": [zero, 0.3]}
        return jb.sweep(
            jb.presets.class_a, axes, t1=5.0, observe="final", store=tmp_path / "a.zarr"
        )

    sweep(0.0)
    with pytest.raises(ValueError, match=r"which differs in axis nu0$"):
        sweep(-0.0)


@pytest.mark.slow(first=True)
def test_a_law_and_a_reducer_count_by_type_numbers_and_source(tmp_path):
    def make(nu, law=Constant, mu=0.5):
        return jb.Oscillator(0.1, (jb.Belt(nu, law(jnp.asarray(mu))),))

    def sweep(make=make, unit=1.0, kind=Count):
        axes = {"nu": [0.1, 0.2]}
        return jb.sweep(make, axes, t1=5.0, observe=kind(unit), store=tmp_path / "a.zarr")

    class Other(Constant):
        def mu(self, speed):
            return self.static / (1.0 + speed)

    class Twice(Count):
        def update(self, state, event):
            return state + 2

    sweep()
    for change, word in (
        (dict(make=lambda nu: make(nu, law=Other)), "the law of belt 0"),
        (dict(make=lambda nu: make(nu, mu=0.6)), "oscillator: .*friction.*=0.5 there, .*=0.6 here"),
        (dict(unit=2.0), "observe"),
        (dict(kind=Twice), "observe"),
    ):
        with pytest.raises(ValueError, match=f"which differs in {word}"):
            sweep(**change)
    assert sweep(make=lambda nu: make(nu)).equals(sweep())


SLOPE = 0.1


def slope(speed):
    return SLOPE * jnp.tanh(speed)


class LooksUp(Constant):
    """A law whose numbers are not its own."""

    def mu(self, speed):
        return self.static - slope(speed)


@dataclasses.dataclass(frozen=True)
class Slopes:
    """An observable that looks up what it counts by, and equals any other of its kind."""

    function: Any = None

    def init(self, osc, x1, x2):
        return jnp.zeros(())

    def update(self, state, event):
        return state + slope(event.x1)

    def finish(self, state, end):
        return {"sum": state}


class AtSlope(Slopes):
    at = (jb.AtSection(lambda osc, x1, x2: x1 - slope(100.0)),)

    def update(self, state, event):
        return event.x1


def makes(nu, law=None):
    law = jb.Coulomb(0.5, 0.4) if law is None else law(jnp.asarray(0.5))
    return jb.Oscillator(0.1, (jb.Belt(nu, law),))


READERS = {
    "a law": (functools.partial(makes, law=LooksUp), "final", "the law of belt 0"),
    "an observable": (makes, Slopes(), "observe"),
    "its section": (makes, AtSlope(), "observe"),
    "make": (lambda nu: makes(nu * (1 + slope(100.0))), "final", "oscillator"),
}


#: The others take as long to compile, and are told by one rule, see tests/test_identity.py.
RARELY = "a law", "an observable", "its section"


@pytest.mark.parametrize(
    "reader",
    [
        pytest.param(name, marks=pytest.mark.slow(first=True) if name in RARELY else [])
        for name in READERS
    ],
)
def test_what_a_function_reads_belongs_to_the_question(reader, tmp_path, monkeypatch):
    make, observe, word = READERS[reader]

    def sweep(name=None):
        options = dict(t1=20.0, observe=observe, progress=False)
        return jb.sweep(
            make, {"nu": [0.1, 0.2]}, **options, store=name and tmp_path / f"{name}.zarr"
        )

    first = sweep("a")
    monkeypatch.setitem(globals(), "SLOPE", 0.2)
    with pytest.raises(ValueError, match=f"which differs in {word}"):
        sweep("a")
    # Nor is a program that was compiled before used for it.
    second = sweep("b")
    assert not second.equals(first) and second.equals(sweep())
    monkeypatch.undo()
    assert sweep("a").equals(first) and sweep().equals(first)


@pytest.mark.slow(first=True)
def test_which_parameters_vary_belongs_to_the_question(tmp_path):
    law = jb.Conti(1.0, 0.6, 10.0)
    axes, store = {"p": np.linspace(0.3, 0.6, 4)}, tmp_path / "of_damping.zarr"

    def of_damping(p):
        return jb.Oscillator(p, (jb.Belt(0.3, law),))

    def of_velocity(p):
        return jb.Oscillator(0.3, (jb.Belt(p, law),))

    jb.sweep(of_damping, axes, y0=(1.0, 0.0), t1=20.0, store=store)
    with pytest.raises(ValueError, match="which differs in make"):
        jb.sweep(of_velocity, axes, y0=(1.0, 0.0), t1=20.0, store=store)


def test_every_run_of_a_large_grid_belongs_to_the_question(monkeypatch):
    law = jb.Conti(1.0, 0.6, 10.0)
    axes = {"nu": np.linspace(0.0, 2.0, 20_001)}
    number = 1006
    assert number not in np.linspace(0, 20_000, questions.SAMPLE).astype(int)

    def identity(damping, there):
        def make(nu):
            here = jnp.abs(nu - axes["nu"][number]) < 5e-5
            return jb.Oscillator(jnp.where(here, there, damping + 0 * nu), (jb.Belt(nu, law),))

        return Question.of(make, axes, (3.0, 0.0), 1.0, 1e-8, None, "final", ()).identity()

    def differing(one, other):
        return {name for name in one if one[name] != other[name]}

    first, more = identity(0.5, 0.5), np.nextafter(0.5, 1)
    assert differing(first, identity(0.5, 0.3)) == {"make"}
    # Rounding on another machine makes no other `make`.
    assert not differing(first, identity(0.5, more))
    assert differing(first, identity(more, 0.5)) == {"oscillator"}
    # Of a grid with too many points some are left out.
    monkeypatch.setattr(questions, "MOST_COUNTED", 100)
    assert not differing(identity(0.5, 0.5), identity(0.5, 0.3))
    assert "make" in differing(identity(0.5, 0.5), identity(0.3, 0.5))


def test_the_docs_tell_at_how_many_points_a_sweep_is_another():
    words = " ".join(jb.sweep.__doc__.split())
    assert f"at {questions.SAMPLE:,} points of the grid to eleven digits" in words
    assert f"at {questions.MOST_COUNTED:,} points" in words


@pytest.mark.slow
def test_a_table_counts_to_its_last_digit(tmp_path):
    def with_table(last):
        law = jb.Tabulated((0.0, 0.5, 1.0), (1.0, 0.7, last))
        return lambda p: jb.Oscillator(p, (jb.Belt(0.3, law),))

    axes, store = {"p": np.linspace(0.3, 0.6, 4)}, tmp_path / "table.zarr"
    jb.sweep(with_table(0.6), axes, y0=(1.0, 0.0), t1=20.0, store=store)
    with pytest.raises(ValueError, match="which differs in the law of belt 0"):
        jb.sweep(with_table(0.6 + 1e-14), axes, y0=(1.0, 0.0), t1=20.0, store=store)


@pytest.mark.slow
@pytest.mark.parametrize("scaled", [False, True])
def test_a_force_of_ones_own_counts_by_what_it_does(tmp_path, scaled):
    def make_of(power):
        class Push(jb.AbstractForce):
            frequency: Any

            def force(self, t):
                return jnp.cos(self.frequency * t) ** power

        def make(velocity):
            law, push = jb.Conti(0.6, 0.35, 10.0), Push(jnp.asarray(15.0))
            if scaled:
                belt = jb.PhysicalBelt(velocity, law, 20.0)
                return jb.Machine(1.2, 450.0, 0.6, (belt,), forcing=(push,)).oscillator
            return jb.Oscillator(0.1, (jb.Belt(velocity, law),), forcing=(push,))

        return make

    axes, store = {"velocity": np.linspace(0.1, 0.3, 4)}, tmp_path / "force.zarr"
    jb.sweep(make_of(1), axes, y0=(1.0, 0.0), t1=5.0, store=store)
    with pytest.raises(ValueError, match="which differs in force 0"):
        jb.sweep(make_of(3), axes, y0=(1.0, 0.0), t1=5.0, store=store)


def test_what_cannot_be_told_is_refused_for_stores_only(tmp_path):
    observe = Slopes(threading.Lock())

    def sweep(**options):
        return jb.sweep(
            makes, {"nu": [0.1, 0.2]}, t1=5.0, observe=observe, progress=False, **options
        )

    assert np.all(np.isfinite(sweep()["sum"]))
    with pytest.raises(
        ValueError, match=r"observe must be made of .* got in Slopes: function: .*lock"
    ):
        sweep(store=tmp_path / "a.zarr")
    assert not (tmp_path / "a.zarr").exists()


def test_a_store_is_the_empty_working_folder(tmp_path, monkeypatch, whole):
    """It stays where it is: a folder in its place would not be the working folder any more."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert again(".").equals(whole)
    assert Path.cwd() == folder and (Path() / "zarr.json").exists()
    assert again(Path()).equals(whole) and again("../here").equals(whole)
    assert jb.verify(".").finished
    assert sorted(one.name for one in tmp_path.iterdir()) == [".here.locks", "here"]


def test_places_that_cannot_hold_a_store_are_told_before_the_computing(tmp_path, monkeypatch):
    monkeypatch.delattr("jaxbelt.sweeps.work.run")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("mine")
    (tmp_path / "file").write_text("mine")
    for name in ("full", "file"):
        with pytest.raises(ValueError, match="store must be an empty folder or the store of this"):
            again(tmp_path / name)
    with pytest.raises(OSError, match="store cannot be written"):
        again(tmp_path / "file" / "a.zarr")
    if Path("/proc/self").exists():  # where nobody may write, not even root
        with pytest.raises(OSError, match="store cannot be written"):
            again(Path("/proc/a.zarr"))
    assert (tmp_path / "full" / "thesis.tex").read_text() == "mine"


# --- what can go wrong ----------------------------------------------------------------------------


def test_what_was_harmed_is_found_and_repaired(path, whole):
    flipped, cut = chunk(path, "x1_max", 1), chunk(path, "period", 2)
    data = bytearray(flipped.read_bytes())
    data[len(data) // 2] ^= 1
    flipped.write_bytes(data)
    cut.write_bytes(cut.read_bytes()[:-3])
    chunk(path, "status", 3).unlink()
    row = ledger(path)["blocks"][4]
    row[CHECKSUM] += 1
    ledger(path)["blocks"][4] = row
    assert jb.verify(path, repair=True).bad == (1, 2, 3, 4)
    assert again(path).equals(whole) and jb.verify(path).finished


def test_a_ledger_that_lies_is_found_out(path, whole):
    undone(path, 0)
    rows = ledger(path)["blocks"]
    rows[0] = [1, 12345, 1, 0.5]  # done, it says
    chunk(path, "kind", 1).unlink()
    assert jb.verify(path).bad == (0, 1)
    (path / "ledger" / "blocks" / "c" / "2" / "0").write_bytes(b"?")
    with pytest.raises(ValueError, match="jaxbelt verify"):
        again(path)
    assert jb.verify(path, repair=True).bad == (0, 1, 2)
    assert again(path).equals(whole)
    (path / "signature" / "c" / "3" / "0").unlink()
    assert jb.verify(path).bad == (3,)


def test_stores_of_other_schemas_and_wrecks_are_refused(path):
    root = zarr.open_group(path, mode="r+", use_consolidated=False)
    root.attrs["jaxbelt_schema"] = 0
    for call in (again, jb.verify):
        with pytest.raises(ValueError, match=rf"of schema {stores.SCHEMA}, .* got schema 0"):
            call(path)
    (path / "zarr.json").write_text("{")
    for call in (again, jb.verify):
        with pytest.raises(ValueError, match="store must be a folder that is empty or holds"):
            call(path)


def test_of_two_sweeps_at_once_the_second_is_refused(path, whole):
    undone(path, 2)
    with locked(path):
        for call in (again, lambda path: jb.verify(path, repair=True)):
            with pytest.raises(BlockingIOError, match="is being written by another sweep"):
                call(path)
    assert again(path).equals(whole)


def test_a_full_disk_harms_nothing(tmp_path, whole, monkeypatch):
    local = sys.modules["zarr.storage._local"]
    path, written, put = tmp_path / "a.zarr", [], local._put

    def full(target, *args, **options):
        if "/c/" in target.as_posix():
            if len(written) >= 30:
                raise OSError(errno.ENOSPC, "No space left on device")
            written.append(target)
        return put(target, *args, **options)

    with monkeypatch.context() as patch:
        patch.setattr(local, "_put", full)
        with pytest.raises(OSError, match=r"No space left on device; interrupted: .* of 15 runs"):
            again(path)
    found = jb.verify(path)
    assert not found.bad and 0 < len(found.to_do) < 5
    assert again(path).equals(whole)


#: On a disk of two megabytes of its own, which something else fills but for so many kilobytes: the
#: sweep has to say so, and go on from what it has when there is room again.
FULL_DISK = """
import os, sys
from pathlib import Path
import jax
jax.config.update("jax_enable_x64", True)
import jaxbelt as jb
import test_store as tests
tests.stores.BLOCK_RUNS = 4
disk, told = Path(sys.argv[1]), []
whole = jb.sweep(jb.presets.class_b, tests.AXES, **tests.OPTIONS)
for room in map(int, sys.argv[2:]):
    path, other = disk / f"{room}.zarr", disk / "other"
    free = os.statvfs(disk)
    other.write_bytes(bytes(free.f_bavail * free.f_frsize - 1024 * room))
    try:
        tests.again(path)
        raise SystemExit(f"{room} KiB were enough")
    except OSError as error:
        assert "No space left on device" in str(error), error
        assert "store cannot be written" in str(error) or " of 15 runs are in" in str(error), error
    done = []
    if path.exists():
        found = jb.verify(path)
        assert not found.bad and not found.finished, found
        done = found.done
    other.unlink()
    assert tests.again(path).equals(whole) and jb.verify(path).finished
    told.append(len(done))
    tests.stores.shutil.rmtree(path)
print(*told)
"""


@pytest.mark.slow(first=True)
def test_a_disk_that_is_full_harms_nothing(tmp_path):
    """A real one, where this system lets a process have one of its own."""

    def on_a_disk(size, *command):
        mount = f'mount -t tmpfs -o size={size} none "$0" && exec "$@"'
        own = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", mount, str(tmp_path)]
        environment = dict(os.environ, PYTHONPATH=os.pathsep.join([str(TESTS), *sys.path]))
        return subprocess.run([*own, *command], capture_output=True, text=True, env=environment)

    try:
        allowed = on_a_disk("64k", "true").returncode == 0
    except OSError:
        allowed = False
    if not allowed:
        pytest.skip("no file system of its own for a process")
    rooms = map(str, (8, 100, 200, 300, 400))
    ran = on_a_disk("2m", sys.executable, "-c", FULL_DISK, str(tmp_path), *rooms)
    assert ran.returncode == 0, ran.stderr
    done = [int(word) for word in ran.stdout.split()]
    assert done[0] == 0 and max(done) > 0


def test_an_interrupt_keeps_what_is_done(tmp_path, whole, monkeypatch):
    path, put = tmp_path / "a.zarr", stores.Store.put

    def interrupted(self, *args):
        put(self, *args)
        if self.done() >= 6:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(stores.Store, "put", interrupted)
        with pytest.raises(KeyboardInterrupt, match=r"\d+ of 15 runs are in .*a.zarr; the"):
            again(path)
    assert len(jb.verify(path).done) >= 2
    assert again(path).equals(whole)


@pytest.mark.skipif(sys.platform == "win32", reason="processes of POSIX")
@pytest.mark.parametrize(
    "number",
    [pytest.param(6, marks=pytest.mark.slow(first=True)), pytest.param(20, marks=pytest.mark.slow)],
)
def test_kills_at_random_moments_do_no_harm(number, tmp_path):
    told = kills.campaign(tmp_path, "final", kills=number, seed=1)
    assert told["blocks seen done"] > 0
