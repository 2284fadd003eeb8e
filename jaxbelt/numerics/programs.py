"""Compiled programs, kept on disk for the processes to come.

A program is known by what it was made of: the source of jaxbelt, its name, what it is called with
but for the numbers, versions, the processor, JAX's settings. `load` gives the program that was kept
under such a key and `keep` keeps one. Nothing here raises on account of what it finds on the disk:
what is not there, is damaged or belongs to others is compiled anew, and the logger "jaxbelt" says
so.

A file is a line with a checksum and a pickle. To load it runs its code, so the folder has to belong
to the user alone. Files are written under another name and then renamed: a process that is killed
leaves no part of one. Without room the least recently used go.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import io
import logging
import os
import pickle
import platform
import secrets
import stat
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ..identity import fingerprint, is_installed
from .widths import is_cpu

_log = logging.getLogger("jaxbelt")

#: Whether programs are kept at all.
ON = os.environ.get("JAXBELT_CACHE", "1") not in ("", "0")

#: First line of every file, before its checksum; the number grows when the format changes.
MAGIC = b"jaxbelt program 1 "
SUFFIX = ".program"
#: Bytes that the folder may have before the least recently used programs go; the part that stays.
BOUND = 2**30
LEFT = 0.9
#: Seconds after which a file that was not renamed is known to be left behind.
ABANDONED = 3600.0
#: Packages on whose versions programs depend.
PACKAGES = "jax jaxlib equinox diffrax optimistix lineax numpy".split()


# --- the folder -----------------------------------------------------------------------------------


def folder() -> Path | None:
    """The folder of the programs, made where it is missing; None: nothing is kept.

    It is `programs` in JAXBELT_CACHE_DIR, or else in the user's cache folder.
    """
    return _usable_folder(place()) if ON else None


def place() -> Path:
    """Where the folder is, or would be."""
    own = os.environ.get("JAXBELT_CACHE_DIR")
    if own:
        return Path(own).absolute() / "programs"
    import platformdirs

    return platformdirs.user_cache_path("jaxbelt") / "programs"


@functools.lru_cache(maxsize=16)
def _usable_folder(path: Path) -> Path | None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.mkdir(mode=0o700, exist_ok=True)
        reason = _not_the_users_alone(path)
    except OSError as error:
        reason = f"it cannot be made ({error})"
    if reason:
        _log.warning("compiled programs are not kept in %s: %s", path, reason)
    return None if reason else path


def _not_the_users_alone(path: Path) -> str:
    """Why others may have written there; empty where they cannot have."""
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode):
        return "it is no folder"
    if hasattr(os, "getuid"):
        if found.st_uid != os.getuid():
            return "it belongs to another user"
        if found.st_mode & 0o077:
            return "others may use it, too (its mode has to be 0700)"
    return ""


class Entry(NamedTuple):
    """A file of the folder."""

    used: float
    size: int
    path: Path


def entries() -> list[Entry]:
    """The programs that are kept, the least recently used one first."""
    path = folder()
    return sorted(one for one in _files(path) if one.path.suffix == SUFFIX) if path else []


def _files(path: Path) -> Iterator[Entry]:
    # Other processes take files away at any moment.
    with contextlib.suppress(OSError), os.scandir(path) as found:
        for one in found:
            with contextlib.suppress(OSError):
                facts = one.stat(follow_symlinks=False)
                yield Entry(facts.st_mtime, facts.st_size, Path(one.path))


def clear() -> int:
    """Remove all programs; returns how many there were."""
    path, count = folder(), 0
    for one in _files(path) if path else ():
        with contextlib.suppress(OSError):
            one.path.unlink()
            count += one.path.suffix == SUFFIX
    return count


def _evict(path: Path) -> None:
    files = sorted(_files(path))
    for one in files:
        if one.path.suffix != SUFFIX and one.used < time.time() - ABANDONED:
            with contextlib.suppress(OSError):
                one.path.unlink()
    kept = [one for one in files if one.path.suffix == SUFFIX]
    total = sum(one.size for one in kept)
    goal = total if total <= BOUND else LEFT * BOUND
    for one in kept:
        if total <= goal:
            break
        with contextlib.suppress(OSError):
            one.path.unlink()
        total -= one.size


# --- files ----------------------------------------------------------------------------------------


def _read(path: Path, key: str) -> bytes | None:
    """The contents of a file, or None where it is missing or not what was written."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        _log.warning("%s cannot be read (%s); it is compiled anew", path, error)
        return None
    head, _, contents = data.partition(b"\n")
    if head != _first_line(key, contents):
        _discard(path, "is damaged")
        return None
    with contextlib.suppress(OSError):
        os.utime(path)
    return contents


def _first_line(key: str, contents: bytes) -> bytes:
    return MAGIC + hashlib.sha256(key.encode() + contents).hexdigest().encode()


def _discard(path: Path, reason: str) -> None:
    _log.warning("%s %s; the program is compiled anew", path, reason)
    with contextlib.suppress(OSError):
        path.unlink()


def _write(path: Path, key: str, contents: bytes) -> None:
    part = path.with_name(f"{secrets.token_hex(8)}.part")
    try:
        with part.open("wb") as file:
            file.write(_first_line(key, contents) + b"\n")
            file.write(contents)
        part.replace(path)
        _evict(path.parent)
    except OSError as error:
        _log.warning("%s cannot be written: %s", path, error)
        with contextlib.suppress(OSError):
            part.unlink()


# --- what a program is known by -------------------------------------------------------------------


@functools.cache
def surroundings() -> str:
    """Checksum of what all programs depend on: sources, versions, processor, settings."""
    versions = [f"{name} {importlib.metadata.version(name)}" for name in PACKAGES]
    flags = [os.environ.get(name, "") for name in ("XLA_FLAGS", "LIBTPU_INIT_ARGS")]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    parts = [_sources(), sys.version, *versions, *flags, _processor(), str(cores)]
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _sources() -> str:
    """A checksum of the package's source."""
    top, digest = Path(__file__).parent.parent, hashlib.sha256()
    for path in sorted(top.rglob("*.py")):
        contents = path.read_bytes()
        digest.update(f"{path.relative_to(top)} {len(contents)}\n".encode() + contents)
    return digest.hexdigest()


#: Folders of jaxbelt on whose modules programs depend. All of them are imported at once.
FOLDERS = "numerics model kernel motion cycles sweeps bifurcations inverse".split()


def _constants() -> list[str]:
    """Constants, with names in capitals, of jaxbelt's modules, with their present values: a session
    that changes one has programs of its own, and leaves none to others."""
    found = []
    for name, module in sorted(sys.modules.items()):
        if name.startswith("jaxbelt.") and name.split(".")[1] in FOLDERS and name != __name__:
            for key, value in vars(module).items():
                if key.isupper() and isinstance(value, bool | int | float | str | tuple):
                    text = repr(value)
                    found.append(f"{name} {key} {text}" if " at 0x" not in text else "")
    return found


def _processor() -> str:
    """What the processor can do; XLA makes code for all of it."""
    words = ("model name", "flags", "features", "cpu part", "cpu implementer")
    try:
        lines = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
        described = [line for line in lines if line.lower().startswith(words)]
    except OSError:
        described = [platform.processor()]
    return "\n".join([sys.platform, platform.machine(), *described])


# --- programs -------------------------------------------------------------------------------------


class Hole:
    """Stands for an array in a tree."""

    def __reduce__(self) -> str:
        return "HOLE"


HOLE = Hole()


class KeptProgram(NamedTuple):
    """A compiled program of arrays, and how its results are put together.

    call: makes a list of arrays from a list of arrays. structure: of the tree of results; rest:
    its leaves, with `HOLE` in place of every array.
    """

    call: Callable[[list[Any]], list[Any]]
    structure: Any
    rest: list[Any]

    def __call__(self, arrays: list[Any]) -> Any:
        out = iter(self.call(arrays))
        leaves = [next(out) if one is HOLE else one for one in self.rest]
        return jax.tree.unflatten(self.structure, leaves)


def type_of_leaf(leaf: Any) -> Any:
    """The type of an argument: shape, dtype, and whether the dtype is weak."""
    if isinstance(leaf, jax.Array):
        return leaf.shape, leaf.dtype, leaf.weak_type
    if isinstance(leaf, np.ndarray | np.generic):
        return leaf.shape, leaf.dtype, False
    return type(leaf)


@functools.cache
def _config() -> Any:
    from jax._src import config

    return config


@functools.cache
def are_kept() -> bool:
    """Whether programs are kept: it is not switched off, and JAX's settings are known."""
    try:
        return ON and isinstance(jax_settings(), tuple)
    except Exception as error:
        _log.warning("compiled programs are not kept: %s: %s", type(error).__name__, error)
        return False


def jax_settings() -> tuple[Any, ...]:
    """The settings of JAX that programs depend on, hashable."""
    return _config().trace_context(), _config().debug_nans.value, _config().debug_infs.value


def can_be_kept() -> bool:
    """Whether programs can be kept with the present settings: those for the CPU as the only device,
    without checks of values underway."""
    watched = (
        _config().debug_nans.value or _config().debug_infs.value or _config().disable_jit.value
    )
    return is_cpu() and jax.device_count() == 1 and not watched


def key_of(function: Callable, template: Any, signatures: Sequence[Any], options: Any) -> str:
    """Key of a program, by all that it depends on; raises where this cannot be known."""
    name = getattr(function, "__module__", ""), getattr(function, "__qualname__", "")
    mark = fingerprint((name, function, template, options))
    # Words with an address are left out: they are of an object of JAX, empty outside of traces.
    context = [word for word in map(repr, jax_settings()[0]) if " at 0x" not in word]
    parts = surroundings(), _constants(), mark, [str(one) for one in signatures], context
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def compile_and_keep(
    key: str, function: Callable, template: Any, arrays: list[Any], options: Any
) -> KeptProgram | None:
    """Compile the program of a function and keep it; None where it cannot be compiled this way."""
    results: list[Any] = []

    def flat(arrays):
        args, kwargs = with_arrays(template, arrays)
        leaves, structure = jax.tree.flatten(function(*args, **kwargs))
        results[:] = structure, [HOLE if eqx.is_array(leaf) else leaf for leaf in leaves]
        return [leaf for leaf in leaves if eqx.is_array(leaf)]

    named = getattr(function, "func", function)  # of a partial
    name = getattr(named, "__name__", "program")
    flat.__name__ = flat.__qualname__ = f"{name}_{key[:8]}"
    try:
        call = _compile(flat, arrays, options)
    except Exception:  # of the function; it is raised again where this is compiled as usual
        return None
    program = KeptProgram(call, *results)
    keep(key, program, template)
    return program


def _compile(function: Callable, arrays: list[Any], options: Any) -> Any:
    """The function, compiled for the arrays. It must not come out of JAX's own cache, for then it
    could not be loaded again: its name is its own, and it is never written to that cache."""
    with _config().persistent_cache_min_compile_time_secs(1e9):
        return jax.jit(function).lower(arrays).compile(compiler_options=options)


def with_arrays(template: Any, arrays: Sequence[Any]) -> Any:
    """The tree with arrays in its holes."""
    leaves, structure = jax.tree.flatten(template)
    rest = iter(arrays)
    filled = [next(rest) if one is HOLE else one for one in leaves]
    return jax.tree.unflatten(structure, filled)


def keep(key: str, program: KeptProgram, template: Any) -> None:
    """Keep a program that was compiled and not called yet.

    template: the tree of its arguments, with a `HOLE` for every array.
    """
    path = folder()
    if path is None:
        return
    try:
        contents = _file_of(program, template)
    except Exception as error:  # of whatever the insides of JAX and of results raise
        _log.info("a program is not kept: %s: %s", type(error).__name__, error)
        return
    _write(path / (key + SUFFIX), key, contents)


def _file_of(program: KeptProgram, template: Any) -> bytes:
    from jax.experimental import serialize_executable

    compiled: Any = program.call
    unloaded = compiled._executable._unloaded_executable
    for what in ("host_callbacks", "keepalive", "unordered_effects", "ordered_effects"):
        if getattr(unloaded, what):
            raise ValueError(f"it has {what}")
    executable, arrays, out = serialize_executable.serialize(compiled)
    known = _own_objects(template)
    results = _pickled(jax.tree.unflatten(program.structure, program.rest), known)
    if _results_in(results, known) != (program.structure, program.rest):
        raise ValueError("its results do not come back as they were")
    needs_lapack = b"lapack" in executable
    return pickle.dumps((executable, results, arrays.num_leaves, out.num_leaves, needs_lapack))


def load(key: str, template: Any) -> KeptProgram | None:
    """The program that was kept under a key, ready to be called; None: there is none."""
    path = folder()
    contents = path and _read(path / (key + SUFFIX), key)
    if not (path and contents):
        return None
    try:
        return _unpacked(contents, template)
    except Exception as error:
        _discard(path / (key + SUFFIX), f"cannot be loaded ({type(error).__name__}: {error})")
        return None


def _unpacked(contents: bytes, template: Any) -> KeptProgram:
    from jax.experimental import serialize_executable

    executable, results, arrays, out, needs_lapack = pickle.loads(contents)
    if needs_lapack:
        _start_lapack()
    trees = [jax.tree.structure(one) for one in ((([0] * arrays,), {}), [0] * out)]
    call = serialize_executable.deserialize_and_load(executable, *trees)
    return KeptProgram(call, *_results_in(results, _own_objects(template)))


@functools.cache
def _start_lapack() -> None:
    """Have jaxlib find LAPACK, which it does when it compiles; a loaded program would crash."""
    from jaxlib.cpu import _lapack

    _lapack.initialize()


def _results_in(pickled: bytes, known: list[Any]) -> tuple[Any, list[Any]]:
    """`structure` and `rest` of the results, see `KeptProgram`."""

    class Unpickler(pickle.Unpickler):
        def persistent_load(self, pid):
            return known[pid]

    leaves, structure = jax.tree.flatten(Unpickler(io.BytesIO(pickled)).load())
    return structure, leaves


# A user's classes and functions are in arguments and come back in results. They cannot be found by
# name, so a file contains their numbers among those of the arguments.


def _own_objects(template: Any) -> list[Any]:
    found: list[Any] = []

    class Pickler(pickle.Pickler):
        def persistent_id(self, obj):
            if not _is_own(obj):
                return None
            if not any(one is obj for one in found):
                found.append(obj)
            return "own"

    Pickler(io.BytesIO()).dump(template)
    return found


def _pickled(value: Any, known: list[Any]) -> bytes:
    class Pickler(pickle.Pickler):
        def persistent_id(self, obj):
            if not _is_own(obj):
                return None
            return next((i for i, one in enumerate(known) if one is obj), None)

    with io.BytesIO() as file:
        Pickler(file).dump(value)
        return file.getvalue()


def _is_own(obj: Any) -> bool:
    return isinstance(obj, type | FunctionType) and not is_installed(obj)


def trial() -> bool:
    """Whether a small program comes back from its pickle and gives the same."""

    def trial_of_kept_programs(arrays):
        return [2 * arrays[0]]

    call = _compile(trial_of_kept_programs, [np.ones(2)], None)
    structure = jax.tree.structure((0, 0))
    template = (HOLE, "word")
    packed = _file_of(KeptProgram(call, structure, [HOLE, "word"]), template)
    found = _unpacked(packed, template)([np.ones(2)])
    return found[0].tolist() == [2.0, 2.0] and found[1] == "word"
