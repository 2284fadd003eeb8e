"""Sweeps: named axes in, a labelled `xarray.Dataset` out.

`sweep` runs an oscillator from every point of a grid of parameters and starts, in the kernel of
`queue`, and puts the results where they belong.
"""

import functools
import hashlib
import importlib.metadata
import inspect
import json
import math
import threading
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ..checks import (
    as_array,
    check_finite,
    check_positive,
    require,
    require_usable_jax,
)
from ..model.events import signature_name
from ..model.oscillator import Oscillator, check_scalars
from ..numerics.compiling import depends
from .attractor import KINDS, Attractor
from .audit import chosen, differing
from .events import word_events
from .lanes import Observer, Program
from .observers import Final, Reduce
from .queue import by_name, layout
from .threads import CHUNK, run

if TYPE_CHECKING:
    import xarray

#: Results with a number a belt.
PER_BELT = ("sticks", "stick_duration", "mode_end")
#: What axes are called in words; other arguments of `make` go by their own name.
LONG_NAMES = {
    "nu0": "velocity of belt 0",
    "nu1": "velocity of belt 1",
    "sigma": "edge between the contact intervals",
    "sigma0": "lower edge of belt 1's contact interval",
    "sigma1": "upper edge of belt 0's contact interval",
    "x1": "displacement at the start",
    "x2": "velocity at the start",
    "belt": "belt",
    "x1_end": "displacement at t1",
    "x2_end": "velocity at t1",
    "mode_end": "contact at t1: 1/-1 slips with that sign of nu - omega x2, 0 stuck, "
    "-2/2 mass below/above the belt's interval",
    "kind": "what the run leads to",
    "signature": "events of one loop of the cycle, by number of flag_meanings",
    "sticks": "whether the attractor sticks to the belt",
    "period": "period of the cycle",
    "stick_duration": "time stuck to the belt in one loop",
    "x1_min": "smallest displacement on the attractor",
    "x1_max": "largest displacement on the attractor",
    "x2_min": "smallest velocity on the attractor",
    "x2_max": "largest velocity on the attractor",
    "transient": "time at which the attractor was reached",
    "n_events": "number of events (of a cycle: in one loop)",
    "status": "how the run ended, a jaxbelt.Status",
}
#: Types of what is not a float.
TYPES = {
    "kind": "int8",
    "signature": "int64",
    "sticks": "bool",
    "mode_end": "int8",
    "n_events": "int32",
    "status": "int8",
}
#: Default t1 of attractor runs.
LONG_ENOUGH = 30_000.0


def sweep(
    make: Callable[..., Oscillator],
    axes: Mapping[str, Any],
    *,
    y0: ArrayLike | tuple = (3.0, 0.0),
    t1: ArrayLike | None = None,
    rtol: ArrayLike = 1e-8,
    atol: ArrayLike = 1e-8,
    observe: Any = "final",
    derivatives: Sequence[str] = (),
    store: str | Path | None = None,
    progress: bool | None = None,
    audit: float = 0.0,
) -> "xarray.Dataset":
    """Run an oscillator from every point of a grid of parameters and starts.

    make: a function of parameters that returns an `Oscillator`, such as `jb.presets.class_b`; the
    rest of its arguments can be fixed by `functools.partial`. It is called with traced arrays.
    axes: values, shape [n], of arguments of `make`, and of `x1` and `x2` for starts; NaN is
    allowed and gives runs with the status NOT_FINITE. y0: start (x1, x2) where no axis says
    otherwise. t1: end of each run, from t = 0 (dimensionless time tau = omega t). rtol, atol:
    tolerances of a step.

    observe: what is wanted, and the variables of the dataset, over the axes:

    - `"final"`: x1_end, x2_end, mode_end(belt) (contact codes as in `Trajectory.modes`), n_events.
    - `"attractor"`: kind ("equilibrium", "cycle", "stuck", or "undecided" at t1, which is 30,000
      unless given), signature (the events of one loop, kind and belt: a number, with its meaning in
      the attributes flag_values and flag_meanings), sticks(belt), period, stick_duration(belt) in
      a loop (inf where stuck for ever), x1_min, x1_max, x2_min, x2_max on the attractor,
      transient: the time at which it was reached, n_events: of a cycle in one loop, else until it
      was known. Runs end as soon as their attractor is known, see `attractor.Attractor`.
    - an object with three methods for scalars: `init(osc, x1, x2)`, the state of a run, any tree of
      arrays; `update(state, event)`, the state after an `observers.RunEvent` (t, x1, x2, kind,
      belt); and `finish(state, end)`, a dictionary of results, numbers or vectors, from the state
      and an `observers.RunEnd` (t, x1, x2, status). They are traced, so use `jax.numpy`.

    and always status, a `Status` code a run: nothing raises because of one run.

    derivatives: names of axes. Adds `d_<variable>_d_<axis>` for every variable that is a float, by
    forward mode. store: a folder for the results as they come in; the same call with the same
    store goes on where an interrupted one stopped. progress: whether to show a bar; None: on a
    terminal, when it takes long. audit: share of the runs that are done once more without any
    shortcut and compared, see `audit` for what is left out; the attributes audited and
    audit_differed say how many, and a warning says so where one differed.

    Uses every core (every device, if JAX has others). `ValueError` names the argument that is
    impossible. `KeyboardInterrupt` ends the sweep within a second and says what became of its runs.
    """
    require_usable_jax()
    grid = _Grid(make, axes, y0)
    observer = _observer(observe)
    if t1 is None:
        require(observe == "attractor", "t1", "given", "None")
        t1 = LONG_ENOUGH
    numbers: dict[str, Any] = {"t1": t1, "rtol": rtol, "atol": atol}
    for name, value in numbers.items():
        numbers[name] = float(as_array(value, name))
        check_positive(numbers[name], name)
    derivatives = tuple([derivatives] if isinstance(derivatives, str) else derivatives)
    for name in derivatives:
        require(
            name in grid.axes, "derivatives", f"names of axes, {', '.join(grid.axes)}", repr(name)
        )
    audit = float(as_array(audit, "audit"))
    require(0 <= audit <= 1, "audit", "a share from 0 to 1", audit)
    require(
        audit == 0 or not isinstance(observer, Reduce),
        "audit",
        '0 but for observe="final" and "attractor"',
        audit,
    )
    attributes = _provenance(grid, numbers, observe, derivatives)
    program = grid.program(observer)
    table = _Table(program, grid, derivatives, store, attributes)
    try:
        _run(program, grid, table, numbers, derivatives, progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(table.interrupted()) from None
    if audit:
        attributes |= _audited(program, grid, table, audit, numbers)
    return table.dataset(attributes)


def _run(program, grid: "_Grid", table: "_Table", numbers, derivatives, progress) -> None:
    """Do the runs that the table lacks."""
    todo, lock = table.todo(), threading.Lock()

    def rows_of(first: int, last: int) -> np.ndarray:
        return grid.rows(todo[first:last], derivatives)

    with _Progress(len(todo), progress) as advance:

        def put(done: np.ndarray, results: np.ndarray) -> None:
            with lock:
                table.put(todo[done], results)
                advance(len(done))

        run(
            program,
            grid.shared,
            rows_of,
            len(todo),
            put,
            **numbers,
            derivatives=len(derivatives),
        )


def _audited(program, grid: "_Grid", table: "_Table", share: float, numbers) -> dict[str, int]:
    """The attributes that tell of an audit; warns of what differed."""
    runs = chosen(math.prod(grid.shape), share)
    known = {name: table.arrays[name][runs] for name in table.layout}
    differ = differing(program, grid.shared, lambda i: grid.rows(i)[0], runs, known, numbers)
    if len(differ):
        places = [tuple(map(int, np.unravel_index(run, grid.shape))) for run in differ[:5]]
        warnings.warn(
            f"{len(differ)} of {len(runs)} audited runs differ from the long way, at the indices "
            f"{', '.join(map(str, places))}{' and others' * (len(differ) > 5)}",
            stacklevel=3,
        )
    return {"audited": len(runs), "audit_differed": len(differ)}


def _observer(observe: Any) -> Observer:
    named = {"final": Final, "attractor": Attractor}
    if isinstance(observe, str):
        require(observe in named, "observe", '"final", "attractor" or a reducer', repr(observe))
        return named[observe]()
    methods = ("init", "update", "finish")
    fits = all(callable(getattr(observe, name, None)) for name in methods)
    require(fits, "observe", '"final", "attractor" or an object with init, update, finish', observe)
    return Reduce(observe)


# --- the grid -------------------------------------------------------------------------------------


class _Grid:
    """The points of a sweep and the oscillators there."""

    def __init__(self, make: Callable[..., Oscillator], axes: Mapping[str, Any], y0: Any):
        require(callable(make), "make", "a function that returns an Oscillator", repr(make))
        require(
            isinstance(axes, Mapping) and len(axes) > 0,
            "axes",
            "a dictionary of values",
            repr(axes),
        )
        self.make = make
        self.axes = {
            name: np.asarray(as_array(v, f"axis {name}", (None,))) for name, v in axes.items()
        }
        for name, values in self.axes.items():
            require(name != "belt", "axes", "without the name belt, a dimension of results", name)
            require(values.size > 0, f"axis {name}", "at least one value", "none")
        start = as_array(y0, "y0", (2,))
        check_finite(start, "y0")
        self.y0 = dict(zip(("x1", "x2"), np.asarray(start).tolist(), strict=True))
        self.shape = tuple(values.size for values in self.axes.values())
        self.names = [name for name in self.axes if name not in self.y0]
        self._accepted_by(make)
        # An oscillator of the sweep, for the structure and for what does not vary. Whatever is
        # impossible in it is told here; runs that are not finite are told by their status.
        finite = {name: self.axes[name][np.isfinite(self.axes[name])] for name in self.names}
        first = {name: float(v[0]) if v.size else 0.0 for name, v in finite.items()}
        self.example = make(**first)
        require(
            isinstance(self.example, Oscillator),
            "make",
            "a function that returns an Oscillator",
            f"one that returns {type(self.example).__name__}",
        )
        check_scalars(self.example)
        leaves, self.structure = jax.tree.flatten(self.example)
        self.mapped = self._varying()
        self.shared = [leaf for leaf, mapped in zip(leaves, self.mapped, strict=True) if not mapped]

    def _accepted_by(self, make):
        try:
            parameters = inspect.signature(make).parameters
        except (TypeError, ValueError):
            return
        if any(p.kind == p.VAR_KEYWORD for p in parameters.values()):
            return
        for name in self.names:
            require(
                name in parameters,
                "axes",
                f"arguments of make ({', '.join(parameters)}), x1 or x2",
                repr(name),
            )

    def _varying(self) -> tuple[bool, ...]:
        """For each leaf of the oscillator whether it depends on an axis."""
        return depends(lambda values: self.make(**values), dict.fromkeys(self.names, 0.0))

    def program(self, observer: Observer) -> Program:
        leaves = jax.tree.unflatten(self.structure, self.mapped)
        edges = any(
            varies or np.isfinite(value)
            for belt, which in zip(self.example.belts, leaves.belts, strict=True)
            for varies, value in ((which.lower, belt.lower), (which.upper, belt.upper))
        )
        return Program(self.structure, self.mapped, observer, bool(edges))

    def rows(self, runs: np.ndarray, derivatives: tuple[str, ...] = ()) -> np.ndarray:
        """Starts and varying parameters of some runs, [1 + derivatives, columns, runs]."""
        # Of one size, for one compiled program.
        padded = np.concatenate([runs, np.zeros(CHUNK - len(runs), runs.dtype)])
        places = np.unravel_index(padded, self.shape)
        values = {
            name: axis[place] for (name, axis), place in zip(self.axes.items(), places, strict=True)
        }
        start = tuple(self.y0.items())
        table = _rows(self.make, tuple(self.names), self.mapped, start, derivatives, values)
        return np.asarray(table)[:, :, : len(runs)]


@functools.partial(jax.jit, static_argnums=(0, 1, 2, 3, 4))
def _rows(make, names, mapped, start, derivatives, values):
    def row(values):
        leaves = jax.tree.leaves(make(**{name: values[name] for name in names}))
        varying = [leaf for leaf, varies in zip(leaves, mapped, strict=True) if varies]
        return jnp.stack([*(jnp.asarray(values.get(x, default)) for x, default in start), *varying])

    rows = jax.vmap(row, out_axes=1)
    tables = [rows(values)]
    for name in derivatives:
        direction = {n: jnp.full_like(v, float(n == name)) for n, v in values.items()}
        tables.append(jax.jvp(rows, (values,), (direction,))[1])
    return jnp.stack(tables)


# --- results --------------------------------------------------------------------------------------


class _Table:
    """The results, an array a variable, in memory or in the files of a store."""

    def __init__(self, program, grid: _Grid, derivatives, store, attributes):
        self.grid, self.derivatives = grid, derivatives
        self.finds_attractors = isinstance(program.observer, Attractor)
        self.layout = layout(program, grid.shared)
        runs = math.prod(grid.shape)
        self.arrays: dict[str, np.ndarray] = {}
        folder = None if store is None else _open_store(Path(store), grid, attributes)
        self.folder = folder
        shapes = dict(self.layout)
        for by in derivatives:
            shapes |= {
                f"d_{name}_d_{by}": s for name, s in self.layout.items() if name not in TYPES
            }
        for name, shape in shapes.items():
            kind = np.dtype(TYPES.get(name, "float64"))
            empty = -1 if name == "status" else np.zeros(1, kind)[0]
            if folder is None:
                self.arrays[name] = np.full((runs, *shape), empty, kind)
            elif (folder / f"{name}.npy").exists():
                self.arrays[name] = np.load(folder / f"{name}.npy", mmap_mode="r+")
            else:
                array = np.lib.format.open_memmap(
                    folder / f"{name}.npy", mode="w+", dtype=kind, shape=(runs, *shape)
                )
                array[...] = empty
                self.arrays[name] = array

    def todo(self) -> np.ndarray:
        return np.flatnonzero(self.arrays["status"] < 0)

    def put(self, runs: np.ndarray, results: np.ndarray) -> None:
        """Store results of runs, [1 + derivatives, columns, runs]; the status last of all."""
        parts = by_name(self.layout, results)
        status = parts.pop("status")[0]
        for name, part in parts.items():
            # Codes of runs that are not finite are not numbers: 0.
            self.arrays[name][runs] = np.nan_to_num(part[0]) if name in TYPES else part[0]
            if name not in TYPES:
                for by, derivative in zip(self.derivatives, part[1:], strict=True):
                    self.arrays[f"d_{name}_d_{by}"][runs] = derivative
        self.arrays["status"][runs] = status

    def interrupted(self) -> str:
        """What becomes of the results of an interrupted sweep."""
        status = self.arrays["status"]
        done = f"{np.sum(status >= 0):,} of {status.size:,} runs"
        if self.folder is None:
            return (
                f"interrupted after {done}, which are not kept; with a store "
                '(store="results.zarr") they are, and the same call goes on from there'
            )
        return f"interrupted: {done} are in {self.folder}; the same call goes on from there"

    def dataset(self, attributes: dict[str, Any]) -> "xarray.Dataset":
        import xarray  # with pandas, half of what `import jaxbelt` would take

        variables = {}
        belts = len(self.grid.example.belts)
        for name in sorted(self.arrays, key=_position):
            values = self.arrays[name]
            attributes_of = _attributes(name)
            if self.finds_attractors and name == "kind":
                values = np.array(KINDS)[values]
            if self.finds_attractors and name == "signature":
                values, flags = _signatures(values, belts)
                attributes_of |= flags
            extra = [f"{name}_{i}" for i in range(values.ndim - 1)]
            if name.split("_d_")[0].removeprefix("d_") in PER_BELT and values.shape[1:] == (belts,):
                extra = ["belt"]
            variables[name] = (
                (*self.grid.axes, *extra),
                values.reshape(*self.grid.shape, *values.shape[1:]),
                attributes_of,
            )
        coordinates = {
            name: (name, values, _attributes(name)) for name, values in self.grid.axes.items()
        }
        if any("belt" in dims for dims, *_ in variables.values()):
            coordinates["belt"] = ("belt", np.arange(belts), _attributes("belt"))
        return xarray.Dataset(variables, coordinates, attributes)


def _signatures(words: np.ndarray, belts: int) -> tuple[np.ndarray, dict[str, Any]]:
    """Numbers of the signatures that these words stand for, and CF's attributes that name them.

    A signature begins where the sequence of its events is smallest, so that it does not depend on
    where the loop began.
    """
    different = np.unique(words)
    meanings = [_meaning(int(word), belts) for word in different]
    names = sorted(set(meanings), key=lambda name: (name != "none", name != "smooth", name))
    number = {name: i for i, name in enumerate(names)}
    numbers = np.array([number[name] for name in meanings], "int16")
    values = numbers[np.searchsorted(different, words)]
    flags = {
        "flag_values": np.arange(len(names), dtype="int16"),
        "flag_meanings": " ".join(names),
    }
    return values, flags


def _meaning(word: int, belts: int) -> str:
    """A signature as one word; -1 stands for one that is too long to be told."""
    if word < 1:
        return "none" if word == 0 else "long"
    return signature_name(word_events(word, belts))


def _position(name: str) -> tuple[int, str]:
    """Results in the order of `LONG_NAMES`, then others, then derivatives."""
    known = list(LONG_NAMES)
    return (known.index(name) if name in known else len(known) + name.startswith("d_"), name)


def _attributes(name: str) -> dict[str, str]:
    if name.startswith("d_") and "_d_" in name:
        of, by = name.removeprefix("d_").split("_d_")
        return {"long_name": f"derivative of {of} by {by}", "units": "1"}
    return {"long_name": LONG_NAMES.get(name, name), "units": "1"}


# --- around it ------------------------------------------------------------------------------------


def _provenance(grid: _Grid, numbers, observe, derivatives) -> dict[str, Any]:
    """What the numbers of a dataset came from."""
    name = getattr(grid.make, "__qualname__", None) or repr(grid.make)
    start = [f"{axis} = {value}" for axis, value in grid.y0.items() if axis not in grid.axes]
    packages = ("jaxbelt", "jax", "jaxlib", "diffrax", "equinox", "numpy", "xarray")
    return {
        "title": "sweep of a belt-driven dry-friction oscillator",
        "make": name,
        "oscillator": f"{grid.example!r}, where the axes do not say otherwise",
        "start": ", ".join(start) or "along the axes",
        **numbers,
        "observe": observe if isinstance(observe, str) else type(observe).__name__,
        "derivatives": ", ".join(derivatives) or "none",
        "versions": ", ".join(f"{p} {importlib.metadata.version(p)}" for p in packages),
        "units": "all quantities are dimensionless; time is tau = omega t",
    }


def _open_store(folder: Path, grid: _Grid, attributes: dict[str, Any]) -> Path:
    """The folder of a store, for this sweep and no other."""
    same = {k: v for k, v in attributes.items() if k != "versions"}
    same["axes"] = {name: hashlib.sha256(v.tobytes()).hexdigest() for name, v in grid.axes.items()}
    described = json.dumps(same, indent=2, default=str)
    folder.mkdir(parents=True, exist_ok=True)
    card = folder / "sweep.json"
    if card.exists():
        require(
            card.read_text(encoding="utf-8") == described,
            "store",
            "an empty folder or the store of this very sweep",
            f"another one in {folder}",
        )
    else:
        require(not any(folder.iterdir()), "store", "an empty folder", f"{folder} with files in it")
        card.write_text(described, encoding="utf-8")
    return folder


class _Progress:
    """A bar on the terminal, for what takes longer than a moment."""

    #: Seconds before a bar is shown that nobody asked for.
    PATIENCE = 3.0

    def __init__(self, total: int, wanted: bool | None):
        console = Console(stderr=True)
        self.wanted = (console.is_terminal or console.is_jupyter) if wanted is None else wanted
        self.patience = self.PATIENCE if wanted is None else 0.0
        self.total, self.done, self.bar = total, 0, None
        self.console, self.began = console, time.monotonic()

    def __enter__(self) -> Callable[[int], None]:
        return self.advance

    def advance(self, count: int) -> None:
        self.done += count
        if not self.wanted:
            return
        if self.bar is None and time.monotonic() - self.began >= self.patience:
            columns = (
                TextColumn("sweep"),
                BarColumn(),
                TextColumn("{task.completed:,.0f} of {task.total:,.0f} runs"),
                TimeElapsedColumn(),
                TimeRemainingColumn(),
            )
            self.bar = Progress(*columns, console=self.console)
            self.bar.start()
            self.bar.add_task("", total=self.total)
        if self.bar is not None:
            self.bar.update(self.bar.task_ids[0], completed=self.done)

    def __exit__(self, *_) -> None:
        if self.bar is not None:
            self.bar.stop()
