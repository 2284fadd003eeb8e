"""How long diagrams and curves take: `pytest tests/benchmarks --benchmark-only`. Asserts no time.

Everything is warm: what is compiled is compiled before.
"""

import numpy as np
import pytest

import jaxbelt as jb


def nu0(osc):
    return osc.belts[0].velocity


def nu1(osc):
    return osc.belts[1].velocity


@pytest.fixture(scope="module")
def points():
    return jb.scan(jb.presets.class_b(0.3, 0.35), nu0, (-0.7, 0.7))


def test_scan_of_the_papers_path(benchmark, points):
    """Eight points, without a guess."""
    found = benchmark.pedantic(
        lambda: jb.scan(jb.presets.class_b(0.3, 0.35), nu0, (-0.7, 0.7)),
        warmup_rounds=1,
        rounds=3,
    )
    assert len(found) == len(points) == 8


def test_diagram_of_fig07(benchmark):
    """Points, equilibria, stable and unstable cycles."""
    found = benchmark.pedantic(
        lambda: jb.bifurcation_diagram(jb.presets.class_b(0.3, 0.35), nu0, (-0.7, 0.7)),
        warmup_rounds=1,
        rounds=3,
    )
    assert len(found.branches) == 4


def test_curve_of_200_points(benchmark, points):
    """The fold on belt 1 in the plane of both velocities, without its corner."""
    span = ((-0.7, -0.53), (0.3, 0.36))

    def curve():
        return jb.bifurcation_curve(points[0], (nu0, nu1), span, step=8.7e-4)

    found = benchmark.pedantic(curve, warmup_rounds=1, rounds=3)
    assert 190 <= len(found) <= 230 and np.max(found.residual) < 1e-12
