"""Readers of ASC, CSV, TRC and MF4 logs through python-can, and of candump's own.

Python-can is loaded without asammdf, which MF4 files alone need. Lines that its readers cannot
read are made readable here.
"""

from __future__ import annotations

import gc
import importlib
import logging
import math
import mmap
import re
import struct
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TextIO, cast

from firmware_iface.errors import InputOutputError, install_command
from firmware_iface.logs.log_files import DamagedLogError, Spending
from firmware_iface.transport.frames import (
    MAX_CHANNEL,
    MAX_PAYLOAD,
    ColumnBuilder,
    FrameTable,
)

if TYPE_CHECKING:
    from can import Message

MAX_MF4_BYTES = 128 << 20
"""Bytes of an MF4 file: its library holds all frames in memory, and more than once."""
MAX_PACKED_BLOCK = 64 << 20
"""Bytes that one packed block of an MF4 or HDF5 file may unpack to; usual are 1 to 4 MiB."""
MF4_PACKED_BLOCK = b"##DZ"
MF4_PACKED_HEAD = struct.Struct("<26xB13xQ")
"""Of a packed block: its method, bytes that follow."""
MF4_OTHER_METHODS = range(2, 6)
"""Zstandard and LZ4; 0 and 1 are deflate, no other number has a meaning."""
INFLATED_PIECE = 1 << 16
"""Bytes that are unpacked at once."""

MF4_LIBRARY = "asammdf"


def can_library() -> ModuleType:
    """Import python-can, unless it is loaded already without asammdf.

    Returns `can`; its MF4 classes may say that asammdf is missing, see `mf4_library`.
    """
    modules: dict[str, Any] = sys.modules
    if "can" in modules or MF4_LIBRARY in modules:
        return importlib.import_module("can")
    modules[MF4_LIBRARY] = None  # as if it were not installed
    try:
        return importlib.import_module("can")
    finally:
        del modules[MF4_LIBRARY]


def mf4_library() -> ModuleType:
    """Import python-can's reader and writer of MF4 files with asammdf, where it is installed.

    Returns `can.io.mf4`.
    """
    library = importlib.import_module("can.io.mf4")
    return library if library.asammdf else importlib.reload(library)


class _PythonCanReader:
    """Reads one kind of log through python-can, see `LogReader`."""

    signature = b""
    kind = ""
    """What a readable file is called in errors."""
    channel_offset = 0
    """Number of an adapter channel less what python-can makes of it."""
    resume_line = ""
    """Line at which python-can's reader goes on to frames when it begins amidst a text log."""

    def openers(self, path: Path, spending: Spending) -> Iterator[Callable[[], Any]]:
        """Ways to make python-can's reader of a file, each for a file that those before fail on."""
        raise NotImplementedError

    def frames(self, path: Path, spending: Spending) -> Iterator[FrameTable]:
        """Read a file."""
        found = False
        for open_file in self.openers(path, spending):
            try:
                for table in self._tables(open_file):
                    found = True
                    yield table
            except DamagedLogError:
                if found:
                    raise
            else:
                return
        raise InputOutputError(f"log {path}: not a readable {self.kind}")

    def _tables(self, open_file: Callable[[], Any]) -> Iterator[FrameTable]:
        reader: Any = None
        columns = ColumnBuilder()
        found = bad = 0
        intact = False
        try:
            reader = open_file()
            while not intact:
                try:
                    for message in reader:
                        self._add(message, columns)
                        found += 1
                        if len(columns) >= 50_000:
                            yield columns.table()
                            columns = ColumnBuilder()
                    intact = True
                except InputOutputError:
                    raise
                except Exception:
                    # The readers raise whatever a bad line leads them to, and their texts quote it.
                    bad += 1
                    if not self._resumes(reader, found, bad):
                        break
                    BAD_LINES.warning("a line that holds no frame")
        except InputOutputError:
            raise
        except Exception:
            intact = False
        finally:
            if reader is not None:
                with suppress(Exception):
                    reader.stop()
        if len(columns):
            yield columns.table()
        if not intact:
            self._release()
            raise DamagedLogError("the log breaks off or is damaged")

    def _release(self) -> None:
        """Destroy a reader that failed, where that must not be later."""

    def _resumes(self, reader: Any, found: int, bad: int) -> bool:
        """Whether a text log goes on after a bad line, which is then left out."""
        lines = getattr(reader, "file", None)
        begun = found or self.signature  # amidst a header nothing tells what a line means
        if not (begun and self.resume_line and isinstance(lines, _BoundedLines)):
            return False
        return bad <= found + MAX_BAD_LINES and lines.push(self.resume_line)

    def _add(self, message: Message, columns: ColumnBuilder) -> None:
        seconds = math.floor(message.timestamp)
        number = message.channel
        channel = number + self.channel_offset if isinstance(number, int) else 0
        columns.add(
            seconds * 1_000_000_000 + round((message.timestamp - seconds) * 1e9),
            message.arbitration_id & 0xFFFFFFFF,
            bytes(message.data[:MAX_PAYLOAD]),
            extended=message.is_extended_id,
            fd=message.is_fd,
            error=message.is_error_frame,
            remote=message.is_remote_frame,
            sent=not message.is_rx,
            channel=min(max(channel, 0), MAX_CHANNEL),
        )


class AscReader(_PythonCanReader):
    """Vector's text log."""

    kind = "ASC log"
    channel_offset = 1  # python-can counts them from 0
    resume_line = "no internal events logged"

    def openers(self, path: Path, spending: Spending) -> Iterator[Callable[[], Any]]:
        """With its date; without, where python-can does not know the date's language."""
        for relative in (False, True):
            yield partial(_open_asc_reader, path, spending, relative)


def _open_asc_reader(path: Path, spending: Spending, relative: bool) -> Any:
    lines = open_asc(path, spending)
    return can_library().ASCReader(lines, relative_timestamp=relative)


class CsvReader(_PythonCanReader):
    """The CSV log of python-can: frames, not signals."""

    signature = b"timestamp,arbitration_id"
    kind = "CSV log of frames, as python-can writes them; are these decoded signals?"
    resume_line = "timestamp,arbitration_id"

    def openers(self, path: Path, spending: Spending) -> Iterator[Callable[[], Any]]:
        """The one way."""
        yield lambda: can_library().CSVReader(open_text(path, spending))


class TrcReader(_PythonCanReader):
    """PEAK's text log."""

    kind = "TRC log"
    resume_line = ";"

    def openers(self, path: Path, spending: Spending) -> Iterator[Callable[[], Any]]:
        """The one way."""
        yield lambda: can_library().TRCReader(open_text(path, spending, TRC_LINE_PATTERN))


class Mf4Reader(_PythonCanReader):
    """ASAM's log of bus events."""

    kind = "MF4 log"

    def _release(self) -> None:
        """Destroy asammdf's object, whose destructor would fail later, beside something else."""
        gc.collect()

    def openers(self, path: Path, spending: Spending) -> Iterator[Callable[[], Any]]:
        """The one way, of a file that fits into memory."""
        spending.look_at_clock()
        if path.stat().st_size > MAX_MF4_BYTES:
            raise InputOutputError(
                f"log {path}: an MF4 file beyond {MAX_MF4_BYTES >> 20} MiB takes too much memory;"
                " convert it to BLF"
            )
        check_packed_blocks(path, MAX_MF4_BYTES)
        yield lambda: _open_mf4(path)


def check_packed_blocks(path: Path, most: int) -> None:
    """Refuse an MF4 file whose packed blocks take too much memory; what they state is not believed.

    path: the file; most: bytes that all blocks may unpack to. InputOutputError: they unpack to
    more, a single one to more than `MAX_PACKED_BLOCK`, or are not packed by deflate.
    """
    unpacked = 0
    with path.open("rb") as source, mmap.mmap(source.fileno(), 0, access=mmap.ACCESS_READ) as file:
        at = -1
        while (at := file.find(MF4_PACKED_BLOCK, at + 1)) >= 0:
            begin = at + MF4_PACKED_HEAD.size
            if begin > len(file):
                return
            method, length = MF4_PACKED_HEAD.unpack(file[at:begin])
            if method in MF4_OTHER_METHODS:
                raise InputOutputError(
                    f"log {path}: packed by another method than deflate; save it by deflate"
                )
            limit = min(most - unpacked, MAX_PACKED_BLOCK)
            size = inflated_size(file, begin, min(begin + length, len(file)), limit)
            if size > limit:
                raise InputOutputError(
                    f"log {path}: unpacks to more than {most >> 20} MiB, or one block of it to more"
                    f" than {MAX_PACKED_BLOCK >> 20} MiB; split it"
                )
            unpacked += size


def inflated_size(packed: bytes | mmap.mmap, begin: int, end: int, limit: int) -> int:
    """Bytes that data of deflate hold, or some number beyond the limit.

    Of damaged ones those before the damage, or some more: the work on them counts, too.
    """
    inflate, size = zlib.decompressobj(), 0
    try:
        while size <= limit and not inflate.eof:
            piece = inflate.unconsumed_tail
            if not piece:
                piece = packed[begin : min(begin + INFLATED_PIECE, end)]
                begin += len(piece)
            if not piece:
                break
            size += len(inflate.decompress(piece, INFLATED_PIECE))
    except zlib.error:  # data that look like a block, or damage: the reader says so
        size += INFLATED_PIECE
    return size


def _open_mf4(path: Path) -> Any:
    try:
        with path.open("rb") as file:  # of a path, a reader that fails would leave it open
            return mf4_library().MF4Reader(file)
    except NotImplementedError:
        raise InputOutputError(f"log {path}: MF4 needs asammdf: {install_command('mf4')}") from None


BAD_LINES = logging.getLogger("can.lines")
"""Child of python-can's logger, whose complaints the reader of logs counts."""
MAX_BAD_LINES = 1000
"""Bad lines, 1, beyond as many as there are frames, at which a text log is no log: each takes
python-can a new start."""
MAX_LINE_CHARACTERS = 1 << 16
RELATIVE_HEADER_PATTERN = re.compile(
    r"\s*base\s+(?:hex|dec)\s+timestamps\s+relative", re.IGNORECASE
)
ASC_LINE_PATTERN = re.compile(
    r"\s*(?://|(?:date|base|begin|end|previous|(?:no\s+)?internal)\b"
    r"|\d+\.\d+\s+(?://|\d+\s+\w+\s+(?:Rx|Tx)|CANFD|(?:\d+\s+)?[A-Z]*[G-Z]))",
    re.IGNORECASE,
)
"""Beginning of a comment, a line of the header, a frame, or an event by its name."""
TRC_LINE_PATTERN = re.compile(
    r"\s*(?:;|\d+\)?\s+\d+(?:\.\d+)?\s+(?:[A-Z]{2}|[0-9A-F]{4,8}|\d+|Rx|Tx|Warng|Error)\s)"
)
"""Beginning of a comment, or number, stamp, and type, identifier or bus of versions 1.0 to 2.1."""
STAMP_PATTERN = re.compile(r"\s*(\d+\.\d+)(\s.*)", re.DOTALL)


class _BoundedLines:
    """Lines of a read-only text file, none longer than a log can have: noise has no line ends.

    Lines that do not begin by the pattern, which python-can passes over, are counted and left out.
    """

    def __init__(
        self, file: TextIO, spending: Spending, pattern: re.Pattern[str] | None = None
    ) -> None:
        self._file = file
        self._spending = spending
        self._position = 0
        self._pattern = pattern
        self._pushed: list[str] = []

    def push(self, line: str) -> bool:
        """Give a line before the next one; False at the end of the file, where none follows."""
        while (following := self.readline()) and not following.strip():
            pass
        self._pushed = [following, line + "\n"] if following else []
        return bool(following)

    def __iter__(self) -> Iterator[str]:
        while line := self.readline():
            yield line

    def __next__(self) -> str:
        line = self.readline()
        if not line:
            raise StopIteration
        return line

    def readline(self) -> str:
        """Return the next line, or a piece of one; empty at the end."""
        # A file of lines that are no frames must end in time too.
        self._spending.look_at_clock()
        return self._pushed.pop() if self._pushed else self._next_line()

    def _next_line(self) -> str:
        line = self._file.readline(MAX_LINE_CHARACTERS)
        self._position += len(line)
        self._spending.report_progress(self._position)
        line = self._stamped(line)
        if self._pattern is None or not line.strip() or self._pattern.match(line):
            return line
        BAD_LINES.warning("a line that holds no frame")
        return "\n"

    def _stamped(self, line: str) -> str:
        """Return a line with an absolute stamp."""
        return line

    def read(self, _size: int = -1) -> str:
        """Return one line: readers go by lines."""
        return self.readline()

    def write(self, _text: str) -> int:
        """Refuse: a recording is never changed."""
        raise OSError("read only")

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class _AbsoluteLines(_BoundedLines):
    """Lines of an ASC file with relative stamps, made absolute."""

    def __init__(self, file: TextIO, spending: Spending) -> None:
        super().__init__(file, spending, ASC_LINE_PATTERN)
        self._elapsed = 0.0

    def _stamped(self, line: str) -> str:
        stamp = STAMP_PATTERN.match(line)
        if stamp is None:
            return line
        self._elapsed += float(stamp[1])
        return f"{self._elapsed:.9f}{stamp[2]}"


def open_text(path: Path, spending: Spending, pattern: re.Pattern[str] | None = None) -> TextIO:
    """Open a text log for one of python-can's readers."""
    file = path.open(encoding="utf-8", errors="replace")
    return cast(TextIO, _BoundedLines(file, spending, pattern))


def open_asc(path: Path, spending: Spending) -> TextIO:
    """Open an ASC file for python-can's reader, its stamps absolute (from the start of the log)."""
    file = path.open(encoding="utf-8", errors="replace")
    head = [file.readline(MAX_LINE_CHARACTERS) for _ in range(20)]
    file.seek(0)
    if any(RELATIVE_HEADER_PATTERN.match(line) for line in head):
        return cast(TextIO, _AbsoluteLines(file, spending))
    return cast(TextIO, _BoundedLines(file, spending, ASC_LINE_PATTERN))
