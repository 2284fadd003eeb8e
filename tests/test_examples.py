"""The examples of the reference, as they stand there: what they print is what is printed.

One page a test. The names that the index of the reference takes for granted are there.
"""

import doctest
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
    for path in [*DOCS.glob("api/*.md"), *DOCS.glob("bifurcations/*.md"), DOCS / "laws.md"]
}
#: What these compile, few other tests need.
SLOW = """
AtEvents AtExtrema AtSection AtTimes BasinFractions BasinStability Basins-class BeltAtRest
BifurcationCurve BifurcationDiagram BoundaryEquilibrium CornerCollision CrossingSliding Design-class
EdgeExchange FatalShock Fit-class FoldOfCycles GrazingEdge MeetingEdges OrbitDiagram Portrait-class
PseudoHopf RegionMap SaddleConnection Separatrix SpecialPoint
attractors basin_fractions basin_stability basins bifurcation_curve bifurcation_diagram design
distance_to distance_to_basin_boundary find_cycle fit minimal_fatal_shock orbit_diagram plot_basins
portrait region_map scan
""".split()


def examples(path: Path) -> str:
    return "\n".join(re.findall(r"^```pycon\n(.+?)^```$", path.read_text("utf-8"), re.M | re.S))


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.slow if page in SLOW else [])
        for page, path in sorted(PAGES.items())
        if examples(path)
    ],
)
def test_example_prints_what_its_page_says(page):
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    path = PAGES[page]
    test = doctest.DocTestParser().get_doctest(examples(path), dict(GIVEN), page, str(path), 0)
    told: list[str] = []
    doctest.DocTestRunner(optionflags=options).run(test, out=told.append)
    plt.close("all")
    assert not told, "".join(told)
