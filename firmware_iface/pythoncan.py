"""Every python-can interface, by its name, as a transport."""

from __future__ import annotations

import contextlib
import importlib
import ipaddress
import os
import socket
import sys
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehadiag.errors import ConfigurationError, EhadiagError, InputOutputError
from firmware_iface.frames import Frame
from firmware_iface.transport import Transport

if TYPE_CHECKING:
    import can

__all__ = ["BusOptions", "PythonCanTransport", "frame_of", "message_of"]

MULTICAST_GROUP = "239.74.163.2"
"""Default channel of udp_multicast; python-can's own is IPv6 and needs a route few hosts have."""
ROUTES = Path("/proc/net/route")
RECEIVE_BUFFER = 4 << 20
"""Bytes asked of the kernel for a socket's receive buffer: a second of a full bus and more."""
SO_MEMINFO = 55
"""Linux: counts of a socket (linux/sock_diag.h); Python's socket module does not name it."""
MEMINFO_DROPS = 8
"""Place of the number of dropped frames among them."""
DROP_CHECK = 1024
"""Calls between two looks at that number while the bus is busy."""
SEND_TIMEOUT = 0.5
"""s; a bus that takes no frame for so long is lost."""
BUS_OFF = 0x40
"""Bit of SocketCAN's error class (linux/can/error.h, CAN_ERR_BUSOFF)."""
LISTEN_ONLY: Mapping[str, Mapping[str, Any]] = {
    "slcan": {"listen_only": True},
    "vector": {"listen_only": True},
    "nixnet": {"listen_only": True},
    "kvaser": {"driver_mode": False},
}
"""Options that silence an adapter. PCAN and Systec take a bus state instead."""
OWN_OPTIONS = frozenset(("interface", "channel", "bitrate", "data_bitrate", "fd", "app_name"))
"""Options that may not hide among the further arguments: what is checked must be what is opened."""
PASSIVE_STATE = ("pcan", "systec")
SOCKETCAN_ERRORS = ("socketcan", "virtual", "udp_multicast")
"""Interfaces whose error frames carry SocketCAN's error class as identifier."""
ECHOES = ("udp_multicast",)
"""Interfaces that hand a sender its own frames, unmarked."""
NOT_A_FRAME = "could not unpack received message"
"""What python-can says of a datagram that is none of its own."""


@dataclass(frozen=True, slots=True)
class BusOptions:
    """Options of a bus, named as python-can names them; None leaves its default.

    Attributes
    ----------
    interface: socketcan, virtual, udp_multicast, slcan, pcan, kvaser, vector, ixxat, …
    channel: as the interface understands it.
    bitrate, data_bitrate: bit/s.
    fd: accept CAN FD frames.
    app_name: Vector's application name.
    extra: further keyword arguments of the interface (python-can's `--bus-kwargs`).
    allow_multicast: let udp_multicast join a group beyond the loopback interface.
    """

    interface: str
    channel: str | None = None
    bitrate: int | None = None
    data_bitrate: int | None = None
    fd: bool = False
    app_name: str | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)
    allow_multicast: bool = False


class PythonCanTransport(Transport):
    """One python-can bus; see `Transport` for what it promises.

    Raises
    ------
    ConfigurationError: unknown interface, missing driver or module, a wrong option, multicast that
        would leave the machine without leave.
    InputOutputError: the channel is absent, busy or refused.
    """

    def __init__(self, options: BusOptions, *, transmit: bool = False) -> None:
        name = f"{options.interface} {options.channel or ''}".strip()
        super().__init__(name, transmit=transmit)
        self._options = options
        self._bus = _open(options, name, transmit)
        self._bus_closed = False
        self._damaged = 0
        self._echoes = _EchoFilter() if options.interface in ECHOES else None
        self._received = 0
        self._dropped = 0

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
            message = self._bus.recv(timeout)
        except Exception as error:
            if str(error) == NOT_A_FRAME:
                self._damaged += 1
                self._degrade(f"{self._damaged} datagrams on the group were no CAN frames")
                return None
            # Drivers raise what they like; all of it means that this bus gives no more frames.
            raise self._fail(_one_line(error)) from None
        self._received += 1
        if message is None or self._received % DROP_CHECK == 0:
            self._look_for_drops()
        if message is None:
            return None
        frame = frame_of(message)
        of_kernel = self._options.interface in SOCKETCAN_ERRORS
        if frame.error and frame.can_id & BUS_OFF and of_kernel:
            raise self._fail("bus off; check wiring and bit rate, then restart the interface")
        return frame

    def _send(self, frame: Frame) -> None:
        if self._echoes is not None:
            self._echoes.sent(frame)
        try:
            self._bus.send(message_of(frame), timeout=SEND_TIMEOUT)
        except Exception as error:
            raise self._fail(f"cannot send: {_one_line(error)}") from None

    def _look_for_drops(self) -> None:
        """Say it when frames were lost between kernel and reader: no error tells of it."""
        dropped = self.dropped or 0
        if dropped > self._dropped:
            self._dropped = dropped
            self._degrade(f"{dropped} frames dropped by the kernel, the reader was too slow")

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


def frame_of(message: can.Message) -> Frame:
    """Turn a python-can message into a frame.

    Times are rounded to whole microseconds: python-can's float seconds carry no more, and only so
    a recorded frame reads back with the very stamp it had on the bus. Its mark for sent frames is
    left out: SocketCAN sets it on the frames of every program of this machine.
    """
    limit = 0x1FFFFFFF if message.is_extended_id else 0x7FF
    return Frame(
        time_ns=round(message.timestamp * 1e6) * 1000,
        can_id=message.arbitration_id & (0x1FFFFFFF if message.is_error_frame else limit),
        data=b"" if message.is_remote_frame else bytes(message.data),
        extended=message.is_extended_id,
        fd=message.is_fd,
        error=message.is_error_frame,
        remote=message.is_remote_frame,
    )


def message_of(frame: Frame) -> can.Message:
    """Turn a frame into a python-can message."""
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


def _open(options: BusOptions, name: str, transmit: bool) -> can.BusABC:
    import can  # noqa: PLC0415 - costs half a second

    arguments = _arguments(options, transmit)
    if options.interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise ConfigurationError(f"interface {options.interface!r} unknown, need one of {known}")
    try:
        bus = can.Bus(**arguments)
    except EhadiagError:
        raise
    except (can.CanInterfaceNotImplementedError, ImportError, NameError) as error:
        raise ConfigurationError(
            f"{name}: driver or Python module of the interface is missing: {_one_line(error)}"
        ) from None
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigurationError(f"{name}: wrong option: {_one_line(error)}") from None
    except (can.CanError, OSError) as error:
        raise InputOutputError(
            f"{name}: cannot open: {_one_line(error)}; is its driver installed, the adapter "
            "plugged in, the channel up and not in use?"
        ) from None
    except Exception as error:
        raise InputOutputError(f"{name}: cannot open: {_one_line(error)}") from None
    _widen_buffer(bus)
    return bus


def _arguments(options: BusOptions, transmit: bool) -> dict[str, Any]:
    if options.extra.get("receive_own_messages"):
        raise ConfigurationError(
            f"{options.interface}: receive_own_messages is not supported: own requests are "
            "recorded as they are sent, and an echo would look like another tester's"
        )
    for key in OWN_OPTIONS & options.extra.keys():
        raise ConfigurationError(f"{options.interface}: give {key} as an option of its own")
    arguments: dict[str, Any] = dict(options.extra)
    arguments |= {"interface": options.interface, "ignore_config": True}
    for key in ("channel", "bitrate", "data_bitrate", "app_name"):
        value = getattr(options, key)
        if value is not None:
            arguments[key] = value
    if options.fd:
        arguments["fd"] = True
    if options.interface == "udp_multicast":
        arguments |= _multicast(options)
    if not transmit:
        arguments |= LISTEN_ONLY.get(options.interface, {})
        if options.interface in PASSIVE_STATE:
            arguments["state"] = importlib.import_module("can").BusState.PASSIVE
    return arguments


def _multicast(options: BusOptions) -> dict[str, Any]:
    """Keep the group on this machine unless the user lets it out.

    Without leave the kernel's own route must be the loopback interface: a hop limit of zero alone
    keeps frames in, but the group's membership report goes out and foreign frames come in.
    """
    group = options.channel or MULTICAST_GROUP
    if options.allow_multicast:
        return {"channel": group}
    try:
        address = ipaddress.ip_address(group)
    except ValueError:
        raise ConfigurationError(
            f"udp_multicast {group}: not an IP address; need a group such as {MULTICAST_GROUP}"
        ) from None
    interface = _route(address)
    if interface != "lo":
        where = f"leave the machine through {interface}" if interface else "find no loopback route"
        raise ConfigurationError(
            f"udp_multicast {group}: would {where}; run inside tools/loopnet.sh, or allow it "
            "with --allow-multicast"
        )
    return {"channel": group, "hop_limit": 0}


def _route(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> str | None:
    """Interface that the kernel sends to an IPv4 address through; None where it cannot be told."""
    try:
        lines = ROUTES.read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return None
    found: tuple[int, str] | None = None
    for line in lines:
        columns = line.split()
        # The kernel prints addresses as hexadecimal words of this machine's byte order.
        target, mask = (int(columns[i], 16).to_bytes(4, sys.byteorder) for i in (1, 7))
        bits = int.from_bytes(mask, "big")
        same = int(address) & bits == int.from_bytes(target, "big")
        if address.version == 4 and same and (found is None or bits > found[0]):
            found = (bits, columns[0])
    return None if found is None else found[1]


def _widen_buffer(bus: can.BusABC) -> None:
    """Ask the kernel for room, so that a reader that waits for a processor loses no frame."""
    try:
        descriptor = bus.fileno()
        with socket.socket(fileno=os.dup(descriptor)) as twin:
            twin.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
    except (NotImplementedError, OSError, AttributeError):
        return  # no socket behind this interface


def _kernel_drops(bus: can.BusABC) -> int | None:
    """Frames that found no room in the socket's buffer; None where that cannot be told."""
    try:
        with socket.socket(fileno=os.dup(bus.fileno())) as twin:
            info = twin.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 4 * (MEMINFO_DROPS + 1))
    except (NotImplementedError, OSError, AttributeError, TypeError):
        return None
    words = memoryview(info).cast("I")
    return words[MEMINFO_DROPS] if len(words) > MEMINFO_DROPS else None


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__
