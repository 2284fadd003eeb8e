"""The regions of a plane of two parameters: `region_map`, and how regions are named.

A region map is a sweep over two parameters from several starts, each cell named by what its runs
lead to and by the stability of its equilibria. What bounds the regions is not read off the cells:
points are found by `scan` along a few lines across the map, and their curves are followed.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..activity import announced, tell
from ..checks import (
    as_array,
    as_positive,
    as_whole,
    check_arguments,
    check_finite,
    require_one_of,
    require_value,
)
from ..cycles.attractors import Runs, distinct, itinerary, lead_to_one_cycle, stuck_belts
from ..cycles.cycle import Cycle, find_cycle, unstable_cycle
from ..model.equilibria import EquilibriumKind, equilibria
from ..model.oscillator import Oscillator
from ..model.variations import Variation
from ..numerics.compiling import jit
from ..presets import class_b
from ..results import Status, draw
from ..sweeps.datasets import decoded
from ..sweeps.sweep import sweep
from ..tables import table_of
from .conditions import BifurcationPoint
from .curves import FAR, BifurcationCurve, follow_point, is_elsewhere
from .faces import Faces
from .labels import Label
from .path import ParameterPath
from .scan import search

if TYPE_CHECKING:
    import pandas

#: Velocities that differ by less are one, but for rounding.
SAME_VELOCITY = 1e-12


def region_name(osc: Oscillator, label: Label) -> str:
    """The name of what a label tells, in the manner of the paper's Fig. 6.

    A digit: 1 there is a stable equilibrium only; 2 a stable cycle, too; 3 a stable cycle only.
    Where belts run in opposite directions these are 6, 5 and 4. With several belts a letter tells
    what the cycle sticks to: a belt 0, b belt 1, c both (belts as binary digits, for more of them),
    s none. Of several cycles each has its letter.
    """
    velocities = [float(belt.velocity) for belt in osc.belts]
    opposite = min(velocities) < 0 < max(velocities)
    rests = any(stable for _, stable, _ in label.equilibria)
    return region_of(opposite, len(velocities), rests, [stuck_belts(path) for path in label.cycles])


def region_of(opposite: bool, belts: int, rests: bool, cycles: Sequence[Collection[int]]) -> str:
    """The name of a region, see `region_name`, by what is known of it.

    opposite: whether belts run in opposite directions; belts: how many there are; rests: whether an
    equilibrium is stable; cycles: the belts to which each of them sticks.
    """
    number = 2 if rests and cycles else 3 if cycles else 1
    letters = []
    for stuck in cycles:
        code = sum(2**belt for belt in set(stuck))
        letters.append(chr(ord("a") + code - 1) if code else "s")
    tail = "".join(sorted(letters)) if belts > 1 else "s" * letters.count("s")
    return f"{7 - number if opposite else number}{tail}"


def in_plane_of_paper(oscillators: Sequence[Oscillator]) -> bool:
    """Whether oscillators are those of the plane of the paper's Fig. 6, where regions have their
    names: class (b) with its friction, loads and damping, and any velocities of the belts."""

    def is_there(osc: Oscillator) -> bool:
        paper = class_b(*([belt.velocity for belt in osc.belts] * 2)[:2])
        same = jax.tree.structure(osc) == jax.tree.structure(paper)
        pairs = zip(jax.tree.leaves(osc), jax.tree.leaves(paper), strict=True) if same else ()
        return same and all(np.array_equal(one, other) for one, other in pairs)

    return all(map(is_there, oscillators))


class RegionMap(eqx.Module):
    """What `region_map` returns.

    names: of the two parameters, as arguments of `make`; values: of each, [n] and [m]; label: name
    of the region, [n, m], see below, "" where the runs were undecided; curves: what bounds the
    regions, see `BifurcationCurve`; cycles: by the name of a region, the cycles in its example,
    attracting ones and the unstable one; on_line: cells where a belt is at rest, or two run at one
    velocity, [n, m]: what is so on that line only is the name of these; between: (p, q, name) in
    each part of the plane between curves in which there is no other cell; make: as given.
    `words` says what the names mean; `example(name)` is a cell well inside a region; `table()` has
    the curves as rows; `plot()` draws the map, with a portrait of each region.

    In the name of a region a digit says what attracts: 1 an equilibrium only, 2 a cycle, too, 3
    cycles only; 6, 5 and 4 are the same where belts run in opposite directions. With several belts
    a letter for each cycle says what it sticks to: a belt 0, b belt 1, c both (d belt 2, and on as
    binary digits); s, with one belt too, is a cycle that never sticks. These are the names of the
    paper's Fig. 6; pictures show them in its plane only, as notebook 03 does.
    """

    names: tuple[str, str] = eqx.field(static=True)
    values: tuple[np.ndarray, np.ndarray]
    label: np.ndarray
    curves: tuple[BifurcationCurve, ...]
    cycles: dict[str, tuple[Cycle, ...]]
    on_line: np.ndarray
    between: tuple[tuple[float, float, str], ...] = eqx.field(static=True)
    make: Callable[..., Oscillator] = eqx.field(static=True)

    @property
    def regions(self) -> tuple[str, ...]:
        """The names that occur, in order."""
        return tuple(sorted(set(np.unique(self.label).tolist()) - {""}))

    @property
    def words(self) -> dict[str, str]:
        """What the name of each region says: what attracts, and which belts each cycle sticks to;
        that belts run in opposite directions where that differs. As in the key of `plot()`."""
        names = sorted({*self.regions, *(name for *_, name in self.between)})
        opposite = {name: f"; {OPPOSITE}" * (name[0] in "456") for name in names}
        if len(set(opposite.values())) < 2:
            opposite = dict.fromkeys(names, "")
        belts = len(self.oscillator(self.regions[0]).belts) if self.regions else 1
        return {name: _attractors_of(name, belts) + opposite[name] for name in names}

    def example(self, name: str) -> tuple[float, float]:
        """The values of the parameters in the cell of a region that is farthest from its bounds."""
        require_one_of(name, self.regions, "name")
        return _example(self.values, self.label == name)

    def oscillator(self, name: str) -> Oscillator:
        """The oscillator in that cell."""
        return _at(self.make, self.names, self.example(name))

    @property
    def as_paper(self) -> bool:
        """Whether the plane is that of the paper's Fig. 6, the velocities of the paper's class (b):
        pictures show the names of the regions there only."""
        corners = [(p, q) for p in self.values[0][[0, -1]] for q in self.values[1][[0, -1]]]
        return in_plane_of_paper([_at(self.make, self.names, corner) for corner in corners])

    def raster(self) -> np.ndarray:
        """The name at every point of an even raster over the plane, on the side of each exact curve
        that the point is on, [pixels, pixels], the first parameter along the rows."""
        faces, points, names = _faces_of(self.values, self.label, self.on_line, self.curves)
        extra = [(p, q) for p, q, _ in self.between]
        points = np.concatenate([points, np.array(extra).reshape(-1, 2)])
        return faces.named(points, [*names, *(name for *_, name in self.between)])

    def table(self) -> "pandas.DataFrame":
        """All curves in rows, with their number: see `BifurcationCurve.table`."""
        return table_of(
            [
                {"curve": number, **row}
                for number, curve in enumerate(self.curves)
                for row in curve.table(self.names).to_dict("records")
            ]
        )

    def plot(self, ax: Any = None) -> Any:
        """Draw the map into the axes `ax`, which are returned.

        None: new ones, and a sketch of the phase portrait of each region in its example beside
        them, as in the paper's Fig. 6.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        sizes = " x ".join(str(len(values)) for values in self.values)
        return (
            f"RegionMap({self.names[0]}, {self.names[1]}: {sizes} cells, "
            f"regions {' '.join(self.regions)}, {len(self.curves)} curves)"
        )


#: How the words for a region end whose belts run in opposite directions.
OPPOSITE = "belts opposite"


def _attractors_of(name: str, belts: int) -> str:
    """In words what attracts in a region of that name, of so many belts."""
    digit, letters = name[:1], name[1:]
    words = ["rest"] if digit in ("1", "2", "5", "6") else []
    if belts == 1:
        words += {"2": ["cycle"], "3": ["cycle"]}.get(digit, [])
        words = [f"{word} without sticking" if "s" in letters else word for word in words]
    for letter in letters if belts > 1 else "":
        code = ord(letter) - ord("a") + 1
        stuck = [str(belt) for belt in range(belts) if code >> belt & 1] if letter != "s" else []
        which = f"belt{'s' * (len(stuck) > 1)} {', '.join(stuck)}"
        words.append(f"cycle on {which}" if stuck else "cycle without sticking")
    return "; ".join(words)


def interior(inside: np.ndarray) -> tuple[int, int]:
    """Row and column of the cell that is farthest from where a region ends, and from the rim.

    Of several the last one: where the plane is symmetric, that with the larger parameters.
    """
    from scipy.ndimage import distance_transform_edt  # a quarter of a second that only maps need

    depth = np.asarray(distance_transform_edt(np.pad(inside, 1)))[1:-1, 1:-1]
    row, column = np.argwhere(depth > np.max(depth) - 1e-9)[-1]
    return int(row), int(column)


@announced("region_map")
def region_map(
    make: Callable[..., Oscillator],
    axes: Mapping[str, ArrayLike],
    *,
    starts: Sequence[tuple[float, float]] = ((3.0, 0.0), (0.0, 0.0), (-2.0, -0.5)),
    step: float = 0.01,
    lines: int = 4,
) -> RegionMap:
    """Which motions there are in each cell of a plane of two parameters, and what bounds them.

    make: gives an `Oscillator`, such as `jb.presets.class_b`; axes: two of its arguments and their
    values, increasing. starts: where each cell is run from; what attracts none of them is not seen.
    step: between the points of the curves, in units of the larger side of the map / 1.4; lines: on
    how many lines parallel to each axis curves are looked for, 0 for none. `ValueError` names an
    impossible argument.
    """
    expected = "a dictionary, two arguments of make and their values"
    require_value(isinstance(axes, Mapping) and len(axes) == 2, "axes", expected, axes)
    names = tuple(axes)
    check_arguments(make, names, "make")
    values = [np.asarray(as_array(axes[name], name, (None,))) for name in names]
    for name, along in zip(names, values, strict=True):
        increases = along.size > 1 and np.all(np.diff(along) > 0)
        require_value(increases, name, "two values or more that increase", along)
    starts = _checked_starts(starts)
    step = as_positive(step, "step")
    lines = as_whole(lines, "lines", 0)
    # Two things that know nothing of each other, most of the first time compiling.
    with ThreadPoolExecutor(1) as beside:
        cells = beside.submit(_cells, make, names, values, dict(axes), starts)
        curves = _bounds(make, names, values, step, lines) if lines else ()
        label, cycles, on_line = cells.result()
    pair = (names[0], names[1]), (values[0], values[1])
    between = _names_between(make, names, pair[1], label, on_line, curves, starts)
    return RegionMap(*pair, label, tuple(curves), cycles, on_line, between, make)


def _at(make, names, pair) -> Oscillator:
    return make(**dict(zip(names, map(float, pair), strict=True)))


def _faces_of(values, label, on_line, curves) -> tuple[Faces, np.ndarray, list[str]]:
    """The faces of a map, and the cells that tell what is in an area, with their names."""
    (p, q), told = values, (label != "") & ~on_line
    faces = Faces(((p[0], p[-1]), (q[0], q[-1])), [curve.path for curve in curves])
    rows, columns = np.nonzero(told)
    return faces, np.column_stack([p[rows], q[columns]]), label[told].tolist()


def _names_between(make, names, values, label, on_line, curves, starts):
    """What there is in each part of the plane between curves in which there is no cell."""
    if not curves:
        return ()
    faces, points, _ = _faces_of(values, label, on_line, curves)
    found = []
    for p, q in faces.unnamed(points):
        osc = _at(make, names, (p, q))
        cycles = [cycle for cycle in _cycles(osc, starts) if bool(cycle.stable)]
        rests, velocities = _at_cells(make, names, jnp.asarray([[p, q]]))
        opposite = bool(jnp.min(velocities) < 0 < jnp.max(velocities))
        stuck = [stuck_belts(itinerary(osc, cycle.chain)) for cycle in cycles]
        if bool(rests[0]) or stuck:
            name = region_of(opposite, len(osc.belts), bool(rests[0]), stuck)
            found.append((p, q, name))
    return tuple(found)


def _checked_starts(starts: Any) -> tuple[tuple[float, float], ...]:
    expected = "a list of (x1, x2), such as [(3.0, 0.0)]"
    shape = np.shape(starts) if isinstance(starts, tuple | list | np.ndarray) else ()
    require_value(len(shape) == 2 and shape[0] and shape[1] == 2, "starts", expected, starts)
    rows = as_array(starts, "starts", (None, 2))
    check_finite(rows, "starts")
    return tuple((float(x1), float(x2)) for x1, x2 in np.asarray(rows))


def _cells(make, names, values, axes, starts):
    """The names of all cells, the cycles in the example of each region, and which cells lie on a
    line where velocities meet."""
    label, on_line = _cell_names(make, names, values, axes, starts)
    cycles = {}
    for name in sorted(set(np.unique(label).tolist()) - {""}):
        osc = _at(make, names, _example(values, label == name))
        cycles[name] = _cycles(osc, starts)
    return label, cycles, on_line


def _example(values, inside: np.ndarray) -> tuple[float, float]:
    row, column = interior(inside)
    return float(values[0][row]), float(values[1][column])


def _cycles(osc: Oscillator, starts) -> tuple[Cycle, ...]:
    """The cycles that the starts lead to, and the unstable ones, each once."""
    rests = equilibria(osc)
    foci = int(np.sum(rests.stable & (rests.kind != EquilibriumKind.SEGMENT)))
    repelling = (unstable_cycle(osc, around=number) for number in range(foci))
    return tuple(distinct([*(find_cycle(osc, start) for start in starts), *repelling]))


def _cell_names(make, names, values, axes, starts) -> tuple[np.ndarray, np.ndarray]:
    runs = [sweep(make, axes, y0=start, observe="attractor") for start in starts]
    grid = np.meshgrid(*values, indexing="ij")
    rests, velocities = _at_cells(make, names, jnp.asarray(np.stack([g.ravel() for g in grid], 1)))
    shape = grid[0].shape
    stable = np.asarray(rests).reshape(shape)
    velocities = np.asarray(velocities).reshape(*shape, -1)
    n = velocities.shape[-1]
    seen = np.zeros((*shape, len(runs)), dtype=int)  # 0 no cycle, else 1 + the belts stuck to
    decided = np.ones(shape, dtype=bool)
    for i, run in enumerate(runs):
        kind = decoded(run[["kind"]]).kind.transpose(*names).values
        sticks = run.sticks.transpose(*names, "belt").values
        seen[..., i] = np.where(kind == "cycle", 1 + sticks @ 2 ** np.arange(n), 0)
        decided &= kind != "undecided"
    # Each cycle once.
    tell = [Runs.of(run, names) for run in runs]
    for i, j in combinations(range(len(runs)), 2):
        both = (seen[..., i] > 0) & (seen[..., j] > 0)
        same, doubtful = tell[i].same(tell[j])
        for row, column in np.argwhere(both & doubtful):
            osc = _at(make, names, (values[0][row], values[1][column]))
            same[row, column] = lead_to_one_cycle(osc, starts[i], starts[j])
        seen[..., j] = np.where(both & same, 0, seen[..., j])
    opposite = (velocities.min(-1) < 0) & (velocities.max(-1) > 0)
    facts = np.concatenate([stable[..., None], opposite[..., None], decided[..., None], seen], -1)
    kinds, which = np.unique(facts.reshape(-1, facts.shape[-1]), axis=0, return_inverse=True)
    found = []
    for rest, against, known, *codes in kinds.tolist():
        cycles = [[b for b in range(n) if (code - 1) >> b & 1] for code in codes if code]
        name = region_of(bool(against), n, bool(rest), cycles)
        found.append(name if known and (rest or cycles) else "")
    # A belt is at rest where it runs at the velocity of one that does not.
    others = np.append(velocities, np.zeros((*shape, 1)), axis=-1)
    apart = velocities[..., :, None] - others[..., None, :]
    meet = np.abs(apart) < SAME_VELOCITY
    on_line = np.any(meet & ~np.eye(n, n + 1, dtype=bool), axis=(-2, -1))
    return np.array(found)[which.reshape(shape)], on_line


@jit
def _at_cells(make, names, cells: Array) -> tuple[Array, Array]:
    def one(pair):
        osc = make(**dict(zip(names, pair, strict=True)))
        rests = equilibria(osc)
        stable = jnp.any((rests.kind > 0) & rests.stable)
        return stable, jnp.stack([belt.velocity for belt in osc.belts])

    return jax.vmap(one)(cells)


def _bounds(make, names, values, step, lines) -> list[BifurcationCurve]:
    """The curve of every point on a few lines, each curve once."""

    def at(p, q):
        return make(**dict(zip(names, (p, q), strict=True)))

    span = tuple((float(along[0]), float(along[-1])) for along in values)
    step = step * max(b - a for a, b in span) / 1.4
    across = [
        (along, float(fixed))
        for along in (0, 1)
        for a, b in [span[1 - along]]
        for fixed in a + (b - a) * (np.arange(lines) + 0.37) / lines
    ]

    def points_on(along: int, fixed: float) -> tuple[BifurcationPoint, ...]:
        return search(ParameterPath(variation.held(1 - along, fixed), None, span[along]))

    limits, corner = np.array(span), [ends[0] for ends in span]
    variation = replace(Variation.of_function(at, corner, "make"), names=names)
    curves: list[BifurcationCurve] = []
    # The next lines are searched while curves are followed from those before.
    with ThreadPoolExecutor(1) as ahead:
        searches = [(line, ahead.submit(points_on, *line)) for line in across]
        for count, ((along, fixed), found) in enumerate(searches, 1):
            for point in found.result():
                tell(f"{len(curves)} curves from {count} of {len(across)} lines")
                pair = np.empty(2)
                pair[along], pair[1 - along] = float(point.value), fixed
                if point.status == Status.OK and not any(
                    _lies_on(point, pair, curve, step) for curve in curves
                ):
                    curves.append(follow_point(variation, point, pair, limits, step=step))
    return curves


def _lies_on(point: BifurcationPoint, at: np.ndarray, curve: BifurcationCurve, step: float) -> bool:
    """Whether a point is on a curve that is known."""
    if point.condition.lineage != curve.condition.lineage:
        return False
    a, b = curve.values[:-1], curve.values[1:]
    chord = b - a
    along = np.sum((at - a) * chord, axis=1) / np.maximum(np.sum(chord**2, axis=1), 1e-300)
    along = np.clip(along, 0, 1)[:, None]
    away = np.hypot(*(at - a - along * chord).T)
    places = curve.places[:-1] + along * (curve.places[1:] - curve.places[:-1])
    own = point.place
    return any(
        not is_elsewhere(own, places[i], FAR) for i in np.flatnonzero(away < 0.3 * step).tolist()
    )
