"""Bifurcation points against the exact values of the paper's table and the oracle elsewhere."""

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest
from laws import BELL, bell, peak
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from where import nu0

import jaxbelt as jb
from jaxbelt import Status

FIRST = pytest.mark.slow(first=True)


def class_b(nu):
    return jb.presets.class_b(nu, 0.35)


# (class, condition, value computed twice independently to about 1e-11); that `jaxbelt reproduce`
# has the same is in test_cli.py
TABLE = [
    (jb.presets.class_a, jb.NonsmoothFold(0), 0.267134534361),
    (jb.presets.class_a, jb.Hopf(), (np.sqrt(8) - 1) / 10),
    (class_b, jb.NonsmoothFold(1), 0.538734800481),
    (class_b, jb.SlidingExchange((0, 1)), 0.35),
    (class_b, jb.Hopf(), 0.263654916039),
    (class_b, jb.SuddenSliding(0), 0.0),
    (class_b, jb.Hopf(), -0.263654916039),
    (class_b, jb.GrazingSliding(0), -0.455724862289),
    (class_b, jb.NonsmoothFold(1), -0.561302406210),
]


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("offset", [-0.02, 0.02])
@pytest.mark.parametrize(("make", "condition", "exact"), TABLE)
def test_the_papers_table(make, condition, exact, offset):
    point = jb.refine(condition, make(exact + offset), where=nu0)
    assert point.status == Status.OK, point
    # The table is good to 1e-11, the asked precision is 1e-10.
    assert point.value == pytest.approx(exact, abs=1e-11)
    assert abs(point.value - exact) <= point.error + 1e-11
    assert point.error < 1e-11 and point.residual < 1e-11
    assert point.iterations <= 8
    assert nu0(point.oscillator) == point.value


@pytest.mark.slow(first=True)
def test_cycle_at_a_fold_has_a_stick_phase_of_no_duration():
    point = jb.refine(jb.NonsmoothFold(1), class_b(0.53), where=nu0)
    assert point.cycle.status == Status.OK
    assert jb.stick_duration(point.cycle, 1) == pytest.approx(0, abs=1e-10)
    assert jb.gap(point.cycle, 1) == pytest.approx(0, abs=1e-12)
    assert point.multiplier > 1


@pytest.mark.slow(first=True)
def test_cycle_at_a_grazing_point_goes_on():
    point = jb.refine(jb.GrazingSliding(0), class_b(-0.44), where=nu0)
    assert point.cycle.stick_durations[0] == pytest.approx(0, abs=1e-10)
    assert point.cycle.stick_durations[1] > 0.5 and point.multiplier == 0


@pytest.mark.slow(first=True)
def test_grazing_that_the_paper_does_not_list():
    """Just below nu0 = 0 the cycle sticks to belt 0 only; belt 1 comes at a grazing point."""
    point = jb.refine(jb.GrazingSliding(1), class_b(-0.06), where=nu0)
    expected = oracle_cycles.grazing(lambda nu: oracle.class_b(nu, 0.35), (-0.09, -0.06), 1)
    assert point.value == pytest.approx(expected, abs=1e-10)


def other_system():
    """Every parameter away from the paper's, the belts unlike each other."""
    frictions = (jb.Conti(1.05, 0.62, 9.0, 0.02), jb.Conti(0.98, 0.6, 11.0))
    belts = (jb.Belt(0.5, frictions[0], load=0.95), jb.Belt(0.4, frictions[1], load=1.1))
    return jb.Oscillator(0.52, belts, omega=1.1)


def other_oracle(nu):
    def belt(velocity, load, *law):
        mu, static = oracle.conti(*law)
        return oracle.Belt(velocity, mu, static, load)

    belts = (belt(nu, 0.95, 1.05, 0.62, 9.0, 0.02), belt(0.4, 1.1, 0.98, 0.6, 11.0))
    return oracle.Oscillator(0.52, belts, 1.1)


def at_nu0(osc, nu):
    return jb.Oscillator(
        osc.damping,
        (jb.Belt(nu, osc.belts[0].friction, osc.belts[0].load), osc.belts[1]),
        osc.omega,
    )


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(("guess", "exact"), [(0.23, (np.sqrt(8) - 1) / 10), (0.25, 0.3)])
def test_the_nearer_of_two_fixed_points_that_change(guess, exact):
    """One on either side of an edge beyond which friction is twice as strong."""
    law = jb.Conti(1.0, 0.6, 10.0)

    def make(nu):
        return jb.Oscillator(0.5, (jb.Belt(nu, law), jb.Belt(nu, law, lower=1.0)))

    point = jb.refine(jb.Hopf(), make, at=guess)
    assert point.value == pytest.approx(exact, abs=1e-13)
    assert (float(point.x1) > 1.0) == (exact == 0.3)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("belt", [0, 1])
def test_grazing_on_either_of_two_belts_that_share_the_load_of_one(belt):
    def make(nu):
        half = jb.Belt(nu, jb.presets.class_a(0.2).belts[0].friction, load=0.5)
        return jb.Oscillator(0.5, (half, half, class_b(nu).belts[1]))

    point = jb.refine(jb.GrazingSliding(belt), make, at=-0.44)
    assert point.status == Status.OK
    assert point.value == pytest.approx(-0.455724862289, abs=1e-11)


@pytest.mark.slow(first=True)
def test_a_belt_that_does_not_touch_where_another_is_crossed_has_no_part_in_it():
    """They run at one velocity, and the cycle sticks to both; it crosses the boundary of belt 0
    where belt 1 does not touch."""
    law = jb.Conti(1.0, 0.6, 10.0)

    def make(load):
        belts = jb.Belt(0.6, law, load=load), jb.Belt(0.6, law, load=1.5, lower=0.4)
        return jb.Oscillator(0.02, belts)

    point = jb.refine(jb.CrossingSliding(0), make, at=0.14)
    assert point.value == pytest.approx(0.144938215991, abs=1e-10)
    assert jb.refine(jb.CrossingSliding(1), make, at=0.14).status != Status.OK


@pytest.mark.slow(first=True)
def test_points_of_another_system():
    osc = other_system()
    hopf = jb.refine(jb.Hopf(), osc, where=nu0)
    value = float(hopf.value)
    expected = oracle_cycles.hopf(other_oracle, (value - 0.02, value + 0.02))
    assert value == pytest.approx(expected, abs=1e-10)
    fold = jb.refine(jb.NonsmoothFold(1), at_nu0(osc, 0.5), where=nu0)
    assert fold.status == Status.OK, fold
    expected = oracle_cycles.nonsmooth_fold(
        other_oracle, (float(fold.value) - 0.01, float(fold.value) + 0.01), 1
    )
    assert fold.value == pytest.approx(expected, abs=1e-9)


@pytest.mark.slow(first=True)
def test_a_law_with_a_jump():
    """The stick phase at the tangency has a duration; beyond, the cycle is gone."""

    def make(nu):
        return oracle.Oscillator(0.05, (oracle.Belt(nu, lambda r: 0.7, 1.0, 1.0),), 1.0)

    osc = jb.Oscillator(0.05, (jb.Belt(0.45, jb.Coulomb(1.0, 0.7)),))
    point = jb.refine(jb.NonsmoothFold(0), osc, where=nu0)
    expected = oracle_cycles.nonsmooth_fold(make, (0.45, 0.55), 0)
    assert point.value == pytest.approx(expected, abs=1e-10)
    assert point.multiplier == jnp.inf and jb.stick_duration(point.cycle) > 0.5
    assert oracle_cycles.sticking_cycle(make(expected - 1e-6)) is not None
    assert oracle_cycles.sticking_cycle(make(expected + 1e-6)) is None


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("condition", "nu", "status"),
    [
        (jb.GrazingSliding(0), 0.52, Status.NOT_TOUCHED),
        (jb.GrazingSliding(1), 0.52, Status.OTHER_KIND),
        (jb.NonsmoothFold(0), -0.45, Status.OTHER_KIND),
        (jb.SlidingExchange((0, 1)), 0.6, Status.NOT_TOUCHED),
        (jb.SuddenSliding(1), 0.3, Status.NO_CONVERGENCE),
    ],
)
def test_a_guess_that_fits_no_such_point_is_told_so(condition, nu, status):
    point = jb.refine(condition, class_b(nu), where=nu0)
    assert point.status == status
    assert jnp.isnan(point.value) and jb.describe(status) in repr(point)
    # Who knows more of it is told, too.
    assert "jb.scan with a span" in repr(point)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("offset", [-0.03, -0.004, 0.004, 0.03])
def test_a_fold_from_where_newtons_method_alone_does_not_find_it(offset):
    law = jb.Conti(1.0, 0.6, 10.0)

    def make(nu):
        return jb.Oscillator(0.5, (jb.Belt(nu, law, 0.8), jb.Belt(0.5, law, 0.8)), 1.3)

    def other(nu):
        mu, static = oracle.conti(1.0, 0.6, 10.0)
        belts = (oracle.Belt(nu, mu, static, 0.8), oracle.Belt(0.5, mu, static, 0.8))
        return oracle.Oscillator(0.5, belts, 1.3)

    expected = oracle_cycles.nonsmooth_fold(other, (0.4826, 0.4828), 0)
    point = jb.refine(jb.NonsmoothFold(0), make(expected + offset), where=nu0)
    assert point.status == Status.OK and point.kind == "NonsmoothFold"
    assert point.value == pytest.approx(expected, abs=1e-10)
    assert abs(point.value - expected) <= point.error + 1e-11


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("offset", [-0.03, -1e-3, 1e-3, 0.03])
def test_grazing_from_where_newtons_method_alone_does_not_find_it(offset):
    """A thousandth from where belt 0 is at rest, beyond which there is no such cycle."""

    def other(nu):
        (mu, static), (mu1, static1) = oracle.conti(1.0, 0.6, 8.0), oracle.conti(1.1, 0.6, 12.0)
        belts = (oracle.Belt(nu, mu, static, 1.0), oracle.Belt(0.3, mu1, static1, 1.0))
        return oracle.Oscillator(0.4, belts, 1.0)

    expected = oracle_cycles.grazing(other, (-0.002, -0.001), 1)
    belts = jb.Belt(expected + offset, jb.Conti(1, 0.6, 8)), jb.Belt(0.3, jb.Conti(1.1, 0.6, 12))
    point = jb.refine(jb.GrazingSliding(1), jb.Oscillator(0.4, belts), where=nu0)
    assert point.status == Status.OK and point.condition == jb.GrazingSliding(1)
    # The cycle takes long to leave belt 0: the error of the integration grows on the way.
    assert abs(point.value - expected) <= point.error + 1e-11 < 1e-8


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("nu", [0.483, 0.4867, 0.52])
def test_fold_of_cycles(nu):
    """Two cycles that do not stick meet; from guesses on either side, up to 0.02 away."""
    point = jb.refine(jb.FoldOfCycles(), jb.Oscillator(0.4, (jb.Belt(nu, BELL),)), where=nu0)

    def make(nu):
        return oracle.Oscillator(0.4, (oracle.Belt(nu, bell, 1.0, 1.0),), 1.0)

    expected = oracle_cycles.fold_of_cycles(make, (0.49, 0.503), (0.2, 0.8))
    # The oracle's largest value is good to 1e-14, its slope by nu is about 4.
    assert point.value == pytest.approx(expected, abs=1e-11)
    assert point.residual < 1e-11 and point.iterations <= 8
    assert point.cycle.multiplier == pytest.approx(1, abs=1e-10)
    assert point.cycle.signature == ()


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("short", [1e-2, 1e-3])
def test_fold_of_small_cycles(short):
    """For damping 0.5 and nu 0.4 the Hopf point is degenerate. For less damping the fold
    is at 1.44 times the square of the difference from the Hopf point, the amplitude like its root.
    """
    osc = jb.Oscillator(0.5 - short, (jb.Belt(0.4 + 0.8 * short, BELL),))
    hopf = jb.refine(jb.Hopf(), osc, where=nu0).oscillator

    def make(nu):
        return oracle.Oscillator(0.5 - short, (oracle.Belt(nu, bell, 1.0, 1.0),), 1.0)

    start, away = nu0(hopf), 1.44 * short**2
    amplitude = 0.88 * np.sqrt(short)
    expected = oracle_cycles.fold_of_cycles(
        make, (start + 0.9 * away, start + 1.1 * away), (0.5 * amplitude, 2 * amplitude)
    )
    for offset in (-1.0, 0.0, 0.3, 2.0, 3.0):
        osc = jb.Oscillator(0.5 - short, (jb.Belt(start + offset * away, BELL),))
        point = jb.refine(jb.FoldOfCycles(), osc, where=nu0)
        # The oracle's loops are good to 1e-13, relative to the amplitude.
        assert point.value == pytest.approx(expected, abs=1e-11) and point.error < 1e-11
        assert point.residual < 1e-11
        assert point.cycle.x1_max - point.cycle.x1_min == pytest.approx(2 * amplitude, rel=0.05)


@pytest.mark.slow(first=True)
def test_a_hopf_point_is_no_fold_of_cycles():
    # More damping than at the degenerate Hopf point of the test above.
    point = jb.refine(jb.FoldOfCycles(), jb.Oscillator(0.55, (jb.Belt(0.35, BELL),)), where=nu0)
    assert point.status == Status.NO_FOLD and jnp.isnan(point.value)
    assert "value nan, NO_FOLD: " in repr(point)


@pytest.mark.slow(first=True)
def test_convergence_is_quadratic():
    """Each Newton step is about the square of the one before, until rounding ends it."""
    point = jb.refine(jb.NonsmoothFold(0), jb.presets.class_a(0.28), where=nu0)
    steps = np.asarray(point.steps[: int(point.iterations)])
    fast = steps[steps < 0.1]
    assert len(fast) >= 3
    assert np.all(fast[1:] <= np.maximum(20 * fast[:-1] ** 2, 1e-12))


@pytest.mark.slow(first=True)
def test_a_batch_of_hopf_points_and_the_slope_of_their_curve():
    """Of class (a), 1 + p3 nu = sqrt(p3 (mus - p1)/zeta). With more damping than friction can undo
    there is none: NaN, and so is its derivative."""

    def value(zeta):
        osc = jb.Oscillator(zeta, (jb.Belt(0.2, jb.Conti(1.0, 0.6, 10.0)),))
        return jb.refine(jb.Hopf(), osc, where=nu0).value

    zetas = jnp.array([0.45, 0.5, 0.55, 5.0])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(value)))(zetas)
    assert jnp.isnan(values[3]) and jnp.isnan(slopes[3])
    zetas, values, slopes = (numbers[:3] for numbers in (zetas, values, slopes))
    np.testing.assert_allclose(values, (2 / np.sqrt(zetas) - 1) / 10, atol=1e-14)
    np.testing.assert_allclose(slopes, -0.1 * zetas**-1.5, rtol=1e-12)


@pytest.mark.slow
def test_the_second_derivative_of_a_hopf_point():
    """By implicit differentiation twice; of the closed form of the test above."""

    def value(zeta):
        osc = jb.Oscillator(zeta, (jb.Belt(0.2, jb.Conti(1.0, 0.6, 10.0)),))
        return jb.refine(jb.Hopf(), osc, where=nu0).value

    bend = jax.jit(jax.jacfwd(jax.grad(value)))(0.5)
    # Rounding of the point, some 1e-16, times the third derivative over the first.
    assert bend == pytest.approx(0.15 * 0.5**-2.5, rel=1e-12)


@pytest.mark.slow
def test_a_batch_of_folds_and_the_slope_of_their_curve():
    def fold(nu1):
        osc = jb.presets.class_b(0.53 - 2.4 * (nu1 - 0.35), nu1)
        return jb.refine(jb.NonsmoothFold(1), osc, where=nu0, max_arcs=8)

    nu1s = jnp.linspace(0.345, 0.355, 5)

    def value(nu1):
        point = fold(nu1)
        return point.value, point

    # One program gives the points, and the slope of the curve by the implicit function theorem, in
    # reverse.
    slopes, points = jax.jit(jax.vmap(jax.grad(value, has_aux=True)))(nu1s)
    assert points.status.tolist() == [Status.OK] * 5
    expected = oracle_cycles.nonsmooth_fold(
        lambda nu: oracle.class_b(nu, float(nu1s[1])), (0.53, 0.56), 1
    )
    assert points.value[1] == pytest.approx(expected, abs=1e-10)
    difference, _ = oracle.richardson(
        lambda nu1: oracle_cycles.nonsmooth_fold(
            lambda nu: oracle.class_b(nu, nu1), (0.5, 0.58), 1
        ),
        0.35,
        2e-3,
    )
    assert nu1s[2] == 0.35
    assert slopes[2] == pytest.approx(difference, rel=1e-7)


@pytest.mark.slow(first=True)
def test_the_nearer_of_two_to_which_a_cycle_grazes():
    """Newton's method makes a long first step from there, and ends in the farther one."""

    def make(nu):
        belts = (
            jb.Belt(-0.9, jb.Stribeck(0.5, 0.4, 0.15), load=2.0, upper=0.8),
            jb.Belt(nu, jb.Conti(1.0, 0.6, 10.0), load=1.5),
        )
        return jb.Oscillator(0.05, belts, omega=0.5)

    near, far = jb.scan(make, span=(0.99, 1.01), resolution=8)
    assert near.kind == far.kind == "GrazingSliding" and far.value - near.value > 8e-3
    for guess in (0.9969278, 0.9985):
        assert jb.refine(near.condition, make, at=guess).value == pytest.approx(float(near.value))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("offset", [-0.03, -1e-3, 1e-3, 0.03])
@pytest.mark.parametrize(("steepness", "damping"), [(30.0, 0.5), (100.0, 0.3), (100.0, 0.5)])
def test_grazing_beside_a_belt_that_hardly_moves(steepness, damping, offset):
    """Under a steep law eight steps an arc left 1e-8 in the equations, and the point off by 1e-6;
    from 0.03 away none was found."""
    law, slow = jb.Conti(1.0, 0.6, steepness), 1e-4

    def make(nu):
        return jb.Oscillator(damping, (jb.Belt(slow, law), jb.Belt(nu, law, load=0.8)))

    def gap(nu):
        mu, static = oracle.conti(1.0, 0.6, steepness)
        belts = oracle.Belt(slow, mu, static, 1.0), oracle.Belt(nu, mu, static, 0.8)
        osc = oracle.Oscillator(damping, belts, 1.0)
        # Not so far beyond the boundary as the pole of the law is.
        return oracle_cycles.gap(osc, 0, 1, slack=0.2 / steepness)

    expected = brentq(gap, -0.365, -0.315, xtol=1e-15)
    point = jb.refine(jb.GrazingSliding(1), make, at=expected + offset)
    assert point.status == Status.OK and point.error < 1e-11
    # The oracle's orbit is good to 1e-13; on the way from the belt errors grow some tenfold.
    assert abs(point.value - expected) <= point.error + 1e-12


@pytest.mark.slow(first=True)
def test_the_nearest_point_and_not_one_to_which_another_within_reach_leads():
    """Beside the guess an equilibrium comes to the edge. From there, as from the guess, Newton's
    method leads to where a cycle touches the edge 0.43 farther off."""
    laws = jb.Conti(1.0, 0.5225, 5.697), jb.Conti(1.0666, 0.6, 8.479)

    def make(edge):
        belts = jb.Belt(-3.75e-4, laws[0], 0.7885, upper=edge), jb.Belt(5.62e-3, laws[1], 0.9203)
        return jb.Oscillator(0.3879, belts)

    near, far = (one for one in jb.scan(make, span=(0.1, 0.7)) if one.kind == "GrazingEdge")
    guess = float(near.value) - 0.03
    assert far.value - guess > 0.4
    point = jb.refine(jb.GrazingEdge(0), make, at=guess)
    assert point.value == pytest.approx(float(near.value), abs=1e-10)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("guess", [0.9516398, 0.9716398])
def test_the_nearer_of_two_folds_of_cycles_from_both_mirror_images(guess):
    """The other one is at 0.98210; from 0.97164 it is farther by 5e-4 only."""

    def law(static):
        return jb.Conti(static, 0.4, 2.0)

    def make(static):
        belts = jb.Belt(0.35, law(static), upper=0.2), jb.Belt(-1.15, law(1.0), lower=-0.6)
        return jb.Oscillator(0.5, belts)

    def image(static):
        belts = jb.Belt(1.15, law(1.0), upper=0.6), jb.Belt(-0.35, law(static), lower=-0.2)
        return jb.Oscillator(0.5, belts)

    values = [float(jb.refine(jb.FoldOfCycles(), one, at=guess).value) for one in (make, image)]
    assert values[0] == pytest.approx(values[1], abs=1e-10)
    assert values[0] == pytest.approx(0.96163983088, abs=1e-10)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("mirrored", [False, True])
def test_grazing_of_either_of_two_belts_of_one_velocity(mirrored):
    """The search beside a guess tells the first of them, and is asked for the second in the mirror
    image; Newton's method alone leads there to a point twenty times as far."""
    paper = jb.Conti(1.0, 0.6, 10.0)

    def make(residual):
        law = jb.Conti(1.0, residual, 10.0)
        belts = (
            jb.Belt(-1.0, law, upper=0.65),
            jb.Belt(-1.0, paper, lower=-0.85),
            jb.Belt(0.55, paper, 2.0, lower=-0.85, upper=0.65),
        )
        if mirrored:
            belts = tuple(
                jb.Belt(-b.velocity, b.friction, b.load, lower=-b.upper, upper=-b.lower)
                for b in reversed(belts)
            )
        return jb.Oscillator(0.2, belts)

    point = jb.refine(jb.GrazingSliding(2 if mirrored else 0), make, at=0.705676900485494)
    assert float(point.value) == pytest.approx(0.695676900485494, abs=1e-10)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("scale", [0.0042])
def test_a_fold_of_a_law_with_a_narrow_layer(scale):
    """The layer holds the orbit until it comes to slip onset: forwards no number leads there."""
    law, (mu, static) = peak(1.5, 1.0, scale, 0.28)

    def least_x1(nu, way):
        """Of the orbit from slip onset, or backwards from there."""

        def field(_, y):
            return way * y[1], way * (mu(nu - y[1]) - y[0])

        def bottom(_, y):
            return y[1]

        bottom.direction, bottom.terminal = way, True
        # By a method for stiff equations, which stays in the layer.
        options = dict(method="LSODA", rtol=1e-12, atol=1e-13, events=bottom)
        return solve_ivp(field, (0, 9), (static, nu), **options).y_events[0][0][0]

    value = brentq(lambda nu: least_x1(nu, 1) - least_x1(nu, -1), 0.262, 0.282, xtol=1e-12)

    def make(nu):
        return jb.Oscillator(0.0, (jb.Belt(nu, law),))

    point = jb.refine(jb.NonsmoothFold(0), make, at=0.266)
    assert point.status == Status.OK
    assert point.value == pytest.approx(value, abs=1e-9)


# --- cycles that come from infinity: by the energy of large loops ---------------------------------


PAPER = jb.Conti(1.0, 0.6, 10.0)
QUADRATIC = jb.Conti(1.0, 0.6, 10.0, 0.05)
AT_INFINITY = jb.HopfAtInfinity()


class Viscous(jb.AbstractFriction):
    """mu(r) = static + slope r."""

    static: float
    slope: float

    def mu(self, speed):
        """Kinetic friction coefficient."""
        return self.static + self.slope * speed


class Root(jb.AbstractFriction):
    """mu(r) = static + slope sqrt(1 + r)."""

    static: float
    slope: float

    def mu(self, speed):
        """Kinetic friction coefficient."""
        return self.static + self.slope * (jnp.sqrt(1 + speed) - 1)


def one_belt(damping, law=PAPER, omega=1.0, **changes):
    return jb.Oscillator(damping, (jb.Belt(0.3, law, **changes),), omega=omega)


@FIRST
def test_a_cycle_comes_from_infinity_without_damping():
    point = jb.refine(AT_INFINITY, one_belt, at=-0.1)
    assert point.status == Status.OK and point.value == 0
    assert point.cycle.status == Status.NOT_FINITE
    (found,) = jb.scan(one_belt, span=(-0.2, 0.15), resolution=8)
    assert found.condition == AT_INFINITY and found.value == 0
    assert jb.scan(one_belt, span=(0.02, 0.15), resolution=8) == ()


@pytest.mark.parametrize(
    ("law", "omega", "changes", "at"),
    [
        # Energy of a loop x2 = A cos t: of a belt that is passed at |x2| = A, twice.
        (
            jb.Conti(1.0, 0.6, 10.0, 0.05),
            1.0,
            {"lower": -1.0, "upper": 1.5},
            -2 / np.pi * 0.05 * 2.5,
        ),
        pytest.param(
            jb.Conti(1.0, 0.6, 10.0, 0.05),
            0.5,
            {"lower": 0.0, "upper": 2.0},
            -2 / np.pi * 0.0125 * 2,
            marks=FIRST,
        ),
        pytest.param(*(Viscous(1.0, 0.02), 1.0, {"load": 2.0}, -0.04), marks=pytest.mark.slow),
        pytest.param(*(Viscous(1.0, 0.02), 0.5, {"lower": 0.4}, -0.005), marks=pytest.mark.slow),
        pytest.param(
            *(Viscous(1.0, 0.02), 1.0, {"lower": 0.4, "upper": 2.0}, 0.0), marks=pytest.mark.slow
        ),
    ],
)
def test_a_cycle_comes_from_infinity_with_friction_that_grows(law, omega, changes, at):
    def make(damping):
        return one_belt(damping, law, omega, **changes)

    point = jb.refine(AT_INFINITY, make, at=-0.1)
    assert point.status == Status.OK and point.value == pytest.approx(at, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "amplitude"),
    [
        # Twice the friction force, both ways, over pi times the damping.
        ({}, lambda away: 4 * 0.6 / (np.pi * away)),
        ({"lower": 0.4}, lambda away: 2 * 0.6 / (np.pi * away)),
        # The remainder of the energy of a short contact, 2 u0 p1 times its length.
        ({"lower": -0.5, "upper": 1.0}, lambda away: np.sqrt(2 * 1.5 * 0.6 / (np.pi * away))),
    ],
)
def test_the_amplitude_of_what_comes_from_infinity_goes_there(changes, amplitude):
    for away, error in ((0.01, 0.05), (0.0025, 0.02)):
        portrait = jb.portrait(one_belt(-away, **changes))
        outermost = max(portrait.unstable, key=jb.amplitude)
        assert jb.amplitude(outermost) == pytest.approx(amplitude(away), rel=error)
    assert jb.portrait(one_belt(0.0025, **changes)).unstable == ()


@FIRST
def test_nothing_comes_from_infinity():
    """Friction that grows without bounds, as r^2 and to all sides; and none at all."""
    point = jb.refine(AT_INFINITY, lambda damping: one_belt(damping, QUADRATIC), at=-0.1)
    assert point.status != Status.OK and jnp.isnan(point.value)
    point = jb.refine(AT_INFINITY, lambda damping: one_belt(damping, load=0.0), at=-0.1)
    assert point.status == Status.NOT_TOUCHED


@pytest.mark.slow
def test_growth_at_infinity_that_is_not_told():
    """What grows neither as r nor as r^2; and a scan where nothing comes from infinity."""
    point = jb.refine(AT_INFINITY, lambda damping: one_belt(damping, Root(1.0, 0.1)), at=-0.1)
    assert point.status == Status.NOT_TOUCHED
    assert jb.scan(lambda d: one_belt(d, QUADRATIC), span=(-0.2, 0.15), resolution=8) == ()


@pytest.mark.slow(first=True)
def test_derivative_of_a_point_at_infinity():
    """Of the damping at which it happens by the quadratic coefficient, in closed form."""

    def value(p2):
        law = jb.Conti(1.0, 0.6, 10.0, p2)
        make = lambda damping: one_belt(damping, law, lower=-1.0, upper=1.5)  # noqa: E731
        return jb.refine(AT_INFINITY, make, at=-0.1).value

    assert jax.grad(value)(0.05) == pytest.approx(-5 / np.pi, abs=1e-9)
