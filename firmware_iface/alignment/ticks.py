"""Assigns frames to control ticks: by their counters, or by time stamps where there are none.

Stamps are late, never early, and frames keep their order: phase and drift of the computer's clock
are the *lower envelope* of the stamps (Moon, Skelly and Towsley, INFOCOM 1999). Gaps between late
frames are placed where the measured signals then run smoothly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from firmware_iface.codec import Decoded, DecodedTable
from firmware_iface.protection import NO_POSITION, unwrap
from firmware_iface.recording import BoolArray, FloatArray, IntArray


class StampLimits(msgspec.Struct, frozen=True):
    """Limits by which frames are placed by their time stamps."""

    envelope_block: int = 500
    """Frames of which the earliest shows the phase."""
    burst: int = 500
    """Most frames of a burst of late ones."""
    spacing_lag: int = 200
    """Frames over which the spacing is measured."""
    spacing_quantile: float = 0.2
    """Quantile of the spacings over a lag: losses make them longer, never shorter."""
    spacing_tolerance: float = 0.25
    """Distance of a spacing from a whole number of ticks, per tick."""
    all_late_chance: float = 1e-4
    """Chance that all frames of a stretch are late, below which lateness is a loss."""
    late_quantile: float = 0.95
    """Quantile of the delays that is their usual one."""
    early: float = 0.15
    """Share of a spacing by which a stamp may be earlier than the earliest of its time."""
    rough_early: float = 0.3
    """The same share where the phase is known roughly."""
    on_time: float = 0.05
    """Quantile of the delays at which a stamp is on time."""
    noted_delay: float = 0.05
    """Delay of stamps from which on a note gives it, ticks."""
    phase_block: int = 500
    """Frames over which the phase of a stream against the tick grid is averaged."""
    simultaneity: float = 0.1
    """Phase below which a command and its telemetry count as simultaneous, ticks."""


STAMPS = StampLimits()


class LateStamps(msgspec.Struct, frozen=True, eq=False):
    """Ticks of a message's frames, from 0 at its first one, and how late their stamps are."""

    tick: IntArray
    """Shape (n,)."""
    phase: FloatArray
    """Stamp of a frame that is not late, less its tick, in ticks, shape (n,)."""
    late: FloatArray
    """Delay of each stamp beyond the earliest ones, in ticks, shape (n,)."""

    @property
    def usual(self) -> float:
        """Delay, in ticks, that 95 % of the stamps keep below."""
        return float(np.quantile(self.late, STAMPS.late_quantile)) if len(self.late) else 0.0


def spacing_of(since: FloatArray, stated: float = 0.0) -> int:
    """Ticks between two frames; 0 where several share a tick.

    since: time stamps, ticks, in order of arrival, shape (n,), n > 1; stated: ticks that the DBC
    says; 0: nothing. Returns the spacing. Late stamps and lost frames do not change it.
    """
    lag = max(min(len(since) // 2, STAMPS.spacing_lag), 1)
    steps = (since[lag:] - since[:-lag]) / lag
    # Jitter of the ends of a short lag is no loss: the median is safe there.
    found = float(
        np.quantile(steps, STAMPS.spacing_quantile if lag >= STAMPS.spacing_lag // 4 else 0.5)
    )
    if stated >= 1.0 and abs(found - stated) <= STAMPS.spacing_tolerance * stated:
        return round(stated)
    return round(found) if found < 1e6 else 1


def place_late(since: FloatArray, every: int) -> LateStamps:
    """Place frames in order of arrival by their late time stamps.

    since: time stamps, ticks, shape (n,), n > 0; every: ticks between two frames, at least 1.
    Returns their ticks. Where a frame is lost among late ones, the next few may be a spacing early.
    """
    index = np.arange(len(since), dtype=np.float64)
    slack = (since - since[0]) / every - index
    phase = _envelope(slack)
    over = slack - phase
    whole = np.floor(over + STAMPS.early).astype(np.int64)
    shift = _settled_shift(whole, 1)
    late_share = float(np.mean(over - shift > 1.0 - STAMPS.early))
    if late_share > 0.0:
        sure = int(np.ceil(np.log(STAMPS.all_late_chance) / np.log(min(late_share, 0.95))))
        shift = _settled_shift(whole, max(sure, 1))
    tick = (index.astype(np.int64) + shift) * every
    first = int(tick[0])
    drift = phase * every + first
    return LateStamps(tick - first, drift, (over - shift) * every)


def _settled_shift(shift: IntArray, sure: int) -> IntArray:
    """Each frame's shift is the least of those after it, within the longest burst.

    Of the last `sure` frames nothing proves that they are not late: they keep what was before.
    """
    out = _least_ahead(shift, max(STAMPS.burst, sure))
    if sure > 1 and len(out) > sure:
        end = len(out) - sure
        out[end:] = np.minimum(out[end:], out[end])
    return out


def _least_ahead(values: NDArray[Any], horizon: int) -> NDArray[Any]:
    """Least of each value and the `horizon` ones after it, by doubling."""
    out, width = values.copy(), 1
    while width <= horizon:
        step = min(width, horizon + 1 - width)
        out[:-step] = np.minimum(out[:-step], out[step:])
        width += step
    return out


def _envelope(slack: FloatArray) -> FloatArray:
    """Slowly drifting phase of the earliest stamps, whole spacings taken off; per frame.

    slack: stamp less index, in spacings; it climbs a stair with each lost frame.
    """
    count = len(slack)
    starts = np.arange(0, max(count - STAMPS.envelope_block // 2, 1), STAMPS.envelope_block)
    stairs = _least_ahead(slack, STAMPS.burst)
    turn = np.add.reduceat(np.exp(2j * np.pi * stairs), starts)
    level = np.unwrap(np.angle(turn) / (2.0 * np.pi), period=1.0)
    centre = starts + 0.5 * np.diff(np.append(starts, count))
    near = np.interp(np.arange(count), centre, level)
    # The stairs' mean lies above their lower edge by what the short ones are late.
    over = slack - near
    late = over - _least_ahead(np.floor(over + STAMPS.rough_early), STAMPS.burst)
    edge = np.minimum.reduceat(late, starts)
    return np.asarray(near + np.interp(np.arange(count), centre, edge))


class GapLimits(msgspec.Struct, frozen=True):
    """Limits by which gaps among late frames are placed."""

    shift: int = 12
    """Most frames by which a gap is moved."""
    context: int = 3
    """Frames beyond these whose corners count."""
    corner_cost: float = 25.0
    """Most that one corner counts, variances: what is stranger is no matter of placing."""
    bridged: int = 4
    """Spacings of a gap that signals bridge."""
    lateness: float = 0.05
    """Usual delay below which stamps are enough by themselves, ticks."""


GAPS = GapLimits()


def settle_gaps(
    tick: IntArray, late: FloatArray, every: int, signals: Sequence[FloatArray]
) -> IntArray:
    """Move gaps to where time stamps and signals together put them.

    tick: tick of each frame; each gap as early as the stamps allow, shape (n,); late: delay of each
    stamp, ticks, shape (n,); every: ticks between two frames; signals: what the frames measured,
    NaN where nothing, shape (n,) each. Returns the ticks, shape (n,).
    """
    spread = float(np.sqrt(np.mean(late**2))) if len(late) else 0.0
    step = np.diff(tick)
    gaps = np.flatnonzero((step > every) & (step <= GAPS.bridged * every)) + 1
    scaled = [item for item in map(_scaled, signals) if item is not None]
    if spread < GAPS.lateness or len(gaps) == 0 or not scaled:
        return tick
    out = tick.copy()
    for index, gap in enumerate(gaps.tolist()):
        end = int(gaps[index + 1]) if index + 1 < len(gaps) else len(tick)
        most = min(GAPS.shift, end - gap - 1)
        jump = int(step[gap - 1]) - every
        low, high = (
            max(gap - GAPS.context, 0),
            min(gap + most + GAPS.context, len(tick)),
        )
        costs = []
        for moved in range(most + 1):
            placed = out[low:high].copy()
            placed[gap - low : gap - low + moved] -= jump
            delay = late[gap : gap + moved]
            unlikely = float(np.sum((delay + jump) ** 2 - delay**2)) / spread**2
            costs.append(unlikely + sum(_corners(placed, item[low:high]) for item in scaled))
        best = int(np.argmin(costs))
        out[gap : gap + best] -= jump
    return out


def _scaled(values: FloatArray) -> FloatArray | None:
    """Values in units of the noise of their second differences; None of a signal that stands."""
    second = np.abs(values[2:] - 2.0 * values[1:-1] + values[:-2])
    seen = second[np.isfinite(second)]
    noise = float(np.median(seen)) if len(seen) else 0.0
    return values / noise if noise > 0.0 else None


def _corners(tick: IntArray, values: FloatArray) -> float:
    """Sum of squares by which each value lies off the line between its neighbours."""
    known = np.isfinite(values)
    at, seen = tick[known].astype(np.float64), values[known]
    if len(seen) < 3:
        return 0.0
    weight = (at[1:-1] - at[:-2]) / np.maximum(at[2:] - at[:-2], 1.0)
    off = seen[1:-1] - (1.0 - weight) * seen[:-2] - weight * seen[2:]
    # In units of a second difference, twice what the middle value lies off the line.
    return float(np.minimum(4.0 * off**2, GAPS.corner_cost).sum())


class TickAxis(msgspec.Struct, frozen=True, eq=False):
    """Unlimited tick numbers of the frames of a table."""

    ticks: Mapping[str, IntArray]
    """Per message, tick of each accepted frame, far below zero for one out of line; messages that
    no tick fits are left out.
    """
    rows: Mapping[str, IntArray]
    """Per message, row of the table of each accepted frame."""
    row: IntArray
    """The frames that define the axis, in order of arrival."""
    tick: IntArray
    time_ns: IntArray
    every: Mapping[str, int]
    """Per message, ticks between two frames of one stream."""
    turn: int
    """Ticks after which the counter repeats; 0 without a counter."""
    notes: tuple[str, ...]
    """What a reader should know."""

    def at(self, row: IntArray, time_ns: IntArray, tick_ns: int) -> tuple[FloatArray, IntArray]:
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


def place_frames(decoded: DecodedTable, tick_ns: int) -> TickAxis | None:
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
    modulus = counted[names[0]].modulus
    owner, row, time_ns = owner[order], row[order], time_ns[order]
    position, notes = _unwrap(counter[order], time_ns, moving[order], tick_ns, modulus)
    sound = position != NO_POSITION
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
    sound = tick != NO_POSITION
    return TickAxis(
        ticks={name: tick},
        rows={name: anchor.row},
        row=anchor.row[sound],
        tick=tick[sound],
        time_ns=anchor.time_ns[sound],
        every={name: every},
        turn=anchor.modulus * every,
        notes=notes,
    )


def _standing(item: Decoded, period_ns: int) -> BoolArray:
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
        still &= (waited > period_ns // 2) & (waited < item.modulus * period_ns // 2)
        standing[mine[1:][still]] = True
    return standing


def _unwrap(
    counter: IntArray,
    time_ns: IntArray,
    moving: BoolArray,
    period_ns: int,
    modulus: int,
) -> tuple[IntArray, tuple[str, ...]]:
    """`unwrap` of the frames whose counter moves; the others have no position."""
    if moving.all():
        return unwrap(counter, time_ns, period_ns, modulus)
    position = np.full(len(counter), NO_POSITION, dtype=np.int64)
    position[moving], notes = unwrap(counter[moving], time_ns[moving], period_ns, modulus)
    return position, notes


def _counter(item: Decoded) -> IntArray:
    if item.counter is None:
        raise AssertionError("a message that counts ticks has a counter")
    return item.counter


def _own_ticks(item: Decoded, tick_ns: int) -> tuple[IntArray, int, tuple[str, ...]]:
    """Ticks of a message that stands alone, from 0 at its first frame."""
    if len(item.row) < 2:
        return np.zeros(len(item.row), dtype=np.int64), 1, ()
    every = _frame_spacing(item, tick_ns)
    if item.counter is not None and every >= 1:
        moving = ~_standing(item, every * tick_ns)
        count, notes = _unwrap(item.counter, item.time_ns, moving, every * tick_ns, item.modulus)
        begin = int(count[count != NO_POSITION][0])
        return np.where(count == NO_POSITION, NO_POSITION, (count - begin) * every), every, notes
    if every >= 1:
        placed = _late_stamps(item, every, tick_ns)
        tick = placed.tick
        if item.saturated and not item.stream.any():
            measured = [item.values[role] for role in item.saturated]
            tick = settle_gaps(tick, placed.late, every, measured)
        return tick, every, (_time_note(item, placed.usual, tick_ns),)
    since = (item.time_ns - item.time_ns[0]) / tick_ns
    return np.rint(since - _phase(since)).astype(np.int64), 1, (_time_note(item, 0.0, tick_ns),)


def _late_stamps(item: Decoded, every: int, tick_ns: int) -> LateStamps:
    return place_late((item.time_ns - item.time_ns[0]) / tick_ns, every)


def _time_note(item: Decoded, late: float, tick_ns: int) -> str:
    note = f"{item.message.name}: no counter to place samples by; host time stamps do"
    if late < STAMPS.noted_delay:
        return note
    return f"{note} (late by up to {late * tick_ns / 1e6:.1f} ms, their order places them)"


def _frame_spacing(item: Decoded, tick_ns: int) -> int:
    """Ticks between two frames; 0 where several share a tick."""
    if item.counter is None:
        since = (item.time_ns - item.time_ns[0]) / tick_ns
        return spacing_of(since, item.message.cycle_ns / tick_ns)
    steps = np.diff(item.time_ns) / tick_ns
    counts = np.diff(item.counter) % item.modulus
    steps = steps[counts == 1] if np.any(counts == 1) else steps
    return int(np.rint(np.median(steps))) if np.median(steps) < 1e6 else 1


def _undo_lateness(tick: IntArray, every: int) -> IntArray:
    """Late frames back into the ticks before: stamps can be late (bursts), never early."""
    if every < 1:
        return tick
    index = np.arange(len(tick)) * every
    slack = np.minimum.accumulate((tick - index)[::-1])[::-1]
    return slack + index


def _phase(fraction: FloatArray) -> FloatArray:
    """Slowly drifting offset of a stream against whole ticks, per frame."""
    count = len(fraction)
    starts = np.arange(0, count, STAMPS.phase_block)
    turn = np.exp(2j * np.pi * fraction)
    angle = np.angle(np.add.reduceat(turn, starts)) / (2.0 * np.pi)
    smooth = np.unwrap(angle, period=1.0)
    centre = starts + 0.5 * np.diff(np.append(starts, count))
    phase: FloatArray = np.interp(np.arange(count), centre, smooth)
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
        sound = own != NO_POSITION
        reference = replace(
            axis, row=anchor.row[sound], tick=own[sound], time_ns=anchor.time_ns[sound]
        )
    clock = _ComputerClock.of(anchor, tick_ns) if anchor.counter is None and not axis.turn else None
    for name, item in messages.items():
        if name in ticks or len(item.row) == 0:
            continue
        if clock is not None:
            ticks[name], every[name], stated = clock.place(item, tick_ns)
            notes += stated
            rows[name] = item.row
            continue
        fraction, _ = reference.at(item.row, item.time_ns, tick_ns)
        phase = _phase(fraction)
        precedes = not item.saturated
        if precedes:
            # A command comes before the telemetry of its tick, by less than a tick.
            phase = phase - np.ceil(np.median(phase) - STAMPS.simultaneity)
        else:
            phase = phase - np.rint(np.median(phase))
        by_time = np.rint(fraction - phase).astype(np.int64)
        alone, spacing, _ = _own_ticks(item, tick_ns)
        every[name] = max(spacing, 1)
        if item.counter is not None and spacing >= 1:
            sound = alone != NO_POSITION
            shift = int(np.rint(np.median((by_time - alone)[sound])))
            ticks[name] = np.where(sound, alone + shift, NO_POSITION)
        else:
            ticks[name] = _undo_lateness(by_time, spacing)
            notes.append(f"{name}: no counter to place samples by; host time stamps do")
        rows[name] = item.row
    return replace(axis, ticks=ticks, rows=rows, every=every, notes=tuple(notes))


class _ComputerClock(msgspec.Struct, frozen=True, eq=False):
    """The computer's clock as the earliest stamps of a message without a counter tell it."""

    time_ns: IntArray
    """Host time, ascending."""
    phase: FloatArray
    """Ticks since the first frame, less the tick that an unhindered frame of then is of."""

    @classmethod
    def of(cls, anchor: Decoded, tick_ns: int) -> _ComputerClock | None:
        """Clock of the message that defines the axis; None where several share a tick."""
        if len(anchor.row) < 2 or (every := _frame_spacing(anchor, tick_ns)) < 1:
            return None
        phase = _late_stamps(anchor, every, tick_ns).phase
        return cls(np.maximum.accumulate(anchor.time_ns), phase)

    def place(self, item: Decoded, tick_ns: int) -> tuple[IntArray, int, tuple[str, ...]]:
        """Ticks of another message's frames, the ticks between two of them, and notes.

        A message is sent at the same instant of each of its ticks: a command before the telemetry
        of its tick by less than a tick, other telemetry by the nearest.
        """
        alone, spacing, notes = _own_ticks(item, tick_ns)
        sound = alone != NO_POSITION
        phase = np.interp(item.time_ns, self.time_ns, self.phase)
        away = (item.time_ns - self.time_ns[0]) / tick_ns - phase - alone
        shift = float(np.quantile(away[sound], STAMPS.on_time))
        whole = np.rint(shift) if item.saturated else np.ceil(shift - STAMPS.simultaneity)
        return np.where(sound, alone + int(whole), NO_POSITION), spacing, notes
