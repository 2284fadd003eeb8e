"""Derivatives of bifurcation points by other parameters, against differences of their values.

Along random paths, those of the campaign `paths`, `scan` finds points. For each the derivative
of the value of `refine`, along a random direction of the oscillator's numbers, is compared with a
Richardson difference of values of `refine` for oscillators beside, each solved for separately. The
values themselves are compared with the engine's by `paths`.
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxbelt as jb

from . import derivatives, package, paths
from .cases import Case
from .outcome import Outcome

#: Step of the differences, and their tolerance: values are known to 1e-11 or so.
STEP, ROOM = 2e-4, 1e-5
#: After so many paths compiled programs are dropped: a thousand of them fill the memory.
TOGETHER = 10


def outcome(options, number: int) -> Outcome:
    """Compares derivatives of all points of one path."""
    case = paths.case_of(options.seed, number)
    if number % TOGETHER == 0:
        jax.clear_caches()
    rng = np.random.default_rng((options.seed, number, 1))
    middle = package.oscillator(case.at(0.5 * sum(case.span)))
    points = [p for p in jb.scan(middle, case.where, case.span) if p.status == jb.Status.OK]
    one = Outcome(f"{case.parameter}, {len(points)} points")
    for point in points:
        osc = case.at(float(point.value))
        along = derivatives.directions(Case(osc, (0.0, 0.0)), rng)
        verdict, told, right = _compared(case, osc, point, along)
        one.counts[f"{point.kind}: {verdict}"] += 1
        if verdict == "wrong":
            what = f"{point!r} along {along}: {told}, differences {right}"
            one.wrong.append(f"{what}\n    {osc!r}")
    return one


def _compared(case: paths.Case, osc, point, along):
    """A verdict, the package's derivative, and that of differences."""

    def value(by):
        moved = package.oscillator(derivatives.moved(osc, along, by))
        found = jb.refine(point.condition, moved, where=case.where)
        return float(found.value)

    def traced(by):
        moved = derivatives.moved(osc, along, by)
        return jb.refine(point.condition, package.oscillator(moved), where=case.where).value

    _, told = jax.jvp(traced, (jnp.asarray(0.0),), (jnp.asarray(1.0),))
    # The parameter of the path moves, too, but it is only the guess.
    values = {h: value(h) for h in (-STEP, -STEP / 2, STEP / 2, STEP)}
    whole, half = ((values[h] - values[-h]) / (2 * h) for h in (STEP, STEP / 2))
    right, told = (4 * half - whole) / 3, float(told)
    if not np.isfinite(right) or abs(half - whole) > 1e-3 * (1 + abs(right)):
        return "no difference", told, right
    if np.isnan(told):
        return "none told", told, right
    return ("same" if abs(told - right) < ROOM * (1 + abs(right)) else "wrong"), told, right
