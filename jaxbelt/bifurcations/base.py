"""The base of all bifurcation conditions, `AbstractCondition`, and its result, `BifurcationPoint`.

A condition is one more equation, in one more unknown: the parameter. It is written so that the
whole system is regular at the point, which "stick duration of the cycle = 0" is not: solved for the
cycle at every parameter, the duration goes like a square root and Newton's method fails. In the
unknowns of fixed-signature shooting (see `cycles`) the same equation is harmless.

Each kind is one class that carries everything about it: its theory; a guess and the system of
equations that Newton's method solves from there, which also judges the solution; the changes of
labels along a path that it could explain; the functions to watch along its curve, and where the
curve ends; its names and its line in pictures. `refine`, `scan`, `bifurcation_curve`, the diagrams
and the pictures call these methods and distinguish no kinds. What conditions on a cycle have in
common is in `conditions`, what those on a state of rest have in `rests`.

The numbers in a condition, such as its belt, are arguments of the compiled programs, so one program
serves all values: in `guess` and `prepared` they are arrays. A field that decides which program
runs is static.
"""

import abc
import inspect
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..checks import check_belt, is_concrete, number, require, require_value
from ..cycles.attractors import PLACE_DIMENSIONS, place_of
from ..cycles.chains import SIZES, Chain, Loop, blank_loop
from ..cycles.cycle import Cycle
from ..model.families import Family
from ..model.oscillator import Oscillator, has_clock, has_possible_numbers
from ..model.own_units import in_own_units, quantity, rescaled
from ..model.variations import Variation
from ..results import Status, describe, draw
from ..tables import require_single, table_of
from .beside import Side
from .labels import AttractingCycle, Label
from .special import SpecialPoint, Trail
from .systems import NOWHERE, AbstractSystem, Solution, judged_by

if TYPE_CHECKING:
    import pandas


#: Explanations of the arguments of conditions, for error messages.
ARGUMENTS = {
    "belt": " (the number of a belt, such as 0)",
    "belts": " (the numbers of two belts, such as (0, 1))",
}


class Line(NamedTuple):
    """Style of the curves of a kind: name in legends, colour, line style as of Matplotlib."""

    name: str
    colour: str
    style: str | tuple[float, tuple[float, ...]] = "-"


def check_conditions(conditions: Any, field: str = "conditions") -> tuple["AbstractCondition", ...]:
    """`conditions` as a tuple, or a `ValueError`."""
    expected = "a tuple of conditions, such as (jb.Hopf(),)"
    is_many = isinstance(conditions, Iterable) and not isinstance(conditions, str | dict)
    require_value(is_many, field, expected, conditions)
    conditions = tuple(conditions)
    for one in conditions:
        require_value(isinstance(one, AbstractCondition), field, expected, one)
    return conditions


def check_two_belts(belts: Any) -> None:
    """Raises a `ValueError` unless `belts` are the numbers of two belts."""
    two = isinstance(belts, tuple | list) and len(set(belts)) == len(belts) == 2
    require_value(two, "belts", "two different numbers, such as (0, 1)", belts)


class AbstractCondition(eqx.Module):
    """A condition that holds at a bifurcation point."""

    #: Caption of a point in a diagram, with {belt} for the number of the belt; "": name of the
    #: class.
    caption: ClassVar[str] = ""
    #: Style of the curves of the kind; an empty name stands for the name of the class.
    line: ClassVar[Line] = Line("", "black", (0, (1, 1)))
    #: Name of the group of kinds that may alternate along one curve; "": this kind alone.
    group: ClassVar[str] = ""
    #: Whether orbits near a point converge slowly, so that labels are compared farther from it.
    slow: ClassVar[bool] = False
    #: Whether several such points may lie near one guess, in different arcs or of other cycles.
    has_several: ClassVar[bool] = False
    #: Whether branches of a diagram continue through a point.
    joins: ClassVar[bool] = True
    #: Whether its curve ends where the signature changes, or where its state of rest vanishes.
    ends_at_contact: ClassVar[bool] = False
    #: Whether its curve bends sharply before its limit, so that rows are needed close to the limit.
    bends: ClassVar[bool] = False

    def __new__(cls, *args: Any, **given: Any):
        signature = inspect.signature(cls)
        try:
            signature.bind(*args, **given)
        except TypeError as error:
            takes = " and ".join(name + ARGUMENTS.get(name, "") for name in signature.parameters)
            raise TypeError(f"{cls.__name__}() takes {takes or 'nothing'}: {error}") from None
        return super().__new__(cls)

    def __reduce__(self):  # without arguments `__new__` would refuse
        return object.__new__, (type(self),), vars(self)

    @property
    def belts_concerned(self) -> tuple[int, ...]:
        """Numbers of the belts concerned: those in its field `belt`, or `belts`."""
        belt = getattr(self, "belt", None)
        return getattr(self, "belts", ()) if belt is None else (belt,)

    @property
    def lineage(self) -> tuple[str, tuple[int, ...]]:
        """What is constant along a curve: the name of the group or the class, and the belts."""
        return self.group or type(self).__name__, self.belts_concerned

    @property
    def words(self) -> str:
        """Caption of a point in a diagram."""
        caption = self.caption or type(self).__name__
        return caption.format(belt=" ".join(map(str, self.belts_concerned)))

    @property
    def sought(self) -> "AbstractCondition":
        """The condition to solve where the kind shows only at the solution, see `named`."""
        return self

    def named(self, point: "BifurcationPoint") -> "AbstractCondition":
        """The condition that holds at a solution of `sought`, a point with status OK."""
        return self

    def is_slow_at(self, point: "BifurcationPoint") -> bool:
        """Whether orbits beside this point converge slowly."""
        return self.slow

    def covers(self, point: "BifurcationPoint") -> bool:
        """Whether a point, whose condition is known, is a point of this condition."""
        other = point.condition
        is_pair = type(self) is type(other) and len(self.belts_concerned) == 2
        same_pair = is_pair and set(self.belts_concerned) == set(other.belts_concerned)
        return self == other or same_pair

    def check(self, osc: Oscillator) -> None:
        """Raises a `ValueError` if the oscillator cannot meet the condition."""
        # A field `belt` that is None is checked, too.
        belts = [vars(self)["belt"]] if "belt" in vars(self) else self.belts_concerned
        for belt in belts:
            check_belt(belt, len(osc.belts))
        leaves = jax.tree.leaves(self)
        plain = all(isinstance(leaf, int | float) and np.isfinite(leaf) for leaf in leaves)
        require(plain, "condition", "made of plain finite numbers", self)

    def with_clock(self) -> Any:
        """The same condition for forced oscillators; a `ValueError` where there is none."""
        reason = f"{type(self).__name__} is for oscillators that do not know the time"
        other = "use a condition for forced ones, such as jb.PeriodDoubling()"
        require(False, "osc", f"without a clock: {reason}; {other}", "one with forcing")

    def applied_to(self, osc: Oscillator) -> Any:
        """The condition as an instance of the class that solves it for this oscillator."""
        return self.with_clock() if has_clock(osc) else self

    def as_data(self) -> Any:
        """The same condition with arrays for its numbers, as compiled programs take it."""
        return jax.tree.map(lambda leaf: jnp.asarray(np.array(leaf)), self)

    # --- a point ---

    @property
    def room(self) -> int:
        """Number of arcs that a loop of the guess has room for."""
        return SIZES[0]

    @abc.abstractmethod
    def guess(self, osc: Oscillator, size: int) -> Any:
        """The guess from which Newton's method starts, any pytree.

        It is called on the condition as data, see `as_data`, and may return a loop of a cycle, a
        state of rest, or whatever `prepared` takes. Where nothing can serve as a guess, the status
        of `prepared` says so. size: room for the arcs of a loop.
        """

    @abc.abstractmethod
    def prepared(self, osc: Oscillator, guess: Any) -> tuple[AbstractSystem, Any, Array]:
        """The system near a guess, its unknowns there, and a status.

        guess: what `guess` returned; osc: the oscillator of the guess. The unknowns are the x of
        the system; the status is OK, or says why there is no guess.
        """

    @abc.abstractmethod
    def point_near(
        self, family: Family, system: Any, x: Any, p: Any, status: Array
    ) -> tuple["BifurcationPoint", tuple[Any, Array]]:
        """The point near a guess (x, p) in a family of oscillators, and the solution (x, p).

        system, x, status: from `prepared`; p: the parameter, [1]. The condition of the point is
        `UNNAMED`; its status is that of `prepared` where that was not OK.
        """

    def solve(
        self, variation: Variation, osc: Oscillator, value: Any, guess: Any
    ) -> "BifurcationPoint":
        """The point near a guess, its condition `UNNAMED`; osc: the oscillator at value, [1]."""
        system, x, status = self.prepared(osc, guess)

        def attempt(family, unknowns):
            x, p = unknowns
            return self.point_near(family, system, x, p, status)

        point, agrees = variation.relinearised(attempt, (x, value))
        if agrees is True and is_concrete(osc):
            return point
        # Inside a trace no earlier check has refused impossible numbers.
        possible = has_possible_numbers(osc)
        fails = (point.status == Status.OK) & ~(jnp.asarray(agrees) & possible)
        numbers = ("value", "residual", "error", "multiplier")
        known = {name: jnp.where(fails, jnp.nan, getattr(point, name)) for name in numbers}
        status = jnp.where(fails, Status.NO_CONVERGENCE.value, point.status)
        status = jnp.where(possible, status, Status.NOT_FINITE.value)
        return replace(point, **known, status=status)

    def point(
        self, variation: Variation, osc: Oscillator, value: Any, size: int
    ) -> "BifurcationPoint":
        """The point found from the oscillator `osc`, at the parameter `value`, [1]."""
        data = self.as_data()
        return replace(data.solve(variation, osc, value, data.guess(osc, size)), condition=self)

    def named_point_from(
        self, variation: Variation, value: float, beginning: Any = None
    ) -> "BifurcationPoint | None":
        """The point found from this value of the parameter, with its kind named; None if it fails.

        beginning: one of `beginnings`; None: the condition's own guess.
        """
        point = self.point_from(variation, value, beginning)
        if int(point.status) != Status.OK:
            return None
        return replace(point, condition=self.sought.named(point))

    def named_point_beside(
        self, variation: Variation, value: float, osc: Oscillator, system: Any, x: Any
    ) -> "BifurcationPoint | None":
        """Like `named_point_from`, where a neighbouring point is known: its oscillator, its system,
        and the unknowns x of the system."""
        return self.named_point_from(variation, value)

    def point_from(
        self, variation: Variation, value: float, beginning: Any = None
    ) -> "BifurcationPoint":
        """Like `named_point_from`, but with the condition `UNNAMED`, and with any status."""
        data, start = self.sought.as_data(), np.array([value])
        osc = variation.oscillator(start)
        guess = data.guess(osc, data.room) if beginning is None else data.guess_near(beginning)
        return data.solve(variation, osc, start, guess)

    def guess_near(self, beginning: Any) -> Any:
        """The guess from a known motion, one of `beginnings`."""
        raise NotImplementedError

    # --- on a path ---

    @classmethod
    def between(
        cls, before: Label, after: Label, edged: Sequence[int]
    ) -> Sequence["AbstractCondition"]:
        """Conditions of this kind that could explain the difference between two labels.

        edged: belts with load and a finite contact edge, one for each set of shared edges.
        """
        return ()

    @classmethod
    def at_coincidence(cls, belts: tuple[int, ...]) -> Sequence["AbstractCondition"]:
        """Conditions that could hold where one belt is at rest, or two belts have one velocity."""
        return ()

    @classmethod
    def at_meeting(
        cls, belts: tuple[int, ...], before: Label, after: Label
    ) -> Sequence["AbstractCondition"]:
        """Conditions that could explain a difference where contact edges of two belts meet."""
        return ()

    @classmethod
    def of_unstable_cycles(cls, edged: Sequence[int]) -> Sequence["AbstractCondition"]:
        """Conditions that could explain a difference between the modes of two unstable cycles."""
        return ()

    def mark(self, osc: Oscillator, cycles: Sequence[Loop]) -> Hashable:
        """Part of a label: a value that changes where the condition holds.

        cycles: loops of the attracting cycles, in order.
        """
        return None

    def beginnings(self, osc: Oscillator, cycles: Sequence[AttractingCycle]) -> Sequence[Any]:
        """Motions to start from, such as loops of the attracting cycles; None: the own `guess`."""
        return (None,)

    def values(self, a: float, b: float) -> Sequence[float]:
        """Values of the parameter to start from if the condition may hold between a and b."""
        return a, b

    # --- along a curve ---

    @abc.abstractmethod
    def system_at(self, point: "BifurcationPoint") -> tuple[AbstractSystem, Any]:
        """The system to follow from a point, and its unknowns there."""

    def kind_along(self, osc: Oscillator, multiplier: float) -> type["AbstractCondition"]:
        """The kind that holds at a point of the curve of this condition."""
        return type(self)

    def limit(self, trail: Trail) -> SpecialPoint | None:
        """The special point, if near, in which its curve ends as the motion ceases to exist."""
        return None

    def place(self, point: "BifurcationPoint") -> np.ndarray:
        """Place of the motion at a point, see `place_of`; NaN where there is none."""
        return place_of(point.cycle) if int(point.cycle.status) == Status.OK else NOWHERE

    def type_of(self, point: "BifurcationPoint") -> str:
        """Type of a point, "" for a kind with one type."""
        return ""

    def coefficient(self, point: "BifurcationPoint") -> Array:
        """For a kind at which a cycle is born: the coefficient whose sign decides on which side."""
        return jnp.asarray(jnp.nan)

    def orbit(self, point: "BifurcationPoint") -> np.ndarray | None:
        """States of the motion at a point that is no cycle, [samples, 2]; None if there is none."""
        return None


class BifurcationPoint(eqx.Module):
    """A bifurcation point; what `refine` returns.

    Attributes:
        condition: The condition that holds there.
        value: Value of the parameter; NaN where the status is not OK, unless only the kind is
            unknown.
        residual: Largest error in the defining equations.
        iterations: Number of Newton steps.
        steps: Lengths of the Newton steps, NaN padded.
        error: A bound on `|value - exact value|`, from the same equations with every integration
            step halved, and rounding.
        multiplier: For `NonsmoothFold` and `GrazingSliding`, multiplier of the cycle on the side
            where it does not stick to the belt; else NaN.
        x1: Displacement of the mass at rest, where the equations determine it; else NaN.
        oscillator: The oscillator at the point.
        cycle: The cycle at the point. Where there is none, its status says why (at a Hopf point it
            has shrunk to the equilibrium, at `SuddenSliding` its period is infinite).
        status: A `Status` code.
        member: Number of the state of rest, as its condition counts them.
        sides: For a change that no condition explains, the `Side` below the value and the one
            above it; else ().
    """

    condition: AbstractCondition = eqx.field(static=True)
    value: Array
    residual: Array
    iterations: Array
    steps: Array
    error: Array
    multiplier: Array
    x1: Array = eqx.field(metadata=quantity("length"))
    oscillator: Oscillator
    cycle: Any
    status: Array
    member: ArrayLike = 0
    sides: tuple[Side, ...] = ()

    @property
    def _own(self) -> "BifurcationPoint":
        """The point in the oscillator's own units, in which its condition works."""
        own = in_own_units(self.oscillator)
        if own is self.oscillator:
            return self
        return rescaled(self, 1 / own.units.length, lambda _: own)

    def _back(self, value: Any, *dimensions: str) -> Any:
        """A result of the condition for `_own`, converted to the units of the point."""
        own = in_own_units(self.oscillator)
        return value if own is self.oscillator else own.units.back(value, *dimensions)

    @property
    def kind(self) -> str:
        """Name of the condition."""
        return type(self.condition).__name__

    @property
    def type(self) -> str:
        """Type of the point within its kind.

        "supercritical" or "subcritical" for `Hopf` and `PseudoHopf`: the cycle that is born
        attracts or repels ("degenerate": the coefficient is zero, or the fixed point lies on a
        contact edge, where there is no coefficient). "persistence" or "annihilation" for
        `BoundaryEquilibrium`: there is an equilibrium on both sides of the point, or two meet and
        vanish ("degenerate": another equilibrium lies there, too). "crossing" or "buckling" for
        `CrossingSliding`: a stick phase ceases to exist, or the boundary is crossed once more
        before it ("jump": the orbit goes far beyond the boundary at once). "homoclinic" or
        "heteroclinic" for `SaddleConnection`: it leads back to the same saddle or to another one.
        "" where the kind has one type, or no point was found.
        """
        require_single(self, self.value, 0)
        return self._solved.type_of(self._own) if int(self.status) == Status.OK else ""

    @property
    def coefficient(self) -> Array:
        """The coefficient a of `Hopf` and `PseudoHopf`, with derivatives by parameters.

        The amplitude r of small oscillations, of x1 around a fixed point, of x2 at the edge around
        a pseudo-focus, obeys r' = rate r + a r^3, with the `rate` of `Equilibria`. So near the
        point there is a cycle with r^2 = -rate/a, which attracts where a < 0. NaN for other kinds,
        and at a fixed point on a contact edge.
        """
        found = self._back(self._solved.coefficient(self._own), "coefficient")
        return jnp.where(self.status == Status.OK, found, jnp.nan)

    @property
    def _solved(self) -> AbstractCondition:
        return self.condition.applied_to(self._own.oscillator)

    @property
    def place(self) -> np.ndarray:
        """Place of the motion, see `place_of`; NaN where there is none."""
        return self._back(self._solved.place(self._own), *PLACE_DIMENSIONS)

    @property
    def orbit(self) -> np.ndarray | None:
        """States of the motion at a point that is no cycle, [samples, 2]; None if there is none."""
        states = self._solved.orbit(self._own)
        return None if states is None else self._back(states, "length", "velocity")

    def row(self) -> dict[str, Any]:
        """The row of the point in `table`."""
        require_single(self, self.value, 0)
        place = self.place if int(self.status) == Status.OK else NOWHERE
        *extent, period = np.where(place == 0, [0, 0, 0, 0, np.nan], place)  # none at equilibria
        return {
            "kind": self.kind,
            "belts": " ".join(map(str, self.condition.belts_concerned)),
            "type": self.type,
            **{name: float(getattr(self, name)) for name in ("value", "error", "residual")},
            "iterations": int(self.iterations),
            **dict(zip(("x1_min", "x1_max", "x2_min", "x2_max"), extent, strict=True)),
            "period": period,
            "multiplier": float(self.multiplier),
            "coefficient": float(self.coefficient),
            "status": Status(int(self.status)).name,
        }

    def table(self) -> "pandas.DataFrame":
        """Returns one row.

        Columns: kind, belts, type, value, error, residual, iterations, x1_min, x1_max, x2_min,
        x2_max and period of the motion there, multiplier, coefficient, status. For the points of a
        scan use `pandas.concat`.
        """
        return table_of([self.row()])

    def plot(self, ax: Any = None) -> Any:
        """Draws the phase plane at the point, with the cycle where there is one.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.

        Raises:
            ValueError: If no point was found.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        if not is_concrete(self.value) or self.value.ndim:
            return f"BifurcationPoint({self.condition!r}, value={self.value.shape})"
        if int(self.status) != Status.OK:
            name, advice = Status(int(self.status)).name, describe(self.status)
            if self.sides:
                below, above = self.sides
                advice = f"{advice} Below, {below!r}; above, {above!r}."
            elif "jb.scan" not in advice:
                advice += " Every bifurcation point in an interval is found by jb.scan."
            # Where only the kind is unknown, the value is known up to `error`.
            value, error = f"value {number(self.value)}", float(self.error)
            value = f"{value}, error < {error:.1e}" if np.isfinite(error) else value
            return f"BifurcationPoint({self.condition!r}, {value}, {name}: {advice})"
        sort = f"{self.type}, " if self.type else ""
        return (
            f"BifurcationPoint({self.condition!r}, {sort}value {number(self.value)}, "
            f"residual {float(self.residual):.1e}, {int(self.iterations)} iterations, "
            f"error < {float(self.error):.1e})"
        )


def given_point(point: BifurcationPoint, variation: Variation) -> BifurcationPoint:
    """A point that was found in own units, converted to the units of the given variation."""
    if variation.units is None:
        return point
    given, length, (unit,), _ = variation.units
    value = point.value * unit
    osc = given.oscillator(np.asarray(value)[None] if is_concrete(value) else value[None])
    found = rescaled(replace(point, sides=()), length, lambda _: osc)
    sides = tuple(_given_side(side, variation) for side in point.sides)
    return replace(found, value=value, error=point.error * unit, sides=sides)


def _given_side(side: Side, variation: Variation) -> Side:
    given, length, (unit,), _ = variation.own
    value = side.value * unit
    osc = given.oscillator(np.asarray(value)[None])
    return replace(rescaled(side, length, lambda _: osc), value=value)


class Unexplained(AbstractCondition):
    """The motions change and no other condition explains it; only `scan` returns such points.

    The point's `sides` say what there is below its value and above, and how far apart the branches
    are that end there, see `Side`. Under a law that falls within a hundredth of the
    belt's velocity the end of stick-slip is such a point: the fold in which a sticking cycle ends
    is squeezed together with a canard.
    """

    caption: ClassVar[str] = "unexplained"

    def guess(self, osc, size):
        raise ValueError("condition must be one that can be refined, got Unexplained()")

    def prepared(self, osc, guess):
        raise NotImplementedError

    def point_near(self, family, system, x, p, status):
        raise NotImplementedError

    def system_at(self, point):
        raise ValueError(f"point must be of a kind that has curves, got {self!r}")


#: Condition of points from compiled programs: a named one would be a constant of the program.
UNNAMED = Unexplained()


def point_of(
    family: Family, solution: Solution, cycle: Any, multiplier: Array, status: Array
) -> BifurcationPoint:
    """The point of a solution, NaN where the status is not OK."""
    status = judged_by(solution.error, family, status)
    point = _point_at(family, solution, status)
    return replace(point, multiplier=multiplier * _where_known(status), cycle=cycle)


def _where_known(status: Array) -> Array:
    """1, or NaN where there is no point: a factor, so that derivatives are NaN there, too."""
    return jnp.where(status == Status.OK, 1.0, jnp.nan)


def _point_at(family: Family, solution: Solution, status: Array) -> BifurcationPoint:
    """The point of a solution, without a cycle."""
    known, none = _where_known(status), jnp.asarray(jnp.nan)
    return BifurcationPoint(
        condition=UNNAMED,
        value=solution.p[0] * known,
        residual=solution.residual * known,
        iterations=solution.iterations,
        steps=solution.steps,
        error=solution.error * known,
        multiplier=none,
        x1=none,
        oscillator=family.at(solution.p * known),
        cycle=None,
        status=status,
    )


def point_without_cycle(
    family: Family, p, steps, size, error, status, why, x1: ArrayLike = jnp.nan
) -> BifurcationPoint:
    """A point at p without a cycle; why: the reason; x1: displacement of the mass at rest."""
    solution = Solution(jnp.zeros(0), p, steps, jnp.sum(~jnp.isnan(steps)), size, error, status)
    point = _point_at(family, solution, status)
    loop, none = blank_loop(SIZES[0], len(point.oscillator.belts)), jnp.asarray(jnp.nan)
    chain = Chain(loop.codes, loop.ends, jnp.zeros((SIZES[0], 1)))
    nan = jnp.full((SIZES[0], 3), jnp.nan)
    cycle = Cycle(point.oscillator, chain, nan, none, none, point.iterations, why)
    return replace(point, x1=jnp.asarray(x1) * _where_known(status), cycle=cycle)
