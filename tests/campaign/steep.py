"""Steep laws: attractors of oscillators whose friction falls within 1e-1 to 1e-4 of a belt's speed.

Half of the oscillators have round numbers. The attractor of each is found by `find_cycle`, by
`sweep` and by the engine. A case of this campaign is a batch of oscillators of one structure; each
half is one call of the sweep. Two of each batch are scanned along the velocity of a belt, twice,
the second time warm; a point without a name has to state the motions on both sides.
"""

import functools
import json
import time
from dataclasses import replace

import numpy as np

import jaxbelt as jb

from . import cases, compare, package, units
from .engine import Belt, Oscillator
from .outcome import Outcome

#: Laws of the belts, one for each belt.
STRUCTURES = (("peak",), ("conti",), ("stribeck",), ("table",), ("peak", "stribeck"))
#: Oscillators in a batch.
BATCH = 20
TOL = 1e-8


def settings(options):
    return dict(runs=options.runs)


def numbers(options):
    return range(-(-options.runs // BATCH))


def outcome(options, number):
    laws = STRUCTURES[number % len(STRUCTURES)]
    rng = np.random.default_rng((options.seed, number))
    count = min(BATCH, options.runs - number * BATCH)
    one = Outcome(f"{count} oscillators with {' and '.join(laws)}")
    drawn = [case(rng, laws, is_round=i % 2 == 0) for i in range(count)]
    for is_round, some in ((True, drawn[::2]), (False, drawn[1::2])):
        own = units.drawn(np.random.default_rng((options.seed, number, is_round)), exact=is_round)
        _compare([replace(one_, units=own) for one_ in some], one)
        _scan(some[0], one)
    return one


def _scan(case_, one):
    """Scans one oscillator, from half of the velocity of its first belt to twice that."""
    osc = package.oscillator(case_.oscillator)
    velocity = float(osc.belts[0].velocity)
    span = tuple(sorted((0.5 * velocity, 2.0 * velocity)))
    for _ in range(2):
        began = time.monotonic()
        points = jb.scan(osc, _first_velocity, span)
        spent = time.monotonic() - began
    one.counts["scans"] += 1
    one.largest["seconds of a scan, warm"] = spent
    for point in points:
        unnamed = point.kind == "Unexplained"
        one.counts["points without a name" if unnamed else "points"] += 1
        if unnamed and (int(point.status) != jb.Status.UNEXPLAINED or len(point.sides) != 2):
            one.wrong.append(f"{point!r}\n{package.as_code(case_)}")


def _first_velocity(osc):
    return osc.belts[0].velocity


def _compare(batch, one):
    swept, found = package.labels(batch, TOL), package.cycles(batch)
    for case_, *told in zip(batch, swept, found):
        verdicts = {}
        for by, label in zip(("sweep", "find_cycle"), told):
            again = functools.partial(_again, by)
            verdicts[by], mine = compare.judge_label(case_, label, TOL, again)
        for by, verdict in verdicts.items():
            one.counts[f"{case_.kind}|{verdict}|{by}"] += 1
        one.counts[f"kind|{mine.kind}"] += 1
        if not set(verdicts.values()) <= set(compare.GOOD):
            labels = {by: vars(label) for by, label in zip(verdicts, told)}
            told = dict(verdicts=verdicts, **labels, engine=vars(mine), case=case_.to_json())
            one.wrong.append(f"{package.as_code(case_)}\n  {json.dumps(told)}")


def _again(by, case, tol):
    return (package.labels([case], tol) if by == "sweep" else package.cycles([case]))[0]


def case(rng, laws, *, is_round):
    """An oscillator of belts with these laws, and a start beside or on one of the boundaries."""

    def number(low, high):
        value = rng.uniform(low, high)
        return round(value, 1 if high >= 1 else 2) if is_round else value

    belts, low = [], 0.02
    for law in laws:
        velocity = max(number(low, 0.5), low) * (1 if rng.random() < 0.8 else -1)
        scale = rng.integers(-4, 0) if is_round else rng.uniform(-4, -1)
        width = float(10.0**scale) * abs(velocity)
        static = number(0.6, 1.6)
        kinetic = static * number(0.5, 0.9)
        load = 1.0 if rng.random() < 0.5 else number(0.5, 2.0)
        forms = {
            "peak": (static, kinetic, width, number(0.0, 0.4)),
            "conti": (static, kinetic, 1 / width, 0.0),
            "stribeck": (static, kinetic, width),
            "table": (1.0, 1 / width),
        }
        belts.append(Belt(velocity, (law, *forms[law]), load))
    damping = max(number(0.0, 0.3), 0.01) if rng.random() < 0.5 else 0.01
    osc = Oscillator(damping, tuple(belts))
    fastest = max(abs(belt.velocity) for belt in belts)
    if rng.random() < 0.7:
        start = number(-2.0, 2.0), belts[0].velocity
    else:
        start = number(-2.0, 2.0), number(-1.0, 1.0) * 2 * fastest
    return cases.Case(osc, start, 50.0, "round" if is_round else "random")
