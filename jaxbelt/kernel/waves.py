"""Forces, velocities and loads at the times of a step's stages, without a cosine for each.

Over a step of size h a wave A cos(Omega t + phi) turns by the angle x = Omega h. Its cosine and
sine in the middle of the step are computed once; at the fraction c of the step the wave is

    A (cos(middle) cos((c - 1/2) x) - sin(middle) sin((c - 1/2) x)),

where the cosine and the sine of the small angle (c - 1/2) x are polynomials with fixed
coefficients. So are the integrals of waves, for small frequencies, too. Forces of the user's own
classes are evaluated at each time.
"""

from collections.abc import Sequence
from math import factorial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..model.forcing import (
    AbstractForce,
    BaseMotion,
    ConstantForce,
    Harmonic,
    Oscillating,
    unchecked,
)
from ..model.modes import Mode, foremost
from ..model.oscillator import Belt, MovingBelt, Oscillator
from .lanes import materialise

#: Terms of cosines and sines of half the angle of a step, which is 3/4 or less: the next one is
#: 1e-14.
TERMS = 7
#: pi/2 in three parts: multiples of the first two, by whole numbers of 20 bits, are exact.
_QUARTER = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)


@jax.custom_jvp
def cosine_and_sine(angle: Array) -> tuple[Array, Array]:
    """Cosine and sine of angles up to some 1e6, at a fraction of the cost of XLA's."""
    quarters = jnp.round(angle * (2 / np.pi))
    x = angle
    for part in _QUARTER:
        x = x - quarters * part
    y = x * x
    cosine = _even(y, [(-1) ** k / factorial(2 * k) for k in range(9)])
    sine = x * _even(y, [(-1) ** k / factorial(2 * k + 1) for k in range(9)])
    odd = quarters - 2 * jnp.floor(0.5 * quarters) > 0.5
    half = jnp.floor(0.5 * quarters)
    sign = jnp.where(half - 2 * jnp.floor(0.5 * half) > 0.5, -1.0, 1.0)
    return jnp.where(odd, -sine, cosine) * sign, jnp.where(odd, cosine, sine) * sign


@cosine_and_sine.defjvp
def _(primals, tangents):
    (angle,), (turn,) = primals, tangents
    cosine, sine = cosine_and_sine(angle)
    return (cosine, sine), (-sine * turn, cosine * turn)


def _even(y: Array, coefficients: Sequence[float]) -> Array:
    """A polynomial in y, the lowest order first."""
    total: Any = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        total = total * y + c
    return total


def turn_of(osc: Oscillator, force: AbstractForce) -> Array | None:
    """The `turn` of a `BaseMotion`, a wave cos u - turn sin u on the mass; None for a cosine."""
    return osc.damping * force.frequency if isinstance(force, BaseMotion) else None


def along_and_across(angle: Array, turn: Array | None) -> tuple[Array, Array]:
    """cos u - turn sin u at the angle u, and minus its derivative; see `turn_of`.

    As one cosine it would have the phase arctan(turn), which XLA left out of some programs for the
    CPU (jaxlib 0.10.2).
    """
    cosine, sine = cosine_and_sine(angle)
    if turn is None:
        return cosine, sine
    return cosine - turn * sine, sine + turn * cosine


class StepWave(NamedTuple):
    """mean + along cos(u) - across sin(u), u = (c - 1/2) x, at the fraction c of a step; x: the
    angle of the step, frequency: the angle per unit of time."""

    mean: Array | float
    along: Array
    across: Array
    x: Array
    frequency: Array

    def at(self, c: float) -> Array:
        """Its value at the fraction c of the step."""
        u, y = c - 0.5, self.x * self.x
        cosine = _even(y, [(-1) ** k * u ** (2 * k) / factorial(2 * k) for k in range(TERMS + 1)])
        odd = [(-1) ** k * u ** (2 * k + 1) / factorial(2 * k + 1) for k in range(TERMS)]
        return self.mean + self.along * cosine - self.across * (self.x * _even(y, odd))

    def rate(self, c: float) -> Array:
        """Its time derivative at the fraction c of the step."""
        turned = StepWave(0.0, -self.across, self.along, self.x, self.frequency)
        return self.frequency * turned.at(c)

    def integral(self, c: float, h: Array) -> Array:
        """Its integral over the first fraction c of the step of size h."""
        u, y = (-0.5, c - 0.5), self.x * self.x

        def power(n: int) -> float:
            return (u[1] ** n - u[0] ** n) / factorial(n)

        cosine = _even(y, [(-1) ** k * power(2 * k + 1) for k in range(TERMS + 1)])
        odd = [(-1) ** k * power(2 * k + 2) for k in range(TERMS)]
        return h * (self.mean * c + self.along * cosine - self.across * (self.x * _even(y, odd)))


class _Constant(NamedTuple):
    value: Array

    def at(self, c: float) -> Array:
        return self.value

    def rate(self, c: float) -> Array:
        return jnp.zeros_like(self.value)

    def integral(self, c: float, h: Array) -> Array:
        return c * h * self.value


class StepClock(NamedTuple):
    """All of an oscillator that depends on the time, in a step of size h from t on.

    forces: waves and constants, on the mass; others: forces of the user's own classes.
    """

    osc: Oscillator
    t: Array
    h: Array
    ones: Array
    forces: list[Any]
    others: list[AbstractForce]
    velocities: list[Any]
    loads: list[Any]

    @classmethod
    def of(cls, osc: Oscillator, ones: Array, t: Array, h: Array) -> "StepClock":
        """The clock of the lanes' next steps."""
        middle = t + 0.5 * h

        def wave(mean, amplitude, frequency, phase, turn=None):
            along, across = along_and_across(frequency * middle + phase, turn)
            along = materialise(amplitude * along, ones)
            across = materialise(amplitude * across, ones)
            return StepWave(mean, along, across, materialise(frequency * h, ones), frequency)

        forces, others = [], []
        for one in osc.forcing:
            if isinstance(one, ConstantForce):
                forces.append(_Constant(one.push))
            elif isinstance(one, Harmonic | BaseMotion):
                turn = turn_of(osc, one)
                forces.append(wave(0.0, one.amplitude, one.frequency, one.phase, turn))
            else:
                others.append(one)

        def part(value):
            if not isinstance(value, Oscillating):
                return _Constant(value)
            return wave(value.mean, value.amplitude, value.frequency, value.phase)

        velocities = [part(belt.velocity) for belt in osc.belts]
        loads = [part(belt.load) for belt in osc.belts]
        return cls(osc, t, h, ones, forces, others, velocities, loads)

    def at(self, c: float) -> Oscillator:
        """The oscillator as it is at the fraction c of the step, without a clock."""
        pushes = [force.at(c) for force in self.forces]
        time = self.t + c * self.h
        for force in self.others:
            pushes.append(materialise(force.on_mass(time, self.osc.damping), self.ones))
        rows = zip(self.osc.belts, self.velocities, self.loads, strict=True)
        belts = tuple(_belt(belt, v, load, c) for belt, v, load in rows)
        forcing = tuple(unchecked(ConstantForce, amplitude=push, phase=None) for push in pushes)
        damping, omega = self.osc.damping, self.osc.omega
        return unchecked(Oscillator, damping=damping, belts=belts, omega=omega, forcing=forcing)

    def carried(self, mode: Mode, x1: Array, c: float) -> tuple[Array, Array]:
        """The state (x1, x2) of a mass that sticks, at the fraction c of the step."""
        ways = [v.integral(c, self.h) for v in self.velocities]
        speeds = [v.at(c) for v in self.velocities]
        if len(ways) == 1:
            return x1 + ways[0] / self.osc.omega, speeds[0] / self.osc.omega
        rows = [jnp.broadcast_to(x, x1.shape) for x in (*ways, *speeds)]
        n, zero = len(ways), jnp.zeros_like(x1)
        # In the middle of the step, so that the choice of the belt does not depend on c.
        osc = self.at(0.5)
        way, speed = (foremost(osc, mode.stuck, x, zero) for x in (rows[:n], rows[n:]))
        return x1 + way / self.osc.omega, speed / self.osc.omega


def _belt(belt: Belt, velocity: Any, load: Any, c: float) -> Belt:
    moves = isinstance(velocity, StepWave)
    fields = vars(belt) | dict(velocity=velocity.at(c), load=load.at(c))
    if moves:
        fields["rate"] = velocity.rate(c)
    return unchecked(MovingBelt if moves else Belt, **fields)
