"""Processes that keep compiled programs in one folder and are killed at random moments.

No program that comes from the folder may be wrong, and no process may crash.
"""

import multiprocessing
import os
import random
import signal
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxbelt.numerics import compiling, programs

PROCESSES = multiprocessing.get_context("forkserver")
# Imported once; JAX is not in use there, so its processes may be forked from it.
PROCESSES.set_forkserver_preload(["jaxbelt.api"])
#: The longest time in seconds that a process is left alone, and how many run at once.
LONGEST, AT_ONCE = 4.0, 8
X = np.linspace(0.1, 1.0, 50)


def powers(x, n):
    """Sums of powers, by a program whose size grows with n: a few kilobytes and more."""
    terms = [x]
    for _ in range(n):
        terms.append(terms[-1] * x + jax.numpy.sort(terms[-1] * 0.5))
    return {"sum": sum(terms[1:], start=terms[0]), "count": n}


def expected(n: int) -> np.ndarray:
    """The same in NumPy."""
    terms = [X]
    for _ in range(n):
        terms.append(terms[-1] * X + np.sort(terms[-1] * 0.5))
    return np.sum(terms, axis=0)


def use(folder: Path) -> None:
    """Keep programs in this folder from now on."""
    os.environ["JAXBELT_CACHE_DIR"] = str(folder)
    programs.ON = True
    programs.are_kept.cache_clear()


def child(folder: Path, bound: int, seed: float, begins) -> None:
    """Call programs in any order, loaded or compiled, and see that they are right, for ever."""
    jax.config.update("jax_enable_x64", True)
    use(folder)
    programs.BOUND = bound
    rng = random.Random(seed)
    begins.set()
    while True:
        n = rng.randrange(1, 9)
        # Anew every time: nothing is in memory.
        found = compiling.jit(powers)(X, n)
        assert found["count"] == n
        # Sums are put in another order.
        np.testing.assert_allclose(found["sum"], expected(n), rtol=1e-14)


def campaign(folder: Path, kills: int, seed: int, bound: int = 150_000) -> int:
    """Kill so many processes, eight at once, in a folder with room for some of the programs.

    Returns how many programs were left there.
    """

    rng = random.Random(seed)
    running: list[Any] = []
    started = killed = 0
    while killed < kills:
        while len(running) < AT_ONCE and started < kills:
            begins = PROCESSES.Event()
            process = PROCESSES.Process(target=child, args=(folder, bound, rng.random(), begins))
            process.start()
            started += 1
            running.append((process, begins, rng.uniform(0, LONGEST)))
        process, begins, patience = running.pop(0)
        assert begins.wait(120)
        # The others work on meanwhile, so that each of them is left alone for some time.
        time.sleep(patience / AT_ONCE)
        assert process.exitcode is None, f"exit code {process.exitcode}"
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL, f"exit code {process.exitcode}"
        killed += 1
    return len(list((folder / "programs").glob("*" + programs.SUFFIX)))


def harmed(contents: bytes, rng: random.Random) -> bytes:
    """The contents of a file, damaged at a random place in a random way."""
    place = rng.randrange(len(contents))
    ways = [
        contents[:place],
        contents[:place] + bytes([contents[place] ^ 1 << rng.randrange(8)]) + contents[place + 1 :],
        contents[:place] + bytes(len(contents) - place),
        contents[:place] + rng.randbytes(16) + contents[place:],
        contents[place:],
    ]
    way = rng.choice(ways)
    return way if way != contents else b""


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        print(campaign(Path(name), kills=200, seed=1), "programs left")
