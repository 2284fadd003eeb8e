"""Bifurcations at contact edges: against the oracle and closed forms, found, refined, followed."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from where import nu0, nu1

import jaxbelt as jb
from jaxbelt import EventKind, Status
from jaxbelt.bifurcations.path import ParameterPath
from jaxbelt.numerics.continuation import Stop

EDGE = EventKind.EDGE


def sigma1(osc):
    return osc.belts[0].upper


def overlapping(sigma, nu=0.2):
    """Class (d) with the edge beyond which belt 0 is left at sigma."""
    return jb.presets.class_d(0.35, nu, 0.0, sigma)


def its_oracle(sigma, nu=0.2):
    return oracle.class_d(0.35, nu, 0.0, sigma)


def from_onset(osc):
    """Slip onset on belt 1 where it touches alone, x1 = mus - zeta nu1."""
    return (1 - 0.5 * osc.speed(1), osc.speed(1)), (oracle.ABOVE, 1)


#: What the unstable cycle does, which `scan` does not look for.
INSIDE = jb.GrazingEdge(0, unstable=True)


@pytest.fixture(scope="module")
def diagram():
    return jb.bifurcation_diagram(overlapping(0.6), sigma1, (0.05, 2.5))


@pytest.mark.slow(first=True)
def test_points_of_overlapping_belts(diagram):
    """All that happens as the edge moves from the left of all motion to the right of it."""
    alone = oracle_cycles.sticking_cycle(its_oracle(0.3))
    both = oracle_cycles.sticking_cycle(its_oracle(2.5))
    inside = oracle_cycles.unstable_cycle(its_oracle(0.3))
    friction = [0.6 + 0.4 / (1 + 10 * nu) for nu in (0.35, 0.2)]
    expected = [
        (jb.GrazingEdge(0), alone.x1_min),
        (
            jb.CornerCollision(0),
            oracle_cycles.corner(its_oracle, (0.605, 0.625), 1, from_onset),
        ),
        (INSIDE, inside.x1_min),
        (jb.BoundaryEquilibrium(0), friction[1]),
        (jb.CornerCollision(0), 1 - 0.5 * 0.2),  # slip onset on belt 1, belt 0 being left
        (jb.PseudoHopf(0), oracle_cycles.pseudo_hopf(its_oracle, (0.9, 0.95), lambda p: p)),
        (jb.BoundaryEquilibrium(0), sum(friction)),
        # Slip onset on belt 1 while belt 0, faster by 0.15, pulls along.
        (jb.CornerCollision(0), 1 - 0.5 * 0.2 + 0.6 + 0.4 / 2.5),
        (jb.GrazingEdge(0), both.x1_max),
    ]
    assert [point.condition for point in diagram.points] == [kind for kind, _ in expected]
    for point, (_, value) in zip(diagram.points, expected, strict=True):
        # The oracle integrates to 1e-13.
        assert point.value == pytest.approx(value, abs=1e-11)
        assert point.status == Status.OK and point.error < 1e-11


@pytest.mark.slow(first=True)
def test_branches_go_on_beyond_them(diagram):
    """A branch of equilibria, one of attracting cycles; the unstable cycle shrinks to the edge."""
    rests, attracting, repelling = diagram.branches
    values = [float(point.value) for point in diagram.points if point.condition != INSIDE]
    for branch in (rests, attracting):
        assert branch.values[0] == 0.05 and branch.values[-1] == 2.5
        assert np.max(np.abs(np.diff(branch.x1_max))) < 0.03
    assert np.all(rests.stable == (rests.values < values[4])) and np.all(attracting.stable)
    assert np.allclose(attracting.x1_max[attracting.values > values[7]], attracting.x1_max[-1])
    assert repelling.values[-1] == pytest.approx(values[4], abs=2e-3)
    assert repelling.x1_max[-1] - repelling.x1_min[-1] < 1e-3
    texts = {text.get_text() for text in diagram.plot(quantity="x1").texts}
    assert {"edge grazing, belt 0", "corner, belt 0", "pseudo-Hopf, belt 0"} <= texts


@pytest.mark.slow(first=True)
def test_an_unstable_cycle_touches_the_edge_on_one_side_and_the_other():
    """The edge comes into it from the left and goes out to the right; one branch all along."""
    osc = jb.presets.class_d(0.4, 0.25, 0.0, 0.6)
    diagram = jb.bifurcation_diagram(osc, sigma1, (0.4, 1.6), rows=60)
    points = [point for point in diagram.points if point.condition == INSIDE]
    left, right = (
        oracle_cycles.unstable_cycle(oracle.class_d(0.4, 0.25, 0.0, edge)) for edge in (0.05, 2.5)
    )
    # The oracle integrates to 1e-13.
    for point, expected in zip(points, (left.x1_min, right.x1_max), strict=True):
        assert point.value == pytest.approx(expected, abs=1e-11)
        assert point.residual < 1e-11 and point.error < 1e-11 and point.cycle.multiplier > 1
    for point, within in zip(points, (1e-3, -1e-3), strict=True):
        for offset, signature in ((-within, ()), (within, ((EDGE, 0), (EDGE, 0)))):
            beside = jb.presets.class_d(0.4, 0.25, 0.0, float(point.value) + offset)
            assert jb.unstable_cycle(beside).signature == signature
    (branch,) = (branch for branch in diagram.branches if not np.any(branch.stable))
    assert branch.kind == "cycle" and (branch.values[0], branch.values[-1]) == (0.4, 1.6)
    outside = branch.values < left.x1_min
    assert np.allclose(branch.x1_min[outside], left.x1_min, rtol=0, atol=1e-11)
    outside = branch.values > right.x1_max
    assert np.allclose(branch.x1_max[outside], right.x1_max, rtol=0, atol=1e-11)
    row = len(branch) // 2
    passing = oracle_cycles.unstable_cycle(
        oracle.class_d(0.4, 0.25, 0.0, float(branch.values[row]))
    )
    assert branch.x1_max[row] == pytest.approx(passing.x1_max, abs=1e-9)
    assert branch.multiplier[row] == pytest.approx(passing.multiplier, rel=1e-7)


@pytest.mark.slow(first=True)
def test_points_of_sequential_belts():
    """Class (c); beyond the corner there is no cycle, as the phase of sticking vanished there."""
    points = jb.scan(jb.presets.class_c(0.35, -0.25, 0.4), nu0, (-0.7, 0.7))

    def make(nu):
        return oracle.class_c(nu, -0.25, 0.4)

    def from_edge(osc):
        return (0.4, osc.speed(0)), (oracle.ABOVE, -1)

    expected = [
        # Left of the edge belt 0 is alone; see the paper's class (a).
        (jb.NonsmoothFold(0), -0.267134534361),
        (jb.Hopf(), -(np.sqrt(8) - 1) / 10),
        (jb.SuddenSliding(0), 0.0),
        (jb.PseudoHopf(0), oracle_cycles.pseudo_hopf(make, (0.1, 0.2), lambda _: 0.4)),
        (jb.CornerCollision(0), oracle_cycles.corner(make, (0.23, 0.236), 0, from_edge)),
    ]
    assert [point.condition for point in points] == [kind for kind, _ in expected]
    # The cycle of the corner all but repeats without sticking: errors of 1e-14 count a hundredfold.
    for point, (_, value) in zip(points, expected, strict=True):
        assert point.value == pytest.approx(value, abs=1e-11)
    corner = expected[-1][1]
    assert oracle_cycles.sticking_cycle(make(corner - 1e-7), T=400.0) is not None
    assert oracle_cycles.sticking_cycle(make(corner + 1e-7), T=400.0) is None


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("idle", [0.0, 0.7])
def test_a_belt_at_rest_without_load_brakes_nothing_at_a_pseudo_focus(idle):
    """Left of the edge x2' is 0.2 + (0.25 - damping) x2, to first order, right of it -0.5 - damping
    x2: loops neither grow nor shrink where 0.2 damping = 0.5 (0.25 - damping)."""
    law = jb.Conti(1.0, 0.6, 10.0)

    def make(damping):
        return jb.Oscillator(damping, (jb.Belt(0.3, law, upper=0.5), jb.Belt(idle, law, 0.0)))

    point = jb.refine(jb.PseudoHopf(0), make, at=0.15)
    assert point.status == Status.OK and point.value == pytest.approx(0.125 / 0.7, abs=1e-14)


@pytest.mark.slow(first=True)
def test_the_boundary_of_a_belt_at_rest_without_load_is_no_corner():
    """It is where x1 is extreme, and the cycle grazes the edge as it would without that belt."""
    law = jb.Conti(1.0, 0.5, 5.0)

    def make(velocity, *idle):
        belts = (jb.Belt(velocity, law, upper=0.05), jb.Belt(-0.7, law, lower=-0.45))
        return jb.Oscillator(0.1, (*belts, *idle))

    def with_idle(velocity):
        return make(velocity, jb.Belt(0.0, law, 0.0))

    told = [jb.scan(one, span=(-0.06, -0.04)) for one in (make, with_idle)]
    for points in told:
        assert [point.kind for point in points] == ["CornerCollision", "GrazingEdge"]
    values = [[float(point.value) for point in points] for points in told]
    assert values[0] == pytest.approx(values[1], abs=1e-11)


@pytest.mark.slow(first=True)
def test_an_edge_that_pushes_away_ends_the_cycle():
    """It touches the lower edge of belt 1; from beyond, the mass goes to another equilibrium."""
    points = jb.scan(jb.presets.class_d(0.3, 0.2, -0.2, 0.6), nu0, (-0.7, 0.7))
    assert [point.condition for point in points] == [
        jb.GrazingEdge(1),
        jb.NonsmoothFold(0),
        jb.Hopf(),
        jb.BoundaryEquilibrium(1),
        jb.SuddenSliding(0),
        jb.CornerCollision(0),
    ]
    start = (0.9 - 0.6 - 0.4 / 8.6, 0.2)  # slip onset on belt 1 against belt 0
    expected = oracle_cycles.edge_grazing(
        lambda nu: oracle.class_d(nu, 0.2, -9.0, 9.0), (-0.57, -0.55), -0.2, start
    )
    assert points[0].value == pytest.approx(expected, abs=1e-11)
    # The fixed point between the edges: the pulls of both belts, eq. (24), add to the edge.
    assert points[3].value == pytest.approx(-0.02, abs=1e-15)
    expected = oracle_cycles.corner(
        lambda nu: oracle.class_d(nu, 0.2, -0.2, 0.6), (0.19, 0.195), 0, from_onset
    )
    assert points[5].value == pytest.approx(expected, abs=1e-11)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("condition", "number", "offset"),
    [
        (jb.GrazingEdge(0), 0, -0.01),
        (jb.GrazingEdge(0), 0, 0.03),  # the cycle passes the edge
        (INSIDE, 2, -0.1),
        (INSIDE, 2, 0.03),
        (jb.GrazingEdge(0), 8, -0.03),
        (jb.CornerCollision(0), 1, -0.02),
        (jb.CornerCollision(0), 1, 0.02),
        (jb.BoundaryEquilibrium(0), 3, 0.1),
        (jb.PseudoHopf(0), 5, -0.02),
    ],
)
def test_refined_from_either_side(diagram, condition, number, offset):
    exact = float(diagram.points[number].value)
    point = jb.refine(condition, overlapping(exact + offset), where=sigma1)
    assert point.status == Status.OK and point.condition == condition
    assert point.value == pytest.approx(exact, abs=1e-12)
    assert point.iterations <= 7 and point.residual < 1e-11 and point.error < 1e-11


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("offset", [-0.01, 0.01])
@pytest.mark.parametrize("exact", [0.9, 1.66])
def test_slip_onset_in_a_corner(exact, offset):
    """To one side of it the stick phase is ended by it, to the other by the edge, where the mass is
    torn off. It is at 1 - 0.5 nu1, belt 0 being left, or that and the pull of belt 0."""
    point = jb.refine(jb.CornerCollision(0), overlapping(exact + offset), where=sigma1)
    assert point.value == pytest.approx(exact, abs=1e-11) and point.iterations <= 5
    assert point.residual < 1e-12 and point.error < 1e-12


@pytest.mark.slow(first=True)
def test_a_corner_in_which_the_cycle_ends():
    """The phase begins and ends in the corner, and there is no cycle beyond."""
    inside, beyond = (jb.presets.class_c(0.233547455622 + d, -0.25, 0.4) for d in (-0.01, 0.01))
    point = jb.refine(jb.CornerCollision(0), inside, where=nu0)
    assert point.value == pytest.approx(0.233547455622, abs=1e-11)
    # There no loop is to be followed; the cycle is found nearby.
    point = jb.refine(jb.CornerCollision(0), beyond, where=nu0)
    assert point.value == pytest.approx(0.233547455622, abs=1e-11)


@pytest.mark.slow
def test_the_passage_of_an_edge_becomes_tangent():
    """The edge pushes away to both sides, and the cycle that passes it ends there, where it begins
    and ends at the edge: the attracting cycle at the one point, the unstable one at the other."""
    osc = jb.presets.class_c(0.31, 0.25, 0.7)
    points = jb.scan(osc, nu1, (0.16, 0.2))
    grazes, connects = jb.GrazingEdge(0), jb.SaddleConnection(0, 0)
    kinds = [jb.FoldOfCycles(), jb.Hopf(), grazes, connects]
    assert [point.condition for point in points] == kinds

    def miss(nu):
        """How far from the edge the orbit turns back that left it at rest, to the right, came round
        and passed it: by the left belt alone, at the second loop."""
        right = oracle.class_c(0.31, nu, 0.7)
        passes = oracle.advance(
            right, (0.7, 0.0), (oracle.ABOVE, 1), 100.0, until=lambda i: isinstance(i, oracle.Event)
        )
        loops = []

        def until(item):
            loops.extend([item.x1] if isinstance(item, oracle.Loop) and item.axis == 0 else [])
            return len(loops) == 2

        oracle.advance(oracle.class_a(0.31), tuple(passes.y_end), (1,), 100.0, until=until)
        return loops[1] - 0.7

    def miss_at_once(nu):
        """How far from the edge it turns back after the first loop, by the right belt alone."""
        loops = []

        def until(item):
            loops.extend([item.x1] if isinstance(item, oracle.Loop) and item.axis == 0 else [])
            return len(loops) == 2

        oracle.advance(oracle.class_a(nu), (0.7, 0.0), (1,), 100.0, until=until)
        return loops[1] - 0.7

    expected = [
        brentq(miss, 0.1846, 0.18475, xtol=1e-14),
        brentq(miss_at_once, 0.185, 0.1855, xtol=1e-14),
    ]
    for point, value in zip(points[2:], expected, strict=True):
        near = jb.presets.class_c(0.31, value + 1e-4, 0.7)
        for one in (point, *(jb.refine(kind, near, where=nu1) for kind in (grazes, connects))):
            assert one.value == pytest.approx(value, abs=1e-11)
            assert one.residual < 1e-12 and one.error < 1e-11


@pytest.mark.slow(first=True)
def test_a_belt_at_rest_that_no_cycle_sticks_to():
    """To the left of nu1 = 0 its pull, -1, would be balanced where it does not touch."""
    points = jb.scan(jb.presets.class_d(-0.47, 0.16, 0.14, 1.18), nu1, (-0.6, 0.6))
    assert [point.condition for point in points] == [jb.BeltAtRest(1), jb.BoundaryEquilibrium(1)]
    assert points[0].value == 0 and points[0].cycle.status == Status.EQUILIBRIUM
    pull = -0.6 - 0.4 / 5.7
    exact = (0.4 / (0.14 - pull - 0.6) - 1) / 10
    assert points[1].value == pytest.approx(exact, abs=1e-14)
    for nu, rests in ((-1e-3, [pull]), (1e-3, [pull, pull + 0.6 + 0.4 / 1.01])):
        found = jb.equilibria(jb.presets.class_d(-0.47, nu, 0.14, 1.18))
        places = found.x1[found.kind != jb.EquilibriumKind.SADDLE]
        np.testing.assert_allclose(places, rests, rtol=0, atol=1e-14)
    point = jb.refine(jb.BeltAtRest(1), jb.presets.class_c(0.3, 0.2, 9.0), where=nu1)
    assert point.status == Status.NOT_TOUCHED and jnp.isnan(point.value)


@pytest.mark.slow(first=True)
def test_a_small_cycle_that_sticks_until_the_edge():
    """It never comes to slip onset. Beside it there is one that does, and touches belt 0 alone."""
    osc = jb.presets.class_d(-0.6, 0.175, 1.16, 1.5)
    points = jb.scan(osc, nu0, (0.165, 0.18), resolution=8)
    assert [point.condition for point in points] == [jb.SlidingExchange((0, 1))]
    path = ParameterPath(osc, nu0, (0.165, 0.18))
    path.find_labels([0.17, 0.178])
    for nu, belt in ((0.17, 0), (0.178, 1)):
        label = path.label(nu)
        assert len(label.cycles) == 2 and label.events(EventKind.STICK)[belt] > 0
        small = oracle_cycles.sticking_cycle(
            oracle.class_d(nu, 0.175, 1.16, 1.5), (1.5, min(nu, 0.175))
        )
        loops = [one.loop for one in path.cycles[nu]]
        (loop,) = (loop for loop in loops if np.ptp(loop.entries[:, 0]) < 0.3)
        assert np.sum(loop.durations) == pytest.approx(small.period, abs=1e-6)


@pytest.mark.slow(first=True)
def test_the_onset_of_a_belt_that_touches_on_the_right_only():
    """Beside the cycle on belt 0: that on belt 1 alone ends in its fold, the paper's class (a)."""
    points = jb.scan(jb.presets.class_c(-0.246, 0.3225, 0.3141), nu1, (0.23, 0.3), resolution=8)
    assert [point.condition for point in points] == [jb.NonsmoothFold(1)]
    assert points[0].value == pytest.approx(0.267134534361, abs=1e-11)


@pytest.mark.slow(first=True)
def test_unstable_cycles_around_two_equilibria():
    """Each belt has its own, that of the paper's class (a), as neither reaches the edge."""
    osc = jb.presets.class_c(-0.246, 0.22, 0.3141)
    for around, nu, at in ((0, -0.246, -1), (1, 0.22, 1)):
        cycle = jb.unstable_cycle(osc, around=around)
        alone = oracle_cycles.unstable_cycle(oracle.class_a(nu))
        assert cycle.period == pytest.approx(alone.period, rel=1e-9)
        assert cycle.multiplier == pytest.approx(alone.multiplier, rel=1e-7)
        assert np.sign(cycle.x1_max) == at
    assert jb.unstable_cycle(osc, around=2).status == Status.NO_UNSTABLE_CYCLE
    with pytest.raises(ValueError, match="around must be the number of an equilibrium"):
        jb.unstable_cycle(osc, around=-1)
    diagram = jb.bifurcation_diagram(osc, nu1, (0.2, 0.26), rows=9, resolution=8)
    repelling = [b for b in diagram.branches if b.kind == "cycle" and not np.any(b.stable)]
    assert sorted(np.sign(branch.x1_max[0]) for branch in repelling) == [-1, 1]


@pytest.mark.slow(first=True)
def test_what_fits_no_such_point_is_told_so():
    # Everything comes to rest.
    point = jb.refine(jb.GrazingEdge(0), jb.presets.class_d(0.35, 0.6, 0.0, 0.6), where=sigma1)
    assert point.status == Status.NOT_TOUCHED and jnp.isnan(point.value)
    point = jb.refine(INSIDE, jb.presets.class_d(0.35, 0.6, 0.0, 0.6), where=sigma1)
    assert point.status == Status.NO_UNSTABLE_CYCLE and jnp.isnan(point.value)
    for condition in (jb.GrazingEdge(0), INSIDE):
        with pytest.raises(ValueError, match="belt must be one with a finite edge, got 0"):
            jb.refine(condition, jb.presets.class_a(0.2), where=nu0)


@pytest.mark.slow(first=True)
def test_one_edge_of_two_on_which_something_rests_whatever_the_parameter():
    """At 0.25 belt 0 alone holds on the right of the edge at any load of belt 1; on the edge at 0
    the two balance where the loads are equal."""
    law = jb.Coulomb(0.5, 0.25)

    def make(load):
        right = jb.Belt(-1.0, law, load=load, lower=0.0, upper=0.25)
        return jb.Oscillator(0.5, (jb.Belt(0.6, law, upper=1.4), right))

    points = [jb.refine(jb.BoundaryEquilibrium(1), make, at=at) for at in (0.93, 1.0, 1.1)]
    for point in (*points, *jb.scan(make, span=(0.9, 1.25))):
        assert point.condition == jb.BoundaryEquilibrium(1) and point.type == "persistence"
        assert (point.value, point.x1) == pytest.approx((1.0, 0.0), abs=1e-14)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("guess", "value", "edge", "kind"),
    [
        (0.74, 0.7, 0.2, "annihilation"),
        (0.76, 0.8, 0.2, "annihilation"),
        (1.5, 0.8, 0.2, "annihilation"),
        (1.6, 2.3, 0.6, "persistence"),
        (2.36, 2.4, 0.6, "persistence"),
    ],
)
def test_the_nearest_of_what_comes_to_either_edge_from_either_side(guess, value, edge, kind):
    """Belt 0 pulls with load / 4, belt 1 with 0.025 more between its edges."""
    law = jb.Coulomb(0.5, 0.25)

    def make(load):
        inner = jb.Belt(1.0, law, load=0.1, lower=0.2, upper=0.6)
        return jb.Oscillator(0.5, (jb.Belt(1.0, law, load=load), inner))

    point = jb.refine(jb.BoundaryEquilibrium(1), make, at=guess)
    assert (point.value, point.x1) == pytest.approx((value, edge), abs=1e-13)
    assert point.type == kind


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("mirror", [1, -1])
def test_a_fixed_point_comes_to_an_edge_on_which_a_segment_ends_all_along(mirror):
    """On the other side belt 1 at rest stops the mass by kinetic friction up to the edge, whatever
    the load of belt 0 is, which pulls with 0.6 + 0.4 / 3 of it."""
    law, held = jb.Conti(1.0, 0.6, 10.0), jb.Coulomb(0.5, 0.25)
    sides = (
        ({"upper": 0.25}, {"lower": 0.25}) if mirror > 0 else ({"lower": -0.25}, {"upper": -0.25})
    )

    def make(load, nu=0.2):
        belts = (jb.Belt(mirror * nu, law, load=load, **sides[0]), jb.Belt(0.0, held, **sides[1]))
        return jb.Oscillator(0.5, belts)

    point = jb.refine(jb.BoundaryEquilibrium(0), make, at=0.33)
    assert point.value == pytest.approx(0.25 / (0.6 + 0.4 / 3), abs=1e-14)
    assert point.type == "persistence"
    curve = jb.bifurcation_curve(point, make, ((0.3, 0.4), (0.1, 0.4)))
    loads, speeds = np.asarray(curve.values).T
    np.testing.assert_allclose(loads * (0.6 + 0.4 / (1 + 10 * speeds)), 0.25, atol=1e-12)


@pytest.mark.slow(first=True)
def test_the_end_of_a_segment_on_an_edge():
    """Belt 1 at rest holds what is within its capacity of the pull of belt 0."""
    osc = jb.presets.class_d(0.35, 0.0, 0.0, 0.6)
    point = jb.refine(jb.BoundaryEquilibrium(1), osc, where=lambda osc: osc.belts[1].lower)
    pull = 0.6 + 0.4 / 4.5
    assert point.value == pytest.approx(pull - 1, abs=1e-14) and point.status == Status.OK


@pytest.mark.slow(first=True)
def test_an_exchange_where_the_edge_of_one_belt_is_passed():
    """Below, the mass sticks to belt 0, loses it at its edge, and sticks to belt 1; above, to belt
    1 all the way. In the limit the orbit is the same."""
    osc = jb.presets.class_d(0.24, 0.25, 0.0, 0.7)
    (point,) = jb.scan(osc, nu0, (0.23, 0.27))
    assert point.condition == jb.SlidingExchange((0, 1))
    assert point.value == pytest.approx(0.25, abs=1e-14) and point.residual < 1e-11
    below, above = (
        oracle_cycles.sticking_cycle(oracle.class_d(nu, 0.25, 0.0, 0.7)) for nu in (0.2499, 0.2501)
    )
    for value, cycle in ((0.2499, below), (0.2501, above)):
        ours = jb.find_cycle(jb.presets.class_d(value, 0.25, 0.0, 0.7), (3.0, 0.0))
        assert ours.period == pytest.approx(cycle.period, abs=1e-9)
        sticks = {belt for kind, belt in ours.signature if kind == EventKind.STICK}
        assert sticks == ({0, 1} if value < 0.25 else {1})
    at_point = float(point.cycle.period)
    assert below.period < at_point < above.period or above.period < at_point < below.period


@pytest.mark.slow
def test_a_cycle_that_no_start_leads_to_is_followed():
    """A small cycle passes the edge; it attracts little, and the starts of the search miss it. It
    ends where it meets the unstable one of belt 1 alone, which touches the edge there."""
    points = jb.scan(jb.presets.class_c(0.3, 0.25, 0.7), nu1, (0.165, 0.2))
    assert [p.condition for p in points] == [jb.FoldOfCycles(), jb.Hopf(), jb.GrazingEdge(0)]

    def overlap(nu):
        return oracle_cycles.unstable_cycle(oracle.class_a(nu)).x1_min - 0.7

    expected = brentq(overlap, 0.1845, 0.186, xtol=1e-14)
    assert points[2].value == pytest.approx(expected, abs=1e-11)


@pytest.mark.slow
def test_slope_of_a_corner():
    def value(nu):
        osc = overlapping(0.62, nu)
        return jb.refine(jb.CornerCollision(0), osc, where=sigma1, max_arcs=16).value

    found, slope = jax.jvp(value, (0.2,), (1.0,))
    difference, _ = oracle.richardson(
        lambda nu: oracle_cycles.corner(
            lambda sigma: its_oracle(sigma, nu), (0.605, 0.63), 1, from_onset
        ),
        0.2,
        5e-3,
    )
    assert slope == pytest.approx(difference, rel=1e-7) and jnp.isfinite(found)


@pytest.mark.slow(first=True)
def test_curves(diagram):
    """Where the rows lie exactly is known: in closed form, or from the oracle."""
    where, span = (sigma1, nu1), ((0.05, 2.5), (0.1, 0.3))
    rests, grazing = (
        jb.bifurcation_curve(diagram.points[i], where, span, step=0.03) for i in (3, 0)
    )
    assert rests.ends == (Stop.LEFT_SPAN, Stop.LEFT_SPAN)
    sigma, nu = rests.values.T
    assert np.allclose(sigma, 0.6 + 0.4 / (1 + 10 * nu), rtol=0, atol=1e-14)
    for sigma, nu in grazing.values[1:-1:5].tolist():
        alone = oracle_cycles.sticking_cycle(its_oracle(0.3, nu))
        assert sigma == pytest.approx(alone.x1_min, abs=1e-11)
    # It ends where the cycle does, which is that of class (a).
    (fold,) = grazing.special
    assert (fold.kind, fold.belts) == ("DoubleSliding", (1,)) and Stop.STOPPED in grazing.ends
    assert fold.values[1] == pytest.approx(0.267134534361, abs=1e-11)


@pytest.mark.slow(first=True)
def test_curve_of_an_unstable_cycle_that_touches_the_edge(diagram):
    """Up to the nonsmooth fold of belt 1 alone, and down to its Hopf point, which it shrinks to."""
    where, span = (sigma1, nu1), ((0.05, 2.5), (0.1, 0.3))
    grazing = jb.bifurcation_curve(diagram.points[2], where, span, step=0.03)
    for sigma, nu in grazing.values[1:-4:3].tolist():
        alone = oracle_cycles.unstable_cycle(its_oracle(0.05, nu))
        assert sigma == pytest.approx(alone.x1_min, abs=1e-9)
    shrunk, fold = sorted(grazing.special, key=lambda point: point.values[1])
    assert (fold.kind, shrunk.kind) == ("DoubleSliding", "BoundaryHopf")
    assert fold.values[1] == pytest.approx(0.267134534361, abs=1e-11)
    hopf = (np.sqrt(8) - 1) / 10
    assert shrunk.values == pytest.approx((0.6 + 0.4 / (1 + 10 * hopf), hopf), abs=1e-13)
    assert Stop.STOPPED in grazing.ends


@pytest.mark.slow(first=True)
def test_curves_that_meet_in_a_hopf_point_on_an_edge(diagram):
    """Of belt 1 alone to the right of the edge, and of both belts to the left of it."""
    where, span = (sigma1, nu1), ((0.05, 2.5), (0.1, 0.3))
    alone = (np.sqrt(8) - 1) / 10  # where 0.4 * 10 / (1 + 10 nu)^2 is the damping, 0.5
    both = (np.sqrt(4 / (0.5 - 4 / 4.5**2)) - 1) / 10
    pull = 0.6 + 0.4 / (1 + 10 * np.array([alone, both]))
    expected = [(pull[0], alone), (0.6 + 0.4 / 4.5 + pull[1], both)]

    balanced = jb.bifurcation_curve(diagram.points[5], where, span, step=0.03)
    assert balanced.ends == (Stop.STOPPED, Stop.STOPPED)
    first, degenerate, last = balanced.special
    found = sorted([first.values, last.values])
    assert first.kind == last.kind == "BoundaryHopf"
    # In between the cycle that is born there begins to attract.
    assert degenerate.kind == "DegeneratePseudoHopf" and degenerate.residual < 1e-12
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)

    for number, corner in ((3, expected[0]), (6, expected[1])):
        rests = jb.bifurcation_curve(diagram.points[number], where, span, step=0.03)
        (point,) = rests.special
        assert point.kind == "BoundaryHopf"
        np.testing.assert_allclose(point.values, corner, rtol=0, atol=1e-12)

    hopf = jb.refine(jb.Hopf(), overlapping(1.8, 0.25), where=nu1)
    (point,) = jb.bifurcation_curve(hopf, where, span, step=0.03).special
    assert point.kind == "BoundaryHopf"
    np.testing.assert_allclose(point.values, expected[1], rtol=0, atol=1e-12)


@pytest.mark.slow(first=True)
def test_a_segment_of_no_length_at_an_edge_does_not_hold():
    """A belt at rest touches on the left of x1 = -1, where it holds just what it can: loops shrink
    to the circle through that point, faster than geometrically, and go on along it."""
    law = jb.Conti(static=1.0, residual=0.6, steepness=1.0)

    def make(upper):
        belts = jb.Belt(0.0, law, upper=upper), jb.Belt(0.0, law, load=0.0)
        return jb.Oscillator(0.0, belts)

    for t1 in (48.0, 60.0):
        run = jb.simulate(make(-1.0), (3.0, 0.0), t1)
        assert run.status == jb.Status.OK
        # The event times add up to some 1e-13 of t1, the radius to the tolerance 1e-10.
        assert np.hypot(*np.asarray(run.ys[-1])) == pytest.approx(1.0, abs=1e-9)
    # A little less and there is a segment to come to.
    assert jb.simulate(make(-0.9), (3.0, 0.0), 60.0).status == jb.Status.STUCK_FOREVER


@pytest.mark.slow(first=True)
def test_where_one_type_of_boundary_equilibrium_turns_into_the_other():
    """Belt 0 pulls with 0.7 on the left of the edge, belt 1 with 0.9 mu(nu1) on the right, which is
    0.7 where 1 + 10 nu1 = 2.25."""
    law = jb.Conti(static=1.0, residual=0.6, steepness=10.0)

    def make(nu1, sigma):
        right = jb.Belt(nu1, law, load=0.9, lower=sigma)
        return jb.Oscillator(0.5, (jb.Belt(0.3, law, upper=sigma), right))

    point = jb.refine(jb.BoundaryEquilibrium(1), lambda sigma: make(0.2, sigma), at=0.65)
    assert point.value == pytest.approx(0.66, abs=1e-12)
    curve = jb.bifurcation_curve(point, make, ((0.08, 0.25), (0.5, 0.9)))
    (special,) = (one for one in curve.special if one.kind == "DoubleBoundaryEquilibrium")
    assert special.values == pytest.approx((0.125, 0.7), abs=1e-12)
    types = [
        jb.refine(jb.BoundaryEquilibrium(1), lambda s, nu=nu: make(nu, s), at=at).type
        for nu, at in ((0.1, 0.72), (0.2, 0.66))
    ]
    assert sorted(types) == ["annihilation", "persistence"]


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("velocity", "kind"), [(0.0, "persistence"), (-1.0, "annihilation")], ids=["held", "pushed"]
)
def test_the_kinetic_end_of_a_segment_comes_to_an_edge(velocity, kind):
    """To the right of the edge kinetic friction 0.25 stops the mass up to x1 = 0.25, static
    friction 0.5 holds it up to 0.5. With the edge beyond 0.25 what slips down is lost: to the
    segment of the other belt, which is at rest, too, or to where that one pushes it."""
    law = jb.Coulomb(0.5, 0.25)

    def lower_of(edge):
        return -0.2 if velocity == 0 else edge

    def make(edge):
        return jb.Oscillator(
            1.0, (jb.Belt(velocity, law, upper=edge), jb.Belt(0.0, law, lower=lower_of(edge)))
        )

    (point,) = jb.scan(make, span=(0.15, 0.35))
    assert point.condition == jb.BoundaryEquilibrium(0) and point.type == kind
    assert float(point.value) == pytest.approx(0.25, abs=1e-12)
    again = jb.refine(jb.BoundaryEquilibrium(0), make, at=0.27)
    assert again.status == jb.Status.OK
    assert float(again.value) == pytest.approx(0.25, abs=1e-12)


@pytest.mark.slow(first=True)
def test_where_the_mass_is_pushed_back_nothing_ends_at_the_kinetic_limit():
    def make(edge):
        belts = (
            jb.Belt(1.0, jb.Coulomb(1.0, 1.0), upper=edge),
            jb.Belt(0.0, jb.Coulomb(0.5, 0.25), lower=edge),
        )
        return jb.Oscillator(1.0, belts)

    assert jb.scan(make, span=(0.15, 0.35)) == ()


@pytest.mark.slow(first=True)
def test_a_corner_beside_slip_onset_that_lies_on_the_edge_all_along():
    """Belt 0 slips from 1.0 - 0.25 * 0.4 = 0.9 on, where its edge is; what happens in the corner of
    belt 1 on the other side is found all the same."""

    def make(nu):
        belts = (
            jb.Belt(0.4, jb.Stribeck(1.0, 0.5, 0.3), upper=0.9),
            jb.Belt(nu, jb.Conti(0.8, 0.32, 10.0), lower=0.9),
        )
        return jb.Oscillator(0.25, belts)

    def miss(nu):
        """x2 where the orbit from the corner (0.9, 0.4) comes back to the edge, less nu, if belt 1
        goes on to slip with one sign."""

        def field(t, y):
            return y[1], -y[0] - 0.25 * y[1] - 0.32 - 0.48 / (1 + 10.0 * (y[1] - nu))

        def back(t, y):
            return y[0] - 0.9

        back.terminal, back.direction = True, -1.0
        tight = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
        run = solve_ivp(field, (0.0, 2.0), (0.9, 0.4), events=back, **tight)
        return run.y_events[0][0, 1] - nu

    points = jb.scan(make, span=(-0.8, -0.25))
    kinds = ["CornerCollision", "CrossingSliding", "CornerCollision"]
    assert [point.kind for point in points] == kinds
    assert points[0].value == pytest.approx(brentq(miss, -0.41, -0.405, xtol=1e-14), abs=1e-11)
    for belt in (0, 1):
        for at in (-0.4059, -0.4058):
            found = jb.refine(jb.CornerCollision(belt), make, at=at)
            assert found.value == pytest.approx(float(points[0].value), abs=1e-11)
        found = jb.refine(jb.CornerCollision(belt), make, at=-0.4025)
        assert found.value == pytest.approx(float(points[2].value), abs=1e-9)


def with_onset_on_its_edge(residual, *, edge=0.8, side=1):
    """Slip onset on the belt is at x1 = side (1 - 0.5 * 0.4), where it ends; beyond it is none."""
    ends = {"upper": edge} if side > 0 else {"lower": -edge}
    return jb.Oscillator(0.5, (jb.Belt(0.4 * side, jb.Conti(1.0, residual, 10.0), **ends),))


def farthest_after_onset():
    """x1 where the mass that slips off the belt at (0.8, 0.4) turns back: free, damped motion."""
    half, x1, x2 = 0.25, 0.8, 0.4
    frequency = np.sqrt(1 - half**2)
    t = np.arctan2(x2 * frequency, x1 + half * x2) / frequency
    swing = np.cos(frequency * t) * x1 + np.sin(frequency * t) * (x2 + half * x1) / frequency
    return np.exp(-half * t) * swing


@functools.cache
def fold_with_onset_on_its_edge():
    """The residual friction with which the orbit from there comes back tangent to the boundary."""

    def gap(residual):
        law = oracle.conti(1.0, residual, 10.0)
        osc = oracle.Oscillator(0.5, (oracle.Belt(0.4, *law, upper=0.8),))
        return oracle_cycles.gap_from(osc, (0.8, 0.4), (oracle.ABOVE,), (0,))

    return brentq(gap, 0.25, 0.35, xtol=1e-14)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("guess", [0.31, 0.25])
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("offset", [0.0, -1e-13, 1e-13])
def test_a_fold_where_slip_onset_lies_on_the_edge(offset, side, guess):
    """Beyond the fold no cycle sticks, and the orbit from the edge begins with slip."""

    def make(residual):
        return with_onset_on_its_edge(residual, edge=0.8 + offset, side=side)

    point = jb.refine(jb.NonsmoothFold(0), make, at=guess)
    assert point.status == Status.OK
    # The oracle integrates to 1e-13.
    assert point.value == pytest.approx(fold_with_onset_on_its_edge(), abs=1e-11)
    farthest = point.cycle.x1_max if side > 0 else -point.cycle.x1_min
    # The arc beyond the edge is good to 1e-12; the edge is off by 1e-13.
    assert farthest == pytest.approx(farthest_after_onset(), abs=1e-12)


@pytest.mark.slow(first=True)
def test_a_fold_where_slip_onset_lies_on_the_edge_is_told_once():
    points = jb.scan(with_onset_on_its_edge, span=(0.3, 0.9))
    # Beside the fold the mass comes to rest on the edge, where mu(0.4) = r + (1 - r)/5 is 0.8.
    assert [point.kind for point in points] == ["NonsmoothFold", "BoundaryEquilibrium"]
    values = (fold_with_onset_on_its_edge(), 0.75)
    assert [float(point.value) for point in points] == pytest.approx(values, abs=1e-11)
