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

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np

from ..activity import announced, note_progress
from ..checks import as_whole, outside_of_traces, require, require_value
from ..cycles.attractors import MOMENT
from ..cycles.clocked import turns_of
from ..cycles.cycle import Cycle, warn_of_fast_loops
from ..cycles.periodic import PeriodicMotion
from ..cycles.unstable import from_starts
from ..dimensions import EXTENT
from ..model.events import signature_name
from ..model.oscillator import Oscillator, has_clock
from ..model.own_units import in_own_units, rescaled
from ..model.variations import WITH_A_CLOCK, Variation, as_span, varied
from ..numerics.compiling import compiled_beside
from ..results import Status, draw
from ..tables import per_belt, table_of
from .base import BifurcationPoint, given_point
from .branches import forced_branches
from .cells import in_plane_of_paper, region_name
from .forced import motions_to_begin_from
from .legs import ForcedLine, MotionRow
from .path import ParameterPath
from .pieces import (
    Branch,
    cycle_pieces,
    equilibrium_pieces,
    joined_pieces,
    nodes_of_stretch,
    separated_stretches,
)
from .scan import by_value, calls_ahead, edges_touched, is_at_one_value, search
from .symmetry import looks_the_same
from .timed_systems import place_of_motion

if TYPE_CHECKING:
    import pandas


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
            f"{len(self.branches)} branches{f', regions {names}' if names else ''}"
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
            doublings and where symmetry breaks (rows and resolution play no part): that motion, or
            a start (x1, x2) at t = 0 that leads to it with the parameter in the middle of the span.
            None: a motion found in the middle of the span, and others found in the middle of the
            widest part that no branch reaches. A branch ends where no motion is
            found beyond a point, or where it cannot be followed further or grows beyond all bounds,
            see `open_ends`.

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
    ahead = chain(calls_ahead(path), [lambda: from_starts(osc_at_first)])
    with compiled_beside("bifurcation_diagram", osc_at_first, ahead):
        points = search(path, resolution)
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
    nodes = [nodes_of_stretch(path, a, b, rows) for a, b in stretches]
    path.find_labels(np.concatenate(nodes))
    middles = [float(values[len(values) // 2]) for values in nodes]
    labels = [path.label(value) for value in middles]
    note_progress(f"branches between {len(points)} points")
    for stretch, around in separated_stretches(labels):
        found = edges_touched(path, nodes[stretch], around)
        points = by_value([*points, *found])
        at = [float(point.value) for point in found if point.status == Status.OK]
        nodes[stretch] = np.sort(np.append(nodes[stretch], at))
    path.find_labels(np.concatenate(nodes))
    if any(np.all(np.isfinite(belt.friction.measured_to)) for belt in path.at(path.first).belts):
        loops = ((path.at(v), one.loop) for v, found in path.cycles.items() for one in found)
        fast = ((osc, loop, np.asarray(loop.entries)[:, 1]) for osc, loop in loops)
        warn_of_fast_loops(fast, depth=5)
    pieces = [*equilibrium_pieces(path, nodes), *cycle_pieces(path, nodes, labels)]
    names = [region_name(path.at(v), label) for v, label in zip(middles, labels, strict=True)]
    given, length, (unit,), _ = path.variation.own
    branches = rescaled(tuple(joined_pieces(pieces, list(special.values()))), length)
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
    """Whether the oscillators that are varied are forced."""
    if isinstance(osc, Oscillator) or not callable(osc):
        return isinstance(osc, Oscillator) and has_clock(osc)
    ends = as_span(osc, where, span)
    made = [_made_by(osc, end) for end in ends]
    clocks = [has_clock(one) for one in made if one is not None]
    require(len(set(clocks)) < 2, "span", WITH_A_CLOCK, ends)
    return bool(clocks) and clocks[0]


def _made_by(make: Any, value: float) -> Oscillator | None:
    """The oscillator that a function returns; None if it fails, which later checks refuse."""
    try:
        made = make(value)
    except Exception:
        return None
    return made if isinstance(made, Oscillator) else None


def _forced_diagram(osc: Any, where: Any, span: Any, start: Any) -> BifurcationDiagram:
    """`bifurcation_diagram` of a forced oscillator."""
    first, last = as_span(osc, where, span)
    given = varied(osc, where, (first,), forced=True)
    variation = given.over(first, last)
    given.check_clock((first, last))
    (unit,), length = variation.own.parameters, variation.own.length
    limits = np.array([[first, last]]) / unit
    motion, value = _start_of_branch(variation, limits, start)
    turns = turns_of(motion.oscillator)
    symmetric = all(looks_the_same(variation.oscillator(end), turns) for end in limits.T)
    line = ForcedLine(variation, float(limits[0, 0]), float(limits[0, 1]), turns, symmetric)

    def further(value: float) -> MotionRow | None:
        motions = motions_to_begin_from(line.at(value), None, line.turns)
        return MotionRow(value, motions[0]) if motions else None

    begun = MotionRow(value, motion)
    found, points = forced_branches(line, begun, further if start is None else None)
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
    """The motion from which the branch is followed, and the value of the parameter there."""
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
