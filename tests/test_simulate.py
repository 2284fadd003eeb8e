"""`simulate` against the independent oracle, its derivatives, and every degenerate case."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest

import jaxbelt as jb
from jaxbelt import EventKind, Status
from jaxbelt.paper import formulation_errors

# One budget for every run with two belts: they then share one compiled program.
simulate = functools.partial(jb.simulate, max_segments=4096)

SPAN = 60.0
SAMPLES = jnp.linspace(0.0, SPAN, 241)
#: Where nothing is compared at SAMPLES: runs of up to 51.2 have as many samples of their own.
SHORT = 50.0
#: Closer to a corner or a tangency than this, the sequence of events is a matter of rounding.
MARGIN = 1e-6


def kinds(trajectory):
    events = trajectory.events
    return [(EventKind(int(k)).name, int(b)) for k, b in zip(events.kind, events.belt, strict=True)]


def random_case(kind, rng):
    nu = rng.uniform(-0.8, 0.8, 2)
    sigma = np.sort(rng.uniform(-1.0, 2.0, 2))
    parameters = {"a": nu[:1], "b": nu, "c": [*nu, sigma[0]], "d": [*nu, *sigma]}[kind]
    return [float(p) for p in parameters], tuple(map(float, rng.uniform([-3, -1.5], [3, 1.5])))


# --- right ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["ab", "c", "d"])
def test_random_runs_agree_with_the_oracle(kind, seed, record_property):
    """25 runs a test: 100 of classes (a) and (b), 100 of (c), 100 of (d)."""
    kind = kind[seed % 2] if kind == "ab" else kind
    rng = np.random.default_rng([ord(kind), seed])
    set_aside, foci, worst = 0, 0, 0.0
    for _ in range(25):
        parameters, y0 = random_case(kind, rng)
        expected = oracle.simulate(getattr(oracle, f"class_{kind}")(*parameters), y0, SPAN)
        run = simulate(getattr(jb.presets, f"class_{kind}")(*parameters), y0, SPAN, ts=SAMPLES)
        if expected.status == "pseudo_focus" or run.status == Status.PSEUDO_FOCUS:
            foci += 1
            compare_pseudo_focus(expected, run)
            continue
        if expected.margin < MARGIN:
            set_aside += 1
            continue
        assert run.status in (Status.OK, Status.STUCK_FOREVER), (parameters, y0, run)
        assert kinds(run) == [(e.kind, e.belt) for e in expected.events], (parameters, y0)
        error = difference(run, expected)
        assert error < 1e-8, (parameters, y0, error)
        worst = max(worst, error)
    report = f"{set_aside} set aside, {foci} pseudo-foci, worst error {worst:.1e}"
    record_property("report", report)
    print(f"class {kind}, seed {seed}: {report}")
    assert set_aside <= 5


def difference(run, expected):
    """Largest difference of event times, event states and samples between a run and the oracle."""

    def table(run):
        if isinstance(run, oracle.Run):
            events = [(e.t, e.x1, e.x2) for e in run.events]
            return np.array(events).reshape(-1, 3), [run.at(t) for t in np.asarray(SAMPLES)]
        return np.column_stack([run.events.t, run.events.y]), run.ys

    (events, states), (expected_events, expected_states) = table(run), table(expected)
    return max(
        np.max(np.abs(events - expected_events), initial=0.0),
        np.max(np.abs(np.asarray(states) - np.asarray(expected_states))),
    )


@pytest.mark.slow
def test_random_systems_of_two_and_three_belts():
    """Laws mixed, intervals at random, half of the cases on a grid full of exact corners."""
    rng = np.random.default_rng(1)
    laws = (
        (jb.Conti(1.0, 0.6, 10.0), oracle.conti(1.0, 0.6, 10.0)),
        (jb.Coulomb(0.8, 0.6), oracle.coulomb(0.8, 0.6)),
        (jb.Stribeck(0.9, 0.5, 0.2), oracle.stribeck(0.9, 0.5, 0.2)),
    )
    compared = 0
    for _ in range(60):
        on_grid, n = rng.random() < 0.5, int(rng.integers(2, 4))

        def draw(low, high, on_grid=on_grid):
            value = rng.uniform(low, high)
            return float(np.round(5 * value) / 5 if on_grid else value)

        here, there = [], []
        for law, reference in laws[:n]:
            velocity, load = draw(-0.8, 0.8), draw(0.2, 1.4)
            lower = draw(-2.0, 0.5) if rng.random() < 0.5 else -np.inf
            upper = draw(0.6, 2.0) if rng.random() < 0.5 else np.inf
            here.append(jb.Belt(velocity, law, load, lower, upper))
            there.append(oracle.Belt(velocity, *reference, load, lower, upper))
        damping, omega = draw(0.0, 0.6), draw(0.6, 1.6)
        y0 = (draw(-2, 2), draw(-1, 1))
        run = simulate(jb.Oscillator(damping, here, omega), y0, SPAN, ts=SAMPLES)
        expected = oracle.simulate(oracle.Oscillator(damping, tuple(there), omega), y0, SPAN)
        if Status.PSEUDO_FOCUS == run.status or expected.status == "pseudo_focus":
            compare_pseudo_focus(expected, run)
        elif expected.margin > MARGIN:
            assert kinds(run) == [(e.kind, e.belt) for e in expected.events], (here, y0)
            assert difference(run, expected) < 1e-8 * max(1.0, 1e-3 / expected.margin), (here, y0)
            compared += 1
    print(compared, "of 60 compared to the end")
    assert compared > 45


def compare_pseudo_focus(expected, run):
    """The two stop at different radii: compare what both saw, and where it ends."""
    n = min(len(expected.events), len(run.events.t))
    assert kinds(run)[:n] == [(e.kind, e.belt) for e in expected.events[:n]]
    if run.status == Status.PSEUDO_FOCUS:
        edge = run.ys[-1, 0]
        assert run.ys[-1, 1] == 0
        assert expected.events[-1].x1 == edge
        assert abs(expected.events[-1].x2) < 0.011  # still inside the radius of capture


def test_error_falls_with_the_tolerance():
    osc, y0 = (-0.2, 0.35), (2.0, 0.0)
    expected = oracle.simulate(oracle.class_b(*osc), y0, SPAN)
    states = np.array([expected.at(t) for t in np.asarray(SAMPLES)])
    tolerances = np.array([1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10])
    errors = []
    for tolerance in tolerances:
        run = simulate(
            jb.presets.class_b(*osc), y0, SPAN, ts=SAMPLES, rtol=tolerance, atol=tolerance
        )
        errors.append(float(np.max(np.abs(run.ys - states))))
    order = np.polyfit(np.log(tolerances), np.log(errors), 1)[0]
    print("errors", errors, "order in the tolerance", order)
    # Error per step control of a fifth-order pair: between proportional and the power 4/5.
    assert 0.75 < order < 1.2
    assert errors[-1] < 1e-9


@pytest.mark.slow(first=True)
def test_rest_up_to_rounding_on_the_boundary_of_an_idle_belt_at_rest():
    """The motion shrinks to a focus at (0.6111, 0), and each half loop ends on that boundary."""
    law = jb.Conti(1.0, 0.5, 10.0)
    osc = jb.Oscillator(
        2.0, (jb.Belt(0.0, law, load=0.0, upper=0.8), jb.Belt(0.35, law, lower=0.45))
    )
    run = jb.simulate(osc, (0.8, 0.35), 50.0)
    assert run.status == Status.OK and run.events.t.size < 20
    assert run.ys[-1, 0] == pytest.approx(11 / 18, abs=1e-11) and abs(run.ys[-1, 1]) < 1e-11


# --- differentiable -------------------------------------------------------------------------------

PARAMETERS = jnp.array([-0.3, 0.35, 0.5, 0.6, 10.0, 2.5, 0.1])  # nu0 nu1 zeta p1 p3 x1 x2
LATE = 42.0
N_EVENTS = 12


def outcome(p):
    """Final state, event times, event states of a two-belt run with every parameter traced.

    And beside them what has no derivatives: the kinds of the events, and the last mode.
    """
    law = jb.Conti(static=1.0, residual=p[3], steepness=p[4])
    osc = jb.Oscillator(p[2], (jb.Belt(p[0], law), jb.Belt(p[1], law)))
    run = jb.simulate(osc, p[5:], LATE, ts=jnp.array([LATE]), max_segments=256)
    events = jax.tree.map(lambda column: column[:N_EVENTS], run.events)
    numbers = run.ys[0], events.t, events.y
    return numbers, (numbers, events.kind, run.modes[0])


@functools.cache
def forward_derivatives():
    """The derivatives, and what `outcome` gives beside them, by one program."""
    return jax.jit(jax.jacfwd(outcome, has_aux=True))(PARAMETERS)


def test_derivatives_agree_with_richardson_differences_of_the_oracle():
    def reference(p):
        law = oracle.conti(1.0, p[3], p[4])
        belts = (oracle.Belt(p[0], *law), oracle.Belt(p[1], *law))
        run = oracle.simulate(oracle.Oscillator(p[2], belts), (p[5], p[6]), LATE)
        assert len(run.events) >= N_EVENTS
        return np.concatenate([run.at(LATE), [e.t for e in run.events[:N_EVENTS]]])

    (final, times, _), _ = forward_derivatives()
    computed = np.concatenate([final, times])
    base = np.asarray(PARAMETERS)
    for i in range(len(base)):

        def along(value, i=i):
            p = base.copy()
            p[i] = value
            return reference(p)

        value, error = oracle.richardson(along, base[i], 3e-4 * max(1.0, abs(base[i])))
        scale = np.maximum(np.abs(value), 1e-2)
        assert np.max(np.abs(error) / scale) < 5e-8, "the differences are too coarse to tell"
        np.testing.assert_array_less(np.abs(computed[:, i] - value) / scale, 1e-7)


@pytest.mark.slow(first=True)
def test_reverse_mode_equals_forward_mode():
    reverse, _ = jax.jit(jax.jacrev(outcome, has_aux=True))(PARAMETERS)
    for a, b in zip(reverse, forward_derivatives()[0], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)


@pytest.mark.slow(first=True)
def test_second_derivatives_agree_with_differences_of_the_oracle():
    def final(z):
        run = jb.simulate(jb.presets.class_b(z[0], 0.35), z[1:], 9.0, ts=jnp.array([6.0, 9.0]))
        return run.ys.reshape(-1)

    def reference(z):
        run = oracle.simulate(oracle.class_b(z[0], 0.35), (z[1], z[2]), 9.0)
        return np.concatenate([run.at(6.0), run.at(9.0)])

    z = np.array([-0.3, 2.5, 0.1])
    assert len(oracle.simulate(oracle.class_b(z[0], 0.35), z[1:].tolist(), 9.0).events) >= 3
    computed = np.asarray(jax.jit(jax.hessian(final))(jnp.asarray(z)))
    np.testing.assert_allclose(computed, computed.swapaxes(1, 2), rtol=1e-9, atol=1e-11)

    def second(i, j, h):
        a, b = h * np.eye(3)[i], h * np.eye(3)[j]
        parts = reference(z + a + b) - reference(z + a - b)
        return (parts - reference(z - a + b) + reference(z - a - b)) / (4 * h * h)

    for i, j in ((0, 0), (0, 1), (1, 1), (2, 0)):
        value = (4 * second(i, j, 2e-3) - second(i, j, 4e-3)) / 3
        scale = 1e-2 + np.abs(value)
        np.testing.assert_array_less(np.abs(computed[:, i, j] - value) / scale, 1e-5)


COMPOSITIONS = {
    "vmap grad": lambda loss: jax.vmap(jax.grad(loss)),
    "jit vmap grad": lambda loss: jax.jit(jax.vmap(jax.grad(loss))),
    "grad vmap": lambda loss: jax.grad(lambda rows: jnp.sum(jax.vmap(loss)(rows))),
    "jit grad vmap": lambda loss: jax.jit(jax.grad(lambda rows: jnp.sum(jax.vmap(loss)(rows)))),
    "grad map": lambda loss: jax.grad(lambda rows: jnp.sum(jax.lax.map(loss, rows))),
    "map grad": lambda loss: functools.partial(jax.lax.map, jax.grad(loss)),
    "vmap grad checkpoint": lambda loss: jax.vmap(jax.grad(jax.checkpoint(loss))),
    "vmap jacfwd": lambda loss: jax.vmap(jax.jacfwd(loss)),
    "vmap jacrev jit": lambda loss: jax.vmap(jax.jacrev(jax.jit(loss))),
    "jit jvp vmap": lambda loss: jax.jit(
        lambda rows: jnp.stack(
            [
                jax.jvp(jax.vmap(loss), (rows,), (jnp.zeros_like(rows).at[:, i].set(1.0),))[1]
                for i in range(2)
            ],
            axis=1,
        )
    ),
}


#: What has most of the others in it.
BY_DAY = ("vmap grad checkpoint",)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow(first=name in BY_DAY)) for name in COMPOSITIONS],
)
def test_transformations_compose_in_any_order(name):
    def loss(row):
        run = jb.simulate(jb.presets.class_b(row[0], 0.35), (row[1], 0.1), 6.0, ts=SAMPLES[:3])
        times = jnp.where(run.events.kind > 0, run.events.t, 0.0)
        return jnp.sum(run.ys**2) + jnp.sum(times)

    rows = jnp.array([[-0.3, 2.5], [-0.2, 2.0], [0.4, -1.0]])
    alone = jnp.stack([jax.jit(jax.jacfwd(loss))(row) for row in rows])
    # In a batch the arcs are cut at other places; derivatives along an arc are right to 1e-8.
    np.testing.assert_allclose(COMPOSITIONS[name](loss)(rows), alone, rtol=1e-8, atol=1e-9)


def test_a_stick_phase_forgets_the_start():
    (final, times, states), ((end, *_), kind, mode) = forward_derivatives()
    first = int(np.argmax(kind == EventKind.SLIP))
    assert kind[first] == EventKind.SLIP
    by_start = slice(5, 7)
    onsets = np.flatnonzero(np.asarray(kind) == EventKind.SLIP)
    assert len(onsets) >= 3
    assert np.max(np.abs(states[onsets, :, by_start])) == 0
    intervals = np.diff(np.asarray(times[first:, by_start]), axis=0)
    np.testing.assert_allclose(intervals, 0, atol=1e-12)
    # The clock is not forgotten: the final state moves along the orbit, by minus the time shift.
    x1, x2 = end
    push = sum(
        float(s) * oracle.conti(1.0, 0.6, 10.0)[0](abs(nu - float(x2)))
        for s, nu in zip(mode, (-0.3, 0.35), strict=True)
    )
    field = np.array([x2, -x1 - 0.5 * x2 + push])
    shift = -np.asarray(times[first, by_start])
    np.testing.assert_allclose(final[:, by_start], np.outer(field, shift), rtol=1e-8, atol=1e-10)


# --- batched --------------------------------------------------------------------------------------


def one_of_class_d(nu, y0, edges):
    osc = jb.presets.class_d(nu[0], nu[1], edges[0], edges[1])
    return simulate(osc, y0, SPAN / 2, ts=SAMPLES / 2)


all_of_class_d = jax.jit(jax.vmap(one_of_class_d))


def mixed_lanes():
    """Velocities, starts and edges of 24 runs; a third of them without edges."""
    rng = np.random.default_rng(5)
    nu = jnp.asarray(rng.uniform(-0.7, 0.7, (24, 2)))
    y0 = jnp.asarray(rng.uniform([-3, -1.5], [3, 1.5], (24, 2)))
    edges = jnp.asarray(np.sort(rng.uniform(-1, 2, (24, 2)), axis=1))
    return nu, y0, edges.at[:8].set(jnp.array([-jnp.inf, jnp.inf]))


@pytest.mark.slow
def test_vmap_equals_a_loop():
    """A batch is integrated in another way; both keep the tolerance, 1e-10, and some runs magnify
    what they are off by a hundred times."""
    lanes = mixed_lanes()
    batch = all_of_class_d(*lanes)
    seen = set()
    for i in range(24):
        alone = one_of_class_d(*(column[i] for column in lanes))
        assert alone.status == batch.status[i]
        n = len(alone.events.t)
        np.testing.assert_array_equal(alone.events.kind, batch.events.kind[i, :n])
        assert not np.any(batch.events.kind[i, n:])
        np.testing.assert_allclose(alone.events.t, batch.events.t[i, :n], rtol=0, atol=2e-10)
        np.testing.assert_allclose(alone.ys, batch.ys[i], rtol=0, atol=2e-10)
        seen |= set(np.asarray(alone.events.kind).tolist())
    assert seen >= {1, 2, 3, 4}


@pytest.mark.slow(first=True)
def test_a_batch_of_batches_is_one_batch():
    """A grid of belt speeds and starts, by two vmaps, where either is the same for all of one."""

    def final(nu, x1):
        osc = jb.presets.class_b(nu, 0.35)
        return jb.simulate(osc, (x1, 0.0), 20.0, ts=jnp.array([20.0])).ys[-1, 0]

    both = jax.value_and_grad(final, argnums=(0, 1))
    nus, starts = jnp.linspace(-0.5, 0.6, 4), jnp.linspace(-2.5, 2.5, 5)
    grid = jax.jit(jax.vmap(jax.vmap(both, (None, 0)), (0, None)))(nus, starts)
    rows = jax.jit(jax.vmap(both))(jnp.repeat(nus, 5), jnp.tile(starts, 4))
    for one, other in zip(jax.tree.leaves(grid), jax.tree.leaves(rows), strict=True):
        assert one.shape == (4, 5) and len(np.unique(one)) > 10
        np.testing.assert_allclose(one.reshape(-1), other, rtol=1e-12, atol=1e-12)


@pytest.mark.slow(first=True)
def test_a_lane_that_is_not_finite_harms_no_other():
    nu, y0, edges = mixed_lanes()
    sound = all_of_class_d(nu, y0, edges)
    hurt = all_of_class_d(nu.at[3, 0].set(jnp.nan), y0.at[11, 1].set(jnp.nan), edges)
    lost = np.isin(np.arange(24), [3, 11])
    assert np.all(hurt.status[lost] == Status.NOT_FINITE) and np.all(np.isnan(hurt.ys[lost]))
    for name in ("ys", "status", "modes"):
        np.testing.assert_array_equal(getattr(hurt, name)[~lost], getattr(sound, name)[~lost])


@pytest.mark.slow(first=True)
def test_nor_does_one_of_the_switch_model():
    def run(nu):
        osc = jb.presets.class_b(nu, 0.35)
        return jb.simulate(osc, (3.0, 0.0), 10.0, ts=jnp.linspace(0, 10, 5), formulation="switch")

    out = jax.jit(jax.vmap(run))(jnp.array([0.3, jnp.nan]))
    assert np.all(np.isfinite(out.ys[0])) and np.all(np.isnan(out.ys[1]))
    assert out.status[0] == Status.OK and out.status[1] != Status.OK


# --- formulations ---------------------------------------------------------------------------------


@pytest.mark.slow(first=True)
@pytest.mark.parametrize(("formulation", "width"), [("switch", "v_star"), ("smooth", "eps")])
def test_formulations_converge_to_the_exact_one(formulation, width):
    widths = np.array([1e-3, 1e-4, 1e-5])
    errors, _ = formulation_errors(formulation, width, widths)
    orders = np.diff(np.log10(errors)) / np.diff(np.log10(widths))
    print(formulation, errors, orders)
    # First order; the tanh tail brings a logarithm, which the measured order approaches from below.
    lowest = {"switch": 0.97, "smooth": 0.85}[formulation]
    assert np.all((orders > lowest) & (orders < 1.05))


@pytest.mark.slow(first=True)
def test_the_smooth_formulation_has_derivatives():
    def end(nu):
        osc = jb.presets.class_b(nu, 0.35)
        ts = jnp.array([5.0])
        run = jb.simulate(osc, (2.0, 0.0), 5.0, ts=ts, formulation="smooth", eps=0.05)
        return run.ys[-1]

    forward, reverse = jax.jit(lambda nu: (jax.jacfwd(end)(nu), jax.jacrev(end)(nu)))(-0.2)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)
    difference, _ = oracle.richardson(lambda nu: np.asarray(end(nu)), -0.2, 1e-3)
    np.testing.assert_allclose(forward, difference, rtol=1e-6)


# --- degenerate cases -----------------------------------------------------------------------------


def coulomb_belts(*belts, damping=0.0, omega=1.0):
    """Frictions are constant, so slip arcs are circles around +-mu (undamped): all closed form."""
    return jb.Oscillator(damping, belts, omega=omega)


def agree(osc_here, osc_there, y0, span=SHORT, tolerance=1e-8):
    """Same events, times and states here and in the oracle; returns the run."""
    run = simulate(osc_here, y0, span)
    expected = oracle.simulate(osc_there, y0, span)
    assert kinds(run) == [(e.kind, e.belt) for e in expected.events]
    np.testing.assert_allclose(run.events.t, [e.t for e in expected.events], atol=tolerance)
    np.testing.assert_allclose(run.ys[-1], expected.at(span), atol=tolerance)
    return run


def test_equal_speeds_stick_and_slip_together():
    run = agree(jb.presets.class_b(0.3, 0.3), oracle.class_b(0.3, 0.3), (3.0, 0.0))
    stuck = np.asarray(run.modes) == 0
    assert np.any(stuck)
    np.testing.assert_array_equal(stuck[:, 0], stuck[:, 1])
    # Capacities add: slip onset where x1 + zeta nu = 2 mus.
    onset = run.events.y[run.events.kind == EventKind.SLIP]
    np.testing.assert_allclose(onset[:, 0], 2 - 0.5 * 0.3, atol=1e-14)


def test_a_belt_at_rest_holds_for_ever():
    run = agree(jb.presets.class_b(0.0, 0.35), oracle.class_b(0.0, 0.35), (2.5, 0.0))
    assert run.status == Status.STUCK_FOREVER
    assert run.ys[-1, 1] == 0
    start = simulate(jb.presets.class_b(0.0, 0.35), (0.5, 0.0), SHORT)
    assert start.status == Status.STUCK_FOREVER
    np.testing.assert_array_equal(start.ys, np.broadcast_to([0.5, 0.0], start.ys.shape))


def test_both_belts_at_rest():
    run = agree(jb.presets.class_b(0.0, 0.0), oracle.class_b(0.0, 0.0), (6.0, 0.0))
    assert run.status == Status.STUCK_FOREVER


@pytest.mark.parametrize("x1", [-2.5, -1.2, -0.3, 0.4, 0.83, 1.9])
@pytest.mark.parametrize("belt", [0, 1])
def test_starts_on_a_boundary(x1, belt):
    nu = (-0.25, 0.35)
    run = agree(jb.presets.class_b(*nu), oracle.class_b(*nu), (x1, nu[belt]), span=20.0)
    assert run.status == Status.OK


def test_start_on_a_boundary_with_a_rounded_velocity():
    law = jb.Conti(1.0, 0.6, 10.0)
    osc = jb.Oscillator(0.5, (jb.Belt(0.1, law), jb.Belt(0.7, law)), omega=3.0)
    run = simulate(osc, (0.2, 0.1 / 3.0), 20.0)
    assert run.modes[0, 0] == 0


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("x2", [-0.4, 0.0, 0.4])
@pytest.mark.parametrize("sigma", [-0.5, 0.3, 1.1])
def test_starts_on_a_contact_edge(sigma, x2):
    here = jb.presets.class_c(0.4, -0.3, sigma)
    there = oracle.class_c(0.4, -0.3, sigma)
    expected = oracle.simulate(there, (sigma, x2), 10.0)
    run = simulate(here, (sigma, x2), 10.0)
    if expected.status == "pseudo_focus" or run.status == Status.PSEUDO_FOCUS:
        compare_pseudo_focus(expected, run) if expected.events else None
        return
    n = min(len(expected.events), 20)
    assert kinds(run)[:n] == [(e.kind, e.belt) for e in expected.events[:n]]


LAW = {"static": 1.0, "kinetic": 0.6}
OTHER = {"static": 0.3, "kinetic": 0.2}


def two_belts(nu0, nu1, lower, upper, other=OTHER):
    """Belt 0 everywhere, belt 1 on (lower, upper); here and in the oracle."""
    here = coulomb_belts(
        jb.Belt(nu0, jb.Coulomb(**LAW)), jb.Belt(nu1, jb.Coulomb(**other), lower=lower, upper=upper)
    )
    there = oracle.Oscillator(
        0.0,
        (
            oracle.Belt(nu0, *oracle.coulomb(LAW["static"], LAW["kinetic"])),
            oracle.Belt(
                nu1, *oracle.coulomb(other["static"], other["kinetic"]), lower=lower, upper=upper
            ),
        ),
    )
    return here, there


@pytest.mark.slow(first=True)
def test_an_edge_met_while_sticking_still_stuck():
    run = agree(*two_belts(0.3, 2.0, 0.2, np.inf), (-0.5, 0.3), span=15.0)
    edge = int(np.argmax(np.asarray(run.events.kind) == EventKind.EDGE))
    assert run.events.belt[edge] == 1
    assert run.events.y[edge].tolist() == [0.2, 0.3]
    assert run.events.kind[edge + 1] == EventKind.SLIP  # still stuck in between
    # Onset where the spring equals belt 0's capacity and the new belt's pull: x1 = 1 + 0.2.
    np.testing.assert_allclose(run.events.y[edge + 1], [1.2, 0.3], atol=1e-14)


@pytest.mark.slow(first=True)
def test_an_edge_met_while_sticking_torn_off():
    run = agree(*two_belts(0.3, -2.0, 0.9, np.inf), (-0.5, 0.3), span=15.0)
    assert run.events.kind[0] == EventKind.EDGE  # one event, though it ends the stick phase
    np.testing.assert_allclose(run.events.t[0], (0.9 + 0.5) / 0.3, rtol=1e-14)
    after = int(np.searchsorted(run.ts, run.events.t[0] + 1e-3))
    assert run.modes[after].tolist() == [1, -1]


def test_an_edge_met_while_sticking_belt_left():
    here = coulomb_belts(
        jb.Belt(0.3, jb.Coulomb(**LAW), upper=0.2), jb.Belt(-0.5, jb.Coulomb(**OTHER))
    )
    there = oracle.Oscillator(
        0.0,
        (
            oracle.Belt(0.3, *oracle.coulomb(1.0, 0.6), upper=0.2),
            oracle.Belt(-0.5, *oracle.coulomb(0.3, 0.2)),
        ),
    )
    run = agree(here, there, (-0.5, 0.3), span=15.0)
    assert (run.events.kind[0], run.events.belt[0]) == (EventKind.EDGE, 0)
    after = int(np.searchsorted(run.ts, run.events.t[0] + 1e-3))
    assert run.modes[after].tolist() == [2, -1]


def test_equal_speed_belts_meet_and_part_while_sticking():
    here, there = two_belts(0.3, 0.3, -0.2, 0.4)
    run = agree(here, there, (-0.5, 0.3), span=15.0)
    assert kinds(run)[:2] == [("EDGE", 1), ("EDGE", 1)]
    between = int(np.searchsorted(run.ts, float(run.events.t[0]) + 1e-3))
    assert run.modes[between].tolist() == [0, 0]


def test_static_friction_above_kinetic_jumps_at_onset():
    here, there = two_belts(0.3, 2.0, 5.0, np.inf)
    run = agree(here, there, (-0.5, 0.3), span=40.0)
    np.testing.assert_allclose(run.events.y[0], [1.0, 0.3], atol=1e-14)
    # The slip arc is a circle around 0.6: back at x2 = nu at x1 = 0.2.
    np.testing.assert_allclose(run.events.y[1], [0.2, 0.3], atol=1e-9)


def test_an_excursion_within_one_step_is_found():
    """A crossing of depth 1e-7, there and back in 1e-3 of the time that a step may take."""
    # Undamped, no friction: x2 = 1 * cos; it tops the slow belt's velocity by 1e-7 for 9e-4.
    law = jb.Coulomb(static=1e-9, kinetic=1e-9)
    nu = 1.0 - 1e-7
    # With an edge where it does not come to, for the program of the tests above.
    osc = coulomb_belts(jb.Belt(nu, law), jb.Belt(50.0, law, upper=50.0))
    run = simulate(osc, (-1.0, 0.0), 12.0)
    assert [kind for kind, _ in kinds(run)] == ["CROSS"] * 4
    width = 2 * np.arccos(nu)
    np.testing.assert_allclose(np.diff(run.events.t)[::2], width, rtol=1e-2)


def test_an_edge_excursion_within_one_step_is_found():
    law = jb.Coulomb(static=1e-9, kinetic=1e-9)
    osc = coulomb_belts(jb.Belt(50.0, law), jb.Belt(60.0, law, lower=1.0 - 1e-7))
    run = simulate(osc, (-1.0, 0.0), 12.0)
    assert [kind for kind, _ in kinds(run)] == ["EDGE"] * 4


def test_grazing_a_boundary_from_both_sides():
    """Class (b) around the paper's grazing point: the steady cycle sticks on belt 0, or not."""

    def sticks(nu0):
        run = simulate(jb.presets.class_b(nu0, 0.35), (3.0, 0.0), SHORT)
        late = run.events.t > SHORT / 2
        stuck = (run.events.kind == EventKind.STICK) & late
        return set(np.asarray(run.events.belt)[np.asarray(stuck)].tolist())

    grazing = -0.455724862289
    assert sticks(grazing + 1e-7) == {0, 1}
    assert sticks(grazing - 1e-7) == {1}


@pytest.mark.slow(first=True)
def test_three_belts_and_mixed_laws():
    here = jb.Oscillator(
        0.2,
        (
            jb.Belt(0.3, jb.Conti(1.0, 0.6, 10.0, quadratic=0.05), load=0.8),
            jb.Belt(-0.2, jb.Stribeck(0.7, 0.4, 0.1), lower=-0.5),
            jb.Belt(0.9, jb.Coulomb(0.5, 0.3), upper=1.2),
        ),
        omega=1.3,
    )
    there = oracle.Oscillator(
        0.2,
        (
            oracle.Belt(0.3, *oracle.conti(1.0, 0.6, 10.0, 0.05), load=0.8),
            oracle.Belt(-0.2, *oracle.stribeck(0.7, 0.4, 0.1), lower=-0.5),
            oracle.Belt(0.9, *oracle.coulomb(0.5, 0.3), upper=1.2),
        ),
        omega=1.3,
    )
    run = agree(here, there, (2.0, 0.0), span=30.0)
    assert {kind for kind, _ in kinds(run)} == {"STICK", "SLIP", "CROSS", "EDGE"}


def test_a_pseudo_focus_is_recognised():
    run = simulate(jb.presets.class_c(0.6136281850438676, -0.6028933954969964, -0.6432623150623895),
                   (-1.72283053, 0.66071584), SHORT)  # fmt: skip
    assert run.status == Status.PSEUDO_FOCUS
    assert run.ys[-1].tolist() == [-0.6432623150623895, 0.0]
    at_once = simulate(jb.presets.class_c(0.6, -0.6, -0.6), (-0.6, 0.0), 10.0)
    assert at_once.status == Status.PSEUDO_FOCUS


@pytest.mark.parametrize("x2", [0.05, 0.0])
def test_a_pseudo_focus_with_a_belt_at_rest_is_reached_in_finite_time(x2):
    law = jb.Conti(1.0, 0.6, 10.0)
    osc = jb.Oscillator(
        0.5, (jb.Belt(0.0, law, upper=-1.2), jb.Belt(-0.3, law, load=2.0, lower=-1.2))
    )
    run = simulate(osc, (-1.2, x2), 9.0)
    assert run.status == Status.PSEUDO_FOCUS
    assert run.ys[-1].tolist() == [-1.2, 0.0]
    # The oracle's loops have shrunk to nothing by then.
    assert float(run.arcs.t[-1]) < 0.8724


@pytest.mark.slow(first=True)
def test_a_used_up_budget_gives_what_there_is():
    run = simulate(jb.presets.class_b(-0.2, 0.35), (3.0, 0.0), 1e5)
    assert run.status == Status.TOO_MANY_SEGMENTS
    assert "max_segments" in jb.describe(run.status)
    assert np.all(np.isfinite(run.ys[run.ts < run.arcs.t[-1]]))
    assert np.all(np.isnan(run.ys[-1]))
    known = run.ts[np.isfinite(run.ys[:, 0])][-1]
    assert f"t 0 to 100000, known up to {known:.6g}, " in repr(run)


@pytest.mark.slow(first=True)
def test_a_run_without_samples_shows_its_events():
    run = simulate(jb.presets.class_b(-0.2, 0.35), (3.0, 0.0), SHORT, ts=[])
    assert repr(run).startswith("Trajectory(0 samples, Events(") and "status OK" in repr(run)
    assert run.table().empty and run.events.t.size > 0


def test_samples_stay_increasing_and_show_every_arc():
    run = simulate(jb.presets.class_b(-0.2, 0.35), (3.0, 0.0), SHORT)
    assert np.all(np.diff(run.ts) > 0)
    assert np.all(np.isin(np.asarray(run.arcs.t), np.asarray(run.ts)))
    assert run.ts[0] == 0
    assert run.ts[-1] == SHORT


# --- bad input ------------------------------------------------------------------------------------

OSC = ("class_b", (0.3, 0.35))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: jb.presets.class_a(np.nan), "velocity of .*belt.* must be finite, got nan"),
        (lambda: jb.Belt([0.1, 0.2], jb.Coulomb(1, 1)), "velocity must be a scalar.*got shape"),
        (lambda: jb.Belt("fast", jb.Coulomb(1, 1)), "velocity must be a number, got"),
        (lambda: jb.presets.class_a(np.float32(0.3)), "velocity must be float64, got float32"),
        (lambda: jb.Conti(-1.0, 0.6, 10.0), "static of Conti must be >= 0, got -1"),
        (lambda: jb.Conti(1.0, 0.6, -10.0), "steepness of Conti must be >= 0, got -10"),
        (lambda: jb.Coulomb(0.5, 0.6), "kinetic of Coulomb must be <= static"),
        (lambda: jb.Stribeck(1.0, 0.6, 0.0), "velocity of Stribeck must be > 0, got 0"),
        (lambda: jb.Belt(0.1, jb.Coulomb(1, 1), load=-1), "load of .*belt.* must be >= 0, got -1"),
        (
            lambda: jb.Belt(0.1, jb.Coulomb(1, 1), lower=2, upper=1),
            "lower of .* must be < upper = 1",
        ),
        (lambda: jb.Belt(0.1, 0.5), "friction must be a law such as"),
        (lambda: jb.presets.class_d(0.1, 0.2, 1.0, 0.0), "sigma0 must be <= sigma1 = 0"),
        (lambda: jb.Oscillator(0.5, ()), "belts must be at least one Belt, got none"),
        (lambda: jb.Oscillator(np.inf, (jb.Belt(0.1, jb.Coulomb(1, 1)),)), "damping must be fini"),
        (
            lambda: jb.Oscillator(0.5, (jb.Belt(0.1, jb.Coulomb(1, 1)),), omega=0.0),
            "omega must be > 0, got 0",
        ),
    ],
)
def test_impossible_parameters_are_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"y0": (1.0, 2.0, 3.0)}, r"y0 must be of shape \(2\), got shape \(3,\)"),
        ({"y0": (1.0, np.inf)}, "y0 must be finite, got"),
        ({"t1": 0.0}, "t1 must be > t0 = 0.0, got 0.0"),
        ({"t1": np.nan}, "t1 must be finite, got nan"),
        ({"rtol": 0.0}, "rtol must be > 0, got 0"),
        ({"atol": -1e-3}, "atol must be > 0, got -0.001"),
        ({"ts": jnp.array([1.0, 11.0])}, "ts must be within"),
        ({"ts": jnp.array([2.0, 1.0])}, "ts must be increasing"),
        ({"formulation": "exact"}, "formulation must be .* got 'exact'"),
        ({"formulation": "switch", "v_star": 0.0}, "v_star must be > 0, got 0"),
        ({"v_star": 0.1}, 'v_star must be left out unless formulation="switch", got 0.1'),
        ({"formulation": "switch", "eps": 0.1}, 'eps must be left out unless formulation="smooth"'),
        ({"formulation": "smooth", "eps": -1.0}, "eps must be > 0, got -1"),
        ({"max_segments": 0}, "max_segments must be a positive integer, got 0"),
    ],
)
def test_impossible_arguments_are_named(arguments, message):
    settings = {"y0": (1.0, 0.0), "t1": 10.0, **arguments}
    with pytest.raises(ValueError, match=message):
        jb.simulate(jb.presets.class_b(0.3, 0.35), **settings)


def test_a_batched_oscillator_is_referred_to_vmap():
    batch = jax.vmap(jb.presets.class_a)(jnp.array([0.1, 0.2]))
    with pytest.raises(ValueError, match=r"damping must be a scalar \(use jax.vmap"):
        jb.simulate(batch, (1.0, 0.0), 10.0)


def test_float32_is_refused_with_the_remedy():
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(ValueError, match=r'jax.config.update\("jax_enable_x64", True\)'):
            jb.presets.class_a(0.3)
    finally:
        jax.config.update("jax_enable_x64", True)


@pytest.mark.slow(first=True)
def test_times_that_do_not_increase_under_a_trace():
    """Outside they are refused; inside there are no samples, and the status says so."""
    ts = np.random.default_rng(0).uniform(0.0, SPAN, SAMPLES.size)

    @jax.jit
    def run(ts):
        found = simulate(jb.presets.class_b(0.45, 0.35), (3.0, 0.0), SPAN, ts=ts)
        return found.ys, found.status

    states, status = run(ts)
    assert status == Status.NOT_FINITE and np.all(np.isnan(states))
    states, status = run(np.sort(ts))
    assert status == Status.OK
    known = simulate(jb.presets.class_b(0.45, 0.35), (3.0, 0.0), SPAN, ts=np.sort(ts)).ys
    np.testing.assert_allclose(states, known, rtol=0, atol=1e-9)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("edges", [False, True])
def test_derivatives_of_a_sample_are_those_of_it_alone(edges):
    """Those of many samples are made each from the one before; round numbers and others, in both
    modes of derivatives."""

    def states(numbers, ts):
        nu0, nu1, damping, load, sigma, *y0 = numbers
        ends = ({"upper": sigma}, {"lower": sigma}) if edges else ({}, {})
        law = jb.Conti(1.0, 0.6, 8.0)
        belts = jb.Belt(nu0, law, load, **ends[0]), jb.Belt(nu1, law, **ends[1])
        return jb.simulate(jb.Oscillator(damping, belts), tuple(y0), 30.0, ts=ts).ys

    forward = jax.jit(jax.jacfwd(states))
    one_by_one = jax.jit(jax.vmap(lambda n, t: jax.jacfwd(states)(n, t[None])[0], (None, 0)))
    backward = jax.jit(jax.grad(lambda n, ts, weights: jnp.sum(weights * states(n, ts))))
    of_last = jax.jit(jax.jacfwd(lambda numbers: states(numbers, [30.0])[0]))
    rng = np.random.default_rng(3)
    ts = np.sort(np.concatenate([np.linspace(0.0, 30.0, 257), rng.uniform(0.0, 30.0, 30)]))
    for numbers in [
        (0.75, -0.75, 0.5, 1.0, 0.3, 1.0, 0.0),
        (1.0, -0.5, 0.5, 1.0, -0.25, 3.0, 0.0),
        (0.5, 0.5, 0.5, 1.0, 0.25, -1.0, 0.5),
        (0.5, 0.25, 0.5, 0.0, -0.5, 0.5, 0.5),
        (0.0, 0.5, 0.5, 1.0, 0.25, 2.0, -1.0),
        (0.3, 0.3, 0.05, 1.0, 0.125, 0.0, 0.0),
        (0.45, 0.35, -0.05, 1.0, -0.2, 1.3, 0.2),
        (0.4512, -0.3391, 0.3, 0.87, 0.21, -1.234, 0.456),
    ]:
        numbers = jnp.array(numbers)
        found, alone = np.asarray(forward(numbers, ts)), np.asarray(one_by_one(numbers, ts))
        scale = 1 + np.maximum.accumulate(np.nanmax(np.abs(alone), axis=(1, 2), keepdims=True))
        np.testing.assert_array_less(np.abs(found - alone), 1e-8 * scale * np.ones_like(found))
        assert np.all(np.abs(of_last(numbers) - alone[-1]) < 1e-9 * scale[-1])
        weights = rng.normal(size=found.shape[:2])
        told = np.einsum("ij,ijk->k", weights, found)
        size = np.einsum("ij,ijk->k", np.abs(weights), np.abs(found))
        assert np.all(np.abs(backward(numbers, ts, weights) - told) <= 1e-11 * (1 + size))


@pytest.mark.slow(first=True)
def test_samples_that_are_not_used_are_not_made():
    """The last of the default samples is the final state alone, for values and for derivatives in
    forward mode: the compiled program does not contain the others."""

    def final(nu0, ts):
        return jb.simulate(jb.presets.class_b(nu0, 0.35), (3.0, 0.0), 20.0, ts=ts).ys[-1]

    for ways in (lambda f: f, lambda f: lambda x: jax.jvp(f, (x,), (1.0,))):
        programs = [
            jax.jit(ways(lambda x, ts=ts: final(x, ts))).lower(0.45).compile()
            for ts in (None, [20.0])
        ]
        default, alone = (program.as_text().count(" fusion(") for program in programs)
        assert default <= 1.02 * alone
        for one, other in zip(*(jax.tree.leaves(program(0.45)) for program in programs)):
            np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.slow(first=True)
def test_no_samples_in_a_batch():
    """An empty `ts` is possible under every transformation."""

    def run(nu0):
        return jb.simulate(jb.presets.class_b(nu0, 0.35), (3.0, 0.0), 20.0, ts=[])

    runs = jax.vmap(run)(jnp.array([0.3, 0.45]))
    assert runs.ys.shape == (2, 0, 2)
    slopes = jax.vmap(jax.jacfwd(lambda nu0: run(nu0).events.t))(jnp.array([0.3, 0.45]))
    assert np.all(np.any(np.nan_to_num(slopes) != 0, axis=1))


#: Friction falls within 3e-5 to 1e-4 of the own unit: start, damping, (velocity, load) of belts; by
#: the engine of the campaigns the number of events until 50 and the state there.
THIN = [
    ((2.487, 0.475), 0.098, [(0.2328, 0.446)], 5, (0.2534408535373042, 0.04556610074149681)),
    ((-1.35, 0.0), 0.05, [(0.35, 1.0)], 15, (0.25506473732934754, 0.32444510417110334)),
    ((3.0, 0.0), 0.2, [(-0.55, 1.5), (0.95, 2.0)], 3, (0.2915785057334776, -0.0017051355186067396)),
]


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("y0, damping, belts, count, end", THIN)
def test_a_thin_layer_is_neither_jumped_nor_left_late(y0, damping, belts, count, end):
    """On the way in the step that ends at the boundary has to see the layer; at slip onset an error
    grows with exp(t / 1e-4) until the mass has left it."""
    own = jb.Oscillator(
        damping,
        tuple(jb.Belt(v, jb.Stribeck(1.0, 0.6, 1e-4 * abs(v)), load) for v, load in belts),
    )
    for tol, room in ((1e-8, 1e-6), (1e-11, 1e-9)):
        run = jb.simulate(own, y0, 50.0, rtol=tol, atol=tol)
        assert run.status == Status.OK
        assert np.sum(np.isfinite(run.events.t)) == count
        np.testing.assert_allclose(run.ys[-1], end, rtol=0, atol=room)
    runs = jb.sweep(
        lambda z: eqx.tree_at(lambda o: o.damping, own, z), {"z": [damping]}, y0=y0, t1=50.0
    )
    np.testing.assert_allclose((runs.x1_end[0], runs.x2_end[0]), end, rtol=0, atol=1e-6)
    assert runs.n_events[0] == count
