"""Machines in SI units: the oscillator that they are, and results brought back."""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import oracle
import pytest
import xarray as xr
from laws import Lorentz

import jaxbelt as jb
from jaxbelt.bifurcations.pieces import Branch
from jaxbelt.model.parameters import names_of
from jaxbelt.si import unit_of

MASS, STIFFNESS, DAMPING = 0.5, 2000.0, 1.0


def machine(V=0.02, N=5.0, mass=MASS):
    return jb.Machine(
        mass,
        STIFFNESS,
        DAMPING,
        (
            jb.PhysicalBelt(V, jb.Conti(0.4, 0.25, 100.0), N, upper=0.004),
            jb.PhysicalBelt(0.05, jb.Conti(0.3, 0.2, 50.0, 0.3), 2.0, lower=0.001),
        ),
    )


def its_oracle():
    """In metres, and speeds in m/s: only time is scaled, as in the paper."""
    omega = np.sqrt(STIFFNESS / MASS)
    slow = oracle.Belt(0.02, *oracle.conti(0.4, 0.25, 100.0), 5.0 / STIFFNESS, upper=0.004)
    fast = oracle.Belt(0.05, *oracle.conti(0.3, 0.2, 50.0, 0.3), 2.0 / STIFFNESS, lower=0.001)
    return oracle.Oscillator(DAMPING / np.sqrt(STIFFNESS * MASS), (slow, fast), omega), omega


@pytest.fixture(scope="module")
def run():
    m = machine()
    # Of a shape that other tests ask for, too, see tests/test_relations.py.
    times = m.tau(np.linspace(0.0, 0.5, 241))
    return jb.simulate(m.oscillator, m.start(0.003, 0.0), times[-1], ts=times, max_segments=4096)


def test_motion_in_si_is_that_of_the_dimensional_oracle(run):
    theirs, omega = its_oracle()
    reference = oracle.simulate(theirs, (0.003, 0.0), 0.5 * omega)
    ours = jb.in_si(run, machine())
    assert ours.attrs["status"] == "OK" and ours.x1.units == "m" and ours.t.units == "s"
    events = [(event.kind, event.belt) for event in reference.events]
    kinds = jb.decoded(ours).event_kind.values
    assert [(k.upper(), b) for k, b in zip(kinds, ours.event_belt.values)] == events
    times = np.array([event.t for event in reference.events]) / omega
    assert np.allclose(ours.t_event, times, rtol=0, atol=1e-10)
    x1, x2 = reference.y_end
    # Lengths are of the size 1e-3 here.
    assert float(ours.x1[-1]) == pytest.approx(x1, abs=1e-12)
    assert float(ours.x2[-1]) == pytest.approx(x2 * omega, abs=1e-10)


def test_friction_force(run):
    ours = jb.in_si(run, machine())
    x, v = ours.x1.values, ours.x2.values
    stuck = (ours["mode"].values == 0).any(axis=1)
    assert 30 < stuck.sum() < 210
    with pytest.raises(ValueError, match="result must be dimensionless, got a dataset that is in"):
        jb.in_si(ours, machine())
    # Nothing is accelerated where it sticks: the force is that of spring and dashpot.
    assert np.allclose(ours.force[stuck], (STIFFNESS * x + DAMPING * v)[stuck], rtol=1e-12)
    # Else it is what the laws say, in newtons at metres per second.
    slow, fast = 0.02 - v, 0.05 - v
    mu0 = 0.15 / (1 + 100.0 * abs(slow)) + 0.25
    mu1 = 0.1 / (1 + 50.0 * abs(fast)) + 0.2 + 0.3 * fast**2
    force = (x < 0.004) * 5.0 * mu0 * np.sign(slow) + (x > 0.001) * 2.0 * mu1 * np.sign(fast)
    assert np.allclose(ours.force[~stuck], force[~stuck], rtol=0, atol=1e-9)


@pytest.mark.slow(first=True)
def test_the_force_at_an_event_is_that_after_it():
    m = machine()
    ours = jb.in_si(jb.simulate(m.oscillator, m.start(0.003, 0.0), m.tau(0.1)), m)
    (event,) = np.flatnonzero(jb.decoded(ours).event_kind.values == "stick")
    row = int(np.argmin(np.abs(ours.t.values - float(ours.t_event[event]))))
    assert float(ours.t[row]) == float(ours.t_event[event])
    before, at, _ = ours.force.values[row - 1 : row + 2]
    held = STIFFNESS * float(ours.x1[row]) + DAMPING * 0.02
    assert at == pytest.approx(held, rel=1e-9) and abs(before - at) > 0.1
    assert ours["mode"].values[row, 0] == 0 != ours["mode"].values[row - 1, 0]


def test_a_trajectory_of_another_machine(run):
    for bring in (jb.in_si, jb.plot_in_si):
        with pytest.raises(ValueError, match=r"its belt 0 at velocity 0\.189.*sticks .* at 0\.126"):
            bring(run, machine(0.03))
    alone, whole = jb.in_si(run, machine(0.03).units), jb.in_si(run, machine())
    assert alone.identical(whole.drop_vars("force"))


@pytest.mark.parametrize(
    ("kind", "advice"),
    [
        (jb.RegionMap, "draw it by its own"),
        (jb.CircleMap, r"jb.in_si\(found.motions\[0\], machine\)"),
        (jb.Exponents, "multiply its values by machine.units.rate"),
        (jb.Design, r"write machine.of_oscillator\(plan.oscillator\)"),
    ],
)
def test_what_is_not_converted_has_advice(kind, advice):
    result = object.__new__(kind)
    with pytest.raises(TypeError, match=f"got {kind.__name__}; .*{advice}"):
        jb.in_si(result, machine())
    if kind in (jb.RegionMap, jb.CircleMap):
        with pytest.raises(ValueError, match=f"got a {kind.__name__}; .*{advice}"):
            jb.plot_in_si(result, machine)


@pytest.mark.slow(first=True)
def test_a_portrait_and_a_shock_in_si():
    """Of one that was put together by hand; a cycle and an equilibrium are real ones."""
    m = machine()
    cycle, points = jb.find_cycle(m.oscillator, m.start(0.003, 0.0)), jb.equilibria(m.oscillator)
    nothing, ok = jnp.zeros((0, 2)), jnp.asarray(jb.Status.OK.value)
    picture = jb.Portrait(m.oscillator, points, (cycle,), (), (), False, 3.0, nothing, ok)
    ours, table = jb.in_si(picture, m), picture.table()
    length, time = 5.0 / STIFFNESS, np.sqrt(MASS / STIFFNESS)
    assert set(ours) == set(table) and len(ours.row) == len(table)
    assert np.allclose(ours.x1_max, table.x1_max * length) and ours.x1_max.units == "m"
    assert np.allclose(ours.x2_min, table.x2_min * length / time)
    assert np.allclose(ours.period, table.period * time, equal_nan=True)
    assert np.allclose(ours.rate, table.rate / time, equal_nan=True) and ours.rate.units == "s-1"
    start, by = jnp.array([1.0, 0.2]), jnp.array([0.0, 0.3])
    for direction, size in (("x2", length / time), ("both", 1.0)):
        words = (direction, "cycle 0", "none", "infinity")
        shock = jb.FatalShock(picture, *words, jnp.asarray(0.3), start, by, ok)
        ours = jb.in_si(shock, m)
        assert float(ours.distance) == pytest.approx(0.3 * size)
        assert float(ours.shock_x2) == pytest.approx(0.3 * length / time)
        assert float(ours.x1) == pytest.approx(length) and ours.x1.units == "m"
        assert ours.distance.attrs.get("units") == ("m s-1" if direction == "x2" else None)
        assert ours.attrs["attractor"] == "cycle 0" and ours.attrs["status"] == "OK"
    for one in (picture, shock):
        with pytest.raises(ValueError, match="machine must be the one of the result"):
            jb.in_si(one, machine(0.03))


def test_a_basin_stability_has_no_units():
    kinds = {"cycle": 0.25, "equilibrium": 0.75}
    ours = jb.in_si(jb.BasinStability(kinds, dict.fromkeys(kinds, 0.04), 100), machine())
    assert ours.fraction.values.tolist() == [0.25, 0.75] and ours.kind.values[0] == "cycle"


@pytest.mark.slow(first=True)
def test_a_cycle_in_si():
    m = machine()
    cycle = jb.find_cycle(m.oscillator, m.start(0.003, 0.0))
    ours = jb.in_si(cycle, m)
    assert float(ours.period) == pytest.approx(float(cycle.period) * np.sqrt(MASS / STIFFNESS))
    assert float(ours.x2_max) == pytest.approx(0.02, rel=1e-9)  # it sticks to the slow belt
    # The heat of one loop is what the belts' drives give: force times velocity, in joules.
    fed = float(jb.energy_fed(cycle) * m.units.energy)
    assert float(ours.energy) == pytest.approx(fed, rel=1e-8)
    assert ours.energy.units == "J" and ours.stick_duration.dims == ("belt",)
    for wrong, told in ((machine(N=50.0), "velocity"), (machine(0.03), "velocity = 0.126")):
        for bring in (jb.in_si, jb.plot_in_si):
            with pytest.raises(ValueError, match=f"machine must be the one of the result.*{told}"):
                bring(cycle, wrong)
    # In other units, but of whatever motion.
    assert float(jb.in_si(cycle, machine(0.03).units).period) == float(ours.period)
    assert jb.plot_in_si(cycle, machine(0.03).units).get_xlabel() == "displacement $X$ (m)"
    one = jb.Machine(MASS, STIFFNESS, DAMPING, m.belts[:1])
    with pytest.raises(ValueError, match="machine must be of 2 belts, got 1 belts"):
        jb.in_si(cycle, one)
    other = jb.PhysicalBelt(0.05, jb.Coulomb(0.3, 0.2), 2.0, lower=0.001)
    with pytest.raises(ValueError, match="machine must be with the laws of the result"):
        jb.in_si(cycle, jb.Machine(MASS, STIFFNESS, DAMPING, (m.belts[0], other)))


def fit_of(osc, **values):
    """A fit of an oscillator, with a tenth of each estimate as its standard error."""
    estimates, names = jnp.asarray(list(values.values())), tuple(values)
    p, ts, one = len(names), jnp.linspace(0.0, 1.0, 3), jnp.asarray(1.0)
    ys = jnp.asarray([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    return jb.Fit(
        oscillator=osc,
        names=names,
        estimates=estimates,
        standard_errors=0.1 * estimates,
        covariance=jnp.diag((0.1 * estimates) ** 2) if p else jnp.zeros((0, 0)),
        y0=ys[0],
        y0_standard_errors=0.1 * ys[0],
        ts=ts,
        ys=ys,
        residuals=0.01 * ys,
        noise=jnp.ones(2),
        reduced_chi_squared=one,
        plausibility=one,
        autocorrelation=one,
        candidates=1,
        evaluations=1,
        status=jnp.asarray(jb.Status.OK.value),
    )


def test_a_fit_in_si():
    """What a fit would find without noise are the numbers that the machine was made of."""
    m = machine()
    numbers = dict(zip(names_of(m.oscillator), jax.tree.leaves(m.oscillator), strict=True))
    names = [name for name in numbers if name not in ("omega", "belts[0].lower", "belts[1].upper")]
    ours = jb.in_si(fit_of(m.oscillator, **{name: numbers[name] for name in names}), m)
    assert ours.attrs == {"status": "OK", "reduced_chi_squared": 1.0}
    told = {
        name: (float(v), u)
        for name, v, u in zip(ours.parameter.values, ours.estimate, ours.unit.values)
    }
    # 5 N on 2000 N/m are 2.5 mm, and one unit of time is sqrt(m/k).
    length, time = 5.0 / STIFFNESS, np.sqrt(MASS / STIFFNESS)
    expected = {
        "damping": (DAMPING, "N s m-1"),
        "belts[0].velocity": (0.02, "m s-1"),
        "belts[0].friction.static": (0.4, "1"),
        "belts[0].friction.residual": (0.25, "1"),
        "belts[0].friction.steepness": (100.0, "s m-1"),
        "belts[0].friction.quadratic": (0.0, "s2 m-2"),
        "belts[0].load": (5.0, "N"),
        "belts[0].upper": (0.004, "m"),
        "belts[1].velocity": (0.05, "m s-1"),
        "belts[1].friction.static": (0.3, "1"),
        "belts[1].friction.residual": (0.2, "1"),
        "belts[1].friction.steepness": (50.0, "s m-1"),
        "belts[1].friction.quadratic": (0.3, "s2 m-2"),
        "belts[1].load": (2.0, "N"),
        "belts[1].lower": (0.001, "m"),
        "x1 at the start": (length, "m"),
        "x2 at the start": (2 * length / time, "m s-1"),
    }
    assert {name: unit for name, (_, unit) in told.items()} == {
        k: u for k, (_, u) in expected.items()
    }
    for name, (value, _) in expected.items():
        assert told[name][0] == pytest.approx(value, rel=1e-14)
    assert np.allclose(ours.standard_error, 0.1 * ours.estimate, rtol=1e-14)
    assert np.allclose(ours.upper - ours.lower, 2 * 1.959964 * ours.standard_error, rtol=1e-6)
    assert np.allclose(ours.x1, np.array([1, 3, 5]) * length) and ours.x1.units == "m"
    assert np.allclose(ours.x2_residual, np.array([0.02, 0.04, 0.06]) * length / time)
    assert np.allclose(ours.t, np.linspace(0, 1, 3) * time) and ours.t.units == "s"


def test_a_misfit_tells_no_standard_errors():
    """They would be those of a motion that is not that of the record."""
    good = fit_of(machine().oscillator, damping=0.1)
    bad = dataclasses.replace(good, status=jnp.asarray(jb.Status.MISFIT.value))
    assert "damping = 0.1 +- 0.01" in repr(good) and not good.table().isna().any().any()
    assert "damping = 0.1 (a misfit: without a standard error)" in repr(bad)
    told = bad.table().set_index("name").loc["damping"]
    assert told.estimate == 0.1 and told.drop("estimate").isna().all()


def test_a_fit_of_a_law_of_ones_own_and_of_tied_parameters_in_si():
    law = Lorentz(jnp.asarray(0.5), jnp.asarray(0.3), jnp.asarray(0.1))
    m = jb.Machine(MASS, STIFFNESS, DAMPING, [jb.PhysicalBelt(0.02, law, 5.0)] * 2)
    (width,) = [
        name for name in names_of(m.oscillator) if name.endswith("0].friction.law.velocity")
    ]
    tied = "belts[0].load = belts[1].load"
    ours = jb.in_si(fit_of(m.oscillator, **{width: 0.1, tied: 1.0}), m)
    assert ours.parameter.values.tolist()[:2] == [width, tied]
    assert ours.estimate.values[:2] == pytest.approx([0.1, 5.0])
    assert ours.unit.values.tolist()[:2] == ["", "N"]
    with pytest.raises(ValueError, match="of tied parameters with one unit, got damping = belts"):
        jb.in_si(fit_of(m.oscillator, **{"damping = belts[0].load": 1.0}), m)
    with pytest.raises(ValueError, match="machine must be of 1 belts, got 2 belts"):
        jb.in_si(fit_of(jb.presets.class_a(0.3), damping=0.1), m)
    doubled = dataclasses.replace(m, damping=2 * m.damping)
    with pytest.raises(ValueError, match=r"has damping = 0\.0316.*, got 0\.0632"):
        jb.in_si(fit_of(m.oscillator, **{tied: 1.0}), doubled)


class _Powers(jb.AbstractFriction):
    """Its numbers go with several powers of the speed."""

    static: jax.Array
    velocity: jax.Array
    square: jax.Array
    count: float = 3.0

    def mu(self, speed):
        return self.static / (1 + speed / self.velocity + speed**2 / self.square)

    def in_units_of(self, speed):
        return _Powers(self.static, self.velocity / speed, self.square / speed**2, self.count)


class _Shifted(_Powers):
    def in_units_of(self, speed):
        return _Shifted(self.static, self.velocity + speed, self.square / speed**2, self.count)


def test_a_law_of_ones_own_that_takes_other_units_says_what_its_numbers_are_in():
    def told(kind, name):
        law = kind(jnp.asarray(0.4), jnp.asarray(0.05), jnp.asarray(0.02))
        m = jb.Machine(MASS, STIFFNESS, DAMPING, [jb.PhysicalBelt(0.02, law, 5.0)])
        path = f"belts[0].friction.{name}"
        numbers = dict(zip(names_of(m.oscillator), jax.tree.leaves(m.oscillator), strict=True))
        ours = jb.in_si(fit_of(m.oscillator, **{path: numbers[path]}), m)
        return float(ours.estimate[0]), str(ours.unit.values[0])

    for name, value, unit in (
        ("static", 0.4, "1"),
        ("velocity", 0.05, "m s-1"),
        ("square", 0.02, "m2 s-2"),
        ("count", 3.0, "1"),
    ):
        assert told(_Powers, name) == (pytest.approx(value, rel=1e-14), unit)
    with pytest.raises(ValueError, match=r"of what goes with a power of the speed in in_units_of"):
        told(_Shifted, "velocity")


def test_a_picture_of_a_fit_in_si():
    m = machine()
    both = fit_of(m.oscillator, damping=0.1)
    ax, ours = jb.plot_in_si(both, m), jb.in_si(both, m)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time $t$ (s)", "displacement $X$ (m)")
    for one, name in zip(ax.figure.axes, ("x1", "x2"), strict=True):
        record, motion = (line.get_xydata() for line in one.lines)
        assert np.allclose(motion, np.stack([ours.t, ours[name]], axis=1), rtol=1e-12)
        data = ours[name] + ours[f"{name}_residual"]
        assert np.allclose(record, np.stack([ours.t, data], axis=1), rtol=1e-12)
    alone = dataclasses.replace(both, residuals=both.residuals.at[:, 1].set(jnp.nan))
    assert jb.plot_in_si(alone, m).get_ylabel() == "displacement $X$ (m)"


def test_its_numbers_are_differentiable():
    def numbers(V, N):
        osc = machine(V, N).oscillator
        return jnp.stack([osc.belts[0].velocity, osc.belts[0].load, osc.belts[1].load])

    by_velocity, by_force = jax.jacfwd(numbers, (0, 1))(0.02, 5.0)
    # nu = V sqrt(k m) / N and u1 = 2 / N, where N is the largest force, and u0 = 1.
    root = np.sqrt(STIFFNESS * MASS)
    assert np.allclose(by_velocity, [root / 5.0, 0.0, 0.0], rtol=1e-14)
    assert np.allclose(by_force, [-0.02 * root / 25.0, 0.0, -2.0 / 25.0], rtol=1e-14, atol=1e-17)


def test_laws_keep_their_coefficients_at_the_speeds_of_the_machine():
    speeds = jnp.linspace(0.0, 0.3, 7)
    laws = [
        jb.Conti(0.3, 0.2, 50.0, 0.3),
        jb.Coulomb(0.4, 0.3),
        jb.Stribeck(0.4, 0.25, 0.01),
        Lorentz(jnp.asarray(0.5), jnp.asarray(0.3), jnp.asarray(0.1)),
    ]
    for law in laws:
        scaled = law.in_units_of(jnp.asarray(0.04))
        assert np.allclose(scaled.mu(speeds / 0.04), law.mu(speeds), rtol=1e-14)
        assert float(scaled.static) == float(law.static)
        twice = scaled.in_units_of(jnp.asarray(1 / 0.04))
        assert np.allclose(twice.mu(speeds), law.mu(speeds), rtol=1e-14)


def test_there_and_back():
    m = machine()
    back = m.of_oscillator(m.oscillator)
    for one, other in zip(jax.tree.leaves(back), jax.tree.leaves(m), strict=True):
        assert float(one) == pytest.approx(float(other), rel=1e-14)
    with pytest.raises(ValueError, match="osc must be of 2 belts"):
        m.of_oscillator(jb.presets.class_a(0.3))
    with pytest.raises(ValueError, match="omega of osc must be 1"):
        m.of_oscillator(jb.Oscillator(0.1, m.oscillator.belts, omega=2.0))


def test_without_forces_there_are_units_all_the_same():
    free = jb.Machine(1.0, 4.0, 0.1, (jb.PhysicalBelt(0.1, jb.Coulomb(0.4, 0.3), 0.0),))
    assert float(free.units.length) == 1.0 and float(free.units.time) == 0.5
    assert float(free.oscillator.belts[0].load) == 0.0


def swept(axes, make):
    """Final states of its oscillators; derivatives are numbers like any other here."""
    found = jb.sweep(make, axes, y0=(3.0, 0.0), t1=50.0)
    slopes = {
        "d_x2_end_d_x1": found.x2_end.assign_attrs(quantity="velocity / length"),
        "d_x1_end_d_V": found.x1_end.assign_attrs(quantity="length / unit of V"),
    }
    return found.assign(slopes)


@pytest.mark.slow(first=True)
def test_sweeps_in_si():
    axes = {"V": np.array([0.01, 0.02]), "x1": np.array([1.0, 2.0])}
    dataset = swept(axes, lambda V: machine(V).oscillator)
    units = machine().units
    ours = jb.in_si(dataset, machine)
    assert np.allclose(ours.x1_end, dataset.x1_end * float(units.length), rtol=1e-15)
    assert np.allclose(ours.x1, dataset.x1 * float(units.length), rtol=1e-15)
    assert ours.x1_end.units == ours.x1.units == "m" and ours.x2_end.units == "m s-1"
    # The call, whose axes are in the oscillator's units, finds them in the dataset.
    (axes_of_call,) = re.findall(r"\{name: dataset.*?\]\}", ours.attrs["call"])
    found = eval(axes_of_call, {"dataset": ours})
    assert all(np.allclose(found[name], dataset[name], rtol=1e-15) for name in ("V", "x1"))
    assert np.allclose(ours.d_x1_end_d_V, dataset.d_x1_end_d_V * float(units.length))
    ratio = float(units.velocity / units.length)
    assert np.allclose(ours.d_x2_end_d_x1, dataset.d_x2_end_d_x1 * ratio)
    assert ours.d_x2_end_d_x1.units == "m s-1 / (m)"
    assert ours.d_x1_end_d_V.units == "m / (unit of V)"
    assert ours.n_events.identical(dataset.n_events.assign_coords(x1=ours.x1))
    with pytest.raises(ValueError, match=r"result must be without x1 .* vary"):
        jb.in_si(
            dataset.drop_vars(["d_x2_end_d_x1", "d_x1_end_d_V"]), lambda V: machine(V, 500 * V)
        )


@pytest.mark.slow(first=True)
def test_variables_of_sweeps_state_their_dimensions():
    """Those of stores of earlier versions do not; they are converted all the same."""
    axes = {"V": np.array([0.01, 0.02]), "x1": np.array([1.0, 2.0])}
    dataset = jb.sweep(
        lambda V: machine(V).oscillator, axes, t1=50.0, derivatives=("V", "x1"), rtol=1e-6
    )
    assert dataset.x1.quantity == dataset.x1_end.quantity == "length"
    assert dataset.d_x2_end_d_x1.quantity == "velocity / length"
    assert dataset.d_x2_end_d_V.quantity == "velocity / unit of V"
    assert not {"quantity"} & {*dataset.V.attrs, *dataset.n_events.attrs, *dataset.status.attrs}
    units, ours = machine().units, jb.in_si(dataset, machine)
    assert ours.d_x2_end_d_x1.units == "m s-1 / (m)" and "quantity" not in ours.x1.attrs
    slopes = dataset.d_x2_end_d_x1 * float(units.velocity / units.length)
    assert np.allclose(ours.d_x2_end_d_x1, slopes, equal_nan=True)
    earlier = dataset.copy()
    for name in earlier.variables:
        earlier[name].attrs.pop("quantity", None)
    assert jb.in_si(earlier, machine).identical(ours)
    one = jb.in_si(dataset.isel(x1=0), machine)
    assert float(one.x1) == float(ours.x1[0]) and one.x1.units == "m"


def test_results_of_ones_own_state_their_dimensions_where_they_are_to_be_converted():
    axes = {"V": ("V", [0.01, 0.02])}
    own = xr.Dataset({"x1": ("V", [1.0, 2.0])}, axes, {"observe": "Largest"})
    assert jb.in_si(own, machine).x1.identical(own.x1)
    own.x1.attrs["quantity"] = "length"
    ours = jb.in_si(own, machine)
    assert ours.x1.units == "m" and np.allclose(ours.x1, own.x1 * 5.0 / STIFFNESS, rtol=1e-14)
    own.x1.attrs["quantity"] = "lenght"
    with pytest.raises(ValueError, match=r"quantity of x1 must be .* \(did you mean 'length'"):
        jb.in_si(own, machine)


def test_attractors_of_a_sweep_take_the_function_of_the_sweep():
    """The numbers of the attractors are no argument of it."""
    axes = {"V": ("V", [0.01, 0.02]), "attractor": ("attractor", [0, 1])}
    x1_max = (("V", "attractor"), np.array([[1.0, 2.0], [3.0, 4.0]]), {"quantity": "length"})
    shares = xr.Dataset({"x1_max": x1_max}, axes, {"observe": "attractor"})
    ours = jb.in_si(shares, machine)
    assert ours.x1_max.units == "m" and np.allclose(ours.x1_max, shares.x1_max * 5.0 / STIFFNESS)


@pytest.mark.slow(first=True)
def test_units_may_differ_from_run_to_run():
    axes = {"N": np.array([5.0, 1.0, 10.0])}
    loads = swept(axes, lambda N: machine(0.02, N).oscillator)
    plain = loads.drop_vars(["d_x2_end_d_x1", "d_x1_end_d_V"])
    ours = jb.in_si(plain, lambda N: machine(0.02, N))
    # The largest force is that of the second belt, 2 N, where the first has less.
    lengths = np.array([5.0, 2.0, 10.0]) / STIFFNESS
    assert np.allclose(ours.x1_end, loads.x1_end * lengths, rtol=1e-14)
    with pytest.raises(ValueError, match="machine must be a function of N that returns"):
        jb.in_si(loads, machine())
    with pytest.raises(ValueError, match=r"result must be without d_x2_end_d_x1 .* vary"):
        jb.in_si(loads, lambda N: machine(0.02, N))


@pytest.mark.slow(first=True)
def test_basins_in_si():
    m = machine()
    basins = jb.basins(m.oscillator, x1=np.linspace(-1, 2, 3), x2=np.linspace(-1, 1, 3))
    ours = jb.in_si(basins, m)
    assert ours.x1.values == pytest.approx(np.linspace(-1, 2, 3) * 5.0 / STIFFNESS)
    assert ours.label.identical(basins.label.assign_coords(x1=ours.x1, x2=ours.x2))
    resting = dataclasses.replace(basins, attractors=("rest at 0.559",), cycles=())
    keys = [one.get_legend_handles_labels()[1] for one in (jb.plot_basins(resting), resting.plot())]
    drawn = jb.plot_in_si(resting, m)
    told = f"to rest at {0.559 * 5.0 / STIFFNESS:.3g} m"
    assert told in drawn.get_legend_handles_labels()[1]
    assert all("to rest at 0.559" in labels for labels in keys)
    assert told in [text.get_text() for text in drawn.get_legend().get_texts()]


def test_words_for_basins_tell_the_place_of_rest_in_si():
    m = machine()
    words = "undecided cycle_that_never_sticks rest_at_0.230 rest_at_-1.234"
    told = {"flag_values": np.array([-1, 0, 1, 2]), "flag_meanings": words}
    axes = {"x1": ("x1", [1.0, 2.0, 3.0]), "x2": ("x2", [0.0])}
    dataset = xr.Dataset({"label": (("x1", "x2"), [[0], [1], [2]], told)}, axes)
    ours = jb.in_si(dataset, m)
    places = [
        f"rest_at_{x1 * 5.0 / STIFFNESS:{of}}_m" for x1, of in ((0.23, ".3g"), (-1.234, ".4g"))
    ]
    assert ours.label.flag_meanings.split() == [*words.split()[:2], *places]
    assert jb.decoded(ours).label.values[:, 0].tolist() == [words.split()[1], *places]
    assert np.array_equal(ours.label, dataset.label) and dataset.label.flag_meanings == words


def test_pictures_in_si(run):
    m = machine()
    ax = jb.plot_phase_portrait(m.oscillator, run)
    before = np.array([ax.get_xlim(), ax.get_ylim()])
    assert jb.plot_in_si(ax, m) is ax
    assert ax.get_xlabel() == "displacement $X$ (m)"
    assert ax.get_ylabel() == r"velocity $\dot X$ (m/s)"
    sizes = np.array([[m.units.length], [m.units.velocity]])
    assert np.allclose([ax.get_xlim(), ax.get_ylim()], before * sizes, rtol=1e-14)
    (orbit,) = (line for line in ax.lines if line.get_label() == "orbit")
    assert np.allclose(orbit.get_xydata()[0], (0.003, 0.0), rtol=1e-14)
    ax.figure.canvas.draw()
    texts = [label.get_text() for label in ax.get_xticklabels()]
    shown = [float(text.replace("\N{MINUS SIGN}", "-")) for text in texts]
    assert np.allclose(shown, ax.get_xticks(), rtol=1e-5)
    # As many decimals in each, and no hyphen.
    assert min(shown) < 0 and not any("-" in text for text in texts)
    assert len({len(text.partition(".")[2]) for text in texts}) == 1


def of_page(ax):
    """What is drawn, as numbers [rows, columns, colours], without the axes' own numbers."""
    figure = ax.figure
    figure.set_layout_engine("none")
    for one in figure.axes:
        one.set_position((0.1, 0.1 + 0.5 * (one is not ax), 0.8, 0.3))
        one.xaxis.set_visible(False)
        one.yaxis.set_visible(False)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(int)


def test_in_si_everything_stays_where_it_is(run):
    m = machine()
    osc, events = m.oscillator, run.events
    pictures = [
        lambda: jb.plot_phase_portrait(osc, run),
        lambda: jb.plot_vector_field(osc),
        lambda: jb.plot_vector_field(osc, kind="arrows"),
        lambda: jb.plot_friction_law(osc.belts[0].friction),
        *(events.plot, run.arcs.plot, jb.equilibria(osc).plot),
        lambda: jb.plot_time_history(run),
    ]
    for draw in pictures:
        pages = []
        for axes in (draw(), jb.plot_in_si(draw(), m)):
            # As if somebody went on drawing: limits follow what is there.
            ax = axes if isinstance(axes, plt.Axes) else axes[1]
            ax.autoscale_view()
            pages.append(of_page(ax))
        differs = np.max(np.abs(pages[0] - pages[1]), axis=-1) > 60
        # Rounding moves edges by a pixel.
        assert np.mean(differs) < 2e-3, draw
        assert np.mean(pages[0] < 250) > 1e-3


def test_a_measurement_beside_a_picture_in_si(run):
    m = machine()
    t, X = np.linspace(0.0, 0.6, 4), np.array([0.003, 0.004, 0.0, 0.001])
    _, axes = plt.subplots(2, sharex=True)
    jb.plot_time_history(run, tuple(axes))
    assert jb.plot_in_si(axes, m) is axes
    axes[0].plot(t, X)
    assert axes[1].get_xlim() == axes[0].get_xlim() == (0.0, 0.6)
    assert axes[0].get_ylim()[1] == pytest.approx(0.00427, abs=1e-4)

    # What is there already stays, and so do limits that somebody has set.
    _, ax = plt.subplots()
    (line,) = ax.plot(t, X)
    run_alone = jb.plot_in_si(run, m, ax)
    assert run_alone.get_xlim() == pytest.approx((0.0, 0.6))
    assert np.array_equal(line.get_xydata(), np.stack([t, X], axis=1))
    ax.set_xlim(0.1, 0.2)
    assert jb.plot_in_si(run, m, ax).get_xlim() == (0.1, 0.2)
    assert [one.get_xdata()[-1] for one in ax.lines[1:]] == pytest.approx([0.5] * 2)
    # A call that fails leaves the limits alone.
    with pytest.raises(TypeError):
        jb.plot_in_si(run, m, ax, colour="red")
    ax.autoscale()
    assert ax.get_xlim() == pytest.approx((0.0, 0.6))
    # And what was drawn without units is converted once.
    ax = run.plot()
    jb.plot_in_si(run, m, ax)
    assert [one.get_xdata()[-1] for one in ax.lines] == pytest.approx([0.5] * 2)


@pytest.mark.parametrize("is_new", [True, False])
def test_a_trajectory_in_si_has_the_numbers_of_in_si(run, is_new):
    """In new axes, and beside a measurement; the velocity has an axis of its own."""
    m, ours = machine(), jb.in_si(run, machine())
    ax = None
    if not is_new:
        ax = plt.subplots()[1]
        (measured,) = ax.plot([0.0, 0.5], [-0.01, 0.02])
    dimensionless = run.plot().get_ylim()
    ax = jb.plot_in_si(run, m, ax)
    line = ax.lines[-1]
    (aside,) = (one for one in ax.figure.axes if one is not ax)
    (other,) = aside.lines
    for drawn, shown, name in ((ax, line, "x1"), (aside, other, "x2")):
        t, values = np.transpose(shown.get_xydata())
        assert t[-1] == pytest.approx(0.5)
        # The lines have samples of their own besides: each of in_si is among them, or between two.
        assert np.interp(ours.t, t, values) == pytest.approx(
            ours[name].values, abs=1e-3 * max(values)
        )
        assert drawn.get_ylim()[0] < min(values) and max(values) < drawn.get_ylim()[1]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time $t$ (s)", "displacement $X$ (m)")
    assert aside.get_ylabel() == r"velocity $\dot X$ (m/s)"
    assert aside.get_xlim() == ax.get_xlim() == pytest.approx((0.0, 0.5))
    if is_new:
        for one, unit in ((ax, m.units.length), (aside, m.units.velocity)):
            assert one.get_ylim() == pytest.approx(np.multiply(dimensionless, float(unit)))
    else:
        assert measured.get_ydata().tolist() == [-0.01, 0.02] and ax.get_ylim()[1] < 0.03
        assert jb.plot_in_si(run, m, ax).figure.axes == [ax, aside] and len(aside.lines) == 2
    words = [text.get_text() for text in ax.get_legend().get_texts()]
    assert {"displacement $X$", r"velocity $\dot X$"} < set(words)


def along(name="belts[0].velocity", is_argument=False, **changes):
    """Results along a parameter, of two values; their numbers are made up."""
    values, two = np.array([0.5, 1.0]), np.array([[1.0, 2.0], [3.0, 4.0]])
    fractions = jb.BasinFractions(
        *(values, ("cycle 0", "equilibrium 0"), two / 4, two / 100, 0 * values),
        *(-two, two, -two, two, np.array([[6.0, np.nan]] * 2), 100, name, is_argument),
    )
    kind, status = np.array([["cycle"], ["undecided"]]), np.zeros((2, 1), int)
    points = np.array([[[1.0, 2.0]], [[np.nan] * 2]])
    orbits = jb.OrbitDiagram(
        *(values, kind, two[:, :1], status, points, 0 * points, jb.AtEvents(), name, None),
        is_argument,
    )
    branch = Branch(
        *("cycle", values, np.array([True, False]), np.zeros(2, bool)),
        *(i * values for i in (-1, 1, -2, 2, 6, 0)),
        *(two, two, tuple(jb.find_cycle(machine().oscillator, (1.0, 0.0)) for _ in values)),
    )
    region = ((0.5, 1.0, "1"),)
    diagram = jb.BifurcationDiagram((), (branch,), region, machine().oscillator, name, False)
    return fractions, orbits, dataclasses.replace(diagram, is_argument=is_argument)


def test_results_along_a_parameter_in_si():
    m, length, time = machine(), 5.0 / STIFFNESS, np.sqrt(MASS / STIFFNESS)
    for one in along():
        ours, table = jb.in_si(one, m), one.table()
        assert set(ours) == set(table) and len(ours.row) == len(table)
        assert np.allclose(ours.value, table.value * length / time) and ours.value.units == "m s-1"
        assert np.allclose(ours.period, table.period.astype(float) * time, equal_nan=True)
        name = "x1" if "x1" in ours else "x1_max"
        assert np.allclose(ours[name], table[name] * length, equal_nan=True)
        assert ours[name].units == "m" and ours.period.units == "s"
        ax = jb.plot_in_si(one, m)
        assert ax.get_xlabel() == "belt velocity $V_0$ (m/s)"
        assert np.allclose(ax.get_xlim(), np.array([0.5, 1.0]) * length / time, rtol=1e-14)
    diagram = along()[2]
    assert jb.in_si(diagram, m.units).identical(jb.in_si(diagram, m))
    with pytest.raises(ValueError, match="as the result keeps no oscillator, got its units"):
        jb.in_si(along()[0], m.units)
    assert jb.in_si(diagram, m).stick_duration_1.units == "s"
    ax = jb.plot_in_si(diagram, m, quantity="x1")
    assert ax.get_ylabel() == "displacement $X$ (m)"
    ends = np.array([line.get_ydata()[[0, -1]] for line in ax.lines])
    assert np.ptp(ends) == pytest.approx(2 * length, rel=1e-12)
    root = np.sqrt(STIFFNESS * MASS)
    sizes = {"belts[1].load": 5.0, "belts[0].upper": length, "belts[1].lower": length}
    sizes |= {"damping": root, "belts[1].friction.static": 1.0}
    for name, size in sizes.items():
        (ours,) = {tuple(jb.in_si(one, m).value.values) for one in along(name)[:1]}
        assert ours[0] == pytest.approx(0.5 * size)


def shaken(frequency):
    """The first belt at rest, alone, and a force of 12 N."""
    sole = jb.PhysicalBelt(0.0, jb.Coulomb(0.4, 0.4), 10.0)
    force = jb.Harmonic(12.0, frequency)
    return jb.Machine(MASS, STIFFNESS, DAMPING, (sole,), forcing=force)


@pytest.mark.slow(first=True)
def test_a_forced_motion_in_si():
    m = shaken(60.0)
    motion = jb.find_cycle(m.oscillator, m.start(0.0, 0.0))
    ours, length = jb.in_si(motion, m), 10.0 / STIFFNESS
    assert float(ours.period) == pytest.approx(2 * np.pi / 60.0, rel=1e-14)
    assert ours.attrs == {"status": "OK", "periods": 1} and "energy" not in ours
    assert float(ours.amplitude) == pytest.approx(float(motion.x1_max) * length, rel=1e-9)
    assert ours.amplitude.units == ours.x1.units == "m" and ours.x2.units == "m s-1"
    with pytest.raises(ValueError, match=r"oscillator has forcing\[0\].frequency"):
        jb.in_si(motion, shaken(61.0))


@pytest.mark.slow
def test_a_diagram_of_a_forced_machine_in_si():
    m, time = shaken(60.0), np.sqrt(MASS / STIFFNESS)
    motion = jb.find_cycle(m.oscillator, m.start(0.0, 0.0))
    by_argument = jb.bifurcation_diagram(
        lambda frequency: shaken(frequency).oscillator, span=(58.0, 62.0), start=motion
    )
    span = 58.0 * time, 62.0 * time
    by_leaf = jb.bifurcation_diagram(
        m.oscillator, lambda o: o.forcing[0].frequency, span, start=motion
    )
    one, other = jb.in_si(by_argument, shaken), jb.in_si(by_leaf, m)
    assert other.value.units == "rad s-1" and one.x1_max.units == "m"
    for ours in (one, other):
        assert ours.value.values[[0, -1]] == pytest.approx([58.0, 62.0], rel=1e-12)
    ax = jb.plot_in_si(by_leaf, m, quantity="amplitude")
    assert ax.get_xlabel() == r"frequency of forcing $\Omega$ (rad/s)"
    assert ax.get_xlim() == pytest.approx((58.0, 62.0))


def test_units_of_the_numbers_of_forces():
    waves = jb.Harmonic(12.0, 60.0), jb.BaseMotion(0.001, 60.0)
    belt = jb.PhysicalBelt(jb.Oscillating(0.1, 0.01, 60.0), jb.Coulomb(0.4, 0.4), 10.0)
    m = jb.Machine(MASS, STIFFNESS, DAMPING, (belt,), forcing=waves)
    osc, names = m.oscillator, names_of(m.oscillator)
    leaves = dict(zip(names, jax.tree.leaves(osc), strict=True))
    for name, size, symbol in (
        ("forcing[0].amplitude", 12.0, "N"),
        ("forcing[0].frequency", 60.0, "rad s-1"),
        ("forcing[0].phase", 0.0, "rad"),
        ("forcing[1].amplitude", 0.001, "m"),
        ("belts[0].velocity.mean", 0.1, "m s-1"),
        ("belts[0].velocity.amplitude", 0.01, "m s-1"),
        ("belts[0].velocity.frequency", 60.0, "rad s-1"),
    ):
        unit, one = unit_of(name, osc, m.units)
        assert unit == symbol and float(leaves[name]) * one == pytest.approx(size, rel=1e-14)


def doubled(cycle):
    return 2 * cycle.period


@pytest.mark.parametrize(
    ("quantity", "unit", "label"),
    [
        (jb.energy_fed, "energy", "energy fed (J)"),
        (functools.partial(jb.stick_duration, belt=0), "time", "stick duration (belt 0) (s)"),
        (jb.peak, "length", "peak (m)"),
        (functools.partial(jb.peak, coordinate="x2"), "velocity", "peak (coordinate x2) (m/s)"),
        (jb.period, "time", "period (s)"),
        (jb.stick_fraction, None, "stick fraction"),
        (doubled, None, "doubled (dimensionless)"),
        (lambda cycle: jb.stick_duration(cycle, 0), None, "quantity (dimensionless)"),
    ],
)
def test_a_quantity_of_a_diagram_in_si(quantity, unit, label):
    m, diagram = machine(), along()[2]
    size = 1.0 if unit is None else float(getattr(m.units, unit))
    plain, ours = diagram.plot(quantity=quantity), jb.plot_in_si(diagram, m, quantity=quantity)
    assert ours.get_ylabel() == label
    assert ours.lines[0].get_ydata() == pytest.approx(plain.lines[0].get_ydata() * size, rel=1e-12)
    assert np.all(np.isfinite(ours.lines[0].get_ydata()))
    # Beside what is there in SI units, too.
    _, ax = plt.subplots()
    (before,) = ax.plot([0.1, 0.2], [1.0, 2.0])
    jb.plot_in_si(diagram, m, ax, quantity=quantity)
    assert ax.get_ylabel() == label and before.get_ydata().tolist() == [1.0, 2.0]
    assert ax.lines[1].get_ydata() == pytest.approx(ours.lines[0].get_ydata())


@pytest.mark.slow(first=True)
def test_the_title_of_a_point_in_si_has_no_value_without_a_unit():
    m = machine()
    point = jb.refine(jb.Hopf(), m.oscillator, where=lambda o: o.damping)
    ax = jb.plot_in_si(point, m.units)
    assert ax.get_title() == "Hopf" and ax.get_xlabel() == "displacement $X$ (m)"
    assert point.plot().get_title().startswith("Hopf at ")


def test_a_parameter_of_a_function_stays_as_the_function_takes_it():
    for one in along("N", True):
        ours, table = jb.in_si(one, lambda N: machine(0.02, 10 * N)), one.table()
        assert np.array_equal(ours.value, table.value) and "units" not in ours.value.attrs
        lengths = 10 * table.value / STIFFNESS  # the largest force is that of the first belt
        name = "x1" if "x1" in ours else "x1_max"
        assert np.allclose(ours[name], table[name] * lengths, equal_nan=True)
        with pytest.raises(ValueError, match="machine must be a function of N that returns"):
            jb.in_si(one, machine())
        assert jb.in_si(one, lambda N: machine(0.02, 10 * N).units).identical(ours)
        with pytest.raises(ValueError, match=r"no unit depends .* got along N"):
            jb.plot_in_si(one, lambda N: machine(0.02, 10 * N))
        with pytest.raises(ValueError, match=r"machine must be a function of N .* 'V'"):
            jb.in_si(one, lambda V: machine(V))
    shown = dataclasses.replace(along("V", True)[2], oscillator=machine(0.5).oscillator)
    ax = jb.plot_in_si(shown, machine)
    assert ax.get_xlabel() == "parameter $V$" and ax.get_xlim() == (0.5, 1.0)


def test_what_has_no_si_units_is_told():
    m = machine()
    with pytest.raises(ValueError, match=r"result must be along .* one along omega"):
        jb.in_si(along("omega")[0], m)
    with pytest.raises(ValueError, match=r"machine must be of a belt 2, .* got 2 belts"):
        jb.in_si(along("belts[2].load")[0], m)
    axes = {"V": ("V", [0.01, 0.02]), "x1": ("x1", [1.0, 2.0])}
    dataset = xr.Dataset({"x1_end": (("V", "x1"), np.ones((2, 2)))}, axes)
    with pytest.raises(ValueError, match=r"with an axis of time, .* jb.plot_sweep\(jb.in_si"):
        jb.plot_in_si(jb.plot_sweep(dataset, "x1_end"), m)
    with pytest.raises(ValueError, match=r"machine must be a function of V that .* 'speed'"):
        jb.in_si(dataset, lambda speed: machine(speed))
    by_itself = r"or what it shows itself: jb.plot_in_si\(diagram, .* got axes of .*stick fraction"
    with pytest.raises(ValueError, match=by_itself):
        jb.plot_in_si(along()[2].plot(quantity=jb.stick_fraction), m)
    _, ax = plt.subplots()
    ax.set_xlabel("time in hours")
    with pytest.raises(ValueError, match="got axes of 'time in hours', ''"):
        jb.plot_in_si(ax, m)
    drawn = jb.plot_sweep(jb.in_si(dataset, machine), "x1_end")
    assert drawn.get_ylabel() == "x1 (m)"


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: jb.Machine(0.0, 1.0, 0.1, machine().belts), "mass must be > 0, got 0"),
        (lambda: jb.Machine(1.0, -1.0, 0.1, machine().belts), "stiffness must be > 0, got -1"),
        (lambda: jb.Machine(1.0, 1.0, np.nan, machine().belts), "damping must be finite"),
        (lambda: jb.Machine(1.0, 1.0, 0.1, ()), "belts must be at least one PhysicalBelt"),
        (
            lambda: jb.Machine(1.0, 1.0, 0.1, [jb.Belt(1.0, jb.Coulomb(1, 1))]),
            r"belts\[0\] must be",
        ),
        (lambda: jb.PhysicalBelt(1.0, 0.4, 1.0), "friction must be a law"),
        (lambda: jb.PhysicalBelt(1.0, jb.Coulomb(1, 1), -1.0), "normal_force must be >= 0, got -1"),
        (lambda: jb.PhysicalBelt(1.0, jb.Coulomb(1, 1), 1.0, 2.0, 1.0), "lower must be < upper"),
        (lambda: jb.in_si(3.0, machine()), "result must be a Trajectory"),
    ],
)
def test_what_cannot_be_is_told(wrong, message):
    with pytest.raises((ValueError, TypeError), match=message):
        wrong()


def test_units_show_their_values():
    belt = jb.PhysicalBelt(0.1, jb.Coulomb(0.5, 0.4), 20.0)
    machine = jb.Machine(mass=2.0, stiffness=800.0, damping=4.0, belts=(belt,))
    shown = "Units(time 0.05 s, length 0.025 m, velocity 0.5 m/s, force 20 N, energy 0.5 J)"
    assert repr(machine.units) == shown


@pytest.mark.slow(first=True)
def test_what_is_in_si_units_is_not_scaled_again():
    belt = jb.PhysicalBelt(0.1, jb.Coulomb(0.5, 0.4), 20.0)
    machine = jb.Machine(mass=2.0, stiffness=800.0, damping=4.0, belts=(belt,))
    dataset = jb.sweep(lambda: machine.oscillator, {"x1": [1.0]}, t1=1.0)
    once = jb.in_si(dataset, machine)
    assert once.start == "dimensionless: x2 = 0.0"
    with pytest.raises(ValueError, match="result must be dimensionless, got a dataset that is in"):
        jb.in_si(once, machine)


@pytest.mark.slow(first=True)
def test_a_time_among_many_is_the_same_number():
    """Else the last of some times is behind the end of the run."""
    m = jb.Machine(0.5, 2000.0, 1.0, (jb.PhysicalBelt(0.02, jb.Coulomb(0.4, 0.3), 5.0),))
    for end in np.arange(1, 50) / 10:
        times = np.linspace(0, end, 41)
        assert m.tau(times)[-1] == m.tau(end)
        assert m.start(times, times)[0][-1] == m.start(end, end)[0]
