"""The sweep kernel against `simulate`: final states, events, statuses; and its attractors."""

import jax
import jax.numpy as jnp
import lists
import numpy as np
import oracle
import oracle_cycles
import pytest
from laws import Bump
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxbelt as jb
from jaxbelt import Status
from jaxbelt.kernel.events import append, word_events
from jaxbelt.sweeps.attractor import signature
from jaxbelt.sweeps.datasets import numbered, renumber

SPAN = 40.0
#: Room for the arcs of a run of `simulate`, as in tests/test_simulate.py, for one program.
ARCS = 4096
#: Both integrate with this tolerance.
TIGHT = 1e-10
#: Of the states: a run of 40 units of time at 1e-10 keeps 1e-8 here (see the numbers that the test
#: prints), all but those that pass many contact edges slowly.
AGREES = 1e-7
N = 96


def lanes(kind: str, n: int, seed: int = 0) -> np.ndarray:
    """Parameters of n runs of a class at random, a column each."""
    rng = np.random.default_rng([ord(kind), seed])
    nu, sigma = rng.uniform(-0.8, 0.8, (2, n)), np.sort(rng.uniform(-1.0, 2.0, (2, n)), axis=0)
    return np.stack({"a": nu[:1], "b": nu, "c": [*nu, sigma[0]], "d": [*nu, *sigma]}[kind])


def from_table(kind: str, table):
    """A function of the number of a run that makes its oscillator."""
    columns = [jnp.asarray(column) for column in table]

    def make(run):
        i = jnp.asarray(run).astype(int)
        return getattr(jb.presets, f"class_{kind}")(*[column[i] for column in columns])

    return make


def sweep_of(kind, table, **options):
    return jb.sweep(from_table(kind, table), {"run": np.arange(1.0 * table.shape[1])}, **options)


def simulated(kind: str, table: np.ndarray):
    make = getattr(jb.presets, f"class_{kind}")
    runs = [
        jb.simulate(make(*one), (3.0, 0.0), SPAN, rtol=TIGHT, atol=TIGHT, max_segments=ARCS)
        for one in table.T.tolist()
    ]
    # Each length of a run would be a program that picks its last row.
    found = [
        (np.asarray(run.ys)[-1], np.asarray(run.modes)[-1], len(run.events.t), run.status)
        for run in runs
    ]
    return [np.stack([np.asarray(one) for one in column]) for column in zip(*found, strict=True)]


@pytest.mark.parametrize("kind", ["b", pytest.param("d", marks=pytest.mark.slow)])
def test_final_states_and_events_equal_those_of_simulate(kind, record_property):
    table = lanes(kind, N)
    dataset = sweep_of(kind, table, t1=SPAN, rtol=TIGHT, atol=TIGHT)
    ys, modes, events, status = simulated(kind, table)
    assert np.array_equal(dataset.status, status)
    assert np.array_equal(dataset.n_events, events)
    assert np.array_equal(dataset.mode_end, modes)
    states = np.stack([dataset.x1_end, dataset.x2_end], axis=-1)
    error = np.max(np.abs(states - ys), axis=-1)
    report = f"median {np.median(error):.1e}, worst {np.max(error):.1e}"
    record_property("report", report)
    print(f"class {kind}: {report}")
    assert np.max(error) < AGREES


@pytest.mark.slow(first=True)
def test_slow_passages_of_an_edge_keep_the_time():
    """Some 900 and 200 in a run: errors in the times of landings would add up."""
    table = lanes("c", 10_000, seed=7)[:, [153, 41]]
    oscillators = [jb.presets.class_c(*parameters) for parameters in table.T.tolist()]
    dataset = lists.swept(oscillators, t1=SPAN, y0=(3.0, 0.0), rtol=TIGHT, atol=TIGHT)
    for i, parameters in enumerate(table.T.tolist()):
        run = oracle.simulate(oracle.class_c(*parameters), (3.0, 0.0), SPAN)
        assert dataset.n_events[i] == len(run.events) > 150
        end = np.array([dataset.x1_end[i], dataset.x2_end[i]])
        np.testing.assert_allclose(end, run.at(SPAN), rtol=0, atol=AGREES)


def test_runs_that_are_not_finite_are_told_in_place_and_harm_no_other():
    table = lanes("b", N)
    broken = table.copy()
    broken[0, 5], broken[1, 50] = np.nan, np.inf
    good, dataset = (sweep_of("b", t, t1=SPAN) for t in (table, broken))
    hit = np.isin(np.arange(N), [5, 50])
    assert np.array_equal(dataset.status == Status.NOT_FINITE, hit)
    for name in ("x1_end", "x2_end", "n_events", "status"):
        assert np.array_equal(dataset[name][~hit], good[name][~hit])


@pytest.mark.slow(first=True)
def test_runs_of_impossible_oscillators_are_told_in_place_in_every_engine():
    """Outside of a trace they raise; inside they would go on and tell numbers."""
    rows = np.array(
        [
            # nu, static, kinetic, load, lower
            [0.2, 0.5, 0.4, 1.0, -1.0],
            [0.2, 0.5, 0.6, 1.0, -1.0],
            [0.2, -0.1, -0.2, 1.0, -1.0],
            [0.2, 0.5, 0.4, -1.0, -1.0],
            [0.2, 0.5, 0.4, 1.0, 2.0],
            [0.2, 0.5, 0.4, 1.0, np.nan],
            [np.inf, 0.5, 0.4, 1.0, -1.0],
        ]
    )

    def make(nu, static, kinetic, load, lower):
        return jb.Oscillator(0.1, (jb.Belt(nu, jb.Coulomb(static, kinetic), load, lower, 1.0),))

    def run(row):
        return jb.simulate(make(*row), (0.9, 0.0), 5.0, ts=jnp.array([5.0]), max_events=64)

    def cycle(row):
        return jb.find_cycle(make(*row), (0.9, 0.0))

    def smooth(row):
        return jb.simulate(make(*row), (0.9, 0.0), 1.0, ts=jnp.array([1.0]), formulation="smooth")

    rests = jax.vmap(lambda row: jb.equilibria(make(*row)))(rows)
    assert np.any(rests.kind[0] > 0) and np.all(rests.kind[1:] == 0)
    runs, smoothed, cycles = (jax.vmap(ask)(rows) for ask in (run, smooth, cycle))
    swept = jb.sweep(
        lambda row: make(*(jnp.asarray(column)[jnp.asarray(row).astype(int)] for column in rows.T)),
        {"row": np.arange(len(rows), dtype=float)},
        y0=(0.9, 0.0),
        t1=5.0,
    )
    for status in (runs.status, smoothed.status, cycles.status, swept.status):
        assert status[0] != Status.NOT_FINITE and np.all(status[1:] == Status.NOT_FINITE)
    for told in (runs.ys, smoothed.ys, cycles.period):
        assert np.all(np.isnan(told[1:]))


@pytest.mark.slow(first=True)
def test_degenerate_velocities():
    """Equal belts (both stick together), belts at rest (the mass stays for ever), opposite ones."""
    cases = np.array([[0.2, 0.2], [0.0, 0.3], [0.3, 0.0], [0.0, 0.0], [0.3, -0.3]]).T
    dataset = sweep_of("b", cases, t1=SPAN, rtol=TIGHT, atol=TIGHT)
    for i, (nu0, nu1) in enumerate(cases.T.tolist()):
        run = oracle.simulate(oracle.class_b(nu0, nu1), (3.0, 0.0), SPAN)
        assert dataset.n_events[i] == len(run.events)
        end = np.array([dataset.x1_end[i], dataset.x2_end[i]])
        np.testing.assert_allclose(end, run.at(SPAN), atol=1e-8)
    assert (dataset.status == Status.STUCK_FOREVER).values.tolist() == [False, *[True] * 3, False]
    kinds = jb.decoded(sweep_of("b", cases, observe="attractor")).kind
    assert kinds.values.tolist() == ["cycle", "stuck", "stuck", "stuck", "cycle"]


@pytest.mark.slow(first=True)
def test_an_excursion_within_one_step_is_found():
    """An undamped circle just beyond a boundary, or an edge, twice; steps of half a unit and more.

    As for `simulate` in tests/test_simulate.py, but not so close: the steps are longer here."""
    law = jb.Coulomb(static=1e-9, kinetic=1e-9)

    def boundary(gap):
        return jb.Oscillator(0.0, (jb.Belt(1.0 - gap, law), jb.Belt(50.0, law)))

    def edge(gap):
        return jb.Oscillator(0.0, (jb.Belt(50.0, law), jb.Belt(60.0, law, lower=1.0 - gap)))

    oscillators = [make(gap) for make in (boundary, edge) for gap in (1e-6, -1e-6)]
    dataset = lists.swept(oscillators, y0=(-1.0, 0.0), t1=12.0)
    assert dataset.n_events.values.tolist() == [4, 0, 4, 0]


# A belt of load 5e4 beyond an edge, to which the mass comes back again and again: a bounce takes
# some 1e-5. The final state by the engine of tests/campaign at 1e-13, and by `simulate`.
HEAVY = jb.Oscillator(
    0.24881058016541968,
    (
        jb.Belt(
            -0.7727968126474689,
            jb.Conti(1.141401599297721, 1.0817844937744994, 1.1550828769555714),
            47792.18037920744,
            lower=-0.5,
        ),
        jb.Belt(
            0.05,
            jb.Conti(0.7839371576095431, 0.621952093843681, 13.292461028521792),
            0.0011496192886156667,
            lower=0.0016014717825907354,
            upper=0.3,
        ),
    ),
)
HEAVY_END = (-0.5000461133112228, -0.01132346337252263)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("tol", [1e-6, 1e-8, 1e-10])
def test_no_event_of_a_heavy_belt_is_missed(tol):
    """At 1e-6 and 1e-8 there were 77 events. An error at an edge counts 235 bounces long."""
    dataset = lists.swept(
        [HEAVY], y0=(-0.24666868128577546, 1.7499879137357852), t1=50.0, rtol=tol, atol=tol
    )
    assert dataset.status.item() == Status.OK and dataset.n_events.item() == 470
    end = dataset.x1_end.item(), dataset.x2_end.item()
    # 5e-8: the rounding of x1 there, 1e-16, in 235 bounces of a load of 5e4.
    np.testing.assert_allclose(end, HEAVY_END, rtol=0, atol=30 * tol + 1e-7)


class Logarithmic(jb.AbstractFriction):
    """A law of a user's own, no quotient: mu falls with the logarithm of the speed."""

    static: jax.Array

    def mu(self, speed):
        return self.static - 0.1 * jnp.log1p(20 * jnp.maximum(speed, -0.02))


@pytest.mark.slow(first=True)
def test_three_belts_with_other_laws():
    def make(nu):
        return jb.Oscillator(
            0.2,
            (
                jb.Belt(nu, jb.Conti(1.0, 0.6, 10.0, quadratic=0.05), load=0.8),
                jb.Belt(-0.2, jb.Stribeck(0.7, 0.4, 0.1), lower=-0.5),
                jb.Belt(0.9, Logarithmic(jnp.asarray(0.5)), upper=1.2),
            ),
            omega=1.3,
        )

    nus = np.linspace(0.1, 0.5, 4)
    dataset = jb.sweep(make, {"nu": nus}, y0=(1.0, 0.4), t1=SPAN, rtol=TIGHT, atol=TIGHT)
    conti, static = oracle.conti(1.0, 0.6, 10.0, 0.05)
    for i, nu in enumerate(nus.tolist()):
        belts = (
            oracle.Belt(nu, conti, static, load=0.8),
            oracle.Belt(-0.2, *oracle.stribeck(0.7, 0.4, 0.1), lower=-0.5),
            oracle.Belt(0.9, lambda r: 0.5 - 0.1 * np.log1p(20 * r), 0.5, upper=1.2),
        )
        run = oracle.simulate(oracle.Oscillator(0.2, belts, 1.3), (1.0, 0.4), SPAN)
        assert dataset.n_events[i] == len(run.events)
        end = np.array([dataset.x1_end[i], dataset.x2_end[i]])
        np.testing.assert_allclose(end, run.at(SPAN), atol=AGREES)


# --- attractors -----------------------------------------------------------------------------------


def test_attractors_equal_the_cycles_of_the_oracle():
    points = np.array([[0.45, 0.35], [0.1, 0.35], [-0.2, 0.35], [-0.5, 0.35], [0.05, -0.4]]).T
    dataset = sweep_of("b", points, observe="attractor", rtol=TIGHT, atol=TIGHT)
    for i, (nu0, nu1) in enumerate(points.T.tolist()):
        here, expected = (
            jb.decoded(dataset.isel(run=i)),
            oracle_cycles.sticking_cycle(oracle.class_b(nu0, nu1)),
        )
        assert here.kind == "cycle"
        for name in ("period", "x1_min", "x1_max", "x2_min", "x2_max"):
            # Ends of steps, and the extrema of x2 in between, from a polynomial of degree four.
            np.testing.assert_allclose(here[name], getattr(expected, name), atol=3e-8)
        np.testing.assert_allclose(here.stick_duration, expected.stick_durations, atol=1e-8)
        assert np.array_equal(here.sticks, np.array(expected.stick_durations) > 0)
        assert here.signature == signature_word(expected.signature)


@pytest.mark.slow(first=True)
def test_a_cycle_that_attracts_weakly_is_not_the_way_to_it():
    """A loop, of multiplier 0.994, moves by less than the tolerance long before the end."""
    gain = 1e-3

    def make():
        return jb.Oscillator(0.5, (jb.Belt(1.0, Bump(jnp.asarray(3.0), gain, jnp.asarray(0.0))),))

    dataset = jb.sweep(
        make, {"x1": np.linspace(1.684, 1.716, 11)}, y0=(0.0, 0.0), observe="attractor"
    )
    assert np.all(jb.decoded(dataset).kind == "cycle")

    # By hand, for SciPy: what `Bump` leaves of friction and damping.
    def field(t, y):
        return y[1], 1.0 - y[0] + gain * (0.98 * y[1] - 8 / 3 * y[1] ** 3)

    def top(t, y):
        return y[1]

    top.direction = -1

    def gained_in_a_loop(x1):
        run = solve_ivp(field, (0.0, 7.0), (x1, 0.0), "DOP853", events=top, rtol=1e-13, atol=1e-13)
        return run.y_events[0][-1][0] - x1

    cycle = brentq(gained_in_a_loop, 1.6, 1.8, xtol=1e-9)
    np.testing.assert_allclose(dataset.x1_max, cycle, atol=3e-6)


def signature_word(events):
    """What a signature is called in a dataset: from where its sequence of events is smallest."""
    told = [(jb.EventKind[kind], belt) for kind, belt in events]
    loop = min(told[i:] + told[:i] for i in range(len(told)))
    return "-".join(f"{kind.name.lower()}{belt}" for kind, belt in loop)


def test_signatures_that_are_not_of_one_turn():
    """At rest there is none; one that no number holds is told to be long."""
    numbers, flags = numbered({code: signature(code, 2) for code in (-1, 0, 1)})
    assert flags["flag_meanings"].split() == ["none", "smooth", "long"]
    assert renumber(np.array([[0, -1], [1, 1]]), numbers).tolist() == [[0, 2], [1, 1]]
    assert np.array_equal(flags["flag_values"], [0, 1, 2])
    word = jnp.ones(())
    for _ in range(16):
        word = append(word, jnp.asarray(4), jnp.asarray(1), 2)
    assert word_events(int(word), 2) == ((jb.EventKind.EDGE, 1),) * 16
    assert np.isinf(append(word, jnp.asarray(4), jnp.asarray(1), 2))


class Late:
    """A reducer that knows the attractor the plain way: what happens in the second half."""

    span = 1000.0

    def init(self, osc, x1, x2):
        return jnp.zeros(len(osc.belts)), jnp.zeros(())

    def update(self, state, event):
        sticks, events = state
        late = jnp.where(event.t > self.span / 2, 1.0, 0.0)
        here = jnp.arange(sticks.size) == event.belt
        stick = here & (event.kind == jb.EventKind.STICK)
        return sticks + late * jnp.where(stick, 1.0, 0.0), events + late

    def finish(self, state, end):
        return {"late_sticks": state[0], "late_events": state[1], "x1": end.x1, "x2": end.x2}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["b", "d"])
def test_early_labels_equal_those_of_long_runs(kind):
    """The small version of a comparison on 20,000 points with T = 3000."""
    table = lanes(kind, 200, seed=1)
    table = table[:, np.min(np.abs(table[:2]), axis=0) > 0.01]  # periods short against the span
    early = jb.decoded(sweep_of(kind, table, observe="attractor"))
    late = sweep_of(kind, table, observe=Late(), t1=Late.span)
    rests = (late.late_events == 0) & (np.abs(late.x2) < 1e-7)
    rests |= late.status == Status.PSEUDO_FOCUS
    assert np.array_equal(early.kind == "equilibrium", rests)
    assert np.array_equal(early.kind == "cycle", ~rests)
    cycles = np.flatnonzero(~rests)
    assert np.array_equal(early.sticks[cycles], late.late_sticks[cycles] > 0)
    at_rest = np.flatnonzero(rests & (late.status == Status.OK))
    np.testing.assert_allclose(early.x1_min[at_rest], late.x1[at_rest], atol=1e-7)
    assert np.array_equal(early.x1_min[at_rest], early.x1_max[at_rest])


@pytest.mark.slow(first=True)
def test_a_cycle_that_crosses_without_sticking():
    """Negative damping drives it, dry friction of two belts limits it: it converges, slowly."""
    law = jb.Coulomb(static=0.1, kinetic=0.1)
    osc = jb.Oscillator(-0.05, (jb.Belt(1.0, law), jb.Belt(-1.0, law)))
    dataset = lists.swept([osc], y0=(1.5, 0.0), observe="attractor").isel(case=0)
    mu = oracle.coulomb(0.1, 0.1)
    there = oracle.Oscillator(-0.05, (oracle.Belt(1.0, *mu), oracle.Belt(-1.0, *mu)))
    run = oracle.simulate(there, (1.5, 0.0), 600.0)
    assert jb.decoded(dataset).kind == "cycle"
    assert not dataset.sticks.any() and dataset.n_events == 4
    assert dataset.signature.flag_meanings == "cross0-cross0-cross1-cross1"
    # It has converged to 1e-7 of the amplitude when it is accepted.
    np.testing.assert_allclose(dataset.period, run.events[-1].t - run.events[-5].t, rtol=1e-6)


@pytest.mark.slow
def test_impossible_times_are_no_answers_and_harm_no_other_lane():
    """Known ones raise; traced ones had states from before the start, with the status OK."""
    osc, nan = jb.presets.class_b(0.45, 0.35), np.nan

    def end(t1, ts, rtol):
        run = jb.simulate(osc, (3.0, 0.0), t1, ts=ts, rtol=rtol, max_segments=64)
        return run.ys, run.status

    rows = [
        (20.0, [1.0, 2.0], 1e-9),
        (-1.0, [1.0, 2.0], 1e-9),
        (0.0, [1.0, 2.0], 1e-9),
        (20.0, [2.0, 1.0], 1e-9),
        (20.0, [1.0, 30.0], 1e-9),
        (20.0, [-3.0, 1.0], 1e-9),
        (20.0, [nan, 1.0], 1e-9),
        (20.0, [1.0, 2.0], -1.0),
    ]
    ys, status = jax.vmap(end)(*(jnp.array(column) for column in zip(*rows)))
    assert status.tolist() == [jb.Status.OK] + [jb.Status.NOT_FINITE] * 7
    assert np.all(np.isnan(ys[1:]))
    alone = jb.simulate(osc, (3.0, 0.0), 20.0, ts=[1.0, 2.0], rtol=1e-9)
    np.testing.assert_allclose(ys[0], alone.ys, atol=1e-9)


@pytest.mark.slow(first=True)
def test_impossible_runs_have_no_derivatives_and_harm_no_other_lane():
    """A derivative of 0 would look like an extremum."""

    def end(load, x1, edge, t1):
        belt = jb.Belt(0.3, jb.Coulomb(1.0, 0.8), load, upper=edge)
        return jb.simulate(jb.Oscillator(0.05, (belt,)), (x1, 0.0), t1, ts=t1[None]).ys[0, 0]

    rows = [
        (0.5, 1.0, 1.2, 4.0),
        (0.5, 1.0, np.inf, 4.0),
        (-1.0, 1.0, 1.2, 4.0),
        (np.nan, 1.0, 1.2, 4.0),
        (0.5, np.nan, 1.2, 4.0),
        (0.5, 1.0, 1.2, 0.0),
    ]
    columns = [jnp.array(column) for column in zip(*rows, strict=True)]
    values, slopes = jax.vmap(jax.value_and_grad(end, argnums=(0, 1, 2, 3)))(*columns)
    assert np.all(np.isfinite(values[:2])) and np.all(np.isnan(values[2:]))
    known, unknown = np.split(np.stack(slopes), [2], axis=1)
    assert np.all(np.isfinite(known)) and np.all(np.isnan(unknown))
    step = 1e-5
    for row in rows[:2]:
        for i in (0, 1, 3):
            beside = [(*row[:i], row[i] + way * step, *row[i + 1 :]) for way in (1, -1)]
            more, less = (end(*(jnp.asarray(value) for value in one)) for one in beside)
            np.testing.assert_allclose(
                slopes[i][rows.index(row)], (more - less) / (2 * step), rtol=0, atol=1e-7
            )


@pytest.mark.slow(first=True)
def test_padding_does_not_spoil_derivatives_in_reverse_mode():
    def run(nu):
        return jb.simulate(jb.presets.class_b(nu, 0.35), (3.0, 0.0), 30.0)

    for numbers in (
        lambda run: run.events.t[4] - run.events.t[0],
        lambda run: run.arcs.duration[0],
        lambda run: jnp.nansum(run.events.t),
    ):
        backwards, forwards = (
            mode(lambda nu, numbers=numbers: numbers(run(nu)))(0.45)
            for mode in (jax.grad, jax.jacfwd)
        )
        np.testing.assert_allclose(backwards, forwards, rtol=1e-9)
