"""candump's logs: every kind of frame, what is none, and can-utils' and python-can's own files.

Logs full of noise: one line of error or a note, little memory, nothing on the terminal.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import can
import numpy as np
import pytest
from bus_synth import START
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from places import LOGS

from ehadiag import InputOutputError
from firmware_iface.logs.candump import candump_frames
from firmware_iface.logs.reader import FrameLog, read_frames
from firmware_iface.logs.recorder import Recorder
from firmware_iface.signals.recordings import read_recording
from firmware_iface.transport.frames import Frame, FrameTable


def frame_of(line: str) -> Frame:
    ((frame, _),) = candump_frames([line])
    return frame


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("(1.5) can0 123#0102", Frame(1_500_000_000, 0x123, b"\1\2")),
        ("(0.000001) can0 123#", Frame(1000, 0x123, b"")),
        ("(1700000000.123456) can0 7FF#aB", Frame(1_700_000_000_123_456_000, 0x7FF, b"\xab")),
        ("(1.123456789) vcan1 00000123#00", Frame(1_123_456_789, 0x123, b"\0", extended=True)),
        ("(1.0) can0 18FF0001#FF R\n", Frame(10**9, 0x18FF0001, b"\xff", extended=True)),
        ("(1.0) can0 123#FF T", Frame(10**9, 0x123, b"\xff", sent=True)),
        ("(1.0) can0 123#R", Frame(10**9, 0x123, b"", remote=True)),
        ("(1.0) can0 123#R8", Frame(10**9, 0x123, b"", remote=True)),
        ("(1.0) can0 123##0", Frame(10**9, 0x123, b"", fd=True)),
        ("(1.0) can0 123##5" + "7f" * 64, Frame(10**9, 0x123, b"\x7f" * 64, fd=True)),
        (
            "(1.0) can0 123#0011223344556677_9",
            Frame(10**9, 0x123, bytes.fromhex("0011223344556677")),
        ),
        (
            "(1.0) can0 20000004#0004000000000000",
            Frame(10**9, 4, bytes([0, 4, 0, 0, 0, 0, 0, 0]), extended=True, error=True),
        ),
    ],
)
def test_every_kind_of_frame(line: str, expected: Frame) -> None:
    assert frame_of(line) == expected


@pytest.mark.parametrize(
    "line",
    [
        "hello, world",
        "(1.0) can0 123",
        "(1.0) can0 123#012",
        "(1.0) can0 12#01",
        "(1.0) can0 123#" + "00" * 9,
        "(1.0) can0 123##1" + "00" * 65,
        "1.0 can0 123#01",
        "(1.0) 123#01",
        "(1.0) can0 123#01 X",
        "(9999999999.0) can0 123#01",
        "(99999999999.0) can0 123#01",
    ],
)
def test_a_line_that_holds_no_frame(line: str, caplog: pytest.LogCaptureFixture) -> None:
    assert list(candump_frames([line, "", "(1.0) can0 123#01"])) == [
        (Frame(10**9, 0x123, b"\1"), "can0")
    ]
    assert len(caplog.records) == 1


def test_lines_that_hold_no_frame_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "mixed.log"
    path.write_text("(1.0) can0 123#01\nnoise\n(2.0) can0 12\n(3.0) can0 123#03\n")
    assert read_frames(path).time_ns.tolist() == [10**9, 3 * 10**9]
    assert "2 lines of the log could not be read" in read_recording(path).quality.notes


def test_another_log_of_that_name_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "server.log"
    path.write_text("2026-11-21 12:00:00 started\n" * 50)
    with pytest.raises(
        InputOutputError, match=r"server\.log: no frames in it \(no line as candump"
    ):
        read_frames(path)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.builds(
            Frame,
            time_ns=st.integers(0, 2 * 10**18).map(lambda n: n // 1000 * 1000),
            can_id=st.integers(0, 0x7FF),
            data=st.binary(max_size=8),
        ),
        min_size=1,
        max_size=30,
    )
)
def test_what_python_can_writes_is_read_back(tmp_path: Path, frames: list[Frame]) -> None:
    path = tmp_path / "theirs.log"
    frames = sorted(frames, key=lambda frame: frame.time_ns)
    with can.CanutilsLogWriter(str(path)) as writer:
        for frame in frames:
            message = can.Message(
                timestamp=frame.time_ns / 1e9,
                arbitration_id=frame.can_id,
                data=frame.data,
                is_extended_id=False,
            )
            writer.on_message_received(message)
    table = read_frames(path)
    assert table.can_id.tolist() == [frame.can_id for frame in frames]
    assert [bytes(row[:length]) for row, length in zip(table.data, table.length, strict=True)] == [
        frame.data for frame in frames
    ]
    expected = [frame.time_ns for frame in frames]
    np.testing.assert_allclose(table.time_ns, expected, atol=2000)


def as_candump(source: Path, target: Path) -> Path:
    """The frames of a log, as `candump -L` would have written them."""
    table = read_frames(source)
    columns = table.time_ns.tolist(), table.can_id.tolist(), table.length.tolist(), table.data
    target.write_text(
        "".join(
            f"({time // 10**9:010d}.{time % 10**9 // 1000:06d}) can0 {number:03X}#"
            f"{bytes(data[:length]).hex().upper()}\n"
            for time, number, length, data in zip(*columns, strict=True)
        )
    )
    return target


def test_a_reference_recording_by_way_of_candump(tmp_path: Path) -> None:
    original = read_recording(LOGS / "lossy-open.blf")
    found = read_recording(as_candump(LOGS / "lossy-open.blf", tmp_path / "lossy-open.log"))
    assert found.quality == original.quality
    assert found.samples is not None
    assert original.samples is not None
    np.testing.assert_array_equal(found.samples.spool, original.samples.spool)
    np.testing.assert_array_equal(found.samples.command, original.samples.command)


def test_can_utils_takes_the_same_lines(tmp_path: Path) -> None:
    """log2asc is of can-utils: what it makes of a log, read as ASC, is what we read."""
    if shutil.which("log2asc") is None:
        pytest.skip("no log2asc on this machine: Debian package can-utils")
    lines = [
        f"({START // 10**9 + k // 100}.{k % 100 * 10_000:06d}) can0 {0x100 + k:03X}#{k:02X}{k:02X}"
        for k in range(150)
    ]
    ours = tmp_path / "ours.log"
    ours.write_text("\n".join(lines) + "\n")
    subprocess.run(
        ["log2asc", "-I", ours, "-O", tmp_path / "theirs.asc", "can0"], check=True, timeout=60
    )
    mine, theirs = read_frames(ours), read_frames(tmp_path / "theirs.asc")
    np.testing.assert_array_equal(mine.can_id, theirs.can_id)
    np.testing.assert_array_equal(mine.data, theirs.data)


NOISE = 200 << 20
"""Bytes without a single line end; a sparse file, so that they cost no disk."""


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".csv", ".trc"])
def test_noise_without_line_ends_is_one_line_of_error(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"noise{suffix}"
    path.touch()
    os.truncate(path, NOISE)
    with pytest.raises(InputOutputError, match=r"noise\.") as caught:
        read_frames(path)
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(sys.platform != "linux", reason="limits of memory as on Linux")
@pytest.mark.parametrize("suffix", [".asc", ".csv", ".trc"])
def test_noise_takes_no_memory_and_no_terminal(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"noise{suffix}"
    path.touch()
    os.truncate(path, NOISE)
    code = f"""
import can, resource
from firmware_iface.errors import InputOutputError
from firmware_iface.logs.reader import read_frames
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    read_frames({str(path)!r})
except InputOutputError:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert int(done.stdout) < (NOISE >> 10) // 4  # KiB


def test_lines_that_cannot_be_read_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "x.trc"
    with Recorder(path) as recorder:
        for k in range(20):
            recorder.write(Frame(1_700_000_000_000_000_000 + k * 1_000_000, 0x110, bytes(8)))
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    lines[-3] = "    18        17.0 DT 0zzz Rx 8 damaged\n"
    path.write_text("".join(lines), encoding="utf-8")
    reader = FrameLog(path)
    assert sum(map(len, reader)) == 19
    assert reader.notes == ("1 lines of the log could not be read",)


LINES = st.sampled_from(
    [
        "(1700000000.000001) can0 101#0011223344556677",
        "(1700000000.000002) can0 101#00112233445566FF",
        "(1700000000.000003) can1 101#AABBCCDDEEFF0011",
        "(1700000000.000004) can0 102#AABB",
        "(1700000000.000005) can0 102#aabb",
        "(1700000000.000006) can0 102#aabb T",
        "(1700000000.000007) can0 102#aabb R",
        "(1700000000.00000a) can0 102#aabb",
        "(9999999999.000008) can0 102#aabb",
        "(1700000000.000009) can0 00000102#aabb",
        "(1700000000.000010) can0 20000102#aabb",
        "(1700000000.000011) can0 102#R",
        "(1700000000.000012) can0 102##0" + "1F" * 20,
        "(1700000000.000013) can0 102#xabb",
        "noise",
        "",
        "\ufffd(1700000000.000014) can0 102#aabb",
    ]
)


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(LINES, st.integers(1, 12)), min_size=1, max_size=40), st.booleans())
def test_lines_parsed_together_are_those_parsed_singly(
    tmp_path: Path, runs: list[tuple[str, int]], windows: bool
) -> None:
    lines = [line for line, count in runs for _ in range(count)]
    path = tmp_path / "mixed.log"
    path.write_text(("\r\n" if windows else "\n").join(lines), newline="")
    names: dict[str, int] = {}
    expected = [
        replace(frame, channel=names.setdefault(name, len(names) + 1))
        for frame, name in candump_frames(lines)
    ]
    if expected:
        table, singly = read_frames(path), FrameTable.from_frames(expected)
        for column in ("time_ns", "can_id", "length", "extended", "fd", "error", "remote", "sent"):
            np.testing.assert_array_equal(getattr(table, column), getattr(singly, column))
        np.testing.assert_array_equal(table.channel, singly.channel)
        np.testing.assert_array_equal(table.data, singly.data)
