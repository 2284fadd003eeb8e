"""Equations as MathML, which every browser of today draws by itself: no script, font or network."""

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx

#: Operators as latex2mathml writes them, and their replacements: bars of an absolute value without
#: space inside, and a minus sign after "=" as a prefix.
BAR, MINUS = '<mo stretchy="false">&#x0007C;</mo>', "<mo>&#x0003D;</mo><mo>&#x02212;</mo>"
MEANT = {
    BAR: BAR.replace("<mo", '<mo lspace="0" rspace="0" form="prefix"'),
    MINUS: MINUS.replace("<mo>&#x02212;", '<mo form="prefix">&#x02212;'),
}


def _mathml(source: str, display: str) -> str:
    equation = convert(source, display=display)
    for operator, meant in MEANT.items():
        equation = equation.replace(operator, meant)
    return equation


def _visit_inline(writer, node: nodes.math) -> None:
    writer.body.append(_mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def _visit_block(writer, node: nodes.math_block) -> None:
    writer.body.append(f'<div class="equation">{_mathml(node.astext(), "block")}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Adds the renderer of equations that conf.py names."""
    app.add_html_math_renderer("mathml", (_visit_inline, None), (_visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
