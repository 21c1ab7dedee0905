"""Records raw frames to disk as they arrive, before anything is decoded."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

from ehadiag.core.errors import ConfigurationError, InputOutputError, reason_of
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.python_can import message_of

__all__ = ["Recorder"]

SUFFIXES = (".blf", ".asc", ".csv", ".trc", ".mf4")
AT_THE_END = ".mf4"
"""Its library writes when the file is closed, nothing before."""
FLUSH_PERIOD = 0.5
"""s between flushes; a second is the most that may be lost."""
MAX_FILES = 10_000
SMALLEST_FILE = 65_536
"""Bytes below which rotation makes no sense."""


class Recorder:
    """Writes frames to `path` in the format of its suffix (BLF, ASC, CSV, TRC, MF4).

    Flushed every half second, so that a killed process leaves a readable file up to then; MF4 is
    the exception. With `max_bytes` a file that has grown beyond it is closed and the next one begun
    (`name.blf`, `name-2.blf`, …). An existing file is never overwritten. Any thread may call.

    Parameters
    ----------
    path : Path | str
        File to write; the suffix chooses the format.
    max_bytes : int | None
        Size at which the next file is begun; None: never.
    channel : int | None
        Adapter channel to write for frames of a bus that has only one.

    Raises
    ------
    ConfigurationError
        Unknown suffix; MF4 without its library; `max_bytes` too small.
    InputOutputError
        The file exists, or cannot be written, now or later.
    """

    def __init__(
        self, path: Path | str, *, max_bytes: int | None = None, channel: int | None = None
    ) -> None:
        self._first = Path(path)
        self._suffix = self._first.suffix.lower()
        if self._suffix not in SUFFIXES:
            raise ConfigurationError(
                f"recording {path}: suffix unknown, need one of {' '.join(SUFFIXES)}"
            )
        if max_bytes is not None and max_bytes < SMALLEST_FILE:
            raise ConfigurationError(
                f"recording {path}: files of {max_bytes} bytes, need at least {SMALLEST_FILE}"
            )
        self._max_bytes = max_bytes
        self._channel = channel or 0
        self._lock = threading.RLock()
        self._paths: list[Path] = []
        self._frames = 0
        self._skipped = 0
        self._flushed = time.monotonic()
        self._dirty = False
        self._closed = False
        self._writer: Any = None
        with self._guarded():
            try:
                self._begin()
            except BaseException:
                self._leave_nothing()
                raise

    @property
    def paths(self) -> tuple[Path, ...]:
        """Files written so far, in order."""
        return tuple(self._paths)

    @property
    def frames(self) -> int:
        """Frames written."""
        return self._frames

    @property
    def skipped(self) -> int:
        """Frames that the format cannot hold: error, remote and FD frames in TRC."""
        return self._skipped

    def write(self, frame: Frame) -> None:
        """Take one frame; after `close` nothing is taken.

        Parameters
        ----------
        frame : Frame
            The frame to write.

        Raises
        ------
        InputOutputError
            The file cannot be written.
        """
        with self._guarded():
            if self._closed:
                return
            if self._suffix == ".trc" and (frame.error or frame.remote or frame.fd):
                self._skipped += 1
                return
            message = message_of(frame)
            if number := frame.channel or self._channel:
                # python-can counts channels from 0, and its MF4 writer as they are in the file.
                message.channel = number if self._suffix == ".mf4" else number - 1
            self._writer.on_message_received(message)
            self._frames += 1
            self._dirty = True
            # The first one at once: it gives a BLF header its start time.
            if self._frames == 1 or self._due():
                self._flush()

    def idle(self) -> None:
        """Flush if it is time; called while the bus is silent."""
        if self._dirty and self._due():
            self.flush()

    def flush(self) -> None:
        """Bring everything so far to the file."""
        with self._guarded():
            if not self._closed:
                self._flush()

    def close(self) -> None:
        """Finish the file; may be called twice."""
        with self._guarded():
            if not self._closed:
                self._closed = True
                try:
                    self._writer.stop()
                finally:  # a full disk must not leave the file open
                    self._let_go()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _begin(self) -> None:
        from firmware_iface.logs.writers import open_writer  # noqa: PLC0415 - costs half a second

        number = len(self._paths) + 1
        path = self._first
        if number > 1:
            path = path.with_name(f"{path.stem}-{number}{path.suffix}")
        self._writer = open_writer(path)
        self._paths.append(path)
        self._flush()

    def _let_go(self) -> None:
        """Close the file, though what is left in memory cannot be written."""
        if self._suffix != AT_THE_END:
            with contextlib.suppress(OSError):
                self._writer.file.close()

    def _leave_nothing(self) -> None:
        """Remove the first file, into which not even its header could be written."""
        for path in self._paths:
            self._let_go()
            with contextlib.suppress(OSError):
                path.unlink()

    def _due(self) -> bool:
        return time.monotonic() - self._flushed >= FLUSH_PERIOD

    def _flush(self) -> None:
        self._flushed = time.monotonic()
        self._dirty = False
        if self._suffix == AT_THE_END:
            return
        writer = self._writer
        (writer if hasattr(writer, "flush") else writer.file).flush()
        if self._max_bytes is not None and writer.file.tell() >= self._max_bytes:
            if len(self._paths) >= MAX_FILES:
                raise InputOutputError(f"recording {self._first}: more than {MAX_FILES} files")
            writer.stop()
            self._begin()

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """One caller at a time; errors of the file as ours."""
        with self._lock:
            try:
                yield
            except FileExistsError:
                raise InputOutputError(
                    f"recording {self._first}: exists, and is not overwritten; name another file"
                ) from None
            except OSError as error:
                raise InputOutputError(f"recording {self._first}: {reason_of(error)}") from None
