"""Where the alarms of a monitor go: log, command of the user's, recording of the seconds around."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehadiag.core.conventions import utc_text
from firmware_iface.errors import ConfigurationError, InputOutputError, reason_of, valid_text
from firmware_iface.files import append_to_file, unused_path

if TYPE_CHECKING:
    from firmware_iface.logs.recorder import Recorder
    from firmware_iface.transport.frames import Frame

MONITOR_LOG_SCHEMA = "ehadiag.monitor/1"


class AlarmLog:
    """Appends events to a file; without one it keeps nothing.

    path: the file; it is made where there is none. None: no log. InputOutputError: it cannot be
    opened, is a link or no file.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path = path
        try:
            self._file = (
                None if path is None else os.fdopen(append_to_file(path), "a", encoding="utf-8")
            )
        except OSError as error:
            raise InputOutputError(f"log {path}: {reason_of(error)}") from None

    def write(self, event: str, **content: Any) -> dict[str, Any]:
        """Append an event, and return what was written.

        event: its name: `begin`, `unit`, `alarm` or `end`; content: its other keys. Returns the
        object of the line. InputOutputError: it cannot be written.
        """
        texts = {
            key: valid_text(value) if isinstance(value, str) else value
            for key, value in content.items()
        }
        tree = {"schema": MONITOR_LOG_SCHEMA, "time": utc_now_text(), "event": event, **texts}
        if self._file is not None:
            try:
                self._file.write(json.dumps(tree, allow_nan=False) + "\n")
                self._file.flush()
                os.fsync(self._file.fileno())
            except OSError as error:
                raise InputOutputError(f"log {self._path}: {reason_of(error)}") from None
        return tree

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()


def utc_now_text() -> str:
    """Time of day: UTC, ISO 8601, to the millisecond."""
    return utc_text(datetime.now(UTC))


class AlarmCommand:
    """Runs a command with the alarm's JSON object on its standard input, one call at a time.

    An alarm that comes while a call still runs makes none: the log has them all. What the command
    prints goes nowhere.

    arguments: program and arguments; empty: nothing is called; report: called at the end with what
    went wrong last; None: it is logged. ConfigurationError: there is no such program.
    """

    def __init__(
        self,
        arguments: Sequence[str] = (),
        report: Callable[[str], None] | None = None,
    ) -> None:
        if arguments and shutil.which(arguments[0]) is None:
            raise ConfigurationError(f"--on-alarm {arguments[0]}: no such program")
        self._arguments, self._report = (
            list(arguments),
            report or logging.getLogger("ehadiag").warning,
        )
        self._thread: threading.Thread | None = None
        self.calls = 0
        """Number of calls begun."""
        self.failed = ""
        """Latest failure; empty without one."""

    def call(self, event: dict[str, Any]) -> None:
        """Begin a call, in a thread of its own: nobody waits for it."""
        if not self._arguments or (self._thread is not None and self._thread.is_alive()):
            return
        self.calls += 1
        self._thread = threading.Thread(
            target=self._run, args=(event,), name="ehadiag-on-alarm", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Wait for a call that runs, but not for long."""
        if self._thread is not None:
            self._thread.join(5.0)
        if self.failed:
            self._report(f"--on-alarm {self._arguments[0]}: {self.failed}")

    def _run(self, event: dict[str, Any]) -> None:
        try:
            done = subprocess.run(
                self._arguments,
                input=json.dumps(event).encode() + b"\n",
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                check=False,
            )
            if done.returncode:
                self.failed = f"ended with code {done.returncode}"
        except (OSError, ValueError) as error:
            self.failed = reason_of(error)


class AlarmRecorder:
    """Keeps the newest frames, and writes them and what follows to a BLF when an alarm comes.

    An alarm that comes while the recording of the one before still runs prolongs it.

    folder: where recordings go; None: nothing is recorded; seconds: before and after an alarm;
    channel: adapter channel to write. InputOutputError: the folder cannot be made.
    """

    def __init__(
        self, folder: Path | None = None, seconds: float = 0.0, channel: int | None = None
    ) -> None:
        self._folder = folder
        self._span_ns = round(seconds * 1e9)
        self._channel = channel
        self._kept: deque[Frame] = deque(maxlen=200_000)
        self._recorder: Recorder | None = None
        self._name = ""
        self._until_ns = 0
        self._count = 0
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except FileExistsError:
                raise InputOutputError(f"--record {folder}: is a file; name a folder") from None
            except OSError as error:
                raise InputOutputError(f"folder {folder}: {reason_of(error)}") from None

    def take(self, frame: Frame) -> None:
        """Take a frame, in order of arrival; InputOutputError where it cannot be written."""
        if self._folder is None:
            return
        if self._recorder is not None:
            if frame.time_ns <= self._until_ns:
                self._recorder.write(frame)
                return
            self.close()
        kept = self._kept
        kept.append(frame)
        oldest = frame.time_ns - self._span_ns
        while kept[0].time_ns < oldest:
            kept.popleft()

    def record(self, time_ns: int) -> str:
        """Record the seconds around an alarm at that time.

        time_ns: time stamp of the frame that led to it, ns. Returns name of the file; empty where
        none is written: decoded signals have no frames. InputOutputError: it cannot be written.
        """
        if self._folder is None or (self._recorder is None and not self._kept):
            return ""
        self._until_ns = time_ns + self._span_ns
        if self._recorder is not None:
            return self._name
        # A rig that alarms all night does not fill the disk.
        if self._count >= 1000:
            return ""
        from firmware_iface.logs.recorder import Recorder  # noqa: PLC0415 - loads python-can

        self._count += 1
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        path = unused_path(self._folder, f"{stamp}-alarm", ".blf")
        self._recorder, self._name = Recorder(path, channel=self._channel), path.name
        for frame in self._kept:
            self._recorder.write(frame)
        self._kept.clear()
        return self._name

    def idle(self) -> None:
        """Flush if it is time; called while the bus is silent."""
        if self._recorder is not None:
            self._recorder.idle()

    def close(self) -> None:
        """Finish a recording that runs; may be called twice."""
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            recorder.close()
