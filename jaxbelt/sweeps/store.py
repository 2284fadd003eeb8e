"""Stores: the results of a sweep in a Zarr group that grows block by block and survives its writer.

A store is a folder that `xarray.open_zarr` opens: variables over the axes, with units and long
names. One block of runs is one chunk of every variable, so no two writers meet in a chunk, and the
content of a block does not depend on when or where it was computed. Beside the variables the group
`ledger` holds

- `blocks`, a row for each block: its state (0 to do, 1 done), a checksum of its data, how often and
  in how many seconds it was done. The row is written after the data, in a separate write, so that
  no block is marked as done that is not, whenever the writer dies;
- the codes of categories that are numbered when all runs are done, see `lanes.Variable.name_of`.

The attributes of the group contain the question of the sweep; a sweep with another question is
refused.
"""

import hashlib
import json
import math
import os
import shutil
import threading
import time
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..checks import as_path, require, require_value
from ..results import draw
from ..tables import table_of
from .datasets import NUMBERED, renumber
from .grid import Blocks, Grid
from .locks import hidden_beside, locked
from .question import Question

if TYPE_CHECKING:
    import pandas
    import xarray

#: Version of the layout described above.
SCHEMA = 4
#: Largest number of runs in a block: few enough that not much is lost with one.
BLOCK_RUNS = 2**17
#: Number of blocks of a smaller sweep, whose runs may be long (writing a block takes some 40 ms),
#: and the least number of runs in a block.
FEW_BLOCKS, LEAST_RUNS = 8, 64
#: Columns of the ledger, and states of a block.
STATE, CHECKSUM, TIMES_DONE, SECONDS = range(4)
TO_DO, DONE = 0, 1


def blocks_of(grid: Grid) -> Blocks:
    """The blocks of a grid in a new store."""
    return Blocks(grid.shape, _block_runs(grid))


def _block_runs(grid: Grid) -> int:
    return min(BLOCK_RUNS, max(math.ceil(grid.runs / FEW_BLOCKS), LEAST_RUNS))


@dataclass
class _Waiting:
    """A block of which some runs are done: its variables, and how many runs are missing."""

    parts: dict[str, np.ndarray]
    missing: int


class Store:
    """The results of a sweep in a store that is open for writing, or finished."""

    @classmethod
    @contextmanager
    def opened(
        cls, path: Path, question: Question, part: tuple[int, int] | None = None
    ) -> "Iterator[Store]":
        """Opens the store of a sweep, creates it if necessary, and locks it unless it is finished.

        part: the first block to do, and the one behind the last; None: all blocks.
        """
        if _is_finished(path):
            yield cls(path, question, part)
            return
        _check_folder(path)

        def prepare():
            if not (path / "zarr.json").exists():
                _create(path, question)
            if part is None:
                _sweep_out(path)

        with ExitStack() as stack:
            with _writes(path):
                stack.enter_context(locked(path, *(part or ()), prepare=prepare))
            yield cls(path, question, part)

    @classmethod
    def finish_if_done(cls, path: Path, question: Question) -> "Store":
        """Reads the store after a part is done; finishes it if that was the last one."""
        store = cls(path, question)
        if store.to_do or store.finished:
            return store
        try:
            with cls.opened(path, question) as store:
                store.finish()
        except BlockingIOError:  # another process does a part again, or finishes the store
            pass
        return store

    def __init__(
        self,
        path: Path,
        question: Question,
        part: tuple[int, int] | None = None,
        known: str | None = None,
    ):
        """known: hash of the question, if another process has already compared all of it."""
        self.path, self.question, self.table = path, question, question.table
        self.root = _open(path)
        self.hash = self.root.attrs["jaxbelt_hash"]
        if known is None:
            _check_question(path, self.root, question)
        elif known != self.hash:
            raise ValueError(f"store must be that of this very sweep, got another one in {path}")
        self.ledger = self.root["ledger"]
        self.blocks = Blocks(question.grid.shape, self.ledger.attrs["block"])
        self.part = range(len(self.blocks))[slice(*(part or (None,)))]
        self.rows = _ledger_rows(path, self.ledger)
        self.finished = bool(self.ledger.attrs["finished"])
        self.to_do = [block for block in self.part if not self.is_done(block)]
        self.arrays = {name: _array(self.root, name) for name in self.ledger.attrs["variables"]}
        self.waiting: dict[int, _Waiting] = {}
        self.lock = threading.Lock()
        self.began = time.monotonic()

    def is_done(self, block: int) -> bool:
        """Whether a block is done, by the rows that were read last."""
        return bool(self.rows[block, STATE] == DONE)

    def read_rows(self, *blocks: int) -> None:
        """Reads the rows of blocks that other processes may have written."""
        for block in blocks:
            self.rows[block] = np.asarray(self.ledger["blocks"][block])

    def statuses(self, block: int) -> np.ndarray:
        """Statuses of the runs of a block."""
        return np.asarray(self.arrays["status"][self.blocks.slices(block)])

    def put(self, block: int, positions: np.ndarray, results: np.ndarray) -> None:
        """Takes results of runs; a block is written when it is complete."""
        parts, size = self.table.parts(results), self.blocks.size(block)
        with self.lock:
            if block not in self.waiting:
                empty = {name: np.empty((size, *p.shape[1:]), p.dtype) for name, p in parts.items()}
                self.waiting[block] = _Waiting(empty, size)
            waiting = self.waiting[block]
            for name, part in parts.items():
                waiting.parts[name][positions] = part
            waiting.missing -= len(positions)
            if waiting.missing:
                return
            del self.waiting[block]
        self._write(block, waiting.parts)

    def _write(self, block: int, parts: dict[str, np.ndarray]) -> None:
        place, extent = self.blocks.slices(block), self.blocks.extent(block)
        for name, array in self.arrays.items():
            parts[name] = parts[name].reshape(*extent, *parts[name].shape[1:])
            array[place] = parts[name]
        attempts = self.rows[block, TIMES_DONE] + 1
        seconds, self.began = time.monotonic() - self.began, time.monotonic()
        row = np.array([DONE, _checksum(parts[name] for name in self.arrays), attempts, seconds])
        self.ledger["blocks"][block] = row
        self.rows[block] = row

    @property
    def runs(self) -> int:
        """Number of runs in the blocks of this part."""
        return sum(map(self.blocks.size, self.part))

    def done(self) -> int:
        """Number of runs of this part that are in the store."""
        return sum(self.blocks.size(block) for block in self.part if self.is_done(block))

    def interrupted(self) -> str:
        """Says what becomes of the results of an interrupted sweep."""
        done = f"{self.done():,} of {self.runs:,} runs"
        return f"interrupted: {done} are in {self.path}; the same call goes on from there"

    def of_runs(self, runs: np.ndarray) -> dict[str, np.ndarray]:
        """The kernel's results for some runs."""
        places = np.unravel_index(runs, self.question.grid.shape)
        box = [np.asarray(i) // k for i, k in zip(places, self.blocks.box, strict=True)]
        blocks = np.ravel_multi_index(box, self.blocks.counts)
        found = {}
        for name in self.table.layout:
            array = self.arrays[name]
            found[name] = np.empty((len(runs), *array.shape[len(places) :]), array.dtype)
            for block in np.unique(blocks).tolist():
                here, part = blocks == block, self.blocks.slices(block)
                inside = tuple(i[here] - s.start for i, s in zip(places, part, strict=True))
                found[name][here] = np.asarray(array[part])[inside]
        return found

    def finish(self) -> None:
        """Numbers the categories, as all codes are known now, and marks the store as finished."""
        if self.finished:
            return
        for name in self.table.numbered():
            codes: set[int] = set()
            for block in range(len(self.blocks)):
                codes |= set(np.unique(self.arrays[name][self.blocks.slices(block)]).tolist())
            numbers, named = self.table.numbering(name, sorted(codes))
            shown = _array(self.root, name, numbered=True)
            for block in range(len(self.blocks)):
                place = self.blocks.slices(block)
                shown[place] = renumber(np.asarray(self.arrays[name][place]), numbers)
            shown.attrs.update(_as_json(named))
            self.ledger.attrs[f"{name}_numbers"] = {str(k): v for k, v in numbers.items()}
        _consolidate(self.path)
        _sweep_out(self.path)
        self.ledger.attrs["finished"] = self.finished = True

    def add_attributes(self, attributes: dict[str, Any]) -> None:
        """Adds attributes to the dataset."""
        self.root.attrs.update(attributes)
        _consolidate(self.path)

    def dataset(self) -> "xarray.Dataset":
        """The dataset in the store; its data are read when they are used."""
        import xarray

        return xarray.open_zarr(self.path, chunks=None)


# --- opening and creating -------------------------------------------------------------------------


def _open(path: Path, mode: Any = "r+") -> Any:
    """Opens the group of a store and checks its schema."""
    import zarr

    expected = "a folder that is empty or holds the store of a sweep"
    try:
        root = zarr.open_group(path, mode=mode, use_consolidated=False)
        schema = root.attrs["jaxbelt_schema"]
    except Exception as error:
        raise ValueError(f"store must be {expected}, got {path}: {error}") from None
    require(
        schema == SCHEMA,
        "store",
        f"of schema {SCHEMA}, which this version of jaxbelt reads and writes",
        f"schema {schema} in {path}; xarray.open_zarr opens it, and its sweep needs a new store",
    )
    return root


def _consolidate(path: Path) -> None:
    """Copies all metadata to one place, where xarray looks for them first."""
    import zarr

    with warnings.catch_warnings():
        # Zarr warns that this is not yet in the specification; other readers ignore it.
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(path)


def _array(root: Any, name: str, numbered: bool = False) -> Any:
    """Array of a variable; of a numbered category that of its codes or, if `numbered`, numbers."""
    codes = f"{name}_codes"
    array = root["ledger"][codes] if codes in root["ledger"] and not numbered else root[name]
    # A chunk of fill values only, such as NaN, has to be written, too, to count as done.
    return array.with_config({"write_empty_chunks": True})


def _is_finished(path: Path) -> bool:
    return (path / "zarr.json").exists() and bool(_open(path, "r")["ledger"].attrs["finished"])


def _check_folder(path: Path) -> None:
    """Raises unless a store can be written there."""
    with _writes(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not (path / "zarr.json").exists():
            fits = path.is_dir() and not any(path.iterdir())
            require(fits, "store", "an empty folder or the store of this very sweep", f"{path}")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise PermissionError(13, "store cannot be written", str(path))


@contextmanager
def _writes(path: Path) -> Iterator[None]:
    """Adds to an error of the operating system that the store cannot be written."""
    try:
        yield
    except BlockingIOError:
        raise  # another process writes
    except OSError as error:
        message = f"store cannot be written: {error.strerror}"
        raise OSError(error.errno, message, str(path)) from None


def _sweep_out(path: Path) -> None:
    """Removes files of writers that died."""
    for partial in path.rglob("*.partial"):
        partial.unlink(missing_ok=True)


def _create(path: Path, question: Question) -> None:
    """Creates an empty store, which appears in its place when it is complete."""
    import xarray
    import zarr

    table, grid = question.table, question.grid
    blocks = blocks_of(grid)
    identity = _identity(question, blocks)
    attributes = question.attributes() | {
        "jaxbelt_schema": SCHEMA,
        "jaxbelt_question": json.dumps(identity),
        "jaxbelt_hash": hashlib.sha256(json.dumps(identity).encode()).hexdigest(),
    }
    new = hidden_beside(path, "new")
    shutil.rmtree(new, ignore_errors=True)
    empty = xarray.Dataset(coords=table.coordinates(), attrs=attributes)
    empty.to_zarr(new, mode="w", zarr_format=3, consolidated=False)
    root = zarr.open_group(new, mode="r+", use_consolidated=False)
    ledger = root.create_group("ledger")
    numbered = table.numbered()

    def allocate(group: Any, name: str, dtype: str, fill: Any, **options: Any) -> None:
        extra = table.shapes[name.removesuffix("_codes")]
        options |= {"shape": (*grid.shape, *extra), "chunks": (*blocks.box, *extra)}
        group.create_array(name, dtype=dtype, fill_value=fill, **options)

    for name in table.shapes:
        described = {
            "dimension_names": table.dims(name),
            "attributes": _as_json(table.attributes(name)),
        }
        dtype, fill = table.variable(name).dtype, table.empty(name)
        if name in numbered:
            allocate(ledger, f"{name}_codes", dtype, fill)
            dtype, fill = NUMBERED, -1
        fill = np.nan if np.issubdtype(np.dtype(dtype), np.floating) else fill
        allocate(root, name, dtype, fill, **described)
    # One chunk for each row, as two threads may write theirs at once.
    shape = (len(blocks), 4)
    ledger.create_array("blocks", shape=shape, chunks=(1, 4), dtype="float64", fill_value=0)
    ledger.attrs.update(
        {
            "variables": list(table.shapes),
            "numbered": numbered,
            "shape": grid.shape,
            "block": _block_runs(grid),
            "finished": False,
        }
    )
    _consolidate(new)
    if not (path.exists() and path.samefile(Path.cwd())):
        os.replace(new, path)
        return
    # The working folder cannot be replaced. `zarr.json`, which makes it a store, is moved last.
    for part in sorted(new.iterdir(), key=lambda part: part.name == "zarr.json"):
        os.replace(part, path / part.name)
    new.rmdir()


def _ledger_rows(path: Path, ledger: Any) -> np.ndarray:
    """The ledger's rows of all blocks."""
    try:
        return np.array(ledger["blocks"][:])
    except Exception as error:  # codecs raise all kinds of errors for damaged bytes
        raise ValueError(
            f"store must have a ledger that can be read, got a harmed one in {path} ({error}); "
            f"`jaxbelt verify {path} --repair` finds what is left of it"
        ) from None


def _identity(question: Question, blocks: Blocks) -> dict[str, str]:
    return question.identity() | {"the size of a block": repr(blocks.box)}


def _check_question(path: Path, root: Any, question: Question) -> None:
    """Raises unless the store is of this very sweep, and names what differs."""
    there = json.loads(root.attrs["jaxbelt_question"])
    # A store keeps the size of blocks that it was made with.
    here = _identity(question, Blocks(question.grid.shape, root["ledger"].attrs["block"]))
    for name in dict.fromkeys([*there, *here]):
        axis = name.removeprefix("axis ")
        if axis != name and not (name in there and name in here):
            continue  # the difference of their list, "axes", is reported
        if here.get(name) != there.get(name):
            if axis != name and axis in question.grid.axes and axis in root:
                pair = root[axis][:].tolist(), question.grid.axes[axis].tolist()
            else:
                pair = [str(there.get(name))], [str(here.get(name))]
                # Long texts, such as the leaves of an oscillator, are compared by entries.
                if max(map(len, pair[0] + pair[1])) > 80:
                    pair = pair[0][0].split(", "), pair[1][0].split(", ")
            raise ValueError(
                f"store must be an empty folder or the store of this very sweep, got that of "
                f"another one in {path}, which differs in {name}{_first_difference(*pair)}"
            )


def _first_difference(there: Sequence[Any], here: Sequence[Any]) -> str:
    """Describes where two rows differ first, and in how many entries, if that is short."""
    different = [i for i, (old, new) in enumerate(zip(there, here)) if old != new]
    if len(there) != len(here):
        pair = f"{len(there)} entries there", f"{len(here)} here"
    elif not different:  # equal but for the sign of a zero, for example
        return ""
    else:
        more = f" and {len(different) - 1} more" if len(different) > 1 else ""
        pair = f"{there[different[0]]} there", f"{here[different[0]]} here{more}"
    return f": {', '.join(pair)}" if max(map(len, pair)) < 90 else ""


def _as_json(attributes: dict[str, Any]) -> dict[str, Any]:
    """Attributes as JSON."""
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in attributes.items()}


def _checksum(parts: Any) -> float:
    """CRC-32 of the bytes of a block's variables, in order."""
    total = 0
    for part in parts:
        total = zlib.crc32(np.asarray(part).tobytes(), total)
    return float(total)


# --- verifying ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Verified:
    """Blocks of a store by state; what `verify` returns.

    Attributes:
        done: Numbers of blocks that are done and right.
        to_do: Numbers of blocks that are not done.
        bad: Numbers of blocks whose data are not what was written.
        finished: Whether all blocks are right and the categories numbered.
    """

    done: tuple[int, ...]
    to_do: tuple[int, ...]
    bad: tuple[int, ...]
    finished: bool

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each block, in order; columns: block, state ("right", "to do" or
        "bad")."""
        named = {"right": self.done, "to do": self.to_do, "bad": self.bad}
        pairs = sorted((block, state) for state, blocks in named.items() for block in blocks)
        blocks, states = [block for block, _ in pairs], [state for _, state in pairs]
        return table_of({"block": np.array(blocks, int), "state": np.array(states, str)})

    def plot(self, ax: Any = None) -> Any:
        """Draws the blocks in rows, coloured by their states.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        bad = f" ({', '.join(map(str, self.bad[:10]))}{', ...' * (len(self.bad) > 10)})"
        return (
            f"Verified({len(self.done)} blocks right, {len(self.to_do)} to do, {len(self.bad)} bad"
            f"{bad if self.bad else ''}; {'finished' if self.finished else 'not finished'})"
        )


def verify(path: str | Path, repair: bool = False) -> Verified:
    """Checks whether the data in a store are what was written: all checksums are computed again.

    Args:
        path: Folder of a store that `sweep` wrote.
        repair: Whether to mark bad blocks as to do, so that the call that made the store does them
            again.

    Returns:
        The blocks by state, `Verified`.

    Raises:
        ValueError: If there is no store that this version knows.
        OSError: If a sweep is writing it and `repair` is set.
    """
    path = as_path(path, "path")
    require_value(isinstance(repair, bool), "repair", "True or False", repair)
    require(path.exists(), "path", "that of a store, a folder", f"{path}, which is not there")
    root = _open(path, "r")
    if not repair:
        return _verified(root)
    with locked(path):
        root = _open(path)
        found = _verified(root)
        for block in found.bad:
            root["ledger"]["blocks"][block] = np.zeros(4)
        if not found.finished:
            root["ledger"].attrs["finished"] = False
    return found


def _verified(root: Any) -> Verified:
    ledger = root["ledger"]
    blocks = Blocks(tuple(ledger.attrs["shape"]), ledger.attrs["block"])
    arrays = [_array(root, name) for name in ledger.attrs["variables"]]
    states: dict[str, list[int]] = {"done": [], "to do": [], "bad": []}
    finished = bool(ledger.attrs["finished"])
    for block in range(len(blocks)):
        state = _state(root, ledger, arrays, block, blocks.slices(block), finished)
        states[state].append(block)
    done, to_do, bad = map(tuple, states.values())
    return Verified(done, to_do, bad, finished and len(done) == len(blocks))


def _state(root, ledger, arrays, block: int, place: tuple[slice, ...], finished: bool) -> str:
    """State of a block: done, to do or bad."""
    try:
        row = np.asarray(ledger["blocks"][block])
        if row[STATE] == TO_DO and not finished:
            return "to do"
        parts = [np.asarray(array[place]) for array in arrays]
        right = row[STATE] == DONE and _checksum(parts) == row[CHECKSUM]
        for name in ledger.attrs["numbered"] if finished else ():
            numbers = {int(k): v for k, v in ledger.attrs[f"{name}_numbers"].items()}
            codes = np.asarray(_array(root, name)[place])
            shown = np.asarray(_array(root, name, numbered=True)[place])
            right = right and np.array_equal(renumber(codes, numbers), shown)
        return "done" if right else "bad"
    except Exception:  # codecs raise all kinds of errors for damaged bytes
        return "bad"
