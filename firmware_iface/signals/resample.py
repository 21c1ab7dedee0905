"""Puts signals of any rate onto control ticks, by a stated rule with a stated error.

A signal that a logger took from the computer's bus *holds* each value for a tick: its changes show
the ticks of the computer, whatever clock the logger has, and each value is taken as it is. A
signal that was measured apart from the bus is read near the end of each tick, where the computer's
converters sample: by a cubic through two samples on either side, as long before the end as the
signal's own samples usually lie. Of many samples in a tick, those within a sixteenth of a tick
about its end are averaged, which removes faster oscillations. With fewer than three samples in four
ticks, each sample goes to the nearest tick, and the other ticks have none.
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
    """Limits that tell which signals hold values for a tick, and in which tick each change is."""

    changes_per_tick: float = 1.1
    """Largest number of changes a tick, in the span with the most."""
    span: int = 50
    """Ticks in which the changes are counted."""
    recent: int = 300
    """Number of latest changes whose least delay is taken for the present one."""
    early: float = 0.15
    """Ticks by which a change may come earlier than after this delay."""
    group: int = 3
    """Number of channels, changing together, from which a tick without a change was lost."""
    rate: float = 1.5
    """Least samples a tick that can show whether a signal holds its values."""
    changes: int = 200
    """Least changes that can show it."""


HELD = HeldLimits()


class TickClock(msgspec.Struct, frozen=True, eq=False):
    """Beginnings of control ticks on the logger's clock."""

    begin: FloatArray
    """Beginning of each tick and of the one after the last, s, shape (ticks + 1,)."""

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

    period: length of a tick, s. Returns False where samples are too rare to show it.
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
    that change together has changed; None: no signal holds its values, or the delays of the changes
    scatter too much for their order alone to tell the ticks.
    """
    held = {role: item for role, item in signals.items() if is_held(item, period)}
    if not held:
        return None
    groups = groups_of(held, period)
    leader = groups[0]
    tick = _tick_sequence((leader.at - leader.at[0]) / period)
    rate = float(np.polyfit(tick, leader.at, 1)[0])
    step = max(sampling_interval(held[role]) for role in leader.roles)
    if _scatter(leader.at - rate * tick) > step + HELD.early * period:
        return None
    last = max(item.time[-1] for item in held.values())
    after = max(int((last - leader.at[-1]) / rate), 0)
    grid = np.arange(int(tick[-1]) + after + 2)
    known = np.append(tick, tick[-1] + after + 2)
    times = np.append(leader.at, leader.at[-1] + (after + 2) * rate)
    clock = TickClock(np.asarray(np.interp(grid, known, times), dtype=np.float64))
    rows: dict[str, FloatArray] = {}
    for group in groups:
        place = _group_ticks(group, leader, tick)
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
        """Whether it is a command, which comes before the telemetry of its tick."""
        return self.roles[0].startswith("command.")

    @property
    def complete(self) -> bool:
        """Whether a tick without a change was lost; in other groups it has the same value again."""
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
    """Ticks of successive changes, each of a tick of its own; since: times of the changes, ticks.

    A change is sampled up to a sampling interval late. The least delay of the recent changes is
    taken for the present one: it drifts, for the logger has another clock.
    """
    tick = np.zeros(len(since), dtype=np.int64)
    recent: deque[float] = deque([0.0], HELD.recent)
    least_delay = 0.0
    for index in range(1, len(since)):
        at = float(since[index])
        tick[index] = max(int(tick[index - 1]) + 1, math.floor(at - least_delay + HELD.early))
        dropped = recent[0] if len(recent) == HELD.recent else math.inf
        recent.append(at - float(tick[index]))
        least_delay = min(recent) if dropped <= least_delay else min(least_delay, recent[-1])
    return tick


def _group_ticks(group: SignalGroup, leader: SignalGroup, tick: IntArray) -> IntArray:
    """Ticks of a group's changes; a command has the tick of the telemetry that follows it."""
    if group is leader:
        return tick
    after = np.searchsorted(leader.at, group.at)
    if group.command and not leader.command:
        later = np.append(tick, tick[-1] + 1)
        # Where telemetry changed ticks later, the command's tick is as many before that change.
        wait = np.append(leader.at, np.inf)[after] - group.at
        period = float(np.median(np.diff(leader.at)))
        return later[after] - np.where(np.isfinite(wait), np.floor(wait / period), 0).astype(int)
    part = np.interp(group.at, leader.at, tick)
    phase = np.angle(np.mean(np.exp(2j * np.pi * part))) / (2.0 * np.pi)
    return np.rint(part - phase).astype(np.int64)


def on_ticks(
    signal: RecordedSignal, clock: TickClock, period: float, *, hold: bool, lead: float = 0.0
) -> tuple[FloatArray, str]:
    """Values of a signal on each tick, and the rule by which they came.

    period: length of a tick, s; hold: take the value in the middle of a tick, not at its end, for
    the computer holds it; lead: time before the ticks' ends whose values are taken, s. Returns
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
    """Usual time between a signal's last sample in a tick and the tick's end, s.

    period: length of a tick, s. Returns less than a sampling interval; 0 where samples are so many
    that their mean is taken, or so few that each goes to the nearest tick.
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
    """Value of each tick: its sample next to the middle, else the last sample before."""
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
