"""candump's log files (`candump -l`, `candump -L`), read line by line.

python-can's own reader takes error frames of controllers for data frames, and ends at the first
line that holds no frame.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator

from firmware_iface.transport.frames import Frame

__all__ = ["candump_frames"]

LINE = re.compile(
    r"\s*\((?P<seconds>\d{1,10})\.(?P<fraction>\d{1,9})\)"
    r"\s+(?P<interface>\S+)"
    r"\s+(?P<id>[0-9A-F]{3}|[0-9A-F]{8})#"
    r"(?:(?P<remote>R)[0-8]?|#[0-9A-F](?P<fd>(?:[0-9A-F]{2}){0,64})|(?P<data>(?:[0-9A-F]{2}){0,8}))"
    r"(?:_[0-9A-F])?(?:\s+(?P<direction>[RT]))?\s*",
    re.IGNORECASE | re.ASCII,
)
"""A frame as can-utils writes it; `_N` is the length code of a classic frame beyond 8."""
LAST_SECOND = (1 << 63) // 1_000_000_000
"""Nanoseconds are counted in 64 bits."""
STANDARD_DIGITS = 3
STANDARD_MASK, EXTENDED_MASK, ERROR_FLAG = 0x7FF, 0x1FFFFFFF, 0x20000000


def candump_frames(lines: Iterable[str]) -> Iterator[tuple[Frame, str]]:
    """Give each frame with the name of its interface; a line that holds none is logged.

    The logger is a child of python-can's, whose complaints the reader of logs counts.
    """
    complaints = logging.getLogger("can.candump")
    for line in lines:
        match = LINE.fullmatch(line)
        if match is not None and int(match["seconds"]) < LAST_SECOND:
            yield _frame(match), match["interface"]
        elif line.strip():
            complaints.warning("no frame in the line %r", line[:80])


def _frame(match: re.Match[str]) -> Frame:
    number = int(match["id"], 16)
    extended = len(match["id"]) > STANDARD_DIGITS
    error = extended and bool(number & ERROR_FLAG)
    payload = match["data"] or match["fd"] or ""
    return Frame(
        time_ns=int(match["seconds"]) * 1_000_000_000 + int(match["fraction"].ljust(9, "0")),
        can_id=number & (EXTENDED_MASK if extended else STANDARD_MASK),
        data=bytes.fromhex(payload),
        extended=extended,
        fd=match["fd"] is not None,
        error=error,
        remote=match["remote"] is not None,
        sent=(match["direction"] or "").upper() == "T",
    )
