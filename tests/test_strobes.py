"""Labels, exponents, basins and integrals of forced sweeps, against `find_cycle`, `lyapunov`, runs
of `simulate` and closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt import Status
from jaxbelt.kernel.clocked import timed_lanes_at_start
from jaxbelt.model.oscillator import common_turns, repeating
from jaxbelt.model.own_units import in_own_units
from jaxbelt.sweeps.moments import Course
from jaxbelt.sweeps.strobes import ForcedAttractor


def bernardo(frequency, amplitude=0.1):
    """Of di Bernardo, Kowalczyk and Nordmark (2003): periodic, chaotic, and sticking motions."""
    law = jb.Cubic(1.5, 1.5, 0.45)
    forcing = jb.Harmonic(amplitude, frequency)
    return jb.Oscillator(0.0, (jb.Belt(1.0, law, 1.0),), forcing=forcing)


@pytest.fixture(scope="module")
def labels():
    frequencies = [1.68, 1.69, 1.7078, 1.715, 1.72, 1.8, 2.5]
    return jb.sweep(
        bernardo, {"frequency": frequencies}, y0=(0.5, 0.5), t1=8000.0, observe="attractor"
    )


@pytest.mark.slow(first=True)
def test_periodic_motions_are_those_of_find_cycle(labels):
    kinds = jb.decoded(labels).kind.values
    for i, frequency in enumerate(labels.frequency.values):
        motion = jb.find_cycle(bernardo(frequency), (0.5, 0.5))
        if motion.status != Status.OK:
            assert kinds[i] == "chaotic" and labels.periods[i] == 0
            assert np.isnan(labels.period[i]) and np.isnan(labels.x1_max[i])
            continue
        row = labels.isel(frequency=i)
        assert kinds[i] == "periodic" and row.status == Status.OK
        assert row.periods == motion.periods
        np.testing.assert_allclose(row.period, motion.period, rtol=1e-12)
        np.testing.assert_allclose(row.stick_duration, motion.stick_durations, atol=1e-5)
        strobe = np.array([row.x1_strobe, row.x2_strobe])
        starts = np.asarray(motion.starts)
        np.testing.assert_allclose(strobe, starts[np.argmax(starts[:, 0])], atol=1e-5)
        states = np.asarray(motion.sample(20_001))
        found = [row.x1_min, row.x1_max, row.x2_min, row.x2_max]
        expected = [states[:, 0].min(), states[:, 0].max(), states[:, 1].min(), states[:, 1].max()]
        np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.slow(first=True)
def test_an_approach_from_two_sides_in_turn_has_the_period_of_its_end(labels):
    """At 1.715 the largest multiplier is near -1: the motion repeats after four periods first."""
    row = labels.sel(frequency=1.715)
    assert row.periods == 2 and row.status == Status.OK


@pytest.mark.slow(first=True)
def test_exponents_are_those_of_lyapunov_and_of_multipliers():
    frequencies = [1.69, 1.7077, 1.72, 1.8]
    found = jb.sweep(
        bernardo, {"frequency": frequencies}, y0=(0.5, 0.5), t1=8000.0, observe="lyapunov"
    )
    for frequency, value, error in zip(
        frequencies, found.exponent.values, found.exponent_error.values, strict=True
    ):
        osc = bernardo(frequency)
        motion = jb.find_cycle(osc, (0.5, 0.5))
        if motion.status == Status.OK:
            expected = np.log(abs(motion.multipliers[0])) / motion.period
            assert abs(value - expected) < 4 * error + 1e-4
        else:
            known = jb.lyapunov(osc, (0.5, 0.5), periods=400)
            both = np.hypot(error, known.standard_errors[0])
            assert abs(value - known.exponents[0]) < 4 * both
            assert value > 3 * error


def swinging(V, A, W, L):
    """One belt whose velocity oscillates: x1 and x2 have extrema inside of stick phases."""
    law = jb.Conti(1.0, 0.6, 10.0)
    return jb.Oscillator(0.1, (jb.Belt(jb.Oscillating(V, A, W, 0.3), law, L),))


def two_belts(V, A, W, L):
    """A load that oscillates, an edge, a static limit above the kinetic one."""
    first = jb.Belt(V, jb.Conti(1.0, 0.6, 10.0), jb.Oscillating(L, 0.4 * L, W, 1.0))
    second = jb.Belt(-0.2, jb.Coulomb(0.5, 0.4), 0.3, upper=0.5)
    return jb.Oscillator(0.1, (first, second), forcing=jb.Harmonic(A, W))


def steady(V, A, W, L):
    belt = jb.Belt(V, jb.Conti(1.0, 0.6, 10.0), L)
    return jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(A, W))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("make", [steady, swinging, two_belts])
def test_labels_and_exponents_of_random_oscillators(make):
    rng = np.random.default_rng(11)
    for i in range(8):
        drawn = rng.uniform([0.1, 0.1, 0.4, 0.2], [0.6, 1.0, 2.2, 1.0])
        V, A, W, L = np.maximum(np.round(drawn, 1), 0.1) if i % 2 else drawn
        axes = {name: [value] for name, value in dict(V=V, A=A, W=W, L=L).items()}
        run = {"y0": (0.3, 0.1), "t1": 4000.0}
        label = jb.sweep(make, axes, **run, observe="attractor").squeeze()
        kind = str(jb.decoded(label).kind.values)
        motion = jb.find_cycle(make(V, A, W, L), (0.3, 0.1))
        if motion.status != Status.OK:
            # It follows up to 16 periods.
            assert kind != "periodic" or label.periods > 16
            continue
        assert kind == "periodic" and label.periods == motion.periods
        extrema = [label.x1_min, label.x1_max, label.x2_min, label.x2_max]
        expected = [motion.x1_min, motion.x1_max, motion.x2_min, motion.x2_max]
        np.testing.assert_allclose(extrema, expected, atol=1e-6)
        sticks = np.atleast_1d(label.stick_duration)
        np.testing.assert_allclose(sticks, motion.stick_durations, atol=1e-5)
        found = jb.sweep(make, axes, **run, observe="lyapunov").squeeze()
        known = np.log(abs(motion.multipliers[0])) / motion.period
        room = 5 * found.exponent_error + 3e-3 * abs(known) + 2e-4
        assert abs(found.exponent - known) < room or known == -np.inf


def free(frequency, damping=0.0, load=0.0, velocity=0.3):
    belt = jb.Belt(velocity, jb.Coulomb(1.0, 1.0), load)
    return jb.Oscillator(damping, (belt,), forcing=jb.Harmonic(0.5, frequency))


@pytest.mark.slow(first=True)
def test_a_torus_a_response_and_a_mass_that_is_held():
    """A cycle without sticking, pushed at another frequency, is a torus; a belt without load leaves
    the linear response; within the capacity of a belt at rest nothing moves."""
    found = jb.sweep(
        bernardo,
        {"frequency": [np.sqrt(5)], "amplitude": [0.02]},
        y0=(0.5, 0.5),
        t1=6000.0,
        observe="attractor",
    ).squeeze()
    assert jb.decoded(found).kind == "quasiperiodic" and found.status == Status.OK
    assert abs(found.exponent) < 3 * found.exponent_error < 3e-3

    found = jb.sweep(
        lambda damping: free(np.sqrt(2), damping), {"damping": [0.2]}, observe="attractor"
    )
    size = 0.5 / np.hypot(1 - 2, 0.2 * np.sqrt(2))
    assert jb.decoded(found).kind[0] == "periodic" and found.periods[0] == 1
    np.testing.assert_allclose(found.x1_max[0], size, rtol=1e-5)
    np.testing.assert_allclose(found.x2_min[0], -np.sqrt(2) * size, rtol=1e-5)

    def held(amplitude):
        belt = jb.Belt(0.0, jb.Coulomb(1.0, 1.0), 1.0)
        return jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(amplitude, 0.8))

    found = jb.sweep(held, {"amplitude": [0.5]}, y0=(0.2, 0.0), observe="attractor")
    assert jb.decoded(found).kind[0] == "stuck" and bool(found.sticks[0, 0])
    assert np.isinf(found.stick_duration[0, 0]) and found.x1_max[0] == 0.2


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("frequency", [0.5, 2.0, np.sqrt(5)])
def test_what_attracts_nothing_is_no_attractor(frequency):
    """Without damping, friction of constant size leaves a continuum of motions: at round
    frequencies each of them repeats."""
    found = jb.sweep(
        lambda load: free(frequency, load=load, velocity=50.0),
        {"load": [0.0, 1.0]},
        y0=(1.0, 0.0),
        t1=3000.0,
        observe="attractor",
    )
    assert set(jb.decoded(found).kind.values) == {"undecided"}
    assert np.all(found.status == Status.NEUTRAL)
    assert np.all(np.isnan(found.x1_max)) and np.all(found.periods == 0)


@pytest.mark.slow(first=True)
def test_periods_are_those_that_all_frequencies_have_in_common():
    def make(ratio):
        forcing = (jb.Harmonic(0.5, 1.2), jb.Harmonic(0.3, 1.2 * ratio))
        belt = jb.Belt(0.3, jb.Conti(1.0, 0.6, 10.0), 0.4)
        return jb.Oscillator(0.3, (belt,), forcing=forcing)

    found = jb.sweep(make, {"ratio": [2 / 3, 0.5, 3.0]}, y0=(0.5, 0.0), observe="attractor")
    for i, ratio in enumerate(found.ratio.values):
        motion = jb.find_cycle(make(ratio), (0.5, 0.0))
        assert found.periods[i] == motion.periods
        np.testing.assert_allclose(found.period[i], motion.period, rtol=1e-12)
    # Frequencies with no period in common have no periodic motion.
    found = jb.sweep(make, {"ratio": [np.sqrt(2)]}, y0=(0.5, 0.0), t1=3000.0, observe="attractor")
    assert jb.decoded(found).kind[0] != "periodic" and found.periods[0] == 0


@pytest.mark.parametrize("unit", [1.0, 300.0, 1 / 300])
@pytest.mark.parametrize(
    ("waves", "turns"),
    [
        ((1, 0), 1),  # a constant force repeats always
        ((0, 1), 1),
        ((0, 0), 0),  # no clock at all
        ((0, 1, 0.5, 0), 2),
        ((1, 1), 1),
        ((1, 1 / 2), 2),
        ((1 / 2, 1), 1),
        ((1, 2 / 3), 3),
        ((1, 3 / 2), 2),
        ((3 / 2, 1), 3),
        ((1, 2), 1),
        ((1, 33 / 32), 32),
        ((33 / 32, 1), 33),
        ((1, 1 / 33), 33),
        ((1, np.sqrt(2)), 0),
        ((1, 1 + 1e-8), 0),
        ((1, np.nan), 0),  # what is not known to repeat
    ],
)
def test_turns_after_which_all_waves_repeat(waves, turns, unit):
    rates = [np.array([unit * one, 1.0]) for one in waves]
    with np.errstate(invalid="ignore"):
        assert common_turns(rates, np).tolist() == [turns, 1]
    assert common_turns([jnp.asarray(one) for one in rates]).tolist() == [turns, 1]


def linear(*forcing):
    """Its mass never comes to the belt's velocity, and friction of 0.5 pushes it."""
    return jb.Oscillator(0.2, (jb.Belt(10.0, jb.Coulomb(0.5, 0.5)),), forcing=forcing)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, -1])
def test_a_force_whose_frequency_is_0_in_a_sweep_is_a_constant_one(order):
    """x1 = 1 +- 5 there, 0.5 +- 7.5 at the frequency of the other force; a force that beats slowly
    with it has no period."""

    def make(f2):
        return linear(*(jb.Harmonic(1.0, 1.0), jb.Harmonic(0.5, f2))[::order])

    axes = {"f2": [0.0, 1.0, 1 + 1e-8]}
    found = jb.sweep(make, axes, observe="attractor", t1=3000.0, y0=(0.0, 0.0))
    assert jb.decoded(found).kind.values.tolist() == ["periodic", "periodic", "undecided"]
    np.testing.assert_allclose(found.period[:2], 2 * np.pi, rtol=1e-14)
    np.testing.assert_allclose(found.x1_min[:2], [-4.0, -7.0], atol=1e-5)
    np.testing.assert_allclose(found.x1_max[:2], [6.0, 8.0], atol=1e-5)
    motion = jb.find_cycle(make(0.0), (0.0, 0.0))
    assert motion.periods == found.periods[0] == 1
    np.testing.assert_allclose([motion.x1_min, motion.x1_max], [-4.0, 6.0], rtol=1e-12)


class Ramp(jb.AbstractForce):
    """Never repeats."""

    size: jax.Array
    frequency: jax.Array

    def force(self, t):
        return self.size * jnp.tanh(1e-6 * t)


def test_of_a_force_of_ones_own_without_a_frequency_nothing_is_known():
    osc = linear(jb.Harmonic(1.0, 1.0), Ramp(jnp.array(0.5), jnp.array(0.0)))
    assert common_turns(repeating(osc)) == 0
    with pytest.raises(ValueError, match="osc must be such that all its frequencies have a period"):
        jb.find_cycle(osc, (0.0, 0.0))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("k", [-20, 20])
def test_labels_do_not_depend_on_the_unit_of_length(labels, k):
    unit = 2.0**k

    def scaled(frequency):
        law = jb.Cubic(1.5, 1.5 / unit, 0.45 / unit**3)
        forcing = jb.Harmonic(0.1 * unit, frequency)
        return jb.Oscillator(0.0, (jb.Belt(unit, law, unit),), forcing=forcing)

    frequencies = labels.frequency.values
    y0 = 0.5 * unit, 0.5 * unit
    found = jb.sweep(scaled, {"frequency": frequencies}, y0=y0, t1=8000.0, observe="attractor")
    for name in ("kind", "periods", "period", "exponent", "transient"):
        np.testing.assert_array_equal(found[name], labels[name])
    for name in ("x1_min", "x1_max", "x2_min", "x2_max", "x1_strobe", "x2_strobe"):
        np.testing.assert_array_equal(found[name], unit * labels[name])


@pytest.mark.slow(first=True)
def test_basins_of_two_attractors():
    """At 1.68 a sticking motion of two periods and chaos: each start as a run of its own says."""
    osc = bernardo(1.68)
    x1, x2 = np.linspace(-1, 3, 7), np.linspace(-1.2, 1.2, 5)
    found = jb.basins(osc, x1=x1, x2=x2, t1=3000.0)
    assert found.attractors == ("2-periodic motion that sticks to belt 0", "chaotic motion")
    assert found.boundary is None and found.cycles[0].periods == 2
    for i, j in ((0, 4), (3, 2), (5, 1), (6, 0)):
        motion = jb.find_cycle(osc, (x1[i], x2[j]))
        is_periodic = int(found.label[i, j]) == 0
        assert (motion.status == Status.OK) == is_periodic
    table = found.table()
    assert list(table.attractor) == [*found.attractors, "undecided"]
    np.testing.assert_allclose(table.multiplier_0[0], found.cycles[0].multipliers[0].real)
    found.plot()
    box = (-1, 3), (-1.2, 1.2)
    shares = jb.basin_stability(osc, box=box, n=512, key=jax.random.key(0), t1=3000.0)
    assert 0.8 < shares.fractions["periodic"] < 0.95 and shares.fractions["stuck"] == 0
    with pytest.raises(ValueError, match="finite_time_stability"):
        found.finite_time_stability(10.0, 0.1)


@dataclasses.dataclass(frozen=True)
class Energy:
    """Work of friction and of damping, and the mean square of x1."""

    at = (jb.AtEvents(),)

    def init(self, osc, x1, x2):
        return jnp.zeros(())

    def rates(self, osc, motion):
        return jnp.sum(motion.forces) * motion.x2, motion.x2**2, motion.a * jnp.cos(motion.t)

    def update(self, state, event):
        return event.integrals[0]

    def finish(self, state, end):
        return dict(zip(("friction", "square", "cosine"), end.integrals, strict=True))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("velocity", [0.3, jb.Oscillating(0.3, 0.1, 1.2)])
@pytest.mark.parametrize("end", [9.0, 25.24, 26.0, 30.0])
def test_integrals_keep_the_balance_of_energy(velocity, end):
    """With a constant force beside the belts the work of friction and damping is known from the
    states at both ends; the cosine of the time enters by an integral by parts."""
    law = jb.Conti(1.0, 0.6, 10.0)
    load = jb.Oscillating(1.0, 0.3, 0.6)

    def make(damping):
        belts = jb.Belt(velocity, law, load), jb.Belt(0.1, jb.Coulomb(0.5, 0.4), 0.3, upper=0.9)
        return jb.Oscillator(damping, belts)

    run = jb.sweep(
        make, {"damping": [0.1]}, y0=(0.5, 0.1), t1=end, observe=Energy(), rtol=1e-10, atol=1e-10
    )
    last = jb.simulate(make(0.1), (0.5, 0.1), end, rtol=1e-11, atol=1e-11).ys[-1]
    gained = 0.5 * float(jnp.sum(last**2)) - 0.5 * (0.5**2 + 0.1**2)
    np.testing.assert_allclose(run.friction[0] - 0.1 * run.square[0], gained, atol=3e-8)


@dataclasses.dataclass(frozen=True)
class Square:
    """The integral of x1 squared."""

    at = (jb.AtEvents(),)

    def init(self, osc, x1, x2):
        return jnp.zeros(())

    def rates(self, osc, motion):
        return motion.x1**2

    def update(self, state, event):
        return event.integrals

    def finish(self, state, end):
        return {"square": end.integrals}


@pytest.mark.slow(first=True)
def test_integrals_where_a_stick_phase_ends_far_back_in_its_step():
    """Against samples of `simulate`, by the trapezoidal rule; the mass sticks for 0.035 at 25.2."""

    def make(amplitude):
        belt = jb.Belt(0.3, jb.Conti(1.0, 0.6, 10.0), 1.0)
        return jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(amplitude, 1.2, 0.3))

    tight = {"rtol": 1e-10, "atol": 1e-10}
    run = jb.sweep(make, {"amplitude": [1.0]}, y0=(0.5, 0.1), t1=30.0, observe=Square(), **tight)
    ts = np.linspace(0.0, 30.0, 60_001)
    x1 = np.asarray(jb.simulate(make(1.0), (0.5, 0.1), 30.0, ts=ts, **tight).ys)[:, 0]
    np.testing.assert_allclose(run.square[0], np.trapezoid(x1**2, ts), atol=1e-7)


@pytest.mark.parametrize(
    "observe, t1, message",
    [
        ("lyapunov", 100.0, "observe must be for oscillators that are forced"),
        ("exponent", 100.0, "observe must be"),
    ],
)
def test_what_is_for_forced_oscillators_only(observe, t1, message):
    def make(velocity):
        return jb.Oscillator(0.1, (jb.Belt(velocity, jb.Coulomb(1.0, 1.0), 1.0),))

    with pytest.raises(ValueError, match=message):
        jb.sweep(make, {"velocity": [0.1]}, t1=t1, observe=observe)


@pytest.mark.slow(first=True)
def test_pictures_and_shares_of_forced_sweeps(labels):
    """A picture of stick durations has those of periodic motions; shares are for loops."""
    lines = jb.plot_sweep(labels, "stick_duration").lines
    sticks = labels.stick_duration.values[:, 0]
    np.testing.assert_array_equal(lines[0].get_ydata(), sticks)
    assert np.sum(np.isfinite(sticks)) == 6
    with pytest.raises(ValueError, match="dataset must be of oscillators without a clock"):
        jb.attractors(labels.rename(frequency="x1"))


def test_an_exponent_needs_an_end_and_labels_no_audit():
    with pytest.raises(ValueError, match="t1 must be given"):
        jb.sweep(bernardo, {"frequency": [1.7]}, observe="lyapunov")
    with pytest.raises(ValueError, match="audit must be 0"):
        jb.sweep(bernardo, {"frequency": [1.7]}, observe="attractor", audit=0.5)
    with pytest.raises(ValueError, match="t0 must be"):
        jb.basins(jb.presets.class_b(0.3, 0.35), x1=[0.0], x2=[0.0], t0=1.0)


@pytest.mark.slow(first=True)
def test_what_has_not_settled_is_no_attractor():
    """A linear response that has not died away, one that grows beyond all bounds, with negative
    damping or at resonance, and a motion that leaves an unstable one, slowly."""

    def make(damping, amplitude, frequency, velocity, load, residual):
        belt = jb.Belt(velocity, jb.Conti(1.0, residual, 1.0), load)
        forcing = jb.Harmonic(amplitude, frequency)
        return jb.Oscillator(damping, (belt,), forcing=forcing)

    names = "damping", "amplitude", "frequency", "velocity", "load", "residual", "x1"
    rows = (
        (2e-5, 0.3, 2.0, 2.0, 1.0, 1.0, 1.5),
        (2e-5, 0.3, np.sqrt(2), 2.0, 1.0, 1.0, 1.5),
        (1e-6, 0.3, 2.0, 2.0, 1.0, 1.0, 1.5),
        (-0.001, 0.1, np.sqrt(2), 100.0, 1.0, 1.0, 1.0),
        (0.0, 1.0, 1.0, 0.0, 0.4, 1.0, 0.0),
        (0.0, 1.0, 1.0, 0.0, 0.75, 1.0, 1.0),
        (0.0998, 0.001, 1.5, 1.0, 1.0, 0.6, 0.8),
    )
    for row in rows:
        axes = {name: [value] for name, value in zip(names, row, strict=True)}
        found = jb.sweep(make, axes, y0=(0.8, 0.0), t1=3000.0, observe="attractor").squeeze()
        assert jb.decoded(found).kind == "undecided", row
        assert found.status == Status.NOT_SETTLED, row


@pytest.mark.slow(first=True)
def test_a_mass_that_swings_with_a_belt_wherever_it_stuck_to_it_has_no_attractor():
    """It slips once, and sticks from then on: each place to stick is as good as the next."""

    def make(amplitude):
        belt = jb.Belt(jb.Oscillating(0.0, amplitude, 1.0), jb.Coulomb(1.0, 1.0))
        return jb.Oscillator(0.1, (belt,))

    found = jb.sweep(make, {"amplitude": [0.1, 0.2]}, y0=(0.2, 0.5), t1=2000.0, observe="attractor")
    assert np.all(found.status == Status.NEUTRAL) and np.all(found.n_events == 1)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("t", [10.0, 400.0, 3e4])
def test_a_mass_that_a_belt_carries_has_no_extrema(t):
    """Rounding of the time makes its velocity vary; steps were cut to a thousandth there."""
    osc = in_own_units(bernardo(1.7))
    count, x2 = jnp.zeros(64, jnp.int32), jnp.full(64, 0.7)
    begun, steps, x1 = jnp.asarray(np.random.default_rng(1).uniform(0.1, 0.5, size=(3, 64)))
    lanes = timed_lanes_at_start(osc, count, x1, x2, 0, 1e-8, 0.0)
    seen = ForcedAttractor().start(osc, lanes)
    seen = dataclasses.replace(seen, repeats=dataclasses.replace(seen.repeats, n=count + 1))
    begun, ones = t + begun, jnp.ones(64)
    h = begun + steps - begun
    ends = (lanes.x1, x2, 0 * x2), (lanes.x1 + steps * x2, x2, 0 * x2)
    cut = ForcedAttractor()._cut(seen, Course.of_step(*ends, h), begun + steps, ones)
    np.testing.assert_array_equal(cut, 1.0)
    # Beside it the mass turns round in the middle of each step.
    ends = (lanes.x1, 0.1 * h, -0.2 + 0 * h), (lanes.x1, -0.1 * h, -0.2 + 0 * h)
    cut = ForcedAttractor()._cut(seen, Course.of_step(*ends, h), begun + steps, ones)
    np.testing.assert_allclose(cut, 0.5, atol=1e-3)


def weakly_forced(frequency, amplitude, damping=0.05):
    """A stick-slip cycle that is pushed."""
    law = jb.Conti(static=1.0, residual=0.6, steepness=10.0)
    forcing = jb.Harmonic(amplitude, frequency)
    return jb.Oscillator(damping, (jb.Belt(0.2, law),), forcing=forcing)


def maxima_of(osc, start, t0, t1):
    """Times of the maxima of x1 between t0 and t1, by a run of `simulate`."""
    ts = np.linspace(t0, t1, 1 + round(100 * (t1 - t0)))
    x2 = np.asarray(jb.simulate(osc, start, t1, ts=ts).ys[:, 1])
    before = np.flatnonzero((x2[:-1] > 0) & (x2[1:] <= 0))
    share = x2[before] / (x2[before] - x2[before + 1])
    return ts[before] + share * (ts[before + 1] - ts[before])


@pytest.mark.slow(first=True)
def test_winding_numbers_of_stick_slip_motions_that_are_pushed():
    """Hardly pushed, the mass moves as without forcing; locked to the force, it has a rational
    winding number, which is that of the motion; else the mean of the maxima is between bounds."""
    axes = {"frequency": [0.5, 1.141, 1.7], "amplitude": [1e-4, 0.02, 0.2]}
    found = jb.sweep(weakly_forced, axes, y0=(0.5, 0.1), t1=20_000.0, observe="attractor")
    kinds = jb.decoded(found).kind.values
    assert np.all(kinds[:, :2] == "quasiperiodic")
    assert np.all(found.status.values[:, :2] == Status.OK)
    pushed = weakly_forced(1.0, 1.0)
    alone = jb.find_cycle(jb.Oscillator(pushed.damping, pushed.belts), (0.5, 0.1))
    expected = 2 * np.pi / (np.asarray(axes["frequency"]) * float(alone.period))
    np.testing.assert_allclose(found.winding.values[:, 0], expected, rtol=1e-6)

    for row in range(3):
        osc = weakly_forced(axes["frequency"][row], 0.02)
        times = maxima_of(osc, (0.5, 0.1), 1000.0, 3000.0)
        k = np.arange(1, len(times))
        periods = (times[1:] - times[0]) / (2 * np.pi / axes["frequency"][row])
        low, high = np.max(np.floor(periods) / k), np.min(np.ceil(periods) / k)
        assert high - low < 1e-3 and low <= 1 / found.winding.values[row, 1] <= high


@pytest.mark.slow(first=True)
def test_a_mass_that_stops_at_its_maximum_has_one_maximum():
    """Where it comes to rest, x2 at the end of the step is zero up to rounding of either sign."""
    frequencies = np.linspace(0.3, 0.5, 5)
    found = jb.sweep(
        jb.presets.den_hartog,
        {"frequency": frequencies},
        y0=(0.0, 0.0),
        observe="attractor",
        progress=False,
    )
    np.testing.assert_array_equal(found.n_events, 4)  # it stops twice in a period
    np.testing.assert_array_equal(found.winding, 1.0)


@pytest.mark.slow(first=True)
def test_the_winding_number_of_a_periodic_motion_counts_its_maxima():
    """Also where one of them is at a strobe, before or behind it by rounding."""
    found = jb.sweep(
        weakly_forced,
        {"frequency": [0.8, 1.2, 2.6], "amplitude": [0.3, 0.35]},
        y0=(0.5, 0.1),
        observe="attractor",
    )
    seen = 0
    for at in np.ndindex(3, 2):
        row = found.isel(frequency=at[0], amplitude=at[1])
        if jb.decoded(row).kind != "periodic":
            continue
        seen += 1
        osc = weakly_forced(float(row.frequency), float(row.amplitude))
        motion = jb.find_cycle(osc, (0.5, 0.1))
        loops = len(maxima_of(osc, motion.starts[0], 0.0, float(motion.period)))
        np.testing.assert_allclose(row.winding * row.periods, loops, rtol=1e-12)
    assert seen >= 3

    def response(phase):
        """x1 is largest at t = 0, and x2 there is rounding."""
        law = jb.Coulomb(1.0, 1.0)
        forcing = jb.Harmonic(0.5, 2.0, phase)
        return jb.Oscillator(0.2, (jb.Belt(1.0, law, 0.0),), forcing=forcing)

    phases = np.arctan2(0.2 * 2.0, 1 - 2.0**2) + np.array([-1e-15, 0.0, 1e-15])
    row = jb.sweep(response, {"phase": phases}, y0=(0.0, 0.0), observe="attractor")
    np.testing.assert_array_equal(row.winding, 1.0)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("frequency", [0.25, 1.0])
@pytest.mark.parametrize("start", [2.0, 1.0])
def test_a_motion_that_has_lost_its_tangent_once_attracts_nothing(frequency, start):
    """Without damping and force a mass that stuck on its way comes to one of many circles."""

    def make(frequency):
        belt = jb.Belt(0.3, jb.Coulomb(1.0, 1.0), load=0.5)
        return jb.Oscillator(0.0, (belt,), forcing=jb.Harmonic(0.0, frequency))

    axes = {"frequency": [frequency]}
    found = jb.decoded(jb.sweep(make, axes, y0=(start, 0.0), t1=3000.0, observe="attractor"))
    assert found.kind[0] == "undecided" and found.status[0] == "neutral"


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("steepness", [2.0, 10.0, 100.0])
def test_a_cycle_that_slips_past_the_strobe_repeats_nothing(steepness):
    """A force of amplitude 0 whose period is nearly that of a cycle: the phase drifts, or stays
    where it began."""
    law = jb.Conti(1.0, 0.6, steepness)

    def make(frequency):
        return jb.Oscillator(0.5, (jb.Belt(0.1, law),), forcing=jb.Harmonic(0.0, frequency))

    cycle = jb.find_cycle(jb.Oscillator(0.5, (jb.Belt(0.1, law),)), (3.0, 0.0))
    frequencies = 2 * np.pi / float(cycle.period) * np.array([1.0, 1 + 1e-9, 1 + 1e-7])
    axes = {"frequency": frequencies}
    found = jb.decoded(jb.sweep(make, axes, y0=(0.9, 0.1), t1=5000.0, observe="attractor"))
    assert list(found.kind.values) == ["undecided"] * 3


def label_of(make, value, start):
    axes = {"damping": [value]}
    found = jb.sweep(make, axes, y0=tuple(start), t1=3000.0, observe="attractor")
    return str(jb.decoded(found).kind.values[0]), jb.Status(int(found.status[0]))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("edge, amplitude, frequency", [(0.0, 0.5, 1.25), (-np.inf, 0.3, 1.7)])
def test_what_turns_attracts_by_the_area_that_shrinks(edge, amplitude, frequency):
    """The belt outruns the mass, and damping alone changes areas; tangents turn, and are shorter
    now and then. So weak damping attracts, none is neutral, and a negative one leads away."""

    def make(damping):
        belt = jb.Belt(4.0, jb.Coulomb(1.0, 1.0), load=0.2, lower=edge)
        return jb.Oscillator(damping, (belt,), forcing=jb.Harmonic(amplitude, frequency))

    start = (-0.79, 0.0) if np.isfinite(edge) else (0.04, 0.0)
    for damping in (1e-2, 1e-4, 1e-5):
        motion = jb.periodic(make(damping), start)
        assert bool(motion.stable)
        assert label_of(make, damping, motion.start) == ("periodic", Status.OK)
    start = jb.periodic(make(0.0), start).start
    assert label_of(make, 0.0, start) == ("undecided", Status.NEUTRAL)
    for damping in (-1e-5, -1e-3):
        motion = jb.periodic(make(damping), start)
        assert label_of(make, damping, motion.start)[0] == "undecided"
