"""How functions are compiled: `jit`, with options that spare the user's time."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

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
    plain = eqx.filter_jit(function)

    @functools.cache
    def quick():
        return eqx.filter_jit(function, compiler_options=known(QUICK))

    @functools.wraps(function)
    def call(*args, **kwargs):
        outermost = is_concrete((args, kwargs, _probe()))
        return (quick() if outermost else plain)(*args, **kwargs)

    return call
