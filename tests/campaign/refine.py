"""Guesses beside points that `scan` knows: whether `refine` finds them from there.

Along random paths, those of the campaign `paths`, `scan` finds points. From either side of each, at
several distances, `refine` is asked for its condition, as a user would. It is right where it gives
the point, or another one of that kind that is no farther from the guess: one between the two, or
one that is nearer on the other side of the guess. Whether something happens there `scan` has to
say, too, on a short path across it.
"""

import time

import jaxbelt as jb
from jaxbelt.results import Status

from . import package, paths
from .outcome import Outcome

#: How far the guesses are from the points.
AWAY = (1e-3, 1e-2, 3e-2)
#: Two values of one point differ by less: both are solved for to rounding, some of them in systems
#: that amplify it.
SAME = 1e-7
#: What counts as right.
GOOD = ("found", "between", "nearer")


def settings(options) -> dict:
    return {}


def numbers(options) -> range:
    return range(options.runs)


def outcome(options, number: int) -> Outcome:
    """Ask beside all points of one path."""
    case = paths.case_of(options.seed, number)
    middle = package.oscillator(case.at(0.5 * sum(case.span)))
    known = [p for p in jb.scan(middle, case.where, case.span) if p.status == Status.OK]
    one = Outcome(f"{case.parameter}, {len(known)} points")
    for point in known:
        for guess in _guesses(case, float(point.value)):
            osc = package.oscillator(case.at(guess))
            begun = time.perf_counter()
            found = jb.refine(point.condition, osc, where=case.where)
            seconds = time.perf_counter() - begun
            verdict = _verdict(case, point, guess, found)
            one.counts[f"{verdict} from {abs(guess - float(point.value)):.3f}"] += 1
            one.counts["calls"] += 1
            one.counts["right"] += verdict in GOOD
            one.largest["seconds"] = max(one.largest.get("seconds", 0.0), seconds)
            if verdict not in GOOD:
                told = one.wrong if verdict == "wrong" else one.notes
                told.append(f"{verdict}: {point.condition} from {guess!r}: {found!r}")
                told.append(f"    {point!r}\n    {case.oscillator!r}")
    return one


def said(counts, largest) -> list[str]:
    lines = [f"{name}: {n}" for name, n in sorted(counts.items()) if " from " in name]
    share = 100 * counts["right"] / max(counts["calls"], 1)
    lines.append(f"{counts['right']} of {counts['calls']} calls right ({share:.2f}%)")
    return [*lines, f"the longest, compilation included, {largest.get('seconds', 0.0):.1f} s"]


def _guesses(case: paths.Case, value: float) -> list[float]:
    """Values beside that of a point at which there is an oscillator."""
    every = [value + side * away for away in AWAY for side in (-1, 1)]
    return [guess for guess in every if paths.is_possible(case.at(guess))]


def _verdict(case: paths.Case, point, guess: float, found) -> str:
    """found, between, nearer; wrong; or none."""
    if found.status != Status.OK:
        return "none"
    at, value = float(point.value), float(found.value)
    if abs(value - at) <= SAME + float(point.error) + float(found.error):
        return "found"
    if abs(value - guess) > abs(at - guess):
        return "wrong"
    # `scan` has to know it, too; by another name, where two things happen at once.
    osc, ends = package.oscillator(case.at(guess)), (value - 2e-3, value + 1.9e-3)
    beside = jb.scan(osc, case.where, ends, resolution=16)
    if not any(p.status == Status.OK and abs(p.value - value) < SAME for p in beside):
        return "wrong"
    return "between" if (value - guess) * (at - guess) > 0 else "nearer"
