"""Events, the changes of mode, and signatures, what happens in one loop.

`simulate`, the orbits behind cycles and sweeps all name their events by `event_between`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..results import EventKind
from .modes import any_of

#: The events of one loop of a cycle, (kind, belt) each.
Signature = tuple[tuple[EventKind, int], ...]


def event_between(before: Sequence[Any], after: Sequence[Any]) -> tuple[Any, Any]:
    """The event, (kind, belt), that leads from one mode to another; (0, -1) where they are equal.

    before, after: contact codes, an array a belt, of JAX or of NumPy, any common shape. Where a
    belt comes or goes it is an EDGE, whatever else changes; else a STICK where one is stuck
    afterwards only, a SLIP where one was before only, else a CROSS. Of several belts concerned the
    lowest is told.
    """
    pairs = list(zip(before, after, strict=True))
    changes = {
        EventKind.EDGE: [(abs(a) < 2) != (abs(b) < 2) for a, b in pairs],
        EventKind.STICK: [(a != 0) & (b == 0) for a, b in pairs],
        EventKind.SLIP: [(a == 0) & (b != 0) for a, b in pairs],
        EventKind.CROSS: [a != b for a, b in pairs],
    }
    # Operators only: they leave what is NumPy's in NumPy, which compiles nothing.
    kind, belt = 0, -1
    for one, changed in reversed(changes.items()):
        happens = any_of(changed)
        lowest = -1
        for number, flag in reversed(list(enumerate(changed))):
            lowest = lowest + flag * (number - lowest)
        kind = kind + happens * (one.value - kind)
        belt = belt + happens * (lowest - belt)
    return kind, belt


def events_of(modes: np.ndarray | Sequence[Sequence[int]]) -> Signature:
    """The events of a loop through modes, contact codes [modes, belts], and back to the first."""
    modes = np.asarray(modes)
    kinds, belts = event_between([*modes.T], [*np.roll(modes, -1, axis=0).T])
    return tuple((EventKind(k), int(b)) for k, b in zip(kinds, belts, strict=True) if k)
