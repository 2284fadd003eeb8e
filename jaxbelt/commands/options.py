"""What the commands share: options that describe an oscillator, errors in one sentence.

Neither this module nor those of the commands import what computes before it is used. So help, and
mistakes in the options, appear at once.
"""

import functools
import inspect
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
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

import jaxbelt as jb

from ..spelling import did_you_mean

#: Arguments of the four classes of the paper, and their defaults.
CLASSES = {
    "a": {"nu0": 0.2},
    "b": {"nu0": 0.45, "nu1": 0.35},
    "c": {"nu0": 0.2, "nu1": 0.4, "sigma": 0.8},
    "d": {"nu0": 0.2, "nu1": 0.4, "sigma0": 0.5, "sigma1": 1.0},
}
#: Friction laws by name: their classes, and the defaults of their arguments.
LAWS: dict[str, tuple[str, dict[str, float | None]]] = {
    "conti": ("Conti", {"static": 1.0, "residual": 0.6, "steepness": 10.0, "quadratic": 0.0}),
    "coulomb": ("Coulomb", {"static": None, "kinetic": None}),
    "stribeck": ("Stribeck", {"static": None, "kinetic": None, "stribeck_velocity": None}),
}


@contextmanager
def plain_errors() -> Iterator[None]:
    """Prints an error of the user as its one sentence and exits with code 2.

    An interrupt exits with code 130, as in shells.
    """
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


#: Seconds that a computation has after an interrupt to end and to report on its runs.
GRACE = 2.0


@contextmanager
def _interrupts_that_count() -> Iterator[None]:
    """Ends the process after an interrupt that Python does not notice.

    Python does not notice it while the main thread compiles.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # no signals arrive in other threads
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)

    def watch() -> None:
        while number := reader.recv(1):
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
        writer.close()  # ends the watching thread
        watcher.join(GRACE / 10)
        reader.close()


def turn_on_float64() -> None:
    """Turns 64-bit floats on, before a command computes.

    The package itself never touches JAX's settings; a program may.
    """
    import jax

    jax.config.update("jax_enable_x64", True)


def outputs(out: Path, *ends: str) -> list[Path]:
    """Paths of the files that `out` stands for; raises, before anything is computed, if one
    cannot be written."""
    paths = [out.with_name(out.name + end) for end in ends]
    for path in paths:
        check_out(path)
    return paths


def check_out(out: Path) -> None:
    """Raises unless a file can be written there; missing folders are made later."""
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
    """Raises unless a number is finite and > 0, like the package itself, but before it is
    imported."""
    if not 0 < value < math.inf:
        raise ValueError(f"{name} must be finite and > 0, got {value}")


#: Largest tolerance of a step; with larger ones the result is no motion of the oscillator.
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
    """Raises unless an option FROM TO is an interval."""
    first, last = ends
    if not -math.inf < first < last < math.inf:
        raise ValueError(f"{name} must be FROM TO with FROM < TO, got {first} {last}")


def make_console() -> Console:
    """A console; in a file, which has no width, it does not fold lines."""
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
    """Prints lines and the files that were written; or `data`, with these, as JSON."""
    if as_json:
        print(json.dumps({**(data or {}), "written": [str(path) for path in written]}))
        return
    files = ", ".join(map(str, written))
    for line in (*lines, *([f"Written: {files}"] if files else [])):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def as_json_value(value: Any) -> Any:
    """A number or an array as JSON; numbers that are not finite are null."""
    import numpy as np

    def one(x: Any) -> Any:
        return [one(part) for part in x] if isinstance(x, list) else x if np.isfinite(x) else None

    return one(np.asarray(value).tolist())


def _of_classes(name: str) -> str:
    """Defaults of an argument of the classes, for the help."""
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
Forces = Annotated[
    list[str] | None,
    typer.Option(
        "--force",
        help="A harmonic force on the mass, AMPLITUDE,FREQUENCY or AMPLITUDE,FREQUENCY,PHASE, over "
        "the stiffness and in the time tau; give it once a force.",
        show_default="none",
    ),
]
Damping = Annotated[float, typer.Option(help="zeta = c / sqrt(k m).")]
Omega = Annotated[float, typer.Option(help="sqrt(k / m).")]
Json = Annotated[
    bool, typer.Option("--json", help="Print the results as one line of JSON, for scripts.")
]
Interval = tuple[float, float]
Start = Annotated[
    Interval, typer.Option(metavar="X1 X2", help="Displacement x1 and velocity x2 at tau = 0.")
]
Out = Annotated[
    Path,
    typer.Option(
        help="Where to write, without an ending: OUT.png, OUT.csv, ... Folders that are missing "
        "are made."
    ),
]


def from_to(text: str) -> Any:
    """Option of an interval, FROM TO, with this help."""
    return typer.Option(metavar="FROM TO", help=text)


@dataclass(frozen=True)
class Description:
    """Oscillator that options describe: a class of the paper with its arguments, or belts in full.

    A command that is decorated with `describes` has these options.
    """

    system: Class = "b"
    nu0: Nu0 = None
    nu1: Nu1 = None
    sigma: Sigma = None
    sigma0: Sigma0 = None
    sigma1: Sigma1 = None
    belt: Belts = None
    damping: Damping = 0.5
    omega: Omega = 1.0
    force: Forces = None

    @property
    def arguments(self) -> dict[str, float | None]:
        """Arguments of the class, None where one is not given."""
        return {name: getattr(self, name) for name in ("nu0", "nu1", "sigma", "sigma0", "sigma1")}

    @property
    def short_names(self) -> tuple[str, ...]:
        """Names of the arguments of the class; none for belts in full."""
        return () if self.belt else tuple(CLASSES[self.system])

    def check(self, **varied: float) -> None:
        """Raises unless the options describe belts; the classes themselves check numbers.

        varied: values of arguments of the class that vary.
        """
        for text in self.force or ():
            parts_of_force(text)
        given = _given(self.arguments | varied)
        if self.belt:
            if given:
                raise ValueError(f"with --belt no class must be described, got {', '.join(given)}")
            for text in self.belt:
                _parts_of_belt(text)
            return
        check_class(self.system)
        for name in given:
            if name not in self.short_names:
                known = ", ".join(self.short_names)
                raise ValueError(f"class {self.system} must have only {known}, got {name}")

    def check_axes(self, axes: Iterable[str], others: tuple[str, ...] = ()) -> None:
        """Raises unless all axes are known and different.

        Known are arguments of the class, parameters of what is described, and `others`.
        """
        self.check()
        paths = self.parameters()
        names, seen = (*self.short_names, *paths, *others), set()
        for name in axes:
            if name not in names:
                known = names_in_words((*self.short_names, *others), paths)
                raise ValueError(f"axes must be {known}, got {name}{did_you_mean(name, names)}")
            if paths.get(name, name) in seen:
                raise ValueError(f"axes must be different ones, got {name} twice")
            seen.add(paths.get(name, name))

    def parameters(self) -> dict[str, str]:
        """Paths of all parameters, by name.

        A path is the place in the oscillator, such as belts[1].friction.steepness. Parameters that
        have a short name are listed under that, too.
        """
        return _parameters(self.system, self.belt, self.force)

    def oscillator(self, **values: Any) -> "jb.Oscillator":
        """The oscillator; values: what differs from the options, as for `oscillator`."""
        given = {**self.arguments, **values}
        return oscillator(self.system, self.belt, self.damping, self.omega, self.force, **given)

    def along(self, axes: Iterable[str]) -> "Callable[..., jb.Oscillator]":
        """The oscillator as a function of its axes; the function's text, which datasets keep, can
        be run."""
        rest: dict[str, Any] = {"damping": self.damping, "omega": self.omega}
        if self.force:
            rest["force"] = tuple(self.force)
        if self.belt:
            return functools.partial(oscillator, belt=tuple(self.belt), **rest)
        axes, known = tuple(axes), CLASSES[self.system] | _given(self.arguments)
        fixed = {name: value for name, value in known.items() if name not in axes}
        if rest == {"damping": 0.5, "omega": 1.0} and known.keys() >= set(axes):
            make = getattr(jb.presets, f"class_{self.system}")
            return functools.partial(make, **fixed) if fixed else make
        return functools.partial(oscillator, self.system, **rest, **fixed)


def describes(*names: str) -> Callable:
    """Decorator of a command: options with these names stand in place of its parameter `described`.

    The command gets a `Description`. Without names all fields of one are options.
    """
    options = [
        inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=field.type
        )
        for field in fields(Description)
        if not names or field.name in names
    ]

    def decorate(command: Callable) -> Callable:
        own: list[inspect.Parameter] = []
        for name, one in inspect.signature(command).parameters.items():
            is_description = name == "described"
            own += options if is_description else [one.replace(kind=one.KEYWORD_ONLY)]

        @functools.wraps(command)
        def call(**given: Any) -> Any:
            values = {one.name: given.pop(one.name) for one in options}
            return command(described=Description(**values), **given)

        # By which typer knows the options.
        vars(call)["__signature__"] = inspect.Signature(own)
        call.__annotations__ = {one.name: one.annotation for one in own}
        return call

    return decorate


def oscillator(
    system: str = "b",
    belt: Sequence[str] | None = None,
    damping: Any = 0.5,
    omega: Any = 1.0,
    force: Sequence[str] | None = None,
    **values: Any,
) -> "jb.Oscillator":
    """The oscillator that the options describe: a class with its arguments, or belts in full.

    values: arguments of the class and parameters, by name; None for one that is not given.
    """
    arguments = {} if belt else CLASSES[system]
    named = {name: value for name, value in values.items() if name in arguments}
    from .. import presets
    from ..model.forcing import Harmonic
    from ..model.oscillator import Oscillator

    if belt:
        belts = tuple(map(parse_belt, belt))
    else:
        belts = getattr(presets, f"class_{system}")(**CLASSES[system] | _given(named)).belts
    forcing = tuple(Harmonic(*parts_of_force(text)) for text in force or ())
    osc, paths = Oscillator(damping, belts, omega, forcing), _parameters(system, belt, force)
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


def _parameters(
    system: str, belt: Sequence[str] | None, force: Sequence[str] | None = None
) -> dict[str, str]:
    """See `Description.parameters`."""
    laws = [_parts_of_belt(text)[1] for text in belt or ()]
    if not laws:
        laws = [LAWS["conti"][1]] * (1 if system == "a" else 2)
    short = {f"nu{i}": f"belts[{i}].velocity" for i in range(len(laws))} | {"zeta": "damping"}
    paths = ["damping", "omega"]
    for i, law in enumerate(laws):
        fields = ("velocity", *(f"friction.{name}" for name in law), "load", "lower", "upper")
        paths += [f"belts[{i}].{field}" for field in fields]
    for i, text in enumerate(force or ()):
        # A force of frequency 0 is constant.
        waves = ("amplitude", "frequency", "phase") if parts_of_force(text)[1] else ("amplitude",)
        paths += [f"forcing[{i}].{field}" for field in waves]
    return short | {path: path for path in paths}


def _given(arguments: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in arguments.items() if value is not None}


def check_class(system: str) -> None:
    """Raises unless it is one of the paper's classes."""
    if system not in CLASSES:
        raise ValueError(f"class must be a, b, c or d, got {system}")


def names_in_words(names: Iterable[str], paths: dict[str, str]) -> str:
    """Possible names of a parameter: the short ones, or one of many paths."""
    short = dict.fromkeys([*names, *(name for name, path in paths.items() if name != path)])
    one = next(path for path in paths if ".friction." in path)
    return f"one of {', '.join(short)}, or a path such as {one} or belts[0].load"


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
    law, friction, numbers = _parts_of_belt(text)
    from ..model import friction as laws
    from ..model.oscillator import Belt

    return Belt(friction=getattr(laws, law)(**friction), **numbers)


def _check_numbers(text: str, friction: dict[str, float], numbers: dict[str, float]) -> None:
    """Raises where a belt or its law would refuse these numbers; these check only once imported."""

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
    """Class of the law, its arguments, and those of the belt."""
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
