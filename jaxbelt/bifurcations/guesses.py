"""Loops of cycles as guesses for conditions.

Orbits are followed from ends of stick phases, and from a few places beside an equilibrium, until a
loop repeats.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..checks import pick
from ..cycles.chains import Loop, first_failure, following_codes
from ..cycles.orbits import Orbit, before_stick_ends, follow, last_loop, loop_of
from ..model.equilibria import Equilibria, EquilibriumKind, candidates, saddles
from ..model.modes import STUCK, edges, mode_acceleration, mode_of, select, velocity_of
from ..model.oscillator import Oscillator
from ..motion.arcs import Ends
from ..motion.integrators import STRIDE
from ..numerics.compiling import each, jit
from ..results import Status
from .systems import third_derivative

#: Number of arcs for which the orbit from slip onset is followed to find the signature. Of 665 such
#: orbits (300 oscillators, half of them with round numbers) 84% repeated by then, 87% after 96.
HINT_BUDGET = 32
#: FOLLOWED arcs in each of ATTEMPTS attempts to follow an orbit until it repeats; each continues
#: the orbit or begins at its limit. Of the 1,565 orbits from `starts` of those oscillators 87%
#: repeated within 96 arcs, 95% within 384 and 97% within 768; the others creep.
FOLLOWED = 96
ATTEMPTS = 6
#: Distances of the starts to the right of an equilibrium. If it repels, INNERMOST is one more: an
#: unstable cycle may surround it, with an attracting cycle between the two.
DISTANCES, INNERMOST = (0.02, 0.3, 3.0), 4e-3
#: Distance of the starts on both sides of a saddle: just beyond a saddle connection an attracting
#: cycle may pass the saddle this closely.
BESIDE_SADDLE = 1e-9


def starts(osc: Oscillator, rests: Equilibria) -> Array:
    """Starts of the orbits that find the cycles, [starts, 2].

    They lie at ends of stick phases, just beside the saddles, and at several distances from an
    equilibrium, the farthest one last. Rows without a start are NaN.
    """
    exists = rests.kind > 0
    repels = exists & ~rests.stable
    row = jnp.where(jnp.any(repels), jnp.argmax(repels), jnp.maximum(jnp.sum(exists) - 1, 0))
    centre = jnp.where(jnp.any(exists), rests.x1[row], 0.0)
    ends = [before_stick_ends(osc, belt) for belt in range(len(osc.belts))]
    innermost = jnp.where(jnp.any(repels), _innermost(osc, rests, row), jnp.nan)
    distances = (innermost, *DISTANCES)
    others = [jnp.stack([centre + distance, jnp.zeros(())])[None] for distance in distances]
    places = jnp.stack(edges(osc))
    places = jnp.where(saddles(osc), places, jnp.nan)
    away = BESIDE_SADDLE * (1 + jnp.abs(places))
    beside = jnp.concatenate([places - away, places + away])
    return jnp.concatenate([*ends, jnp.stack([beside, jnp.zeros_like(beside)], axis=-1), *others])


def _innermost(osc: Oscillator, rests: Equilibria, row: Array) -> Array:
    """Distance of the innermost start from an equilibrium that repels.

    Beside a supercritical Hopf point it is the amplitude A of the cycle, to third order: the growth
    over a loop, rate A^2 + y A^4 / 16 with y the third derivative of x2' by x2, is zero there. From
    other starts orbits hardly converge to so weak a cycle, which may end in a fold before they do.
    """
    codes = rests.modes[row].astype(float)
    third = third_derivative(osc, codes, rests.x1[row])
    amplitude = jnp.sqrt(-16 * rests.rate[row] / jnp.where(third < 0, third, -jnp.inf))
    is_weak = (rests.kind[row] == EquilibriumKind.FIXED_POINT) & (third < 0)
    return jnp.where(is_weak & (amplitude < DISTANCES[1]), amplitude, INNERMOST)


def approach(osc: Oscillator, rests: Equilibria, start: Array, stride: float | Array) -> Orbit:
    """Follows the orbit from a start until it repeats; the status is OK where it is on a cycle.

    An orbit that has not repeated is continued in a further attempt. Aitken's formula, exact for a
    geometric sequence, gives the limit of the last three tops (maxima of x1). If the limit is much
    nearer to the last top than any equilibrium is, the next attempt begins at the limit, as there
    may be a boundary on the way; if the last attempt does not repeat either, its last loop counts
    as the one that repeats. An orbit whose last loop sticks is always continued from where it is:
    from the end of the stick phase it repeats exactly.
    """

    def attempt(state):
        number, start, *_ = state
        orbit = follow(osc, start, FOLLOWED, stride)
        rows = jnp.arange(orbit.tops.size)
        last = jnp.sort(jnp.where(jnp.isnan(orbit.tops), -1, rows))[-3:]
        tops = orbit.tops[last]
        before, after = tops[1] - tops[0], tops[2] - tops[1]
        ratio = after / jnp.where(before == 0, 1.0, before)
        limit = tops[2] + after * ratio / (1 - ratio)
        distance = jnp.min(jnp.where(rests.kind > 0, jnp.abs(tops[2] - rests.x1), jnp.inf))
        away = jnp.abs(limit - tops[2]) < 0.2 * distance
        pending = orbit.status == Status.NOT_SETTLED
        inside = (rows > last[1]) & (rows <= last[2])
        has_stuck = jnp.any(inside & jnp.any(orbit.codes == STUCK, axis=-1))
        is_cycle = pending & (last[0] >= 0) & (before != 0) & (jnp.abs(ratio) < 1) & away
        is_cycle = is_cycle & ~has_stuck
        start = jnp.where(is_cycle, jnp.stack([limit, jnp.zeros(())]), orbit.y)
        return number + 1, start, orbit, last, pending, is_cycle

    def unsettled(state):
        number, *_, pending, _ = state
        return (number == 0) | (pending & (number < ATTEMPTS))

    none = _zeros_of(attempt, (jnp.asarray(0), start))
    first = (jnp.asarray(0), start, *none[2:])
    _, _, orbit, last, _, is_cycle = lax.while_loop(unsettled, attempt, first)
    ended = eqx.tree_at(
        lambda o: (o.repeats, o.count, o.status),
        orbit,
        (last[1], last[2] + 1, jnp.asarray(Status.OK.value)),
    )
    return select(is_cycle, ended, orbit)


def _zeros_of(function: Callable, argument: Any) -> Any:
    """Zeros with the shapes and dtypes of function(argument)."""
    shapes = jax.eval_shape(function, argument)
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)


@jit
def repeated_loops(
    osc: Oscillator, rests: Equilibria, size: int, stride: float | Array = STRIDE
) -> tuple[Loop, Array]:
    """The loop that each orbit from `starts` repeats, padded to `size` arcs, and its status."""

    def run(start):
        orbit = approach(osc, rests, start, stride)
        _, count = last_loop(orbit)
        status = first_failure(orbit.status, count <= size, Status.TOO_MANY_ARCS)
        return loop_of(orbit, size, len(osc.belts)), status

    osc, rests = lax.stop_gradient((osc, rests))
    return each(run)(starts(osc, rests))


def nearest(osc: Oscillator, size: int, condition: Any) -> tuple[Loop, Array]:
    """The loop, padded to `size` arcs, of the attracting cycle with the least
    condition.distance(osc, loop), and a status."""
    return _least_distant(osc, *repeated_loops(osc, candidates(osc), size), condition)


@jit
def _least_distant(osc: Oscillator, loops: Loop, status: Array, condition: Any):
    distances = jax.vmap(functools.partial(condition.distance, lax.stop_gradient(osc)))(loops)
    known = (status == Status.OK) & ~jnp.isnan(distances)
    distances = jnp.where(known, distances, jnp.inf)
    at, large = jnp.argmin(distances), jnp.any(status == Status.TOO_MANY_ARCS)
    none = jnp.where(large, Status.TOO_MANY_ARCS.value, Status.NOT_TOUCHED.value)
    found = jnp.isfinite(distances[at])
    return pick(loops, at), jnp.where(found, Status.OK.value, none)


def least_push(osc: Oscillator, loop: Loop, belt: int | Array) -> tuple[Array, Array]:
    """Row of the arc that arrives to stick to a belt with the least |x2'|, and that |x2'|.

    Only arcs that slip with the sign of the belt's velocity count: on that side x2' vanishes where
    an orbit is tangent to the boundary. Without such an arc |x2'| is inf.
    """
    side = jnp.sign(velocity_of(osc, belt))
    arrives = loop.used & (following_codes(loop)[:, belt] == 0) & (loop.codes[:, belt] == side)

    def push(codes, y):
        return jnp.abs(mode_acceleration(osc, mode_of(codes), y[0], y[1]))

    pushes = jnp.where(arrives, jax.vmap(push)(loop.codes, loop.exits), jnp.inf)
    return jnp.argmin(pushes), jnp.min(pushes)


@jit
def orbit_after_stick(osc: Oscillator, belt: int | Array) -> tuple[Oscillator, Array, Orbit]:
    """The oscillator, a state just before a stick phase on the belt ends, and the orbit from there.

    There is such an orbit in each of several zones: the one that returns to stick to the belt most
    nearly tangent to the boundary is taken; if none sticks, the one that comes nearest to the
    boundary. The oscillator is the given one, but a belt at rest gets a small velocity, as no orbit
    leaves it.
    """
    velocities = [
        jnp.where((belt == i) & (one.velocity == 0), 1e-2, one.velocity)
        for i, one in enumerate(osc.belts)
    ]
    moving = eqx.tree_at(lambda o: [one.velocity for one in o.belts], osc, velocities)
    moving = lax.stop_gradient(moving)
    n = len(osc.belts)
    velocity, extremum_x2 = velocity_of(moving, belt), Ends(n).extremum_x2
    states = before_stick_ends(moving, belt)
    exists = jnp.isfinite(states[:, 0])
    states = states[jnp.argsort(~exists)]

    def attempt(tried):
        number, best, kept = tried
        orbit = follow(moving, states[number], HINT_BUDGET)
        _, push = least_push(moving, loop_of(orbit, HINT_BUDGET, n), belt)
        x2 = orbit.exits[:, 1]
        loops = (orbit.ends == extremum_x2) & (x2 * velocity > 0) & (jnp.arange(HINT_BUDGET) > 0)
        gap = jnp.min(jnp.where(loops, jnp.abs(velocity - osc.omega * x2), jnp.inf))
        sticks = (orbit.status == Status.OK) & jnp.isfinite(push)
        size = jnp.where(sticks, push, 1e6 + gap)
        better = (number == 0) | (size < best)
        new = (size, (states[number], orbit))
        best, kept = select(better, new, (best, kept))
        return number + 1, best, kept

    empty = _zeros_of(lambda y: (y, follow(moving, y, HINT_BUDGET)), states[0])
    none = jnp.asarray(0), jnp.asarray(jnp.inf), empty
    several = jnp.maximum(jnp.sum(exists), 1)
    _, _, (start, orbit) = lax.while_loop(lambda tried: tried[0] < several, attempt, none)
    return moving, start, orbit


@jit
def repeated_loop(orbit: Orbit, size: int, n: int) -> tuple[Loop, Array]:
    """The loop that an orbit repeats, padded to `size` arcs, and a status; n: number of belts."""
    _, count = last_loop(orbit)
    status = jnp.where(count <= size, Status.OK.value, Status.TOO_MANY_ARCS.value)
    status = jnp.where(orbit.status == Status.OK, status, Status.NOT_TOUCHED.value)
    return loop_of(orbit, size, n), status


def without_arcs(loop: Loop, row: Array, removed: Array) -> tuple[Loop, Array]:
    """The loop without the `removed` arcs after `row`, and the new number of `row`, its last."""
    rows, count = jnp.arange(loop.ends.size), jnp.maximum(jnp.sum(loop.used), 1)
    left, first = count - removed, row + removed + 1
    source = jnp.where(rows < left, first + rows, first) % count
    ends = jnp.where(rows < left, loop.ends[source], Ends(loop.codes.shape[-1]).unused)
    durations = jnp.where(rows < left, loop.durations[source], 0.0)
    return Loop(loop.codes[source], ends, loop.entries[source], durations), left - 1
