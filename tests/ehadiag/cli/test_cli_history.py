"""`ehadiag history`, and diagnoses that are appended to it."""

from __future__ import annotations

import csv
import gzip
import io
import json
import re
import shutil
import time
from pathlib import Path
from typing import Any

import pytest
from cli_result import Result, Run
from history_cases import an_entry
from places import LOGS, ROOT

from ehadiag.history.records import MAX_DATE_ROUNDING_S
from ehadiag.history.store import History

HEALTHY = LOGS / "healthy-open.blf"
WORN = LOGS / "paper-open-4.blf"
GOOD = ("--history", "good")


def listed(run: Run, *arguments: object) -> list[dict[str, Any]]:
    return run("history", "list", "--json", "--history", "h.sqlite", *arguments).objects


def test_diagnoses_are_appended(run: Run) -> None:
    options = ("--json", "--history", "h.sqlite")
    first = run("diagnose", *options, "--hours", 120, HEALTHY)
    run("diagnose", *options, "--cycles", 40, WORN)
    one, two = listed(run)
    assert (one["hours"], one["cycles"], two["hours"], two["cycles"]) == (120, None, None, 40)
    assert (one["verdict"], two["verdict"]) == ("HEALTHY", "DEGRADED")
    shown = json.loads(run("history", "show", "1", "--history", "h.sqlite").out)
    assert shown["result"] == first.objects[0]
    assert shown["recordings"][0]["path"] == str(HEALTHY)
    assert len(shown["covariance"]) == len(shown["covariance"][0]) == 3
    for name, fault in first.objects[0]["faults"].items():
        assert shown["severities"][name]["estimate"] == fault["estimate"]


def test_the_file_is_named_before_or_after_the_verb_or_by_the_environment(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run("diagnose", "--history", "h.sqlite", HEALTHY).code == 0
    after = run("history", "list", "--history", "h.sqlite")
    assert after.code == 0
    assert run("history", "--history", "h.sqlite", "list") == after
    monkeypatch.setenv("EHADIAG_HISTORY", "h.sqlite")
    assert run("history", "list") == after


def test_the_users_own_history_is_kept_once_it_was_begun(run: Run) -> None:
    assert "no health history" in run("history", "list").message
    assert run("history", "list").code == 2
    assert run("diagnose", HEALTHY).code == 0
    assert "begun" in run("history", "init").out
    assert run("diagnose", HEALTHY).code == 0
    assert run("diagnose", "--no-history", WORN).code == 10
    assert len(run("history", "list", "--json").objects) == 1
    assert "was there already" in run("history", "init").out


def test_the_verdict_says_by_when_from_the_history(run: Run) -> None:
    assert "By when: not known from one test" in run("diagnose", WORN).out
    found = run("diagnose", "--history", "h.sqlite", "--hours", 100, WORN)
    assert "By when is not known yet: 1 diagnosis of the unit, needs 3." in found.out


def test_tables_are_broken_between_words_on_a_narrow_terminal(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("history", "init", "--history", "h.sqlite")
    run("history", "import", ROOT / "docs" / "examples" / "fleet.csv", "--history", "h.sqlite")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    day = "2026-08-18T08:00:00.000Z"
    for module in ("prognosis.units", "history.records"):
        monkeypatch.setattr(f"ehadiag.{module}.current_utc_text", lambda: day)
    for words, kept in (
        (("history", "list"), r"2026-08-20 08:00 .*FAULT"), (("rul", "--all"), "reference-31 "),
        (("rul", "--unit", "1"), r"690\s+to 2100 with 80 %\."),
    ):  # fmt: skip
        out = re.sub(r"\x1b\[[\d;]*m", "", run(*words, "--history", "h.sqlite").out)
        assert max(map(len, out.splitlines())) <= 80
        assert re.search(kept, out), out
    page = (ROOT / "docs" / "how-to" / "remaining-life.md").read_text()
    (said,) = re.findall(r"\*(First: .*?)\*", page, re.DOTALL)
    out = run("rul", "--unit", "1", "--hours", 2210, "--history", "h.sqlite").out
    plain = re.sub(r"\([\d-]+\)", "(…)", re.sub(r"\x1b\[[\d;]*m", "", out))
    assert " ".join(said.split()) in " ".join(plain.split())


def test_a_simulated_unit_goes_into_a_named_history_only(run: Run) -> None:
    bit = ("bit", "--simulate", "--fast", "--json", "--no-picture", "--test", "open", "--unit", 9)
    run("history", "init")
    assert run(*bit, "--supply", 10).code == 30  # refused, which is kept as well
    assert run("history", "list", "--json").objects == []
    assert run(*bit, "--history", "h.sqlite", "--hours", 3).code == 0
    (found,) = listed(run)
    assert (found["serial"], found["hours"]) == (9, 3)
    assert json.loads(run("history", "show", 1, "--history", "h.sqlite").out)["simulated"]


def test_the_same_recording_counts_once_in_any_packing(run: Run, tmp_path: Path) -> None:
    (tmp_path / "copy.blf.gz").write_bytes(gzip.compress(WORN.read_bytes()))
    shutil.copy(WORN, tmp_path / "other-name.blf")
    logs = (WORN, "copy.blf.gz", "other-name.blf", HEALTHY)
    run("diagnose", "--history", "h.sqlite", *logs)
    assert len(listed(run)) == 2
    assert len(listed(run, "--all")) == 4


def test_what_a_test_recorded_is_the_same_when_its_recording_is_diagnosed(
    run: Run, tmp_path: Path
) -> None:
    bit = ("bit", "--simulate", "--fast", "--no-picture", "--test", "open")
    run(*bit, "--history", "h.sqlite", "--record", "a.blf")
    run("diagnose", "--history", "h.sqlite", tmp_path / "a.blf")
    assert len(listed(run)) == 1
    assert len(listed(run, "--all")) == 2


def test_what_was_not_tested_is_kept_too(run: Run, tmp_path: Path) -> None:
    (tmp_path / "half.blf").write_bytes(HEALTHY.read_bytes()[:60_000])
    assert run("diagnose", "--history", "h.sqlite", "half.blf").code == 30
    (found,) = listed(run)
    assert found["verdict"] == "NOT_TESTED"
    assert found["severities"] == {}
    assert run("history", "export", "--history", "h.sqlite").code == 0


def test_events_are_listed_with_the_diagnoses(run: Run) -> None:
    history = ("--history", "h.sqlite")
    run("diagnose", *history, HEALTHY)
    event = run(
        "history", "event", "--unit", 1, "filter\x1b[31m changed", "--hours", 30,
        "--resets", "Kintas", "--when", "2026-03-01", *history,
    )  # fmt: skip
    assert event.code == 0
    assert "\x1b" not in event.out
    found = listed(run)[-1]
    assert (found["kind"], found["hours"], found["resets"]) == ("event", 30, ["Kintas"])
    assert found["when"] == "2026-03-01T00:00:00.000Z"
    table = run("history", "list", *history).out
    assert "filter\\x1b[31m changed (begins anew: Kintas)" in table


def test_what_is_withdrawn_counts_no_more_and_stays(run: Run) -> None:
    history = ("--history", "h.sqlite")
    run("diagnose", *history, HEALTHY, WORN)
    run("history", "event", "--unit", 1, "filter changed", *history)
    for kind in ("event", "diagnosis"):
        said = run("history", "withdraw", kind, 1, "=of unit\x1b[31m 8", *history)
        assert (said.code, "\x1b" in said.out) == (0, False)
    assert [(item["kind"], item["number"]) for item in listed(run)] == [("diagnosis", 2)]
    gone = {item["kind"] for item in listed(run, "--all") if item["withdrawn"]}
    assert gone == {"event", "diagnosis"}
    assert (
        "event 1 (withdrawn: =of unit\\x1b[31m 8)" in run("history", "list", "--all", *history).out
    )
    assert "withdrawn" in json.loads(run("history", "show", 1, *history).out)
    text = run("history", "export", "--all", *history).out
    assert {row["withdrawn"] for row in csv.DictReader(io.StringIO(text))} == {
        "", "'=of unit\x1b[31m 8",
    }  # fmt: skip
    for number, words in ((1, "has event 1 withdrawn already"), (9, "has no event 9")):
        again = run("history", "withdraw", "event", number, "x", *history)
        assert again.code == 2
        assert words in again.err


@pytest.mark.slow
def test_two_tests_of_a_simulated_unit_count_both(run: Run) -> None:
    """Their noise has the same seed, so their samples are the same."""
    for hours in (10, 20):
        run("bit", "--simulate", "--fast", "--test", "open", "--history", "h.sqlite",
            "--hours", hours, "--no-picture")  # fmt: skip
        # No real test is over so soon: dates nearer than this are taken for one.
        time.sleep(MAX_DATE_ROUNDING_S)
    found = listed(run)
    assert [item["hours"] for item in found] == [10, 20]
    first, second = (
        json.loads(run("history", "show", item["number"], "--history", "h.sqlite").out)
        for item in found
    )
    assert first["recordings"][0]["samples"] == second["recordings"][0]["samples"]


def test_export_is_csv(run: Run) -> None:
    run("diagnose", "--history", "h.sqlite", "--hours", 5, WORN)
    text = run("history", "export", "--history", "h.sqlite").out
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [row["severity"] for row in rows] == ["Kintas", "FSS", "FDJ"]
    assert float(rows[2]["estimate"]) == pytest.approx(0.6, abs=2e-3)
    run("history", "export", "--history", "h.sqlite", "--out", "h.csv")
    assert Path("h.csv").read_bytes().decode().replace("\r\n", "\n") == text.replace("\r\n", "\n")


def test_plot_draws_a_picture(run: Run) -> None:
    history = ("--history", "h.sqlite")
    for hours, log in ((10, HEALTHY), (200, WORN)):
        run("diagnose", *history, "--hours", hours, log)
    run("history", "event", "--unit", 1, "$oiled", "--hours", 100, *history)
    assert run("history", "plot", *history, "--unit", 1, "--out", "h.png").code == 0
    assert Path("h.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_the_largest_serial(run: Run) -> None:
    largest = (1 << 63) - 1
    run("history", "init", *GOOD)
    with History(Path("good")) as history:
        history.append(an_entry(largest))
    assert run("history", "event", "--unit", largest, "oiled", *GOOD).code == 0
    listed = run("history", "list", "--unit", largest, "--json", *GOOD).objects
    assert [item["serial"] for item in listed] == [largest, largest]


def test_units_of_two_types_with_one_serial_number_are_told_apart(run: Run) -> None:
    run("history", "init", *GOOD)
    with History(Path("good")) as history:
        for kind, day in (("a", "01"), ("b", "02")):
            for n in (1, 2):
                when = f"2026-{n:02}-{day}T12:00:00.000Z"
                history.append(an_entry(1, 100.0 * n, tested=when, actuator=kind))
    event = ("history", "event", "--unit", 1, "filter changed", "--actuator", "b", *GOOD)
    assert run(*event).code == 0
    found = run("history", "list", "--unit", 1, "--actuator", "a", "--json", *GOOD).objects
    assert [(item["kind"], item["actuator"]) for item in found] == [("diagnosis", "a")] * 2
    found = run("history", "list", "--unit", 1, "--json", *GOOD).objects
    assert [item["actuator"] for item in found] == ["a", "a", "b", "b", "b"]
    assert " a " in run("history", "list", *GOOD).out
    text = run("history", "export", "--actuator", "b", *GOOD).out
    assert {row["actuator"] for row in csv.DictReader(io.StringIO(text))} == {"b"}
    plot = ("history", "plot", "--unit", 1, "--out", "h.png", *GOOD)
    assert "serial 1 is of a, b: name its actuator" in run(*plot).message
    assert run(*plot, "--actuator", "a").code == 0
    with History(Path("good")) as history:
        assert history.last_identified(1, "b", (), 9) is None
        kept = history.last_identified(1, "a", (), 9)
    assert kept is not None
    assert kept.number == 2


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("diagnose", "--hours", "5", HEALTHY), 2, "no health history to keep them in"),
        (("diagnose", "--hours", "-5", HEALTHY), 2, "at least 0"),
        (("diagnose", "--history", "h", "--no-history", HEALTHY), 2, "exclude each other"),
        (("diagnose", "--history", "no/such/h", HEALTHY), 3, "no such folder"),
        (("diagnose", "--history", "h.blf", HEALTHY), 3, "not an SQLite file"),
        (("bit", "--test", "open", "--simulate", "--fast", "--history", "h.blf"), 3, "not an SQL"),
        (("history", "list", "--history", "none"), 2, "begin one by ehadiag history init"),
        (("history", "show", "5", *GOOD), 2, "has no diagnosis 5"),
        (("history", "plot", "--unit", "5", "--out", "x.png", *GOOD), 2, "serial 5"),
        (("history", "list", "--unit", "5", *GOOD), 2, "no diagnosis of it; there are none"),
        (("history", "list", "--actuator", "x", *GOOD), 2, "--actuator x: there is none"),
        (("history", "event", "--unit", "5", "a", *GOOD), 2, "no diagnosis of it"),
        (("history", "event", "--unit", "5", " ", *GOOD), 2, "TEXT: is empty"),
        (("history", "event", "--unit", "5", "a", "--when", "2999-01-01", *GOOD), 2, "future"),
        (("history", "export", "--out", "x.xlsx", *GOOD), 2, "need .csv or .parquet"),
        (("history", "event", "--unit", "5", "a", "--resets", "x", *GOOD), 2, "FSS"),
        (("history", "event", "--unit", "5", "a", "--when", "x", *GOOD), 2, "8601"),
        (("history", "export", "--out", "no/x.csv", *GOOD), 3, "No such file"),
        (("history", "list", "--unit", "9" * 20, *GOOD), 2, "serial number is a whole number"),
        (("history", "list", "--unit", 1 << 63, *GOOD), 2, "0 … 9223372036854775807"),
        (("history", "event", "--unit", "-1", "a", *GOOD), 2, "whole number"),
        (("history", "event", "--unit", "9" * 5000, "a", *GOOD), 2, "whole number"),
        (("rul", "--unit", "9" * 20, *GOOD), 2, "serial number is a whole number"),
    ],
)
def test_wrong_usage_is_one_line(
    run: Run, arguments: tuple[object, ...], code: int, said: str
) -> None:
    shutil.copy(HEALTHY, "h.blf")
    assert run("history", "init", *GOOD).code == 0
    found: Result = run(*arguments)
    assert said in found.message
    assert found.code == code


def test_a_diagnosis_begins_from_the_units_last_one(run: Run) -> None:
    history = ("--history", "h.sqlite", "--json")

    def begun_from(*words: object) -> str | None:
        (found,) = run("diagnose", *words).objects
        source: str | None = found["solver"]["begun_from"]
        return source

    assert begun_from(HEALTHY, *history) is None
    assert begun_from(HEALTHY, *history) is None  # not from itself
    closed = HEALTHY.with_name("healthy-closed.blf")
    assert begun_from(closed, *history) == "diagnosis 2 of history h.sqlite"
    assert "begun from diagnosis 3" in run("diagnose", HEALTHY, "--history", "h.sqlite").out
    assert begun_from(WORN, *history) is None  # it does not explain another wear
    run("history", "event", "--unit", 1, "filter changed", "--history", "h.sqlite")
    assert begun_from(closed, *history) is None


def test_a_diagnosis_begins_from_a_named_result(run: Run) -> None:
    run("diagnose", HEALTHY, "--out", ".")
    closed = HEALTHY.with_name("healthy-closed.blf")
    (found,) = run("diagnose", closed, "--prior", "healthy-open.json", "--json").objects
    assert found["solver"]["begun_from"] == "result healthy-open.json"
    assert found["request"]["prior"] == "healthy-open.json"
    said = run("diagnose", closed, "--prior", "nowhere.json")
    assert said.code == 3
    assert "nowhere.json" in said.message
    said = run("diagnose", closed, "--prior", closed)
    assert said.code == 2
    assert "is none of ehadiag's JSON results" in said.message
