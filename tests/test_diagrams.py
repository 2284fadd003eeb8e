"""Bifurcation diagrams against closed forms and the oracle, and their pictures."""

import numpy as np
import oracle
import oracle_cycles
import pytest

import jaxbelt as jb
from jaxbelt import EventKind
from jaxbelt.bifurcations.diagrams import region_name
from jaxbelt.bifurcations.labels import Label


def nu0(osc):
    return osc.belts[0].velocity


@pytest.fixture(scope="module")
def diagram():
    return jb.bifurcation_diagram(jb.presets.class_b(0.3, 0.35), nu0, (-0.7, 0.7))


def test_regions_are_named_as_in_the_paper(diagram):
    """With 4a, which the paper misses; 5b and 6 on the far side as it has them."""
    names = [name for _, _, name in diagram.regions]
    assert names == ["6", "5b", "5c", "4c", "4a", "3a", "2a", "2b", "1"]
    values = [float(point.value) for point in diagram.points]
    assert [last for _, last, _ in diagram.regions[:-1]] == values
    assert "8 points, 4 branches, regions 6 | 5b" in repr(diagram)


def test_equilibria_are_those_of_the_closed_form(diagram):
    left, right = (branch for branch in diagram.branches if branch.kind == "equilibrium")
    for branch in (left, right):
        nu = branch.values
        # Eq. (24) for two belts: both pull with mu, in the direction in which they run.
        pull = np.sign(nu) * (0.6 + 0.4 / (1 + 10 * np.abs(nu))) + 0.6 + 0.4 / 4.5
        assert np.allclose(branch.x1_min, pull, rtol=0, atol=1e-15)
        slope = 4 / (1 + 10 * np.abs(nu)) ** 2 + 4 / 4.5**2  # eq. (27)
        assert np.all(branch.stable == (slope < 0.5))
        assert np.all(np.diff(nu) > 0) and np.sum(np.diff(branch.stable)) == 1


def test_cycles_are_those_of_the_oracle(diagram):
    cycles = [branch for branch in diagram.branches if branch.kind == "cycle"]
    for branch in cycles:
        for stable in (True, False):
            row = np.flatnonzero(branch.stable == stable)[15]
            osc = oracle.class_b(float(branch.values[row]), 0.35)
            find = oracle_cycles.sticking_cycle if stable else oracle_cycles.unstable_cycle
            expected = find(osc)
            assert expected is not None
            # The oracle integrates to 1e-13; unstable cycles are good to 1e-9 there.
            assert branch.period[row] == pytest.approx(expected.period, rel=1e-8)
            assert branch.x1_max[row] == pytest.approx(expected.x1_max, abs=1e-8)
            assert branch.x1_min[row] == pytest.approx(expected.x1_min, abs=1e-8)
            assert branch.multiplier[row] == pytest.approx(expected.multiplier, rel=1e-7)


def test_branches_of_cycles_go_on_through_grazing_exchange_and_fold(diagram):
    left, right = (branch for branch in diagram.branches if branch.kind == "cycle")
    fold, _, hopf, grazing, _, _, exchange, other_fold = (float(p.value) for p in diagram.points)
    for branch, turning in ((left, fold), (right, other_fold)):
        # From where belt 0 rests to the fold, and back from there to the Hopf point.
        loop = int(np.argmax(np.abs(branch.values)))
        # Rows end beside the points, 1e-6 (1 + span) away.
        assert branch.values[loop] == pytest.approx(turning, abs=3e-6)
        assert np.all(branch.stable[: loop + 1]) and not np.any(branch.stable[loop + 2 :])
        assert abs(branch.values[-1]) == pytest.approx(-hopf, abs=3e-6)
        # It shrinks to the equilibrium like a square root: to 1e-3 at 2.4e-6 from the Hopf point.
        assert branch.x1_max[-1] - branch.x1_min[-1] < 3e-3
        # Rows are dense enough for a picture, and no two ends are joined that do not belong.
        assert np.max(np.abs(np.diff(branch.x1_max))) < 0.06
    sticks = ~np.isnan(left.stick_velocities[left.stable])
    values = left.values[left.stable]
    assert np.all(sticks[:, 1] == (values < grazing)) and np.all(sticks[values > -0.45, 0])
    sticks = ~np.isnan(right.stick_velocities[right.stable])
    values = right.values[right.stable]
    assert np.all(sticks[:, 0] == (values < exchange)) and np.all(sticks[:, 1] != sticks[:, 0])


SLIPS, STICKS_0, STICKS_1 = ((1, 1),), ((0, -1), (1, -1)), ((-1, 0), (-1, 1))


@pytest.mark.parametrize(
    ("velocities", "stable", "cycles", "name"),
    [
        ((0.3, 0.7), True, (), "1"),
        ((0.3, -0.7), True, (), "6"),
        ((0.3, 0.7), True, (STICKS_0,), "2a"),
        ((-0.3, 0.7), True, (((-1, 0), (-1, 1), (0, 1), (1, 1)),), "5c"),
        ((0.3, 0.7), False, (STICKS_1,), "3b"),
        ((-0.3, 0.7), False, (SLIPS,), "4s"),
        ((0.3, 0.7), True, (STICKS_0, STICKS_1), "2ab"),
        ((0.3, 0.7), True, (STICKS_0, STICKS_0), "2aa"),
        ((0.3,), False, (((0,), (1,)),), "3"),
        ((0.3, 0.4, 0.5), False, (((-1, 0, 1), (-1, -1, 0)),), "3f"),
    ],
)
def test_names_of_regions(velocities, stable, cycles, name):
    osc = jb.Oscillator(0.5, [jb.Belt(v, jb.Conti(1.0, 0.6, 10.0)) for v in velocities])
    rests = ((1, stable, (1,) * len(velocities)),)
    assert region_name(osc, Label(rests, cycles)) == name


def test_picture(diagram):
    for quantity in ("x2", "x1", "period"):
        ax = diagram.plot(quantity=quantity)
        texts = {text.get_text() for text in ax.texts}
        assert {"6", "4a", "2b", "fold, belt 1", "grazing, belt 0", "belt 0 at rest"} <= texts
        assert ax.get_xlabel() == r"belt velocity $\nu_0$"
    with pytest.raises(ValueError, match="quantity must be one of x2, x1, period, got 'x3'"):
        diagram.plot(quantity="x3")


def test_picture_shows_stick_velocities_and_dashes_what_is_unstable(diagram):
    lines = diagram.plot().get_lines()
    dashed = [line for line in lines if line.get_label() == "unstable cycle"]
    assert len(dashed) == 2 and all(line.is_dashed() for line in dashed)
    stable = [line for line in lines if line.get_label() == "stable cycle"]
    heights = [line.get_ydata()[~np.isnan(line.get_ydata())] for line in stable]
    # Sticks on belt 1 at x2 = nu1, or on belt 0 at x2 = nu0.
    for line, height in zip(stable, heights, strict=True):
        nu = line.get_xdata()[~np.isnan(line.get_ydata())]
        assert np.allclose(height, 0.35) or np.allclose(height, nu)


def test_impossible_rows_are_named():
    with pytest.raises(ValueError, match="rows must be a positive integer, got 0"):
        jb.bifurcation_diagram(jb.presets.class_b(0.3, 0.35), nu0, (-0.7, 0.7), rows=0)


# --- region maps ----------------------------------------------------------------------------------

#: No two of these are equal, and none is zero.
NU0S, NU1S = np.linspace(-0.65, 0.66, 12), np.linspace(-0.64, 0.65, 11)


def expected_name(nu0, nu1):
    """The region's name from the oracle's cycle and the trace, eq. (27), in closed form."""
    rest = 4 / (1 + 10 * abs(nu0)) ** 2 + 4 / (1 + 10 * abs(nu1)) ** 2 < 0.5
    cycle = oracle_cycles.sticking_cycle(oracle.class_b(nu0, nu1))
    if cycle is None:
        return "6" if nu0 * nu1 < 0 else "1"
    same, against = ("2", "5") if rest else ("3", "4")
    letter = "-abc"[sum(2**k for k in (0, 1) if cycle.stick_durations[k] > 0)]
    return (against if nu0 * nu1 < 0 else same) + letter


@pytest.fixture(scope="module")
def cells():
    return jb.region_map(jb.presets.class_b, {"nu0": NU0S, "nu1": NU1S}, lines=0)


def test_cells_are_named_as_the_oracle_finds(cells):
    rng = np.random.default_rng(7)
    for i, j in zip(rng.integers(0, 12, 14), rng.integers(0, 11, 14), strict=True):
        assert cells.label[i, j] == expected_name(float(NU0S[i]), float(NU1S[j]))
    # Those of the paper, and 4a, 4b, 5a beside them.
    assert set(cells.regions) >= {"1", "2a", "2b", "3a", "3b", "4a", "4b", "4c", "6"}
    assert cells.curves == () and "12 x 11 cells" in repr(cells)


def test_an_example_lies_in_its_region(cells):
    for name in cells.regions:
        assert expected_name(*cells.example(name)) == name
        osc = cells.oscillator(name)
        assert (float(osc.belts[0].velocity), float(osc.belts[1].velocity)) == cells.example(name)
    with pytest.raises(ValueError, match="name must be one of 1, 2a"):
        cells.example("7")


def test_cycles_in_the_examples_are_those_of_the_names(cells):
    """Each once, though several starts lead to it; with the belts that it sticks to."""
    for name, cycles in cells.cycles.items():
        stable = [cycle for cycle in cycles if cycle.stable]
        assert len(stable) == (name[0] in "2345")
        assert len(cycles) - len(stable) == (name[0] in "25")
        for cycle in stable:
            belts = {belt for kind, belt in cycle.signature if kind == EventKind.STICK}
            assert belts == {"a": {0}, "b": {1}, "c": {0, 1}}[name[1]]


def test_impossible_axes_are_named():
    with pytest.raises(ValueError, match="axes must be a dictionary, two arguments of make"):
        jb.region_map(jb.presets.class_b, {"nu0": NU0S})
    with pytest.raises(ValueError, match="nu1 must be two values or more that increase"):
        jb.region_map(jb.presets.class_b, {"nu0": NU0S, "nu1": NU1S[::-1]})


@pytest.fixture(scope="module")
def bounded():
    axes = {"nu0": NU0S, "nu1": NU1S}
    return jb.region_map(jb.presets.class_b, axes, starts=((3.0, 0.0),))


@pytest.mark.slow
def test_no_curve_is_missing_by_symmetry(bounded):
    """The mirror image of each curve, and what it becomes with the belts exchanged, are there."""
    mirrored, exchanged = (lambda at: -at), (lambda at: at[::-1])
    paths, special = {}, {}
    for curve in bounded.curves:
        kind, belts = curve.condition.lineage
        belts = frozenset(belts)
        paths.setdefault((kind, belts), []).append(curve.path)
        points = [np.array(point.values) for point in curve.special]
        special.setdefault((kind, belts), []).extend(points)
    for (kind, belts), own in paths.items():
        other = kind, frozenset(1 - belt for belt in belts)
        for image, of in ((mirrored, (kind, belts)), (exchanged, other)):
            # The rim of the map is not symmetric; chords of 0.01 stand for a bent curve.
            inside = [at for at in np.concatenate(own) if np.max(np.abs(at)) < 0.63]
            assert max(min(nearest(path, image(at)) for path in paths[of]) for at in inside) < 2e-3
            for at in special[kind, belts]:
                gap = min(np.max(np.abs(image(at) - one)) for one in special[of])
                assert gap < 1e-9 or np.max(np.abs(at)) > 0.63


@pytest.mark.slow
def test_curves_bound_the_regions(bounded):
    """Where neighbouring cells have different names a curve passes between them."""
    # Chords of 0.01 stand for a bent curve, so cells that it all but touches do not count.
    paths = [curve.path for curve in bounded.curves]
    for i in range(11):
        for j in range(1, 10):  # on the rim the curves end
            ends = np.array([(NU0S[i], NU1S[j]), (NU0S[i + 1], NU1S[j])])
            differ = bounded.label[i, j] != bounded.label[i + 1, j]
            crossings = sum(crosses(path, *ends) for path in paths)
            near = min(nearest(path, end) for path in paths for end in ends) < 2e-3
            fits = crossings > 0 if differ else crossings % 2 == 0  # through a tip and out again
            assert near or fits, (ends, differ, crossings)


def crosses(path, a, b):
    """How often a path crosses the segment from a to b, which is parallel to the first axis."""
    above = path[:, 1] > a[1]
    rows = np.flatnonzero(above[1:] != above[:-1])
    p, q = path[rows], path[rows + 1]
    x = p[:, 0] + (a[1] - p[:, 1]) / (q[:, 1] - p[:, 1]) * (q[:, 0] - p[:, 0])
    return int(np.sum((a[0] < x) & (x < b[0])))


def nearest(path, at):
    p, chord = path[:-1], np.diff(path, axis=0)
    part = np.sum((at - p) * chord, axis=1) / np.maximum(np.sum(chord**2, axis=1), 1e-30)
    return np.min(np.hypot(*(at - p - np.clip(part, 0, 1)[:, None] * chord).T))
