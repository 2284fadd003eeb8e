"""Derivatives of motion that is at rest, that starts on a boundary, or where two guards coincide,
and of machines, some of whose contact edges are at infinity.

A run's steps and events come from its state alone. Where the motion is small, or stands on two
guards at once, the state says nothing of how its neighbours move.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import oracle_cycles
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import jaxbelt as jb
from tests.campaign import compare, derivatives, package
from tests.campaign.cases import PAPER, Case
from tests.campaign.engine import Belt, Oscillator

SPAN = 10.0
#: Without damping a disturbance grows; with the last two it decays fast in one direction and slowly
#: in another.
DAMPING = [0.3, 0.0, 6.0, 50.0]


def linearised(damping):
    """x1 of the equilibrium of `at_rest`, and the derivatives of its flow over SPAN there."""
    law = jb.Conti(1.0, 0.6, 10.0)
    rest, slope = jax.value_and_grad(law.mu)(jnp.asarray(0.5))
    matrix = np.array([[0.0, 1.0], [-1.0, -damping - float(slope)]])
    return float(rest), expm(matrix * SPAN)


def at_rest(damping):
    return jb.Oscillator(damping, (jb.Belt(0.5, jb.Conti(1.0, 0.6, 10.0)),))


@pytest.mark.slow(first=True)
def test_derivatives_of_a_mass_at_rest_by_sweep():
    """Any step keeps the state there, and so says nothing of the error in its derivatives."""
    rest, _ = linearised(0.0)
    dataset = jb.sweep(
        at_rest,
        {"damping": DAMPING, "x1": [rest], "x2": [0.0]},
        t1=SPAN,
        derivatives=("x1", "x2"),
    ).squeeze()
    for i, damping in enumerate(DAMPING):
        found = [
            [dataset[f"d_{end}_end_d_{start}"][i] for start in ("x1", "x2")] for end in ("x1", "x2")
        ]
        np.testing.assert_allclose(found, linearised(damping)[1], atol=3e-8, err_msg=str(damping))


@pytest.mark.slow(first=True)
def test_derivatives_of_a_mass_at_rest_by_simulate():
    rest, _ = linearised(0.0)

    def end(damping, y0):
        return jb.simulate(at_rest(damping), y0, SPAN).ys[-1]

    found = jax.jit(jax.vmap(jax.jacfwd(end, 1), (0, None)))(
        jnp.array(DAMPING), jnp.array([rest, 0.0])
    )
    for jacobian, damping in zip(found, DAMPING):
        np.testing.assert_allclose(jacobian, linearised(damping)[1], atol=1e-10)


@pytest.mark.slow(first=True)
def test_an_edge_without_force_where_x2_is_extreme():
    """At the event x2' = 0, as at slip onset; what is left of the motion is a rotation."""
    law, angle = jb.Conti(1.0, 0.6, 10.0), 2.0
    dataset = jb.sweep(
        lambda: jb.Oscillator(0.0, (jb.Belt(5.0, law, 0.0, upper=0.0),)),
        {"x1": [3.0], "x2": [0.0]},
        t1=angle,
        rtol=1e-12,
        atol=1e-12,
        derivatives=("x1", "x2"),
    ).squeeze()
    assert dataset.n_events == 1
    cos, sin = np.cos(angle), np.sin(angle)
    found = [[dataset[f"d_{end}_end_d_{start}"] for start in ("x1", "x2")] for end in ("x1", "x2")]
    np.testing.assert_allclose(found, [[cos, sin], [-sin, cos]], atol=1e-10)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("by", ["simulate", "sweep"])
def test_a_start_that_sticks_moves_with_its_belt(by):
    """x2 of the start is a number, but the mass has the belt's velocity at once."""
    t1, y0 = 2.0, (1.0, 0.2)  # slip onset is at 3.3
    if by == "simulate":

        def end(nu0, x2):
            return jb.simulate(jb.presets.class_b(nu0, 0.35), (y0[0], x2), t1).ys[-1]

        by_nu0, by_x2 = jax.jit(jax.jacfwd(end, (0, 1)))(0.2, y0[1])
    else:
        axes = {"nu0": [0.2], "nu1": [0.35], "x1": [y0[0]], "x2": [y0[1]]}
        swept = jb.sweep(jb.presets.class_b, axes, t1=t1, derivatives=("nu0", "x2")).squeeze()
        by_nu0, by_x2 = (
            [float(swept[f"d_{end}_end_d_{name}"]) for end in ("x1", "x2")]
            for name in ("nu0", "x2")
        )
    np.testing.assert_allclose(by_nu0, [t1, 1.0], atol=1e-14)
    np.testing.assert_allclose(by_x2, [0.0, 0.0], atol=1e-14)


def on_an_edge(mud, edge):
    """At rest on the edge -0.3 the left-hand side pushes back, and so does the right-hand one where
    mud < 0.5. Where mud = 0.5 that has its equilibrium there."""
    belts = jb.Belt(0.8, jb.Coulomb(0.5, mud)), jb.Belt(-0.7, jb.Coulomb(1.0, 0.8), lower=edge)
    return jb.Oscillator(2.0, belts)


@jax.jit
@jax.jacfwd
def simulated_on_an_edge(row):
    """Of the state at T = 50 by start, mud and edge, [2, 4]."""
    return jb.simulate(on_an_edge(*row[2:]), row[:2], 50.0, ts=jnp.array([50.0])).ys[-1]


def derivatives_on_an_edge(by, mud, start):
    """The same of either."""
    if by == "simulate":
        return simulated_on_an_edge(jnp.array([*start, mud, -0.3]))
    axes = {"x1": start[:1], "x2": start[1:], "mud": [mud], "edge": [-0.3]}
    found = jb.sweep(on_an_edge, axes, t1=50.0, derivatives=tuple(axes)).squeeze()
    return np.array([[float(found[f"d_{i}_end_d_{j}"]) for j in axes] for i in ("x1", "x2")])


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("by", ["simulate", "sweep"])
@pytest.mark.parametrize("mud", [0.4, 0.5])
def test_a_start_at_a_pseudo_focus_moves_with_its_edge(by, mud):
    """Its neighbours are pushed back there."""
    found = derivatives_on_an_edge(by, mud, [-0.3, 0.0])
    np.testing.assert_array_equal(found, [[0, 0, 0, 1], [0, 0, 0, 0]])


def captured_on_an_edge(velocity, mud, edge):
    """Spirals into a pseudo-focus where two belts end, of which one exerts no force."""
    law = jb.Stribeck(0.5, 0.25, 0.1)
    idle = jb.Belt(-0.5, law, 0.0, lower=-0.35)
    belts = jb.Belt(velocity, law, upper=edge), idle, jb.Belt(-0.9, jb.Coulomb(1.2, mud), 0.5)
    return jb.Oscillator(1.0, belts)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("by", ["simulate", "sweep"])
def test_a_run_that_a_pseudo_focus_captures_moves_with_its_edge(by):
    """Nothing else moves it, however late it is captured."""
    at, start = {"velocity": 0.9, "mud": 1.2, "edge": -0.35}, (-0.35, -0.5)
    if by == "simulate":

        def end(row):
            osc = captured_on_an_edge(*row)
            return jb.simulate(osc, start, 50.0, ts=jnp.array([50.0])).ys[-1]

        found = jax.jit(jax.jacfwd(end))(jnp.array([*at.values()]))
    else:
        axes = {name: [value] for name, value in at.items()}
        swept = jb.sweep(captured_on_an_edge, axes, y0=start, t1=50.0, derivatives=tuple(at))
        assert swept.status.item() == jb.Status.PSEUDO_FOCUS
        found = [[swept[f"d_{i}_end_d_{j}"].item() for j in at] for i in ("x1", "x2")]
    np.testing.assert_array_equal(found, [[0, 0, 1], [0, 0, 0]])


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("by", ["simulate", "sweep"])
def test_a_run_that_comes_to_rest_on_an_edge_moves_with_its_equilibrium(by):
    """That of the side from which it came; a step of it ends on the edge."""
    found = derivatives_on_an_edge(by, 0.5, [-1.4, 0.8])
    np.testing.assert_allclose(found, [[0, 0, 1, 0], [0, 0, 0, 0]], atol=1e-9)


def around_an_edge(damping, mud, edge):
    """Turns around the equilibrium 0.5, past the edge of a belt that exerts no force."""
    idle = jb.Belt(0.9, jb.Coulomb(0.7, 0.7), 0.0, lower=edge)
    return jb.Oscillator(damping, (jb.Belt(0.8, jb.Coulomb(0.6, mud)), idle))


#: Damping and time: the motion is one of 2e-11, and at rest up to rounding.
TURNS = (0.5, 100.0), (1.0, 60.0), (0.5, 200.0)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("by", ["simulate", "sweep"])
def test_an_edge_without_force_at_an_equilibrium(by):
    """However small a loop is that passes it. At its end the equilibrium alone counts."""
    row = jnp.array([0.5, 0.5])

    @jax.jit
    def simulated(row, damping, t1):
        osc = around_an_edge(damping, *row)
        return jb.simulate(osc, (-1.3, 0.3), t1, ts=t1[None]).ys[-1]

    for damping, t1 in TURNS:
        if by == "simulate":
            found = jax.jacfwd(simulated)(row, damping, jnp.asarray(t1))
        else:
            axes = {"damping": [damping], "mud": [0.5], "edge": [0.5]}
            question = dict(y0=(-1.3, 0.3), t1=t1, derivatives=("mud", "edge"))
            data = jb.sweep(around_an_edge, axes, **question).squeeze()
            found = [
                [float(data[f"d_{i}_end_d_{j}"]) for j in ("mud", "edge")] for i in ("x1", "x2")
            ]
        np.testing.assert_allclose(found, [[1, 0], [0, 0]], atol=1e-8, err_msg=f"{damping}, {t1}")


STEEP = ("conti", 1.0, 0.6, 5.0, 0.0)
CASES = {
    "starts by sticking": (Oscillator(0.5, (Belt(0.2, PAPER), Belt(0.35, PAPER))), (1.0, 0.2)),
    "an unloaded belt at rest": (
        Oscillator(0.25, (Belt(0.0, STEEP, 0.0, upper=-0.5),)),
        (3.0, 0.0),
    ),
    "a loaded and an unloaded belt of one velocity": (
        Oscillator(
            0.1,
            (
                Belt(0.25, ("stribeck", 0.5, 0.25, 0.05), 0.5),
                Belt(0.25, ("stribeck", 1.2, 0.96, 0.45), 0.0, -0.85, 0.5),
            ),
            0.5,
        ),
        (0.2, 0.0),
    ),
    "onset on an edge without load": (
        Oscillator(
            0.05,
            (Belt(0.05, PAPER, 0.0, upper=1.98), Belt(0.4, ("conti", 1.0, 0.5, 10.0, 0.0), 2.0)),
        ),
        (3.0, 0.0),
    ),
    "onset on an edge": (
        Oscillator(
            0.2,
            (
                Belt(-0.15, ("stribeck", 1.0, 1.0, 0.3)),
                Belt(0.15, PAPER, lower=-1.03, upper=-0.27),
            ),
        ),
        (0.76, 0.15),
    ),
    "starts on an edge, at onset": (
        Oscillator(
            0.25,
            (
                Belt(-0.7, ("conti", 1.2, 0.48, 10.0, 0.0), 2.0, upper=-0.6),
                Belt(-0.7, ("conti", 0.5, 0.25, 5.0, 0.0), 2.0, lower=-2.225),
                Belt(-0.75, ("conti", 1.0, 0.4, 1.0, 0.0), 2.0, lower=-2.225, upper=-0.6),
            ),
        ),
        (-2.225, -0.7),
    ),
}


#: Of these the slow tests of CI ask, too.
FIRST = {("an unloaded belt at rest", "sweep"), ("starts on an edge, at onset", "sweep")}


@pytest.mark.parametrize(
    ("name", "by"),
    [
        pytest.param(
            *both, marks=pytest.mark.slow(first=True) if both in FIRST else pytest.mark.slow
        )
        for both in itertools.product(CASES, ["simulate", "sweep"])
    ],
)
def test_derivatives_where_guards_coincide(name, by):
    """Against the engine of the campaigns, on both sides of the coincidence."""
    osc, y0 = CASES[name]
    case = Case(osc, y0, 50.0)
    mine, rng, verdicts = compare.run(case), np.random.default_rng(3), []
    for _ in range(4):
        direction = derivatives.directions(case, rng)
        (told,) = package.derivatives([case], [direction], 1e-11, by)
        verdicts.append(compare.judge_derivative(case, told, mine, direction, 1e-11)[0])
    # "corner": in that direction there is none, it differs from one side to the other.
    assert set(verdicts) <= {"same", "corner"} and "same" in verdicts


@pytest.mark.slow
@pytest.mark.parametrize("by", ["simulate", "sweep"])
@pytest.mark.parametrize(
    "name", ["a loaded and an unloaded belt of one velocity", "onset on an edge without load"]
)
def test_the_order_of_belts_changes_no_derivative(name, by):
    """Though they act at one place: what counts is which of them exerts a force."""
    osc, y0 = CASES[name]
    start, damping, belts = derivatives.directions(Case(osc, y0), np.random.default_rng(4))
    alone = [(velocity, *rest) for velocity, (_, *rest) in zip((0.3, -0.8), belts, strict=True)]
    found = []
    for order in (1, -1):
        case = Case(Oscillator(osc.damping, osc.belts[::order], osc.omega), y0, 50.0)
        direction = start, damping, tuple(alone[::order])
        found.append(package.derivatives([case], [direction], 1e-11, by)[0])
    np.testing.assert_allclose(*found, rtol=1e-7)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("size", [1e4, 1e7])
def test_derivatives_of_large_states(size):
    """From the bend of the law the mass is off at once, so that the way there has thousands of
    steps. By the variational equation, for there is no event yet."""
    velocities, t1 = (0.3, 0.35), 1.0

    def field(t, state):
        x1, x2, d1, d2 = state
        r = np.array(velocities) - x2
        force, slope = 0.4 / (1 + 10 * r) + 0.6, 4 / (1 + 10 * r) ** 2
        return [x2, -x1 - 0.5 * x2 + force.sum(), d2, -d1 + (slope.sum() - 0.5) * d2]

    start = [size, 0.0, 1.0, 0.0]
    atol = [1e-13 * size, 1e-13 * size, 1e-14, 1e-14]
    known = solve_ivp(field, (0, t1), start, method="DOP853", rtol=1e-13, atol=atol).y[:, -1]

    def end(x1):
        osc = jb.presets.class_b(*velocities)
        return jb.simulate(osc, jnp.stack([x1, 0.0]), t1, ts=jnp.array([t1])).ys[-1]

    np.testing.assert_allclose(end(size), known[:2], rtol=1e-9)
    for found in (jax.jacfwd(end)(size), jax.jacrev(end)(size)):
        np.testing.assert_allclose(found, known[2:], rtol=1e-8)


# --- machines, and edges at infinity --------------------------------------------------------------


MASS, STIFFNESS, DASHPOT, UNTIL = 0.5, 2000.0, 1.0, 30.0
#: Normal force and stiffness.
AT = jnp.array([5.0, STIFFNESS])


def machine(p, V=0.02):
    """The second belt presses with a fifth of the largest force."""
    laws = jb.Conti(0.4, 0.25, 100.0), jb.Conti(0.3, 0.2, 50.0)
    slow, fast = jb.PhysicalBelt(V, laws[0], p[0]), jb.PhysicalBelt(0.09, laws[1], 1.0)
    return jb.Machine(MASS, p[1], DASHPOT, (slow, fast))


def by_hand(p, V=0.02):
    """The same with speeds in units of N / sqrt(k m), in the oracle."""
    N, k = map(float, p)
    root = np.sqrt(k * MASS)
    speed = N / root
    slow = oracle.Belt(V / speed, *oracle.conti(0.4, 0.25, 100.0 * speed), 1.0)
    fast = oracle.Belt(0.09 / speed, *oracle.conti(0.3, 0.2, 50.0 * speed), 1.0 / N)
    return oracle.Oscillator(DASHPOT / root, (slow, fast))


def directly(p):
    """The same, with edges that a user might write; that of the second belt is a finite one."""
    speed = p[0] / jnp.sqrt(p[1] * MASS)
    length = p[0] / p[1]
    slow = jb.Conti(0.4, 0.25, 100.0 * speed)
    fast = jb.Conti(0.3, 0.2, 50.0 * speed)
    belts = (
        jb.Belt(0.02 / speed, slow, 1.0, -jnp.inf / length, jnp.inf / length),
        jb.Belt(0.09 / speed, fast, 1.0 / p[0], upper=100.0 / length),
    )
    return jb.Oscillator(DASHPOT / jnp.sqrt(p[1] * MASS), belts)


def by_differences(of):
    """The derivatives by the normal force and the stiffness, of a function of both."""

    def along(i):
        def at(value):
            return of(np.where(np.arange(2) == i, value, np.asarray(AT)))

        value, error = oracle.richardson(at, float(AT[i]), 1e-3 * float(AT[i]))
        assert error < 1e-7 * max(1.0, abs(value))
        return value

    return np.array([along(0), along(1)])


def end_of(p, make=lambda p: machine(p).oscillator):
    return jb.simulate(make(p), (1.2, 0.0), UNTIL, ts=jnp.array([0.0, UNTIL])).ys[-1, 0]


@pytest.fixture(scope="module")
def slopes_of_end():
    return by_differences(lambda p: oracle.simulate(by_hand(p), (1.2, 0.0), UNTIL).y_end[0])


# Tolerances of 1e-10 a step, and differences good to 1e-7.
TOLERANCE = 1e-6


@pytest.mark.slow(first=True)
def test_derivatives_of_a_machines_run(slopes_of_end):
    assert jax.grad(end_of)(AT) == pytest.approx(slopes_of_end, rel=TOLERANCE)


@pytest.mark.slow
def test_derivatives_of_batches_of_a_machines_runs(slopes_of_end):
    batch = jnp.stack([AT, 1.01 * AT])
    for derivative in (jax.grad(end_of), jax.jacfwd(end_of)):
        rows = jax.jit(jax.vmap(derivative))(batch)
        assert np.all(np.isfinite(rows))
        assert rows[0] == pytest.approx(slopes_of_end, rel=TOLERANCE)


@pytest.mark.slow
def test_derivatives_of_a_run_with_edges_that_are_divided(slopes_of_end):
    """Reverse mode where the edges are known, as they are outside of jit; forward everywhere."""

    def of(p):
        return end_of(p, directly)

    assert jax.grad(of)(AT) == pytest.approx(slopes_of_end, rel=TOLERANCE)
    assert jax.jit(jax.jacfwd(of))(AT) == pytest.approx(slopes_of_end, rel=TOLERANCE)


@pytest.mark.slow(first=True)
def test_derivatives_of_the_edges_of_a_machine():
    def edges(p):
        belt = jb.PhysicalBelt(0.1, jb.Coulomb(0.4, 0.3), p[0], upper=0.004)
        belt = jb.Machine(MASS, p[1], DASHPOT, (belt,)).oscillator.belts[0]
        return jnp.stack([belt.lower, belt.upper])

    # Its unit of length is N/k.
    for derivative in (jax.jacfwd(edges), jax.jacrev(edges), jax.jit(jax.jacrev(edges))):
        expected = [[0.0, 0.0], [-0.004 * 2000 / 25, 0.004 / 5]]
        assert np.allclose(derivative(AT), expected, rtol=1e-14, atol=0)


def test_derivatives_of_a_machine_that_is_itself_traced():
    """Its edges are unknown then, and may be anything; and there and back again."""

    def edges(m):
        there = m.oscillator
        return jnp.stack([there.belts[0].lower, m.of_oscillator(there).belts[1].upper])

    upside = jax.tree.map(jnp.zeros_like, machine(AT))
    for of in (edges, jax.jit(edges)):
        found = jax.jacrev(of)(machine(AT))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))
    _, moved = jax.jvp(edges, (machine(AT),), (jax.tree.map(jnp.ones_like, upside),))
    assert np.all(np.isfinite(moved))


def test_derivatives_of_edges_that_are_divided():
    """As above, of the edges alone."""

    def edges(L):
        belt = jb.Belt(0.1, jb.Coulomb(0.4, 0.3), 1.0, -jnp.inf / L, 2.0 / L)
        return jnp.stack([belt.lower, belt.upper])

    assert np.allclose(jax.jacrev(edges)(2.0), [0.0, -0.5], rtol=1e-14, atol=0)
    assert np.allclose(jax.jit(jax.jacfwd(edges))(2.0), [0.0, -0.5], rtol=1e-14, atol=0)
    found = jax.vmap(jax.jacfwd(edges))(jnp.array([2.0]))
    assert np.allclose(found, [[0.0, -0.5]], rtol=1e-14, atol=0)


@pytest.mark.slow
def test_derivatives_of_a_machines_cycle():
    def period(p):
        return jb.find_cycle(machine(p).oscillator, (1.2, 0.0)).period

    expected = by_differences(lambda p: oracle_cycles.sticking_cycle(by_hand(p), (1.2, 0.0)).period)
    assert jax.grad(period)(AT) == pytest.approx(expected, rel=TOLERANCE)
    assert jax.jacfwd(period)(AT) == pytest.approx(expected, rel=TOLERANCE)
    rows = jax.vmap(jax.grad(period))(jnp.stack([AT, 1.01 * AT]))
    assert rows[0] == pytest.approx(expected, rel=TOLERANCE) and np.all(np.isfinite(rows))


@pytest.mark.slow
def test_derivatives_of_a_machines_nonsmooth_fold():
    """By V, the velocity of the first belt in m/s."""

    def fold(p, at=0.095):
        point = jb.refine(jb.NonsmoothFold(0), lambda V: machine(p, V).oscillator, at=at)
        return point.value

    def theirs(p):
        bracket = 0.9 * float(ours), 1.1 * float(ours)
        return oracle_cycles.nonsmooth_fold(lambda V: by_hand(p, V), bracket, 0)

    ours = fold(AT)
    assert float(ours) == pytest.approx(theirs(AT), rel=1e-9)
    expected = by_differences(theirs)
    near = functools.partial(fold, at=1.02 * float(ours))
    assert jax.grad(near)(AT) == pytest.approx(expected, rel=TOLERANCE)
    rows = jax.jit(jax.vmap(jax.jacfwd(near)))(AT[None])
    assert rows[0] == pytest.approx(expected, rel=TOLERANCE)
