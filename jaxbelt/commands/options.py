"""What the commands share: options that describe an oscillator, errors in one sentence."""

import functools
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

import jaxbelt as jb

#: The arguments of the four classes of the paper, and what they are unless given.
CLASSES = {
    "a": {"nu0": 0.2},
    "b": {"nu0": 0.45, "nu1": 0.35},
    "c": {"nu0": 0.2, "nu1": 0.4, "sigma": 0.8},
    "d": {"nu0": 0.2, "nu1": 0.4, "sigma0": 0.5, "sigma1": 1.0},
}
#: The friction laws by name, and what their arguments are unless given.
LAWS: dict[str, tuple[type[jb.AbstractFriction], dict[str, float | None]]] = {
    "conti": (jb.Conti, {"static": 1.0, "residual": 0.6, "steepness": 10.0, "quadratic": 0.0}),
    "coulomb": (jb.Coulomb, {"static": None, "kinetic": None}),
    "stribeck": (jb.Stribeck, {"static": None, "kinetic": None, "stribeck_velocity": None}),
}


@contextmanager
def plain_errors() -> Iterator[None]:
    """What a user did wrong is told in its one sentence, with exit code 2; an interrupt, with the
    shells' 130."""
    try:
        yield
    except KeyboardInterrupt as error:
        typer.secho(str(error) or "interrupted", err=True, fg=typer.colors.RED)
        # At once: an exit by an exception would wait for a compilation under way.
        sys.stdout.flush()
        os._exit(130)
    except (ValueError, OSError) as error:
        typer.secho(f"Error: {error}", err=True, fg=typer.colors.RED)
        raise typer.Exit(2) from None


def check_out(out: Path) -> None:
    """Raise unless a file can be written there; before the computing, not after."""
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.is_dir():
        raise IsADirectoryError(f"out must be a file, got the folder {out}")
    if not os.access(out if out.exists() else out.parent, os.W_OK):
        raise PermissionError(f"out must be a place that can be written to, got {out}")


def make_console() -> Console:
    """A console; in a file, which has no width, lines are not folded."""
    console = Console()
    return console if console.is_terminal else Console(width=200)


def say(console: Console, lines: Iterable[str], written: Iterable[Path]) -> None:
    """Print lines as they are, and which files were written."""
    for line in (*lines, f"Written: {', '.join(map(str, written))}"):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


Class = Annotated[str, typer.Option("--class", help="The paper's class of contact: a, b, c or d.")]
Nu0 = Annotated[float | None, typer.Option(help="Velocity of belt 0.")]
Nu1 = Annotated[float | None, typer.Option(help="Velocity of belt 1 (classes b, c, d).")]
Sigma = Annotated[float | None, typer.Option(help="Edge between the belts (class c).")]
Sigma0 = Annotated[float | None, typer.Option(help="Where belt 1 begins (class d).")]
Sigma1 = Annotated[float | None, typer.Option(help="Where belt 0 ends (class d).")]
Belts = Annotated[
    list[str] | None,
    typer.Option(
        "--belt",
        help="A belt in full, instead of a class; give it once a belt. A velocity, then "
        "name=value with commas between: load, lower, upper (its contact interval), law.",
    ),
]
Damping = Annotated[float, typer.Option(help="zeta = c / sqrt(k m).")]
Omega = Annotated[float, typer.Option(help="sqrt(k / m).")]


def oscillator(system, arguments, belt, damping, omega) -> jb.Oscillator:
    """The oscillator that the options describe: a class with its arguments, or belts in full."""
    given = {name: value for name, value in arguments.items() if value is not None}
    belts = belts_of_class(system, given) if not belt else _belts_in_full(belt, given)
    return jb.Oscillator(damping, belts, omega)


def class_along(
    system: str, axes: Iterable[str], others: tuple[str, ...] = ()
) -> Callable[..., jb.Oscillator]:
    """A class as a function of its arguments that are axes; others: further names of axes."""
    if system not in CLASSES:
        raise ValueError(f"class must be a, b, c or d, got {system}")
    names = (*CLASSES[system], *others)
    for name in axes:
        if name not in names:
            raise ValueError(f"axes of class {system} must be among {', '.join(names)}, got {name}")
    fixed = {name: value for name, value in CLASSES[system].items() if name not in axes}
    return functools.partial(getattr(jb.presets, f"class_{system}"), **fixed)


def belts_of_class(system: str, given: dict[str, float]) -> tuple[jb.Belt, ...]:
    """The belts of a class of the paper, with the arguments that are given."""
    if system not in CLASSES:
        raise ValueError(f"class must be a, b, c or d, got {system}")
    arguments = CLASSES[system]
    for name in given:
        if name not in arguments:
            raise ValueError(f"class {system} must have only {', '.join(arguments)}, got {name}")
    make = getattr(jb.presets, f"class_{system}")
    return make(**{**arguments, **given}).belts


def _belts_in_full(texts: list[str], given: dict[str, float]) -> list[jb.Belt]:
    if given:
        raise ValueError(f"with --belt no class must be described, got {', '.join(given)}")
    return [parse_belt(text) for text in texts]


def parse_belt(text: str) -> jb.Belt:
    """The belt that a text such as `0.3,load=0.5,law=coulomb,static=0.8,kinetic=0.5` describes."""
    velocity, *parts = text.split(",")
    words = dict.fromkeys(["velocity"], velocity)
    for part in parts:
        name, equals, value = part.partition("=")
        if not equals:
            raise ValueError(f"belt {text!r} must have name=value after its velocity, got {part!r}")
        words[name.strip()] = value
    name_of_law = words.pop("law", "conti").strip()
    if name_of_law not in LAWS:
        raise ValueError(f"law of belt {text!r} must be {', '.join(LAWS)}, got {name_of_law}")
    law, defaults = LAWS[name_of_law]
    known = ("velocity", "load", "lower", "upper", *defaults)
    numbers: dict[str, Any] = {}
    for name, word in words.items():
        if name not in known:
            raise ValueError(f"belt {text!r} must have only {', '.join(known)}, got {name}")
        try:
            numbers[name] = float(word)
        except ValueError:
            raise ValueError(f"{name} of belt {text!r} must be a number, got {word!r}") from None
    friction = {}
    for name, default in defaults.items():
        friction[name.removeprefix("stribeck_")] = numbers.pop(name, default)
        if friction[name.removeprefix("stribeck_")] is None:
            raise ValueError(f"belt {text!r} must have {name}, which {name_of_law} needs")
    return jb.Belt(friction=law(**friction), **numbers)
