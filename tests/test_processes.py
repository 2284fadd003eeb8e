"""Processes: a child that was forked after JAX was used is told so, others compute."""

import multiprocessing
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

import jaxbelt as jb

OSC = jb.presets.class_b(nu0=0.45, nu1=0.35)
SPAN, TWO, KEY = (0.1, 0.2), np.array([0.1, 0.2]), jax.random.key(0)


def velocity(osc):
    return osc.belts[0].velocity


ENTRIES = {
    "simulate": lambda: jb.simulate(OSC, (1.0, 0.0), 5.0),
    "equilibria": lambda: jb.equilibria(OSC),
    "lyapunov_coefficient": lambda: jb.lyapunov_coefficient(OSC),
    "find_cycle": lambda: jb.find_cycle(OSC, (3.0, 0.0)),
    "unstable_cycle": lambda: jb.unstable_cycle(OSC),
    "refine": lambda: jb.refine(jb.Hopf(), OSC, where=velocity),
    "scan": lambda: jb.scan(OSC, where=velocity, span=SPAN),
    "diagram": lambda: jb.bifurcation_diagram(OSC, where=velocity, span=SPAN),
    "sweep": lambda: jb.sweep(
        jb.presets.class_b, {"nu0": TWO, "nu1": TWO}, y0=(3.0, 0.0), t1=5.0, observe="final"
    ),
    "region_map": lambda: jb.region_map(jb.presets.class_b, {"nu0": TWO, "nu1": TWO}),
    "basins": lambda: jb.basins(OSC, x1=TWO, x2=TWO),
    "basin_stability": lambda: jb.basin_stability(
        OSC, box=((-2.0, 2.0), (0.0, 2.0)), n=16, key=KEY
    ),
    "fit": lambda: jb.fit(OSC, np.arange(9.0), np.zeros(9), where=velocity),
    "design": lambda: jb.design(OSC, [(jb.amplitude, 1.0)], where=velocity),
}


def _try_all(answers):
    for name, entry in ENTRIES.items():
        try:
            entry()
        except Exception as error:
            answers.send((name, type(error).__name__, str(error)))
        else:
            answers.send((name, "nothing", ""))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no processes are forked here")
@pytest.mark.filterwarnings("ignore:.*fork:RuntimeWarning", "ignore:.*fork:DeprecationWarning")
def test_a_forked_child_is_told_to_be_spawned():
    jax.block_until_ready(jb.equilibria(OSC))  # JAX is in use
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    child = context.Process(target=_try_all, args=(there,))
    child.start()
    try:
        for name in ENTRIES:
            assert here.poll(10.0), f"{name} does not end"
            entry, error, message = here.recv()
            assert (entry, error) == (name, "RuntimeError")
            assert "forked after JAX was used" in message and 'get_context("spawn")' in message
    finally:
        child.kill()
        child.join()


def test_a_spawned_child_computes(monkeypatch):
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        found = pool.apply_async(jb.equilibria, (OSC,)).get(timeout=60.0)
    assert found.x1 == pytest.approx(np.asarray(jb.equilibria(OSC).x1), abs=0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no processes are forked here")
def test_a_child_that_was_forked_before_jax_was_used_computes():
    program = """
import os, jax, jaxbelt as jb
jax.config.update("jax_enable_x64", True)
child = os.fork()
osc = jb.presets.class_a(0.2)
if not child:
    jb.equilibria(osc)
    os._exit(7)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    assert run.stdout.strip() == "7"
