"""Hands the frames of one bus to several listeners, each of which reads as if it were alone."""

from __future__ import annotations

import queue
import threading
from typing import Self

from ehadiag.core.errors import BusLostError, EhadiagError
from firmware_iface.logs.recorder import Recorder
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.interface import Transport
from firmware_iface.transport.receiver import CAPACITY

__all__ = ["SharedBus"]

POLL = 0.05
"""s; how fast the thread notices that it shall stop."""


class SharedBus:
    """Reads a bus in a thread of its own, records each frame once, and passes it to all branches.

    Nothing is sent. A bus or a recording that fails ends every branch with the error. While the
    context is open the branches may be read, each by one thread.

    Parameters
    ----------
    transport : Transport
        Open; to be closed by the caller.
    branches : int
        Number of listeners.
    recorder : Recorder
        Gets each frame before any listener; closed at the end of the context.
    """

    def __init__(self, transport: Transport, branches: int, recorder: Recorder) -> None:
        self._transport = transport
        self._recorder = recorder
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._run, name=f"share {transport.name}", daemon=True
        )
        self.branches: tuple[Transport, ...] = tuple(_Branch(transport) for _ in range(branches))
        """What the listeners read."""

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._recorder.close()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                frame = self._transport.receive(POLL)
                if frame is None:
                    self._recorder.idle()
                    continue
                self._recorder.write(frame)
                self._hand_on(frame)
        except EhadiagError as error:
            self._hand_on(error)

    def _hand_on(self, item: Frame | EhadiagError) -> None:
        for branch in self.branches:
            assert isinstance(branch, _Branch)
            branch.take(item)


class _Branch(Transport):
    """One listener's view of a bus; too slow a one loses the newest frames, and says so."""

    def __init__(self, transport: Transport) -> None:
        super().__init__(transport.name, transmit=False)
        self._frames: queue.Queue[Frame] = queue.Queue(CAPACITY)
        self._lost = 0
        self._error: EhadiagError | None = None

    def take(self, item: Frame | EhadiagError) -> None:
        """Queue a frame, or the error that ends the bus; in the thread that reads it."""
        if isinstance(item, EhadiagError):
            self._error = item
            return
        try:
            self._frames.put_nowait(item)
        except queue.Full:
            self._lost += 1

    def _receive(self, timeout: float) -> Frame | None:
        if self._lost:
            self._degrade(f"{self._lost} frames came faster than they were read")
        try:
            return self._frames.get(timeout > 0.0, timeout or None)
        except queue.Empty:
            if isinstance(self._error, BusLostError):
                raise self._fail(str(self._error).removeprefix(f"{self.name}: ")) from None
            if self._error is not None:
                raise self._error from None
            return None

    def _send(self, frame: Frame) -> None:
        raise AssertionError(f"a branch sends nothing, {frame} neither")

    def _close(self) -> None:
        """The bus is the caller's."""
