"""Cycles and bifurcation points of the oracle, each found the plain way.

Sticking cycles are simulated until an event that ends a stick phase repeats to the last bit.
Unstable cycles are the fixed points of the return map of the section x2 = 0, run backwards in
time, where they attract. Bifurcation points are scalar roots by Brent's method of a function
that changes sign smoothly: the trace at the focus (Hopf), or the gap between a boundary and the
extremum of x2 of the orbit that leaves a slip onset (nonsmooth fold, grazing), the boundary
itself not being acted upon.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import copysign, exp, inf
from typing import Any

import numpy as np
from oracle import (
    ABOVE,
    BELOW,
    STUCK,
    Event,
    Loop,
    Oscillator,
    acceleration,
    advance,
    capacity,
    mates,
    needed_and_capacity,
    start_mode,
    touches,
)
from scipy.optimize import brentq, minimize_scalar


@dataclass(frozen=True)
class Cycle:
    period: float
    stick_durations: tuple  # per belt, summed over the phases of one loop
    x1_min: float
    x1_max: float
    x2_min: float
    x2_max: float
    signature: tuple  # ((kind, belt), ...) of one loop, the start's event last
    start: tuple
    margin: float
    run: Any = field(repr=False)
    multiplier: float = 0.0  # nontrivial Floquet multiplier; 0 for a cycle that sticks


# ---------------------------------------------------------------- sticking cycles


def sticking_cycle(osc, y0=(3.0, 0.0), T=2000.0, **options):
    """The sticking cycle that a start leads to, or None where no stick phase repeats by T.

    A stick phase ends in a state that does not depend on how it was entered, so the run repeats
    exactly as soon as one such end occurs twice.
    """
    mode, x2, status, _ = start_mode(osc, *map(float, y0))
    if status:
        return None
    y = (float(y0[0]), x2)
    run = advance(osc, y, mode, T, until=_repetition(mode), **options)
    if run.status != "stopped":
        return None
    # Once more from the repeated event itself, so that the clock starts at zero.
    end = run.stopped_by
    until = _repetition(end.mode, end)
    run = advance(osc, (end.x1, end.x2), end.mode, T, until=until, **options)
    return _cycle(osc, run)


def _repetition(mode, first=None):
    """A condition on the items of a run that starts in a mode: a stick phase ends as before."""
    seen = {first and _state(first)}

    def repeats(item):
        nonlocal mode
        if not isinstance(item, Event):
            return False
        was_stuck, mode = STUCK in mode, item.mode
        if not was_stuck:
            return False
        again = _state(item) in seen
        seen.add(_state(item))
        return again

    return repeats


def _state(event):
    return event.kind, event.belt, event.x1, event.x2, event.mode


def _cycle(osc, run, **more):
    durations = tuple(
        sum(arc.duration for arc in run.arcs if arc.mode[k] == STUCK) for k in range(len(osc.belts))
    )
    points = [p for arc in run.arcs for p in (arc.entry, arc.exit)]
    points += [(loop.x1, loop.x2) for arc in run.arcs for loop in arc.loops]
    (x1_min, x2_min), (x1_max, x2_max) = np.min(points, axis=0), np.max(points, axis=0)
    extrema = map(float, (x1_min, x1_max, x2_min, x2_max))
    start = run.arcs[0].entry
    return Cycle(run.t_end, durations, *extrema, run.sequence, start, run.margin, run, **more)


# ---------------------------------------------------------------- equilibria and Hopf points


def slope(mu, r):
    """mu'(r) by a complex step, exact to rounding."""
    return (mu(complex(r, 1e-30))).imag / 1e-30


def foci(osc):
    """Equilibria that orbits loop around, from left to right: [(x1, "focus" | "pseudo_focus")].

    At rest every touching belt pulls with load mu(|nu|) sgn(nu), so x2' falls along x1 but for
    jumps at the contact edges.
    """
    edges = sorted({e for b in osc.belts for e in (b.lower, b.upper) if abs(e) < inf})
    bounds = [-inf, *edges, inf]
    found = []
    for lo, up in pairwise(bounds):
        pull = _pull(osc, lo, up)
        if lo < pull < up:
            found.append((pull, "focus"))
        if up < inf:
            right = _pull(osc, up, bounds[bounds.index(up) + 1])
            if pull > up > right:
                found.append((up, "pseudo_focus"))
    return found


def _pull(osc, lo, up):
    belts = (b for b in osc.belts if b.lower <= lo and up <= b.upper)
    return sum(copysign(b.load * b.mu(abs(b.velocity)), b.velocity) for b in belts)


def trace(osc, x1):
    """Trace of the Jacobian at the focus (x1, 0)."""
    touching = (b for b in osc.belts if b.lower < x1 < b.upper)
    return -osc.damping - sum(b.load * osc.omega * slope(b.mu, abs(b.velocity)) for b in touching)


def hopf(make, bracket):
    """Parameter in the bracket at which the trace at the only focus of make(parameter) is zero."""

    def at(p):
        osc = make(p)
        ((x1, kind),) = foci(osc)
        assert kind == "focus", kind
        return trace(osc, x1)

    return _solve(at, bracket)


def pseudo_focus_rate(osc, sigma):
    """Growth rate of small loops around the pseudo-focus at the edge sigma (design, section 1)."""
    (a_l, tr_l), (a_r, tr_r) = (_beside(osc, sigma, d) for d in (-1, 1))
    return (tr_l / a_l + tr_r / abs(a_r)) / (3 * (1 / a_l + 1 / abs(a_r)))


def _beside(osc, sigma, direction):
    """x2' and trace at rest just beside an edge."""
    x1 = np.nextafter(sigma, direction * inf)
    return -sigma + _pull(osc, x1, x1), trace(osc, x1)


def _solve(f, bracket):
    return brentq(f, *bracket, xtol=1e-15, rtol=1e-15)


# ---------------------------------------------------------------- unstable cycles


def reverse(osc):
    """The oscillator that runs backwards in time, with x2 -> -x2.

    With w = -x2 and s = -t:  x1' = w,  w' = -x1 + zeta w + load mu(|r|) sgn(r) and
    r = nu + omega w, so damping, belt velocities and loads change sign.
    """
    belts = tuple(replace(b, velocity=-b.velocity, load=-b.load) for b in osc.belts)
    return Oscillator(-osc.damping, belts, osc.omega)


def one_loop(osc, x1, loops=2):
    """Run in slip from (x1, 0) until x2 = 0 again (loops=1: half a loop); None at a boundary."""
    mode = _slip_mode(osc, x1)
    count = [0]

    def until(item):
        count[0] += isinstance(item, Loop) and item.axis == 0
        return count[0] == loops

    never = dict.fromkeys(range(len(osc.belts)), 0.0)
    run = advance(osc, (x1, 0.0), mode, 100.0, until=until, slack=never, focus_speed=0.0)
    return run if run.status == "stopped" else None


def _slip_mode(osc, x1):
    """Mode at rest, by the side of x1 on which each belt is (x1 on no edge)."""
    return tuple(
        BELOW if x1 < b.lower else ABOVE if x1 > b.upper else int(copysign(1, b.velocity))
        for b in osc.belts
    )


def unstable_cycle(osc, focus=None, samples=40):
    """The unstable cycle nearest to a stable focus that touches no boundary, or None.

    It may pass contact edges. With d the distance of the start (focus - d, 0), the orbit is run
    backwards for one loop to distance q(d): near a stable focus q > d, outside an unstable cycle
    q < d. The largest d that reaches no boundary is found first, by bisection.
    """
    if focus is None:
        ((focus, _),) = foci(osc)
    back = reverse(osc)

    def growth(d):
        run = one_loop(back, focus - d)
        return None if run is None else focus - run.stopped_by.x1 - d

    inside, outside = 1e-6, 10.0
    if growth(inside) is None:
        return None
    while outside - inside > 1e-14 * inside:
        middle = 0.5 * (inside + outside)
        if middle in (inside, outside):
            break
        inside, outside = (inside, middle) if growth(middle) is None else (middle, outside)
    grid = np.unique(np.r_[np.geomspace(1e-3, 1, samples), np.linspace(0, 1, samples)[1:]])
    before = growing = None
    for d in inside * grid:
        grows = growth(d) > 0
        if growing and not grows:
            distance = brentq(growth, before, d, xtol=1e-15, rtol=1e-14)
            run = one_loop(osc, focus - distance)
            if run is None:  # forwards it leaves: it touches a boundary within rounding
                return None
            return _cycle(osc, run, multiplier=exp(_divergence(osc, run)))
        before, growing = d, grows
    return None


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)


def _divergence(osc, run):
    """Integral of the trace along a run without stick. The passage of an edge adds nothing:
    its saltation matrix [[1, 0], [jump of x2' / x2, 1]] has determinant one.
    """
    total = 0.0
    for arc in run.arcs:
        belts = [(m, b) for m, b in zip(arc.mode, osc.belts) if touches(m)]
        starts = [t for t, _, _ in arc.steps]
        for a, b in zip(starts, [*starts[1:], arc.t_end]):
            for node, weight in zip(_NODES, _WEIGHTS):
                _, x2 = arc.dense(0.5 * (a + b) + 0.5 * (b - a) * node)
                tr = -osc.damping - sum(
                    belt.load * osc.omega * slope(belt.mu, m * (belt.velocity - osc.omega * x2))
                    for m, belt in belts
                )
                total += 0.5 * (b - a) * weight * tr
    return total


def integral_of_x1(run):
    """Integral of x1 over the time of a run."""
    total = 0.0
    for arc in run.arcs:
        starts = [t for t, _, _ in arc.steps] or [arc.t_start]
        for a, b in zip(starts, [*starts[1:], arc.t_end]):
            for node, weight in zip(_NODES, _WEIGHTS):
                x1, _ = arc.at(0.5 * (a + b) + 0.5 * (b - a) * node)
                total += 0.5 * (b - a) * weight * x1
    return total


# ---------------------------------------------------------------- nonstandard points


def slip_onset(osc, belt):
    """State and mode at the end of a stick phase on a belt: ((x1, x2), mode after).

    needed = rest - x1 has grown against the belt's motion to the capacity. Which belts touch
    there depends on x1, which depends on them; the consistent choice is searched for.
    """
    x2 = osc.speed(belt)
    nu = osc.belts[belt].velocity
    edges = sorted({e for b in osc.belts for e in (b.lower, b.upper) if abs(e) < inf})
    bounds = [-inf, *edges, inf]
    for lo, up in pairwise(bounds):
        mode = []
        for b in osc.belts:
            if b.lower <= lo and up <= b.upper:
                r = b.velocity - nu
                mode.append(0 if r == 0 else int(copysign(1, r)))
            else:
                mode.append(BELOW if up <= b.lower else ABOVE)
        group = mates(osc, mode, nu)
        rest = acceleration(osc, mode, without=group)(0.0, x2)
        x1 = rest + copysign(capacity(osc, group), x2)
        if belt in group and lo < x1 < up:
            sign = int(copysign(1, x2))
            return (x1, x2), tuple(sign if k in group else m for k, m in enumerate(mode))
    raise ValueError(f"a stick phase on belt {belt} does not end in a slip onset")


def gap(osc, onset_belt, belt, slack=0.02):
    """Distance in x2 by which the orbit from a slip onset stays short of a belt's boundary.

    The orbit is followed to its first extremum of x2 on the side of the boundary; the boundary
    is not acted upon, so that the gap passes smoothly through zero. An orbit that runs further
    than `slack` beyond counts as -slack - |x2'| there (continuous, and far from the pole at
    which Conti's law, continued, ends).
    """
    return gap_from(osc, *slip_onset(osc, onset_belt), (onset_belt, belt), slack)


def gap_from_rest(osc, resting, sign, belt, slack=0.02):
    """The same for the orbit that leaves the equilibrium on a belt at rest, which came there with
    velocities of that sign, along its stronger unstable direction (of class (b) only).

    It starts on the straight line, 1e-6 away; that is as good as some 10 times its square.
    """
    assert osc.belts[resting].velocity == 0
    mode = tuple(
        sign if k == resting else int(copysign(1, b.velocity)) for k, b in enumerate(osc.belts)
    )
    rest = acceleration(osc, mode)(0.0, 0.0)
    strong = max(np.roots([1.0, -trace(osc, rest), 1.0]))
    assert np.isreal(strong)
    x2 = -sign * 1e-6
    return gap_from(osc, (rest + x2 / strong, x2), mode, (resting, belt), slack)


def gap_from(osc, y, mode, belts, slack=0.02):
    """The same for the orbit from a state in a mode; the last belt is that of the boundary."""
    run = _to_extremum(osc, y, mode, belts, slack)
    if run.status == "overshot":
        return -slack - abs(acceleration(osc, run.mode_end)(*run.y_end))
    if run.status != "stopped":
        raise ValueError(f"the orbit from the onset on belt {belts[0]} does not come back")
    return abs(osc.speed(belts[-1])) - abs(run.stopped_by.x2)


def _to_extremum(osc, y, mode, belts, slack):
    """The run to the first extremum of x2 on the side of the last belt's boundary."""
    level = osc.speed(belts[-1])

    def until(item):
        return isinstance(item, Loop) and item.axis == 1 and item.x2 * level > 0

    within = dict.fromkeys(belts, slack)
    return advance(osc, y, mode, 100.0, until=until, slack=within, focus_speed=0.0)


def growth_from_tangency(osc, belt):
    """Logarithm of the multiplier of a cycle that is tangent to a belt's boundary where slip onset
    on it is, and touches no other boundary: the integral of the trace."""
    run = _to_extremum(osc, *slip_onset(osc, belt), (belt,), 0.02)
    assert run.status == "stopped"
    return _divergence(osc, run)


def nonsmooth_fold(make, bracket, belt):
    """Parameter at which the stick phase on a belt has vanished.

    The slip orbit from the onset then returns to the onset: it is tangent to the boundary
    there, and the boundary has no other point of tangency on this side. So the maximum of x2
    equals the belt's velocity: one equation in one unknown.
    """
    return _solve(lambda p: gap(make(p), belt, belt), bracket)


def grazing(make, bracket, belt, y0=(3.0, 0.0)):
    """Parameter at which the sticking cycle touches the boundary of a belt it does not stick to.

    The cycle is the orbit from the slip onset of its own stick phase; which belt that is is read
    off the cycle at the end of the bracket where it does not stick to `belt`.
    """
    for p in bracket:
        cycle = sticking_cycle(make(p), y0)
        if cycle and cycle.stick_durations[belt] == 0:
            onset_belt = int(np.argmax(cycle.stick_durations))
            break
    else:
        raise ValueError(f"the cycle sticks to belt {belt} at both ends of {bracket}")
    return _solve(lambda p: gap(make(p), onset_belt, belt), bracket)


def crossing_sliding(make, bracket, onset_belt, belt, arrivals):
    """Parameter at which the needed force is just the capacity where an orbit meets a boundary.

    The orbit is that from a slip onset; it may cross or stick there. arrivals: which of its
    arrivals at the boundary it is.
    """

    def excess(p):
        osc = make(p)
        y, mode = slip_onset(osc, onset_belt)
        found = []

        def until(item):
            if isinstance(item, Event) and item.belt == belt and item.kind in ("STICK", "CROSS"):
                found.append(item)
            return len(found) == arrivals

        run = advance(osc, y, mode, 100.0, until=until)
        group = mates(osc, run.arcs[-1].mode, osc.belts[belt].velocity)
        needed, cap = needed_and_capacity(osc, run.arcs[-1].mode, group, found[-1].x1)
        return abs(needed) - cap

    return _solve(excess, bracket)


def edge_grazing(make, bracket, edge, y0=(3.0, 0.0)):
    """Parameter at which the sticking cycle touches a contact edge that it does not pass.

    make(p) has that edge out of the way, so that touching it has no consequence.
    """

    def distance(p):
        cycle = sticking_cycle(make(p), y0)
        return min(cycle.x1_max - edge, cycle.x1_min - edge, key=abs)

    return _solve(distance, bracket)


def corner(make, bracket, belt, start, passages=2, slack=0.02):
    """Parameter at which an orbit passes a contact edge just with the velocity of a belt.

    start(osc) is its state and mode at first; the passage is the given one; the belt's boundary is
    not acted upon, so that x2 there goes smoothly through the belt's velocity.
    """

    def excess(p):
        osc, count = make(p), [0]

        def until(item):
            count[0] += isinstance(item, Event) and item.kind == "EDGE"
            return count[0] == passages

        run = advance(osc, *start(osc), 100.0, until=until, slack={belt: slack}, focus_speed=0.0)
        assert run.status == "stopped", run.status
        return run.stopped_by.x2 - osc.speed(belt)

    return _solve(excess, bracket)


def pseudo_hopf(make, bracket, edge):
    """Parameter at which loops around the pseudo-focus at edge(parameter) do not grow or shrink."""
    return _solve(lambda p: pseudo_focus_rate(make(p), edge(p)), bracket)


def fold_of_cycles(make, bracket, distances, *, attracts_inside=False):
    """Parameter at which two cycles that touch no boundary meet and vanish.

    A loop from (focus + d, 0) grows by a factor; between the two cycles that is above one.
    They meet where its largest value over the distances d is just one. attracts_inside: the inner
    one of the two attracts; then it is below one between them, and its smallest value counts.
    """

    def largest(p):
        osc = make(p)
        ((focus, _),) = foci(osc)

        def growth(d):
            excess = (one_loop(osc, focus + d).stopped_by.x1 - focus) / d - 1
            return excess if attracts_inside else -excess

        best = minimize_scalar(growth, bounds=distances, method="bounded", options={"xatol": 1e-7})
        assert distances[0] + 1e-3 < best.x < distances[1] - 1e-3, "the largest value is at an end"
        return -best.fun

    return _solve(largest, bracket)
