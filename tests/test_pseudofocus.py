"""Forced masses at an edge that pushes back from both sides, against the engine of
`campaign/forced.py`, which follows the loops on."""

import numpy as np
import pytest

import jaxbelt as jb
from tests.campaign import forced

EDGE = 0.5


def osc(force, frequency, damping=0.3, friction=1.0, unit=1.0, way=1.0, phase=0.0):
    """On the left friction pushes to the edge, on the right the spring does."""
    edge = dict(upper=EDGE * unit) if way > 0 else dict(lower=-EDGE * unit)
    belt = jb.Belt(way * unit, jb.Coulomb(1.0, friction), load=unit, **edge)
    return jb.Oscillator(damping, (belt,), forcing=jb.Harmonic(force * unit, frequency, phase))


def engine(force, frequency, damping=0.3, friction=1.0):
    belt = forced.Belt(1.0, ("coulomb", 1.0, friction), 1.0, upper=EDGE)
    one = forced.Oscillator(damping, (belt,), (forced.Harmonic(force, frequency),))
    return forced.simulate(one, (1.0, 0.3), 400.0, max_events=30_000)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("case", "rests"),
    [
        ((0.45, 0.7), True),  # of 0.5, at which it would be pushed away
        ((0.45, 0.1), True),
        ((0.02, 0.7, 0.1, 0.8), True),
        ((0.45, 2.0), False),  # it bounces on
        ((0.25, 5.0, 0.05, 0.8), False),
        ((0.02, 0.7, 0.0, 1.0), False),  # loops do not shrink
        ((0.55, 0.7), False),  # chaos
    ],
)
def test_a_forced_mass_comes_to_rest_where_loops_shrink(case, rests):
    run, loops = jb.simulate(osc(*case), (1.0, 0.3), 400.0, ts=[400.0]), engine(*case)
    assert (run.status == jb.Status.PSEUDO_FOCUS) == rests
    n = run.events.t.size
    if not rests:
        assert run.status == jb.Status.OK
        np.testing.assert_allclose(run.events.t[:60], loops.t[:60], rtol=0, atol=1e-6)
        return
    np.testing.assert_array_equal(run.ys[0], (EDGE, 0.0))
    force, *numbers = case
    swept = jb.sweep(
        lambda force: osc(force, *numbers), {"force": [force]}, y0=(1.0, 0.3), t1=400.0
    )
    assert swept.status.item() == run.status and swept.n_events.item() == n
    np.testing.assert_array_equal(swept.mode_end[0], run.modes[-1])
    np.testing.assert_allclose(run.events.t, loops.t[:n], rtol=0, atol=1e-7)
    speeds = np.abs(loops.y[n - 1 :, 1])
    # It goes up and down with the force by the cube root of how much both pushes vary, and shrinks.
    assert np.max(speeds) < 1.5 * speeds[0] and speeds[-1] < 0.1 * speeds[0]
    # Own units are powers of two, so that the loop at which it is known may be another one.
    other = jb.simulate(osc(*case, unit=1e3), (1e3, 300.0), 400.0)
    shared = min(n, other.events.t.size)
    assert other.status == run.status and shared > n / 2
    np.testing.assert_allclose(other.events.t[:shared], run.events.t[:shared], rtol=0, atol=1e-7)
    mirror = jb.simulate(osc(*case, way=-1.0, phase=np.pi), (-1.0, -0.3), 400.0)
    assert mirror.status == run.status and mirror.events.t.size == n


@pytest.mark.slow
def test_no_periodic_motion_is_found_where_the_mass_comes_to_rest():
    found = jb.find_cycle(osc(0.1, 1.3), (0.6, 0.0))
    assert found.status == jb.Status.PSEUDO_FOCUS


@pytest.mark.slow
def test_labels_of_forced_masses_that_rest_on_an_edge():
    axes = {"force": np.array([0.1, 0.45, 0.55]), "x1": np.array([1.0, EDGE])}
    swept = jb.sweep(
        lambda force: osc(force, 0.7),
        axes,
        y0=(1.0, 0.0),
        t1=400.0,
        observe="attractor",
        progress=False,
    )
    labels = jb.decoded(swept)
    assert np.all(labels.kind[:2] == "equilibrium") and np.all(labels.kind[2] == "chaotic")
    assert np.all(swept.x1_max[:2] == EDGE) and np.all(swept.x1_min[:2] == EDGE)
    assert np.all(swept.transient[:2, 1] == 0.0) and np.all(swept.transient[:2, 0] > 10.0)


@pytest.mark.slow(first=True)
def test_a_force_as_large_as_what_pushes_back_holds_nothing():
    """0.7 * 0.8 is less than 0.56 by rounding."""

    def make(force):
        law = jb.Coulomb(1.0, 0.8)
        belts = jb.Belt(5.0, law, 0.7, upper=0.0), jb.Belt(-5.0, law, 0.7, lower=0.0)
        return jb.Oscillator(1.0, belts, forcing=jb.Harmonic(force, 1.0))

    runs = [jb.simulate(make(force), (2.0, 0.0), 3.0, ts=[3.0]) for force in (0.5599, 0.56, 0.5601)]
    assert [int(run.status) for run in runs] == [jb.Status.OK] * 3
    below, at, above = (np.asarray(run.ys[0]) for run in runs)
    np.testing.assert_allclose(at, 0.5 * (below + above), rtol=0, atol=1e-7)
    np.testing.assert_allclose(at, (-0.54434949, -0.16893665), rtol=0, atol=1e-7)
