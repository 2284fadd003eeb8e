"""Basins against a published example, the oracle's unstable cycle, and what must come out."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest
from matplotlib.path import Path
from scipy.linalg import expm
from typer.testing import CliRunner

import jaxbelt as jb
from jaxbelt import Status
from jaxbelt.cli import app
from jaxbelt.sweeps.basins import _labels, rest_reached

# One belt, zeta = 0.1, mu(r) = 0.5 (1 + exp(-r/0.5)); starts uniform in this box. Fraction of
# them that comes to rest: bSTAB and pyBasin, from 5,000 starts each.
BOX = ((-2.0, 2.0), (0.0, 2.0))
PUBLISHED = {1.25: 0.0838, 1.4: 0.211, 1.5: 0.312}


def belt_drive(velocity):
    return jb.Oscillator(0.1, (jb.Belt(velocity, jb.Stribeck(1.0, 0.5, 0.5)),))


def oracle_boundary(velocity):
    """The unstable cycle as a polygon, [2000, 2], by SciPy backwards in time."""
    osc = oracle.Oscillator(0.1, (oracle.Belt(velocity, *oracle.stribeck(1.0, 0.5, 0.5)),))
    cycle = oracle_cycles.unstable_cycle(osc)
    return np.array([cycle.run.at(t) for t in np.linspace(0, cycle.period, 2001)[:-1]])


def area_above(polygon, level):
    """Area of the part of a polygon where x2 > level (its edges cut, then the shoelace formula)."""
    part = []
    for p, q in zip(polygon, np.roll(polygon, -1, axis=0)):
        if p[1] >= level:
            part.append(p)
        if (p[1] >= level) != (q[1] >= level):
            part.append(p + (q - p) * (level - p[1]) / (q[1] - p[1]))
    x, y = np.array(part).T
    return 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("velocity", PUBLISHED)
def test_published_basin_stability_and_area_of_the_unstable_cycle(velocity):
    n = 20_000
    found = jb.basin_stability(belt_drive(velocity), box=BOX, n=n, key=jax.random.key(1))
    fraction, error = found.fractions["equilibrium"], found.standard_errors["equilibrium"]
    assert error == pytest.approx(np.sqrt(fraction * (1 - fraction) / n))
    assert sum(found.fractions.values()) == pytest.approx(1) and found.fractions["undecided"] == 0
    polygon = oracle_boundary(velocity)
    assert np.all(np.abs(polygon[:, 0]) < 2) and np.max(polygon[:, 1]) < 2
    # Sampling errors: once in 15,000 a right result is four of them off.
    assert abs(fraction - area_above(polygon, 0.0) / 8) < 4 * error
    theirs = PUBLISHED[velocity]
    assert abs(fraction - theirs) < 4 * np.hypot(error, np.sqrt(theirs * (1 - theirs) / 5000))


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(("velocity", "exact"), [(1.0, 0.0), (1.9, 1.0)])
def test_one_attractor_alone_is_exact(velocity, exact):
    found = jb.basin_stability(belt_drive(velocity), box=BOX, n=2_000, key=jax.random.key(2))
    assert found.fractions["equilibrium"] == exact
    assert found.fractions["cycle"] == 1 - exact
    if exact:
        starts = {"x1": np.array([-1.0, 0.5, 2.0]), "x2": np.array([0.0, 1.0])}
        grid = jb.basins(belt_drive(velocity), **starts, progress=False)
        # x1 = mu(1.9) at rest
        assert grid.attractors == (f"rest at {0.5 * (1 + np.exp(-3.8)):.3f}",)
        assert np.all(np.asarray(grid.label) == 0)
        assert grid.boundary.status == Status.NO_UNSTABLE_CYCLE


def test_the_bound_is_told_where_all_starts_agree():
    def stability(cycle, n):
        fractions = {"equilibrium": 1 - cycle, "cycle": cycle, "stuck": 0.0, "undecided": 0.0}
        errors = {kind: float(np.sqrt(f * (1 - f) / n)) for kind, f in fractions.items()}
        return jb.BasinStability(fractions, errors, n)

    assert repr(stability(1.0, 1000)) == (
        "BasinStability(all cycle, a fraction above 0.99700 with 95% confidence; 1000 starts)"
    )
    assert "equilibrium 0.25000 +- 0.01369, cycle 0.75000" in repr(stability(0.75, 1000))


@pytest.mark.slow(first=True)
def test_grid_is_split_by_the_unstable_cycle():
    x1, x2 = np.linspace(-1.0, 2.0, 41), np.linspace(-1.3, 1.7, 37)
    found = jb.basins(belt_drive(1.4), x1=x1, x2=x2, progress=False)
    assert found.boundary.status == Status.OK
    # x1 = mu(1.4) at rest
    assert found.attractors == (
        "cycle that sticks to belt 0",
        f"rest at {0.5 * (1 + np.exp(-2.8)):.3f}",
    )
    assert len(found.cycles) == 1 and found.cycles[0].stable
    grid = np.stack(np.meshgrid(x1, x2, indexing="ij"), axis=-1).reshape(-1, 2)
    polygon = Path(oracle_boundary(1.4))
    # Starts nearer to the boundary than its polygon is to the curve are not asked.
    inside, surely = polygon.contains_points(grid, radius=0.0), np.ones(len(grid), bool)
    for radius in (-1e-4, 1e-4):
        surely &= polygon.contains_points(grid, radius=radius) == inside
    assert np.sum(~surely) <= 2
    label = np.asarray(found.label).reshape(-1)
    assert np.array_equal(label[surely] == 1, inside[surely])
    assert "41 x 37 starts" in repr(found)
    call = found.dataset.attrs["call"]
    (asked,) = eval(
        call,
        {
            "jaxbelt": SimpleNamespace(basins=lambda *a, **k: [k]),
            "oscillator": 1,
            "dataset": found.dataset,
        },
    )
    assert np.array_equal(asked["x1"], x1) and np.array_equal(asked["x2"], x2)
    assert asked["t1"] == found.dataset.attrs["t1"]


def test_a_belt_at_rest_holds_what_comes_to_it():
    osc = belt_drive(0.0)
    found = jb.basin_stability(osc, box=BOX, n=200, key=jax.random.key(3))
    assert found.fractions["stuck"] == 1.0


@pytest.mark.slow(first=True)
def test_labels_tell_attractors_of_one_kind_apart():
    """Cycles by where they are; the most frequent first; undecided is none."""
    dataset = jb.sweep(lambda: belt_drive(1.4), {"x1": [0.0] * 5, "x2": [2.0]}, observe="attractor")
    dataset = dataset.load()
    dataset["kind"][:, 0] = [1, 0, 2, 2, 2]  # equilibrium, undecided, cycle ...
    dataset["x1_max"][:, 0] += [0.0, 0.0, 0.0, 1e-9, 0.0]
    cycle, rest = _labels(belt_drive(1.4), dataset)
    assert cycle.runs[:, 0].tolist() == [False, False, True, True, True]
    assert rest.runs[:, 0].tolist() == [True, False, False, False, False]
    assert cycle.name == "cycle that sticks to belt 0"
    assert cycle.cycle is not None and rest.cycle is None


@pytest.mark.slow
def test_two_cycles_with_one_sequence_of_events_are_two():
    """Both stick to belt 0 once a loop, to the left of where belt 1 begins and to the right."""
    osc = jb.presets.class_d(-0.06341, 0.5073, -0.49694, 0.61855)
    found = jb.basins(osc, x1=np.linspace(-2.0, 2.0, 9), x2=np.linspace(-1.0, 1.0, 5))
    assert len({cycle.signature for cycle in found.cycles}) == 1
    periods = sorted(float(cycle.period) for cycle in found.cycles)
    assert periods == pytest.approx([9.9148027860, 10.9019400715], abs=1e-9)
    assert [name for name in found.attractors if name.startswith("cycle")] == [
        "cycle that sticks to belt 0 (1)",
        "cycle that sticks to belt 0 (2)",
    ]


@pytest.mark.slow(first=True)
def test_two_segments_are_two_attractors():
    """A belt at rest touches on both sides of a stretch without it."""
    law = jb.Conti(0.3, 0.2, 10.0)  # the law of the test above, for one program
    belts = (jb.Belt(0.0, law, upper=-0.1), jb.Belt(0.0, law, lower=0.1))
    osc = jb.Oscillator(0.5, belts)
    found = jb.basins(osc, x1=np.linspace(-0.3, 0.3, 7), x2=np.array([-0.1, 0.1]))
    stuck = np.asarray(jb.decoded(found.dataset).kind) == "stuck"
    x1 = np.asarray(found.dataset.x1_min)[stuck]
    labels = np.asarray(found.label)[stuck]
    assert len(set(labels[x1 < 0]) & set(labels[x1 > 0])) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"x1": [0.0, 0.0], "x2": [0.0]}, "x1 must be increasing"),
        ({"x1": [0.0], "x2": [jnp.nan]}, "x2 must be finite"),
    ],
)
def test_impossible_grids_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        jb.basins(belt_drive(1.4), **arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"box": ((0.0, 0.0), (0.0, 1.0))}, r"box\[0\], x1 must be \(first, last\)"),
        ({"box": (0.0, 1.0)}, r"box must be \(\(x1 from"),
        ({"box": BOX, "n": 0}, "n must be a positive integer"),
    ],
)
def test_impossible_boxes_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        jb.basin_stability(belt_drive(1.4), key=jax.random.key(0), **arguments)


@pytest.mark.slow(first=True)
def test_command_writes_a_picture_and_a_table(tmp_path):
    belt = "1.4,law=stribeck,static=1,kinetic=0.5,stribeck_velocity=0.5"
    words = f"basins --belt {belt} --damping 0.1 --x1 -1 2 --x2 0 1 --points 5 --starts 50"
    run = CliRunner().invoke(app, [*words.split(), "--out", str(tmp_path / "here")])
    assert run.exit_code == 0, run.output
    assert "Basins(5 x 5 starts" in run.output and "BasinStability(" in run.output
    assert (tmp_path / "here.png").stat().st_size > 10_000
    rows = (tmp_path / "here.csv").read_text(encoding="utf-8").splitlines()
    # The start (0.5, 0.25) is near the equilibrium at 0.530, the other basin.
    assert rows[0] == "x1,x2,label" and len(rows) == 26 and "0.5,0.25,1" in rows
    run = CliRunner().invoke(app, [*words.replace("--points 5", "--points 1").split()])
    assert run.exit_code == 2 and "points must be at least 2, got 1" in run.output


def test_a_rest_that_is_not_near_is_not_the_one_that_a_run_has_come_to():
    """One is known, at 0.8; a run that stands elsewhere is told to be there."""
    rest, _, _ = rest_reached(jb.presets.class_a(0.1), np.array([0.805, 0.3]))
    assert rest == pytest.approx([0.8, 0.3], abs=1e-12)


# --- finite-time basin stability ------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_a_linear_oscillator_comes_near_when_its_solution_does():
    """Constant friction of a belt that is always faster: a damped oscillator around x1 = 1."""
    osc = jb.Oscillator(0.4, (jb.Belt(5.0, jb.Stribeck(1.0, 1.0, 0.5)),))
    axes = {"x1": np.linspace(-0.5, 2.5, 31), "x2": np.linspace(-1.5, 1.5, 29)}
    found = jb.basins(osc, **axes, progress=False)
    assert found.attractors == ("rest at 1.000",)
    starts = np.stack(np.meshgrid(*axes.values(), indexing="ij"), axis=-1) - [1.0, 0.0]
    shares = []
    for t in (1e-6, 2.0, 5.0, 12.0):
        there = starts @ expm(t * np.array([[0.0, 1.0], [-1.0, -0.4]])).T
        away = np.hypot(there[..., 0], there[..., 1])
        assert np.min(np.abs(away - 0.31)) > 1e-6  # no start is in doubt
        shares.append(np.mean(away < 0.31))
        assert found.finite_time_stability(t, 0.31).tolist() == [shares[-1]]
    assert shares[0] < shares[1] < shares[2] < shares[3] == 1


@pytest.mark.slow(first=True)
def test_near_a_cycle_is_near_to_one_of_its_states():
    osc = jb.presets.class_b(0.45, 0.35)
    x1, x2 = np.linspace(1.0, 1.7, 7), np.array([-0.2, 0.03])
    found = jb.basins(osc, x1=x1, x2=x2, progress=False)
    assert [name.split()[0] for name in found.attractors] == ["rest", "cycle"]
    labels, rest = np.asarray(found.label), [float(jb.equilibria(osc).x1[0]), 0.0]
    # By other means: chords of a fine polygon are shorter than 1e-4.
    polygon = np.asarray(found.cycles[0].sample(100_000))
    for t, within in ((2.0, 0.03), (6.0, 0.02), (30.0, 0.01)):
        near = np.zeros(2)
        for (i, j), label in np.ndenumerate(labels):
            end = np.asarray(jb.simulate(osc, (x1[i], x2[j]), t, ts=np.array([t])).ys[-1])
            away = np.min(np.hypot(*(end - (polygon if label == 1 else [rest])).T))
            assert abs(away - within) > 1e-4
            near[label] += away < within
        told = found.finite_time_stability(t, within)
        np.testing.assert_allclose(told, near / labels.size, rtol=0, atol=1e-15)
    ever = [np.mean(labels == 0), np.mean(labels == 1)]
    np.testing.assert_allclose(found.finite_time_stability(1000.0, 1e-3), ever, atol=1e-15)
    with pytest.raises(ValueError, match=r"t must be > 0, got 0\.0"):
        found.finite_time_stability(0.0, 0.1)
    with pytest.raises(ValueError, match=r"within must be > 0, got -1\.0"):
        found.finite_time_stability(1.0, -1.0)


@pytest.mark.slow(first=True)
def test_a_mass_that_is_held_is_at_its_segment_wherever_on_it():
    osc = jb.Oscillator(0.1, (jb.Belt(0.0, jb.Stribeck(1.0, 0.5, 0.5)),))
    found = jb.basins(osc, x1=np.array([-0.6, 0.3, 2.0]), x2=np.array([0.0]), progress=False)
    assert found.attractors == ("stuck to belt 0",)
    # Two begin there and stay; the third is on its way.
    assert found.finite_time_stability(0.5, 1e-6).tolist() == [2 / 3]
    assert found.finite_time_stability(50.0, 1e-6).tolist() == [1.0]


# --- basin entropy --------------------------------------------------------------------------------


def entropy_of(labels, side):
    """Of basins of which only the labels are known."""
    return jb.Basins.entropy(SimpleNamespace(label=np.asarray(labels)), side)


def test_one_basin_has_no_entropy():
    entropy = entropy_of(np.zeros((6, 4), int), 2)
    assert entropy.basins == 0 and np.isnan(entropy.boundary)


def test_a_straight_boundary():
    """Through the middles of one column of boxes of three."""
    labels = np.zeros((20, 12), int)
    labels[10:] = 1
    entropy = entropy_of(labels, 4)
    assert entropy.boundary == pytest.approx(np.log(2), abs=1e-15)
    assert entropy.basins == pytest.approx(np.log(2) / 5, abs=1e-15)
    # On the edges of boxes it is not seen.
    assert entropy_of(labels, (10, 4)).basins == 0
    # A quarter of each box.
    labels[9:] = 1
    quarter = -0.25 * np.log(0.25) - 0.75 * np.log(0.75)
    assert entropy_of(labels, 4).boundary == pytest.approx(quarter, abs=1e-15)


def test_a_checkerboard_and_more_than_two_labels():
    board = np.indices((8, 6)).sum(axis=0) % 2
    assert entropy_of(board, 2) == pytest.approx((np.log(2), np.log(2)), abs=1e-15)
    three = np.tile([[-1, 0, 1]], (4, 2))
    assert entropy_of(three, (2, 3)) == pytest.approx((np.log(3),) * 2, abs=1e-15)
    assert entropy_of(three, 1).basins == 0


@pytest.mark.parametrize(
    ("side", "message"),
    [
        (5, r"side must be one that divides the 8 x 6 starts, got 5"),
        ((2, 4), r"side must be one that divides the 8 x 6 starts, got \(2, 4\)"),
        (0, "side must be a positive integer, got 0"),
        ((2, -1), "side must be a positive integer, got -1"),
    ],
)
def test_impossible_boxes_of_an_entropy_are_named(side, message):
    with pytest.raises(ValueError, match=message):
        entropy_of(np.zeros((8, 6), int), side)


@pytest.mark.slow(first=True)
def test_two_attractors_of_one_kind_have_numbers():
    """Two motions of one period that stick to one belt; each is drawn in the colour of its name."""
    belt = jb.Belt(0.2, jb.Stribeck(0.4, 0.2, 0.1), 1.0)
    forcing = (jb.Harmonic(0.109453140753, 0.9, 0.5), jb.BaseMotion(0.16, 0.9))
    osc = jb.Oscillator(0.1, (belt,), forcing=forcing)
    found = jb.basins(osc, x1=np.linspace(-1, 1, 9), x2=np.linspace(-0.8, 0.8, 9), t1=3000.0)
    name = "1-periodic motion that sticks to belt 0"
    assert found.attractors == (f"{name} (1)", f"{name} (2)")
    assert abs(found.cycles[0].x1_max - found.cycles[1].x1_max) > 0.01
    _, labels = found.plot().get_legend_handles_labels()
    assert labels == [f"to {name} (1)", f"to {name} (2)", f"{name} (1)", f"{name} (2)"]
