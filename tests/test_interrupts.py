"""Ctrl-C: every sweep is back at the prompt soon, and says what became of its runs."""

import gc
import importlib
import os
import signal
import subprocess
import sys
import time

import jax
import kills
import pytest

import jaxbelt as jb
from jaxbelt.commands.options import GRACE
from jaxbelt.interrupts import heard_interrupts
from jaxbelt.sweeps import store, threads
from jaxbelt.sweeps.datasets import Memory
from jaxbelt.sweeps.question import Question

pytestmark = pytest.mark.usefixtures("hears_interrupts")

#: What is started in the background of a shell would else ignore interrupts, and so its children.
HEARS = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
#: A sweep that would take hours: many short runs, or a few long ones, each longer than a call of
#: the kernel is to take. Before it, one of the same program that compiles it.
SWEEP = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import jaxbelt as jb
from jaxbelt.sweeps import threads

def sweep(n, t1):
    nus = {"nu0": np.linspace(-0.6, 0.55, n), "nu1": np.linspace(-0.5, 0.55, n)}
    return jb.sweep(jb.presets.class_b, nus, t1=t1, observe=observe, progress=False)

class Last:  # sees every event, so that no loop of a run is skipped
    def init(self, osc, x1, x2):
        return x1
    def update(self, state, event):
        return event.t
    def finish(self, state, end):
        return {"last": state}

observe = Last() if sys.argv[1] == "long" else "final"
if sys.argv[1] != "compiling":
    sweep(2, 1.0)
    print("ready", flush=True)
else:
    # It is ready where it begins to compile the kernel: how long it takes to come there differs.
    compile_kernel = threads._Team.compile

    def told(*given):
        print("ready", flush=True)
        return compile_kernel(*given)

    threads._Team.compile = told
sweep(20, 1e6) if sys.argv[1] == "long" else sweep(3000, 300.0)
"""
COMMAND = "from jaxbelt.cli import app; app()"
#: The same, ready when the kernel is compiled and the runs begin.
RUNS = """
from jaxbelt.cli import app
from jaxbelt.sweeps import threads

compile_kernel = threads._Team.compile

def told(*given):
    compile_kernel(*given)
    print("ready", flush=True)

threads._Team.compile = told
app()
"""
#: Seconds from the interrupt to the end of the process.
SOON = 2.0


def interrupted(
    command: list[str], delay: float, ready: bool, cache: bool
) -> tuple[float, int, str]:
    """Seconds until the process ended, its exit code, and what it wrote last.

    cache: whether it may read compiled programs; else there is something to compile.
    """
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    if cache and jax.config.jax_compilation_cache_dir:
        environment["JAX_COMPILATION_CACHE_DIR"] = jax.config.jax_compilation_cache_dir
    pipes = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    process = subprocess.Popen(command, **pipes)
    if ready:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
    time.sleep(delay)
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    return time.monotonic() - began, process.returncode, errors


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(
    "when, delay",
    [
        pytest.param("many", 3.0, marks=pytest.mark.slow(first=True)),
        pytest.param("long", 3.0, marks=pytest.mark.slow(first=True)),
        ("compiling", 1.0),
    ],
)
def test_an_interrupt_ends_a_sweep_and_says_what_became_of_it(when, delay):
    command, cache = [sys.executable, "-c", HEARS + SWEEP, when], when != "compiling"
    seconds, code, errors = interrupted(command, delay, ready=True, cache=cache)
    assert code == -signal.SIGINT, errors
    last = errors.strip().splitlines()[-1]
    assert (
        last.startswith("KeyboardInterrupt: interrupted after ") and 'store="results.zarr"' in last
    )
    assert seconds < SOON


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.slow(first=True)
def test_an_interrupt_ends_the_command(tmp_path):
    axes = ["nu0=-0.6:0.55:3000", "nu1=-0.5:0.5:3000"]
    out = ["--out", str(tmp_path / "plane.nc")]
    command = [sys.executable, "-c", HEARS + RUNS, "sweep", *axes, *out]
    seconds, code, errors = interrupted(command, 3.0, ready=True, cache=True)
    assert code == 130 and "interrupted after " in errors and "Traceback" not in errors
    assert seconds < SOON
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.slow(first=True)
def test_an_interrupt_ends_a_command_that_compiles(tmp_path):
    out = ["--out", str(tmp_path / "map")]
    command = [sys.executable, "-c", HEARS + COMMAND, "map", *out]
    seconds, code, errors = interrupted(command, 8.0, ready=False, cache=False)
    assert code == 130 and errors.endswith("interrupted\n") and "Traceback" not in errors
    assert seconds < SOON + GRACE
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "owner, method, kept, message",
    [
        (Question, "of", False, "before the first run"),
        (Question, "identity", True, "before the first run"),
        (Memory, "dataset", False, "after 3 of 3 runs, which are not kept; a sweep with a store"),
        (store.Store, "finish", True, "3 of 3 runs are in .*; the same call goes on from there"),
    ],
)
def test_an_interrupt_beside_the_runs_says_what_became_of_them(
    tmp_path, monkeypatch, owner, method, kept, message
):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(owner, method, interrupt)
    options = dict(store=tmp_path / "a.zarr") if kept else {}
    with pytest.raises(KeyboardInterrupt, match=message):
        jb.sweep(jb.presets.class_b, {"nu0": [0.1, 0.2, 0.3], "nu1": [0.35]}, t1=5.0, **options)


@pytest.mark.slow(first=True)
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_interrupts_of_a_session_lose_nothing(tmp_path, monkeypatch):
    """At random moments, of the compilation too; the same store goes on."""
    monkeypatch.setattr(store, "BLOCK_RUNS", kills.BLOCK)
    told = kills.interrupt_campaign(tmp_path, interrupts=3, seed=2, t1=2000.0)
    assert told["interrupted"] == 3 and told["longest"] < SOON


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("where", [(threads, "wait"), (Question, "of"), (Memory, "dataset")])
def test_an_interrupt_in_a_callback_of_the_garbage_collector_is_not_lost(monkeypatch, where):
    """Python would print that it is ignored, and the sweep would go on to its end."""
    sent = []

    def interrupt_once(phase, info):
        if not sent:
            sent.append(phase)
            os.kill(os.getpid(), signal.SIGINT)

    def collect(*arguments, **options):
        # As the main thread does anywhere while it waits, and before and after.
        gc.callbacks.append(interrupt_once)
        gc.collect()
        gc.callbacks.remove(interrupt_once)
        return does(*arguments, **options)

    does = getattr(*where)
    monkeypatch.setattr(*where, collect)
    with pytest.raises(KeyboardInterrupt, match="interrupted"):
        jb.sweep(jb.presets.class_b, {"nu0": [0.3], "nu1": [0.2]}, t1=1.0, observe="final")
    assert sent
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_comes_after_an_import_that_is_under_way(tmp_path, monkeypatch):
    """An extension whose first steps are interrupted raises what no one expects, or crashes."""
    lines = "import os, signal", "os.kill(os.getpid(), signal.SIGINT)", "is_whole = True"
    (tmp_path / "interrupted_module.py").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt), heard_interrupts(at_once=True):
        module = importlib.import_module("interrupted_module")
    assert module.is_whole
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
