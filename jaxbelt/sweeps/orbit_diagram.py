"""Orbit diagrams: the points of attractors along a path in one parameter, by brute force.

At each of many values of the parameter orbits from a few starts are followed to their attractor,
and its points at some moment (extrema, crossings of a section, events) are kept. Two sweeps do it:
one as with `observe="attractor"`, so that each run takes the transient that it needs, and one that
follows each cycle through one loop, from its largest displacement. The values of the parameter are
data of both: other values compile nothing, so a picture can be zoomed into.

Where each value begins from the attractor of the value before, as in an experiment, the first sweep
does one value after the other, in a kernel of few lanes.
"""

import functools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from ..activity import announced, note_progress
from ..checks import (
    as_finite,
    as_interval,
    as_positive,
    as_tolerance,
    as_whole,
    outside_of_traces,
    require,
    require_one_of,
    require_value,
)
from ..cycles.attractors import RUN
from ..model.forcing import has_amplitude
from ..model.oscillator import (
    Oscillator,
    clock_frequency,
    common_turns,
    has_clock,
    repeating,
    waves_of,
)
from ..model.variations import WITH_A_CLOCK, Variation, as_span, varied
from ..numerics.spacing import evenly_spaced
from ..results import Status, draw
from ..tables import table_of
from .along import Along
from .attractor import CYCLE, EQUILIBRIUM, KINDS, STUCK_FOR_EVER, UNDECIDED, Attractor
from .grid import Grid
from .moments import AtEvents, AtExtrema, AtPhase, AtSection
from .question import LONG_ENOUGH
from .reducers import check_sections
from .strobes import SAME

if TYPE_CHECKING:
    import pandas

#: Number of moments of a loop, extrema of x1 among them, that one run has room for. A loop with
#: more moments takes several runs, each from the last extremum: a start at an event may repeat that
#: event.
MOMENTS_KEPT = 16
#: Largest number of runs for one loop.
MOST_RUNS = 64
#: A run through a loop goes on beyond it by this fraction of the period.
OUTSIDE = 1e-4

#: Forced oscillators: number of periods left out as transient, fewer where a run begins on the
#: attractor of a neighbouring value, and number of points that are kept.
PERIODS_LEFT_OUT, PERIODS_LEFT_OUT_BESIDE, STROBES = 1000, 500, 64
#: Lanes of the kernel where each value begins from the attractor of the value before.
LANES_OF_FEW = 4
#: Distance, in own units, at which such a run begins from an equilibrium or a periodic forced
#: motion: these may have become unstable, and a run that begins on one would stay. A mass stuck for
#: ever begins where it is: else it would creep as the parameter changes.
OFF_ATTRACTOR = 1e-3
#: For each value of `sense`, the sense in which the parameter changes for each start.
SENSES = {"up": ("up",), "down": ("down",), "both": ("up", "down")}
#: Kind of a forced run whose points do not repeat: chaos, a torus, or a slow approach.
NOT_PERIODIC = "no period found"


class OrbitDiagram(eqx.Module):
    """Points of attractors along a parameter; what `orbit_diagram` returns.

    Attributes:
        values: Values of the parameter, increasing, [values].
        kind: Attractor of each start: "equilibrium", "cycle", "stuck" (for ever, to a belt at rest)
            or "undecided", and with forcing "no period found", [values, starts].
        period: Periods of cycles, else NaN, [values, starts].
        status: A `Status` each, [values, starts].
        x1: Points of the attractors, [values, starts, points], dimensionless, NaN where there are
            fewer: of a cycle one for each of its moments, in their order; of a mass at rest its
            place.
        x2: Velocities at these points, likewise.
        at: The moments at which points are kept.
        name: Name of the parameter: its path, or the name of the function's argument.
        sampling: Arguments that `over` uses again.
        is_argument: Whether `name` is that of a function's argument.
    """

    values: np.ndarray
    kind: np.ndarray
    period: np.ndarray
    status: np.ndarray
    x1: np.ndarray
    x2: np.ndarray
    at: Any = eqx.field(static=True)
    name: str = eqx.field(static=True)
    sampling: "Sampling" = eqx.field(static=True, repr=False)
    is_argument: bool = eqx.field(static=True, default=False)

    def over(self, span: tuple[float, float]) -> "OrbitDiagram":
        """The same diagram over another span of the parameter, with as many values: nothing is
        compiled.

        Args:
            span: First and last value of the parameter.

        Returns:
            The new `OrbitDiagram`.

        Raises:
            ValueError: If the oscillator at an end is impossible.
        """
        return self.sampling.diagram(span)

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each point.

        Columns: value (of the parameter), start (its number), kind, period (NaN at rest), x1, x2.
        An undecided start has a row with NaN.
        """
        held = ~np.isnan(self.x1)
        held[..., 0] |= self.kind == KINDS[UNDECIDED]
        rows, starts, _ = np.nonzero(held)
        return table_of(
            {
                "value": self.values[rows],
                "start": starts,
                "kind": self.kind[rows, starts],
                "period": self.period[rows, starts],
                "x1": self.x1[held],
                "x2": self.x2[held],
            },
            {"period": "time", "x1": "length", "x2": "velocity"},
        )

    def plot(self, ax: Any = None, *, quantity: str | None = None, zoom: bool = False) -> Any:
        """Draws the points over the parameter.

        Args:
            ax: Axes; None makes new ones.
            quantity: "x1" or "x2"; None: the one whose extrema the points are, else "x1".
            zoom: Whether the points are computed anew, as by `over`, whenever the limits of the
                parameter change: with the mouse, where the backend of matplotlib is interactive (in
                a notebook `%matplotlib widget`, of the package ipympl), or by `ax.set_xlim`.

        Returns:
            The axes.
        """
        return draw(self, ax, quantity=quantity, zoom=zoom)

    def __repr__(self) -> str:
        counts = Counter(self.kind.ravel().tolist())
        kinds = ", ".join(
            f"{counts[kind]} {kind}" for kind in (*KINDS, NOT_PERIODIC) if counts[kind]
        )
        ends = f"{self.values[0]:.6g} to {self.values[-1]:.6g}"
        return f"OrbitDiagram({self.name} from {ends}, {self.kind.size} runs: {kinds})"


@announced("orbit_diagram")
@outside_of_traces
def orbit_diagram(
    osc: Oscillator | Callable[..., Oscillator],
    where: Callable[[Oscillator], Any] | None = None,
    span: tuple[float, float] | None = None,
    *,
    at: AtExtrema | AtSection | AtEvents | AtPhase | None = None,
    y0: ArrayLike | Sequence[Any] = (3.0, 0.0),
    sense: str | None = None,
    rows: int = 400,
    rtol: ArrayLike = 1e-8,
    atol: ArrayLike | None = None,
) -> OrbitDiagram:
    """Orbit diagram: the points of attractors against one parameter, from given starts.

    There is no transient to choose: each run goes on until its attractor is known, or until t =
    30,000, when it is undecided, with the status NOT_SETTLED and without points. A cycle that does
    not come back to where it began, to a thousand times the tolerance, is undecided, too. A loop of
    many hundred moments is cut off, with the status TOO_MANY_STEPS. Unstable motions are in
    `bifurcation_diagram` only.

    Args:
        osc: An oscillator, or a function of the parameter that returns it, as for `scan`.
        where: Selects the parameter that varies, as for `scan`; None with a function.
        span: First and last value of the parameter.
        at: Moments at which a cycle has its points, in one loop: `AtExtrema` of "x1" (None) or
            "x2", an `AtSection`, or `AtEvents`. Of a forced oscillator an `AtPhase` (None).
        y0: Start (x1, x2), or several, [starts, 2]: where attractors coexist, each start shows its
            own.
        sense: "up", "down" or "both": the first value, or the last one, begins from `y0`, and each
            other one from the attractor of the value before, as in an experiment in which the
            parameter changes slowly; with "both", up is start 0 and down is start 1. None: each
            value begins from `y0`.
        rows: Number of values of the parameter, evenly spaced.
        rtol: Relative tolerance of a step.
        atol: Absolute tolerance of a step; None: 1e-8 of the oscillator's own size.

    Returns:
        The `OrbitDiagram`.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    first, last = as_span(osc, where, span)
    starts = _starts_of(y0)
    numbers = {"rtol": as_positive(rtol, "rtol"), "atol": as_tolerance(atol, "atol")}
    variation = varied(osc, where, (first,), forced=True)
    rows = as_whole(rows, "rows", 2)
    if sense is not None:
        require_one_of(sense, tuple(SENSES), "sense")
        require_value(len(starts) == 1, "y0", "one start where sense is given", y0)
    # A force whose frequency is a known 0 is a constant force, without a clock.
    ends = [variation.oscillator(np.array([value])) for value in (first, last)]
    example = max(ends, key=has_clock)
    if has_clock(example):
        at = AtPhase() if at is None else at
        require_value(isinstance(at, AtPhase), "at", "an AtPhase, as osc is forced", at)
    else:
        at = AtExtrema("x1") if at is None else at
        kinds = AtExtrema | AtSection | AtEvents
        require_value(isinstance(at, kinds), "at", "an AtExtrema, AtSection or AtEvents", at)
    check_sections((at,), example)
    senses = () if sense is None else SENSES[sense]
    starts = np.repeat(starts, len(senses), axis=0) if senses else starts
    return Sampling(variation, at, starts, rows, numbers, senses).diagram((first, last))


def _starts_of(y0: Any) -> np.ndarray:
    """Checks the starts, [starts, 2]."""
    try:
        are_several = np.ndim(y0) == 2
    except ValueError:  # rows of different lengths; the check below raises
        are_several = False
    starts = np.asarray(as_finite(y0, "y0", (None, 2) if are_several else (2,)))
    require_value(starts.size, "y0", "one start or more", y0)
    return starts.reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class Sampling:
    """Arguments that determine the points of an orbit diagram, except its span; see
    `orbit_diagram`.

    senses: sense in which the parameter changes, for each start; (): all values use the starts.
    """

    variation: Variation
    at: Any
    starts: np.ndarray
    rows: int
    numbers: dict[str, Any]
    senses: tuple[str, ...] = ()

    def diagram(self, span: tuple[float, float]) -> OrbitDiagram:
        """The orbit diagram over a span of the parameter."""
        first, last = as_interval(span, "span")
        for value in (first, last):
            self.variation.check(value)
        values = evenly_spaced(first, last, self.rows)
        grid = Grid(self._make, {"parameter": values}, (0.0, 0.0))
        if isinstance(self.at, AtPhase):
            return self._strobed(grid, values)
        ends = functools.partial(np.full_like, fill_value=LONG_ENOUGH, dtype=float)
        found = self._from_starts(grid, Attractor(), _beside_attractor(grid), ends)
        # Codes of runs that are not finite are NaN.
        kind = np.nan_to_num(found["kind"]).astype(int)
        status = found["status"].astype(int)
        x1, x2 = (found[name][:, None] for name in RESTS_AT)
        cycles = np.flatnonzero(kind == CYCLE)
        if len(cycles):
            loops = {name: found[name][cycles] for name in ("x1_min", "x1_max", "period")}
            ended, *points = self._loops(grid, cycles, **loops)
            status[cycles] = ended
            kind[cycles[ended == Status.NOT_SETTLED]] = UNDECIDED
            missing = ((0, 0), (0, points[0].shape[1] - 1))
            x1, x2 = (np.pad(x, missing, constant_values=np.nan) for x in (x1, x2))
            x1[cycles], x2[cycles] = points
        period = np.where(kind == CYCLE, found["period"], np.nan)
        return self._diagram(values, np.array(KINDS)[kind], period, status, x1, x2)

    def _diagram(self, values: np.ndarray, *columns: np.ndarray) -> OrbitDiagram:
        """The diagram of columns of all runs: kind, period, status, and points x1 and x2."""
        shape = len(values), len(self.starts)
        kind, period, status = (column.reshape(shape) for column in columns[:3])
        x1, x2 = (column.reshape(*shape, -1) for column in columns[3:])
        return OrbitDiagram(
            values=values,
            kind=kind,
            period=period,
            status=status,
            x1=x1,
            x2=x2,
            at=self.at,
            name=self.variation.names[0],
            sampling=self,
            is_argument=not self.variation.varies_leaves,
        )

    def _strobed(self, grid: Grid, values: np.ndarray) -> OrbitDiagram:
        """The diagram of a stroboscopic section: STROBES points behind PERIODS_LEFT_OUT periods."""
        period, turns = (np.repeat(one, len(self.starts)) for one in self._clocks(values))
        left_out = PERIODS_LEFT_OUT_BESIDE if self.senses else PERIODS_LEFT_OUT
        reducer = _KeptMoments((self.at,), STROBES, ("x1", "x2"), left_out)
        off = OFF_ATTRACTOR * grid.length()
        share = self.at.phase / (2 * np.pi)
        # With a common period of all waves, runs begin at its phase where the last ones ended.
        cycle = np.maximum(turns, 1)
        passed = np.full(period.size, np.ceil(-share - 1e-12))

        def ends(which):
            """Ends of runs, half a period behind the last moment: an end at a moment would let
            rounding decide whether it counts."""
            return (share + passed[which] + left_out + STROBES - 0.5) * period[which]

        def further(found, which, following):
            *state, last = reducer.last_state(found)
            passed[following] = (passed[which] + left_out + last) % cycle[following]
            times = (share + passed[following]) * period[following]
            rests = _have_come_to_rest(found)
            away = np.where(found["status"] == Status.STUCK_FOREVER, 0, off)
            ends = (np.where(rests, found[at], x) for at, x in zip(ENDS_AT, state, strict=True))
            return np.stack([*(x + away for x in ends), times])

        found = self._from_starts(grid, Along(reducer), further, ends, t0=0.0)
        x1, x2 = reducer.columns(found)
        status = found["status"].astype(int)
        x1[status != Status.OK], x2[status != Status.OK] = np.nan, np.nan
        turns = _turns_in(x1, x2, turns)
        kind = np.where(turns > 0, KINDS[CYCLE], NOT_PERIODIC)
        kind = np.where(status == Status.OK, kind, KINDS[UNDECIDED])
        for at_rest, code in RESTS.items():
            kind[status == at_rest] = KINDS[code]
        rests = _have_come_to_rest(found)
        x1[rests, 0], x2[rests, 0] = (found[at][rests] for at in ENDS_AT)
        once = (turns[:, None] > 0) & (np.arange(STROBES) >= turns[:, None])
        x1, x2 = (np.where(once, np.nan, x) for x in (x1, x2))
        period = np.where(turns > 0, turns * period, np.nan)
        return self._diagram(values, kind, period, status, x1, x2)

    def _clocks(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The period of the clock at each value, and its `common_turns`."""
        made = self.variation.oscillators(values[:, None])

        def row(number):
            return np.broadcast_to(np.asarray(number, float), values.shape)

        frequency = row(clock_frequency(made))
        fine = np.all((frequency > 0) & np.isfinite(frequency))
        require(fine, "span", WITH_A_CLOCK, (float(values[0]), float(values[-1])))
        pairs = zip(map(row, repeating(made)), map(row, map(has_amplitude, waves_of(made))))
        # Waves without amplitude always repeat; but the clock's own period sets the strobes.
        rates = [np.where((size > 0) | (rate == frequency), rate, 0.0) for rate, size in pairs]
        with np.errstate(all="ignore"):
            return 2 * np.pi / frequency, common_turns(rates, np)

    def _make(self, parameter: Any) -> Oscillator:
        return self.variation.make(parameter)

    def _results(
        self,
        grid: Grid,
        observer: Any,
        states: np.ndarray,
        ends: np.ndarray,
        which: np.ndarray,
        **numbers: Any,
    ) -> dict[str, np.ndarray]:
        """Results of an observer for runs from states, [2 or 3, runs], that go on until `ends` at
        least; which: numbers of the runs; numbers: more arguments of `threads.run`."""
        numbers |= self.numbers
        begin = states[2] if len(states) == 3 else np.zeros(len(ends))
        found, left = {}, np.arange(len(ends))
        # Runs with one t1 are chosen so that none takes more than twice as long as it needs.
        while left.size:
            t1 = float(np.max(ends[left]))
            alike = t1 - begin[left] <= 2 * (ends - begin)[left]
            here, left = left[alike], left[~alike]
            rows = which[here] // len(self.starts)
            results = grid.results(observer, states[:, here], rows, t1=t1, **numbers)
            _fill_in(found, here, results, len(ends))
        return found

    def _from_starts(
        self,
        grid: Grid,
        observer: Any,
        further: Callable[[dict[str, np.ndarray], np.ndarray, np.ndarray], np.ndarray],
        ends: Callable[[np.ndarray], np.ndarray],
        **numbers: Any,
    ) -> dict[str, np.ndarray]:
        """Results of an observer for all runs; ends(numbers): when runs end. With `senses`,
        further(results, their numbers, numbers of the next runs) returns the states from which the
        next runs begin, [2 or 3, runs], see `Grid.results`; NaN: they begin where the present runs
        began."""
        if not self.senses:
            states = np.tile(self.starts.T, self.rows)
            which = np.arange(states.shape[1])
            return self._results(grid, observer, states, ends(which), which, **numbers)
        lanes, found = np.arange(len(self.senses)), {}
        rows = [
            np.array([i if sense == "up" else self.rows - 1 - i for sense in self.senses])
            for i in range(self.rows)
        ]
        runs = [row * len(lanes) + lanes for row in rows]
        states = self.starts.T
        if isinstance(self.at, AtPhase):  # with the start time
            states = np.concatenate([states, np.zeros((1, len(lanes)))])
        for i, which in enumerate(runs):
            note_progress(f"{i} of {self.rows} values")
            few = {"width": LANES_OF_FEW, **numbers}
            results = self._results(grid, observer, states, ends(which), which, **few)
            _fill_in(found, which, results, self.rows * len(lanes))
            following = runs[min(i + 1, self.rows - 1)]
            ahead = further(results, which, following)
            states = np.where(np.isfinite(ahead), ahead, states)
        return found

    def _loops(self, grid: Grid, which: np.ndarray, x1_min, x1_max, period):
        """Status, x1 and x2 of the moments of one loop of cycles, [cycles] and [cycles, points].

        which: numbers of the runs that led to the cycles.
        """
        period, top = period[:, None], x1_max[:, None]
        (t, x1, x2, number), cut = self._moments(grid, which, x1_max, (1 + OUTSIDE) * period[:, 0])
        # Exactly one loop: moments within OUTSIDE of its beginning are met again at its end.
        inside = (t > OUTSIDE * period) & (t <= (1 + OUTSIDE) * period)
        size = RUN * self.numbers["rtol"] * (top - x1_min[:, None])
        back = inside & (number == EXTREMUM) & (np.abs(x1 - top) < size)
        back &= np.abs(t - period) <= OUTSIDE * period
        status = np.where(np.any(back, axis=1), Status.OK, Status.NOT_SETTLED)
        status[cut] = Status.TOO_MANY_STEPS
        wanted = inside & (status != Status.NOT_SETTLED)[:, None]
        wanted &= number == (EXTREMUM if self.at == AtExtrema("x1") else OWN)
        order = np.argsort(~wanted, axis=1, kind="stable")
        order = order[:, : max(1, np.max(np.sum(wanted, axis=1)))]
        held = np.take_along_axis(wanted, order, axis=1)
        points = (np.take_along_axis(x, order, axis=1) for x in (x1, x2))
        return status, *(np.where(held, x, np.nan) for x in points)

    def _moments(self, grid: Grid, which: np.ndarray, x1_max: np.ndarray, end: np.ndarray):
        """The moments of loops from x1_max until the times `end`, [cycles], in order.

        Returns t, x1, x2 and the moment's number, [4, cycles, moments], NaN where there is none,
        and a mask of loops that are cut off, [cycles].
        """
        at = (AtExtrema("x1"),) if self.at == AtExtrema("x1") else (AtExtrema("x1"), self.at)
        reducer = _KeptMoments(at, MOMENTS_KEPT)
        moments, cut = np.zeros((4, len(which), 0)), np.zeros(len(which), bool)
        state, began = np.stack([x1_max, np.zeros_like(x1_max)]), np.zeros_like(x1_max)
        remaining = np.arange(len(which))
        for _ in range(MOST_RUNS):
            until = np.max((end - began)[remaining]) * (1 + OUTSIDE)
            until = np.full(len(remaining), until)
            left = state[:, remaining], until, which[remaining]
            new = np.stack(reducer.columns(self._results(grid, Along(reducer), *left)))
            new[0] += began[remaining, None]
            # Where the room is used up, the next run begins at the last extremum, if there is one.
            cut[remaining] = new[0, :, -1] < end[remaining]
            turns = new[3] == EXTREMUM
            last = MOMENTS_KEPT - 1 - np.argmax(turns[:, ::-1], axis=1)
            on = cut[remaining] & np.any(turns, axis=1)
            new[:, on[:, None] & (np.arange(MOMENTS_KEPT) > last[:, None])] = np.nan
            whole = np.full((4, len(which), MOMENTS_KEPT), np.nan)
            whole[:, remaining] = new
            moments = np.concatenate([moments, whole], axis=2)
            began[remaining[on]], state[:, remaining[on]] = (
                new[0, on, last[on]],
                new[1:3, on, last[on]],
            )
            remaining = remaining[on]
            if not len(remaining):
                break
        return moments, cut


def _beside_attractor(grid: Grid) -> Callable[..., np.ndarray]:
    """Returns a function: from results, a state on or beside each run's attractor, [2, runs]."""
    off = OFF_ATTRACTOR * grid.length()

    def state(found: dict[str, np.ndarray], which: np.ndarray, following: np.ndarray):
        kind = np.nan_to_num(found["kind"]).astype(int)
        is_cycle, rests = kind == CYCLE, kind == EQUILIBRIUM
        x1 = np.where(is_cycle, found["x1_max"], found["x1_min"] + np.where(rests, off, 0.0))
        state = np.stack([x1, np.where(is_cycle, 0.0, found["x2_min"])])
        return np.where(kind == UNDECIDED, np.nan, state)

    return state


def _fill_in(
    found: dict[str, np.ndarray], which: np.ndarray, results: dict[str, np.ndarray], size: int
) -> None:
    """Writes results of the runs `which` into the columns `found`, of `size` runs each."""
    for name, values in results.items():
        if name not in found:
            found[name] = np.full((size, *values.shape[1:]), np.nan)
        found[name][which] = values


def _have_come_to_rest(found: dict[str, np.ndarray]) -> np.ndarray:
    """Mask of forced runs that have come to rest, from their results."""
    return np.isin(found["status"], list(RESTS))


def _turns_in(x1: np.ndarray, x2: np.ndarray, common: np.ndarray) -> np.ndarray:
    """Number of points, up to half of all, after which each row of points repeats; 0: none.

    common: number of points after which the forcing repeats, 0: never. A motion repeats only after
    a multiple of it; where waves beat slowly, points may only seem to repeat before.
    """
    turns = np.zeros(len(x1), dtype=int)
    sizes = [SAME * (np.ptp(x, axis=1) + np.max(np.abs(x), axis=1)) for x in (x1, x2)]
    for n in reversed(range(1, x1.shape[1] // 2 + 1)):
        away = [np.max(np.abs(x[:, n:] - x[:, :-n]), axis=1) for x in (x1, x2)]
        pushed_alike = (common > 0) & (n % np.maximum(common, 1) == 0)
        turns[pushed_alike & (away[0] <= sizes[0]) & (away[1] <= sizes[1])] = n
    return turns


#: Numbers of the moments of a loop: extrema of x1, and the moments of the diagram, if different.
EXTREMUM, OWN = 0, 1
#: Results of `Attractor` with the place of an attractor at rest.
RESTS_AT = ("x1_min", "x2_min")
#: Kinds of forced runs that have come to rest, by their status, and results of `_KeptMoments` with
#: the state at the end of a run.
RESTS = {Status.STUCK_FOREVER: STUCK_FOR_EVER, Status.PSEUDO_FOCUS: EQUILIBRIUM}
ENDS_AT = ("x1 at the end", "x2 at the end")


#: Moments are kept in arrays of this many: larger arrays in all lanes make a slow kernel.
PIECE_KEPT = 8


@dataclass(frozen=True)
class _KeptMoments:
    """A reducer, see `sweep.sweep`, that keeps `room` moments of a run behind `skipped` ones, and
    the state at the end of the run. kept: the fields that are kept of a moment (moment: its number
    in `at`); room: a multiple of PIECE_KEPT."""

    at: tuple[Any, ...]
    room: int
    kept: tuple[str, ...] = ("t", "x1", "x2", "moment")
    skipped: int = 0

    @property
    def pieces(self) -> range:
        return range(self.room // PIECE_KEPT)

    def init(self, osc, x1, x2):
        pieces = tuple(jnp.full(PIECE_KEPT, jnp.nan) for _ in self.pieces)
        return (pieces,) * len(self.kept), jnp.zeros((), int) - self.skipped

    def update(self, state, event):
        known, count = state

        def put(name, pieces):
            value = getattr(event, name).astype(event.t.dtype)
            places = (PIECE_KEPT * i + jnp.arange(PIECE_KEPT) for i in self.pieces)
            pairs = zip(places, pieces, strict=True)
            return tuple(jnp.where(place == count, value, piece) for place, piece in pairs)

        return tuple(map(put, self.kept, known)), count + 1

    def finish(self, state, end):
        pieces = {
            f"{name} {i}": piece
            for name, pieces in zip(self.kept, state[0], strict=True)
            for i, piece in enumerate(pieces)
        }
        return pieces | dict(zip(ENDS_AT, (end.x1, end.x2), strict=True))

    def last_state(self, found: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
        """x1 and x2 of the last moment kept of each run, [runs], NaN where none was kept, and its
        index among the moments kept."""
        x1, x2 = self.columns(found)
        last = self.room - 1 - np.argmax(np.isfinite(x1)[:, ::-1], axis=1)
        return *(np.take_along_axis(x, last[:, None], 1)[:, 0] for x in (x1, x2)), last

    def columns(self, found: dict[str, np.ndarray]) -> list[np.ndarray]:
        """An array [runs, room] for each name in `kept`, from the results of runs."""
        return [
            np.concatenate([found[f"{name} {i}"] for i in self.pieces], axis=-1)
            for name in self.kept
        ]
