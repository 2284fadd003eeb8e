"""Forced oscillators: the model, `simulate` and its derivatives.

Runs share few programs: one belt with Coulomb's or the cubic law and one force are compiled once.
"""

import warnings
from dataclasses import replace
from functools import partial
from math import atan, cos, inf, pi, sin, sqrt, tan

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scipy.integrate import solve_ivp

import jaxbelt as jb
from jaxbelt.model.oscillator import at_time, constant_force, has_clock
from tests.campaign import forced, forced_cases, forced_package

#: The engine's runs and ours agree to this where nothing grows: 1e-10 a step, over some 10 steps.
CLOSE = 1e-8


def forced_one(**changes):
    """One belt, Coulomb's law, one harmonic force: the program that most tests run."""
    fields = dict(velocity=0.3, law=jb.Coulomb(1.0, 0.8), load=0.7, damping=0.1, omega=1.0)
    fields |= dict(forcing=jb.Harmonic(0.9, 1.3, 0.4)) | changes
    belt = jb.Belt(fields["velocity"], fields["law"], fields["load"])
    return jb.Oscillator(fields["damping"], (belt,), fields["omega"], forcing=fields["forcing"])


def end_of(osc, y0=(1.0, 0.2), t1=25.0, t0=0.0):
    """The last sample of a run, and its events without times."""
    run = jb.simulate(osc, y0, t1, t0=t0, ts=[t1])
    assert run.status == jb.Status.OK
    kinds = np.asarray(run.events.kind).tolist(), np.asarray(run.events.belt).tolist()
    return np.asarray(run.ys[-1]), np.asarray(run.events.t), kinds


def assert_same(one, other, within=CLOSE, later=0.0):
    (y, t, kinds), (y_other, t_other, kinds_other) = one, other
    assert kinds == kinds_other
    assert len(t) > 1
    np.testing.assert_allclose(t + later, t_other, atol=within)
    np.testing.assert_allclose(y, y_other, atol=within)


# --- the model ------------------------------------------------------------------------------------


def test_text_of_a_forced_oscillator_makes_it_again():
    osc = jb.Oscillator(
        0.1,
        (jb.Belt(jb.Oscillating(0.2, 0.1, 1.2), jb.Cubic(1.5, 1.5, 0.45), load=2.0),),
        forcing=(jb.Harmonic(0.5, 1.2, 0.3), jb.BaseMotion(0.25, 2.0), jb.Harmonic(0.5, 0.0)),
    )
    names = {name: getattr(jb, name) for name in jb.__all__} | {"inf": inf}
    again = eval(repr(osc), {}, names)
    assert jax.tree.structure(again) == jax.tree.structure(osc)
    assert jax.tree.leaves(again) == jax.tree.leaves(osc)
    assert "forcing" not in repr(jb.presets.class_a(0.3))


@pytest.mark.slow(first=True)
def test_a_frequency_of_zero_is_a_constant_force_without_a_clock():
    push = 0.5 * cos(0.3)
    law = jb.Conti(1.0, 0.6, 10.0)  # that of class (a), for one program without forcing
    velocity = jb.Oscillating(0.2, 0.1, 0, 0.0)
    osc = forced_one(law=law, forcing=jb.Harmonic(0.5, 0.0, 0.3), velocity=velocity)
    assert not has_clock(osc)
    assert float(osc.belts[0].velocity) == pytest.approx(0.3, abs=1e-15)
    still = forced_one(law=law, forcing=())
    rest, rest_still = jb.equilibria(osc), jb.equilibria(still)
    np.testing.assert_allclose(rest.x1, rest_still.x1 + push, atol=1e-15)
    cycle, cycle_still = jb.find_cycle(osc, (1.0, 0.0)), jb.find_cycle(still, (1.0 - push, 0.0))
    assert cycle.signature == cycle_still.signature
    np.testing.assert_allclose(cycle.period, cycle_still.period, atol=1e-11)
    np.testing.assert_allclose(cycle.x1_max, cycle_still.x1_max + push, atol=1e-11)
    assert has_clock(forced_one())


@pytest.mark.parametrize("phase", [0.0, 0.3, np.pi])
def test_constant_forces_of_machines(phase):
    """A support moved by x and kept there pushes with the stiffness times x; both keep what the
    user has said of them."""
    push = 500.0 * 0.01 * cos(phase)
    belt = jb.PhysicalBelt(0.2, jb.Coulomb(0.6, 0.4), 10.0)
    for force in (jb.Harmonic(5.0, 0.0, phase), jb.BaseMotion(0.01, 0.0, phase)):
        machine = jb.Machine(2.0, 500.0, 0.5, (belt,), force)
        (found,) = constant_force(machine.oscillator)
        assert float(found * machine.units.force) == pytest.approx(push, rel=1e-14)
        (kept,) = machine.forcing
        assert float(kept.amplitude) == float(force.amplitude)
        assert repr(kept).startswith(f"{type(force).__name__}(amplitude=")
        assert ("phase" in repr(kept)) == bool(phase)


@pytest.mark.parametrize("by_leaf", [True, False])
def test_a_span_begins_where_a_force_is_constant(by_leaf):
    osc, where = forced_one(), lambda osc: osc.forcing[0].frequency
    given = (osc, where) if by_leaf else (lambda w: forced_one(forcing=jb.Harmonic(0.5, w)), None)
    for ask in (jb.bifurcation_diagram, jb.orbit_diagram):
        with pytest.raises(
            ValueError, match=r"^span must be without the frequency 0.*\(0.0, 1.0\)"
        ):
            ask(*given, (0.0, 1.0))


@pytest.mark.slow(first=True)
def test_a_constant_force_in_a_sweep_is_the_origin_moved():
    def make(push):
        return forced_one(law=jb.Conti(1.0, 0.6, 10.0), forcing=jb.Harmonic(push, 0.0))

    pushes = np.array([0.0, 0.5, -0.25])
    moved = jb.sweep(make, {"push": pushes}, y0=(1.0, 0.0), t1=20.0, progress=False)
    for push, x1 in zip(pushes, moved.x1_end.values, strict=True):
        run = jb.simulate(make(0.0), (1.0 - push, 0.0), 20.0, ts=[20.0])
        # The sweep's own tolerance is 1e-8 a step.
        assert float(run.ys[-1, 0]) + push == pytest.approx(x1, abs=1e-6)


@pytest.mark.slow
def test_derivatives_of_sweeps_with_constant_forces():
    """Of their amplitudes and phases, of both, and of another number beside a phase."""
    law = jb.Conti(1.0, 0.6, 10.0)

    def make(push, phase, damping):
        forces = jb.Harmonic(push, 0.0, phase), jb.BaseMotion(0.1 * push, 0.0, 0.3)
        return jb.Oscillator(damping, (jb.Belt(0.3, law, 0.7),), forcing=forces)

    at = dict(push=0.3, phase=0.4, damping=0.1)
    axes = {name: [value] for name, value in at.items()}
    swept = jb.sweep(make, axes, y0=(0.5, -0.3), t1=4.0, derivatives=tuple(at), rtol=1e-11)
    exact = jax.jacfwd(
        lambda numbers: jb.simulate(make(*numbers), (0.5, -0.3), 4.0, ts=[4.0]).ys[-1]
    )(jnp.array(list(at.values())))
    found = [
        [swept[f"d_{x}_end_d_{name}"].item() for name in at] for x in ("x1", "x2")
    ]  # fmt: skip
    assert np.allclose(found, exact, rtol=0, atol=1e-7) and np.all(np.abs(exact[0]) > 1e-3)


def test_at_an_instant_it_is_an_oscillator_without_a_clock():
    belts = (
        jb.Belt(jb.Oscillating(0.2, 0.1, 1.2, 0.5), jb.Coulomb(1.0, 0.8)),
        jb.Belt(0.7, jb.Coulomb(1.0, 0.8), load=jb.Oscillating(1.0, 0.5, 0.7)),
    )
    forces = jb.Harmonic(0.5, 1.2), jb.BaseMotion(0.25, 2.0, 0.1), jb.Harmonic(0.125, 0.0)
    now = at_time(jb.Oscillator(0.3, belts, forcing=forces), jnp.asarray(0.6))
    assert not has_clock(now)
    base = sqrt(1 + (0.3 * 2.0) ** 2) * 0.25 * cos(2.0 * 0.6 + 0.1 + atan(0.3 * 2.0))
    push = 0.5 * cos(0.72) + base + 0.125
    assert float(now.forcing[0].amplitude) == pytest.approx(push, abs=1e-15)
    assert float(now.belts[0].velocity) == pytest.approx(0.2 + 0.1 * cos(1.22), abs=1e-15)
    assert float(now.belts[0].rate) == pytest.approx(-0.12 * sin(1.22), abs=1e-15)
    assert float(now.belts[1].load) == pytest.approx(1 + 0.5 * cos(0.42), abs=1e-15)


def test_a_machine_in_si_is_its_dimensionless_oscillator():
    belt = jb.PhysicalBelt(
        jb.Oscillating(0.1, 0.05, 3.0), jb.Coulomb(0.5, 0.4), jb.Oscillating(20.0, 5.0, 4.0)
    )
    forces = jb.Harmonic(5.0, 10.0, 0.2), jb.BaseMotion(0.01, 4.0)
    machine = jb.Machine(2.0, 50.0, 0.3, (belt,), forcing=forces)
    osc, length, time = machine.oscillator, 25.0 / 50.0, sqrt(2.0 / 50.0)
    one, base = osc.forcing
    assert float(one.amplitude) == pytest.approx(5.0 / 25.0)
    assert float(one.frequency) == pytest.approx(10.0 * time)
    assert float(base.amplitude) == pytest.approx(0.01 / length)
    assert float(osc.belts[0].velocity.amplitude) == pytest.approx(0.05 * time / length)
    assert float(osc.belts[0].load.frequency) == pytest.approx(4.0 * time)
    again = machine.of_oscillator(osc)
    leaves = zip(jax.tree.leaves(again), jax.tree.leaves(machine), strict=True)
    assert all(float(a) == pytest.approx(float(b)) for a, b in leaves)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jb.Harmonic(1.0, -1.0), "frequency of Harmonic must be >= 0, got -1.0"),
        (lambda: jb.Harmonic(np.nan, 1.0), "amplitude of Harmonic must be finite, got nan"),
        (lambda: jb.Harmonic("a", 1.0), "amplitude must be a number, got 'a'"),
        (lambda: forced_one(forcing=2.0), "forcing must be a force such as"),
        (lambda: forced_one(forcing=(2.0,)), r"forcing\[0\] must be a force such as"),
        (
            lambda: forced_one(load=jb.Oscillating(1.0, 1.5, 1.0)),
            r"mean of load of belt must be >=",
        ),
        (lambda: forced_one(velocity=jb.Harmonic(1.0, 1.0)), "velocity must be a number or jb.Osc"),
        (lambda: jb.Cubic(-1.0, 0.0, 0.0), "a0 of Cubic must be >= 0, got -1.0"),
        (lambda: forced_one(forcing=Silent()), "frequency of Silent must be a number"),
        (lambda: forced_one(forcing=Many(jnp.ones(()))), "force of Many must be a function that"),
    ],
)
def test_bad_forcing_is_told(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make()


class Silent(jb.AbstractForce):
    frequency: str = "fast"

    def force(self, t):
        return t


class Many(jb.AbstractForce):
    frequency: jax.Array

    def force(self, t):
        return jnp.stack([t, t])


@pytest.mark.parametrize(
    "call",
    [
        jb.equilibria,
        jb.portrait,
        jb.unstable_cycle,
        partial(jb.minimal_fatal_shock, y0=(1.0, 0.0)),
        partial(jb.scan, where=lambda o: o.damping, span=(0.1, 0.2)),
        partial(jb.refine, jb.Hopf(), where=lambda o: o.damping),
        jb.plot_vector_field,
    ],
)
def test_what_has_no_meaning_with_a_clock_refuses_one(call):
    takes_first = isinstance(call, partial) and call.func is jb.refine
    with pytest.raises(ValueError, match=r"must be without a clock: .* got one with forcing"):
        call(osc=forced_one()) if takes_first else call(forced_one())


# --- runs against the engine ----------------------------------------------------------------------


def engine_cases(number, count, structure):
    """Cases of one structure, half of them on round numbers."""
    rng = np.random.default_rng(number)
    shape = forced_cases.structures(np.random.default_rng(0), structure + 1)[structure]
    return [forced_cases.case(rng, shape) for _ in range(count)]


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("structure", "count"),
    [
        (0, 40),  # Coulomb, one force
        (1, 20),  # cubic, one force
        pytest.param(2, 20, marks=pytest.mark.slow),  # two belts with edges
        # Two belts with edges, a velocity that oscillates, two forces.
        pytest.param(3, 20, marks=pytest.mark.slow),
        pytest.param(6, 20, marks=pytest.mark.slow),  # three belts
        pytest.param(8, 20, marks=pytest.mark.slow),  # no force: velocity and load oscillate
    ],
)
def test_runs_are_those_of_the_engine(structure, count):
    batch = engine_cases(structure, count, structure)
    told = forced_package.simulated(batch, 1e-10)
    verdicts = forced_cases.judged(batch, told, 1e-10)
    wrong = [(v, c.to_json()) for (v, _), c in zip(verdicts, batch) if v not in forced_cases.GOOD]
    assert not wrong


@pytest.mark.parametrize("meeting", forced_cases.MEETINGS)
def test_a_stick_phase_ends_at_the_first_root_of_its_limits(meeting):
    """A double root touches and the phase goes on, a triple one passes."""
    rng = np.random.default_rng(5)
    for distance in (1e-3, 1e-6, 1e-9):
        for _ in range(4):
            case, onset = forced_cases.stick_case(rng, meeting, distance)
            (answer,) = forced_package.simulated([case], 1e-10)
            t, kind, *_ = answer.events[0]
            assert kind == jb.EventKind.SLIP
            # A triple root's time is known to (6e-16/(F Omega^3))^(1/3); a root that is a distance
            # d past a double one to 1e-16/sqrt(d), a touching one by no more than rounding.
            within = 3e-4 if meeting == "passes" else 1e-10 if distance > 1e-8 else 1e-9
            assert t == pytest.approx(onset, abs=within)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("early", [1e-9, 1e-8, 1e-7, 1e-6, 1e-4])
def test_an_edge_from_which_a_belt_carries_the_mass_and_back_is_met_at_once(early):
    """The way from the edge and back is rounding, early^2 / 8; the belt reverses `early` later."""
    belt = jb.Belt(jb.Oscillating(0.0, 0.25, 1.0), jb.Coulomb(2.0, 1.0), 1.0, lower=0.9)
    osc, t0 = jb.Oscillator(0.0, (belt,), forcing=jb.Harmonic(1e-3, 2.0)), pi / 2 - early
    run = jb.simulate(osc, (0.9, 0.25 * cos(t0)), t0 + 1.0, t0=t0)
    assert float(run.events.t[0]) - t0 == pytest.approx(2 * (pi / 2 - t0), abs=1e-14, rel=1e-6)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("speed", [1e-10, 1e-8, 1e-6])
def test_an_edge_from_which_a_mass_slips_and_back_is_met_at_once(speed):
    belt = jb.Belt(jb.Oscillating(0.5, 0.25, 1.0), jb.Coulomb(0.5, 0.5), 1.0, lower=0.9)
    osc = jb.Oscillator(0.0, (belt,), forcing=jb.Harmonic(1e-3, 2.0, pi / 2))
    run = jb.simulate(osc, (0.9, speed), 1.0)
    assert float(run.events.t[0]) == pytest.approx(2 * speed / 0.4, rel=1e-3 + 10 * speed)


def test_a_belt_at_rest_holds_for_ever_only_within_its_capacity():
    osc = forced_one(velocity=0.0, forcing=jb.Harmonic(0.5, 1.3))
    held = jb.simulate(osc, (0.15, 0.0), 50.0, ts=[50.0])
    assert held.status == jb.Status.STUCK_FOREVER
    np.testing.assert_array_equal(held.ys[-1], [0.15, 0.0])
    torn = jb.simulate(osc, (0.25, 0.0), 50.0, ts=[50.0])
    # It slips once, and then holds where it comes to rest.
    assert torn.status == jb.Status.STUCK_FOREVER
    assert abs(float(torn.ys[-1, 0])) < 0.2
    assert torn.events.kind[0] == jb.EventKind.SLIP
    # needed = -0.25 + 0.5 cos(1.3 t) first is -0.7.
    assert float(torn.events.t[0]) == pytest.approx(np.arccos(-0.9) / 1.3, abs=1e-11)


# --- closed forms ---------------------------------------------------------------------------------


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("frequency", [0.7, 1.4, 2.2])
def test_den_hartogs_motion_without_stops(frequency):
    """x = S - S cos t - S tan(beta/2) sin t + V cos(Omega t + phi) on the way down, with
    beta = pi/Omega, V = F/(1 - Omega^2) and sin phi = -S tan(beta/2)/(V Omega)."""
    S, F = 0.3, 1.0
    V, bend = F / (1 - frequency**2), tan(pi / frequency / 2)
    phase = np.arcsin(-S * bend / (V * frequency))
    phase = pi - phase if V < 0 else phase
    top = V * cos(phase)
    osc = forced_one(
        velocity=0.0,
        law=jb.Coulomb(1.0, 1.0),
        load=S,
        damping=0.0,
        forcing=jb.Harmonic(F, frequency, phase),
    )
    half = pi / frequency
    t = np.linspace(0, half, 9)[:-1]
    x = S - S * np.cos(t) - S * bend * np.sin(t) + V * np.cos(frequency * t + phase)
    run = jb.simulate(osc, (top, 0.0), 2 * half, ts=[*t, half, 2 * half - 1e-9, 2 * half])
    np.testing.assert_allclose(run.ys[:8, 0], x, atol=1e-10)
    np.testing.assert_allclose(run.ys[8], [-top, 0.0], atol=1e-10)
    np.testing.assert_allclose(run.ys[-1], [top, 0.0], atol=1e-10)


@pytest.mark.slow(first=True)
def test_csernaks_family_of_periodic_motions():
    """Omega = 1/2: a motion of period 4 pi for every A, closed in itself."""
    V, S, A = 1.0, 0.04, 0.05
    osc = forced_one(
        velocity=0.0,
        law=jb.Coulomb(1.0, 1.0),
        load=S,
        damping=0.0,
        forcing=jb.Harmonic(0.75 * V, 0.5),
    )
    top = S + V + A
    t = np.linspace(0, 4 * pi, 17)
    run = jb.simulate(osc, (top, 0.0), t[-1], ts=t)
    down = S + V * np.cos(t / 2) + A * np.cos(t)
    up = -S + V * np.cos(t / 2) + (A + 2 * S) * np.cos(t)
    np.testing.assert_allclose(run.ys[:, 0], np.where(t < 2 * pi, down, up), atol=1e-10)


# --- relations ------------------------------------------------------------------------------------


def test_a_period_later_everything_is_later():
    osc, period = forced_one(), 2 * pi / 1.3
    later = end_of(osc, t0=period, t1=25.0 + period)
    assert_same(end_of(osc), later, later=period)


def test_the_time_of_the_start_is_the_phase():
    later = end_of(forced_one(forcing=jb.Harmonic(0.9, 1.3, 0.0)), t0=0.4 / 1.3, t1=25 + 0.4 / 1.3)
    assert_same(end_of(forced_one()), later, later=0.4 / 1.3)


def test_reflected():
    mirrored = forced_one(velocity=-0.3, forcing=jb.Harmonic(-0.9, 1.3, 0.4))
    y, t, kinds = end_of(mirrored, (-1.0, -0.2))
    assert_same(end_of(forced_one()), (-y, t, kinds))


@pytest.mark.slow(first=True)
def test_a_moving_support_is_a_force():
    amplitude = 0.9 / sqrt(1 + (0.1 * 1.3) ** 2)
    base = jb.BaseMotion(amplitude, 1.3, 0.4 - atan(0.1 * 1.3))
    assert_same(end_of(forced_one()), end_of(forced_one(forcing=base)))


@pytest.mark.slow(first=True)
def test_a_force_in_two_halves_is_one():
    half = jb.Harmonic(0.45, 1.3, 0.4)
    assert_same(end_of(forced_one()), end_of(forced_one(forcing=(half, half))))


@pytest.mark.slow(first=True)
def test_without_amplitude_it_is_the_motion_without_forcing():
    osc = forced_one(forcing=jb.Harmonic(0.0, 1.3))
    assert_same(end_of(osc), end_of(forced_one(forcing=())))


def test_in_other_units():
    """Lengths eight times as large, and a unit of time 1.5 as long for the belts' velocities."""
    L, omega = 8.0, 1.5
    osc = forced_one(
        velocity=0.3 * L * omega,
        load=0.7 * L,
        omega=omega,
        forcing=jb.Harmonic(0.9 * L, 1.3, 0.4),
    )
    y, t, kinds = end_of(osc, (L, 0.2 * L))
    assert_same(end_of(forced_one()), (y / L, t, kinds))


class Pulses(jb.AbstractForce):
    """A force of one's own."""

    size: jax.Array
    frequency: jax.Array

    def force(self, t):
        return self.size * jnp.exp(3 * (jnp.cos(self.frequency * t) - 1))


@pytest.mark.slow
def test_a_force_of_ones_own_is_the_sum_of_its_waves():
    """exp(3 cos) is a sum of Bessel functions I_n(3) times cos(n theta)."""
    from scipy.special import iv

    own = forced_one(forcing=Pulses(jnp.asarray(0.9), jnp.asarray(1.3)), load=8 * 0.7)
    waves = [2 * iv(n, 3.0) * np.exp(-3) * 0.9 for n in range(18)]
    waves[0] /= 2
    forces = tuple(jb.Harmonic(wave, 1.3 * n) for n, wave in enumerate(waves))
    assert_same(end_of(own), end_of(forced_one(forcing=forces, load=8 * 0.7)))


@pytest.mark.parametrize(
    "formulation",
    [
        pytest.param("switch", marks=pytest.mark.slow(first=True)),
        pytest.param("smooth", marks=pytest.mark.slow),
    ],
)
def test_approximations_approach_the_exact_motion(formulation):
    osc = forced_one(law=jb.Coulomb(1.0, 1.0), velocity=jb.Oscillating(0.3, 0.1, 0.7), load=2.0)
    exact = jb.simulate(osc, (1.0, 0.2), 6.0, ts=[6.0])
    assert jb.EventKind.SLIP in np.asarray(exact.events.kind)
    name = "v_star" if formulation == "switch" else "eps"
    errors = []
    for width in (1e-2, 2.5e-3):
        run = jb.simulate(
            osc, (1.0, 0.2), 6.0, ts=[6.0], rtol=1e-8, atol=1e-8, formulation=formulation,
            **{name: width},
        )  # fmt: skip
        errors.append(float(np.max(np.abs(run.ys[-1] - exact.ys[-1]))))
    # First order in the width; the terms beyond are a few tens of per cent.
    assert errors[1] < 0.4 * errors[0] < 0.04


# --- transformations ------------------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_derivatives_are_differences_of_the_engine():
    """Along all numbers together: start, damping, omega, belt, force, and of t0 and T alone."""
    rng = np.random.default_rng(3)
    shape = forced_cases.structures(rng, 1)[0]
    done = 0
    while done < 5:
        case = forced_cases.random_case(rng, shape, T=15.0)
        direction = rng.uniform(-1, 1, len(forced_cases._numbers(case)[0]))
        known = forced_cases.derivative(case, direction)
        if known is None or case.simulate().status != forced.OK or known[1] > 1e-9:
            continue
        scale = 1 + np.max(np.abs(known[0]))
        off = np.max(np.abs(forced_package.derivative(case, direction) - known[0]))
        assert off < 1e-8 * scale
        for name, times in (("t0", (1.0, 0.0)), ("T", (0.0, 1.0))):
            h = 1e-4
            ends = [
                replace(case, **{name: getattr(case, name) + way * h}).simulate().y_end
                for way in (1, -1)
            ]
            # A central difference of 1e-4: its error is some 1e-8 of the third derivative.
            slope = np.subtract(*ends) / (2 * h)
            nothing = np.zeros_like(direction)
            moved = forced_package.derivative(case, nothing, times=times)
            assert np.max(np.abs(moved - slope)) < 1e-5 * (1 + np.max(np.abs(slope)))
        done += 1


@pytest.mark.slow
def test_derivatives_where_a_moving_belt_passes_the_bend_of_its_law():
    """There steps have to be short for the motion of the mass relative to the belt."""
    wave = 1.5784433
    belt = forced.Belt(
        forced.Oscillating(-0.37681613, 0.61460606, wave, 2.98708225),
        ("conti", 1.10739975, 1.03172114, 10.58908380, 0.04163986),
        load=0.60798073,
        upper=0.82610703,
    )
    load = forced.Oscillating(1.36843843, 1.11128597, wave, 0.33069544)
    other = forced.Belt(0.39971060, ("coulomb", 1.05062571, 0.50223336), load, lower=0.59368429)
    forces = tuple(
        forced.Harmonic(amplitude, wave, phase)
        for amplitude, phase in ((1.49625279, 1.30318582), (0.64073247, 1.70330296))
    )
    osc = forced.Oscillator(0.38036077, (belt, other), forces, 1.37035268)
    case = forced_cases.Case(osc, (2.10191435, 1.61053796), T=20.0)
    direction = np.cos(np.arange(len(forced_cases._numbers(case)[0])))
    direction = np.array(forced_cases.tied(case, direction))
    known, error = forced_cases.derivative(case, direction)
    off = np.max(np.abs(forced_package.derivative(case, direction) - known))
    assert error < 1e-8 and off < 1e-7 * (1 + np.max(np.abs(known)))


@pytest.mark.slow
def test_reverse_mode_is_the_transpose_and_samples_have_derivatives():
    osc = forced_one(law=jb.Cubic(1.5, 1.5, 0.45), velocity=1.0)

    def samples(osc, y0):
        return jb.simulate(osc, y0, 12.0, ts=jnp.array([3.0, 7.0, 12.0])).ys

    y0 = jnp.array([1.0, 0.2])
    forward = jax.jacfwd(samples, argnums=(0, 1))(osc, y0)
    backward = jax.jacrev(samples, argnums=(0, 1))(osc, y0)
    pairs = zip(jax.tree.leaves(forward), jax.tree.leaves(backward), strict=True)
    for one, other in pairs:
        np.testing.assert_allclose(one, other, atol=1e-12)
    h = 1e-5
    for i, column in enumerate(jnp.eye(2)):
        ends = [jb.simulate(osc, y0 + w * h * column, 12.0, ts=[3.0, 7.0, 12.0]) for w in (1, -1)]
        slope = (np.asarray(ends[0].ys) - np.asarray(ends[1].ys)) / (2 * h)
        # Runs are good to some 1e-11, which a difference of 1e-5 makes 1e-6.
        np.testing.assert_allclose(forward[1][..., i], slope, atol=3e-6)


@pytest.mark.slow
def test_a_batch_is_each_run_by_itself():
    amplitudes = jnp.array([0.2, 0.9, 1.4])

    def end(amplitude):
        osc = eqx.tree_at(lambda o: o.forcing[0].amplitude, forced_one(), amplitude)
        run = jb.simulate(osc, (1.0, 0.2), 12.0, ts=jnp.array([12.0]))
        return run.ys[-1], run.status

    ys, statuses = jax.vmap(end)(amplitudes)
    for amplitude, y, status in zip(amplitudes, ys, statuses, strict=True):
        alone, status_alone = end(amplitude)
        assert int(status) == int(status_alone)
        np.testing.assert_allclose(y, alone, atol=1e-9)


def test_impossible_numbers_in_a_trace_have_a_status():
    def status(frequency):
        osc = forced_one(forcing=jb.Harmonic(0.9, frequency))
        return jb.simulate(osc, (1.0, 0.2), 5.0, ts=jnp.array([5.0])).status

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert jax.jit(status)(jnp.nan) == jb.Status.NOT_FINITE


# --- in a trace -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        dict(),
        pytest.param(
            dict(forcing=(), velocity=jb.Oscillating(0.3, 0.2, 1.7)),
            marks=pytest.mark.slow(first=True),
        ),
        pytest.param(
            dict(forcing=jb.BaseMotion(0.4, 2.6), omega=2.0, load=0.3),
            marks=pytest.mark.slow(first=True),
        ),
        dict(forcing=Pulses(jnp.array(0.4), jnp.array(1.3))),
    ],
)
def test_known_numbers_are_so_in_a_trace_too(changes):
    osc = forced_one(**changes)

    def run(y0, t1=5.0, **options):
        return jb.simulate(osc, y0, t1, ts=jnp.array([2.0]), **options).ys

    y0 = jax.ShapeDtypeStruct((2,), jnp.float64)
    assert jax.eval_shape(run, y0).shape == (1, 2)
    assert jax.eval_shape(partial(run, max_segments=100, max_events=30), y0).shape == (1, 2)
    assert jax.eval_shape(run, y0, jax.ShapeDtypeStruct((), jnp.float64)).shape == (1, 2)
    batch = jax.ShapeDtypeStruct((3, 2), jnp.float64)
    assert jax.eval_shape(jax.vmap(run), batch).shape == (3, 1, 2)
    slopes = jax.grad(lambda y: jnp.sum(run(y)))
    assert jax.eval_shape(slopes, y0).shape == (2,)


@pytest.mark.slow
def test_compiled_runs_of_a_known_oscillator_are_those_outside():
    osc, times = forced_one(), jnp.array([5.0])

    def run(y0):
        return jb.simulate(osc, y0, 5.0, ts=times).ys[-1]

    starts = jnp.array([[1.0, 0.0], [1.5, 0.3]])
    alone = jnp.stack([run(y0) for y0 in starts])
    np.testing.assert_allclose(jax.jit(jax.vmap(run))(starts), alone, atol=1e-13)
    slopes = jax.jit(jax.grad(lambda y: run(y)[0]))(starts[0])
    np.testing.assert_allclose(slopes, jax.jacfwd(run)(starts[0])[0], atol=1e-12)


# --- loads that oscillate, and edges --------------------------------------------------------------


def edged(velocity, edge, amplitude, phase):
    """A belt whose load oscillates, which touches on the right of an edge."""
    load = jb.Oscillating(1.0, amplitude, 2.0, phase)
    return jb.Oscillator(0.1, (jb.Belt(velocity, jb.Coulomb(1.0, 0.7), load, lower=edge),))


def edged_of_engine(velocity, edge, amplitude, phase):
    load = forced.Oscillating(1.0, amplitude, 2.0, phase)
    belt = forced.Belt(velocity, ("coulomb", 1.0, 0.7), load, lower=edge)
    return forced.Oscillator(0.1, (belt,))


#: It passes the edge twice, and sticks and slips behind it.
EDGED, EDGED_START, EDGED_SPAN = np.array([0.5, -1.0, 0.5, 0.3]), (3.0, 0.0), 10.0


@jax.jit
def edged_end(numbers):
    return jb.simulate(edged(*numbers), EDGED_START, EDGED_SPAN, ts=jnp.array([EDGED_SPAN])).ys[-1]


@pytest.mark.slow(first=True)
def test_a_load_that_oscillates_acts_up_to_an_edge_as_in_scipy():
    """From zone to zone; the belt is faster than the mass ever is."""
    numbers = np.array([9.0, *EDGED[1:]])
    edge, amplitude, phase = numbers[1:]

    def field(touches):
        def rate(t, y):
            load = 1.0 + amplitude * cos(2.0 * t + phase)
            return y[1], -y[0] - 0.1 * y[1] + touches * 0.7 * load

        return rate

    def passes(t, y):
        return y[0] - edge

    t, y, zones = 0.0, np.array(EDGED_START), 0
    passes.terminal = True
    while t < EDGED_SPAN:
        touches = y[0] > edge or (y[0] == edge and y[1] > 0)
        passes.direction = -1.0 if touches else 1.0
        options = dict(events=passes, rtol=1e-12, atol=1e-13)
        run = solve_ivp(field(touches), (t, EDGED_SPAN), y, "DOP853", **options)
        t, y, zones = run.t[-1], run.y[:, -1], zones + 1
        if t < EDGED_SPAN:
            y[0] = edge
    assert zones > 2
    # Both are good to 1e-10 a step, or better.
    np.testing.assert_allclose(edged_end(jnp.asarray(numbers)), y, atol=1e-9)


@pytest.mark.slow(first=True)
def test_derivatives_of_a_load_that_oscillates_up_to_an_edge():
    found = np.asarray(jax.jacfwd(edged_end)(jnp.asarray(EDGED)))

    def end(numbers):
        run = forced.simulate(edged_of_engine(*map(float, numbers)), EDGED_START, EDGED_SPAN)
        kinds = {kind for kind, _ in run.sequence}
        assert kinds == {1, 2, 4}  # STICK, SLIP, EDGE
        return np.array(run.y_end)

    np.testing.assert_allclose(edged_end(jnp.asarray(EDGED)), end(EDGED), atol=CLOSE)
    for k, column in enumerate(found.T):
        one = np.eye(len(EDGED))[k]
        slope, error = oracle.richardson(lambda h, one=one: end(EDGED + h * one), 0.0, 1e-3)
        assert np.max(error) < 1e-8 and np.max(np.abs(slope)) > 0.1
        np.testing.assert_allclose(column, slope, atol=1e-8)


def two_edged(kind, wave, belt, law, edges, amplitude=0.5):
    """Two belts end at one place, and either load is the larger one by turns."""
    waves = wave(0.6, amplitude, 2.0, 0.3), wave(0.6, 0.4, 3.0, 2.0)
    rows = zip((2.5, -2.3), waves, edges, strict=True)
    return kind(0.1, tuple(belt(nu, law, load, upper=edge) for nu, load, edge in rows))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("t1", [3.0, 9.0])
def test_each_of_two_edges_at_one_place_has_its_own_derivative(t1):
    own = partial(two_edged, jb.Oscillator, jb.Oscillating, jb.Belt, jb.Coulomb(0.8, 0.5))
    law = ("coulomb", 0.8, 0.5)
    other = partial(two_edged, forced.Oscillator, forced.Oscillating, forced.Belt, law)

    def end(numbers):
        first, second, amplitude = map(float, numbers)
        osc = other((first, second), amplitude)
        return np.array(forced.simulate(osc, (1.5, 0.0), t1).y_end)

    at, names = np.array([0.2, 0.2, 0.5]), ("first", "second", "amplitude")
    slopes = [
        oracle.richardson(lambda h, one=one: end(at + h * one), 0.0, 1e-3)[0] for one in np.eye(3)
    ]

    @jax.jit
    def run(numbers, t1):
        return jb.simulate(own(numbers[:2], numbers[2]), (1.5, 0.0), t1, ts=t1[None]).ys[-1]

    one, found = run(jnp.asarray(at), jnp.asarray(t1)), jax.jacfwd(run)
    np.testing.assert_allclose(one, end(at), atol=CLOSE)
    np.testing.assert_allclose(found(jnp.asarray(at), jnp.asarray(t1)).T, slopes, atol=1e-7)
    swept = jb.sweep(
        lambda first, second, amplitude: own((first, second), amplitude),
        {name: [float(value)] for name, value in zip(names, at, strict=True)},
        **dict(y0=(1.5, 0.0), t1=t1, rtol=1e-10, atol=1e-10, progress=False),
    )
    np.testing.assert_allclose([swept.x1_end.item(), swept.x2_end.item()], end(at), atol=CLOSE)


@pytest.mark.slow(first=True)
def test_a_cycle_of_a_load_that_oscillates_passes_an_edge():
    numbers = np.array([-0.5, -0.2, 0.5, 0.3])
    motion = jb.find_cycle(edged(*numbers), (3.0, 0.0))
    assert motion.status == jb.Status.OK
    assert jb.EventKind.EDGE in [kind for kind, _ in motion.signature]
    state = tuple(map(float, motion.start))
    again = forced.simulate(edged_of_engine(*numbers), state, motion.periods * pi).y_end
    np.testing.assert_allclose(again, state, atol=CLOSE)
