"""`--report`, and `ehadiag report`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from cli_result import Run
from places import LOGS

from ehadiag.cli import report_page

HEALTHY = LOGS / "healthy-open.blf"
WORN = LOGS / "paper-open-4.blf"


def test_a_page_is_written_beside_result_and_picture(run: Run) -> None:
    result = run("diagnose", "--report", "--out", "o", WORN, "--advisory", "0.3")
    assert result.code == 10
    assert "o/paper-open-4.html" in result.err
    page = Path("o/paper-open-4.html").read_text()
    assert "DEGRADED" in page
    assert "Advisory level 0.3" in page


def test_a_trend_where_there_is_a_history(run: Run) -> None:
    run("diagnose", "--report", "--out", "o", "--history", "h", "--hours", 5, HEALTHY)
    page = Path("o/healthy-open.html").read_text()
    assert "Trend of this unit" in page
    assert "no number: 1 diagnosis of the unit, needs 3" in page


def test_a_page_from_a_stored_result(run: Run) -> None:
    shutil.copy(WORN, "w.blf")
    run("diagnose", "--out", "o", "w.blf")
    assert not Path("o/w.html").exists()
    assert run("report", "o/w.json").code == 0
    assert "Measured and modelled" in Path("o/w.html").read_text()
    Path("w.blf").unlink()
    gone = run("report", "o/w.json")
    assert gone.code == 0
    assert "w.blf is not at hand" in gone.err
    page = Path("o/w.html").read_text()
    assert "No responses are drawn" in page
    assert "0.59988" in page


def test_another_recording_under_the_same_name_is_not_drawn(run: Run) -> None:
    shutil.copy(WORN, "w.blf")
    run("diagnose", "--out", "o", "w.blf")
    shutil.copy(HEALTHY, "w.blf")
    assert "diagnosed otherwise now" in run("report", "o/w.json").err
    assert "No responses are drawn" in Path("o/w.html").read_text()


def test_an_old_page_does_not_stay_beside_a_new_result(run: Run) -> None:
    run("diagnose", "--report", "--out", "o", HEALTHY)
    run("diagnose", "--out", "o", HEALTHY)
    assert not Path("o/healthy-open.html").exists()


@pytest.mark.parametrize(
    "content", ["", "x", "[]", "{}", '{"schema": "ehadiag.diagnosis/1"}', "[" * 100_000,
                '{"schema": "ehadiag.diagnosis/1", "faults": {"a": 1}}'],
)  # fmt: skip
def test_what_is_no_result_is_refused(run: Run, content: str) -> None:
    Path("r.json").write_text(content)
    found = run("report", "r.json")
    assert found.code == 2
    assert "none of ehadiag's JSON results" in found.message
    assert not Path("r.html").exists()


def test_the_page_goes_by_the_levels_of_its_result(run: Run) -> None:
    assert run("diagnose", "--out", "o", "--limit", 0.5, WORN).code == 20
    run("report", "o/paper-open-4.json")
    page = Path("o/paper-open-4.html").read_text()
    assert "limit 0.5" in page
    assert "limit 0.75" not in page


def test_other_actuator_data_draw_no_responses(run: Run) -> None:
    run("diagnose", "--out", "o", HEALTHY)
    run("init", "actuator", ".")
    text = Path("actuator.toml").read_text()
    Path("other.toml").write_text(text.replace("511.6", "511.7"))
    found = run("report", "o/healthy-open.json", "--actuator", "other.toml")
    assert found.code == 0
    assert "it goes by other actuator data" in found.err
    assert "No responses are drawn" in Path("o/healthy-open.html").read_text()


@pytest.mark.parametrize(
    "change",
    [
        lambda tree: tree["faults"]["FSS"].update(estimate="much"),
        lambda tree: tree["faults"]["FSS"].update(flags=5),
        lambda tree: tree.update(solver="cga"),
        lambda tree: tree["solver"].update(seed=-5),
        lambda tree: tree["solver"].update(seed=1 << 80),
    ],
)
def test_a_result_with_keys_of_the_wrong_kind_ends_in_one_line(run: Run, change) -> None:  # type: ignore[no-untyped-def]
    run("diagnose", "--out", "o", HEALTHY)
    tree = json.loads(Path("o/healthy-open.json").read_text())
    change(tree)
    Path("r.json").write_text(json.dumps(tree))
    found = run("report", "r.json")
    assert found.code == 2
    assert "none of ehadiag's JSON results" in found.err


@pytest.mark.parametrize(
    "arguments", [("diagnose", "--report", "--out", "o", HEALTHY), ("report", "o/x.json")]
)
def test_without_its_libraries_there_is_no_report(
    run: Run, arguments: tuple[object, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report_page, "find_spec", lambda _: None)
    found = run(*arguments)
    assert found.code == 2
    assert "pip install 'ehadiag[report]'" in found.message


def test_a_page_needs_a_folder(run: Run) -> None:
    found = run("diagnose", "--report", HEALTHY)
    assert found.code == 2
    assert "--out" in found.message
