"""Periodic motions of forced oscillators, their multipliers, bifurcations and exponents.

Oracles: the engine of tests/campaign/forced.py, which follows runs and differentiates them by
differences; closed forms of Den Hartog; the numbers of di Bernardo, Kowalczyk and Nordmark that two
independent engines computed.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.optimize import brentq

import jaxbelt as jb
from tests.campaign import forced, forced_cases

OK = jb.Status.OK


def bkn(frequency, amplitude=0.1, phase=0.0):
    """The oscillator of di Bernardo, Kowalczyk and Nordmark, 2003."""
    force = jb.Harmonic(amplitude, frequency, phase)
    return jb.Oscillator(0.0, (jb.Belt(1.0, jb.Cubic(1.5, 1.5, 0.45)),), forcing=force)


def stribeck(frequency, phase):
    """An oscillator whose motion sticks once a period."""
    belt = jb.Belt(0.1139, jb.Stribeck(0.5, 0.3, 0.0474))
    return jb.Oscillator(0.2108, (belt,), forcing=jb.Harmonic(0.15, frequency, phase))


def bkn_of_engine(frequency):
    law = ("cubic", 1.5, 1.5, 0.45)
    return forced.Oscillator(0.0, (forced.Belt(1.0, law),), (forced.Harmonic(0.1, frequency),))


def frequency_of(osc):
    return osc.forcing[0].frequency


@pytest.fixture(scope="module")
def smooth():
    """A motion of four periods that does not stick."""
    return jb.find_cycle(bkn(1.7079), (0.5, 0.0))


@pytest.fixture(scope="module")
def sticking():
    """A motion of two periods that sticks."""
    return jb.find_cycle(bkn(1.68), (0.5, 0.0))


def test_find_cycle_finds_the_number_of_periods(smooth, sticking):
    assert (smooth.periods, sticking.periods) == (4, 2)
    assert smooth.period == pytest.approx(4 * 2 * np.pi / 1.7079, rel=1e-15)
    assert smooth.signature == ()
    assert sticking.signature == ((jb.EventKind.STICK, 0), (jb.EventKind.SLIP, 0))
    assert bool(smooth.stable) and bool(sticking.stable)
    assert sticking.multipliers[1] == 0.0
    assert float(smooth.stick_durations[0]) == 0.0


@pytest.mark.slow(first=True)
def test_a_motion_at_a_known_oscillator_can_be_compiled(smooth):
    """All is known in the trace, and what is computed is not."""
    osc = bkn(1.7079)
    start, status = jax.jit(lambda one: (one * smooth.at(osc).start, smooth.at(osc).status))(1.0)
    assert status == OK
    np.testing.assert_allclose(start, smooth.start, atol=1e-10)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("frequency", [1.715, 1.725, 1.8])
def test_the_number_of_periods_is_the_least(frequency):
    motion = jb.find_cycle(bkn(frequency), (0.5, 0.0))
    assert motion.periods == 2
    start = np.asarray(motion.start)
    once, twice = (
        forced_cases.stroboscopic(bkn_of_engine(frequency), start, n).y_end for n in (1, 2)
    )
    assert np.max(np.abs(start - once)) > 0.1 and start == pytest.approx(twice, abs=1e-9)


TWINS = (("conti", 1.0, 0.6, 10.0, 0.0), ("coulomb", 1.0, 0.8))


def twins(amplitude):
    """Two belts of one velocity; the second one's friction falls when the mass begins to slip."""
    laws = jb.Conti(*TWINS[0][1:]), jb.Coulomb(*TWINS[1][1:])
    belts = jb.Belt(-1.0, laws[0], 2.0), jb.Belt(-1.0, laws[1], 1.5)
    return jb.Oscillator(0.1, belts, forcing=jb.Harmonic(amplitude, 0.5, 1.5 * np.pi))


def twins_of_engine(amplitude):
    belts = tuple(forced.Belt(-1.0, law, load) for law, load in zip(TWINS, (2.0, 1.5), strict=True))
    return forced.Oscillator(0.1, belts, (forced.Harmonic(amplitude, 0.5, 1.5 * np.pi),))


def amplitude_of(osc):
    return osc.forcing[0].amplitude


@pytest.mark.slow(first=True)
def test_the_number_of_periods_beside_a_period_doubling_is_the_least():
    """A multiplier is near to 1, and rounding moves the state by 1e-9 a Newton step."""
    found = jb.find_cycle(twins(2.26832), (0.65, 0.6))
    assert int(found.status) == OK and found.periods == 2
    assert 0.99 < float(found.multipliers[0].real) < 1
    start = np.asarray(found.start)
    # A Newton step's rounding.
    back = forced_cases.stroboscopic(twins_of_engine(2.26832), start, 2).y_end
    assert start == pytest.approx(back, abs=1e-9)
    span = 2.266, 2.27
    diagram = jb.bifurcation_diagram(twins(2.26832), amplitude_of, span, rows=8, start=found)
    assert not diagram.open_ends
    (point,) = diagram.points
    assert point.kind == "PeriodDoubling" and point.cycle.periods == 1
    # The motion of two periods ends there, and that of one period, which it has left, goes on.
    own, other = diagram.branches
    assert {motion.periods for motion in own.cycles} == {2}
    assert {motion.periods for motion in other.cycles} == {1}
    assert own.values.max() < float(point.value)
    assert other.values[[0, -1]] == pytest.approx(span, abs=1e-12)
    # At the point itself rounding decides.
    beside = np.abs(other.values - float(point.value)) > 1e-9
    assert np.array_equal(other.stable[beside], other.values[beside] > float(point.value))


@pytest.mark.slow
def test_a_branch_ends_where_a_mass_begins_to_stick_by_grazing():
    """Static friction above kinetic friction: what just touches the boundary sticks for some time,
    and what just misses it does not."""
    start = jb.find_cycle(twins(1.85), (0.65, 0.6))
    diagram = jb.bifurcation_diagram(twins(1.85), amplitude_of, (1.75, 1.9), rows=24, start=start)
    assert not diagram.open_ends
    grazing = [point for point in diagram.points if point.kind == "GrazingSliding"]
    assert len(grazing) == 2
    for point in grazing:
        first, periods = np.asarray(point.cycle.start), int(point.cycle.periods)
        sides = [
            forced_cases.stroboscopic(twins_of_engine(float(point.value) + off), first, periods)
            for off in (1e-7, -1e-7)
        ]
        # To one side it comes back, but for the root of 1e-7; to the other it does not.
        away = sorted(np.max(np.abs(np.subtract(run.y_end, first))) for run in sides)
        assert away[0] < 0.01 and away[1] > 0.1


@pytest.mark.slow
def test_a_branch_of_twice_the_periods_ends_where_it_left():
    """Behind the period doubling its own motions would come again, half of their periods later."""
    start = jb.find_cycle(twins(2.15), (0.65, 0.6))
    diagram = jb.bifurcation_diagram(twins(2.15), amplitude_of, (2.145, 2.16), rows=8, start=start)
    assert not diagram.open_ends
    (point,) = (point for point in diagram.points if point.kind == "PeriodDoubling")
    branch, doubled = diagram.branches
    assert {motion.periods for motion in doubled.cycles} == {4}
    assert {motion.periods for motion in branch.cycles} == {2}
    # It is left at a thousandth of the span at most, and the other end is one of the span.
    away = np.abs(doubled.values[[0, -1]] - float(point.value))
    assert np.min(away) < 0.001 * 0.015 and np.max(away) > 0.005


@pytest.mark.slow(first=True)
def test_motions_and_multipliers_are_those_of_the_engine(smooth, sticking):
    # Differences of runs at 1e-13; the state is 3e-5 from grazing, so the step is small.
    for motion, frequency, h in ((smooth, 1.7079, 1e-6), (sticking, 1.68, 1e-4)):
        osc, start = bkn_of_engine(frequency), np.asarray(motion.start)
        y, multipliers = forced_cases.periodic(osc, start, motion.periods, h=h)
        assert start == pytest.approx(y, abs=1e-10)
        wanted = sorted(np.abs(multipliers))
        assert sorted(np.abs(np.asarray(motion.multipliers))) == pytest.approx(wanted, abs=3e-7)
    run = forced_cases.stroboscopic(bkn_of_engine(1.68), np.asarray(sticking.start), 2)
    stuck = np.diff(run.t)[run.kind[:-1] == forced.STICK]
    assert float(sticking.stick_durations[0]) == pytest.approx(stuck[0], abs=1e-10)


@pytest.mark.slow(first=True)
def test_unstable_motions_are_found_from_a_guess(smooth):
    between = 0.5 * (smooth.starts[0] + smooth.starts[2])
    motion = jb.periodic(bkn(1.7079), between, periods=2)
    assert int(motion.status) == OK and motion.periods == 2 and not bool(motion.stable)
    _, multipliers = forced_cases.periodic(bkn_of_engine(1.7079), np.asarray(motion.start), 2)
    assert np.sort(motion.multipliers.real) == pytest.approx(np.sort(multipliers.real), abs=1e-7)
    # Asked for twice the number of periods it is given as what it is.
    again = jb.periodic(bkn(1.7079), np.asarray(motion.start), periods=4)
    assert again.periods == 2
    assert again.start == pytest.approx(np.asarray(motion.start), abs=1e-10)


def test_samples_begin_and_end_at_the_start(sticking):
    states = np.asarray(sticking.sample(101))
    assert states[0] == pytest.approx(np.asarray(sticking.start), abs=1e-14)
    assert states[-1] == pytest.approx(states[0], abs=1e-10)
    assert states[50] == pytest.approx(np.asarray(sticking.starts[1]), abs=1e-10)


@pytest.mark.slow(first=True)
def test_extrema_are_those_of_samples(smooth, sticking):
    # A belt that turns back while the mass sticks to it: x1 is largest inside of a stick phase.
    belt = jb.Belt(jb.Oscillating(0.0, 0.5, 1.0), jb.Coulomb(1.0, 1.0))
    carrier = jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(1.15, 1.0))
    carried = jb.find_cycle(carrier, (0.0, 0.0))
    assert float(carried.stick_durations[0]) > 1.0
    for motion in (smooth, sticking, carried):
        found = [motion.x1_min, motion.x1_max, motion.x2_min, motion.x2_max]
        states = np.asarray(motion.sample(40_001))
        seen = np.array([[x.min(), x.max()] for x in states.T]).ravel()
        # Between samples, 1e-3 apart at most, there is no more than 1e-6.
        beyond = (np.array(found) - seen) * [-1, 1, -1, 1]
        assert np.all((beyond > -1e-12) & (beyond < 1e-6))
        row = motion.table().iloc[0]
        assert row.amplitude == 0.5 * (row.x1_max - row.x1_min) == float(jb.amplitude(motion))


def test_functionals_of_a_forced_motion(sticking):
    stuck = float(sticking.stick_durations[0])
    assert float(jb.period(sticking)) == pytest.approx(4 * np.pi / 1.68, rel=1e-15)
    assert float(jb.stick_duration(sticking, 0)) == float(jb.stick_duration(sticking)) == stuck
    assert float(jb.slip_duration(sticking, 0)) == pytest.approx(
        float(jb.slip_duration(sticking)), abs=1e-12
    )
    assert float(jb.stick_fraction(sticking)) == pytest.approx(stuck * 1.68 / (4 * np.pi))
    assert float(jb.peak(sticking, "x2")) == pytest.approx(1.0, abs=1e-14)
    for functional in (jb.energy_fed, lambda motion: jb.gap(motion, 0)):
        # The types are checked before, where tests check them.
        with pytest.raises((ValueError, TypeError), match="PeriodicMotion"):
            functional(sticking)


@pytest.mark.slow(first=True)
def test_extrema_of_a_batch(sticking):
    values = jnp.array([1.678, 1.68])
    motions = jax.vmap(lambda frequency: sticking.at(bkn(frequency)))(values)
    assert motions.x1_max.shape == (2,)
    assert motions.x1_max[1] == pytest.approx(float(sticking.x1_max), abs=1e-11)


@pytest.mark.slow(first=True)
def test_derivatives_are_those_of_the_engine(sticking):
    def start(frequency):
        osc = bkn_of_engine(frequency)
        return forced_cases.periodic(osc, np.asarray(sticking.start), 2)[0]

    slope = jax.jacfwd(lambda frequency: jb.find_cycle(bkn(frequency), (0.5, 0.0)).start)(1.68)
    near, far = ((start(1.68 + h) - start(1.68 - h)) / (2 * h) for h in (2.5e-5, 5e-5))
    # Of fourth order in h, and 1e-13/h of rounding.
    assert np.asarray(slope) == pytest.approx((4 * near - far) / 3, abs=1e-7)


@pytest.mark.slow(first=True)
def test_at_follows_a_motion_to_other_oscillators(sticking):
    values = jnp.array([1.678, 1.68, 1.682])
    moved = jax.vmap(lambda frequency: sticking.at(bkn(frequency)).start)(values)
    assert moved[1] == pytest.approx(np.asarray(sticking.start), abs=1e-11)
    other = jb.find_cycle(bkn(1.682), (0.5, 0.0))
    assert moved[2] == pytest.approx(np.asarray(other.start), abs=1e-10)


def beyond_adding(amplitude):
    """One belt; from amplitude 0.8544 on it sticks twice, first for no time."""
    law, force = jb.Conti(0.8, 0.5, 2.0), jb.Harmonic(amplitude, 1.0, np.pi / 2)
    return jb.Oscillator(0.2, (jb.Belt(0.15, law),), forcing=force)


@pytest.mark.slow(first=True)
def test_motions_are_exact_however_far_they_are_followed():
    """The steps of integration of the first ones would be too long for the others."""
    first = jb.find_cycle(beyond_adding(0.8625), (0.0, 0.15))
    assert len(first.signature) == 4
    there = jb.find_cycle(beyond_adding(0.88), (0.0, 0.15))
    one = jnp.zeros_like(first.chain.mesh).at[:, 0].set(1.0)
    coarse = replace(first, chain=replace(first.chain, mesh=one))
    for motion, status in ((first, OK), (coarse, jb.Status.NO_CONVERGENCE)):
        moved = motion.at(beyond_adding(0.88))
        assert moved.start == pytest.approx(np.asarray(there.start), abs=1e-11)
        traced = jax.jit(lambda amplitude, motion: motion.at(beyond_adding(amplitude)))
        assert int(traced(0.88, motion).status) == status

    def amplitude_of(osc):
        return osc.forcing[0].amplitude

    # Through the point at 0.8544, beyond which it sticks twice.
    start = jb.find_cycle(beyond_adding(0.85), (0.0, 0.15))
    found = jb.bifurcation_diagram(start.oscillator, amplitude_of, (0.84, 0.94), start=start)
    (branch,), law = found.branches, ("conti", 0.8, 0.5, 2.0)
    assert [point.kind for point in found.points] == ["AddingSliding"]
    for value, motion in zip(branch.values, branch.cycles, strict=True):
        wave = forced.Harmonic(float(value), 1.0, np.pi / 2)
        osc = forced.Oscillator(0.2, (forced.Belt(0.15, law),), (wave,))
        end = forced_cases.stroboscopic(osc, np.asarray(motion.start), 1).y_end
        assert end == pytest.approx(np.asarray(motion.start), abs=2e-10), value


@pytest.mark.slow(first=True)
def test_a_stick_phase_ends_where_the_limit_is_reached_first():
    """What is needed passes the limit for 6e-4, by less than 1e-8, and is the limit again where the
    solution of the equations has the end of the phase; the engine's run goes another way."""
    belt, force = (
        jb.Belt(-0.260586421226356, jb.Coulomb(1.0, 0.5), 0.5),
        jb.Harmonic(0.5, 0.5, np.pi),
    )
    osc = jb.Oscillator(0.2, (belt,), 2.0, forcing=force)
    motion = jb.periodic(osc, guess=(-0.16381169, -0.30761343))
    assert int(motion.status) == jb.Status.NOT_ADMISSIBLE


@pytest.mark.slow(first=True)
def test_a_branch_ends_where_a_stick_phase_ends_by_touching():
    """Static friction above kinetic friction: beyond the point the phase goes on. The oscillator is
    its own mirror image, half a period later."""
    law, force = jb.Coulomb(1.0, 0.5), jb.Harmonic(0.5, 0.5, np.pi)
    values = []
    for sign, guess in ((1.0, (-0.6318, -0.2265)), (-1.0, (-0.1698, -0.31))):
        osc = jb.Oscillator(0.2, (jb.Belt(0.26 * sign, law, 0.5),), 2.0, forcing=force)
        start, span = jb.periodic(osc, guess), tuple(sorted([0.258 * sign, 0.262 * sign]))
        found = jb.bifurcation_diagram(
            osc, lambda osc: osc.belts[0].velocity, span, rows=8, start=start
        )
        assert not found.open_ends
        (point,), (branch,) = found.points, found.branches
        assert point.kind == "AddingSliding"
        values.append(float(point.value))
        assert np.max(np.abs(branch.values)) < abs(values[-1])
        for off, comes_back in ((-1e-7, True), (1e-7, False)):
            belt = forced.Belt(values[-1] + sign * off, ("coulomb", 1.0, 0.5), 0.5)
            wave = forced.Harmonic(0.5, 0.5, np.pi)
            of_engine = forced.Oscillator(0.2, (belt,), (wave,), 2.0)
            first = np.asarray(point.cycle.start)
            away = np.subtract(forced_cases.stroboscopic(of_engine, first, 1).y_end, first)
            assert (np.max(np.abs(away)) < 1e-2) == comes_back
    assert values[1] == pytest.approx(-values[0], abs=1e-10)


def test_no_number_depends_on_the_unit_of_length(sticking):
    law = jb.Cubic(1.5, 1.5 / 4, 0.45 / 64)
    belt, force = jb.Belt(4.0, law, 4.0), jb.Harmonic(0.4, 1.68)
    motion = jb.find_cycle(jb.Oscillator(0.0, (belt,), forcing=force), (2.0, 0.0))
    np.testing.assert_array_equal(motion.start, 4 * sticking.start)
    np.testing.assert_array_equal(motion.multipliers, sticking.multipliers)
    np.testing.assert_array_equal(motion.stick_durations, sticking.stick_durations)


@pytest.mark.slow(first=True)
def test_grazing_of_the_motion_of_four_periods(smooth):
    point = jb.refine(jb.GrazingSliding(0), bkn(1.7079), where=frequency_of, start=smooth)
    assert int(point.status) == OK
    assert float(point.value) == pytest.approx(1.707799714885, abs=1e-10)
    wanted = [0.840725392543, 0.00719233612]
    assert point.cycle.multipliers.real == pytest.approx(wanted, abs=1e-9)
    assert point.kind == "GrazingSliding" and len(point.table()) == 1


def on_a_belt(nu, frequency, damping, amplitude, package):
    """One belt with Coulomb's friction and a harmonic force, of the package or of the engine."""
    if package is jb:
        belts = (jb.Belt(nu, jb.Coulomb(1.0, 0.6)),)
        return jb.Oscillator(damping, belts, forcing=jb.Harmonic(amplitude, frequency))
    belts = (forced.Belt(nu, ("coulomb", 1.0, 0.6)),)
    return forced.Oscillator(damping, belts, (forced.Harmonic(amplitude, frequency),))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("condition", "numbers", "guess"),
    [
        (jb.AddingSliding(0), (0.1, 1.5, 0.05), 0.95),
        (jb.CrossingSliding(0), (0.1, 1.5, 0.05), 1.0),
        (jb.CrossingSliding(0), (0.1, 1.5, 0.05), 1.1),
        (jb.SwitchingSliding(0), (0.9, 1.3, 0.05), 0.9),
        (jb.GrazingSliding(0), (0.5, 2.25, 0.15), 1.1),
    ],
)
def test_sliding_points_are_where_the_motion_of_the_engine_changes(condition, numbers, guess):
    """Found by halving an interval, at whose ends the motions have different events."""
    motion = jb.find_cycle(on_a_belt(*numbers, guess, jb), (1.0, 0.0))
    point = jb.refine(
        condition,
        on_a_belt(*numbers, guess, jb),
        where=lambda osc: osc.forcing[0].amplitude,
        start=motion,
    )
    assert int(point.status) == OK

    def events(amplitude):
        osc = on_a_belt(*numbers, amplitude, forced)
        settled = forced_cases.stroboscopic(osc, np.asarray(point.cycle.start), 400).y_end
        return forced_cases.stroboscopic(osc, settled, point.cycle.periods).sequence

    low, high = float(point.value) - 1e-3, float(point.value) + 1e-3
    before = events(low)
    assert events(high) != before
    while high - low > 1e-11:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if events(middle) == before else (low, middle)
    assert float(point.value) == pytest.approx(low, abs=1e-10)


@pytest.mark.slow
def test_a_curve_of_grazing_is_what_refine_finds(smooth):
    point = jb.refine(jb.GrazingSliding(0), bkn(1.7079), where=frequency_of, start=smooth)
    both = frequency_of, lambda osc: osc.forcing[0].amplitude
    curve = jb.bifurcation_curve(point, both, ((1.69, 1.72), (0.08, 0.12)), max_points=30)
    assert len(curve) > 4 and np.all(curve.residual < 1e-11)
    np.testing.assert_allclose(curve.values[[0, -1], 0], [1.69, 1.72], rtol=0, atol=1e-12)
    row = int(np.argmin(np.abs(curve.values[:, 0] - 1.7079))) + 1
    frequency, amplitude = curve.values[row]
    beside = bkn(frequency + 1e-5, amplitude)
    near = jb.periodic(beside, np.asarray(smooth.start), periods=4)
    assert int(near.status) == OK
    again = jb.refine(jb.GrazingSliding(0), beside, where=frequency_of, start=near)
    assert float(again.value) == pytest.approx(frequency, abs=1e-10)
    assert again.place == pytest.approx(curve.places[row], abs=1e-6)


@pytest.mark.slow(first=True)
def test_fold_of_the_sticking_motion(sticking):
    point = jb.refine(jb.Fold(), bkn(1.68), where=frequency_of, start=sticking)
    assert int(point.status) == OK
    assert float(point.value) == pytest.approx(1.683440572496, abs=1e-10)
    assert point.cycle.multipliers == pytest.approx(np.array([1.0, 0.0]), abs=1e-9)


@pytest.mark.slow
def test_period_doubling():
    guess = (2.00853228736, -0.306478097835)
    motion = jb.periodic(bkn(1.714), guess, periods=2)
    point = jb.refine(jb.PeriodDoubling(), bkn(1.714), where=frequency_of, start=motion)
    assert int(point.status) == OK
    assert float(point.value) == pytest.approx(1.712981036227, abs=1e-10)
    assert point.cycle.multipliers[0] == pytest.approx(-1.0, abs=1e-9)


@pytest.mark.slow
def test_the_torus_point_is_where_the_area_is_kept():
    def osc(velocity):
        law = jb.Cubic(1.5, 1.5, 0.45)
        return jb.Oscillator(0.0, (jb.Belt(velocity, law),), forcing=jb.Harmonic(0.05, 1.7))

    point = jb.refine(jb.Torus(), osc, at=1.07, start=(1.4, 0.0))
    assert int(point.status) == OK
    belt = forced.Belt(float(point.value), ("cubic", 1.5, 1.5, 0.45))
    engine = forced.Oscillator(0.0, (belt,), (forced.Harmonic(0.05, 1.7),))
    _, multipliers = forced_cases.periodic(engine, np.asarray(point.cycle.start), 1)
    assert np.abs(multipliers) == pytest.approx(1.0, abs=1e-8)


# --- Den Hartog, 1931: one belt at rest, Coulomb friction -----------------------------------------

ZETA, FRICTION, FORCE = 0.05, 0.4, 1.0


def den_hartog(frequency, friction=FRICTION):
    return jb.Oscillator(
        *(ZETA, (jb.Belt(0.0, jb.Coulomb(friction, friction)),)),
        forcing=jb.Harmonic(FORCE, frequency),
    )


def closed_form(frequency, friction=FRICTION):
    """The motion without stops from its largest displacement X on, in closed form: X, the phase of
    the force there, and (x1, x2) at a time less than half a period later."""
    root = np.sqrt(1 - ZETA**2 / 4)
    T = np.pi / frequency
    e, c, s = np.exp(-ZETA * T / 2), np.cos(root * T), np.sin(root * T)
    # x = f + e^(-zeta t/2) (A cos + B sin) + P cos(Omega t) + Q sin(Omega t), and -X after T.
    half = ZETA / 2
    matrix = [
        [1.0, 0.0, -1.0, 0.0],
        [-half, root, 0.0, frequency],
        [e * c, e * s, 1.0, 0.0],
        [e * (-half * c - root * s), e * (root * c - half * s), 0.0, -frequency],
    ]
    A, B, rest, Q = np.linalg.solve(matrix, [-friction, 0.0, -friction, 0.0])
    response = 1 / complex(1 - frequency**2, ZETA * frequency)
    P = np.sqrt((FORCE * abs(response)) ** 2 - Q**2)
    phase = np.angle((P - 1j * Q) / response)

    def state(t):
        fades, angle = np.exp(-half * t), root * t
        own = A * np.cos(angle) + B * np.sin(angle)
        turned = -A * np.sin(angle) + B * np.cos(angle)
        wave = P * np.cos(frequency * t) + Q * np.sin(frequency * t)
        slope = frequency * (-P * np.sin(frequency * t) + Q * np.cos(frequency * t))
        x1, x2 = friction + fades * own + wave, fades * (root * turned - half * own) + slope
        return np.array([x1, x2])

    return rest + P, phase, state


def start_of(frequency):
    """Its state at the phase 0 of the force."""
    _, phase, state = closed_form(frequency)
    half = np.pi / frequency
    since = (-phase / frequency) % (2 * half)
    return state(since) if since < half else -state(since - half)


def limit_without_stops():
    """The frequency at which friction could just hold the mass where it turns back."""

    def excess(frequency):
        X, phase, _ = closed_form(frequency)
        return abs(FORCE * np.cos(phase) - X) - FRICTION

    return brentq(excess, 0.5, 0.6, xtol=1e-14)


@pytest.mark.slow(first=True)
def test_den_hartog_without_stops():
    motion = jb.find_cycle(den_hartog(0.6), (0.0, 0.0))
    assert motion.periods == 1
    assert motion.start == pytest.approx(start_of(0.6), abs=1e-10)
    assert [kind.name for kind, _ in motion.signature] == ["CROSS", "CROSS"]


@pytest.mark.slow(first=True)
def test_a_symmetric_motion_loses_two_stops_at_once():
    """Den Hartog's, at low frequencies, where a stop of each half ends in a grazing."""
    few, many = (jb.find_cycle(den_hartog(value), (1.0, 0.0)) for value in (0.145, 0.1456))
    assert (len(few.signature), len(many.signature)) == (4, 8)
    found = [
        jb.refine(jb.GrazingSliding(0), one.oscillator, where=frequency_of, start=one)
        for one in (few, many)
    ]
    assert [int(point.status) for point in found] == [OK, OK]
    assert found[0].value == pytest.approx(float(found[1].value), abs=1e-10)
    diagram = jb.bifurcation_diagram(den_hartog(0.1456), frequency_of, (0.144, 0.147), start=many)
    assert [point.kind for point in diagram.points] == ["GrazingSliding"]
    assert diagram.open_ends == ()
    # The engine on both sides.
    law = ("coulomb", 1.0, 1.0)
    for off, stops in ((-2e-6, 2), (2e-6, 4)):
        frequency = float(found[0].value) + off
        belts = (forced.Belt(0.0, law, FRICTION),)
        osc = forced.Oscillator(0.05, belts, (forced.Harmonic(1.0, frequency),))
        start = np.asarray(jb.find_cycle(den_hartog(frequency), (1.0, 0.0)).start)
        run = forced_cases.stroboscopic(osc, start, 1)
        assert run.y_end == pytest.approx(start, abs=1e-9)
        assert int(np.sum(run.kind == forced.STICK)) == stops


@pytest.mark.slow(first=True)
def test_the_amplitude_and_its_derivatives_are_those_of_the_closed_form():
    def height(frequency, friction):
        return jb.amplitude(jb.find_cycle(den_hartog(frequency, friction), (0.0, 0.0)))

    value, slopes = jax.value_and_grad(height, argnums=(0, 1))(0.6, FRICTION)
    assert float(value) == pytest.approx(closed_form(0.6)[0], abs=1e-11)
    h = 1e-4  # of order four: 1e-15 beside 1e-12 of rounding
    for slope, step in zip(slopes, np.eye(2) * h, strict=True):
        near, far = (
            (closed_form(*(at + n * step))[0] - closed_form(*(at - n * step))[0]) / (2 * n * h)
            for at in [np.array([0.6, FRICTION])]
            for n in (1, 2)
        )
        assert float(slope) == pytest.approx((4 * near - far) / 3, abs=1e-9)


@pytest.mark.slow(first=True)
def test_a_guess_beside_a_stick_gives_no_stick_phase_of_no_duration():
    stopping = jb.find_cycle(den_hartog(0.47), (0.0, 0.0))
    assert len(stopping.signature) == 4 and stopping.start[1] == 0.0
    guess = np.asarray(stopping.start) + np.array([0.0, -1e-3])
    again = jb.periodic(den_hartog(0.47), guess)
    assert again.start == pytest.approx(np.asarray(stopping.start), abs=1e-10)
    assert again.signature == stopping.signature


@pytest.mark.slow
def test_a_branch_goes_on_where_stops_begin_and_where_one_passes_the_phase_0():
    """Two stops begin at the limit; at 0.4711 one of them begins at the phase 0."""
    start = jb.find_cycle(den_hartog(0.58), (0.0, 0.0))
    diagram = jb.bifurcation_diagram(den_hartog, span=(0.46, 0.6), start=start)
    (point,), (branch,) = diagram.points, diagram.branches
    assert point.kind == "CrossingSliding"
    assert float(point.value) == pytest.approx(limit_without_stops(), abs=1e-10)
    assert branch.values[[0, -1]] == pytest.approx([0.46, 0.6], abs=1e-12)
    assert np.all(np.diff(branch.values) > 0)
    slips = branch.values > limit_without_stops()
    assert np.array_equal(slips, ~(branch.stick_durations[:, 0] > 0))
    assert np.all(branch.evaluated(jb.stick_fraction)[~slips] > 0)
    exact = [closed_form(one)[0] for one in branch.values[slips]]
    # Rows of a branch are good to what its corrector leaves.
    assert branch.amplitude[slips] == pytest.approx(exact, abs=1e-8)
    stopping = jb.find_cycle(den_hartog(0.46), (0.0, 0.0))
    assert branch.amplitude[0] == pytest.approx(float(jb.amplitude(stopping)), abs=1e-8)
    ax = diagram.plot(quantity="amplitude")
    assert ax.get_xlim() == (0.46, 0.6) and ax.get_xlabel() == r"frequency of forcing $\Omega$"
    plt.close("all")


@pytest.mark.slow
def test_the_limit_without_stops_is_a_bifurcation():
    limit = limit_without_stops()
    osc = den_hartog(limit + 0.02)
    kind = jb.CrossingSliding(0)
    point = jb.refine(kind, osc, where=frequency_of, start=(0.0, 0.0))
    assert int(point.status) == OK
    assert float(point.value) == pytest.approx(limit, abs=1e-10)


# --- branches ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_branch_with_its_points(sticking):
    """From the sticking motion to the fold and back on the unstable motion that it meets there."""
    diagram = jb.bifurcation_diagram(bkn(1.68), frequency_of, (1.675, 1.69), start=sticking)
    folds = [point for point in diagram.points if point.kind == "Fold"]
    assert [float(one.value) for one in folds] == pytest.approx([1.683440572496], abs=1e-10)
    (branch,) = diagram.branches
    assert branch.values.max() < 1.683440573
    assert np.any(branch.stable) and np.any(~branch.stable)


# --- exponents ------------------------------------------------------------------------------------


def test_exponents_of_a_motion_that_sticks(sticking):
    found = jb.lyapunov(bkn(1.68), (0.5, 0.0), periods=100, transient=200)
    wanted = np.log(abs(sticking.multipliers[0])) / 2
    assert float(found.per_period[0]) == pytest.approx(float(wanted), abs=1e-9)
    assert found.per_period[1] == -np.inf and bool(found.sticks)
    assert float(found.exponents[0]) == pytest.approx(wanted * 1.68 / (2 * np.pi), abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "frequency, start, wanted", [(1.69, (0.5, 0), 0.1277), (1.68, (2, -0.3), 0.1494)]
)
def test_exponents_of_chaos(frequency, start, wanted):
    found = jb.lyapunov(bkn(frequency), start, periods=2000)
    error = float(found.standard_errors[0]) * 2 * np.pi / frequency
    # The wanted one is known to 1e-4.
    assert abs(float(found.per_period[0]) - wanted) < 3 * error + 1e-4
    assert found.exponents[1] == -np.inf


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_a_stable_motion_is_not_what_every_slow_orbit_leads_to():
    """Hardly damped, the free motion dies away slowly beside the response, whose frequency is near
    to it. From 0.5 it does not touch the velocity of the belt; from 1.1 the two add up to it after
    150 periods, and the mass sticks and slips from then on."""
    belt = jb.Belt(1.0, jb.Coulomb(1.5, 0.5))
    osc = jb.Oscillator(1e-4, (belt,), forcing=jb.Harmonic(0.0012, 1.002))
    motion = jb.find_cycle(osc, (0.5, 0.0))
    assert int(motion.status) == jb.Status.OK and not motion.signature
    run = jb.simulate(osc, (1.1, 0.0), 1000.0)
    assert float(run.events.t[0]) == pytest.approx(953.7, abs=0.1)
    assert int(jb.find_cycle(osc, (1.1, 0.0)).status) == jb.Status.NOT_SETTLED


def test_what_is_for_forced_oscillators_says_so():
    still = jb.presets.class_b(0.45, 0.35)
    with pytest.raises(ValueError, match="osc must be with a clock: periodic is for"):
        jb.periodic(still, (0.0, 0.0))
    with pytest.raises(ValueError, match="osc must be with a clock: lyapunov is for"):
        jb.lyapunov(still, (0.0, 0.0))
    with pytest.raises(ValueError, match="osc must be with a clock: PeriodDoubling is for"):
        jb.refine(jb.PeriodDoubling(), still, where=lambda o: o.belts[0].velocity)
    with pytest.raises(ValueError, match="osc must be without a clock: NonsmoothFold is for"):
        jb.refine(jb.NonsmoothFold(0), bkn(1.7), where=frequency_of)
    with pytest.raises(ValueError, match="periods must be at most 32, got 33"):
        jb.periodic(bkn(1.7), (0.0, 0.0), periods=33)
    forces = jb.Harmonic(0.1, 1.0), jb.Harmonic(0.1, 2**0.5)
    law = jb.Cubic(1.5, 1.5, 0.45)
    osc = jb.Oscillator(0.0, (jb.Belt(1.0, law),), forcing=forces)
    with pytest.raises(ValueError, match="a period in common"):
        jb.find_cycle(osc, (0.0, 0.0))


@pytest.mark.slow(first=True)
def test_no_motion_begins_a_stick_phase_off_its_belt():
    """Newton's method came to arcs that close, of which the first one sticks, as the guess's orbit
    did at the phase 0, though x2 is 0.106 less than the belt's velocity there."""
    belts = (
        jb.Belt(
            0.4154444398169099,
            jb.Conti(0.6049188829626094, 0.2550394743834081, 6.02933669528854),
            0.79044996904765,
            lower=-0.8422993400111707,
        ),
        jb.Belt(
            0.6418290706066099,
            jb.Conti(1.2035373653805785, 0.8721736605049802, 5.413125720158654),
            1.3703185331281773,
            lower=0.36749594123280493,
        ),
    )
    forcing = jb.Harmonic(0.26103804975329814, 2.093961775249448, 1.109664635677639)
    osc = jb.Oscillator(0.3919753302448578, belts, forcing=forcing)
    guess = (1.404863563013945, 0.5510750911554423)
    motion = jb.periodic(osc, guess, periods=2)
    if motion.status == jb.Status.OK:
        run = jb.simulate(osc, motion.start, motion.period, ts=[float(motion.period)])
        np.testing.assert_allclose(run.ys[-1], motion.start, atol=1e-8)
    # What it was, is none.
    wrong = jnp.array([1.36221451, 0.30946912])
    assert motion.status != jb.Status.OK or jnp.max(jnp.abs(motion.start - wrong)) > 1e-3


# --- where t is 0 makes no difference -------------------------------------------------------------


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("phase", [0.0, 0.5])
def test_a_motion_with_an_event_at_the_phase_0_has_it_once(phase):
    """At the first phase the mass begins to stick 2e-5 before t = 0."""
    motion = jb.find_cycle(stribeck(1.2315, phase), (0.4, -0.2))
    kinds = sorted(int(kind) for kind, _ in motion.signature)
    assert kinds == [jb.EventKind.STICK, jb.EventKind.SLIP]
    # The state at t = 0, from which the motion comes back after a period.
    run = jb.simulate(motion.oscillator, motion.start, motion.period)
    np.testing.assert_allclose(run.ys[-1], motion.start, atol=1e-8)
    np.testing.assert_allclose(motion.starts[0], motion.start, atol=1e-15)
    np.testing.assert_allclose(motion.sample(5)[0], motion.start, atol=1e-12)


@pytest.mark.slow(first=True)
def test_the_derivative_of_a_start_of_a_chain_that_begins_elsewhere():
    """By differences of the engine, in which the mass sticks at the phase 0, too: its x1 there
    after a period is a function of its x1 before."""
    frequency, velocity = 1.2315, 0.1139

    def start(amplitude):
        force = jb.Harmonic(amplitude, frequency)
        osc = replace(stribeck(frequency, 0.0), forcing=(force,))
        return jb.find_cycle(osc, (0.4, -0.2)).start

    def after_a_period(x1, amplitude):
        belt = forced.Belt(velocity, ("stribeck", 0.5, 0.3, 0.0474))
        osc = forced.Oscillator(0.2108, (belt,), (forced.Harmonic(amplitude, frequency),))
        return forced.simulate(osc, (x1, velocity), 2 * np.pi / frequency).y_end[0]

    (x1, x2), h = start(0.15).tolist(), 1e-6
    assert x2 == velocity
    assert after_a_period(x1, 0.15) == pytest.approx(x1, abs=1e-10)
    by_x1 = (after_a_period(x1 + h, 0.15) - after_a_period(x1 - h, 0.15)) / (2 * h)
    by_amplitude = (after_a_period(x1, 0.15 + h) - after_a_period(x1, 0.15 - h)) / (2 * h)
    slope = jax.jacfwd(start)(0.15)
    assert slope[0] == pytest.approx(by_amplitude / (1 - by_x1), rel=1e-6)
    assert slope[1] == 0
    # The map's slope is the multiplier.
    motion = jb.find_cycle(stribeck(frequency, 0.0), (0.4, -0.2))
    assert float(motion.multipliers[0].real) == pytest.approx(by_x1, rel=1e-6)


@pytest.mark.slow(first=True)
def test_motions_beside_where_an_event_passes_the_phase_0():
    frequencies = jnp.linspace(1.2, 1.26, 7)

    def largest(phase):
        motion = jb.find_cycle(stribeck(1.2, phase), (0.4, -0.2))
        found = jax.vmap(lambda f: motion.at(stribeck(f, phase)))(frequencies)
        assert np.all(np.asarray(found.status) == OK)
        last = motion.at(stribeck(1.26, phase))
        assert float(last.x1_max) == pytest.approx(float(found.x1_max[-1]), abs=1e-10)
        return found.x1_max, found.start

    (highest, starts), (others, _) = largest(0.0), largest(0.5)
    np.testing.assert_allclose(highest, others, atol=1e-10)
    osc = stribeck(1.26, 0.0)
    run = jb.simulate(osc, starts[-1], 2 * np.pi / 1.26)
    np.testing.assert_allclose(run.ys[-1], starts[-1], atol=1e-8)


@pytest.mark.slow(first=True)
def test_the_error_of_an_exponent_is_no_less_than_rounding():
    """Without damping and load both exponents are zero."""
    belt = jb.Belt(0.3, jb.Coulomb(1.0, 1.0), 0.0)
    osc = jb.Oscillator(0.0, (belt,), forcing=jb.Harmonic(1.0, 2.0))
    found = jb.lyapunov(osc, (1.0, 0.0), periods=50, transient=0)
    assert found.exponents[0] >= found.exponents[1]
    assert np.all(np.abs(found.exponents) <= 3 * found.standard_errors)


@pytest.mark.slow(first=True)
def test_a_branch_goes_on_where_an_event_passes_the_phase_0():
    found = jb.bifurcation_diagram(lambda f: stribeck(f, 0.0), span=(0.9, 1.265))
    (branch,) = found.branches
    assert found.points == () and found.open_ends == ()
    assert branch.values.min() == 0.9 and branch.values.max() == 1.265


@pytest.mark.slow
@pytest.mark.parametrize("phase", [0.0, 2.0, 2.6, np.pi])
def test_points_of_a_branch_do_not_depend_on_where_t_is_0(phase):
    """At 1.66769 the motion of two periods that slips comes to touch the belt, for both multipliers
    of it, -1.264258 and -0.035038, SciPy's: it does not cross it."""
    frequency = 1.68
    circle = jb.circle_map(bkn(frequency, phase=phase))
    start = circle.motions[int(np.argmax(circle.stable))]
    found = jb.bifurcation_diagram(
        lambda f: bkn(f, phase=phase), span=(1.66, 1.70), start=start, rows=40
    )
    assert [type(point.condition) for point in found.points] == [jb.GrazingSliding, jb.Fold]
    assert found.open_ends == ()
    grazing, fold = found.points
    assert float(grazing.value) == pytest.approx(1.667690998106, abs=1e-10)
    assert grazing.cycle.multipliers == pytest.approx([-1.264258, -0.035038], abs=1e-6)
    assert float(fold.value) == pytest.approx(1.683440572496, abs=1e-10)
    point = jb.refine(jb.Fold(), lambda f: bkn(f, phase=phase), at=frequency, start=start)
    assert float(point.value) == pytest.approx(1.683440572496, abs=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.0, np.pi])
def test_a_branch_does_not_come_back_on_its_own_way(shift):
    """The motion of two periods leaves at -0.6705, and is passed once up to the end of the span;
    at the phase 0 it was once passed eight times between two of its points."""
    frequency, phase = 1.2452992554816376, -2.3977739914230036
    law = jb.Conti(1.3002848008294428, 0.4622780264319666, 3.8834085816708197)
    other = jb.Coulomb(0.926320195367839, 0.8748525680829766)

    def make(velocity, shift=shift):
        belts = (
            jb.Belt(velocity, law, 1.4559526993781906),
            jb.Belt(-1.1619514070792074, other, 1.1257794784172945),
        )
        force = jb.Harmonic(0.7620646581716999, frequency, phase + shift)
        return jb.Oscillator(0.21854331541413463, belts, 1.219010775315218, forcing=force)

    middle = -0.8679051388820676
    known = jb.find_cycle(make(middle, 0.0), (-1.506923755745062, 1.1556079688091607))
    begins = jb.simulate(make(middle, 0.0), known.start, shift / frequency) if shift else None
    guess = known.start if begins is None else begins.ys[-1]
    start = jb.periodic(make(middle), guess, periods=known.periods)
    span = middle - 0.3, middle + 0.3
    found = jb.bifurcation_diagram(make, span=span, rows=48, start=start)
    assert found.open_ends == ()
    assert [type(point.condition).__name__ for point in found.points] == [
        "GrazingSliding",
        "PeriodDoubling",
        "AddingSliding",
        "Fold",
        "PeriodDoubling",
        "GrazingSliding",
        "PeriodDoubling",
        "PeriodDoubling",
        "Fold",
    ]
    _, double = found.branches
    assert {motion.periods for motion in double.cycles} == {2}
    values = double.values if abs(double.values[0] + 0.67) < 0.01 else double.values[::-1]
    # It turns at both folds, and at the grazing point at -0.855.
    assert np.sum(np.diff(np.sign(np.diff(values))) != 0) == 3
    assert values[-1] == span[1]


@pytest.mark.slow
@pytest.mark.parametrize("away", [0.0, 1e-9, -1e-9, 1e-3, -1e-3])
def test_a_point_is_found_again_from_its_own_motion(away):
    def osc(force):
        belt = jb.Belt(0.1, jb.Coulomb(1.0, 0.6))
        return jb.Oscillator(0.05, (belt,), forcing=jb.Harmonic(force, 1.5))

    point = jb.refine(jb.AddingSliding(0), osc, at=0.95, start=(1.0, 0.0))
    value = float(point.value)
    again = jb.refine(jb.AddingSliding(0), osc, at=value + away, start=point.cycle)
    assert int(again.status) == OK and float(again.value) == pytest.approx(value, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("frequency", [0.99, 1.02])
def test_a_crossing_begins_to_stick_however_long_the_mass_is_beyond(frequency):
    """It crosses the boundary, slips on the other side for some time, and sticks then; where it
    crosses it begins to stick for a moment."""

    def osc(frequency, static=0.8, kinetic=0.8):
        belt = jb.Belt(0.4, jb.Coulomb(static, kinetic))
        return jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(0.9, frequency))

    span = (frequency - 0.04, frequency + 0.04)
    found = jb.bifurcation_diagram(osc, span=span, start=(0.5, 0.0))
    assert found.open_ends == ()
    (point,) = found.points
    assert isinstance(point.condition, jb.CrossingSliding)
    before, behind = (
        jb.find_cycle(osc(float(point.value) + way), point.cycle.start).signature
        for way in (-1e-6, 1e-6)
    )
    assert sorted(kind.name for kind, _ in before) == ["CROSS", "SLIP", "STICK"]
    assert sorted(kind.name for kind, _ in behind) == ["SLIP", "SLIP", "STICK", "STICK"]
    motion = jb.find_cycle(osc(frequency), (0.5, 0.0))
    again = jb.refine(jb.CrossingSliding(0), osc, at=frequency, start=motion)
    assert float(again.value) == pytest.approx(float(point.value), abs=1e-10)


@pytest.mark.slow
def test_where_friction_jumps_two_motions_end_side_by_side():
    """One sticks where it arrives, the other one crosses, and each ends where it would do what the
    other one does; in between both are there."""

    def osc(force):
        belt = jb.Belt(0.9, jb.Coulomb(1.0, 0.6))
        return jb.Oscillator(0.05, (belt,), forcing=jb.Harmonic(force, 1.3))

    found = jb.bifurcation_diagram(osc, span=(0.7, 0.94))
    low, high = (float(point.value) for point in found.points)
    assert {type(point.condition) for point in found.points} == {jb.SwitchingSliding}
    assert 0.82 < low < high < 0.84
    for branch in found.branches:
        kinds = [{kind for kind, _ in cycle.signature} for cycle in branch.cycles]
        crosses = {jb.EventKind.CROSS in one for one in kinds}
        assert len(crosses) == 1
    middle = osc(0.5 * (low + high))
    durations = {
        round(float(jb.find_cycle(middle, start).stick_durations[0]), 3)
        for start in ((-0.3427, 0.6498), (-0.355, 0.659))
    }
    assert len(durations) == 2


@pytest.mark.slow
def test_a_branch_does_not_come_home_the_way_that_it_has_gone():
    """Two folds, and an end at which the tangent turns by a right angle."""

    def between_two_belts(frequency):
        belts = (jb.Belt(v, jb.Coulomb(1.0, 0.6), load=0.4) for v in (0.3, -0.3))
        return jb.Oscillator(0.05, tuple(belts), forcing=jb.Harmonic(1.0, frequency))

    for begun in (0.325, 0.35):
        start = jb.find_cycle(between_two_belts(begun), (0.0, 0.0))
        found = jb.bifurcation_diagram(between_two_belts, span=(0.285, 0.42), start=start)
        values = [float(point.value) for point in found.points]
        for expected in (0.322637908, 0.325369709, 0.355773559):
            assert np.min(np.abs(np.subtract(values, expected))) < 1e-8
        # Its end has a point, or is open.
        ends = np.append(values, found.open_ends)
        assert np.min(np.abs(ends - 0.325141094)) < 1e-8


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("frequency", [1.0, 0.25, 0.1])
def test_exponents_of_a_linear_motion_are_known_where_one_is_lost_in_rounding(frequency):
    """In a period of 63 units of time the second tangent shrinks to 1e-71 of its size."""
    belt = jb.Belt(0.3, jb.Coulomb(1.0, 0.8), load=0.7)
    osc = jb.Oscillator(3.0, (belt,), forcing=jb.Harmonic(0.9, frequency))
    found = jb.lyapunov(osc, (1.0, 0.0), periods=50, transient=10)
    assert not bool(found.sticks)
    expected = [-1.5 + 1.25**0.5, -1.5 - 1.25**0.5]
    np.testing.assert_allclose(found.exponents, expected, rtol=0, atol=1e-12)


@pytest.mark.slow(first=True)
def test_areas_change_by_what_multipliers_multiply_to():
    """Across two belts, with a law that bends."""
    belts = (
        jb.Belt(0.3, jb.Coulomb(1.0, 0.6), load=0.2),
        jb.Belt(-0.2, jb.Stribeck(1.0, 0.5, 0.3), 0.2),
    )
    osc = jb.Oscillator(0.1, belts, forcing=jb.Harmonic(1.2, 0.7))
    motion = jb.find_cycle(osc, (1.0, 0.0))
    assert len(motion.signature) == 4 and not np.any(motion.stick_durations)
    found = jb.lyapunov(osc, motion.start, periods=25, transient=0)
    area = np.log(np.abs(np.prod(np.asarray(motion.multipliers))))
    assert float(np.sum(found.per_period)) == pytest.approx(area, abs=1e-9)


@pytest.mark.slow(first=True)
def test_forces_in_either_order_have_the_same_motions():
    """One a hundred times as fast as the other: the slower one was not allowed to be the second."""
    slow, fast = jb.Harmonic(0.5, 0.01), jb.Harmonic(0.9, 1.0)
    belt = jb.Belt(0.3, jb.Coulomb(1.0, 0.8), load=0.1)
    found = [
        jb.find_cycle(jb.Oscillator(0.5, (belt,), forcing=forces), (1.0, 0.0))
        for forces in ((slow, fast), (fast, slow))
    ]
    assert all(int(one.status) == OK and one.periods == 1 for one in found)
    np.testing.assert_allclose(found[0].start, found[1].start, rtol=0, atol=1e-11)
    unlike = jb.Oscillator(0.5, (belt,), forcing=(fast, jb.Harmonic(0.5, 1.01)))
    with pytest.raises(ValueError, match="of 64 periods of the slowest at most"):
        jb.find_cycle(unlike, (1.0, 0.0))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("load", [0.25, 0.3])
def test_a_branch_goes_on_where_a_motion_touches_two_boundaries_at_once(load):
    """From the side on which it sticks to both belts it ended there. Where it slips between them
    their friction is constant, so the motion is in closed form."""

    def make(frequency):
        law = jb.Coulomb(1.0, 1.0)
        belts = jb.Belt(0.5, law, load=0.25), jb.Belt(-0.5, law, load=load)
        return jb.Oscillator(0.1, belts, forcing=jb.Harmonic(1.0, frequency))

    def too_fast(w):
        return w / np.hypot(1 - w**2, 0.1 * w) - 0.5

    touches = brentq(too_fast, 0.3, 0.5, xtol=1e-14)
    for span, start in (((0.4, 0.44), (0.0, 0.0)), ((0.39, 0.43), None)):
        found = jb.bifurcation_diagram(make, span=span, start=start)
        assert found.open_ends == () and len(found.branches) == 1
        (point,) = found.points
        assert type(point.condition) is jb.GrazingSliding
        assert float(point.value) == pytest.approx(touches, abs=1e-11)
        values = found.branches[0].values
        assert (min(values), max(values)) == pytest.approx(span)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("condition", [jb.PeriodDoubling(), jb.GrazingSliding(0)])
def test_a_motion_that_was_not_found_is_no_start(condition):
    belt = jb.Belt(0.5, jb.Conti(1.0, 0.6, 10.0))
    osc = jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(0.5, 1.66))
    start = jb.find_cycle(osc, (0.5, 0.0))
    assert start.status == jb.Status.NOT_SETTLED
    with pytest.raises(ValueError, match="start must be a motion with status OK, got NOT_SETTLED"):
        jb.refine(condition, osc, where=lambda osc: osc.forcing[0].frequency, start=start)
