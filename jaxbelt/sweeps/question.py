"""The question of a sweep: its arguments, checked once, and what makes two sweeps the same."""

import functools
import hashlib
import importlib.metadata
import inspect
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np

from ..checks import (
    as_array,
    as_positive,
    as_tolerance,
    check_no_start,
    in_words,
    is_of_this_package,
    require,
    require_one_of,
    require_usable_jax,
    require_value,
)
from ..identity import fingerprint
from ..kernel.lanes import Observer, Program
from ..model.oscillator import has_clock
from ..spelling import did_you_mean
from .along import Along
from .attractor import Attractor
from .datasets import DIMENSIONS_OF_STARTS, Table, variable_of
from .grid import Grid
from .growth import LargestExponent
from .moments import AtEvents, checked
from .observers import Final, Reduce
from .reducers import check_reducer
from .strobes import ForcedAttractor

if TYPE_CHECKING:
    import xarray

#: Default t1 of attractor runs: some 500 loops; nearly all runs are decided long before.
LONG_ENOUGH = 30_000.0
#: Names of observers for `observe`, without a clock.
NAMED: dict[str, type[Observer]] = {"final": Final, "attractor": Attractor}
#: The same for forced oscillators.
NAMED_FORCED: dict[str, type[Observer]] = {
    "final": Final,
    "attractor": ForcedAttractor,
    "lyapunov": LargestExponent,
}
#: Largest numbers of points of the grid at which the oscillators count in the identity of a sweep,
#: to eleven digits and to seven; the same on every machine.
SAMPLE, MOST_COUNTED = 2**14, 2**24


@dataclass(frozen=True, eq=False)
class Question:
    """Checked arguments of a sweep; numbers: t1, rtol, atol and, with a clock, t0."""

    grid: Grid
    observe: Any
    numbers: dict[str, Any]
    derivatives: tuple[str, ...]

    @classmethod
    def of(cls, make, axes, y0, t1, rtol, atol, observe, derivatives, t0: Any = 0.0) -> "Question":
        """Checks the arguments of `sweep`."""
        require_usable_jax()
        grid = Grid(make, axes, y0)
        clock = has_clock(grid.example)
        _observer(observe, clock)
        if t1 is None:
            given = 'given, the end of each run, but for observe="attractor"'
            require(observe == "attractor", "t1", given, "None")
            t1 = LONG_ENOUGH
        numbers = settings_of_runs(t1, rtol, atol)
        if clock:
            numbers["t0"] = as_start(t0, numbers["t1"])
        else:
            check_no_start(t0)
        wanted: Sequence[str] = [derivatives] if isinstance(derivatives, str) else derivatives
        fits = isinstance(wanted, Sequence)
        require_value(fits, "derivatives", "a tuple of names of axes", wanted)
        none = "none where the oscillators are forced: differentiate jb.simulate"
        require(not clock or len(wanted) == 0, "derivatives", none, wanted)
        different = len(set(wanted)) == len(wanted)
        require_value(different, "derivatives", "free of repeats", wanted)
        for name in wanted:
            known, came = ", ".join(grid.axes), in_words(name) + did_you_mean(name, grid.axes)
            require(name in grid.axes, "derivatives", f"names of axes, {known}", came)
        if not isinstance(observe, str | Observer):
            check_reducer(observe, grid.example)
        question = cls(grid, observe, numbers, tuple(wanted))
        question.table.check_names()
        return question

    def arguments(self) -> tuple[Any, ...]:
        """The arguments of `of`, for another process that asks the same question."""
        grid, numbers = self.grid, [self.numbers[name] for name in ("t1", "rtol", "atol")]
        start, t0 = tuple(grid.y0.values()), self.numbers.get("t0", 0.0)
        return grid.make, grid.axes, start, *numbers, self.observe, self.derivatives, t0

    @functools.cached_property
    def program(self) -> Program:
        """What the kernel is compiled for."""
        return self.grid.program(_observer(self.observe, has_clock(self.grid.example)))

    @functools.cached_property
    def table(self) -> Table:
        """The variables of the results."""
        return Table(self.program, self.grid, self.derivatives)

    def attributes(self) -> dict[str, Any]:
        """Attributes that describe the origin of a dataset."""
        grid, observe = self.grid, self.observe
        start = [f"{axis} = {value}" for axis, value in grid.y0.items() if axis not in grid.axes]
        return {
            "title": "sweep of a belt-driven dry-friction oscillator",
            "make": _expression(grid.make) or _text_of(grid.make),
            "call": self.call(),
            "oscillator": f"{_plain(repr(grid.example))}, where the axes do not say otherwise",
            "start": ", ".join(start) + self._only_one_start() or "along the axes",
            **{name: value for name, value in self.numbers.items() if value is not None},
            "length": self.grid.length(),
            "observe": observe if isinstance(observe, str) else type(observe).__name__,
            "derivatives": ", ".join(self.derivatives) or "none",
            "versions": _versions(),
            "units": "lengths and velocities as in the oscillator; time is tau = omega t",
        }

    def _only_one_start(self) -> str:
        """Warning in the attributes if attractors are looked for from only one start at each
        point."""
        if self.observe != "attractor" or any(name in self.grid.axes for name in ("x1", "x2")):
            return ""
        return (
            ": of several attractors the one that this start leads to; axes x1 and x2, and then "
            "jaxbelt.attractors, show the others"
        )

    def call(self) -> str:
        """The call that asks this question, as a line of Python.

        `dataset` is the dataset of the results; objects that cannot be imported go by their own
        name, or by `make`.
        """
        given = {name: value for name, value in self.numbers.items() if value is not None}
        settings = ", ".join(f"{name}={value!r}" for name, value in given.items())
        start, axes = tuple(self.grid.y0.values()), list(self.grid.axes)
        name = getattr(self.grid.make, "__name__", "")
        make = _expression(self.grid.make) or (name if name.isidentifier() else "make")
        return (
            f"jaxbelt.sweep({make}, "
            f"{{name: dataset[name] for name in {axes}}}, y0={start}, {settings}, "
            f"observe={_plain(repr(self.observe))}, derivatives={self.derivatives!r})"
        )

    def identity(self) -> dict[str, str]:
        """Identity of the sweep, by the names of the arguments; equal for two sweeps that are the
        same.

        `make` counts by what it returns, see `_made`, and the friction laws of its oscillator by
        their types, numbers and, if they are not this package's, their fingerprints.
        """
        grid = self.grid
        leaves, _ = jax.tree_util.tree_flatten_with_path(grid.example)
        parameters = [f"{jax.tree_util.keystr(path)}={float(leaf)!r}" for path, leaf in leaves]
        identity = {f"axis {name}": digest(axis.tobytes()) for name, axis in grid.axes.items()}
        identity["axes"] = ", ".join(f"{name} ({axis.size})" for name, axis in grid.axes.items())
        identity["y0"] = repr(tuple(grid.y0.values()))
        identity["oscillator"] = ", ".join(parameters)
        identity["make"] = self._made
        for i, belt in enumerate(grid.example.belts):
            shown, name = _plain(repr(belt.friction)), f"the law of belt {i}"
            identity[name] = f"{shown} of {_kinds_of(belt.friction, name)}"
        for i, force in enumerate(grid.example.forcing):
            identity[f"force {i}"] = _kinds_of(force, f"force {i}")
        identity |= {name: repr(value) for name, value in self.numbers.items()}
        identity["observe"] = repr(self.observe)
        if not isinstance(self.observe, str):
            kind = type(self.observe).__qualname__
            identity["observe"] = f"{kind} {fingerprint(self.observe, 'observe')}"
        identity["derivatives"] = repr(self.derivatives)
        return identity

    @functools.cached_property
    def _made(self) -> str:
        """Hash of the starts and parameters of the runs, by numbers that do not depend on the
        machine: eleven digits of `SAMPLE` runs, and single precision of `MOST_COUNTED`.

        With more digits a few of so many numbers would be rounded differently by two machines.
        """
        grid = self.grid
        sample = np.unique(np.linspace(0, grid.runs - 1, SAMPLE).astype(int))
        varying = " ".join(str(number) for number, varies in enumerate(grid.mapped) if varies)
        numbers = " ".join(f"{x:.10e}" for x in grid.rows(sample).ravel().tolist())
        found = hashlib.sha256(f"{varying}: {numbers}".encode())
        counted = min(grid.runs, MOST_COUNTED)
        for first in range(0, counted if grid.runs > SAMPLE else 0, SAMPLE):
            runs = np.arange(first, min(first + SAMPLE, counted)) * grid.runs // counted
            rows = grid.rows(runs)
            with np.errstate(over="ignore"):
                found.update(np.where(np.isnan(rows), np.nan, rows).astype("<f4").tobytes())
        return found.hexdigest()[:16]


def quantities_of(dataset: "xarray.Dataset") -> dict[str, str]:
    """Dimensions of the variables and coordinates of a dataset: their attributes `quantity`.

    Stores of earlier versions lack it; there the descriptions of the observers are used.
    """
    named = dataset.variables.items()
    stated = {str(name): one.attrs["quantity"] for name, one in named if "quantity" in one.attrs}
    if stated or dataset.attrs.get("observe", "final") not in NAMED_FORCED:
        return stated
    observers = (*NAMED.values(), *NAMED_FORCED.values())
    described = {name: one for kind in observers for name, one in kind.variables.items()}
    axes = [str(name) for name in dataset.coords]
    found = {name: DIMENSIONS_OF_STARTS.get(name) for name in axes}
    for name in map(str, dataset.data_vars):
        found[name] = variable_of(name, described, axes).dimension
    return {name: dimension for name, dimension in found.items() if dimension}


def settings_of_runs(t1: Any, rtol: Any, atol: Any) -> dict[str, Any]:
    """Checks the arguments of runs; atol may be None, for the default in own units."""
    positive = {name: as_positive(value, name) for name, value in (("t1", t1), ("rtol", rtol))}
    return {**positive, "atol": as_tolerance(atol, "atol")}


def as_start(t0: Any, t1: float) -> float:
    """The time at which runs begin, before t1, as a float."""
    start = float(as_array(t0, "t0"))
    require_value(np.isfinite(start) and start < t1, "t0", f"a number below t1 = {t1}", t0)
    return start


def _observer(observe: Any, clock: bool) -> Observer:
    if isinstance(observe, Attractor):
        require(not clock, "observe", '"attractor" for oscillators that are forced', observe)
    if isinstance(observe, Observer):
        return observe
    known = NAMED_FORCED if clock else NAMED
    if isinstance(observe, str):
        instead = "for oscillators that are forced; of a cycle ask the multiplier of jb.find_cycle"
        require(clock or observe != "lyapunov", "observe", instead, '"lyapunov"')
        require_one_of(observe, known, "observe", " or an object with init, update, finish")
        return known[observe]()
    methods = ("init", "update", "finish")
    fits = all(callable(getattr(observe, name, None)) for name in methods)
    fits = fits and not isinstance(observe, type)
    names = ", ".join(f'"{name}"' for name in known)
    expected = f"{names} or an object with init, update, finish"
    require_value(fits, "observe", expected, observe)
    if hasattr(observe, "at") or hasattr(observe, "rates"):
        checked(getattr(observe, "at", (AtEvents(),)))
        return Along(observe)
    return Reduce(observe)


@functools.cache
def _versions() -> str:
    """Versions of all packages that affect the numbers; reading one takes a third of a
    millisecond."""
    packages = ("jaxbelt", "jax", "jaxlib", "diffrax", "equinox", "numpy", "xarray")
    return ", ".join(f"{name} {importlib.metadata.version(name)}" for name in packages)


def _expression(make: Callable) -> str | None:
    """Expression for a function in any program: its full name or a `partial` of it; else None."""
    if isinstance(make, functools.partial):
        function = _expression(make.func)
        given = [*map(_value, make.args), *(f"{k}={_value(v)}" for k, v in make.keywords.items())]
        return function and f"functools.partial({', '.join([function, *given])})"
    name = getattr(make, "__qualname__", "<")
    return None if "<" in name or make.__module__ == "__main__" else f"{make.__module__}.{name}"


def _text_of(make: Callable) -> str:
    """Source of a function, all of its lines, or its name where there is no source."""
    try:
        return inspect.getsource(make).strip()
    except (OSError, TypeError):
        return getattr(make, "__qualname__", _plain(repr(make)))


def _value(value: Any) -> str:
    """The repr of an argument that `partial` fixed; of a scalar array the repr of its number."""
    return repr(float(value)) if np.ndim(value) == 0 and hasattr(value, "dtype") else repr(value)


def _kinds_of(module: eqx.Module, name: str) -> str:
    """Classes of a law or force and of the modules in it; with a hash of its static arguments
    where all classes are this package's, else with its fingerprint; name: for messages."""
    parts = [*_modules_in(module)]
    kinds = [type(part) for part in parts]
    names = " with ".join(kind.__qualname__ for kind in kinds)
    if not all(map(is_of_this_package, kinds)):
        return f"{names}, {fingerprint(module, name)}"
    static = [
        getattr(part, argument)
        for part in parts
        for argument in inspect.signature(type(part)).parameters
        if isinstance(getattr(part, argument, None), tuple)
    ]
    return f"{names}, {digest(repr(static).encode())}" if static else names


def _modules_in(module: eqx.Module) -> Iterator[eqx.Module]:
    """Yields a module and all modules inside it."""
    yield module
    parts = jax.tree.leaves(
        list(vars(module).values()), is_leaf=lambda part: isinstance(part, eqx.Module)
    )
    for part in parts:
        if isinstance(part, eqx.Module):
            yield from _modules_in(part)


def _plain(text: str) -> str:
    """A repr without addresses in memory."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", text)


def digest(data: bytes) -> str:
    """Short digest of bytes, in the identity of a sweep."""
    return hashlib.sha256(data).hexdigest()[:16]
