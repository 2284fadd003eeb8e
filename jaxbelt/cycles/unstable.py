"""The unstable cycle around a stable equilibrium: `unstable_cycle`.

Starts to the right of the equilibrium at different distances are followed for one loop. The first
one that does not come nearer, or that touches a boundary, lies outside of the cycle; between it and
its neighbour the search is repeated, and Newton's method does the rest. That is one program, for
`jit`, `vmap` and derivatives. It misses a cycle that has an attracting one close outside of it. So
where it finds none, and the oscillator is not traced, all cycles are searched, as by `portrait`.
"""

import functools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..activity import announced
from ..checks import as_whole, pick, require_value
from ..model.equilibria import Equilibria, EquilibriumKind, candidates, equilibria, most_equilibria
from ..model.modes import STUCK
from ..model.oscillator import Oscillator, check_oscillator, refuse_clock
from ..model.own_units import in_given_units, in_own_units
from ..numerics.compiling import each, in_groups, is_outermost, jit
from ..results import Status
from .attractors import arcs_of, place_of
from .chains import SIZES, Loop, modes_of
from .cycle import Cycle, exactly
from .orbits import first_loop, loop_of
from .portrait import branches_and_returns

#: Loops that are compared in one batch, and how often the interval between two of them is refined:
#: 31^5 parts of the way from 1e-4 to 10 give the guess to 4e-7 of itself, so that Newton's method
#: converges from there to cycles with multipliers of ten thousand.
LOOPS_TRIED, REFINEMENTS = 32, 5


@announced("unstable_cycle")
def unstable_cycle(osc: Oscillator, *, around: int = 0, max_arcs: int | None = None) -> Cycle:
    """The unstable cycle around a stable equilibrium that touches no boundary (no sliding).

    It separates the starts that come to rest from those that go on to the motion outside of it. It
    may pass contact edges. It is differentiable like any `Cycle`.

    Args:
        osc: The oscillator.
        around: Number of the equilibrium, counted from the left among the stable ones without
            segments.
        max_arcs: Room for the arcs of one loop, as for `find_cycle`.

    Returns:
        The `Cycle`. Where there is none, or none of this sort, its status is NO_UNSTABLE_CYCLE;
        under `jit`, `vmap` and derivatives also where another cycle attracts close outside of it.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    check_oscillator(osc)
    refuse_clock(osc, "unstable_cycle")
    last = most_equilibria(osc) - 1
    is_number = isinstance(around, int | np.integer) and not isinstance(around, bool)
    among = f"0 to {last}" if last else "0"
    expected = f"the number of an equilibrium, {among}"
    require_value(is_number and 0 <= around <= last, "around", expected, around)
    room = SIZES[0] if max_arcs is None else as_whole(max_arcs, "max_arcs")
    own = in_own_units(osc)
    cycle = from_starts(own, around=around, room=room)
    if is_outermost(osc) and int(cycle.status) == Status.NO_UNSTABLE_CYCLE:
        found = among_all(own, around)
        cycle = cycle if found is None else found
    return in_given_units(cycle, osc, own)


def from_starts(osc: Oscillator, *, around: int = 0, room: int = SIZES[0]) -> Cycle:
    """`unstable_cycle` by one program, as under `jit`: from starts near the equilibrium."""
    loop, status, distance = separating_loop(osc, room, around)
    return _if_meant(exactly(osc, loop, status), loop, distance)


def among_all(osc: Oscillator, around: int) -> Cycle | None:
    """The innermost cycle of that sort around an equilibrium, among all cycles of a concrete
    oscillator; None if there is none."""
    points = equilibria(osc)
    meant = np.flatnonzero(_eligible(points))
    if around >= len(meant):
        return None
    x1 = float(points.x1[meant[around]])
    _, returns = branches_and_returns(osc, points)
    found = [cycle for cycle in returns.cycles if _is_sought(cycle, x1)]
    return min(found, key=lambda cycle: float(cycle.x1_max - cycle.x1_min), default=None)


def _eligible(rests: Equilibria) -> Array:
    return rests.stable & (rests.kind != EquilibriumKind.SEGMENT) & (rests.kind > 0)


def _is_sought(cycle: Cycle, x1: float) -> bool:
    """Whether a cycle repels, never sticks, and surrounds the place x1."""
    slips = not np.any(modes_of(arcs_of(cycle)[0]) == STUCK)
    low, high, *_ = place_of(cycle)
    return float(cycle.multiplier) > 1 and slips and bool(low < x1 < high)


def separating_loop(osc: Oscillator, size: int, around: int = 0) -> tuple[Loop, Array, Array]:
    """A loop near the unstable cycle, a status, and its distance from the equilibrium."""
    return _separating_loop(osc, candidates(osc), jnp.asarray(np.array(around)), size)


@jit
def _separating_loop(osc: Oscillator, rests: Equilibria, around: Array, size: int):
    separating = in_groups(functools.partial(_separating_in_lanes, size=size))
    return separating(*lax.stop_gradient((osc, rests, around)))


def _separating_in_lanes(still: Oscillator, rests: Equilibria, around: Array, size: int):
    eligible = _eligible(rests)
    meant = eligible & (jnp.cumsum(eligible) - 1 == around)
    exists = jnp.any(meant)
    x1 = jnp.where(exists, rests.x1[jnp.argmax(meant)], 0.0)

    def loop(distance):
        orbit, touches, top = first_loop(still, x1, distance, size)
        rests = (orbit.status == Status.PSEUDO_FOCUS) | (orbit.status == Status.EQUILIBRIUM)
        inside = ~touches & jnp.where(jnp.isnan(top), rests, top - x1 < distance)
        return orbit, inside

    def narrow(bracket, _):
        distances = jnp.exp(jnp.linspace(jnp.log(bracket[0]), jnp.log(bracket[1]), LOOPS_TRIED))
        orbits, inside = each(loop)(distances)
        first = jnp.argmin(inside)
        bounded = ~inside[-1] & (first > 0)
        low, high = distances[jnp.maximum(first - 1, 0)], distances[first]
        bracket = jnp.where(bounded, jnp.stack([low, high]), bracket)
        innermost = pick(orbits, jnp.maximum(first - 1, 0))
        return bracket, (inside[0] & ~jnp.all(inside), innermost)

    bracket, (found, orbits) = lax.scan(narrow, jnp.array([1e-4, 10.0]), None, length=REFINEMENTS)
    orbit = pick(orbits, -1)
    status = jnp.where(exists & found[0], Status.OK.value, Status.NO_UNSTABLE_CYCLE.value)
    return loop_of(orbit, size, len(still.belts)), status, bracket[0]


@jit
def _if_meant(cycle: Cycle, loop: Loop, distance: Array) -> Cycle:
    """The cycle if it repels and begins near the loop, else NaN with NO_UNSTABLE_CYCLE: Newton's
    method may find one elsewhere, or shrink it to the equilibrium."""
    near = jnp.abs(cycle.unknowns[0, 0] - loop.entries[0, 0]) < 0.1 * distance
    same = near & (cycle.multiplier > 1)
    missing = (cycle.status == Status.OK) & ~same | (cycle.status == Status.NOT_ADMISSIBLE)
    missing = missing | (cycle.status == Status.NO_CONVERGENCE)
    status = jnp.where(missing, Status.NO_UNSTABLE_CYCLE.value, cycle.status)
    known = functools.partial(jnp.where, status == Status.OK)
    return replace(
        cycle,
        unknowns=known(cycle.unknowns, jnp.nan),
        multiplier=known(cycle.multiplier, jnp.nan),
        residual=known(cycle.residual, jnp.nan),
        status=status,
    )
