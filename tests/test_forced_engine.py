"""The engine of forced runs against SciPy, closed forms and published motions."""

import json
from dataclasses import replace
from math import inf, pi, sqrt
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, minimize_scalar

from tests.campaign import cases, engine, forced, forced_cases
from tests.campaign.forced import (
    CROSS,
    EDGE,
    OK,
    SLIP,
    STICK,
    STUCK_FOREVER,
    Belt,
    Harmonic,
    Oscillating,
    Oscillator,
)

# The engine is compiled for half a minute.
pytestmark = pytest.mark.slow(first=True)

# ---------------------------------------------------------------- SciPy, with its own event loop


def law(spec):
    """mu(r) of a law, written anew."""
    name, static, *p = spec
    if name == "conti":
        p1, p3, p2 = p
        return lambda r: (static - p1) / (1 + p3 * r) + p1 + p2 * r**2
    if name == "coulomb":
        return lambda r: p[0]
    if name == "stribeck":
        return lambda r: p[0] + (static - p[0]) * np.exp(-r / p[1])
    return lambda r: static - p[0] * r + p[1] * r**3


def wave(w):
    """A number, or an `Oscillating`, as a function of the time; and its derivative."""
    if not isinstance(w, Oscillating):
        return lambda t: w, lambda t: 0.0
    angle = lambda t: w.frequency * t + w.phase  # noqa: E731
    return (
        lambda t: w.mean + w.amplitude * np.cos(angle(t)),
        lambda t: -w.amplitude * w.frequency * np.sin(angle(t)),
    )


def push(force, t, damping):
    """What pushes the mass: a force, or spring and dashpot of a support that moves."""
    angle = force.frequency * t + force.phase
    place = force.amplitude * np.cos(angle)
    if not isinstance(force, forced.BaseMotion):
        return place
    return place + damping * -force.frequency * force.amplitude * np.sin(angle)


class Peer:
    """A run by `solve_ivp`: stick phases are integrated, too, and end where the needed force, asked
    of the right-hand side, exceeds the capacity. A step may hide what is shorter."""

    def __init__(self, case, step=0.05):
        osc = self.osc = case.oscillator
        self.step = step
        self.nu, self.slope = zip(*(wave(b.velocity) for b in osc.belts))
        self.load = [wave(b.load)[0] for b in osc.belts]
        self.mu = [law(b.law) for b in osc.belts]
        self.t, self.T, self.y = case.t0, case.T, np.array(case.y0, float)
        self.rows = []
        self.mode = [
            -2 if self.y[0] < b.lower else 2 if self.y[0] > b.upper else self.sign(i)
            for i, b in enumerate(osc.belts)
        ]
        while self.t < self.T:
            self.arc()

    def sign(self, i):
        return 1 if self.nu[i](self.t) > self.osc.omega * self.y[1] else -1

    def pull(self, t, y):
        """x2' by all but a belt that the mass is stuck to."""
        total = -y[0] - self.osc.damping * y[1]
        total += sum(push(f, t, self.osc.damping) for f in self.osc.forces)
        for i, m in enumerate(self.mode):
            if abs(m) == 1:
                r = m * (self.nu[i](t) - self.osc.omega * y[1])
                total += m * self.load[i](t) * self.mu[i](max(r, -1e-2))
        return total

    def needed(self, k, t, y):
        return self.slope[k](t) / self.osc.omega - self.pull(t, y)

    def capacity(self, k, t):
        return self.load[k](t) * self.osc.belts[k].law[1]

    def arc(self):
        osc, omega = self.osc, self.osc.omega
        k = self.mode.index(0) if 0 in self.mode else None
        lines = []

        def add(f, kind, belt):
            f.terminal, f.direction = True, -1
            lines.append((f, kind, belt))

        for i, b in enumerate(osc.belts):
            m = self.mode[i]
            if m in (-2, 0, 1, -1):
                if m == -2:
                    add(lambda t, y, b=b: b.lower - y[0], EDGE, i)
                else:
                    for level, side in ((b.lower, 1), (b.upper, -1)):
                        if np.isfinite(level):
                            add(lambda t, y, x=level, d=side: d * (y[0] - x), EDGE, i)
            else:
                add(lambda t, y, b=b: y[0] - b.upper, EDGE, i)
            if abs(m) == 1:
                add(lambda t, y, i=i, m=m: m * (self.nu[i](t) - omega * y[1]), CROSS, i)
        if k is None:
            field = lambda t, y: [y[1], self.pull(t, y)]  # noqa: E731
        else:
            field = lambda t, y: [y[1], self.slope[k](t) / omega]  # noqa: E731
            for side in (1, -1):
                add(
                    lambda t, y, d=side: self.capacity(k, t) - d * self.needed(k, t, y),
                    SLIP,
                    k,
                )
        found = solve_ivp(
            field,
            (self.t, self.T),
            self.y,
            "DOP853",
            rtol=1e-13,
            atol=1e-13,
            max_step=self.step,
            events=[f for f, _, _ in lines],
        )
        self.t, self.y = found.t[-1], found.y[:, -1].copy()
        if found.status == 0:
            return
        _, kind, i = next(line for line, ts in zip(lines, found.t_events) if len(ts))
        if kind == EDGE:
            # Belts may share an edge.
            level = min((osc.belts[i].lower, osc.belts[i].upper), key=lambda x: abs(x - self.y[0]))
            shared = [j for j, b in enumerate(osc.belts) if level in (b.lower, b.upper)]
            for j in shared:
                leaves = abs(self.mode[j]) < 2
                self.mode[j] = (-2 if self.y[1] < 0 else 2) if leaves else self.sign(j)
            i = min(shared)
            if k is not None and self.mode[k] == 0:
                self.hold([k])
        elif kind == SLIP:
            # Its force is the limit of friction: it pulls in the direction that is needed.
            self.mode[i] = 1 if self.needed(i, self.t, self.y) > 0 else -1
        elif k is None:
            self.mode[i] *= -1
            kind = STICK if self.hold([i]) else CROSS
        else:
            self.mode[i] *= -1
            kind = CROSS if self.hold([k]) else STICK if self.hold([i], k) else SLIP
            i = k if kind == SLIP else i
        self.rows.append((self.t, kind, i, *self.y))

    def hold(self, tried, left=None):
        """Stick to a belt if it can hold the mass; else slip on it, to the side that is needed.

        left: a belt that the mass was stuck to, whose velocity is the same now.
        """
        (k,) = tried
        before = list(self.mode)
        self.mode[k] = 0
        if left is not None:
            self.mode[left] = 1 if self.slope[left](self.t) > self.slope[k](self.t) else -1
        needed = self.needed(k, self.t, self.y)
        if abs(needed) < self.capacity(k, self.t):
            return True
        if left is not None:
            self.mode = before
        self.mode[k] = 1 if needed > 0 else -1
        return False


def is_clear(case, mine):
    """Whether the run is one that SciPy can be asked for: short, not near to another outcome, not
    begun on a boundary or an edge, and without belts of one velocity."""
    x1, x2 = case.y0
    away = [abs(wave(b.velocity)[0](case.t0) - case.oscillator.omega * x2) for b in case.belts]
    away += [abs(x1 - edge) for b in case.belts for edge in (b.lower, b.upper)]
    ends = mine.status in (OK, STUCK_FOREVER)
    differ = len({b.velocity for b in case.belts}) == len(case.belts)
    return ends and differ and mine.margin > 1e-3 and min(away) > 1e-9 and len(mine.t) < 40


def compare_with_scipy(seed, count, T=12.0):
    rng, compared, kinds = np.random.default_rng(seed), 0, set()
    structures = forced_cases.structures(rng, 30)
    while compared < count:
        case = forced_cases.case(rng, structures[compared % len(structures)], T)
        mine = case.simulate()
        if not is_clear(case, mine):
            continue
        shortest = np.min(np.diff(mine.t), initial=inf)
        if shortest < 3e-3:
            continue
        peer = Peer(case, min(0.05, 0.3 * shortest))
        assert tuple(row[1:3] for row in peer.rows) == mine.sequence, case
        assert tuple(peer.mode) == mine.mode_end
        # SciPy finds an event on its interpolant, good to about 1e-11; margins are 1e-3 at least,
        # and forced runs may amplify errors.
        assert peer.y == pytest.approx(mine.y_end, abs=1e-8)
        for (t, _, _, *y), t_mine, y_mine in zip(peer.rows, mine.t, mine.y):
            assert [t, *y] == pytest.approx([t_mine, *y_mine], abs=1e-7)
        kinds.update((kind, 0 in codes) for kind, codes in zip(mine.kind.tolist(), mine.codes))
        compared += 1
    return kinds


def test_runs_are_those_of_scipy():
    compare_with_scipy(0, 50)


@pytest.mark.slow
def test_many_runs_are_those_of_scipy():
    kinds = compare_with_scipy(1, 500, T=20.0)
    # The mass was met by edges, and by other belts' zeros of r, while it stuck, and went on.
    assert {(STICK, True), (SLIP, False), (CROSS, False), (CROSS, True), (EDGE, True)} <= kinds


# ---------------------------------------------------------------- closed forms


def coulomb(velocity=0.0, capacity=1.0, **options):
    return Belt(velocity, ("coulomb", capacity, capacity), **options)


def den_hartog(frequency, friction, damping, force=1.0):
    """Den Hartog's motion without stops: (amplitude, phase of the force at the maximum of x1).

    On the half period T = pi/Omega after a maximum x' < 0, and x = friction + exp(-zeta t/2)
    (A cos b t + B sin b t) + p cos(Omega t) - q sin(Omega t). From x(0) = a = -x(T) and
    x'(0) = 0 = x'(T) follow A, B, p and q, linear in a; and (p, q) is as long as the response to
    the force without friction.
    """
    T, half = pi / frequency, damping / 2
    b = sqrt(1 - half**2)
    decay, c, s = np.exp(-half * T), np.cos(b * T), np.sin(b * T)
    matrix = np.array(
        [
            [1, 0, 1, 0],
            [decay * c, decay * s, -1, 0],
            [-half, b, 0, -frequency],
            [decay * (-half * c - b * s), decay * (b * c - half * s), 0, frequency],
        ]
    )
    _, _, p0, q0 = np.linalg.solve(matrix, [-friction, -friction, 0, 0])
    _, _, p1, q1 = np.linalg.solve(matrix, [1, -1, 0, 0])
    response = force / (1 - frequency**2 + 1j * damping * frequency)
    square = [p1**2 + q1**2, 2 * (p0 * p1 + q0 * q1), p0**2 + q0**2 - abs(response) ** 2]
    a = float(np.max(np.roots(square).real))
    return a, float(np.angle(p0 + a * p1 + 1j * (q0 + a * q1)) - np.angle(response))


def test_den_hartog_without_damping_has_his_formula():
    frequency, friction = 1.4, 0.3
    V, turn = 1 / (1 - frequency**2), pi / frequency
    U = np.sin(turn) / (frequency * (1 + np.cos(turn)))
    a, _ = den_hartog(frequency, friction, 0.0)
    assert a == pytest.approx(sqrt(V**2 - (friction * U) ** 2), rel=1e-13)


@pytest.mark.parametrize("damping", [0.0, 0.05, 0.3])
@pytest.mark.parametrize("frequency", [0.8, 1.3, 2.2])
def test_den_hartog_moves_without_stops(frequency, damping):
    a, phase = den_hartog(frequency, 0.15, damping)
    osc = Oscillator(damping, (coulomb(capacity=0.15),), (Harmonic(1.0, frequency, phase),))
    half = pi / frequency
    run = forced.simulate(osc, (a, 0.0), 5 * half)
    assert run.sequence == ((CROSS, 0),) * (len(run.t))
    assert run.t[:4] == pytest.approx(half * np.arange(1, 5), abs=1e-11)
    assert run.y[:4, 0] == pytest.approx([-a, a, -a, a], abs=1e-11)


def test_den_hartog_stops_where_friction_can_hold_a_turning_mass():
    # Coulomb 0.4, zeta 0.05, F = 1: at a turn |x1 - force| = friction on the border.
    def room(frequency):
        a, phase = den_hartog(frequency, 0.4, 0.05)
        return abs(a - np.cos(phase)) - 0.4

    border = brentq(room, 0.3, 0.8, xtol=1e-14)
    for by, kind in ((1e-8, CROSS), (-1e-8, STICK)):
        frequency = border + by * np.sign(room(border + 1e-3))
        a, phase = den_hartog(frequency, 0.4, 0.05)
        osc = Oscillator(0.05, (coulomb(capacity=0.4),), (Harmonic(1.0, frequency, phase),))
        # From a little after the maximum to a little after the minimum.
        start = forced.simulate(osc, (a, 0.0), 1e-2, mode=(1,))
        run = forced.simulate(osc, start.y_end, 1.001 * pi / frequency, t0=1e-2)
        assert run.sequence[0] == (kind, 0)
        assert run.t[0] == pytest.approx(pi / frequency, abs=1e-10)


@pytest.mark.parametrize("n, A", [(1, 0.05), (1, -0.3), (2, 0.02)])
def test_csernak_stepan_shaw(n, A):
    # A continuum of motions, one for each A, at Omega = 1/(2 n).
    S, frequency = 0.05, 1 / (2 * n)
    V = 2.5
    osc = Oscillator(0.0, (coulomb(capacity=S),), (Harmonic(V * (1 - frequency**2), frequency),))

    def x(t):
        first = t <= pi / frequency
        rest, factor = (S, A) if first else (-S, A + 2 * S)
        return rest + V * np.cos(frequency * t) + factor * np.cos(t)

    for t in (1.0, 5.0, 8.0, 2 * pi / frequency):
        run = forced.simulate(osc, (x(0.0), 0.0), t)
        assert run.y_end[0] == pytest.approx(x(t), abs=2e-12)
    assert run.kind.tolist()[:1] == [CROSS]
    assert run.t[0] == pytest.approx(pi / frequency, abs=1e-10)


def test_without_a_clock_runs_are_those_of_the_other_engine():
    rng, compared = np.random.default_rng(0), 0
    for structure in cases.structures(rng, 9):
        for _ in range(12):
            case = cases.random_case(rng, structure, T=30.0)
            right = engine.simulate(case.oscillator, case.y0, case.T)
            if right.margin < 1e-3 or right.status not in (OK, STUCK_FOREVER):
                continue
            belts = tuple(Belt(*vars(b).values()) for b in case.oscillator.belts)
            osc = Oscillator(case.oscillator.damping, belts, (), case.oscillator.omega)
            run = forced.simulate(osc, case.y0, case.T)
            assert run.sequence == right.sequence
            assert run.status == right.status and run.mode_end == right.mode_end
            # Both integrate at 1e-13; a margin of 1e-3 lets errors grow a thousandfold. Times of
            # events that are approached slowly are worse than the states.
            assert run.y_end == pytest.approx(right.y_end, abs=1e-9)
            assert run.y == pytest.approx(right.y, abs=1e-9)
            late = np.abs(run.t - right.t) * np.minimum(run.speeds, 1.0)
            assert np.max(late, initial=0.0) < 1e-9
            compared += 1
    assert compared > 60


# ---------------------------------------------------------------- stick phases


def meetings(seed, count):
    rng = np.random.default_rng(seed)
    for i in range(count):
        meeting = forced_cases.MEETINGS[i % 4]
        distance = float(10 ** rng.uniform(-11, -3)) if meeting in ("misses", "hits") else 0.0
        yield meeting, distance, *forced_cases.stick_case(rng, meeting, distance)


def check_meetings(seed, count):
    for meeting, distance, case, onset in meetings(seed, count):
        run = case.simulate()
        assert run.sequence[:1] == ((SLIP, 0),), case
        wave = case.oscillator.forces[0]
        if meeting == "passes":
            # A value known to e tells the time of a triple root to (6 e / (F Omega^3))^(1/3).
            room = (6 * 1e-15 / (wave.amplitude * wave.frequency**3)) ** (1 / 3) * 4
        elif meeting == "hits":
            room = 1e-14 / sqrt(distance) + 1e-12
        else:
            room = 1e-7
        assert run.t[0] == pytest.approx(onset, abs=room), (meeting, distance)
        # Where the mass slips because the limit was exceeded for a short time it may stick again.
        assert len(run.t) == 1 or meeting == "hits"


def test_double_roots_touch_and_triple_ones_pass():
    check_meetings(0, 200)


@pytest.mark.slow
def test_many_double_and_triple_roots():
    check_meetings(1, 4000)


def sampled_stick_phase(rng):
    """A stick phase of a random oscillator, from the engine and from samples of the closed form:
    (run up to its first event, distances at its samples, their names), or None."""
    structures = forced_cases.structures(np.random.default_rng(0), 30)
    case = forced_cases.case(rng, structures[rng.integers(30)], T=25.0)
    osc, k = case.oscillator, int(rng.integers(len(case.belts)))
    # As strong as is needed for a phase of some length.
    belts = list(case.belts)
    belts[k] = replace(belts[k], law=("coulomb", rng.uniform(1.0, 6.0), 0.5))
    osc = replace(osc, belts=tuple(belts))
    nu, slope = zip(*(wave(b.velocity) for b in belts))
    x2 = nu[k](case.t0) / osc.omega
    case = replace(case, oscillator=osc, y0=(rng.uniform(-1, 1), float(x2)))
    start = forced.simulate(osc, case.y0, case.t0 + 1e-9, t0=case.t0)
    if start.mode_end[k] != 0 or len(start.t):
        return None
    run = forced.simulate(osc, case.y0, case.T, t0=case.t0)
    t_first = run.t[0] if len(run.t) else case.T
    t = np.linspace(case.t0, t_first, 20_000)
    velocity = nu[k](t) + 0 * t
    # Simpson's rule is good to 1e-12 with so many samples.
    middle = nu[k](0.5 * (t[1:] + t[:-1])) + 0 * t[1:]
    ways = (velocity[1:] + 4 * middle + velocity[:-1]) / 6 * np.diff(t) / osc.omega
    x1 = case.y0[0] + np.concatenate([[0.0], np.cumsum(ways)])
    needed = slope[k](t) / osc.omega + x1 + osc.damping * velocity / osc.omega
    needed -= sum(push(f, t, osc.damping) for f in osc.forces)
    capacity, distances = 0.0, {}
    for i, (b, m) in enumerate(zip(belts, start.mode_end)):
        load = wave(b.load)[0](t)
        if m == 0:
            capacity = capacity + load * b.law[1]
        elif abs(m) == 1:
            r = m * (nu[i](t) - velocity)
            needed = needed - m * load * law(b.law)(np.maximum(r, 0.0))
            distances[CROSS, i] = r
        for edge in (b.lower, b.upper):
            if np.isfinite(edge):
                distances[EDGE, edge] = (x1 - edge) * np.sign(case.y0[0] - edge)
    distances[SLIP, k] = capacity - np.abs(needed)
    return run, distances


def check_sampled(seed, count):
    rng, seen = np.random.default_rng(seed), {}
    while sum(seen.values()) < count:
        found = sampled_stick_phase(rng)
        if found is None:
            continue
        run, distances = found
        # Nothing is passed before the first event, and something is at it.
        least = {name: np.min(values[1:-1]) for name, values in distances.items()}
        assert min(least.values()) > -1e-9
        at_end = {name: values[-1] for name, values in distances.items()}
        (kind, _), value = min(at_end.items(), key=lambda item: item[1])
        if len(run.t):
            assert abs(value) < 1e-9
            assert run.kind[0] == kind or (kind == CROSS and run.kind[0] in (STICK, SLIP))
        seen[kind if len(run.t) else None] = seen.get(kind if len(run.t) else None, 0) + 1
    return seen


def test_stick_phases_are_those_of_samples():
    assert set(check_sampled(0, 200)) == {None, SLIP, CROSS, EDGE}


@pytest.mark.slow
def test_many_stick_phases_are_those_of_samples():
    check_sampled(1, 5000)


def test_a_force_equal_to_the_capacity_holds_for_ever():
    osc = Oscillator(0.1, (coulomb(),), (Harmonic(1.0, 1.0),))
    run = forced.simulate(osc, (0.0, 0.0), 50.0)
    assert run.status == STUCK_FOREVER and run.y_end == (0.0, 0.0) and not len(run.t)


def test_held_for_ever_only_where_it_is():
    def run(forces, x1=0.0, t1=3.0, **options):
        osc = Oscillator(0.1, (coulomb(**options),), forces)
        return forced.simulate(osc, (x1, 0.0), t1)

    # Frequencies without a common period come as near to the sum of the forces as one likes.
    both = Harmonic(0.5, 1.0, pi), Harmonic(0.4, sqrt(2.0), pi)
    assert run(both).status == STUCK_FOREVER
    assert run(both, x1=0.2).status == OK
    # With a common period the forces need not add up.
    together = Harmonic(0.7, 1.0), Harmonic(0.7, 2.0, pi)
    assert run(together, t1=60.0).status == OK
    weak = Harmonic(0.7, 1.0, pi / 2), Harmonic(0.35, 3.0, -pi / 2)
    peak = max(-0.7 * np.sin(t) + 0.35 * np.sin(3 * t) for t in np.linspace(0, 7, 10_000))
    assert peak > 1.04
    assert run(weak, capacity=1.06).status == STUCK_FOREVER
    assert run(weak, capacity=1.04, t1=60.0).status == OK
    # A belt that swings carries the mass for ever, too; one that drifts does not.
    swings = Oscillating(0.0, 0.3, 1.3)
    osc = Oscillator(0.1, (coulomb(swings, capacity=2.0),))
    carried = forced.simulate(osc, (0.0, 0.3), 40.0)
    assert carried.status == STUCK_FOREVER
    assert carried.y_end == pytest.approx(
        [0.3 / 1.3 * np.sin(1.3 * 40), 0.3 * np.cos(1.3 * 40)], abs=1e-14
    )


def test_another_belt_passes_or_touches_while_the_mass_sticks():
    # Its relative velocity 0.4 sin t changes its sign at multiples of pi; |x1| stays below 0.1.
    def run(velocity, load=0.3):
        belts = coulomb(capacity=2.0), coulomb(velocity, load=load)
        return forced.simulate(Oscillator(0.1, belts), (0.1, 0.0), 10.0)

    passing = run(Oscillating(0.0, 0.4, 1.0, pi / 2))
    assert passing.sequence == ((CROSS, 1),) * 3
    assert passing.t == pytest.approx([pi, 2 * pi, 3 * pi], abs=1e-13)
    assert passing.codes.tolist() == [[0, 1], [0, -1], [0, 1]]
    # 0.4 (1 - cos t) touches zero.
    touching = run(Oscillating(0.4, 0.4, 1.0, pi))
    assert touching.sequence == () and touching.mode_end == (0, 1)


def test_the_mass_goes_over_to_another_belt():
    belts = (
        coulomb(0.2, load=0.5),
        coulomb(Oscillating(0.2, 0.1, 1.0, pi / 2), load=1.0),
    )
    osc = Oscillator(0.0, belts)
    # Without belt 1 needed is x1 = 0.2 t - 1.2. Belt 1 pulls by +1 while it is faster, then by -1,
    # which is more than belt 0 can hold.
    run = forced.simulate(osc, (-1.2, 0.2), 8.0)
    assert run.sequence[0] == (STICK, 1)
    assert run.t[0] == pytest.approx(pi, abs=1e-12)


def test_an_edge_is_met_where_a_swinging_belt_carries_the_mass():
    # x1 = 0.5 sin t reaches 0.3 at arcsin 0.6, and only there.
    belts = (coulomb(Oscillating(0.0, 0.5, 1.0), capacity=3.0, upper=0.3),)
    run = forced.simulate(Oscillator(0.0, belts), (0.0, 0.5), 1.0)
    assert run.sequence == ((EDGE, 0),)
    assert run.t == pytest.approx([np.arcsin(0.6)], abs=1e-13)
    # An edge that is touched is not passed.
    belts = (replace(belts[0], upper=0.5),)
    run = forced.simulate(Oscillator(0.0, belts), (0.0, 0.5), 9.0)
    assert run.sequence == ()


# ---------------------------------------------------------------- relations


def some_cases(seed, count, margin=1e-5):
    rng = np.random.default_rng(seed)
    structures = forced_cases.structures(rng, count)
    for structure in structures:
        while True:
            case = forced_cases.random_case(rng, structure, T=25.0)
            run = case.simulate()
            if run.margin > margin and run.status in (OK, STUCK_FOREVER):
                yield case, run
                break


def shifted(case, by):
    """The same motion with all clocks set back."""
    osc = case.oscillator

    def wave(w):
        moving = isinstance(w, Oscillating)
        return replace(w, phase=w.phase + w.frequency * by) if moving else w

    belts = tuple(replace(b, velocity=wave(b.velocity), load=wave(b.load)) for b in osc.belts)
    forces = tuple(replace(f, phase=f.phase + f.frequency * by) for f in osc.forces)
    return replace(
        case, oscillator=replace(osc, belts=belts, forces=forces), t0=case.t0 - by, T=case.T - by
    )


def wave_times(w, factor):
    if not isinstance(w, Oscillating):
        return factor * w
    return replace(w, mean=factor * w.mean, amplitude=factor * w.amplitude)


def mirrored(case):
    osc = case.oscillator
    belts = tuple(
        replace(b, velocity=wave_times(b.velocity, -1.0), lower=-b.upper, upper=-b.lower)
        for b in osc.belts
    )
    forces = tuple(replace(f, amplitude=-f.amplitude) for f in osc.forces)
    y0 = tuple(-y for y in case.y0)
    return replace(case, oscillator=replace(osc, belts=belts, forces=forces), y0=y0)


def test_relations():
    for case, run in some_cases(3, 12):
        osc = case.oscillator
        # Another clock.
        other = shifted(case, 1.7).simulate()
        assert other.sequence == run.sequence
        assert other.y_end == pytest.approx(run.y_end, abs=1e-8)
        # Mirror images, bit by bit up to the rounding of enclosures.
        other = mirrored(case).simulate()
        assert other.sequence == run.sequence
        assert other.y_end == pytest.approx([-y for y in run.y_end], abs=1e-9)
        # Forces in halves, and a force of frequency zero, which moves the rest.
        halves = tuple(replace(f, amplitude=f.amplitude / 2) for f in osc.forces) * 2
        push = 0.2
        belts = tuple(replace(b, lower=b.lower + push, upper=b.upper + push) for b in osc.belts)
        pushed = replace(osc, belts=belts, forces=(*halves, Harmonic(push, 0.0)))
        y0 = (case.y0[0] + push, case.y0[1])
        other = replace(case, oscillator=pushed, y0=y0).simulate()
        assert other.sequence == run.sequence
        assert np.subtract(other.y_end, (push, 0.0)) == pytest.approx(run.y_end, abs=1e-8)
        # A belt in two.
        first = osc.belts[0]
        half = wave_times(first.load, 0.5)
        belts = (replace(first, load=half), *osc.belts[1:], replace(first, load=half))
        other = replace(case, oscillator=replace(osc, belts=belts)).simulate()
        assert other.sequence == run.sequence
        assert other.y_end == pytest.approx(run.y_end, abs=1e-8)
        # In two parts.
        half = 0.5 * (case.t0 + case.T)
        first = replace(case, T=half).simulate()
        second = replace(case, t0=half, y0=first.y_end).simulate(mode=first.mode_end)
        assert first.sequence + second.sequence == run.sequence
        assert second.y_end == pytest.approx(run.y_end, abs=1e-8)


def test_a_moving_support_is_a_force():
    X, frequency, phase, zeta = 0.7, 1.3, 0.4, 0.3
    t = np.linspace(0.0, 9.0, 7)
    support = X * np.cos(frequency * t + phase)
    speed = -X * frequency * np.sin(frequency * t + phase)
    pulls = forced.base_motion(zeta, X, frequency, phase)
    total = sum(f.amplitude * np.cos(f.frequency * t + f.phase) for f in pulls)
    assert total == pytest.approx(support + zeta * speed, abs=1e-14)


# ---------------------------------------------------------------- di Bernardo, Kowalczyk, Nordmark


def bkn(frequency):
    law = ("cubic", 1.5, 1.5, 0.45)
    return Oscillator(0.0, (Belt(1.0, law),), (Harmonic(0.1, frequency),))


def bkn_without_boundary(frequency, d=0.05):
    """The field of the slip mode, a little beyond its boundary: the belt is faster by d, and its
    law is written for the speed less d."""
    law = ("polynomial", 1.5 + 1.5 * d - 0.45 * d**3, -1.5 + 1.35 * d**2, -1.35 * d, 0.45)
    return Oscillator(0.0, (Belt(1.0 + d, law),), (Harmonic(0.1, frequency),))


def test_bkn_period_doubling():
    def past(frequency):
        _, multipliers = forced_cases.periodic(bkn(frequency), np.array([2.01, -0.309]), 2)
        return multipliers[0].real + 1

    found = brentq(past, 1.7128, 1.7132, xtol=1e-12)
    assert found == pytest.approx(1.712981036227, abs=1e-10)


def test_bkn_grazing():
    # The margin of the 4-periodic motion is its distance from the belt's boundary; linear in Omega.
    def distance(frequency):
        # Steps of the differences, and iterates, that do not reach the boundary.
        osc = bkn_without_boundary(frequency)
        y, _ = forced_cases.periodic(osc, np.array([2.19334, -0.42336]), 4)
        run = forced_cases.stroboscopic(bkn(frequency), y, 4)
        assert not len(run.t)
        return run.margin

    one, two = (1.707799714885 + by for by in (2e-8, 1e-8))
    d_one, d_two = distance(one), distance(two)
    found = two - d_two * (two - one) / (d_two - d_one)
    assert found == pytest.approx(1.707799714885, abs=1e-11)
    _, multipliers = forced_cases.periodic(
        bkn_without_boundary(found), np.array([2.19334, -0.42336]), 4
    )
    # Differences of runs at 1e-13 with a step of 1e-4.
    assert multipliers == pytest.approx([0.00719233612, 0.840725392543], abs=4e-9)


def onset_map(theta, frequency):
    """The time of the next slip onset, less two periods, as a function of that of one: with
    needed = capacity there the phase is the state."""
    y = 1.5 + 0.1 * np.cos(frequency * theta), 1.0
    T = 2 * pi / frequency
    run = forced.simulate(bkn(frequency), y, theta + 2.5 * T, t0=theta, max_events=50)
    assert run.sequence[:2] == ((STICK, 0), (SLIP, 0))
    return run.t[1] - 2 * T


def test_bkn_fold_of_the_sticking_motion():
    # Two fixed points meet where the least value of map - identity is zero.
    def least(frequency):
        found = minimize_scalar(
            lambda theta: onset_map(theta, frequency) - theta,
            bounds=(1.7, 2.1),
            method="bounded",
            options=dict(xatol=1e-7),
        )
        return found.fun

    found = brentq(least, 1.6834, 1.6835, xtol=1e-12)
    assert found == pytest.approx(1.683440572496, abs=1e-10)


def test_bkn_has_two_attractors():
    osc, T = bkn(1.68), 2 * pi / 1.68
    y = forced.simulate(osc, (0.5, 0.0), 500 * T).y_end
    run = forced_cases.stroboscopic(osc, y, 2)
    assert run.y_end == pytest.approx(y, abs=1e-11)  # sticks, with a multiplier well inside 1
    assert run.sequence == ((STICK, 0), (SLIP, 0))
    y = forced.simulate(osc, (2.0, -0.3), 500 * T).y_end
    many = np.array([y := forced_cases.stroboscopic(osc, y, 2).y_end for _ in range(200)])
    assert np.ptp(many, axis=0)[0] > 0.05 and np.std(many[:, 0]) > 0.01


def test_bkn_exponent_of_the_periodic_motion():
    _, multipliers = forced_cases.periodic(bkn(1.7078), np.array([2.19334, -0.42336]), 4, h=1e-7)
    # The motion is 3e-6 away from grazing: a small step, and an error of 1e-13/1e-7.
    assert np.log(abs(multipliers[1])) / 4 == pytest.approx(-0.04337, abs=1e-5)
    found, _ = forced_cases.exponent(bkn(1.7078), (0.5, 0.0), 400, size=1e-9, transient=800)
    assert found == pytest.approx(-0.04337, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "frequency, start, right",
    [(1.7077, (0.5, 0.0), 0.0633), (1.69, (0.5, 0.0), 0.1277), (1.68, (2.0, -0.3), 0.1494)],
)
def test_bkn_exponents_of_chaos(frequency, start, right):
    found, error = forced_cases.exponent(bkn(frequency), start, 20_000)
    assert error < 2e-3
    assert abs(found - right) < 3.5 * error + 1e-4


# ---------------------------------------------------------------- cases and verdicts


def answer(run):
    rows = zip(run.t.tolist(), run.kind.tolist(), run.belt.tolist(), *run.y.T.tolist())
    x1, x2 = run.y_end
    return SimpleNamespace(
        x1=x1,
        x2=x2,
        mode=run.mode_end,
        n_events=len(run.t),
        status=run.status,
        events=tuple(rows),
    )


def test_cases_can_be_written_and_read():
    rng = np.random.default_rng(5)
    for structure in forced_cases.structures(rng, 14):
        for make in (forced_cases.random_case, forced_cases.round_case):
            case = make(rng, structure)
            assert case.structure == structure
            assert forced_cases.from_json(json.dumps(case.to_json())) == case


def test_verdicts():
    rng = np.random.default_rng(6)
    batch = [
        forced_cases.case(rng, structure, T=30.0)
        for structure in forced_cases.structures(rng, 12)
        for _ in range(4)
    ]
    runs = forced_cases.simulate_all(batch)
    again = forced_cases.simulate_all(batch, tol=1e-11)
    verdicts = forced_cases.judged(batch, [answer(run) for run in again], 1e-9)
    assert all(verdict in forced_cases.GOOD for verdict, _ in verdicts)
    assert sum(verdict == "same" for verdict, _ in verdicts) > 40
    again = forced_cases.simulate_all(batch, noise=1e-9, seed=99)
    verdicts = forced_cases.judged(batch, [answer(run) for run in again], 1e-9)
    assert all(verdict in forced_cases.GOOD for verdict, _ in verdicts)
    clear = [(c, r) for c, r in zip(batch, runs) if r.margin > 1e-5 and len(r.t)]
    assert len(clear) > 15
    for case, run in clear[:6]:
        told = answer(run)
        spoilt = [
            {"x1": run.y_end[0] + 1e-3},
            {"x2": float("nan")},
            {"n_events": 0, "events": ()},
            {"mode": tuple(-2 for _ in run.mode_end)},
            {"events": ((told.events[0][0] + 1.0, *told.events[0][1:]), *told.events[1:])},
            {"status": forced.NOT_FINITE},
        ]
        for change in spoilt:
            verdict, _ = forced_cases.judge(case, SimpleNamespace(**vars(told) | change), 1e-8)
            assert verdict not in forced_cases.GOOD, change


def test_derivatives_of_a_run():
    # A harmonic response without contact, by its frequency.
    zeta, F, frequency, T = 0.2, 0.7, 1.3, 9.0
    osc = Oscillator(zeta, (coulomb(lower=50.0),), (Harmonic(F, frequency),))
    case = forced_cases.Case(osc, (0.3, -0.2), T)
    _, names = forced_cases._numbers(case)
    direction = [float(name == ("frequency", frequency)) for name in names]
    found, error = forced_cases.derivative(case, direction)
    h = 1e-3

    def end(frequency):
        b = sqrt(1 - zeta**2 / 4)
        c = F / (1 - frequency**2 + 1j * zeta * frequency)
        p = 0.3 - c.real
        q = (-0.2 - (1j * frequency * c).real + zeta / 2 * p) / b
        fade = np.exp(-zeta / 2 * T)
        return (
            fade * (p * np.cos(b * T) + q * np.sin(b * T)) + (c * np.exp(1j * frequency * T)).real
        )

    right = (8 * (end(frequency + h) - end(frequency - h)) - end(frequency + 2 * h)
             + end(frequency - 2 * h)) / (12 * h)  # fmt: skip
    assert found[0] == pytest.approx(right, abs=1e-9)
    assert error < 1e-9


def test_a_batch_has_no_run_that_is_lost():
    rng = np.random.default_rng(8)
    batch = [
        forced_cases.case(rng, structure)
        for structure in forced_cases.structures(rng, 16)
        for _ in range(15)
    ]
    runs = forced_cases.simulate_all(batch, max_events=4000)
    ended = [run.status in (OK, STUCK_FOREVER) and run.t_end == c.T for run, c in zip(runs, batch)]
    # The others run out of events, or of digits, around a pseudo-focus.
    assert np.mean(ended) > 0.95
    assert not any(run.status in (forced.STEPS, forced.NOT_FINITE, forced.CORNER) for run in runs)
    assert all(np.all(np.isfinite(run.y_end)) for run in runs)
    assert max(abs(run.y_end[0]) for run in runs) < inf


@pytest.mark.parametrize("x2", [-0.02, -0.005, -0.001])
def test_short_arcs_from_an_edge_end_where_scipy_says(x2):
    """Steep friction: over 0.02 units of time a rule of order four was off by 5e-9."""
    steep = ("conti", 1.3, 0.9, 7.4, 0.16)
    osc = Oscillator(0.5, (Belt(-0.4, steep, 0.5, lower=0.0),), (Harmonic(0.2, 0.4, -1.7),))

    def rates(t, y):
        r = abs(-0.4 - y[1])
        mu = (1.3 - 0.9) / (1 + 7.4 * r) + 0.9 + 0.16 * r**2
        return y[1], -y[0] - 0.5 * y[1] - 0.5 * mu + 0.2 * np.cos(0.4 * t - 1.7)

    def back(t, y):
        return y[0] if t > 1e-5 else -1.0

    back.direction = -1
    run = forced.simulate(osc, (0.0, -x2), 1.0, mode=(-1,))
    peer = solve_ivp(rates, (0, 1), (0.0, -x2), "DOP853", events=back, rtol=1e-13, atol=1e-16)
    assert run.kind[0] == EDGE and 1e-3 < run.t[0] < 0.1
    np.testing.assert_allclose(run.t[0], peer.t_events[0][0], rtol=1e-10)
