"""Cycles that come from infinity: against the energy of large loops in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt import Status

LAW = jb.Conti(1.0, 0.6, 10.0)
QUADRATIC = jb.Conti(1.0, 0.6, 10.0, 0.05)
CONDITION = jb.HopfAtInfinity()
SLOW = pytest.mark.slow


class Viscous(jb.AbstractFriction):
    """mu(r) = static + slope r."""

    static: float
    slope: float

    def mu(self, speed):
        """Kinetic friction coefficient."""
        return self.static + self.slope * speed


class Root(jb.AbstractFriction):
    """mu(r) = static + slope sqrt(1 + r)."""

    static: float
    slope: float

    def mu(self, speed):
        """Kinetic friction coefficient."""
        return self.static + self.slope * (jnp.sqrt(1 + speed) - 1)


def one_belt(damping, law=LAW, omega=1.0, **changes):
    return jb.Oscillator(damping, (jb.Belt(0.3, law, **changes),), omega=omega)


@pytest.mark.slow(first=True)
def test_without_damping():
    point = jb.refine(CONDITION, one_belt, at=-0.1)
    assert point.status == Status.OK and point.value == 0
    assert point.cycle.status == Status.NOT_FINITE
    (found,) = jb.scan(one_belt, span=(-0.2, 0.15), resolution=8)
    assert found.condition == CONDITION and found.value == 0
    assert jb.scan(one_belt, span=(0.02, 0.15), resolution=8) == ()


@pytest.mark.parametrize(
    ("law", "omega", "changes", "at"),
    [
        # Energy of a loop x2 = A cos t: of a belt that is passed at |x2| = A, twice.
        (
            jb.Conti(1.0, 0.6, 10.0, 0.05),
            1.0,
            {"lower": -1.0, "upper": 1.5},
            -2 / np.pi * 0.05 * 2.5,
        ),
        pytest.param(
            jb.Conti(1.0, 0.6, 10.0, 0.05),
            0.5,
            {"lower": 0.0, "upper": 2.0},
            -2 / np.pi * 0.0125 * 2,
            marks=pytest.mark.slow(first=True),
        ),
        pytest.param(*(Viscous(1.0, 0.02), 1.0, {"load": 2.0}, -0.04), marks=SLOW),
        pytest.param(*(Viscous(1.0, 0.02), 0.5, {"lower": 0.4}, -0.005), marks=SLOW),
        pytest.param(
            *(Viscous(1.0, 0.02), 1.0, {"lower": 0.4, "upper": 2.0}, 0.0), marks=pytest.mark.slow
        ),
    ],
)
def test_with_friction_that_grows(law, omega, changes, at):
    def make(damping):
        return one_belt(damping, law, omega, **changes)

    point = jb.refine(CONDITION, make, at=-0.1)
    assert point.status == Status.OK and point.value == pytest.approx(at, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "amplitude"),
    [
        # Twice the friction force, both ways, over pi times the damping.
        ({}, lambda away: 4 * 0.6 / (np.pi * away)),
        ({"lower": 0.4}, lambda away: 2 * 0.6 / (np.pi * away)),
        # The remainder of the energy of a short contact, 2 u0 p1 times its length.
        ({"lower": -0.5, "upper": 1.0}, lambda away: np.sqrt(2 * 1.5 * 0.6 / (np.pi * away))),
    ],
)
def test_its_amplitude_goes_to_infinity(changes, amplitude):
    for away, error in ((0.01, 0.05), (0.0025, 0.02)):
        portrait = jb.portrait(one_belt(-away, **changes))
        outermost = max(portrait.unstable, key=jb.amplitude)
        assert jb.amplitude(outermost) == pytest.approx(amplitude(away), rel=error)
    assert jb.portrait(one_belt(0.0025, **changes)).unstable == ()


@pytest.mark.slow(first=True)
def test_nothing_comes_from_infinity():
    """Friction that grows without bounds, as r^2 and to all sides; and none at all."""
    point = jb.refine(CONDITION, lambda damping: one_belt(damping, QUADRATIC), at=-0.1)
    assert point.status != Status.OK and jnp.isnan(point.value)
    point = jb.refine(CONDITION, lambda damping: one_belt(damping, load=0.0), at=-0.1)
    assert point.status == Status.NOT_TOUCHED


@pytest.mark.slow
def test_growth_that_is_not_told():
    """What grows neither as r nor as r^2; and a scan where nothing comes from infinity."""
    point = jb.refine(CONDITION, lambda damping: one_belt(damping, Root(1.0, 0.1)), at=-0.1)
    assert point.status == Status.NOT_TOUCHED
    assert jb.scan(lambda d: one_belt(d, QUADRATIC), span=(-0.2, 0.15), resolution=8) == ()


def test_derivative():
    """Of the damping at which it happens by the quadratic coefficient, in closed form."""

    def value(p2):
        law = jb.Conti(1.0, 0.6, 10.0, p2)
        make = lambda damping: one_belt(damping, law, lower=-1.0, upper=1.5)  # noqa: E731
        return jb.refine(CONDITION, make, at=-0.1).value

    assert jax.grad(value)(0.05) == pytest.approx(-5 / np.pi, abs=1e-9)
