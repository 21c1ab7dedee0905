"""What every bus, serial link and log implements to be a transport, and the receive thread.

The thread takes frames off a transport as they arrive, into a bounded queue.
"""

from __future__ import annotations

import abc
import queue
import threading
import time
from collections.abc import Callable
from enum import Enum
from typing import Protocol, Self

from firmware_iface.errors import BusLostError, ConfigurationError, EhadiagError
from firmware_iface.transport.frames import Frame


class TransportState(Enum):
    """How a source of frames is.

    OPEN: works, nothing was lost that it knows of.
    DEGRADED: works, but frames were lost or damaged on this side; `detail` says how many.
    FAILED: an error ended it; every further call raises that error.
    CLOSED: closed by its user.
    """

    OPEN = "open"
    DEGRADED = "degraded"
    FAILED = "failed"
    CLOSED = "closed"


class FrameSource(Protocol):
    """What a reader of frames needs; the receive thread gives it."""

    @property
    def name(self) -> str:
        """Bus or file, for messages to people."""

    @property
    def state(self) -> TransportState:
        """Present state."""

    @property
    def detail(self) -> str:
        """One sentence on a state that is not OPEN; empty otherwise."""

    @property
    def overflow(self) -> int:
        """Frames dropped because the reader was too slow."""

    @property
    def at_end(self) -> bool:
        """Whether no frame can come any more."""

    def receive(self, timeout: float) -> Frame | None:
        """Return the next frame, None when none came within `timeout` s."""

    def now_ns(self) -> int:
        """Present time for time limits, ns from any zero."""


class Transport(abc.ABC):
    """One bus, serial link or log, as a source of frames and, if asked, a sink.

    Obligations of every implementation:

    - It is open once constructed; the constructor raises ConfigurationError (an option is wrong,
      a driver is missing) or InputOutputError (the channel is absent or busy), in one line.
    - `receive(timeout)` waits at most `timeout` s (0: does not wait), returns frames in order of
      arrival, each once, foreign, error and remote frames among them. None means that no frame
      came, never that the bus ended. It is called by one thread at a time.
    - `Frame.time_ns` is an integer on one clock: host time, the adapter's, simulated time or the
      log's. Time limits go by `now_ns()`, which never steps: the monotonic clock of the host, or
      the simulated time where `real_time` is false and nothing waits.
    - Nothing is sent unless the transport was opened with `transmit=True`; an adapter that can be
      set to listen only is set so otherwise. `send` may be called from another thread than
      `receive`. Own frames do not come back through `receive`.
    - A bus that fails raises BusLostError from the call that meets the failure and from every call
      after it, and its state is FAILED. Damaged input that is skipped makes it DEGRADED.
    - `close()` may be called twice, from any state, and does not raise.
    """

    def __init__(self, name: str, *, transmit: bool) -> None:
        self._name = name
        self._transmit = transmit
        self._state = TransportState.OPEN
        self._detail = ""

    @property
    def name(self) -> str:
        """Bus or file, for messages to people."""
        return self._name

    @property
    def transmits(self) -> bool:
        """Whether the transport was opened to send as well."""
        return self._transmit

    @property
    def state(self) -> TransportState:
        """Present state."""
        return self._state

    @property
    def detail(self) -> str:
        """One sentence on a state that is not OPEN; empty otherwise."""
        return self._detail

    @property
    def at_end(self) -> bool:
        """Whether no frame can come any more: the end of a log, never true of a bus."""
        return False

    @property
    def real_time(self) -> bool:
        """Whether frames come when the bus brings them; false: as fast as they are read."""
        return True

    def now_ns(self) -> int:
        """Present time for time limits, ns from any zero."""
        return time.monotonic_ns()

    def stamp_ns(self) -> int:
        """Time stamp for a frame that is sent now, ns."""
        return time.time_ns() // 1000 * 1000

    def receive(self, timeout: float) -> Frame | None:
        """Return the next frame, None when none came within `timeout` s.

        BusLostError: the bus failed, now or before, or is closed.
        """
        self._check_usable()
        return self._receive(timeout)

    def send(self, frame: Frame) -> None:
        """Send one frame.

        frame: the frame to send. ConfigurationError: the transport was opened to listen only;
        BusLostError: the bus failed, now or before, or did not take the frame.
        """
        self._check_usable()
        if not self._transmit:
            raise ConfigurationError(f"{self.name}: opened to listen only, nothing is sent")
        self._send(frame)

    def close(self) -> None:
        """Free the bus; further calls do nothing."""
        if self._state is TransportState.CLOSED:
            return
        self._state = TransportState.CLOSED
        self._close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abc.abstractmethod
    def _receive(self, timeout: float) -> Frame | None: ...

    @abc.abstractmethod
    def _send(self, frame: Frame) -> None: ...

    @abc.abstractmethod
    def _close(self) -> None: ...

    def _degrade(self, detail: str) -> None:
        """Note damage that does not end the transport."""
        self._detail = detail
        if self._state is TransportState.OPEN:
            self._state = TransportState.DEGRADED

    def _fail(self, why: str) -> BusLostError:
        """Note the failure that ends the transport; returns the error to raise."""
        self._detail = why
        if self._state is not TransportState.CLOSED:
            self._state = TransportState.FAILED
        return BusLostError(f"{self.name}: {why}")

    def _check_usable(self) -> None:
        if self._state is TransportState.FAILED:
            raise BusLostError(f"{self.name}: {self._detail}")
        if self._state is TransportState.CLOSED:
            raise BusLostError(f"{self.name}: used after it was closed")


QUEUE_CAPACITY = 65_536
"""Frames; some seconds of a fully loaded 1 Mbit/s bus."""
RECEIVE_POLL_S = 0.05
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
        capacity: int = QUEUE_CAPACITY,
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
        """Return the next frame, None when none came within `timeout` s."""
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
                frame = self._transport.receive(RECEIVE_POLL_S)
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
