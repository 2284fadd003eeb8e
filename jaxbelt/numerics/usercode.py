"""User-defined code in compiled programs: whether it still is what it was.

JAX finds a compiled program in memory by the classes and objects that it is called with: laws,
forces, conditions, functionals. What these read may have changed since: globals, attributes of
classes and of objects. So before a program is called, their fingerprints are compared with those of
the call before. Where one differs all programs are compiled again, or loaded.
"""

import contextlib
import contextvars
import functools
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import jax

from ..identity import REPR_TYPES, fingerprint_of_known, is_installed, own_parts

#: By the `id` of a part: a weak reference to the part, or the part itself, and its fingerprint.
_remembered: dict[int, tuple[Any, str]] = {}
#: Whether a call whose arguments are watched is under way: the calls in its trace are part of it.
_in_call = contextvars.ContextVar("in_call", default=False)
#: Functions to call whenever JAX's programs are forgotten.
_also_forgotten: list[Callable[[], None]] = []


def forgotten_with_programs(forget: Callable[[], None]) -> None:
    """Have a function called whenever programs have to be forgotten."""
    _also_forgotten.append(forget)


@contextlib.contextmanager
def watched(leaves: list[Any], structure: Any) -> Iterator[None]:
    """Around the call of a program with these arguments: where user-defined code among them has
    changed since the last call, programs are forgotten first."""
    parts = [] if _in_call.get() else [*_parts_of_structure(structure), *_parts_of_leaves(leaves)]
    if not parts:
        yield
        return
    known = [_remembered.get(id(part), (None, ""))[1] for part in parts]
    new = [part for part, was in zip(parts, known) if fingerprint_of_known(part) != was]
    if any(id(part) in _remembered for part in new):
        jax.clear_caches()
        for forget in _also_forgotten:
            forget()
    mark = _in_call.set(True)
    try:
        yield
    finally:
        _in_call.reset(mark)
        # A trace may have changed what the code reads, as a counter of calls.
        for part in new:
            _remember(part)


def _parts_of_structure(structure: Any) -> list[Any]:
    try:
        return _known_parts(structure)
    except TypeError:  # not hashable: JAX refuses it
        return []


@functools.lru_cache(maxsize=1024)
def _known_parts(structure: Any) -> list[Any]:
    return own_parts(structure)


def _parts_of_leaves(leaves: list[Any]) -> list[Any]:
    """The `own_parts` of the leaves that are no numbers."""
    found = []
    for leaf in leaves:
        if not (hasattr(leaf, "dtype") or isinstance(leaf, REPR_TYPES) or is_installed(leaf)):
            found += own_parts(leaf)
    return found


def _remember(part: Any) -> None:
    key = id(part)
    try:
        held: Any = weakref.ref(part, lambda _: _remembered.pop(key, None))
    except TypeError:  # an object with slots
        held = part
    _remembered[key] = held, fingerprint_of_known(part)
