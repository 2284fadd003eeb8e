"""Locks of stores: no two sweeps do the same blocks at once.

Who does the blocks from `first` to `last` holds the lock file `first-last` in a hidden folder
beside the store; whoever wants blocks among these is refused. So the processes of a cluster's job
array, each with blocks of its own, write to one store at once. Locks are taken and left behind a
door, the lock of the folder, which is held for a moment.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

#: More blocks than there are: the end of what is locked by who wants the whole store.
ALL_BLOCKS = 2**63
#: Seconds that may pass before the door opens: a store may be created behind it.
DOOR_PATIENCE = 60.0


@contextmanager
def locked(
    path: Path,
    first: int = 0,
    last: int = ALL_BLOCKS,
    prepare: Callable[[], Any] = lambda: None,
) -> Iterator[None]:
    """Keep other sweeps off these blocks, on this machine and on others that see the folder.

    prepare is called behind the door, when the blocks are locked.
    """
    from filelock import FileLock

    folder = path.with_name(f".{path.name}.locks")
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
    """Raise if somebody holds that lock; what a process left that died is removed."""
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
