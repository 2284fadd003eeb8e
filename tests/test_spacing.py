"""Even values of a parameter are round where they can be."""

import numpy as np
import pytest

from jaxbelt.numerics.spacing import evenly_spaced


@pytest.mark.parametrize("n", [3, 5, 61, 101, 141, 1001])
@pytest.mark.parametrize("ends", [(-0.7, 0.7), (-1.1, 1.1), (-1 / 3, 1 / 3)])
def test_the_middle_of_a_symmetric_span_is_zero(ends, n):
    values = evenly_spaced(*ends, n)
    assert values[n // 2] == 0 and np.array_equal(values, -values[::-1])


@pytest.mark.parametrize("n", [1, 2, 7, 100])
def test_it_is_as_even_as_numpy(n):
    values = evenly_spaced(0.1, 2.3, n)
    np.testing.assert_allclose(values, np.linspace(0.1, 2.3, n), rtol=4e-16)
    assert values[0] == 0.1 and values[-1] == (2.3 if n > 1 else 0.1)
