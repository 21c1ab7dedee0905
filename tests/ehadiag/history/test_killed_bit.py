"""What a live test leaves that is killed at a random moment: history, its entries, recording."""

from __future__ import annotations

import random
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ehadiag.history.records import Entry
from ehadiag.history.store import History
from firmware_iface.errors import EhadiagError
from firmware_iface.logs.reader import read_frames

COMMAND = (sys.executable, "-m", "ehadiag")
MISSING_S = 5.0
"""Longest part of a recording that may be missing, s; the machine may be busy with other tests."""


def bit(folder: Path, number: int) -> list[str]:
    history, log = folder / "history.db", folder / f"{number}.blf"
    options = ["--simulate", "--test", "open", "--json", "--hours", str(number)]
    return [*COMMAND, "bit", *options, "--history", str(history), "--record", str(log)]


def entries(folder: Path) -> list[Entry]:
    with sqlite3.connect(folder / "history.db") as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    with History(folder / "history.db") as history:
        return history.entries()


@pytest.mark.slow
def test_a_killed_test_leaves_a_sound_history_and_its_recording(tmp_path: Path) -> None:
    history = ["history", "init", "--history", str(tmp_path / "history.db")]
    subprocess.run([*COMMAND, *history], check=True, capture_output=True)
    began = time.monotonic()
    subprocess.run(bit(tmp_path, 0), check=False, capture_output=True)
    length = time.monotonic() - began
    moments = random.Random(7)
    for number in range(1, 5):
        before, log = entries(tmp_path), tmp_path / f"{number}.blf"
        process = subprocess.Popen(
            bit(tmp_path, number), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        time.sleep(moments.uniform(0.3, 1.1) * length)
        killed = time.time()
        process.kill()
        printed, _ = process.communicate()
        after = entries(tmp_path)
        assert after[: len(before)] == before
        assert len(after) <= len(before) + 1
        if '"verdict"' in printed:
            assert [source.path for source in after[-1].sources] == [str(log)]
        elif log.exists():
            try:
                last = max(read_frames(log).time_ns.tolist(), default=None)
            except EhadiagError:
                last = None  # begun shortly before
            begun = log.stat().st_ctime
            assert killed - (begun if last is None else last * 1e-9) < MISSING_S
