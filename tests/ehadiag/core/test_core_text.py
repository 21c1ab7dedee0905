"""Time stamps as text.

Names of others reach neither the terminal's commands nor a file's path. What is in SI is read in
the units of the workshop. Hashes of what configuration files say.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag import bundled_tests, default_actuator, load_actuator
from ehadiag.core.conventions import date_text, fingerprint, start_text, to_precision, with_unit
from ehadiag.model.registry import REGISTRY
from firmware_iface.bus_map import default_map
from firmware_iface.errors import plain_name, printable, printable_lines, valid_text


def test_a_date_where_the_stamp_has_one() -> None:
    assert date_text(1_700_000_000_001_168_012) == "2023-11-14T22:13:20.001Z"
    assert date_text(1_500_000_000) is None
    assert date_text(None) is None
    assert start_text(1_500_000_000) == "1.500 s"
    assert start_text(None) is None


@given(st.integers(-(2**70), 2**70))
def test_any_stamp_has_a_text(stamp: int) -> None:
    assert start_text(stamp)


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


@pytest.mark.parametrize(
    ("value", "unit", "words"),
    [
        (4e-4, "A", "0.4 mA"),
        (2.5e-6, "m", "2.5 µm"),
        (0.0123, "1", "1.23 %"),
        (1e6, "Pa", "1 MPa"),
        (-466.9, "Pa", "-0.4669 kPa"),
        (300.0, "N", "300 N"),
    ],
)
def test_numbers_are_told_with_a_unit(value: float, unit: str, words: str) -> None:
    assert with_unit(value, unit) == words


def test_no_parameter_is_told_in_the_unit_1() -> None:
    assert not [item.name for item in REGISTRY if with_unit(1.0, item.unit).endswith(" 1")]


def test_comments_and_order_do_not_change_it(tmp_path: Path) -> None:
    from importlib import resources

    text = resources.files("ehadiag").joinpath("data/actuator.toml").read_text()
    first, _, rest = text.partition("[servovalve]")
    other = tmp_path / "other.toml"
    name, _, controller = first.partition("[controller]")
    other.write_text(f"# mine\n{name}[servovalve]{rest}\n[controller]{controller}")
    assert fingerprint(load_actuator(other)) == fingerprint(default_actuator())
    other.write_text(text.replace("GAP = 1.7 ", "GAP = 1.8 "))
    assert fingerprint(load_actuator(other)) != fingerprint(default_actuator())


def test_each_content_has_its_own() -> None:
    things = [*bundled_tests().values(), default_actuator(), default_map()]
    hashes = {fingerprint(item) for item in things}
    assert len(hashes) == len(things)
    assert all(len(item) == 64 for item in hashes)


def test_values_stand_to_the_second_digit_of_their_deviation() -> None:
    assert to_precision(0.00028, 3.972e-05, -0.0005054) == ["0.00004", "-0.00051"]
    assert to_precision(12.3, 456.7, 12.3) == ["457", "12"]
    assert to_precision(0.0, 1.23456) == ["1.235"]
