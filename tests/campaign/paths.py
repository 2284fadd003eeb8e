"""Paths in one parameter: what `scan` finds against what the engine finds by brute force.

A path is an oscillator, one of its parameters and an interval. On a grid along it the engine runs
from many starts, and from every attractor that it found at the neighbouring values, so that one
with a small basin is not lost. The engine's label has the equilibria, in a closed form independent
of the package, and the cycles: the modes of one loop, and their place. Three things must hold.

- Every cycle of the engine is in the label that `scan` uses, and every cycle of that label exists
  for the engine when it starts on it.
- Between values with different labels, narrowed to a small part of the interval, is a point.
- On the two sides of a point the engine's labels differ; at a connection of saddles the engine's
  runs from the saddle part there.
"""

import functools
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, isfinite

import numpy as np

import jaxbelt as jb
from jaxbelt.bifurcations.base import given_point
from jaxbelt.bifurcations.path import ParameterPath
from jaxbelt.bifurcations.scan import search
from jaxbelt.cycles.attractors import place_of

from . import engine, package
from .cases import random_case, rational_case, structures
from .outcome import Outcome
from .units import ENGINES, Units, drawn

#: Number of structures (laws and edges) of a campaign, each a compilation.
PROGRAMS = 6
#: Of DRAWS random paths the first one is taken along which labels change by a few runs at COARSE
#: values; the last one if there is none.
DRAWS, COARSE = 8, 6
#: Values on the grid, and starts at each.
GRID, STARTS = 48, 12
#: Changes are narrowed to this fraction of the interval.
NARROW = 1e-4
#: Largest difference of extrema and periods of the same cycle: the engine's repeat to 2e-11, and a
#: run that approaches slowly may be a thousand times as far from its limit.
SAME = 1e-6
#: Relative distance below which two events happen at one place: rounding decides which one comes
#: first.
ONE_PLACE = 1e-14
#: Distance below which two edges, or an edge and an equilibrium, coincide.
ONE_EDGE = 1e-12
#: Width below which a cycle around a pseudo-focus cannot be distinguished from it.
TINY = 1e-3
#: Number of the last events, some loops, that are examined in a run with too many events.
LAST_EVENTS = 100
#: Time after the end of a connection at which orbits that part there are compared.
PARTED = 1.0
#: Longest time of a run of the engine; its attractor is then undecided.
PATIENCE = 3000.0

NUMBERS = {
    "conti": ("static", "residual", "steepness", "quadratic"),
    "coulomb": ("static", "kinetic"),
    "stribeck": ("static", "kinetic", "velocity"),
}


@dataclass(frozen=True)
class Case:
    """The engine's oscillator, the parameter as (belt or -1, name), the interval, and the units in
    which the package gets them."""

    oscillator: engine.Oscillator
    parameter: tuple[int, str]
    span: tuple[float, float]
    kind: str
    units: Units = ENGINES

    def at(self, value: float) -> engine.Oscillator:
        """The engine's oscillator at a value of the parameter."""
        return with_value(self.oscillator, self.parameter, value)

    def given(self, value: float) -> jb.Oscillator:
        """The package's oscillator at a value of the parameter, in the units of the case."""
        return package.oscillator(self.units.given(self.at(value)))

    @property
    def measured(self) -> float:
        """Size of 1 of the parameter in the units of the case."""
        return self.units.of(self.oscillator, self.parameter)

    @property
    def given_span(self) -> tuple[float, float]:
        """The interval in the units of the case."""
        first, last = (end * self.measured for end in self.span)
        return first, last

    @property
    def where(self):
        """The function that selects the parameter of the package's oscillator."""
        return selector(self.parameter)


@functools.cache
def selector(parameter: tuple[int, str]):
    """The same function for the same parameter, so that compiled programs serve all paths."""
    number, name = parameter

    def where(osc):
        if number < 0:
            return getattr(osc, name)
        belt = osc.belts[number]
        if name in ("velocity", "load", "lower", "upper"):
            return getattr(belt, name)
        return getattr(belt.friction, name.removeprefix("law "))

    return where


def value_of(osc: engine.Oscillator, parameter: tuple[int, str]) -> float:
    """The value of a parameter, (belt or -1, name)."""
    number, name = parameter
    if number < 0:
        return getattr(osc, name)
    belt = osc.belts[number]
    if name.startswith("law "):
        return belt.law[1 + NUMBERS[belt.law[0]].index(name.removeprefix("law "))]
    return getattr(belt, name)


def with_value(
    osc: engine.Oscillator, parameter: tuple[int, str], value: float
) -> engine.Oscillator:
    """The oscillator with another value of a parameter."""
    number, name = parameter
    if number < 0:
        return replace(osc, **{name: value})
    belt = osc.belts[number]
    if name.startswith("law "):
        place = 1 + NUMBERS[belt.law[0]].index(name.removeprefix("law "))
        belt = replace(belt, law=(*belt.law[:place], value, *belt.law[place + 1 :]))
    else:
        belt = replace(belt, **{name: value})
    return replace(osc, belts=(*osc.belts[:number], belt, *osc.belts[number + 1 :]))


# --- random paths ---------------------------------------------------------------------------------


def random_path(rng: np.random.Generator, structure, *, rational: bool) -> Case:
    """A path through a random oscillator; rational: its ends are multiples of 1/20, too."""
    while True:
        osc = (rational_case if rational else random_case)(rng, structure).oscillator
        number = int(rng.integers(-1, len(osc.belts)))
        if number < 0:
            parameter, value = (-1, "damping"), osc.damping
        else:
            belt = osc.belts[number]
            name = str(rng.choice(["velocity", "velocity", "velocity", "load", "edge", "law"]))
            ends = [end for end in ("lower", "upper") if isfinite(getattr(belt, end))]
            if name == "edge" and not ends:
                continue
            if name == "edge":
                name = str(rng.choice(ends))
            if name == "law":
                place = int(rng.integers(len(belt.law) - 1))
                name = f"law {NUMBERS[belt.law[0]][place]}"
            parameter = number, name
            value = value_of(osc, parameter)
        width = rng.uniform(0.1, 0.8) * (
            1.0 if parameter[1] in ("velocity", "lower", "upper") else max(abs(value), 0.1)
        )
        first = value - rng.uniform(0, 1) * width
        span = first, first + width
        if rational:
            span = tuple(round(20 * end) / 20 for end in span)
        if span[0] < span[1] and all(is_possible(with_value(osc, parameter, end)) for end in span):
            return Case(osc, parameter, span, "rational" if rational else "random")


def is_possible(osc: engine.Oscillator) -> bool:
    """Whether the package takes such an oscillator."""
    try:
        package.oscillator(osc).check()
    except ValueError:
        return False
    return osc.damping >= 0 and all(b.lower < b.upper for b in osc.belts)


# --- labels by the engine -------------------------------------------------------------------------


@dataclass(frozen=True)
class Cycle:
    """The modes of one loop, (smallest x1, largest, smallest x2, largest, period), and a state."""

    modes: tuple
    place: np.ndarray
    state: tuple[float, float]

    def is_same(self, other: "Cycle") -> bool:
        return self.modes == other.modes and _near(self.place, other.place)


def _near(place, other) -> bool:
    return bool(np.max(np.abs(place - other)) < SAME * max(1.0, np.ptp(place[:4])))


@dataclass
class Label:
    """Equilibria, (kind, stable, contact codes) each; cycles; whether every run was decided."""

    rests: tuple
    cycles: list[Cycle]
    decided: bool

    @property
    def name(self):
        """The part of a label that is compared between values."""
        return self.rests, tuple(sorted(cycle.modes for cycle in self.cycles))


def label_of(osc: engine.Oscillator, starts) -> Label:
    """The engine's label, by runs from these starts."""
    label = Label(equilibria(osc), [], True)
    for start in starts:
        if _circles_an_edge(osc, start, label.rests):
            continue
        found = engine.attractor(osc, start, t_max=PATIENCE)
        label.decided &= found.kind != "undecided"
        if found.kind == "cycle":
            cycle = _cycle(osc, found)
            # Slipping loops around a pseudo-focus seem to repeat long before they shrink to it;
            # loops that stick do not, because they repeat exactly after one.
            slips = not any(0 in modes for modes in cycle.modes)
            around = any(kind == 3 for kind, _, _ in label.rests)
            if slips and around and found.x1[1] - found.x1[0] < TINY:
                label.decided = False
                continue
            if not any(cycle.is_same(other) for other in label.cycles):
                label.cycles.append(cycle)
    return label


def _circles_an_edge(osc: engine.Oscillator, start, rests) -> bool:
    """Whether a run converges to an attracting pseudo-focus, passing its edge ever faster."""
    if not any(kind == 3 and stable for kind, stable, _ in rests):
        return False
    run = engine.simulate(osc, start, 400.0, max_events=8000)
    ends = [x for b in osc.belts for x in (b.lower, b.upper) if isfinite(x)]
    near = min(abs(run.y_end[0] - x) for x in ends) + abs(run.y_end[1]) < 0.05
    # A loop that sticks after thousands of others is a cycle, however small.
    still_sticks = run.status == engine.BUDGET and np.any(run.codes[-LAST_EVENTS:] == 0)
    return near and not still_sticks and run.status in (engine.BUDGET, engine.PSEUDO_FOCUS)


def _cycle(osc: engine.Oscillator, found: engine.Attractor) -> Cycle:
    top = (found.x1[1], 0.0)
    run = engine.simulate(osc, top, 2.3 * found.period)
    # Events are taken from later on, because a belt at rest may be crossed at the top.
    inside = (
        (run.t > 0.3 * found.period) & (run.t <= 1.3 * found.period) & (run.kind <= engine.EDGE)
    )
    modes = run.codes[inside & _lasts(run)].tolist() or [run.mode_end]
    place = np.array([*found.x1, *found.x2, found.period])
    return Cycle(_loop([_told(osc, mode) for mode in modes]), place, top)


def _lasts(run) -> np.ndarray:
    """Whether the mode after each event of a run lasts, [events]: False if the next event is at the
    same place up to rounding, as where slip onset lies on an edge."""
    events = np.flatnonzero(run.kind <= engine.EDGE)
    lasts = np.ones(len(run.t), bool)
    here, ahead = run.y[events[:-1]], run.y[events[1:]]
    lasts[events[:-1]] = np.any(np.abs(ahead - here) > ONE_PLACE * (1 + np.abs(here)), axis=1)
    return lasts


def _told(osc: engine.Oscillator, codes) -> tuple:
    """Contact codes in which a belt without load is absent."""
    return tuple(2 if b.load == 0 else code for b, code in zip(osc.belts, codes, strict=True))


def _loop(modes) -> tuple:
    """Successive modes without repetition, rotated to the smallest sequence."""
    before = [modes[-1], *modes[:-1]]
    kept = [mode for mode, last in zip(modes, before, strict=True) if mode != last] or modes[:1]
    return min(tuple(kept[i:] + kept[:i]) for i in range(len(kept)))


def equilibria(osc: engine.Oscillator) -> tuple:
    """Equilibria (kind, stable, contact codes) from left to right; kind: 1 fixed point, 2 segment,
    3 pseudo-focus."""
    table = osc.table()
    ends = []
    for x in sorted(x for b in osc.belts for x in (b.lower, b.upper) if isfinite(x)):
        if not ends or x - ends[-1] > ONE_EDGE:
            ends.append(x)
    zones = list(pairwise([-inf, *ends, inf]))
    rows = [_rest_in_zone(osc, table, *zone) for zone in zones]
    held_at = [end for zone in zones for end in _segment(osc, table, zone)]
    found: list = []
    for row in filter(None, rows):
        # A fixed point on an edge that a segment reaches is the end of the segment; a fixed point
        # on an edge that both zones have counts once.
        others = [*held_at, *(other[0] for other in found if other[1] == 1)]
        if row[1] == 1 and any(abs(row[0] - x) < ONE_EDGE for x in others):
            continue
        if row[1] == 1:
            row = (*row[:2], row[2] and not _leaves_edge(osc, table, row[0], zones), row[3])
        found.append(row)
    for edge, left, right in zip(ends, zones, zones[1:], strict=False):
        row = _rest_on_edge(osc, table, edge, left, right)
        if row is not None:
            found.append(row)
    found = sorted(found, key=lambda row: row[0])
    return tuple((kind, bool(stable), _told(osc, codes)) for _, kind, stable, codes in found)


def _leaves_edge(osc, table, x1, zones) -> bool:
    """Whether a fixed point is on an edge, and the field of one side pushes away from the edge."""
    for left, right in pairwise(zones):
        if abs(x1 - left[1]) < ONE_EDGE:
            pulls = [_side(osc, table, zone)[1] - x1 for zone in (left, right)]
            helds = [_side(osc, table, zone)[2] for zone in (left, right)]
            return pulls[0] < -helds[0] - ONE_EDGE or pulls[1] > helds[1] + ONE_EDGE
    return False


def _side(osc, table, zone):
    """At x2 = 0 in a zone: codes, pull of moving belts, static, kinetic force at rest, trace."""
    codes, pull, held, rubs, trace = [], 0.0, 0.0, 0.0, -osc.damping
    for row, belt in zip(table, osc.belts, strict=True):
        if zone[0] < belt.lower - ONE_EDGE or zone[1] > belt.upper + ONE_EDGE:
            codes.append(-2 if zone[0] < belt.lower - ONE_EDGE else 2)
            continue
        codes.append(int(np.sign(belt.velocity)))
        if belt.velocity == 0:
            held += belt.load * belt.law[1]
            rubs += belt.load * engine.mu(row, 0.0)
        else:
            speed, h = abs(belt.velocity), 1e-6
            pull += np.sign(belt.velocity) * belt.load * engine.mu(row, speed)
            slope = (engine.mu(row, speed + h) - engine.mu(row, speed - h)) / (2 * h)
            trace -= osc.omega * belt.load * slope
    return codes, pull, held, rubs, trace


def _segment(osc, table, zone):
    """Ends of the segment of a zone where belts at rest hold the mass; () if there is none."""
    _, pull, held, *_ = _side(osc, table, zone)
    first, last = max(pull - held, zone[0]), min(pull + held, zone[1])
    return (first, last) if last - first > ONE_EDGE else ()


def _rest_in_zone(osc, table, lower, upper):
    codes, pull, held, rubs, trace = _side(osc, table, (lower, upper))
    if held == 0:
        # Belts at rest without static friction slip.
        codes = [1 if code == 0 else code for code in codes]
        is_here = lower - ONE_EDGE < pull < upper + ONE_EDGE
        return (pull, 1, trace < 0, tuple(codes)) if is_here else None
    first, last = max(pull - held, lower), min(pull + held, upper)
    attracts = max(pull - rubs, lower) < min(pull + rubs, upper)
    attracts = attracts or (first < last and _returns(osc, first, last))
    is_here = last - first > ONE_EDGE
    return (0.5 * (first + last), 2, attracts, tuple(codes)) if is_here else None


def _returns(osc, first, last):
    """Whether runs from beside an end of a segment, up and down, end in the segment near there; far
    away does not count, because a large motion may lead back by chance."""
    near = 1e-3 * (last - first)
    for x1 in (first + near, last - near):
        begin, end = max(first, x1 - 10 * near), min(last, x1 + 10 * near)
        ends = [engine.attractor(osc, (x1, x2), t_max=PATIENCE) for x2 in (-1e-5, 1e-5)]
        if all(one.kind == "stuck" and begin <= one.x1[0] <= end for one in ends):
            return True
    return False


def _rest_on_edge(osc, table, edge, left, right):
    (codes, pull, held, rubs, trace), other = _side(osc, table, left), _side(osc, table, right)
    (a, b), capacity = (pull - edge, other[1] - edge), max(held, other[2])
    if not a > held + ONE_EDGE or not -b > other[2] + ONE_EDGE:
        return None
    # The signs of slipping belts there make no difference.
    signs = [code if abs(code) == 2 else 1 for code in codes]
    stable = True if capacity + rubs + other[3] > 0 else trace / a + other[4] / -b < 0
    return edge, 3, stable, tuple(signs)


# --- one path -------------------------------------------------------------------------------------


@dataclass
class Report:
    """Disagreements, a line each; and numbers of what was compared."""

    case: Case
    points: tuple
    wrong: list[str]
    changes: int = 0
    labels: int = 0
    undecided: int = 0
    seconds: tuple[float, float] = (0.0, 0.0)


class Brute:
    """The engine's labels along a path; runs also start on cycles of neighbouring values."""

    def __init__(self, case: Case, rng: np.random.Generator):
        self.case = case
        self.starts = np.stack([rng.uniform(-3, 3, STARTS), rng.uniform(-1.5, 1.5, STARTS)], 1)
        self.labels: dict[float, Label] = {}

    def look(self, value: float, more=()) -> Label:
        if value not in self.labels:
            osc = self.case.at(value)
            near = [row for label in self._beside(value) for row in label.cycles]
            starts = [*map(tuple, self.starts), *(cycle.state for cycle in near), *more]
            self.labels[value] = label_of(osc, starts)
        return self.labels[value]

    def _beside(self, value: float) -> list[Label]:
        known = sorted(self.labels)
        at = int(np.searchsorted(known, value))
        return [self.labels[known[i]] for i in (at - 1, at) if 0 <= i < len(known)]

    def learn(self, value: float, start) -> Cycle | None:
        """The cycle that a start leads to, which is added to the label of the value; or None."""
        found = label_of(self.case.at(value), [start])
        if not found.cycles:
            return None
        label, (cycle,) = self.labels[value], found.cycles
        if not any(cycle.is_same(other) for other in label.cycles):
            label.cycles.append(cycle)
        return cycle

    def spread(self) -> None:
        """Follows cycles from each value to the neighbouring ones, and adds what they lead to."""
        values = sorted(self.labels)
        for pairs in (pairwise(values), pairwise(values[::-1])):
            for known, value in pairs:
                for cycle in self.labels[known].cycles:
                    if all(cycle.modes != other.modes for other in self.labels[value].cycles):
                        self.learn(value, cycle.state)

    def changes(self, a: float, b: float) -> Iterator[tuple[float, float]]:
        """Intervals, narrowed by bisection, between whose ends labels differ."""
        left, right = self.labels[a], self.labels[b]
        if not (left.decided and right.decided) or left.name == right.name:
            return
        for known, value in ((a, b), (b, a)):
            for cycle in self.labels[known].cycles:
                if all(cycle.modes != other.modes for other in self.labels[value].cycles):
                    self.learn(value, cycle.state)
        if left.name == right.name:
            return
        if b - a < NARROW * (self.case.span[1] - self.case.span[0]):
            if self._is_decided(a, b) and self._is_decided(b, a):
                yield a, b
            return
        middle = 0.5 * (a + b)
        self.look(middle)
        if not self.labels[middle].decided:
            middle += 0.0123 * (b - a)
            self.look(middle)
        yield from self.changes(a, middle)
        yield from self.changes(middle, b)

    def _is_decided(self, known: float, value: float) -> bool:
        """Whether runs show that `value` lacks cycles of `known`; these may be too small for it."""
        names = [cycle.modes for cycle in self.labels[value].cycles]
        missing = [cycle for cycle in self.labels[known].cycles if cycle.modes not in names]
        osc = self.case.at(value)
        return all(label_of(osc, [cycle.state]).decided for cycle in missing)


class OwnPath:
    """The path of `scan`, which is in its own units, with values and states in the engine's."""

    def __init__(self, case: Case):
        middle = case.given(0.5 * sum(case.span))
        self.path = ParameterPath(middle, case.where, case.given_span)
        own, self.case = self.path.variation.own, case
        self._parameter = float(own.parameters[0]) / case.measured
        self._length = float(own.length) / case.units.length
        found = [given_point(point, self.path.variation) for point in search(self.path)]
        self.points = tuple(
            replace(p, value=p.value / case.measured, error=p.error / case.measured) for p in found
        )

    def look(self, values) -> None:
        self.path.find_labels([self._own(value) for value in values])

    def label(self, value: float):
        return self.path.label(self._own(value))

    def cycles(self, value: float) -> list[tuple]:
        """For each cycle its modes, its place and the state with the largest x1."""
        found = []
        for one in self.path.cycles[self._own(value)]:
            if one.path:
                place = place_of(one.loop) * np.array([*[self._length] * 4, 1.0])
                found.append((one.path, place, _start_on(one.loop, self._length)))
        return found

    def orbit(self, point) -> np.ndarray:
        """The states of a connection."""
        return np.asarray(point.orbit) / self.case.units.length

    def _own(self, value: float) -> float:
        return float(value) / self._parameter


def check(case: Case, seed: int) -> Report:
    """Compares along one path."""
    rng = np.random.default_rng(seed)
    begun = time.perf_counter()
    first, last = case.span
    path = OwnPath(case)
    points = path.points
    report = Report(case, points, [])
    at_scan = time.perf_counter() - begun
    length = last - first
    # The values are not round numbers.
    values = (first + length * (np.arange(GRID) + 0.3779) / GRID).tolist()
    special = [float(point.value) for point in points]
    brute = Brute(case, rng)
    for value in values:
        brute.look(value)
    path.find_labels(values)
    for value in values:
        _compare(path, brute, value, report)
    brute.spread()
    tolerance = 2e-6 * (1 + length)
    for a, b in pairwise(values):
        for low, high in brute.changes(a, b):
            if not any(low - tolerance <= at <= high + tolerance for at in special):
                # Starts may miss the basin of a cycle about to vanish: a start on the cycle of
                # `scan` shows whether it exists.
                path.find_labels([low, high])
                for value in (low, high):
                    for start in _starts_on_cycles(path, value):
                        brute.learn(value, start)
                sides = [brute.labels[at] for at in (low, high)]
                if sides[0].name == sides[1].name:
                    continue
                names = [words(side) for side in sides]
                report.wrong.append(f"change at {low:.9g}..{high:.9g}: {names[0]} | {names[1]}")
            report.changes += 1
    report.undecided = sum(not label.decided for label in brute.labels.values())
    for point in points:
        _both_sides(path, point, special, brute, report)
    report.seconds = at_scan, time.perf_counter() - begun - at_scan
    return report


def _compare(path: OwnPath, brute: Brute, value: float, report: Report) -> None:
    """Compares the label of `scan` with the engine's at one value."""
    label, ours = brute.labels[value], path.label(value)
    if not label.decided:
        return
    report.labels += 1
    for modes, place, start in path.cycles(value):
        cycle = brute.learn(value, start)
        if (
            cycle is None
            or cycle.modes != modes
            or np.any(np.abs(cycle.place - place) > 1e-4 * np.maximum(1.0, np.abs(place)))
        ):
            report.wrong.append(f"at {value:.12g} scan has {modes} {place.round(6)}: {cycle}")
    if tuple(sorted(cycle.modes for cycle in label.cycles)) != ours.cycles:
        report.wrong.append(f"at {value:.12g} cycles {ours.cycles}, engine {words(label)}")
    if label.rests != ours.equilibria:
        report.wrong.append(f"at {value:.12g} rests {ours.equilibria}, engine {label.rests}")


def _both_sides(path: OwnPath, point, special, brute: Brute, report: Report) -> None:
    """Checks that labels differ on the two sides of a point of `scan`.

    The engine also starts on the cycles of `scan` to confirm them, because from few starts it need
    not find them.
    """
    at, (first, last) = float(point.value), brute.case.span
    others = [abs(at - other) for other in special if other != at]
    away = min([1e-4 * (last - first), *(gap / 3 for gap in others)])
    if away < 1e-9 or at - away < first or at + away > last:
        return
    if point.kind == "HopfAtInfinity":
        return  # tests/test_bifurcations.py has its closed forms
    if point.kind == "SaddleConnection":
        if not _part(brute.case, path.orbit(point), float(point.place[4]), at, away):
            report.wrong.append(f"no orbits part at {point!r}")
        return
    path.find_labels([at - away, at + away])
    sides = [brute.look(side, _starts_on_cycles(path, side)) for side in (at - away, at + away)]
    for label, other, value in ((*sides, at + away), (*sides[::-1], at - away)):
        for cycle in label.cycles:
            if all(cycle.modes != one.modes for one in other.cycles):
                brute.learn(value, cycle.state)
    if sides[0].name == sides[1].name:
        # Near a fold no run reaches a cycle that hardly attracts in time; a start on the cycle
        # shows whether it exists.
        for value in (at - away, at + away):
            for cycle in jb.portrait(brute.case.given(value)).cycles:
                brute.learn(value, (float(cycle.x1_max) / brute.case.units.length, 0.0))
    if all(side.decided for side in sides) and sides[0].name == sides[1].name:
        report.wrong.append(f"nothing changes at {point!r}: {words(sides[0])}")


def _part(case: Case, orbit: np.ndarray, period: float, at: float, away: float) -> bool:
    """Whether the engine's runs from the saddle, at values on the two sides of a connection, are
    apart a time PARTED after its end."""
    upward = np.sign(orbit[1, 1])
    beyond = []
    for value in (at - away, at + away):
        osc = case.at(value)
        ends = [x for b in osc.belts for x in (b.lower, b.upper) if isfinite(x)]
        edge = min(ends, key=lambda x: abs(x - orbit[0, 0]))
        run = engine.simulate(osc, (edge, 1e-10 * upward), period + PARTED)
        beyond.append(run.y_end)
    return float(np.max(np.abs(np.subtract(*beyond)))) > 100 * away


def _starts_on_cycles(path: OwnPath, value: float) -> list[tuple[float, float]]:
    """A state on each cycle of `scan` at a value."""
    return [start for *_, start in path.cycles(value)]


def _start_on(loop, length: float) -> tuple[float, float]:
    """The state of a loop with the largest x1, times `length`."""
    rows = np.asarray(loop.entries)[np.asarray(loop.used)]
    x1, x2 = (rows[int(np.argmax(rows[:, 0]))] * length).tolist()
    return x1, x2


def words(label: Label) -> str:
    cycles = [(cycle.modes, cycle.place.round(6).tolist()) for cycle in label.cycles]
    return f"rests {label.rests} cycles {cycles}"


def case_of(seed: int, number: int) -> Case:
    """The path of a case number; every other one is rational."""
    kinds = structures(np.random.default_rng(seed), PROGRAMS)
    rng = np.random.default_rng((seed, number))
    for _ in range(DRAWS):
        case = random_path(rng, kinds[number // 2 % len(kinds)], rational=number % 2 == 1)
        if _changes(case):
            break
    return replace(case, units=drawn(rng, exact=case.kind == "rational"))


def _changes(case: Case) -> bool:
    """Whether labels change along a path, by a few runs."""
    values = np.linspace(*case.span, COARSE + 2)[1:-1] + 1e-3 * (case.span[1] - case.span[0])
    names = set()
    for value in values.tolist():
        names.add(label_of(case.at(value), [(3.0, 0.0)]).name)
    return len(names) > 1


def outcome(options, number: int) -> Outcome:
    """Compares along one path."""
    case = case_of(options.seed, number)
    report = check(case, options.seed + number)
    unexplained = [float(p.value) for p in report.points if p.kind == "Unexplained"]
    one = Outcome(
        f"{case.kind} {case.parameter} {case.span}: {len(report.points)} points, "
        f"{report.changes} changes, {report.labels} labels, {report.undecided} undecided, "
        f"{report.seconds[0]:.1f} + {report.seconds[1]:.1f} s",
        report.wrong,
    )
    if unexplained:
        one.notes.append(f"unexplained at {unexplained}")
    if report.wrong or unexplained:
        one.notes.append(f"{case.oscillator!r}\n{case.units}")
    one.counts.update(
        points=len(report.points),
        unexplained=len(unexplained),
        changes=report.changes,
        labels=report.labels,
        undecided=report.undecided,
    )
    return one
