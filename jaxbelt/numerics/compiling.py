"""How functions are compiled so that nobody waits long.

`jit`, `traced_once` and `each` save the time of compiling, `one_kernel` that of running.
"""

import contextvars
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from ..checks import is_concrete, require_own_threads

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
        require_own_threads()
        outermost = is_concrete((args, kwargs, _probe()))
        return (quick() if outermost else plain)(*args, **kwargs)

    return call


def traced_once(function: Callable) -> Any:
    """The function itself, for functions that stand in many places: its trace is kept."""
    filter_jit: Any = eqx.filter_jit
    return filter_jit(function, inline=True)


#: How XLA's CPU compiler is told to put a call into one piece of machine code, and not to dissolve
#: it before. It does so by itself with loops on less than a kilobyte.
IN_ONE_PIECE = {"xla_cpu_small_call": "true", "inlineable": "false"}
#: What is inside of the call would inherit the mark.
NOT_MARKED = {"xla_cpu_small_call": "false", "inlineable": "true"}
#: Operations that it can do there, those of Equinox's loops among them. It cannot sort, nor write
#: to places that differ in a batch, nor call libraries.
POSSIBLE = frozenset(
    """abs acos acosh add add_any and argmax argmin asin asinh atan atan2 atanh broadcast_in_dim
    cbrt ceil clamp concatenate cond convert_element_type copy cos cosh cumsum
    custom_jvp_call div dynamic_slice eq exp exp2 expm1 floor gather ge gt integer_pow iota
    is_finite jit le le_to log log1p logistic lt max min mul ne neg nextafter nonbatchable not
    or pow reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum rem reshape rev
    round rsqrt scan select_if_vmap select_n sign sin sinh slice sqrt square squeeze stack
    stop_gradient sub tan tanh transpose unvmap_any while xor""".split()
)
#: Nor share out the work on large arrays among threads; with 3,000 numbers it did not want to, with
#: 4,096 it did, and failed.
LARGEST = 1024


#: Whether what is traced becomes part of a piece already.
_is_part = contextvars.ContextVar("is_part", default=False)


def _is_possible(jaxpr: Any) -> bool:
    for equation in jaxpr.eqns:
        sizes = [variable.aval.size for variable in equation.outvars]
        if equation.primitive.name not in POSSIBLE or max(sizes, default=0) > LARGEST:
            return False
        parts = [getattr(one, "jaxpr", one) for one in jax.tree.leaves(equation.params)]
        if not all(_is_possible(part) for part in parts if hasattr(part, "eqns")):
            return False
    return True


def one_kernel(function: Callable) -> Callable:
    """The same function of arrays, that closes over none; on the CPU as one piece of machine code.

    Else XLA's runtime calls a piece of code for every few operations, every time round a loop, and
    for a few numbers that takes longer than the operations do. In a batch, in derivatives, and
    where something in it is not possible in one piece, the function is as it was.
    """

    @jax.custom_jvp
    def in_one_piece(*args):
        if _is_part.get():
            return function(*args)
        mark = _is_part.set(True)
        try:
            closed, shape = jax.make_jaxpr(function, return_shape=True)(*args)
        finally:
            _is_part.reset(mark)
        if not _is_possible(closed.jaxpr):
            return function(*args)
        out = _in_one_piece(closed.jaxpr, closed.consts, jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(shape), out)

    @in_one_piece.defjvp
    def _(primals, tangents):
        return jax.jvp(function, primals, tangents)

    @functools.wraps(function)
    def call(*args):
        return (in_one_piece if jax.default_backend() == "cpu" else function)(*args)

    return call


def _in_one_piece(jaxpr: Any, *args) -> list[jax.Array]:
    """What the jaxpr gives, as one piece of machine code where it is not in a batch."""

    def evaluate(constants, arguments):
        return jaxpr_as_fun(ClosedJaxpr(jaxpr, constants))(*arguments)

    @jax.jit
    def unmarked(*args):
        with set_xla_metadata(**NOT_MARKED):
            # Handed through: XLA fails where an argument is not used,
            return evaluate(*args), args

    @jax.custom_batching.custom_vmap
    def alone(*args):
        with set_xla_metadata(**IN_ONE_PIECE):
            # or is a constant, which the barrier hides from it.
            return unmarked(*lax.optimization_barrier(args))[0]

    @alone.def_vmap
    def _(axis_size, batched, *args):
        axes = jax.tree.map(lambda one: 0 if one else None, tuple(batched))
        out = jax.vmap(evaluate, axes, axis_size=axis_size)(*args)
        return out, jax.tree.map(lambda _: True, out)

    return alone(*args)


def each(function: Callable) -> Callable:
    """`jax.vmap` of a function of arrays; on the CPU one row after another.

    There a loop over some dozen rows takes as long as they do together, and compiles in half the
    time.
    """
    if jax.default_backend() != "cpu":
        return jax.vmap(function)
    return lambda *rows: lax.map(lambda row: function(*row), rows)
