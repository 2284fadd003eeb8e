"""Special points of curves in two parameters: they do not depend on where the rows lie."""

import numpy as np
import pytest

import jaxbelt as jb


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("start", "step"),
    [
        (0.35, 0.1),
        pytest.param(0.25, 0.1, marks=pytest.mark.slow),
        pytest.param(0.3, 0.03, marks=pytest.mark.slow),
    ],
)
def test_a_special_point_on_a_row_is_named_once(start, step):
    """From 0.35 the first row lies where both belts have one velocity."""
    law = jb.Conti(1.0, 0.6, 10.0)

    def make(velocity, edge):
        belts = jb.Belt(velocity, law, upper=edge), jb.Belt(0.35, law)
        return jb.Oscillator(0.5, belts)

    point = jb.refine(jb.BoundaryEquilibrium(0), lambda edge: make(start, edge), at=1.5)
    curve = jb.bifurcation_curve(point, make, ((-0.5, 1.0), (-3.0, 3.0)), step=step)
    named = {one.kind: one.values for one in curve.special}
    assert [one.kind for one in curve.special] == ["BeltAtRest", "BoundaryHopf", "EqualVelocities"]
    np.testing.assert_allclose(
        named["EqualVelocities"], (0.35, 2 * (0.6 + 0.4 / 4.5)), rtol=0, atol=1e-10
    )
    np.testing.assert_allclose(named["BeltAtRest"][0], 0.0, rtol=0, atol=1e-10)
