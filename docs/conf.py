"""Sphinx: the site of gmmtorch. `./scripts/site.sh` builds it to outputs/site, without a network."""

from __future__ import annotations

import os
import re
from importlib.metadata import version as installed
from typing import Any

from docutils.nodes import SkipNode, image, section
from latex2mathml.converter import convert
from sphinx.util.inspect import signature, stringify_signature

project = "gmmtorch"
author = "The gmmtorch developers"
project_copyright = "The gmmtorch developers"
release = installed("gmmtorch")
version = release

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
source_suffix = {".md": "myst-nb", ".rst": "restructuredtext"}
exclude_patterns = ["_build"]
html_theme = "furo"
html_math_renderer = "mathml"  # browsers draw it without a script from the network
html_title = f"gmmtorch {release}"
html_static_path = ["style"]
html_css_files = ["site.css"]
html_copy_source = False
suppress_warnings = ["ref.python"]  # words of Literal types that are also names of attributes

myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath", "attrs_block"]
nb_execution_mode = "force"  # pictures are those of the present code
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_execution_in_temp = True  # tutorials write files
nb_merge_streams = True
os.environ["OPEN3D_DISABLE_WEB_VISUALIZER"] = "true"  # Open3D announces it in the output of a cell

autodoc_member_order = "groupwise"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
default_role = "code"  # docstrings quote code by single backticks
napoleon_google_docstring = True
napoleon_numpy_docstring = False

_TOP = {
    "README.md": "index.md",
    "BENCHMARKS.md": "benchmarks.md",
    "CHANGELOG.md": "changes.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "examples": "examples.md",
}
"""Files of the repository's root, and the pages of the site that show them."""
_FIELD = re.compile(r"([a-z_]\w*(?:, [a-z_]\w*)*(?: \([^)]*\))?(?: bool)?): (.+)")
_ANY = re.compile(r"\(\*args(: \S+)?, \*\*kwargs(: \S+)?\)")


def _links(app: Any, name: str, source: list[str]) -> None:
    """Pages link to files of the repository, where people read them too. On the site these are its pages."""
    docs = "../" * name.count("/")
    for path, page in _TOP.items():
        source[0] = re.sub(rf"\]\({re.escape(f'{docs}../{path}')}(?=[#)])", f"]({docs}{page}", source[0])


def _included_links(app: Any, path: Any, parent: str, source: list[str]) -> None:
    """Links of the root's files start at the root."""
    source[0] = re.sub(r"\]\((?!\w+:|#)", "](../", source[0]).replace("](../docs/", "](")
    _links(app, parent, source)


def _docstring(app: Any, what: str, name: str, item: Any, options: Any, lines: list[str]) -> None:
    """Writes the lines `field: text` of a class as a definition list, and keeps norms such as |x|."""
    found: list[str] = []
    for line in lines:
        field = _FIELD.fullmatch(line) if what == "class" else None
        if (
            found
            and found[-1]
            and line
            and found[-1].startswith(" ") != bool(field)
            and not line.startswith(" ")
        ):
            found.append("")  # before and after the list
        found += [f"``{field[1]}``", f"    {field[2]}"] if field else [line]
    lines[:] = [re.sub(r"\|(?=\S)", r"\|", line) for line in found]


def _skip(app: Any, what: str, name: str, item: Any, skip: bool, options: Any) -> bool:
    """Leaves out what scikit-learn's base class adds for the routing of metadata."""
    return skip or name.endswith(("_request", "_metadata_routing"))


def _signature(app: Any, what: str, name: str, item: Any, options: Any, text: str, returned: str) -> Any:
    """Shows the arguments of `__init__` if `__new__` accepts any; none of protocols, which have none."""
    if what != "class" or not _ANY.fullmatch(text or ""):
        return None
    own = signature(item.__init__, bound_method=True)
    text = stringify_signature(own, show_return_annotation=False, unqualified_typehints=True)
    return ("" if "**kwargs" in text else text), returned


def _alternatives(app: Any, page: Any) -> None:
    """Gives pictures that the code of a tutorial draws a text; the prose below each describes it."""
    for picture in page.findall(image):
        if "alt" not in picture:
            around = picture.parent
            while not isinstance(around, section):
                around = around.parent
            picture["alt"] = f"Picture drawn by the code of the section {around[0].astext()}"


def _linked_pictures(app: Any, page: str, template: str, context: Any, doctree: Any) -> None:
    """Links each picture to its file, so that a click shows it at full size."""
    picture = r'(<img\b[^>]*\bsrc="([^"]*_images/[^"]*)"[^>]*>)'
    context["body"] = re.sub(picture, r'<a class="picture" href="\2">\1</a>', context.get("body", ""))


def _broken_names(app: Any, page: str, template: str, context: Any, doctree: Any) -> None:
    """Lets long names in tables break after their marks, such as dots, and not within a word."""

    def broken(name: re.Match[str]) -> str:
        return re.sub(r"(?<=[a-z][._/=,])(?=[a-z])(?!py<)", "<wbr>", name[0])

    def in_cell(cell: re.Match[str]) -> str:
        return re.sub(r'class="pre">[^<]{15,}<', broken, cell[0])

    context["body"] = re.sub(r"<td\b.*?</td>", in_cell, context.get("body", ""), flags=re.DOTALL)


def _equation(display: str) -> Any:
    """Writes a formula as MathML."""

    def visit(writer: Any, node: Any) -> None:
        formula = convert(node.astext(), display=display)
        writer.body.append(f'<div class="scrolls">{formula}</div>' if display == "block" else formula)
        raise SkipNode

    return visit


def setup(app: Any) -> None:
    app.add_html_math_renderer("mathml", (_equation("inline"), None), (_equation("block"), None))
    app.connect("source-read", _links)
    app.connect("include-read", _included_links)
    app.connect("autodoc-process-docstring", _docstring, priority=400)  # before napoleon
    app.connect("autodoc-skip-member", _skip)
    app.connect("autodoc-process-signature", _signature)
    app.connect("doctree-read", _alternatives)
    app.connect("html-page-context", _linked_pictures)
    app.connect("html-page-context", _broken_names)
