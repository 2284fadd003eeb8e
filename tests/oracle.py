"""Belt-driven dry-friction oscillators once more, slowly and independently.

This is the reference that the package is tested against. It shares no line with it: plain
NumPy, and SciPy's DOP853 at 1e-13, one arc at a time. A mass on a spring (unit mass, unit
stiffness in scaled time) is dragged by belts,

    x1' = x2
    x2' = -x1 - zeta x2 + sum over touching belts of  load mu(|r|) sgn(r),    r = nu - omega x2,

and every belt either slips (sign +1 or -1 of r), or is stuck (0), or does not touch because the
mass is above (+2) or below (-2) the interval of x1 in which the belt is. A run is a list of arcs,
one mode each. Slip arcs are integrated with the friction of their mode, stick arcs are written
down. Within a solver step the zeros of x2 and of x2' are found first; between them x1 and x2 are
monotone, so no boundary can be passed and passed back unseen.

`Run.margin` says how far the run stays from the cases whose sequence of events is decided by
rounding (corners, tangencies, a needed force equal to the capacity, an event at the final time).
Compare sequences only where it is well above the accuracy of the code under test. It is small by
nature for a run into a pseudo-focus, whose loops shrink to a point.
"""

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field
from math import copysign, inf
from typing import Any

import numpy as np
from scipy.integrate import DOP853
from scipy.optimize import brentq

BELOW, ABOVE, STUCK = -2, 2, 0

# ---------------------------------------------------------------- model


def conti(mus, p1, p3, p2=0.0):
    """Conti's law (mus - p1)/(1 + p3 r) + p1 + p2 r^2, and its static limit."""
    return (lambda r: (mus - p1) / (1 + p3 * r) + p1 + p2 * r * r), mus


def coulomb(mus, mud):
    """Coulomb's law with a static limit mus at or above the kinetic value mud."""
    return (lambda r: mud + 0 * r), mus


def stribeck(mus, mud, vs):
    """Exponential Stribeck law mud + (mus - mud) exp(-r/vs), and its static limit."""
    return (lambda r: mud + (mus - mud) * np.exp(-r / vs)), mus


@dataclass(frozen=True)
class Belt:
    velocity: float
    mu: Callable
    static: float
    load: float = 1.0
    lower: float = -inf
    upper: float = inf


@dataclass(frozen=True)
class Oscillator:
    damping: float
    belts: tuple
    omega: float = 1.0

    def speed(self, k):
        """The x2 at which belt k does not slip."""
        return self.belts[k].velocity / self.omega


# The constants of Casini and Vestroni (2004), with p3 = 10 for every class.
_PAPER = dict(mus=1.0, p1=0.6, p3=10.0, p2=0.0, damping=0.5, load=1.0, omega=1.0)


def _preset(velocities, intervals, **changes):
    c = {**_PAPER, **changes}
    mu, static = conti(c["mus"], c["p1"], c["p3"], c["p2"])
    belts = tuple(
        Belt(v, mu, static, c["load"], lo, up) for v, (lo, up) in zip(velocities, intervals)
    )
    return Oscillator(c["damping"], belts, c["omega"])


def class_a(nu0, **changes):
    """One belt, always."""
    return _preset([nu0], [(-inf, inf)], **changes)


def class_b(nu0, nu1, **changes):
    """Both belts, always."""
    return _preset([nu0, nu1], [(-inf, inf)] * 2, **changes)


def class_c(nu0, nu1, sigma, **changes):
    """Belt 0 left of sigma, belt 1 right of it."""
    return _preset([nu0, nu1], [(-inf, sigma), (sigma, inf)], **changes)


def class_d(nu0, nu1, sigma0, sigma1, **changes):
    """Belt 0 left of sigma1, belt 1 right of sigma0, both in between."""
    return _preset([nu0, nu1], [(-inf, sigma1), (sigma0, inf)], **changes)


# ---------------------------------------------------------------- modes


def touches(m):
    return abs(m) < 2


def acceleration(osc, mode, without=()):
    """x2' as a function of (x1, x2) in a mode, less the friction of some belts.

    The friction keeps the sign of the mode also where r has changed its own. Stuck belts do not
    contribute: what is left for them is the needed force.
    """
    zeta, omega = osc.damping, osc.omega
    terms = [
        (m * b.load, m, b.velocity, b.mu)
        for k, (m, b) in enumerate(zip(mode, osc.belts))
        if abs(m) == 1 and k not in without
    ]

    def x2_prime(x1, x2):
        total = -x1 - zeta * x2
        for weight, sign, nu, mu in terms:
            total = total + weight * mu(sign * (nu - omega * x2))
        return total

    return x2_prime


def mates(osc, mode, velocity):
    """The touching belts that run at this velocity: they stick, slip and cross together."""
    return [k for k, b in enumerate(osc.belts) if touches(mode[k]) and b.velocity == velocity]


def capacity(osc, group):
    return sum(osc.belts[k].load * osc.belts[k].static for k in group)


def _replace(mode, group, m):
    return tuple(m if k in group else old for k, old in enumerate(mode))


def _sign_of_r(osc, k, x2):
    """Sign of r_k, 0 on the boundary. The rounding of nu/omega counts as on the boundary."""
    r = osc.belts[k].velocity - osc.omega * x2
    return 0 if abs(r) <= 4e-16 * abs(osc.belts[k].velocity) else (1 if r > 0 else -1)


def needed_and_capacity(osc, mode, group, x1):
    """Force that would have to be held by the belts of the group, and what they can hold."""
    x2 = osc.speed(group[0])
    return acceleration(osc, mode, without=group)(x1, x2), capacity(osc, group)


@dataclass(frozen=True)
class Guard:
    """A line y[axis] = level that bounds a mode; side (y[axis] - level) > 0 inside."""

    axis: int  # 0: contact edge in x1, 1: belt boundary in x2
    level: float
    side: int
    belts: tuple

    def __call__(self, y):
        return self.side * (y[self.axis] - self.level)


def guards_of(osc, mode):
    """All lines that bound a mode, coinciding ones once. A stuck mode has edges only."""
    lines = {}
    stuck = STUCK in mode
    for k, (m, b) in enumerate(zip(mode, osc.belts)):
        if m == BELOW:
            found = [(0, b.lower, -1)]
        elif m == ABOVE:
            found = [(0, b.upper, 1)]
        else:
            found = [(0, b.lower, 1), (0, b.upper, -1)]
            if m != STUCK and not stuck:
                found.append((1, osc.speed(k), -m))
        for axis, level, side in found:
            if abs(level) < inf:
                lines.setdefault((axis, level, side), []).append(k)
    return [Guard(*line, tuple(ks)) for line, ks in lines.items()]


# ---------------------------------------------------------------- results


@dataclass(frozen=True)
class Event:
    t: float
    kind: str  # "STICK", "SLIP", "CROSS", "EDGE"
    belt: int
    x1: float
    x2: float
    mode: tuple = ()  # after the event


@dataclass(frozen=True)
class Loop:
    """An extremum inside a slip arc: of x1 (axis 0, there x2 = 0) or of x2 (axis 1, x2' = 0)."""

    t: float
    axis: int
    x1: float
    x2: float
    mode: tuple


@dataclass
class Arc:
    mode: tuple
    t_start: float
    t_end: float
    entry: tuple
    steps: list = field(default_factory=list, repr=False)  # (t, y, interpolant) per solver step
    loops: list = field(default_factory=list, repr=False)
    land: Any = field(default=None, repr=False)
    exit: tuple = None

    @property
    def duration(self):
        return self.t_end - self.t_start

    def _line(self, t):
        return np.array([self.entry[0] + self.entry[1] * (t - self.t_start), self.entry[1]])

    def _step(self, t):
        return self.steps[max(bisect_right(self.steps, t, key=lambda s: s[0]) - 1, 0)]

    def dense(self, t):
        """State by the solver's interpolant, good to about 1e-11."""
        return self._line(t) if not self.steps else self._step(t)[2](t)

    def at(self, t):
        """State by a solver step that ends at t, good to the tolerance."""
        if not self.steps:
            return self._line(t)
        t0, y0, _ = self._step(t)
        return self.land(t0, y0, t)


@dataclass
class Run:
    events: list
    arcs: list
    y_end: np.ndarray
    t_end: float
    mode_end: tuple
    margin: float
    status: str  # "ok", "pseudo_focus", "budget"; from `advance` also "stopped", "overshot"
    stopped_by: Any = None

    def at(self, t):
        """State (x1, x2) at a time of the run."""
        if not self.arcs[0].t_start <= t <= self.t_end:
            raise ValueError(f"time must be within the run, up to {self.t_end}, got {t}")
        i = bisect_right(self.arcs, t, key=lambda arc: arc.t_start) - 1
        return np.array(self.arcs[max(i, 0)].at(t))

    @property
    def sequence(self):
        """The events without their numbers: ((kind, belt), ...)."""
        return tuple((e.kind, e.belt) for e in self.events)


# ---------------------------------------------------------------- simulation


def simulate(osc, y0, T, rtol=1e-13, atol=1e-13, max_events=20_000, max_step=0.5, focus_speed=1e-3):
    """The run from y0 over [0, T].

    Passing an edge is one EDGE event, also where it ends a stick phase. Where several belts are
    concerned at once (an edge or a velocity that they share) the event names the lowest. A start
    on a boundary or an edge is resolved (stuck or not, which side) without an event. A run whose
    passages of an edge shrink below `focus_speed` is taken to converge to the pseudo-focus there;
    it ends with status "pseudo_focus" at that time and in that state.
    """
    x1, x2 = float(y0[0]), float(y0[1])
    mode, x2, status, margin = start_mode(osc, x1, x2)
    return advance(
        osc,
        (x1, x2),
        mode,
        T,
        rtol=rtol,
        atol=atol,
        max_events=max_events,
        max_step=max_step,
        focus_speed=focus_speed,
        status=status,
        margin=margin,
    )


def start_mode(osc, x1, x2):
    """Mode at a start: (mode, x2 snapped to the boundary it is on, status or None, margin)."""
    on_edge = any(x1 in (b.lower, b.upper) for b in osc.belts)
    if not on_edge or x2 != 0:
        return _mode_beside(osc, x1, x2, copysign(1, x2))
    # At rest on an edge: the accelerations on the two sides decide.
    left, right = (_mode_beside(osc, x1, 0.0, d) for d in (-1, 1))
    a_left, a_right = (
        0.0 if STUCK in side[0] else acceleration(osc, side[0])(x1, 0.0) for side in (left, right)
    )
    margin = min(left[3], right[3], abs(a_left), abs(a_right))
    if a_left > 0 > a_right:
        return right[0], 0.0, "pseudo_focus", margin
    if a_left < 0 < a_right:  # both ways are solutions
        margin = 0.0
    mode = left[0] if a_right < 0 or (a_right == 0 and a_left == 0) else right[0]
    return mode, 0.0, None, margin


def _mode_beside(osc, x1, x2, direction):
    """Mode for a state; direction says on which side of an edge it is, if it is on one."""
    mode = []
    for k, b in enumerate(osc.belts):
        if x1 < b.lower or (x1 == b.lower and direction < 0):
            mode.append(BELOW)
        elif x1 > b.upper or (x1 == b.upper and direction > 0):
            mode.append(ABOVE)
        else:
            mode.append(_sign_of_r(osc, k, x2))
    mode, margin = tuple(mode), inf
    if STUCK in mode:
        k = mode.index(STUCK)
        mode, _, margin = _hold_or_slip(osc, mode, osc.belts[k].velocity, x1)
        x2 = osc.speed(k)
    return mode, x2, None, margin


def _hold_or_slip(osc, mode, velocity, x1):
    """At rest on the belts of one velocity: held, or torn off against the needed force.

    Returns (mode, held, | |needed| - capacity |).
    """
    group = mates(osc, mode, velocity)
    needed, cap = needed_and_capacity(osc, mode, group, x1)
    held = abs(needed) < cap
    sign = STUCK if held else (-1 if needed > 0 else 1)
    return _replace(mode, group, sign), held, abs(abs(needed) - cap)


def advance(
    osc,
    y,
    mode,
    T,
    t=0.0,
    rtol=1e-13,
    atol=1e-13,
    max_events=20_000,
    max_step=0.5,
    focus_speed=1e-3,
    status=None,
    margin=inf,
    until=None,
    slack=None,
):
    """Run on from a state in a mode.

    until(item): called with every Event and Loop; the run stops where it is true.
    slack: {belt: distance}; the boundary of such a belt is not acted upon, the orbit runs on in
    its mode and stops (status "overshot") where it is this far beyond.
    """
    walk = _Walk(osc, y, mode, t, T, rtol, atol, max_step, focus_speed, margin, until, slack or {})
    walk.status = status
    for guard in guards_of(osc, walk.mode):
        if guard(walk.y) != 0:
            walk.near(guard(walk.y))
    while walk.status is None and walk.t < T:
        if len(walk.events) >= max_events:
            walk.status = "budget"
        elif STUCK in walk.mode:
            walk.stick()
        else:
            walk.slip()
    if walk.events:
        walk.near(T - walk.events[-1].t)
    return Run(
        walk.events,
        walk.arcs,
        np.array(walk.y),
        walk.t,
        walk.mode,
        walk.margin,
        walk.status or "ok",
        walk.stopped_by,
    )


class _Walk:
    """A run in the making: state, mode and time, and one method per kind of arc and of event."""

    def __init__(self, osc, y, mode, t, T, rtol, atol, max_step, focus_speed, margin, until, slack):
        self.osc, self.y, self.mode, self.t, self.T = osc, tuple(y), tuple(mode), t, T
        self.tol, self.max_step = dict(rtol=rtol, atol=atol), max_step
        self.focus_speed, self.margin = focus_speed, margin
        self.until, self.slack = until, slack
        self.events, self.arcs, self.status, self.stopped_by = [], [], None, None
        self.onset = True  # the arc may start tangent to its boundary: x2' = 0 up to rounding
        self.passages = {}  # edge -> speeds of the passages in a row, for the pseudo-focus

    def near(self, distance):
        self.margin = min(self.margin, float(abs(distance)))

    def tell(self, item):
        if self.until is not None and self.status is None and self.until(item):
            self.status, self.stopped_by = "stopped", item

    def record(self, kind, belts):
        """Note an event at the current state, between the last arc and the mode to come."""
        event = Event(self.t, kind, min(belts), *self.y, self.mode)
        self.events.append(event)
        # A corner is near where another line of either mode is. The event's own line is not
        # another one, nor is the boundary that the mass has been stuck to.
        before = self.arcs[-1].mode
        own = (0, self.y[0]) if kind == "EDGE" else (1, self.y[1])
        for line in guards_of(self.osc, before) + guards_of(self.osc, self.mode):
            left = STUCK in before and (line.axis, line.level) == (1, self.y[1])
            if (line.axis, line.level) != own and not left:
                self.near(line(self.y))
        if kind != "EDGE":
            self.passages.clear()
        self.tell(event)

    # ------------------------------------------------ stick

    def stick(self):
        """The mass rides on a belt until the needed force is too large or an edge is met."""
        osc, (x1, v) = self.osc, self.y
        velocity = osc.belts[self.mode.index(STUCK)].velocity
        group = mates(osc, self.mode, velocity)
        arc = Arc(self.mode, self.t, self.T, self.y)
        self.arcs.append(arc)
        duration, edge = inf, None
        if v != 0:
            rest = acceleration(osc, self.mode, without=group)(0.0, v)  # needed = rest - x1
            onset_x1 = rest + copysign(capacity(osc, group), v)
            duration = max((onset_x1 - x1) / v, 0.0)
            edges = [g for g in guards_of(osc, self.mode) if g.side * v < 0]
            times = [(g.level - x1) / v for g in edges]
            if times:
                first = int(np.argmin(times))
                self.near(edges[first].level - onset_x1)
                if times[first] <= duration:
                    duration, edge = times[first], edges[first]
        if self.t + duration > self.T:
            self.near(self.t + duration - self.T)
            self.y, self.t = tuple(arc._line(self.T)), self.T
            arc.exit = self.y
            return
        self.t = arc.t_end = self.t + duration
        self.y = arc.exit = (edge.level if edge else onset_x1, v)
        if edge is None:
            self.mode = _replace(self.mode, group, 1 if v > 0 else -1)
            self.onset = True
            self.record("SLIP", group)
        else:
            self.enter_side(edge, velocity)
            self.record("EDGE", edge.belts)

    # ------------------------------------------------ slip

    def slip(self):
        """Integrate a slip mode to the first of its guards."""
        osc = self.osc
        x2_prime = acceleration(osc, self.mode)
        guards = [self._moved(g) for g in guards_of(osc, self.mode)]

        def rhs(t, y):
            x1, x2 = y.tolist()
            return x2, x2_prime(x1, x2)

        def land(t0, y0, t):
            if t <= t0:
                return np.array(y0)
            solver = DOP853(rhs, t0, y0, t, first_step=t - t0, **self.tol)
            while solver.status == "running":
                solver.step()
            return solver.y

        arc = Arc(self.mode, self.t, self.T, self.y, land=land)
        self.arcs.append(arc)
        solver = DOP853(rhs, self.t, np.array(self.y), self.T, max_step=self.max_step, **self.tol)
        fresh, self.onset = self.onset, False
        while solver.status == "running":
            y_old = solver.y
            solver.step()
            if solver.status == "failed":
                raise RuntimeError(f"integration failed at t = {solver.t}, x = {solver.y}")
            dense, t_old = solver.dense_output(), solver.t_old
            arc.steps.append((t_old, y_old, dense))
            loops = _loops(dense, t_old, solver.t, x2_prime, self.mode, fresh)
            fresh = False
            left = t_old
            for loop in [*loops, None]:
                right, y = (loop.t, (loop.x1, loop.x2)) if loop else (solver.t, solver.y)
                passed = [g for g in guards if g(y) < 0]
                if passed:
                    roots = [_root(g, dense, left, right) for g in passed]
                    first = int(np.argmin(roots))
                    self._reach(arc, passed[first], roots[first], t_old, y_old, x2_prime)
                    return
                if loop:
                    for g in guards:
                        if g.axis == loop.axis:
                            self.near(g(y))
                    arc.loops.append(loop)
                    self.tell(loop)
                    if self.status:
                        self.t, self.y = loop.t, tuple(land(t_old, y_old, loop.t).tolist())
                        arc.t_end, arc.exit = self.t, self.y
                        return
                left = right
        self.t, self.y = self.T, tuple(solver.y.tolist())
        arc.exit = self.y
        for g in guards:
            self.near(g(self.y))

    def _moved(self, guard):
        slack = [self.slack[k] for k in guard.belts if k in self.slack]
        if guard.axis == 0 or not slack:
            return guard
        return Guard(1, guard.level - guard.side * slack[0], guard.side, guard.belts)

    def _reach(self, arc, guard, t, t_old, y_old, x2_prime):
        """End a slip arc on a guard: land there with solver steps instead of the interpolant."""
        y = arc.land(t_old, y_old, t)
        for _ in range(2):
            rate = y[1] if guard.axis == 0 else x2_prime(*y)
            shift = (guard.level - y[guard.axis]) / rate if rate else 0.0
            if abs(shift) > 1e-6:  # tangent: keep the root of the interpolant
                break
            t = max(t + shift, t_old)
            y = arc.land(t_old, y_old, t)
        if t >= self.T:
            self.near(t - self.T)
            t = self.T
        y = y.tolist()
        y[guard.axis] = guard.level
        self.t, self.y = float(t), tuple(y)
        arc.t_end, arc.exit = self.t, self.y
        if guard.axis == 0:
            self.pass_edge(guard, x2_prime)
        elif self.slack.keys() & set(guard.belts):
            self.status = "overshot"
        else:
            self.reach_boundary(guard, x2_prime)

    def reach_boundary(self, guard, x2_prime):
        """r = 0 from a slip mode: stick, or cross."""
        velocity = self.osc.belts[guard.belts[0]].velocity
        self.near(x2_prime(*self.y))  # slow arrival
        mode, held, gap = _hold_or_slip(self.osc, self.mode, velocity, self.y[0])
        self.near(gap)
        if held:
            self.mode = mode
        else:
            self.mode = _replace(self.mode, guard.belts, guard.side)
            self.near(acceleration(self.osc, self.mode)(*self.y))
        self.record("STICK" if held else "CROSS", guard.belts)

    def pass_edge(self, guard, x2_prime):
        """x1 on an edge while the mass slips."""
        x2 = self.y[1]
        self.near(x2)  # slow passage
        before = x2_prime(*self.y)
        self.enter_side(guard, None)
        if STUCK not in self.mode:
            self.watch_focus(guard.level, x2, before, acceleration(self.osc, self.mode)(*self.y))
        self.record("EDGE", guard.belts)

    def enter_side(self, guard, velocity):
        """Change contacts at an edge; velocity: of the belts stuck to until now, if any.

        Belts that stay keep their sign, an arriving belt gets the sign of its r. Where the mass
        is at the velocity of a touching belt, needed force and capacity are compared anew.
        """
        osc, (x1, x2) = self.osc, self.y
        mode = list(self.mode)
        for k in guard.belts:
            b = osc.belts[k]
            if guard.level == b.lower:
                mode[k] = _sign_of_r(osc, k, x2) if x2 > 0 else BELOW
            else:
                mode[k] = _sign_of_r(osc, k, x2) if x2 < 0 else ABOVE
        self.mode = tuple(mode)
        if STUCK in self.mode:
            if velocity is None:  # slipped exactly into a corner
                velocity = osc.belts[self.mode.index(STUCK)].velocity
            self.mode, _, gap = _hold_or_slip(osc, self.mode, velocity, x1)
            self.near(gap)

    def watch_focus(self, level, x2, before, after):
        """Stop where passages to and fro over one edge shrink: a stable pseudo-focus."""
        turns_back = before * x2 > 0 > after * x2
        speeds = self.passages.get(level, []) if turns_back else []
        self.passages = {level: [*speeds[-1:], abs(x2)]}
        # Two passages ago the mass went the same way: compare whole loops.
        small = turns_back and len(speeds) >= 2 and abs(x2) < self.focus_speed
        if small and abs(x2) < speeds[-2]:
            self.status = "pseudo_focus"


def _root(guard, dense, left, right):
    """First time at which a guard that is monotone on [left, right] is zero."""
    if guard(dense(left)) <= 0:
        return left
    if guard(dense(right)) >= 0:  # negative at the end of the step by rounding only
        return right
    return brentq(lambda t: guard(dense(t)), left, right, xtol=1e-15, rtol=1e-15)


_SAMPLES = np.linspace(0.0, 1.0, 7)


def _loops(dense, t_old, t_new, x2_prime, mode, fresh):
    """The zeros of x2 and x2' in a step, in order.

    fresh: the step starts at a slip onset, where x2' is zero up to rounding and not a loop.
    """
    ts = t_old + (t_new - t_old) * _SAMPLES
    x1, x2 = dense(ts)
    a = x2_prime(x1, x2)
    if fresh and abs(a[0]) < 1e-10:
        a[0] = a[1]
    loops = []
    for axis, values in ((0, x2), (1, a)):
        if values[0] == 0:
            values[0] = values[1]
        negative = values < 0
        for i in np.flatnonzero(negative[1:] != negative[:-1]):
            if axis == 0:
                t = _zero(lambda t: dense(t)[1], ts[i], ts[i + 1])
            else:
                t = _zero(lambda t: x2_prime(*dense(t)), ts[i], ts[i + 1])
            loops.append(Loop(float(t), axis, *dense(t).tolist(), mode))
    return sorted(loops, key=lambda loop: loop.t)


def _zero(f, a, b):
    fa, fb = f(a), f(b)
    if fa * fb > 0:  # the start was moved off an exact zero
        return b if abs(fb) < abs(fa) else a
    return brentq(f, a, b, xtol=1e-15, rtol=1e-15)


# ---------------------------------------------------------------- differences


def richardson(f, x, h, levels=3):
    """Derivative of f at x by central differences, extrapolated: (value, error estimate).

    Steps h, h/2, h/4, ...; f may return an array. The estimate is the last change in the table,
    so it covers truncation and, where h is too small, shows the rounding.
    """
    table = []
    for i in range(levels):
        step = h / 2**i
        row = [(np.asarray(f(x + step)) - np.asarray(f(x - step))) / (2 * step)]
        for j in range(1, i + 1):
            row.append(row[-1] + (row[-1] - table[-1][j - 1]) / (4**j - 1))
        table.append(row)
    value = table[-1][-1]
    error = np.maximum(np.abs(value - table[-1][-2]), np.abs(value - table[-2][-1]))
    return value, error
