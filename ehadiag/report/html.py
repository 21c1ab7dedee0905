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

__all__ = ["fill"]


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
        _environment()
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
    loader = _environment().loader
    assert loader is not None
    return loader.get_source(_environment(), name)[0]


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("ehadiag.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )


def _policy(scripts: Sequence[str]) -> str:
    """Nothing from anywhere but this page; of scripts only its own."""
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(item.encode()).digest()).decode()}'"
        for item in scripts
    )
    allowed = hashes or "'none'"
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "img-src data:; font-src data:; base-uri 'none'; form-action 'none'"
    )
