"""Basin fractions along a parameter: those of `basin_fractions` against runs of the engine.

Along nu0 of class (b), nu1 = 0.35, at ten values. The engine runs from the middles of the cells of
a grid over the box, whose counts err by less than those of starts at random: the boundary of a
basin is a curve, and only cells that it passes are counted wrong. Three things must hold.

- At each value there are as many attractors, of the same kinds and at the same places.
- Each fraction is the engine's, to two standard errors of as many random starts as the engine has;
  `basin_fractions` has more.
- The differences from the engine's fractions, in their standard errors, are as large as they should
  be: chance explains the sum of their squares, one for each value with two attractors.

The last holds for 100,000 starts of the engine or more: the error of a grid falls faster than that
of random starts, and has to be small beside it.
"""

import functools
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np
from scipy.stats import chi2

import jaxbelt as jb

from . import engine
from .cases import PAPER
from .outcome import Outcome

#: The path, and the box of starts; six of the values have two attractors.
NU1, SPAN, VALUES, BOX = 0.35, (-0.55, 0.53), 10, ((-1.0, 3.0), (-1.0, 1.0))
#: Starts of `basin_fractions` for each start of the engine.
MORE = 10
#: Largest difference between extrema of the same attractor.
SAME = 1e-4
#: A sum of squares is a fault if chance exceeds it with a smaller probability than this.
CHANCE = 1e-3


#: Kind, smallest and largest x1 of an attractor.
Place = tuple[str, float, float]


class Seen(NamedTuple):
    """Attractors at one value, and how many starts lead to each; the kind "undecided" stands for
    starts whose attractor the engine does not find."""

    places: tuple[Place, ...]
    counts: tuple[int, ...]


def by_engine(nu0: float, starts: int, threads: int) -> Seen:
    """Attractors of the engine's runs from about `starts` starts on a grid, sides two to one."""
    across = max(1, round(np.sqrt(starts / 2)))
    middles = [
        low + (high - low) * (np.arange(n) + 0.5) / n
        for (low, high), n in zip(BOX, (2 * across, across), strict=True)
    ]
    grid = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1)
    return of_starts(class_b(nu0), grid.reshape(-1, 2), threads)


def class_b(nu0: float) -> engine.Oscillator:
    """The oscillator at a value."""
    return engine.Oscillator(0.5, tuple(engine.Belt(nu, PAPER) for nu in (nu0, NU1)))


def of_starts(osc: engine.Oscillator, starts: np.ndarray, threads: int) -> Seen:
    """Attractors of the engine's runs from starts [n, 2]."""

    def label(y0) -> Place:
        seen = engine.attractor(osc, tuple(y0))
        x1_min, x1_max = seen.x1 if seen.kind != "undecided" else (0.0, 0.0)
        return seen.kind, x1_min, x1_max

    with ThreadPoolExecutor(threads) as pool:
        found: Counter[Place] = Counter()
        for one in pool.map(label, starts.tolist()):
            known = (other for other in found if _is_same(one, other))
            found[next(known, one)] += 1
    return Seen(tuple(found), tuple(found.values()))


def _is_same(one: Place, other: Place) -> bool:
    return one[0] == other[0] and bool(np.max(np.abs(np.subtract(one[1:], other[1:]))) < SAME)


def differences(told: jb.BasinFractions, row: int, seen: Seen) -> tuple[list[str], float]:
    """Faults of the fractions at a value; and, where there are two, the square of the difference of
    one of them from the engine's, in its standard errors, else 0."""
    met = np.flatnonzero(told.fractions[row])
    mine = {
        (told.attractors[k].split()[0], float(told.x1_min[row, k]), float(told.x1_max[row, k])): k
        for k in met.tolist()
    }
    total, wrong, square = sum(seen.counts), [], 0.0
    if len(mine) != len(seen.places) or told.undecided[row] > 0:
        wrong.append(f"attractors {list(mine)}, engine {seen}")
    for place, count in zip(seen.places, seen.counts, strict=True):
        k = next((k for one, k in mine.items() if _is_same(one, place)), None)
        if k is None:
            wrong.append(f"missing: {place}, {count} starts")
            continue
        right = count / total
        away = float(told.fractions[row, k]) - right
        if abs(away) > 2 * np.sqrt(right * (1 - right) / total):
            wrong.append(f"{place}: {told.fractions[row, k]:.5f}, engine {right:.5f}")
        if 0 < right < 1:
            square = (away / float(told.standard_errors[row, k])) ** 2
    return wrong, square


@functools.cache
def told_by_package(seed: int, starts: int) -> jb.BasinFractions:
    """The package's fractions at all values, from `starts` random starts."""
    return jb.basin_fractions(
        lambda nu0: jb.presets.class_b(nu0, NU1),
        span=SPAN,
        rows=VALUES,
        box=BOX,
        n=starts,
        key=jax.random.key(seed),
    )


def settings(options) -> dict:
    return {"runs": options.runs}


def numbers(options) -> range:
    return range(VALUES)


def outcome(options, number: int) -> Outcome:
    """Compares the fractions at one value, with about `options.runs` starts of the engine."""
    nu0 = float(np.linspace(*SPAN, VALUES)[number])
    seen = by_engine(nu0, options.runs, options.threads)
    total = sum(seen.counts)
    told = told_by_package(options.seed, MORE * total)
    wrong, square = differences(told, number, seen)
    fractions = ", ".join(
        f"{name} {told.fractions[number, k]:.5f} +- {told.standard_errors[number, k]:.5f}"
        for k, name in enumerate(told.attractors)
        if told.fractions[number, k]
    )
    shares = ", ".join(
        f"{place[0]} {count / total:.5f}"
        for place, count in zip(seen.places, seen.counts, strict=True)
    )
    line = f"nu0 = {nu0:.4f}: {fractions}; engine {shares}; {square**0.5:.2f} errors off"
    one = Outcome(line, wrong)
    one.counts.update({"squares": square, "two attractors": len(seen.places) > 1, "starts": total})
    one.largest["errors off"] = square**0.5
    return one


def said(counts, largest) -> list[str]:
    return [
        f"{int(counts['starts']):,} starts of the engine",
        f"at most {largest.get('errors off', 0.0):.2f} standard errors off",
        f"sum of {int(counts['two attractors'])} squares {float(counts['squares']):.2f}, by chance "
        f"with {_chance(counts):.3f}",
    ]


def holds(counts) -> bool:
    """Whether chance explains the differences at all values together."""
    return _chance(counts) > CHANCE


def _chance(counts) -> float:
    values = int(counts["two attractors"])
    return float(chi2.sf(float(counts["squares"]), values)) if values else 1.0
