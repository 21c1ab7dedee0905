"""Makes every python-can interface a transport."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, Self

import msgspec

from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import MAX_CAN_ID, MAX_STANDARD_CAN_ID
from firmware_iface.transport.adapters import BusOptions, one_line, open_bus
from firmware_iface.transport.base import Transport
from firmware_iface.transport.frames import MAX_CHANNEL, Frame

if TYPE_CHECKING:
    import can

SO_MEMINFO = 55
"""Linux: counts of a socket (linux/sock_diag.h); Python's socket module does not name it."""
MEMINFO_DROPS = 8
"""Place of the number of dropped frames among them."""


class BusTimes(msgspec.Struct, frozen=True):
    """Times of a bus that takes no frames, s."""

    send: float = 0.5
    """Without room for so long nobody listens: frames are dropped."""
    retry: float = 0.1
    """Between two tries of such a bus."""
    retry_timeout: float = 0.02
    """Longest wait of each try."""
    pause: float = 0.001
    """Until a full queue is tried again."""


BUS_TIMES = BusTimes()
FULL_BUFFER_TEXT = "Transmit buffer full"
"""What python-can says of a socket that took no frame in time."""
BUS_OFF_ERROR = 0x40
"""Bit of SocketCAN's error class (linux/can/error.h, CAN_ERR_BUSOFF)."""
SOCKETCAN_ERROR_INTERFACES = ("socketcan", "virtual", "udp_multicast")
"""Interfaces whose error frames carry SocketCAN's error class as identifier."""
ECHOING_INTERFACES = ("udp_multicast",)
"""Interfaces that hand a sender its own frames, unmarked."""
BAD_DATAGRAM_TEXT = "could not unpack received message"
"""What python-can says of a datagram that is none of its own."""


class PythonCanTransport(Transport):
    """One python-can bus; see `Transport` for what it promises.

    A bus on which nobody listens fills up: frames that find no room are dropped and counted
    (DEGRADED), and sending goes on when there is room again.

    options: which bus, and how to open it; transmit: whether the bus may be sent to; otherwise it
    is opened listen-only where the adapter can be; bus: open bus, which the caller closes; None: it
    is opened and closed here. ConfigurationError, InputOutputError: see `open_bus`.
    """

    def __init__(
        self, options: BusOptions, *, transmit: bool = False, bus: can.BusABC | None = None
    ) -> None:
        name = f"{options.interface} {options.channel or ''}".strip()
        super().__init__(name, transmit=transmit)
        self._options = options
        self._bus = open_bus(options, transmit=transmit) if bus is None else bus
        _widen_buffer(self._bus)
        self._line = None
        if options.interface == "slcan":
            self._line = _descriptor(self._bus)
            self._flush()  # opening takes seconds, and what came meanwhile is old
        self._bus_closed = bus is not None
        self._damaged = 0
        self._echoes = _EchoFilter() if options.interface in ECHOING_INTERFACES else None
        self._received = 0
        self._dropped = 0
        self._unsent = 0
        self._next_try = 0.0
        self._channels: dict[str, int] = {}

    @classmethod
    def of_bus(cls, bus: can.BusABC, *, transmit: bool = False) -> Self:
        """Return the transport of a bus that the caller has opened, and closes.

        bus: the open bus; nobody else, such as a `can.Notifier`, may read it meanwhile; transmit:
        whether the bus may be sent to. Returns the transport; closing it leaves the bus open.
        ConfigurationError: the bus hands its own frames back, which look like another tester's.
        """
        interface = type(bus).__module__.removeprefix("can.interfaces.").partition(".")[0]
        name = str(bus.channel_info or interface)
        if getattr(bus, "receive_own_messages", False):
            raise ConfigurationError(
                f"{name}: open it without receive_own_messages: own requests would look like"
                " another tester's"
            )
        transport = cls(BusOptions(interface), transmit=transmit, bus=bus)
        transport._name = name
        return transport

    @property
    def unsent(self) -> int:
        """Frames dropped for want of room; one of each stall may have gone out all the same."""
        return self._unsent

    @property
    def dropped(self) -> int | None:
        """Frames that the kernel dropped because its buffer was full; None if it cannot say."""
        return _kernel_drops(self._bus)

    def _receive(self, timeout: float) -> Frame | None:
        frame = self._next(timeout)
        while frame is not None and self._echoes is not None and self._echoes.is_own(frame):
            # Nothing of others' may wait behind own frames: a reader takes None for an empty bus.
            frame = self._next(0.0)
        return frame

    def _next(self, timeout: float) -> Frame | None:
        try:
            message = self._read(timeout)
        except Exception as error:
            if self._is_damage(error):
                self._damaged += 1
                self._report_losses()
                return None
            # Drivers raise what they like; all of it means that this bus gives no more frames.
            raise self._fail(one_line(error)) from None
        self._received += 1
        # A look now and then while the bus is busy.
        if message is None or self._received % 1024 == 0:
            self._look_for_drops()
        if message is None:
            return None
        frame = frame_of(message, self._channel(message.channel))
        of_kernel = self._options.interface in SOCKETCAN_ERROR_INTERFACES
        if frame.error and frame.can_id & BUS_OFF_ERROR and of_kernel:
            raise self._fail("bus off; check wiring and bit rate, then restart the interface")
        return frame

    def _channel(self, stated: object) -> int:
        """Number of a frame's adapter channel: the driver's, or by name in order of appearance.

        0 where the bus was opened on the one channel that it was named by.
        """
        if self._options.interface in ECHOING_INTERFACES:  # there the sender says what it likes
            return 0
        if isinstance(stated, int):
            several = "," in str(self._options.channel or "")
            return min(max(stated + 1, 0), MAX_CHANNEL) if several else 0
        if not stated or self._options.channel != "":
            return 0
        return self._channels.setdefault(str(stated), len(self._channels) % MAX_CHANNEL + 1)

    def _read(self, timeout: float) -> can.Message | None:
        """Read from python-can; its SLCAN waits a millisecond also where it shall not wait."""
        if self._line is None:
            return self._bus.recv(timeout)
        deadline = time.monotonic() + timeout
        while True:
            left = deadline - time.monotonic()
            if not select.select([self._line], [], [], max(left, 0.0))[0]:
                return None
            message = self._bus.recv(0.0)
            if message is not None or left <= 0.0:
                return message

    def _is_damage(self, error: Exception) -> bool:
        """Whether an error tells of something on the line that was no frame, not of its end."""
        if str(error) == BAD_DATAGRAM_TEXT:
            return True
        if self._options.interface != "slcan":
            return False
        if isinstance(error.__cause__, UnicodeDecodeError):
            self._flush()  # python-can would stumble over the same bytes for ever
            return True
        return isinstance(error, ValueError | IndexError | KeyError)

    def _flush(self) -> None:
        """Forget what waits in python-can's SLCAN and in the port."""
        with contextlib.suppress(Exception):
            getattr(self._bus, "flush", list)()

    def _send(self, frame: Frame) -> None:
        if self._echoes is not None:
            self._echoes.sent(frame)
        if self._next_try and time.monotonic() < self._next_try:
            taken = False
        else:
            taken = self._deliver(
                message_of(frame), BUS_TIMES.retry_timeout if self._next_try else BUS_TIMES.send
            )
            self._next_try = 0.0 if taken else time.monotonic() + BUS_TIMES.retry
        if not taken:
            self._unsent += 1
            self._report_losses()

    def _deliver(self, message: can.Message, patience: float) -> bool:
        """Hand a message to the bus; False where it had no room for so long."""
        deadline = time.monotonic() + patience
        while True:
            try:
                self._bus.send(message, timeout=patience)
            except Exception as error:
                if _timed_out(error):
                    return False
                if getattr(error, "error_code", None) != errno.ENOBUFS:
                    raise self._fail(f"cannot send: {one_line(error)}") from None
            else:
                return True
            if time.monotonic() >= deadline:
                return False
            time.sleep(BUS_TIMES.pause)

    def _look_for_drops(self) -> None:
        """Say it when frames were lost between kernel and reader: no error tells of it."""
        dropped = self.dropped or 0
        if dropped > self._dropped:
            self._dropped = dropped
            self._report_losses()

    def _report_losses(self) -> None:
        counts = (
            (self._damaged, "messages on the line were no CAN frames"),
            (self._dropped, "frames dropped by the kernel, the reader was too slow"),
            (self._unsent, "frames not sent, nobody took them off the bus"),
        )
        self._degrade("; ".join(f"{count} {what}" for count, what in counts if count))

    def _close(self) -> None:
        if not self._bus_closed:
            self._bus_closed = True
            with contextlib.suppress(Exception):
                self._bus.shutdown()


class _EchoFilter:
    """Knows own frames when they come back: each once and in the order sent."""

    def __init__(self) -> None:
        self._expected: deque[tuple[int, bytes]] = deque(maxlen=4096)
        self._lock = threading.Lock()  # one thread sends, another receives

    def sent(self, frame: Frame) -> None:
        """Expect this frame back."""
        with self._lock:
            self._expected.append((frame.can_id, frame.data))

    def is_own(self, frame: Frame) -> bool:
        """Whether a received frame is an own one; those before it were lost on the way back."""
        key = (frame.can_id, frame.data)
        with self._lock:
            if key not in self._expected:
                return False
            while self._expected.popleft() != key:
                pass
            return True


def frame_of(message: can.Message, channel: int = 0) -> Frame:
    """Turn a python-can message into a frame.

    Times are rounded to whole microseconds: python-can's float seconds carry no more, and only so
    a recorded frame reads back with the very stamp it had on the bus. Its mark for sent frames is
    left out: SocketCAN sets it on the frames of every program of this machine.
    """
    limit = MAX_CAN_ID if message.is_extended_id else MAX_STANDARD_CAN_ID
    return Frame(
        time_ns=round(message.timestamp * 1e6) * 1000,
        can_id=message.arbitration_id & (MAX_CAN_ID if message.is_error_frame else limit),
        data=b"" if message.is_remote_frame else bytes(message.data),
        extended=message.is_extended_id,
        fd=message.is_fd,
        error=message.is_error_frame,
        remote=message.is_remote_frame,
        channel=channel,
    )


def message_of(frame: Frame) -> can.Message:
    """Turn a frame into a python-can message, without its channel: a bus has one."""
    import can  # noqa: PLC0415 - costs half a second

    return can.Message(
        timestamp=frame.time_ns * 1e-9,
        arbitration_id=frame.can_id,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        is_error_frame=frame.error,
        is_fd=frame.fd,
        is_rx=not frame.sent,
        data=frame.data,
    )


def _timed_out(error: Exception) -> bool:
    """Whether python-can, or pyserial below it, found no room in time."""
    kinds = {type(item).__name__ for item in (error, error.__cause__)}
    return (
        bool(kinds & {"CanTimeoutError", "SerialTimeoutException"})
        or str(error) == FULL_BUFFER_TEXT
    )


def _descriptor(bus: can.BusABC) -> int | None:
    """What can be waited for; None on systems, or behind ports, that have no such thing."""
    if os.name != "posix":
        return None
    try:
        return bus.fileno()
    except Exception:
        return None


@contextlib.contextmanager
def _socket_of(bus: can.BusABC) -> Iterator[socket.socket]:
    """The socket behind an interface, until the block ends.

    NotImplementedError, OSError, AttributeError, TypeError: there is none.
    """
    descriptor = os.dup(bus.fileno())
    try:
        duplicate = socket.socket(fileno=descriptor)
    except OSError:  # a serial port
        os.close(descriptor)
        raise
    with duplicate:
        yield duplicate


def _widen_buffer(bus: can.BusABC) -> None:
    """Ask the kernel for room, so that a reader that waits for a processor loses no frame."""
    absent = contextlib.suppress(NotImplementedError, OSError, AttributeError, TypeError)
    with absent, _socket_of(bus) as duplicate:
        # A second of a full bus and more.
        duplicate.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)


def _kernel_drops(bus: can.BusABC) -> int | None:
    """Frames that found no room in the socket's buffer; None where that cannot be told."""
    try:
        with _socket_of(bus) as duplicate:
            info = duplicate.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 4 * (MEMINFO_DROPS + 1))
    except (NotImplementedError, OSError, AttributeError, TypeError):
        return None
    words = memoryview(info).cast("I")
    return words[MEMINFO_DROPS] if len(words) > MEMINFO_DROPS else None
