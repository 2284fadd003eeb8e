"""How functions are compiled: the same results in and out of traces, and nothing needlessly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt import compiling


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


def test_options_that_xla_does_not_know_are_left_out():
    assert compiling.known((("xla_cpu_no_such_option", True),)) is None
    if jax.default_backend() == "cpu":
        assert compiling.known(compiling.QUICK) == dict(compiling.QUICK)


def test_each_is_vmap():
    a, b = jnp.arange(6.0).reshape(3, 2), jnp.arange(3.0)

    def function(row, number):
        return {"sum": jnp.sum(row) * number, "row": row}

    one, all_at_once = (jax.jit(f(function))(a, b) for f in (compiling.each, jax.vmap))
    assert jax.tree.all(jax.tree.map(lambda x, y: np.array_equal(x, y), one, all_at_once))


def test_runs_with_other_numbers_of_events_compile_nothing():
    osc = jb.presets.class_b(0.45, 0.35)
    first = jb.simulate(osc, (3.0, 0.0), 40.0)
    compiled = []

    def listen(name, *_, **__):
        if name.endswith("backend_compile_duration"):
            compiled.append(name)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        second = jb.simulate(osc, (3.0, 0.0), 30.0)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert second.events.t.size < first.events.t.size
    assert compiled == []


class Constant(jb.Coulomb):
    """A law that no other test uses."""


def test_a_sweep_compiles_its_kernel_once():
    compiled = []

    def listen(name, *_, fun_name="", **__):
        if name.endswith("backend_compile_duration"):
            compiled.append(fun_name)

    law = Constant(1.0, 0.8)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        jb.sweep(
            lambda nu: jb.Oscillator(0.1, (jb.Belt(nu, law, load=1.0),)),
            {"nu": np.linspace(0.1, 0.5, 5)},
            y0=(1.0, 0.0),
            t1=20.0,
        )
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert sum("_advance" in name for name in compiled) == 1
