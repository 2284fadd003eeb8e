"""Checks of a user's reducer: its methods are tried on shapes, before any run."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from ..checks import require, shape_in_words
from ..model.oscillator import Oscillator
from .along import Motion, rates_of
from .moments import AtSection, check_moments, checked
from .observers import RunEnd, RunEvent


def check_reducer(reducer: Any, osc: Oscillator) -> None:
    """Raises a `ValueError` or `TypeError` if a method of the reducer is not as `sweep` describes
    it; the message names the method."""
    number, code = jax.ShapeDtypeStruct((), jnp.float64), jax.ShapeDtypeStruct((), jnp.int64)
    moment = integrals = None
    if hasattr(reducer, "at") or hasattr(reducer, "rates"):
        moment = code
    if hasattr(reducer, "at"):
        check_sections(checked(reducer.at), osc)
        check_moments(reducer.at, osc)
    if hasattr(reducer, "rates"):
        forces = jax.ShapeDtypeStruct((len(osc.belts),), jnp.float64)
        motion = jax.eval_shape(Motion, number, number, number, number, forces)
        integrals = _tried("rates", "(osc, motion)", lambda m: rates_of(reducer, osc, m), motion)
        expected = "a method that returns a number, or a tuple or dictionary of numbers"
        for rate in jax.tree.leaves(integrals):
            require(not rate.shape, "observe.rates", expected, shape_in_words(rate))
    state = _tried(
        "init", "(osc, x1, x2)", lambda x1, x2: reducer.init(osc, x1, x2), number, number
    )
    # The kernel knows no weak types.
    state = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), state)
    place = number, number, number
    event = jax.eval_shape(RunEvent, *place, code, code, moment, integrals)
    new = _tried("update", "(state, event)", reducer.update, state, event)
    same = jax.tree.map(jnp.shape, new) == jax.tree.map(jnp.shape, state)
    came = f"{shape_in_words(new)} where init returns {shape_in_words(state)}"
    require(same, "observe.update", "a method that returns a state such as init does", came)
    kept = _tried(
        "update", "(state, event)", functools.partial(jax.tree.map, _number_kept), new, state
    )
    for after, before in zip(*map(jax.tree.leaves, (kept, state)), strict=True):
        expected = "a method that returns numbers of the types that init returns"
        came = f"{after.dtype} where init returns {before.dtype}"
        _require_type(after.dtype == before.dtype, "observe.update", expected, came)
    end = jax.eval_shape(RunEnd, *place, code, integrals)
    results = _tried("finish", "(state, end)", reducer.finish, state, end)
    expected = "a method that returns a dictionary of results"
    require(isinstance(results, Mapping), "observe.finish", expected, shape_in_words(results))
    strange = [name for name in results if not isinstance(name, str)]
    require(not strange, "observe.finish", f"{expected} by their names", strange)
    without = f"{expected} without status, which is the run's own"
    require("status" not in results, "observe.finish", without, "one with it")
    expected = "a method that returns numbers, or vectors, by their names"
    for name, value in results.items():
        # A tuple of numbers is a vector.
        parts = value if isinstance(value, tuple) else (value,)
        fits = all(isinstance(part, jax.ShapeDtypeStruct) for part in parts)
        fits = fits and not (isinstance(value, tuple) and any(part.shape for part in parts))
        _require_type(fits, "observe.finish", expected, f"{shape_in_words(value)} for {name}")


def _number_kept(new: Any, old: Any) -> Any:
    """A number of the new state, with the type that `lanes.choose` gives it."""
    return jnp.where(True, new, old)


def _require_type(condition: Any, field: str, expected: str, came: str) -> None:
    """Like `require`, but raises a `TypeError`."""
    if not condition:
        raise TypeError(f"{field} must be {expected}, got {came}")


def check_sections(moments: Sequence[Any], osc: Oscillator) -> None:
    """Raises a `ValueError` unless the function of each `AtSection` returns one number."""
    number = jax.ShapeDtypeStruct((), jnp.float64)
    for one in moments:
        if isinstance(one, AtSection):
            field, kind = "function of AtSection", "a function of (osc, x1, x2)"
            function = functools.partial(one.function, osc)
            value = _shape_of(field, kind, function, number, number)
            fits = isinstance(value, jax.ShapeDtypeStruct) and value.shape == ()
            fits = fits and jnp.issubdtype(value.dtype, jnp.floating)
            require(fits, field, f"{kind} that returns one number", shape_in_words(value))


def _tried(name: str, arguments: str, method: Callable, *args: Any) -> Any:
    """Shapes of what a method of the reducer returns, or a `ValueError` that names the method."""
    return _shape_of(f"observe.{name}", f"a method of {arguments}", method, *args)


def _shape_of(field: str, kind: str, function: Callable, *args: Any) -> Any:
    """Shapes of what a function returns, or a `ValueError` that names its field."""
    try:
        return jax.eval_shape(function, *args)
    except Exception as error:
        came = str(error).partition("\n")[0]
        raise ValueError(
            f"{field} must be {kind} made of what JAX can trace "
            f"(jnp.where, say, not if), got {type(error).__name__}: {came}"
        ) from error
