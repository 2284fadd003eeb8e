"""Belts and forces from words of the command line, the values of `--belt` and `--force`."""

import math

import jaxbelt as jb

from ..spelling import did_you_mean

#: Friction laws by name: their classes, and the defaults of their arguments.
LAWS: dict[str, tuple[str, dict[str, float | None]]] = {
    "conti": ("Conti", {"static": 1.0, "residual": 0.6, "steepness": 10.0, "quadratic": 0.0}),
    "coulomb": ("Coulomb", {"static": None, "kinetic": None}),
    "stribeck": ("Stribeck", {"static": None, "kinetic": None, "stribeck_velocity": None}),
    "cubic": ("Cubic", {"a0": None, "a1": None, "a3": None}),
}
#: Arguments of laws that may be negative.
SIGNED = ("quadratic", "a1", "a3")


def parts_of_force(text: str) -> tuple[float, float, float]:
    """Amplitude, frequency and phase of a force such as `0.3,1.7` or `0.3,1.7,0.5`."""
    try:
        amplitude, frequency, *phase = map(float, text.split(","))
        (phase,) = phase or (0.0,)
    except ValueError:
        expected = "AMPLITUDE,FREQUENCY or AMPLITUDE,FREQUENCY,PHASE, numbers"
        raise ValueError(f"force must be {expected}, got {text!r}") from None
    if not all(map(math.isfinite, (amplitude, frequency, phase))) or frequency < 0:
        raise ValueError(f"force must be finite numbers with a frequency >= 0, got {text!r}")
    return amplitude, frequency, phase


def parse_belt(text: str) -> "jb.Belt":
    """Parses a belt such as `0.3,load=0.5,law=coulomb,static=0.8,kinetic=0.5`."""
    law, friction, numbers = parts_of_belt(text)
    from ..model import friction as laws
    from ..model.oscillator import Belt

    return Belt(friction=getattr(laws, law)(**friction), **numbers)


def _check_numbers(text: str, friction: dict[str, float], numbers: dict[str, float]) -> None:
    """Raises where `Belt` or the law would refuse these numbers, but without importing them."""

    def fits(name: str, holds: bool, expected: str, came: float) -> None:
        if not holds:
            raise ValueError(f"{name} of belt {text!r} must be {expected}, got {came}")

    ends = {"lower": -math.inf, "upper": math.inf} | numbers
    own = {name: numbers.get(name, 1.0) for name in ("velocity", "load")}
    for name, value in (*own.items(), *friction.items()):
        fits(name, math.isfinite(value), "finite", value)
    for name, value in (("load", own["load"]), *friction.items()):
        fits(name, value >= 0 or name in SIGNED, ">= 0", value)
    fits("lower", ends["lower"] < ends["upper"], f"< upper = {ends['upper']}", ends["lower"])
    if "kinetic" in friction:
        kinetic, static = friction["kinetic"], friction["static"]
        fits("kinetic", kinetic <= static, f"<= static = {static}", kinetic)
    if "velocity" in friction:
        fits("stribeck_velocity", friction["velocity"] > 0, "> 0", friction["velocity"])


def parts_of_belt(text: str) -> tuple[str, dict[str, float], dict[str, float]]:
    """Name of the class of the law, the arguments of the law, and those of the belt."""
    velocity, *parts = text.split(",")
    words = dict.fromkeys(["velocity"], velocity)
    for part in parts:
        name, equals, value = part.partition("=")
        if not equals:
            raise ValueError(f"belt {text!r} must have name=value after its velocity, got {part!r}")
        if name.strip() in words:
            raise ValueError(f"belt {text!r} must have each name once, got {name.strip()} twice")
        words[name.strip()] = value
    name_of_law = words.pop("law", "conti").strip()
    if name_of_law not in LAWS:
        meant = did_you_mean(name_of_law, LAWS)
        raise ValueError(
            f"law of belt {text!r} must be {', '.join(LAWS)}, got {name_of_law}{meant}"
        )
    law, defaults = LAWS[name_of_law]
    known = ("velocity", "load", "lower", "upper", *defaults)
    numbers: dict[str, float] = {}
    for name, word in words.items():
        if name not in known:
            meant = did_you_mean(name, known)
            raise ValueError(f"belt {text!r} must have only {', '.join(known)}, got {name}{meant}")
        try:
            numbers[name] = float(word)
        except ValueError:
            raise ValueError(f"{name} of belt {text!r} must be a number, got {word!r}") from None
    friction: dict[str, float] = {}
    for name, default in defaults.items():
        value = numbers.pop(name, default)
        if value is None:
            raise ValueError(f"belt {text!r} must have {name}, which {name_of_law} needs")
        friction[name.removeprefix("stribeck_")] = value
    _check_numbers(text, friction, numbers)
    return law, friction, numbers
