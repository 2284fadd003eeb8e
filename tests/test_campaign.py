"""The independent engine against closed forms and SciPy, and small campaigns on it.

The whole campaigns are `python -m tests.campaign`; what they found is in docs/checked.md.
"""

import importlib
import os
import signal
from collections import Counter
from dataclasses import replace
from math import acos, atan, inf, pi, sqrt

import numpy as np
import oracle
import pytest

import jaxbelt as jb
from jaxbelt.cycles.attractors import idle_belts, itinerary
from tests.campaign import __main__ as command
from tests.campaign import cases, compare, derivatives, engine, package, paths
from tests.campaign.engine import CROSS, EDGE, SLIP, STICK, Belt, Oscillator
from tests.campaign.outcome import Outcome, part

# The tools of the campaigns; their engine is compiled for half a minute.
pytestmark = pytest.mark.slow(first=True)

#: The engine integrates at 1e-13, with events of order-one normal speed in these tests.
EXACT = dict(rel=0, abs=1e-11)
KINDS = {"STICK": STICK, "SLIP": SLIP, "CROSS": CROSS, "EDGE": EDGE}


def coulomb(velocity, static=1.0, kinetic=1.0, **options):
    return Belt(velocity, ("coulomb", static, kinetic), **options)


def check(run, expected):
    """Events (t, kind, belt, x1, x2) one by one."""
    assert run.sequence == tuple(row[1:3] for row in expected)
    for t, y, (t_expected, _, _, *y_expected) in zip(run.t, run.y, expected):
        assert (t, *y) == pytest.approx((t_expected, *y_expected), **EXACT)


def to_oracle(osc):
    laws = dict(conti=oracle.conti, coulomb=oracle.coulomb, stribeck=oracle.stribeck)
    belts = []
    for b in osc.belts:
        mu, static = laws[b.law[0]](*b.law[1:])
        belts.append(oracle.Belt(b.velocity, mu, static, b.load, b.lower, b.upper))
    return oracle.Oscillator(osc.damping, tuple(belts), osc.omega)


# ---------------------------------------------------------------- the engine: closed forms


@pytest.mark.parametrize("v", [0.1, -0.4])
def test_stick_slip_is_a_circle_and_a_straight_line(v):
    # Onset at x1 = mus, a circle around mud, back at x2 = v a distance d = mus - mud before it.
    mus, mud = 1.0, 0.6
    d, side = mus - mud, np.sign(v)
    slip, stick = 2 * pi - 2 * atan(d / abs(v)), 2 * d / abs(v)
    osc = Oscillator(0.0, (coulomb(v, mus, mud),))
    run = engine.simulate(osc, (side * (mus - d / 2), v), 3 * (slip + stick))
    times = [stick / 4 + i * (slip + stick) for i in range(3)]
    onset, arrival = (side * mus, v), (side * (mud - d), v)
    check(run, [e for t in times for e in ((t, SLIP, 0, *onset), (t + slip, STICK, 0, *arrival))])
    found = engine.attractor(osc, (side * (mus - d / 2), v))
    assert found.kind == "cycle" and found.loop == ((STICK, 0), (SLIP, 0))
    assert found.period == pytest.approx(slip + stick, **EXACT)
    assert found.sticks == pytest.approx((stick,), **EXACT)
    assert max(map(abs, found.x1)) == pytest.approx(mud + sqrt(d * d + v * v), **EXACT)


def test_a_crossing_is_a_change_of_circles():
    # Around +0.5 while x2 < 0.2, around -0.5 above; at x2 = 0.2 nothing can hold the mass.
    osc = Oscillator(0.0, (coulomb(0.2, 0.5, 0.5),))
    run = engine.simulate(osc, (-3.0, -0.3), 2.0)
    radius = sqrt(3.5**2 + 0.3**2)
    x1 = 0.5 - sqrt(radius**2 - 0.2**2)
    angle = atan(0.3 / 3.5) + atan(0.2 / (0.5 - x1))
    check(run, [(angle, CROSS, 0, x1, 0.2)])
    out = sqrt((x1 + 0.5) ** 2 + 0.2**2)
    left = 2.0 - angle + acos((-x1 - 0.5) / out)
    assert run.y_end[0] == pytest.approx(-0.5 - out * np.cos(left), **EXACT)


def test_a_passage_of_an_edge():
    # A circle around 0.6 on the left of 0.3, around 0 on its right.
    osc = Oscillator(0.0, (coulomb(5.0, 0.6, 0.6, upper=0.3),))
    run = engine.simulate(osc, (-1.0, 0.0), 2.0)
    speed = sqrt(1.6**2 - 0.3**2)
    passed = acos(0.3 / 1.6)
    check(run, [(passed, EDGE, 0, 0.3, speed)])
    t = 2.0 - passed
    assert run.y_end[0] == pytest.approx(0.3 * np.cos(t) + speed * np.sin(t), **EXACT)


@pytest.mark.parametrize("side", [1, -1])
def test_slip_onset_on_an_edge_is_none(side):
    # At 0.5 the belt can just hold the mass, and beyond the edge nothing pulls at it any more.
    edge = {"upper": 0.5} if side > 0 else {"lower": -0.5}
    belts = coulomb(0.5 * side, 1.0, 0.5), coulomb(-0.5 * side, 1.0, 0.5, **edge)
    run = engine.simulate(Oscillator(0.0, belts), (0.4 * side, 0.5 * side), 2.0)
    check(run, [(0.2, EDGE, 1, 0.5 * side, 0.5 * side), (1.2, SLIP, 0, side, 0.5 * side)])


def test_rest_is_recognised():
    law = ("conti", 1.0, 0.6, 10.0)
    at_rest = Oscillator(0.5, (Belt(0.0, law),))
    assert engine.simulate(at_rest, (3.0, 0.0), 50.0).status == engine.STUCK_FOREVER
    focus = Oscillator(0.1, (coulomb(5.0, upper=0.5), coulomb(-5.0, lower=0.5)))
    run = engine.simulate(focus, (1.0, 0.0), 200.0)
    assert run.status == engine.PSEUDO_FOCUS and run.y_end == (0.5, 0.0)
    assert engine.attractor(focus, (1.0, 0.0)).kind == "equilibrium"


@pytest.mark.parametrize("make", [cases.random_case, cases.rational_case])
def test_runs_like_scipy(make):
    rng = np.random.default_rng(20)
    compared = 0
    for structure in cases.structures(rng, 14):
        case = make(rng, structure, 12.0)
        run = compare.run(case)
        other = oracle.simulate(to_oracle(case.oscillator), case.y0, case.T, max_events=1000)
        # In a corner rounding decides; a focus is told sooner or later.
        if other.status != "ok" or min(run.margin, other.margin) < 1e-9:
            continue
        compared += 1
        assert run.sequence == tuple((KINDS[kind], belt) for kind, belt in other.sequence)
        # 1e-9: a few orbits here expand errors of 1e-13 by a thousand and more.
        np.testing.assert_allclose(run.y_end, other.y_end, rtol=0, atol=1e-9)
    assert compared >= 6


def test_grazing_is_resolved_to_rounding():
    rng = np.random.default_rng(5)
    structures = cases.structures(rng, 9)
    for i in range(60):
        # Made only where the engine sees the distance, missed or gone beyond.
        case = cases.grazing_case(rng, structures[i % 9], 1e-12)
        run = compare.run(case)
        if case.distance > 0:
            # Built backwards from there: the way there and back rounds to some 1e-15.
            assert run.margin == pytest.approx(case.distance, rel=0.05, abs=2e-15)
        else:
            assert len(run.kind) > 0


def test_errors_come_from_disturbances():
    case = cases.Case(Oscillator(0.5, (Belt(0.2, cases.PAPER),)), (3.0, 0.0), 4.0)
    one, other = compare.run(case), compare.run(case, noise=1e-8, seed=1)
    far = np.max(np.abs(np.subtract(one.y_end, other.y_end)))
    assert one.sequence == other.sequence and 1e-10 < far < 1e-6


def test_cases_go_to_json_and_back():
    rng = np.random.default_rng(0)
    for structure in cases.structures(rng, 14):
        case = cases.rational_case(rng, structure)
        assert cases.from_json(case.to_json()) == case
        osc = package.oscillator(case.oscillator)
        assert len(osc.belts) == len(case.oscillator.belts)
        assert all(b.lower < b.upper and -inf < b.velocity < inf for b in case.oscillator.belts)


def told_by(run, **changes):
    """The engine's own run as if the package had told it, with something changed."""
    events = tuple(zip(run.t.tolist(), run.kind.tolist(), run.belt.tolist(), *run.y.T.tolist()))
    right = package.Final(*run.y_end, run.mode_end, len(run.kind), run.status, events)
    return replace(right, **changes)


def test_what_is_wrong_is_found():
    osc = Oscillator(0.5, (Belt(0.45, cases.PAPER), Belt(0.35, cases.PAPER)))
    case = cases.Case(osc, (3.0, 0.0), 30.0)
    run = compare.run(case)
    swapped = tuple((t, kind, 1 - belt, *y) for t, kind, belt, *y in told_by(run).events)
    wrong = {
        "same": {},
        "state": dict(x1=run.y_end[0] + 1e-5),
        "more events": dict(n_events=len(run.kind) + 1),
        "mode": dict(mode=(-1, -1)),
        "sequence": dict(events=swapped),
        "status 4, not 0": dict(status=4),
        "focus that is none": dict(status=engine.PSEUDO_FOCUS),
    }
    for verdict, changes in wrong.items():
        assert compare.judge(case, told_by(run, **changes), 1e-8)[0] == verdict
    label = engine.attractor(osc, case.y0)
    told = package.Label(*(getattr(label, f) for f in package.Label.__dataclass_fields__))
    assert compare.label_difference(told, label) is None
    for changes in (dict(kind="equilibrium"), dict(loop=()), dict(x1=(0.0, 1.0)), dict(period=3.0)):
        assert compare.label_difference(replace(told, **changes), label)


def test_a_corner_has_the_answers_of_its_neighbours():
    # At slip onset on an edge: beyond it, before it, or at once; but not stuck for ever.
    law = ("conti", 1.0, 0.6, 10.0)
    belts = (Belt(0.4, law, upper=0.9), Belt(-0.55, law, lower=0.9))
    case = cases.Case(Oscillator(0.25, belts), (3.0, 0.0), 20.0)
    run = compare.run(case)
    assert run.margin < compare.CORNER
    before = compare.run(next(compare.neighbours(case, by=-1e-7)))
    assert compare.judge(case, told_by(before), 1e-8)[0] in compare.GOOD
    stuck = told_by(run, x1=0.9, x2=0.4, status=engine.OK)
    assert compare.judge(case, stuck, 1e-8)[0].startswith("corner: ")


@pytest.mark.parametrize("velocity", [0.4, 0.41, 0.5])
def test_a_mode_that_does_not_last_is_none(velocity):
    """Slip onset, needed = capacity at x1 = 0.3 + 0.1 * 0.175 - 2 * 0.5, lies on the edge."""
    left = coulomb(velocity, 0.5, 0.3, upper=-0.25)
    right = coulomb(-0.35, 0.5, 0.3, load=2.0, lower=-0.6825)
    osc = Oscillator(0.1, (left, right), omega=2.0)
    (cycle,) = paths.label_of(osc, [(3.0, 0.0)]).cycles
    found = jb.find_cycle(package.oscillator(osc), (3.0, 0.0))
    assert cycle.modes == itinerary(idle_belts(found.oscillator), found)
    assert cycle.modes == ((0, -1), (2, -1), (2, 0), (1, 0), (1, -2), (1, -1))


def test_derivatives_are_those_of_differences():
    rng = np.random.default_rng(3)
    for structure in cases.structures(rng, 9):
        case = cases.random_case(rng, structure, 8.0)
        run = compare.run(case)
        if run.status or run.margin < 1e-2:
            continue
        along = derivatives.directions(case, rng)

        def end(h, case=case, along=along):
            y0 = np.add(case.y0, h * np.array(along[0]))
            osc = derivatives.moved(case.oscillator, along, h)
            return np.array(engine.simulate(osc, y0, case.T).y_end)

        expected, error = oracle.richardson(end, 0.0, 1e-5, levels=2)
        found = derivatives.derivative(case, run, along)
        # Differences of 1e-13 over 1e-5, beside what Richardson says of the rest.
        assert np.all(np.abs(found - expected) <= 1e-6 * (1 + np.abs(expected)) + error)


def test_rows_take_the_place_of_those_of_the_same_campaign(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("text\n| x | random | 3 | 1e-08 | 0 | 0 | 7 |\n<!-- campaigns -->\n")
    command.put_rows(page, ["| x | random | 9 | 1e-08 | 0 | 0 | 0 |"])
    assert page.read_text() == "text\n| x | random | 9 | 1e-08 | 0 | 0 | 0 |\n<!-- campaigns -->\n"


class Stub:
    """A campaign of five cases; of the third something is wrong, the fourth raises."""

    def __init__(self, stops_at=None, swallows=False):
        self.stops_at, self.swallows, self.asked = stops_at, swallows, []

    def settings(self, options):
        return {"runs": options.runs}

    def numbers(self, options):
        return range(5)

    def outcome(self, options, number):
        if number == self.stops_at:
            try:
                os.kill(os.getpid(), signal.SIGTERM)
            except KeyboardInterrupt as error:
                # As the engine's compiled code does.
                raise (SystemError("an exception set") if self.swallows else error) from error
        self.asked.append(number)
        if number == 3:
            raise ValueError("no such belt")
        one = Outcome(f"the case {number}", ["not parted"] if number == 2 else [])
        one.counts["sum"] += number
        one.largest["error"] = float(number)
        return one

    def said(self, counts, largest):
        return [f"sum {counts['sum']}, error {largest.get('error')}"]


def campaign_of(monkeypatch, stub):
    monkeypatch.setattr(command.importlib, "import_module", lambda *_: stub)
    monkeypatch.setattr(command, "_commit", lambda: f"by {id(stub)}")
    return stub


@pytest.mark.parametrize("swallows", [False, True])
def test_a_campaign_that_is_stopped_goes_on(swallows, monkeypatch, tmp_path, capsys):
    call = ["final", "--runs", "9", "--results", str(tmp_path / "results")]
    first = campaign_of(monkeypatch, Stub(2, swallows))
    assert command.main(call) == 1 and first.asked == [0, 1]
    said = capsys.readouterr().out
    assert "stopped" in said and "sum 1, error 1.0" in said and "2 of 5 cases, 0 wrong" in said
    # Killed while it wrote the next one.
    with open(tmp_path / "results", "a") as file:
        file.write('{"number": 2, "com')
    second = campaign_of(monkeypatch, Stub())
    assert command.main(call) == 1 and second.asked == [2, 3, 4]
    said = capsys.readouterr().out
    assert "not parted" in said and "ValueError: no such belt" in said
    assert "sum 7, error 4.0" in said and "5 of 5 cases, 2 wrong" in said
    assert f"by {id(first)}" in said and f"by {id(second)}" in said
    with pytest.raises(SystemExit, match="of another campaign"):
        command.main([*call, "--seed", "1"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("grazing --regime many", "--regime: grazing does not know it"),
        ("final --by sweep", "--by: final does not know it"),
        ("maps --seed 3", "--seed: maps does not know it"),
        ("paths --threads 2", "--threads: paths does not know it"),
        ("grazing --extreme-share 0.1", "--extreme-share: grazing does not know it"),
        ("grazing --heavy", "--heavy: grazing does not know it"),
        ("grazing --by find_cycle --structure 0", "cycles that graze have none"),
        ("final --structure 9", "expected 0 to 8, got 9"),
        ("final --runs 0", "expected 1 or more, got 0"),
        ("final --extreme-share 0.7", "expected 0 to 0.5, got 0.7"),
        ("final --tol 0", "expected a positive number, got 0.0"),
    ],
)
def test_what_a_campaign_does_not_know_is_refused(arguments, message, capsys):
    with pytest.raises(SystemExit) as refused:
        command.main(arguments.split())
    assert refused.value.code == 2 and message in capsys.readouterr().err


def test_what_each_campaign_knows():
    assert command.KNOWN.keys() == command.CAMPAIGNS.keys()


@pytest.mark.parametrize("module", sorted(set(command.CAMPAIGNS.values())))
def test_nothing_done_is_summed_up(module):
    campaign = importlib.import_module(f"tests.campaign.{module}")
    assert all(isinstance(line, str) for line in part(campaign, "said")(Counter(), {}))


# ---------------------------------------------------------------- small campaigns


@pytest.mark.parametrize(
    "arguments",
    [
        pytest.param(
            "final --runs 300 --structure 0 --seed 11", marks=pytest.mark.slow(first=True)
        ),
        pytest.param("attractors --runs 100 --structure 0 --seed 12", marks=pytest.mark.slow),
        pytest.param("final --heavy --runs 300 --structure 0 --seed 13", marks=pytest.mark.slow),
    ],
)
def test_small_campaign(arguments, capsys):
    wrong = command.main(arguments.split())
    assert wrong == 0, capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        "final --runs 20000 --seed 21",
        "attractors --runs 5000 --seed 22",
        "simulate --runs 2000 --seed 23",
        "derivatives --by sweep --runs 500 --tol 1e-11 --seed 26",
        "grazing --runs 1000 --tol 1e-13 --seed 24",
        "grazing --runs 1000 --seed 25",
        "paths --runs 14 --seed 3",
    ],
)
def test_campaign(arguments, capsys):
    wrong = command.main(arguments.split())
    assert wrong == 0, capsys.readouterr().out


@pytest.mark.slow
def test_derivatives_of_an_edge_that_is_barely_passed():
    """Found by a campaign: beyond by 1.2e-10, so that x1 is on the edge to rounding at both ends,
    and the sweep lost the derivatives of one passage."""
    laws = (
        ("conti", 1.020586219515656, 0.3964259333796029, 7.49304765013548, 0.2542711091782788),
        ("conti", 0.5401517146606191, 0.34166043817551817, 11.217674230517941, 0.0),
        ("conti", 0.5847799015530727, 0.3457138888107467, 1.0411984665091287, 0.0),
    )
    upper, lower = -0.3073823557564196, -0.5309339032867204
    belts = (
        Belt(-1.0802115851973795, laws[0], 1.2580428931955348, upper=upper),
        Belt(-0.043782329051282876, laws[2], 0.0, lower=lower),
        Belt(-1.0009542901629669, laws[1], 1.3075515641175743, lower=lower, upper=upper),
    )
    case = cases.Case(
        Oscillator(0.5540927456151249, belts), (-1.138081268179836, 1.1912261823560164), 4.0, "edge"
    )
    mine = compare.run(case, tol=1e-15)
    assert [event[0] for event in mine.sequence] == [EDGE, EDGE]
    assert mine.t[1] - mine.t[0] < 1e-4
    along = (0.91, 0.34, 0.0, -0.78), (-0.69, 0.0, 0.62, 0.0), (-0.01, 0.53, 0.62, -0.78)
    direction = (-0.77, 0.71), 0.2, along
    right = derivatives.derivative(case, mine, direction)
    assert np.max(np.abs(right)) > 1e3
    for by in ("simulate", "sweep"):
        (told,) = package.derivatives([case], [direction], 1e-13, by)
        np.testing.assert_allclose(told, right, rtol=1e-3)
