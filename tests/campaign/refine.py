"""Guesses beside points of `scan`: whether `refine` finds the points from there.

Along random paths, those of the campaign `paths`, `scan` finds points. From guesses on either side
of each point, at several distances, `refine` solves its condition, as a user would. The result is
right if it is the point, or another one of that kind that is no farther from the guess: between
both, or closer on the other side of the guess. Another point has to be confirmed by `scan` on a
short path across it, or by `bifurcation_diagram`, which also has points of unstable cycles.

`refine` also runs on the mirror image of the oscillator: x1 and x2 with opposite signs, and the
belts in reverse order. Both results have to agree.
"""

import time
from dataclasses import fields, replace

import jaxbelt as jb
from jaxbelt.results import Status

from . import paths
from .outcome import Outcome

#: Distances of the guesses from the points.
AWAY = (1e-3, 1e-2, 3e-2)
#: Largest difference of two values of one point: both are solved for to rounding, which some
#: systems amplify.
SAME = 1e-7
#: Verdicts that count as right.
GOOD = ("found", "between", "nearer")


def outcome(options, number: int) -> Outcome:
    """Runs `refine` beside all points of one path."""
    case = paths.case_of(options.seed, number)
    middle = case.given(0.5 * sum(case.span))
    known = [p for p in jb.scan(middle, case.where, case.given_span) if p.status == Status.OK]
    known = [_in_engines(case, point) for point in known]
    one = Outcome(f"{case.parameter}, {len(known)} points")
    image = mirror_image(case)
    for point in known:
        for guess in _guesses(case, float(point.value)):
            osc = case.given(guess)
            begun = time.perf_counter()
            found = _in_engines(case, jb.refine(point.condition, osc, where=case.where))
            seconds = time.perf_counter() - begun
            one.wrong += _unlike(case, image, point.condition, guess, found)
            verdict = _verdict(case, point, guess, found)
            one.counts[f"{verdict} from {abs(guess - float(point.value)):.3f}"] += 1
            one.counts["calls"] += 1
            one.counts["right"] += verdict in GOOD
            one.largest["seconds"] = max(one.largest.get("seconds", 0.0), seconds)
            if verdict not in GOOD:
                told = one.wrong if verdict == "wrong" else one.notes
                told.append(f"{verdict}: {point.condition} from {guess!r}: {found!r}")
                told.append(f"    {point!r}\n    {case.oscillator!r}\n    {case.units}")
    return one


def said(counts, largest) -> list[str]:
    lines = [f"{name}: {n}" for name, n in sorted(counts.items()) if " from " in name]
    share = 100 * counts["right"] / max(counts["calls"], 1)
    lines.append(f"{counts['right']} of {counts['calls']} calls right ({share:.2f}%)")
    return [*lines, f"the longest, compilation included, {largest.get('seconds', 0.0):.1f} s"]


def _in_engines(case: paths.Case, point):
    """A point with its value and error in the engine's units."""
    return replace(point, value=point.value / case.measured, error=point.error / case.measured)


def _guesses(case: paths.Case, value: float) -> list[float]:
    """Values beside that of a point at which the oscillator is possible."""
    every = [value + side * away for away in AWAY for side in (-1, 1)]
    return [guess for guess in every if paths.is_possible(case.at(guess))]


def _verdict(case: paths.Case, point, guess: float, found) -> str:
    """Returns "found", "between", "nearer", "wrong", or "none" where the status is not OK."""
    if found.status != Status.OK:
        return "none"
    at, value = float(point.value), float(found.value)
    if abs(value - at) <= SAME + float(point.error) + float(found.error):
        return "found"
    if abs(value - guess) > abs(at - guess):
        return "wrong"
    # Another call has to find it, too; its kind may differ where two things happen at once.
    ends = (value - 2e-3) * case.measured, (value + 1.9e-3) * case.measured
    path = case.given(guess), case.where, ends
    calls = jb.scan, lambda *path, **options: jb.bifurcation_diagram(*path, **options).points
    if not any(_is_among(case, value, call(*path, resolution=16)) for call in calls):
        return "wrong"
    return "between" if (value - guess) * (at - guess) > 0 else "nearer"


def _is_among(case: paths.Case, value: float, points) -> bool:
    near = SAME * case.measured
    return any(
        p.status == Status.OK and abs(p.value - value * case.measured) < near for p in points
    )


# --- mirror images --------------------------------------------------------------------------------

#: Numbers that change sign in the mirror image.
_TURNED = ("velocity", "lower", "upper")


def mirror_image(case: paths.Case) -> paths.Case:
    """The path whose motions are those of the given one with -x1 and -x2, and with the belts in
    reverse order. Velocities and edges have the opposite sign."""
    belts = [
        replace(belt, velocity=-belt.velocity, lower=-belt.upper, upper=-belt.lower)
        for belt in reversed(case.oscillator.belts)
    ]
    number, name = case.parameter
    osc = replace(case.oscillator, belts=tuple(belts))
    other = {"lower": "upper", "upper": "lower"}.get(name, name)
    first, last = (_mirrored_value(case, end) for end in case.span)
    parameter = (-1 if number < 0 else len(belts) - 1 - number, other)
    return replace(case, oscillator=osc, parameter=parameter, span=tuple(sorted((first, last))))


def _mirrored_value(case: paths.Case, value: float) -> float:
    return -value if case.parameter[1] in _TURNED else value


def mirrored_condition(condition, count: int):
    """The condition for the mirror image of an oscillator with `count` belts."""

    def turned(value):
        if isinstance(value, tuple):
            return tuple(sorted(count - 1 - one for one in value))
        return count - 1 - value if type(value) is int else value

    own = {one.name: getattr(condition, one.name) for one in fields(condition)}
    return type(condition)(**{name: turned(value) for name, value in own.items()})


def _unlike(case: paths.Case, image: paths.Case, condition, guess: float, found) -> list[str]:
    """Lines on the result for the mirror image, if it differs from `found`; else none."""
    value = _mirrored_value(case, guess)
    osc = image.given(value)
    condition = mirrored_condition(condition, len(osc.belts))
    other = _in_engines(image, jb.refine(condition, osc, where=image.where))
    if found.status == other.status:
        away = abs(_mirrored_value(case, float(other.value)) - float(found.value))
        if found.status != Status.OK or away <= SAME + float(found.error) + float(other.error):
            return []
    told = f"not as its mirror image: from {guess!r}: {found!r}"
    return [told, f"    {condition} from {value!r}: {other!r}\n    {osc!r}"]
