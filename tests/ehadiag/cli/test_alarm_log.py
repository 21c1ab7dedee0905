"""The log of a monitor: appended to, through no link, and to nothing that is no file."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from ehadiag.cli.watch.alarm_log import AlarmLog
from ehadiag.core.errors import InputOutputError

posix = pytest.mark.skipif(os.name != "posix", reason="links, pipes and permissions of POSIX")


def events(path: Path) -> list[str]:
    return [json.loads(line)["event"] for line in path.read_text().splitlines()]


def test_calls_are_appended(tmp_path: Path) -> None:
    path = tmp_path / "watch.jsonl"
    for event in ("begin", "end"):
        log = AlarmLog(path)
        log.write(event, name="a\x1b[31m\udcff")
        log.close()
    assert events(path) == ["begin", "end"]


@posix
def test_permissions(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        AlarmLog(tmp_path / "log").close()
    finally:
        os.umask(before)
    assert (tmp_path / "log").stat().st_mode & 0o777 == 0o640


@posix
@pytest.mark.parametrize("kind", ["link", "dangling link", "pipe", "device", "folder"])
def test_what_is_no_file_is_refused_at_once(kind: str, tmp_path: Path) -> None:
    path, other = tmp_path / "log", tmp_path / "other"
    match kind:
        case "link":
            other.write_text("mine")
            path.symlink_to(other)
        case "dangling link":
            path.symlink_to(other)
        case "pipe":
            os.mkfifo(path)
        case "device":
            path = Path(os.devnull)
        case "folder":
            path.mkdir()
    with pytest.raises(InputOutputError, match=r"^log .*: "):
        AlarmLog(path)
    assert not other.exists() or other.read_text() == "mine"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no full device")
def test_a_full_disk_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "ehadiag.cli.watch.alarm_log.append_to_file",
        lambda _path: os.open("/dev/full", os.O_WRONLY),
    )
    log = AlarmLog(tmp_path / "log")
    with pytest.raises(InputOutputError, match="No space left on device"):
        log.write("begin")
    log.close()
