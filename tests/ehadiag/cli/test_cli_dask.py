"""A Dask cluster as workers: nothing is lost, nothing comes twice, where one of them is killed."""

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
