"""Detects a second sender of the same messages: drops conflicting frames and gives the reasons."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.recording import MessageCounts
from firmware_iface.alignment.ticks import TickAxis
from firmware_iface.codec.decode import Decoded, DecodedTable
from firmware_iface.codec.protection import OUTSIDE
from firmware_iface.codec.validity import (
    LEAST_CONFLICTS,
    MOST_CONFLICTS,
    conflicting,
    event_positions,
)
from firmware_iface.mapping.bus_map import BusMap

__all__ = ["Conflicts", "crowded", "drop_conflicts", "second_senders", "too_many"]

MOST_FRAMES = 1.25
"""Different frames in a tick beyond which a message without a counter has two senders."""
APART = 16
"""Counts between two successive frames that a reordered one does not make."""

Rows = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Conflicts:
    """Frames of one message that were dropped because others had their counter.

    Attributes
    ----------
    row : Rows
        Rows of the table, ascending, shape (n,).
    position : Rows
        Which counter value each belongs to, shape (n,).
    apart : NDArray[np.bool_]
        Whether the counters of successive ones lie far apart, shape (n,).
    """

    row: Rows
    position: Rows
    apart: NDArray[np.bool_]

    @property
    def count(self) -> int:
        """Counter values in conflict."""
        return len(np.unique(self.position))

    def within(self, begin: int, end: int) -> int:
        """Counter values in conflict among the rows in [begin, end)."""
        inside = slice(*np.searchsorted(self.row, [begin, end]))
        return len(np.unique(self.position[inside]))

    def interleaved(self, begin: int, end: int) -> bool:
        """Whether two counters run beside each other, rather than one twice."""
        inside = slice(*np.searchsorted(self.row, [begin, end]))
        return bool(self.apart[inside].mean() > 1 / 3) if inside.stop > inside.start else False


def drop_conflicts(
    decoded: DecodedTable, axis: TickAxis | None
) -> tuple[DecodedTable, TickAxis | None, Mapping[str, Conflicts]]:
    """Leave out all frames that share their counter with one of another payload."""
    messages = dict(decoded.messages)
    ticks = {} if axis is None else dict(axis.ticks)
    found: dict[str, Conflicts] = {}
    for name, item in decoded.messages.items():
        counter = item.message.counter
        if counter is None or item.counter is None or len(item.row) < 2:
            continue
        counted = counter.present(item.data)
        if axis is not None and name in ticks:
            position = _positions(item, ticks[name], axis.every[name])
            bad = conflicting(position, item.data)
            if counted is not None:
                bad = np.zeros(len(item.row), dtype=np.bool_)
                bad[counted] = conflicting(position[counted], item.data[counted])
            if bad.any():
                ticks[name] = np.where(bad, OUTSIDE, ticks[name])
        else:
            has, some = event_positions(item.counter, item.time_ns, item.message.modulus)
            position = np.zeros(len(item.row), dtype=np.int64)
            position[has] = some
            bad = np.zeros(len(item.row), dtype=np.bool_)
            bad[has] = conflicting(some, item.data[has])
            if counted is not None:
                bad &= counted
            if bad.any():
                messages[name] = item.without(bad)
        if bad.any():
            found[name] = _conflicts(item, bad, position)
    if axis is not None:
        axis = replace(axis, ticks=ticks)
    return replace(decoded, messages=messages), axis, found


def _conflicts(item: Decoded, bad: NDArray[np.bool_], position: Rows) -> Conflicts:
    if item.counter is None:
        raise AssertionError("no conflict without a counter")
    modulus = item.message.modulus
    step = np.diff(item.counter, prepend=item.counter[:1]) % modulus
    apart = np.minimum(step, modulus - step) > APART
    return Conflicts(item.row[bad], position[bad], apart[bad])


def _positions(item: Decoded, tick: Rows, every: int) -> Rows:
    """Unlimited counter of each frame; of one out of line the nearest to the frame before."""
    if item.counter is None:
        raise AssertionError("a position needs a counter")
    sound = tick != OUTSIDE
    place = np.flatnonzero(sound)
    if len(place) == 0:
        return item.counter
    modulus = item.message.modulus
    position = tick // every
    shift = position[place[0]] - item.counter[place[0]]
    before = np.maximum.accumulate(np.where(sound, np.arange(len(tick)), place[0]))
    reference = position[before]
    away = (item.counter + shift - reference + modulus // 2) % modulus - modulus // 2
    position = np.where(sound, position, reference + away)
    stream = item.stream.astype(np.int64)
    return position * (int(stream.max(initial=0)) + 1) + stream


def too_many(conflicts: int, values: int) -> bool:
    """Whether so many of a message's counter values are in conflict that chance did not do it."""
    return conflicts > max(LEAST_CONFLICTS, MOST_CONFLICTS * values)


def second_senders(
    counts: Mapping[str, MessageCounts],
    conflicts: Mapping[str, Conflicts],
    bus_map: BusMap,
    begin: int,
    end: int,
) -> tuple[str, ...]:
    """Reasons to give no verdict on the rows in [begin, end) for what else was sent there."""
    reasons = []
    for name, item in counts.items():
        values = item.accepted + item.lost
        if not too_many(item.conflicts, values):
            continue
        message = bus_map.messages[name]
        how = "the same counters twice"
        if conflicts[name].interleaved(begin, end):
            how = "two interleaved counters"
        reasons.append(
            f"a second sender of {name} ({message.can_id:#x}), {how}: {item.conflicts} of"
            f" {max(values, item.conflicts)} counter values came with different payloads"
            f" ({MOST_CONFLICTS:.0%} are borne)"
        )
    return tuple(reasons)


def crowded(item: Decoded, tick_ns: int, begin: int, end: int) -> str:
    """Why a message without a counter has more than one sender; empty if nothing says so."""
    drives = any(role.name.split(".")[0] in ("channels", "command") for role in item.message.roles)
    if item.counter is not None or not drives:
        return ""
    inside = slice(*np.searchsorted(item.row, [begin, end]))
    for stream in np.unique(item.stream[inside]):
        mine = inside.start + np.flatnonzero(item.stream[inside] == stream)
        if len(mine) < 2:
            continue
        changes = int((item.data[mine[1:]] != item.data[mine[:-1]]).any(axis=1).sum())
        span = int(item.time_ns[mine].max() - item.time_ns[mine].min()) / tick_ns
        if changes > LEAST_CONFLICTS and changes > MOST_FRAMES * (span + 1.0):
            return (
                f"{item.message.name}: {changes} different frames in {span:.0f} ticks, and no"
                " counter to tell them apart: a second sender, or a wrong tick_ms"
            )
    return ""
