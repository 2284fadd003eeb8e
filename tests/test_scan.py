"""The points that `scan` finds by itself, against the exact table, simulation and the oracle."""

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest
from laws import BELL, NESTED, bell, nested
from scipy.optimize import brentq, minimize_scalar
from where import nu0

import jaxbelt as jb
from jaxbelt import EventKind, Status
from jaxbelt.bifurcations.conditions import CycleEquation
from jaxbelt.bifurcations.path import ParameterPath
from jaxbelt.bifurcations.scan import search
from jaxbelt.model.parameters import leaf_index, vary

# Class (b), nu1 = 0.35: the paper's seven points and the one that it misses, see test_bifurcations.
POINTS = [
    (jb.NonsmoothFold(1), -0.561302406210),
    (jb.GrazingSliding(0), -0.455724862289),
    (jb.Hopf(), -0.263654916039),
    (jb.GrazingSliding(1), -0.078804734107),
    (jb.SuddenSliding(0), 0.0),
    (jb.Hopf(), 0.263654916039),
    (jb.SlidingExchange((0, 1)), 0.35),
    (jb.NonsmoothFold(1), 0.538734800481),
]


def values_of(points):
    return [float(point.value) for point in points]


def test_the_papers_path():
    """All of them, in order, nothing else; to the 1e-11 that they are known to."""
    points = jb.scan(jb.presets.class_b(0.3, 0.35), nu0, (-1.0, 1.0))
    assert [point.condition for point in points] == [condition for condition, _ in POINTS]
    assert np.allclose(values_of(points), [v for _, v in POINTS], rtol=0, atol=2e-11)
    for point in points:
        assert point.status == Status.OK and point.error < 1e-10
        assert (point.kind == "NonsmoothFold") == bool(point.multiplier > 1)


def test_several_points_between_two_of_the_first_values():
    """Asked at five values only, it still sees the fold and two grazing points in one interval."""
    points = jb.scan(jb.presets.class_b(0.3, 0.45), nu0, (-1.0, 1.0), resolution=4)
    fine = jb.scan(jb.presets.class_b(0.3, 0.45), nu0, (-1.0, 1.0))
    assert [point.condition for point in points] == [point.condition for point in fine]
    assert np.allclose(values_of(points), values_of(fine), rtol=0, atol=1e-11)
    inside = [point.condition for point in points if -0.55 < point.value < -0.3]
    assert inside == [jb.NonsmoothFold(1), jb.GrazingSliding(0), jb.GrazingSliding(1)]
    expected = oracle_cycles.grazing(lambda nu: oracle.class_b(nu, 0.45), (-0.35, -0.32), 1)
    assert points[2].value == pytest.approx(expected, abs=1e-9)


def test_a_path_in_the_damping():
    """No velocity is varied, and the answer was not known beforehand."""
    points = jb.scan(jb.presets.class_b(-0.2, 0.35), lambda osc: osc.damping, (0.0, 1.5))
    assert [point.condition for point in points] == [
        jb.Hopf(),
        jb.GrazingSliding(1),
        jb.NonsmoothFold(0),
    ]

    def at(zeta):
        return oracle.class_b(-0.2, 0.35, damping=zeta)

    # The trace vanishes where zeta is the sum of p3 (mus - p1) / (1 + p3 |nu|)^2, eq. (27).
    assert points[0].value == pytest.approx(4 / 3**2 + 4 / 4.5**2, abs=1e-14)
    grazing, fold = values_of(points[1:])
    expected = oracle_cycles.grazing(at, (grazing - 0.01, grazing + 0.01), 1)
    assert grazing == pytest.approx(expected, abs=1e-9)
    expected = oracle_cycles.nonsmooth_fold(at, (fold - 0.01, fold + 0.01), 0)
    assert fold == pytest.approx(expected, abs=1e-9)


@pytest.mark.slow(first=True)
def test_folds_of_a_law_that_jumps():
    """Belt 0 holds 0.5 and drags with 0.4: beyond its folds, to both sides, there is no cycle."""
    belts = (jb.Belt(0.3, jb.Coulomb(1.0, 0.8), load=0.5), jb.Belt(0.35, jb.Conti(1.0, 0.6, 10.0)))
    points = jb.scan(jb.Oscillator(0.5, belts), nu0, (-0.6, 0.6))
    kinds = [jb.NonsmoothFold(0), jb.SuddenSliding(0), jb.NonsmoothFold(0)]
    assert [point.condition for point in points] == kinds
    mu, static = oracle.conti(1.0, 0.6, 10.0)

    def make(nu):
        belts = (oracle.Belt(nu, lambda r: 0.8, 1.0, 0.5), oracle.Belt(0.35, mu, static, 1.0))
        return oracle.Oscillator(0.5, belts, 1.0)

    for point in (points[0], points[2]):
        bracket = (float(point.value) - 0.01, float(point.value) + 0.01)
        expected = oracle_cycles.nonsmooth_fold(make, bracket, 0)
        assert point.value == pytest.approx(expected, abs=1e-11) and point.multiplier == np.inf


def load1(osc):
    return osc.belts[1].load


def pair(damping, *belts):
    """Two belts, (velocity, residual, steepness, load) each; and the same for the oracle."""
    own = [
        jb.Belt(nu, jb.Conti(1.0, residual, steepness), load=load)
        for nu, residual, steepness, load in belts
    ]
    laws = [oracle.conti(1.0, residual, steepness) for _, residual, steepness, _ in belts]
    others = [
        oracle.Belt(nu, *law, load) for law, (nu, _, _, load) in zip(laws, belts, strict=True)
    ]
    return jb.Oscillator(damping, own), oracle.Oscillator(damping, tuple(others), 1.0)


def held_by(load):
    """The cycle arrives twice at the boundary of belt 1, which can hold little."""
    return pair(0.45, (-0.1, 0.4, 12.0, 1.1), (0.035, 0.3, 4.0, load))


@pytest.fixture(scope="module")
def crossing():
    return jb.scan(held_by(0.3)[0], load1, (0.1, 0.5), resolution=48)


@pytest.mark.slow(first=True)
def test_crossing_sliding(crossing):
    """At the end of slip onset, where a phase of no duration begins, and at the other end."""
    assert [point.condition for point in crossing] == [jb.CrossingSliding(1)] * 2
    for point, arrivals, width in zip(crossing, (2, 1), (0.01, 0.02), strict=True):
        bracket = (float(point.value) - width, float(point.value) + width)
        expected = oracle_cycles.crossing_sliding(
            lambda load: held_by(load)[1], bracket, 0, 1, arrivals
        )
        assert point.value == pytest.approx(expected, abs=1e-11)
        assert point.residual < 1e-12 and point.error < 1e-11
    assert [point.type for point in crossing] == ["crossing", "buckling"]
    cross, stick, slip = EventKind.CROSS, EventKind.STICK, EventKind.SLIP
    expected = [
        {(cross, 1): 2, (stick, 0): 1, (slip, 0): 1},
        {(cross, 1): 1, (stick, 1): 1, (slip, 1): 1, (stick, 0): 1, (slip, 0): 1},
        {(stick, 1): 1, (slip, 1): 1, (stick, 0): 1, (slip, 0): 1},
    ]
    for load, events in zip((0.12, 0.18, 0.3), expected, strict=True):
        assert Counter(jb.find_cycle(held_by(load)[0], (3.0, 0.0)).signature) == events


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("offset", [-0.01, 0.01])
def test_crossing_sliding_from_either_side(crossing, number, offset):
    exact = crossing[number].value
    point = jb.refine(jb.CrossingSliding(1), held_by(exact + offset)[0], where=load1)
    assert point.value == pytest.approx(float(exact), abs=1e-12) and point.iterations <= 6


@pytest.mark.slow(first=True)
def test_a_curve_of_crossing_sliding(crossing):
    """Rows of it are what is refined near them."""
    where, span = (load1, lambda osc: osc.belts[1].velocity), ((0.1, 0.5), (0.02, 0.06))
    curve = jb.bifurcation_curve(crossing[1], where, span, step=0.004)
    assert set(curve.kinds) == {"CrossingSliding"} and len(curve) > 8
    assert np.max(curve.residual) < 1e-12
    for load, nu in curve.values[1:-1:3].tolist():
        guess = pair(0.45, (-0.1, 0.4, 12.0, 1.1), (nu, 0.3, 4.0, load + 1e-3))[0]
        point = jb.refine(jb.CrossingSliding(1), guess, where=load1)
        assert point.value == pytest.approx(load, abs=1e-10)


def test_a_fold_of_an_orbit_that_repels_strongly():
    """What is followed forwards to the tangency grows by more than a thousand in one loop."""

    def make(load):
        return pair(0.82, (0.47, 0.64, 9.5, 0.67), (0.235, 0.54, 15.0, load))

    (point,) = jb.scan(make(1.0)[0], load1, (1.1, 1.3), resolution=16)
    assert point.condition == jb.NonsmoothFold(1) and point.multiplier > 1e3
    bracket = (float(point.value) - 0.01, float(point.value) + 0.01)
    expected = oracle_cycles.nonsmooth_fold(lambda load: make(load)[1], bracket, 1)
    # Steps halved change it by less than the bound, 4e-11.
    assert point.value == pytest.approx(expected, abs=1e-10) and point.error < 1e-10


@pytest.mark.slow
def test_an_orbit_that_still_grows_is_no_cycle():
    """From beside an unstable equilibrium it takes hundreds of arcs until it first sticks."""
    belts = (
        jb.Belt(0.95, jb.Stribeck(1.2, 0.72, 0.15), 2.0, upper=0.35),
        jb.Belt(0.93, jb.Conti(0.5, 0.3, 1.0), 2.0),
    )
    osc = jb.Oscillator(0.05, belts, omega=0.5)
    path = ParameterPath(osc, lambda osc: osc.belts[1].velocity, (0.932, 0.935))
    path.find_labels([0.9333, 0.93331195])
    assert [len(path.cycles[value]) for value in (0.9333, 0.93331195)] == [1, 1]


@pytest.mark.slow
def test_nested_cycles_in_one_mode():
    """Each ends in a fold, where the other one goes on."""
    path = ParameterPath(
        jb.Oscillator(0.5, (jb.Belt(1.0, NESTED),)), lambda osc: osc.damping, (0.497, 0.508)
    )
    points = search(path, resolution=32)
    assert [point.condition for point in points] == [jb.FoldOfCycles()] * 2

    def make(damping):
        return oracle.Oscillator(damping, (oracle.Belt(1.0, nested, 3.0, 1.0),), 1.0)

    expected = (
        oracle_cycles.fold_of_cycles(make, (0.497, 0.4995), (0.15, 0.3), attracts_inside=True),
        oracle_cycles.fold_of_cycles(make, (0.5045, 0.5065), (0.3, 0.45)),
    )
    assert values_of(points) == pytest.approx(expected, abs=1e-9)
    path.find_labels([0.4975, 0.5, 0.5075])
    unit = path.variation.own.length
    amplitudes = [
        [unit * float(np.ptp(one.loop.entries[:, 0])) / 2 for one in path.cycles[value]]
        for value in (0.4975, 0.5, 0.5075)
    ]
    assert [len(sizes) for sizes in amplitudes] == [1, 2, 1]
    # To first order in the damping less 0.5, so up to some per cent.
    assert sorted(amplitudes[1]) == pytest.approx([0.2, 0.4], rel=0.02)


def bell_oracle(nu):
    return oracle.Oscillator(0.4, (oracle.Belt(nu, bell, 1.0, 1.0),), 1.0)


@pytest.mark.slow
def test_small_cycles_that_do_not_stick():
    """They begin at a supercritical Hopf point and grow until they touch the boundary; on the far
    side they end beyond a subcritical one, which the scan below goes up to."""
    osc = jb.Oscillator(0.4, (jb.Belt(0.3, BELL),))
    points = jb.scan(osc, nu0, (0.02, 0.49))
    kinds = [jb.Hopf(), jb.GrazingSliding(0), jb.GrazingSliding(0), jb.Hopf()]
    assert [point.condition for point in points] == kinds
    for point, bracket in ((points[1], (0.09, 0.1)), (points[2], (0.44, 0.46))):
        expected = oracle_cycles.nonsmooth_fold(bell_oracle, bracket, 0)
        assert point.value == pytest.approx(expected, abs=1e-11) and 0 < point.multiplier < 1
    for point, sign in ((points[0], -1), (points[3], 1)):
        x = float(point.value) / 0.4  # a trace of zero, -mu' = zeta
        assert 2 * x / (1 + x**2) ** 2 == pytest.approx(0.4, abs=1e-14)
        assert np.sign(jb.lyapunov_coefficient(point.oscillator)) == sign
    # In between the cycle is there: r^2 = -(trace/2)/a, up to a percent so far from the point.
    beyond = jb.Oscillator(0.4, (jb.Belt(float(points[0].value) + 2e-3, BELL),))
    cycle = jb.find_cycle(beyond, (float(jb.equilibria(beyond).x1[0]) + 0.05, 0.0))
    assert cycle.stable and cycle.signature == ()
    rate, a = jb.equilibria(beyond).rate[0], jb.lyapunov_coefficient(beyond)[0]
    amplitude = 0.5 * (cycle.x1_max - cycle.x1_min)
    assert amplitude == pytest.approx(np.sqrt(float(-rate / a)), rel=0.02)


@pytest.mark.slow
def test_a_fold_of_cycles_is_found_once():
    """Beyond it orbits linger where the cycles were."""
    osc = jb.Oscillator(0.4, (jb.Belt(0.3, BELL),))
    points = jb.scan(osc, nu0, (0.47, 0.7))
    assert [point.condition for point in points] == [jb.Hopf(), jb.FoldOfCycles()]
    expected = oracle_cycles.fold_of_cycles(bell_oracle, (0.49, 0.503), (0.2, 0.8))
    assert points[1].value == pytest.approx(expected, abs=1e-11)


@pytest.mark.slow
def test_a_fold_of_cycles_beyond_which_there_is_nothing():
    """Negative damping: a cycle that crosses the boundary meets an unstable one, and beyond all
    orbits grow without bounds. It begins at a crossing-sliding point, and not before: where it
    would cross the boundary on the stretch that holds the mass, it is none."""

    def make(damping):
        return oracle.class_a(0.3, damping=damping)

    path = ParameterPath(jb.presets.class_a(0.3), lambda osc: osc.damping, (-0.605, -0.59))
    fold, crossing = search(path, 12)
    assert (fold.condition, crossing.condition) == (jb.FoldOfCycles(), jb.CrossingSliding(0))

    def least_growth(damping):
        """Of a loop from (x1, 0), which crosses the boundary twice; 0 on a cycle."""

        def growth(x1):
            tops = []

            def until(item):
                tops.extend([item.x1] if isinstance(item, oracle.Loop) and item.axis == 0 else [])
                return len(tops) == 2

            mode, *_ = oracle.start_mode(make(damping), x1, 0.0)
            oracle.advance(make(damping), (x1, 0.0), mode, 100.0, until=until)
            return tops[-1] - x1

        best = minimize_scalar(
            growth, bounds=(1.3719, 1.3728), method="bounded", options={"xatol": 1e-8}
        )
        assert 1.372 < best.x < 1.3727
        return best.fun

    expected = brentq(least_growth, -0.59596, -0.5959, xtol=1e-14)
    assert fold.value == pytest.approx(expected, abs=1e-10)
    expected = oracle_cycles.crossing_sliding(make, (-0.596, -0.595), 0, 0, 2)
    assert crossing.value == pytest.approx(expected, abs=1e-11)
    for value, cycles in path.cycles.items():
        assert len(cycles) == 1
        sticks = any(0 in mode for mode in cycles[0].path)
        assert sticks == (value > crossing.value)


class _Jump(CycleEquation):
    """Changes its sign without a zero where the damping is 0.5."""

    def equation(self, osc, chain, z):
        return jnp.where(osc.damping > 0.5, 1.0, -1.0)


@pytest.mark.slow(first=True)
def test_a_change_that_no_condition_explains_is_reported():
    (point,) = jb.scan(
        jb.presets.class_a(0.2),
        lambda osc: osc.damping,
        (0.45, 0.57),
        resolution=8,
        conditions=[_Jump()],
    )
    assert point.kind == "Unexplained" and point.status == Status.UNEXPLAINED
    assert point.value == pytest.approx(0.5, abs=1e-9)  # known to 1e-9 of the span
    told = f"BifurcationPoint(Unexplained(), value {float(point.value):.12g}, error < "
    assert repr(point).startswith(told) and "Simulate on both sides" in repr(point)
    # All that moves there goes on.
    assert [len(side.cycles) for side in point.sides] == [0, 0]
    assert point.sides[0].value < 0.5 < point.sides[1].value


class Gauss(jb.AbstractFriction):
    """mu(r) = 1 + 0.5 exp(-(r/speed)^2) + 0.4 r, in m/s."""

    speed: jax.Array

    @property
    def static(self):
        return jnp.asarray(1.5)

    def mu(self, r):
        return 1 + 0.5 * jnp.exp(-((r / self.speed) ** 2)) + 0.4 * r


@pytest.mark.slow
def test_a_fold_squeezed_together_with_a_canard_is_told_by_how_its_branches_end():
    """By bisection with two engines stick-slip ends at 0.1879264811 m/s."""
    law = Gauss(jnp.asarray(0.001))
    machine = jb.Machine(1.0, 2.0, 0.0, (jb.PhysicalBelt(0.188, law, 1.0),))
    osc, per = machine.oscillator, float(machine.oscillator.belts[0].velocity) / 0.188

    def where(osc):
        return osc.belts[0].velocity

    (point,) = jb.scan(osc, where, (0.15 * per, 0.25 * per), resolution=16)
    assert point.kind == "Unexplained"
    assert point.value / per == pytest.approx(0.1879264811, abs=2e-10)
    below, above = point.sides
    (cycle,) = below.cycles
    assert not above.cycles and "STICK 0 SLIP 0" in repr(point)
    # It still sticks for a quarter of its period; the loop that parts it from rest is close by.
    assert cycle.stick_durations[0] > 1.5 and cycle.multiplier == 0
    (jump,), (inside,) = below.jumps, below.inside
    assert 0.4 < jump < 0.6 and 0 < inside < 1e-4
    found = jb.refine(jb.NonsmoothFold(0), osc, where=where)
    assert found.status != Status.OK and len(found.sides[0].cycles) == 1
    # Between a stable rest and a cycle that attracts there has to be something.
    beside = (replace(osc.belts[0], velocity=jnp.asarray(point.value - 1e-5 * per)),)
    portrait = jb.portrait(replace(osc, belts=beside))
    assert portrait.status == Status.INCOMPLETE and len(portrait.cycles) == 1
    ((low, high),) = portrait.gaps
    assert high < portrait.cycles[0].x1_max < high + 1e-4 and high - low < 1e-9


@pytest.mark.slow(first=True)
def test_a_search_that_is_left_says_so(monkeypatch):
    monkeypatch.setattr("jaxbelt.bifurcations.scan.MOST_ATTEMPTS", 0)
    osc = jb.presets.class_b(0.45, 0.35)
    with pytest.warns(UserWarning, match="was not looked into in"):
        points = jb.scan(osc, lambda osc: osc.belts[0].velocity, (0.1, 0.7), resolution=24)
    left = [point for point in points if point.status == Status.INCOMPLETE]
    # The intervals have all that it did not come to, and what it has is kept.
    for value in (0.263654916039, 0.538734800481):
        assert any(abs(point.value - value) <= point.error for point in left)
    assert any(point.status == Status.OK for point in points)


@pytest.mark.parametrize(
    ("span", "message"),
    [
        ((1.0, -1.0), "span must be .first, last., two numbers with first < last, got .1"),
        ((0.0, np.inf), "span must be finite"),
        ((-1.0, 1.0), "load of belt 0 must be >= 0"),
    ],
)
def test_impossible_spans_are_named(span, message):
    with pytest.raises(ValueError, match=message):
        jb.scan(jb.presets.class_b(0.3, 0.35), lambda osc: osc.belts[0].load, span)


def brute_force(osc, where, values, starts):
    """Belts that each start sticks to in the end, [values, starts, belts]; plain simulation."""
    index, end = leaf_index(osc, where), 160.0

    def sticks(value, start):
        run = jb.simulate(
            vary(osc, index, value[None]), start, end, rtol=1e-6, atol=1e-6, max_segments=512
        )
        late = (run.events.t > 0.75 * end) & (run.events.kind == EventKind.STICK)
        return jnp.stack([jnp.any(late & (run.events.belt == k)) for k in range(len(osc.belts))])

    lanes = jax.jit(jax.vmap(jax.vmap(sticks, (None, 0)), (0, None)))
    return np.asarray(lanes(jnp.asarray(values), jnp.asarray(starts)))


#: What is found where, belts stuck to in the stretches between the points, and "rest" is stable.
STRETCHES = ["rest", "rest 1", "rest 01", "01", "0", "0", "rest 0", "rest 1", "rest"]


@pytest.mark.slow
def test_simulation_agrees_between_any_two_points():
    values = [-1.0, *(value for _, value in POINTS), 1.0]
    places = [np.linspace(a, b, 4)[1:-1] for a, b in pairwise(values)]
    # Far out; at the fixed points, which all lie between -0.7 and 1.7; and on either side.
    osc = jb.presets.class_b(0.3, 0.35)
    starts = np.array([(3.0, 0.0), (0.0, 0.3), (-2.0, -0.5)])
    found = brute_force(osc, nu0, np.concatenate(places), starts).reshape(len(places), 2, 3, 2)
    for stretch, expected in zip(found, STRETCHES, strict=True):
        belts = {int(belt) for belt in expected if belt.isdigit()}
        for place in stretch:
            seen = {tuple(np.flatnonzero(sticks)) for sticks in place}
            allowed = {tuple(sorted(belts))} | ({()} if "rest" in expected else set())
            # From far out everything comes to the sticking cycle where there is one.
            assert tuple(np.flatnonzero(place[0])) == tuple(sorted(belts)) and seen <= allowed


def test_a_span_that_is_hardly_longer_than_a_point():
    (rest,) = jb.scan(lambda nu: jb.presets.class_b(nu, 0.35), span=(-5e-7, 5e-7))
    assert rest.kind == "SuddenSliding" and abs(rest.value) < 1e-14
