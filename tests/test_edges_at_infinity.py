"""Derivatives where contact edges are at infinity: those of a `Machine`, and of edges like inf/L.

The oracle is in the dimensionless numbers of a machine that are written down here, by hand.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest

import jaxbelt as jb

MASS, STIFFNESS, DAMPING, SPAN = 0.5, 2000.0, 1.0, 30.0
#: Normal force and stiffness.
AT = jnp.array([5.0, STIFFNESS])


def machine(p, V=0.02):
    """The second belt presses with a fifth of the largest force."""
    laws = jb.Conti(0.4, 0.25, 100.0), jb.Conti(0.3, 0.2, 50.0)
    slow, fast = jb.PhysicalBelt(V, laws[0], p[0]), jb.PhysicalBelt(0.09, laws[1], 1.0)
    return jb.Machine(MASS, p[1], DAMPING, (slow, fast))


def by_hand(p, V=0.02):
    """The same with speeds in units of N / sqrt(k m), in the oracle."""
    N, k = map(float, p)
    root = np.sqrt(k * MASS)
    speed = N / root
    slow = oracle.Belt(V / speed, *oracle.conti(0.4, 0.25, 100.0 * speed), 1.0)
    fast = oracle.Belt(0.09 / speed, *oracle.conti(0.3, 0.2, 50.0 * speed), 1.0 / N)
    return oracle.Oscillator(DAMPING / root, (slow, fast))


def directly(p):
    """The same, with edges that a user might write; that of the second belt is a finite one."""
    speed = p[0] / jnp.sqrt(p[1] * MASS)
    length = p[0] / p[1]
    slow = jb.Conti(0.4, 0.25, 100.0 * speed)
    fast = jb.Conti(0.3, 0.2, 50.0 * speed)
    belts = (
        jb.Belt(0.02 / speed, slow, 1.0, -jnp.inf / length, jnp.inf / length),
        jb.Belt(0.09 / speed, fast, 1.0 / p[0], upper=100.0 / length),
    )
    return jb.Oscillator(DAMPING / jnp.sqrt(p[1] * MASS), belts)


def by_differences(of):
    """The derivatives by the normal force and the stiffness, of a function of both."""

    def along(i):
        def at(value):
            return of(np.where(np.arange(2) == i, value, np.asarray(AT)))

        value, error = oracle.richardson(at, float(AT[i]), 1e-3 * float(AT[i]))
        assert error < 1e-7 * max(1.0, abs(value))
        return value

    return np.array([along(0), along(1)])


def end(p, make=lambda p: machine(p).oscillator):
    return jb.simulate(make(p), (1.2, 0.0), SPAN, ts=jnp.array([0.0, SPAN])).ys[-1, 0]


@pytest.fixture(scope="module")
def slopes_of_end():
    return by_differences(lambda p: oracle.simulate(by_hand(p), (1.2, 0.0), SPAN).y_end[0])


# Tolerances of 1e-10 a step, and differences good to 1e-7.
TOLERANCE = 1e-6


@pytest.mark.slow(first=True)
def test_of_a_run(slopes_of_end):
    assert jax.grad(end)(AT) == pytest.approx(slopes_of_end, rel=TOLERANCE)


@pytest.mark.slow
def test_of_batches_of_runs(slopes_of_end):
    batch = jnp.stack([AT, 1.01 * AT])
    for derivative in (jax.grad(end), jax.jacfwd(end)):
        rows = jax.jit(jax.vmap(derivative))(batch)
        assert np.all(np.isfinite(rows))
        assert rows[0] == pytest.approx(slopes_of_end, rel=TOLERANCE)


@pytest.mark.slow
def test_of_a_run_with_edges_that_are_divided(slopes_of_end):
    """Reverse mode where the edges are known, as they are outside of jit; forward everywhere."""

    def of(p):
        return end(p, directly)

    assert jax.grad(of)(AT) == pytest.approx(slopes_of_end, rel=TOLERANCE)
    assert jax.jit(jax.jacfwd(of))(AT) == pytest.approx(slopes_of_end, rel=TOLERANCE)


@pytest.mark.slow(first=True)
def test_of_the_edges_of_a_machine():
    def edges(p):
        belt = jb.PhysicalBelt(0.1, jb.Coulomb(0.4, 0.3), p[0], upper=0.004)
        belt = jb.Machine(MASS, p[1], DAMPING, (belt,)).oscillator.belts[0]
        return jnp.stack([belt.lower, belt.upper])

    # Its unit of length is N/k.
    for derivative in (jax.jacfwd(edges), jax.jacrev(edges), jax.jit(jax.jacrev(edges))):
        expected = [[0.0, 0.0], [-0.004 * 2000 / 25, 0.004 / 5]]
        assert np.allclose(derivative(AT), expected, rtol=1e-14, atol=0)


def test_of_a_machine_that_is_itself_traced():
    """Its edges are unknown then, and may be anything; and there and back again."""

    def edges(m):
        there = m.oscillator
        return jnp.stack([there.belts[0].lower, m.of_oscillator(there).belts[1].upper])

    upside = jax.tree.map(jnp.zeros_like, machine(AT))
    for of in (edges, jax.jit(edges)):
        found = jax.jacrev(of)(machine(AT))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))
    _, moved = jax.jvp(edges, (machine(AT),), (jax.tree.map(jnp.ones_like, upside),))
    assert np.all(np.isfinite(moved))


def test_of_edges_that_are_divided():
    """As above, of the edges alone."""

    def edges(L):
        belt = jb.Belt(0.1, jb.Coulomb(0.4, 0.3), 1.0, -jnp.inf / L, 2.0 / L)
        return jnp.stack([belt.lower, belt.upper])

    assert np.allclose(jax.jacrev(edges)(2.0), [0.0, -0.5], rtol=1e-14, atol=0)
    assert np.allclose(jax.jit(jax.jacfwd(edges))(2.0), [0.0, -0.5], rtol=1e-14, atol=0)
    found = jax.vmap(jax.jacfwd(edges))(jnp.array([2.0]))
    assert np.allclose(found, [[0.0, -0.5]], rtol=1e-14, atol=0)


@pytest.mark.slow
def test_of_a_cycle():
    def period(p):
        return jb.find_cycle(machine(p).oscillator, (1.2, 0.0)).period

    expected = by_differences(lambda p: oracle_cycles.sticking_cycle(by_hand(p), (1.2, 0.0)).period)
    assert jax.grad(period)(AT) == pytest.approx(expected, rel=TOLERANCE)
    assert jax.jacfwd(period)(AT) == pytest.approx(expected, rel=TOLERANCE)
    rows = jax.vmap(jax.grad(period))(jnp.stack([AT, 1.01 * AT]))
    assert rows[0] == pytest.approx(expected, rel=TOLERANCE) and np.all(np.isfinite(rows))


@pytest.mark.slow
def test_of_a_nonsmooth_fold():
    """By V, the velocity of the first belt in m/s."""

    def fold(p, at=0.095):
        point = jb.refine(jb.NonsmoothFold(0), lambda V: machine(p, V).oscillator, at=at)
        return point.value

    def theirs(p):
        bracket = 0.9 * float(ours), 1.1 * float(ours)
        return oracle_cycles.nonsmooth_fold(lambda V: by_hand(p, V), bracket, 0)

    ours = fold(AT)
    assert float(ours) == pytest.approx(theirs(AT), rel=1e-9)
    expected = by_differences(theirs)
    near = functools.partial(fold, at=1.02 * float(ours))
    assert jax.grad(near)(AT) == pytest.approx(expected, rel=TOLERANCE)
    rows = jax.jit(jax.vmap(jax.jacfwd(near)))(AT[None])
    assert rows[0] == pytest.approx(expected, rel=TOLERANCE)
