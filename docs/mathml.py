"""Equations as MathML, which every browser of today draws by itself: no script, font or network."""

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx


def _mathml(source: str, display: str) -> str:
    # Bars stand for an absolute value here, and close to it.
    bar = '<mo stretchy="false">&#x0007C;</mo>'
    close = bar.replace("<mo", '<mo lspace="0" rspace="0" form="prefix"')
    return convert(source, display=display).replace(bar, close)


def _visit_inline(writer, node: nodes.math) -> None:
    writer.body.append(_mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def _visit_block(writer, node: nodes.math_block) -> None:
    writer.body.append(f'<div class="equation">{_mathml(node.astext(), "block")}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """The renderer that conf.py names."""
    app.add_html_math_renderer("mathml", (_visit_inline, None), (_visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
