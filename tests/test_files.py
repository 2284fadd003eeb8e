"""Oscillators and machines from a file: what the Python classes are, and results in SI units."""

import functools
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
import xarray as xr
from test_cli import column, read
from typer.testing import CliRunner

import jaxbelt as jb
from jaxbelt.cli import app
from jaxbelt.commands import files
from jaxbelt.commands.description import Description
from jaxbelt.commands.simulate import simulate
from jaxbelt.model.oscillator import constant_force
from jaxbelt.model.parameters import names_of

#: Every run of these tests has one shape, and so one compiled program.
SAMPLES, END = 401, 2.0

MACHINE = """
mass = 1.2
stiffness = 300.0
damping = 4.0
[[belts]]
velocity = 0.12
normal_force = 20.0
friction = { law = "stribeck", static = 0.5, kinetic = 0.3, velocity = 0.05 }
"""


def machine(velocity=0.12, normal_force=20.0):
    belt = jb.PhysicalBelt(velocity, jb.Stribeck(0.5, 0.3, 0.05), normal_force)
    return jb.Machine(1.2, 300.0, 4.0, (belt,))


def written(folder, text, name="given.toml"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def described(folder, text) -> Any:
    return Description(file=written(folder, text)).source


def run(*words):
    return CliRunner().invoke(app, [*map(str, words)])


# --- what a file describes ----------------------------------------------------------------------


def test_a_file_says_all_that_the_classes_say(tmp_path):
    written(tmp_path, "speed, mu, remark\n0, 0.5, first\n0.1, 0.4,\n0.3, 0.35, last\n", "mu.csv")
    found = described(
        tmp_path,
        """
        mass = 1.2
        stiffness = 300
        damping = 4.0
        [[belts]]
        velocity = { mean = 0.1, amplitude = 0.02, frequency = 12.0 }
        normal_force = { mean = 20.0, amplitude = 5.0, frequency = 12.0, phase = 0.5 }
        upper = 0.04
        friction = { law = "conti", static = 0.5, residual = 0.3, steepness = 40.0 }
        [[belts]]
        velocity = -0.1
        normal_force = 10.0
        lower = 0.02
        [belts.friction]
        law = "table"
        file = "mu.csv"
        static = 0.6
        [[belts]]
        velocity = 0.0
        normal_force = 1.0
        lower = -inf
        friction = { law = "table", speeds = [0.0, 1.0], coefficients = [0.5, 0.4] }
        [[forcing]]
        amplitude = 3.0
        frequency = 12.0
        [[forcing]]
        kind = "base_motion"
        amplitude = 0.001
        frequency = 24.0
        phase = 0.1
        """,
    )
    wave = functools.partial(jb.Oscillating, frequency=12.0)
    belts = (
        jb.PhysicalBelt(
            wave(0.1, 0.02), jb.Conti(0.5, 0.3, 40.0), wave(20, 5, phase=0.5), upper=0.04
        ),
        jb.PhysicalBelt(
            -0.1, jb.Tabulated([0.0, 0.1, 0.3], [0.5, 0.4, 0.35], 0.6), 10.0, lower=0.02
        ),
        jb.PhysicalBelt(0.0, jb.Tabulated([0.0, 1.0], [0.5, 0.4]), 1.0),
    )
    forcing = jb.Harmonic(3.0, 12.0), jb.BaseMotion(0.001, 24.0, 0.1)
    expected = jb.Machine(1.2, 300.0, 4.0, belts, forcing)
    assert eqx.tree_equal(found.machine, expected)
    assert eqx.tree_equal(found.own, expected.oscillator)


def test_a_dimensionless_file(tmp_path):
    found = described(
        tmp_path,
        """
        damping = 0.1
        omega = 1.1
        [belts]
        velocity = 0.5
        load = 0.7
        friction = { law = "cubic", a0 = 1.5, a1 = 1.5, a3 = 0.45 }
        [forcing]
        amplitude = 0.1
        frequency = 1.7
        """,
    )
    belt = jb.Belt(0.5, jb.Cubic(1.5, 1.5, 0.45), load=0.7)
    expected = jb.Oscillator(0.1, (belt,), omega=1.1, forcing=jb.Harmonic(0.1, 1.7))
    assert found.machine is None and eqx.tree_equal(found.own, expected)
    assert set(found.paths.values()) == set(names_of(expected))
    moved = found.at(nu0=0.4, **{"forcing[0].frequency": 1.6})
    assert (float(moved.belts[0].velocity), float(moved.forcing[0].frequency)) == (0.4, 1.6)


def test_the_files_in_the_help_and_in_the_documentation_are_ones(tmp_path):
    page = Path(__file__).parent.parent / "docs" / "scaling.md"
    written(tmp_path, "speed,mu\n0,0.5\n0.1,0.4\n", "mu.csv")
    texts = str(simulate.__doc__) + page.read_text(encoding="utf-8")
    blocks = re.findall(r"```toml\n(.+?)```", texts, re.S)
    assert len(blocks) == 3
    for block in blocks:
        assert isinstance(described(tmp_path, block).machine, jb.Machine)


@pytest.mark.parametrize("law", ["conti", "coulomb", "stribeck", "cubic"])
def test_parameters_vary_in_the_units_of_the_file(tmp_path, law):
    """Each number of a machine set to another one makes the oscillator of that machine.

    In the units of the machine as it is in the file: of the other one they may differ.
    """
    numbers = {
        "conti": "static = 0.5, residual = 0.3, steepness = 40.0, quadratic = 0.1",
        "coulomb": "static = 0.5, kinetic = 0.3",
        "stribeck": "static = 0.5, kinetic = 0.3, velocity = 0.05",
        "cubic": "a0 = 0.5, a1 = 1.0, a3 = 2.0",
    }[law]
    text = f"""
    mass = 1.2
    stiffness = 300.0
    damping = 4.0
    forcing = {{ amplitude = 3.0, frequency = 12.0 }}
    [[belts]]
    velocity = {{ mean = 0.1, amplitude = 0.02, frequency = 12.0 }}
    normal_force = 20.0
    lower = -0.04
    friction = {{ law = "{law}", {numbers} }}
    """
    source = described(tmp_path, text)
    given, own = source.machine, source.own
    assert set(names_of(given)) - set(source.paths) == {"mass", "stiffness"}
    leaves, structure = jax.tree.flatten(given)
    for place, name in enumerate(names_of(given)):
        if name in source.paths:
            value = 1.01 * float(leaves[place])
            other = jax.tree.unflatten(
                structure, [value if i == place else leaf for i, leaf in enumerate(leaves)]
            )
            back = given.of_oscillator(source.at(**{name: value}))
            # A few roundings of products and quotients.
            for one, expected in zip(jax.tree.leaves(back), jax.tree.leaves(other), strict=True):
                np.testing.assert_allclose(one, expected, rtol=1e-14, err_msg=name)
    assert own is source.own


def test_the_function_of_a_sweep_does_not_need_the_file(tmp_path):
    path = written(tmp_path, MACHINE)
    make: Any = Description(file=path).along(["belts[0].velocity"])
    path.unlink()
    again = eval(f"files.oscillator_of({make.args[0]!r}, **{{'belts[0].velocity': 0.1}})")
    # The unit of velocity is that of the file.
    expected = machine(velocity=0.1).oscillator
    np.testing.assert_allclose(jax.tree.leaves(again), jax.tree.leaves(expected), rtol=1e-14)
    assert files.described_by(tomllib.loads(MACHINE), "") is not None


# --- mistakes -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("mass = 1.2", "mass = -1.2", "mass in {} must be > 0, got -1.2"),
        (
            "mass = 1.2",
            "mas = 1.2",
            "{} must have only mass, stiffness, damping, belts, forcing, got mas (did you "
            "mean 'mass'?)",
        ),
        ("mass = 1.2\n", "", "{} must have mass, got stiffness, damping, belts"),
        ("damping = 4.0", "damping = 'soft'", "damping in {} must be a number, got 'soft'"),
        ("velocity = 0.12", "velocity = nan", "belts[0].velocity in {} must be finite, got nan"),
        (
            "velocity = 0.12",
            "velocity = [1, 2]",
            "belts[0].velocity in {} must be a number, got [1, 2]",
        ),
        (
            "velocity = 0.12",
            "speed = 0.12",
            "belts[0] in {} must have only velocity, friction, normal_force, lower, upper, "
            "got speed",
        ),
        ("= 20.0", "= -20.0", "belts[0].normal_force in {} must be >= 0, got -20.0"),
        (
            "= 20.0",
            "= { mean = 1.0, amplitude = 2.0, frequency = 3.0 }",
            "belts[0].normal_force.mean in {} must be >= |amplitude| = |2.0|, got 1.0",
        ),
        (
            "= 20.0",
            "= { mean = 1.0, amplitude = 2.0, hertz = 3.0 }",
            "belts[0].normal_force in {} must have only mean, amplitude, frequency, phase, "
            "got hertz",
        ),
        (
            "kinetic = 0.3",
            "kinetic = 0.7",
            "belts[0].friction.kinetic in {} must be <= static = 0.5, got 0.7",
        ),
        (
            "kinetic = 0.3",
            "kinetik = 0.3",
            "belts[0].friction in {} must have only law, static, kinetic, velocity, got "
            "kinetik (did you mean 'kinetic'?)",
        ),
        (
            "kinetic = 0.3, ",
            "",
            "belts[0].friction in {} must have kinetic, got law, static, velocity",
        ),
        (
            '"stribeck"',
            '"stribek"',
            "belts[0].friction.law in {} must be conti, coulomb, stribeck, cubic, table, got "
            "'stribek' (did you mean 'stribeck'?)",
        ),
        (
            'law = "stribeck", ',
            "",
            "belts[0].friction in {} must have law, got static, kinetic, velocity",
        ),
        (
            "[[belts]]",
            "[[belts]]\nupper = 1\nlower = 2",
            "belts[0].lower in {} must be < upper = 1.0, got 2.0",
        ),
        (
            "damping = 4.0",
            "damping = 4.0\nforcing = { amplitude = 1.0, frequency = -3.0 }",
            "forcing[0].frequency in {} must be >= 0, got -3.0",
        ),
        (
            "damping = 4.0",
            "damping = 4.0\nforcing = { kind = 'kick' }",
            "forcing[0].kind in {} must be harmonic, base_motion, got 'kick'",
        ),
        (
            "damping = 4.0",
            "damping = 4.0\nforcing = 3",
            "forcing in {} must be tables, [[forcing]], got 3",
        ),
        (
            "mass = 1.2",
            "mass 1.2",
            "file must be TOML, got {}: Expected '=' after a key in a key/value pair (at "
            "line 2, column 6)",
        ),
    ],
)
def test_what_is_wrong_is_told_with_its_place(tmp_path, old, new, sentence):
    assert old in MACHINE
    file = written(tmp_path, MACHINE.replace(old, new))
    result = run("simulate", "--file", file, "--out", tmp_path / "run")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == f"Error: {sentence.format(file)}\n"
    assert [*tmp_path.iterdir()] == [file]


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        (
            "speed,mu\n0,0.5\n0.1,high\n",
            "{} must be a CSV file of numbers, got '0.1', 'high' in line 3 of {}",
        ),
        (
            "speed,mu\n0,1,0,5\n",
            "{} must be a CSV file of numbers, got '0', '1', '0', '5' in line 2 of {}",
        ),
        ("v,mu\n0,0.5\n", "{} must be a CSV file with the columns speed and mu, got {} with v, mu"),
        ("speed,mu\n0,0.5\n", "{at}.speeds in {file} must be two or more, got 1"),
        (None, "{} must be a CSV file, got {}: No such file or directory"),
    ],
)
def test_what_is_wrong_with_a_table(tmp_path, table, sentence):
    start, _, _ = MACHINE.partition("friction")
    file = written(tmp_path, start + 'friction = { law = "table", file = "mu.csv" }')
    if table:
        written(tmp_path, table, "mu.csv")
    result = run("simulate", "--file", file, "--out", tmp_path / "run")
    at = "belts[0].friction"
    words = sentence.format(f"{at}.file in {file}", tmp_path / "mu.csv", at=at, file=file)
    assert (result.exit_code, result.stderr) == (2, f"Error: {words}\n")


def test_numbers_that_are_possible_together(tmp_path):
    """An end of one axis is refused only where no ends of the others make it possible."""
    source = Description(file=written(tmp_path, MACHINE))
    kinetic, static = "belts[0].friction.kinetic", "belts[0].friction.static"
    source.check_ends({kinetic: [0.3, 0.6], static: [0.4, 0.9]})
    for statics in ([0.4, 0.5], [0.4, 0.9]):
        with pytest.raises(ValueError, match=r"kinetic in .* must be <= static = 0.4, got 0.6"):
            source.check_ends({kinetic: [0.6], static: statics})


def test_the_amplitude_of_a_constant_force_is_that_of_the_file(tmp_path):
    """It stands in the file beside a phase, which makes a part of it the force."""
    for kind, unit in (("harmonic", 1 / 300.0), ("base_motion", 1.0)):
        wave = f'kind = "{kind}"\namplitude = 3.0\nfrequency = 0.0\nphase = 2.0'
        source = described(tmp_path, f"{MACHINE}[[forcing]]\n{wave}")
        name = "forcing[0].amplitude"
        assert eqx.tree_equal(source.at(**{name: 3.0}), source.own)
        for amplitude in (3.0, -1.5):
            (push,) = constant_force(source.at(**{name: amplitude}))
            in_m = float(push * source.machine.units.length)
            assert in_m == pytest.approx(unit * amplitude * np.cos(2.0), rel=1e-14)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("simulate --damping 0.1", "with --file nothing else must be described, got --damping"),
        (
            "simulate --class a --nu0 1",
            "with --file nothing else must be described, got --class, --nu0",
        ),
        ("simulate --start nan 0", "start must be finite, got nan 0.0"),
        (
            "sweep mass=1:2:3",
            "axes must be one of x1, x2, or a path such as belts[0].friction.static or "
            "belts[0].normal_force, got mass",
        ),
        (
            "diagram",
            "vary must be a path such as belts[0].friction.static or belts[0].normal_force, "
            "got nu0",
        ),
        (
            "orbits --vary belts[0].load",
            "vary must be a path such as belts[0].friction.static or belts[0].normal_force, "
            "got belts[0].load",
        ),
        (
            "sweep belts[0].normal_force=-5:5:3",
            "belts[0].normal_force in {file} must be >= 0, got -5.0",
        ),
        (
            "orbits --vary belts[0].friction.kinetic --span 0.1 0.9",
            "belts[0].friction.kinetic in {file} must be <= static = 0.5, got 0.9",
        ),
        (
            "orbits --vary belts[0].velocity --also 1",
            "also must be X1,X2, two finite numbers, got '1'",
        ),
        ("orbits --vary belts[0].velocity --also nan,0", "also must be X1,X2, two finite numbers"),
        ("simulate --v-star 0.1", "v-star must be left out unless --formulation is switch"),
        ("simulate --formulation switch --v-star 0", "v-star must be finite and > 0, got 0.0"),
        (
            "diagram --vary belts[0].velocity --span 0.1 0.2 --start 0 0",
            "start must be left out where there is no forcing, got (0.0, 0.0)",
        ),
        (
            "map",
            "file of map must describe a dimensionless oscillator, without mass and "
            "stiffness, got a machine",
        ),
        (
            "basins",
            "file of basins must describe a dimensionless oscillator, without mass and "
            "stiffness, got a machine",
        ),
    ],
)
def test_what_commands_refuse(tmp_path, words, sentence):
    out = tmp_path / "out"
    command, *rest = words.format(out).split()
    given = [] if "--out" in rest else ["--out", out if command != "sweep" else f"{out}.nc"]
    file = written(tmp_path, MACHINE)
    result = run(command, *rest, "--file", file, *given)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith(f"Error: {sentence.format(out, file=file)}")
    assert result.stderr.count("\n") == 1


def test_a_file_that_is_not_there(tmp_path):
    missing = tmp_path / "no.toml"
    result = run("simulate", "--file", missing)
    words = f"Error: file must be a TOML file, got {missing}: No such file or directory\n"
    assert (result.exit_code, result.stderr) == (2, words)


# --- results in SI units ------------------------------------------------------------------------


@pytest.mark.slow(first=True)
def test_simulate_in_si_units(tmp_path):
    out = tmp_path / "run"
    words = "--start", 0.05, 0, "--t1", END, "--samples", SAMPLES, "--json", "--out", out
    result = run("simulate", "--file", written(tmp_path, MACHINE), *words)
    assert result.exit_code == 0, result.output
    one = machine()
    end = float(one.tau(END))
    ts = np.array([end * i / (SAMPLES - 1) for i in range(SAMPLES)])
    run_of_it = jb.simulate(one.oscillator, one.start(0.05, 0.0), end, ts=ts)
    expected = jb.in_si(run_of_it, one)
    rows = read(tmp_path / "run.csv")
    assert list(rows[0]) == ["t (s)", "x1 (m)", "x2 (m/s)", "force (N)", "mode0"]
    for name, of in (("t (s)", "t"), ("x1 (m)", "x1"), ("x2 (m/s)", "x2"), ("force (N)", "force")):
        np.testing.assert_array_equal(column(rows, name), expected[of])
    np.testing.assert_array_equal(column(rows, "mode0"), expected["mode"][:, 0])
    events = read(tmp_path / "run_events.csv")
    assert list(events[0]) == ["t (s)", "x1 (m)", "x2 (m/s)", "kind", "belt"]
    np.testing.assert_array_equal(column(events, "x2 (m/s)"), expected["x2_event"])
    told = json.loads(result.stdout)
    assert told["t (s)"] == pytest.approx(END, rel=1e-15)
    assert told["x1 (m)"] == expected.x1.values[-1]
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_a_sweep_over_a_machine_is_a_loop_over_machines(tmp_path, suffix):
    """Also where the force varies that makes the unit of length; starts are in metres. Beside a
    store the whole is in SI units."""
    forces, starts = (10.0, 40.0), (0.0, 0.05)
    out, whole = tmp_path / f"sweep{suffix}", tmp_path / "sweep.nc"
    axes = "belts[0].normal_force=10:40:2", "x1=0:0.05:2"
    words = "--observe", "final", "--t1", END, "--start", 0.01, 0.2, "--out", out
    command = "sweep", *axes, "--file", written(tmp_path, MACHINE), *words
    if suffix == ".zarr":
        first = run(*command, "--blocks", "0:1")
        assert first.exit_code == 0 and out.is_dir() and not whole.exists(), first.output
    result = run(*command)
    assert result.exit_code == 0, result.output
    with xr.open_dataset(whole, engine="scipy") as found:
        assert found["belts[0].normal_force"].attrs["units"] == "N"
        np.testing.assert_allclose(found["x1"], starts, rtol=1e-15)
        assert found.attrs["start"] == "x2 = 0.2 m/s"
        for i, normal_force in enumerate(forces):
            one = machine(normal_force=normal_force)
            for j, x1 in enumerate(starts):
                end, start = float(one.tau(END)), one.start(x1, 0.2)
                ts = np.linspace(0.0, end, SAMPLES)
                last = jb.in_si(jb.simulate(one.oscillator, start, end, ts=ts), one)
                # The sweep's tolerance is 1e-8 of displacements of some hundredths of a metre.
                assert float(found.x1_end[i, j]) == pytest.approx(float(last.x1[-1]), abs=1e-8)
                assert float(found.x2_end[i, j]) == pytest.approx(float(last.x2[-1]), abs=1e-7)


@pytest.mark.slow
def test_orbits_in_si_units(tmp_path):
    words = "--vary", "belts[0].velocity", "--span", 0.1, 0.3, "--rows", 5, "--also", "0.0167,0"
    words = *words, "--start", 0.05, 0, "--out", tmp_path / "orbits"
    result = run("orbits", "--file", written(tmp_path, MACHINE), *words)
    assert result.exit_code == 0, result.output
    rows = read(tmp_path / "orbits.csv")
    assert list(rows[0]) == ["value (m/s)", "start", "kind", "period (s)", "x1 (m)", "x2 (m/s)"]
    assert (tmp_path / "orbits.png").read_bytes().startswith(b"\x89PNG")
    for row in rows:
        one = machine(velocity=float(row["value (m/s)"]))
        start = one.start((0.05, 0.0167)[int(row["start"])], 0.0)
        if row["kind"] == "cycle":
            cycle = jb.in_si(jb.find_cycle(one.oscillator, start), one)
            ends = float(cycle.x1_min), float(cycle.x1_max)
            # The tolerance of the runs, 1e-8 of a step, over a cycle.
            assert min(abs(float(row["x1 (m)"]) - x1) for x1 in ends) < 1e-7
            assert float(row["period (s)"]) == pytest.approx(float(cycle.period), rel=1e-6)
        else:
            rest = float(jb.equilibria(one.oscillator).x1[0]) * float(one.units.length)
            assert float(row["x1 (m)"]) == pytest.approx(rest, abs=1e-7)
    assert {row["kind"] for row in rows} == {"cycle", "equilibrium"}


@pytest.mark.slow
def test_a_diagram_in_si_units(tmp_path):
    words = "--vary", "belts[0].velocity", "--span", 0.05, 0.5, "--rows", 20
    words = *words, "--out", tmp_path / "diagram"
    result = run("diagram", "--file", written(tmp_path, MACHINE), *words)
    assert result.exit_code == 0, result.output
    points = {row["kind"]: row for row in read(tmp_path / "diagram_points.csv")}
    # m X'' = ... : the fixed point is unstable where N mu'(V) < -c, and mu' follows from the law.
    hopf = -0.05 * np.log(4.0 / 20.0 * 0.05 / 0.2)
    assert float(points["Hopf"]["value (m/s)"]) == pytest.approx(hopf, abs=1e-13)
    fold = float(points["NonsmoothFold"]["value (m/s)"])
    rows = read(tmp_path / "diagram.csv")
    cycles = [row for row in rows if row["kind"] == "cycle"]
    # Stable and unstable cycles meet at the fold.
    assert max(column(cycles, "value (m/s)")) == pytest.approx(fold, abs=1e-6)
    row = next(row for row in cycles if row["stable"] == "True")
    one = machine(velocity=float(row["value (m/s)"]))
    cycle = jb.in_si(jb.find_cycle(one.oscillator, one.start(0.05, 0.0)), one)
    for name in ("x1_min (m)", "x1_max (m)", "x2_min (m/s)", "period (s)"):
        expected = float(cycle[name.partition(" ")[0]])
        assert float(row[name]) == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_a_forced_diagram_finds_the_points_of_the_python_call(tmp_path):
    words = "--belt", "1.0,law=coulomb,static=1,kinetic=0.6", "--force", "0.9,1.3"
    span, start = (1.0, 1.6), (0.5, 0.0)
    words = *words, "--vary", "forcing[0].frequency", "--span", *span, "--start", *start
    result = run("diagram", *words, "--out", tmp_path / "diagram")
    assert result.exit_code == 0, result.output
    belt = jb.Belt(1.0, jb.Coulomb(1.0, 0.6))
    osc = jb.Oscillator(0.5, (belt,), forcing=jb.Harmonic(0.9, 1.3))
    expected = jb.bifurcation_diagram(osc, lambda o: o.forcing[0].frequency, span, start=start)
    rows = read(tmp_path / "diagram_points.csv")
    assert column(rows, "value").tolist() == [float(point.value) for point in expected.points]
    branches = read(tmp_path / "diagram.csv")
    assert len(branches) == sum(map(len, expected.branches))
    assert expected.plot().get_ylabel() == "amplitude of $x_1$"
    np.testing.assert_array_equal(
        column(branches, "x1_max"), np.concatenate([one.x1_max for one in expected.branches])
    )
