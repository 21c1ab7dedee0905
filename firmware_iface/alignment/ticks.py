"""Assigns frames to control ticks: by their counters, or by time stamps where there are none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from firmware_iface.alignment.gaps import settle_gaps
from firmware_iface.alignment.late_stamps import LateStamps, place_late, spacing_of
from firmware_iface.codec.decode import Decoded, DecodedTable
from firmware_iface.codec.protection import OUTSIDE, unwrap

__all__ = ["TickAxis", "place"]

PHASE_BLOCK = 500
"""Frames over which the phase of a stream against the tick grid is averaged."""
SAME_TIME = 0.1
"""Phase, in ticks, below which a command and its telemetry count as simultaneous."""

EARLIEST = 0.05
"""Quantile of delays at which a stamp is on time."""
WORTH_SAYING = 0.05
"""Delay of stamps, in ticks, that is told."""

Ticks = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class TickAxis:
    """Unlimited tick numbers of the frames of a table.

    Attributes
    ----------
    ticks : Mapping[str, Ticks]
        Per message, tick of each accepted frame, far below zero for one out of line; messages
        that no tick fits are left out.
    rows : Mapping[str, NDArray[np.int64]]
        Per message, row of the table of each accepted frame.
    row : NDArray[np.int64]
        The frames that define the axis, in order of arrival.
    tick : Ticks
        See `row`.
    time_ns : NDArray[np.int64]
        See `row`.
    every : Mapping[str, int]
        Per message, ticks between two frames of one stream.
    turn : int
        Ticks after which the counter repeats; 0 without a counter.
    notes : tuple[str, ...]
        What a reader should know.
    """

    ticks: Mapping[str, Ticks]
    rows: Mapping[str, NDArray[np.int64]]
    row: NDArray[np.int64]
    tick: Ticks
    time_ns: NDArray[np.int64]
    every: Mapping[str, int]
    turn: int
    notes: tuple[str, ...]

    def at(
        self, row: NDArray[np.int64], time_ns: NDArray[np.int64], tick_ns: int
    ) -> tuple[NDArray[np.float64], Ticks]:
        """Tick of other frames: fractional by time since the axis frame before, and the tick of
        the axis frame after (one past the last where none follows)."""
        after = np.searchsorted(self.row, row)
        before = np.maximum(after - 1, 0)
        fraction = self.tick[before] + (time_ns - self.time_ns[before]) / tick_ns
        end = self.tick.max() + 1
        following = np.where(
            after < len(self.tick), self.tick[np.minimum(after, len(self.tick) - 1)], end
        )
        return fraction, following


def place(decoded: DecodedTable, tick_ns: int) -> TickAxis | None:
    """Give every frame of telemetry and command its tick; None without telemetry."""
    messages = {
        name: item
        for name, item in decoded.messages.items()
        if any(role.name.split(".")[0] in ("channels", "command") for role in item.message.roles)
    }
    telemetry = {name: item for name, item in messages.items() if item.saturated}
    counted = {name: item for name, item in messages.items() if item.message.counts_ticks}
    if not any(len(item.row) for item in telemetry.values()):
        return None
    anchor = max(telemetry.values(), key=lambda item: len(item.row))
    if counted and any(name in telemetry and len(item.row) for name, item in counted.items()):
        axis = _counted_axis(counted, tick_ns)
    else:
        axis = _anchor_axis(anchor, tick_ns)
    return _with_others(axis, messages, anchor, tick_ns)


def _counted_axis(counted: Mapping[str, Decoded], tick_ns: int) -> TickAxis:
    names = list(counted)
    row = np.concatenate([counted[name].row for name in names])
    owner = np.concatenate([np.full(len(counted[name].row), i) for i, name in enumerate(names)])
    counter = np.concatenate([_counter(counted[name]) for name in names])
    time_ns = np.concatenate([counted[name].time_ns for name in names])
    moving = np.concatenate([~_standing(counted[name], tick_ns) for name in names])
    # Stable sorting merges columns that are sorted already: twice as fast.
    order = np.argsort(row, kind="stable")
    modulus = counted[names[0]].message.modulus
    owner, row, time_ns = owner[order], row[order], time_ns[order]
    position, notes = _unwrap(counter[order], time_ns, moving[order], tick_ns, modulus)
    sound = position != OUTSIDE
    ticks = {name: position[owner == index] for index, name in enumerate(names)}
    return TickAxis(
        ticks=ticks,
        rows={name: counted[name].row for name in names},
        row=row[sound],
        tick=position[sound],
        time_ns=time_ns[sound],
        every=dict.fromkeys(names, 1),
        turn=modulus,
        notes=notes,
    )


def _anchor_axis(anchor: Decoded, tick_ns: int) -> TickAxis:
    tick, every, notes = _own_ticks(anchor, tick_ns)
    name = anchor.message.name
    sound = tick != OUTSIDE
    return TickAxis(
        ticks={name: tick},
        rows={name: anchor.row},
        row=anchor.row[sound],
        tick=tick[sound],
        time_ns=anchor.time_ns[sound],
        every={name: every},
        turn=anchor.message.modulus * every,
        notes=notes,
    )


def _standing(item: Decoded, period_ns: int) -> NDArray[np.bool_]:
    """Frames whose counter has not moved since the frame before, though time has.

    Nothing tells which tick they are of: once a turn such a counter even looks right. A repeat of a
    frame takes no time; a gap of a whole turn takes a whole turn.
    """
    standing = np.zeros(len(item.row), dtype=np.bool_)
    if item.counter is None:
        return standing
    for stream in np.unique(item.stream):
        mine = np.flatnonzero(item.stream == stream)
        waited = np.diff(item.time_ns[mine])
        still = np.diff(item.counter[mine]) == 0
        still &= (waited > period_ns // 2) & (waited < item.message.modulus * period_ns // 2)
        standing[mine[1:][still]] = True
    return standing


def _unwrap(
    counter: NDArray[np.int64],
    time_ns: NDArray[np.int64],
    moving: NDArray[np.bool_],
    period_ns: int,
    modulus: int,
) -> tuple[Ticks, tuple[str, ...]]:
    """`unwrap` of the frames whose counter moves; the others have no position."""
    if moving.all():
        return unwrap(counter, time_ns, period_ns, modulus)
    position = np.full(len(counter), OUTSIDE, dtype=np.int64)
    position[moving], notes = unwrap(counter[moving], time_ns[moving], period_ns, modulus)
    return position, notes


def _counter(item: Decoded) -> NDArray[np.int64]:
    if item.counter is None:
        raise AssertionError("a message that counts ticks has a counter")
    return item.counter


def _own_ticks(item: Decoded, tick_ns: int) -> tuple[Ticks, int, tuple[str, ...]]:
    """Ticks of a message that stands alone, from 0 at its first frame."""
    if len(item.row) < 2:
        return np.zeros(len(item.row), dtype=np.int64), 1, ()
    every = _frame_spacing(item, tick_ns)
    if item.counter is not None and every >= 1:
        moving = ~_standing(item, every * tick_ns)
        count, notes = _unwrap(
            item.counter, item.time_ns, moving, every * tick_ns, item.message.modulus
        )
        begin = int(count[count != OUTSIDE][0])
        return np.where(count == OUTSIDE, OUTSIDE, (count - begin) * every), every, notes
    if every >= 1:
        placed = _late(item, every, tick_ns)
        tick = placed.tick
        if item.saturated and not item.stream.any():
            measured = [item.values[role] for role in item.saturated]
            tick = settle_gaps(tick, placed.late, every, measured)
        return tick, every, (_by_time(item, placed.usual, tick_ns),)
    since = (item.time_ns - item.time_ns[0]) / tick_ns
    return np.rint(since - _phase(since)).astype(np.int64), 1, (_by_time(item, 0.0, tick_ns),)


def _late(item: Decoded, every: int, tick_ns: int) -> LateStamps:
    return place_late((item.time_ns - item.time_ns[0]) / tick_ns, every)


def _by_time(item: Decoded, late: float, tick_ns: int) -> str:
    note = f"{item.message.name}: no counter to place samples by; host time stamps do"
    if late < WORTH_SAYING:
        return note
    return f"{note} (late by up to {late * tick_ns / 1e6:.1f} ms, their order places them)"


def _frame_spacing(item: Decoded, tick_ns: int) -> int:
    """Ticks between two frames; 0 where several share a tick."""
    if item.counter is None:
        since = (item.time_ns - item.time_ns[0]) / tick_ns
        return spacing_of(since, item.message.cycle_ns / tick_ns)
    steps = np.diff(item.time_ns) / tick_ns
    counts = np.diff(item.counter) % item.message.modulus
    steps = steps[counts == 1] if np.any(counts == 1) else steps
    return int(np.rint(np.median(steps))) if np.median(steps) < 1e6 else 1


def _settle(tick: Ticks, every: int) -> Ticks:
    """Late frames back into the ticks before: stamps can be late (bursts), never early."""
    if every < 1:
        return tick
    index = np.arange(len(tick)) * every
    slack = np.minimum.accumulate((tick - index)[::-1])[::-1]
    return slack + index


def _phase(fraction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Slowly drifting offset of a stream against whole ticks, per frame."""
    count = len(fraction)
    starts = np.arange(0, count, PHASE_BLOCK)
    turn = np.exp(2j * np.pi * fraction)
    angle = np.angle(np.add.reduceat(turn, starts)) / (2.0 * np.pi)
    smooth = np.unwrap(angle, period=1.0)
    centre = starts + 0.5 * np.diff(np.append(starts, count))
    phase: NDArray[np.float64] = np.interp(np.arange(count), centre, smooth)
    return phase


def _with_others(
    axis: TickAxis, messages: Mapping[str, Decoded], anchor: Decoded, tick_ns: int
) -> TickAxis:
    """Add the messages that the axis does not hold, by time against the anchor's frames."""
    ticks, rows = dict(axis.ticks), dict(axis.rows)
    every, notes = dict(axis.every), list(axis.notes)
    own = ticks.get(anchor.message.name)
    reference = axis
    if own is not None and len(axis.row) != len(own):
        sound = own != OUTSIDE
        reference = replace(
            axis, row=anchor.row[sound], tick=own[sound], time_ns=anchor.time_ns[sound]
        )
    clock = _Clock.of(anchor, tick_ns) if anchor.counter is None and not axis.turn else None
    for name, item in messages.items():
        if name in ticks or len(item.row) == 0:
            continue
        if clock is not None:
            ticks[name], every[name], said = clock.place(item, tick_ns)
            notes += said
            rows[name] = item.row
            continue
        fraction, _ = reference.at(item.row, item.time_ns, tick_ns)
        phase = _phase(fraction)
        precedes = not item.saturated
        if precedes:
            # A command comes before the telemetry of its tick, by less than a tick.
            phase = phase - np.ceil(np.median(phase) - SAME_TIME)
        else:
            phase = phase - np.rint(np.median(phase))
        by_time = np.rint(fraction - phase).astype(np.int64)
        alone, spacing, _ = _own_ticks(item, tick_ns)
        every[name] = max(spacing, 1)
        if item.counter is not None and spacing >= 1:
            sound = alone != OUTSIDE
            shift = int(np.rint(np.median((by_time - alone)[sound])))
            ticks[name] = np.where(sound, alone + shift, OUTSIDE)
        else:
            ticks[name] = _settle(by_time, spacing)
            notes.append(f"{name}: no counter to place samples by; host time stamps do")
        rows[name] = item.row
    return replace(axis, ticks=ticks, rows=rows, every=every, notes=tuple(notes))


@dataclass(frozen=True, slots=True, eq=False)
class _Clock:
    """The computer's clock as the earliest stamps of a message without a counter tell it.

    Attributes
    ----------
    time_ns : NDArray[np.int64]
        Host time, ascending.
    phase : NDArray[np.float64]
        Ticks since the first frame, less the tick that an unhindered frame of then is of.
    """

    time_ns: NDArray[np.int64]
    phase: NDArray[np.float64]

    @classmethod
    def of(cls, anchor: Decoded, tick_ns: int) -> _Clock | None:
        """Clock of the message that defines the axis; None where several share a tick."""
        if len(anchor.row) < 2 or (every := _frame_spacing(anchor, tick_ns)) < 1:
            return None
        phase = _late(anchor, every, tick_ns).phase
        return cls(np.maximum.accumulate(anchor.time_ns), phase)

    def place(self, item: Decoded, tick_ns: int) -> tuple[Ticks, int, tuple[str, ...]]:
        """Ticks of another message's frames, the ticks between two of them, and notes.

        A message is sent at the same instant of each of its ticks: a command before the telemetry
        of its tick by less than a tick, other telemetry by the nearest.
        """
        alone, spacing, notes = _own_ticks(item, tick_ns)
        sound = alone != OUTSIDE
        phase = np.interp(item.time_ns, self.time_ns, self.phase)
        away = (item.time_ns - self.time_ns[0]) / tick_ns - phase - alone
        shift = float(np.quantile(away[sound], EARLIEST))
        whole = np.rint(shift) if item.saturated else np.ceil(shift - SAME_TIME)
        return np.where(sound, alone + int(whole), OUTSIDE), spacing, notes
