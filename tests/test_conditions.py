"""Conditions carry themselves: one defined here is refined, found on a path, followed and drawn."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest
from compilations import compilations
from scipy.optimize import brentq
from where import nu0, zeta

import jaxbelt as jb
from jaxbelt import Status
from jaxbelt.bifurcations.conditions import AbstractCondition, CycleEquation, Line
from jaxbelt.bifurcations.scan import LOOKED_FOR


class PeriodIs(CycleEquation):
    """The period of an attracting cycle has a given value: a resonance with something outside."""

    period: float | jax.Array

    caption: ClassVar[str] = "period"
    line: ClassVar[Line] = Line("period", "#0072B2", (0, (1, 1)))

    def equation(self, osc, chain, z):
        return jnp.sum(z[:, 2]) - self.period

    def watch(self, osc, chain, z, slope):
        # Where its motion is 0.45 wide.
        return {("Width", ()): jnp.max(z[:, 0]) - jnp.min(z[:, 0]) - 0.45}


def its_cycle(nu, damping=0.5):
    cycle = oracle_cycles.sticking_cycle(oracle.class_a(nu, damping=damping))
    assert cycle is not None
    return cycle


@pytest.fixture(scope="module")
def exact():
    """Where the cycle of class (a) takes 8 units of time, by the oracle."""
    return brentq(lambda nu: its_cycle(nu).period - 8.0, 0.09, 0.11, xtol=1e-13)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("offset", [-0.02, 0.1])
def test_it_is_refined(exact, offset):
    point = jb.refine(PeriodIs(8.0), jb.presets.class_a(exact + offset), where=nu0)
    assert point.status == Status.OK and point.kind == "PeriodIs"
    # The oracle integrates to 1e-13.
    assert point.value == pytest.approx(exact, abs=1e-10) and point.error < 1e-10
    assert point.cycle.period == pytest.approx(8.0, abs=1e-12)
    assert repr(point).startswith("BifurcationPoint(PeriodIs(period=8.0), value 0.")


@pytest.fixture(scope="module")
def points():
    conditions = [PeriodIs(8.0), PeriodIs(9.0)]
    osc = jb.presets.class_a(0.2)
    return jb.scan(osc, nu0, (0.09, 0.4), resolution=24, conditions=conditions)


@pytest.mark.slow(first=True)
def test_it_is_found_on_a_path_among_the_others(points, exact):
    """The period of 9 is not there: the belt would be slower."""
    kinds = [PeriodIs(8.0), jb.Hopf(), jb.NonsmoothFold(0)]
    assert [point.condition for point in points] == kinds
    assert points[0].value == pytest.approx(exact, abs=1e-10)


@pytest.mark.slow(first=True)
def test_it_is_looked_for_only_where_it_is_asked_for():
    points = jb.scan(jb.presets.class_a(0.2), nu0, (0.09, 0.15), resolution=6)
    assert points == ()


@pytest.mark.slow(first=True)
def test_its_curve_is_followed_and_drawn(points):
    span = ((0.05, 0.2), (0.2, 0.8))
    curve = jb.bifurcation_curve(points[0], (nu0, zeta), span, step=0.04)
    assert set(curve.kinds) == {"PeriodIs"} and len(curve) > 12
    # To both sides, to the ends of the span.
    assert np.allclose(sorted(curve.values[[0, -1], 1]), [0.2, 0.8], rtol=0, atol=1e-12)
    for nu, damping in curve.values[::5].tolist():
        # The oracle integrates to 1e-13.
        assert its_cycle(nu, damping).period == pytest.approx(8.0, abs=1e-10)
    (special,) = curve.special
    cycle = its_cycle(*special.values)
    assert special.kind == "Width" and special.residual < 1e-12
    assert cycle.period == pytest.approx(8.0, abs=1e-10)
    assert cycle.x1_max - cycle.x1_min == pytest.approx(0.45, abs=1e-10)

    (line, *_) = curve.plot().lines
    assert line.get_label() == "period" and line.get_color() == "#0072B2"
    assert curve.table(("nu0", "zeta")).condition[0] == "PeriodIs"


@pytest.mark.slow(first=True)
def test_its_name_stands_in_diagrams(points):
    osc = jb.presets.class_a(0.2)
    diagram = jb.BifurcationDiagram(points, (), ((0.09, 0.4, "2"),), osc, "belts[0].velocity")
    texts = {text.get_text() for text in diagram.plot().texts}
    assert {"period", "Hopf", "nonsmooth fold, belt 0"} <= texts


@pytest.mark.slow(first=True)
def test_numbers_in_conditions_are_data():
    """Another period, another belt, the other kind of tangency: nothing is compiled anew."""

    def look(osc):
        jb.refine(PeriodIs(8.0), osc, where=nu0)
        jb.refine(jb.NonsmoothFold(1), osc, where=nu0)
        jb.refine(jb.SuddenSliding(0), osc, where=nu0)
        jb.refine(jb.Hopf(), osc, where=zeta)  # what the second look meets there

    osc = jb.presets.class_b(0.5, 0.35)
    look(osc)
    with compilations() as compiled:
        jb.refine(PeriodIs(7.0), osc, where=zeta)
        jb.refine(jb.NonsmoothFold(0), osc, where=zeta)
        jb.refine(jb.GrazingSliding(1), osc, where=nu0)
        jb.refine(jb.SuddenSliding(1), osc, where=nu0)
    assert compiled == []


@pytest.mark.parametrize("kind", [*LOOKED_FOR, jb.NonsmoothFold, jb.CornerCollision])
def test_every_kind_of_the_package_carries_its_words(kind: type[AbstractCondition]):
    assert kind.__doc__ and kind.__doc__ != AbstractCondition.__doc__
    assert kind.caption and kind.line.name and kind.line.colour


def test_what_is_no_plain_number_is_named():
    with pytest.raises(ValueError, match="condition must be made of plain finite numbers"):
        jb.refine(PeriodIs(jnp.asarray(8.0)), jb.presets.class_a(0.2), where=nu0)
    with pytest.raises(ValueError, match="belt must be 0: there is one belt, got 1"):
        jb.scan(jb.presets.class_a(0.2), nu0, (0.1, 0.2), conditions=[jb.GrazingSliding(1)])


class Plain(CycleEquation):
    """With nothing but its equation."""

    size: float

    def equation(self, osc, chain, z):
        return jnp.sum(z[:, 2]) - self.size


class Long(Plain):
    def equation(self, osc, chain, z):
        return z[:1, 2] - self.size


class Untraceable(Plain):
    def equation(self, osc, chain, z):
        return float(np.max(z))


def test_mistakes_in_a_condition_of_ones_own_are_named():
    osc = jb.presets.class_a(0.2)
    for one, words in (
        (Plain(float("nan")), "condition must be made of plain finite numbers"),
        (Long(8.0), "equation of Long must be a function that returns one float64"),
        (Untraceable(8.0), "equation of Untraceable must be .*made of what JAX can trace"),
    ):
        with pytest.raises(ValueError, match=words):
            jb.refine(one, osc, where=nu0)
        with pytest.raises(ValueError, match=words):
            jb.scan(osc, nu0, (0.1, 0.2), conditions=[one])


@pytest.mark.slow(first=True)
def test_a_condition_without_words_goes_by_its_name():
    point = jb.refine(Plain(8.0), jb.presets.class_a(0.2), where=nu0)
    assert point.status == Status.OK and point.condition.words == "Plain"
    curve = jb.bifurcation_curve(point, (nu0, zeta), ((0.05, 0.4), (0.4, 0.6)))
    assert curve.plot().get_legend_handles_labels()[1] == ["Plain"]
