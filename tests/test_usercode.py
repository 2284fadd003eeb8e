"""Programs of code of a user's own, which reads what changes: each answer is that of today."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt.identity import own_parts

residual = 0.8


class Reading(jb.AbstractFriction):
    """Conti's law with a residual that a global says."""

    static: float

    def mu(self, speed):
        falling = (self.static - residual) / (1 + 10 * jnp.maximum(speed, -0.05))
        return residual + falling


class OfClass(jb.AbstractFriction):
    """Coulomb's law with a kinetic coefficient that the class says."""

    static: float
    kinetic = 0.8

    def mu(self, speed):
        return self.kinetic + 0.0 * speed


class Push(jb.AbstractForce):
    frequency: jax.Array

    def force(self, t):
        return residual * jnp.cos(self.frequency * t)


class Scaled:
    def __init__(self, factor):
        self.factor = factor

    def __call__(self, cycle):
        return self.factor * jb.amplitude(cycle)


def end(law, forcing=()):
    osc = jb.Oscillator(0.5, (jb.Belt(0.2, law),), forcing=forcing)
    return jb.simulate(osc, (3.0, 0.0), 20.0, ts=[20.0]).ys[-1]


def conti():
    return jb.Conti(1.0, residual, 10.0)


@pytest.mark.slow(first=True)
def test_a_law_that_reads_a_global(monkeypatch):
    for value in (0.8, 0.6, 0.8):
        monkeypatch.setitem(globals(), "residual", value)
        np.testing.assert_allclose(end(Reading(1.0)), end(conti()), rtol=0, atol=1e-9)


@pytest.mark.slow(first=True)
def test_also_in_a_batch(monkeypatch):
    def of_batch(law):
        return jax.vmap(lambda static: end(law(static))[0])(jnp.array([1.0, 1.1]))

    for value in (0.8, 0.6):
        monkeypatch.setitem(globals(), "residual", value)
        right = of_batch(lambda static: jb.Conti(static, residual, 10.0))
        np.testing.assert_allclose(of_batch(Reading), right, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_law_that_reads_its_class_and_a_force(monkeypatch):
    for value in (0.8, 0.6):
        monkeypatch.setattr(OfClass, "kinetic", value)
        right = end(jb.Coulomb(1.0, value))
        np.testing.assert_allclose(end(OfClass(1.0)), right, rtol=0, atol=1e-9)
        monkeypatch.setitem(globals(), "residual", value)
        right = end(conti(), jb.Harmonic(value, 1.3))
        np.testing.assert_allclose(end(conti(), Push(jnp.asarray(1.3))), right, rtol=0, atol=1e-8)


@dataclasses.dataclass(frozen=True, slots=True)
class Slotted:
    """Cannot be referred to weakly."""

    def __call__(self, speed):
        return residual + 0.0 * speed


class Logging(jb.AbstractFriction):
    """Holds what has no fingerprint, and something that reads a global."""

    static: float
    made_of: Slotted = eqx.field(static=True)

    def mu(self, speed):
        _ = NO_FINGERPRINT
        return self.made_of(speed)


NO_FINGERPRINT = (one for one in ())


@pytest.mark.slow(first=True)
def test_parts_without_weak_references_or_fingerprints(monkeypatch):
    for value in (0.8, 0.6):
        monkeypatch.setitem(globals(), "residual", value)
        right = end(jb.Coulomb(1.0, value))
        np.testing.assert_allclose(end(Logging(1.0, Slotted())), right, rtol=0, atol=1e-9)


@pytest.mark.slow(first=True)
def test_a_functional_whose_attribute_changed():
    osc, wanted = jb.presets.class_b(0.3, 0.35), 0.5
    functional = Scaled(1.0)
    for factor in (1.0, 2.0):
        functional.factor = factor
        found = jb.design(osc, [(functional, wanted)], where=lambda osc: osc.belts[0].velocity)
        cycle = jb.find_cycle(found.oscillator, (3.0, 0.0))
        assert float(functional(cycle)) == pytest.approx(wanted, abs=1e-8)


@pytest.mark.slow(first=True)
def test_programs_are_forgotten_only_where_something_changed(monkeypatch):
    monkeypatch.setitem(globals(), "residual", 0.8)
    end(Reading(1.0))
    forgotten, forget = [], jax.clear_caches
    monkeypatch.setattr(jax, "clear_caches", lambda: (forgotten.append(1), forget()))
    for value, times in ((0.8, 0), (0.8, 0), (0.6, 1), (0.6, 1)):
        monkeypatch.setitem(globals(), "residual", value)
        end(Reading(1.0))
        end(jb.Conti(1.0, 0.6, 10.0))
        assert len(forgotten) == times


def test_own_parts_are_those_of_the_user_alone():
    own = jb.Oscillator(0.5, (jb.Belt(0.2, Reading(1.0)), jb.Belt(0.3, jb.Coulomb(1.0, 0.8))))
    assert own_parts(jax.tree.structure(own)) == [Reading]
    assert own_parts(jax.tree.structure(jb.presets.class_b(0.3, 0.35))) == []
    functional = Scaled(2.0)
    assert own_parts([functional, jb.amplitude, 1.0]) == [functional]
