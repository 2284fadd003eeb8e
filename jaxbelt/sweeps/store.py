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
refused. The question has digests of the axes: coordinates that do not agree with them are written
again by the sweep, which is given the axes.
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

from ..checks import require
from .datasets import NUMBERED, renumber
from .grid import Blocks, Grid
from .locks import hidden_beside, locked
from .question import Question, digest

if TYPE_CHECKING:
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
        opened: list[Store] = []

        def prepare():
            if not (path / "zarr.json").exists():
                _create(path, question)
            if part is None:
                _sweep_out(path)
            opened.append(cls(path, question, part))
            opened[0].write_axes()

        with ExitStack() as stack:
            with _writes(path):
                stack.enter_context(locked(path, *(part or ()), prepare=prepare))
            yield opened[0]

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
        self.content = content = Content(path)
        self.root, self.ledger, self.hash = content.root, content.ledger, content.hash
        if known is None:
            _check_question(content, question)
        elif known != self.hash:
            raise ValueError(f"store must be that of this very sweep, got another one in {path}")
        self.blocks, self.finished = content.blocks, content.finished
        self.part = range(len(self.blocks))[slice(*(part or (None,)))]
        self.rows = content.all_rows()
        self.to_do = [block for block in self.part if not self.is_done(block)]
        self.arrays = content.arrays
        self.waiting: dict[int, _Waiting] = {}
        self.lock = threading.Lock()
        self.began = time.monotonic()

    def is_done(self, block: int) -> bool:
        """Whether a block is done, by the rows that were read last."""
        return bool(self.rows[block, STATE] == DONE)

    def read_rows(self, *blocks: int) -> None:
        """Reads the rows of blocks that other processes may have written."""
        for block in blocks:
            self.rows[block] = np.asarray(self.content.rows[block])

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
        row = np.array([DONE, checksum(parts[name] for name in self.arrays), attempts, seconds])
        self.content.rows[block] = row
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
            shown = self.content.shown[name]
            for block in range(len(self.blocks)):
                place = self.blocks.slices(block)
                shown[place] = renumber(np.asarray(self.arrays[name][place]), numbers)
            shown.attrs.update(_as_json(named))
            self.ledger.attrs[f"{name}_numbers"] = {str(k): v for k, v in numbers.items()}
        _consolidate(self.path)
        _sweep_out(self.path)
        self.ledger.attrs["finished"] = self.finished = True

    def write_axes(self) -> None:
        """Writes the coordinates again that are not those of the question."""
        harmed = self.content.harmed_axes()
        if not harmed:
            return
        known, new = self.table.coordinates(), hidden_beside(self.path, "axes")
        _write_coordinates(new, {name: known[name] for name in harmed})
        for name in harmed:
            shutil.rmtree(self.path / name, ignore_errors=True)
            os.replace(new / name, self.path / name)
        shutil.rmtree(new)
        _consolidate(self.path)

    def add_attributes(self, attributes: dict[str, Any]) -> None:
        """Adds attributes to the dataset."""
        self.root.attrs.update(attributes)
        _consolidate(self.path)

    def dataset(self) -> "xarray.Dataset":
        """The dataset in the store; its data are read when they are used."""
        import xarray

        return xarray.open_zarr(self.path, chunks=None)


# --- opening and creating -------------------------------------------------------------------------


class Content:
    """What is in a store, as its metadata say, for sweeps and `verify`.

    Attributes:
        root: The group.
        identity: The identity of the question, and hash, that of it.
        ledger: The group of the ledger, and rows, its array of blocks.
        blocks: The blocks of the grid.
        finished: Whether the store is marked as finished.
        arrays: The arrays of the variables; of those that are numbered, their codes.
        shown: The arrays of the numbers of these, by name.
    """

    def __init__(self, path: Path, mode: Any = "r+"):
        self.path, self.root = path, _open(path, mode)
        with _reading(path, ""):
            attributes = self.root.attrs
            question, self.hash = attributes["jaxbelt_question"], attributes["jaxbelt_hash"]
            self.identity: dict[str, str] = json.loads(question)
            if _hash_of(question) != self.hash:
                raise ValueError("the question and its hash do not agree")
        with _reading(path, "ledger"):
            self.ledger = self.root["ledger"]
            about = self.ledger.attrs
            shape, names = tuple(about["shape"]), list(about["variables"])
            self.blocks = Blocks(shape, about["block"])
            self.finished, numbered = bool(about["finished"]), list(about["numbered"])
        self.rows = self._array("ledger/blocks", (len(self.blocks), 4))
        self.shown = {name: self._array(name, shape) for name in numbered}
        self.arrays = {
            name: self._array(f"ledger/{name}_codes" if name in numbered else name, shape)
            for name in names
        }

    def _array(self, name: str, shape: tuple[int, ...]) -> Any:
        """An array whose first axes have this shape."""
        with _reading(self.path, name):
            array = self.root[name]
            if array.shape[: len(shape)] != shape:
                raise ValueError(f"shape {array.shape} does not begin with {shape}")
            # A chunk of NaN only has to be written, too, to count as done.
            return array.with_config({"write_empty_chunks": True})

    def all_rows(self) -> np.ndarray:
        """The ledger's rows of all blocks."""
        try:
            return np.array(self.rows[:])
        except Exception as error:  # whatever a codec raises for bytes that are not its own
            raise ValueError(
                f"store must have a ledger that can be read, got a harmed one in {self.path} "
                f"({error}); `jaxbelt verify {self.path} --repair` finds what is left of it"
            ) from None

    def axis(self, name: str) -> np.ndarray | None:
        """Values of a coordinate; None where they cannot be read."""
        try:
            return np.asarray(self.root[name][:])
        except Exception:  # whatever a codec raises for bytes that are not its own
            return None

    def harmed_axes(self) -> list[str]:
        """Names of the coordinates whose values are not those of the question."""
        known = {
            name.removeprefix("axis "): value
            for name, value in self.identity.items()
            if name.startswith("axis ")
        }
        for array in self.arrays.values():
            for name, size in zip(array.metadata.dimension_names or (), array.shape, strict=False):
                if name == "belt":
                    known[name] = digest(np.arange(size).tobytes())
        values = {name: self.axis(name) for name in known}
        return [
            name
            for name, digested in known.items()
            if (found := values[name]) is None or digest(found.tobytes()) != digested
        ]


def _open(path: Path, mode: Any) -> Any:
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


@contextmanager
def _reading(path: Path, part: str) -> Iterator[None]:
    """Makes an error in the metadata of a part of a store name their file and say what to do."""
    try:
        yield
    except Exception as error:  # whatever Zarr raises for metadata that are none
        raise ValueError(
            f"store must have metadata that can be read, got harmed ones in "
            f"{path / part / 'zarr.json'} ({type(error).__name__}: {error}); put this file back "
            f"from a copy of the store, or do the sweep again in a new one"
        ) from None


def _hash_of(question: str) -> str:
    return hashlib.sha256(question.encode()).hexdigest()


def _consolidate(path: Path) -> None:
    """Copies all metadata to one place, where xarray looks for them first."""
    import zarr

    with warnings.catch_warnings():
        # Zarr warns that this is not yet in the specification; other readers ignore it.
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(path)


def _is_finished(path: Path) -> bool:
    """Whether there is a store that is finished and has the axes of its question."""
    if not (path / "zarr.json").exists():
        return False
    content = Content(path, "r")
    return content.finished and not content.harmed_axes()


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
    import zarr

    table, grid = question.table, question.grid
    blocks = blocks_of(grid)
    identity = json.dumps(_identity(question, blocks))
    attributes = question.attributes() | {
        "jaxbelt_schema": SCHEMA,
        "jaxbelt_question": identity,
        "jaxbelt_hash": _hash_of(identity),
    }
    new = hidden_beside(path, "new")
    _write_coordinates(new, table.coordinates(), attributes)
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


def _write_coordinates(
    new: Path, coordinates: dict[str, Any], attributes: dict[str, Any] | None = None
) -> None:
    """Makes a group of coordinates, with these attributes; one that is there is replaced."""
    import xarray

    shutil.rmtree(new, ignore_errors=True)
    empty = xarray.Dataset(coords=coordinates, attrs=attributes)
    empty.to_zarr(new, mode="w", zarr_format=3, consolidated=False)


def _identity(question: Question, blocks: Blocks) -> dict[str, str]:
    return question.identity() | {"the size of a block": repr(blocks.box)}


def _check_question(content: Content, question: Question) -> None:
    """Raises unless the store is of this very sweep, and names what differs."""
    path, there = content.path, content.identity
    # A store keeps the blocks that it was made with.
    here = _identity(question, content.blocks)
    for name in dict.fromkeys([*there, *here]):
        axis = name.removeprefix("axis ")
        if axis != name and not (name in there and name in here):
            continue  # the difference of their list, "axes", is reported
        if here.get(name) != there.get(name):
            known = content.axis(axis) if axis != name else None
            if known is not None:
                pair = known.tolist(), question.grid.axes[axis].tolist()
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


def checksum(parts: Any) -> float:
    """CRC-32 of the bytes of a block's variables, in order."""
    total = 0
    for part in parts:
        total = zlib.crc32(np.asarray(part).tobytes(), total)
    return float(total)
