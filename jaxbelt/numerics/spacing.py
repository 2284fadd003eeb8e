"""Evenly spaced numbers that are round where they can be."""

import numpy as np


def evenly_spaced(first: float, last: float, n: int) -> np.ndarray:
    """n numbers from first to last, [n]; those of (-b, -a) are minus those of (a, b).

    So the middle of a span such as (-0.7, 0.7) is 0. Of `np.linspace` it may be 1e-16, and a belt
    of that velocity creeps instead of being at rest.
    """
    after = np.arange(n)
    before = after[::-1]
    numbers = (first * before + last * after) / max(1, n - 1)
    numbers[0], numbers[-1] = first, last if n > 1 else first
    return numbers
