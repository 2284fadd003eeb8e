"""Basin fractions along a parameter: against the engine, closed forms, and what must come out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from where import nu0

import jaxbelt as jb
from jaxbelt.cycles.attractors import Runs
from jaxbelt.model.variations import varied
from jaxbelt.sweeps import fractions
from jaxbelt.sweeps.attractor import CYCLE, EQUILIBRIUM, STUCK_FOR_EVER
from jaxbelt.sweeps.basins import starts_in
from jaxbelt.sweeps.fractions import _matched, _Met
from tests.campaign import engine
from tests.campaign import fractions as campaign
from tests.campaign.cases import PAPER

NU1, BOX, KEY = 0.35, ((-1.0, 3.0), (-1.0, 1.0)), jax.random.key(4)
#: Where the equilibrium of class (b) loses its stability, and where the cycle vanishes.
HOPF, FOLD = 0.263654916039, 0.538734800481


def by_nu0():
    """What is varied where that does not matter."""
    return varied(jb.presets.class_b(0.3, NU1), nu0, (0.3,))


def along(osc, span, rows, **options):
    return jb.basin_fractions(
        osc, nu0, span, rows=rows, **{"box": BOX, "n": 200, "key": KEY, **options}
    )


@pytest.fixture(scope="module")
def found():
    return along(jb.presets.class_b(0.3, NU1), (-0.7, 0.7), 29)


@pytest.mark.slow(first=True)
def test_attractors_keep_their_names_and_are_where_they_are(found):
    values, met = found.values, found.fractions > 0
    assert found.attractors[:2] == ("equilibrium 0", "cycle 0") and values[14] == 0
    # A belt at rest holds the mass, so there are cycles of two names, and on both sides of 0 rest.
    assert found.attractors[2:] == ("stuck 0", "cycle 1", "equilibrium 1")
    np.testing.assert_array_equal(np.flatnonzero(met[:, 2]), [14])
    np.testing.assert_array_equal(met[:, 1], (values > -0.5613024) & (values < 0))
    np.testing.assert_array_equal(met[:, 3], (values > 0) & (values < FOLD))
    # Of a small basin there may be no start.
    assert np.all(met[:, 4] <= (values > HOPF)) and np.all(met[values > 0.33, 4])
    for row, column in zip(*np.nonzero(met)):
        osc = jb.presets.class_b(values[row], NU1)
        place = [getattr(found, name)[row, column] for name in ("x1_min", "x1_max", "x2_max")]
        if column in (1, 3):
            cycle = jb.find_cycle(osc, (3.0, 0.0))
            right = [float(getattr(cycle, name)) for name in ("x1_min", "x1_max", "x2_max")]
            assert found.period[row, column] == pytest.approx(float(cycle.period), abs=1e-5)
        else:
            rest = jb.equilibria(osc)[0]
            right = [float(rest.x1_lower), float(rest.x1_upper), 0.0]
            assert np.isnan(found.period[row, column])
        assert place == pytest.approx(right, abs=1e-6)
    assert np.all(np.isnan(found.x1_min[~met])) and np.all(found.undecided == 0)


@pytest.mark.slow(first=True)
def test_fractions_add_up_and_have_their_errors(found):
    np.testing.assert_allclose(np.sum(found.fractions, axis=1), 1.0, rtol=0, atol=1e-14)
    variance = found.fractions * (1 - found.fractions) / 200
    np.testing.assert_allclose(found.standard_errors**2, variance, rtol=1e-14)
    table = found.table()
    assert len(table) == np.sum(found.fractions > 0) and "undecided" not in set(table.attractor)
    rows = table[table.attractor == "equilibrium 1"]
    assert rows.fraction.tolist() == found.fractions[found.fractions[:, 4] > 0, 4].tolist()
    assert repr(found) == (
        "BasinFractions(belts[0].velocity from -0.7 to 0.7, 29 values, 200 starts each: "
        "equilibrium 0, cycle 0, stuck 0, cycle 1, equilibrium 1)"
    )


@pytest.mark.slow(first=True)
def test_each_value_has_starts_of_its_own_and_compiles_nothing(found):
    with compilations() as compiled:
        # One attractor alone.
        alone = along(jb.presets.class_b(0.3, NU1), (0.6, 0.7), 3)
        # Equal belts, from which a cycle changes what it sticks to, and keeps its name.
        equal = along(jb.presets.class_b(0.3, NU1), (0.3, 0.4), 3)
        again = along(jb.presets.class_b(0.3, NU1), (0.3, 0.4), 3)
    # But for how the rows of a function are made.
    assert set(compiled) == {"jit(_rows)"}
    assert alone.attractors == ("equilibrium 0",) and np.all(alone.fractions == 1)
    assert np.all(alone.standard_errors == 0)
    assert equal.values[1] == NU1 and "cycle 0" in equal.attractors
    assert np.all(equal.fractions[:, equal.attractors.index("cycle 0")] > 0.9)
    assert set(equal.attractors) <= {"cycle 0", "equilibrium 0"}
    np.testing.assert_array_equal(again.fractions, equal.fractions)


@pytest.mark.slow(first=True)
def test_at_a_hopf_point_the_equilibrium_attracts_nothing():
    found = along(jb.presets.class_b(0.3, NU1), (HOPF, 0.45), 2, n=300)
    assert found.attractors == ("cycle 0", "equilibrium 0")
    assert found.fractions[0].tolist() == [1 - found.undecided[0], 0.0]
    assert found.fractions[1, 1] > 0


class Rayleigh(jb.AbstractFriction):
    """mu(1 - v) = 1 + 0.3 (0.98 v - 8/3 v^3): without damping a cycle of amplitude 0.7 attracts."""

    static: jax.Array

    def mu(self, speed):
        v = 1.0 - speed
        return 1.0 + 0.3 * (0.98 * v - 8 / 3 * v**3)


@pytest.mark.slow(first=True)
def test_of_many_cycles_that_to_which_most_runs_lead_is_looked_into(monkeypatch):
    """What is left beyond the limit is undecided; a continuum of closed orbits may come first."""
    monkeypatch.setattr(fractions, "MOST_CYCLES", 3)
    osc = jb.Oscillator(0.0, (jb.Belt(1.0, Rayleigh(jnp.asarray(3.0))),))
    radii = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.7, 0.7])
    places = np.column_stack([1 - radii, 1 + radii, -radii, radii, np.full(8, 2 * np.pi)])
    runs = Runs(places, np.full(8, ""), 1e-6)
    left = fractions._closed_only(osc, np.full(8, True), runs)
    # From within the cycle all orbits lead to it.
    assert left.tolist() == [False] * 2 + [True] * 3 + [False] * 3


@pytest.mark.slow(first=True)
def test_without_damping_all_starts_are_undecided():
    """Two belts with constant friction, one to each side of the motion: circles, for ever. They
    close, and attract nothing."""
    law = jb.Conti(1.0, 1.0, 10.0)
    osc = jb.Oscillator(0.0, (jb.Belt(0.5, law), jb.Belt(-0.5, law)))
    found = along(osc, (0.5, 0.6), 2, n=20, box=((-0.2, 0.2), (-0.2, 0.2)), t1=100.0)
    assert found.attractors == () and found.fractions.shape == (2, 0)
    assert found.undecided.tolist() == [1.0, 1.0]
    table = found.table()
    assert table.attractor.tolist() == ["undecided"] * 2 and table.x1_min.isna().all()
    assert repr(found).endswith("no attractor; up to 100.0% undecided)")
    assert found.plot().get_legend_handles_labels()[1] == ["undecided"]


@pytest.mark.slow(first=True)
def test_a_steep_branch_is_one_and_a_jump_is_two():
    """The cycle grows with the load, by a factor of ten in two steps: from 3 to 10 it moves by more
    than a quarter of all. Where belt 0 changes its direction another cycle appears elsewhere."""

    def growing(exponent):
        law = jb.Conti(1.0, 0.6, 10.0)
        return jb.Oscillator(0.1, (jb.Belt(0.05, law, load=10.0**exponent),))

    options = {"box": ((-1.0, 1.0), (-1.0, 1.0)), "n": 20, "key": KEY}
    grown = jb.basin_fractions(growing, span=(0.0, 1.0), rows=3, **options)
    assert grown.attractors == ("cycle 0",)
    assert np.ptp(grown.x1_max[1:, 0]) > 0.5 * np.max(grown.x1_max)
    jump = along(jb.presets.class_b(0.1, NU1), (-0.01, 0.01), 2, n=20, moves=0.5)
    assert jump.attractors == ("cycle 0", "cycle 1")


@pytest.mark.slow(first=True)
def test_where_there_is_no_oscillator_nothing_is_decided():
    def make(s):
        return jb.presets.class_b(jnp.sqrt(s**2 - 0.01), NU1)

    found = jb.basin_fractions(make, span=(-0.4, 0.4), rows=3, box=BOX, n=200, key=KEY)
    assert found.undecided.tolist() == [0.0, 1.0, 0.0] and found.name == "s"
    assert np.all(found.fractions[1] == 0) and np.all(found.fractions[[0, 2], 0] > 0.9)
    assert sorted(found.attractors) == ["cycle 0", "equilibrium 0"]


# --- matching, of attractors that are made up -----------------------------------------------------


def met(kind, x1, fraction=0.5, size=0.0):
    return _Met(kind, np.array([x1 - size, x1 + size, -size, size, 0.0]), fraction)


def names_at(*rows, moves=0.2):
    """The names of the attractors at each value, in their order there."""
    found = _matched(list(rows), np.arange(float(len(rows))), moves, 100, by_nu0())
    told = []
    for row, attractors in enumerate(rows):
        column = {float(x): name for x, name in zip(found.x1_min[row], found.attractors)}
        told.append([column[float(one.place[0])] for one in attractors])
    return told


def test_two_attractors_that_change_places_in_size_keep_their_names():
    first = [met(EQUILIBRIUM, 0.0, 0.6), met(EQUILIBRIUM, 1.0, 0.4)]
    second = [met(EQUILIBRIUM, 1.1, 0.7), met(EQUILIBRIUM, 0.1, 0.3)]
    assert names_at(first, second) == [
        ["equilibrium 0", "equilibrium 1"],
        ["equilibrium 1", "equilibrium 0"],
    ]


@pytest.mark.slow(first=True)
def test_a_shift_of_all_is_followed_though_one_is_nearer_to_another():
    first = [met(CYCLE, 0.0), met(CYCLE, 1.0)]
    second = [met(CYCLE, 0.9), met(CYCLE, 1.9)]
    assert names_at(first, second, moves=0.95)[1] == ["cycle 0", "cycle 1"]
    # What may move by less is the nearest one, and another that is new.
    assert names_at(first, second, moves=0.2)[1] == ["cycle 1", "cycle 2"]


def test_what_jumps_or_is_of_another_kind_has_a_new_name():
    at_rest, cycle = met(EQUILIBRIUM, 0.0, 1.0), met(CYCLE, 0.0, 1.0, size=0.1)
    rows = [[at_rest], [met(EQUILIBRIUM, 2.0, 1.0)], [cycle], [met(CYCLE, 0.0, size=0.5)], []]
    rows += [[met(STUCK_FOR_EVER, 0.0)], [met(EQUILIBRIUM, 1.0)]]
    assert names_at(*rows) == [
        *(["equilibrium 0"], ["equilibrium 1"], ["cycle 0"], ["cycle 1"], []),
        *(["stuck 0"], ["equilibrium 2"]),
    ]


def test_what_was_not_met_at_a_value_is_known_again():
    one, other = met(EQUILIBRIUM, 0.0), met(EQUILIBRIUM, 0.15)
    assert names_at([one], [], [met(EQUILIBRIUM, 0.1)]) == [
        ["equilibrium 0"],
        [],
        ["equilibrium 0"],
    ]
    # What was there just before comes first, though it is farther.
    assert names_at([other, one], [one], [met(EQUILIBRIUM, 0.14), met(EQUILIBRIUM, 0.3)]) == [
        *(["equilibrium 0", "equilibrium 1"], ["equilibrium 1"]),
        ["equilibrium 1", "equilibrium 0"],
    ]


def test_bands_end_half_way_to_where_an_attractor_is_not():
    rows = [[met(EQUILIBRIUM, 0.0, 1.0)]] * 2
    rows += [[met(CYCLE, 0.0, 0.75, size=0.5), met(EQUILIBRIUM, 0.0, 0.25)]] * 2
    ax = _matched(rows, np.arange(4.0), 0.2, 100, by_nu0()).plot()
    labels = ax.get_legend_handles_labels()
    bands = {name: band.get_paths() for band, name in zip(*labels)}
    assert sorted(bands) == ["cycle 0", "equilibrium 0", "two standard errors"]
    (cycle,) = bands["cycle 0"]
    np.testing.assert_allclose(cycle.get_extents().extents, [1.5, 0.25, 3.0, 1.0])
    assert ax.get_ylabel() == "fraction of 100 starts" and ax.get_ylim() == (0, 1)


# --- against the engine ---------------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_start_by_start_the_engine_agrees():
    """Its own starts: no error of sampling hides a wrong label. The whole campaign is
    `python -m tests.campaign fractions --runs 100000`."""
    told = jb.basin_fractions(
        lambda nu0: jb.presets.class_b(nu0, NU1),
        span=campaign.SPAN,
        rows=campaign.VALUES,
        **{"box": campaign.BOX, "n": 300, "key": KEY},
    )
    agree(told, campaign.class_b, campaign.BOX)


@pytest.mark.slow
def test_start_by_start_with_edges_and_three_equilibria():
    """Most of the basin of one of them goes over to another at about 0.53."""
    box = ((-2.0, 2.0), (-1.0, 1.0))
    told = jb.basin_fractions(
        lambda sigma1: jb.presets.class_d(-0.5, 0.5, -0.4, sigma1),
        span=(0.44, 0.56),
        rows=4,
        **{"box": box, "n": 300, "key": KEY},
    )
    assert told.attractors == ("equilibrium 0", "equilibrium 1", "equilibrium 2")
    assert np.all(told.fractions[:3, 1] > 0.2) and 0 < told.fractions[3, 1] < 0.1

    def make(sigma1):
        belts = engine.Belt(-0.5, PAPER, upper=sigma1), engine.Belt(0.5, PAPER, lower=-0.4)
        return engine.Oscillator(0.5, belts)

    agree(told, make, box)


def agree(told, make, box):
    """At every value as many of its starts lead to each attractor by the engine."""
    for row, value in enumerate(told.values):
        starts = starts_in(np.array(box), told.n, jax.random.fold_in(KEY, row))
        seen = campaign.of_starts(make(float(value)), starts.T, threads=2)
        wrong, _ = campaign.differences(told, row, seen)
        assert not wrong
        counts = np.sort(told.n * told.fractions[row][told.fractions[row] > 0])
        np.testing.assert_allclose(counts, np.sort(seen.counts), rtol=0, atol=1e-9)
