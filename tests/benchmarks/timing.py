"""Least times of a few calls."""

import time

import jax


def least(call, repeat=5):
    """Seconds of wall time and of processor time, the least of a few calls after one that compiles;
    and what a call returns."""
    result = jax.block_until_ready(call())
    walls, processors = [], []
    for _ in range(repeat):
        wall, processor = time.perf_counter(), time.process_time()
        result = jax.block_until_ready(call())
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    return min(walls), min(processors), result
