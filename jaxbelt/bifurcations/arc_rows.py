"""The arcs of a known motion on the host, where they are cut, joined and given other ends."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array

from ..cycles.chains import Loop, padded_loop
from ..cycles.periodic import PeriodicMotion


class ArcRows(NamedTuple):
    """The arcs of a known motion, in NumPy: codes, ends, and unknowns [arcs, 4]; share: where in a
    period they begin, see `TimedChain`."""

    codes: np.ndarray
    ends: np.ndarray
    z: np.ndarray
    share: Array | None

    @classmethod
    def of(cls, motion: PeriodicMotion) -> "ArcRows":
        used = np.asarray(motion.chain.used)
        parts = motion.chain.codes, motion.chain.ends, motion.unknowns
        return cls(*(np.asarray(part)[used] for part in parts), share=motion.chain.share)

    def ending(self, row: int, end: int) -> "ArcRows":
        """The same arcs, with another end of the arc of a row."""
        ends = self.ends.copy()
        ends[row] = end
        return self._replace(ends=ends)

    def put(self, first: int, last: int, *rows: tuple[Any, Any, Any]) -> "ArcRows":
        """The arcs with rows (codes, end, unknowns) in place of those from `first` up to `last`."""
        new = [np.array(list(column)) for column in zip(*rows, strict=True)]
        parts = [
            np.concatenate([own[:first], some.astype(own.dtype), own[last + 1 :]])
            for own, some in zip(self[:3], new, strict=True)
        ]
        return ArcRows(*parts, share=self.share)

    def cut(self, row: int, since: float, state: np.ndarray, end: int) -> "ArcRows":
        """The arcs, one cut by `end` at `state`, (x1, x2, t), a time `since` after its entry."""
        codes, z = self.codes[row], self.z[row]
        first = (codes, end, np.append(z[:3], since))
        return self.put(row, row, first, (codes, self.ends[row], np.append(state, z[3] - since)))

    def without(self, row: int, end: int | None) -> "ArcRows":
        """The arcs without the short one of a row: the arc before goes on instead, cut by an end in
        the middle of the short one; None: not cut."""
        last, phase, then = self.z[row - 1 : row + 2]
        codes, half = self.codes[row - 1], 0.5 * phase[3]
        if end is None:
            whole = (codes, self.ends[row + 1], np.append(last[:3], last[3] + phase[3] + then[3]))
            return self.put(row - 1, row + 1, whole)
        middle = phase[:3] + half * np.array([phase[1], 0.0, 1.0])
        first = (codes, end, np.append(last[:3], last[3] + half))
        second = (codes, self.ends[row + 1], np.append(middle, then[3] + half))
        return self.put(row - 1, row + 1, first, second)

    def loop(self) -> Loop:
        return padded_loop(self.codes, self.ends, self.z[:, :3], self.z[:, 3])
