"""A fast and independent second code for belt-driven dry-friction oscillators, for campaigns.

A mass on a spring is dragged by belts, in scaled time

    x1' = x2
    x2' = -x1 - zeta x2 + sum over touching belts of  load mu(|r|) sgn(r),    r = nu - omega x2.

Nothing here comes from the package, neither code nor the way events are found. Slip arcs are
integrated by DOP853 at 1e-13. A step that may come near a boundary or an edge has to show, by
interval arithmetic over an enclosure of the whole step, that the distance to it is

- positive throughout, or
- monotone, or convex, or concave over the step,

or it is halved. Of a convex distance the smallest value is sought, so no excursion within a step is
missed and none is made up, however small. An event is found by shorter and shorter steps from the
beginning of its own step, so its state is as good as the integration.

What follows an event is decided by Filippov's set of forces at that very point: belts at the
mass's own velocity give anything up to their static limits, and if that can balance the rest of the
forces the mass sticks, else it is accelerated to one side. Belts that slipped before and go on
touching keep their sign. Stick phases are computed in closed form.

Contact codes, one for each belt: 1, -1 slips with that sign of r; 0 stuck; -2, 2 mass below, above
the interval. Kinds of events: 1 STICK, 2 SLIP, 3 CROSS, 4 EDGE; and, where asked for, 5 a zero of
x2 and 6 an extremum of x2.
"""

from dataclasses import dataclass, field, replace
from math import inf, nan

import numpy as np
from numba import njit
from scipy.integrate._ivp import dop853_coefficients as _dop853

STICK, SLIP, CROSS, EDGE, TURN, EXTREMUM = 1, 2, 3, 4, 5, 6
OK, STUCK_FOREVER, PSEUDO_FOCUS, NOT_FINITE = 0, 1, 2, 5
#: Statuses of the engine only: too many events, no progress in a corner, too many steps.
BUDGET, CORNER, STEPS = 100, 101, 102

_N = _dop853.N_STAGES
_A = np.ascontiguousarray(_dop853.A[:_N, :_N])
_B = np.ascontiguousarray(_dop853.B)
_E3 = np.ascontiguousarray(_dop853.E3)
_E5 = np.ascontiguousarray(_dop853.E5)

#: Longest step; shortest that is still halved.
_LONGEST, _SHORTEST = 0.5, 1e-10
#: Distances above this one need no closer look; below it the margin of a run is exact.
_CLOSE = 1e-6
#: Largest |x2| at an edge at which a run may end in a pseudo-focus, and largest relative error of
#: the rate at which its turns around the edge shrink.
_FOCUS_SPEED, _FOCUS_MATCH = 1e-2, 0.1
#: A turn with a smaller velocity is smaller than the rounding of x1.
_ROUNDING = 1e-7


# ---------------------------------------------------------------- problems

#: Speeds and coefficients of the law "table", with the unit 1.
TABLE = (
    (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 64.0, 256.0, 1024.0, 4096.0, 16384.0, 65536.0),
    (1.0, 0.93, 0.87, 0.8, 0.733, 0.68, 0.644, 0.6235, 0.606, 0.602, 0.6, 0.6, 0.6, 0.6),
)


def _hardy(speeds, coefficients):
    """Widths and weights of the multiquadrics through the points, and the level."""
    r, gaps = np.array(speeds), np.diff(speeds)
    n = len(r)
    widths = np.minimum(np.append(gaps[0], gaps), np.append(gaps, gaps[-1]))
    matrix = np.ones((n + 1, n + 1))
    matrix[:n, :n] = np.sqrt((r[:, None] - r[None]) ** 2 + widths[None] ** 2)
    matrix[n, n] = 0.0
    *weights, level = np.linalg.solve(matrix, np.append(coefficients, 0.0))
    return r, widths, np.array(weights), float(level)


_TABLE_R, _TABLE_H, _TABLE_W, _TABLE_LEVEL = _hardy(*TABLE)


@dataclass(frozen=True)
class Belt:
    """law: ("conti", mus, p1, p3, p2), ("coulomb", static, kinetic), ("stribeck", static, kinetic,
    velocity), ("peak", static, kinetic, velocity, viscous), or ("table", static, unit): the curve
    through the points `TABLE`, at unit times the speed."""

    velocity: float
    law: tuple
    load: float = 1.0
    lower: float = -inf
    upper: float = inf


@dataclass(frozen=True)
class Oscillator:
    damping: float
    belts: tuple
    omega: float = 1.0

    def table(self):
        """The belts as rows: velocity, load, lower, upper, static, form, c0, c1, c2, c3, c4.

        mu(r) = c0 f(c1 r) + c2 + c3 r^2 + c4 r with f(x) = 1/(1 + x) (form 0), exp(-x) (form 1),
        exp(-x^2) (form 2), or Hardy's curve through `TABLE` (form 3).
        """
        rows = []
        for b in self.belts:
            name, static, *p = b.law
            if name == "conti":
                p1, p3, p2 = (*p, 0.0) if len(p) == 2 else p
                law = (static, 0, static - p1, p3, p1, p2, 0.0)
            elif name == "coulomb":
                law = (static, 0, 0.0, 0.0, p[0], 0.0, 0.0)
            elif name == "stribeck":
                law = (static, 1, static - p[0], 1 / p[1], p[0], 0.0, 0.0)
            elif name == "peak":
                law = (static, 2, static - p[0], 1 / p[1], p[0], 0.0, p[2])
            else:
                law = (static, 3, 1.0, p[0], _TABLE_LEVEL, 0.0, 0.0)
            rows.append((b.velocity, b.load, b.lower, b.upper, *law))
        return np.array(rows, dtype=float)


@dataclass(frozen=True)
class Run:
    """events: rows (t, kind, belt, x1, x2, codes after it); margin: the smallest distance from
    another outcome that the run has met."""

    t: np.ndarray
    kind: np.ndarray
    belt: np.ndarray
    y: np.ndarray
    codes: np.ndarray
    t_end: float
    y_end: tuple
    mode_end: tuple
    status: int
    margin: float
    steps: int = field(default=0, repr=False)

    @property
    def sequence(self):
        return tuple(zip(self.kind.tolist(), self.belt.tolist()))


def simulate(
    osc,
    y0,
    T,
    *,
    tol=1e-13,
    noise=0.0,
    seed=0,
    mode=None,
    turns=False,
    extrema=False,
    capture=True,
    max_events=20_000,
    max_steps=1_000_000,
):
    """The run from y0 over [0, T].

    mode: contact codes to go on with, None: those of the state. noise: a tolerance, as rtol and
    atol; every step of length h is disturbed by noise (1 + |y|) h, the state after every event by
    noise (1 + |y|), at random. turns, extrema: record the zeros of x2 (belt 0: a maximum of x1, 1:
    a minimum), the extrema of x2. capture: whether to end, at rest, where a run converges to a
    pseudo-focus. max_steps: limit of steps, plus a thousand for each unit of time.
    """
    n = len(osc.belts)
    given = np.full(n, 9, np.int64) if mode is None else np.array(mode, np.int64)
    out = np.empty((max_events, 5 + n))
    flags = (1 if turns else 0) + (2 if extrema else 0) + (0 if capture else 4)
    count, t, x1, x2, status, margin, codes, steps = _run(
        osc.damping,
        osc.omega,
        osc.table(),
        float(y0[0]),
        float(y0[1]),
        given,
        float(T),
        tol,
        noise,
        seed,
        flags,
        max_steps,
        out,
    )
    rows = out[:count]
    return Run(
        rows[:, 0],
        rows[:, 1].astype(int),
        rows[:, 2].astype(int),
        rows[:, 3:5],
        rows[:, 5:].astype(int),
        t,
        (x1, x2),
        tuple(codes.tolist()),
        status,
        margin,
        steps,
    )


# ---------------------------------------------------------------- field


@njit(nogil=True, cache=True, error_model="numpy")
def _product(a, b, c, d):
    p, q, r, t = a * c, a * d, b * c, b * d
    return min(min(p, q), min(r, t)), max(max(p, q), max(r, t))


@njit(nogil=True, cache=True, error_model="numpy")
def _mu(row, r):
    x = row[7] * r
    f = 0.0
    if row[5] == 0:
        f = 1 / (1 + x)
    elif row[5] == 1:
        f = np.exp(-x)
    elif row[5] == 2:
        f = np.exp(-x * x)
    else:
        for i in range(_TABLE_R.size):
            f += _TABLE_W[i] * np.sqrt((x - _TABLE_R[i]) ** 2 + _TABLE_H[i] ** 2)
    return row[6] * f + row[8] + row[9] * r * r + row[10] * r


@njit(nogil=True, cache=True, error_model="numpy")
def _mu_slope(row, r):
    x = row[7] * r
    f = 0.0
    if row[5] == 0:
        f = -1 / (1 + x) ** 2
    elif row[5] == 1:
        f = -np.exp(-x)
    elif row[5] == 2:
        f = -2 * x * np.exp(-x * x)
    else:
        for i in range(_TABLE_R.size):
            away = x - _TABLE_R[i]
            f += _TABLE_W[i] * away / np.sqrt(away * away + _TABLE_H[i] ** 2)
    return row[6] * row[7] * f + 2 * row[9] * r + row[10]


@njit(nogil=True, cache=True, error_model="numpy")
def _law_interval(row, ra, rb):
    """Bounds of c0 f(c1 r), and of its slope, for ra <= r <= rb."""
    xa, xb = row[7] * ra, row[7] * rb
    if row[5] <= 1:  # monotone, and so is the slope
        f = (1 / (1 + xa), 1 / (1 + xb)) if row[5] == 0 else (np.exp(-xa), np.exp(-xb))
        g = (-f[0] * f[0], -f[1] * f[1]) if row[5] == 0 else (-f[0], -f[1])
        f_low, f_high, g_low, g_high = min(f), max(f), min(g), max(g)
    elif row[5] == 2:
        f_low, f_high = np.exp(-max(xa * xa, xb * xb)), np.exp(-min(xa * xa, xb * xb))
        if xa <= 0 <= xb:
            f_high = 1.0
        g = -2 * xa * np.exp(-xa * xa), -2 * xb * np.exp(-xb * xb)
        g_low, g_high = min(g), max(g)
        steepest = np.sqrt(0.5)
        if xa <= steepest <= xb:
            g_low = -np.sqrt(2.0) * np.exp(-0.5)
        if xa <= -steepest <= xb:
            g_high = np.sqrt(2.0) * np.exp(-0.5)
    else:
        f_low = f_high = g_low = g_high = 0.0
        for i in range(_TABLE_R.size):
            w, r, h = _TABLE_W[i], _TABLE_R[i], _TABLE_H[i]
            pa, pb = np.sqrt((xa - r) ** 2 + h * h), np.sqrt((xb - r) ** 2 + h * h)
            p, q = _product(w, w, h if xa <= r <= xb else min(pa, pb), max(pa, pb))
            f_low, f_high = f_low + p, f_high + q
            p, q = _product(w, w, (xa - r) / pa, (xb - r) / pb)
            g_low, g_high = g_low + p, g_high + q
    f_low, f_high = _product(row[6], row[6], f_low, f_high)
    slope = row[6] * row[7]
    g_low, g_high = _product(slope, slope, g_low, g_high)
    return f_low, f_high, g_low, g_high


@njit(nogil=True, cache=True, error_model="numpy")
def _force(z, w, B, s, x1, x2):
    """x2' in the mode s; stuck belts add nothing. NaN where a law is far beyond its boundary."""
    f = -x1 - z * x2
    for i in range(B.shape[0]):
        if s[i] == 1 or s[i] == -1:
            r = s[i] * (B[i, 0] - w * x2)
            if B[i, 7] * r < -0.25:
                return np.nan
            f += s[i] * B[i, 1] * _mu(B[i], r)
    return f


@njit(nogil=True, cache=True, error_model="numpy")
def _trace(z, w, B, s, x2):
    """d x2' / d x2 in the mode s."""
    f = -z
    for i in range(B.shape[0]):
        if s[i] == 1 or s[i] == -1:
            f -= w * B[i, 1] * _mu_slope(B[i], s[i] * (B[i, 0] - w * x2))
    return f


@njit(nogil=True, cache=True, error_model="numpy")
def _advance(z, w, B, s, x1, x2, a, h, V, K):
    """One step of DOP853; V, K: room for the stages' x2 and x2'."""
    V[0], K[0] = x2, a
    for i in range(1, _N):
        d1 = 0.0
        d2 = 0.0
        for j in range(i):
            d1 += _A[i, j] * V[j]
            d2 += _A[i, j] * K[j]
        V[i] = x2 + h * d2
        K[i] = _force(z, w, B, s, x1 + h * d1, V[i])
    d1 = 0.0
    d2 = 0.0
    for j in range(_N):
        d1 += _B[j] * V[j]
        d2 += _B[j] * K[j]
    y1, y2 = x1 + h * d1, x2 + h * d2
    V[_N], K[_N] = y2, _force(z, w, B, s, y1, y2)
    return y1, y2


@njit(nogil=True, cache=True, error_model="numpy")
def _jumps(w, B, s, V):
    """Whether the relative speed of a belt changes in a step by more than the scale of its law and
    the smallest speed allow: error estimates miss narrow layers between two stages."""
    low, high = V[0], V[0]
    for j in range(_N + 1):
        low, high = min(low, V[j]), max(high, V[j])
    for i in range(B.shape[0]):
        if (s[i] == 1 or s[i] == -1) and B[i, 7] > 0:
            nearest = min(s[i] * (B[i, 0] - w * low), s[i] * (B[i, 0] - w * high))
            if w * (high - low) > 0.5 / B[i, 7] + max(nearest, 0.0):
                return True
    return False


@njit(nogil=True, cache=True, error_model="numpy")
def _error(x1, x2, y1, y2, h, tol, V, K):
    """The error of the step over the tolerance, as Hairer, Norsett and Wanner combine it."""
    c1 = tol * (1 + max(abs(x1), abs(y1)))
    c2 = tol * (1 + max(abs(x2), abs(y2)))
    e51 = e52 = e31 = e32 = 0.0
    for j in range(_N + 1):
        e51 += _E5[j] * V[j]
        e52 += _E5[j] * K[j]
        e31 += _E3[j] * V[j]
        e32 += _E3[j] * K[j]
    e5 = (e51 / c1) ** 2 + (e52 / c2) ** 2
    e3 = (e31 / c1) ** 2 + (e32 / c2) ** 2
    if e5 == 0 and e3 == 0:
        return 0.0
    return abs(h) * e5 / np.sqrt((e5 + 0.01 * e3) * 2)


def mu(row, r):
    """The coefficient of friction of a row of `Oscillator.table` at a sliding speed r."""
    return float(_mu(row, float(r)))


# ---------------------------------------------------------------- enclosures


@njit(nogil=True, cache=True, error_model="numpy")
def _force_interval(z, w, B, s, l1, u1, l2, u2):
    """Bounds of x2' and of d x2'/d x2 over a box; NaN where a law is far beyond its boundary."""
    p, q = _product(-z, -z, l2, u2)
    low, high = p - u1, q - l1
    t_low, t_high = -z, -z
    for i in range(B.shape[0]):
        if s[i] != 1 and s[i] != -1:
            continue
        ra, rb = s[i] * (B[i, 0] - w * u2), s[i] * (B[i, 0] - w * l2)
        if ra > rb:
            ra, rb = rb, ra
        if B[i, 7] * ra < -0.25:
            return np.nan, np.nan, np.nan, np.nan
        f_low, f_high, g_low, g_high = _law_interval(B[i], ra, rb)
        q_high = max(ra * ra, rb * rb)
        q_low = 0.0 if ra <= 0 <= rb else min(ra * ra, rb * rb)
        p, q = _product(B[i, 9], B[i, 9], q_low, q_high)
        l_low, l_high = _product(B[i, 10], B[i, 10], ra, rb)
        p, q = p + f_low + B[i, 8] + l_low, q + f_high + B[i, 8] + l_high
        p, q = _product(s[i] * B[i, 1], s[i] * B[i, 1], p, q)
        low, high = low + p, high + q
        p, q = _product(2 * B[i, 9], 2 * B[i, 9], ra, rb)
        p, q = p + g_low + B[i, 10], q + g_high + B[i, 10]
        p, q = _product(-w * B[i, 1], -w * B[i, 1], p, q)
        t_low, t_high = t_low + p, t_high + q
    return low, high, t_low, t_high


@njit(nogil=True, cache=True, error_model="numpy")
def _enclose(z, w, B, s, x1, x2, a, y1, y2, b, h, box):
    """Bounds of x1, x2, x2', x2'' over the step, into `box`; False where none were found.

    A box encloses the step if Picard's iteration maps the box into itself.
    """
    room = 0.1 * abs(y2 - x2) + 0.05 * h * (abs(a) + abs(b)) + 1e-300
    l2, u2 = min(x2, y2) - room, max(x2, y2) + room
    found = False
    for _ in range(8):
        l1, u1 = x1 + min(0.0, h * l2), x1 + max(0.0, h * u2)
        low, high, t_low, t_high = _force_interval(z, w, B, s, l1, u1, l2, u2)
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
    l1, u1 = (
        max(x1 + min(0.0, h * l2), y1 - max(0.0, h * u2)),
        min(x1 + max(0.0, h * u2), y1 - min(0.0, h * l2)),
    )
    l1, u1 = min(l1, min(x1, y1)), max(u1, max(x1, y1))
    low, high, t_low, t_high = _force_interval(z, w, B, s, l1, u1, l2, u2)
    # x2'' = -x2 + (d x2'/d x2) x2'
    p, q = _product(t_low, t_high, low, high)
    j_low, j_high = p - u2, q - l2
    a_low = max(low, max(a + min(0.0, h * j_low), b - max(0.0, h * j_high)))
    a_high = min(high, min(a + max(0.0, h * j_high), b - min(0.0, h * j_low)))
    box[0], box[1], box[2], box[3] = l1, u1, l2, u2
    box[4], box[5] = min(a_low, min(a, b)), max(a_high, max(a, b))
    box[6], box[7] = j_low, j_high
    return True


# ---------------------------------------------------------------- roots within a step


@njit(nogil=True, cache=True, error_model="numpy")
def _root(z, w, B, s, x1, x2, a, what, level, left, right, f_left, f_right, V, K):
    """The step length in [left, right] at which a quantity takes the value `level`.

    what: 0 x1, 1 x2, 2 x2'. Newton's method, kept within the bracket by bisection. Returns the
    length and the state.
    """
    h = left + (right - left) * min(max(f_left / (f_left - f_right), 0.1), 0.9)
    y1, y2 = x1, x2
    size = right - left
    for i in range(100):
        y1, y2 = _advance(z, w, B, s, x1, x2, a, h, V, K)
        b = K[_N]
        if what == 0:
            f, slope = y1 - level, y2
        elif what == 1:
            f, slope = y2 - level, b
        else:
            f, slope = b, -y2 + _trace(z, w, B, s, y2) * b
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
def _look(z, w, B, s, x1, x2, a, y1, y2, b, h, axis, level, side, box, V, K):
    """Whether side (x_axis - level), positive at first, is negative within the step.

    Returns (verdict, length, x1, x2, distance). verdict: 0 no, 1 yes, first at that step length, 2
    undecided. distance: from the line to the path's turning point within the step, on either side.
    """
    if axis == 0:
        g0, g1, d0, d1 = side * (x1 - level), side * (y1 - level), side * x2, side * y2
        low = box[0] - level if side > 0 else level - box[1]
        rising, falling = (
            side * box[2] >= 0 and side * box[3] >= 0,
            side * box[2] <= 0 and side * box[3] <= 0,
        )
        c_low, c_high = box[4], box[5]
    else:
        g0, g1, d0, d1 = side * (x2 - level), side * (y2 - level), side * a, side * b
        low = box[2] - level if side > 0 else level - box[3]
        rising, falling = (
            side * box[4] >= 0 and side * box[5] >= 0,
            side * box[4] <= 0 and side * box[5] <= 0,
        )
        c_low, c_high = box[6], box[7]
    if low > _CLOSE:
        return 0, 0.0, 0.0, 0.0, np.inf
    nearest = np.inf
    if rising and g1 >= 0:
        return 0, 0.0, 0.0, 0.0, nearest
    if side < 0:
        c_low, c_high = -c_high, -c_low
    convex, concave = c_low >= 0, c_high <= 0
    if not (rising or falling or convex or concave) and h > _SHORTEST:
        return 2, 0.0, 0.0, 0.0, nearest
    if g1 >= 0:
        if not convex or not (d0 < 0 < d1) or g0 == 0:
            return 0, 0.0, 0.0, 0.0, nearest
        # Convex: down and up again. How far down?
        if axis == 0:
            t, m1, m2 = _root(z, w, B, s, x1, x2, a, 1, 0.0, 0.0, h, x2, y2, V, K)
            g = side * (m1 - level)
        else:
            t, m1, m2 = _root(z, w, B, s, x1, x2, a, 2, 0.0, 0.0, h, a, b, V, K)
            g = side * (m2 - level)
        nearest = abs(g)
        if g >= 0:
            return 0, 0.0, 0.0, 0.0, nearest
        right, f_right = t, side * g
    else:
        right, f_right = h, side * g1
    left, f_left = 0.0, side * g0
    if g0 <= 0:
        # The step began on the line: look for a length at which it is on the positive side.
        left = 0.5 * right
        for _ in range(60):
            m1, m2 = _advance(z, w, B, s, x1, x2, a, left, V, K)
            g = side * ((m1 if axis == 0 else m2) - level)
            if g > 0:
                f_left = side * g
                break
            right, f_right = left, side * g
            left *= 0.5
        else:
            return 1, 0.0, x1, x2, 0.0
        if f_right == 0:
            return 1, right, m1, m2, nearest
    t, m1, m2 = _root(z, w, B, s, x1, x2, a, axis, level, left, right, f_left, f_right, V, K)
    return 1, t, m1, m2, nearest


# ---------------------------------------------------------------- transitions


@njit(nogil=True, cache=True, error_model="numpy")
def _contacts(w, B, x1, x2, on, right, old, new):
    """The contacts at a point, into `new`: 0 where a touching belt runs at the velocity `on`.

    right: whether an x1 on an edge counts as to the right of it. A belt that slipped and goes on
    touching keeps its sign.
    """
    for i in range(B.shape[0]):
        if x1 < B[i, 2] or (x1 == B[i, 2] and not right):
            new[i] = -2
        elif x1 > B[i, 3] or (x1 == B[i, 3] and right):
            new[i] = 2
        elif B[i, 0] == on:
            new[i] = 0
        elif old[i] == 1 or old[i] == -1:
            new[i] = old[i]
        else:
            new[i] = 1 if B[i, 0] > w * x2 else -1


@njit(nogil=True, cache=True, error_model="numpy")
def _balance(z, w, B, s, x1, x2):
    """Decides whether the mass sticks to the belts with code 0; if not, sets these codes in s to a
    slip. Returns (sticks, distance from the other outcome, sign of x2' after)."""
    held = 0.0
    any_zero = False
    for i in range(B.shape[0]):
        if s[i] == 0:
            any_zero = True
            held += B[i, 1] * B[i, 4]
    rest = _force(z, w, B, s, x1, x2)
    if not any_zero:
        return False, np.inf, np.sign(rest)
    if abs(rest) <= held and held > 0:
        return True, held - abs(rest), 0.0
    # Belts without force cannot hold the mass; where no force acts, either, x2'' = -x2 decides.
    onward = np.sign(rest) if rest != 0 else -np.sign(x2)
    for i in range(B.shape[0]):
        if s[i] == 0:
            s[i] = -1 if onward > 0 else 1
    return False, abs(rest) - held, onward


@njit(nogil=True, cache=True, error_model="numpy")
def _velocity_at(w, B, x1, x2):
    """Velocity of a belt that may touch at x1 and is as fast as the mass, else NaN."""
    for i in range(B.shape[0]):
        v = B[i, 0]
        if B[i, 2] <= x1 <= B[i, 3] and (x2 == v / w or abs(v - w * x2) <= 4e-16 * abs(v)):
            return v
    return np.nan


@njit(nogil=True, cache=True, error_model="numpy")
def _begin(z, w, B, x1, x2, s):
    """The mode of a state, into s; returns (stuck, status, distance from another mode)."""
    n = B.shape[0]
    on = _velocity_at(w, B, x1, x2)
    none = np.full(n, 9, np.int64)
    if x2 != 0:
        _contacts(w, B, x1, x2, on, x2 > 0, none, s)
        stuck, gap, _ = _balance(z, w, B, s, x1, x2)
        return stuck, OK, gap
    left, right = np.empty(n, np.int64), np.empty(n, np.int64)
    _contacts(w, B, x1, x2, on, False, none, left)
    _contacts(w, B, x1, x2, on, True, none, right)
    same = True
    for i in range(n):
        same = same and left[i] == right[i]
    stuck_l, gap_l, a_l = _balance(z, w, B, left, x1, x2)
    stuck_r, gap_r, a_r = _balance(z, w, B, right, x1, x2)
    gap = min(gap_l, gap_r)
    if not same:
        if a_l <= 0 <= a_r:  # both ways are solutions
            gap = 0.0
        for side in (left, right):
            gap = min(gap, abs(_force(z, w, B, side, x1, x2)))
    go_right = a_r > 0
    for i in range(n):
        s[i] = right[i] if go_right else left[i]
    stuck = stuck_r if go_right else stuck_l
    if not same and a_l > 0 and a_r <= 0:
        # The mass is pushed to the edge from both sides, or held on its right-hand side.
        if stuck_r:
            for i in range(n):
                s[i] = right[i]
            return True, OK, 0.0
        return False, PSEUDO_FOCUS, gap
    return stuck, OK, gap


@njit(nogil=True, cache=True, error_model="numpy")
def _bounds(w, B, s, L):
    """The box of a slip mode, into L: left, right, lower and upper bound."""
    L[0], L[1], L[2], L[3] = -np.inf, np.inf, -np.inf, np.inf
    for i in range(B.shape[0]):
        if s[i] == -2:
            L[1] = min(L[1], B[i, 2])
        elif s[i] == 2:
            L[0] = max(L[0], B[i, 3])
        else:
            L[0], L[1] = max(L[0], B[i, 2]), min(L[1], B[i, 3])
            if s[i] == 1:
                L[3] = min(L[3], B[i, 0] / w)
            elif s[i] == -1:
                L[2] = max(L[2], B[i, 0] / w)


@njit(nogil=True, cache=True, error_model="numpy")
def _nearest(L, x1, x2):
    """Distance of a state from the lines that it is not on."""
    d = np.inf
    for i in range(4):
        g = abs((x1 if i < 2 else x2) - L[i])
        if g > 0:
            d = min(d, g)
    return d


@njit(nogil=True, cache=True, error_model="numpy")
def _contraction(z, w, B, left, right, edge):
    """Returns (rate, least): a loop around the rest on an edge multiplies x2 by 1 + rate |x2|.

    This is to leading order. least: smallest speed of a touching belt; turns must be far slower.
    """
    a_l, a_r = _force(z, w, B, left, edge, 0.0), _force(z, w, B, right, edge, 0.0)
    least = np.inf
    for i in range(B.shape[0]):
        if (abs(left[i]) < 2 or abs(right[i]) < 2) and B[i, 1] * B[i, 4] > 0:
            least = min(least, abs(B[i, 0]) / w)
    s = _trace(z, w, B, left, 0.0) / a_l - _trace(z, w, B, right, 0.0) / a_r
    return 2 / 3 * s, least


# ---------------------------------------------------------------- runs


@njit(nogil=True, cache=True, error_model="numpy")
def _run(z, w, B, x1, x2, given, T, tol, noise, seed, flags, max_steps, out):
    n = B.shape[0]
    turns, extrema, capture = flags % 2 == 1, flags // 2 % 2 == 1, flags < 4
    s, old = given.copy(), given.copy()
    before, L, box = given.copy(), np.empty(4), np.empty(8)
    V, K, V2, K2 = np.empty(_N + 1), np.empty(_N + 1), np.empty(_N + 1), np.empty(_N + 1)
    t, status, margin, count, steps, still = 0.0, OK, np.inf, 0, 0, 0
    random = np.uint64(2 * seed + 88172645463325253)
    passed_edge, speed_right, speed_left = np.nan, np.inf, np.inf
    stuck = False
    if given[0] == 9:
        stuck, status, margin = _begin(z, w, B, x1, x2, s)
        on = _velocity_at(w, B, x1, x2)
        if stuck:
            x2 = on / w
        else:
            margin = min(margin, max(abs(x2), abs(_force(z, w, B, s, x1, x2))))
    else:
        for i in range(n):
            stuck = stuck or s[i] == 0
    if not (np.isfinite(x1) and np.isfinite(x2)):
        status = NOT_FINITE
    while t < T and status == OK:
        if count >= out.shape[0] - 2:
            status = BUDGET
            break
        if steps > 1000 * T + max_steps:
            status = STEPS
            break
        kind = 0
        t_before = t
        _bounds(w, B, s, L)
        for i in range(n):
            before[i] = s[i]
        if stuck:
            # ---------------- a stick phase
            on, held = 0.0, 0.0
            for i in range(n):
                if s[i] == 0:
                    on = B[i, 0]
                    held += B[i, 1] * B[i, 4]
            if on == 0:
                status = STUCK_FOREVER
                break
            ahead = 1.0 if on > 0 else -1.0
            end = _force(z, w, B, s, 0.0, x2) + ahead * held
            edge = L[1] if on > 0 else L[0]
            margin = min(margin, abs(edge - end))
            # At the limit of static friction the mass still sticks: an edge at that x1 comes first.
            is_slip = ahead * (edge - end) > 1e-15 * (held + abs(end))
            if not is_slip:
                end = edge
            duration = max((end - x1) / x2, 0.0)
            if t + duration >= T:
                margin = min(margin, t + duration - T)
                x1, t = x1 + x2 * (T - t), T
                break
            t, x1 = t + duration, end
            if is_slip:
                kind, belt = SLIP, -1
                for i in range(n):
                    if s[i] == 0:
                        belt = i if belt < 0 else belt
                        s[i] = 1 if on > 0 else -1
                stuck = False
            else:
                kind = EDGE
                for i in range(n):
                    old[i] = s[i]
                _contacts(w, B, x1, x2, on, on > 0, old, s)
                stuck, gap, _ = _balance(z, w, B, s, x1, x2)
                margin = min(margin, gap)
            passed_edge = np.nan
        else:
            # ---------------- a slip arc
            a = _force(z, w, B, s, x1, x2)
            if abs(x2) + abs(a) < (
                1e-14 if turns else 1e-300
            ):  # at rest; for labels up to rounding
                t = T
                break
            if turns:
                if x2 > 0 or (x2 == 0 and a > 0):
                    L[2] = max(L[2], 0.0)
                else:
                    L[3] = min(L[3], 0.0)
            h = 0.02
            hit, h_hit, m1, m2 = -1, 0.0, 0.0, 0.0
            while t < T:
                steps += 1
                if steps > 1000 * T + max_steps:
                    break
                last = h >= T - t
                if last:
                    h = T - t
                y1, y2 = _advance(z, w, B, s, x1, x2, a, h, V, K)
                b = K[_N]
                error = _error(x1, x2, y1, y2, h, tol, V, K)
                if not (error <= 1.0) and h > 1e-14:
                    h *= max(0.2, 0.9 * error ** (-0.125)) if np.isfinite(error) else 0.25
                    continue
                if abs(y1) + abs(y2) > 1e9:
                    status = NOT_FINITE
                    break
                if _jumps(w, B, s, V) and h > _SHORTEST:
                    h *= 0.5
                    continue
                # Whether a line is near enough to need a closer look.
                low2 = high2 = x2
                for j in range(_N + 1):
                    low2, high2 = min(low2, V[j]), max(high2, V[j])
                room = 0.5 * (high2 - low2) + _CLOSE
                low2, high2 = low2 - room, high2 + room
                low1, high1 = x1 + min(0.0, h * low2) - _CLOSE, x1 + max(0.0, h * high2) + _CLOSE
                near = low1 <= L[0] or high1 >= L[1] or low2 <= L[2] or high2 >= L[3]
                unclear = False
                hit = -1
                if near:
                    good = _enclose(z, w, B, s, x1, x2, a, y1, y2, b, h, box)
                    if not good and h > _SHORTEST:
                        unclear = True
                    else:
                        if not good:
                            box[0::2], box[1::2] = -np.inf, np.inf
                        closest = np.inf
                        for g in range(4):
                            if not np.isfinite(L[g]):
                                continue
                            side = 1.0 if g % 2 == 0 else -1.0
                            verdict, length, p1, p2, d = _look(
                                z, w, B, s, x1, x2, a, y1, y2, b, h, g // 2, L[g], side, box, V2, K2
                            )
                            if verdict == 2:
                                unclear = True
                                break
                            if verdict == 1 and (hit < 0 or length < h_hit):
                                hit, h_hit, m1, m2 = g, length, p1, p2
                            if verdict == 0 and not (g >= 2 and L[g] == 0 and turns):
                                closest = min(closest, d)
                        if not unclear and hit < 0:
                            margin = min(margin, closest)
                if unclear:
                    h *= 0.5
                    continue
                if extrema and a * (b if hit < 0 else _force(z, w, B, s, m1, m2)) < 0:
                    right = h if hit < 0 else h_hit
                    f = b if hit < 0 else _force(z, w, B, s, m1, m2)
                    length, p1, p2 = _root(z, w, B, s, x1, x2, a, 2, 0.0, 0.0, right, a, f, V2, K2)
                    out[count, 0], out[count, 1], out[count, 2] = t + length, EXTREMUM, -1
                    out[count, 3], out[count, 4] = p1, p2
                    for i in range(n):
                        out[count, 5 + i] = s[i]
                    count += 1
                if hit >= 0:
                    t, x1, x2 = t + h_hit, m1, m2
                    break
                t = T if last else t + h
                x1, x2, a = y1, y2, b
                if noise > 0 and _nearest(L, x1, x2) > 100 * noise:
                    random ^= random << np.uint64(13)
                    random ^= random >> np.uint64(7)
                    random ^= random << np.uint64(17)
                    x1 += noise * (1 + abs(x1)) * h * (1.0 if random & np.uint64(1) else -1.0)
                    x2 += noise * (1 + abs(x2)) * h * (1.0 if random & np.uint64(2) else -1.0)
                    a = _force(z, w, B, s, x1, x2)
                h *= min(4.0, max(0.3, 0.9 * max(error, 1e-8) ** (-0.125)))
                h = min(h, _LONGEST)
                if count >= out.shape[0] - 2:
                    break
            if hit < 0:
                continue
            # ---------------- what follows
            on, belt = np.nan, -1
            for i in range(n):
                old[i] = s[i]
            if hit >= 2:
                x2 = L[hit]
                for i in range(n):
                    sign = 1 if hit == 3 else -1
                    if s[i] == sign and B[i, 0] / w == x2 and belt < 0:
                        on, belt = B[i, 0], i
                if belt < 0:
                    kind, belt = TURN, 0 if hit == 2 else 1
                else:
                    # The side of an edge does not matter, because x1 is on no edge.
                    _contacts(w, B, x1, x2, on, x2 > 0, old, s)
                    stuck, gap, _ = _balance(z, w, B, s, x1, x2)
                    margin = min(margin, gap)
                    if not stuck and t == t_before and gap < 1e-12:
                        # Met again at once: needed is the limit up to rounding; the mass sticks.
                        _contacts(w, B, x1, x2, on, x2 > 0, old, s)
                        stuck = True
                    kind = STICK if stuck else CROSS
                if stuck or x2 != 0:
                    passed_edge = np.nan
            else:
                x1 = L[hit]
                kind = EDGE
                rightward = hit == 1
                a = _force(z, w, B, s, x1, x2)
                _contacts(w, B, x1, x2, np.nan, rightward, old, s)
                arrived = _velocity_at(w, B, x1, x2)
                fresh = False
                for i in range(n):
                    if abs(old[i]) == 2 and abs(s[i]) < 2 and B[i, 0] == arrived:
                        fresh = True
                if fresh:
                    _contacts(w, B, x1, x2, arrived, rightward, old, s)
                stuck, gap, _ = _balance(z, w, B, s, x1, x2)
                margin = min(margin, min(gap, abs(x2)))
                d = 1.0 if rightward else -1.0
                speed = speed_right if rightward else speed_left
                if passed_edge != x1:
                    speed, speed_left, speed_right = np.inf, np.inf, np.inf
                passed_edge = x1
                if rightward:
                    speed_right = abs(x2)
                else:
                    speed_left = abs(x2)
                after = _force(z, w, B, s, x1, x2)
                if capture and not stuck and a * d > 0 > after * d and abs(x2) < _FOCUS_SPEED:
                    if rightward:
                        rate, least = _contraction(z, w, B, old, s, x1)
                    else:
                        rate, least = _contraction(z, w, B, s, old, x1)
                    small = abs(x2) < speed < min(np.inf, 0.5 * least)
                    shrunk = (abs(x2) - speed) / (speed * speed)
                    if abs(x2) < _ROUNDING or (
                        small and abs(shrunk - rate) <= -_FOCUS_MATCH * rate
                    ):
                        status = PSEUDO_FOCUS
                        x2 = 0.0
        # ---------------- an event
        if kind == 0:
            continue
        if kind == EDGE:
            belt = -1
            for i in range(n):
                if (abs(before[i]) == 2) != (abs(s[i]) == 2) and belt < 0:
                    belt = i
        if kind != TURN:
            margin = min(margin, _nearest(L, x1, x2))
        out[count, 0], out[count, 1], out[count, 2] = t, kind, belt
        out[count, 3], out[count, 4] = x1, x2
        for i in range(n):
            out[count, 5 + i] = s[i]
        count += 1
        still = still + 1 if t == t_before else 0
        if still > 20:
            # Turns around a point on an edge that are smaller than rounding end there, too.
            status = PSEUDO_FOCUS if kind == EDGE and abs(x2) < _ROUNDING else CORNER
            x2 = 0.0 if status == PSEUDO_FOCUS else x2
        if noise > 0:
            random ^= random << np.uint64(13)
            random ^= random >> np.uint64(7)
            random ^= random << np.uint64(17)
            shift = noise * (1.0 if random & np.uint64(1) else -1.0)
            _bounds(w, B, s, L)
            if _nearest(L, x1, x2) > 100 * noise:
                if kind == EDGE:
                    x2 += 0.0 if stuck else shift * (1 + abs(x2))
                elif kind != TURN:
                    x1 += shift * (1 + abs(x1))
    if status == OK or status == STUCK_FOREVER:
        _bounds(w, B, s, L)
        margin = min(margin, _nearest(L, x1, x2) if not stuck else np.inf)
    return count, t, x1, x2, status, margin, s, steps


@njit(nogil=True, cache=True, error_model="numpy")
def _flow(z, w, B, s, x1, x2, duration, steps):
    V, K = np.empty(_N + 1), np.empty(_N + 1)
    h = duration / steps
    for _ in range(steps):
        x1, x2 = _advance(z, w, B, s, x1, x2, _force(z, w, B, s, x1, x2), h, V, K)
    return x1, x2


def flow(osc, mode, y, duration, step=0.01):
    """The state after a duration, which may be negative, in the field of a slip mode; events are
    ignored. NaN where the field ends."""
    if not np.all(np.isfinite([*y, step])):
        return np.nan, np.nan
    steps = max(1, round(abs(duration) / step))
    mode = np.array(mode, np.int64)
    return _flow(osc.damping, osc.omega, osc.table(), mode, *map(float, y), duration, steps)


def force(osc, mode, x1, x2):
    """x2' in the field of a slip mode."""
    mode = np.array(mode, np.int64)
    return _force(osc.damping, osc.omega, osc.table(), mode, float(x1), float(x2))


# ---------------------------------------------------------------- attractors


@dataclass(frozen=True)
class Attractor:
    """kind: "equilibrium", "cycle", "stuck" or "undecided"; loop: events (kind, belt) of one
    period, rotated so that their sequence is smallest; sticks: time stuck to each belt in one
    period; y: a state on it, of a cycle a maximum of x1."""

    kind: str
    period: float = nan
    loop: tuple = ()
    x1: tuple = (nan, nan)
    x2: tuple = (nan, nan)
    sticks: tuple = ()
    margin: float = inf
    status: int = OK
    y: tuple = (nan, nan)


def attractor(osc, y0, *, chunk=100.0, t_max=200_000.0, same=1e-9, at_rest=1e-6, periods=24):
    """The attractor of a run, which is continued in longer and longer pieces.

    It is a cycle where all of the maxima of x1 in the second half of a piece repeat, as whole
    states, to `same`; an equilibrium where the motion has shrunk below `at_rest` and does shrink.
    """
    x1, x2, mode, margin, t = *y0, None, inf, 0.0
    size, patience = inf, 4
    while t < t_max:
        run = simulate(
            osc, (x1, x2), chunk, mode=mode, turns=True, extrema=True, max_events=200_000
        )
        (x1, x2), mode = run.y_end, run.mode_end
        margin = min(margin, run.margin) if t == 0 else margin
        t += run.t_end
        if run.status == STUCK_FOREVER:
            return Attractor("stuck", x1=(x1, x1), x2=(0.0, 0.0), margin=margin)
        if run.status == PSEUDO_FOCUS:
            return Attractor("equilibrium", x1=(x1, x1), x2=(0.0, 0.0), margin=margin)
        if run.status not in (OK, BUDGET):
            return Attractor("undecided", margin=margin, status=run.status)
        crossed_at_rest = (run.kind == CROSS) & (run.y[:, 1] == 0)
        downward = np.array(
            [
                any(osc.belts[k].velocity == 0 and c == 1 for k, c in enumerate(codes))
                for codes in run.codes
            ],
            bool,
        )
        tops = np.flatnonzero((run.kind == TURN) & (run.belt == 0) | crossed_at_rest & downward)
        last = run.t > run.t_end - 30.0
        seen = run.y[last] if np.any(last) else np.array([[x1, x2]])
        old, size = size, float(np.max(np.ptp(np.vstack([seen, [x1, x2]]), axis=0)))
        if size < at_rest and (size <= 0.999 * old or size < 1e-12) and abs(x2) < at_rest:
            return Attractor("equilibrium", x1=(x1, x1), x2=(0.0, 0.0), margin=margin)
        found = _repeats(run, tops, same, periods) if t > run.t_end else None
        if found:
            cycle = _cycle(osc, run, *found)
            if max(np.ptp(cycle.x1), np.ptp(cycle.x2)) > at_rest:
                return replace(cycle, margin=min(margin, run.margin))
        if run.status == BUDGET:
            patience -= 1
            if patience == 0:
                return Attractor("undecided", margin=margin, status=BUDGET)
        elif chunk < 1600.0 or len(tops) < 32:
            chunk *= 2
    return Attractor("undecided", margin=margin)


def _repeats(run, tops, same, periods):
    """First and last event of one period, a range of `run`, if the tops repeat; else None."""
    y, codes = run.y[tops], run.codes[tops]
    half = len(tops) // 2

    def alike(lag):
        close = np.abs(y[half:] - y[half - lag : -lag]) <= same
        return np.all(close) and np.array_equal(codes[half:], codes[half - lag : -lag])

    def extent(p, before):
        """Widths in x1 and x2 of the loop of p tops that ends `before` tops before the last."""
        last = len(tops) - 1 - before
        return np.ptp(run.y[tops[last - p] : tops[last] + 1], axis=0)

    for p in range(1, min(periods, half // 4) + 1):
        if alike(p):
            # Creep shows over as many periods as there are. Extents are compared, too: the tops of
            # loops around an edge that pushes hard hardly show that the loops shrink.
            far = half // p * p
            is_cycle = alike(far) and np.all(np.abs(extent(p, 0) - extent(p, far)) <= same)
            return (tops[-1 - p], tops[-1]) if is_cycle else None
    return None


def _cycle(osc, run, first, last):
    rows = slice(first, last + 1)
    t, y, codes = run.t[rows], run.y[rows], run.codes[rows]
    stuck = np.where(codes[:-1] == 0, np.diff(t)[:, None], 0.0).sum(axis=0)
    turn = [(int(k), int(b)) for k, b in zip(run.kind[rows][1:], run.belt[rows][1:]) if k <= EDGE]
    turn = min((turn[i:] + turn[:i] for i in range(len(turn))), default=[])
    return Attractor(
        "cycle",
        float(t[-1] - t[0]),
        tuple(turn),
        (float(y[:, 0].min()), float(y[:, 0].max())),
        (float(y[:, 1].min()), float(y[:, 1].max())),
        tuple(stuck.tolist()),
        y=tuple(y[-1].tolist()),
    )
