"""A bus with a damaged harness: kinds of damage, and a transport that applies them.

Each kind (loss, delay, bit flips, ...) is a rule that turns one frame into none, one or several;
seeded, so that a run can be repeated.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from msgspec.structs import replace

from firmware_iface.errors import BusLostError
from firmware_iface.protection import crc8
from firmware_iface.transport.base import Transport
from firmware_iface.transport.frames import Frame

COUNTER_BYTE_INDEX, CRC_BYTE_INDEX = 6, 7


@dataclass(frozen=True, slots=True)
class FrameMoment:
    """When a frame passes, s since the first one, and the chance that strikes it."""

    since: float
    rng: np.random.Generator


class HarnessFault(Protocol):
    """One kind of damage."""

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Return what becomes of a frame."""


@dataclass(slots=True)
class FrameLoss:
    """Single frames vanish; `only` names the identifier it strikes."""

    share: float
    only: int | None = None

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Drop a frame by chance."""
        hit = self.only in (None, frame.can_id) and at.rng.random() < self.share
        return () if hit else (frame,)


@dataclass(slots=True)
class LossBursts:
    """Runs of frames vanish: `length` of them, on average one run every `every` frames."""

    length: int
    every: float
    _left: int = 0

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Drop the frames of a run."""
        if self._left == 0 and at.rng.random() < 1.0 / self.every:
            self._left = self.length
        if self._left == 0:
            return (frame,)
        self._left -= 1
        return ()


@dataclass(slots=True)
class DuplicateFrames:
    """Frames come twice."""

    share: float

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Repeat a frame by chance."""
        return (frame, frame) if at.rng.random() < self.share else (frame,)


@dataclass(slots=True)
class Reordering:
    """Frames come after `depth` later ones, with the stamp of their late arrival."""

    share: float
    depth: int
    _held: deque[tuple[int, Frame]] = field(default_factory=deque)
    _count: int = 0

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
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
    """One bit of a payload changes; `mended` gives it a valid check sum."""

    share: float
    mended: bool = False

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Flip a bit by chance."""
        if not frame.data or at.rng.random() >= self.share:
            return (frame,)
        bit = int(at.rng.integers(8 * (CRC_BYTE_INDEX if self.mended else len(frame.data))))
        data = bytearray(frame.data)
        data[bit // 8] ^= 1 << bit % 8
        damaged = replace(frame, data=bytes(data))
        return (_with_valid_crc(damaged) if self.mended else damaged,)


@dataclass(slots=True)
class SecondSender:
    """Another device sends the same messages, with counters of its own and valid check sums."""

    share: float

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Add its frame by chance."""
        if len(frame.data) <= CRC_BYTE_INDEX or at.rng.random() >= self.share:
            return (frame,)
        data = bytearray(frame.data)
        data[COUNTER_BYTE_INDEX] = (data[COUNTER_BYTE_INDEX] + 128) % 256
        return (frame, _with_valid_crc(replace(frame, data=bytes(data))))


@dataclass(slots=True)
class WrongLength:
    """Payloads lose their last byte."""

    share: float

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Shorten a frame by chance."""
        return (replace(frame, data=frame.data[:-1]) if at.rng.random() < self.share else frame,)


@dataclass(slots=True)
class ForeignFrames:
    """Frames of other devices, `per_frame` with each of ours; 11 and 29 bits, FD and remote."""

    per_frame: int

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
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
class NoiseFrames:
    """Random payloads under our own identifiers, `per_frame` with each of ours."""

    per_frame: int

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Add noise before a frame."""
        out = [replace(frame, data=at.rng.bytes(8)) for _ in range(self.per_frame)]
        # One in 256 would carry a valid check sum: no receiver can tell that from a good frame.
        return (*(item for item in out if _with_valid_crc(item).data != item.data), frame)


@dataclass(slots=True)
class ErrorFrames:
    """The adapter reports errors on the wire."""

    share: float

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
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

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Write the old counter."""
        if frame.can_id != self.can_id or not self.start <= at.since < self.end:
            return (frame,)
        if self._value is None:
            self._value = frame.data[COUNTER_BYTE_INDEX]
        data = bytearray(frame.data)
        data[COUNTER_BYTE_INDEX] = self._value
        return (_with_valid_crc(replace(frame, data=bytes(data))),)


@dataclass(slots=True)
class ClockStep:
    """The clock that stamps the frames is set, at a time, by some seconds."""

    at: float
    seconds: float

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Shift the stamp."""
        step = round(self.seconds * 1e9) if at.since >= self.at else 0
        return (replace(frame, time_ns=frame.time_ns + step),)


@dataclass(slots=True)
class StampJitter:
    """Stamps are late by up to `most` s, each by its own amount."""

    most: float

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Delay the stamp."""
        return (replace(frame, time_ns=frame.time_ns + int(at.rng.random() * self.most * 1e9)),)


@dataclass(slots=True)
class BusPause:
    """Nothing comes for a while; what was sent then is lost, or comes in one burst (`kept`)."""

    at: float
    length: float
    kept: bool = False
    _held: list[Frame] = field(default_factory=list)

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Hold or drop the frames of the pause."""
        if self.at <= at.since < self.at + self.length:
            if self.kept:
                self._held.append(frame)
            return ()
        late = [replace(item, time_ns=frame.time_ns) for item in self._held]
        self._held.clear()
        return (*late, frame)


@dataclass(slots=True)
class MessageSilence:
    """One message does not come, from a time on."""

    can_id: int
    start: float = 0.0

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Drop the message."""
        return () if frame.can_id == self.can_id and at.since >= self.start else (frame,)


@dataclass(slots=True)
class InsertedFrames:
    """Certain frames appear once, at a time: a second tester, a stray answer."""

    at: float
    frames: Sequence[Frame]
    _done: bool = False

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Add the frames when their time has come."""
        if self._done or at.since < self.at:
            return (frame,)
        self._done = True
        return (*(replace(item, time_ns=frame.time_ns) for item in self.frames), frame)


@dataclass(slots=True)
class BusFailure:
    """The bus ends: adapter unplugged, bus off."""

    at: float
    why: str

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """End the bus when its time has come."""
        if at.since >= self.at:
            raise BusLostError(self.why)
        return (frame,)


def _with_valid_crc(frame: Frame) -> Frame:
    """The frame with a valid check sum of the default bus."""
    header = struct.pack("<H", frame.can_id & 0xFFFF)
    body = frame.data[:CRC_BYTE_INDEX]
    return replace(frame, data=body + bytes((crc8(header + body),)))


class FaultyTransport(Transport):
    """A transport seen through a damaged harness; closes the inner one with itself."""

    def __init__(
        self,
        inner: Transport,
        received: Sequence[HarnessFault] = (),
        *,
        sent: Sequence[HarnessFault] = (),
        seed: int = 0,
    ) -> None:
        super().__init__(inner.name, transmit=inner.transmits)
        self._inner = inner
        self._received, self._sent = tuple(received), tuple(sent)
        streams = np.random.SeedSequence(seed).spawn(2)
        self._rng_received, self._rng_sent = (np.random.default_rng(item) for item in streams)
        self._ready: deque[Frame] = deque()
        self._first_ns: int | None = None

    @property
    def real_time(self) -> bool:
        """As the inner transport."""
        return self._inner.real_time

    @property
    def at_end(self) -> bool:
        """As the inner transport."""
        return self._inner.at_end and not self._ready

    def now_ns(self) -> int:
        """As the inner transport."""
        return self._inner.now_ns()

    def stamp_ns(self) -> int:
        """As the inner transport."""
        return self._inner.stamp_ns()

    def _receive(self, timeout: float) -> Frame | None:
        deadline = self._inner.now_ns() + round(timeout * 1e9)
        while not self._ready:
            left = max(0.0, (deadline - self._inner.now_ns()) / 1e9)
            frame = self._inner.receive(left)
            if frame is None:
                return None
            self._ready.extend(self._through(self._received, frame, self._rng_received))
            if left <= 0.0:
                break
        return self._ready.popleft() if self._ready else None

    def _send(self, frame: Frame) -> None:
        for item in self._through(self._sent, frame, self._rng_sent):
            self._inner.send(item)

    def _through(
        self, faults: Sequence[HarnessFault], frame: Frame, rng: np.random.Generator
    ) -> list[Frame]:
        if self._first_ns is None:
            self._first_ns = frame.time_ns
        moment = FrameMoment((frame.time_ns - self._first_ns) / 1e9, rng)
        frames = [frame]
        for fault in faults:
            try:
                frames = [out for item in frames for out in fault(item, moment)]
            except BusLostError as error:
                raise self._fail(str(error)) from None
        return frames

    def _close(self) -> None:
        self._inner.close()
