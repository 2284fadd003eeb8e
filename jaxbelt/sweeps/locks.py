"""Locks of stores: no two sweeps do the same blocks at once.

A sweep of the blocks from `first` to `last` holds the lock file `first-last` in a hidden folder
beside the store; another sweep that needs some of them is refused. So the processes of a cluster's
job array, each with its own blocks, write to one store at once. A lock of the folder, the door, is
held for a moment while locks are taken and released.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

#: End of the range of blocks that locks the whole store: more than any store has.
ALL_BLOCKS = 2**63
#: Seconds to wait for the door: its holder may be creating a store.
DOOR_PATIENCE = 60.0


def hidden_beside(path: Path, kind: str) -> Path:
    """Path of a hidden folder of some kind beside a store, which may be the working folder."""
    path = Path(os.path.abspath(path))
    return path.with_name(f".{path.name}.{kind}")


@contextmanager
def locked(
    path: Path,
    first: int = 0,
    last: int = ALL_BLOCKS,
    prepare: Callable[[], Any] = lambda: None,
) -> Iterator[None]:
    """Keeps other sweeps off these blocks, on this machine and on others that see the folder.

    prepare is called while the door is held and the blocks are locked.
    """
    from filelock import FileLock

    folder = hidden_beside(path, "locks")
    folder.mkdir(exist_ok=True)
    mine = FileLock(folder / f"{first}-{last}", timeout=0)
    with FileLock(folder / "door", timeout=DOOR_PATIENCE):
        for other in folder.glob("*-*"):
            start, end = map(int, other.name.split("-"))
            if start < last and first < end:
                _refuse_if_held(path, other)
        mine.acquire()
        try:
            prepare()
        except BaseException:
            mine.release()
            raise
    try:
        yield
    finally:
        with FileLock(folder / "door", timeout=DOOR_PATIENCE):
            mine.release()
            Path(mine.lock_file).unlink(missing_ok=True)


def _refuse_if_held(path: Path, other: Path) -> None:
    """Raises a `BlockingIOError` if another process holds the lock `other`; else removes it."""
    from filelock import FileLock, Timeout

    lock = FileLock(other, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise BlockingIOError(
            f"store {path} is being written by another sweep; wait for it, or use another store"
        ) from None
    lock.release()
    other.unlink(missing_ok=True)
