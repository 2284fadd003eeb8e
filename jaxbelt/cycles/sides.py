"""Curves that divide motions, and the attractors on both of their sides.

On the axis x2 = 0 all cycles, separatrices and equilibria mark places, and all starts between two
neighbouring places lead to one attractor. So one start between them, far from slow motions, is
enough.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..model.equilibria import EquilibriumKind
from ..model.modes import edges
from ..model.oscillator import Oscillator
from ..numerics.compiling import each, jit
from ..numerics.padding import in_batches
from ..results import Status
from .orbits import MOST_ARCS, follow, place_of_rest
from .outlines import ClosedOutline, OpenOutline, Outline, StraightOutline, jumps, place_on
from .portrait import Portrait

#: Starts that are followed in one batch; largest number of rounds of MOST_ARCS arcs each.
STARTS_AT_ONCE, ROUNDS = 16, 32
#: Accuracy of x2 of places on the axis; states at ends of arcs are good to 1e-9.
ON_AXIS = 1e-8
#: Distance, relative to that from the origin, at which an orbit is assigned to a cycle, which may
#: attract weakly, or to a place of rest.
KNOWN = 1e-3
#: Distance of starts from a curve that does not cross the axis, and from a boundary.
ASIDE = 1e-6


class Destination(NamedTuple):
    """Destination of a start.

    what: "cycle", "equilibrium", "infinity" or "undecided"; number: in the portrait (for a segment
    in pieces that of the first), or -1.
    """

    what: str
    number: int = -1

    @property
    def name(self) -> str:
        return f"{self.what} {self.number}" if self.number >= 0 else self.what

    @classmethod
    def of_name(cls, name: str) -> "Destination":
        what, _, row = name.partition(" ")
        return cls(what, int(row) if row else -1)


NOT_KNOWN = Destination("undecided")


class Bound(NamedTuple):
    """A curve that may divide motions: its name, its outline, and the destinations on its two
    sides."""

    name: str
    outline: Outline
    sides: tuple[Destination, Destination]

    def beyond(self, end: Destination) -> Destination:
        """The destination on the side of the curve that does not lead to `end`."""
        return self.sides[1] if self.sides[0] == end else self.sides[0]


def bounds_of(portrait: Portrait) -> list[Bound]:
    """All curves of a portrait that divide, or may divide, motions with different destinations."""
    osc, places = portrait.oscillator, _places(portrait)
    found: list[tuple[str, Outline, np.ndarray]] = []
    for number, cycle in enumerate(portrait.unstable):
        starts = _around(places, float(cycle.x1_max))
        found.append((f"unstable cycle {number}", ClosedOutline.of(cycle), starts))
    for number, one in enumerate(portrait.separatrices):
        if one.stable:
            outline = OpenOutline.of(osc, one)
            x1, x2 = np.asarray(one.point).tolist()
            starts = _around(places, x1) if x2 == 0 else _across(osc, outline)
            found.append((f"separatrix {number}", outline, starts))
    for belt in range(len(osc.belts)):
        for row in np.flatnonzero(np.isfinite(jumps(osc, jnp.asarray(np.array(belt)))[0])):
            outline = StraightOutline(belt, int(row), int(row))
            found.append((f"boundary of belt {belt}", outline, _across(osc, outline)))
    ends = leads_to(portrait, np.array([starts for *_, starts in found]).reshape(-1, 2))
    bounds = [
        Bound(name, outline, (ends[2 * i], ends[2 * i + 1]))
        for i, (name, outline, _) in enumerate(found)
    ]
    return [one for one in bounds if one.sides[0] != one.sides[1] or one.sides[0] == NOT_KNOWN]


def _places(portrait: Portrait) -> np.ndarray:
    """x1 of everything on the axis x2 = 0, from left to right."""
    rests = portrait.equilibria
    found = [np.asarray(rests.x1_lower), np.asarray(rests.x1_upper)]
    found.append(np.asarray(jnp.stack(edges(portrait.oscillator))))
    for cycle in (*portrait.cycles, *portrait.unstable):
        found.append(np.array([float(cycle.x1_min), float(cycle.x1_max)]))
    for one in portrait.separatrices:
        x1, x2 = np.asarray(one.ys).T
        found.append(x1[np.abs(x2) < ON_AXIS])
    places = np.unique(np.concatenate(found))
    return places[np.isfinite(places)]


def _around(places: np.ndarray, x1: float) -> np.ndarray:
    """Starts on the axis on both sides of a place, half the way to the next places, [2, 2]."""
    # Places that differ by rounding are one.
    near = 10 * ON_AXIS * (1 + abs(x1))
    left = places[places < x1 - near].max(initial=-np.inf)
    right = places[places > x1 + near].min(initial=np.inf)
    left = left if np.isfinite(left) else x1 - 1.0
    right = right if np.isfinite(right) else x1 + 1.0
    return np.array([[0.5 * (x1 + left), 0.0], [0.5 * (x1 + right), 0.0]])


def _across(osc: Oscillator, outline: Outline) -> np.ndarray:
    """Starts on both sides of the middle of an outline's first piece, [2, 2]."""
    piece = jax.tree.map(lambda leaf: leaf[0], outline.pieces(osc))
    place, slope, _ = map(np.asarray, place_on(osc, piece, jnp.asarray(0.5)))
    normal = np.array([-slope[1], slope[0]]) / np.hypot(*slope)
    return place + ASIDE * (1 + np.abs(place).max()) * np.array([normal, -normal])


# --- where starts lead ----------------------------------------------------------------------------


def leads_to(portrait: Portrait, starts: np.ndarray) -> list[Destination]:
    """Destinations of starts, [n, 2], in a portrait."""
    ends: dict[int, Destination] = {}
    states = np.array(starts, float)
    for _ in range(ROUNDS):
        left = np.array([i for i in range(len(starts)) if i not in ends], int)
        for batch, some in in_batches(states, left, STARTS_AT_ONCE):
            followed = _followed_on(portrait.oscillator, some)
            for i, status, top, rest, y in zip(batch.tolist(), *map(np.asarray, followed)):
                states[i] = y
                end = _destination(portrait, int(status), float(top), float(rest), y)
                if end is not None:
                    ends[i] = end
    return [ends.get(i, NOT_KNOWN) for i in range(len(starts))]


@jit
def _followed_on(osc: Oscillator, starts: Array):
    """For each start, [n, 2]: the status, the last top, the place of rest, and the last state."""

    def one(start):
        orbit = follow(osc, start, MOST_ARCS)
        last = jnp.arange(orbit.tops.size) == orbit.count - 1
        top = jnp.max(jnp.where(last, orbit.tops, -jnp.inf))
        return orbit.status, top, place_of_rest(osc, orbit), orbit.y

    return each(one)(lax.stop_gradient(starts))


def _destination(
    portrait: Portrait, status: int, top: float, rest: float, y: np.ndarray
) -> Destination | None:
    """The destination of an orbit; None if it has to be followed on."""
    if not np.isnan(rest):
        return _resting_at(portrait, rest)
    if status == Status.OK:
        away = [abs(float(cycle.x1_max) - top) for cycle in portrait.cycles]
        near = len(away) and min(away) < KNOWN * (1 + abs(top))
        return Destination("cycle", int(np.argmin(away))) if near else NOT_KNOWN
    if not np.all(np.abs(y) < 10 * portrait.reach):
        return Destination("infinity") if portrait.escapes else NOT_KNOWN
    return None if status == Status.NOT_SETTLED else NOT_KNOWN


def _resting_at(portrait: Portrait, x1: float) -> Destination:
    """The point or segment where the mass rests at x1."""
    rests = portrait.equilibria
    away = np.maximum(np.asarray(rests.x1_lower) - x1, x1 - np.asarray(rests.x1_upper))
    away = np.maximum(away, 0.0)
    away[np.asarray(rests.kind) == EquilibriumKind.SADDLE] = np.inf
    if not np.min(away, initial=np.inf) < KNOWN * (1 + abs(x1)):
        return NOT_KNOWN
    row = int(np.argmin(away))
    return Destination("equilibrium", max(i for i, _ in segments_of(portrait) if i <= row))


def segments_of(portrait: Portrait) -> list[tuple[int, int]]:
    """Rows in `equilibria` of the first and last piece of each point or segment of rest."""
    rests = portrait.equilibria
    kinds, lower, upper = map(np.asarray, (rests.kind, rests.x1_lower, rests.x1_upper))
    held = (kinds[1:] == EquilibriumKind.SEGMENT) & (kinds[:-1] == EquilibriumKind.SEGMENT)
    goes_on = held & (lower[1:] - upper[:-1] < 1e-12 * (1 + np.abs(lower[1:])))
    firsts = np.flatnonzero(np.append(True, ~goes_on)[: len(kinds)])
    return list(zip(firsts.tolist(), [*(firsts[1:] - 1).tolist(), len(kinds) - 1]))
