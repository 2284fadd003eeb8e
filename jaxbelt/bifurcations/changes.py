"""Where the motion of a curve of bifurcation points ceases to exist: `where_it_ends`; and how the
curve goes on where only its signature changes: `beyond_change`, or where an event passes the phase
at which its arcs begin: `begun_off_events_at`."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..cycles.clocked import forcing_period, timed_chain_of
from ..cycles.periodic import passing_states, phase_off_events
from ..model.oscillator import has_clock
from ..model.variations import Variation
from ..motion.arcs import Ends
from ..numerics.continuation import CurvePoint, continue_curve
from .arc_rows import ArcRows
from .base import AbstractCondition, BifurcationPoint
from .refine import points_within
from .special import FAR, SpecialPoint, is_elsewhere
from .systems import RestSystem, Seen
from .timed_systems import TimedSystem
from .tracks import Track

#: Distances from a change of signature, in steps, at which the curve beyond it is searched for: it
#: may bend sharply, or end near there.
BESIDE_CHANGE = (0.5, 0.1, 0.02)
#: Directions in which it is searched for, in degrees from straight on: it may have a corner there.
TURNS = (0, 15, -15, 30, -30, 50, -50, 75, -75, 105, -105, 135, -135)
#: Cosine of the angle, 45 degrees, to where the curve came from, below which a point is on its way
#: back.
BACK = 0.7
#: A point is on the curve behind a change if its own curve comes as near to the change as this, in
#: steps, on a way that is followed in parts of the distance.
AT_CHANGE, PARTS_TO_CHANGE, MOST_PARTS = 0.03, 4, 40
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


def begun_off_events_at(
    track: Track, last: CurvePoint, beyond: CurvePoint
) -> tuple[Track, np.ndarray, np.ndarray] | None:
    """The track with arcs that begin off all events, if an event passes the phase at which they
    begin between two of its points; u at the first one, and the direction from there on.

    None where something else happens between them.
    """
    system, osc = track.system, track.variation.oscillator(last.u[-2:])
    if not isinstance(system, TimedSystem):
        return None
    used, end = np.asarray(system.chain.used), Ends(len(osc.belts)).period
    is_end = np.asarray(system.chain.ends)[used] == end
    gone = track.unknowns(beyond.u)[used, 3] < 0
    if not gone.any() or not np.all((is_end | np.roll(is_end, 1))[gone]):
        return None
    motion = system.motion(osc, track.unknowns(last.u))
    phase = phase_off_events(osc, motion)
    if phase is None:
        return None
    states = np.asarray(passing_states(osc, system.chain, motion.unknowns, jnp.asarray(phase)))
    period, turns = float(forcing_period(osc, system.chain.turns)), system.chain.turns
    rows, places = ArcRows.of(motion).begun_at(phase, states[used], period)
    chain, z = timed_chain_of(osc, rows.loop(), turns, rows.share)
    system = eqx.tree_at(lambda s: s.chain, system, chain)
    if hasattr(system, "row"):
        row = jnp.asarray(places[int(system.row)], dtype=jnp.asarray(system.row).dtype)
        system = eqx.tree_at(lambda s: s.row, system, row)
    begun, u = Track.of_system(track.variation, system.refined(osc, z), z, last.u[-2:])
    way = begun.tangent(u)
    return begun, u, way * np.sign(way[-2:] @ last.tangent[-2:])


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


def begun_again(
    problem: CurveProblem, track: Track, at: CurvePoint
) -> tuple[Track, np.ndarray, np.ndarray] | None:
    """The track that follows the same curve with the arcs that the motion has at a point, u there,
    and the direction; None where the point is not found with these arcs."""
    osc, values, way = problem.variation.oscillator(at.u[-2:]), at.u[-2:], at.tangent[-2:]
    held = int(np.argmax(np.abs(way)))
    along = problem.variation.held(held, float(values[held]))
    known = osc, track.system, track.unknowns(at.u)
    point = problem.condition.named_point_beside(along, float(values[1 - held]), *known)
    if point is None or point.condition.lineage != problem.condition.lineage:
        return None
    away = abs(float(point.value) - values[1 - held])
    if away > SAME_POINT_AGAIN or is_elsewhere(point.place, track.place(at.u), FAR):
        return None
    new, u = Track.begun(problem.variation, point, values)
    direction = new.tangent(u)
    return new, u, direction * np.sign(direction[-2:] @ way)


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
    ways = [*((change.from_guesses, reach) for reach in reaches), (change.from_search, reaches[0])]
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
        system, _ = point.condition.applied_to(point.oscillator).system_at(point)
        new = not passed and not self.track.system.has_signature_of(system)
        return new and self._comes_from_change(point, at)

    def _comes_from_change(self, point: BifurcationPoint, at: np.ndarray) -> bool:
        """Whether the curve of a point, followed backwards, comes from the change: others may pass
        by."""
        near = AT_CHANGE * self.problem.step
        distance = float(np.linalg.norm(at - self.centre))
        if distance <= near:
            return True
        track, u = Track.begun(self.problem.variation, point, at)
        way = track.tangent(u)
        step, path, nearest = distance / PARTS_TO_CHANGE, [at], distance
        for one in continue_curve(
            track.corrected,
            u,
            way * np.sign(way[-2:] @ (self.centre - at)),
            step=step,
            min_step=min(1e-3 * self.problem.step, step),
            max_step=step,
            max_points=MOST_PARTS,
        ):
            path.append(one.u[-2:])
            nearest = min(nearest, float(np.min(from_chords(self.centre, np.stack(path[-2:]))[0])))
            if nearest <= near or np.linalg.norm(path[-1] - self.centre) > 2 * distance:
                break
        return nearest <= near


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
