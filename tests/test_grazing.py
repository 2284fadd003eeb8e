"""Orbits that miss a boundary or an edge, or meet it, by next to nothing: see `grazing`."""

import functools
import itertools
from dataclasses import fields

import grazing
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt import Status
from jaxbelt.kernel.lanes import Program
from jaxbelt.model.own_units import in_units_of_run
from jaxbelt.sweeps.observers import Final
from jaxbelt.sweeps.queue import layout
from jaxbelt.sweeps.threads import run

AXES = {f.name: 0 if f.name in ("damping", "omega") else 1 for f in fields(grazing.Oscillators)}
#: Distances of the cases, on both sides.
POWERS = (3, 6, 8, 9, 10, 11)
#: Down to these distances are answers right at a tolerance: as far as the error of an integration,
#: which is up to ten times the tolerance of a step of the sweep, allows.
TOLERANCES = {"simulate": {1e-10: 1e-9, 1e-13: 1e-11}, "sweep": {1e-8: 1e-7, 1e-13: 1e-11}}
#: Errors of states over those that an error of the tolerance in the distance makes.
STATES = 30.0
#: Relative errors of derivatives where no event is near.
SLOPES = {1e-8: 1e-5, 1e-10: 1e-6, 1e-13: 1e-7}
#: How many cases there are of a kind at each distance.
FEW, MANY = 12, 280


@functools.cache
def cases(kind, n):
    """n cases of a kind for every distance."""
    distances = [sign * 10.0**-power for power in POWERS for sign in (1, -1)]
    if kind == "edge":
        found = grazing.edge_cases(0, 4 * n, distances)
    else:
        found = grazing.boundary_cases(0, 2 * n, distances, jump=kind == "jump")
    assert found[0].belt.size >= n
    return [case.take(slice(n)) for case in found]


def oscillator(parts, jump):
    """The oscillator of one case."""
    q = grazing.Oscillators(**parts)

    def belt(i):
        law = jb.Conti(q.static[i], q.residual[i], q.steepness[i])
        law = jb.Coulomb(q.static[i], q.residual[i]) if jump else law
        return jb.Belt(q.velocity[i], law, q.load[i], q.lower[i], q.upper[i])

    return jb.Oscillator(q.damping, (belt(0), belt(1)), q.omega)


def parts_of(case):
    return {name: jnp.asarray(part) for name, part in vars(case.osc).items()}


def directions(case):
    """What derivatives are asked for, as arguments of `grazing.derivative`."""
    own = (case.belt, np.arange(case.belt.size))
    last = ("edge", ()) if np.all(np.isfinite(case.edge)) else ("load", own)
    return [("start", 0), ("start", 1), ("velocity", own), ("damping", ()), last]


def tangent(case, name, index):
    """The same as tangents of the parts of the oscillators and of the starts."""
    parts = {key: np.zeros_like(part) for key, part in vars(case.osc).items()}
    start = np.zeros_like(case.start)
    if name == "edge":
        for key in ("lower", "upper"):
            parts[key] = np.where(getattr(case.osc, key) == case.edge, 1.0, 0.0)
    else:
        (start if name == "start" else parts[name])[index] = 1.0
    return {key: jnp.asarray(part) for key, part in parts.items()}, jnp.asarray(start)


# --- the engines: events, modes and states at the end ---------------------------------------------


@functools.partial(jax.jit, static_argnums=3)
def _simulated(parts, start, t1, jump, tolerance):
    def one(parts, y0):
        osc = oscillator(parts, jump)
        run = jb.simulate(osc, y0, t1, ts=t1[None], rtol=tolerance, atol=tolerance, max_segments=32)
        return run.ys[0], run.modes[0], run.events.kind, run.status

    return jax.vmap(one, (AXES, 1))(parts, start)


def simulate(case, kind, tolerance):
    parts, start = parts_of(case), jnp.asarray(case.start)
    run = _simulated(parts, start, jnp.asarray(case.t1), kind == "jump", tolerance)
    ys, modes, kinds, status = map(np.asarray, run)
    return ys.T, modes.T, np.sum(kinds > 0, axis=1), status, kinds


@functools.partial(jax.jit, static_argnums=5)
def _simulated_slopes(parts, start, d_parts, d_start, t1, jump, tolerance):
    def one(parts, y0, d_parts, d_y0):
        def end(parts, y0):
            osc, options = oscillator(parts, jump), {"rtol": tolerance, "atol": tolerance}
            return jb.simulate(osc, y0, t1, ts=t1[None], max_segments=32, **options).ys[0]

        return jax.jvp(end, (parts, y0), (d_parts, d_y0))[1]

    return jax.vmap(one, (AXES, 1, AXES, 1))(parts, start, d_parts, d_start).T


def simulated_slopes(case, kind, tolerance):
    given = parts_of(case), jnp.asarray(case.start)
    t1, jump = jnp.asarray(case.t1), kind == "jump"
    return [
        np.asarray(_simulated_slopes(*given, *tangent(case, *at), t1, jump, tolerance))
        for at in directions(case)
    ]


def _leaves(kind):
    def leaves(parts):
        return jax.tree.leaves(in_units_of_run(oscillator(parts, kind == "jump"), edges=True))

    return jax.vmap(leaves, (AXES,))


def sweep_all(case, kind, tolerance, along=()):
    """Results by name, [1 + directions, columns, cases], from starts and oscillators of a table."""
    leaves = _leaves(kind)
    parts = parts_of(case)
    rows = [np.stack([*case.start, *map(np.asarray, leaves(parts))])]
    for at in along:
        d_parts, d_start = tangent(case, *at)
        slopes = jax.jvp(leaves, (parts,), (d_parts,))[1]
        rows.append(np.stack([*map(np.asarray, d_start), *map(np.asarray, slopes)]))
    table, n = np.stack(rows), case.belt.size
    first = {k: part[..., 0] for k, part in parts.items()}
    one = in_units_of_run(oscillator(first, kind == "jump"), edges=True)
    mapped = (True,) * (table.shape[1] - 2)
    program = Program(jax.tree.structure(one), mapped, Final(), True)
    shapes = layout(program, [])
    out = np.zeros((len(table), sum(int(np.prod(shape)) for shape in shapes.values()), n))

    def put(numbers, results):
        out[:, :, numbers] = results

    settings = {"t1": case.t1, "rtol": tolerance, "atol": tolerance}
    run(program, [], lambda i, j: table[:, :, i:j], n, put, derivatives=len(along), **settings)
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes.values()])
    return dict(zip(shapes, np.split(out, ends[:-1], axis=1), strict=True))


def sweep(case, kind, tolerance):
    got = {name: part[0] for name, part in sweep_all(case, kind, tolerance).items()}
    ys = np.concatenate([got["x1_end"], got["x2_end"]])
    return ys, got["mode_end"], got["n_events"][0], got["status"][0], None


def swept_slopes(case, kind, tolerance):
    along = directions(case)
    got = sweep_all(case, kind, tolerance, along)
    ys = np.concatenate([got["x1_end"], got["x2_end"]], axis=1)
    return list(ys[1:])


# --- the tests ------------------------------------------------------------------------------------


def expected_events(case):
    return np.array([(*grazing.EVENTS[outcome], 0, 0)[:2] for outcome in case.outcome])


def check_answers(engine, case, kind, tolerance):
    ys, modes, counts, status, kinds = engine(case, kind, tolerance)
    events = expected_events(case)
    assert np.all(status == Status.OK)
    assert np.array_equal(counts, np.sum(events > 0, axis=1))
    if kinds is not None:
        assert np.array_equal(kinds[:, :2], events)
    assert np.array_equal(modes, case.after)
    # Where the boundary is met depends on the distance like its root.
    scale = tolerance / np.sqrt(case.distance) if case.distance > 0 else tolerance
    assert np.max(np.abs(ys - case.end)) < STATES * scale


def check_slopes(slopes, case, kind, tolerance):
    limit = SLOPES[tolerance] + (tolerance / case.distance if case.distance > 0 else 0.0)
    for at, slope in zip(directions(case), slopes(case, kind, tolerance), strict=True):
        true = grazing.derivative(case, *at)
        assert np.max(np.abs(slope - true) / (1 + np.max(np.abs(true), axis=0))) < limit, at


def some(engine, kind, n):
    """Cases, and tolerances at which an engine tells them right."""
    for tolerance, nearest in TOLERANCES[engine].items():
        for case in cases(kind, n):
            if abs(case.distance) > 0.9 * nearest:
                yield case, kind, tolerance


SLOW, FIRST = pytest.mark.slow, pytest.mark.slow(first=True)
KINDS = ("boundary", "edge", pytest.param("jump", marks=SLOW))


def in_turn(*first):
    """Every kind, few and many of each; the first ones belong to CI."""
    pairs = itertools.product((FEW, MANY), ("boundary", "edge", "jump"))
    rows = [pytest.param(*pair, marks=FIRST if pair in first else SLOW) for pair in pairs]
    return pytest.mark.parametrize(("n", "kind"), rows)


@in_turn((FEW, "boundary"), (FEW, "edge"))
def test_simulate_tells_a_miss_from_a_hit(kind, n):
    for case in some("simulate", kind, n):
        check_answers(simulate, *case)


@in_turn((FEW, "boundary"), (FEW, "edge"))
def test_sweep_tells_a_miss_from_a_hit(kind, n):
    for case in some("sweep", kind, n):
        check_answers(sweep, *case)


@SLOW
@pytest.mark.parametrize("kind", KINDS)
def test_slopes_of_simulate_are_those_of_their_side(kind):
    for case in some("simulate", kind, FEW):
        check_slopes(simulated_slopes, *case)


@SLOW
@pytest.mark.parametrize("kind", KINDS)
def test_slopes_of_a_sweep_are_those_of_their_side(kind):
    for case in some("sweep", kind, FEW):
        check_slopes(swept_slopes, *case)


@pytest.mark.slow(first=True)
def test_no_edge_where_an_orbit_turns_before_it():
    """It loops 2e-9 before the edge: a search on the smallest of all guards met the edge."""
    edge = -0.6037118870579379
    left = jb.Belt(
        -0.15732429933837827,
        jb.Conti(0.9353205004355242, 0.4458549183546525, 11.582180544525603),
        0.9814324281374591,
        upper=edge,
    )
    right = jb.Belt(
        0.49978599986749117,
        jb.Conti(1.0882687285343118, 0.6114050763002862, 10.2250053676874),
        1.0071418264221546,
        lower=edge,
    )
    osc = jb.Oscillator(0.7748469184621489, (left, right))
    for tolerance in (1e-10, 1e-13):
        start = 1.1668454824692276, -2.3851896526744154
        run = jb.simulate(osc, start, 2.3, rtol=tolerance, atol=tolerance)
        assert [(int(k), int(b)) for k, b in zip(run.events.kind, run.events.belt)] == [(1, 1)]
        assert np.allclose(run.events.t, 1.93247512, atol=1e-7)
        assert np.allclose(run.ys[-1], (-0.30883201, 0.499786), atol=1e-7)
