"""Attractors that runs lead to, and the words for them."""

import math
import re
from typing import Any, NamedTuple

import numpy as np

from ..cycles.attractors import is_same
from ..cycles.cycle import Cycle
from ..cycles.periodic import PeriodicMotion, is_same_motion

#: Where the mass rests, at the end of the words for an attractor.
REST = re.compile(r"(?<=rest.at.)-?\d+(\.\d+)?(e[+-]\d+)?$")


class Found(NamedTuple):
    """An attractor: its name, the runs that lead to it, and the cycle that shooting finds, if it
    is one."""

    name: str
    runs: np.ndarray
    cycle: Cycle | PeriodicMotion | None

    def is_of(self, cycle: Cycle | PeriodicMotion) -> bool:
        """Whether it is that cycle."""
        if isinstance(cycle, PeriodicMotion):
            return isinstance(self.cycle, PeriodicMotion) and is_same_motion(self.cycle, cycle)
        return isinstance(self.cycle, Cycle) and is_same(self.cycle, cycle)


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
    """The words with the place of rest in m, to the digits that are known; length: of 1, in m."""

    def in_m(found: re.Match) -> str:
        digits = len(found[0].partition("e")[0].replace(".", "").lstrip("-0"))
        return f"{float(found[0]) * float(length):.{max(1, digits)}g} m"

    return REST.sub(in_m, words)


def is_cycle(name: str) -> bool:
    """Whether the words for an attractor are those of a cycle, or of a periodic motion."""
    return name.startswith("cycle") or "-periodic" in name
