"""What the commands share: options that describe an oscillator, errors in one sentence.

Neither this module nor those of the commands import what computes before it is used. So help, and
mistakes in the options, are told at once.
"""

import functools
import json
import math
import os
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

import jaxbelt as jb

from ..spelling import did_you_mean

#: The arguments of the four classes of the paper, and what they are unless given.
CLASSES = {
    "a": {"nu0": 0.2},
    "b": {"nu0": 0.45, "nu1": 0.35},
    "c": {"nu0": 0.2, "nu1": 0.4, "sigma": 0.8},
    "d": {"nu0": 0.2, "nu1": 0.4, "sigma0": 0.5, "sigma1": 1.0},
}
#: The friction laws by name: their classes, and what their arguments are unless given.
LAWS: dict[str, tuple[str, dict[str, float | None]]] = {
    "conti": ("Conti", {"static": 1.0, "residual": 0.6, "steepness": 10.0, "quadratic": 0.0}),
    "coulomb": ("Coulomb", {"static": None, "kinetic": None}),
    "stribeck": ("Stribeck", {"static": None, "kinetic": None, "stribeck_velocity": None}),
}


@contextmanager
def plain_errors() -> Iterator[None]:
    """What a user did wrong is told in its one sentence, with exit code 2; an interrupt, with the
    shells' 130."""
    try:
        with _interrupts_that_count():
            yield
    except KeyboardInterrupt as error:
        typer.secho(str(error) or "interrupted", err=True, fg=typer.colors.RED)
        # At once: an exit by an exception would wait for a compilation under way.
        sys.stdout.flush()
        os._exit(130)
    except (ValueError, OSError) as error:
        typer.secho(f"Error: {error}", err=True, fg=typer.colors.RED)
        raise typer.Exit(2) from None


#: Seconds that what computes has to end, and to tell what became of it, after an interrupt.
GRACE = 2.0


@contextmanager
def _interrupts_that_count() -> Iterator[None]:
    """Ends the process after an interrupt that Python does not hear of, as it does not while the
    main thread compiles."""
    if threading.current_thread() is not threading.main_thread():
        yield  # which hears of no signals
        return
    hears, told = socket.socketpair()
    told.setblocking(False)
    before = signal.set_wakeup_fd(told.fileno(), warn_on_full_buffer=False)

    def watch() -> None:
        while number := hears.recv(1):
            if number[0] == signal.SIGINT:
                time.sleep(GRACE)
                print("interrupted", file=sys.stderr, flush=True)
                os._exit(130)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        told.close()  # which ends what watches
        watcher.join(GRACE / 10)
        hears.close()


def turn_on_float64() -> None:
    """What every command does before it computes: the package itself never touches JAX's settings,
    a program of its own may."""
    import jax

    jax.config.update("jax_enable_x64", True)


def outputs(out: Path, *ends: str) -> list[Path]:
    """The files that `out` stands for, if they can be written; asked before the computing."""
    paths = [out.with_name(out.name + end) for end in ends]
    for path in paths:
        check_out(path)
    return paths


def check_out(out: Path) -> None:
    """Raise unless a file can be written there; folders on the way are made later."""
    if out.is_dir():
        raise IsADirectoryError(f"out must be a file, got the folder {out}")
    there = next(folder for folder in out.absolute().parents if folder.exists())
    try:
        if out.exists() and not os.access(out, os.W_OK):
            raise PermissionError
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError:
        raise OSError(f"out must be a place that can be written to, got {out}") from None


def check_number(name: str, value: float) -> None:
    """Raise unless a number is finite and > 0, as what computes does, but before it is imported."""
    if not 0 < value < math.inf:
        raise ValueError(f"{name} must be finite and > 0, got {value}")


#: The largest tolerance of a step. Beyond, what comes out is no motion of the oscillator.
LOOSEST = 1e-2


def tolerances(value: float | None) -> dict[str, float]:
    """The arguments rtol and atol for the option `--tolerance`; none, where it is not given.

    Raises:
        ValueError: If an integrator cannot be asked for it.
    """
    if value is None:
        return {}
    if not 0 < value <= LOOSEST:
        raise ValueError(f"tolerance must be > 0 and at most {LOOSEST}, got {value}")
    return {"rtol": value, "atol": value}


def check_range(name: str, ends: tuple[float, float]) -> None:
    """Raise unless an option FROM TO is an interval."""
    first, last = ends
    if not -math.inf < first < last < math.inf:
        raise ValueError(f"{name} must be FROM TO with FROM < TO, got {first} {last}")


def make_console() -> Console:
    """A console; in a file, which has no width, lines are not folded."""
    console = Console()
    return console if console.is_terminal else Console(width=200)


def say(
    console: Console,
    lines: Iterable[str],
    written: Iterable[Path],
    *,
    as_json: bool = False,
    data: dict[str, Any] | None = None,
) -> None:
    """Print lines as they are, and which files were written; or `data`, with these, as JSON."""
    if as_json:
        print(json.dumps({**(data or {}), "written": [str(path) for path in written]}))
        return
    told = ", ".join(map(str, written))
    for line in (*lines, *([f"Written: {told}"] if told else [])):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def as_json_value(value: Any) -> Any:
    """A number, or an array of them, as JSON has it: what is not finite is null."""
    import numpy as np

    def one(x: Any) -> Any:
        return [one(part) for part in x] if isinstance(x, list) else x if np.isfinite(x) else None

    return one(np.asarray(value).tolist())


def _of_classes(name: str) -> str:
    """The defaults of an argument of the classes, for the help."""
    values: dict[float, list[str]] = {}
    for system, arguments in CLASSES.items():
        if name in arguments:
            values.setdefault(arguments[name], []).append(system)
    return "; ".join(f"{value} in {', '.join(names)}" for value, names in values.items())


def _argument(name: str, text: str) -> Any:
    return typer.Option(help=text, show_default=_of_classes(name))


Class = Annotated[str, typer.Option("--class", help="The paper's class of contact: a, b, c or d.")]
Nu0 = Annotated[float | None, _argument("nu0", "Velocity of belt 0.")]
Nu1 = Annotated[float | None, _argument("nu1", "Velocity of belt 1 (classes b, c, d).")]
Sigma = Annotated[float | None, _argument("sigma", "Edge between the belts (class c).")]
Sigma0 = Annotated[float | None, _argument("sigma0", "Where belt 1 begins (class d).")]
Sigma1 = Annotated[float | None, _argument("sigma1", "Where belt 0 ends (class d).")]
Belts = Annotated[
    list[str] | None,
    typer.Option(
        "--belt",
        help="A belt in full, instead of a class; give it once a belt. A velocity, then "
        "name=value with commas between: load, lower, upper (its contact interval), law.",
        show_default="the belts of the class",
    ),
]
Damping = Annotated[float, typer.Option(help="zeta = c / sqrt(k m).")]
Omega = Annotated[float, typer.Option(help="sqrt(k / m).")]
Json = Annotated[
    bool, typer.Option("--json", help="Print the results as one line of JSON, for scripts.")
]


def oscillator(
    system: str = "b",
    belt: Sequence[str] | None = None,
    damping: Any = 0.5,
    omega: Any = 1.0,
    **values: Any,
) -> "jb.Oscillator":
    """The oscillator that the options describe: a class with its arguments, or belts in full.

    values: arguments of the class and `parameters`, by name; None for one that is not given.
    """
    arguments = {} if belt else CLASSES[system]
    named = {name: value for name, value in values.items() if name in arguments}
    belts = tuple(map(parse_belt, belt)) if belt else belts_of_class(system, named)
    from ..model.oscillator import Oscillator

    osc, paths = Oscillator(damping, belts, omega), parameters(system, belt)
    others = _given({name: value for name, value in values.items() if name not in arguments})
    return _with(osc, {paths[name]: value for name, value in others.items()}) if others else osc


def _with(osc: "jb.Oscillator", values: dict[str, Any]) -> "jb.Oscillator":
    """The oscillator with the parameters of these paths set."""
    import jax

    from ..checks import as_array
    from ..model.parameters import names_of

    leaves, structure = jax.tree.flatten(osc)
    places = names_of(osc)
    for path, value in values.items():
        leaves[places.index(path)] = as_array(value, path)
    changed: jb.Oscillator = jax.tree.unflatten(structure, leaves)
    changed.check()
    return changed


def parameters(system: str, belt: Sequence[str] | None = None) -> dict[str, str]:
    """The parameters of what is described: their short names, where they have one, and their paths
    in the oscillator, such as belts[1].friction.steepness; each with its path."""
    laws = [_parts_of_belt(text)[1] for text in belt or ()]
    if not laws:
        laws = [LAWS["conti"][1]] * (1 if system == "a" else 2)
    short = {f"nu{i}": f"belts[{i}].velocity" for i in range(len(laws))} | {"zeta": "damping"}
    paths = ["damping", "omega"]
    for i, law in enumerate(laws):
        fields = ("velocity", *(f"friction.{name}" for name in law), "load", "lower", "upper")
        paths += [f"belts[{i}].{field}" for field in fields]
    return short | {path: path for path in paths}


def check_description(
    system: str, arguments: dict[str, float | None], belt: Sequence[str] | None = None
) -> None:
    """Raise unless these options describe belts; numbers are left to the classes themselves."""
    given = _given(arguments)
    if belt:
        if given:
            raise ValueError(f"with --belt no class must be described, got {', '.join(given)}")
        for text in belt:
            _parts_of_belt(text)
        return
    check_class(system)
    names = CLASSES[system]
    for name in given:
        if name not in names:
            raise ValueError(f"class {system} must have only {', '.join(names)}, got {name}")


def _given(arguments: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in arguments.items() if value is not None}


def check_class(system: str) -> None:
    """Raise unless it is one of the paper's classes."""
    if system not in CLASSES:
        raise ValueError(f"class must be a, b, c or d, got {system}")


def check_axis_names(
    system: str,
    axes: Iterable[str],
    others: tuple[str, ...] = (),
    belt: Sequence[str] | None = None,
) -> None:
    """Raise unless all axes are arguments of the class or parameters of what is described, or
    among other names, and come once."""
    check_description(system, {}, belt)
    paths = parameters(system, belt)
    names, seen = (*({} if belt else CLASSES[system]), *paths, *others), set()
    for name in axes:
        if name not in names:
            known = names_in_words((*({} if belt else CLASSES[system]), *others), paths)
            meant = did_you_mean(name, names)
            raise ValueError(f"axes must be {known}, got {name}{meant}")
        if paths.get(name, name) in seen:
            raise ValueError(f"axes must be different ones, got {name} twice")
        seen.add(paths.get(name, name))


def names_in_words(names: Iterable[str], paths: dict[str, str]) -> str:
    """What a parameter may be called: a short name, or one of many paths."""
    short = dict.fromkeys([*names, *(name for name, path in paths.items() if name != path)])
    one = next(path for path in paths if ".friction." in path)
    return f"one of {', '.join(short)}, or a path such as {one} or belts[0].load"


def family(
    system: str,
    arguments: dict[str, float | None],
    belt: Sequence[str] | None,
    damping: float,
    omega: float,
    axes: Iterable[str],
) -> "Callable[..., jb.Oscillator]":
    """What is described as a function of its axes; its text, which datasets keep, can be run."""
    given, axes = _given(arguments), tuple(axes)
    if belt:
        return functools.partial(oscillator, belt=tuple(belt), damping=damping, omega=omega)
    fixed = {k: v for k, v in (CLASSES[system] | given).items() if k not in axes}
    if (damping, omega) == (0.5, 1.0) and CLASSES[system].keys() >= set(axes):
        make = getattr(jb.presets, f"class_{system}")
        return functools.partial(make, **fixed) if fixed else make
    return functools.partial(oscillator, system, damping=damping, omega=omega, **fixed)


def belts_of_class(system: str, arguments: dict[str, Any]) -> "tuple[jb.Belt, ...]":
    """The belts of a class of the paper, with the arguments that are given."""
    from .. import presets

    make = getattr(presets, f"class_{system}")
    return make(**CLASSES[system] | _given(arguments)).belts


def parse_belt(text: str) -> "jb.Belt":
    """The belt that a text such as `0.3,load=0.5,law=coulomb,static=0.8,kinetic=0.5` describes."""
    law, friction, numbers = _parts_of_belt(text)
    from ..model import friction as laws
    from ..model.oscillator import Belt

    return Belt(friction=getattr(laws, law)(**friction), **numbers)


def _check_numbers(text: str, friction: dict[str, float], numbers: dict[str, float]) -> None:
    """Raise where a belt or its law would refuse them, which ask only when they are imported."""

    def fits(name: str, holds: bool, expected: str, came: float) -> None:
        if not holds:
            raise ValueError(f"{name} of belt {text!r} must be {expected}, got {came}")

    ends = {"lower": -math.inf, "upper": math.inf} | numbers
    own = {name: numbers.get(name, 1.0) for name in ("velocity", "load")}
    for name, value in (*own.items(), *friction.items()):
        fits(name, math.isfinite(value), "finite", value)
    for name, value in (("load", own["load"]), *friction.items()):
        fits(name, value >= 0 or name == "quadratic", ">= 0", value)
    fits("lower", ends["lower"] < ends["upper"], f"< upper = {ends['upper']}", ends["lower"])
    if "kinetic" in friction:
        kinetic, static = friction["kinetic"], friction["static"]
        fits("kinetic", kinetic <= static, f"<= static = {static}", kinetic)
    if "velocity" in friction:
        fits("stribeck_velocity", friction["velocity"] > 0, "> 0", friction["velocity"])


def _parts_of_belt(text: str) -> tuple[str, dict[str, float], dict[str, float]]:
    """The class of its law, and the arguments of that and of the belt."""
    velocity, *parts = text.split(",")
    words = dict.fromkeys(["velocity"], velocity)
    for part in parts:
        name, equals, value = part.partition("=")
        if not equals:
            raise ValueError(f"belt {text!r} must have name=value after its velocity, got {part!r}")
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
