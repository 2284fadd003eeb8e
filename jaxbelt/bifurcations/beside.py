"""The motions on the two sides of a change that no condition explains: `Side`.

A branch of cycles that ends there is described by its last cycle. Two numbers say how the branch
ends: the distance of this cycle from the motion that its orbits lead to on the other side, and its
distance from the largest loop inside it that comes to rest. Where the branch ends in a fold, the
attracting and the unstable cycle come together, and the second number goes to zero. Under a very
steep law the unstable branch follows the boundary of the belt through the thin layer of the law, as
a canard, with a multiplier too large for a float: there the two branches end apart.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks import number, pick
from ..cycles.attractors import MAYBE_SAME, distance, place_of
from ..cycles.backwards import solved
from ..cycles.chains import SIZES
from ..cycles.cycle import Cycle, cycle_from
from ..cycles.unstable import separating_loop
from ..model.equilibria import Equilibria, EquilibriumKind, equilibria
from ..model.oscillator import Oscillator
from ..model.own_units import quantity
from ..results import Status
from .labels import AttractingCycle


class Side(eqx.Module):
    """The motions on one side of a point of kind `Unexplained`.

    value: the parameter on this side; equilibria: all of them; cycles: the attracting `Cycle`s that
    do not continue on the other side. jumps: distance of the extrema of x1 of each cycle from those
    of the motion that its orbits lead to on the other side, [cycles]. inside: distance of the
    largest x1 of each cycle from that of the largest loop inside it that comes to rest, [cycles],
    near zero where both branches of a fold come together. NaN: not known.
    """

    value: Array
    equilibria: Equilibria
    cycles: tuple[Cycle, ...]
    jumps: Array = eqx.field(metadata=quantity("length"))
    inside: Array = eqx.field(metadata=quantity("length"))

    def __repr__(self) -> str:
        ends = [
            f"{_words(cycle)}, {number(jump)} from what is on the other side, "
            f"{number(inside)} outside the largest loop that comes to rest"
            for cycle, jump, inside in zip(self.cycles, self.jumps, self.inside, strict=True)
        ]
        ends = ends or ["no cycle that ends"]
        return f"at {number(self.value)} {'; '.join(ends)}; {self.equilibria!r}"


def _words(cycle: Cycle) -> str:
    low, high = number(cycle.x1_min), number(cycle.x1_max)
    return f"{cycle!r} over x1 from {low} to {high}"


def sides_of(
    values: tuple[float, float],
    oscs: tuple[Oscillator, Oscillator],
    cycles: tuple[Sequence[AttractingCycle], Sequence[AttractingCycle]],
) -> tuple[Side, Side]:
    """The sides below and above a change between two close values; cycles: the attracting ones."""
    known = [[one for one in some if one.path] for some in cycles]
    places = [[place_of(one.loop) for one in some] for some in known]
    first, last = (
        _side_at(values[i], oscs[i], oscs[1 - i], known[i], places[i], known[1 - i], places[1 - i])
        for i in (0, 1)
    )
    return first, last


def _side_at(value, osc, across, cycles, places, others, other_places) -> Side:
    rests = equilibria(osc)
    ended = [
        solved(osc, one.loop)
        for one, place in zip(cycles, places, strict=True)
        if not any(
            one.path == other.path and distance(place, at) < MAYBE_SAME
            for other, at in zip(others, other_places, strict=True)
        )
    ]
    # A cycle that Newton's method does not close has no numbers to report.
    ended = [cycle for cycle in ended if int(cycle.status) == Status.OK]
    tops = _tops_that_come_to_rest(osc, rests)
    return Side(
        value=jnp.asarray(value),
        equilibria=rests,
        cycles=tuple(ended),
        jumps=jnp.asarray([_jump(across, cycle) for cycle in ended], float),
        inside=jnp.asarray([_inside(cycle, tops) for cycle in ended], float),
    )


def _jump(osc: Oscillator, cycle: Cycle) -> float:
    """Distance of the extrema of x1 from those of the motion that its orbit leads to in `osc`."""
    ends = np.array([float(cycle.x1_min), float(cycle.x1_max)])
    found = cycle_from(osc, np.asarray(cycle.unknowns)[0, :2])
    if int(found.status) == Status.OK:
        return float(np.max(np.abs(ends - [float(found.x1_min), float(found.x1_max)])))
    if int(found.status) not in (Status.EQUILIBRIUM, Status.STUCK_FOREVER, Status.PSEUDO_FOCUS):
        return float("nan")
    rests = equilibria(osc)
    settles = np.asarray(rests.stable) & (np.asarray(rests.kind) > 0)
    x1 = np.asarray(rests.x1)[settles]
    # Of several equilibria the one within the cycle is nearest; one farther off is a jump, too.
    away = [float(np.max(np.abs(ends - at))) for at in x1]
    return min(away, default=float("nan"))


def _tops_that_come_to_rest(osc: Oscillator, rests: Equilibria) -> list[float]:
    """Largest x1 of the largest loop that comes to rest, around each stable equilibrium."""
    meant = np.asarray(rests.stable) & (np.asarray(rests.kind) > 0)
    meant &= np.asarray(rests.kind) != EquilibriumKind.SEGMENT
    tops = []
    for around, row in enumerate(np.flatnonzero(meant).tolist()):
        _, status, away = separating_loop(osc, SIZES[-1], around)
        if int(status) == Status.OK:
            tops.append(float(pick(rests, row).x1) + float(away))
    return tops


def _inside(cycle: Cycle, tops: Sequence[float]) -> float:
    low, high = float(cycle.x1_min), float(cycle.x1_max)
    return min((high - top for top in tops if low < top < high), default=float("nan"))
