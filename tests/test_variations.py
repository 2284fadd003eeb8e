"""Whatever a function of a parameter makes of it: what is not one leaf of the oscillator."""

import functools
import math
import time

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest
from compilations import compilations
from where import nu0

import jaxbelt as jb
from jaxbelt import Status
from jaxbelt.model.parameters import leaf_index, vary
from jaxbelt.model.variations import Variation

FIRST = pytest.mark.slow(first=True)
#: Where the fixed point of class (a) changes its stability, eq. (28) of the paper.
HOPF = (np.sqrt(8) - 1) / 10


# --- what it makes --------------------------------------------------------------------------------

OSC = jb.presets.class_d(0.35, -0.25, -0.1, 0.4)


@pytest.mark.parametrize("place", [0, 1, 6, 8, 16, 17])
def test_a_leaf_is_varied_as_by_a_function(place):
    leaf = Variation.of_leaves(OSC, [place])
    made = Variation.of_function(lambda p: vary(OSC, place, p[None]), (0.3,))
    assert leaf.line is not None and made.line is not None
    for value in (-0.7, 0.0, 0.1 + 0.2):
        expected = vary(OSC, place, jnp.asarray([value]))
        for one in (leaf, made):
            # To the last bit, edges at infinity included.
            found = jax.tree.leaves(one.oscillator(np.array([value])))
            assert found == jax.tree.leaves(expected)
    # Only what depends on it is lost where it is not a number.
    lost = [bool(np.isnan(x)) for x in jax.tree.leaves(leaf.oscillator(np.array([np.nan])))]
    assert [i for i, nan in enumerate(lost) if nan] == [place]


def test_a_function_that_is_not_linear_has_a_tangent():
    made = Variation.of_function(lambda p, q: jb.presets.class_d(p * q, q**2, -p, p), (0.3, 0.5))
    assert made.line is None and made.names == ("p", "q")
    at = np.array([0.3, 0.5])
    family, step = made.family(at), np.array([1e-5, -2e-5])

    def error(values):
        pairs = zip(
            *map(jax.tree.leaves, (family.at(values), made.oscillator(values))), strict=True
        )
        return max(0.0 if a == b else abs(float(a - b)) for a, b in pairs)

    # The second derivatives are one and two.
    assert error(at) == 0 and 1e-10 < error(at + step) < 5e-10
    held = made.held(0, 0.3)
    assert held.names == ("q",) and nu0(held.oscillator([0.7])) == pytest.approx(0.21, rel=1e-15)


def test_arguments_that_are_left():
    left = functools.partial(jb.presets.class_c, nu1=0.3)
    made = Variation.of_function(left, (0.1, 0.2))
    assert made.names == ("nu0", "sigma")
    assert made.oscillator(np.array([0.1, 0.2])).belts[1].lower == 0.2
    made = Variation.of_function(lambda *p: jb.presets.class_b(*p), (0.1, 0.2))
    assert made.names == ("p", "q")


def test_where_an_oscillator_lies():
    span = np.array([[-1.0, 1.0], [-1.0, 1.0]])
    straight = Variation.of_function(lambda s, nu: jb.presets.class_c(nu, 0.3, s), (0.1, 0.2))
    found = straight.values_of(jb.presets.class_c(0.47, 0.3, -0.1), span)
    assert np.asarray(found).tolist() == [-0.1, 0.47]
    assert straight.values_of(jb.presets.class_c(0.47, 0.31, -0.1), span) is None
    assert straight.values_of(jb.presets.class_a(0.47), span) is None
    bent = Variation.of_function(lambda p, r: jb.presets.class_b(p**2, p**2 * r), (0.5, 0.5))
    osc = jb.presets.class_b(0.36, -0.09)
    for sign in (1, -1):
        found = bent.values_of(osc, span, np.array([0.5 * sign, 0.0]))
        assert found == pytest.approx([0.6 * sign, -0.25], abs=1e-15)
    found = np.asarray(bent.values_of(osc, span))
    assert np.abs(found) == pytest.approx([0.6, 0.25], abs=1e-15)


def test_where_belts_coincide():
    def coincidences(make, first=-1.0, last=1.0):
        return Variation.of_function(make, (first,)).coincidences(first, last)

    assert coincidences(lambda s: jb.presets.class_b(s, 0.35)) == {0.35: [(0, 1)], 0.0: [(0,)]}
    assert coincidences(lambda s: jb.presets.class_b(s, 2 * s)) == {0.0: [(0, 1), (0,), (1,)]}
    assert coincidences(lambda s: jb.presets.class_c(0.3, 0.3, s)) == {}
    found = coincidences(lambda s: jb.presets.class_b(s**2, 0.25))
    at = sorted((round(value, 9), which) for value, which in found.items())
    assert at == [(-0.5, [(0, 1)]), (0.0, [(0,)]), (0.5, [(0, 1)])]
    found = coincidences(lambda s: jb.presets.class_b(jnp.sin(4 * s), jnp.sin(4 * s)))
    assert sorted(found) == pytest.approx([-np.pi / 4, 0, np.pi / 4], abs=1e-14)
    assert all(which == [(0,), (1,)] for which in found.values())


# --- points ---------------------------------------------------------------------------------------


def shared_load(load, nu=0.54):
    law = jb.Conti(1.0, 0.6, 10.0)
    return jb.Oscillator(0.5, (jb.Belt(nu, law, load), jb.Belt(0.35, law, load)))


@pytest.mark.parametrize(
    ("make", "at", "expected"),
    [
        pytest.param(lambda s: jb.presets.class_a(2 * s), 0.1, HOPF / 2, id="half"),
        pytest.param(lambda s: jb.presets.class_a(s**2), 0.4, np.sqrt(HOPF), id="root"),
        pytest.param(lambda s: jb.presets.class_a(s**2), -0.4, -np.sqrt(HOPF), id="other root"),
        pytest.param(lambda s: jb.presets.class_a(0.1 / s), 0.5, 0.1 / HOPF, id="inverse"),
        pytest.param(lambda s: jb.presets.class_a(jnp.exp(-s)), 1.5, -np.log(HOPF), id="logarithm"),
        # Of both belts the slopes add up to the damping.
        pytest.param(
            shared_load, 0.6, 0.5 / (4 / 6.4**2 + 4 / 4.5**2), id="shared load", marks=FIRST
        ),
        pytest.param(
            *(lambda r: jb.presets.class_b(0.3, 0.3 * r), 0.5, (np.sqrt(4 / 0.25) - 1) / 3),
            id="ratio",
            marks=FIRST,
        ),
    ],
)
def test_hopf_points_in_closed_form(make, at, expected):
    point = jb.refine(jb.Hopf(), make, at=at)
    assert point.status == Status.OK and point.error < 1e-13
    assert point.value == pytest.approx(expected, rel=1e-14)
    made = make(point.value)
    np.testing.assert_allclose(jax.tree.leaves(point.oscillator), jax.tree.leaves(made), atol=2e-14)


@pytest.mark.slow(first=True)
def test_its_derivatives_and_its_batches():
    """Of class (a), 1 + p3 s^2 = sqrt(p3 (mus - p1)/zeta)."""

    def value(zeta, at):
        law = jb.Conti(1.0, 0.6, 10.0)
        return jb.refine(
            jb.Hopf(), lambda s: jb.Oscillator(zeta, (jb.Belt(s**2, law),)), at=at
        ).value

    zetas = jnp.array([0.45, 0.5, 0.55])
    batch = jax.jit(jax.vmap(jax.value_and_grad(value), (0, None)))
    for at in (0.4, 0.43):
        values, slopes = batch(zetas, at)
        squares = (2 / np.sqrt(zetas) - 1) / 10
        np.testing.assert_allclose(values, np.sqrt(squares), rtol=1e-13)
        np.testing.assert_allclose(slopes, -0.05 * zetas**-1.5 / np.sqrt(squares), rtol=1e-11)


@pytest.mark.slow(first=True)
def test_a_load_shared_by_two_belts():
    def other(load):
        mu, static = oracle.conti(1.0, 0.6, 10.0)
        belts = (oracle.Belt(0.54, mu, static, load), oracle.Belt(0.35, mu, static, load))
        return oracle.Oscillator(0.5, belts, 1.0)

    expected = oracle_cycles.nonsmooth_fold(other, (0.99, 1.02), 1)
    for make, factor in ((shared_load, 1), (lambda s: shared_load(1 / s**2), -2)):
        point = jb.refine(jb.NonsmoothFold(1), make, at=1.001)
        # The oracle integrates to 1e-13; the fold moves by a thirtieth of the load.
        assert float(point.value) ** factor == pytest.approx(expected, abs=1e-10)


def test_a_fold_by_the_square_of_a_velocity_is_that_by_the_velocity():
    point = jb.refine(jb.NonsmoothFold(1), lambda s: jb.presets.class_b(s**2, 0.35), at=0.73)
    assert point.status == Status.OK and point.residual < 1e-12
    assert point.value**2 == pytest.approx(0.538734800481, abs=1e-11)


def sequential(sigma):
    return jb.presets.class_c(0.35, -0.25, sigma)


@pytest.mark.slow(first=True)
def test_both_edges_of_sequential_belts_at_once():
    points = jb.scan(sequential, span=(-1.0, 1.0))
    sigmas = {}

    def other(sigma):
        osc = oracle.class_c(0.35, -0.25, sigma)
        sigmas[id(osc)] = sigma, osc
        return osc

    def from_edge(osc):
        return (sigmas[id(osc)][0], osc.speed(1)), (1, oracle.BELOW)

    expected = [
        # Slip onset on belt 1, and a fixed point of either belt, on the edge.
        (jb.CornerCollision(0), -1 + 0.5 * 0.25),
        (jb.CornerCollision(0), oracle_cycles.corner(other, (-0.8435, -0.841), 1, from_edge)),
        (jb.BoundaryEquilibrium(0), -(0.6 + 0.4 / 3.5)),
        (jb.BoundaryEquilibrium(0), 0.6 + 0.4 / 4.5),
    ]
    assert [point.condition for point in points] == [kind for kind, _ in expected]
    for point, (_, value) in zip(points, expected, strict=True):
        assert point.value == pytest.approx(value, abs=1e-11)
    again = jb.refine(jb.BoundaryEquilibrium(0), sequential, at=0.6)
    assert again.value == pytest.approx(expected[-1][1], abs=1e-13)


@pytest.mark.slow(first=True)
def test_a_path_that_is_not_linear_has_the_points_of_the_straight_one():
    span = (0.2, 0.7)
    straight = jb.scan(jb.presets.class_b(0.3, 0.35), nu0, span, resolution=24)
    ends = math.log(span[0]), math.log(span[1])
    bent = jb.scan(lambda s: jb.presets.class_b(jnp.exp(s), 0.35), span=ends, resolution=24)
    assert [p.condition for p in bent] == [p.condition for p in straight]
    assert [p.kind for p in bent] == ["Hopf", "SlidingExchange", "NonsmoothFold"]
    for one, other in zip(bent, straight, strict=True):
        assert math.exp(one.value) == pytest.approx(float(other.value), abs=1e-11)


@pytest.mark.slow(first=True)
def test_its_diagram_is_named_by_its_argument():
    diagram = jb.bifurcation_diagram(sequential, span=(-0.8, -0.6), rows=9, resolution=8)
    assert diagram.name == "sigma"
    (point,) = diagram.points
    assert point.value == pytest.approx(-(0.6 + 0.4 / 3.5), abs=1e-12)
    assert diagram.oscillator.belts[0].upper == -0.8


# --- curves ---------------------------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_a_curve_in_what_a_function_makes():
    """Class (b) has its Hopf points where the slopes of both laws add up to the damping."""

    def make(p, q):
        return jb.presets.class_b(p, q**2)

    point = jb.refine(jb.Hopf(), lambda p: make(p, 0.6), at=0.25)
    span = ((0.05, 0.7), (0.1, 0.8))
    curve = jb.bifurcation_curve(point, make, span=span, step=0.03)
    assert len(curve) > 20 and curve.names == ("p", "q")
    p, q = curve.path.T
    np.testing.assert_allclose(4 / (1 + 10 * p) ** 2 + 4 / (1 + 10 * q**2) ** 2, 0.5, atol=1e-12)
    assert np.min(np.hypot(p - float(point.value), q - 0.6)) < 1e-15
    kinds = [special.kind for special in curve.special]
    assert kinds == ["EqualVelocities"]
    assert curve.special[0].values == pytest.approx((0.3, np.sqrt(0.3)), abs=1e-12)
    # The other side of the plane, where it is asked for.
    span = ((0.05, 0.7), (-0.8, 0.8))
    other = jb.bifurcation_curve(point, make, span=span, at=(0.26, -0.5), step=0.03, max_points=5)
    assert np.all(other.values[:, 1] < 0)


def test_a_straight_curve_is_that_of_the_leaves():
    point = jb.refine(jb.Hopf(), jb.presets.class_b(0.25, 0.35), where=nu0)
    span = ((0.1, 0.7), (0.1, 0.7))
    both = (nu0, lambda osc: osc.belts[1].velocity)
    one = jb.bifurcation_curve(point, both, span, step=0.05)
    other = jb.bifurcation_curve(point, jb.presets.class_b, span, step=0.05)
    assert np.array_equal(one.path, other.path) and other.names == ("nu0", "nu1")


@pytest.mark.slow
def test_a_map_over_both_edges_has_its_curves():
    axes = {"nu0": np.linspace(0.05, 0.6, 12), "sigma": np.linspace(-1.0, 1.0, 13)}
    found = jb.region_map(functools.partial(jb.presets.class_c, nu1=-0.25), axes, lines=2)
    kinds = {kind for curve in found.curves for kind in curve.kinds}
    assert {"PseudoHopf", "BoundaryEquilibrium", "CornerCollision"} <= kinds
    for curve in found.curves:
        if curve.kinds == ("BoundaryEquilibrium",) * len(curve):
            nu, sigma = curve.values.T
            rests = np.array([0.6 + 0.4 / (1 + 10 * nu), np.full(nu.size, -(0.6 + 0.4 / 3.5))])
            assert np.max(np.min(np.abs(sigma - rests), axis=0)) < 1e-11


# --- one program for all of them ------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_another_function_compiles_nothing():
    def look(make, at):
        jb.refine(jb.Hopf(), make, at=at)
        point = jb.refine(jb.Hopf(), lambda s: make(1.01 * s), at=at)
        span = ((at - 0.1, at + 0.1), (0.3, 0.4))
        jb.bifurcation_curve(
            point,
            lambda p, q: vary(make(1.01 * p), velocity, jnp.asarray(q)[None]),
            span,
            max_points=3,
        )

    def looks(factor):
        look(lambda s: jb.presets.class_b(factor * s, 0.35), 0.27 / factor)
        look(lambda s: jb.presets.class_b(factor * s**2, 0.35), 0.52 / math.sqrt(factor))

    velocity = leaf_index(jb.presets.class_b(0.1, 0.2), lambda osc: osc.belts[1].velocity)
    looks(1.0)
    with compilations() as compiled:
        looks(1.2)
    assert compiled == []


# --- what is impossible ---------------------------------------------------------------------------

MAKE = jb.presets.class_a


IMPOSSIBLE = {
    "both": (lambda p: jb.scan(MAKE, nu0, (0.1, 0.2)), "where must be left out"),
    "both, refine": (lambda p: jb.refine(jb.Hopf(), MAKE, where=nu0, at=0.1), "where must be left"),
    "neither": (lambda p: jb.scan(MAKE(0.2), span=(0.1, 0.2)), "where must be a function"),
    "neither, refine": (lambda p: jb.refine(jb.Hopf(), MAKE(0.2)), "where must be a function"),
    "no span": (lambda p: jb.scan(MAKE), "span must be"),
    "no at": (lambda p: jb.refine(jb.Hopf(), MAKE), "at must be the value"),
    "at infinity": (lambda p: jb.refine(jb.Hopf(), MAKE, at=np.inf), "at must be finite"),
    "at of a leaf": (
        lambda p: jb.refine(jb.Hopf(), MAKE(0.2), where=nu0, at=0.1),
        "at must be left out where osc is an Oscillator",
    ),
    "two arguments": (
        lambda p: jb.scan(jb.presets.class_b, span=(0.1, 0.2)),
        r"osc must be a function of one number .*got one of \(nu0",
    ),
    "one argument": (
        lambda p: jb.bifurcation_curve(p, MAKE, ((0.1, 0.3), (0.1, 0.3))),
        "where must be a function of two numbers",
    ),
    "no oscillator": (
        lambda p: jb.bifurcation_diagram(lambda s: s, span=(0.1, 0.2)),
        "osc must be .* returns an Oscillator, got one that returns",
    ),
    "not differentiable": (
        lambda p: jb.scan(lambda s: MAKE(math.sqrt(s)), span=(0.1, 0.2)),
        "osc must be .* JAX can differentiate",
    ),
    "no difference": (
        lambda p: jb.scan(lambda s: MAKE(0.2), span=(0.1, 0.2)),
        "got one whose argument s makes no difference",
    ),
    "impossible there": (
        lambda p: jb.scan(lambda s: shared_load(s), span=(-0.1, 0.2)),
        "load of belt 0 must be >= 0",
    ),
    "elsewhere": (
        lambda p: jb.bifurcation_curve(
            p, lambda p, q: jb.Oscillator(q, MAKE(p).belts, 2.0), ((0.1, 0.3), (0.1, 0.3))
        ),
        "where must be a function that gives the oscillator of the point",
    ),
    "outside": (
        lambda p: jb.bifurcation_curve(
            p, lambda p, q: jb.Oscillator(q, MAKE(p).belts), ((0.3, 0.4), (0.4, 0.6))
        ),
        "span must be around the point",
    ),
    "batched": (
        lambda p: jb.scan(lambda s: MAKE(jnp.stack([s, s])), span=(0.1, 0.2)),
        "must be a scalar",
    ),
}


@pytest.fixture(scope="module")
def hopf():
    return jb.refine(jb.Hopf(), jb.presets.class_a(0.19), where=nu0)


@pytest.mark.parametrize(("call", "message"), IMPOSSIBLE.values(), ids=IMPOSSIBLE.keys())
def test_what_is_impossible_is_named_before_it_computes(call, message, hopf):
    begin = time.process_time()
    with pytest.raises(ValueError, match=message):
        call(hopf)
    assert time.process_time() - begin < 1.0  # much less than compiling takes
