"""The project's serial link: frames in COBS packets with a CRC-16, over any pyserial URL.

A packet is `COBS(id u16 LE, time u32 LE in µs, payload 8 bytes, CRC-16/CCITT-FALSE u16 LE over all
before it)` and a zero byte (BUS-15). The framer finds its way back after any damage at the next
zero byte and counts what it had to drop.
"""

from __future__ import annotations

import binascii
import contextlib
import select
import struct
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import msgspec

from firmware_iface.errors import BusLostError, ConfigurationError, InputOutputError
from firmware_iface.recording import MAX_STANDARD_CAN_ID
from firmware_iface.transport.base import Transport
from firmware_iface.transport.frames import Frame

DEFAULT_BAUDRATE = 921_600
PACKET_BODY = struct.Struct("<HI8s")
PACKET_CRC = struct.Struct("<H")
PACKET_BYTES = PACKET_BODY.size + PACKET_CRC.size
MAX_CODED_BYTES = PACKET_BYTES + 1
"""COBS adds one byte to packets below 254 bytes."""
TIME_WRAP_US = 1 << 32


class PortTimes(msgspec.Struct, frozen=True):
    """Times of a serial port, s."""

    read: float = 0.01
    """The port's own time limit; a new one at each call would set up the line anew."""
    send: float = 0.25
    """A port that takes no byte for so long has no reader at its other end."""
    retry: float = 0.1
    """Between two tries of such a port, where it does not show whether there is room."""


PORT_TIMES = PortTimes()
NO_WRITE_TIMEOUT = ("rfc2217://",)
"""pyserial URLs that refuse to open with a time limit on writing; they have one of their own."""


def packet_of(frame: Frame) -> bytes:
    """Encode one frame with its delimiter.

    ConfigurationError: the link carries 11-bit identifiers and payloads of up to 8 bytes only.
    """
    from cobs import cobs  # noqa: PLC0415 - only serial users need it

    if frame.extended or frame.fd or frame.error or frame.remote or len(frame.data) != 8:
        raise ConfigurationError(
            f"the serial link carries classic 8-byte data frames only, not {frame.can_id:#x}"
        )
    body = PACKET_BODY.pack(frame.can_id, frame.time_ns // 1000 % TIME_WRAP_US, frame.data)
    coded: bytes = cobs.encode(body + PACKET_CRC.pack(binascii.crc_hqx(body, 0xFFFF)))
    return coded + b"\0"


@dataclass(slots=True)
class Framer:
    """Byte stream to frames; keeps at most one packet's bytes."""

    bad: int = 0
    """Packets dropped: not COBS, wrong length, wrong CRC, identifier beyond 11 bits."""
    bytes_seen: int = 0
    """Bytes fed so far."""
    _partial: bytes = b""
    _overlong: bool = False
    _last_us: int | None = None
    _time_us: int = 0

    def feed(self, chunk: bytes) -> list[Frame]:
        """Take bytes as they come; return the frames that became complete.

        `time_ns` counts from the sender's zero, unwrapped over the 71 minutes of the 32-bit field.
        """
        self.bytes_seen += len(chunk)
        frames = []
        *packets, rest = chunk.split(b"\0")
        for packet in packets:
            whole = self._partial + packet
            self._partial = b""
            if self._overlong:  # already counted
                self._overlong = False
                continue
            if not whole:  # two delimiters in a row are idle line, not damage
                continue
            frame = self._frame(whole)
            if frame is None:
                self.bad += 1
            else:
                frames.append(frame)
        if not self._overlong:
            self._partial += rest
            if len(self._partial) > MAX_CODED_BYTES:
                self.bad += 1
                self._overlong = True
                self._partial = b""
        return frames

    def _frame(self, coded: bytes) -> Frame | None:
        from cobs import cobs  # noqa: PLC0415 - only serial users need it

        if len(coded) != MAX_CODED_BYTES:
            return None
        try:
            packet = cobs.decode(coded)
        except cobs.DecodeError:
            return None
        if len(packet) != PACKET_BYTES:
            return None
        body = packet[: PACKET_BODY.size]
        can_id, stamp, data = PACKET_BODY.unpack(body)
        if (
            binascii.crc_hqx(body, 0xFFFF) != PACKET_CRC.unpack(packet[PACKET_BODY.size :])[0]
            or can_id > MAX_STANDARD_CAN_ID
        ):
            return None
        if self._last_us is None:
            self._time_us = stamp
        else:
            # The nearest way round the clock: a stamp may also lie before its predecessor.
            half = TIME_WRAP_US // 2
            self._time_us += (stamp - self._last_us + half) % TIME_WRAP_US - half
        self._last_us = stamp
        return Frame(time_ns=self._time_us * 1000, can_id=can_id, data=data)


class SerialTransport(Transport):
    """The serial link on any pyserial URL (`/dev/ttyUSB0`, `COM3`, `socket://…`, `rfc2217://…`).

    Frame times are the sender's clock, shifted once to this host's at the first frame.

    A serial line does not say whether anybody reads it, but a pseudo-terminal or a network port
    fills up when nobody does: frames that find no room are dropped and counted (DEGRADED), and
    sending goes on when there is room again.

    url: port, or pyserial URL; baudrate: bd; ignored by URLs without a line; transmit: whether the
    bus may be sent to; otherwise it is opened listen-only where the adapter can be.
    ConfigurationError: pyserial does not know the URL or the settings; InputOutputError: the port
    is absent or busy.
    """

    def __init__(
        self, url: str, *, baudrate: int = DEFAULT_BAUDRATE, transmit: bool = False
    ) -> None:
        super().__init__(f"serial {url}", transmit=transmit)
        self._framer = Framer()
        self._ready: deque[Frame] = deque()
        self._shift_ns: int | None = None
        self._reported_bad = 0
        self._unsent = 0
        self._stalled = False
        self._cut = False
        self._next_try = 0.0
        self._write_lock = threading.Lock()
        # A network port says only whether anything waits, not how much: read in blocks there.
        self._first_read = 256 if "://" in url else 1
        self._port = _open_port(url, baudrate)
        self._readable = _descriptor(self._port)

    @property
    def bad_packets(self) -> int:
        """Packets dropped so far."""
        return self._framer.bad

    @property
    def unsent(self) -> int:
        """Frames dropped for want of room; one of each stall may have gone out all the same."""
        return self._unsent

    def _receive(self, timeout: float) -> Frame | None:
        deadline = time.monotonic() + timeout
        while not self._ready:
            left = deadline - time.monotonic()
            self._fill(left)
            if left <= 0.0:
                break
        return self._ready.popleft() if self._ready else None

    def _fill(self, timeout: float) -> None:
        try:
            if not self._has_come(timeout):
                return
            # Wait for a first byte, then take what has come: a read of many would wait for all.
            chunk = self._port.read(self._first_read)
            if chunk:
                chunk += self._port.read(min(self._port.in_waiting, 4096))
        except Exception as error:
            raise self._lost(error) from None
        for frame in self._framer.feed(chunk):
            if self._shift_ns is None:
                self._shift_ns = time.time_ns() // 1000 * 1000 - frame.time_ns
            self._ready.append(
                Frame(frame.time_ns + self._shift_ns, can_id=frame.can_id, data=frame.data)
            )
        if self._framer.bad != self._reported_bad:
            self._reported_bad = self._framer.bad
            self._report_losses()

    def _has_come(self, timeout: float) -> bool:
        """Whether to read now; the port's own time limit is too coarse for a millisecond."""
        if self._readable is not None:
            return bool(select.select([self._readable], [], [], max(timeout, 0.0))[0])
        return timeout > 0.0 or bool(self._port.in_waiting)

    def _send(self, frame: Frame) -> None:
        packet = packet_of(frame)
        with self._write_lock:
            if not self._write(packet):
                self._unsent += 1
                self._report_losses()

    def _write(self, packet: bytes) -> bool:
        """Hand a packet to the port; False where it had no room for all of it."""
        from serial import SerialTimeoutException  # noqa: PLC0415 - only serial users need it

        try:
            if not self._has_room():
                self._stalled = True
                return False
            # What a cut packet left behind ends here, so that it does not spoil this one as well.
            self._port.write(b"\0" * self._cut + packet)
        except SerialTimeoutException:
            self._stalled = self._cut = True
            self._next_try = time.monotonic() + PORT_TIMES.retry
            return False
        except Exception as error:
            raise self._lost(error) from None
        self._stalled = self._cut = False
        return True

    def _has_room(self) -> bool:
        """Whether the port takes bytes; waits for it once, not for each frame of a long stall."""
        descriptor = _descriptor(self._port)
        if descriptor is None:
            return not self._stalled or time.monotonic() >= self._next_try
        return bool(
            select.select([], [descriptor], [], 0.0 if self._stalled else PORT_TIMES.send)[1]
        )

    def _report_losses(self) -> None:
        parts = [f"{self._reported_bad} damaged packets dropped"] if self._reported_bad else []
        if self._unsent:
            parts.append(f"{self._unsent} frames not sent, nobody read at the other end")
        self._degrade("; ".join(parts))

    def _close(self) -> None:
        with contextlib.suppress(Exception):
            self._port.close()

    def _lost(self, error: Exception) -> BusLostError:
        return self._fail(" ".join(str(error).split()) or type(error).__name__)


def _descriptor(port: Any) -> int | None:
    """What can be waited for; None where there is no such thing: Windows, RFC 2217."""
    try:
        descriptor: int = port.fileno()
    except (AttributeError, OSError):
        return None
    return descriptor


def _open_port(url: str, baudrate: int) -> Any:
    import serial  # noqa: PLC0415 - only serial users need it

    patience = None if url.lower().startswith(NO_WRITE_TIMEOUT) else PORT_TIMES.send
    try:
        return serial.serial_for_url(
            url, baudrate=baudrate, timeout=PORT_TIMES.read, write_timeout=patience, exclusive=True
        )
    except (ValueError, NotImplementedError) as error:
        raise ConfigurationError(f"serial {url}: wrong option: {error}") from None
    except (serial.SerialException, OSError) as error:
        text = " ".join(str(error).split())
        raise InputOutputError(
            f"serial {url}: cannot open: {text}; is the adapter plugged in and the port not in use?"
        ) from None
