"""The regions of a plane of two parameters: `region_map`.

Each cell of the plane is named after its motions (see `cells`). The bounds of the regions are not
read off the cells: curves of bifurcation points are followed, until they pass between all
neighbouring cells that differ (see `bounds`).
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike

from ..activity import announced, note_progress
from ..checks import (
    as_array,
    as_finite,
    as_positive,
    as_whole,
    check_arguments,
    outside_of_traces,
    refuse_interval,
    require_one_of,
    require_value,
)
from ..cycles.cycle import Cycle
from ..cycles.portrait import portrait
from ..model.oscillator import Oscillator
from ..model.variations import Variation
from ..numerics.widths import as_here
from ..results import draw
from ..tables import table_of
from .bounds import Bounds, Pair
from .cells import belts_of_letters, in_plane_of_paper, made_at, motions_in_cells
from .curves import BifurcationCurve, given_curve
from .faces import Faces

if TYPE_CHECKING:
    import pandas


class RegionMap(eqx.Module):
    """The regions of a plane of two parameters; what `region_map` returns.

    `words` explains the names; `example(name)` is a cell well inside a region; `table()` has the
    curves as rows; `plot()` draws the map, with a portrait of each region.

    In the name of a region a digit says what attracts: 1 an equilibrium only, 2 a cycle, too, 3
    cycles only; 6, 5 and 4 are the same where belts run in opposite directions. With several belts
    a letter for each cycle says what it sticks to: a belt 0, b belt 1, c both (d belt 2, and so on,
    belts as binary digits; with five belts or more some sets as [0,1,4]); s, also with one belt, is
    a cycle that never sticks. These are the names of the paper's Fig. 6; pictures show them in its
    plane only, as notebook 03 does.

    Attributes:
        names: Names of the two parameters, arguments of `make`.
        values: Values of each, [n] and [m].
        label: Names of the regions, [n, m], "" where the runs were undecided.
        curves: Bounds of the regions, see `BifurcationCurve`.
        cycles: By the name of a region, the cycles in its example, attracting ones first, then
            unstable ones.
        on_line: Cells where a belt is at rest or without load, or two belts have one velocity,
            [n, m], unless this is so in all of them; their names hold on that line only.
        between: (p, q, name) in each part of the plane between curves that contains no cell.
        make: The given function.
        uncovered: Pairs of neighbouring cells, ((p, q), (p, q)), that differ, though no curve
            passes within half a cell and none was found between them.
    """

    names: tuple[str, str] = eqx.field(static=True)
    values: tuple[np.ndarray, np.ndarray]
    label: np.ndarray
    curves: tuple[BifurcationCurve, ...]
    cycles: dict[str, tuple[Cycle, ...]]
    on_line: np.ndarray
    between: tuple[tuple[float, float, str], ...] = eqx.field(static=True)
    make: Callable[..., Oscillator] = eqx.field(static=True)
    uncovered: tuple[Pair, ...] = eqx.field(static=True, default=())

    @property
    def regions(self) -> tuple[str, ...]:
        """The names that occur, in order."""
        return tuple(sorted(set(np.unique(self.label).tolist()) - {""}))

    @property
    def words(self) -> dict[str, str]:
        """Meaning of the name of each region, as in the key of `plot()`.

        It says what attracts, which belts each cycle sticks to, and, where regions differ in this,
        that belts run in opposite directions.
        """
        names = sorted({*self.regions, *(name for *_, name in self.between)})
        opposite = {name: f"; {OPPOSITE}" * (name[0] in "456") for name in names}
        if len(set(opposite.values())) < 2:
            opposite = dict.fromkeys(names, "")
        belts = len(self.oscillator(self.regions[0]).belts) if self.regions else 1
        heads = {name: name.partition(":")[0] for name in names}  # without equilibria
        return {name: _attractors_of(heads[name], belts) + opposite[name] for name in names}

    def example(self, name: str) -> tuple[float, float]:
        """The cell of a region that is farthest from its bounds.

        Args:
            name: Name of the region.

        Returns:
            The values of the parameters in that cell.

        Raises:
            ValueError: If there is no such region.
        """
        require_one_of(name, self.regions, "name")
        return _example(self.values, self.label == name)

    def oscillator(self, name: str) -> Oscillator:
        """The oscillator in the cell of `example`."""
        return made_at(self.make, self.names, self.example(name))

    @property
    def as_paper(self) -> bool:
        """Whether the plane is that of the paper's Fig. 6, the velocities of the paper's class (b).

        Pictures show the names of the regions there only.
        """
        corners = [(p, q) for p in self.values[0][[0, -1]] for q in self.values[1][[0, -1]]]
        return in_plane_of_paper([made_at(self.make, self.names, corner) for corner in corners])

    def raster(self) -> np.ndarray:
        """Names on an even raster over the plane, [pixels, pixels], the first parameter along the
        rows.

        Every point has the name of its own side of each exact curve.
        """
        faces, points, names = _faces_of(self.values, self.label, self.on_line, self.curves)
        extra = [(p, q) for p, q, _ in self.between]
        points = np.concatenate([points, np.array(extra).reshape(-1, 2)])
        return faces.named(points, [*names, *(name for *_, name in self.between)])

    def table(self) -> "pandas.DataFrame":
        """Returns all curves in rows, with their number; other columns: see
        `BifurcationCurve.table`."""
        return table_of(
            [
                {"curve": number, **row}
                for number, curve in enumerate(self.curves)
                for row in curve.table(self.names).to_dict("records")
            ]
        )

    def plot(self, ax: Any = None) -> Any:
        """Draws the map.

        Args:
            ax: Axes. None makes new ones, and beside them a sketch of the phase portrait of each
                region in its example, as in the paper's Fig. 6.

        Returns:
            The axes of the map.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        sizes = " x ".join(str(len(values)) for values in self.values)
        count = len(self.uncovered)
        missing = f", none between {count} pairs of cells that differ" * bool(count)
        return (
            f"RegionMap({self.names[0]}, {self.names[1]}: {sizes} cells, "
            f"regions {' '.join(self.regions)}, {len(self.curves)} curves"
            f"{missing})"
        )


#: End of the words for a region whose belts run in opposite directions.
OPPOSITE = "belts opposite"


def _attractors_of(name: str, belts: int) -> str:
    """Words for what attracts in a region of that name; belts: their number."""
    digit, letters = name[:1], name[1:]
    words = ["rest"] if digit in ("1", "2", "5", "6") else []
    if belts == 1:
        words += {"2": ["cycle"], "3": ["cycle"]}.get(digit, [])
        words = [f"{word} without sticking" if "s" in letters else word for word in words]
    for stuck in belts_of_letters(letters) if belts > 1 else []:
        which = f"belt{'s' * (len(stuck) > 1)} {', '.join(map(str, stuck))}"
        words.append(f"cycle on {which}" if stuck else "cycle without sticking")
    return "; ".join(words)


def interior(inside: np.ndarray) -> tuple[int, int]:
    """Row and column of the cell of a region that is farthest from its bounds and from the rim.

    inside: mask of the region, [n, m]. Of several such cells the last one is taken: in a symmetric
    plane that with the larger parameters.
    """
    # import takes a quarter of a second, which only maps need
    from scipy.ndimage import distance_transform_edt

    depth = np.asarray(distance_transform_edt(np.pad(inside, 1)))[1:-1, 1:-1]
    row, column = np.argwhere(depth > np.max(depth) - 1e-9)[-1]
    return int(row), int(column)


@announced("region_map")
@outside_of_traces
def region_map(
    make: Callable[..., Oscillator],
    axes: Mapping[str, ArrayLike],
    *,
    starts: Sequence[tuple[float, float]] = (),
    step: float = 0.01,
    lines: int = 4,
) -> RegionMap:
    """The regions of a plane of two parameters, with the exact curves that bound them.

    Args:
        make: Function that returns an `Oscillator`, such as `jb.presets.class_b`.
        axes: Two of its arguments and their values, increasing.
        starts: Further starts, (x1, x2), of the runs in each cell. The starts from which `scan`
            follows orbits are always taken; an attractor that none of them leads to is not seen.
        step: Distance between the points of curves, in units of the larger side of the map / 1.4.
        lines: Number of lines parallel to each axis on which curves are searched first; then they
            are searched between the cells that differ. 0: no curves.

    Returns:
        The `RegionMap`.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    expected = "a dictionary, two arguments of make and their values"
    require_value(isinstance(axes, Mapping) and len(axes) == 2, "axes", expected, axes)
    names = tuple(axes)
    check_arguments(make, names, "make")
    for name in names:
        refuse_interval(axes[name], name)
    values = [np.asarray(as_array(axes[name], name, (None,))) for name in names]
    for name, along in zip(names, values, strict=True):
        increases = along.size > 1 and np.all(np.diff(along) > 0)
        require_value(increases, name, "two values or more that increase", along)
    further = _checked_starts(starts)
    step = as_positive(step, "step")
    lines = as_whole(lines, "lines", 0)
    span = names[0], names[1]
    given = varied_by_names(make, span, values)
    corners = [np.array(pair) for pair in product(*([one[0], one[-1]] for one in values))]
    variation = given.in_own_units(*corners)
    length, units = variation.own.length, variation.own.parameters
    bounds = Bounds(variation, [one / unit for one, unit in zip(values, units)], step)
    own_starts = tuple((x1 / length, x2 / length) for x1, x2 in further)

    def own(**numbers):
        return variation.own.of(make(**numbers))

    # Motions in cells and curves are independent; in a first call both mostly compile.
    with ThreadPoolExecutor(1) as beside:
        seen = beside.submit(as_here(_motions_in_all), own, span, values, own_starts)
        if lines:
            bounds.search_lines(lines)
        label, motions, on_line = seen.result()
    uncovered = bounds.search_between(motions, on_line) if lines else ()
    bounds.name_ends()
    curves = tuple(given_curve(curve, variation) for curve in bounds.curves)
    cycles = _cycles_of_examples(make, span, values, label)
    between = _names_between(own, span, values, label, on_line, curves, own_starts)
    pair = values[0], values[1]
    first, second = units.tolist()
    pairs = tuple(
        ((a * first, b * second), (c * first, d * second)) for (a, b), (c, d) in uncovered
    )
    return RegionMap(span, pair, label, curves, cycles, on_line, between, make, pairs)


def varied_by_names(make, names: tuple[str, str], values: Sequence[np.ndarray]) -> Variation:
    """The variation of two arguments of `make`; values: possible values of each."""

    def at(p, q):
        return make(**dict(zip(names, (p, q), strict=True)))

    corner = [float(along[0]) for along in values]
    return replace(Variation.of_function(at, corner, "make"), names=names)


def _motions_in_all(make, names, values, starts):
    """Names of all cells, numbers of the motions in them, and whether they lie on a line, see
    `Cells`, [n, m] each."""
    grid = np.meshgrid(*values, indexing="ij")
    cells = motions_in_cells(make, names, np.column_stack([axis.ravel() for axis in grid]), starts)
    shape = grid[0].shape
    return cells.names.reshape(shape), cells.motions.reshape(shape), cells.on_line.reshape(shape)


def _cycles_of_examples(make, names, values, label) -> dict[str, tuple[Cycle, ...]]:
    """The cycles in the example of each region."""
    cycles = {}
    for name in sorted(set(np.unique(label).tolist()) - {""}):
        note_progress(f"the portrait of region {name}")
        found = portrait(made_at(make, names, _example(values, label == name)))
        cycles[name] = (*found.cycles, *found.unstable)
    return cycles


def _faces_of(values, label, on_line, curves) -> tuple[Faces, np.ndarray, list[str]]:
    """The faces of a map, and the cells that name them: their points, [cells, 2], and names."""
    (p, q), known = values, label != ""
    if np.any(known & ~on_line):
        known = known & ~on_line
    faces = Faces(((p[0], p[-1]), (q[0], q[-1])), [curve.path for curve in curves])
    rows, columns = np.nonzero(known)
    return faces, np.column_stack([p[rows], q[columns]]), label[known].tolist()


def _names_between(make, names, values, label, on_line, curves, starts):
    """The motions in each part of the plane between curves that contains no cell."""
    if not curves:
        return ()
    faces, points, _ = _faces_of(values, label, on_line, curves)
    unnamed = faces.unnamed(points)
    if not unnamed:
        return ()
    found = motions_in_cells(make, names, np.array(unnamed), starts).names.tolist()
    return tuple((*point, name) for point, name in zip(unnamed, found, strict=True) if name)


def _checked_starts(starts: Any) -> tuple[tuple[float, float], ...]:
    expected = "a list of (x1, x2), such as [(3.0, 0.0)]"
    if isinstance(starts, tuple | list) and not starts:
        return ()
    shape = np.shape(starts) if isinstance(starts, tuple | list | np.ndarray) else ()
    require_value(len(shape) == 2 and shape[0] and shape[1] == 2, "starts", expected, starts)
    rows = as_finite(starts, "starts", (None, 2))
    return tuple((float(x1), float(x2)) for x1, x2 in np.asarray(rows))


def _example(values, inside: np.ndarray) -> tuple[float, float]:
    row, column = interior(inside)
    return float(values[0][row]), float(values[1][column])
