"""The arcs of a known motion on the host, where they are cut, joined and given other ends."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..cycles.chains import Loop, padded_loop
from ..cycles.periodic import PeriodicMotion
from ..motion.arcs import Ends


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

    def begun_at(
        self, phase: float, states: np.ndarray, period: float
    ) -> tuple["ArcRows", dict[int, int]]:
        """The arcs of the same motion, which begin at another phase, a fraction of a period; and
        the new rows of those that end in an event.

        states: those in which the arcs pass that phase, [arcs, 2], NaN of arcs that do not.
        """
        begins, whole = np.cumsum(self.z[:, 3]) - self.z[:, 3], np.sum(self.z[:, 3])
        end = Ends(self.codes.shape[1]).period
        first = 0.0 if self.share is None else float(self.share)
        t = period * (phase + (phase < first))
        # Passages of the phase, and events: time, state and codes from there on, end, row.
        passages = [
            (begins[i] + t - self.z[i, 2], states[i], self.codes[i], end, i)
            for i in np.flatnonzero(np.isfinite(states[:, 0])).tolist()
        ]
        events = [
            (begins[i] + self.z[i, 3], self.z[then, :2], self.codes[then], self.ends[i], i)
            for i in np.flatnonzero(self.ends != end).tolist()
            for then in [(i + 1) % len(self.ends)]
        ]
        start = min(one[0] for one in passages)
        order: list[tuple[Any, ...]] = [
            ((one[0] - start) % whole, *one[1:]) for one in (*passages, *events)
        ]
        order.sort(key=lambda one: one[0])
        rows, places, since = [], {}, 0.0
        for place, (at, state, codes, kind, _) in enumerate(order):
            then, _, _, ended_by, row = order[(place + 1) % len(order)]
            since = at if kind == end else since
            rows.append(
                (codes, ended_by, [*state, phase * period + at - since, (then - at) % whole])
            )
            if ended_by != end:
                places[row] = place
        parts = [np.array(list(column)) for column in zip(*rows, strict=True)]
        return ArcRows(*parts, share=jnp.asarray(phase)), places

    def loop(self) -> Loop:
        return padded_loop(self.codes, self.ends, self.z[:, :3], self.z[:, 3])
