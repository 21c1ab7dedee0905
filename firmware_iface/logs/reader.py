"""Recordings on disk (BLF, ASC, CSV, TRC, MF4, candump; packed): into columns, and into tests."""

from __future__ import annotations

import gc
import logging
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from ehadiag.core.errors import ConfigurationError, InputOutputError
from ehadiag.core.recording import BitState, Recording
from firmware_iface.alignment.align import assemble
from firmware_iface.logs.asc_lines import open_asc, open_text
from firmware_iface.logs.blf import read_blf
from firmware_iface.logs.candump_log import candump_frames
from firmware_iface.logs.packed import kind_of, unpacked
from firmware_iface.mapping.bus_map import BusMap, default_map
from firmware_iface.transport.columns import ColumnBuilder
from firmware_iface.transport.frames import MAX_PAYLOAD, FrameTable

if TYPE_CHECKING:
    from can import Message

__all__ = ["SUFFIXES", "read_frames", "read_recording", "read_recordings"]

SUFFIXES = (".blf", ".asc", ".csv", ".trc", ".mf4", ".log")
MAX_LOG_BYTES = 2 << 30
"""Largest log that is read: some ten hours of this bus."""
MAX_FRAMES = 100_000_000


def read_recordings(path: Path | str, bus_map: BusMap | None = None) -> tuple[Recording, ...]:
    """Read all tests in a log, in order of time; a log without one gives one empty recording.

    Raises
    ------
    InputOutputError: the file is missing, unreadable, or not what its suffix says.
    ConfigurationError: unknown kind of log.
    """
    table, notes = read_frames_noted(path)
    return assemble(table, bus_map or default_map(), str(path), notes)


def read_recording(path: Path | str, bus_map: BusMap | None = None) -> Recording:
    """Read the last complete test of a log; the last one begun if none was completed.

    Raises
    ------
    InputOutputError: the file is missing, unreadable, or not what its suffix says.
    ConfigurationError: unknown kind of log.
    """
    return choose(read_recordings(path, bus_map))


def choose(recordings: tuple[Recording, ...]) -> Recording:
    """Return the last complete test, or the last with samples, or the last."""
    for wanted in (_complete, _sampled):
        found = [item for item in recordings if wanted(item)]
        if found:
            return found[-1]
    return recordings[-1]


def _complete(item: Recording) -> bool:
    return item.samples is not None and item.outcome.state is BitState.COMPLETE


def _sampled(item: Recording) -> bool:
    return item.samples is not None


def read_frames(path: Path | str) -> FrameTable:
    """Read all frames of a log; a log that breaks off is read up to the break."""
    return read_frames_noted(path)[0]


def read_frames_noted(path: Path | str) -> tuple[FrameTable, tuple[str, ...]]:
    """Read all frames of a log, with notes on the reading."""
    path = Path(path)
    try:
        if not path.is_file():
            raise InputOutputError(
                f"log {path}: {'not a file' if path.exists() else 'no such file'}"
            )
        size = path.stat().st_size
        with path.open("rb"):
            pass
    except OSError as error:
        raise InputOutputError(f"log {path}: {error.strerror or error}") from None
    suffix = kind_of(path)
    if suffix not in SUFFIXES:
        raise ConfigurationError(
            f"log {path}: unknown kind {suffix or 'without a suffix'}; known: "
            f"{', '.join(SUFFIXES)}, and these packed as .gz"
        )
    if size > MAX_LOG_BYTES:
        raise InputOutputError(f"log {path}: larger than {MAX_LOG_BYTES >> 20} MiB; split it")
    if size == 0:
        raise InputOutputError(f"log {path}: the file is empty")
    with unpacked(path, MAX_LOG_BYTES) as plain:
        table, notes = _collect(plain.path, suffix)
    if plain.trouble:
        notes += (f"{plain.trouble} after {len(table)} frames; the rest is lost",)
    return table, notes


def _collect(path: Path, suffix: str) -> tuple[FrameTable, tuple[str, ...]]:
    columns = ColumnBuilder()
    notes: tuple[str, ...] = ()
    with _Complaints() as complaints:
        if suffix == ".blf":
            trouble = read_blf(path, columns)
        elif suffix == ".log":
            trouble = _read_candump(path, columns)
        else:
            trouble = _read_text(path, suffix, columns)
    if len(columns) == 0:
        reason = f" ({trouble})" if trouble else ""
        raise InputOutputError(f"log {path}: no frames in it{reason}")
    if complaints.count:
        notes += (f"{complaints.count} lines of the log could not be read",)
    if trouble:
        notes += (f"{trouble} after {len(columns)} frames; the rest is lost",)
    return columns.table(), notes


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


def _read_candump(path: Path, columns: ColumnBuilder) -> str:
    lines = open_text(path)
    try:
        for frame, _ in candump_frames(lines):
            columns.add(
                frame.time_ns,
                frame.can_id,
                frame.data,
                extended=frame.extended,
                fd=frame.fd,
                error=frame.error,
                remote=frame.remote,
                sent=frame.sent,
            )
            if len(columns) > MAX_FRAMES:
                raise InputOutputError(f"log {path}: more than {MAX_FRAMES} frames; split it")
    finally:
        lines.close()
    return "" if len(columns) else "no line as candump -l writes it"


def _read_text(path: Path, suffix: str, columns: ColumnBuilder) -> str:
    """Read the other kinds through python-can."""
    if suffix == ".asc":
        # A date in a language that python-can does not know fails the file: time then starts at 0.
        try:
            return _read_with(path, suffix, columns, dated=True)
        except InputOutputError:
            return _read_with(path, suffix, columns, dated=False)
    return _read_with(path, suffix, columns, dated=True)


def _read_with(path: Path, suffix: str, columns: ColumnBuilder, *, dated: bool) -> str:
    reader: Any = None
    failed = ""
    try:
        reader = _reader(path, suffix, dated)
        for message in reader:
            _add(message, columns)
            if len(columns) > MAX_FRAMES:
                raise InputOutputError(f"log {path}: more than {MAX_FRAMES} frames; split it")
    except InputOutputError:
        raise
    except Exception as error:  # the readers raise whatever a bad file leads them to
        failed = " ".join(str(error).split())[:160] or type(error).__name__
    finally:
        if reader is not None:
            reader.stop()
    if failed and suffix == ".mf4":
        gc.collect()  # or the destructor is heard of later
    if failed and len(columns) == 0:
        raise InputOutputError(f"log {path}: not a readable {suffix[1:].upper()} log: {failed}")
    return "the log breaks off or is damaged" if failed else ""


def _reader(path: Path, suffix: str, dated: bool) -> Any:
    import can  # noqa: PLC0415 - slow to import

    if suffix == ".asc":
        return can.ASCReader(open_asc(path), relative_timestamp=not dated)
    kinds: dict[str, Any] = {".csv": can.CSVReader, ".trc": can.TRCReader}
    if suffix in kinds:
        return kinds[suffix](open_text(path))
    try:
        return can.MF4Reader(str(path))
    except NotImplementedError:
        raise InputOutputError(
            f"log {path}: MF4 needs asammdf: pip install 'ehadiag[mf4]'"
        ) from None


def _add(message: Message, columns: ColumnBuilder) -> None:
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
    )
