"""Loops that a run repeats: followed once, they are those of runs that follow them all."""

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest

import jaxbelt as jb
from jaxbelt import Status

#: As in tests/test_simulate.py, for one program.
ARCS = 4096
SPAN, SAMPLES = 60.0, 64
#: Shorter than any loop here, so that nothing repeats in a run of this length.
PIECE = 1.5

PAPER = jb.Conti(1.0, 0.6, 10.0)
OSCILLATORS = {
    "one belt": jb.presets.class_b(0.45, 0.35),
    "both belts": jb.presets.class_b(-0.1, 0.1),
    "equal speeds": jb.presets.class_b(0.2, 0.2),
    "edges": jb.presets.class_d(0.3, 0.2, 0.2, 0.9),
    "a static limit": jb.Oscillator(
        0.1, (jb.Belt(0.2, jb.Coulomb(1.0, 0.5)), jb.Belt(-0.3, PAPER, 0.5, 0.0))
    ),
}


def run_of(osc, y0, t0, t1):
    ts = jnp.linspace(t0, t1, SAMPLES)
    return jb.simulate(osc, y0, t1, t0=t0, ts=ts, max_segments=ARCS)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("name", OSCILLATORS)
def test_a_run_is_that_of_its_pieces(name):
    """Each loop is followed in the pieces. Both are right to a hundredth of 1e-10 an arc; what
    remains of that after a stick phase is a shift of the time."""
    osc, y0 = OSCILLATORS[name], (3.0, 0.0)
    run, t, pieces = run_of(osc, y0, 0.0, SPAN), 0.0, []
    for i in range(1, round(SPAN / PIECE) + 1):
        pieces.append(run_of(osc, y0, t, i * PIECE))
        y0, t = pieces[-1].ys[-1], i * PIECE
    assert int(run.status) == Status.OK
    events = [
        np.concatenate([getattr(piece.events, part) for piece in pieces])
        for part in ("t", "y", "kind", "belt")
    ]
    followed = jb.find_cycle(osc, (3.0, 0.0))
    assert len(events[0]) > 4 * len(followed.signature)  # it does repeat
    for part, expected in zip(("t", "y"), events, strict=False):
        np.testing.assert_allclose(getattr(run.events, part), expected, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(run.events.kind, events[2])
    np.testing.assert_array_equal(run.events.belt, events[3])

    times = np.concatenate([piece.ts for piece in pieces])
    keep = slice(0, None, len(times) // SAMPLES)
    times, ys = (
        times[keep][:SAMPLES],
        np.concatenate([piece.ys for piece in pieces])[keep][:SAMPLES],
    )
    again = jb.simulate(osc, (3.0, 0.0), SPAN, ts=jnp.asarray(times), max_segments=ARCS)
    np.testing.assert_allclose(again.ys, ys, rtol=0, atol=1e-9)

    # The arcs are a chain without gaps, and each begins where it is said to.
    ends = run.arcs.t + run.arcs.duration
    np.testing.assert_allclose(run.arcs.t[1:], ends[:-1], rtol=0, atol=1e-12)
    assert ends[-1] == pytest.approx(SPAN, abs=1e-12)
    entries = np.asarray(run.arcs.t)
    at = np.linspace(0, len(entries) - 1, SAMPLES).astype(int)
    again = jb.simulate(osc, (3.0, 0.0), SPAN, ts=jnp.asarray(entries[at]), max_segments=ARCS)
    np.testing.assert_allclose(again.ys, run.arcs.y[at], rtol=0, atol=1e-9)


@pytest.mark.slow(first=True)
def test_times_of_later_loops_move_by_the_period():
    """d t(n + k m)/dp = d t(n)/dp + k d period/dp, the period by shooting. And states behind the
    loops, in the first arc there and in the last, by differences of the oracle, which follows all.
    """
    loops, size = 7, 2  # events of a loop: STICK and SLIP
    whole = oracle.simulate(oracle.class_b(0.45, 0.35), (3.0, 0.0), SPAN)
    # The last loop ends at the last slip onset.
    late = [max(one.t for one in whole.events if one.kind == "SLIP") + 0.2, SPAN]

    def times(p):
        run = jb.simulate(
            jb.presets.class_b(p[0], 0.35), (p[1], 0.0), SPAN, ts=jnp.array(late), max_events=64
        )
        return jnp.append(run.events.t[jnp.array([2, 2 + loops * size])], run.ys.ravel())

    def period(p):
        return jb.find_cycle(jb.presets.class_b(p[0], 0.35), (3.0, 0.0)).period

    p = jnp.array([0.45, 3.0])
    (first, last, *_), slopes = times(p), jax.jacfwd(times)(p)
    one, slope = jax.value_and_grad(period)(p)
    np.testing.assert_allclose(last - first, loops * one, rtol=0, atol=1e-10)
    np.testing.assert_allclose(slopes[1] - slopes[0], loops * slope, rtol=0, atol=1e-8)
    # The start moves the first loop, and all others with it by just as much.
    assert slopes[0, 1] == slopes[1, 1] != 0

    def states(nu0):
        run = oracle.simulate(oracle.class_b(nu0, 0.35), (3.0, 0.0), SPAN)
        return np.ravel([run.at(t) for t in late])

    for i in range(4):
        difference, error = oracle.richardson(lambda nu0, i=i: states(nu0)[i], 0.45, 1e-3)
        assert error < 1e-7
        np.testing.assert_allclose(slopes[2 + i, 0], difference, rtol=0, atol=1e-7)


@pytest.mark.slow(first=True)
def test_a_budget_counts_the_arcs_that_are_not_followed():
    """As if all were: it is used up where it is too small for the loops that repeat."""
    osc = OSCILLATORS["one belt"]
    whole = jb.simulate(osc, (3.0, 0.0), SPAN, max_segments=ARCS)
    room = 32
    assert room < len(whole.arcs.t)
    part = jb.simulate(osc, (3.0, 0.0), SPAN, max_segments=room)
    assert int(part.status) == Status.TOO_MANY_SEGMENTS
    assert len(part.arcs.t) == room
    np.testing.assert_allclose(part.arcs.t, whole.arcs.t[:room], rtol=0, atol=1e-10)
    assert np.all(np.isnan(part.ys[part.ts > part.arcs.t[-1] + part.arcs.duration[-1]]))
