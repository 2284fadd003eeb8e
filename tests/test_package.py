"""The package as a whole: the ladder of its modules, its import, its version, its README."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

import jaxbelt

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxbelt"

# Read from top to bottom: a module imports only from lines above its own.
LADDER = (
    "results",
    "processes",
    "checks",
    "compiling",
    "friction",
    "oscillator",
    "parameters",
    "modes",
    "presets",
    "continuation",
    "derivatives",
    "extrapolation",
    "roots",
    "smoothing",
    "simulate",
    "batch",
    "audit",
    "equilibria",
    "cycles",
    "attractors",
    "functionals",
    "sweep",
    "bifurcations",
    "switch_folds",
    "detection",
    "curves",
    "diagrams",
    "basins",
    "inverse",
    "plotting",
    "reproduce",
    "__init__",
    "cli",
    "__main__",
)
MODULES = sorted(
    path.relative_to(PACKAGE).with_suffix("").as_posix() for path in PACKAGE.rglob("*.py")
)


def imported_names(module: str) -> Iterator[str]:
    """Full names of what a module of the package imports, also inside its functions."""
    for node in ast.walk(ast.parse((PACKAGE / f"{module}.py").read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            # The package is flat, so a leading dot is the package.
            parts = ("jaxbelt" if node.level else None, node.module)
            source = ".".join(part for part in parts if part)
            yield from (f"{source}.{alias.name}" for alias in node.names)


def rung(name: str) -> str:
    """The module that a full name inside the package belongs to; the package itself is __init__."""
    part = name.removeprefix("jaxbelt").lstrip(".").partition(".")[0]
    return part if part in LADDER else "__init__"


@pytest.mark.parametrize("module", MODULES)
def test_module_imports_only_from_above_it(module: str):
    assert module in LADDER, f"{module}.py has no place in the ladder of modules"
    inside = [name for name in imported_names(module) if name.partition(".")[0] == "jaxbelt"]
    above = LADDER[: LADDER.index(module)]
    assert [name for name in inside if rung(name) not in above] == []


@pytest.mark.parametrize("module", [module for module in MODULES if module != "plotting"])
def test_matplotlib_is_imported_by_plotting_only(module: str):
    roots = {name.partition(".")[0] for name in imported_names(module)}
    assert roots.isdisjoint({"matplotlib", "mpl_toolkits"})


def test_importing_jaxbelt_is_light_and_leaves_the_settings_of_jax_alone():
    program = """
import sys, jax
before = jax.config.values.copy()
import jaxbelt
heavy = {"matplotlib", "optax", "pandas", "scipy.ndimage", "scipy.optimize", "xarray"}
print(sorted(heavy & sys.modules.keys()), jax.config.values == before)
"""
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120
    )
    assert run.stdout.split() == ["[]", "True"]


def test_version_is_that_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert jaxbelt.__version__ == importlib.metadata.version("jaxbelt") == project["version"]
    assert f"## [{project['version']}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"\nversion: {project['version']}\n" in (ROOT / "CITATION.cff").read_text(
        encoding="utf-8"
    )


def readme_command(mark: str) -> str:
    """The one line of the README's fenced block after the comment `<!-- mark -->`."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (command,) = re.findall(rf"^<!-- {mark} -->\n```bash\n(.+)\n```$", readme, re.MULTILINE)
    return command


def test_readme_reproduces_the_paper_in_one_line():
    (script,) = importlib.metadata.entry_points(group="console_scripts", name="jaxbelt")
    assert script.value == "jaxbelt.cli:app"
    assert readme_command("reproduce").endswith("&& .venv/bin/jaxbelt reproduce")


def test_examples_of_the_readme_run():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    examples = re.findall(r"^```python\n(.+?)^```$", readme, re.MULTILINE | re.DOTALL)
    assert examples
    exec(compile("\n".join(examples), "README.md", "exec"), {})
    plt.close("all")


def test_ci_runs_the_test_command_of_the_readme():
    """The lines of .ci/run that read the command find it, its exit code counts, and pytest is
    started nowhere else."""
    ci = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    (extraction,) = re.findall(r"^command=.*$", ci, re.MULTILINE)
    run = subprocess.run(
        ["bash", "-c", f'{extraction}\nprintf %s "$command"'],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert run.stdout == readme_command("tests")
    assert ci.count("$command") == 3  # looked at, shown, run
    assert 'bash -euo pipefail -c "$command") || tested=$?' in ci
    assert ci.rstrip().endswith("exit $((tested || linted))")
    assert "pytest" not in ci


def test_every_public_name_has_its_place_in_the_reference():
    pages = (ROOT / "docs" / "api").glob("*.md")
    written = [page.read_text(encoding="utf-8") for page in pages]
    named = {
        name.rpartition(".")[2]
        for text in written
        for name in re.findall(r"^::: jaxbelt\.(\S+)$", text, re.MULTILINE)
    }
    assert set(jaxbelt.__all__) - named == {"presets"}
