"""A transport that damages the frames of another one as a faulty harness would."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from ehadiag.core.errors import BusLostError
from ehadiag_sim.faults.harness import Fault, Moment
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.interface import Transport

__all__ = ["FaultyTransport"]


class FaultyTransport(Transport):
    """A transport seen through a damaged harness; closes the inner one with itself."""

    def __init__(
        self,
        inner: Transport,
        received: Sequence[Fault] = (),
        *,
        sent: Sequence[Fault] = (),
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
        self, faults: Sequence[Fault], frame: Frame, rng: np.random.Generator
    ) -> list[Frame]:
        if self._first_ns is None:
            self._first_ns = frame.time_ns
        moment = Moment((frame.time_ns - self._first_ns) / 1e9, rng)
        frames = [frame]
        for fault in faults:
            try:
                frames = [out for item in frames for out in fault(item, moment)]
            except BusLostError as error:
                raise self._fail(str(error)) from None
        return frames

    def _close(self) -> None:
        self._inner.close()
