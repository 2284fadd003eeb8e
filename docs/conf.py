"""The documentation, built by Sphinx: `sphinx-build -W --keep-going docs site`.

It needs no network, neither to be built nor to be read: no font or script comes from elsewhere, and
equations are MathML (see `mathml`), which browsers draw themselves. Pages are Markdown. Those of
public names show their docstrings, which are in Google style (autodoc and napoleon); notebooks are
shown with the outputs stored in them.
"""

import base64
import json
import shutil
import struct
import sys
from pathlib import Path

from docutils.nodes import Element
from jaxtyping import ArrayLike
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.typing import stringify_annotation

HERE = Path(__file__).parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE), str(ROOT)]

project = "jaxbelt"
copyright = "the jaxbelt developers"
html_title = "jaxbelt"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "links",
    "mathml",
]
exclude_patterns = ["costs.md"]

# Markdown, and the notebooks as they were stored.
myst_enable_extensions = ["attrs_block", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"

# Docstrings. Backticks mark code; `links` makes links of public names.
default_role = "code"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autosummary_generate = False
napoleon_use_ivar = True
napoleon_use_rtype = False

# Every reference has to lead somewhere; types of other packages have no page here.
nitpicky = True
nitpick_ignore_regex = [("py:class", r"(?!jaxbelt\.).*")]

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_use_index = False
html_copy_source = False
html_show_sourcelink = False
html_math_renderer = "mathml"
html_theme_options = {"navigation_with_keys": True}
maximum_signature_line_length = 72
python_use_unqualified_type_names = True
toc_object_entries = False
add_module_names = False
copybutton_prompt_text = ">>> |\\.\\.\\. |\\$ "
copybutton_prompt_is_regexp = True


def take_notebooks() -> None:
    """Copies the notebooks to where Sphinx looks for pages, without the views of progress bars;
    pictures that a phone would make too small to read are marked as wide, see site.css."""
    pages = HERE / "notebooks"
    shutil.rmtree(pages, ignore_errors=True)
    pages.mkdir()
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        notebook = json.loads(path.read_text(encoding="utf-8"))
        notebook["metadata"].pop("widgets", None)
        for cell in notebook["cells"]:
            # Links to files of docs/ have another path from the copied notebooks.
            cell["source"] = "".join(cell["source"]).replace("](../docs/", "](../")
            if cell["cell_type"] == "code":
                cell["outputs"] = [one for one in cell["outputs"] if not _is_widget(one)]
                if any(_width(one) > WIDE for one in cell["outputs"]):
                    cell["metadata"]["mystnb"] = {"image": {"classes": "wide"}}
        (pages / path.name).write_text(json.dumps(notebook), encoding="utf-8")


def _is_widget(output: dict) -> bool:
    return any("widget" in kind for kind in output.get("data", {}))


#: Pictures with more columns of pixels than this are wide.
WIDE = 700


def _width(output: dict) -> int:
    """Width in pixels of an output's picture, from the header of the PNG; 0 if there is none."""
    text = "".join(output.get("data", {}).get("image/png", ""))
    return struct.unpack(">I", base64.b64decode(text[:32])[16:20])[0] if text else 0


take_notebooks()


def setup(app: Sphinx) -> None:
    """Connects the functions that adjust how autodoc shows annotations."""
    app.connect("autodoc-process-signature", shorten)
    app.connect("missing-reference", public_class)


def shorten(app, what, name, thing, options, signature: str | None, returns: str | None):
    """Shows ArrayLike by its name in signatures, not as the union of types that it is."""
    if not signature:
        return None
    union = stringify_annotation(ArrayLike, "smart")
    return signature.replace(union, "ArrayLike").replace("NoneType", "None"), returns


def public_class(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: Element
) -> Element | None:
    """Links an annotation, `jaxbelt.cycles.cycle.Cycle`, to the page of `jaxbelt.Cycle`.

    Classes that are not public have no page: their names stay as they are.
    """
    target = node.get("reftarget", "")
    if not target.startswith("jaxbelt.") or target.count(".") == 1:
        return None
    public = f"jaxbelt.{target.rpartition('.')[2]}"
    python = env.get_domain("py")
    link = python.resolve_xref(env, node["refdoc"], app.builder, "obj", public, node, content)
    return link or content
