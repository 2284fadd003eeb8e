"""Points of codimension two on curves of forced oscillators, and those in which they end."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

import jaxbelt as jb
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
