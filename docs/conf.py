"""Settings of the documentation site: the pages of this folder, plain Markdown, and the docstrings.

`sphinx-build -W --keep-going -b html docs build/site` makes it. Tables of options, parameters and
UDS services are made from the code where a page has `<!-- NAME -->`.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from functools import cache
from importlib.metadata import version as installed
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "sim")]

project = "ehadiag"
author = "the ehadiag developers"
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

CONTENTS = ("index", "maintainers")
"""Pages whose lists make the navigation."""
LINK = re.compile(r"- \[.*?\]\(([\w/-]+)\.md\)")
OUTSIDE = re.compile(
    r"\]\(((?:\.\./)+(?:examples/README|CONTRIBUTING|firmware_iface/c/README)\.md)\)"
)
SCROLLED = re.compile(r'<pre(?=>)|<div(?= class="table-wrapper)')
HEAD = re.compile(r"^(?=[A-Z][a-z]+$)", re.MULTILINE)


def adapt(_app: Sphinx, page: str, source: list[str]) -> None:
    """Link files outside this folder; fill in what is made; make the navigation from the lists."""
    if page == "gallery":
        source[0] += gallery()
    source[0] = with_tables(source[0])
    source[0] = OUTSIDE.sub(r"](path:\1)", source[0])
    if page not in CONTENTS:
        return
    trees = []
    for part in HEAD.split(source[0])[1:]:
        caption = part.splitlines()[0]
        pages = "\n".join(LINK.findall(part))
        trees.append(f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{pages}\n```\n")
    source[0] += "".join(trees)


EXAMPLES = HERE.parent / "examples" / "README.md"
PICTURE = re.compile(r"^!\[(.*?)\]\((.*?)\)$", re.MULTILINE)
SCRIPT = re.compile(r"^```sh\npython (examples/\w+\.py).*?```\n```\n.*?```\n\n", re.M | re.S)


def gallery() -> str:
    """Return the examples with their output, which tests compare, each above its folded source."""
    text = EXAMPLES.read_text("utf-8").partition("\n\n")[2].replace("](../docs/", "](")
    text = text.replace("](diagnose.ipynb)", "](path:../examples/diagnose.ipynb)")
    return SCRIPT.sub(
        r"\g<0><details><summary>Source</summary>\n\n"
        r"```{literalinclude} ../\1\n:language: python\n```\n\n</details>\n\n",
        PICTURE.sub(r"```{image} \2\n:alt: \1\n:height: 24em\n```", text),
    )


TABLE = re.compile(r"^<!-- (.*) -->$", re.MULTILINE)


def with_tables(text: str) -> str:
    """Fill tables that are made from the code into a page."""
    return TABLE.sub(lambda match: table(match[1]), text)


def table(name: str) -> str:
    """Return a table by its name in the page."""
    if name == "parameters":
        return parameter_table()
    return uds_tables() if name == "UDS services" else option_tables()[name]


@cache
def option_tables() -> dict[str, str]:
    """Return the table of each command's options, made from its help.

    An option that two commands have with the same help stands in the table `shared` alone.
    """
    from ehadiag.cli.main import parser_and_commands  # noqa: PLC0415 - loads all commands

    _, parsers = parser_and_commands()
    found: dict[tuple[str, str], list[str]] = {}
    for command, parser in parsers.items():
        for item in parser._actions:
            if item.option_strings and item.help and item.dest not in ("help", "help_all"):
                names = ", ".join(f"`{_call(item, name)}`" for name in item.option_strings)
                meaning = parser._get_formatter()._expand_help(item)
                row = (names, meaning.replace("|", "\\|"))
                found.setdefault(row, []).append(command)
    shared = [
        f"| {names} | {meaning} | {', '.join(sorted(commands))} |"
        for (names, meaning), commands in found.items() if len(commands) > 1
    ]  # fmt: skip
    tables = {"shared": ["| option | meaning | of |", "| --- | --- | --- |", *shared]}
    for command in parsers:
        own = [row for row, commands in found.items() if commands == [command]]
        lines = [f"| {names} | {meaning} |" for names, meaning in own]
        tables[command] = ["| option | meaning |", "| --- | --- |", *lines] if own else []
    return {f"options: {name}": "\n".join(lines) for name, lines in tables.items()}


def _call(item: argparse.Action, name: str) -> str:
    """Write an option with its value, as in a table."""
    if item.nargs == 0:
        return name
    value = item.metavar or "|".join(map(str, item.choices or [item.dest.upper()]))
    words = value if isinstance(value, str) else " ".join(value)
    words = f"[{words}]" if item.nargs == "?" else words
    return f"{name} {words}".replace("|", "\\|")


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


def parameter_table() -> str:
    """Return the rows of the registry of parameters, as Markdown."""
    from ehadiag.model.registry import REGISTRY  # noqa: PLC0415 - loads kernels

    lines = ["| name | symbol | unit | range | meaning |", "| --- " * 5 + "|"]
    data = [item for item in REGISTRY if item.name == f"datum_{item.symbol.removeprefix('d')}"]
    error = "relative error of the actuator file's "
    meanings = "; ".join(item.meaning.removeprefix(error) for item in data)
    for item in [data[0], *(item for item in REGISTRY if item not in data)]:
        bounded = math.isfinite(item.lower)
        span = f"{item.lower:g} … {item.upper:g}" if bounded else "any"
        cells = [f"`{item.name}`", item.symbol, item.unit, span, item.meaning]
        if item in data:  # one row for all, since they have the same bounds
            cells[:2], cells[4] = ["`datum_NAME`", "dNAME"], f"{error}NAME: {meanings}"
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def uds_tables() -> str:
    """Return the services, data and codes of UDS, as Markdown."""
    from firmware_iface.uds import services as uds  # noqa: PLC0415 - has the package's path now

    def rows(title: str, head: str, lines: list[str]) -> str:
        rule = "| --- " * (head.count("|") + 1) + "|"
        return "\n".join([f"## {title}", "", f"| {head} |", rule, *lines, ""])

    routine, snapshot = f"{uds.TEST_STATUS.number:04X}", f"{uds.SNAPSHOT_RECORD:02X}"
    status = uds.TEST_STATUS.name
    calls = [
        *(
            (f"31 {action:02X} {routine}{option}", f"{action.name.lower()} of a test", status)
            for action, option in zip(uds.RoutineAction, (" TEST", "", ""), strict=True)
        ),
        *((f"22 {item.number:04X}", item.meaning, item.name) for item in uds.DATA_RECORDS.values()),
        ("19 02 MASK", "trouble codes with a bit of the mask", "mask, codes with their status"),
        (
            f"19 04 CODE {snapshot}",
            "what set a trouble code",
            f"code, status, {uds.ONBOARD_RESULT.name}",
        ),
        ("19 0A", "all trouble codes", "mask, codes with their status"),
    ]
    fields = [
        f"| {record.name} | `{item.name}` | {item.size} | {_scale(item)} | {item.unit} | "
        f"{item.meaning} |"
        for record in (uds.TEST_STATUS, *uds.DATA_RECORDS.values())
        for item in record.fields
    ]
    codes = [
        f"| {item.code} | {item.number:06X} | {item.verdict.name.replace('_', ' ')} | "
        f"{item.meaning} |"
        for item in uds.TROUBLE_CODES
    ]
    refused = [
        f"| {code:02X} | {code.name.lower().replace('_', ' ')} | "
        f"{', '.join(_words(key) for key, value in uds.REFUSALS.items() if value is code)} |"
        for code in uds.ResponseCode
    ]
    return "\n".join(
        (
            rows("Services", "request | meaning | answer", [f"| {' | '.join(c)} |" for c in calls]),
            rows("Data", "answer | field | bytes | step | unit | meaning", fields),
            rows("Trouble codes", "display | code | set while | meaning", codes),
            rows("Negative responses", "code | meaning | of a start", refused),
        )
    )


def _words(value: Any) -> str:
    return str(value.name).lower().replace("_", " ")


def _scale(item: Any) -> str:
    if item.names is not None:
        return ", ".join(f"{int(value)} {_words(value)}" for value in item.names)
    return "text" if item.text else f"{item.scale:g}" + (", signed" if item.signed else "")


def setup(app: Sphinx) -> None:
    """Connect what is above."""
    app.connect("html-page-context", make_accessible, priority=900)  # after the theme
    app.connect("source-read", adapt)
    app.connect("autodoc-process-docstring", name_types, priority=400)  # before numpydoc
