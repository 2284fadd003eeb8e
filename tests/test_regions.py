"""Region maps with contact edges: what cells know, and that curves bound all of them."""

import functools
import itertools

import matplotlib.pyplot as plt
import numpy as np
import oracle
import oracle_cycles
import pytest
from scipy.spatial import cKDTree

import jaxbelt as jb
from jaxbelt.bifurcations.bounds import Bounds, _without_known, neighbours_that_differ
from jaxbelt.bifurcations.cells import belts_of_letters, motions_in_cells, region_name
from jaxbelt.bifurcations.labels import Label
from jaxbelt.bifurcations.regions import RegionMap, varied_by_names
from jaxbelt.numerics.continuation import Stop
from tests.campaign import engine
from tests.campaign.cases import PAPER
from tests.campaign.maps import in_one_unit

NUS = ("nu0", "nu1")
class_c, class_d = jb.presets.class_c, jb.presets.class_d


def letters_seen_by_engine(osc):
    """Those that the name of the region has for cycles, from a grid of starts."""
    cycles = {}
    for start in itertools.product(np.linspace(-2.0, 2.0, 9), np.linspace(-1.0, 1.0, 5)):
        seen = engine.attractor(osc, start, t_max=5000.0)
        if seen.kind == "cycle":
            code = sum(2**belt for belt in (0, 1) if seen.sticks[belt] > 0)
            cycles[round(seen.x1[1], 6), round(seen.period, 6)] = "sabc"[code]
    return "".join(sorted(cycles.values()))


@pytest.mark.slow(first=True)
def test_cells_have_the_attractors_that_an_engine_finds_from_a_grid_of_starts():
    """Three cycles at once, three fixed points, a cycle around a pseudo-focus among them."""
    points = np.array([(-0.05, 0.1), (-0.5, 0.6), (0.2, -0.25), (-0.22, 0.23), (0.3, -0.65)])
    make = functools.partial(class_d, sigma0=-0.3, sigma1=0.3)
    names = motions_in_cells(in_one_unit(make), NUS, points).names.tolist()
    assert names[:2] == ["3abc:(f)(f)(f)", "1:fff"]
    for (nu0, nu1), name in zip(points.tolist(), names, strict=True):
        belts = (
            engine.Belt(nu0, PAPER, 1.0, -np.inf, 0.3),
            engine.Belt(nu1, PAPER, 1.0, -0.3, np.inf),
        )
        letters = letters_seen_by_engine(engine.Oscillator(0.5, belts))
        assert name.partition(":")[0][1:] == letters


def test_names_tell_equilibria_where_there_are_edges():
    osc = class_d(-0.2, 0.3, -0.3, 0.3)
    fixed, focus = (jb.EquilibriumKind.FIXED_POINT, jb.EquilibriumKind.PSEUDO_FOCUS)
    rests = ((fixed, True, (1, 1)), (focus, False, (1, 1)))
    assert region_name(osc, Label(rests, ())) == "1:f(p)"
    assert region_name(osc, Label(rests[1:], (((0, -1), (1, -1)),))) == "3a:(p)"
    # None of it where there are none: belts that run in opposite directions have digits there.
    without = jb.presets.class_b(-0.2, 0.3)
    assert region_name(without, Label(rests[:1], ())) == "6"


def test_each_set_of_belts_has_a_name_of_its_own():
    """Of six belts, too: letters end where s, which stands for no belt, would come."""
    osc = jb.Oscillator(0.1, tuple(jb.Belt(0.1 * (i + 1), jb.Coulomb(1.0, 0.8)) for i in range(6)))
    sets = [tuple(b for b in range(6) if code >> b & 1) for code in range(64)]
    modes = [tuple(0 if b in stuck else 1 for b in range(6)) for stuck in sets]
    names = [region_name(osc, Label((), ((mode,),))) for mode in modes]
    assert len(set(names)) == 64 and all(name.isprintable() for name in names)
    assert [belts_of_letters(name[1:])[0] for name in names] == [list(stuck) for stuck in sets]


AXES = {"nu0": np.linspace(0.15, 0.35, 7), "sigma": np.linspace(0.6, 1.0, 6)}


@pytest.fixture(scope="module")
def corner_of_map():
    """A part of a plane of class (c) in which one line each way meets few of the curves."""
    return jb.region_map(functools.partial(class_c, nu1=0.3), AXES, lines=1, step=0.05)


@pytest.mark.slow
def test_curves_are_found_where_no_line_meets_them(corner_of_map):
    """Between all cells that differ."""
    told = corner_of_map
    assert told.uncovered == () and "none between" not in repr(told)
    make = functools.partial(class_c, nu1=0.3)
    bounds = Bounds(varied_by_names(make, told.names, told.values), told.values, 0.05)
    grid = np.meshgrid(*told.values, indexing="ij")
    cells = motions_in_cells(
        in_one_unit(make), told.names, np.column_stack([axis.ravel() for axis in grid])
    )
    motions = cells.motions.reshape(grid[0].shape)
    pairs = neighbours_that_differ(motions, told.on_line)
    missing = int(np.sum(bounds.away(pairs) > 0.5))
    assert bounds.search_between(motions, told.on_line) == ()
    assert missing > 0 and np.all(bounds.away(pairs) < 0.5)


@pytest.mark.slow
def test_pairs_that_no_curve_explains_are_told():
    """Cells that are said to differ, where nothing happens."""
    make = functools.partial(class_c, sigma=0.0)
    values = [np.linspace(0.4, 0.6, 3), np.linspace(0.4, 0.6, 3)]
    bounds = Bounds(varied_by_names(make, NUS, values), values, 0.05)
    motions = np.array([[0, 0, 0], [0, 1, 0], [0, 0, 0]])
    told = bounds.search_between(motions, np.zeros((3, 3), bool))
    assert len(told) == 4 and all((0.5, 0.5) in pair for pair in told)
    # Where nothing is known, or a belt is at rest, nothing is said to differ.
    assert bounds.search_between(np.where(motions, -1, 0), np.zeros((3, 3), bool)) == ()
    assert bounds.search_between(motions, motions == 1) == ()


PLANE = ((-0.7, 0.7), (-1.0, 1.0))


def over_sigma(nu0, sigma):
    return class_c(nu0, 0.3, sigma=sigma)


@pytest.mark.slow
def test_a_fold_ends_where_its_cycle_touches_an_edge():
    """On the left that is the fold cycle of class (a) with the edge at its largest x1; on the right
    the edge comes to where the cycle is tangent to the boundary, slip onset, x1 = 1 - zeta nu0."""
    (left,) = jb.scan(lambda nu0: over_sigma(nu0, 0.3), span=(-0.3, -0.2))
    curve = jb.bifurcation_curve(left, over_sigma, ((-0.3, -0.2), (-1.0, 1.0)), step=0.02)
    (end,) = curve.special
    assert end.kind == "EdgeTouch" and end.residual < 1e-12 and curve.is_named(0)
    fold = oracle_cycles.nonsmooth_fold(oracle.class_a, (0.26, 0.275), 0)
    # The orbit from slip onset, which the stick phase does not change: 1e-9 before the fold.
    edge = oracle_cycles.sticking_cycle(oracle.class_a(fold - 1e-9)).x1_min
    assert end.values == pytest.approx((-fold, -edge), abs=1e-8)

    (right,) = jb.scan(lambda nu0: over_sigma(nu0, 0.95), span=(0.2, 0.3))
    curve = jb.bifurcation_curve(right, over_sigma, ((0.2, 0.3), (0.8, 1.0)), step=0.02)
    (end,) = curve.special
    assert end.kind == "EdgeTouch"
    assert end.values[1] == pytest.approx(1 - 0.5 * end.values[0], abs=1e-12)


@pytest.mark.slow(first=True)
def test_pseudo_hopf_points_are_pseudo_foci():
    """Their curve once went on beyond a belt at rest, where there is a fixed point."""
    point = jb.refine(jb.PseudoHopf(0), lambda nu0: over_sigma(nu0, 0.73), at=0.12)
    curve = jb.bifurcation_curve(point, over_sigma, PLANE, step=0.02)
    for nu0, sigma in curve.values[:-1]:
        kinds = np.asarray(jb.equilibria(over_sigma(nu0, sigma)).kind).tolist()
        assert jb.EquilibriumKind.PSEUDO_FOCUS in kinds
    # At its end, BoundaryHopf, the fixed point of the one belt comes to the edge.
    nu0, sigma = curve.values[-1]
    assert jb.equilibria(over_sigma(nu0, sigma)).x1 == pytest.approx([sigma], abs=1e-12)
    assert [end.kind for end in curve.special] == [
        "BeltAtRest", "DegeneratePseudoHopf", "BoundaryHopf"
    ]  # fmt: skip
    # Where belt 0 is at rest the traces are those of mu' at 0 and 0.3, the pushes 1 - sigma and
    # sigma - 0.7: (1 - sigma) (0.25 - 0.5) + (sigma - 0.7) (4 - 0.5) = 0.
    sigma = (0.25 + 0.7 * 3.5) / (0.25 + 3.5)
    assert curve.special[0].values == pytest.approx((0.0, sigma), abs=1e-12)


@pytest.mark.slow(first=True)
def test_a_curve_that_creeps_to_a_belt_at_rest_ends_there():
    """It took a thousand rows, down to 1e-33."""
    make = functools.partial(class_c, sigma=-0.5)
    points = jb.scan(lambda nu0: make(nu0, -0.02), span=(-0.27, -0.26))
    point = next(one for one in points if one.kind in ("GrazingSliding", "NonsmoothFold"))
    curve = jb.bifurcation_curve(point, make, ((-0.28, -0.25), (-0.03, 0.1)), step=0.01)
    assert len(curve) < 300 and curve.ends.count(Stop.STOPPED) == 1
    (end,) = [one for one in curve.special if one.kind == "BeltAtRest"]
    assert end.belts == (1,) and end.residual < 1e-6
    assert end.values[1] == pytest.approx(0.0, abs=1e-12)


def test_a_curve_that_goes_on_as_another_one_is_cut_there():
    def curve_along(values, special=()):
        n = len(values)
        return jb.BifurcationCurve(
            jb.CornerCollision(0), values, (jb.CornerCollision,) * n, np.full(n, np.nan),
            np.zeros(n), np.tile([0.0, 1.0, -0.5, 0.5, 6.0], (n, 1)), special,
            (Stop.LEFT_SPAN, Stop.LEFT_SPAN), NUS,
        )  # fmt: skip

    x = np.linspace(0.0, 1.0, 51)
    straight = curve_along(np.column_stack([x, 0 * x]))
    bent = curve_along(np.column_stack([x, np.maximum(0.5 - x, 0)]))
    cut = _without_known(bent, np.array([0.1, 0.4]), [straight], 0.02, np.ones(2))
    assert cut.ends == (Stop.LEFT_SPAN, Stop.STOPPED)
    assert np.array_equal(cut.values, bent.values[: len(cut)])
    assert 0.46 <= cut.values[-1, 0] <= 0.5
    # Curves that only cross, or are of other cycles, stay whole.
    across = curve_along(np.column_stack([x, x - 0.5]))
    assert _without_known(across, np.array([0.9, 0.4]), [straight], 0.02, np.ones(2)) is across


@pytest.mark.slow(first=True)
def test_a_map_is_the_same_in_other_units():
    """Points of one kind on two curves are two, too, where the other axis is much longer."""
    nu0, steepness = np.linspace(0.21, 0.345, 4), np.linspace(38.0, 60.0, 3)

    def steep(nu0, steepness):
        law = jb.Conti(1.0, 0.6, steepness)
        return jb.Oscillator(0.5, (jb.Belt(nu0, law), jb.Belt(0.35, law)))

    def scaled(nu0, q):
        return steep(nu0, 128 * q)

    one = jb.region_map(steep, {"nu0": nu0, "steepness": steepness}, lines=1, step=0.05)
    other = jb.region_map(scaled, {"nu0": nu0, "q": steepness / 128}, lines=1, step=0.05)
    assert np.array_equal(one.label, other.label)

    def told(map_, unit):
        curves = [(curve, np.sort(curve.values[[0, -1]] / [1, unit], 0)) for curve in map_.curves]
        return sorted((repr(curve.condition), *np.round(ends, 6).flat) for curve, ends in curves)

    ours, theirs = told(one, 1), told(other, 1 / 128)
    assert len(ours) == 2 and [a[0] for a in ours] == [b[0] for b in theirs]
    for a, b in zip(ours, theirs, strict=True):
        assert a[1:] == pytest.approx(b[1:], abs=2e-2)


@pytest.mark.slow
def test_a_belt_may_be_two_in_the_whole_plane():
    law = jb.presets.paper_friction()

    def split(nu0, nu1):
        half = jb.Belt(nu1, law, load=0.5)
        return jb.Oscillator(0.5, (jb.Belt(nu0, law), half, half))

    axes = {"nu0": np.linspace(-0.2, 0.62, 12), "nu1": np.linspace(0.02, 0.61, 11)}
    one = jb.region_map(jb.presets.class_b, axes, lines=1, step=0.03)
    two = jb.region_map(split, axes, lines=1, step=0.03)
    # Belt 1 is belts 1 and 2: b is f, c is g.
    table = str.maketrans("bc", "fg")
    assert np.array_equal(np.char.translate(one.label, table), two.label)
    assert two.uncovered == () and np.array_equal(one.on_line, two.on_line)
    kinds = {kind for curve in one.curves for kind in curve.kinds}
    assert "NonsmoothFold" in kinds
    assert kinds == {kind for curve in two.curves for kind in curve.kinds}

    def densely_along(path):
        at = np.arange(len(path))
        return np.column_stack([np.interp(np.arange(0, at[-1], 0.02), at, x) for x in path.T])

    def densely(made):
        return np.concatenate([densely_along(curve.path) for curve in made.curves])

    for a, b in ((one, two), (two, one)):
        assert cKDTree(densely(a)).query(densely(b))[0].max() < 2e-3


@pytest.mark.slow
def test_a_plane_in_which_a_belt_rests_throughout_has_a_picture():
    law = jb.presets.paper_friction()

    def braked(velocity, damping):
        pad = jb.Belt(0.0, law, load=0.2)
        return jb.Oscillator(damping, (jb.Belt(velocity, law), pad))

    axes = {"velocity": np.linspace(0.1, 0.5, 4), "damping": np.linspace(0.1, 0.8, 3)}
    made = jb.region_map(braked, axes, lines=1, step=0.03)
    assert not made.on_line.any() and set(np.unique(made.raster())) == {"1"}
    assert made.plot().figure is not None
    plt.close("all")


def test_a_map_whose_cells_are_all_on_lines_or_undecided_has_a_picture():
    values = np.array([0.0, 1.0])
    for name, on_line in (("1", True), ("", False)):
        label, lines = np.full((2, 2), name), np.full((2, 2), on_line)
        made = RegionMap(
            *(("nu0", "nu1"), (values, values), label, (), {name: ()}, lines, ()),
            jb.presets.class_b,
        )
        assert set(np.unique(made.raster())) == {name}
        assert made.plot().figure is not None
    plt.close("all")


@pytest.mark.slow
def test_cells_with_a_belt_without_load_do_not_differ_from_their_neighbours():
    law = jb.presets.paper_friction()

    def make(load, damping):
        return jb.Oscillator(damping, (jb.Belt(0.3, law), jb.Belt(0.15, law, load=load)))

    axes = {"load": np.linspace(0.0, 0.6, 4), "damping": np.linspace(0.3, 1.0, 4)}
    made = jb.region_map(make, axes, lines=2, step=0.03)
    assert np.array_equal(made.on_line, np.arange(4)[:, None] == [[0] * 4]) and made.uncovered == ()
