"""Every public result has a table, a DataFrame, and a picture that can be saved."""

import dataclasses
import inspect
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from where import nu0

import jaxbelt as jb
from jaxbelt.commands.map import cells_along, write_cells
from jaxbelt.cycles.chains import Loop
from jaxbelt.cycles.clocked import TimedChain
from jaxbelt.motion.arcs import Ends
from jaxbelt.numerics.continuation import Stop
from jaxbelt.numerics.spacing import evenly_spaced
from jaxbelt.plotting.categories import COLOURS, _colour_of_kind
from jaxbelt.plotting.draw import draw_result
from jaxbelt.plotting.style import parameter_label

#: Public classes that are no results: what a user writes down.
NO_RESULTS = {
    *(jb.AbstractFriction, jb.Conti, jb.Coulomb, jb.Stribeck, jb.Tabulated),
    *(jb.Cubic, jb.AbstractForce, jb.Harmonic, jb.BaseMotion, jb.Oscillating),
    *(jb.Belt, jb.Oscillator),
    *(jb.Machine, jb.PhysicalBelt, jb.Units),
    *(jb.AtEvents, jb.AtExtrema, jb.AtPhase, jb.AtSection, jb.AtTimes),
    *(jb.EquilibriumKind, jb.EventKind, jb.Status),
    *(jb.BeltAtRest, jb.BoundaryEquilibrium, jb.CornerCollision, jb.CrossingSliding),
    *(jb.EdgeExchange, jb.FoldOfCycles, jb.GrazingEdge, jb.GrazingSliding, jb.Hopf),
    jb.HopfAtInfinity,
    *(jb.MeetingEdges, jb.NonsmoothFold, jb.PseudoHopf, jb.SaddleConnection),
    *(jb.SlidingExchange, jb.SuddenSliding),
    *(jb.AddingSliding, jb.Fold, jb.PeriodDoubling, jb.SwitchingSliding, jb.Torus),
    jb.SymmetryBreaking,
}
PUBLIC = [getattr(jb, name) for name in jb.__all__]
RESULTS = [one for one in PUBLIC if inspect.isclass(one) and one not in NO_RESULTS]


def forced_motion() -> jb.PeriodicMotion:
    """A motion of one arc, made up."""
    osc = jb.Oscillator(0.1, (jb.Belt(1.0, jb.Coulomb(0.1, 0.1)),), forcing=jb.Harmonic(0.1, 1.0))
    ends = jnp.array([Ends(1).period])
    chain = TimedChain(jnp.ones((1, 1)), ends, jnp.full((1, 8), 1 / 8), turns=1)
    z, zero = jnp.array([[0.5, 0.0, 0.0, 2 * np.pi]]), jnp.zeros((), int)
    return jb.PeriodicMotion(osc, chain, z, jnp.zeros(2, complex), jnp.zeros(()), zero, zero)


@pytest.fixture(scope="module")
def results() -> dict[type, Any]:
    """One of each; numbers that no test is about are made up, which compiles nothing."""
    osc, span = jb.presets.class_b(0.45, 0.35), np.linspace(0.0, 1.0, 5)
    # Room for as many arcs as in tests/test_simulate.py, for one program.
    run = jb.simulate(osc, (3.0, 0.0), 20.0, max_segments=4096)
    cycle, inner = jb.find_cycle(osc, (3.0, 0.0)), jb.unstable_cycle(osc)
    point, rests = jb.refine(jb.NonsmoothFold(belt=1), osc, where=nu0), jb.equilibria(osc)
    ts, ys = jnp.asarray(span), jnp.asarray(np.column_stack([np.cos(span), np.sin(span)]))
    arcs = Loop(*(jnp.zeros(shape) for shape in ((1, 2), 1, (1, 2), 1)))
    separatrix = jb.Separatrix(ys[-1], "left", True, ts, ys, "outside", -1, arcs)
    special, none = jb.SpecialPoint("DoubleSliding", (0,), (0.49, 0.5), 1e-12), jnp.zeros((0, 2))
    rows = np.column_stack([span, span**2])
    curve = jb.BifurcationCurve(
        *(jb.NonsmoothFold(1), rows, (jb.NonsmoothFold,) * 5, span, span, np.ones((5, 5))),
        *((special,), (Stop.LEFT_SPAN, Stop.LEFT_SPAN), ("nu0", "nu1")),
    )
    label = np.array([["1", "2b"], ["2b", "2b"]])
    axes = {"x1": [1.0, 2.0], "x2": [-0.5, 0.5]}
    dataset = xr.Dataset({"label": (("x1", "x2"), np.array([[0, 1], [0, -1]]))}, axes)
    regions = ((0.0, 0.5, "2b"), (0.5, 0.6, "1"))
    kinds = {"equilibrium": 0.25, "cycle": 0.75}
    zero, two = jnp.zeros(()), jnp.zeros(2)
    seen = (cycle,), (inner,), (separatrix,)
    portrait = jb.Portrait(osc, rests, *seen, False, 3.0, none, run.status)
    found = [
        *(run, run.events, run.arcs, cycle, rests, point, special, curve, separatrix),
        portrait,
        jb.FatalShock(
            *(portrait, "x2", "cycle 0", "unstable cycle 0", "equilibrium 0", jnp.asarray(0.5)),
            *(ys[0], jnp.array([0.0, 0.5]), run.status),
        ),
        jb.BifurcationDiagram((point,), (), regions, osc, "belts[0].velocity", True),
        jb.RegionMap(
            *(("nu0", "nu1"), (np.array([0.4, 0.6]), np.array([0.3, 0.5])), label, (curve,)),
            *({"1": (), "2b": (cycle, inner)}, label == "", (), jb.presets.class_b),
        ),
        jb.Basins(osc, dataset, ("cycle that sticks to belt 1", "rest at 1.36"), (cycle,), inner),
        jb.BasinFractions(
            *(span[:2], ("cycle 0",), rows[:2, 1:], rows[:2, :1], 1 - rows[:2, 1]),
            *(rows[:2, :1] for _ in range(5)),
            *(100, "belts[0].velocity"),
        ),
        jb.BasinStability(kinds, dict.fromkeys(kinds, 0.01), 1000),
        jb.Fit(
            *(osc, ("damping",), ts[1:2], ts[1:2], ts[:1, None], two, two, ts, ys, 0.1 * ys, two),
            *(zero, zero, two, 1, 1, run.status),
        ),
        jb.Design(osc, cycle, ("damping",), ts[1:2], ts[2:4], ts[2:4], 3, run.status),
        jb.OrbitDiagram(
            *(span[1:3], np.array([["cycle"], ["undecided"]]), rows[:2, :1], np.zeros((2, 1), int)),
            *(np.array([[[1.0, 2.0]], [[np.nan] * 2]]), np.zeros((2, 1, 2)), jb.AtEvents()),
            *("belts[0].velocity", None),
        ),
        jb.Explanation(4096, 4, 300_000, 1.5, 0.1),
        forced_motion(),
        jb.CircleMap(
            *(span[:4], span[:4], span[:4], np.array([True, True, True, False]), span[2:3]),
            *((forced_motion(),), np.zeros(0), 2 * np.pi, 0, -1),
        ),
        jb.Exponents(two, two, two, 100, zero, two, run.status),
        jb.Verified((0, 1, 3), (4,), (2,), False),
    ]
    return {type(one): one for one in found}


def test_every_public_class_is_a_result_or_known_to_be_none(results):
    assert set(results) == set(RESULTS)


#: How many rows the table of each has, and some of its columns.
TABLES = {
    jb.Arcs: (None, "t x1 x2 duration contact_0 contact_1"),
    jb.Basins: (4, "label attractor fraction x1_min period multiplier signature"),
    jb.BasinFractions: (3, "value attractor fraction standard_error x1_min x2_max period"),
    jb.BasinStability: (2, "kind fraction standard_error n"),
    jb.BifurcationCurve: (6, "condition belts nu0 nu1 multiplier residual special"),
    jb.BifurcationDiagram: (1, "branch kind value stable x1_min x2_max period amplitude signature"),
    jb.BifurcationPoint: (1, "kind belts value error residual x1_min period multiplier status"),
    jb.CircleMap: (5, "phase next_phase periods slope is_onset fixed_point"),
    jb.Cycle: (1, "stable x1_max period amplitude multiplier stick_duration_1 signature status"),
    jb.Design: (3, "what name value wanted"),
    jb.Equilibria: (1, "kind stable x1 x1_lower x1_upper rate frequency contact_0"),
    jb.Events: (None, "t x1 x2 kind belt"),
    jb.Explanation: (1, "runs blocks bytes compile_seconds seconds"),
    jb.Exponents: (2, "exponent per_period standard_error status"),
    jb.FatalShock: (1, "attractor direction distance x1 shock_x2 boundary beyond status"),
    jb.Fit: (3, "name estimate standard_error lower upper"),
    jb.OrbitDiagram: (3, "value start kind period x1 x2"),
    jb.PeriodicMotion: (1, "stable periods period x1 multiplier_0 stick_duration_0 signature"),
    jb.Portrait: (4, "what number kind stable x1_min period multiplier rate"),
    jb.RegionMap: (6, "curve condition belts nu0 nu1 multiplier residual special"),
    jb.Separatrix: (5, "t x1 x2"),
    jb.SpecialPoint: (1, "kind belts value_0 value_1 residual"),
    jb.Trajectory: (None, "t x1 x2 contact_0 contact_1"),
    jb.Verified: (5, "block state"),
}


@pytest.mark.parametrize("kind", RESULTS, ids=lambda kind: kind.__name__)
def test_it_has_a_table(results, kind):
    table, (rows, columns) = results[kind].table(), TABLES[kind]
    assert isinstance(table, pd.DataFrame) and set(columns.split()) <= set(table.columns)
    assert len(table) == rows if rows else len(table) > 3
    assert table.index.tolist() == list(range(len(table)))
    # Numbers and words that a file takes and gives back.
    assert all(np.ndim(value) == 0 for value in table.to_numpy().ravel())


@pytest.mark.parametrize("kind", RESULTS, ids=lambda kind: kind.__name__)
def test_it_has_a_picture(results, kind, tmp_path):
    result = results[kind]
    ax = result.plot()
    assert isinstance(ax, Axes)
    ax.figure.savefig(tmp_path / "picture.png")
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    # Axes that are given are drawn into and come back.
    given = plt.figure().add_subplot()
    assert result.plot(given) is given
    for one in (ax, given):
        assert one.get_xlabel() and one.get_ylabel()
        assert "[1]" not in one.get_xlabel() + one.get_ylabel() + one.get_title()
    labels = set(given.get_legend_handles_labels()[1])
    key = given.get_legend()
    shown = [text.get_text() for text in key.get_texts()] if key else []
    assert sorted(shown) == sorted(labels)


def test_tables_tell_what_the_results_hold(results):
    run, cycle = results[jb.Trajectory], results[jb.Cycle]
    table = run.table()
    np.testing.assert_array_equal(table[["x1", "x2"]], run.ys)
    np.testing.assert_array_equal(table.contact_1, run.modes[:, 1])
    assert run.events.table().kind.tolist() == [jb.EventKind(int(k)).name for k in run.events.kind]
    (row,) = cycle.table().to_dict("records")
    assert row["signature"] == "stick1-slip1" and row["status"] == "OK" and row["stable"]
    assert row["amplitude"] == float(jb.amplitude(cycle))
    assert row["stick_duration_1"] == float(jb.stick_duration(cycle, belt=1))
    (point,) = results[jb.BifurcationPoint].table().to_dict("records")
    assert point["value"] == pytest.approx(0.538734800481, abs=1e-11) and point["belts"] == "1"
    lower, upper = results[jb.Fit].intervals()[0]
    fitted = results[jb.Fit].table().iloc[0]
    assert (fitted["lower"], fitted["upper"]) == (float(lower), float(upper))
    states = results[jb.Verified].table().state.tolist()
    assert states == ["right", "right", "bad", "right", "to do"]


def test_what_was_not_found_has_a_table_and_no_picture():
    nothing = jb.unstable_cycle(jb.presets.class_b(0.1, 0.35))
    (row,) = nothing.table().to_dict("records")
    assert row["status"] == "NO_UNSTABLE_CYCLE" and row["signature"] == "" and not row["stable"]
    assert all(np.isnan(row[name]) for name in ("period", "x1_min", "stick_duration_1"))
    with pytest.raises(ValueError, match="cycle must be one with status OK, to be drawn, got NO_"):
        nothing.plot()


@pytest.mark.parametrize("kind", [jb.Trajectory, jb.Events, jb.Arcs, jb.Cycle, jb.BifurcationPoint])
def test_batches_are_refused_by_name(results, kind):
    batch = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], results[kind])
    for method in (batch.table, batch.plot):
        with pytest.raises(ValueError, match=f"{kind.__name__} must be a single one"):
            method()


def test_what_has_no_picture_is_refused():
    with pytest.raises(TypeError, match="result must be one that has a picture, got str"):
        draw_result("text", None)


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("belts[0].velocity", r"belt velocity $\nu_0$"),
        ("belts[1].friction.steepness", "steepness of friction $p_{3,1}$"),
        ("belts[0].friction.velocity", "Stribeck velocity $v_{s,0}$"),
        ("belts[1].lower", "lower contact edge of belt 1"),
        ("damping", r"damping $\zeta$"),
        ("nu1", r"belt velocity $\nu_1$"),
        ("sigma", r"contact edge $\sigma$"),
        ("sigma0", r"contact edge $\sigma_0$"),
        ("s", "parameter $s$"),
        ("slow", "parameter slow"),
    ],
)
def test_parameters_are_named_by_word_and_symbol(name, label):
    assert parameter_label(name) == label


# --- sweeps, which are datasets -------------------------------------------------------------------


@pytest.fixture(scope="module")
def dataset() -> xr.Dataset:
    """What a sweep gives, made up."""
    named = {"long_name": "time stuck"}
    kind = {"flag_values": np.array([1, 2]), "flag_meanings": "equilibrium cycle"}
    nus = np.linspace(0.2, 0.6, 3)
    values = np.arange(18.0).reshape(3, 3, 2)
    return xr.Dataset(
        {
            "stick_duration": (("nu0", "nu1", "belt"), values, named),
            "sticks": (("nu0", "nu1", "belt"), values > 9),
            "kind": (("nu0", "nu1"), 1 + (values[..., 0] > 9), kind),
        },
        {
            "nu0": ("nu0", nus, {"long_name": "velocity of belt 0"}),
            "nu1": ("nu1", nus, {"long_name": "velocity of belt 1"}),
            "belt": [0, 1],
        },
    )


def test_sweeps_are_drawn_with_words(dataset):
    ax = jb.plot_sweep(dataset, "kind")
    assert ax.get_xlabel() == r"belt velocity $\nu_0$"
    ax = jb.plot_sweep(dataset.isel(nu1=0), "stick_duration")
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["belt 0", "belt 1"]
    assert ax.get_ylabel() == "time stuck"
    assert len(jb.plot_sweep(dataset.isel(belt=0), "stick_duration").collections) == 1
    with pytest.raises(ValueError, match='variable must be "stick_duration", "sticks" or "kind"'):
        jb.plot_sweep(dataset, "nope")
    with pytest.raises(ValueError, match=r"got 3 \(nu0, nu1, belt\); choose with .*isel\(belt=0\)"):
        jb.plot_sweep(dataset, "stick_duration")


def key_of(ax):
    """The colour of each label in the key of a figure."""
    (key,) = ax.figure.legends
    return {
        text.get_text(): to_hex(patch.get_facecolor())
        for text, patch in zip(key.get_texts(), key.get_patches(), strict=True)
    }


def test_a_kind_has_one_colour_in_every_picture(dataset):
    whole = key_of(jb.plot_sweep(dataset, "kind"))
    assert set(whole) == {"equilibrium", "cycle, sticks to belt 0 and 1"}
    resting = key_of(jb.plot_sweep(dataset.assign(kind=xr.ones_like(dataset.kind)), "kind"))
    assert resting.items() <= whole.items()
    turned = dataset.assign(sticks=dataset.sticks & (dataset.belt == 0)).transpose()
    assert key_of(jb.plot_sweep(turned, "kind"))["equilibrium"] == whole["equilibrium"]
    colours = [_colour_of_kind(f"cycle, sticks to belt {belts}") for belts in ("0", "1", "0 and 1")]
    assert len({*colours, *COLOURS.values()} - {"#009E73"}) == 3 + 8


def test_what_is_not_done_is_left_white(dataset):
    status = xr.zeros_like(dataset.kind).where(dataset.nu0 > 0.3, -1).drop_attrs()
    half = dataset.assign(status=status, n_events=dataset.kind.drop_attrs())
    assert key_of(jb.plot_sweep(half, "kind"))["not done"] == "#ffffff"
    drawn = np.ma.filled(jb.plot_sweep(half, "n_events").collections[0].get_array(), np.nan)
    assert np.array_equal(np.isnan(drawn), (status == -1).values.T)
    with pytest.raises(ValueError, match="dataset must be of a sweep that is done for its sig"):
        jb.plot_sweep(half.assign(signature=status), "signature")


def test_what_rests_has_no_stick_duration(dataset):
    mesh = jb.plot_sweep(dataset.isel(belt=0), "stick_duration").collections[0]
    drawn = np.ma.filled(mesh.get_array(), np.nan)
    assert np.array_equal(np.isnan(drawn), (dataset.kind == 1).values.T)


def test_signatures_have_a_key_of_the_most_frequent(dataset):
    names = ["none", *("-".join(["stick0", "slip0"] * n) for n in range(1, 12))]
    told = {"flag_values": np.arange(12), "flag_meanings": " ".join(names)}
    values = np.minimum(np.arange(48), 11).reshape(6, 8) - (np.arange(48) > 30).reshape(6, 8)
    many = xr.Dataset({"signature": (("nu0", "nu1"), values, told)})
    many = many.assign_coords(nu0=np.arange(6.0), nu1=np.arange(8.0))
    ax = jb.plot_sweep(many, "signature")
    key = key_of(ax)
    assert len(key) == 9 and len(set(key.values())) == 9 and "other" in key
    assert {name.replace("\n", "") for name in key} - {"other"} <= set(names)
    assert len(ax.figure.axes) == 1
    (line,) = jb.plot_sweep(many.isel(nu0=0), "signature").get_lines()
    assert np.array_equal(line.get_ydata(), values[0])


def test_basins_have_one_key_that_leaves_room(results):
    keys = []
    for draw in (jb.plot_basins, draw_result):
        figure, ax = plt.subplots(figsize=(5.2, 3.6))
        draw(results[jb.Basins], ax)
        keys.append([text.get_text() for text in ax.get_legend().get_texts()])
        figure.canvas.draw()
        # 0.47 with a column of six lines.
        assert ax.get_position().height > 0.6
    assert keys[0] == keys[1] and len(keys[0]) == 6


def test_pictures_of_sweeps_tell_the_unit(dataset):
    values = dataset.isel(belt=0).assign_coords(nu1=dataset.nu1.assign_attrs(units="m s-1"))
    values["stick_duration"].attrs["units"] = "s"
    ax = jb.plot_sweep(values, "stick_duration")
    assert ax.figure.axes[1].get_ylabel() == "time stuck (s)"
    assert ax.get_ylabel() == "velocity of belt 1 (m/s)"


def test_a_map_says_in_its_table_what_it_says_in_its_key(results, tmp_path):
    made = results[jb.RegionMap]
    path = tmp_path / "map.csv"
    write_cells(dataclasses.replace(made, on_line=np.eye(2, dtype=bool)), path)
    rows = path.read_text().splitlines()
    assert rows[0] == "nu0,nu1,region,words,on_line" and len(rows) == 5
    assert rows[1] == "0.4,0.3,1,rest,1" and rows[2] == "0.4,0.5,2b,rest; cycle on belt 1,0"
    other = dataclasses.replace(made, make=lambda nu0, nu1: jb.presets.class_c(nu0, nu1, 0.1))
    shown = set(other.plot(plt.figure().subplots()).get_legend_handles_labels()[1])
    assert set(made.words.values()) <= shown


def test_no_cell_of_a_symmetric_map_is_at_rest():
    for cells in (2, 31, 200):
        first, second = (evenly_spaced(-0.7, 0.7, n) for n in cells_along(cells))
        assert np.all(first != 0) and np.all(second != 0)
        assert not set(first[1:-1]) & set(second[1:-1])


def test_the_error_band_of_fractions_is_in_the_key(results):
    some = results[jb.BasinFractions]
    assert some.plot().get_legend_handles_labels()[1][-1] == "two standard errors"
    sure = dataclasses.replace(some, fractions=np.ones((2, 1)), undecided=np.zeros(2))
    assert sure.plot().get_legend_handles_labels()[1] == ["cycle 0"]
