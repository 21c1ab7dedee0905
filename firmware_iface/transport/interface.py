"""What every bus, serial link and log implements to be a source, or a sink, of frames."""

from __future__ import annotations

import abc
import time
from enum import Enum
from types import TracebackType
from typing import Protocol, Self

from ehadiag.core.errors import BusLostError, ConfigurationError
from firmware_iface.transport.frames import Frame

__all__ = ["FrameSource", "Transport", "TransportState"]


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
        BusLostError
            The bus failed, now or before, or is closed.
        """
        self._check_usable()
        return self._receive(timeout)

    def send(self, frame: Frame) -> None:
        """Send one frame.

        Parameters
        ----------
        frame : Frame
            The frame to send.

        Raises
        ------
        ConfigurationError
            The transport was opened to listen only.
        BusLostError
            The bus failed, now or before, or did not take the frame.
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
