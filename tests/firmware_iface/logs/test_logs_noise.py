"""Logs full of noise: one line of error or a note, little memory, nothing on the terminal."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ehadiag.core.errors import InputOutputError
from firmware_iface.logs.blocks import LogReader
from firmware_iface.logs.reader import read_frames
from firmware_iface.logs.recorder import Recorder
from firmware_iface.transport.frames import Frame

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
from ehadiag.core.errors import InputOutputError
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
    reader = LogReader(path)
    assert sum(map(len, reader)) == 19
    assert reader.notes == ("1 lines of the log could not be read",)
