"""Reads the logs of `candump -l`, lines of one layout together."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from firmware_iface.logs.can_readers import BAD_LINES, MAX_LINE_CHARACTERS
from firmware_iface.logs.log_files import DamagedLogError, Spending
from firmware_iface.recording import MAX_CAN_ID, MAX_STANDARD_CAN_ID, BoolArray, IntArray
from firmware_iface.transport.frames import MAX_CHANNEL, ColumnBuilder, Frame, FrameTable

CANDUMP_LINE_PATTERN = re.compile(
    r"\s*\((?P<seconds>\d{1,10})\.(?P<fraction>\d{1,9})\)"
    r"\s+(?P<interface>\S+)"
    r"\s+(?P<id>[0-9A-F]{3}|[0-9A-F]{8})#"
    r"(?:(?P<remote>R)[0-8]?|#[0-9A-F](?P<fd>(?:[0-9A-F]{2}){0,64})|(?P<data>(?:[0-9A-F]{2}){0,8}))"
    r"(?:_[0-9A-F])?(?:\s+(?P<direction>[RT]))?\s*",
    re.IGNORECASE | re.ASCII,
)
"""A frame as can-utils writes it; `_N` is the length code of a classic frame beyond 8."""
MAX_STAMP_S = (1 << 63) // 1_000_000_000
"""Nanoseconds are counted in 64 bits."""
STANDARD_ID_DIGITS = 3
ERROR_ID_FLAG = 0x20000000


def candump_frames(lines: Iterable[str]) -> Iterator[tuple[Frame, str]]:
    """Give each frame with the name of its interface; a line that holds none is logged."""
    for line in lines:
        match = CANDUMP_LINE_PATTERN.fullmatch(line)
        if match is not None and int(match["seconds"]) < MAX_STAMP_S:
            yield _frame(match), match["interface"]
        elif line.strip():
            BAD_LINES.warning("a line that holds no frame")


def _frame(match: re.Match[str]) -> Frame:
    number = int(match["id"], 16)
    extended = len(match["id"]) > STANDARD_ID_DIGITS
    error = extended and bool(number & ERROR_ID_FLAG)
    payload = match["data"] or match["fd"] or ""
    return Frame(
        time_ns=int(match["seconds"]) * 1_000_000_000 + int(match["fraction"].ljust(9, "0")),
        can_id=number & (MAX_CAN_ID if extended else MAX_STANDARD_CAN_ID),
        data=bytes.fromhex(payload),
        extended=extended,
        fd=match["fd"] is not None,
        error=error,
        remote=match["remote"] is not None,
        sent=(match["direction"] or "").upper() == "T",
    )


@cache
def _digit_values() -> NDArray[np.int64]:
    """Value of each character, shape (256,), as a hexadecimal digit; -1 of others."""
    values = np.full(256, -1, dtype=np.int64)
    for value, digit in enumerate(b"0123456789abcdef"):
        values[[digit, ord(chr(digit).upper())]] = value
    return values


class _CandumpBlock:
    """Lines of a candump log, those alike parsed together.

    Classic data frames whose lines have the same layout (length, interface, widths of identifier
    and payload, direction) are read as a matrix of characters; all others one by one.
    """

    def __init__(self, text: bytes) -> None:
        self._text = text
        self._characters = np.frombuffer(text, dtype=np.uint8)
        ends = np.flatnonzero(self._characters == ord("\n"))
        self._starts = np.append(0, ends[:-1] + 1)
        self._lengths = ends - self._starts
        count = len(ends)
        self._time_ns = np.zeros(count, dtype=np.int64)
        self._can_id = np.zeros(count, dtype=np.uint32)
        self._size = np.zeros(count, dtype=np.uint8)
        self._payload = np.zeros((count, 8), dtype=np.uint8)
        self._extended = np.zeros(count, dtype=np.bool_)
        self._sent = np.zeros(count, dtype=np.bool_)
        self._interface = np.full(count, -1)
        self._names: list[str] = []

    def append_to(self, columns: ColumnBuilder, channels: dict[str, int]) -> None:
        """Append all frames in order; `channels` numbers the interfaces."""
        self._parse_alike()
        begin = 0
        for row in map(int, np.flatnonzero((self._interface < 0) & (self._lengths > 0))):
            self._extend(columns, channels, begin, row)
            begin = row + 1
            for frame, interface in candump_frames([self._line(row)]):
                columns.add_frame(frame, _channel_of(interface, channels))
        self._extend(columns, channels, begin, len(self._starts))

    def _line(self, row: int) -> str:
        begin = int(self._starts[row])
        length = min(int(self._lengths[row]), MAX_LINE_CHARACTERS)
        return self._text[begin : begin + length].decode("utf-8", "replace")

    def _parse_alike(self) -> None:
        """Parse the lines of each layout together."""
        forms = 0
        for length in np.unique(self._lengths):
            rows = np.flatnonzero(self._lengths == length)
            # From 8 lines of one layout on parsing them together is faster.
            while len(rows) >= 8 and forms < 64:
                forms += 1
                alike = self._parse_like_first(rows)
                alike[0] = True  # what the first line alone holds is found by itself
                rows = rows[~alike]

    def _parse_like_first(self, rows: IntArray) -> BoolArray:
        """Parse those lines, of one length, that have the layout of the first; return which."""
        form = CANDUMP_LINE_PATTERN.fullmatch(self._line(int(rows[0])))
        if form is None or form["data"] is None:
            return np.zeros(len(rows), dtype=np.bool_)
        length = int(self._lengths[rows[0]])
        characters = self._characters[self._starts[rows][:, None] + np.arange(length)]
        digits = _digit_values()[characters]
        fixed = np.ones(length, dtype=np.bool_)
        for name in ("seconds", "fraction", "id", "data"):
            fixed[slice(*form.span(name))] = False
        alike: BoolArray = (characters[:, fixed] == characters[0, fixed]).all(axis=1)
        alike &= (digits[:, ~fixed] >= 0).all(axis=1)
        for name in ("seconds", "fraction"):
            alike &= (digits[:, slice(*form.span(name))] <= 9).all(axis=1)
        seconds = _number(digits[:, slice(*form.span("seconds"))], 10)
        fraction = _number(digits[:, slice(*form.span("fraction"))], 10)
        number = _number(digits[:, slice(*form.span("id"))], 16)
        extended = len(form["id"]) > STANDARD_ID_DIGITS
        alike &= seconds < MAX_STAMP_S
        alike &= (number & ERROR_ID_FLAG == 0) | (not extended)

        found, size = rows[alike], len(form["data"]) // 2
        scale = 10 ** (9 - len(form["fraction"]))
        self._time_ns[found] = seconds[alike] * 1_000_000_000 + fraction[alike] * scale
        self._can_id[found] = number[alike] & (MAX_CAN_ID if extended else MAX_STANDARD_CAN_ID)
        self._extended[found] = extended
        self._sent[found] = (form["direction"] or "").upper() == "T"
        self._size[found] = size
        payload = digits[alike, slice(*form.span("data"))]
        self._payload[found, :size] = payload[:, ::2] << 4 | payload[:, 1::2]
        if form["interface"] not in self._names:
            self._names.append(form["interface"])
        self._interface[found] = self._names.index(form["interface"])
        return alike

    def _extend(
        self, columns: ColumnBuilder, channels: dict[str, int], begin: int, end: int
    ) -> None:
        """Append the frames that were parsed together of some lines."""
        rows = begin + np.flatnonzero(self._interface[begin:end] >= 0)
        if not len(rows):
            return
        interface = self._interface[rows]
        channel = np.zeros(len(self._names), dtype=np.uint16)
        for name in interface[np.sort(np.unique(interface, return_index=True)[1])]:
            channel[name] = _channel_of(self._names[name], channels)
        columns.extend(
            time_ns=self._time_ns[rows],
            can_id=self._can_id[rows],
            length=self._size[rows],
            data=self._payload[rows],
            extended=self._extended[rows],
            remote=np.zeros(len(rows), dtype=np.bool_),
            sent=self._sent[rows],
            channel=channel[interface],
        )


def _number(digits: NDArray[np.int64], base: int) -> NDArray[np.int64]:
    """Numbers of the digits in the rows, the highest first."""
    number = np.zeros(len(digits), dtype=np.int64)
    for digit in digits.T:
        number = number * base + digit
    return number


def _channel_of(interface: str, channels: dict[str, int]) -> int:
    return channels.setdefault(interface, min(len(channels) + 1, MAX_CHANNEL))


class CandumpReader:
    """The log of `candump -l`; interfaces are channels, from 1 in the order in which they come."""

    signature = b""

    def frames(self, path: Path, spending: Spending) -> Iterator[FrameTable]:
        """Read a file, see `LogReader`."""
        found = False
        channels: dict[str, int] = {}
        with path.open("rb") as file:
            for text in _complete_lines(file, spending):
                columns = ColumnBuilder()
                _CandumpBlock(text).append_to(columns, channels)
                if len(columns):
                    found = True
                    yield columns.table()
        if not found:
            raise DamagedLogError("no line as candump -l writes it")


def _complete_lines(file: BinaryIO, spending: Spending) -> Iterator[bytes]:
    """Blocks of whole lines; one that is longer than a block is cut: noise has no line ends."""
    rest = b""
    while piece := file.read(1 << 20):
        spending.look_at_clock()
        spending.report_progress(file.tell())
        text = rest + piece.replace(b"\r", b"\n")
        end = text.rfind(b"\n") + 1
        rest = text[end:]
        if end:
            yield text[:end]
        elif len(rest) > MAX_LINE_CHARACTERS:
            yield rest + b"\n"
            rest = b""
    if rest:
        yield rest + b"\n"
