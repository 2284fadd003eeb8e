"""A sweep into a store that is killed at random moments, again and again, and must not mind."""

import multiprocessing
import random
import signal
import time
from pathlib import Path

import jax
import numpy as np

import jaxbelt as jb

#: 1,024 runs in 64 blocks: their writing takes about as long as a process is left alone.
AXES = {"nu0": np.linspace(-0.6, 0.55, 32), "nu1": np.linspace(-0.5, 0.5, 32)}
BLOCK = 16
#: The longest time in seconds that a process is left alone once it sweeps.
LONGEST = 0.6
PROCESSES = multiprocessing.get_context("forkserver")
# Imported once; JAX is not in use there, so its processes may be forked from it.
PROCESSES.set_forkserver_preload(["jaxbelt", "xarray", "zarr", "filelock"])


def swept(observe, store=None):
    options = dict(t1=100.0, observe=observe, store=store, progress=False)
    return jb.sweep(jb.presets.class_b, AXES, **options)


def child(store: Path, cache: Path, begins, observe: str) -> None:
    """Sweep into the store in small blocks."""
    from jaxbelt.sweeps import store as stores

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
    store = folder / "0.zarr"
    while told["killed"] < kills:
        begins = PROCESSES.Event()
        process = PROCESSES.Process(target=child, args=(store, cache, begins, observe))
        process.start()
        assert begins.wait(120)
        time.sleep(rng.uniform(0, LONGEST))
        process.kill()
        process.join()
        told["killed"] += process.exitcode == -signal.SIGKILL
        if not store.exists():
            continue
        found = jb.verify(store)
        assert not found.bad, found
        told["blocks seen done"] += len(found.done)
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
