"""Sweeps: named axes in, a labelled `xarray.Dataset` out.

`sweep` runs an oscillator from every point of a grid of parameters and starts, on all cores, and
puts the results where they belong, in memory or in a store. `explain` says beforehand how much that
is.
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
from ..model.oscillator import Oscillator
from ..results import draw
from ..tables import table_of
from .along import Along
from .audit import chosen, differing
from .clusters import check_executor, do_on_cluster
from .datasets import Memory
from .observers import Reduce
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
    """Run an oscillator from every point of a grid of parameters and starts.

    make: a function of parameters that returns an `Oscillator`, such as `jb.presets.class_b`; the
    rest of its arguments can be fixed by `functools.partial`. It is called with traced arrays.
    axes: values, shape [n], of arguments of `make`, and of `x1` and `x2` for starts. NaN, and
    parameters that are impossible, such as a negative load, give runs with the status NOT_FINITE;
    but the oscillator at the first finite value of each axis, which is made before anything runs,
    has to be possible. y0: start (x1, x2) where no axis says
    otherwise. t1: end of each run, from t = 0 (dimensionless time tau = omega t). rtol, atol:
    tolerances of a step, atol a length (None: 1e-8 of the oscillator's own size).

    observe: what is wanted, and the variables of the dataset, over the axes:

    - `"final"`: x1_end, x2_end, mode_end(belt) (contact codes as in `Trajectory.modes`), n_events.
    - `"attractor"`: kind (equilibrium, cycle, stuck, or undecided at t1, which is 30,000 unless
      given), signature (the events of one loop, kind and belt), sticks(belt), period,
      stick_duration(belt) in a loop (inf where stuck for ever), x1_min, x1_max, x2_min, x2_max on
      the attractor, transient: the time at which it was reached, n_events: of a cycle in one loop,
      else until it was known. What is undecided has no attractor: all of these are NaN, sticks is
      false, signature "none", and n_events those of the run. Runs end as soon as their attractor is
      known, see `attractor.Attractor`.
    - an object with three methods for scalars: `init(osc, x1, x2)`, the state of a run, any tree of
      arrays; `update(state, event)`, the state after an `observers.RunEvent` (t, x1, x2, kind,
      belt); and `finish(state, end)`, a dictionary of results, numbers or vectors, from the state
      and an `observers.RunEnd` (t, x1, x2, status). They are traced, so use `jax.numpy`. It may see
      more than events: with `at`, a tuple of the moments `AtEvents()`, `AtExtrema("x1")`,
      `AtSection(function)` and `AtTimes(times)`, it is asked there; with `rates(osc, motion)`, a
      tree of numbers, their integrals are in event.integrals and end.integrals, see `along.Motion`;
    - a `lanes.Observer`, the base of the first two.

    and always status, a `Status` code a run: nothing raises because of one run. Categories, such as
    kind, are integers with the attributes flag_values and flag_meanings; `decoded` gives the words.

    derivatives: names of axes. Adds `d_<variable>_d_<axis>` for every variable that is a float, by
    forward mode; NaN where the variable is not finite. store: a folder for the results as they come
    in, a Zarr group that `xarray.open_zarr` opens; it has blocks of an eighth of the runs (64 at
    least, 131,072 at most), each written when it is whole; the same call with the same store goes
    on where one was interrupted, at the first block that is not, and returns at once what is
    finished. executor: a `dask.distributed.Client`, whose workers then do the blocks
    of the store, in a folder that all of them see; a worker that dies costs the block that it was
    at. blocks: (first, last), which blocks of the store to do, `last` not among them, for processes
    that share one store, such as those of a job array; who ends last finishes the store, in which
    until then runs that are not done have the status and the kind -1, "not_done". progress: whether
    to show a bar; None: on a terminal, when it takes long. audit: share of the runs that are done
    once more without any shortcut and compared, of "final" and "attractor" only; the attributes
    audited and audit_differed say how many, and a warning says so where one differed.

    Uses every core (every device, if JAX has others). `ValueError` names the argument that is
    impossible, a store of another sweep among them, and says what differs. `KeyboardInterrupt` ends
    the sweep within a second and says what became of its runs; so does `OSError` where a store
    cannot be written.
    """
    with _ends_told() as known:
        question = Question.of(make, axes, y0, t1, rtol, atol, observe, derivatives, t0)
        audit = float(as_array(audit, "audit"))
        require(0 <= audit <= 1, "audit", "a share from 0 to 1", audit)
        require(
            audit == 0 or not isinstance(question.program.observer, Reduce | Along),
            "audit",
            '0 but for observe="final" and "attractor"',
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
        told = _audited(question, results, audit) if audit else {}
        return results.dataset(question.attributes() | told)


@contextmanager
def _ends_told() -> "Iterator[list[Memory | Store]]":
    """Let an interrupt, or a disk that is full, say what becomes of the runs, whenever it comes.

    Yields a list for the results, once there is a place for them.
    """
    known: list[Memory | Store] = []
    try:
        yield known
    except KeyboardInterrupt:
        told = (
            known[0].interrupted()
            if known
            else "interrupted before the first run; nothing is lost, the same call begins again"
        )
        raise KeyboardInterrupt(told) from None
    except OSError as error:  # of a store on a full disk, say
        if not known:
            raise
        told = f"{error.strerror or error}; {known[0].interrupted()}"
        raise OSError(error.errno, told) from error


def _kept(
    question: Question,
    path: Path,
    executor: Any,
    part: tuple[int, int] | None,
    progress: bool | None,
    audit: float,
    known: list[Memory | Store],
) -> "xarray.Dataset":
    """The sweep in a store, or as far as that part of its blocks goes."""
    with Store.opened(path, question, part) as results:
        known.append(results)
        if results.to_do:
            _do_and_show(question, results, progress, executor)
        if part is None:
            results.finish()
        if audit and results.root.attrs.get("audited", 0) < len(chosen(question.grid.runs, audit)):
            results.tell(_audited(question, results, audit))
    if part is not None:
        results = Store.finish_if_done(path, question)
    return results.dataset()


def _do_and_show(
    question: Question, results: Memory | Store, progress: bool | None, executor: Any = None
) -> None:
    """Do the runs that the results lack, here or on a cluster."""
    with SweepProgress(results.runs, results.done(), progress) as bar:
        if executor is not None and isinstance(results, Store):
            do_on_cluster(executor, question, results, bar.advance)
        else:
            do_runs(question, results, results.to_do, bar.advance)


def _check_where(question: Question, store, executor, blocks, audit: float) -> None:
    """Raise unless blocks can be done there."""
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
    """The attributes that tell of an audit; warns of what differed."""
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
    """What `explain` returns.

    runs: how many there are; blocks: chunks of every variable in a store; bytes: of the dataset in
    memory, which a store compresses; compile_seconds: taken by the compilation, which the sweep
    itself then need not do again in this process; seconds: the estimate for the runs.
    """

    runs: int
    blocks: int
    bytes: int
    compile_seconds: float
    seconds: float

    def table(self) -> "pandas.DataFrame":
        """One row: runs, blocks, bytes, compile_seconds, seconds."""
        return table_of([dataclasses.asdict(self)])

    def plot(self, ax: Any = None) -> Any:
        """Draw how long compilation and runs take, as a bar, into the axes `ax` (None: new ones),
        which are returned."""
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
    rtol: ArrayLike = 1e-8,
    atol: ArrayLike | None = None,
    observe: Any = "final",
    derivatives: Sequence[str] = (),
) -> Explanation:
    """How much a sweep is, and how long it will take: compiles it and does a sample of its runs.

    The arguments are those of `sweep`; nothing is written. The sample is spread over the grid, as
    many runs as a thread is given at once or fewer. `ValueError` names the argument that is
    impossible.
    """
    question = Question.of(make, axes, y0, t1, rtol, atol, observe, derivatives)
    grid, table = question.grid, question.table
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
    widths = [
        int(np.prod(shape, dtype=int)) * np.dtype(table.variable(name).dtype).itemsize
        for name, shape in table.shapes.items()
    ]
    return Explanation(
        runs=grid.runs,
        blocks=len(blocks_of(grid)),
        bytes=grid.runs * sum(widths) + sum(axis.nbytes for axis in grid.axes.values()),
        compile_seconds=compiling,
        seconds=seconds * grid.runs / len(sample),
    )
