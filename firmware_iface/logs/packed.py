"""Logs packed by gzip: unpacked into a temporary file, then read like any other."""

from __future__ import annotations

import gzip
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from ehadiag.core.errors import InputOutputError, reason_of

__all__ = ["Unpacked", "beginning_of", "kind_of", "unpacked"]

PACKED = ".gz"
PIECE = 1 << 20
"""Bytes unpacked at once."""


@dataclass(frozen=True, slots=True)
class Unpacked:
    """A log that can be opened as it is."""

    path: Path
    trouble: str
    """What ended the unpacking early; empty for a whole file."""


def kind_of(path: Path) -> str:
    """Suffix that says how a log is written, in lower case: that below `.gz`, if it is packed."""
    suffix = path.suffix.lower()
    return Path(path.stem).suffix.lower() if suffix == PACKED else suffix


def beginning_of(path: Path, count: int) -> bytes:
    """Return the first bytes of a log, or of what a packed one holds; no more is unpacked.

    Parameters
    ----------
    path : Path
        Log, packed or not.
    count : int
        Bytes at most.

    Returns
    -------
    bytes
        Fewer where the log is shorter, or damaged there.

    Raises
    ------
    OSError
        It cannot be read.
    """
    if path.suffix.lower() != PACKED:
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
def unpacked(path: Path, most: int) -> Iterator[Unpacked]:
    """Give the log itself, or what a packed one holds, as far as it can be unpacked.

    Parameters
    ----------
    path : Path
        Log, packed or not.
    most : int
        Bytes that it may unpack to.

    Yields
    ------
    Unpacked
        The log to read, until the block ends.

    Raises
    ------
    InputOutputError
        Not packed by gzip, larger than `most`, no room for it. Errors of the block that name
        the temporary file name the packed one instead.
    """
    if path.suffix.lower() != PACKED:
        yield Unpacked(path, "")
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
            yield Unpacked(plain, "the packed log breaks off or is damaged" if broken else "")
        except InputOutputError as error:
            raise InputOutputError(str(error).replace(str(plain), str(path))) from None


def _unpack(source: gzip.GzipFile, target: BinaryIO, path: Path, most: int) -> bool:
    """Copy piece by piece; return whether the packed file breaks off or is damaged."""
    size = 0
    while True:
        try:
            piece = source.read1(PIECE)
        except (gzip.BadGzipFile, EOFError, zlib.error):
            return True
        if not piece:
            return False
        size += len(piece)
        if size > most:
            raise InputOutputError(f"log {path}: unpacks to more than {most >> 20} MiB; split it")
        target.write(piece)
