"""The complete phase portrait of one oscillator: `portrait` and its result, `Portrait`.

A few sets determine the plane: those where orbits end, and those that divide orbits that end in
different places. With dry friction these are (see `returns` and `separatrices` for why there are no
others) equilibria, attracting cycles, unstable cycles, and separatrices of points on contact edges,
of ends of segments and of boundaries with a jump. Nothing here needs bifurcations, so it belongs to
the cycles.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..activity import announced
from ..checks import outside_of_traces, pick
from ..dimensions import EXTENT
from ..model.equilibria import Equilibria, EquilibriumKind, equilibria
from ..model.events import signature_name
from ..model.modes import edges
from ..model.oscillator import Oscillator, check_oscillator, refuse_clock
from ..model.own_units import OwnOscillator, in_given_units, in_own_units, quantity
from ..numerics.compiling import compiled_beside
from ..results import Status, describe, draw
from ..tables import table_of
from .chains import SIZES, blank_loop
from .cycle import Cycle, polish, warn_of_extrapolation
from .returns import Returns, reach_of
from .separatrices import Separatrix, TracedSeparatrix, branches

if TYPE_CHECKING:
    import pandas

#: A top this near to the top of a cycle, relative to its distance from the origin, is on the cycle.
ON_CYCLE = 1e-5
#: An equilibrium this near to an edge lies on it.
ON_EDGE = 1e-9
#: Separatrices are followed up to this multiple of the reach, as they may come back into it.
TRACED = 3.0
#: An orbit that has not settled, but comes this near to a point of rest, tends to it.
CREEPING = 1e-3


class Portrait(eqx.Module):
    """All equilibria, cycles and separatrices of one oscillator; what `portrait` returns.

    The basin of a start follows from its place: see `table` for all numbers, `plot` for the
    picture.

    Attributes:
        oscillator: The oscillator.
        equilibria: All of them, saddles included, see `Equilibria`.
        cycles: The attracting cycles, a tuple of `Cycle`, sorted by their largest x1.
        unstable: The unstable cycles, likewise.
        separatrices: A tuple of `Separatrix`, sorted by their points; the stable ones bound basins,
            as unstable cycles do.
        escapes: Whether starts far out go to infinity.
        reach: Bound of the search, `|x1|` and `|x2|` < reach. No cycle is farther out where a bound
            is known; for damping 0 none is. For damping < 0 with friction that grows with the
            speed, the loops tried beyond it grew, or shrank, as they do at infinity.
        gaps: Intervals (from, to) of x1 at rest in which it is not known whether cycles pass,
            [gaps, 2]; also those of a continuum of closed orbits, which are neither attracting nor
            unstable; and (reach, inf) where there is a cycle farther out.
        status: OK; or INCOMPLETE where there is a gap, where an equilibrium on a contact edge is a
            stable node (the orbit that comes to it in its fast direction is a separatrix, too, and
            is missing), or where a stable separatrix is unsettled, or ends within the reach.
    """

    oscillator: Oscillator
    equilibria: Equilibria
    cycles: tuple[Cycle, ...]
    unstable: tuple[Cycle, ...]
    separatrices: tuple[Separatrix, ...]
    escapes: bool = eqx.field(static=True)
    reach: float = eqx.field(metadata=quantity("length"), static=True)
    gaps: Array = eqx.field(metadata=quantity("length"))
    status: Array

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each equilibrium, cycle and separatrix.

        Columns: what, number (within its sort), kind (an `EquilibriumKind`, the events of a cycle,
        or where a separatrix leads to or comes from), stable, neutral (of an equilibrium; else
        False), x1_min, x1_max, x2_min, x2_max, period and multiplier of a cycle, rate of an
        equilibrium; NaN where it has none.
        """
        rows = [
            _row(
                "equilibrium",
                number,
                EquilibriumKind(int(rest.kind)).name,
                rest.stable,
                np.array([[rest.x1_lower, 0.0], [rest.x1_upper, 0.0]]),
                rate=float(rest.rate),
                neutral=bool(rest.neutral),
            )
            for number, rest in enumerate(self.equilibria)
        ]
        for cycles in (self.cycles, self.unstable):
            rows += [
                _row(
                    "cycle",
                    number,
                    signature_name(cycle.signature),
                    cycle.stable,
                    np.array([[cycle.x1_min, cycle.x2_min], [cycle.x1_max, cycle.x2_max]]),
                    period=float(cycle.period),
                    multiplier=float(cycle.multiplier),
                )
                for number, cycle in enumerate(cycles)
            ]
        rows += [
            _row("separatrix", number, f"{one.end} {one.to}", one.stable, np.asarray(one.ys))
            for number, one in enumerate(self.separatrices)
        ]
        return table_of(rows, EXTENT | {"period": "time", "rate": "rate"})

    def plot(self, ax: Any = None) -> Any:
        """Draws the portrait.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        lines = [f"Portrait({len(self.equilibria)} equilibria, {len(self.cycles)} attracting and "]
        lines[0] += f"{len(self.unstable)} unstable cycles, {len(self.separatrices)} separatrices"
        lines[0] += ", starts far out go to infinity" if self.escapes else ""
        lines += [repr(self.equilibria), *map(repr, [*self.cycles, *self.unstable])]
        lines += map(repr, self.separatrices)
        if int(self.status) != Status.OK:
            lines.append(f"{Status(int(self.status)).name}: {describe(self.status)}")
        return "\n  ".join(lines) + ")"


def _row(what: str, number: int, kind: str, stable: Any, ys: np.ndarray, **more: Any):
    x1, x2 = np.asarray(ys).T
    return {
        "what": what,
        "number": number,
        "kind": kind,
        "stable": bool(stable),
        "neutral": False,
        "x1_min": float(x1.min()),
        "x1_max": float(x1.max()),
        "x2_min": float(x2.min()),
        "x2_max": float(x2.max()),
        "period": np.nan,
        "multiplier": np.nan,
        "rate": np.nan,
        **more,
    }


@announced("portrait")
@outside_of_traces
def portrait(osc: Oscillator) -> Portrait:
    """All equilibria, attracting and unstable cycles, and separatrices of an oscillator.

    Cycles smaller than 1e-5 of the oscillator's own size, and those that go less than 1e-7 of it to
    the right of a contact edge at which the mass can rest, are not distinguished from equilibria.
    Not for `jax.jit`, `jax.vmap` and derivatives: the numbers decide how much is computed.

    Args:
        osc: An `Oscillator` with known numbers (not traced), and any friction laws, belts, contact
            intervals and damping.

    Returns:
        The `Portrait`.

    Raises:
        ValueError: If an argument is impossible or traced; the message names it.
    """
    check_oscillator(osc)
    refuse_clock(osc, "portrait", "jb.simulate from several starts")
    own = in_own_units(osc)
    found = in_given_units(_portrait(own), osc, own)
    warn_of_extrapolation((*found.cycles, *found.unstable), depth=5)
    return found


def _portrait(osc: OwnOscillator) -> Portrait:
    points = equilibria(osc)
    # Cycles are polished once the return map is known; the program for it is compiled meanwhile.
    loop, ok = blank_loop(SIZES[0], len(osc.belts)), jnp.asarray(Status.OK.value)
    with compiled_beside("portrait", osc, [lambda: polish(osc, loop, ok)]):
        found, map_ = branches_and_returns(osc, points)
    reach = map_.reach
    cycles = tuple(cycle for cycle in map_.cycles if abs(float(cycle.multiplier)) < 1)
    unstable = tuple(cycle for cycle in map_.cycles if float(cycle.multiplier) > 1)
    gaps = np.array(sorted(map_.gaps)).reshape(-1, 2)
    separatrices = tuple(
        _named(branch, map_, points, unstable if branch.stable else cycles) for branch in found
    )
    short = any(one.stable and _falls_short(one, reach) for one in separatrices)
    complete = not len(gaps) and not _has_node_on_edge(osc, points) and not short
    status = Status.OK if complete else Status.INCOMPLETE
    return Portrait(
        oscillator=osc,
        equilibria=points,
        cycles=cycles,
        unstable=unstable,
        separatrices=separatrices,
        escapes=map_.escapes,
        reach=reach,
        gaps=jax.device_put(gaps),
        status=jnp.asarray(np.array(status.value)),
    )


def branches_and_returns(
    osc: Oscillator, points: Equilibria
) -> tuple[list[TracedSeparatrix], Returns]:
    """The separatrices of an oscillator, and the return map with all of its cycles."""
    reach = reach_of(osc)
    rests = pick(points, np.asarray(points.kind) != EquilibriumKind.SADDLE)
    found = branches(osc, rests, TRACED * reach)
    tops = [top for branch in found for top in branch.tops[:2].tolist()]
    return found, Returns(osc, rests, reach, tops)


def _falls_short(one: Separatrix, reach: float) -> bool:
    """Whether a separatrix was followed without reaching its origin or its destination."""
    is_inside = bool(jnp.max(jnp.abs(one.ys)) < reach)
    return one.end == "unsettled" or (one.end == "outside" and is_inside)


def _has_node_on_edge(osc: Oscillator, points: Equilibria) -> bool:
    """Whether a node that attracts from its side lies on a contact edge, up to rounding."""
    x1, at = np.asarray(points.x1), np.asarray(jnp.stack(edges(osc)))
    on_edge = np.min(np.abs(x1[:, None] - at), axis=1, initial=np.inf) < ON_EDGE
    fixed = np.asarray(points.kind) == EquilibriumKind.FIXED_POINT
    is_node = np.isreal(np.asarray(points.eigenvalues)[:, 0])
    return bool(np.any(on_edge & fixed & is_node & (np.asarray(points.rate) < 0)))


def _named(
    branch: TracedSeparatrix, map_: Returns, points: Equilibria, cycles: Sequence[Cycle]
) -> Separatrix:
    """The separatrix with its destination or origin; cycles: those that this may be."""
    end, to = _end_of(branch, map_, points, cycles)
    if branch.stable and end == "equilibrium" and points.stable[to]:
        # Only by rounding does an orbit come from an equilibrium that attracts all orbits nearby;
        # from a segment it may.
        if int(points.kind[to]) != EquilibriumKind.SEGMENT:
            end, to = "unsettled", -1
    ts, ys = jax.device_put((branch.ts, branch.ys))
    point = jax.device_put(np.array(branch.point))
    return Separatrix(point, branch.side, branch.stable, ts, ys, end, to, branch.arcs)


def _end_of(branch: TracedSeparatrix, map_: Returns, points: Equilibria, cycles) -> tuple[str, int]:
    if branch.cut:
        return "boundary", -1
    if max(abs(branch.y)) >= map_.reach or branch.status == Status.NOT_FINITE:
        return "outside", -1
    if not np.isnan(branch.rest):
        lower, upper = np.asarray(points.x1_lower), np.asarray(points.x1_upper)
        away = np.maximum(np.maximum(lower - branch.rest, branch.rest - upper), 0.0)
        return "equilibrium", int(np.argmin(away))
    return _approached(branch, map_, points, cycles)


def _approached(
    branch: TracedSeparatrix, map_: Returns, points: Equilibria, cycles
) -> tuple[str, int]:
    """The limit of the tops of an orbit that was followed until they hardly moved.

    It is the next of the `cycles` in the direction in which the tops move, or the end of their
    interval.
    """
    if branch.status != Status.OK and (to := _creeping_to(branch, points)) >= 0:
        return "equilibrium", to
    if not len(branch.tops):
        return "unsettled", -1
    top = float(branch.tops[-1])
    step = float(map_(np.array([top]))[0]) - top
    step = -step if branch.stable else step
    (low, high), *_ = [*(i for i in map_.intervals if i[0] < top <= i[1]), (top, top)]
    inside = [
        (number, float(cycle.x1_max))
        for number, cycle in enumerate(cycles)
        if low < float(cycle.x1_max) <= high
    ]
    near = [(abs(at - top), number) for number, at in inside]
    if near and min(near)[0] < ON_CYCLE * (1 + abs(top)):
        return "cycle", min(near)[1]
    ahead = [(abs(at - top), number) for number, at in inside if (at - top) * step > 0]
    if ahead:
        return "cycle", min(ahead)[1]
    if step > 0:
        return ("outside" if high == map_.intervals[-1][1] else "unsettled"), -1
    rests = np.flatnonzero(np.abs(np.asarray(points.x1_upper) - low) < 1e-9 * (1 + abs(low)))
    return ("equilibrium", int(rests[0])) if rests.size else ("unsettled", -1)


def _creeping_to(branch: TracedSeparatrix, points: Equilibria) -> int:
    """Number of the point of rest that an orbit approaches for ever, or -1.

    An orbit never arrives at a node on an edge, or on the boundary of a belt at rest.
    """
    ends = np.stack([np.asarray(points.x1_lower), np.asarray(points.x1_upper)])
    away = np.min(np.hypot(ends - branch.y[0], branch.y[1]), axis=0)
    away[np.asarray(points.kind) == EquilibriumKind.SADDLE] = np.inf
    return int(np.argmin(away)) if np.any(away < CREEPING) else -1
