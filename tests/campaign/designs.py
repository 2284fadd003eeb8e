"""`design` against the engine's attractor at the parameters that it returns.

One or two numbers of a random oscillator that sticks are changed by up to a tenth. The value of a
functional of the engine's cycle there is the target of a design from the unchanged oscillator. So a
solution exists, and at the returned one the engine's cycle, from the same start, has this value.
"""

import functools

import numpy as np

import jaxbelt as jb

from . import coverage, engine, package, paths, units
from .outcome import Outcome

#: Largest relative change of the numbers; largest relative error of the engine's value.
MOVED, ROOM = 0.1, 1e-7
#: Smallest size of a value in relative errors.
SMALLEST = 1e-2
START = (3.0, 0.0)


def _period(cycle):
    return cycle.period


def _stick(cycle):
    return jb.stick_duration(cycle, 0)


def _largest(cycle):
    return cycle.x1_max


#: Sets of parameters that change, as `paths` names them.
CHANGED = (
    ((0, "velocity"),),
    ((0, "velocity"), (0, "load")),
    ((0, "law static"), (-1, "damping")),
)
#: Functionals: as `design` gets them, of the engine's attractor, and whether they are lengths.
WANTED = (
    (jb.amplitude, lambda seen: 0.5 * (seen.x1[1] - seen.x1[0]), True),
    (_period, lambda seen: seen.period, False),
    (_stick, lambda seen: seen.sticks[0], False),
    (_largest, lambda seen: seen.x1[1], True),
)


def outcome(options, number: int) -> Outcome:
    """Design one oscillator."""
    rng = np.random.default_rng((options.seed, number))
    osc, _ = coverage.random_record(rng)
    own = units.drawn(rng, exact=False)
    changed = CHANGED[rng.integers(len(CHANGED))]
    functional, measured, is_length = WANTED[rng.integers(len(WANTED))]
    one = Outcome(f"{changed}, {functional.__name__}")
    begun = np.array([paths.value_of(osc, parameter) for parameter in changed])
    truth = begun * (1 + MOVED * rng.uniform(-1, 1, begun.size))
    target = _seen(_at(osc, changed, truth), measured)
    if not np.isfinite(target):
        one.counts["no cycle there"] += 1
        return one
    told = jb.design(
        package.oscillator(own.given(osc)),
        [(functional, target * (own.length if is_length else 1.0))],
        where=_selector(changed),
        y0=(START[0] * own.length, START[1]),
    )
    status = jb.Status(int(told.status)).name
    one.line += f" {target:.6g}: {status}"
    one.counts[status] += 1
    if status == "OK":
        sizes = [own.of(osc, parameter) for parameter in changed]
        found = _at(osc, changed, np.asarray(told.values) / sizes)
        off = abs(_seen(found, measured) - target) / max(abs(target), SMALLEST)
        one.largest["off"] = off
        if not off < ROOM:
            one.wrong.append(f"off by {off}: {told!r}\n    {osc!r}\n    {own}")
    return one


@functools.cache
def _selector(changed):
    """The same function for the same parameters, so that compiled programs serve all cases."""
    return lambda osc: tuple(paths.selector(parameter)(osc) for parameter in changed)


def _at(osc, changed, values):
    for parameter, value in zip(changed, values.tolist(), strict=True):
        osc = paths.with_value(osc, parameter, value)
    return osc


def _seen(osc: engine.Oscillator, measured) -> float:
    """Value of the functional of the engine's cycle; NaN if no cycle sticks."""
    seen = engine.attractor(osc, START)
    return float(measured(seen)) if seen.kind == "cycle" and max(seen.sticks) > 0 else np.nan


def said(counts, largest) -> list[str]:
    statuses = {name: n for name, n in counts.items() if name.isupper()}
    return [
        f"{statuses}; values of the engine's cycles off by {largest.get('off', 0.0):.1e} at most"
    ]
