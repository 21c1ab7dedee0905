"""Counts lost, repeated, late, damaged and conflicting frames, and applies the mapping's policy."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
from msgspec.structs import replace

from firmware_iface.alignment.episodes import Episode
from firmware_iface.alignment.ticks import TickAxis
from firmware_iface.bus_map import BusMap
from firmware_iface.codec import Decoded, DecodedTable
from firmware_iface.mapping_file import Policy
from firmware_iface.protection import CONFLICTS, NO_POSITION, conflicting, event_positions
from firmware_iface.recording import BoolArray, FloatArray, IntArray, MessageCounts
from firmware_iface.slow_values import (
    brings_slow_values,
    repeated_frames,
    slow_value_conflict,
)


class Conflicts(msgspec.Struct, frozen=True, eq=False):
    """Frames of one message that were dropped because others had their counter."""

    row: IntArray
    """Rows of the table, ascending, shape (n,)."""
    position: IntArray
    """Which counter value each belongs to, shape (n,)."""
    apart: BoolArray
    """Whether the counters of successive ones lie far apart, shape (n,)."""

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
        if item.counter is None or len(item.row) < 2:
            continue
        counted = item.counted
        if axis is not None and name in ticks:
            position = _positions(item, ticks[name], axis.every[name])
            bad = conflicting(position, item.data)
            if counted is not None:
                bad = np.zeros(len(item.row), dtype=np.bool_)
                bad[counted] = conflicting(position[counted], item.data[counted])
            if bad.any():
                ticks[name] = np.where(bad, NO_POSITION, ticks[name])
        else:
            has, some = event_positions(
                item.counter, item.time_ns, item.modulus, item.values.get("status.state")
            )
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


def _conflicts(item: Decoded, bad: BoolArray, position: IntArray) -> Conflicts:
    if item.counter is None:
        raise AssertionError("no conflict without a counter")
    modulus = item.modulus
    step = np.diff(item.counter, prepend=item.counter[:1]) % modulus
    # A reordered frame does not make so large a step.
    apart = np.minimum(step, modulus - step) > 16
    return Conflicts(item.row[bad], position[bad], apart[bad])


def _positions(item: Decoded, tick: IntArray, every: int) -> IntArray:
    """Unlimited counter of each frame; of one out of line the nearest to the frame before."""
    if item.counter is None:
        raise AssertionError("a position needs a counter")
    sound = tick != NO_POSITION
    place = np.flatnonzero(sound)
    if len(place) == 0:
        return item.counter
    modulus = item.modulus
    position = tick // every
    shift = position[place[0]] - item.counter[place[0]]
    before = np.maximum.accumulate(np.where(sound, np.arange(len(tick)), place[0]))
    reference = position[before]
    away = (item.counter + shift - reference + modulus // 2) % modulus - modulus // 2
    position = np.where(sound, position, reference + away)
    stream = item.stream.astype(np.int64)
    return position * (int(stream.max(initial=0)) + 1) + stream


def too_many_conflicts(conflicts: int, values: int) -> bool:
    """Whether so many of a message's counter values are in conflict that chance did not do it."""
    return conflicts > max(CONFLICTS.chance, CONFLICTS.share * values)


def second_sender_reasons(
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
        if not too_many_conflicts(item.conflicts, values):
            continue
        message = bus_map.messages[name]
        how = "the same counters twice"
        if conflicts[name].interleaved(begin, end):
            how = "two interleaved counters"
        reasons.append(
            f"a second sender of {name} ({message.can_id:#x}), {how}: {item.conflicts} of"
            f" {max(values, item.conflicts)} counter values came with different payloads"
            f" ({CONFLICTS.share:.0%} are borne)"
        )
    return tuple(reasons)


def crowding_reason(item: Decoded, tick_ns: int, begin: int, end: int) -> str:
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
        # More different frames in a tick: a message without a counter has two senders.
        if changes > CONFLICTS.chance and changes > 1.25 * (span + 1.0):
            return (
                f"{item.message.name}: {changes} different frames in {span:.0f} ticks, and no"
                " counter to tell them apart: a second sender, or a wrong tick_ms"
            )
    return ""


def slow_values(
    item: Decoded, begin: int, end: int, span_ns: int
) -> tuple[Mapping[str, FloatArray], tuple[str, ...]]:
    """Values of the environment that a message brings in the rows [begin, end), each frame once.

    item: its frames; begin: rows of the table that belong to the test; end: see `begin`; span_ns:
    duration of the test, ns; the stamps tell it where it is 0. Returns SI values by role, and why
    they are not of one sender (empty: nothing says so).
    """
    roles = [role for role in item.values if role.startswith("environment.")]
    inside = slice(*np.searchsorted(item.row, [begin, end]))
    found: dict[str, list[FloatArray]] = {role: [] for role in roles}
    reasons: list[str] = []
    streams = np.unique(item.stream[inside]) if roles else ()
    for stream in streams:
        mine = inside.start + np.flatnonzero(item.stream[inside] == stream)
        message, data = item.message, item.data[mine]
        # Between two frames of a slow page the counter goes on with all the fast ones.
        counts = len(streams) == 1 or brings_slow_values(message)
        counter = item.counter if counts else None
        if counter is not None:
            every = item.counted is None or item.counted[mine].all()
            counter = counter[mine] if every else None
        time_ns = item.time_ns[mine]
        keep = ~repeated_frames(message, time_ns, data, counted=counter is not None)
        values = {role: item.values[role][mine][keep] for role in roles}
        stamps = time_ns[keep]
        reason = slow_value_conflict(
            message,
            stamps,
            None if counter is None else counter[keep],
            item.modulus,
            values,
            max(span_ns, int(np.ptp(stamps))),
        )
        reasons += [reason] if reason else []
        for role in roles:
            found[role].append(values[role])
    return {role: np.concatenate(parts) for role, parts in found.items() if parts}, tuple(reasons)


def count_within(rows: IntArray, begin: int, end: int) -> int:
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

    axis: ticks; None without telemetry; begin: rows of the table that belong to the test; end: see
    `begin`; conflicts: counter values among them that came with different payloads.
    """
    received = count_within(item.received, begin, end)
    crc_errors = count_within(item.crc_bad, begin, end)
    length_errors = count_within(item.length_bad, begin, end)
    range_errors = count_within(item.range_bad, begin, end)
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
        position = _sequence(item.counter[inside], item.modulus)
        expected = int(position.max() - position.min()) + 1 if len(position) else 0
    else:
        # Nothing tells of frames that did not come.
        position = np.arange(inside.stop - inside.start)
        expected = 0
    first = np.unique(position, return_index=True)[1]
    accepted, once = len(first), position[np.sort(first)]
    return MessageCounts(
        received=received,
        accepted=accepted,
        lost=max(expected - accepted - crc_errors - length_errors, 0),
        repeated=len(position) - accepted,
        # That came after a later one, repeats aside.
        out_of_order=int(np.count_nonzero(once < np.maximum.accumulate(once))),
        conflicts=conflicts,
        crc_errors=crc_errors,
        length_errors=length_errors,
        range_errors=range_errors,
    )


def _expected(at: IntArray, stream: IntArray, ticks: int, every: int) -> int:
    """Frames that a test of that length holds; of several streams each has a rate of its own."""
    if len(at) == 0:
        return -(-ticks // every)
    expected, streams = 0, np.unique(stream)
    for item in streams:
        own = at[stream == item]
        spacing = every
        if len(streams) > 1 and len(apart := np.diff(np.unique(own))):
            spacing = max(every, int(np.median(apart)))
        expected += len(range(int(own.min() % spacing), ticks, spacing))
    return expected


def _sequence(counter: IntArray, modulus: int) -> IntArray:
    """Continue the counter of a message that is sent on event: the nearest number counts."""
    if len(counter) == 0:
        return counter
    step = np.diff(counter) % modulus
    step = np.where(step > modulus // 2, step - modulus, step)
    return np.concatenate(([0], np.cumsum(step)))


FAULT_KINDS = {
    "crc": ("crc_errors", "frames with a wrong check sum"),
    "range": ("range_errors", "frames with values outside their range"),
    "length": ("length_errors", "frames of a wrong length"),
    "lost": ("lost", "frames lost"),
    "repeated": ("repeated", "frames repeated"),
    "out_of_order": ("out_of_order", "frames out of order"),
}
"""Key of the policy: count of the quality, and its words."""


def judge_frames(
    policy: Policy, counts: Mapping[str, MessageCounts]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Reasons to refuse a verdict, and notes on faulty frames that were used.

    A kind is refused where it is met in more than its share of a message's frames, lost ones
    among them.
    """
    refused, notes = [], []
    for kind, (count, words) in FAULT_KINDS.items():
        action: str = getattr(policy, kind)
        limit: float = getattr(policy.limits, kind)
        for name, item in counts.items():
            bad, frames = int(getattr(item, count)), item.received + item.lost
            if not bad:
                continue
            if action == "refuse" and bad > limit * frames:
                share = f"{bad} of {frames} {words} (the mapping's policy allows {limit:.3g})"
                refused.append(f"{name}: {share}")
            elif action == "flag" and kind in ("crc", "range"):
                notes.append(f"{name}: {bad} {words}, used as the mapping's policy says")
    return tuple(refused), tuple(notes)
