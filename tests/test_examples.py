"""The examples of the reference, as they stand there: what they print is what is printed.

One page a test. The names that the index of the reference takes for granted are there.
"""

import ast
import builtins
import doctest
import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxbelt as jb

DOCS = Path(__file__).parents[1] / "docs"
GIVEN = {"jax": jax, "jnp": jnp, "np": np, "plt": plt, "jb": jb}
PAGES = {
    path.stem: path
    for path in [
        *DOCS.glob("api/*.md"),
        *DOCS.glob("bifurcations/*.md"),
        DOCS / "laws.md",
        DOCS / "forcing.md",
    ]
}
#: What these compile, few other tests need.
SLOW = """
AddingSliding AtEvents AtExtrema AtPhase AtSection AtTimes BasinFractions BasinStability
BeltAtRest BifurcationCurve BifurcationDiagram BoundaryEquilibrium CircleMap CornerCollision
CrossingSliding Design-class EdgeExchange Exponents FatalShock Fit-class Fold FoldOfCycles
GrazingEdge MeetingEdges
OrbitDiagram PeriodDoubling PeriodicMotion Portrait-class PseudoHopf RegionMap SaddleConnection
Separatrix SpecialPoint SwitchingSliding SymmetryBreaking Torus attractors basin_fractions
basin_stability basins
bifurcation_curve bifurcation_diagram circle_map class design distance_to distance_to_basin_boundary
find_cycle fit minimal_fatal_shock orbit_diagram plot_basins portrait region_map scan
""".split()
#: Long, and the only examples of what they show.
FIRST = """
Arcs Basins-class HopfAtInfinity Tabulated explore forcing in_si laws lyapunov periodic
plot_in_si simulate verify
""".split()


def examples(path: Path) -> str:
    return "\n".join(re.findall(r"^```pycon\n(.+?)^```$", path.read_text("utf-8"), re.M | re.S))


@pytest.mark.slow
def test_the_page_on_scaling_runs():
    """Its blocks in their order; what they say of units holds."""
    blocks = re.findall(
        r"^```python\n(.+?)^```$", (DOCS / "scaling.md").read_text("utf-8"), re.M | re.S
    )
    assert len(blocks) >= 6
    given: dict = {}
    for block in blocks:
        exec(compile(block, "scaling.md", "exec"), given)
    m, machine = given["m"], given["machine"]
    x1 = jb.in_si(given["basins"], m).x1.values
    np.testing.assert_allclose(x1[[0, -1]], [-0.002, 0.004], rtol=1e-12)
    starts = jb.in_si(given["dataset"], lambda N: m).x1
    np.testing.assert_allclose(starts, [0.001, 0.003], rtol=1e-12)
    velocity = jb.in_si(given["orbits"], m).value
    np.testing.assert_allclose([velocity.min(), velocity.max()], [0.02, 0.04], rtol=1e-12)
    # The one belt sticks at its own speed, in whatever units the runs are.
    found = jb.in_si(given["fractions"], machine).to_dataframe()
    sticks = found[found.attractor.str.startswith("cycle")]
    np.testing.assert_allclose(sticks.x2_max, sticks.value, rtol=1e-9)
    amplitude = given["amplitude"]
    np.testing.assert_allclose(amplitude(0.02), jb.in_si(given["cycle"], m).amplitude, rtol=1e-9)
    slope = (amplitude(0.0201) - amplitude(0.0199)) / 0.0002
    np.testing.assert_allclose(given["slope"], slope, rtol=1e-3)  # a difference, of order two
    # The second stiffness is that of m; the tolerance of the runs is 1e-10.
    np.testing.assert_allclose(given["ends"][1], jb.in_si(given["run"], m).x1[-1], rtol=1e-7)
    # In one machine's units and in its own a machine does the same: at 8 N a cycle of one period.
    own, held = machine(N=8.0), given["pressed"](8.0)
    periods = (
        float(jb.find_cycle(osc, one.start(0.003, 0.0)).period * one.units.time)
        for osc, one in ((own.oscillator, own), (held, m))
    )
    assert next(periods) == pytest.approx(next(periods), rel=1e-9)


def test_the_code_of_the_gallery_runs_after_the_lines_that_it_shows():
    page = (DOCS / "gallery.md").read_text("utf-8")
    (begin,) = re.findall(r"^```python\n(.+?)^```$", page, re.M | re.S)
    given: dict = {}
    exec(compile(begin, "gallery.md", "exec"), given)
    shown = re.findall(r":pyobject: (\w+)", page)
    for one in ast.parse((DOCS / "draw.py").read_text("utf-8")).body:
        if isinstance(one, ast.FunctionDef) and one.name in shown:
            shown.remove(one.name)
            exec(compile(ast.Module([one], []), "draw.py", "exec"), given)
            used = {name.id for name in ast.walk(one) if isinstance(name, ast.Name)}
            local = set(given[one.name].__code__.co_varnames)
            local |= {argument.arg for argument in ast.walk(one) if isinstance(argument, ast.arg)}
            assert used - local <= {*given, *dir(builtins)}, one.name
    assert not shown
    assert len(given["friction_laws"]().axes) == 3


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.slow(first=True) if page in FIRST else slow)
        for page, path in sorted(PAGES.items())
        for slow in [pytest.mark.slow if page in SLOW else []]
        if examples(path)
    ],
)
def test_example_prints_what_its_page_says(page):
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    path = PAGES[page]
    test = doctest.DocTestParser().get_doctest(examples(path), dict(GIVEN), page, str(path), 0)
    told: list[str] = []
    doctest.DocTestRunner(optionflags=options).run(test, out=told.append)
    assert not told, "".join(told)


# --- notebooks, in the small setting where they have one ------------------------------------------


NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
#: What the others show takes minutes, and has tests of its own.
BY_DAY = ("01_first_steps", "02_sweeps", "06_atlas", "08_response")


@pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive:UserWarning")
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=pytest.mark.slow(first=path.stem in BY_DAY), id=path.stem)
        for path in NOTEBOOKS
    ],
)
def test_notebook_runs(path, monkeypatch):
    monkeypatch.syspath_prepend(path.parent)  # as Jupyter does
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    namespace = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            source = "".join(cell["source"]).replace("\nFULL = True", "\nFULL = False")
            # Optax relies on promotion, as users of a notebook may.
            with jax.numpy_dtype_promotion("standard"):
                exec(compile(source, path.name, "exec"), namespace)
