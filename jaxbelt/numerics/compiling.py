"""Everything that relies on what JAX, XLA and Equinox do not document, behind one switch.

- `jit`, `traced_once` and `each` save time of compiling; `one_kernel`, `one_kernel_alone`,
  `lanes_in_one_kernel`, `with_batches`, `wide`, `any_lane` and `where_any` save time of running.
- `programs` keeps on disk what `jit` and `wide` compile; it uses undocumented features, too.
- `depends` and `is_affine` look at what a function does with its arguments.
- `require_own_threads` looks at whether JAX was in use before a process was forked.

With JAXBELT_PLAIN=1 in the environment ("plain" below) no undocumented feature is used; everything
works, slower. Without it, each feature is tried on a small example before its first use. One that
fails is left out from then on, with a warning.
"""

import contextlib
import contextvars
import functools
import os
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer

from . import programs, usercode
from .widths import SideBySide, is_cpu

#: Whether to use documented features only.
PLAIN = os.environ.get("JAXBELT_PLAIN", "0") not in ("", "0")

_works: dict[str, bool] = {}
_trying = threading.RLock()


def _usable(name: str, trial: Callable[[], bool]) -> bool:
    """Whether an undocumented feature may be used: it passed its trial, which is run once."""
    if PLAIN:
        return False
    if name not in _works:
        with _trying:
            if name not in _works:
                _try(name, trial)
    return _works[name]


def _try(name: str, trial: Callable[[], bool]) -> None:
    try:
        # In another thread the trial is outside of any trace: JAX's traces belong to their thread.
        with ThreadPoolExecutor(1) as apart:
            _works[name] = apart.submit(trial).result()
        reason = "its result is wrong"
    except Exception as error:
        _works[name] = False
        reason = f"{type(error).__name__}: {error}"
    # As the process ends every trial fails, and a warning is of no use.
    if not _works[name] and threading.main_thread().is_alive():
        warnings.warn(
            f"jaxbelt goes on without {name}, which does not work with JAX {jax.__version__} here "
            f"({reason}): results are the same, some take longer. JAXBELT_PLAIN=1 in the "
            "environment leaves out everything of this kind, and this warning.",
            RuntimeWarning,
            stacklevel=2,
        )


def is_concrete(value: Any) -> bool:
    """Whether the numbers in `value` are known now, that is, outside of a trace."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value))


@functools.cache
def the_solvers() -> Any:
    """diffrax, imported when something is compiled: it takes a quarter of a second."""
    # Arrays that it makes as it is imported must not be part of a trace.
    with jax.ensure_compile_time_eval():
        import diffrax

    return diffrax


# --- options of the compiler ----------------------------------------------------------------------

#: XLA's newer emitter of fused loops takes half as long again to compile programs like these, many
#: small operations on few numbers, and its code is no faster. Since JAX 0.11.1 there is no other
#: one, and 0.12 compiles as fast with it as 0.10 without.
QUICK = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11, 1) else {}
#: Vectors as wide as the processor has them, for many lanes side by side.
WIDE = {"xla_cpu_prefer_vector_width": 512}


def known(options: dict[str, Any]) -> dict[str, Any] | None:
    """The options where JAX runs on the CPU and this version of XLA knows them, else None."""

    def trial():
        return int(jax.jit(lambda: 7, compiler_options=options)()) == 7

    if is_cpu() and _usable(f"XLA's options {', '.join(options)}", trial):
        return options
    return None


@jax.jit
def _probe() -> Any:
    """A number, concrete outside of a trace and a tracer inside."""
    return 0


def is_outermost(*values: Any) -> bool:
    """Whether the numbers in `values`, and those that are computed from here on, are known."""
    return is_concrete((values, _probe()))


def jit(function: Callable) -> Any:
    """`equinox.filter_jit`, compiled with the options `QUICK` and kept on disk, see `programs`.

    Inside of another trace, where JAX takes no options, it is compiled without them.
    """
    filter_jit: Any = eqx.filter_jit
    plain = filter_jit(function)

    @functools.cache
    def quick():
        return filter_jit(function, compiler_options=QUICK)

    kept = _Kept(function, eqx.is_array, lambda: known(QUICK))

    @functools.wraps(function)
    def call(*args, **kwargs):
        require_own_threads()
        leaves, structure = jax.tree.flatten((args, kwargs))
        with usercode.watched(leaves, structure):
            if not is_outermost(leaves):
                return plain(*args, **kwargs)
            program, arrays = kept.program(leaves, structure)
            if program is not None:
                return program(arrays)
            return quick()(*args, **kwargs) if known(QUICK) else plain(*args, **kwargs)

    return call


def wide(function: Callable) -> Any:
    """`jax.jit` for many lanes side by side, compiled with the options `WIDE` and kept on disk."""

    def options():
        return known(WIDE) if _has_wide_vectors() else None

    @functools.cache
    def plain(is_wide: bool):
        return jax.jit(function, compiler_options=WIDE if is_wide else None)

    kept = _Kept(function, lambda leaf: True, options)

    @functools.wraps(function)
    def call(*args):
        leaves, structure = jax.tree.flatten((args, {}))
        with usercode.watched(leaves, structure):
            program, arrays = kept.program(leaves, structure)
            return plain(bool(options()))(*args) if program is None else program(arrays)

    return call


#: Most programs of one function in memory; before one more, all of them are forgotten.
MOST_PROGRAMS = 4096


class _Kept:
    """The programs of a function, which are kept on disk.

    is_array: whether a leaf of the arguments is an array; other leaves are part of the program;
    options: gives the options of the compiler.
    """

    def __init__(self, function: Callable, is_array: Callable[[Any], bool], options: Callable):
        self.function, self.is_array, self.options = function, is_array, options
        #: Programs by the structure and types of their arguments, and by `programs.key_of`.
        self.called: dict[Any, programs.KeptProgram | None] = {}
        self.made: dict[str, programs.KeptProgram] = {}
        self.locks: dict[Any, Any] = {}
        usercode.forgotten_with_programs(self.called.clear)

    def program(self, leaves: list[Any], structure: Any) -> tuple[Any, list[Any]]:
        """The program of these arguments, None if it cannot be kept; and the arrays among them."""
        arrays, signatures = [], []
        if PLAIN or not programs.are_kept():
            return None, arrays
        for leaf in leaves:
            if self.is_array(leaf):
                arrays.append(leaf)
                signatures.append(programs.type_of_leaf(leaf))
            else:
                # 1, 1.0 and True are equal, and so are 0.0 and -0.0.
                signatures.append((type(leaf), repr(leaf) if type(leaf) is float else leaf))
        asked = structure, tuple(signatures), programs.jax_settings()
        try:
            if asked in self.called:
                return self.called[asked], arrays
        except TypeError:  # what is not hashable JAX refuses, too
            return None, arrays
        with self.locks.setdefault(asked, threading.RLock()):
            if asked not in self.called:
                if len(self.called) >= MOST_PROGRAMS:
                    self.called.clear()
                    self.made.clear()
                    self.locks.clear()
                self.called[asked] = self._found(leaves, structure, asked, arrays)
        return self.called[asked], arrays

    def _found(self, leaves, structure, asked, arrays) -> "programs.KeptProgram | None":
        """The program, loaded or compiled; None where it cannot be kept."""
        if programs.folder() is None or not programs.can_be_kept():
            return None
        holes = [programs.HOLE if self.is_array(leaf) else leaf for leaf in leaves]
        template = jax.tree.unflatten(structure, holes)
        options = self.options()
        signatures = [one for one, leaf in zip(asked[1], holes) if leaf is programs.HOLE]
        try:
            key = programs.key_of(self.function, template, signatures, options)
        except Exception:  # its fingerprint cannot be known
            return None
        if key not in self.made:
            program = programs.load(key, template)
            if program is None and _usable("compiled programs from disk", programs.trial):
                program = programs.compile_and_keep(key, self.function, template, arrays, options)
            if program is None:
                return None
            self.made[key] = program
        return self.made[key]


#: The names and structures for which `compiled_beside` has begun calls in this process.
_begun_beside: set[Any] = set()


@contextlib.contextmanager
def compiled_beside(name: str, like: Any, calls: Iterable[Callable[[], Any]]) -> Iterator[None]:
    """While the block runs a second thread makes the calls, so that their programs are compiled or
    loaded; XLA compiles two programs side by side in two thirds of the time.

    Once in a process for each name and structure of the tree `like`. What the calls return or raise
    is ignored; at the end of the block those that have not begun are left out. Only where programs
    are kept: a program that both threads ask for is compiled once by `jit`, but twice by JAX.
    """
    key = name, jax.tree.structure(like)
    is_kept = not PLAIN and programs.are_kept() and programs.folder() is not None
    if key in _begun_beside or not is_kept or os.cpu_count() == 1 or not is_outermost(like):
        yield
        return
    _begun_beside.add(key)

    def attempt(call):
        with contextlib.suppress(Exception):
            call()

    pool = ThreadPoolExecutor(1)
    for call in calls:
        pool.submit(attempt, call)
    try:
        yield
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


@functools.cache
def _has_wide_vectors() -> bool:
    try:
        return "avx512f" in Path("/proc/cpuinfo").read_text()
    except OSError:
        return False


def traced_once(function: Callable) -> Any:
    """The same function, its trace kept: for functions that are called at many places."""
    filter_jit: Any = eqx.filter_jit
    return filter_jit(function) if PLAIN else filter_jit(function, inline=True)


def _traced_once_anywhere(function: Callable) -> Callable:
    """The same function of arrays; its trace is kept.

    JAX keeps traces by the mesh, which is unset outside of custom rules and empty inside them. Here
    an unset mesh is replaced by an empty one, so that one trace serves both.
    """
    kept = jax.jit(function)

    @functools.wraps(function)
    def call(*args):
        mesh = jax.sharding.get_abstract_mesh()
        if not mesh.empty:
            return kept(*args)
        with jax.sharding.use_abstract_mesh(mesh):
            return kept(*args)

    return call


def power_of_two(count: int, least: int) -> int:
    """A count rounded up to a power of two, `least` or more, so that few shapes are compiled."""
    return max(least, 1 << (count - 1).bit_length())


def each(function: Callable) -> Callable:
    """`jax.vmap` of a function of trees with a row in each array; on the CPU one row after another.

    There a loop over some dozen rows takes as long as they do together, and compiles in half the
    time. Leaves that are no arrays are the same for all rows.
    """
    if not is_cpu():
        return eqx.filter_vmap(function, in_axes=lambda leaf: 0 if _is_array(leaf) else None)

    def mapped(*trees):
        rows, rest = eqx.partition(trees, _is_array)
        return lax.map(lambda row: function(*eqx.combine(row, rest)), rows)

    return mapped


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray)


def of_lane(function: Callable, batched, args) -> tuple[Callable, list[Any]]:
    """The function for one lane, as a function of the list of its batched leaves; and the list of
    these leaves with all lanes."""
    leaves, structure = jax.tree.flatten(args)
    flags = jax.tree.leaves(batched)

    def one(rows):
        rows = iter(rows)
        own = [next(rows) if flag else leaf for flag, leaf in zip(flags, leaves, strict=True)]
        return function(*jax.tree.unflatten(structure, own))

    return one, [leaf for flag, leaf in zip(flags, leaves, strict=True) if flag]


def with_batches(function: Callable, batch: Callable) -> Callable:
    """The same function of arrays, that closes over none; a batch of it is computed by
    batch(function, axis_size, batched, *args).

    batched: a tree of flags like args. Derivatives of a batch are those of the plain `vmap`.
    """
    # The batch and its derivatives contain the function, too: it is traced once for all.
    function = _traced_once_anywhere(function)
    lanes = _as_lanes(function, batch)

    @functools.wraps(function)
    def call(*args):
        usable = _usable("batches by a rule of one's own", _try_lanes)
        return (lanes if usable else function)(*args)

    return call


def lanes_in_one_kernel(function: Callable) -> Callable:
    """The same function of arrays, that closes over none; a batch of it is `one_kernel`."""

    def batch(_, axis_size, batched, *args):
        return one_kernel(jax.vmap(function, axes_of(tuple(batched)), axis_size=axis_size))(*args)

    lanes = with_batches(function, batch)

    @functools.wraps(function)
    def call(*args):
        return (function if _is_part.get() else lanes)(*args)

    return call


def one_kernel_alone(function: Callable) -> Callable:
    """`one_kernel`, but a batch is the function under `vmap`, with any kernels inside of it."""

    def batch(_, axis_size, batched, *args):
        return jax.vmap(function, axes_of(tuple(batched)), axis_size=axis_size)(*args)

    return with_batches(one_kernel(function), batch)


def axes_of(flags):
    """`in_axes` of `jax.vmap`: the first axis where flagged; the rest is the same for all lanes."""
    return jax.tree.map(lambda flag: 0 if flag else None, flags)


#: Lanes of a group, see `in_groups`.
GROUP = SideBySide(on_cpu=64, elsewhere=2**15)
#: So many lanes, or fewer, are not worth the longer compilation of a group.
FEW_LANES = 8


def in_groups(function: Callable) -> Callable:
    """The same function of arrays, that closes over none; a batch of it is done in groups of lanes,
    one after another. Its derivatives are not in groups."""

    def batch(_, axis_size, batched, *args):
        lane, leaves = of_lane(function, batched, args)
        size = GROUP.here
        if axis_size <= FEW_LANES:
            return each(lane)(leaves)
        if axis_size <= size:
            return jax.vmap(lane)(leaves)
        groups = -(-axis_size // size)
        # The last group is filled up with the last lane.
        lanes = np.minimum(np.arange(groups * size), axis_size - 1).reshape(groups, size)
        done = lax.map(lambda own: jax.vmap(lane)([leaf[own] for leaf in leaves]), lanes)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:axis_size], done)

    return with_batches(function, batch)


def more_rows(size: int, rows: int, leaf: jax.Array, is_row: bool, is_batched: bool) -> jax.Array:
    """A leaf of a batch, [size, rows, ..], as [size * rows, ..]; is_row: it has an axis of rows,
    is_batched: one of the batch; with neither axis it stays as it is."""
    if is_batched and not is_row:
        return jnp.repeat(leaf, rows, axis=0)
    if is_row and not is_batched:
        leaf = jnp.broadcast_to(leaf, (size, *leaf.shape))
    return leaf.reshape(-1, *leaf.shape[2:]) if is_row else leaf


def _as_lanes(function: Callable, batch: Callable) -> Callable:
    @jax.custom_batching.custom_vmap
    def lane(*args):
        return function(*args)

    @lane.def_vmap
    def _(axis_size, batched, *args):
        out = batch(lane, axis_size, batched, *args)
        return out, jax.tree.map(lambda _: True, out)

    @jax.custom_jvp
    def alone(*args):
        return lane(*args)

    @alone.defjvp
    def _(primals, tangents):
        return jax.jvp(function, primals, tangents)

    return alone


def _try_lanes() -> bool:
    def twice(lane, axis_size, batched, x, y):
        return (2 if tuple(batched) == (True, False) else 0) * x * y

    found = jax.vmap(_as_lanes(lambda x, y: x * y, twice), (0, None))(np.array([1.0, 2.0]), 3.0)
    return found.tolist() == [6.0, 12.0]


# --- one piece of machine code --------------------------------------------------------------------

#: Options that make XLA's CPU compiler put a call into one piece of machine code, and not dissolve
#: it before. It does so without them for loops on less than a kilobyte.
IN_ONE_PIECE = {"xla_cpu_small_call": "true", "inlineable": "false"}
#: Options of what is inside of the call, which would inherit `IN_ONE_PIECE`.
NOT_MARKED = {"xla_cpu_small_call": "false", "inlineable": "true"}
#: Operations that XLA can do in one piece, those of Equinox's loops among them. It cannot sort, nor
#: write to places that differ in a batch, nor call libraries.
POSSIBLE = frozenset(
    """abs acos acosh add add_any and argmax argmin asin asinh atan atan2 atanh broadcast_in_dim
    cbrt ceil clamp concatenate cond convert_element_type copy cos cosh cumsum custom_jvp_call
    empty2 div dynamic_slice dynamic_update_slice eq exp exp2 expm1 floor gather ge gt
    integer_pow iota is_finite jit le le_to log log1p logistic lt lt_to max min mul ne neg nextafter
    nonbatchable not or pow reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum
    rem remat2 reshape rev round rsqrt scan select_if_vmap select_n sign sin sinh slice sqrt
    square squeeze stack stop_gradient sub tan tanh transpose unvmap_any while xor""".split()
)
#: Largest array in a piece. XLA computes large loops on several threads, which fails inside one
#: piece (seen at 4,096 numbers, not at 3,000). There are pieces on the CPU only.
LARGEST = SideBySide(on_cpu=1024, elsewhere=2**30)

#: Whether the function that is being traced is part of a piece already.
_is_part = contextvars.ContextVar("is_part", default=False)


def one_kernel(function: Callable) -> Callable:
    """The same function of arrays, that closes over none; on the CPU as one piece of machine code.

    Otherwise XLA's runtime calls a piece of code for every few operations, every time round a loop,
    and for a few numbers that takes longer than the operations do. In a batch, in derivatives, and
    where an operation is not possible in one piece, the function is compiled as usual.
    """
    function = _traced_once_anywhere(function)
    piece = _as_piece(function)

    @functools.wraps(function)
    def call(*args):
        usable = is_cpu() and _usable("kernels of one piece", _try_piece)
        return (piece if usable else function)(*args)

    return call


def _as_piece(function: Callable) -> Callable:
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

    return in_one_piece


def _is_possible(jaxpr: Any) -> bool:
    for equation in jaxpr.eqns:
        sizes = [variable.aval.size for variable in equation.outvars]
        if equation.primitive.name not in POSSIBLE or max(sizes, default=0) > LARGEST.here:
            return False
        parts = [getattr(one, "jaxpr", one) for one in jax.tree.leaves(equation.params)]
        if not all(_is_possible(part) for part in parts if hasattr(part, "eqns")):
            return False
    return True


def _in_one_piece(jaxpr: Any, *args) -> list[jax.Array]:
    """The results of the jaxpr, computed in one piece of machine code, but as usual in a batch."""
    # Imported late: `_try_piece` detects a version of JAX that lacks them.
    from jax.experimental.xla_metadata import set_xla_metadata
    from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

    def evaluate(constants, arguments):
        return jaxpr_as_fun(ClosedJaxpr(jaxpr, constants))(*arguments)

    @jax.jit
    def unmarked(*args):
        with set_xla_metadata(**NOT_MARKED):
            # The arguments are returned, too: XLA fails where one of them is not used.
            return evaluate(*args), args

    @jax.custom_batching.custom_vmap
    def alone(*args):
        with set_xla_metadata(**IN_ONE_PIECE):
            # XLA also fails where an argument is a constant: the barrier hides that it is.
            return unmarked(*lax.optimization_barrier(args))[0]

    @alone.def_vmap
    def _(axis_size, batched, *args):
        out = jax.vmap(evaluate, axes_of(tuple(batched)), axis_size=axis_size)(*args)
        return out, jax.tree.map(lambda _: True, out)

    return alone(*args)


def _try_piece() -> bool:
    """A loop, with an argument that it does not use; its batch and derivative are traced only."""

    def halve(x, unused):
        return lax.while_loop(lambda state: state[0] > 1, lambda s: (s[0] / 2, s[1] + 1), (x, 0))

    def derivatives(x):
        return jax.jvp(lambda x: jax.vmap(_as_piece(halve), (0, None))(x, x), (x,), (x,))

    jax.eval_shape(derivatives, np.ones(2))
    x, n = jax.jit(_as_piece(halve))(40.0, np.ones(2))
    return (float(x), int(n)) == (0.625, 6)


# --- batches and arguments ------------------------------------------------------------------------


def any_lane(flag: jax.Array) -> jax.Array:
    """Whether a flag holds anywhere in a batch, one answer for all lanes.

    With it `lax.cond` computes only one branch under `vmap`, too. Plain: the lane's own flag, and
    both branches are computed in a batch.
    """

    def trial():
        from equinox.internal import unvmap_any

        one = jax.eval_shape(jax.vmap(unvmap_any, out_axes=None), np.array([False, True]))
        return (one.shape, one.dtype) == ((), bool)

    if _usable("Equinox's reductions of a batch", trial):
        from equinox.internal import unvmap_any

        return unvmap_any(flag)
    return flag


def where_any(flags: jax.Array, function: Callable[[], Any], otherwise: Any) -> Any:
    """function() if any of the flags is set, in any lane; else `otherwise`, a tree of the same
    shapes. For results that few lanes need, and seldom.

    On accelerators always function(): of so many lanes some need it, and the device would wait for
    the host to choose the branch. So lanes without the flag may hold either result.
    """
    if not is_cpu():
        return function()
    return lax.cond(any_lane(jnp.any(flags)), function, lambda: otherwise)


def depends(function: Callable, *args: Any) -> tuple[bool, ...]:
    """For each leaf of a function's result, whether it depends on the arguments, numbers.

    Plain: every float is taken to depend on them.
    """

    def trial():
        return _depends(lambda x: [x, lax.neg(np.ones(()))], True, 0.0) == (True, False)

    return _depends(function, _usable("what vmap leaves alone", trial), *args)


def _depends(function: Callable, usable: bool, *args: Any) -> tuple[bool, ...]:
    found = []

    def probe(*args):
        for leaf in jax.tree.leaves(function(*args)):
            # Under `vmap` what does not depend on the mapped arguments is a concrete number.
            found.append(not is_concrete(leaf) if usable else eqx.is_inexact_array(leaf))
        return 0

    pairs = jax.tree.map(lambda x: np.array([x, x]), args)
    jax.vmap(probe, axis_size=2, out_axes=None)(*pairs)
    return tuple(found)


def is_affine(function: Callable[..., Sequence[Any]], count: int) -> bool:
    """Whether all results of the function, of `count` numbers, are known to be linear in them, but
    for constants.

    Its jaxpr shows it: the numbers are added, scaled and handed on, and nothing else is done with
    them. Plain: no function is known to be.
    """

    def trial():
        return _is_affine(lambda p, q: [p - 2 * q / 3, q, 1.0], 2) and not (
            _is_affine(lambda p, q: [p * q], 2) or _is_affine(lambda p: [jnp.abs(p)], 1)
        )

    return _usable("a look into traced programs", trial) and _is_affine(function, count)


#: Primitives that are linear in their arguments.
LINEAR = frozenset(
    """add add_any sub neg copy convert_element_type broadcast_in_dim reshape squeeze
    concatenate slice""".split()
)

#: Primitives that call another jaxpr, and the parameter that holds it.
CALLS = {"jit": "jaxpr", "pjit": "jaxpr", "custom_jvp_call": "call_jaxpr"}


def _is_affine(function: Callable[..., Sequence[Any]], count: int) -> bool:
    number = jax.ShapeDtypeStruct((), jnp.float64)
    jaxpr = jax.make_jaxpr(function)(*[number] * count).jaxpr
    return all(degree <= 1 for degree in _degrees(jaxpr, [1] * count))


def _degrees(jaxpr: Any, given: Sequence[int]) -> list[int]:
    """How each result depends on some numbers, where the arguments depend on them as `given`: not
    at all (0), linearly (1), or perhaps in another way (2)."""
    from jax.extend.core import Var

    degrees = dict(zip(jaxpr.invars, given, strict=True))

    def of(atoms):
        return [degrees.get(one, 0) if isinstance(one, Var) else 0 for one in atoms]

    for equation in jaxpr.eqns:
        given, name = of(equation.invars), equation.primitive.name
        if not any(given):
            continue
        inner = equation.params.get(CALLS[name]) if name in CALLS else None
        scales = (name == "mul" and 0 in given) or (name == "div" and not given[1])
        picks = name == "select_n" and not given[0]
        degree = max(given) if name in LINEAR or scales or picks else 2
        out = [degree] * len(equation.outvars) if inner is None else _degrees(inner.jaxpr, given)
        degrees |= dict(zip(equation.outvars, out, strict=True))
    return of(jaxpr.outvars)


# --- forked processes -----------------------------------------------------------------------------

# A fork copies the memory of a process but none of its threads, and JAX waits for its threads: most
# of what it is asked to do in the child never ends. So the child raises at once.

_forked = False
#: Whether jaxbelt computed in this process; noted where nothing else shows that JAX is in use.
_computed = False


def _is_jax_in_use() -> bool:
    # JAX's private list of backends is empty before JAX is used. The public function that returns
    # the list starts them.
    from jax._src import xla_bridge

    return len(xla_bridge._backends) > 0


def _note_fork() -> None:
    global _forked
    try:
        in_use = not PLAIN and _is_jax_in_use()
    except Exception:
        in_use = False
    _forked = _forked or _computed or in_use


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)


def require_own_threads() -> None:
    """Raise a `RuntimeError` in a process that was forked after JAX was used.

    Plain: after jaxbelt was used.
    """
    global _computed
    if _forked:
        raise RuntimeError(
            "jaxbelt cannot compute in a process that was forked after JAX was used: JAX's threads "
            "are not in it, so it would wait for ever. Start processes by the method spawn, such "
            'as multiprocessing.get_context("spawn").Pool() or '
            'ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))'
        )
    if not _usable("JAX's list of its backends", lambda: _is_jax_in_use() in (True, False)):
        _computed = True
