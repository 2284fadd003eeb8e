"""Verification of stores: whether blocks and axes are what was written."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..checks import as_path, require, require_value
from ..results import draw
from ..tables import table_of
from .datasets import renumber
from .locks import locked
from .store import CHECKSUM, DONE, STATE, TO_DO, Content, checksum

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True)
class Verified:
    """Blocks of a store by state; what `verify` returns.

    Attributes:
        done: Numbers of blocks that are done and right.
        to_do: Numbers of blocks that are not done.
        bad: Numbers of blocks whose data are not what was written.
        finished: Whether all blocks and axes are right and the categories numbered.
        axes: Names of the axes whose values are not what was written; the call that made the store
            writes them again.
    """

    done: tuple[int, ...]
    to_do: tuple[int, ...]
    bad: tuple[int, ...]
    finished: bool
    axes: tuple[str, ...] = ()

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each block, in order; columns: block, state ("right", "to do" or
        "bad")."""
        named = {"right": self.done, "to do": self.to_do, "bad": self.bad}
        pairs = sorted((block, state) for state, blocks in named.items() for block in blocks)
        blocks, states = [block for block, _ in pairs], [state for _, state in pairs]
        return table_of({"block": np.array(blocks, int), "state": np.array(states, str)})

    def plot(self, ax: Any = None) -> Any:
        """Draws the blocks in rows, coloured by their states.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        more = ", ..." * (len(self.bad) > 10)
        bad = f" ({', '.join(map(str, self.bad[:10]))}{more})" if self.bad else ""
        if self.axes:
            bad += f"; bad axes {', '.join(self.axes)}, which the call that made the store "
            bad += "writes again"
        return (
            f"Verified({len(self.done)} blocks right, {len(self.to_do)} to do, {len(self.bad)} bad"
            f"{bad}; {'finished' if self.finished else 'not finished'})"
        )


def verify(path: str | Path, repair: bool = False) -> Verified:
    """Checks whether the data in a store are what was written: all checksums are computed again.

    Axes are compared with the digests in the question of the store. They are not mended from these:
    the call that made the store is given the axes, and writes those that are bad again.

    Args:
        path: Folder of a store that `sweep` wrote.
        repair: Whether to mark bad blocks as to do, so that the call that made the store does them
            again.

    Returns:
        The blocks by state, and the bad axes, `Verified`.

    Raises:
        ValueError: If there is no store that this version knows, or its metadata are harmed; the
            message names their file.
        OSError: If a sweep is writing it and `repair` is set.
    """
    path = as_path(path, "path")
    require_value(isinstance(repair, bool), "repair", "True or False", repair)
    require(path.exists(), "path", "that of a store, a folder", f"{path}, which is not there")
    if not repair:
        return _verified(Content(path, "r"))
    with locked(path):
        content = Content(path)
        found = _verified(content)
        for block in found.bad:
            content.rows[block] = np.zeros(4)
        if not found.finished:
            content.ledger.attrs["finished"] = False
    return found


def _verified(content: Content) -> Verified:
    blocks, states = content.blocks, {"done": [], "to do": [], "bad": []}
    for block in range(len(blocks)):
        states[_state(content, block)].append(block)
    done, to_do, bad = map(tuple, states.values())
    axes = tuple(content.harmed_axes())
    finished = content.finished and len(done) == len(blocks) and not axes
    return Verified(done, to_do, bad, finished, axes)


def _state(content: Content, block: int) -> str:
    """State of a block: done, to do or bad."""
    place = content.blocks.slices(block)
    try:
        row = np.asarray(content.rows[block])
        if row[STATE] == TO_DO and not content.finished:
            return "to do"
        parts = {name: np.asarray(array[place]) for name, array in content.arrays.items()}
        right = row[STATE] == DONE and checksum(parts.values()) == row[CHECKSUM]
        for name, array in content.shown.items() if content.finished else ():
            numbers = {int(k): v for k, v in content.ledger.attrs[f"{name}_numbers"].items()}
            shown = np.asarray(array[place])
            right = right and np.array_equal(renumber(parts[name], numbers), shown)
        return "done" if right else "bad"
    except Exception:  # whatever a codec raises for bytes that are not its own
        return "bad"
