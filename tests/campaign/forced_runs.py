"""Trajectories of forced oscillators by `simulate`, and their derivatives, against the engine's.

A case of this campaign is a batch of runs of one structure.
"""

import numpy as np

from . import forced, forced_cases, forced_package
from .outcome import Outcome
from .runs import said as said

#: Number of runs in one case, and of structures; each structure is a compilation.
BATCH, PROGRAMS = 128, 14
#: Number of runs differentiated in the last case of each structure, along one direction each.
DIFFERENTIATED = 64
#: Largest relative error of a derivative of the engine, by its differences, that is compared.
KNOWN_TO = 1e-8


def settings(options):
    return dict(runs=options.runs, tol=options.tol, structure=options.structure)


def numbers(options):
    return range(len(_batches(options)))


def _batches(options):
    return forced_cases.batches(options, BATCH, PROGRAMS)


def outcome(options, number):
    structure, count = _batches(options)[number]
    rng = np.random.default_rng((options.seed, number))
    batch = [forced_cases.case(rng, structure) for _ in range(count)]
    told = forced_package.simulated(batch, options.tol)
    one = compared(batch, told, options)
    following = _batches(options)[number + 1 : number + 2]
    if not following or following[0][0] != structure:
        _differentiate(one, structure, rng)
    return one


def compared(batch, told, options) -> Outcome:
    """Compares the package's answers for runs of one structure with the engine's."""
    one = Outcome(f"{len(batch)} runs of {batch[0].structure}")
    verdicts = forced_cases.judged(batch, told, options.tol, options.threads)
    for case, answer, (verdict, mine) in zip(batch, told, verdicts):
        one.counts[f"{case.kind}|{verdict}|{options.what}|{options.tol:g}"] += 1
        if verdict not in forced_cases.GOOD:
            one.wrong.append(
                f"{verdict}: {answer.x1, answer.x2, answer.mode, answer.status}, "
                f"{answer.n_events} events; engine {mine.y_end} {mine.mode_end} {mine.status} "
                f"{len(mine.t)} events, margin {mine.margin:.1e}\n  {case.to_json()}"
            )
    return one


def _differentiate(one, structure, rng):
    """Compares derivatives of runs over a shorter time, in which they grow less."""
    for _ in range(DIFFERENTIATED):
        case = forced_cases.random_case(rng, structure, T=20.0)
        size = len(forced_cases._numbers(case)[0])
        direction = np.array(forced_cases.tied(case, rng.uniform(-1, 1, size)))
        known = forced_cases.derivative(case, direction)
        if known is None or case.simulate().status != forced.OK:
            continue
        value, error = known
        scale = 1 + np.max(np.abs(value))
        if error > KNOWN_TO * scale:
            continue
        off = np.max(np.abs(forced_package.derivative(case, direction) - value)) / scale
        one.counts["derivatives"] += 1
        one.counts["derivatives to 1e-7"] += bool(off <= 1e-7)
        one.largest["derivative"] = max(one.largest.get("derivative", 0.0), float(off))
        if not off <= 1e-7:
            one.wrong.append(
                f"derivative off by {off:.1e}, along {direction.tolist()}\n  {case.to_json()}"
            )
