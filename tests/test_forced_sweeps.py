"""Sweeps of forced oscillators, against the engine of `campaign/forced.py`."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb
from tests.campaign import forced


def _cubic(amplitude, frequency):
    """The oscillator of di Bernardo, Kowalczyk and Nordmark (2003)."""
    belt = jb.Belt(1.0, jb.Cubic(1.5, 1.5, 0.45))
    return jb.Oscillator(0.0, (belt,), forcing=jb.Harmonic(amplitude, frequency))


def _engine(amplitude, frequency, y0, t1):
    belt = forced.Belt(1.0, ("cubic", 1.5, 1.5, 0.45))
    osc = forced.Oscillator(0.0, (belt,), (forced.Harmonic(amplitude, frequency),))
    return forced.simulate(osc, y0, t1)


@pytest.fixture(scope="module")
def swept():
    axes = {"amplitude": np.array([0.05, 0.1, 0.3]), "frequency": np.array([1.6, 1.7, 1.8])}
    return jb.sweep(_cubic, axes, y0=(0.5, 0.0), t1=60.0, progress=False)


@pytest.mark.slow(first=True)
def test_final_states_are_those_of_the_engine(swept):
    for i, amplitude in enumerate(swept.amplitude.values):
        for j, frequency in enumerate(swept.frequency.values):
            run = _engine(float(amplitude), float(frequency), (0.5, 0.0), 60.0)
            one = swept.isel(amplitude=i, frequency=j)
            assert int(one.n_events) == len(run.t) and int(one.status) == jb.Status.OK
            assert tuple(one.mode_end.values.tolist()) == run.mode_end
            # Motions near the onset of sliding grow errors of 1e-8 a hundredfold in this time.
            assert np.allclose([one.x1_end, one.x2_end], run.y_end, rtol=0, atol=1e-6)


@pytest.mark.slow(first=True)
def test_shift_by_a_period_changes_nothing(swept):
    period = 2 * np.pi / 1.7
    axes = {"amplitude": swept.amplitude.values, "frequency": np.array([1.7, 1.7, 1.7])}
    later = jb.sweep(
        _cubic, axes, y0=(0.5, 0.0), t0=3 * period, t1=60.0 + 3 * period, progress=False
    )
    here = swept.sel(frequency=1.7)
    assert np.array_equal(later.n_events.values[:, 0], here.n_events.values)
    assert np.allclose(later.x1_end.values[:, 0], here.x1_end.values, rtol=0, atol=1e-6)


@pytest.mark.slow(first=True)
def test_an_axis_may_begin_with_the_frequency_0():
    """Where it is known to be 0 the force is a constant one, without a clock."""
    frequency = np.array([0.0, 1.7])

    def swept(values):
        axes = {"w": values}
        return jb.sweep(lambda w: _cubic(0.1, w), axes, y0=(0.5, 0.0), t1=10.0, progress=False)

    made = swept(frequency)
    for w, x1, x2 in zip(frequency, made.x1_end.values, made.x2_end.values, strict=True):
        alone = jb.simulate(_cubic(0.1, float(w)), (0.5, 0.0), 10.0, ts=[10.0])
        np.testing.assert_allclose((x1, x2), alone.ys[0], rtol=0, atol=1e-7)
    with pytest.raises(ValueError, match=r"^axes must be .* not 0 everywhere"):
        swept(frequency[:1])


@pytest.mark.parametrize(
    "options, message",
    [
        (dict(derivatives=("frequency",)), "derivatives"),
        (dict(t0=100.0), "t0"),
        (dict(audit=0.1, observe="nothing"), "observe"),
    ],
)
def test_what_is_impossible_is_refused(options, message):
    axes = {"amplitude": np.array([0.1]), "frequency": np.array([1.7])}
    with pytest.raises(ValueError, match=message):
        jb.sweep(_cubic, axes, t1=60.0, progress=False, **options)


def test_a_start_time_is_for_those_that_know_the_time():
    with pytest.raises(ValueError, match="t0"):
        jb.sweep(jb.presets.class_a, {"nu0": np.array([0.2])}, t0=1.0, t1=10.0)


# --- moments --------------------------------------------------------------------------------------


class Rows:
    """Time, state and number of every moment, in their order."""

    def __init__(self, at, room=40):
        self.at, self.room = at, room

    def init(self, osc, x1, x2):
        return jnp.full((self.room, 4), jnp.nan), jnp.zeros((), int)

    def update(self, state, event):
        rows, count = state
        row = jnp.stack([event.t, event.x1, event.x2, event.moment.astype(float)])
        return jnp.where((jnp.arange(self.room) == count)[:, None], row[None], rows), count + 1

    def finish(self, state, end):
        return {"rows": state[0].reshape(-1), "moments": state[1]}


def _two_belts(amplitude, frequency):
    first = jb.Belt(0.4, jb.Coulomb(1.0, 0.6))
    second = jb.Belt(0.8, jb.Coulomb(0.5, 0.5), 0.5, lower=0.2)
    return jb.Oscillator(0.05, (first, second), forcing=jb.Harmonic(amplitude, frequency))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("t0", [0.0, 2.0])
def test_moments_are_those_of_a_run_that_is_sampled(t0):
    times = (0.0, 1.0, 2.5, 7.0)
    section = jb.AtSection(lambda osc, x1, x2: x1 - 0.3)
    at = (jb.AtPhase(0.5), jb.AtExtrema("x1"), section, jb.AtTimes(times))
    axes = {"amplitude": np.array([0.3, 1.0, 1.5]), "frequency": np.array([0.5, 1.0, 1.7])}
    options = dict(y0=(1.0, 0.0), t0=t0, t1=20.0, rtol=1e-10, atol=1e-10)
    swept = jb.sweep(_two_belts, axes, observe=Rows(at), progress=False, **options)
    even = np.linspace(t0, 20.0, 20_001)
    for amplitude in axes["amplitude"]:
        for frequency in axes["frequency"]:
            one = swept.sel(amplitude=amplitude, frequency=frequency)
            assert int(one.status) == jb.Status.OK
            rows = one.rows.values.reshape(-1, 4)[: int(one.moments)]
            t, number = rows[:, 0], rows[:, 3]
            assert np.all(np.diff(t) >= 0)
            osc = _two_belts(amplitude, frequency)
            ts, places = np.unique(np.concatenate([t, even]), return_inverse=True)
            run = jb.simulate(osc, (1.0, 0.0), 20.0, t0=t0, ts=ts)
            states = np.asarray(run.ys)[places]
            np.testing.assert_allclose(states[: len(t)], rows[:, 1:3], atol=1e-8)
            x1, x2 = states[len(t) :].T
            phases = (0.5 + 2 * np.pi * np.arange(20)) / frequency
            np.testing.assert_allclose(t[number == 0], phases[(phases >= t0) & (phases <= 20.0)])
            # It begins at an extremum, which is none that it comes to.
            assert np.sum(number == 1) == np.sum(np.diff(np.sign(x2[1:])) != 0)
            assert np.sum(number == 2) == np.sum(np.diff(np.sign(x1 - 0.3)) != 0)
            assert t[number == 3].tolist() == [one for one in times if one >= t0]


@pytest.mark.slow(first=True)
def test_both_attractors_as_the_frequency_rises_and_falls():
    """The sticking motion of two periods ends in the fold at 1.68344; chaos is there below, too."""
    make = jb.presets.di_bernardo
    found = jb.orbit_diagram(make, span=(1.675, 1.695), y0=(0.5, 0.0), rows=5, sense="both")
    up, down = found.kind.T
    chaos = "no period found"
    assert up.tolist() == ["cycle", "cycle", chaos, chaos, chaos]
    assert down.tolist() == [chaos] * 5
    periods = 2 * 2 * np.pi / found.values[:2]
    assert found.period[:2, 0] == pytest.approx(periods, rel=1e-12)
    motion = jb.find_cycle(make(1.68), (0.5, 0.0))
    points = found.x1[1, 0][~np.isnan(found.x1[1, 0])]
    assert np.sort(points) == pytest.approx(np.sort(np.asarray(motion.starts)[:, 0]), abs=1e-6)


@pytest.mark.slow(first=True)
def test_an_orbit_diagram_has_the_periods_of_find_cycle():
    diagram = jb.orbit_diagram(jb.presets.di_bernardo, span=(1.67, 1.75), y0=(0.5, 0.0), rows=9)
    for value, kind, period, x1 in zip(*(diagram.values, diagram.kind, diagram.period, diagram.x1)):
        motion = jb.find_cycle(jb.presets.di_bernardo(value), (0.5, 0.0))
        if int(motion.status) != jb.Status.OK:
            assert kind[0] == "no period found"
            continue
        assert kind[0] == "cycle" and period[0] == pytest.approx(float(motion.period))
        points = np.sort(x1[0][np.isfinite(x1[0])])
        np.testing.assert_allclose(points, np.sort(motion.starts[:, 0]), atol=1e-5)
    assert {"cycle", "no period found"} == set(diagram.kind.ravel().tolist())


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("x2", [-9.184850993605148e-17, 0.0, -1e-12])
def test_a_mass_on_an_edge_that_a_belt_just_begins_to_carry(x2):
    """The belt is at rest at t = 0 up to rounding, as cos(3 pi / 2) is, and the other belt touches
    behind the edge. Such a run stood still there, and ended with TOO_MANY_STEPS."""
    phase = 4.71238898038469

    def make(damping):
        swings = jb.Belt(jb.Oscillating(0.0, 0.5, 0.5, phase), jb.Coulomb(0.8, 0.4), upper=0.0)
        rests = jb.Belt(0.0, jb.Coulomb(0.8, 0.4), lower=-0.5)
        forces = (jb.Harmonic(0.8, 0.5, np.pi / 2), jb.Harmonic(1.6, 0.5, phase))
        return jb.Oscillator(damping, (swings, rests), forcing=forces)

    found = jb.sweep(make, {"damping": [0.1]}, y0=(-0.5, x2), t1=1.0, observe="final")
    assert found.status[0] == jb.Status.OK
    # The belt carries it: x2 = sin(t / 2) / 2.
    np.testing.assert_allclose(found.x1_end[0], -0.5 + 1 - np.cos(0.5), atol=1e-10)
    np.testing.assert_allclose(found.x2_end[0], 0.5 * np.sin(0.5), atol=1e-10)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("load", "velocity", "edge", "force", "start"),
    [
        (0.0, (0.5, 0.5, np.pi), -1.2, 1.0, (0.0, 0.0)),
        (0.0, (0.0, 1.0, 1.5 * np.pi), -0.5, 1.6, (-0.5, -1.8369701987210297e-16)),
        (1e-3, (0.5, 0.5, np.pi), -1.2, 1.0, (0.0, 0.0)),
        (1e-3, (0.5, 0.5, np.pi), -1.2, -1.0, (0.0, 0.0)),
    ],
)
def test_a_mass_and_a_belt_that_begin_to_move_together(load, velocity, edge, force, start):
    """Belt and force begin like sin(t / 2): the relative velocity vanishes with its slope at the
    start. Such a run stood still there, and ended with TOO_MANY_STEPS."""
    mean, amplitude, phase = velocity

    def make(damping):
        wave = jb.Oscillating(mean, amplitude, 0.5, phase)
        belt = jb.Belt(wave, jb.Conti(1.0, 0.6, 10.0), load, lower=edge)
        return jb.Oscillator(damping, (belt,), forcing=jb.Harmonic(force, 0.5, 1.5 * np.pi))

    found = jb.sweep(make, {"damping": [1.0]}, y0=start, t1=60.0, observe="final")
    run = jb.simulate(make(1.0), start, 60.0)
    assert found.status[0] == run.status == jb.Status.OK
    np.testing.assert_allclose([found.x1_end[0], found.x2_end[0]], run.ys[-1], atol=1e-7)
    assert found.n_events[0] == np.sum(np.asarray(run.events.kind) > 0)


def _on_moving_base(frequency=0.9, damping=0.2, amplitude=0.4):
    belt = jb.Belt(0.15, jb.Coulomb(0.5, 0.3))
    return jb.Oscillator(damping, (belt,), forcing=jb.BaseMotion(amplitude, frequency))


def _with_equal_force(frequency=0.9, damping=0.2, amplitude=0.4):
    turn = damping * frequency
    belt = jb.Belt(0.15, jb.Coulomb(0.5, 0.3))
    force = jb.Harmonic(amplitude * jnp.sqrt(1 + turn**2), frequency, jnp.arctan2(turn, 1.0))
    return jb.Oscillator(damping, (belt,), forcing=force)


@pytest.mark.slow
@pytest.mark.parametrize("names", [("frequency",), ("damping",), ("frequency", "amplitude")])
def test_a_base_motion_is_swept_as_the_force_that_it_equals(names):
    """XLA left out the phase of the force from programs that store whole states."""
    values = {"frequency": [0.7, 0.9], "damping": [0.2, 0.25], "amplitude": [0.38, 0.4]}
    axes, options = {name: values[name] for name in names}, dict(y0=(1.0, 0.2), progress=False)
    one = jb.sweep(_on_moving_base, axes, observe="attractor", **options)
    other = jb.sweep(_with_equal_force, axes, observe="attractor", **options)
    for name in ("x1_min", "x1_max", "x2_max", "stick_duration"):
        np.testing.assert_allclose(one[name].values, other[name].values, rtol=0, atol=1e-5)
    last = {name: values[name][-1] for name in names}
    motion = jb.find_cycle(_on_moving_base(**last), (1.0, 0.2))
    assert one.x1_max.values.ravel()[-1] == pytest.approx(float(motion.x1_max), abs=1e-5)


@pytest.mark.slow(first=True)
def test_starts_are_swept_with_forcing_and_a_contact_edge():
    law = jb.Coulomb(0.5, 0.3)
    belts = jb.Belt(0.15, law), jb.Belt(-0.1, law, lower=0.1)
    osc = jb.Oscillator(0.2, belts, forcing=jb.Harmonic(0.4, 0.9))
    swept = jb.sweep(lambda: osc, {"x1": [0.0, 1.0]}, y0=(1.0, 0.2), t1=5.0, progress=False)
    for x1, end in zip((0.0, 1.0), swept.x1_end.values, strict=True):
        run = jb.simulate(osc, (x1, 0.2), 5.0)
        assert end == pytest.approx(float(run.ys[-1, 0]), abs=1e-7)
