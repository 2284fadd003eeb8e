"""Runs in bulk: every core at work on one queue."""

import functools
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .lanes import Program
from .queue import ROUNDS, STEPS, advance, idle

#: Steps that a run may take for each 100 units of time before it is given up. On its way to a
#: pseudo-focus beside a slow belt it may pass ten thousand events in that time.
MAX_STEPS = 400_000
#: Runs that the kernel is given at once.
CHUNK = 2**14
#: Lanes. On the CPU few, which stay near the processor, but more than is lost at each refill.
WIDTH = {"cpu": 128}


def _kernel(program: Program, derivatives: int) -> Callable:
    """The compiled kernel of a program, one for all threads and all sweeps."""
    return compiled(program, derivatives > 0, _options())


@functools.lru_cache(maxsize=32)
def compiled(program, derivatives, options):
    """The kernel, compiled when it is first called."""
    function = advance_with_derivatives if derivatives else advance
    return jax.jit(functools.partial(function, program), compiler_options=dict(options) or None)


def advance_with_derivatives(
    program, shared, t1, rtol, atol, limit, queue, first, count, stream, drain
):
    """`advance` to the end, with derivatives in the directions queue[1:] of the rows queue[0]."""

    def of_rows(rows):
        stream_out, numbers, results = advance(
            program, shared, t1, rtol, atol, limit, rows, first, count, stream, True
        )
        return results, (stream_out, numbers)

    def column(direction):
        return jax.jvp(of_rows, (queue[0],), (direction,), has_aux=True)

    out = jax.vmap(column, out_axes=(None, 0, None))(queue[1:])
    results, columns, (stream_out, numbers) = out
    return stream_out, numbers, jnp.concatenate([results[None], columns])


@functools.lru_cache(maxsize=1)
def _options() -> tuple[tuple[str, Any], ...]:
    """Compiler options of the kernel: wide vectors where the processor has them."""
    if jax.default_backend() != "cpu":
        return ()
    try:
        wide = "avx512f" in Path("/proc/cpuinfo").read_text()
    except OSError:
        return ()
    options = {"xla_cpu_prefer_vector_width": 512}
    try:
        if wide:
            jax.jit(lambda: 0, compiler_options=options)()
            return tuple(options.items())
    except jax.errors.JaxRuntimeError:
        pass  # a version of XLA that does not know the option
    return ()


def workers() -> int:
    """Threads that run the kernel: one a core on the CPU, one a device elsewhere."""
    if jax.default_backend() != "cpu":
        return jax.local_device_count()
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run(
    program: Program,
    shared: list[Array],
    rows_of: Callable[[int, int], np.ndarray],
    runs: int,
    put: Callable[[np.ndarray, np.ndarray], None],
    *,
    t1: float,
    rtol: float,
    atol: float,
    derivatives: int = 0,
    budget: float = 1.0,
) -> None:
    """Do all runs: rows_of(first, last) gives the queue, [1 + derivatives, columns, runs]:
    the starts and the parameters that vary, and their derivatives in so many directions;
    put(numbers, results) takes results [1 + derivatives, columns, runs] in any order. budget: the
    share of `MAX_STEPS` that a run may take.

    Every thread feeds chunks to one compiled kernel (which lets go of Python's lock) on its own
    lanes. Long runs stay in their lanes while the next chunk is worked on.
    """
    limit = int(budget * MAX_STEPS * max(1.0, t1 / 100)) // (STEPS * ROUNDS)
    settings = (t1, rtol, atol, np.int32(limit))
    kernel = functools.partial(_kernel(program, derivatives), shared, *settings)
    columns = 2 + sum(program.mapped)
    threads = workers()
    # The queue is of one size, for one compiled program; short work is shared out all the same.
    share = min(CHUNK, -(-runs // threads))
    width = WIDTH.get(jax.default_backend(), 2**17)
    chunks = iter([(i, min(i + share, runs)) for i in range(0, runs, share)])
    lock = threading.Lock()

    def take():
        with lock:
            return next(chunks, None)

    def work(device) -> None:
        with jax.default_device(device):
            stream, todo = idle(program, shared, width, columns), take()
            while todo is not None:
                (first, last), todo = todo, take()
                rows = np.zeros((1 + derivatives, columns, CHUNK + width))
                rows[:, :, : last - first] = rows_of(first, last)
                rows = rows if derivatives else rows[0]
                span = np.int32(first), np.int32(last - first)
                stream, numbers, results = kernel(rows, *span, stream, todo is None)
                numbers = np.asarray(numbers)
                done = np.flatnonzero(numbers >= 0)
                results = np.asarray(results).reshape(1 + derivatives, -1, len(numbers))
                with lock:
                    put(numbers[done], results[:, :, done])

    devices = jax.local_devices()
    if not runs:
        return
    # Compiled here, once, and not by each thread; on a device as there, or they would do it again.
    nothing = np.zeros((1 + derivatives, columns, CHUNK + width))
    with jax.default_device(devices[0]):
        lanes = idle(program, shared, width, columns)
        kernel(nothing if derivatives else nothing[0], np.int32(0), np.int32(0), lanes, False)
    with ThreadPoolExecutor(threads) as pool:
        started = [pool.submit(work, devices[i % len(devices)]) for i in range(threads)]
        for future in started:
            future.result()
