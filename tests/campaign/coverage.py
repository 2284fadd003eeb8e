"""Intervals of `fit`: how many contain the truth.

The engine makes records of stick-slip motions of random oscillators, with noise of known size. In
each record a velocity, a coefficient of friction and the damping are fitted, from a guess at most
10 % off. Of the 95 % intervals (+- 1.96 standard errors), 90 to 98 % have to contain the truth.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxbelt as jb

from . import cases, engine, package, units
from .outcome import Outcome

#: Samples of a record and the time between two; noise over the width of the motion.
SAMPLES, STEP, NOISE = 400, 0.1, 0.01
#: Largest relative error of the guess; half-width of the interval in standard errors.
OFF, HALF = 0.1, 1.959964
#: Smallest and largest share of intervals that contain the truth.
LEAST, MOST = 0.90, 0.98


def random_record(rng):
    """An oscillator that sticks, and a start on its cycle."""
    while True:
        osc = cases.random_case(rng, (("conti",), False)).oscillator
        seen = engine.attractor(osc, (3.0, 0.0))
        # A motion that hardly sticks hardly depends on the static friction.
        if seen.kind == "cycle" and seen.period < 20 and 0.1 < max(seen.sticks) < 0.9 * seen.period:
            return osc, seen


def outcome(options, number: int) -> Outcome:
    """Fit one record."""
    rng = np.random.default_rng((options.seed, number))
    osc, seen = random_record(rng)
    own = units.drawn(rng, exact=False)
    ts = STEP * np.arange(1, SAMPLES + 1)
    exact = _samples(osc, seen.y, ts)
    noise = NOISE * float(np.ptp(exact)) * own.length
    x1 = own.length * exact + rng.normal(0.0, noise, SAMPLES)
    right = package.oscillator(own.given(osc))
    truth = np.array([float(value) for value in _where(right)])
    guess = _moved(right, truth * (1 + OFF * rng.uniform(-1, 1, truth.size)))
    told = jb.fit(guess, ts, x1, where=_where, noise=noise)
    one = Outcome(f"{jb.Status(int(told.status)).name}: {told.estimates} of {truth}")
    one.counts[jb.Status(int(told.status)).name] += 1
    if int(told.status) == jb.Status.OK:
        errors = (np.asarray(told.estimates) - truth) / np.asarray(told.standard_errors)
        one.counts["intervals"] += truth.size
        one.counts["with the truth"] += int(np.sum(np.abs(errors) < HALF))
        one.largest["standard errors off"] = float(np.max(np.abs(errors)))
    return one


def _samples(osc, y0, ts) -> np.ndarray:
    """Displacements at times, by runs of the engine from each time to the next."""
    state, before, found = tuple(y0), 0.0, []
    for t in ts.tolist():
        state, before = engine.simulate(osc, state, t - before).y_end, t
        found.append(state[0])
    return np.array(found)


def _where(osc):
    belt = osc.belts[0]
    return belt.velocity, belt.friction.static, osc.damping


def _moved(osc, values):
    return eqx.tree_at(_where, osc, tuple(jnp.asarray(value) for value in values))


def said(counts, largest) -> list[str]:
    share = counts["with the truth"] / max(counts["intervals"], 1)
    statuses = {name: n for name, n in counts.items() if name.isupper()}
    return [
        f"{counts['with the truth']} of {counts['intervals']} intervals contain the truth "
        f"({100 * share:.1f}%); {statuses}; at most {largest.get('standard errors off', 0.0):.2f} "
        "standard errors off"
    ]


def holds(counts) -> bool:
    """Whether the share lies between LEAST and MOST, up to two of its standard errors."""
    n = counts["intervals"]
    room = 2 * np.sqrt(0.05 * 0.95 / n) if n else 1.0
    return not n or LEAST - room < counts["with the truth"] / n < MOST + room
