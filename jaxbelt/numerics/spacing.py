"""Evenly spaced numbers that are round where they can be."""

import numpy as np


def evenly_spaced(first: float, last: float, n: int) -> np.ndarray:
    """n numbers from first to last, [n], each rounded once.

    Between -0.7 and 0.7 some of `np.linspace` are 1e-16 where they should be 0, and a belt of that
    velocity creeps instead of being at rest.
    """
    after = np.arange(n)
    before = after[::-1]
    numbers = (first * before + last * after) / max(1, n - 1)
    numbers[0], numbers[-1] = first, last if n > 1 else first
    return numbers
