"""Cases for campaigns: random ones, rational ones, and orbits that graze a boundary or an edge.

A rational case has round numbers everywhere, as users have, and starts on boundaries, edges,
equilibria and corners on purpose: exact coincidences have probability zero among random numbers.
"""

import json
from dataclasses import dataclass, replace
from math import inf, isfinite

import numpy as np

from . import engine
from .engine import Belt, Oscillator
from .units import ENGINES, Units

#: Number of structures (laws and edges) of a campaign; each needs a compilation.
STRUCTURES = 9

LAWS = ("conti", "coulomb", "stribeck")
PAPER = ("conti", 1.0, 0.6, 10.0, 0.0)


@dataclass(frozen=True)
class Case:
    """An oscillator, a start and a duration; kind: origin of the case; units: those in which the
    package gets it."""

    oscillator: Oscillator
    y0: tuple
    T: float = 50.0
    kind: str = "random"
    #: Distance of a grazing orbit from its boundary or edge; negative: it goes beyond by as much.
    distance: float | None = None
    units: Units = ENGINES

    @property
    def given(self):
        """The oscillator and the start in the units in which the package gets them."""
        x1, x2 = self.y0
        return self.units.given(self.oscillator), (x1 * self.units.length, x2 * self.units.length)

    @property
    def structure(self):
        """What decides the compiled program: the belts' laws, and whether there are edges."""
        belts = self.oscillator.belts
        edges = any(isfinite(b.lower) or isfinite(b.upper) for b in belts)
        return tuple(b.law[0] for b in belts), edges

    def to_json(self):
        """The complete parameters, every number by its shortest exact digits."""
        osc = self.oscillator
        belts = [
            dict(
                velocity=b.velocity,
                law=list(b.law),
                load=b.load,
                lower=None if b.lower == -inf else b.lower,
                upper=None if b.upper == inf else b.upper,
            )
            for b in osc.belts
        ]
        return dict(
            damping=osc.damping,
            omega=osc.omega,
            belts=belts,
            y0=list(self.y0),
            T=self.T,
            kind=self.kind,
            distance=self.distance,
            units=[self.units.length, self.units.frequency],
        )


def from_json(text):
    """The case of a report's line."""
    d = json.loads(text) if isinstance(text, str) else text
    belts = tuple(
        Belt(
            b["velocity"],
            tuple(b["law"]),
            b["load"],
            -inf if b["lower"] is None else b["lower"],
            inf if b["upper"] is None else b["upper"],
        )
        for b in d["belts"]
    )
    return Case(
        Oscillator(d["damping"], belts, d["omega"]),
        tuple(d["y0"]),
        d["T"],
        d["kind"],
        d["distance"],
        Units(*d.get("units", ())),
    )


def structures(rng, programs):
    """Some structures: laws of one to three belts, with edges and without. Each is a compilation,
    so a campaign takes a few, the commonest first."""
    first = [
        (("conti", "conti"), True),
        (("conti", "conti"), False),
        (("conti",), False),
        (("conti", "conti", "conti"), True),
        (("coulomb", "coulomb"), True),
        (("stribeck", "conti"), True),
        (("conti",), True),
        (("coulomb", "stribeck"), False),
        (("stribeck", "stribeck", "coulomb"), True),
    ]
    while len(first) < programs:
        laws = tuple(str(law) for law in rng.choice(LAWS, size=rng.choice([1, 2, 2, 2, 3, 3])))
        s = laws, bool(rng.random() < 0.7)
        if s not in first:
            first.append(s)
    return first[:programs]


# ---------------------------------------------------------------- random


def _random_law(rng, name):
    static = rng.uniform(0.5, 1.4)
    if name == "conti":
        quadratic = rng.uniform(0, 0.3) if rng.random() < 0.3 else 0.0
        return name, static, static * rng.uniform(0.3, 0.95), rng.uniform(0.5, 15.0), quadratic
    kinetic = static * rng.uniform(0.4, 1.0)
    return (name, static, kinetic) + ((rng.uniform(0.05, 1.0),) if name == "stribeck" else ())


def _intervals(rng, n, number):
    """Contact intervals of n belts: those of class (c), of class (d), or random ones."""
    style = rng.integers(4) if n > 1 else 3
    if style == 0:
        s = number(-1.2, 1.2)
        cuts = [(-inf, s), (s, inf), (-inf, inf)]
    elif style == 1:
        s0, s1 = sorted((number(-1.2, 1.2), number(-1.2, 1.2)))
        if s0 == s1:
            s1 = s0 + 0.5
        cuts = [(-inf, s1), (s0, inf), (s0, s1)]
    else:
        cuts = []
        for _ in range(n):
            a, b = sorted((number(-1.5, 1.5), number(-1.5, 1.5)))
            if a == b:
                b = a + 1.0
            cuts.append([(a, b), (a, inf), (-inf, b), (-inf, inf)][rng.integers(4)])
    return [cuts[i % len(cuts)] for i in range(n)]


def random_case(rng, structure, T=50.0):
    laws, edges = structure
    intervals = _intervals(rng, len(laws), rng.uniform) if edges else [(-inf, inf)] * len(laws)
    if edges and not any(isfinite(v) for pair in intervals for v in pair):
        intervals[0] = (-inf, rng.uniform(-1.0, 1.0))
    belts = tuple(
        Belt(
            rng.uniform(-1.2, 1.2),
            _random_law(rng, law),
            rng.uniform(0.3, 1.8) if rng.random() < 0.95 else 0.0,
            lower,
            upper,
        )
        for law, (lower, upper) in zip(laws, intervals)
    )
    damping = rng.uniform(0.02, 1.0) if rng.random() < 0.95 else rng.uniform(1.0, 3.0)
    omega = rng.uniform(0.6, 1.6) if rng.random() < 0.4 else 1.0
    y0 = (rng.uniform(-3, 3), rng.uniform(-2, 2))
    return Case(Oscillator(damping, belts, omega), y0, T, "random")


def extreme_case(rng, structure, T=50.0):
    """A random case with one number or two far from the others."""
    case = random_case(rng, structure, T)
    osc, belts = case.oscillator, list(case.oscillator.belts)
    for _ in range(int(rng.integers(1, 3))):
        i, what = int(rng.integers(len(belts))), rng.integers(7)
        b = belts[i]
        if what == 0:
            belts[i] = replace(b, load=float(10 ** rng.uniform(1, 4)))
        elif what == 1:
            belts[i] = replace(b, load=float(10 ** rng.uniform(-9, -1)))
        elif what == 2:
            belts[i] = replace(b, velocity=float(rng.choice([-1, 1]) * 10 ** rng.uniform(-9, -2)))
        elif what == 3:
            belts[i] = replace(b, velocity=float(rng.choice([-1, 1]) * 10 ** rng.uniform(0, 2)))
        elif what == 4 and b.law[0] == "conti":
            belts[i] = replace(b, law=(*b.law[:3], float(10 ** rng.uniform(1.5, 2.5)), b.law[4]))
        elif what == 5 and isfinite(b.lower):
            upper = b.lower + float(10 ** rng.uniform(-7, -2))
            belts[i] = replace(b, upper=min(b.upper, upper))
        elif what == 6:
            osc = replace(osc, damping=float(rng.choice([0.0, -0.05, 10.0, 50.0])))
    start = (case.y0[0] * 10, case.y0[1] * 10) if rng.random() < 0.2 else case.y0
    return Case(replace(osc, belts=tuple(belts)), start, T, "extreme")


# ---------------------------------------------------------------- rational


def _rational_law(rng, name):
    def twentieth(a, b):
        return round(float(rng.integers(round(20 * a), round(20 * b) + 1)) / 20, 2)

    static = float(rng.choice([1.0, 1.0, 0.8, 1.2, 0.5]))
    if name == "conti":
        if rng.random() < 0.5:
            return PAPER
        residual = float(rng.choice([0.6, 0.5, 0.4])) * static
        return name, static, residual, float(rng.choice([10, 5, 2, 1])), 0.0
    kinetic = static * float(rng.choice([1.0, 0.8, 0.6, 0.5]))
    return (name, static, kinetic) + ((twentieth(0.05, 0.5),) if name == "stribeck" else ())


def rational_case(rng, structure, T=50.0):
    """A case whose parameters are multiples of 1/20, and often equal or related."""

    def number(a, b):
        return round(float(rng.integers(round(20 * a), round(20 * b) + 1)) / 20, 2)

    laws, edges = structure
    n = len(laws)
    velocities = [number(-1.0, 1.0) for _ in range(n)]
    relation = rng.integers(7)
    if n > 1:
        if relation == 0:
            velocities[1] = velocities[0]
        elif relation == 1:
            velocities[1] = -velocities[0]
        elif relation == 2:  # slip onsets of the paper's belts share x1 and mode
            velocities[1] = round(velocities[0] - 1.5 * (1 if velocities[0] > 0 else -1), 2)
        elif relation == 3:
            velocities[rng.integers(n)] = 0.0
    elif relation == 3:
        velocities[0] = 0.0
    chosen = {name: _rational_law(rng, name) for name in LAWS}
    same_law = rng.random() < 0.7
    loads = [float(rng.choice([1, 1, 1, 2, 0.5]))] * n
    if rng.random() < 0.4:
        loads = [float(v) for v in rng.choice([1, 1, 2, 0.5, 0.0, 1.5], size=n)]
    damping = float(rng.choice([0.5, 0.5, 0.25, 0.1, 0.05, 1.0, 0.2, 2.0]))
    omega = float(rng.choice([1, 1, 1, 0.5, 2]))

    def law_of(name):
        return chosen[name] if same_law else _rational_law(rng, name)

    belts = tuple(Belt(v, law_of(name), load) for v, name, load in zip(velocities, laws, loads))
    osc = Oscillator(damping, belts, omega)
    if edges:
        special = [x for x in special_positions(osc) if abs(x) < 3]

        def position(a, b):
            # On a slip onset or an equilibrium, or round.
            if special and rng.random() < 0.35:
                return float(rng.choice(special))
            return number(a, b)

        intervals = _intervals(rng, n, position)
        if not any(isfinite(v) for pair in intervals for v in pair):
            intervals[0] = (-inf, number(-1.0, 1.0))
        osc = replace(
            osc,
            belts=tuple(replace(b, lower=lo, upper=up) for b, (lo, up) in zip(belts, intervals)),
        )
    return Case(osc, _special_start(rng, osc, number), T, "rational")


def special_positions(osc):
    """x1 of slip onsets and of equilibria, whatever the other belts' signs and contacts are."""
    found = set()
    table = osc.table()
    for i, belt in enumerate(osc.belts):
        v = belt.velocity / osc.omega
        others = {0.0}
        for k, other in enumerate(osc.belts):
            if k != i:
                r = abs(other.velocity - belt.velocity)
                pull = other.load * engine.mu(table[k], r)
                pull = pull if other.velocity > belt.velocity else -pull
                others |= {s + pull for s in others}
        for rest in others:
            for held in (belt.load * belt.law[1], -belt.load * belt.law[1]):
                found.add(round(rest - osc.damping * v + held, 14))
    rests = {0.0}
    for k, belt in enumerate(osc.belts):
        if belt.velocity:
            pull = belt.load * engine.mu(table[k], abs(belt.velocity))
            rests |= {s + (pull if belt.velocity > 0 else -pull) for s in rests}
    return sorted(found | {round(x, 14) for x in rests})


def _special_start(rng, osc, number):
    edges = [x for b in osc.belts for x in (b.lower, b.upper) if isfinite(x)]
    levels = [b.velocity / osc.omega for b in osc.belts]
    x1, x2 = number(-2.0, 3.0), number(-1.5, 1.5)
    how = rng.integers(8)
    if how == 0:
        return 3.0, 0.0
    if how in (1, 2) and edges:
        x1 = float(rng.choice(edges))
    if how in (2, 3):
        x2 = float(rng.choice(levels))
    if how == 4:
        x1, x2 = float(rng.choice(special_positions(osc))), float(rng.choice([*levels, 0.0]))
    if how == 5:
        x2 = 0.0
        if edges and rng.random() < 0.5:
            x1 = float(rng.choice(edges))
    if how == 6:
        return 0.0, 0.0
    return x1, x2


# ---------------------------------------------------------------- heavy and light belts


def heavy_case(rng, structure, T=50.0):
    """A random or a rational case with loads of 1e-6 to 1e6 beside one another.

    A mass on a heavy belt sticks to it for as long as the run lasts, unless an edge is on its way:
    so a run in four begins near a slip onset or an equilibrium.
    """
    is_round = rng.random() < 0.5
    case = (rational_case if is_round else random_case)(rng, structure, T)
    belts = []
    for belt in case.oscillator.belts:
        load = float(rng.choice([1, 2, 5])) * 10.0 ** int(rng.integers(-6, 6))
        load = load if is_round else float(10 ** rng.uniform(-6, 6))
        belts.append(replace(belt, load=load))
    osc, y0 = replace(case.oscillator, belts=tuple(belts)), case.y0
    if rng.random() < 0.25:
        beside = float(rng.integers(-4, 5)) / 2 if is_round else rng.uniform(-2, 2)
        y0 = (float(rng.choice(special_positions(osc))) + beside, y0[1])
    return replace(
        case, oscillator=osc, y0=y0, kind="heavy, rational" if is_round else "heavy, random"
    )


# ---------------------------------------------------------------- regimes

#: Structures of each regime.
REGIMES = {
    # Four and six belts.
    "many": [(("conti",) * 4, True), (("conti", "coulomb") * 2, False), (("conti",) * 6, True)],
    # The static limit is far from the kinetic friction.
    "jumps": [(("coulomb", "coulomb"), True), (("table",), False), (("table", "conti"), True)],
    # Stribeck's speed is 1e-4 of that of the belt.
    "thin": [(("stribeck",), False), (("stribeck", "conti"), True), (("stribeck",) * 2, False)],
    # Friction that grows with the speed beyond the static limit.
    "rising": [(("peak",), False), (("peak", "peak"), True), (("peak", "conti"), True)],
}


def regime_case(rng, structure, regime, T=50.0):
    """A random or a rational case of a regime."""
    laws, edges = structure
    known = tuple("conti" if law in ("table", "peak") else law for law in laws)
    is_round = rng.random() < 0.5
    case = (rational_case if is_round else random_case)(rng, (known, edges), T)
    belts = []
    for law, belt in zip(laws, case.oscillator.belts):
        static, number = belt.law[1], float(rng.uniform(0.1, 0.9))
        number = round(number, 1) if is_round else number
        if regime == "thin" and law == "stribeck" and belt.velocity:
            belt = replace(belt, law=(*belt.law[:3], 1e-4 * abs(belt.velocity)))
        elif law == "coulomb" and regime == "jumps":
            belt = replace(belt, law=(law, static, number * static))
        elif law == "table":
            belt = replace(belt, law=(law, 1.0 + number, 10 * number))
        elif law == "peak":
            belt = replace(belt, law=(law, static, static * (1 + number), number, 0.5 * number))
        belts.append(belt)
    osc = replace(case.oscillator, belts=tuple(belts))
    return replace(case, oscillator=osc, kind=f"{regime}, {case.kind}")


# ---------------------------------------------------------------- grazing


def grazing_case(rng, structure, smallest, largest=1e-3):
    """An orbit that misses, or goes beyond, a boundary or an edge by a given distance.

    It is built backwards from the touching point, in the field of the mode before, whose friction
    keeps its sign beyond the boundary.
    """
    while True:
        osc = random_case(rng, structure).oscillator
        distance = float(np.exp(rng.uniform(np.log(smallest), np.log(largest))))
        distance *= 1 if rng.random() < 0.5 else -1
        edges = [x for b in osc.belts for x in (b.lower, b.upper) if isfinite(x)]
        at_edge = bool(edges) and rng.random() < 0.5
        if at_edge:
            edge, side = float(rng.choice(edges)), int(rng.choice([-1, 1]))
            x1, x2 = edge + side * distance, 0.0
            mode = _mode_beside(osc, edge, side, x2, {})
            # On that side of the edge the acceleration has to turn x1 back from it.
            if side * engine.force(osc, mode, x1, x2) <= 0:
                continue
        else:
            k = int(rng.integers(len(osc.belts)))
            if osc.belts[k].load == 0 or osc.belts[k].velocity == 0:
                continue
            sign = 1 if osc.belts[k].velocity > 0 else -1
            x2 = osc.belts[k].velocity / osc.omega - sign * distance
            x1 = rng.uniform(-2, 2)
            for _ in range(3):
                mode = _mode_beside(osc, x1, 1, x2, {k: sign})
                x1 = engine.force(osc, mode, 0.0, x2)
            if mode != _mode_beside(osc, x1, 1, x2, {k: sign}) or abs(mode[k]) == 2:
                continue
            if any(abs(x1 - edge) < 0.05 for edge in edges):
                continue
        before = rng.uniform(0.3, 1.5)
        y0 = engine.flow(osc, mode, (x1, x2), -before)
        if not np.all(np.isfinite(y0)):
            continue
        case = Case(
            osc,
            tuple(y0),
            4.0,
            "edge" if at_edge else "boundary",
            distance,
        )
        run = engine.simulate(osc, y0, case.T)
        first = run.t[0] if len(run.t) else inf
        # Grazing must be the first event, and no other event may be as close.
        if distance > 0:
            good = (
                first > before + 1e-4 and abs(run.margin / distance - 1) < 0.05 + 1e-15 / distance
            )
        else:
            good = abs(first - before) < 2 * np.sqrt(10 * abs(distance))
        if good and engine.simulate(osc, y0, before / 2).margin > 1e-4:
            return case


def grazing_cycle(rng, smallest, largest=1e-3):
    """An oscillator with an extra belt, whose edge a cycle misses, or goes beyond, by a distance.

    Or the cycle misses the boundary of an extra belt without load, which changes only the events.
    The start is on the cycle of the other belts, half a loop before.
    """
    while True:
        structure = (("conti",) * int(rng.integers(1, 3)), False)
        osc = random_case(rng, structure).oscillator
        cycle = engine.attractor(osc, (3.0, 0.0))
        if cycle.kind != "cycle" or cycle.period > 20 or cycle.margin < 1e-3:
            continue
        distance = float(np.exp(rng.uniform(np.log(smallest), np.log(largest))))
        distance *= 1 if rng.random() < 0.5 else -1
        sign = int(rng.choice([-1, 1]))
        law = _random_law(rng, "conti")
        if rng.random() < 0.5:
            edge = cycle.x1[(sign + 1) // 2] + sign * distance
            bounds = (edge, inf) if sign > 0 else (-inf, edge)
            extra, kind = Belt(rng.uniform(-1, 1), law, rng.uniform(0.3, 1.5), *bounds), "edge"
        else:
            x2 = cycle.x2[(sign + 1) // 2]
            if any(abs(x2 - b.velocity / osc.omega) < 1e-2 for b in osc.belts):
                continue
            extra, kind = Belt(osc.omega * (x2 + sign * distance), law, 0.0), "boundary"
        y0 = engine.simulate(osc, cycle.y, 0.5 * cycle.period).y_end
        osc = replace(osc, belts=(*osc.belts, extra))
        return Case(osc, tuple(y0), 50.0, f"cycle, {kind}", distance)


def _mode_beside(osc, x1, side, x2, given):
    """The slip mode beside an edge, or at x1; given: signs of some belts."""
    mode = []
    for i, b in enumerate(osc.belts):
        if x1 < b.lower or (x1 == b.lower and side < 0):
            mode.append(-2)
        elif x1 > b.upper or (x1 == b.upper and side > 0):
            mode.append(2)
        else:
            mode.append(given.get(i, 1 if b.velocity > osc.omega * x2 else -1))
    return tuple(mode)
