"""The work of a sweep: the runs of its blocks through the kernel, into memory or a store."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .datasets import Memory
from .question import Question
from .queue import column_of
from .store import Store
from .threads import run

#: Function that is called with the numbers of newly done runs by status.
Advance = Callable[[Mapping[int, int]], None]


def do_runs(
    question: Question,
    results: Memory | Store,
    to_do: Sequence[int],
    advance: Advance,
    **options: Any,
) -> None:
    """Does the runs of the blocks `to_do`; options: `threads` and `watch` of `threads.run`."""
    blocks = results.blocks
    ends = np.cumsum([blocks.size(block) for block in to_do])
    starts = np.append(0, ends[:-1])
    status = column_of(question.table.layout, "status")

    def parts(numbers: np.ndarray):
        """For each block yields its number, an index of its `numbers`, their positions in it."""
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


def counts(statuses: np.ndarray) -> dict[int, int]:
    """Numbers of runs by status."""
    numbers = np.bincount(statuses.ravel().astype(int))
    return {int(i): int(numbers[i]) for i in np.flatnonzero(numbers)}
