"""Puts signals of any rate onto control ticks, by a stated rule with a stated error.

A signal that a logger took from the computer's bus *holds* each value for a tick: its changes show
the ticks of the computer, whatever clock the logger has, and each value is taken as it is. A
signal that was measured by itself is read at the end of each tick, where the computer's converters
sample: by a straight line between its neighbours; of many samples in a tick the mean of those
within an eighth of a tick about that instant, against what is faster; of less than three in four
ticks the nearest tick gets each, and the others none.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.signals.tables import Signal

__all__ = [
    "DENSE",
    "Clock",
    "Group",
    "bend",
    "forward",
    "groups_of",
    "held_on_ticks",
    "holds",
    "interval",
    "on_ticks",
]

MOST_CHANGES = 1.1
"""Changes a tick, where there are most, of a signal that holds each value for a tick."""
LIVELY = 50
"""Ticks in which they are counted."""
RECENT = 300
"""Changes whose least delay is that of the present ones."""
EARLY = 0.15
"""Ticks by which a change may be earlier than those."""
LEAST_TOGETHER = 3
"""Channels that change together from which on a tick without any change is a lost one."""
DENSE = 1.5
"""Samples a tick from which on a signal can show that it holds its values."""
LEAST_CHANGES = 200
SPARSE = 0.75
"""Samples a tick below which each goes to the nearest tick."""
MANY = 8.0
"""Samples a tick from which on the mean of several is taken."""
WINDOW = 0.125
"""Ticks on either side of an instant whose samples are averaged."""
GAP = 2.5
"""Sampling intervals between two neighbours beyond which nothing is interpolated."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Clock:
    """Beginnings of control ticks on the logger's clock.

    Attributes
    ----------
    begin : Floats
        Of each tick and of the one after the last, s, shape (ticks + 1,).
    """

    begin: Floats

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return len(self.begin) - 1

    @classmethod
    def even(cls, start: float, period: float, ticks: int) -> Clock:
        """Ticks of one length."""
        return cls(start + period * np.arange(ticks + 1, dtype=np.float64))


def interval(signal: Signal) -> float:
    """Usual time between two samples, s."""
    return float(np.median(np.diff(signal.time))) if len(signal.time) > 1 else np.inf


def holds(signal: Signal, period: float) -> bool:
    """Whether a signal keeps each value for a whole tick, as one taken from a bus does.

    Parameters
    ----------
    signal : Signal
        As recorded.
    period : float
        Length of a tick, s.

    Returns
    -------
    bool
        False of one that is sampled too seldom to show it.
    """
    if period / interval(signal) < DENSE:
        return False
    at = _changes(signal)
    if len(at) < LEAST_CHANGES:
        return False
    window = np.floor((at - at[0]) / (LIVELY * period)).astype(np.int64)
    return float(np.bincount(window).max()) <= MOST_CHANGES * LIVELY


def _changes(signal: Signal) -> Floats:
    """Instants of the first sample of each new value."""
    return signal.time[1:][np.diff(signal.value) != 0.0]


def held_on_ticks(
    signals: Mapping[str, Signal], period: float
) -> tuple[Clock, dict[str, Floats]] | None:
    """Put held signals on the ticks that their own changes show, by the order of the changes.

    Parameters
    ----------
    signals : Mapping[str, Signal]
        By role.
    period : float
        Nominal length of a tick, s.

    Returns
    -------
    tuple[Clock, dict[str, Floats]] | None
        The computer's clock on the logger's, and values by role, shape (ticks,): NaN in ticks in
        which none of several channels that change together has changed; None where no signal
        holds its values, or changes come too late to be told by their order alone.
    """
    held = {role: item for role, item in signals.items() if holds(item, period)}
    if not held:
        return None
    groups = groups_of(held, period)
    lead = groups[0]
    tick = _counted((lead.at - lead.at[0]) / period)
    rate = float(np.polyfit(tick, lead.at, 1)[0])
    step = max(interval(held[role]) for role in lead.roles)
    if _scatter(lead.at - rate * tick) > step + EARLY * period:
        return None
    last = max(item.time[-1] for item in held.values())
    after = max(int((last - lead.at[-1]) / rate), 0)
    grid = np.arange(int(tick[-1]) + after + 2)
    known = np.append(tick, tick[-1] + after + 2)
    times = np.append(lead.at, lead.at[-1] + (after + 2) * rate)
    clock = Clock(np.asarray(np.interp(grid, known, times), dtype=np.float64))
    rows: dict[str, Floats] = {}
    for group in groups:
        place = _beside(group, lead, tick)
        inside = (place >= 0) & (place < clock.ticks)
        for role in group.roles:
            item = held[role]
            value = np.full(clock.ticks, np.nan)
            value[place[inside]] = item.value[np.searchsorted(item.time, group.at[inside])]
            rows[role] = value if group.complete else forward(value, item.value[0])
    return clock, rows


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Held signals that change together.

    Attributes
    ----------
    roles : tuple[str, ...]
        Which.
    at : Floats
        Times of the first samples of new values, s.
    """

    roles: tuple[str, ...]
    at: Floats

    @property
    def command(self) -> bool:
        """Whether it is a command: that comes before the telemetry of its tick."""
        return self.roles[0].startswith("command.")

    @property
    def complete(self) -> bool:
        """Whether a tick without a change is one that did not arrive rather than an equal value."""
        return len(self.roles) >= LEAST_TOGETHER


def groups_of(held: Mapping[str, Signal], period: float) -> list[Group]:
    """Channels that change together first, then what changes alone.

    Parameters
    ----------
    held : Mapping[str, Signal]
        Signals that hold their values, by role.
    period : float
        Length of a tick, s.

    Returns
    -------
    list[Group]
        Each role in one of them.
    """
    channels = tuple(role for role in held if role.startswith("channels."))
    alone = [role for role in held if role not in channels]
    out = []
    if channels:
        together = np.unique(np.concatenate([_changes(held[role]) for role in channels]))
        span = max(float(together[-1] - together[0]), period)
        if len(together) * period <= MOST_CHANGES * span:
            out.append(Group(channels, together))
        else:
            alone = [*channels, *alone]
    singles = [Group((role,), _changes(held[role])) for role in alone]
    return out + sorted(singles, key=lambda item: -len(item.at))


def forward(values: Floats, first: float) -> Floats:
    """Each value until the next one; `first` before there is any.

    Parameters
    ----------
    values : Floats
        NaN where there is none, shape (n,).
    first : float
        Value before the first one.

    Returns
    -------
    Floats
        Without NaN, shape (n,).
    """
    known = np.isfinite(values)
    index = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    return np.where(index >= 0, values[np.maximum(index, 0)], first)


def _scatter(values: Floats) -> float:
    """Width of a distribution but for its outermost hundredths."""
    low, high = np.quantile(values, [0.01, 0.99])
    return float(high - low)


def _counted(since: Floats) -> NDArray[np.int64]:
    """Ticks of changes that follow one another: each is of a tick of its own.

    A change comes up to a sampling interval late. The earliest of late tell how late the present
    ones are at least; a logger with another clock makes that wander.
    """
    tick = np.zeros(len(since), dtype=np.int64)
    recent: deque[float] = deque([0.0], RECENT)
    edge = 0.0
    for index in range(1, len(since)):
        at = float(since[index])
        tick[index] = max(int(tick[index - 1]) + 1, math.floor(at - edge + EARLY))
        gone = recent[0] if len(recent) == RECENT else math.inf
        recent.append(at - float(tick[index]))
        edge = min(recent) if gone <= edge else min(edge, recent[-1])
    return tick


def _beside(group: Group, lead: Group, tick: NDArray[np.int64]) -> NDArray[np.int64]:
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


def on_ticks(signal: Signal, clock: Clock, period: float, *, hold: bool) -> tuple[Floats, str]:
    """Values of a signal on each tick, and the rule by which they came.

    Parameters
    ----------
    signal : Signal
        As recorded.
    clock : Clock
        The ticks.
    period : float
        Length of a tick, s.
    hold : bool
        Take the value in the middle of a tick, not that at its end: of what the computer holds.

    Returns
    -------
    tuple[Floats, str]
        NaN where there is none, shape (ticks,); the rule in words, with its error.
    """
    step = interval(signal)
    if hold:
        instants = clock.begin[:-1] + 0.5 * period
        return _last_before(
            signal, instants, max(GAP * step, 1.5 * period)
        ), "the value in the middle of each tick"
    ends = clock.begin[1:]
    rate = period / step
    if rate < SPARSE:
        return _nearest(signal, ends, period), (
            "each sample at the nearest tick, off by up to half a tick"
        )
    if rate >= MANY:
        return _mean(signal, ends, WINDOW * period), (
            f"mean of the samples within {WINDOW * period * 1e3:.3g} ms of each tick's end"
        )
    return _line(signal, ends, GAP * step), "a straight line at each tick's end"


def bend(signal: Signal) -> float:
    """Most that a straight line between two samples is off, SI: an eighth of second differences.

    Parameters
    ----------
    signal : Signal
        As recorded.

    Returns
    -------
    float
        Of all but the largest 1 %, noise included.
    """
    second = np.abs(np.diff(signal.value, 2))
    return float(np.quantile(second, 0.99)) / 8.0 if len(second) else 0.0


def _last_before(signal: Signal, instants: Floats, most: float) -> Floats:
    index = np.searchsorted(signal.time, instants, side="right") - 1
    known = index >= 0
    index = np.maximum(index, 0)
    known &= instants - signal.time[index] <= most
    return np.where(known, signal.value[index], np.nan)


def _line(signal: Signal, instants: Floats, most: float) -> Floats:
    right = np.clip(np.searchsorted(signal.time, instants), 1, len(signal.time) - 1)
    gap = signal.time[right] - signal.time[right - 1]
    value = np.interp(instants, signal.time, signal.value)
    inside = (instants >= signal.time[0]) & (instants <= signal.time[-1])
    return np.where(inside & (gap <= most), value, np.nan)


def _mean(signal: Signal, instants: Floats, width: float) -> Floats:
    low = np.searchsorted(signal.time, instants - width)
    high = np.searchsorted(signal.time, instants + width, side="right")
    total = np.concatenate([[0.0], np.cumsum(signal.value - signal.value[0])])
    count = high - low
    mean = (total[high] - total[low]) / np.maximum(count, 1) + signal.value[0]
    return np.where(count > 0, mean, np.nan)


def _nearest(signal: Signal, instants: Floats, period: float) -> Floats:
    out = np.full(len(instants), np.nan)
    index = np.rint(np.interp(signal.time, instants, np.arange(len(instants)))).astype(np.int64)
    near = np.abs(instants[index] - signal.time) <= 0.5 * period
    out[index[near]] = signal.value[near]
    return out
