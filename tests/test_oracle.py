"""The oracle against closed forms, a second integrator of another kind, and published numbers.

Without damping and with Coulomb friction every slip arc is a circle around the point where
spring and friction balance, run through with unit angular speed; that gives most of the numbers
here by hand. Tolerances: 1e-11 where the oracle integrates at 1e-13 for a few dozen time units
with events of order-one normal speed.
"""

from dataclasses import replace
from math import acos, atan, cos, hypot, inf, pi, sin, sqrt

import numpy as np
import pytest
from oracle import (
    Belt,
    Oscillator,
    advance,
    class_a,
    class_b,
    class_c,
    class_d,
    conti,
    coulomb,
    richardson,
    simulate,
    start_mode,
    stribeck,
)
from oracle_cycles import (
    foci,
    gap,
    grazing,
    hopf,
    nonsmooth_fold,
    one_loop,
    pseudo_focus_rate,
    reverse,
    sticking_cycle,
    unstable_cycle,
)

EXACT = dict(rel=0, abs=1e-11)


def undamped(*belts):
    return Oscillator(0.0, belts)


def coulomb_belt(velocity, mus=1.0, mud=1.0, **options):
    return Belt(velocity, *coulomb(mus, mud), **options)


def check(run, expected):
    """Events (t, kind, belt, x1, x2) one by one."""
    assert run.sequence == tuple((kind, belt) for _, kind, belt, _, _ in expected)
    for event, (t, _, _, x1, x2) in zip(run.events, expected):
        assert (event.t, event.x1, event.x2) == pytest.approx((t, x1, x2), **EXACT)


# ---------------------------------------------------------------- slip and stick


@pytest.mark.parametrize("v", [0.1, 0.4, -0.4])
def test_stick_slip_cycle_is_a_circle_and_a_straight_line(v):
    # Onset at x1 = mus, circle around mud, back at x2 = v a distance d = mus - mud before it.
    mus, mud = 1.0, 0.6
    d, side = mus - mud, np.sign(v)
    osc = undamped(coulomb_belt(v, mus, mud))
    slip, stick = 2 * pi - 2 * atan(d / abs(v)), 2 * d / abs(v)
    start = stick / 4  # start inside the stick phase
    run = simulate(osc, (side * (mus - d / 2), v), 3 * (slip + stick))
    onset, arrival = (side * mus, v), (side * (mud - d), v)
    times = [start + i * (slip + stick) for i in range(3)]
    expected = [
        e for t in times for e in ((t, "SLIP", 0, *onset), (t + slip, "STICK", 0, *arrival))
    ]
    check(run, expected)
    # Between events: on the circle, a known angle after the onset.
    angle = np.linspace(0.1, slip - 0.1, 7)
    x1 = mud * side + side * (d * np.cos(angle) + abs(v) * np.sin(angle))
    x2 = side * (abs(v) * np.cos(angle) - d * np.sin(angle))
    states = np.array([run.at(start + phi) for phi in angle])
    assert states == pytest.approx(np.c_[x1, x2], **EXACT)
    # The interpolant is only drawn with; its order is lower.
    assert run.arcs[1].dense(start + 1.0) == pytest.approx(run.at(start + 1.0), abs=1e-9)

    cycle = sticking_cycle(osc, (3.0, 0.0))
    assert cycle.period == pytest.approx(slip + stick, **EXACT)
    assert cycle.stick_durations == pytest.approx([stick], **EXACT)
    assert cycle.signature == (("STICK", 0), ("SLIP", 0))
    assert max(abs(cycle.x1_min), abs(cycle.x1_max)) == pytest.approx(mud + hypot(d, v), **EXACT)
    assert max(abs(cycle.x2_min), abs(cycle.x2_max)) == pytest.approx(hypot(d, v), **EXACT)


def test_belt_at_rest_takes_a_fixed_bite_per_half_cycle_and_holds_for_ever():
    # 5 -> -4 -> 3 -> -2 -> 1 -> 0 with mu = 1/2, each in half a period; then |x1| < 1/2 holds.
    osc = undamped(coulomb_belt(0.0, 0.5, 0.5))
    run = simulate(osc, (5.0, 0.0), 1000.0)
    loops = [(i * pi, "CROSS", 0, x, 0.0) for i, x in enumerate([-4.0, 3.0, -2.0, 1.0], 1)]
    check(run, [*loops, (5 * pi, "STICK", 0, 0.0, 0.0)])
    assert run.mode_end == (0,) and tuple(run.at(999.0)) == pytest.approx((0, 0), abs=1e-11)
    assert simulate(osc, (0.3, 0.0), 50.0).events == []


def test_damped_slip_arc():
    # x'' + 2 k x' + x = mud below a fast belt: exp(-k t) times a rotation at sqrt(1 - k^2).
    k, mud, t = 0.25, 0.7, 20.0
    run = simulate(Oscillator(2 * k, (coulomb_belt(9.0, 1.0, mud),)), (2.0, 0.5), t)
    w, z0, v0 = sqrt(1 - k * k), 2.0 - mud, 0.5
    x1 = mud + np.exp(-k * t) * (z0 * cos(w * t) + (v0 + k * z0) / w * sin(w * t))
    assert run.events == [] and run.y_end[0] == pytest.approx(x1, **EXACT)


def test_two_belts_at_one_speed_are_one_belt():
    one = simulate(class_b(0.3, -0.2), (-1.5, 1.0), 40.0)
    b0, b1 = class_b(0.3, -0.2).belts
    halves = (replace(b0, load=0.25), b1, replace(b0, load=0.75))
    split = simulate(Oscillator(0.5, halves), (-1.5, 1.0), 40.0)
    assert split.sequence == one.sequence and len(one.events) > 4
    assert [e.t for e in split.events] == pytest.approx([e.t for e in one.events], **EXACT)
    assert {(arc.mode[0], arc.mode[2]) for arc in split.arcs} == {(1, 1), (-1, -1), (0, 0)}


def test_crossing_a_boundary_flips_one_sign():
    # Belt 0 pulls with 1/2 only; belt 1 at speed 9 pulls with 2, so the needed force at x1 < 1.5
    # is too large for belt 0. Circles around 2.5, then 1.5.
    osc = undamped(coulomb_belt(0.3, 0.5, 0.5), coulomb_belt(9.0, 2.0, 2.0))
    run = simulate(osc, (0.0, 0.0), 0.5)
    t = np.arcsin(0.3 / 2.5)
    check(run, [(t, "CROSS", 0, 2.5 - 2.5 * cos(t), 0.3)])
    assert run.mode_end == (-1, 1)


# ---------------------------------------------------------------- contact edges


@pytest.mark.parametrize(
    "velocity, load, mode, centre",
    [
        (-1.0, 0.2, (0, -1), None),  # needed = -0.7: still stuck, onset at 0.8
        (-1.0, 0.8, (1, -1), 0.2),  # needed = -1.3: torn off downwards
        (2.0, 2.0, (-1, 1), 1.0),  # needed = 1.5: torn off upwards
        (0.3, 0.5, (0, 0), None),  # same speed: both hold, onset at 1.5
    ],
)
def test_a_belt_arrives_while_the_mass_sticks(velocity, load, mode, centre):
    osc = undamped(coulomb_belt(0.3), coulomb_belt(velocity, load=load, lower=0.5))
    run = simulate(osc, (0.0, 0.3), 2.0)
    t = 0.5 / 0.3
    assert run.events[0].mode == mode and run.margin > 0.05  # torn off is no corner
    check(run, [(t, "EDGE", 1, 0.5, 0.3)])
    if centre is not None:
        phi = 2.0 - t
        x1 = centre + (0.5 - centre) * cos(phi) + 0.3 * sin(phi)
        assert run.y_end[0] == pytest.approx(x1, **EXACT)
    else:
        onset = {(0, -1): 0.8, (0, 0): 1.5}[mode]
        check(simulate(osc, (0.0, 0.3), 5.1), [
            (t, "EDGE", 1, 0.5, 0.3), (onset / 0.3, "SLIP", 0, onset, 0.3),
        ])  # fmt: skip


def test_the_belt_stuck_to_is_left():
    run = simulate(undamped(coulomb_belt(0.3, upper=0.5)), (0.0, 0.3), 2.5)
    t = 0.5 / 0.3
    check(run, [(t, "EDGE", 0, 0.5, 0.3)])
    assert run.mode_end == (2,)
    phi = 2.5 - t  # a free circle around 0
    assert run.y_end == pytest.approx(
        (0.5 * cos(phi) + 0.3 * sin(phi), 0.3 * cos(phi) - 0.5 * sin(phi)), **EXACT
    )


def test_of_two_belts_at_one_speed_one_is_left():
    # Both hold up to 1.5; belt 0 ends at 0.8, where 0.8 > 0.5 tears the mass off belt 1, or at
    # 0.4, where belt 1 still holds.
    def osc(upper):
        return undamped(coulomb_belt(0.3, upper=upper), coulomb_belt(0.3, 0.5, 0.5))

    run = simulate(osc(0.8), (0.0, 0.3), 3.0)
    check(run, [(0.8 / 0.3, "EDGE", 0, 0.8, 0.3)])
    assert run.mode_end == (2, 1)
    run = simulate(osc(0.4), (0.0, 0.3), 2.0)
    check(run, [(0.4 / 0.3, "EDGE", 0, 0.4, 0.3), (0.5 / 0.3, "SLIP", 1, 0.5, 0.3)])


def test_the_shared_edge_of_class_c_is_one_event_of_belt_0():
    run = simulate(class_c(0.4, -0.4, 0.2), (0.0, 0.4), 2.0)
    assert run.sequence[0] == ("EDGE", 0) and run.events[0].mode == (2, -1)
    assert run.events[0].t == pytest.approx(0.5, **EXACT)
    run = simulate(class_c(0.3, 0.3, 0.2), (0.0, 0.3), 1.0)  # carried from belt to belt
    assert run.sequence == (("EDGE", 0),) and run.mode_end == (2, 0)


@pytest.mark.parametrize("depth", [1e-3, 1e-6, 1e-9])
def test_an_excursion_over_an_edge_within_one_step(depth):
    # Free motion -cos t; the belt begins just below its maximum and pulls up with 1/2: there
    # the circle is around 1/2. x2 at the edge is sqrt(2 depth - depth^2).
    edge = 1 - depth
    run = simulate(undamped(coulomb_belt(9.0, 0.5, 0.5, lower=edge)), (-1.0, 0.0), 4.0)
    t, v = pi - acos(edge), sqrt(2 * depth - depth**2)
    back = t + 2 * atan(v / (edge - 0.5))
    assert run.sequence == (("EDGE", 0), ("EDGE", 0))
    # A passage at speed v loops an error e of x1 into e/v of time.
    times = [e.t for e in run.events]
    assert times == pytest.approx([t, back], rel=0, abs=1e-13 + 1e-14 / v)


@pytest.mark.parametrize("depth", [1e-3, 1e-6, 1e-9])
def test_a_stick_phase_shorter_than_a_step(depth):
    # A circle around mud = mus whose top is `depth` above the boundary is cut off there.
    v, mu = 0.4, 0.7
    radius, half = v + depth, sqrt((v + depth) ** 2 - v * v)
    run = simulate(undamped(coulomb_belt(v, mu, mu)), (mu, -radius), 5.0)
    t = pi - atan(half / v)
    assert run.sequence == (("STICK", 0), ("SLIP", 0))
    expected = [t, t + half / v]
    assert [e.t for e in run.events] == pytest.approx(expected, rel=0, abs=1e-13 + 1e-13 / half)
    assert run.margin == pytest.approx(min(depth, half), abs=half * 1.1)


def test_margin_sees_a_corner_of_an_edge_and_the_boundary_of_the_belt_left():
    # Carried over the left end of the belt at its velocity v < 0, free on a circle, back in at
    # -v; the next passage out is at v again, on the boundary but for rounding.
    osc = undamped(coulomb_belt(-0.25, 1.0, 0.6, load=2.0, lower=-0.75, upper=0.25))
    assert simulate(osc, (-0.5, -0.25), 2.2).margin > 0.01
    assert simulate(osc, (-0.5, -0.25), 4.0).margin < 1e-11


# ---------------------------------------------------------------- starts


def test_starts_on_a_boundary_are_resolved_without_an_event():
    osc = undamped(coulomb_belt(0.3, 1.0, 0.6))
    assert start_mode(osc, 0.9, 0.3)[0] == (0,)
    assert start_mode(osc, 1.1, 0.3)[0] == (1,)  # needed = -1.1 pulls down: r > 0
    assert start_mode(osc, -1.1, 0.3)[0] == (-1,)
    assert simulate(osc, (1.1, 0.3), 1.0).events == []
    # nu/omega is rounded; it is on the boundary all the same.
    assert start_mode(replace(osc, omega=1.7), 0.0, 0.3 / 1.7)[0] == (0,)


def test_starts_on_an_edge_lie_on_the_side_they_move_to():
    osc = class_c(0.4, -0.4, 0.2)
    assert start_mode(osc, 0.2, 0.1)[0] == (2, -1)
    assert start_mode(osc, 0.2, -0.1)[0] == (1, -2)
    assert start_mode(osc, 0.2, 0.0)[2] == "pseudo_focus"
    assert simulate(osc, (0.2, 0.0), 5.0).status == "pseudo_focus"
    assert start_mode(class_c(0.4, 0.4, 0.2), 0.2, 0.0)[0] == (2, 1)  # pulled to the right


# ---------------------------------------------------------------- pseudo-foci


def test_pseudo_focus_is_recognised_and_its_rate_is_right():
    osc = class_c(0.5, -0.6, 0.1)
    assert foci(osc) == [(0.1, "pseudo_focus")]
    rate = pseudo_focus_rate(osc, 0.1)
    assert rate < 0
    run = simulate(osc, (0.1, 0.1), 60.0)
    assert run.status == "pseudo_focus" and 0 < abs(run.y_end[1]) < 1e-3
    # The law is the limit of small loops: the error of the measured rate is of order x2.
    first, last = next(e for e in run.events if abs(e.x2) < 5e-3), run.events[-1]
    measured = np.log(abs(last.x2 / first.x2)) / (last.t - first.t)
    assert measured == pytest.approx(rate, rel=2e-2)


def test_unstable_pseudo_focus_is_left():
    osc = class_c(0.1, -0.1, 0.1)  # weakening wins over damping at low speed
    assert pseudo_focus_rate(osc, 0.1) > 0
    run = simulate(osc, (0.1, 9e-4), 3.0)  # slower than where a shrinking run is stopped
    growth = np.exp(3 * pseudo_focus_rate(osc, 0.1))
    assert run.status == "ok"
    assert abs(run.events[-1].x2 / 9e-4) == pytest.approx(growth, rel=1e-2)
    assert simulate(osc, (0.1, 9e-4), 3.0, max_events=7).status == "budget"


# ---------------------------------------------------------------- symmetries, other integrators


def random_oscillators(seed, count, omega=True):
    rng = np.random.default_rng(seed)
    for i in range(count):
        nu0, nu1 = rng.uniform(-0.8, 0.8, 2)
        s0, s1 = np.sort(rng.uniform(-1.0, 1.3, 2))
        c = dict(omega=rng.uniform(0.7, 1.5) if omega else 1.0)
        make = [class_b, class_c, class_d][i % 3]
        args = [(), (s0,), (s0, s1)][i % 3]
        yield make(nu0, nu0 if i % 7 == 6 else nu1, *args, **c), rng.uniform(-2, 2, 2)


def test_the_mirror_image_runs_alike():
    for osc, y0 in random_oscillators(5, 12):
        mirrored = [
            replace(b, velocity=-b.velocity, lower=-b.upper, upper=-b.lower) for b in osc.belts
        ]
        run = simulate(osc, y0, 20.0)
        image = simulate(replace(osc, belts=tuple(mirrored)), -y0, 20.0)
        if run.margin > 1e-6:
            assert image.sequence == run.sequence
            assert image.y_end == pytest.approx(-run.y_end, abs=1e-9)


def test_other_steps_and_laws_give_the_same_run():
    mu, static = stribeck(1.0, 0.6, 0.3)
    osc = Oscillator(0.1, (Belt(0.3, mu, static), Belt(-0.5, *conti(0.5, 0.2, 4.0, 0.05))))
    run, fine = simulate(osc, (2.0, 1.0), 40.0), simulate(osc, (2.0, 1.0), 40.0, max_step=0.07)
    assert run.sequence == fine.sequence and len(run.events) > 8
    assert [e.t for e in run.events] == pytest.approx([e.t for e in fine.events], **EXACT)


def test_reversed_time_runs_back():
    osc = class_d(0.7, -0.6, -0.4, 0.9)
    run = simulate(osc, (0.35, 0.0), 3.0)
    assert {kind for kind, _ in run.sequence} <= {"EDGE"}
    x1, x2 = run.y_end
    mode = tuple(m if abs(m) == 2 else -m for m in run.mode_end)
    back = advance(reverse(osc), (x1, -x2), mode, 3.0)
    assert back.y_end == pytest.approx((0.35, 0.0), **EXACT)


@pytest.mark.slow(first=True)
def test_events_agree_with_time_stepping_of_the_inclusion():
    """Set-valued friction stepped implicitly knows no events; it converges with order one."""
    T, cases = 12.0, []
    for osc, y0 in random_oscillators(7, 60):
        run = simulate(osc, y0, T, max_events=200)
        if run.status == "ok" and run.margin > 2e-2:
            cases.append((osc, y0, run))
    seen = {e.kind for *_, run in cases for e in run.events}
    assert seen == {"STICK", "SLIP", "CROSS", "EDGE"} and len(cases) > 20
    exact = np.array([run.y_end for *_, run in cases])
    coarse, fine = (np.abs(_time_stepping(cases, T, h) - exact).max(1) for h in (4e-3, 5e-4))
    assert fine.max() < 5e-3  # about h times the norm of the field, times ten
    assert np.median(coarse) / np.median(fine) == pytest.approx(8, rel=0.3)  # order one


def _time_stepping(cases, T, h):
    """Moreau's scheme for two belts, all cases at once: the new x2 solves a monotone inclusion

    (1 + h zeta/2) x2 in free + h sum of W_i Sgn(v_i - x2).
    """
    oscs = [osc for osc, _, _ in cases]
    x1, x2 = np.array([y0 for _, y0, _ in cases]).T
    nu, lower, upper = (
        np.array([[getattr(b, name) for b in osc.belts] for osc in oscs]).T
        for name in ("velocity", "lower", "upper")
    )
    omega, zeta = np.array([osc.omega for osc in oscs]), oscs[0].damping
    v = nu / omega
    low, high, columns = np.argmin(v, 0), 1 - np.argmin(v, 0), np.arange(len(oscs))
    v_low, v_high = v[low, columns], v[high, columns]
    den = 1 + 0.5 * h * zeta
    for _ in range(round(T / h)):
        middle = x1 + 0.5 * h * x2
        weight = 0.4 / (1 + 10 * abs(nu - omega * x2)) + 0.6
        weight = np.where((middle > lower) & (middle < upper), weight, 0.0)
        w_low, w_high = weight[low, columns], weight[high, columns]
        free = x2 * (1 - 0.5 * h * zeta) - h * middle
        below, between, above = (
            (free + h * pull) / den for pull in (w_low + w_high, w_high - w_low, -w_low - w_high)
        )
        between = np.clip(between, v_low, v_high)
        x2 = np.where(below < v_low, below, np.where(above > v_high, above, between))
        x1 = middle + 0.5 * h * x2
    return np.c_[x1, x2]


# ---------------------------------------------------------------- published numbers


def test_leine_block():
    # Leine et al., as quoted with seven decimals: half a unit of the last one, and its sum.
    osc = undamped(Belt(0.2, *conti(1.0, 0.0, 3.0)))
    cycle = sticking_cycle(osc)
    assert cycle.period == pytest.approx(12.0010313, abs=1e-7)
    assert cycle.stick_durations[0] == pytest.approx(7.7050318, abs=1e-7)
    assert cycle.period - cycle.stick_durations[0] == pytest.approx(4.2959995, abs=1e-7)


def belt_1_at_035(nu0):
    return class_b(nu0, 0.35)


# The exact column of the table, printed with twelve decimals and good to about 1e-11.
def test_nonsmooth_folds():
    point = dict(abs=1e-11, rel=0)
    assert nonsmooth_fold(class_a, (0.25, 0.28), 0) == pytest.approx(0.267134534361, **point)
    fold = nonsmooth_fold(belt_1_at_035, (0.5, 0.56), 1)
    assert fold == pytest.approx(0.538734800481, **point)
    fold = nonsmooth_fold(belt_1_at_035, (-0.58, -0.53), 1)
    assert fold == pytest.approx(-0.561302406210, **point)


def test_grazing():
    value = grazing(belt_1_at_035, (-0.5, -0.4), 0)
    assert value == pytest.approx(-0.455724862289, abs=1e-11, rel=0)


def test_hopf_points():
    assert hopf(class_a, (0.1, 0.25)) == pytest.approx((sqrt(8) - 1) / 10, abs=1e-13)
    assert hopf(belt_1_at_035, (0.2, 0.3)) == pytest.approx(0.263654916039, abs=1e-12)
    assert hopf(belt_1_at_035, (-0.3, -0.2)) == pytest.approx(-0.263654916039, abs=1e-12)


def test_p3_of_class_a_is_misprinted():
    def with_3(nu0):
        return class_a(nu0, p3=3.0)

    assert hopf(with_3, (0.1, 0.25)) == pytest.approx(0.183064, abs=1e-6)
    assert nonsmooth_fold(with_3, (0.2, 0.25), 0) == pytest.approx(0.215967, abs=1e-6)


def test_stick_duration_grows_like_a_square_root_at_the_fold():
    fold = 0.267134534361
    long, short = (sticking_cycle(class_a(fold - d)).stick_durations[0] for d in (4e-6, 1e-6))
    assert long / short == pytest.approx(2.0, rel=2e-2)  # the next term is of order sqrt(d)
    assert sticking_cycle(class_a(fold + 1e-4), (1.5, 0.0), T=200.0) is None
    assert gap(class_a(fold - 1e-4), 0, 0) < 0 < gap(class_a(fold + 1e-4), 0, 0)


def test_cycle_that_sticks_on_both_belts():
    cycle = sticking_cycle(belt_1_at_035(-0.3))
    assert cycle.signature == (("STICK", 1), ("SLIP", 1), ("STICK", 0), ("SLIP", 0)) and (
        min(cycle.stick_durations) > 1
    )


# ---------------------------------------------------------------- unstable cycles


def test_unstable_cycle_repeats_and_its_multiplier_is_the_slope_of_the_return_map():
    osc = class_a(0.22)
    cycle = unstable_cycle(osc)

    def back(x1):
        return one_loop(osc, x1).stopped_by.x1

    assert back(cycle.start[0]) == pytest.approx(cycle.start[0], abs=1e-12)
    slope, error = richardson(back, cycle.start[0], 1e-3)
    assert cycle.multiplier == pytest.approx(slope, abs=10 * error) and error < 1e-4
    assert cycle.multiplier > 1 and cycle.x2_max < 0.22


@pytest.mark.slow(first=True)
def test_unstable_cycle_exists_between_hopf_point_and_fold():
    assert unstable_cycle(class_a(0.18)) is None
    assert unstable_cycle(class_a(0.268)) is None
    assert unstable_cycle(class_a(0.267)).x2_max == pytest.approx(0.267, abs=1e-3)


def test_unstable_cycle_around_a_pseudo_focus():
    osc = class_c(0.6304, -0.1582, -0.3782)
    assert pseudo_focus_rate(osc, -0.3782) < 0
    cycle = unstable_cycle(osc)
    assert cycle.signature == (("EDGE", 0), ("EDGE", 0)) and cycle.multiplier > 1
    # Runs from either side of it part.
    x1, _ = cycle.start
    inner, outer = (simulate(osc, (x1 + d, 0.0), 60.0) for d in (0.002, -0.002))
    assert abs(inner.events[-1].x2) < cycle.x2_max < abs(outer.events[-1].x2)


# ---------------------------------------------------------------- differences


def test_richardson_is_far_better_than_a_difference_and_says_so():
    value, error = richardson(np.sin, 0.7, 0.1)
    assert abs(value - cos(0.7)) <= error < 1e-6
    assert abs(value - cos(0.7)) < 1e-10
    value, _ = richardson(lambda x: np.array([x**2, x**3]), 2.0, 0.1)
    assert value == pytest.approx([4, 12], abs=1e-11)


def test_a_stick_phase_collapses_the_state():
    # Onset time and everything after shifts with the start; the states at events do not.
    osc = class_a(0.2)

    def events(x1):
        run = simulate(osc, (x1, 0.0), 20.0)
        return np.array([(e.t, e.x1, e.x2) for e in run.events])

    value, _ = richardson(events, 2.0, 1e-3)
    shift = value[1, 0]
    assert abs(shift) > 1e-3
    assert value[1:, 0] == pytest.approx(np.full(len(value) - 1, shift), abs=1e-9)
    assert value[1:, 1:] == pytest.approx(np.zeros((len(value) - 1, 2)), abs=1e-9)


def test_time_outside_the_run_is_refused():
    run = simulate(class_a(0.3), (1.0, 0.0), 5.0)
    with pytest.raises(ValueError, match=r"within the run, up to 5\.0, got 6"):
        run.at(6.0)
    assert run.y_end == pytest.approx(run.at(5.0), abs=1e-14) and run.margin < inf
