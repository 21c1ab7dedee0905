"""Broken sensors and wires: what each kind does to the four readings of a tick.

They strike before conversion, so that the control law works on what they leave of the jack
position. Each keeps its own past; a plant takes copies, so that every test begins afresh.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from ehadiag.core.channels import Channels

__all__ = [
    "Constant",
    "Drift",
    "Frozen",
    "Hum",
    "Late",
    "LooseContact",
    "Scaled",
    "Spikes",
    "Stepped",
    "Swapped",
]


@dataclass(slots=True)
class Constant:
    """A dead channel: reads the same share of its half range whatever happens."""

    channel: int
    share: float = 0.0

    def __call__(self, _tick: int, values: list[float], channels: Channels) -> None:
        """Overwrite the reading."""
        values[self.channel] = self.share * channels[self.channel].full_scale


@dataclass(slots=True)
class Scaled:
    """A reading times a factor; -1 is a reversed wire."""

    channel: int
    factor: float

    def __call__(self, _tick: int, values: list[float], _channels: Channels) -> None:
        """Scale the reading."""
        values[self.channel] *= self.factor


@dataclass(slots=True)
class Drift:
    """A reading that runs away, by so many half ranges a tick."""

    channel: int
    per_tick: float

    def __call__(self, tick: int, values: list[float], channels: Channels) -> None:
        """Add what has gathered."""
        values[self.channel] += self.per_tick * tick * channels[self.channel].full_scale


@dataclass(slots=True)
class Frozen:
    """A reading that stands still from a tick on."""

    channel: int
    since: int
    _held: float | None = None

    def __call__(self, tick: int, values: list[float], _channels: Channels) -> None:
        """Hold the reading."""
        if tick >= self.since:
            if self._held is None:
                self._held = values[self.channel]
            values[self.channel] = self._held


@dataclass(slots=True)
class Late:
    """A reading that comes some ticks late."""

    channel: int
    ticks: int
    _past: deque[float] = field(default_factory=deque)

    def __call__(self, _tick: int, values: list[float], _channels: Channels) -> None:
        """Give the old reading."""
        self._past.append(values[self.channel])
        values[self.channel] = self._past[0]
        if len(self._past) > self.ticks:
            self._past.popleft()


@dataclass(slots=True)
class Swapped:
    """Two wires exchanged: each converter gets the other's volts."""

    first: int
    second: int

    def __call__(self, _tick: int, values: list[float], channels: Channels) -> None:
        """Exchange the readings, each as a share of its half range."""
        ratio = channels[self.first].full_scale / channels[self.second].full_scale
        one, other = values[self.first], values[self.second]
        values[self.first], values[self.second] = other * ratio, one / ratio


@dataclass(slots=True)
class LooseContact:
    """A reading that drops to zero for some ticks, again and again."""

    channel: int
    every: int
    length: int
    since: int = 0

    def __call__(self, tick: int, values: list[float], _channels: Channels) -> None:
        """Drop the reading while the contact is open."""
        if (tick - self.since) % self.every < self.length and tick >= self.since:
            values[self.channel] = 0.0


@dataclass(slots=True)
class Stepped:
    """A converter that lost its low bits: steps of so many LSB."""

    channel: int
    codes: int

    def __call__(self, _tick: int, values: list[float], channels: Channels) -> None:
        """Round the reading."""
        step = self.codes * channels[self.channel].lsb
        values[self.channel] = step * round(values[self.channel] / step)


@dataclass(slots=True)
class Spikes:
    """Single readings off by so many half ranges, one every so many ticks, signs in turn."""

    channel: int
    every: int
    share: float

    def __call__(self, tick: int, values: list[float], channels: Channels) -> None:
        """Add a spike when its tick has come."""
        if tick % self.every == self.every - 1:
            sign = 1.0 if tick // self.every % 2 else -1.0
            values[self.channel] += sign * self.share * channels[self.channel].full_scale


@dataclass(slots=True)
class Hum:
    """A sine of the mains or the aircraft's supply on a reading; cycles a tick, half ranges."""

    channel: int
    per_tick: float
    share: float

    def __call__(self, tick: int, values: list[float], channels: Channels) -> None:
        """Add the sine."""
        sine = math.sin(2.0 * math.pi * self.per_tick * tick)
        values[self.channel] += self.share * channels[self.channel].full_scale * sine
