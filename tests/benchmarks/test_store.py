"""Stores measured: a hundred kills, and what keeping ten million runs costs."""

import resource
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb

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
