"""Portraits: the result of `portrait` for an oscillator against runs of the engine.

The engine runs from 121 starts on a grid. Three things must hold.

- Each run leads to an attractor of the portrait. If no start leads to an attractor of the portrait,
  a run that starts on it must stay; it is set aside and counted, because its basin is small.
- Between two neighbours on the grid that lead to different attractors passes an unstable cycle or a
  stable separatrix; or a boundary, where the static limit of its belt exceeds mu(0).
- Runs that start beside an unstable cycle, inside and outside, leave it.
"""

import time
from collections import Counter
from dataclasses import replace
from math import inf

import jax.numpy as jnp
import numpy as np

import jaxbelt as jb

from . import engine, package, units
from .cases import PAPER, random_case, rational_case, special_positions, structures
from .outcome import Outcome

#: Number of displacements and of velocities of the starts, and their window.
SIDE, WINDOW = 11, ((-3.0, 3.0), (-2.0, 2.0))
#: Largest difference of extrema and periods of one cycle, and of places of one equilibrium.
SAME, AT_REST = 1e-6, 1e-4
#: Largest distance of a curve from the chords between its samples, over the distance between
#: starts.
CHORD = 0.02
#: Width below which a cycle, and one at a pseudo-focus, cannot be distinguished from rest.
TINY, TINY_AT_FOCUS = 1e-5, 1e-7
#: Distance below which a fixed point and a saddle coincide.
AT_ROUNDING = 1e-12
#: Largest error of a multiplier; steeper maps than STEEP and smaller cycles are not compared.
SLOPE, STEEP, SMALL = 1e-2, 100.0, 1e-2
#: Largest |x2| at a maximum of x1, by rounding.
AT_TOP = 1e-9
#: Rate below which an equilibrium is a Hopf point, which round numbers hit: loops stay there.
CENTRE = 1e-12
#: Longest time of a run of the engine; its attractor is then undecided.
PATIENCE = 20_000.0


def random_oscillator(rng: np.random.Generator) -> tuple[str, engine.Oscillator]:
    """A kind of oscillator, and a random oscillator of this kind."""
    kind = str(rng.choice(KINDS, p=SHARES))
    if kind == "paper":
        return kind, _of_the_paper(rng)
    if kind in ("random", "rational"):
        make = random_case if kind == "random" else rational_case
        number = int(rng.choice([0, 4, 5], p=[0.8, 0.1, 0.1]))
        return kind, make(rng, structures(rng, 6)[number]).oscillator
    osc = (_of_the_paper if rng.random() < 0.5 else _random)(rng)
    first, *rest = osc.belts
    if kind == "negative damping":
        return kind, replace(osc, damping=-float(rng.uniform(0.01, 0.4)))
    if kind == "equal belts":
        rest = [replace(b, velocity=first.velocity, law=first.law, load=first.load) for b in rest]
    elif kind == "belt at rest":
        first = replace(first, velocity=0.0)
    elif kind == "no load":
        first = replace(first, load=0.0)
    else:
        return kind, _with_edge_on_equilibrium(rng, osc)
    return kind, replace(osc, belts=(first, *rest))


KINDS = (
    "paper", "random", "rational", "negative damping", "equal belts", "belt at rest", "no load",
    "edge on equilibrium",
)  # fmt: skip
SHARES = (0.35, 0.25, 0.15, 0.05, 0.05, 0.05, 0.05, 0.05)


def _random(rng):
    return random_case(rng, structures(rng, 1)[0]).oscillator


def _of_the_paper(rng) -> engine.Oscillator:
    """The paper's belts at random velocities, in contact as in one of its classes."""
    nu0, nu1 = rng.uniform(-0.8, 0.8, 2)
    s0, s1 = np.sort(rng.uniform(-1.2, 1.2, 2))
    style = rng.choice(["a", "b", "c", "d", "d"])
    if style == "a":
        return engine.Oscillator(0.5, (engine.Belt(nu0, PAPER),))
    bounds = {"b": (inf, -inf), "c": (s0, s0), "d": (s1, s0)}[str(style)]
    belts = (
        engine.Belt(nu0, PAPER, 1.0, -inf, float(bounds[0])),
        engine.Belt(nu1, PAPER, 1.0, float(bounds[1]), inf),
    )
    return engine.Oscillator(0.5, belts)


def _with_edge_on_equilibrium(rng, osc: engine.Oscillator) -> engine.Oscillator:
    places = [x for x in special_positions(osc) if abs(x) < 3]
    edge = float(rng.choice(places))
    first, *rest = osc.belts
    first = replace(first, lower=-inf, upper=edge)
    return replace(osc, belts=(first, *(replace(b, lower=edge, upper=inf) for b in rest)))


# --- comparison -----------------------------------------------------------------------------------


def differences(osc: engine.Oscillator, told: jb.Portrait) -> tuple[list[str], Counter]:
    """Faults of the portrait of an oscillator, and counts of cases set aside, by reason.

    Starts are compared within the portrait's reach, |x1| and |x2| < reach.
    """
    aside: Counter = Counter()
    centres = [float(r.x1) for r in told.equilibria if abs(float(r.rate)) < CENTRE]
    gaps = np.asarray(told.gaps).tolist()
    of_centres = [gap for gap in gaps if any(abs(gap[0] - x1) < 1e-4 for x1 in centres)]
    aside["gap at a Hopf point"] += len(of_centres)
    wrong = [f"gap {gap}" for gap in gaps if gap not in of_centres]
    unsettled = [one for one in told.separatrices if one.end == "unsettled" and one.stable]
    if unsettled and _has_fixed_point_at_saddle(told):
        aside["fixed point and saddle on an edge"] += 1
    else:
        wrong += [f"{one}" for one in unsettled]
    wrong += [
        f"ends within reach: {one}"
        for one in told.separatrices
        if one.end == "outside"
        and np.max(np.abs(np.asarray(one.ys))) < told.reach
        and int(told.status) == jb.Status.OK
    ]
    ids = np.full((SIDE, SIDE), -1)
    x1s, x2s = (np.linspace(*ends, SIDE) for ends in WINDOW)
    for i, x1 in enumerate(x1s):
        for j, x2 in enumerate(x2s):
            if max(abs(x1), abs(x2)) > told.reach:
                aside["beyond reach"] += 1
                continue
            seen = engine.attractor(osc, (x1, x2), t_max=PATIENCE)
            if seen.kind == "undecided":
                aside["goes to infinity" if seen.status == engine.NOT_FINITE else "undecided"] += 1
                ids[i, j] = 1000 if seen.status == engine.NOT_FINITE and told.escapes else -1
                continue
            ids[i, j] = _number_of(seen, told)
            if ids[i, j] < 0 and _is_tiny(seen, told):
                aside["tiny"] += 1
            elif ids[i, j] < 0:
                wrong.append(f"from {(x1, x2)} missing: {seen}")
    wrong += _invented(osc, told, set(ids.ravel().tolist()), aside)
    if int(told.status) == jb.Status.INCOMPLETE and not len(told.gaps) and not unsettled:
        aside["node on an edge"] += 1
    else:
        wrong += _not_parted(told, ids, x1s, x2s)
    wrong += [f"not unstable: {one}" for one in told.unstable if not _repels(osc, one, told)]
    for one in (*told.cycles, *told.unstable):
        slope = _slope(osc, one)
        if not abs(slope - float(one.multiplier)) <= SLOPE * max(1.0, float(one.multiplier)):
            wrong.append(f"multiplier {one.multiplier} for {slope}: {one}")
    return wrong, aside


def _number_of(seen: engine.Attractor, told: jb.Portrait) -> int:
    """Number of an attractor in the portrait: cycles first, then equilibria; -1 if not in it."""
    if seen.kind == "cycle":
        for number, cycle in enumerate(told.cycles):
            mine = float(cycle.x1_min), float(cycle.x1_max), float(cycle.period)
            if np.max(np.abs(np.array(mine) - [*seen.x1, seen.period])) < SAME:
                return number
        return -1
    x1, number = seen.x1[0], -1
    end = -inf
    for row, rest in enumerate(told.equilibria):
        holds = int(rest.kind) == jb.EquilibriumKind.SEGMENT
        # Adjacent segments count as one.
        if not (holds and abs(float(rest.x1_lower) - end) < 1e-12):
            number = len(told.cycles) + row
        end = float(rest.x1_upper) if holds else inf
        inside = float(rest.x1_lower) - AT_REST <= x1 <= float(rest.x1_upper) + AT_REST
        if inside and (holds or bool(rest.stable)):
            return number
    return -1


def _is_tiny(seen: engine.Attractor, told: jb.Portrait) -> bool:
    foci = np.asarray(told.equilibria.kind) == jb.EquilibriumKind.PSEUDO_FOCUS
    at_focus = np.any(np.abs(np.asarray(told.equilibria.x1)[foci] - seen.x1[0]) < 1e-3)
    return seen.x1[1] - seen.x1[0] < (TINY_AT_FOCUS if at_focus else TINY)


def _has_fixed_point_at_saddle(told: jb.Portrait) -> bool:
    """Whether a fixed point and a saddle coincide up to rounding, as before both vanish."""
    x1, kinds = np.asarray(told.equilibria.x1), np.asarray(told.equilibria.kind)
    saddles = x1[kinds == jb.EquilibriumKind.SADDLE]
    fixed = x1[kinds == jb.EquilibriumKind.FIXED_POINT]
    return bool(np.any(np.abs(saddles[:, None] - fixed) < AT_ROUNDING))


def _invented(osc, told: jb.Portrait, seen: set[int], aside: Counter) -> list[str]:
    wrong = []
    for number, cycle in enumerate(told.cycles):
        if number not in seen:
            arcs = cycle.arcs
            again = engine.attractor(osc, tuple(np.asarray(arcs.y)[0].tolist()), t_max=PATIENCE)
            if again.kind == "undecided":
                aside["undecided"] += 1
            elif _number_of(again, told) == number:
                aside["small basin"] += 1
            else:
                wrong.append(f"invented: {cycle}, engine {again}")
    return wrong


def _not_parted(told: jb.Portrait, ids, x1s, x2s) -> list[str]:
    """Neighbours that lead to different attractors without a curve between them."""
    curves = [np.asarray(one.ys) for one in told.separatrices if one.stable]
    for cycle in told.unstable:
        ys = np.asarray(cycle.sample(2000))
        curves.append(np.concatenate([ys, ys[1:2]]))
    wrong = []
    for axis, along, across in ((0, x1s, x2s), (1, x2s, x1s)):
        room = CHORD * (along[1] - along[0])
        for k, level in enumerate(across):
            row = ids[:, k] if axis == 0 else ids[k]
            at = np.concatenate([_crossings(curve, axis, level) for curve in curves] or [[]])
            for i in np.flatnonzero((row[1:] != row[:-1]) & (row[1:] >= 0) & (row[:-1] >= 0)):
                low, high = along[i] - room, along[i + 1] + room
                if axis == 1 and any(
                    along[i] - 1e-9 <= v <= along[i + 1] + 1e-9 for v in _jumps(told)
                ):
                    continue
                if not np.any((low <= at) & (at <= high)):
                    ends = [(a, level) if axis == 0 else (level, a) for a in along[i : i + 2]]
                    wrong.append(f"not parted: {ends}, {row[i]} and {row[i + 1]}")
    return wrong


def _jumps(told: jb.Portrait) -> list[float]:
    """Boundaries x2 of belts whose static limit exceeds mu(0): orbits leave them upwards or
    downwards, so that they separate basins."""
    belts, omega = told.oscillator.belts, float(told.oscillator.omega)
    return [
        float(b.velocity) / omega
        for b in belts
        if float(b.friction.static) > float(b.friction.mu(jnp.zeros(()))) + 1e-12
    ]


def _crossings(curve: np.ndarray, axis: int, level: float) -> np.ndarray:
    """Places where a curve crosses a line of the grid; ends on the line, up to rounding, count."""
    other = curve[:, 1 - axis] - level
    other = np.where(np.abs(other) < AT_ROUNDING, 0.0, other)
    i = np.flatnonzero(other[1:] * other[:-1] <= 0)
    share = other[i] / np.where(other[i] == other[i + 1], 1.0, other[i] - other[i + 1])
    return curve[i, axis] + share * (curve[i + 1, axis] - curve[i, axis])


def _repels(osc: engine.Oscillator, cycle: jb.Cycle, told: jb.Portrait) -> bool:
    """Whether runs from both sides of a cycle's maximum of x1 leave the cycle in one loop."""
    top = float(cycle.x1_max)
    tops = [float(one.x1_max) for one in (*told.cycles, *told.unstable) if one is not cycle]
    nearest = min([1.0, *(abs(other - top) for other in tops)])
    step = 1e-4 * min(nearest, float(cycle.x1_max - cycle.x1_min))
    for side in (-step, step):
        run = engine.simulate(osc, (top + side, 0.0), 5 * float(cycle.period) + 50, turns=True)
        tops = run.y[(run.kind == engine.TURN) & (run.belt == 0), 0]
        if not tops.size:
            return run.status != engine.OK or side < 0
        moved = (tops[0] - top) / side
        if not moved > 1 + 0.3 * min(float(cycle.multiplier) - 1, 1.0):
            return False
    return True


def _slope(osc: engine.Oscillator, cycle: jb.Cycle) -> float:
    """Slope of the map from top to top at a cycle, by differences. For steep maps and small cycles
    the cycle's own multiplier, because differences are useless there."""
    size, multiplier = float(cycle.x1_max - cycle.x1_min), float(cycle.multiplier)
    if multiplier > STEEP or size < SMALL:
        return multiplier
    ends = []
    for side in (-1e-6, 1e-6):
        start = float(cycle.x1_max) + side * size, 0.0
        run = engine.simulate(osc, start, 2 * float(cycle.period), turns=True)
        # At the boundary of a belt at rest a top is an event of that belt.
        late = (run.t > 0.5 * float(cycle.period)) & (np.abs(run.y[:, 1]) < AT_TOP)
        tops = run.y[late, 0]
        tops = tops[np.abs(tops - float(cycle.x1_max)) < 1e-3 * size]
        ends.append(tops[0] if tops.size else np.nan)
    return float((ends[1] - ends[0]) / (2e-6 * size))


def outcome(options, number: int) -> Outcome:
    """Compares one random portrait."""
    rng = np.random.default_rng((options.seed, number))
    kind, osc = random_oscillator(rng)
    own = units.drawn(rng, exact=kind not in ("paper", "random"))
    before = time.monotonic()
    told = jb.portrait(package.oscillator(own.given(osc)))
    seconds = time.monotonic() - before
    wrong, aside = differences(osc, own.back(told, package.oscillator(osc)))
    one = Outcome(kind, wrong)
    one.counts.update({f"set aside: {name}": n for name, n in aside.items()})
    one.counts.update(
        {
            kind: 1,
            "attracting": len(told.cycles),
            "unstable": len(told.unstable),
            "separatrices": len(told.separatrices),
            "seconds of portraits": seconds,
        }
    )
    if wrong:
        wrong.insert(0, f"{package.oscillator(own.given(osc))!r}\n{told}\n{own}")
    return one
