"""Multipliers of periodic forced motions, stable and unstable, against differences of the engine.

Motions of random and round oscillators are found by `find_cycle` from the case's start, and by
`periodic` from guesses around the end of a long run. The engine starts at the state of each motion
and has to return to it after the motion's periods; sum and product of the multipliers have to be
those of the eigenvalues of a matrix of differences of the engine's runs.
"""

import numpy as np

import jaxbelt as jb

from . import forced, forced_cases, forced_package
from .outcome import Outcome

#: Number of structures, each a compilation.
PROGRAMS = 10
#: Number of guesses for one oscillator, and the largest number of periods of its motions.
GUESSES, MOST_PERIODS = 24, 2
#: Largest error of the return to a start, times the largest multiplier where that is > 1.
SAME = 1e-8
#: Steps of the differences. KNOWN: the multipliers are known if the results of both steps differ by
#: less. The tolerance is TIMES their difference, plus ROUNDING.
STEPS, KNOWN, TIMES, ROUNDING = (1e-4, 3e-5), 1e-4, 30, 1e-7
#: Motions of one oscillator are the same if their states differ by less.
ONE_MOTION = 1e-5


def settings(options) -> dict:
    return {}


def numbers(options) -> range:
    return range(options.runs)


def outcome(options, number: int) -> Outcome:
    rng = np.random.default_rng((options.seed, number))
    structures = forced_cases.structures(np.random.default_rng(options.seed), PROGRAMS)
    case = forced_cases.case(rng, structures[number % PROGRAMS])
    one = Outcome(f"{case.structure.laws}, {len(case.oscillator.forces)} forces")
    period = case.oscillator.common_period()
    if not 0 < period < np.inf:
        one.counts["no common period"] += 1
        return one
    given = forced_package.oscillator(case.oscillator)
    found = []
    for motion in _motions(given, case, period, rng):
        start = np.asarray(motion.start)
        if all(np.max(np.abs(start - other)) > ONE_MOTION for other in found):
            found.append(start)
            verdict, row = _compared(case.oscillator, motion, period)
            kind = f"{'' if motion.stable else 'un'}stable"
            sticks = "sticks" if np.any(np.asarray(motion.stick_durations) > 0) else "slips"
            one.counts[f"{kind}, {sticks}: {verdict}"] += 1
            if verdict.startswith("wrong"):
                one.wrong.append(f"{verdict}: {row}\n    {case.to_json()}")
    return one


def _motions(given, case, period, rng):
    motion = jb.find_cycle(given, case.y0)
    if isinstance(motion, jb.PeriodicMotion) and int(motion.status) == jb.Status.OK:
        yield motion
    run = forced.simulate(case.oscillator, case.y0, 40 * period, max_events=20_000)
    middle = np.array(run.y_end)
    if not np.all(np.isfinite(middle)):
        return
    for size in rng.uniform(0.05, 2.0, GUESSES):
        guess = tuple(middle + size * rng.normal(size=2))
        motion = jb.periodic(given, guess, periods=int(rng.integers(1, MOST_PERIODS + 1)))
        if int(motion.status) == jb.Status.OK:
            yield motion


def _compared(osc, motion, period):
    start, n = np.asarray(motion.start), int(motion.periods)
    told = np.asarray(motion.multipliers)
    told = told[np.argsort(np.abs(told))]
    run = forced_cases.stroboscopic(osc, start, n, period)
    row = {"start": start.tolist(), "periods": n, "told": told.tolist()}
    row["off"] = float(np.max(np.abs(np.subtract(run.y_end, start))))
    if not row["off"] < SAME * max(1.0, float(np.abs(told[1]))):
        return "wrong motion", row
    if run.margin < forced_cases.compare.CORNER:
        return "corner", row
    known = []
    for h in STEPS:
        values = np.linalg.eigvals(forced_cases.monodromy(osc, start, n, period, h))
        known.append(values[np.argsort(np.abs(values))])
    row["known"] = [one.tolist() for one in known]
    # Sum and product do not depend on the order of multipliers.
    sums = [np.array([np.sum(one).real, np.prod(one).real]) for one in (*known, told)]
    doubt, off = np.abs(sums[0] - sums[1]), np.abs(sums[1] - sums[2])
    size = 1 + np.abs(sums[1])
    if not np.all(doubt < KNOWN * size):
        return "not known", row
    row["off"] = (off / size).tolist()
    return ("same" if np.all(off <= TIMES * doubt + ROUNDING * size) else "wrong multipliers"), row
