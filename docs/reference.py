"""What the pages of public names show: signature, docstring, members, all read from the objects.

Three directives. `public` is one name: it goes by the object that `jaxbelt.NAME` is, so that a
function and a module of one name (`simulate`, `sweep`, `basins`) are not mixed up. `summary` lists
names, each with the first sentence of its docstring and a link to its page. `family` is the
docstring of a module.

Docstrings are Markdown. What they say of arguments and fields in running text, as "osc: the
oscillator; where: selects the parameter", becomes a list, and sentences on what comes back and on
errors become paragraphs of their own, with "Returns" as a heading; no other word is changed. A name
of the package in backticks, on
any page, becomes a link.
"""

import ast
import dataclasses
import enum
import functools
import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.docutils import SphinxDirective

import jaxbelt


def found(name: str) -> Any:
    """The object of a public name, or of one such as presets.class_a, or Cycle.sample."""
    return functools.reduce(getattr, name.split("."), jaxbelt)


class Public(SphinxDirective):
    """A public name: its signature, what its docstring says, and its members if it is a class."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        name = self.arguments[0]
        text = "\n".join(described(name))
        source = inspect.getsourcefile(found(name)) or ""
        self.env.note_dependency(source)
        holder = nodes.container()
        self.state.nested_parse(StringList(text.splitlines(), source=name), 0, holder)
        return holder.children


class Family(SphinxDirective):
    """The docstring of a module of the package."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        module = importlib.import_module(f"jaxbelt.{self.arguments[0]}")
        lines = markdown(inspect.getdoc(module) or "", [])
        holder = nodes.container()
        self.state.nested_parse(StringList(list(lines), source=module.__name__), 0, holder)
        return [nodes.block_quote("", *holder.children)]


class Summary(SphinxDirective):
    """Names, each with its first sentence, and the tree of their pages."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        names = " ".join(self.content).split()
        lines = [f"- {{py:obj}}`{name} <jaxbelt.{name}>`: {first_sentence(name)}" for name in names]
        lines += ["", ":::{toctree}", ":hidden:", ""]
        lines += [page_of(name) for name in names] + [":::"]
        holder = nodes.container()
        self.state.nested_parse(StringList(lines, source="summary"), 0, holder)
        return holder.children


def page_of(name: str) -> str:
    """The page of a name; some file systems do not tell `Fit` from `fit`."""
    last = name.rpartition(".")[2]
    twin = last[:1].isupper() and hasattr(jaxbelt, last.lower())
    return f"/api/{last}-class" if twin else f"/api/{last}"


# --- text -----------------------------------------------------------------------------------------


def first_sentence(name: str) -> str:
    """Of a docstring: its first sentence, or its first clause if that is long."""
    paragraph = " ".join((inspect.getdoc(found(name)) or "").partition("\n\n")[0].split())
    return re.split(r"(?<=[a-z)`])(?<!eqs)(?<!eq)[.;] ", paragraph)[0].rstrip(".") + "."


def described(name: str) -> Iterator[str]:
    """The lines of a name in Markdown."""
    thing = found(name)
    if isinstance(thing, type):
        kind = "exception" if issubclass(thing, Exception) else "class"
        signature = "" if issubclass(thing, enum.Enum) else class_signature(thing)
        names = fields(thing)
    else:
        kind, signature = "function", function_signature(thing)
        names = list(inspect.signature(thing).parameters)
    yield f"::::::{{py:{kind}}} jaxbelt.{name}{signature}"
    yield ""
    doc = inspect.getdoc(thing) or ""
    yield from markdown(doc, names)
    result = re.search(r"-> (\w+)$", signature)
    is_told = "Returns " in doc or "for what comes back" in doc
    if result and result[1] in jaxbelt.__all__ and not is_told:
        yield from ("**Returns**", f": a `{result[1]}`.", "")
    if isinstance(thing, type):
        yield from members(name, thing)
    yield "::::::"


def members(name: str, thing: type) -> Iterator[str]:
    """The members of an enumeration; the documented methods and properties of a class."""
    if issubclass(thing, enum.Enum):
        yield from ("", "| member | value | meaning |", "|---|---|---|")
        for member in thing:
            meaning = jaxbelt.describe(member) if thing is jaxbelt.Status else comment_of(member)
            yield f"| `{member.name}` | {member.value} | {meaning} |"
        return
    for key, member in public_members(thing):
        doc = inspect.getdoc(member)
        function = getattr(member, "__func__", member)
        if isinstance(member, property):
            directive, signature = "property", ""
        else:
            directive, signature = "method", function_signature(function, bound=True)
        names = [] if directive == "property" else list(inspect.signature(function).parameters)
        yield from ("", f":::::{{py:{directive}}} jaxbelt.{name}.{key}{signature}", "")
        yield from markdown(doc or "", names)
        yield ":::::"


def public_members(thing: type) -> Iterator[tuple[str, Any]]:
    """Documented methods and properties, a base's before those that replace them.

    Of a bifurcation condition none: what it tells the package is in the docstrings of its base.
    """
    if "bifurcations" in thing.__module__ and hasattr(thing, "guess"):
        return
    for key, member in vars(thing).items():
        member = getattr(member, "__wrapped__", member)
        routine = inspect.isroutine(member) or isinstance(member, property)
        if not key.startswith("_") and routine and inspect.getdoc(member):
            yield key, member


def comment_of(member: enum.Enum) -> str:
    """The comment behind a member where it is defined, or above it."""
    lines = inspect.getsource(type(member)).splitlines()
    (at,) = (i for i, line in enumerate(lines) if re.match(rf"\s+{member.name} *=", line))
    behind = lines[at].partition("# ")[2]
    above = lines[at - 1].partition("#: ")[2]
    return behind or above


def markdown(doc: str, names: list[str]) -> Iterator[str]:
    """A docstring with what it says of `names` as lists."""
    for paragraph in re.split(r"\n\n+", doc):
        if paragraph.startswith("    "):
            yield from ("```text", *textwrap.dedent(paragraph).splitlines(), "```", "")
        elif re.match(r"[-|] ?", paragraph):
            # Items begin with the names of what they are about.
            about = r"^- ((?:\w+(?:, )?)+)(?=: )"
            words = re.sub(about, r"- **\1**", paragraph, flags=re.MULTILINE)
            yield from (*words.splitlines(), "")
        else:
            yield from listed(paragraph, names)


def listed(paragraph: str, names: list[str]) -> Iterator[str]:
    """A paragraph of running text, its "name: what it is" as a list of definitions; and what it
    says of what comes back, and of errors, as items of their own."""
    pieces = re.split(r"(?<=\. )(?=Returns |See `|`\w+Error`)", " ".join(paragraph.split()))
    if names:
        # "a, b, [n]: what", at the beginning of the text or of a sentence or clause.
        one = rf"(?:{'|'.join(map(re.escape, names))})"
        begin, several = r"(?:^|(?<=[.;] )|(?<=\) ))", rf"{one}(?:(?:, | and | < ){one})*"
        term = rf"{begin}({several}(?:, \[[^]:]*\])*): "
    for piece in pieces:
        if heading := re.match(r"(Returns) (?=\S)|(?=`\w+Error`)", piece):
            what = piece[heading.end() :]
            yield from ("**Returns**" if heading[1] else "**Errors**", f": {what}", "")
            continue
        parts = re.split(term, piece) if names else [piece]
        if parts[0]:
            yield from (parts[0], "")
        for head, body in zip(parts[1::2], parts[2::2], strict=True):
            words = re.sub(rf"\b{one}\b", r"`\g<0>`", head)
            body = body.strip().removesuffix(";")
            yield from (words, f": {body}", "")


# --- signatures -----------------------------------------------------------------------------------


def fields(thing: type) -> list[str]:
    """What a class is made of: its fields, or the arguments of its __init__."""
    if dataclasses.is_dataclass(thing):
        return [field.name for field in dataclasses.fields(thing)]
    return list(getattr(thing, "_fields", ()))


def class_signature(thing: type) -> str:
    """As a class is called, for those that a user makes; without types, which its text tells."""
    given = inspect.signature(thing).parameters.values()
    shown = [parameter.replace(annotation=inspect.Parameter.empty) for parameter in given]
    return str(inspect.Signature([p for p in shown if p.name != "self"]))


def function_signature(function: Any, bound: bool = False) -> str:
    """With annotations as they stand in the source; bound: without its first argument."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(function)))).body
    assert isinstance(tree, ast.FunctionDef)
    if bound:
        tree.args.args = tree.args.args[1:]
    for argument in [*tree.args.args, *tree.args.kwonlyargs]:
        argument.annotation = _unquoted(argument.annotation)
    known = inspect.unwrap(function).__globals__
    for defaults in (tree.args.defaults, tree.args.kw_defaults):
        # A constant of the module by its value.
        defaults[:] = [
            ast.Constant(known[one.id]) if isinstance(one, ast.Name) and one.id.isupper() else one
            for one in defaults
        ]
    returns = f" -> {ast.unparse(_unquoted(tree.returns))}" if tree.returns else ""
    return f"({ast.unparse(tree.args)}){returns}"


def _unquoted(annotation: ast.expr | None) -> Any:
    quoted = isinstance(annotation, ast.Constant) and isinstance(annotation.value, str)
    return ast.parse(annotation.value, mode="eval").body if quoted else annotation


# --- links ----------------------------------------------------------------------------------------


class LinkNames(SphinxPostTransform):
    """Makes a link of a public name in backticks: `jb.simulate`, `simulate(...)`, `Status.OK`."""

    default_priority = 5  # before references are resolved

    def run(self, **kwargs: Any) -> None:
        known = self.env.get_domain("py").objects  # pyright: ignore
        for literal in list(self.document.findall(nodes.literal)):
            text = literal.astext()
            words = re.match(r"(?:jb\.|jaxbelt\.)?(\w+(?:\.\w+)?)(?:\([^()]*\))?$", text)
            linked = (nodes.reference, addnodes.pending_xref)
            # What is explained there is no public name, if it is spelled like one.
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
    """Marks numbers with a minus in them, such as 1e-9, which a browser would break there."""

    default_priority = 900  # after references are resolved

    def run(self, **kwargs: Any) -> None:
        of_code = (nodes.literal, nodes.literal_block, nodes.raw, nodes.math, nodes.math_block)
        for text in list(self.document.findall(nodes.Text)):
            if isinstance(text.parent, of_code) or not isinstance(text.parent, nodes.TextElement):
                continue
            parts = re.split(r"(?<!\w)(-?\d[\d.,]*e-\d+|-\d[\d.,]*\d|-\d)(?!\w)", text.astext())
            if len(parts) > 1:
                # Every other one is a number.
                marked = [
                    nodes.inline("", part, classes=["number"]) if i % 2 else nodes.Text(part)
                    for i, part in enumerate(parts)
                ]
                text.parent.replace(text, [one for one in marked if one.astext()])


def setup(app: Sphinx) -> dict[str, bool]:
    """The directives, and the links."""
    app.add_directive("public", Public)
    app.add_directive("family", Family)
    app.add_directive("summary", Summary)
    app.add_post_transform(LinkNames)
    app.add_post_transform(KeepNumbers)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
