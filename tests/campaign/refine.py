"""Guesses beside points that `scan` knows: whether `refine` finds them from there.

Along random paths, those of the campaign `paths`, `scan` finds points. From either side of each, at
several distances, `refine` is asked for its condition, as a user would. It is right where it gives
the point, or another one of that kind that is no farther from the guess: one between the two, or
one that is nearer on the other side of the guess. Whether something happens there `scan` has to
say, too, on a short path across it.
"""

import time
from collections import Counter

import numpy as np

import jaxbelt as jb
from jaxbelt.results import Status

from . import package, paths

#: How far the guesses are from the points.
AWAY = (1e-3, 1e-2, 3e-2)
#: Two values of one point differ by less: both are solved for to rounding, some of them in systems
#: that amplify it.
SAME = 1e-7
#: What counts as right.
GOOD = ("found", "between", "nearer")


def run(seed: int, calls: int, *, first: int = 0, out=print) -> int:
    """Ask so many times, and say how it went; returns how many answers are wrong."""
    told, seconds, number = Counter(), [], first
    while sum(told.values()) < calls:
        case = paths.case_of(seed, number)
        middle = package.oscillator(case.at(0.5 * sum(case.span)))
        known = [p for p in jb.scan(middle, case.where, case.span) if p.status == Status.OK]
        for point in known:
            for guess in _guesses(case, float(point.value)):
                osc = package.oscillator(case.at(guess))
                begun = time.perf_counter()
                found = jb.refine(point.condition, osc, where=case.where)
                seconds.append(time.perf_counter() - begun)
                verdict = _verdict(case, point, guess, found)
                told[verdict, abs(round(guess - float(point.value), 9))] += 1
                if verdict not in GOOD:
                    out(f"path {number} {case.parameter} from {guess!r}: {verdict} {found!r}")
                    out(f"    {point!r}\n    {case.oscillator!r}")
        out(f"path {number}: {len(known)} points, {sum(told.values())} calls")
        number += 1
    for (verdict, away), count in sorted(told.items()):
        out(f"{verdict} from {away:g}: {count}")
    total, right = sum(told.values()), sum(n for (v, _), n in told.items() if v in GOOD)
    median, longest = np.median(seconds), max(seconds)
    out(f"{right} of {total} right ({100 * right / total:.2f}%), paths {first} to {number - 1}")
    out(f"a call takes {1e3 * median:.0f} ms, compilation included at most {longest:.1f} s")
    return sum(n for (verdict, _), n in told.items() if verdict == "wrong")


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
