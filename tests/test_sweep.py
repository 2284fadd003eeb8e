"""`sweep`: the dataset, derivatives, reducers, stores, and what it says about bad input."""

import ast
import functools
import json
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import jax
import jax.numpy as jnp
import lists
import numpy as np
import oracle
import oracle_cycles
import pytest
import xarray as xr
from compilations import compilations
from typer.testing import CliRunner

import jaxbelt as jb
from jaxbelt import Status
from jaxbelt.cli import app
from jaxbelt.kernel.lanes import Observer, Variable
from jaxbelt.kernel.marks import Mark, code_of
from jaxbelt.numerics import programs
from jaxbelt.numerics.widths import SideBySide
from jaxbelt.sweeps import store, threads
from jaxbelt.sweeps.question import Question
from jaxbelt.sweeps.threads import CHUNK

NU0, NU1 = np.linspace(-0.6, 0.55, 4), np.array([0.35, -0.2])
AXES = {"nu0": NU0, "nu1": NU1}
SPAN = 40.0
final = functools.partial(jb.sweep, jb.presets.class_b, t1=SPAN)


@pytest.fixture(scope="module")
def dataset():
    return final(AXES)


def test_the_dataset_is_labelled(dataset):
    assert dict(dataset.sizes) == {"nu0": 4, "nu1": 2, "belt": 2}
    assert list(dataset) == ["x1_end", "x2_end", "mode_end", "n_events", "status"]
    assert dataset.x1_end.dims == ("nu0", "nu1") and dataset.mode_end.dims == ("nu0", "nu1", "belt")
    assert np.array_equal(dataset.nu0, NU0)
    assert dataset.nu0.attrs == {"long_name": "velocity of belt 0"}
    assert all(variable.attrs["long_name"] for variable in dataset.variables.values())
    told = dataset.attrs
    assert (told["t1"], told["rtol"], told["start"]) == (SPAN, 1e-8, "x1 = 3.0, x2 = 0.0")
    assert f"jaxbelt {jb.__version__}" in told["versions"] and "Conti(" in told["oscillator"]
    assert "velocity of belt 0" in str(dataset.nu0.attrs) and "x1_end" in repr(dataset)


@pytest.mark.slow(first=True)
def test_axes_of_starts_and_of_functions_with_fixed_arguments(dataset):
    make = functools.partial(jb.presets.class_b, nu1=0.35)
    starts = jb.sweep(make, {"x1": [1.0, 3.0], "nu0": NU0}, t1=SPAN)
    assert starts.x1_end.dims == ("x1", "nu0")
    # Another compiled program, in which nu1 is one number for all: other roundings.
    expected = dataset.x1_end.sel(nu1=0.35)
    np.testing.assert_allclose(starts.x1_end.sel(x1=3.0), expected, atol=1e-9)


@pytest.mark.slow(first=True)
def test_a_mass_at_rest_is_near_no_edge():
    # x1 = x2 = x2' = 0, between the intervals of two belts: no way is short against a speed of 0.
    law = jb.Conti(1.0, 0.6, 10.0)
    belts = jb.Belt(-0.9, law, lower=0.8), jb.Belt(0.3, law, upper=-0.82)
    rest = lists.swept([jb.Oscillator(0.25, belts)], y0=(0.0, 0.0), t1=50.0)
    assert (rest.status == Status.OK) & (rest.x1_end == 0) & (rest.x2_end == 0)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("observe", ["final", "attractor"])
def test_a_motion_that_grows_beyond_all_bounds_keeps_nobody_waiting(observe):
    """At 1e103 cubes overflow and steps become ever smaller; so many would be made until t1."""
    belts = jb.presets.class_b(0.3, 0.35).belts
    oscillators = [jb.Oscillator(damping, belts) for damping in (-0.1, 0.5)]
    dataset = lists.swept(oscillators, y0=(20.0, 5.0), t1=30_000.0, observe=observe)
    grows, settles = dataset.status.values.ravel()
    assert grows == Status.NOT_FINITE and settles == Status.OK


def test_many_chunks_lose_no_run():
    n = 2 * CHUNK.here + 1000
    many = jb.sweep(jb.presets.class_b, {"nu0": np.linspace(-0.7, 0.7, n), "nu1": [0.35]}, t1=2.0)
    assert np.sum(many.status == Status.OK) == n
    assert np.all(np.isfinite(many.x1_end))
    some = np.arange(0, n, 5000)
    alone = jb.sweep(jb.presets.class_b, {"nu0": many.nu0[some], "nu1": [0.35]}, t1=2.0)
    assert np.array_equal(alone.x1_end, many.x1_end[some])


@pytest.mark.slow
def test_derivatives_equal_those_of_simulate():
    options = dict(rtol=1e-12, atol=1e-12)
    swept = final(AXES, derivatives=("nu0",), **options)

    @jax.jit
    @jax.vmap
    def derivative(nu0, nu1):
        def end(nu0):
            osc, ts = jb.presets.class_b(nu0, nu1), jnp.array([SPAN])
            return jb.simulate(osc, (3.0, 0.0), SPAN, ts=ts, max_segments=256, **options).ys[0]

        return jax.jacfwd(end)(nu0)

    grid = np.meshgrid(NU0, NU1, indexing="ij")
    expected = derivative(*(jnp.asarray(part.ravel()) for part in grid)).reshape(4, 2, 2)
    # Relative to their size, which is up to some hundreds: the clock of a sticking run shears.
    size = 1 + np.max(np.abs(expected), axis=-1)
    for i, name in enumerate(("d_x1_end_d_nu0", "d_x2_end_d_nu0")):
        assert np.max(np.abs(swept[name].values - expected[..., i]) / size) < 1e-8


@pytest.mark.slow(first=True)
def test_derivatives_of_a_cycle_equal_differences_of_the_oracle():
    nu0, nu1 = 0.1, 0.35
    swept = jb.sweep(
        jb.presets.class_b,
        {"nu0": [nu0], "nu1": [nu1]},
        observe="attractor",
        derivatives=("nu0",),
        rtol=1e-11,
        atol=1e-11,
    ).squeeze()

    def there(name):
        def value(nu0):
            return getattr(oracle_cycles.sticking_cycle(oracle.class_b(nu0, nu1)), name)

        return oracle.richardson(value, nu0, 1e-2)[0]

    for name in ("period", "x1_min", "x1_max", "x2_max"):
        # The differences are good to 1e-9 or so; x2's extrema are interpolated, to 1e-8.
        np.testing.assert_allclose(swept[f"d_{name}_d_nu0"], there(name), atol=1e-7)


@pytest.mark.slow(first=True)
def test_what_is_undecided_tells_of_no_attractor(tmp_path):
    """A loop that is under way when time is up is none; and what is NaN has no derivative of 0."""
    arguments = jb.presets.class_a, {"nu0": [0.0, 0.1, 0.2, 0.45]}
    options = dict(observe="attractor", t1=10.0, derivatives=("nu0",))
    found = jb.sweep(*arguments, **options)
    kind = jb.decoded(found).kind.values
    assert kind.tolist() == ["stuck", "undecided", "undecided", "equilibrium"]
    undecided = kind == "undecided"
    told = ("period", "stick_duration", "x1_min", "x1_max", "x2_min", "x2_max", "transient")
    for name in told:
        value, slope = found[name].values, found[f"d_{name}_d_nu0"].values
        assert np.all(np.isnan(value[undecided]))
        assert name == "period" or not np.any(np.isnan(value[~undecided]))
        np.testing.assert_array_equal(np.isfinite(slope), np.isfinite(value))
    assert not np.any(found.sticks[undecided]) and np.all(found.sticks[0])
    assert np.all(found.n_events[undecided] > 0)
    assert np.all(found.status[undecided] == Status.NOT_SETTLED)
    stored = jb.sweep(*arguments, **options, store=tmp_path / "results.zarr")
    assert all(stored[name].load().equals(found[name]) for name in found)


class Sticks:
    """How often a run stuck to belt 1, and when something happened last."""

    def init(self, osc, x1, x2):
        return jnp.zeros(()), jnp.asarray(0.0)  # of a strong type, and of a weak one

    def update(self, state, event):
        stick = (event.kind == jb.EventKind.STICK) & (event.belt == 1)
        return state[0] + jnp.where(stick, 1.0, 0.0), event.t

    def finish(self, state, end):
        return {"sticks_to_1": state[0], "last": state[1], "end": jnp.stack([end.x1, end.x2])}


class Extent(Observer):
    """An observable of one class: the largest |x1| at the events of a run."""

    variables: ClassVar = {"extent": Variable("largest |x1| at an event")}

    def start(self, osc, lanes):
        return jnp.abs(lanes.x1)

    def watch(self, osc, lanes, passage, ones, t1, tol):
        return replace(lanes, memory=jnp.maximum(lanes.memory, jnp.abs(lanes.x1)))

    def finish(self, osc, lanes):
        return {"extent": lanes.memory, "status": lanes.status}


def test_an_observable_is_one_class():
    found = final(AXES, observe=Extent())
    assert found.extent.attrs["long_name"] == "largest |x1| at an event"
    assert np.all(found.extent >= 3.0 - 1e-12) and list(found) == ["extent", "status"]


@pytest.mark.slow(first=True)
def test_every_dataset_can_be_drawn_and_written(tmp_path, dataset):
    attractors = jb.sweep(jb.presets.class_b, AXES, observe="attractor")
    basins = jb.basins(jb.presets.class_b(0.45, 0.35), x1=[1.36, 3.0], x2=[0.0]).dataset
    for one, variable in ((dataset, "status"), (attractors, "kind"), (basins, "label")):
        one[variable].plot()
        one.to_netcdf(tmp_path / "one.nc", engine="scipy")
        one.to_zarr(tmp_path / "one.zarr", mode="w", consolidated=False)
        for read in (
            xr.open_dataset(tmp_path / "one.nc", engine="scipy"),
            xr.open_zarr(tmp_path / "one.zarr", consolidated=False),
        ):
            assert read.load().equals(one)
            assert jb.decoded(read).equals(jb.decoded(one))
    words = jb.decoded(attractors)
    assert set(words.kind.values.ravel()) <= {"undecided", "equilibrium", "cycle", "stuck"}
    assert np.array_equal(words.kind == "cycle", attractors.kind == 2)
    assert set(jb.decoded(basins).label.values.ravel()) == {
        "rest_at_1.362",
        "cycle_that_sticks_to_belt_1",
    }
    assert jb.decoded(dataset).mode_end.values.ravel()[0].startswith("slips")


def test_a_sweep_is_explained_without_doing_it(monkeypatch):
    monkeypatch.setattr(store, "BLOCK_RUNS", 4)
    found = jb.explain(jb.presets.class_b, AXES, t1=SPAN)
    assert (found.runs, found.blocks) == (8, 2) and found.seconds > 0
    assert found.bytes == final(AXES).nbytes
    assert "8 runs in 2 blocks" in repr(found)
    with pytest.raises(ValueError, match="t1 must be given"):
        jb.explain(jb.presets.class_b, AXES)


@pytest.mark.slow(first=True)
def test_a_dataset_of_attractors_is_as_large_as_explained():
    """Its signatures are numbered, in fewer bytes than the codes that runs hand in."""
    options = dict(observe="attractor", derivatives="nu0")
    found = jb.explain(jb.presets.class_b, AXES, **options)
    assert found.bytes == jb.sweep(jb.presets.class_b, AXES, **options).nbytes


def test_progress_is_shown_where_it_is_wanted(capsys):
    final(AXES, progress=True)
    shown = " ".join(capsys.readouterr().err.split())
    assert "sweep" in shown and "8 of 8 runs" in shown
    final({**AXES, "nu1": [np.nan]}, progress=True)
    assert "4 not_finite" in " ".join(capsys.readouterr().err.split())
    final(AXES)
    assert capsys.readouterr().err == ""  # this is no terminal


def test_a_reducer_sees_every_event(dataset):
    with compilations() as compiled:
        reduced = final(AXES, observe=Sticks())
    assert compiled.count("jit(advance)") == 1
    for i, nu0 in enumerate(NU0.tolist()):
        run = oracle.simulate(oracle.class_b(nu0, 0.35), (3.0, 0.0), SPAN)
        sticks = [event for event in run.events if (event.kind, event.belt) == ("STICK", 1)]
        assert reduced.sticks_to_1[i, 0] == len(sticks)
        # Here at 1e-8, there at 1e-13.
        np.testing.assert_allclose(reduced["last"][i, 0], run.events[-1].t, atol=1e-5)
    # Not skipping loops changes nothing but the sum of the rounding of the clock.
    np.testing.assert_allclose(reduced.end[..., 0], dataset.x1_end, atol=1e-9)


@pytest.mark.parametrize(
    "options, message",
    [
        (
            dict(axes={"nu2": [1.0]}),
            r"axes must be arguments of make \(nu0, nu1\), x1 or x2, got 'nu2'",
        ),
        (dict(axes={}), r"axes must be a dictionary of values, got \{\}"),
        (dict(axes={"nu0": 0.3, "nu1": [0.2]}), r"axis nu0 must be of shape \(n\)"),
        (dict(axes={"nu0": [], "nu1": [0.2]}), "axis nu0 must be at least one value"),
        (dict(rtol=0.0), "rtol must be > 0"),
        (dict(t1=-1.0), "t1 must be > 0"),
        (dict(t1=None), "t1 must be given"),
        (dict(y0=(np.nan, 0.0)), "y0 must be finite"),
        (dict(observe="end"), 'observe must be "final", "attractor" or an object'),
        (dict(derivatives=("mu",)), "derivatives must be names of axes, nu0, nu1, got 'mu'"),
        (dict(make=lambda nu0, nu1: nu0), "make must be a function that returns an Oscillator"),
    ],
)
def test_impossible_arguments_are_named(options, message):
    arguments = {"make": jb.presets.class_b, "axes": AXES, "t1": 1.0, **options}
    with pytest.raises(ValueError, match=message):
        jb.sweep(arguments.pop("make"), arguments.pop("axes"), **arguments)


def test_the_command_writes_data_and_a_picture(tmp_path):
    runner, out = CliRunner(), tmp_path / "plane.nc"
    axes = ["nu0=-0.4:0.4:2", "nu1=0.3:0.35:2"]
    done = runner.invoke(app, ["sweep", *axes, "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    written = xr.open_dataset(out, engine="scipy")
    assert written.kind.dims == ("nu0", "nu1") and np.all(jb.decoded(written).kind == "cycle")
    done = runner.invoke(app, ["sweep", *axes, "--dry-run", "--out", str(tmp_path / "no" / "a.nc")])
    assert done.exit_code == 0 and "4 runs in 1 blocks" in done.output
    assert not (tmp_path / "no").exists()
    kept = tmp_path / "plane.zarr"
    done = runner.invoke(app, ["sweep", *axes, "--out", str(kept)])
    assert done.exit_code == 0 and xr.open_zarr(kept).kind.equals(written.kind)
    done = runner.invoke(app, ["sweep", *axes, "--out", str(kept), "--json"])
    assert json.loads(done.stdout)["status"] == {"ok": 4}
    done = runner.invoke(app, ["verify", str(kept)])
    assert done.exit_code == 0 and "1 blocks right, 0 to do, 0 bad; finished" in done.output
    (kept / "period" / "c" / "0" / "0").write_bytes(b"nothing")
    done = runner.invoke(app, ["verify", str(kept)])
    assert done.exit_code == 1 and "1 bad (0)" in done.output
    done = runner.invoke(app, ["sweep", *axes, "--out", str(tmp_path)])
    assert done.exit_code == 2 and "out must end in .nc or .zarr" in done.output
    done = runner.invoke(app, ["sweep", "nu0=0.1:0.2", "--out", str(out)])
    assert (
        done.exit_code == 2 and "NAME=FROM:TO:COUNT or NAME=VALUE, got 'nu0=0.1:0.2'" in done.output
    )


def with_steepness(nu0, steepness):
    law = jb.Conti(static=1.0, residual=0.6, steepness=steepness)
    return jb.Oscillator(0.5, (jb.Belt(nu0, law),))


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (jb.presets.class_a, "jaxbelt.presets.class_a"),
        (
            functools.partial(jb.presets.class_b, nu1=np.float64(0.35)),
            "functools.partial(jaxbelt.presets.class_b, nu1=0.35)",
        ),
        (functools.partial(with_steepness, steepness=9.0), None),
        (lambda nu0: jb.presets.class_b(nu0, 0.3), None),
    ],
)
def test_attributes_tell_how_to_ask_again(make, name):
    axes = {"nu0": [0.1, 0.2]}
    question = Question.of(make, axes, (3.0, 0.0), 10.0, 1e-8, 1e-8, "final", ())
    told = question.attributes()
    assert name is None or told["make"] == name
    asked = {}
    modules = {"functools": functools, __name__: sys.modules[__name__], "dataset": axes}
    if getattr(make, "__name__", "") == "<lambda>":
        assert "lambda nu0: jb.presets.class_b(nu0, 0.3)" in told["make"]
        modules["make"] = make
    else:
        assert told["make"] in told["call"]
    modules["jaxbelt"] = SimpleNamespace(
        presets=jb.presets, sweep=lambda *args, **named: asked.update(args=args, **named)
    )
    eval(told["call"], modules)
    again = asked.pop("args")
    osc, same = (one(0.3) if one is make else one(nu0=0.3) for one in (make, again[0]))
    assert repr(osc) == repr(same) and again[1] == axes
    assert asked == {
        "y0": (3.0, 0.0), "t1": 10.0, "rtol": 1e-8, "atol": 1e-8, "observe": "final",
        "derivatives": (),
    }  # fmt: skip


def test_calls_are_python_whatever_the_function_is_called():
    def inner(nu0):
        return jb.presets.class_a(nu0)

    pair = (
        lambda nu0: jb.presets.class_a(nu0), lambda nu0: jb.presets.class_b(nu0, 0.3)
    )  # fmt: skip
    for make, name in ((inner, "inner"), (pair[0], "make")):
        call = Question.of(make, {"nu0": [0.1]}, (3.0, 0.0), 9.0, 1e-8, 1e-8, "final", ()).call()
        ast.parse(call, mode="eval")
        assert call.startswith(f"jaxbelt.sweep({name}, ")


def test_one_start_is_told_not_to_show_every_attractor():
    arguments = {"nu0": [0.1]}, (3.0, 0.0), None, 1e-8, 1e-8, "attractor", ()
    alone = Question.of(jb.presets.class_a, *arguments).attributes()["start"]
    assert "x1 = 3.0, x2 = 0.0: of several attractors the one" in alone
    several = Question.of(jb.presets.class_a, {"nu0": [0.1], "x1": [1.0, 2.0]}, *arguments[1:])
    assert several.attributes()["start"] == "x2 = 0.0"


def test_more_runs_than_are_counted_are_refused_at_once():
    axes = {"nu0": np.array([0.1, 0.2])}
    program = Question.of(
        jb.presets.class_a, axes, (3.0, 0.0), 1.0, 1e-8, 1e-8, "final", ()
    ).program
    settings = dict(t1=1.0, rtol=1e-8, atol=1e-8, derivatives=2)
    with pytest.raises(ValueError, match=r"axes must be .* or fewer .*, got 2147483648"):
        threads.run(program, [], np.zeros, 2**31, print, **settings)


@pytest.mark.slow(first=True)
def test_several_derivatives_are_each_by_itself(monkeypatch):
    """Also where the runs are in many chunks, and a long one ends in a later chunk."""
    monkeypatch.setattr(threads, "CHUNK", SideBySide(96, 96))
    axes = {"nu0": np.linspace(-0.6, 0.6, 20), "nu1": np.linspace(-0.5, 0.5, 15)}

    def sweep(*names):
        return jb.sweep(jb.presets.class_b, axes, t1=30.0, derivatives=names)

    both = sweep("nu0", "nu1")
    for name in ("nu0", "nu1"):
        one = sweep(name)
        for variable in one.variables:
            np.testing.assert_array_equal(both[variable], one[variable])


# --- audits ---------------------------------------------------------------------------------------


def test_huge_loads_do_not_stop_a_sweep():
    law = jb.Conti(1.0, 0.6, 10.0)
    osc = jb.Oscillator(0.5, (jb.Belt(0.3, law, 1e8), jb.Belt(0.3, law, 0.0)))
    found = lists.swept([osc], y0=(3.0, 0.0), t1=50.0)
    # It sticks at once (after 4e-9) and is carried along.
    assert found.status == Status.OK and found.n_events == 1
    np.testing.assert_allclose(found.x1_end, 3.0 + 0.3 * 50.0, rtol=0, atol=1e-7)


# --- audits ---------------------------------------------------------------------------------------

AUDITED = {"nu0": np.array([0.2, 0.4, 0.6]), "nu1": np.array([-0.9, -0.4, 0.3])}


@pytest.mark.parametrize("observe", ["final", "attractor"])
def test_audits_find_nothing(observe):
    found = jb.sweep(
        jb.presets.class_b, AUDITED, t1=200.0, observe=observe, audit=0.5, progress=False
    )
    assert (found.attrs["audited"], found.attrs["audit_differed"]) == (5, 0)


@pytest.mark.parametrize(
    "observe",
    [
        pytest.param("final", marks=pytest.mark.slow(first=True)),
        pytest.param("attractor", marks=pytest.mark.slow),
    ],
)
def test_audits_find_repeats_that_are_none(observe, monkeypatch):
    def in_part(mark, lanes, close):
        same = code_of(lanes.mode) == mark.code
        return same & (abs(lanes.x1 - mark.x1) <= close)

    monkeypatch.setattr(Mark, "met_by", in_part)
    # A kept program would be one without the change, or be kept with it.
    monkeypatch.setattr(programs, "ON", False)
    programs.are_kept.cache_clear()
    threads.compiled.cache_clear()
    with pytest.warns(UserWarning, match="1 of 9 audited runs differ .* indices \\(2, 0\\)"):
        found = jb.sweep(
            jb.presets.class_b, AUDITED, t1=60.0, observe=observe, audit=1.0, progress=False
        )
    threads.compiled.cache_clear()
    programs.are_kept.cache_clear()
    assert found.attrs["audit_differed"] == 1


def test_what_cannot_be_audited_is_refused():
    with pytest.raises(ValueError, match="audit must be a share from 0 to 1, got 2"):
        jb.sweep(jb.presets.class_b, AUDITED, t1=1.0, audit=2.0)


@pytest.mark.slow(first=True)
def test_an_impossible_oscillator_has_no_final_state():
    """It was the start."""

    def make(frequency):
        belt = jb.Belt(0.3, jb.Coulomb(1.0, 0.8), load=1.0)
        return jb.Oscillator(0.1, (belt,), forcing=jb.Harmonic(0.9, frequency))

    found = jb.sweep(make, {"frequency": [1.3, -1.0, np.nan]}, y0=(0.5, 0.0), t1=10.0)
    assert list(found.status.values[1:]) == [jb.Status.NOT_FINITE] * 2
    assert np.isfinite(found.x1_end[0]) and np.all(np.isnan(found.x1_end[1:]))
    assert np.all(np.isnan(found.x2_end[1:]))
