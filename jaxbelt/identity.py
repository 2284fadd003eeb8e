"""Fingerprints of values and code: equal fingerprints mean equal behaviour.

Results that are kept on disk, and compiled programs, belong to the code that made them. The
fingerprint of a user's function or class covers its bytecode and constants and, recursively, all
that it reaches: defaults, closure cells, the globals that it reads by name, the functions that it
calls, base classes. Code of installed packages and of Python counts by name and version. What such
code reads from files, the clock or the environment does not count, as it cannot be known
beforehand.
"""

import builtins
import copyreg
import dis
import functools
import hashlib
import importlib.metadata
import inspect
import pickle
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path
from types import (
    BuiltinFunctionType,
    CodeType,
    FunctionType,
    GetSetDescriptorType,
    MappingProxyType,
    MemberDescriptorType,
    ModuleType,
)
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

#: Types of values that their repr determines.
REPR_TYPES = (type(None), bool, int, float, complex, str, bytes, type(...), type(NotImplemented))
#: Builtins that read what the code does not name.
READS_ANYTHING = ("eval", "exec", "globals", "open", "input", "__import__")
#: Attributes of Python's modules that lead to any other module.
ALL_MODULES = (("sys", "modules"), ("importlib", "import_module"))
#: Attributes that name or describe a function, a class or an object, and do not affect what it
#: does.
BOOKKEEPING = frozenset(
    (
        *("__module__", "__name__", "__qualname__", "__doc__", "__dict__", "__weakref__"),
        *("__annotations__", "__annotate__", "__annotate_func__", "__annotations_cache__"),
        *("__type_params__", "__parameters__", "__orig_bases__", "__static_attributes__"),
        *("__firstlineno__", "__match_args__", "__signature__", "__slots__"),
        *("__dataclass_fields__", "__dataclass_params__", "__abstractmethods__", "_abc_impl"),
    )
)


class FingerprintError(ValueError):
    """Raised for a value that has no fingerprint."""


def fingerprint(value: Any, name: str = "a function or object of one's own") -> str:
    """Fingerprint of a value: a text of 32 letters, the same in every process.

    Args:
        value: A number, text, array, container, function, class, or an object of any class whose
            state `pickle` would find: dataclasses, Equinox modules, tree definitions, partials.
        name: Words for the value in the message of the error.

    Returns:
        A text. It changes with the code of a user's functions, their constants and what they reach,
        with the version of a package whose code they use (jaxbelt is one, also from a checkout),
        and with the Python whose bytecode it is; not with names of functions, lines and comments.

    Raises:
        FingerprintError: If there is none, as for a generator, an open file, or a module of the
            user's own that is passed as a value.
    """
    return _Reading(name).digest(value, "")


def fingerprint_or_unique(value: Any) -> Any:
    """Fingerprint of a value; without one, an object that equals nothing else.

    For programs in memory: a value without a fingerprint is compiled again and not mistaken for
    another.
    """
    try:
        return fingerprint(value)
    except FingerprintError:
        return object()


def own_parts(value: Any) -> list[Any]:
    """The user's own functions, classes and objects that a value is made of, without those that
    they reach in turn."""
    reading = _Reading("a value", skips=True)
    reading.digest(value, "")
    return reading.own


def fingerprint_of_known(value: Any) -> str:
    """As `fingerprint`, but parts that have none count as unknown instead of raising."""
    return _Reading("a value", skips=True).digest(value, "")


class _Reading:
    """One call of `fingerprint`: the digests of the objects that were met; own: the user's own
    objects that were not met inside of another one of the user's own."""

    def __init__(self, name: str, *, skips: bool = False):
        self.name = name
        #: Whether parts that have no fingerprint count as unknown instead of raising.
        self.skips = skips
        self.own: list[Any] = []
        self.inside_own = False
        self.known: dict[int, str] = {}
        self.open: list[int] = []
        # Keeps objects alive, so that no id is used twice.
        self.alive: list[Any] = []

    def digest(self, value: Any, place: str) -> str:
        """Digest of a value; place: where the value was met, for messages."""
        if type(value) in REPR_TYPES:
            return _digest_of(type(value).__name__, repr(value))
        key = id(value)
        if key in self.open:  # it reaches itself
            return f"{len(self.open) - self.open.index(key)} levels up"
        if key not in self.known:
            self.alive.append(value)
            self.open.append(key)
            begins = not self.inside_own and _is_users(value)
            if begins:
                self.own.append(value)
                self.inside_own = True
            try:
                self.known[key] = _digest_of(*self.parts(value, place))
            except FingerprintError:
                if not self.skips:
                    raise
                self.known[key] = "unknown"
            finally:
                self.open.pop()
                self.inside_own = self.inside_own and not begins
        return self.known[key]

    def parts(self, value: Any, place: str) -> Iterator[str]:
        """Parts of an object, each as a text."""
        name = _installed_name(value)
        if name:
            yield name
        elif isinstance(value, np.ndarray | np.generic | jax.Array):
            yield from self.of_array(value, place)
        elif type(value) in (tuple, list, dict, set, frozenset, MappingProxyType):
            yield type(value).__name__
            yield from self.of_container(value, place)
        elif isinstance(value, CodeType):
            yield from self.of_code(value, place)
        elif isinstance(value, FunctionType):
            yield from self.of_function(value, f"{place}{value.__qualname__}")
        elif isinstance(value, type):
            yield from self.of_class(value, f"{place}{value.__qualname__}")
        elif isinstance(value, ModuleType):
            self.refuse(place, f"the module {value.__name__} as a value: name what is read of it")
        elif isinstance(value, staticmethod | classmethod):
            yield from (type(value).__name__, self.digest(value.__func__, place))
        elif isinstance(value, property):
            yield "property"
            for function in (value.fget, value.fset, value.fdel):
                yield self.digest(function, place)
        elif isinstance(value, functools.cached_property):
            yield from ("cached_property", self.digest(value.func, place))
        elif isinstance(value, MemberDescriptorType | GetSetDescriptorType):
            yield value.__name__
        elif isinstance(value, jax.tree_util.PyTreeDef):
            yield "PyTreeDef"
            yield self.digest(value.node_data(), place)
            yield from (self.digest(child, place) for child in value.children())
        elif isinstance(value, COMPILED):
            yield from (type(value).__name__, self.digest(vars(value)["__wrapped__"], place))
        else:
            yield from self.of_object(value, place)

    def refuse(self, place: str, came: str, error: Exception | None = None) -> NoReturn:
        where = f" in {place.rstrip(': ')}" if place else ""
        raise FingerprintError(
            f"{self.name} must be made of numbers, texts, arrays, functions, classes and objects "
            f"of these, got{where} {came}"
        ) from error

    def of_array(self, value: Any, place: str) -> Iterator[str]:
        if isinstance(value, Tracer):
            self.refuse(place, "a traced array, whose numbers are not known")
        if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            yield str(value.dtype)
            value = jax.random.key_data(value)
        kind = "scalar" if isinstance(value, np.generic) else "array"
        value = np.asarray(value)
        yield from (kind, str(value.dtype.descr), str(value.shape))
        if value.dtype.hasobject:
            yield from self.of_container(value.ravel().tolist(), place)
        else:
            yield hashlib.sha256(value.tobytes()).hexdigest()

    def of_container(self, value: Any, place: str) -> Iterator[str]:
        if isinstance(value, set | frozenset):
            yield from sorted(self.digest(part, place) for part in value)
        elif isinstance(value, dict | MappingProxyType):
            for key, part in value.items():
                inner = f"{place}{key}: " if isinstance(key, str) else place
                yield from (self.digest(key, place), self.digest(part, inner))
        else:
            yield from (self.digest(part, place) for part in value)

    # --- functions

    def of_code(self, code: CodeType, place: str) -> Iterator[str]:
        """A compiled function without its place in the source."""
        yield f"python {sys.version_info[0]}.{sys.version_info[1]}"
        yield code.co_code.hex()
        yield code.co_exceptiontable.hex()
        counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount
        flags = code.co_flags & ~inspect.CO_NESTED  # the flag depends on where it is written
        names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
        yield repr((counts, flags, names))
        yield self.digest(code.co_consts, place)

    def of_function(self, function: FunctionType, place: str) -> Iterator[str]:
        package = _package_of(function.__globals__.get("__name__"))
        yield package or "own"
        yield self.digest(function.__code__, f"{place}: ")
        yield self.digest(function.__defaults__, f"defaults of {place}: ")
        yield self.digest(function.__kwdefaults__, f"defaults of {place}: ")
        attributes = {k: v for k, v in vars(function).items() if k not in BOOKKEEPING}
        yield self.digest(attributes, f"attributes of {place}: ")
        cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        names = {name: _content(cell) for name, cell in cells}
        if package:
            # The version identifies the code of a package, but not the values in its closures.
            yield from (self.digest(value, f"{place}: ") for value in names.values())
            return
        for name, value in self.reads(function.__code__, function.__globals__, names, place):
            yield from (name, self.digest(value, f"{name} of {place}: "))

    def reads(
        self, code: CodeType, scope: dict[str, Any], cells: dict[str, Any], place: str
    ) -> Iterator[tuple[str, Any]]:
        """Names that a function and its inner functions look up, with their present values."""
        instructions = list(dis.get_instructions(code))
        for i, one in enumerate(instructions):
            if one.opname == "IMPORT_NAME":
                package = _package_of(one.argval)
                if package is None and not self.skips:  # the user's own, or not imported until now
                    self.refuse(place, f"an import of {one.argval or 'a module'}: do it outside")
                yield one.argval, package or "unknown"
            name = one.argval
            if one.opname in GLOBALS:
                value = scope.get(name, getattr(builtins, name, MISSING))
                if name in READS_ANYTHING and name not in scope:
                    self.refuse(place, f"{name}, which may read anything")
            elif one.opname in CELLS and name in cells:
                value = cells[name]
            else:
                continue
            following = iter(instructions[i + 1 :])
            if isinstance(value, ModuleType) and i + 1 < len(instructions):
                asked = value.__name__, instructions[i + 1].argval
                if asked in ALL_MODULES:
                    self.refuse(place, f"{'.'.join(asked)}, which may read anything")
            while isinstance(value, ModuleType) and _package_of(value.__name__) is None:
                attribute = next(following, one)
                if attribute.opname not in ("LOAD_ATTR", "LOAD_METHOD"):
                    self.refuse(place, f"the module {name} as a value: name what is read of it")
                name = f"{name}.{attribute.argval}"
                value = getattr(value, attribute.argval, MISSING)
            yield name, value
        for constant in code.co_consts:
            if isinstance(constant, CodeType):
                yield from self.reads(constant, scope, cells, place)

    # --- classes and objects

    def of_class(self, kind: type, place: str) -> Iterator[str]:
        yield kind.__name__
        yield self.digest(type(kind), f"{place}: ")
        yield from (self.digest(base, f"{place}: ") for base in kind.__bases__)
        for name, value in vars(kind).items():
            if name not in BOOKKEEPING:
                yield from (name, self.digest(value, f"{place}.{name}: "))

    def of_object(self, value: Any, place: str) -> Iterator[str]:
        """Covers what `pickle` would need to make the object again."""
        kind = type(value)
        place = f"{place}{kind.__qualname__}: "
        try:
            reduced = (copyreg.dispatch_table.get(kind) or _as_pickled)(value)
        except Exception as error:
            self.refuse(place, f"a {kind.__name__}, whose behaviour cannot be known", error)
        if isinstance(reduced, str):
            module = pickle.whichmodule(value, reduced)  # pyright: ignore[reportAttributeAccessIssue]
            package = _package_of(module)
            if package is None:
                self.refuse(place, f"the {kind.__name__} {reduced}, known by its name only")
            yield f"{package} {reduced}"
            return
        parts: list[Any] = [*reduced, None, None, None]
        make, arguments, state, entries, items = parts[:5]
        yield from (self.digest(kind, place), self.digest(make, place))
        yield self.digest(arguments, place)
        yield self.digest(_without_caches(kind, state), place)
        yield self.digest([*(entries or ())], place)
        yield self.digest([*(items or ())], place)


#: Types of compiled functions, by JAX or in C, that keep the original function.
COMPILED = type(jax.jit(lambda: 0)), type(functools.lru_cache(lambda: 0))
#: Bytecode instructions that look up names: globals, and variables of enclosing functions.
GLOBALS = ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS")
CELLS = ("LOAD_DEREF", "LOAD_CLASSDEREF", "LOAD_FROM_DICT_OR_DEREF")
#: Stands for a name without a value.
MISSING = "nothing of this name"


def _digest_of(*parts: str) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


def _as_pickled(value: Any) -> Any:
    return value.__reduce_ex__(4)


def _is_users(value: Any) -> bool:
    """Whether something is a user's own function or class, or an object of such a class."""
    if isinstance(value, FunctionType):
        return _package_of(value.__globals__.get("__name__")) is None
    kind = value if isinstance(value, type) else type(value)
    # Modules in C have no file, and may not be there.
    top = str(kind.__module__).partition(".")[0]
    return top in sys.modules and not (_package_of(kind.__module__) or _package_of(top))


def _content(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:
        return MISSING


def _without_caches(kind: type, state: Any) -> Any:
    """State of an object without what was computed from the rest of it, or describes it."""
    if isinstance(state, tuple) and len(state) == 2 and isinstance(state[1], dict):
        return tuple(_without_caches(kind, part) for part in state)  # attributes, and slots
    if not isinstance(state, dict):
        return state
    cached = functools.cached_property

    def is_state(name):
        return name not in BOOKKEEPING and not isinstance(getattr(kind, str(name), None), cached)

    return {name: value for name, value in state.items() if is_state(name)}


def _installed_name(value: Any) -> str:
    """Package, version and name of what an installed package or Python defines under its name;
    empty for anything else."""
    if isinstance(value, ModuleType):
        package = _package_of(value.__name__)
        return f"{package} {value.__name__}" if package else ""
    if not isinstance(value, (type, FunctionType, BuiltinFunctionType, *COMPILED)):
        return ""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", "")
    if not isinstance(module, str) or not (package := _package_of(module)):
        return ""
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    # Classes that packages make on the fly have no other name.
    is_theirs = found is value or (isinstance(value, type) and "<" in name)
    return f"{package} {module}.{name}" if is_theirs else ""


def _package_of(module: Any) -> str | None:
    """Name and version of the package of a module; None for the user's own, or one that is not
    loaded."""
    if not isinstance(module, str) or module not in sys.modules:
        return None
    file = getattr(sys.modules.get(module), "__file__", None)
    return _package_in(module.partition(".")[0], file)


@functools.cache
def _package_in(top: str, file: str | None) -> str | None:
    """Name and version of an installed package; top: first word of the module's name."""
    parents = Path(file).parents if file else ()
    if top == __name__.partition(".")[0]:  # also from a checkout
        return f"{top} {importlib.metadata.version(top)}"
    is_installed = any(folder.name in ("site-packages", "dist-packages") for folder in parents)
    if top in sys.stdlib_module_names and not is_installed:
        folders = {Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib")}
        if not file or folders & set(parents):
            return f"python {sys.version_info[0]}.{sys.version_info[1]}"
    # A package that is installed as a link to its sources changes without its version.
    names = _distributions().get(top, ()) if is_installed else ()
    return (
        ", ".join(f"{one} {importlib.metadata.version(one)}" for one in sorted(set(names))) or None
    )


@functools.cache
def _distributions() -> Any:
    return importlib.metadata.packages_distributions()


def is_installed(value: Any) -> bool:
    """Whether a value is a class or function that a package or Python defines under its name."""
    return _installed_name(value) != ""
