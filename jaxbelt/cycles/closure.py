"""Properties of a solution of the shooting equations: its error, its multiplier, and whether the
oscillator moves along it."""

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.modes import (
    any_of,
    boundary_guards,
    capacity,
    edge_guards,
    mode_acceleration,
    mode_of,
    select,
)
from ..model.oscillator import Oscillator
from ..model.transitions import held_at_boundary
from ..motion.arcs import Ends
from ..numerics.compiling import any_lane
from ..numerics.newton import HOLDS
from .chains import Chain, after_each, following_codes
from .shooting import (
    arc_by_arc,
    arc_columns,
    directions_of,
    end_guard,
    flow,
    magnifies,
    trace_of,
    with_columns,
)

#: An arc that lasts less than this, the square root of rounding, may have the duration zero.
LASTS = 1e-6


@eqx.filter_custom_jvp
def closure(osc: Oscillator, chain: Chain, z: Array) -> tuple[Array, Array]:
    """The largest error in the shooting equations, and the determinant of the monodromy matrix.

    The determinant leaves stick phases out. It is exp of the integral of the divergence, times the
    determinant of the saltation matrix, x2' after over before, at each crossing of a boundary. One
    multiplier of a planar cycle is 1, so the determinant is the other one. Contact edges have
    determinant one: their saltation matrix is [[1, 0], [jump of x2' / x2, 1]].
    """
    entries = jnp.roll(z[:, :2], -1, axis=0)
    columns = arc_columns(chain, following_codes(chain), z, entries)
    errors, factors = _errors_and_factors((osc,), columns)
    return jnp.max(errors), jnp.prod(factors)


@closure.def_jvp
def _(primals, tangents):
    # By columns, as in `shooting._by_columns`; the error has no derivative.
    osc, chain, z = primals
    along, weights = directions_of(osc, tangents[0])
    _, by_z, by_osc = multiplier_and_slopes(osc, along, chain, z)
    change = jnp.sum(by_osc * weights)
    if tangents[2] is not None:
        change = change + jnp.sum(by_z * tangents[2])
    return closure(osc, chain, z), (jnp.zeros(()), change)


def _error_and_factor(osc: Oscillator, codes, end, mesh, following, unknown, entry):
    """The largest error in the equations of an arc, and its factor of the determinant."""

    def followed(unknown, entry):
        return _error_and_factor_of(osc, codes, end, mesh, following, unknown, entry)

    def nothing(unknown, entry):
        missed = jnp.append(unknown[:2] - entry, unknown[2])
        return jnp.max(jnp.abs(missed)), jnp.ones(())

    some = any_lane(end != Ends(len(osc.belts)).unused)
    return lax.cond(some, followed, nothing, unknown, entry)


_errors_and_factors = arc_by_arc(_error_and_factor)


def _error_and_factor_of(osc: Oscillator, codes, end, mesh, following, unknown, entry):
    """`_error_and_factor` of a used arc."""
    back = magnifies(osc, codes, unknown[:2], entry)
    start, target = select(back, (entry, unknown[:2]), (unknown[:2], entry))
    way = jnp.where(back, -1.0, 1.0)
    steps = jnp.where(back, jnp.flip(mesh), mesh)
    after = flow(osc, codes, steps, start, way * unknown[2], trace_of)
    last = jnp.where(back, entry, after[:2])
    guard = end_guard(osc, codes, end, last)
    before_crossing = mode_acceleration(osc, mode_of(codes), last[0], last[1])
    after_crossing = mode_acceleration(osc, mode_of(following), entry[0], entry[1])
    slips = jnp.all(codes != 0) & (unknown[2] != 0)
    # The boundary of a belt at rest, x2 = 0, is crossed at an extremum of x1.
    flips = (end == Ends(len(osc.belts)).extremum_x1) & jnp.any(codes * following == -1)
    crosses = ((end < len(osc.belts)) | flips) & jnp.all(following != 0)
    ratio = after_crossing / jnp.where(crosses, before_crossing, 1.0)
    growth = jnp.where(slips, jnp.exp(jnp.where(slips, way * after[2], 0.0)), 1.0)
    error = jnp.maximum(jnp.max(jnp.abs(after[:2] - target)), jnp.abs(guard))
    return error, growth * jnp.where(crosses, ratio, 1.0)


def multiplier_and_slopes(
    osc: Oscillator, along: Oscillator, chain: Chain, z: Array
) -> tuple[Array, Array, Array]:
    """The determinant of `closure`, and its derivatives by z, [N, 3], and along k directions, [k].

    along: the directions, as for `residual_and_blocks`. The derivatives are taken arc by arc:
    reverse mode through all arcs takes three times as long to compile.
    """
    entries = jnp.roll(z[:, :2], -1, axis=0)
    columns = arc_columns(chain, following_codes(chain), z, entries)
    factors, slopes = _factors_and_slopes((osc, along), columns)
    product = jnp.prod(factors)
    slopes = slopes * _products_of_others(factors)[:, None]
    by_z = slopes[:, :3].at[:, :2].add(jnp.roll(slopes[:, 3:5], 1, axis=0))
    return product, by_z, jnp.sum(slopes[:, 5:], axis=0)


def _products_of_others(factors: Array) -> Array:
    """For each factor the product of all others."""
    one = jnp.ones(1)
    before = jnp.cumprod(jnp.concatenate([one, factors[:-1]]))
    after = jnp.cumprod(jnp.concatenate([one, factors[:0:-1]]))[::-1]
    return before * after


@arc_by_arc
def _factors_and_slopes(
    osc: Oscillator, along: Oscillator, codes, end, mesh, following, unknown: Array, entry: Array
):
    """The factor of an arc, and its derivatives by its unknowns, by the next arc's entry, and along
    the directions, [5 + k]."""

    def factor(osc, both):
        return _error_and_factor(osc, codes, end, mesh, following, both[:3], both[3:])[1]

    return with_columns(factor, osc, along, jnp.concatenate([unknown, entry]))


def admissible(osc: Oscillator, chain: Chain, z: Array) -> Array:
    """Whether the oscillator moves along a solution.

    Every arc has a duration >= 0 and stays inside its mode: both ends are examined; between them
    x1, x2 and the needed force are monotone, and no extremum of x1 is passed unmarked. All belts to
    which the mass sticks have its velocity. No arc crosses a boundary, or leaves one beyond an
    edge, where the mass would stick.
    """
    belts = range(len(osc.belts))

    def one(codes, end, unknown, exit_, after, lasts):
        mode, following = mode_of(codes), mode_of(after)
        fine = unknown[2] >= -HOLDS
        for y in (unknown, exit_):
            inside = jnp.stack([*boundary_guards(osc, mode, y[1]), *edge_guards(osc, mode, y[0])])
            needed = mode_acceleration(osc, mode, y[0], y[1])
            holds = ~mode.any_stuck | (jnp.abs(needed) <= capacity(osc, mode) + HOLDS)
            together = jnp.where(codes == 0, jnp.abs(velocities - osc.omega * y[1]), 0.0)
            fine = fine & jnp.all(inside >= -HOLDS) & holds & jnp.all(together <= HOLDS)
        # An arc along which x2 changes sign passes an extremum of x1 that ends no arc.
        lowest, highest = jnp.minimum(unknown[1], exit_[1]), jnp.maximum(unknown[1], exit_[1])
        fine = fine & ((lowest >= -HOLDS) | (highest <= HOLDS))
        # At a corner, where a boundary meets an edge, the arc behind the edge has duration zero.
        on_boundary = jnp.abs(velocities - osc.omega * exit_[1]) <= HOLDS
        goes_on = on_boundary & (jnp.abs(after) == 1) & lasts
        hit = [(end == belt) | goes_on[belt] for belt in belts]
        held, x2 = held_at_boundary(osc, following, hit)
        needed = mode_acceleration(osc, held, exit_[0], x2)
        would_stick = jnp.abs(needed) < capacity(osc, held) - HOLDS
        return fine & ~(any_of(hit) & ~following.any_stuck & would_stick)

    velocities = jnp.stack([belt.velocity for belt in osc.belts])
    exits = jnp.roll(z[:, :2], -1, axis=0)
    lasts = after_each(chain, z[:, 2]) > LASTS
    each = jax.vmap(one)(chain.codes, chain.ends, z, exits, following_codes(chain), lasts)
    return jnp.all(each | ~chain.used)


def passes_extremum(osc: Oscillator, chain: Chain, z: Array) -> Array:
    """Whether x2' changes sign along a slip arc of a solution: the arc passes an extremum of x2,
    where it should have ended."""

    def one(codes, entry, exit_):
        mode = mode_of(codes)
        ends = [mode_acceleration(osc, mode, y[0], y[1]) for y in (entry, exit_)]
        return ~mode.any_stuck & (jnp.minimum(*ends) < -HOLDS) & (jnp.maximum(*ends) > HOLDS)

    passes = jax.vmap(one)(chain.codes, z[:, :2], jnp.roll(z[:, :2], -1, axis=0))
    return jnp.any(passes & chain.used)
