"""A machine in SI units, and the dimensionless oscillator that describes it.

    m X'' = -k X - c X' + sum over touching belts of  N_i mu_i(|R_i|) sgn(R_i) + sum of P_j(t),
    R_i = V_i - X'

One unit of time is sqrt(m/k); one of length is the deflection of the spring under the largest
normal force, max N_i / k; velocity, force and energy follow from these. So the oscillator has omega
= 1, its largest load is 1, and its laws take speeds in the unit of velocity.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..checks import (
    KnownNames,
    check_finite,
    check_nonnegative,
    check_positive,
    is_concrete,
    number,
    require,
    require_value,
    scalar,
)
from .forcing import AbstractForce, Oscillating, as_forcing, as_velocity, number_or_oscillating
from .friction import AbstractFriction, as_friction
from .oscillator import (
    Belt,
    Oscillator,
    as_belts,
    as_edge,
    check_oscillator,
    number_or_wave,
    scaled_edge,
)
from .own_units import in_unit


class Units(eqx.Module):
    """Units of the dimensionless quantities of a `Machine`, scalars.

    Args:
        time: Unit of time in s.
        length: Unit of length in m.
        velocity: Unit of velocity in m/s.
        force: Unit of force in N.
        energy: Unit of energy in J.

    Raises:
        ValueError: If a unit is not > 0.
    """

    time: Float[Array, ""] = eqx.field(converter=scalar("time"))
    length: Float[Array, ""] = eqx.field(converter=scalar("length"))
    velocity: Float[Array, ""] = eqx.field(converter=scalar("velocity"))
    force: Float[Array, ""] = eqx.field(converter=scalar("force"))
    energy: Float[Array, ""] = eqx.field(converter=scalar("energy"))

    def __check_init__(self):
        for name, value in vars(self).items():
            check_positive(value, name)

    @property
    def rate(self) -> Any:
        """Unit of rates, such as exponents, in 1/s."""
        return 1.0 / self.time

    def __repr__(self) -> str:
        symbols = {"time": "s", "length": "m", "velocity": "m/s", "force": "N", "energy": "J"}
        parts = (f"{name} {number(getattr(self, name))} {of}" for name, of in symbols.items())
        return f"Units({', '.join(parts)})"


#: SI unit of each dimension: its symbol, and the size of the dimensionless unit in it.
SI_UNITS: dict[str, tuple[str, Callable[[Units], Any]]] = {
    "time": ("s", lambda units: units.time),
    "length": ("m", lambda units: units.length),
    "velocity": ("m s-1", lambda units: units.velocity),
    "force": ("N", lambda units: units.force),
    "energy": ("J", lambda units: units.energy),
    "rate": ("s-1", lambda units: units.rate),
    "damping": ("N s m-1", lambda units: units.force / units.velocity),
    "frequency": ("rad s-1", lambda units: units.rate),
    "angle": ("rad", lambda units: jnp.ones(())),
}


class PhysicalBelt(KnownNames):
    """A belt of a `Machine`, in SI units; it touches the mass while lower < X < upper.

    Args:
        velocity: V in m/s, a number or `Oscillating` with an angular frequency in rad/s.
        friction: A law that takes speeds in m/s (`Conti`'s steepness is then in s/m, `Stribeck`'s
            velocity in m/s).
        normal_force: N >= 0 in newtons, likewise a number or `Oscillating`.
        lower: Lower end of the contact interval, a displacement in m from where the spring is
            relaxed; default unbounded.
        upper: Upper end, likewise.

    Raises:
        ValueError: If a value is impossible; the message names it.
    """

    # Scalar arrays, or `Oscillating`.
    velocity: Any = eqx.field(converter=as_velocity)
    friction: AbstractFriction = eqx.field(converter=as_friction)
    normal_force: Any = eqx.field(
        converter=lambda value: number_or_oscillating(value, "normal_force")
    )
    lower: Float[Array, ""] = eqx.field(converter=as_edge("lower"), default=-float("inf"))
    upper: Float[Array, ""] = eqx.field(converter=as_edge("upper"), default=float("inf"))

    def __check_init__(self):
        for name, check in (("velocity", check_finite), ("normal_force", check_nonnegative)):
            value = getattr(self, name)
            if isinstance(value, Oscillating):
                for rule in value.rules_as(name):
                    rule.enforce("")
            else:
                check(value, name)
        if is_concrete((self.lower, self.upper)):
            require(not np.isnan(self.lower), "lower", "a number", self.lower)
            ordered = np.asarray(self.lower) < np.asarray(self.upper)
            require(ordered, "lower", f"< upper = {self.upper}", self.lower)

    def __repr__(self) -> str:
        return (
            f"PhysicalBelt(velocity={number_or_wave(self.velocity)} m/s, "
            f"friction={self.friction!r}, "
            f"normal_force={number_or_wave(self.normal_force)} N, lower={number(self.lower)} m, "
            f"upper={number(self.upper)} m)"
        )


class Machine(KnownNames):
    """A mass on a spring and a dashpot, in contact with one belt or more, in SI units.

    `oscillator` is the dimensionless `Oscillator`, which all of this package takes; `units` are its
    units, and `start(x, v)` and `tau(t)` convert a state and a time. `in_si` and `plot_in_si`
    convert results back. Everything is differentiable by every number of the machine.

    Args:
        mass: m in kg.
        stiffness: k in N/m.
        damping: c in N s/m.
        belts: One `PhysicalBelt` or more.
        forcing: A force or a tuple of forces; default none. A `Harmonic` has its amplitude in N and
            its angular frequency in rad/s, a `BaseMotion` its amplitude in m; your own force takes
            s and returns N.

    Raises:
        ValueError: If a value is impossible; the message names it.
    """

    mass: Float[Array, ""] = eqx.field(converter=scalar("mass"))
    stiffness: Float[Array, ""] = eqx.field(converter=scalar("stiffness"))
    damping: Float[Array, ""] = eqx.field(converter=scalar("damping"))
    belts: tuple[PhysicalBelt, ...] = eqx.field(
        converter=lambda belts: as_belts(belts, "PhysicalBelt")
    )
    forcing: tuple[AbstractForce, ...] = eqx.field(converter=as_forcing, default=())

    def __check_init__(self):
        check_positive(self.mass, "mass")
        check_positive(self.stiffness, "stiffness")
        check_finite(self.damping, "damping")
        require(len(self.belts) > 0, "belts", "at least one PhysicalBelt", "none")
        for i, belt in enumerate(self.belts):
            require(isinstance(belt, PhysicalBelt), f"belts[{i}]", "a PhysicalBelt", repr(belt))
        for i, force in enumerate(self.forcing):
            AbstractForce.check(force, f"forcing[{i}]")

    @property
    def units(self) -> Units:
        """One unit of each dimensionless quantity, in SI units."""
        largest = jnp.max(jnp.stack([_largest_force(belt.normal_force) for belt in self.belts]))
        # Without a normal force on any belt there is no natural length.
        length = jnp.where(largest > 0, largest / self.stiffness, 1.0)
        time, force = jnp.sqrt(self.mass / self.stiffness), self.stiffness * length
        return Units(time, length, length / time, force, force * length)

    @property
    def oscillator(self) -> Oscillator:
        """The dimensionless `Oscillator`."""
        units = self.units
        belts = [
            Belt(
                in_unit(belt.velocity, units.velocity, units.time),
                belt.friction.in_units_of(units.velocity),
                in_unit(belt.normal_force, units.force, units.time),
                scaled_edge(belt.lower, 1 / units.length),
                scaled_edge(belt.upper, 1 / units.length),
            )
            for belt in self.belts
        ]
        damping = self.damping / jnp.sqrt(self.stiffness * self.mass)
        scales = units.force, units.length, units.time
        forcing = tuple(force.in_units_of(*scales) for force in self.forcing)
        return Oscillator(damping, belts, forcing=forcing)

    def start(self, displacement: ArrayLike, velocity: ArrayLike) -> tuple[Array, Array]:
        """The dimensionless start of a motion.

        Args:
            displacement: In m.
            velocity: In m/s.

        Returns:
            The state (x1, x2).
        """
        x1, x2 = _si_numbers(displacement, "displacement"), _si_numbers(velocity, "velocity")
        units = self.units
        return _over(x1, units.length), _over(x2, units.velocity)

    def tau(self, time: ArrayLike) -> Array:
        """The dimensionless time tau.

        Args:
            time: In s, any shape.

        Returns:
            The time, of the same shape.
        """
        return _over(_si_numbers(time, "time"), self.units.time)

    def of_oscillator(self, osc: Oscillator) -> "Machine":
        """This machine with the numbers of a dimensionless oscillator, such as that of a fit.

        Args:
            osc: The oscillator, in the units of this machine.

        Returns:
            A `Machine` with the mass and stiffness of this one.

        Raises:
            ValueError: If the number of belts differs, or omega is not 1.
        """
        check_oscillator(osc)
        require(len(osc.belts) == len(self.belts), "osc", f"of {len(self.belts)} belts", osc)
        if is_concrete(osc.omega):
            require(
                np.asarray(osc.omega) == 1, "omega of osc", "1, as that of every machine", osc.omega
            )
        units = self.units
        belts = [
            PhysicalBelt(
                in_unit(belt.velocity, 1 / units.velocity, 1 / units.time),
                belt.friction.in_units_of(1 / units.velocity),
                in_unit(belt.load, 1 / units.force, 1 / units.time),
                scaled_edge(belt.lower, units.length),
                scaled_edge(belt.upper, units.length),
            )
            for belt in osc.belts
        ]
        damping = osc.damping * jnp.sqrt(self.stiffness * self.mass)
        scales = 1 / units.force, 1 / units.length, 1 / units.time
        forcing = tuple(force.in_units_of(*scales) for force in osc.forcing)
        return Machine(self.mass, self.stiffness, damping, belts, forcing)

    def __repr__(self) -> str:
        belts = ", ".join(map(repr, self.belts))
        return (
            f"Machine(mass={number(self.mass)} kg, stiffness={number(self.stiffness)} N/m, "
            f"damping={number(self.damping)} N s/m, belts=({belts},){_forcing_text(self.forcing)})"
        )


def _forcing_text(forcing: tuple[AbstractForce, ...]) -> str:
    return f", forcing=({', '.join(map(repr, forcing))},)" if forcing else ""


def _largest_force(normal_force: Any) -> Array:
    if isinstance(normal_force, Oscillating):
        return normal_force.mean + jnp.abs(normal_force.amplitude)
    return normal_force


def _si_numbers(value: Any, field: str) -> Array:
    """`value` as an array of any shape, or a `ValueError`."""
    is_number = isinstance(value, jax.Array) or np.asarray(value).dtype.kind in "iuf"
    require_value(is_number, field, "a number", value)
    return jnp.asarray(value)


def _over(value: Array, unit: Array) -> Array:
    """value / unit, by NumPy for known numbers: a number alone and one of many give the same
    quotient, while XLA may multiply many by the reciprocal."""
    if is_concrete((value, unit)):
        return jnp.asarray(np.asarray(value) / np.asarray(unit))
    return value / unit
