"""Points of codimension two on curves of forced oscillators, and those in which they end."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve
from test_periodic import closed_form

import jaxbelt as jb
from jaxbelt.numerics.continuation import Stop
from tests.campaign import forced, forced_cases

SPAN = (1.6, 1.9), (0.02, 0.2)


def curve_of(condition, at):
    point = jb.refine(condition, jb.presets.di_bernardo, at=at)
    return jb.bifurcation_curve(point, jb.presets.di_bernardo, SPAN)


def named(curve, kind):
    return [np.array(one.values) for one in curve.special if one.kind == kind]


@pytest.fixture(scope="module")
def meeting():
    """Frequency and amplitude at which a motion of two periods that always slips touches the
    boundary, with a multiplier of -1: solved by SciPy from where it touches."""

    def equations(unknowns):
        touched, frequency, amplitude = unknowns

        def rates(t, y):
            r = 1 - y[1]
            force = 1.5 - 1.5 * r + 0.45 * r**3 + amplitude * np.cos(frequency * t)
            matrix = np.array([[0.0, 1.0], [-1.0, 1.5 - 1.35 * r**2]])
            return np.array([y[1], force - y[0], *(matrix @ y[2:].reshape(2, 2)).ravel()])

        begin = np.array([1.5 + amplitude * np.cos(frequency * touched), 1, 1, 0, 0, 1])
        times = touched, touched + 4 * np.pi / frequency
        y = solve_ivp(rates, times, begin, "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
        matrix = y[2:].reshape(2, 2)
        return [*(y - begin)[:2], 1 + np.trace(matrix) + np.linalg.det(matrix)]

    return fsolve(equations, [2.2, 1.66, 0.088], xtol=1e-13)[1:]


@pytest.mark.slow
def test_curves_of_grazing_and_period_doubling_meet_in_one_point(meeting):
    grazing = curve_of(jb.GrazingSliding(0), 1.6676)
    (passed,) = named(grazing, "PeriodDoubling")
    assert passed == pytest.approx(meeting, abs=1e-10)
    doubling = curve_of(jb.PeriodDoubling(), 1.713)
    assert doubling.values[:, 1].max() == pytest.approx(0.2, abs=1e-12)
    (end,) = doubling.special
    assert (end.kind, end.belts) == ("GrazingSliding", (0,))
    assert end.values == pytest.approx(meeting, abs=1e-10)
    assert tuple(doubling.path[0]) == end.values
    # Of the motion of twice the period, which its period doubling has left there.
    doubled = curve_of(jb.GrazingSliding(0), 1.7078)
    first, other = named(doubled, "PeriodDoubling")
    assert first == pytest.approx(meeting, abs=1e-10)
    assert tuple(doubled.path[0]) == tuple(first)
    assert np.linalg.norm(other - meeting) > 0.1


@pytest.mark.slow
def test_a_curve_of_torus_points_goes_from_one_strong_resonance_to_another():
    def osc(velocity, frequency):
        law = jb.Cubic(1.5, 1.5, 0.45)
        return jb.Oscillator(0.0, (jb.Belt(velocity, law),), forcing=jb.Harmonic(0.05, frequency))

    point = jb.refine(jb.Torus(), lambda velocity: osc(velocity, 1.7), at=1.07, start=(1.4, 0.0))
    curve = jb.bifurcation_curve(point, osc, ((0.9, 1.3), (0.8, 2.6)), step=0.03)
    kinds = [one.kind.removeprefix("Resonance1to") for one in curve.special]
    assert kinds in (["1", "4", "3", "2"], ["2", "3", "4", "1"])
    for one in curve.special:
        order, (velocity, frequency) = int(one.kind[-1]), one.values
        if order < 3:
            continue  # the motion is singular there
        motion = jb.periodic(osc(velocity, frequency), (1.4, 0.0))
        belt = forced.Belt(velocity, ("cubic", 1.5, 1.5, 0.45))
        engine = forced.Oscillator(0.0, (belt,), (forced.Harmonic(0.05, frequency),))
        _, multipliers = forced_cases.periodic(engine, np.asarray(motion.start), 1)
        assert multipliers[0] ** order == pytest.approx(1.0, abs=1e-7)


@pytest.mark.slow
def test_a_curve_of_crossing_ends_where_it_turns_into_switching_whatever_the_step():
    """Where the mass turns back friction can just hold it, and the force is largest."""

    def equations(unknowns):
        X, phase, _ = closed_form(*unknowns)
        return [abs(np.cos(phase) - X) - unknowns[1], np.sin(phase)]

    expected = fsolve(equations, [0.49, 0.29], xtol=1e-14)

    def osc(frequency, friction):
        return jb.presets.den_hartog(frequency, friction=friction)

    point = jb.refine(jb.CrossingSliding(0), lambda friction: osc(0.495, friction), at=0.3)
    for step in (0.05, 0.02):
        curve = jb.bifurcation_curve(point, osc, ((0.3, 0.51), (0.05, 0.95)), step=step)
        (end,) = curve.special
        assert (end.kind, end.belts) == ("SwitchingSliding", (0,))
        assert end.values == pytest.approx(expected, abs=1e-11)
        assert tuple(curve.path[0]) == end.values
        # The last row is where the step is bisected to, ten times.
        assert curve.values[0] == pytest.approx(expected, abs=step * 2**-10)


def between_equal_belts(phase, unit):
    def osc(force, frequency):
        law = jb.Coulomb(1.0, 1.0)
        belts = [jb.Belt(way * 0.5 * unit, law, load=0.3 * unit) for way in (1, -1)]
        return jb.Oscillator(0.1, belts, forcing=jb.Harmonic(force * unit, frequency, phase))

    return osc


BOTH_PHASES_AND_UNITS = pytest.mark.parametrize(("phase", "unit"), [(0.0, 1.0), (1.0, 1e5)])


@pytest.mark.slow
@BOTH_PHASES_AND_UNITS
def test_what_holds_for_both_belts_all_along_a_curve_is_no_special_point(phase, unit):
    osc = between_equal_belts(phase, unit)
    point = jb.refine(jb.CrossingSliding(0), lambda force: osc(force, 0.65), at=1.0)
    # There an event passes the phase 0 at (1.0112, 0.6339) without a phase, at others with it.
    curve = jb.bifurcation_curve(point, osc, ((0.55, 1.05), (0.6, 1.3)), step=0.05)
    assert len(curve) > 10
    assert set(curve.ends) == {Stop.LEFT_SPAN}
    assert curve.special == ()


@pytest.mark.slow
@BOTH_PHASES_AND_UNITS
def test_a_border_that_symmetric_motions_meet_is_named(phase, unit):
    osc = between_equal_belts(phase, unit)
    point = jb.refine(jb.SwitchingSliding(0), lambda frequency: osc(1.4, frequency), at=0.37)
    curve = jb.bifurcation_curve(point, osc, ((1.35, 1.5), (0.33, 0.4)), step=0.05)
    (met,) = curve.special
    assert met.kind == "AddingSliding"
    # The other curve as far as frequencies of 0.3635, 0.364 and 0.3645 show it.
    force, frequency = met.values
    known = [0.3635, 0.364, 0.3645], [1.495773, 1.492969, 1.490173]
    adding = np.polynomial.Polynomial.fit(*known, 2)
    assert force == pytest.approx(adding(frequency), abs=3e-5)


# --- where t is 0 ---------------------------------------------------------------------------------


def frequency_of(osc):
    return osc.forcing[0].frequency


def amplitude_of(osc):
    return osc.forcing[0].amplitude


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("step", [0.02, 0.05])
@pytest.mark.parametrize("phase", [0.0, 0.5, -0.5, np.pi])
@pytest.mark.parametrize("kinetic", [1.0, 0.5])
def test_a_curve_goes_on_where_the_touch_passes_the_phase_0(kinetic, phase, step):
    """The motion that slips all the time is x1 = 1/2 + A cos(w t - lag), and touches at A w = 1/2.
    For the phase 0 it does so at the phase 0 where w = 1."""

    def exact(w):
        return 0.5 * np.hypot(1 - w**2, 0.1 * w) / w

    belt = jb.Belt(0.5, jb.Coulomb(1.0, kinetic), load=0.5)
    osc = jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(0.9 * exact(1.2), 1.2, phase))
    start = jb.find_cycle(osc, (0.25, 0.0))
    point = jb.refine(jb.GrazingSliding(0), osc, where=amplitude_of, start=start)
    both = frequency_of, amplitude_of
    curve = jb.bifurcation_curve(point, both, ((0.8, 1.3), (0.01, 1.0)), step=step)
    assert curve.ends == (Stop.LEFT_SPAN, Stop.LEFT_SPAN) and curve.special == ()
    assert {0.8, 1.3} <= set(curve.values[:, 0].tolist())
    w, force = curve.values.T
    np.testing.assert_allclose(force, exact(w), rtol=0, atol=1e-13)


@pytest.mark.slow
def test_a_curve_of_three_periods_does_not_depend_on_where_t_is_0():
    """For some phases events of its motion pass the phase 0, and other curves pass nearby."""

    def osc(force, phase):
        law = jb.Coulomb(1.0, 1.0)
        belts = jb.Belt(2.0, law, load=0.5), jb.Belt(2.0, law, load=0.25, lower=0.75)
        return jb.Oscillator(0.1, belts, forcing=jb.Harmonic(force, 1.2, phase))

    begun = osc(0.1026, np.pi)
    start = jb.find_cycle(begun, (0.5, 0.0))
    known = jb.refine(jb.GrazingEdge(1), begun, where=amplitude_of, start=start)
    motion = known.cycle
    assert motion.periods == 3
    curves = []
    for phase in (np.pi, 2.1, 0.5 * np.pi, 0.3):
        later = (phase - np.pi) % (2 * np.pi) / 1.2
        start = tuple(motion.start.tolist())
        if later > 0:
            run = jb.simulate(known.oscillator, start, later, ts=[later])
            start = tuple(run.ys[0].tolist())
        begun = osc(0.9999 * float(known.value), phase)
        point = jb.refine(jb.GrazingEdge(1), begun, where=amplitude_of, start=start)
        both = frequency_of, amplitude_of
        curves.append(jb.bifurcation_curve(point, both, ((0.8, 1.3), (0.01, 1.0)), step=0.05))
    first = curves[0]
    assert [one.kind for one in first.special] == ["PeriodDoubling", "Fold", "Fold"]
    for curve in curves[1:]:
        assert curve.ends == first.ends
        assert [one.kind for one in curve.special] == [one.kind for one in first.special]
        values = [one.values for one in curve.special]
        np.testing.assert_allclose(values, [one.values for one in first.special], atol=1e-11)
        # The first row is as near to the end as a part of a step.
        np.testing.assert_allclose(curve.values[[0, -1]], first.values[[0, -1]], atol=5e-5)
