"""What every test runs under: float64, JAX's strict promotion rules, checked annotations."""

import ctypes
import gc
import os
import random
import signal
import sys
import time
from pathlib import Path

import pytest

os.environ.setdefault("MPLBACKEND", "Agg")  # for the commands that tests start, too
# JAX keeps what tests compile, see below. With JAXBELT_CACHE=1 jaxbelt does, as for its users.
os.environ.setdefault("JAXBELT_CACHE", "0")

import jax

# Not through the environment: a command that a test starts has to ask for float64 by itself.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


# A trace makes many objects that stay: to look for garbage among them as often as Python does takes
# a seventh of the time of tests that trace.
gc.set_threshold(200_000, 20, 100)

START = time.monotonic()

#: Memory from which on a worker drops its compiled programs, in bytes; those that are asked again
#: come from the cache on disk. A hundred long tests would take three times as much. On Linux alone.
MUCH_MEMORY = 4e9
STATM = Path("/proc/self/statm")


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--minutes N`: what has not begun by then is skipped, and another part of it every time."""
    parser.addoption("--minutes", type=float, help="skip what has not begun after so many minutes")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The order of a run that may be cut short: what is checked nowhere else, `slow(first=True)`,
    then the other files, another one first in every run; the same for all its workers."""
    if config.getoption("minutes") is None:
        return
    files = sorted({item.path for item in items})
    random.Random(getattr(config, "workerinput", {}).get("testrunuid")).shuffle(files)

    def order(item):
        slow = item.get_closest_marker("slow")
        return not (slow and slow.kwargs.get("first")), files.index(item.path)

    items.sort(key=order)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skips what comes too late."""
    minutes = item.config.getoption("minutes")
    if minutes is not None and time.monotonic() - START > 60 * minutes:
        pytest.skip(f"not begun after {minutes:g} minutes")


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Drops compiled programs between files, where they have become many."""
    ends = nextitem is None or nextitem.path != item.path
    if ends and STATM.exists():
        pages = int(STATM.read_text().split()[1])
        if pages * os.sysconf("SC_PAGE_SIZE") > MUCH_MEMORY:
            jax.clear_caches()
            gc.collect()
            # What is free goes back to the system only when glibc is asked for that.
            if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
                trim(0)


@pytest.fixture
def hears_interrupts():
    """Interrupts are heard: tests that a shell starts in its background ignore them otherwise."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(autouse=True)
def close_figures():
    """A test leaves no figure open."""
    yield
    if pyplot := sys.modules.get("matplotlib.pyplot"):
        pyplot.close("all")


def pytest_configure(config: pytest.Config) -> None:
    """Keeps compiled programs for the next run, and checks jaxbelt's annotations as it runs.

    The cache is JAX_COMPILATION_CACHE_DIR where that is set, else a folder of pytest's own cache.
    Benchmarks measure the package as its users import it, with its annotations unchecked.
    """
    cache = getattr(config, "cache", None)  # missing under `-p no:cacheprovider`
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ and cache is not None:
        jax.config.update("jax_compilation_cache_dir", str(cache.mkdir("jax")))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)

    if not config.getoption("benchmark_only"):
        from jaxtyping import install_import_hook

        install_import_hook("jaxbelt", "beartype.beartype")
