"""How a curve of bifurcation points goes on where the signature changes: `beyond_change`."""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..model.oscillator import has_clock
from ..model.variations import Variation
from .base import AbstractCondition, BifurcationPoint
from .refine import points_within
from .special import FAR, SpecialPoint, is_elsewhere
from .tracks import Track

#: How far from a change of signature the curve is searched for, in steps: it may bend sharply, or
#: end near there.
BESIDE_CHANGE = (0.5, 0.1, 0.02)
#: What is no farther from the chords between rows is on the curve, in steps: neighbouring tangents
#: differ by 18 degrees at most.
ON_CHORD = 0.05


class CurveProblem(NamedTuple):
    """What is followed: condition, among oscillators of a variation; within limits, [2, 2]."""

    condition: AbstractCondition
    variation: Variation
    limits: np.ndarray
    step: float
    max_points: int

    def contains(self, point: SpecialPoint) -> bool:
        """Whether a point is in the span, up to rounding."""
        slack = 1e-12 * np.ptp(self.limits, axis=1)
        low, high = self.limits.T
        return bool(np.all((low - slack <= point.values) & (point.values <= high + slack)))


class CurveRow(NamedTuple):
    """A row of a curve, see `BifurcationCurve`."""

    values: np.ndarray
    kind: type[AbstractCondition]
    multiplier: float
    residual: float
    place: np.ndarray


def beyond_change(
    problem: CurveProblem,
    track: Track,
    rows: list[CurveRow],
    last: np.ndarray,
    centre: np.ndarray,
) -> tuple[BifurcationPoint, np.ndarray] | None:
    """The point of the same condition just beyond a change of signature, and where, or None.

    It has to be the same cycle, at about the same place. The curve may have a corner there, so the
    search goes all around the change, except where the curve came from.
    """
    found = (
        _near_change(problem, track, rows, last, centre, part * problem.step)
        for part in BESIDE_CHANGE
    )
    return next((one for one in found if one is not None), None)


def _near_change(
    problem: CurveProblem,
    track: Track,
    rows: list[CurveRow],
    last: np.ndarray,
    centre: np.ndarray,
    reach: float,
) -> tuple[BifurcationPoint, np.ndarray] | None:
    """See `beyond_change`; reach: the distance from the change along one of the parameters."""
    condition, before, place = problem.condition, last[-2:], track.place(last)
    known = problem.variation.oscillator(before), track.system, track.unknowns(last)
    came_from = (before - centre) / max(float(np.linalg.norm(before - centre)), 1e-12)

    def direct(held: Variation, near: float) -> Iterator[BifurcationPoint | None]:
        for offset in (-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0):
            yield condition.named_point_beside(held, near + offset * reach, *known)

    def searched(held: Variation, near: float) -> Iterator[BifurcationPoint | None]:
        # Where the motion is there only just beside the curve, guesses miss it.
        if not has_clock(known[0]):
            yield from points_within(condition, held, near, 2 * reach)

    found: list[tuple[float, BifurcationPoint, np.ndarray]] = []
    for way, free, side in itertools.product((direct, searched), (0, 1), (1.0, -1.0)):
        if found and way is searched:
            break
        values = centre + side * reach * np.eye(2)[1 - free]
        held = problem.variation.held(1 - free, float(values[1 - free]))
        for point in way(held, float(values[free])):
            if point is None or is_elsewhere(point.place, place, FAR):
                continue
            if point.condition.lineage != condition.lineage:
                continue
            at = values.copy()
            at[free] = float(point.value)
            inside = np.all((problem.limits[:, 0] <= at) & (at <= problem.limits[:, 1]))
            away = at - centre
            distance = float(np.linalg.norm(away))
            if inside and 0 < distance < 6 * reach and (away / distance) @ came_from < 0.7:
                found.append((distance, point, at))
    curve = np.array([row.values for row in rows]), np.array([row.place for row in rows])
    for _, point, at in sorted(found, key=lambda one: one[0]):
        system, _ = point.condition.applied_to(point.oscillator).system_at(point)
        passed = is_on_rows(at, point.place, *curve, ON_CHORD * problem.step)
        if not passed and not track.system.has_signature_of(system):
            return point, at
    return None


def is_on_rows(
    at: np.ndarray, place: np.ndarray, values: np.ndarray, places: np.ndarray, near: float
) -> bool:
    """Whether a point is nearer than that to a curve, and its motion about the same as there.

    at, place: of the point, [2] and [5]; values, places: of the rows of the curve, [rows, ..].
    """
    away, part = from_chords(at, values)
    between = places[:-1] + part[:, None] * np.diff(places, axis=0)
    return any(
        not is_elsewhere(place, between[i], FAR) for i in np.flatnonzero(away < near).tolist()
    )


def from_chords(at: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of a point from each chord of a path, and the part of the chord where it is,
    [chords]."""
    a, chord = path[:-1], np.diff(path, axis=0)
    along = np.sum((at - a) * chord, axis=1) / np.maximum(np.sum(chord**2, axis=1), 1e-300)
    along = np.clip(along, 0, 1)
    return np.hypot(*(at - a - along[:, None] * chord).T), along
