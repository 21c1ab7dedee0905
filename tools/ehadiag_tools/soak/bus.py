"""`tools/soak`: minutes on a loaded bus; frames lost, memory, age of samples at the reader.

Two more processes send: telemetry and command at 1 kHz, and frames of other devices until the bus
is as full as asked. The reader is that of the product: receive thread, recorder, bounded queue.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ehadiag.core.errors import BusLostError, ConfigurationError, EhadiagError
from ehadiag_tools.soak.load import (
    COMMAND,
    FRAME_S,
    OWN_RATE,
    TELEMETRY,
    send_foreign,
    send_own,
    sent_at_us,
)
from ehadiag_tools.soak.monitor import BESIDE, monitor_soak, monitor_text
from firmware_iface.logs.recorder import Recorder
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.python_can import BusOptions, PythonCanTransport
from firmware_iface.transport.receiver import Receiver

__all__ = ["Soak", "main", "soak"]

AGE_STEP_US = 10
AGE_BINS = 1_000_000
"""Ten seconds; older ones count as that old."""
PAGE = 4096
WARM_S = 60.0
"""Memory is compared from here on: caches are full by then."""
MOST_AT_ONCE = 64
"""Frames between two looks at the clock."""
QUIET_S = 1.0
"""Silence after which the bus counts as read empty."""
LONGEST_START_S = 60.0
"""For the senders' first frame."""


@dataclass(frozen=True, slots=True)
class Soak:
    """What came of a soak.

    Attributes
    ----------
    seconds: how long the senders ran.
    bus_load: share of 1 Mbit/s that was really sent.
    sent, received: frames, all senders together.
    own_lost, foreign_lost: frames sent and not read.
    dropped_by_kernel: of them, those that the socket had no room for; None if it cannot say.
    dropped_by_queue: of them, those that the reader was too slow for.
    recorded: frames in the recording.
    rss_warm, rss_end: memory of the reader after a minute (or half the time) and at the end, bytes.
    age_p50, age_p99, age_max: of telemetry and command when the reader has them, s.
    """

    interface: str
    seconds: float
    bus_load: float
    sent: int
    received: int
    own_lost: int
    foreign_lost: int
    dropped_by_kernel: int | None
    dropped_by_queue: int
    recorded: int
    rss_warm: int
    rss_end: int
    age_p50: float
    age_p99: float
    age_max: float


def soak(options: BusOptions, seconds: float, load: float, folder: Path) -> Soak:
    """Load a bus and read it for a while.

    Raises
    ------
    ConfigurationError: load below that of our own frames or above 1, time too short.
    BusLostError, InputOutputError: bus or recording failed.
    """
    foreign_rate = load / FRAME_S - OWN_RATE
    if not (load <= 1.0 and foreign_rate > 0.0 and seconds >= 1.0):
        raise ConfigurationError(
            f"soak of {seconds:g} s at load {load:g}: need at least 1 s, and a load between "
            f"{OWN_RATE * FRAME_S:.2f} (our own frames) and 1"
        )
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    own, foreign = (context.Value("q", 0, lock=False) for _ in range(2))
    senders = [
        context.Process(target=send_own, args=(options, stop, own)),
        context.Process(target=send_foreign, args=(options, stop, foreign, foreign_rate)),
    ]
    recorder = Recorder(folder / "soak.blf", max_bytes=64 << 20)
    with (
        PythonCanTransport(options) as bus,
        recorder,
        Receiver(bus, sink=recorder.write, idle=recorder.idle) as source,
    ):
        reading = _Reading(source, seconds)
        for item in senders:
            item.start()
        try:
            reading.run()
        finally:
            stop.set()
            for item in senders:
                item.join()
        reading.drain()
        dropped, overflow = bus.dropped, source.overflow
    sent = own.value + foreign.value
    return Soak(
        interface=bus.name,
        seconds=reading.elapsed,
        bus_load=sent * FRAME_S / reading.elapsed,
        sent=sent,
        received=reading.own + reading.foreign,
        own_lost=own.value - reading.own,
        foreign_lost=foreign.value - reading.foreign,
        dropped_by_kernel=dropped,
        dropped_by_queue=overflow,
        recorded=recorder.frames,
        rss_warm=reading.rss_warm,
        rss_end=_resident(),
        age_p50=reading.age(0.5),
        age_p99=reading.age(0.99),
        age_max=reading.oldest_us * 1e-6,
    )


class _Reading:
    """The reader: counts frames, and their ages in a histogram of fixed size."""

    def __init__(self, source: Receiver, seconds: float) -> None:
        self._source = source
        self._seconds = seconds
        self._ages = np.ones(AGE_BINS, dtype=np.int64)  # written, so that memory is taken now
        self._ages[:] = 0
        self.own = self.foreign = self.oldest_us = self.rss_warm = 0
        self.elapsed = 0.0

    def run(self) -> None:
        """Read until the time is up, from the first frame on."""
        limit = time.monotonic() + LONGEST_START_S
        while not self._step():
            if time.monotonic() > limit:
                raise BusLostError(f"{self._source.name}: no frame within {LONGEST_START_S:g} s")
        begin = time.monotonic()
        warm = min(WARM_S, self._seconds / 2)
        while (now := time.monotonic()) - begin < self._seconds:
            self._step()
            if not self.rss_warm and now - begin >= warm:
                self.rss_warm = _resident()
        self.elapsed = time.monotonic() - begin

    def drain(self) -> None:
        """Read what is still under way."""
        while self._step():
            pass

    def age(self, share: float) -> float:
        """Age that this share of the samples does not exceed, s."""
        total = np.cumsum(self._ages)
        return float((np.searchsorted(total, share * total[-1]) + 1) * AGE_STEP_US * 1e-6)

    def _step(self) -> bool:
        """Wait for a frame, then take all that are there; false after a silence."""
        frame = self._source.receive(QUIET_S)
        if frame is None:
            return False
        self._take(frame)
        for _ in range(MOST_AT_ONCE):
            frame = self._source.receive(0.0)
            if frame is None:
                break
            self._take(frame)
        return True

    def _take(self, frame: Frame) -> None:
        if frame.can_id in (TELEMETRY, COMMAND):
            age = time.monotonic_ns() // 1000 - sent_at_us(frame.data)
            self._ages[min(age // AGE_STEP_US, AGE_BINS - 1)] += 1
            self.oldest_us = max(self.oldest_us, age)
            self.own += 1
        else:
            self.foreign += 1


def _resident() -> int:
    """Memory of this process that is in use, bytes."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * PAGE


def text(result: Soak) -> str:
    """Print a result for people."""
    kernel = "unknown" if result.dropped_by_kernel is None else str(result.dropped_by_kernel)
    return "\n".join(
        (
            f"{result.interface}: {result.seconds:.0f} s at {result.bus_load:.0%} of 1 Mbit/s",
            f"frames sent {result.sent}, received {result.received}, recorded {result.recorded}",
            f"lost: ours {result.own_lost}, foreign {result.foreign_lost} "
            f"(dropped by the socket {kernel}, by the queue {result.dropped_by_queue})",
            f"memory {result.rss_warm / 2**20:.1f} MiB warm, {result.rss_end / 2**20:.1f} at the "
            f"end: {(result.rss_end - result.rss_warm) / 2**20:+.2f} MiB",
            f"age of a sample at its reader: p50 {result.age_p50 * 1e3:.2f} ms, "
            f"p99 {result.age_p99 * 1e3:.2f} ms, most {result.age_max * 1e3:.1f} ms",
        )
    )


def _monitor(options: BusOptions, arguments: argparse.Namespace) -> int:
    switch = None if arguments.switch_ms is None else arguments.switch_ms * 1e-3
    result = monitor_soak(options, arguments.minutes * 60.0, arguments.monitor, switch)
    print(json.dumps(asdict(result)) if arguments.json else monitor_text(result))
    return int(result.lost > 0)


def main(argv: Sequence[str] | None = None) -> int:
    """Soak a bus; exit code 0 without, 1 with a lost frame, or that of the error."""
    parser = argparse.ArgumentParser(prog="soak", description=__doc__)
    parser.add_argument("-i", "--interface", required=True, help="as python-can names it")
    parser.add_argument("-c", "--channel", help="as the interface names it")
    parser.add_argument("--minutes", type=float, default=10.0, help="(%(default)s)")
    parser.add_argument("--load", type=float, default=0.8, help="share of 1 Mbit/s (%(default)s)")
    parser.add_argument(
        "--monitor",
        choices=BESIDE,
        help="the monitor in the receive thread instead, diagnoses or the live view beside it"
        " (sends telemetry and command only)",
    )
    parser.add_argument(
        "--switch-ms", type=float, help="with --monitor: sys.setswitchinterval (left as it is: 5)"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object")
    arguments = parser.parse_args(argv)
    options = BusOptions(arguments.interface, channel=arguments.channel)
    try:
        if arguments.monitor is not None:
            return _monitor(options, arguments)
        with tempfile.TemporaryDirectory() as folder:
            result = soak(options, arguments.minutes * 60.0, arguments.load, Path(folder))
    except EhadiagError as error:
        print(f"soak: {error}", file=sys.stderr)
        return error.exit_code
    print(json.dumps(asdict(result)) if arguments.json else text(result))
    return int(result.own_lost + result.foreign_lost > 0)
