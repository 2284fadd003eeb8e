"""Contact edges of two belts that meet: `EdgeExchange` and `MeetingEdges`.

Beside such a point the two edges lie close together, and the contacts between them differ from
those to the left and to the right of both. At the point nothing is between them; beyond it the
edges come in the other order, and the contacts between them are different again.

- `EdgeExchange`: a cycle passes both edges, one right after the other. Its velocity is not zero
  there, so the arc between them has the duration distance/velocity. It vanishes at the point like
  the distance itself, and with the signature fixed the cycle goes smoothly through, as at a sliding
  exchange. The orbit changes continuously; its modes, and the order of its events, change at once.
- `MeetingEdges`: the mass can rest there, whether a cycle passes or not. The accelerations at rest
  to the left of both edges, between them and to the right of both decide whether there is a
  pseudo-focus on one of the edges, a segment between them, or no equilibrium. Beyond the point the
  acceleration between them differs: the equilibrium may move to the other edge, change its
  stability, appear or vanish.
"""

from itertools import pairwise, product
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks import is_concrete, pick, require_value
from ..cycles.chains import SIZES, Chain, Loop, after_each, first_failure
from ..cycles.shooting import meshed
from ..model.modes import Mode, any_of, capacity, edge_at, edges, mode_acceleration
from ..model.oscillator import Oscillator
from ..model.transitions import contact
from ..results import Status
from .base import AbstractCondition, Line, check_two_belts
from .conditions import AbstractCycleCondition
from .crossings import arrival_tests
from .guesses import nearest
from .rests import NOTHING, AbstractRestCondition
from .systems import CycleSystem, RestSystem


class TwoEdges(eqx.Module):
    """Two edges by their numbers in `modes.edges`; the first one belongs to the first belt."""

    first: Array
    second: Array

    def gap(self, osc: Oscillator) -> Array:
        """Position of the first edge minus that of the second one."""
        positions = jnp.stack(edges(osc))
        return positions[self.first] - positions[self.second]


class _BetweenEdges(AbstractCondition):
    """A condition that any contact edge of one belt meets any contact edge of another."""

    belts: tuple[int, int]

    def check(self, osc):
        check_two_belts(self.belts)
        super().check(osc)
        if is_concrete(osc):
            ends = [(osc.belts[belt].lower, osc.belts[belt].upper) for belt in self.belts]
            have = np.all(np.any(np.isfinite(ends), axis=1))
            require_value(have, "belts", "two with a finite edge", self.belts)


def _edge_pairs(osc: Oscillator, belts: tuple[int | Array, int | Array]) -> TwoEdges:
    """The four pairs of an edge of the first belt and an edge of the second one, [4]."""
    n = len(osc.belts)
    pairs = [(belts[0] + i * n, belts[1] + j * n) for i, j in product((0, 1), repeat=2)]
    return TwoEdges(*(jnp.stack([jnp.asarray(one) for one in ends]) for ends in zip(*pairs)))


def _size(gap: Array) -> Array:
    """Absolute gap between two edges, inf where either edge is infinite."""
    return jnp.where(jnp.isfinite(gap), jnp.abs(gap), jnp.inf)


def _both_rub(osc: Oscillator, belts: tuple[int | Array, int | Array]) -> Array:
    """Whether both belts have a load: the edge of a belt without load does nothing."""
    loads = jnp.stack([belt.load for belt in osc.belts])
    return (loads[belts[0]] > 0) & (loads[belts[1]] > 0)


# --- a cycle passes both --------------------------------------------------------------------------


class EdgesPassed(CycleSystem):
    """A cycle that passes two edges in succession, at the ends of `row` and of the arc after it."""

    chain: Chain
    row: Array
    pair: TwoEdges

    def condition(self, osc, z, miss):
        return self.pair.gap(osc)

    def watch(self, osc, z, slope):
        return arrival_tests(osc, self.chain, z, self.row), True, jnp.nan


class EdgeExchange(AbstractCycleCondition, _BetweenEdges):
    """Contact edges of two belts meet and change places where a cycle passes them.

    Beyond the point it passes them in the other order, in another mode between them.

    Args:
        belts: Numbers of the two belts.
    """

    caption: ClassVar[str] = "edge exchange, belts {belt}"
    line: ClassVar[Line] = Line("edge exchange", "#56B4E9", (0, (1, 1.2)))

    @property
    def room(self):
        return SIZES[1]  # passing edges needs more arcs

    def guess(self, osc, size):
        return nearest(osc, size, self)

    def distance(self, osc: Oscillator, loop: Loop) -> Array:
        """Distance between the edges that the loop passes."""
        return _passage_of_edges(osc, loop, self.belts)[0]

    def system(self, osc, loop, status):
        distance, row, pair = _passage_of_edges(osc, loop, self.belts)
        exists = jnp.isfinite(distance) & _both_rub(osc, self.belts)
        status = first_failure(status, exists, Status.NOT_TOUCHED)
        chain, z = meshed(osc, loop)
        return EdgesPassed(chain, row, pair), z, status

    @classmethod
    def at_meeting(cls, belts, before, after):
        return [cls((belts[0], belts[1]))] if before.cycles != after.cycles else []


def _passage_of_edges(osc: Oscillator, loop: Loop, belts) -> tuple[Array, Array, TwoEdges]:
    """The closest two edges, one of each belt, that a loop passes in succession.

    Returns the distance between them, inf if there are no such edges, the row of the arc that ends
    on the edge that is passed first, and the pair.
    """
    n, positions, pairs = len(osc.belts), jnp.stack(edges(osc)), _edge_pairs(osc, belts)
    passes = (loop.ends >= n) & (loop.ends < 3 * n)
    at = jnp.where(passes, positions[jnp.clip(loop.ends - n, 0, 2 * n - 1)], jnp.nan)
    following = after_each(loop, at)

    def distances(pair):
        first, second = positions[pair.first], positions[pair.second]
        # Two edges at one place are passed at once, at the end of one arc.
        then = jnp.where(first == second, at, following)
        passed = (at == first) & (then == second) | (at == second) & (then == first)
        return jnp.where(passed, _size(pair.gap(osc)), jnp.inf)

    found = jax.vmap(distances)(pairs)
    which, row = jnp.divmod(jnp.argmin(found), loop.ends.size)
    return found[which, row], row, pick(pairs, which)


# --- the mass rests there -------------------------------------------------------------------------


class EdgesAtRest(RestSystem):
    """Two edges meet: one equation, in the parameter alone; belts: those with these edges."""

    pair: TwoEdges
    belts: tuple[int | Array, int | Array]

    @property
    def otherwise(self):
        return Status.NOT_TOUCHED

    def residual(self, osc, x):
        return self.pair.gap(osc)[None]

    def x1(self, osc, x):
        return edge_at(osc, self.pair.first)

    def exists(self, osc, x):
        """Whether the mass can rest on the edges, or between them, in either order of the edges."""
        focus, held = self._margins(osc)
        rests = any_of([*(one > 0 for one in focus), *(one >= 0 for one in held)])
        return rests & _both_rub(osc, self.belts)

    def tests(self, osc, x):
        focus, held = self._margins(osc)
        return {("BoundaryEquilibrium", ()): jnp.max(jnp.stack([*focus, *held]))}

    def _margins(self, osc: Oscillator) -> tuple[list[Array], list[Array]]:
        """Margins of a pseudo-focus on either edge (the weaker push to it) and of a segment between
        the edges (spare holding force), in both orders; negative where the mass cannot rest so."""
        positions = jnp.stack(edges(osc))
        ends = jnp.sort(jnp.stack([positions[self.pair.first], positions[self.pair.second]]))
        rest = jnp.zeros(())
        left = contact(osc, ends[0], rest, rightward=False)
        right = contact(osc, ends[1], rest, rightward=True)
        focus, held = [], []
        passed_first = (self.belts[0], self.pair.first), (self.belts[1], self.pair.second)
        for (passed, edge), (other, _) in zip(passed_first, reversed(passed_first), strict=True):
            # Between the edges the belt whose edge comes first already has its contact to the right
            # of both, and so have belts that are equal to it.
            equal = _equal_belts(osc, passed, edge)
            codes = [
                jnp.where(equal[number] & (number != other), after, before)
                for number, (before, after) in enumerate(zip(left.codes, right.codes, strict=True))
            ]
            modes = left, Mode(tuple(codes)), right
            pushes = [_net_pushes(osc, mode, ends[0]) for mode in modes]
            focus += [jnp.minimum(a, b) for (a, _), (_, b) in pairwise(pushes)]
            held.append(-jnp.maximum(*pushes[1]))
        return focus, held


def _equal_belts(osc: Oscillator, belt: int | Array, edge: Array) -> list[Array]:
    """Whether each belt has the velocity of `belt` and, on the same side, an edge at `edge`."""
    n, positions = len(osc.belts), jnp.stack(edges(osc))
    velocities = jnp.stack([jnp.asarray(one.velocity) for one in osc.belts])
    sides = positions.reshape(2, n)[edge // n]
    same = (velocities == velocities[belt]) & (sides == positions[edge])
    return [same[number] for number in range(n)]


def _net_pushes(osc: Oscillator, mode: Mode, x1: Array) -> tuple[Array, Array]:
    """Forces on the mass at rest to the right and to the left, less the capacity of stuck belts."""
    needed, held = mode_acceleration(osc, mode, x1, jnp.zeros(())), capacity(osc, mode)
    return needed - held, -needed - held


class MeetingEdges(AbstractRestCondition, _BetweenEdges):
    """Contact edges of two belts meet and change places where the mass can rest.

    Beyond the point the equilibrium there has another kind or stability, or it appears or vanishes.

    Args:
        belts: Numbers of the two belts.
    """

    caption: ClassVar[str] = "edges meet, belts {belt}"
    line: ClassVar[Line] = Line("edges meet", "#D55E00", (0, (1, 1.2)))
    ends_at_contact: ClassVar[bool] = True

    def guess(self, osc, size):
        return None

    def system(self, osc, guess: Any):
        pairs = _edge_pairs(osc, self.belts)
        sizes = _size(jax.vmap(lambda pair: pair.gap(osc))(pairs))
        at = jnp.argmin(sizes)
        pair = pick(pairs, at)
        status = jnp.where(jnp.isfinite(sizes[at]), Status.OK.value, Status.NOT_TOUCHED.value)
        return EdgesAtRest(pair, self.belts), NOTHING, status

    @classmethod
    def at_meeting(cls, belts, before, after):
        return [cls((belts[0], belts[1]))] if before.equilibria != after.equilibria else []
