"""The switch model and tanh smoothing where there are contact edges, against SciPy zone by zone."""

import functools
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scipy.integrate import DOP853
from scipy.optimize import brentq

import jaxbelt as jb
from jaxbelt import Status

WIDTHS = {"smooth": "eps", "switch": "v_star"}


def oracle_field(formulation, damping, belts, force, width):
    """(x1', x2') at (t, y); belts: those that touch, (velocity, mu, static, load)."""

    def friction(x2, without=None):
        slipping = [belt for belt in belts if belt[0] != without]
        return sum(load * mu(abs(v - x2)) * (1 if v >= x2 else -1) for v, mu, _, load in slipping)

    def smooth(t, y):
        pulls = [load * mu(abs(v - y[1])) * np.tanh((v - y[1]) / width) for v, mu, _, load in belts]
        return np.array([y[1], -y[0] - damping * y[1] + force(t) + sum(pulls)])

    def switch(t, y):
        rest = -y[0] - damping * y[1] + force(t)
        for v, *_ in belts:
            held = sum(static * load for u, _, static, load in belts if u == v)
            if abs(v - y[1]) <= width and abs(rest + friction(y[1], without=v)) < held:
                return np.array([v, v - y[1]])
        return np.array([y[1], rest + friction(y[1])])

    return smooth if formulation == "smooth" else switch


def by_scipy(formulation, damping, belts, y0, t1, width, force=None, t0=0.0):
    """The state at t1; belts: (velocity, mu, static, load, lower, upper).

    Each zone between edges has a field of its own. A step is searched for an exit at 12 points.
    """
    force = force or (lambda t: 0.0)
    places = sorted({edge for belt in belts for edge in belt[4:] if np.isfinite(edge)})
    bounds = [-np.inf, *places, np.inf]

    def field_of(zone):
        low, high = max(bounds[zone], places[0] - 2), min(bounds[zone + 1], places[-1] + 2)
        touching = [belt[:4] for belt in belts if belt[4] < 0.5 * (low + high) < belt[5]]
        return oracle_field(formulation, damping, touching, force, width)

    options: Any = dict(rtol=1e-12, atol=1e-13, max_step=0.05)
    t, y = t0, np.array(y0, float)
    zone = int(np.searchsorted(places, y[0], side="right"))
    if y[0] in places:
        v, a = field_of(zone)(t, y)
        zone -= (v or a) < 0
    while t < t1:
        low, high = bounds[zone], bounds[zone + 1]
        solver = DOP853(field_of(zone), t, y, t1, **options)
        while solver.status == "running":
            solver.step()
            dense: Any = solver.dense_output()
            times = np.linspace(cast(float, solver.t_old), solver.t, 12)
            x1 = dense(times)[0]
            x1[0] = np.clip(x1[0], low, high)
            out = np.flatnonzero((x1 < low) | (x1 > high))
            if out.size:
                edge = low if x1[out[0]] < low else high
                until, before = times[out[0]], times[out[0] - 1]

                def past(t, dense=dense, edge=edge):
                    return dense(t)[0] - edge

                if past(before) * past(until) < 0:
                    t = brentq(past, before, until, xtol=1e-15)
                else:
                    t = before
                y = dense(t)
                y[0], zone = edge, zone + (1 if edge == high else -1)
                break
        else:
            return solver.y
    return y


def friction(mu):
    return lambda r: mu + 0.0 * r


def end(formulation, osc, y0, t1, width=None, ts=None, t0=0.0):
    width = {} if width is None else {WIDTHS[formulation]: width}
    ts = jnp.stack([jnp.asarray(t1)]) if ts is None else ts
    return jb.simulate(osc, y0, t1, t0=t0, ts=ts, formulation=formulation, **width)


# --- states ---------------------------------------------------------------------------------------


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("formulation", WIDTHS)
def test_a_narrow_interval_is_not_jumped(formulation):
    """The mass never comes near the belt's velocity 10, so both are the exact motion of a push of
    10 in the interval: its energy grows by 10 * 0.01 where x1 grows, and so much less on the way
    back, so the amplitude stays."""
    belt = jb.Belt(10.0, jb.Coulomb(1.0, 1.0), 10.0, lower=0.5, upper=0.51)
    osc = jb.Oscillator(0.0, (belt,))
    few = end(formulation, osc, (2.0, 0.0), 20.0)
    many = end(formulation, osc, (2.0, 0.0), 20.0, ts=np.linspace(0.0, 20.0, 41))
    assert few.status == many.status == Status.OK
    # Half of it a tolerance of 1e-10 per step, in hundreds of steps.
    np.testing.assert_allclose(few.ys[-1], many.ys[-1], rtol=0, atol=1e-8)
    belts = [(10.0, friction(1.0), 1.0, 10.0, 0.5, 0.51)]
    expected = by_scipy(formulation, 0.0, belts, (2.0, 0.0), 20.0, 1e-3)
    np.testing.assert_allclose(few.ys[-1], expected, rtol=0, atol=1e-8)
    # The same from integrating the discontinuous field with steps of 2e-4.
    np.testing.assert_allclose(few.ys[-1], [0.88979183, -1.79116456], rtol=0, atol=1e-6)


#: Belts by velocity, friction, load, lower, upper; start.
CASES = {
    "narrow, beside an edge": (
        [(1.0, 0.5, 1.0, -np.inf, 0.5), (-0.5, 0.5, 1.5, 0.5, 0.51)],
        (1.5, 0.0),
    ),
    "one place": ([(1.0, 0.5, 1.0, -np.inf, 0.0), (-1.5, 0.5, 0.5, 0.0, np.inf)], (1.0, 0.0)),
    "starts on an edge": ([(1.0, 0.5, 1.0, 0.0, 1.0), (-0.5, 0.5, 1.0, 0.5, np.inf)], (0.0, 1.0)),
    "starts on an edge, leftward": ([(1.0, 0.5, 1.0, 0.0, 1.0)], (1.0, -1.0)),
    "starts at rest on an edge": ([(1.0, 0.5, 1.0, 0.5, np.inf)], (0.5, 0.0)),
    "belt at rest": ([(0.0, 0.25, 0.5, -1.0, 1.0), (0.5, 0.25, 0.5, 0.0, 0.5)], (2.0, 0.0)),
    "turns just beyond an edge": ([(3.0, 0.5, 1.0, 0.9999, np.inf)], (-1.0, 0.0)),
    "grazes an edge": ([(3.0, 0.5, 1.0, 1.0, np.inf)], (-1.0, 0.0)),
}


@functools.cache
def runs(formulation, belts, forced):
    """The end of a run, compiled, as a function of its belts' numbers, [belts, 5], and start."""

    def run(numbers, y0):
        rows = tuple(
            jb.Belt(v, jb.Coulomb(mu, mu), load, lower=lower, upper=upper)
            for v, mu, load, lower, upper in (numbers[i] for i in range(belts))
        )
        forcing = jb.Harmonic(0.75, 1.5) if forced else ()
        osc = jb.Oscillator(0.125, rows, forcing=forcing)
        found = end(formulation, osc, y0, 10.0, 0.125)
        return found.ys[-1], found.status

    return jax.jit(run)


def compare(formulation, belts, y0, forced, tolerance):
    ends, status = runs(formulation, len(belts), forced)(jnp.array(belts), jnp.array(y0))
    force = (lambda t: 0.75 * np.cos(1.5 * t)) if forced else None
    rows = [(v, friction(mu), mu, *rest) for v, mu, *rest in belts]
    expected = by_scipy(formulation, 0.125, rows, y0, 10.0, 0.125, force)
    assert status == Status.OK
    np.testing.assert_allclose(ends, expected, rtol=0, atol=tolerance)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("forced", [False, True])
@pytest.mark.parametrize("formulation", WIDTHS)
def test_round_cases(formulation, forced):
    for belts, y0 in CASES.values():
        # At each jump of the switch field at the band both integrators lose some tolerances.
        compare(formulation, belts, y0, forced, {"smooth": 2e-8, "switch": 5e-7}[formulation])


@pytest.mark.slow
@pytest.mark.parametrize("forced", [False, True])
def test_random_cases_of_the_smooth_formulation(forced):
    draw = np.random.default_rng(7)
    for _ in range(30):
        belts = []
        for _ in range(2):
            lower = draw.uniform(-1, 1)
            upper = lower + draw.choice([0.01, 0.1, 0.5, np.inf])
            belts.append(
                (draw.uniform(-1.5, 1.5), draw.uniform(0.3, 1), draw.uniform(0.5, 1), lower, upper)
            )
        y0 = draw.uniform(-2, 2, 2)
        compare("smooth", belts, y0, forced, 2e-8)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("formulation", WIDTHS)
def test_an_edge_that_pushes_back_from_both_sides_ends_with_a_status(formulation):
    """Loops around it shrink to a point; who starts there passes it without end."""
    left = jb.Belt(2.0, jb.Coulomb(0.5, 0.5), 1.0, upper=0.0)
    right = jb.Belt(-2.0, jb.Coulomb(0.5, 0.5), 1.0, lower=0.0)
    osc = jb.Oscillator(0.125, (left, right))

    def run(y0):
        found = end(formulation, osc, y0, 10.0, 0.125)
        return found.ys[-1], found.status

    starts = jnp.array([[0.25, 0.0], [0.0, 0.0], [jnp.nan, 0.0]])
    ys, status = jax.jit(jax.vmap(run))(starts)
    np.testing.assert_array_equal(status, [Status.OK, Status.TOO_MANY_STEPS, Status.NOT_FINITE])
    assert np.all(np.isnan(ys[1:]))
    half = friction(0.5)
    belts = [(2.0, half, 0.5, 1.0, -np.inf, 0.0), (-2.0, half, 0.5, 1.0, 0.0, np.inf)]
    if formulation == "switch":
        return  # SciPy is slow there.
    expected = by_scipy(formulation, 0.125, belts, starts[0], 10.0, 0.125)
    # The edge is passed every few tenths; each time the error of the state is kept.
    np.testing.assert_allclose(ys[0], expected, rtol=0, atol=2e-8)


# --- derivatives ----------------------------------------------------------------------------------


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("formulation", WIDTHS)
def test_derivatives_by_an_edge(formulation):
    """The belt is never near the mass, so the bands play no part."""

    def run(lower):
        osc = jb.Oscillator(0.1, (jb.Belt(5.0, jb.Coulomb(0.5, 0.5), 1.0, lower=lower),))
        return end(formulation, osc, (-1.0, 0.0), 5.0).ys[-1]

    forward, reverse = jax.jit(lambda lower: (jax.jacfwd(run)(lower), jax.jacrev(run)(lower)))(0.0)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)

    def expected(lower):
        belts = [(5.0, friction(0.5), 0.5, 1.0, lower, np.inf)]
        return by_scipy(formulation, 0.1, belts, (-1.0, 0.0), 5.0, 1e-3)

    difference, _ = oracle.richardson(expected, 0.0, 1e-2)
    # Errors of 1e-12 in the oracle over steps of 2.5e-3.
    np.testing.assert_allclose(forward, difference, rtol=0, atol=1e-8)


#: Two edges at one place, one that is met elsewhere, and all else that a run depends on: lower,
#: upper, lower of the second belt, velocity, load, amplitude, x1, x2, eps, t1, t0.
POINT = np.array([0.0, 0.75, 0.0, 1.125, 0.75, 0.625, -1.0, 0.25, 0.25, 4.0, 0.5])


@pytest.mark.slow
@pytest.mark.parametrize("forced", [False, True])
def test_derivatives_of_the_smooth_formulation(forced):
    def run(p):
        belts = (
            jb.Belt(p[3], jb.Coulomb(0.5, 0.5), p[4], lower=p[0], upper=p[1]),
            jb.Belt(-0.25, jb.Coulomb(0.5, 0.5), 1.0, lower=p[2]),
        )
        osc = jb.Oscillator(0.125, belts, forcing=jb.Harmonic(p[5], 1.5) if forced else ())
        return end("smooth", osc, (p[6], p[7]), p[9], p[8], t0=p[10]).ys[-1]

    def expected(p):
        half = friction(0.5)
        belts = [(p[3], half, 0.5, p[4], p[0], p[1]), (-0.25, half, 0.5, 1.0, p[2], np.inf)]
        force = (lambda t: p[5] * np.cos(1.5 * t)) if forced else None
        return by_scipy("smooth", 0.125, belts, p[6:8], p[9], p[8], force, p[10])

    forward, reverse = jax.jit(lambda p: (jax.jacfwd(run)(p), jax.jacrev(run)(p)))(POINT)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)
    for i, column in enumerate(forward.T):

        def moved(value, i=i):
            return expected(np.where(np.arange(POINT.size) == i, value, POINT))

        # Edges that are at one place, 0 and 2, change their order there: second derivatives jump,
        # and differences are good to their step; else to errors of 1e-11 over steps of 2e-3.
        step, tolerance = (1e-5, 2e-6) if i in (0, 2) else (8e-3, 5e-8)
        difference, _ = oracle.richardson(moved, POINT[i], step)
        np.testing.assert_allclose(column, difference, rtol=0, atol=tolerance)


@pytest.mark.slow
def test_the_last_state_of_the_switch_model_has_its_derivative_by_time():
    """It is the field there, here within the band, where x1' is the belt's velocity."""
    osc = jb.Oscillator(0.125, (jb.Belt(-0.25, jb.Coulomb(1.0, 0.5), 2.0, upper=0.5),))
    t1, y0 = 0.375, (0.25, 0.0)
    state = end("switch", osc, y0, t1, 0.125).ys[-1]
    assert abs(state[1] + 0.25) < 0.125
    slope = jax.jacfwd(lambda t1: end("switch", osc, y0, t1, 0.125).ys[-1])(t1)
    np.testing.assert_allclose(slope, [-0.25, -0.25 - state[1]], rtol=1e-9)


# --- impossible arguments -------------------------------------------------------------------------


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("formulation", "name"),
    [(one, name) for one, width in WIDTHS.items() for name in (width, "atol", "rtol")]
    + [("filippov", "atol"), ("filippov", "rtol")],
)
def test_impossible_traced_sizes(formulation, name):
    """Known ones raise; traced ones are NOT_FINITE, without a state and without derivatives."""
    osc = jb.Oscillator(0.125, (jb.Belt(2.0, jb.Coulomb(0.5, 0.5), 1.0),))

    def run(size):
        found = jb.simulate(
            osc, (1.0, 0.0), 1.0, ts=[0.5, 1.0], formulation=formulation, **{name: size}
        )
        return found.ys, found.status

    sizes = jnp.array([1e-6, -1e-6, 0.0, jnp.nan, jnp.inf])
    ys, status = jax.jit(jax.vmap(run))(sizes)
    np.testing.assert_array_equal(status, [Status.OK] + 4 * [Status.NOT_FINITE])
    assert np.all(np.isfinite(ys[0])) and np.all(np.isnan(ys[1:]))
    # A batch of exact runs has an integrator of its own; the tolerance is 1e-6.
    np.testing.assert_allclose(ys[0], run(1e-6)[0], rtol=0, atol=1e-6)


@pytest.mark.slow(first=True)
def test_impossible_widths_have_no_derivatives():
    osc = jb.Oscillator(0.125, (jb.Belt(2.0, jb.Coulomb(0.5, 0.5), 1.0),))

    def x1(eps):
        ts = jnp.array([1.0])
        return jb.simulate(osc, (1.0, 0.0), 1.0, ts=ts, formulation="smooth", eps=eps).ys[-1, 0]

    slopes = jax.jit(jax.vmap(jax.grad(x1)))(jnp.array([0.125, -1.0, jnp.nan]))
    assert np.isfinite(slopes[0]) and np.all(np.isnan(slopes[1:]))
