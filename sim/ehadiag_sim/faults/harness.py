"""Kinds of harness damage (loss, delay, bit flips, ...), each a rule for single frames.

Seeded, so that a run can be repeated. Each fault turns one frame into none, one or several.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from ehadiag.core.errors import BusLostError
from firmware_iface.codec.protection import crc8
from firmware_iface.transport.frames import Frame

__all__ = [
    "BitFlips",
    "Bursts",
    "ClockStep",
    "Duplicates",
    "ErrorFrames",
    "Failure",
    "Fault",
    "Foreign",
    "Inserted",
    "Jitter",
    "Loss",
    "Moment",
    "Noise",
    "Pause",
    "Reordering",
    "Silence",
    "StuckCounter",
    "WrongLength",
]

COUNTER_BYTE, CRC_BYTE = 6, 7


@dataclass(frozen=True, slots=True)
class Moment:
    """When a frame passes, s since the first one, and the chance that strikes it."""

    since: float
    rng: np.random.Generator


class Fault(Protocol):
    """One kind of damage."""

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Return what becomes of a frame."""


@dataclass(slots=True)
class Loss:
    """Single frames vanish; `only` names the identifier it strikes."""

    share: float
    only: int | None = None

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Drop a frame by chance."""
        hit = self.only in (None, frame.can_id) and at.rng.random() < self.share
        return () if hit else (frame,)


@dataclass(slots=True)
class Bursts:
    """Runs of frames vanish: `length` of them, on average one run every `every` frames."""

    length: int
    every: float
    _left: int = 0

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Drop the frames of a run."""
        if self._left == 0 and at.rng.random() < 1.0 / self.every:
            self._left = self.length
        if self._left == 0:
            return (frame,)
        self._left -= 1
        return ()


@dataclass(slots=True)
class Duplicates:
    """Frames come twice."""

    share: float

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Repeat a frame by chance."""
        return (frame, frame) if at.rng.random() < self.share else (frame,)


@dataclass(slots=True)
class Reordering:
    """Frames come after `depth` later ones, with the stamp of their late arrival."""

    share: float
    depth: int
    _held: deque[tuple[int, Frame]] = field(default_factory=deque)
    _count: int = 0

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Hold a frame back by chance; release those whose time has come."""
        self._count += 1
        out = [frame]
        if at.rng.random() < self.share:
            self._held.append((self._count + self.depth, frame))
            out = []
        while self._held and self._held[0][0] <= self._count:
            out.append(replace(self._held.popleft()[1], time_ns=frame.time_ns))
        return out


@dataclass(slots=True)
class BitFlips:
    """One bit of a payload changes; `mended` gives it a valid check sum again."""

    share: float
    mended: bool = False

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Flip a bit by chance."""
        if not frame.data or at.rng.random() >= self.share:
            return (frame,)
        bit = int(at.rng.integers(8 * (CRC_BYTE if self.mended else len(frame.data))))
        data = bytearray(frame.data)
        data[bit // 8] ^= 1 << bit % 8
        damaged = replace(frame, data=bytes(data))
        return (_mended(damaged) if self.mended else damaged,)


@dataclass(slots=True)
class WrongLength:
    """Payloads lose their last byte."""

    share: float

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Shorten a frame by chance."""
        return (replace(frame, data=frame.data[:-1]) if at.rng.random() < self.share else frame,)


@dataclass(slots=True)
class Foreign:
    """Frames of other devices, `per_frame` beside each of ours; 11 and 29 bits, FD and remote."""

    per_frame: int

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Add foreign frames before a frame."""
        out = []
        for number in range(self.per_frame):
            extended = bool(at.rng.integers(2))
            # The same number as ours, but with 29 bits, is another identifier.
            can_id = frame.can_id if extended else 0x300 + int(at.rng.integers(0x400))
            payload = at.rng.bytes(64 if number % 8 == 7 else 8)
            out.append(Frame(frame.time_ns, can_id, payload, extended, fd=len(payload) > 8))
        return (*out, frame)


@dataclass(slots=True)
class Noise:
    """Random payloads under our own identifiers, `per_frame` beside each of ours."""

    per_frame: int

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Add noise before a frame."""
        out = [replace(frame, data=at.rng.bytes(8)) for _ in range(self.per_frame)]
        # One in 256 would carry a valid check sum: no receiver can tell that from a good frame.
        return (*(item for item in out if _mended(item).data != item.data), frame)


@dataclass(slots=True)
class ErrorFrames:
    """The adapter reports errors on the wire."""

    share: float

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Add an error frame by chance."""
        if at.rng.random() >= self.share:
            return (frame,)
        return (Frame(frame.time_ns, 0x008, bytes(8), error=True), frame)


@dataclass(slots=True)
class StuckCounter:
    """The counter of one message stands still for a time, with valid check sums."""

    can_id: int
    start: float
    end: float = math.inf
    _value: int | None = None

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Write the old counter."""
        if frame.can_id != self.can_id or not self.start <= at.since < self.end:
            return (frame,)
        if self._value is None:
            self._value = frame.data[COUNTER_BYTE]
        data = bytearray(frame.data)
        data[COUNTER_BYTE] = self._value
        return (_mended(replace(frame, data=bytes(data))),)


@dataclass(slots=True)
class ClockStep:
    """The clock that stamps the frames is set, at a time, by some seconds."""

    at: float
    seconds: float

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Shift the stamp."""
        step = round(self.seconds * 1e9) if at.since >= self.at else 0
        return (replace(frame, time_ns=frame.time_ns + step),)


@dataclass(slots=True)
class Jitter:
    """Stamps are late by up to `most` s, each by its own amount."""

    most: float

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Delay the stamp."""
        return (replace(frame, time_ns=frame.time_ns + int(at.rng.random() * self.most * 1e9)),)


@dataclass(slots=True)
class Pause:
    """Nothing comes for a while; what was sent then is lost, or comes in one burst (`kept`)."""

    at: float
    length: float
    kept: bool = False
    _held: list[Frame] = field(default_factory=list)

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Hold or drop the frames of the pause."""
        if self.at <= at.since < self.at + self.length:
            if self.kept:
                self._held.append(frame)
            return ()
        late = [replace(item, time_ns=frame.time_ns) for item in self._held]
        self._held.clear()
        return (*late, frame)


@dataclass(slots=True)
class Silence:
    """One message does not come, from a time on."""

    can_id: int
    start: float = 0.0

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Drop the message."""
        return () if frame.can_id == self.can_id and at.since >= self.start else (frame,)


@dataclass(slots=True)
class Inserted:
    """Certain frames appear once, at a time: a second tester, a stray answer."""

    at: float
    frames: Sequence[Frame]
    _done: bool = False

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """Add the frames when their time has come."""
        if self._done or at.since < self.at:
            return (frame,)
        self._done = True
        return (*(replace(item, time_ns=frame.time_ns) for item in self.frames), frame)


@dataclass(slots=True)
class Failure:
    """The bus ends: adapter unplugged, bus off."""

    at: float
    why: str

    def __call__(self, frame: Frame, at: Moment) -> Iterable[Frame]:
        """End the bus when its time has come."""
        if at.since >= self.at:
            raise BusLostError(self.why)
        return (frame,)


def _mended(frame: Frame) -> Frame:
    """The frame with a valid check sum of the default bus."""
    header = struct.pack("<H", frame.can_id & 0xFFFF)
    body = frame.data[:CRC_BYTE]
    return replace(frame, data=body + bytes((crc8(header + body),)))
