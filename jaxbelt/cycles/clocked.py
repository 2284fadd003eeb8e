"""Shooting with a clock: a chain of arcs that is closed after n periods of the forcing.

As in `shooting`, but a state is (x1, x2, t). A chain begins at the phase 0 of the forcing and is
cut wherever a period ends, where t restarts at 0. Where an event is near the phase 0 the chain
begins at another fraction s of the period P instead, with t = s P. For N arcs:

    4N unknowns    entry state (x1, x2, t) and duration T of every arc
     N equations   the guard of the arc's end vanishes at its end; at the end of a period
                   t - (1 + s) P
    3N equations   the end of an arc is the entry of the next, after the last comes the first

The derivative of the end of an arc by its entry, at the time at which its guard vanishes, contains
the saltation matrix: the product of these along a chain gives the monodromy matrix, [2, 2]. Behind
a stick phase it has rank one: the time is all that a motion remembers of its start.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import require
from ..model.instants import (
    TimedState,
    Trend,
    carried,
    field_at,
    guards_at,
    guards_trend,
    trend_of,
)
from ..model.modes import capacity, mode_acceleration, mode_of, select, stick_velocity
from ..model.oscillator import (
    RATIOS,
    Oscillator,
    at_time,
    clock_frequency,
    common_turns,
    frequencies,
)
from ..motion.arcs import Ends
from ..numerics.compiling import any_lane, jit, power_of_two
from ..numerics.implicit import Equations, step_to_root
from ..numerics.newton import HOLDS
from ..numerics.polynomials import derivative, polynomial, quintic
from .chains import Chain, Loop, after_each, following_codes
from .shooting import (
    ARC_STEPS,
    FINE,
    arc_by_arc,
    arc_columns,
    arc_step,
    coarse_step,
    densities,
    directions_of,
    end_guard,
    flow,
    jacobian,
    late_at_end,
    over_mesh,
    slip_slopes,
    trace_of,
    with_columns,
)

#: Length of an integration step times the density of steps: at order twelve its error is then no
#: larger than rounding.
TIMED_STRIDE = 0.25
#: The smallest mesh of an arc; coarse steps that sample the density, for each step of the mesh.
LEAST_STEPS, PLACING = 8 * ARC_STEPS, 2
#: A boundary or stick limit that is exceeded by less than this is only touched.
TOUCHES_AGAIN = 1e-8
#: A guard that rises faster than this where it ends an arc has been zero before.
COMES_BACK = 1e-6
#: Newton steps from the extremum of an interpolating quintic to that of the motion.
EXTREMUM_STEPS = 2


class TimedChain(Chain):
    """A chain of whole periods. turns: `common_turns` of the oscillator's frequencies;
    share: fraction of a period at which it begins, in [0, 1); None: at the phase 0."""

    turns: int = eqx.field(static=True, kw_only=True)
    share: Array | None = eqx.field(default=None, kw_only=True)


def turns_of(osc: Oscillator) -> int:
    """`common_turns` of a concrete oscillator; `ValueError` where there is no common period.

    A frequency 0 has no period here: a force declared constant is no wave, so it is the frequency
    of a user's force, or one by which derivatives are taken.
    """
    found = [float(one) for one in lax.stop_gradient(frequencies(osc))]
    rates = [np.float64(one or np.nan) for one in found]
    with np.errstate(all="ignore"):
        turns = round(float(common_turns(rates, np)))
    expected = f"a period in common, of {RATIOS} periods of the slowest at most"
    require(turns > 0, "osc", f"such that all its frequencies have {expected}", found)
    return turns


def forcing_period(osc: Oscillator, turns: int) -> Array:
    """The common period of all forces and belt velocities that depend on time."""
    return 2 * jnp.pi * turns / clock_frequency(osc)


# --- the mesh -------------------------------------------------------------------------------------


def least_steps(osc: Oscillator, loop: Loop) -> int:
    """The size of the mesh that the arcs of a concrete loop need; see `timed_mesh`."""
    counts = _counted_ends(lax.stop_gradient(osc), loop.codes, loop.entries, loop.durations)
    return power_of_two(math.ceil(min(float(jnp.max(counts)), 4096.0)) + 1, LEAST_STEPS)


@jit
def _counted_ends(osc: Oscillator, codes: Array, entries: Array, durations: Array) -> Array:
    """Numbers of steps that the arcs need, [N], by the mean density of steps along them."""

    def one(osc, codes, y, duration):
        def advance(y, _):
            return coarse_step(osc, codes, y, duration / LEAST_STEPS)

        _, rho = lax.scan(advance, y, None, length=LEAST_STEPS)
        mean = jnp.mean(jnp.clip(jnp.nan_to_num(rho, nan=1.0), 1.0, 100.0))
        return jnp.where(mode_of(codes).any_stuck, 0.0, duration * mean / TIMED_STRIDE)

    rows = codes, entries, durations
    return arc_by_arc(one)((osc,), rows)


def timed_mesh(osc: Oscillator, size: int, codes: Array, y: Array, duration: Array) -> Array:
    """Steps as fractions of the duration of a slip arc, [size]: all of them, as a short arc may
    have become long before there are new ones."""
    n = PLACING * size
    slips = ~mode_of(codes).any_stuck & (duration > 0)
    rho = densities(osc, n, codes, y, duration, slips)
    share = jnp.concatenate([jnp.zeros(1), jnp.cumsum(0.5 * (rho[1:] + rho[:-1]))])
    places = jnp.linspace(0, 1, size + 1)
    grid = jnp.interp(places, share / share[-1], jnp.linspace(0, 1, n + 1))
    return jnp.where(slips, jnp.diff(grid), jnp.where(jnp.arange(size) == 0, 1.0, 0.0))


def timed_chain(
    osc: Oscillator, loop: Loop, size: int, turns: int, share: Array | None = None
) -> tuple[TimedChain, Array]:
    """The chain of a loop with its mesh, and the guess of its unknowns, [N, 4]."""
    osc, loop = lax.stop_gradient((osc, loop))
    meshes = arc_by_arc(lambda osc, *row: timed_mesh(osc, size, *row))
    mesh = meshes((osc,), (loop.codes, loop.entries, loop.durations))
    z = jnp.concatenate([loop.entries, loop.durations[:, None]], axis=1)
    chain = TimedChain(loop.codes, loop.ends, mesh, turns=turns, share=share)
    return lax.stop_gradient((chain, z))


_compiled_chain = jit(timed_chain)


def timed_chain_of(
    osc: Oscillator, loop: Loop, turns: int, share: Array | None = None
) -> tuple[TimedChain, Array]:
    """`timed_chain` of a concrete loop, with as many steps as its arcs need."""
    return _compiled_chain(osc, loop, least_steps(osc, loop), turns, share)


# --- equations ------------------------------------------------------------------------------------


def _timed_arc_equations(
    turns: int, osc: Oscillator, share, codes, end, mesh, unknown: Array
) -> Array:
    """(x1, x2, t, guard) at the end of one arc, from its unknowns (x1, x2, t, T).

    An unused arc ends as it begins, and its guard is its duration.
    """
    names = Ends(len(osc.belts))

    def followed(unknown):
        after = flow(osc, codes, mesh, unknown[:3], unknown[3])
        period = forcing_period(osc, turns)
        left = after[2] - period * (1.0 if share is None else 1.0 + share)
        guard = jnp.where(end == names.period, left, end_guard(osc, codes, end, after))
        t = jnp.where(end == names.period, after[2] - period, after[2])
        return jnp.stack([after[0], after[1] + late_at_end(osc, codes, end, after), t, guard])

    return lax.cond(any_lane(end != names.unused), followed, lambda unknown: unknown, unknown)


def _and_columns(turns: int, osc, along, share, codes, end, mesh, unknown: Array):
    """`_timed_arc_equations`, and derivatives by unknowns and k directions `along`, [4, 4 + k]."""

    def equations(osc, u):
        return _timed_arc_equations(turns, osc, share, codes, end, mesh, u)

    return with_columns(equations, osc, along, unknown)


def _by_turns(function: Callable) -> Callable[[int], Callable]:
    """`arc_by_arc` of a function whose first argument is static: the number of turns."""

    @functools.cache
    def of_turns(turns: int) -> Callable:
        return arc_by_arc(functools.partial(function, turns))

    return of_turns


_timed_equations = _by_turns(_timed_arc_equations)
_timed_equations_and_blocks = _by_turns(_and_columns)


def _timed_mismatch(out: Array, z: Array) -> Array:
    exits = out[:, :3] - jnp.roll(z[:, :3], -1, axis=0)
    return jnp.concatenate([exits, out[:, 3:4]], axis=1)


def timed_residual(osc: Oscillator, chain: TimedChain, z: Array) -> Array:
    """The 4N equations at the unknowns z, [N, 4]: mismatch of x1, x2, t, and the guard."""
    rows = arc_columns(chain, z)
    return _timed_mismatch(_timed_equations(chain.turns)((osc, chain.share), rows), z)


def timed_blocks(osc: Oscillator, along: Oscillator | None, chain: TimedChain, z: Array):
    """`timed_residual`, and its derivatives as `shooting.residual_and_blocks` has them."""
    given = osc, along, chain.share
    out, blocks = _timed_equations_and_blocks(chain.turns)(given, arc_columns(chain, z))
    return _timed_mismatch(out, z), blocks


class TimedClosed(Equations):
    """The 4N equations of a chain in the unknowns z, [N, 4], for an oscillator."""

    chain: TimedChain

    def residual(self, given: Oscillator, z: Array) -> Array:
        return timed_residual(given, self.chain, z).reshape(-1)

    def linearized(self, given: Oscillator, z: Array) -> tuple[Array, Array]:
        value, blocks = timed_blocks(given, None, self.chain, z)
        return value.reshape(-1), jacobian(blocks)

    def moved(self, given: Oscillator, z: Array, tangents: Oscillator) -> tuple[Array, Array]:
        along, weights = directions_of(given, tangents)
        _, blocks = timed_blocks(given, along, self.chain, z)
        change = _timed_mismatch(blocks[..., 4:] @ weights, jnp.zeros_like(z))
        return change.reshape(-1), jacobian(blocks[..., :4])


# --- the monodromy matrix -------------------------------------------------------------------------


def _arc_map(turns, osc, share, codes, end, mesh, unknown: Array) -> Array:
    """Derivative of the entry state of the next arc by the entry state of this arc, [3, 3]."""
    _, blocks = _and_columns(turns, osc, None, share, codes, end, mesh, unknown)
    by_entry, by_time = blocks[:, :3], blocks[:, 3]
    return by_entry[:3] - jnp.outer(by_time[:3], by_entry[3] / by_time[3])


_arc_maps = _by_turns(_arc_map)


@_by_turns
def _maps_and_slopes(turns, osc, along, share, codes, end, mesh, unknown: Array):
    """`_arc_map`, and its derivatives by unknowns and k directions `along`, [3, 3, 4 + k]."""

    def arc_map(osc, u):
        return _arc_map(turns, osc, share, codes, end, mesh, u)

    return with_columns(arc_map, osc, along, unknown)


def arc_maps(osc: Oscillator, chain: TimedChain, z: Array) -> Array:
    """`_arc_map` of all arcs, [N, 3, 3]."""
    return _arc_maps(chain.turns)((osc, chain.share), arc_columns(chain, z))


def logs_of_areas(osc: Oscillator, chain: TimedChain, z: Array) -> Array:
    """Logarithms of the factors by which arcs, with the saltation at their ends, change areas of
    states, [N]; they hold for slip arcs only: behind a stick arc no area is left.

    By the divergence of the field (Liouville's formula), so they are exact where the products of
    `arc_maps` have lost the smaller one of two directions in rounding. At a boundary an area
    changes by a ratio: the rate at which the boundary is crossed, after over before.
    """

    def one(osc, codes, end, mesh, after, unknown):
        n = len(osc.belts)
        last = flow(osc, codes, mesh, unknown[:3], unknown[3], trace_of)
        state = last[0], last[1], last[2]

        def distances(*y):
            now = at_time(osc, y[2])
            return jnp.stack([belt.velocity - osc.omega * y[1] for belt in now.belts])

        before, behind = (
            jax.jvp(distances, state, field_at(osc, mode_of(one), state))[1]
            for one in (codes, after)
        )
        at = jnp.arange(n) == end
        ratio = jnp.sum(jnp.where(at, behind, 0.0)) / jnp.sum(jnp.where(at, before, 0.0))
        return last[3] + jnp.log(jnp.abs(jnp.where(end < n, ratio, 1.0)))

    columns = chain.codes, chain.ends, chain.mesh, following_codes(chain), z
    return jnp.where(chain.used, arc_by_arc(one)((osc,), columns), 0.0)


def _product(maps: Array) -> Array:
    def times(total, one):
        return one @ total, None

    return lax.scan(times, jnp.eye(3), maps)[0]


@eqx.filter_custom_jvp
def monodromy(osc: Oscillator, chain: TimedChain, z: Array) -> Array:
    """The derivative of the state at the end of a chain by that at its beginning, [2, 2]."""
    return _product(arc_maps(osc, chain, z))[:2, :2]


@monodromy.def_jvp
def _(primals, tangents):
    # By columns, arc by arc, as in `closure`.
    osc, chain, z = primals
    along, weights = directions_of(osc, tangents[0])
    matrix, by_z, by_osc = monodromy_and_slopes(osc, along, chain, z)
    change = by_osc @ weights
    if tangents[2] is not None:
        change = change + jnp.einsum("ijnk,nk->ij", by_z, tangents[2])
    return matrix, change


def monodromy_and_slopes(
    osc: Oscillator, along: Oscillator, chain: TimedChain, z: Array
) -> tuple[Array, Array, Array]:
    """`monodromy`, and its derivatives by z, [2, 2, N, 4], and along directions, [2, 2, k]."""
    given = osc, along, chain.share
    maps, slopes = _maps_and_slopes(chain.turns)(given, arc_columns(chain, z))

    def times(total, one):
        return one @ total, total

    def times_behind(total, one):
        return total @ one, total

    matrix, before = lax.scan(times, jnp.eye(3), maps)
    _, behind = lax.scan(times_behind, jnp.eye(3), maps, reverse=True)
    moved = jnp.einsum("nij,njkd,nkl->ilnd", behind, slopes, before)[:2, :2]
    return matrix[:2, :2], moved[..., :4], jnp.sum(moved[..., 4:], axis=2)


def multipliers_of(matrix: Array, sticks: Array) -> Array:
    """The eigenvalues of a monodromy matrix, complex, [2], the larger one first. Where the motion
    sticks the second is exactly 0, and the first the trace."""
    trace = matrix[0, 0] + matrix[1, 1]
    det = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    inner = 0.25 * trace**2 - det
    root = jnp.where(inner == 0, 0.0, jnp.sqrt(jnp.where(inner == 0, 1.0, jnp.abs(inner))))
    largest = 0.5 * trace + jnp.where(trace < 0, -1.0, 1.0) * root
    none = largest == 0
    smallest = jnp.where(none, 0.0, det / jnp.where(none, 1.0, largest))
    zero = jnp.zeros(())
    real = jnp.stack([largest, smallest]), jnp.stack([zero, zero])
    pair = jnp.stack([0.5 * trace, 0.5 * trace]), jnp.stack([root, -root])
    stuck = jnp.stack([trace, zero]), jnp.stack([zero, zero])
    parts = select(sticks, stuck, select(inner >= 0, real, pair))
    return lax.complex(*parts)


# --- along the arcs -------------------------------------------------------------------------------


def states_at_phase(osc: Oscillator, chain: TimedChain, z: Array, phase: Array) -> Array:
    """States (x1, x2) of all arcs at a phase, a fraction of a period, [N, 2]; NaN for arcs that do
    not pass it, so that one row per period is finite."""
    begins = 0.0 if chain.share is None else chain.share
    t = forcing_period(osc, chain.turns) * jnp.where(phase < begins, phase + 1, phase)

    def one(osc, t, codes, is_first, is_last, mesh, unknown, following):
        # Where a period begins t is exact only up to rounding, so it is not compared there.
        passes = (is_first | (unknown[2] <= t)) & (is_last | (following > t))
        since = jnp.where(passes, t - unknown[2], 0.0)
        state = flow(osc, codes, mesh, unknown[:3], since)[:2]
        return jnp.where(passes, state, jnp.nan)

    is_last = chain.ends == Ends(len(osc.belts)).period
    is_first = jnp.roll(is_last, 1).at[0].set(True)
    columns = chain.codes, is_first, is_last, chain.mesh, z, after_each(chain, z[:, 2])
    found = arc_by_arc(one)((osc, t), columns)
    return jnp.where(chain.used[:, None], found, jnp.nan)


def _steps_along(codes: Array, mesh: Array) -> Array:
    """Steps along an arc as fractions of its duration; a stick arc is cut into equal ones."""
    return jnp.where(mode_of(codes).any_stuck, jnp.full_like(mesh, 1 / mesh.size), mesh)


def _after(osc: Oscillator, codes: Array, y: Array, h: Array) -> Array:
    """The state of an arc a time h after y."""
    mode = mode_of(codes)
    slipped = arc_step(functools.partial(slip_slopes, osc, codes), y, h, FINE)
    held = jnp.stack(carried(osc, mode, (y[0], y[1], y[2]), h))
    return jnp.where(mode.any_stuck, held, slipped)


@jit
def guards_along(osc: Oscillator, chain: TimedChain, z: Array) -> tuple[Array, Array, Array]:
    """States of all arcs at the ends of steps, [N, steps + 1, 3], and there the guards of the arcs'
    modes and their time derivatives, [N, steps + 1, guards] each."""

    def one(osc, codes, mesh, unknown):
        mode = mode_of(codes)

        def at(y):
            found = guards_trend(osc, mode, y)
            return found.value, found.slope

        y, duration = unknown[:3], unknown[3]
        steps = _steps_along(codes, mesh)

        def advance(y, fraction):
            return _after(osc, codes, y, duration * fraction)

        _, states = over_mesh(advance, y, steps, seen=lambda y: y)
        states = jnp.concatenate([y[None], states])
        return states, *jax.vmap(at)(states)

    return arc_by_arc(one)((osc,), (chain.codes, chain.mesh, z))


class Least(NamedTuple):
    """Least values of functions along an arc, and for the step in which each occurs: the state
    before it, [functions, 3], its length, and the place in it as a fraction, [functions]."""

    value: Array
    before: Array
    h: Array
    at: Array


def _least_along(
    osc: Oscillator,
    codes: Array,
    mesh: Array,
    y: Array,
    duration: Array,
    function: Callable[[Oscillator, TimedState], Array],
) -> Least:
    """The least values along an arc of functions of the oscillator and the state.

    Only the states before steps, and the steps' lengths, are differentiable.
    """
    mode, known = mode_of(codes), lax.stop_gradient(osc)

    def trend(y):
        now = lax.stop_gradient((y[0], y[1], y[2]))
        found = trend_of(known, mode, functools.partial(function, known), now)
        there = jnp.isfinite(found.value)
        return there, Trend(*(jnp.where(there, one, 0.0) for one in found))

    def advance(carry, fraction):
        y, (there, before), least = carry
        h = duration * fraction
        new = _after(osc, codes, y, h)
        after = trend(new)
        value, at = _least_between(before, after[1], lax.stop_gradient(h))
        value = jnp.where(there, value, jnp.inf)
        better = value < least.value
        least = Least(
            jnp.where(better, value, least.value),
            jnp.where(better[:, None], y[None], least.before),
            jnp.where(better, h, least.h),
            jnp.where(better, at, least.at),
        )
        return new, after, least

    begun = trend(y)
    count = begun[1].value.size
    zeros = jnp.zeros(count)
    none = Least(jnp.full(count, jnp.inf), jnp.stack([y] * count), zeros, zeros)
    (_, _, least), _ = over_mesh(advance, (y, begun, none), _steps_along(codes, mesh))
    return least


def _least_between(before: Trend, after: Trend, h: Array) -> tuple[Array, Array]:
    """Least values of functions in a step of length h, and their places as fractions of the step.

    Each function is the quintic with the values, slopes and curvatures of `before` and `after`.
    """
    start, end = ((one.value, one.slope * h, one.curvature * h**2) for one in (before, after))
    between = quintic(start, end)
    slopes = derivative(between)
    bends = derivative(slopes)
    places = jnp.linspace(0.0, 1.0, 9)
    values = jnp.stack([polynomial(between, s) for s in places])
    s = places[jnp.argmin(values, axis=0)]
    for _ in range(4):
        first, second = polynomial(slopes, s), polynomial(bends, s)
        s = jnp.clip(s + step_to_root(first, second, where=second > 0), 0.0, 1.0)
    return jnp.minimum(jnp.min(values, axis=0), polynomial(between, s)), s


def least_guard(osc: Oscillator, codes: Array, mesh: Array, y: Array, duration: Array) -> Array:
    """The least value of all guards of an arc's mode along the arc, up to rounding."""

    def guards(osc, y):
        return guards_at(osc, mode_of(codes), y)

    return jnp.min(_least_along(osc, codes, mesh, y, duration, guards).value)


#: Weights of (x1, x2) whose sums are least at the smallest and largest x1, and x2.
_SIDES = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def extrema_along(osc: Oscillator, chain: TimedChain, z: Array) -> Array:
    """The smallest and the largest x1, then x2, along a solution of the equations, [4].

    Differentiable by the oscillator and the unknowns, twice.
    """

    def sides(osc, y):
        return jnp.stack([y[0], -y[0], y[1], -y[1]])

    def one(osc, codes, mesh, unknown):
        least = _least_along(osc, codes, mesh, unknown[:3], unknown[3], sides)
        polished = functools.partial(_polished_least, osc, codes)
        return jax.vmap(polished)(_SIDES, least.before, least.h, least.at)

    least = jnp.min(arc_by_arc(one)((osc,), (chain.codes, chain.mesh, z)), axis=0)
    return least * np.sum(_SIDES, axis=1)


def _polished_least(
    osc: Oscillator, codes: Array, weight: Array | np.ndarray, before: Array, h: Array, s: Array
) -> Array:
    """The least value of weight . (x1, x2) near the fraction s of a step of length h."""
    mode = mode_of(codes)

    def state(s):
        return _after(osc, codes, before, s * h)

    def function(y):
        return weight[0] * y[0] + weight[1] * y[1]

    for _ in range(EXTREMUM_STEPS):
        s = lax.stop_gradient(s)
        y = state(s)
        found = trend_of(osc, mode, function, (y[0], y[1], y[2]))
        bends = (found.curvature > 0) & (h > 0)
        new = s + step_to_root(found.slope, found.curvature * h, where=bends)
        # At the end of an arc a coordinate may have a kink, and its extremum there.
        s = jnp.where(bends & (s > 0) & (s < 1) & (new > 0) & (new < 1), new, s)
    return function(state(s))


def guard_slope(osc: Oscillator, codes: Array, end: Array, y: Array) -> Array:
    """Time derivative of the guard that ends an arc, at y; 0 for arcs that end otherwise."""
    mode, names = mode_of(codes), Ends(len(osc.belts))
    at = guards_trend(osc, mode, y)
    count = at.value.size - 2
    limit = count + jnp.argmin(at.value[count:])
    place = jnp.where(end == names.onset, limit, jnp.clip(end, 0, count - 1))
    slope = jnp.nan_to_num(at.slope[place], nan=0.0)
    return jnp.where((end < count) | (end == names.onset), slope, 0.0)


def timed_admissible(osc: Oscillator, chain: TimedChain, z: Array) -> Array:
    """Whether the oscillator moves along a solution of the equations: no arc leaves its mode before
    its end, or re-enters it there, none crosses a boundary where the mass would stick, and x2 is
    the belt's velocity where a stick phase begins, or where a period begins within one."""
    n = len(osc.belts)

    def one(osc, codes, mesh, end, after, unknown):
        y, duration = unknown[:3], unknown[3]
        speed = osc.omega * y[1]
        belt = stick_velocity(at_time(osc, y[2]), mode_of(codes), speed)
        on_belt = jnp.abs(belt - speed) <= TOUCHES_AGAIN * (1 + jnp.abs(belt))
        end_state = flow(osc, codes, mesh, y, duration)
        now = at_time(osc, end_state[2])
        flips = codes * after == -1
        held = mode_of(jnp.where(flips, 0.0, after))
        needed = jnp.abs(mode_acceleration(now, held, end_state[0], end_state[1]))
        crosses = (end < n) & ~jnp.any(after == 0) & jnp.any(flips)
        would_stick = crosses & (needed < capacity(now, held) - TOUCHES_AGAIN)
        least = least_guard(osc, codes, mesh, y, duration)
        late = guard_slope(osc, codes, end, end_state) > COMES_BACK
        stays = on_belt & (duration >= -HOLDS) & (least >= -TOUCHES_AGAIN)
        return stays & ~late & ~would_stick

    columns = chain.codes, chain.mesh, chain.ends, following_codes(chain), z
    each = arc_by_arc(one)((osc,), columns)
    return jnp.all(each | ~chain.used)
