"""The return map of the tops, and all cycles of an oscillator from it: `Returns`.

x1' = x2, so an orbit moves right above the axis x2 = 0 and left below it. A top is a maximum of x1,
a state (x1, 0) at which the mass is pulled to the left; the map leads from a top to the next one.

- A closed orbit has one top. Between a top and the next minimum of x1 an orbit is a graph over the
  x1 axis, and two orbits do not cross: were there two tops and two minima, two of the four arcs
  would. So the fixed points of the map are the cycles.
- For the same reason the map P does not decrease between two tops a < b without a rest, an edge or
  an end of a segment between them on the axis. So P(a) > b, or P(b) < a, shows that no cycle has
  its top between a and b. The tops are divided until each interval is free in this sense, brackets
  a change of sign of P(x1) - x1, or is short.
- The map is flat where orbits stick, and steep beside. A cycle that sticks passes a place where a
  stick phase ends; the intervals are divided at the tops that follow these places, too.
- It jumps at tops whose orbits end in a point of an edge that nothing draws in from one side, see
  `separatrices`. A jump over the diagonal is no cycle.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import pick
from ..model.equilibria import Equilibria, EquilibriumKind, side_pulls
from ..model.far_out import contraction_far_out, is_bounded
from ..model.friction import AbstractFriction, friction_jumps
from ..model.modes import edges
from ..model.oscillator import Oscillator, constant_force
from ..numerics.compiling import each, jit
from ..numerics.padding import in_batches
from ..results import Status
from .attractors import distinct
from .backwards import forwards, reversed_in_time, solved
from .chains import SIZES, Loop
from .cycle import Cycle
from .orbits import before_stick_ends, follow_to_top, loop_of, place_of_rest
from .settling import AT_REST

#: Tops that are evaluated in one batch.
TOPS_AT_ONCE = 64
#: Room for the arcs of one loop.
LOOP_ROOM = SIZES[-1]
#: Tops for each factor of ten of the distance from the beginning of an interval, and from its end.
PER_DECADE = 16
#: Intervals shorter than SHORT, as a fraction of the distance from where they begin, are divided
#: only where the growth of loops changes by more than UNEVEN, and none below SHORTEST.
SHORT, UNEVEN, SHORTEST = 1e-2, 0.05, 1e-5
#: Smallest distance of evaluated tops from those that follow stick phases, and from jumps.
CLOSEST = 1e-10
#: Smallest width of cycles around a pseudo-focus that are searched; their height is larger. For
#: tops nearer to the edge rounding decides whether loops grow, so no gap is reported there.
AT_FOCUS = 1e-7
#: Distance at which both sides of a narrow gap are examined, over the distance from where its
#: interval begins.
AROUND = 0.3
#: Largest number of tops in the search for all cycles.
MOST_TOPS = 20_000
#: A top returns to itself, up to the errors of orbits, if it changes by no more than this fraction.
RETURNED = 1e-8
#: A bracket is divided into 64, at most DIVISIONS times; if it then contains a jump, the map
#: changes by more than JUMP there.
DIVISIONS, JUMP = 6, 1e-6
#: Where loops grow by less than HARDLY_GROWS the errors of the map are estimated from EACH_WAY tops
#: on either side, which differ by the fraction SIDEWAYS: nearer to one another they have the same
#: errors. Beside an edge such errors are considered up to UNRESOLVED, in units of 1 + |x1|.
HARDLY_GROWS, EACH_WAY, SIDEWAYS, UNRESOLVED = 0.1, 8, 1e-2, 1e-4
#: Values of a function within this many standard deviations of its errors are rounding.
CERTAIN = 5.0
#: Error of the map, relative to the top; a fixed point is off by this over 1 - multiplier.
MAP_ERROR = 3e-7
#: Cycles with a multiplier this near to 1 are parts of a continuum of closed orbits.
NEUTRAL = 1e-9
#: Intervals of tops as short as this, relative to their place, are rounding.
NARROWEST = 1e-12
#: Tops that differ by less, relative to their place, are equal up to rounding of the map.
ONE_TOP = 1e-11
#: Largest distance from the origin that is searched, where no bound is known.
FARTHEST = 1e4
#: Loops grow as they do at infinity if their growth differs from that by less than this fraction.
AS_EXPECTED = 0.25


class Bracket(NamedTuple):
    """Tops between which P(x1) - x1 changes its sign."""

    low: float
    high: float


@jit
def _next_tops(osc: Oscillator, starts: Array) -> tuple[Array, Loop]:
    """x1 of the top that follows each start, [starts], and the orbit up to it as a loop.

    starts: states, [starts, 2]. In place of a top: x1 where the orbit comes to rest; inf where it
    does not come back; NaN where that is not known.
    """

    def one(start):
        orbit, top = follow_to_top(osc, start, LOOP_ROOM)
        rest = place_of_rest(osc, orbit)
        far = jnp.max(jnp.abs(orbit.y)) > 10 * (1 + jnp.max(jnp.abs(start)))
        lost = (orbit.status != Status.OK) & (far | ~jnp.all(jnp.isfinite(orbit.y)))
        rest = jnp.where(lost & jnp.isnan(rest), jnp.inf, rest)
        orbit = eqx.tree_at(lambda orbit: orbit.repeats, orbit, jnp.asarray(-1))
        return jnp.where(jnp.isnan(top), rest, top), loop_of(orbit, LOOP_ROOM, len(osc.belts))

    return each(one)(lax.stop_gradient(starts))


@jit
def _stick_ends(osc: Oscillator) -> Array:
    """States shortly before stick phases end, [places, 2]; NaN where there is none."""
    return jnp.concatenate([before_stick_ends(osc, belt) for belt in range(len(osc.belts))])


class Returns:
    """Values of the return map of one oscillator, and its fixed points.

    reach: bound of the tops of cycles and of orbits that come to rest, as far as one is known.
    intervals: of tops, (from, to) each, from left to right. cycles: all cycles found, each once, in
    order of their tops. gaps: intervals of tops, (from, to) each, in which it is not known whether
    there are cycles, such as a continuum of closed orbits. escapes: whether orbits from the
    outermost tops go to infinity.
    """

    def __init__(
        self, osc: Oscillator, rests: Equilibria, reach: float, special: Sequence[float]
    ) -> None:
        """rests: states of rest; special: tops of separatrices, near which the map may jump."""
        self.osc = osc
        self.gaps: list[tuple[float, float]] = []
        self._brackets: list[Bracket] = []
        self._hits: list[float] = []
        self._leaps: list[tuple[float, float]] = []
        self._known: dict[float, float] = {}
        self.reach = reach
        self._edges = {float(edge) for edge in edges(osc)}
        self.intervals = self._intervals_of_tops(rests)
        places = np.concatenate([*map(np.ravel, map(np.asarray, _positions(osc, rests)))])
        self._separating = np.concatenate([np.array(special), places])
        self._holds_by_more = any(bool(friction_jumps(belt.friction)) for belt in osc.belts)
        self._special = np.array([*special, *self._tops_after_sticking()])
        for low, high in self.intervals:
            self._search(low, high, rests)
        self.cycles = self._solved()
        self.gaps = [gap for gap in self.gaps if not self._is_rounding(gap, rests)]
        self.gaps += [gap for gap in _touching_joined(self._leaps) if not self._has_unstable(gap)]
        outermost = self.intervals[-1][1]
        grows, bounded = bool(self(np.array([outermost]))[0] > outermost), bool(is_bounded(osc))
        self.escapes = grows and not bounded
        if grows == bounded:  # there is a cycle farther out
            self.gaps.append((outermost, np.inf))

    def __call__(self, tops: np.ndarray) -> np.ndarray:
        """x1 of the tops that follow these tops, as of `_next_tops`."""
        new = np.array([top for top in tops.tolist() if top not in self._known])
        after, _ = self._after(self.osc, np.column_stack([new, np.zeros_like(new)]))
        self._known |= dict(zip(new.tolist(), after.tolist(), strict=True))
        return np.array([self._known[top] for top in tops.tolist()])

    def _after(self, osc: Oscillator, starts: np.ndarray) -> tuple[np.ndarray, list[Loop]]:
        """`_next_tops` of these states, [starts, 2]; the loops in batches of one size."""
        tops, loops = [np.zeros(0)], []
        for batch, some in in_batches(starts, np.arange(len(starts)), TOPS_AT_ONCE):
            after, ways = _next_tops(osc, some)
            tops.append(np.asarray(after)[: len(batch)])
            loops.append(ways)
        return np.concatenate(tops), loops

    def _is_rounding(self, gap: tuple[float, float], rests: Equilibria) -> bool:
        """Whether P(x1) - x1 changes its sign in a gap only by rounding, and no cycle passes there.

        That is the case next to an edge at which an interval begins; at an edge where one ends;
        between a fixed point on an edge and loops that certainly grow, or shrink, as its rate says;
        and where a gap is as narrow as rounding, but loops grow on its left as on its right.
        """
        (low, high), *_ = [*(i for i in self.intervals if i[0] <= gap[0] < i[1]), (np.nan, np.nan)]
        away, narrow = gap[1] - low, NARROWEST * (1 + abs(gap[1]))
        at_end = high in self._edges and high - gap[1] < narrow
        if at_end or (low in self._edges and away < AT_FOCUS):
            return True
        if away < UNRESOLVED * (1 + abs(low)) and self._grow_as_at_rest(low, high, away, rests):
            return True
        beside = np.array([gap[0] - AROUND * away, gap[1] + AROUND * away])
        if not (gap[1] - gap[0] < narrow and beside[1] < high):
            return False
        within, outside = self(beside) - beside
        here = np.asarray(rests.x1) == low
        if np.any(here & (np.asarray(rests.kind) == EquilibriumKind.PSEUDO_FOCUS)):
            # That close to a pseudo-focus the map is rounding, but its stability is known.
            within = -1.0 if np.any(here & np.asarray(rests.stable)) else 1.0
        return bool(within * outside > 0)

    def _grow_as_at_rest(self, low: float, high: float, away: float, rests: Equilibria) -> bool:
        """Whether loops around a fixed point, at which an interval begins, grow or shrink as its
        rate says.

        Loops farther out than `away` are tried; the first whose growth exceeds rounding decides.
        """
        rate = _rate_at(rests, low)
        beyond = low + away * np.geomspace(1.0, 1e3, TOPS_AT_ONCE)[1:]
        beyond = beyond[beyond < high]
        if not (rate.size and beyond.size):
            return False
        rise = self(beyond) - beyond
        known = np.flatnonzero(np.abs(rise) > CERTAIN * self._errors_at(beyond, low))
        return bool(known.size) and bool(rise[known[0]] * rate[0] > 0)

    def _errors_at(self, tops: np.ndarray, low: float) -> np.ndarray:
        """Errors of the map at these tops, estimated from tops beside them."""
        steps = SIDEWAYS * np.arange(-EACH_WAY, EACH_WAY + 1)
        beside = tops[:, None] + (tops[:, None] - low) * steps
        around = self(beside.ravel()).reshape(beside.shape) - beside
        return np.array([_error_of(one) for one in around])

    def _intervals_of_tops(self, rests: Equilibria) -> list[tuple[float, float]]:
        """The intervals of the axis in which a mass at rest is pulled to the left."""
        cuts = np.concatenate([*map(np.ravel, map(np.asarray, _positions(self.osc, rests)))])
        cuts = np.unique(cuts[np.isfinite(cuts)])
        cuts = cuts if cuts.size else np.zeros(1)
        ends = np.append(cuts, self.reach)
        pulls = np.asarray(side_pulls(self.osc, jax.device_put(0.5 * (ends[1:] + ends[:-1])))[1])
        found: list[tuple[float, float]] = []
        for low, high, pull in zip(ends[:-1].tolist(), ends[1:].tolist(), pulls, strict=True):
            if not pull < 0 or high - low < NARROWEST * (1 + abs(low)):
                continue
            goes_on = found and found[-1][1] == low and self._passes(low)
            found[-1:] = [(found[-1][0], high)] if goes_on else [*found[-1:], (low, high)]
        return found

    def _passes(self, x1: float) -> bool:
        """Whether both sides of an edge pull to the left."""
        left, right = side_pulls(self.osc, jax.device_put(np.array([x1])))
        return bool(left[0] < 0 and right[0] < 0)

    def _tops_after_sticking(self) -> list[float]:
        """The tops that follow places where stick phases end, and the tops that follow these."""
        starts = np.asarray(_stick_ends(self.osc))
        first, _ = self._after(self.osc, starts[np.isfinite(starts[:, 0])])
        tops = first[np.isfinite(first)]
        return [*tops.tolist(), *(top for top in self(tops).tolist() if np.isfinite(top))]

    # --- dividing -------------------------------------------------------------------------------

    def _search(self, low: float, high: float, rests: Equilibria) -> None:
        """Finds the brackets of cycles with their tops in an interval."""
        tops = self._first_tops(low, high)
        returns = self(tops)
        while tops.size < MOST_TOPS:
            divided = self._divided(tops, returns, low)
            if not divided.size:
                break
            tops = np.concatenate([tops, divided])
            returns = np.concatenate([returns, self(divided)])
            order = np.argsort(tops)
            tops, returns = tops[order], returns[order]
        self._collect(tops, returns, low)
        # Where the smallest loop does not grow as the rate says, there is a smaller cycle.
        grows, rate = returns[0] - tops[0], _rate_at(rests, low)
        if np.any(grows * rate < 0):
            self.gaps.append((low, float(tops[0])))

    def _first_tops(self, low: float, high: float) -> np.ndarray:
        length = high - low
        # Cycles around a pseudo-focus are as wide as the square of their height.
        least = min(0.1 * AT_FOCUS if low in self._edges else AT_REST, 1e-4 * length)
        decades = np.log10(0.5 * length / least)
        away = np.geomspace(least, 0.5 * length, max(8, int(PER_DECADE * decades)))
        near = self._special[(low < self._special) & (self._special < high)]
        # An unstable cycle may be as near to a sticking cycle as this is to its fold.
        steps = np.geomspace(CLOSEST, 0.1, int(-0.25 * PER_DECADE * np.log10(CLOSEST)))
        beside = (near[:, None] + np.concatenate([-steps, steps])).ravel()
        tops = np.concatenate([low + away, high - away, [high], beside, near])
        return np.unique(tops[(low + least <= tops) & (tops <= high)])

    def _divided(self, tops: np.ndarray, returns: np.ndarray, low: float) -> np.ndarray:
        """New tops, one in each interval that is not known to be free of cycles."""
        (a, b), (after_a, after_b) = (tops[:-1], tops[1:]), (returns[:-1], returns[1:])
        with np.errstate(invalid="ignore"):
            free = (after_a > b) | (after_b < a)
            changes = np.sign(after_a - a) * np.sign(after_b - b) <= 0
            growth = (after_a - a) / (a - low), (after_b - b) / (b - low)
            uneven = np.abs(growth[1] - growth[0]) > UNEVEN * np.abs(growth[0])
        width = (b - a) / (b - low)
        wide = (width > SHORT) | (width > SHORTEST) & uneven
        return (0.5 * (a + b))[~free & ~changes & wide & np.isfinite(width)]

    def _collect(self, tops: np.ndarray, returns: np.ndarray, low: float) -> None:
        """Collects the changes of sign, the tops that return to themselves, and unresolved
        intervals."""
        rise = returns - tops
        zero = np.abs(rise) <= np.maximum(RETURNED * np.minimum(1.0, tops - low), RETURNED**2)
        zero = self._with_rounding(tops, rise, zero, low)
        many = zero[:-2] & zero[1:-1] & zero[2:] if tops.size > 2 else np.zeros(0, bool)
        closed = np.zeros(tops.size, bool)
        for i in np.flatnonzero(many):
            closed[i : i + 3] = tops[i + 2] - tops[i] > 1e-4 * (tops[i] - low) or closed[i]
        for first, last in _runs_of(closed):
            self.gaps.append((float(tops[first]), float(tops[last])))
        for first, last in _runs_of(np.isnan(returns)):
            self.gaps.append(
                (float(tops[max(first - 1, 0)]), float(tops[min(last + 1, tops.size - 1)]))
            )
        self._hits += tops[zero & ~closed].tolist()
        known = ~zero & ~np.isnan(returns)
        signs, where = np.sign(rise[known]), tops[known]
        for i in np.flatnonzero(np.diff(signs)):
            if not np.any(closed & (where[i] < tops) & (tops < where[i + 1])):
                self._brackets.append(Bracket(float(where[i]), float(where[i + 1])))

    def _with_rounding(
        self, tops: np.ndarray, rise: np.ndarray, zero: np.ndarray, low: float
    ) -> np.ndarray:
        """Mask of the rises of the map that are zero, including those within its errors beside a
        change of sign.

        Near an edge that pushes the mass back these errors are large: x1 there is known to its
        rounding, and so x2 only to that rounding times the push, divided by x2.
        """
        zero, asked = zero.copy(), np.abs(rise) > HARDLY_GROWS * (tops - low)
        while True:
            known = np.flatnonzero(~zero & ~np.isnan(rise))
            changes = np.flatnonzero(np.diff(np.sign(rise[known])))
            new = np.unique([known[changes], known[changes + 1]])
            new = new[~asked[new]]
            if not new.size:
                return zero
            zero[new] = np.abs(rise[new]) <= CERTAIN * self._errors_at(tops[new], low)
            asked[new] = True

    # --- solving --------------------------------------------------------------------------------

    def _solved(self) -> list[Cycle]:
        """The cycles in all brackets and at all tops that return to themselves, each once."""
        found = [self._cycle_at(top, top, top) for top in self._hits]
        for bracket in self._brackets:
            found += self._solved_between(bracket, DIVISIONS)
        cycles = distinct([cycle for cycle in found if cycle is not None])
        return _with_tops_apart(sorted(cycles, key=lambda cycle: float(cycle.x1_max)))

    def _solved_between(self, bracket: Bracket, divisions: int) -> list[Cycle]:
        low, high = bracket
        tops = np.unique(np.linspace(low, high, TOPS_AT_ONCE + 2)[1:-1])
        tops = np.concatenate([[low], tops[(low < tops) & (tops < high)], [high]])
        rise = self(tops) - tops
        known = ~np.isnan(rise)
        tops, rise = tops[known], rise[known]
        found: list[Cycle] = []
        for i, j, is_rounding in _changes_of_sign(rise):
            a, b, before, after = tops[i], tops[j], rise[i], rise[j]
            # A secant step: where the map is flat, it leads to the top of the cycle.
            change = before - after
            share = before / change if np.isfinite(change) and change else 0.5
            at = a + (b - a) * np.clip(share, 0.01, 0.99)
            cycle = self._cycle_at(float(at), float(a), float(b))
            if cycle is not None and (float(cycle.multiplier) > 1) == (after > before):
                found.append(cycle)
            elif divisions > 1 and tops.size > 2 and not is_rounding:
                found += self._solved_between(Bracket(float(a), float(b)), divisions - 1)
            elif after > before and (behind := self._cycle_behind(float(a), float(b))) is not None:
                found.append(behind)
            elif is_rounding or not abs(after - before) > JUMP:
                self.gaps.append((float(a), float(b)))
            elif not self._jumps(a, b):
                self._leaps.append((float(a), float(b)))
        return found

    def _has_unstable(self, gap: tuple[float, float]) -> bool:
        """Whether the map leaps over the diagonal in a gap because an unstable cycle makes it
        steep."""
        tops = [float(cycle.x1_max) for cycle in self.cycles if float(cycle.multiplier) > 1]
        margin = MAP_ERROR * (1 + abs(gap[1]))
        return any(gap[0] - margin < top < gap[1] + margin for top in tops)

    def _jumps(self, low: float, high: float) -> bool:
        """Whether the map may jump between two tops.

        It does so at the top of a separatrix, at edges and states of rest themselves, and where a
        mass arrives at a boundary that holds it by more than kinetic friction. A steep law that has
        none of these makes the map steep, too.
        """
        margin = high - low + MAP_ERROR * (1 + abs(high))
        at = (low - margin < self._separating) & (self._separating < high + margin)
        return self._holds_by_more or bool(np.any(at))

    def _cycle_at(self, top: float, low: float, high: float) -> Cycle | None:
        """The cycle with its top between `low` and `high`, solved for from the loop that begins at
        `top`; or None."""
        _, (loops,) = self._after(self.osc, np.array([[top, 0.0]]))
        return _if_at_home(solved(self.osc, pick(loops, 0)), top, high - low)

    def _cycle_behind(self, low: float, top: float) -> Cycle | None:
        """The cycle with its top at `top`, solved for in reversed time, or None.

        None means that the map jumps between `low` and `top`, or, where the reversed orbit comes to
        no top, that this is not known: then the interval becomes a gap.
        """
        behind = reversed_in_time(self.osc)
        (before,), (loops,) = self._after(behind, np.array([[top, 0.0]]))
        if np.isnan(before):
            self.gaps.append((low, top))
        if not abs(before - top) < MAP_ERROR * (1 + abs(top)):
            return None
        cycle = _if_at_home(solved(behind, pick(loops, 0)), top, 0.0)
        return None if cycle is None else forwards(self.osc, cycle)


def _rate_at(rests: Equilibria, x1: float) -> np.ndarray:
    """The rate of the fixed point at x1, as an array; empty if there is none, or a neutral one."""
    near = np.abs(np.asarray(rests.x1) - x1) < NARROWEST * (1 + abs(x1))
    near &= np.asarray(rests.kind) == EquilibriumKind.FIXED_POINT
    return np.asarray(rests.rate)[near & ~np.asarray(rests.neutral)]


def _if_at_home(cycle: Cycle, top: float, width: float) -> Cycle | None:
    """A cycle that was solved for from `top`, or None where it does not exist or lies elsewhere."""
    if int(cycle.status) != Status.OK:
        return None
    x1, x2, _ = np.ptp(np.asarray(cycle.unknowns), axis=0)
    if x1 < AT_FOCUS or x2 < AT_REST:
        return None
    growth = min(abs(float(cycle.multiplier) - 1), 1.0)
    margin = width + MAP_ERROR * (1 + abs(top)) / max(growth, NEUTRAL)
    return cycle if abs(float(cycle.x1_max) - top) < margin and growth > NEUTRAL else None


def _touching_joined(gaps: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Intervals, merged where they touch up to rounding."""
    joined: list[tuple[float, float]] = []
    for low, high in sorted(gaps):
        if joined and low - joined[-1][1] < NARROWEST * (1 + abs(low)):
            low, high = joined[-1][0], max(high, joined.pop()[1])
        joined.append((low, high))
    return joined


def _with_tops_apart(cycles: Sequence[Cycle]) -> list[Cycle]:
    """Cycles in order of their tops, without those that rounding has multiplied.

    Of several neighbours that all attract, or all do not, with equal tops up to rounding, the first
    is kept: between two such fixed points lies one of the other sort. Where a saddle's orbit
    returns to it, the map rises like a square root, and rounding makes several cycles of one.
    """
    kept = list(cycles[:1])
    for before, cycle in pairwise(cycles):
        attract = [float(one.multiplier) < 1 for one in (before, cycle)]
        top = float(cycle.x1_max)
        near = top - float(before.x1_max) < ONE_TOP * (1 + abs(top))
        if not (near and attract[0] == attract[1]):
            kept.append(cycle)
    return kept


def _changes_of_sign(rise: np.ndarray) -> list[tuple[int, int, bool]]:
    """Changes of sign of a function between its values at even steps, as numbers of both values,
    and whether they are rounding.

    Neighbouring changes whose values are all rounding count as one.
    """
    signs = np.flatnonzero(np.sign(rise[:-1]) * np.sign(rise[1:]) <= 0)
    small = np.abs(rise) <= CERTAIN * _error_of(rise)
    found: list[tuple[int, int, bool]] = []
    for i in signs.tolist():
        is_rounding = bool(small[i] and small[i + 1])
        if is_rounding and found and found[-1][2] and np.all(small[found[-1][1] : i + 1]):
            found[-1] = (found[-1][0], i + 1, True)
        else:
            found.append((i, i + 1, is_rounding))
    return found


def _error_of(values: np.ndarray) -> float:
    """Standard deviation of errors in the values of a function at even steps.

    Zero for too few values; JUMP at most: larger values are no error. Little is left of a smooth
    function in its fourth differences; the median of their sizes is 5.6 times the standard
    deviation of independent errors. A jump occurs in four of them.
    """
    left = np.abs(np.diff(values[np.isfinite(values)], 4))
    return min(float(np.median(left)) / 5.6, JUMP) if left.size > 2 * 4 else 0.0


def _positions(osc: Oscillator, rests: Equilibria) -> list[Array]:
    return [*edges(osc), rests.x1_lower, rests.x1_upper]


def _runs_of(flags: np.ndarray) -> np.ndarray:
    """First and last number of each run of True, [runs, 2]."""
    switches = np.flatnonzero(np.diff(flags, prepend=False, append=False))
    return switches.reshape(-1, 2) - [0, 1]


def reach_of(osc: Oscillator) -> float:
    """Largest possible top that returns to itself; FARTHEST where that is farther, or not known.

    Let friction be at most F. Half a loop of the linear oscillator with a constant force F takes an
    extremum x to -(q x + F (1 + q)) at most, q = exp(-pi zeta/(2 w)), w^2 = 1 - zeta^2/4, and no
    force between -F and F takes it farther; q = 0 from zeta = 2 on. So with q < 1 no top beyond F
    (1 + q)/(1 - q) comes back as far out. With q > 1, F (1 + q)/(q - 1) is where the least that
    half a loop leads to, q x - F (1 + q), is x, and from farther out orbits go to infinity.
    Friction that opposes the motion and grows with the speed brings orbits further in; with q > 1
    it holds cycles farther out, see `_reach_of_friction_that_grows`.
    """
    zeta = float(osc.damping)
    frequency = np.sqrt(max(1 - zeta**2 / 4, 0.0))
    decay = np.exp(-np.pi * abs(zeta) / (2 * frequency)) if frequency > 0 else 0.0
    friction = sum(_largest_pull(belt) for belt in osc.belts)
    friction += abs(float(sum(constant_force(osc))))
    bound = friction * (1 + decay) / max(1 - decay, 1e-12)
    # Equilibria and all possible ends of an interval lie within.
    inner = [friction, *(abs(edge) for edge in map(float, edges(osc)) if np.isfinite(edge))]
    inner += [abs(float(belt.velocity / osc.omega)) for belt in osc.belts]
    reach = float(max(min(1.01 * bound + 1.0, FARTHEST), max(inner) + 1.0))
    if zeta < 0 and reach < FARTHEST and any(map(_pulls_more_far_out, osc.belts)):
        return _reach_of_friction_that_grows(osc, reach)
    return reach


def _reach_of_friction_that_grows(osc: Oscillator, reach: float) -> float:
    """The least of the tried tops beyond which all loops grow, or shrink, as at infinity."""
    tops = np.geomspace(reach, FARTHEST, TOPS_AT_ONCE)
    after, _ = _next_tops(osc, jax.device_put(np.column_stack([tops, np.zeros_like(tops)])))
    growth = np.log(np.abs(after) / tops)
    rate = float(contraction_far_out(osc))
    if np.isinf(rate):
        differs = growth >= 0
    else:
        expected = -np.pi * rate / np.sqrt(max(1 - rate**2 / 4, 1e-12))
        differs = (np.abs(growth - expected) > AS_EXPECTED * abs(expected)) & (abs(rate) < 2)
        differs |= growth * expected <= 0
    first = np.flatnonzero(differs).max(initial=-1) + 1
    return float(tops[min(first, tops.size - 1)])


def _pulls_more_far_out(belt) -> bool:
    fast = _coefficients(belt.friction, np.geomspace(1.0, FARTHEST, 65))
    return float(belt.load) * float(np.max(fast)) > _largest_pull(belt) * (1 + 1e-9)


def _largest_pull(belt) -> float:
    speeds = np.linspace(0.0, 1.0 + abs(float(belt.velocity)), 65)
    coefficients = _coefficients(belt.friction, speeds)
    largest = max(float(belt.friction.static), float(np.max(coefficients)))
    return float(belt.load) * largest


@jit
def _coefficients(friction: AbstractFriction, speeds: Array) -> Array:
    return friction.mu(speeds)
