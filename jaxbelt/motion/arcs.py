"""One arc: from a state to where its mode, or its monotone motion, ends, and how it goes on there.

In a slip arc the orbit runs in the smooth field of its mode until one of these vanishes first:

- a guard of the mode, that is, a boundary r_k = 0 or a contact edge (see `modes`);
- x2' or x2. Between two such extrema x2 (x1) is monotone, so each boundary (edge) is met once at
  most: the sign of a guard after a step shows whether it was met, and its sign at the extremum
  itself whether an orbit that grazes a boundary meets it.

An integrator marches until a step ends outside of the mode; that step is then made once more,
shorter, so that it ends on the first root, see `roots`. A stick arc is known in closed form.

`simulate` and the orbits behind cycles are made of these arcs, and share the code for what follows
at their ends.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.modes import (
    Mode,
    boundary_guards,
    bounds_leftward,
    bounds_rightward,
    edge_guards,
    first_of,
    mode_acceleration,
    select,
)
from ..model.oscillator import Oscillator
from ..model.transitions import directions, leave_slip, leave_stick, stick_phase
from ..numerics.implicit import step_to_root
from ..numerics.roots import first_root
from .integrators import AbstractIntegrator, Field, State, slip_field

#: Signs of x2' and of x2 on an arc: +1 or -1, as numbers.
Signs = tuple[Array, Array]


class Ends:
    """Numbers of the things that may end an arc, for n belts.

    i < n: the boundary of belt i; n <= i < 3n: the edge i - n of `modes.edges`; then the extremum
    x2' = 0 of x2, the extremum x2 = 0 of x1, and slip onset. For shooting there follow `unused`, an
    arc that is not used, and from `tangent` on a tangency to the boundary of belt i. With a clock a
    tangency is where r_i' = 0, and last come `period`, the end of a period, and `nearest_limit`,
    where the needed force of a stick phase comes nearest to its limit.
    """

    def __init__(self, n: int):
        self.extremum_x2, self.extremum_x1, self.onset, self.unused, self.tangent = range(
            3 * n, 3 * n + 5
        )
        self.period, self.nearest_limit = 4 * n + 4, 4 * n + 5


class ArcEnd(eqx.Module):
    """How an arc ends, and how the orbit goes on.

    duration: of the arc; ended_by: a number of `Ends`, -1 if nothing ended it; y, mode, signs: from
    there on. captured: whether by a pseudo-focus; forever: whether the mass stays stuck; failed:
    whether the integrator gave up.
    """

    duration: Array
    y: State
    mode: Mode
    signs: Signs
    ended_by: Array
    captured: Array
    forever: Array
    failed: Array


def signs_after(osc: Oscillator, mode: Mode, y: State) -> Signs:
    """Signs of x2' and x2 just after y; +1 at an equilibrium."""
    of_x2, of_x1 = directions(osc, mode, *y)
    signs = jnp.where(of_x2 == 0, 1.0, of_x2), jnp.where(of_x1 == 0, 1.0, of_x1)
    return lax.stop_gradient(signs)


# --- slip arcs ------------------------------------------------------------------------------------


def _all_guards(osc: Oscillator, mode: Mode, signs: Signs, x1: Array, x2: Array) -> Array:
    """The guards of a slip arc in the order of `Ends`: boundaries, edges, extrema of x2 and x1."""
    a = mode_acceleration(osc, mode, x1, x2)
    guards = [*boundary_guards(osc, mode, x2), *edge_guards(osc, mode, x1)]
    return jnp.stack([*guards, signs[0] * a, signs[1] * x2])


def _that_count(
    osc: Oscillator, mode: Mode, signs: Signs, guards: Array, every_extremum: bool
) -> Array:
    """The guards of `_all_guards`, larger where they do not count, so that they do not fire.

    A boundary or edge from which the orbit moves away until its next extremum does not count. Nor
    does an extremum of x2 (x1), unless every extremum is to end an arc, while the boundaries
    (edges) are out of reach of one step.
    """
    n = len(osc.belts)
    boundary, edge, extrema = guards[:n], guards[n : 3 * n], guards[3 * n :]
    if not every_extremum:
        reach = jnp.abs(extrema[0]) + jnp.abs(extrema[1])
        distances = jnp.stack([jnp.min(boundary) / osc.omega, jnp.min(edge)])
        extrema = jnp.maximum(extrema, distances - reach)
    nears_boundary = signs[0] * jnp.stack(mode.codes) > 0
    rightward, leftward = jnp.stack(bounds_rightward(mode)), jnp.stack(bounds_leftward(mode))
    nears_edge = jnp.where(signs[1] > 0, rightward, leftward)
    nears = jnp.concatenate([nears_boundary, nears_edge])
    return jnp.append(jnp.where(nears, guards[: 3 * n], jnp.inf), extrema)


class SlipArc(eqx.Module):
    """The end of a slip arc: duration, state, what ended it (as in `ArcEnd`), failure."""

    duration: Array
    y: State
    ended_by: Array
    failed: Array


def slip_arc(
    osc: Oscillator,
    mode: Mode,
    signs: Signs,
    y: State,
    integrator: AbstractIntegrator,
    *,
    every_extremum: bool,
) -> SlipArc:
    """Follow the slip arc from y until a guard fires, or the integrator's time is over.

    signs: see `signs_after`; every_extremum: whether the arc ends at an extremum also where no
    boundary and no edge is near.
    """

    return arc_to_guard(
        osc,
        mode,
        signs,
        functools.partial(slip_field, osc, mode),
        functools.partial(_all_guards, osc, mode, signs),
        y,
        integrator,
        every_extremum=every_extremum,
    )


def arc_to_guard(
    osc: Oscillator,
    mode: Mode,
    signs: Signs,
    field: Field,
    guards_of: Callable[..., Array],
    y: State,
    integrator: AbstractIntegrator,
    *,
    every_extremum: bool,
) -> SlipArc:
    """`slip_arc` in the given field. guards_of(*y): the guards in the order of `Ends`."""

    def count(guards):
        return _that_count(osc, mode, signs, guards, every_extremum)

    def is_outside(y):
        return jnp.min(count(guards_of(*y))) < 0

    last = integrator.march(field, y, is_outside)
    root, ended_by = _first_guard(field, guards_of, last, integrator, count)
    # Unless every extremum ends an arc, nothing depends on where exactly an extremum ends one.
    is_sharp = last.outside & (every_extremum | (ended_by < 3 * len(osc.belts)))

    def guard_fired(*y):
        guards = guards_of(*y)
        return jnp.sum(jnp.where(jnp.arange(guards.size) == ended_by, guards, 0.0))

    # Newton steps from the root, small ones, for its last digits. The third pass makes the state at
    # the length that the second one found.
    def polish(carry, _):
        h = carry[0]
        y = integrator.step(field, last.start, h)
        guard, slope = jax.jvp(guard_fired, y, field(y))
        regular = jnp.abs(slope) * 1e-3 * last.length > jnp.abs(guard)
        return (h + step_to_root(guard, slope, where=is_sharp & regular), h, y), None

    h = jnp.where(last.outside, root, last.length)
    (_, h, y), _ = lax.scan(polish, (h, h, last.start), length=3)
    return SlipArc(last.t + h, y, jnp.where(last.outside, ended_by, -1), ~last.finished)


def _first_guard(field, guards_of, last, integrator, count) -> tuple[Array, Array]:
    """The time within the last step at which a guard first vanishes, and the guard's number."""

    def guards_at(y):
        values, slopes = jax.jvp(guards_of, y, field(y))
        return count(values), slopes

    values, slopes = guards_at(last.end)
    return first_root(
        lambda h: guards_at(integrator.step(field, last.start, h)),
        guards_at(last.start),
        last.length,
        (jnp.where(last.outside, values, jnp.inf), slopes),
        extrema=2,
    )


def after_slip(osc: Oscillator, mode: Mode, signs: Signs, arc: SlipArc) -> ArcEnd:
    """How the orbit goes on at the end of a slip arc; if a pseudo-focus captures it, at rest.

    Where the arc ends at an extremum, or for want of time, the mode stays.
    """
    ends = Ends(len(osc.belts))
    after = leave_slip(osc, mode, arc.ended_by, *arc.y)
    y = after.x1, jnp.where(after.captured, 0.0, after.x2)
    flipped = (
        jnp.where(arc.ended_by == ends.extremum_x2, -signs[0], signs[0]),
        jnp.where(arc.ended_by == ends.extremum_x1, -signs[1], signs[1]),
    )
    at_event = after.at_boundary | after.at_edge
    return ArcEnd(
        duration=arc.duration,
        y=y,
        mode=after.mode,
        signs=select(at_event, signs_after(osc, after.mode, y), flipped),
        ended_by=arc.ended_by,
        captured=after.captured,
        forever=jnp.zeros_like(arc.failed),
        failed=arc.failed,
    )


# --- stick arcs -----------------------------------------------------------------------------------


def stick_arc(osc: Oscillator, mode: Mode, y: State, longest: Array) -> ArcEnd:
    """The stick arc from y to its end, or for the time `longest` if this is finite and shorter."""
    x1, n = y[0], len(osc.belts)
    phase = stick_phase(osc, mode, x1)
    is_cut = (phase.duration >= longest) & (longest < jnp.inf)
    edges = [jnp.asarray(n + i) for i in range(2 * n)]
    ended_by = first_of(phase.edge, edges, jnp.asarray(Ends(n).onset))
    way = phase.x2 * jnp.where(is_cut, longest, 0.0)
    y_end = jnp.where(is_cut, x1 + way, phase.x1), phase.x2
    after = select(is_cut, mode, leave_stick(osc, mode, phase))
    never = jnp.zeros_like(is_cut)
    return ArcEnd(
        duration=jnp.where(is_cut, longest, phase.duration),
        y=y_end,
        mode=after,
        signs=signs_after(osc, after, y_end),
        ended_by=jnp.where(is_cut, -1, ended_by),
        captured=never,
        forever=jnp.isinf(phase.duration),
        failed=never,
    )
