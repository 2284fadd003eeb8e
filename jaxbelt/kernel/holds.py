"""Ends of stick phases under a clock, where no belt changes its velocity or its load.

The needed force is then a line plus waves, in the time tau since the phase began,

    needed(tau) = rest - v tau + sum of a_j cos(theta_j + Omega_j tau),

and its second derivative is never larger than bend = sum of |a_j| Omega_j^2. A limit
f = capacity -+ needed with the slope s therefore stays positive for as long as the parabola
f + s tau - bend tau^2 / 2 does. The search steps to where the first of the two parabolas vanishes,
again and again: it cannot pass an end, whatever the frequencies are, and converges to a simple root
as fast as Newton's method. It steps over roots where a limit only touches zero, within rounding.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.forcing import BaseMotion, ConstantForce, Harmonic, Oscillating
from ..model.instants import blur
from ..model.modes import (
    Mode,
    capacity,
    edge_guards,
    edges_ahead,
    first_of,
    has_edges,
    mode_acceleration,
)
from ..model.oscillator import Oscillator, at_time
from .waves import along_and_across, turn_of

#: Relative rounding error of the needed force.
NEEDED_ROUNDING = 1e-13
#: Newton's method takes over where bend f <= `SAFE` s^2: by Kantorovich's theorem each step then
#: leaves less than the square of twice bend f / s^2, and `LAST_NEWTON_STEPS` leave rounding.
SAFE, LAST_NEWTON_STEPS = 1 / 32, 4
#: Steps of one search; where they do not reach the end, the next search goes on from there.
MOST_PARABOLAS = 64
#: Least divisor, in place of one that may be zero.
LEAST_DIVISOR = 1e-300


class FirstEnd(NamedTuple):
    """The end of a stick phase, arrays [lanes].

    duration: until its end, or the time searched without finding one; number: the guard that ends
    it, as in `instants.guards_at`, -1 where none has been found.
    """

    duration: Array
    number: Array


def is_steady(osc: Oscillator) -> bool:
    """Whether no velocity or load oscillates and all forces are waves or constants, by type."""
    numbers = [number for belt in osc.belts for number in (belt.velocity, belt.load)]
    waves = all(isinstance(one, ConstantForce | Harmonic | BaseMotion) for one in osc.forcing)
    return waves and not any(isinstance(number, Oscillating) for number in numbers)


def hold_from(osc: Oscillator, mode: Mode, asked: Array, x1, x2, t, remaining) -> FirstEnd:
    """The ends of the stick phases of the asked lanes, up to the remaining time.

    Args:
        osc: Steady oscillators, see `is_steady`.
        mode: Modes with a stuck belt.
        asked: Mask of the lanes to search; the results of the others mean nothing.
        x1: Where the mass is.
        x2: The velocity of the belt that holds it.
        t: Time.
        remaining: Time until the end of the run.
    """
    n, now = len(osc.belts), at_time(osc, t)
    waves = [_wave(osc, one, t) for one in osc.forcing if not isinstance(one, ConstantForce)]
    limit, zero = capacity(now, mode), jnp.zeros_like(x1)
    bend = sum((wave.size * wave.frequency**2 for wave in waves), zero + LEAST_DIVISOR)
    fuzz = NEEDED_ROUNDING * blur(t) * (1 + limit + jnp.abs(x1))
    rest = mode_acceleration(now, mode, x1, x2)
    rest = rest - sum((wave.after(zero)[0] for wave in waves), zero)

    def needed_at(tau):
        value, slope = rest - x2 * tau, -x2
        for wave in waves:
            push, change = wave.after(tau)
            value, slope = value + push, slope + change
        return value, slope

    to_edge, edge = zero + jnp.inf, jnp.full_like(zero, -1, dtype=int)
    if has_edges(osc):
        moves = x2 != 0
        ahead = zip(edges_ahead(mode, x2), edge_guards(now, mode, x1), strict=True)
        ways = [jnp.where(flag & moves, jnp.maximum(way, 0.0), jnp.inf) for flag, way in ahead]
        nearest = jnp.min(jnp.stack(ways), axis=0)
        to_edge = nearest / jnp.where(moves, jnp.abs(x2), 1.0)
        numbers = [jnp.asarray(n + i) for i in range(2 * n)]
        edge = first_of([way == nearest for way in ways], numbers, jnp.asarray(-1))
    horizon = jnp.minimum(remaining, to_edge)

    def parabolas(tau):
        """The time to the first root of a parabola, the side of its limit, and whether Newton's
        method is safe to find the root of that limit."""
        needed, rate = needed_at(tau)
        ways, sure = [], []
        for side in (-1.0, 1.0):
            value, slope = limit + side * needed + fuzz, side * rate
            value = jnp.maximum(value, jnp.where(slope < 0, 0.0, 0.25 * fuzz))
            root = jnp.sqrt(slope * slope + 2 * bend * value)
            falls = slope < 0
            over = jnp.where(falls, root - slope, bend)
            ways.append(jnp.where(falls, 2 * value, root + slope) / over)
            sure.append(falls & (bend * value <= SAFE * slope * slope))
        first = ways[0] < ways[1]
        way, other = jnp.where(first, ways[0], ways[1]), jnp.where(first, ways[1], ways[0])
        ends = jnp.where(first, sure[0], sure[1]) & (other > 1.1 * way)
        return way, jnp.where(first, -1.0, 1.0), ends

    def go_on(state):
        tau, going, ends, side, steps = state
        way, nearer, is_end = parabolas(tau)
        ends, side = ends | going & is_end, jnp.where(going, nearer, side)
        going = going & ~is_end
        tau = jnp.where(going, jnp.minimum(tau + way, horizon), tau)
        return tau, going & (tau < horizon), ends, side, steps + 1

    def is_going(state):
        return jnp.any(state[1]) & (state[-1] < MOST_PARABOLAS)

    start = zero, asked & (horizon > 0), zero > 0, zero, jnp.zeros((), int)
    tau, going, ends, side, _ = lax.while_loop(is_going, go_on, start)
    for _ in range(LAST_NEWTON_STEPS):
        needed, rate = needed_at(tau)
        value, slope = limit + side * needed, side * rate
        way = jnp.where(ends, -value / jnp.where(ends, slope, 1.0), 0.0)
        tau = jnp.maximum(tau + way, 0.0)
    # Where a limit and an edge coincide up to rounding, the phase ends at the edge.
    rounding = fuzz / jnp.maximum(jnp.abs(x2), LEAST_DIVISOR)
    at_edge = ~going & (to_edge <= remaining) & (~ends | (to_edge <= tau + rounding))
    at_limit = ends & ~at_edge & (tau <= remaining)
    number = jnp.where(at_limit, jnp.where(side < 0, 3 * n, 3 * n + 1), -1)
    number = jnp.where(at_edge, edge, number).astype(jnp.int32)
    return FirstEnd(jnp.where(at_edge, to_edge, jnp.minimum(tau, remaining)), number)


class _PhaseWave(NamedTuple):
    """A force on the mass, amplitude (cos u - turn sin u), u = angle + frequency tau, where tau is
    the time since the phase began; see `turn_of`."""

    amplitude: Array
    frequency: Array
    angle: Array
    turn: Array | None

    @property
    def size(self) -> Array:
        """The largest value of the force."""
        size = jnp.abs(self.amplitude)
        return size if self.turn is None else size * jnp.sqrt(1.0 + self.turn * self.turn)

    def after(self, tau: Array) -> tuple[Array, Array]:
        """The force at tau, and its derivative."""
        cosine, sine = along_and_across(self.angle + self.frequency * tau, self.turn)
        return self.amplitude * cosine, -self.amplitude * self.frequency * sine


def _wave(osc: Oscillator, force, t: Array) -> _PhaseWave:
    """The wave of a force on the mass, in the time tau since t."""
    angle = force.frequency * t + force.phase
    return _PhaseWave(force.amplitude, force.frequency, angle, turn_of(osc, force))
