"""Maps of `region_map` for classes (c) and (d): faults, and curves that are missing.

Faults of a map are: neighbouring cells with different motions but no curve within one cell; curves
that bound nothing, because motions are the same on both sides of their rows; ends of curves without
a name; rows and special points with a residual that is not small; and rows whose mirror image is no
point of the mirrored oscillator: x1 to -x1 exchanges (nu0, nu1) with (-nu1, -nu0) and (sigma0,
sigma1) with (-sigma1, -sigma0), where both belts are alike. In a map that is its own mirror image
the mirror images of special points must be special points. In cells drawn at random the engine must
find the equilibria and the cycles that the name of the region states.
"""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import jaxbelt as jb
from jaxbelt.bifurcations import cells
from jaxbelt.bifurcations.bounds import Bounds, neighbours_that_differ
from jaxbelt.bifurcations.cells import motions_in_cells
from jaxbelt.bifurcations.labels import Label
from jaxbelt.bifurcations.regions import varied_by_names
from jaxbelt.model.own_units import in_own_units
from jaxbelt.numerics.continuation import Stop

from . import package, paths
from .outcome import Outcome

#: Numbers of cells along the axes, different so that no cell lies where both parameters are equal.
CELLS = 64, 65
#: Number of rows checked on a curve; distance of both sides from a row, in units of the map's side.
ROWS, BESIDE = 7, 2e-3
#: Largest residual of a row; largest distance of a mirror image from the point refined there.
SMALL, SAME = 1e-8, 1e-9
#: Largest residual of a special point at the end of a curve, which may be extrapolated.
END = 1e-2
#: Number of cells checked with the engine, and of its starts in each.
ASKED, STARTS = 150, 24
#: Largest distance of the guesses from the mirror image of a row.
ASIDE = 1e-4

NU, SIGMA = (-0.7, 0.7), (-1.0, 1.0)


@dataclass(frozen=True)
class Plane:
    """A map. numbers: (p, q) to (nu0, nu1, sigma0, sigma1); axes: (from, to) by name."""

    name: str
    numbers: Callable
    axes: dict[str, tuple[float, float]]

    def make(self, **values):
        return jb.presets.class_d(*self.numbers(*values.values()))

    def mirrored(self, p, q):
        nu0, nu1, sigma0, sigma1 = self.numbers(p, q)
        return jb.presets.class_d(-nu1, -nu0, -sigma1, -sigma0)


def _velocities(name: str, sigma0: float, sigma1: float) -> Plane:
    return Plane(name, lambda p, q: (p, q, sigma0, sigma1), {"nu0": NU, "nu1": NU})


PLANES = (
    *(_velocities(f"(c) sigma = {sigma:g}", sigma, sigma) for sigma in (-0.5, 0.0, 0.3)),
    Plane("(c) nu1 = 0.3", lambda p, q: (p, 0.3, q, q), {"nu0": NU, "sigma": SIGMA}),
    *(_velocities(f"(d) {ends}", *ends) for ends in ((-0.3, 0.3), (-1.0, 0.2), (0.2, 0.9))),
)


def differences(plane: Plane, told: jb.RegionMap) -> tuple[Counter, list[str]]:
    """Counts of what was checked in a map, and its faults in words."""
    counts, wrong = Counter(curves=len(told.curves)), []
    counts["special points"] = sum(len(curve.special) for curve in told.curves)
    variation = varied_by_names(plane.make, told.names, told.values)
    pairs = _boundaries(plane, told)
    counts["boundaries"] = len(pairs)
    bounds = Bounds(variation, told.values, 0.01)
    bounds.curves = list(told.curves)
    for row, gap in zip(pairs, bounds.away(pairs)):
        if gap > 1.0:
            wrong.append(f"no curve within a cell: {bounds.pair(row)}")
    wrong += [f"no curve between: {pair}" for pair in told.uncovered]
    for curve in told.curves:
        counts["ends"] += 2
        for end in (0, -1):
            if curve.ends[end] not in (Stop.LEFT_SPAN, Stop.CLOSED) and not curve.is_named(end):
                wrong.append(f"end without a name: {curve}, {curve.ends[end].value}")
        if np.max(curve.residual) > SMALL:
            wrong.append(f"residual {np.max(curve.residual):.1e}: {curve}")
        if not _bounds_something(plane, told, curve):
            wrong.append(f"bounds nothing: {curve}")
        wrong += _not_mirrored(plane, curve, counts)
        wrong += _not_solved(curve)
    wrong += _without_image(plane, told)
    wrong += _not_the_engines(plane, told, counts)
    return counts, wrong


def in_one_unit(make: Callable[..., jb.Oscillator]) -> Callable[..., jb.Oscillator]:
    """A function like `make` whose oscillators are in own units, all with the length 1."""
    return lambda **values: in_own_units(make(**values), 1.0)


def _boundaries(plane: Plane, told: jb.RegionMap) -> np.ndarray:
    """Pairs of neighbouring cells that differ, in the form of `bounds.neighbours_that_differ`."""
    grid = np.meshgrid(*told.values, indexing="ij")
    points = np.column_stack([axis.ravel() for axis in grid])
    found = motions_in_cells(in_one_unit(plane.make), told.names, points)
    return neighbours_that_differ(found.motions.reshape(grid[0].shape), told.on_line)


def _some_rows(curve: jb.BifurcationCurve) -> list[int]:
    """Numbers of rows spread along a curve, its ends left out."""
    inner = np.linspace(0, len(curve) - 1, ROWS + 2)[1:-1]
    return sorted({int(row) for row in inner})


def _bounds_something(plane: Plane, told: jb.RegionMap, curve: jb.BifurcationCurve) -> bool:
    """Whether motions differ on the two sides of at least one of some rows of a curve."""
    if len(curve) < 3:
        return True
    sides = np.array([along[-1] - along[0] for along in told.values])
    points = []
    for row in _some_rows(curve):
        chord = (curve.values[min(row + 1, len(curve) - 1)] - curve.values[max(row - 1, 0)]) / sides
        normal = np.array([-chord[1], chord[0]]) / np.linalg.norm(chord)
        points += [curve.values[row] + side * BESIDE * normal * sides for side in (-1, 1)]
    motions = motions_in_cells(in_one_unit(plane.make), told.names, np.array(points)).motions
    return bool(
        np.any((motions[::2] != motions[1::2]) & (motions[::2] >= 0) & (motions[1::2] >= 0))
    )


def _not_mirrored(plane: Plane, curve: jb.BifurcationCurve, counts: Counter) -> list[str]:
    """Rows whose mirror image is no point of the mirrored oscillator, in words."""
    wrong = []
    for row in _some_rows(curve)[1::3]:
        condition = _for_mirror(curve.classes[row], curve.condition)
        chord = np.abs(curve.values[min(row + 1, len(curve) - 1)] - curve.values[max(row - 1, 0)])
        counts["mirrored"] += 1
        # Along both parameters: beside a belt at rest rounding may hide the point along one.
        said = []
        for free in np.argsort(chord).tolist():
            said += _images(plane, condition, curve.values[row], free)
            if any(away <= SAME for away, _ in said):
                break
        else:
            wrong.append(f"not mirrored: {curve} at {curve.values[row]}: {said}")
    return wrong


def _not_solved(curve: jb.BifurcationCurve) -> list[str]:
    """Special points whose residual is too large to be a solution, in words."""
    order = curve.in_order()
    ends = order[0], order[-1]
    return [
        f"no special point: {point} of {curve}"
        for point in curve.special
        if not point.residual < (END if any(point is end for end in ends) else SMALL)
    ]


def _not_the_engines(plane: Plane, told: jb.RegionMap, counts: Counter) -> list[str]:
    """Cells whose region has other equilibria or cycles than the engine finds, in words."""
    rng, wrong = np.random.default_rng(len(told.curves)), []
    for cell in rng.integers(told.label.size, size=ASKED).tolist():
        place = np.unravel_index(cell, told.label.shape)
        at = [float(along[i]) for along, i in zip(told.values, place)]
        made = plane.make(**dict(zip(told.names, at, strict=True)))
        osc = package.engines(made)
        starts = np.column_stack([rng.uniform(-3, 3, STARTS), rng.uniform(-1.5, 1.5, STARTS)])
        # The engine also starts on cycles of the package to confirm them, because from few starts
        # it need not find them.
        known = [(float(one.x1_max), 0.0) for one in jb.portrait(made).cycles]
        seen = paths.label_of(osc, [*map(tuple, starts), *known])
        if not seen.decided or told.on_line[place]:
            counts["cells undecided"] += 1
            continue
        counts["cells"] += 1
        name = cells.region_name(made, as_label(seen))
        if name != told.label[place]:
            wrong.append(f"at {at} {told.label[place]}, the engine {name}: {paths.words(seen)}")
    return wrong


def as_label(seen: paths.Label) -> Label:
    """The engine's label as the package's."""
    return Label(seen.rests, tuple(sorted(cycle.modes for cycle in seen.cycles)))


def _without_image(plane: Plane, told: jb.RegionMap) -> list[str]:
    """Special points whose image is missing from a map that is its own mirror image, in words."""
    p, q = (axis[len(axis) // 3] for axis in told.values)
    numbers = plane.numbers(p, q)
    if numbers[2:] != (-numbers[3], -numbers[2]) or [*told.names] != ["nu0", "nu1"]:
        return []
    points = [point for curve in told.curves for point in curve.special]
    at = np.array([point.values for point in points])
    wrong = []
    for point, image in zip(points, -at[:, ::-1]):
        away = np.max(np.abs(image - at), axis=1)
        alike = [i for i, other in enumerate(points) if other.kind == point.kind]
        errors = np.array([max(point.residual, points[i].residual, SMALL) for i in alike])
        if not np.any(away[alike] < 10 * errors):
            wrong.append(f"no mirror image among the special points: {point}")
    return wrong


def _images(plane: Plane, condition, values: np.ndarray, free: int):
    """Yields (distance, point): points refined beside the mirror image of a row, along p or q."""
    held, at = float(values[1 - free]), float(values[free])

    def make(value):
        return plane.mirrored(*((value, held) if free == 0 else (held, value)))

    # A cycle may be there on one side only.
    for side in (1, -1):
        point = jb.refine(condition, make, at=at + side * _aside(plane, *values))
        is_found = int(point.status) == jb.Status.OK
        yield abs(float(point.value) - at) if is_found else np.inf, point


def _aside(plane: Plane, p: float, q: float) -> float:
    """Distance of guesses from a row, so small that no belt comes to rest, or to the velocity of
    the other belt, in between."""
    nu0, nu1, *_ = plane.numbers(p, q)
    gaps = np.abs([nu0, nu1, nu0 - nu1])
    return min(ASIDE, 0.5 * float(np.min(gaps, initial=np.inf, where=gaps > SAME)))


def _for_mirror(kind: type, condition):
    """The condition of a row for the mirror image, in which belts are exchanged."""
    names = [name for name in ("belt", "belts") if hasattr(condition, name)]
    belts = tuple(1 - belt for belt in condition.belts_concerned)
    return kind(belts[0] if names == ["belt"] else belts) if names else kind()


def numbers(options) -> range:
    return range(len(PLANES))


def outcome(options, number: int) -> Outcome:
    """Draw a map twice, the second time warm, and compare it."""
    plane = PLANES[number]
    axes = {name: np.linspace(*ends, n) for (name, ends), n in zip(plane.axes.items(), CELLS)}
    spent = []
    for _ in range(2):
        began = time.monotonic(), time.process_time()
        told = jb.region_map(plane.make, axes)
        spent.append((time.monotonic() - began[0], time.process_time() - began[1]))
    (cold, _), (warm, processor) = spent
    counts, wrong = differences(plane, told)
    line = (
        f"{plane.name}: {dict(counts)}; {cold:.0f} s, then {warm:.0f} s ({processor:.0f} s of "
        "processors)"
    )
    return Outcome(line, wrong, counts=counts, largest={"seconds, warm": warm})


def said(counts, largest) -> list[str]:
    return [f"{dict(counts)}, the longest {largest.get('seconds, warm', 0.0):.0f} s, warm"]
