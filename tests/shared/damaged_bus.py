"""A bus with a damaged harness: kinds of damage, and a transport that applies them.

Each kind turns one frame into none, one or several; seeded, so that a run can be repeated. Those
that the simulator has too are in `ehadiag_sim.control`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from msgspec.structs import replace

from ehadiag_sim.control import COUNTER_BYTE_INDEX, FrameMoment, with_valid_crc
from firmware_iface.errors import BusLostError
from firmware_iface.transport.base import Transport
from firmware_iface.transport.frames import Frame

HarnessFault = Callable[[Frame, FrameMoment], Iterable[Frame]]


def loss_bursts(length: int, every: float) -> HarnessFault:
    """Runs of frames vanish: `length` of them, on average one run every `every` frames."""
    left = 0

    def damaged(frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        nonlocal left
        if left == 0 and at.rng.random() < 1.0 / every:
            left = length
        if left == 0:
            return (frame,)
        left -= 1
        return ()

    return damaged


def reordering(share: float, depth: int) -> HarnessFault:
    """Frames come after `depth` later ones, with the stamp of their late arrival."""
    held: deque[list[Frame]] = deque([[] for _ in range(depth)])

    def damaged(frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        is_held = at.rng.random() < share
        held.append([frame] if is_held else [])
        late = [replace(item, time_ns=frame.time_ns) for item in held.popleft()]
        return late if is_held else [frame, *late]

    return damaged


def wrong_length(share: float) -> HarnessFault:
    """Payloads lose their last byte."""
    return lambda frame, at: [
        replace(frame, data=frame.data[:-1]) if at.rng.random() < share else frame
    ]


def foreign_frames(per_frame: int) -> HarnessFault:
    """Frames of other devices, `per_frame` with each of ours; 11 and 29 bits, FD and remote."""

    def damaged(frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        for number in range(per_frame):
            extended = bool(at.rng.integers(2))
            # The same number as ours, but with 29 bits, is another identifier.
            can_id = frame.can_id if extended else 0x300 + int(at.rng.integers(0x400))
            payload = at.rng.bytes(64 if number % 8 == 7 else 8)
            yield Frame(frame.time_ns, can_id, payload, extended, fd=len(payload) > 8)
        yield frame

    return damaged


def noise_frames(per_frame: int) -> HarnessFault:
    """Random payloads under our own identifiers, `per_frame` with each of ours."""

    def damaged(frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        out = [replace(frame, data=at.rng.bytes(8)) for _ in range(per_frame)]
        # One in 256 would carry a valid check sum: no receiver can tell that from a good frame.
        return (*(item for item in out if with_valid_crc(item).data != item.data), frame)

    return damaged


def error_frames(share: float) -> HarnessFault:
    """The adapter reports errors on the wire."""

    def damaged(frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        if at.rng.random() < share:
            yield Frame(frame.time_ns, 0x008, bytes(8), error=True)
        yield frame

    return damaged


def stuck_counter(can_id: int, start: float, end: float = math.inf) -> HarnessFault:
    """The counter of one message stands still for a time, with valid check sums."""
    stuck: list[int] = []

    def damaged(frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        if frame.can_id != can_id or not start <= at.since < end:
            return (frame,)
        data = bytearray(frame.data)
        stuck.append(data[COUNTER_BYTE_INDEX])
        data[COUNTER_BYTE_INDEX] = stuck[0]
        return (with_valid_crc(replace(frame, data=bytes(data))),)

    return damaged


def clock_step(after: float, seconds: float) -> HarnessFault:
    """The clock that stamps the frames is set, after a time, by some seconds."""
    step = round(seconds * 1e9)
    return lambda frame, at: [replace(frame, time_ns=frame.time_ns + step * (at.since >= after))]


def stamp_jitter(most: float) -> HarnessFault:
    """Stamps are late by up to `most` s, each by its own amount."""
    return lambda frame, at: [
        replace(frame, time_ns=frame.time_ns + int(at.rng.random() * most * 1e9))
    ]


def bus_pause(begin: float, length: float, kept: bool = False) -> HarnessFault:
    """Nothing comes for a while; what was sent then is lost, or comes in one burst (`kept`)."""
    held: list[Frame] = []

    def damaged(frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        if begin <= at.since < begin + length:
            held.extend([frame] * kept)
            return ()
        late = [replace(item, time_ns=frame.time_ns) for item in held]
        held.clear()
        return (*late, frame)

    return damaged


def message_silence(can_id: int, start: float = 0.0) -> HarnessFault:
    """One message does not come, from a time on."""
    return lambda frame, at: () if frame.can_id == can_id and at.since >= start else (frame,)


def inserted_frames(after: float, frames: Sequence[Frame]) -> HarnessFault:
    """Certain frames appear once, after a time: a second tester, a stray answer."""
    left = list(frames)

    def damaged(frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        while left and at.since >= after:
            yield replace(left.pop(0), time_ns=frame.time_ns)
        yield frame

    return damaged


def bus_failure(after: float, why: str) -> HarnessFault:
    """The bus ends: adapter unplugged, bus off."""

    def damaged(frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        if at.since >= after:
            raise BusLostError(why)
        return (frame,)

    return damaged


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

    real_time = property(lambda self: self._inner.real_time)
    at_end = property(lambda self: self._inner.at_end and not self._ready)

    def now_ns(self) -> int:
        return self._inner.now_ns()

    def stamp_ns(self) -> int:
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
