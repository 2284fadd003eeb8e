"""The grid of a sweep: its points, the oscillators there, and its blocks."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..checks import (
    as_array,
    as_finite,
    check_arguments,
    is_concrete,
    require,
    require_callable,
    require_value,
    traceable,
)
from ..identity import fingerprint_or_unique
from ..kernel.lanes import Observer, Program
from ..model.oscillator import (
    Oscillator,
    check_scalars,
    has_edges,
    interval_ends,
    its_oscillator,
)
from ..model.own_units import in_units_of_run
from ..numerics.compiling import jit, power_of_two
from .runs_in_memory import results_of

#: Smallest number of rows computed at once, even for few runs: few shapes are compiled.
FEWEST_ROWS = 2**14


class Grid:
    """The points of a sweep and the oscillators there."""

    def __init__(self, make: Callable[..., Oscillator], axes: Mapping[str, Any], y0: Any):
        returns = "a function that returns an Oscillator, such as jb.presets.class_b"
        require_callable(make, "make", returns)
        require_value(
            isinstance(axes, Mapping) and len(axes) > 0,
            "axes",
            "a dictionary of values",
            axes,
        )
        self.make = make
        self.made_of = fingerprint_or_unique(make)
        self.axes = {
            name: np.asarray(as_array(v, f"axis {name}", (None,))) for name, v in axes.items()
        }
        for name, values in self.axes.items():
            require(values.size > 0, f"axis {name}", "at least one value", "none")
        start = as_finite(y0, "y0", (2,))
        self.y0 = dict(zip(("x1", "x2"), np.asarray(start).tolist(), strict=True))
        self.shape = tuple(values.size for values in self.axes.values())
        self.runs = math.prod(self.shape)
        self.names = [name for name in self.axes if name not in self.y0]
        check_arguments(make, self.names, "make", ", x1 or x2")
        # One oscillator of the sweep gives the tree structure and the leaves that do not vary; for
        # impossible values `make` raises here. Other runs that are not finite only get a status.
        self.example = make(**self._first(np.isfinite))
        kind = type(self.example).__name__
        came = f"one that returns {kind}{its_oscillator(self.example, 'return')}"
        require(isinstance(self.example, Oscillator), "make", returns, came)
        known = "one of known numbers: sweeps are not for jit, vmap or derivatives"
        require(is_concrete(self.example), "make", known, "a traced one")
        check_scalars(self.example)
        self.edges = True
        own = in_units_of_run(self.example, edges=True)
        self.mapped = traceable(self._varying, "make", returns)
        if len(self.mapped) != len(jax.tree.leaves(own)):
            # A force whose frequency is a known 0 is a constant force, of another tree structure.
            self.example = make(**self._first(lambda values: np.isfinite(values) & (values != 0)))
            own = in_units_of_run(self.example, edges=True)
        alike = len(self.mapped) == len(jax.tree.leaves(own))
        expected = "such that a frequency is not 0 everywhere, which makes a constant force"
        require(alike, "axes", expected, "one of zeros")
        which = jax.tree.unflatten(jax.tree.structure(own), self.mapped)
        self.edges = has_edges(own) or any(map(bool, interval_ends(which)))
        leaves, self.structure = jax.tree.flatten(in_units_of_run(self.example, edges=self.edges))
        self.mapped = self.mapped if self.edges else self._varying()
        pairs = zip(leaves, self.mapped, strict=True)
        self.shared = [jnp.asarray(leaf) for leaf, mapped in pairs if not mapped]
        #: Cache of `rows` for all runs of a small grid, by `derivatives`.
        self.known_rows: dict[tuple[str, ...], np.ndarray] = {}

    def _first(self, usable: Callable[[np.ndarray], np.ndarray]) -> dict[str, float]:
        """The first usable value of each axis, 0 where there is none."""
        found = {name: self.axes[name][usable(self.axes[name])] for name in self.names}
        return {name: float(values[0]) if values.size else 0.0 for name, values in found.items()}

    def _varying(self) -> tuple[bool, ...]:
        """For each leaf of the oscillator whether it depends on an axis."""
        found = []

        def probe(values):
            # Leaves that do not depend on the mapped values are concrete, not traced.
            run = in_units_of_run(self.make(**values), edges=self.edges)
            found.extend(not is_concrete(leaf) for leaf in jax.tree.leaves(run))
            return 0

        jax.vmap(probe, axis_size=2, out_axes=None)({name: np.zeros(2) for name in self.names})
        return tuple(found)

    def program(self, observer: Observer, *, own_t0: bool = False) -> Program:
        made_of = fingerprint_or_unique((self.structure, observer))
        known = self.structure, self.mapped, observer, self.edges
        return Program(*known, own_t0=own_t0, made_of=made_of)

    def results(
        self, observer: Observer, states: np.ndarray, which: np.ndarray, **numbers: Any
    ) -> dict[str, np.ndarray]:
        """`results_of` for runs from states (x1, x2) or (x1, x2, t), [2 or 3, runs], each with the
        parameters of the grid's run number `which`, [runs]."""

        def rows_of(first: int, last: int) -> np.ndarray:
            rows = self.rows(which[first:last])
            return np.concatenate([states[None, :, first:last], rows[:, 2:]], axis=1)

        program = self.program(observer, own_t0=len(states) == 3)
        return results_of(program, self.shared, rows_of, len(which), **numbers)

    def length(self) -> float:
        """Smallest own unit of length among a sample of the oscillators of the grid."""
        units = jax.tree.unflatten(self.structure, self.mapped).units
        if not units.length:
            leaves = iter(self.shared)
            found = [None if mapped else next(leaves) for mapped in self.mapped]
            return float(jax.tree.unflatten(self.structure, found).units.length)
        # The units are the last leaves: length, velocity.
        sample = np.unique(np.linspace(0, self.runs - 1, FEWEST_ROWS).astype(int))
        column = 2 + sum(self.mapped) - 1 - bool(units.velocity)
        lengths = self.rows(sample)[0, column]
        return float(np.min(lengths))

    def rows(self, runs: np.ndarray, derivatives: tuple[str, ...] = ()) -> np.ndarray:
        """Starts and varying parameters of some runs, [1 + derivatives, columns, runs]."""
        if self.runs > FEWEST_ROWS:
            return self._computed_rows(runs, derivatives)
        if derivatives not in self.known_rows:
            self.known_rows[derivatives] = self._computed_rows(np.arange(self.runs), derivatives)
        return self.known_rows[derivatives][:, :, runs]

    def _computed_rows(self, runs: np.ndarray, derivatives: tuple[str, ...]) -> np.ndarray:
        size = power_of_two(len(runs), FEWEST_ROWS)
        places = np.unravel_index(np.resize(runs, size), self.shape)
        values = {
            name: axis[place] for (name, axis), place in zip(self.axes.items(), places, strict=True)
        }
        start = {name: np.asarray(value) for name, value in self.y0.items()}
        known = self.make, self.made_of, tuple(self.names), self.mapped, self.edges
        table = _rows(*known, start, derivatives, values)
        return np.asarray(table)[:, :, : len(runs)]


@jit
def _rows(make, made_of, names, mapped, edges, start, derivatives, values):
    def row(values):
        osc = make(**{name: values[name] for name in names})
        leaves = jax.tree.leaves(in_units_of_run(osc, edges=edges))
        varying = [leaf for leaf, varies in zip(leaves, mapped, strict=True) if varies]
        starts = [jnp.asarray(values.get(name, start[name])) for name in ("x1", "x2")]
        return jnp.stack([*starts, *varying])

    rows = jax.vmap(row, out_axes=1)
    tables = [rows(values)]
    for name in derivatives:
        direction = {n: jnp.full_like(v, float(n == name)) for n, v in values.items()}
        tables.append(jax.jvp(rows, (values,), (direction,))[1])
    return jnp.stack(tables)


class Blocks:
    """A grid cut into boxes of about `size` runs, each a chunk of every variable of a store.

    The last axes are whole in a box as long as there is room for them; other axes are cut evenly.
    """

    def __init__(self, shape: tuple[int, ...], size: int):
        self.shape, box, room = shape, [], size
        for n in reversed(shape):
            box.insert(0, math.ceil(n / math.ceil(n / max(room, 1))))
            room //= box[0] if box[0] == n else room + 1
        self.box = tuple(box)
        self.counts = tuple(math.ceil(n / k) for n, k in zip(shape, box, strict=True))

    def __len__(self) -> int:
        return math.prod(self.counts)

    def slices(self, block: int) -> tuple[slice, ...]:
        """Slices of a block in the grid."""
        place = np.unravel_index(block, self.counts)
        starts = [int(i) * k for i, k in zip(place, self.box, strict=True)]
        ends = map(min, map(sum, zip(starts, self.box, strict=True)), self.shape)
        return tuple(map(slice, starts, ends))

    def extent(self, block: int) -> tuple[int, ...]:
        """Shape of a block: that of the box, or less at the ends of the axes."""
        return tuple(part.stop - part.start for part in self.slices(block))

    def size(self, block: int) -> int:
        """Number of runs in a block."""
        return math.prod(self.extent(block))

    def runs(self, block: int, positions: np.ndarray) -> np.ndarray:
        """Numbers in the grid of the runs at some positions in a block."""
        if len(self) == 1:
            return positions
        inside = np.unravel_index(positions, self.extent(block))
        parts = zip(inside, self.slices(block), strict=True)
        places = tuple(i + part.start for i, part in parts)
        return np.asarray(np.ravel_multi_index(places, self.shape))
