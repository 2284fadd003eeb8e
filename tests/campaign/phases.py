"""Where t is 0 makes no difference: `bifurcation_diagram` of one oscillator at several phases.

As in `branches`, a branch of a random or round oscillator with one force is followed. At another
phase of the force it is the same oscillator with time shifted: its diagram must have the same
points, with the same multipliers, as many branches, and as many open ends.
"""

from dataclasses import replace

import numpy as np

import jaxbelt as jb

from . import branches, forced_cases, forced_package
from .outcome import Outcome

#: Largest difference of the values of a point, over the span, and of its multipliers, over 1 plus
#: their size.
SAME_VALUE, SAME_MULTIPLIER = 1e-7, 1e-3
#: Shifts of the phase, one of which is used besides a random one.
ROUND = (np.pi / 2, np.pi, 2.0)


def outcome(options, number: int) -> Outcome:
    rng = np.random.default_rng((options.seed, number))
    structure = branches.STRUCTURES[number % len(branches.STRUCTURES)]
    case = forced_cases.case(rng, structure)
    osc, parameter = case.oscillator, str(rng.choice(branches.PARAMETERS))
    force = osc.forces[0]
    value = osc.belts[0].velocity if parameter == "velocity" else vars(force)[parameter]
    off = 0.3 if parameter == "velocity" else 0.25 * value
    motion = jb.find_cycle(forced_package.oscillator(osc), case.y0)
    one = Outcome(f"{structure.laws}, {parameter} around {value:.4g}: {motion.status}")
    if int(motion.status) != jb.Status.OK or not isinstance(motion, jb.PeriodicMotion):
        one.counts["no periodic motion"] += 1
        return one
    span, seen = (value - off, value + off), []
    for shift in (0.0, float(rng.uniform(0, 2 * np.pi)), float(rng.choice(ROUND))):
        moved = replace(osc, forces=(replace(force, phase=force.phase + shift),))
        given, start = forced_package.oscillator(moved), motion
        if shift:
            run = jb.simulate(forced_package.oscillator(osc), motion.start, shift / force.frequency)
            start = jb.periodic(given, run.ys[-1], periods=motion.periods)
        if int(start.status) != jb.Status.OK:
            one.wrong.append(f"no motion at a phase shifted by {shift!r}: {start!r}\n    {osc!r}")
            continue
        found = jb.bifurcation_diagram(
            given, branches._selector(parameter), span, rows=branches.ROWS, start=start
        )
        seen.append((shift, found))
        one.counts["diagrams"] += 1
    one.line += f", {len(seen[0][1].points)} points"
    for shift, found in seen[1:]:
        what = _difference(seen[0][1], found, span)
        one.counts["another one" if what else "the same"] += 1
        if what:
            where = f"{osc!r}, {parameter} over {span}, from {case.y0}"
            one.wrong.append(f"phase shifted by {shift!r}: {what}\n    {where}")
    return one


def _difference(one, other, span):
    """What differs between two diagrams, or None."""
    said = [[(point.kind, float(point.value)) for point in found.points] for found in (one, other)]
    if [kind for kind, _ in said[0]] != [kind for kind, _ in said[1]]:
        return f"points {said[0]} and {said[1]}"
    for (kind, value), (_, beside) in zip(*said, strict=True):
        if abs(value - beside) > SAME_VALUE * (span[1] - span[0]):
            return f"{kind} at {value!r} and {beside!r}"
    pairs = (np.array([point.cycle.multipliers for point in d.points]) for d in (one, other))
    first, second = pairs
    if first.size and np.any(np.abs(first - second) > SAME_MULTIPLIER * (1 + np.abs(first))):
        return f"multipliers {first.tolist()} and {second.tolist()}"
    if len(one.open_ends) != len(other.open_ends):
        return f"open ends {one.open_ends} and {other.open_ends}"
    if len(one.branches) != len(other.branches):
        return f"{len(one.branches)} and {len(other.branches)} branches"
    return None
