"""The system of equations along a curve of bifurcation points, and the special points on the curve.

A `Track` is the system of a condition with both parameters among its unknowns. Between two points
of the curve a watched function may change its sign: then `special_between` solves for its zero, a
point of codimension two. `special_on` finds zeros that lie exactly on a point of the curve.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..model.families import Family
from ..model.oscillator import Oscillator
from ..model.variations import Variation
from ..numerics.compiling import jit
from ..numerics.continuation import Corrected, CurvePoint, corrected
from .base import BifurcationPoint
from .special import SpecialPoint, extrapolated_to_zero
from .systems import AbstractSystem, Seen

#: How often, at most, the points on both sides of a singular point are moved half of the way to it.
#: Newton's method fails earlier: after four times in the known cases, where two times leave 5e-9.
SHRINKS = 8
#: A watched function that changes its sign where it is larger than this fraction of its values at
#: both ends of the step jumps there, and does not vanish. Zeros of square roots leave 1e-7.
JUMPS = 1e-3
#: A function that is smaller than this at both ends of a step is zero all along it, up to rounding.
ALONG = 1e-12


def corrected_among(
    variation: Variation,
    linearized: Callable,
    args: tuple[Any, ...],
    units: np.ndarray,
    u: ArrayLike,
    tangent: ArrayLike,
    length: float,
) -> Corrected:
    """As `continuation.corrected`, for equations of the oscillators of a variation.

    linearized: called with (family, *args) as its args. units: of the parameters, [k], which are
    the last k of the unknowns u.
    """
    start, normal, k = np.asarray(u), np.asarray(tangent), len(units)

    def attempt(family, unknowns):
        # Every attempt solves in one plane, `length` ahead of the start; later guesses lie in it.
        ahead = length if unknowns[0] is start else 0.0
        solved = corrected(linearized, (family, *args), unknowns[0], normal, ahead)
        return solved, (solved.u, units * solved.u[-k:])

    begun = start, units * (start + length * normal)[-k:]
    solved, agrees = variation.relinearised(attempt, begun)
    return solved._replace(found=solved.found & agrees)


class Track(NamedTuple):
    """The system of a curve, in u: its own unknowns times weights, and both parameters."""

    variation: Variation
    system: AbstractSystem
    weights: Array

    @classmethod
    def begun(
        cls, variation: Variation, point: BifurcationPoint, pair: np.ndarray
    ) -> tuple["Track", np.ndarray]:
        """The track to follow from a point, and u there; pair: both parameters, [2]."""
        system, x = point.condition.applied_to(point.oscillator).system_at(point)
        return cls.of_system(variation, system, x, pair)

    @classmethod
    def of_system(
        cls, variation: Variation, system: AbstractSystem, x: ArrayLike, pair: np.ndarray
    ) -> tuple["Track", np.ndarray]:
        """The track of a system with the unknowns x, and u there; pair: both parameters, [2]."""
        weights = system.weights(jnp.asarray(x))
        u = np.append(np.asarray(weights) * np.asarray(x).reshape(-1), pair)
        return cls(variation, system, weights), u

    def corrected(self, u: ArrayLike, tangent: ArrayLike, length: float) -> Corrected:
        """As `continuation.corrected`."""
        given = _curve_linearized, (self.system, self.weights), np.ones(2)
        return corrected_among(self.variation, *given, u, tangent, length)

    def unknowns(self, u: np.ndarray) -> np.ndarray:
        """The unknowns of the system."""
        return np.asarray(self.system.shaped(jnp.asarray(u[:-2] / np.asarray(self.weights))))

    def place(self, u: np.ndarray) -> np.ndarray:
        """Place of the motion, see `place_of`."""
        return self.system.place(self.variation.oscillator(u[-2:]), self.unknowns(u))

    def seen_at(self, u: np.ndarray) -> Seen:
        """`AbstractSystem.seen_at` at u, in Python numbers."""
        osc, x = self.variation.oscillator(u[-2:]), jnp.asarray(self.unknowns(u))
        seen = _seen_at(osc, self.system, x)
        tests = {name: float(value) for name, value in seen.tests.items()}
        numbers = float(seen.multiplier), float(seen.residual)
        return Seen(tests, bool(seen.exists), *numbers, bool(seen.is_cut))

    def remeshed(self, u: np.ndarray, tangent: np.ndarray) -> tuple["Track", Any, Any]:
        """The same track with new integration steps, and u and the tangent in it."""
        osc, x = self.variation.oscillator(u[-2:]), jnp.asarray(self.unknowns(u))
        system, weights = _remeshed(osc, self.system, x)
        scale = np.append(np.asarray(weights) / np.asarray(self.weights), [1.0, 1.0])
        return Track(self.variation, system, weights), scale * u, scale * tangent

    def tangent(self, u: np.ndarray) -> np.ndarray:
        """Tangent of the curve at u along which the first parameter grows, or the second one where
        the curve turns back in the first."""
        for axis in (-2, -1):
            solved = self.corrected(u, np.eye(u.size)[axis], 0.0)
            if solved.found:  # fails where the curve turns back in this parameter
                break
        return solved.tangent


def _curve_linearized(u: Array, args: tuple[Family, AbstractSystem, Array]) -> tuple[Array, Array]:
    family, system, weights = args
    value, matrix = system.linearized(family.at, system.shaped(u[:-2] / weights), u[-2:])
    return value, matrix.at[:, :-2].divide(weights[None])


@jit
def _seen_at(osc: Oscillator, system: AbstractSystem, x: Array) -> Seen:
    return system.seen_at(osc, x)


@jit
def _remeshed(osc: Oscillator, system: AbstractSystem, x: Array):
    return system.remeshed(osc, x), system.weights(x)


# --- special points -------------------------------------------------------------------------------


def special_between(
    track: Track,
    limits: np.ndarray,
    before: tuple[CurvePoint, Seen],
    after: tuple[CurvePoint, Seen],
) -> list[SpecialPoint]:
    """Points of codimension two between two neighbouring points: zeros of watched functions."""
    from scipy.optimize import brentq  # half a second that only curves need

    (a, seen_a), (b, seen_b) = before, after
    length = float((b.u - a.u) @ a.tangent)
    found = []
    for name, start in seen_a.tests.items():
        end = seen_b.tests.get(name, np.nan)
        # A zero at an end of the step is found by `special_on`.
        if np.isnan(start * end) or start * end >= 0 or min(abs(start), abs(end)) < ALONG:
            continue

        def probe(part, name=name):
            at = track.corrected(a.u, a.tangent, part * length)
            seen = track.seen_at(at.u)
            value = seen.tests[name]
            if not at.found or np.isnan(value):
                raise _SingularError
            return _Probe(part, value, at.u[-2:], max(seen.residual, abs(value)))

        try:
            # Beside a singular point the solution for an end may lie on the point's other side.
            if probe(0.0).test * probe(1.0).test > 0:
                raise _SingularError
            root: Any = brentq(lambda part, probe=probe: probe(part).test, 0.0, 1.0, xtol=1e-14)
            special = probe(root)
            if abs(special.test) > max(JUMPS * min(abs(start), abs(end)), ALONG):
                continue
        except _SingularError:
            ends = _Probe(0.0, start, a.u[-2:], 0.0), _Probe(1.0, end, b.u[-2:], 0.0)
            special = _from_both_sides(probe, *ends)
        values = special.values
        if np.all((limits[:, 0] <= values) & (values <= limits[:, 1])):
            pair = float(values[0]), float(values[1])
            found.append((special.part, SpecialPoint(name[0], name[1], pair, special.residual)))
    points = [point for _, point in sorted(found, key=lambda item: item[0])]
    return [one for one in points if not _vanishes_at_rest(one, points)]


def special_on(
    track: Track,
    limits: np.ndarray,
    aside: float,
    row: tuple[CurvePoint, Seen],
    before: tuple[CurvePoint, Seen] | None = None,
) -> list[SpecialPoint]:
    """Points of codimension two on a row: watched functions that vanish there, and have different
    signs on its two sides.

    aside: distance along the curve at which the signs are compared. before: the row before; a
    function that vanishes there, too, vanishes all along the curve.
    """
    at, seen = row
    if not np.all((limits[:, 0] <= at.u[-2:]) & (at.u[-2:] <= limits[:, 1])):
        return []
    found, pair = [], (float(at.u[-2]), float(at.u[-1]))
    for name, value in seen.tests.items():
        last = np.inf if before is None else before[1].tests.get(name, np.inf)
        if not abs(value) < ALONG or abs(last) < ALONG:
            continue
        beside = [track.corrected(at.u, at.tangent, way * aside) for way in (-1.0, 1.0)]
        behind, ahead = (
            track.seen_at(one.u).tests[name] if one.found else np.nan for one in beside
        )
        if behind * ahead < 0 and min(abs(behind), abs(ahead)) >= ALONG:
            residual = max(seen.residual, abs(value))
            found.append(SpecialPoint(name[0], name[1], pair, residual))
    return [one for one in found if not _vanishes_at_rest(one, found)]


def _vanishes_at_rest(point: SpecialPoint, points: list[SpecialPoint]) -> bool:
    """Whether a point only repeats one of `points` at which a belt comes to rest.

    Distances of the cycle from boundaries and edges vanish with the belt's velocity.
    """
    if point.kind not in ("DoubleSliding", "EdgeTouch"):
        return False
    at_rest = [one for one in points if one.kind == "BeltAtRest"]
    return any(np.hypot(*np.subtract(one.values, point.values)) <= one.residual for one in at_rest)


class _Probe(NamedTuple):
    """A fraction of a step, with the watched function, parameters [2] and largest error there."""

    part: float
    test: float
    values: np.ndarray
    residual: float


class _SingularError(Exception):
    """Newton's method does not converge, or the watched function is not defined."""


def _from_both_sides(probe: Callable[[float], _Probe], low: _Probe, high: _Probe) -> _Probe:
    """Zero of a watched function at a point where it cannot be computed, extrapolated from values
    on both sides.

    An example is a curve whose cycle shrinks to a point: with all arcs of duration zero the
    equations of the cycle are singular.
    """
    known = [low, high]
    for _ in range(SHRINKS):
        middle = low.part - low.test * (high.part - low.part) / (high.test - low.test)
        try:
            nearer = [probe(0.5 * (side.part + middle)) for side in (low, high)]
        except _SingularError:
            break
        if any(new.test * old.test <= 0 for new, old in zip(nearer, (low, high), strict=True)):
            break
        known += nearer
        low, high = nearer

    def at_zero(probes):
        numbers = np.array([[probe.part, *probe.values] for probe in probes])
        return extrapolated_to_zero(np.array([probe.test for probe in probes]), numbers)

    best, other = at_zero(known[-6:]), at_zero(known[-4:])
    residual = float(np.max(np.abs(best - other))) if len(known) > 4 else np.nan
    return _Probe(float(best[0]), 0.0, best[1:], residual)
