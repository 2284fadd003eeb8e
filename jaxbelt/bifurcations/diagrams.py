"""Pictures of a whole parameter space as data: `bifurcation_diagram` and `region_map`.

A bifurcation diagram is what `scan` leaves between its points, filled in. In the stretch between
two neighbouring points nothing changes in kind, so every equilibrium and every cycle in it can be
computed at as many values as are wanted, all at once: the attracting cycles from where the label
of the stretch says that they are reached from, the unstable ones around stable equilibria. The
values are denser towards the points, where branches go like square roots. At a point, what ends on
one side goes on as what begins there at the same place: through a Hopf point with the other
stability, through a grazing point or an exchange with another signature, and at a nonsmooth fold
back on the same side, from stable to unstable.

A region map is a sweep over two parameters from several starts, each cell named by what its runs
lead to and by the stability of its equilibria. What bounds the regions is not read off the cells:
points are found by `scan` along a few lines across the map, and their curves are followed.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..activity import announced, tell
from ..checks import (
    as_array,
    as_whole,
    check_arguments,
    check_finite,
    check_positive,
    require_one_of,
    require_value,
)
from ..cycles.attractors import Runs, distinct, lead_to_one_cycle, stuck_belts
from ..cycles.cycle import Cycle, find_cycle, polish, unstable_cycle
from ..cycles.shooting import Loop, cut
from ..model.equilibria import EquilibriumKind, candidates, equilibria
from ..model.oscillator import Oscillator
from ..model.variations import Variation
from ..numerics.compiling import jit
from ..results import Status, draw
from ..sweeps.datasets import decoded
from ..sweeps.sweep import sweep
from .conditions import BifurcationPoint
from .curves import FAR, BifurcationCurve, follow_point, is_elsewhere
from .labels import Label
from .path import ParameterPath
from .scan import by_value, edges_touched, search

#: Ends of two pieces of a branch are one place if they differ by less, relative to their size.
SAME = 1e-2


class Branch(eqx.Module):
    """Equilibria or cycles along a path in one parameter: a struct of arrays, a row a value.

    kind: "equilibrium" or "cycle". values: of the parameter, [rows]; they turn back at a fold.
    stable: [rows]. x1_min, x1_max, x2_min, x2_max: the range of the motion, [rows]; of a segment of
    pseudo-equilibria its ends. period, multiplier (the nontrivial one): of a cycle, else NaN.
    stick_durations, stick_velocities: per loop, and of the belt over omega, [rows, belts]; NaN
    where a cycle does not stick to that belt.
    """

    kind: str = eqx.field(static=True)
    values: np.ndarray
    stable: np.ndarray
    x1_min: np.ndarray
    x1_max: np.ndarray
    x2_min: np.ndarray
    x2_max: np.ndarray
    period: np.ndarray
    multiplier: np.ndarray
    stick_durations: np.ndarray
    stick_velocities: np.ndarray

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        ends = f"{self.values[0]:.6g} to {self.values[-1]:.6g}"
        flips = int(np.sum(self.stable[1:] != self.stable[:-1]))
        first = "stable" if self.stable[0] else "unstable"
        return f"Branch({self.kind}, {len(self)} rows, {ends}, {first} first, {flips} changes)"


class BifurcationDiagram(eqx.Module):
    """What `bifurcation_diagram` returns.

    points: the special points in order, as from `scan`, and those at which an unstable cycle
    touches a contact edge; branches: of equilibria, then of cycles; regions: (first, last, name) of
    every stretch between points of `scan`, see `region_name`; oscillator: the one that was given,
    of a function that at the first value; name: of the parameter, as the path to it, or that of the
    function's argument. `plot()` draws it.
    """

    points: tuple[BifurcationPoint, ...]
    branches: tuple[Branch, ...]
    regions: tuple[tuple[float, float, str], ...] = eqx.field(static=True)
    oscillator: Oscillator
    name: str = eqx.field(static=True)

    def plot(self, ax: Any = None, *, quantity: str = "x2") -> Any:
        """Draw it into the axes `ax` (None: new ones), which are returned.

        quantity: "x2", the paper's Figs. 3 and 7: equilibria at x2 = 0, sticking cycles by the
        velocity of the belt, others by their largest x2; or "x1" (smallest and largest), "period".
        """
        return draw(self, ax, quantity=quantity)

    def __repr__(self) -> str:
        names = " | ".join(name for _, _, name in self.regions)
        return (
            f"BifurcationDiagram({self.name}, {len(self.points)} points, "
            f"{len(self.branches)} branches, regions {names})"
        )


@announced("bifurcation_diagram")
def bifurcation_diagram(
    osc: Oscillator | Callable[..., Oscillator],
    where: Callable[[Oscillator], Any] | None = None,
    span: tuple[float, float] | None = None,
    *,
    rows: int = 160,
    resolution: int = 96,
) -> BifurcationDiagram:
    """Equilibria and cycles, stable and unstable, along a path in one parameter.

    osc, where, span, resolution: as for `scan`, which finds the special points. rows: about how
    many values of the parameter are computed. `ValueError` names an impossible argument.
    """
    rows, resolution = as_whole(rows, "rows"), as_whole(resolution, "resolution")
    path = ParameterPath(osc, where, span)
    points = search(path, resolution)
    # A point on an end of the span has one side only.
    inner = [point for point in points if path.first < float(point.value) < path.last]
    ends = [path.first, *(float(point.value) for point in inner), path.last]
    stretches = list(pairwise(ends))
    nodes = [_nodes(path, a, b, rows) for a, b in stretches]
    path.look(np.concatenate(nodes))
    middles = [float(values[len(values) // 2]) for values in nodes]
    labels = [path.label(value) for value in middles]
    tell(f"branches between {len(points)} points")
    for stretch, around in _separated(labels):
        found = edges_touched(path, nodes[stretch], around)
        points = by_value([*points, *found])
        at = [float(point.value) for point in found if point.status == Status.OK]
        nodes[stretch] = np.sort(np.append(nodes[stretch], at))
    path.look(np.concatenate(nodes))
    pieces = [*_equilibrium_pieces(path, nodes), *_cycle_pieces(path, nodes, labels)]
    names = [region_name(path.at(v), label) for v, label in zip(middles, labels, strict=True)]
    return BifurcationDiagram(
        points=points,
        branches=tuple(_joined(pieces, inner)),
        regions=tuple((a, b, name) for (a, b), name in zip(stretches, names, strict=True)),
        oscillator=path.osc,
        name=path.name,
    )


def _nodes(path: ParameterPath, a: float, b: float, rows: int) -> np.ndarray:
    """Values from a to b, dense at both ends, which are left out where they are special."""
    count = max(9, round(rows * (b - a) / path.length))
    inner = 0.5 * (1 - np.cos(np.linspace(0, np.pi, count)))
    first = path.beside(a)[1] if a in path.breaks or a != path.first else a
    last = path.beside(b)[0] if b in path.breaks or b != path.last else b
    return first + (last - first) * inner


def _separated(labels: Sequence[Label]) -> list[tuple[int, int]]:
    """The stretches with unstable cycles, between equilibria and cycles that attract, and the
    number of each such equilibrium."""
    return [
        (stretch, around)
        for stretch, label in enumerate(labels)
        if label.cycles
        for around in range(label.foci)
    ]


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
    """The same, where it is known whether belts run in opposite directions, how many there are,
    whether an equilibrium is stable, and to which belts each of the cycles sticks."""
    number = 2 if rests and cycles else 3 if cycles else 1
    letters = []
    for stuck in cycles:
        code = sum(2**belt for belt in set(stuck))
        letters.append(chr(ord("a") + code - 1) if code else "s")
    tail = "".join(sorted(letters)) if belts > 1 else "s" * letters.count("s")
    return f"{7 - number if opposite else number}{tail}"


class RegionMap(eqx.Module):
    """What `region_map` returns.

    names: of the two parameters, as arguments of `make`; values: of each, [n] and [m]; label: name
    of the region, [n, m], as from `region_name`, "" where the runs were undecided; curves: what
    bounds the regions, see `BifurcationCurve`; cycles: by the name of a region, the cycles in its
    example, attracting ones and the unstable one; make: as given. `example(name)` is a cell well
    inside a region; `table()` has the curves as rows; `plot()` draws the map, with a portrait of
    each region.
    """

    names: tuple[str, str] = eqx.field(static=True)
    values: tuple[np.ndarray, np.ndarray]
    label: np.ndarray
    curves: tuple[BifurcationCurve, ...]
    cycles: dict[str, tuple[Cycle, ...]]
    make: Callable[..., Oscillator] = eqx.field(static=True)

    @property
    def regions(self) -> tuple[str, ...]:
        """The names that occur, in order."""
        return tuple(sorted(set(np.unique(self.label).tolist()) - {""}))

    def example(self, name: str) -> tuple[float, float]:
        """The values of the parameters in the cell of a region that is farthest from its bounds."""
        require_one_of(name, self.regions, "name")
        return _example(self.values, self.label == name)

    def oscillator(self, name: str) -> Oscillator:
        """The oscillator in that cell."""
        return self.make(**dict(zip(self.names, self.example(name), strict=True)))

    def table(self) -> list[dict[str, Any]]:
        """All curves in rows, with their number: see `BifurcationCurve.table`."""
        return [
            {"curve": number, **row}
            for number, curve in enumerate(self.curves)
            for row in curve.table(self.names)
        ]

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
    step = float(as_array(step, "step"))
    check_positive(step, "step")
    lines = as_whole(lines, "lines", 0)
    # Two things that know nothing of each other, most of the first time compiling.
    with ThreadPoolExecutor(1) as beside:
        cells = beside.submit(_cells, make, names, values, dict(axes), starts)
        curves = _bounds(make, names, values, step, lines) if lines else ()
        label, cycles = cells.result()
    pair = (names[0], names[1]), (values[0], values[1])
    return RegionMap(*pair, label, tuple(curves), cycles, make)


def _checked_starts(starts: Any) -> tuple[tuple[float, float], ...]:
    expected = "a list of (x1, x2), such as [(3.0, 0.0)]"
    shape = np.shape(starts) if isinstance(starts, tuple | list | np.ndarray) else ()
    require_value(len(shape) == 2 and shape[0] and shape[1] == 2, "starts", expected, starts)
    rows = as_array(starts, "starts", (None, 2))
    check_finite(rows, "starts")
    return tuple((float(x1), float(x2)) for x1, x2 in np.asarray(rows))


def _cells(make, names, values, axes, starts):
    """The names of all cells, and the cycles in the example of each region."""
    label = _cell_names(make, names, values, axes, starts)
    cycles = {}
    for name in sorted(set(np.unique(label).tolist()) - {""}):
        osc = make(**dict(zip(names, _example(values, label == name), strict=True)))
        cycles[name] = _cycles(osc, starts)
    return label, cycles


def _example(values, inside: np.ndarray) -> tuple[float, float]:
    row, column = interior(inside)
    return float(values[0][row]), float(values[1][column])


def _cycles(osc: Oscillator, starts) -> tuple[Cycle, ...]:
    """The cycles that the starts lead to, and the unstable ones, each once."""
    rests = equilibria(osc)
    foci = int(np.sum(rests.stable & (rests.kind != EquilibriumKind.SEGMENT)))
    repelling = (unstable_cycle(osc, around=number) for number in range(foci))
    return tuple(distinct([*(find_cycle(osc, start) for start in starts), *repelling]))


def _cell_names(make, names, values, axes, starts) -> np.ndarray:
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
            osc = make(**{names[0]: values[0][row], names[1]: values[1][column]})
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
    return np.array(found)[which.reshape(shape)]


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


# --- pieces of branches ---------------------------------------------------------------------------


class _Piece(NamedTuple):
    """A branch within one stretch, rows from left to right, and the number of the stretch."""

    branch: Branch
    stretch: int


def _equilibrium_pieces(path: ParameterPath, nodes: Sequence[np.ndarray]) -> list[_Piece]:
    found = _stacked(candidates, map(path.at, np.concatenate(nodes)))
    pieces = []
    for stretch, rows in enumerate(_consecutive(nodes)):
        values, here = nodes[stretch], jax.tree.map(lambda x, rows=rows: x[rows], found)
        none = np.full(len(values), np.nan)
        per_belt = np.full((len(values), len(path.osc.belts)), np.nan)
        for row in range(int(np.max(np.sum(here.kind > 0, axis=1)))):
            branch = Branch(
                kind="equilibrium",
                values=values,
                stable=here.stable[:, row],
                x1_min=here.x1_lower[:, row],
                x1_max=here.x1_upper[:, row],
                x2_min=np.zeros(len(values)),
                x2_max=np.zeros(len(values)),
                period=none,
                multiplier=none,
                stick_durations=per_belt,
                stick_velocities=per_belt,
            )
            pieces.append(_Piece(branch, stretch))
    return pieces


def _cycle_pieces(
    path: ParameterPath, nodes: Sequence[np.ndarray], labels: Sequence[Label]
) -> list[_Piece]:
    wanted: list[tuple[int, np.ndarray, list[Loop]]] = []
    for stretch in range(len(labels)):
        for loops in path.followed(nodes[stretch].tolist()):
            wanted.append((stretch, np.array(list(loops)), list(loops.values())))
    pieces = []
    if wanted:
        groups = [values for _, values, _ in wanted]
        loops = [loop for _, _, group in wanted for loop in group]
        cycles = _attracting(path, np.concatenate(groups), loops)
        pieces += _as_pieces(path, cycles, groups, [stretch for stretch, _, _ in wanted])
    both = _separated(labels)
    if both:
        groups = [nodes[stretch] for stretch, _ in both]
        arounds = np.repeat([around for _, around in both], [len(group) for group in groups])
        cycles = _repelling(path, np.concatenate(groups), arounds)
        pieces += _as_pieces(path, cycles, groups, [stretch for stretch, _ in both])
    return pieces


def _as_pieces(path: ParameterPath, found: "_Rows", groups, stretches) -> list[_Piece]:
    pieces = []
    for stretch, values, rows in zip(stretches, groups, _consecutive(groups), strict=True):
        fine = found.status[rows] == Status.OK
        if np.any(fine):
            here = jax.tree.map(lambda x, rows=rows[fine]: x[rows], found)
            fields = {name: value for name, value in here._asdict().items() if name != "status"}
            pieces.append(_Piece(Branch(kind="cycle", values=values[fine], **fields), stretch))
    return pieces


class _Rows(NamedTuple):
    """The fields of a `Branch` of cycles, and the status of each."""

    status: Any
    stable: Any
    x1_min: Any
    x1_max: Any
    x2_min: Any
    x2_max: Any
    period: Any
    multiplier: Any
    stick_durations: Any
    stick_velocities: Any


@jit
def _row_of_branch(cycle: Cycle) -> _Rows:
    osc, chain = cycle.oscillator, cycle.chain
    stuck = jnp.any((chain.codes == 0) & chain.used[:, None], axis=0)
    speeds = jnp.stack([belt.velocity / osc.omega for belt in osc.belts])
    return _Rows(
        status=cycle.status,
        stable=cycle.stable,
        x1_min=cycle.x1_min,
        x1_max=cycle.x1_max,
        x2_min=cycle.x2_min,
        x2_max=cycle.x2_max,
        period=cycle.period,
        multiplier=cycle.multiplier,
        stick_durations=jnp.where(stuck, cycle.stick_durations, jnp.nan),
        stick_velocities=jnp.where(stuck, speeds, jnp.nan),
    )


def _consecutive(groups: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The row numbers of each group, when all stand one after another."""
    ends = np.cumsum([len(group) for group in groups])
    return [np.arange(end - len(group), end) for group, end in zip(groups, ends, strict=True)]


# One by one: so one program serves any number of them.


def _stacked(program, items: Iterable[Any]) -> Any:
    """What the program gives of each, as NumPy arrays of many rows."""
    rows = [jax.tree.map(np.asarray, program(item)) for item in items]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def _attracting(path: ParameterPath, values: np.ndarray, loops: Sequence[Loop]) -> _Rows:
    ok = jnp.asarray(Status.OK.value)
    pairs = zip(values, cut(loops), strict=True)
    return _stacked(_row_of_branch, (polish(path.at(value), loop, ok) for value, loop in pairs))


def _repelling(path: ParameterPath, values: np.ndarray, arounds: np.ndarray) -> _Rows:
    pairs = zip(values.tolist(), arounds.tolist(), strict=True)
    return _stacked(_row_of_branch, (path.unstable(value, around) for value, around in pairs))


# --- from pieces to branches ----------------------------------------------------------------------


class _End(NamedTuple):
    """An end of a piece (its number, and whether it is the right one), and where it is."""

    piece: int
    right: bool
    place: tuple[str, float, float]


def _joined(pieces: Sequence[_Piece], points: Sequence[BifurcationPoint]) -> list[Branch]:
    """Branches through the points: two ends of pieces that are one place there belong together."""
    partner: dict[tuple[int, bool], tuple[int, bool]] = {}
    for at, point in enumerate(points):
        if not point.condition.joins:
            continue
        ends = [
            _end(i, piece, right=piece.stretch == at)
            for i, piece in enumerate(pieces)
            if piece.stretch in (at, at + 1)
        ]
        pairs = sorted(
            (_distance(a, b), i, j) for (i, a), (j, b) in combinations(enumerate(ends), 2)
        )
        taken: set[int] = set()
        for distance, i, j in pairs:
            if distance < SAME and not taken & {i, j}:
                taken |= {i, j}
                for a, b in ((ends[i], ends[j]), (ends[j], ends[i])):
                    partner[a.piece, a.right] = (b.piece, b.right)
    branches, left = [], set(range(len(pieces)))
    while left:
        # Begin at an end that has no partner; a closed branch may begin anywhere.
        free = [(i, r) for i in sorted(left) for r in (False, True) if (i, r) not in partner]
        at = (free or [(min(left), False)])[0]
        chain = []
        while at is not None and at[0] in left:
            left.remove(at[0])
            branch = pieces[at[0]].branch
            chain.append(_reversed(branch) if at[1] else branch)
            at = partner.get((at[0], not at[1]))
        branches.append(jax.tree.map(lambda *leaves: np.concatenate(leaves), *chain))
    return branches


def _end(number: int, piece: _Piece, *, right: bool) -> _End:
    branch, row = piece.branch, -1 if right else 0
    return _End(number, right, (branch.kind, float(branch.x1_min[row]), float(branch.x1_max[row])))


def _distance(a: _End, b: _End) -> float:
    """How far apart two ends are, relative to the motion there."""
    (kind, *x), (other, *y) = a.place, b.place
    size = max(x[1] - x[0], y[1] - y[0], 0.1)
    return max(abs(x[0] - y[0]), abs(x[1] - y[1])) / size if kind == other else np.inf


def _reversed(branch: Branch) -> Branch:
    return jax.tree.map(lambda leaf: leaf[::-1], branch)
