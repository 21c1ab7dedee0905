"""Decides which frames are valid: length, CRC, range, and counter conflicts between two senders.

All that decides whether a frame of a mapped message is believed stands here, for frames in columns
and for one at a time:

1. *Length*: that of the DBC.
2. *Check sum*, where the mapping names one.
3. *Range*: values that the DBC does not allow (`firmware_iface.codec.decode`, per signal).
4. *Counter*: the same payload with a counter that was used before is a **repeat**, and harmless.
   Another payload with it is a **conflict**: somebody else sends under this identifier, and nothing
   tells which of them is right. All frames of a counter value in conflict are dropped and counted
   as lost. Beyond `MOST_CONFLICTS` of the counter values no verdict is given. A counter that
   *stands still* while time goes on is a fault of its sender: one value, and so one conflict.

None of this keeps out a sender who means harm and sends alone: telemetry is checked, not
authenticated.
"""

from __future__ import annotations

import struct
from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from firmware_iface.codec.protection import crc8, crc8_rows
from firmware_iface.mapping.bus_map import MessageMap
from firmware_iface.transport.frames import FrameTable

__all__ = [
    "LEAST_CONFLICTS",
    "MOST_CONFLICTS",
    "SenderWatch",
    "conflicting",
    "event_positions",
    "intact",
    "rows_of",
    "sound_rows",
]

MOST_CONFLICTS = 0.02
"""Share of a message's counter values that may be in conflict."""
LEAST_CONFLICTS = 3
"""Conflicts up to which chance is to blame, whatever their share: a damaged frame whose check sum
fits."""
STANDING = 3
"""Frames in a row with one counter from which on it stands still; two senders make pairs."""
REMEMBERED = 128
"""Counter values that the live watch looks back: half a turn of eight bits."""
RECENT = 500
"""Frames after which what the live watch saw weighs half."""

Rows = NDArray[np.int64]


def rows_of(table: FrameTable, message: MessageMap) -> Rows:
    """Rows of the data frames that have a message's identifier, on whatever channel."""
    mine = table.can_id == message.can_id
    mine &= table.extended == message.extended
    mine &= ~(table.error | table.remote)
    return np.flatnonzero(mine)


def sound_rows(
    table: FrameTable, received: Rows, message: MessageMap, *, keep_bad_sums: bool = False
) -> tuple[Rows, NDArray[np.uint8], Rows, Rows]:
    """Check length and check sum of frames in columns.

    Parameters
    ----------
    table : FrameTable
        Frames in columns.
    received : Rows
        Rows of the message.
    message : MessageMap
        The message that they should be.
    keep_bad_sums : bool
        Tell frames with a wrong check sum, but let them pass.

    Returns
    -------
    tuple[Rows, NDArray[np.uint8], Rows, Rows]
        Rows that pass, their payloads of shape (n, width), rows of a wrong length, and rows
        with a wrong check sum.
    """
    fits = table.length[received] == message.length
    wrong_length, row = received[~fits], received[fits]
    data = _gather(table.data, row)
    wrong_sum = row[:0]
    if message.crc is not None and len(row):
        at = message.crc.lead // 8
        good = crc8_rows(message.can_id, data, at, message.length) == data[:, at]
        if not good.all():
            wrong_sum = row[~good]
            if not keep_bad_sums:
                row, data = row[good], np.ascontiguousarray(data[good])
    return row, data, wrong_length, wrong_sum


def intact(message: MessageMap, data: bytes) -> bool:
    """Whether one payload has the right length and check sum."""
    if len(data) != message.length:
        return False
    if message.crc is None:
        return True
    at = message.crc.lead // 8
    header = struct.pack("<H", message.can_id & 0xFFFF)
    return crc8(header + data[:at] + data[at + 1 :]) == data[at]


def _gather(data: NDArray[np.uint8], row: Rows) -> NDArray[np.uint8]:
    if data.shape[1] == 8 and data.flags.c_contiguous:
        return data.view(np.uint64).reshape(-1)[row].view(np.uint8).reshape(-1, 8)
    return np.ascontiguousarray(data[row])


def conflicting(position: Rows, data: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Frames whose position another frame has with another payload.

    Parameters
    ----------
    position : Rows
        Unlimited counter (and page, where a message has several) of each frame, shape (n,).
    data : NDArray[np.uint8]
        Payloads, shape (n, width).

    Returns
    -------
    NDArray[np.bool_]
        Frames in conflict, shape (n,).
    """
    marked = np.zeros(len(position), dtype=np.bool_)
    order = np.argsort(position, kind="stable")
    same = np.diff(position[order]) == 0
    if not same.any():
        return marked
    begins = np.flatnonzero(np.concatenate(([True], ~same)))
    lengths = np.diff(np.concatenate((begins, [len(order)])))
    several = np.repeat(lengths > 1, lengths)
    order, group = order[several], np.repeat(np.arange(len(begins)), lengths)[several]
    differs = (data[order[1:]] != data[order[:-1]]).any(axis=1) & (group[1:] == group[:-1])
    marked[order] = np.isin(group, group[1:][differs])
    return marked


def event_positions(counter: Rows, time_ns: Rows, modulus: int) -> tuple[NDArray[np.bool_], Rows]:
    """Positions of a message that counts its own frames, the nearest number counting.

    After a silence of half a turn the positions begin anew, and a counter that stands still says
    nothing.

    Parameters
    ----------
    counter : Rows
        Counter of each frame, shape (n,).
    time_ns : Rows
        Time stamp of each frame, ns, shape (n,).
    modulus : int
        Number of values of the counter.

    Returns
    -------
    tuple[NDArray[np.bool_], Rows]
        Frames that have a position, shape (n,), and those positions.
    """
    has = np.ones(len(counter), dtype=np.bool_)
    if len(counter) < 2:
        return has, np.zeros(len(counter), dtype=np.int64)
    edges = np.flatnonzero(np.diff(counter)) + 1
    begins = np.concatenate(([0], edges))
    lengths = np.diff(np.concatenate((begins, [len(counter)])))
    has = np.repeat(lengths < STANDING, lengths)
    has[begins] = True
    counter, time_ns = counter[has], time_ns[has]
    step = np.diff(counter) % modulus
    step = np.where(step > modulus // 2, step - modulus, step)
    waited = np.diff(time_ns)
    usual = max(float(np.median(np.abs(waited))), 1.0) if len(waited) else 1.0
    anew = np.abs(waited) > usual * modulus / 2
    step[anew] = 2 * modulus  # beyond the reach of any frame before
    return has, np.concatenate(([0], np.cumsum(step)))


class SenderWatch:
    """Looks for a second sender under one identifier, a frame at a time; memory is constant.

    Parameters
    ----------
    modulus : int
        Counts per turn.
    period_ns : int
        Usual time between two counts.

    Attributes
    ----------
    conflicts : int
        Counter values that came with two payloads within half a turn.
    """

    conflicts: int

    def __init__(self, modulus: int, period_ns: int) -> None:
        self._reach = min(REMEMBERED, max(modulus // 2, 1))
        self._half_turn_ns = self._reach * period_ns
        self._seen: OrderedDict[tuple[int, ...], tuple[bytes, int]] = OrderedDict()
        self._last: tuple[int, ...] = ()
        self._standing = 0
        self._recent = [0, 0]
        self.conflicts = 0

    def take(self, counter: tuple[int, ...], data: bytes, time_ns: int) -> bool:
        """Take a sound frame; return whether its counter was just used with another payload.

        `counter` is the counter's value, and the page that it counts where there are several.
        """
        known = self._seen.pop(counter, None)
        self._seen[counter] = (data, time_ns)
        if len(self._seen) > self._reach:
            self._seen.popitem(last=False)
        if known is not None and known[0] == data:
            return False
        self._standing = self._standing + 1 if counter == self._last else 1
        self._last = counter
        conflict = known is not None and abs(time_ns - known[1]) <= self._half_turn_ns
        if conflict and self._standing >= STANDING:
            if self._standing == STANDING:
                self._count(-1)  # what looked like a pair is a counter that stands still
            return False
        self._count(int(conflict))
        return conflict

    def _count(self, conflicts: int) -> None:
        self.conflicts += conflicts
        self._recent[0] += 1
        self._recent[1] += conflicts
        if self._recent[0] >= RECENT:
            self._recent = [item // 2 for item in self._recent]

    @property
    def second_sender(self) -> bool:
        """Whether there are more conflicts of late than chance makes."""
        frames, conflicts = self._recent
        return conflicts > max(LEAST_CONFLICTS, MOST_CONFLICTS * frames)
