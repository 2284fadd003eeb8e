"""Portraits: closed forms, published values, SciPy backwards in time, and the independent engine.

The campaign is `python -m tests.campaign portraits`; what it found is in docs/checked.md.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
import scipy.linalg
from scipy.integrate import solve_ivp

import jaxbelt as jb
from jaxbelt.cycles.outlines import OpenOutline
from jaxbelt.cycles.returns import _next_tops
from jaxbelt.motion.arcs import Ends
from tests.campaign import engine, package, portraits
from tests.campaign.cases import PAPER

#: Two attracting cycles with one sequence of events, around two of three foci.
TWO_CYCLES = (-0.06341, 0.5073, -0.49694, 0.61855)


def engine_class_d(nu0, nu1, sigma0, sigma1, damping=0.5) -> engine.Oscillator:
    belts = (
        engine.Belt(nu0, PAPER, 1.0, -np.inf, sigma1),
        engine.Belt(nu1, PAPER, 1.0, sigma0, np.inf),
    )
    return engine.Oscillator(damping, belts)


@pytest.fixture(scope="module")
def class_d() -> jb.Portrait:
    return jb.portrait(jb.presets.class_d(*TWO_CYCLES))


@pytest.mark.slow(first=True)
def test_attractors_are_told_apart_by_where_they_are(class_d):
    assert int(class_d.status) == jb.Status.OK and not len(class_d.gaps)
    left, right = class_d.cycles
    assert left.signature == right.signature
    # The periods are those of another program's cycles, to all the digits that it gave.
    assert float(left.period) == pytest.approx(9.9148027860, abs=1e-9)
    assert float(right.period) == pytest.approx(10.9019400715, abs=1e-9)
    assert class_d.unstable == () and not class_d.escapes


@pytest.mark.slow(first=True)
def test_saddles_and_their_separatrices(class_d):
    kinds = [jb.EquilibriumKind(int(kind)).name for kind in class_d.equilibria.kind]
    assert kinds == ["FIXED_POINT", "SADDLE", "FIXED_POINT", "SADDLE", "FIXED_POINT"]
    points = [tuple(np.asarray(one.point)) for one in class_d.separatrices]
    assert points == [(-0.49694, 0.0)] * 4 + [(0.61855, 0.0)] * 4
    ends = {(one.point[0].item(), one.side, one.end, one.to) for one in class_d.separatrices}
    assert (-0.49694, "left", "cycle", 0) in ends and (-0.49694, "right", "cycle", 1) in ends
    for one in class_d.separatrices:
        place = -1 if one.stable else 0
        assert one.ts[place] == 0 and tuple(np.asarray(one.ys)[place]) == tuple(one.point)
        assert np.all(np.diff(one.ts) >= 0)


@pytest.mark.slow(first=True)
def test_separatrices_are_orbits_to_1e_9(class_d):
    """The engine, from samples some loops before the saddle, comes to it; forwards it follows."""
    osc = engine_class_d(*TWO_CYCLES)
    for one in class_d.separatrices:
        ts, ys = np.asarray(one.ts), np.asarray(one.ys)
        if one.stable:
            # Errors grow backwards like exp(damping/2 time) or less, and shrink as much forwards.
            start = np.searchsorted(ts, -6.0)
            run = engine.simulate(osc, ys[start], -ts[start], capture=False)
            assert np.abs(np.array(run.y_end) - ys[-1]).max() < 1e-9
        else:
            i = np.searchsorted(ts, 3.0)
            start = (np.nextafter(ys[0, 0], -9 if one.side == "left" else 9), 0.0)
            run = engine.simulate(osc, start, ts[i], capture=False)
            assert np.abs(np.array(run.y_end) - ys[i]).max() < 1e-9


@pytest.mark.slow(first=True)
def test_table_and_text_tell_everything(class_d):
    rows = class_d.table().to_dict("records")
    assert [row["what"] for row in rows] == ["equilibrium"] * 5 + ["cycle"] * 2 + ["separatrix"] * 8
    assert rows[1]["kind"] == "SADDLE" and not rows[1]["stable"] and rows[1]["rate"] == np.inf
    assert rows[5]["period"] == float(class_d.cycles[0].period)
    text = repr(class_d)
    assert "2 attracting and 0 unstable cycles, 8 separatrices" in text and "SADDLE" in text


@pytest.mark.slow(first=True)
def test_picture_shows_everything(class_d):
    ax = class_d.plot()
    labels = [line.get_label() for line in ax.get_lines()]
    assert labels.count("stable cycle") == 2 and labels.count("saddle") == 2
    assert labels.count("stable separatrix") == labels.count("unstable separatrix") == 4


def test_bad_arguments_are_refused_by_name():
    with pytest.raises(ValueError, match="damping must be finite"):
        jb.portrait(eqx.tree_at(lambda o: o.damping, jb.presets.class_a(0.3), jnp.array(jnp.nan)))
    with pytest.raises(ValueError, match="osc must be known"):
        jax.jit(lambda nu: jb.portrait(jb.presets.class_b(nu, 0.35)).reach)(0.2)


def test_saddle_is_an_equilibrium_where_nothing_rests():
    """Class (c): a_L = 0.7 nu-pull - sigma and so on, with mu(0.3) = 0.7."""
    osc = jb.presets.class_c(-0.3, 0.3, -0.2)
    points = jb.equilibria(osc)
    assert [int(kind) for kind in points.kind] == [1, jb.EquilibriumKind.SADDLE, 1]
    assert np.asarray(points.x1) == pytest.approx([-0.7, -0.2, 0.7], abs=1e-15)
    assert points.stable.tolist() == [True, False, True] and points.rate[1] == np.inf
    # Only where the edge pushes away to both sides.
    assert not np.any(jb.equilibria(jb.presets.class_c(-0.3, 0.3, 0.8)).kind == 4)


@pytest.mark.slow(first=True)
def test_friction_that_grows_holds_a_cycle_far_out():
    """Friction that grows as the square of the speed outweighs negative damping: nothing goes to
    infinity, and a cycle attracts what does without that growth."""
    damping, velocity, law = -0.1, 0.3, (1.0, 0.6, 10.0, 0.01)
    osc = jb.Oscillator(damping, (jb.Belt(velocity, jb.Conti(*law), lower=1.0),))
    found = jb.portrait(osc)
    assert found.status == jb.Status.OK and not found.escapes
    near, far = found.cycles
    assert len(found.unstable) == 1
    assert float(far.x1_max) > 10 * float(near.x1_max) and found.reach > float(far.x1_max)
    mus, p1, p3, p2 = law
    belt = oracle.Belt(velocity, *oracle.conti(mus, p1, p3, p2), lower=1.0)
    other = oracle.Oscillator(damping, (belt,))
    for cycle in (near, far, *found.unstable):
        top = float(cycle.x1_max)
        once = oracle.simulate(other, (top, 0.0), float(cycle.period))
        # Cycles are solved to 1e-10 of their size.
        assert once.y_end == pytest.approx((top, 0.0), abs=1e-9 * top)
    # From farther out loops shrink.
    assert oracle.simulate(other, (60.0, 0.0), float(far.period)).y_end[0] < 59.0


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("damping", "quadratic", "lower"), [(-0.1, 1e-6, 1.0), (-1e-5, 0.0, -np.inf)], ids=["in", "out"]
)
def test_a_cycle_beyond_all_that_is_looked_at_is_told_as_a_gap(damping, quadratic, lower):
    """One attracts, of amplitude 2e5, in inverse proportion to the coefficient; the other, of
    amplitude 4/pi 0.6/1e-5 = 7.6e4, is the bound of what goes to infinity."""
    law = jb.Conti(1.0, 0.6, 10.0, quadratic)
    found = jb.portrait(jb.Oscillator(damping, (jb.Belt(0.3, law, lower=lower),)))
    assert found.status == jb.Status.INCOMPLETE and not found.escapes
    assert found.gaps[-1].tolist() == [found.reach, np.inf]


# --- slow: other programs, the engine ---------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("zeta", "amplitude"), [(-0.1, 7.739495458), (-0.2, 3.917652434)])
def test_unstable_cycle_that_bounds_what_goes_to_infinity(zeta, amplitude):
    osc = jb.Oscillator(zeta, jb.presets.class_a(0.3).belts)
    found = jb.portrait(osc)
    (cycle,) = found.unstable
    assert found.escapes and float(jb.amplitude(cycle)) == pytest.approx(amplitude, abs=1e-9)
    # Backwards it attracts: SciPy, from a tenth farther in, and out.
    for start in (0.9, 1.1):
        top = _top_backwards(zeta, start * float(cycle.x1_max), loops=90)
        assert top == pytest.approx(float(cycle.x1_max), abs=1e-9)


def _top_backwards(zeta: float, x1: float, loops: int) -> float:
    """x1 of the top after so many loops of class (a) at nu0 = 0.3 in reversed time, none of which
    meets the boundary where it sticks; v = -x2."""
    mu = oracle.conti(1.0, 0.6, 10.0)[0]

    def turns(t, y):
        return y[1]

    def meets(t, y):
        return y[1] + 0.3

    y, tops = [x1, 0.0], 0
    while tops < loops:
        # r = 0.3 + v; what is beyond a zero of v or r is the next piece.
        v_sign = np.sign(y[1]) or -np.sign(y[0])
        sign = 1.0 if y[1] > -0.3 or (y[1] == -0.3 and y[0] < 0) else -1.0
        turns.terminal = meets.terminal = True
        turns.direction, meets.direction = -v_sign, -sign

        def field(t, y, sign=sign):
            return y[1], -y[0] + zeta * y[1] + sign * mu(sign * (0.3 + y[1]))

        run = solve_ivp(field, (0, 50), y, "DOP853", rtol=1e-13, atol=1e-13, events=(turns, meets))
        y = run.y[:, -1].tolist()
        if run.t_events[0].size:
            y[1] = 0.0
            tops += v_sign > 0
        else:
            y[1] = -0.3
    return y[0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", portraits.KINDS)
def test_portraits_are_the_engines(kind):
    """Attractors from 121 starts; curves between neighbours that lead to different ones."""
    rng = np.random.default_rng(portraits.KINDS.index(kind))
    done = 0
    while done < 4:
        what, osc = portraits.random_oscillator(rng)
        if what == kind:
            done += 1
            wrong, _ = portraits.differences(osc, jb.portrait(package.oscillator(osc)))
            assert wrong == []


@pytest.mark.slow
def test_orbits_that_touch_a_boundary_with_a_jump_bound_basins():
    """Coulomb's law with a static limit above the kinetic one."""
    law = ("coulomb", 1.2, 0.6)
    osc = engine.Oscillator(
        0.25,
        (
            engine.Belt(0.2, law, 1.5, -np.inf, -1.4),
            engine.Belt(-0.2, ("coulomb", 1.0, 0.5), 1.5, -1.4, np.inf),
        ),
        0.5,
    )
    told = jb.portrait(package.oscillator(osc))
    (one,) = told.separatrices
    # needed = -x1 - zeta x2 balances the kinetic friction, -u0 0.5, at x2 = nu/omega.
    assert np.asarray(one.point) == pytest.approx([-0.75 + 0.1, -0.4], abs=1e-14)
    assert portraits.differences(osc, told)[0] == []


@pytest.mark.parametrize(
    "sign",
    [
        pytest.param(1.0, marks=pytest.mark.slow(first=True)),
        pytest.param(-1.0, marks=pytest.mark.slow),
    ],
)
def test_an_edge_cuts_off_what_only_the_static_limit_holds(sign):
    """Found by a campaign: the orbit that comes to the corner of edge and boundary, above which the
    mass comes to be held and below which it slips away, bounds basins."""

    def between(*ends):
        return sorted(sign * end for end in ends)

    laws = ("coulomb", 1.2, 0.72), ("coulomb", 0.5, 0.3)
    belts = (
        engine.Belt(-0.65 * sign, laws[0], 2.0, *between(-np.inf, -0.55)),
        engine.Belt(0.85 * sign, laws[1], 2.0, *between(-0.9, np.inf)),
    )
    osc = engine.Oscillator(0.5, belts, 2.0)
    told = jb.portrait(package.oscillator(osc))
    assert portraits.differences(osc, told)[0] == []
    corner = (-0.9 * sign, 0.425 * sign)
    (one,) = [one for one in told.separatrices if tuple(np.asarray(one.point)) == corner]
    assert one.stable and one.end == "outside"
    # As shocks follow it, backwards from its point.
    pieces = OpenOutline.of(told.oscillator, one).pieces(told.oscillator)
    np.testing.assert_array_equal(pieces.entries[0], [corner[0], -corner[1]])


@pytest.mark.slow(first=True)
def test_cycle_whose_multiplier_is_1e20_is_solved_for_backwards():
    """It passes along the boundary of a slow belt. Starts on its two sides go to two cycles."""
    belts = (
        engine.Belt(
            -0.0359699775761,
            ("conti", 1.23834266023, 0.543764190981, 11.4523662569, 0.0985743864923),
            1.52923444492,
            0.68989911476,
            np.inf,
        ),
    )
    osc = engine.Oscillator(-0.368460830234, belts, 0.861998498696)
    told = jb.portrait(package.oscillator(osc))
    (cycle,) = told.unstable
    assert float(cycle.multiplier) > 1e19
    top = float(cycle.x1_max)
    inside, outside = (engine.attractor(osc, (top + d, 0.0)) for d in (-1e-7, 1e-7))
    assert inside.x1[1] < top < outside.x1[1]
    ys = np.asarray(cycle.sample(400))
    assert ys[0] == pytest.approx([top, 0.0], abs=1e-9) and ys[-1] == pytest.approx(ys[0], abs=1e-9)


@pytest.mark.slow
def test_continuum_of_closed_orbits_is_a_gap():
    """Without damping, and with Coulomb's law, all orbits that do not reach the belt are closed."""
    told = jb.portrait(jb.Oscillator(0.0, (jb.Belt(0.4, jb.Coulomb(1.0, 0.6)),)))
    assert int(told.status) == jb.Status.INCOMPLETE
    ((low, high),) = np.asarray(told.gaps)
    # Circles around (0.6, 0) with radii up to 0.4; the one that sticks is from 1.0 onwards.
    assert low == pytest.approx(0.6, abs=1e-3) and high == pytest.approx(1.0, abs=1e-2)


@pytest.mark.slow(first=True)
def test_a_separatrix_that_creeps_to_a_node_comes_from_there():
    """Backwards it comes to the end of the segment that a belt at rest holds, where slip on the
    steep law's boundary is a node with the slow rate 0.065: along the fast one steps are short."""
    law = jb.Conti(static=1.0, residual=0.6, steepness=10.0)
    belts = jb.Belt(0.45, law, 2.0), jb.Belt(0.0, law, 2.0, lower=-2.0225, upper=0.7)
    told = jb.portrait(jb.Oscillator(0.1, belts, 2.0))
    (one,) = (s for s in told.separatrices if s.stable and s.side == "left")
    assert (one.end, one.to) == ("equilibrium", 0)
    assert float(one.ys[0, 0]) == pytest.approx(float(told.equilibria.x1_lower[0]), abs=2e-5)

    def backwards(t, y):
        drag, brake = (2 * (0.4 / (1 + 10 * r) + 0.6) for r in (0.45 - 2 * y[1], 2 * y[1]))
        return [-y[1], y[0] + 0.1 * y[1] - drag + brake]

    ts = -np.asarray(one.ts)[::-1]
    span, tight = (0.0, ts[-1]), {"rtol": 1e-12, "atol": 1e-14}
    run = solve_ivp(backwards, span, [0.7, 0.0], "LSODA", dense_output=True, **tight)
    assert np.max(np.abs(np.asarray(one.ys)[::-1] - run.sol(ts).T)) < 1e-9


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("damping", "numbers", "load", "at"),
    [(1.0, (1.0, 0.6, 10.0), 2.0, 1.4), (0.7, (1.05, 0.63, 14.5), 1.5, 1.45)],
)
def test_long_arcs_are_sampled_by_steps_that_fit(damping, numbers, load, at):
    """Backwards from the edge to the end of the segment in one arc, which is fast beside the edge
    and lasts for many times as long beside the end, where the law is steep."""
    static, residual, steepness = numbers
    law = jb.Conti(static, residual, steepness)
    belts = jb.Belt(0.0, law, load), jb.Belt(1.5, jb.Conti(1.0, 0.6, 10.0), 1.0, lower=-at)
    told = jb.portrait(jb.Oscillator(damping, belts))
    (one,) = (s for s in told.separatrices if s.stable and s.side == "left" and s.end != "outside")
    assert (one.end, one.to) == ("equilibrium", 0)

    def backwards(t, y):
        brake = load * ((static - residual) / (1 + steepness * y[1]) + residual)
        return [-y[1], y[0] + damping * y[1] + brake]

    ts = -np.asarray(one.ts)[::-1]
    span, tight = (0.0, ts[-1]), {"rtol": 1e-12, "atol": 1e-14}
    run = solve_ivp(backwards, span, [-at, 0.0], "LSODA", dense_output=True, **tight)
    assert np.max(np.abs(np.asarray(one.ys)[::-1] - run.sol(ts).T)) < 1e-9


@pytest.mark.slow(first=True)
def test_an_unstable_cycle_that_takes_fine_steps():
    """Far out, where damping is negative: the largest error in the equations of its first loop is
    not one of the steps of integration, others are."""
    law = jb.Conti(1.0, 0.6, 10.0)
    belts = (
        jb.Belt(0.0832138215457, law, upper=0.866285905625),
        jb.Belt(-0.257265751997, law, lower=-0.970587365831),
    )
    told = jb.portrait(jb.Oscillator(-0.137007563083, belts))
    (outer,) = told.unstable
    assert told.status == jb.Status.OK and told.escapes
    # By bisection with the campaigns' engine: from there tops neither rise nor fall.
    assert outer.x1_max == pytest.approx(6.4667377846218, abs=1e-10)


@pytest.mark.slow(first=True)
def test_rounding_beside_an_equilibrium_on_an_edge_is_no_gap():
    """The fixed point lies on the edge, which repels: so near to it rounding says whether loops
    grow."""
    strong, weak = jb.Conti(1.0, 0.6, 10.0), jb.Conti(0.5, 0.3, 10.0)
    belts = jb.Belt(-0.35, strong, lower=-0.55), jb.Belt(-0.15, weak, load=2.0, lower=-0.76)
    found = jb.portrait(jb.Oscillator(0.2, belts))
    assert int(found.status) == jb.Status.OK and not len(found.gaps)
    (cycle,) = found.cycles
    assert not found.unstable and bool(cycle.x1_min < -0.76 < cycle.x1_max)


@pytest.mark.slow(first=True)
def test_a_separatrix_goes_on_outside_where_nothing_ends_its_last_arc():
    """Backwards an overdamped oscillator that no belt touches runs away without another extremum.

    In closed form there: x1'' = -a x1' - x1, from where the separatrix leaves the belts.
    """
    first = jb.Conti(static=0.917545147159, residual=0.488230806572, steepness=3.75629421489)
    second = jb.Conti(static=0.759660614246, residual=0.414325928775, steepness=13.7697254784)
    belts = (
        jb.Belt(1.08317491456, first, 1.34935753813, lower=0.614361589913),
        jb.Belt(0.321723922376, second, 1.03374906374, lower=0.051167768582, upper=0.644035983841),
    )
    osc = jb.Oscillator(2.82868521867, belts, omega=0.908402510527)
    told = jb.portrait(osc)
    assert told.status == jb.Status.OK
    outside = [one for one in told.separatrices if one.end == "outside"]
    assert len(outside) == 4
    for one in outside:
        assert np.max(np.abs(np.asarray(one.ys))) > told.reach
        if one.side == "left":
            ts, ys = np.asarray(one.ts), np.asarray(one.ys)
            free = np.flatnonzero(ys[:, 0] <= float(belts[1].lower))
            field = np.array([[0.0, 1.0], [-1.0, -2.82868521867]])
            for i in free:
                exact = scipy.linalg.expm(field * (ts[i] - ts[free[-1]])) @ ys[free[-1]]
                assert ys[i] == pytest.approx(exact, rel=1e-9)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("beyond", [-1e-9, -1e-15, 0.0, 1e-15, 1e-9])
def test_a_saddle_that_has_met_a_fixed_point_is_none(beyond):
    """They meet on the edge, where rounding has no say; either way one cycle attracts."""
    edge = -0.6 - 0.4 / 6.5 + beyond  # the fixed point, and how far beyond it
    law = jb.Conti(static=1.0, residual=0.6, steepness=10.0)
    belts = jb.Belt(-0.55, law, upper=edge), jb.Belt(0.3, law, lower=edge)
    told = jb.portrait(jb.Oscillator(0.1, belts))
    assert told.status == jb.Status.OK and len(told.cycles) == 1 and not told.unstable
    has_saddle = beyond > 1e-12
    assert (jb.EquilibriumKind.SADDLE in told.equilibria.kind.tolist()) == has_saddle
    assert len(told.separatrices) == 4 * has_saddle


@pytest.mark.slow(first=True)
def test_a_cycle_with_its_top_on_a_belt_at_rest_has_its_multiplier():
    """There the friction of the belt changes its sign, and x2' by a factor."""
    law = ("conti", 0.5, 0.25, 2.0, 0.0)
    edge = 0.85869565217391
    belts = engine.Belt(0.65, law, 1.0, -np.inf, edge), engine.Belt(0.0, law, 1.0, edge, np.inf)
    osc = engine.Oscillator(0.1, belts)
    told = jb.portrait(package.oscillator(osc))
    (cycle,) = told.cycles
    assert told.status == jb.Status.OK and len(told.unstable) == 1
    top, period = float(cycle.x1_max), float(cycle.period)
    assert top > edge

    def top_after(x1):
        run = engine.simulate(osc, (x1, 0.0), 1.5 * period)
        at = (run.t > 0.5 * period) & (np.abs(run.y[:, 1]) < 1e-9) & (run.y[:, 0] > edge)
        return run.y[at, 0][0]

    slope = (top_after(top + 1e-6) - top_after(top - 1e-6)) / 2e-6
    assert float(cycle.multiplier) == pytest.approx(slope, rel=1e-6)
    found = jb.find_cycle(package.oscillator(osc), (3.0, 0.0))
    assert float(found.multiplier) == pytest.approx(float(cycle.multiplier), rel=1e-9)


@pytest.mark.slow(first=True)
def test_an_unstable_cycle_with_its_top_on_a_belt_at_rest_has_its_multiplier():
    law = ("conti", 0.5, 0.25, 2.0, 0.0)
    belts = engine.Belt(0.65, law), engine.Belt(0.0, law, 0.05, 0.55)
    osc = engine.Oscillator(0.1, belts)
    (cycle,) = jb.portrait(package.oscillator(osc)).unstable
    assert float(cycle.x1_max) > 0.55

    def top_after(x1):
        run = engine.simulate(osc, (x1, 0.0), 1.5 * float(cycle.period))
        at = (run.t > 0.5 * float(cycle.period)) & (np.abs(run.y[:, 1]) < 1e-9)
        return run.y[at & (run.y[:, 0] > 0.55), 0][0]

    top = float(cycle.x1_max)
    assert top_after(top) == pytest.approx(top, abs=1e-9)
    slope = (top_after(top + 1e-6) - top_after(top - 1e-6)) / 2e-6
    assert float(cycle.multiplier) == pytest.approx(slope, rel=1e-5) and slope > 1.1


@pytest.mark.slow(first=True)
def test_one_top_is_not_two_where_two_belts_at_rest_touch():
    """Rounding made two arcs end in it, of which the second was taken for a loop that repeats."""
    law = jb.Conti(1.0, 0.6, 10.0)
    told = jb.portrait(jb.Oscillator(0.1, (jb.Belt(0.0, law, lower=0.7), jb.Belt(0.0, law))))
    assert told.status == jb.Status.OK and len(told.separatrices) == 2
    for one in told.separatrices:
        assert one.end == "outside" and np.max(np.abs(np.asarray(one.ys))) > told.reach


@pytest.mark.slow(first=True)
def test_rounding_beside_a_pseudo_focus_is_no_gap():
    laws = (
        jb.Conti(1.24132057137, 1.14210672961, 14.2554871992),
        jb.Conti(1.22484183836, 1.13191091395, 8.8225063106, 0.120664234962),
    )
    edge = -1.42790547637
    belts = (
        jb.Belt(1.17304874713, laws[0], 0.581673761753, upper=edge),
        jb.Belt(-0.336211567652, laws[1], 1.22149573949, lower=edge),
    )
    told = jb.portrait(jb.Oscillator(0.077586547912, belts))
    assert told.status == jb.Status.OK and not len(told.gaps)


@pytest.mark.slow(first=True)
def test_separatrices_come_from_out_of_reach_where_loops_hardly_grow():
    """A loop passes a dozen edges and boundaries, and grows by a seventh."""
    belts = (
        jb.Belt(0.9, jb.Conti(1.2, 0.9, 6.0), 0.4, lower=-0.1, upper=-0.09),
        jb.Belt(-1.0, jb.Conti(0.9, 0.5, 5.0), 0.4, upper=0.2),
    )
    told = jb.portrait(jb.Oscillator(0.05, belts))
    stable = [one for one in told.separatrices if one.stable]
    assert len(stable) == 2 and int(told.status) == jb.Status.OK
    for one in stable:
        assert one.end == "outside" and np.max(np.abs(np.asarray(one.ys))) >= told.reach


@pytest.mark.slow(first=True)
def test_a_belt_at_rest_without_load_changes_nothing():
    """Its boundary lies where x1 is extremal: which of the two ends an arc is not left to rounding,
    by which lowest points of x1 were taken for the highest ones."""
    law = jb.Conti(1.0, 0.6, 10.0)
    lone = jb.portrait(jb.Oscillator(2.0, (jb.Belt(0.0404213, law),)))
    told = jb.portrait(jb.Oscillator(2.0, (jb.Belt(0.0, law, 0.0), jb.Belt(0.0404213, law))))
    assert int(told.status) == jb.Status.OK
    assert len(told.cycles) == len(lone.cycles) == 1 and not told.unstable and not lone.unstable
    period = pytest.approx(float(lone.cycles[0].period), abs=1e-12)
    assert float(told.cycles[0].period) == period


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("edges", [(0.3, 0.3), (0.3, 0.1 + 0.2), (0.1 + 0.2, 0.3)])
def test_a_saddle_on_edges_that_are_one_up_to_rounding_is_one(edges):
    law, (upper, lower) = jb.Conti(1.0, 0.6, 10.0), edges
    belts = (jb.Belt(-0.5, law, upper=upper), jb.Belt(0.5, law, lower=lower))
    told = jb.portrait(jb.Oscillator(0.5, belts))
    kinds = [jb.EquilibriumKind(int(row.kind)).name for row in told.equilibria]
    assert kinds.count("SADDLE") == 1
    sides = [(one.side, one.stable) for one in told.separatrices]
    assert len(sides) == len(set(sides)) == 4


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("nu", [0.0, 1e-17, -1e-17, 0.3 - (0.1 + 0.2), -1e-16])
def test_tops_beside_a_belt_at_rest_follow_one_another(nu):
    law = jb.Conti(1.0, 0.6, 10.0)
    at_rest, away = (
        jb.Oscillator(2.0, (jb.Belt(one, law, 0.0), jb.Belt(0.0404213, law))) for one in (nu, 5.0)
    )
    low = float(jb.equilibria(away).x1[0])
    starts = np.column_stack([low + np.geomspace(1e-8, 0.1, 512), np.zeros(512)])
    (tops, loops), (expected, _) = (_next_tops(osc, jnp.asarray(starts)) for osc in (at_rest, away))
    np.testing.assert_allclose(tops - low, expected - low, rtol=1e-6, atol=1e-15)
    # Nor does an extremum of x1 follow right after another one.
    extremal = np.asarray(loops.ends) == Ends(2).extremum_x1
    assert np.any(extremal) and not np.any(extremal[:, 1:] & extremal[:, :-1])


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(
    ("law", "damping", "omega", "belts"),
    [
        (jb.Conti(1.0, 0.6, 10.0), 0.5, 2.0, [(-0.35, 2.0), (1.15, 2.0, -0.7, -0.2)]),
        (jb.Coulomb(1.2, 0.6), 0.05, 1.0, [(0.15, 1.0, -np.inf, 0.2), (-0.15, 1.0, -0.9, 0.65)]),
    ],
    ids=["to a saddle", "to a boundary"],
)
def test_a_jump_of_the_map_of_tops_is_no_gap(law, damping, omega, belts):
    """Over an orbit that bounds basins, between neighbours among the floats."""
    told = jb.portrait(
        jb.Oscillator(damping, [jb.Belt(v, law, *rest) for v, *rest in belts], omega)
    )
    assert told.status == jb.Status.OK and not len(told.gaps)
    assert len(told.cycles) == 1 and not told.unstable


@pytest.mark.slow(first=True)
def test_loops_around_a_fixed_point_on_an_edge_grow_as_its_rate_says():
    """Next to it, where their growth is rounding: an excursion over the edge, of 4e-15, is twenty
    floats long."""
    law, end = jb.Conti(1.0, 0.4, 1.0), -0.6 * 2 / 1.05 - 0.8
    belts = jb.Belt(-0.3, law, 2.0, lower=-0.35, upper=0.29), jb.Belt(-0.05, law, 2.0, lower=end)
    told = jb.portrait(jb.Oscillator(0.5, belts, omega=0.5))
    assert told.status == jb.Status.OK and not len(told.gaps)
    (rest,) = told.equilibria
    assert float(rest.x1) == end and not rest.stable
    assert len(told.cycles) == 1 and not told.unstable


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(("unit", "omega"), [(1.0, 1.0), (7.0, 1 / 300), (1e5, 1 / 300)])
def test_a_node_with_one_direction_has_a_separatrix_in_every_unit(unit, omega):
    """The trace at the end of the segment is exactly 2."""
    law = jb.Conti(1.0, 0.6, 10.0 / (unit * omega))
    belt = jb.Belt(0.0, law, load=unit, upper=-0.2 * unit)
    portrait = jb.portrait(jb.Oscillator(2.0, (belt,), omega=omega))
    assert len(portrait.separatrices) == 4
