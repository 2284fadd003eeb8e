"""Variations: oscillators as functions of one or two parameters, for diagrams, scans and fits.

A `Variation` gives the oscillator at each value of one parameter, or of two. It is made from an
oscillator and `where`, which selects its leaves, or from a function that returns the oscillator;
its users need not know which. Compiled programs are handed a `Family`: oscillators that are linear
in the parameters, their leaves and slopes as data, so that one program serves every parameter and
every function. Where a function is not linear, a problem is solved in the family that is tangent to
it at a guess, then in the family that is tangent at the solution, and so on, until the family and
the function have the same oscillator there (`Variation.relinearised`): Newton's method once more.
"""

import functools
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer

from ..checks import as_interval, is_concrete, require, require_callable, require_value
from ..numerics.compiling import depends, is_affine, is_outermost
from .families import Family
from .oscillator import (
    NoEdge,
    Oscillator,
    check_oscillator,
    check_scalars,
    frequencies,
    has_clock,
    has_edges,
    interval_ends,
    its_oscillator,
    refuse_clock,
)
from .own_units import OwnOscillator, in_own_units, own_length, power_of_two_below
from .parameters import is_number, is_real, leaf_index, names_of

#: Numbers that differ by less than this times 1 + their size are equal up to rounding.
ROUNDING = 1e-14
#: Largest difference, over 1 + size, of the numbers of an oscillator from those that it is to have.
SAME_NUMBER = 1e-9
#: Most linearisations of a nonlinear function. Each squares the distance: 1e-1, 1e-2, 1e-4, 1e-8,
#: 1e-16. Inside a trace, where convergence cannot be tested, always TRACED_PASSES are made.
PASSES, TRACED_PASSES = 12, 5
#: Number of parameter values between which zeros of velocities and meetings of edges are sought;
#: zeros nearer to each other than MERGED count as one.
VALUES_SEEN, MERGED = 257, 1e-7
#: Number of tangents of a function after which tangents are compiled, which takes a few tenths of a
#: second; an uncompiled tangent of a machine in SI units takes some 20 ms.
OFTEN = 64
#: Guesses along each parameter in `Variation.values_of`.
GUESSES = 9


#: In messages: what the span of a parameter of a forced oscillator has to be.
WITH_A_CLOCK = "without the frequency 0, at which a force is constant"
#: In messages: what varies a parameter only of oscillators without a clock.
VARIED = "this diagram, scan or set of fractions"
#: In messages: what to use with forcing instead.
FOR_FORCED = "jb.bifurcation_diagram(...) of a branch, jb.orbit_diagram or jb.sweep"


def _at_parameters(line: Family, *p: Any) -> Oscillator:
    return line.at(jnp.stack(p))


@dataclass(frozen=True)
class Variation:
    """Oscillators as a function of one parameter or two.

    make: returns the oscillator at given parameters; names: names of the parameters; line: the
    `Family` of all these oscillators if they are linear in the parameters, else None; tangents:
    tangent families found so far, by the parameters' values. varies_leaves: whether the parameters
    are leaves of an oscillator, not arguments of a function. units: own units of the variation;
    None: the user's.
    """

    make: Callable[..., Oscillator]
    names: tuple[str, ...]
    line: Family | None
    tangents: dict[tuple[float, ...], Family] = field(default_factory=dict)
    varies_leaves: bool = False
    units: "UnitsOfVariation | None" = None

    @classmethod
    def of_leaves(cls, osc: Oscillator, numbers: Sequence[int]) -> "Variation":
        """An oscillator in which the leaves with these numbers are varied."""
        leaves, structure = jax.tree.flatten(osc)
        slopes: list[Any] = [None] * len(leaves)
        for place, leaf in enumerate(leaves):
            if is_number(leaf):
                slopes[place] = np.array([float(number == place) for number in numbers])
                if place in numbers:
                    leaves[place] = jnp.asarray(np.zeros(()))
                elif not isinstance(leaf, jax.Array):
                    leaves[place] = jnp.asarray(np.float64(leaf))
        line = Family(jax.tree.unflatten(structure, leaves), tuple(slopes), np.zeros(len(numbers)))
        named = names_of(osc)
        names = tuple(named[number] for number in numbers)
        return cls(functools.partial(_at_parameters, line), names, line, varies_leaves=True)

    @classmethod
    def of_function(
        cls,
        make: Callable[..., Oscillator],
        values: Sequence[Any],
        argument: str = "osc",
        *,
        forced: bool = False,
    ) -> "Variation":
        """The oscillators that a function returns; values: possible values of its arguments, [k].

        `ValueError`, naming `argument`, for a function of other arguments or results, for one that
        JAX cannot differentiate, and where an argument makes no difference.
        """
        words = ("", "one number", "two numbers")[len(values)]
        expected = f"a function of {words} that returns an Oscillator"
        make, names = _by_position(make, len(values), argument, expected)

        def numbers(*p):
            osc = make(*p)
            kind = "a number" if isinstance(osc, Tracer) else type(osc).__name__
            came = f"one that returns {kind}{its_oscillator(osc, 'return')}"
            require(isinstance(osc, Oscillator), argument, expected, came)
            check_scalars(osc)
            if not forced:
                refuse_clock(osc, VARIED, FOR_FORCED)
            leaves = jax.tree.leaves(osc)
            return [jnp.asarray(leaf) for leaf in leaves if is_real(leaf)]

        try:
            for place in range(len(values)):
                rest = [*values[:place], *values[place + 1 :]]

                def one(p, rest=rest, place=place):
                    return numbers(*rest[:place], p, *rest[place:])

                came = f"one whose argument {names[place]} makes no difference"
                require(any(depends(one, 0.0)), argument, expected, came)
            found = cls(make, names, None)
            if is_affine(numbers, len(values)):
                return cls(make, names, found._tangent(np.zeros(len(values))))
            found._tangent(values)
        except (TypeError, jax.errors.JAXTypeError) as error:
            came = str(error).partition("\n")[0]
            raise ValueError(
                f"{argument} must be {expected}, made of what JAX can differentiate (jnp.sqrt, "
                f"say, not math.sqrt), got {type(error).__name__}: {came}"
            ) from error
        return found

    def _tangent(self, values: Any) -> Family:
        """The `Family` that is tangent to the function at `values`, [k]."""
        structure, rest = None, []

        def numbers(*p):
            nonlocal structure, rest
            leaves, structure = jax.tree.flatten(self.make(*p))
            is_one = [is_real(leaf) for leaf in leaves]
            rest = [None if one else leaf for leaf, one in zip(leaves, is_one, strict=True)]
            pairs = zip(leaves, is_one, strict=True)
            return [jnp.asarray(leaf, dtype=jnp.float64) for leaf, one in pairs if one]

        values = np.asarray(values) if is_concrete(values) else jnp.stack([*values])
        at = tuple(jnp.asarray(value) for value in values)
        tangents, leaves = [], []
        for place in range(len(at)):
            along = tuple(jnp.asarray(np.float64(place == i)) for i in range(len(at)))
            leaves, tangent = jax.jvp(numbers, at, along)
            tangents.append(tangent)
        pack: Any = np if is_concrete(tangents) else jnp
        slopes = iter([pack.stack(rows) for rows in zip(*tangents, strict=True)])
        found = iter(leaves)
        whole = [next(found) if other is None else other for other in rest]
        return Family(
            jax.tree.unflatten(structure, whole),
            tuple(next(slopes) if other is None else None for other in rest),
            values,
        )

    @functools.cached_property
    def _compiled_tangent(self) -> Callable[[Any], Family]:
        return eqx.filter_jit(lambda values: self._tangent(values))

    def family(self, values: Any) -> Family:
        """The `Family` of the variation itself if this is linear, else the family that is tangent
        at `values`, [k]."""
        if self.line is not None:
            return self.line
        if not is_concrete(values):
            return self._tangent(values)
        place = tuple(np.asarray(values).tolist())
        if place not in self.tangents:
            is_often_asked = len(self.tangents) >= OFTEN
            tangent = self._compiled_tangent if is_often_asked else self._tangent
            self.tangents[place] = tangent(np.asarray(values))
        return self.tangents[place]

    def oscillator(self, values: Any) -> Oscillator:
        """The oscillator at these values, [k]; not checked, it may be impossible."""
        if self.line is not None:
            return self.line.at(values)
        row = tuple(np.asarray(values).tolist()) if is_concrete(values) else None
        if row in self.tangents:
            return self.tangents[row].oscillator
        if row is not None and not np.all(np.isfinite(row)):
            # A user's function would refuse such values.
            shapes = eqx.filter_eval_shape(self.make, *(jnp.asarray(value) for value in values))
            return jax.tree.map(
                lambda leaf: jnp.full(leaf.shape, jnp.nan) if hasattr(leaf, "shape") else leaf,
                shapes,
            )
        made = self.make(*(jnp.asarray(value) for value in values))
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.float64) if is_real(x) else x, made)

    def oscillators(self, rows: np.ndarray) -> Oscillator:
        """The oscillators at many values [rows, k], as one whose leaves have a row for each."""
        if self.line is None:
            return eqx.filter_vmap(self.make)(*(jnp.asarray(column) for column in rows.T))
        return self.line.rows(rows)

    def coincidences(self, first: float, last: float) -> dict[float, list[tuple[int, ...]]]:
        """Parameter values in [first, last] at which two belts with a load run at one velocity, or
        one is at rest: dictionary from these values to the belts' numbers, pairs first."""
        belts = range(len(self.oscillator(np.array([first])).belts))
        which = [*combinations(belts, 2), *((belt,) for belt in belts)]
        velocities = [[(belt, "velocity") for belt in some] for some in which]
        return self._zeros_of(velocities, first, last)

    def meetings(self, first: float, last: float) -> dict[float, list[tuple[int, ...]]]:
        """As `coincidences`, values at which contact edges of two belts with a load meet. The ends
        first and last count only if there can be an oscillator beyond: otherwise an edge may have
        come there from where it cannot be."""
        belts = self.oscillator(np.array([first])).belts
        ends = [
            [(number, name) for name in ("lower", "upper") if np.isfinite(getattr(belt, name))]
            for number, belt in enumerate(belts)
        ]
        which = [pair for two in combinations(ends, 2) for pair in product(*two)]
        found = self._zeros_of(which, first, last)
        little = MERGED * (1 + last - first)
        beyond = {first: first - little, last: last + little}
        return {
            value: belts
            for value, belts in found.items()
            if value not in beyond or self._is_possible(beyond[value])
        }

    def _is_possible(self, value: float) -> bool:
        try:
            self.check(value)
        except ValueError:
            return False
        return True

    def _zeros_of(
        self, which: Sequence[Sequence[tuple[int, str]]], first: float, last: float
    ) -> dict[float, list[tuple[int, ...]]]:
        """Parameter values in [first, last] at which two numbers (belt, name) of belts with a load
        are equal, or one number is zero: dictionary from these values to the belts' numbers."""
        found: dict[float, list[tuple[int, ...]]] = {}
        for some in which:
            line, belts = self.line, tuple(belt for belt, _ in some)
            zeros = self._zeros(some, first, last) if line is None else line.zeros(some)
            for value in zeros:
                if not first <= value <= last:
                    continue
                osc = self.oscillator(np.array([value]))
                if not all(float(osc.belts[belt].load) for belt in belts):
                    continue
                near = (one for one in found if self.line is None and abs(one - value) < MERGED)
                here = found.setdefault(next(near, value), [])
                if belts not in here:
                    here.append(belts)
        return found

    def _zeros(self, which: Sequence[tuple[int, str]], first: float, last: float) -> list[float]:
        """As `Family.zeros`, between two values of the parameter of a nonlinear variation."""
        from scipy.optimize import brentq, minimize_scalar  # late, as only functions need them

        def difference(osc):
            numbers = [np.asarray(getattr(osc.belts[belt], name)) for belt, name in which]
            return numbers[0] - numbers[1] if len(which) == 2 else numbers[0]

        def at(value):
            return float(difference(self.oscillator(np.array([value]))))

        rows = np.linspace(first, last, VALUES_SEEN)
        v = difference(self.oscillators(rows[:, None]))
        if np.all(v == v[0]):
            return []
        zeros = rows[v == 0].tolist()
        for k in np.flatnonzero(v[:-1] * v[1:] < 0):
            root: Any = brentq(at, rows[k], rows[k + 1], xtol=ROUNDING)
            zeros.append(float(root))
        size = np.abs(v)
        # Zeros at which the sign does not change.
        inner = (size[1:-1] <= size[:-2]) & (size[1:-1] < size[2:]) & (v[:-2] * v[2:] > 0)
        for k in 1 + np.flatnonzero(inner & (v[1:-1] != 0)):
            ends = rows[k - 1], rows[k + 1]
            least = minimize_scalar(lambda p: abs(at(p)), bounds=ends, options={"xatol": ROUNDING})
            if least.fun < MERGED**2:
                zeros.append(float(least.x))
        return zeros

    def check(self, *values: float) -> None:
        """Raise a `ValueError` where the oscillator at these values is impossible."""
        if self.line is None:
            Oscillator.check(self.make(*map(np.float64, values)))
        else:
            Oscillator.check(self.line.at(np.array(values)))

    def check_clock(self, span: Sequence[float]) -> None:
        """Raises a `ValueError` if a force is constant at an end of a span of one parameter."""
        made = [self.oscillator(np.array([value])) for value in span]
        fine = all(has_clock(osc) and all(map(bool, frequencies(osc))) for osc in made)
        require(fine, "span", WITH_A_CLOCK, tuple(map(float, span)))

    def held(self, axis: int, value: float) -> "Variation":
        """The variation by one of two parameters, with the parameter `axis` fixed at `value`."""
        free = 1 - axis
        pair = np.zeros(2)
        pair[axis] = value
        line = None
        if self.line is not None:
            pair[free] = self.line.origin[free]
            slopes = tuple(slope if slope is None else slope[[free]] for slope in self.line.slopes)
            line = Family(self.line.at(pair), slopes, self.line.origin[[free]])

        def make(p):
            return self.make(*(p if place == free else value for place in (0, 1)))

        units = None
        if self.units is not None:
            known = self.units
            given = known.given.held(axis, value * known.parameters[axis])
            units = known._replace(given=given, parameters=known.parameters[[free]])
        return Variation(make, (self.names[free],), line, units=units)

    def measured_in(self, units: Any) -> "Variation":
        """The same variation with its parameters measured in these units, [k]."""
        if is_concrete(units) and np.all(units == 1.0):
            return self
        line = None
        if self.line is not None:
            slopes = [s if s is None else (s.T * units).T for s in self.line.slopes]
            line = Family(self.line.oscillator, tuple(slopes), self.line.origin / units)

        def make(*p):
            return self.make(*(unit * one for unit, one in zip(units, p, strict=True)))

        known = self.units
        if known is not None:
            known = known._replace(parameters=known.parameters * units)
        return replace(self, make=make, line=line, tangents={}, units=known)

    @property
    def own(self) -> "UnitsOfVariation":
        """The units of a variation that is in own units; `units` is None for any other."""
        assert self.units is not None
        return self.units

    def in_own_units(self, *rows: Any) -> "Variation":
        """The same oscillators in one unit of length, and the parameters in units of their own.

        rows: values of the parameters, [k] each; of several the first is where the parameters'
        units are taken, the others are the ends of what is varied. The unit of length is the
        largest own unit of the oscillators at these ends (or at the one row). The unit of a
        parameter is the change of it that changes a number of the oscillator at the first row by
        one, rounded down to a power of two.
        """
        if self.units is not None:
            return self
        # The first of several rows is left out: an oscillator between the ends may be impossible.
        ends = rows[1:] or rows
        lengths = [own_length(self.oscillator(values)) for values in ends]
        one: Any = np if is_concrete(lengths) else jnp
        return self.in_units(functools.reduce(one.maximum, lengths), rows[0], ends)

    def in_units(self, length: Any, values: Any, ends: Sequence[Any] = ()) -> "Variation":
        """As `in_own_units`, with a given unit of length; the units of the parameters are taken at
        `values`, [k].

        ends: values at which the oscillators are possible; none: `values`.
        """
        edges = any(self._may_have_edges(possible) for possible in ends or (values,))

        def make(*p):
            return in_own_units(self.make(*p), length, edges=edges)

        own = Variation(make, self.names, None, varies_leaves=self.varies_leaves)
        if self.line is not None:
            if not _varies_omega(self.line):
                # Still linear, because the units are fixed.
                own = replace(own, line=own._tangent(np.asarray(self.line.origin)))
        units = [power_of_two_below(unit) for unit in own.family(values).units]
        pack: Any = np if is_concrete(units) else jnp
        units = pack.stack(units)
        return replace(own.measured_in(units), units=UnitsOfVariation(self, length, units, edges))

    def over(self, first: float, last: float) -> "Variation":
        """`in_own_units` between two values of the one parameter; a `ValueError` where the
        oscillator at one of them is impossible."""
        for value in (first, last):
            self.check(value)
        return self.in_own_units(*np.array([[0.5 * (first + last)], [first], [last]]))

    def _may_have_edges(self, values: Any) -> bool:
        """Whether any of the oscillators may have a contact edge; values: possible ones, [k]."""
        if self.line is not None:
            slopes = jax.tree.unflatten(jax.tree.structure(self.line.oscillator), self.line.slopes)
            ends = [row for row in interval_ends(slopes) if not isinstance(row, NoEdge)]
            vary = [not is_concrete(row) or bool(np.any(row)) for row in ends]
            return any(vary) or has_edges(self.line.oscillator)
        if not is_concrete(values):
            return True

        def bounds(*p):
            return [jnp.asarray(edge) for edge in interval_ends(self.make(*p))]

        return any(depends(bounds, *values)) or has_edges(self.make(*values))

    def rest_of(self, belt: int, start: float) -> float:
        """The value of the only parameter, near `start`, at which a belt is at rest."""
        value = float(start)
        for _ in range(PASSES):
            before, (value,) = value, self.family(np.array([value])).zeros([(belt, "velocity")])
            if not abs(value - before) > ROUNDING:
                break
        return value

    def relinearised(
        self, attempt: Callable[[Family, Any], tuple[Any, Any]], unknowns: Any
    ) -> tuple[Any, Any]:
        """Result of an attempt in the family that is tangent at its own solution, and whether the
        family and the variation agree there.

        attempt: function of a family and of the unknowns to begin from, the last of which are the
        parameters, [k]; returns its result and the unknowns at the solution.
        """
        if self.line is not None:
            return attempt(self.line, unknowns)[0], True
        family, found = self.family(unknowns[-1]), None
        if not is_outermost(family, unknowns):

            def again(unknowns, _):
                fixed = lax.stop_gradient(self.family(unknowns[-1]))
                return lax.stop_gradient(attempt(fixed, unknowns)[1]), None

            unknowns, _ = lax.scan(again, unknowns, length=TRACED_PASSES - 1)
            family = self.family(unknowns[-1])
            found, (*_, p) = attempt(family, unknowns)
            return found, _agree(*lax.stop_gradient((family.at(p), self.oscillator(p))))
        for _ in range(PASSES):
            found, unknowns = attempt(family, unknowns)
            values = np.asarray(unknowns[-1])
            if not np.all(np.isfinite(values)):
                break
            before, family = family, self.family(values)
            if _agree(before.at(values), family.oscillator):
                return found, True
        return found, False

    def values_of(self, osc: Oscillator, span: np.ndarray, start: Any = None) -> np.ndarray | None:
        """The parameters, [k], at which the variation gives `osc`; None if it never does.

        span: the first and last value of each parameter, [k, 2], between which they are sought;
        start: a guess, [k], or None. By the method of Gauss and Newton.
        """
        if jax.tree.structure(osc) != jax.tree.structure(self.oscillator(span[:, 0])):
            return None
        wanted = _numbers(osc)

        def misses(values):
            own = _numbers(self.oscillator(values))
            with np.errstate(invalid="ignore"):
                return np.where(own == wanted, 0.0, wanted - own)

        guesses = [start]
        if self.line is not None:
            guesses = [self.line.origin]
        elif start is None:
            inner = [np.linspace(a, b, GUESSES + 2)[1:-1] for a, b in span]
            guesses = [np.array(one) for one in product(*inner)]
        values = min(guesses, key=lambda one: np.nan_to_num(np.sum(misses(one) ** 2), nan=np.inf))
        for _ in range(PASSES):
            slopes = [one for one in self.family(values).slopes if one is not None]
            matrix = np.concatenate([np.reshape(one, (len(values), -1)) for one in slopes], axis=1)
            missing = misses(values)
            square, side = matrix @ matrix.T, matrix @ np.where(np.any(matrix, 0), missing, 0.0)
            if not np.linalg.cond(square) < 1 / ROUNDING:
                return None
            change = np.linalg.solve(square, side)
            values = values + change
            if np.max(np.abs(change)) < ROUNDING:
                break
        found = np.all(np.abs(misses(values)) <= SAME_NUMBER * (1 + np.abs(wanted)))
        return values if found else None


class UnitsOfVariation(NamedTuple):
    """Own units of a variation. given: the variation in the user's units; length: unit of length,
    parameters: units of the parameters, [k], both in the user's units. edges: whether any
    oscillator may have a contact edge."""

    given: Variation
    length: Any
    parameters: Any
    edges: bool

    def of(self, osc: Oscillator) -> OwnOscillator:
        """An oscillator, as the user has it, in these units."""
        return in_own_units(osc, self.length, edges=self.edges)


def _varies_omega(line: Family) -> bool:
    slopes = jax.tree.unflatten(jax.tree.structure(line.oscillator), line.slopes)
    return not is_concrete(slopes.omega) or bool(np.any(slopes.omega))


def as_span(osc: Any, where: Any, span: Any) -> tuple[float, float]:
    """The span of a parameter. `ValueError` for a wrong `where` first: if `where` was left out, the
    span may stand in its place."""
    if isinstance(osc, Oscillator):
        leaf_index(osc, where)
    numbers = isinstance(where, tuple | list | np.ndarray) and len(where) == 2
    if span is None and numbers and not any(map(callable, where)):
        first, last = where
        require(False, "span", f"given by its name, span=({first}, {last})", "it as where")
    return as_interval(span, "span")


def varied(osc: Any, where: Any, values: Sequence[Any], *, forced: bool = False) -> Variation:
    """The `Variation` by one parameter that a public function was given: an oscillator and `where`,
    or a function alone, or a `Variation`. values: a possible value of the parameter, [1]."""
    if isinstance(osc, Variation):
        return osc
    if callable(osc) and not isinstance(osc, Oscillator):
        alone = "left out where osc is a function of the parameter"
        require_value(where is None, "where", alone, where)
        make: Any = osc
        return Variation.of_function(make, values, forced=forced)
    check_oscillator(osc)
    if not forced:
        refuse_clock(osc, VARIED, FOR_FORCED)
    return Variation.of_leaves(osc, [leaf_index(osc, where)])


def _by_position(make: Any, count: int, argument: str, expected: str):
    """`make` as a function of `count` numbers by position, and the names of its arguments."""
    require_callable(make, argument, expected)
    try:
        signature = inspect.signature(make)
    except (TypeError, ValueError):
        return make, ("p", "q")[:count]
    given = [one for one in signature.parameters.values() if one.kind not in _ANY_NUMBER]
    free = [one.name for one in given if one.default is one.empty]
    if len(free) == count and any(one.kind == one.KEYWORD_ONLY for one in given):
        # Such as functools.partial(jb.presets.class_c, nu1=0.3).
        return lambda *p: make(**dict(zip(free, p, strict=True))), tuple(free)
    try:
        signature.bind(*[0.0] * count)
    except TypeError:
        came = ", ".join(signature.parameters)
        require(False, argument, expected, f"one of ({came})")
    return make, tuple([*(one.name for one in given), "p", "q"][:count])


_ANY_NUMBER = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def _numbers(osc: Oscillator) -> np.ndarray:
    """All numbers of an oscillator in one array."""
    leaves = [np.ravel(x) for x in jax.tree.leaves(osc) if is_real(x)]
    return np.concatenate(leaves)


def _agree(osc: Oscillator, other: Oscillator) -> Any:
    """Whether two oscillators are the same but for rounding."""
    one: Any = np if is_concrete((osc, other)) else jnp
    agree: Any = True
    with np.errstate(invalid="ignore"):
        for a, b in zip(*map(jax.tree.leaves, (osc, other)), strict=True):
            if is_real(a):
                a, b = one.asarray(a), one.asarray(b)
                agree &= one.all((a == b) | (one.abs(a - b) <= ROUNDING * (1 + one.abs(b))))
    return agree
