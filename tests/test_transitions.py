"""Derivatives past contact edges of several belts at one place: each edge moves by itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb

EDGES = jnp.array([0.3, 0.3])


def halves(edges, forcing=()):
    """A belt that is cut in two, which end at one place."""
    belts = tuple(jb.Belt(0.4, jb.Coulomb(1.0, 1.0), load=0.5, upper=edge) for edge in edges)
    return jb.Oscillator(0.1, belts, forcing=forcing)


def follows(edges, forcing=()):
    """A belt that begins where the other one ends, as in class (c)."""
    (first, second), law = edges, jb.Coulomb(1.0, 1.0)
    belts = jb.Belt(0.4, law, upper=first), jb.Belt(-0.3, law, load=0.5, lower=second)
    return jb.Oscillator(0.1, belts, forcing=forcing)


def beside_another(edges, forcing=()):
    """The mass never sticks to two fast belts, one of which begins where the other one ends."""
    (first, second), law = edges, jb.Conti(1.0, 0.6, 10.0)
    fast = jb.Belt(3.0, law, load=0.1, upper=first), jb.Belt(-3.0, law, load=0.2, lower=second)
    return jb.Oscillator(0.1, (jb.Belt(0.4, law), *fast), forcing=forcing)


def slopes_on_both_sides(function, edges, h):
    """Differences by each edge, from above and from below, extrapolated, [sides, .., edges]."""

    def slope(step):
        columns = [(function(edges + one) - function(edges)) / jnp.sum(one) for one in step]
        return np.stack(columns, axis=-1)

    return np.stack(
        [2 * slope(jnp.eye(2) * way * h) - slope(jnp.eye(2) * way * 2 * h) for way in (1, -1)]
    )


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("make", "forcing"),
    [
        (halves, ()),
        (follows, ()),
        (follows, jb.Harmonic(0.5, 1.3)),
    ],
)
def test_a_run_past_edges_at_one_place(make, forcing):
    def end(edges):
        return jb.simulate(make(edges, forcing), (3.0, 0.0), 5.0, ts=[5.0]).ys[-1]

    forwards, backwards = jax.jacfwd(end)(EDGES), jax.jacrev(end)(EDGES)
    np.testing.assert_allclose(forwards, backwards, rtol=0, atol=1e-12)
    for right in slopes_on_both_sides(end, EDGES, 1e-5):
        np.testing.assert_allclose(forwards, right, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_a_sweep_past_edges_at_one_place():
    axes = {"first": np.array([0.299, 0.3, 0.301])}
    swept = jb.sweep(
        lambda first: follows((first, 0.3)),
        axes,
        y0=(3.0, 0.0),
        t1=5.0,
        derivatives=("first",),
        progress=False,
    )
    for found in (swept.d_x1_end_d_first.values, swept.d_x2_end_d_first.values):
        assert found[1] == pytest.approx(0.5 * (found[0] + found[2]), abs=1e-5)


@pytest.mark.slow(first=True)
def test_a_cycle_that_slips_on_where_its_belt_ends_and_another_one_begins():
    """Both sides differ: where both belts touch the mass it is stuck until the first one ends."""
    law = jb.Conti(1.0, 0.6, 10.0)

    def make(edges):
        belts = jb.Belt(0.4, law, upper=edges[0]), jb.Belt(-0.3, law, lower=edges[1])
        return jb.Oscillator(0.1, belts)

    def numbers(edges):
        cycle = jb.find_cycle(make(edges), (3.0, 0.0))
        return jnp.stack([cycle.period, cycle.x1_max])

    found, h = jax.jacfwd(numbers)(EDGES), 1e-5
    both = EDGES + jnp.array([h, -h])
    for i, way in ((0, 1), (1, -1)):
        one = jnp.zeros(2).at[i].set(way * h)
        right = way * (numbers(both + one) - numbers(both)) / h
        np.testing.assert_allclose(found[:, i], right, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    "forcing",
    [
        pytest.param((), marks=pytest.mark.slow(first=True)),
        pytest.param(jb.Harmonic(1.5, 0.8), marks=pytest.mark.slow),
    ],
)
def test_a_periodic_motion_past_edges_at_one_place(forcing):

    def numbers(edges):
        cycle = jb.find_cycle(beside_another(edges, forcing), (1.0, 0.0))
        return jnp.stack([cycle.x1_max, cycle.x1_min, cycle.x2_min])

    cycle = jb.find_cycle(beside_another(EDGES, forcing), (1.0, 0.0))
    assert jb.EventKind.EDGE in [kind for kind, _ in cycle.signature]
    found = jax.jacfwd(numbers)(EDGES)
    for right in slopes_on_both_sides(numbers, EDGES, 1e-5):
        np.testing.assert_allclose(found, right, rtol=0, atol=1e-6)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("swapped", [False, True])
def test_a_forced_run_that_slips_on_where_its_belt_ends(swapped):
    """While both belts touch the mass it stays stuck, so that the edge of its own belt counts."""
    law = jb.Coulomb(1.0, 0.8)

    def end(edges):
        belts = jb.Belt(0.4, law, 0.1, lower=edges[1]), jb.Belt(-0.3, law, 2.0, lower=edges[0])
        osc = jb.Oscillator(0.1, belts[:: -1 if swapped else 1], forcing=jb.Harmonic(0.4, 1.3))
        return jb.simulate(osc, (0.0, -0.3), 2.5, ts=[2.5]).ys[-1]

    found, h = jax.jacfwd(end)(-EDGES - 0.2), 1e-6
    for i, way in ((0, -1), (1, 1)):
        one = jnp.zeros(2).at[i].set(way * h)
        right = way * (end(-EDGES - 0.2 + one) - end(-EDGES - 0.2)) / h
        np.testing.assert_allclose(found[:, i], right, rtol=0, atol=1e-4)
