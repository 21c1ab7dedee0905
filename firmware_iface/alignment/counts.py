"""Counts the lost, repeated, late and damaged frames of a message during a test."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.recording import MessageCounts
from firmware_iface.alignment.episodes import Episode
from firmware_iface.alignment.ticks import TickAxis
from firmware_iface.codec.decode import Decoded

__all__ = ["count_frames", "within"]


def within(rows: NDArray[np.int64], begin: int, end: int) -> int:
    """Count rows in [begin, end)."""
    return int(np.searchsorted(rows, end) - np.searchsorted(rows, begin))


def count_frames(
    item: Decoded,
    axis: TickAxis | None,
    episode: Episode,
    begin: int,
    end: int,
    conflicts: int = 0,
) -> MessageCounts:
    """Count what happened to the frames of a message.

    Parameters
    ----------
    item : Decoded
        Its frames.
    axis : TickAxis | None
        Ticks; None without telemetry.
    episode : Episode
        The test.
    begin : int
        Rows of the table that belong to the test.
    end : int
        See `begin`.
    conflicts : int
        Counter values among them that came with different payloads.

    Returns
    -------
    MessageCounts
        The counts.
    """
    received = within(item.received, begin, end)
    crc_errors = within(item.crc_bad, begin, end)
    length_errors = within(item.length_bad, begin, end)
    range_errors = within(item.range_bad, begin, end)
    tick = axis.ticks.get(item.message.name) if axis is not None else None
    inside = slice(*np.searchsorted(item.row, [begin, end]))
    if tick is not None and axis is not None and episode.ticks > 0:
        at = tick[inside]
        at = at - episode.first
        stream = item.stream[inside]
        keep = (at >= 0) & (at < episode.ticks)
        at, stream = at[keep], stream[keep]
        expected = _expected(at, stream, episode.ticks, axis.every.get(item.message.name, 1))
        position = at * (int(stream.max(initial=0)) + 1) + stream
    elif item.counter is not None:
        position = _sequence(item.counter[inside], item.message.modulus)
        expected = int(position.max() - position.min()) + 1 if len(position) else 0
    else:
        # Nothing tells of frames that did not come.
        position = np.arange(inside.stop - inside.start)
        expected = 0
    accepted = len(np.unique(position))
    return MessageCounts(
        received=received,
        accepted=accepted,
        lost=max(expected - accepted - crc_errors - length_errors, 0),
        repeated=len(position) - accepted,
        out_of_order=_late(position),
        conflicts=conflicts,
        crc_errors=crc_errors,
        length_errors=length_errors,
        range_errors=range_errors,
    )


def _expected(at: NDArray[np.int64], stream: NDArray[np.int64], ticks: int, every: int) -> int:
    """Frames that a test of that length holds."""
    if len(at) == 0:
        return -(-ticks // every)
    return sum(
        len(range(int(at[stream == item].min() % every), ticks, every))
        for item in np.unique(stream)
    )


def _sequence(counter: NDArray[np.int64], modulus: int) -> NDArray[np.int64]:
    """Continue the counter of a message that is sent on event: the nearest number counts."""
    if len(counter) == 0:
        return counter
    step = np.diff(counter) % modulus
    step = np.where(step > modulus // 2, step - modulus, step)
    return np.concatenate(([0], np.cumsum(step)))


def _late(position: NDArray[np.int64]) -> int:
    """Frames that came after a later one, repeats aside."""
    first = np.unique(position, return_index=True)[1]
    once = position[np.sort(first)]
    return int(np.count_nonzero(once < np.maximum.accumulate(once)))
