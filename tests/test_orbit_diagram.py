"""Orbit diagrams against the independent integrator, and zooming by the events of a mouse."""

import dataclasses
import pickle
from types import SimpleNamespace

import numpy as np
import oracle
import pytest
from compilations import compilations
from matplotlib.backend_bases import MouseEvent
from scipy.optimize import brentq
from where import nu0

import jaxbelt as jb
from jaxbelt.plotting.orbits import plot_orbits
from jaxbelt.sweeps import orbit_diagram as module

NU1 = 0.35
#: A sweep at 1e-8 is compared with an oracle at 1e-13: errors of one loop add up.
CLOSE = dict(rtol=0, atol=1e-6)


def height(osc, x1, x2):
    return x2 - 0.1 * (x1 - 0.6)


@pytest.fixture(scope="module")
def diagram():
    starts = [(3.0, 0.0), (1.362, 0.0)]
    return jb.orbit_diagram(jb.presets.class_b(0.3, NU1), nu0, (-0.5, 0.45), y0=starts, rows=3)


def test_a_diagram_of_a_parameter_can_be_pickled(diagram):
    again = pickle.loads(pickle.dumps(diagram))
    np.testing.assert_array_equal(again.values, diagram.values)
    assert repr(again) == repr(diagram)


def zeros(run, value, first, last):
    """Times at which a function of the state passes 0 upwards, and downwards."""
    ts = np.linspace(first, last, 4001)
    values = [value(*run.at(t)) for t in ts]
    for k in np.flatnonzero(np.diff(np.sign(values))):
        yield brentq(lambda t: value(*run.at(t)), ts[k], ts[k + 1], xtol=1e-12), values[k] < 0


def distinct(states):
    """States without those that are there already, in the order of x1."""
    kept = []
    for state in states:
        if all(np.max(np.abs(state - other)) > 1e-5 for other in kept):
            kept.append(state)
    return np.array(sorted(kept, key=lambda state: state[0]))


def points(found, row, start=0):
    """The points of an attractor in the order of x1."""
    both = np.stack([found.x1[row, start], found.x2[row, start]], axis=1)
    return distinct(both[~np.isnan(both[:, 0])])


@pytest.mark.slow(first=True)
def test_extrema_are_those_of_an_independent_integration(diagram):
    assert diagram.values.tolist() == pytest.approx([-0.5, -0.025, 0.45], abs=1e-15)
    assert np.all(diagram.status == jb.Status.OK)
    assert diagram.kind.tolist() == [["cycle"] * 2, ["cycle"] * 2, ["cycle", "equilibrium"]]
    for row, value in enumerate(diagram.values):
        # After the first stick phase the motion repeats exactly.
        run = oracle.simulate(oracle.class_b(value, NU1), (3.0, 0.0), 130.0)
        told = distinct(run.at(t) for t, _ in zeros(run, lambda x1, x2: x2, 60.0, 130.0))
        assert len(told) == 2
        np.testing.assert_allclose(points(diagram, row), told, **CLOSE)
        # One loop, no more: as many points as there are different ones.
        assert np.sum(~np.isnan(diagram.x1[row, 0])) == 2
    rests = jb.equilibria(jb.presets.class_b(0.45, NU1))
    assert diagram.x1[2, 1, 0] == pytest.approx(float(rests.x1[0]), abs=1e-12)
    assert diagram.x2[2, 1, 0] == 0 and np.isnan(diagram.period[2, 1])


@pytest.mark.slow(first=True)
def test_another_span_is_the_same_question_and_compiles_nothing(diagram):
    with compilations() as compiled:
        there = diagram.over((-0.2, 0.2))
        back = there.over((-0.5, 0.45))
    assert compiled == []
    np.testing.assert_array_equal(back.x1, diagram.x1)
    # A belt at rest holds the mass for ever, where it came to rest.
    assert there.values[1] == 0 and there.kind[1].tolist() == ["stuck", "stuck"]
    assert np.all(np.isfinite(there.x1[1, :, 0])) and np.all(there.x2[1, :, 0] == 0)
    # What needs longer than t = 30,000 has no points, and says so.
    slow = diagram.over((1e-7, 3e-7))
    assert np.all(slow.kind == "undecided") and np.all(slow.status == jb.Status.NOT_SETTLED)
    assert np.all(np.isnan(slow.x1)) and np.all(np.isnan(slow.period))
    table = slow.table()
    assert len(table) == 6 and set(table.kind) == {"undecided"} and table.x1.isna().all()


@pytest.mark.slow(first=True)
def test_table_has_a_row_for_each_point(diagram):
    table = diagram.table()
    assert table.columns.tolist() == ["value", "start", "kind", "period", "x1", "x2"]
    assert len(table) == np.sum(~np.isnan(diagram.x1)) == 11
    last = table[table.value == 0.45]
    assert last.kind.tolist() == ["cycle", "cycle", "equilibrium"]
    assert last.start.tolist() == [0, 0, 1] and last.period.isna().tolist() == [False, False, True]
    assert repr(diagram) == (
        "OrbitDiagram(belts[0].velocity from -0.5 to 0.45, 6 runs: 1 equilibrium, 5 cycle)"
    )


@pytest.mark.slow(first=True)
def test_a_cycle_that_does_not_come_back_is_undecided(diagram, monkeypatch):
    """Within no distance at all: what is not the same to the last bit is refused."""
    monkeypatch.setattr(module, "RUN", 0.0)
    found = diagram.over((-0.5, 0.45))
    assert np.all(found.kind[:, 0] == "undecided") and np.all(np.isnan(found.x1[:, 0]))
    assert np.all(found.status[:, 0] == jb.Status.NOT_SETTLED)
    assert found.kind[2, 1] == "equilibrium"


@pytest.mark.slow
def test_section_of_motions_with_edges():
    at = jb.AtSection(height, 1)

    def make(sigma1):
        return jb.presets.class_d(0.35, 0.2, 0.0, sigma1)

    found = jb.orbit_diagram(make, span=(0.4, 1.1), at=at, rows=4)
    assert np.all(found.kind == "cycle") and np.all(found.status == jb.Status.OK)
    for row, sigma1 in enumerate(found.values):
        run = oracle.simulate(oracle.class_d(0.35, 0.2, 0.0, sigma1), (3.0, 0.0), 200.0)
        crossings = zeros(run, lambda x1, x2: height(None, x1, x2), 150.0, 200.0)
        told = distinct(run.at(t) for t, rises in crossings if rises)
        np.testing.assert_allclose(points(found, row), told, **CLOSE)


@pytest.mark.slow
def test_a_loop_with_more_moments_than_there_is_room_for(monkeypatch):
    arguments = jb.presets.class_b(0.3, NU1), nu0, (-0.3, 0.45)
    with_room = jb.orbit_diagram(*arguments, at=jb.AtEvents(), rows=4)
    assert with_room.x1.shape[-1] == 4
    monkeypatch.setattr(module, "MOMENTS_KEPT", 4)
    monkeypatch.setattr(module, "PIECE_KEPT", 2)
    one_by_one = jb.orbit_diagram(*arguments, at=jb.AtEvents(), rows=4)
    for row in range(4):
        np.testing.assert_allclose(points(with_room, row), points(one_by_one, row), **CLOSE)
    monkeypatch.setattr(module, "MOST_RUNS", 1)
    cut = one_by_one.over((-0.3, 0.45))
    assert np.all(cut.kind == "cycle")
    assert set(cut.status.ravel().tolist()) == {jb.Status.TOO_MANY_STEPS}
    assert 1 <= np.min(np.sum(~np.isnan(cut.x1), axis=-1)) <= 3


# --- zooming: of a diagram that is made up, which computes nothing --------------------------------


class MadeUp:
    """Answers as a `Sampling` does, and remembers what it was asked."""

    senses = ()

    def __init__(self):
        self.asked = []

    def diagram(self, span):
        self.asked.append(span)
        if span[0] < 0:
            raise ValueError("load of belt 0 must be >= 0, got -1.0")
        values = np.linspace(*span, 5)
        kind = np.full((5, 1), "cycle" if span[0] else "equilibrium", "<U11")
        kind[0] = "undecided"
        x1 = np.where(kind == "undecided", np.nan, values[:, None])[..., None]
        status, at = np.zeros((5, 1), int), jb.AtExtrema("x1")
        return jb.OrbitDiagram(values, kind, 7 + 0 * x1[..., 0], status, x1, -x1, at, "nu0", self)


@pytest.fixture
def zoomed():
    sampling = MadeUp()
    ax = sampling.diagram((0.0, 1.0)).plot(zoom=True)
    sampling.asked.clear()
    return SimpleNamespace(ax=ax, asked=sampling.asked, canvas=ax.figure.canvas)


def drawn(ax):
    """The values of the parameter at which there are points."""
    return np.sort(np.concatenate([line.get_xdata() for line in ax.lines]))


def mouse(zoomed, name):
    event = MouseEvent(f"button_{name}_event", zoomed.canvas, 100, 100, button=1)
    zoomed.canvas.callbacks.process(event.name, event)


def test_new_limits_are_computed_once(zoomed):
    zoomed.ax.set_xlim(0.25, 0.75)
    assert zoomed.asked == [(0.25, 0.75)] and zoomed.ax.get_xlim() == (0.25, 0.75)
    np.testing.assert_array_equal(drawn(zoomed.ax), np.linspace(0.25, 0.75, 5))
    # The heights follow, and the key.
    low, high = zoomed.ax.get_ylim()
    assert 0.3 < low < 0.375 and 0.75 < high < 0.8
    assert sorted(zoomed.ax.get_legend_handles_labels()[1]) == ["cycle", "undecided"]
    zoomed.ax.set_ylim(0.4, 0.5)
    zoomed.ax.set_xlim(0.25, 0.75)
    assert len(zoomed.asked) == 1
    # Heights that were chosen stay.
    zoomed.ax.set_xlim(0.7, 0.3)
    assert zoomed.asked[1:] == [(0.3, 0.7)] and zoomed.ax.get_ylim() == (0.4, 0.5)
    zoomed.canvas.draw()
    assert len(zoomed.asked) == 2


def test_a_zoom_in_si():
    """Of a machine whose unit of length is 0.25 m, and of velocity 0.5 m/s."""
    machine = jb.Machine(1.0, 4.0, 0.1, [jb.PhysicalBelt(0.1, jb.Coulomb(0.4, 0.3), 1.0)])
    sampling = MadeUp()
    sampling.variation = SimpleNamespace(oscillator=lambda _: machine.oscillator)
    diagram = dataclasses.replace(sampling.diagram((0.0, 1.0)), name="belts[0].velocity")
    ax = jb.plot_in_si(diagram, machine, zoom=True)
    assert sampling.asked == [(0.0, 1.0)] and ax.get_xlim() == (0.0, 0.5)
    ax.set_xlim(0.125, 0.375)
    assert sampling.asked[1:] == [(0.25, 0.75)]
    np.testing.assert_allclose(drawn(ax), np.linspace(0.125, 0.375, 5), rtol=1e-14)
    (cycle,) = (line for line in ax.lines if line.get_label() == "cycle")
    np.testing.assert_allclose(cycle.get_ydata(), 0.5 * cycle.get_xdata(), rtol=1e-14)


def test_nothing_is_computed_while_a_button_is_held(zoomed):
    mouse(zoomed, "press")
    for left in (0.1, 0.2, 0.3):
        zoomed.ax.set_xlim(left, 1.0)
    assert zoomed.asked == []
    mouse(zoomed, "release")
    assert zoomed.asked == [(0.3, 1.0)]
    # A click that changes nothing.
    mouse(zoomed, "press")
    mouse(zoomed, "release")
    assert len(zoomed.asked) == 1


def test_limits_that_cannot_be_are_told_and_the_points_stay(zoomed):
    before = drawn(zoomed.ax)
    zoomed.ax.set_xlim(-1.0, 1.0)
    np.testing.assert_array_equal(drawn(zoomed.ax), before)
    (told,) = (text for text in zoomed.ax.texts if text.get_text())
    assert told.get_text() == "load of belt 0 must be >= 0, got -1.0"
    zoomed.ax.set_xlim(0.5, 1.0)
    assert not told.get_text() and drawn(zoomed.ax)[0] == 0.5


def test_without_zoom_new_limits_are_a_window():
    sampling = MadeUp()
    diagram = sampling.diagram((0.0, 1.0))
    ax = plot_orbits(diagram, quantity="x2")
    assert ax.get_ylabel() == "velocity $x_2$" and ax.get_xlabel() == r"belt velocity $\nu_0$"
    ax.set_xlim(0.25, 0.75)
    assert len(sampling.asked) == 1 and drawn(ax)[0] == 0.0


def test_an_impossible_quantity():
    with pytest.raises(ValueError, match='quantity must be "x1" or "x2", got \'x3\''):
        MadeUp().diagram((0.0, 1.0)).plot(quantity="x3")


@pytest.mark.slow(first=True)
def test_a_parameter_that_rises_and_falls_keeps_its_attractor():
    """From -0.55 to the Hopf point at -0.26365 an equilibrium and a cycle coexist."""
    osc = jb.presets.class_b(0.3, NU1)
    both = jb.orbit_diagram(osc, nu0, (-0.6, -0.2), rows=9, y0=(0.0, 0.0), sense="both")
    up, down = both.kind.T
    assert up.tolist() == ["equilibrium"] * 7 + ["cycle"] * 2
    assert down.tolist() == ["equilibrium"] + ["cycle"] * 8
    # What is found is what a start on it leads to.
    alone = jb.orbit_diagram(osc, nu0, (-0.5, -0.3), rows=2, y0=(float(both.x1[2, 1].max()), 0.0))
    assert alone.period[:, 0] == pytest.approx(both.period[[2, 6], 1], rel=1e-6)
    for sense, start in (("up", 0), ("down", 1)):
        one = jb.orbit_diagram(osc, nu0, (-0.6, -0.2), rows=9, y0=(0.0, 0.0), sense=sense)
        assert np.array_equal(one.kind[:, 0], both.kind[:, start])
        assert np.array_equal(one.period[:, 0], both.period[:, start], equal_nan=True)
    labels = [line.get_label() for line in both.plot().lines]
    assert "cycle, parameter falling" in labels


@pytest.mark.slow
def test_runs_go_on_where_others_have_come_to_whatever_the_phase_and_the_first_force():
    """Chaos is followed while the frequency falls, also below 1.683, where the motion that sticks
    is while it rises."""

    def forced(*ratios):
        def make(frequency):
            law = jb.Cubic(1.5, 1.5, 0.45)
            forcing = tuple(jb.Harmonic(0.1 * (one == 1), one * frequency) for one in ratios)
            return jb.Oscillator(0.0, (jb.Belt(1.0, law),), forcing=forcing)

        return make

    def periodic_rows(make, phase):
        options = dict(span=(1.675, 1.695), rows=11, y0=(0.5, 0.0), sense="both")
        found = jb.orbit_diagram(make, at=jb.AtPhase(phase), **options)
        return np.sum(np.isfinite(found.period), axis=0).tolist()

    rising, falling = periodic_rows(forced(1), 0.0)
    assert falling < rising
    for ratios, phase in (((1,), 1.5), ((1,), -1.0), ((1, 2), 0.0), ((2, 1), 0.0), ((0.5, 1), 0.0)):
        assert periodic_rows(forced(*ratios), phase) == [rising, falling]


@pytest.mark.slow
@pytest.mark.parametrize("frequency", [0.7, 1.4])
def test_a_diagram_comes_to_its_end_where_runs_end_on_a_moment(frequency):
    """A moment at the end of a run was due in the condition of a loop and not in its body."""
    belts = (jb.Belt(0.2, jb.Conti(1.0, 0.6, 10.0)),)
    osc = jb.Oscillator(0.5, belts, forcing=jb.Harmonic(0.4, frequency))
    options = dict(y0=(1.0, 0.0), sense="up", rows=2)
    found = jb.orbit_diagram(osc, lambda osc: osc.forcing[0].amplitude, (0.8, 0.9), **options)
    assert set(found.status.ravel().tolist()) == {jb.Status.OK}


@pytest.mark.slow(first=True)
def test_a_mass_that_a_belt_at_rest_holds_has_no_period():
    """A force below friction moves nothing: the mass stays where it is, while the force falls,
    too."""

    def make(force):
        return jb.presets.den_hartog(0.5, force)

    options = dict(span=(0.0, 0.6), rows=7)
    found = jb.orbit_diagram(make, y0=[(0.1, 0.0), (-0.05, 0.0)], **options)
    moves = found.values > 0.45
    assert np.all(found.kind[moves] == "cycle") and np.all(found.kind[:4] == "stuck")
    assert np.all(found.status[:4] == jb.Status.STUCK_FOREVER)
    # |force cos| + |x1| < 0.4 up to a force of 0.2.
    np.testing.assert_array_equal(found.x1[:3, :, 0], [[0.1, -0.05]] * 3)
    assert np.all(found.x2[:4, :, 0] == 0) and np.all(np.isnan(found.period[:4]))
    assert np.all(np.sum(np.isfinite(found.x1[:4]), axis=-1) == 1)
    table = found.table()
    held = table[table.kind == "stuck"]
    assert len(held) == np.sum(found.kind == "stuck") and held.period.isna().all()
    assert "stuck for ever" in found.plot().get_legend_handles_labels()[1]
    swept = jb.sweep(make, {"force": found.values[:3]}, y0=(0.1, 0.0), observe="attractor")
    assert np.all(jb.decoded(swept).kind == "stuck")

    both = jb.orbit_diagram(make, y0=(0.1, 0.0), sense="both", **options)
    up, down = both.kind[both.values < 0.35].T
    assert set(up) == set(down) == {"stuck"}
    np.testing.assert_array_equal(both.x1[:3, 0, 0], 0.1)
    # What held it at 0.3 holds it at smaller forces, at the same place.
    assert len(np.unique(both.x1[:4, 1, 0])) == 1


@pytest.mark.slow(first=True)
def test_a_forced_mass_at_rest_on_an_edge_is_an_equilibrium():
    """On the left friction pushes to the edge, on the right the spring does, at all times."""

    def make(force):
        belt = jb.Belt(1.0, jb.Coulomb(1.0, 1.0), upper=0.5)
        return jb.Oscillator(0.3, (belt,), forcing=jb.Harmonic(force, 0.7))

    found = jb.orbit_diagram(make, span=(0.1, 0.4), y0=(1.0, 0.3), rows=3, sense="both")
    assert np.all(found.kind == "equilibrium") and np.all(np.isnan(found.period))
    assert np.all(found.status == jb.Status.PSEUDO_FOCUS)
    assert np.all(found.x1[..., 0] == 0.5) and np.all(np.isnan(found.x1[..., 1:]))
    assert len(found.table()) == 6 and np.all(found.table().x2 == 0)


def two_forces(f2, phase=0.0, order=1):
    """A mass that never comes to the belt's velocity: linear, pushed by friction of 0.5, too."""
    forcing = (jb.Harmonic(1.0, 1.0), jb.Harmonic(0.5, f2, phase))[::order]
    return jb.Oscillator(0.2, (jb.Belt(10.0, jb.Coulomb(0.5, 0.5)),), forcing=forcing)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("phase", [0.0, np.pi])
def test_forces_that_beat_slowly_have_no_cycle(phase):
    """At the frequencies 1 and 1 + 1e-8 the strobes of the first force look alike, but the motion
    beats between the amplitudes 7.5 and 2.5."""
    found = jb.orbit_diagram(
        lambda f2: two_forces(f2, phase), span=(1 + 1e-8, 1.5), y0=(0.0, 0.0), rows=2
    )
    assert found.kind[:, 0].tolist() == ["no period found", "cycle"]
    assert np.isnan(found.period[0, 0]) and found.period[1, 0] == pytest.approx(4 * np.pi)


def test_a_force_without_amplitude_has_no_say():
    """Its frequency has no period in common with the other one's."""

    def make(amplitude):
        forcing = jb.Harmonic(1.0, 1.0), jb.Harmonic(amplitude, np.sqrt(2))
        return jb.Oscillator(0.2, (jb.Belt(10.0, jb.Coulomb(0.5, 0.5)),), forcing=forcing)

    found = module.varied(make, None, (0.0,), forced=True)
    sampling = module.Sampling(found, jb.AtPhase(), np.zeros((1, 2)), 2, {})
    period, turns = sampling._clocks(np.array([0.0, 0.1]))
    assert period.tolist() == [2 * np.pi] * 2 and turns.tolist() == [1, 0]


def test_what_seems_to_repeat_before_the_forces_do_is_not_taken_for_a_period():
    still = np.ones((5, 64))
    turns = module._turns_in(still, still, np.array([1, 2, 3, 33, 0]))
    assert turns.tolist() == [1, 2, 3, 0, 0]


class Seen(Exception):
    """The end of a run that is not to be done."""


def test_a_slow_second_force_makes_no_longer_runs(monkeypatch):
    """They are 1,000 periods and 64 points long, of the first force."""

    def results(grid, observer, states, which, t1, **numbers):
        raise Seen(t1)

    monkeypatch.setattr(module.Grid, "results", results)
    for sense, periods in ((None, 1064), ("both", 564)):
        options = dict(span=(1e-8, 1.0), y0=(0.0, 0.0), rows=2, sense=sense)
        with pytest.raises(Seen) as caught:
            jb.orbit_diagram(two_forces, **options)
        assert 2 * np.pi * (periods - 1) < caught.value.args[0] < 2 * np.pi * periods


def test_runs_that_end_apart_are_not_prolonged(monkeypatch):
    """Each takes twice as long as it needs to, at most, and all are done."""

    def results(grid, observer, states, which, t1, **numbers):
        return {"row": which, "t1": np.full(len(which), t1)}

    monkeypatch.setattr(module.Grid, "results", results)
    variation = module.varied(two_forces, None, (1.0,), forced=True)
    sampling = module.Sampling(variation, None, np.zeros((1, 2)), 5, {})
    grid = module.Grid(two_forces, {"f2": np.ones(5)}, (0.0, 0.0))
    ends = np.array([10.0, 11.0, 100.0, 5000.0, 5010.0])
    for begin in (np.zeros(5), np.array([0.0, 0.0, 50.0, 4990.0, 5000.0])):
        states = np.stack([np.zeros(5), np.zeros(5), begin])
        found = sampling._results(grid, None, states, ends, np.arange(5))
        assert found["row"].tolist() == [0, 1, 2, 3, 4]
        assert np.all(found["t1"] >= ends)
        assert np.all(found["t1"] - begin <= 2 * (ends - begin))


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, -1])
def test_a_force_of_frequency_0_beside_another_is_a_constant_one(order):
    """x1 = 1 +- 5; at a frequency of 1 of both forces 0.5 +- 7.5."""

    def make(f2):
        return two_forces(f2, order=order)

    found = jb.orbit_diagram(make, span=(0.0, 1.0), y0=(0.0, 0.0), rows=2)
    assert np.all(found.kind == "cycle") and np.all(found.status == jb.Status.OK)
    np.testing.assert_allclose(found.period, 2 * np.pi, rtol=1e-14)
    # The force is largest at the strobe, and the mass is a quarter of a period behind it.
    np.testing.assert_allclose(found.x1[:, 0, 0], [1.0, 0.5], atol=1e-7)
    np.testing.assert_allclose(found.x2[:, 0, 0], [5.0, 7.5], atol=1e-7)
    assert np.all(np.isnan(found.x1[..., 1:]))


def test_a_span_without_a_clock_at_an_end():
    def make(f):
        forcing = jb.Harmonic(1.0, f), jb.Harmonic(0.5, 2 * f)
        return jb.Oscillator(0.2, (jb.Belt(10.0, jb.Coulomb(0.5, 0.5)),), forcing=forcing)

    for span in ((0.0, 1.0), (1.0, 0.0)):
        with pytest.raises(ValueError, match="span must be"):
            jb.orbit_diagram(make, span=span, rows=2)
