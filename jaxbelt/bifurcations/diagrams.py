"""Equilibria and cycles along a path in one parameter: `bifurcation_diagram`.

A bifurcation diagram fills in what lies between the points of `scan`. Between two neighbouring
points nothing changes in kind, so every equilibrium and every cycle there can be computed at any
number of values, all at once: the attracting cycles from the loops of the label of the stretch, the
unstable ones around stable equilibria. The values are denser towards the points, where branches go
like square roots. At a point, the branch that ends on one side continues with the one that begins
there at the same place: through a Hopf point with the other stability, through a grazing point or
an exchange with another signature, and at a nonsmooth fold back on the same side, from stable to
unstable.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..activity import announced, note_progress
from ..checks import as_whole, outside_of_traces, require, require_value
from ..cycles.attractors import MAYBE_SAME, MOMENT, distance
from ..cycles.chains import Loop, cut
from ..cycles.clocked import turns_of
from ..cycles.cycle import Cycle, exactly, polish, warn_of_fast_loops
from ..cycles.periodic import PeriodicMotion
from ..cycles.unstable import from_starts
from ..dimensions import EXTENT
from ..model.equilibria import candidates
from ..model.events import signature_name
from ..model.oscillator import Oscillator, has_clock
from ..model.own_units import in_own_units, quantity, rescaled
from ..model.parameters import leaf_index
from ..model.variations import Variation, as_span, varied
from ..numerics.compiling import jit
from ..results import Status, draw
from ..tables import per_belt, table_of
from .base import BifurcationPoint, given_point
from .branches import MotionRow, forced_branches
from .cells import in_plane_of_paper, region_name
from .forced import motions_to_begin_from, place_of_motion
from .labels import Label
from .path import ParameterPath
from .scan import by_value, edges_touched, is_at_one_value, search

if TYPE_CHECKING:
    import pandas

#: Smallest size by which distances between ends of branches are measured.
LEAST_SIZE = 0.1


class Branch(eqx.Module):
    """Equilibria or cycles along a path in one parameter: a struct of arrays, one row for each
    value.

    Attributes:
        kind: "equilibrium" or "cycle".
        values: Values of the parameter, [rows]; they turn back at a fold.
        stable: Stability, [rows].
        neutral: Whether it is a centre, see `Equilibria`, [rows]; no cycle is.
        x1_min: Smallest x1 of the motion, [rows]; for a segment of pseudo-equilibria its end.
        x1_max: Largest x1, likewise.
        x2_min: Smallest x2, likewise.
        x2_max: Largest x2, likewise.
        period: Periods of cycles, else NaN, [rows].
        multiplier: Nontrivial multipliers of cycles, else NaN, [rows].
        stick_durations: Time stuck to each belt in one loop, [rows, belts]; NaN where a cycle does
            not stick to that belt.
        stick_velocities: Velocity of the belt over omega, likewise.
        cycles: A `Cycle` for each row; none for equilibria. For forced oscillators a
            `PeriodicMotion` for each row; `multiplier` is then the real part of the larger one.
    """

    kind: str = eqx.field(static=True)
    values: np.ndarray
    stable: np.ndarray
    neutral: np.ndarray
    x1_min: np.ndarray = eqx.field(metadata=quantity("length"))
    x1_max: np.ndarray = eqx.field(metadata=quantity("length"))
    x2_min: np.ndarray = eqx.field(metadata=quantity("velocity"))
    x2_max: np.ndarray = eqx.field(metadata=quantity("velocity"))
    period: np.ndarray
    multiplier: np.ndarray
    stick_durations: np.ndarray
    stick_velocities: np.ndarray = eqx.field(metadata=quantity("velocity"))
    cycles: tuple[Any, ...]

    @property
    def amplitude(self) -> np.ndarray:
        """Half the range of x1 for cycles, 0 for equilibria, [rows]."""
        moves = self.kind == "cycle"
        return 0.5 * (self.x1_max - self.x1_min) if moves else np.zeros(len(self))

    def evaluated(self, functional: Callable[[Cycle], Any]) -> np.ndarray:
        """Values of a functional of the cycles, [rows], NaN where there is none.

        The functional gets one known `Cycle` after another, so JAX need not be able to trace it.
        """
        if not self.cycles:
            return np.full(len(self), np.nan)
        values = [np.asarray(functional(cycle)) for cycle in self.cycles]
        for value in values:
            fits = value.ndim == 0 and np.issubdtype(value.dtype, np.number)
            returned = f"one that returns {value.dtype}{list(value.shape)}"
            require(fits, "quantity", "a function of a cycle that returns one number", returned)
        return np.array(values, float)

    def columns(self) -> dict[str, Any]:
        """Columns of the table of a diagram for its rows."""
        names = ("stable", "neutral", "x1_min", "x1_max", "x2_min", "x2_max", "period", "amplitude")
        events = [signature_name(cycle.signature) for cycle in self.cycles]
        return {
            "kind": [self.kind] * len(self),
            "belts": [""] * len(self),
            "type": [""] * len(self),
            "value": self.values,
            **{name: getattr(self, name) for name in (*names, "multiplier")},
            # Where a stick phase vanishes Newton's method leaves a rounding error of it.
            **per_belt("stick_duration", np.maximum(self.stick_durations, 0.0)),
            "signature": events or [""] * len(self),
        }

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        ends = f"{self.values[0]:.6g} to {self.values[-1]:.6g}"
        flips = int(np.sum(self.stable[1:] != self.stable[:-1]))
        first = "stable" if self.stable[0] else "neutral" if self.neutral[0] else "unstable"
        return f"Branch({self.kind}, {len(self)} rows, {ends}, {first} first, {flips} changes)"


class BifurcationDiagram(eqx.Module):
    """Branches and special points along a parameter; what `bifurcation_diagram` returns.

    `table()` has all rows and points, `plot()` draws them.

    Attributes:
        points: The special points in order, as from `scan`, and those at which an unstable cycle
            touches a contact edge.
        branches: Branches of equilibria, then of cycles.
        regions: (first, last, name) for every stretch between points of `scan`, with names as in
            `RegionMap`; for forced oscillators the whole span, without a name.
        oscillator: The given oscillator; for a function the one at the first value.
        name: Name of the parameter: its path, or the name of the function's argument.
        as_paper: Whether the path lies in the plane of the paper's Fig. 6, so that pictures show
            the names of the regions.
        is_argument: Whether `name` is that of a function's argument.
        open_ends: Values inside of the span at which a branch of a forced oscillator ends, and no
            point says why: its motion could not be followed further.
    """

    points: tuple[BifurcationPoint, ...]
    branches: tuple[Branch, ...]
    regions: tuple[tuple[float, float, str], ...] = eqx.field(static=True)
    oscillator: Oscillator
    name: str = eqx.field(static=True)
    as_paper: bool = eqx.field(static=True, default=False)
    is_argument: bool = eqx.field(static=True, default=False)
    open_ends: tuple[float, ...] = ()

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each row of each branch, in order, and then for each special point.

        Columns: branch (its number; missing for a point), kind ("equilibrium", "cycle", or the
        condition of a point), belts and type (of a point), value (of the parameter), stable and
        neutral (missing for a point), x1_min, x1_max, x2_min, x2_max, period (NaN at rest),
        amplitude (half the range of x1; 0 at rest), multiplier, stick_duration_0, ... of each belt
        (NaN where the cycle does not stick to it), signature (the events of a cycle, as in
        `Cycle.table`).
        """
        rows = [
            {"branch": number, **row}
            for number, branch in enumerate(self.branches)
            for row in table_of(branch.columns()).to_dict("records")
        ]
        sticks = {f"stick_duration_{i}": "time" for i in range(len(self.oscillator.belts))}
        quantities = EXTENT | {"period": "time", "amplitude": "length"} | sticks
        table = table_of([*rows, *map(_row_of_point, self.points)], quantities)
        # A point belongs to no branch, and is neither stable nor unstable.
        return (
            table.astype({"branch": "Int64", "stable": "boolean", "neutral": "boolean"})
            if len(table)
            else table
        )

    def plot(self, ax: Any = None, *, quantity: str | Callable[[Cycle], Any] | None = None) -> Any:
        """Draws a quantity over the parameter.

        The quantity may be

        - "amplitude": half the range of x1; 0 for equilibria.
        - "x1": the smallest and the largest x1.
        - "x2": as in the paper's Figs. 3 and 7. Equilibria at x2 = 0, cycles that stick at the
          velocity of each belt that they stick to, others at their largest x2.
        - "period": of cycles.
        - a functional of cycles, such as `jb.stick_fraction`, or a function that takes a `Cycle`
          and returns a number: for cycles, stable and unstable.
        - None: "amplitude" where a cycle sticks, as x2 would only show the velocity of its belt;
          else "x2", and "x1" where there is no cycle.

        Args:
            ax: Axes; None makes new ones.
            quantity: The quantity, see above.

        Returns:
            The axes.
        """
        return draw(self, ax, quantity=quantity)

    def __repr__(self) -> str:
        names = " | ".join(name for _, _, name in self.regions)
        ends = ", ".join(f"{value:.6g}" for value in self.open_ends)
        return (
            f"BifurcationDiagram({self.name}, {len(self.points)} points, "
            f"{len(self.branches)} branches, regions {names}"
            f"{f', not followed beyond {ends}' if ends else ''})"
        )


@announced("bifurcation_diagram")
@outside_of_traces
def bifurcation_diagram(
    osc: Oscillator | Callable[..., Oscillator],
    where: Callable[[Oscillator], Any] | None = None,
    span: tuple[float, float] | None = None,
    *,
    start: Any = None,
    rows: int = 160,
    resolution: int = 96,
) -> BifurcationDiagram:
    """Equilibria and cycles, stable and unstable, along a path in one parameter.

    Args:
        osc: An oscillator, or a function of the parameter that returns it, as for `scan`.
        where: Selects the parameter, as for `scan`; None with a function.
        span: First and last value of the parameter.
        rows: Approximate number of values of the parameter.
        resolution: As for `scan`, which finds the special points.
        start: For a forced oscillator only, whose diagram is the branch of one periodic motion,
            stable and unstable, with the points on it, and the branches that leave it at period
            doublings (rows and resolution do not count): that motion, or a start (x1, x2) at t = 0
            that leads to it with the parameter in the middle of the span; None: from where one is
            found. A branch ends where no motion is found beyond a point, or where it cannot be
            followed further, see `open_ends`.

    Returns:
        The `BifurcationDiagram`.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    rows, resolution = as_whole(rows, "rows"), as_whole(resolution, "resolution")
    if _is_forced(osc, where, span):
        return _forced_diagram(osc, where, span, start)
    require_value(start is None, "start", "left out where there is no forcing", start)
    path = ParameterPath(osc, where, span)
    osc_at_first = path.at(path.first)
    points = search(path, resolution, ahead=[lambda: from_starts(osc_at_first)])
    # A point on an end of the span has one side only; a condition that holds all along has none.
    bounds = [point for point in points if int(point.status) != Status.DEGENERATE]
    inner = [point for point in bounds if path.first < float(point.value) < path.last]
    special: dict[float, list[BifurcationPoint]] = {}
    for point in inner:
        known = next(reversed(special), np.nan)
        shared = known in special and is_at_one_value(special[known][0], point)
        special.setdefault(known if shared else float(point.value), []).append(point)
    ends = [path.first, *special, path.last]
    stretches = list(pairwise(ends))
    nodes = [_nodes(path, a, b, rows) for a, b in stretches]
    path.find_labels(np.concatenate(nodes))
    middles = [float(values[len(values) // 2]) for values in nodes]
    labels = [path.label(value) for value in middles]
    note_progress(f"branches between {len(points)} points")
    for stretch, around in _separated(labels):
        found = edges_touched(path, nodes[stretch], around)
        points = by_value([*points, *found])
        at = [float(point.value) for point in found if point.status == Status.OK]
        nodes[stretch] = np.sort(np.append(nodes[stretch], at))
    path.find_labels(np.concatenate(nodes))
    if any(np.all(np.isfinite(belt.friction.measured_to)) for belt in path.at(path.first).belts):
        loops = ((path.at(v), one.loop) for v, found in path.cycles.items() for one in found)
        fast = ((osc, loop, np.asarray(loop.entries)[:, 1]) for osc, loop in loops)
        warn_of_fast_loops(fast, depth=5)
    pieces = [*_equilibrium_pieces(path, nodes), *_cycle_pieces(path, nodes, labels)]
    names = [region_name(path.at(v), label) for v, label in zip(middles, labels, strict=True)]
    given, length, (unit,), _ = path.variation.own
    branches = rescaled(tuple(_joined(pieces, list(special.values()))), length)
    at_ends = [given.oscillator(np.array([unit * v])) for v in (path.first, *middles, path.last)]
    return BifurcationDiagram(
        points=tuple(given_point(point, path.variation) for point in points),
        branches=tuple(replace(one, values=one.values * unit) for one in branches),
        regions=tuple(
            (a * float(unit), b * float(unit), name)
            for (a, b), name in zip(stretches, names, strict=True)
        ),
        oscillator=path.osc,
        name=path.name,
        as_paper=in_plane_of_paper(at_ends),
        is_argument=not path.variation.varies_leaves,
    )


def _is_forced(osc: Any, where: Any, span: Any) -> bool:
    """Whether what is varied knows the time."""
    if isinstance(osc, Oscillator) or not callable(osc):
        return isinstance(osc, Oscillator) and has_clock(osc)
    first, _ = as_span(span, where)
    try:
        made = osc(first)
    except Exception:  # which is told as of any function
        return False
    return isinstance(made, Oscillator) and has_clock(made)


def _forced_diagram(osc: Any, where: Any, span: Any, start: Any) -> BifurcationDiagram:
    """`bifurcation_diagram` of a forced oscillator."""
    if isinstance(osc, Oscillator):
        leaf_index(osc, where)
    first, last = as_span(span, where)
    given = varied(osc, where, (first,), forced=True)
    for value in (first, last):
        given.check(value)
    ends = np.array([[0.5 * (first + last)], [first], [last]])
    variation = given.in_own_units(*ends)
    (unit,), length = variation.own.parameters, variation.own.length
    limits = np.array([[first, last]]) / unit
    motion, value = _start_of_branch(variation, limits, start)
    found, points = forced_branches(variation, (limits[0, 0], limits[0, 1]), motion, value)
    branches = rescaled(tuple(_branch_of_motions(one.rows) for one in found), length)
    open_ends = [end * float(unit) for one in found for end in one.open_ends]
    return BifurcationDiagram(
        points=tuple(given_point(point, variation) for point in points),
        branches=tuple(replace(one, values=one.values * unit) for one in branches),
        regions=((first, last, ""),),
        oscillator=osc if isinstance(osc, Oscillator) else given.oscillator(np.array([first])),
        name=variation.names[0],
        as_paper=False,
        is_argument=not variation.varies_leaves,
        open_ends=tuple(open_ends),
    )


def _start_of_branch(
    variation: Variation, limits: np.ndarray, start: Any
) -> tuple[PeriodicMotion, float]:
    """The motion to begin from, and where it is."""
    if isinstance(start, PeriodicMotion):
        status = Status(int(start.status))
        require(status == Status.OK, "start", "a motion with status OK", status.name)
        length = variation.own.length
        own = in_own_units(start.oscillator, length)
        values = variation.values_of(own, limits)
        expected = "a motion of an oscillator within the span"
        inside = values is not None and limits[0, 0] <= values[0] <= limits[0, 1]
        if values is None or not inside:
            raise ValueError(f"start must be {expected}, got one of another oscillator")
        return rescaled(start, 1 / length, lambda _: own), float(values[0])
    value = float(np.mean(limits))
    own = in_own_units(variation.oscillator(np.array([value])))
    motions = motions_to_begin_from(own, start, turns_of(own))
    expected = "one that leads to a periodic motion in the middle of the span"
    require_value(len(motions) > 0, "start", expected, start)
    return motions[0], value


def _branch_of_motions(rows: Sequence[MotionRow]) -> Branch:
    motions = tuple(row.motion for row in rows)
    places = np.array([place_of_motion(motion) for motion in motions])
    sticks = np.array([np.asarray(motion.stick_durations) for motion in motions])
    stuck = np.where(sticks > 0, sticks, np.nan)
    return Branch(
        kind="cycle",
        values=np.array([row.value for row in rows]),
        stable=np.array([bool(motion.stable) for motion in motions]),
        neutral=np.zeros(len(rows), bool),
        x1_min=places[:, 0],
        x1_max=places[:, 1],
        x2_min=places[:, 2],
        x2_max=places[:, 3],
        period=places[:, 4],
        multiplier=np.array([float(motion.multipliers[0].real) for motion in motions]),
        stick_durations=stuck,
        stick_velocities=np.full_like(stuck, np.nan),
        cycles=motions,
    )


def _row_of_point(point: BifurcationPoint) -> dict[str, Any]:
    row, none = point.row(), [np.nan] * len(point.oscillator.belts)
    known = int(point.cycle.status) == Status.OK
    sticks = np.asarray(point.cycle.stick_durations)
    names = ("x1_min", "x1_max", "x2_min", "x2_max", "period", "multiplier")
    return {
        "branch": None,
        **{name: row[name] for name in ("kind", "belts", "type", "value")},
        "stable": None,
        "neutral": None,
        **{name: row[name] for name in names},
        "amplitude": 0.5 * (row["x1_max"] - row["x1_min"]),
        **per_belt("stick_duration", np.where(sticks > MOMENT, sticks, np.nan) if known else none),
        "signature": signature_name(point.cycle.signature) if known else "",
    }


def _nodes(path: ParameterPath, a: float, b: float, rows: int) -> np.ndarray:
    """Values from a to b, dense at both ends, which are left out where they are special."""
    # Short stretches are no less curved than long ones: with fewer rows corners would be visible.
    count = max(9, rows // 9, round(rows * (b - a) / path.length))
    inner = 0.5 * (1 - np.cos(np.linspace(0, np.pi, count)))
    first = path.beside(a)[1] if a in path.breaks or a != path.first else a
    last = path.beside(b)[0] if b in path.breaks or b != path.last else b
    return first + (last - first) * inner


def _separated(labels: Sequence[Label]) -> list[tuple[int, int]]:
    """Stretches with unstable cycles between equilibria and cycles that attract.

    With the number of each such equilibrium.
    """
    return [
        (stretch, around)
        for stretch, label in enumerate(labels)
        if label.cycles
        for around in range(label.foci)
    ]


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
        none_stick = np.full((len(values), len(path.osc.belts)), np.nan)
        for row in range(int(np.max(np.sum(here.kind > 0, axis=1)))):
            branch = Branch(
                kind="equilibrium",
                values=values,
                stable=here.stable[:, row],
                neutral=here.neutral[:, row],
                x1_min=here.x1_lower[:, row],
                x1_max=here.x1_upper[:, row],
                x2_min=np.zeros(len(values)),
                x2_max=np.zeros(len(values)),
                period=none,
                multiplier=none,
                stick_durations=none_stick,
                stick_velocities=none_stick,
                cycles=(),
            )
            pieces.append(_Piece(branch, stretch))
    return pieces


def _cycle_pieces(
    path: ParameterPath, nodes: Sequence[np.ndarray], labels: Sequence[Label]
) -> list[_Piece]:
    wanted: list[tuple[int, np.ndarray, list[Loop]]] = []
    for stretch in range(len(labels)):
        for loops in path.strands(nodes[stretch].tolist()):
            wanted.append((stretch, np.array(list(loops)), list(loops.values())))
    pieces = []
    if wanted:
        groups = [values for _, values, _ in wanted]
        loops = [loop for _, _, group in wanted for loop in group]
        cycles = _attracting(path, np.concatenate(groups), loops)
        pieces += _as_pieces(cycles, groups, [stretch for stretch, _, _ in wanted])
    both = _separated(labels)
    if both:
        groups = [nodes[stretch] for stretch, _ in both]
        found = [path.unstable_along(nodes[stretch], around) for stretch, around in both]
        cycles = [cycle for group in found for cycle in group]
        pieces += _as_pieces(cycles, groups, [stretch for stretch, _ in both])
    return pieces


def _as_pieces(cycles: Sequence[Cycle], groups, stretches) -> list[_Piece]:
    pieces, found = [], _stacked(_row_of_branch, cycles)
    for stretch, values, rows in zip(stretches, groups, _consecutive(groups), strict=True):
        fine = found.status[rows] == Status.OK
        if np.any(fine):
            here = jax.tree.map(lambda x, rows=rows[fine]: x[rows], found)
            fields = {name: value for name, value in here._asdict().items() if name != "status"}
            own = tuple(cycles[row] for row in rows[fine].tolist())
            branch = Branch(kind="cycle", values=values[fine], cycles=own, **fields)
            pieces.append(_Piece(branch, stretch))
    return pieces


class _Rows(NamedTuple):
    """The fields of a `Branch` of cycles, and the status of each."""

    status: Any
    stable: Any
    neutral: Any
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
        neutral=jnp.zeros_like(cycle.stable),
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
    """Row numbers of each group, when all groups stand one after another."""
    ends = np.cumsum([len(group) for group in groups])
    return [np.arange(end - len(group), end) for group, end in zip(groups, ends, strict=True)]


# One by one, so that one program serves any number of them.


def _stacked(program, items: Iterable[Any]) -> Any:
    """Results of a program for each item, as NumPy arrays of many rows."""
    rows = [jax.tree.map(np.asarray, program(item)) for item in items]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def _attracting(path: ParameterPath, values: np.ndarray, loops: Sequence[Loop]) -> list[Cycle]:
    ok = jnp.asarray(Status.OK.value)

    def solved(osc: Oscillator, loop: Loop) -> Cycle:
        cycle = polish(osc, loop, ok)
        # The steps are too long for the law; a branch must not end for that.
        return exactly(osc, loop, ok) if int(cycle.status) == Status.NO_CONVERGENCE else cycle

    pairs = zip(values, cut(loops), strict=True)
    return [solved(path.at(value), loop) for value, loop in pairs]


# --- from pieces to branches ----------------------------------------------------------------------


class _End(NamedTuple):
    """An end of a piece: number of the piece, whether it is the right end, and its place."""

    piece: int
    right: bool
    place: tuple[str, float, float]


def _joined(pieces: Sequence[_Piece], special: Sequence[list[BifurcationPoint]]) -> list[Branch]:
    """Joins pieces to branches.

    special: the points between stretches, those at one value together. Two ends of pieces at the
    same place there belong together.
    """
    partner: dict[tuple[int, bool], tuple[int, bool]] = {}
    for at, points in enumerate(special):
        if not all(point.condition.joins for point in points):
            continue
        ends = [
            _end(i, piece, right=piece.stretch == at)
            for i, piece in enumerate(pieces)
            if piece.stretch in (at, at + 1)
        ]
        pairs = sorted(
            (_between(a, b), i, j) for (i, a), (j, b) in combinations(enumerate(ends), 2)
        )
        taken: set[int] = set()
        for away, i, j in pairs:
            if away < MAYBE_SAME and not taken & {i, j}:
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
        branches.append(_chained(chain))
    return branches


def _end(number: int, piece: _Piece, *, right: bool) -> _End:
    branch, row = piece.branch, -1 if right else 0
    return _End(number, right, (branch.kind, float(branch.x1_min[row]), float(branch.x1_max[row])))


def _between(a: _End, b: _End) -> float:
    """How far apart two ends are, relative to the motion there."""
    (kind, *x), (other, *y) = a.place, b.place
    return distance(x, y, least=LEAST_SIZE) if kind == other else np.inf


def _reversed(branch: Branch) -> Branch:
    arrays = jax.tree.map(lambda leaf: leaf[::-1], replace(branch, cycles=()))
    return replace(arrays, cycles=branch.cycles[::-1])


def _chained(parts: Sequence[Branch]) -> Branch:
    bare = [replace(part, cycles=()) for part in parts]
    arrays = jax.tree.map(lambda *leaves: np.concatenate(leaves), *bare)
    return replace(arrays, cycles=tuple(cycle for part in parts for cycle in part.cycles))
