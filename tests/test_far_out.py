"""Loops far out grow or shrink: `model.far_out` against runs of large amplitude."""

import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt.model.far_out import contraction_far_out


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("law", "damping", "expected", "start"),
    [
        (jb.Cubic(1.5, 1.5, 0.0), 1.0, -0.5, 1e4),  # friction falls as -1.5 r, and drives the mass
        (jb.Cubic(1.5, 1.5, 0.0), 2.0, 0.5, 1e4),
        (jb.Conti(1.0, 0.6, 10.0, quadratic=-1e-3), 0.5, -np.inf, 1e3),
        (jb.Conti(1.0, 0.6, 10.0, quadratic=1e-3), 0.5, np.inf, 1e3),
        (jb.Conti(1.0, 0.6, 10.0), 0.5, 0.5, 1e4),
        (jb.Stribeck(1.0, 0.5, 0.3), -0.5, -0.5, 1e4),
    ],
)
def test_loops_far_out_grow_where_the_contraction_is_negative(law, damping, expected, start):
    osc = jb.Oscillator(damping, (jb.Belt(0.3, law),))
    assert float(contraction_far_out(osc)) == pytest.approx(expected, rel=1e-6)
    end = jb.simulate(osc, (start, 0.0), 3.0, ts=[3.0]).ys[-1]  # about half a loop
    assert (np.hypot(*np.asarray(end)) > start) == (expected < 0)
