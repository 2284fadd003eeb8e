"""What derivatives and batches cost, one table:

    pytest tests/benchmarks/test_derivatives.py --benchmark-only -s

Class (b), the start (3, 0), T = 100. Ratios are of wall time for single runs, of processor time for
the others. Nothing here asserts a time.
"""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb
from tests.benchmarks.timing import least

SPAN, START, NU1 = 100.0, (3.0, 0.0), 0.35
LANES = 1024
#: Velocities of a batch: of belt 0, on a line where most runs stick; of both belts, at random.
LINE = jnp.linspace(0.3, 0.6, LANES)
PLANE = tuple(jnp.asarray(np.random.default_rng(1).uniform(-0.7, 0.7, (2, LANES))))
#: nu0, nu1, damping, steepness and load of belt 0, x1, x2.
SEVEN = jnp.array([0.45, NU1, 0.5, 10.0, 1.0, *START])


def final(nu0, nu1=NU1):
    return jb.simulate(jb.presets.class_b(nu0, nu1), START, SPAN, ts=[SPAN]).ys[-1]


def final_by_seven(inputs):
    nu0, nu1, damping, steepness, load, x1, x2 = inputs
    belts = (
        jb.Belt(nu0, jb.Conti(1.0, 0.6, steepness), load),
        jb.Belt(nu1, jb.Conti(1.0, 0.6, 10.0)),
    )
    return jb.simulate(jb.Oscillator(damping, belts), (x1, x2), SPAN, ts=[SPAN]).ys[-1]


def loss(*velocities):
    return jnp.sum(final(*velocities) ** 2)


def event_times(nu0):
    return jb.simulate(jb.presets.class_b(nu0, NU1), START, SPAN).events.t


def stick_duration(nu0):
    return jb.stick_duration(jb.find_cycle(jb.presets.class_b(nu0, NU1), START), belt=1)


def say(what, value):
    print(f"{what:62s} {value}", flush=True)


def each(function, argument, calls=200):
    """Seconds of wall time of one of many calls in a row."""
    function = jax.jit(function)

    def call():
        for _ in range(calls):
            result = function(argument)
        return result

    return least(call)[0] / calls


def single_runs():
    value = each(final, 0.45)
    say("one run, final state", f"{1e3 * value:.3f} ms")
    for name, function in (
        ("jvp", lambda nu0: jax.jvp(final, (nu0,), (1.0,))),
        ("value_and_grad", jax.value_and_grad(loss)),
    ):
        say(f"{name} over it", f"{each(function, 0.45) / value:.2f}")
    ratio = each(jax.jacfwd(final_by_seven), SEVEN) / each(final_by_seven, SEVEN)
    say("jacfwd by 7 parameters and starts over it", f"{ratio:.2f}")


def batches():
    for name, function in (("simulate", final), ("grad", jax.grad(loss))):
        batch = jax.jit(jax.vmap(function))
        for where, velocities in (("on a line", (LINE,)), ("at random", PLANE)):
            wall, processor, _ = least(lambda b=batch, v=velocities: b(*v))
            rates = f"{LANES / processor:.0f}/s of a core, {LANES / wall:.0f}/s by the clock"
            say(f"vmap({name}), {LANES} lanes {where}", rates)
    batch = jax.jit(jax.vmap(event_times))
    wall, processor, _ = least(lambda: batch(LINE))
    say(f"event times of {LANES} runs", f"{wall:.3f} s, {processor:.3f} s of a core")


def cycles():
    velocities = jnp.linspace(0.4, 0.52, LANES)
    value = jax.jit(jax.vmap(stick_duration))
    wall, processor, _ = least(lambda: value(velocities))
    rates = f"{LANES / processor:.0f}/s of a core, {LANES / wall:.0f}/s by the clock"
    say("vmap(find_cycle) and a functional", rates)
    gradient = jax.jit(jax.vmap(jax.value_and_grad(stick_duration)))
    say("its gradient over it", f"{least(lambda: gradient(velocities))[1] / processor:.2f}")


def swept(make, n, **options):
    nus = np.linspace(-0.7, 0.7, n)
    options = dict(t1=SPAN) | options
    return least(lambda: jb.sweep(make, {"nu0": nus, "nu1": nus}, progress=False, **options))[1]


def sweeps():
    value = swept(jb.presets.class_b, 128)
    for names in (("nu0",), ("nu0", "nu1")):
        ratio = swept(jb.presets.class_b, 128, derivatives=names) / value
        say(f"sweep with {len(names)} derivative(s) over none", f"{ratio:.2f}")

    def class_c(nu0, nu1):
        return jb.presets.class_c(nu0, nu1, sigma=0.1)

    for observe, options in (("final", {}), ("attractor", {"t1": None})):
        seconds = swept(class_c, 128, observe=observe, **options)
        say(f"sweep of class (c), sigma = 0.1, {observe}", f"{128**2 / seconds:.0f}/s of a core")


FIRST_CALL = """
import time
import jax
import jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
import jaxbelt as jb
jb.simulate
def final(nu0):
    return jb.simulate(jb.presets.class_b(nu0, 0.35), (3.0, 0.0), 100.0, ts=[100.0]).ys[-1]
start = time.perf_counter()
jax.block_until_ready(%s)
print(time.perf_counter() - start)
"""
FIRST_CALLS = {
    "jvp": "jax.jit(lambda nu0: jax.jvp(final, (nu0,), (1.0,)))(0.45)",
    "vmap(grad)": "jax.jit(jax.vmap(jax.grad(lambda nu0: jnp.sum(final(nu0) ** 2))))"
    "(jnp.linspace(0.3, 0.6, 1024))",
}


def first_calls():
    """In fresh interpreters, where nothing is compiled yet."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
        patch.setenv("JAXBELT_CACHE", "0")
        for name, call in FIRST_CALLS.items():
            command = [sys.executable, "-c", FIRST_CALL % call]
            out = subprocess.run(command, capture_output=True, check=True)
            say(f"first call of {name}", f"{float(out.stdout):.1f} s")


def test_table(benchmark):
    print()
    for part in (single_runs, batches, cycles, sweeps, first_calls):
        part()
    value = jax.jit(final)
    benchmark(lambda: jax.block_until_ready(value(0.45)))
