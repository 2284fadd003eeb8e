"""Connections of saddles of contact edges: against plain integration with SciPy, and relations that
must hold."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxbelt as jb
from jaxbelt import Status
from jaxbelt.bifurcations.connections import courses_of
from jaxbelt.model.variations import varied

NU = 0.5  # of both belts, in opposite directions


def over(sigma1, sigma0=-0.4, nu=NU):
    """Three fixed points, and a saddle on each of the edges between them."""
    return jb.presets.class_d(-nu, nu, sigma0, sigma1)


def beside(nu0):
    """A fixed point on either side of one edge, on which there is a saddle."""
    return jb.presets.class_c(nu0, 0.3, sigma=-0.5)


def slips(y0, belts, *, extrema, zeta=0.5):
    """x1 at an extremum of an orbit, by its number, in one slip mode; belts: (velocity, sign)."""

    def mu(r):
        return 0.4 / (1 + 10 * r) + 0.6

    def field(t, y):
        pull = sum(sign * mu(sign * (nu - y[1])) for nu, sign in belts)
        return [y[1], -y[0] - zeta * y[1] + pull]

    # It begins at one.
    def turns(t, y):
        return y[1] if t > 1e-3 else y[1] + np.sign(field(0.0, y0)[1])

    turns.terminal = extrema
    found = solve_ivp(
        field, (0, 50), y0, "DOP853", events=turns, rtol=1e-13, atol=1e-13, max_step=0.1
    )
    return found.y_events[0][extrema - 1][0]


def miss(sigma1, sigma0=-0.4, nu=NU):
    """How far the orbit from the saddle on the left edge turns from the right one."""
    return slips((sigma0, 0.0), ((-nu, -1), (nu, 1)), extrema=1) - sigma1


@pytest.mark.slow(first=True)
def test_from_one_saddle_to_another():
    wanted = brentq(miss, 0.2, 0.4, xtol=1e-15)
    assert wanted == pytest.approx(0.2910103952526, abs=1e-12)  # known before there was this kind
    point = jb.refine(jb.SaddleConnection(1), over, at=0.3)
    assert point.status == Status.OK and point.value == pytest.approx(wanted, abs=1e-12)
    assert point.residual < 1e-13 and point.error < 1e-12
    # It is no cycle.
    assert point.type == "heteroclinic"
    assert point.cycle.status == Status.EQUILIBRIUM and jnp.isnan(point.cycle.period)
    orbit = point.condition.orbit(point)
    assert orbit[0] == pytest.approx((-0.4, 0.0), abs=1e-12)
    assert orbit[-1] == pytest.approx((wanted, 0.0), abs=1e-12)


@pytest.mark.slow(first=True)
def test_scan_finds_what_changes_no_attractor():
    (point,) = jb.scan(over, span=(0.2, 0.4), resolution=12)
    assert point.condition == jb.SaddleConnection(1, to=0)
    assert point.value == pytest.approx(brentq(miss, 0.2, 0.4, xtol=1e-15), abs=1e-12)


@pytest.mark.slow(first=True)
def test_two_connections_at_one_value():
    """With both edges in a symmetric place: from the left one to the right one, and back."""
    wanted = brentq(lambda s: miss(s, sigma0=-s), 0.5, 0.506, xtol=1e-15)
    points = jb.scan(lambda s: over(s, -s), span=(0.48, 0.51), resolution=4)
    connections = [jb.SaddleConnection(0, to=1), jb.SaddleConnection(1, to=0)]
    assert sorted((one.condition for one in points), key=repr) == connections
    assert [one.value for one in points] == pytest.approx([wanted] * 2, abs=1e-12)


@pytest.mark.slow(first=True)
def test_back_to_the_same_saddle():
    """An unstable cycle ends there, and with it the basin within."""

    def opens(nu0):
        # Down from the saddle, up to the left of it and back: the second extremum is its own.
        return slips((-0.5, 0.0), ((nu0, -1),), extrema=2) + 0.5

    wanted = brentq(opens, -0.2645, -0.2635, xtol=1e-15)
    assert wanted == pytest.approx(-0.263755321469, abs=1e-12)
    for guess in (-0.2636, -0.264):
        point = jb.refine(jb.SaddleConnection(0), beside, at=guess)
        assert point.status == Status.OK and point.value == pytest.approx(wanted, abs=1e-12)
    # The cycle that ends there, beside the point.
    assert point.type == "homoclinic"
    assert point.cycle.multiplier > 1
    near = jb.unstable_cycle(beside(wanted + 1e-7))
    assert near.period == pytest.approx(float(point.cycle.period), abs=1e-5)
    assert jb.unstable_cycle(beside(wanted - 1e-4)).status == Status.NO_UNSTABLE_CYCLE
    # Two belts share the edge.
    other = jb.refine(jb.SaddleConnection(1, to=0), beside, at=-0.264)
    assert other.value == pytest.approx(wanted, abs=1e-12)
    points = jb.scan(beside, span=(-0.27, -0.25), resolution=12)
    kinds = [jb.NonsmoothFold(0), jb.SaddleConnection(0, 0), jb.GrazingEdge(0)]
    assert [one.condition for one in points] == kinds[-len(points) :]
    assert points[-1].value == pytest.approx(-0.252465, abs=1e-6)


@pytest.mark.slow(first=True)
def test_a_separatrix_that_sticks_forgets_where_it_began():
    """From slip onset on belt 1 to the saddle, wherever the orbit begins to stick."""
    # Belt 1 holds its limit, against the damping and belt 0, which slips at a speed of 1.
    x1 = 1.0 - 0.5 * NU - (0.4 / (1 + 10 * 1.0) + 0.6)
    wanted = slips((x1, NU), ((-NU, -1), (NU, 1)), extrema=1)
    for sigma0 in (-0.52, -0.6):
        point = jb.refine(jb.SaddleConnection(1), functools.partial(over, sigma0=sigma0), at=0.5)
        assert point.status == Status.OK and point.value == pytest.approx(wanted, abs=1e-11)


@pytest.mark.slow
def test_the_nearest_of_two_beside_each_other():
    """Both are where an attracting cycle comes to the saddle, so `scan` tells them as grazing."""
    right = jb.Belt(0.4, jb.Conti(1.0, 0.4, 2.0), lower=-0.75, upper=0.73333333333333)

    def make(nu0):
        return jb.Oscillator(0.05, (jb.Belt(nu0, jb.Stribeck(1.0, 0.8, 0.1)), right))

    grazing = [float(one.value) for one in jb.scan(make, span=(-0.486, -0.482))]
    point = jb.refine(jb.SaddleConnection(1, 1), make, at=-0.484831720301)
    assert point.value == pytest.approx(min(grazing), abs=1e-12)


@pytest.mark.slow(first=True)
def test_point_symmetry():
    point = jb.refine(jb.SaddleConnection(1), over, at=0.3)
    mirrored = jb.refine(jb.SaddleConnection(0), lambda s: over(0.4, s), at=-0.3)
    assert mirrored.value == pytest.approx(-float(point.value), abs=1e-13)


def connected(nu, sigma0=-0.4):
    """The edge at which there is the connection."""
    return jb.refine(jb.SaddleConnection(1), lambda s: over(s, sigma0, nu), at=0.3).value


@pytest.mark.slow(first=True)
def test_derivative():
    wanted, _ = oracle.richardson(
        lambda nu: brentq(lambda s: miss(s, nu=nu), 0.2, 0.4, xtol=1e-15), NU, 1e-3
    )
    assert jax.grad(connected)(NU) == pytest.approx(float(wanted), abs=1e-8)


@pytest.mark.slow
def test_a_batch_is_each_of_them():
    edges = jnp.array([-0.42, -0.4, -0.38])
    values = jax.vmap(lambda sigma0: connected(NU, sigma0))(edges)
    alone = [float(connected(NU, float(sigma0))) for sigma0 in edges]
    np.testing.assert_allclose(values, alone, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_beyond_a_connection_its_orbit_leads_elsewhere():
    ends = [jb.simulate(over(s), (-0.4, 1e-9), 200.0).ys[-1, 0] for s in (0.29, 0.292)]
    assert ends[0] == pytest.approx(2 / 3, abs=1e-3) and ends[1] == pytest.approx(0, abs=1e-3)


@pytest.mark.slow
def test_curve_from_one_saddle_to_another():
    point = jb.refine(jb.SaddleConnection(1), over, at=0.3)
    span = ((-0.7, -0.3), (0.0, 1.0))
    curve = jb.bifurcation_curve(
        point, lambda a, b: over(b, a), span=span, at=(-0.4, float(point.value))
    )
    assert np.all(curve.residual < 1e-10)
    sticks, ends = (
        next(one for one in curve.special if one.kind == kind)
        for kind in ("DoubleSliding", "BoundaryEquilibrium")
    )
    # From where it begins to stick on belt 1 it does not depend on where it began, up to where the
    # fixed point to the left of the first edge comes to it: 0.4 / 6 + 0.6 = 2/3.
    assert ends.values[0] == pytest.approx(-2 / 3, abs=1e-12)
    assert ends.values[1] == pytest.approx(sticks.values[1], abs=1e-11)
    assert -0.51 < sticks.values[0] < -0.50


@pytest.mark.slow
def test_a_connection_that_shrinks_to_its_saddle():
    """It ends where the fixed point beside the saddle comes to it with a trace of zero."""

    def make(nu0, sigma):
        return jb.presets.class_c(nu0, 0.3, sigma)

    point = jb.refine(jb.SaddleConnection(0), lambda s: make(-0.25, s), at=-0.52)
    curve = jb.bifurcation_curve(point, make, ((-0.3, -0.1), (-0.9, -0.4)))
    end = curve.special[-1]
    assert end.kind == "BoundaryHopf" and curve.is_named(-1) and end.residual < 1e-13
    hopf = -(np.sqrt(8) - 1) / 10  # eq. (28) of the paper
    expected = hopf, -(0.4 / (1 - 10 * hopf) + 0.6)
    assert end.values == pytest.approx(expected, abs=1e-12)


@pytest.mark.slow(first=True)
def test_no_courses_where_orbits_depend_on_the_parameter_with_jumps():
    """With belts at rest, and laws that jump."""

    def courses(make):
        return courses_of(varied(make, None, (1.0,)).oscillators(np.array([[0.9], [1.1]])))

    law, jumps = jb.Conti(1.0, 0.6, 10.0), jb.Coulomb(1.0, 0.6)

    def with_law(law, nu):
        right = jb.Belt(nu, law, lower=0.0)
        return lambda load: jb.Oscillator(0.5, (jb.Belt(-nu, law, load=load, upper=0.0), right))

    assert [len(one) for one in courses(with_law(law, 0.5))] == [2, 2]
    assert courses(with_law(jumps, 0.5)) == courses(with_law(law, 0.0)) == [(), ()]


@pytest.mark.slow(first=True)
def test_no_saddle_where_a_fixed_point_lies_on_the_edge():
    """On round numbers, but for rounding: it pushes to no side, whatever the damping is; and as the
    other side pushes away, nothing changes where its trace vanishes."""
    first, second = jb.Conti(1.0, 0.6, 10.0), jb.Conti(0.5, 0.2, 5.0)

    def make(damping):
        belts = jb.Belt(-0.4, first, upper=0.6), jb.Belt(0.55, second, lower=-0.4)
        return jb.Oscillator(damping, belts, omega=2.0)

    rests = jb.equilibria(make(0.5))
    assert float(rests[1].x1) == pytest.approx(-0.4, abs=1e-15)
    assert set(rests.kind.tolist()) == {jb.EquilibriumKind.FIXED_POINT}
    assert courses_of(varied(make, None, (1.0,)).oscillators(np.array([[0.36]]))) == [()]
    assert not rests.stable[1] and jb.scan(make, span=(0.35, 0.6), resolution=8) == ()


@pytest.mark.slow(first=True)
def test_no_saddle_no_connection():
    # A pseudo-focus on the edge.
    point = jb.refine(jb.SaddleConnection(0), lambda n: jb.presets.class_c(n, -0.3, 0.0), at=0.3)
    assert point.status == Status.NOT_TOUCHED and jnp.isnan(point.value)


@pytest.mark.slow(first=True)
def test_an_orbit_that_slowly_circles_a_pseudo_focus_stays_between_saddles():
    """Found by a campaign: how many loops it takes until it counts as at rest is no difference."""
    stribeck = jb.Stribeck(1.2156234004882518, 1.0138132582447077, 0.8970527898384911)
    conti = jb.Conti(
        1.0806532617460558, 0.8834968101467371, 2.0580829655030133, 0.08027645786017466
    )

    def at(v):
        belts = (
            jb.Belt(v, stribeck, 1.0736123969087175, upper=0.5890596277834703),
            jb.Belt(-0.6232106467377576, conti, 1.3247909701486493, upper=0.16499225790624839),
        )
        return jb.Oscillator(0.14666389569371077, belts, 1.2720166147779866)

    assert jb.scan(at, span=(0.0032336, 0.0032348), resolution=4) == ()


@pytest.mark.slow(first=True)
def test_belts_that_share_an_edge_may_be_named_by_either_also_where_a_point_is_searched_for():
    """In class (c) both belts have the edge; an edge is touched from the side where no cycle is."""
    value, grazing = -0.263755321469, jb.GrazingEdge
    for offset in (1e-3, -0.03):
        for condition in (jb.SaddleConnection(0, to=1), jb.SaddleConnection(1, to=1)):
            point = jb.refine(condition, beside, at=value + offset)
            assert point.value == pytest.approx(value, abs=1e-11)
            assert point.condition == condition
    for nu0 in (-0.25, -0.05):
        make = functools.partial(jb.presets.class_c, nu0, 0.3)
        (touched,) = (one for one in jb.scan(make, span=(-0.7, -0.45)) if one.kind == "GrazingEdge")
        points = [jb.refine(grazing(k), make, at=float(touched.value) - 1e-3) for k in (0, 1)]
        for point in points:
            assert point.value == pytest.approx(float(touched.value), abs=1e-11)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("away", [-0.03, -0.01, -1e-3, 1e-3, 0.01, 0.03])
def test_mirror_images_answer_alike(away):
    """(nu0, nu1, sigma) -> (-nu1, -nu0, -sigma): the belts change places."""

    def image(nu0):
        return jb.presets.class_c(-0.3, -nu0, 0.5)

    for value, conditions in (
        (-0.263755321469, (jb.SaddleConnection(0, to=0), jb.SaddleConnection(1, to=1))),
        (-0.252465134234, (jb.GrazingEdge(0), jb.GrazingEdge(1))),
    ):
        points = [
            jb.refine(condition, make, at=value + away)
            for make, condition in zip((beside, image), conditions, strict=True)
        ]
        assert [int(point.status) for point in points] == [Status.OK] * 2
        # Of the connections the other one may be nearer.
        assert points[0].value == pytest.approx(float(points[1].value), abs=1e-11)
        assert abs(points[0].value - (value + away)) <= abs(away) + 1e-9


@pytest.mark.slow(first=True)
def test_a_cycle_between_a_connection_and_a_fold_is_seen_by_mirror_images_alike():
    """It attracts, sticks to nothing, and is there along 6e-5 of the load: from starts on one side
    of an equilibrium only one of the two images found it."""
    law = jb.Conti(1.2, 0.6, 5.0)

    def make(load):
        belts = (jb.Belt(0.5, law, load, lower=0.4), jb.Belt(0.5, law, 0.5, upper=0.6))
        return jb.Oscillator(0.25, belts, 0.5)

    def image(load):
        belts = (jb.Belt(-0.5, law, load, upper=-0.4), jb.Belt(-0.5, law, 0.5, lower=-0.6))
        return jb.Oscillator(0.25, belts, 0.5)

    told = [jb.scan(one, span=(1.385, 1.395)) for one in (make, image)]
    for points in told:
        kinds = ["SaddleConnection", "SaddleConnection", "FoldOfCycles"]
        assert [point.kind for point in points] == kinds
    assert [float(a.value) for a in told[0]] == pytest.approx(
        [float(b.value) for b in told[1]], abs=1e-11
    )
    # The fold lies so near to an interval with a connection in it that it was told for that, too,
    # and both connections were lost.
    wide = [(point.kind, float(point.value)) for point in jb.scan(make, span=(1.0, 1.5))][-3:]
    assert wide == [(one.kind, pytest.approx(float(one.value), abs=1e-11)) for one in told[0]]
    # One that sticks is always there. In the connection itself rounding makes several of one.
    _, born, ends = [float(point.value) for point in told[0]]
    values = [born - 1e-9, born + 1e-9, 0.5 * (born + ends), ends - 1e-9, ends + 1e-9]
    assert [len(jb.portrait(make(v)).cycles) for v in values] == [1, 2, 2, 2, 1]
    for away in (-1e-12, -1e-13, -1e-14, 0.0, 1e-14, 1e-13, 1e-12):
        assert len(jb.portrait(make(born + away)).cycles) in (1, 2)
