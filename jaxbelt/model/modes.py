"""Modes: which belts touch, slip or stick; and when a mode ends.

A mode holds one contact code a belt:

    +1, -1   slipping, with that sign of the relative velocity r_i = nu_i - omega x2
     0       stuck: the mass moves with the belt
    -2, +2   not touching: the mass is below (above) the belt's contact interval

In a slip mode the friction keeps the sign of the mode, not sgn(r_i). So the field of a mode is
smooth across the mode's own boundaries, and events, derivatives and Newton iterations are right.
An orbit leaves a mode where one of its guards, positive inside, vanishes; `transitions` decides how
it goes on.

Everything here is elementwise: codes and states may be scalars (the trajectories of `simulate`)
or arrays of lanes (the kernel of `sweeps.queue`), belts are unrolled.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

from .forcing import Oscillating
from .oscillator import (
    MovingBelt,
    NoEdge,
    Oscillator,
    acceleration,
    has_edges,
    interval_ends,
)

Tree = TypeVar("Tree")
STUCK, BELOW, ABOVE = 0.0, -2.0, 2.0
#: Numbers that differ by less than this fraction are equal: the rounding of omega (nu / omega).
ULPS = 4e-16


class Mode(eqx.Module):
    """Contact codes, one array per belt (float64, any batch shape); see the module's text."""

    codes: tuple[Array, ...]

    @property
    def touching(self) -> tuple[Array, ...]:
        return tuple(jnp.abs(code) < 1.5 for code in self.codes)

    @property
    def stuck(self) -> tuple[Array, ...]:
        return tuple(code == STUCK for code in self.codes)

    @property
    def any_stuck(self) -> Array:
        return any_of(self.stuck)

    @property
    def signs(self) -> tuple[Array, ...]:
        """The signs for `acceleration`: 0 for belts that are stuck or do not touch."""
        return tuple(
            jnp.where(touches, code, 0.0)
            for code, touches in zip(self.codes, self.touching, strict=True)
        )

    def slipping(self, sign: float | Array) -> "Mode":
        """The mode in which the belts that are stuck slip with this sign instead."""
        return Mode(tuple(jnp.where(code == STUCK, sign, code) for code in self.codes))


def any_of(flags: Sequence[Any]) -> Any:
    """Elementwise `or` of at least one array of booleans, of JAX or of NumPy."""
    out = flags[0]
    for flag in flags[1:]:
        out = out | flag
    return out


def first_of(flags: Sequence[Array], values: Sequence[Array], default: Array) -> Array:
    """Elementwise the value whose flag is the first one set, or `default`."""
    out = default
    for flag, value in zip(reversed(flags), reversed(values), strict=True):
        out = jnp.where(flag, value, out)
    return out


def foremost(
    osc: Oscillator, flags: Sequence[Array], values: Sequence[Array], default: Array
) -> Array:
    """Elementwise the value of the belt with the largest load among those whose flag is set.

    These values are equal, because the belts act at one place, but their derivatives differ: this
    choice takes those of a belt that exerts a force. flags, values: one per belt, or several rows
    of one per belt. `default` where no flag is set. A load that oscillates counts by its mean, so
    that the choice is the same at all times.
    """
    out, largest = default, jnp.asarray(-jnp.inf)
    loads = [b.load.mean if isinstance(b.load, Oscillating) else b.load for b in osc.belts]
    loads = loads * (len(flags) // len(osc.belts))
    for load, flag, value in zip(loads, flags, values, strict=True):
        out, largest = select(flag & (load > largest), (value, load), (out, largest))
    return out


def select(condition: Array, on_true: Tree, on_false: Tree) -> Tree:
    """Elementwise choice between two modes, or two tuples of arrays."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), on_true, on_false)


def mode_of(codes: Array) -> Mode:
    """The mode with these contact codes, [belts]."""
    return Mode(tuple(codes[i] for i in range(codes.shape[0])))


def mode_acceleration(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> Array:
    """x2' of a slip mode; of a mode with stuck belts, the force `needed` that they have to hold."""
    a = acceleration(osc, mode.signs, x1, x2)
    if not any(isinstance(belt, MovingBelt) for belt in osc.belts):
        return a
    # The mass is carried along at the rate of the belt that it is stuck to.
    return a - stick_rate(osc, mode) / osc.omega


def stick_rate(osc: Oscillator, mode: Mode) -> Array:
    """The rate at which the velocity of the belts that are stuck changes, 0 where none is."""
    rates = [belt.rate if isinstance(belt, MovingBelt) else jnp.zeros(()) for belt in osc.belts]
    return foremost(osc, mode.stuck, rates, jnp.zeros(()))


def fastest_rate(a_by_x2: Array) -> Array:
    """How fast disturbances change: the largest |eigenvalue| of ((0, 1), (-1, d x2'/d x2))."""
    half = 0.5 * jnp.abs(a_by_x2)
    return jnp.where(half > 1, half + jnp.sqrt(jnp.maximum(half * half - 1, 0.0)), 1.0)


#: A layer is thin if x2' grows e-fold in less than LAYER; an error in it may delay the motion by
#: DELAY tolerances; see `share_of_tolerance`.
LAYER, DELAY = 0.01, 10.0
#: Rounding of x2 in a step, over x2.
X2_ROUNDING = 5e-15


def share_of_tolerance(rise: Array, a_start: Array, a_end: Array, rtol: ArrayLike) -> Array:
    """The share of the tolerance that the error of x2 may use in a step of an integrator.

    It is 1 except in a step out of a thin layer. Slip onset is an unstable point: where the law
    falls steeply, x2' grows from there like exp(t / LAYER) or faster, and an error of x2 with it.
    What remains of the error is a delay, the error over x2', which may be `DELAY` tolerances.

    Args:
        rise: Change of x2 in the step, relative to the belt where belts move.
        a_start: x2' at the start of the step, likewise relative to the belt.
        a_end: x2' at the end of the step, likewise.
        rtol: The relative tolerance; the share never asks for errors below rounding.
    """
    change = jnp.abs(a_end - a_start)
    grows = (jnp.abs(rise) < LAYER * change) & (jnp.abs(a_end) > jnp.abs(a_start))
    grows = grows & (a_start * a_end >= 0)
    share = jnp.maximum(DELAY * change, X2_ROUNDING / rtol)
    return jnp.where(grows, jnp.minimum(1.0, share), 1.0)


def capacity(osc: Oscillator, mode: Mode) -> Array:
    """The largest force that the stuck belts can hold together, the sum of u0_k mus_k."""
    return _of_stuck(osc, mode, [belt.friction.static for belt in osc.belts])


def kinetic_capacity(osc: Oscillator, mode: Mode) -> Array:
    """The friction of the stuck belts together as they begin to slip, the sum of u0_k mu_k(0)."""
    return _of_stuck(osc, mode, [belt.friction.mu(jnp.zeros(())) for belt in osc.belts])


def _of_stuck(osc: Oscillator, mode: Mode, coefficients: Sequence[ArrayLike]) -> Array:
    total = jnp.zeros(())
    for belt, stuck, mu in zip(osc.belts, mode.stuck, coefficients, strict=True):
        total = total + jnp.where(stuck, belt.load * mu, 0.0)
    return total


def force_rounding(x1: Any, scale: Array | float = 1.0) -> Any:
    """Rounding of forces and of x2' at x1: smaller ones count as 0 in all of this package.

    Forces at x1 are sums of terms of size `scale` and |x1|, each accurate to about 1e-16 of itself;
    but x1 and x2 may come from an integrated arc, whose end is accurate to about 1e-13.
    """
    return 1e-12 * (scale + abs(x1))


def distinct_places(places: np.ndarray) -> np.ndarray:
    """Sorted indices of the finite places; places equal up to rounding are merged."""
    order = np.argsort(places)
    order = order[np.isfinite(places[order])]
    known = places[order]
    return order[np.diff(known, prepend=-np.inf) > force_rounding(known)]


def without_rounding(a: Array, x1: Array) -> Array:
    """x2' at x1, set to 0 where it is rounding, as at slip onset; its derivatives are kept."""
    return jnp.where(jnp.abs(a) < force_rounding(x1), a - lax.stop_gradient(a), a)


def settle(osc: Oscillator, mode: Mode, x1: Array, x2: Array, held: Array | None = None) -> Mode:
    """Keep the stuck belts of `mode` stuck if they can hold the needed force, else let them slip.

    held: the largest force that they can hold together; None: their `capacity`.

    They slip with sign -sgn(needed): friction opposed the needed force until the limit. That one
    rule serves arrivals at a boundary (not held: the orbit crosses), contact edges met while
    sticking (not held: torn off) and starts on a boundary. Belts of equal velocity are stuck
    together, their capacities add and their signs flip together. Belts that can hold nothing never
    stick; where no force is needed either, r'' = omega^2 x2 gives the sign.
    """
    needed = mode_acceleration(osc, mode, x1, x2)
    held = capacity(osc, mode) if held is None else held
    rounding = force_rounding(x1, held)
    slips = (jnp.abs(needed) > held + rounding) | (held == 0)
    onward = jnp.where(x2 < 0, -1.0, 1.0)
    sign = jnp.where(jnp.abs(needed) <= rounding, onward, -jnp.sign(needed))
    codes = tuple(
        jnp.where(stuck & slips, sign, code)
        for code, stuck in zip(mode.codes, mode.stuck, strict=True)
    )
    return Mode(codes)


def stick_velocity(osc: Oscillator, mode: Mode, default: Array) -> Array:
    """Velocity nu_k of the belts that are stuck, or `default` where none is."""
    return foremost(osc, mode.stuck, [belt.velocity for belt in osc.belts], default)


# --- guards: positive inside a mode ---------------------------------------------------------------


def boundary_guards(osc: Oscillator, mode: Mode, x2: Array) -> list[Array]:
    """For every belt s_i r_i, positive while it slips with sign s_i; inf where it does not slip."""
    slipping = [touches & ~stuck for touches, stuck in zip(mode.touching, mode.stuck, strict=True)]
    return [
        jnp.where(slips, code * (belt.velocity - osc.omega * x2), jnp.inf)
        for belt, code, slips in zip(osc.belts, mode.codes, slipping, strict=True)
    ]


def edge_guards(osc: Oscillator, mode: Mode, x1: Array) -> list[Array]:
    """Distances to the edges that bound the mode: lower edges of all belts, then upper; or inf."""
    if not has_edges(osc):
        return [jnp.full_like(x1, jnp.inf)] * (2 * len(osc.belts))
    lower = [
        jnp.where(code == ABOVE, jnp.inf, jnp.where(code == BELOW, -1.0, 1.0) * (x1 - belt.lower))
        for belt, code in zip(osc.belts, mode.codes, strict=True)
    ]
    upper = [
        jnp.where(code == BELOW, jnp.inf, jnp.where(code == ABOVE, -1.0, 1.0) * (belt.upper - x1))
        for belt, code in zip(osc.belts, mode.codes, strict=True)
    ]
    return lower + upper


def bounds_rightward(mode: Mode) -> list[Array]:
    """For each of `edge_guards`, whether the edge bounds the mode on its right-hand side."""
    lower = [code == BELOW for code in mode.codes]
    return lower + list(mode.touching)


def bounds_leftward(mode: Mode) -> list[Array]:
    """For each of `edge_guards`, whether the edge bounds the mode on its left-hand side."""
    upper = [code == ABOVE for code in mode.codes]
    return list(mode.touching) + upper


def edges_ahead(mode: Mode, v: Array) -> list[Array]:
    """For each of `edge_guards`, whether a mass with velocity v (or its sign) moves towards it."""
    sides = zip(bounds_rightward(mode), bounds_leftward(mode), strict=True)
    return [(v > 0) & on_right | (v < 0) & on_left for on_right, on_left in sides]


def edges(osc: Oscillator) -> list[Array]:
    """Positions of the contact edges in the order of `edge_guards`; infinite for no edge."""
    bounds = interval_ends(osc)
    return [jnp.asarray(float(x)) if isinstance(x, NoEdge) else x for x in bounds]


def edge_at(osc: Oscillator, number: int | Array) -> Array:
    """x1 of the edge with this number in `edges`."""
    return jnp.stack(edges(osc))[number]


def velocity_of(osc: Oscillator, belt: int | Array) -> Array:
    """The velocity of a belt, by its number."""
    return jnp.stack([one.velocity for one in osc.belts])[belt]


def zone_ends(osc: Oscillator) -> tuple[Array, Array]:
    """Lower and upper ends of the intervals of x1 between contact edges, from left to right."""
    positions, end = jnp.sort(jnp.stack(edges(osc))), jnp.full(1, jnp.inf)
    return jnp.concatenate([-end, positions]), jnp.concatenate([positions, end])


def zone(osc: Oscillator, mode: Mode) -> tuple[Array, Array]:
    """The two edges, lower and upper, between which the mode's contacts do not change."""
    lower, upper = jnp.asarray(-jnp.inf), jnp.asarray(jnp.inf)
    sides = zip(edges(osc), bounds_leftward(mode), bounds_rightward(mode), strict=True)
    for edge, on_left, on_right in sides:
        lower = jnp.maximum(lower, jnp.where(on_left, edge, -jnp.inf))
        upper = jnp.minimum(upper, jnp.where(on_right, edge, jnp.inf))
    return lower, upper
