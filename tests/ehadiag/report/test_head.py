"""The head of a result: plain words, worst first, causes before evidence, on every width."""

from __future__ import annotations

import io
import re
from typing import Any

import msgspec
import pytest
from places import LOGS
from rich.console import Console

import ehadiag
from ehadiag import Levels
from ehadiag.report.head import head_of, percent
from ehadiag.report.result_tables import diagnosis_html, print_result


@pytest.fixture(scope="module")
def worn() -> ehadiag.Result:
    return ehadiag.diagnose(LOGS / "paper-closed-3.blf")


def untested(result: ehadiag.Result, *reasons: str, **changes: Any) -> ehadiag.Result:
    changes = {"fit": None, "state": "NOT_TESTED", "reasons": reasons, **changes}
    return msgspec.structs.replace(result, **changes)


def printed(result: ehadiag.Result, width: int) -> list[str]:
    out = io.StringIO()
    console = Console(file=out, width=width, highlight=False, markup=False, emoji=False)
    print_result(result, console)
    return out.getvalue().splitlines()


@pytest.mark.parametrize("width", [60, 80, 120, 200])
def test_a_terminal_breaks_no_word_and_loses_no_digit(worn: ehadiag.Result, width: int) -> None:
    lines = printed(worn, width)
    assert max(len(line.rstrip()) for line in lines) <= width
    text = "\n".join(lines)
    for item in worn.severities.values():
        for number in (item.value, *item.interval):
            assert f"{number:.5f}" in text
    words = set(re.findall(r"\S+", "\n".join(printed(worn, 10_000)))) - {"|"}
    bars = {word for word in words if "·" in word or "█" in word}
    assert words - bars <= set(re.findall(r"\S+", text))


def test_a_dumb_terminal_gets_every_digit(
    worn: ehadiag.Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "dumb")
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, highlight=False, markup=False, emoji=False)
    assert console.is_dumb_terminal
    print_result(worn, console)
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert "…" not in out.getvalue().replace(" … ", "")
    for item in worn.severities.values():
        assert all(f"{number:.5f}" in out.getvalue() for number in (item.value, *item.interval))


def test_the_worst_comes_first_with_what_to_do(worn: ehadiag.Result) -> None:
    levels = Levels(0.25, 0.5)
    head = head_of(worn, levels)
    assert [bar.value for bar in head.bars] == sorted(
        (item.value for item in worn.severities.values()), reverse=True
    )
    assert re.match(
        r"(Spool friction|Filter clogging) is at 60 %, its limit is 50 %\.", head.sentences[0]
    )
    assert "Replace the servovalve." in " ".join(head.sentences)
    assert head.sentences[-1].endswith("Plan to overhaul the jack.")
    assert dict(head.facts)["tested"] == "2023-11-14 22:13 UTC"


def test_a_recording_that_was_cut_says_so_first(worn: ehadiag.Result) -> None:
    quality = msgspec.structs.replace(
        worn.quality,
        notes=("the last 2.700 s of the test are missing: the recording ends early",),
    )
    reasons = ("49% of the spool samples are missing (limit 25%)", "no pressure sample for 2.70 s")
    head = head_of(untested(worn, *reasons, quality=quality), Levels())
    assert head.word == "NOT TESTED"
    assert head.sentences == ("The recording ends early: 2.7 s are missing.",)
    assert head.reasons[0].evidence == reasons
    assert head.reasons[0].action


@pytest.mark.parametrize(
    ("reason", "cause"),
    [
        ("refused by the flight-control computer: supply pressure low", "pressure is too low"),
        ("no answer within 1 s of the request; can0 was silent for 1.2 s", "does not answer"),
        ("telemetry lost for 0.25 s", "connection was lost"),
        ("the spool signal is frozen", "does not move"),
        ("test 9 is none of the stored tests: name its file by --test", "is not known"),
        ("the command is a current, test 'closed' needs another", "another test"),
        ("oil at 150 degC, outside -54 … 135", "too hot or too cold"),
        ("this computer is too busy to simulate in real time: it fell 1 s behind", "too busy"),
        (
            "the actuator file is calibrated for serial 4, the recording is of serial 5",
            "another unit",
        ),
    ],
)
def test_each_reason_has_a_plain_cause_and_an_action(
    worn: ehadiag.Result, reason: str, cause: str
) -> None:
    (found,) = head_of(untested(worn, reason), Levels()).reasons
    assert cause in found.cause
    assert found.action
    assert found.evidence == (reason,)


def test_an_unexplained_test_is_inconclusive_and_has_the_exit_code_of_not_tested(
    worn: ehadiag.Result,
) -> None:
    reason = "the model does not explain the recording: 9.0% of the residuals beyond three times"
    result = untested(worn, reason, fit=worn.fit)
    head = head_of(result, Levels())
    assert head.word == "INCONCLUSIVE"
    assert head.sentences == ("Wear alone does not explain how this unit moved.",)
    assert result.exit_code == 30
    assert {bar.standing for bar in head.bars} == {"no verdict"}
    assert not any("█" in line for line in printed(result, 80))


def test_a_sound_unit_needs_nothing(worn: ehadiag.Result) -> None:
    def sized(value: float) -> ehadiag.Result:
        faults = {
            name: msgspec.structs.replace(item, estimate=value, interval95=(value, value))
            for name, item in worn.severities.items()
        }
        return msgspec.structs.replace(worn, severities=faults, state="HEALTHY", reasons=())

    (said,) = head_of(sized(0.123), Levels()).sentences
    assert said.startswith("Nothing to do. All wear is below its advisory level of 25 %; most worn")
    assert said.endswith("12 %.")
    assert head_of(sized(0.001), Levels()).sentences == ("Nothing to do. No wear was found.",)


def test_an_unknown_reason_stands_for_itself(worn: ehadiag.Result) -> None:
    (found,) = head_of(untested(worn, "something else happened"), Levels()).reasons
    assert (found.cause, found.evidence) == ("Something else happened.", ())


@pytest.mark.parametrize(
    ("value", "text"), [(0.3, "30 %"), (0.2499, "24.99 %"), (0.25, "25 %"), (0.746, "74.6 %")]
)
def test_a_percentage_is_told_from_the_levels(value: float, text: str) -> None:
    assert percent(value, 0.25, 0.75) == text


def test_a_notebook_shows_tables_and_texts_as_texts(worn: ehadiag.Result) -> None:
    html = diagnosis_html(msgspec.structs.replace(worn, actuator="<script>alert(1)</script>"))
    assert "<script" not in html
    assert "<pre" not in html
    assert html.count("<table") == 2
    assert "DEGRADED" in html
