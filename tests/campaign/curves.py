"""Curves in two parameters, against the engine's labels on both sides of their rows.

Along random paths, those of the campaign `paths`, `scan` finds points. One of them is followed in
the parameter of the path and a second one, drawn at random. On both sides of some of its rows,
along the parameter most transverse to it, the engine must have different labels; it starts from
many states, from the row's cycle, and from all cycles that `portrait` finds on both sides. With the
parameters in the other order the curve must be the same, with the same ends.
"""

import jax
import numpy as np

import jaxbelt as jb

from . import package, paths
from .outcome import Outcome

#: Number of rows checked on a curve, and distance of both sides from a row, in units of the spans.
ROWS, BESIDE = 5, 2e-3
#: Width of the second parameter's span over the parameter's size, and smallest such size.
WIDTH, LEAST = 0.3, 0.1
#: Rows of one curve that are farther from the chords of another one, in units of the spans, are
#: not on it: chords of bent curves are off by a tenth of a step.
OFF = 3e-3
#: Points of kinds at which no attractor and no equilibrium changes.
SILENT = frozenset({"HopfAtInfinity", "SaddleConnection"})
#: After so many paths compiled programs are dropped: a thousand of them fill the memory.
TOGETHER = 10


def outcome(options, number: int) -> Outcome:
    """Follow one point and look at both sides of some rows."""
    case = paths.case_of(options.seed, number)
    if number % TOGETHER == 0:
        jax.clear_caches()
    rng = np.random.default_rng((options.seed, number, 2))
    osc = package.oscillator(case.at(0.5 * sum(case.span)))
    points = [p for p in jb.scan(osc, case.where, case.span) if p.status == jb.Status.OK]
    points = [p for p in points if p.kind not in SILENT]
    one = Outcome(f"{case.parameter}, {len(points)} points")
    if not points:
        return one
    point = points[rng.integers(len(points))]
    other, span = _second(case, rng)
    curve = jb.bifurcation_curve(point, (case.where, paths.selector(other)), (case.span, span))
    one.line += f", {other}: {curve!r}"
    one.counts["curves"] += 1
    spans = np.array([case.span, span])
    swapped = jb.bifurcation_curve(point, (paths.selector(other), case.where), (span, case.span))
    off = max(
        _off(curve.path, swapped.path[:, ::-1], spans),
        _off(swapped.path[:, ::-1], curve.path, spans),
    )
    alike = off < OFF and {*curve.ends} == {*swapped.ends}
    one.counts["in the other order the same" if alike else "in the other order another one"] += 1
    if not alike:
        both = f"{curve!r} {curve.ends}, {swapped!r} {swapped.ends}"
        where = f"{case.oscillator!r}, {case.parameter}, {other}, {spans.tolist()}"
        one.wrong.append(f"off by {off:.1e} in the other order: {both}\n    {where}")
    for row in sorted({int(row) for row in np.linspace(0, len(curve) - 1, ROWS + 2)[1:-1]}):
        verdict, sides = _beside(case, other, curve, row, spans, rng)
        one.counts[verdict] += 1
        if verdict == "nothing changes":
            said = f"{verdict} at row {row}, {curve.values[row].tolist()}, of {curve!r}: {sides}"
            one.wrong.append(f"{said}\n    {case.oscillator!r}, {case.parameter}, {other}")
    return one


def _off(path: np.ndarray, other: np.ndarray, spans: np.ndarray) -> float:
    """The largest distance of the points of a path from the chords of another one."""
    at, chords = (one / np.ptp(spans, axis=1) for one in (path, other))
    if len(chords) < 2:
        return float(np.max(np.hypot(*(at - chords[0]).T)))
    begin, along = chords[:-1], np.diff(chords, axis=0)
    away = at[:, None] - begin
    part = np.sum(away * along, axis=-1) / np.maximum(np.sum(along**2, axis=-1), 1e-300)
    away -= np.clip(part, 0, 1)[..., None] * along
    return float(np.max(np.min(np.linalg.norm(away, axis=-1), axis=1)))


def _second(case: paths.Case, rng) -> tuple[tuple[int, str], tuple[float, float]]:
    """Another parameter, and a span of it around its value."""
    osc = case.oscillator
    belts = range(len(osc.belts))
    able = [(-1, "damping"), *((i, name) for i in belts for name in ("velocity", "load"))]
    able = [parameter for parameter in able if parameter != case.parameter]
    while True:
        parameter = able[rng.integers(len(able))]
        value = paths.value_of(osc, parameter)
        half = 0.5 * WIDTH * max(abs(value), LEAST)
        ends = value - half, value + half
        if all(paths.is_possible(paths.with_value(osc, parameter, end)) for end in ends):
            return parameter, ends


def _beside(case, other, curve, row, spans, rng):
    """Whether labels differ on the two sides of a row, and the labels."""
    sizes = spans[:, 1] - spans[:, 0]
    near = curve.values[[max(row - 1, 0), min(row + 1, len(curve) - 1)]]
    across = int(np.argmin(np.abs(near[1] - near[0]) / sizes))
    values = curve.values[row]
    held = ((other, values[1]), (case.parameter, values[0]))[across]
    free = (case.parameter, other)[across]
    middle = paths.with_value(case.oscillator, held[0], float(held[1]))
    line = paths.Case(middle, free, tuple(spans[across].tolist()), case.kind)
    away = BESIDE * sizes[across]
    brute = paths.Brute(line, rng)
    ends = float(values[across] - away), float(values[across] + away)
    starts = [(float(x), 0.0) for x in curve.places[row, :2] if np.isfinite(x)]
    if not all(paths.is_possible(line.at(end)) for end in ends):
        return "at the rim", ""
    sides = [brute.look(end, starts) for end in ends]
    for end in ends:
        for cycle in jb.portrait(line.given(end)).cycles:
            brute.learn(end, (float(cycle.x1_max), 0.0))
    for label, end in ((sides[0], ends[1]), (sides[1], ends[0])):
        for cycle in list(label.cycles):
            brute.learn(end, cycle.state)
    if not all(side.decided for side in sides):
        return "undecided", ""
    changes = sides[0].name != sides[1].name
    return ("changes" if changes else "nothing changes"), paths.words(sides[0])
