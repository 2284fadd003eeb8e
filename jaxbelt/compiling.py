"""How functions are compiled so that nobody waits long: `jit`, `traced_once` and `each`."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax import lax

from .checks import is_concrete

#: XLA's newer emitter of fused loops takes half as long again to compile programs like these, many
#: small operations on few numbers, and its code is no faster.
QUICK = (("xla_cpu_use_fusion_emitters", False),)


@functools.cache
def known(options: tuple[tuple[str, Any], ...]) -> dict[str, Any] | None:
    """The options where this version of XLA knows them and runs on the CPU, else None."""
    if jax.default_backend() != "cpu":
        return None
    try:
        jax.jit(lambda: 0, compiler_options=dict(options))()
    except jax.errors.JaxRuntimeError:
        return None
    return dict(options)


@jax.jit
def _probe() -> Any:
    """Known outside of a trace, and traced inside."""
    return 0


def jit(function: Callable) -> Any:
    """`equinox.filter_jit`, compiled with the options `QUICK`.

    Inside of another trace, where JAX takes no options, without them.
    """
    filter_jit: Any = eqx.filter_jit
    plain = filter_jit(function)

    @functools.cache
    def quick():
        return filter_jit(function, compiler_options=known(QUICK))

    @functools.wraps(function)
    def call(*args, **kwargs):
        outermost = is_concrete((args, kwargs, _probe()))
        return (quick() if outermost else plain)(*args, **kwargs)

    return call


def traced_once(function: Callable) -> Any:
    """The function itself, for functions that stand in many places: its trace is kept."""
    filter_jit: Any = eqx.filter_jit
    return filter_jit(function, inline=True)


def each(function: Callable) -> Callable:
    """`jax.vmap` of a function of arrays; on the CPU one row after another.

    There a loop over some dozen rows takes as long as they do together, and compiles in half the
    time.
    """
    if jax.default_backend() != "cpu":
        return jax.vmap(function)
    return lambda *rows: lax.map(lambda row: function(*row), rows)
