"""Cycles and their functionals against the oracle, published numbers and balances.

Tolerances: the fixed steps of shooting are good to about 1e-12 per arc, the oracle to 1e-12 per
loop; 1e-10 leaves room for the amplification by an unstable multiplier of 20.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest
from laws import peak
from scipy.integrate import solve_ivp

import jaxbelt as jb
from jaxbelt import EventKind, Status
from jaxbelt.cycles.attractors import idle_belts, itinerary
from jaxbelt.cycles.chains import cut
from jaxbelt.cycles.cycle import FINE_STEPS, as_loop, polish
from jaxbelt.motion.arcs import Ends
from jaxbelt.numerics.compiling import GROUP

START = (3.0, 0.0)
EXTREMA = ("x1_min", "x1_max", "x2_min", "x2_max")


@pytest.mark.parametrize("nu", [0.45, 0.535, 0.3, 0.05, -0.05, -0.3, -0.5])
def test_sticking_cycle_is_that_of_the_oracle(nu):
    cycle = jb.find_cycle(jb.presets.class_b(nu, 0.35), START)
    expected = oracle_cycles.sticking_cycle(oracle.class_b(nu, 0.35))
    assert cycle.status == Status.OK and cycle.stable
    assert tuple((kind.name, belt) for kind, belt in cycle.signature) == expected.signature
    # An error in x1 where a stick phase begins is one of 1/nu as much in its duration.
    exact = dict(rel=0, abs=1e-11 * (1 + 1 / abs(nu)))
    assert cycle.period == pytest.approx(expected.period, **exact)
    assert cycle.stick_durations == pytest.approx(expected.stick_durations, **exact)
    for name in EXTREMA:
        assert getattr(cycle, name) == pytest.approx(getattr(expected, name), abs=1e-10)
    assert cycle.multiplier == 0
    assert cycle.residual < 1e-12 and cycle.iterations <= 3


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [
        ("c", (0.08584, -0.21376, 0.01373)),  # stuck from edge to edge
        ("c", (-0.11454, -0.36178, -0.72774)),
        ("d", (0.05247, 0.52188, -0.99201, 1.448)),
        ("d", (0.08584, -0.21376, 0.01373, 0.7829)),  # belts that change while the mass is stuck
        ("d", (0.309, -0.003, 0.588, 1.357)),
    ],
)
def test_cycle_that_passes_contact_edges_is_that_of_the_oracle(kind, parameters):
    cycle = jb.find_cycle(getattr(jb.presets, f"class_{kind}")(*parameters), START)
    expected = oracle_cycles.sticking_cycle(getattr(oracle, f"class_{kind}")(*parameters))
    assert cycle.status == Status.OK and cycle.multiplier == 0
    # The two begin their loop at different ends of a stick phase.
    events = tuple((event.name, belt) for event, belt in cycle.signature)
    assert ("EDGE", 0) in events or ("EDGE", 1) in events
    assert expected.signature in {events[i:] + events[:i] for i in range(len(events))}
    # An error in x1 where a stick phase begins is one of 1/nu as much in its duration.
    exact = dict(rel=0, abs=1e-11 * (1 + 1 / np.min(np.abs(parameters[:2]))))
    assert cycle.period == pytest.approx(expected.period, **exact)
    assert cycle.stick_durations == pytest.approx(expected.stick_durations, **exact)
    for name in EXTREMA:
        assert getattr(cycle, name) == pytest.approx(getattr(expected, name), abs=1e-10)


@pytest.mark.parametrize("load", [0.02, 0.0])
def test_cycle_that_crosses_a_belt_at_rest(load):
    # There x1 has its extrema on the boundary itself.
    law, mu = jb.Conti(1.0, 0.6, 10.0), oracle.conti(1.0, 0.6, 10.0)
    osc = jb.Oscillator(0.5, (jb.Belt(0.2, law), jb.Belt(0.0, law, load)))
    cycle = jb.find_cycle(osc, START)
    belts = oracle.Belt(0.2, *mu), oracle.Belt(0.0, *mu, load)
    expected = oracle_cycles.sticking_cycle(oracle.Oscillator(0.5, belts))
    assert cycle.status == Status.OK
    assert tuple((kind.name, belt) for kind, belt in cycle.signature) == expected.signature
    assert cycle.period == pytest.approx(expected.period, abs=1e-10)
    assert cycle.stick_durations == pytest.approx(expected.stick_durations, abs=1e-10)
    for name in EXTREMA:
        assert getattr(cycle, name) == pytest.approx(getattr(expected, name), abs=1e-10)


def _steep(name, scale):
    """A law that falls by a third within a scale of r = 0, for the package and for the oracle."""
    if name == "Peak":
        return peak(1.5, 1.0, scale, 0.28)
    if name == "Conti":
        return jb.Conti(1.5, 1.0, 1 / scale), oracle.conti(1.5, 1.0, 1 / scale)
    return jb.Stribeck(1.5, 1.0, scale), oracle.stribeck(1.5, 1.0, scale)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("name", "nu", "scale"),
    [
        # Orbits whose last step before the boundary went past the layer of the law there.
        *(("Peak", nu, 0.0042) for nu in (0.2256, 0.2362, 0.2602, 0.2606)),
        ("Peak", 0.2602, 0.0014),
        ("Conti", 0.2, 2e-3),
        ("Stribeck", 0.2, 2e-3),
    ],
)
def test_cycle_of_a_law_with_a_narrow_layer(name, nu, scale):
    law, mu = _steep(name, scale)
    cycle = jb.find_cycle(jb.Oscillator(0.0, (jb.Belt(nu, law),)), (1.4, nu))
    own = oracle.Oscillator(0.0, (oracle.Belt(nu, *mu),))
    expected = oracle_cycles.sticking_cycle(own, (1.4, nu), max_step=0.02)
    assert cycle.status == Status.OK
    assert tuple((kind.name, belt) for kind, belt in cycle.signature) == expected.signature
    assert cycle.period == pytest.approx(expected.period, abs=1e-9)
    assert cycle.stick_durations == pytest.approx(expected.stick_durations, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("damping", "nu", "load"), [(5.0, 0.1, 12.0), (8.0, 0.05, 20.0)])
def test_relaxation_cycle_of_a_strongly_damped_oscillator(damping, nu, load):
    """Its arcs creep: they take more integration steps than others."""
    osc = jb.Oscillator(damping, (jb.Belt(nu, jb.Conti(1.0, 0.5, 10.0), load),))
    cycle = jb.find_cycle(osc, (0.0, 0.0))
    belt = oracle.Belt(nu, *oracle.conti(1.0, 0.5, 10.0), load)
    expected = oracle_cycles.sticking_cycle(oracle.Oscillator(damping, (belt,)))
    assert cycle.status == Status.OK
    assert cycle.period == pytest.approx(expected.period, abs=1e-9 / nu)
    assert cycle.stick_durations == pytest.approx(expected.stick_durations, abs=1e-9 / nu)
    for name in EXTREMA:
        assert getattr(cycle, name) == pytest.approx(getattr(expected, name), abs=1e-9)


@pytest.mark.parametrize(
    ("name", "velocities"),
    [
        ("class_b", (0.3, 0.35)),
        ("class_b", (0.5387, 0.35)),
        ("class_b", (-0.3, 0.35)),
        *(
            pytest.param(name, velocities, marks=pytest.mark.slow(first=True))
            for name, velocities in (
                *(("class_b", (nu, 0.35)) for nu in (0.28, 0.45, 0.53, -0.55)),
                *(("class_a", (nu,)) for nu in (0.184, 0.22, 0.265)),
            )
        ),
    ],
)
def test_unstable_cycle_is_that_of_the_oracle(name, velocities):
    cycle = jb.unstable_cycle(getattr(jb.presets, name)(*velocities))
    expected = oracle_cycles.unstable_cycle(getattr(oracle, name)(*velocities))
    assert cycle.status == Status.OK and not cycle.stable and cycle.signature == ()
    assert cycle.period == pytest.approx(expected.period, abs=1e-9)
    assert cycle.multiplier == pytest.approx(expected.multiplier, rel=1e-8)
    for extremum in EXTREMA:
        assert getattr(cycle, extremum) == pytest.approx(getattr(expected, extremum), abs=1e-9)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("nu", [0.2, 0.6])
def test_there_is_no_unstable_cycle_outside_of_hopf_point_and_fold(nu):
    cycle = jb.unstable_cycle(jb.presets.class_b(nu, 0.35))
    assert cycle.status == Status.NO_UNSTABLE_CYCLE and jnp.isnan(cycle.period)


@pytest.mark.slow(first=True)
def test_no_cycle_crosses_where_the_mass_would_stick():
    """Crossing-sliding is at a damping of -0.595658067405: above it the cycle of class (a) sticks,
    and what solves the equations of the one that crosses is no motion of the oscillator."""
    belts = jb.presets.class_a(0.3).belts
    cycle = jb.find_cycle(jb.Oscillator(-0.5957, belts), (1.0, 0.0))
    assert cycle.signature == ((EventKind.CROSS, 0),) * 2
    loop = cut([as_loop(cycle, 32)])[0]
    below, above = (
        polish(jb.Oscillator(damping, belts), loop, jnp.asarray(Status.OK.value))
        for damping in (-0.59567, -0.59564)
    )
    assert below.status == Status.OK and above.status == Status.NOT_ADMISSIBLE
    sticks = jb.find_cycle(jb.Oscillator(-0.59564, belts), (1.0, 0.0))
    assert sticks.status == Status.OK and jb.stick_duration(sticks, 0) > 0


@pytest.mark.slow(first=True)
def test_no_arc_of_a_cycle_passes_an_extremum_of_x1():
    """What solves the equations of a chain that does not mark it would tell a wrong amplitude."""
    osc = jb.Oscillator(0.5, (jb.Belt(0.4, jb.Conti(1.0, 0.25, 10.0), upper=0.9),))
    cycle = jb.find_cycle(osc, (0.9, 0.4))
    loop = as_loop(cycle, 16)
    marked = np.flatnonzero(loop.ends == Ends(1).extremum_x1)
    assert cycle.status == Status.OK and marked.size == 2
    for row in marked:
        merged = replace(
            loop,
            ends=loop.ends.at[row].set(loop.ends[row + 1]),
            durations=loop.durations.at[row].add(loop.durations[row + 1]),
        )
        rows = np.append(np.delete(np.arange(16), row + 1), 15)  # the last one is not used
        merged = jax.tree.map(lambda leaf, rows=rows: leaf[rows], merged)
        found = polish(osc, merged, jnp.asarray(Status.OK.value), FINE_STEPS)
        assert found.status == Status.NOT_ADMISSIBLE


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_start_that_sticks_to_a_belt_at_rest_stays_there(sign):
    # It sticks where x1 is smallest, and there is no way from there to a largest one.
    law = jb.Conti(1.2, 0.6, 5.0)
    osc = jb.Oscillator(0.1, (jb.Belt(sign * 0.3, law, 0.5), jb.Belt(0.0, law, 0.5)))
    assert jb.find_cycle(osc, (sign * 0.57, sign * 1.2)).status == Status.STUCK_FOREVER


@pytest.mark.slow(first=True)
def test_where_there_is_no_cycle_every_number_is_nan():
    held = jb.find_cycle(jb.presets.class_a(0.0), (3.0, 0.0))
    assert held.status == Status.STUCK_FOREVER
    durations = jb.stick_duration(held), jb.slip_duration(held), jb.slip_duration(held, 0)
    assert np.all(np.isnan([*held.stick_durations, *durations]))


def beside_a_slow_belt(nu):
    """Period, stick duration and x1_min of class (a), by SciPy, in the displacement from slip onset
    and the relative velocity, with mu(r) - mu(0) in closed form: nothing cancels, however small nu
    is, and tolerances are relative."""

    def field(t, y):
        u, r = y
        return [nu - r, u - 0.5 * r + 4.0 * r / (1 + 10.0 * r)]

    def arrives(t, y):
        return y[1]

    def turns(t, y):
        return y[1] - nu

    arrives.terminal, arrives.direction = True, -1
    options = dict(method="DOP853", rtol=1e-13, atol=1e-13 * nu, first_step=1e-6)
    run = solve_ivp(field, (0.0, 100.0), (0.0, 0.0), events=(arrives, turns), **options)
    stick = -run.y_events[0][0, 0] / nu
    lowest = np.min(run.y_events[1][:, 0])
    return np.array([run.t_events[0][0] + stick, stick, 1 - 0.5 * nu + lowest])


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("nu", [1e-2, 1e-5, 1e-8, 1e-11, 1e-14])
def test_cycles_beside_belts_that_hardly_move(nu):
    """Slip begins within nu of a fixed point that repels: an arc from there magnifies by 1 / nu."""
    cycle = jb.find_cycle(jb.presets.class_a(nu), START)
    told = [cycle.period, cycle.stick_durations[0], cycle.x1_min]
    # What the arcs are good to: 1e-12 each.
    assert told == pytest.approx(beside_a_slow_belt(nu), rel=5e-12)
    assert cycle.residual < 1e-12 and cycle.multiplier == 0


@pytest.mark.slow
def test_derivatives_beside_a_belt_that_hardly_moves():
    """Against differences of order four in log(nu): 1e-9 is their error with steps of 1e-2."""

    def told(nu):
        cycle = jb.find_cycle(jb.presets.class_a(nu), START)
        return jnp.stack([cycle.period, cycle.stick_durations[0]])

    def expected(shift):
        return beside_a_slow_belt(1e-8 * np.exp(shift))[:2]

    near, far = (expected(h) - expected(-h) for h in (1e-2, 2e-2))
    for slopes in both_ways(told, 1e-8):
        np.testing.assert_allclose(1e-8 * slopes, (8 * near - far) / 0.12, rtol=1e-9)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("nu", [2.8e-17, 1e-14, 1e-12])
def test_a_belt_that_creeps_brings_the_mass_to_no_rest(nu):
    """Slip begins at a fixed point that repels, up to rounding: for any nu > 0 there is a cycle."""
    cycle = jb.find_cycle(jb.presets.class_a(nu), (3.0, 0.0))
    assert cycle.status == (Status.OK if nu > 1e-16 else Status.NOT_SETTLED)
    axes, long = {"nu0": [nu]}, 1e19  # a sweep ends long before, if it cannot tell
    run = jb.decoded(jb.sweep(jb.presets.class_a, axes, observe="attractor", t1=long)).squeeze()
    assert run.kind in ("cycle", "undecided") and (run.kind == "cycle") == (run.status == "ok")


FLAT = jb.Coulomb(static=0.5, kinetic=0.5)
CENTRES = {
    "one belt": lambda nu: jb.Oscillator(0.0, (jb.Belt(nu, FLAT),)),
    "opposite belts": lambda nu: jb.Oscillator(0.0, (jb.Belt(nu, FLAT), jb.Belt(-nu, FLAT))),
    # Halves of two circles.
    "an edge": lambda nu: jb.Oscillator(
        0.0, (jb.Belt(nu, FLAT, upper=0.25), jb.Belt(-nu, FLAT, lower=0.25))
    ),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("one belt", marks=pytest.mark.slow(first=True)),
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("opposite belts", "an edge")),
    ],
)
def test_circles_around_a_centre_are_no_cycle(name):
    """Friction is constant below the speed of the belts, and nothing damps: every orbit with
    |x2| < nu closes, and outer ones stick until they are on the largest of these."""
    make = CENTRES[name]
    starts = (0.75, 0.0), (0.25, 0.5), (0.5, 1.0), (3.0, 0.0)
    for start in starts:
        cycle = jb.find_cycle(make(1.0), start)
        assert cycle.status == Status.NEUTRAL and jnp.isnan(cycle.period), start
    told = jb.basins(make(1.0), x1=[0.4, 0.75, 3.0], x2=[0.1, 0.5])
    assert np.all(np.asarray(told.label) < 0) and not told.attractors
    run = jb.decoded(jb.sweep(make, {"nu": [1.0]}, y0=(0.75, 0.0), observe="attractor"))
    assert run.kind == "undecided" and run.status == "neutral" and np.isnan(run.period)


@pytest.mark.slow(first=True)
def test_beside_circles_a_cycle_that_sticks_is_one():
    """Static friction beyond the kinetic one: it sticks from x1 = 0.2 to 0.8, on a circle around
    0.5 of radius sqrt(1.09), and then slips along the rest of it."""
    law = jb.Coulomb(static=0.8, kinetic=0.5)
    osc = jb.Oscillator(0.0, (jb.Belt(1.0, law),))
    cycle = jb.find_cycle(osc, START)
    slip = 2 * np.pi - 2 * np.arctan2(0.3, 1.0)
    assert cycle.period == pytest.approx(0.6 + slip, abs=1e-12)
    assert jb.find_cycle(osc, (1.0, 0.0)).status == Status.NEUTRAL


def test_a_start_that_comes_to_rest_leads_to_no_cycle():
    cycle = jb.find_cycle(jb.presets.class_b(0.6, 0.35), START)
    assert cycle.status == Status.EQUILIBRIUM and jnp.isnan(cycle.period)
    assert "equilibrium" in repr(cycle)


@pytest.mark.parametrize(
    ("steepness", "period", "stick"), [(3.0, 12.0010313, 7.7050318), (1.0, 9.2307705, None)]
)
def test_published_stick_slip_cycles(steepness, period, stick):
    """R. I. Leine and others' block on a belt, and the same with another steepness; as printed."""
    friction = jb.Conti(static=1.0, residual=0.0, steepness=steepness)
    cycle = jb.find_cycle(jb.Oscillator(0.0, (jb.Belt(0.2, friction),)), START)
    assert cycle.period == pytest.approx(period, abs=6e-8)
    if stick is not None:
        assert jb.stick_duration(cycle, 0) == pytest.approx(stick, abs=6e-8)
        assert jb.slip_duration(cycle, 0) == pytest.approx(4.2959995, abs=6e-8)


@pytest.fixture(scope="module")
def cycle():
    return jb.find_cycle(jb.presets.class_b(-0.3, 0.35), START)


def test_functionals(cycle):
    assert jb.period(cycle) == cycle.period
    sticks = jb.stick_duration(cycle, 0) + jb.stick_duration(cycle, 1)
    assert jb.stick_duration(cycle) == pytest.approx(float(sticks), rel=1e-15)
    assert jb.slip_duration(cycle) + sticks == pytest.approx(float(cycle.period), rel=1e-15)
    assert jb.stick_fraction(cycle) == pytest.approx(float(sticks / cycle.period), rel=1e-15)
    assert jb.amplitude(cycle) == pytest.approx(float(cycle.x1_max - cycle.x1_min) / 2, rel=1e-15)
    assert jb.peak(cycle, "x2") == pytest.approx(0.35, abs=1e-12)
    assert jb.gap(cycle, 0) == pytest.approx(0, abs=1e-12)
    # What the drives put in is what becomes heat; both are integrals of their own.
    assert jb.energy_fed(cycle) == pytest.approx(float(jb.energy_dissipated(cycle)), abs=1e-12)
    beyond = jb.find_cycle(jb.presets.class_b(-0.51, 0.35), START)  # sticks to belt 1 only
    there = oracle_cycles.sticking_cycle(oracle.class_b(-0.51, 0.35))
    assert jb.gap(beyond, 0) == pytest.approx(there.x2_min + 0.51, abs=1e-10)
    with pytest.raises(ValueError, match=r"belt must be 0 to 1, got 2"):
        jb.stick_duration(cycle, 2)


def test_samples_lie_on_the_orbit(cycle):
    run = oracle.simulate(oracle.class_b(-0.3, 0.35), cycle.arcs.y[0].tolist(), 6.9)
    ts = np.linspace(0.0, 1.0, 12) * float(cycle.period)
    expected = [run.at(float(t)) for t in ts[1:-1]]
    samples = np.asarray(cycle.sample(12))
    assert samples[1:-1] == pytest.approx(np.array(expected), abs=1e-10)
    assert samples[-1] == pytest.approx(samples[0], abs=1e-12)


def test_signature_begins_after_the_longest_stick_phase(cycle):
    stick, slip = EventKind.STICK, EventKind.SLIP
    assert cycle.signature == ((stick, 1), (slip, 1), (stick, 0), (slip, 0))


@pytest.mark.slow
def test_derivatives_with_two_belts():
    """Against Richardson differences of the oracle; 1e-8 relative is what those are good to."""

    def functionals(nu):
        cycle = jb.find_cycle(jb.presets.class_b(nu, 0.35), START)  # sticks to belt 1 only
        durations = jb.stick_duration(cycle, belt=1), cycle.period
        return jnp.stack([*durations, jb.amplitude(cycle), jb.gap(cycle, 0)])

    def expected(nu):
        cycle = oracle_cycles.sticking_cycle(oracle.class_b(nu, 0.35))
        amplitude = (cycle.x1_max - cycle.x1_min) / 2
        return [cycle.stick_durations[1], cycle.period, amplitude, cycle.x2_min - nu]

    slopes, _ = oracle.richardson(expected, -0.51, 8e-3, levels=4)
    forward, reverse = both_ways(functionals, -0.51)
    assert forward == pytest.approx(slopes, rel=1e-8)
    assert reverse == pytest.approx(slopes, rel=1e-8)


def both_ways(function, x):
    """Its derivatives in forward and in reverse mode, by one program."""
    return jax.jit(lambda x: (jax.jacfwd(function)(x), jax.jacrev(function)(x)))(x)


@pytest.mark.slow(first=True)
def test_derivatives_of_functionals():
    """Forward and reverse, against Richardson differences of the oracle, 1e-8 relative."""

    def functionals(nu):
        cycle = jb.find_cycle(jb.presets.class_a(nu), START)
        return jnp.stack(
            [
                jb.period(cycle),
                jb.stick_duration(cycle, 0),
                jb.slip_duration(cycle, 0),
                jb.stick_fraction(cycle),
                jb.amplitude(cycle),
                jb.amplitude(cycle, "x2"),
                jb.peak(cycle),
                jb.peak(cycle, "x2"),
                jb.energy_fed(cycle),
                jb.energy_dissipated(cycle),
            ]
        )

    def expected(nu):
        cycle = oracle_cycles.sticking_cycle(oracle.class_a(nu))
        stick = cycle.stick_durations[0]
        # One belt: the work of its drive is nu times the mean friction, which is the spring's.
        fed = nu * oracle_cycles.integral_of_x1(cycle.run)
        return [
            cycle.period,
            stick,
            cycle.period - stick,
            stick / cycle.period,
            (cycle.x1_max - cycle.x1_min) / 2,
            (cycle.x2_max - cycle.x2_min) / 2,
            max(cycle.x1_max, -cycle.x1_min),
            max(cycle.x2_max, -cycle.x2_min),
            fed,
            fed,
        ]

    nu = 0.24
    assert functionals(nu) == pytest.approx(expected(nu), abs=1e-10)
    slopes, _ = oracle.richardson(expected, nu, 8e-3, levels=4)
    forward, reverse = both_ways(functionals, nu)
    assert forward == pytest.approx(slopes, rel=1e-8)
    assert reverse == pytest.approx(slopes, rel=1e-8)


@pytest.mark.slow(first=True)
def test_square_root_law_near_the_hopf_point():
    """The amplitude r of the unstable cycle: r^2 -> -(trace/2)/a with the Lyapunov coefficient a.

    The next term of r^2 is relatively of the order of the distance, so two distances give the
    limit by extrapolation, up to the square of the distance.
    """
    hopf = (np.sqrt(8) - 1) / 10
    a = jb.lyapunov_coefficient(jb.presets.class_a(hopf))[0]

    def ratio(distance):
        osc = jb.presets.class_a(hopf + distance)
        trace = jnp.trace(jb.equilibria(osc).jacobian[0])
        return jb.amplitude(jb.unstable_cycle(osc)) ** 2 / (-(trace / 2) / a)

    near, far = ratio(1e-4), ratio(2e-4)
    assert near == pytest.approx(1, abs=0.02) and abs(near - 1) < 0.6 * abs(far - 1)
    assert 2 * near - far == pytest.approx(1, abs=2e-4)


@pytest.mark.slow(first=True)
def test_a_batch_of_cycles_is_each_of_them():
    """Of more than a group, some of which have no cycle, or need shorter steps; derivatives too."""

    def of(nu):
        cycle = jb.find_cycle(jb.presets.class_b(nu, 0.35), START)
        numbers = jnp.stack([cycle.period, cycle.stick_durations[0], cycle.multiplier])
        return numbers, (numbers, cycle.status)

    nus = jnp.linspace(-0.35, 0.65, GROUP.here + 37)
    slopes, (numbers, status) = jax.jit(jax.vmap(jax.jacrev(of, has_aux=True)))(nus)
    assert set(status.tolist()) > {Status.OK.value, Status.EQUILIBRIUM.value}
    alone = jax.jit(jax.jacfwd(of, has_aux=True))
    for i in range(0, len(nus), 7):
        nu = nus[i]
        one_slopes, (one_numbers, one_status) = alone(nu)
        assert status[i] == one_status
        np.testing.assert_allclose(numbers[i], one_numbers, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(slopes[i], one_slopes, rtol=1e-8, atol=1e-9)
        found = jb.find_cycle(jb.presets.class_b(float(nu), 0.35), START)
        assert status[i] == found.status
        np.testing.assert_allclose(numbers[i, 0], found.period, rtol=1e-11)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("offset", [-1e-7, -1e-9, 1e-9, 1e-7])
def test_an_orbit_that_all_but_touches_an_edge(offset):
    """Where it does it is pushed over it and comes to rest; the cycle touches it at this load."""
    law = jb.Coulomb(1.0, 0.5)
    belts = (jb.Belt(0.2, law, 1.0392850493425 + offset, lower=0.7, upper=1.45), jb.Belt(0.85, law))
    cycle = jb.find_cycle(jb.Oscillator(0.25, belts), (1.45, 0.2))
    assert cycle.status == (Status.OK if offset > 0 else Status.EQUILIBRIUM)


@pytest.mark.slow(first=True)
def test_a_cycle_beside_circles_that_hardly_sticks():
    """The static limit is above kinetic friction by so little that it sticks for 1e-4 of its
    period, by a distance of twice the excess; the rest is an arc of a circle."""
    excess, nu = 1e-4, 0.3
    osc = jb.Oscillator(0.0, (jb.Belt(nu, jb.Coulomb(0.5 + excess, 0.5)),))
    cycle = jb.find_cycle(osc, (1.5, 0.0))
    assert cycle.status == Status.OK
    slips = 2 * np.pi - 2 * np.arctan2(excess, nu)
    assert cycle.stick_durations[0] == pytest.approx(2 * excess / nu, rel=1e-9)
    assert cycle.period == pytest.approx(2 * excess / nu + slips, rel=1e-12)


def assert_repels(cycle, osc):
    """SciPy's orbits from 1e-9 beside its top leave it to either side."""
    assert cycle.status == Status.OK

    def next_top(x1):
        run = oracle_cycles.one_loop(osc, x1)
        return np.inf if run is None else run.stopped_by.x1  # None: it touches a boundary, outside

    inside, outside = float(cycle.x1_max) - 1e-9, float(cycle.x1_max) + 1e-9
    assert next_top(inside) < inside and next_top(outside) > outside


@pytest.mark.slow(first=True)
def test_unstable_cycles_that_repel_strongly_are_found():
    """At a belt's load just above a nonsmooth fold, multipliers of ten thousand; they were found
    only where they are below a thousand."""
    law, (mu, static) = jb.Conti(1.0, 0.6, 10.0), oracle.conti(1.0, 0.6, 10.0)
    for load in (1.031, 1.05):
        osc = jb.Oscillator(0.5, (jb.Belt(0.7, law, load), jb.Belt(0.7, law, 0.5)), 2.0)
        belts = tuple(oracle.Belt(0.7, mu, static, one) for one in (load, 0.5))
        cycle = jb.unstable_cycle(osc)
        assert cycle.multiplier > 1e4
        assert_repels(cycle, oracle.Oscillator(0.5, belts, 2.0))
        (known,) = jb.portrait(osc).unstable
        np.testing.assert_allclose(cycle.x1_max, known.x1_max, rtol=1e-10)


@pytest.mark.slow(first=True)
def test_an_unstable_cycle_close_inside_one_that_attracts_is_found_from_either_side():
    """A way of 0.003 between the two: starts passed over it, but not in the mirror image."""
    laws = (0.9624, 0.593, 5.52, 0.0065), (0.9576, 0.5185, 11.126, 0.0058)
    sides = [(0.235, 0.4425, -0.2768, np.inf), (-0.4105, 0.5268, -np.inf, 0.2214)]
    images = [(-v, load, -upper, -lower) for v, load, lower, upper in sides]
    found = []
    for belts in (sides, images):
        pairs = list(zip(belts, laws, strict=True))
        ours = tuple(jb.Belt(v, jb.Conti(*law), *more) for (v, *more), law in pairs)
        theirs = tuple(oracle.Belt(v, *oracle.conti(*law), *more) for (v, *more), law in pairs)
        found.append(jb.unstable_cycle(jb.Oscillator(0.4664, ours, 1.4555), around=1))
        assert_repels(found[-1], oracle.Oscillator(0.4664, theirs, 1.4555))
    assert all(cycle.status == Status.OK and cycle.multiplier > 1 for cycle in found)
    np.testing.assert_allclose(found[0].x1_min, -found[1].x1_max, rtol=1e-10)
    np.testing.assert_allclose(found[0].period, found[1].period, rtol=1e-10)


def test_a_stick_phase_that_ends_on_an_edge_and_by_slip_onset():
    """Which comes first is rounding, and no mode of a cycle: it repeats at the same values."""
    law = jb.Conti(1.0, 0.6, 10.0)

    def make(residual):
        other = jb.Conti(1.0, residual, 10.0)
        belts = jb.Belt(-0.6, law, 1.5, lower=-1.47, upper=0.15), jb.Belt(-0.6, other, 1.5)
        return jb.Oscillator(0.05, belts)

    for residual in (0.553149166667, 0.6):
        cycle = jb.find_cycle(make(residual), (-1.0, 0.0))
        assert itinerary(idle_belts(cycle.oscillator), cycle) == ((-2, -1), (-1, -1), (0, 0))
