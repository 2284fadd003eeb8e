"""Symmetric motions of forced oscillators, and where their symmetry breaks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt.bifurcations.symmetry import is_symmetric, looks_the_same
from tests.campaign import forced, forced_cases

VELOCITY, LOAD, DAMPING = 0.5, 0.2, 0.05


def osc(frequency, amplitude=1.0, damping=DAMPING, unit=1.0, phase=0.0):
    law = jb.Stribeck(1.0, 0.5, 0.3 * unit)
    belts = [jb.Belt(way * VELOCITY * unit, law, LOAD * unit) for way in (1.0, -1.0)]
    return jb.Oscillator(damping, belts, forcing=jb.Harmonic(amplitude * unit, frequency, phase))


def multiplier_of_engine(frequency, start):
    belts = [forced.Belt(way * VELOCITY, ("stribeck", 1.0, 0.5, 0.3), LOAD) for way in (1.0, -1.0)]
    engine = forced.Oscillator(DAMPING, tuple(belts), (forced.Harmonic(1.0, frequency),))
    found, multipliers = forced_cases.periodic(engine, start, 1)
    half = forced.simulate(engine, tuple(found), np.pi / frequency).y_end
    return float(np.max(np.real(multipliers))), np.max(np.abs(found + np.array(half)))


@pytest.fixture(scope="module")
def point():
    return jb.refine(jb.SymmetryBreaking(), osc, at=0.476, start=(0.5, 0.2))


@pytest.mark.slow(first=True)
def test_a_multiplier_of_the_engine_is_one_where_symmetry_breaks(point):
    """On the symmetric motion, to both sides: its multiplier is a smooth function there."""
    value, away = float(point.value), 2e-3 * np.array([-2.0, -1.0, 1.0, 2.0])
    found = [multiplier_of_engine(value + d, np.asarray(point.cycle.start)) for d in away]
    multipliers, asymmetries = np.transpose(found)
    assert np.max(asymmetries) < 1e-9
    cubic = np.polynomial.Polynomial.fit(away, multipliers - 1, 3)
    assert abs(cubic(0.0) / cubic.deriv()(0.0)) < 1e-6
    # Asymmetric motions are there on one side only, and their distance grows like a root.
    apart = []
    for d in (1e-4, 4e-4):
        motion = jb.find_cycle(osc(value + d), (0.5, 0.2))
        assert motion.stable and not is_symmetric(motion.oscillator, motion)
        symmetric = jb.periodic(osc(value + d), point.cycle.start)
        apart.append(np.max(np.abs(np.asarray(motion.start - symmetric.start))))
    assert apart[1] == pytest.approx(2 * apart[0], rel=0.02)


@pytest.mark.slow
def test_refined_from_all_sides_and_by_gradients(point):
    value = float(point.value)
    for at in (0.47, 0.478):
        again = jb.refine(
            jb.SymmetryBreaking(), osc, at=at, start=jb.find_cycle(osc(at), (0.5, 0.2))
        )
        assert float(again.value) == pytest.approx(value, abs=1e-12)
    moved = jb.refine(
        jb.SymmetryBreaking(), lambda f: osc(f, unit=7.3, phase=1.0), at=0.476, start=(3.0, 1.0)
    )
    assert float(moved.value) == pytest.approx(value, abs=1e-11)

    def value_at(damping):
        near = jb.periodic(osc(0.476), point.cycle.start)
        found = jb.refine(
            jb.SymmetryBreaking(), lambda f: osc(f, damping=damping), at=0.476, start=near
        )
        return found.value

    slope = jax.jacfwd(value_at)(jnp.asarray(DAMPING))
    h = 1e-4
    ends = [value_at(DAMPING + k * h) for k in (-2, -1, 1, 2)]
    known = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
    assert float(slope) == pytest.approx(float(known), abs=1e-8)


@pytest.mark.slow
def test_a_fold_of_symmetric_motions_is_no_breaking_of_symmetry():
    fold = jb.refine(jb.Fold(), osc, at=0.448, start=(0.5, 0.2))
    assert fold.status == jb.Status.OK and is_symmetric(fold.oscillator, fold.cycle)
    near = jb.refine(jb.SymmetryBreaking(), osc, at=float(fold.value), start=fold.cycle)
    assert near.status != jb.Status.OK and np.isnan(near.value)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("at", [0.46, 0.485])
def test_branches_of_symmetric_and_asymmetric_motions_meet(point, at):
    """From a symmetric motion, and from an asymmetric one."""
    diagram = jb.bifurcation_diagram(
        osc, span=(0.46, 0.49), start=jb.find_cycle(osc(at), (0.5, 0.2))
    )
    (found,) = diagram.points
    assert found.kind == "SymmetryBreaking" and diagram.open_ends == ()
    assert float(found.value) == pytest.approx(float(point.value), abs=1e-11)
    branches = sorted(diagram.branches, key=len)
    assert len(branches) == 3 and all(abs(one.values[-1] - 0.49) < 1e-12 for one in branches)
    assert branches[-1].values[0] == 0.46
    one, image = branches[:2]
    assert min(one.values[0], image.values[0]) == pytest.approx(float(point.value), abs=1e-4)
    assert one.x1_max[-1] == pytest.approx(-image.x1_min[-1], abs=1e-9)
    assert abs(one.x1_max[-1] - image.x1_max[-1]) > 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("unit", "omega"), [(1e-5, 300.0), (1e5, 1 / 300)])
def test_both_images_are_followed_in_other_units(point, unit, omega):
    """Where they meet Newton's method goes from one to the other, by rounding."""
    speed = unit * omega
    law = jb.Stribeck(1.0, 0.5, 0.3 * speed)

    def make(frequency):
        belts = [jb.Belt(way * VELOCITY * speed, law, LOAD * unit) for way in (1.0, -1.0)]
        return jb.Oscillator(DAMPING, belts, omega, forcing=jb.Harmonic(unit, frequency))

    start = jb.find_cycle(make(0.47), (0.5 * unit, 0.2 * unit))
    diagram = jb.bifurcation_diagram(make, span=(0.465, 0.485), start=start)
    (found,) = diagram.points
    assert float(found.value) == pytest.approx(float(point.value), abs=1e-11)
    assert len(diagram.branches) == 3 and diagram.open_ends == ()


@pytest.mark.slow
@pytest.mark.parametrize("at", [0.46, 0.475])
def test_two_events_that_vanish_at_once_are_a_point(at):
    """Of a symmetric motion both crossings do; whatever the steps to the point are."""
    diagram = jb.bifurcation_diagram(
        osc, span=(0.445, 0.476), start=jb.find_cycle(osc(at), (0.5, 0.2))
    )
    assert [p.kind for p in diagram.points] == ["Fold", "SwitchingSliding", "Fold"]
    assert float(diagram.points[1].value) == pytest.approx(0.4484671346378, abs=1e-11)


def between_edges(frequency):
    """A mass that touches two belts at +-0.8, and is free between."""
    law = jb.Coulomb(1.0, 0.8)
    belts = jb.Belt(0.35, law, 0.5, upper=-0.8), jb.Belt(-0.35, law, 0.5, lower=0.8)
    return jb.Oscillator(DAMPING, belts, forcing=jb.Harmonic(0.5, frequency))


@pytest.mark.slow
@pytest.mark.parametrize("at", [0.5, 0.62])
def test_a_symmetric_motion_touches_edges_on_both_sides(at):
    """It goes on beyond both; beyond one of them there is an asymmetric motion, and its image."""
    start = jb.find_cycle(between_edges(at), (-0.8, 0.35))
    diagram = jb.bifurcation_diagram(between_edges, span=(0.5, 0.62), start=start)
    # The free motion has the amplitude 0.8.
    squares = np.roots([1.0, DAMPING**2 - 2, 1 - (0.5 / 0.8) ** 2])
    (grazing,) = (p for p in diagram.points if p.kind == "GrazingEdge")
    assert float(grazing.value) == pytest.approx(np.sqrt(np.min(squares)), abs=1e-11)
    folds = [float(p.value) for p in diagram.points if p.kind == "Fold"]
    assert len(folds) == len(diagram.points) - 1 == 2
    assert folds[0] == pytest.approx(folds[1], abs=1e-10)
    widths = [(one.x1_min, one.x1_max) for one in diagram.branches]
    symmetric = [np.max(np.abs(low + high)) < 1e-7 for low, high in widths]
    assert sorted(symmetric) == [False, False, True]
    ends = {round(float(one.values[k]), 9) for one in diagram.branches for k in (0, -1)}
    assert {0.5, 0.62} <= ends and diagram.open_ends == ()


@pytest.mark.slow
def test_a_curve_in_two_parameters_is_the_same_in_either_order(point):
    spans = (0.47, 0.485), (0.9, 1.1)
    one = jb.bifurcation_curve(point, lambda f, a: osc(f, a), spans, step=0.02)
    other = jb.bifurcation_curve(point, lambda a, f: osc(f, a), spans[::-1], step=0.02)
    ends = [np.array(sorted(curve.tolist())) for curve in (one.values, other.values[:, ::-1])]
    assert ends[0][[0, -1]] == pytest.approx(ends[1][[0, -1]], abs=1e-10)
    frequency, amplitude = one.values[2]
    again = jb.refine(
        jb.SymmetryBreaking(), lambda f: osc(f, amplitude), at=frequency + 1e-4, start=point.cycle
    )
    assert float(again.value) == pytest.approx(frequency, abs=1e-10)


def test_oscillators_that_look_the_same_from_both_sides():
    law = jb.Stribeck(1.0, 0.5, 0.3)

    def looks(belts, *forces):
        return looks_the_same(jb.Oscillator(0.1, belts, forcing=forces), 1)

    at_rest, right, left = (jb.Belt(v, law, 0.5) for v in (0.0, 0.4, -0.4))
    force = jb.Harmonic(1.0, 0.7, 0.3)
    assert looks((at_rest,), force) and looks((right, at_rest, left), force)
    assert looks((at_rest,), force, jb.Harmonic(0.2, 2.1))
    assert not looks((at_rest,), force, jb.Harmonic(0.2, 1.4))
    assert not looks((at_rest,), force, jb.Harmonic(0.2, 0.0))
    assert not looks((right,), force) and not looks((right, right), force)
    assert not looks((right, jb.Belt(-0.4, law, 0.6)), force)
    edges = jb.Belt(0.4, law, 0.5, upper=0.3), jb.Belt(-0.4, law, 0.5, lower=-0.3)
    assert looks(edges, force) and not looks((edges[0], left), force)
    waves = [jb.Belt(jb.Oscillating(0.0, 0.3, 0.7, phase), law) for phase in (0.2, 0.9)]
    assert looks(waves, force)
    load = jb.Oscillating(1.0, 0.5, 0.7)
    assert not looks((jb.Belt(0.0, law, load),), force)
    assert looks((jb.Belt(0.0, law, jb.Oscillating(1.0, 0.5, 1.4)),), force)
