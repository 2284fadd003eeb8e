"""How functions are compiled: the same results in and out of traces, and nothing needlessly."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import equinox.internal
import jax
import jax.experimental.xla_metadata
import jax.extend.core
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from jax import lax

import jaxbelt as jb
from jaxbelt.cycles import clocked
from jaxbelt.model.own_units import in_own_units
from jaxbelt.numerics import compiling, programs

#: Whether the tricks are used, which are those of the CPU's compiler.
TRICKS = jax.default_backend() == "cpu" and not compiling.PLAIN
needs_tricks = pytest.mark.skipif(not TRICKS, reason="needs what is not promised")


@compiling.jit
def cubed(x):
    return x**3


@pytest.mark.parametrize(
    "call",
    [
        cubed,
        jax.jit(cubed),
        jax.jit(lambda x: x - x + cubed(jnp.asarray(2.0))),  # no traced argument, yet in a trace
        compiling.jit(lambda x: cubed(x)),
        lambda x: jax.vmap(cubed)(x[None])[0],
        lambda x: jax.grad(lambda v: cubed(v) * v)(x) / 4,
        lambda x: jax.lax.map(cubed, x[None])[0],
    ],
)
def test_jit_works_inside_of_every_trace(call):
    assert call(jnp.asarray(2.0)) == 8.0


def test_each_is_vmap():
    a, b = jnp.arange(6.0).reshape(3, 2), jnp.arange(3.0)

    def function(row, number):
        return {"sum": jnp.sum(row) * number, "row": row}

    one, all_at_once = (jax.jit(f(function))(a, b) for f in (compiling.each, jax.vmap))
    assert jax.tree.all(jax.tree.map(lambda x, y: np.array_equal(x, y), one, all_at_once))


def test_runs_with_other_numbers_of_events_compile_nothing():
    osc = jb.presets.class_b(0.45, 0.35)
    first = jb.simulate(osc, (3.0, 0.0), 40.0, max_segments=4096)  # as in tests/test_simulate.py
    with compilations() as compiled:
        second = jb.simulate(osc, (3.0, 0.0), 30.0, max_segments=4096)
    assert second.events.t.size < first.events.t.size
    assert compiled == []


#: Calls, and others that differ from them in numbers only: these compile nothing.
SAME_PROGRAM = {
    "simulate, another length of ts, with and without t1": (
        lambda: jb.simulate(CLASS_B, (3.0, 0.0), 40.0, ts=np.linspace(0.0, 40.0, 101)),
        lambda: jb.simulate(OTHER, (1.0, 0.5), 38.0, ts=np.linspace(0.0, 36.0, 113)),
    ),
    "simulate, another t1": (
        lambda: jb.simulate(CLASS_B, (3.0, 0.0), 40.0),
        lambda: jb.simulate(OTHER, (1.0, 0.5), 51.0, rtol=1e-9),
    ),
    "find_cycle, another oscillator and start": (
        lambda: jb.find_cycle(CLASS_B, (3.0, 0.0)),
        lambda: jb.find_cycle(OTHER, (1.0, 0.5)),
    ),
    "sweep, another start, size and span": (
        lambda: swept(9, (3.0, 0.0)),
        lambda: swept(14, (1.0, 0.5)),
    ),
}
CLASS_B, OTHER = jb.presets.class_b(0.45, 0.35), jb.presets.class_b(0.41, 0.3)


def swept(count, y0):
    axes = {"nu0": np.linspace(0.1, 0.1 * count, count), "nu1": [0.35]}
    return jb.sweep(jb.presets.class_b, axes, y0=y0, t1=20.0 + count, observe="final")


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("name", SAME_PROGRAM)
def test_numbers_decide_no_program(name):
    first, second = SAME_PROGRAM[name]
    first()
    with compilations() as compiled:
        second()
    assert compiled == []


SIMULATE = jax.jit(lambda y0, ts: jb.simulate(CLASS_B, y0, 40.0, ts=ts))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("end", [40.0, 39.0])
def test_padded_times_are_those_that_were_asked_for(end):
    ts = np.linspace(0.0, end, 101)
    found = jb.simulate(CLASS_B, (3.0, 0.0), 40.0, ts=ts)
    # In a trace the times are not padded.
    unpadded = SIMULATE(np.array([3.0, 0.0]), ts)
    np.testing.assert_array_equal(found.ts, ts)
    # Samples are flown from one to the next, in pieces that may begin at other ones.
    np.testing.assert_allclose(found.ys, unpadded.ys, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found.modes, unpadded.modes)
    if end == 40.0:
        last = jb.simulate(CLASS_B, (3.0, 0.0), 40.0).ys[-1]
        np.testing.assert_array_equal(found.ys[-1], last)


def test_bounds_at_infinity_are_no_numbers_of_programs():
    own = in_own_units(CLASS_B)
    assert len(jax.tree.leaves(own.belts)) == len(jax.tree.leaves(CLASS_B.belts)) - 4
    edged = jb.presets.class_c(0.45, 0.35, sigma=0.5)
    assert len(jax.tree.leaves(in_own_units(edged).belts)) == len(jax.tree.leaves(edged.belts))
    # What comes back has them, as arrays.
    cycle = jb.find_cycle(CLASS_B, (3.0, 0.0))
    assert jax.tree.structure(cycle.oscillator) == jax.tree.structure(CLASS_B)


def test_what_is_compiled_beside_is_asked_for_once(monkeypatch, tmp_path):
    monkeypatch.setattr(programs, "ON", True)
    monkeypatch.setenv("JAXBELT_CACHE_DIR", str(tmp_path))
    for cached in (programs._usable_folder, programs.are_kept):
        cached.cache_clear()
    monkeypatch.setattr(compiling, "_begun_beside", set())
    called = []

    def fails():
        called.append("fails")
        raise ValueError("no such thing")

    # Arrays of another length are no other question.
    for like, seconds in ((jnp.ones(2), 5), (jnp.ones(3), 0), ({"x": jnp.ones(2)}, 5)):
        begun = threading.Event()
        calls = [fails, lambda begun=begun: (called.append("second"), begun.set())]
        with compiling.compiled_beside("test", like, calls):
            begun.wait(seconds)
    for cached in (programs._usable_folder, programs.are_kept):
        cached.cache_clear()
    expected = [] if compiling.PLAIN or os.cpu_count() == 1 else ["fails", "second"] * 2
    assert called == expected


class Constant(jb.Coulomb):
    """A law that no other test uses."""


def test_a_sweep_compiles_its_kernel_once():
    law = Constant(1.0, 0.8)
    with compilations() as compiled:
        jb.sweep(
            lambda nu: jb.Oscillator(0.1, (jb.Belt(nu, law, load=1.0),)),
            {"nu": np.linspace(0.1, 0.5, 5)},
            y0=(1.0, 0.0),
            t1=20.0,
        )
    assert sum("advance" in name for name in compiled) == 1


# --- one kernel -----------------------------------------------------------------------------------

MARK = 'inlineable="false"'  # not on the loops that XLA puts into one piece by itself


def descend(start, rates):
    """A loop whose length depends on the numbers."""

    def step(state):
        x, n = state
        return x * (1 - rates["slow"]), n + 1

    return lax.while_loop(lambda state: state[0] > 0.1, step, (start, 0))


def expected(start, slow):
    n = int(np.ceil(np.log(0.1 / start) / np.log(1 - slow)))
    return start * (1 - slow) ** n, n


def check(values, start, slow):
    x, n = expected(start, slow)
    assert int(values[1]) == n
    assert float(values[0]) == pytest.approx(x, rel=1e-12)


def program(function, *args) -> str:
    return jax.jit(function).lower(*args).compile().as_text()


piece = compiling.one_kernel(descend)
# An argument that is not used, and what is a constant where it is compiled, are the hard ones.
RATES = {"slow": 0.2, "unused": jnp.arange(3)}


def test_the_result_is_that_of_the_function():
    check(piece(2.0, RATES), 2.0, 0.2)
    check(jax.jit(piece)(2.0, RATES), 2.0, 0.2)


def test_constants_are_no_matter():
    check(jax.jit(lambda: piece(2.0, RATES))(), 2.0, 0.2)
    check(jax.jit(lambda x: piece(x, RATES))(2.0), 2.0, 0.2)
    check(jax.jit(lambda r: piece(2.0, {"slow": r, "unused": r}))(0.2), 2.0, 0.2)


@needs_tricks
def test_it_is_one_piece_of_machine_code():
    assert MARK in program(piece, 2.0, RATES)
    assert MARK not in program(descend, 2.0, RATES)


def test_in_loops_and_branches():
    def sums(x):
        def body(total, start):
            return total + lax.cond(start > 1, lambda: piece(start, RATES)[0], lambda: start), None

        return lax.scan(body, 0.0, x)[0]

    starts = np.array([2.0, 0.5, 3.0])
    wanted = expected(2.0, 0.2)[0] + 0.5 + expected(3.0, 0.2)[0]
    assert float(jax.jit(sums)(starts)) == pytest.approx(wanted, rel=1e-12)


def test_a_piece_within_a_piece_is_part_of_it():
    @compiling.one_kernel
    def twice(x, rates):
        return piece(piece(x, rates)[0] + 2.0, rates)

    start = expected(2.0, 0.2)[0] + 2.0
    check(jax.jit(twice)(2.0, RATES), start, 0.2)
    assert program(twice, 2.0, RATES).count(MARK) == program(piece, 2.0, RATES).count(MARK)
    grown = jax.jacfwd(lambda x: twice(x, RATES)[0])(2.0)
    assert float(grown) == pytest.approx(0.8 ** sum(expected(x, 0.2)[1] for x in (2.0, start)))


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit])
def test_a_batch_gives_what_a_loop_gives(wrap):
    starts = jnp.array([2.0, 0.05, 3.0])
    batch = wrap(jax.vmap(lambda x: piece(x, RATES)))(starts)
    rows = [piece(x, RATES) for x in starts]
    assert [float(x) for x in batch[0]] == [float(x) for x, _ in rows]
    assert [int(n) for n in batch[1]] == [int(n) for _, n in rows]


def test_an_empty_batch():
    assert jax.vmap(lambda x: piece(x, RATES))(jnp.zeros(0))[0].shape == (0,)


def test_derivatives():
    def fixed(x, a):
        return lax.scan(lambda x, _: (x + a * jnp.sin(x), None), x, length=5)[0]

    for take in (jax.grad, jax.jacfwd, lambda f: jax.jacfwd(jax.grad(f))):
        exact = take(fixed)(0.7, 0.3)
        assert float(take(compiling.one_kernel(fixed))(0.7, 0.3)) == pytest.approx(
            float(exact), rel=1e-14
        )
        batch = jax.jit(jax.vmap(take(compiling.one_kernel(fixed)), (0, None)))(
            jnp.full(3, 0.7), 0.3
        )
        np.testing.assert_allclose(batch, exact, rtol=1e-14)


#: What a friction law may be made of.
MATH = [
    *(jnp.abs, jnp.sign, jnp.floor, jnp.ceil, jnp.round, jnp.square, jnp.sqrt, jnp.cbrt),
    *(jnp.exp, jnp.exp2, jnp.expm1, jnp.log, jnp.log1p, lax.rsqrt, lax.logistic),
    *(jnp.sin, jnp.cos, jnp.tan, jnp.arcsin, jnp.arccos, jnp.arctan),
    *(jnp.sinh, jnp.cosh, jnp.tanh, jnp.arcsinh, lambda x: jnp.arccosh(1 + x), jnp.arctanh),
    *(lambda x: x**3, lambda x: x**2.5, lambda x: jnp.arctan2(x, 2.0), lambda x: x % 0.3),
    *(lambda x: jnp.clip(x, 0.2, 0.6), jnp.isfinite),
    *(lambda x: jnp.prod(x) * x, lambda x: (x > 0.5) ^ (x > 0.3), lambda x: jnp.cumsum(x)[::-1]),
    *(lambda x: x[jnp.argmax(x)], lambda x: jnp.nextafter(x, 1.0), jax.nn.softplus),
]


def test_what_a_law_may_be_made_of_is_possible():
    def add_up(x):
        return lax.fori_loop(
            0, 3, lambda i, y: y + sum(f(x + 0.1 * i).astype(float) for f in MATH), 0.0 * x
        )

    x = jnp.array([0.2, 0.41, 0.65])
    piece = compiling.one_kernel(add_up)
    np.testing.assert_allclose(jax.jit(piece)(x), add_up(x), rtol=1e-13)
    if TRICKS:
        assert MARK in program(piece, x)


def lookup(x):
    return jax.pure_callback(lambda x: np.asarray(x) ** 2, jax.ShapeDtypeStruct((3,), float), x)


@pytest.mark.parametrize(
    "function",
    [
        jnp.sort,
        jnp.argsort,
        lambda x: jnp.linalg.solve(jnp.diag(x), x),
        lambda x: jnp.zeros(3).at[x.astype(int) % 3].add(x),
        lambda x: jnp.fft.fft(x).real,
        lambda x: jax.random.normal(jax.random.key(0), (3,)) + x,
        lambda x: jnp.sum(jnp.sin(jnp.outer(jnp.linspace(0, 1, 100_000), x)), axis=0),
        lookup,
    ],
)
def test_what_cannot_be_one_piece_is_what_it_was(function):
    x = jnp.array([3.0, 1.0, 2.0])
    np.testing.assert_allclose(jax.jit(compiling.one_kernel(function))(x), function(x), rtol=1e-13)
    if jax.default_backend() == "cpu":
        assert MARK not in program(compiling.one_kernel(function), x)


@needs_tricks
def test_shooting_with_a_clock_is_one_piece(monkeypatch):
    """With the longest meshes, too; a scattered number in an equation kept all of it from that."""
    judged, is_possible = [], compiling._is_possible

    def noted(jaxpr):
        judged.append(is_possible(jaxpr))
        return judged[-1]

    monkeypatch.setattr(compiling, "_is_possible", noted)
    osc = in_own_units(jb.presets.den_hartog(0.8))
    arcs, steps = 16, 512
    codes, ends = jnp.ones((arcs, len(osc.belts))), jnp.zeros(arcs, int)
    chain = clocked.TimedChain(codes, ends, jnp.ones((arcs, steps)) / steps, turns=1)
    z = jnp.ones((arcs, 4))
    functions = {
        "equations": lambda z: clocked.timed_residual(osc, chain, z),
        "derivatives": lambda z: clocked.timed_blocks(osc, osc, chain, z),
        "maps": lambda z: clocked.arc_maps(osc, chain, z),
        "slopes": lambda z: clocked.monodromy_and_slopes(osc, osc, chain, z),
        "areas": lambda z: clocked.logs_of_areas(osc, chain, z),
        "admissible": lambda z: clocked.timed_admissible(osc, chain, z),
        "extrema": lambda z: clocked.extrema_along(osc, chain, z),
    }
    for name, function in functions.items():
        judged.clear()
        jax.make_jaxpr(function)(z)
        assert judged and judged[-1], name


# --- without what is not promised -----------------------------------------------------------------


@pytest.fixture
def untried(monkeypatch):
    """As in a new process: nothing was tried yet."""
    monkeypatch.setattr(compiling, "_works", {})
    return monkeypatch


def warned_once(what: str, function, *args):
    """What a function gives, twice the same, and only the first time with a warning."""
    with pytest.warns(RuntimeWarning) as warnings:
        first = function(*args)
    (warning,) = warnings
    assert f"jaxbelt goes on without {what}" in str(warning.message)
    assert jax.tree.all(jax.tree.map(np.array_equal, function(*args), first))
    return first


def broken(*args, **kwargs):
    raise TypeError("this is of another version")


@needs_tricks
def test_without_an_option_of_the_compiler(untried):
    untried.setattr(compiling, "QUICK", {"xla_cpu_no_such_option": True})
    squared = compiling.jit(lambda x: x**2)
    assert warned_once("XLA's options xla_cpu_no_such_option", squared, jnp.asarray(3.0)) == 9.0


@needs_tricks
@pytest.mark.parametrize(
    "module, name",
    [
        (jax.experimental.xla_metadata, "set_xla_metadata"),
        (jax.extend.core, "jaxpr_as_fun"),
        (jax, "make_jaxpr"),
        (compiling, "_is_possible"),
        (jax.custom_batching, "custom_vmap"),
    ],
)
@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit, lambda f: jax.vmap(f, axis_size=2)])
def test_without_kernels_of_one_piece(untried, module, name, wrap):
    untried.setattr(module, name, broken)
    piece = compiling.one_kernel(descend)
    x, n = warned_once("kernels of one piece", wrap(lambda: piece(2.0, RATES)))
    for values in zip(np.ravel(x), np.ravel(n), strict=True):
        check(values, 2.0, 0.2)


@needs_tricks
def test_without_kernels_of_one_piece_that_are_wrong(untried):
    right = jax.extend.core.jaxpr_as_fun

    def wrong(jaxpr):
        return lambda *args: [2 * result for result in right(jaxpr)(*args)]

    untried.setattr(jax.extend.core, "jaxpr_as_fun", wrong)
    piece = compiling.one_kernel(descend)
    check(warned_once("kernels of one piece", jax.jit(piece), 2.0, RATES), 2.0, 0.2)


@needs_tricks
def test_without_one_branch_for_a_batch(untried):
    untried.delattr(equinox.internal, "unvmap_any")

    def halved(x):
        return lax.cond(compiling.any_lane(x > 1), lambda: jnp.where(x > 1, x / 2, x), lambda: x)

    x = jnp.array([0.5, 4.0])
    found = warned_once("Equinox's reductions of a batch", jax.vmap(halved), x)
    assert found.tolist() == [0.5, 2.0]


@needs_tricks
def test_without_what_vmap_leaves_alone(untried):
    untried.setattr(compiling, "is_concrete", lambda value: False)
    leaves = warned_once(
        "what vmap leaves alone", compiling.depends, lambda x: [x, 2, 1.0 + x], 0.0
    )
    assert leaves == (True, False, True)


@needs_tricks
def test_without_a_look_into_traced_programs(untried):
    untried.delattr(jax.extend.core, "Var")

    def function(p, q):
        return [1.0, p - q, 2 * p / 3]

    assert not warned_once("a look into traced programs", compiling.is_affine, function, 2)


@needs_tricks
@pytest.mark.parametrize(
    "function, expected",
    [
        (lambda p: [p, 1.0], True),
        (lambda p: [0.3 - 2 * p / 3, jnp.where(True, p, 0.0), jnp.asarray(p)], True),
        (lambda p: [jax.jit(lambda x: -x)(p) + jnp.sum(jnp.ones(3))], True),
        (lambda p: [jnp.stack([p, 2 * p])[1]], False),  # indexing is not looked into
        (lambda p: [p * p], False),
        (lambda p: [1 / p], False),
        (lambda p: [jnp.abs(p)], False),
        (lambda p: [jnp.where(p > 0, p, 0.0)], False),
        (lambda p: [lax.stop_gradient(p)], False),
        (lambda p: [jnp.sqrt(p)], False),
        (lambda p: [jnp.round(p)], False),
    ],
)
def test_what_is_linear_but_for_constants(function, expected):
    assert compiling.is_affine(function, 1) == expected


@needs_tricks
def test_without_the_list_of_backends(untried):
    untried.setattr(compiling, "_is_jax_in_use", broken)
    untried.setattr(compiling, "_forked", False)
    untried.setattr(compiling, "_computed", False)
    compiling._note_fork()
    assert not compiling._forked
    warned_once("JAX's list of its backends", compiling.require_own_threads)
    compiling._note_fork()
    with pytest.raises(RuntimeError, match="forked after JAX was used"):
        compiling.require_own_threads()


@needs_tricks
@pytest.mark.parametrize("trace", [jax.vmap, lambda f: jax.jit(jax.vmap(f))])
def test_what_is_tried_inside_of_a_batch_is_no_part_of_it(trace, monkeypatch):
    monkeypatch.setattr(compiling, "_works", {})
    product = compiling.with_batches(lambda x: 2 * x, lambda one, size, batched, x: 2 * x)
    assert trace(product)(jnp.ones(3)).tolist() == [2.0, 2.0, 2.0]
    assert compiling._works and all(compiling._works.values())


# --- all without what is not promised -------------------------------------------------------------


#: One of everything that leans on it: motion, cycles, sweeps, parameters, processes.
PART = (
    "test_compiling.py::test_jit_works_inside_of_every_trace",
    "test_compiling.py::test_a_batch_gives_what_a_loop_gives",
    "test_simulate.py::test_error_falls_with_the_tolerance",
    "test_cycles.py::test_sticking_cycle_is_that_of_the_oracle",
    "test_sweep.py::test_audits_find_nothing[final]",
    "test_variations.py::test_hopf_points_in_closed_form[half]",
    "test_processes.py::test_a_forked_child_is_told_to_be_spawned",
)
#: More of the same.
MORE = (
    "test_sweep.py::test_audits_find_nothing[attractor]",
    "test_variations.py::test_hopf_points_in_closed_form",
    "test_processes.py::test_a_spawned_child_computes",
    "test_processes.py::test_a_child_that_was_forked_before_jax_was_used_computes",
)


@pytest.mark.parametrize(
    "part",
    [
        pytest.param(PART, marks=pytest.mark.slow(first=True)),
        pytest.param(MORE, marks=pytest.mark.slow),
    ],
)
def test_a_part_of_the_tests_passes_plainly(part):
    tests = Path(__file__).parent
    inherited = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "-m", ""]
    run = subprocess.run(
        [*command, *(str(tests / one) for one in part)],
        cwd=tests.parent,
        env={**inherited, "JAXBELT_PLAIN": "1"},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert run.returncode == 0, run.stdout
