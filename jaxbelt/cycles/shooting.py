"""Shooting with a fixed signature: a closed chain of arcs as a square system of equations.

To compute a cycle only the mode of every arc has to be known, and the event that ends it: the
numbers follow without any event detection (fixed-signature multiple shooting). An arc ends at a
boundary r_k = 0, at a contact edge, at slip onset, or at an extremum, x2' = 0 or x2 = 0. The
extrema make x1 and x2 monotone on every arc, so all extrema of a cycle are ends of arcs. For N arcs
there are

    3N unknowns    entry state (x1, x2) and duration T of every arc
     N equations   the guard of the arc's end vanishes at its end
    2N equations   the end of an arc is the entry of the next, after the last comes the first

The number N is padded to a few fixed sizes and modes are data, so that one compiled program serves
all signatures. Slip arcs are integrated by a fixed number of steps of a scheme of order twelve,
spread over the arc so that they are short where the friction law bends; all arcs at once, each step
smooth in everything. An arc that magnifies is followed backwards, see `solve_closed`. Derivatives
of a solution come from the implicit function theorem and work in forward and reverse mode and under
`jax.vmap`.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..model.instants import carried, field_at
from ..model.modes import (
    Mode,
    capacity,
    has_edges,
    mode_acceleration,
    mode_of,
    stick_velocity,
)
from ..model.oscillator import Oscillator, at_time, has_clock
from ..model.transitions import edge_of_guard, late_contacts, onset_position
from ..motion.arcs import Ends
from ..motion.integrators import density
from ..numerics.compiling import any_lane, lanes_in_one_kernel, one_kernel, one_kernel_alone
from ..numerics.derivatives import moving_and_fixed
from ..numerics.extrapolation import Scheme, increments, scheme
from ..numerics.implicit import Equations, solution
from ..numerics.newton import solve
from .chains import Chain, Loop

#: Integration steps per slip arc (an arc is about a quarter of a loop at most).
ARC_STEPS = 8
#: Meshes of more than EVEN_STEPS steps are placed by a march of at most MESH_MARCH steps, each
#: MESH_STRIDE over the `density`; others by even steps, some of which may jump a thin layer.
EVEN_STEPS, MESH_STRIDE, MESH_MARCH = 32, 0.3, 20_000
#: An arc magnifies if the state moves this many times faster at its end than at its entry.
MAGNIFIED = 1e4


# Of order 12 for the arcs, of order 4 for placing the steps.
FINE = scheme((2, 4, 6, 8, 10, 12))
_COARSE = scheme((2, 4))


def arc_by_arc(function: Callable) -> Callable:
    """Maps function(*shared, *row) over the arcs of a chain; returns call(shared, columns), whose
    arguments are tuples. All arcs are one piece of machine code; in a batch, and where there are
    too many arcs, each arc is one piece, for all lanes."""
    of_lanes = lanes_in_one_kernel(one_kernel(function))

    @functools.wraps(function)
    @one_kernel_alone
    def call(shared, columns):
        return lax.map(lambda row: of_lanes(*shared, *row), columns)

    return call


def arc_step(field: Callable[[Array], Array], y: Array, h: Array, scheme: Scheme) -> Array:
    """One step of size h, for states in one array."""

    def apart(state):
        slopes = field(jnp.stack(state))
        return tuple(slopes[i] for i in range(y.size))

    (change,) = increments(apart, tuple(y[i] for i in range(y.size)), h, scheme)
    return y + jnp.stack(change)


def slip_slopes(osc: Oscillator, codes: Array, y: Array) -> Array:
    """The field of a slip mode at a state, in one array."""
    if has_clock(osc):
        return jnp.stack(field_at(osc, mode_of(codes), (y[0], y[1], y[2])))
    return jnp.stack([y[1], mode_acceleration(osc, mode_of(codes), y[0], y[1])])


def meshed(osc: Oscillator, loop: Loop, steps: int = ARC_STEPS) -> tuple[Chain, Array]:
    """The chain of a loop with its mesh, and the guess of its unknowns."""
    stuck = jnp.any(loop.codes == 0, axis=-1)
    slip = jnp.where(stuck, 0.0, loop.durations)
    mesh = _meshes(steps)(osc, (loop.codes, loop.entries, slip))
    z = jnp.concatenate([loop.entries, loop.durations[:, None]], axis=1)
    return lax.stop_gradient((Chain(loop.codes, loop.ends, mesh), z))


@functools.cache
def _meshes(steps: int) -> Callable:
    """`_mesh` of all arcs. Not by `arc_by_arc`: in a batch a whole march is too large for one piece
    of machine code, so each step of the march is a piece."""

    @one_kernel_alone
    def call(osc, columns):
        return lax.map(lambda row: _mesh(osc, steps, *row), columns)

    return call


def _mesh(osc: Oscillator, steps: int, codes: Array, y: Array, duration: Array) -> Array:
    """Steps as fractions of the duration, [steps], each with about the same share of the
    density."""
    if steps > EVEN_STEPS:
        return _marched_mesh(osc, steps, codes, y, duration)
    n = 24
    # Stick phases, and the padding of a chain, take no steps.
    rho = densities(osc, n, codes, y, duration, duration != 0)
    share = jnp.concatenate([jnp.zeros(1), jnp.cumsum(rho[1:] + rho[:-1])])
    grid = jnp.interp(
        jnp.linspace(0.0, 1.0, steps + 1), share / share[-1], jnp.linspace(0, 1, n + 1)
    )
    return jnp.diff(grid)


def densities(
    osc: Oscillator, n: int, codes: Array, y: Array, duration: Array, slips: Array
) -> Array:
    """The density of steps at the ends of n coarse steps along an arc that slips, [n + 1].

    It is clipped, so that a poor guess only makes the mesh less good.
    """

    def march():
        def advance(y, _):
            return coarse_step(osc, codes, y, duration / n)

        return lax.scan(advance, y, None, length=n)[1]

    rest = lax.cond(any_lane(slips), march, lambda: jnp.ones(n))
    rho = jnp.concatenate([density(osc, mode_of(codes), *y)[None], rest])
    return jnp.clip(jnp.nan_to_num(rho, nan=1.0), 1.0, 100.0)


def _marched_mesh(osc: Oscillator, steps: int, codes: Array, y: Array, duration: Array) -> Array:
    """`_mesh` by a march along the arc, whose steps follow the density."""
    even = jnp.linspace(0.0, 1.0, steps + 1)

    def march(total):
        """The integral of the density over the arc, and the times of even fractions of `total`."""

        def unfinished(carry):
            number, _, _, left, _, _ = carry
            return (number < MESH_MARCH) & any_lane(left > 0)

        def advance(carry):
            number, y, rho, left, share, grid = carry
            # The last step within MESH_MARCH goes to the end of the arc.
            wanted = jnp.where(number < MESH_MARCH - 1, MESH_STRIDE / rho, left)
            h = jnp.minimum(wanted, left)
            y, after = coarse_step(osc, codes, y, h)
            after = jnp.maximum(jnp.nan_to_num(after, nan=1.0), 1.0)
            more, passed = 0.5 * h * (rho + after), duration - left
            behind = even * total - share
            inside = (behind >= 0) & (behind <= more)
            grid = jnp.where(inside, passed + h * behind / jnp.where(more > 0, more, 1.0), grid)
            return number + 1, y, after, left - h, share + more, grid

        at = jnp.maximum(density(osc, mode_of(codes), *y), 1.0)
        start = jnp.asarray(0), y, at, duration, jnp.zeros(()), jnp.zeros(steps + 1)
        *_, share, grid = lax.while_loop(unfinished, advance, start)
        return share, grid

    # Stick phases, and the padding of a chain, take no steps. First march: the total density.
    _, grid = march(march(jnp.ones(()))[0])
    grid = grid.at[-1].set(duration) / jnp.where(duration == 0, 1.0, duration)
    return jnp.diff(jnp.where(duration == 0, even, grid))


@lanes_in_one_kernel
def coarse_step(osc: Oscillator, codes: Array, y: Array, h: Array) -> tuple[Array, Array]:
    """The state after a step of length h, and the density of steps that is needed there."""
    y = arc_step(functools.partial(slip_slopes, osc, codes), y, h, _COARSE)
    return y, density(osc, mode_of(codes), *y)


def over_mesh(
    advance: Callable[[Any, Array], Any],
    state: Any,
    mesh: Array,
    seen: Callable[[Any], Any] = lambda state: None,
) -> tuple[Any, Any]:
    """The last state of advance(state, fraction), applied to each step of a mesh, [steps]; and
    seen(state) after each step, [steps, ...].

    Padding of a long mesh, steps of length zero at its end, is skipped.
    """

    def step(state, fraction):
        new = advance(state, fraction)
        return new, seen(new)

    def some_steps(state, fractions):
        def as_it_is():
            rows = len(fractions)
            return state, jax.tree.map(lambda x: jnp.stack([x] * rows), seen(state))

        some = any_lane(jnp.any(fractions > 0))
        return lax.cond(some, lambda: lax.scan(step, state, fractions), as_it_is)

    if mesh.size > ARC_STEPS and mesh.size % ARC_STEPS == 0:
        state, rows = lax.scan(some_steps, state, mesh.reshape(-1, ARC_STEPS))
        return state, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
    return lax.scan(step, state, mesh)


def flow(osc: Oscillator, codes: Array, mesh: Array, y: Array, duration: Array, extra=None):
    """End of one arc, (x1, x2), and the integrals of `extra(osc, mode, x1, x2)`, a vector, over it.

    A stick arc is a straight line; Simpson's rule is exact there for integrands that are at most
    cubic. With a clock states are (x1, x2, t), and the integrals over stick arcs are given as 0.
    """
    mode = mode_of(codes)
    stuck = mode.any_stuck

    def rates(state):
        now = at_time(osc, state[2]) if has_clock(osc) else osc
        return jnp.zeros(0) if extra is None else extra(now, mode, state[0], state[1])

    def field(state):
        smooth = slip_slopes(osc, codes, state[: y.size])
        return smooth if extra is None else jnp.concatenate([smooth, rates(state)])

    n_extra = rates(y).size

    start = jnp.concatenate([y, jnp.zeros(n_extra)])
    slip_time = jnp.where(stuck, 0.0, duration)

    def advance(state, fraction):
        return arc_step(field, state, slip_time * fraction, FINE)

    slipped, _ = over_mesh(advance, start, mesh)
    if has_clock(osc):
        stuck_end = jnp.stack(carried(osc, mode, (y[0], y[1], y[2]), duration))
        return jnp.where(stuck, jnp.append(stuck_end, jnp.zeros(n_extra)), slipped)
    v = stick_velocity(osc, mode, jnp.zeros(())) / osc.omega
    stuck_end = jnp.stack([y[0] + v * duration, v])
    if extra is not None:
        values = [
            weight * extra(osc, mode, y[0] + fraction * v * duration, v)
            for fraction, weight in ((0.0, 1 / 6), (0.5, 4 / 6), (1.0, 1 / 6))
        ]
        stuck_end = jnp.concatenate([stuck_end, duration * (values[0] + values[1] + values[2])])
    return jnp.where(stuck, stuck_end, slipped)


def end_guard(osc: Oscillator, codes: Array, end: Array, y: Array) -> Array:
    """The guard that vanishes at y if an arc ends there by `end`; zero for an unused arc."""
    if has_clock(osc):
        return _timed_end_guard(osc, codes, end, y)
    mode = mode_of(codes)
    values = [
        *[belt.velocity - osc.omega * y[1] for belt in osc.belts],
        *[y[0] - edge_of_guard(osc, mode, end)] * (2 * len(osc.belts)),
        mode_acceleration(osc, mode, y[0], y[1]),
        y[1],
        y[0] - onset_position(osc, mode),
    ]
    return sum((jnp.where(end == i, value, 0.0) for i, value in enumerate(values)), jnp.zeros(()))


def _timed_end_guard(osc: Oscillator, codes: Array, end: Array, y: Array) -> Array:
    """`end_guard` with a clock, except for the end of a period."""
    mode, state = mode_of(codes), (y[0], y[1], y[2])

    def guards(*y):
        now = at_time(osc, y[2])
        limit = jnp.abs(mode_acceleration(now, mode, y[0], y[1])) - capacity(now, mode)
        return jnp.stack([*(belt.velocity - osc.omega * y[1] for belt in now.belts), limit])

    values, slopes = jax.jvp(guards, state, field_at(osc, mode, state))
    n, names = len(osc.belts), Ends(len(osc.belts))
    numbers = [
        *((i, values[i]) for i in range(n)),
        *((n + i, y[0] - edge_of_guard(osc, mode, end)) for i in range(2 * n)),
        (names.extremum_x1, y[1]),
        (names.onset, values[n]),
        *((names.tangent + i, slopes[i]) for i in range(n)),
        (names.nearest_limit, slopes[n]),
    ]
    return sum((jnp.where(end == i, value, 0.0) for i, value in numbers), jnp.zeros(()))


def late_at_end(osc: Oscillator, codes: Array, end: Array, y: Array) -> Array:
    """`late_contacts` at the end y of an arc, 0 where it does not end at a contact edge."""
    mode, n = mode_of(codes), len(osc.belts)
    if not has_edges(osc):
        return jnp.zeros(())
    now = at_time(osc, y[2]) if has_clock(osc) else osc
    late = late_contacts(now, mode, edge_of_guard(osc, mode, end), y[1], y[1] > 0)
    return jnp.where((end >= n) & (end < 3 * n), late, 0.0)


def trace_of(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> Array:
    """Divergence of the field of a slip mode, d(x2')/d(x2), as a vector of one."""
    _, slope = jax.jvp(lambda v: mode_acceleration(osc, mode, x1, v), (x2,), (jnp.ones_like(x2),))
    return slope[None]


def magnifies(osc: Oscillator, codes: Array, entry: Array, exit_: Array) -> Array:
    """Whether an arc leads away from a place where the orbit lingers and hardly moves.

    An example is a mass that leaves a slow belt: the end of the arc is lost in the rounding of its
    entry, magnified by the ratio of the two speeds in the phase plane. Backwards the magnification
    is that ratio over the growth of areas, so arcs are followed backwards where areas grow.
    """
    osc, entry, exit_ = lax.stop_gradient((osc, entry, exit_))
    mode = mode_of(codes)
    slow, fast = (jnp.max(jnp.abs(slip_slopes(osc, codes, y))) for y in (entry, exit_))
    grows = trace_of(osc, mode, entry[0], entry[1])[0] > 0
    return ~mode.any_stuck & grows & (fast > MAGNIFIED * slow)


def _magnifying(osc: Oscillator, chain: Chain, z: Array) -> Array:
    """Mask [N] of the arcs that magnify an error at their entry; see `magnifies`."""
    exits = jnp.roll(z[:, :2], -1, axis=0)
    return jax.vmap(functools.partial(magnifies, osc))(chain.codes, z[:, :2], exits)


def _arc_equations(osc: Oscillator, codes, end, mesh, backwards, unknown: Array) -> Array:
    """(x1, x2, guard, 0) at the end of one arc, from its unknowns (x1, x2, T).

    backwards: the unknown (x1, x2) is the state in which the arc ends, and the first two numbers
    are its entry. An unused arc ends as it begins, and its guard is its duration. An arc that has
    to end tangent to the boundary of a belt ends at the point of the boundary with x2' = 0. Trial
    arcs that run past that point meet the pole of the friction law, so this arc is followed
    backwards from the point to its entry: the first two numbers are the point, the last two the
    errors in the entry's x1 and x2. That is one more equation, a condition on the oscillator.
    """
    is_unused = end == Ends(len(osc.belts)).unused

    def nothing(unknown):
        return jnp.append(unknown, 0.0)

    def followed(unknown):
        out = _followed(osc, codes, end, mesh, backwards, unknown)
        return jnp.where(is_unused, nothing(unknown), out)

    return lax.cond(any_lane(~is_unused), followed, nothing, unknown)


def _followed(osc: Oscillator, codes, end, mesh, backwards, unknown: Array) -> Array:
    """`_arc_equations` of a used arc."""
    names = Ends(len(osc.belts))
    is_tangent = end >= names.tangent
    velocity = jnp.zeros(())
    for i, belt in enumerate(osc.belts):
        velocity = velocity + jnp.where(end == names.tangent + i, belt.velocity / osc.omega, 0.0)
    x1 = mode_acceleration(osc, mode_of(codes), jnp.zeros(()), velocity)
    point = jnp.stack([x1, velocity])
    late = late_at_end(osc, codes, end, unknown[:2])
    start = jnp.stack([unknown[0], unknown[1] - jnp.where(backwards, late, 0.0)])
    start = jnp.where(is_tangent, point, start)
    back = is_tangent | backwards
    duration = jnp.where(back, -unknown[2], unknown[2])
    after = flow(osc, codes, jnp.where(back, jnp.flip(mesh), mesh), start, duration)
    guard = end_guard(osc, codes, end, jnp.where(backwards, unknown[:2], after))
    late = jnp.where(backwards, 0.0, late_at_end(osc, codes, end, after))
    after = jnp.stack([after[0], after[1] + late])
    ordinary = jnp.concatenate([after, guard[None], jnp.zeros(1)])
    return jnp.where(is_tangent, jnp.concatenate([point, after - unknown[:2]]), ordinary)


_all_arc_equations = arc_by_arc(_arc_equations)


@arc_by_arc
def _equations_and_blocks(
    osc: Oscillator, along: Oscillator | None, codes, end, mesh, backwards, unknown: Array
):
    """`_arc_equations`, [4], and their derivatives, [4, 3 + k]."""

    def equations(osc, u):
        return _arc_equations(osc, codes, end, mesh, backwards, u)

    return with_columns(equations, osc, along, unknown)


def with_columns(
    function: Callable[[Oscillator, Array], Array],
    osc: Oscillator,
    along: Oscillator | None,
    unknowns: Array,
) -> tuple[Array, Array]:
    """A function of an oscillator and n unknowns, and its derivatives, in a last axis of n + k.

    They are taken by the unknowns, and along the k directions `along` in the space of oscillators
    (an oscillator of arrays [k, ..]; None: no directions).
    """
    n, more = unknowns.size, 0 if along is None else jax.tree.leaves(along)[0].size

    def column(direction):
        if along is None:
            return jax.jvp(functools.partial(function, osc), (unknowns,), (direction,))
        moved = jax.tree.map(functools.partial(_weighted, direction[n:]), along)
        return jax.jvp(function, (osc, unknowns), (moved, direction[:n]))

    return jax.vmap(column, out_axes=(None, -1))(jnp.eye(n + more))


def _weighted(weights: Array, slopes: Array) -> Array:
    """The sum of the slopes, [k, ..], each times its weight."""
    return jnp.sum(weights.reshape(-1, *[1] * (slopes.ndim - 1)) * slopes, axis=0)


def directions_of(osc: Oscillator, tangents: Oscillator) -> tuple[Oscillator, Array]:
    """A unit direction for each of the k numbers of the oscillator that have a tangent, as an
    oscillator of arrays [k, ..], and these tangents, [k]."""
    moving, fixed = moving_and_fixed(osc, tangents)
    numbers, unravel = jax.flatten_util.ravel_pytree(moving)
    steady = jax.tree.map(jnp.zeros_like, fixed)
    units = [eqx.combine(unravel(unit), steady) for unit in jnp.eye(numbers.size)]
    none = jax.tree.map(lambda leaf: jnp.zeros((0, *jnp.shape(leaf))), osc)
    along = jax.tree.map(lambda *leaves: jnp.stack(leaves), *units) if units else none
    return along, jax.flatten_util.ravel_pytree(tangents)[0]


def arc_columns(chain: Chain, *others: Array) -> tuple[Array, ...]:
    """The columns of a chain, and others, as functions made by `arc_by_arc` take them."""
    return chain.codes, chain.ends, chain.mesh, *others


@eqx.filter_custom_jvp
def _by_columns(osc: Oscillator, chain: Chain, backwards: Array, z: Array) -> Array:
    """`_all_arc_equations`, with derivatives by columns, arc by arc.

    Reverse mode through all integration steps takes ten times as long.
    """
    return _all_arc_equations((osc,), arc_columns(chain, backwards, z))


@_by_columns.def_jvp
def _(primals, tangents):
    osc, chain, backwards, z = primals
    along, weights = directions_of(osc, tangents[0])
    out, blocks = _equations_and_blocks((osc, along), arc_columns(chain, backwards, z))
    change = blocks[..., 3:] @ weights
    if tangents[3] is not None:
        change = change + jnp.sum(blocks[..., :3] * tangents[3][:, None], axis=-1)
    return out, change


def residual(
    osc: Oscillator, chain: Chain, z: Array, backwards: Array | None = None
) -> tuple[Array, Array]:
    """The 3N equations at the unknowns z, [N, 3], and the error in the condition of tangent arcs.

    For every arc: mismatch of x1, of x2, and guard. Without tangent arcs the error is zero.
    backwards: arcs that are followed backwards, [N]; default none.
    """
    backwards = _none(z) if backwards is None else backwards
    out = _by_columns(osc, chain, backwards, z)
    return _mismatch(out, z, backwards), jnp.sum(out[:, 3])


def _none(z: Array) -> Array:
    return jnp.zeros(len(z), bool)


def _mismatch(out: Array, z: Array, backwards: Array) -> Array:
    exits = jnp.where(backwards[:, None], z[:, :2], out[:, :2])
    entries = jnp.where(backwards[:, None], out[:, :2], z[:, :2])
    return jnp.concatenate([exits - jnp.roll(entries, -1, axis=0), out[:, 2:3]], axis=1)


def residual_and_blocks(
    osc: Oscillator,
    along: Oscillator | None,
    chain: Chain,
    z: Array,
    backwards: Array | None = None,
) -> tuple[Array, Array, Array]:
    """`residual`, and its derivatives, [N, 4, 3 + k].

    The derivatives of the equations of each arc with respect to its (x1, x2, T), and along the k
    directions `along` in the space of oscillators (an oscillator of arrays [k, ..]; None: no
    directions).
    """
    backwards = _none(z) if backwards is None else backwards
    out, blocks = _equations_and_blocks((osc, along), arc_columns(chain, backwards, z))
    return _mismatch(out, z, backwards), jnp.sum(out[:, 3]), blocks


def jacobian(blocks: Array, backwards: Array | None = None) -> Array:
    """The 3N x 3N matrix of the system: derivatives of each arc's end and guard, minus those of the
    next arc's entry. The end is an unknown itself where an arc is followed backwards, else the
    entry is."""
    n, unknowns = blocks.shape[0], blocks.shape[-1]
    own, entry = blocks, jnp.asarray(np.diag([1.0] * (unknowns - 1) + [0.0]))[None]
    if backwards is not None:
        back, state = backwards[:, None, None], jnp.asarray([True, True, False])[None, :, None]
        own = jnp.where(back & state, entry, blocks)
        entry = jnp.where(back, jnp.where(state, blocks, 0.0), entry)
    following = jnp.asarray(np.roll(np.eye(n), 1, axis=1))
    same = jnp.eye(n)[:, None, :, None] * own[:, :, None, :]
    then = following[:, None, :, None] * jnp.swapaxes(entry, 0, 1)[None]
    return (same - then).reshape(unknowns * n, unknowns * n)


class ClosedChain(Equations):
    """The 3N equations of a chain in the unknowns z, [N, 3], for an oscillator.

    backwards: the arcs that are followed backwards, [N].
    """

    chain: Chain
    backwards: Array

    def residual(self, given: Oscillator, z: Array) -> Array:
        return residual(given, self.chain, z, self.backwards)[0].reshape(-1)

    def linearized(self, given: Oscillator, z: Array) -> tuple[Array, Array]:
        value, _, blocks = residual_and_blocks(given, None, self.chain, z, self.backwards)
        return value.reshape(-1), jacobian(blocks[:, :3], self.backwards)

    def moved(self, given: Oscillator, z: Array, tangents: Oscillator) -> tuple[Array, Array]:
        along, weights = directions_of(given, tangents)
        _, _, blocks = residual_and_blocks(given, along, self.chain, z, self.backwards)
        out = blocks[..., 3:] @ weights
        change = _mismatch(out, jnp.zeros_like(z), self.backwards)
        return change.reshape(-1), jacobian(blocks[:, :3, :3], self.backwards)


def solve_closed(osc: Oscillator, chain: Chain, guess: Array) -> tuple[Array, Array, Array]:
    """The unknowns of a closed chain near a guess, [N, 3], differentiable with respect to the
    oscillator.

    Also returns the number of Newton steps, and the possible error of the states, from the last
    steps and from rounding. It is 0 for a chain that sticks: that begins at slip onset, which the
    parameters alone determine (durations that wander do not move it). An arc that magnifies is
    followed backwards from the state in which it ends, which is then its unknown: forwards its
    rounding would be larger than the tolerance of the equations.
    """
    guess = lax.stop_gradient(guess)
    backwards = _magnifying(osc, chain, guess)
    start = _with_ends(backwards, guess)
    solved = solve(ClosedChain(chain, backwards), osc, start)
    z = _with_entries(osc, chain, backwards, solved.z)
    off = jnp.maximum(solved.unsettled, jnp.max(solved.rounding.reshape(-1, 3)[:, :2]))
    return z, solved.iterations, jnp.where(chain.sticks, 0.0, off)


def closed(osc: Oscillator, chain: Chain, z: Array) -> Array:
    """The unknowns z found by `solve_closed`, differentiable with respect to the oscillator."""
    z = lax.stop_gradient(z)
    backwards = _magnifying(osc, chain, z)
    solved = solution(ClosedChain(chain, backwards), osc, _with_ends(backwards, z))
    return _with_entries(osc, chain, backwards, solved)


def _with_ends(backwards: Array, z: Array) -> Array:
    """z with the entries of arcs that are followed backwards replaced by the states at their
    ends."""
    return jnp.where(_is_end(backwards), jnp.roll(z, -1, axis=0), z)


def _with_entries(osc: Oscillator, chain: Chain, backwards: Array, z: Array) -> Array:
    """The inverse of `_with_ends`, by following these arcs backwards to their entries."""

    def entered():
        return jnp.where(_is_end(backwards), _by_columns(osc, chain, backwards, z)[:, :3], z)

    return lax.cond(any_lane(jnp.any(backwards)), entered, lambda: z)


def _is_end(backwards: Array) -> Array:
    return backwards[:, None] & jnp.asarray([True, True, False])[None]
