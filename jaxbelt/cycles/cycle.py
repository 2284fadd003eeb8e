"""Steady cycles, stable and unstable: `find_cycle`, `unstable_cycle` and what they return, `Cycle`.

A cycle is a closed chain of arcs, and its signature, (the mode, what ends it) arc by arc, is all
that has to be known to compute it: the numbers then follow from a square system of equations
without any event detection (fixed-signature multiple shooting). An arc ends at a boundary r_k = 0,
at a contact edge, at slip onset, or at a loop, x2' = 0 or x2 = 0. The loops make x1 and x2 monotone
on every arc, so all extrema of a cycle are ends of arcs. Counted for N arcs:

    3N unknowns    entry state (x1, x2) and duration T of every arc
     N equations   the guard of the arc's end vanishes at its end
    2N equations   the end of an arc is the entry of the next, after the last comes the first

The number N is padded to a few fixed sizes and modes are data, so that one compiled program serves
all signatures. Slip arcs are integrated by a fixed number of steps of a scheme of order
twelve, spread over the arc so that they are short where the friction law bends; all arcs at
once, each step smooth in everything. Derivatives of a solution come from the implicit function
theorem and work in forward and reverse mode and under `jax.vmap`.

The signature comes from following the orbit, with the same steps and with the transition rules of
`modes`, until a loop repeats.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

from ..checks import as_array, check_finite, is_concrete, number, pick, require
from ..model.equilibria import Equilibria, EquilibriumKind, candidates
from ..model.modes import (
    Mode,
    at_focus,
    begins_at_rest,
    boundary_guards,
    bounds_leftward,
    bounds_rightward,
    capacity,
    edge_guards,
    edges,
    first_of,
    leave_slip,
    leave_stick,
    mode_acceleration,
    mode_of,
    mode_of_state,
    onset_position,
    select,
    settles,
    stick_phase,
    stick_velocity,
)
from ..model.oscillator import Oscillator, check_oscillator
from ..motion.simulate import Arcs
from ..numerics.compiling import each, jit, one_kernel
from ..numerics.extrapolation import Scheme, increments, scheme
from ..numerics.roots import first_root
from ..results import EventKind, Status, describe

#: Arcs in a chain: what is needed is rounded up to one of these; the first one under a trace.
SIZES = (16, 32, 64)
#: Integration steps per slip arc (an arc is about a quarter of a loop at most).
STEPS = 8
#: The same where those leave a larger error than EXACT, as halved steps tell it.
FINE_STEPS, EXACT = 32, 1e-11
#: Arcs that an orbit is followed for before it is given up.
BUDGET = 1024
#: A loop that repeats to this fraction of the amplitude has repeated; Newton does the rest.
REPEATED = 1e-7
#: Amplitudes below this one are an equilibrium, up to what can be told.
AT_REST = 1e-5
NEWTON_STEPS = 12
#: Longer Newton steps are cut to this length: guesses are good to that.
LONGEST = 0.5


# --- smooth arcs ----------------------------------------------------------------------------------


# Of order 12 for the arcs, of order 8 for following an orbit, of order 4 for placing the steps.
_FINE = scheme((2, 4, 6, 8, 10, 12))
_MEDIUM = scheme((2, 4, 6, 8))
_COARSE = scheme((2, 4))


def _step(field: Callable[[Array], Array], y: Array, h: Array, scheme: Scheme) -> Array:
    """One step of size h, for states in one array."""

    def apart(state):
        slopes = field(jnp.stack(state))
        return tuple(slopes[i] for i in range(y.size))

    (change,) = increments(apart, tuple(y[i] for i in range(y.size)), h, scheme)
    return y + jnp.stack(change)


def _field(osc: Oscillator, codes: Array, y: Array) -> Array:
    return jnp.stack([y[1], mode_acceleration(osc, mode_of(codes), y[0], y[1])])


def density(osc: Oscillator, codes: Array, y: Array) -> Array:
    """How many steps per unit of time an orbit at y wants: more where the friction law bends.

    The bend's inverse length is sqrt(u0 |mu''|), about p3 for Conti's law near r = 0.
    """
    a = mode_acceleration(osc, mode_of(codes), y[0], y[1])
    bend = jnp.zeros(())
    for i, belt in enumerate(osc.belts):
        speed = jnp.maximum(jnp.sign(codes[i]) * (belt.velocity - osc.omega * y[1]), 0.0)

        def slope(r, belt=belt):
            return jax.jvp(belt.friction.mu, (r,), (jnp.ones_like(r),))[1]

        curvature = jax.jvp(slope, (speed,), (jnp.ones_like(speed),))[1]
        slips = jnp.abs(codes[i]) == 1
        bend = bend + jnp.where(slips, jnp.sqrt(jnp.abs(belt.load * curvature)), 0.0)
    turning = jnp.sqrt(bend * jnp.abs(osc.omega * y[1]))  # where x2' = 0, x2'' = -x2
    return 1 + 0.4 * bend * jnp.abs(osc.omega * a) + turning


def _mesh(osc: Oscillator, steps: int, codes: Array, y: Array, duration: Array) -> Array:
    """Steps as fractions of the duration, [steps], so that each has about the same share of it."""
    n = 24
    h = duration / n

    def advance(y, _):
        y = _step(functools.partial(_field, osc, codes), y, h, _COARSE)
        return y, density(osc, codes, y)

    _, rest = lax.scan(advance, y, None, length=n)
    rho = jnp.concatenate([density(osc, codes, y)[None], rest])
    # Clipped: where a guess is poor the mesh is only less good.
    rho = jnp.clip(jnp.nan_to_num(rho, nan=1.0), 1.0, 100.0)
    share = jnp.concatenate([jnp.zeros(1), jnp.cumsum(rho[1:] + rho[:-1])])
    grid = jnp.interp(
        jnp.linspace(0.0, 1.0, steps + 1), share / share[-1], jnp.linspace(0, 1, n + 1)
    )
    return jnp.diff(grid)


class Chain(eqx.Module):
    """A signature: contact codes [arcs, belts], what ends each arc [arcs], and the step fractions.

    ends: i < n the boundary of belt i; n <= i < 3n the edge i - n of `modes.edges`; then the loop
    x2' = 0, the loop x2 = 0, slip onset, an unused arc, of duration zero, and from there on a
    tangency to the boundary of belt i (see `_arc_equations`).
    """

    codes: Array
    ends: Array
    mesh: Array

    @property
    def used(self) -> Array:
        return self.ends != Ends(self.codes.shape[-1]).unused

    @property
    def halved(self) -> "Chain":
        """The same chain with every integration step halved."""
        return replace(self, mesh=jnp.repeat(self.mesh / 2, 2, axis=-1))


class Ends:
    """Numbers for what ends an arc, for n belts."""

    def __init__(self, n: int):
        self.extremum_x2, self.extremum_x1, self.onset, self.unused, self.tangent = range(
            3 * n, 3 * n + 5
        )


def flow(osc: Oscillator, codes: Array, mesh: Array, y: Array, duration: Array, extra=None):
    """End of one arc, (x1, x2), and the integrals of `extra(osc, mode, x1, x2)`, a vector, over it.

    A stick arc is a straight line; Simpson's rule is exact there for what is at most cubic.
    """
    mode = mode_of(codes)
    stuck = mode.any_stuck
    n_extra = 0 if extra is None else extra(osc, mode, y[0], y[1]).size

    def field(state):
        smooth = _field(osc, codes, state[:2])
        if extra is None:
            return smooth
        return jnp.concatenate([smooth, extra(osc, mode, state[0], state[1])])

    start = jnp.concatenate([y, jnp.zeros(n_extra)])
    slip_time = jnp.where(stuck, 0.0, duration)

    def advance(state, fraction):
        return _step(field, state, slip_time * fraction, _FINE), None

    slipped, _ = lax.scan(advance, start, mesh)
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
    """What vanishes at y if an arc ends there by `end`; zero for an unused one."""
    mode = mode_of(codes)
    values = [
        *[belt.velocity - osc.omega * y[1] for belt in osc.belts],
        *[jnp.where(jnp.isfinite(edge), y[0] - edge, 1.0) for edge in edges(osc)],
        mode_acceleration(osc, mode, y[0], y[1]),
        y[1],
        y[0] - onset_position(osc, mode),
    ]
    return sum((jnp.where(end == i, value, 0.0) for i, value in enumerate(values)), jnp.zeros(()))


def _arc_equations(osc: Oscillator, codes, end, mesh, unknown: Array) -> Array:
    """(x1, x2, guard, 0) at the end of one arc, from its unknowns (x1, x2, T).

    An unused arc ends as it begins, and its guard is its duration. One that is to end tangent to
    the boundary of a belt ends at the point of it with x2' = 0. Trial arcs that run past there meet
    the pole of the friction law, so this one is followed backwards, from that point, to where it
    begins: (x1, x2) are the point's, the last two the misses of x1 and of x2. That is one equation
    more, a condition on the oscillator.
    """
    is_unused = end == Ends(len(osc.belts)).unused
    follow = functools.partial(_followed, osc, codes, end, mesh)
    return lax.cond(is_unused, lambda u: jnp.append(u, 0.0), follow, unknown)


def _followed(osc: Oscillator, codes, end, mesh, unknown: Array) -> Array:
    """`_arc_equations` of an arc that is used."""
    names = Ends(len(osc.belts))
    is_tangent = end >= names.tangent
    velocity = jnp.zeros(())
    for i, belt in enumerate(osc.belts):
        velocity = velocity + jnp.where(end == names.tangent + i, belt.velocity / osc.omega, 0.0)
    x1 = mode_acceleration(osc, mode_of(codes), jnp.zeros(()), velocity)
    point = jnp.stack([x1, velocity])
    start = jnp.where(is_tangent, point, unknown[:2])
    duration = jnp.where(is_tangent, -unknown[2], unknown[2])
    after = flow(osc, codes, jnp.where(is_tangent, jnp.flip(mesh), mesh), start, duration)
    guard = end_guard(osc, codes, end, after)
    ordinary = jnp.concatenate([after, guard[None], jnp.zeros(1)])
    return jnp.where(is_tangent, jnp.concatenate([point, after - unknown[:2]]), ordinary)


@one_kernel
def _equations(osc: Oscillator, chain: Chain, z: Array) -> Array:
    """`_arc_equations` of all arcs, [N, 4]."""

    def one(row):
        codes, end, mesh, unknown = row
        return _arc_equations(osc, codes, end, mesh, unknown)

    return lax.map(one, (chain.codes, chain.ends, chain.mesh, z))


@one_kernel
def _equations_and_blocks(osc: Oscillator, along: Oscillator | None, chain: Chain, z: Array):
    """`_arc_equations` of all arcs, [N, 4], and their derivatives, [N, 4, 3 + k]."""
    more = 0 if along is None else jax.tree.leaves(along)[0].size

    def one(row):
        codes, end, mesh, unknown = row

        def equations(osc, u):
            return _arc_equations(osc, codes, end, mesh, u)

        def column(direction):
            if along is None:
                of_unknown = functools.partial(equations, osc)
                return jax.jvp(of_unknown, (unknown,), (direction,))
            moved = jax.tree.map(lambda slopes: jnp.sum(slopes * direction[3:]), along)
            return jax.jvp(equations, (osc, unknown), (moved, direction[:3]))

        return jax.vmap(column, out_axes=(None, -1))(jnp.eye(3 + more))

    return lax.map(one, (chain.codes, chain.ends, chain.mesh, z))


def residual(osc: Oscillator, chain: Chain, z: Array) -> tuple[Array, Array]:
    """The 3N equations at the unknowns z, [N, 3]: mismatch of x1, of x2, guard, for every arc; and
    the miss of the tangent arcs, zero where there is none."""
    out = _equations(osc, chain, z)
    return out[:, :3] - _next_entries(z), jnp.sum(out[:, 3])


def _next_entries(z):
    return jnp.roll(z, -1, axis=0).at[:, 2].set(0.0)


def residual_and_blocks(
    osc: Oscillator, along: Oscillator | None, chain: Chain, z: Array
) -> tuple[Array, Array, Array]:
    """`residual`, and its derivatives: those of the equations of each arc with respect to its
    (x1, x2, T), and along the k directions `along` in the space of oscillators, if they are given
    (an oscillator of arrays [k]), [N, 4, 3 + k]."""
    out, blocks = _equations_and_blocks(osc, along, chain, z)
    return out[:, :3] - _next_entries(z), jnp.sum(out[:, 3]), blocks


def jacobian(blocks: Array) -> Array:
    """The 3N x 3N matrix of the system: the blocks, and minus one at the next arc's entry."""
    n = blocks.shape[0]
    following = jnp.asarray(np.roll(np.eye(n), 1, axis=1))
    same = jnp.eye(n)[:, None, :, None] * blocks[:, :, None, :]
    then = following[:, None, :, None] * jnp.asarray(np.diag([1.0, 1.0, 0.0]))[None, :, None, :]
    return (same - then).reshape(3 * n, 3 * n)


class Newton(eqx.Module):
    """State of a Newton iteration: unknowns, largest residual, steps made, how long each was,
    [NEWTON_STEPS], NaN where there was none, and the matrix of the last one."""

    z: Any
    residual: Array
    iterations: Array
    lengths: Array
    matrix: Array


def newton(step: Callable[[Any], tuple[Any, Array, Array]], start: Any) -> Newton:
    """Newton's method: step(z) gives the correction, the residual at z and the matrix.

    Steps longer than LONGEST are cut. Ends where steps are as small as rounding lets them be, and
    where they are not finite.
    """

    def unfinished(n):
        last = n.lengths[n.iterations - 1]
        before = n.lengths[jnp.maximum(n.iterations - 2, 0)]
        # The next step is shorter by the same factor at least: not worth making below rounding.
        settled = last * jnp.minimum(last / before, 1.0) < 1e-13
        going = (n.iterations < NEWTON_STEPS) & ~settled & jnp.isfinite(last)
        return going | (n.iterations == 0)

    def improve(n):
        change, size, matrix = step(n.z)
        length = jnp.max(jnp.stack([jnp.max(jnp.abs(c)) for c in jax.tree.leaves(change)]))
        shorter = jnp.minimum(1.0, LONGEST / length)
        z = jax.tree.map(lambda a, b: a + shorter * b, n.z, change)
        lengths = n.lengths.at[n.iterations].set(length)
        return Newton(z, size, n.iterations + 1, lengths, matrix)

    none = jnp.full(NEWTON_STEPS, jnp.nan)
    size = sum(leaf.size for leaf in jax.tree.leaves(start))
    matrix = jnp.zeros((size, size))
    first = Newton(start, jnp.zeros(()), jnp.asarray(0), none, matrix)
    return lax.while_loop(unfinished, improve, first)


def _newton_step(osc, chain, z):
    value, _, blocks = residual_and_blocks(osc, None, chain, z)
    matrix = jacobian(blocks[:, :3])
    step = jnp.linalg.solve(matrix, -value.reshape(-1))
    return step.reshape(z.shape), jnp.max(jnp.abs(value)), matrix


@eqx.filter_custom_jvp
def _solve(osc: Oscillator, chain: Chain, z0: Array) -> tuple[Array, Array]:
    """Unknowns that solve the system, [N, 3], and the number of Newton steps."""
    solved = newton(functools.partial(_newton_step, osc, chain), z0)
    return solved.z, solved.iterations


@_solve.def_jvp
def _(primals, tangents):
    osc, chain, z0 = primals
    z, iterations = _solve(osc, chain, z0)
    moved, fixed = eqx.partition(
        osc, jax.tree.map(lambda t: t is not None, tangents[0], is_leaf=lambda t: t is None)
    )
    _, shift = jax.jvp(
        lambda moved: residual(eqx.combine(moved, fixed), chain, z)[0], (moved,), (tangents[0],)
    )
    _, _, blocks = residual_and_blocks(osc, None, chain, z)
    z_dot = jnp.linalg.solve(jacobian(blocks[:, :3]), -shift.reshape(-1)).reshape(z.shape)
    return (z, iterations), (z_dot, None)


# --- following an orbit ---------------------------------------------------------------------------


class Orbit(eqx.Module):
    """The arcs of an orbit, in rows up to `count`: entry, duration, codes, and what ended each.

    tops: x1 where an arc ended in a maximum of x1, else NaN. repeats: row of the top that the last
    one repeats, else -1. y, code: where it stands now. low, low_before: the smallest x1 since the
    last top, and between that and the one before.
    """

    entries: Array
    durations: Array
    codes: Array
    ends: Array
    tops: Array
    count: Array
    y: Array
    code: Array
    low: Array
    low_before: Array
    repeats: Array
    status: Array
    done: Array


def _after(osc: Oscillator, codes: Array, y: Array):
    """Sign of x2' and x2 just after y; where x2' = 0, x2'' = -x2 decides."""
    a = mode_acceleration(osc, mode_of(codes), y[0], y[1])
    still, moving = jnp.abs(a) < 1e-9 * (1 + jnp.abs(y[0])), jnp.abs(y[1]) >= 1e-9
    return jnp.sign(jnp.where(still, -y[1], a)), jnp.sign(jnp.where(moving, y[1], a))


def _slip_to_guard(osc: Oscillator, codes: Array, y: Array):
    """Follow a slip arc to the first of its guards: duration, end state, index of the guard."""
    mode = mode_of(codes)
    a_sign, v_sign = _after(osc, codes, y)
    field = functools.partial(_field, osc, codes)

    # Others are moved away from until the next loop.
    nears_edge = jnp.where(
        v_sign > 0, jnp.stack(bounds_rightward(mode)), jnp.stack(bounds_leftward(mode))
    )
    nears = jnp.concatenate([a_sign * codes > 0, nears_edge])

    def guards(y):
        a = mode_acceleration(osc, mode, y[0], y[1])
        values = jnp.stack([*boundary_guards(osc, mode, y[1]), *edge_guards(osc, mode, y[0])])
        loops = jnp.stack([a_sign * a, v_sign * y[1]])
        return jnp.append(jnp.where(nears, values, jnp.inf), loops)

    def inside(state):
        _, _, _, y_end, steps = state
        # A stuck lane has no slip arc to follow; it must not keep a batch waiting.
        going = (steps < 200) & ~mode.any_stuck & jnp.all(jnp.isfinite(y_end))
        return ((steps == 0) | jnp.all(guards(y_end) >= 0)) & going

    def advance(state):
        t, _, h, y, steps = state
        h_new = 0.2 / density(osc, codes, y)
        return t + h, y, h_new, _step(field, y, h_new, _MEDIUM), steps + 1

    zero = jnp.zeros(())
    t, y0, h, y1, steps = lax.while_loop(inside, advance, (zero, y, zero, y, jnp.asarray(0)))

    def guards_at(y):
        return jax.jvp(guards, (y,), (field(y),))

    values, slopes = guards_at(y1)
    h_root, fired = first_root(
        lambda h: guards_at(_step(field, y0, h, _MEDIUM)),
        guards_at(y0),
        h,
        (jnp.where(mode.any_stuck, jnp.inf, values), slopes),
        extrema=2,
    )
    # Newton's method adds the last digits, but at a tangency.
    values, slopes = guards_at(_step(field, y0, h_root, _MEDIUM))
    own = jnp.arange(values.size) == fired
    value, slope = (jnp.sum(jnp.where(own, part, 0.0)) for part in (values, slopes))
    regular = jnp.abs(slope) > 1e-6
    h_root = h_root - jnp.where(regular, value / jnp.where(regular, slope, 1.0), 0.0)
    return t + h_root, _step(field, y0, h_root, _MEDIUM), fired, steps >= 200


def _next_arc(osc: Oscillator, orbit: Orbit) -> Orbit:
    n = len(osc.belts)
    names = Ends(n)
    y, codes = orbit.y, orbit.code
    mode = mode_of(codes)
    stuck = mode.any_stuck

    phase = stick_phase(osc, mode, y[0])
    stick_end = jnp.stack([phase.x1, y[1]])
    forever = jnp.isinf(phase.duration)
    edge_indices = [jnp.asarray(n + i) for i in range(2 * n)]
    stick_fired = first_of(phase.edge, edge_indices, jnp.asarray(names.onset))

    t_slip, slip_end, fired, lost = _slip_to_guard(osc, codes, y)
    after = leave_slip(osc, mode, fired, slip_end[0], slip_end[1])
    slip_end = jnp.stack([after.x1, after.x2])

    y_end = jnp.where(stuck, stick_end, slip_end)
    end = jnp.where(stuck, stick_fired, fired)
    new = select(stuck, leave_stick(osc, mode, phase, y[1]), after.mode)
    code = jnp.stack([jnp.asarray(c, dtype=y.dtype) for c in new.codes])
    duration = jnp.where(stuck, phase.duration, t_slip)

    # Whatever ends the arc: at the boundary of a belt at rest it is not the guard of loops.
    falls = ~new.any_stuck & (_after(osc, code, y_end)[1] < 0)
    is_top = ~stuck & (_after(osc, codes, y)[1] > 0) & falls
    top = jnp.where(is_top, y_end[0], jnp.nan)
    amplitude = top - orbit.low
    rows = jnp.arange(orbit.tops.size)
    same = jnp.abs(orbit.tops - top) < REPEATED * amplitude
    same = same & jnp.all(orbit.codes == codes[None], axis=-1)
    repeats = jnp.max(jnp.where(same, rows, -1))
    before = jnp.max(jnp.where(jnp.isnan(orbit.tops), -1, rows))
    # An orbit that sticks is on a cycle, however small: it repeats exactly.
    stuck_since = jnp.any((rows > before) & jnp.any(orbit.codes == 0, axis=-1))
    shrinks = amplitude < orbit.tops[before] - orbit.low_before
    resting = is_top & shrinks & (amplitude < AT_REST) & ~stuck_since
    resting = resting | settles(osc, new, y_end[0], y_end[1])

    status = jnp.where(stuck & forever, Status.STUCK_FOREVER.value, Status.OK.value)
    status = jnp.where(~stuck & after.captured, Status.PSEUDO_FOCUS.value, status)
    status = jnp.where(resting, Status.EQUILIBRIUM.value, status)
    astray = ~stuck & lost & ~resting
    status = jnp.where(astray, Status.NOT_SETTLED.value, status)
    status = jnp.where(jnp.all(jnp.isfinite(y_end)), status, Status.NOT_FINITE.value)
    own = rows == orbit.count

    def put(column, value):  # column.at[i].set would be a scatter in batches
        return jnp.where(own.reshape(-1, *[1] * value.ndim), value, column)

    return Orbit(
        entries=put(orbit.entries, y),
        durations=put(orbit.durations, duration),
        codes=put(orbit.codes, codes),
        ends=put(orbit.ends, end),
        tops=put(orbit.tops, top),
        count=orbit.count + 1,
        y=y_end,
        code=code,
        low=jnp.where(is_top, y_end[0], jnp.minimum(orbit.low, y_end[0])),
        low_before=jnp.where(is_top, orbit.low, orbit.low_before),
        repeats=repeats,
        status=status,
        done=(status != Status.OK) | (repeats >= 0),
    )


@one_kernel
def _follow_from(osc: Oscillator, start: Orbit) -> Orbit:
    def going(orbit):
        return ~orbit.done & (orbit.count < orbit.tops.size)

    return lax.while_loop(going, functools.partial(_next_arc, osc), start)


def follow(osc: Oscillator, y0: Array, budget: int) -> Orbit:
    """The orbit from y0 until a loop repeats, it comes to rest, or the budget is used up."""
    osc, y0 = lax.stop_gradient((osc, y0))
    n = len(osc.belts)
    mode = mode_of_state(osc, y0[0], y0[1])
    rests = begins_at_rest(osc, y0[0], y0[1])
    focus = at_focus(osc, y0[0], y0[1])
    status = jnp.where(rests, Status.EQUILIBRIUM.value, Status.OK.value)
    status = jnp.where(focus, Status.PSEUDO_FOCUS.value, status)
    start = Orbit(
        entries=jnp.zeros((budget, 2)),
        durations=jnp.zeros(budget),
        codes=jnp.ones((budget, n)),
        ends=jnp.full(budget, Ends(n).unused),
        tops=jnp.full(budget, jnp.nan),
        count=jnp.asarray(0),
        y=y0,
        code=jnp.stack([jnp.asarray(c, dtype=y0.dtype) for c in mode.codes]),
        low=y0[0],
        low_before=jnp.full_like(y0[0], jnp.inf),
        repeats=jnp.asarray(-1),
        status=status,
        done=status != Status.OK,
    )
    orbit = _follow_from(osc, start)
    status = jnp.where(orbit.done, orbit.status, Status.NOT_SETTLED.value)
    return eqx.tree_at(lambda orbit: orbit.status, orbit, status)


def last_loop(orbit: Orbit) -> tuple[Array, Array]:
    """(first row, number of rows) of the loop that repeats; it begins at the end of a stick phase.

    That of the longest one, if there are several; if there is none, at the top. Rows are to be
    taken modulo the number, see `loop_of`.
    """
    rows = jnp.arange(orbit.durations.size)
    size = orbit.count - 1 - orbit.repeats
    inside = (rows > orbit.repeats) & (rows < orbit.count)
    stuck = inside & jnp.any(orbit.codes == 0, axis=-1)
    longest = jnp.argmax(jnp.where(stuck, orbit.durations, -1.0))
    shift = jnp.where(jnp.any(stuck), longest - orbit.repeats, 0)
    return shift, size


class Loop(eqx.Module):
    """One loop of an orbit, arc by arc, padded: a signature, and a guess of the unknowns."""

    codes: Array
    ends: Array
    entries: Array
    durations: Array

    @property
    def used(self) -> Array:
        return self.ends != Ends(self.codes.shape[-1]).unused

    @property
    def exits(self) -> Array:
        """The states at the ends of the arcs; after the last used one comes the first."""
        last = jnp.arange(self.ends.size) == jnp.sum(self.used) - 1
        return jnp.where(last[:, None], self.entries[0], jnp.roll(self.entries, -1, axis=0))


def loop_of(orbit: Orbit, size: int, n: int) -> Loop:
    """The loop that repeats, padded to `size` arcs, of an oscillator with n belts."""
    shift, count = last_loop(orbit)
    rows = jnp.arange(size)
    used = rows < count
    source = orbit.repeats + 1 + jnp.where(used, shift + rows, shift) % jnp.maximum(count, 1)
    ends = jnp.where(used, orbit.ends[source], Ends(n).unused)
    durations = jnp.where(used, orbit.durations[source], 0.0)
    return Loop(orbit.codes[source], ends, orbit.entries[source], durations)


def meshed(osc: Oscillator, loop: Loop, steps: int = STEPS) -> tuple[Chain, Array]:
    """The chain of a loop with its mesh, and the guess of its unknowns."""
    stuck = jnp.any(loop.codes == 0, axis=-1)
    slip = jnp.where(stuck, 0.0, loop.durations)
    mesh = jax.vmap(functools.partial(_mesh, osc, steps))(loop.codes, loop.entries, slip)
    z = jnp.concatenate([loop.entries, loop.durations[:, None]], axis=1)
    return lax.stop_gradient((Chain(loop.codes, loop.ends, mesh), z))


# --- the cycle ------------------------------------------------------------------------------------


class Cycle(eqx.Module):
    """A steady cycle, differentiable with respect to every parameter of its oscillator.

    oscillator: whose cycle it is; chain: its signature, see `Chain`; unknowns: (x1, x2, T) at the
    entry of every arc, [arcs, 3]; both padded. multiplier: nontrivial Floquet multiplier, the
    determinant of the monodromy matrix with its saltation matrices, exactly 0 where the cycle
    sticks. residual: largest error in the shooting
    equations. iterations: Newton steps. status: a
    `Status` code; where it is not OK every number is NaN.

    `period`; `stick_durations`, [belts], summed over the phases of one loop; `x1_min`, `x1_max`,
    `x2_min`, `x2_max`; `stable`; `signature`, ((kind, belt), ...) of the events of one loop;
    `arcs`, as of a trajectory; `sample(n)`. A cycle that sticks begins at the end of its longest
    stick phase, any other at its largest x1.
    """

    oscillator: Oscillator
    chain: Chain
    unknowns: Array
    multiplier: Array
    residual: Array
    iterations: Array
    status: Array

    @property
    def period(self) -> Array:
        return jnp.sum(self.unknowns[..., 2], axis=-1)

    @property
    def stick_durations(self) -> Array:
        stuck = self.chain.codes == 0
        return jnp.sum(jnp.where(stuck, self.unknowns[..., 2:], 0.0), axis=-2)

    @property
    def x1_min(self) -> Array:
        return jnp.min(self.unknowns[..., 0], axis=-1)

    @property
    def x1_max(self) -> Array:
        return jnp.max(self.unknowns[..., 0], axis=-1)

    @property
    def x2_min(self) -> Array:
        return jnp.min(self.unknowns[..., 1], axis=-1)

    @property
    def x2_max(self) -> Array:
        return jnp.max(self.unknowns[..., 1], axis=-1)

    @property
    def stable(self) -> Array:
        return jnp.abs(self.multiplier) < 1

    @property
    def arcs(self) -> Arcs:
        """The arcs, smooth pieces in one mode each; NaN, or cut off, where unused."""
        used = self.chain.used
        nan = functools.partial(jnp.where, used)
        entries = jnp.cumsum(self.unknowns[..., 2], axis=-1) - self.unknowns[..., 2]
        arcs = Arcs(
            t=nan(entries, jnp.nan),
            y=jnp.where(used[..., None], self.unknowns[..., :2], jnp.nan),
            mode=self.chain.codes,
            duration=nan(self.unknowns[..., 2], jnp.nan),
        )
        if is_concrete(self.unknowns) and used.ndim == 1:
            arcs = pick(arcs, slice(int(np.sum(used))))
        return arcs

    @property
    def signature(self) -> tuple[tuple[EventKind, int], ...]:
        """The events of one loop, (kind, belt) each; outside of transformations only."""
        require(
            is_concrete(self.chain) and self.chain.ends.ndim == 1,
            "signature",
            "asked of one cycle outside of transformations",
            "a traced or batched cycle",
        )
        return loop_events(self.chain) if int(self.status) == Status.OK else ()

    def sample(self, n: int) -> Array:
        """States (x1, x2) at n times evenly spread over one period, ends included, [n, 2]."""
        return _sample(self, n)

    def __repr__(self) -> str:
        if not is_concrete(self.unknowns) or self.unknowns.ndim != 2:
            return f"Cycle(unknowns={self.unknowns.shape})"
        if int(self.status) != Status.OK:
            return f"Cycle({Status(int(self.status)).name}: {describe(self.status)})"
        events = " ".join(f"{kind.name} {belt}" for kind, belt in self.signature) or "smooth"
        sticks = ", ".join(map(number, self.stick_durations))
        return (
            f"Cycle({events}; period {number(self.period)}, sticks ({sticks}), "
            f"multiplier {number(self.multiplier)}, {'' if self.stable else 'un'}stable, "
            f"residual {float(self.residual):.1e})"
        )


def as_loop(cycle: Cycle, size: int) -> Loop:
    """The loop that a cycle is, padded to `size` arcs."""
    chain, z = cycle.chain, cycle.unknowns
    own = np.arange(size) < len(z)
    source = np.where(own, np.arange(size), 0)
    ends = jnp.where(own, chain.ends[source], Ends(chain.codes.shape[-1]).unused)
    return Loop(chain.codes[source], ends, z[source, :2], jnp.where(own, z[source, 2], 0.0))


def modes_of(loop: Chain | Loop) -> np.ndarray:
    """The contact codes of the arcs of one loop, [arcs, belts], without those that are unused."""
    codes, ends = np.asarray(loop.codes), np.asarray(loop.ends)
    return codes[ends != Ends(codes.shape[-1]).unused].astype(int)


def event_between(before: Sequence[int], after: Sequence[int]) -> tuple[EventKind, int]:
    """The event, (kind, belt), that leads from one mode to another one, by their contact codes.

    Of several belts concerned the lowest.
    """
    pairs = list(zip(before, after, strict=True))
    changes = {
        EventKind.EDGE: [(abs(a) < 2) != (abs(b) < 2) for a, b in pairs],
        EventKind.STICK: [a != 0 and b == 0 for a, b in pairs],
        EventKind.SLIP: [a == 0 and b != 0 for a, b in pairs],
        EventKind.CROSS: [a != b for a, b in pairs],
    }
    kind = next(kind for kind, changed in changes.items() if any(changed))
    return kind, changes[kind].index(True)


def loop_events(loop: Chain | Loop) -> tuple[tuple[EventKind, int], ...]:
    """The events of one loop, (kind, belt) each; for EDGE the lowest belt that comes or goes."""
    modes = modes_of(loop).tolist()
    pairs = zip(modes, modes[1:] + modes[:1], strict=True)
    return tuple(event_between(before, after) for before, after in pairs if before != after)


@jit
def _sample(cycle: Cycle, n: int) -> Array:
    durations = cycle.unknowns[:, 2]
    ends = jnp.cumsum(durations)

    def at(t):
        i = jnp.minimum(jnp.searchsorted(ends, t).astype(int), jnp.sum(cycle.chain.used) - 1)
        since = t - ends[i] + durations[i]
        chain = cycle.chain
        return flow(cycle.oscillator, chain.codes[i], chain.mesh[i], cycle.unknowns[i, :2], since)

    return jax.vmap(at)(jnp.linspace(0.0, 1.0, n) * ends[-1])


def trace_of(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> Array:
    """Divergence of the field of a slip mode, d(x2')/d(x2), as a vector of one."""
    _, slope = jax.jvp(lambda v: mode_acceleration(osc, mode, x1, v), (x2,), (jnp.ones_like(x2),))
    return slope[None]


def closure(osc: Oscillator, chain: Chain, z: Array) -> tuple[Array, Array]:
    """The largest error in the shooting equations, and the determinant of the monodromy matrix with
    stick phases left out: exp of the mean divergence, and at each crossing of a boundary the
    determinant of its saltation matrix, x2' after over before.

    One multiplier of a planar cycle is 1, so this is the other one. Contact edges have determinant
    one: their saltation matrix is [[1, 0], [jump of x2' / x2, 1]].
    """
    entries = jnp.roll(z[:, :2], -1, axis=0)
    errors, factors = _errors_and_factors(osc, chain, following_codes(chain), z, entries)
    return jnp.max(errors), jnp.prod(factors)


@one_kernel
def _errors_and_factors(osc: Oscillator, chain: Chain, following: Array, z: Array, entries: Array):
    """What each arc contributes to `closure`."""
    return lax.map(
        lambda row: _error_and_factor(osc, *row),
        (chain.codes, chain.ends, chain.mesh, following, z, entries),
    )


def _error_and_factor(osc: Oscillator, codes, end, mesh, following, unknown, entry):
    after = flow(osc, codes, mesh, unknown[:2], unknown[2], trace_of)
    guard = end_guard(osc, codes, end, after[:2])
    before_crossing = mode_acceleration(osc, mode_of(codes), after[0], after[1])
    after_crossing = mode_acceleration(osc, mode_of(following), entry[0], entry[1])
    slips = jnp.all(codes != 0) & (unknown[2] != 0)
    crosses = (end < len(osc.belts)) & jnp.all(following != 0)
    ratio = after_crossing / jnp.where(crosses, before_crossing, 1.0)
    growth = jnp.where(slips, jnp.exp(jnp.where(slips, after[2], 0.0)), 1.0)
    error = jnp.maximum(jnp.max(jnp.abs(after[:2] - entry)), jnp.abs(guard))
    return error, growth * jnp.where(crosses, ratio, 1.0)


def multiplier_and_slopes(
    osc: Oscillator, along: Oscillator, chain: Chain, z: Array
) -> tuple[Array, Array, Array]:
    """The determinant that `closure` gives, and its derivatives: with respect to z, [N, 3], and
    along the k directions `along`, as for `residual_and_blocks`, [k].

    Arc by arc: backwards through all of them the program takes three times as long to compile.
    """
    entries = jnp.roll(z[:, :2], -1, axis=0)
    factors, slopes = _factors_and_slopes(osc, along, chain, following_codes(chain), z, entries)
    product = jnp.prod(factors)
    slopes = slopes * (product / factors)[:, None]
    by_z = slopes[:, :3].at[:, :2].add(jnp.roll(slopes[:, 3:5], 1, axis=0))
    return product, by_z, jnp.sum(slopes[:, 5:], axis=0)


@one_kernel
def _factors_and_slopes(osc, along: Oscillator, chain: Chain, following, z: Array, entries: Array):
    """The factor of each arc, [N], and its derivatives with respect to its unknowns, the entry of
    the next one, and along the directions, [N, 5 + k]."""
    more = jax.tree.leaves(along)[0].size

    def one(row):
        codes, end, mesh, following, unknown, entry = row

        def factor(osc, unknown, entry):
            return _error_and_factor(osc, codes, end, mesh, following, unknown, entry)[1]

        def column(direction):
            moved = jax.tree.map(lambda slopes: jnp.sum(slopes * direction[5:]), along)
            tangents = moved, direction[:3], direction[3:5]
            return jax.jvp(factor, (osc, unknown, entry), tangents)

        return jax.vmap(column, out_axes=(None, -1))(jnp.eye(5 + more))

    return lax.map(one, (chain.codes, chain.ends, chain.mesh, following, z, entries))


def following_codes(chain: Chain | Loop) -> Array:
    """Contact codes of the arc after each; after the last used one comes the first."""
    following = jnp.roll(chain.codes, -1, axis=0)
    last = jnp.arange(chain.ends.size) == jnp.sum(chain.used) - 1
    return jnp.where(last[:, None], chain.codes[0], following)


def admissible(osc: Oscillator, chain: Chain, z: Array) -> Array:
    """Whether every arc stays inside its mode and has a duration >= 0, up to rounding.

    Both ends are looked at; between them x1, x2 and the needed force are monotone.
    """
    slack = 1e-9

    def one(codes, unknown, following):
        mode = mode_of(codes)
        fine = unknown[2] >= -slack
        for y in (unknown, following):
            inside = jnp.stack([*boundary_guards(osc, mode, y[1]), *edge_guards(osc, mode, y[0])])
            needed = mode_acceleration(osc, mode, y[0], y[1])
            held = ~mode.any_stuck | (jnp.abs(needed) <= capacity(osc, mode) + slack)
            fine = fine & jnp.all(inside >= -slack) & held
        return fine

    each = jax.vmap(one)(chain.codes, z, jnp.roll(z, -1, axis=0))
    return jnp.all(each | ~chain.used)


def cycle_of(
    osc: Oscillator,
    chain: Chain,
    z: Array,
    iterations: Array,
    status: Array,
    error: Array | None = None,
) -> tuple[Cycle, Array]:
    """The `Cycle` of a solution z, NaN with a status where it is none; and its multiplier with
    stick phases left out.

    error: the largest in its equations, where these are not those of the chain and it is known that
    they hold: an arc that was solved for backwards may magnify what is followed forwards a hundred
    thousand times.
    """
    forwards, slope = closure(osc, chain, z)
    if error is None:
        error = forwards
        status = _first_failure(
            status, closure(osc, chain.halved, z)[0] < 1e-9, Status.NO_CONVERGENCE
        )
        status = _first_failure(status, error < 1e-9, Status.NO_CONVERGENCE)
    status = _first_failure(status, admissible(osc, chain, z), Status.NOT_ADMISSIBLE)
    sticks = jnp.any(chain.used[:, None] & (chain.codes == 0))
    known = functools.partial(jnp.where, status == Status.OK)
    cycle = Cycle(
        oscillator=osc,
        chain=chain,
        unknowns=known(z, jnp.nan),
        multiplier=known(jnp.where(sticks, 0.0, slope), jnp.nan),
        residual=known(error, jnp.nan),
        iterations=iterations,
        status=status,
    )
    return cycle, slope


def _first_failure(status: Array, fine: Array, code: Status) -> Array:
    return jnp.where((status == Status.OK) & ~fine, code.value, status)


@jit
def _loop_reached(osc: Oscillator, y0: Array, size: int) -> tuple[Loop, Array, Array]:
    """The loop that the start leads to, in `size` arcs; how many it has, and a status."""
    orbit = follow(osc, y0, BUDGET)
    # Where there is no cycle the first arc still gives finite numbers to calculate with.
    loop = orbit.repeats, orbit.count
    loop = select(orbit.status == Status.OK, loop, (jnp.asarray(-1), jnp.asarray(1)))
    orbit = eqx.tree_at(lambda orbit: (orbit.repeats, orbit.count), orbit, loop)
    _, count = last_loop(orbit)
    return loop_of(orbit, size, len(osc.belts)), count, _if_it_fits(orbit.status, count, size)


def _if_it_fits(status: Array, count: Array, size: int) -> Array:
    return _first_failure(status, count <= size, Status.TOO_MANY_ARCS)


def exactly(osc: Oscillator, loop: Loop, status: Array) -> Cycle:
    """The cycle that a loop nearly is; where it is known, with as many steps as it takes."""
    cycle = polish(osc, loop, status)
    if is_concrete(cycle) and int(status) == Status.OK:
        inexact = int(cycle.status) == Status.NO_CONVERGENCE or integration_error(cycle) > EXACT
        cycle = polish(osc, loop, status, steps=FINE_STEPS) if inexact else cycle
    return cycle


@jit
def integration_error(cycle: Cycle) -> Array:
    """The largest error in the shooting equations with every integration step halved."""
    return closure(cycle.oscillator, cycle.chain.halved, cycle.unknowns)[0]


@jit
def polish(osc: Oscillator, loop: Loop, status: Array, steps: int = STEPS) -> Cycle:
    """The cycle that a loop nearly is, by Newton's method; one program for all that need it."""
    chain, guess = meshed(lax.stop_gradient(osc), loop, steps)
    z, iterations = _solve(osc, chain, guess)
    return cycle_of(osc, chain, z, iterations, status)[0]


def room_of(arcs: int) -> int:
    """The size of a chain that so many arcs, SIZES[-1] at most, are given."""
    return next(size for size in SIZES if size >= arcs)


def cut(loops: Sequence[Loop], *, more: int = 0) -> list[Loop]:
    """The loops, known ones, with no more room than the longest of them needs, and some more."""
    unused = Ends(loops[0].codes.shape[-1]).unused
    longest = max(int(np.sum(np.asarray(loop.ends) != unused)) for loop in loops)
    room = slice(room_of(min(longest + more, SIZES[-1])))
    return [jax.tree.map(lambda leaf: leaf[room], loop) for loop in loops]


def find_cycle(osc: Oscillator, y0: ArrayLike | tuple, *, max_arcs: int | None = None) -> Cycle:
    """The steady cycle that the start y0 leads to.

    osc: `Oscillator`; y0: start (x1, x2), shape [2]. max_arcs: room for the arcs of one loop, where
    under a transformation 16 are not enough.

    The orbit is followed until a loop repeats; then all arcs are polished together by Newton's
    method. Differentiable with respect to the parameters (the derivative with respect to y0 is
    zero: a cycle does not depend on where it was approached from), forward and reverse, and under
    `jax.vmap`. Where the start leads to an equilibrium, or nothing repeats, the status says so.
    `ValueError` names an argument that is impossible.
    """
    check_oscillator(osc)
    y0 = as_array(y0, "y0", (2,))
    check_finite(y0, "y0")
    loop, count, status = _loop_reached(osc, y0, max_arcs or SIZES[-1])
    if max_arcs is None and is_concrete(count):
        needed = int(count) if int(status) == Status.OK else 0
        loop = pick(loop, slice(room_of(needed)))
    elif max_arcs is None:
        loop, status = pick(loop, slice(SIZES[0])), _if_it_fits(status, count, SIZES[0])
    return exactly(osc, loop, status)


# --- the unstable cycle ---------------------------------------------------------------------------

#: Starts that are compared in one batch, and how often the interval between two of them is refined.
STARTS, REFINEMENTS = 32, 3


def unstable_cycle(osc: Oscillator, *, around: int = 0, max_arcs: int | None = None) -> Cycle:
    """The unstable cycle around a stable equilibrium, that touches no boundary (no sliding).

    It separates the starts that come to rest from those that go on to the motion outside of it. It
    may pass contact edges. osc: `Oscillator`; around: the number of the equilibrium, counted from
    the left among the stable ones but for segments; max_arcs as for `find_cycle`. Differentiable
    like any `Cycle`. Where there is none, or none of this sort, the status is NO_UNSTABLE_CYCLE.
    `ValueError` names an impossible argument.

    Starts to the right of the equilibrium at different distances are followed for one loop. The
    first one that does not come nearer, or that touches a boundary, lies outside of the cycle;
    between it and its neighbour the search is repeated, and Newton's method does the rest.
    """
    check_oscillator(osc)
    whole = isinstance(around, int) and around >= 0
    require(whole, "around", "the number of an equilibrium, 0 or more", repr(around))
    loop, status, distance = separating_loop(osc, max_arcs or SIZES[0], around)
    return _if_meant(exactly(osc, loop, status), loop, distance)


def first_loop(osc: Oscillator, x1: Array, distance: Array, size: int):
    """The orbit from (x1 + distance, 0) to its first maximum of x1, within `size` arcs.

    Returns it as if that loop repeated, whether it meets a boundary, and x1 there (NaN: none).
    """
    orbit = follow(osc, jnp.stack([x1 + distance, jnp.zeros(())]), size)
    is_top = ~jnp.isnan(orbit.tops)
    row = jnp.where(jnp.any(is_top), jnp.argmax(is_top), size)
    meets = jnp.any((jnp.arange(size) <= row) & (orbit.ends < len(osc.belts)))
    top = jnp.where(row < size, orbit.tops[jnp.minimum(row, size - 1)], jnp.nan)
    closed = (jnp.asarray(-1), row + 1)
    return eqx.tree_at(lambda o: (o.repeats, o.count), orbit, closed), meets, top


def separating_loop(osc: Oscillator, size: int, around: int = 0) -> tuple[Loop, Array, Array]:
    """A loop near the unstable cycle, a status, and how far from the equilibrium it begins."""
    return _separating_loop(osc, candidates(osc), jnp.asarray(np.array(around)), size)


@jit
def _separating_loop(osc: Oscillator, rests: Equilibria, around: Array, size: int):
    still, rests = lax.stop_gradient((osc, rests))
    eligible = rests.stable & (rests.kind != EquilibriumKind.SEGMENT) & (rests.kind > 0)
    meant = eligible & (jnp.cumsum(eligible) - 1 == around)
    exists = jnp.any(meant)
    x1 = jnp.where(exists, rests.x1[jnp.argmax(meant)], 0.0)

    def loop(distance):
        orbit, touches, top = first_loop(still, x1, distance, size)
        rests = (orbit.status == Status.PSEUDO_FOCUS) | (orbit.status == Status.EQUILIBRIUM)
        inside = ~touches & jnp.where(jnp.isnan(top), rests, top - x1 < distance)
        return orbit, inside

    def narrow(bracket, _):
        distances = jnp.exp(jnp.linspace(jnp.log(bracket[0]), jnp.log(bracket[1]), STARTS))
        orbits, inside = each(loop)(distances)
        first = jnp.argmin(inside)
        bounded = ~inside[-1] & (first > 0)
        low, high = distances[jnp.maximum(first - 1, 0)], distances[first]
        bracket = jnp.where(bounded, jnp.stack([low, high]), bracket)
        innermost = jax.tree.map(lambda leaf: leaf[jnp.maximum(first - 1, 0)], orbits)
        return bracket, (inside[0] & ~jnp.all(inside), innermost)

    bracket, (found, orbits) = lax.scan(narrow, jnp.array([1e-4, 10.0]), None, length=REFINEMENTS)
    orbit = jax.tree.map(lambda leaf: leaf[-1], orbits)
    status = jnp.where(exists & found[0], Status.OK.value, Status.NO_UNSTABLE_CYCLE.value)
    return loop_of(orbit, size, len(osc.belts)), status, bracket[0]


@jit
def _if_meant(cycle: Cycle, loop: Loop, distance: Array) -> Cycle:
    """The cycle, if it repels and begins near the loop; one found elsewhere by Newton's method, or
    that has shrunk to the equilibrium, is not the one meant."""
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
