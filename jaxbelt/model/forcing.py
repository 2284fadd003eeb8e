"""Forcing: forces on the mass, and velocities and loads of belts, that depend on the time.

Forces F_j(tau) may push the mass; they depend on the dimensionless time tau = omega t alone,

    x2' = -x1 - zeta x2 + (friction of the touching belts) + sum of F_j(tau),

and a belt's velocity and load may oscillate. Forces are measured like loads, over the stiffness, so
they are lengths. Frequencies are angular ones in the time tau: the natural frequency is 1.

A user's force is a subclass of `AbstractForce` with `frequency` and `force(t)`. A frequency that is
known to be 0 makes a constant force, or a constant velocity or load; then the oscillator has no
clock, and every function of this package accepts it.
"""

import abc
from collections.abc import Iterable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..checks import (
    Parameters,
    Rule,
    as_array,
    be_finite,
    be_nonnegative,
    is_concrete,
    number,
    require_one_float,
    require_value,
    scalar,
    traceable,
)
from ..dimensions import quantity

#: Dimensions of the fields of forces and waves.
FORCE, FREQUENCY, ANGLE = map(quantity, ("force", "frequency", "angle"))


class _Wave(Parameters):
    """Base of all classes of this module."""

    def rules(self) -> list[Rule]:
        """Conditions on its parameters; a user's force may add to them."""
        named = [(name, value) for name, value in vars(self).items() if eqx.is_inexact_array(value)]
        return [
            rule
            for name, value in named
            for rule in (be_nonnegative if name == "frequency" else be_finite)(name, value)
        ]


class AbstractForce(_Wave):
    """A periodic force on the mass: subclass it with `frequency` and `force` to define your own.

    Attributes:
        frequency: Angular frequency in the time tau; the period is 2 pi / frequency. 0: no period
            is known.

    Example:
        A short push in each period::

            class Pulses(jb.AbstractForce):
                size: jax.Array
                frequency: jax.Array

                def force(self, t):
                    return self.size * jnp.exp(3 * (jnp.cos(self.frequency * t) - 1))
    """

    frequency: eqx.AbstractVar[Array]

    @abc.abstractmethod
    def force(self, t: Array) -> Array:
        """The force over the stiffness; smooth, and made of `jax.numpy`.

        Args:
            t: Time tau, a scalar.

        Returns:
            The force, a scalar.
        """

    @property
    def fastest(self) -> Array:
        """Highest frequency that matters in the force; steps are short against its period."""
        return 8.0 * self.frequency

    def bound(self, damping: ArrayLike) -> Array:
        """A bound of the size of the force for all times; inf where none is known."""
        return jnp.asarray(jnp.inf)

    def on_mass(self, t: Array, damping: Array) -> Array:
        """The force at the time t on a mass with this damping."""
        return self.force(t)

    def in_units_of(self, force: ArrayLike, length: ArrayLike, time: ArrayLike) -> "AbstractForce":
        """The same force in these units of force, length and time."""
        return ForceInUnits(self, force, time)


class ForceInUnits(AbstractForce):
    """A user's force in other units: force(t) is own.force(time t) / unit."""

    own: AbstractForce
    unit: Array
    time: Array

    def __init__(self, own: AbstractForce, unit: Any, time: Any):
        self.own, self.unit, self.time = own, jnp.asarray(unit), jnp.asarray(time)

    # A property: a copy would be a further leaf, that is, a further parameter.
    @property
    def frequency(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.own.frequency * self.time

    @property
    def fastest(self) -> Array:
        return self.own.fastest * self.time

    def bound(self, damping: ArrayLike) -> Array:
        return self.own.bound(damping) / self.unit

    def force(self, t: Array) -> Array:
        """The force over the unit at the time t."""
        return self.own.force(self.time * t) / self.unit

    def in_units_of(self, force: ArrayLike, length: ArrayLike, time: ArrayLike) -> AbstractForce:
        return ForceInUnits(self.own, self.unit * force, self.time * time)

    def rules(self) -> list[Rule]:
        return type(self.own).rules(self.own)


class ConstantForce(AbstractForce):
    """A constant force, as of an incline: a `Harmonic` with the frequency 0. No clock.

    phase: None stands for 0.
    """

    amplitude: Float[Array, ""] = eqx.field(metadata=FORCE)
    phase: Float[Array, ""] | None = eqx.field(default=None, metadata=ANGLE)

    wave: ClassVar[str] = "Harmonic"

    @property
    def frequency(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        return jnp.zeros(())

    @property
    def push(self) -> Array:
        """The force over the stiffness, amplitude cos(phase)."""
        return self.amplitude if self.phase is None else self.amplitude * _cosine(self.phase)

    def force(self, t: Array) -> Array:
        """The force over the stiffness, at every time."""
        return self.push

    def bound(self, damping: ArrayLike) -> Array:
        return jnp.abs(self.push)

    def in_units_of(self, force: ArrayLike, length: ArrayLike, time: ArrayLike) -> AbstractForce:
        return unchecked(ConstantForce, amplitude=self.amplitude / force, phase=self.phase)

    def __repr__(self) -> str:
        phase = "" if self.phase is None else f", phase={number(self.phase)}"
        return f"{self.wave}(amplitude={number(self.amplitude)}, frequency=0{phase})"


class ConstantShift(ConstantForce):
    """A support that is displaced and stands still: a `BaseMotion` with the frequency 0."""

    amplitude: Float[Array, ""] = eqx.field(metadata=quantity("length"))

    wave: ClassVar[str] = "BaseMotion"

    def in_units_of(self, force: ArrayLike, length: ArrayLike, time: ArrayLike) -> AbstractForce:
        return unchecked(ConstantShift, amplitude=self.amplitude / length, phase=self.phase)


class _Sinusoid(AbstractForce):
    """Base of forces of a single wave with an amplitude, a frequency and a phase."""

    amplitude: Float[Array, ""] = eqx.field(converter=scalar("amplitude"), metadata=FORCE)
    frequency: Float[Array, ""] = eqx.field(converter=scalar("frequency"), metadata=FREQUENCY)
    phase: Float[Array, ""] = eqx.field(converter=scalar("phase"), default=0.0, metadata=ANGLE)

    def __check_init__(self):
        self.check(type(self).__name__)

    @property
    def fastest(self) -> Array:
        return self.frequency


class Harmonic(_Sinusoid):
    """A harmonic force, amplitude cos(frequency tau + phase).

    Args:
        amplitude: F, force over stiffness, a length.
        frequency: Angular frequency >= 0 in the time tau = omega t; 0 makes a constant force.
        phase: Phase at tau = 0, default 0.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """

    def bound(self, damping: ArrayLike) -> Array:
        return jnp.abs(self.amplitude)

    def force(self, t: Array) -> Array:
        """The force over the stiffness at the time t, any shape."""
        return self.amplitude * jnp.cos(self.frequency * t + self.phase)

    def in_units_of(self, force: ArrayLike, length: ArrayLike, time: ArrayLike) -> AbstractForce:
        amplitude, frequency = self.amplitude / force, self.frequency * time
        return unchecked(Harmonic, amplitude=amplitude, frequency=frequency, phase=self.phase)


class BaseMotion(_Sinusoid):
    """A support that moves by amplitude cos(frequency tau + phase); spring and dashpot are fixed to
    it.

    On the mass this is the force X cos(theta) - zeta Omega X sin(theta), of the amplitude X sqrt(1
    + zeta^2 Omega^2) and the phase phi + atan(zeta Omega). x1 and x2 stay in the frame of the
    ground, and so do the belts.

    Args:
        amplitude: X, a length.
        frequency: Angular frequency Omega >= 0 in the time tau; 0: a support that is displaced.
        phase: phi, default 0.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """

    amplitude: Float[Array, ""] = eqx.field(
        converter=scalar("amplitude"), metadata=quantity("length")
    )

    def bound(self, damping: ArrayLike) -> Array:
        return jnp.abs(self.amplitude) * jnp.sqrt(1 + (damping * self.frequency) ** 2)

    def force(self, t: Array, damping: ArrayLike = 0.0) -> Array:
        """The force over the stiffness at the time t, any shape, on a mass with that damping."""
        angle = self.frequency * t + self.phase
        return self.amplitude * (jnp.cos(angle) - damping * self.frequency * jnp.sin(angle))

    def on_mass(self, t: Array, damping: Array) -> Array:
        return self.force(t, damping)

    def in_units_of(self, force: ArrayLike, length: ArrayLike, time: ArrayLike) -> AbstractForce:
        amplitude, frequency = self.amplitude / length, self.frequency * time
        return unchecked(BaseMotion, amplitude=amplitude, frequency=frequency, phase=self.phase)


class Oscillating(_Wave):
    """An oscillating velocity or load of a belt: mean + amplitude cos(frequency tau + phase).

    Args:
        mean: Mean value.
        amplitude: Amplitude, in the same unit.
        frequency: Angular frequency >= 0 in the time tau; 0 makes a constant.
        phase: Phase at tau = 0, default 0.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """

    # Mean and amplitude have the dimension of what oscillates.
    mean: Float[Array, ""] = eqx.field(converter=scalar("mean"))
    amplitude: Float[Array, ""] = eqx.field(converter=scalar("amplitude"))
    frequency: Float[Array, ""] = eqx.field(converter=scalar("frequency"), metadata=FREQUENCY)
    phase: Float[Array, ""] = eqx.field(converter=scalar("phase"), default=0.0, metadata=ANGLE)

    def __check_init__(self):
        self.check("Oscillating")

    def value(self, t: Array) -> Array:
        """The value at the time t, any shape."""
        return self.mean + self.amplitude * jnp.cos(self.frequency * t + self.phase)

    def rate(self, t: Array) -> Array:
        """Time derivative of the value at the time t."""
        return -self.amplitude * self.frequency * jnp.sin(self.frequency * t + self.phase)

    def derivative(self, t: Array, order: int) -> Array:
        """Time derivative of the value of this order, 1 or more, at the time t."""
        angle = self.frequency * t + self.phase + order * 0.5 * jnp.pi
        return self.amplitude * self.frequency**order * jnp.cos(angle)

    def integral(self, start: Array, duration: Array) -> Array:
        """Integral of the value over `duration` from `start` on, exact also for low frequencies."""
        half = 0.5 * self.frequency * duration
        middle = jnp.cos(self.frequency * start + half + self.phase)
        return duration * (self.mean + self.amplitude * middle * jnp.sinc(half / jnp.pi))

    def in_units_of(self, unit: ArrayLike, time: ArrayLike) -> "Oscillating":
        """The same wave in these units of its value and of time."""
        mean, amplitude, frequency = self.mean / unit, self.amplitude / unit, self.frequency * time
        fields = dict(mean=mean, amplitude=amplitude, frequency=frequency, phase=self.phase)
        return unchecked(Oscillating, **fields)

    def rules_as(self, field: str) -> list[Rule]:
        """Rules of the wave as the belt's field of this name; a load must never be negative."""
        rules = [rule._replace(field=f"{rule.field} of {field}") for rule in self.rules()]
        if field in ("load", "normal_force"):
            given = self.mean, self.amplitude
            least = Rule(f"mean of {field}", given, _is_never_negative, ">= |amplitude| = |{1}|")
            rules.append(least)
        return rules


def _is_never_negative(mean: Any, amplitude: Any) -> Any:
    return mean >= abs(amplitude)


def unchecked(kind: type, /, **fields: Any) -> Any:
    """A module made without checks, of numbers derived from the user's, which have passed them."""
    made = object.__new__(kind)
    for name, value in fields.items():
        object.__setattr__(made, name, value)
    return made


def rate_of_repeats(wave: Any) -> Array:
    """Frequency with which a wave repeats, 0 where it is constant; NaN for a user's force with the
    frequency 0, which may repeat in any way or not at all."""
    known = isinstance(wave, _Sinusoid | Oscillating)
    return wave.frequency if known else jnp.where(wave.frequency == 0, jnp.nan, wave.frequency)


def has_amplitude(wave: Any) -> Array:
    """Whether a wave's amplitude is not 0; true for a user's force, whose amplitude is unknown."""
    known = isinstance(wave, _Sinusoid | Oscillating)
    return wave.amplitude != 0 if known else jnp.asarray(True)


def _is_zero(value: Any) -> bool:
    """Whether a number is known to be 0."""
    return is_concrete(value) and bool(np.all(np.asarray(value) == 0))


def as_velocity(value: Any) -> Any:
    """`value` as the velocity of a belt: an array, or `Oscillating`; or a `ValueError`."""
    return number_or_oscillating(value, "velocity")


def as_load(value: Any) -> Any:
    """`value` as the load of a belt: an array, or `Oscillating`; or a `ValueError`."""
    return number_or_oscillating(value, "load")


def number_or_oscillating(value: Any, field: str) -> Any:
    """`value` as an array, or `Oscillating`; or a `ValueError`."""
    if not isinstance(value, Oscillating):
        is_other = isinstance(value, eqx.Module) and not eqx.is_array(value)
        require_value(not is_other, field, "a number or jb.Oscillating(...)", value)
        return as_array(value, field)
    if not _is_zero(value.frequency):
        return value
    return as_array(value.mean + value.amplitude * _cosine(value.phase), field)


def _cosine(phase: Array) -> Array:
    if not is_concrete(phase):
        return jnp.cos(phase)
    with jax.ensure_compile_time_eval():
        return jnp.cos(phase)


def as_forcing(forcing: Any) -> tuple[AbstractForce, ...]:
    """The forces as a tuple, those of frequency 0 as `ConstantForce`; or a `ValueError`."""
    expected = "a force such as jb.Harmonic(...), or a tuple of them"
    if isinstance(forcing, AbstractForce):
        forcing = (forcing,)
    fits = isinstance(forcing, Iterable) and not isinstance(forcing, str | dict | eqx.Module)
    require_value(fits, "forcing", expected, forcing)
    forces: tuple[Any, ...] = tuple(forcing)
    for i, force in enumerate(forces):
        name = f"forcing[{i}]"
        require_value(isinstance(force, AbstractForce), name, expected, force)
        _check_force(force)
    return tuple(map(_without_frequency, forces))


def _without_frequency(force: AbstractForce) -> AbstractForce:
    if not isinstance(force, _Sinusoid) or not _is_zero(force.frequency):
        return force
    phase = None if _is_zero(force.phase) else force.phase
    kind = ConstantShift if isinstance(force, BaseMotion) else ConstantForce
    return unchecked(kind, amplitude=force.amplitude, phase=phase)


#: Classes of users' forces whose `force` was traced without error.
_traced_forces: set[type] = set()


def _check_force(force: AbstractForce) -> None:
    """Raises a `ValueError` if a user's `force` cannot be traced, once for each class."""
    kind = type(force)
    if kind.__module__ == __name__ or kind in _traced_forces:
        return
    frequency = getattr(force, "frequency", None)
    fits = eqx.is_array(frequency) or isinstance(frequency, float | int)
    require_value(fits, f"frequency of {kind.__name__}", "a number", frequency)
    time = jax.ShapeDtypeStruct((), jnp.float64)

    def at_a_time() -> Any:
        return jax.eval_shape(force.force, time)

    found = traceable(at_a_time, f"force of {kind.__name__}", "a function of the time")
    require_one_float(found, f"force of {kind.__name__}", "a function that returns one float64")
    _traced_forces.add(kind)
