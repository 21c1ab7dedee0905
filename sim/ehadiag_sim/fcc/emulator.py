"""Runs the emulated computer on a bus, in real time or as fast as the bus takes its frames."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from ehadiag_sim.fcc.computer import FccCore
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.interface import Transport, TransportState

__all__ = ["EmulatorTransport", "run_emulator"]

LONGEST_WAIT = 0.05
"""s; how fast a stop is noticed."""
MOST_READ = 64
"""Frames read from the bus in one tick: a flooded bus must not stop the control law."""


def run_emulator(
    core: FccCore,
    transport: Transport,
    stop: threading.Event,
    *,
    real_time: bool = True,
    tell: Callable[[str], None] | None = None,
) -> int:
    """Run the computer on a bus until `stop` is set; return the number of ticks.

    `tell` hears once, the first time that the transport is degraded, what it says of itself.

    Ticks have absolute deadlines, so lateness is made up and the rate does not drift. With
    `real_time` false ticks follow at once and only the frames' time stamps tell the time.

    Parameters
    ----------
    core : FccCore
        The emulated computer.
    transport : Transport
        The bus to send and receive on.
    stop : threading.Event
        Set from outside to end the loop.
    real_time : bool
        Keep to the wall clock, or run as fast as the bus takes frames.
    tell : Callable[[str], None] | None
        Called once with what the transport says of itself when it is first degraded.

    Returns
    -------
    int
        Number of ticks run.

    Raises
    ------
    BusLostError
        The bus failed.
    """
    period = core.period_ns
    started = time.monotonic_ns()
    ticks = 0
    while not stop.is_set():
        if real_time:
            due = started + (ticks + 1) * period
            while (left := due - time.monotonic_ns()) > 0 and not stop.is_set():
                frame = transport.receive(min(left / 1e9, LONGEST_WAIT))
                if frame is not None:
                    core.take(frame)
        for _ in range(MOST_READ):
            frame = transport.receive(0.0)
            if frame is None:
                break
            core.take(frame)
        for frame in core.step():
            transport.send(frame)
        if tell is not None and transport.state is TransportState.DEGRADED:
            tell(transport.detail)
            tell = None
        ticks += 1
    return ticks


class EmulatorTransport(Transport):
    """The emulated computer itself as a transport, in simulated time and without threads.

    Reading advances the computer as far as the next frame needs; a time limit is simulated time.
    The same frames in the same order, whatever the host does.
    """

    def __init__(self, core: FccCore, *, transmit: bool = True) -> None:
        super().__init__("simulated flight-control computer", transmit=transmit)
        self._core = core
        self._frames: deque[Frame] = deque()
        self._now = core.now_ns

    @property
    def real_time(self) -> bool:
        """Nothing waits here."""
        return False

    def now_ns(self) -> int:
        """Simulated time, ns."""
        return self._now

    def stamp_ns(self) -> int:
        """Simulated time, ns."""
        return self._now

    def _receive(self, timeout: float) -> Frame | None:
        limit = self._now + round(timeout * 1e9)
        while not self._frames and self._core.now_ns < limit:
            self._frames.extend(self._core.step())
        if not self._frames:
            self._now = max(self._now, limit)
            return None
        frame = self._frames.popleft()
        self._now = max(self._now, frame.time_ns)
        return frame

    def _send(self, frame: Frame) -> None:
        self._core.take(frame)

    def _close(self) -> None:
        self._frames.clear()
