"""Links and numbers in running text, on every page.

Sphinx renders docstrings with its own extensions (autodoc, napoleon). This module adds two small
transforms: a public name in backticks becomes a link to its page, and numbers such as 1e-9 are kept
on one line.
"""

import re
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms.post_transforms import SphinxPostTransform


class LinkNames(SphinxPostTransform):
    """Makes a link of a public name in backticks: `jb.simulate`, `simulate(...)`, `Status.OK`."""

    default_priority = 5  # before references are resolved

    def run(self, **kwargs: Any) -> None:
        known = self.env.get_domain("py").objects  # pyright: ignore
        for literal in list(self.document.findall(nodes.literal)):
            text = literal.astext()
            words = re.match(r"(?:jb\.|jaxbelt\.)?(\w+(?:\.\w+)?)(?:\([^()]*\))?$", text)
            linked = (nodes.reference, addnodes.pending_xref)
            # A term of a definition list is an argument, even if it is spelled like a public name.
            if words is None or isinstance(literal.parent, (*linked, nodes.term)):
                continue
            target = f"jaxbelt.{words[1]}"
            if target not in known:
                target = target.rpartition(".")[0]
            if target not in known or known[target].docname == self.env.docname:
                continue
            link = addnodes.pending_xref(
                "", refdomain="py", reftype="obj", reftarget=target, refexplicit=True, refwarn=True
            )
            link["refdoc"] = self.env.docname
            literal.replace_self(link)
            link += literal


class KeepNumbers(SphinxPostTransform):
    """Marks numbers with a minus sign, such as 1e-9, at which a browser would break the line."""

    default_priority = 900  # after references are resolved

    def run(self, **kwargs: Any) -> None:
        of_code = (nodes.literal, nodes.literal_block, nodes.raw, nodes.math, nodes.math_block)
        for text in list(self.document.findall(nodes.Text)):
            if isinstance(text.parent, of_code) or not isinstance(text.parent, nodes.TextElement):
                continue
            parts = re.split(r"(?<!\w)(-?\d[\d.,]*e-\d+|-\d[\d.,]*\d|-\d)(?!\w)", text.astext())
            if len(parts) > 1:
                # Parts with odd indices are numbers.
                marked = [
                    nodes.inline("", part, classes=["number"]) if i % 2 else nodes.Text(part)
                    for i, part in enumerate(parts)
                ]
                text.parent.replace(text, [one for one in marked if one.astext()])


def setup(app: Sphinx) -> dict[str, bool]:
    """Adds both transforms."""
    app.add_post_transform(LinkNames)
    app.add_post_transform(KeepNumbers)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
