"""The oscillator that options describe: `Description`, and `describes`, a decorator of commands."""

import functools
import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import typer

import jaxbelt as jb

from ..spelling import did_you_mean
from .belts import LAWS, parse_belt, parts_of_belt, parts_of_force
from .files import FromFile, changed, oscillator_of, read_file
from .options import Interval, option, turn_on_float64

#: Arguments of the four classes of the paper, and their defaults.
CLASSES = {
    "a": {"nu0": 0.2},
    "b": {"nu0": 0.45, "nu1": 0.35},
    "c": {"nu0": 0.2, "nu1": 0.4, "sigma": 0.8},
    "d": {"nu0": 0.2, "nu1": 0.4, "sigma0": 0.5, "sigma1": 1.0},
}
#: Arguments of classes that are contact edges: sigma of both belts, the others of one.
EDGES = ("sigma", "sigma0", "sigma1")
#: Default start, dimensionless.
FIRST_STATE = (3.0, 0.0)


def _of_classes(name: str) -> str:
    """Defaults of an argument of the classes, for the help."""
    values: dict[float, list[str]] = {}
    for system, arguments in CLASSES.items():
        if name in arguments:
            values.setdefault(arguments[name], []).append(system)
    return "; ".join(f"{value} in {', '.join(names)}" for value, names in values.items())


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
        """Whether the oscillator is forced; a force of the frequency 0 is constant."""
        if self.source is None:
            return any(parts_of_force(one)[1] != 0 for one in self.force or ())
        from ..model.oscillator import has_clock

        return has_clock(self.source.own)

    def dimensionless(self, value: float, quantity: str) -> float:
        """Converts a number of the options, in SI units with a machine, to the oscillator's units.

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
        """Raises unless the options fit together; constructors of the package check the numbers.

        varied: parameters that vary. Contact edges of class (c) or (d) among them count as given.
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
        """Raises unless the options fit together and the parameter to vary exists."""
        self.check(name)
        paths, short = self.parameters(), self.short_names
        if name not in (*short, *paths):
            known, meant = names_in_words(short, paths), did_you_mean(name, (*short, *paths))
            raise ValueError(f"vary must be {known}, got {name}{meant}")

    def path_along(self, name: str, span: Interval) -> tuple[Any, Any, Interval]:
        """Oscillator, `where` and span of a path in a parameter, as the package takes them.

        For an argument of a class that is no leaf of the oscillator, such as sigma, the first is a
        function of the argument that returns the oscillator, and `where` is None.
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
        """Raises if the first or last value of a parameter of a file is impossible with all
        combinations of first and last values of the other axes."""
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
        """Message of the error that parameter values of a file raise; "" if they are valid."""
        assert self.source is not None
        try:
            self.source.check(values)
        except ValueError as error:
            return str(error)
        return ""

    def unit(self, name: str) -> tuple[str, float]:
        """Unit of a parameter of a machine, and the size of the oscillator's unit in it."""
        return self.source.unit(name) if self.machine and self.source else ("", 1.0)

    def check_axes(self, axes: Iterable[str], others: tuple[str, ...] = ()) -> None:
        """Raises unless all axes are known and different.

        Axes may be arguments of the class, parameters of the oscillator or machine, and `others`.
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
        """The oscillator; values: by name, they replace those of the options (see `oscillator`)."""
        if self.source:
            return self.source.at(**values)
        given = {**self.arguments, **values}
        return oscillator(self.system, self.belt, self.damping, self.omega, self.force, **given)

    def along(self, axes: Iterable[str]) -> "Callable[..., jb.Oscillator]":
        """The oscillator as a function of its axes; datasets store the text of the function, which
        can be run in any program."""
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
    """Decorator of a command: options with these names replace its parameter `described`.

    The command gets them as a `Description`. Without names all fields of `Description` are options.
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

        # typer reads the options from the signature and the annotations.
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
    """Names that a parameter may have, for messages: the short ones, and two paths as examples."""
    short = dict.fromkeys(
        [*names, *(name for name in paths if "." not in name and paths[name] != name)]
    )
    one = next(path for path in paths if ".friction." in path)
    load = next(path for path in paths if path.startswith(("belts[0].load", "belts[0].normal")))
    words = f"a path such as {one} or {load}"
    return f"one of {', '.join(short)}, or {words}" if short else words
