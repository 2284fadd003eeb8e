"""Attractors that runs lead to, and the words for them."""

import math
import re
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..cycles.attractors import is_same
from ..cycles.cycle import Cycle
from ..cycles.periodic import PeriodicMotion, is_same_motion

#: Matches the place of rest in the words for an attractor: at their end or before a number (n).
REST = re.compile(r"(?<=rest.at.)-?\d+(\.\d+)?(e[+-]\d+)?(?=(.\(\d+\))?$)")


class Found(NamedTuple):
    """An attractor: its name, the runs that lead to it, and the cycle that shooting finds, if it
    is one."""

    name: str
    runs: np.ndarray
    cycle: Cycle | PeriodicMotion | None

    def is_of(self, cycle: Cycle | PeriodicMotion) -> bool:
        """Whether the attractor is the given cycle or motion."""
        if isinstance(cycle, PeriodicMotion):
            return isinstance(self.cycle, PeriodicMotion) and is_same_motion(self.cycle, cycle)
        return isinstance(self.cycle, Cycle) and is_same(self.cycle, cycle)


def told_apart(kinds: np.ndarray, of_run: Callable[[tuple[int, ...]], Found]) -> list[Found]:
    """The attractors that runs lead to, each with its runs, the most frequent first.

    kinds: kind of each run; of_run(index): the attractor of a run, with a mask of similar runs of
    any kind. Runs that differ by more than the accuracy of a sweep may still be on one cycle;
    `is_of` decides.
    """
    found: list[Found] = []
    left = kinds != "undecided"
    while np.any(left):
        first = tuple(int(i) for i in np.unravel_index(np.argmax(left), left.shape))
        one = of_run(first)
        same = left & (kinds == kinds[first]) & one.runs
        left &= ~same
        known = (other for other in found if one.cycle is not None and other.is_of(one.cycle))
        before = next(known, None)
        if before is None:
            found.append(one._replace(runs=same))
        else:
            before.runs[same] = True
    return _with_numbers(sorted(found, key=lambda one: -int(np.sum(one.runs))))


def _with_numbers(found: list[Found]) -> list[Found]:
    """The attractors, with a number behind the name where several have the same name."""
    times = Counter(one.name for one in found)
    seen: Counter[str] = Counter()
    for i, one in enumerate(found):
        seen[one.name] += 1
        if times[one.name] > 1:
            found[i] = one._replace(name=f"{one.name} ({seen[one.name]})")
    return found


def words_for(kind: str, sticks: np.ndarray, x1: float, length: float) -> str:
    """A few words for an attractor: its kind, its place at rest, the belts that it sticks to."""
    belts = " and ".join(f"belt {i}" for i in np.flatnonzero(sticks))
    if kind == "equilibrium":
        # To a thousandth of the own unit of length.
        decimals = 3 - math.floor(math.log10(length) + 0.5)
        return f"rest at {x1:.{decimals}f}" if 0 < decimals <= 6 else f"rest at {x1:.4g}"
    if kind == "stuck":
        return f"stuck to {belts}" if belts else "stuck"
    if kind in ("chaotic", "quasiperiodic"):
        return f"{kind} motion"
    moves = "cycle" if kind == "cycle" else f"{kind} motion"
    return f"{moves} that sticks to {belts}" if belts else f"{moves} that never sticks"


def rest_in_m(words: str, length: Any) -> str:
    """The words with the place of rest in m, to as many digits; length: the length 1, in m."""

    def in_m(found: re.Match) -> str:
        digits = len(found[0].partition("e")[0].replace(".", "").lstrip("-0"))
        return f"{float(found[0]) * float(length):.{max(1, digits)}g} m"

    return REST.sub(in_m, words)


def is_cycle(name: str) -> bool:
    """Whether the words for an attractor are those of a cycle, or of a periodic motion."""
    return name.startswith("cycle") or "-periodic" in name
