"""Units in which the package gets a case: a user's, drawn for each call.

Cases are drawn, and the engine runs, in units in which sizes are of order one. The package gets the
same case in random units: lengths are multiplied by 2^-24 to 2^24 or 10^-7 to 10^7, frequencies by
2^-10 to 2^10 or 10^-3 to 10^3. Its answers are converted back.
"""

from dataclasses import dataclass, replace

import numpy as np

from jaxbelt.model.own_units import rescaled

from . import engine

#: Powers of the unit of speed by which the numbers of a law after its static limit are multiplied;
#: 0 for coefficients.
_SPEEDS = {
    "conti": (0, -1, -2),
    "coulomb": (0,),
    "stribeck": (0, 1),
    "peak": (0, 1, -1),
    "table": (-1,),
}
_NAMES = {"damping": "number", "velocity": "speed"} | dict.fromkeys(
    ("load", "lower", "upper"), "length"
)
#: Numbers of a law by the names that paths use.
_LAW = {
    "conti": ("static", "residual", "steepness", "quadratic"),
    "coulomb": ("static", "kinetic"),
    "stribeck": ("static", "kinetic", "velocity"),
}


@dataclass(frozen=True)
class Units:
    """Units of a user. length, frequency: factors by which the engine's lengths and frequencies are
    multiplied."""

    length: float = 1.0
    frequency: float = 1.0

    @property
    def speed(self) -> float:
        return self.length * self.frequency

    def given(self, osc: engine.Oscillator) -> engine.Oscillator:
        """An oscillator in the user's units."""
        if self == ENGINES:
            return osc
        return replace(
            osc, omega=osc.omega * self.frequency, belts=tuple(map(self._given_belt, osc.belts))
        )

    def _given_belt(self, belt: engine.Belt) -> engine.Belt:
        name, static, *numbers = belt.law
        scaled = [
            number * self.speed**power
            for number, power in zip(numbers, _SPEEDS[name], strict=False)
        ]
        return engine.Belt(
            belt.velocity * self.speed,
            (name, static, *scaled),
            belt.load * self.length,
            belt.lower * self.length,
            belt.upper * self.length,
        )

    def of(self, osc: engine.Oscillator, parameter: tuple[int, str]) -> float:
        """Factor by which a parameter, (belt or -1, name), is multiplied."""
        number, name = parameter
        if not name.startswith("law "):
            return {"number": 1.0, "speed": self.speed, "length": self.length}[_NAMES[name]]
        law = osc.belts[number].law[0]
        place = _LAW[law].index(name.removeprefix("law "))
        return self.speed ** (0, *_SPEEDS[law])[place]

    def back(self, result, osc):
        """A result of the package in the engine's units; osc: the oscillator in these units."""
        return result if self == ENGINES else rescaled(result, 1 / self.length, lambda _: osc)


#: Units of the engine.
ENGINES = Units()


def drawn(rng: np.random.Generator, *, exact: bool) -> Units:
    """Random units; exact: powers of two, which keep equal numbers equal and round ones round."""
    if exact or rng.random() < 0.5:
        return Units(2.0 ** int(rng.integers(-24, 25)), 2.0 ** int(rng.integers(-10, 11)))
    return Units(10.0 ** int(rng.integers(-7, 8)), float(10 ** rng.uniform(-3, 3)))
