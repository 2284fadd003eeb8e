"""Basin fractions along a parameter: how much of a box of starts each attractor attracts.

`basin_fractions` is basin stability (P. J. Menck, J. Heitzig, N. Marwan, J. Kurths, How basin
stability complements the linear-stability paradigm, Nature Physics 9 (2013) 89-92) of each
attractor at each of many values of a parameter, the attractors matched from value to value, as
global continuation does it (G. Datseris, K. Luiz Rossi, A. Wagemakers, Framework for global
stability analysis of dynamical systems, Chaos 33 (2023) 073151). The values are data of one
compiled program, that of `sweep` for attractors.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..activity import announced, note_progress
from ..checks import as_positive, as_whole, check_key, outside_of_traces
from ..cycles.attractors import MAYBE_SAME, Runs, distance, error_of_runs, place_of
from ..cycles.cycle import cycle_from
from ..dimensions import EXTENT
from ..model.equilibria import equilibria
from ..model.oscillator import Oscillator, refuse_clock
from ..model.own_units import quantity, rescaled
from ..model.variations import Variation, as_span, varied
from ..numerics.spacing import evenly_spaced
from ..results import Status, draw
from ..tables import table_of
from .attractor import CYCLE, EQUILIBRIUM, KINDS, STUCK_FOR_EVER, UNDECIDED, Attractor
from .basins import as_box, rest_reached, standard_error, starts_in
from .grid import Grid
from .question import LONG_ENOUGH, settings_of_runs
from .shares import numbers_of_attractors

if TYPE_CHECKING:
    import pandas

#: Largest number of runs that are done at once, unless one value has more: results are in memory.
MOST_AT_ONCE = 2**20
#: Default of `moves`, as a part of the extent of the box and all attractors.
MOVES = 0.25
#: A cycle attracts if its multiplier is below 1 by more than this, which is beyond rounding.
ATTRACTS = 1e-9
#: Number of cycles without a stick phase that are examined at one value, those with most runs
#: first: cycles beyond these are a continuum, with a run or two on each.
MOST_CYCLES = 50
#: Smallest part of a parameter step by which an attractor that moves too far is followed.
SMALLEST_PART = 1 / 64
#: Place of an attractor and its dimensions: smallest and largest x1 and x2, and the period of a
#: loop.
PLACE = EXTENT | {"period": "time"}


class BasinFractions(eqx.Module):
    """Fractions of starts by attractor, along a parameter; what `basin_fractions` returns.

    Attributes:
        values: Values of the parameter, increasing, [values].
        attractors: Names such as "equilibrium 0" and "cycle 1", in the order in which they are met
            along the parameter; of those met at one value, the one with the largest fraction first.
        fractions: Fractions of the starts that lead to each attractor, [values, attractors], 0
            where none does.
        standard_errors: sqrt(f (1 - f) / n), [values, attractors]. It is 0 where f is 0 or 1; an
            attractor that none of the n starts met has a fraction below 3/n, with a confidence of
            95 per cent.
        undecided: Fractions of starts whose attractor is not known, [values]. This includes starts
            that go to infinity, and all starts where the oscillator is impossible.
        x1_min: Smallest x1 of each attractor, [values, attractors], NaN where it is not met; for a
            segment that holds the mass for ever its end.
        x1_max: Largest x1, likewise.
        x2_min: Smallest x2, likewise.
        x2_max: Largest x2, likewise.
        period: Periods of cycles, else NaN, [values, attractors].
        n: Number of starts at each value.
        name: Name of the parameter: its path, or the name of the function's argument.
        is_argument: Whether `name` is that of a function's argument.
    """

    values: np.ndarray
    attractors: tuple[str, ...] = eqx.field(static=True)
    fractions: np.ndarray
    standard_errors: np.ndarray
    undecided: np.ndarray
    x1_min: np.ndarray = eqx.field(metadata=quantity("length"))
    x1_max: np.ndarray = eqx.field(metadata=quantity("length"))
    x2_min: np.ndarray = eqx.field(metadata=quantity("velocity"))
    x2_max: np.ndarray = eqx.field(metadata=quantity("velocity"))
    period: np.ndarray
    n: int
    name: str = eqx.field(static=True)
    is_argument: bool = eqx.field(static=True, default=False)

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each value and each attractor that is met there, and for undecided
        starts.

        Columns: value (of the parameter), attractor, fraction, standard_error, x1_min, x1_max,
        x2_min, x2_max, period (NaN at rest).
        """
        names = [*self.attractors, "undecided"]
        fractions = np.column_stack([self.fractions, self.undecided])
        errors = np.column_stack([self.standard_errors, standard_error(self.undecided, self.n)])
        rows, which = np.nonzero(fractions)
        nothing = np.full(len(self.values), np.nan)
        return table_of(
            {
                "value": self.values[rows],
                "attractor": np.array(names, object)[which],
                "fraction": fractions[rows, which],
                "standard_error": errors[rows, which],
                **{
                    column: np.column_stack([getattr(self, column), nothing])[rows, which]
                    for column in PLACE
                },
            },
            PLACE,
        )

    def plot(self, ax: Any = None) -> Any:
        """Draws the fractions over the parameter as bands, one on top of the other.

        Between values with the same attractors the edges of the bands are straight; where an
        attractor comes or goes they end half-way. Grey along an edge: two standard errors.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        ends = f"{self.values[0]:.6g} to {self.values[-1]:.6g}"
        names = ", ".join(self.attractors) or "no attractor"
        text = f"{len(self.values)} values, {self.n} starts each: {names}"
        most = np.max(self.undecided)
        more = f"; up to {most:.1%} undecided" if most > 0 else ""
        return f"BasinFractions({self.name} from {ends}, {text}{more})"


@announced("basin_fractions")
@outside_of_traces
def basin_fractions(
    osc: Oscillator | Callable[..., Oscillator],
    where: Callable[[Oscillator], Any] | None = None,
    span: tuple[float, float] | None = None,
    *,
    box: Any,
    n: int = 10_000,
    key: Array,
    rows: int = 50,
    moves: float | None = None,
    t1: ArrayLike = LONG_ENOUGH,
    rtol: ArrayLike = 1e-8,
    atol: ArrayLike | None = None,
) -> BasinFractions:
    """Fraction of a box of starts that leads to each attractor, against one parameter.

    At each value attractors are distinguished as by `attractors`; equilibria and the segments on
    which a mass is stuck for ever are identified with a row of `equilibria`.

    From one value to the next an attractor keeps its name if it is of one kind (equilibrium, cycle,
    stuck) and its smallest and largest x1 and x2 have moved by no more than `moves`. Of several
    ways to pair attractors, the one is taken that leaves the fewest alone, and of these the one
    with the least sum of the largest of the four moves. So a cycle that comes to stick to another
    belt keeps its name. An attractor without a partner is compared in the same way with those that
    were met before, where they were met last: a small basin may have no start in it at a value in
    between. An attractor that moves by more in one step, as a cycle on a steep branch may, is
    followed through values in between, from the state in which it was: it keeps its name if it gets
    to an unpaired one without such a move in less than a 64th of the step. An attractor that jumps
    counts as two, one that ends and one that begins. Too large a value of `moves` joins attractors
    that only lie near to one another.

    Only attractors that starts lead to are found: one with a basin that no start is in is not seen.
    Starts on closed orbits that do not attract, such as those around a centre, are undecided, and
    so are those that go to infinity, where the damping is negative. Of cycles that do not stick the
    50 with the most starts are examined at a value; where there are more, starts that lead to
    others are undecided, too.

    Args:
        osc: An oscillator, or a function of the parameter that returns it, as for `scan`.
        where: Selects the parameter that varies, as for `scan`; None with a function.
        span: First and last value of the parameter.
        box: ((x1 from, to), (x2 from, to)), dimensionless.
        n: Number of starts at each value, drawn uniformly and anew for each.
        key: Random key, from `jax.random.key`.
        rows: Number of values of the parameter, evenly spaced.
        moves: How far an attractor may move from one value to the next, in x1 or x2. None: a
            quarter of the extent of the box and the attractors at all values, in x1 or x2,
            whichever is longer.
        t1: Time at which a run ends that has reached no attractor.
        rtol: Relative tolerance of a step.
        atol: Absolute tolerance of a step; None: 1e-8 of the oscillator's own size.

    Returns:
        The `BasinFractions`.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    first, last = as_span(osc, where, span)
    corners, n, rows = as_box(box), as_whole(n, "n"), as_whole(rows, "rows", 2)
    check_key(key)
    numbers = settings_of_runs(t1, rtol, atol)
    moves = None if moves is None else as_positive(moves, "moves")
    given = varied(osc, where, (first,))
    instead = "jb.sweep with axes x1 and x2"
    refuse_clock(given.oscillator(np.array([first])), "basin_fractions", instead)
    # The runs are made in own units.
    variation = given.over(first, last)
    values = evenly_spaced(first, last, rows)
    starts = [starts_in(corners, n, jax.random.fold_in(key, row)) for row in range(rows)]
    length, (unit,) = variation.own.length, variation.own.parameters
    if numbers["atol"] is not None:
        numbers["atol"] /= float(length)
    found = _found_along(variation, values / unit, np.stack(starts) / length, numbers)
    longest = _longest(corners / length, found)
    moves = MOVES * longest if moves is None else moves / float(length)
    fractions = _matched(found, values / unit, moves, n, variation)
    return replace(rescaled(fractions, length), values=values)


def _longest(corners: np.ndarray, found: list[list["_Met"]]) -> float:
    """The longer side of the extent of a box and all attractors."""
    sides = [corners, *(one.place[:4].reshape(2, 2) for met in found for one in met)]
    low, high = np.min(sides, axis=(0, 2)), np.max(sides, axis=(0, 2))
    return float(np.max(high - low))


class _Met(NamedTuple):
    """An attractor at one value: code of its kind, its place (as `PLACE`), and its fraction of
    the starts."""

    kind: int
    place: np.ndarray
    fraction: float


def _found_along(
    variation: Variation, values: np.ndarray, starts: np.ndarray, numbers: dict[str, Any]
) -> list[list[_Met]]:
    """Attractors at each value that its starts, [values, 2, n], lead to, the largest fraction
    first."""
    grid = Grid(lambda parameter: variation.make(parameter), {"parameter": values}, (0.0, 0.0))
    n = starts.shape[2]
    error = error_of_runs(numbers, 1.0)
    found: list[list[_Met]] = []
    step = max(1, MOST_AT_ONCE // n)
    for first in range(0, len(values), step):
        part = starts[first : first + step]
        states = np.moveaxis(part, 1, 0).reshape(2, -1)
        which = first + np.repeat(np.arange(len(part)), n)
        results = grid.results(Attractor(), states, which, **numbers)
        note_progress("telling the attractors apart")
        for row in range(len(part)):
            here = {name: column[row * n : (row + 1) * n] for name, column in results.items()}
            value = values[first + row : first + row + 1]
            found.append(_attractors_met(variation, value, here, error))
    return found


def _attractors_met(
    variation: Variation, value: np.ndarray, results: dict[str, np.ndarray], error: float
) -> list[_Met]:
    """Attractors of the runs at a value, [1], the largest fraction first.

    results: the results of `Attractor` by name, [runs, ..] each.
    """
    # Codes of runs that are not finite are NaN.
    kinds = np.nan_to_num(results["kind"]).astype(int)
    if np.all(kinds == UNDECIDED):
        return []
    osc = variation.oscillator(value)
    places = np.nan_to_num(np.stack([results[name] for name in PLACE], axis=1))
    rest, segment, ends = rest_reached(osc, 0.5 * (places[:, 0] + places[:, 1]))
    rests, stuck = kinds == EQUILIBRIUM, kinds == STUCK_FOR_EVER
    places[rests, 0] = places[rests, 1] = rest[rests]
    if len(ends):
        places[stuck, :2] = ends[segment[stuck]]
    sticks = np.nan_to_num(results["sticks"]).astype(int)
    runs = Runs(places, results["signature"], error)
    kinds[_closed_only(osc, (kinds == CYCLE) & ~np.any(sticks, axis=1), runs)] = UNDECIDED
    held = np.column_stack([sticks, segment])
    labels = numbers_of_attractors(kinds[None], held[None], runs.at((None,)), lambda _: osc)[0]
    met = []
    for number in range(int(np.max(labels)) + 1):
        of_it = labels == number
        one = int(np.argmax(of_it))
        met.append(_Met(int(kinds[one]), places[one], float(np.mean(of_it))))
    return sorted(met, key=lambda one: -one.fraction)


def _closed_only(osc: Oscillator, smooth: np.ndarray, runs: Runs) -> np.ndarray:
    """Mask [runs] of runs that end on a closed orbit that does not attract.

    smooth: mask of runs that end on a cycle that does not stick (one that sticks attracts); a cycle
    that was not examined counts as one that does not attract.
    """
    closed, remaining = np.zeros_like(smooth), smooth.copy()
    tops, reach = runs.places[:, 1], runs.error * np.ptp(runs.places[:, :4], axis=1)
    others = np.sort(tops[smooth])
    beside = np.searchsorted(others, tops + reach) - np.searchsorted(others, tops - reach)
    for _ in range(MOST_CYCLES):
        if not np.any(remaining):
            return closed
        first = int(np.argmax(np.where(remaining, beside, -1)))
        same = remaining & runs.same(runs.at(first))[0]
        same[first] = True
        cycle = cycle_from(osc, jnp.asarray(np.array([runs.places[first, 1], 0.0])))
        attracts = int(cycle.status) == Status.OK and abs(float(cycle.multiplier)) < 1 - ATTRACTS
        closed |= same & (not attracts)
        remaining &= ~same
    return closed | remaining


def _matched(
    found: list[list[_Met]], values: np.ndarray, moves: float, n: int, variation: Variation
) -> BasinFractions:
    """The `BasinFractions` of attractors found at each value, matched from value to value."""
    names: list[str] = []
    last: list[_Met] = []  # the attractors, each where it was met last
    numbers: list[list[int]] = []  # for each value the numbers of its attractors in `names`
    for row, met in enumerate(found):
        just_before = numbers[-1] if numbers else []
        pairs = _partners([last[k] for k in just_before], met, moves)
        here = {i: just_before[j] for i, j in pairs.items()}
        for known in just_before:
            alone = [i for i in range(len(met)) if i not in here]
            if known in here.values() or all(met[i].kind != last[known].kind for i in alone):
                continue
            there = _followed_to(variation, values[row - 1 : row + 1], last[known], moves)
            here |= {i: known for i in alone if there is not None and _is_at(met[i], there)}
        missed = [k for k in range(len(last)) if k not in just_before]
        new = [i for i in range(len(met)) if i not in here]
        pairs = _partners([last[k] for k in missed], [met[i] for i in new], moves)
        here |= {new[i]: missed[j] for i, j in pairs.items()}
        for i, one in enumerate(met):
            if i not in here:
                here[i] = len(names)
                kind = KINDS[one.kind]
                names.append(f"{kind} {sum(name.startswith(kind) for name in names)}")
                last.append(one)
            last[here[i]] = one
        numbers.append([here[i] for i in range(len(met))])
    fractions = np.zeros((len(found), len(names)))
    places = np.full((len(PLACE), *fractions.shape), np.nan)
    for row, met in enumerate(found):
        for number, one in zip(numbers[row], met, strict=True):
            fractions[row, number] = one.fraction
            places[:, row, number] = one.place
            if one.kind != CYCLE:
                places[-1, row, number] = np.nan
    # Fractions are multiples of 1/n; rounding to these leaves no error of the sum.
    undecided = np.round(n * (1 - np.sum(fractions, axis=1))) / n
    columns = dict(zip(PLACE, places, strict=True))
    errors = standard_error(fractions, n)
    return BasinFractions(
        values,
        tuple(names),
        fractions,
        errors,
        undecided,
        **columns,
        n=n,
        name=variation.names[0],
        is_argument=not variation.varies_leaves,
    )


def _followed_to(variation: Variation, way: np.ndarray, one: _Met, moves: float) -> _Met | None:
    """Follows an attractor from the first of two values to the second.

    Returns the attractor there, or None if it moves by more than `moves` in a SMALLEST_PART of the
    way.
    """
    done, part = 0.0, 0.5
    while done < 1:
        to = min(1.0, done + part)
        value = (1 - to) * way[:1] + to * way[1:]
        there = _seeded(variation.oscillator(value), one)
        if there is not None and _move_between(one, there) <= moves:
            done, one = to, there
        elif part > SMALLEST_PART:
            part /= 2
        else:
            return None
    return one


def _seeded(osc: Oscillator, one: _Met) -> _Met | None:
    """The attractor of `osc` that continues the attractor `one` of another oscillator, or None.

    A cycle is searched from the state (largest x1, 0) of the other one; of stable equilibria the
    nearest is taken.
    """
    place = np.zeros(len(PLACE))
    if one.kind == CYCLE:
        cycle = cycle_from(osc, jnp.asarray(np.array([one.place[1], 0.0])))
        if int(cycle.status) != Status.OK or not bool(cycle.stable):
            return None
        place = place_of(cycle)
    elif one.kind == EQUILIBRIUM:
        rests = equilibria(osc)
        x1 = np.asarray(rests.x1)[np.asarray(rests.stable) & ~np.isnan(rests.rate)]
        if not x1.size:
            return None
        place[:2] = x1[np.argmin(np.abs(x1 - one.place[0]))]
    else:
        return None
    return _Met(one.kind, place, one.fraction)


def _is_at(one: _Met, other: _Met) -> bool:
    """Whether two attractors of one kind, at one value, are at one place."""
    is_beside = distance(one.place[:4], other.place[:4], least=1.0) < MAYBE_SAME
    return one.kind == other.kind and bool(is_beside)


def _partners(before: list[_Met], met: list[_Met], moves: float) -> dict[int, int]:
    """Pairs {index in met: index in before} of attractors, see `basin_fractions`."""
    from scipy.optimize import linear_sum_assignment  # late, as only this needs it

    if not before or not met:
        return {}
    far = np.array([[_move_between(one, other) for other in before] for one in met])
    fits = far <= moves
    # A pair that does not fit costs more than all pairs that do.
    rows, columns = linear_sum_assignment(np.where(fits, far, 1 + moves * (1 + far.size)))
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {i: j for i, j in pairs if fits[i, j]}


def _move_between(one: _Met, other: _Met) -> float:
    """Largest change of the four extrema of x1 and x2; inf between different kinds."""
    if one.kind != other.kind:
        return np.inf
    return float(np.max(np.abs(one.place[:4] - other.place[:4])))
