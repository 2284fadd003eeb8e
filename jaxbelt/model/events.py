"""Events, the changes of mode, and signatures, the events of one loop.

`simulate`, the orbits behind cycles and sweeps all name their events by `event_between`. The
signature of a cycle begins where the cycle begins; before signatures are compared or named,
`of_one_loop` brings them into one order.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np

from ..results import EventKind
from .modes import any_of

Step = TypeVar("Step")
#: The events of one loop of a cycle, (kind, belt) each.
Signature = tuple[tuple[EventKind, int], ...]


def event_between(before: Sequence[Any], after: Sequence[Any]) -> tuple[Any, Any]:
    """The event, (kind, belt), that leads from one mode to another; (0, -1) where they are equal.

    before, after: contact codes, one array per belt, of JAX or of NumPy, any common shape. The
    event is an EDGE where a belt arrives or leaves, whatever else changes; else a STICK where a
    belt is stuck only afterwards, a SLIP where one was stuck only before, else a CROSS. If several
    belts have that event, the lowest is named.
    """
    pairs = list(zip(before, after, strict=True))
    changes = {
        EventKind.EDGE: [(abs(a) < 2) != (abs(b) < 2) for a, b in pairs],
        EventKind.STICK: [(a != 0) & (b == 0) for a, b in pairs],
        EventKind.SLIP: [(a == 0) & (b != 0) for a, b in pairs],
        EventKind.CROSS: [a != b for a, b in pairs],
    }
    # NumPy arrays are handled by NumPy, which compiles nothing.
    where: Any = np.where if isinstance(before[0], np.ndarray | np.number) else jnp.where
    kind, belt = 0, -1
    for one, changed in reversed(changes.items()):
        lowest = -1
        for number, flag in reversed(list(enumerate(changed))):
            lowest = where(flag, number, lowest)
        happens = any_of(changed)
        kind, belt = where(happens, one.value, kind), where(happens, lowest, belt)
    return kind, belt


def events_of(modes: np.ndarray | Sequence[Sequence[int]]) -> Signature:
    """The events, in order, of a closed loop through modes, contact codes [modes, belts]."""
    modes = np.asarray(modes)
    if not modes.size:
        return ()  # no belt exerts a force
    kinds, belts = event_between([*modes.T], [*np.roll(modes, -1, axis=0).T])
    return tuple((EventKind(k), int(b)) for k, b in zip(kinds, belts, strict=True) if k)


def of_one_loop(steps: Sequence[Step]) -> tuple[Step, ...]:
    """The steps of a loop (events or modes) in their least cyclic order, wherever it begins."""
    loop = tuple(steps)
    orders: Any = (loop[i:] + loop[:i] for i in range(len(loop)))
    return min(orders, default=())


def signature_name(signature: Signature) -> str:
    """A signature as one word, such as stick0-slip0; "smooth" where there is no event."""
    loop = of_one_loop(signature)
    return "-".join(f"{kind.name.lower()}{belt}" for kind, belt in loop) or "smooth"
