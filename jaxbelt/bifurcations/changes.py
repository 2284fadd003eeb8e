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
BESIDE_CHANGE = (0.02, 0.1, 0.5)
#: Directions in which it is searched for, in degrees from straight on: it may have a corner there.
TURNS = (0, 15, -15, 30, -30, 50, -50, 75, -75, 105, -105, 135, -135)
#: A curve goes back where it came from within 45 degrees.
BACK = 0.7
#: Arcs are the same ones if their durations change by less than this part of them all.
ALIKE_DURATIONS = 0.1
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
    way: np.ndarray,
) -> tuple[BifurcationPoint, np.ndarray] | None:
    """The point of the same condition just beyond a change of signature, and both its parameters.

    None if there is none. It has to be the same cycle, at about the same place. The curve may have
    a corner at the change, so the search goes all around it, except where the curve came from.

    Args:
        problem: The curve.
        track: The track up to the change.
        rows: The rows so far.
        last: The unknowns at the last of them.
        centre: Both parameters at the change.
        way: Direction of the curve there, [2], where `last` is at the change itself.
    """
    change = _SignatureChange(problem, track, rows, last, centre, way)
    reaches = [part * problem.step for part in BESIDE_CHANGE]
    # Where the motion exists only close to the curve, guesses miss it. A curve that goes on crosses
    # a side of the largest square around the change.
    ways = [*((change.from_guesses, reach) for reach in reaches), (change.from_search, reaches[-1])]
    found = (change.nearest(find(reach), reach) for find, reach in ways)
    return next((one for one in found if one is not None), None)


class _Beside(NamedTuple):
    """A point beside a change: with the parameter `held` at its value in `guess`, both of them."""

    point: BifurcationPoint
    held: int
    guess: np.ndarray

    @property
    def values(self) -> np.ndarray:
        """Both parameters, [2]."""
        at = self.guess.copy()
        at[1 - self.held] = float(self.point.value)
        return at


class _SignatureChange(NamedTuple):
    """A change of signature; the fields are the arguments of `beyond_change`."""

    problem: CurveProblem
    track: Track
    rows: list[CurveRow]
    last: np.ndarray
    centre: np.ndarray
    way: np.ndarray

    def from_guesses(self, reach: float) -> Iterator[_Beside]:
        """Points of the condition that are found from guesses at the distance `reach`."""
        condition, variation = self.problem.condition, self.problem.variation
        known = variation.oscillator(self.last[-2:]), self.track.system
        unknowns, back = self.track.unknowns(self.last), self._back()
        straight = np.arctan2(*(-back if back.any() else self.way)[::-1])
        for turn in straight + np.deg2rad(TURNS):
            away = np.array([np.cos(turn), np.sin(turn)])
            held = int(np.argmax(np.abs(away)))
            guess = self.centre + reach * away / abs(away[held])
            along = variation.held(held, float(guess[held]))
            point = condition.named_point_beside(along, float(guess[1 - held]), *known, unknowns)
            if point is not None:
                yield _Beside(point, held, guess)

    def from_search(self, reach: float) -> Iterator[_Beside]:
        """Points of the condition that the search of `scan` finds on the sides of a square around
        the change, at the distance `reach`; none of states of rest and with forcing."""
        condition, variation = self.problem.condition, self.problem.variation
        forced = has_clock(variation.oscillator(self.last[-2:]))
        if forced or isinstance(self.track.system, RestSystem):
            return
        for held, side in itertools.product((1, 0), (1.0, -1.0)):
            middle = self.centre + side * reach * np.eye(2)[held]
            along = variation.held(held, float(middle[held]))
            for point in points_within(condition, along, float(middle[1 - held]), 2 * reach):
                yield _Beside(point, held, middle)

    def nearest(
        self, some: Iterable[_Beside], reach: float
    ) -> tuple[BifurcationPoint, np.ndarray] | None:
        """The nearest of some points that are on the curve beyond the change, and its parameters;
        reach: about their distance."""
        fits = [(one.values, one.point) for one in some if self._is_beyond(one, reach)]
        fits.sort(key=lambda one: float(np.linalg.norm(one[0] - self.centre)))
        return next(((point, at) for at, point in fits if self._is_new(point, at)), None)

    def _back(self) -> np.ndarray:
        """The direction from which the curve came, [2]; 0 where `last` is at the change."""
        before = self.last[-2:] - self.centre
        return before / max(float(np.linalg.norm(before)), 1e-12)

    def _is_beyond(self, one: _Beside, reach: float) -> bool:
        """Whether a point is of the same kind of cycle, near, and not where the curve came from."""
        (low, high), at = self.problem.limits.T, one.values
        away = at - self.centre
        distance = float(np.linalg.norm(away))
        if not np.all((low <= at) & (at <= high)) or not 0 < distance < 6 * reach:
            return False
        if (away / distance) @ self._back() >= BACK:
            return False
        is_alike = one.point.condition.lineage == self.problem.condition.lineage
        return is_alike and not is_elsewhere(one.point.place, self.track.place(self.last), FAR)

    def _is_new(self, point: BifurcationPoint, at: np.ndarray) -> bool:
        """Whether a point is not on the curve so far, and its motion has another signature."""
        curve = [
            np.stack(column) for column in zip(*((row.values, row.place) for row in self.rows))
        ]
        passed = is_on_rows(at, point.place, curve[0], curve[1], ON_CHORD * self.problem.step)
        system, x = point.condition.applied_to(point.oscillator).system_at(point)
        is_same = self.track.system.has_signature_of(system)
        return not passed and not (is_same and self._begins_alike(np.asarray(x)))

    def _begins_alike(self, x: np.ndarray) -> bool:
        """Whether the arcs of a motion with the same signature, unknowns x, are those before the
        change. With forcing its only event may have passed the phase 0, where the arcs begin."""
        if not has_clock(self.problem.variation.oscillator(self.last[-2:])):
            return True
        durations, before = x[:, 3], np.asarray(self.track.unknowns(self.last))[:, 3]
        return bool(np.max(np.abs(durations - before)) < ALIKE_DURATIONS * np.sum(before))


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
