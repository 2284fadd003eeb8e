"""How long a run takes: `pytest tests/benchmarks --benchmark-only`. Nothing here asserts a time."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest
from scipy.integrate import solve_ivp

import jaxbelt as jb

OSC = (0.45, 0.35)
Y0 = (3.0, 0.0)
SPAN = 100.0


def test_one_run(benchmark):
    """T = 100, class (b), default tolerances and samples, called as a user calls it."""
    osc = jb.presets.class_b(*OSC)
    benchmark(lambda: jax.block_until_ready(jb.simulate(osc, Y0, SPAN).ys))


def test_one_run_final_state(benchmark):
    """The same with the final state alone."""
    osc, ts = jb.presets.class_b(*OSC), jnp.array([SPAN])
    benchmark(lambda: jax.block_until_ready(jb.simulate(osc, Y0, SPAN, ts=ts).ys))


def test_one_run_with_a_gradient(benchmark):
    """Value and derivative of the final state by nu0, forward mode."""
    ts = jnp.array([SPAN])

    def final(nu0):
        return jb.simulate(jb.presets.class_b(nu0, OSC[1]), Y0, SPAN, ts=ts).ys[0]

    derivative = jax.jit(jax.jacfwd(final))
    benchmark(lambda: jax.block_until_ready(derivative(jnp.asarray(OSC[0]))))


def test_256_runs_under_vmap(benchmark):
    """Final states of 256 runs in one call."""
    ts = jnp.array([SPAN])

    @jax.jit
    @jax.vmap
    def final(nu0):
        return jb.simulate(jb.presets.class_b(nu0, OSC[1]), Y0, SPAN, ts=ts).ys[0]

    nus = jnp.linspace(-0.7, 0.7, 256)
    benchmark(lambda: jax.block_until_ready(final(nus)))


def test_scipy_without_events(benchmark):
    """A peer: SciPy's DOP853 on the switch model's field, tolerance 1e-10, no derivatives."""

    def field(t, y):
        x1, x2 = y
        force = -x1 - 0.5 * x2
        for k, nu in enumerate(OSC):
            r = nu - x2
            needed = -x1 - 0.5 * x2
            other = OSC[1 - k] - x2
            needed += (0.4 / (1 + 10 * abs(other)) + 0.6) * (1 if other > 0 else -1)
            if abs(r) <= 1e-6 and abs(needed) < 1:
                return nu, r
            force += (0.4 / (1 + 10 * abs(r)) + 0.6) * (1 if r > 0 else -1)
        return x2, force

    benchmark(lambda: solve_ivp(field, (0, SPAN), Y0, "DOP853", rtol=1e-10, atol=1e-10))


FIRST_RUN = """
import time
import jax
jax.config.update("jax_enable_x64", True)
import jaxbelt as jb
osc = jb.presets.class_b(0.45, 0.35)
start = time.perf_counter()
jax.block_until_ready(jb.simulate(osc, (3.0, 0.0), 100.0).ys)
print(time.perf_counter() - start)
"""
IMPORT = """
import time
import jax, diffrax
start = time.perf_counter()
import jaxbelt
print(time.perf_counter() - start)
"""


@pytest.mark.parametrize("program", [FIRST_RUN, IMPORT], ids=["first_run", "import_after_diffrax"])
def test_start_up(benchmark, program):
    """Seconds inside a fresh interpreter, in extra_info: the first run, and the import."""
    seconds = []

    def fresh():
        out = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
        seconds.append(float(out.stdout))

    benchmark.pedantic(fresh, rounds=3)
    benchmark.extra_info["seconds_inside"] = seconds
    print(seconds)
