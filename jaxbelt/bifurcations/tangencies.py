"""Cycles tangent to the boundary of a belt."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..cycles.cycle import (
    Chain,
    Cycle,
    Ends,
    Loop,
    Orbit,
    last_loop,
    loop_of,
    meshed,
)
from ..model.modes import (
    STUCK,
)
from ..model.oscillator import Oscillator
from ..numerics.compiling import jit
from ..results import Status
from .conditions import BeltCondition, solved_point
from .guesses import HINT_BUDGET, least_push, orbit_after_stick
from .systems import Encounter, velocity_of


class NonsmoothFold(BeltCondition):
    """The stick phase on a belt shrinks to a point and the cycle vanishes with an unstable one."""


class GrazingSliding(BeltCondition):
    """The cycle touches the boundary of a belt and begins to stick to it there, but goes on."""


def at_tangency(osc: Oscillator, index: int | Array, belts: Array, wanted: Array, size: int):
    """A cycle tangent to the boundary of the first belt.

    wanted: 1 a fold, -1 grazing, 0 either; its multiplier tells which it is.
    """
    _, _, orbit = orbit_after_stick(osc, belts)
    return solved_point(osc, index, *_touching(osc, orbit, belts, wanted, size))


@jit
def _touching(osc: Oscillator, orbit: Orbit, belts: Array, wanted: Array, size: int):
    """The system of `at_tangency` with a guess of its unknowns, a status, and the judge."""
    belt = belts[0]
    n = len(osc.belts)
    names = Ends(n)
    still = lax.stop_gradient(osc)
    velocity = velocity_of(still, belt)
    repeated = orbit.status == Status.OK

    # Either a cycle was found, or the orbit left the boundary for good: then its first loop from
    # slip onset to the next extremum of x2 on that side, closed there, is nearly the cycle.
    exits = jnp.roll(orbit.entries, -1, axis=0).at[orbit.count - 1].set(orbit.y)
    rows = jnp.arange(HINT_BUDGET)
    near = (orbit.ends == names.extremum_x2) & (exits[:, 1] * jnp.sign(velocity) > 0) & (rows > 0)
    last = jnp.argmax(near)
    first_loop = eqx.tree_at(lambda o: (o.repeats, o.count), orbit, (jnp.asarray(0), last + 1))
    returns = jnp.any(near) & ~jnp.any(
        (rows > 0) & (rows <= last) & jnp.any(orbit.codes == 0, axis=-1)
    )
    orbit = jax.tree.map(lambda a, b: jnp.where(repeated, a, b), orbit, first_loop)
    _, count = last_loop(orbit)
    status = jnp.where(repeated | returns, Status.OK.value, Status.NOT_TOUCHED.value)
    # It may need one arc more.
    status = jnp.where((status == Status.OK) & (count >= size), Status.TOO_MANY_ARCS.value, status)
    return _tangent(still, belts, wanted, loop_of(orbit, size, n), status)


def tangency_near(osc: Oscillator, index: int | Array, belts: Array, loop: Loop, status: Array):
    """The cycle near a loop that is tangent to the boundary of a belt; status: of the loop."""
    return solved_point(osc, index, *_tangent_cycle(osc, belts, loop, status))


@jit
def _tangent_cycle(osc: Oscillator, belts: Array, loop: Loop, status: Array):
    fits = jnp.sum(loop.used) < loop.ends.size
    status = jnp.where(fits | (status != Status.OK), status, Status.TOO_MANY_ARCS.value)
    return _tangent(lax.stop_gradient(osc), belts, jnp.zeros(()), loop, status)


def _tangent(osc: Oscillator, belts: Array, wanted: Array, loop: Loop, status: Array):
    """The system of a tangency with a guess of its unknowns, a status, and the judge."""
    belt = belts[0]
    loop, row, found = _with_stick(osc, loop, belt)
    chain, z = meshed(osc, loop)
    status = jnp.where(found | (status != Status.OK), status, Status.NOT_TOUCHED.value)
    status = jnp.where(velocity_of(osc, belt) == 0, Status.STUCK_FOREVER.value, status)
    # The arc before the stick arc is the one that becomes tangent.
    before = (row - 1) % jnp.maximum(jnp.sum(chain.used), 1)
    ends = chain.ends.at[before].set(Ends(len(osc.belts)).tangent + belt)
    system = Encounter(Chain(chain.codes, ends, chain.mesh), jnp.stack([belt, belt]))
    return system, z, status, eqx.Partial(judge_encounter, belts, wanted, row)


def judge_encounter(belts, wanted, row, osc: Oscillator, z, cycle: Cycle, slope):
    """Status and multiplier of what an `Encounter` ends in."""
    belt, other = belts[0], belts[1]
    exchange, chain = belt != other, cycle.chain
    stuck = jnp.any(chain.codes == 0, axis=-1) & chain.used
    phase = stick_phase_from(osc, chain, row)
    slope = jnp.where(z[row, 2] > 1e-6, jnp.inf, slope)  # a square root of rounding is no phase
    slope = jnp.where(jnp.any(stuck & ~phase), 0.0, slope)
    # A tangency is of one kind.
    is_wanted = (wanted == 0) | (wanted * (slope - 1) >= 0)  # the slope may be infinite
    fits = exchange | is_wanted
    slope = jnp.where(exchange, jnp.nan, slope)
    other_kind = (cycle.status == Status.OK) & ~fits
    return jnp.where(other_kind, Status.OTHER_KIND.value, cycle.status), slope


def stick_phase_from(osc: Oscillator, chain: Chain, row: Array) -> Array:
    """A row, and the arcs after it in the stick phase that it begins: one that passes edges."""
    stuck = chain.used & jnp.any(chain.codes == 0, axis=-1)
    rows = jnp.arange(stuck.size)
    before = (rows - 1) % jnp.maximum(jnp.sum(chain.used), 1)
    phase, goes_on = rows == row, stuck & stuck[before]
    for _ in range(2 * len(osc.belts)):
        phase = phase | (goes_on & phase[before])
    return phase


def _with_stick(osc: Oscillator, loop: Loop, belt: Array) -> tuple[Loop, Array, Array]:
    """A loop with a stick arc on the belt, its row, whether there is one.

    Its own that begins most nearly by a tangency, or one of duration zero where x2 comes closest to
    the boundary from inside.
    """
    velocity = velocity_of(osc, belt)
    rows = jnp.arange(loop.ends.size)
    names = Ends(len(osc.belts))
    arrival, push = least_push(osc, loop, belt)
    has_own = jnp.isfinite(push)
    own = (arrival + 1) % jnp.maximum(jnp.sum(loop.used), 1)

    following = loop.exits
    loops = loop.used & (loop.ends == names.extremum_x2)
    loops = loops & (loop.codes[:, belt] == jnp.sign(velocity))
    loops = loops & (following[:, 1] * jnp.sign(velocity) > 0)
    distance = jnp.abs(velocity - osc.omega * following[:, 1])
    at = jnp.argmin(jnp.where(loops, distance, jnp.inf))

    def inserted(array, new):
        shifted = jnp.roll(array, 1, axis=0)
        after = (rows > at + 1).reshape(-1, *[1] * (array.ndim - 1))
        return jnp.where(after, shifted, array).at[at + 1].set(new)

    # Where all rows are in use the last one is shifted out; the caller knows.
    new = Loop(
        codes=inserted(loop.codes, loop.codes[at].at[belt].set(STUCK)),
        ends=inserted(loop.ends.at[at].set(belt), jnp.asarray(names.onset)),
        entries=inserted(loop.entries, jnp.stack([following[at, 0], velocity / osc.omega])),
        durations=inserted(loop.durations, jnp.zeros(())),
    )
    loop = jax.tree.map(lambda a, b: jnp.where(has_own, a, b), loop, new)
    return loop, jnp.where(has_own, own, at + 1), has_own | jnp.any(loops)
