"""Runs in bulk: all cores at work on one queue, each with a kernel on its own lanes."""

import atexit
import functools
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks import require
from ..interrupts import heard_interrupts
from ..kernel.lanes import Program
from ..kernel.rounds import STEPS_PER_ROUND
from ..numerics.compiling import wide
from ..numerics.widths import SideBySide, as_here, is_cpu
from .queue import ROUNDS_PER_PASS, Call, Common, advance, differentiable, idle

#: Steps that a run may take for each 100 units of time before it ends, TOO_MANY_STEPS. On its way
#: to a pseudo-focus beside a slow belt it may pass ten thousand events in that time.
STEP_BUDGET = 400_000
#: Runs that the kernel gets at once: enough that the cost of a call is negligible, and few enough
#: that the threads end together.
CHUNK = SideBySide(on_cpu=2**14, elsewhere=2**20)
#: Number of lanes, large enough that a refill is cheap for each.
WIDTH = SideBySide(on_cpu=128, elsewhere=2**20)
#: Few runs get fewer lanes, in steps of the factor `COARSER`, so that few programs are compiled.
LEAST_WIDTH = SideBySide(on_cpu=128, elsewhere=2**10)
COARSER = 32
#: Seconds within which an interrupt takes effect; a call of the kernel takes half of that or less.
PATIENCE = 0.5
#: Passes of the first call, before it is known how long one takes: about a seventh of a second on
#: the CPU; with derivatives, or where there are more lanes, a pass takes longer.
FIRST_PASSES = SideBySide(on_cpu=2000, elsewhere=100)


@functools.lru_cache(maxsize=32)
def compiled(program: Program) -> Callable:
    """The kernel of a program, one for all threads and all sweeps.

    It is compiled at the first call with each number of derivatives.
    """
    return wide(functools.partial(advance, program))


def workers() -> int:
    """Number of threads that run the kernel: one for each core, or device other than a CPU."""
    if not is_cpu():
        return jax.local_device_count()
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def lanes_for(runs: int) -> int:
    """Number of lanes for a thread that has `runs` runs to do."""
    width = WIDTH.here
    while width // COARSER >= max(runs, LEAST_WIDTH.here):
        width //= COARSER
    return width


def run(
    program: Program,
    shared: list[Array],
    rows_of: Callable[[int, int], np.ndarray],
    runs: int,
    put: Callable[[np.ndarray, np.ndarray], None],
    *,
    t1: float,
    rtol: float,
    atol: float | None,
    t0: float | None = None,
    derivatives: int = 0,
    budget: float = 1.0,
    threads: int | None = None,
    width: int | None = None,
    watch: Callable[[], None] = lambda: None,
) -> None:
    """Does all runs, on `threads` threads or, with None, on all cores.

    Every thread feeds chunks to one compiled kernel (which releases Python's lock) on its own
    lanes. Long runs stay in their lanes while the next chunk is worked on. An exception, also a
    `KeyboardInterrupt`, or one that `watch` raises, ends all threads within `PATIENCE` and is
    raised.

    Args:
        program: Program of the kernel.
        shared: Leaves of the oscillator that do not vary.
        rows_of: rows_of(first, last) returns the queue, [1 + derivatives, columns, runs]: the
            starts and the varying parameters, and their derivatives. Starts are in the units in
            which the oscillators were given.
        runs: Number of runs.
        put: put(numbers, results) takes results [1 + derivatives, columns, runs] in any order, on
            any thread.
        t1: End of the runs.
        t0: Time at which they begin, see `queue.Common`.
        rtol: Relative tolerance of a step.
        atol: Absolute tolerance of a step, in the given units; None: the default, in own units.
        derivatives: Number of directions of derivatives.
        budget: Share of `STEP_BUDGET` that a run may take.
        threads: Number of threads.
        width: Number of lanes of each thread; None: by the number of runs.
        watch: Called every tenth of a second.
    """
    if not runs:
        return
    largest = np.iinfo(np.int32).max
    require(runs <= largest, "axes", f"{largest} runs or fewer in one call", runs)
    span = t1 - (t0 or 0.0)
    limit = int(budget * STEP_BUDGET * max(1.0, span / 100)) // (STEPS_PER_ROUND * ROUNDS_PER_PASS)
    limit = min(limit, largest)
    threads = workers() if threads is None else threads
    columns = program.columns
    atol = np.nan if atol is None else atol
    width = lanes_for(-(-runs // threads)) if width is None else width
    most = CHUNK.here * width // WIDTH.here
    team = _Team(
        functools.partial(compiled(program), Common(shared, t1, rtol, atol, np.int32(limit), t0)),
        functools.partial(_first_streams, program, shared, width, columns, derivatives),
        rows_of,
        put,
        (1 + derivatives, columns, most + width),
        _Chunks(runs, threads, most),
        FIRST_PASSES.here // (1 + derivatives),
    )
    devices = jax.local_devices()
    with heard_interrupts(at_once=False) as raise_interrupt:

        def look():
            raise_interrupt()
            watch()

        # Compiled once, before the threads begin, and not on the thread of the caller, so that an
        # interrupt need not wait for the compiler.
        _wait([_started(team.compile, devices[0])], look)
        at_work = [_started(team.work, devices[i % len(devices)]) for i in range(threads)]
        try:
            _wait(at_work, look)
        finally:
            team.stop.set()
            wait(at_work, timeout=10 * PATIENCE)


def _first_streams(program: Program, shared, width: int, columns: int, derivatives: int) -> Any:
    """The empty stream that a kernel starts from, and its derivatives, all zero."""
    stream = idle(program, shared, width, columns)
    return stream, [jax.tree.map(jnp.zeros_like, differentiable(stream))] * derivatives


class _Chunks:
    """The runs in chunks, (first, last) each, for several threads to take.

    Few runs are shared out evenly.
    """

    def __init__(self, runs: int, threads: int, most: int):
        share = min(most, -(-runs // threads))
        self.spans = iter([(i, min(i + share, runs)) for i in range(0, runs, share)])
        self.lock = threading.Lock()

    def take(self) -> tuple[int, int] | None:
        with self.lock:
            return next(self.spans, None)


@dataclass
class _Team:
    """What the threads of one call of `run` share; see its arguments.

    room: shape of a queue, with a chunk and one more run for each lane.
    """

    kernel: Callable
    idle: Callable[[], Any]
    rows_of: Callable[[int, int], np.ndarray]
    put: Callable[[np.ndarray, np.ndarray], None]
    room: tuple[int, int, int]
    chunks: _Chunks
    first_passes: int
    stop: threading.Event = field(default_factory=threading.Event)
    #: Empty streams to begin with, by device; threads share them, as a kernel changes no argument.
    streams: dict[Any, Any] = field(default_factory=dict)

    def compile(self, device) -> None:
        """Compiles the kernel by a call with nothing to do, on a device as `work` calls it."""
        zero = np.int32(0)
        with _settings(device):
            call = Call(zero, zero, zero, zero, np.bool_(False))
            queue = jax.device_put(self._queue())
            jax.block_until_ready(self.kernel(queue, call, self._begun(device)))

    def _begun(self, device) -> Any:
        if device not in self.streams:
            self.streams[device] = self.idle()
        return self.streams[device]

    def work(self, device) -> None:
        """Takes chunks until there are no more, or until the team is stopped."""
        with _settings(device):
            passes = self.first_passes
            streams, todo = self._begun(device), self.chunks.take()
            while todo is not None and not self.stop.is_set():
                (first, last), todo = todo, self.chunks.take()
                queue, drain = self._queue(), todo is None
                queue[..., : last - first] = self.rows_of(first, last)
                streams, passes = self._chunk(queue, first, last, drain, streams, passes)

    def _queue(self) -> np.ndarray:
        """Zeros with room for a chunk, always of one size, so that one compiled kernel serves."""
        return np.zeros(self.room)

    def _chunk(self, queue, first: int, last: int, drain: bool, streams, passes: int):
        """Calls the kernel until a chunk is taken (with `drain`: done).

        A call takes about half of PATIENCE. Returns the streams, and how many passes the next call
        may make.
        """
        # Transferred to the device once, for all calls.
        queue, taken, more = jax.device_put(queue), np.int32(0), True
        while more and not self.stop.is_set():
            began = time.monotonic()
            span = np.int32(first), np.int32(last - first)
            call = Call(*span, taken, np.int32(passes), np.bool_(drain))
            streams, taken, more, numbers, results = self.kernel(queue, call, streams)
            numbers, more = np.asarray(numbers), bool(more)
            seconds = time.monotonic() - began
            if more:  # it made all of its passes
                passes = int(np.clip(passes * 0.5 * PATIENCE / seconds, 1, 4 * passes))
            done = np.flatnonzero(numbers >= 0)
            if done.size:
                self.put(numbers[done], np.asarray(results)[:, :, done])
        return streams, passes


@contextmanager
def _settings(device) -> Iterator[None]:
    """JAX's settings on a thread: a caller's `with` affects the caller's thread only."""
    with jax.enable_x64(True), jax.default_device(device):
        yield


#: Threads at work. They outlive a call only if an interrupt came while one was compiling,
#: which nothing can interrupt.
_alive: set[threading.Thread] = set()


def _started(function: Callable, *args: Any) -> Future:
    """Runs a function on a new thread."""
    future: Future = Future()
    function = as_here(function)

    def call():
        try:
            future.set_result(function(*args))
        except BaseException as error:
            future.set_exception(error)
        finally:
            _alive.discard(threading.current_thread())

    thread = threading.Thread(target=call, daemon=True)
    _alive.add(thread)
    thread.start()
    return future


@atexit.register
def _end_of_process() -> None:
    """Waits for all threads: any alive at the end of the interpreter would abort the process.

    A process that ends by an interrupt does not wait: the signal ends it, as Python does.
    """
    if _alive and getattr(sys, "last_type", None) is KeyboardInterrupt:
        sys.stdout.flush()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.raise_signal(signal.SIGINT)
    for thread in tuple(_alive):
        thread.join()


def _wait(futures: list[Future], watch: Callable[[], None]) -> None:
    """Waits until all futures are done or one has failed, and raises the error of that one."""
    # With a timeout, as some systems do not interrupt a wait without one.
    while wait(futures, timeout=0.1, return_when=FIRST_EXCEPTION).not_done:
        watch()
        for future in futures:
            if future.done():
                future.result()
    for future in futures:
        future.result()
