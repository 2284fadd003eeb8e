"""A fast and independent second code for forced belt-driven oscillators, for campaigns.

A mass on a spring is dragged by belts and pushed by forces that depend on time,

    x1' = x2
    x2' = -x1 - zeta x2 + sum over touching belts of  u_i(t) mu_i(|r_i|) sgn(r_i)
          + sum over j of  F_j cos(Omega_j t + phi_j),            r_i = nu_i(t) - omega x2.

Velocities nu_i and loads u_i >= 0 of belts may oscillate, each with its own frequency. Nothing here
comes from the package. It shares with `engine`, the engine of autonomous runs, the coefficients of
DOP853 and the estimate of its error, at 1e-13; the rest is different because boundaries move with
time, forces depend on it, and stick phases are curved.

Slip arcs. A step that may come near a boundary r_i = 0 or an edge of a contact interval has to
show, by interval arithmetic over an enclosure of the whole step in state and time, that the
distance g to it is positive throughout, or monotone, or convex, or concave over the step; or the
step is halved. Of a convex distance the least value is sought. So no excursion is missed and none
is made up, however short.

Stick phases. x2 = nu_k(t)/omega, and x1 is its integral, in closed form. Five kinds of distances
end the phase: capacity - needed and capacity + needed, x1 from either edge, and the relative
velocity of every other touching belt, where

    needed = nu_k'/omega + x1 + zeta nu_k/omega - (friction of the other belts) - (forces).

All are explicit functions of the time, and their first root is found by the same proof, with bounds
of their first and second derivatives over an interval of time. A double root touches and the phase
goes on; a triple root passes. A phase is for ever (status STUCK_FOREVER) where x1 does not drift
and the limits hold for all phases of all waves, or over one period that all frequencies have in
common; such a run goes on to its final time, because the belt may oscillate.

The forces at the point of an event decide what follows. Z are the touching belts with r = 0. Each
velocity among those of Z is tried: the mass can stick to it if the belts of that velocity can exert
the friction needed, while the signs of the others are those of the differences of velocities just
afterwards. The belt that the mass is stuck to is tried first, then the one that was met. If no
velocity can be held, the mass slips with the only signs that agree with its acceleration. Where
|needed| = capacity exactly, the derivatives of |needed| - capacity decide.

A mass may also rest on an edge to which it is pushed from both sides. A run that starts there, or
whose loops around such a point become smaller than the rounding of x1, ends at that time with the
status PSEUDO_FOCUS; whether and when the mass leaves is not computed.

Contact codes, one for each belt: 1, -1 slips with that sign of r; 0 stuck; -2, 2 mass below, above
the interval. Kinds of events:

- STICK k: the mass sticks to belt k, from a slip arc, or from another belt to which it was stuck;
- SLIP k: it was stuck to belt k and slips on all belts;
- CROSS k: r_k changes its sign, in a slip arc, or while the mass goes on sticking to another belt;
- EDGE k: the mass enters or leaves the interval of belt k, which may also end a stick phase.

Where several belts are concerned at once the event names the lowest number. The mode at the start
is found without an event. Usage:

    belt = Belt(1.0, ("cubic", 1.5, 1.5, 0.45))
    osc = Oscillator(0.0, (belt,), (Harmonic(0.1, 1.7077),))
    run = simulate(osc, (0.5, 0.0), 60.0)            # from t = 0, the time of the cosines, to 60
    run.t, run.sequence, run.y, run.codes            # events (t; (kind, belt); (x1, x2); codes)
    run.y_end, run.mode_end, run.status, run.margin
    simulate(osc, (0.5, 0.0), 60.0, noise=1e-10, seed=3)     # disturbed by the size of a tolerance

`margin` is the smallest distance from another outcome that the run has met: compare sequences only
where it is well above the accuracy of the code under test. `forced_cases` has random and round
oscillators, batches of runs on several threads, the effect of a tolerance, and the verdict on
another code's answer.
"""

from dataclasses import dataclass, field
from fractions import Fraction
from math import inf, lcm, pi

import numpy as np
from numba import njit
from scipy.integrate._ivp import dop853_coefficients as _dop853

from .engine import (
    _A,
    _B,
    _N,
    BUDGET,
    CORNER,
    CROSS,
    EDGE,
    NOT_FINITE,
    OK,
    PSEUDO_FOCUS,
    SLIP,
    STEPS,
    STICK,
    STUCK_FOREVER,
    _error,
    _product,
)

__all__ = [
    "BUDGET",
    "CORNER",
    "CROSS",
    "EDGE",
    "NOT_FINITE",
    "OK",
    "PSEUDO_FOCUS",
    "SLIP",
    "STEPS",
    "STICK",
    "STUCK_FOREVER",
    "Belt",
    "Harmonic",
    "Oscillating",
    "Oscillator",
    "Run",
    "base_motion",
    "force",
    "simulate",
]

_C = np.ascontiguousarray(_dop853.C[:_N])
#: Gauss's rule of order ten on [0, 1].
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_NODES, _WEIGHTS = 0.5 * (1 + _NODES), 0.5 * _WEIGHTS

#: Longest step; shortest that is still halved.
_LONGEST, _SHORTEST = 0.5, 1e-10
#: Most steps of one stick phase; after these its end counts as unknown.
_MOST_ROUNDS = 1_000_000
#: Distances above this one need no closer look; below it the margin of a run is exact.
_CLOSE = 1e-6
#: A distance below _ROUNDING times the size of its terms is zero up to rounding; velocities with a
#: relative difference below _SAME are equal at an instant. Both grow with time by `_blur`.
_ROUNDING, _SAME = 1e-14, 2e-15
#: Length of an interval of time that stands for infinity: bounds over it hold for ever.
_EVER = 1e12
#: Largest denominator of the ratios of frequencies for which a common period is found.
_RATIOS = 64
#: Columns of `Oscillator.table`: velocity 0-3 and load 4-7 (mean, amplitude, frequency, phase).
_LOAD, _LOWER, _UPPER, _STATIC, _LAW = 4, 8, 9, 10, 11


# ---------------------------------------------------------------- problems


@dataclass(frozen=True)
class Oscillating:
    """mean + amplitude cos(frequency t + phase)."""

    mean: float
    amplitude: float
    frequency: float
    phase: float = 0.0


@dataclass(frozen=True)
class Harmonic:
    """A force amplitude cos(frequency t + phase)."""

    amplitude: float
    frequency: float
    phase: float = 0.0


@dataclass(frozen=True)
class BaseMotion(Harmonic):
    """A support that moves by amplitude cos(frequency t + phase)."""


@dataclass(frozen=True)
class Belt:
    """velocity, load: numbers or `Oscillating`. law: as in `engine.Belt`, or ("cubic", a0, a1, a3),
    mu(r) = a0 - a1 r + a3 r^3, or ("polynomial", c0, c1, c2, c3)."""

    velocity: float | Oscillating
    law: tuple
    load: float | Oscillating = 1.0
    lower: float = -inf
    upper: float = inf


@dataclass(frozen=True)
class Oscillator:
    damping: float
    belts: tuple
    forces: tuple = ()
    omega: float = 1.0

    def table(self):
        """The belts as rows: velocity and load, four numbers each, lower, upper, static, form, and
        the law's numbers c0, c1, c2, ...

        mu(r) = c0 f(c1 r) + c2 + c3 r + c4 r^2 + c5 r^3, f(x) = 1/(1 + x) (form 0) or exp(-x)
        (form 1).
        """
        rows = []
        for b in self.belts:
            name, static, *p = b.law
            if name == "conti":
                p1, p3, p2 = (*p, 0.0) if len(p) == 2 else p
                law = (0, static - p1, p3, p1, 0.0, p2, 0.0)
            elif name == "coulomb":
                law = (0, 0.0, 0.0, p[0], 0.0, 0.0, 0.0)
            elif name == "stribeck":
                law = (1, static - p[0], 1 / p[1], p[0], 0.0, 0.0, 0.0)
            elif name == "cubic":
                law = (0, 0.0, 0.0, static, -p[0], 0.0, p[1])
            elif name == "polynomial":
                law = (0, 0.0, 0.0, static, *p)
            else:
                raise ValueError(f"unknown law {name}")
            rows.append((*_numbers(b.velocity), *_numbers(b.load), b.lower, b.upper, static, *law))
        return np.array(rows, dtype=float)

    def clock(self):
        """The forces as rows (0, amplitude, frequency, phase), one for each frequency.

        They are added here because forces that cancel do not cancel in sums of intervals.
        """
        groups, rows = {}, []
        for f in self.forces:
            waves = [f]
            if isinstance(f, BaseMotion):
                waves = base_motion(self.damping, f.amplitude, f.frequency, f.phase)
            for one in waves:
                row = _numbers(Oscillating(0.0, one.amplitude, one.frequency, one.phase))
                groups.setdefault(row[2], []).append(row)
        for frequency, some in groups.items():
            if len(some) == 1:
                rows += some
                continue
            total = sum(amplitude * np.exp(1j * phase) for _, amplitude, _, phase in some)
            if abs(total) > 1e-15 * sum(abs(amplitude) for _, amplitude, _, _ in some):
                rows.append((0.0, abs(total), frequency, np.angle(total)))
        return np.array(rows, dtype=float).reshape(-1, 4)

    def common_period(self):
        """The period that all waves have in common, 0 where there are none, inf where none is
        known."""
        waves = [*self.clock()] + [row[c : c + 4] for row in self.table() for c in (0, _LOAD)]
        found = sorted({float(w[2]) for w in waves if w[1] and w[2]})
        if not found:
            return 0.0
        ratios = [Fraction(f / found[0]).limit_denominator(_RATIOS) for f in found]
        if any(abs(f / found[0] - float(q)) > 1e-15 * float(q) for f, q in zip(found, ratios)):
            return inf
        return 2 * pi / found[0] * lcm(*(q.denominator for q in ratios))


def _numbers(wave):
    """mean, amplitude, frequency >= 0, phase."""
    if not isinstance(wave, Oscillating):
        return float(wave), 0.0, 0.0, 0.0
    turned = -1.0 if wave.frequency < 0 else 1.0
    return wave.mean, wave.amplitude, turned * wave.frequency, turned * wave.phase


def base_motion(damping, amplitude, frequency, phase=0.0):
    """The forces on a mass whose spring and dashpot end in a support that moves by
    amplitude cos(frequency t + phase)."""
    return (
        Harmonic(amplitude, frequency, phase),
        Harmonic(amplitude * damping * frequency, frequency, phase + pi / 2),
    )


@dataclass(frozen=True)
class Run:
    """Events: t, kind, belt, y = (x1, x2) and the codes after it, a row each. speeds: rate at which
    each event's distance went to zero. margin: the smallest distance from another outcome."""

    t: np.ndarray
    kind: np.ndarray
    belt: np.ndarray
    y: np.ndarray
    codes: np.ndarray
    speeds: np.ndarray = field(repr=False)
    t_end: float
    y_end: tuple
    mode_end: tuple
    status: int
    margin: float
    steps: int = field(default=0, repr=False)

    @property
    def sequence(self):
        return tuple(zip(self.kind.tolist(), self.belt.tolist()))


def simulate(osc, y0, t1, *, t0=0.0, tol=1e-13, noise=0.0, seed=0, mode=None, max_events=20_000):
    """The run from y0 over [t0, t1].

    mode: contact codes to go on with, None: those of the state. noise: a tolerance, as rtol and
    atol; every step of length h is disturbed by noise (1 + |y|) h, the state after every event by
    noise (1 + |y|), at random.
    """
    n = len(osc.belts)
    given = np.full(n, 9, np.int64) if mode is None else np.array(mode, np.int64)
    out = np.empty((max_events, 6 + n))
    count, t, x1, x2, status, margin, codes, steps = _run(
        float(osc.damping),
        float(osc.omega),
        osc.table(),
        osc.clock(),
        osc.common_period(),
        float(y0[0]),
        float(y0[1]),
        given,
        float(t0),
        float(t1),
        float(tol),
        float(noise),
        int(seed),
        out,
    )
    rows = out[:count].copy()
    return Run(
        rows[:, 0],
        rows[:, 1].astype(int),
        rows[:, 2].astype(int),
        rows[:, 3:5],
        rows[:, 6:].astype(int),
        rows[:, 5],
        t,
        (x1, x2),
        tuple(codes.tolist()),
        status,
        margin,
        steps,
    )


# ---------------------------------------------------------------- waves and laws


@njit(nogil=True, cache=True, error_model="numpy")
def _wave(row, c, t, k):
    """The k-th derivative at t of the wave in the columns from c of a row."""
    value = row[c] if k == 0 else 0.0
    if row[c + 1] != 0:
        f, angle = row[c + 2], row[c + 2] * t + row[c + 3]
        if k == 0:
            value += row[c + 1] * np.cos(angle)
        elif k == 1:
            value -= row[c + 1] * f * np.sin(angle)
        elif k == 2:
            value -= row[c + 1] * f * f * np.cos(angle)
        else:
            value += row[c + 1] * f * f * f * np.sin(angle)
    return value


@njit(nogil=True, cache=True, error_model="numpy")
def _blur(t):
    """Factor by which the rounding error of a wave's angle grows with time."""
    return 1 + 0.1 * abs(t)


@njit(nogil=True, cache=True, error_model="numpy")
def _cosine_interval(a, b):
    """Bounds of the cosine over [a, b]."""
    if b - a >= 2 * np.pi:
        return -1.0, 1.0
    p, q = np.cos(a), np.cos(b)
    low, high = min(p, q), max(p, q)
    if np.ceil(a / (2 * np.pi)) * 2 * np.pi <= b:
        high = 1.0
    if np.ceil((a - np.pi) / (2 * np.pi)) * 2 * np.pi + np.pi <= b:
        low = -1.0
    return low, high


@njit(nogil=True, cache=True, error_model="numpy")
def _wave_interval(row, c, t, h, k):
    """Bounds of the k-th derivative of a wave over [t, t + h]."""
    if row[c + 1] == 0 or h == 0:
        value = _wave(row, c, t, k)
        return value, value
    angle = row[c + 2] * t + row[c + 3] + 0.5 * np.pi * k
    p, q = _cosine_interval(angle, angle + row[c + 2] * h)
    size = row[c + 1]
    for _ in range(k):
        size *= row[c + 2]
    p, q = _product(size, size, p, q)
    return (row[c] + p, row[c] + q) if k == 0 else (p, q)


@njit(nogil=True, cache=True, error_model="numpy")
def _travel(row, start, t):
    """The integral of a velocity from `start` to t."""
    way = row[0] * (t - start)
    if row[1] != 0:
        if row[2] == 0:
            way += row[1] * np.cos(row[3]) * (t - start)
        else:
            half = 0.5 * row[2] * (t - start)
            way += 2 * row[1] / row[2] * np.sin(half) * np.cos(row[2] * start + half + row[3])
    return way


@njit(nogil=True, cache=True, error_model="numpy")
def _travel_interval(row, start, t, h):
    """Bounds of the integral of a velocity from `start` to [t, t + h]."""
    if h == 0:
        way = _travel(row, start, t)
        return way, way
    p, q = row[0] * (t - start), row[0] * (t + h - start)
    low, high = min(p, q), max(p, q)
    if row[1] != 0:
        if row[2] == 0:
            p, q = _product(row[1], row[1], np.cos(row[3]), np.cos(row[3]))
            p, q = _product(p, q, t - start, t + h - start)
        else:
            angle = row[2] * t + row[3] - 0.5 * np.pi
            p, q = _cosine_interval(angle, angle + row[2] * h)
            begun = np.sin(row[2] * start + row[3])
            p, q = _product(row[1] / row[2], row[1] / row[2], p - begun, q - begun)
        low, high = low + p, high + q
    return low, high


@njit(nogil=True, cache=True, error_model="numpy")
def _mu(row, r):
    f = np.exp(-row[13] * r) if row[11] == 1 else 1 / (1 + row[13] * r)
    return row[12] * f + row[14] + r * (row[15] + r * (row[16] + r * row[17]))


@njit(nogil=True, cache=True, error_model="numpy")
def _steep(row, r, k):
    """The k-th derivative of the part of a law that is not polynomial, which is monotone in r."""
    c = row[13]
    if row[11] == 1:
        f = np.exp(-c * r)
        return row[12] * (f if k == 0 else -c * f if k == 1 else c * c * f)
    f = 1 / (1 + c * r)
    return row[12] * (f if k == 0 else -c * f * f if k == 1 else 2 * c * c * f * f * f)


@njit(nogil=True, cache=True, error_model="numpy")
def _mu_slope(row, r):
    return _steep(row, r, 1) + row[15] + r * (2 * row[16] + r * 3 * row[17])


@njit(nogil=True, cache=True, error_model="numpy")
def _mu_interval(row, ra, rb, k):
    """Bounds of the k-th derivative of mu over [ra, rb]."""
    p, q = _steep(row, ra, k), _steep(row, rb, k)
    low, high = min(p, q), max(p, q)
    squares = max(ra * ra, rb * rb)
    least = 0.0 if ra <= 0 <= rb else min(ra * ra, rb * rb)
    if k == 0:
        low, high = low + row[14], high + row[14]
        p, q = _product(row[15], row[15], ra, rb)
        low, high = low + p, high + q
        p, q = _product(row[16], row[16], least, squares)
        low, high = low + p, high + q
        p, q = _product(row[17], row[17], ra * ra * ra, rb * rb * rb)
    elif k == 1:
        low, high = low + row[15], high + row[15]
        p, q = _product(2 * row[16], 2 * row[16], ra, rb)
        low, high = low + p, high + q
        p, q = _product(3 * row[17], 3 * row[17], least, squares)
    else:
        low, high = low + 2 * row[16], high + 2 * row[16]
        p, q = _product(6 * row[17], 6 * row[17], ra, rb)
    return low + p, high + q


# ---------------------------------------------------------------- field


@njit(nogil=True, cache=True, error_model="numpy")
def _force(z, w, B, F, s, t, x1, x2):
    """x2' in the mode s; stuck belts add nothing. NaN where a law is far beyond its boundary."""
    f = -x1 - z * x2
    for j in range(F.shape[0]):
        f += _wave(F[j], 0, t, 0)
    for i in range(B.shape[0]):
        if s[i] == 1 or s[i] == -1:
            r = s[i] * (_wave(B[i], 0, t, 0) - w * x2)
            if B[i, 13] * r < -0.25:
                return np.nan
            f += s[i] * _wave(B[i], _LOAD, t, 0) * _mu(B[i], r)
    return f


@njit(nogil=True, cache=True, error_model="numpy")
def _jerk(z, w, B, F, s, t, x1, x2, a):
    """x2'' in the mode s."""
    f = -x2 - z * a
    for j in range(F.shape[0]):
        f += _wave(F[j], 0, t, 1)
    for i in range(B.shape[0]):
        if s[i] == 1 or s[i] == -1:
            r = s[i] * (_wave(B[i], 0, t, 0) - w * x2)
            f += s[i] * _wave(B[i], _LOAD, t, 1) * _mu(B[i], r)
            rate = _wave(B[i], 0, t, 1) - w * a
            f += _wave(B[i], _LOAD, t, 0) * _mu_slope(B[i], r) * rate
    return f


@njit(nogil=True, cache=True, error_model="numpy")
def _advance(z, w, B, F, s, t, x1, x2, a, h, V, K):
    """One step of DOP853; V, K: room for the stages' x2 and x2'."""
    V[0], K[0] = x2, a
    for i in range(1, _N):
        d1 = 0.0
        d2 = 0.0
        for j in range(i):
            d1 += _A[i, j] * V[j]
            d2 += _A[i, j] * K[j]
        V[i] = x2 + h * d2
        K[i] = _force(z, w, B, F, s, t + _C[i] * h, x1 + h * d1, V[i])
    d1 = 0.0
    d2 = 0.0
    for j in range(_N):
        d1 += _B[j] * V[j]
        d2 += _B[j] * K[j]
    y1, y2 = x1 + h * d1, x2 + h * d2
    V[_N], K[_N] = y2, _force(z, w, B, F, s, t + h, y1, y2)
    return y1, y2


def force(osc, mode, t, x1, x2):
    """x2' in the field of a slip mode."""
    mode = np.array(mode, np.int64)
    return _force(
        float(osc.damping),
        float(osc.omega),
        osc.table(),
        osc.clock(),
        mode,
        float(t),
        float(x1),
        float(x2),
    )


# ---------------------------------------------------------------- enclosures of slip arcs


@njit(nogil=True, cache=True, error_model="numpy")
def _waves(B, F, s, t, h, E):
    """Bounds over [t, t + h], into E: row i has those of nu, nu', nu'', u, u' of belt i, the last
    row those of the sum of the forces and its derivative."""
    n = B.shape[0]
    for i in range(n):
        if s[i] == 1 or s[i] == -1:
            for k in range(3):
                E[i, 2 * k], E[i, 2 * k + 1] = _wave_interval(B[i], 0, t, h, k)
            for k in range(2):
                E[i, 6 + 2 * k], E[i, 7 + 2 * k] = _wave_interval(B[i], _LOAD, t, h, k)
    E[n, :] = 0.0
    for j in range(F.shape[0]):
        for k in range(2):
            p, q = _wave_interval(F[j], 0, t, h, k)
            E[n, 2 * k] += p
            E[n, 2 * k + 1] += q


@njit(nogil=True, cache=True, error_model="numpy")
def _relative(w, s, E, i, l2, u2):
    """Bounds of s r of a slipping belt."""
    ra, rb = E[i, 0] - w * u2, E[i, 1] - w * l2
    return (ra, rb) if s[i] > 0 else (-rb, -ra)


@njit(nogil=True, cache=True, error_model="numpy")
def _force_interval(z, w, B, s, E, l1, u1, l2, u2):
    """Bounds of x2' over a box; NaN where a law is far beyond its boundary."""
    n = B.shape[0]
    p, q = _product(-z, -z, l2, u2)
    low, high = p - u1 + E[n, 0], q - l1 + E[n, 1]
    for i in range(n):
        if s[i] != 1 and s[i] != -1:
            continue
        ra, rb = _relative(w, s, E, i, l2, u2)
        if B[i, 13] * ra < -0.25:
            return np.nan, np.nan
        p, q = _mu_interval(B[i], ra, rb, 0)
        p, q = _product(p, q, E[i, 6], E[i, 7])
        if s[i] < 0:
            p, q = -q, -p
        low, high = low + p, high + q
    return low, high


@njit(nogil=True, cache=True, error_model="numpy")
def _jerk_interval(z, w, B, s, E, l2, u2, al, ah):
    """Bounds of x2'' over a box."""
    n = B.shape[0]
    p, q = _product(-z, -z, al, ah)
    low, high = p - u2 + E[n, 2], q - l2 + E[n, 3]
    for i in range(n):
        if s[i] != 1 and s[i] != -1:
            continue
        ra, rb = _relative(w, s, E, i, l2, u2)
        if E[i, 8] != 0 or E[i, 9] != 0:
            p, q = _mu_interval(B[i], ra, rb, 0)
            p, q = _product(p, q, E[i, 8], E[i, 9])
            if s[i] < 0:
                p, q = -q, -p
            low, high = low + p, high + q
        p, q = _mu_interval(B[i], ra, rb, 1)
        p, q = _product(p, q, E[i, 6], E[i, 7])
        p, q = _product(p, q, E[i, 2] - w * ah, E[i, 3] - w * al)
        low, high = low + p, high + q
    return low, high


@njit(nogil=True, cache=True, error_model="numpy")
def _enclose(z, w, B, F, s, t, x1, x2, a, y1, y2, b, h, E, box):
    """Bounds of x1, x2, x2', x2'' over the step, into `box`; False where none were found.

    A box encloses the step if Picard's iteration maps the box into itself.
    """
    _waves(B, F, s, t, h, E)
    room = 0.1 * abs(y2 - x2) + 0.05 * h * (abs(a) + abs(b)) + 1e-300
    l2, u2 = min(x2, y2) - room, max(x2, y2) + room
    found = False
    n_l2, n_u2 = l2, u2
    for _ in range(8):
        l1, u1 = x1 + min(0.0, h * l2), x1 + max(0.0, h * u2)
        low, high = _force_interval(z, w, B, s, E, l1, u1, l2, u2)
        if not (low <= high):
            return False
        n_l2, n_u2 = x2 + min(0.0, h * low), x2 + max(0.0, h * high)
        if n_l2 >= l2 and n_u2 <= u2:
            found = True
            break
        room = 0.2 * (n_u2 - n_l2)
        l2, u2 = min(l2, n_l2 - room), max(u2, n_u2 + room)
    if not found:
        return False
    # The box is tightened from both ends of the step.
    l2, u2 = max(n_l2, y2 - max(0.0, h * high)), min(n_u2, y2 - min(0.0, h * low))
    l2, u2 = min(l2, min(x2, y2)), max(u2, max(x2, y2))
    l1 = max(x1 + min(0.0, h * l2), y1 - max(0.0, h * u2))
    u1 = min(x1 + max(0.0, h * u2), y1 - min(0.0, h * l2))
    l1, u1 = min(l1, min(x1, y1)), max(u1, max(x1, y1))
    low, high = _force_interval(z, w, B, s, E, l1, u1, l2, u2)
    jl, jh = _jerk_interval(z, w, B, s, E, l2, u2, low, high)
    al = max(low, max(a + min(0.0, h * jl), b - max(0.0, h * jh)))
    ah = min(high, min(a + max(0.0, h * jh), b - min(0.0, h * jl)))
    al, ah = min(al, min(a, b)), max(ah, max(a, b))
    jl, jh = _jerk_interval(z, w, B, s, E, l2, u2, al, ah)
    box[0], box[1], box[2], box[3] = l1, u1, l2, u2
    box[4], box[5], box[6], box[7] = al, ah, jl, jh
    return True


# ---------------------------------------------------------------- the first root of a distance
#
# A distance is given by its value, slope and curvature at a point, and by bounds of all three over
# an interval: `_verdict` says whether it has a root there. Lines of a slip arc: 0, 1 the left and
# right edge, 2 + i belt i. Lines of a stick phase: 0, 1 the edges, 2, 3 capacity -+ needed, 4 + i
# belt i.


@njit(nogil=True, cache=True, error_model="numpy")
def _verdict(g0, g1, d0, d1, h, shift, touch, R):
    """Whether a distance, from g0 > 0 to g1 with slopes d0 and d1, is negative in between.

    R: bounds of the distance, its slope and its curvature over the interval; they are tightened.
    shift: number added to a distance that began at zero. touch: depth below zero down to which a
    convex distance only touches it. Returns 0 no, 1 yes, once, 2 perhaps, around a minimum of a
    convex distance, 3 undecided.
    """
    R[2] = max(R[2], max(d0 + min(0.0, h * R[4]), d1 - max(0.0, h * R[5])))
    R[3] = min(R[3], min(d0 + max(0.0, h * R[5]), d1 - min(0.0, h * R[4])))
    R[0] = max(R[0], max(g0 + min(0.0, h * R[2]), g1 - max(0.0, h * R[3])))
    if R[0] > (0.0 if shift > 0 else _CLOSE):
        return 0
    rising, falling = R[2] >= 0, R[3] <= 0
    convex, concave = R[4] >= 0, R[5] <= 0
    if rising and g1 > 0:
        return 0
    if not (rising or falling or convex or concave) and h > _SHORTEST:
        return 3
    if g1 > 0 or (convex and g1 >= -touch):
        return 2 if convex and d0 < 0 < d1 else 0
    return 1


@njit(nogil=True, cache=True, error_model="numpy")
def _slip_line(z, w, B, F, s, L, line, t, x1, x2, a):
    """Distance from a line of a slip arc, its slope and its curvature."""
    if line == 0:
        return x1 - L[0], x2, a
    if line == 1:
        return L[1] - x1, -x2, -a
    i = line - 2
    g, d = s[i] * (_wave(B[i], 0, t, 0) - w * x2), s[i] * (_wave(B[i], 0, t, 1) - w * a)
    return g, d, s[i] * (_wave(B[i], 0, t, 2) - w * _jerk(z, w, B, F, s, t, x1, x2, a))


@njit(nogil=True, cache=True, error_model="numpy")
def _slip_bounds(w, s, L, line, E, box, R):
    """Bounds of the distance, slope and curvature over a step."""
    if line == 0:
        R[0], R[1], R[2], R[3] = box[0] - L[0], box[1] - L[0], box[2], box[3]
        R[4], R[5] = box[4], box[5]
    elif line == 1:
        R[0], R[1], R[2], R[3] = L[1] - box[1], L[1] - box[0], -box[3], -box[2]
        R[4], R[5] = -box[5], -box[4]
    else:
        i = line - 2
        for k in range(3):
            p, q = (
                E[i, 2 * k] - w * box[2 * k + 3],
                E[i, 2 * k + 1] - w * box[2 * k + 2],
            )
            R[2 * k], R[2 * k + 1] = (p, q) if s[i] > 0 else (-q, -p)


@njit(nogil=True, cache=True, error_model="numpy")
def _slip_root(z, w, B, F, s, L, line, order, shift, t, x1, x2, a, right, f_left, f_right, V, K):
    """The step length up to `right` at which a distance (order 0) or its slope (1) is zero.

    Newton's method, kept within the bracket by bisection. Returns the length and the state.
    """
    left = 0.0
    h = right * min(max(f_left / (f_left - f_right), 0.1), 0.9)
    y1, y2 = x1, x2
    size = right
    for i in range(100):
        y1, y2 = _advance(z, w, B, F, s, t, x1, x2, a, h, V, K)
        g, d, c = _slip_line(z, w, B, F, s, L, line, t + h, y1, y2, K[_N])
        f, slope = (g + shift, d) if order == 0 else (d, c)
        if f == 0:
            return h, y1, y2
        if (f > 0) == (f_left > 0):
            left = h
        else:
            right = h
        new = h - f / slope if slope != 0 else left - 1.0
        if not (left < new < right) or (i % 4 == 3 and right - left > 0.5 * size):
            new = 0.5 * (left + right)
        if i % 4 == 3:
            size = right - left
        if abs(new - h) <= 1e-16 or right - left <= 1e-16 or new == left or new == right:
            return h, y1, y2
        h = new
    return h, y1, y2


@njit(nogil=True, cache=True, error_model="numpy")
def _slip_root_beside(z, w, B, F, s, L, line, t, x1, x2, a, right, V, K):
    """Root as in `_stick_root_beside`, on a slip arc; returns the length and the state there."""
    left, end, h = 0.0, right, right
    for _ in range(60):
        mean = 0.0
        for i in range(_NODES.size):
            part = _NODES[i] * h
            y1, y2 = _advance(z, w, B, F, s, t, x1, x2, a, part, V, K)
            _, slope, _ = _slip_line(z, w, B, F, s, L, line, t + part, y1, y2, K[_N])
            mean += _WEIGHTS[i] * slope
        if mean > 0:
            left = h
        else:
            right = h
        # The mean is g / h.
        y1, y2 = _advance(z, w, B, F, s, t, x1, x2, a, h, V, K)
        _, slope, _ = _slip_line(z, w, B, F, s, L, line, t + h, y1, y2, K[_N])
        new = h - h * mean / (slope - mean) if slope < mean else 0.0
        if not (left < new < right):
            new = 0.5 * (left + right)
        if abs(new - h) <= 1e-16:
            break
        h = new
    h = min(max(h, 1e-11 * _blur(t)), end)
    y1, y2 = _advance(z, w, B, F, s, t, x1, x2, a, h, V, K)
    return h, y1, y2


@njit(nogil=True, cache=True, error_model="numpy")
def _stick_line(z, w, B, F, s, k, start, x1, L, line, t, h, R):
    """Bounds of a distance of a stick phase, of its slope and curvature over [t, t + h], into R.

    The mass is stuck to belt k, and was at x1 at the time `start`. With h = 0 bounds are values.
    """
    v0l, v0h = _wave_interval(B[k], 0, t, h, 0)
    v1l, v1h = _wave_interval(B[k], 0, t, h, 1)
    if line < 2:
        p, q = _travel_interval(B[k], start, t, h)
        if line == 0:
            R[0], R[1] = x1 + p / w - L[0], x1 + q / w - L[0]
            R[2], R[3], R[4], R[5] = v0l / w, v0h / w, v1l / w, v1h / w
        else:
            R[0], R[1] = L[1] - x1 - q / w, L[1] - x1 - p / w
            R[2], R[3], R[4], R[5] = -v0h / w, -v0l / w, -v1h / w, -v1l / w
        return
    if line >= 4:
        i = line - 4
        for m in range(3):
            p, q = _wave_interval(B[i], 0, t, h, m)
            a, b = _wave_interval(B[k], 0, t, h, m)
            R[2 * m], R[2 * m + 1] = (p - b, q - a) if s[i] > 0 else (a - q, b - p)
        return
    v2l, v2h = _wave_interval(B[k], 0, t, h, 2)
    v3l, v3h = _wave_interval(B[k], 0, t, h, 3)
    p, q = _travel_interval(B[k], start, t, h)
    a, b = _product(z, z, v0l, v0h)
    R[0], R[1] = x1 + (p + a + v1l) / w, x1 + (q + b + v1h) / w
    a, b = _product(z, z, v1l, v1h)
    R[2], R[3] = (v2l + v0l + a) / w, (v2h + v0h + b) / w
    a, b = _product(z, z, v2l, v2h)
    R[4], R[5] = (v3l + v1l + a) / w, (v3h + v1h + b) / w
    for j in range(F.shape[0]):
        for m in range(3):
            p, q = _wave_interval(F[j], 0, t, h, m)
            R[2 * m] -= q
            R[2 * m + 1] -= p
    sign = -1.0 if line == 2 else 1.0
    for i in range(B.shape[0]):
        if s[i] != 1 and s[i] != -1:
            continue
        p, q = _wave_interval(B[i], 0, t, h, 0)
        ra, rb = (p - v0h, q - v0l) if s[i] > 0 else (v0l - q, v0h - p)
        if B[i, 13] * ra < -0.25:
            R[:] = np.nan
            return
        p, q = _wave_interval(B[i], 0, t, h, 1)
        e1l, e1h = p - v1h, q - v1l
        p, q = _wave_interval(B[i], 0, t, h, 2)
        e2l, e2h = p - v2h, q - v2l
        m0l, m0h = _mu_interval(B[i], ra, rb, 0)
        m1l, m1h = _mu_interval(B[i], ra, rb, 1)
        m2l, m2h = _mu_interval(B[i], ra, rb, 2)
        u0l, u0h = _wave_interval(B[i], _LOAD, t, h, 0)
        u1l, u1h = _wave_interval(B[i], _LOAD, t, h, 1)
        u2l, u2h = _wave_interval(B[i], _LOAD, t, h, 2)
        # s u mu(s r) and its derivatives, with d mu(s r)/dt = mu' s r'.
        p, q = _product(u0l, u0h, m0l, m0h)
        p, q = (p, q) if s[i] > 0 else (-q, -p)
        R[0], R[1] = R[0] - q, R[1] - p
        p, q = _product(u1l, u1h, m0l, m0h)
        p, q = (p, q) if s[i] > 0 else (-q, -p)
        a, b = _product(u0l, u0h, m1l, m1h)
        a, b = _product(a, b, e1l, e1h)
        R[2], R[3] = R[2] - q - b, R[3] - p - a
        p, q = _product(u2l, u2h, m0l, m0h)
        least = 0.0 if e1l <= 0 <= e1h else min(e1l * e1l, e1h * e1h)
        a, b = _product(u0l, u0h, m2l, m2h)
        a, b = _product(a, b, least, max(e1l * e1l, e1h * e1h))
        p, q = p + a, q + b
        p, q = (p, q) if s[i] > 0 else (-q, -p)
        R[4], R[5] = R[4] - q, R[5] - p
        p, q = _product(u1l, u1h, m1l, m1h)
        p, q = _product(p, q, e1l, e1h)
        a, b = _product(u0l, u0h, m1l, m1h)
        a, b = _product(a, b, e2l, e2h)
        R[4], R[5] = R[4] - 2 * q - b, R[5] - 2 * p - a
    for m in range(3):
        p, q = R[2 * m], R[2 * m + 1]
        R[2 * m], R[2 * m + 1] = (-q, -p) if sign < 0 else (p, q)
        for i in range(B.shape[0]):
            if s[i] == 0:
                p, q = _wave_interval(B[i], _LOAD, t, h, m)
                R[2 * m] += B[i, _STATIC] * p
                R[2 * m + 1] += B[i, _STATIC] * q


@njit(nogil=True, cache=True, error_model="numpy")
def _stick_root(z, w, B, F, s, k, start, x1, L, line, order, shift, left, right, f_left, R):
    """The time in [left, right] at which a distance (order 0) or its slope (1) is zero."""
    t = 0.5 * (left + right)
    size = right - left
    for i in range(200):
        _stick_line(z, w, B, F, s, k, start, x1, L, line, t, 0.0, R)
        f, slope = (R[0] + shift, R[2]) if order == 0 else (R[2], R[4])
        if f == 0:
            return t
        if (f > 0) == (f_left > 0):
            left = t
        else:
            right = t
        new = t - f / slope if slope != 0 else left - 1.0
        if not (left < new < right) or (i % 4 == 3 and right - left > 0.5 * size):
            new = 0.5 * (left + right)
        if i % 4 == 3:
            size = right - left
        if new == t or new == left or new == right:
            return t
        t = new
    return t


@njit(nogil=True, cache=True, error_model="numpy")
def _stick_root_beside(z, w, B, F, s, k, start, x1, L, line, right, R):
    """The root up to the time `right` of a distance that is zero at `start`.

    The distance itself is only rounding there. Its mean slope is not, and has the same root.
    """
    left, end, t = start, right, right
    for _ in range(60):
        mean = 0.0
        for i in range(_NODES.size):
            part = start + _NODES[i] * (t - start)
            _stick_line(z, w, B, F, s, k, start, x1, L, line, part, 0.0, R)
            mean += _WEIGHTS[i] * R[2]
        if mean > 0:
            left = t
        else:
            right = t
        # The mean is g / (t - start).
        _stick_line(z, w, B, F, s, k, start, x1, L, line, t, 0.0, R)
        new = t - (t - start) * mean / (R[2] - mean) if R[2] < mean else start
        if not (left < new < right):
            new = 0.5 * (left + right)
        if new == t or new == left or new == right:
            break
        t = new
    return min(max(t, start + 1e-11 * _blur(start)), end)


# ---------------------------------------------------------------- transitions


@njit(nogil=True, cache=True, error_model="numpy")
def _mates(B, i, k):
    """Whether two belts have the same velocity at all times."""
    if i == k:
        return True
    if B[i, 1] == 0 and B[k, 1] == 0:
        return B[i, 0] == B[k, 0]
    return B[i, 0] == B[k, 0] and B[i, 1] == B[k, 1] and B[i, 2] == B[k, 2] and B[i, 3] == B[k, 3]


@njit(nogil=True, cache=True, error_model="numpy")
def _faster(B, i, k, t):
    """1 where belt i is faster than belt k just after they had the same velocity, else -1."""
    size = 1e-13 * (1 + abs(B[i, 0]) + abs(B[i, 1]) + abs(B[k, 0]) + abs(B[k, 1]))
    for m in range(1, 4):
        d = _wave(B[i], 0, t, m) - _wave(B[k], 0, t, m)
        if abs(d) > size:
            return 1 if d > 0 else -1
    return 1


@njit(nogil=True, cache=True, error_model="numpy")
def _holds(z, w, B, F, s, k, t, x1, L, R):
    """Whether the belts with code 0, all as fast as belt k, hold the mass; returns (holds, distance
    from the other outcome)."""
    cap = 0.0
    for i in range(B.shape[0]):
        if s[i] == 0:
            cap += B[i, _STATIC] * _wave(B[i], _LOAD, t, 0)
    if not cap > 0:
        # Belts without load or static friction cannot hold the mass.
        _stick_line(z, w, B, F, s, k, t, x1, L, 2, t, 0.0, R)
        return False, abs(R[0])
    gap, held = np.inf, True
    for line in (2, 3):
        _stick_line(z, w, B, F, s, k, t, x1, L, line, t, 0.0, R)
        gap = min(gap, R[0])
        if abs(R[0]) > _ROUNDING * _blur(t) * (1 + abs(x1) + cap):
            held = held and R[0] > 0
            continue
        # At the limit: derivatives decide whether the distance grows.
        value, slope, curvature = R[0], R[2], R[4]
        if abs(slope) > 1e-12:
            held = held and slope > 0
        elif abs(curvature) > 1e-10:
            held = held and curvature > 0
        else:
            step = 1e-3
            _stick_line(z, w, B, F, s, k, t, x1, L, line, t + step, 0.0, R)
            held = held and R[0] >= value - 1e-13
    return held, abs(gap)


@njit(nogil=True, cache=True, error_model="numpy")
def _settle(z, w, B, F, t, x1, x2, s, zero, first, second, R):
    """Sets the codes of the belts in `zero`, which have r = 0; first, second: belts to try first.
    Returns (belt that the mass sticks to, or -1; distance from another outcome; x2' after)."""
    n = B.shape[0]
    L = np.array([-np.inf, np.inf])
    gap = np.inf
    for turn in range(2 + n):
        k = first if turn == 0 else second if turn == 1 else turn - 2
        if k < 0 or not zero[k] or (turn >= 2 and (k == first or k == second)):
            continue
        if turn == 1 and first >= 0 and zero[first] and _mates(B, first, k):
            continue
        for i in range(n):
            if zero[i]:
                s[i] = 0 if _mates(B, i, k) else _faster(B, i, k, t)
        held, d = _holds(z, w, B, F, s, k, t, x1, L, R)
        gap = min(gap, d)
        if held:
            return k, gap, _wave(B[k], 0, t, 1) / w
    # Slips. The belts faster than the mass afterwards are those whose velocity grows faster.
    order = np.zeros(n, np.int64)
    count = 0
    for i in range(n):
        if zero[i]:
            j = count
            while j > 0 and not _mates(B, i, order[j - 1]) and _faster(B, order[j - 1], i, t) > 0:
                order[j] = order[j - 1]
                j -= 1
            order[j] = i
            count += 1
    best, chosen, acceleration = np.inf, 0, 0.0
    for cut in range(count + 1):
        # Belts order[:cut] are slower than the mass.
        if 0 < cut < count and _mates(B, order[cut - 1], order[cut]):
            continue
        for j in range(count):
            s[order[j]] = -1 if j < cut else 1
        a = _force(z, w, B, F, s, t, x1, x2)
        wrong = 0.0
        if cut > 0:
            wrong = max(wrong, _wave(B[order[cut - 1]], 0, t, 1) - w * a)
        if cut < count:
            wrong = max(wrong, w * a - _wave(B[order[cut]], 0, t, 1))
        if wrong < best:
            best, chosen, acceleration = wrong, cut, a
    for j in range(count):
        s[order[j]] = -1 if j < chosen else 1
    return -1, gap, acceleration


@njit(nogil=True, cache=True, error_model="numpy")
def _at_zero(w, B, t, x2, s, k, zero):
    """The touching belts with r = 0, into `zero`; k: one of them, or -1."""
    for i in range(B.shape[0]):
        zero[i] = False
        if abs(s[i]) == 2:
            continue
        v = _wave(B[i], 0, t, 0)
        at = w * x2 if k < 0 else _wave(B[k], 0, t, 0)
        same = k >= 0 and _mates(B, i, k)
        zero[i] = same or abs(v - at) <= _SAME * _blur(t) * (abs(v) + abs(at) + abs(B[i, 1]))


@njit(nogil=True, cache=True, error_model="numpy")
def _touching(w, B, t, x1, x2, right, old, new):
    """The contacts at x1, into `new`; right: whether x1 on an edge counts as to the right of it."""
    for i in range(B.shape[0]):
        if x1 < B[i, _LOWER] or (x1 == B[i, _LOWER] and not right):
            new[i] = -2
        elif x1 > B[i, _UPPER] or (x1 == B[i, _UPPER] and right):
            new[i] = 2
        elif abs(old[i]) < 2:
            new[i] = old[i]
        else:
            new[i] = 1 if _wave(B[i], 0, t, 0) > w * x2 else -1


@njit(nogil=True, cache=True, error_model="numpy")
def _begin(z, w, B, F, t, x1, x2, s, zero, R):
    """The mode of a state, into s; returns (belt stuck to or -1, status, margin)."""
    n = B.shape[0]
    none = np.full(n, 9, np.int64)
    left, right = np.empty(n, np.int64), np.empty(n, np.int64)
    _touching(w, B, t, x1, x2, False, none, left)
    _touching(w, B, t, x1, x2, True, none, right)
    same = True
    for i in range(n):
        same = same and left[i] == right[i]
    if same or x2 != 0:
        for i in range(n):
            s[i] = right[i] if x2 > 0 or same else left[i]
        _at_zero(w, B, t, x2, s, -1, zero)
        stuck, gap, _ = _settle(z, w, B, F, t, x1, x2, s, zero, -1, -1, R)
        return stuck, OK, gap
    # At rest on an edge: the accelerations on the two sides decide.
    _at_zero(w, B, t, x2, left, -1, zero)
    stuck_l, gap_l, a_l = _settle(z, w, B, F, t, x1, x2, left, zero, -1, -1, R)
    _at_zero(w, B, t, x2, right, -1, zero)
    stuck_r, gap_r, a_r = _settle(z, w, B, F, t, x1, x2, right, zero, -1, -1, R)
    gap = min(min(gap_l, gap_r), min(abs(a_l), abs(a_r)))
    go_right = a_r > 0 or (a_r == 0 and stuck_r >= 0 and a_l >= 0)
    for i in range(n):
        s[i] = right[i] if go_right else left[i]
    stuck = stuck_r if go_right else stuck_l
    if a_l <= 0 <= a_r:
        gap = 0.0
    if a_l > 0 > a_r:
        return -1, PSEUDO_FOCUS, gap
    return stuck, OK, gap


@njit(nogil=True, cache=True, error_model="numpy")
def _edges(B, s, L):
    L[0], L[1] = -np.inf, np.inf
    for i in range(B.shape[0]):
        if s[i] == -2:
            L[1] = min(L[1], B[i, _LOWER])
        elif s[i] == 2:
            L[0] = max(L[0], B[i, _UPPER])
        else:
            L[0], L[1] = max(L[0], B[i, _LOWER]), min(L[1], B[i, _UPPER])


@njit(nogil=True, cache=True, error_model="numpy")
def _nearest(w, B, s, L, t, x1, x2):
    """Distance of a state from the lines of its mode that it is not on."""
    d = np.inf
    for j in range(2):
        g = abs(x1 - L[j])
        if g > 1e-13:
            d = min(d, g)
    for i in range(B.shape[0]):
        if abs(s[i]) == 1:
            g = abs(_wave(B[i], 0, t, 0) - w * x2)
            if g > 1e-13:
                d = min(d, g)
    return d


# ---------------------------------------------------------------- runs


@njit(nogil=True, cache=True, error_model="numpy")
def _stick_phase(z, w, B, F, s, k, start, x1, T, period, L, shifts, R, Q):
    """End of a stick phase: (line, or -1: none by T, -2: unknown; time; margin; is for ever)."""
    n = B.shape[0]
    lines = 4 + n
    margin = np.inf
    fastest = 1.0
    for i in range(n):
        fastest = max(fastest, max(B[i, 2], B[i, _LOAD + 2]))
    for j in range(F.shape[0]):
        fastest = max(fastest, F[j, 2])
    size = abs(x1) + 1.0
    for i in range(n):
        size += (abs(B[i, _LOAD]) + abs(B[i, _LOAD + 1])) * B[i, _STATIC]
    size *= _blur(T)
    touch = 0.1 * _ROUNDING * size
    rests = B[k, 0] == 0 and (B[k, 1] == 0 or B[k, 2] > 0)
    until = T
    if rests:
        ever = True
        for line in range(lines):
            if line < 4 or (abs(s[line - 4]) == 1):
                _stick_line(z, w, B, F, s, k, start, x1, L, line, start, _EVER, R)
                # On a belt at rest the mass does not move away from an edge that it is on.
                least = -touch if line in (2, 3) or B[k, 1] == 0 else touch
                ever = ever and R[0] >= least
                margin = min(margin, abs(R[0])) if line in (2, 3) else margin
        if ever:
            return -1, T, margin, True
        margin = np.inf
        if np.isfinite(period):
            until = max(T, start + period * (1 + 1e-12))
    for line in range(lines):
        shifts[line] = 0.0
        if line < 4 or abs(s[line - 4]) == 1:
            _stick_line(z, w, B, F, s, k, start, x1, L, line, start, 0.0, R)
            if abs(R[0]) <= _ROUNDING * size:
                shifts[line] = 2 * _ROUNDING * size
    t, h, rounds = start, 0.25 / fastest, 0
    while t < until:
        rounds += 1
        if rounds > _MOST_ROUNDS:
            return -1 if t >= T else -2, T, margin, False
        h = min(h, until - t)
        # One step ends at T exactly.
        if t < T < t + h:
            h = T - t
        hit, t_hit, unclear, closest = -1, np.inf, False, np.inf
        for line in range(lines):
            if line >= 4 and abs(s[line - 4]) != 1:
                continue
            if line < 2 and not np.isfinite(L[line]):
                continue
            _stick_line(z, w, B, F, s, k, start, x1, L, line, t, 0.0, R)
            g0, d0 = R[0] + shifts[line], R[2]
            if g0 <= 0:
                if t > start and g0 >= -touch and d0 >= -1e-6:
                    g0 = 1e-300  # it touches here
                else:
                    if t < t_hit:
                        hit, t_hit = line, t
                    continue
            _stick_line(z, w, B, F, s, k, start, x1, L, line, t + h, 0.0, R)
            g1, d1 = R[0] + shifts[line], R[2]
            _stick_line(z, w, B, F, s, k, start, x1, L, line, t, h, R)
            R[0] += shifts[line]
            if not (R[0] <= R[1] + shifts[line]) and h > _SHORTEST:
                unclear = True
                break
            found = _verdict(g0, g1, d0, d1, h, shifts[line], touch, R)
            if found == 3:
                unclear = True
                break
            end, f_left = t + h, g0
            if found == 2:
                end = _stick_root(z, w, B, F, s, k, start, x1, L, line, 1, 0.0, t, t + h, d0, Q)
                _stick_line(z, w, B, F, s, k, start, x1, L, line, end, 0.0, Q)
                if shifts[line] == 0:
                    closest = min(closest, abs(Q[0]))
                if Q[0] + shifts[line] >= -touch:
                    continue
            if found >= 1:
                root = _stick_root(
                    z, w, B, F, s, k, start, x1, L, line, 0, shifts[line], t, end, f_left, Q
                )
                if root < t_hit:
                    hit, t_hit = line, root
        if unclear:
            h *= 0.5
            continue
        if hit >= 0:
            if shifts[hit] > 0:
                t_hit = _stick_root_beside(z, w, B, F, s, k, start, x1, L, hit, t_hit, Q)
            return hit, t_hit, margin, False
        margin = min(margin, closest)
        t = until if h == until - t else T if h == T - t else t + h
        for line in range(lines):
            if shifts[line] > 0:
                _stick_line(z, w, B, F, s, k, start, x1, L, line, t, 0.0, R)
                if R[0] > shifts[line]:
                    shifts[line] = 0.0
        h = min(2 * h, _LONGEST / fastest)
    return -1, T, margin, rests and np.isfinite(period) and until >= start + period


@njit(nogil=True, cache=True, error_model="numpy")
def _run(z, w, B, F, period, x1, x2, given, t, T, tol, noise, seed, out):
    n = B.shape[0]
    s, old, before = given.copy(), given.copy(), given.copy()
    zero = np.zeros(n, np.bool_)
    L, box, R, Q = np.empty(2), np.empty(8), np.empty(6), np.empty(6)
    E = np.zeros((n + 1, 10))
    shifts = np.zeros(4 + n)
    V, K, V2, K2 = np.empty(_N + 1), np.empty(_N + 1), np.empty(_N + 1), np.empty(_N + 1)
    status, margin, count, steps, still = OK, np.inf, 0, 0, 0
    most = 1000 * (T - t) + 1_000_000
    random = np.uint64(2 * seed + 88172645463325253)
    stuck = -1
    if given[0] == 9:
        stuck, status, margin = _begin(z, w, B, F, t, x1, x2, s, zero, R)
    else:
        for i in range(n):
            if s[i] == 0 and stuck < 0:
                stuck = i
    if not (np.isfinite(x1) and np.isfinite(x2)):
        status = NOT_FINITE
    while t < T and status == OK:
        if count >= out.shape[0] - 2:
            status = BUDGET
            break
        if steps > most:
            status = STEPS
            break
        kind, belt, speed = 0, -1, 0.0
        t_before = t
        _edges(B, s, L)
        for i in range(n):
            before[i] = s[i]
        if stuck >= 0:
            # ---------------- a stick phase
            k = stuck
            line, end, gap, ever = _stick_phase(z, w, B, F, s, k, t, x1, T, period, L, shifts, R, Q)
            margin = min(margin, gap)
            if line == -2:
                status = STEPS
                break
            if line < 0 or end > T:
                margin = min(margin, end - T if end > T else np.inf)
                x1 += _travel(B[k], t, T) / w
                x2, t = _wave(B[k], 0, T, 0) / w, T
                status = STUCK_FOREVER if ever else OK
                break
            _stick_line(z, w, B, F, s, k, t, x1, L, line, end, 0.0, R)
            speed = abs(R[2])
            x1 += _travel(B[k], t, end) / w
            x2, t = _wave(B[k], 0, end, 0) / w, end
            for i in range(n):
                old[i] = s[i]
            if line in (2, 3):
                kind = SLIP
                for i in range(n):
                    if s[i] == 0:
                        belt = i if belt < 0 else belt
                        s[i] = 1 if line == 2 else -1
                stuck = -1
            elif line >= 4:
                met = line - 4
                _at_zero(w, B, t, x2, s, k, zero)
                for i in range(n):
                    zero[i] = zero[i] or (abs(s[i]) == 1 and _mates(B, i, met))
                stuck, gap, _ = _settle(z, w, B, F, t, x1, x2, s, zero, k, met, R)
                margin = min(margin, gap)
                if stuck < 0:
                    kind = SLIP
                elif s[k] == 0:
                    kind, belt = CROSS, met
                else:
                    kind = STICK
                for i in range(n - 1, -1, -1):
                    if (kind == SLIP and old[i] == 0) or (kind == STICK and s[i] == 0):
                        belt = i
                    if kind == CROSS and abs(old[i]) == 1 and _mates(B, i, met):
                        belt = i
            else:
                kind = EDGE
                x1 = L[line]
                _touching(w, B, t, x1, x2, line == 1, old, s)
                _at_zero(w, B, t, x2, s, k, zero)
                stuck, gap, _ = _settle(z, w, B, F, t, x1, x2, s, zero, k, -1, R)
                margin = min(margin, min(gap, abs(x2)))
        else:
            # ---------------- a slip arc
            a = _force(z, w, B, F, s, t, x1, x2)
            size = _blur(t) * (1 + abs(x1) + abs(x2))
            for line in range(2 + n):
                shifts[line] = 0.0
                if line >= 2 and abs(s[line - 2]) != 1:
                    continue
                g, d, _ = _slip_line(z, w, B, F, s, L, line, t, x1, x2, a)
                if abs(g) <= _ROUNDING * size:
                    shifts[line] = 2 * _ROUNDING * size
            h, begun = 0.02, t
            hit, h_hit, m1, m2 = -1, 0.0, 0.0, 0.0
            while t < T:
                steps += 1
                if steps > most:
                    break
                last = h >= T - t
                if last:
                    h = T - t
                y1, y2 = _advance(z, w, B, F, s, t, x1, x2, a, h, V, K)
                b = K[_N]
                error = _error(x1, x2, y1, y2, h, tol, V, K)
                if not (error <= 1.0) and h > 1e-13 * (1 + t):
                    h *= max(0.2, 0.9 * error ** (-0.125)) if np.isfinite(error) else 0.25
                    continue
                if not (abs(y1) + abs(y2) <= 1e9):
                    status = NOT_FINITE
                    break
                # Whether a line is near enough to need a closer look.
                near = False
                low2 = high2 = x2
                for j in range(_N + 1):
                    low2, high2 = min(low2, V[j]), max(high2, V[j])
                room = 0.5 * (high2 - low2) + _CLOSE
                low1 = x1 + min(0.0, h * (low2 - room)) - _CLOSE
                high1 = x1 + max(0.0, h * (high2 + room)) + _CLOSE
                near = low1 <= L[0] or high1 >= L[1]
                for i in range(n):
                    if abs(s[i]) == 1 and not near:
                        low, high = np.inf, -np.inf
                        for j in range(_N + 1):
                            c = _C[j] if j < _N else 1.0
                            g = s[i] * (_wave(B[i], 0, t + c * h, 0) - w * V[j])
                            low, high = min(low, g), max(high, g)
                        near = low - 0.5 * (high - low) <= _CLOSE
                unclear = False
                hit = -1
                if near:
                    good = _enclose(z, w, B, F, s, t, x1, x2, a, y1, y2, b, h, E, box)
                    if not good and h > _SHORTEST:
                        unclear = True
                    else:
                        if not good:
                            box[0::2], box[1::2] = -np.inf, np.inf
                        closest = np.inf
                        for line in range(2 + n):
                            if line < 2 and not np.isfinite(L[line]):
                                continue
                            if line >= 2 and abs(s[line - 2]) != 1:
                                continue
                            shift = shifts[line]
                            g0, d0, _ = _slip_line(z, w, B, F, s, L, line, t, x1, x2, a)
                            g1, d1, _ = _slip_line(z, w, B, F, s, L, line, t + h, y1, y2, b)
                            g0, g1 = g0 + shift, g1 + shift
                            if g0 <= 0:
                                hit, h_hit, m1, m2 = line, 0.0, x1, x2
                                break
                            _slip_bounds(w, s, L, line, E, box, R)
                            R[0] += shift
                            found = _verdict(g0, g1, d0, d1, h, shift, 0.0, R)
                            if found == 3:
                                unclear = True
                                break
                            right, f_right = h, g1
                            if found == 2:
                                right, p1, p2 = _slip_root(
                                    z, w, B, F, s, L, line, 1, 0.0, t, x1, x2, a, h, d0, d1, V2, K2
                                )
                                f_right, _, _ = _slip_line(
                                    z, w, B, F, s, L, line, t + right, p1, p2, K2[_N]
                                )
                                if shift == 0:
                                    closest = min(closest, abs(f_right))
                                f_right += shift
                                if f_right >= 0:
                                    continue
                            if found >= 1:
                                length, p1, p2 = _slip_root(
                                    z, w, B, F, s, L, line, 0, shift,
                                    t, x1, x2, a, right, g0, f_right, V2, K2,
                                )  # fmt: skip
                                if shift > 0 and t == begun:
                                    length, p1, p2 = _slip_root_beside(
                                        z, w, B, F, s, L, line, t, x1, x2, a, length, V2, K2
                                    )
                                if hit < 0 or length < h_hit:
                                    hit, h_hit, m1, m2 = line, length, p1, p2
                        if not unclear and hit < 0:
                            margin = min(margin, closest)
                if unclear:
                    h *= 0.5
                    continue
                if hit >= 0:
                    t, x1, x2 = t + h_hit, m1, m2
                    break
                t = T if last else t + h
                x1, x2, a = y1, y2, b
                for line in range(2 + n):
                    if shifts[line] > 0:
                        g, d, _ = _slip_line(z, w, B, F, s, L, line, t, x1, x2, a)
                        if g > shifts[line]:
                            shifts[line] = 0.0
                if noise > 0 and _nearest(w, B, s, L, t, x1, x2) > 100 * noise:
                    random ^= random << np.uint64(13)
                    random ^= random >> np.uint64(7)
                    random ^= random << np.uint64(17)
                    x1 += noise * (1 + abs(x1)) * h * (1.0 if random & np.uint64(1) else -1.0)
                    x2 += noise * (1 + abs(x2)) * h * (1.0 if random & np.uint64(2) else -1.0)
                    a = _force(z, w, B, F, s, t, x1, x2)
                h *= min(4.0, max(0.3, 0.9 * max(error, 1e-8) ** (-0.125)))
                h = min(h, _LONGEST)
            if hit < 0:
                continue
            # ---------------- what follows
            for i in range(n):
                old[i] = s[i]
            a = _force(z, w, B, F, s, t, x1, x2)
            _, d, _ = _slip_line(z, w, B, F, s, L, hit, t, x1, x2, a)
            speed = abs(d)
            if hit >= 2:
                k = hit - 2
                x2 = _wave(B[k], 0, t, 0) / w
                _at_zero(w, B, t, x2, s, k, zero)
                stuck, gap, _ = _settle(z, w, B, F, t, x1, x2, s, zero, k, -1, R)
                margin = min(margin, gap)
                kind = STICK if stuck >= 0 else CROSS
                same = True
                for i in range(n - 1, -1, -1):
                    if s[i] != old[i] and (kind == CROSS or s[i] == 0):
                        same, belt = False, i
                if same:
                    # The path only touched the line, up to rounding.
                    kind, margin = 0, 0.0
            else:
                x1 = L[hit]
                kind = EDGE
                _touching(w, B, t, x1, x2, hit == 1, old, s)
                _at_zero(w, B, t, x2, s, -1, zero)
                arrived = False
                for i in range(n):
                    # Belts that stay keep their sign unless one that arrives has r = 0, too.
                    arrived = arrived or (zero[i] and abs(old[i]) == 2)
                gap = np.inf
                if arrived:
                    stuck, gap, _ = _settle(z, w, B, F, t, x1, x2, s, zero, -1, -1, R)
                margin = min(margin, min(gap, abs(x2)))
                after = _force(z, w, B, F, s, t, x1, x2)
                inward = 1.0 if hit == 1 else -1.0
                if stuck < 0 and abs(x2) < 1e-7 and a * inward > 0 > after * inward:
                    # Loops around a point on an edge have become smaller than the rounding of x1.
                    status, x2 = PSEUDO_FOCUS, 0.0
        # ---------------- an event
        still = still + 1 if t == t_before else 0
        if still > 20:
            status = CORNER
        if kind == 0:
            continue
        if kind == EDGE:
            for i in range(n - 1, -1, -1):
                if (abs(before[i]) == 2) != (abs(s[i]) == 2):
                    belt = i
        _edges(B, s, L)
        margin = min(margin, _nearest(w, B, s, L, t, x1, x2))
        out[count, 0], out[count, 1], out[count, 2] = t, kind, belt
        out[count, 3], out[count, 4], out[count, 5] = x1, x2, speed
        for i in range(n):
            out[count, 6 + i] = s[i]
        count += 1
        if noise > 0:
            random ^= random << np.uint64(13)
            random ^= random >> np.uint64(7)
            random ^= random << np.uint64(17)
            move = noise * (1.0 if random & np.uint64(1) else -1.0)
            if _nearest(w, B, s, L, t, x1, x2) > 100 * noise:
                if kind == EDGE:
                    x2 += 0.0 if stuck >= 0 else move * (1 + abs(x2))
                elif kind == SLIP:
                    # In the direction of the slip, or the mass would stick again at once.
                    x1 += s[belt] * abs(move) * (1 + abs(x1))
                else:
                    x1 += move * (1 + abs(x1))
    if count > 0:
        margin = min(margin, abs(T - out[count - 1, 0]))
    if status == OK:
        _edges(B, s, L)
        margin = min(margin, _nearest(w, B, s, L, t, x1, x2))
    return count, t, x1, x2, status, margin, s, steps
