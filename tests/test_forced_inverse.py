"""Fits of records of forced motions, and designs of forced motions.

Oracles: records of the engine of tests/campaign/forced.py, and their Richardson differences; the
closed form of Den Hartog's motion without stops; the fold of di Bernardo, Kowalczyk and Nordmark.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scipy.optimize import brentq
from test_periodic import bkn, bkn_of_engine, closed_form, den_hartog, frequency_of

import jaxbelt as jb
from jaxbelt.inverse.selection import selection_of
from tests.campaign import forced, forced_cases

OK = jb.Status.OK

# --- fit ------------------------------------------------------------------------------------------

#: Static friction, damping; amplitude, frequency and phase of the force.
TRUTH = np.array([1.0, 0.1, 0.9, 1.3, 0.4])
TS = 2.0 + np.arange(600) * 0.1
START = (1.0, 0.0)
SIGMA = 0.01
NU, KINETIC = 0.3, 0.6


def where(osc):
    belt, force = osc.belts[0], osc.forcing[0]
    return belt.friction.static, osc.damping, force.amplitude, force.frequency, force.phase


def oscillator(values, length=1.0):
    static, damping, *wave = values
    belt = jb.Belt(NU * length, jb.Coulomb(static, KINETIC), load=length)
    return jb.Oscillator(damping, (belt,), forcing=jb.Harmonic(wave[0] * length, *wave[1:]))


def recorded(values, start=START, ts=TS):
    """States of the engine at the times of a record, [samples, 2]."""
    static, damping, *wave = values
    belt = forced.Belt(NU, ("coulomb", static, KINETIC))
    return recorded_of(forced.Oscillator(damping, (belt,), (forced.Harmonic(*wave),)), start, ts)


def recorded_of(osc, start, ts):
    y = np.array(start)
    states = [y]
    for before, after in itertools.pairwise(ts):
        y = np.asarray(forced.simulate(osc, y, after, t0=before).y_end)
        states.append(y)
    return np.array(states)


def noise_of(seed, size=600):
    return SIGMA * np.random.default_rng(seed).standard_normal(size)


@pytest.fixture(scope="module")
def motion():
    return recorded(TRUTH)


def assert_recovered(found, truth):
    """Within four standard errors: by chance once in 3,000 records of five parameters."""
    assert int(found.status) == OK, found
    off = np.abs(np.asarray(found.estimates) - truth)
    assert np.all(off < 4 * np.asarray(found.standard_errors)), found


@pytest.fixture(scope="module")
def fitted(motion):
    guess = oscillator(TRUTH * [1.3, 0.7, 1.3, 1.01, 0.0])
    return jb.fit(guess, TS, motion[:, 0] + noise_of(2), where=where, noise=SIGMA)


@pytest.mark.slow(first=True)
def test_fit_recovers_friction_damping_and_force(fitted):
    """From 30 per cent off, of the phase nothing known; the record begins at t = 2."""
    assert_recovered(fitted, TRUTH)
    # How exactly 600 data tell the frequency: a phase of 0.004 at the end of 60 units of time.
    assert fitted.standard_errors[3] < 2e-4 and fitted.standard_errors[4] < 0.01
    assert np.all(np.abs(fitted.y0 - np.array(START)) < 4 * fitted.y0_standard_errors)
    # 593 degrees of freedom: standard deviation 0.058.
    assert fitted.reduced_chi_squared == pytest.approx(1, abs=4 * 0.058)
    again = jb.simulate(fitted.oscillator, fitted.y0, TS[-1], t0=TS[0], ts=TS)
    # The pieces of the fit were computed at 1e-8.
    np.testing.assert_allclose(fitted.ys, again.ys, atol=1e-7)


@pytest.mark.slow(first=True)
def test_standard_errors_are_those_of_the_engines_derivatives(fitted):
    at = np.append(np.asarray(fitted.estimates), np.asarray(fitted.y0))
    columns = []
    for direction in np.eye(7):
        derivative, _ = oracle.richardson(
            lambda h, e=direction: recorded(at[:5] + h * e[:5], at[5:] + h * e[5:])[:, 0],
            *(0.0, 2e-5, 2),
        )
        columns.append(derivative / SIGMA)
    jacobian = np.stack(columns, axis=1)
    covariance = np.linalg.inv(jacobian.T @ jacobian)[:5, :5]
    scale = np.sqrt(np.diag(covariance))
    # Corners of the motion between two samples of a difference cost a little.
    np.testing.assert_allclose(
        np.asarray(fitted.covariance) / scale[:, None] / scale,
        covariance / scale[:, None] / scale,
        atol=2e-3,
    )


@pytest.mark.slow
def test_intervals_contain_the_truth_as_often_as_they_say(motion):
    inside, squares = 0, 0.0
    for seed in range(30):
        guess = oscillator(TRUTH * [1.05, 0.95, 1.05, 1.002, 0.9])
        x1 = motion[:, 0] + noise_of(100 + seed)
        found = jb.fit(guess, TS, x1, where=where, noise=SIGMA, starts=2)
        assert int(found.status) == OK
        lower, upper = np.asarray(found.intervals()).T
        inside += np.sum((lower < TRUTH) & (TRUTH < upper))
        off = np.asarray(found.estimates) - TRUTH
        squares += off @ np.linalg.solve(np.asarray(found.covariance), off)
    # Of 150, which hang together in fives, 142.5 are expected: standard deviation 2.7 to 6.
    assert 127 <= inside <= 150
    # chi^2 of 150 degrees of freedom: standard deviation 17.3.
    assert abs(squares - 150) < 4 * 17.3


@pytest.mark.slow(first=True)
def test_a_record_that_begins_while_the_mass_sticks():
    states = recorded(TRUTH, (-0.2, NU))
    assert np.ptp(states[:3, 1]) == 0.0
    guess = oscillator(TRUTH * [1.1, 0.9, 1.1, 1.005, 0.8])
    found = jb.fit(guess, TS, states[:, 0] + noise_of(7), where=where, noise=SIGMA, starts=4)
    assert_recovered(found, TRUTH)
    assert abs(found.y0[0] + 0.2) < 4 * found.y0_standard_errors[0]


@pytest.mark.slow(first=True)
def test_records_in_other_units_have_the_same_parameters(motion, fitted):
    """Lengths of 1e-5, as of a device in metres."""
    length, values = 1e-5, TRUTH * [1.3, 0.7, 1.3, 1.01, 0.0]
    found = jb.fit(
        oscillator(values, length),
        TS,
        length * (motion[:, 0] + noise_of(2)),
        where=where,
        noise=SIGMA * length,
    )
    scale = np.array([1.0, 1.0, length, 1.0, 1.0])
    assert int(found.status) == OK
    # Both end where less than 1e-5 of a squared standard error is left to gain.
    apart = (found.estimates / scale - fitted.estimates) / fitted.standard_errors
    assert np.all(np.abs(apart) < 0.01)
    errors = found.standard_errors / scale / fitted.standard_errors
    np.testing.assert_allclose(errors, 1.0, rtol=1e-3)


@pytest.mark.slow
def test_velocities_of_a_belt_that_swings():
    """The mass sticks to it at the ends of windows; the noise is estimated, from x2 alone."""
    truth = np.array([0.3, 0.2, 0.7, 0.5, 0.2])
    ts = np.arange(500) * 0.1

    def parts(module, values, law):
        *wave, force = values
        belt = module.Belt(module.Oscillating(*wave), law)
        return (belt,), (module.Harmonic(force, 1.4),)

    start = (-0.3, 0.3 + 0.2 * np.cos(0.5))
    osc = forced.Oscillator(0.1, *parts(forced, truth, ("coulomb", 1.0, 0.6)))
    states = recorded_of(osc, start, ts)
    x2 = states[:, 1] + noise_of(4, 500)

    def numbers(osc):
        wave = osc.belts[0].velocity
        numbers = wave.mean, wave.amplitude, wave.frequency, wave.phase
        return *numbers, osc.forcing[0].amplitude

    belts, forcing = parts(jb, truth * [1.1, 0.9, 1.005, 1.2, 1.2], jb.Coulomb(1.0, 0.6))
    found = jb.fit(jb.Oscillator(0.1, belts, forcing=forcing), ts, x2=x2, where=numbers)
    assert_recovered(found, truth)
    assert found.noise[1] == pytest.approx(SIGMA, rel=0.25)


@pytest.mark.slow
def test_a_machine_that_is_shaken_quickly():
    """In SI units. The support moves at four times the natural frequency: windows and cubics are
    shorter, or the motion were taken for noise."""

    def machine(amplitude, phase, force):
        belt = jb.PhysicalBelt(0.12, jb.Stribeck(0.62, 0.36, 0.04), force)
        shaken = jb.BaseMotion(amplitude, 80.0, phase)
        return jb.Machine(0.8, 320.0, 0.9, (belt,), forcing=shaken)

    true, guess, ts = machine(0.04, 0.7, 15.0), machine(0.03, 0.0, 16.0), np.arange(1500) * 0.002
    run = jb.simulate(true.oscillator, true.start(0.0, 0.0), true.tau(3.0), ts=true.tau(ts))
    noise = 2e-4 * np.random.default_rng(8).standard_normal(ts.size)
    x1 = (np.asarray(run.ys[:, 0] * true.units.length) + noise) / guess.units.length

    def numbers(osc):
        return osc.forcing[0].amplitude, osc.forcing[0].phase, osc.belts[0].load

    found = jb.fit(guess.oscillator, guess.tau(ts), x1, where=numbers)
    assert int(found.status) == OK, found
    assert found.noise[0] * guess.units.length == pytest.approx(2e-4, rel=0.1)
    told = jb.in_si(found, guess)
    assert told.unit.values[:3].tolist() == ["m", "rad", "N"]
    off = np.abs(told.estimate.values[:3] - [0.04, 0.7, 15.0])
    assert np.all(off < 4 * told.standard_error.values[:3])


def test_one_unit_of_a_frequency_or_phase_shifts_a_wave_by_a_radian():
    osc = oscillator(TRUTH)
    plain, _ = selection_of(osc, where, None)
    selection, u = selection_of(osc, where, None, 60.0)
    np.testing.assert_allclose(selection.values(jnp.asarray(u)), TRUTH, rtol=1e-14)
    slopes = jnp.diag(jax.jacfwd(selection.values)(jnp.asarray(u)))
    # The others as without a clock: of their own size, or of the distance to their bound.
    np.testing.assert_allclose(slopes, [1.0 - KINETIC, 0.1, 0.9, 1 / 60, 1.0], rtol=1e-12)
    assert plain.stretch is None
    zero = oscillator(TRUTH * [1, 1, 1, 1, 0])
    selection, u = selection_of(zero, where, None, 60.0)
    assert jax.jacfwd(selection.values)(jnp.asarray(u))[4, 4] == pytest.approx(1.0)


# --- functionals ----------------------------------------------------------------------------------


def amplitude_at(frequency):
    return jb.amplitude(jb.find_cycle(den_hartog(frequency), (0.0, 0.0)))


@pytest.mark.slow(first=True)
def test_extremes_and_their_derivatives_are_those_of_the_closed_form():
    motion = jb.find_cycle(den_hartog(0.6), (0.0, 0.0))
    X, _, state = closed_form(0.6)
    speed = max(abs(state(t)[1]) for t in np.linspace(0.0, np.pi / 0.6, 2001))
    assert motion.x1_max == pytest.approx(X, abs=1e-11)
    assert motion.x1_min == pytest.approx(-X, abs=1e-11)
    assert jb.amplitude(motion) == pytest.approx(X, abs=1e-11) == jb.peak(motion)
    # One of the samples, 0.0026 apart, is below the largest by 2e-6 at most.
    assert 0 <= motion.x2_max - speed < 2e-6
    assert jb.amplitude(motion, "x2") == pytest.approx(float(motion.x2_max), abs=1e-11)
    near, far = (
        (closed_form(0.6 + h)[0] - closed_form(0.6 - h)[0]) / (2 * h) for h in (1e-4, 2e-4)
    )
    wanted = (4 * near - far) / 3
    assert jax.jacfwd(amplitude_at)(0.6) == pytest.approx(wanted, abs=1e-9)
    assert jax.grad(amplitude_at)(0.6) == pytest.approx(wanted, abs=1e-9)


@pytest.mark.slow(first=True)
def test_functionals_of_a_motion_that_sticks():
    motion = jb.find_cycle(bkn(1.68), (0.5, 0.0))
    run = forced_cases.stroboscopic(bkn_of_engine(1.68), np.asarray(motion.start), 2)
    stuck = float(np.diff(run.t)[run.kind[:-1] == forced.STICK][0])
    period = 4 * np.pi / 1.68
    assert jb.period(motion) == pytest.approx(period, rel=1e-15)
    assert jb.stick_duration(motion) == pytest.approx(stuck, abs=1e-10)
    assert jb.stick_duration(motion, 0) == jb.stick_duration(motion)
    assert jb.slip_duration(motion) == pytest.approx(period - stuck, abs=1e-10)
    assert jb.stick_fraction(motion, 0) == pytest.approx(stuck / period, abs=1e-11)
    # The belt runs at 1, and the mass is never faster.
    assert motion.x2_max == pytest.approx(1.0, abs=1e-12)
    states = np.asarray(motion.sample(20_001))
    assert 0 <= float(states[:, 0].min() - motion.x1_min) < 1e-6
    assert 0 <= float(states[:, 1].min() - motion.x2_min) < 1e-6


# --- design ---------------------------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_design_meets_an_amplitude_at_a_frequency():
    plan = jb.design(
        den_hartog(0.7), [(jb.amplitude, 1.5)], where=lambda osc: osc.forcing[0].amplitude
    )
    assert int(plan.status) == OK and plan.names == ("forcing[0].amplitude",)
    assert plan.achieved[0] == pytest.approx(1.5, abs=1e-9)
    # On a surface at rest the mass turns back at events; free motions decay to e^-15 in 600.
    run = jb.simulate(plan.oscillator, (0.0, 0.0), 600.0)
    np.testing.assert_allclose(np.abs(run.events.y[-4:, 0]), 1.5, atol=2e-7)
    assert plan.table().name.tolist() == ["forcing[0].amplitude", "target 0"]
    plan.plot()


@pytest.mark.slow(first=True)
def test_design_finds_the_frequency_of_the_closed_form():
    plan = jb.design(den_hartog(0.6), [(jb.amplitude, 2.0)], where=frequency_of)
    assert int(plan.status) == OK
    exact = brentq(lambda frequency: closed_form(frequency)[0] - 2.0, 0.6, 0.9, xtol=1e-14)
    # What is asked for is 1e-9 of the amplitude, which changes by 4 or so with the frequency.
    assert float(plan.values[0]) == pytest.approx(exact, abs=1e-9)


@pytest.mark.slow(first=True)
def test_design_meets_a_share_of_sticking_and_a_multiplier():
    targets = [(lambda m: jb.stick_fraction(m, 0), 0.1), (lambda m: abs(m.multipliers[0]), 0.5)]

    def both(osc):
        return osc.forcing[0].amplitude, osc.forcing[0].frequency

    plan = jb.design(bkn(1.68), targets, where=both, y0=(0.5, 0.0))
    assert int(plan.status) == OK and bool(plan.cycle.stable)
    amplitude, frequency = np.asarray(plan.values)
    belt = forced.Belt(1.0, ("cubic", 1.5, 1.5, 0.45))
    osc = forced.Oscillator(0.0, (belt,), (forced.Harmonic(amplitude, frequency),))
    y, multipliers = forced_cases.periodic(osc, np.asarray(plan.cycle.start), 2)
    # Differences of runs are good to 3e-7.
    assert np.max(np.abs(multipliers)) == pytest.approx(0.5, abs=1e-6)
    run = forced_cases.stroboscopic(osc, y, 2)
    stuck = np.diff(run.t)[run.kind[:-1] == forced.STICK]
    assert np.sum(stuck) * frequency / (4 * np.pi) == pytest.approx(0.1, abs=1e-8)


@pytest.mark.slow
def test_design_keeps_a_fold_away():
    margin = jb.distance_to(jb.Fold(), where=frequency_of)
    plan = jb.design(bkn(1.68), [(margin, 0.005)], where=frequency_of, y0=(0.5, 0.0))
    assert int(plan.status) == OK
    assert float(plan.values[0]) == pytest.approx(1.683440572496 - 0.005, abs=1e-9)


@pytest.mark.slow(first=True)
def test_design_says_why_it_ends():
    """A stronger force tears the mass off: within the bounds it sticks for less than the half. And
    what leads to chaos has no motion to begin with."""
    share = [(jb.stick_fraction, 0.5)]
    plan = jb.design(
        bkn(1.68),
        share,
        where=lambda osc: osc.forcing[0].amplitude,
        bounds=[(0.09, 0.11)],
        y0=(0.5, 0.0),
    )
    assert int(plan.status) == jb.Status.UNREACHABLE and 0.05 < plan.achieved[0] < 0.5
    nothing = jb.design(bkn(1.7), share, where=frequency_of, y0=(0.5, 0.0))
    assert int(nothing.status) == jb.Status.NOT_SETTLED and np.isnan(nothing.achieved[0])


@pytest.mark.slow(first=True)
def test_designs_do_not_depend_on_the_unit_of_length():
    belt, force = jb.Belt(0.0, jb.Coulomb(0.4, 0.4), 4.0), jb.Harmonic(4.0, 0.7)
    large = jb.Oscillator(0.05, (belt,), forcing=force)

    def amplitude(osc):
        return osc.forcing[0].amplitude

    plans = [
        jb.design(osc, [(jb.amplitude, wanted)], where=amplitude)
        for osc, wanted in ((den_hartog(0.7), 1.5), (large, 6.0))
    ]
    np.testing.assert_allclose(plans[1].values, 4 * plans[0].values, rtol=1e-9)


# --- what is refused ------------------------------------------------------------------------------


def two_waves():
    belt = jb.Belt(1.0, jb.Cubic(1.5, 1.5, 0.45))
    return jb.Oscillator(0.0, (belt,), forcing=(jb.Harmonic(0.1, 1.0), jb.Harmonic(0.1, 2.0)))


@pytest.mark.parametrize(
    ("targets", "osc", "message"),
    [
        (
            [(jb.distance_to_basin_boundary(), 0.1)],
            bkn(1.68),
            "osc must be without a clock: distance_to_basin_boundary is for",
        ),
        (
            [(jb.distance_to(jb.Hopf(), where=frequency_of), 0.1)],
            bkn(1.68),
            "osc must be without a clock: Hopf is for .*; use a condition for forced ones",
        ),
        ([(lambda m: m.multipliers, 0.1)], bkn(1.68), "functional of targets must be a function"),
        ([(lambda m: float(m.period), 0.1)], bkn(1.68), "functional of targets must be a function"),
        ([(jb.amplitude, 0.1)], two_waves(), "where must be such that all frequencies keep"),
    ],
)
def test_what_makes_no_sense_with_forcing_is_refused(targets, osc, message):
    with pytest.raises(ValueError, match=message):
        jb.design(osc, targets, where=frequency_of)


@pytest.mark.slow
def test_an_estimate_at_its_bound_is_held_there():
    """The damping would be 0.0996 without it; the others are as if it were known."""
    law = jb.Coulomb(1.0, 0.8)

    def make(damping, amplitude, phase):
        belt = jb.Belt(0.3, law, load=0.7)
        return jb.Oscillator(damping, (belt,), forcing=jb.Harmonic(amplitude, 1.3, phase))

    def forces(osc):
        return osc.forcing[0].amplitude, osc.forcing[0].phase

    ts = np.linspace(0, 30, 301)
    x1 = jb.simulate(make(0.1, 0.9, 0.0), (1.0, 0.0), 30.0, ts=ts).ys[:, 0]
    x1 = np.asarray(x1) + 1e-3 * np.random.default_rng(5).standard_normal(301)
    bounds = [(0.1, 1.0), None, None]
    where = lambda o: (o.damping, *forces(o))  # noqa: E731
    found = jb.fit(make(0.15, 0.8, 0.5), ts, x1, where=where, noise=1e-3, bounds=bounds)
    known = jb.fit(make(0.1, 0.8, 0.5), ts, x1, where=forces, noise=1e-3)
    assert found.status == known.status == jb.Status.OK
    assert float(found.estimates[0]) == pytest.approx(0.1, abs=1e-6)
    assert found.standard_errors[0] == 0
    np.testing.assert_allclose(found.estimates[1:], known.estimates, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.standard_errors[1:], known.standard_errors, rtol=1e-3)
