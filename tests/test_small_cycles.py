"""Cycles that are easily lost: small ones around a pseudo-focus, and ones that end in a corner."""

import oracle
import oracle_cycles
import pytest

import jaxbelt as jb
from jaxbelt import Status
from tests.campaign import engine

EDGE = 1.15
AT_REST = jb.BeltAtRest(1)


def around_an_edge(nu1, damping=0.62):
    """A pseudo-focus on the edge between two belts, of which the right one comes to rest."""
    left = jb.Belt(0.125, jb.Conti(1.14, 0.79, 10.0), load=1.7, upper=EDGE)
    right = jb.Belt(nu1, jb.Conti(1.04, 0.51, 12.7), load=0.55, lower=EDGE)
    return jb.Oscillator(damping, (left, right), omega=1.15)


def its_oracle(nu1, damping=0.62):
    left = oracle.Belt(0.125, *oracle.conti(1.14, 0.79, 10.0), 1.7, upper=EDGE)
    right = oracle.Belt(nu1, *oracle.conti(1.04, 0.51, 12.7), 0.55, lower=EDGE)
    return oracle.Oscillator(damping, (left, right), 1.15)


def its_engine(nu1, damping=0.62):
    left = engine.Belt(0.125, ("conti", 1.14, 0.79, 10.0, 0.0), load=1.7, upper=EDGE)
    right = engine.Belt(nu1, ("conti", 1.04, 0.51, 12.7, 0.0), load=0.55, lower=EDGE)
    return engine.Oscillator(damping, (left, right), 1.15)


def rate(nu1, damping=0.62):
    return oracle_cycles.pseudo_focus_rate(its_oracle(nu1, damping), EDGE)


@pytest.mark.parametrize("nu1", [-1e-3, 1e-3, 1e-4])
def test_a_cycle_as_small_as_a_belt_is_slow(nu1):
    """The focus repels, and where the mass overtakes the belt this brakes it."""
    assert rate(nu1) > 0
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
def test_it_shrinks_to_the_focus_where_the_belt_is_at_rest():
    (point,) = jb.scan(around_an_edge, span=(-0.01, 0.01), resolution=6)
    assert point.condition == AT_REST and point.status == Status.OK
    assert point.value == 0 and point.x1 == EDGE
    (rest,) = jb.equilibria(around_an_edge(0.0))
    assert rest.kind == jb.EquilibriumKind.PSEUDO_FOCUS and rest.stable
    run = engine.simulate(its_engine(0.0), (1.2, 0.0), 40.0)
    assert run.status == engine.PSEUDO_FOCUS and run.y_end == (EDGE, 0.0)


@pytest.mark.slow(first=True)
def test_a_focus_that_repels_on_one_side_only():
    damping = 2.2
    assert rate(-1e-6, damping) < 0 < rate(1e-6, damping)
    (point,) = jb.scan(lambda nu1: around_an_edge(nu1, damping), span=(-0.01, 0.01), resolution=6)
    assert point.condition == AT_REST and point.value == 0


@pytest.mark.slow(first=True)
def test_a_focus_that_attracts_on_both_sides():
    damping = 3.0
    assert rate(-1e-6, damping) < 0 and rate(1e-6, damping) < 0

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
