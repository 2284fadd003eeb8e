"""Cases of forced oscillators, runs of many of them, and verdicts on another code's answers.

    rng = np.random.default_rng(0)
    for structure in structures(rng, 12):            # the package compiles once for a structure
        batch = [case(rng, structure) for _ in range(4096)]     # half of them on round numbers
        told = ...                                   # the package's answers, one `Told` a case
        for verdict, mine in judged(batch, told, tol=1e-8, threads=2):
            ...                                      # verdict in GOOD, or what differs

Statuses are those of `engine`. STUCK_FOREVER and OK are the same answer if the state at the final
time is the same: a run that is held for ever is held until then, and where frequencies have no
common period not every code can distinguish the two. Verdicts are those of `compare`:

- "same": the engine's sequence, mode, status, and states within what the tolerance allows;
- "tolerance": the answer of a run that is disturbed by the tolerance at every step and event, or,
  where disturbed runs have other events than the run, an answer within the range of theirs;
- "corner": the run comes within 1e-9 of another outcome, where rounding decides, and the answer is
  that of a neighbour, whose numbers are moved by 1e-7; or the engine stops at a pseudo-focus, and
  the events until then are the same;
- otherwise the difference, in a word or two.

`stick_case` gives stick phases that end at a simple root of |needed| = capacity next to a double
one, touch it, pass a triple one, or miss it narrowly, together with the time of slip onset from a
scan of the closed form. `derivative` differences the engine's final state along a direction;
`monodromy`, `periodic` and `exponent` do so over periods of the forcing.
"""

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import inf, isfinite, pi

import numpy as np
from scipy.optimize import brentq

from . import compare, forced
from .forced import BaseMotion, Belt, Harmonic, Oscillating, Oscillator

__all__ = [
    "GOOD",
    "Case",
    "Structure",
    "case",
    "derivative",
    "exponent",
    "from_json",
    "judge",
    "judged",
    "monodromy",
    "periodic",
    "random_case",
    "round_case",
    "simulate_all",
    "spread",
    "stick_case",
    "stroboscopic",
    "structures",
]

GOOD = compare.GOOD
#: Statuses of another code that took too many arcs or steps, and the one of the engine.
GAVE_UP = (*compare.GAVE_UP, forced.BUDGET)
#: Limit of events for the engine where another code reached the end.
MOST_EVENTS = 100_000
LAWS = ("conti", "coulomb", "stribeck", "cubic")


@dataclass(frozen=True)
class Structure:
    """What decides the compiled program: laws of the belts, whether there are edges, the number of
    forces, which velocities and loads oscillate, and how many forces, the last ones, come from a
    moving support."""

    laws: tuple
    edges: bool
    forces: int
    velocities: tuple
    loads: tuple
    supports: int = 0

    @property
    def kinds(self):
        """The classes of the forces."""
        return [Harmonic] * (self.forces - self.supports) + [BaseMotion] * self.supports


@dataclass(frozen=True)
class Case:
    """A run of an oscillator from y0 over [t0, T]."""

    oscillator: Oscillator
    y0: tuple
    T: float = 60.0
    kind: str = "random"
    t0: float = 0.0

    @property
    def structure(self):
        belts = self.oscillator.belts
        return Structure(
            tuple(b.law[0] for b in belts),
            any(isfinite(b.lower) or isfinite(b.upper) for b in belts),
            len(self.oscillator.forces),
            tuple(isinstance(b.velocity, Oscillating) for b in belts),
            tuple(isinstance(b.load, Oscillating) for b in belts),
            sum(isinstance(f, BaseMotion) for f in self.oscillator.forces),
        )

    @property
    def belts(self):
        return self.oscillator.belts

    def simulate(self, **options):
        return forced.simulate(self.oscillator, self.y0, self.T, t0=self.t0, **options)

    def to_json(self):
        """The complete parameters, every number by its shortest exact digits."""
        osc = self.oscillator

        def wave(w):
            return list(vars(w).values()) if isinstance(w, Oscillating) else w

        belts = [
            dict(
                velocity=wave(b.velocity),
                law=list(b.law),
                load=wave(b.load),
                lower=None if b.lower == -inf else b.lower,
                upper=None if b.upper == inf else b.upper,
            )
            for b in osc.belts
        ]
        return dict(
            damping=osc.damping,
            omega=osc.omega,
            belts=belts,
            forces=[list(vars(f).values()) for f in osc.forces],
            supports=self.structure.supports,
            y0=list(self.y0),
            t0=self.t0,
            T=self.T,
            kind=self.kind,
        )


def from_json(text):
    """The case of a report's line."""
    d = json.loads(text) if isinstance(text, str) else text

    def wave(w):
        return Oscillating(*w) if isinstance(w, list) else w

    belts = tuple(
        Belt(
            wave(b["velocity"]),
            tuple(b["law"]),
            wave(b["load"]),
            -inf if b["lower"] is None else b["lower"],
            inf if b["upper"] is None else b["upper"],
        )
        for b in d["belts"]
    )
    first = len(d["forces"]) - d.get("supports", 0)
    forces = tuple((Harmonic, BaseMotion)[i >= first](*f) for i, f in enumerate(d["forces"]))
    osc = Oscillator(d["damping"], belts, forces, d["omega"])
    return Case(osc, tuple(d["y0"]), d["T"], d["kind"], d["t0"])


def structures(rng, programs):
    """Some structures, the commonest first."""

    def of(laws, edges, forces, velocities=(), loads=(), supports=0):
        flags = [tuple(i in chosen for i in range(len(laws))) for chosen in (velocities, loads)]
        return Structure(tuple(laws), edges, forces, *flags, supports)

    first = [
        of(["coulomb"], False, 1),
        of(["cubic"], False, 1),
        of(["conti", "conti"], True, 1),
        of(["coulomb", "coulomb"], True, 2, velocities=[0], supports=1),
        of(["stribeck"], False, 2, loads=[0]),
        of(["conti"], True, 1, velocities=[0]),
        of(["coulomb", "stribeck", "conti"], True, 2, velocities=[1], loads=[0]),
        of(["cubic", "coulomb"], False, 0, velocities=[0, 1]),
        of(["coulomb"], True, 0, velocities=[0], loads=[0]),
        of(["stribeck", "stribeck", "cubic"], True, 1, supports=1),
        of(["coulomb"], False, 1, supports=1),
        of(["conti"], True, 2, supports=2),
    ]
    while len(first) < programs:
        n = int(rng.choice([1, 1, 2, 2, 3]))
        laws = [str(law) for law in rng.choice(LAWS, size=n)]
        moving, loaded = ([i for i in range(n) if rng.random() < 0.35] for _ in range(2))
        forces = int(rng.integers(0 if moving or loaded else 1, 3))
        supports = int(rng.integers(forces + 1)) if rng.random() < 0.5 else 0
        s = of(laws, bool(rng.random() < 0.6), forces, moving, loaded, supports)
        if s not in first:
            first.append(s)
    return first[:programs]


def batches(options, size, programs):
    """Pairs of a structure and a number of runs, at most `size`."""
    found = structures(np.random.default_rng(options.seed), programs)
    if options.structure is not None:
        found = found[options.structure : options.structure + 1]
    each = -(-options.runs // len(found))
    return [
        (structure, min(size, each - first))
        for structure in found
        for first in range(0, each, size)
    ]


def case(rng, structure, T=60.0):
    """A random case, or one on round numbers."""
    return (round_case if rng.random() < 0.5 else random_case)(rng, structure, T)


# ---------------------------------------------------------------- random


def _random_law(rng, name):
    if name == "cubic":
        a0, a3 = rng.uniform(0.5, 1.6), rng.uniform(0.1, 0.6)
        # The minimum a0 - 2/3 a1 sqrt(a1/(3 a3)) stays above a tenth of a0.
        most = (1.35 * a0 * np.sqrt(3 * a3)) ** (2 / 3)
        return name, a0, rng.uniform(0.0, 1.0) * float(most), a3
    static = rng.uniform(0.5, 1.4)
    if name == "conti":
        quadratic = rng.uniform(0, 0.3) if rng.random() < 0.3 else 0.0
        return name, static, static * rng.uniform(0.3, 0.95), rng.uniform(0.5, 12.0), quadratic
    kinetic = static * (1.0 if rng.random() < 0.3 else rng.uniform(0.4, 1.0))
    return (name, static, kinetic) + ((rng.uniform(0.05, 1.0),) if name == "stribeck" else ())


def _intervals(structure, number, rng):
    n = len(structure.laws)
    cuts = [(-inf, inf)] * n
    while structure.edges and not any(isfinite(v) for pair in cuts for v in pair):
        for i in range(n):
            a, b = sorted((number(-1.3, 1.3), number(-1.3, 1.3)))
            b = a + 1.0 if a == b else b
            cuts[i] = [(a, b), (a, inf), (-inf, b), (-inf, inf)][rng.integers(4)]
        if n > 1 and rng.random() < 0.5:
            a = number(-1.2, 1.2)
            cuts[:2] = [(-inf, a), (a if rng.random() < 0.5 else a - 0.5, inf)]
    return cuts


def random_case(rng, structure, T=60.0):
    """A case with random numbers; forces, velocities and loads share one or two frequencies."""
    known = rng.uniform(0.3, 2.5, size=rng.integers(1, 3))

    def frequency():
        return float(rng.choice(known))

    def phase():
        return rng.uniform(-pi, pi)

    belts = []
    cuts = _intervals(structure, rng.uniform, rng)
    for law, moves, swells, cut in zip(structure.laws, structure.velocities, structure.loads, cuts):
        velocity, load = rng.uniform(-1.2, 1.2), rng.uniform(0.3, 1.5)
        if moves:
            velocity = Oscillating(velocity, rng.uniform(0.05, 0.8), frequency(), phase())
        if swells:
            load = Oscillating(load, load * rng.uniform(0.1, 1.0), frequency(), phase())
        belts.append(Belt(velocity, _random_law(rng, law), load, *cut))
    forces = tuple(kind(rng.uniform(0.05, 1.5), frequency(), phase()) for kind in structure.kinds)
    omega = rng.uniform(0.6, 1.6) if rng.random() < 0.3 else 1.0
    osc = Oscillator(rng.uniform(0.02, 0.8), tuple(belts), forces, omega)
    t0 = rng.uniform(-5.0, 5.0) if rng.random() < 0.3 else 0.0
    return Case(osc, (rng.uniform(-2.5, 2.5), rng.uniform(-2, 2)), t0 + T, "random", t0)


# ---------------------------------------------------------------- round numbers


def _round_law(rng, name):
    static = float(rng.choice([1.0, 1.0, 0.8, 0.5]))
    if name == "cubic":
        return (name, 1.5, 1.5, 0.45) if rng.random() < 0.5 else (name, static, static / 2, 0.5)
    if name == "conti":
        return (name, 1.0, 0.6, 10.0, 0.0) if rng.random() < 0.5 else (name, static, 0.5, 2.0, 0.0)
    kinetic = static * float(rng.choice([1.0, 1.0, 0.8, 0.5]))
    return (name, static, kinetic) + ((0.25,) if name == "stribeck" else ())


def round_case(rng, structure, T=60.0):
    """A case with frequencies 1, 1/2 and 2, phases multiples of pi/2, forces equal to capacities,
    other numbers multiples of 1/20, and many equal numbers."""

    def number(a, b):
        return round(float(rng.integers(round(20 * a), round(20 * b) + 1)) / 20, 2)

    def phase():
        return float(rng.integers(4)) * pi / 2

    known = [float(f) for f in rng.choice([1.0, 0.5, 2.0], size=2, replace=False)]
    known = known[:1] if rng.random() < 0.5 else known

    def frequency():
        return float(rng.choice(known))

    laws = {name: _round_law(rng, name) for name in LAWS}
    velocity = float(rng.choice([0.0, 0.0, 0.5, 1.0, number(-1, 1)]))
    wave = Oscillating(
        velocity, float(rng.choice([0.5, 1.0, 0.25, abs(velocity) or 1.0])), frequency(), phase()
    )
    load = float(rng.choice([1.0, 1.0, 0.5, 2.0]))
    belts = []
    cuts = _intervals(structure, number, rng)
    for law, moves, swells, cut in zip(structure.laws, structure.velocities, structure.loads, cuts):
        v = float(rng.choice([velocity, velocity, -velocity, 0.0, number(-1, 1)]))
        if moves:
            # The same wave, the same mean, or another one.
            v = [wave, replace(wave, phase=phase()), replace(wave, mean=v)][rng.integers(3)]
        u = load if rng.random() < 0.7 else float(rng.choice([0.5, 1.0, 0.0, 1.5]))
        if swells:
            u = Oscillating(u, u * float(rng.choice([0.5, 1.0])), frequency(), phase())
        belts.append(Belt(v, laws[law], u, *cut))
    capacity = load * laws[structure.laws[0]][1]
    forces = tuple(
        kind(capacity * float(rng.choice([1.0, 1.0, 0.5, 2.0])), frequency(), phase())
        for kind in structure.kinds
    )
    damping = float(rng.choice([0.5, 0.25, 0.1, 0.05, 1.0, 0.2]))
    osc = Oscillator(damping, tuple(belts), forces, float(rng.choice([1, 1, 1, 1, 0.5, 2])))
    t0 = float(rng.choice([0.0, 0.0, 0.0, pi / 2, 1.0]))
    return Case(osc, _round_start(rng, osc, t0, number), t0 + T, "round", t0)


def _round_start(rng, osc, t0, number):
    edges = [x for b in osc.belts for x in (b.lower, b.upper) if isfinite(x)]
    x1, x2 = number(-1.5, 1.5), number(-1, 1)
    how = rng.integers(6)
    if how == 0:
        return 0.0, 0.0
    if how in (1, 2) and edges:
        x1 = float(rng.choice(edges))
    if how in (2, 3, 4):
        b = osc.belts[rng.integers(len(osc.belts))].velocity
        moving = isinstance(b, Oscillating)
        b = b.mean + b.amplitude * float(np.cos(b.frequency * t0 + b.phase)) if moving else b
        x2 = b / osc.omega
    if how == 4:
        x1 = 0.0
    return x1, x2


# ---------------------------------------------------------------- stick phases next to double roots

#: What |needed| - capacity does at the time for which a stick phase is made.
MEETINGS = ("touches", "passes", "misses", "hits")


def stick_case(rng, meeting, distance=0.0):
    """A case that starts stuck, and the time of its slip onset.

    One belt at a speed nu > 0 and a force F cos(Omega t + phi): needed = x1 + zeta nu + nu t -
    F cos(Omega t + phi) meets the capacity at a local maximum at a time t*, where it "touches" it,
    or "misses" or "hits" it by a distance; with nu = F Omega it "passes" it at a triple root.
    """
    while True:
        force, frequency = rng.uniform(0.2, 1.5), rng.uniform(0.4, 2.5)
        phase, zeta = rng.uniform(-pi, pi), rng.uniform(0.0, 0.5)
        capacity = rng.uniform(0.6, 2.0)
        if meeting == "passes":
            nu, angle = force * frequency, -pi / 2
        else:
            nu = rng.uniform(0.05, 0.9) * force * frequency
            angle = pi + np.arcsin(nu / (force * frequency))
        beyond = {"touches": 0.0, "passes": 0.0, "misses": -distance, "hits": distance}[meeting]
        at = ((angle - phase) % (2 * pi)) / frequency
        x1 = capacity + beyond - zeta * nu - nu * at + force * np.cos(frequency * at + phase)

        def over(t, line=(x1 + zeta * nu - capacity, nu), wave=(force, frequency, phase)):
            """needed - capacity"""
            return line[0] + line[1] * t - wave[0] * np.cos(wave[1] * t + wave[2])

        before = over(np.linspace(0.0, at, 2000)[:-40])
        other_limit = 1e-3 - 2 * capacity
        if at < 0.3 or np.any(before > -1e-4) or np.any(before < other_limit):
            continue
        if meeting == "passes":
            onset = at
        elif meeting == "hits":
            start = at - 3 * np.sqrt(2 * distance / abs(force * frequency**2 * np.cos(angle)))
            if over(start) >= 0:
                continue
            onset = brentq(over, start, at, xtol=1e-15)
        else:
            ts = np.linspace(at + 0.02, at + 2 * pi / frequency, 4000)
            values = over(ts)
            if values[0] > -1e-9 or not np.any(values > 0):
                continue
            first = int(np.argmax(values > 0))
            if np.any(values[:first] < other_limit):
                continue
            onset = brentq(over, ts[first - 1], ts[first], xtol=1e-15)
        law = ("coulomb", 1.0, float(rng.choice([1.0, 0.7])))
        osc = Oscillator(zeta, (Belt(nu, law, capacity),), (Harmonic(force, frequency, phase),))
        return Case(osc, (x1, nu), onset + 0.5, meeting), onset


# ---------------------------------------------------------------- many runs, and disturbed ones


def simulate_all(cases, threads=2, **options):
    """The runs of many cases, on several threads: the engine releases the interpreter's lock."""
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(lambda one: one.simulate(**options), cases))


def spread(case, noise, mine):
    """Largest changes of the final state and of the events' (t, x1, x2) by disturbances `noise`.

    Times count as distances, at the speed at which each event's line was approached. Returns both
    changes and the disturbed runs.
    """
    runs = [_disturbed(case, noise, seed, mine) for seed in range(compare.DISTURBED)]
    alike = [r for r in runs if r.sequence == mine.sequence and r.status == mine.status]
    far = max((np.max(np.abs(np.subtract(r.y_end, mine.y_end))) for r in alike), default=0.0)
    rows = max((_away(r.t, r.y, mine) for r in alike), default=0.0)
    return far, rows, runs


def _disturbed(case, noise, seed, mine):
    """A disturbed run, with room for twice the events of the undisturbed run `mine`."""
    return case.simulate(noise=noise, seed=seed, max_events=max(20_000, 2 * len(mine.t)))


def _away(t, y, mine):
    if not len(mine.t):
        return 0.0
    late = np.abs(t - mine.t) * np.minimum(mine.speeds, 1.0)
    return float(max(np.max(late), np.max(np.abs(y - mine.y))))


# ---------------------------------------------------------------- verdicts


def difference(case, told, mine, tol):
    """What differs between an answer `told` and a run of the engine, or None."""
    if mine.status == forced.BUDGET and told.status in GAVE_UP:
        return None  # too many events for both, and both say so
    held = (forced.OK, forced.STUCK_FOREVER)
    if told.status != mine.status and not (told.status in held and mine.status in held):
        return f"status {told.status}, not {mine.status}"
    if told.status == forced.STUCK_FOREVER and 0 not in mine.mode_end:
        return "held for ever, and is not"
    if mine.status == forced.NOT_FINITE:
        return None
    n = len(mine.kind)
    if told.n_events != n:
        return f"{'more' if told.n_events > n else 'fewer'} events"
    if told.events is not None and tuple(e[1:3] for e in told.events) != mine.sequence:
        return "sequence"
    if tuple(told.mode) != tuple(mine.mode_end):
        return "mode"
    far = np.max(np.abs(np.array([told.x1, told.x2]) - mine.y_end))
    rows = 0.0
    if told.events:
        table = np.array([(e[0], e[3], e[4]) for e in told.events])
        rows = _away(table[:, 0], table[:, 1:], mine)
    room = compare.STEPS * tol
    # Not `>`: NaN is far.
    if far <= room and rows <= room:
        return None
    d_far, d_rows, _ = spread(case, tol, mine)
    if not far <= compare.STEPS * (tol + d_far):
        return "state"
    return None if rows <= compare.STEPS * (tol + d_rows) else "event"


def judge(case, told, tol):
    """The verdict on a final state or a trajectory, and the engine's run."""
    mine = case.simulate(tol=min(1e-13, 0.01 * tol))
    if mine.status == forced.BUDGET and told.status not in GAVE_UP:
        mine = case.simulate(max_events=MOST_EVENTS)
    if mine.status == forced.PSEUDO_FOCUS and told.status != mine.status:
        same = told.events is None or _alike_until(told.events, mine, mine.t_end - 0.1)
        return ("corner" if same else "sequence"), mine
    if told.status == forced.PSEUDO_FOCUS and mine.status != told.status:
        return _of_focus(told, mine), mine
    what = difference(case, told, mine, tol)
    if what is None:
        return "same", mine
    if _of_disturbed_runs(case, told, mine, tol):
        return "tolerance", mine
    if mine.margin <= compare.CORNER or mine.status == forced.CORNER:
        for other in neighbours(case):
            his = other.simulate()
            if his.status != forced.CORNER:
                if difference(other, told, his, max(tol, compare.NEIGHBOUR)) is None:
                    return "corner", mine
        return f"corner: {what}", mine
    return what, mine


def _of_focus(told, mine):
    """The verdict on an answer that ended at an edge which pushes back from both sides, where loops
    shrink; the engine goes on along them, and may not have fewer events than the answer."""
    n = told.n_events
    if len(mine.t) <= n or (
        told.events and tuple(e[1:3] for e in told.events) != mine.sequence[:n]
    ):
        return "focus that is none"
    # The loops that remain grow and shrink with the force, and shrink on the whole.
    speeds = np.abs(mine.y[n - 1 :, 1])
    stays = np.all(np.abs(mine.y[n - 1 :, 0] - told.x1) <= speeds[0])
    return "same" if stays and np.max(speeds) <= 3 * speeds[0] else "focus that is none"


def _of_disturbed_runs(case, told, mine, tol):
    """Whether an answer is that of a disturbed run with another sequence than the engine's; or, if
    there are such runs, has a number of events and a state within the range of theirs."""
    others = []
    for seed in range(compare.DISTURBED):
        for noise in (tol, 10 * tol):
            other = _disturbed(case, noise, seed, mine)
            if other.sequence != mine.sequence or other.status != mine.status:
                if difference(case, told, other, 10 * noise) is None:
                    return True
                others += [other] if noise == tol else []
    if not others:
        return False
    for seed in range(compare.DISTURBED, 4 * compare.DISTURBED):
        other = _disturbed(case, tol, seed, mine)
        if difference(case, told, other, 10 * tol) is None:
            return True
        others.append(other)
    rows = np.array([(len(other.t), *other.y_end) for other in others])
    low, high = rows.min(axis=0), rows.max(axis=0)
    room = 0.5 * (high - low)  # because the runs are few
    row = np.array([told.n_events, told.x1, told.x2])
    alike = told.status in {other.status for other in others}
    return bool(alike and np.all((low - room <= row) & (row <= high + room)))


def _alike_until(events, mine, t):
    early = [e[1:3] for e in events if e[0] < t]
    right = [pair for s, pair in zip(mine.t, mine.sequence) if s < t]
    # Numbers may differ by one, if an event is close to t.
    shared = min(len(early), len(right))
    return abs(len(early) - len(right)) <= 1 and early[:shared] == right[:shared]


def judged(cases: Sequence, told: Sequence, tol, threads=2):
    """Verdicts and the engine's runs, judged on several threads."""
    pool = ThreadPoolExecutor(threads)
    try:
        return list(pool.map(lambda one, answer: judge(one, answer, tol), cases, told))
    finally:
        pool.shutdown(cancel_futures=True)


# ---------------------------------------------------------------- neighbours and derivatives
#
# A direction is a list of numbers in the order of `_numbers`.


def _numbers(case):
    """All numbers of a case that can be moved, and a name for each: equal numbers of one kind share
    a name, and stay equal along a direction that is `tied`."""
    osc = case.oscillator
    values, names = [*case.y0, osc.damping, osc.omega], ["x1", "x2", "damping", "omega"]

    def add(name, value):
        values.append(value)
        names.append((name, value))

    def add_wave(name, wave):
        if isinstance(wave, Oscillating):
            for part, value in vars(wave).items():
                add(part if part in ("frequency", "phase") else name + part, value)
        else:
            add(name + "mean", wave)

    for b in osc.belts:
        add_wave("velocity ", b.velocity)
        add_wave("load ", b.load)
        add("static", b.law[1])
        add("edge", b.lower)
        add("edge", b.upper)
    for f in osc.forces:
        for part, value in vars(f).items():
            add(part if part in ("frequency", "phase") else "force " + part, value)
    return np.array(values, float), names


def moved(case, direction, by=1.0):
    """The case with its numbers moved along a direction."""
    values, _ = _numbers(case)
    # Infinite numbers stay infinite.
    rest = iter(np.where(np.isfinite(values), values + by * np.asarray(direction), values).tolist())
    y0, damping, omega = (next(rest), next(rest)), next(rest), next(rest)

    def take(wave):
        count = 4 if isinstance(wave, Oscillating) else 1
        parts = [next(rest) for _ in range(count)]
        return Oscillating(*parts) if count == 4 else parts[0]

    belts = []
    for b in case.oscillator.belts:
        velocity, load = take(b.velocity), take(b.load)
        law = (b.law[0], next(rest), *b.law[2:])
        if law[0] == "coulomb" and b.law[1] == b.law[2]:
            # Both move together, so that the static limit is not below the kinetic friction.
            law = ("coulomb", law[1], law[1])
        belts.append(Belt(velocity, law, load, next(rest), next(rest)))
    forces = tuple(kind(next(rest), next(rest), next(rest)) for kind in case.structure.kinds)
    return replace(case, oscillator=Oscillator(damping, tuple(belts), forces, omega), y0=y0)


def tied(case, direction):
    """A direction in which numbers of one kind that are equal stay equal."""
    groups = {}
    return [groups.setdefault(name, d) for name, d in zip(_numbers(case)[1], direction)]


def neighbours(case, by=compare.NEIGHBOUR, joint=24, seed=0):
    """The case with one number moved up or down, then many of them at random."""
    size = len(_numbers(case)[0])
    for i in range(size):
        for sign in (1.0, -1.0):
            yield moved(case, sign * np.eye(size)[i], by)
    rng = np.random.default_rng(seed)
    for k in range(joint):
        direction = rng.uniform(-1, 1, size)
        yield moved(case, tied(case, direction) if k % 2 else direction, by)
    for _ in range(joint):
        yield moved(case, rng.uniform(-1, 1, size) * (rng.uniform(size=size) < 0.3), by)


def derivative(case, direction, step=1e-4, levels=4):
    """d(x1, x2 at T) along a direction, by Richardson's differences of the engine.

    Returns (value, error), or None where the runs of the differences pass other events. Smaller
    steps are tried twice.
    """
    mine = case.simulate()
    for size in (step, 0.1 * step, 0.01 * step):
        rows, same = [], True
        for i in range(levels):
            h = size / 2**i
            pair = [moved(case, direction, sign * h).simulate() for sign in (1.0, -1.0)]
            same = same and all(
                r.sequence == mine.sequence and r.mode_end == mine.mode_end for r in pair
            )
            row = [np.subtract(pair[0].y_end, pair[1].y_end) / (2 * h)]
            for j in range(1, i + 1):
                row.append(row[-1] + (row[-1] - rows[-1][j - 1]) / (4**j - 1))
            rows.append(row)
        if same:
            error = max(
                np.max(np.abs(rows[-1][-1] - other)) for other in (rows[-1][-2], rows[-2][-1])
            )
            return rows[-1][-1], float(error)
    return None


# ---------------------------------------------------------------- periodic motions and exponents


def stroboscopic(osc, y, periods, period=None, **options):
    """The run from y at t = 0 over a number of periods of the first force, or of `period`."""
    period = 2 * pi / osc.forces[0].frequency if period is None else period
    options = dict(max_events=400 + 40 * periods) | options
    return forced.simulate(osc, y, periods * period, **options)


def monodromy(osc, y, periods, period=None, h=1e-4):
    """The derivative of the state after some periods by the state before, by differences.

    Two steps, extrapolated: the error is some h^4 and 1e-13/h. It is valid only where the runs of
    the differences pass the same events.
    """

    def difference(d, h):
        ends = [stroboscopic(osc, y + sign * h * d, periods, period).y_end for sign in (1, -1)]
        return np.subtract(*ends) / (2 * h)

    return np.column_stack([(4 * difference(d, h / 2) - difference(d, h)) / 3 for d in np.eye(2)])


def periodic(osc, guess, periods, period=None, h=1e-4):
    """A periodic motion by Newton's method: its state at t = 0 and its multipliers, in order."""
    y = np.array(guess, float)
    for _ in range(20):
        M = monodromy(osc, y, periods, period, h)
        end = np.array(stroboscopic(osc, y, periods, period).y_end)
        step = np.linalg.solve(M - np.eye(2), y - end)
        y = y + step
        if np.max(np.abs(step)) < 1e-12:
            break
    return y, np.sort(np.linalg.eigvals(monodromy(osc, y, periods, period, h)))


def exponent(osc, y, periods, size=1e-8, transient=300):
    """Lyapunov exponent per period, and its standard error, by a neighbour that is moved back to
    the distance `size` after each period."""
    y = np.array(stroboscopic(osc, y, transient).y_end)
    along, growth = np.array([size, 0.0]), []
    for _ in range(periods + 80):
        ends = [np.array(stroboscopic(osc, start, 1).y_end) for start in (y, y + along)]
        y, along = ends[0], ends[1] - ends[0]
        growth.append(np.log(np.linalg.norm(along) / size))
        along *= size / np.linalg.norm(along)
    # The first periods turn the neighbour into the direction that grows most.
    blocks = np.mean(np.reshape(growth[80:], (40, -1)), axis=1)
    return float(np.mean(blocks)), float(np.std(blocks, ddof=1) / np.sqrt(40))
