"""Audits of sweeps: some runs are repeated without shortcuts, and the results compared.

The kernel of `queue` has three shortcuts: a run of final states skips loops once it has seen one
repeat; a run that looks for its attractor ends as soon as it knows it; and a run that is captured
by a pseudo-focus ends at rest there. The audited runs take none of them and go to t1. From the
state at t1 the attractor is then looked for again: it has to be the same one.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ..kernel.events import word_events
from ..kernel.lanes import Program
from ..model.events import of_one_loop
from ..model.pseudofocus import FOCUS_RADIUS
from ..results import Status
from .attractor import CYCLE, UNDECIDED
from .observers import Final
from .runs_in_memory import results_of
from .threads import CHUNK

#: States and extrema agree up to so many tolerances of a step: errors add up over a run.
AUDIT_CLOSE = 1e4
#: Share of `STEP_BUDGET` that an audited run may take, as no pseudo-focus ends it early.
LONG_WAY_BUDGET = 0.025

Results = dict[str, np.ndarray]


def chosen(runs: int, share: float) -> np.ndarray:
    """Numbers of the runs that are audited: the same ones for the same sweep."""
    count = math.ceil(share * runs)
    return np.sort(np.random.default_rng(runs).choice(runs, count, replace=False))


def differing(
    program: Program,
    shared: list[Any],
    rows_of: Callable[[np.ndarray], np.ndarray],
    runs: np.ndarray,
    known: Results,
    numbers: dict[str, Any],
    length: float,
) -> np.ndarray:
    """Numbers of the audited runs whose results differ without shortcuts.

    rows_of(runs): the kernel's rows of some runs, [columns, runs]; known: the sweep's results
    for the audited runs by name, a row for each run; numbers: those of its `Question`; length: own
    unit of length of the oscillators.
    """
    atol = numbers["rtol"] * length if numbers["atol"] is None else numbers["atol"]
    close = functools.partial(_close, atol=atol, rtol=numbers["rtol"])
    captured = functools.partial(_captured, within=FOCUS_RADIUS * length)
    rows = np.concatenate(
        [rows_of(part) for part in np.array_split(runs, -(-len(runs) // CHUNK.here))], axis=1
    )
    long_way = dataclasses.replace(program, observer=Final(skip=False), captures=False)
    final = _results(long_way, shared, rows, numbers)
    if isinstance(program.observer, Final):
        return runs[~_same_ends(known, final, close, captured)]
    rows[:2] = final["x1_end"], final["x2_end"]
    again = _results(program, shared, rows, numbers)
    return runs[~_same_attractors(known, final, again, close, captured)]


def _results(program, shared, rows: np.ndarray, numbers: dict[str, Any]) -> Results:
    """The kernel's results for the rows, [columns, runs]."""

    def rows_of(first: int, last: int) -> np.ndarray:
        return rows[None, :, first:last]

    runs = rows.shape[1]
    return results_of(program, shared, rows_of, runs, **numbers, budget=LONG_WAY_BUDGET)


def _close(a: np.ndarray, b: np.ndarray, *, atol: float, rtol: float) -> np.ndarray:
    largest = np.maximum(np.abs(a), np.abs(b))
    return np.abs(a - b) <= AUDIT_CLOSE * (atol + rtol * largest)


def _same_ends(known: Results, final: Results, close: Callable, captured: Callable) -> np.ndarray:
    """Mask of runs whose ends agree: to the tolerance, both not finite, or near a pseudo-focus."""
    same = (known["n_events"] == final["n_events"]) & (known["status"] == final["status"])
    same &= np.all(known["mode_end"] == final["mode_end"], axis=1)
    for name in ("x1_end", "x2_end"):
        same &= close(known[name], final[name])
    lost = (known["status"] == Status.NOT_FINITE) & (final["status"] == Status.NOT_FINITE)
    return same | lost | captured(known["x1_end"], known, final)


def _captured(x1: np.ndarray, known: Results, final: Results, *, within: float) -> np.ndarray:
    """Mask of runs that ended at a pseudo-focus at x1 and stay there without the shortcut."""
    distance = np.hypot(final["x1_end"] - x1, final["x2_end"])
    return (known["status"] == Status.PSEUDO_FOCUS) & (distance <= within)


def _same_attractors(
    known: Results, final: Results, again: Results, close: Callable, captured: Callable
) -> np.ndarray:
    """Mask of runs whose attractors agree in kind, place and events; undecided ones always do."""
    decided = (known["kind"] != UNDECIDED) & (again["kind"] != UNDECIDED)
    same = known["kind"] == again["kind"]
    for name in ("x1_min", "x1_max", "x2_min", "x2_max"):
        same &= close(known[name], again[name])
    cycle = same & (known["kind"] == CYCLE)
    same &= ~cycle | close(known["period"], again["period"])
    belts = known["sticks"].shape[1]
    for i in np.flatnonzero(cycle):
        loops = (
            of_one_loop(word_events(int(word), belts))
            for word in (known["signature"][i], again["signature"][i])
        )
        same[i] &= len(set(loops)) == 1
    return same | ~decided | captured(known["x1_max"], known, final)
