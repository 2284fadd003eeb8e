"""Compiled programs that are kept on disk: the same results, and nothing on the disk does harm."""

import errno
import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kept import X, campaign, harmed, powers

import jaxbelt as jb
from jaxbelt.numerics import compiling, programs


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "ON", True)
    monkeypatch.setenv("JAXBELT_CACHE_DIR", str(tmp_path))
    programs._usable_folder.cache_clear()
    programs.are_kept.cache_clear()
    yield tmp_path / "programs"
    programs._usable_folder.cache_clear()
    programs.are_kept.cache_clear()


def files(folder):
    return sorted(folder.glob("*" + programs.SUFFIX))


def fresh():
    """The function as another process finds it."""
    return compiling.jit(powers)


def compiled_names(function, *args):
    names = []

    def listen(name, *_, fun_name="", **__):
        if name.endswith("backend_compile_duration"):
            names.append(fun_name)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        function(*args)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    return [name for name in names if "powers" in name]


def test_a_program_is_compiled_once_and_loaded_then(folder):
    assert len(compiled_names(fresh(), X, 3)) == 1
    assert len(files(folder)) == 1
    assert compiled_names(fresh(), X, 3) == []
    assert (
        fresh()(X, 3)["sum"].tobytes() == jax.jit(powers, static_argnums=1)(X, 3)["sum"].tobytes()
    )


@pytest.mark.parametrize(
    "args",
    [(X, 4), (X[:9], 3), (X.astype(np.float32), 3), (X, True), (X, 3.0)],
    ids=["number", "shape", "single", "a flag", "a float"],
)
def test_what_it_is_called_with_makes_another_program(folder, args):
    fresh()(X, 3)
    fresh()(X, 1)
    try:
        compiled_names(fresh(), *args)
    except TypeError:  # range(3.0)
        assert len(files(folder)) == 2
        return
    assert len(files(folder)) == 3


def test_weak_types_make_another_program(folder):
    strong, weak = jnp.ones(()), jnp.asarray(1.0)
    assert not strong.weak_type
    assert weak.weak_type or jnp.add(1.0, 1.0).weak_type
    weak = weak if weak.weak_type else jnp.add(1.0, 1.0)
    fresh()(strong[None], 1)
    before = len(files(folder))
    compiling.jit(_doubled)(strong)
    compiling.jit(_doubled)(weak)
    assert len(files(folder)) == before + 2


def _doubled(x):
    return 2 * x


@pytest.mark.parametrize(
    "change",
    [
        ("_sources", lambda: "other"),
        ("_processor", lambda: "another processor"),
        ("PACKAGES", ["jax"]),
    ],
    ids=["source", "processor", "versions"],
)
def test_surroundings_make_another_program(folder, monkeypatch, change):
    fresh()(X, 2)
    programs.surroundings.cache_clear()
    monkeypatch.setattr(programs, *change)
    assert len(compiled_names(fresh(), X, 2)) == 1
    assert len(files(folder)) == 2
    monkeypatch.undo()
    programs.surroundings.cache_clear()


def test_a_constant_that_was_changed_makes_another_program(folder, monkeypatch):
    fresh()(X, 2)
    monkeypatch.setattr("jaxbelt.kernel.step.SLOW", 0.2)
    assert len(compiled_names(fresh(), X, 2)) == 1
    assert len(files(folder)) == 2


def test_settings_make_another_program(folder):
    fresh()(X, 2)
    with jax.default_matmul_precision("float32"):
        fresh()(X, 2)
    assert len(files(folder)) == 2


def test_what_watches_numbers_is_compiled_as_ever(folder):
    with jax.debug_nans(True):
        with pytest.raises(FloatingPointError):
            compiling.jit(lambda x: jnp.log(-x))(X)
        fresh()(X, 2)
    assert files(folder) == []


class Law(jb.AbstractFriction):
    """A law of a user's own."""

    static: jax.Array
    slope: jax.Array

    def mu(self, speed):
        return self.static - self.slope * speed / (1 + speed)


def _own(osc, factor):
    return jax.tree.map(lambda leaf: factor * leaf, osc)


def test_a_law_of_ones_own_comes_back_in_results(folder):
    osc = jb.Oscillator(damping=0.5, belts=(jb.Belt(0.2, Law(jnp.ones(()), jnp.ones(()) / 2)),))
    first = compiling.jit(_own)(osc, np.float64(2.0))
    second = compiling.jit(_own)(osc, np.float64(2.0))
    assert len(files(folder)) == 1
    assert type(first.belts[0].friction) is type(second.belts[0].friction) is Law
    assert float(second.belts[0].friction.slope) == 1.0


def test_another_law_of_the_same_name_is_another_program(folder):
    def law(power):
        class Local(Law):
            def mu(self, speed):
                return self.static - self.slope * speed**power

        return Local(jnp.ones(()), jnp.ones(()))

    found = [
        float(compiling.jit(lambda law, x: law.mu(x))(law(n), np.float64(0.5))) for n in (1, 2)
    ]
    assert found == [0.5, 0.75]


def test_what_has_no_fingerprint_is_compiled_as_ever(folder):
    open_file = (n for n in range(3))
    assert float(compiling.jit(lambda x: x + float(open_file is not None))(np.float64(1.0))) == 2.0
    assert files(folder) == []


def test_callbacks_are_not_kept(folder):
    def called(x):
        return jax.pure_callback(lambda x: np.asarray(x) + 1, jax.ShapeDtypeStruct((), x.dtype), x)

    assert float(compiling.jit(called)(np.float64(1.0))) == 2.0
    assert float(compiling.jit(called)(np.float64(1.0))) == 2.0
    assert files(folder) == []


def test_linear_algebra_runs_in_a_process_that_compiled_nothing(folder, tmp_path):
    script = """
import sys, jax, numpy as np
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, sys.argv[1])
from jaxbelt.numerics import compiling
from solving import solve
print(compiling.jit(solve)(np.array([[2.0, 1.0], [1.0, 3.0]]), np.ones(2)).tolist())
"""
    (tmp_path / "solving.py").write_text(
        "import jax.numpy as jnp\n\ndef solve(a, b):\n    return jnp.linalg.solve(a, b)\n"
    )
    environment = os.environ | {"JAXBELT_CACHE": "1", "JAXBELT_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", script, str(tmp_path)]
    options = dict(env=environment, capture_output=True, text=True, check=True)
    outputs = {subprocess.run(command, **options).stdout for _ in range(2)}
    assert len(outputs) == 1 and "[0.4, 0.2" in outputs.pop()
    assert len(files(folder)) == 1


@pytest.mark.slow(first=True)
def test_a_users_own_cache_of_jax_does_no_harm(folder, tmp_path):
    """A program that came out of JAX's cache could not be loaded again."""
    script = """
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
import jaxbelt as jb
print(np.asarray(jb.equilibria(jb.presets.class_b(0.45, 0.35)).x1_lower).tobytes().hex())
"""
    environment = os.environ | {
        "JAXBELT_CACHE": "1",
        "JAXBELT_CACHE_DIR": str(tmp_path),
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "jax"),
    }
    command = [sys.executable, "-W", "error", "-c", script]
    options = dict(env=environment, capture_output=True, text=True, check=True)
    found = []
    for _ in range(3):
        found.append(subprocess.run(command, **options).stdout)
        if len(found) == 1:
            for path in files(folder):
                path.unlink()
    assert len(set(found)) == 1 and files(folder)


# --- the folder and its files ---------------------------------------------------------------------


def test_damaged_files_are_recognised_and_compiled_anew(folder, caplog):
    rng, wanted = random.Random(0), fresh()(X, 3)["sum"].tobytes()
    (path,) = files(folder)
    whole = path.read_bytes()
    for _ in range(100):
        path.write_bytes(harmed(whole, rng))
        caplog.clear()
        assert programs.load(path.stem, ((programs.HOLE, 3), {})) is None
        assert "compiled anew" in caplog.text and not path.exists()
    assert fresh()(X, 3)["sum"].tobytes() == wanted and path.exists()


def test_a_file_under_the_name_of_another_is_recognised(folder):
    fresh()(X, 3)
    fresh()(X, 4)
    first, second = files(folder)
    first.replace(second)
    assert programs.load(second.stem, None) is None and not second.exists()


def test_a_pickle_that_is_none_is_recognised(folder, caplog):
    fresh()(X, 3)
    (path,) = files(folder)
    programs._write(path, path.stem, b"no pickle")
    assert len(compiled_names(fresh(), X, 3)) == 1
    assert "cannot be loaded" in caplog.text


def test_folders_of_others_are_not_used(folder, monkeypatch, caplog):
    fresh()(X, 3)
    programs._usable_folder.cache_clear()
    monkeypatch.setattr(os, "getuid", lambda: os.stat(folder).st_uid + 1)
    assert programs.folder() is None and "belongs to another user" in caplog.text
    assert len(compiled_names(fresh(), X, 3)) == 1


@pytest.mark.parametrize("mode", [0o755, 0o770, 0o701])
def test_folders_that_others_may_use_are_not_used(folder, mode, caplog):
    fresh()(X, 3)
    programs._usable_folder.cache_clear()
    folder.chmod(mode)
    assert programs.folder() is None and "0700" in caplog.text
    fresh()(X, 3)


def test_a_link_is_not_used(folder, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    folder.symlink_to(elsewhere)
    assert programs.folder() is None


def test_the_folder_is_the_users_alone(folder):
    fresh()(X, 3)
    assert folder.stat().st_mode & 0o777 == 0o700


def test_a_home_that_cannot_be_written_does_no_harm(tmp_path, folder, monkeypatch, caplog):
    (tmp_path / "file").touch()
    monkeypatch.setenv("JAXBELT_CACHE_DIR", str(tmp_path / "file" / "below"))
    fresh()(X, 3)
    assert "not kept" in caplog.text


def test_a_full_disk_does_no_harm(folder, monkeypatch, caplog):
    class Full:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            return None

        def write(self, data):
            raise OSError(errno.ENOSPC, "No space left on device")

    folder.parent.mkdir(exist_ok=True)
    programs.folder()
    real = Path.open
    choose = lambda self, mode: Full() if mode == "wb" else real(self, mode)  # noqa: E731
    monkeypatch.setattr(Path, "open", choose)
    assert fresh()(X, 3)["count"] == 3
    monkeypatch.undo()
    assert "No space left" in caplog.text
    assert not list(folder.iterdir()) if folder.exists() else True


def test_the_least_recently_used_go(folder, monkeypatch):
    for n in range(1, 6):
        fresh()(X, n)
    old = time.time() - 1000
    for i, path in enumerate(files(folder)):
        os.utime(path, (old + i, old + i))
    least = programs.entries()[0].path
    kept = programs.entries()[1].path
    assert programs._read(kept, kept.stem)  # used
    (folder / "dead.part").touch()
    os.utime(folder / "dead.part", (old - 10_000, old - 10_000))
    monkeypatch.setattr(programs, "BOUND", sum(one.size for one in programs.entries()))
    fresh()(X, 6)
    assert not least.exists() and kept.exists() and not (folder / "dead.part").exists()
    assert sum(one.size for one in programs.entries()) <= programs.BOUND


@pytest.mark.slow(first=True)
@pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
def test_processes_killed_at_random_leave_nothing_wrong(tmp_path):
    assert campaign(tmp_path, kills=12, seed=0)


# --- commands and switches ------------------------------------------------------------------------


def command(tmp_path, *words, **environment):
    environment = os.environ | {"JAXBELT_CACHE_DIR": str(tmp_path)} | environment
    code = "import sys; from jaxbelt.cli import app; app(sys.argv[1:])"
    run = subprocess.run(
        [sys.executable, "-c", code, *words], env=environment, capture_output=True, text=True
    )
    return run.returncode, run.stdout + run.stderr


def test_the_command_tells_and_clears(folder, tmp_path):
    fresh()(X, 3)
    on = {"JAXBELT_CACHE": "1"}
    code, text = command(tmp_path, "cache", "--json", **on)
    told = json.loads(text)
    assert code == 0 and told["programs"] == 1 and told["bytes"] == files(folder)[0].stat().st_size
    code, text = command(tmp_path, "cache", "--clear", **on)
    assert code == 0 and "1 programs removed" in text and files(folder) == []


def test_it_can_be_switched_off(tmp_path):
    code, text = command(tmp_path, "cache", JAXBELT_CACHE="0")
    assert code == 0 and "switched off" in text and not list(tmp_path.iterdir())
    code, text = command(tmp_path, "warm", JAXBELT_CACHE="0")
    assert code == 2 and "JAXBELT_CACHE=0" in text
