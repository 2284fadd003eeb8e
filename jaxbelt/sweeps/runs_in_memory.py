"""Results of runs in memory, in the order of the runs."""

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from ..kernel.lanes import Observer, Program
from ..model.oscillator import has_edges
from ..model.own_units import OwnOscillator
from .queue import by_name, layout
from .threads import run


def results_of(
    program: Program,
    shared: list[Array],
    rows_of: Callable[[int, int], np.ndarray],
    runs: int,
    **numbers: Any,
) -> dict[str, np.ndarray]:
    """Results of runs by name, [runs, ...], in the order of the runs; arguments as for
    `threads.run`; numbers: its keyword arguments, t1, rtol, atol and more."""
    shapes = layout(program, shared)
    columns = np.zeros((sum(math.prod(shape) for shape in shapes.values()), runs))

    def put(places: np.ndarray, results: np.ndarray) -> None:
        columns[:, places] = results[0]

    run(program, shared, rows_of, runs, put, **numbers)
    return by_name(shapes, columns)


def results_from(
    own: OwnOscillator, observer: Observer, starts: np.ndarray, **numbers: Any
) -> dict[str, np.ndarray]:
    """`results_of` for one oscillator as from `in_units_of_run`, from starts (x1, x2), [2, runs],
    or (x1, x2, t), [3, runs]; numbers: t1, rtol, atol, t0."""
    leaves, structure = jax.tree.flatten(own)
    mapped, own_t0 = (False,) * len(leaves), len(starts) == 3
    program = Program(structure, mapped, observer, has_edges(own), own_t0=own_t0)

    def rows_of(first: int, last: int) -> np.ndarray:
        return starts[None, :, first:last]

    return results_of(program, leaves, rows_of, starts.shape[1], **numbers)
