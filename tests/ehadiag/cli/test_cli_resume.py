"""A file of results that several calls add to: nothing of it is lost, and one call at a time.

Worker processes that end before their time. A Dask cluster as workers: nothing is lost, nothing
comes twice, where one of them is killed.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from cli_result import COMMAND, Run
from places import LOGS

from ehadiag import InputOutputError
from ehadiag.batch.journal import lock_result_file
from ehadiag.batch.workers import Workers

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
    with lock_result_file(Path("all.jsonl")):
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
        lock_result_file(Path("all.jsonl")),
        pytest.raises(InputOutputError),
        lock_result_file(Path("all.jsonl")),
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


@pytest.mark.usefixtures("undrawn")
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


def gives(given: tuple[int, str]) -> int:
    """Return the number; 5 ends its process, 9 does so the first time."""
    number, folder = given
    mark = Path(folder) / "came"
    if number == 5 or (number == 9 and not mark.exists()):
        mark.touch()
        os._exit(1)
    return number


@pytest.mark.slow
def test_what_ends_its_worker_takes_no_other_with_it(tmp_path: Path) -> None:
    inputs = [(number, str(tmp_path)) for number in range(80)]
    with Workers(2) as workers:
        made = list(workers.over(gives, inputs, lambda given: -given[0]))
    assert made == [-5 if number == 5 else number for number in range(80)]


NAMES = ("healthy-open.blf", "paper-open-1.blf", "paper-closed-1.blf", "paper-open-4.blf")
COUNT = 16
PATIENCE_S = 60.0


@contextmanager
def started(command: list[str], environment: dict[str, str], log: Path) -> Iterator[int]:
    with (
        log.open("wb") as out,
        subprocess.Popen(
            [sys.executable, "-m", *command], env=environment, stdout=out, stderr=subprocess.STDOUT
        ) as process,
    ):
        try:
            yield process.pid
        finally:
            process.kill()


def waited(log: Path, word: str) -> str:
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        for line in log.read_text().splitlines() if log.exists() else ():
            if word in line:
                return line
        time.sleep(0.05)
    raise AssertionError(f"{word!r} is not in {log.name}: {log.read_text()}")


@pytest.mark.slow
def test_a_killed_worker_loses_nothing(tmp_path: Path, environment: dict[str, str]) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    for number in range(COUNT):
        shutil.copy(LOGS / NAMES[number % len(NAMES)], logs / f"{number:03}.blf")
    (logs / "008.blf").write_bytes(b"broken")
    with ExitStack() as stack:
        said = tmp_path / "scheduler.log"
        scheduler = ["distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
        stack.enter_context(started([*scheduler, "--no-dashboard"], environment, said))
        address = waited(said, "Scheduler at:").split()[-1]
        workers = []
        for name in ("one", "two"):
            worker = ["distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny"]
            told = tmp_path / f"{name}.log"
            options = ["--name", name, "--no-dashboard"]
            workers.append(stack.enter_context(started([*worker, *options], environment, told)))
            waited(told, "Registered to:")
        results = tmp_path / "results.jsonl"
        command = [*COMMAND, "diagnose", str(logs), "--json", "--cluster", address]
        with subprocess.Popen(
            [*command, "--results", str(results), "--summary", str(tmp_path / "s.json")],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        ) as call:  # fmt: skip
            end = time.monotonic() + PATIENCE_S
            while time.monotonic() < end and not (results.exists() and results.stat().st_size):
                time.sleep(0.02)
            os.kill(workers[0], signal.SIGTERM if os.name == "nt" else signal.SIGKILL)
            out, err = call.communicate(timeout=3 * PATIENCE_S)
    objects = [json.loads(line) for line in out.splitlines()]
    assert [Path(item["source"]).name for item in objects] == [
        f"{number:03}.blf" for number in range(COUNT)
    ], err
    assert [json.loads(line) for line in results.read_text().splitlines()] == objects
    assert [item["verdict"] is None for item in objects].count(True) == 1
    assert call.returncode == 3
    assert json.loads((tmp_path / "s.json").read_text())["failed"] == 1


def test_without_a_scheduler_it_is_said(run: Run) -> None:
    result = run("diagnose", "--cluster", "nonsense://127.0.0.1:1", LOGS / NAMES[0])
    assert result.code == 3
    assert "cluster nonsense://127.0.0.1:1: " in result.message
