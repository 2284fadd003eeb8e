"""Where a step of an orbit first meets one of several guards.

Guards are positive at the start of the step and negative beyond their root. Their minimum has
kinks, on which a search for its root may end, and near a tangency one guard is small where another
has its root. So the root of each guard is searched for by itself. The extrema come first, the zeros
of x2' and of x2: up to an extremum the other guards are monotone, and the sign of a guard at the
extremum, as accurate as the integration, shows whether it has a root before.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .implicit import step_to_root

#: The values of all guards at a time, and their rates of change.
Guards = tuple[Array, Array]
#: A root is found to this fraction of the step.
NEAREST = 5e-13
#: A guard this small at the start is rounding of numbers of size one: the orbit has just left it.
JUST_LEFT = 5e-16
#: Steps after which a bracket is halved in every other step, and most steps of a search.
TRIALS, MOST = 8, 100


def first_root(
    guards: Callable[[Array], Guards], at_start: Guards, end: Array, at_end: Guards, extrema: int
) -> tuple[Array, Array]:
    """The time in (0, end] at which a guard first vanishes, and the number of that guard.

    guards: gives all of them at a time; the last `extrema` of them are extrema. Where none is
    negative at the end the number is -1, and the time is the end.
    """
    numbers = jnp.arange(at_end[0].size)
    is_extremum = numbers >= numbers.size - extrema

    def passed(state):
        _, (values, slopes), _, known = state
        # Negative by rounding and rising: the orbit is about to become positive in this guard, as
        # where a boundary lies so near to an extremum that rounding exchanged their order.
        leaves = (values > -JUST_LEFT) & (slopes > 0)
        return (values < 0) & ~leaves & ~known

    def earlier(state):
        end, at_end, _, known = state
        candidates = passed(state)
        extremum = candidates & is_extremum
        candidates = jnp.where(jnp.any(extremum), extremum, candidates)
        number = jnp.argmin(jnp.where(candidates, at_end[0], jnp.inf))
        end, at_end = _root(guards, numbers == number, at_start, end, at_end)
        return end, at_end, number, known | (numbers == number)

    start = (end, at_end, jnp.asarray(-1), jnp.zeros(numbers.shape, dtype=bool))
    end, _, number, _ = lax.while_loop(lambda state: jnp.any(passed(state)), earlier, start)
    return end, number


def _root(guards, which: Array, at_start: Guards, end: Array, at_end: Guards):
    """The root of one guard in (0, end], and all guards there, by the Illinois method.

    At 0 the guard may vanish, or be negative by rounding, where the orbit has just left it. Trial
    points come from values only: rates of change round differently in a batch than alone, and so
    would the runs.
    """

    def pick(both):
        return tuple(jnp.sum(jnp.where(which, part, 0.0)) for part in both)

    shortest = NEAREST * end
    f_start, _ = pick(at_start)
    f_end, _ = pick(at_end)

    def near(at_c):
        value, slope = pick(at_c)
        return jnp.abs(value) <= jnp.abs(slope) * shortest

    def unfinished(state):
        a, _, b, _, _, _, at_c, count = state
        return (count == 0) | ((b - a > 2 * shortest) & ~near(at_c) & (count < MOST))

    def improve(state):
        a, fa, b, fb, left, _, _, count = state
        halved = (count > TRIALS) & (count % 2 == 0)
        c = jnp.where(halved, 0.5 * (a + b), (a * fb - b * fa) / (fb - fa))
        # Not nearer to an end than this: if that end is the root, the other then closes in at once.
        c = jnp.clip(c, a + shortest, b - shortest)
        at_c = guards(c)
        value, _ = pick(at_c)
        inside = value > 0
        # The value at an end that stays for the second time is halved.
        fa, fb = jnp.where(left < 0, 0.5, 1.0) * fa, jnp.where(left > 0, 0.5, 1.0) * fb
        return (
            jnp.where(inside, c, a),
            jnp.where(inside, value, fa),
            jnp.where(inside, b, c),
            jnp.where(inside, fb, value),
            jnp.where(inside, 1, -1),
            c,
            at_c,
            count + 1,
        )

    f_start = jnp.where(f_start > JUST_LEFT, f_start, -f_end)
    start = (jnp.zeros_like(end), f_start, end, f_end, 0, end, at_end, 0)
    *_, c, at_c, _ = lax.while_loop(unfinished, improve, start)
    return c + step_to_root(*pick(at_c), where=near(at_c)), at_c
