"""Stores measured: kills and interrupts, two workers beside one, and what keeping runs costs."""

import resource
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt.sweeps import store

sys.path.append(str(Path(__file__).parents[1]))

#: Starts along each side of the grid: ten million runs.
SIDE = 3163


def test_a_hundred_kills(benchmark, tmp_path):
    import kills

    told = benchmark.pedantic(lambda: kills.campaign(tmp_path, "attractor", 100, seed=0))
    print(f"\n{told}")
    assert told["killed"] == 100


@pytest.mark.skipif(sys.platform == "win32", reason="measures memory as POSIX does")
def test_ten_million_runs(benchmark, tmp_path):
    """Peak memory over that of the interpreter with JAX, and the processor time that a store takes
    beside that of the same sweep in memory. The peak is of the process: run this test alone."""

    def peak():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10

    def swept(n, **options):
        nus = np.linspace(-0.7, 0.7, n)
        axes = {"nu0": nus, "nu1": nus}
        began = time.process_time()
        jb.sweep(jb.presets.class_b, axes, t1=20.0, progress=False, **options)
        return time.process_time() - began

    jnp.ones(1).block_until_ready()
    before = peak()
    swept(3)
    kept = benchmark.pedantic(lambda: swept(SIDE, store=tmp_path / "a.zarr"))
    above = peak() - before
    overhead = kept / swept(SIDE) - 1
    print(f"\npeak {above:.0f} MiB over JAX; the store takes {overhead:.1%} of the processor time")
    assert above < 1024


def test_fifteen_killed_workers(benchmark, tmp_path, monkeypatch):
    import kills

    monkeypatch.setattr(store, "BLOCK_RUNS", kills.BLOCK)
    with kills.cluster(2, tmp_path / "cache") as client:
        told = benchmark.pedantic(lambda: kills.worker_campaign(client, tmp_path, 15, seed=0))
    print(f"\n{told}")
    assert told["killed"] == 15


def test_twenty_interrupts(benchmark, tmp_path, monkeypatch):
    import kills

    monkeypatch.setattr(store, "BLOCK_RUNS", kills.BLOCK)
    told = benchmark.pedantic(lambda: kills.interrupt_campaign(tmp_path, 20, seed=0))
    print(f"\n{told}")
    assert told["interrupted"] == 20 and told["longest"] < 2.0


def test_two_workers_beside_one(benchmark, tmp_path):
    """How many times as fast two workers do a sweep of four million runs: 16 blocks or so a worker.
    It takes two cores with nothing else to do."""
    import kills

    nus = np.linspace(-0.7, 0.7, 2048)
    seconds = {}

    def swept(client, n, name):
        options = dict(t1=50.0, store=tmp_path / name, executor=client, progress=False)
        began = time.monotonic()
        jb.sweep(jb.presets.class_b, {"nu0": nus[:n], "nu1": nus}, **options)
        return time.monotonic() - began

    for workers in (1, 2):
        with kills.cluster(workers, tmp_path / "cache") as client:
            swept(client, 128 * workers, f"compiled{workers}.zarr")
            seconds[workers] = min(swept(client, 2048, f"{workers}-{i}.zarr") for i in range(3))
    benchmark.pedantic(lambda: None)
    print(f"\none worker {seconds[1]:.1f} s, two {seconds[2]:.1f} s: {seconds[1] / seconds[2]:.2f}")
