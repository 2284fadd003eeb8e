"""The work of a sweep: runs through the kernel, by blocks into memory or a store, or one by one."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from ..kernel.lanes import Observer, Program
from ..model.oscillator import has_edges
from ..model.own_units import OwnOscillator
from .datasets import Memory
from .question import Question
from .queue import by_name, column_of, layout
from .store import Store
from .threads import run

#: Function that is called with the numbers of further runs by status.
Advance = Callable[[Mapping[int, int]], None]


def do_runs(
    question: Question,
    results: Memory | Store,
    to_do: Sequence[int],
    advance: Advance,
    **options: Any,
) -> None:
    """Does the runs of some blocks; options: `threads` and `watch` of `threads.run`."""
    blocks = results.blocks
    ends = np.cumsum([blocks.size(block) for block in to_do])
    starts = np.append(0, ends[:-1])
    status = column_of(question.table.layout, "status")

    def parts(numbers: np.ndarray):
        """Yields for each block which of the numbers are in it, and their positions there."""
        if len(to_do) == 1:
            yield to_do[0], slice(None), numbers
            return
        places = np.searchsorted(ends, numbers, side="right")
        for i in np.unique(places):
            here = places == i
            yield to_do[i], here, numbers[here] - starts[i]

    def rows_of(first: int, last: int) -> np.ndarray:
        numbers = np.arange(first, last)
        runs = [blocks.runs(block, positions) for block, _, positions in parts(numbers)]
        return question.grid.rows(np.concatenate(runs), question.derivatives)

    def put(numbers: np.ndarray, columns: np.ndarray) -> None:
        for block, here, positions in parts(numbers):
            results.put(block, positions, columns[:, :, here])
        advance(counts(columns[0, status]))

    run(
        question.program,
        question.grid.shared,
        rows_of,
        int(ends[-1]),
        put,
        **question.numbers,
        derivatives=len(question.derivatives),
        **options,
    )


def results_of(
    program: Program,
    shared: list[Array],
    rows_of: Callable[[int, int], np.ndarray],
    runs: int,
    *,
    t1: float,
    rtol: float,
    atol: float | None,
    t0: float | None = None,
) -> dict[str, np.ndarray]:
    """Results of runs by name, [runs, ...], in the order of the runs; arguments as for
    `threads.run`."""
    shapes = layout(program, shared)
    columns = np.zeros((sum(math.prod(shape) for shape in shapes.values()), runs))

    def put(places: np.ndarray, results: np.ndarray) -> None:
        columns[:, places] = results[0]

    run(program, shared, rows_of, runs, put, t1=t1, rtol=rtol, atol=atol, t0=t0)
    return by_name(shapes, columns)


def results_from(
    own: OwnOscillator, observer: Observer, starts: np.ndarray, **numbers: Any
) -> dict[str, np.ndarray]:
    """`results_of` of one oscillator, as of `in_units_of_run`, from starts (x1, x2), [2, runs], or
    (x1, x2, t), [3, runs]; numbers: t1, rtol, atol, t0."""
    leaves, structure = jax.tree.flatten(own)
    mapped, own_t0 = (False,) * len(leaves), len(starts) == 3
    program = Program(structure, mapped, observer, has_edges(own), own_t0=own_t0)

    def rows_of(first: int, last: int) -> np.ndarray:
        return starts[None, :, first:last]

    return results_of(program, leaves, rows_of, starts.shape[1], **numbers)


def counts(statuses: np.ndarray) -> dict[int, int]:
    """Numbers of runs by status."""
    numbers = np.bincount(statuses.ravel().astype(int))
    return {int(i): int(numbers[i]) for i in np.flatnonzero(numbers)}
