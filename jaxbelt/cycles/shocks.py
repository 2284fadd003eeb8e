"""The smallest shock that leads off an attractor: `minimal_fatal_shock` and its result,
`FatalShock`.

A shock moves the state (x1, x2) of a mass that is on an attractor. It is fatal if the mass then
goes elsewhere. The smallest fatal shock is the distance of the attractor from the boundary of its
basin (L. Halekotte and U. Feudel, Minimal fatal shocks in multistable complex networks, Scientific
Reports 10 (2020) 11783), which here is known exactly: it consists of unstable cycles and of stable
separatrices. So the shock is as accurate as these curves, and so are its derivatives: the shortest
way does not change to first order where its ends move along the curves, only where the curves move.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

from ..activity import announced
from ..checks import (
    as_finite,
    as_whole,
    is_concrete,
    number,
    require_one_of,
    require_outside_of_jit,
)
from ..model.oscillator import Oscillator, check_oscillator, refuse_clock
from ..model.own_units import OwnOscillator, in_given_units, in_units_of_run, quantity, rescaled
from ..results import Status, describe, draw
from ..tables import table_of
from .nearest import ShortestWay, in_parts, shortest_between
from .outlines import ClosedOutline, Outline, StraightOutline, straight
from .portrait import TRACED, Portrait, portrait
from .sides import Bound, Destination, bounds_of, leads_to, segments_of

if TYPE_CHECKING:
    import pandas

#: Possible directions of a shock.
DIRECTIONS = ("both", "x2")
#: Statuses with which every number is NaN.
FAILED = (Status.NOT_SETTLED, Status.NO_CONVERGENCE)


class FatalShock(eqx.Module):
    """The smallest fatal shock of an attractor; what `minimal_fatal_shock` returns.

    distance, start and shock are differentiable by every parameter of the oscillator.

    Attributes:
        portrait: Portrait of the oscillator, see `Portrait`.
        direction: "both" or "x2", what the shock changes.
        attractor: The attractor that is left: "cycle 0" or "equilibrium 2", numbers in the
            portrait.
        boundary: Where the shock leads: "unstable cycle 0", "separatrix 3" (numbers in the
            portrait), "boundary of belt 0" (one whose static limit exceeds mu(0)), or "none".
        beyond: Where starts beyond that boundary lead: "cycle 1", "equilibrium 0", "infinity".
        distance: Size of the shock; inf where there is no boundary in that direction.
        start: State (x1, x2) on the attractor from which the shock is the smallest, [2]; NaN where
            there is no boundary.
        shock: Change of this state, [2], likewise.
        status: OK; INCOMPLETE, where the portrait may lack boundaries, or they were not followed
            far enough to exclude a smaller shock; NOT_SETTLED, where y0 leads to no attractor, and
            NO_CONVERGENCE, where Newton's method failed: then every number is NaN.
    """

    portrait: Portrait
    direction: str = eqx.field(static=True)
    attractor: str = eqx.field(static=True)
    boundary: str = eqx.field(static=True)
    beyond: str = eqx.field(static=True)
    distance: Array = eqx.field(metadata=quantity("length"))
    start: Array = eqx.field(metadata=quantity("length", "velocity"))
    shock: Array = eqx.field(metadata=quantity("length", "velocity"))
    status: Array

    def at_phases(self, n: int) -> "pandas.DataFrame":
        """The smallest fatal shock at each of n phases of the cycle, evenly spread over a period.

        Args:
            n: Number of phases; an equilibrium has one.

        Returns:
            A row for each phase, with the columns t, the time since the first phase, x1, x2,
            distance, shock_x1, shock_x2; inf and NaN where there is no boundary in that direction,
            NaN where Newton's method failed.
        """
        known, along_x2 = in_units_of_run(self.portrait.oscillator), self.direction == "x2"
        shown, unit = _in_units_of(self.portrait, known), float(known.units.length)
        end = Destination.of_name(self.attractor)
        ts, states = _phases(shown, end, as_whole(n, "n"))
        outlines = [bound.outline for bound in bounds_of(shown) if end in bound.sides]
        curves = [in_parts(known, outline.pieces(known)) for outline in outlines]
        rows = []
        for t, y in zip(ts.tolist(), states, strict=True):
            x1, x2 = map(jnp.asarray, y)
            point = in_parts(known, straight(known, x1, x1, x2))
            ways = [shortest_between(known, point, curve, along_x2=along_x2) for curve in curves]
            best, to = np.inf, np.full(2, np.nan)
            for length, its_end, meeting in ways:
                if np.isnan(length):
                    best, to = np.nan, np.full(2, np.nan)
                    break
                if meeting is not None and length < best:
                    best, to = length, its_end
            rows.append([t, *(unit * np.array([*y, best, *(to - y)])).tolist()])
        names = ("t", "x1", "x2", "distance", "shock_x1", "shock_x2")
        return table_of([dict(zip(names, row, strict=True)) for row in rows])

    def table(self) -> "pandas.DataFrame":
        """Returns one row.

        Columns: attractor, direction, distance, x1 and x2 of the start, shock_x1, shock_x2,
        boundary, beyond, status.
        """
        (x1, x2), (shock_x1, shock_x2) = map(np.asarray, (self.start, self.shock))
        row = {
            "attractor": self.attractor,
            "direction": self.direction,
            "distance": float(self.distance),
            **{"x1": x1, "x2": x2, "shock_x1": shock_x1, "shock_x2": shock_x2},
            "boundary": self.boundary,
            "beyond": self.beyond,
            "status": Status(int(self.status)).name,
        }
        quantities = {"x1": "length", "x2": "velocity"}
        quantities |= {"shock_x1": "length", "shock_x2": "velocity"}
        # A distance that combines displacement and velocity has no unit.
        quantities |= {"distance": "velocity"} if self.direction == "x2" else {}
        return table_of([row], quantities)

    def plot(self, ax: Any = None) -> Any:
        """Draws the shock as an arrow in the portrait.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        if not is_concrete((self.distance, self.start)):
            return f"FatalShock({self.attractor} to {self.boundary})"
        text = f"FatalShock({self.attractor}, {self.direction}: {number(self.distance)}"
        if self.boundary != "none":
            # A component that is tiny compared with the distance may be rounding.
            shock = np.where(np.abs(self.shock) > 1e-15 * self.distance, self.shock, 0.0)
            start, shock = (", ".join(map(number, one)) for one in (self.start, shock))
            text += f", from ({start}) by ({shock}) to {self.boundary}, beyond it {self.beyond}"
        if int(self.status) != Status.OK:
            text += f"; {Status(int(self.status)).name}: {describe(self.status)}"
        return text + ")"


@announced("minimal_fatal_shock")
def minimal_fatal_shock(
    osc: Oscillator | Portrait, y0: ArrayLike | tuple, *, direction: str = "both"
) -> FatalShock:
    """The smallest change of the state after which a mass on an attractor goes elsewhere.

    It is the least over all states of the attractor, that is, over all phases of a cycle, to 1e-9.
    Unstable cycles and separatrices count if they have the attractor on one side and something else
    on the other. An unstable equilibrium is no boundary: starts around it do not stay.

    Differentiable by every parameter with `jax.grad`, `jax.jacfwd` and `jax.jacrev`: the derivative
    is that of the nearest piece of the boundary. As for `portrait`, the numbers decide how much is
    computed, so not for `jax.jit` and `jax.vmap`.

    Args:
        osc: The oscillator, or its `portrait` where that has been computed.
        y0: Start (x1, x2) that leads to the attractor, a cycle, an equilibrium or a segment, shape
            [2].
        direction: "both", a change of x1 and x2, of size sqrt(dx1^2 + dx2^2), or "x2", of the
            velocity alone, as a blow makes it. Dimensionless.

    Returns:
        The `FatalShock`.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    shown = osc if isinstance(osc, Portrait) else None
    osc = osc.oscillator if isinstance(osc, Portrait) else osc
    check_oscillator(osc)
    refuse_clock(osc, "minimal_fatal_shock", "jb.simulate from several starts")
    y0 = as_finite(y0, "y0", (2,))
    require_one_of(direction, DIRECTIONS, "direction")
    hint = "shocks are not for jit or vmap"
    require_outside_of_jit("minimal_fatal_shock", hint, osc=osc, y0=y0)
    given, osc = osc, in_units_of_run(osc)
    y0 = y0 / osc.units.length
    known, start = lax.stop_gradient((osc, y0))
    shown = portrait(lax.stop_gradient(given)) if shown is None else shown
    own_portrait = _in_units_of(shown, known)
    (end,) = leads_to(own_portrait, np.asarray(start)[None])
    way, bound, status = shortest_way_out(own_portrait, end, along_x2=direction == "x2")
    if bound is None or way is None:
        distance = jnp.asarray(np.array(np.nan if status in FAILED else np.inf))
        nowhere = jnp.asarray(np.full(2, np.nan))
        from_, shock = nowhere, nowhere
    else:
        from_, to = way.ends(osc)
        shock = to - from_
        distance = length_of(shock, direction)
    found = FatalShock(
        portrait=shown,
        direction=direction,
        attractor=end.name,
        boundary="none" if bound is None else bound.name,
        beyond="none" if bound is None else bound.beyond(end).name,
        distance=distance,
        start=from_,
        shock=shock,
        status=jnp.asarray(np.array(status.value)),
    )
    return replace(in_given_units(found, given, osc), portrait=shown)


def _in_units_of(own_portrait: Portrait, own: OwnOscillator) -> Portrait:
    """A portrait in own units; own: its oscillator in these."""
    return rescaled(own_portrait, 1 / own.units.length, lambda _: own)


def length_of(shock: Array, direction: str) -> Array:
    """The size of a shock, [2]; direction: see `minimal_fatal_shock`."""
    return jnp.abs(shock[1]) if direction == "x2" else jnp.sqrt(jnp.sum(shock**2))


def shortest_way_out(
    own_portrait: Portrait, end: Destination, *, along_x2: bool
) -> tuple[ShortestWay | None, Bound | None, Status]:
    """The shortest way from an attractor to the boundary of its basin, and that boundary.

    Both are None if there is no boundary in that direction, or the status is one of FAILED.
    """
    if end.what not in ("cycle", "equilibrium"):
        return None, None, Status.NOT_SETTLED
    osc, outline = own_portrait.oscillator, _outline_of(own_portrait, end)
    first, found = in_parts(osc, outline.pieces(osc)), bounds_of(own_portrait)
    shortest, way, beside = np.inf, None, None
    for bound in (bound for bound in found if end in bound.sides):
        second = in_parts(osc, bound.outline.pieces(osc))
        length, _, meeting = shortest_between(osc, first, second, along_x2=along_x2)
        if np.isnan(length):
            return None, None, Status.NO_CONVERGENCE
        if meeting is not None and length < shortest:
            shortest, beside = length, bound
            way = ShortestWay(outline, bound.outline, meeting, along_x2)
    farthest = max(np.max(np.abs(ends)) for ends in (first.low, first.high))
    # Separatrices are not followed beyond TRACED * reach.
    goes_on = any(one.stable and one.end == "outside" for one in own_portrait.separatrices)
    complete = not goes_on or shortest + farthest < TRACED * own_portrait.reach
    complete = complete and _is_complete(own_portrait, found)
    return way, beside, Status.OK if complete else Status.INCOMPLETE


def _is_complete(own_portrait: Portrait, found: list[Bound]) -> bool:
    """Whether nothing is missing among the bounds of a portrait."""
    known = all(side.what != "undecided" for bound in found for side in bound.sides)
    # A separatrix that ends on the boundary of a belt divides this into pieces; the boundary of a
    # belt at rest is a segment.
    ends = ("unsettled", "boundary")
    traced = all(one.end not in ends for one in own_portrait.separatrices if one.stable)
    resting = {
        f"boundary of belt {i}"
        for i, belt in enumerate(own_portrait.oscillator.belts)
        if float(belt.velocity) == 0
    }
    jumps_at_rest = any(bound.name in resting for bound in found)
    return int(own_portrait.status) == Status.OK and known and traced and not jumps_at_rest


def _outline_of(own_portrait: Portrait, end: Destination) -> Outline:
    if end.what == "cycle":
        return ClosedOutline.of(own_portrait.cycles[end.number])
    return next(
        StraightOutline(-1, *rows) for rows in segments_of(own_portrait) if rows[0] == end.number
    )


def _phases(own_portrait: Portrait, end: Destination, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and states of an attractor: n for a cycle, one where the mass rests."""
    if end.what == "cycle":
        cycle = own_portrait.cycles[end.number]
        ts = np.linspace(0.0, float(cycle.period), n, endpoint=False)
        return ts, np.asarray(cycle.sample(n + 1))[:n]
    return np.zeros(1), np.array([[float(own_portrait.equilibria.x1[end.number]), 0.0]])
