"""The receive thread: takes frames off a transport as they arrive, into a bounded queue."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Self

from ehadiag.core.errors import BusLostError, EhadiagError
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.interface import Transport, TransportState

__all__ = ["CAPACITY", "DirectReader", "Receiver", "open_source"]

CAPACITY = 65_536
"""Frames; some seconds of a fully loaded 1 Mbit/s bus."""
POLL = 0.05
"""s; how fast the thread notices that it shall stop."""


def open_source(
    transport: Transport,
    *,
    sink: Callable[[Frame], None] | None = None,
    idle: Callable[[], None] | None = None,
) -> Receiver | DirectReader:
    """Return the receive thread for a bus, a plain reader for what does not run in real time."""
    if transport.real_time:
        return Receiver(transport, sink=sink, idle=idle)
    return DirectReader(transport, sink=sink)


class Receiver:
    """Owns the thread that reads one transport.

    `sink` sees each frame in the thread, before it is queued: the recorder, so that frames are on
    disk before anything decodes them and whatever the reader does. `idle` is called when the bus is
    silent. Any exception in the thread, theirs included, ends it and reaches the reader from
    `receive` as an error; frames that came before are handed out first. A full queue drops the
    newest frame, counts it and makes the state DEGRADED.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        sink: Callable[[Frame], None] | None = None,
        idle: Callable[[], None] | None = None,
        capacity: int = CAPACITY,
    ) -> None:
        self._transport = transport
        self._sink = sink
        self._idle = idle
        self._queue: queue.Queue[Frame | None] = queue.Queue(capacity)
        self._overflow = 0
        self._error: EhadiagError | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._run, name=f"receive {transport.name}", daemon=True
        )

    def start(self) -> Self:
        """Start the thread."""
        self._thread.start()
        return self

    def stop(self) -> None:
        """End the thread and wait for it; may be called twice. The transport stays open."""
        self._stop.set()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def name(self) -> str:
        """Name of the transport."""
        return self._transport.name

    @property
    def overflow(self) -> int:
        """Frames dropped because the reader was too slow (the sink has seen them)."""
        return self._overflow

    @property
    def waiting(self) -> int:
        """Frames in the queue."""
        return self._queue.qsize()

    @property
    def state(self) -> TransportState:
        """State of transport and queue together."""
        if self._error is not None:
            return TransportState.FAILED
        if self._stop.is_set():
            return TransportState.CLOSED
        if self._overflow and self._transport.state is TransportState.OPEN:
            return TransportState.DEGRADED
        return self._transport.state

    @property
    def detail(self) -> str:
        """One sentence on a state that is not OPEN; empty otherwise."""
        if self._error is not None:
            return str(self._error)
        parts = [self._transport.detail] if self._transport.detail else []
        if self._overflow:
            parts.append(f"{self._overflow} frames dropped, the reader was too slow")
        return "; ".join(parts)

    @property
    def at_end(self) -> bool:
        """Whether no frame can come any more: the end of a log."""
        return self._transport.at_end and self._queue.empty()

    def now_ns(self) -> int:
        """Present time for time limits, ns from any zero."""
        return self._transport.now_ns()

    def receive(self, timeout: float) -> Frame | None:
        """Return the next frame, None when none came within `timeout` s.

        Parameters
        ----------
        timeout : float
            Longest wait, s.

        Returns
        -------
        Frame | None
            The next frame; None if there was none in time.

        Raises
        ------
        BusLostError or another EhadiagError: what ended the thread, once the queue is empty.
        """
        try:
            frame = self._queue.get_nowait() if timeout <= 0 else self._queue.get(timeout=timeout)
        except queue.Empty:
            frame = None
        if frame is None and self._queue.empty() and self._error is not None:
            raise self._error
        return frame

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                frame = self._transport.receive(POLL)
                if frame is not None:
                    self._take(frame)
                elif self._idle is not None:
                    self._idle()
                if frame is None and self._transport.at_end:
                    return
        except EhadiagError as error:
            self._error = error
        except Exception as error:
            # Whatever it was, the reader must hear of it: a thread that dies silently looks like
            # a silent bus.
            text = " ".join(str(error).split())
            self._error = BusLostError(
                f"{self.name}: receive thread failed: {type(error).__name__}: {text}"
            )
        finally:
            self._wake()

    def _take(self, frame: Frame) -> None:
        if self._sink is not None:
            self._sink(frame)
        try:
            self._queue.put_nowait(frame)
        except queue.Full:
            self._overflow += 1

    def _wake(self) -> None:
        """Let a waiting reader look at the error now."""
        try:
            self._queue.put_nowait(None)
        except queue.Full:
            return


class DirectReader:
    """The receive thread's face without a thread: for simulated time, which waits for its reader.

    A thread would only fill the queue faster than it can be emptied.
    """

    overflow = 0

    def __init__(
        self, transport: Transport, *, sink: Callable[[Frame], None] | None = None
    ) -> None:
        self._transport = transport
        self._sink = sink

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return

    @property
    def name(self) -> str:
        """Name of the transport."""
        return self._transport.name

    @property
    def state(self) -> TransportState:
        """State of the transport."""
        return self._transport.state

    @property
    def detail(self) -> str:
        """One sentence on a state that is not OPEN; empty otherwise."""
        return self._transport.detail

    @property
    def at_end(self) -> bool:
        """Whether no frame can come any more."""
        return self._transport.at_end

    def now_ns(self) -> int:
        """Present time for time limits, ns from any zero."""
        return self._transport.now_ns()

    def receive(self, timeout: float) -> Frame | None:
        """Return the next frame, None when none came within `timeout` s."""
        frame = self._transport.receive(timeout)
        if frame is not None and self._sink is not None:
            self._sink(frame)
        return frame
