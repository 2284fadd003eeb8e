"""A friction law of the user's own, for several tests."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxbelt as jb


class Lorentz(jb.AbstractFriction):
    """mu(r) = kinetic + (static - kinetic)/(1 + (r/velocity)^2), steepest away from r = 0."""

    static: jax.Array
    kinetic: jax.Array
    velocity: jax.Array

    def mu(self, speed):
        return self.kinetic + (self.static - self.kinetic) / (1 + (speed / self.velocity) ** 2)


def bell(r):
    """The same for the oracle, as a function."""
    return 0.6 + 0.4 / (1 + (r / 0.4) ** 2)


BELL = Lorentz(jnp.asarray(1.0), jnp.asarray(0.6), jnp.asarray(0.4))


class Peak(jb.AbstractFriction):
    """mu(r) = kinetic + (static - kinetic) exp(-(r/velocity)^2) + viscous r, the Stribeck curve of
    LuGre models: a narrow layer at r = 0 of which no derivative tells outside of it."""

    static: jax.Array
    kinetic: jax.Array
    velocity: jax.Array
    viscous: jax.Array

    def mu(self, speed):
        falls = self.static - self.kinetic
        return (
            self.kinetic + falls * jnp.exp(-((speed / self.velocity) ** 2)) + self.viscous * speed
        )


def peak(static, kinetic, velocity, viscous):
    """The same law for the package, and for the oracle as a function with its static limit."""

    def mu(r):
        return kinetic + (static - kinetic) * np.exp(-((r / velocity) ** 2)) + viscous * r

    return Peak(*map(jnp.asarray, (static, kinetic, velocity, viscous))), (mu, static)


class Nested(jb.AbstractFriction):
    """mu(1 - v) = 1 + v/2 + a polynomial in v, for a belt of velocity 1.

    With damping near 0.5 what is left is weak. Averaged over a loop it lets the amplitude A grow
    like -A (s - 0.04) (s - 0.08) (s - 0.16), s = A^2: between two attracting cycles lies a third.
    At r = 0, far from what is met there, it is a friction again, 1.1.
    """

    static: jax.Array

    def mu(self, speed):
        return nested(speed)


def nested(r):
    v = 1.0 - r
    rest = (20 * 5.12e-4 * 2, -20 * 0.0224 * 8 / 3, 20 * 0.28 * 16 / 5, -20 * 128 / 35)
    odd = sum(c * v ** (2 * i + 1) for i, c in enumerate(rest))
    return 1.0 + 0.5 * v + odd + 56.0 * v**32


NESTED = Nested(jnp.asarray(3.0))


class Bump(jb.AbstractFriction):
    """mu(1 - v) = 1 + v/2 + gain (0.98 v - 8/3 v^3) + bump 1e-3/(1 + ((v - 0.703)/1e-3)^2).

    For a belt of velocity 1 and damping 0.5, where a cycle of amplitude 0.7 attracts by `gain`. A
    bump puts energy in where x2 comes to 0.703, and there is another cycle right outside.
    """

    static: jax.Array
    gain: jax.Array
    bump: jax.Array

    def mu(self, speed):
        return bumpy(speed, self.gain, self.bump)


def bumpy(r, gain, bump):
    v = 1.0 - r
    rest = gain * (0.98 * v - 8 / 3 * v**3) + bump * 1e-3 / (1 + ((v - 0.703) / 1e-3) ** 2)
    return 1.0 + 0.5 * v + rest
