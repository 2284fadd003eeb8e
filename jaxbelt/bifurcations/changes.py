"""Where the motion of a curve of bifurcation points ceases to exist: `where_it_ends`; and how the
curve goes on where only its signature changes: `beyond_change`."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..model.oscillator import has_clock
from ..model.variations import Variation
from ..numerics.continuation import CurvePoint
from .base import AbstractCondition, BifurcationPoint
from .refine import points_within
from .special import FAR, SpecialPoint, is_elsewhere
from .systems import RestSystem, Seen
from .tracks import Track

#: Distances from a change of signature, in steps, at which the curve beyond it is searched for: it
#: may bend sharply, or end near there.
BESIDE_CHANGE = (0.5, 0.1, 0.02)
#: A point is on a curve if it is no farther than this from the chords between rows, in steps:
#: neighbouring tangents differ by 18 degrees at most.
ON_CHORD = 0.05
#: A point of codimension two this near, in steps, is why no step along a curve is short enough.
JUST_AHEAD = 0.02
#: How often the step in which the motion ceases to exist is halved to find where; for a state of
#: rest, which costs no integration, to rounding.
HALVINGS_TO_END, HALVINGS_TO_END_OF_REST = 10, 50
#: Largest distance of a point from the same one found with other arcs.
SAME_POINT_AGAIN = 1e-8


class CurveProblem(NamedTuple):
    """A curve to follow: a condition, in the oscillators of a variation, within limits, [2, 2]."""

    condition: AbstractCondition
    variation: Variation
    limits: np.ndarray
    step: float
    max_points: int

    def contains(self, point: SpecialPoint) -> bool:
        """Whether a point is within the limits, up to rounding."""
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


def where_it_ends(track: Track, last: CurvePoint, beyond: CurvePoint) -> tuple[np.ndarray, float]:
    """The unknowns where the motion just exists, between `last` and a point beyond, at which the
    equations may have turned back; and the distance from there at which it exists no longer."""
    length, known, ends = float((beyond.u - last.u) @ last.tangent), 0.0, 1.0
    of_rest = isinstance(track.system, RestSystem)
    for _ in range(HALVINGS_TO_END_OF_REST if of_rest else HALVINGS_TO_END):
        part = 0.5 * (known + ends)
        at = track.corrected(last.u, last.tangent, part * length)
        exists = at.found and track.seen_at(at.u).exists
        known, ends = (part, ends) if exists else (known, part)
    return track.corrected(last.u, last.tangent, known * length).u, (ends - known) * length


def parameters_apart(values: Sequence[float] | np.ndarray, u: np.ndarray) -> float:
    """Distance of both parameters from those in the unknowns u of a curve."""
    return float(np.hypot(*np.subtract(values, u[-2:])))


def just_ahead(seen: list[tuple[CurvePoint, Seen]], step: float) -> list[SpecialPoint]:
    """The point of codimension two just ahead of the last of two points, where a line through the
    values of a watched function vanishes; its residual is its distance from the last point.

    Where an arc begins or ends on an edge its duration goes like a square root, so no step leads
    there.
    """
    if len(seen) < 2:
        return []
    (before, was), (last, now) = seen
    found = []
    for name, value in now.tests.items():
        change = was.tests.get(name, np.nan) - value
        part = value / change if change else np.inf
        away = part * np.linalg.norm((last.u - before.u)[-2:])
        if 0 < part and away < JUST_AHEAD * step:
            at = last.u[-2:] + part * (last.u - before.u)[-2:]
            found.append(SpecialPoint(*name, (float(at[0]), float(at[1])), float(away)))
    return sorted(found, key=lambda point: point.residual)[:1]


def beyond_change(
    problem: CurveProblem,
    track: Track,
    rows: list[CurveRow],
    last: np.ndarray,
    centre: np.ndarray,
) -> tuple[BifurcationPoint, np.ndarray] | None:
    """The point of the same condition just beyond a change of signature, and both its parameters.

    None if there is none. It has to be the same cycle, at about the same place. The curve may have
    a corner at the change, so the search goes all around it, except where the curve came from.
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
        # Where the motion exists only close to the curve, the direct guesses miss it. For a state
        # of rest there are no other guesses.
        if not has_clock(known[0]) and not isinstance(track.system, RestSystem):
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
    """Whether a point is nearer than `near` to a curve, and its motion about the same as there.

    at, place: of the point, [2] and [5]; values, places: of the rows of the curve, [rows, ..].
    """
    away, part = from_chords(at, values)
    between = places[:-1] + part[:, None] * np.diff(places, axis=0)
    return any(
        not is_elsewhere(place, between[i], FAR) for i in np.flatnonzero(away < near).tolist()
    )


def from_chords(at: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of a point from each chord of a path, and the nearest place on the chord as a part
    of it, [chords]."""
    a, chord = path[:-1], np.diff(path, axis=0)
    along = np.sum((at - a) * chord, axis=1) / np.maximum(np.sum(chord**2, axis=1), 1e-300)
    along = np.clip(along, 0, 1)
    return np.hypot(*(at - a - along[:, None] * chord).T), along


def named_once(points: Iterable[SpecialPoint]) -> list[SpecialPoint]:
    """The points without repetitions, which occur where a curve begins at its end."""
    found: list[SpecialPoint] = []
    for one in points:
        alike = [x for x in found if (x.kind, x.belts) == (one.kind, one.belts)]
        if all(np.hypot(*np.subtract(one.values, x.values)) > SAME_POINT_AGAIN for x in alike):
            found.append(one)
    return found
