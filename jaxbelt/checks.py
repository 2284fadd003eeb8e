"""What a user may pass in, checked once at the public edge.

Every check runs before tracing and raises a `ValueError` that names the field, what was expected
and what came. Under `jit`, `vmap` and derivatives values are not known, so only their dtype and
shape are checked there; results then carry a status and NaN instead of an exception.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from .numerics.compiling import is_concrete, require_own_threads

TURN_ON_FLOAT64 = 'jax.config.update("jax_enable_x64", True)'


def pick(tree: Any, index: Any) -> Any:
    """The tree with every array indexed; where it is known in NumPy, which compiles nothing."""
    if is_concrete((tree, index)):
        # Put there as they are: jnp.asarray compiles a program for every shape.
        return jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[index], tree))
    return jax.tree.map(lambda leaf: leaf[index], tree)


def require(condition: Any, field: str, expected: str, got: Any) -> None:
    """Raise `ValueError("<field> must be <expected>, got <got>")` unless `condition` holds.

    Where `expected` tells a number, ask first: to print an array takes longer than to check it.
    """
    if not condition:
        raise ValueError(f"{field} must be {expected}, got {got}")


def require_usable_jax() -> None:
    """Raise in a forked process, and unless JAX is set to 64-bit floats.

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

    Python numbers and integer arrays are converted; a 32-bit float is refused, because the digits
    that it lacks are not there to be restored. What is known stays known inside a trace.
    """
    numbers = as_numbers(value, field, shape)
    if isinstance(numbers, Tracer):
        return jnp.asarray(numbers, dtype=jnp.float64)
    with jax.ensure_compile_time_eval():
        return jnp.asarray(numbers, dtype=jnp.float64)


def as_numbers(value: Any, field: str, shape: tuple[int | None, ...] = ()) -> Array | np.ndarray:
    """The same, but left in NumPy if it is known: for what goes into a compiled function anyway."""
    require_usable_jax()
    dtype = getattr(value, "dtype", None)
    if dtype is None:
        try:
            value = np.asarray(value)
        except (ValueError, TypeError):
            # a sequence that holds tracers
            try:
                value = jnp.stack([jnp.asarray(v, dtype=jnp.float64) for v in value])
            except Exception:
                raise ValueError(f"{field} must be a number, got {value!r}") from None
        dtype = value.dtype
        if not np.issubdtype(dtype, np.number):
            raise ValueError(f"{field} must be a number, got {value!r}")
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


def check_finite(value: Any, field: str) -> None:
    """Raise unless every known number of the array `value` is finite."""
    if not isinstance(value, Tracer):
        require(np.isfinite(value).all(), field, "finite", value)


def check_nonnegative(value: Any, field: str) -> None:
    """Raise unless every known number of `value` is finite and >= 0."""
    check_finite(value, field)
    if not isinstance(value, Tracer):
        require((np.asarray(value) >= 0).all(), field, ">= 0", value)


def check_positive(value: Any, field: str) -> None:
    """Raise unless every known number of `value` is finite and > 0."""
    check_finite(value, field)
    if not isinstance(value, Tracer):
        require((np.asarray(value) > 0).all(), field, "> 0", value)


def number(value: Any) -> str:
    """A number as a short text for a repr; what is traced or batched is shown by its type."""
    if is_concrete(value) and np.ndim(value) == 0:
        return f"{float(value):.12g}"
    return f"{value.dtype}{list(np.shape(value))}"
