"""The list of a log's tests, and its index: taken once, made anew for whatever changes it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from places import LOGS

from ehadiag.batch import journal
from ehadiag.batch.journal import list_tests
from ehadiag.request import Request
from ehadiag.result import ListedTest
from ehadiag.setup import Setup
from firmware_iface.logs import log_files
from firmware_iface.logs.reader import read_frames


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("EHADIAG_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(journal, "MIN_READ_S", 0.0)
    shutil.copy(LOGS / "paper-open-1.blf", tmp_path / "one.blf")
    return tmp_path / "one.blf"


def readings(log: Path, monkeypatch: pytest.MonkeyPatch, request: Request) -> list[bool]:
    """List a log twice; return whether it was read, each time."""
    setup, read = Setup(request), []
    opened = Setup.open

    def spy(self: Setup, *files: str, **options: object) -> object:
        read[-1] = True
        return opened(self, *files, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(Setup, "open", spy)
    found: list[list[ListedTest]] = []
    for _ in range(2):
        read.append(False)
        found.append(list(list_tests(setup, str(log))))
    assert found[0] == found[1]
    assert [(item.number, item.length_s, item.outcome) for item in found[0]] == [
        (1, 5.5, "complete")
    ]
    monkeypatch.setattr(Setup, "open", opened)
    return read


def test_an_unchanged_log_is_read_once(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert readings(log, monkeypatch, Request()) == [True, False]
    assert readings(log, monkeypatch, Request()) == [False, False]


def test_a_changed_log_or_another_question_is_read_anew(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert readings(log, monkeypatch, Request()) == [True, False]
    os.utime(log, ns=(0, 10**9))
    assert readings(log, monkeypatch, Request()) == [True, False]
    assert readings(log, monkeypatch, Request(log_channel=1)) == [True, False]


@pytest.mark.parametrize("content", [b"", b"[{}]", b"\0" * 100])
def test_a_damaged_index_is_made_anew(
    log: Path, monkeypatch: pytest.MonkeyPatch, content: bytes
) -> None:
    assert readings(log, monkeypatch, Request()) == [True, False]
    (index,) = (log.parent / "cache" / journal.INDEX_FOLDER).iterdir()
    index.write_bytes(content)
    assert readings(log, monkeypatch, Request()) == [True, False]


def test_the_oldest_indexes_go_first(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal, "MAX_INDEXES", 2)
    for k in range(4):
        os.utime(log, ns=(0, (k + 1) * 10**9))
        assert readings(log, monkeypatch, Request()) == [True, False]
    assert len(list((log.parent / "cache" / journal.INDEX_FOLDER).iterdir())) == 2


def test_a_short_log_gets_no_index(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal, "MIN_READ_S", 1e9)
    assert readings(log, monkeypatch, Request()) == [True, True]


def as_candump(log: Path, path: Path) -> Path:
    table = read_frames(log)
    with path.open("w") as file:
        for time_ns, number, payload in zip(table.time_ns, table.can_id, table.data, strict=True):
            seconds, rest = divmod(int(time_ns), 10**9)
            print(f"({seconds}.{rest:09d}) can0 {number:03X}#{bytes(payload).hex()}", file=file)
    return path


@pytest.mark.parametrize("name", ["paper-open-1.blf", "hot-worn-closed.asc", "candump.log"])
def test_reading_reports_its_progress(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_files, "PROGRESS_PERIOD_S", 0.0)
    monkeypatch.setattr(journal, "MIN_READ_S", 1e9)  # a busy machine would leave an index
    monkeypatch.setenv("EHADIAG_CACHE_DIR", str(tmp_path / "cache"))
    path = LOGS / name
    if not path.exists():
        path = as_candump(LOGS / "paper-open-1.blf", tmp_path / name)
    shares: list[float] = []
    list(list_tests(Setup(Request()), path, progress=lambda _stage, share: shares.append(share)))
    assert shares == sorted(shares)
    assert 0.0 < shares[-1] <= 1.0
