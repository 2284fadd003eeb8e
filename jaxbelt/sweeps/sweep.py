"""Sweeps: named axes in, a labelled `xarray.Dataset` out.

`sweep` runs an oscillator from every point of a grid of parameters and starts, on all cores, and
returns the results in memory or in a store. `explain` estimates size and time beforehand.
"""

import dataclasses
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import ArrayLike

from ..activity import announced
from ..checks import (
    as_array,
    as_path,
    outside_of_traces,
    require,
    require_value,
    require_wish,
)
from ..interrupts import heard_interrupts
from ..model.oscillator import Oscillator
from ..results import draw
from ..tables import table_of
from .attractor import Attractor
from .audit import chosen, differing
from .clusters import check_executor, do_on_cluster
from .datasets import Memory
from .observers import Final
from .progress import SweepProgress
from .question import Question
from .store import Store, blocks_of
from .threads import CHUNK, run
from .work import do_runs

if TYPE_CHECKING:
    import pandas
    import xarray


@outside_of_traces
def sweep(
    make: Callable[..., Oscillator],
    axes: Mapping[str, Any],
    *,
    y0: ArrayLike | tuple = (3.0, 0.0),
    t1: ArrayLike | None = None,
    t0: ArrayLike = 0.0,
    rtol: ArrayLike = 1e-8,
    atol: ArrayLike | None = None,
    observe: Any = "final",
    derivatives: Sequence[str] = (),
    store: str | Path | None = None,
    executor: Any = None,
    blocks: tuple[int, int] | None = None,
    progress: bool | None = None,
    audit: float = 0.0,
) -> "xarray.Dataset":
    """Runs an oscillator from every point of a grid of parameters and starts.

    The runs use every core (every device, if JAX has others). Nothing raises because of one run:
    each has a status. With `store` the results are written in blocks of an eighth of the runs (64
    at least, 131,072 at most), each when it is whole. The same call with the same store goes on
    where one was interrupted, at the first block that is not done, and returns a finished store at
    once.

    The variables of the dataset, over the axes, depend on `observe`. All datasets have `status`, a
    `Status` code for each run. Categories, such as kind, are integers with the attributes
    flag_values and flag_meanings; `decoded` returns the words.

    - `"final"`: x1_end, x2_end, mode_end(belt) (contact codes as in `Trajectory.modes`; at a
      pseudo-focus those of the side from which the mass came), n_events.
    - `"attractor"`: kind (equilibrium, cycle, stuck, or undecided at t1), signature (the events of
      one loop, kind and belt), sticks(belt), period, stick_duration(belt) in a loop (inf where
      stuck for ever), x1_min, x1_max, x2_min, x2_max on the attractor, transient (the time at which
      it was reached), n_events (of a cycle in one loop, else until it was known). An undecided run
      has no attractor: all of these are NaN, sticks is false, signature "none", and n_events those
      of the run. Runs end as soon as their attractor is known, see `attractor.Attractor`.
      Of oscillators that are forced: kind (periodic, stuck, equilibrium; and, where no period is
      found until t1, chaotic, quasiperiodic or undecided by the largest exponent), periods (of the
      forcing, until the motion repeats), sticks(belt), period, stick_duration(belt) and the extrema
      in it, winding (maxima of x1 in a period of the forcing, on average), x1_strobe and x2_strobe
      (its state at the phase 0 where x1 is largest, a guess for `periodic`), exponent and
      exponent_error (where no period is found), transient, n_events; see `strobes.ForcedAttractor`.
      Without a period NaN stands for what belongs to one.
    - `"lyapunov"`, of oscillators that are forced: exponent, the largest Lyapunov exponent per unit
      of time, from the last three quarters of the run, exponent_error, its standard error from 25
      parts of these, n_events.
    - an object with three methods for scalars: `init(osc, x1, x2)` returns the state of a run, any
      tree of arrays; `update(state, event)` the state after an `observers.RunEvent` (t, x1, x2,
      kind, belt), of the same shapes and types; `finish(state, end)` a dictionary of results, real
      numbers or vectors, from the state and an `observers.RunEnd` (t, x1, x2, status). They are
      traced, so use `jax.numpy`. With the attribute `at`, a tuple of the moments `AtEvents()`,
      `AtExtrema("x1")`, `AtSection(function)`, `AtTimes(times)` and, with forcing,
      `AtPhase(phase)`, `update` is called at these; with a method `rates(osc, motion)`, which
      returns a tree of numbers, their integrals are in event.integrals and end.integrals, see
      `along.Motion`.
    - a `lanes.Observer`, the base class of the first two.

    Args:
        make: Function of parameters that returns an `Oscillator`, such as `jb.presets.class_b`;
            other arguments can be fixed by `functools.partial`. It is called with traced arrays.
        axes: Values, shape [n], of arguments of `make`, and of `x1` and `x2` for starts. NaN, and
            impossible parameters such as a negative load, give runs with the status NOT_FINITE; but
            the oscillator at the first finite value of each axis has to be possible.
        y0: Start (x1, x2), where it is not on an axis.
        t1: End of each run (dimensionless time tau = omega t). The default for attractors is
            30,000.
        t0: Time at which each run begins, which matters where the oscillator is forced.
        rtol: Relative tolerance of a step.
        atol: Absolute tolerance of a step, a length; None: 1e-8 of the oscillator's own size.
        observe: What to observe: `"final"`, `"attractor"`, `"lyapunov"` or an object, see above.
        derivatives: Names of axes. Each adds `d_<variable>_d_<axis>` for every variable that is a
            float, by forward mode; NaN where the variable is not finite.
        store: Folder for the results, a Zarr group that `xarray.open_zarr` opens. It is of another
            sweep where an argument from `make` to `derivatives` differs. `make` counts by the
            oscillators that it returns: by their laws and forces, and by their numbers, at 16,384
            points of the grid to eleven digits and at all points to seven (at 16,777,216 points,
            evenly spaced, of a larger grid). An observable, law or force of one's own counts by its
            code and by what that reads.
        executor: A `dask.distributed.Client`, whose workers do the blocks of the store, in a folder
            that all of them see. A worker that dies costs the block that it was doing.
        blocks: (first, last): the blocks of the store to do, `last` not among them, for processes
            that share one store, such as those of a job array. The process that ends last finishes
            the store; until then runs that are not done have the status and the kind -1,
            "not_done".
        progress: Whether to show a bar; None: on a terminal, when it takes long.
        audit: Share of the runs, of "final" and "attractor" only, that are done again without any
            shortcut and compared. The attributes audited and audit_differed count them; a warning
            says if one differed.

    Returns:
        The dataset, an `xarray.Dataset`.

    Raises:
        ValueError: If an argument is impossible, or the store is of another sweep; the message
            names it.
        TypeError: If a method of `observe` returns what is of a wrong type; likewise.
        KeyboardInterrupt: Within a second of an interrupt; the message says what became of the
            runs.
        OSError: If the store cannot be written; likewise.
    """
    with _explained_ends() as known:
        question = Question.of(make, axes, y0, t1, rtol, atol, observe, derivatives, t0)
        audit = float(as_array(audit, "audit"))
        require(0 <= audit <= 1, "audit", "a share from 0 to 1", audit)
        require(
            audit == 0 or isinstance(question.program.observer, Final | Attractor),
            "audit",
            '0 but for "final", and for "attractor" without forcing',
            audit,
        )
        require_wish(progress, "progress")
        store = None if store is None else as_path(store, "store")
        _check_where(question, store, executor, blocks, audit)
        if store is not None:
            return _kept(question, store, executor, blocks, progress, audit, known)
        results = Memory(question.table)
        known.append(results)
        _do_and_show(question, results, progress)
        audited = _audited(question, results, audit) if audit else {}
        return results.dataset(question.attributes() | audited)


@contextmanager
def _explained_ends() -> "Iterator[list[Memory | Store]]":
    """Adds what becomes of the runs to the message of an interrupt, or of a full disk.

    Yields a list to which the caller adds the `Memory` or `Store` once it exists.
    """
    known: list[Memory | Store] = []
    try:
        with heard_interrupts(at_once=True):
            yield known
    except KeyboardInterrupt:
        message = (
            known[0].interrupted()
            if known
            else "interrupted before the first run; nothing is lost, the same call begins again"
        )
        raise KeyboardInterrupt(message) from None
    except OSError as error:  # of a store on a full disk, for example
        if not known:
            raise
        message = f"{error.strerror or error}; {known[0].interrupted()}"
        raise OSError(error.errno, message) from error


def _kept(
    question: Question,
    path: Path,
    executor: Any,
    part: tuple[int, int] | None,
    progress: bool | None,
    audit: float,
    known: list[Memory | Store],
) -> "xarray.Dataset":
    """Does the sweep, or a part of its blocks, in a store, and returns the dataset."""
    with Store.opened(path, question, part) as results:
        known.append(results)
        if results.to_do:
            _do_and_show(question, results, progress, executor)
        if part is None:
            results.finish()
        if audit and results.root.attrs.get("audited", 0) < len(chosen(question.grid.runs, audit)):
            results.add_attributes(_audited(question, results, audit))
    if part is not None:
        results = Store.finish_if_done(path, question)
    return results.dataset()


def _do_and_show(
    question: Question, results: Memory | Store, progress: bool | None, executor: Any = None
) -> None:
    """Does the runs that the results lack, here or on a cluster."""
    with SweepProgress(results.runs, results.done(), progress) as bar:
        if executor is not None and isinstance(results, Store):
            do_on_cluster(executor, question, results, bar.advance)
        else:
            do_runs(question, results, results.to_do, bar.advance)


def _check_where(question: Question, store, executor, blocks, audit: float) -> None:
    """Raises a `ValueError` unless store, executor, blocks and audit fit together."""
    for name, value in (("executor", executor), ("blocks", blocks)):
        wanted = f"given, where {name} is: blocks are written there one by one"
        require(value is None or store is not None, "store", wanted, "None")
    if executor is not None:
        check_executor(executor)
    if blocks is not None:
        fits = isinstance(blocks, Sequence) and len(blocks) == 2
        fits = fits and all(isinstance(b, int) for b in blocks) and 0 <= blocks[0] < blocks[1]
        require_value(fits, "blocks", "two integers (first, last), 0 <= first < last", blocks)
        count = len(blocks_of(question.grid))
        require(blocks[0] < count, "blocks", f"among the {count:,} of this sweep", blocks)
        require(audit == 0, "audit", "0 where blocks is given", audit)


def _audited(question: Question, results: Memory | Store, share: float) -> dict[str, int]:
    """Attributes of an audit; warns if runs differ."""
    grid = question.grid
    runs = chosen(grid.runs, share)
    known = results.of_runs(runs)
    differ = differing(
        question.program,
        grid.shared,
        lambda i: grid.rows(i)[0],
        runs,
        known,
        question.numbers,
        grid.length(),
    )
    if len(differ):
        places = [tuple(map(int, np.unravel_index(run, grid.shape))) for run in differ[:5]]
        warnings.warn(
            f"{len(differ)} of {len(runs)} audited runs differ from the long way, at the indices "
            f"{', '.join(map(str, places))}{' and others' * (len(differ) > 5)}",
            stacklevel=3,
        )
    return {"audited": len(runs), "audit_differed": len(differ)}


@dataclasses.dataclass(frozen=True)
class Explanation:
    """Size and time of a sweep; what `explain` returns.

    Attributes:
        runs: Number of runs.
        blocks: Number of chunks of every variable in a store.
        bytes: Size of the dataset in memory; a store compresses it.
        compile_seconds: Time that the compilation took; the sweep itself need not compile again in
            this process.
        seconds: Estimated time of the runs.
    """

    runs: int
    blocks: int
    bytes: int
    compile_seconds: float
    seconds: float

    def table(self) -> "pandas.DataFrame":
        """Returns one row; columns: runs, blocks, bytes, compile_seconds, seconds."""
        return table_of([dataclasses.asdict(self)])

    def plot(self, ax: Any = None) -> Any:
        """Draws how long compilation and runs take, as bars.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        return (
            f"Explanation({self.runs:,} runs in {self.blocks:,} blocks, {self.bytes / 1e6:,.1f} "
            f"MB, about {self.seconds:,.3g} s after {self.compile_seconds:,.2g} s of compilation)"
        )


@announced("explain")
@outside_of_traces
def explain(
    make: Callable[..., Oscillator],
    axes: Mapping[str, Any],
    *,
    y0: ArrayLike | tuple = (3.0, 0.0),
    t1: ArrayLike | None = None,
    t0: ArrayLike = 0.0,
    rtol: ArrayLike = 1e-8,
    atol: ArrayLike | None = None,
    observe: Any = "final",
    derivatives: Sequence[str] = (),
) -> Explanation:
    """Estimates the size of a sweep and its time: compiles it and does a sample of its runs.

    The sample is spread over the grid, as many runs as a thread gets at once or fewer. Nothing is
    written.

    Args:
        make: As for `sweep`, like all other arguments.
        axes: As for `sweep`.
        y0: As for `sweep`.
        t1: As for `sweep`.
        t0: As for `sweep`.
        rtol: As for `sweep`.
        atol: As for `sweep`.
        observe: As for `sweep`.
        derivatives: As for `sweep`.

    Returns:
        The `Explanation`.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    question = Question.of(make, axes, y0, t1, rtol, atol, observe, derivatives, t0)
    grid = question.grid
    sample = np.unique(np.linspace(0, grid.runs - 1, CHUNK.here).astype(int))

    def rows_of(first: int, last: int) -> np.ndarray:
        return grid.rows(sample[first:last], question.derivatives)

    def timed(runs: int) -> float:
        began = time.monotonic()
        run(
            question.program,
            grid.shared,
            rows_of,
            runs,
            lambda *_: None,
            **question.numbers,
            derivatives=len(question.derivatives),
        )
        return time.monotonic() - began

    compiling, seconds = timed(1), timed(len(sample))
    return Explanation(
        runs=grid.runs,
        blocks=len(blocks_of(grid)),
        bytes=question.table.nbytes,
        compile_seconds=compiling,
        seconds=seconds * grid.runs / len(sample),
    )
