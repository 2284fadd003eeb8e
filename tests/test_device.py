"""What is computed on accelerators, computed on the CPU: right, and in a form that suits them."""

import json
import os
import re
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt.numerics import compiling, programs, widths
from jaxbelt.sweeps import threads
from jaxbelt.sweeps.question import Question
from jaxbelt.sweeps.queue import Call, Common, advance
from tests.benchmarks import device

needs_cpu = pytest.mark.skipif(jax.default_backend() != "cpu", reason="compares with the CPU")
NU1 = 0.35
AXES = {"nu0": np.linspace(-0.6, 0.6, 20), "nu1": np.linspace(-0.5, 0.5, 30)}


def class_d(nu0, nu1):
    return jb.presets.class_d(nu0, nu1, -0.3, 0.5)


def one_belt(nu0, nu1):
    return jb.Oscillator(0.5, (jb.Belt(nu0, jb.Coulomb(1.0, 0.8 + 0.2 * nu1)),))


# --- the rule -------------------------------------------------------------------------------------


@needs_cpu
def test_the_form_holds_for_this_thread_and_those_that_are_given_it():
    number, seen = widths.SideBySide(1, 2), []
    assert widths.is_cpu() and number.here == 1

    def look():
        seen.append(number.here)

    with widths.as_on_accelerator():
        assert not widths.is_cpu() and number.here == 2
        for function in (look, widths.as_here(look)):
            thread = threading.Thread(target=function)
            thread.start()
            thread.join()
    assert seen == [1, 2] and widths.is_cpu()


@needs_cpu
@pytest.mark.parametrize("compiled", [jax.jit, compiling.jit, compiling.wide])
def test_programs_of_the_two_forms_are_never_mixed(compiled, monkeypatch, tmp_path):
    """Neither in memory nor in the store of programs."""
    monkeypatch.setattr(programs, "ON", True)
    monkeypatch.setenv("JAXBELT_CACHE_DIR", str(tmp_path))
    programs.are_kept.cache_clear()
    number = widths.SideBySide(1, 2)
    call = compiled(lambda x: x + number.here)
    found = []
    for _ in range(2):
        found.append(float(call(jnp.zeros(()))))
        with widths.as_on_accelerator():
            found.append(float(call(jnp.zeros(()))))
    programs.are_kept.cache_clear()
    assert found == [1.0, 2.0, 1.0, 2.0]


@needs_cpu
def test_keys_of_the_store_tell_the_forms_apart_and_no_addresses(monkeypatch):
    def key():
        return programs.key_of(np.sin, [programs.HOLE], ["float64"], None)

    here, (context, *others) = key(), programs.jax_settings()
    with widths.as_on_accelerator():
        assert key() != here
    # JAX has an object without a name among its settings, which lies elsewhere in each process.
    for where in (0, len(context)):
        settings = (*context[:where], object(), *context[where:]), *others
        monkeypatch.setattr(programs, "jax_settings", lambda settings=settings: settings)
        assert key() == here


@needs_cpu
def test_few_runs_have_few_lanes():
    assert [threads.lanes_for(n) for n in (1, 10**7)] == [128, 128]
    with widths.as_on_accelerator():
        widest = threads.WIDTH.elsewhere
        found = [threads.lanes_for(n) for n in (1, 2**10, 2**10 + 1, 2**15 + 1, 10**7)]
        assert found == [2**10, 2**10, 2**15, widest, widest]
        assert threads.workers() == jax.local_device_count()


# --- the kernel's form ----------------------------------------------------------------------------


def kernel_for_gpus(make, observe, derivatives=()):
    """The sweep's kernel as a GPU would be given it, as text in StableHLO; none is needed."""
    question = Question.of(make, AXES, (3.0, 0.0), 30.0, 1e-8, None, observe, derivatives)
    program, shared = question.program, question.grid.shared
    columns, width = 2 + sum(program.mapped), 1024
    with widths.as_on_accelerator():
        streams = threads._first_streams(program, shared, width, columns, len(derivatives))
        common = Common(shared, 30.0, 1e-8, np.nan, np.int32(100))
        call = Call(*[np.int32(0)] * 4, np.bool_(False))
        queue = np.zeros((1 + len(derivatives), columns, 2 * width))
        traced = jax.jit(lambda *args: advance(program, *args)).trace(common, queue, call, streams)
        return traced.lower(lowering_platforms=("cuda",)).as_text(), traced.jaxpr


def primitives(jaxpr):
    """The names of all primitives, those in loops and calls among them."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for part in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "jaxpr")):
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                yield from primitives(part)


@pytest.mark.parametrize(
    "make, observe, derivatives",
    [
        (jb.presets.class_b, "final", ()),
        pytest.param(jb.presets.class_b, "final", ("nu0",), marks=pytest.mark.slow),
        pytest.param(class_d, "attractor", (), marks=pytest.mark.slow),
    ],
)
def test_the_kernel_for_gpus_waits_for_nothing(make, observe, derivatives):
    text, jaxpr = kernel_for_gpus(make, observe, derivatives)
    # Branches, callbacks and calls of libraries are chosen or made by the host; scatters to places
    # that lanes choose are made one after another where two may be the same.
    operations = set(re.findall(r"(?:stablehlo|chlo)\.(\w+)", text))
    assert not operations & {"case", "if", "scatter", "custom_call", "infeed", "outfeed", "sort"}
    # The host looks at the conditions of two loops, a call's and a block's; others are counted.
    names = list(primitives(jaxpr.jaxpr))
    assert names.count("while") == 2 and "cond" not in names
    assert "f64" in text and "f32" not in text


@pytest.mark.slow
def test_batches_and_cycles_can_be_lowered_for_gpus():
    def end(nu):
        return jb.simulate(jb.presets.class_b(nu, NU1), (3.0, 0.0), 40.0, ts=jnp.full(1, 40.0)).ys

    def amplitude(nu):
        return jb.amplitude(jb.find_cycle(jb.presets.class_b(nu, NU1), (3.0, 0.0)))

    nus = jnp.linspace(0.3, 0.6, 300)
    libraries = set()
    with widths.as_on_accelerator():
        for function in (lambda nu: jax.jacrev(end)(nu), jax.grad(amplitude)):
            traced = jax.jit(jax.vmap(function)).trace(nus)
            text = traced.lower(lowering_platforms=("cuda",)).as_text()
            libraries |= set(re.findall(r"custom_call @(\w+)", text))
            assert "callback" not in text
    # Newton's method of the cycles: an LU decomposition.
    assert libraries <= {"cusolver_getrf_ffi", "cu_lu_pivots_to_permutation"}


# --- the same results -----------------------------------------------------------------------------


def sweep(observe="final", make=jb.presets.class_b, derivatives=()):
    t1 = 30.0 if observe == "final" else None
    found = jb.sweep(
        make, AXES, t1=t1, observe=observe, derivatives=derivatives, progress=False
    ).variables
    return {str(name): values.values for name, values in found.items()}


def end(nu, x1):
    return jb.simulate(jb.presets.class_b(nu, NU1), (x1, 0.0), 40.0, ts=jnp.full(1, 40.0)).ys[0]


#: More lanes than a group on the CPU has.
LANES = jnp.linspace(-0.6, 0.6, 300), jnp.linspace(-3.0, 3.0, 300)


def ends():
    return {"ends": jax.jit(jax.vmap(end))(*LANES)}


def slopes():
    def slope(nu, x1):
        return jax.grad(lambda *p: end(*p)[0], (0, 1))(nu, x1)

    d_nu, d_x1 = jax.jit(jax.vmap(slope))(*LANES)
    return {"d_nu": d_nu, "d_x1": d_x1}


def cycles():
    def period(nu):
        cycle = jb.find_cycle(jb.presets.class_b(nu, NU1), (3.0, 0.0))
        return jb.period(cycle), cycle.status

    # More than a group on the CPU has.
    nus = jnp.linspace(0.1, 0.6, 70)
    (found, status), slope = jax.jit(jax.vmap(jax.value_and_grad(period, has_aux=True)))(nus)
    return {"period": found, "status": status, "d_period": slope}


def unstable_cycles():
    nus = jnp.linspace(0.27, 0.52, 20)
    found = jax.jit(jax.vmap(lambda nu: jb.unstable_cycle(jb.presets.class_b(nu, NU1)).period))(nus)
    return {"period": found}


def scanned():
    osc = jb.presets.class_b(0.45, NU1)
    points = jb.scan(osc, lambda o: o.belts[0].velocity, (-0.7, 0.7))
    return {
        "values": np.array([float(point.value) for point in points]),
        "kinds": np.array([str(point.kind) for point in points]),
    }


def mapped():
    nus = np.linspace(-0.6, 0.6, 9)
    found = jb.region_map(jb.presets.class_b, {"nu0": nus, "nu1": nus + 0.01}, lines=1)
    return {"label": found.label, "curves": np.array([len(found.curves)])}


def basins():
    osc = jb.presets.class_b(0.45, NU1)
    found = jb.basins(osc, x1=np.linspace(-3.0, 3.0, 40), x2=np.linspace(-2.0, 2.0, 40))
    return {"label": found.label.values, "boundary": np.array(found.boundary.period)}


first = pytest.mark.slow(first=True)


@needs_cpu
@pytest.mark.parametrize(
    "computed",
    [
        pytest.param(lambda: sweep(make=one_belt), id="sweep", marks=first),
        pytest.param(lambda: sweep(derivatives=("nu0", "nu1")), id="derivatives", marks=first),
        pytest.param(lambda: sweep("attractor", class_d), id="attractors", marks=first),
        pytest.param(ends, id="ends", marks=first),
        pytest.param(slopes, id="slopes", marks=first),
        pytest.param(cycles, id="cycles", marks=pytest.mark.slow),
        pytest.param(unstable_cycles, id="unstable", marks=pytest.mark.slow),
        pytest.param(scanned, id="scan", marks=pytest.mark.slow),
        pytest.param(mapped, id="regions", marks=pytest.mark.slow),
        pytest.param(basins, id="basins", marks=pytest.mark.slow),
    ],
)
def test_results_are_those_of_the_cpu(computed):
    expected = computed()
    with widths.as_on_accelerator():
        found = computed()
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        values, own = np.asarray(values), np.asarray(found[name])
        if values.dtype.kind != "f":
            np.testing.assert_array_equal(own, values, err_msg=name)
            continue
        # Another order of operations. A derivative multiplies the rounding by what it has grown to;
        # a time at which the mass is near rest divides it by the small velocity there.
        tol = 1e-9 if name.startswith("d_") else 1e-5 if name == "transient" else 1e-12
        np.testing.assert_allclose(own, values, rtol=tol, atol=tol, err_msg=name)


@pytest.mark.slow(first=True)
def test_several_devices_of_one_process_share_a_sweep(tmp_path):
    """As many threads as for several accelerators, and all devices at work."""
    program = """
import sys
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxbelt as jb
from jaxbelt.numerics.widths import as_on_accelerator
from jaxbelt.sweeps import threads
used, started = set(), threads._started
def watched(function, *arguments):
    used.update(arguments)
    return started(function, *arguments)
threads._started = watched
axes = {"nu0": np.linspace(-0.6, 0.6, 40), "nu1": [0.35]}
with as_on_accelerator():
    assert threads.workers() == 3
    found = jb.sweep(jb.presets.class_b, axes, t1=20.0, progress=False)
assert used == set(jax.local_devices()) and len(used) == 3
np.savez(sys.argv[1], **{str(name): found[name].values for name in found})
"""
    file = tmp_path / "found.npz"
    environment = dict(os.environ, XLA_FLAGS="--xla_force_host_platform_device_count=3")
    run = subprocess.run(
        [sys.executable, "-c", program, str(file)],
        env=environment | {"JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert run.returncode == 0, run.stderr
    axes = {"nu0": np.linspace(-0.6, 0.6, 40), "nu1": [NU1]}
    expected = jb.sweep(jb.presets.class_b, axes, t1=20.0, progress=False)
    for name, values in np.load(file).items():
        np.testing.assert_allclose(values, expected[name].values, 1e-12, 1e-12, err_msg=name)


# --- the script for a device ----------------------------------------------------------------------


@pytest.fixture
def script(tmp_path):
    """Runs the script, as on an accelerator; gives its exit code and what this device has in the
    file of its results, in which there was another device before."""
    file = tmp_path / "device.json"
    file.write_text(json.dumps({"another": {"proof": {"right": True, "runs": 7}}}))

    def call(*arguments):
        told = ["--file", str(file), "--as-on-accelerator", "--seconds", "3000", *arguments]
        code = device.main(told)
        found = json.loads(file.read_text())
        assert found.pop("another")["proof"]["runs"] == 7
        return code, next(iter(found.values()), {})

    return call


def test_the_script_keeps_what_is_done_and_tells_what_failed(script, monkeypatch, capsys):
    def fails(sizes, clock):
        raise MemoryError("too large")

    monkeypatch.setattr(device, "proof", lambda sizes, clock: {"right": True, "runs": 1234})
    monkeypatch.setattr(device, "w1", fails)
    code, found = script("--parts", "proof", "w1")
    assert code == 1 and found["proof"]["runs"] == 1234
    assert found["w1"] == {"right": False, "failed": "MemoryError: too large"}
    assert "1,234" in capsys.readouterr().out
    monkeypatch.setattr(device.Clock, "left", 0.0)
    code, _ = script("--parts", "proof")
    assert code == 0 and "proof: left out, 0 s are left" in capsys.readouterr().out


def test_a_map_stops_where_its_time_is_up(monkeypatch):
    monkeypatch.setattr(device, "TILE", 5)
    monkeypatch.setattr(device.Clock, "left", 0.0)
    known = np.array(json.loads(device.ANSWERS.read_text())["basins"])

    def call(x1, x2):
        return known[: len(x1), : len(x2)]

    found = device.mapped("basins", call, device.BASINS, 10, device.Clock(1.0))
    assert (found["right"], found["cells"], found["not done"]) == (True, 25, 100)
    monkeypatch.setattr(device.Clock, "left", 1e9)
    found = device.mapped("basins", lambda *a: call(*a) + 1, device.BASINS, 10, device.Clock(1.0))
    assert (found["right"], found["cells"]) == (False, 100)


def test_operations_of_a_lane_are_those_that_were_written():
    def some(x):
        def step(x, _):
            return x * 2.0 + 1.0, None

        return jax.lax.scan(step, jnp.sqrt(x), length=3)[0]

    assert device.operations(jax.make_jaxpr(some)(jnp.ones(10)).jaxpr) == 10 * (1 + 3 * 2)


@needs_cpu
@pytest.mark.slow(first=True)
def test_the_script_measures_at_small_sizes(script):
    code, found = script("--parts", "w1", "--w1", "900")
    assert code == 0, found
    told = found["w1"]
    assert told["runs"] == 900 and told["right"] and 15 < told["events a run"] < 25
    # Some steps for each of 100 units of time; of 1,024 lanes some are idle from the start.
    assert 100 < told["kernel: steps of a lane a run"] < 1000
    assert told["kernel: bound by"] in ("float64 operations", "memory")
    assert 0 < told["kernel: share of float64 operations"] <= told["kernel: share of the bound"]


@needs_cpu
@pytest.mark.parametrize(
    "parts",
    [
        pytest.param(("proof",), marks=pytest.mark.slow(first=True)),
        pytest.param(("grad", "regions", "basins"), marks=pytest.mark.slow),
    ],
)
def test_the_script_proves_at_small_sizes(script, parts):
    code, found = script("--parts", *parts, "--grad", "150", "--regions", "10", "--basins", "10")
    assert code == 0, found
    assert all(found[part]["right"] for part in parts)
    if "proof" in parts:
        assert found["proof"]["runs"] == 300
