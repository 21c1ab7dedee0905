"""Senders of a soak: telemetry and command at 1 kHz, and frames of other devices.

Every payload begins with the time of sending, so that its reader knows its age: 48 bits of
microseconds on the machine's monotonic clock, which all processes share.
"""

from __future__ import annotations

import struct
import time
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event

from firmware_iface.codec.protection import crc8
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.python_can import BusOptions, PythonCanTransport

__all__ = [
    "COMMAND",
    "FRAME_S",
    "OWN_RATE",
    "PERIOD_NS",
    "TELEMETRY",
    "send_foreign",
    "send_own",
    "sent_at_us",
]

TELEMETRY, COMMAND = 0x110, 0x111
FOREIGN = 0x300
FOREIGN_IDENTIFIERS = 256
PERIOD_NS = 1_000_000
OWN_RATE = 2e9 / PERIOD_NS
"""Frames/s: one of each per tick."""
FRAME_S = 130e-6
"""Length of an 8-byte frame at 1 Mbit/s, stuff bits included."""
STAMP = (1 << 48) - 1


def sent_at_us(data: bytes) -> int:
    """When a payload was sent, µs on the monotonic clock."""
    return int.from_bytes(data[:6], "little")


def send_own(options: BusOptions, stop: Event, sent: Synchronized[int]) -> None:
    """Send telemetry and command every tick, with counter (BUS-5) and check sum (BUS-6)."""
    headers = [(item, struct.pack("<H", item)) for item in (COMMAND, TELEMETRY)]
    tick = 0
    with PythonCanTransport(options, transmit=True) as bus:
        started = time.monotonic_ns()
        while not stop.is_set():
            _wait_until(started + tick * PERIOD_NS)
            body = _stamp() + bytes((tick & 0xFF,))
            for can_id, header in headers:
                bus.send(Frame(0, can_id, body + bytes((crc8(header + body),))))
                sent.value += 1
            tick += 1


def send_foreign(options: BusOptions, stop: Event, sent: Synchronized[int], rate: float) -> None:
    """Send frames of other devices, `rate` of them a second, each millisecond those of it.

    So an adapter on USB hands them over; a sender that sleeps for each frame costs more processor
    than the reader that is tried.
    """
    count = tick = 0
    with PythonCanTransport(options, transmit=True) as bus:
        started = time.monotonic_ns()
        while not stop.is_set():
            _wait_until(started + tick * PERIOD_NS)
            tick += 1
            stamp = _stamp()
            while count < tick * PERIOD_NS * 1e-9 * rate:
                can_id = FOREIGN + count % FOREIGN_IDENTIFIERS
                bus.send(Frame(0, can_id, stamp + struct.pack("<H", count & 0xFFFF)))
                count += 1
            sent.value = count


def _stamp() -> bytes:
    return (time.monotonic_ns() // 1000 & STAMP).to_bytes(6, "little")


def _wait_until(due_ns: int) -> None:
    """Sleep until a time; what is late follows at once, so that the mean rate holds."""
    left = due_ns - time.monotonic_ns()
    if left > 0:
        time.sleep(left * 1e-9)
