"""Records the seconds around each alarm: those before it are kept in memory until then."""

from __future__ import annotations

import itertools
import os
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.core.errors import InputOutputError, reason_of

if TYPE_CHECKING:
    from firmware_iface.logs.recorder import Recorder
    from firmware_iface.transport.frames import Frame

__all__ = ["MOST", "Surroundings"]

MOST = 1000
"""Recordings of one session: a rig that alarms all night does not fill the disk."""
MOST_FRAMES = 200_000
"""Kept in memory."""


class Surroundings:
    """Keeps the newest frames, and writes them and what follows to a BLF when an alarm comes.

    An alarm that comes while the recording of the one before still runs prolongs it.

    Parameters
    ----------
    folder : Path | None
        Where recordings go; None: nothing is recorded.
    seconds : float
        Before and after an alarm.
    channel : int | None
        Adapter channel to write.

    Raises
    ------
    InputOutputError
        The folder cannot be made.
    """

    def __init__(self, folder: Path | None, seconds: float, channel: int | None = None) -> None:
        self._folder = folder
        self._span_ns = round(seconds * 1e9)
        self._channel = channel
        self._kept: deque[Frame] = deque(maxlen=MOST_FRAMES)
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

        Parameters
        ----------
        time_ns : int
            Time stamp of the frame that led to it, ns.

        Returns
        -------
        str
            Name of the file; empty where none is written.

        Raises
        ------
        InputOutputError
            It cannot be written.
        """
        if self._folder is None:
            return ""
        self._until_ns = time_ns + self._span_ns
        if self._recorder is not None:
            return self._name
        if self._count >= MOST:
            return ""
        from firmware_iface.logs.recorder import Recorder  # noqa: PLC0415 - loads python-can

        self._count += 1
        path = self._unused()
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

    def _unused(self) -> Path:
        """Return a name that no file has yet."""
        assert self._folder is not None
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        for number in itertools.count(1):
            suffix = f"-{number}" if number > 1 else ""
            path = self._folder / f"{stamp}-alarm{suffix}.blf"
            if not os.path.lexists(path):
                return path
        raise AssertionError("numbers have no end")
