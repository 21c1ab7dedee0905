"""Lets python-can read ASC logs with relative time stamps, and lines without an end.

`timestamps relative` means that each stamp counts from the event before it, whatever that event
is; python-can takes every stamp for an absolute one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TextIO, cast

__all__ = ["open_asc", "open_text"]

MAX_LINE = 1 << 16
HEADER_LINES = 20
HEADER = re.compile(r"\s*base\s+(?:hex|dec)\s+timestamps\s+relative", re.IGNORECASE)
STAMP = re.compile(r"\s*(\d+\.\d+)(\s.*)", re.DOTALL)


class _BoundedLines:
    """Lines of a read-only text file, none longer than a log can have: noise has no line ends."""

    def __init__(self, file: TextIO, look: Callable[[], None]) -> None:
        self._file = file
        self._look = look

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
        self._look()  # a file of lines that are no frames must end in time too
        return self._file.readline(MAX_LINE)

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

    def __init__(self, file: TextIO, look: Callable[[], None]) -> None:
        super().__init__(file, look)
        self._elapsed = 0.0

    def readline(self) -> str:
        """Return the next line; empty at the end."""
        line = super().readline()
        stamp = STAMP.match(line)
        if stamp is None:
            return line
        self._elapsed += float(stamp[1])
        return f"{self._elapsed:.9f}{stamp[2]}"


def open_text(path: Path, look: Callable[[], None]) -> TextIO:
    """Open a text log for one of python-can's readers; `look` is called at each line."""
    file = path.open(encoding="utf-8", errors="replace")
    return cast(TextIO, _BoundedLines(file, look))


def open_asc(path: Path, look: Callable[[], None]) -> TextIO:
    """Open an ASC file for python-can's reader, its stamps absolute (from the start of the log)."""
    file = path.open(encoding="utf-8", errors="replace")
    head = [file.readline(MAX_LINE) for _ in range(HEADER_LINES)]
    file.seek(0)
    if any(HEADER.match(line) for line in head):
        return cast(TextIO, _AbsoluteLines(file, look))
    return cast(TextIO, _BoundedLines(file, look))
