"""No answer depends on the unit of length or of time.

A change of unit by a power of two changes no bit of a result but exponents; any other changes
nothing but rounding. The relation is exact, so it needs no oracle, and no tolerance.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from where import nu0, nu1

import jaxbelt as jb
from jaxbelt.model.own_units import in_own_units, in_units_of_user, own_length, power_of_two_below

#: Exponents of the unit of length and of omega.
UNITS = [(-24, 3), (24, -10), (-1, 0)]


def oscillator(nu0=0.45, nu1=0.35, *, length=1.0, omega=1.0, damping=0.5, **edges):
    """The paper's class (b), with lengths in another unit and at another frequency."""
    speed = length * omega
    law = jb.Conti(1.0, 0.6, 10 / speed)
    edges = {name: value * length for name, value in edges.items()}
    belts = jb.Belt(nu0 * speed, law, length, **edges), jb.Belt(nu1 * speed, law, length)
    return jb.Oscillator(damping, belts, omega)


def powers_of(name, length, speed):
    """What a column of a result is multiplied by, by its name."""
    if name.startswith(("x1", "x2", "shock", "distance", "amplitude", "stick_velocit", "reach")):
        return length
    if name in ("value", "error", "value_0", "value_1", "nu0", "nu1") or "velocity" in name:
        return speed
    return length**-2 if name == "coefficient" else 1.0


def same_tables(table, other, length, speed):
    assert list(table) == list(other) and len(table) == len(other)
    for name in table:
        a, b = table[name].to_numpy(), other[name].to_numpy()
        if a.dtype.kind == "f":
            a = a * powers_of(name, length, speed)
            np.testing.assert_array_equal(a, b, err_msg=name)
        else:
            assert list(map(str, a)) == list(map(str, b)), name


def same(values, others, factor=1.0):
    np.testing.assert_array_equal(np.asarray(values) * factor, np.asarray(others))


#: The largest change of both units is among the quick tests.
RARELY = [pytest.param(one, marks=pytest.mark.slow(first=True)) for one in UNITS if one[0] < 0]


@pytest.fixture(params=[*RARELY, *(one for one in UNITS if one[0] > 0)], ids=str)
def units(request):
    k, m = request.param
    return 2.0**k, 2.0**m


@pytest.mark.slow(first=True)
def test_motions(units):
    length, omega = units
    osc, other = oscillator(), oscillator(length=length, omega=omega)
    for settings in ({}, {"formulation": "switch"}, {"formulation": "smooth"}):
        run = jb.simulate(osc, (3.0, 0.1), 20.0, **settings)
        again = jb.simulate(other, (3.0 * length, 0.1 * length), 20.0, **settings)
        same(run.ts, again.ts)
        same(run.ys, again.ys, length)
        same(run.events.y, again.events.y, length)
        same(run.modes, again.modes)
    run = jb.simulate(osc, (3.0, 0.1), 20.0, atol=1e-7)
    again = jb.simulate(other, (3.0 * length, 0.1 * length), 20.0, atol=1e-7 * length)
    same(run.ys, again.ys, length)


@pytest.mark.slow(first=True)
def test_derivatives_and_batches(units):
    length, omega = units

    def end(nu0, length=1.0, omega=1.0):
        osc = oscillator(nu0, length=length, omega=omega)
        return jb.simulate(osc, (3.0 * length, 0.1 * length), 20.0, ts=[20.0]).ys[-1, 0]

    numbers = jnp.array([0.1, 0.3, 0.45])
    for transformed in (jax.grad(end), jax.jacfwd(end)):
        same(
            jax.vmap(transformed)(numbers),
            jax.vmap(functools.partial(transformed, length=length, omega=omega))(numbers),
            length,
        )


@pytest.mark.slow(first=True)
def test_cycles_portraits_and_shocks(units):
    length, omega = units
    osc, other = oscillator(), oscillator(length=length, omega=omega)
    start = 3.0 * length, 0.0
    for one, two in (
        (jb.find_cycle(osc, (3.0, 0.0)), jb.find_cycle(other, start)),
        (jb.unstable_cycle(osc), jb.unstable_cycle(other)),
    ):
        same_tables(one.table(), two.table(), length, length * omega)
        same(one.sample(50), two.sample(50), length)
        same(jb.energy_fed(one), jb.energy_fed(two), length**2)
        same(jb.gap(one, 0), jb.gap(two, 0), length)
    same_tables(jb.portrait(osc).table(), jb.portrait(other).table(), length, length * omega)
    same_tables(jb.equilibria(osc).table(), jb.equilibria(other).table(), length, length * omega)
    same(jb.lyapunov_coefficient(osc), jb.lyapunov_coefficient(other), length**-2)
    shock, again = jb.minimal_fatal_shock(osc, (3.0, 0.0)), jb.minimal_fatal_shock(other, start)
    same_tables(shock.table(), again.table(), length, length * omega)
    same_tables(shock.at_phases(4), again.at_phases(4), length, length * omega)


@pytest.mark.slow(first=True)
def test_points_and_curves(units):
    length, omega = units
    speed = length * omega
    points = jb.scan(oscillator(), nu0, (-0.7, 0.7))
    others = jb.scan(oscillator(length=length, omega=omega), nu0, (-0.7 * speed, 0.7 * speed))
    assert len(points) == len(others) == 8
    for point, other in zip(points, others, strict=True):
        same_tables(point.table(), other.table(), length, speed)
    fold = jb.refine(jb.NonsmoothFold(1), oscillator(0.52), where=nu0)
    other = jb.refine(jb.NonsmoothFold(1), oscillator(0.52, length=length, omega=omega), where=nu0)
    same_tables(fold.table(), other.table(), length, speed)
    curve = jb.bifurcation_curve(fold, (nu0, nu1), ((0.2, 0.7), (0.2, 0.6)))
    span = (0.2 * speed, 0.7 * speed), (0.2 * speed, 0.6 * speed)
    again = jb.bifurcation_curve(other, (nu0, nu1), span)
    same(curve.values, again.values, speed)
    same(curve.places[:, :4], again.places[:, :4], length)


class Work:
    """A reducer in the user's units: what the friction does, and where x2 passes a third of the
    load."""

    at = (
        jb.AtEvents(),
        jb.AtExtrema("x1"),
        jb.AtSection(lambda osc, x1, x2: 3 * x2 - osc.belts[0].load),
    )

    def init(self, osc, x1, x2):
        return jnp.abs(x1), jnp.zeros((), int)

    def update(self, state, event):
        return state[0] + jnp.abs(event.x1), state[1] + 1

    def finish(self, state, end):
        return {"sum": state[0], "count": state[1], "work": end.integrals}

    def rates(self, osc, motion):
        return jnp.sum(motion.forces) * motion.x2


@pytest.mark.slow(first=True)
def test_sweeps(units):
    length, omega = units
    speed = length * omega
    nus, starts = np.linspace(-0.7, 0.7, 6), np.linspace(-2.0, 2.0, 4)

    def made(length, omega):
        def make(nu0, nu1):
            return oscillator(
                nu0 / (length * omega), nu1 / (length * omega), length=length, omega=omega
            )

        return make

    def swept(length, omega, **settings):
        speed = length * omega
        axes = {"nu0": nus * speed, "nu1": nus * speed, "x1": starts * length}
        return jb.sweep(made(length, omega), axes, y0=(0.0, 0.1 * length), **settings)

    for settings in ({"t1": 30.0}, {"observe": "attractor"}):
        one, two = swept(1.0, 1.0, **settings), swept(length, omega, **settings)
        for name in one:
            same(one[name], two[name], length if name[:2] in ("x1", "x2") else 1.0)
        if "observe" in settings:
            of_one, of_two = (
                jb.attractors(data, made(*those))
                for data, those in ((one, (1.0, 1.0)), (two, units))
            )
            same(of_one.fraction, of_two.fraction)
    one, two = (
        swept(1.0, 1.0, t1=30.0, observe=Work()),
        swept(length, omega, t1=30.0, observe=Work()),
    )
    for name, factor in (("sum", length), ("count", 1.0), ("work", length**2)):
        same(one[name], two[name], factor)
    tight = swept(1.0, 1.0, t1=30.0, atol=1e-10), swept(length, omega, t1=30.0, atol=1e-10 * length)
    same(tight[0].x1_end, tight[1].x1_end, length)
    one = jb.sweep(made(1.0, 1.0), {"nu0": nus, "nu1": nus}, t1=20.0, derivatives=["nu0"])
    two = jb.sweep(
        made(length, omega),
        {"nu0": nus * speed, "nu1": nus * speed},
        y0=(3.0 * length, 0.0),
        t1=20.0,
        derivatives=["nu0"],
    )
    same(one.d_x1_end_d_nu0, two.d_x1_end_d_nu0, 1 / omega)


@pytest.mark.slow(first=True)
def test_basins(units):
    length, omega = units
    osc, other = oscillator(), oscillator(length=length, omega=omega)
    x1, x2, box = (
        np.linspace(-2, 2, 12),
        np.linspace(-1, 1, 12),
        np.array([(-2.0, 2.0), (0.0, 2.0)]),
    )
    one, two = jb.basins(osc, x1=x1, x2=x2), jb.basins(other, x1=x1 * length, x2=x2 * length)
    same(one.label, two.label)
    same(one.boundary.unknowns[:, 0], two.boundary.unknowns[:, 0], length)
    same(one.finite_time_stability(20.0, 0.1), two.finite_time_stability(20.0, 0.1 * length))
    key = jax.random.key(0)
    fractions = [
        jb.basin_stability(osc, box=box * unit, n=500, key=key).fractions
        for osc, unit in ((osc, 1.0), (other, length))
    ]
    assert fractions[0] == fractions[1]


@pytest.mark.slow
def test_diagrams_maps_fractions_fits_and_designs(units):
    length, omega = units
    speed = length * omega
    osc, other = oscillator(), oscillator(length=length, omega=omega)
    span, ends = (-0.7, 0.7), (-0.7 * speed, 0.7 * speed)
    diagrams = jb.bifurcation_diagram(osc, nu0, span), jb.bifurcation_diagram(other, nu0, ends)
    same_tables(*(diagram.table() for diagram in diagrams), length, speed)
    orbits = jb.orbit_diagram(osc, nu0, span, rows=20)
    again = jb.orbit_diagram(other, nu0, ends, rows=20, y0=(3.0 * length, 0.0))
    same(orbits.x1, again.x1, length)
    settings = {"n": 300, "key": jax.random.key(0), "rows": 6}
    box = np.array([(-2.0, 2.0), (0.0, 2.0)])
    one = jb.basin_fractions(osc, nu0, (0.2, 0.6), box=box, **settings)
    two = jb.basin_fractions(other, nu0, (0.2 * speed, 0.6 * speed), box=box * length, **settings)
    same_tables(one.table(), two.table(), length, speed)
    nus, maps = np.linspace(-0.7, 0.7, 16), []
    for unit, frequency in ((1.0, 1.0), units):

        def make(nu0, nu1, unit=unit, frequency=frequency):
            speed = unit * frequency
            return oscillator(nu0 / speed, nu1 / speed, length=unit, omega=frequency)

        axes = dict.fromkeys(("nu0", "nu1"), nus * unit * frequency)
        maps.append(jb.region_map(make, axes, lines=1, step=0.03))
    same_tables(*(one.table() for one in maps), length, speed)
    assert np.array_equal(maps[0].label, maps[1].label)
    ts = np.linspace(0.0, 30.0, 300)
    noise = 1e-3 * np.random.default_rng(0).normal(size=300)
    found = []
    for unit, frequency, one in ((1.0, 1.0, osc), (length, omega, other)):
        x1 = np.asarray(jb.simulate(one, (3.0 * unit, 0.0), 30.0, ts=ts).ys[:, 0])
        guess = oscillator(0.47, 0.33, length=unit, omega=frequency)
        found.append(
            jb.fit(
                guess, ts, x1 + noise * unit, where=lambda o: (nu0(o), nu1(o)), noise=1e-3 * unit
            )
        )
    same(found[0].estimates, found[1].estimates, speed)
    same(found[0].residuals, found[1].residuals, length)
    plans = [
        jb.design(
            oscillator(length=unit, omega=frequency),
            [(jb.amplitude, 0.6 * unit), (jb.distance_to_basin_boundary(), (0.02 * unit, unit))],
            where=lambda o: (nu0(o), o.damping),
            y0=(3.0 * unit, 0.0),
        )
        for unit, frequency in ((1.0, 1.0), units)
    ]
    same(plans[0].achieved, plans[1].achieved, length)


@pytest.mark.parametrize("k", [-7, -4, 6])
def test_units_of_ten_change_rounding_only(k):
    # Rounding of the numbers themselves, 1e-16, times what the answers make of it.
    length = 10.0**k
    cycle, other = (
        jb.find_cycle(oscillator(), (3.0, 0.0)),
        jb.find_cycle(oscillator(length=length), (3.0 * length, 0.0)),
    )
    np.testing.assert_allclose(other.x1_max / length, cycle.x1_max, rtol=1e-12)
    point = jb.refine(jb.NonsmoothFold(1), oscillator(0.52), where=nu0)
    other = jb.refine(jb.NonsmoothFold(1), oscillator(0.52, length=length), where=nu0)
    np.testing.assert_allclose(other.value / length, point.value, rtol=1e-12)


@pytest.mark.slow(first=True)
def test_a_newton_and_a_stiff_spring_in_metres():
    """N = 1 N, k = 1e5 N/m: a portrait without a cycle was found here, with the status OK."""
    osc = oscillator(length=1e-5, omega=1e5**0.5)
    (attracting,), (unstable,) = jb.portrait(osc).cycles, jb.portrait(osc).unstable
    # Both periods were computed by SciPy at 1e-13 in the units of the paper.
    np.testing.assert_allclose(
        [attracting.period, unstable.period], [6.531575203, 6.462456064], rtol=1e-9
    )
    assert int(jb.unstable_cycle(osc).status) == jb.Status.OK


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("omega", [10.0, 100.0, 1000.0])
def test_refine_at_other_frequencies(omega):
    point = jb.refine(jb.NonsmoothFold(1), oscillator(0.52, omega=omega), where=nu0)
    np.testing.assert_allclose(point.value / omega, 0.538734800481, rtol=1e-11)


class Gauss(jb.AbstractFriction):
    """A law of the user's, with a speed of its own."""

    static: jax.Array
    speed: jax.Array

    def __init__(self, speed):
        self.static, self.speed = jnp.asarray(1.0), jnp.asarray(speed)

    def mu(self, speed):
        return 0.6 + 0.4 * jnp.exp(-((speed / self.speed) ** 2))


@pytest.mark.slow(first=True)
def test_laws_of_the_user_are_scaled_from_outside():
    length, omega = 2.0**-20, 8.0

    def made(unit, frequency):
        belt = jb.Belt(0.3 * unit * frequency, Gauss(0.2 * unit * frequency), unit)
        return jb.Oscillator(0.1, (belt,), frequency)

    one = jb.find_cycle(made(1.0, 1.0), (1.5, 0.0))
    two = jb.find_cycle(made(length, omega), (1.5 * length, 0.0))
    assert int(one.status) == jb.Status.OK
    same(one.unknowns[:, 0], two.unknowns[:, 0], length)
    assert isinstance(two.oscillator.belts[0].friction, Gauss)


def test_the_own_unit_of_length():
    assert [float(power_of_two_below(x)) for x in (1.0, 1.99, 0.3, 0.0, np.inf)] == [
        1,
        1,
        0.25,
        1,
        1,
    ]
    traced = jax.jit(power_of_two_below)
    for x in (1.0, np.nextafter(2.0, 0), 3e-300, 7e250, 0.0, -1.0, np.nan):
        assert float(traced(x)) == float(power_of_two_below(x))
    law = jb.Coulomb(0.5, 0.4)
    assert float(own_length(jb.Oscillator(0.1, (jb.Belt(3.0, law, 2.0),)))) == 1.0
    # Heavy belts that end at an edge, and belts without load or friction.
    heavy = jb.Belt(-0.7, law, 1e6, lower=-0.5), jb.Belt(0.1, law, 1e-3)
    assert float(own_length(jb.Oscillator(0.1, heavy))) == 0.5
    free = jb.Belt(5.0, law, 0.0), jb.Belt(0.3, jb.Coulomb(0.0, 0.0), 1.0)
    assert float(own_length(jb.Oscillator(0.1, free))) == 0.25
    assert float(own_length(jb.Oscillator(0.1, (jb.Belt(5.0, law, 0.0),)))) == 1.0


def test_there_and_back():
    osc = oscillator(length=3e-6, omega=200.0, lower=-0.4)
    back = in_units_of_user(in_own_units(osc))
    for one, other in zip(jax.tree.leaves(osc), jax.tree.leaves(back), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-15)
    own = in_own_units(osc)
    assert in_own_units(own) is own and float(own.omega) == 1.0
