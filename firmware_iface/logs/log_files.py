"""Opens log files of every kind, packed or plain, within a budget, each with its reader.

A reader of the package or of another one is found by the file's suffix. Another package brings one
by an entry point of the group `ehadiag.log_readers`, as python-can's `can.io` plug-ins do.
"""

from __future__ import annotations

import codecs
import gzip
import pkgutil
import stat
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Protocol

import msgspec

from firmware_iface.errors import (
    ConfigurationError,
    EhadiagError,
    InputOutputError,
    printable,
    reason_of,
)

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from firmware_iface.transport.frames import FrameTable


class Budget(msgspec.Struct, frozen=True):
    """What reading one recording may cost; a recording that costs more is refused in one line."""

    frames: int = 20_000_000
    """Of the recording, foreign ones included; the default is some three hours of this bus."""
    size: int = 4 << 30
    """Bytes of the file, and of what a compressed one unpacks to."""
    seconds: float = 900.0
    """Wall time of reading."""
    held: int = 500_000
    """Frames held in memory at once, some 25 bytes each and ten times as many while they are
    decoded; a test that is longer is cut off and said to be.
    """
    progress: Callable[[float], None] | None = None
    """Is called now and then with the share of the file that is read, 0 … 1."""


PROGRESS_PERIOD_S = 0.1
"""Time between two reports of progress, s."""


class Spending:
    """Counts what reading `path` has cost so far.

    path: file to read; budget: what may be spent. InputOutputError: by each method, once a budget
    is spent; it names the option that allows more.
    """

    def __init__(self, path: Path, budget: Budget) -> None:
        self._path = path
        self._budget = budget
        self._deadline = time.monotonic() + budget.seconds
        self.frames = 0
        self._bytes = 0
        self._size = 0
        self._reported = 0.0

    def add_frames(self, count: int) -> None:
        """Count frames, and look at the clock."""
        self.frames += count
        if self.frames > self._budget.frames:
            self._refuse(f"more than {self._budget.frames} frames", "--max-frames")
        self.look_at_clock()

    def add_bytes(self, count: int) -> None:
        """Count unpacked bytes, and look at the clock."""
        self._bytes += count
        if self._bytes > self._budget.size:
            self._refuse(f"unpacks to more than {_mebibytes(self._budget.size)}", "--max-log-size")
        self.look_at_clock()

    def report_progress(self, position: int) -> None:
        """Report how far the file is read, bytes."""
        report, now = self._budget.progress, time.monotonic()
        if report is not None and self._size and now - self._reported >= PROGRESS_PERIOD_S:
            self._reported = now
            report(min(position / self._size, 1.0))

    def check_size(self, size: int) -> None:
        """Compare the size of the file, bytes; progress is a share of it."""
        self._size = size
        if size > self._budget.size:
            self._refuse(f"larger than {_mebibytes(self._budget.size)}", "--max-log-size")

    def look_at_clock(self) -> None:
        """Compare the time since the beginning."""
        if time.monotonic() > self._deadline:
            self._refuse(f"not read within {self._budget.seconds:g} s", "--max-read-time")

    def _refuse(self, what: str, option: str) -> None:
        raise InputOutputError(f"log {self._path}: {what}; split it, or allow more by {option}")


def _mebibytes(size: int) -> str:
    return f"{size / (1 << 20):.4g} MiB"


GZIP_SUFFIX = ".gz"


class UnpackedLog(msgspec.Struct, frozen=True):
    """A log that can be opened as it is."""

    path: Path
    trouble: str
    """What ended the unpacking early; empty for a whole file."""


def log_size(path: Path) -> int:
    """Return the bytes of a log; InputOutputError where it is no file that can be read."""
    try:
        state = path.stat()
        if not stat.S_ISREG(state.st_mode):
            raise InputOutputError(f"log {path}: not a file")
        with path.open("rb"):
            return state.st_size
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        missing = isinstance(error, FileNotFoundError | NotADirectoryError)
        reason = "no such file" if missing else reason_of(error)
        raise InputOutputError(f"log {path}: {reason}") from None


def kind_of(path: Path) -> str:
    """Suffix that says how a log is written, in lower case: that below `.gz`, if it is packed."""
    suffix = path.suffix.lower()
    return Path(path.stem).suffix.lower() if suffix == GZIP_SUFFIX else suffix


def beginning_of(path: Path, count: int) -> bytes:
    """Return the first bytes of a log, or of what a packed one holds; no more is unpacked.

    path: log, packed or not; count: bytes at most. Returns fewer where the log is shorter, or
    damaged there. OSError: it cannot be read.
    """
    if path.suffix.lower() != GZIP_SUFFIX:
        with path.open("rb") as plain:
            return plain.read(count)
    out = b""
    with gzip.open(path, "rb") as source:
        while len(out) < count:
            try:
                piece = source.read1(count - len(out))
            except (gzip.BadGzipFile, EOFError, zlib.error):
                break
            if not piece:
                break
            out += piece
    return out


@contextmanager
def unpacked_log(path: Path, most: int) -> Iterator[UnpackedLog]:
    """Give the log itself, or what a packed one holds, as far as it can be unpacked.

    path: log, packed or not; most: bytes that it may unpack to. Yields the log to read, until the
    block ends. InputOutputError: not packed by gzip, larger than `most`, no room for it. Errors of
    the block that name the temporary file name the packed one instead.
    """
    if path.suffix.lower() != GZIP_SUFFIX:
        yield UnpackedLog(path, "")
        return
    with tempfile.TemporaryDirectory(prefix="ehadiag-") as folder:
        plain = Path(folder) / f"log{kind_of(path)}"
        try:
            with gzip.open(path, "rb") as source, plain.open("wb") as target:
                broken = _unpack(source, target, path, most)
        except OSError as error:
            raise InputOutputError(f"log {path}: {reason_of(error)}") from None
        if plain.stat().st_size == 0:
            reason = "not packed by gzip, or damaged" if broken else "the file is empty"
            raise InputOutputError(f"log {path}: {reason}")
        try:
            yield UnpackedLog(plain, "the packed log breaks off or is damaged" if broken else "")
        except EhadiagError as error:
            raise type(error)(str(error).replace(str(plain), str(path))) from None


def _unpack(source: gzip.GzipFile, target: BinaryIO, path: Path, most: int) -> bool:
    """Copy piece by piece; return whether the packed file breaks off or is damaged."""
    size = 0
    while True:
        try:
            piece = source.read1(1 << 20)
        except (gzip.BadGzipFile, EOFError, zlib.error):
            return True
        if not piece:
            return False
        size += len(piece)
        if size > most:
            raise InputOutputError(f"log {path}: unpacks to more than {most >> 20} MiB; split it")
        target.write(piece)


READER_GROUP = "ehadiag.log_readers"
"""Group of the entry points of other packages' readers; an entry point's name is the suffix."""
FRAME_READERS: Mapping[str, str] = {
    ".blf": "firmware_iface.logs.blf:BlfReader",
    ".asc": "firmware_iface.logs.can_readers:AscReader",
    ".csv": "firmware_iface.logs.can_readers:CsvReader",
    ".trc": "firmware_iface.logs.can_readers:TrcReader",
    ".mf4": "firmware_iface.logs.can_readers:Mf4Reader",
    ".log": "firmware_iface.logs.candump:CandumpReader",
}
"""The package's own readers of frames, by suffix; each is imported when it is needed."""
SIGNAL_READERS: Mapping[str, str] = {
    ".csv": "firmware_iface.signals.tables:CsvTableReader",
    ".parquet": "firmware_iface.signals.tables:ParquetReader",
    ".mf4": "firmware_iface.signals.arrays:Mf4SignalReader",
    ".tdms": "firmware_iface.signals.arrays:TdmsReader",
    ".h5": "firmware_iface.signals.arrays:HdfReader",
    ".hdf5": "firmware_iface.signals.arrays:HdfReader",
    ".mat": "firmware_iface.signals.arrays:HdfReader",
}
"""The package's own readers of decoded signals, by suffix."""
MAX_TEXT_HEADER_BYTES = 1 << 16
"""Bytes at the beginning of a file by which its reader is chosen."""


class DamagedLogError(Exception):
    """Ends the reading of a log early, by its text; what was read before counts."""


class LogReader(Protocol):
    """Reads the frames of one kind of log; it is made without arguments, one for each file.

    The class of an entry point of `ehadiag.log_readers`. A reader of decoded signals has a method
    `signals` in the place of `frames`, see `firmware_iface.signals.tables.SignalReader`.
    """

    signature: bytes
    """Beginning of each of its files, white space and byte-order mark aside; it tells them apart
    from other kinds with the same suffix. Empty: no other kind has the suffix.
    """

    def frames(self, path: Path, spending: Spending) -> Iterator[FrameTable]:
        """Read a file, unpacked already, in tables of some ten thousand frames.

        path: the file; it exists and is not empty; spending: counts what reading costs. The frames
        of each table are counted by the caller; `look_at_clock` is for long stretches without a
        frame. Returns frames in order of arrival. DamagedLogError: the file breaks off or is
        damaged here: the frames so far are used. Any other error of another package's reader counts
        as this one. InputOutputError: the file cannot be read at all.
        """


class FoundReader(msgspec.Struct, frozen=True):
    """A reader of one log."""

    reader: Any
    """A `LogReader`, or a `SignalReader`."""
    origin: str
    """Class and package of a reader that another package brings; empty: the package's own."""

    @property
    def signature(self) -> bytes:
        """Beginning of its files; empty: any."""
        signature: bytes = self.reader.signature
        return signature

    @property
    def decodes(self) -> bool:
        """Whether it reads decoded signals, not frames."""
        return hasattr(self.reader, "signals")

    @property
    def notes(self) -> tuple[str, ...]:
        """Note on a reader of another package."""
        return (f"read by {self.origin}",) if self.origin else ()


@cache
def _plugins() -> tuple[EntryPoint, ...]:
    from importlib.metadata import entry_points  # noqa: PLC0415 - looks through all packages

    return tuple(entry_points(group=READER_GROUP))


def known_suffixes() -> tuple[str, ...]:
    """Return the suffixes of all logs that can be read: other packages' last."""
    foreign = sorted(item.name.lower() for item in _plugins())
    return tuple(dict.fromkeys((*FRAME_READERS, *SIGNAL_READERS, *foreign)))


def _plugin_readers(suffix: str, own: list[FoundReader]) -> list[FoundReader]:
    """Readers of other packages for a suffix; one for the files of another reader is refused."""
    found: list[FoundReader] = []
    for item in _plugins():
        if item.name.lower() != suffix:
            continue
        package = f" of {item.dist.name} {item.dist.version}" if item.dist else ""
        origin = f"{item.value}{package}"
        try:
            new = FoundReader(item.load()(), origin)
        except Exception as error:
            reason = printable(" ".join(f"{type(error).__name__}: {error}".split()))
            raise ConfigurationError(f"log reader {origin}: cannot be loaded: {reason}") from None
        methods = [callable(getattr(new.reader, name, None)) for name in ("frames", "signals")]
        if sum(methods) != 1 or not isinstance(getattr(new.reader, "signature", None), bytes):
            raise ConfigurationError(
                f"log reader {origin}: needs a method frames or signals, and a signature in bytes"
            )
        for other in (*own, *found):
            if _clash(new, other):
                raise ConfigurationError(
                    f"log reader {origin}: {suffix} files are read by"
                    f" {other.origin or 'ehadiag itself'}: name another suffix, or a signature"
                    " that only its own files begin with"
                )
        found.append(new)
    return found


def _clash(new: FoundReader, other: FoundReader) -> bool:
    if not new.signature or not other.signature:
        return not new.signature or other.origin != ""
    shorter = min(len(new.signature), len(other.signature))
    return new.signature[:shorter] == other.signature[:shorter]


def _candidates(path: Path) -> list[FoundReader]:
    """The one reader whose signature a log has, or else all without one, or else the package's."""
    suffix = kind_of(path)
    values = (table.get(suffix) for table in (FRAME_READERS, SIGNAL_READERS))
    own = [FoundReader(pkgutil.resolve_name(value)(), "") for value in values if value]
    try:
        begin = text_beginning(path)
    except OSError:
        begin = b""
    match = _by_signature(own, begin)
    if match is None:  # only now: looking through all packages takes 50 ms
        foreign = _plugin_readers(suffix, own)
        match = _by_signature(foreign, begin)
        own += [item for item in foreign if not item.signature]
    return own if match is None else [match]


def _by_signature(readers: list[FoundReader], begin: bytes) -> FoundReader | None:
    fitting = (item for item in readers if item.signature and begin.startswith(item.signature))
    return next(fitting, None)


def find_reader(path: Path, *, decodes: bool) -> FoundReader | None:
    """Return a new reader for a log that exists; None: of an unknown kind.

    path: the log, packed or not; decodes: read decoded signals, not frames. Returns that whose
    signature the log has, or that of its suffix. ConfigurationError: a reader of another package is
    faulty, or is for the files of another one.
    """
    found = [item for item in _candidates(path) if item.decodes is decodes]
    return min(found, key=lambda item: len(item.signature), default=None)


def holds_signals(path: Path | str, *, mapped: bool) -> bool:
    """Whether a log holds decoded signals rather than frames.

    path: the log; mapped: its columns are mapped: a file that may hold either (MF4) is then one of
    signals. Returns True too where its beginning cannot be read: the reader of signals says why.
    ConfigurationError: a reader of another package is faulty.
    """
    path = Path(path)
    suffix = kind_of(path)
    if not path.is_file():
        return suffix in SIGNAL_READERS and suffix not in FRAME_READERS
    found = _candidates(path)
    frames = [item for item in found if not item.decodes]
    if not frames or len(frames) == len(found):
        return not frames and bool(found)
    if not frames[0].signature:
        return mapped
    try:
        begin = text_beginning(path)
    except OSError:
        return True
    if begin.startswith(UTF16_MARKS):  # the reader of signals says so
        return True
    text = begin.decode("utf-8", "replace")
    return text != "" and all(item.isprintable() or item.isspace() for item in text)


UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def text_beginning(path: Path) -> bytes:
    """Return the first 64 KiB of a log without byte-order mark and white space before them."""
    begin = beginning_of(path, MAX_TEXT_HEADER_BYTES)
    return begin.removeprefix(codecs.BOM_UTF8).lstrip()
