"""Where a step of an orbit first meets one of several guards.

Guards are positive at the start of the step and negative beyond their root. The smallest of them
has kinks, on which a search for its root may end, and near a tangency one guard is small where
another has its root. So each is searched for by itself. The turns come first, the zeros of x2' and
of x2: up to a turn the other guards are monotone, and the sign of one at the turn, as accurate as
the integration, tells whether it has a root before.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

#: The values of all guards at a time, and their rates of change.
Guards = tuple[Array, Array]
#: A root is found to this fraction of the step.
NEAREST = 5e-13
#: A bracket that interpolation does not narrow in so many steps is halved in every other.
TRIALS, MOST = 8, 100


def first_root(
    guards: Callable[[Array], Guards], at_start: Guards, end: Array, at_end: Guards, turns: int
) -> tuple[Array, Array]:
    """The time in (0, end] at which a guard first vanishes, and the number of that guard.

    guards: all of them at a time; the last `turns` of them are turns. Where none is negative at the
    end the number is -1, and the time the end.
    """
    numbers = jnp.arange(at_end[0].size)
    is_turn = numbers >= numbers.size - turns

    def passed(state):
        _, (values, _), _, known = state
        return (values < 0) & ~known

    def earlier(state):
        end, at_end, _, known = state
        candidates = passed(state)
        turn = candidates & is_turn
        candidates = jnp.where(jnp.any(turn), turn, candidates)
        number = jnp.argmin(jnp.where(candidates, at_end[0], jnp.inf))
        end, at_end = _root(guards, numbers == number, at_start, end, at_end)
        return end, at_end, number, known | (numbers == number)

    start = (end, at_end, jnp.asarray(-1), jnp.zeros(numbers.shape, dtype=bool))
    end, _, number, _ = lax.while_loop(lambda state: jnp.any(passed(state)), earlier, start)
    return end, number


def _root(guards, which: Array, at_start: Guards, end: Array, at_end: Guards):
    """The root of one guard in (0, end], and all guards there.

    At 0 it may vanish, or be negative by rounding, where the orbit has just left it.
    """

    def pick(both):
        return tuple(jnp.sum(jnp.where(which, part, 0.0)) for part in both)

    shortest = NEAREST * end
    f_start, slope_start = pick(at_start)

    def near(at_c):
        value, slope = pick(at_c)
        return jnp.abs(value) <= jnp.abs(slope) * shortest

    def unfinished(state):
        a, _, b, _, _, at_c, count = state
        return (count == 0) | ((b - a > 2 * shortest) & ~near(at_c) & (count < MOST))

    def improve(state):
        a, at_a, b, at_b, _, _, count = state
        halved = (count > TRIALS) & (count % 2 == 0)
        c = jnp.where(halved, 0.5 * (a + b), _interpolated(a, at_a, b, at_b))
        # Not nearer to an end: once that is the root, up to rounding, the other follows at once.
        c = jnp.clip(c, a + shortest, b - shortest)
        at_c = guards(c)
        value, slope = pick(at_c)
        inside = value > 0

        def choose(new, old):
            return jnp.where(inside, new, old)

        a, at_a = choose(c, a), (choose(value, at_a[0]), choose(slope, at_a[1]))
        b, at_b = choose(b, c), (choose(at_b[0], value), choose(at_b[1], slope))
        return a, at_a, b, at_b, c, at_c, count + 1

    at_a = jnp.maximum(f_start, jnp.finfo(f_start.dtype).tiny), slope_start
    start = (jnp.zeros_like(end), at_a, end, pick(at_end), end, at_end, 0)
    *_, c, at_c, _ = lax.while_loop(unfinished, improve, start)
    value, slope = pick(at_c)
    regular = near(at_c) & (slope != 0)
    return c - jnp.where(regular, value / jnp.where(regular, slope, 1.0), 0.0), at_c


def _interpolated(a, at_a, b, at_b) -> Array:
    """The root of Hermite's cubic between a, where it is positive, and b, where it is not."""
    (f0, slope0), (f1, slope1) = at_a, at_b
    width = b - a
    m0, m1, rise = width * slope0, width * slope1, f1 - f0

    def cubic(s):
        return f0 + s * (m0 + s * (3 * rise - 2 * m0 - m1 + s * (m0 + m1 - 2 * rise)))

    def halve(_, bracket):
        left, right = bracket
        middle = 0.5 * (left + right)
        inside = cubic(middle) > 0
        return jnp.where(inside, middle, left), jnp.where(inside, right, middle)

    left, right = lax.fori_loop(0, 12, halve, (jnp.zeros_like(a), jnp.ones_like(a)))
    above, below = cubic(left), cubic(right)
    return a + width * (left + (right - left) * above / (above - below))
