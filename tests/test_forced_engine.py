"""The engine of forced runs against SciPy, closed forms and published motions."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.campaign import forced, forced_cases
from tests.campaign.forced import CROSS, EDGE, SLIP, STICK, Oscillating

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


class Peer:
    """A run by `solve_ivp`: stick phases are integrated, too, and end where the needed force, asked
    of the right-hand side, exceeds the capacity. A step of 0.05 may hide what is shorter."""

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
        total += sum(f.amplitude * np.cos(f.frequency * t + f.phase) for f in self.osc.forces)
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
        f, kind, i = next(line for line, ts in zip(lines, found.t_events) if len(ts))
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
    """Whether the run is one that SciPy can be asked for: short, not near to another outcome, and
    not begun on a boundary or an edge."""
    x1, x2 = case.y0
    away = [abs(wave(b.velocity)[0](case.t0) - case.oscillator.omega * x2) for b in case.belts]
    away += [abs(x1 - edge) for b in case.belts for edge in (b.lower, b.upper)]
    ends = mine.status in (forced.OK, forced.STUCK_FOREVER)
    return ends and mine.margin > 1e-3 and min(away) > 1e-9 and len(mine.t) < 40


def compare_with_scipy(seed, count, T=12.0):
    rng, compared, kinds = np.random.default_rng(seed), 0, set()
    structures = forced_cases.structures(rng, 30)
    while compared < count:
        case = forced_cases.case(rng, structures[compared % len(structures)], T)
        mine = case.simulate()
        if not is_clear(case, mine):
            continue
        peer = Peer(case)
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
    compare_with_scipy(0, 6)


@pytest.mark.slow
def test_many_runs_are_those_of_scipy():
    kinds = compare_with_scipy(1, 50)
    # The mass was met by edges, and by other belts' zeros of r, while it stuck, and went on.
    assert {(STICK, True), (SLIP, False), (CROSS, False), (CROSS, True), (EDGE, True)} <= kinds
