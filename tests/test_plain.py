"""JAXBELT_PLAIN=1: all works the same without what JAX, XLA and Equinox do not promise."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

#: One of everything that leans on it: motion, cycles, sweeps, parameters, processes.
PART = (
    "test_compiling.py::test_jit_works_inside_of_every_trace",
    "test_compiling.py::test_a_batch_gives_what_a_loop_gives",
    "test_simulate.py::test_error_falls_with_the_tolerance",
    "test_cycles.py::test_sticking_cycle_is_that_of_the_oracle",
    "test_coincidences.py::test_audits_find_nothing[final]",
    "test_variations.py::test_hopf_points_in_closed_form[half]",
    "test_processes.py::test_a_forked_child_is_told_to_be_spawned",
)
#: More of the same.
MORE = (
    "test_coincidences.py::test_audits_find_nothing[attractor]",
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
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n0", *(str(tests / one) for one in part)],
        cwd=tests.parent,
        env={**inherited, "JAXBELT_PLAIN": "1"},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert run.returncode == 0, run.stdout
