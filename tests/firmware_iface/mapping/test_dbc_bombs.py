"""Small DBC files that would cost their parser minutes and gigabytes, and ambiguous ones."""

from __future__ import annotations

import time
from importlib import resources
from unittest import mock

import pytest

from firmware_iface.dbc import MAX_SIGNAL_BITS, parse_dbc
from firmware_iface.errors import ConfigurationError

HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: A\n'


def message(content: str, identifier: object = 272, name: str = "Servo", size: object = 8) -> str:
    return f"BO_ {identifier} {name}: {size} A\n{content}\n"


def signal(start: object, length: object, name: str = "Spool", sep: str = "") -> str:
    return f' SG_ {name} :{sep} {start}|{length}@1+ (1,0) [0|1] "" A\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (message(signal(10**9, 8)), "signal Spool of message Servo reaches beyond 1785 bytes"),
        (message(signal(0, 4 * 10**7)), "signal Spool of message Servo reaches beyond"),
        (message(signal("9" * 5000, 8)), "signal Spool of message Servo reaches beyond"),
        (message(signal("\u0661" * 9, 8)), "signal Spool of message Servo reaches beyond"),
        (message(signal(f"+{10**9}", 8)), "reaches beyond"),
        (message(signal(10**9, 8, sep="// comment : 5 A\n")), "reaches beyond"),
        (message(signal(f"{10**9} ", 8).replace("SG_ Spool", "SG_ Spool m0")), "Spool of message"),
        (message(signal(0, 8), size=4 * 10**7), "message Servo of more than 1785 bytes"),
        (message(signal(0, 8), size=f"{4 * 10**7} "), "message Servo of more than 1785 bytes"),
        (
            message(signal(0, 8)) + message(signal(0, 8), name="Other"),
            "messages Servo and Other have the same identifier 0x110",
        ),
        (
            message(signal(0, 8), 2**31 + 5) + message(signal(0, 8), 2**31 + 5, "Other"),
            "messages Servo and Other have the same identifier 0x5",
        ),
        (message(signal(0, 8)) + "SG_MUL_VAL_ 272 Spool Spool 0-4000000000;\n", "100000 values"),
        (message("") + f"SG_MUL_VAL_ 272 A A 0-1, 5{'9' * 500_000};", "not a valid DBC"),
        (
            "".join(message(signal(14000, 8), number + 1, f"M{number}") for number in range(500)),
            "too long ones",
        ),
    ],
)
def test_a_bomb_is_refused_before_its_parser_sees_it(text: str, words: str) -> None:
    with (
        mock.patch("cantools.database.load_string", side_effect=AssertionError),
        pytest.raises(ConfigurationError, match=r"DBC file x\.dbc: ") as caught,
    ):
        parse_dbc((HEAD + text).encode(), "x.dbc")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_texts_and_comments_say_is_no_layout() -> None:
    text = (
        HEAD
        + message(signal(0, 8))
        + message(signal(0, 8), 2**31 + 272, "Extended")
        + 'CM_ BO_ 272 "BO_ 272 Other: 99999999 A SG_ One : 99999999|8@ \\" : 5|99999999";\n'
    )
    assert set(parse_dbc(text.encode(), "x.dbc")) == {"Servo", "Extended"}


def test_signals_of_no_message_are_passed_over() -> None:
    text = message("", 3221225472, "VECTOR__INDEPENDENT_SIG_MSG", 0) + message(signal(0, 8))
    assert set(parse_dbc((HEAD + text + text.splitlines()[0]).encode(), "x.dbc")) == {"Servo"}


def test_the_longest_message_of_j1939_is_read() -> None:
    text = message(signal(MAX_SIGNAL_BITS - 8, 8), size=1785)
    (spool,) = parse_dbc((HEAD + text).encode(), "x.dbc")["Servo"].signals
    assert (spool.start, spool.length) == (MAX_SIGNAL_BITS - 8, 8)


def test_our_own_bus_is_read() -> None:
    text = resources.files("firmware_iface").joinpath("data/eha_fcc.dbc").read_bytes()
    assert "ServoTelemetry" in parse_dbc(text, "eha_fcc.dbc")


@pytest.mark.slow
def test_the_most_that_is_allowed_takes_a_bounded_time() -> None:
    many = "".join(
        message(signal(500, 8), 2**31 + number, f"M{number}", 64) for number in range(9999)
    )
    long = "".join(
        message(signal(14000, 8), number + 1, f"M{number}", 1785) for number in range(12)
    )
    for text in (many, long):
        begin = time.process_time()
        parse_dbc((HEAD + text).encode(), "x.dbc")
        assert time.process_time() - begin < 60.0
