"""Recordings on disk (BLF, ASC, CSV, TRC, MF4): into columns of frames, and into tests."""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ehadiag.errors import ConfigurationError, InputOutputError
from ehadiag.recording import BitState, Recording
from firmware_iface.align import assemble
from firmware_iface.busmap import BusMap, default_map
from firmware_iface.frames import MAX_PAYLOAD, FrameTable

if TYPE_CHECKING:
    from can import Message

__all__ = ["SUFFIXES", "read_frames", "read_recording", "read_recordings"]

SUFFIXES = (".blf", ".asc", ".csv", ".trc", ".mf4")
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
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ConfigurationError(
            f"log {path}: unknown kind {suffix or 'without a suffix'}; known: {', '.join(SUFFIXES)}"
        )
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
    if size > MAX_LOG_BYTES:
        raise InputOutputError(f"log {path}: larger than {MAX_LOG_BYTES >> 20} MiB; split it")
    if size == 0:
        raise InputOutputError(f"log {path}: the file is empty")
    return _collect(path, suffix)


def _reader(path: Path, suffix: str) -> Any:
    import can  # noqa: PLC0415 - slow to import

    if suffix == ".asc":
        return can.ASCReader(str(path), relative_timestamp=False)
    kinds = {".blf": can.BLFReader, ".csv": can.CSVReader, ".trc": can.TRCReader}
    if suffix in kinds:
        return kinds[suffix](str(path))
    try:
        return can.MF4Reader(str(path))
    except NotImplementedError:
        raise InputOutputError(
            f"log {path}: MF4 needs the extra: pip install ehadiag[mf4]"
        ) from None


def _collect(path: Path, suffix: str) -> tuple[FrameTable, tuple[str, ...]]:
    columns = _Columns()
    notes: tuple[str, ...] = ()
    reader = None
    try:
        reader = _reader(path, suffix)
        for message in reader:
            columns.add(message)
            if len(columns) > MAX_FRAMES:
                raise InputOutputError(f"log {path}: more than {MAX_FRAMES} frames; split it")
    except InputOutputError:
        raise
    except Exception as error:  # noqa: BLE001 - the readers raise whatever a bad file leads them to
        if len(columns) == 0:
            reason = " ".join(str(error).split())[:160] or type(error).__name__
            raise InputOutputError(
                f"log {path}: not a readable {suffix[1:].upper()} log: {reason}"
            ) from None
        notes = (f"the log breaks off or is damaged after {len(columns)} frames; the rest is lost",)
    finally:
        if reader is not None:
            reader.stop()
    if len(columns) == 0:
        raise InputOutputError(f"log {path}: no frames in it")
    return columns.table(), notes


class _Columns:
    """Grows columns frame by frame: 40 bytes a frame, no object kept."""

    def __init__(self) -> None:
        self._time = array("d")
        self._id = array("L")
        self._flags = array("B")
        self._length = array("B")
        self._data = bytearray()
        self._width = 8

    def __len__(self) -> int:
        return len(self._time)

    def add(self, message: Message) -> None:
        """Append one python-can message."""
        data = message.data
        size = len(data)
        if size > self._width:
            self._widen()
        self._time.append(message.timestamp)
        self._id.append(message.arbitration_id)
        self._length.append(size)
        self._flags.append(
            message.is_extended_id
            | message.is_fd << 1
            | message.is_error_frame << 2
            | message.is_remote_frame << 3
            | (not message.is_rx) << 4
        )
        self._data += data
        if size < self._width:
            self._data += bytes(self._width - size)

    def _widen(self) -> None:
        old = np.frombuffer(bytes(self._data), dtype=np.uint8).reshape(-1, self._width)
        wide = np.zeros((len(old), MAX_PAYLOAD), dtype=np.uint8)
        wide[:, : self._width] = old
        self._data = bytearray(wide.tobytes())
        self._width = MAX_PAYLOAD

    def table(self) -> FrameTable:
        """Columns as arrays."""
        flags = np.frombuffer(self._flags, dtype=np.uint8)
        seconds = np.frombuffer(self._time, dtype=np.float64)
        return FrameTable(
            time_ns=to_ns(seconds),
            can_id=np.array(self._id, dtype=np.uint32),
            length=np.frombuffer(self._length, dtype=np.uint8),
            data=np.frombuffer(self._data, dtype=np.uint8).reshape(-1, self._width),
            extended=(flags & 1).astype(np.bool_),
            fd=(flags & 2).astype(np.bool_),
            error=(flags & 4).astype(np.bool_),
            remote=(flags & 8).astype(np.bool_),
            sent=(flags & 16).astype(np.bool_),
        )


def to_ns(seconds: np.ndarray[Any, np.dtype[np.float64]]) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Seconds as written by a logger to integer ns; a stamp that is no time becomes 0."""
    whole = np.floor(np.nan_to_num(seconds, nan=0.0, posinf=0.0, neginf=0.0))
    whole = np.clip(whole, -9e9, 9e9)
    part = np.clip(np.nan_to_num(seconds - whole, nan=0.0, posinf=0.0, neginf=0.0), 0.0, 1.0)
    return whole.astype(np.int64) * 1_000_000_000 + np.rint(part * 1e9).astype(np.int64)
