"""How long bifurcation points take: `pytest tests/benchmarks --benchmark-only`. Asserts no time.

The point is the nonsmooth fold on belt 1 of class (b), nu1 = 0.35, from a guess 0.02 away.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxbelt as jb
from tests.where import nu0

EXACT = 0.538734800481
NU1 = 0.35


def test_one_fold(benchmark):
    """As a user calls it."""
    guess = jb.presets.class_b(EXACT - 0.02, NU1)
    point = benchmark(
        lambda: jax.block_until_ready(jb.refine(jb.NonsmoothFold(1), guess, where=nu0))
    )
    assert point.value == pytest.approx(EXACT, abs=1e-11)


def test_a_thousand_folds(benchmark):
    """A curve nu0(nu1) of them in one call."""

    @jax.jit
    @jax.vmap
    def fold(nu1):
        osc = jb.presets.class_b(EXACT - 2.4 * (nu1 - NU1), nu1)
        return jb.refine(jb.NonsmoothFold(1), osc, where=nu0, max_arcs=8).value

    nu1s = jnp.linspace(0.345, 0.355, 1000)
    values = benchmark(lambda: jax.block_until_ready(fold(nu1s)))
    assert np.all(np.isfinite(values))


def test_scipy(benchmark):
    """A peer: SciPy's brentq over solve_ivp (DOP853, 1e-12) with an event, to 1e-11.

    The orbit from slip onset is followed to its next maximum of x2. It finds the same root, with
    less to find out: that this maximum is the place is known beforehand.
    """

    def friction(r):
        return 0.4 / (1 + 10 * r) + 0.6

    def gap(nu):
        def field(t, y):
            # Both belts run ahead of the mass. A little beyond belt 1 the law is continued.
            pull = friction(nu - y[1]) + friction(max(NU1 - y[1], -0.05))
            return y[1], -y[0] - 0.5 * y[1] + pull

        def loops(t, y):
            return field(t, y)[1]

        loops.terminal, loops.direction = True, -1
        onset = (friction(nu - NU1) + 1.0 - 0.5 * NU1, NU1)
        out = solve_ivp(field, (0, 1.0), onset, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
        run = solve_ivp(field, (0, 20), out, "DOP853", rtol=1e-12, atol=1e-12, events=loops)
        return NU1 - run.y[1, -1]

    value = benchmark(lambda: brentq(gap, EXACT - 0.02, EXACT + 0.02, xtol=1e-12))
    assert value == pytest.approx(EXACT, abs=1e-9)
