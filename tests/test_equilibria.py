"""`equilibria` and `lyapunov_coefficient` against closed forms and the independent oracle.

What is compared with a formula agrees to a few roundings: 1e-12.
"""

import functools
from math import inf, log, pi, sqrt

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest
from scipy.optimize import brentq

import jaxbelt as jb
from jaxbelt import EquilibriumKind

EXACT = dict(rel=1e-12, abs=1e-12)
SETTLED = 1e-4
FIXED_POINT, SEGMENT, PSEUDO_FOCUS, SADDLE = EquilibriumKind

HOPF_A = (sqrt(8) - 1) / 10


def found(osc):
    """Kinds and positions, from left to right."""
    points = jb.equilibria(osc)
    return [(EquilibriumKind(int(p.kind)), float(p.x1)) for p in points]


@functools.cache
def batched(preset):
    """Equilibria of a preset for rows of parameters; one compiled program a preset."""
    return jax.jit(jax.vmap(lambda p: jb.equilibria(preset(*p))))


def free_class_d(nu0, nu1, sigma0, sigma1):
    return jb.presets.class_d(nu0, nu1, sigma0, sigma1)


def random_class_cd(rng, n):
    """Class (d), every third one with both edges at one place: class (c)."""
    sigma = np.sort(rng.uniform(-1.0, 1.0, (n, 2)), axis=1)
    sigma[::3, 1] = sigma[::3, 0]
    return np.hstack([rng.uniform(-0.6, 0.6, (n, 2)), sigma])


# --- fixed points: eqs. (24) and (26) -------------------------------------------------------------


def one_belt(zeta, nu, mus, p1, p2, p3):
    return jb.Oscillator(zeta, (jb.Belt(nu, jb.Conti(mus, p1, p3, p2)),))


def two_belts(zeta, omega, *belts):
    """belts: (nu, mus, p1, p2, p3, u0) one after the other."""
    return jb.Oscillator(
        zeta,
        tuple(
            jb.Belt(nu, jb.Conti(mus, p1, p3, p2), u0)
            for nu, mus, p1, p2, p3, u0 in (belts[:6], belts[6:])
        ),
        omega,
    )


def pull_and_trace(zeta, omega, *belts):
    """x1 of eq. (24) and the trace in eq. (26), for any number of belts, by hand."""
    x1, trace = 0.0, -zeta
    for nu, mus, p1, p2, p3, u0 in np.reshape(belts, (-1, 6)):
        speed = abs(nu)
        x1 += u0 * np.sign(nu) * ((mus - p1) / (1 + p3 * speed) + p1 + p2 * speed**2)
        trace += omega * u0 * ((mus - p1) * p3 / (1 + p3 * speed) ** 2 - 2 * p2 * speed)
    return x1, trace


def draw_belts(rng, shape):
    """nu of either sign, mus, p1, p2 != 0, p3, u0."""
    low, high = [-1.0, 0.5, 0.0, -0.3, 0.0, 0.2], [1.0, 1.5, 0.5, 0.3, 15.0, 2.0]
    return rng.uniform(low, high, (*shape, 6))


def check_fixed_point(points, i, x1, trace):
    assert points.kind[i, 0] == FIXED_POINT and np.all(points.kind[i, 1:] == 0)
    assert points.x1[i, 0] == points.x1_lower[i, 0] == points.x1_upper[i, 0]
    assert points.x1[i, 0] == pytest.approx(x1, **EXACT)
    assert np.asarray(points.jacobian[i, 0]) == pytest.approx(
        np.array([[0, 1], [-1, trace]]), **EXACT
    )
    # Eq. (26), the square root as it stands there.
    root = np.sqrt(complex(-4 + trace**2))
    expected = np.array([0.5 * (trace + root), 0.5 * (trace - root)])
    # Next to a double eigenvalue the root of a rounding error is larger than the error.
    close = max(1e-12, 1e-15 / abs(root))
    assert np.asarray(points.eigenvalues[i, 0]) == pytest.approx(expected, abs=20 * close)
    assert points.rate[i, 0] == pytest.approx(expected[0].real, abs=20 * close)
    assert points.stable[i, 0] == (trace < 0)


@pytest.mark.slow(first=True)
def test_fixed_point_of_class_a_is_that_of_the_paper():
    rng = np.random.default_rng(24)
    belts = draw_belts(rng, (200,))
    p = np.column_stack([rng.uniform(0, 1, 200), belts[:, :5]])
    points = batched(one_belt)(p)
    traces = []
    for i, (zeta, *belt) in enumerate(p):
        x1, trace = pull_and_trace(zeta, 1.0, *belt, 1.0)
        check_fixed_point(points, i, x1, trace)
        traces.append(trace)
    # All sorts: stable and unstable foci, and nodes, eq. (27).
    assert min(traces) < 0 and max(traces) > 2 and np.sum(np.abs(traces) < 2) > 50


@pytest.mark.slow(first=True)
def test_fixed_point_of_class_b_with_any_load_and_frequency():
    rng = np.random.default_rng(26)
    p = np.hstack(
        [rng.uniform([0, 0.3], [1, 3], (200, 2)), *np.moveaxis(draw_belts(rng, (200, 2)), 1, 0)]
    )
    points = batched(two_belts)(p)
    for i, row in enumerate(p):
        check_fixed_point(points, i, *pull_and_trace(*row))


def test_equal_speeds_are_one_belt_of_both_loads():
    one, law = jb.presets.class_b(0.3, 0.3), jb.presets.paper_friction()
    both = jb.equilibria(jb.Oscillator(0.5, (jb.Belt(0.3, law, 2.0),)))
    assert float(jb.equilibria(one).x1[0]) == pytest.approx(float(both.x1[0]), **EXACT)
    assert float(jb.equilibria(one).rate[0]) == pytest.approx(float(both.rate[0]), **EXACT)


def test_a_fixed_point_turns_and_grows_as_its_eigenvalues_say():
    # Five loops from 1e-6 away, to 3e-5 at most: the linear motion, but for squares of that.
    for p in [(0.35, -0.2), (0.15, 0.6)]:
        (point,) = jb.equilibria(jb.presets.class_b(*p))
        value = complex(point.eigenvalues[0])
        T = 5 * 2 * pi / value.imag
        run = oracle.simulate(oracle.class_b(*p), (float(point.x1) + 1e-6, 0.0), T)
        away = run.y_end - np.array([point.x1, 0.0])
        assert away == pytest.approx([1e-6 * np.exp(value.real * T), 0.0], abs=5e-9)


@pytest.mark.parametrize(
    "make, bracket, exact",
    [
        (jb.presets.class_a, (0.1, 0.3), HOPF_A),
        (lambda nu0: jb.presets.class_b(nu0, 0.35), (0.2, 0.3), 0.263654916039),
        (lambda nu0: jb.presets.class_b(nu0, 0.35), (-0.3, -0.2), -0.263654916039),
    ],
)
def test_hopf_points_of_the_paper(make, bracket, exact):
    # 12 digits are known; the rate is monotone within the bracket.
    value = brentq(lambda nu0: float(jb.equilibria(make(nu0)).rate[0]), *bracket, xtol=1e-14)
    assert value == pytest.approx(exact, abs=1e-12)


# --- contact edges: classes (c) and (d), and more belts -------------------------------------------


def check_against_foci(points, osc):
    """Where the oracle sees orbits loop, and how fast they grow there."""
    expected = oracle_cycles.foci(osc)
    points = jax.tree.map(lambda leaf: leaf[points.kind != SADDLE], points)
    assert np.sum(points.kind > 0) == len(expected)
    for i, (x1, kind) in enumerate(expected):
        assert points.x1[i] == pytest.approx(x1, **EXACT)
        edges = {b.lower for b in osc.belts} | {b.upper for b in osc.belts}
        left = x1 if kind == "focus" else np.nextafter(x1, -inf)
        codes = [
            -2 if left < b.lower else 2 if left > b.upper else np.sign(b.velocity)
            for b in osc.belts
        ]
        assert list(points.modes[i]) == codes
        if kind == "focus":
            trace = oracle_cycles.trace(osc, x1)
            root = np.sqrt(max(trace**2 / 4 - 1, 0.0))
            assert points.kind[i] == FIXED_POINT
            assert points.jacobian[i, 1, 1] == pytest.approx(trace, **EXACT)
            assert points.rate[i] == pytest.approx(trace / 2 + root, **EXACT)
        else:
            assert points.kind[i] == PSEUDO_FOCUS and x1 in edges
            rate = oracle_cycles.pseudo_focus_rate(osc, x1)
            assert points.rate[i] == pytest.approx(rate, **EXACT)
            assert np.all(np.isnan(points.jacobian[i])) and np.all(np.isnan(points.eigenvalues[i]))
        assert points.stable[i] == (points.rate[i] < 0)
    return [kind for _, kind in expected]


def test_classes_c_and_d_have_what_the_oracle_finds():
    p = random_class_cd(np.random.default_rng(4), 240)
    points = jax.device_get(batched(free_class_d)(p))
    kinds = [
        check_against_foci(jax.tree.map(lambda leaf, i=i: leaf[i], points), oracle.class_d(*row))
        for i, row in enumerate(p)
    ]
    # In three zones up to three points; pseudo-foci exclude the fixed points next to them.
    assert max(map(len, kinds)) == 3 and sum("pseudo_focus" in k for k in kinds) > 40


def three_belts(zeta, omega, *p):
    """Three laws, three intervals; p: velocities, loads, widths of the intervals, their middles."""
    nu, u0, width, middle = p[0:3], p[3:6], p[6:9], p[9:12]
    laws = (jb.Conti(1.0, 0.6, 10.0, 0.1), jb.Coulomb(1.0, 0.7), jb.Stribeck(1.2, 0.5, 0.3))
    belts = [jb.Belt(*b, lower=m - w, upper=m + w) for *b, w, m in zip(nu, laws, u0, width, middle)]
    return jb.Oscillator(zeta, tuple(belts), omega)


def oracle_three_belts(zeta, omega, *p):
    nu, u0, width, middle = p[0:3], p[3:6], p[6:9], p[9:12]
    laws = (
        oracle.conti(1.0, 0.6, 10.0, 0.1),
        oracle.coulomb(1.0, 0.7),
        oracle.stribeck(1.2, 0.5, 0.3),
    )
    belts = [
        oracle.Belt(v, *law, load, m - w, m + w)
        for v, law, load, w, m in zip(nu, laws, u0, width, middle)
    ]
    return oracle.Oscillator(zeta, tuple(belts), omega)


@pytest.mark.slow(first=True)
def test_three_belts_of_three_laws_in_seven_zones():
    rng = np.random.default_rng(7)
    low = [0.0, 0.5] + 3 * [-0.8] + 3 * [0.3] + 3 * [0.1] + 3 * [-1.0]
    high = [0.8, 2.0] + 3 * [0.8] + 3 * [1.5] + 3 * [1.5] + 3 * [1.0]
    p = rng.uniform(low, high, (200, 14))
    p[::5, 8] = inf  # a belt without edges
    points = jax.device_get(batched(three_belts)(p))
    kinds = [
        check_against_foci(
            jax.tree.map(lambda leaf, i=i: leaf[i], points), oracle_three_belts(*row)
        )
        for i, row in enumerate(p)
    ]
    assert max(map(len, kinds)) >= 3 and sum("pseudo_focus" in k for k in kinds) > 40


# What is listed as stable is where runs end, and nothing else is. nu0, nu1, sigma0, sigma1.
BRUTE_FORCE = [
    (0.40, 0.45, 0.80, 0.80),  # (c): a stable focus
    (-0.45, 0.50, -0.10, -0.10),  # (c): two
    (0.40, -0.45, 0.10, 0.10),  # (c): a stable pseudo-focus
    (0.12, -0.15, 0.10, 0.10),  # (c): an unstable one
    (-0.50, 0.55, -0.40, 0.30),  # (d): three stable foci
    (0.50, -0.30, -0.20, 0.60),  # (d): one, where both belts touch
    (0.15, -0.12, -0.90, 0.90),  # (d): an unstable one there
    (0.45, 0.50, 0.75, 0.90),  # (d): a stable focus and a stable pseudo-focus
]


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("p", BRUTE_FORCE)
def test_long_runs_end_where_the_stable_equilibria_are(p):
    osc = oracle.class_d(*p)
    points = [(float(e.x1), bool(e.stable)) for e in jb.equilibria(free_class_d(*p))]
    for x1, stable in points:
        ends = rest(osc, (x1 + 0.01, 0.005))
        assert (ends == pytest.approx(x1, abs=SETTLED)) if stable else (ends != x1), (x1, ends)
    for start in [(1.5, 0.0), (-0.9, 0.3)]:
        end = rest(osc, start)
        assert end is None or any(s and abs(end - x1) < SETTLED for x1, s in points), (start, end)


def rest(osc, start, T=90.0):
    """Where a run comes to rest, or None. The slowest point above halves its distance in 6."""
    run = oracle.simulate(osc, start, T, focus_speed=5e-3)
    if run.status == "pseudo_focus":
        return run.y_end[0]
    last = np.array([run.at(t) for t in np.linspace(T - 7, T, 30)])
    return run.y_end[0] if np.ptp(last, axis=0).max() < SETTLED else None


@pytest.mark.parametrize("nu, speeds", [(0.3, (0.02, 0.005)), (0.1, (0.005, 0.02))])
def test_rate_of_a_pseudo_focus_is_that_of_its_crossings(nu, speeds):
    (point,) = jb.equilibria(jb.presets.class_c(nu, -nu, 0.1))
    assert point.kind == PSEUDO_FOCUS and point.stable == (nu > 0.2)
    assert list(point.modes) == [1, -2]
    start, end = speeds
    T = 1.2 * log(end / start) / float(point.rate)
    run = oracle.simulate(oracle.class_c(nu, -nu, 0.1), (0.1, start), T, focus_speed=0.0)
    passed = [e for e in run.events if (abs(e.x2) <= end) == (end < start) and e.kind == "EDGE"]
    # x2 behaves like exp(rate t) to the first order in x2.
    assert log(abs(passed[0].x2) / start) / passed[0].t == pytest.approx(
        float(point.rate), rel=2 * max(speeds)
    )


def test_a_belt_at_rest_ends_a_pseudo_focus_in_finite_time():
    law = jb.presets.paper_friction()
    osc = jb.Oscillator(
        0.5, (jb.Belt(0.0, law, upper=-1.2), jb.Belt(-0.3, law, load=2.0, lower=-1.2))
    )
    (point,) = jb.equilibria(osc)
    assert (point.kind, point.x1, point.rate) == (PSEUDO_FOCUS, -1.2, -inf) and point.stable
    b0, b1 = oracle.class_c(0.0, -0.3, -1.2).belts
    slow = oracle.Oscillator(0.5, (b0, oracle.Belt(-0.3, b1.mu, 1.0, 2.0, -1.2, inf)))
    run = oracle.simulate(slow, (-1.2, 0.05), 9.0, max_events=21)
    assert run.sequence[1:] == ((("CROSS", 0), ("EDGE", 0), ("EDGE", 0)) * 7)[:20]
    # Each loop multiplies x2, and so the time that the next one takes, by (out/in)^(1/2), with the
    # accelerations 1.2 - 1 and 1.2 + 1 left of the edge: a geometric series.
    ratio = sqrt(0.2 / 2.2)
    one, two, three = run.events[14], run.events[17], run.events[20]
    assert three.x2 / two.x2 == pytest.approx(ratio, rel=1e-4)
    assert (three.t - two.t) / (two.t - one.t) == pytest.approx(ratio, rel=1e-3)


def test_a_fixed_point_on_an_edge_is_listed_once_with_its_zone():
    law = jb.Conti(0.5, 0.5, 10.0)
    left = jb.Oscillator(0.5, (jb.Belt(0.3, law, upper=0.5), jb.Belt(-0.3, law, lower=0.5)))
    right = jb.Oscillator(0.5, (jb.Belt(0.3, law, upper=-0.5), jb.Belt(-0.3, law, lower=-0.5)))
    for osc, x1, modes in [(left, 0.5, [1, -2]), (right, -0.5, [2, -1])]:
        (point,) = jb.equilibria(osc)
        assert (point.kind, point.x1) == (FIXED_POINT, x1) and list(point.modes) == modes


def test_free_flight_has_its_fixed_point_at_the_unloaded_spring():
    law = jb.presets.paper_friction()
    points = jb.equilibria(jb.Oscillator(0.5, (jb.Belt(0.3, law, lower=0.2),)))
    assert points.kind.tolist() == [FIXED_POINT, SADDLE, FIXED_POINT]
    assert points.x1 == pytest.approx([0.0, 0.2, 0.7], **EXACT)
    assert points.modes.tolist() == [[-2], [-2], [1]]
    assert points.rate == pytest.approx([-0.25, inf, (-0.5 + 4 / 16) / 2], **EXACT)


# --- belts at rest: segments ----------------------------------------------------------------------

PULL = 0.6 + 0.4 / 4  # of a belt at 0.3
AT_REST = {
    "one belt": (oracle.class_a(0.0), jb.presets.class_a(0.0), [(-1, 1)]),
    "one of two": (oracle.class_b(0.0, 0.3), jb.presets.class_b(0.0, 0.3), [(PULL - 1, PULL + 1)]),
    "both": (oracle.class_b(0.0, 0.0), jb.presets.class_b(0.0, 0.0), [(-2, 2)]),
    "cut off": (oracle.class_c(0.3, 0.0, 0.1), jb.presets.class_c(0.3, 0.0, 0.1), [(0.1, 1)]),
    "pieces": (
        oracle.class_c(0.0, 0.0, 0.2),
        jb.presets.class_c(0.0, 0.0, 0.2),
        [(-1, 0.2), (0.2, 1)],
    ),
    "and a point": (
        oracle.class_d(0.0, 0.3, -0.2, 0.5),
        jb.presets.class_d(0.0, 0.3, -0.2, 0.5),
        [(-1, -0.2), (-0.2, 0.5), (PULL, PULL)],
    ),
}


@pytest.mark.parametrize("case", AT_REST)
def test_a_mass_at_rest_on_a_segment_stays_and_beside_it_leaves(case):
    slow, osc, expected = AT_REST[case]
    points = jb.equilibria(osc)
    ends = np.column_stack([points.x1_lower, points.x1_upper])
    assert ends == pytest.approx(np.array(expected), **EXACT)
    for point, (lower, upper) in zip(points, expected):
        assert point.stable
        assert point.x1 == pytest.approx((lower + upper) / 2, **EXACT)
        assert point.kind == (SEGMENT if lower < upper else FIXED_POINT)
        if lower == upper:
            continue
        assert np.isnan(point.rate) and np.all(np.isnan(point.jacobian))
        assert [c == 0 for c in point.modes] == [
            b.velocity == 0 and b.lower <= lower and upper <= b.upper for b in slow.belts
        ]
        for end, outward in [(lower, -1), (upper, 1)]:
            held = oracle.simulate(slow, (end - outward * 1e-6, 0.0), 5.0)
            assert held.events == [] and tuple(held.y_end) == (end - outward * 1e-6, 0.0)
            outside = end + outward * 1e-6
            if not any(a <= outside <= b for a, b in expected):
                assert oracle.simulate(slow, (outside, 0.0), 5.0).at(1e-4)[1] != 0


def test_loads_and_static_limits_make_the_length_of_a_segment():
    laws = jb.Coulomb(1.5, 0.6), jb.Stribeck(0.8, 0.5, 0.2), jb.Conti(0.7, 0.5, 3.0)
    belts = [jb.Belt(v, law, u0) for v, law, u0 in zip((0.0, -0.4, 0.0), laws, (0.5, 2.0, 3.0))]
    (point,) = jb.equilibria(jb.Oscillator(0.1, tuple(belts), 1.7))
    pull, held = -2 * (0.5 + 0.3 * np.exp(-2)), 0.5 * 1.5 + 3 * 0.7
    assert (point.x1, point.x1_lower, point.x1_upper) == pytest.approx(
        (pull, pull - held, pull + held), **EXACT
    )
    assert point.modes.tolist() == [0, -1, 0] and point.stable


def test_a_segment_beyond_the_kinetic_friction_holds_but_does_not_attract():
    # Contact from 0.8 on: static friction 1 holds x1 = 0.9, kinetic friction 0.6 does not stop it.
    def both(lower):
        osc = jb.Oscillator(0.5, (jb.Belt(0.0, jb.Coulomb(1.0, 0.6), lower=lower),))
        slow = oracle.Oscillator(0.5, (oracle.Belt(0.0, *oracle.coulomb(1.0, 0.6), lower=lower),))
        return jb.equilibria(osc), slow

    points, slow = both(0.8)
    assert points.kind.tolist() == [FIXED_POINT, SEGMENT] and points.stable.tolist() == [
        True,
        False,
    ]
    assert (points.x1_lower[1], points.x1_upper[1]) == (0.8, 1.0)
    assert oracle.simulate(slow, (0.9, 0.0), 20.0).events == []
    assert oracle.simulate(slow, (0.9, -1e-4), 20.0).y_end[0] < 0.1
    points, slow = both(0.4)
    assert points.stable.tolist() == [True, True]
    assert oracle.simulate(slow, (0.5, -1e-4), 20.0).mode_end == (0,)


def test_a_belt_at_rest_that_holds_nothing_makes_a_fixed_point():
    # mu = 0.6 - 0.6/(1 + 10 r) starts from 0 with slope 6: a damper.
    (point,) = jb.equilibria(jb.Oscillator(0.5, (jb.Belt(0.0, jb.Conti(0.0, 0.6, 10.0)),)))
    assert (point.kind, point.x1) == (FIXED_POINT, 0) and point.stable
    assert np.sum(point.eigenvalues).real == pytest.approx(-6.5, **EXACT)
    (point,) = jb.equilibria(jb.Oscillator(0.5, (jb.Belt(0.0, jb.Coulomb(1.0, 0.6), load=0.0),)))
    assert point.kind == FIXED_POINT and point.rate == pytest.approx(-0.25, **EXACT)


# --- transformations ------------------------------------------------------------------------------


def test_a_batch_is_a_loop_with_padding():
    p = random_class_cd(np.random.default_rng(11), 240)
    p[::4, 0] = 0.0
    points = jax.device_get(batched(free_class_d)(p))
    assert points.x1.shape == (240, 9) and points.jacobian.shape == (240, 9, 2, 2)
    for i, row in enumerate(p[:40]):
        one = jb.equilibria(free_class_d(*row))
        n = len(one)
        assert n > 0
        for single, padded in zip(jax.tree.leaves(one), jax.tree.leaves(points)):
            inexact = single.dtype.kind in "fc"
            # A batch is another program, which some versions of XLA round otherwise.
            rounding = 1e-14 if inexact else 0.0
            np.testing.assert_allclose(padded[i, :n], single, rtol=rounding, strict=True)
            absent = padded[i, n:]
            assert np.all(np.isnan(absent)) if inexact else not np.any(absent)


def test_nothing_raises_under_jit():
    bad = jax.jit(lambda nu: jb.equilibria(jb.presets.class_a(nu)))(jnp.nan)
    assert not np.any(bad.kind) and np.all(np.isnan(bad.x1)) and not np.any(bad.stable)


@pytest.mark.slow(first=True)
def test_derivatives_of_a_fixed_point_are_those_of_the_formulas():
    _, nu, mus, p1, p2, p3 = p = (0.4, 0.3, 1.1, 0.5, 0.2, 8.0)

    def position_and_rate(p):
        points = jb.equilibria(one_belt(*p))
        return jnp.stack([points.x1[0], points.rate[0]])

    s = 1 + p3 * nu
    expected = [
        [
            0,
            -(mus - p1) * p3 / s**2 + 2 * p2 * nu,
            1 / s,
            1 - 1 / s,
            nu**2,
            -(mus - p1) * nu / s**2,
        ],
        [
            -0.5,
            -((mus - p1) * p3**2) / s**3 - p2,
            p3 / s**2 / 2,
            -p3 / s**2 / 2,
            -nu,
            (mus - p1) * (1 / s**2 - 2 * p3 * nu / s**3) / 2,
        ],
    ]
    both = jax.jit(lambda p: [way(position_and_rate)(p) for way in (jax.jacfwd, jax.jacrev)])
    for found in both(jnp.array(p)):
        assert np.asarray(found) == pytest.approx(np.array(expected), **EXACT)


@pytest.mark.slow(first=True)
def test_derivatives_of_a_pseudo_focus_agree_with_differences():
    def first_row(p):
        point = jb.equilibria(jb.presets.class_c(*p))[0]
        return point.rate, point.x1

    p = jnp.array([0.3, -0.25, 0.1])
    gradient, edge = jax.jit(jax.jacrev(first_row))(p)
    for i in range(3):
        at = lambda x, i=i: np.where(np.arange(3) == i, x, np.asarray(p))  # noqa: E731
        value, error = oracle.richardson(
            lambda x, at=at: oracle_cycles.pseudo_focus_rate(oracle.class_c(*at(x)), at(x)[2]),
            float(p[i]),
            1e-3,
        )
        assert gradient[i] == pytest.approx(value, abs=max(1e-9, 10 * error))
    assert edge.tolist() == [0, 0, 1]


@pytest.mark.parametrize(("velocity", "returns"), [(1.0, True), (-1.0, False)])
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_segment_attracts_from_beyond_an_edge_that_pushes_back(velocity, returns, mirrored):
    # Static friction 0.5 holds from the edge at 0.3 to 0.5, kinetic friction 0.25 stops nothing
    # that slips down; beyond the edge the moving belt pushes it up again, or farther down.
    way = -1.0 if mirrored else 1.0
    side, other = ("upper", "lower") if mirrored else ("lower", "upper")
    moving = {"velocity": way * velocity, other: way * 0.3}
    still = {"velocity": 0.0, side: way * 0.3}
    osc = jb.Oscillator(
        1.0,
        (
            jb.Belt(friction=jb.Coulomb(1.0, 1.0), **moving),
            jb.Belt(friction=jb.Coulomb(0.5, 0.25), **still),
        ),
    )
    slow = oracle.Oscillator(
        1.0,
        (
            oracle.Belt(moving["velocity"], *oracle.coulomb(1.0, 1.0), **{other: way * 0.3}),
            oracle.Belt(0.0, *oracle.coulomb(0.5, 0.25), **{side: way * 0.3}),
        ),
    )
    points = jb.equilibria(osc)
    (row,) = np.flatnonzero(np.asarray(points.kind) == SEGMENT)
    assert sorted(way * np.array([points.x1_lower[row], points.x1_upper[row]])) == [0.3, 0.5]
    assert bool(points.stable[row]) == returns
    end = oracle.simulate(slow, (way * 0.31, way * -1e-3), 60.0).y_end[0]
    assert (0.3 <= way * end <= 0.5) == returns


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_fixed_point_at_the_end_of_a_segment_is_that(mirrored):
    """No belt touches to the left of 0, where the spring is at rest, and one at rest holds from
    there on: what comes to rest at 0 is held."""
    side = {"upper": 0.0} if mirrored else {"lower": 0.0}
    osc = jb.Oscillator(0.25, (jb.Belt(0.0, jb.Conti(1.0, 0.6, 10.0), **side),))
    points = jb.equilibria(osc)
    assert points.kind.tolist() == [SEGMENT]
    assert sorted([abs(points.x1_lower[0]), abs(points.x1_upper[0])]) == [0.0, 1.0]


@pytest.mark.slow(first=True)
def test_derivatives_of_the_ends_of_a_segment():
    def ends(static, load, nu, edge):
        law = jb.Conti(static, 0.6, 10.0)
        belts = (jb.Belt(0.0, law, load), jb.Belt(nu, jb.presets.paper_friction(), lower=edge))
        points = jb.equilibria(jb.Oscillator(0.5, belts))
        return jnp.stack([points.x1_lower, points.x1_upper])[:, :2]

    at = tuple(map(jnp.asarray, (1.1, 0.8, 0.3, 0.2)))
    assert np.asarray(ends(*at)) == pytest.approx(np.array([[-0.88, 0.2], [0.2, 1.58]]), **EXACT)
    gradient = jax.jit(jax.jacrev(ends, argnums=(0, 1, 2, 3)))(*at)
    expected = [
        [[-0.8, 0], [0, 0.8]],
        [[-1.1, 0], [0, 1.1]],
        [[0, 0], [0, -4 / 16]],
        [[0, 1], [1, 0]],
    ]
    assert np.asarray(gradient) == pytest.approx(np.array(expected), **EXACT)


@pytest.mark.slow(first=True)
def test_every_derivative_is_a_number_though_edges_are_infinite():
    osc = jb.presets.class_d(-0.5, 0.55, -0.4, 0.3)
    fixed = np.flatnonzero(jb.equilibria(osc).kind == FIXED_POINT)

    assert fixed.tolist() == [0, 2, 4]

    def total(osc):
        points = jb.equilibria(osc)
        numbers = points.x1, points.rate, jnp.imag(points.eigenvalues[:, 0])
        return sum(jnp.sum(leaf[fixed]) for leaf in numbers)

    gradient = jax.jit(jax.grad(total))(osc)
    assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(gradient))


# --- the Hopf point -------------------------------------------------------------------------------


def test_lyapunov_coefficient_of_the_paper():
    # a = F'''/16 with F = mu(nu - x2): 6 (mus - p1) p3^3 / (1 + p3 nu)^4 / 16, 1 + p3 nu = 8^.5
    (a,) = jb.lyapunov_coefficient(jb.presets.class_a(HOPF_A))
    assert a == pytest.approx(6 * 0.4 * 1000 / 64 / 16, **EXACT)


def test_lyapunov_coefficient_is_half_of_kuznetsovs():
    rng = np.random.default_rng(3)
    rows = [(rng.uniform(0.5, 2.0), *draw_belts(rng, (2,)).ravel()) for _ in range(6)]
    rows[0] = (1.0, 0.263654916039, 1.0, 0.6, 0.0, 10.0, 1.0, 0.35, 1.0, 0.6, 0.0, 10.0, 1.0)
    rows = [(pull_and_trace(0.0, *row)[1], *row) for row in rows]  # damping that makes the trace 0
    many = jax.jit(jax.vmap(lambda p: jb.lyapunov_coefficient(two_belts(*p))))(np.array(rows))
    assert many.shape == (6, 9) and np.all(np.isnan(many[:, 1:]))
    for row, a in zip(rows, np.asarray(many[:, 0])):
        zeta, omega, *belts = row
        slow = [
            oracle.Belt(nu, *oracle.conti(mus, p1, p3, p2), u0)
            for nu, mus, p1, p2, p3, u0 in np.reshape(belts, (2, 6))
        ]
        signs = tuple(np.sign(b.velocity) for b in slow)
        field = oracle.acceleration(oracle.Oscillator(zeta, tuple(slow), omega), signs)
        # Third differences at 1e-3, extrapolated: about 1e-6 of truncation, 1e-7 of rounding.
        expected = kuznetsov(field, pull_and_trace(*row)[0]) / 2
        assert a == pytest.approx(expected, rel=1e-5, abs=1e-6)
    assert rows[0][0] == pytest.approx(0.5) and many[0, 0] > 0  # class (b): subcritical


def kuznetsov(x2_prime, x1):
    """l1 = Re(i g20 g11 + w g21) / (2 w^2), eq. (3.20) there, from differences of the field."""

    def differences(order, h):
        """All partial derivatives of x2' of this order, as a symmetric array."""
        out = np.zeros((2,) * order)
        for axes in np.ndindex(*out.shape):
            for signs in np.ndindex(*out.shape):
                s = 1 - 2 * np.array(signs)
                y = np.zeros(2)
                for axis, sign in zip(axes, s):
                    y[axis] += sign * h
                out[axes] += np.prod(s) * x2_prime(x1 + y[0], y[1]) / (2 * h) ** order
        return out

    def partials(order, h=1e-3):
        coarse, middle, fine = (differences(order, h * f) for f in (4, 2, 1))
        better = [(4 * middle - coarse) / 3, (4 * fine - middle) / 3]
        return (16 * better[1] - better[0]) / 15

    matrix = np.array([[0, 1], partials(1)])
    values, right = np.linalg.eig(matrix)
    w, q = np.imag(values[0]), right[:, 0]  # of unit length
    if w < 0:
        w, q = -w, q.conj()
    transposed, left = np.linalg.eig(matrix.T)
    p = left[:, np.argmin(np.imag(transposed))]
    p = p / np.vdot(p, q).conj()
    second, third = partials(2), partials(3)

    def form(*vectors):
        value = {2: second, 3: third}[len(vectors)].astype(complex)
        for v in vectors:
            value = np.tensordot(value, v, axes=(0, 0))
        return p[1].conj() * value

    bar = q.conj()
    g20, g11, g21 = form(q, q), form(q, bar), form(q, q, bar)
    return (1j * g20 * g11 + w * g21).real / (2 * w**2)


def test_lyapunov_coefficient_gives_the_amplitude_of_the_unstable_cycle():
    (a,) = jb.lyapunov_coefficient(jb.presets.class_a(HOPF_A))
    ratios = []
    for d in (4e-4, 8e-4):
        half_trace = float(jb.equilibria(jb.presets.class_a(HOPF_A + d)).rate[0])
        cycle = oracle_cycles.unstable_cycle(oracle.class_a(HOPF_A + d), samples=6)
        radius = (cycle.x1_max - cycle.x1_min) / 2
        ratios.append(radius**2 / (-half_trace / float(a)))
    # Exact at the Hopf point; on the way there the error is linear in the distance.
    assert 2 * ratios[0] - ratios[1] == pytest.approx(1, abs=1e-4)
    assert ratios == pytest.approx([1, 1], abs=1e-2)


class Cubic(jb.AbstractFriction):
    """1 - r + r^3: a law of one's own, with a supercritical Hopf point."""

    static: jax.Array

    def mu(self, speed):
        return self.static - speed + speed**3


@pytest.mark.slow(first=True)
def test_a_law_of_ones_own_and_a_supercritical_point():
    nu, half_trace = 0.3, 0.005
    zeta = 1 - 3 * nu**2 - 2 * half_trace
    osc = jb.Oscillator(zeta, (jb.Belt(nu, Cubic(jnp.asarray(1.0))),))
    (point,) = jb.equilibria(osc)
    assert point.x1 == pytest.approx(1 - nu + nu**3, **EXACT)
    assert point.rate == pytest.approx(half_trace, **EXACT) and not point.stable
    (a,) = jb.lyapunov_coefficient(osc)
    assert a == pytest.approx(-6 / 16, **EXACT)
    radius = sqrt(-half_trace / float(a))
    belt = oracle.Belt(nu, lambda r: 1 - r + r**3, 1.0)
    run = oracle.simulate(oracle.Oscillator(zeta, (belt,)), (float(point.x1) + radius, 0.0), 300.0)
    x1 = [loop.x1 for arc in run.arcs for loop in arc.loops if loop.axis == 0 and loop.t > 280]
    # The cycle attracts like exp(-2 half_trace t): of an error of a hundredth 5 % are left.
    assert np.ptp(x1) / 2 == pytest.approx(radius, rel=2e-2)


#: Damping 0 and friction that does not depend on the speed; on both sides of an edge; laws whose
#: sum is even in the velocity: c - 0.05 x2^2 (damping 0), and a constant (damping 4 * 0.05).
CENTRES = {
    "constant": (0.0, jb.Belt(2.0, jb.Conti(0.6, 0.6, 10.0))),
    "an edge": (
        0.0,
        jb.Belt(2.0, jb.Coulomb(0.8, 0.6), upper=0.1),
        jb.Belt(-2.0, jb.Coulomb(0.8, 0.5), lower=0.1),
    ),
    "even": (
        0.0,
        jb.Belt(2.0, jb.Conti(0.5, 0.5, 1.0, 0.05)),
        jb.Belt(-1.0, jb.Conti(0.5, 0.5, 1.0, -0.1)),
    ),
    "damped": (
        0.2,
        jb.Belt(1.0, jb.Conti(0.5, 0.5, 1.0, -0.05)),
        jb.Belt(-1.0, jb.Conti(0.5, 0.5, 1.0, -0.05)),
    ),
}


@pytest.mark.parametrize(
    "name",
    # The others take a program each.
    ["constant", *(pytest.param(n, marks=pytest.mark.slow(first=True)) for n in list(CENTRES)[1:])],
)
def test_a_centre_is_neutral(name):
    damping, *belts = CENTRES[name]
    osc = jb.Oscillator(damping, tuple(belts))
    (point,) = jb.equilibria(osc)
    assert point.neutral and not point.stable and abs(float(point.rate)) < 1e-15
    assert repr(point).startswith("Equilibria(neutral ")
    assert point.table().neutral.tolist() == [True]
    (row,) = jb.equilibria(eqx.tree_at(lambda o: o.damping, osc, damping + 1e-9))
    assert row.stable and not row.neutral


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("name", CENTRES)
def test_orbits_around_a_centre_close(name):
    """One loop, and more than the first half of another: from a top it comes back to the top."""
    damping, *belts = CENTRES[name]
    osc = jb.Oscillator(damping, tuple(belts))
    top = float(jb.equilibria(osc).x1[0]) + 0.3
    events = jb.simulate(osc, (top, 0.0), 15.0, ts=np.linspace(0.0, 15.0, 3001))
    assert float(jnp.max(events.ys[1500:, 0])) == pytest.approx(top, abs=1e-5)
    assert jb.find_cycle(osc, (top, 0.0)).status == jb.Status.NEUTRAL


def test_a_point_of_hopf_is_no_centre():
    (point,) = jb.equilibria(jb.presets.class_a(HOPF_A))
    assert abs(float(point.rate)) < 1e-15 and not point.neutral


def test_lyapunov_coefficients_stand_beside_the_equilibria():
    osc = free_class_d(0.0, 0.3, -0.2, 0.5)
    coefficients, kinds = jb.lyapunov_coefficient(osc), jb.equilibria(osc).kind
    assert np.isnan(coefficients).tolist() == [True, True, False]
    assert kinds.tolist() == [SEGMENT, SEGMENT, FIXED_POINT]


# --- at the public edge ---------------------------------------------------------------------------


def test_rows_and_their_texts():
    points = jb.equilibria(free_class_d(0.0, 0.3, -0.2, 0.5))
    assert len(points) == 3 and [float(p.x1) for p in points] == points.x1.tolist()
    assert repr(points[2]) == "Equilibria(stable FIXED_POINT at x1 = 0.7)"
    assert "stable SEGMENT at x1 = -1 to -0.2; stable SEGMENT" in repr(points)
    # As many as above, for one program.
    assert "kind" in repr(batched(free_class_d)(np.zeros((240, 4))))


def test_bad_input_is_named():
    for function in (jb.equilibria, jb.lyapunov_coefficient):
        bad = eqx.tree_at(lambda o: o.damping, jb.presets.class_a(0.1), jnp.asarray(jnp.nan))
        with pytest.raises(ValueError, match="damping must be finite, got nan"):
            function(bad)
        many = jax.vmap(jb.presets.class_a)(jnp.array([0.1, 0.2]))
        with pytest.raises(ValueError, match=r"must be a scalar \(use jax\.vmap"):
            function(many)


# --- on an edge, but for rounding -----------------------------------------------------------------

LAW = jb.Conti(1.0, 0.6, 10.0)
BITS = [-1, 0, 1]  # of the edge


def shifted(x, bits):
    return float(x + bits * np.spacing(x))


@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("damping", [1.05, 1.08])
def test_a_fixed_point_on_an_edge_is_there_whatever_its_last_bit(bits, damping):
    """At 0.8 - 0.65, where beyond the edge a belt pushes back. Loops shrink where the trace of
    the left side is negative: 4 / (1 + 10 * 0.1)^2 + 4 / (1 + 10 * 0.7)^2 = 1.0625."""
    belts = jb.Belt(0.1, LAW, upper=shifted(0.15, bits)), jb.Belt(-0.7, LAW, lower=-0.5)
    osc = jb.Oscillator(damping, belts)
    rests = jb.equilibria(osc)
    assert [one.name for one in map(jb.EquilibriumKind, rests.kind.tolist())] == ["FIXED_POINT"]
    assert float(rests.x1[0]) == pytest.approx(0.15, abs=1e-15)
    assert float(rests.rate[0]) == pytest.approx((1.0625 - damping) / 2, abs=1e-12)
    assert bool(rests.stable[0]) == (damping > 1.0625)


@pytest.mark.slow(first=True)
def test_where_runs_come_to_rest_is_told_though_others_are_near():
    belts = jb.Belt(0.1, LAW, upper=0.15), jb.Belt(-0.7, LAW, lower=-0.5)
    osc = jb.Oscillator(2.0, (*belts, jb.Belt(0.3, LAW, 4.0, lower=1.0)))
    told = jb.basins(osc, x1=np.linspace(0.1, 0.9, 5), x2=np.linspace(-0.2, 0.2, 5))
    assert told.label.attrs["flag_meanings"] == "undecided rest_at_0.15"
    assert bool((told.label == 0).all())


#: One edge of each of two belts, but for rounding.
edges_but_for_rounding = pytest.mark.parametrize(
    "edges", [(0.3, 0.3), (0.3, 0.1 + 0.2), (0.1 + 0.2, 0.3)]
)


def with_edges(edges, damping):
    upper, lower = edges
    belts = jb.Belt(0.1, LAW, upper=upper), jb.Belt(-0.2, LAW, lower=lower)
    return jb.Oscillator(damping, belts)


@edges_but_for_rounding
def test_edges_that_differ_by_rounding_are_one(edges):
    rests = jb.equilibria(with_edges(edges, 0.5))
    assert rests.kind.tolist() == [jb.EquilibriumKind.PSEUDO_FOCUS] and not rests.stable[0]


@pytest.mark.slow(first=True)
@edges_but_for_rounding
def test_edges_that_differ_by_rounding_have_one_pseudo_hopf_point(edges):
    """Around a pseudo-focus with pushes a and traces b of the sides, loops grow where the sum of
    b/a is positive."""
    left, right = 0.8 - 0.3, 0.6 + 0.4 / 3 + 0.3
    zero = (1 / left + 4 / 9 / right) / (1 / left + 1 / right)
    point = jb.refine(jb.PseudoHopf(0), lambda damping: with_edges(edges, damping), at=0.8)
    assert float(point.value) == pytest.approx(zero, abs=1e-13)


def test_what_a_belt_at_rest_holds_in_one_point_is_no_segment():
    held = jb.Belt(0.0, jb.Conti(0.8, 0.8, 10.0), lower=0.0, upper=0.85)
    osc = jb.Oscillator(0.5, (jb.Belt(0.3, jb.Conti(1.2, 0.7, 10.0), 2.0), held))
    rests = jb.equilibria(osc)  # 2 * 0.825 - 0.8 = 0.85
    assert rests.kind.tolist() == [jb.EquilibriumKind.FIXED_POINT]
    assert float(rests.x1[0]) == pytest.approx(1.65, abs=1e-14)


def test_the_end_of_a_segment_is_no_fixed_point():
    belts = jb.Belt(0.1, jb.Conti(0.5, 0.2, 5.0), 0.5), jb.Belt(0.0, LAW, lower=0.2)
    assert jb.equilibria(jb.Oscillator(0.5, belts)).kind.tolist() == [jb.EquilibriumKind.SEGMENT]


def test_a_fixed_point_on_an_edge_is_listed_once():
    assert len(jb.equilibria(jb.presets.class_c(0.3, 0.3, 0.7))) == 1


@pytest.mark.parametrize(("unit", "omega"), [(1.0, 1.0), (3.0, 1.0), (1e5, 1 / 300), (1e5, 7.0)])
def test_a_trace_of_zero_is_zero_in_every_unit(unit, omega):
    """At belt velocity 0.1 friction falls by 1 for each unit of velocity, as much as damping."""
    law = jb.Conti(1.0, 0.6, 10.0 / (unit * omega))
    belt = jb.Belt(0.1 * unit * omega, law, load=0.5 * unit)
    (rest,) = jb.equilibria(jb.Oscillator(1.0, (belt, belt), omega=omega))
    assert rest.kind == FIXED_POINT and abs(rest.rate) < 1e-14
    assert not rest.stable and not rest.neutral
