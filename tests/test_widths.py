"""What is done side by side on other devices is right: their numbers of lanes, on the CPU."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb

#: Programs as they are traced for another device, but with lanes of a sweep that a CPU does in
#: seconds. `is_cpu` is changed itself, as other modules have it by its name.
ELSEWHERE = """
import sys
import jax
from jaxbelt.numerics import widths
widths.is_cpu.__code__ = (lambda: False).__code__
from jaxbelt.sweeps import threads
threads.WIDTH = widths.SideBySide(0, 2**10)
jax.config.update("jax_enable_x64", True)
import numpy as np
sys.path.insert(0, sys.argv[1])
from test_widths import computed
np.savez(sys.argv[2], **computed())
"""


def computed() -> dict[str, np.ndarray]:
    """More lanes than a group on the CPU has, with their slopes, and a sweep with derivatives."""

    def end(nu, x1):
        return jb.simulate(jb.presets.class_b(nu, 0.35), (x1, 0.0), 40.0).ys[-1]

    lanes = jnp.linspace(-0.6, 0.6, 300), jnp.linspace(-3.0, 3.0, 300)
    axes = {"nu0": np.linspace(-0.6, 0.6, 20), "nu1": np.linspace(-0.5, 0.5, 30)}
    swept = jb.sweep(jb.presets.class_b, axes, t1=30.0, derivatives=("nu0",))
    return {
        "ends": np.asarray(jax.jit(jax.vmap(end))(*lanes)),
        "slopes": np.asarray(jax.jit(jax.vmap(jax.grad(lambda *p: end(*p)[0])))(*lanes)),
        **{str(name): swept[name].values for name in swept},
    }


@pytest.mark.slow(first=True)
def test_lanes_as_on_another_device(tmp_path, request):
    file = tmp_path / "found.npz"
    command = [sys.executable, "-c", ELSEWHERE, str(request.path.parent), str(file)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert run.returncode == 0, run.stderr
    found, expected = np.load(file), computed()
    for name, values in expected.items():
        is_slope = name == "slopes" or name.startswith("d_")
        tol = 1e-9 if is_slope else 1e-12
        np.testing.assert_allclose(found[name], values, rtol=tol, atol=tol, err_msg=name)
