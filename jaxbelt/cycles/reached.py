"""The periodic motion to which a start of a forced oscillator leads: what `find_cycle` finds.

An orbit is followed for many periods of the forcing. Where its state nearly repeats after some of
them, `periodic` solves for a motion, which is the answer if it is stable and attracts the orbit.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array

from ..checks import require_outside_of_jit
from ..model.oscillator import Oscillator
from ..results import Status
from .followed import PERIODS_AT_ONCE, Followed, after_period, arcs_over
from .periodic import (
    IN_TRACES,
    PeriodicMotion,
    differentiable_motion,
    is_same_motion,
    monodromy_of,
    nothing_found,
    of_least_periods,
    solved_from,
)

#: Number of runs after which the search ends for an orbit that slowly approaches a periodic motion,
#: and for one that approaches none.
MOST_SLOW, MOST_RESTLESS = 256, 32
#: Relative differences of states n periods apart: below NEARLY_BACK a periodic motion is tried at
#: once, below HARDLY_BACK now and then; after a failure again where NEARER times the difference.
NEARLY_BACK, HARDLY_BACK, NEARER = 1e-6, 1e-2, 0.1
#: An orbit within NEAR_MOTION of a stable motion, relative to its size, converges to it; farther
#: away `_draws_in` decides, up to a condition number MOST_SKEW of the motion's eigenvectors.
NEAR_MOTION, MOST_SKEW = 1e-5, 1e6


def attracted(osc: Oscillator, y0: Any, turns: int) -> PeriodicMotion:
    """The periodic motion that a start leads to, for a concrete oscillator in its own units."""
    y, due = np.asarray(y0, float), 1
    failed: dict[int, float] = {}
    for run in range(1, MOST_SLOW + 1):
        followed = arcs_over(osc, y, turns)
        rests = followed.status == Status.PSEUDO_FOCUS
        if rests or len(followed.starts) <= PERIODS_AT_ONCE:
            return nothing_found(osc, turns, followed.status or Status.NOT_FINITE.value)
        nearly = _nearly_back(followed.starts)
        # Slow approaches are tried at runs 1, 2, 4, ...; close ones at once, then ten times closer.
        is_due = run == due
        due *= 1 + is_due
        for periods, away in nearly.items():
            if not is_due and away > min(NEARLY_BACK, NEARER * failed.get(periods, np.inf)):
                continue
            found = _reached(osc, followed, periods, turns)
            if found is not None:
                return of_least_periods(osc, found, turns)
            failed[periods] = away
        if run >= MOST_RESTLESS and not nearly:
            break
        y = after_period(osc, followed)
    return nothing_found(osc, turns, Status.NOT_SETTLED)


def _nearly_back(starts: np.ndarray) -> dict[int, float]:
    """Numbers of periods after which the state nearly repeats, ever more closely, with its change
    relative to the size of the orbit. A larger number has to halve the change, at least."""
    size = 1 + np.max(np.abs(starts))
    found, nearest = {}, HARDLY_BACK
    for periods in range(1, PERIODS_AT_ONCE // 2 + 1):
        away, before = (
            np.max(np.abs(starts[-1 - k * periods] - starts[-1 - (k + 1) * periods])) / size
            for k in range(2)
        )
        if away < nearest and away <= max(before, NEARLY_BACK):
            found[periods], nearest = away, 0.5 * away
    return found


def _reached(
    osc: Oscillator, followed: Followed, periods: int, turns: int
) -> PeriodicMotion | None:
    """The stable motion to which an orbit leads that nearly repeats after these periods, or the
    motion of a continuum on which the orbit is; None if there is neither."""
    motion = solved_from(osc, followed.last(periods).loop(), turns)
    if int(motion.status) == Status.NEUTRAL:
        return motion
    if int(motion.status) != Status.OK or not bool(motion.stable):
        return None
    off = followed.starts[-1 - periods] - np.asarray(motion.start)
    near = np.max(np.abs(off)) < NEAR_MOTION * (1 + np.max(np.abs(followed.starts)))
    return motion if near or _draws_in(osc, motion, off, turns) else None


def _draws_in(osc: Oscillator, motion: PeriodicMotion, off: np.ndarray, turns: int) -> bool:
    """Whether a stable motion attracts the states as far from it as one that differs by `off`, [2].

    In the basis of the eigenvectors of its monodromy matrix a small difference turns and shrinks,
    or shrinks along each axis. So the way from that state to the motion stays in an ellipse, or in
    a rectangle. Orbits from its rim have to pass the events of the motion, and to approach it.
    """
    values, vectors = np.linalg.eig(np.asarray(monodromy_of(osc, motion.chain, motion.unknowns)))
    turning = np.iscomplexobj(values)
    basis = vectors
    if turning:
        basis = np.column_stack([np.real(vectors[:, 0]), np.imag(vectors[:, 0])])
    if not np.linalg.cond(basis) < MOST_SKEW:
        return False
    inside = np.linalg.inv(basis)
    size = np.hypot(*(inside @ off)) if turning else np.abs(inside @ off)
    chain, periods = motion.chain, motion.periods
    used = np.asarray(chain.used)
    times = PERIODS_AT_ONCE // periods
    codes = np.tile(np.asarray(chain.codes)[used], (times, 1))
    ends = np.tile(np.asarray(chain.ends)[used], times)
    for rim in _RIM:
        scaled = rim / np.hypot(*rim) if turning else rim
        begun = scaled * size
        orbit = arcs_over(osc, np.asarray(motion.start) + basis @ begun, turns)
        if len(orbit.starts) <= times * periods:
            return False
        orbit = orbit.first(times * periods)
        left = inside @ (orbit.starts[-1] - np.asarray(motion.start))
        same = np.array_equal(orbit.codes, codes) and np.array_equal(orbit.ends, ends)
        if not same or np.hypot(*left) > np.hypot(*begun) + NEARLY_BACK * np.hypot(*off):
            return False
    return True


#: Places on the rim of a square: its corners and the middles of its sides.
_RIM = np.array([[i, j] for i in (-1.0, 0.0, 1.0) for j in (-1.0, 0.0, 1.0) if (i, j) != (0, 0)])


def motion_reached(osc: Oscillator, y0: Array) -> PeriodicMotion:
    """What `find_cycle` returns for an oscillator with a clock."""
    require_outside_of_jit("find_cycle", IN_TRACES, osc=osc, y0=y0)
    return differentiable_motion(osc, y0, attracted)


def motions_of(osc: Oscillator, starts: Sequence[Any], turns: int) -> list[PeriodicMotion]:
    """The different periodic motions to which some starts lead."""
    found: list[PeriodicMotion] = []
    for start in starts:
        motion = attracted(osc, start, turns)
        if int(motion.status) == Status.OK and not any(
            is_same_motion(motion, one) for one in found
        ):
            found.append(motion)
    return found
