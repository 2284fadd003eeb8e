"""Every notebook runs from start to end, in the small setting where it has one."""

import json
from pathlib import Path

import jax
import pytest

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
def test_notebook_runs(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    namespace = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            source = "".join(cell["source"]).replace("\nFULL = True", "\nFULL = False")
            # Optax relies on promotion, as users of a notebook may.
            with jax.numpy_dtype_promotion("standard"):
                exec(compile(source, path.name, "exec"), namespace)
