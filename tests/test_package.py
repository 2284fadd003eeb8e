"""The package as a whole: the ladder of its modules, its import, its version, its README."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

import jaxbelt

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxbelt"

MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
FOLDERS = {module for module in MODULES if module.endswith(".__init__")}


def ladder() -> list[str]:
    """The modules in the order of the package's docstring; a line of a folder lists its modules."""
    (text,) = re.findall(r"(?<=\n\n)(?: {4}\S.*\n)+", ast.get_docstring(ast.parse(init())) + "\n")
    rungs = []
    for line in text.splitlines():
        name, words = line.split(maxsplit=1)
        rungs += [f"{name[:-1]}.{m}" for m in words.split()] if name.endswith("/") else [name]
    return rungs


def init() -> str:
    return (PACKAGE / "__init__.py").read_text(encoding="utf-8")


LADDER = ladder()


def imported_names(module: str) -> Iterator[str]:
    """Full names of what a module of the package imports, also inside its functions."""
    package = ["jaxbelt", *module.split(".")[:-1]]
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            yield from (f"{source}.{alias.name}" for alias in node.names)


def rung(name: str) -> str:
    """The module that a full name inside the package belongs to; the package itself is __init__."""
    parts = name.split(".")[1:]
    for length in (2, 1):
        if ".".join(parts[:length]) in LADDER:
            return ".".join(parts[:length])
    return "__init__"


def test_every_module_has_its_place_in_the_ladder_of_the_docstring():
    assert sorted(LADDER) == sorted(MODULES.keys() - FOLDERS)


@pytest.mark.parametrize("folder", sorted(FOLDERS))
def test_folders_have_a_docstring_and_nothing_else(folder: str):
    tree = ast.parse(MODULES[folder].read_text(encoding="utf-8"))
    assert len(tree.body) == 1 and ast.get_docstring(tree)


@pytest.mark.parametrize("module", LADDER)
def test_module_imports_only_from_above_it(module: str):
    inside = [name for name in imported_names(module) if name.partition(".")[0] == "jaxbelt"]
    above = LADDER[: LADDER.index(module)]
    assert [name for name in inside if rung(name) not in above] == []


def defined_names(module: str) -> set[str]:
    """What a module defines at its top level."""
    names = set()
    for node in ast.parse(MODULES[module].read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            leaves = (leaf for target in targets for leaf in ast.walk(target))
            names |= {leaf.id for leaf in leaves if isinstance(leaf, ast.Name)}
    return names


def test_no_two_modules_define_different_things_under_one_name():
    """But for commands, each named as the function that it calls. Nor does what comes from another
    package have a name that is defined here."""
    defined = {module: defined_names(module) for module in LADDER}
    for module in LADDER:
        if module.startswith("commands."):
            defined[module] -= {*jaxbelt.__all__, "reproduce"}
    times = Counter(
        name for names in defined.values() for name in {name.lstrip("_") for name in names} - {""}
    )
    assert [name for name in times if times[name] > 1] == []
    foreign = {
        name.rpartition(".")[2]
        for module in LADDER
        for name in imported_names(module)
        if name.partition(".")[0] != "jaxbelt"
    }
    assert foreign & set().union(*defined.values()) == set()


#: Ways to import a module, or to reach an imported one, that import statements do not show.
HIDDEN_WAYS = {"__import__", "eval", "exec", "import_module", "importlib", "modules", "pkgutil"}


@pytest.mark.parametrize("module", LADDER)
def test_modules_are_imported_by_statements_only(module: str):
    """So that the test above sees every import."""
    used = set(".".join(set(imported_names(module)) - {"importlib.metadata"}).split("."))
    # These ask what was imported.
    hidden = HIDDEN_WAYS - (
        {"modules"} if module in ("__init__", "identity", "numerics.programs") else set()
    )
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Name) and node.id != "importlib":
            used.add(node.id)
        elif isinstance(node, ast.Attribute):
            used.add(node.attr)
    assert used.isdisjoint(hidden)


UNPROMISED = ("numerics.compiling", "numerics.programs")


@pytest.mark.parametrize("module", [name for name in LADDER if name not in UNPROMISED])
def test_what_others_do_not_promise_is_used_in_one_place(module: str):
    """Behind the switch JAXBELT_PLAIN; what is kept on disk is, too."""
    inside = ("jax._src", "jax.extend", "jax.experimental", "jax.custom_batching")
    inside = (*inside, "equinox.internal", "eqx.internal")
    assert not [name for name in imported_names(module) if name.startswith(inside)]
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute):
            assert not ast.unparse(node).startswith(inside)
        if isinstance(node, ast.keyword):
            assert node.arg not in ("compiler_options", "inline")


@pytest.mark.parametrize(
    "module", [module for module in LADDER if not module.startswith("plotting.")]
)
def test_matplotlib_is_imported_by_plotting_only(module: str):
    roots = {name.partition(".")[0] for name in imported_names(module)}
    assert roots.isdisjoint({"matplotlib", "mpl_toolkits"})


def test_importing_jaxbelt_is_light_and_leaves_the_settings_of_jax_alone():
    program = """
import sys, jaxbelt
print("jax" in sys.modules)
import jax
before = jax.config.values.copy()
jaxbelt.simulate  # with it, all that stands behind the public names
heavy = {"matplotlib", "optax", "pandas", "scipy.ndimage", "scipy.optimize", "xarray", "zarr"}
print(sorted(heavy & sys.modules.keys()), jax.config.values == before)
"""
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120
    )
    assert run.stdout.split() == ["False", "[]", "True"]


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


@pytest.mark.slow(first=True)
def test_examples_of_the_readme_run():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    examples = re.findall(r"^```python\n(.+?)^```$", readme, re.MULTILINE | re.DOTALL)
    assert examples
    exec(compile("\n".join(examples), "README.md", "exec"), {})


@pytest.mark.parametrize("mark", ["tests", "slow tests"])
def test_ci_runs_the_test_commands_of_the_readme(mark):
    """The line of .ci/run that reads a command finds it, its exit code counts, and pytest is
    started nowhere else."""
    ci = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    (extraction,) = re.findall(r"^ *command=.*$", ci, re.MULTILINE)
    assert 'for mark in tests "slow tests"; do' in ci
    run = subprocess.run(
        ["bash", "-c", f'mark={mark!r}\n{extraction}\nprintf %s "$command"'],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert run.stdout == readme_command(mark)
    assert ci.count("$command") == 3  # looked at, shown, run
    assert 'bash -euo pipefail -c "$command") || tested=$?' in ci
    assert ci.rstrip().endswith("exit $((tested || linted))")
    assert "pytest" not in ci


def test_completion_offers_the_public_names_alone():
    assert sorted(n for n in dir(jaxbelt) if not n.startswith("__")) == sorted(jaxbelt.__all__)


def test_every_public_name_has_its_place_in_the_reference():
    pages = [*(ROOT / "docs" / "api").glob("*.md"), *(ROOT / "docs" / "bifurcations").glob("*.md")]
    shown = Counter(
        name
        for page in pages
        for name in re.findall(
            r"^\.\. auto(?:class|function):: jaxbelt\.(\S+)$", page.read_text("utf-8"), re.MULTILINE
        )
    )
    classes = {name for name in vars(jaxbelt.presets) if name.startswith("class_")}
    classes |= {"den_hartog", "di_bernardo"}
    presets = {f"presets.{name}" for name in classes}
    assert shown == Counter({*jaxbelt.__all__, *presets} - {"presets"})
