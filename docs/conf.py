"""Settings of the documentation site: the pages of this folder, plain Markdown, and the docstrings.

`sphinx-build -W --keep-going -b html docs build/site` makes it.
"""

from __future__ import annotations

import re
import sys
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "sim")]

project = "ehadiag"
author = "the ehadiag maintainers"
release = version = installed("ehadiag")
language = "en"
default_role = "code"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode", "numpydoc"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
html_theme = "furo"
html_title = f"ehadiag {release}"
exclude_patterns = ["examples"]

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # numpydoc's sections have them
numpydoc_class_members_toctree = False
numpydoc_show_class_members = False

CONTENTS = "index"
LINK = re.compile(r"- \[.*?\]\(([\w/-]+)\.md\)")
OUTSIDE = re.compile(r"\]\(((?:\.\./)+examples/README\.md)\)")
SCROLLED = re.compile(r'<pre(?=>)|<div(?= class="table-wrapper)')
HEAD = re.compile(r"^(?=[A-Z][a-z]+$)", re.MULTILINE)


def adapt(_app: Sphinx, page: str, source: list[str]) -> None:
    """Hand on what stands outside this folder; make the navigation from the first page's lists."""
    source[0] = OUTSIDE.sub(r"](path:\1)", source[0])
    if page != CONTENTS:
        return
    trees = []
    for part in HEAD.split(source[0])[1:]:
        caption = part.splitlines()[0]
        pages = "\n".join(LINK.findall(part))
        trees.append(f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{pages}\n```\n")
    source[0] += "".join(trees)


def name_types(
    _app: Sphinx, _what: str, _name: str, _of: object, _options: object, lines: list[str]
) -> None:
    """Write numpy's truth type without the underscore that reStructuredText takes for a link."""
    lines[:] = [line.replace("np.bool_", "np.bool") for line in lines]


def make_accessible(
    _app: Sphinx, _page: str, _template: str, context: dict[str, Any], _tree: object
) -> None:
    """Give the navigation's captions their level, and let code that is scrolled take the focus."""
    tree = str(context.get("furo_navigation_tree", ""))
    context["furo_navigation_tree"] = tree.replace(
        'role="heading"', 'role="heading" aria-level="2"'
    )
    if "body" in context:
        context["body"] = SCROLLED.sub(r'\g<0> tabindex="0"', context["body"])


def setup(app: Sphinx) -> None:
    """Connect what is above."""
    app.connect("html-page-context", make_accessible, priority=900)  # after the theme
    app.connect("source-read", adapt)
    app.connect("autodoc-process-docstring", name_types, priority=400)  # before numpydoc
