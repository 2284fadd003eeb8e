"""Parameters that an inverse problem may change, and their bounds."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..activity import note_progress
from ..checks import as_numbers, require, require_value
from ..model.oscillator import Oscillator, has_clock, waves_of
from ..model.parameters import leaf_groups, names_of
from ..model.variations import Variation

#: Largest number of damped Newton steps, and the longest step in the variables u of `Selection`.
ITERATIONS, LONGEST_CHANGE = 40, 0.4
#: Bisections by which the end of an interval of possible values is found.
BISECTIONS = 40
#: Smallest size of a parameter, in its own unit; used where its value is nearer to zero.
SMALLEST = 0.1


class Selection(eqx.Module):
    """Parameters of an oscillator: the leaves that each one sets, and bounds.

    Each parameter is a function of an unbounded variable u: lower + unit exp(u) or upper - unit
    exp(-u) with one bound, a logistic function of u between two bounds, and size u without bounds.
    unit is the parameter's own, see `Variation.in_own_units`. stretch: factors, [p], by which u is
    multiplied first; None: 1.
    """

    leaves: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    lower: Array
    upper: Array
    size: Array
    unit: Array
    stretch: Array | None = None

    def values(self, u: Array) -> Array:
        u = u if self.stretch is None else u * self.stretch
        has_lower, has_upper = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        low, high = jnp.where(has_lower, self.lower, 0.0), jnp.where(has_upper, self.upper, 0.0)
        unit = self.unit
        one_sided = jnp.where(has_lower, low + unit * jnp.exp(u), high - unit * jnp.exp(-u))
        between = low + (high - low) * jax.nn.sigmoid(u)
        bounded = jnp.where(has_lower & has_upper, between, one_sided)
        return jnp.where(has_lower | has_upper, bounded, self.size * u)

    def unbounded(self, values: ArrayLike) -> Array:
        """The inverse of `values`: u for values within the bounds, [p]."""
        has_lower, has_upper = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        above = jnp.log(jnp.where(has_lower, (values - self.lower) / self.unit, 1.0))
        below = -jnp.log(jnp.where(has_upper, (self.upper - values) / self.unit, 1.0))
        u = jnp.where(has_lower | has_upper, above + below, values / self.size)
        return u if self.stretch is None else u / self.stretch

    def put(self, osc: Oscillator, values: Array) -> Oscillator:
        """The oscillator with the parameters set to these values."""
        leaves, structure = jax.tree.flatten(osc)
        for i, numbers in enumerate(self.leaves):
            for leaf in numbers:
                leaves[leaf] = values[i]
        return jax.tree.unflatten(structure, leaves)


def progress_reporter(report: Callable[[str], None] | None) -> Callable[[str], None]:
    """Returns a function that passes lines on to the progress display and to `report`.

    Raises a `ValueError` if `report` cannot be called.
    """

    fits = report is None or callable(report)
    require_value(fits, "report", "a function of a text, such as print, or None", report)

    def both(text: str) -> None:
        note_progress(text.strip())
        if report is not None:
            report(text)

    return both


def selection_of(
    osc: Oscillator, where: Callable, bounds, until: float | None = None
) -> tuple[Selection, np.ndarray]:
    """The parameters that `where` selects, and their u.

    A parameter is a leaf, or a tuple of leaves that are kept equal. until: the time up to which the
    forcing matters. It scales the u of frequencies and phases: a change of u by 1 shifts no wave by
    more than a radian up to that time.
    """
    groups, leaves = leaf_groups(osc, where), jax.tree.leaves(osc)
    named = names_of(osc)
    names = tuple(" = ".join(named[leaf] for leaf in group) for group in groups)
    values = np.array([float(leaves[group[0]]) for group in groups])
    pairs = []
    for group, name, value, pair in zip(
        groups, names, values, _pairs_of(bounds, names), strict=True
    ):
        lower, upper = _interval(osc, group, groups) if pair is None else pair
        require(np.isfinite(value), name, "finite, as a guess", f"{value:.12g}")
        inside = f"inside of its bounds ({lower:.12g}, {upper:.12g})"
        require(lower < value < upper, name, inside, f"{value:.12g}")
        pairs.append((lower, upper))
    lower, upper = jnp.asarray(pairs).T
    units = own_units_of(osc, names)
    size = jnp.asarray(parameter_sizes(values, units))
    selection = Selection(groups, names, lower, upper, size, jnp.asarray(units))
    u = selection.unbounded(jnp.asarray(values))
    if until is not None and has_clock(osc):
        shifts = _shifts(osc, selection, u, until)
        stretch = 1 / jnp.where(shifts > 0, shifts, 1.0)
        selection, u = replace(selection, stretch=stretch), u / stretch
    return selection, np.asarray(u)


def _shifts(osc: Oscillator, selection: Selection, u: Array, until: float) -> Array:
    """The largest shift of a wave of the forcing up to a time, in radians per unit of u, [p]."""

    def angles(u):
        waves = waves_of(selection.put(osc, selection.values(u)))
        phases = [getattr(wave, "phase", jnp.zeros(())) for wave in waves]
        return jnp.stack([until * wave.frequency for wave in waves] + phases)

    return jnp.max(jnp.abs(jax.jacfwd(angles)(u)), axis=0)


def parameter_sizes(values: ArrayLike, units: ArrayLike) -> np.ndarray:
    """Sizes of parameters, [p]: |value|, but SMALLEST times the parameter's own unit at least."""
    return np.maximum(np.abs(np.asarray(values)), SMALLEST * np.asarray(units))


def own_units_of(osc: Oscillator, names: Sequence[str]) -> np.ndarray:
    """Change of each parameter that changes the oscillator in its own units by 1; a power of two.

    names: as in `Selection`.
    """
    named, leaves, units = names_of(osc), jax.tree.leaves(osc), []
    for name in names:
        leaf = named.index(name.partition(" = ")[0])
        variation = Variation.of_leaves(osc, [leaf])
        known = variation.in_own_units(np.array([float(leaves[leaf])])).own
        units.append(float(known.parameters[0]))
    return np.array(units)


def _pairs_of(bounds: Any, names: Sequence[str]) -> list[tuple[float, float] | None]:
    """Checks `bounds`; returns a pair or None for each parameter."""
    if bounds is None:
        return [None] * len(names)
    many = "one (lower, upper) or None" + " for each" * (len(names) > 1)
    expected = f"a list with {many} of {', '.join(names)}"
    fits = isinstance(bounds, Sequence | np.ndarray) and not isinstance(bounds, str)
    fits = fits and len(bounds) == len(names)
    fits = fits and all(pair is None or np.shape(pair) == (2,) for pair in bounds)
    require_value(fits, "bounds", expected, bounds)
    pairs: list[tuple[float, float] | None] = []
    for name, pair in zip(names, bounds, strict=True):
        if pair is not None:
            field = f"bounds of {name}"
            lower, upper = (float(end) for end in as_numbers(pair, field, (2,)))
            require_value(lower < upper, field, "(lower, upper), lower < upper", (lower, upper))
            pair = lower, upper
        pairs.append(pair)
    return pairs


def _interval(
    osc: Oscillator, group: Sequence[int], groups: Sequence[Sequence[int]]
) -> tuple[float, float]:
    """The interval of values of the leaves of a group, kept equal, that the oscillator's checks
    allow with the leaves of the other groups unchanged, shifted alike, or scaled alike, and all
    other leaves unchanged. Exact where it ends at 0, at another leaf, or at the negative of one."""
    leaves, structure = jax.tree.flatten(osc)
    known = np.array([float(leaf) for leaf in leaves if np.ndim(leaf) == 0])
    value = float(leaves[group[0]])
    marks = np.append(np.abs(known[np.isfinite(known)]), 0.0)
    marks = np.unique(np.append(-marks, marks))

    others = {leaf for one in groups for leaf in one} - set(group)

    def passes(number, moved):
        given = list(leaves)
        for leaf in others:
            given[leaf] = jnp.asarray(moved(float(leaves[leaf])))
        for leaf in group:
            given[leaf] = jnp.asarray(number)
        try:
            jax.tree.unflatten(structure, given).check()
        except ValueError:
            return False
        return True

    def is_possible(number):
        ratio = number / value if value else 1.0
        ways = (lambda x: x), (lambda x: x + number - value), (lambda x: x * ratio)
        return any(passes(number, moved) for moved in ways[: 3 if others else 1])

    def end(sign):
        ahead = np.sort(sign * marks[sign * marks >= sign * value])
        inside = sign * value
        for outside in (0.5 * (ahead + np.append(ahead[1:], ahead[-1:] + 2.0))).tolist():
            if not is_possible(sign * outside):
                break
            inside = outside
        else:
            return sign * np.inf
        for _ in range(BISECTIONS):
            middle = 0.5 * (inside + outside)
            inside, outside = (middle, outside) if is_possible(sign * middle) else (inside, middle)
        nearest = float(marks[np.argmin(np.abs(marks - sign * outside))])
        is_mark = abs(nearest - sign * outside) <= 2.0 ** (2 - BISECTIONS) * (1 + abs(nearest))
        return nearest if is_mark else sign * inside

    return end(-1.0), end(1.0)
