"""Kills live tests at random moments, and looks at what they leave: history, entries, recording."""

from __future__ import annotations

import argparse
import json
import random
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ehadiag.core.errors import EhadiagError
from ehadiag.core.recording import BitState
from ehadiag.history.records import Entry
from ehadiag.history.store import History
from firmware_iface.logs.reader import read_frames, read_recording

__all__ = ["Kill", "kill_run", "main", "whole_run"]

COMMAND = (sys.executable, "-m", "ehadiag")
POLL_S = 0.005
ENDED = (BitState.COMPLETE, BitState.ABORTED, BitState.REFUSED)
MOST_LOST_S = 1.0
"""Of a recording, before the kill."""
BEYOND = 1.05
"""Kills come up to this share of a whole run's time: some runs end before theirs."""


@dataclass(frozen=True, slots=True)
class Kill:
    """What one killed run left."""

    after_s: float
    """Since the process began."""
    ended: bool
    """Whether it had ended by itself."""
    told: bool
    """Whether it had printed its result."""
    recorded: bool
    """Whether its recording had been begun."""
    lost_s: float | None
    """Of the recording before the kill; None where its test has ended, or it was not begun."""
    wrong: tuple[str, ...]
    """What should not be."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Kill runs; return 1 where one left what it should not."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--folder", type=Path, help="to keep what is left (default: none is kept)")
    asked = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="ehadiag-kills-") as temporary:
        folder = asked.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        whole = whole_run(folder)
        print(f"a whole run takes {whole:.1f} s; seed {asked.seed}")
        moments = random.Random(asked.seed)
        kills = []
        for number in range(1, asked.runs + 1):
            found = kill_run(folder, number, moments.uniform(0.0, BEYOND * whole))
            kills.append(found)
            for wrong in found.wrong:
                print(f"run {number}, killed after {found.after_s:.3f} s: {wrong}")
        print(_summary(kills, folder))
    return int(any(item.wrong for item in kills))


def whole_run(folder: Path) -> float:
    """Make the history, and run one test to its end; return how long that takes, s."""
    subprocess.run(
        [*COMMAND, "history", "init", "--history", str(_history(folder))],
        check=True, capture_output=True,
    )  # fmt: skip
    began = time.monotonic()
    subprocess.run(_bit(folder, 0), check=False, capture_output=True)
    return time.monotonic() - began


def kill_run(folder: Path, number: int, after_s: float, most_lost_s: float = MOST_LOST_S) -> Kill:
    """Run a live test, kill it, and look at what it left.

    Parameters
    ----------
    folder : Path
        With the history of `whole_run`.
    number : int
        Of the run, from 1; each once.
    after_s : float
        From the start of the process.
    most_lost_s : float
        How much of the recording before the kill may be missing: more on a machine that is short
        of processor time.

    Returns
    -------
    Kill
        What was found.
    """
    before = _entries(folder)
    log = _recording(folder, number)
    began, seen = time.monotonic(), None
    with (folder / f"{number}.out").open("w+") as out, (folder / f"{number}.err").open("w") as err:
        process = subprocess.Popen(_bit(folder, number), stdout=out, stderr=err)
        while time.monotonic() - began < after_s and process.poll() is None:
            if seen is None and log.exists():
                seen = time.time()
            time.sleep(POLL_S)
        ended = process.poll() is not None
        killed = time.time()
        process.kill()
        process.wait()
        out.seek(0)
        told = _told(out.read())
    wrong = _history_faults(folder, before, log if told else None)
    lost = None
    if log.exists():
        lost, fault = _lost(log, seen, killed, ended, most_lost_s)
        wrong += fault
    elif seen is not None:
        wrong.append("the recording is gone")
    return Kill(after_s, ended, told, log.exists(), lost, tuple(wrong))


def _bit(folder: Path, number: int) -> list[str]:
    return [
        *COMMAND, "bit", "--simulate", "--test", "open", "--json", "--seed", str(number),
        "--hours", str(number), "--history", str(_history(folder)),
        "--record", str(_recording(folder, number)),
    ]  # fmt: skip


def _history(folder: Path) -> Path:
    return folder / "history.db"


def _recording(folder: Path, number: int) -> Path:
    return folder / f"run-{number}.blf"


def _entries(folder: Path) -> list[Entry]:
    with History(_history(folder)) as history:
        return history.entries()


def _told(printed: str) -> bool:
    """Whether a whole result was printed: then its entry was reported as kept."""
    try:
        result: dict[str, Any] = json.loads(printed)
    except ValueError:
        return False
    return "verdict" in result


def _history_faults(folder: Path, before: list[Entry], log: Path | None) -> list[str]:
    """Say what is wrong with the history; `log`: whose entry must be there."""
    try:
        with sqlite3.connect(_history(folder)) as connection:
            (state,) = connection.execute("PRAGMA integrity_check").fetchone()
        now = _entries(folder)
    except (sqlite3.Error, EhadiagError) as error:
        return [f"history: {error}"]
    wrong = [] if state == "ok" else [f"history: {state}"]
    if now[: len(before)] != before:
        wrong.append("history: an earlier entry is lost or changed")
    if len(now) > len(before) + 1:
        wrong.append(f"history: {len(now) - len(before)} entries of one run")
    if log is not None and not any(
        source.path == str(log) for entry in now[len(before) :] for source in entry.sources
    ):
        wrong.append("history: a result was printed, its entry is lost")
    return wrong


def _lost(
    log: Path, seen: float | None, killed: float, ended: bool, most_lost_s: float
) -> tuple[float | None, list[str]]:
    """How much of a recording before the kill is missing, s; None where its test has ended."""
    try:
        last = max(read_frames(log).time_ns.tolist(), default=None)
        if last is not None and read_recording(log).outcome.state in ENDED:
            return None, []
    except EhadiagError as error:
        last, unread = None, [f"recording: {error}"]
    else:
        unread = []
    # Of what was begun shortly before a kill all may be missing.
    since = killed - (seen or killed) if last is None else killed - last * 1e-9
    if since <= most_lost_s and not (ended and unread):
        return since, []
    return since, [*unread, f"recording: its last {since:.2f} s are missing"]


def _summary(kills: Sequence[Kill], folder: Path) -> str:
    lost = [item.lost_s for item in kills if item.lost_s is not None]
    worst = f"{max(lost):.2f} s" if lost else "none"
    return (
        f"{len(kills)} runs: {sum(not item.recorded for item in kills)} killed before the"
        f" recording, {len(lost)} in the test, {sum(item.told for item in kills)} had told their"
        f" result, {sum(item.ended for item in kills)} had ended;"
        f" entries {len(_entries(folder))}; most of a recording lost {worst};"
        f" wrong {sum(bool(item.wrong) for item in kills)}"
    )
