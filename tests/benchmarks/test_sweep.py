"""Sweeps beside other programs: `pytest tests/benchmarks/test_sweep.py --benchmark-only -s`.

Workload W1: class (b), start (1.5, 0), the state at T = 100, tolerance 1e-8, for the n x n points
nu0 = -0.7 + 1.4 (i + 0.5)/n, nu1 = -0.6987 + 1.4 (j + 0.5)/n. Nothing here asserts a time.
"""

import shutil
import subprocess
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxbelt as jb
from jaxbelt import batch

SPAN, TOLERANCE = 100.0, 1e-8


def w1(n):
    i = (np.arange(n) + 0.5) / n
    return {"nu0": -0.7 + 1.4 * i, "nu1": -0.6987 + 1.4 * i}


def processor_time(function, repeat=3):
    """Least seconds of processor time of a few calls, after one that compiles; and the result."""
    result, times = function(), []
    for _ in range(repeat):
        start = time.process_time()
        result = function()
        times.append(time.process_time() - start)
    return min(times), result


def swept(n, **options):
    options = dict(y0=(1.5, 0.0), t1=SPAN, rtol=TOLERANCE, atol=TOLERANCE) | options
    return jb.sweep(jb.presets.class_b, w1(n), **options)


def boost(n, folder):
    """Seconds and the sum of |x1(T)| of the C++ program beside this file, or None."""
    compiler = shutil.which("g++")
    if compiler is None:
        return None
    source, program = Path(__file__).with_name("sweep_peer.cpp"), folder / "peer"
    build = [compiler, "-std=c++17", "-O3", "-march=native", "-o", str(program), str(source)]
    if subprocess.run(build, capture_output=True).returncode != 0:
        return None
    runs = [
        subprocess.run(
            [program, str(n), str(SPAN), str(TOLERANCE)], capture_output=True, check=True
        )
        for _ in range(3)
    ]
    return min(tuple(map(float, run.stdout.split())) for run in runs)


def vmapped(n):
    ts = jnp.array([SPAN])

    @jax.jit
    @jax.vmap
    def end(nu0, nu1):
        osc = jb.presets.class_b(nu0, nu1)
        tolerances = dict(rtol=TOLERANCE, atol=TOLERANCE)
        return jb.simulate(osc, (1.5, 0.0), SPAN, ts=ts, **tolerances).ys[0, 0]

    grid = [jnp.asarray(part.ravel()) for part in np.meshgrid(*w1(n).values(), indexing="ij")]
    return lambda: np.asarray(jax.block_until_ready(end(*grid)))


def scipy_runs(n):
    """No events: the switch model's field with a narrow band, as one would write it first."""

    def end(nu0, nu1):
        def field(t, y):
            x1, x2 = y
            force = -x1 - 0.5 * x2
            for nu, other in ((nu0, nu1), (nu1, nu0)):
                r, s = nu - x2, other - x2
                needed = -x1 - 0.5 * x2 + np.sign(s) * (0.4 / (1 + 10 * abs(s)) + 0.6)
                if abs(r) <= 1e-6 and abs(needed) < 1:
                    return nu, r
                force += np.sign(r) * (0.4 / (1 + 10 * abs(r)) + 0.6)
            return x2, force

        options = dict(rtol=TOLERANCE, atol=TOLERANCE)
        return solve_ivp(field, (0, SPAN), (1.5, 0.0), "DOP853", **options).y[0, -1]

    axes = w1(n)
    return lambda: np.array([end(a, b) for a in axes["nu0"] for b in axes["nu1"]])


def test_w1_side_by_side(benchmark, tmp_path, monkeypatch):
    """A table: runs per second of one core, the ratio to Boost.odeint, and the sum of |x1(T)|."""
    monkeypatch.setattr(batch, "workers", lambda: 1)
    n = 128
    rows = []
    peer = boost(n, tmp_path)
    if peer is None:
        print("Boost.odeint: skipped, no g++ or no Boost headers")
    else:
        rows.append(("Boost.odeint (C++)", n, *peer))
    seconds, dataset = processor_time(lambda: swept(n))
    rows.append(("sweep", n, seconds, float(np.abs(dataset.x1_end).sum())))
    seconds, x1 = processor_time(vmapped(16), repeat=1)
    rows.append(("vmap of simulate", 16, seconds, np.abs(x1).sum()))
    seconds, x1 = processor_time(scipy_runs(3), repeat=1)
    rows.append(("SciPy, no events", 3, seconds, np.abs(x1).sum()))
    base = n * n / rows[0][2]
    for name, size, seconds, total in rows:
        rate = size * size / seconds
        print(f"{name:20s} n={size:4d} {rate:9.0f} runs/s {rate / base:7.2f} sum {total:.8f}")
    benchmark(lambda: swept(n))


@pytest.mark.parametrize("n", [10, 100, 316])
def test_batch_size(benchmark, n):
    swept(n)
    benchmark(lambda: swept(n))


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-8, 1e-11])
def test_tolerance(benchmark, tolerance):
    options = dict(rtol=tolerance, atol=tolerance)
    swept(64, **options)
    benchmark(lambda: swept(64, **options))


@pytest.mark.parametrize("belts", [1, 2, 3, 4])
def test_number_of_belts(benchmark, belts):
    """64 x 64 points; the first call, which compiles, in extra_info."""
    law = jb.presets.paper_friction()

    def make(nu0, nu1):
        velocities = [nu0, nu1, -0.25, 0.6][:belts]
        return jb.Oscillator(0.5, tuple(jb.Belt(nu, law, load=1.0) for nu in velocities))

    def call():
        return jb.sweep(make, w1(64), y0=(1.5, 0.0), t1=SPAN)

    start = time.perf_counter()
    call()
    benchmark.extra_info["first_call_seconds"] = time.perf_counter() - start
    benchmark(call)


def test_attractor_map(benchmark):
    """The plane of the paper's Fig. 6, 1024 x 1024 labels, on all cores."""
    axes = {name: np.linspace(-0.7, 0.7, n) for name, n in (("nu0", 1024), ("nu1", 1025))}
    axes["nu1"] = axes["nu1"][:-1]

    def call():
        return jb.sweep(jb.presets.class_b, axes, observe="attractor")

    benchmark.pedantic(call, rounds=2, warmup_rounds=1)
