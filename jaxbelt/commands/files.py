"""An oscillator, or a machine in SI units, from a TOML file, for `--file`.

Keys of the file are arguments of the classes: of `Machine` and `PhysicalBelt` where a mass, a
stiffness or a normal force is given, else of `Oscillator` and `Belt`. A table in place of a
velocity or a load is an `Oscillating`; `law` and `kind` choose the class of a friction law and of a
force. The classes check all values; here their messages get the place in the file.
"""

import copy
import csv
import inspect
import re
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jaxbelt as jb

from ..spelling import did_you_mean
from .belts import LAWS

#: Names of classes by the words of the file that choose them, for both keys of such words.
CLASSES_OF = {
    "law": {name: law for name, (law, _) in LAWS.items()} | {"table": "Tabulated"},
    "kind": {"harmonic": "Harmonic", "base_motion": "BaseMotion"},
}
#: Columns of a CSV file of friction coefficients.
COLUMNS = ("speed", "mu")


@dataclass(frozen=True)
class Place:
    """A place in a file: the path of a table or a value, such as belts[0].friction."""

    file: str
    path: str = ""

    def __str__(self) -> str:
        return f"{self.path} in {self.file}" if self.path else self.file

    def at(self, key: str | int) -> "Place":
        """The place of an entry of the table or list at this place."""
        step = f"[{key}]" if isinstance(key, int) else f".{key}" if self.path else key
        return Place(self.file, self.path + step)

    def must(self, expected: str, came: str) -> ValueError:
        """The error for a wrong value at this place."""
        return ValueError(f"{self} must {expected}, got {came}")

    def blamed(self, message: str, table: dict[str, Any]) -> ValueError:
        """The error of a class made from the table here, with the place of the wrong value."""
        subject, must, rest = message.partition(" must be ")
        place, inner = self, table
        # Subjects are such as "kinetic of Coulomb", or "mean of load of belt".
        for word in reversed(subject.split(" of ")):
            if isinstance(inner, dict) and word in inner:
                place, inner = place.at(word), inner[word]
        return ValueError(f"{place}{must}{rest}" if place != self else f"{self}: {message}")


def read_file(path: Path) -> dict[str, Any]:
    """Content of a TOML file, with friction tables read from the CSV files that it names."""
    try:
        with path.open("rb") as file:
            data = tomllib.load(file)
    except OSError as error:
        raise ValueError(f"file must be a TOML file, got {path}: {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"file must be TOML, got {path}: {error}") from None
    for belt, place in _tables(data.get("belts", []), Place(str(path), "belts")):
        law = belt.get("friction")
        if isinstance(law, dict) and law.get("law") == "table" and "file" in law:
            at = place.at("friction")
            if law.keys() & {"speeds", "coefficients"}:
                raise at.must("have a file, or speeds and coefficients", "both")
            name = law.pop("file")
            if not isinstance(name, str):
                raise at.at("file").must("be the path of a CSV file", repr(name))
            law["speeds"], law["coefficients"] = read_table(path.parent / name, at.at("file"))
    return data


def read_table(path: Path, place: Place) -> tuple[list[float], list[float]]:
    """Speeds and coefficients from a CSV file with the columns speed and mu."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            names = [name.strip() for name in reader.fieldnames or ()]
            reader.fieldnames = names
            if not {*COLUMNS} <= {*names}:
                came = f"{path} with {', '.join(names) or 'none'}"
                raise place.must("be a CSV file with the columns speed and mu", came)
            rows = [(reader.line_num, _cells(row)) for row in reader]
    except OSError as error:
        raise place.must("be a CSV file", f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise place.must("be a CSV file", f"{path}, which is no text") from None
    found: list[list[float]] = []
    for line, row in rows:
        try:
            speed, mu = map(float, row)
            found.append([speed, mu])
        except (TypeError, ValueError):
            came = ", ".join(map(repr, row))
            raise place.must(
                "be a CSV file of numbers", f"{came} in line {line} of {path}"
            ) from None
    return [speed for speed, _ in found], [mu for _, mu in found]


def _cells(row: dict[Any, Any]) -> list[Any]:
    """Speed and coefficient of a row, followed by its cells beyond the last column, if any."""
    cells = [row[name] for name in COLUMNS]
    return [*cells, *row[None]] if None in row else cells


def described_by(data: dict[str, Any], file: str) -> "jb.Machine | jb.Oscillator":
    """The machine or the oscillator that a file describes."""
    top = Place(file)
    belts = data.get("belts", [])
    in_belts = {key for belt, _ in _tables(belts, top.at("belts")) for key in belt}
    is_machine = bool({"mass", "stiffness"} & data.keys() or "normal_force" in in_belts)
    belt: Any = jb.PhysicalBelt if is_machine else jb.Belt

    def as_belts(tables: Any, place: Place) -> list[Any]:
        return [_object(belt, table, at, makers) for table, at in _tables(tables, place)]

    def as_forcing(tables: Any, place: Place) -> list[Any]:
        return [_of_choice("kind", table, at, "harmonic") for table, at in _tables(tables, place)]

    waves = dict.fromkeys(("velocity", "load", "normal_force"), _as_wave)
    makers: Makers = waves | {"friction": lambda table, at: _of_choice("law", table, at)}
    whole: Any = jb.Machine if is_machine else jb.Oscillator
    return _object(whole, data, top, {"belts": as_belts, "forcing": as_forcing})


#: Functions that make the objects in a table, by key; arguments: the value and its place.
Makers = dict[str, Callable[[Any, Place], Any]]


def _object(
    kind: Callable, table: Any, place: Place, makers: Makers | None = None, choice: str = ""
) -> Any:
    """An object of a class from a table of its arguments.

    choice: the key that chose the class and is not one of its arguments; "" if there is none.
    """
    _, *arguments = inspect.signature(vars(kind)["__init__"]).parameters.values()
    known = [*([choice] if choice else []), *(one.name for one in arguments)]
    if choice == "law" and "speeds" in known:
        known.append("file")
    for name in table:
        if name not in known:
            came = f"{name}{did_you_mean(name, known)}"
            raise place.must(f"have only {', '.join(known)}", came)
    values: dict[str, Any] = {}
    for one in arguments:
        if one.name in table:
            value, at = table[one.name], place.at(one.name)
            if isinstance(value, list) and one.name not in LISTS:
                raise at.must("be a number", repr(value))
            make = (makers or {}).get(one.name)
            values[one.name] = make(value, at) if make else value
        elif one.default is one.empty:
            raise place.must(f"have {one.name}", ", ".join(table) or "nothing")
    try:
        return kind(**values)
    except ValueError as error:
        raise place.blamed(str(error), table) from error


#: Arguments that are lists.
LISTS = ("belts", "forcing", "speeds", "coefficients")


def _of_choice(key: str, table: Any, place: Place, default: str | None = None) -> Any:
    """An object from a table, of the class that the table's word at `key` chooses."""
    known = CLASSES_OF[key]
    if not isinstance(table, dict):
        raise place.must(f"be a table with the key {key}", repr(table))
    word = table.get(key, default)
    if word is None:
        raise place.must(f"have {key}", ", ".join(table) or "nothing")
    if not (isinstance(word, str) and word in known):
        came = f"{word!r}{did_you_mean(word, known)}"
        raise place.at(key).must(f"be {', '.join(known)}", came)
    return _object(getattr(jb, known[word]), table, place, choice=key)


def _as_wave(value: Any, place: Place) -> Any:
    return _object(jb.Oscillating, value, place) if isinstance(value, dict) else value


def _tables(value: Any, place: Place) -> Iterator[tuple[dict[str, Any], Place]]:
    """Tables of an array, each with its place; a single table counts as an array of one."""
    tables = [value] if isinstance(value, dict) else value
    if not (isinstance(tables, list) and all(isinstance(one, dict) for one in tables)):
        raise place.must(f"be tables, [[{place.path}]]", repr(value))
    return ((table, place.at(i)) for i, table in enumerate(tables))


class FromFile:
    """What a file describes, and its parameters by name, in SI units where it is a machine.

    Parameters vary in the units of the machine as it stands in the file. So mass and stiffness,
    which make these units, are not among them.

    Attributes:
        data: Content of the file.
        file: Its path.
        machine: The machine; None for a dimensionless oscillator.
        own: The dimensionless oscillator.
        paths: Paths of parameters in `own`, by their paths in the file; without a machine also by
            their short names.
    """

    def __init__(self, data: dict[str, Any], file: str):
        import jax

        from ..model.parameters import names_of

        self.data, self.file = data, file
        # Numbers of the file stay concrete if this runs while a program is traced.
        with jax.ensure_compile_time_eval():
            found: Any = described_by(data, file)
            self.machine = found if isinstance(found, jb.Machine) else None
            own: Any = found if self.machine is None else found.oscillator
        self.own: jb.Oscillator = own
        names = names_of(self.own)
        if self.machine is None:
            short = {f"nu{i}": f"belts[{i}].velocity" for i in range(len(self.own.belts))}
            short = {name: path for name, path in short.items() if path in names}
            self.paths = short | {"zeta": "damping"} | {name: name for name in names}
            return
        self.paths = {}
        for name in names_of(self.machine):
            path = name.replace(".normal_force", ".load")
            # A law without a unit of speed is inside a `LawInUnits`.
            for one in (path, path.replace(".friction.", ".friction.law.")):
                if one in names:
                    self.paths[name] = one

    def unit(self, name: str) -> tuple[str, float]:
        """Unit of a parameter in the file, and the size of the oscillator's unit in it."""
        if self.machine is None:
            return "", 1.0
        import jax

        from ..model.parameters import unit_of

        with jax.ensure_compile_time_eval():
            return unit_of(self.paths[name], self.own, self.machine.units)

    def check(self, values: dict[str, float]) -> None:
        """Raises if the values are impossible together; the error names the place in the file."""
        data = copy.deepcopy(self.data)
        for name, value in values.items():
            path = name if self.machine else self.paths[name]
            here: Any = data
            *steps, last = re.findall(r"[^.\[\]]+", path)
            for step in steps:
                if not step.isdecimal():
                    here = here[step]
                elif isinstance(here, list):
                    here = here[int(step)]
            here[last] = value
        described_by(data, self.file)

    def at(self, **values: Any) -> "jb.Oscillator":
        """The dimensionless oscillator with parameters set to values in the units of the file."""
        scaled = {self.paths[name]: value / self.unit(name)[1] for name, value in values.items()}
        return changed(self.own, scaled)


def oscillator_of(data: dict[str, Any], **values: Any) -> "jb.Oscillator":
    """Dimensionless oscillator of a file's content; values: parameters in the file's units."""
    return FromFile(data, "the file").at(**values)


def changed(osc: "jb.Oscillator", values: dict[str, Any]) -> "jb.Oscillator":
    """The oscillator with the parameters at these paths set to the values, checked."""
    import jax

    from ..checks import as_array
    from ..model.parameters import names_of

    leaves, structure = jax.tree.flatten(osc)
    places = names_of(osc)
    for path, value in values.items():
        leaves[places.index(path)] = as_array(value, path)
    other: jb.Oscillator = jax.tree.unflatten(structure, leaves)
    other.check()
    return other
