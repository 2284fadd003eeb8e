"""Ends of curves of forced oscillators in points where two conditions hold: `meeting_point`.

The curve of a multiplier ends where the signature of its motion does, and a curve of a motion that
has left another one in a period doubling ends where its two halves come together. There the motion
ceases to exist, or its equations are singular. The equations of the other curve through that point
are regular, and the condition on a multiplier is one of the functions watched along it.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ..cycles.clocked import turns_of
from ..cycles.periodic import PeriodicMotion, motion_between_halves
from ..model.events import of_one_loop
from ..model.oscillator import Oscillator
from ..numerics.continuation import continue_curve
from ..numerics.newton import HOLDS
from ..results import Status
from .base import AbstractCondition, BifurcationPoint
from .crossings import CrossingSliding
from .edges import CornerCollision, GrazingEdge
from .forced import (
    AbstractForcedCondition,
    AddingSliding,
    PeriodDoubling,
    SwitchingSliding,
    UnitCircle,
)
from .forced_edges import edged_belts
from .special import FAR, SpecialPoint, Trail, is_elsewhere
from .tangencies import GrazingSliding
from .timed_systems import place_of_motion
from .tracks import Track, special_between

#: Largest distance of a meeting point from the last row, in steps of the curve.
REACH = 3
#: Number of points of the other curve that are computed to each side.
POINTS_TO_A_SIDE = 5


def borders_of(osc: Oscillator) -> list[AbstractCondition]:
    """The conditions at whose points the signature of a forced motion ends."""
    kinds = GrazingSliding, CrossingSliding, SwitchingSliding, AddingSliding
    sliding = [kind(belt) for kind in kinds for belt in range(len(osc.belts))]
    of_edges = [kind(belt) for kind in (GrazingEdge, CornerCollision) for belt in edged_belts(osc)]
    return [*sliding, *of_edges]


def meeting_point(condition: AbstractCondition, trail: Trail) -> SpecialPoint | None:
    """The point in which a curve ends where it meets another one, if it is near the last row; None
    without forcing."""
    if not isinstance(condition, AbstractForcedCondition):
        return None
    osc = trail.variation.oscillator(trail.values[-1])
    motion = trail.system.motion(osc, trail.x)
    found = []
    if isinstance(condition, UnitCircle):
        for border in borders_of(osc):
            kind = type(condition).__name__
            for point in _zeros_along(trail, border.with_clock(), motion, kind):
                named = point._replace(kind=type(border).__name__, belts=border.belts_concerned)
                found.append(named)
    between = motion_between_halves(osc, motion, turns_of(osc))
    if between is not None:
        found += _zeros_along(trail, condition, between, PeriodDoubling.__name__)
    return min(found, key=lambda point: _from_last_row(trail, point.values), default=None)


def border_at(
    condition: AbstractCondition,
    trail: Trail,
    beyond: BifurcationPoint,
    centre: np.ndarray,
    error: float,
) -> list[SpecialPoint]:
    """The border that a forced motion meets on a curve where its signature changes.

    trail: up to a point beside the change; beyond: the point with which the curve goes on; centre,
    error: place of the change, and how well it is known.
    """
    if not isinstance(condition, AbstractForcedCondition):
        return []
    osc = trail.variation.oscillator(trail.values[-1])
    motion = trail.system.motion(osc, trail.x)
    if of_one_loop(motion.signature) == of_one_loop(beyond.cycle.signature):
        return []  # only the first event differs: one passes the phase 0
    distances = {}
    for border in borders_of(osc):
        timed = border.with_clock()
        if timed.lineage != condition.lineage:
            some = timed.beginnings_of(osc, motion)
            distances[border] = min((float(one.distance) for one in some), default=np.inf)
    # A condition that holds here already, some part of a step before, holds all along the curve.
    near = [border for border, away in distances.items() if HOLDS < away <= trail.step]
    if not near:
        return []
    border = min(near, key=lambda one: distances[one])
    values = float(centre[0]), float(centre[1])
    return [SpecialPoint(type(border).__name__, border.belts_concerned, values, error)]


def _zeros_along(
    trail: Trail, condition: AbstractForcedCondition, motion: PeriodicMotion, kind: str
) -> Iterator[SpecialPoint]:
    """Special points of a kind, near the last row, on the curves of a condition through the points
    that are found from a motion, where the motion is about the same."""
    anywhere, place = np.array([[-np.inf, np.inf]] * 2), place_of_motion(motion)
    for point, values in _points_near(trail, condition, motion):
        track, u = Track.begun(trail.variation, point, values)
        if is_elsewhere(track.place(u), place, FAR):
            continue
        direction = track.tangent(u)
        for sign in (1.0, -1.0):
            points = continue_curve(
                track.corrected,
                u,
                sign * direction,
                step=trail.step,
                min_step=1e-2 * trail.step,
                max_step=trail.step,
                max_points=POINTS_TO_A_SIDE,
            )
            seen = ((at, track.seen_at(at.u)) for at in points)
            for before, after in pairwise(seen):
                for special in special_between(track, anywhere, before, after):
                    if special.kind == kind and _is_near(trail, special.values):
                        yield special


def _points_near(
    trail: Trail, condition: AbstractForcedCondition, motion: PeriodicMotion
) -> Iterator[tuple[BifurcationPoint, np.ndarray]]:
    """A point of a condition with one parameter as in the last row, and both its parameters."""
    last = trail.values[-1]
    for free in (0, 1):
        along = trail.variation.held(1 - free, float(last[1 - free]))
        for point in condition.points(along, last[free : free + 1], motion):
            values = last.copy()
            values[free] = float(point.value)
            if int(point.status) == Status.OK and _is_near(trail, values):
                yield replace(point, condition=condition), values
                return


def _is_near(trail: Trail, values) -> bool:
    return _from_last_row(trail, values) < REACH * trail.step


def _from_last_row(trail: Trail, values) -> float:
    return float(np.linalg.norm(np.asarray(values) - trail.values[-1]))
