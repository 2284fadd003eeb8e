"""Messages: a mistake in a call names the argument and what came, before anything is compiled."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxbelt as jb

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def answers() -> dict[str, list]:
    """What came of each mistake, from one process, in which annotations are unchecked."""
    run = subprocess.run(
        [sys.executable, str(HERE / "mistakes.py")],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": f"{HERE}{os.pathsep}{HERE.parent}", "COLUMNS": "200"},
        timeout=300,
    )
    assert run.returncode == 0, run.stderr
    rows = [json.loads(line) for line in run.stdout.splitlines()]
    return {what: rest for what, *rest in rows}


def test_every_mistake_has_its_message_and_compiles_nothing(answers):
    # Imported here, as it is a program of its own, too.
    from mistakes import MISTAKES

    assert len({what for what, _ in MISTAKES}) == len(MISTAKES) >= 100
    wrong = []
    for what, pattern in MISTAKES:
        kind, message, compiled, _ = answers[what]
        fits = kind in ("ValueError", "TypeError", "exit") and re.search(pattern, message)
        if not fits or compiled or len(message) > 700:
            wrong.append(f"{what}: {kind}: {message} (compiled: {compiled}; wanted: {pattern})")
    assert not wrong, "\n".join(wrong)


def test_every_public_function_and_class_that_takes_arguments_is_among_the_mistakes():
    from mistakes import MISTAKES

    calls = " ".join(what for what, _ in MISTAKES)
    called = set(re.findall(r"\bjb\.(\w+)\(", calls))
    #: What a user gets from a call, and does not call; and what takes no argument.
    results = {"Arcs", "BasinFractions", "BasinStability", "Basins", "BifurcationCurve"}
    results |= {
        "BifurcationDiagram",
        "BifurcationPoint",
        "CircleMap",
        "Cycle",
        "Design",
        "Equilibria",
        "Exponents",
        "Events",
        "Explanation",
        "Fit",
    }
    results |= {
        "FatalShock",
        "OrbitDiagram",
        "PeriodicMotion",
        "Portrait",
        "RegionMap",
        "Separatrix",
        "SpecialPoint",
    }
    results |= {"Trajectory", "Verified"}
    results |= {
        "AbstractForce",
        "AbstractFriction",
        "AtEvents",
        "PeriodDoubling",
        "SymmetryBreaking",
        "Torus",
        "EquilibriumKind",
        "EventKind",
        "Status",
    }
    results |= {"presets"}
    assert set(jb.__all__) - called - results == set()


def test_a_name_that_is_not_there_is_answered_with_one_that_is():
    with pytest.raises(AttributeError, match=r"'find_cycles' \(did you mean 'find_cycle'\?\)"):
        jb.find_cycles  # noqa: B018


@pytest.mark.parametrize("status", [status for status in jb.Status if status != jb.Status.OK])
def test_a_point_that_was_not_found_names_the_search_that_finds_every_point(status):
    point = object.__new__(jb.BifurcationPoint)  # with what its text is made of, and no more
    nan = np.array(np.nan)
    known = {"condition": jb.Hopf(), "value": nan, "error": nan, "status": np.array(status.value)}
    for name, value in known.items():
        object.__setattr__(point, name, value)
    assert "jb.scan" in repr(point) and jb.describe(status) in repr(point)


def test_what_a_function_closes_over_has_to_be_known():
    """A derivative through it would not be that of the result."""

    def damped(damping, nu0=0.3):
        return jb.Oscillator(damping, (jb.Belt(nu0, jb.Coulomb(0.5, 0.4)),))

    def swept(damping):
        return jb.sweep(lambda nu0: damped(damping, nu0), {"nu0": [0.1, 0.2]}, t1=9.0)

    def scanned(damping):
        return jb.scan(lambda nu: damped(damping, nu), span=(0.1, 0.7))

    with pytest.raises(ValueError, match="make must be one of known numbers: sweeps are"):
        jax.grad(swept)(0.1)
    with pytest.raises(ValueError, match="osc must be of known numbers: paths are"):
        jax.grad(scanned)(0.1)
