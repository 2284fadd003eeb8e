"""Sweeps on many machines: blocks as tasks of a Dask cluster, and by processes of their own."""

import os
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import jax
import kills
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt import interrupts
from jaxbelt.numerics.spacing import evenly_spaced
from jaxbelt.sweeps import clusters
from jaxbelt.sweeps import store as stores
from jaxbelt.sweeps.locks import locked

pytest.importorskip("distributed")
pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="processes of POSIX"),
    # Dask's own, where a worker was killed.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]
MAKE = jb.presets.class_b
AXES = {"nu0": np.linspace(-0.6, 0.55, 5), "nu1": np.array([0.35, -0.2, 0.1])}
OPTIONS = dict(t1=20.0, progress=False)


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(stores, "BLOCK_RUNS", 4)


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    # Where the sweeps of this process have left their programs.
    cache = jax.config.jax_compilation_cache_dir or tmp_path_factory.mktemp("cache")
    with kills.cluster(2, cache) as client:
        yield client


@pytest.fixture(scope="module")
def whole():
    return jb.sweep(MAKE, AXES, **OPTIONS)


def again(path, **options):
    return jb.sweep(MAKE, AXES, **(OPTIONS | options), store=path)


# --- Dask -----------------------------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_workers_do_what_the_sweep_does(client, tmp_path, whole, capsys):
    path = tmp_path / "a.zarr"
    found = again(path, executor=client, progress=True)
    assert kills.Kept(path).identical_values(whole) and found.equals(whole)
    assert jb.verify(path) == jb.Verified((0, 1, 2, 3, 4), (), (), True)
    assert "15 of 15 runs" in " ".join(capsys.readouterr().err.split())
    assert kills.times_done(path).tolist() == [1] * 5
    assert not [left for left in (tmp_path / ".a.zarr.locks").iterdir() if left.name != "door"]


@pytest.mark.slow(first=True)
def test_workers_take_functions_and_classes_of_ones_own(client, tmp_path):
    class Count:  # nothing that a worker could import
        def init(self, osc, x1, x2):
            return 0 * x1

        def update(self, state, event):
            return state + 1

        def finish(self, state, end):
            return {"count": state}

    def make(nu0):
        return jb.presets.class_a(nu0 + 0.1)

    def swept(**options):
        return jb.sweep(make, {"nu0": AXES["nu0"]}, **OPTIONS, observe=Count(), **options)

    found = swept(store=tmp_path / "a.zarr", executor=client)
    assert found.equals(swept()) and jb.verify(tmp_path / "a.zarr").finished


def test_a_block_is_done_once_however_often_it_is_asked_for(tmp_path, whole, monkeypatch):
    import cloudpickle

    from jaxbelt.sweeps.question import Question

    path = tmp_path / "a.zarr"
    again(path, blocks=(0, 1))
    question = Question.of(MAKE, AXES, (3.0, 0.0), 20.0, 1e-8, None, "final", ())
    packed = cloudpickle.dumps((question.arguments(), stores.Store(path, question).hash))
    told = [clusters.do_block(packed, str(path), block) for block in (0, 1, 1)]
    assert told[1] == told[2] == {"block": 1, "statuses": {0: 3}}
    assert kills.times_done(path).tolist() == [1, 1, 0, 0, 0]
    assert again(path).equals(whole)
    other = cloudpickle.dumps((question.arguments(), "another"))
    with pytest.raises(ValueError, match="store must be that of this very sweep"):
        clusters.do_block(other, str(path), 1)


@pytest.mark.slow(first=True)
def test_killed_workers_cost_their_blocks_and_nothing_else(client, tmp_path, monkeypatch):
    monkeypatch.setattr(stores, "BLOCK_RUNS", kills.BLOCK)
    told = kills.worker_campaign(client, tmp_path, kills=3, seed=1, t1=1500.0)
    assert told["killed"] == 3


@pytest.mark.slow(first=True)
@pytest.mark.usefixtures("hears_interrupts")
@pytest.mark.parametrize("is_only_noted", [False, True])
def test_an_interrupt_leaves_the_workers_free(client, tmp_path, monkeypatch, is_only_noted):
    """A block that would take minutes: its worker hears of the interrupt, too. An interrupt that
    comes during an import is only noted, and raised afterwards."""
    if is_only_noted:
        monkeypatch.setattr(interrupts, "_imports", lambda frame: np.nan)
    axes = {"nu0": AXES["nu0"][:4], "nu1": [0.35]}
    # So long that the number of steps that a run may take is more than the kernel can count.
    options = dict(t1=1e7, observe=kills.Sum(), store=tmp_path / "a.zarr", progress=False)
    timer = threading.Timer(2.0, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt, match="0 of 4 runs are in"):
            jb.sweep(MAKE, axes, **options, executor=client)
    finally:
        timer.cancel()
    began = time.monotonic()
    while any(client.processing().values()):
        assert time.monotonic() - began < 5.0
        time.sleep(0.05)


def test_blocks_go_to_workers_with_a_gpu_where_there_are_such():
    def resources(*workers):
        told = {"workers": {str(i): {"resources": one} for i, one in enumerate(workers)}}
        return clusters._resources(SimpleNamespace(scheduler_info=lambda n_workers: told))

    assert resources({}, {"memory": 3}) is None and resources() is None
    assert resources({}, {"GPU": 1}) == {"GPU": 1}


@pytest.mark.parametrize(
    "options, message",
    [
        (dict(blocks=(0, 2)), "store must be given, where blocks is"),
        (dict(executor=3), "store must be given, where executor is"),
        (dict(store="a.zarr", executor=3), "executor must be a dask.distributed.Client"),
        (dict(store="a.zarr", blocks=(2, 2)), r"blocks must be two integers .* got \(2, 2\)"),
        (dict(store="a.zarr", blocks=(5, 9)), r"blocks must be among the 5 of this sweep, got \(5"),
        (dict(store="a.zarr", blocks=(0, 9), audit=0.1), "audit must be 0 where blocks is given"),
    ],
)
def test_impossible_arguments_are_named(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message):
        jb.sweep(MAKE, AXES, **OPTIONS, **options)
    assert not list(tmp_path.iterdir())


# --- processes of a job array ---------------------------------------------------------------------


def test_parts_of_a_store_are_done_apart_and_the_last_finishes_it(tmp_path, whole):
    path = tmp_path / "a.zarr"
    part = again(path, blocks=(3, 9))
    assert np.sum(part.status == -1) == 9 and not jb.verify(path).finished
    with locked(path, 0, 2):  # as another process does
        again(path, blocks=(2, 3))
        for overlapping in (dict(blocks=(1, 2)), {}):
            with pytest.raises(BlockingIOError, match="is being written by another sweep"):
                again(path, **overlapping)
    found = again(path, blocks=(0, 2))
    assert found.equals(whole) and jb.verify(path).finished
    assert kills.times_done(path).tolist() == [1] * 5
    assert again(path, blocks=(1, 2)).equals(whole)


@pytest.mark.slow(first=True)
def test_processes_with_blocks_of_their_own_share_a_store(tmp_path):
    """As a job array starts them: at once, and by the command."""
    path = tmp_path / "plane.zarr"
    program = (
        "import sys; from jaxbelt.sweeps import store; store.BLOCK_RUNS = 4; "
        "from jaxbelt.cli import app; app(['sweep', *sys.argv[1:]])"
    )
    axes = ["nu0=-0.6:0.55:5", "nu1=-0.2:0.35:3", "--observe", "final", "--t1", "20"]
    jobs = [
        subprocess.Popen(
            [sys.executable, "-c", program, *axes, "--out", path, "--blocks", part],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for part in ("0:3", "3:6")
    ]
    outputs = [job.communicate(timeout=120)[0] for job in jobs]
    assert [job.returncode for job in jobs] == [0, 0], outputs
    nus = {"nu0": evenly_spaced(-0.6, 0.55, 5), "nu1": evenly_spaced(-0.2, 0.35, 3)}
    assert kills.Kept(path).identical_values(jb.sweep(MAKE, nus, **OPTIONS))
    assert jb.verify(path).finished


# --- several devices ------------------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_several_devices_of_one_process_give_the_same():
    program = """
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxbelt as jb
from jaxbelt.sweeps import threads
assert jax.local_device_count() == 3
used, started = set(), threads._started
def watched(function, *arguments):
    used.update(arguments)
    return started(function, *arguments)
threads._started = watched
axes = {"nu0": np.linspace(-0.6, 0.55, 30), "nu1": [0.35]}
found = []
for threads_wanted in (1, 3):
    threads.workers = lambda: threads_wanted
    found.append(jb.sweep(jb.presets.class_b, axes, t1=20.0, progress=False))
assert used == set(jax.local_devices())
print(found[0].identical(found[1]))
"""
    environment = dict(os.environ, XLA_FLAGS="--xla_force_host_platform_device_count=3")
    run = subprocess.run(
        [sys.executable, "-c", program],
        env=environment | {"JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.stdout.strip() == "True", run.stderr
