"""Processes in which JAX cannot compute: those forked from one that used it.

A fork copies the memory of a process but none of its threads, and JAX waits for its threads: most
of what it is asked to do in the child never ends. So the child is told at once.
"""

import os
import sys

_forked = False


def _note() -> None:
    global _forked
    # JAX's own list of its backends, empty while they are not in use; the public function that
    # asks for them starts them.
    in_use = getattr(sys.modules.get("jax._src.xla_bridge"), "_backends", True)
    _forked = _forked or bool(in_use)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note)


def require_own_threads() -> None:
    """Raise a `RuntimeError` in a process that was forked after JAX was used."""
    if _forked:
        raise RuntimeError(
            "jaxbelt cannot compute in a process that was forked after JAX was used: JAX's threads "
            "are not in it, so it would wait for ever. Start processes by the method spawn, such "
            'as multiprocessing.get_context("spawn").Pool() or '
            'ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))'
        )
