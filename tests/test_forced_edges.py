"""Periodic motions of forced oscillators that touch a contact edge.

Where a belt of constant friction is fast, the mass never comes to its velocity, and below the edge
the motion is linear: the force at which it touches is known in closed form.
"""

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

import jaxbelt as jb

DAMPING, FRICTION, EDGE = 0.4, 0.6, 1.5


def osc(force, frequency=0.7, way=1.0, unit=1.0, phase=0.0, edge=EDGE):
    law = jb.Coulomb(FRICTION, FRICTION)
    belt = jb.Belt(3.0 * way * unit, law, upper=edge * unit, load=unit)
    return jb.Oscillator(DAMPING, (belt,), forcing=jb.Harmonic(force * unit, frequency, phase))


def touching_force(frequency, way=1.0, edge=EDGE):
    """The force at which the motion below the edge touches it."""
    response = np.abs(1 - frequency**2 + 1j * DAMPING * frequency)
    return (edge - way * FRICTION) * response


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(("frequency", "way"), [(0.7, 1.0), (0.9, -1.0)])
def test_a_motion_touches_the_edge_where_the_closed_form_says(frequency, way):
    expected = touching_force(frequency, way)
    point = jb.refine(
        jb.GrazingEdge(0),
        lambda force: osc(force, frequency, way),
        at=0.95 * expected,
        start=(way * FRICTION, 0.0),
    )
    assert float(point.value) == pytest.approx(expected, abs=1e-12)
    assert float(point.cycle.x1_max) == pytest.approx(EDGE, abs=1e-11)


@pytest.mark.slow
def test_the_point_is_found_from_a_motion_that_goes_beyond_the_edge():
    expected = touching_force(0.7)
    beyond = jb.find_cycle(osc(1.0005 * expected), (0.7, 0.0))
    assert [kind for kind, _ in beyond.signature] == [jb.EventKind.EDGE] * 2
    point = jb.refine(jb.GrazingEdge(0), osc, at=1.0005 * expected, start=beyond)
    assert float(point.value) == pytest.approx(expected, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("unit", "phase"), [(1e-3, 0.0), (1e3, 0.0), (1.0, 2.0), (1.0, -np.pi / 2)]
)
def test_units_and_the_phase_of_the_force_make_no_difference(unit, phase):
    expected = touching_force(0.7)

    def other(force):
        return osc(force, unit=unit, phase=phase)

    point = jb.refine(jb.GrazingEdge(0), other, at=0.95 * expected, start=(0.6 * unit, 0.0))
    assert float(point.value) == pytest.approx(expected, abs=1e-12)


@pytest.mark.slow
def test_an_edge_at_which_one_belt_ends_and_another_begins_is_one_of_both():
    def two(force):
        law = jb.Coulomb(FRICTION, FRICTION)
        belts = jb.Belt(3.0, law, upper=EDGE), jb.Belt(4.0, law, load=0.3, lower=EDGE)
        return jb.Oscillator(DAMPING, belts, forcing=jb.Harmonic(force, 0.7))

    expected = touching_force(0.7)
    for belt in (0, 1):
        point = jb.refine(jb.GrazingEdge(belt), two, at=0.95 * expected, start=(0.6, 0.0))
        assert float(point.value) == pytest.approx(expected, abs=1e-12)


STIFF_FREQUENCY = 1.2
TOUCHES_STIFF = np.hypot(1 - STIFF_FREQUENCY**2, 0.2 * STIFF_FREQUENCY)


def stiff(force):
    belt = jb.Belt(0.5, jb.Coulomb(1.0, 0.8), load=0.3, lower=1.0)
    return jb.Oscillator(0.2, (belt,), forcing=jb.Harmonic(force, STIFF_FREQUENCY))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    "at",
    [
        0.50125,
        pytest.param(0.496, marks=pytest.mark.slow),
        pytest.param(0.5012, marks=pytest.mark.slow),
        pytest.param(TOUCHES_STIFF, marks=pytest.mark.slow),
    ],
)
def test_a_motion_of_more_periods_that_shrinks_onto_one_of_fewer_is_that_one(at):
    """Above the point motions of three and four periods attract, which are one of one period there:
    that of the linear oscillator without the belt."""
    point = jb.refine(jb.GrazingEdge(0), stiff, at=at)
    assert float(point.value) == pytest.approx(TOUCHES_STIFF, abs=1e-13)
    assert point.cycle.periods == 1
    linear = np.exp(-0.1 * 2 * np.pi / STIFF_FREQUENCY)
    np.testing.assert_allclose(np.abs(point.cycle.multipliers), linear, rtol=1e-11)


@pytest.mark.slow
def test_a_motion_of_three_periods_that_touches_once_in_them_keeps_them():
    point = jb.refine(jb.GrazingEdge(0), stiff, at=1.02 * TOUCHES_STIFF)
    assert int(point.status) == jb.Status.OK
    assert float(point.value) > 1.02 * TOUCHES_STIFF
    assert point.cycle.periods == 3


def test_only_conditions_that_forced_oscillators_have_are_taken():
    with pytest.raises(ValueError, match="condition must be stable, as osc is forced"):
        jb.refine(jb.GrazingEdge(0, unstable=True), osc, at=0.5)
    with pytest.raises(ValueError, match="belt must be one with a finite edge, got 0"):
        jb.refine(jb.GrazingEdge(0), lambda force: osc(force, edge=np.inf), at=0.5)


def resonant(force, edge=1.0):
    belt = jb.Belt(3.0, jb.Conti(1.0, 0.6, 2.0), upper=edge)
    return jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(force, 1.3))


@pytest.mark.slow
def test_a_branch_goes_through_the_point_and_back_to_its_fold():
    found = jb.bifurcation_diagram(
        resonant, span=(0.12, 0.48), start=jb.find_cycle(resonant(0.13), (0.0, 0.0))
    )
    grazing, fold = sorted(found.points, key=lambda point: -float(point.value))
    assert isinstance(grazing.condition, jb.GrazingEdge)
    assert isinstance(fold.condition, jb.Fold)
    touched = jb.find_cycle(resonant(float(grazing.value), edge=50.0), (0.0, 0.0))
    assert float(touched.x1_max) == pytest.approx(1.0, abs=1e-11)
    # By brute force: one motion, then two, then only the one that goes far beyond the edge.
    starts = [(x1, x2) for x1 in np.linspace(-1.5, 2, 6) for x2 in (-1.0, 0.0, 1.0)]
    at_fold, at_edge = float(fold.value), float(grazing.value)
    values = at_fold - 1e-5, at_fold + 1e-5, at_edge - 2e-5, at_edge + 2e-5
    tops = [
        {round(float(jb.find_cycle(resonant(force), start).x1_max), 4) for start in starts}
        for force in values
    ]
    below, above, before, behind = (sorted(one) for one in tops)
    assert len(below) == 1
    assert below[0] < 1
    assert len(above) == 2
    assert above[0] < 1 < above[1]
    assert len(behind) == len(before) == 1
    assert behind[0] > 1.2


@pytest.mark.slow
def test_a_curve_of_touching_motions_is_the_response_without_the_edge():
    point = jb.refine(jb.GrazingEdge(0), resonant, at=0.23)
    curve = jb.bifurcation_curve(point, resonant, ((0.05, 0.6), (0.7, 1.4)))
    assert len(curve.values) > 40
    for force, edge in np.asarray(curve.values)[::15]:
        free = jb.find_cycle(resonant(force, edge=50.0), (0.0, 0.0))
        assert float(free.x1_max) == pytest.approx(edge, abs=1e-11)


@pytest.mark.slow
def test_a_branch_turns_back_at_the_edge_from_whichever_side_it_comes():
    """From motions of two periods that touch, and from one of one period far off: the same."""

    def edged(edge):
        belt = jb.Belt(0.4, jb.Coulomb(1.0, 0.6), upper=edge)
        return jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(0.6, 1.3))

    found = []
    for begun in (0.69, 0.7):
        start = jb.find_cycle(edged(begun), (0.5, 0.0))
        diagram = jb.bifurcation_diagram(edged, span=(0.6, 0.75), start=start)
        assert diagram.open_ends == ()
        found.append([(point.kind, float(point.value)) for point in diagram.points])
    kinds, values = zip(*found[0])
    assert kinds.count("GrazingEdge") == 1
    assert kinds.count("Fold") == 1
    assert [kind for kind, _ in found[1]] == list(kinds)
    assert [value for _, value in found[1]] == pytest.approx(values, abs=1e-9)


@pytest.mark.slow
def test_a_fold_beside_the_point_is_seen_from_beyond_the_edge():
    """The motion of two periods comes from far, turns, and touches; its multiplier grows then."""

    def osc(amplitude):
        belt = jb.Belt(6.0, jb.Coulomb(0.6, 0.6), upper=1.5, lower=-0.6)
        forcing = jb.BaseMotion(amplitude, 0.7, 0.3), jb.Harmonic(0.8 * amplitude, 1.4, 1.0)
        return jb.Oscillator(0.4, (belt,), forcing=forcing)

    wide = jb.bifurcation_diagram(osc, span=(0.2, 1.6), start=(0.6, 0.0))
    start = jb.find_cycle(osc(0.432), (0.6, 0.0))
    narrow = jb.bifurcation_diagram(osc, span=(0.41, 0.45), start=start)
    found, expected = (
        [(p.kind, float(p.value)) for p in one.points if float(p.value) < 0.45]
        for one in (wide, narrow)
    )
    assert [kind for kind, _ in found] == [kind for kind, _ in expected]
    assert [kind for kind, _ in found].count("Fold") == 1
    values = [value for _, value in expected]
    assert [value for _, value in found] == pytest.approx(values, abs=1e-9)


@pytest.mark.slow
def test_a_belt_at_rest_is_touched_by_its_edge_and_has_no_corner_there():
    """Its boundary is where x1 is extreme, so both conditions hold."""

    def resting(edge):
        belt = jb.Belt(0.0, jb.Coulomb(1.0, 1.0), load=0.3, upper=edge)
        return jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(1.0, 0.7))

    largest = float(jb.find_cycle(resting(np.inf), (0.0, 0.0)).x1_max)
    point = jb.refine(jb.GrazingEdge(0), resting, at=1.77)
    assert float(point.value) == pytest.approx(largest, abs=1e-11)
    corner = jb.refine(jb.CornerCollision(0), resting, at=1.77)
    assert int(corner.status) == jb.Status.OTHER_KIND


# --- corners --------------------------------------------------------------------------------------

AMPLITUDE, OMEGA, BELT, STATIC, KINETIC, OTHER = 0.5, 0.8, 0.5, 1.0, 0.8, 0.3


def cornered(edge):
    """Belt 0 carries the mass over the edge at which belt 1 begins to pull it back."""
    other = jb.Belt(-1.0, jb.Coulomb(OTHER, OTHER), lower=edge)
    belts = jb.Belt(BELT, jb.Coulomb(STATIC, KINETIC)), other
    return jb.Oscillator(0.1, belts, forcing=jb.Harmonic(AMPLITUDE, OMEGA))


def corner(pull, guess):
    """The edge on which the mass slips off belt 0, whether the other belt pulls already (its
    friction) or not yet (0), and the time when it does: by SciPy."""

    def equations(unknowns):
        slips, edge = unknowns

        def rates(pull):
            def of(t, y):
                force = KINETIC - pull + AMPLITUDE * np.cos(OMEGA * t)
                return [y[1], force - y[0] - 0.1 * y[1]]

            return of

        def back(t, y):
            return y[0] - edge if t > slips + 0.1 else 1.0

        def sticks(t, y):
            return y[1] - BELT

        back.terminal = sticks.terminal = True
        back.direction, sticks.direction = -1, 1
        options = dict(method="DOP853", rtol=1e-12, atol=1e-12)
        until = slips + 2 * np.pi / OMEGA
        over = solve_ivp(rates(OTHER), (slips, until), [edge, BELT], events=back, **options)
        since, state = over.t[-1], over.y[:, -1]
        rest = solve_ivp(rates(0.0), (since, until), state, events=sticks, **options)
        needed = edge + 0.1 * BELT + pull - AMPLITUDE * np.cos(OMEGA * slips)
        return needed - STATIC, rest.y[0, -1] + BELT * (until - rest.t[-1]) - edge

    return fsolve(equations, guess, xtol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(("pull", "guess"), [(OTHER, (0.7, 1.1)), (0.0, (0.7, 1.3))])
def test_a_mass_slips_off_its_belt_at_the_edge_of_another_one(pull, guess):
    _, expected = corner(pull, guess)
    for side in (-0.01, 0.01):
        point = jb.refine(jb.CornerCollision(1), cornered, at=expected + side, start=(0.0, 0.0))
        assert float(point.value) == pytest.approx(expected, abs=1e-10)


@pytest.mark.slow
def test_a_branch_passes_corners_by_name():
    start = jb.find_cycle(cornered(0.9), (0.0, 0.0))
    found = jb.bifurcation_diagram(cornered, span=(0.5, 1.4), start=start)
    assert found.open_ends == ()
    kinds = [type(point.condition) for point in found.points]
    assert kinds == [jb.CornerCollision] * 3
    for point in found.points:
        sides = (
            jb.find_cycle(cornered(float(point.value) + way), point.cycle.start).signature
            for way in (-1e-5, 1e-5)
        )
        assert len(set(sides)) == 2


@pytest.mark.slow
def test_a_curve_goes_on_where_events_change_whatever_its_step():
    """At three places excursions over the belt's velocity appear or vanish, at one a stop does."""
    law = jb.Stribeck(1.0, 0.6, 0.3)

    def make(frequency, amplitude):
        belt = jb.Belt(0.3, law, 0.5, upper=0.9)
        return jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(amplitude, frequency))

    grazing = jb.GrazingEdge(belt=0)
    start = jb.find_cycle(make(1.5, 0.5), (0.3, 0.1))
    point = jb.refine(grazing, lambda amplitude: make(1.5, amplitude), at=0.5, start=start)
    span = (1.2, 2.2), (0.2, 1.2)
    curves = [jb.bifurcation_curve(point, make, span, step=step) for step in (0.02, 0.013)]
    for curve in curves:
        assert [end.name for end in curve.ends] == ["LEFT_SPAN", "LEFT_SPAN"]
        assert curve.values[[0, -1], 1] == pytest.approx(0.2, abs=1e-9)
    (one, other) = ([(p.kind, *p.values) for p in curve.special] for curve in curves)
    kinds = "SwitchingSliding Fold GrazingSliding SwitchingSliding SwitchingSliding"
    assert [p[0] for p in one] == [p[0] for p in other] == kinds.split()
    for a, b in zip(one, other):
        assert a[1:] == pytest.approx(b[1:], abs=1e-12 if a[0] == "Fold" else 5e-5)
    # Behind the place where a stop vanishes, by one parameter alone.
    row = next(row for row in curves[0].values[::-1] if row[1] < 0.353 and row[0] < 1.55)
    found = jb.refine(grazing, lambda f: make(f, row[1]), at=row[0] + 1e-3, start=point.cycle)
    assert float(found.value) == pytest.approx(row[0], abs=1e-9)


@pytest.mark.slow(first=True)
def test_a_corner_is_exact_from_far_away_in_every_unit():
    """Where stick phases vanish at the edge; their durations are those of the events of runs."""

    def make(amplitude, edge=0.5, unit=1.0):
        law = jb.Conti(1.0, 0.6, 10.0 / unit)
        belt = jb.Belt(0.3 * unit, law, load=0.5 * unit, upper=edge * unit)
        return jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(amplitude * unit, 0.9))

    def corner(edge=0.5, unit=1.0):
        def family(amplitude):
            return make(amplitude, edge, unit)

        return jb.refine(jb.CornerCollision(0), family, at=0.6, start=(0.5 * unit, 0.0))

    points = [corner(unit=unit) for unit in (1.0, 10.0, 1e-3)]
    found = [float(point.value) for point in points]
    np.testing.assert_allclose(found, found[0], rtol=0, atol=1e-13)
    assert max(float(point.error) for point in points) < 1e-12

    below, durations, t1 = np.array([4e-5, 2e-5, 1e-5]), [], 120 * np.pi / 0.9
    for distance in below:
        run = jb.simulate(make(found[0] - distance), (0.191, 0.536), t1, ts=[t1])
        last = np.flatnonzero(np.asarray(run.events.kind) == jb.EventKind.STICK)[-1]
        durations.append(float(run.events.t[last + 1] - run.events.t[last]))
    # The distance as a function of the duration, by a parabola; runs are good to 1e-12.
    assert np.polyfit(durations, below, 2)[-1] == pytest.approx(0.0, abs=1e-11)

    slope = (corner(0.501).value - corner(0.499).value) / 0.002  # off by 3e-7
    derivative = jax.grad(lambda edge: corner(edge).value)(0.5)
    assert float(derivative) == pytest.approx(float(slope), abs=1e-6)
