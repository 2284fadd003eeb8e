"""Orbits of forced oscillators, followed period by period: `arcs_over`."""

import itertools
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ..model.modes import BELOW, mode_of, stick_velocity
from ..model.oscillator import Oscillator, at_time
from ..motion.arcs import Ends
from ..motion.simulate import simulate
from .chains import Loop, padded_loop
from .clocked import forcing_period

#: Number of periods followed in one run, and the largest number that a motion may have.
PERIODS_AT_ONCE = 32


class Followed(NamedTuple):
    """An orbit that was followed over whole periods, in NumPy.

    codes, ends, entries (x1, x2, t), durations: of its arcs, as in a `Loop`; starts: the states
    where periods begin, [periods + 1, 2]; status: of the run.
    """

    codes: np.ndarray
    ends: np.ndarray
    entries: np.ndarray
    durations: np.ndarray
    starts: np.ndarray
    status: int

    def last(self, periods: int) -> "Followed":
        """Its last periods, `periods` in number."""
        cuts = np.flatnonzero(self.ends == Ends(self.codes.shape[-1]).period)
        first = 0 if periods >= len(cuts) else cuts[-periods - 1] + 1
        return self._cut(slice(first, None), slice(-periods - 1, None))

    def first(self, periods: int) -> "Followed":
        """Its first periods, `periods` in number."""
        cuts = np.flatnonzero(self.ends == Ends(self.codes.shape[-1]).period)
        return self._cut(slice(cuts[periods - 1] + 1), slice(periods + 1))

    def _cut(self, arcs: slice, starts: slice) -> "Followed":
        parts = [one[arcs] for one in self[:4]]
        return self._make([*parts, self.starts[starts], self.status])

    def loop(self) -> Loop:
        """Its arcs as a loop, see `padded_loop`."""
        return padded_loop(self.codes, self.ends, self.entries, self.durations)


def arcs_over(osc: Oscillator, y0: Any, turns: int, share: float = 0.0) -> Followed:
    """The orbit from y0 at the phase 0 over PERIODS_AT_ONCE periods, or fewer where the run fails.

    osc: concrete, in its own units. share: fraction of a period at which y0 is, in place of 0.
    """
    period = float(forcing_period(osc, turns))
    cuts = period * (np.arange(1, PERIODS_AT_ONCE + 1) + share)
    run = simulate(osc, y0, cuts[-1], t0=period * share, ts=cuts)
    arcs, states = run.arcs, np.asarray(run.ys)
    modes, times = np.asarray(arcs.mode, float), np.asarray(arcs.t)
    entries = np.column_stack([np.asarray(arcs.y), times])
    reached = int(np.sum(np.all(np.isfinite(states), axis=1)))
    # Successive arcs of one mode are merged, and arcs are cut at the ends of periods.
    begins = np.flatnonzero(np.any(np.diff(modes, axis=0, prepend=np.nan) != 0, axis=1))
    names = Ends(modes.shape[1])
    rows = [(entries[i, 2], 0, entries[i], modes[i]) for i in begins.tolist()]
    for k in range(reached):
        inside = modes[begins[np.searchsorted(times[begins], cuts[k], side="right") - 1]]
        rows.append((cuts[k], 1, np.append(states[k], cuts[k]), inside))
    rows.sort(key=lambda row: row[:2])
    last = next(i for i in reversed(range(len(rows))) if rows[i][1]) if reached else 0
    rows = rows[: last + 1]
    begun = np.cumsum([row[1] for row in rows])
    found = [row[2] - np.array([0.0, 0.0, period * k]) for row, k in zip(rows, begun)]
    for place, row in enumerate(rows):
        if row[1]:
            found[place][2] = period * share
    lengths = np.diff([row[0] for row in rows])
    codes = np.array([row[3] for row in rows])
    ends = [
        names.period if then[1] else _end_between(names, now[3], then[3])
        for now, then in itertools.pairwise(rows)
    ]
    starts = np.concatenate([[np.asarray(y0, float)], states[:reached]])
    columns = codes[:-1], np.array(ends, int), np.array(found)[:-1], lengths
    return Followed(*columns, starts, int(run.status))


def _end_between(names: Ends, before: np.ndarray, after: np.ndarray) -> int:
    """The number in `Ends` of the event between two arcs, from the contact codes of both."""
    n = len(before)
    apart = np.abs(before) > 1, np.abs(after) > 1
    for i in np.flatnonzero(apart[0] != apart[1]).tolist():
        return n + i if BELOW in (before[i], after[i]) else 2 * n + i
    for changed in ((before != 0) & (after == 0), before * after == -1):
        if np.any(changed):
            return int(np.argmax(changed))
    return names.onset


def after_period(osc: Oscillator, followed: Followed) -> np.ndarray:
    """The last state, to continue from; x2 is exactly the velocity of a belt that it sticks to."""
    x1, x2 = followed.starts[-1].tolist()
    mode = mode_of(jnp.asarray(followed.codes[-1]))
    began = at_time(osc, jnp.asarray(followed.entries[0, 2]))
    velocity = stick_velocity(began, mode, osc.omega * x2)
    return np.array([x1, float(velocity / osc.omega)])
