"""States along an arc of any duration, and arcs cut into pieces that a mesh can take.

An arc may creep: to a node on the boundary of a belt, for example, near which it stays for a
hundred times as long as it moved, while integration steps stay as short as the steep law needs.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import pick
from ..model.modes import mode_acceleration, mode_of
from ..model.oscillator import Oscillator
from ..motion.arcs import Ends
from ..motion.integrators import STRIDE, density
from ..numerics.compiling import each, jit, power_of_two
from .chains import Loop
from .shooting import flow

#: Largest number of integration steps, of order 12, in an arc.
STEPS_ALONG = 100_000
#: Largest integral of the density of steps over a piece; a mesh of 16 steps takes it.
PIECE = 8.0
#: Pieces that are cut off each arc in one compiled call.
CUT_AT_ONCE = 32
#: Least number of rows of the arrays of arcs and pieces, so that few shapes are compiled.
FEWEST = 16


def places_along(
    osc: Oscillator, codes: Array, y: Array, duration: Array, rate: Callable, marks: Array
) -> tuple[Array, Array]:
    """Times since the entry of an arc, and states, [n] and [n, 2], at which an integral reaches
    marks.

    rate: the integrand, a function of the state; marks: in order. Marks that are not reached are at
    the end of the arc.
    """
    mode = mode_of(codes)

    def to(carry, mark):
        def before(carry):
            _, left, total = carry
            # Where there is no rate, NaN, the arc ends.
            return (left > 0) & ~(total >= mark)

        def step(carry):
            y, left, total = carry
            wanted = jnp.maximum(STRIDE / density(osc, mode, *y), duration / STEPS_ALONG)
            length, pace = jnp.minimum(wanted, left), rate(y)
            passes = total + pace * length > mark
            length = jnp.where(passes, (mark - total) / pace, length)
            total = jnp.where(passes, mark, total + pace * length)
            return flow(osc, codes, jnp.ones(1), y, length), left - length, total

        carry = lax.while_loop(before, step, carry)
        y, left, _ = carry
        return carry, (duration - left, y)

    return lax.scan(to, (y, duration, jnp.zeros(())), marks)[1]


def arc_samples(
    osc: Oscillator, codes: Array, y: Array, exit_: Array, duration: Array, n: int
) -> tuple[Array, Array]:
    """Times and states of n samples of an arc, the last at its end.

    Three quarters of them are spread evenly along its way in the plane, the others evenly in time.
    x1 and x2 are monotone, as extrema end arcs: |dx1| + |dx2| of the arc is the integral of that of
    its steps.
    """
    mode = mode_of(codes)
    way = jnp.sum(jnp.abs(exit_ - y))

    def rate(y):
        pull = jnp.where(mode.any_stuck, 0.0, mode_acceleration(osc, mode, *y))
        return 0.75 * (jnp.abs(y[1]) + jnp.abs(pull)) / way + 0.25 / duration

    marks = jnp.append(jnp.arange(1, n) / n, jnp.inf)
    return places_along(osc, codes, y, duration, rate, marks)


def cut_finely(osc: Oscillator, loop: Loop) -> Loop:
    """Arcs in a row, those that need more steps than a PIECE cut into pieces.

    A piece that is not the last of its arc has no end event ("unused").
    """
    count = len(loop.ends)
    padded = pick(loop, np.minimum(np.arange(power_of_two(count, FEWEST)), count - 1))
    entries, left = map(np.array, (padded.entries, padded.durations))
    left[count:] = 0.0
    pieces: list[list[tuple[np.ndarray, float]]] = [[] for _ in range(count)]
    while np.any(left > 0):
        # Arcs that are done take no step.
        found = _first_pieces(osc, padded.codes, *jax.device_put((entries, left)))
        ts, states = map(np.asarray, found)
        for arc in np.flatnonzero(left > 0):
            begins = np.vstack([entries[arc], states[arc, :-1]])
            for begin, duration in zip(begins, np.diff(ts[arc], prepend=0.0), strict=True):
                if duration > 0:
                    pieces[arc].append((begin, float(duration)))
        entries, left = states[:, -1], left - ts[:, -1]
    for own, entry in zip(pieces, np.asarray(loop.entries), strict=True):
        if not own:  # an arc of no duration
            own.append((entry, 0.0))
    rows = np.repeat(np.arange(count), [len(own) for own in pieces])
    cut_loop = pick(loop, rows)
    is_last = np.append(rows[1:] != rows[:-1], True)
    ends = np.where(is_last, np.asarray(cut_loop.ends), Ends(len(osc.belts)).unused)
    begins = np.stack([begin for own in pieces for begin, _ in own])
    durations = np.array([duration for own in pieces for _, duration in own])
    columns = jax.device_put((ends, begins, durations))
    return eqx.tree_at(lambda a: (a.ends, a.entries, a.durations), cut_loop, columns)


@jit
def _first_pieces(osc: Oscillator, codes: Array, entries: Array, durations: Array):
    def of_arc(codes, y, duration):
        def wanted(y):
            return density(osc, mode_of(codes), *y)

        marks = PIECE * jnp.arange(1.0, CUT_AT_ONCE + 1)
        return places_along(osc, codes, y, duration, wanted, marks)

    return each(of_arc)(codes, entries, durations)
