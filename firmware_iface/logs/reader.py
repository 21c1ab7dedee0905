"""Reads logs (BLF, ASC, CSV, TRC, MF4, candump): frames in blocks of columns, and their tests."""

from __future__ import annotations

import logging
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
from msgspec.structs import replace

from firmware_iface.alignment.align import windowed_recordings
from firmware_iface.bus_map import BusMap, default_map
from firmware_iface.errors import ConfigurationError, EhadiagError, InputOutputError
from firmware_iface.find_test import CandidateTests
from firmware_iface.logs.log_files import (
    Budget,
    DamagedLogError,
    LogReader,
    Spending,
    find_reader,
    kind_of,
    known_suffixes,
    log_size,
    unpacked_log,
)
from firmware_iface.recording import IntArray, Recording
from firmware_iface.transport.frames import FrameTable, concatenate


class FrameLog:
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
        Unknown kind of log, or a faulty reader of another package.
    """

    path: Path
    notes: tuple[str, ...]

    def __init__(self, path: Path | str, budget: Budget | None = None) -> None:
        self.path = Path(path)
        self._budget = budget or Budget()
        self._spending = Spending(self.path, self._budget)
        size = log_size(self.path)
        found = find_reader(self.path, decodes=False)
        if found is None:
            kind = kind_of(self.path) or "without a suffix"
            raise ConfigurationError(
                f"log {self.path}: unknown kind {kind}; known: {', '.join(known_suffixes())}, and"
                " these packed as .gz"
            )
        self._reader: LogReader = found.reader
        self.notes = found.notes
        self._origin = found.origin
        self._spending.check_size(size)
        if size == 0:
            raise InputOutputError(f"log {self.path}: the file is empty")

    def __iter__(self) -> Iterator[FrameTable]:
        stamps = _StampCounts()
        with (
            unpacked_log(self.path, self._budget.size) as plain,
            SkippedLines() as complaints,
        ):
            self._spending.check_size(log_size(plain.path))
            trouble = yield from self._tables(plain.path, stamps)
            trouble = plain.trouble or trouble
        frames = self._spending.frames
        if frames == 0:
            reason = f" ({trouble})" if trouble else ""
            raise InputOutputError(f"log {self.path}: no frames in it{reason}")
        if complaints.count:
            self.notes += (f"{complaints.count} lines of the log could not be read",)
        self.notes += stamps.notes()
        if trouble:
            self.notes += (f"{trouble} after {frames} frames; the rest is lost",)

    def _tables(self, plain: Path, stamps: _StampCounts) -> Generator[FrameTable, None, str]:
        """Tables of frames; returns what ended the reading early, empty at the regular end."""
        tables: Iterator[FrameTable] | None = None
        while True:
            try:
                tables = tables or iter(self._reader.frames(plain, self._spending))
                table = next(tables, None)
            except DamagedLogError as error:
                return str(error)
            except EhadiagError:
                raise
            except Exception as error:
                if not self._origin:
                    raise
                return f"the log breaks off or is damaged: {type(error).__name__} in its reader"
            if table is None:
                return ""
            if not isinstance(table, FrameTable):
                raise ConfigurationError(f"log reader {self._origin}: yields no FrameTable")
            self._spending.add_frames(len(table))
            stamps.take(table.time_ns)
            yield table


class SkippedLines(logging.Handler):
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
        sys.unraisablehook = self._pass_on
        return self

    def __exit__(self, *_: object) -> None:
        logging.getLogger("can").removeHandler(self)
        sys.unraisablehook = self._hook

    def _pass_on(self, what: Any) -> None:
        if not getattr(what.object, "__module__", "").startswith("asammdf."):
            self._hook(what)


MAX_STANDING = 0.5
"""Largest share of stamps, 1, that may equal the one before; bursts of a serial adapter have less
than half of their frames in one stamp, a clock that stands all of them."""


class _StampCounts:
    """Counts stamps that run backward or stand still, of any format."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._steps = self._back = self._standing = 0
        self._farthest = 0

    def take(self, time_ns: IntArray) -> None:
        """Take the stamps of the next frames."""
        if not len(time_ns):
            return
        step = np.diff(time_ns, prepend=time_ns[0] if self._last is None else self._last)
        self._steps += len(step) - (self._last is None)
        self._standing += int((step == 0).sum()) - (self._last is None)
        # Frames of several channels are sorted less exactly than 1 ms.
        self._back += int((step <= -1_000_000).sum())
        self._farthest = min(self._farthest, int(step.min()))
        self._last = int(time_ns[-1])

    def notes(self) -> tuple[str, ...]:
        """Return what a reader should know."""
        found = []
        if self._back:
            found.append(
                f"time stamps run backward {self._back} times in {self._steps + 1} frames, by up to"
                f" {-1e-9 * self._farthest:.3g} s"
            )
        if self._standing > MAX_STANDING * self._steps:
            found.append(
                f"{self._standing} of {self._steps + 1} time stamps are those of the frame before"
            )
        return tuple(found)


def iterate_recordings(
    path: Path | str,
    bus_map: BusMap | None = None,
    budget: Budget | None = None,
    candidates: CandidateTests | None = None,
) -> Iterator[Recording]:
    """Read a log and give its tests in order of time, each as soon as it is complete.

    Memory is that of the longest test, whatever the length of the log. A log without a test gives
    one recording without samples.

    Parameters
    ----------
    path : Path | str
        File to read.
    bus_map : BusMap | None
        Which message and signal plays which role.
    budget : Budget | None
        Bytes, frames and seconds that reading may cost; None: the default.
    candidates : CandidateTests | None
        What to look for where the bus does not say when which test ran.

    Yields
    ------
    Recording
        Each test as soon as it is complete.

    Raises
    ------
    InputOutputError
        The file is missing, unreadable, not what its suffix says, or beyond its budget.
    ConfigurationError
        Unknown kind of log.
    """
    budget = budget or Budget()
    reader = FrameLog(path, budget)
    tests = windowed_recordings(
        reader, bus_map or default_map(), str(path), budget.held, candidates=candidates
    )
    for recording in tests:
        yield with_notes(recording, reader.notes)


def read_recordings(
    path: Path | str,
    bus_map: BusMap | None = None,
    budget: Budget | None = None,
    candidates: CandidateTests | None = None,
) -> tuple[Recording, ...]:
    """Read all tests in a log, in order of time; see `iterate_recordings`."""
    return tuple(iterate_recordings(path, bus_map, budget, candidates))


def with_notes(item: Recording, notes: tuple[str, ...]) -> Recording:
    """Return a recording with further notes."""
    if not notes:
        return item
    return replace(item, quality=replace(item.quality, notes=(*item.quality.notes, *notes)))


def read_frames(path: Path | str, budget: Budget | None = None) -> FrameTable:
    """Read all frames of a log at once; a log that breaks off is read up to the break.

    Parameters
    ----------
    path : Path | str
        File to read.
    budget : Budget | None
        Bytes, frames and seconds that reading may cost; None: the default.

    Returns
    -------
    FrameTable
        The frames in columns, in order of arrival.

    Raises
    ------
    InputOutputError, ConfigurationError
        See `FrameLog`; also where there are more frames than the budget allows to hold at
        once.
    """
    budget = budget or Budget()
    tables: list[FrameTable] = []
    count = 0
    for table in FrameLog(path, budget):
        tables.append(table)
        count += len(table)
        if count > budget.held:
            raise InputOutputError(
                f"log {path}: more than {budget.held} frames, too many to hold at once; cut it"
            )
    return concatenate(tables)
