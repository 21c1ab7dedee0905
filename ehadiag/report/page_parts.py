"""HTML pages from templates and plots, each with a policy that allows its own scripts only.

Pages need no network: bokeh's script is in the page.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from bokeh.embed import components
from bokeh.models import LayoutDOM
from bokeh.resources import Resources
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from firmware_iface.errors import printable


def embed_plots(plots: Mapping[str, LayoutDOM]) -> tuple[list[str], dict[str, str]]:
    """Return the scripts of the page, bokeh's own first, and an element for each plot."""
    if not plots:
        return [], {}
    library = Resources(mode="inline", components=["bokeh"], minified=True, log_level="error")
    script, elements = components(dict(plots), wrap_script=False, wrap_plot_info=True)
    return [*library.js_raw, script], dict(elements)


def render_template(template: str, plots: Mapping[str, LayoutDOM], **texts: Any) -> str:
    """Write a page that loads nothing.

    template: name of its file; plots: plots by the names that the template gives them; **texts:
    values of the template's other places; the template escapes them. Returns HTML.
    """
    templates = templates_of("ehadiag.report")
    scripts, elements = embed_plots(plots)
    if scripts:
        assert templates.loader is not None
        scripts.append(templates.loader.get_source(templates, "print.js")[0])
    policy = (
        f"default-src 'none'; script-src {script_sources(scripts)}; style-src 'unsafe-inline'; "
        "img-src data:; font-src data:; base-uri 'none'; form-action 'none'"
    )
    return templates.get_template(template).render(
        policy=policy,
        scripts=[Markup(script) for script in scripts],
        plots={name: Markup(element) for name, element in elements.items()},
        **texts,
    )


@cache
def templates_of(package: str) -> Environment:
    """Return the templates of a package's folder `templates`.

    They escape every text, write its control characters as numbers and break no line before a
    percent sign; a place left empty is an error.
    """
    return Environment(
        loader=PackageLoader(package),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        finalize=_finalized,
    )


def _finalized(value: Any) -> Any:
    if value is None:
        return "unknown"
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return printable(value).replace(" %", "\N{NO-BREAK SPACE}%")


def script_sources(scripts: Sequence[str]) -> str:
    """Return the sources of `script-src` that allow a page's own inline scripts and no others."""
    digests = (hashlib.sha256(item.encode()).digest() for item in scripts)
    return " ".join(f"'sha256-{base64.b64encode(item).decode()}'" for item in digests) or "'none'"
