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
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

import jaxbelt as jb

from ..spelling import did_you_mean
from .belts import LAWS, parse_belt, parts_of_belt, parts_of_force
from .files import FromFile, changed, oscillator_of, read_file

#: Arguments of the four classes of the paper, and their defaults.
CLASSES = {
    "a": {"nu0": 0.2},
    "b": {"nu0": 0.45, "nu1": 0.35},
    "c": {"nu0": 0.2, "nu1": 0.4, "sigma": 0.8},
    "d": {"nu0": 0.2, "nu1": 0.4, "sigma0": 0.5, "sigma1": 1.0},
}
#: Arguments of classes that are edges: of two belts, or of one.
EDGES = ("sigma", "sigma0", "sigma1")


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
    if not out.name:
        raise ValueError(f"out must be the beginning of files' names, got {str(out)!r}")
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


def check_least(name: str, value: int, least: int) -> None:
    """Raises unless an integer is as large as that, or larger."""
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value}")


def check_word(name: str, word: str, known: Collection[str]) -> None:
    """Raises unless a word is one of those that are known; suggests one."""
    if word not in known:
        meant = did_you_mean(word, known)
        raise ValueError(f"{name} must be one of {', '.join(known)}, got {word}{meant}")


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


def steps_bar(console: Console, width: int, hidden: bool) -> Progress:
    """A bar of steps with their names, of a width in letters."""
    name = TextColumn(f"{{task.description:<{width}}}")
    columns = name, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    return Progress(*columns, console=console, disable=hidden)


def say(
    lines: Iterable[str], written: Iterable[Path] = (), *, as_json: bool, data: dict[str, Any]
) -> None:
    """Prints lines and the files that were written; or `data`, with these, as JSON."""
    if as_json:
        print(json.dumps({**data, "written": [str(path) for path in written]}))
        return
    console, files = make_console(), ", ".join(map(str, written))
    for line in (*lines, *([f"Written: {files}"] if files else [])):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def picture(path: Path, width: float, height: float) -> Iterator[Any]:
    """An empty figure in the style of a journal, size in inches; it is written once drawn."""
    from ..plotting.style import journal_figure, journal_style, save

    with journal_style():
        figure = journal_figure(width, height)
        yield figure
        path.parent.mkdir(parents=True, exist_ok=True)
        save(figure, path)


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


def option(text: str, default: str) -> Any:
    """Option with this help, and words for its default."""
    return typer.Option(help=text, show_default=default)


def _argument(name: str, text: str) -> Any:
    return option(text, _of_classes(name))


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
File = Annotated[
    Path | None,
    option(
        "A TOML file that describes the oscillator, or a machine in SI units, instead of all these "
        "options: see **jaxbelt simulate --help**.",
        "none",
    ),
]
Damping = Annotated[float, typer.Option(help="zeta = c / sqrt(k m).")]
Omega = Annotated[float, typer.Option(help="sqrt(k / m).")]
Json = Annotated[
    bool, typer.Option("--json", help="Print the results as one line of JSON, for scripts.")
]
Interval = tuple[float, float]
#: The start where none is given, dimensionless.
FIRST_STATE = (3.0, 0.0)
Start = Annotated[
    Interval | None,
    typer.Option(
        metavar="X1 X2",
        help="Displacement x1 and velocity x2 at tau = 0; of a machine in m and m/s.",
        show_default="3.0 0.0, dimensionless",
    ),
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


def tolerance_of(default: str) -> Any:
    """Option of the tolerance of a step; default: of the relative one."""
    text = "Relative and absolute tolerance of the integrator; of a machine the latter is in "
    return option(f"{text}max N / k.", f"{default}, the absolute one of the oscillator's own size")


Vary = Annotated[
    str,
    typer.Option(
        "--vary",
        help="The parameter: nu0, nu1, ..., zeta, sigma, sigma0, sigma1, or its path, such as "
        "belts[1].friction.steepness or forcing[0].frequency.",
    ),
]
VarySpan = Annotated[Interval, from_to("Its first and last value; of a machine in its SI unit.")]


@dataclass(frozen=True)
class Description:
    """Oscillator that options describe: a class of the paper with its arguments, belts in full, or
    a file, which may also describe a machine in SI units.

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
    file: File = None

    @functools.cached_property
    def source(self) -> FromFile | None:
        """What the file describes; None without a file."""
        if self.file is None:
            return None
        turn_on_float64()
        return FromFile(read_file(self.file), str(self.file))

    @property
    def machine(self) -> "jb.Machine | None":
        """The machine in SI units, if the file describes one."""
        return self.source.machine if self.source else None

    @property
    def is_forced(self) -> bool:
        """Whether the oscillator is forced."""
        if self.source is None:
            return bool(self.force)
        from ..model.oscillator import has_clock

        return has_clock(self.source.own)

    def dimensionless(self, value: float, quantity: str) -> float:
        """A number of the options, in SI units with a machine, in the units of the oscillator.

        quantity: a field of `Units`, such as "length".
        """
        return value / float(getattr(self.machine.units, quantity)) if self.machine else value

    def start(self, given: Interval | None) -> Interval:
        """The dimensionless start."""
        if given is None:
            return FIRST_STATE
        if not all(map(math.isfinite, given)):
            raise ValueError(f"start must be finite, got {given[0]} {given[1]}")
        return self.dimensionless(given[0], "length"), self.dimensionless(given[1], "velocity")

    def refuse_machine(self, command: str) -> None:
        """Raises if a machine is described, for a command whose results have no SI units."""
        if self.machine:
            expected = "a dimensionless oscillator, without mass and stiffness"
            raise ValueError(f"file of {command} must describe {expected}, got a machine")

    @property
    def arguments(self) -> dict[str, float | None]:
        """Arguments of the class, None where one is not given."""
        return {name: getattr(self, name) for name in ("nu0", "nu1", *EDGES)}

    @property
    def short_names(self) -> tuple[str, ...]:
        """Names of the arguments of the class; none for belts in full."""
        return () if self.belt or self.file else tuple(CLASSES[self.system])

    def check(self, *varied: str) -> None:
        """Raises unless the options describe belts; the classes themselves check numbers.

        varied: parameters that vary. An edge of class (c) or (d) among them is an argument, too.
        """
        if self.source:
            return
        for text in self.force or ():
            parts_of_force(text)
        given = _given(self.arguments) | dict.fromkeys(name for name in varied if name in EDGES)
        if self.belt:
            if given:
                raise ValueError(f"with --belt no class must be described, got {', '.join(given)}")
            for text in self.belt:
                parts_of_belt(text)
            return
        if self.system not in CLASSES:
            raise ValueError(f"class must be a, b, c or d, got {self.system}")
        for name in given:
            if name not in self.short_names:
                known = ", ".join(self.short_names)
                raise ValueError(f"class {self.system} must have only {known}, got {name}")

    def check_parameter(self, name: str) -> None:
        """Raises unless belts are described, and the parameter that is to vary is known."""
        self.check(name)
        paths, short = self.parameters(), self.short_names
        if name not in (*short, *paths):
            known, meant = names_in_words(short, paths), did_you_mean(name, (*short, *paths))
            raise ValueError(f"vary must be {known}, got {name}{meant}")

    def path_along(self, name: str, span: Interval) -> tuple[Any, Any, Interval]:
        """Oscillator, `where` and span of a path in a parameter, as the package takes them.

        For an argument of a class that is no number of the oscillator it is a function, and None.
        """
        path = self.parameters().get(name)
        if path is None:
            return lambda p: self.oscillator(**{name: p}), None, span
        import jax

        from ..model.parameters import names_of

        self.check_ends({name: span})
        osc, (_, size) = self.oscillator(), self.unit(name)
        place, (first, last) = names_of(osc).index(path), span
        return osc, lambda osc: jax.tree.leaves(osc)[place], (first / size, last / size)

    def check_ends(self, axes: Mapping[str, Sequence[float]]) -> None:
        """Raises where the first or the last value of a parameter of a file is impossible, whatever
        the others that vary are."""
        if self.source is None:
            return
        ends = {name: (values[0], values[-1]) for name, values in axes.items()}
        for name, own in ends.items():
            for value in own:
                corners = product(*((ends | {name: (value,)}).values()))
                errors = [
                    self._error_at(dict(zip(ends, corner, strict=True))) for corner in corners
                ]
                if all(errors):
                    raise ValueError(errors[0])

    def _error_at(self, values: dict[str, float]) -> str:
        """What is wrong with values of parameters of a file, "" where nothing is."""
        assert self.source is not None
        try:
            self.source.check(values)
        except ValueError as error:
            return str(error)
        return ""

    def unit(self, name: str) -> tuple[str, float]:
        """Unit of a parameter of a machine, and the size of one unit of the oscillator in it."""
        return self.source.unit(name) if self.machine and self.source else ("", 1.0)

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
        if self.source:
            return self.source.paths
        return _parameters(self.system, self.belt, self.force)

    def oscillator(self, **values: Any) -> "jb.Oscillator":
        """The oscillator; values: what differs from the options, as for `oscillator`."""
        if self.source:
            return self.source.at(**values)
        given = {**self.arguments, **values}
        return oscillator(self.system, self.belt, self.damping, self.omega, self.force, **given)

    def along(self, axes: Iterable[str]) -> "Callable[..., jb.Oscillator]":
        """The oscillator as a function of its axes; the function's text, which datasets keep, can
        be run."""
        if self.source:
            return functools.partial(oscillator_of, self.source.data)
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
    return changed(osc, {paths[name]: value for name, value in others.items()}) if others else osc


def _parameters(
    system: str, belt: Sequence[str] | None, force: Sequence[str] | None = None
) -> dict[str, str]:
    """See `Description.parameters`."""
    laws = [parts_of_belt(text)[1] for text in belt or ()]
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


def names_in_words(names: Iterable[str], paths: dict[str, str]) -> str:
    """Possible names of a parameter: the short ones, or one of many paths."""
    short = dict.fromkeys(
        [*names, *(name for name in paths if "." not in name and paths[name] != name)]
    )
    one = next(path for path in paths if ".friction." in path)
    load = next(path for path in paths if path.startswith(("belts[0].load", "belts[0].normal")))
    words = f"a path such as {one} or {load}"
    return f"one of {', '.join(short)}, or {words}" if short else words
