"""Watches channels while a test runs: that they stay within limits, and keep coming."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

from firmware_iface.codec.live_messages import Sample

__all__ = ["Limits", "Watch"]

UNITS = {"position": ("mm", 1e-3), "pressure": ("MPa", 1e6), "current": ("mA", 1e-3)}
"""Channels that can be watched, each with the unit that a message says it in."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Magnitudes that end the test when exceeded; None is not watched.

    A limit counts as exceeded after `samples` successive samples of its channel beyond it: the CRC
    keeps out corrupted ones, a spike of the converter is not yet a surface that runs away.
    """

    position: float | None = None
    """m."""
    pressure: float | None = None
    """Pa, differential."""
    current: float | None = None
    """A."""
    samples: int = 3

    def watched(self) -> Iterator[tuple[str, float]]:
        """Channels with a limit."""
        for name in UNITS:
            limit: float | None = getattr(self, name)
            if limit is not None:
                yield name, limit


@dataclass(slots=True)
class Watch:
    """Counts the samples of each watched channel; times in ns on one clock.

    A message counts for the channels that it brings: where each has a message of its own, those of
    the others neither add to its count nor end it. What is not a number is no sample.
    """

    limits: Limits
    silence: float
    """s without a sample of a watched channel that end the test."""
    _beyond: dict[str, int] = field(init=False, default_factory=dict)
    _heard: dict[str, int] = field(init=False, default_factory=dict)

    def begin(self, now: int) -> None:
        """Begin anew: the test runs from now on."""
        self._beyond = {name: 0 for name, _ in self.limits.watched()}
        self._heard = dict.fromkeys(self._beyond, now)

    def excuse(self, pause_ns: int) -> None:
        """Take out a time in which the reader itself did not run."""
        for name in self._heard:
            self._heard[name] += pause_ns

    def on_sample(self, now: int, sample: Sample) -> str:
        """Take a sample; return why the test must end, empty if it need not."""
        for name, limit in self.limits.watched():
            value: float = getattr(sample, name)
            if name not in sample.brought or math.isnan(value):
                continue
            self._heard[name] = now
            self._beyond[name] = self._beyond[name] + 1 if abs(value) > limit else 0
            if self._beyond[name] >= self.limits.samples:
                unit, size = UNITS[name]
                beyond = f"{name} {value / size:.4g} {unit} beyond its limit"
                return f"{beyond} ±{limit / size:.4g} {unit}"
        return ""

    def on_time(self, now: int) -> str:
        """Let time pass; return why the test must end, empty if it need not."""
        for name, heard in self._heard.items():
            if (now - heard) / 1e9 >= self.silence:
                return f"telemetry lost: no {name} for {self.silence:g} s, and its limit is watched"
        return ""
