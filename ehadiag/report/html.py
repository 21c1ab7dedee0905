"""Fills the templates of pages, with a policy that lets nothing in from outside the page."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from bokeh.models import LayoutDOM
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ehadiag.report.plots import embedded

__all__ = ["fill", "script_sources", "templates_of"]

PACKAGE = "ehadiag.report"


def fill(template: str, plots: Mapping[str, LayoutDOM], **texts: Any) -> str:
    """Write a page that needs nothing but itself.

    Parameters
    ----------
    template : str
        Name of its file.
    plots : Mapping[str, LayoutDOM]
        Plots by the names that the template gives them.
    **texts : Any
        What else it shows: escaped, whatever it is.

    Returns
    -------
    str
        HTML.
    """
    scripts, elements = embedded(plots)
    if scripts:
        scripts = [*scripts, _source("print.js")]
    return str(
        templates_of(PACKAGE)
        .get_template(template)
        .render(
            policy=_policy(scripts),
            scripts=[Markup(script) for script in scripts],
            plots={name: Markup(element) for name, element in elements.items()},
            **texts,
        )
    )


def _source(name: str) -> str:
    """Read a script of the templates' folder as the template engine finds it."""
    templates = templates_of(PACKAGE)
    assert templates.loader is not None
    return templates.loader.get_source(templates, name)[0]


@cache
def templates_of(package: str) -> Environment:
    """Give the templates of a package; what they are filled with is escaped, whatever it is.

    Parameters
    ----------
    package : str
        With a folder `templates`.

    Returns
    -------
    Environment
        Its templates; a name that is not filled in is an error.
    """
    return Environment(
        loader=PackageLoader(package),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )


def script_sources(scripts: Sequence[str]) -> str:
    """Name a page's own scripts for its Content-Security-Policy, so that no other runs.

    Parameters
    ----------
    scripts : Sequence[str]
        That the page has inline.

    Returns
    -------
    str
        Sources of `script-src`.
    """
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(item.encode()).digest()).decode()}'"
        for item in scripts
    )
    return hashes or "'none'"


def _policy(scripts: Sequence[str]) -> str:
    """Nothing from anywhere but this page; of scripts only its own."""
    return (
        f"default-src 'none'; script-src {script_sources(scripts)}; style-src 'unsafe-inline'; "
        "img-src data:; font-src data:; base-uri 'none'; form-action 'none'"
    )
