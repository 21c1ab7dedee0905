"""Reads logs (BLF, ASC, CSV, TRC, MF4, candump; packed) in blocks of columns, within a budget."""

from __future__ import annotations

import gc
import logging
import math
import stat
import sys
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from ehadiag.core.errors import ConfigurationError, InputOutputError, reason_of
from firmware_iface.logs.asc_lines import open_asc, open_text
from firmware_iface.logs.blf import BlfBlocks
from firmware_iface.logs.budget import Budget, Spending
from firmware_iface.logs.can_library import can_library, mf4_library
from firmware_iface.logs.candump_log import candump_frames
from firmware_iface.logs.packed import kind_of, unpacked
from firmware_iface.transport.columns import ColumnBuilder
from firmware_iface.transport.frames import MAX_CHANNEL, MAX_PAYLOAD, FrameTable

if TYPE_CHECKING:
    from can import Message

__all__ = ["SUFFIXES", "LogReader"]

SUFFIXES = (".blf", ".asc", ".csv", ".trc", ".mf4", ".log")
BLOCK = 50_000
"""Frames that a block of a text log has."""
LARGEST_MF4 = 128 << 20
"""Bytes. Its library holds all of a file's frames in memory, and more than once."""
NOT_FRAMES = {"CSV": " of frames, as python-can writes them; are these decoded signals?"}
"""What a kind of log is often taken for."""
COUNTED_FROM_0 = (".asc",)
"""Kinds whose channel numbers python-can lowers by one."""


class LogReader:
    """The frames of a log, one table after another, in memory that does not grow with its length.

    A log that breaks off is read up to the break; `notes` then say so.

    Parameters
    ----------
    path : Path | str
        File to read.
    budget : Budget | None
        Bytes, frames and seconds that reading may cost; None: the default.

    Attributes
    ----------
    path : Path
        File.
    notes : tuple[str, ...]
        Facts on the reading, complete once all blocks were taken.

    Raises
    ------
    InputOutputError
        The file is missing, no regular file, unreadable, not what its suffix says, without a
        frame, or beyond its budget.
    ConfigurationError
        Unknown kind of log.
    """

    path: Path
    notes: tuple[str, ...]

    def __init__(self, path: Path | str, budget: Budget | None = None) -> None:
        self.path = Path(path)
        self.notes = ()
        self._suffix = kind_of(self.path)
        self._budget = budget or Budget()
        self._spending = Spending(self.path, self._budget)
        self._file = self.path
        self._trouble = ""
        self._check_file()

    def _check_file(self) -> None:
        path = self.path
        try:
            state = path.stat()
            if not stat.S_ISREG(state.st_mode):
                raise InputOutputError(f"log {path}: not a file")
            with path.open("rb"):
                pass
        except (OSError, ValueError) as error:
            missing = isinstance(error, FileNotFoundError | NotADirectoryError)
            reason = "no such file" if missing else reason_of(error)
            raise InputOutputError(f"log {path}: {reason}") from None
        if self._suffix not in SUFFIXES:
            kind = self._suffix or "without a suffix"
            raise ConfigurationError(
                f"log {path}: unknown kind {kind}; known: {', '.join(SUFFIXES)}, .parquet of"
                " decoded signals, and these packed as .gz"
            )
        self._spending.check_size(state.st_size)
        if self._suffix == ".mf4" and state.st_size > LARGEST_MF4:
            raise InputOutputError(
                f"log {path}: an MF4 file beyond {LARGEST_MF4 >> 20} MiB takes too much memory;"
                " convert it to BLF"
            )
        if state.st_size == 0:
            raise InputOutputError(f"log {path}: the file is empty")

    def __iter__(self) -> Iterator[FrameTable]:
        most = LARGEST_MF4 if self._suffix == ".mf4" else self._budget.size
        with unpacked(self.path, most) as plain, _Complaints() as complaints:
            self._file = plain.path
            yield from self._blocks()
            self._trouble = plain.trouble or self._trouble
        frames = self._spending.frames
        if frames == 0:
            reason = f" ({self._trouble})" if self._trouble else ""
            raise InputOutputError(f"log {self.path}: no frames in it{reason}")
        if complaints.count:
            self.notes += (f"{complaints.count} lines of the log could not be read",)
        if self._trouble:
            self.notes += (f"{self._trouble} after {frames} frames; the rest is lost",)

    def _blocks(self) -> Iterator[FrameTable]:
        if self._suffix == ".blf":
            blf = BlfBlocks(self._file, self._spending)
            yield from blf
            self._trouble = blf.trouble
            return
        if self._suffix == ".log":
            yield from self._candump()
            return
        yield from self._messages(dated=True)
        if self._trouble and not self._spending.frames and self._suffix == ".asc":
            # A date in a language that python-can does not know fails the file: time starts at 0.
            yield from self._messages(dated=False)
        if self._trouble and not self._spending.frames:
            kind = self._suffix[1:].upper()
            raise InputOutputError(
                f"log {self.path}: not a readable {kind} log{NOT_FRAMES.get(kind, '')}"
            )

    def _candump(self) -> Iterator[FrameTable]:
        """Read candump's lines; interfaces are channels, from 1 in the order in which they come."""
        columns = ColumnBuilder()
        channels: dict[str, int] = {}
        with closing(open_text(self._file, self._spending.look_at_clock)) as lines:
            for frame, interface in candump_frames(lines):
                channel = channels.setdefault(interface, min(len(channels) + 1, MAX_CHANNEL))
                columns.add(
                    frame.time_ns,
                    frame.can_id,
                    frame.data,
                    extended=frame.extended,
                    fd=frame.fd,
                    error=frame.error,
                    remote=frame.remote,
                    sent=frame.sent,
                    channel=channel,
                )
                if len(columns) >= BLOCK:
                    self._spending.add_frames(len(columns))
                    yield columns.table()
                    columns = ColumnBuilder()
        self._spending.add_frames(len(columns))
        if len(columns):
            yield columns.table()
        if not self._spending.frames:
            self._trouble = "no line as candump -l writes it"

    def _messages(self, *, dated: bool) -> Iterator[FrameTable]:
        """Read the other kinds through python-can."""
        reader: Any = None
        columns = ColumnBuilder()
        self._trouble = ""
        try:
            reader = self._open(dated)
            for message in reader:
                self._add(message, columns)
                if len(columns) >= BLOCK:
                    self._spending.add_frames(len(columns))
                    yield columns.table()
                    columns = ColumnBuilder()
        except InputOutputError:
            raise
        except Exception:
            # The readers raise whatever a bad file leads them to, and their texts quote it.
            self._trouble = "the log breaks off or is damaged"
        finally:
            if reader is not None:
                with suppress(Exception):
                    reader.stop()
        if self._trouble and self._suffix == ".mf4":
            gc.collect()  # or the destructor is heard of later
        self._spending.add_frames(len(columns))
        if len(columns):
            yield columns.table()

    def _open(self, dated: bool) -> Any:
        can = can_library()
        if self._suffix == ".asc":
            lines = open_asc(self._file, self._spending.look_at_clock)
            return can.ASCReader(lines, relative_timestamp=not dated)
        kinds: dict[str, Any] = {".csv": can.CSVReader, ".trc": can.TRCReader}
        if self._suffix in kinds:
            return kinds[self._suffix](open_text(self._file, self._spending.look_at_clock))
        try:
            return mf4_library().MF4Reader(str(self._file))
        except NotImplementedError:
            raise InputOutputError(
                f"log {self.path}: MF4 needs asammdf: pip install 'ehadiag[mf4]'"
            ) from None

    def _add(self, message: Message, columns: ColumnBuilder) -> None:
        whole = math.floor(message.timestamp)
        columns.add(
            whole * 1_000_000_000 + round((message.timestamp - whole) * 1e9),
            message.arbitration_id & 0xFFFFFFFF,
            bytes(message.data[:MAX_PAYLOAD]),
            extended=message.is_extended_id,
            fd=message.is_fd,
            error=message.is_error_frame,
            remote=message.is_remote_frame,
            sent=not message.is_rx,
            channel=self._channel(message.channel),
        )

    def _channel(self, said: object) -> int:
        if not isinstance(said, int):
            return 0
        return min(max(said + (self._suffix in COUNTED_FROM_0), 0), MAX_CHANNEL)


class _Complaints(logging.Handler):
    """Counts what python-can's readers skip with no more than a line in its own log.

    And keeps quiet the destructor of asammdf, which fails where its constructor failed.
    """

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.count = 0
        self._hook = sys.unraisablehook

    def emit(self, _: logging.LogRecord) -> None:
        """Count a complaint."""
        self.count += 1

    def __enter__(self) -> Self:
        logging.getLogger("can").addHandler(self)
        sys.unraisablehook = self._tell
        return self

    def __exit__(self, *_: object) -> None:
        logging.getLogger("can").removeHandler(self)
        sys.unraisablehook = self._hook

    def _tell(self, what: Any) -> None:
        if not getattr(what.object, "__module__", "").startswith("asammdf."):
            self._hook(what)
