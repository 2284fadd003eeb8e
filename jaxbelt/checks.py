"""Checks of arguments, made once at the public edge.

Every check runs before tracing and raises a `ValueError` that names the field, what was expected
and what came (see `in_words`), in one line. Under `jit`, `vmap` and derivatives values are not
known, so only their dtype and shape are checked there; results then carry a status and NaN instead
of an exception.
"""

import functools
import inspect
import operator
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from .numerics.compiling import is_concrete, is_outermost, require_own_threads
from .spelling import did_you_mean, refuse_other_names

#: Other names for the arguments of belts, laws, forces, oscillators and machines.
OTHER_NAMES = {
    **{"v": "velocity", "speed": "velocity", "law": "friction", "mu": "friction"},
    **dict.fromkeys(("n", "normal", "force", "load"), "normal_force"),
    **{"m": "mass", "k": "stiffness", "spring": "stiffness", "belt": "belts"},
    **dict.fromkeys(("c", "dashpot", "damper", "zeta"), "damping"),
    **{"mu_s": "static", "mus": "static", "mu_k": "kinetic", "muk": "kinetic", "mud": "kinetic"},
    **dict.fromkeys(("freq", "omega", "w"), "frequency"),
}
TURN_ON_FLOAT64 = 'jax.config.update("jax_enable_x64", True)'


class KnownNames(eqx.Module):
    """A record that raises a `TypeError`, with the names that it takes, for an unknown argument."""

    def __new__(cls, *_: Any, **given: Any):
        if given:
            taken = list(inspect.signature(cls.__init__).parameters.values())[1:]
            if not any(one.kind == one.VAR_KEYWORD for one in taken):
                refuse_other_names(cls.__name__, [one.name for one in taken], given, OTHER_NAMES)
        return super().__new__(cls)


def pick(tree: Any, index: Any) -> Any:
    """The tree with every array indexed; concrete arrays are indexed in NumPy, which compiles
    nothing."""
    if is_concrete((tree, index)):
        # device_put, because jnp.asarray compiles a program for every shape.
        return jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[index], tree))
    return jax.tree.map(lambda leaf: leaf[index], tree)


def require(condition: Any, field: str, expected: str, got: Any) -> None:
    """Raises `ValueError("<field> must be <expected>, got <got>")` unless `condition` holds.

    got: words, or any other value, which is put `in_words`. If `expected` has a number to format,
    check the condition first: printing an array takes longer than checking it.
    """
    if not condition:
        came = got if isinstance(got, str) else in_words(got)
        raise ValueError(f"{field} must be {expected}, got {came}")


def require_value(condition: Any, field: str, expected: str, value: Any) -> None:
    """`require` whose message has the value `in_words`, also where the value is a text."""
    if not condition:
        require(False, field, expected, in_words(value))


def check_key(key: Any) -> None:
    """Raises a `ValueError` unless it is a key of JAX, of either sort."""
    dtype, shape = getattr(key, "dtype", np.dtype(object)), np.shape(key)
    typed = jnp.issubdtype(dtype, jax.dtypes.prng_key) and shape == ()
    raw = dtype == np.uint32 and shape == (2,)
    require_value(typed or raw, "key", "one key, such as jax.random.key(0)", key)


#: Largest number of letters that describe a value in a message.
LONGEST = 100


def in_words(value: Any) -> str:
    """A value in one line: numbers as they are, long arrays by their shape, functions and
    classes by name."""
    if isinstance(value, Tracer):
        return f"a traced {type(value).__name__} of shape {np.shape(value)}"
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return _array_in_words(value)
    if inspect.isclass(value):
        return f"the class {value.__name__}, not an object of it"
    if hasattr(type(value), "plot") and hasattr(type(value), "table"):
        return f"a {type(value).__name__}"  # a result, which has many numbers
    if inspect.isroutine(value):
        return f"the function {getattr(value, '__qualname__', value)}"
    if isinstance(value, tuple | list) and type(value) in (tuple, list) and len(value) <= 6:
        parts = ", ".join(map(in_words, value))
        text = f"[{parts}]" if isinstance(value, list) else f"({parts}{',' * (len(value) == 1)})"
    else:
        text = " ".join(repr(value).split())
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def shape_in_words(tree: Any) -> str:
    """What a function returned when it was called on shapes, in words."""
    if isinstance(tree, jax.ShapeDtypeStruct):
        return f"an array of {tree.dtype} of shape {tree.shape}"
    return f"a {type(tree).__name__} of {len(jax.tree.leaves(tree))} arrays"


def _array_in_words(value: Any) -> str:
    if np.size(value) > 8 or jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        ends = f", from {value[0]:.6g} to {value[-1]:.6g}" if _is_row(value) else ""
        return f"an array of {value.dtype} of shape {value.shape}{ends}"
    return str(value) if value.ndim < 2 else " ".join(str(value).split())


def _is_row(value: Any) -> bool:
    return (
        isinstance(value, np.ndarray)
        and value.ndim == 1
        and np.issubdtype(value.dtype, np.floating)
    )


def require_one_of(value: Any, names: Iterable[str], field: str, more: str = "") -> None:
    """Raises unless `value` is one of some words; suggests one.

    more: what else is allowed, such as " or a reducer".
    """
    names = list(names)
    if not (isinstance(value, str) and value in names):
        *first, last = (f'"{name}"' for name in names)
        joint = ", " if more else " or "
        expected = (", ".join(first) + joint + last if first else last) + more
        require(False, field, expected, in_words(value) + did_you_mean(value, names))


def check_belt(value: Any, belts: int, field: str = "belt", more: str = "") -> None:
    """Raises unless `value` is the number of one of the belts; more: what else is allowed."""
    there = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < belts
    expected = f"0 to {belts - 1}{more}" if belts > 1 else f"0{more}: there is one belt"
    require_value(there, field, expected, value)


def require_callable(value: Any, field: str, expected: str) -> None:
    """Raises unless `value` can be called."""
    require_value(callable(value), field, expected, value)


def require_wish(value: Any, field: str) -> None:
    """Raises unless `value` is True, False or None (undecided)."""
    is_wish = value is None or isinstance(value, bool)
    require_value(is_wish, field, "True, False or None", value)


#: Largest number of anything that is counted.
MOST_WHOLE = np.iinfo(np.int32).max


def as_whole(value: Any, field: str, least: int = 1) -> int:
    """`value` as an integer from `least` to MOST_WHOLE, or a `ValueError`."""
    fits = isinstance(value, int | np.integer) and not isinstance(value, bool) and value >= least
    kinds = {0: "an integer >= 0", 1: "a positive integer"}
    require_value(fits, field, kinds.get(least, f"an integer >= {least}"), value)
    require(value <= MOST_WHOLE, field, f"an integer of at most {MOST_WHOLE}", "a larger one")
    return int(value)


def check_no_start(t0: Any) -> None:
    """Raises unless a time at which runs begin is 0."""
    is_zero = np.ndim(t0) == 0 and t0 == 0.0
    require_value(is_zero, "t0", "0 for an oscillator that does not know the time", t0)


def as_interval(value: Any, field: str) -> tuple[float, float]:
    """`value` as two numbers (first, last), first < last, or a `ValueError`."""
    expected = "(first, last), two numbers with first < last"
    require(value is not None, field, expected, "None")
    is_pair = not isinstance(value, str | dict) and np.shape(value) == (2,)
    require_value(is_pair, field, expected, value)
    ends = np.asarray(as_numbers(value, field, (2,)))
    check_finite(ends, field)
    first, last = ends.tolist()
    require(first < last, field, expected, f"({first:.12g}, {last:.12g})")
    return first, last


def refuse_interval(values: Any, field: str) -> None:
    """Raises if an interval (first, last) came where all values are needed: it would be read as
    two values."""
    if isinstance(values, tuple) and len(values) == 2:
        first, last = map(in_words, values)
        # Values have to increase: two that do not would be refused as well.
        are_numbers = all(
            np.shape(one) == () and np.asarray(one).dtype.kind in "iuf" for one in values
        )
        ascends = are_numbers and bool(values[0] < values[1])
        if are_numbers and not ascends:
            first, last = last, first
        expected = f"all values, increasing, such as np.linspace({first}, {last}, 201)"
        came = in_words(values) + (f"; for two values write {list(values)}" if ascends else "")
        require(False, field, expected, came)


def as_path(value: Any, field: str) -> Path:
    """`value` as the path of a file or folder, or a `ValueError`."""
    require_value(
        isinstance(value, str | os.PathLike), field, "the path of a file or folder", value
    )
    return Path(value)


def check_arguments(make: Any, names: Sequence[str], field: str, others: str = "") -> None:
    """Raises unless `make` is a function that can be called with these arguments alone.

    others: in words, further names that stand for something else than arguments of `make`.
    """
    expected = "a function that returns an Oscillator, such as jb.presets.class_b"
    require_callable(make, field, expected)
    try:
        parameters = inspect.signature(make).parameters
    except (TypeError, ValueError):
        return
    if not any(p.kind == p.VAR_KEYWORD for p in parameters.values()):
        for name in names:
            known = f"arguments of {field} ({', '.join(parameters)}){others}"
            came = repr(name) + did_you_mean(name, parameters)
            require(name in parameters, "axes", known, came)
    free = [
        one.name
        for one in parameters.values()
        if one.default is one.empty and one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
    ]
    missing = [name for name in free if name not in names]
    if missing:
        fix = ", ".join(f"{name}=..." for name in missing)
        alone = f"a function of {', '.join(names)} alone" if names else "a function of nothing"
        require(
            False,
            field,
            alone,
            f"one that needs {', '.join(missing)}, too: functools.partial({field}, {fix}) fixes it",
        )


def traceable(function: Callable[[], Any], field: str, expected: str) -> Any:
    """Returns `function()`, which calls a user's function; a `ValueError` if that cannot be traced.

    An error that jaxbelt itself raises passes unchanged.
    """
    try:
        return function()
    except (TypeError, AttributeError, jax.errors.JAXTypeError) as error:
        came = str(error).partition("\n")[0]
        raise ValueError(
            f"{field} must be {expected}, made of what JAX can trace (jnp.sqrt and jnp.where, say, "
            f"not math.sqrt, np.sqrt, float or if), got {type(error).__name__}: {came}"
        ) from error


def require_one_float(found: Any, field: str, expected: str) -> None:
    """Raises a `ValueError` unless the result of `jax.eval_shape` is one float64."""
    fits = isinstance(found, jax.ShapeDtypeStruct) and found.shape == ()
    require(fits and found.dtype == np.float64, field, expected, found)


def outside_of_traces(function: Callable, instead: str = "") -> Any:
    """Decorates a public function that cannot be called under `jit`, `vmap` or derivatives.

    The numbers decide how much such a function computes. A call with traced arguments raises, and
    so does an argument with an unknown name. instead: end of the message, what to do in a trace.
    """
    name, signature = function.__name__, inspect.signature(function)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        require_own_threads()
        refuse_other_names(name, signature.parameters, kwargs)
        traced = None
        if not _is_known((args, kwargs)):
            given = signature.bind_partial(*args, **kwargs).arguments
            traced = next(field for field, one in given.items() if not _is_known(one))
        scope = f"{name} is not for jit, vmap or derivatives"
        _refuse_traces(name, scope, traced, instead)
        return function(*args, **kwargs)

    return call


def require_outside_of_jit(name: str, hint: str, **given: Any) -> None:
    """Raises where a public function that takes derivatives, but not `jit` and `vmap`, is in these.

    hint: what to do there. given: its arguments, of which the first that is traced is named.
    """

    def is_known(value: Any) -> bool:
        return is_concrete(value) or is_concrete(jax.lax.stop_gradient(value))

    _refuse_traces(name, hint, next((f for f, one in given.items() if not is_known(one)), None))


def _refuse_traces(name: str, scope: str, traced: str | None, instead: str = "") -> None:
    """Raises if an argument, of that name, is traced, or the call is within a trace."""
    if traced is not None:
        require(False, traced, f"known: {scope}", f"a traced one{instead}")
    if not is_outermost():
        raise ValueError(f"{name} must be called outside of jax.jit: {scope}{instead}")


def _is_known(value: Any) -> bool:
    try:
        return is_concrete(value)
    except ValueError:
        return True  # a dictionary with keys that cannot be sorted is no argument of anything


def require_usable_jax() -> None:
    """Raises in a forked process, and unless JAX is set to 64-bit floats.

    Event times are meaningless in 32 bits.
    """
    require_own_threads()
    if jax.dtypes.canonicalize_dtype(np.float64) != np.float64:
        raise ValueError(
            "jaxbelt must have 64-bit floats, got JAX set to float32; before anything else, "
            f"call {TURN_ON_FLOAT64}"
        )


def as_array(value: Any, field: str, shape: tuple[int | None, ...] = ()) -> Array:
    """`value` as a float64 array of the given shape (None: any length), or a `ValueError`.

    Python numbers and integer arrays are converted; a 32-bit float is refused, because its missing
    digits cannot be restored. Concrete values stay concrete inside a trace.
    """
    numbers = as_numbers(value, field, shape)
    if isinstance(numbers, Tracer):
        return jnp.asarray(numbers, dtype=jnp.float64)
    with jax.ensure_compile_time_eval():
        return jnp.asarray(numbers, dtype=jnp.float64)


def as_finite(value: Any, field: str, shape: tuple[int | None, ...] = ()) -> Array:
    """`as_array` of finite numbers, as far as they are known."""
    array = as_array(value, field, shape)
    check_finite(array, field)
    return array


def scalar(field: str) -> Callable[[Any], Array]:
    """Converter of a field that is a number, see `as_array`."""
    return lambda value: as_array(value, field)


def as_positive_number(value: Any, field: str) -> Array | np.ndarray:
    """`value` as a number, > 0 as far as it is known, see `as_numbers`."""
    number = as_numbers(value, field)
    check_positive(number, field)
    return number


def as_size(value: Any, field: str) -> Array | np.ndarray:
    """`as_positive_number` for a size in the user's units; None becomes NaN, which stands for the
    oscillator's own size."""
    return np.asarray(np.nan) if value is None else as_positive_number(value, field)


def as_positive(value: Any, field: str) -> float:
    """`value` as a finite number > 0, or a `ValueError`."""
    number = float(as_array(value, field))
    check_positive(number, field)
    return number


def as_tolerance(value: Any, field: str) -> float | None:
    """`value` as a tolerance > 0 in the user's units; None: the default, in own units."""
    return None if value is None else as_positive(value, field)


def as_numbers(value: Any, field: str, shape: tuple[int | None, ...] = ()) -> Array | np.ndarray:
    """Like `as_array`, but concrete values stay in NumPy; for arguments of compiled functions."""
    require_usable_jax()
    given, wanted = value, "a number" if shape == () else "numbers"
    dtype = getattr(value, "dtype", None)
    if dtype is None:
        try:
            value = np.asarray(value)
        except (ValueError, TypeError):
            # a sequence that holds tracers
            try:
                value = jnp.stack([jnp.asarray(v, dtype=jnp.float64) for v in value])
            except Exception:
                raise ValueError(f"{field} must be {wanted}, got {in_words(given)}") from None
        dtype = value.dtype
        if not np.issubdtype(dtype, np.number):
            raise ValueError(f"{field} must be {wanted}, got {in_words(given)}")
    elif not isinstance(value, jax.Array | np.ndarray | np.generic):
        # Such as a column of pandas, or a tensor of another library.
        value = _of_other_library(value, field, wanted)
        dtype = value.dtype
    if jnp.issubdtype(dtype, jnp.complexfloating) or not (
        jnp.issubdtype(dtype, jnp.integer) or dtype == jnp.float64
    ):
        raise ValueError(
            f"{field} must be float64, got {dtype}"
            + (f"; {TURN_ON_FLOAT64} turns float64 on" if dtype == jnp.float32 else "")
        )
    array = value if isinstance(value, jax.Array) else np.asarray(value)
    array = array.astype(np.float64)
    fits = len(array.shape) == len(shape) and all(
        want is None or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        wanted = (
            "a scalar (use jax.vmap for batches)"
            if shape == ()
            else f"of shape ({', '.join('n' if n is None else str(n) for n in shape)})"
        )
        raise ValueError(f"{field} must be {wanted}, got shape {array.shape}")
    return array


def _of_other_library(value: Any, field: str, wanted: str) -> np.ndarray:
    try:
        array = np.asarray(value)
    except Exception:
        array = np.array(None)
    if not np.issubdtype(array.dtype, np.number):
        name = f"{type(value).__module__.partition('.')[0]}.{type(value).__name__}"
        raise ValueError(f"{field} must be {wanted}, got a {name} of {value.dtype}")
    return array


class Rule(NamedTuple):
    """A condition on a parameter.

    Attributes:
        field: Name of the parameter.
        given: The parameter, and what the condition depends on besides it.
        judge: judge(*given) says whether the condition holds, an array.
        expected: The condition in words, {1} being given[1].
    """

    field: str
    given: tuple[Any, ...]
    judge: Callable[..., Any]
    expected: str

    def enforce(self, owner: str) -> None:
        """Raises a `ValueError` if the condition is known not to hold; owner: words after the
        field."""
        if any(isinstance(one, Tracer) for one in self.given):
            return
        given = tuple(map(np.asarray, self.given))
        if not np.all(self.judge(*given)):
            require(False, self.field + owner, self.expected.format(*given), given[0])

    def holds(self) -> Any:
        """Whether the condition holds, an array; traced if something given is traced."""
        return self.judge(*self.given)


def _is_finite(value: Any) -> Any:
    return abs(value) < np.inf


def be_finite(field: str, value: Any) -> list[Rule]:
    """The rule that a parameter is finite."""
    return [Rule(field, (value,), _is_finite, "finite")]


def be_nonnegative(field: str, value: Any) -> list[Rule]:
    """The rules that a parameter is finite and >= 0."""
    return [*be_finite(field, value), Rule(field, (value, 0.0), operator.ge, ">= 0")]


def be_positive(field: str, value: Any) -> list[Rule]:
    """The rules that a parameter is finite and > 0."""
    return [*be_finite(field, value), Rule(field, (value, 0.0), operator.gt, "> 0")]


def check_finite(value: Any, field: str) -> None:
    """Raises unless every known number of the array `value` is finite."""
    _enforce(be_finite(field, value))


def check_nonnegative(value: Any, field: str) -> None:
    """Raises unless every known number of `value` is finite and >= 0."""
    _enforce(be_nonnegative(field, value))


def check_positive(value: Any, field: str) -> None:
    """Raises unless every known number of `value` is finite and > 0."""
    _enforce(be_positive(field, value))


def _enforce(rules: Sequence[Rule]) -> None:
    for rule in rules:
        rule.enforce("")


def number(value: Any) -> str:
    """A number as a short text for a repr; traced or batched values are shown by their type."""
    if is_concrete(value) and np.ndim(value) == 0:
        return f"{float(value):.12g}"
    return f"{value.dtype}{list(np.shape(value))}"


class Parameters(KnownNames):
    """A record of parameters with rules; its repr is code that constructs it again."""

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        _refuse_overrides(cls)

    def rules(self) -> list[Rule]:
        """Conditions on the parameters."""
        return []

    def check(self, owner: str) -> None:
        """Raises a `ValueError` naming `owner` if a known parameter is out of range."""
        for rule in type(self).rules(self):
            rule.enforce(f" of {owner}")

    def __repr__(self) -> str:
        values = ", ".join(
            f"{name}={number(value) if eqx.is_array(value) else repr(value)}"
            for name, value in vars(self).items()
        )
        return f"{type(self).__name__}({values})"


def _refuse_overrides(kind: type) -> None:
    """Raises a `TypeError` for a user's subclass that overrides a public method of a class of this
    package that is not abstract: its formula is built into programs."""
    ours = [one for one in kind.__mro__ if is_of_this_package(one)]
    if kind in ours:
        return
    named = [one for one in ours if issubclass(one, Parameters) and one.__name__[0] != "_"]
    ready = [one for one in named if one is not Parameters and not inspect.isabstract(one)]
    known = {name for one in ours for name in vars(one)} - {"rules"}
    changed = [name for name in vars(kind) if name in known and not name.startswith("_")]
    if ready and changed:
        roots = [f"subclass jb.{one.__name__}" for one in ours if inspect.isabstract(one)]
        raise TypeError(
            f"{kind.__name__}.{changed[0]} must not replace that of {ready[0].__name__}, whose "
            f"formula is built in: {roots[-1] if roots else 'there is no way to have another one'}"
        )


def is_of_this_package(kind: type) -> bool:
    """Whether a class is one of jaxbelt's."""
    return kind.__module__.partition(".")[0] == __name__.partition(".")[0]
