"""Round numbers: where a slip onset, an edge, an equilibrium and another belt meet exactly.

Each case went wrong once, in the sweep or in `find_cycle`. The oracle is the engine of the
campaigns, `tests/campaign/engine.py`; `judge` says what counts as right (docs/checked.md).
"""

import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt import Status
from tests.campaign import compare, engine, package
from tests.campaign.cases import PAPER, Case
from tests.campaign.engine import Belt, Oscillator

STEEP, STRONG = ("conti", 1.0, 0.6, 5.0, 0.0), ("conti", 1.0, 0.6, 2.0, 0.0)
MILD, WEAK = ("conti", 1.0, 0.5, 10.0, 0.0), ("conti", 0.5, 0.25, 10.0, 0.0)
SOFT, DRY = ("conti", 1.0, 0.4, 1.0, 0.0), ("coulomb", 1.2, 0.6)
STRUCTURES = [((law, law), edges) for law, edges in (("conti", 0), ("conti", 1), ("coulomb", 1))]
#: Each takes a compilation. The second has all that the first has, and an edge.
structures = pytest.mark.parametrize(
    "structure",
    [
        pytest.param(STRUCTURES[0], marks=pytest.mark.slow(first=True)),
        STRUCTURES[1],
        pytest.param(STRUCTURES[2], marks=pytest.mark.slow(first=True)),
    ],
)


def at_onset(shift):
    """Slip onset of belt 0 a distance `shift` before the edge of both belts, 0.9."""
    edge = 0.9 + shift
    return Oscillator(0.25, (Belt(0.4, PAPER, upper=edge), Belt(-0.55, PAPER, lower=edge)))


CASES = {
    # Stick phases on two belts that end in the same x1 and the same mode.
    "two ends, one x1": (Oscillator(0.5, (Belt(0.6, PAPER), Belt(-0.9, PAPER))), (3.0, 0.0)),
    "two ends at T": (Oscillator(0.5, (Belt(0.15, PAPER), Belt(-1.35, PAPER))), (1.85, 0.45)),
    # Slip onset on an edge, and near it.
    **{f"onset {d:g} before": (at_onset(d), (3.0, 0.0)) for d in (0.0, 1e-9, 1e-12, -1e-9)},
    "onset on a leaving edge": (
        Oscillator(0.5, (Belt(-0.2, STEEP, upper=-0.5), Belt(-0.4, STEEP, 2.0, lower=-1.0))),
        (0.0, 0.0),
    ),
    "onset on an arriving edge": (
        Oscillator(0.5, (Belt(1.0, MILD, upper=1.0), Belt(-0.55, MILD, lower=0.5))),
        (-2.0, 0.0),
    ),
    "onset, one velocity": (
        Oscillator(
            0.05, (Belt(0.35, PAPER, 0.5, -0.035, 0.9), Belt(0.35, PAPER, 0.5, lower=0.465)), 0.5
        ),
        (0.0, 0.0),
    ),
    # Needed force and capacity are equal, to rounding, where an edge is passed while sticking.
    "held to rounding": (
        Oscillator(
            1.0,
            (Belt(-0.65, STRONG, 2.0, upper=1.06666666666667), Belt(-0.4, STRONG, 2.0, -1.1)),
            0.5,
        ),
        (3.0, 0.0),
    ),
    "held to rounding, again": (
        Oscillator(
            0.1, (Belt(-0.9, WEAK, 2.0, -0.45, 0.20666666666667), Belt(-0.4, WEAK, 1.5, -0.45))
        ),
        (3.0, 0.0),
    ),
    # Rest on an edge: between two pushes, or where the field of one side vanishes.
    "rest where a side is at rest": (
        Oscillator(0.5, (Belt(0.75, STEEP, upper=0.0), Belt(0.05, STEEP, 0.0, lower=0.0))),
        (3.0, 0.0),
    ),
    "start there": (
        Oscillator(0.5, (Belt(0.75, STEEP, upper=0.0), Belt(0.05, STEEP, 0.0, lower=0.0))),
        (0.0, 0.0),
    ),
    "start at a pseudo-focus": (
        Oscillator(0.5, (Belt(1.0, MILD, upper=1.0), Belt(-0.55, MILD, lower=0.5))),
        (0.5, 0.0),
    ),
    "held on one side of an edge": (
        Oscillator(0.5, (Belt(0.0, WEAK, upper=1.5), Belt(0.7, WEAK, upper=-0.5))),
        (-0.5, 0.0),
    ),
    "an edge that changes nothing": (
        Oscillator(
            0.5,
            (Belt(0.8, PAPER, upper=0.64444444444444), Belt(0.8, PAPER, lower=0.64444444444444)),
            0.5,
        ),
        (0.64444444444444, 1.2),
    ),
    # A belt that exerts no force is no obstacle, at rest or not.
    "pseudo-focus beside an idle belt": (
        Oscillator(
            0.6108,
            (
                Belt(0.1345, ("conti", 1.0528, 0.715, 0.8284, 0.1321), 1.3767, upper=0.4697),
                Belt(0.0, ("conti", 0.52, 0.464, 4.93, 0.235), 0.0, lower=0.4697),
            ),
            0.7387,
        ),
        (1.3, 0.0),
    ),
    "node on an idle belt's boundary": (
        Oscillator(2.0, (Belt(0.0, PAPER, 0.0, upper=1.4), Belt(-1.0, PAPER, 0.5, lower=-1.15))),
        (0.7, 0.0),
    ),
    # Belts of one velocity, one of them idle: the mass slips where neither holds it.
    "an idle belt arrives at onset": (
        Oscillator(0.05, (Belt(-0.95, SOFT, 0.0, upper=0.0475), Belt(-0.95, SOFT, lower=0.0475))),
        (2.45, 0.0),
    ),
    "an idle belt stays at onset": (
        Oscillator(0.1, (Belt(0.85, PAPER, 1.0, upper=-0.085), Belt(0.85, PAPER, 0.0, lower=-0.2))),
        (2.95, 0.85),
    ),
    # A node exactly on an edge, beyond which the mass would go on.
    "node on an edge": (
        Oscillator(2.0, (Belt(0.55, DRY, 1.0), Belt(-0.65, ("coulomb", 0.8, 0.4), upper=0.6)), 2.0),
        (3.0, 0.0),
    ),
    "node on an edge of a pseudo-focus": (
        Oscillator(
            2.0,
            (Belt(0.55, ("coulomb", 0.5, 0.3)), Belt(-0.3, ("coulomb", 0.5, 0.3), lower=0.3)),
        ),
        (0.95, 0.55),
    ),
    # On the boundary of a belt at rest that could hold the mass.
    "node on the boundary of a belt at rest": (
        Oscillator(
            2.0,
            (
                Belt(0.5, ("coulomb", 0.8, 0.64), 1.5, upper=0.1),
                Belt(0.0, ("coulomb", 0.8, 0.64), 2.0),
            ),
            2.0,
        ),
        (-2.98, 0.25),
    ),
    # A push five thousand times as hard on one side.
    "hard push": (
        Oscillator(
            0.3356,
            (
                Belt(-0.5924, ("conti", 0.5411, 0.4906, 9.2532, 0.0), 4431.87, lower=0.2305),
                Belt(0.5103, ("conti", 0.6543, 0.4098, 9.0086, 0.0), 1.5834),
            ),
        ),
        (-29.947, 8.034),
    ),
}


def by_simulate(case):
    """The case's run, told as the campaigns are told it."""
    osc = package.oscillator(case.oscillator)
    # Room for as many arcs as in tests/test_simulate.py, for one program.
    run = jb.simulate(osc, case.y0, case.T, max_segments=4096)
    events = run.events
    rows = zip(*(np.asarray(part).tolist() for part in (events.t, events.kind, events.belt)))
    told = tuple((*row, *y) for row, y in zip(rows, np.asarray(events.y).tolist()))
    mode = tuple(np.asarray(run.modes[-1]).tolist())
    return package.Final(*map(float, run.ys[-1]), mode, len(told), int(run.status), told)


def wanted(structure):
    cases = [Case(osc, y0, 50.0, "rational") for osc, y0 in CASES.values()]
    return [case for case in cases if case.structure == structure]


def test_every_case_is_run():
    assert sum(len(wanted(structure)) for structure in STRUCTURES) == len(CASES)


@pytest.mark.slow(first=True)
@structures
def test_runs_on_round_numbers(structure):
    cases = wanted(structure)
    for case, answer in zip(cases, package.finals(cases, 1e-8)):
        verdict, mine = compare.judge(case, answer, 1e-8)
        assert verdict in compare.GOOD, (verdict, package.as_code(case), answer, mine)
    for case in cases:
        verdict, mine = compare.judge(case, by_simulate(case), 1e-10)
        assert verdict in compare.GOOD, (verdict, package.as_code(case), mine)


@pytest.mark.slow(first=True)
@structures
def test_labels_of_round_numbers(structure):
    cases = wanted(structure)
    for case, answer in zip(cases, package.labels(cases, 1e-8)):
        verdict, mine = compare.judge_label(case, answer, 1e-8)
        assert verdict in compare.GOOD, (verdict, package.as_code(case), answer, mine)


# Around a hard push it takes more loops than `find_cycle` follows, and says so.
@pytest.mark.slow(first=True)
@pytest.mark.parametrize("name", [name for name in CASES if name != "hard push"])
def test_find_cycle_settles_on_round_numbers(name):
    osc, y0 = CASES[name]
    found, known = jb.find_cycle(package.oscillator(osc), y0), engine.attractor(osc, y0)
    if known.kind == "cycle":
        loops = known.period / float(found.period)
        # The engine may tell several loops; both are far more exact than this.
        assert found.status == Status.OK and abs(loops - round(loops)) < 1e-7
    elif known.kind == "equilibrium":
        assert found.status in (Status.EQUILIBRIUM, Status.PSEUDO_FOCUS)
    else:
        assert found.status == Status.STUCK_FOREVER


# Slip onset and an edge at one place, up to the rounding of x1 (a twentieth each, or a third).
TIES = {
    "both leave": Oscillator(
        0.1,
        (Belt(0.35, ("conti", 1.2, 0.48, 2.0, 0.0), 0.5), Belt(-0.55, PAPER, 0.5, -0.95, 0.245)),
    ),
    "one arrives": Oscillator(
        0.1, (Belt(-0.2, PAPER, 0.5, lower=-0.15), Belt(0.2, PAPER, 0.5)), 2.0
    ),
    "one leaves": Oscillator(0.1, (Belt(0.7, PAPER, 1.0, -0.34, 1.66), Belt(-0.2, PAPER, 1.0))),
    "stiff": Oscillator(
        0.2, (Belt(0.5, PAPER, 2.0, lower=-0.05), Belt(-1.0, PAPER, 1.5, lower=-0.1))
    ),
    "slow": Oscillator(0.25, (Belt(0.15, PAPER, 1.5), Belt(-0.15, PAPER, 2.0, lower=-0.875)), 0.5),
}


@pytest.mark.slow(first=True)
def test_onset_on_an_edge_is_the_same_in_every_engine():
    """At the edge: which of the two comes first is decided once, not by the rounding of each."""
    cases = [Case(osc, (3.0, 0.0), 50.0, "rational") for osc in TIES.values()]
    for case, swept in zip(cases, package.finals(cases, 1e-8)):
        run = by_simulate(case)
        assert (swept.n_events, swept.mode) == (run.n_events, run.mode)
        onsets = [(t, e) for t, kind, _, *e in run.events if kind == jb.EventKind.SLIP]
        edges = [t for t, kind, *_ in run.events if kind == jb.EventKind.EDGE]
        # No slip onset just before an edge, ...
        assert all(min(abs(np.subtract(edges, t))) > 1e-9 for t, _ in onsets)


@pytest.mark.slow(first=True)  # the only program for the attractors of three belts
def test_an_orbit_that_leaves_its_rest_slowly_is_followed_to_its_cycle():
    """From rest beside an unstable equilibrium, which it leaves like exp(0.01 t)."""
    belts = (Belt(0.95, PAPER, 0.5, upper=-1.05), Belt(-0.65, PAPER, 0.5, lower=-1.05))
    osc = Oscillator(0.05, (*belts, Belt(1.0, PAPER, 0.5)))
    (label,) = package.labels([Case(osc, (0.0, 0.0), 50.0, "rational")], 1e-8)
    # By the engine.
    assert label.kind == "cycle" and label.period == pytest.approx(6.362879660, abs=1e-8)
