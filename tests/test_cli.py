"""The command line: files that read back as what was computed, and errors in one sentence."""

import csv
import functools
import json
import os
import subprocess
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import jaxbelt as jb
from jaxbelt import paper as reproduce
from jaxbelt.cli import app
from jaxbelt.commands import options
from jaxbelt.commands.belts import parse_belt
from jaxbelt.commands.description import Description
from jaxbelt.commands.options import tolerances
from jaxbelt.commands.sweep import VARIABLES
from jaxbelt.commands.tables import write_table
from jaxbelt.model.parameters import names_of
from jaxbelt.sweeps.question import Question
from jaxbelt.tables import table_of

runner = CliRunner()

#: Every run of these tests has one shape, and so one compiled program, that of test_compiling.py.
SPAN, TIMES = "--t1 50 --samples 101", np.arange(101) * 50.0 / 100


def read(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def column(rows, name):
    return np.array([float(row[name]) for row in rows])


# --- simulate -----------------------------------------------------------------------------------


def test_simulate_writes_what_simulate_returns(tmp_path):
    out = tmp_path / "new" / "cross"
    arguments = "--class b --nu0 0.3 --nu1 0.4 --start 1.5 1.5 " + SPAN
    result = runner.invoke(app, ["simulate", *arguments.split(), "--out", str(out)])
    assert result.exit_code == 0, result.output
    trajectory = jb.simulate(jb.presets.class_b(0.3, 0.4), (1.5, 1.5), 50.0, ts=TIMES)
    rows = read(tmp_path / "new" / "cross.csv")
    assert list(rows[0]) == ["t", "x1", "x2", "mode0", "mode1"]
    # Written to the last digit.
    np.testing.assert_array_equal(column(rows, "t"), trajectory.ts)
    np.testing.assert_array_equal(column(rows, "x1"), trajectory.ys[:, 0])
    np.testing.assert_array_equal(column(rows, "x2"), trajectory.ys[:, 1])
    for belt in (0, 1):
        np.testing.assert_array_equal(column(rows, f"mode{belt}"), trajectory.modes[:, belt])
    events = read(tmp_path / "new" / "cross_events.csv")
    np.testing.assert_array_equal(column(events, "t"), trajectory.events.t)
    np.testing.assert_array_equal(column(events, "x1"), trajectory.events.y[:, 0])
    np.testing.assert_array_equal(column(events, "belt"), trajectory.events.belt)
    kinds = [jb.EventKind(int(kind)).name for kind in trajectory.events.kind]
    assert [row["kind"] for row in events] == kinds
    assert {"STICK", "SLIP", "CROSS"} <= set(kinds)
    assert (tmp_path / "new" / "cross.png").read_bytes().startswith(b"\x89PNG")
    assert repr(trajectory) in result.output


def test_the_last_sample_is_the_end_of_the_span_whatever_it_is(tmp_path):
    end, steps = 41.6, 99
    assert end * steps / steps > end
    arguments = f"--class b --nu0 0.3 --nu1 0.4 --t1 {end} --samples {steps + 1}"
    out = str(tmp_path / "run")
    result = runner.invoke(app, ["simulate", *arguments.split(), "--out", out])
    assert result.exit_code == 0, result.output
    t = column(read(tmp_path / "run.csv"), "t")
    assert t[-1] == end
    np.testing.assert_allclose(t, np.arange(steps + 1) * (end / steps), rtol=1e-14)


def test_a_run_of_which_nothing_is_known_tells_its_status(tmp_path):
    arguments = "--class b --nu0 0.45 --nu1 0.35 --start 1e308 1e308 " + SPAN
    result = runner.invoke(app, ["simulate", *arguments.split(), "--out", str(tmp_path / "run")])
    assert result.exit_code == 2
    assert result.stderr.startswith("Error: trajectory must be a run with finite samples, got ")
    assert f"status NOT_FINITE: {jb.describe(jb.Status.NOT_FINITE)}" in result.stderr


def test_simulate_takes_belts_in_full(tmp_path):
    arguments = "--belt 0.3,steepness=8 --belt=-0.1,load=0.5 --damping 0.4 --omega 1.1 " + SPAN
    result = runner.invoke(app, ["simulate", *arguments.split(), "--out", str(tmp_path / "run")])
    assert result.exit_code == 0, result.output
    steep, weak = (jb.Conti(static=1.0, residual=0.6, steepness=p3) for p3 in (8.0, 10.0))
    osc = jb.Oscillator(0.4, (jb.Belt(0.3, steep), jb.Belt(-0.1, weak, load=0.5)), omega=1.1)
    expected = jb.simulate(osc, (3.0, 0.0), 50.0, ts=TIMES)
    rows = read(tmp_path / "run.csv")
    np.testing.assert_array_equal(column(rows, "x1"), expected.ys[:, 0])


def test_classes_are_those_of_the_presets():
    def belts(system, **given):
        return repr(Description(system, **given).oscillator().belts)

    assert belts("a", nu0=0.1) == repr(jb.presets.class_a(0.1).belts)
    assert belts("c", nu0=0.1, nu1=-0.2, sigma=0.3) == repr(
        jb.presets.class_c(0.1, -0.2, 0.3).belts
    )
    assert belts("d", nu0=0.1, nu1=-0.2, sigma0=0.3, sigma1=0.4) == repr(
        jb.presets.class_d(0.1, -0.2, 0.3, 0.4).belts
    )


def test_belts_are_parsed():
    belt = parse_belt("-0.3, law=stribeck, static=0.9, kinetic=0.5, stribeck_velocity=0.1,load=2")
    expected = jb.Belt(-0.3, jb.Stribeck(static=0.9, kinetic=0.5, velocity=0.1), load=2.0)
    assert repr(belt) == repr(expected)
    belt = parse_belt("0.5,law=coulomb,static=0.8,kinetic=0.5,lower=0.2")
    assert repr(belt) == repr(jb.Belt(0.5, jb.Coulomb(static=0.8, kinetic=0.5), lower=0.2))
    belt = parse_belt("0.5,steepness=3")
    assert repr(belt) == repr(jb.Belt(0.5, jb.Conti(static=1.0, residual=0.6, steepness=3.0)))


#: Two belts of one's own, as they are described, and as a function of what may vary.
OWN = ("0.3,law=coulomb,static=0.8,kinetic=0.5", "-0.1,steepness=8,load=0.5,lower=0.2")


def own(nu0, load, damping=0.4):
    second = jb.Belt(-0.1, jb.Conti(1.0, 0.6, 8.0), load, lower=0.2)
    return jb.Oscillator(damping, (jb.Belt(nu0, jb.Coulomb(0.8, 0.5)), second), omega=1.1)


@pytest.mark.parametrize("given", [1e-10, 1e-8, 1e-3])
def test_a_tolerance_that_is_given_is_a_length_in_the_users_unit(given):
    """Also where it is the number of the default, which follows the oscillator's own size."""
    assert tolerances(given) == {"rtol": given, "atol": given}
    assert tolerances(None) == {}


@pytest.mark.parametrize("system", ["a", "b", "c", "d", OWN])
def test_parameters_are_those_of_the_oscillator(system):
    """Told without the oscillator, before anything that computes is imported."""
    described = Description(system) if system in list("abcd") else Description(belt=[*system])
    osc, known = described.oscillator(), described.parameters()
    assert set(known.values()) == set(names_of(osc))
    assert [name for name in known if known[name] != name] == [
        *(f"nu{i}" for i in range(len(osc.belts))),
        "zeta",
    ]


def test_forces_are_those_of_the_oscillator():
    """Also where they vary, and where one is constant."""
    described = Description("a", force=["0.3,1.7", "0.1,0", "0.2,2,0.5"])
    osc = described.oscillator(nu0=0.4)
    forces = jb.Harmonic(0.3, 1.7), jb.Harmonic(0.1, 0.0), jb.Harmonic(0.2, 2.0, 0.5)
    assert repr(osc) == repr(jb.Oscillator(0.5, jb.presets.class_a(0.4).belts, forcing=forces))
    assert set(described.parameters().values()) == set(names_of(osc))
    moved = described.along(["nu0", "forcing[0].frequency"])(**{"forcing[0].frequency": 1.1})
    assert float(moved.forcing[0].frequency) == 1.1


@pytest.mark.parametrize(
    ("force", "message"),
    [
        ("0.3", "force must be AMPLITUDE,FREQUENCY or .*, numbers, got '0.3'"),
        ("0.3,one", "force must be AMPLITUDE,FREQUENCY or .*, numbers, got '0.3,one'"),
        ("0.3,-1", "force must be finite numbers with a frequency >= 0, got '0.3,-1'"),
        ("nan,1", "force must be finite numbers with a frequency >= 0, got 'nan,1'"),
    ],
)
def test_bad_forces_are_told(force, message):
    with pytest.raises(ValueError, match=message):
        Description(force=[force]).check()


@pytest.mark.slow(first=True)
def test_a_forced_run_is_written(tmp_path):
    belt = ["--belt", "1.0,law=coulomb,static=1,kinetic=0.6", "--force", "0.9,1.3"]
    out = tmp_path / "run"
    result = CliRunner().invoke(app, ["simulate", *belt, "--t1", "20", "--out", str(out), "--json"])
    assert result.exit_code == 0, result.output
    law = jb.Coulomb(1.0, 0.6)
    osc = jb.Oscillator(0.5, (jb.Belt(1.0, law),), forcing=jb.Harmonic(0.9, 1.3))
    run = jb.simulate(osc, (3.0, 0.0), 20.0, ts=[20.0])
    told = json.loads(result.output)
    assert told["x1"] == pytest.approx(float(run.ys[-1, 0]), abs=1e-9)
    assert out.with_name("run.png").stat().st_size > 10_000


def test_axes_by_name():
    """Of a class its arguments, then anything by its path; dataset.attrs["call"] can be run."""
    axes = {"nu0": 0.2, "belts[1].load": 0.7}
    make = Description(belt=[*OWN], damping=0.4, omega=1.1).along(axes)
    assert repr(make(**axes)) == repr(own(0.2, 0.7))
    assert repr(make(damping=0.3, nu0=0.2)) == repr(make(zeta=0.3, nu0=0.2))
    assert float(make(zeta=0.3).damping) == 0.3
    assert Description().along(["nu0", "nu1"]) is jb.presets.class_b
    edge = Description("c", nu1=-0.2).along(["sigma"])
    assert repr(edge(sigma=0.3)) == repr(jb.presets.class_c(0.2, -0.2, 0.3))
    named = ["sigma", "belts[0].friction.steepness"]
    steep = Description("c", nu1=-0.2, damping=0.3).along(named)
    osc = steep(**{"sigma": 0.3, "belts[0].friction.steepness": 8.0})
    first, second = jb.presets.class_c(0.2, -0.2, 0.3).belts
    first = jb.Belt(first.velocity, jb.Conti(1.0, 0.6, 8.0), upper=0.3)
    assert repr(osc) == repr(jb.Oscillator(0.3, (first, second)))
    with pytest.raises(ValueError, match="load of belt 1 must be >= 0, got -1"):
        make(**{"nu0": 0.2, "belts[1].load": -1.0})


@pytest.mark.slow(first=True)
def test_sweep_of_belts_of_ones_own(tmp_path):
    out = tmp_path / "own.nc"
    arguments = ["nu0=0.1:0.5:3", "belts[1].load=0.5:1:2", "--damping", "0.4", "--omega", "1.1"]
    arguments += ["--belt", OWN[0], f"--belt={OWN[1]}", "--observe", "final", "--t1", "20"]
    result = runner.invoke(app, ["sweep", *arguments, "--out", str(out)])
    assert result.exit_code == 0, result.output
    axes = {"nu0": np.array([0.1, 0.3, 0.5]), "load": np.array([0.5, 1.0])}
    expected = jb.sweep(own, axes, y0=(3.0, 0.0), t1=20.0)
    with xr.open_dataset(out, engine="scipy") as written:
        assert written.x1_end.dims == ("nu0", "belts[1].load")
        np.testing.assert_array_equal(written.x1_end, expected.x1_end)
        again = eval(written.attrs["make"], {"functools": functools, "jaxbelt": jb})
        assert repr(again(**{"nu0": 0.2, "belts[1].load": 0.7})) == repr(own(0.2, 0.7))
    assert (tmp_path / "own.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("--class q", "class must be a, b, c or d, got q"),
        ("--class b --sigma 1", "class b must have only nu0, nu1, got sigma"),
        ("--class a --nu0 nan", "velocity of belt must be finite, got nan"),
        ("--belt 0.3 --nu0 1", "with --belt no class must be described, got nu0"),
        ("--belt 0.3 --class c", "with --belt no class must be described, got --class c"),
        ("--belt fast", "velocity of belt 'fast' must be a number, got 'fast'"),
        (
            "--belt 0.3,static",
            "belt '0.3,static' must have name=value after its velocity, got 'static'",
        ),
        (
            "--belt 0.3,law=dry",
            "law of belt '0.3,law=dry' must be conti, coulomb, stribeck, cubic, got dry",
        ),
        (
            "--belt 0.3,law=coulomb,grip=1",
            "belt '0.3,law=coulomb,grip=1' must have only velocity, load, lower, upper, static, "
            "kinetic, got grip",
        ),
        (
            "--belt 0.3,law=coulomb,static=1",
            "belt '0.3,law=coulomb,static=1' must have kinetic, which coulomb needs",
        ),
        ("--belt 0.3,load=-1", "load of belt '0.3,load=-1' must be >= 0, got -1.0"),
        ("--omega 0", "omega must be > 0, got 0.0"),
        ("--t1 -1", "t1 must be finite and > 0, got -1.0"),
        ("--t1 inf", "t1 must be finite and > 0, got inf"),
        ("--start nan 0", "start must be finite, got nan 0.0"),
        ("--samples 1", "samples must be at least 2, got 1"),
        ("--tolerance 0", "tolerance must be > 0 and at most 0.01, got 0.0"),
        (
            "--formulation exact",
            "formulation must be one of filippov, switch, smooth, got exact",
        ),
    ],
)
def test_simulate_tells_what_is_wrong_in_one_sentence(tmp_path, arguments, sentence):
    out = tmp_path / "run"
    result = runner.invoke(app, ["simulate", *arguments.split(), "--out", str(out)])
    assert result.exit_code == 2
    assert result.stderr == f"Error: {sentence}\n"
    assert result.stdout == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("basins --points 1000000", "points must be at most 6553, got 1000000"),
        ("basins --starts 1000000000", "starts must be at most 42949672, got 1000000000"),
        ("basins --starts -1", "starts must be at least 0, got -1"),
        ("map --cells 1000000000", "cells must be at most 2930, got 1000000000"),
        ("simulate --samples 1000000000", "samples must be at most 42949672, got 1000000000"),
        ("diagram --rows 1000000", "rows must be at most 858993, got 1000000"),
        ("orbits --rows 1000000", "rows must be at most 858993, got 1000000"),
        (
            "sweep nu0=0:1:1000000000",
            "COUNT of axis nu0 must be at most 42949672, got 1000000000",
        ),
        (
            "sweep nu0=0:1:10000 nu1=0:1:10000",
            "product of all COUNTs must be at most 42949672, got 100000000",
        ),
        (
            "sweep nu0=0:1:20000 nu1=0:1:20000 --out plane.zarr",
            "product of all COUNTs must be at most 171798691, got 400000000",
        ),
        (
            "sweep nu0=0:1:100000 nu1=0:1:100000 --out plane.zarr --blocks 0:1",
            "product of all COUNTs must be at most 2147483648, got 10000000000",
        ),
    ],
)
def test_grids_that_have_no_room_in_memory_are_refused(tmp_path, monkeypatch, words, sentence):
    monkeypatch.setattr(options, "_memory", lambda: 2**34)
    monkeypatch.chdir(tmp_path)
    result = runner.invoke(app, words.split())
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith(f"Error: {sentence}")
    assert result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_grids_that_have_room_are_not_refused(monkeypatch):
    monkeypatch.setattr(options, "_memory", lambda: 2**34)
    options.check_count("points", 6553, 2, sides=2)
    with pytest.raises(ValueError, match=r"at most 6553, got 6554: .* \(16 GiB, 400 bytes each\)$"):
        options.check_count("points", 6554, 2, sides=2)
    monkeypatch.undo()
    assert options._memory() > 2**28


def test_a_run_that_is_cut_short_is_written_and_exits_with_1(tmp_path, monkeypatch):
    whole = jb.simulate

    def cut_short(*args, **kwargs):
        trajectory = whole(*args, **kwargs)
        status = jnp.asarray(jb.Status.TOO_MANY_SEGMENTS.value)
        ys = trajectory.ys.at[50:].set(jnp.nan)
        return eqx.tree_at(lambda run: (run.status, run.ys), trajectory, (status, ys))

    monkeypatch.setattr(jb, "simulate", cut_short)
    out = tmp_path / "run"
    result = runner.invoke(app, ["simulate", *SPAN.split(), "--out", str(out)])
    assert result.exit_code == 1
    assert "TOO_MANY_SEGMENTS" in result.output
    assert (
        np.isfinite(column(read(tmp_path / "run.csv"), "x1")).tolist() == [True] * 50 + [False] * 51
    )


def test_rows_read_back_to_the_last_digit(tmp_path):
    rows = [
        {"curve": 0, "nu0": 0.1 + 0.2, "multiplier": np.nan, "special": ""},
        {"curve": 1, "nu0": -1 / 3, "multiplier": 1.5, "special": "BeltAtRest 0 1"},
    ]
    write_table(table_of(rows), tmp_path / "curves.csv")
    found = read(tmp_path / "curves.csv")
    assert list(found[0]) == list(rows[0]) and found[1]["special"] == "BeltAtRest 0 1"
    assert column(found, "nu0").tolist() == [0.1 + 0.2, -1 / 3]
    assert np.isnan(float(found[0]["multiplier"]))


def test_the_command_turns_on_float64_by_itself(tmp_path):
    program = "from jaxbelt.cli import app; app(prog_name='jaxbelt')"
    environment = {key: value for key, value in os.environ.items() if key != "JAX_ENABLE_X64"}
    run = subprocess.run(
        [sys.executable, "-c", program, "simulate", "--damping", "nan"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=environment,
        timeout=120,
    )
    assert (run.returncode, run.stderr) == (2, "Error: damping must be finite, got nan\n")


def test_help_and_mistakes_in_options_import_nothing_that_computes(tmp_path):
    program = """
import sys
from typer.testing import CliRunner
from jaxbelt.cli import app
for words in (["--help"], ["--version"], ["sweep", "--help"], ["simulate", "--class", "q"],
              ["sweep", "nu0=0:1", "--variable", "kind"], ["basins", "--x1", "1", "0"]):
    result = CliRunner().invoke(app, words)
    print(result.exit_code, sorted({"jax", "numpy", "matplotlib", "xarray"} & sys.modules.keys()))
"""
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path, timeout=120
    )
    assert run.stdout.splitlines() == ["0 []"] * 3 + ["2 []"] * 3, run.stderr


def test_the_version_is_told():
    result = runner.invoke(app, ["--version"])
    assert (result.exit_code, result.output) == (0, f"jaxbelt {jb.__version__}\n")


def test_scripts_read_json(tmp_path):
    out = tmp_path / "run"
    result = runner.invoke(app, ["simulate", *SPAN.split(), "--json", "--out", str(out)])
    told = json.loads(result.stdout)
    trajectory = jb.simulate(jb.presets.class_b(0.45, 0.35), (3.0, 0.0), 50.0, ts=TIMES)
    assert told["status"] == "OK" and told["events"] == len(trajectory.events.t)
    assert [told["t"], told["x1"], told["x2"]] == [50.0, *trajectory.ys[-1].tolist()]
    assert told["written"] == [f"{out}{end}" for end in (".png", ".csv", "_events.csv")]


def test_variables_of_the_command_are_those_of_datasets():
    axes = {"nu0": [0.45], "nu1": [0.35]}
    for observe, names in VARIABLES.items():
        question = Question.of(jb.presets.class_b, axes, (3.0, 0.0), 10.0, 1e-8, 1e-8, observe, ())
        assert set(question.table.shapes) == set(names)


@pytest.mark.parametrize("command", ["reproduce", "simulate"])
def test_help_teaches(command):
    result = runner.invoke(app, [command, "--help"])
    assert result.exit_code == 0
    assert f"jaxbelt {command} -" in result.output
    assert "Example" in result.output


# --- reproduce ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def values():
    return reproduce.critical_values()


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reproduction") / "results"
    return folder, runner.invoke(app, ["reproduce", "--out", str(folder)])


@pytest.mark.slow(first=True)
def test_reproduce_writes_the_table_and_every_figure(reproduced, values):
    folder, result = reproduced
    assert result.exit_code == 0, result.output
    names = {f"{name}.png" for name in reproduce.FIGURES}
    assert names >= {f"fig{number:02}.png" for number in (*range(1, 6), *range(7, 14))}
    assert {path.name for path in folder.iterdir()} == names | {"critical_values.json"}
    for name in names:
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    written = json.loads((folder / "critical_values.json").read_text(encoding="utf-8"))
    assert written == reproduce.table_as_json(values)


@pytest.mark.slow(first=True)
def test_critical_values_json(values):
    rows = json.loads(json.dumps(reproduce.table_as_json(values)))
    keys = ["class", "point", "kind", "printed", "computed", "residual", "iterations"]
    assert [list(row) for row in rows] == [keys] * 9
    assert [(r["class"], r["point"], r["kind"], r["printed"]) for r in rows] == [
        tuple(value) for value in jb.presets.PUBLISHED
    ]
    computed = {(r["class"], r["point"]): r["computed"] for r in rows}
    # The growth rate has a slope of order one there: rounding moves its root by a few 1e-16.
    assert computed["a", "nu_beta"] == pytest.approx((np.sqrt(8) - 1) / 10, abs=1e-14)
    # 4 / (1 + 10 nu0)^2 + 4 / (1 + 10 nu1)^2 = zeta = 0.5, eq. (28) for two belts
    hopf = (np.sqrt(4 / (0.5 - 4 / 4.5**2)) - 1) / 10
    assert computed["b", "nu_gamma"] == pytest.approx(hopf, abs=1e-14)
    assert computed["b", "nu_epsilon"] == pytest.approx(-hopf, abs=1e-14)
    # Computed twice by other programs, to about 1e-11.
    others = [0.267134534361, 0.538734800481, -0.455724862289, -0.561302406210]
    keys = ("a", "nu_alpha"), ("b", "nu_alpha"), ("b", "nu_zeta"), ("b", "nu_eta")
    np.testing.assert_allclose([computed[key] for key in keys], others, rtol=0, atol=1e-11)
    assert computed["b", "nu_beta"] == 0.35 and computed["b", "nu_delta"] == 0
    for row in rows:
        assert row["residual"] <= 1e-11
        assert 1 <= row["iterations"] <= 8
        # The printed folds stop up to 8e-4 short, as a switch model does.
        assert row["computed"] == pytest.approx(row["printed"], abs=1e-3)


@pytest.mark.slow(first=True)
def test_reproduce_says_what_the_paper_misprints_and_lacks(reproduced):
    _, result = reproduced
    text = " ".join(result.output.split())
    for remark in reproduce.REMARKS:
        assert remark in text
    assert "0.182842712475" in text
    assert "-0.561302406210" in text


def test_reproduce_tells_in_one_sentence_where_it_cannot_write(tmp_path):
    blocked = tmp_path / "file"
    blocked.touch()
    result = runner.invoke(app, ["reproduce", "--out", str(blocked)])
    assert result.exit_code == 2
    assert result.stderr.startswith("Error: ")
    assert result.stderr.count("\n") == 1


@pytest.mark.slow(first=True)
def test_portraits_show_what_the_paper_says_of_the_regions(values):
    """Which panels have a steady cycle, and on which belts it sticks."""
    panels = {name: figure.panels(values) for name, figure in reproduce.PORTRAITS.items()}
    orbits = iter(
        reproduce.simulate_panels([panel for group in panels.values() for panel in group])
    )
    seen = {}
    for name, group in panels.items():
        seen[name] = []
        for panel in group:
            runs = next(orbits)
            if panel.cycle is not None:
                seen[name].append("fold")
                continue
            cycles = [cycle for cycle in map(reproduce.steady_cycle, runs) if cycle]
            levels = [float(belt.velocity) for belt in panel.oscillator.belts]
            on = ""
            if cycles:
                x2 = cycles[0].states[:, 1]
                on = "".join(
                    str(i) for i, v in enumerate(levels) if np.sum(np.abs(x2 - v) < 1e-9) > 2
                )
            seen[name].append(on)
    # At the grazing point itself rounding decides whether the cycle sticks to belt 0.
    assert seen["fig12"].pop(1) in ("1", "01")
    # One letter a belt, nothing for no steady cycle.
    assert seen == {
        "fig04": ["", "fold", "0"],
        "fig05": ["0", "0", "0"],
        "fig08": ["", "fold", "1"],
        "fig09": ["1", "01", "0"],
        "fig10": ["0", "0", "0"],
        "fig11": ["0", "", "0", "01"],
        "fig12": ["01", "1"],
        "fig13": ["1", "fold", ""],
    }


def test_a_force_of_frequency_zero_is_no_forcing():
    assert not Description(force=["0.3,0"]).is_forced
    assert Description(force=["0.3,0", "0.1,1.2"]).is_forced
