"""Shows a running session: a live view in a process of its own, plain lines, or JSON snapshots."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from typing import BinaryIO, Self

from ehadiag.estimate import Severity
from ehadiag.live import Alarm, Snapshot
from ehadiag.terminal.output import print_status

UNPRINTED_BUS_STATES = ("connecting", "closed")
"""States of the bus at both ends of a session, which are not printed."""


class StatusLines:
    """Turns snapshots into lines, each printed once."""

    def __init__(self) -> None:
        self._printed: dict[str, str] = {}
        self._alarms = 0

    def of(self, snapshot: Snapshot) -> Iterator[str]:
        """Give the lines that a snapshot adds to those before."""
        bus = snapshot.bus
        if bus.state not in UNPRINTED_BUS_STATES:
            detail = f": {bus.detail}" if bus.detail else ""
            yield from self._new("bus", f"bus {bus.name} {bus.state}{detail}")
        test = snapshot.test
        if test is not None and test.phase:
            name = f"test {test.name!r}" if test.name else "no test"
            yield from self._new("test", f"{name}: {test.phase}")
        if snapshot.severities:
            yield from self._new("severities", _severities_text(snapshot.severities))
        fresh = snapshot.alarm_count - self._alarms
        self._alarms = snapshot.alarm_count
        against = ""
        if snapshot.command == "bit" and snapshot.residuals is not None:
            against = f", compared with {snapshot.residuals.against}"
        for alarm in snapshot.alarms[len(snapshot.alarms) - min(fresh, len(snapshot.alarms)) :]:
            yield _alarm_text(alarm) + against
        for note in snapshot.notes:
            yield from self._new(note, note)
        if snapshot.ending is not None and snapshot.command == "monitor":
            reasons = "; ".join(snapshot.ending.reasons)
            yield from self._new(
                "ending", snapshot.ending.verdict + (f": {reasons}" if reasons else "")
            )

    def _new(self, key: str, text: str) -> Iterator[str]:
        if self._printed.get(key) != text:
            self._printed[key] = text
            yield text


def _severities_text(severities: Sequence[Severity]) -> str:
    each = (
        f"{item.name} {item.value:.4f}" + ("" if item.std is None else f" ± {item.std:.4f}")
        for item in severities
    )
    return f"{', '.join(each)} ({severities[0].source})"


def _alarm_text(alarm: Alarm) -> str:
    during = f" during test {alarm.during!r}" if alarm.during else ""
    recorded = f", recorded in {alarm.recorded}" if alarm.recorded else ""
    return f"ALARM {alarm.time}: {alarm.text}{during}{recorded}"


MIN_SCREEN_COLUMNS, MIN_SCREEN_LINES = 60, 20
"""Columns and lines of the smallest terminal with a live view; a smaller one gets plain lines."""


def can_show_screen(*, plain: bool) -> bool:
    """Whether the session is to be shown on a screen that is drawn anew."""
    if plain or not sys.stderr.isatty() or os.environ.get("TERM") in (None, "", "dumb", "unknown"):
        return False
    try:
        size = os.get_terminal_size(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return size.columns >= MIN_SCREEN_COLUMNS and size.lines >= MIN_SCREEN_LINES


class SessionScreen:
    """Shows the snapshots of a session: a live view, plain lines, or JSON lines.

    It begins with the first snapshot: until then lines may be printed. `take` is called in the
    thread of a reader, never in that of the bus. The context ends the live view.

    plain: plain lines also on a terminal; snapshots: write snapshots to standard output; whatever
    else is printed then goes to standard error.
    """

    def __init__(self, *, plain: bool, snapshots: bool = False) -> None:
        self._plain, self._snapshots = plain or snapshots, snapshots
        self._lines: StatusLines | None = None
        self._process: _ScreenProcess | None = None
        self._json: BinaryIO | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.close()

    def take(self, snapshot: Snapshot) -> None:
        """Show a snapshot."""
        if self._lines is None:
            self._begin()
        assert self._lines is not None
        if self._process is not None:
            self._process.take(snapshot)
        else:
            for line in self._lines.of(snapshot):
                print_status(line)
        if self._json is not None:
            try:
                self._json.write(snapshot.to_json() + b"\n")
                self._json.flush()
            except (OSError, ValueError):
                # The reader is gone: nothing moves unwatched.
                self._json = None
                signal.raise_signal(signal.SIGINT)

    def _begin(self) -> None:
        self._lines = StatusLines()
        if can_show_screen(plain=self._plain):
            self._process = _ScreenProcess.begun()
        if self._snapshots:
            self._json = sys.stdout.buffer
            sys.stdout = sys.stderr


class _ScreenProcess:
    """Hands snapshots to the process that draws them (`ehadiag.terminal.screen_process`)."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    @classmethod
    def begun(cls) -> _ScreenProcess | None:
        """Begin the process; None where it cannot be."""
        # -P: a folder that the user works in is no place to load Python files from.
        command = [sys.executable, "-P", "-m", "ehadiag.terminal.screen_process"]
        try:
            return cls(
                subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, bufsize=0
                )
            )
        except OSError:
            return None

    def take(self, snapshot: Snapshot) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError, ValueError):  # it has ended: the test goes on
            self._process.stdin.write(snapshot.to_json() + b"\n")

    def close(self) -> None:
        """Let it draw what it has, and end."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:  # a terminal that takes nothing
            self._process.kill()
            self._process.wait()
