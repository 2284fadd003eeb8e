"""A friction law of the user's own, for several tests."""

import jax
import jax.numpy as jnp

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
