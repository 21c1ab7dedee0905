"""Names of others reach neither the terminal's commands nor a file's path."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag.core.printable import plain_name, printable, printable_lines, valid_text

NAMES = st.text(st.characters(exclude_categories=[]), max_size=300)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain µ…°", "plain µ…°"),
        ("\x1b[31mred\x1b[0m", "\\x1b[31mred\\x1b[0m"),
        ("two\nlines\r\t", "two\\x0alines\\x0d\\x09"),
        ("\x9b2J\x7f", "\\x9b2J\\x7f"),
        ("a\u202eb", "a\\u202eb"),
        ("caf\udce9", "caf\\xe9"),
        ("\U000e0001", "\\U000e0001"),
    ],
)
def test_what_a_terminal_shows(text: str, shown: str) -> None:
    assert printable(text) == shown


@given(NAMES)
def test_nothing_else_reaches_a_terminal(text: str) -> None:
    assert printable(text).isprintable()
    assert all(line.isprintable() for line in printable_lines(text).split("\n"))


@given(NAMES)
def test_every_name_can_be_told_in_json(text: str) -> None:
    kept = valid_text(text)
    assert json.loads(json.dumps(kept).encode("utf-8")) == kept
    kept.encode("utf-8")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("healthy-open", "healthy-open"),
        ("my log (2)", "my log (2)"),
        ("größe", "größe"),
        (".", "_"),
        ("..", "_"),
        ("", "_"),
        ("-rf", "_rf"),
        (".hidden", "_hidden"),
        ("../../etc/passwd", "__.._etc_passwd"),
        ("a\x1b\0b\udce9", "a__b_"),
        ("C:\\x", "C__x"),
    ],
)
def test_the_plain_name_of_a_file(text: str, name: str) -> None:
    assert plain_name(text) == name


@given(NAMES)
def test_any_name_is_made_the_name_of_a_file(text: str) -> None:
    name = plain_name(text)
    assert name
    assert name.isprintable()
    assert name[0] not in ".-"
    assert not set(name) & set("/\\\0")
    assert len(f"{name}-999999999.json".encode()) <= 255
    assert plain_name(name) == name
