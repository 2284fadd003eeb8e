"""Checks of a user's reducer: its methods are tried on shapes, before any run."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from ..checks import require, shape_in_words
from ..model.oscillator import Oscillator
from .along import Motion
from .moments import AtSection, check_moments, checked
from .observers import RunEnd, RunEvent


def check_reducer(reducer: Any, osc: Oscillator) -> None:
    """Raises a `ValueError` that names the method of `observe` that is not as `sweep` describes
    it."""
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
        integrals = _tried("rates", "(osc, motion)", lambda m: reducer.rates(osc, m), motion)
    state = _tried(
        "init", "(osc, x1, x2)", lambda x1, x2: reducer.init(osc, x1, x2), number, number
    )
    place = number, number, number
    event = jax.eval_shape(RunEvent, *place, code, code, moment, integrals)
    new = _tried("update", "(state, event)", reducer.update, state, event)
    same = jax.tree.map(jnp.shape, new) == jax.tree.map(jnp.shape, state)
    came = f"{shape_in_words(new)} where init returns {shape_in_words(state)}"
    require(same, "observe.update", "a method that returns a state such as init does", came)
    end = jax.eval_shape(RunEnd, *place, code, integrals)
    results = _tried("finish", "(state, end)", reducer.finish, state, end)
    expected = "a method that returns a dictionary of results"
    require(isinstance(results, Mapping), "observe.finish", expected, shape_in_words(results))
    strange = [name for name in results if not isinstance(name, str)]
    require(not strange, "observe.finish", f"{expected} by their names", strange)
    without = f"{expected} without status, which is the run's own"
    require("status" not in results, "observe.finish", without, "one with it")


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
    """Shapes of what a method returns."""
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
