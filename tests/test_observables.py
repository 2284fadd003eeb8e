"""Reducers that see the whole motion: extrema, sections, fixed times and integrals."""

import re
from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxbelt as jb

SPAN, Y0 = 40.0, (3.0, 0.0)
NU0, NU1 = (0.45, 0.1, -0.2), 0.35
#: Sticks and slips on both belts; with sigma, passes an edge, too.
CASES = {
    "class_b": (jb.presets.class_b, {"nu0": np.array(NU0), "nu1": [NU1]}),
    "class_c": (
        lambda nu0, nu1: jb.presets.class_c(nu0, nu1, 0.8),
        {"nu0": np.array(NU0), "nu1": [0.4]},
    ),
}
#: Each takes a compilation a case.
in_turn = pytest.mark.parametrize(
    "name",
    [
        pytest.param("class_c", marks=pytest.mark.slow(first=True)),
        pytest.param("class_b", marks=pytest.mark.slow),
    ],
)
#: Moments of one sort each; derivatives are those of the sums over all of them.
at_night = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
#: No events: the belts are faster than the mass ever is.
FAST = (jb.presets.class_b, {"nu0": [4.0, 5.0], "nu1": [6.0]})
#: A sweep at 1e-11 is compared with an oracle at 1e-13: errors add up over a run.
CLOSE = dict(rtol=0, atol=1e-8)
TIGHT = dict(rtol=1e-11, atol=1e-11, t1=SPAN, progress=False)


def swept(case, observe):
    make, axes = case
    return jb.sweep(make, axes, y0=Y0, observe=observe, **TIGHT)


def runs(name):
    """The oracle's runs of a case."""
    if name == "class_b":
        oscillators = [oracle.class_b(nu0, NU1) for nu0 in NU0]
    else:
        oscillators = [oracle.class_c(nu0, 0.4, 0.8) for nu0 in NU0]
    return [oracle.simulate(osc, Y0, SPAN) for osc in oscillators]


def smooth_run(nu0):
    """SciPy's solution of a motion without events: a function of time."""

    def field(t, y):
        force = -y[0] - 0.5 * y[1]
        for nu in (nu0, 6.0):
            force += 0.4 / (1 + 10 * (nu - y[1])) + 0.6
        return y[1], force

    options = dict(rtol=1e-13, atol=1e-13, max_step=0.2, dense_output=True)
    return solve_ivp(field, (0, SPAN), Y0, "DOP853", **options).sol


def along(run):
    """The oracle's motion as a function of time, good to 1e-11."""
    starts = np.array([arc.t_start for arc in run.arcs])
    return lambda t: run.arcs[max(int(np.searchsorted(starts, t, "right")) - 1, 0)].dense(t)


def roots(function, count=4_001):
    """Zeros of a function of time over the run, found on a fine grid."""
    ts = np.linspace(0, SPAN, count)
    values = np.array([function(t) for t in ts])
    places = np.flatnonzero(values[:-1] * values[1:] < 0)
    return [brentq(function, ts[i], ts[i + 1], xtol=1e-13) for i in places]


def integral(function, knots):
    """The integral of a function of time that is smooth between the knots."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    total = 0.0
    for a, b in pairwise(knots):
        parts = np.linspace(a, b, max(2, int(np.ceil((b - a) / 0.1)) + 1))
        for left, right in pairwise(parts):
            middle, half = 0.5 * (left + right), 0.5 * (right - left)
            total += half * sum(
                w * function(middle + half * x) for x, w in zip(nodes, weights, strict=True)
            )
    return total


def examples():
    """What the page on observables defines."""
    page = (Path(__file__).parents[1] / "docs" / "observables.md").read_text(encoding="utf-8")
    names = {}
    exec("\n".join(re.findall(r"^```python\n(.+?)^```$", page, re.MULTILINE | re.DOTALL)), names)
    return names


PAGE = examples()
Largest, Energy, Points, Samples = (PAGE[n] for n in ("Largest", "Energy", "Points", "Samples"))
height = PAGE["height"]


@at_night
def test_extrema_are_those_of_the_oracle(name):
    found = swept(CASES[name], Largest(10.0))
    for i, run in enumerate(runs(name)):
        extrema = [loop for arc in run.arcs for loop in arc.loops if loop.axis == 0]
        assert found.extrema[i, 0] == len(extrema)
        late = max(abs(loop.x1) for loop in extrema if loop.t > 10)
        np.testing.assert_allclose(found.largest[i, 0], late, **CLOSE)


@at_night
def test_integrals_are_those_of_the_oracle(name):
    found = swept(CASES[name], Energy())
    for i, run in enumerate(runs(name)):
        knots = sorted({0.0, SPAN, *(event.t for event in run.events)})
        motion = along(run)
        square = integral(lambda t, motion=motion: motion(t)[0] ** 2, knots)
        np.testing.assert_allclose(found.square[i, 0], square, rtol=1e-8)
        np.testing.assert_allclose(found.rms[i, 0], np.sqrt(square / SPAN), rtol=1e-8)
    # What is fed and not lost is in the mass and its spring, to the tolerance.
    np.testing.assert_allclose(found.fed - found.lost, found.gained, **CLOSE)


@at_night
def test_points_of_a_section_are_those_of_the_oracle(name):
    found = swept(CASES[name], Points())
    for i, motion in enumerate(map(along, runs(name))):
        passed = roots(lambda t, motion=motion: height(None, *motion(t)))
        assert height(None, *Y0) < 0  # it begins below
        ups, downs = passed[::2], passed[1::2]
        assert found["count"][i, 0] == len(ups) > 3
        expected = np.array([[t, *motion(t)] for t in ups[:8]])
        for k, name in enumerate(("t", "x1", "x2")):
            np.testing.assert_allclose(found[name][i, 0, : len(expected)], expected[:, k], **CLOSE)
        above = sum(downs) + SPAN * (len(ups) > len(downs)) - sum(ups)
        np.testing.assert_allclose(found.above[i, 0], above, rtol=0, atol=1e-7)


@pytest.mark.slow(first=True)
def test_the_last_stay_above_a_section_ends_with_the_run():
    end = 14.0
    found = jb.sweep(*CASES["class_b"], y0=Y0, observe=Points(), **{**TIGHT, "t1": end})
    ends_above = 0
    for i, nu0 in enumerate(NU0):
        motion = along(oracle.simulate(oracle.class_b(nu0, NU1), Y0, end))
        passed = roots(lambda t, motion=motion: height(None, *motion(min(t, end))))
        ups, downs = passed[::2], passed[1::2]
        ends_above += len(ups) > len(downs)
        above = sum(downs) + end * (len(ups) > len(downs)) - sum(ups)
        np.testing.assert_allclose(found.above[i, 0], above, rtol=0, atol=1e-7)
    assert 0 < ends_above


@pytest.mark.slow(first=True)
def test_what_is_fed_and_not_lost_is_gained_whatever_omega_is():
    def make(velocity, omega=2.0):
        return jb.Oscillator(0.5, (jb.Belt(velocity, jb.Conti(1.0, 0.6, 10.0), 0.5),), omega=omega)

    found = jb.sweep(make, {"velocity": [0.3, -0.2]}, y0=Y0, observe=Energy(), **TIGHT)
    ends = [jb.simulate(make(v), Y0, SPAN, ts=[SPAN], rtol=1e-12).ys[-1] for v in (0.3, -0.2)]
    gained = [0.5 * float(y[0] ** 2 + y[1] ** 2) - 0.5 * 3.0**2 for y in ends]
    np.testing.assert_allclose(found.gained, gained, **CLOSE)
    np.testing.assert_allclose(found.fed - found.lost, gained, **CLOSE)


@at_night
def test_states_at_fixed_times_are_those_of_the_oracle(name):
    found = swept(CASES[name], Samples())
    assert np.all(found["count"] == 33)
    for i, run in enumerate(runs(name)):
        expected = np.array([run.at(t) for t in np.linspace(0.0, SPAN, 33)])
        np.testing.assert_allclose(found.x1[i, 0], expected[:, 0], **CLOSE)
        np.testing.assert_allclose(found.x2[i, 0], expected[:, 1], **CLOSE)


class Everything:
    """How often it was asked at each kind of moment, and the largest and smallest x2 of extrema."""

    at = (jb.AtEvents(), jb.AtExtrema("x2"), jb.AtTimes([1.0, 2.0]))

    def init(self, osc, x1, x2):
        return jnp.zeros(3), x2, x2

    def rates(self, osc, motion):
        return motion.a, motion.x2

    def update(self, state, event):
        counts, low, high = state
        counts = counts + jnp.where(jnp.arange(3) == event.moment, 1.0, 0.0)
        extreme = jnp.where(event.moment == 1, event.x2, low)
        low, high = jnp.minimum(low, extreme), jnp.maximum(high, extreme)
        return counts, low, high

    def finish(self, state, end):
        counts, low, high = state
        asked = dict(zip(("events", "extrema", "times"), counts, strict=True))
        rise, way = end.integrals
        return asked | {"low": low, "high": high, "rise": rise, "way": way}


@at_night
def test_extrema_of_the_velocity_last_through_stick_phases(name):
    found = swept(CASES[name], Everything())
    assert np.all(found.times == 2)
    for i, run in enumerate(runs(name)):
        assert found.events[i, 0] == len(run.events)
        values = [arc.dense(t)[1] for arc in run.arcs for t in (arc.t_start, arc.t_end)]
        values += [loop.x2 for arc in run.arcs for loop in arc.loops]
        np.testing.assert_allclose(found.high[i, 0], max(values), **CLOSE)
        np.testing.assert_allclose(found.low[i, 0], min(values), **CLOSE)
        # The integrals of x2' and x2 are what x2 and x1 went.
        np.testing.assert_allclose(found["rise"][i, 0], run.y_end[1] - Y0[1], **CLOSE)
        np.testing.assert_allclose(found.way[i, 0], run.y_end[0] - Y0[0], **CLOSE)


def bowl(osc, x1, x2):
    """Passed twice on a way of 0.04."""
    return (x1 - 0.3) ** 2 - 0.02**2


class Passages:
    """How often a section was passed each way, the sums of the times, and whether in order."""

    at = (jb.AtSection(bowl, 1), jb.AtSection(bowl, -1))

    def init(self, osc, x1, x2):
        return jnp.zeros(2), jnp.zeros(2), jnp.zeros(()), jnp.ones(())

    def update(self, state, event):
        counts, sums, last, ordered = state
        here = jnp.where(jnp.arange(2) == event.moment, 1.0, 0.0)
        ordered = jnp.where(event.t > last, ordered, 0.0)
        return counts + here, sums + here * event.t, event.t, ordered

    def finish(self, state, end):
        counts, sums, _, ordered = state
        return {"counts": counts, "sums": sums, "ordered": ordered}


@in_turn
def test_a_section_is_passed_twice_in_a_stick_phase_and_in_a_step(name):
    found = swept(CASES[name], Passages())
    assert np.all(found.ordered == 1)
    stuck = 0
    for i, run in enumerate(runs(name)):
        motion = along(run)
        passed = roots(lambda t, motion=motion: bowl(None, *motion(t)), count=8_001)
        downs, ups = passed[::2], passed[1::2]
        assert found["counts"][i, 0].values.tolist() == [len(ups), len(downs)]
        np.testing.assert_allclose(found["sums"][i, 0], [sum(ups), sum(downs)], **CLOSE)
        spans = [(arc.t_start, arc.t_end) for arc in run.arcs if 0 in arc.mode]
        pairs = list(zip(downs, ups, strict=False))
        stuck += sum(a < one and two < b for a, b in spans for one, two in pairs)
    assert stuck > 0


class Moments:
    """Sums of t, x1, x2 and an integral over the moments of each sort, and integrals to the end."""

    at = (jb.AtSection(height, 1), jb.AtExtrema("x1"), jb.AtTimes([7.3, 20.0, 33.1]), jb.AtEvents())

    def init(self, osc, x1, x2):
        return jnp.zeros((4, 4))

    def rates(self, osc, motion):
        return motion.x1**2, motion.forces[0]

    def update(self, state, event):
        told = jnp.stack([event.t, event.x1, event.x2, event.integrals[0]])
        return state + jnp.where((jnp.arange(4) == event.moment)[:, None], told[None], 0.0)

    def finish(self, state, end):
        return {"sums": state, "square": end.integrals[0], "force": end.integrals[1]}


@in_turn
def test_sums_and_their_derivatives_are_those_of_the_oracle(name):
    """Of sections, extrema, fixed times, events and integrals, through stick phases and edges."""
    make, axes = CASES[name]
    options = dict(y0=Y0, observe=Moments(), derivatives="nu0", **TIGHT)
    found = jb.sweep(make, {**axes, "nu0": [NU0[0], NU0[2]]}, **options)

    def expected(nu0):
        right = oracle.class_b(nu0, NU1) if name == "class_b" else oracle.class_c(nu0, 0.4, 0.8)
        run = oracle.simulate(right, Y0, SPAN)
        motion = along(run)
        moments = [
            roots(lambda t: height(None, *motion(t)))[::2],
            [loop.t for arc in run.arcs for loop in arc.loops if loop.axis == 0],
            [7.3, 20.0, 33.1],
            [event.t for event in run.events],
        ]
        knots = sorted({0.0, SPAN, *(t for times in moments for t in times)})
        parts = [integral(lambda t: motion(t)[0] ** 2, pair) for pair in pairwise(knots)]
        square = dict(zip(knots, [0.0, *np.cumsum(parts)], strict=True))
        sums = [sum(np.array([t, *motion(t), square[t]]) for t in times) for times in moments]
        return np.array([*np.ravel(sums), square[SPAN]])

    for i, nu0 in enumerate((NU0[0], NU0[2])):
        values = [*found.sums[i, 0].values.ravel(), found.square[i, 0].item()]
        # Of some dozen moments, each of them CLOSE.
        np.testing.assert_allclose(values, expected(nu0), rtol=0, atol=1e-7)
        differences, error = oracle.richardson(expected, nu0, 2e-3, levels=3)
        ours = [*found.d_sums_d_nu0[i, 0].values.ravel(), found.d_square_d_nu0[i, 0].item()]
        # As good as the differences are, or to 1e-7 of the largest.
        room = 1e-7 * np.max(np.abs(differences)) + 10 * error
        assert np.all(np.abs(np.array(ours) - differences) < room)
        assert np.all(room < 1e-5 * np.max(np.abs(differences)))


@pytest.mark.slow(first=True)
def test_a_smooth_motion_passes_a_section():
    points = swept(FAST, Points())
    for i, nu0 in enumerate(FAST[1]["nu0"]):
        motion = smooth_run(nu0)
        ups = roots(lambda t, motion=motion: height(None, *motion(t)))[::2]
        assert points["count"][i, 0] == len(ups)


@pytest.mark.slow
def test_a_smooth_motion_has_integrals():
    found = swept(FAST, Energy())
    for i, nu0 in enumerate(FAST[1]["nu0"]):
        motion = smooth_run(nu0)
        square = integral(lambda t, motion=motion: motion(t)[0] ** 2, [0.0, SPAN])
        np.testing.assert_allclose(found.square[i, 0], square, rtol=1e-8)
    np.testing.assert_allclose(found.fed - found.lost, found.gained, **CLOSE)


@pytest.mark.slow(first=True)
def test_rest_and_a_mass_that_is_stuck_for_ever_are_integrated():
    held = jb.sweep(jb.presets.class_a, {"nu0": [0.0]}, y0=(0.25, 0.0), t1=3.0, observe=Energy())
    assert held.status == jb.Status.STUCK_FOREVER
    np.testing.assert_allclose(held.rms, 0.25, rtol=1e-15)


class Counted:
    """Rates that are no floats, and a state that becomes one."""

    def init(self, osc, x1, x2):
        return 0.0

    def rates(self, osc, motion):
        return {"time": 1, "right": motion.x1 > 0}

    def update(self, state, event):
        return 1  # kept as a float

    def finish(self, state, end):
        return end.integrals | {"state": state}


@pytest.mark.slow(first=True)
def test_rates_that_are_integers_or_truth_values_are_integrated():
    make, axes = FAST
    options = dict(y0=(0.25, 0.0), t1=3.0, progress=False, observe=Counted())
    held = jb.sweep(jb.presets.class_a, {"nu0": [0.0]}, **options)
    np.testing.assert_allclose([held.time, held.right], 3.0, rtol=1e-14)
    moving = jb.sweep(make, axes, **options)
    np.testing.assert_allclose(moving.time, 3.0, rtol=1e-14)
    # A jump of a rate within a step is found to the size of the step.
    assert np.all((moving.right > 0) & (moving.right <= 3.0))


@pytest.mark.slow(first=True)
def test_a_store_knows_moments_apart(tmp_path):
    def count(moment):
        class Count(Largest):
            def __init__(self):
                super().__init__(0.0)
                self.at = (moment,)

        return Count()

    def again(moment):
        make, axes = FAST
        return jb.sweep(make, axes, t1=5.0, observe=count(moment), store=tmp_path / "a.zarr")

    def other(osc, x1, x2):
        return x1 - 0.4 * x2 - 0.2

    again(jb.AtSection(height))
    again(jb.AtSection(height))
    for moment in (jb.AtSection(other), jb.AtSection(height, 1), jb.AtExtrema("x1")):
        with pytest.raises(ValueError, match="which differs in observe"):
            again(moment)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: jb.AtExtrema("x3"), 'of must be "x1" or "x2", got \'x3\''),
        (lambda: jb.AtSection(3.0), "function must be a function of osc, x1 and x2"),
        (lambda: jb.AtSection(height, 2), "direction must be -1, 0 or 1, got 2"),
        (lambda: jb.AtTimes([1.0, 1.0]), "times must be finite, >= 0 and increasing"),
        (lambda: jb.AtTimes([]), r"times must be numbers, \[n\]"),
    ],
)
def test_impossible_moments_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
    reducer = Largest(10.0)
    reducer.at = "x1"
    with pytest.raises(ValueError, match=r"observe\.at must be a tuple of AtEvents, AtExtrema"):
        swept(FAST, reducer)
