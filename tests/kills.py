"""A sweep into a store that is killed at random moments, again and again, and must not mind.

Three campaigns: the process that sweeps is killed; workers of a Dask cluster are killed; a session
is interrupted by Ctrl-C.
"""

import contextlib
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxbelt as jb
from jaxbelt.sweeps import store as stores

#: 1,024 runs in 64 blocks: their writing takes about as long as a process is left alone.
AXES = {"nu0": np.linspace(-0.6, 0.55, 32), "nu1": np.linspace(-0.5, 0.5, 32)}
BLOCK = 16
#: The longest time in seconds that a process is left alone once it sweeps.
LONGEST = 0.6
PROCESSES = multiprocessing.get_context("forkserver")
# Imported once; JAX is not in use there, so its processes may be forked from it.
PROCESSES.set_forkserver_preload(["jaxbelt", "xarray", "zarr", "filelock"])


class Sum:
    """The sum of x1 at the events of a run: so no loop of it is skipped, and it takes its time."""

    def init(self, osc, x1, x2):
        return jnp.zeros(())

    def update(self, state, event):
        return state + event.x1

    def finish(self, state, end):
        return {"sum": state, "last": end.x1}

    def __repr__(self):
        return "Sum()"


def swept(observe, store=None, t1=100.0, **options):
    options = dict(t1=t1, observe=observe, store=store, progress=False) | options
    return jb.sweep(jb.presets.class_b, AXES, **options)


def child(store: Path, cache: Path, begins, observe: str) -> None:
    """Sweep into the store in small blocks."""

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    stores.BLOCK_RUNS = BLOCK
    one = {name: values[:1] for name, values in AXES.items()}
    jb.sweep(jb.presets.class_b, one, t1=100.0, observe=observe, progress=False)
    begins.set()
    swept(observe, store)


def campaign(folder: Path, observe: str, kills: int, seed: int) -> dict[str, int]:
    """Kill so many processes; every block that is called done has to be right each time, and every
    store that is finished has to be what an uninterrupted sweep gives, bit for bit."""
    rng, whole = random.Random(seed), swept(observe)
    # Where the sweep above has left its program, or else of the children alone.
    cache = Path(jax.config.jax_compilation_cache_dir or folder / "cache")
    told = {"killed": 0, "stores": 0, "blocks seen done": 0}
    store, longest = folder / "0.zarr", LONGEST
    while told["killed"] < kills:
        begins = PROCESSES.Event()
        process = PROCESSES.Process(target=child, args=(store, cache, begins, observe))
        process.start()
        assert begins.wait(120)
        time.sleep(rng.uniform(0, longest))
        process.kill()
        process.join()
        told["killed"] += process.exitcode == -signal.SIGKILL
        if not store.exists():
            longest *= 2  # a slow machine
            continue
        found = jb.verify(store)
        assert not found.bad, found
        told["blocks seen done"] += len(found.done)
        if not found.done:
            longest *= 2
        if process.exitcode == 0 or found.finished:
            assert found.finished and Kept(store).identical_values(whole)
            told["stores"] += 1
            store = folder / f"{told['stores']}.zarr"
    begins = PROCESSES.Event()
    process = PROCESSES.Process(target=child, args=(store, cache, begins, observe))
    process.start()
    process.join(120)
    assert process.exitcode == 0 and Kept(store).identical_values(whole)
    return told


# --- workers of a cluster -------------------------------------------------------------------------

#: The longest time in seconds between two kills of workers.
LONGEST_OF_WORKERS = 3.0


@contextlib.contextmanager
def cluster(workers: int, cache: Path | None = None):
    """A client of workers on this machine: spawned, of one thread each."""
    import dask
    from distributed import Client, LocalCluster

    settings = {"JAX_PLATFORMS": "cpu", "OMP_NUM_THREADS": "1"}
    settings["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    if cache is not None:
        settings["JAX_COMPILATION_CACHE_DIR"] = str(cache)
    options = dict(n_workers=workers, threads_per_worker=1, dashboard_address=None)
    with (
        dask.config.set({"distributed.nanny.pre-spawn-environ": settings}),
        LocalCluster(**options, memory_limit=0, silence_logs=50) as local,
        Client(local) as client,
    ):
        yield client


def worker_campaign(client, folder: Path, kills: int, seed: int, t1=4000.0) -> dict[str, int]:
    """Kill so many workers of a sweep; no block may be bad at any time, and every store has to be
    what a sweep in this process gives, bit for bit."""
    rng, whole = random.Random(seed), swept(Sum(), t1=t1)
    told = {"killed": 0, "stores": 0, "blocks done twice": 0}
    with ThreadPoolExecutor(1) as pool:
        while told["killed"] < kills:
            store = folder / f"{told['stores']}.zarr"
            sweeping = pool.submit(swept, Sum(), store, t1, executor=client)
            while not sweeping.done() and told["killed"] < kills:
                time.sleep(rng.uniform(0, LONGEST_OF_WORKERS))
                # At work: Dask gives up a worker that dies before it has registered.
                busy = {address for address, keys in client.processing().items() if keys}
                nannies = client.cluster.workers.values()
                given_up = [one.status.name in ("closed", "failed") for one in nannies]
                assert not all(given_up), "Dask has given up all workers"
                alive = [one.pid for one in nannies if one.pid and one.worker_address in busy]
                if alive and not sweeping.done():
                    os.kill(rng.choice(alive), signal.SIGKILL)
                    told["killed"] += 1
                    assert not store.exists() or not jb.verify(store).bad
            sweeping.result(timeout=300)
            assert jb.verify(store).finished and Kept(store).identical_values(whole)
            told["stores"] += 1
            told["blocks done twice"] += int(np.sum(times_done(store) > 1))
    return told


def times_done(store: Path) -> np.ndarray:
    """How often each block was done."""
    import zarr

    rows = np.asarray(zarr.open_group(store, mode="r")["ledger"]["blocks"])
    return rows[:, stores.TIMES_DONE]


# --- Ctrl-C ---------------------------------------------------------------------------------------

#: A session: for every line that comes, it goes on with a sweep, and is back at the prompt when the
#: sweep ends or is interrupted. With "compile" in the line nothing is left of earlier compilations.
SESSION = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.path.append(sys.argv[1])
import jax
jax.config.update("jax_enable_x64", True)
import kills
from jaxbelt.sweeps import store, threads
store.BLOCK_RUNS = kills.BLOCK
print("ready", flush=True)
line = "begin"
while line:
    try:
        line = sys.stdin.readline()
        if "compile" in line:
            threads.compiled.cache_clear()
            jax.clear_caches()
        if line:
            print("begins", flush=True)
            kills.swept(kills.Sum(), line.split()[0], t1=float(sys.argv[2]))
            print("finished", flush=True)
    except KeyboardInterrupt as error:
        # Without a message it came just before or after the sweep.
        print("interrupted" if str(error) else "missed", error, flush=True)
"""
#: The longest time in seconds that a sweep is left alone.
LONGEST_OF_SESSIONS = 5.0
#: Seconds after which a session that does not answer is ended, for each interrupt.
LONGEST_ANSWER = 30.0


def interrupt_campaign(folder: Path, interrupts: int, seed: int, t1=8000.0) -> dict[str, float]:
    """Interrupt a session so many times; it has to say what is kept, no block may be bad, and every
    finished store has to be what an uninterrupted sweep gives, bit for bit.

    Returns among others the longest time in seconds from an interrupt to the prompt.
    """
    rng, whole = random.Random(seed), swept(Sum(), t1=t1)
    told = {"interrupted": 0, "before any block": 0, "stores": 0, "longest": 0.0}
    # Nothing compiled is kept on the disk.
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    command = [sys.executable, "-c", SESSION, str(Path(__file__).parent), str(t1)]
    pipes = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
    with subprocess.Popen(command, **pipes) as session:
        silent = threading.Timer((interrupts + 2) * LONGEST_ANSWER, session.kill)
        silent.start()
        ask, answers = session.stdin, session.stdout
        assert ask and answers and answers.readline() == "ready\n"
        while told["interrupted"] < interrupts or told["stores"] == 0:
            store = folder / f"interrupted{told['stores']}.zarr"
            more = told["interrupted"] < interrupts
            print(store, "compile" if more and rng.random() < 0.5 else "", file=ask, flush=True)
            assert answers.readline() == "begins\n"
            after = rng.uniform(0, LONGEST_OF_SESSIONS) if more else None
            answer, took = interrupted_after(session, after)
            if answer.startswith("interrupted"):
                early = "before the first run" in answer
                goes_on = "runs are in" in answer and "the same call goes on from" in answer
                assert early or goes_on
                told["interrupted"] += 1
                told["before any block"] += early or " 0 of " in answer
                told["longest"] = max(told["longest"], took)
                assert not store.exists() or not jb.verify(store).bad
            elif answer == "finished\n":
                assert Kept(store).identical_values(whole)
                told["stores"] += 1
            else:
                assert answer.startswith("missed")
        silent.cancel()
        ask.close()
    return told


def interrupted_after(session, seconds: float | None) -> tuple[str, float]:
    """What a session that sweeps answers, and how long after the interrupt, which is left out if it
    has finished by then, or with None."""
    sent: list[float] = []

    def interrupt():
        sent.append(time.monotonic())
        session.send_signal(signal.SIGINT)

    timer = threading.Timer(seconds or 0.0, interrupt)
    if seconds is not None:
        timer.start()
    answer = session.stdout.readline()
    took = time.monotonic() - sent[0] if sent else 0.0
    timer.cancel()
    if seconds is not None:
        timer.join()
    if sent and answer == "finished\n":  # then it was too late, and is answered, too
        assert session.stdout.readline().startswith("missed")
    return answer, took


class Kept:
    """What lies in a store, as a user opens it."""

    def __init__(self, store: Path):
        import xarray

        self.dataset = xarray.open_zarr(store).load()

    def identical_values(self, other) -> bool:
        """Bit for bit: NaN equals NaN, and -0.0 is not 0.0."""
        same = self.dataset.equals(other)
        for name, variable in other.variables.items():
            same = same and self.dataset[name].values.tobytes() == variable.values.tobytes()
        return same
