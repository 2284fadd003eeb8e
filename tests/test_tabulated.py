"""Laws from tables: their curve, cycles with them against the oracle; and kinks, told of."""

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest

import jaxbelt as jb
from jaxbelt import Status
from jaxbelt.cycles.shooting import ARC_STEPS
from jaxbelt.model import friction
from jaxbelt.model.friction import jump_and_kink
from jaxbelt.sweeps.question import Question

SPEEDS = np.array([0.0, 0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0])
MEASURED = np.array([0.60, 0.55, 0.52, 0.46, 0.41, 0.38, 0.36, 0.355, 0.36, 0.375])


def curve(speed):
    """Hardy's multiquadrics once more, solved for in another way: all weights but the last."""
    gaps = np.diff(SPEEDS)
    widths = np.array([min(gaps[max(i - 1, 0)], gaps[min(i, 8)]) for i in range(10)])

    def terms(r):
        return np.array([np.hypot(r - a, h) for a, h in zip(SPEEDS, widths, strict=True)])

    def differences(r):
        return np.append(terms(r)[:-1] - terms(r)[-1], 1.0)

    weights = np.linalg.solve([differences(r) for r in SPEEDS], MEASURED)
    return float(weights @ differences(speed))


def test_the_curve_goes_through_every_point_and_keeps_close_to_lines_between():
    law = jb.Tabulated(SPEEDS, MEASURED)
    # Rounding of sums of ten terms of size five.
    np.testing.assert_allclose(law.mu(jnp.asarray(SPEEDS)), MEASURED, rtol=0, atol=1e-14)
    between = np.linspace(0.0, 5.0, 501)
    values = np.asarray(law.mu(jnp.asarray(between)))
    np.testing.assert_allclose(values, [curve(r) for r in between], rtol=0, atol=1e-13)
    assert np.max(np.abs(values - np.interp(between, SPEEDS, MEASURED))) < 0.006
    assert law.static == pytest.approx(0.6, abs=1e-15)
    assert jb.Tabulated(SPEEDS, MEASURED, static=0.7).static == 0.7
    far = law.mu(jnp.array([1e3, 1e6]))
    assert np.ptp(far) < 0.01 and 0.3 < far[1] < 0.45


@pytest.mark.slow(first=True)
def test_a_cycle_with_a_table_is_the_oracles():
    osc = jb.Oscillator(0.03, (jb.Belt(0.3, jb.Tabulated(SPEEDS, MEASURED)),))
    cycle = jb.find_cycle(osc, (3.0, 0.0))
    assert cycle.status == Status.OK
    belt = oracle.Belt(0.3, np.vectorize(curve), 0.6)
    expected = oracle_cycles.sticking_cycle(
        oracle.Oscillator(0.03, (belt,), 1.0), T=100.0, rtol=1e-12, atol=1e-12
    )
    # The tolerance of the oracle, over some loops.
    assert float(cycle.period) == pytest.approx(expected.period, rel=1e-9)


def test_stores_tell_tables_apart():
    def question(coefficients):
        law = jb.Tabulated(SPEEDS, coefficients)

        def make(nu0):
            return jb.Oscillator(0.03, (jb.Belt(nu0, law),))

        axes = {"nu0": np.array([0.1, 0.2])}
        asked = Question.of(make, axes, (3.0, 0.0), 9.0, 1e-8, 1e-8, "final", ())
        return asked.identity()

    other = MEASURED + 0.01 * (SPEEDS == 0.4)
    assert question(MEASURED) == question(MEASURED) != question(other)


class Lines(jb.AbstractFriction):
    static: float

    def mu(self, speed):
        return jnp.interp(speed, SPEEDS, MEASURED)


class Corner(jb.AbstractFriction):
    static: float

    def mu(self, speed):
        return 0.4 + jnp.maximum(0.2 - 0.5 * speed, 0.1)


class Smooth(jb.AbstractFriction):
    static: float

    def mu(self, speed):
        # As steep as a law gets, and cut off below zero.
        return 0.4 + 0.2 * jnp.exp(-jnp.maximum(speed / 1e-3, -1.0)) + 0.1 * jnp.tanh(40 * speed)


class Step(jb.AbstractFriction):
    static: float

    def mu(self, speed):
        return jnp.where(speed < 0.3, self.static, 0.5 * self.static)


def test_kinks_are_found_where_they_are_and_nowhere_else():
    jump, kink = jump_and_kink(Corner(0.6))
    assert jump is None and kink == (pytest.approx(0.2, rel=1e-6), -0.5, 0.0)
    jump, kink = jump_and_kink(Lines(0.6))
    assert jump is None and kink[0] == pytest.approx(0.1, rel=1e-6)
    assert jump_and_kink(Smooth(0.6)) == (None, None)
    assert jump_and_kink(jb.Tabulated(SPEEDS, MEASURED)) == (None, None)
    assert jump_and_kink(Step(0.6))[0] == (pytest.approx(0.3, rel=1e-6), 0.6, 0.3)


def test_a_law_that_jumps_is_told_of_once():
    """Motions past that speed were off by 1e-3, with status OK and without a word."""
    friction._asked_of_kinks.discard(Step)
    with pytest.warns(UserWarning, match=r"mu of Step jumps at the speed 0\.3, from 0\.6 to 0\.3"):
        jb.Belt(0.2, Step(0.6))
    jb.Belt(0.2, Step(0.6))  # warnings are errors here


def test_a_law_of_straight_lines_is_told_of_once():
    friction._asked_of_kinks.discard(Lines)
    with pytest.warns(UserWarning, match=r"mu of Lines has a kink at the speed 0\.1, .*Tabulated"):
        jb.Belt(0.3, Lines(0.6))
    jb.Belt(0.3, Lines(0.6))  # warnings are errors here


class PushingAtRest(jb.AbstractFriction):
    static: float

    def mu(self, speed):
        return 0.2 * speed - 0.1


def test_a_law_that_pushes_at_rest_is_refused():
    with pytest.raises(ValueError, match=r"mu\(0\) of friction of belt must be >= 0, got -0\.1"):
        jb.Belt(0.3, PushingAtRest(0.6))


def test_a_curve_that_leaves_its_table_is_told_of():
    told = r"goes to mu = -0\.165 at the speed 0\.269, .* expects 0\.05 to 0\.05"
    with pytest.warns(UserWarning, match=told):
        jb.Tabulated((0.0, 0.1, 1.0), (0.5, 0.05, 0.05))
    with pytest.warns(UserWarning, match="at the speed 0.9, .* expects 0 to 0.01"):
        jb.Tabulated((0.0, 0.1, 0.2, 0.3), (0.5, 0.01, 0.3, 0.01))
    # Decades between the points, and falling: as measured laws are.
    jb.Tabulated((0.0, 1e-3, 1e-2, 0.1, 1.0), (0.5, 0.48, 0.4, 0.3, 0.25))
    jb.Tabulated((0.0, 0.1), (0.5, 0.4))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:mu of Lines has a kink")
def test_a_cycle_with_straight_lines_is_not_found_and_the_text_says_what_to_do():
    osc = jb.Oscillator(0.03, (jb.Belt(0.3, Lines(0.6)),))
    cycle = jb.find_cycle(osc, (3.0, 0.0))
    assert cycle.status == Status.NO_CONVERGENCE and "smooth" in repr(cycle)
    # Finer steps are not tried: each number of steps is compiled, and none is enough.
    assert cycle.chain.mesh.shape[-1] == ARC_STEPS


def test_a_table_is_no_parameter_and_static_is_one():
    osc = jb.Oscillator(0.03, (jb.Belt(0.3, jb.Tabulated(SPEEDS, MEASURED, 0.65)),))
    slope = jax.grad(lambda s: jb.Tabulated(SPEEDS, MEASURED, s).static)(0.7)
    assert slope == 1.0 and len(jax.tree.leaves(osc.belts[0].friction)) == 1


@pytest.mark.slow(first=True)
def test_a_branch_does_not_end_where_the_law_wants_more_steps():
    """Knots a hundredth of the unit of velocity apart: 16 steps an arc are too few."""
    law = jb.Tabulated(SPEEDS / 8, MEASURED)

    def make(nu):
        return jb.Oscillator(0.026, (jb.Belt(nu, law),))

    diagram = jb.bifurcation_diagram(make, span=(0.03, 0.2), rows=12)
    table = diagram.table()
    cycles = table[(table.kind == "cycle") & table.stable]
    assert cycles.value.min() == pytest.approx(0.03) and cycles.value.max() == pytest.approx(0.2)
    # As many as there are fixed points, one for each value and each end.
    assert len(cycles) == np.sum(table.kind == "equilibrium")


@pytest.mark.slow(first=True)
def test_a_cycle_that_a_fold_ends_just_beside_its_hopf_point_is_seen():
    """The cycle attracts so weakly that orbits hardly come to it; the values that are looked at
    first have one in the interval of 1.8e-4 where it is, of 0.145."""
    table = jb.Tabulated(
        (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2), (0.42, 0.36, 0.33, 0.30, 0.28, 0.275, 0.28)
    )

    def make(velocity):
        return jb.Machine(1.2, 15e3, 4.0, (jb.PhysicalBelt(velocity, table, 40.0),)).oscillator

    fold, hopf = jb.scan(make, span=(0.005, 0.15))
    assert (fold.kind, hopf.kind) == ("FoldOfCycles", "Hopf")
    assert float(fold.value) == pytest.approx(0.0747890104994, abs=1e-11)
    assert float(hopf.value) == pytest.approx(0.0749666018134, abs=1e-11)


def machine(velocity):
    table = jb.Tabulated((0.0, 0.02, 0.05, 0.1, 0.2, 0.4), (0.55, 0.48, 0.41, 0.36, 0.34, 0.35))
    return jb.Machine(2.0, 800.0, 3.0, (jb.PhysicalBelt(velocity, table, 30.0),))


def on_table(velocity):
    return machine(velocity).oscillator


@pytest.mark.slow(first=True)
def test_cycles_that_slip_faster_than_the_table_goes_are_told_of():
    within, beyond = machine(0.12), machine(0.3)
    jb.find_cycle(within.oscillator, within.start(0.0, 0.0))
    with pytest.warns(UserWarning, match=r"slips on belt 0 at 1\.59 times the speed at which"):
        cycle = jb.find_cycle(beyond.oscillator, beyond.start(0.0, 0.0))
    slowest = jnp.min(cycle.sample(2000)[:, 1]) * beyond.units.velocity
    assert (0.3 - slowest) / 0.4 == pytest.approx(1.59, abs=0.005)


@pytest.mark.slow(first=True)
def test_runs_that_slip_faster_than_the_table_goes_are_not_told_of():
    """A warning would fail this."""
    beyond, row = machine(0.3), [0.0, 1.0]
    jb.simulate(beyond.oscillator, beyond.start(0.0, 0.0), 50.0)
    jb.sweep(lambda: beyond.oscillator, {"x1": row}, y0=(0.0, 0.0), observe="attractor")
    jb.basins(beyond.oscillator, x1=row, x2=row)


@pytest.mark.slow(first=True)
def test_a_search_tells_of_it_once():
    """The values that it looks at on its way have such cycles, too."""
    for search in (
        lambda: jb.refine(jb.NonsmoothFold(0), on_table, at=0.38),
        lambda: jb.scan(on_table, span=(0.3, 0.5)),
    ):
        with pytest.warns(UserWarning, match="2.11 times the speed") as told:
            search()
        assert len(told) == 1


@pytest.mark.slow(first=True)
def test_diagrams_and_portraits_tell_of_it_once():
    for call in (
        lambda: jb.portrait(on_table(0.3)),
        lambda: jb.bifurcation_diagram(on_table, span=(0.28, 0.3), rows=9, resolution=4),
    ):
        with pytest.warns(UserWarning, match="1.59 times the speed") as told:
            call()
        assert len(told) == 1
