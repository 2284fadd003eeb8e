"""Contact edges of two belts that meet: against the oracle and closed forms."""

import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest

import jaxbelt as jb
from jaxbelt import Status
from jaxbelt.bifurcations.path import ParameterPath
from jaxbelt.bifurcations.pieces import nodes_of_stretch
from jaxbelt.model.variations import varied
from jaxbelt.numerics.continuation import Stop
from tests.campaign import engine
from tests.campaign.cases import PAPER

LAW = jb.Conti(1.0, 0.6, 10.0)
EXCHANGE, MEETING = jb.EdgeExchange((0, 1)), jb.MeetingEdges((0, 1))


def beside(upper, lower=0.4, nu=(0.2, -0.25), loads=(1.0, 1.0)):
    """Belt 0 up to one edge, belt 1 from another one on; both, or none, in between."""
    belts = (
        jb.Belt(nu[0], LAW, load=loads[0], upper=upper),
        jb.Belt(nu[1], LAW, load=loads[1], lower=lower),
    )
    return jb.Oscillator(0.5, belts)


def its_oracle(upper, lower=0.4, nu=(0.2, -0.25)):
    return oracle.class_d(*nu, lower, upper)


@pytest.mark.slow(first=True)
def test_a_cycle_passes_and_the_pseudo_focus_loses_its_stability():
    span = (0.37, 0.431)
    diagram = jb.bifurcation_diagram(beside, span=span, rows=24, resolution=8)
    corner, exchange, meeting = diagram.points
    assert [p.condition for p in (exchange, meeting)] == [EXCHANGE, MEETING]
    assert corner.condition == jb.CornerCollision(0) and corner.value < 0.4
    assert exchange.value == meeting.value == 0.4
    assert exchange.status == meeting.status == Status.OK and exchange.residual < 1e-12
    # At the point both edges are passed at once: class (c).
    at = oracle_cycles.sticking_cycle(oracle.class_c(0.2, -0.25, 0.4), (0.41, 0.2))
    assert exchange.cycle.period == pytest.approx(at.period, abs=1e-10)
    assert exchange.cycle.x1_max == pytest.approx(at.x1_max, abs=1e-11)
    # Beside it they are passed one after the other, in either order; the cycle goes on.
    orders = []
    for edge in (0.4 - 1e-6, 0.4 + 1e-6):
        cycle = oracle_cycles.sticking_cycle(its_oracle(edge), (0.41, 0.2))
        assert cycle.period == pytest.approx(at.period, abs=1e-4)
        orders.append([belt for kind, belt in cycle.signature if kind == "EDGE"])
    assert orders[0] != orders[1] and all(len(order) == 4 for order in orders)
    assert oracle_cycles.pseudo_focus_rate(its_oracle(0.4 - 1e-6), 0.4 - 1e-6) < 0
    assert oracle_cycles.pseudo_focus_rate(its_oracle(0.4 + 1e-6), 0.4) > 0
    # Two points at one value; the equilibrium and the cycle go on through both.
    rests, cycle = diagram.branches[:2]
    for branch in (rests, cycle):
        assert np.min(branch.values) < 0.399 and np.max(branch.values) == span[1]


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("guess", [0.39975, 0.4, 0.4005, 0.41])
def test_an_exchange_from_either_side(guess):
    """The corner at 0.3946 is beside it; at the guess 0.4 itself there is one edge."""
    point = jb.refine(EXCHANGE, beside, at=guess)
    assert point.status == Status.OK and point.value == pytest.approx(0.4, abs=1e-15)
    assert point.iterations <= 5 and point.residual < 1e-12 and point.error < 1e-14
    assert point.cycle.period == pytest.approx(1.3728405787, abs=1e-9)


@pytest.mark.parametrize(
    ("nu", "edge", "before", "after"),
    [
        # By the pushes left of both edges, between them (none, then both), right of both.
        ((0.35, 0.6), 0.75, 0, 1),
        ((0.35, 0.2), 0.6, 1, 0),
        pytest.param((0.35, 0.2), 0.72, 0, 0, marks=pytest.mark.slow(first=True)),
    ],
)
def test_what_rests_there_begins_or_ceases_to_be(nu, edge, before, after):
    def foci(osc):
        return sum(int(kind) == jb.EquilibriumKind.PSEUDO_FOCUS for kind in jb.equilibria(osc).kind)

    counts = [foci(beside(edge + offset, edge, nu)) for offset in (-1e-3, 1e-3)]
    assert counts == [before, after]
    point = jb.refine(MEETING, lambda upper: beside(upper, edge, nu), at=edge + 0.02)
    if before == after == 0:
        assert point.status == Status.NOT_TOUCHED and jnp.isnan(point.value)
    else:
        assert point.status == Status.OK and point.value == pytest.approx(edge, abs=1e-15)


def equal_belts(lower, unit=1.0):
    """Belt 1 from an edge on, belt 0 up to 1, of one velocity; in a unit of length."""
    law = jb.Conti(1.0, 0.6, 10.0 / unit)
    belts = (
        jb.Belt(0.2 * unit, law, load=unit, upper=unit),
        jb.Belt(0.2 * unit, law, load=unit, lower=lower * unit),
    )
    return jb.Oscillator(0.1, belts)


def kinds_of(points):
    return [(str(point.condition), int(point.status)) for point in points]


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(("last", "unit"), [(1.0, 1.0), (1.0, 10.0), (1.5, 1.0)])
def test_a_corner_that_is_close_to_where_edges_meet(last, unit):
    """Loops around the pseudo-focus are lost in rounding close to where the edges meet; that hides
    no corner, 2.3e-4 from there, of the cycle farther out."""
    span = (-0.5, last)
    points = jb.scan(lambda lower: equal_belts(lower, unit), span=span, resolution=16)
    (corner,) = (p for p in points if p.value < 1 and p.condition == jb.CornerCollision(0))
    assert corner.status == Status.OK
    assert corner.value == pytest.approx(0.9997714089, abs=1e-10)
    assert not any(point.kind == "Unexplained" for point in points)
    beside_it = [float(corner.value) + away for away in (-1e-7, 1e-7)]
    oscillators = [oracle.class_d(0.2, 0.2, lower, 1.0, damping=0.1) for lower in beside_it]
    signatures = [oracle_cycles.sticking_cycle(osc).signature for osc in oscillators]
    assert signatures[0] != signatures[1]


@pytest.mark.slow(first=True)
def test_edges_that_meet_in_the_middle_of_the_span():
    """There the belts have the same edges, elsewhere they do not."""
    points = jb.scan(equal_belts, span=(0.97, 1.03), resolution=12)
    assert kinds_of(points) == [
        ("CornerCollision(belt=1)", 0),
        ("CornerCollision(belt=0)", 0),
        ("EdgeExchange(belts=(0, 1))", 0),
        ("MeetingEdges(belts=(0, 1))", 0),
        ("GrazingEdge(belt=1)", 0),
    ]
    # A stick phase ends where the spring and the damping are as strong as friction.
    assert points[0].value == pytest.approx(1 - 0.1 * 0.2, abs=1e-12)


def test_belts_share_the_edges_that_are_one_along_the_path():
    def split(lower):
        first, last = equal_belts(lower).belts
        again = jb.Belt(0.1, LAW, lower=lower)
        return jb.Oscillator(0.1, (first, last, again))

    for span in ((0.5, 1.5), (0.9, 1.1), (1.0, 1.3), (0.7, 1.0)):
        assert ParameterPath(split, None, span).edged == [0, 1]


def test_a_stretch_between_a_point_and_edges_that_meet_close_to_it():
    path = ParameterPath(equal_belts, None, (-0.5, 1.5))
    for first, last in ((0.99977, 1.0), (1.0, 1.0002), (0.9, 1.0)):
        nodes = nodes_of_stretch(path, first, last, 60)
        assert first < nodes[0] and nodes[-1] < last and np.all(np.diff(nodes) > 0)


@pytest.mark.slow
def test_a_segment_between_the_edges():
    """Belt 1 is at rest: where both touch it holds what belt 0 pulls, to the right it does not."""
    osc = jb.Oscillator(
        0.5,
        (
            jb.Belt(0.55, jb.Coulomb(1.0, 0.5), upper=0.65),
            jb.Belt(0.0, jb.Coulomb(1.0, 0.5), lower=0.6),
        ),
        omega=0.5,
    )
    first, second = jb.scan(osc, lambda o: o.belts[1].lower, (0.6, 1.05), resolution=8)
    assert (first.condition, second.condition) == (MEETING, jb.BoundaryEquilibrium(1))
    assert first.value == 0.65 and second.value == pytest.approx(1.0, abs=1e-14)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("make", "span"),
    [
        # The pseudo-focus stays on the edge of belt 0, to the left, and stable.
        (lambda upper: beside(upper, 0.65, (0.35, -0.6)), (0.64, 0.66)),
        # The edge of a belt without load is that of nothing.
        (lambda upper: beside(upper, 0.4, loads=(1.0, 0.0)), (0.399, 0.401)),
    ],
)
def test_nothing_happens_where_they_meet(make, span):
    assert jb.scan(make, span=span, resolution=8) == ()


def test_where_they_meet():
    """Of straight and of bent ways, at ends of the span, too, but not where there can be no
    oscillator beyond; edges that go together do not count."""
    straight = varied(beside, None, (0.3,))
    bent = varied(lambda p: beside(p**2), None, (0.5,))
    assert straight.meetings(0.3, 0.5) == straight.meetings(0.4, 0.5) == {0.4: [(0, 1)]}

    def shrinking(lower):
        law = jb.Conti(1.0, 0.6, 10.0)
        left = jb.Belt(0.2, law, lower=lower, upper=0.4)
        return jb.Oscillator(0.5, (left, jb.Belt(-0.25, law, lower=0.4)))

    assert varied(shrinking, None, (0.3,)).meetings(0.3, 0.4) == {}
    ((value, belts),) = bent.meetings(0.5, 0.7).items()
    assert value == pytest.approx(np.sqrt(0.4), abs=1e-14) and belts == [(0, 1)]
    together = varied(lambda sigma: jb.presets.class_c(0.2, -0.25, sigma), None, (0.3,))
    assert together.meetings(0.3, 0.5) == {}


@pytest.mark.slow
def test_their_curves():
    """That of the cycle ends where a stick phase on belt 0 has no duration, and passes a point from
    which on it sticks to belt 1, too; the other one goes on."""

    def make(upper, nu1):
        return beside(upper, 0.4, (0.2, nu1))

    span = ((0.3, 0.5), (-0.5, -0.1))
    exchange, meeting = (
        jb.bifurcation_curve(jb.refine(one, beside, at=0.4005), make, span=span, step=0.02)
        for one in (EXCHANGE, MEETING)
    )
    for curve in (exchange, meeting):
        assert np.allclose(curve.values[:, 0], 0.4, rtol=0, atol=1e-15)
    assert np.ptp(meeting.values[:, 1]) == pytest.approx(0.4)
    assert exchange.ends == (Stop.STOPPED, Stop.LEFT_SPAN)
    end, passed = exchange.special
    assert [(one.kind, one.belts) for one in (end, passed)] == [
        ("DoubleSliding", (0,)),
        ("DoubleSliding", (1,)),
    ]

    def duration(nu1, belt=0):
        cycle = oracle_cycles.sticking_cycle(oracle.class_c(0.2, nu1, 0.4), (0.41, 0.2))
        return cycle.stick_durations[belt]

    at = passed.values[1]
    assert duration(at - 1e-4, 1) == 0 and 0 < duration(at + 1e-4, 1) < 0.1

    # It vanishes like a straight line.
    values = end.values[1] + np.array([1e-3, 2e-3])
    slope = np.diff([duration(nu1) for nu1 in values])[0] / 1e-3
    assert duration(values[0]) == pytest.approx(slope * 1e-3, rel=0.05)
    at = jb.refine(EXCHANGE, lambda upper: make(upper, -0.15), at=0.401)
    expected = oracle_cycles.sticking_cycle(oracle.class_c(0.2, -0.15, 0.4), (0.41, 0.2))
    assert at.cycle.period == pytest.approx(expected.period, abs=1e-10)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("span", [(0.4, 0.42), (0.38, 0.4)])
def test_edges_that_meet_at_an_end_of_the_span(span):
    """What is told inside of a span is told at its ends."""
    law = jb.Conti(static=1.0, residual=0.6, steepness=10.0)

    def make(upper):
        return jb.Oscillator(0.5, (jb.Belt(0.2, law, upper=upper), jb.Belt(-0.25, law, lower=0.4)))

    told = jb.scan(make, span=span, resolution=8)
    there = [one.condition for one in told if float(one.value) == pytest.approx(0.4, abs=1e-9)]
    assert there == [jb.EdgeExchange((0, 1)), MEETING]
    assert all(one.status == jb.Status.OK for one in told)


def attractor(upper, y0):
    """What the campaigns' engine comes to."""
    belts = engine.Belt(0.2, PAPER, upper=upper), engine.Belt(-0.25, PAPER, lower=0.4)
    return engine.attractor(engine.Oscillator(0.5, belts), y0)


@pytest.mark.slow(first=True)
def test_an_orbit_that_settles_slowly():
    """Loops around both edges, of which each is by a hundredth nearer to the cycle."""
    cycle, seen = jb.find_cycle(beside(0.4004), (0.4, 0.1)), attractor(0.4004, (0.4, 0.1))
    assert cycle.status == Status.OK and cycle.multiplier == pytest.approx(0.98769, abs=1e-5)
    assert cycle.period == pytest.approx(seen.period, abs=1e-8)
    assert (cycle.x1_min, cycle.x1_max) == pytest.approx(seen.x1, abs=1e-8)


@pytest.mark.slow(first=True)
def test_a_small_cycle_within_an_unstable_one_within_another():
    (fold,) = jb.scan(beside, span=(0.4002, 0.405), resolution=8)
    assert fold.kind == "FoldOfCycles" and fold.error < 1e-11
    # Shortly before it the engine comes to it, beyond to the cycle that sticks.
    start = float(fold.cycle.x1_max), 0.0
    for way, reached in ((-1e-5, 0.406), (1e-5, 0.419)):
        seen = attractor(float(fold.value) + way, start)
        assert seen.kind == "cycle" and seen.x1[1] == pytest.approx(reached, abs=1e-3)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(("gap", "speed"), [(1e-5, 9e-3), (1e-6, 6e-3), (1e-15, 9e-3)])
def test_a_pseudo_focus_does_not_capture_loops_around_another_edge(gap, speed):
    """Small loops around one of the edges shrink, larger ones around both grow; where the two are
    one but for rounding all do."""
    nu, upper = (0.15, -0.3), 0.4 - gap
    osc, start = beside(upper, nu=nu), (upper, speed)
    (rest,) = jb.equilibria(osc)
    belts = engine.Belt(nu[0], PAPER, upper=upper), engine.Belt(nu[1], PAPER, lower=0.4)
    seen = engine.attractor(engine.Oscillator(0.5, belts), start)
    assert rest.kind == jb.EquilibriumKind.PSEUDO_FOCUS and seen.kind == "cycle"
    assert bool(rest.stable) == (gap > 1e-12)
    assert jb.simulate(osc, start, 1.0).status == Status.OK
    cycle = jb.find_cycle(osc, start)
    assert (cycle.x1_min, cycle.x1_max) == pytest.approx(seen.x1, abs=1e-9)
    told = jb.sweep(lambda: osc, {"x2": np.array([speed, 0.1])}, y0=start, observe="attractor")
    assert jb.decoded(told).kind.values[0] == "cycle"


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_edges_of_a_split_belt_meet_another_one(way):
    """Both halves change together where the edges have changed places; also in the mirror."""
    law = jb.presets.paper_friction()

    def make(edge):
        ends = dict(upper=edge) if way > 0 else dict(lower=-edge)
        other = dict(lower=0.0) if way > 0 else dict(upper=0.0)
        halves = [jb.Belt(-0.5 * way, law, load=0.125, **ends)] * 2
        return jb.Oscillator(0.25, [*halves, jb.Belt(0.25 * way, law, load=0.5, **other)])

    for half in (0, 1):
        point = jb.refine(jb.MeetingEdges((half, 2)), make, at=0.01)
        assert point.status == jb.Status.OK and abs(float(point.value)) < 1e-12


def curve_ends(of, make, span, step):
    """Ends of a curve in its rows, how it ends there, and its special points."""
    curve = jb.bifurcation_curve(of, make, span, step=step)
    assert np.max(curve.residual) < 1e-12
    # An end with a name is the special point itself, in the order of the path, too.
    named = [curve.is_named(end) for end in (0, -1)]
    values = [special.values for special in curve.special]
    assert all(tuple(curve.values[end]) in values for end in (0, -1) if named[end])
    return curve.values[[0, -1]], curve.ends, [one.kind for one in curve.special], named


def touching(upper, other=0.75, velocity=0.35, load=1.0):
    """Both belts to the left of their edges."""
    belts = jb.Belt(velocity, LAW, upper=upper), jb.Belt(0.6, LAW, load=load, upper=other)
    return jb.Oscillator(0.5, belts)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("step", [0.5, 0.1, 0.03])
def test_a_curve_ends_where_the_mass_ceases_to_rest_at_the_edges(step):
    """Between where nothing pushes from the right, at 0, and where both belts pull no farther."""
    point = jb.refine(MEETING, touching, at=0.76)
    expected = np.array([[0.0, 0.0], [1.0, 1.0]]) * (1.2 + 0.4 / 4.5 + 0.4 / 7.0)
    for unit, way in ((1.0, 1), (1e3, 1), (1.0, -1)):

        def make(p, q, unit=unit, way=way):
            return touching(*(value / unit for value in (p, q)[::way]))

        span = ((-3 * unit, 3 * unit),) * 2
        values, ends, special, named = curve_ends(point, make, span, step)
        assert ends == (Stop.STOPPED, Stop.STOPPED) and named == [True, True]
        assert special == ["BoundaryEquilibrium"] * 2
        np.testing.assert_allclose(values, unit * expected, rtol=0, atol=1e-12 * unit)


def test_a_curve_may_begin_at_its_end():
    def make(upper, lower):
        return beside(upper, lower, nu=(0.35, 0.6))

    point = jb.refine(MEETING, lambda upper: make(upper, 0.0), at=0.01)
    assert point.status == Status.OK and point.value == 0
    values, _, special, named = curve_ends(point, make, ((-3.0, 3.0), (-3.0, 3.0)), 0.1)
    assert special == ["BoundaryEquilibrium"] * 2 and named == [True, True]
    np.testing.assert_allclose(values[0], 0, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "span", "kinds", "end"),
    [
        # The pull of belt 0 is less than the spring's, the rest is that of the load.
        ("load", (0.0, 3.0), ["BoundaryEquilibrium"], (0.15 - 0.4 / 4.5) / (0.6 + 0.4 / 7.0)),
        # Belt 0 pulls to the other side where it turns round.
        ("velocity", (-1.0, 3.0), ["BeltAtRest", "EqualVelocities"], 0.0),
    ],
)
def test_a_curve_ends_where_a_belt_pulls_no_more(name, span, kinds, end):
    def make(upper, value):
        return touching(upper, **{name: value})

    point = jb.refine(MEETING, touching, at=0.76)
    for step in (0.2, 0.03):
        around = ((0.5, 1.0), span)
        at = {"load": (0.75, 1.0), "velocity": (0.75, 0.35)}[name]
        curve = jb.bifurcation_curve(point, make, around, at=at, step=step)
        assert curve.ends == (Stop.STOPPED, Stop.LEFT_SPAN)
        assert [one.kind for one in curve.special] == kinds and curve.is_named(0)
        assert curve.values[0] == pytest.approx((0.75, end), abs=1e-12)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(("side", "first", "last"), [("upper", -1.0, 1.0), ("lower", -0.3, 1.7)])
def test_a_curve_ends_where_a_belt_at_rest_holds_no_more(side, first, last):
    """Belt 0 at rest holds 1, between the edges alone or with belt 1, which pulls with 0.7."""

    def make(upper, other):
        belts = jb.Belt(0.0, LAW, upper=upper), jb.Belt(0.3, LAW, **{side: other})
        return jb.Oscillator(0.5, belts)

    point = jb.refine(MEETING, lambda upper: make(upper, 0.5), at=0.52)
    for step in (0.2, 0.05):
        found = curve_ends(point, make, ((-3.0, 3.0), (-3.0, 3.0)), step)
        values, _, special, named = found
        assert special == ["BoundaryEquilibrium"] * 2 and named == [True, True]
        np.testing.assert_allclose(values, [[first] * 2, [last] * 2], rtol=0, atol=1e-12)
