"""The head of a result: plain words, worst first, causes before evidence, on every width."""

from __future__ import annotations

import contextlib
import io
import json
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from places import LOGS
from rich.console import Console

import ehadiag
from ehadiag import Levels
from ehadiag.batch.result_files import csv_table
from ehadiag.cli.main import main
from ehadiag.cli.result_output import append_result
from ehadiag.estimate import Culprit, Effect
from ehadiag.history.records import Usage
from ehadiag.prognosis.forecast import RemainingLife
from ehadiag.report.head import (
    NAMED_COLUMNS,
    diagnosis_html,
    head_of,
    percent,
    print_result,
    stored_test_name,
)
from ehadiag.report.prognosis_tables import remaining_sentences
from ehadiag.report.report_pages import diagnosis_page
from ehadiag.report.response_signals import result_picture
from ehadiag.report.signal_files import signal_file
from ehadiag.result import Onboard, OnboardFault
from ehadiag.session.bit_run import BitView
from ehadiag.terminal.screen import _severities_text


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
    words = set(re.findall(r"\S+", "\n".join(printed(worn, 10_000))))
    if width < NAMED_COLUMNS:  # the table has no room for plain names
        words -= {f"({name})" for name in worn.severities}
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
    assert "Act now: replace the servovalve." in " ".join(head.sentences)
    assert head.sentences[-1].endswith("Plan to overhaul the jack.")
    assert dict(head.facts)["tested"] == "2023-11-14 22:13 UTC"


def test_a_recording_that_was_cut_says_so_first(worn: ehadiag.Result) -> None:
    quality = msgspec.structs.replace(
        worn.quality,
        notes=("the last 2.700 s of the test are missing: the recording ends early",),
    )
    reasons = ("79% of the spool samples are missing (limit 75%)", "no pressure sample for 2.70 s")
    head = head_of(untested(worn, *reasons, quality=quality), Levels())
    assert head.word == "NOT TESTED"
    assert head.sentences == ("The recording ends early: 2.7 s are missing.",)
    assert [len(item.evidence) for item in head.reasons] == [0]  # the gap is named once
    assert head.actions == ("Record the test to its end, then diagnose again.",)
    assert head.facts[0] == ("recorded", "2023-11-14 22:13 UTC")


def test_what_to_do_stands_directly_below_the_cause(worn: ehadiag.Result) -> None:
    reason = "the spool signal is frozen"
    first, second, *rest = printed(untested(worn, reason), 120)
    assert first.startswith("NOT TESTED  A sensor does not move")
    assert second.strip() == "→ Check this sensor and its wiring."
    assert f"  - {reason}" in rest


def test_marks_of_the_levels_differ_on_every_code_page(worn: ehadiag.Result) -> None:
    for encoding, marks in (("utf-8", "┊┃"), ("ascii", ":|")):
        out = io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors="replace", newline="\n")
        print_result(worn, Console(file=out, width=80, highlight=False))
        out.seek(0)
        text = out.read()
        advisory, limit = marks
        assert f"{advisory} advisory 25 %, {limit} limit 75 %" in text
        (bar,) = (line for line in text.splitlines() if line.startswith("  jack friction"))
        assert bar.index(advisory) < bar.index(limit)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("open", "open-loop test"), ("closed", "closed-loop test"), ("gentle", 'test "gentle"'),
        ("open+closed", "open-loop and closed-loop tests"), (None, "test unknown"),
    ],
)  # fmt: skip
def test_a_test_is_called_by_its_loop_or_its_name(name: str | None, words: str) -> None:
    assert stored_test_name(name) == words


def forecast_of(*lives: tuple[str, float, float, float, float]) -> Any:
    """A prognosis of severities: name, value now, low, median and high of the hours left."""
    return SimpleNamespace(
        unit="hours",
        now="2026-03-09T00:00:00.000Z",
        last_test="2026-03-09T12:00:00.000Z",
        usage_now=3100.0,
        forecasts=[
            SimpleNamespace(
                name=name, value=now, remaining=[RemainingLife(0.75, low, median, high, "")]
            )
            for name, now, low, median, high in lives
        ],
    )


def test_time_that_is_left_is_no_level_and_not_promised_where_it_is_wide() -> None:
    sure, vague = ("FDJ", 0.6, 89.0, 130.0, 190.0), ("FSS", 0.3, 100.0, 500.0, 1400.0)
    assert remaining_sentences(forecast_of(vague, sure)) == [
        "Jack friction reaches its limit in about 130 h (80 %: 89 to 190 h).",
        "Spool friction reaches its limit not before about 100 h.",
    ]


def test_what_may_be_past_is_not_called_reached_and_now_is_said() -> None:
    found = forecast_of(("FDJ", 0.6, -300.0, 200.0, 900.0), ("FSS", 0.3, -900.0, -50.0, 90.0))
    found.last_test = "2026-01-09T12:00:00.000Z"
    for item, median in zip(found.forecasts, (200.0, -50.0), strict=True):
        quantiles = tuple(np.linspace(median - 500.0, median + 500.0, 99))
        item.remaining = [msgspec.structs.replace(item.remaining[0], quantiles=quantiles)]
    assert remaining_sentences(found) == [
        "Spool friction may have reached its limit: 55 %, from now at about 3100 h.",
        "Jack friction reaches its limit in about 200 h (80 %: 0 to 900 h); it may be past it:"
        " 30 %, from now at about 3100 h.",
    ]


def test_the_head_has_no_time_left_of_what_is_sound(worn: ehadiag.Result) -> None:
    lives = (("FDJ", 0.6, 200.0, 300.0, 400.0), ("FSS", 0.6, 89.0, 130.0, 190.0))
    said = head_of(worn, Levels(0.25, 0.75), forecast_of(*lives)).sentences[-1]
    assert said.startswith("Spool friction reaches its limit in about 130 h")
    sound = head_of(worn, Levels(0.7, 0.75), forecast_of(*lives)).sentences
    assert not any("reaches its limit" in sentence for sentence in sound)


def test_the_head_says_by_when_or_why_that_is_not_known(worn: ehadiag.Result) -> None:
    assert head_of(worn, Levels(0.25, 0.75)).sentences[-1].startswith("By when: not known from one")
    few = forecast_of(("FDJ", 0.6, 0.0, 0.0, 0.0), ("FSS", 0.6, 0.0, 0.0, 0.0))
    for item in few.forecasts:
        item.remaining = [RemainingLife(0.75, None, None, None, "2 diagnoses, needs 3")]
    said = head_of(worn, Levels(0.25, 0.75), few).sentences[-1]
    assert said == "By when is not known yet: 2 diagnoses, needs 3."
    sentences = head_of(worn, Levels(0.25, 0.5)).sentences
    assert sentences[0].split(". ")[1].startswith("Act now: ")
    assert not any(sentence.startswith("By when") for sentence in sentences)


@pytest.mark.parametrize(
    ("advice", "action", "evidence"),
    [
        ("supply pressure looks -2 MPa off its probes", "Check this first: supply pressure", ""),
        ("", "Check sensors, oil and supply.", "no single effect or datum explains most of it"),
    ],
)
def test_what_to_check_is_said_once(
    worn: ehadiag.Result, advice: str, action: str, evidence: str
) -> None:
    reason = "the model does not explain the recording: 9.0% of the residuals beyond three times"
    culprit = Culprit(signal="spool", test="closed", start=1.0, end=2.0, suspects=(), advice=advice)
    result = untested(worn, reason, fit=worn.fit, culprit=culprit)
    lines = printed(result, 200)
    assert lines[1].strip().startswith(f"→ {action}")
    text = "\n".join(lines)
    assert text.count("calibrate") == (not advice)
    assert text.count(advice or "Check sensors") == 1
    assert text.count("most is unexplained on the spool signal") == 1
    assert evidence in text


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
    lines = printed(result, 80)
    assert any("not to be relied on" in line for line in lines)
    assert not any("interval" in line for line in lines)
    assert len(lines) < 24
    assert "learn its normal behaviour" in head.actions[0]


def page_of(result: ehadiag.Result) -> str:
    return diagnosis_page(result, Levels(), "1.2.3", "2026-03-01T12:00:00.000Z")


def listed(result: ehadiag.Result) -> str:
    append_result(Path("h.sqlite"), result, Usage())
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert main(["history", "list", "--history", "h.sqlite"]) == 0
    return out.getvalue()


def row_of(result: ehadiag.Result) -> str:
    with csv_table("r.csv") as take:
        take(result)
    return Path("r.csv").read_text()


def properties_of(result: ehadiag.Result) -> str:
    text = signal_file(result, "mf4").decode("latin-1")
    return "".join(re.findall(r"<common_properties>.*?</common_properties>", text, re.DOTALL))


def live_at_the_end(result: ehadiag.Result) -> str:
    session: Any = SimpleNamespace(_result=result)
    return _severities_text(BitView._severities(session))


@pytest.mark.parametrize(
    ("shown", "deviations"),
    [
        (lambda result: "\n".join(printed(result, 200)), ["{low:.5f}", "{std:.5f}", "±"]),
        (page_of, ["{low:.5f}", "interval {percent:.3f}", ">0.012<"]),
        (diagnosis_html, ["{low:.5f}", "{std:.5f}", "interval {percent:.3f}"]),
        (lambda result: result_picture(result).title, ["({low:.5f} …"]),
        (listed, ["{value:.4f} ±"]),
        (row_of, ["{low}", "{std}", "0.000123"]),
        (properties_of, ["{low}", "{std}"]),
        (live_at_the_end, ["± {std:.4f}"]),
    ],
    ids=["terminal", "page", "notebook", "picture", "history", "row", "properties", "live"],
)  # fmt: skip
def test_no_surface_shows_an_interval_of_a_best_fit(
    worn: ehadiag.Result,
    shown: Callable[[ehadiag.Result], str],
    deviations: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    fdj = worn.severities["FDJ"]
    low, std = fdj.interval[0], fdj.std
    found = OnboardFault(estimate=fdj.estimate, std=0.01)
    onboard = Onboard(verdict="DEGRADED", test_id=2, evaluations=9, faults={"FDJ": found})
    bias = Effect(
        name="null_bias",
        meaning="null bias",
        value=0.5,
        unit="1",
        std=0.000123,
        interval95=(0.4, 0.6),
    )
    explained = msgspec.structs.replace(
        worn, effects=(bias,), origins=(msgspec.structs.replace(worn.origins[0], onboard=onboard),)
    )
    reason = "the model does not explain the recording: 9.0% of the residuals beyond three times"
    texts = [
        item.format(value=fdj.value, low=low, std=std, percent=100.0 * low) for item in deviations
    ]
    text = shown(explained.with_diagnosis(worn.diagnosis))
    assert [item for item in texts if item not in text] == []
    unexplained = untested(explained, reason, fit=worn.fit)
    text = shown(unexplained.with_diagnosis(worn.diagnosis))
    assert [item for item in texts if item in text] == []
    assert f"{fdj.value:.2f}"[:3] in text
    assert json.loads(unexplained.to_json())["faults"]["FDJ"]["std"] == std


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
    assert "<h1>Unit 1: DEGRADED</h1>" in html
    assert "jack friction (FDJ)" in html
    assert "DEGRADED" in html
