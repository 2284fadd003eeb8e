"""Curves of bifurcation points in two parameters: `bifurcation_curve`.

A condition's own system of equations, regular at the point, stays regular along its curve, so with
one unknown more, the second parameter, pseudo-arclength follows it (see `continuation`), turning
points included. The signature is fixed while it lasts. Functions are watched that vanish where two
conditions hold at once: the first Lyapunov coefficient on a Hopf curve; on a curve of tangencies
the multiplier less one, the duration of each other stick phase and the distance of each other
extremum of x2 from a boundary, the last two also where a cycle touches a contact edge and on a
curve of folds of cycles, where the cycle's size is watched, too; on every curve the velocities and
their differences. Where one changes its sign the curve is solved for its zero, a point of
codimension two. There the signature may change; the condition is then refined anew just beyond,
and the curve goes on from there with the signature that is found.
"""

import functools
from collections.abc import Callable
from itertools import combinations
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks import as_array, check_finite, require
from ..cycles.attractors import extent, place_of
from ..cycles.cycle import cycle_of
from ..cycles.orbits import follow
from ..cycles.shooting import SIZES, Chain, Ends, Loop, admissible, end_guard, meshed, trace_of
from ..model.equilibria import Equilibria, EquilibriumKind, equilibria
from ..model.modes import boundary_guards, edge_guards, mode_acceleration, mode_of
from ..model.oscillator import Oscillator
from ..model.parameters import leaf_index, names_of, parameter, vary
from ..numerics.compiling import jit
from ..numerics.continuation import CurvePoint, Stop, continue_curve, corrected
from ..numerics.newton import newton
from ..results import Status, draw
from .refine import (
    HINT_BUDGET,
    AbstractCondition,
    BeltAtRest,
    BifurcationPoint,
    BoundaryEquilibrium,
    CornerCollision,
    CrossingSliding,
    EdgeContact,
    Encounter,
    FoldOfCycles,
    GrazingEdge,
    GrazingSliding,
    Hopf,
    NonsmoothFold,
    PseudoHopf,
    SlidingExchange,
    StickLimit,
    SuddenSliding,
    UnitMultiplier,
    arrival_near_limit,
    edge_balance,
    edge_rest,
    end_near_edge,
    least_push,
    small_newton,
    stick_phase_from,
)
from .scan import refined, sudden_sliding

#: Unknowns of a cycle count this much in the length of a step, beside the two parameters; large
#: ones less, for durations of stick phases go to infinity where a belt comes to rest.
WEIGHT = 0.1
#: After so many points the steps of integration are spread anew.
REMESH = 10
#: How far from an equilibrium its unstable manifold begins to be followed: the error is some third
#: power of it over the velocity at which the friction law bends, 1/p3 for Conti's law.
DEPARTURE = 1e-5
#: Integration steps for each arc of that orbit; it takes long to leave.
STEPS = 48
#: How often the points on both sides of a singular one are brought nearer to it by half; much
#: nearer Newton's method fails.
SHRINKS = 8


#: The place of nothing.
NOWHERE = np.full(5, np.nan)
#: A cycle changes by less in a step, relative to its size; a fixed point by less.
FAR = 0.2


class SpecialPoint(NamedTuple):
    """A point of codimension two on a curve.

    kind: "DegenerateHopf" (first Lyapunov coefficient 0: a fold of cycles shrinks to a Hopf point),
    "FoldGrazing" (a cycle of multiplier 1 touches a boundary: a nonsmooth fold turns into a grazing
    point, and a fold of cycles ends), "DoubleSliding" (another boundary is touched, too),
    "BoundaryHopf" (a Hopf point on a contact edge: there the curves of boundary equilibria and of
    pseudo-Hopf points meet its own), "BeltAtRest", "EqualVelocities"; belts: concerned; values: of
    the two parameters;
    residual: the largest error in all equations.
    """

    kind: str
    belts: tuple[int, ...]
    values: tuple[float, float]
    residual: float


class BifurcationCurve(eqx.Module):
    """A curve of bifurcation points in two parameters; what `bifurcation_curve` returns.

    condition: that of the point it began with; values: of the parameters, [rows, 2]; kinds: name of
    the condition that holds there, a row each; multiplier: of the cycle without the stick phase
    that vanishes, [rows], NaN where there is none; residual: [rows]; places: of the cycle, or of
    the fixed point, smallest and largest x1, the same of x2, and the period, [rows, 5], NaN where
    there is none; special: points of codimension
    two, in order; ends: why it ends at the first and the last row; names: of the parameters.
    `path`, `table()` and `plot()` have rows and special points together.
    """

    condition: AbstractCondition
    values: np.ndarray
    kinds: tuple[str, ...] = eqx.field(static=True)
    multiplier: np.ndarray
    residual: np.ndarray
    places: np.ndarray
    special: tuple[SpecialPoint, ...] = eqx.field(static=True)
    ends: tuple[Stop, Stop] = eqx.field(static=True)
    names: tuple[str, str] = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.values)

    @property
    def path(self) -> np.ndarray:
        """The values with those of the special points among them, [rows + special, 2]."""
        at = (i.values if isinstance(i, SpecialPoint) else self.values[i] for i in self._order())
        return np.array(list(at))

    def table(self, names: tuple[str, str] | None = None) -> list[dict[str, Any]]:
        """The rows and special points in order, as dictionaries.

        condition, belts: what holds there; the two parameters, under `names` (None: those of the
        curve); multiplier, residual: as above; special: kind and belts of a special point, else "".
        """
        belts = getattr(self.condition, "belts", (getattr(self.condition, "belt", ""),))
        rows, kind = [], self.kinds[0]
        for item in self._order():
            if isinstance(item, SpecialPoint):
                values, multiplier, residual = item.values, np.nan, item.residual
                special = " ".join(map(str, (item.kind, *item.belts)))
            else:
                kind, values, special = self.kinds[item], self.values[item].tolist(), ""
                multiplier, residual = float(self.multiplier[item]), float(self.residual[item])
            rows.append(
                {
                    "condition": kind,
                    "belts": " ".join(map(str, belts)),
                    **dict(zip(names or self.names, values, strict=True)),
                    "multiplier": multiplier,
                    "residual": residual,
                    "special": special,
                }
            )
        return rows

    def _order(self) -> list[int | SpecialPoint]:
        """The numbers of the rows, and the special points at their places among them."""
        path, order = self.values, list[int | SpecialPoint](range(len(self)))
        for point in self.special:
            at = np.array(point.values)
            ends = [np.hypot(*(path[i] - at)) for i in (0, -1)]
            gaps = np.hypot(*(path[1:] - path[:-1]).T)
            detour = np.hypot(*(path[:-1] - at).T) + np.hypot(*(path[1:] - at).T) - gaps
            # At an end where that is nearer than a way round by it between two rows.
            place = int(np.argmin([ends[0], *detour, ends[1]]))
            path = np.insert(path, place, at, axis=0)
            order.insert(place, point)
        return order

    def plot(self, ax: Any = None) -> Any:
        """Draw it into the axes `ax` (None: new ones), which are returned."""
        return draw(self, ax)

    def __repr__(self) -> str:
        first, last = (f"({p:.6g}, {q:.6g})" for p, q in self.values[[0, -1]])
        special = ", ".join(point.kind for point in self.special) or "none"
        return (
            f"BifurcationCurve({self.condition!r}, {len(self)} rows, {first} to {last}, "
            f"special: {special})"
        )


def bifurcation_curve(
    point: BifurcationPoint,
    where: tuple[Callable[[Oscillator], Any], Callable[[Oscillator], Any]],
    span: tuple[tuple[float, float], tuple[float, float]],
    *,
    step: float = 0.01,
    max_points: int = 1000,
) -> BifurcationCurve:
    """The curve of a bifurcation point in two parameters, to both sides of it.

    point: from `refine` or `scan`, with status OK; where: selects the two parameters; span: first
    and last value of each; step: length between neighbours; max_points: on each side.
    `ValueError` names an impossible argument.
    """
    require(isinstance(point, BifurcationPoint), "point", "a BifurcationPoint", repr(point))
    require(int(point.status) == Status.OK, "point", "one with status OK", repr(point))
    two = isinstance(where, tuple | list) and len(where) == 2
    require(two, "where", "two functions", repr(where))
    osc = point.oscillator
    numbers = [leaf_index(osc, one) for one in where]
    indices = jnp.asarray(np.array(numbers))
    require(numbers[0] != numbers[1], "where", "two different parameters", "one twice")
    limits = np.stack([np.asarray(as_array(ends, "span", (2,))) for ends in span])
    check_finite(limits, "span")
    start = np.array([float(parameter(osc, number)) for number in numbers])
    inside = np.all((limits[:, 0] <= start) & (start <= limits[:, 1]))
    require(inside, "span", f"around the point {start.tolist()}", limits.tolist())
    problem = _Problem(point.condition, osc, indices, limits, step, max_points)
    ahead = _follow(problem, point, 1.0)
    closed = ahead.end is Stop.CLOSED
    behind = _Side(ahead.rows[:1], [], Stop.CLOSED) if closed else _follow(problem, point, -1.0)
    rows = [*reversed(behind.rows[1:]), *ahead.rows]
    names = [names_of(osc)[number] for number in numbers]
    return BifurcationCurve(
        condition=point.condition,
        values=np.array([row.values for row in rows]),
        kinds=tuple(row.kind for row in rows),
        multiplier=np.array([row.multiplier for row in rows]),
        residual=np.array([row.residual for row in rows]),
        places=np.array([row.place for row in rows]),
        special=(*reversed(behind.special), *ahead.special),
        ends=(behind.end, ahead.end),
        names=(names[0], names[1]),
    )


def place_at(point: BifurcationPoint) -> np.ndarray:
    """Where the cycle, or the fixed point, of a bifurcation point is; NaN where there is none."""
    if isinstance(point.condition, Hopf):
        rests = equilibria(point.oscillator)
        return _at_rest(float(rests.x1[_row_at_hopf(rests)]))
    return place_of(point.cycle) if point.cycle.status == Status.OK else NOWHERE


def is_elsewhere(place: np.ndarray, other: np.ndarray, far: float) -> bool:
    """Whether two places a step or less apart are of two cycles, or fixed points, where known."""
    size = max(np.ptp(place[:4]), np.ptp(other[:4]), far)
    return bool(np.max(np.abs(place - other)[:4]) > far * size)


# --- going along ----------------------------------------------------------------------------------


class _Problem(NamedTuple):
    condition: AbstractCondition
    osc: Oscillator
    indices: Array
    limits: np.ndarray
    step: float
    max_points: int


class _Row(NamedTuple):
    values: np.ndarray
    kind: str
    multiplier: float
    residual: float
    place: np.ndarray


class _Side(NamedTuple):
    rows: list[_Row]
    special: list[SpecialPoint]
    end: Stop


def _follow(problem: _Problem, point: BifurcationPoint, sign: float) -> _Side:
    """The curve to one side of a point: piece by piece, each with one signature and one mesh."""
    system = _system_of(problem, point)
    u = system.unknowns(point)
    origin, direction = u[-2:], sign * system.tangent(u)
    rows: list[_Row] = []
    special: list[SpecialPoint] = []
    while True:
        points, found, beyond, end = _piece(problem, system, u, direction, origin)
        rows += [_row(problem, at, seen) for at, seen in points[min(len(rows), 1) :]]
        special += found
        last = points[-1][0].u if points else u
        if end is not Stop.LEFT_SPAN and (limit := _limit(problem, system, rows, last, end)):
            rows += _towards(problem, rows[-1].values, limit)
            return _Side(rows, [*special, limit], Stop.STOPPED)
        if len(rows) >= problem.max_points or not points:
            return _Side(rows, special, Stop.POINT_COUNT if points else Stop.STEP_TOO_SMALL)
        if beyond is None and end is not Stop.POINT_COUNT:
            return _Side(rows, special, end)
        if beyond is None:
            # The same curve, its mesh spread anew.
            system, u, direction = system.renewed(last, points[-1][0].tangent)
            continue
        # The signature has changed between the last two points.
        centre = np.array(found[-1].values) if found else 0.5 * (last + beyond.u)[-2:]
        is_end = bool(found) and isinstance(problem.condition, FoldOfCycles)
        place = points[-1][1].place
        further = None if is_end else _beyond(problem, last[-2:], centre, place)
        if further is None:
            return _Side(rows, special, Stop.STOPPED)
        system = _system_of(problem, further)
        u = system.unknowns(further)
        direction = system.tangent(u)
        direction = direction * np.sign(direction[-2:] @ (u[-2:] - centre))
        rows.append(_row(problem, beyond._replace(u=u), system.look(u)))


class _Piece(NamedTuple):
    """Points with what is seen there, where there is such a motion; the next one, where there is
    none; the points of codimension two between them."""

    points: list[tuple[CurvePoint, "_Seen"]]
    special: list[SpecialPoint]
    beyond: CurvePoint | None
    end: Stop


def _piece(problem: _Problem, system: "_System", u, direction, origin) -> _Piece:
    points, special = [], []
    for at in _steps(problem, system, u, direction):
        if points:
            at = _closing(system, points[-1][0], at, origin) or at
        points.append((at, system.look(at.u)))
        if len(points) > 1:
            special += _between(problem, system, points[-2], points[-1])
        if not points[-1][1].valid:
            beyond, _ = points.pop()
            return _Piece(points, special, beyond, Stop.STOPPED)
        if at.end is not None:
            return _Piece(points, special, None, at.end)
    return _Piece(points, special, None, Stop.STEP_TOO_SMALL)


def _closing(system: "_System", before: CurvePoint, after: CurvePoint, origin) -> CurvePoint | None:
    """The point where the curve began, if the step from one point to the next passes it."""
    chord = (after.u - before.u)[-2:]
    part = (origin - before.u[-2:]) @ chord / (chord @ chord)
    if not 1e-9 < part <= 1:
        return None
    guess = before.u + part * (after.u - before.u)
    normal = np.append(np.zeros(guess.size - 2), chord)
    at = corrected(*system.problem, guess, normal / np.linalg.norm(chord), 0.0)
    if not at.found or np.linalg.norm(at.u[-2:] - origin) > 1e-6 * np.linalg.norm(chord):
        return None
    return after._replace(u=at.u, tangent=at.tangent, end=Stop.CLOSED)


def _steps(problem: _Problem, system: "_System", u: np.ndarray, direction: np.ndarray):
    span = np.full((2, u.size), np.inf) * np.array([[-1.0], [1.0]])
    span[:, -2:] = problem.limits.T
    return continue_curve(
        system.residual,
        u,
        direction,
        args=system.args,
        jacobian=system.jacobian,
        span=(span[0], span[1]),
        step=problem.step,
        min_step=1e-2 * problem.step,
        max_step=problem.step,
        max_points=REMESH,
    )


def _row(problem: _Problem, at: CurvePoint, seen: "_Seen") -> _Row:
    kind = type(problem.condition)
    if isinstance(problem.condition, NonsmoothFold | GrazingSliding):
        kind = NonsmoothFold if seen.multiplier > 1 else GrazingSliding
    elif isinstance(problem.condition, SuddenSliding | BeltAtRest):
        kind = _kind_at_rest(
            vary(problem.osc, problem.indices, jnp.asarray(at.u[-2:])), problem.condition.belt
        )
    kind = kind.__name__
    return _Row(at.u[-2:], kind, seen.multiplier, seen.residual, seen.place)


def _between(problem: _Problem, system: "_System", before, after) -> list[SpecialPoint]:
    """The points of codimension two between two neighbours: where a watched function vanishes."""
    from scipy.optimize import brentq  # half a second that only curves need

    (a, seen_a), (b, seen_b) = before, after
    length = float((b.u - a.u) @ a.tangent)
    found = []
    for name, start in seen_a.tests.items():
        end = seen_b.tests.get(name, np.nan)
        if start * end >= 0 or np.isnan(start * end):
            continue

        def probe(part, name=name):
            at = corrected(*system.problem, a.u, a.tangent, part * length)
            seen = system.look(at.u)
            value = seen.tests[name]
            if not at.found or np.isnan(value):
                raise _SingularError
            return _Probe(part, value, at.u[-2:], max(seen.residual, abs(value)))

        try:
            root: Any = brentq(lambda part, probe=probe: probe(part).test, 0.0, 1.0, xtol=1e-14)
            special = probe(root)
        except _SingularError:
            ends = _Probe(0.0, start, a.u[-2:], 0.0), _Probe(1.0, end, b.u[-2:], 0.0)
            special = _from_both_sides(probe, *ends)
        values = special.values
        if np.all((problem.limits[:, 0] <= values) & (values <= problem.limits[:, 1])):
            pair = float(values[0]), float(values[1])
            found.append((special.part, SpecialPoint(name[0], name[1], pair, special.residual)))
    return [point for _, point in sorted(found, key=lambda item: item[0])]


class _Probe(NamedTuple):
    """A part of a step, the watched function and the parameters there, the largest error."""

    part: float
    test: float
    values: np.ndarray
    residual: float


class _SingularError(Exception):
    """Newton's method does not converge there, or the watched function is not defined."""


def _from_both_sides(probe: Callable[[float], _Probe], low: _Probe, high: _Probe) -> _Probe:
    """Where a function vanishes that has no value there: extrapolated from what has on both sides.

    So it is where the cycle of a curve shrinks to a point: with all arcs of duration zero its
    equations are singular.
    """
    from scipy.interpolate import KroghInterpolator

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
        numbers = [np.array([probe.part, *probe.values]) for probe in probes]
        return KroghInterpolator([probe.test for probe in probes], numbers)(0.0)

    best, other = at_zero(known[-6:]), at_zero(known[-4:])
    residual = float(np.max(np.abs(best - other))) if len(known) > 4 else np.nan
    return _Probe(float(best[0]), 0.0, best[1:], residual)


def _beyond(problem: _Problem, before: np.ndarray, centre: np.ndarray, place: np.ndarray):
    """The point of the same condition just beyond a change of signature, or None.

    It is the same cycle, in much the same place.

    The curve may have a corner there. So it is looked for all around the change, less where the
    curve came from.
    """
    condition = _sought(problem.condition)
    came_from = (before - centre) / max(float(np.linalg.norm(before - centre)), 1e-12)
    best: tuple[float, BifurcationPoint] | None = None
    for free in (0, 1):
        for side in (1.0, -1.0):
            values = centre + side * 0.5 * problem.step * np.eye(2)[1 - free]
            held = vary(problem.osc, problem.indices[1 - free], jnp.asarray(values[1 - free])[None])
            for offset in (-1.0, -0.5, -0.25, 0.0, 0.25, 0.5, 1.0):
                guess = float(values[free]) + offset * problem.step
                point = refined(held, problem.indices[free], guess, condition)
                if point is None or is_elsewhere(place_at(point), place, FAR):
                    continue
                if isinstance(condition, GrazingEdge | CornerCollision):
                    if point.condition != condition:
                        continue
                at = [float(parameter(point.oscillator, index)) for index in problem.indices]
                away = np.array(at) - centre
                distance = float(np.linalg.norm(away))
                fine = 0 < distance < 3 * problem.step
                if fine and (away / distance) @ came_from < 0.7:
                    if best is None or distance < best[0]:
                        best = distance, point
    return None if best is None else best[1]


def _limit(problem: _Problem, system, rows: list[_Row], u, end: Stop) -> SpecialPoint | None:
    """What the curve of a cycle ends in where there is no cycle, if that is near its point u."""
    if isinstance(problem.condition, FoldOfCycles | GrazingEdge):
        return _limit_at_hopf(problem, system, u) if end is not Stop.POINT_COUNT else None
    return _limit_at_rest(problem, system, rows)


def _towards(problem: _Problem, last: np.ndarray, limit: SpecialPoint) -> list[_Row]:
    """Rows between the last one and a belt at rest, where the curve of a tangency bends: each half
    as far from there as the one before."""
    condition, end = problem.condition, np.array(limit.values)
    if not isinstance(condition, NonsmoothFold | GrazingSliding):
        return []
    rows = []
    held = int(np.argmin(np.abs(end)))
    for part in 0.5 ** np.arange(1, 6):
        guess = end + part * (last - end)
        osc = vary(problem.osc, problem.indices[held], jnp.asarray(guess[held])[None])
        point = refined(osc, problem.indices[1 - held], float(guess[1 - held]), _sought(condition))
        if point is None or abs(float(point.value) - guess[1 - held]) > problem.step:
            break
        guess[1 - held] = float(point.value)
        numbers = float(point.multiplier), float(point.residual)
        rows.append(_Row(guess, point.kind, *numbers, place_at(point)))
    return rows


def _limit_at_hopf(problem: _Problem, system, u: np.ndarray) -> SpecialPoint | None:
    """Where the cycle of a fold, or one that touches an edge, has shrunk to an equilibrium.

    Its own equations are singular there, those of the equilibrium are not.
    """
    cycle, weights = system.args[2], np.asarray(system.args[4])
    x1 = (u[:-2] / weights).reshape(-1, 3)[:, 0]
    if np.ptp(x1) > 5 * problem.step:
        return None
    given = problem.osc, problem.indices, cycle.chain.codes[0]
    guess = jnp.asarray([x1[0], *u[-2:]])
    if isinstance(problem.condition, FoldOfCycles):
        kind, (found, residual) = "DegenerateHopf", _degenerate_hopf(given, guess)
    else:
        kind, (found, residual) = "BoundaryHopf", _boundary_hopf(given, guess, cycle.end)
    values = np.asarray(found[1:])
    if not (residual < 1e-9 and np.linalg.norm(values - u[-2:]) < 2 * problem.step):
        return None
    return SpecialPoint(kind, (), (float(values[0]), float(values[1])), float(residual))


def _limit_at_rest(problem: _Problem, system, rows: list[_Row]) -> SpecialPoint | None:
    """Where the curve of a tangency ends at a belt at rest, if that is near.

    No cycle exists in the limit: slip onset on the belt meets an equilibrium, which the orbit takes
    ever longer to leave. Of its two unstable directions the stronger one wins, by the power
    1 - weak/strong of the velocity. So in the limit the orbit along that direction is tangent to
    the boundary, which is a regular problem.
    """
    condition = problem.condition
    velocities = [
        leaf_index(problem.osc, lambda osc, k=k: osc.belts[k].velocity)
        for k in range(len(problem.osc.belts))
    ]
    last = np.array([row.values for row in rows[-3:]])
    for held in (0, 1):
        index = int(problem.indices[held])
        if index not in velocities or len(last) < 3:
            continue
        nu, free, resting = last[:, held], last[:, 1 - held], velocities.index(index)
        if not 0 < abs(nu[2]) < min(abs(nu[1]), 2 * problem.step):
            continue
        if isinstance(condition, SlidingExchange):
            return SpecialPoint("BeltAtRest", condition.belts, (0.0, 0.0), 0.0)
        if not isinstance(condition, NonsmoothFold | GrazingSliding):
            return None
        guess = np.polyval(np.polyfit(nu, free, 2), 0.0)
        still = vary(problem.osc, problem.indices[held], jnp.zeros(1))
        belts = (jnp.asarray(resting), jnp.asarray(condition.belt))
        # A cycle begins at the end of its longest stick phase, which is the one on that belt.
        codes = jnp.asarray(np.asarray(system.args[2].chain.codes)[0])
        value, residual = _tangent_departure(
            still, problem.indices[1 - held], codes, *belts, jnp.full(1, guess)
        )
        if not (residual < 1e-9 and abs(value - guess) < 3 * problem.step):
            return None
        values = (float(value), 0.0) if held else (0.0, float(value))
        return SpecialPoint("BeltAtRest", (resting,), values, float(residual))
    return None


@jit
def _tangent_departure(osc: Oscillator, index, codes, resting, touched, guess: Array):
    """Value of a parameter for which the orbit from `_departure` is tangent to another boundary.

    The 3N + 1 equations of an `Encounter`, but that the orbit is not closed: it begins on the
    unstable manifold. Returns the residual, too, with every integration step halved; nan where
    there is no such orbit.
    """
    osc_at = functools.partial(vary, osc, index)
    start = _departure(osc_at(guess), codes, resting)
    orbit = follow(osc_at(guess), start, HINT_BUDGET)
    names = Ends(len(osc.belts))
    exits = jnp.roll(orbit.entries, -1, axis=0).at[orbit.count - 1].set(orbit.y)
    side = jnp.sign(jnp.stack([belt.velocity for belt in osc.belts])[touched])
    loops = (orbit.ends == names.extremum_x2) & (exits[:, 1] * side > 0)
    meets = (loops | (orbit.ends == touched)) & (jnp.arange(HINT_BUDGET) < orbit.count)
    last = jnp.argmax(meets)

    rows = jnp.arange(SIZES[0])
    ends = jnp.where(rows < last, orbit.ends[rows], names.unused)
    ends = ends.at[last].set(names.tangent + touched)
    durations = jnp.where(rows <= last, orbit.durations[rows], 0.0)
    z = jnp.concatenate([orbit.entries[rows], durations[:, None]], axis=1)

    def system(steps):
        chain = Chain(orbit.codes[rows], ends, jnp.full((rows.size, steps), 1 / steps))
        return Encounter(chain, jnp.stack([touched, touched]))

    closing = 3 * rows[-1] + jnp.arange(2)  # replaced by where the orbit begins

    def begins(z, p):
        return z[0, :2] - _departure(osc_at(p), codes, resting)

    def linearized(unknowns):
        z, p = unknowns
        value, matrix = system(STEPS).linearized(osc_at, z, p)
        _, slope = jax.jvp(lambda p: begins(z, p), (p,), (jnp.ones(1),))
        row = jnp.zeros((2, value.size)).at[:, :2].set(jnp.eye(2)).at[:, -1].set(slope)
        return value.at[closing].set(begins(z, p)), matrix.at[closing].set(row)

    z, p = newton(linearized, (z, guess)).z
    value = system(2 * STEPS).residual(osc_at(p), z).at[closing].set(begins(z, p))
    exists = jnp.any(meets) & (last < SIZES[0]) & admissible(osc_at(p), system(1).ordinary, z)
    return p[0], jnp.where(exists, jnp.max(jnp.abs(value)), jnp.nan)


def _departure(osc: Oscillator, codes: Array, belt: Array) -> Array:
    """A state on the orbit that leaves a belt at rest at slip onset, into a slip mode.

    It is on the strong unstable manifold of the mode's equilibrium.

    With x2' = -(x1 - rest) + trace x2 + bend x2^2 and eigenvalues strong > weak, whose product is
    one, x1 - rest = weak x2 - weak bend / (2 strong - weak) x2^2 is invariant to third order. NaN
    where they are negative, as nothing departs then, and where they are complex, a +- i b: the
    orbit turns back to the belt within half a loop, on a cycle with -exp(pi a/b) times the belt's
    velocity as its smallest x2. It shrinks with that velocity, so it touches nothing else, and no
    curve of tangencies to another belt ends here.

    Where the law of the belt jumps, slip onset is not at that equilibrium, and the state is one
    shortly after it: x2' is the jump.
    """
    mode, zero = mode_of(codes), jnp.zeros(())
    rest = mode_acceleration(osc, mode, zero, zero)
    trace, twice_bend = jax.jvp(lambda x2: trace_of(osc, mode, rest, x2)[0], (zero,), (zero + 1,))
    strong = 0.5 * trace + jnp.sqrt(0.25 * trace**2 - 1)
    weak = 1 / strong
    x2 = -codes[belt] * DEPARTURE
    x1 = rest + weak * x2 - 0.5 * weak * twice_bend / (2 * strong - weak) * x2**2
    jumps = [b.load * (b.friction.static - b.friction.mu(zero)) for b in osc.belts]
    jump = codes[belt] * jnp.stack(jumps)[belt]
    is_jump = jnp.abs(jump) > 1e-12
    onset = rest + jump - 0.5 * x2**2 / jnp.where(is_jump, jump, 1.0)
    known = is_jump | (strong > 0)
    return jnp.where(known, jnp.stack([jnp.where(is_jump, onset, x1), x2]), jnp.nan)


def _sought(condition: AbstractCondition) -> AbstractCondition:
    """A tangency may be of the other kind further on."""
    is_fold = isinstance(condition, NonsmoothFold)
    return GrazingSliding(condition.belt) if is_fold else condition


# --- the systems ----------------------------------------------------------------------------------


class _Seen(NamedTuple):
    """What is watched at a point: functions by (name, belts), whether there is such a motion; and
    where it is, see `place_at`."""

    tests: dict[tuple[str, tuple[int, ...]], float]
    valid: bool
    multiplier: float
    residual: float
    place: np.ndarray


class _System:
    """Equations in u, whose last two entries are the parameters, and what is watched of them."""

    residual: Callable[..., Array]
    jacobian: Callable[..., tuple[Array, Array]] | None = None
    args: Any

    @property
    def problem(self) -> tuple[Any, Any, Any]:
        return self.residual, self.jacobian, self.args

    def unknowns(self, point: BifurcationPoint) -> np.ndarray:
        raise NotImplementedError

    def look(self, u: np.ndarray) -> _Seen:
        raise NotImplementedError

    def renewed(self, u: np.ndarray, tangent: np.ndarray) -> "tuple[_System, Any, Any]":
        """The system for what follows, and the point and the tangent in its unknowns."""
        return self, u, tangent

    def tangent(self, u: np.ndarray) -> np.ndarray:
        """The direction of the curve at u, in the sense in which a parameter grows."""
        for axis in (-2, -1):
            solved = corrected(*self.problem, u, np.eye(u.size)[axis], 0.0)
            if solved.found:  # it is not where the curve turns back in this parameter
                break
        return solved.tangent


def _system_of(problem: _Problem, point: BifurcationPoint) -> _System:
    kind = type(point.condition)
    if kind is Hopf:
        return _HopfSystem(problem, point)
    if kind in (SuddenSliding, BeltAtRest):
        return _RestSystem(problem, point)
    if kind in (BoundaryEquilibrium, PseudoHopf):
        return _EdgeSystem(problem, point)
    if kind in (
        NonsmoothFold,
        GrazingSliding,
        SlidingExchange,
        FoldOfCycles,
        GrazingEdge,
        CornerCollision,
        CrossingSliding,
    ):
        return _CycleSystem.begun(problem, point)
    raise ValueError(f"point must be of a kind that has curves, got {point.condition!r}")


def _velocity_tests(osc: Oscillator) -> dict[tuple[str, tuple[int, ...]], Any]:
    velocities = [belt.velocity for belt in osc.belts]
    tests: dict[tuple[str, tuple[int, ...]], Any] = {}
    for i, nu in enumerate(velocities):
        tests["BeltAtRest", (i,)] = nu
    for (i, a), (j, b) in combinations(enumerate(velocities), 2):
        tests["EqualVelocities", (i, j)] = a - b
    return tests


class _HopfSystem(_System):
    """Two equations in x1 and the parameters: rest, and a trace of zero."""

    def __init__(self, problem: _Problem, point: BifurcationPoint):
        self._indices = problem.indices
        rests = equilibria(point.oscillator)
        row = _row_at_hopf(rests)
        self._x1 = float(rests.x1[row])
        codes = jnp.asarray(rests.modes[row]).astype(float)
        self.residual = _rest_equations
        self.args = (point.oscillator, problem.indices, codes)

    def unknowns(self, point):
        pair = [float(parameter(point.oscillator, index)) for index in self._indices]
        return np.array([self._x1, *pair])

    def look(self, u):
        tests, valid, residual = _look_at_rest(self.args, jnp.asarray(u))
        tests = {name: float(value) for name, value in tests.items()}
        return _Seen(tests, bool(valid), np.nan, float(residual), _at_rest(u[0]))


def _row_at_hopf(rests: Equilibria) -> int:
    """Of the equilibria at a Hopf point that which it concerns."""
    fixed = np.asarray(rests.kind) == EquilibriumKind.FIXED_POINT
    return int(np.argmin(np.where(fixed, np.abs(np.asarray(rests.rate)), np.inf)))


def _at_rest(x1: float) -> np.ndarray:
    return np.array([x1, x1, 0.0, 0.0, 0.0])


def _rest_equations(u: Array, args) -> Array:
    osc, indices, codes = args
    osc, mode = vary(osc, indices, u[-2:]), mode_of(codes)
    rest = jnp.zeros(())
    return jnp.append(
        mode_acceleration(osc, mode, u[0], rest)[None], trace_of(osc, mode, u[0], rest)
    )


def _third_derivative(u: Array, args) -> Array:
    """That of x2' by x2 at the fixed point: 16 times the first Lyapunov coefficient."""
    osc, indices, codes = args
    osc, mode = vary(osc, indices, u[-2:]), mode_of(codes)

    def derivative(fn):
        return lambda x2: jax.jvp(fn, (x2,), (jnp.ones_like(x2),))[1]

    third = derivative(derivative(derivative(lambda x2: mode_acceleration(osc, mode, u[0], x2))))
    return third(jnp.zeros(()))


@jit
def _degenerate_hopf(args, guess: Array) -> tuple[Array, Array]:
    """(x1, both parameters) of a Hopf point with a third derivative of zero, and the error."""
    return _special_hopf(args, guess, _third_derivative)


@jit
def _boundary_hopf(args, guess: Array, edge: Array) -> tuple[Array, Array]:
    """The same of a Hopf point on an edge; by its number among what ends an arc."""

    def from_edge(u, args):
        osc, indices, codes = args
        at = jnp.stack([u[0], jnp.zeros(())])
        return end_guard(vary(osc, indices, u[-2:]), codes, edge, at)

    return _special_hopf(args, guess, from_edge)


def _special_hopf(args, guess: Array, condition: Callable) -> tuple[Array, Array]:
    """The Hopf point where condition(u, args) is zero, too."""
    osc, indices, codes = args

    def equations(osc, u):
        given = (osc, indices, codes)
        return jnp.append(_rest_equations(u, given), condition(u, given))

    u, _, residual, _ = small_newton(equations, osc, guess)
    return u, residual


@jit
def _look_at_rest(args, u: Array):
    osc, indices, codes = args
    osc, mode = vary(osc, indices, u[-2:]), mode_of(codes)
    tests = {**_velocity_tests(osc), ("DegenerateHopf", ()): _third_derivative(u, args)}
    rest = jnp.zeros(())
    nearest = jnp.min(jnp.stack(edge_guards(osc, mode, u[0])))
    tests["BoundaryHopf", ()] = jnp.where(jnp.isfinite(nearest), nearest, jnp.nan)
    inside = jnp.stack([*boundary_guards(osc, mode, rest), nearest])
    residual = jnp.max(jnp.abs(_rest_equations(u, args)))
    return tests, jnp.all(inside > 0), residual


class _RestSystem(_System):
    """One equation in the parameters: the velocity of a belt is zero."""

    def __init__(self, problem: _Problem, point: BifurcationPoint):
        self.residual = _velocity_equation
        belt = getattr(point.condition, "belt", 0)
        self.args = (point.oscillator, problem.indices, jnp.asarray(belt))
        self._indices = problem.indices

    def unknowns(self, point):
        return np.array([float(parameter(point.oscillator, index)) for index in self._indices])

    def look(self, u):
        osc, indices, belt = self.args
        tests = _velocity_tests(jax.tree.map(np.asarray, vary(osc, indices, jnp.asarray(u))))
        tests = {name: float(v) for name, v in tests.items() if name[1] != (int(belt),)}
        return _Seen(tests, True, np.nan, 0.0, NOWHERE)


def _kind_at_rest(osc: Oscillator, belt: int) -> type[AbstractCondition]:
    """Whether a cycle sticks to a belt before or after it is at rest."""
    index = jnp.asarray(np.array(leaf_index(osc, lambda osc: osc.belts[belt].velocity)))
    return BeltAtRest if sudden_sliding(osc, index, belt) is None else SuddenSliding


def _velocity_equation(u: Array, args) -> Array:
    osc, indices, belt = args
    osc = vary(osc, indices, u)
    return jnp.stack([one.velocity for one in osc.belts])[belt][None]


class _EdgeSystem(_System):
    """One equation in the parameters: of what lies at rest on a contact edge."""

    def __init__(self, problem: _Problem, point: BifurcationPoint):
        condition = point.condition
        self.residual = _edge_equation
        self._indices = problem.indices
        equation_of = edge_rest if isinstance(condition, BoundaryEquilibrium) else edge_balance
        belt = jnp.asarray(getattr(condition, "belt", 0))
        self.args = (point.oscillator, problem.indices, equation_of(point.oscillator, belt))

    def unknowns(self, point):
        return np.array([float(parameter(point.oscillator, index)) for index in self._indices])

    def look(self, u):
        tests, valid, residual = _look_at_edge(self.args, jnp.asarray(u))
        tests = {name: float(value) for name, value in tests.items()}
        return _Seen(tests, bool(valid), np.nan, float(residual), NOWHERE)


@jit
def _look_at_edge(args, u: Array):
    osc, indices, equation = args
    osc = vary(osc, indices, u)
    tests = {**_velocity_tests(osc), ("BoundaryHopf", ()): equation.meets_hopf(osc)}
    return tests, equation.exists(osc), jnp.abs(equation(osc))


def _edge_equation(u: Array, args) -> Array:
    osc, indices, equation = args
    return equation(vary(osc, indices, u))[None]


class _CycleSystem(_System):
    """3N + 1 equations in the unknowns of a cycle and the parameters, see `bifurcations`."""

    def __init__(self, args):
        self.residual, self.jacobian, self.args = _cycle_equations, _cycle_jacobian, args

    @classmethod
    def begun(cls, problem: _Problem, point: BifurcationPoint) -> "_CycleSystem":
        chain, z, condition = point.cycle.chain, point.cycle.unknowns, point.condition
        loop = Loop(chain.codes, chain.ends, z[:, :2], z[:, 2])
        codes, ends = np.asarray(chain.codes), np.array(chain.ends)
        names = Ends(codes.shape[1])
        row, belts = -1, (0, 0)
        if isinstance(condition, NonsmoothFold | GrazingSliding):
            belts = (condition.belt, condition.belt)
            arrival, _ = least_push(point.oscillator, loop, jnp.asarray(condition.belt))
            ends[int(arrival)] = names.tangent + condition.belt
            row = (int(arrival) + 1) % int(np.sum(ends != names.unused))
        elif isinstance(condition, SlidingExchange):
            belts = condition.belts
        chain = Chain(chain.codes, jnp.asarray(ends), chain.mesh)
        if isinstance(condition, FoldOfCycles):
            system = UnitMultiplier(chain)
        elif isinstance(condition, CrossingSliding):
            near = arrival_near_limit(point.oscillator, loop, jnp.asarray(condition.belt))
            row = (int(near.row) + 1) % int(np.sum(ends != names.unused))
            system = StickLimit(chain, near.row, near.codes, near.side)
        elif isinstance(condition, GrazingEdge | CornerCollision):
            belt, either = jnp.asarray(condition.belt), jnp.zeros(())
            near = end_near_edge(point.oscillator, loop, belt, either)
            # In a corner a stick phase that begins or ends there may have no duration.
            row = (int(near.row) + 1) % int(np.sum(ends != names.unused))
            system = EdgeContact(chain, near.row, near.end, near.codes)
        else:
            system = Encounter(chain, jnp.asarray(np.array(belts)))
        weights = _weights(np.asarray(point.cycle.unknowns))
        return cls((point.oscillator, problem.indices, system, jnp.asarray(row), weights))

    def unknowns(self, point):
        pair = [float(parameter(point.oscillator, index)) for index in self.args[1]]
        z = np.asarray(point.cycle.unknowns).reshape(-1)
        return np.append(np.asarray(self.args[4]) * z, pair)

    def look(self, u):
        tests, valid, multiplier, residual = _look_at_cycle(self.args, jnp.asarray(u))
        tests = {name: float(value) for name, value in tests.items()}
        rows = (u[:-2] / np.asarray(self.args[4])).reshape(-1, 3)
        place = extent(rows[np.asarray(self.args[2].chain.used)])
        return _Seen(tests, bool(valid), float(multiplier), float(residual), place)

    def renewed(self, u, tangent):
        args = _meshed_anew(self.args, jnp.asarray(u))
        scale = np.append(np.asarray(args[4]) / np.asarray(self.args[4]), [1.0, 1.0])
        return _CycleSystem(args), scale * u, scale * tangent


def _weights(z):
    return jnp.asarray(WEIGHT / (1 + abs(z.reshape(-1))))


def _parts(u: Array, args):
    """The oscillators by both parameters, the system, the unknowns of the cycle, the parameters."""
    osc, indices, system, _, weights = args
    return functools.partial(vary, osc, indices), system, (u[:-2] / weights).reshape(-1, 3), u[-2:]


def _cycle_equations(u: Array, args) -> Array:
    osc_of, system, z, p = _parts(u, args)
    return system.residual(osc_of(p), z)


def _cycle_jacobian(u: Array, args) -> tuple[Array, Array]:
    osc_of, system, z, p = _parts(u, args)
    value, matrix = system.linearized(osc_of, z, p)
    return value, matrix.at[:, :-2].divide(args[4][None])


@jit
def _look_at_cycle(args, u: Array):
    osc_of, system, z, p = _parts(u, args)
    osc, row = osc_of(p), args[3]
    chain = system.ordinary
    ok = jnp.asarray(Status.OK.value)
    residual = jnp.max(jnp.abs(_cycle_equations(u, args)))
    cycle, slope = cycle_of(osc, chain, z, jnp.asarray(0), ok, residual)
    n = len(osc.belts)
    names = Ends(n)
    rows = jnp.arange(chain.ends.size)
    is_fold = isinstance(system, UnitMultiplier)
    at_end = isinstance(system, EdgeContact | StickLimit)
    touches = (row >= 0) & (not at_end)
    others = chain.used & ~stick_phase_from(osc, chain, row)
    if at_end:
        others = others & (rows != system.row)
    sticks = others & jnp.any(chain.codes == 0, axis=-1)
    slope = jnp.where(jnp.any(sticks), 0.0, slope)
    tests = _velocity_tests(osc)
    tests["FoldGrazing", ()] = jnp.where(touches & ~jnp.any(sticks), slope - 1, jnp.nan)
    # Largest x1 less its mean. Beyond an equilibrium the equations go on, what is largest and
    # smallest exchanged.
    size = z[0, 0] - jnp.mean(z[:, 0], where=chain.used)
    following = jnp.roll(z, -1, axis=0)
    last = rows == jnp.sum(chain.used) - 1
    following = jnp.where(last[:, None], z[0], following)
    loops = chain.used & (system.chain.ends == names.extremum_x2)
    for belt in range(n):
        own = sticks & (chain.codes[:, belt] == 0)
        shortest = jnp.min(jnp.where(own, z[:, 2], jnp.inf))
        r = osc.belts[belt].velocity - osc.omega * following[:, 1]
        slips = loops & (jnp.abs(chain.codes[:, belt]) == 1)
        gap = jnp.min(jnp.where(slips, chain.codes[:, belt] * r, jnp.inf))
        nearest = jnp.where(jnp.any(own), shortest, gap)
        # An exchange ends where the phase of sticking vanishes.
        watched = (touches | is_fold | at_end | jnp.any(own)) & jnp.isfinite(nearest)
        name = "FoldGrazing" if is_fold else "DoubleSliding"
        tests[name, (belt,)] = jnp.where(watched, nearest, jnp.nan)
    valid = (cycle.status == Status.OK) & (residual < 1e-9) & ((size > 0) | (not is_fold))
    return tests, valid, jnp.where(touches | is_fold, slope, jnp.nan), residual


@jit
def _meshed_anew(args, u: Array):
    osc_of, system, z, p = _parts(u, args)
    chain = system.chain
    loop = Loop(chain.codes, chain.ends, z[:, :2], z[:, 2])
    fresh, _ = meshed(osc_of(p), loop)
    return (*args[:2], eqx.tree_at(lambda s: s.chain, system, fresh), args[3], _weights(z))
