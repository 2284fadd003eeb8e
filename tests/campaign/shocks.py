"""Minimal fatal shocks: the result of `minimal_fatal_shock` against bisection by the engine.

For an oscillator at random, one of its attractors and a direction, four things must hold.

- The start is on the attractor: the engine stays there for a loop.
- Along the shock, the engine's runs lead to the attractor up to the distance of the result, and
  elsewhere beyond; bisection finds where this changes.
- No smaller shock is fatal: from states all along the attractor shocks in many directions, a
  thousandth smaller than the smallest fatal one, lead back to it.
- The derivative of the distance along a random direction in the space of oscillators is that of
  bisection: a difference of oscillators beside, extrapolated.
"""

from math import inf

import jax
import jax.numpy as jnp
import numpy as np

import jaxbelt as jb

from . import derivatives, engine, package
from .cases import Case
from .outcome import Outcome
from .portraits import PATIENCE, _number_of, random_oscillator

#: Largest errors of distances, and of derivatives relative to 1 plus their size.
SAME, SAME_SLOPE = 1e-8, 1e-6
#: Smallest distance that is compared; differences of smaller ones may not exist.
LEAST = 1e-3
#: Number of phases of a cycle from which, and of angles at which, smaller shocks are tried.
PHASES, ANGLES = 12, 8
#: Distance to which runs have to repeat; closer to an unstable cycle they count as on it.
REPEATS = 1e-11
#: Loops of the slowest cycle that a run must last for the cycle to be recognised: half of the last
#: piece of the run, which is doubled, has to repeat.
LOOPS = 50
#: Steps of the differences: the first is used with which the nearest boundary stays the same and
#: the two differences that are extrapolated agree within ALIKE.
STEPS, ALIKE = (3e-4, 3e-5, 3e-6), 1e-4
#: Distance between starts of neighbouring oscillators above which the shocks are different ones.
ELSEWHERE = 0.1
#: Numbers of a run that goes to infinity, and of a run whose end is unknown.
INFINITY, UNKNOWN = 1000, -1


def label(osc: engine.Oscillator, told: jb.Portrait, y0) -> int:
    """Where the engine's run from a start leads: a number among the attractors of the portrait."""
    # A cycle that creeps for long has to repeat, too.
    longest = max((float(cycle.period) for cycle in told.cycles), default=0.0)
    patience = max(PATIENCE, LOOPS * longest)
    seen = engine.attractor(osc, tuple(map(float, y0)), t_max=patience, same=REPEATS)
    if seen.kind == "undecided":
        return INFINITY if seen.status == engine.NOT_FINITE and told.escapes else UNKNOWN
    return _number_of(seen, told)


def bisected(osc: engine.Oscillator, told: jb.FatalShock, end: int) -> float:
    """Distance from the start, along the shock, at which the engine's runs stop leading to the
    attractor with the number `end` of the portrait; NaN if there is no such change near the shock.

    A shock that leads to a sharp corner of the basin misses the outside. Then its direction moves
    to states beside the corner that lead elsewhere, by less than the accuracy of the comparison.
    """
    start, shock = (np.asarray(one, float) for one in (told.start, told.shock))
    # The basin beyond may be a thin strip there.
    beside = [10.0**-n for n in range(4, 10)]
    outside = 1 + next(
        (b for b in beside if label(osc, told.portrait, start + (1 + b) * shock) != end), beside[0]
    )
    inside = 2 - outside
    if label(osc, told.portrait, start + outside * shock) == end and told.direction == "both":
        angles = np.radians(np.arange(360))
        ways = np.column_stack([np.cos(angles), np.sin(angles)])
        behind = [
            way for way in ways if label(osc, told.portrait, start + shock + 1e-6 * way) != end
        ]
        if behind:
            shock, outside = shock + 0.1 * SAME * np.mean(behind, axis=0), 1.0
    ends = [label(osc, told.portrait, start + share * shock) for share in (inside, outside)]
    if ends[0] != end or ends[1] == end:
        return np.nan
    while outside - inside > 1e-13:
        middle = 0.5 * (inside + outside)
        found = label(osc, told.portrait, start + middle * shock)
        if found == UNKNOWN:
            # On the boundary up to the accuracy of the runs.
            inside = outside = middle
        elif found == end:
            inside = middle
        else:
            outside = middle
    return 0.5 * (inside + outside) * float(np.linalg.norm(shock))


def differences(osc, y0, direction: str, told: jb.FatalShock) -> tuple[list[str], float]:
    """Faults of the package's shock for an oscillator, and the error of its distance."""
    end = label(osc, told.portrait, y0)
    start, wrong = np.asarray(told.start, float), []
    if label(osc, told.portrait, start) != end:
        wrong.append(f"start {start} leads elsewhere")
    what, number = told.attractor.split()
    if what == "cycle":
        period = float(told.portrait.cycles[int(number)].period)
        back = np.array(engine.simulate(osc, tuple(start), period).y_end)
        if not np.abs(back - start).max() < SAME:
            wrong.append(f"start {start} is not on the cycle, which comes back to {back}")
    error = abs(bisected(osc, told, end) - float(told.distance))
    if not error < SAME:
        wrong.append(f"distance off by {error}")
    wrong += _smaller_ones(osc, told, end, direction)
    return wrong, error


def _smaller_ones(osc, told: jb.FatalShock, end: int, direction: str) -> list[str]:
    what, number = told.attractor.split()
    rests = told.portrait.equilibria
    if what == "cycle":
        cycle = told.portrait.cycles[int(number)]
        states = np.asarray(cycle.sample(PHASES + 1))[:PHASES]
    else:
        states = np.array([[float(rests.x1[int(number)]), 0.0]])
    angles = np.linspace(0.0, 2 * np.pi, ANGLES, endpoint=False) + 0.1
    ways = np.array([[0.0, 1.0], [0.0, -1.0]])
    if direction == "both":
        ways = np.column_stack([np.cos(angles), np.sin(angles)])
    wrong = []
    for y in [*states, np.asarray(told.start)]:
        for way in ways:
            to = y + 0.999 * float(told.distance) * way
            found = label(osc, told.portrait, to)
            if found not in (end, UNKNOWN):
                wrong.append(f"a smaller one is fatal: from {y} to {to}, {found}")
    return wrong


def slope_error(osc, y0, direction: str, along) -> tuple[float, float] | None:
    """Error of the derivative along a direction of the parameters, and size of bisection's; None if
    for oscillators beside, on one side at least, another boundary is the nearest, or the same one
    elsewhere: at round numbers, where things coincide, or where the motion is point-symmetric."""

    def shock(by):
        oscillator = package.oscillator(derivatives.moved(osc, along, by))
        return jb.minimal_fatal_shock(oscillator, y0, direction=direction)

    def by_bisection(by, told):
        beside = derivatives.moved(osc, along, by)
        return bisected(beside, told, label(beside, told.portrait, y0))

    _, slope = jax.jvp(lambda by: shock(by).distance, (jnp.asarray(0.0),), (jnp.asarray(1.0),))
    for step in STEPS:
        sizes = step, 0.5 * step, 0.25 * step
        told = {by: shock(by) for size in sizes for by in (-size, size)}
        sorts = {(one.attractor, one.boundary, one.beyond) for one in (*told.values(), shock(0.0))}
        apart = np.ptp([np.asarray(one.start) for one in told.values()], axis=0)
        if len(sorts) == 1 and np.max(apart) < ELSEWHERE:
            values = {by: by_bisection(by, one) for by, one in told.items()}
            whole, half, quarter = ((values[by] - values[-by]) / (2 * by) for by in sizes)
            # The second derivative may jump here: terms |by| by and by^3 both cancel.
            right = (8 * quarter - 6 * half + whole) / 3
            if abs(half - whole) < ALIKE * (1 + abs(right)) or step == STEPS[-1]:
                return abs(float(slope) - right), abs(right)
    return None


def random_shock(rng: np.random.Generator):
    """A kind, an oscillator, a start, a direction, and the package's shock for them."""
    while True:
        kind, osc = random_oscillator(rng)
        told = jb.portrait(package.oscillator(osc))
        if not told.unstable and not any(one.stable for one in told.separatrices):
            continue
        direction = str(rng.choice(["both", "x2"]))
        y0 = tuple(rng.uniform([-2.0, -1.0], [2.0, 1.0]).tolist())
        shock = jb.minimal_fatal_shock(told, y0, direction=direction)
        if int(shock.status) == jb.Status.OK and LEAST < float(shock.distance) < inf:
            return kind, osc, y0, direction, shock


def outcome(options, number: int) -> Outcome:
    """Compares one random shock."""
    rng = np.random.default_rng((options.seed, number))
    kind, osc, y0, direction, told = random_shock(rng)
    along = derivatives.directions(Case(osc, y0), rng)
    wrong, error = differences(osc, y0, direction, told)
    slopes = slope_error(osc, y0, direction, along)
    one = Outcome(
        f"{kind}: {told.attractor} to {told.boundary}, {direction}, "
        f"{float(told.distance):.9f} off by {error:.1e}, slope {slopes}",
        wrong,
    )
    one.largest["error of distances"] = error
    if slopes is None:
        one.counts["another boundary beside"] += 1
    else:
        off, size = slopes
        one.largest["error of derivatives"] = off / (1 + size)
        if not off < SAME_SLOPE * (1 + size):
            wrong.append(f"derivative off by {off} of {size}")
    what = told.boundary.rpartition(" ")[0]
    one.counts[f"{told.attractor.split()[0]} to {what}, {direction}"] += 1
    if wrong:
        wrong.insert(0, f"from {y0}, along {along}\n{package.oscillator(osc)!r}\n{told}")
    return one


def said(counts, largest) -> list[str]:
    return [f"{dict(counts)}", *(f"largest {name}: {x:.1e}" for name, x in largest.items())]
