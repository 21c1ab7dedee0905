"""A file of results that several calls add to: nothing of it is lost, and one call at a time."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from cli_result import Run
from places import LOGS

from ehadiag.cli.batch.alone import alone_with
from ehadiag.core.errors import InputOutputError

HEALTHY, WORN = LOGS / "healthy-open.blf", LOGS / "paper-open-4.blf"


def kept() -> list[tuple[str, str | None]]:
    trees = [json.loads(line) for line in Path("all.jsonl").read_text().splitlines()]
    return [(tree["source"], tree["verdict"]) for tree in trees]


@pytest.fixture
def logs(tmp_path: Path) -> None:
    shutil.copy(HEALTHY, tmp_path / "a.blf")
    shutil.copy(WORN, tmp_path / "b.blf")
    shutil.copy(HEALTHY, tmp_path / "c.blf")


def test_results_of_logs_that_are_not_named_stay(run: Run, logs: None) -> None:
    run("diagnose", "b.blf", "none.blf", "a.blf", "--resume", "all.jsonl")
    before = Path("all.jsonl").read_bytes()
    assert run("diagnose", "c.blf", "--resume", "all.jsonl").code == 0
    rest = [("b.blf", "DEGRADED"), ("none.blf", None), ("a.blf", "HEALTHY")]
    assert kept() == [*rest, ("c.blf", "HEALTHY")]
    assert Path("all.jsonl").read_bytes().startswith(before)
    # Those of this call stand last, in its order, each log once.
    assert run("diagnose", "c.blf", "b.blf", "--resume", "all.jsonl").code == 10
    assert kept() == [*rest[1:], ("c.blf", "HEALTHY"), ("b.blf", "DEGRADED")]


def test_what_is_found_replaces_what_was_and_a_failure_does_not(run: Run, logs: None) -> None:
    run("diagnose", "a.blf", "b.blf", "none.blf", "--resume", "all.jsonl")
    shutil.copy(HEALTHY, "none.blf")
    shutil.copy(WORN, "a.blf")
    Path("b.blf").unlink()
    run("diagnose", "none.blf", "a.blf", "b.blf", "--resume", "all.jsonl")
    assert kept() == [
        ("b.blf", "DEGRADED"), ("none.blf", "HEALTHY"), ("a.blf", "DEGRADED"), ("b.blf", None),
    ]  # fmt: skip
    shutil.copy(WORN, "b.blf")
    run("diagnose", "b.blf", "--resume", "all.jsonl")
    assert kept()[-1] == ("b.blf", "DEGRADED")
    assert len(kept()) == 3


@pytest.mark.parametrize("option", ["--resume", "--results"])
def test_a_second_call_on_a_file_is_refused(option: str, run: Run, logs: None) -> None:
    with alone_with(Path("all.jsonl")):
        result = run("diagnose", "none.blf", option, "all.jsonl")
    assert result.code == 3
    assert result.message == (
        "ehadiag: results all.jsonl: another call is writing to it; wait for its end, or name"
        " another file"
    )
    assert not Path("all.jsonl").exists()
    result = run("diagnose", "none.blf", option, "all.jsonl")  # the first is through
    assert "another call" not in result.err
    assert kept() == [("none.blf", None)]


def test_a_file_that_is_refused_is_let_go(run: Run, logs: None) -> None:
    Path("all.jsonl").write_text("{}\n")
    for _ in range(2):
        result = run("diagnose", "none.blf", "--resume", "all.jsonl")
        assert "line 1 is no object" in result.message
    with (
        alone_with(Path("all.jsonl")),
        pytest.raises(InputOutputError),
        alone_with(Path("all.jsonl")),
    ):
        pass


def test_no_folder_is_made_for_results(run: Run, logs: None) -> None:
    assert "none/r.jsonl" in run("diagnose", "none.blf", "--results", "none/r.jsonl").message
    assert not Path("none").exists()


def reused(run: Run, *arguments: object) -> int:
    result = run("diagnose", "--resume", "all.jsonl", "--summary", "s.json", *arguments)
    assert result.code == 10, result.err
    found: int = json.loads(Path("s.json").read_text())["reused"]
    assert len(kept()) == 2
    return found


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_what_a_call_is_to_write_is_written_of_earlier_results_too(
    jobs: int, run: Run, logs: None
) -> None:
    both = ("a.blf", "b.blf", "--jobs", jobs)
    assert reused(run, *both) == 0
    assert reused(run, *both) == 2
    out = ("--out", "o", *both)
    assert reused(run, *out) == 0  # a picture needs the samples
    assert sorted(path.name for path in Path("o").iterdir()) == [
        "a.json", "a.png", "b.json", "b.png",
    ]  # fmt: skip
    assert reused(run, *out) == 2
    Path("o/b.png").unlink()
    assert reused(run, *out) == 1
    assert Path("o/b.png").exists()
    history = ("--history", "h.sqlite", *both)
    assert reused(run, *history) == 0
    assert reused(run, *history) == 2
    listed = run("history", "list", "--all", "--json", "--history", "h.sqlite").objects
    assert len(listed) == 2


@pytest.mark.slow
def test_reports_are_written_of_earlier_results_too(run: Run, logs: None) -> None:
    first = ("--out", "o", "--no-picture", "a.blf", "b.blf")
    assert reused(run, *first) == 0
    assert reused(run, *first) == 2
    assert reused(run, "--report", *first) == 0
    assert {path.name for path in Path("o").glob("*.html")} == {"a.html", "b.html"}
    assert reused(run, "--report", *first) == 2
