"""`circle_map` against `find_cycle`, runs of SciPy and of `simulate`, closed forms, relations that
must hold, and the engine of tests/campaign/forced.py."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxbelt as jb
from jaxbelt.model.own_units import in_own_units
from tests.campaign import forced

OMEGA, AMPLITUDE = 1.68, 0.1
PERIOD = 2 * np.pi / OMEGA
#: What the belt can hold.
CAPACITY = 1.5


def bkn(amplitude=AMPLITUDE, velocity=1.0, *, length=1.0, omega=1.0):
    """The oscillator of di Bernardo, Kowalczyk and Nordmark, 2003, in other units."""
    speed = length * omega
    law = jb.Cubic(1.5, 1.5 / speed, 0.45 / speed**3)
    forcing = jb.Harmonic(amplitude * length, OMEGA)
    return jb.Oscillator(0.0, (jb.Belt(velocity * speed, law, length),), omega, forcing=forcing)


@pytest.fixture(scope="module")
def found():
    return jb.circle_map(bkn())


def same_maps(one, other, **tolerances):
    for name in ("elapsed", "slopes", "is_onset", "fixed_points", "multipliers"):
        values = getattr(one, name), getattr(other, name)
        np.testing.assert_allclose(*values, err_msg=name, **tolerances)


def onset(phase, amplitude=AMPLITUDE):
    """The state of a mass on the belt of velocity 1 where needed = -capacity."""
    return amplitude * np.cos(phase) + CAPACITY, 1.0


# --- fixed points ---------------------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_fixed_points_are_sticking_periodic_motions(found):
    """The phase of onset is that of the arcs of what `find_cycle` and `periodic` find."""
    motion = jb.find_cycle(bkn(), (0.5, 0.0))
    (place,) = np.flatnonzero(found.stable)
    assert found.motions[place].periods == motion.periods == 2
    assert found.multipliers[place] == pytest.approx(float(motion.multipliers[0].real), abs=1e-9)
    unstable = found.motions[place + 1]
    again = jb.periodic(bkn(), np.asarray(unstable.start) + 1e-6, periods=2)
    assert not again.stable
    assert found.multipliers[place + 1] == pytest.approx(float(again.multipliers[0].real))
    for one, at in ((motion, place), (again, place + 1)):
        arcs = one.arcs
        stuck = np.asarray(arcs.mode)[:, 0] == 0
        (last,) = np.flatnonzero(stuck & ~np.roll(stuck, -1))
        end = float(arcs.t[last] + arcs.duration[last])
        assert found.fixed_points[at] == pytest.approx(OMEGA * end % (2 * np.pi), abs=1e-9)


def test_fixed_points_repeat_under_the_map(found):
    """A run of SciPy from the onset of each comes to an onset at the same phase; its slope there,
    by a difference, is the multiplier."""
    simple = found.fixed_points[[motion.periods == 2 for motion in found.motions]]
    assert len(simple) == 2
    for phase, multiplier in zip(simple, found.multipliers, strict=False):
        assert followed(phase) == pytest.approx(2 * PERIOD, abs=1e-9)
        steps = [followed(phase + h) - followed(phase - h) for h in (1e-4, 2e-4)]
        slope = 1 + OMEGA * (8 * steps[0] - steps[1]) / 12e-4
        # Runs are good to 1e-11, which a difference of 2e-4 makes 1e-7.
        assert slope == pytest.approx(multiplier, abs=1e-6)


def test_what_jumps_over_the_diagonal_is_no_fixed_point(found):
    turns = found.elapsed / PERIOD
    passes = np.floor(turns) != np.floor(np.roll(turns, -1))
    width = found.phases[1]
    near = np.min(np.abs(found.fixed_points[:, None] - found.phases - 0.5 * width), axis=0)
    jumps = passes & (near > 2 * width)
    assert np.sum(jumps) > 3
    for i in np.flatnonzero(jumps):
        # A jump is as large as it is however near: that over the fourth part is over half a turn.
        assert abs(turns[i] - np.roll(turns, -1)[i]) > 0.1
    assert len(found.unsolved) == 0
    assert all(int(one.status) == 0 and float(one.residual) < 1e-9 for one in found.motions)


def test_fixed_points_of_iterates_are_cycles_of_the_map(found):
    """The second next onset is that behind the next."""
    iterated = jb.circle_map(bkn(), iterate=2, periods=6)
    later = np.interp(found.next_phases, found.phases, found.next_phases)
    smooth = np.flatnonzero((found.phases > 1.0) & (found.phases < 3.0))
    np.testing.assert_allclose(iterated.next_phases[smooth], later[smooth], atol=1e-4)
    # Fixed points stay fixed, with their own motions.
    assert set(found.fixed_points[:2].round(9)) <= set(iterated.fixed_points.round(9))
    for phase, motion in zip(iterated.fixed_points, iterated.motions, strict=True):
        assert motion.periods in (2, 4, 6), phase


@pytest.mark.slow(first=True)
def test_a_motion_with_three_onsets_is_a_cycle_of_three_phases():
    belt = conti(jb.Oscillating(0.3, 0.2, 1.2, 0.3))
    osc = jb.Oscillator(0.1, (belt,))
    motion = jb.find_cycle(osc, (0.5, 0.0))
    assert motion.periods == 4 and len(motion.signature) == 6
    once, thrice = jb.circle_map(osc), jb.circle_map(osc, iterate=3)
    assert once.motions == ()
    stable = thrice.fixed_points[thrice.stable]
    assert len(stable) == 3
    arcs = motion.arcs
    stuck = np.asarray(arcs.mode)[:, 0] == 0
    ends = np.asarray(arcs.t + arcs.duration)[stuck & ~np.roll(stuck, -1)]
    np.testing.assert_allclose(np.sort(1.2 * ends % (2 * np.pi)), stable, atol=1e-9)
    multiplier = float(motion.multipliers[0].real)
    np.testing.assert_allclose(thrice.multipliers[thrice.stable], multiplier, rtol=1e-9)


@pytest.mark.slow(first=True)
def test_a_fixed_point_between_a_phase_and_the_end_of_a_branch_is_found():
    """The mass sticks for 1.4e-4 only; the branch ends before the next of 400 phases."""
    osc = jb.Oscillator(0.2, (conti(0.1),), forcing=jb.Harmonic(1.5, 2.1))
    motion = jb.find_cycle(osc, (0.5, 0.0))
    assert 0 < float(motion.stick_durations[0]) < 1e-3
    found = jb.circle_map(osc)
    assert found.stable.tolist() == [True]
    multiplier = float(motion.multipliers[0].real)
    assert found.multipliers[0] == pytest.approx(multiplier, abs=1e-9)


# --- points of the map ----------------------------------------------------------------------------


def followed(phase):
    """The time from an onset to the next where the mass slips once in between, by SciPy."""

    def field(t, y):
        r = 1.0 - y[1]
        return y[1], -y[0] + 1.5 - 1.5 * r + 0.45 * r**3 + AMPLITUDE * np.cos(OMEGA * t)

    def arrives(t, y):
        return 1.0 - y[1]

    arrives.terminal, arrives.direction = True, -1
    t0 = phase / OMEGA
    settings = dict(method="DOP853", rtol=1e-13, atol=1e-13)
    away = solve_ivp(field, (t0, t0 + 0.5), onset(phase), **settings)
    back = solve_ivp(field, (t0 + 0.5, t0 + 20), away.y[:, -1], events=arrives, **settings)
    t, x1 = back.t[-1], back.y[0, -1]

    def held(time):
        return CAPACITY - (x1 + time - t) + AMPLITUDE * np.cos(OMEGA * time)

    assert held(t) > 0
    return brentq(held, t, t + 2 * CAPACITY + 1, xtol=1e-14) - t0


@pytest.mark.parametrize("i", [100, 150, 200])
def test_the_next_onset_is_that_of_scipy(found, i):
    # Steps of the sweep are good to 1e-10 each.
    assert found.elapsed[i] == pytest.approx(followed(found.phases[i]), abs=1e-9)


@pytest.mark.parametrize("i", [0, 57, 100, 200, 263, 300, 341])
def test_the_next_onset_is_that_of_a_run(found, i):
    """At the phases 0, pi/2, pi, 3 pi/2 and others; with crossings, and up to 6 periods later."""
    phase = 2 * np.pi * i / 400
    assert found.phases[i] == pytest.approx(phase, abs=1e-15) and found.is_onset[i]
    t0, cuts = phase / OMEGA, PERIOD * np.arange(1, 33)
    # In own units, for which the map has compiled it.
    events = jb.simulate(in_own_units(bkn()), onset(phase), cuts[-1], t0=t0, ts=cuts).events
    slips = np.asarray(events.t)[np.asarray(events.kind) == jb.EventKind.SLIP]
    # Where the slopes are large so are errors, up to 200 here.
    error = 1e-10 * (1 + abs(found.slopes[i]))
    assert found.elapsed[i] == pytest.approx(slips[0] - t0, abs=error)
    lift = phase + OMEGA * found.elapsed[i]
    assert found.next_phases[i] + 2 * np.pi * found.periods[i] == pytest.approx(lift, abs=1e-12)
    assert 0 <= found.next_phases[i] < 2 * np.pi


def test_slopes_are_those_of_differences(found):
    for phase, i in ((np.pi / 2, 100), (np.pi, 200)):
        steps = [followed(phase + h) - followed(phase - h) for h in (1e-3, 2e-3)]
        slope = 1 + OMEGA * (8 * steps[0] - steps[1]) / 12e-3
        assert found.slopes[i] == pytest.approx(slope, abs=1e-6)


def test_where_needed_comes_back_from_the_limit_there_is_no_onset():
    """needed + capacity has the slope -1 - F Omega sin(phase) along the belt."""
    strong = jb.circle_map(bkn(1.0))
    leaves = 1.0 + OMEGA * np.sin(strong.phases) > 0
    assert np.any(~leaves) and np.array_equal(strong.is_onset, leaves)
    assert np.all(np.isnan(strong.elapsed[~leaves])) and np.all(np.isnan(strong.slopes[~leaves]))
    table = strong.table()
    assert np.array_equal(table.is_onset[~table.fixed_point], leaves)
    (patch,) = strong.plot().collections
    assert patch.get_label() == "no onset"


def test_what_does_not_stick_again_in_time_is_nan(found):
    short = jb.circle_map(bkn(), periods=3)
    late = found.elapsed > 3 * PERIOD
    assert 0 < np.sum(late) < 400
    np.testing.assert_array_equal(short.elapsed, np.where(late, np.nan, found.elapsed))
    assert [motion.periods for motion in short.motions] == [2, 2]
    # No stick phase ends at the other limit: the belt carries the mass to this one.
    other = jb.circle_map(bkn(), limit=1)
    assert not np.any(other.is_onset) and other.motions == () and "none" in repr(other)


# --- relations ------------------------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_a_force_of_the_other_sign_moves_the_phase_by_half_a_turn(found):
    other = jb.circle_map(bkn(-AMPLITUDE))
    # The cosines differ in the last bit, which slopes up to 1e4 make more of.
    error = 1e-7 * (1 + np.abs(found.slopes))
    assert np.all(np.abs(np.roll(other.elapsed, 200) - found.elapsed) < error)
    moved = np.sort((other.fixed_points + np.pi) % (2 * np.pi))
    np.testing.assert_allclose(moved, found.fixed_points, atol=1e-9)


@pytest.mark.slow(first=True)
def test_the_mirror_image_has_the_same_map_at_the_other_limit(found):
    mirrored = jb.circle_map(bkn(-AMPLITUDE, -1.0))
    assert (found.limit, mirrored.limit) == (-1, 1)
    same_maps(mirrored, found, rtol=0, atol=1e-12)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("units", [(2.0**-24, 2.0**3), (2.0**24, 2.0**-10)], ids=str)
def test_the_map_does_not_depend_on_units(found, units):
    """Of powers of two it does not to the last bit; the motions come in the units given."""
    length, omega = units
    other = jb.circle_map(bkn(length=length, omega=omega))
    same_maps(other, found, rtol=0, atol=0)
    for one, motion in zip(other.motions, found.motions, strict=True):
        np.testing.assert_array_equal(np.asarray(one.start), length * np.asarray(motion.start))


# --- the result -----------------------------------------------------------------------------------


def test_table_and_text(found):
    table = found.table()
    assert len(table) == 400 + len(found.motions) and np.all(np.diff(table.phase) >= 0)
    fixed = table[table.fixed_point]
    np.testing.assert_array_equal(fixed.phase, found.fixed_points)
    np.testing.assert_array_equal(fixed.next_phase, found.fixed_points)
    np.testing.assert_array_equal(fixed.slope, found.multipliers)
    np.testing.assert_array_equal(table.periods[~table.fixed_point], found.periods)
    text = "CircleMap(belt 0, needed = -capacity, 400 of 400 phases lead on, fixed points: 2.92707 "
    assert repr(found).startswith(text + "(2 periods, stable, multiplier 0.831647); ")


def test_the_picture_has_gaps_where_the_map_jumps(found):
    ax = found.plot()
    lines = {line.get_label(): line for line in ax.lines}
    x, y = lines["next onset"].get_data()
    joined = np.abs(np.diff(y))
    # Beside a square root it rises by 0.2 from one phase to the next, or less.
    assert np.nanmax(joined) < 0.5 and 5 < np.sum(np.isnan(y)) < 60
    assert np.nanmin(x) == 0 and np.nanmax(x) == 2 * np.pi
    stable, unstable = (lines[f"{word} fixed point"] for word in ("stable", "unstable"))
    assert stable.get_markerfacecolor() == "black" and unstable.get_markerfacecolor() == "white"
    assert len(stable.get_xdata()) == 1 and len(unstable.get_xdata()) == len(found.motions) - 1
    assert [text.get_text() for text in ax.get_xticklabels()][2] == r"$\pi$"


@pytest.mark.parametrize(
    ("osc", "options", "message"),
    [
        (jb.presets.class_a(0.3), {}, "osc must be with a clock: circle_map is for oscillators"),
        (bkn(), {"belt": 1}, "belt must be 0: there is one belt, got 1"),
        (bkn(), {"limit": 0}, "limit must be 1, -1 or None, got 0"),
        (bkn(), {"n": 1}, "n must be an integer >= 2, got 1"),
        (bkn(), {"iterate": 0}, "iterate must be a positive integer, got 0"),
        (bkn(), {"periods": 33}, "periods must be at most 32, got 33"),
        (
            jb.Oscillator(0.1, (jb.Belt(1.0, jb.Coulomb(1, 1), 0.0),), forcing=jb.Harmonic(1, 1)),
            {},
            "belt must be one with a load and static friction above 0, got belt 0",
        ),
        (
            jb.Oscillator(0.1, bkn().belts, forcing=(jb.Harmonic(1, 1), jb.Harmonic(1, 2**0.5))),
            {},
            "osc must be such that all its frequencies have a period in common",
        ),
        (
            jb.Oscillator(
                0.1, jb.presets.class_d(0.3, 0.2, -0.5, 0.5).belts, forcing=jb.Harmonic(1, 1)
            ),
            {},
            "belt must be one within whose contact no contact of another belt begins or ends",
        ),
    ],
)
def test_impossible_arguments(osc, options, message):
    with pytest.raises(ValueError, match=message):
        jb.circle_map(osc, **options)


# --- other oscillators, against the engine --------------------------------------------------------


def conti(velocity, load=1.0, **edges):
    return jb.Belt(velocity, jb.Conti(1.0, 0.6, 10.0), load, **edges)


def engine_conti(velocity, load=1.0, **edges):
    return forced.Belt(velocity, ("conti", 1.0, 0.6, 10.0, 0.0), load, **edges)


def wave(kind):
    return kind(0.3, 0.2, 1.2, 0.3)


CASES = {
    "one belt": lambda belt, _: ((belt(0.3),), (0.5, 1.3, 0.0)),
    "mates": lambda belt, _: ((belt(0.3), belt(0.3, 0.3)), (0.5, 1.3, 0.4)),
    "two velocities": lambda belt, _: ((belt(0.3), belt(-0.2, 0.3)), (0.5, 1.3, 0.0)),
    "one at a time": lambda belt, _: ((belt(0.3, upper=1.2), belt(-0.2, lower=1.2)), (0.5, 1.3, 0)),
    "a velocity that oscillates": lambda belt, kind: ((belt(wave(kind)),), (0.1, 1.2, 1.0)),
    "a load that oscillates": lambda belt, kind: ((belt(0.3, wave(kind)),), (0.4, 1.2, 0.0)),
    "at rest": lambda belt, _: ((belt(0.0),), (1.4, 0.35, 0.0)),
}


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("name", CASES)
def test_the_next_onset_is_that_of_the_engine(name):
    belts, force = CASES[name](conti, jb.Oscillating)
    osc = jb.Oscillator(0.1, belts, forcing=jb.Harmonic(*force))
    belts, _ = CASES[name](engine_conti, forced.Oscillating)
    engine = forced.Oscillator(0.1, belts, (forced.Harmonic(*force),))
    found = jb.circle_map(osc)
    known, period = 0, found.period
    for i in range(0, 400, 10):
        if not found.is_onset[i]:
            continue
        t0 = found.phases[i] / (2 * np.pi) * period
        x1, x2 = _at_limit(engine, t0, found.limit)
        run = forced.simulate(engine, (x1, x2), t0 + 32 * period, t0=t0)
        slips = np.flatnonzero((run.kind == forced.SLIP) & (run.belt == 0))
        wanted = [_at_limit(engine, run.t[j], found.limit)[0] for j in slips]
        here = slips[np.abs(run.y[slips, 0] - wanted) < 1e-7]
        expected = run.t[here[0]] - t0 if len(here) else np.nan
        error = 1e-7 * (1 + abs(np.nan_to_num(found.slopes[i])))
        assert found.elapsed[i] == pytest.approx(expected, abs=error, nan_ok=True), i
        known += np.isfinite(expected)
    assert known > 5
    for motion, phase in zip(found.motions, found.fixed_points, strict=True):
        t0, count = phase / (2 * np.pi) * period, motion.periods
        run = forced.simulate(
            engine, _at_limit(engine, t0, found.limit), t0 + count * period, t0=t0
        )
        size = 1 + abs(found.multipliers[list(found.motions).index(motion)])
        assert run.y_end == pytest.approx(_at_limit(engine, t0, found.limit), abs=1e-7 * size)


def _at_limit(engine, t, limit):
    """The state at the limit of belt 0, by the numbers of the engine; damping 0.1."""

    def value(wave, k=0):
        if not isinstance(wave, forced.Oscillating):
            return wave if k == 0 else 0.0
        angle = wave.frequency * t + wave.phase
        if k:
            return -wave.amplitude * wave.frequency * np.sin(angle)
        return wave.mean + wave.amplitude * np.cos(angle)

    belt, (force,) = engine.belts[0], engine.forces
    nu, capacity = value(belt.velocity), value(belt.load)
    needed = force.amplitude * np.cos(force.frequency * t + force.phase) - 0.1 * nu
    needed -= value(belt.velocity, 1)
    for other in engine.belts[1:]:
        if value(other.velocity) == nu:
            capacity += value(other.load)
        elif not other.lower >= belt.upper:
            r = value(other.velocity) - nu
            mu = 0.6 + 0.4 / (1 + 10.0 * abs(r))
            needed += np.sign(r) * value(other.load) * mu
    return needed - limit * capacity, nu


@pytest.mark.slow(first=True)
def test_a_limit_that_is_passed_by_little_more_than_rounding_keeps_no_run():
    """On a swinging belt whose load swings, too, some onsets between two phases of this map come
    133 and 140 later, behind slips of 4e-5: shortened steps there were not shorter."""
    velocity, load = jb.Oscillating(0.0, 0.5, 1.0, np.pi / 2), jb.Oscillating(0.5, 0.25, 1.0)
    belt = jb.Belt(velocity, jb.Coulomb(1.0, 1.0), load)
    osc = jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(0.5, 1.0))
    found = jb.circle_map(osc, limit=1)
    assert np.sum(np.isnan(found.elapsed)) == np.sum(~found.is_onset) == 200
    (motion,) = found.motions
    assert float(found.multipliers[0]) == pytest.approx(0.87097261, abs=1e-7)
    run = jb.simulate(osc, motion.start, float(motion.period))
    np.testing.assert_allclose(run.ys[-1], motion.start, atol=1e-8)
