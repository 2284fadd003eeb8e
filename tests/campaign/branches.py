"""Branches of periodic forced motions: `bifurcation_diagram` against the engine, row by row.

A branch of a random or round oscillator with one force is followed from the motion of `find_cycle`,
along the force's frequency or amplitude, or a belt's velocity. The engine starts at the state of
each row and has to return to it after the row's periods; its events are those of the row's motion;
differences of its runs decide whether the row is stable. Then

- two successive rows have the same events and the same stability, or there is a bifurcation point
  between them, or the branch turns back;
- at each point the events or the stability change, or the branch turns back or ends;
- a run from a stable row reaches the next row, if that is stable, too, and the branch goes on.
"""

import functools
from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np

import jaxbelt as jb

from . import forced_cases, forced_package
from .outcome import Outcome

#: Structures without edges and with them, with one belt and two; in the last two the second belt is
#: the mirror image of the first, so that there are symmetric motions.
STRUCTURES = tuple(
    forced_cases.Structure(laws, edges, 1, (False,) * len(laws), (False,) * len(laws))
    for laws, edges in (
        (("cubic",), False),
        (("conti",), False),
        (("coulomb",), False),
        (("stribeck",), True),
        (("conti", "coulomb"), False),
        (("conti",), True),
        (("coulomb", "coulomb"), True),
        (("stribeck", "stribeck"), False),
        (("coulomb", "coulomb"), True),
    )
)
SYMMETRIC = len(STRUCTURES) - 2
#: Largest error of the engine's return to a row, times the largest multiplier where that is > 1.
SAME = 1e-8
#: Distance from 1 within which the largest modulus of the multipliers does not decide stability.
NEUTRAL = 1e-4
#: Number of rows of a diagram.
ROWS = 48
#: Number of periods of a motion within which a run must reach it, and the largest distance then.
SETTLES, SETTLED = 400, 1e-5
#: Accuracy of the engine's multipliers, which are differences of runs with the same events.
GOOD = 1e-3

PARAMETERS = ("frequency", "amplitude", "velocity")


@functools.cache
def _selector(parameter):
    if parameter == "velocity":
        return lambda osc: osc.belts[0].velocity
    return lambda osc: getattr(osc.forcing[0], parameter)


def _at(osc, parameter, value):
    if parameter == "velocity":
        return replace(osc, belts=(replace(osc.belts[0], velocity=value), *osc.belts[1:]))
    return replace(osc, forces=(replace(osc.forces[0], **{parameter: value}),))


def settings(options) -> dict:
    return {}


def numbers(options) -> range:
    return range(options.runs)


def outcome(options, number: int) -> Outcome:
    rng = np.random.default_rng((options.seed, number))
    structure = STRUCTURES[number % len(STRUCTURES)]
    case = forced_cases.case(rng, structure)
    osc, parameter = case.oscillator, str(rng.choice(PARAMETERS))
    if number % len(STRUCTURES) >= SYMMETRIC:
        belt = osc.belts[0]
        image = replace(belt, velocity=-belt.velocity, lower=-belt.upper, upper=-belt.lower)
        osc, parameter = replace(osc, belts=(belt, image)), str(rng.choice(PARAMETERS[:2]))
    value = osc.belts[0].velocity if parameter == "velocity" else vars(osc.forces[0])[parameter]
    off = 0.3 if parameter == "velocity" else 0.25 * value
    given = forced_package.oscillator(osc)
    motion = jb.find_cycle(given, case.y0)
    one = Outcome(f"{structure.laws}, {parameter} around {value:.4g}: {motion.status}")
    if int(motion.status) != jb.Status.OK or not isinstance(motion, jb.PeriodicMotion):
        one.counts["no periodic motion"] += 1
        return one
    span = (value - off, value + off)
    found = jb.bifurcation_diagram(given, _selector(parameter), span, rows=ROWS, start=motion)
    one.counts["branches"] += len(found.branches)
    one.line += f", {len(found.points)} points: {[p.kind for p in found.points]}"
    where = f"{osc!r}, {parameter} over {span}, from {case.y0}"
    pairs = []
    for branch in found.branches:
        rows = [_looked_at(osc, parameter, *row) for row in zip(branch.values, branch.cycles)]
        for row, told in zip(rows, branch.stable, strict=True):
            said = _verdict(row, bool(told))
            one.counts[f"row: {said}"] += 1
            if said.startswith("wrong"):
                one.wrong.append(f"{said} at {row['value']!r}: {row}\n    {where}")
        for i, (before, after) in enumerate(pairwise(rows)):
            turns = _turns(branch.values, i)
            pairs.append((before, after, turns, i in (0, len(rows) - 2)))
            if before["stable"] and after["stable"] and not turns:
                here, n = _at(osc, parameter, after["value"]), SETTLES * after["periods"]
                run = forced_cases.stroboscopic(here, before["start"], n)
                off = np.max(np.abs(np.subtract(run.y_end, after["start"])))
                one.counts["next row: " + ("reached" if off < SETTLED else "not reached")] += 1
                if not off < SETTLED:
                    ends = f"{before['value']!r} and {after['value']!r}"
                    one.notes.append(f"off by {off:.1e} between {ends}\n    {where}")
    _compare(one, pairs, found.points, where)
    return one


def _looked_at(osc, parameter, value, motion):
    """The engine's results for a row."""
    here, n = _at(osc, parameter, float(value)), int(motion.periods)
    start = np.asarray(motion.start)
    run = forced_cases.stroboscopic(here, start, n)
    try:
        radius = float(np.max(np.abs(np.linalg.eigvals(forced_cases.monodromy(here, start, n)))))
        finer = forced_cases.monodromy(here, start, n, h=1e-5)
        doubt = abs(radius - float(np.max(np.abs(np.linalg.eigvals(finer)))))
    except np.linalg.LinAlgError:
        radius, doubt = np.nan, np.inf
    return {
        "value": float(value),
        "start": start,
        "off": float(np.max(np.abs(np.subtract(run.y_end, start)))),
        "radius": radius,
        "doubt": doubt,
        "told": float(np.max(np.abs(np.asarray(motion.multipliers)))),
        "events": _least_rotation(run.sequence),
        "margin": run.margin,
        "stable": bool(motion.stable),
        "periods": n,
    }


def _least_rotation(sequence):
    turns = [sequence[i:] + sequence[:i] for i in range(len(sequence))]
    return min(turns, default=())


def _verdict(row, told):
    if not row["off"] < SAME * max(1.0, row["told"]):
        return "wrong: no periodic motion"
    if row["doubt"] > GOOD * (1 + row["radius"]):
        return "multipliers not known"
    if abs(row["radius"] - row["told"]) > 10 * GOOD * (1 + row["radius"]):
        return "wrong multipliers"
    if abs(row["radius"] - 1) < NEUTRAL + row["doubt"]:
        return "neutral"
    return "same" if told == (row["radius"] < 1) else "wrong stability"


def _turns(values, i):
    """Whether the branch turns back beside the rows i and i + 1."""
    ways = np.sign(np.diff(values[max(i - 1, 0) : i + 3]))
    return bool(np.any(ways != ways[0]))


def _changes(pair):
    before, after, turns, _ = pair
    changes = before["events"] != after["events"] or before["periods"] != after["periods"]
    return changes or before["stable"] != after["stable"] or turns


def _compare(one, pairs, points, where):
    """Assigns points to pairs of rows; records changes without a point and the reverse."""
    with_point = Counter()
    for point in points:
        if int(point.status) != jb.Status.OK:
            one.counts["points that failed"] += 1
            continue
        value, start = float(point.value), np.asarray(point.cycle.start)
        nearest = sorted((_distance(value, start, pair), i) for i, pair in enumerate(pairs))[:2]
        with_point.update(i for _, i in nearest)
        changes = any(_changes(pairs[i]) or pairs[i][3] for _, i in nearest)
        one.counts[f"{point.kind}: {'changes' if changes else 'nothing changes'}"] += 1
        if not changes:
            one.notes.append(f"nothing changes at {point!r}\n    {where}")
    for i, pair in enumerate(pairs):
        before, after = pair[:2]
        changes = before["events"] != after["events"] or before["stable"] != after["stable"]
        if changes and not with_point[i] and min(before["margin"], after["margin"]) > 1e-7:
            one.counts["changes without a point"] += 1
            what = f"{before['events']} to {after['events']}, {before['stable']} {after['stable']}"
            ends = f"{before['value']!r}, {after['value']!r}"
            one.notes.append(f"no point between {ends}: {what}\n    {where}")


def _distance(value, start, pair):
    """Distance of a point of the branch from the straight segment between two rows."""
    a, b = (np.array([row["value"], *row["start"]]) for row in pair[:2])
    at = np.array([value, *start])
    way = b - a
    part = np.clip(np.dot(at - a, way) / max(np.dot(way, way), 1e-300), 0.0, 1.0)
    return float(np.linalg.norm(at - a - part * way))


def said(counts, largest) -> list[str]:
    return [f"{n} {name}" for name, n in sorted(counts.items())]
