"""Attractors on both sides of the curves that divide motions.

On the axis x2 = 0 all cycles, separatrices and equilibria mark places, and all starts between two
neighbouring places lead to one attractor. So one start between them, far from slow motions, is
enough.
"""

from collections.abc import Sequence
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
from ..results import Status
from .orbits import MOST_ARCS, follow, place_of_rest
from .outlines import (
    JumpOutline,
    Outline,
    Rest,
    jumps,
    outline_of_cycle,
    outline_of_separatrix,
    place_on,
)
from .portrait import Portrait

#: Starts that are followed in one batch, and number of rounds, MOST_ARCS arcs each.
STARTS_AT_ONCE, ROUNDS = 16, 32
#: Accuracy of x2 of places on the axis; states at ends of arcs are good to 1e-9.
ON_AXIS = 1e-8
#: A cycle that attracts weakly is recognised from so far off, relative to the distance from the
#: origin.
KNOWN = 1e-3
#: Distance of starts from a curve that does not cross the axis, and from a boundary.
ASIDE = 1e-6


class Destination(NamedTuple):
    """Destination of a start.

    what: "cycle", "equilibrium", "infinity" or "undecided"; number: in the portrait (for a segment
    in pieces that of the first), or -1.
    """

    what: str
    number: int

    @property
    def name(self) -> str:
        return f"{self.what} {self.number}" if self.number >= 0 else self.what


def destination_of_name(name: str) -> Destination:
    """The `Destination` with a name."""
    what, _, row = name.partition(" ")
    return Destination(what, int(row) if row else -1)


class Bound(NamedTuple):
    """A curve that may divide motions: its name, its outline, and the destinations on its two
    sides."""

    name: str
    outline: Outline
    sides: tuple[Destination, Destination]

    def beyond(self, end: Destination) -> Destination:
        """The other side."""
        return self.sides[1] if self.sides[0] == end else self.sides[0]


def bounds_of(portrait: Portrait) -> list[Bound]:
    """All curves of a portrait that divide motions with different ends, or may do so."""
    osc, places = portrait.oscillator, _places(portrait)
    found: list[tuple[str, Outline]] = []
    starts: list[np.ndarray] = []
    for number, cycle in enumerate(portrait.unstable):
        found.append((f"unstable cycle {number}", outline_of_cycle(cycle)))
        starts.append(_around(places, float(cycle.x1_max)))
    for number, one in enumerate(portrait.separatrices):
        if one.stable:
            outline = outline_of_separatrix(osc, one)
            found.append((f"separatrix {number}", outline))
            x1, x2 = np.asarray(one.point).tolist()
            starts.append(_around(places, x1) if x2 == 0 else _across(osc, outline))
    for belt, zone, upper in jumps(osc):
        outline = JumpOutline(belt, zone, upper)
        found.append((f"boundary of belt {belt}", outline))
        starts.append(_across(osc, outline))
    if not found:
        return []
    ends = leads_to(portrait, np.concatenate(starts))
    pairs = zip(ends[::2], ends[1::2], strict=True)
    return [
        Bound(name, outline, pair)
        for (name, outline), pair in zip(found, pairs, strict=True)
        if pair[0] != pair[1] or pair[0].what == "undecided"
    ]


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
    """Starts on the axis on both sides of a place, half the way to the next one, [2, 2]."""
    # Places that differ by rounding are one.
    near = 10 * ON_AXIS * (1 + abs(x1))
    left, right = places[places < x1 - near], places[places > x1 + near]
    ends = left.max(initial=-np.inf), right.min(initial=np.inf)
    ends = [end if np.isfinite(end) else x1 + beyond for end, beyond in zip(ends, (-1.0, 1.0))]
    return np.array([[0.5 * (x1 + end), 0.0] for end in ends])


def _across(osc: Oscillator, outline: Outline) -> np.ndarray:
    """Starts on both sides of the middle of the first piece, [2, 2]."""
    piece = jax.tree.map(lambda leaf: leaf[0], outline.pieces(osc))
    place, slope, _ = map(np.asarray, place_on(osc, piece, jnp.asarray(0.5)))
    normal = np.array([-slope[1], slope[0]]) / np.hypot(*slope)
    return place + ASIDE * (1 + np.abs(place).max()) * np.array([normal, -normal])


# --- where starts lead ----------------------------------------------------------------------------


def leads_to(portrait: Portrait, starts: np.ndarray) -> list[Destination]:
    """Destinations of starts, [n, 2], in a portrait."""
    ends: list[Destination | None] = [None] * len(starts)
    states = np.array(starts, float)
    for _ in range(ROUNDS):
        left = np.array([i for i, end in enumerate(ends) if end is None], int)
        for first in range(0, left.size, STARTS_AT_ONCE):
            batch = left[first : first + STARTS_AT_ONCE]
            filled = batch[np.minimum(np.arange(STARTS_AT_ONCE), batch.size - 1)]
            followed = _followed_on(portrait.oscillator, jax.device_put(states[filled]))
            for i, status, top, rest, y in zip(batch, *map(np.asarray, followed)):
                ends[i] = _destination(portrait, int(status), float(top), float(rest), y)
                states[i] = y
    return [Destination("undecided", -1) if end is None else end for end in ends]


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
    """Where an orbit has come to; None if that is not known yet."""
    if not np.isnan(rest):
        number = _row_of_rest(portrait, rest)
        return Destination("equilibrium", number) if number >= 0 else Destination("undecided", -1)
    if status == Status.OK:
        away = [abs(float(cycle.x1_max) - top) for cycle in portrait.cycles]
        near = len(away) and min(away) < KNOWN * (1 + abs(top))
        return Destination("cycle", int(np.argmin(away))) if near else Destination("undecided", -1)
    if not np.all(np.abs(y) < 10 * portrait.reach):
        return Destination("infinity" if portrait.escapes else "undecided", -1)
    return None if status == Status.NOT_SETTLED else Destination("undecided", -1)


def _row_of_rest(portrait: Portrait, x1: float) -> int:
    """The first row of the state of rest at x1, or -1."""
    lower, upper = (
        np.asarray(ends) for ends in (portrait.equilibria.x1_lower, portrait.equilibria.x1_upper)
    )
    away = np.maximum(np.maximum(lower - x1, x1 - upper), 0.0)
    away[np.asarray(portrait.equilibria.kind) == EquilibriumKind.SADDLE] = np.inf
    row = int(np.argmin(away)) if away.size else -1
    if row < 0 or not away[row] < KNOWN * (1 + abs(x1)):
        return -1
    return next(rest.first for rest in resting_places(portrait) if rest.first <= row <= rest.last)


def resting_places(portrait: Portrait) -> Sequence[Rest]:
    """States of rest: points, and segments with all their pieces."""
    rests = portrait.equilibria
    kinds, lower, upper = map(np.asarray, (rests.kind, rests.x1_lower, rests.x1_upper))
    found: list[Rest] = []
    for row, kind in enumerate(kinds):
        goes_on = found and kind == EquilibriumKind.SEGMENT == kinds[row - 1]
        if goes_on and lower[row] - upper[row - 1] < 1e-12 * (1 + abs(lower[row])):
            found[-1] = Rest(found[-1].first, row)
        else:
            found.append(Rest(row, row))
    return found
