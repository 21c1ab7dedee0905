"""Puts signals of any rate onto control ticks, by a stated rule with a stated error.

A signal that a logger took from the computer's bus *holds* each value for a tick: its changes show
the ticks of the computer, whatever clock the logger has, and each value is taken as it is. A
signal that was measured by itself is read near the end of each tick, where the computer's
converters sample: at the instant at which it was sampled mostly, by a cubic through two samples on
either side; of many samples in a tick the mean of those within a sixteenth of a tick about the end,
against what is faster; of less than three in four ticks the nearest tick gets each, and the others
none.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import msgspec
import numpy as np

from firmware_iface.recording import (
    SAMPLING,
    FloatArray,
    IntArray,
    RecordedSignal,
    sampling_interval,
    values_at,
)


class HeldLimits(msgspec.Struct, frozen=True):
    """Limits by which a signal holds its values for a tick, and its changes are counted."""

    changes_per_tick: float = 1.1
    """Most changes a tick, where there are most."""
    span: int = 50
    """Ticks in which the changes are counted."""
    recent: int = 300
    """Changes whose least delay is that of the present ones."""
    early: float = 0.15
    """Ticks by which a change may be earlier than those."""
    group: int = 3
    """Channels that change together from which on a tick without a change is a lost one."""
    rate: float = 1.5
    """Samples a tick from which on a signal can show that it holds its values."""
    changes: int = 200
    """Least changes of a signal that shows it."""


HELD = HeldLimits()


class TickClock(msgspec.Struct, frozen=True, eq=False):
    """Beginnings of control ticks on the logger's clock."""

    begin: FloatArray
    """Of each tick and of the one after the last, s, shape (ticks + 1,)."""

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return len(self.begin) - 1

    @classmethod
    def even(cls, start: float, period: float, ticks: int) -> TickClock:
        """Ticks of one length."""
        return cls(start + period * np.arange(ticks + 1, dtype=np.float64))


def is_held(signal: RecordedSignal, period: float) -> bool:
    """Whether a signal keeps each value for a whole tick, as one taken from a bus does.

    period: length of a tick, s. Returns False of one that is sampled too seldom to show it.
    """
    if period / sampling_interval(signal) < HELD.rate:
        return False
    at = _changes(signal)
    if len(at) < HELD.changes:
        return False
    window = np.floor((at - at[0]) / (HELD.span * period)).astype(np.int64)
    return float(np.bincount(window).max()) <= HELD.changes_per_tick * HELD.span


def _changes(signal: RecordedSignal) -> FloatArray:
    """Instants of the first sample of each new value."""
    return signal.time[1:][np.diff(signal.value) != 0.0]


def held_on_ticks(
    signals: Mapping[str, RecordedSignal], period: float
) -> tuple[TickClock, dict[str, FloatArray]] | None:
    """Put held signals on the ticks that their own changes show, by the order of the changes.

    signals: by role; period: nominal length of a tick, s. Returns the computer's clock on the
    logger's, and values by role, shape (ticks,): NaN in ticks in which none of several channels
    that change together has changed; None where no signal holds its values, or changes come too
    late to be told by their order alone.
    """
    held = {role: item for role, item in signals.items() if is_held(item, period)}
    if not held:
        return None
    groups = groups_of(held, period)
    lead = groups[0]
    tick = _tick_sequence((lead.at - lead.at[0]) / period)
    rate = float(np.polyfit(tick, lead.at, 1)[0])
    step = max(sampling_interval(held[role]) for role in lead.roles)
    if _scatter(lead.at - rate * tick) > step + HELD.early * period:
        return None
    last = max(item.time[-1] for item in held.values())
    after = max(int((last - lead.at[-1]) / rate), 0)
    grid = np.arange(int(tick[-1]) + after + 2)
    known = np.append(tick, tick[-1] + after + 2)
    times = np.append(lead.at, lead.at[-1] + (after + 2) * rate)
    clock = TickClock(np.asarray(np.interp(grid, known, times), dtype=np.float64))
    rows: dict[str, FloatArray] = {}
    for group in groups:
        place = _group_ticks(group, lead, tick)
        for role in group.roles:
            item = held[role]
            value = group.on_ticks(item, place, clock.ticks)
            rows[role] = value if group.complete else hold_forward(value, item.value[0])
    return clock, rows


class SignalGroup(msgspec.Struct, frozen=True, eq=False):
    """Held signals that change together."""

    roles: tuple[str, ...]
    at: FloatArray
    """Times of the first samples of new values, s."""

    @property
    def command(self) -> bool:
        """Whether it is a command: that comes before the telemetry of its tick."""
        return self.roles[0].startswith("command.")

    @property
    def complete(self) -> bool:
        """Whether a tick without a change is one that did not arrive rather than an equal value."""
        return len(self.roles) >= HELD.group

    def values(self, signal: RecordedSignal) -> FloatArray:
        """New values of one of its signals, shape (n,)."""
        return signal.value[np.searchsorted(signal.time, self.at)]

    def on_ticks(self, signal: RecordedSignal, tick: IntArray, ticks: int) -> FloatArray:
        """New values at their ticks, shape (ticks,); NaN in the others."""
        out = np.full(ticks, np.nan)
        inside = (tick >= 0) & (tick < ticks)
        out[tick[inside]] = self.values(signal)[inside]
        return out


def groups_of(held: Mapping[str, RecordedSignal], period: float) -> list[SignalGroup]:
    """Channels that change together first, then what changes alone.

    held: signals that hold their values, by role; period: length of a tick, s.
    """
    channels = tuple(role for role in held if role.startswith("channels."))
    alone = [role for role in held if role not in channels]
    out = []
    if channels:
        together = np.unique(np.concatenate([_changes(held[role]) for role in channels]))
        span = max(float(together[-1] - together[0]), period)
        if len(together) * period <= HELD.changes_per_tick * span:
            out.append(SignalGroup(channels, together))
        else:
            alone = [*channels, *alone]
    singles = [SignalGroup((role,), _changes(held[role])) for role in alone]
    return out + sorted(singles, key=lambda item: -len(item.at))


def hold_forward(values: FloatArray, first: float) -> FloatArray:
    """Each value until the next one; `first` before there is any.

    values: NaN where there is none, shape (n,); first: value before the first one. Returns without
    NaN, shape (n,).
    """
    known = np.isfinite(values)
    index = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    return np.where(index >= 0, values[np.maximum(index, 0)], first)


def _scatter(values: FloatArray) -> float:
    """Width of a distribution but for its outermost hundredths."""
    low, high = np.quantile(values, [0.01, 0.99])
    return float(high - low)


def _tick_sequence(since: FloatArray) -> IntArray:
    """Ticks of changes that follow one another: each is of a tick of its own.

    A change comes up to a sampling interval late. The earliest of late tell how late the present
    ones are at least; a logger with another clock makes that wander.
    """
    tick = np.zeros(len(since), dtype=np.int64)
    recent: deque[float] = deque([0.0], HELD.recent)
    edge = 0.0
    for index in range(1, len(since)):
        at = float(since[index])
        tick[index] = max(int(tick[index - 1]) + 1, math.floor(at - edge + HELD.early))
        gone = recent[0] if len(recent) == HELD.recent else math.inf
        recent.append(at - float(tick[index]))
        edge = min(recent) if gone <= edge else min(edge, recent[-1])
    return tick


def _group_ticks(group: SignalGroup, lead: SignalGroup, tick: IntArray) -> IntArray:
    """Ticks of a group's changes: a command's is that of the telemetry that follows it."""
    if group is lead:
        return tick
    after = np.searchsorted(lead.at, group.at)
    if group.command and not lead.command:
        later = np.append(tick, tick[-1] + 1)
        # Between two changes that are far apart the command may be of any tick there.
        back = np.append(lead.at, np.inf)[after] - group.at
        period = float(np.median(np.diff(lead.at)))
        return later[after] - np.where(np.isfinite(back), np.floor(back / period), 0).astype(int)
    part = np.interp(group.at, lead.at, tick)
    phase = np.angle(np.mean(np.exp(2j * np.pi * part))) / (2.0 * np.pi)
    return np.rint(part - phase).astype(np.int64)


def on_ticks(
    signal: RecordedSignal, clock: TickClock, period: float, *, hold: bool, lead: float = 0.0
) -> tuple[FloatArray, str]:
    """Values of a signal on each tick, and the rule by which they came.

    period: length of a tick, s; hold: take the value in the middle of a tick, not that at its end:
    of what the computer holds; lead: time before the ticks' ends whose values are taken, s. Returns
    NaN where there is none, shape (ticks,); the rule in words, with its error.
    """
    step = sampling_interval(signal)
    if hold:
        instants = clock.begin[:-1] + 0.5 * period
        most = max(SAMPLING.gap * step, 1.5 * period)
        rule = "the value next to the middle of each tick"
        return _held_at(signal, instants, period, most), rule
    return values_at(signal, clock.begin[1:] - lead, period)


def usual_lead(signal: RecordedSignal, clock: TickClock, period: float) -> float:
    """Time before the ticks' ends at which a signal was sampled mostly, s.

    period: length of a tick, s. Returns less than a sampling interval; 0 of so many samples that
    their mean is taken, and of so few that each goes to the nearest tick.
    """
    step = sampling_interval(signal)
    if not SAMPLING.nearest <= period / step < SAMPLING.averaged:
        return 0.0
    ends = clock.begin[1:]
    inside = (ends > signal.time[0]) & (ends < signal.time[-1])
    before = np.searchsorted(signal.time, ends[inside], side="right") - 1
    turn = np.exp(2j * np.pi * (ends[inside] - signal.time[before]) / step)
    return float(np.angle(turn.sum()) / (2.0 * np.pi) % 1.0) * step


def _held_at(signal: RecordedSignal, middle: FloatArray, period: float, most: float) -> FloatArray:
    """Value in the tick about each middle: its sample next to it, else the last one before."""
    time = signal.time
    before = np.searchsorted(time, middle, side="right") - 1
    known = before >= 0
    before = np.maximum(before, 0)
    after = np.minimum(before + 1, len(time) - 1)
    # A sample far from both edges is of this tick even where the edges are not known well.
    near = np.where(np.abs(time[after] - middle) < np.abs(middle - time[before]), after, before)
    within = np.abs(time[near] - middle) <= 0.5 * period
    index = np.where(within, near, before)
    known = within | (known & (middle - time[before] <= most))
    return np.where(known, signal.value[index], np.nan)
