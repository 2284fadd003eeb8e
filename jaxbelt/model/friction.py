"""Friction laws: the coefficient of friction as a function of the sliding speed.

A law is asked two things: `static`, the coefficient that holds a stuck mass, and `mu(speed)`, the
coefficient while it slips. A slip mode keeps the sign of its relative velocity (see `modes`), so
an integrator or a Newton iteration may ask for a speed slightly below zero; each law therefore
continues smoothly a little beyond its boundary. A law of your own is a subclass of
`AbstractFriction` with these two.
"""

import abc
import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..checks import (
    Rule,
    as_array,
    be_finite,
    be_nonnegative,
    be_positive,
    number,
    require,
    require_value,
    traceable,
)

#: What rounding may add to mu(0), over 1 + static.
MU_ROUNDING = 1e-14


def _scalar(name: str) -> Callable[[Any], Array]:
    return lambda value: as_array(value, name)


class AbstractFriction(eqx.Module):
    """A friction law: subclass it with `static` and `mu` to use one of your own."""

    static: eqx.AbstractVar[Array]

    @abc.abstractmethod
    def mu(self, speed: Array) -> Array:
        """Kinetic friction coefficient at sliding speed |nu_R| (dimensionless, any shape).

        Must be smooth for speed >= 0 and stay finite and smooth slightly below 0; mu(0) <= static,
        and the two are equal for a law without a jump.
        """

    def fraction(self, speed: Array) -> tuple[Array, Array]:
        """mu(speed) as (numerator, denominator), denominator > 0; kernels divide last."""
        return self.mu(speed), jnp.ones_like(speed)

    def in_units_of(self, speed: Array) -> "AbstractFriction":
        """The same law for speeds that are given in units of `speed`; see `Machine`."""
        return LawInUnits(self, speed)

    def rules(self) -> list[Rule]:
        """What its parameters have to be; a law of one's own may add to them."""
        begins = self.mu(jnp.zeros(jnp.shape(self.static)))
        most = self.static + MU_ROUNDING * (1 + self.static)
        bound = Rule("mu(0)", (begins, self.static, most), _is_at_most, "<= static = {1}")
        return [*be_nonnegative("static", self.static), bound]

    def check(self, owner: str) -> None:
        """Raise a `ValueError` naming `owner` where a known parameter is out of range."""
        for rule in type(self).rules(self):
            rule.enforce(f" of {owner}")

    def __repr__(self) -> str:
        values = ", ".join(
            f"{name}={number(value) if eqx.is_array(value) else repr(value)}"
            for name, value in vars(self).items()
        )
        return f"{type(self).__name__}({values})"


def _is_at_most(value: Any, _: Any, most: Any) -> Any:
    return value <= most


#: Laws of one's own whose `mu` was traced.
_traced: set[type] = set()


def check_law(law: AbstractFriction) -> None:
    """Raise a `ValueError` where `mu` of a law of one's own cannot be traced, once for each class.

    A law that asks NumPy for an exponential gives right numbers by itself and fails inside of what
    is compiled.
    """
    kind = type(law)
    if kind in _traced or kind.__module__ == __name__:
        return
    speed = jax.ShapeDtypeStruct((), jnp.float64)

    def coefficients() -> Any:
        return jax.eval_shape(law.mu, speed)

    found = traceable(coefficients, f"mu of {kind.__name__}", "a function of the speed")
    fits = isinstance(found, jax.ShapeDtypeStruct) and found.shape == ()
    fits = fits and found.dtype == jnp.float64
    require(fits, f"mu of {kind.__name__}", "a function that returns one float64 a speed", found)
    _traced.add(kind)


def as_friction(law: Any) -> AbstractFriction:
    """The law, or a `ValueError` where it is none."""
    fits = isinstance(law, AbstractFriction)
    require_value(fits, "friction", "a law such as jb.Conti(...)", law)
    check_law(law)
    return law


class LawInUnits(AbstractFriction):
    """A law that takes its speeds in another unit: mu(r) is law.mu(unit r)."""

    law: AbstractFriction
    unit: Array

    def __init__(self, law: AbstractFriction, unit: Array):
        self.law, self.unit = law, unit

    # The law's own: a copy would be a parameter of its own.
    @property
    def static(self) -> ArrayLike:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.law.static

    def fraction(self, speed: Array) -> tuple[Array, Array]:
        return self.law.fraction(self.unit * speed)

    def mu(self, speed: Array) -> Array:
        """Kinetic friction coefficient of the law at unit times the speed, any shape."""
        return self.law.mu(self.unit * speed)

    def in_units_of(self, speed: Array) -> AbstractFriction:
        return LawInUnits(self.law, self.unit * speed)

    def rules(self) -> list[Rule]:
        return type(self.law).rules(self.law)


class Conti(AbstractFriction):
    """Conti's law, eqs. (7) and (16) of the paper: mu falls hyperbolically with the speed.

    mu(r) = (mus - p1) / (1 + p3 r) + p1 + p2 r^2, so mu(0) = mus.

    Arguments, all dimensionless scalars: static (mus >= 0), residual (p1 >= 0), steepness
    (p3 >= 0), quadratic (p2, default 0). `ValueError` for anything else.
    """

    static: Float[Array, ""] = eqx.field(converter=_scalar("static"))
    residual: Float[Array, ""] = eqx.field(converter=_scalar("residual"))
    steepness: Float[Array, ""] = eqx.field(converter=_scalar("steepness"))
    quadratic: Float[Array, ""] = eqx.field(converter=_scalar("quadratic"), default=0.0)

    def __check_init__(self):
        self.check("Conti")

    def rules(self) -> list[Rule]:
        rules = be_finite("quadratic", self.quadratic)
        for name in ("static", "residual", "steepness"):
            rules += be_nonnegative(name, getattr(self, name))
        return rules

    def in_units_of(self, speed: Array) -> AbstractFriction:
        steepness, quadratic = self.steepness * speed, self.quadratic * speed**2
        return Conti(self.static, self.residual, steepness, quadratic)

    def fraction(self, speed: Array) -> tuple[Array, Array]:
        mus, p1, p2, p3 = self.static, self.residual, self.quadratic, self.steepness
        # The formula has a pole at r = -1/p3, close below the boundary; half way there it is cut
        # off, so that a trial step beyond the boundary meets large errors but never infinity.
        denominator = 1 + jnp.maximum(p3 * speed, -0.5)
        return (mus - p1) + (p1 + p2 * speed**2) * denominator, denominator

    def mu(self, speed: Array) -> Array:
        """Kinetic friction coefficient mu(r), eq. (7) of the paper.

        speed: |nu_R| = |nu - omega x2| >= 0, dimensionless, any shape. Returns the same shape.
        """
        numerator, denominator = self.fraction(speed)
        return numerator / denominator


class Coulomb(AbstractFriction):
    """Coulomb's law with separate static and kinetic coefficients: mu(r) = kinetic for r > 0.

    Arguments, dimensionless scalars: static >= kinetic >= 0. `ValueError` for anything else.
    """

    static: Float[Array, ""] = eqx.field(converter=_scalar("static"))
    kinetic: Float[Array, ""] = eqx.field(converter=_scalar("kinetic"))

    def __check_init__(self):
        self.check("Coulomb")

    def rules(self) -> list[Rule]:
        return _of_static_and_kinetic(self.static, self.kinetic)

    def in_units_of(self, speed: Array) -> AbstractFriction:
        return self

    def mu(self, speed: Array) -> Array:
        """Kinetic friction coefficient, the same at every speed (any shape)."""
        return jnp.broadcast_to(self.kinetic, jnp.shape(speed))


class Stribeck(AbstractFriction):
    """Stribeck's law with exponential decay: mu(r) = kinetic + (static - kinetic) exp(-r/velocity).

    Arguments, dimensionless scalars: static >= kinetic >= 0, and velocity > 0, the Stribeck
    velocity. `ValueError` for anything else. Used in this form by L. C. Bo and D. Pavelescu, The
    friction-speed relation and its influence on the critical velocity of stick-slip motion, Wear
    82 (1982) 277-289.
    """

    static: Float[Array, ""] = eqx.field(converter=_scalar("static"))
    kinetic: Float[Array, ""] = eqx.field(converter=_scalar("kinetic"))
    velocity: Float[Array, ""] = eqx.field(converter=_scalar("velocity"))

    def __check_init__(self):
        self.check("Stribeck")

    def rules(self) -> list[Rule]:
        both = _of_static_and_kinetic(self.static, self.kinetic)
        return both + be_positive("velocity", self.velocity)

    def in_units_of(self, speed: Array) -> AbstractFriction:
        return Stribeck(self.static, self.kinetic, self.velocity / speed)

    def mu(self, speed: Array) -> Array:
        """Kinetic friction coefficient mu(r) at speed r >= 0, dimensionless, any shape."""
        # Cut off below the boundary like Conti's: an exponential overflows there.
        decay = jnp.exp(-jnp.maximum(speed / self.velocity, -1.0))
        return self.kinetic + (self.static - self.kinetic) * decay


def _of_static_and_kinetic(static: ArrayLike, kinetic: ArrayLike) -> list[Rule]:
    rules = be_nonnegative("static", static) + be_nonnegative("kinetic", kinetic)
    return [*rules, Rule("kinetic", (kinetic, static), operator.le, "<= static = {1}")]
