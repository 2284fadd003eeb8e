"""How long first calls take in a session whose programs an earlier one has compiled, in fresh
processes: `pytest tests/benchmarks/test_second_sessions.py --benchmark-only -s`. Asserts no time.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxbelt as jb

#: A session: seconds of `import jaxbelt` with an oscillator, of the first call, of later ones, and
#: a checksum of the answer.
SESSION = """
import time
began = time.perf_counter()
import jax
jax.config.update("jax_enable_x64", True)
import jaxbelt as jb
osc = jb.presets.class_b(nu0=0.45, nu1=0.35)
imported = time.perf_counter()
import hashlib, json
import numpy as np
nu0 = lambda osc: osc.belts[0].velocity
nus, xs = np.linspace(-0.7, 0.7, 64), np.linspace(-3.0, 3.0, 64)
call = lambda: %s
called = time.perf_counter()
answer = call()
first = time.perf_counter() - called
again = []
for _ in range(%d):
    called = time.perf_counter()
    call()
    again.append(time.perf_counter() - called)
leaves = answer.data_vars.values() if hasattr(answer, "data_vars") else jax.tree.leaves(answer)
numbers = b"".join(np.asarray(leaf).tobytes() for leaf in leaves if hasattr(leaf, "dtype"))
told = dict(imported=imported - began, first=first, again=min(again, default=None))
print(json.dumps(told | dict(answer=hashlib.sha256(numbers).hexdigest())))
"""
#: The calls, and what they are to take in a second session, on two quiet cores.
CALLS = {
    "simulate": ("jb.simulate(osc, (3.0, 0.0), 100.0)", 0.7),
    "find_cycle": ("jb.find_cycle(osc, (3.0, 0.0))", 1.2),
    "refine": ("jb.refine(jb.NonsmoothFold(belt=1), osc, where=nu0)", 1.5),
    "sweep": (
        "jb.sweep(jb.presets.class_b, dict(nu0=nus, nu1=nus), y0=(3.0, 0.0), observe='attractor')",
        1.2,
    ),
    "scan": ("jb.scan(osc, nu0, (-0.7, 0.7))", 2.0),
    "portrait": ("jb.portrait(osc)", 1.2),
    "bifurcation_diagram": ("jb.bifurcation_diagram(osc, nu0, (-0.7, 0.7))", 5.0),
    "basins": ("jb.basins(osc, x1=xs, x2=xs)", 2.0),
    "region_map": ('jb.region_map(jb.presets.class_b, {"nu0": nus, "nu1": nus})', 12.0),
}


def session(call, folder, kept="1", again=0):
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"JAXBELT_CACHE": kept, "JAXBELT_CACHE_DIR": str(folder)}
    command = [sys.executable, "-c", SESSION % (call, again)]
    run = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True)
    return json.loads(run.stdout)


@pytest.mark.parametrize("name", CALLS)
def test_second_session(benchmark, tmp_path_factory, name):
    call, aim = CALLS[name]
    folder = tmp_path_factory.getbasetemp() / "kept"
    cold = session(call, folder)
    told = []
    benchmark.pedantic(lambda: told.append(session(call, folder)), rounds=3)
    first, imported = (min(one[key] for one in told) for key in ("first", "imported"))
    print(
        f"\n{name}: import {imported:.2f} s; first call {cold['first']:.1f} s, in a second session "
        f"{first:.2f} s (aim {aim:g} s)"
    )
    assert {one["answer"] for one in told} == {cold["answer"]}


def test_warm_calls(benchmark, tmp_path):
    """Calls of a program that was loaded, beside those of one that JAX has just compiled."""
    call, _ = CALLS["simulate"]
    session(call, tmp_path)
    loaded = benchmark.pedantic(lambda: session(call, tmp_path, again=300), rounds=1)
    compiled = session(call, tmp_path, kept="0", again=300)
    print(f"\nwarm: {loaded['again'] / compiled['again']:.3f} of the time without")
    assert loaded["answer"] == compiled["answer"]


PEER = Path(__file__).with_name("scipy_peer.py")
#: What the script with SciPy answers, as the package has it; and the runs it makes one of.
PEER_ANSWERS = {
    "simulate": (lambda osc, nu0: jb.simulate(osc, (3.0, 0.0), 100.0, ts=[100.0]).ys[0], 1),
    "find_cycle": (lambda osc, nu0: jb.find_cycle(osc, (3.0, 0.0)).period, 1),
    "refine": (lambda osc, nu0: jb.refine(jb.NonsmoothFold(1), osc, where=nu0).value, 1),
    "sweep": (None, 64),
}


@pytest.mark.parametrize("name", PEER_ANSWERS)
def test_first_answers_beside_scipy(benchmark, tmp_path, name):
    """Seconds of the first call in a first and in a second session, beside those of the script; a
    sweep's are those of 64 runs, times 64."""
    ours = [session(CALLS[name][0], tmp_path, again=3) for _ in range(2)]
    command = [sys.executable, str(PEER), name]

    def ask():
        return json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout)

    peer = benchmark.pedantic(ask, rounds=1)
    answer, times = PEER_ANSWERS[name]
    print(
        f"\n{name}: first {ours[0]['first']:.1f} s, second session {ours[1]['first']:.2f} s, "
        f"again {ours[1]['again']:.4f} s; SciPy {times * peer['seconds']:.2f} s"
    )
    if answer is not None:
        right = answer(jb.presets.class_b(0.45, 0.35), lambda osc: osc.belts[0].velocity)
        assert peer["answer"] == pytest.approx(np.asarray(right), abs=1e-8)
