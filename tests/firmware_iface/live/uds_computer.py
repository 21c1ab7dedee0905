"""A flight-control computer of its own: python-can and can-isotp, nothing of this project.

python uds_computer.py LOG FILE: serves one test on udp_multicast, whose telemetry is played from a
recording; begins its answer to the start by 0x78, and its own result by "identifying". Ends when
its result was read; writes the requests to FILE.
"""

from __future__ import annotations

import json
import struct
import sys
import time
from pathlib import Path

import can
import isotp

DURATION = 0.4
ARMING = 0.1


class Computer:
    """Answers requests, and knows its state by the time since the start."""

    def __init__(self, bus: can.BusABC, log: str) -> None:
        address = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x7E8, rxid=0x7E0)
        self.bus = bus
        self.layer = isotp.CanStack(bus, address=address, params={"tx_padding": 0xAA})
        self.requests: list[str] = []
        self.started = 0.0
        self.onboard_asked = 0
        wanted = [item for item in can.BLFReader(log) if item.arbitration_id in (0x110, 0x111)]
        self.played = [(item.timestamp - wanted[0].timestamp, item) for item in wanted]
        self.answer_at: list[tuple[float, bytes]] = []

    def status(self) -> bytes:
        elapsed = time.monotonic() - self.started - ARMING
        state = 1 if elapsed < 0 else 2 if elapsed < DURATION else 3
        shown = min(max(elapsed, 0.0), DURATION)
        return struct.pack(">BBBHH", state, 0, 2, round(1000 * shown), 4711)

    def onboard(self) -> bytes:
        self.onboard_asked += 1
        values = (0.1, 0.2, 0.3, 0.01, 0.02, 0.03)
        numbers = [int(1e7 * value).to_bytes(3, "big") for value in values]
        state = 3 if self.onboard_asked > 2 else 2
        return struct.pack(">BBBH", state, 2, 10, 321) + b"".join(numbers)

    def answer(self, request: bytes) -> bytes:
        head = bytes([request[0] + 0x40])
        if request[:4] == b"\x31\x01\x02\x01":
            self.started = time.monotonic() + 0.3
            self.answer_at.append((self.started, head + request[1:4] + self.status()))
            return b"\x7f\x31\x78"
        if request[:4] == b"\x31\x03\x02\x01" and self.started:
            return head + request[1:4] + self.status()
        data = {
            b"\x22\x01\x20": self.onboard,
            b"\x22\xf1\x8c": lambda: struct.pack(">H", 4711),
            b"\x22\xf1\x95": lambda: b"rig 7".ljust(16, b"\0"),
            b"\x19\x02\x09": lambda: b"\x5a\x01\x00\x09",
        }.get(request[:3])
        if data is None:
            return bytes([0x7F, request[0], 0x24 if request[0] == 0x31 else 0x31])
        echo = b"\x02\x19" if request[0] == 0x19 else request[1:3]
        return head + echo + data()

    def run(self) -> None:
        self.layer.start()
        sent, begin, end = 0, time.monotonic(), time.monotonic() + 60
        while time.monotonic() < end:
            now = time.monotonic()
            while sent < len(self.played) and begin + self.played[sent][0] <= now:
                self.bus.send(self.played[sent][1])
                sent += 1
            request = self.layer.recv()
            if request is not None:
                self.requests.append(bytes(request).hex())
                self.layer.send(self.answer(bytes(request)))
            if self.answer_at and now >= self.answer_at[0][0]:
                self.layer.send(self.answer_at.pop(0)[1])
            if self.onboard_asked > 2 and any(item.startswith("19") for item in self.requests):
                break
            time.sleep(0.0005)
        time.sleep(0.2)
        self.layer.stop()


if __name__ == "__main__":
    with can.Bus("239.74.163.2", interface="udp_multicast") as opened:
        computer = Computer(opened, sys.argv[1])
        print("ready", flush=True)
        computer.run()
    Path(sys.argv[2]).write_text(json.dumps(computer.requests))
