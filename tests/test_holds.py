"""Ends of stick phases under a clock, beside roots found in samples by bisection."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt.kernel.holds import hold_from
from jaxbelt.model.modes import Mode

#: Length of the phases, and samples of the oracle in it.
HORIZON, SAMPLES = 20.0, 8001
#: What a limit only touches: more than the package's rounding and less than any depth asked for.
TOUCHED = 2e-12


@jax.jit
@jax.vmap
def next_ends(limit, rest, v, amplitudes, frequencies, phases, edge, t):
    forces = [jb.Harmonic(*row) for row in zip(amplitudes, frequencies, phases, strict=True)]
    belt = jb.Belt(v, jb.Coulomb(1.0, 1.0), limit, upper=edge)
    osc = jb.Oscillator(0.0, (belt,), forcing=forces)
    row = jnp.ones(1)
    mode = Mode((0 * row,))
    # Without damping what is needed is x1 and the waves.
    x1 = (v * t - rest) * row
    hold = hold_from(osc, mode, row > 0, x1, v * row, t * row, (HORIZON - t) * row)
    return t + hold.duration[0], hold.number[0]


def durations(*phase):
    """As long as a phase lasts, asked for again where a search ends early, as the kernel does."""
    t, number = np.zeros(len(phase[0])), np.full(len(phase[0]), -1)
    for _ in range(20):
        goes_on = (number == -1) & (t < HORIZON)
        if not goes_on.any():
            break
        new_t, new_number = map(np.asarray, next_ends(*phase, t))
        t, number = np.where(goes_on, new_t, t), np.where(goes_on, new_number, number)
    return t, number


def first_ends(limit, rest, v, waves):
    """When a limit first goes below -`TOUCHED`, and the last root before; NaN: not in the time."""

    def limits(t):
        angles = waves[1][..., None] * t[:, None] + waves[2][..., None]
        needed = rest[:, None] - v[:, None] * t + np.sum(waves[0][..., None] * np.cos(angles), 1)
        return np.stack([limit[:, None] - needed, limit[:, None] + needed])

    def at(t):
        return limits(t[:, None])[..., 0]

    t = np.linspace(0.0, HORIZON, SAMPLES)
    step = t[1]
    grid = limits(np.broadcast_to(t, (len(limit), SAMPLES)))
    ends = np.full((2, len(limit)), np.nan)
    for side in range(2):
        f = grid[side]
        # The least value near each dip of the samples, by thirds of the interval.
        dips = (f[:, 1:-1] <= f[:, :-2]) & (f[:, 1:-1] <= f[:, 2:]) & (f[:, 1:-1] < 1e-2)
        rows, columns = np.nonzero(dips)
        low, high = t[columns], t[columns + 2]
        part = [limit[rows], rest[rows], v[rows], [one[rows] for one in waves]]

        def value(t, part=part, side=side):
            angles = part[3][1] * t[:, None] + part[3][2]
            needed = part[1] - part[2] * t + np.sum(part[3][0] * np.cos(angles), 1)
            return part[0] + (-1.0, 1.0)[side] * needed

        for _ in range(90):
            a, b = low + (high - low) / 3, high - (high - low) / 3
            left = value(a) < value(b)
            low, high = np.where(left, low, a), np.where(left, b, high)
        places = 0.5 * (low + high)
        deep = value(places) < -TOUCHED
        below = f < -TOUCHED
        known = np.where(below.any(1), t[np.argmax(below, 1)], np.inf)
        np.minimum.at(known, rows[deep], places[deep])
        # The root before that place, by bisection: the limit is positive a step and more before it.
        inner = np.where(np.isfinite(known), known, 0.0)
        outer = np.maximum(inner - step, 0.0)
        for _ in range(80):
            middle = 0.5 * (outer + inner)
            inside = at(middle)[side] > 0
            outer, inner = np.where(inside, middle, outer), np.where(inside, inner, middle)
        ends[side] = np.where(np.isfinite(known), 0.5 * (outer + inner), np.nan)
    return ends, at(np.zeros(len(limit)))


def random_waves(rng, count, forces):
    frequencies = rng.choice([0.5, 1.0, 1.5, 2.0, np.sqrt(2.0), 3.0], (count, forces))
    amplitudes = rng.choice([0.25, 0.5, 1.0], (count, forces)) * rng.uniform(0.5, 1.5)
    phases = rng.choice(np.pi / 4 * np.arange(8), (count, forces))
    return amplitudes, frequencies, phases


def sums(waves, t, order):
    """Derivatives of the sum of the waves."""
    amplitudes, frequencies, phases = waves
    angles = frequencies * t[:, None] + phases + order * np.pi / 2
    return np.sum(amplitudes * frequencies**order * np.cos(angles), axis=1)


@pytest.mark.parametrize("forces", [1, 2, 3])
def test_first_ends_are_those_of_samples(forces):
    rng = np.random.default_rng(forces)
    n = 400
    waves = random_waves(rng, n, forces)
    limit, v = rng.uniform(0.1, 3.0, n), rng.choice([-0.5, -0.1, 0.1, 0.3, 1.0], n)
    rest = rng.uniform(-1, 1, n) * limit - sums(waves, np.zeros(n), 0)
    ends, start = first_ends(limit, rest, v, waves)
    inside = np.all(start > 1e-6, axis=0)
    found, number = durations(limit, rest, v, *waves, np.full(n, 1e6))
    expected = np.fmin(ends[0], ends[1])
    side = np.where(np.nan_to_num(ends[0], nan=99.0) < np.nan_to_num(ends[1], nan=99.0), 3, 4)
    ended = inside & np.isfinite(expected)
    assert ended.sum() > 100
    assert np.max(np.abs(found - expected)[ended]) < 1e-6  # near-double roots among them
    assert np.quantile(np.abs(found - expected)[ended], 0.95) < 1e-12
    assert np.all(number[ended] == side[ended])
    assert np.all(number[inside & ~ended] == -1) and np.all(found[inside & ~ended] == HORIZON)


@pytest.mark.parametrize("depth", [0.0, 1e-11, 1e-9, 1e-6, -1e-11, -1e-9, -1e-6])
def test_a_touch_is_passed_and_the_slightest_crossing_ends_the_phase(depth):
    """Double roots, and roots beside them: the limit has a least value of -depth."""
    rng = np.random.default_rng(7)
    n = 300
    waves = random_waves(rng, n, 2)
    touch = rng.uniform(0.5, 12.0, n)
    v, limit = sums(waves, touch, 1), rng.uniform(0.5, 3.0, n)
    bends = sums(waves, touch, 2)
    side = np.sign(bends)
    rest = side * (-depth - limit) + v * touch - sums(waves, touch, 0)
    ends, start = first_ends(limit, rest, v, waves)
    # Where two waves cancel there is no touch: the limit stays as near for ever.
    inside = np.all(start > 1e-6, axis=0) & (np.abs(bends) > 1e-3)
    found, number = durations(limit, rest, v, *waves, np.full(n, 1e6))
    expected = np.nan_to_num(np.fmin(ends[0], ends[1]), nan=HORIZON)
    # A root is as sharp as its slope: rounding over the slope, sqrt(2 depth bend) and more.
    assert np.all(np.abs(found - expected)[inside] < 1e-15 / np.sqrt(max(abs(depth), 1e-13)) * 1e3)
    reached = inside & (expected > touch - 0.01)
    assert reached.sum() > 30
    if depth > 0:
        assert np.all(number[reached] != -1) and np.all(found[reached] < touch[reached])
    else:
        assert np.all(found[reached] > touch[reached] + 1e-3)


def test_a_triple_root_ends_the_phase():
    rng = np.random.default_rng(3)
    n = 200
    amplitudes, frequencies, phases = random_waves(rng, n, 1)
    # Where the wave is steepest: its second derivative vanishes.
    turn = rng.choice([0.5 * np.pi, 1.5 * np.pi], n) + 2 * np.pi * rng.integers(1, 3, n)
    touch = (turn - phases[:, 0]) / frequencies[:, 0]
    waves = amplitudes, frequencies, phases
    v, limit = sums(waves, touch, 1), rng.uniform(0.5, 2.0, n)
    side = np.sign(sums(waves, touch, 3))  # the limit falls through
    rest = -side * -limit + v * touch - sums(waves, touch, 0)
    ends, start = first_ends(limit, rest, v, waves)
    inside = np.all(start > 1e-3, axis=0)
    found, _ = durations(limit, rest, v, *waves, np.full(n, 1e6))
    expected = np.nan_to_num(np.fmin(ends[0], ends[1]), nan=HORIZON)
    at_touch = inside & (np.abs(expected - touch) < 1e-3)
    assert at_touch.sum() > 20
    # A limit passes its rounding, here and in the oracle, within its cube root of the place.
    assert np.all(np.abs(found - touch)[at_touch] < 1e-3)
    assert np.all(np.abs(found - expected)[inside & ~at_touch] < 1e-7)


def test_an_edge_ends_the_phase_before_a_limit_and_at_one():
    one = np.ones(3)
    # Needed is 0.1 cos t - t: the limit 1 is reached at t = 1 + 0.1 cos t.
    onset = 1.0
    for _ in range(60):
        onset = 1 + 0.1 * np.cos(onset)
    edges = np.array([0.5, onset, 2.0])
    waves = 0.1 * one[:, None], one[:, None], 0.0 * one[:, None]
    found, number = durations(one, 0.0 * one, one, *waves, edges)
    np.testing.assert_allclose(found, [0.5, onset, onset], atol=1e-13)
    # The upper edge of one belt is guard 2, its lower limit guard 4.
    assert number.tolist() == [2, 2, 4]
