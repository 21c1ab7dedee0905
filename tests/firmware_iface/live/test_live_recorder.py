"""Recorder: what is on disk, also after a kill, and what it refuses."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import pytest

from ehadiag import ConfigurationError, InputOutputError
from firmware_iface.logs import recorder as recorder_module
from firmware_iface.logs.reader import read_frames
from firmware_iface.logs.recorder import Recorder
from firmware_iface.transport.frames import Frame

START_NS = 1_700_000_000_123_456_000
KINDS = (".blf", ".asc", ".csv", ".trc")


def frame(k: int) -> Frame:
    return Frame(START_NS + k * 1_000_000, 0x110 + k % 2, k.to_bytes(8, "little"))


@pytest.mark.parametrize("suffix", KINDS)
def test_frames_read_back_as_they_came(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    with Recorder(path) as recorder:
        for k in range(1000):
            recorder.write(frame(k))
    assert recorder.paths == (path,)
    assert recorder.frames == 1000
    table = read_frames(path)
    assert len(table) == 1000
    assert [bytes(row) for row in table.data] == [frame(k).data for k in range(1000)]
    assert table.can_id.tolist() == [frame(k).can_id for k in range(1000)]
    apart = [b - a for a, b in zip(table.time_ns[:-1], table.time_ns[1:], strict=True)]
    assert max(abs(item - 1_000_000) for item in apart) <= 1000


def test_blf_keeps_every_kind_of_frame_and_the_time_to_a_microsecond(tmp_path: Path) -> None:
    frames = [
        Frame(START_NS, 0x1ABCDEF, b"12345678", extended=True),
        Frame(START_NS + 1000, 0x123, bytes(range(64)), fd=True),
        Frame(START_NS + 2000, 0x123, b"", remote=True),
        Frame(START_NS + 3000, 0x008, bytes(8), error=True),
        Frame(START_NS + 4000, 0x200, bytes(8), sent=True),
        Frame(START_NS + 5000, 0x201, b"ab"),
    ]
    with Recorder(tmp_path / "x.blf") as recorder:
        for item in frames:
            recorder.write(item)
    table = read_frames(tmp_path / "x.blf")
    assert [(t + 500) // 1000 * 1000 for t in table.time_ns.tolist()] == [x.time_ns for x in frames]
    assert table.extended.tolist() == [x.extended for x in frames]
    assert table.fd.tolist() == [x.fd for x in frames]
    assert table.error.tolist() == [x.error for x in frames]
    assert table.remote.tolist() == [x.remote for x in frames]
    assert table.sent.tolist() == [x.sent for x in frames]
    assert bytes(table.data[1]) == frames[1].data
    assert table.length.tolist()[:2] == [8, 64]


def test_trc_counts_what_it_cannot_hold(tmp_path: Path) -> None:
    with Recorder(tmp_path / "x.trc") as recorder:
        recorder.write(frame(0))
        recorder.write(Frame(START_NS, 0x008, bytes(8), error=True))
        recorder.write(Frame(START_NS, 0x123, b"", remote=True))
    assert (recorder.frames, recorder.skipped) == (1, 2)
    assert len(read_frames(tmp_path / "x.trc")) == 1


@pytest.mark.parametrize("suffix", KINDS)
def test_a_killed_process_leaves_all_frames_up_to_its_last_flush(
    tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"x{suffix}"
    code = f"""
        import os, signal
        from firmware_iface.transport.frames import Frame
        from firmware_iface.logs.recorder import Recorder
        recorder = Recorder({str(path)!r})
        for k in range(3000):
            recorder.write(Frame({START_NS} + k * 1_000_000, 0x110, k.to_bytes(8, "little")))
        recorder.flush()
        for k in range(3000, 3050):
            recorder.write(Frame({START_NS} + k * 1_000_000, 0x110, k.to_bytes(8, "little")))
        os.kill(os.getpid(), signal.SIGKILL)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=False, timeout=60)
    assert done.returncode == -signal.SIGKILL
    table = read_frames(path)
    assert 3000 <= len(table) <= 3050
    assert [int.from_bytes(bytes(row), "little") for row in table.data] == list(range(len(table)))
    if suffix == ".blf":
        assert abs(int(table.time_ns[0]) - START_NS) < 1000


def test_frames_reach_the_disk_while_the_bus_is_silent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(recorder_module.time, "monotonic", lambda: now[0])
    with Recorder(tmp_path / "x.csv") as recorder:
        recorder.write(frame(0))
        recorder.write(frame(1))
        recorder.idle()
        before = (tmp_path / "x.csv").stat().st_size
        now[0] += 0.6
        recorder.idle()
        assert (tmp_path / "x.csv").stat().st_size > before


def test_the_next_file_is_begun_when_one_is_full(tmp_path: Path) -> None:
    with Recorder(tmp_path / "x.csv", max_bytes=65_536) as recorder:
        for k in range(4000):
            recorder.write(frame(k))
            if k % 500 == 0:
                recorder.flush()
    assert [item.name for item in recorder.paths] == ["x.csv", "x-2.csv", "x-3.csv"]
    assert sum(len(read_frames(item)) for item in recorder.paths) == 4000


def test_writing_from_two_threads_loses_nothing(tmp_path: Path) -> None:
    with Recorder(tmp_path / "x.blf") as recorder:

        def write() -> None:
            for k in range(1000):
                recorder.write(frame(k))

        threads = [threading.Thread(target=write) for _ in range(2)]
        for item in threads:
            item.start()
        for item in threads:
            item.join()
    assert len(read_frames(tmp_path / "x.blf")) == 2000


def test_after_closing_nothing_is_written(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "x.blf")
    recorder.close()
    recorder.close()
    recorder.write(frame(0))
    recorder.flush()
    assert recorder.frames == 0


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="suffix unknown"):
        Recorder(tmp_path / "x.log")
    with pytest.raises(ConfigurationError, match="at least 65536"):
        Recorder(tmp_path / "x.blf", max_bytes=10)
    with pytest.raises(InputOutputError, match="No such file"):
        Recorder(tmp_path / "nowhere" / "x.blf")
    (tmp_path / "there.blf").write_text("precious")
    with pytest.raises(InputOutputError, match="not overwritten"):
        Recorder(tmp_path / "there.blf")
    assert (tmp_path / "there.blf").read_text() == "precious"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_a_full_disk_is_one_clear_error(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "x.csv")
    recorder._writer.file.close()
    full = os.open("/dev/full", os.O_WRONLY)
    recorder._writer.file = os.fdopen(full, "w", buffering=1 << 20)
    with pytest.raises(InputOutputError, match=r"x\.csv: No space left"):
        recorder.write(frame(0))
    with pytest.raises(InputOutputError, match="No space left"):
        recorder.close()
    recorder.close()
