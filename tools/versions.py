"""Builds the package and tests the wheel: on every Python, and with the oldest dependencies.

`python -m tools.versions`, with `uv` installed (the group `release`), before a release. The wheel
is built from the source distribution. The tests are those of the source distribution, without the
package's source beside them, so that they import the installed wheel. Names of environments as
arguments choose among them. By default only those tests run that depend most on other packages;
with `--whole` all that the README's test command runs, except the tests of the source itself.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: Environments by name: version of Python, and uv's choice of versions of the dependencies.
ENVIRONMENTS = {
    "oldest": ("3.11", "lowest-direct"),
    "3.11": ("3.11", "highest"),
    "3.12": ("3.12", "highest"),
    "3.13": ("3.13", "highest"),
}
PART = "cli clusters explorer machine messages modes parameters plotting results store".split()


def run(*command: str | Path, cwd: Path) -> int:
    """Prints a command, runs it without PYTHONPATH (other code), and returns its exit code."""
    print("==", *command, flush=True)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return subprocess.run(command, cwd=cwd, env=environment).returncode


def built(folder: Path) -> tuple[Path, Path]:
    """Paths of the wheel and of the unpacked source distribution without the package, both new."""
    if run("uv", "build", "--quiet", "--out-dir", folder, cwd=ROOT):
        sys.exit("it cannot be built")
    (archive,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    with tarfile.open(archive) as files:
        files.extractall(folder, filter="data")
    source = folder / archive.name.removesuffix(".tar.gz")
    shutil.rmtree(source / "jaxbelt")
    return wheel, source


def tested(name: str, wheel: Path, source: Path, tests: list[str]) -> bool:
    """Whether the wheel can be installed and used alone in an environment, and the tests pass."""
    version, resolution = ENVIRONMENTS[name]
    environment = source.parent / name
    python = environment / "bin" / "python"
    install = ("uv", "pip", "install", "--quiet", "--python", python, "--resolution", resolution)
    steps = [
        ("uv", "venv", "--quiet", "--no-python-downloads", "--python", version, environment),
        # `lowest-direct` is for named packages: those of pyproject.toml, then the wheel alone.
        (*install, "-r", "pyproject.toml"),
        (*install, "--no-deps", wheel),
        (environment / "bin" / "jaxbelt", "simulate", "--t1", "10", "--out", "run"),
        (*install, "-r", "pyproject.toml", "--group", "test"),
        (python, "-m", "pytest", "-q", "-n", "auto", "--dist", "worksteal", *tests),
    ]
    return not any(run(*step, cwd=source) for step in steps)


def main() -> None:
    """Tests the chosen environments; exits with 1 unless all of them pass."""
    # A shell's background jobs ignore interrupts, and so would the tests that send some.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(ENVIRONMENTS))
    parser.add_argument("--whole", action="store_true", help="all tests, and not a part of them")
    options = parser.parse_args()
    if unknown := set(options.names) - ENVIRONMENTS.keys():
        parser.error(f"there is no {', '.join(sorted(unknown))}")
    tests = ["--ignore=tests/test_package.py"] if options.whole else []
    tests = tests or [f"tests/test_{name}.py" for name in PART]
    with tempfile.TemporaryDirectory() as folder:
        wheel, source = built(Path(folder))
        passed = {
            name: tested(name, wheel, source, tests) for name in options.names or ENVIRONMENTS
        }
    print(*(f"{name}: {'passed' if fine else 'FAILED'}" for name, fine in passed.items()), sep="\n")
    sys.exit(not all(passed.values()))


if __name__ == "__main__":
    main()
