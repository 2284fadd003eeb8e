"""Orbits that nearly graze a boundary or a contact edge, at signed distances that are known.

Each is made backwards: from an extremum of x2 (or x1) at the distance d beyond the boundary (edge),
d < 0 before it, the motion is followed back in time to the start, in the field of its mode. So it
is known without any search for events what happens on the way forwards:

    missed  d < 0: nothing
    sticks  d > 0: STICK, and SLIP soon after, since the limit of sticking is where x2' = 0
    holds   the same where the static limit exceeds the kinetic one: stuck until the end
    passes  d > 0: EDGE, where the belts beyond the edge push on in the direction of the motion
    returns d > 0: EDGE, and EDGE back

Integrations are those of SciPy's eighth-order scheme, with small fixed steps, for all cases at
once. They work for complex numbers too, so that derivatives are exact: the imaginary part of the
final state over a tiny imaginary part of the start or of a parameter.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate._ivp import dop853_coefficients

_STAGES = dop853_coefficients.N_STAGES
_A, _B = dop853_coefficients.A[:_STAGES, :_STAGES], dop853_coefficients.B
#: End of the runs that graze a boundary, and of those that graze an edge.
SPAN, SPAN_AT_EDGE = 1.6, 0.8
#: Deviations grow no more than this up to the extremum, or distances would be lost in rounding.
GROWTH = 10.0
#: Steps in a piece of an orbit.
STEPS = 96
BELOW, ABOVE = -2, 2
STICK, SLIP, CROSS, EDGE = range(1, 5)


@dataclass
class Oscillators:
    """Two belts each, arrays [belts, cases]; friction residual + drop / (1 + steepness r)."""

    damping: np.ndarray
    omega: np.ndarray
    velocity: np.ndarray
    load: np.ndarray
    static: np.ndarray
    residual: np.ndarray
    drop: np.ndarray
    steepness: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def take(self, where) -> "Oscillators":
        return Oscillators(*(leaf[..., where] for leaf in vars(self).values()))

    def acceleration(self, codes, x1, x2):
        """x2' in the mode with these contact codes, [belts, cases]."""
        total = -x1 - self.damping * x2
        for i, code in enumerate(codes):
            sign = np.where(np.abs(code) == 1, code, 0)
            r = sign * (self.velocity[i] - self.omega * x2)
            law = self.residual[i] + self.drop[i] / (1 + self.steepness[i] * r)
            total = total + sign * self.load[i] * law
        return total

    def boundary(self, codes, x2):
        """s_i r_i of every belt, inf where it does not touch."""
        r = codes * (self.velocity - self.omega * x2)
        return np.where(np.abs(codes) == 1, r, np.inf)


@dataclass
class Cases:
    """Cases of one distance, arrays [..., cases].

    start, end: states at t = 0 and t1; graze: time of the extremum; belt: whose boundary it is, or
    that touches on this side of the edge, at x1 = edge; outcome; before, beyond, after: contact
    codes at the start, beyond the edge, and at the end.
    """

    osc: Oscillators
    start: np.ndarray
    t1: float
    graze: np.ndarray
    distance: float
    belt: np.ndarray
    edge: np.ndarray
    outcome: np.ndarray
    before: np.ndarray
    beyond: np.ndarray
    after: np.ndarray
    end: np.ndarray

    def take(self, where) -> "Cases":
        arrays = {k: v[..., where] for k, v in vars(self).items() if isinstance(v, np.ndarray)}
        return replace(self, osc=self.osc.take(where), **arrays)


def flow(osc, codes, y, duration, steps=STEPS, path=False):
    """The states (x1, x2) after the durations, [cases] each; with `path` those of all steps."""
    h = duration / steps
    states = [y]
    x1, x2 = y
    for _ in range(steps):
        slopes = []
        for row in _A:
            shift1 = sum((w * k[0] for w, k in zip(row, slopes) if w), 0.0)
            shift2 = sum((w * k[1] for w, k in zip(row, slopes) if w), 0.0)
            v = x2 + h * shift2
            slopes.append((v, osc.acceleration(codes, x1 + h * shift1, v)))
        x1 = x1 + h * sum(w * k[0] for w, k in zip(_B, slopes) if w)
        x2 = x2 + h * sum(w * k[1] for w, k in zip(_B, slopes) if w)
        states.append((x1, x2))
    return np.array(states) if path else (x1, x2)


def land(osc, codes, y, guess, axis, level):
    """(duration, state) of the orbits where y[axis] = level, near the guessed duration."""
    t = guess + 0 * y[0]
    for _ in range(6):
        x1, x2 = flow(osc, codes, y, t)
        rate = x2 if axis == 0 else osc.acceleration(codes, x1, x2)
        t = t - ((x1, x2)[axis] - level) / rate
    x1, x2 = flow(osc, codes, y, t)
    return t, ((level + 0 * x1, x2) if axis == 0 else (x1, level + 0 * x1))


def growth(osc, codes, y, duration):
    """By how much deviations from the state y grow at most in that time."""
    nudges = (1e-30j, 0), (0, 1e-30j)
    slopes = [flow(osc, codes, (y[0] + u, y[1] + v), duration) for u, v in nudges]
    return np.max(np.abs(np.imag(slopes)) / 1e-30, axis=(0, 1))


# --- how they end ---------------------------------------------------------------------------------


@np.errstate(all="ignore")  # where a case has another outcome
def final(case: Cases) -> np.ndarray:
    """The states at t1 by the outcomes, [2, cases]; for complex starts and parameters, too."""
    ends = {
        "missed": _along,
        "sticks": _stuck_on,
        "holds": _stuck_on,
        "passes": _passed,
        "returns": _back_again,
    }
    end = 0.0
    for outcome in np.unique(case.outcome):
        end = np.where(case.outcome == outcome, np.array(ends[outcome](case)), end)
    return end


def derivative(case: Cases, name: str, index=()) -> np.ndarray:
    """Derivatives of the states at t1 with respect to a part of the start or of the oscillator.

    name: "start" or a field of `Oscillators`, `index` of it, or "edge", the one that is grazed.
    """
    tiny = 1e-40
    if name == "edge":
        case = replace(case, edge=case.edge + 1j * tiny)
    else:
        owner = case if name == "start" else case.osc
        changed = getattr(owner, name).astype(complex)
        changed[index] += 1j * tiny
        owner = replace(owner, **{name: changed})
        case = owner if name == "start" else replace(case, osc=owner)
    return np.imag(final(case)) / tiny


def _along(case):
    middle = flow(case.osc, case.before, case.start, case.graze)
    return flow(case.osc, case.before, middle, case.t1 - case.graze)


def _stuck_on(case):
    """Onto the boundary, and from there."""
    osc, belt, codes = case.osc, case.belt, case.before
    nu = osc.velocity[belt, np.arange(belt.size)]
    v = nu / osc.omega
    guess = case.graze - np.sqrt(2 * case.distance / np.abs(nu))
    t, y = land(osc, codes, case.start, guess, 1, v)
    held = y[0] + v * (case.t1 - t), v + 0 * y[0]
    # Slip onset: what the belt can hold is what its friction is there.
    x1 = osc.acceleration(codes, 0 * v, v)
    slipped = flow(osc, codes, (x1, v), case.t1 - (t + (x1 - y[0]) / v))
    return np.where(case.outcome == "holds", np.array(held), np.array(slipped))


def _over_edge(case):
    """Time and state where the edge is met, and how long until the next time, and that state."""
    push = np.real(np.abs(case.osc.acceleration(case.before, case.edge, 0 * case.graze)))
    guess = case.graze - np.sqrt(2 * case.distance / push)
    t, y = land(case.osc, case.before, case.start, guess, 0, case.edge)
    push = case.osc.acceleration(case.beyond, *y)
    return t, y, *land(case.osc, case.beyond, y, -2 * y[1] / push, 0, case.edge)


def _passed(case):
    t, y, _, _ = _over_edge(case)
    return flow(case.osc, case.beyond, y, case.t1 - t)


def _back_again(case):
    t, _, after, y = _over_edge(case)
    return flow(case.osc, case.before, y, case.t1 - t - after)


# --- how they are made ----------------------------------------------------------------------------


def _draw(rng, n, speeds, jump=False):
    """Oscillators at random, without contact edges; jump: with Coulomb's law, static > kinetic."""
    sides = rng.choice([-1, 1], (2, n))
    residual, static = rng.uniform(0.4, 0.7, (2, n)), rng.uniform(0.8, 1.2, (2, n))
    return Oscillators(
        damping=rng.uniform(0.1, 0.8, n),
        omega=rng.uniform(0.8, 1.2, n),
        velocity=sides * rng.uniform(*speeds, (2, n)),
        load=rng.uniform(0.5, 1.5, (2, n)),
        static=static,
        residual=residual,
        drop=np.zeros((2, n)) if jump else static - residual,
        steepness=rng.uniform(4.0, 12.0, (2, n)),
        lower=np.full((2, n), -np.inf),
        upper=np.full((2, n), np.inf),
    )


def _sign(x):
    return np.where(x < 0, -1, 1)


def boundary_cases(seed, n, distances, jump=False) -> list[Cases]:
    """Extrema of x2 at the boundary of a belt: a list of `Cases`, one for each distance."""
    rng = np.random.default_rng([seed, 1, jump])
    osc = _draw(rng, n, (0.1, 0.9), jump)
    lane = np.arange(n)
    belt = rng.integers(0, 2, n)
    nu, other = osc.velocity[belt, lane], osc.velocity[1 - belt, lane]
    side = _sign(nu)  # x2'' = -x2 at the extremum
    codes = np.zeros((2, n), int)
    codes[belt, lane], codes[1 - belt, lane] = side, _sign(other - nu)
    # Both belts in touch, with or without edges, or this one alone, on its side of an edge: belt 0
    # has the other one's interval above it, belt 1 below.
    contact = rng.choice(["b", "c", "d", "both"], n)
    alone = (contact == "c") | (contact == "d")
    away = np.where(belt == 0, BELOW, ABOVE)
    codes[1 - belt, lane] = np.where(alone, away, codes[1 - belt, lane])
    back = rng.uniform(0.3, 1.2, n)
    margins = rng.uniform(0.05, 0.3, (2, n))
    outcome = np.full(n, "holds" if jump else "sticks")
    after = codes.copy()
    if jump:
        after[belt, lane] = 0
    missed = np.full(n, "missed")
    found, paths, good = [], [], np.ones(n, bool)
    for d in distances:
        x2 = (nu + side * d) / osc.omega
        extremum = osc.acceleration(codes, np.zeros(n), x2), x2
        before = flow(osc, codes, extremum, -back, path=True)
        then = flow(osc, codes, extremum, SPAN - back, path=True)
        case = Cases(
            osc=osc,
            start=before[-1],
            t1=SPAN,
            graze=back,
            distance=d,
            belt=belt,
            edge=np.full(n, np.inf),
            outcome=outcome if d > 0 else missed,
            before=codes,
            beyond=codes,
            after=after if d > 0 else codes,
            end=then[-1],
        )
        if d > 0:
            case = replace(case, end=final(case))
        needed = np.abs(osc.acceleration(case.after, *case.end))
        good &= (case.outcome != "holds") | (needed < 0.99 * (osc.load * osc.static)[belt, lane])
        good &= growth(osc, codes, case.start, back) < GROWTH
        good &= growth(osc, codes, extremum, SPAN - back) < GROWTH
        path = np.concatenate([before[::-1], then[1:]])
        good &= _keeps_away(osc, codes, path, belt)
        found.append(case)
        paths += [path[:, 0], case.end[:1]]
    paths = np.concatenate(paths)
    osc = _edged(osc, contact, belt, paths.min(0), paths.max(0), margins)
    return [replace(case, osc=osc).take(good) for case in found]


def _keeps_away(osc, codes, path, belt, margin=2e-3):
    """Whether nothing but the one extremum comes near a boundary; path: [steps, 2, cases]."""
    guards = np.array([osc.boundary(codes, x2) for x2 in path[:, 1]])
    lane = np.arange(belt.size)
    own, other = guards[:, belt, lane], guards[:, 1 - belt, lane]
    push = np.array([osc.acceleration(codes, *y) for y in path])
    once = np.sum(np.diff(np.sign(push), axis=0) != 0, axis=0) <= 3
    ends = (own[0] > margin) & (own[-1] > margin)
    # The extremum is the only place where this boundary is near.
    near = own < margin
    together = np.sum(np.diff(near.astype(int), axis=0) != 0, axis=0) <= 2
    return np.all(other > margin, axis=0) & ends & together & once & np.all(np.isfinite(own), 0)


def _edged(osc, contact, belt, lowest, highest, margins):
    """Contact edges around the paths: belt 0 touches on the left and belt 1 on the right."""
    lower, upper = osc.lower.copy(), osc.upper.copy()
    left, right = lowest - margins[0], highest + margins[1]
    beyond = np.where(contact == "d", margins[0], 0.0)
    alone = (contact == "c") | (contact == "d")
    # Belt 0 alone: belt 1 begins on the right, and belt 0 ends there or further on.
    first, second = alone & (belt == 0), alone & (belt == 1)
    upper[0] = np.where(first, right + beyond, upper[0])
    lower[1] = np.where(first, right, lower[1])
    upper[0] = np.where(second, left, upper[0])
    lower[1] = np.where(second, left - beyond, lower[1])
    both = contact == "both"
    upper[0] = np.where(both, right, upper[0])
    lower[1] = np.where(both, left, lower[1])
    return replace(osc, lower=lower, upper=upper)


@np.errstate(all="ignore")  # candidates that are not used may run far beyond a boundary
def edge_cases(seed, n, distances) -> list[Cases]:
    """Extrema of x1 at a contact edge: a list of `Cases`, one for each distance."""
    rng = np.random.default_rng([seed, 2])
    osc = _draw(rng, n, (0.4, 1.5))
    sigma = rng.uniform(-1.5, 1.5, n)
    rightward = rng.random(n) < 0.5
    # What touches on this side and beyond: one belt and the other, one and both, both and one.
    kind = rng.integers(0, 3, n)
    slips = _sign(osc.velocity)
    near = np.where(rightward, 0, 1)  # the belt that touches on this side
    lane = np.arange(n)
    before, beyond = slips.copy(), slips.copy()
    away = np.where(rightward, BELOW, ABOVE)  # of a belt that begins beyond
    before[1 - near, lane] = np.where(kind < 2, away, slips[1 - near, lane])
    beyond[near, lane] = np.where(kind != 1, -away, slips[near, lane])
    e = np.where(rightward, 1, -1)
    room = rng.uniform(0.4, 0.8, n)
    lower, upper = osc.lower.copy(), osc.upper.copy()
    # Belt 0 ends at the right end of its interval, belt 1 begins at the left end of its own.
    begins, ends = kind < 2, kind != 1  # the other belt begins, this one ends, at sigma
    own_end = np.where(ends, sigma, sigma + e * room)
    other_begin = np.where(begins, sigma, sigma - e * (room + 2.0))
    upper[0] = np.where(rightward, own_end, other_begin)
    lower[1] = np.where(rightward, other_begin, own_end)
    osc = replace(osc, lower=lower, upper=upper)
    rest = np.zeros(n)
    push, push_beyond = (osc.acceleration(c, sigma, rest) for c in (before, beyond))
    back = rng.uniform(0.2, 0.6, n)
    good = (e * push < -0.1) & (np.abs(push_beyond) > 0.1) & (np.abs(sigma - own_end) < 1)
    returns = e * push_beyond < 0
    over = np.where(returns, "returns", "passes")
    found = []
    for d in distances:
        top = (sigma + e * d, rest)
        path = flow(osc, before, top, -back, path=True)
        case = Cases(
            osc=osc,
            start=path[-1],
            t1=SPAN_AT_EDGE,
            graze=back,
            distance=d,
            belt=near,
            edge=sigma,
            outcome=over if d > 0 else np.full(n, "missed"),
            before=before,
            beyond=beyond,
            after=np.where(returns, before, beyond) if d > 0 else before,
            end=path[-1],
        )
        good &= _stays(osc, before, path, sigma, e)
        good &= growth(osc, before, case.start, back) < GROWTH
        on = SPAN_AT_EDGE - back
        if d > 0:
            t, crossing, back_in, y = _over_edge(case)
            good &= ~returns | (back_in < on - 0.02)
            left = np.where(returns, SPAN_AT_EDGE - t - back_in, on)
            again = flow(osc, before, y, left, path=True)
            middle = flow(osc, beyond, crossing, SPAN_AT_EDGE - t, path=True)
            good &= np.where(
                returns,
                _stays(osc, before, again, sigma, e),
                _stays(osc, beyond, middle, sigma, -e) & (np.abs(middle[-1, 0] - sigma) < 0.35),
            )
        else:
            path = flow(osc, before, top, on, path=True)
            good &= _stays(osc, before, path, sigma, e)
        found.append(replace(case, end=final(case)))
    return [case.take(good) for case in found]


def _stays(osc, codes, path, sigma, e, margin=2e-3):
    """Whether a path that begins or ends at rest near the edge has no other event."""
    guards = np.array([osc.boundary(codes, x2) for x2 in path[:, 1]])
    slips = np.all(guards > margin, axis=(0, 1))
    apart = e * (sigma - path[-1, 0]) > margin
    loops = np.sum(np.abs(np.diff(np.sign(path[1:, 1]), axis=0)) > 0, axis=0) == 0
    within = np.all(np.abs(path[:, 0] - sigma) < 2.3, axis=0)
    return slips & apart & loops & within


#: The events of each outcome.
EVENTS = {
    "missed": (),
    "sticks": (STICK, SLIP),
    "holds": (STICK,),
    "passes": (EDGE,),
    "returns": (EDGE, EDGE),
}
