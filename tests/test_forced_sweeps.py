"""Sweeps of forced oscillators, against the engine of `campaign/forced.py`."""

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


def test_final_states_are_those_of_the_engine(swept):
    for i, amplitude in enumerate(swept.amplitude.values):
        for j, frequency in enumerate(swept.frequency.values):
            run = _engine(float(amplitude), float(frequency), (0.5, 0.0), 60.0)
            one = swept.isel(amplitude=i, frequency=j)
            assert int(one.n_events) == len(run.t) and int(one.status) == jb.Status.OK
            assert tuple(one.mode_end.values.tolist()) == run.mode_end
            # Motions near the onset of sliding grow errors of 1e-8 a hundredfold in this time.
            assert np.allclose([one.x1_end, one.x2_end], run.y_end, rtol=0, atol=1e-6)


def test_shift_by_a_period_changes_nothing(swept):
    period = 2 * np.pi / 1.7
    axes = {"amplitude": swept.amplitude.values, "frequency": np.array([1.7, 1.7, 1.7])}
    later = jb.sweep(
        _cubic, axes, y0=(0.5, 0.0), t0=3 * period, t1=60.0 + 3 * period, progress=False
    )
    here = swept.sel(frequency=1.7)
    assert np.array_equal(later.n_events.values[:, 0], here.n_events.values)
    assert np.allclose(later.x1_end.values[:, 0], here.x1_end.values, rtol=0, atol=1e-6)


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
