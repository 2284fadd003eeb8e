"""`scan` where contact edges, belts at rest and belts without load meet what moves: against the
oracle, the engine of the campaigns, closed forms, and what must come out."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest
from where import nu0, nu1

import jaxbelt as jb
from jaxbelt import Status
from jaxbelt.bifurcations.path import ParameterPath
from jaxbelt.bifurcations.scan import search
from jaxbelt.cycles.attractors import distinct
from jaxbelt.cycles.chains import loop_events
from tests.campaign import engine, package
from tests.campaign.engine import Belt, Oscillator


def two_cycles(nu):
    """Class (d): a cycle to either side of where belt 1 begins, both of which stick to belt 0."""
    return jb.presets.class_d(nu, 0.5073, -0.49694, 0.61855)


@pytest.mark.slow(first=True)
def test_two_cycles_with_one_sequence_of_events():
    """One of them begins as it just touches the edge of belt 1, where belt 0 would hold it back."""
    path = ParameterPath(two_cycles(-0.06341), nu0, (-0.3, -0.02))
    points = search(path)
    expected = [jb.SaddleConnection(1, to=1), jb.GrazingEdge(1), jb.Hopf(), jb.Hopf()]
    assert [point.condition for point in points] == expected
    path.find_labels([-0.06341])
    loops = [one.loop for one in path.cycles[-0.06341]]
    assert len({loop_events(loop) for loop in loops}) == 1
    assert sorted(np.sum(loop.durations) for loop in loops) == pytest.approx(
        [9.9148027860, 10.9019400715], abs=1e-7
    )
    # By simulation: how many cycles there are just before and just after.
    starts = [(x1, -0.1) for x1 in np.linspace(-1.5, 1.5, 13)]
    for offset, count in ((-1e-5, 1), (1e-5, 2)):
        osc = two_cycles(float(points[1].value) + offset)
        assert len(distinct([jb.find_cycle(osc, start) for start in starts])) == count


@pytest.mark.slow(first=True)
def test_a_corner_where_only_the_sign_of_what_arrives_changes():
    """Belt 1 begins where the mass sticks to belt 0 before the point, and slips on it after."""
    law = jb.Conti(1.09, 0.42, 12.8)
    belts = (jb.Belt(0.4, law, 0.8, upper=0.9), jb.Belt(0.291, law, lower=0.72))
    points = jb.scan(jb.Oscillator(0.374, belts), nu0, (0.38, 0.44))
    expected = [jb.CornerCollision(1), jb.CornerCollision(1), jb.GrazingEdge(1)]
    assert [point.condition for point in points] == expected
    assert points[1].value == pytest.approx(0.398440689452, abs=1e-11)


def test_nothing_happens_where_a_belt_without_load_is_as_fast():
    osc = jb.presets.class_b(0.2, 0.22)
    osc = eqx.tree_at(lambda osc: osc.belts[1].load, osc, 0.0)
    kinds = [point.kind for point in jb.scan(osc, nu0, (0.2, 0.25))]
    assert kinds == []


def test_a_belt_without_load_changes_nothing():
    """Neither where it is at rest, nor where a cycle touches its boundary."""
    belt = jb.Belt(0.3, jb.Conti(1.0, 0.6, 10.0))
    idle = jb.Belt(0.1, jb.Conti(1.0, 0.6, 10.0), load=0.0)
    osc = jb.Oscillator(0.5, (belt, idle))
    assert jb.scan(osc, nu1, (-0.1, 0.2), resolution=16) == ()
    kinds = [point.kind for point in jb.scan(osc, nu0, (0.15, 0.3), resolution=16)]
    assert kinds == ["Hopf", "NonsmoothFold"]


@pytest.mark.slow(first=True)
def test_what_kinetic_friction_stops_comes_to_the_edge_of_a_segment():
    """Belt 0 at rest holds the mass up to 1, but slipping on it takes 0.7 only: the part of the
    segment of equilibria below -0.7 holds but attracts nothing."""
    osc = jb.Oscillator(0.5, (jb.Belt(0.0, jb.Coulomb(1.0, 0.7), upper=-0.6),))
    (point,) = jb.scan(osc, lambda osc: osc.belts[0].upper, (-0.9, -0.5), resolution=8)
    assert point.condition == jb.BoundaryEquilibrium(0) and point.type == "annihilation"
    assert point.value == pytest.approx(-0.7, abs=1e-14)


@pytest.mark.slow(first=True)
def test_two_cycles_at_one_value_are_two_points():
    """Each is the other turned round, in the same contact interval of a light belt at rest: at its
    ends they collide with a corner at one value."""
    law, light = jb.Conti(1.0, 0.6, 10.0), jb.Coulomb(0.5, 0.5)
    light = jb.Belt(0.0, light, load=0.02, lower=-1.03, upper=1.03)

    def make(nu):
        return jb.Oscillator(
            0.5, (jb.Belt(-nu, law, upper=-0.1), jb.Belt(nu, law, lower=0.1), light)
        )

    left, right = jb.scan(make, span=(0.188, 0.192), resolution=8)
    assert left.condition == right.condition == jb.CornerCollision(2)
    assert left.value == pytest.approx(float(right.value), abs=1e-12)
    assert left.cycle.x1_min == pytest.approx(-1.03, abs=1e-12)
    assert right.cycle.x1_max == pytest.approx(1.03, abs=1e-12)


def _edge_beside_the_equilibrium(distance):
    """v: an oscillator with an edge so far to the right of where the mass is at rest on a belt."""
    conti = jb.Conti(static=1.0, residual=0.6, steepness=10.0)

    def at(v):
        lower = 0.4 / (1 + 10 * v) + 0.6 + distance(v)
        return jb.Oscillator(0.5, (jb.Belt(v, conti), jb.Belt(0.5, conti, lower=lower)))

    return at


@pytest.mark.slow(first=True)
def test_what_holds_all_along_is_no_point():
    # Rounding decides on which side the edge is; what is added makes it do so on any machine.
    at = _edge_beside_the_equilibrium(lambda v: 4e-16 * jnp.sin(1e3 * v))
    assert jb.refine(jb.BoundaryEquilibrium(1), at, at=0.23).status == Status.DEGENERATE
    (hopf,) = jb.scan(at, span=(0.22, 0.24), resolution=4)
    assert hopf.kind == "Hopf"
    diagram = jb.bifurcation_diagram(at, span=(0.22, 0.24), resolution=4, rows=16)
    assert [b for _, b, _ in diagram.regions] == [pytest.approx(float(hopf.value)), 0.24]


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("distance", [0.0, 1e-15, -1e-15, 1e-9])
def test_a_fixed_point_on_an_edge_all_along_has_a_hopf_point(distance):
    """Its trace is that of the second belt, 0.4 / 0.5 exp(-0.8 / 0.5) - damping, and the edge of
    the first one lies on it: on the other side that belt's force is missing, and pushes back."""
    stribeck, held = jb.Stribeck(1.0, 0.6, 0.5), 0.4 * np.exp(-1.6) + 0.6
    for turned in (False, True):
        edge = (0.75 - held - distance) if turned else (held - 0.75 + distance)
        own = jb.Coulomb(0.75, 0.75)
        ends = dict(upper=edge) if turned else dict(lower=edge)
        sign = -1.0 if turned else 1.0
        belts = jb.Belt(-sign * 0.3, own, **ends), jb.Belt(sign * 0.8, stribeck)
        osc = jb.Oscillator(0.2, belts)
        points = jb.scan(osc, lambda osc: osc.damping, span=(0.0, 0.4), resolution=8)
        kind = "PseudoHopf" if distance > 1e-12 else "Hopf"
        assert {point.kind for point in points} == {kind, "CornerCollision", "NonsmoothFold"}
        (hopf,) = [point for point in points if point.kind == kind]
        assert hopf.value == pytest.approx(0.8 * np.exp(-1.6), abs=1e-13)
        if kind == "Hopf":
            assert hopf.type == "degenerate" and np.isnan(hopf.coefficient)


@pytest.mark.slow(first=True)
def test_nothing_happens_where_a_belt_reverses_at_a_pseudo_focus_that_attracts():
    """It pushes to the right with 0.5 +- 0.125 there, and the other one back with 0.3."""

    def make(v):
        own = jb.Belt(v, jb.Coulomb(1, 0.5), 0.25, upper=-0.5)
        return jb.Oscillator(1.0, (own, jb.Belt(-1.0, jb.Coulomb(1, 0.8), lower=-0.5)))

    for v in (-0.1, 0.1):
        (row,) = jb.equilibria(make(v))
        assert row.kind == jb.EquilibriumKind.PSEUDO_FOCUS and row.stable
    assert jb.scan(make, span=(-0.3, 0.4), resolution=14) == ()


def test_edges_that_are_one_all_along_do_not_meet():
    conti = jb.Conti(static=1.0, residual=0.6, steepness=10.0)

    def at(v):
        belts = jb.Belt(v, conti, upper=0.5), jb.Belt(0.35, conti, lower=0.5)
        return jb.Oscillator(0.5, belts)

    assert jb.refine(jb.MeetingEdges((0, 1)), at, at=0.3).status == Status.DEGENERATE


def _edge_at_the_least_friction(v):
    # At v = 0.3: 2 q v = 4 / (1 + 10 v)^2.
    quadratic = 0.25 / 0.6
    conti = jb.Conti(static=1.0, residual=0.6, steepness=10.0, quadratic=quadratic)
    edge = 0.7 + quadratic * 0.09
    return jb.Oscillator(0.5, (jb.Belt(v, conti), jb.Belt(0.5, conti, lower=edge)))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("start", [0.26, 0.2999, 0.33])
def test_the_error_of_a_double_root_is_told(start):
    osc = _edge_at_the_least_friction(start)
    point = jb.refine(jb.BoundaryEquilibrium(1), osc, where=lambda osc: osc.belts[0].velocity)
    assert point.status != Status.OK or abs(point.value - 0.3) <= point.error


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("unit", [1e3, 1e-3])
def test_the_unit_of_the_parameter_makes_no_difference(unit):
    along = _edge_beside_the_equilibrium(lambda v: 4e-16 * jnp.sin(1e3 * v))
    found = jb.scan(lambda s: along(s / unit), span=(0.22 * unit, 0.24 * unit), resolution=4)
    assert [point.kind for point in found] == ["Hopf"]
    # A double root, known to 5e-8 units, and a simple one, from farther off than 0.5.
    double = jb.refine(
        jb.BoundaryEquilibrium(1), lambda s: _edge_at_the_least_friction(s / unit), at=0.2999 * unit
    )
    assert double.status == Status.OK and double.error < 1e-6 * unit
    assert abs(double.value - 0.3 * unit) <= double.error
    hopf = jb.refine(jb.Hopf(), lambda s: jb.presets.class_b(s / unit, 0.35), at=0.25 * unit)
    assert hopf.value == pytest.approx(0.263654916039 * unit, rel=1e-11)
    assert hopf.error < 1e-13 * unit


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("varied", ["velocity", "damping"])
def test_two_equilibria_that_change_at_one_value(varied):
    """A mirror image of itself: two fixed points, the same distance from the middle."""
    law = jb.Conti(static=1.0, residual=0.6, steepness=10.0)

    def of_both(speed, damping):
        belts = jb.Belt(speed, law, lower=0.1), jb.Belt(-speed, law, upper=-0.1)
        return jb.Oscillator(damping, belts)

    # Eq. (28) of the paper: damping = (static - residual) steepness / (1 + steepness speed)^2.
    if varied == "velocity":
        make, exact = (lambda speed: of_both(speed, 0.5)), (np.sqrt(8) - 1) / 10
    else:
        make, exact = (lambda damping: of_both(0.2, damping)), 4 / 9
    points = jb.scan(make, span=(exact - 0.03, exact + 0.03), resolution=4)
    at = [float(point.x1) for point in points]
    rest = 0.6 + 0.4 / (1 + 10 * (exact if varied == "velocity" else 0.2))
    assert [point.kind for point in points] == ["Hopf", "Hopf"]
    assert np.allclose(sorted(at), [-rest, rest], rtol=0, atol=1e-12)
    assert all(float(point.value) == pytest.approx(exact, abs=1e-13) for point in points)
    assert all(point.place[:2] == pytest.approx(x1) for point, x1 in zip(points, at))
    if varied == "velocity":
        for point in points:
            curve = jb.bifurcation_curve(point, of_both, span=((0.15, 0.22), (0.4, 0.6)))
            assert np.all(np.sign(curve.places[:, 0]) == np.sign(float(point.x1)))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("span", [(0.0, 0.5), (-0.5, 0.0)])
def test_nothing_happens_where_a_load_vanishes(span):
    law = jb.Conti(1.0, 0.6, 10.0)

    def make(value):
        return jb.Oscillator(
            0.25, (jb.Belt(0.3, law, jnp.abs(value), upper=0.6), jb.Belt(0.1, law))
        )

    assert jb.scan(make, span=span, resolution=8) == ()


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("damping", [0.5, 2.0])
def test_an_edge_that_stays_on_the_fixed_point_is_no_point(damping):
    """All loads and edges grow alike, on round numbers, and the fixed point with them."""
    law = jb.Conti(1.0, 0.6, 10.0)

    def make(size):
        belts = (
            jb.Belt(0.1, law, size, upper=0.15 * size),
            jb.Belt(-0.7, law, size, lower=-0.5 * size),
        )
        return jb.Oscillator(damping, belts)

    assert jb.scan(make, span=(0.5, 1.5), resolution=16) == ()


def test_a_belt_at_rest_that_holds_nothing_hides_no_hopf_point():
    """Without a load it is no obstacle, though the fixed point lies on its boundary."""
    law = jb.Conti(1.0, 0.6, 10.0)

    def make(nu):
        return jb.Oscillator(2.0, (jb.Belt(0.0, law, 0.0), jb.Belt(nu, law)))

    for at in (0.0414, -0.0414):
        point = jb.refine(jb.Hopf(), make, at=at)
        assert int(point.status) == Status.OK and point.type == "subcritical"
        # 0.4 * 10 / (1 + 10 nu)^2 = damping
        assert abs(float(point.value)) == pytest.approx((np.sqrt(2) - 1) / 10, abs=1e-14)


@pytest.mark.slow(first=True)
def test_the_edges_of_a_belt_without_load_do_not_cut_what_a_belt_at_rest_holds():
    """Two belts at rest share an edge, which moves past those of a third one, without load."""
    law = jb.Conti(1.0, 0.6, 5.0)

    def make(edge):
        held = jb.Belt(0.0, law, 2.0, upper=edge), jb.Belt(0.0, law, 2.0, lower=edge)
        return jb.Oscillator(0.1, (*held, jb.Belt(0.0, law, 0.0, -0.4, 0.3)), 0.5)

    assert jb.scan(make, span=(-0.8, 0.8)) == ()


@pytest.mark.slow
def test_no_cycle_has_a_corner_at_the_edge_of_a_belt_without_load():
    """Just behind a nonsmooth fold such a corner explained what the fold did."""
    laws = [jb.Conti(1.2811147144765658, 0.472216266800267, 10.917368501350285, 0.034743528)]
    laws += [jb.Conti(0.834101590979167, 0.4631886527969489, 3.8869198626736416, 0.003869525)]
    belts = (
        jb.Belt(0.23652667037415237, laws[0], 0.512709939622697, lower=-0.9319060589307261),
        jb.Belt(-0.7681793591458714, laws[1], 0.8449201209243598, upper=-0.49536973697455766),
        jb.Belt(-0.7681793591458714, laws[1], 0.0, -0.4, 0.3),
    )
    osc = jb.Oscillator(0.6225516228351654, belts, 1.8185890197174717)
    points = jb.scan(osc, lambda osc: osc.belts[0].load, (0.25, 1.5))
    assert [point.kind for point in points] == ["NonsmoothFold", "Hopf"]


@pytest.mark.slow(first=True)
def test_a_belt_whose_load_is_zero_in_the_middle_of_the_path_has_its_edges():
    """Both sides of that are images of one another, and as a path of one side tells them."""
    law = jb.Conti(1.0, 0.6, 10.0)

    def make(s):
        belts = jb.Belt(0.3, law), jb.Belt(-0.2, law, jnp.abs(s), upper=0.8)
        return jb.Oscillator(0.3, belts)

    def told(first, last):
        points = jb.scan(make, span=(first, last))
        return [(one.kind, float(one.value)) for one in points if abs(float(one.value)) > 0.4]

    one_side = told(0.4, 0.55)
    assert [kind for kind, _ in one_side] == ["CornerCollision", "GrazingEdge"]
    both = told(-0.55, 0.55)
    expected = [(kind, -value) for kind, value in reversed(one_side)] + one_side
    assert [kind for kind, _ in both] == [kind for kind, _ in expected]
    assert [value for _, value in both] == pytest.approx([v for _, v in expected], abs=1e-9)


# --- belts of one velocity, and corners -----------------------------------------------------------


@pytest.mark.slow(first=True)
def test_belts_that_change_places_where_a_cycle_sticks_to_both():
    """The slip arc between the two stick phases takes no time at the point; the cycle there is
    that of one belt with the load of both."""
    law = jb.Conti(1.2, 0.48, 10.0)

    def make(velocity):
        return jb.Oscillator(0.1, (jb.Belt(-0.55, law), jb.Belt(velocity, law)))

    one = oracle.Oscillator(0.1, (oracle.Belt(-0.55, *oracle.conti(1.2, 0.48, 10.0), load=2.0),))
    period = oracle_cycles.sticking_cycle(one).period
    points = jb.scan(make, span=(-0.56, -0.54))
    (point,) = [p for p in points if p.condition == jb.SlidingExchange((0, 1))]
    assert "Unexplained" not in [p.kind for p in points]
    for found in (point, *(jb.refine(point.condition, make, at=v) for v in (-0.551, -0.549))):
        assert found.value == pytest.approx(-0.55, abs=1e-13)
        assert found.cycle.period == pytest.approx(period, abs=1e-10)


@pytest.mark.slow(first=True)
def test_a_corner_at_a_value_that_the_search_looks_at():
    """Slip onset on belt 1 is on its edge just where the belts run against each other, at -0.45,
    a round part of the span."""

    def make(velocity):
        belts = (
            jb.Belt(0.45, jb.Stribeck(0.5, 0.4, 0.4), 2.0),
            jb.Belt(velocity, jb.Conti(0.8, 0.32, 1.0), 2.0, lower=-0.66642015508763, upper=0.5),
        )
        return jb.Oscillator(0.25, belts)

    points = jb.scan(make, span=(-0.55, -0.35))
    assert [point.condition for point in points] == [jb.CornerCollision(1)] * 2
    assert points[1].value == pytest.approx(-0.45, abs=1e-12)


@pytest.mark.slow(first=True)
def test_an_arc_that_vanishes_as_a_square_is_told_by_its_corner():
    """Where slip sets in just before the edge, belt 1 holds again just beyond it: what lies between
    takes 1e-13 where the belt runs 8e-6 slower than at the corner."""
    law = jb.Conti(1.0, 0.6, 10.0)
    onset = -2.0 + 0.25 * 0.225 + (0.6 + 0.4 / (1 + 10 * 1.25))  # limit, damping, mu(1.25)

    def make(velocity):
        belts = (jb.Belt(velocity, law, lower=onset), jb.Belt(-0.45, law, 2.0))
        return jb.Oscillator(0.25, belts, 2.0)

    for span in ((0.75, 0.85), (0.7, 0.9)):
        (corner,) = jb.scan(make, span=span)
        assert corner.condition == jb.CornerCollision(0)
        assert corner.value == pytest.approx(0.8, abs=1e-12)


@pytest.mark.slow(first=True)
def test_a_cycle_ends_just_beside_where_two_belts_run_together():
    """It is told apart where no pseudo-focus is about, around which loops are lost in rounding."""

    def numbers(velocity):
        laws = ("coulomb", 0.504701, 0.2643582), ("coulomb", 0.88806, 0.7142546)
        belts = (
            Belt(-0.7094468, laws[0], 1.68557, upper=0.751135),
            Belt(velocity, laws[1], 1.3878348, lower=-0.4312801),
        )
        return Oscillator(0.02107395, belts, 1.214963)

    osc = package.oscillator(numbers(-0.7))
    points = jb.scan(osc, lambda osc: osc.belts[1].velocity, (-0.73, -0.69))
    kinds = [jb.SlidingExchange((0, 1)), jb.GrazingSliding(0)]
    assert [point.condition for point in points] == kinds
    assert points[0].value == -0.7094468 and 4e-6 < points[1].value - points[0].value < 5e-6
    start, at = tuple(np.asarray(points[1].cycle.unknowns)[0, :2]), float(points[1].value)
    sides = [engine.attractor(numbers(at + away), start) for away in (-1e-8, 1e-8)]
    assert [side.kind for side in sides] == ["cycle", "equilibrium"]


# --- cycles that are easily lost: small ones, and ones that end in a corner -----------------------


SHARED = 1.15
AT_REST = jb.BeltAtRest(1)


def around_an_edge(nu1, damping=0.62):
    """A pseudo-focus on the edge between two belts, of which the right one comes to rest."""
    left = jb.Belt(0.125, jb.Conti(1.14, 0.79, 10.0), load=1.7, upper=SHARED)
    right = jb.Belt(nu1, jb.Conti(1.04, 0.51, 12.7), load=0.55, lower=SHARED)
    return jb.Oscillator(damping, (left, right), omega=1.15)


def its_oracle(nu1, damping=0.62):
    left = oracle.Belt(0.125, *oracle.conti(1.14, 0.79, 10.0), 1.7, upper=SHARED)
    right = oracle.Belt(nu1, *oracle.conti(1.04, 0.51, 12.7), 0.55, lower=SHARED)
    return oracle.Oscillator(damping, (left, right), 1.15)


def its_engine(nu1, damping=0.62):
    left = engine.Belt(0.125, ("conti", 1.14, 0.79, 10.0, 0.0), load=1.7, upper=SHARED)
    right = engine.Belt(nu1, ("conti", 1.04, 0.51, 12.7, 0.0), load=0.55, lower=SHARED)
    return engine.Oscillator(damping, (left, right), 1.15)


def rate_of_focus(nu1, damping=0.62):
    return oracle_cycles.pseudo_focus_rate(its_oracle(nu1, damping), SHARED)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("nu1", [-1e-3, 1e-3, 1e-4])
def test_a_cycle_as_small_as_a_belt_is_slow(nu1):
    """The focus repels, and where the mass overtakes the belt this brakes it."""
    assert rate_of_focus(nu1) > 0
    cycle = jb.find_cycle(around_an_edge(nu1), (1.2, 0.0))
    assert cycle.status == Status.OK and cycle.stable
    budget = dict(turns=True, extrema=True, max_events=5000)
    run = engine.simulate(its_engine(nu1), (1.2, 0.0), 40.0, **budget)
    x1, x2 = run.y[-100:].T  # the loops get shorter: some last ones
    # Both repeat to 1e-12; the loop is 1e-9 wide at 1e-4.
    assert (cycle.x1_min, cycle.x1_max) == pytest.approx((x1.min(), x1.max()), abs=1e-12)
    assert (cycle.x2_min, cycle.x2_max) == pytest.approx((x2.min(), x2.max()), abs=1e-9)
    assert float(cycle.x2_max) == pytest.approx(abs(nu1) / 1.15, rel=0.02)


@pytest.mark.slow(first=True)
def test_a_small_cycle_shrinks_to_the_focus_where_the_belt_is_at_rest():
    (point,) = jb.scan(around_an_edge, span=(-0.01, 0.01), resolution=6)
    assert point.condition == AT_REST and point.status == Status.OK
    assert point.value == 0 and point.x1 == SHARED
    (rest,) = jb.equilibria(around_an_edge(0.0))
    assert rest.kind == jb.EquilibriumKind.PSEUDO_FOCUS and rest.stable
    run = engine.simulate(its_engine(0.0), (1.2, 0.0), 40.0)
    assert run.status == engine.PSEUDO_FOCUS and run.y_end == (SHARED, 0.0)


@pytest.mark.slow(first=True)
def test_a_focus_that_repels_on_one_side_only():
    damping = 2.2
    assert rate_of_focus(-1e-6, damping) < 0 < rate_of_focus(1e-6, damping)
    (point,) = jb.scan(lambda nu1: around_an_edge(nu1, damping), span=(-0.01, 0.01), resolution=6)
    assert point.condition == AT_REST and point.value == 0


@pytest.mark.slow(first=True)
def test_a_focus_that_attracts_on_both_sides():
    damping = 3.0
    assert rate_of_focus(-1e-6, damping) < 0 and rate_of_focus(1e-6, damping) < 0

    def make(nu1):
        return around_an_edge(nu1, damping)

    assert jb.scan(make, span=(-0.01, 0.01), resolution=6) == ()
    assert jb.refine(AT_REST, make, at=0.001).status == Status.NOT_TOUCHED


@pytest.mark.slow(first=True)
def test_a_corner_that_the_error_of_an_orbit_moves():
    """Beyond it the stick phase lasts 1/36 of the way from it, so 1e-8 of the orbit are 1e-6."""

    def make(nu1):
        left = jb.Belt(0.84, jb.Conti(1.23, 0.83, 5.53), load=1.46, upper=0.6)
        right = jb.Belt(nu1, jb.Conti(1.0, 0.7, 10.0), load=0.99, lower=0.6)
        return jb.Oscillator(0.2475, (left, right))

    def seen(nu1, start):
        left = engine.Belt(0.84, ("conti", 1.23, 0.83, 5.53, 0.0), load=1.46, upper=0.6)
        right = engine.Belt(nu1, ("conti", 1.0, 0.7, 10.0, 0.0), load=0.99, lower=0.6)
        return engine.attractor(engine.Oscillator(0.2475, (left, right)), start)

    (point,) = jb.scan(make, span=(-0.18, -0.165), resolution=6)
    assert point.condition == jb.CornerCollision(0) and point.error < 1e-10
    value, start = float(point.value), (float(point.cycle.x1_max), 0.0)
    assert seen(value + 1e-8, start).kind == "cycle"
    assert seen(value - 1e-6, start).kind != "cycle"


@pytest.mark.slow
def test_a_cycle_that_hardly_attracts_shrinks_to_its_pseudo_hopf_point():
    """Where its multiplier is 1 - 3e-5 it is known to a ten-thousandth of its size."""

    def make(damping):
        right = jb.Belt(-0.5544, jb.Stribeck(0.5623, 0.2954, 0.3241), load=1.1053, lower=-0.3789)
        left = jb.Belt(0.3399, jb.Conti(0.9768, 0.7338, 5.3516), 0.8811, -1.4126, -1.0575)
        return jb.Oscillator(damping, (right, left), omega=1.1061)

    (point,) = jb.scan(make, span=(0.175, 0.182), resolution=6)
    assert point.condition == jb.PseudoHopf(0) and point.type == "supercritical"


@pytest.mark.slow(first=True)
def test_a_scan_ends_where_a_fold_of_cycles_explains_what_differs_beside_it():
    """Just before they meet, two small cycles around close edges are told from none no more."""
    laws = (
        jb.Stribeck(1.2680291173892104, 0.7289566527855321, 0.2836081013111068),
        jb.Conti(0.5337176820507991, 0.32950903749697996, 7.564122878061967, 0.10724645908958609),
    )

    def make(nu):
        belts = (
            jb.Belt(0.35119653416169805, laws[0], 0.5711931783868905, upper=-0.019601275688333697),
            jb.Belt(nu, laws[1], 1.6626790276232228, lower=-0.023343609120135778),
        )
        return jb.Oscillator(0.49616067385904467, belts)

    points = jb.scan(make, span=(-0.3396733297118405, 0.262960281920367))
    assert all(point.status == Status.OK for point in points)
    (fold,) = (point for point in points if point.kind == "FoldOfCycles")
    assert fold.value == pytest.approx(-0.159462417136, abs=1e-9)


#: Of Conti's law with these numbers, at the relative speed 0.95: mu, and minus its slope.
REST, HOPF = 0.6 / 10.5 + 0.4, 0.6 * 10.0 / 10.5**2


def with_an_edge_at_its_fixed_point(damping):
    """The belt touches to the right of where its friction is as large as the spring's force."""
    return jb.Oscillator(damping, (jb.Belt(-0.95, jb.Conti(1.0, 0.4, 10.0), lower=-REST),))


@pytest.mark.slow(first=True)
def test_around_a_fixed_point_on_an_edge_a_cycle_grows_in_proportion():
    """Loops a twentieth wider and narrower than it, followed by another program, come nearer."""
    belt = engine.Belt(-0.95, ("conti", 1.0, 0.4, 10.0, 0.0), 1.0, lower=-REST)
    widths = []
    for short in (2e-4, 1e-4):
        cycle = jb.find_cycle(with_an_edge_at_its_fixed_point(HOPF - short), (0.01 - REST, 0.0))
        told = jb.portrait(with_an_edge_at_its_fixed_point(HOPF - short))
        small = told.cycles[0]
        assert told.status == Status.OK and small.stable
        # From far off orbits take tens of thousands of loops.
        assert cycle.status == Status.NOT_SETTLED
        widths.append(float(small.x1_max) + REST)
        for part in (0.95, 1.05):
            start = part * widths[-1]
            osc = engine.Oscillator(HOPF - short, (belt,))
            run = engine.simulate(osc, (start - REST, 0.0), 400.0, turns=True)
            tops = run.y[(run.kind == engine.TURN) & (run.belt == 0), 0] + REST
            assert (tops[-1] - start) * (part - 1) < 0
    assert widths[0] == pytest.approx(2 * widths[1], rel=0.01)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("short", [1e-6, 1e-7, 0.0, -1e-7])
def test_loops_that_return_up_to_rounding_are_no_cycles(short):
    """Within 1e-6 of the Hopf point a cycle would be 2e-5 wide, or less. Where a loop passes the
    edge with an x2 of 1e-6, the rounding of x1 there, 5e-17, is one of 2e-11 in x2, which is more
    than the loop grows or shrinks by."""
    osc = with_an_edge_at_its_fixed_point(HOPF - short)
    assert jb.find_cycle(osc, (1e-5 - REST, 0.0)).status != Status.OK
    told = jb.portrait(osc)
    # Beyond them loops shrink; so do smaller ones where the fixed point attracts.
    assert told.status == (Status.OK if short < 0 else Status.INCOMPLETE)
    # Beside the gap the large cycles are there.
    assert all(float(cycle.x1_max) > 0 for cycle in (*told.cycles, *told.unstable))
    assert len(told.cycles) == len(told.unstable) == 1
    assert all(high < -REST + 1e-3 for _, high in told.gaps)


@pytest.mark.slow(first=True)
def test_a_hopf_point_on_an_edge_explains_the_loss_of_its_small_cycle():
    points = jb.scan(with_an_edge_at_its_fixed_point, span=(0.05, 0.06), resolution=6)
    assert [(point.kind, point.type) for point in points] == [("Hopf", "degenerate")]
    assert float(points[0].value) == pytest.approx(HOPF, abs=1e-14)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("damping", [0.1, 0.1001])
@pytest.mark.parametrize("has_another", [False, True])
def test_a_rest_that_vanishes_where_it_would_change_its_stability_has_both_points(
    damping, has_another
):
    """x1 = mu(v) = 1/2 + exp(-2v)/2 is at the edge 0.55 where exp(-2v) = 0.1, and mu'(v) = -zeta
    where exp(-2v) = zeta."""
    law = jb.Stribeck(1.0, 0.5, 0.5)
    belts = [jb.Belt(1.15, law, lower=0.55)]
    if has_another:
        belts += [jb.Belt(0.6, jb.Coulomb(0.5, 0.4), 0.5, upper=0.2)]
    osc = jb.Oscillator(damping, tuple(belts))
    for span in ((1.145, 1.155), (0.9, 1.4)):
        points = [p for p in jb.scan(osc, nu0, span) if isinstance(p.condition, SEEN)]
        assert sorted(str(point.condition) for point in points) == [
            "BoundaryEquilibrium(belt=0)",
            "Hopf()",
        ]
        for point in points:
            at = -0.5 * np.log(damping if point.kind == "Hopf" else 0.1)
            assert float(point.value) == pytest.approx(at, abs=1e-13)


SEEN = (jb.Hopf, jb.BoundaryEquilibrium)
