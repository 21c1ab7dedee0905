"""Study of minutes on a loaded bus: frames lost, memory, ages, time of the monitor's push.

Two more processes send: the computer of an actuator that moves as in the closed-loop test,
telemetry and command at 1 kHz, and other devices until the bus is as full as asked. The reader is
that of the product: a receive thread that records and pushes each tick into the monitor, and a
bounded queue. With `--diagnose` the main thread diagnoses without a pause, so that it shares the
interpreter lock with the receive thread.
"""

from __future__ import annotations

import argparse
import multiprocessing
import struct
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
import psutil

from ehadiag.core.actuator import default_actuator
from ehadiag.identify.identification_session import identify
from ehadiag.monitor.streaming import Monitor
from ehadiag_sim.conditions import Faults
from ehadiag_sim.simulation import Plant
from ehadiag_tools.bench import percentiles, reference_experiment
from ehadiag_tools.study import Options, Record, Study, case_of, markdown
from firmware_iface.codec import Encoder
from firmware_iface.errors import BusLostError, ConfigurationError
from firmware_iface.live_decode import LiveTicks
from firmware_iface.logs.recorder import Recorder
from firmware_iface.recording import CommandMode
from firmware_iface.stored_test import resolve_test
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.base import Receiver
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.python_can import PythonCanTransport

FOREIGN = 0x300
"""First identifier of other devices."""
PERIOD_NS = 1_000_000
"""Control period, ns."""
FRAME_S = 130e-6
"""Length of an 8-byte frame at 1 Mbit/s, stuff bits included, s."""
OWN_LOAD = 2e9 / PERIOD_NS * FRAME_S
"""Load of the bus by telemetry and command, 1."""
ROOM = 60_000
"""Number of times kept beyond those expected."""
SILENCE_S, START_S = 1.0, 120.0
"""Silence after which the bus is empty, s, and longest time until the first frame."""
FAULTS = (0.3, 0.3, 0.3)
"""Severities of the simulated unit, 1."""


@dataclass(frozen=True, slots=True)
class SoakCase:
    """Bus as python-can names it, length, load as a share, whether diagnoses run."""

    interface: str
    channel: str | None
    minutes: float
    load: float
    diagnose: bool


def soak(case: SoakCase) -> Record:
    """Load a bus up to a share of 1 Mbit/s and read it for a while, recording it.

    Frames sent, received (all senders together), lost, and of them those that the socket had no
    room for (None if it cannot say) or the reader was too slow for; memory of the reader after a
    minute (or half the time) and at the end, bytes; ages of foreign frames when it has them, µs; of
    the monitor ticks pushed, lost on the way, alarms, rms of the residuals over the noise, and
    times of a push and of all work of the receive thread on a tick, µs.
    """
    seconds = 60.0 * case.minutes
    if not (OWN_LOAD < case.load <= 1.0 and seconds >= 1.0):
        raise ConfigurationError(
            f"soak of {seconds:g} s at load {case.load:g}: need at least 1 s, and a load "
            f"between {OWN_LOAD:.2f} (our own frames) and 1"
        )
    options = BusOptions(case.interface, channel=case.channel)
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    own, foreign = (context.Value("q", 0, lock=False) for _ in range(2))
    rate = (case.load - OWN_LOAD) / FRAME_S
    senders = [
        context.Process(target=send_actuator, args=(options, stop, own)),
        context.Process(target=send_foreign, args=(options, stop, foreign, rate)),
    ]
    with (
        tempfile.TemporaryDirectory() as folder,
        PythonCanTransport(options) as bus,
        Recorder(Path(folder) / "soak.blf", max_bytes=64 << 20) as recorder,
    ):
        sink = _Sink(recorder, seconds)
        with Receiver(bus, sink=sink.take, idle=recorder.idle) as source:
            reader = _Reader(source, seconds * rate)
            for item in senders:
                item.start()
            try:
                reader.read(seconds, case.diagnose)
            finally:
                stop.set()
                for item in senders:
                    item.join()
            while reader.take_all(SILENCE_S):
                pass
        dropped, overflow = bus.dropped, source.overflow
    sent = own.value + foreign.value
    return {
        "elapsed": reader.elapsed,
        "bus_load": (sent - reader.before) * FRAME_S / reader.elapsed,
        "sent": sent,
        "received": reader.own + reader.foreign,
        "own_lost": own.value - reader.own,
        "foreign_lost": foreign.value - reader.foreign,
        "dropped_by_kernel": dropped,
        "dropped_by_queue": overflow,
        "recorded": recorder.frames,
        "rss_warm": reader.rss_warm,
        "rss_end": _resident(),
        "age_us": percentiles(reader.ages_us[: reader.foreign]),
        "diagnoses": reader.diagnoses,
        **sink.result(),
    }


class _Sink:
    """Sink of the receive thread: records, monitors, and measures how long that takes."""

    def __init__(self, recorder: Recorder, seconds: float) -> None:
        self._recorder, self._ticks = recorder, LiveTicks()
        self._monitor = Monitor(default_actuator(), FAULTS, mode=CommandMode.POSITION)
        room = round(seconds * 1e9 / PERIOD_NS) + ROOM
        self._push, self._work = np.ones((2, room), dtype=np.int64)  # taken from the system now
        self._squares, self._count = np.zeros(2), np.zeros(2)
        self._breaks = self._alarms = self._pushes = 0

    def take(self, frame: Frame) -> None:
        """Take one frame."""
        clock = time.perf_counter_ns
        begin = clock()
        self._recorder.write(frame)
        for tick in self._ticks.take(frame):
            if self._ticks.breaks != self._breaks:
                self._breaks = self._ticks.breaks
                self._monitor.reset()
            k, start = self._pushes % len(self._push), clock()
            reading = self._monitor.push(tick)
            self._push[k] = clock() - start
            self._pushes += 1
            self._alarms += bool(reading.alarmed.any())
            finite = np.isfinite(reading.residual)
            self._count += finite
            self._squares += np.where(finite, reading.residual, 0.0) ** 2
            self._work[k] = clock() - begin

    def result(self) -> Record:
        """Return the monitor's figures."""
        part = slice(min(self._pushes, len(self._push)))
        if not self._pushes:
            raise BusLostError("no tick arrived complete")
        return {
            "pushes": self._pushes,
            "ticks_lost": self._ticks.lost,
            "alarms": self._alarms,
            "push_us": percentiles(self._push[part] / 1e3),
            "work_us": percentiles(self._work[part] / 1e3),
            "residual": np.sqrt(self._squares / np.maximum(self._count, 1.0)).tolist(),
        }


class _Reader:
    """Counts frames behind the queue, and keeps the ages of foreign ones, as many as expected."""

    def __init__(self, source: Receiver, foreign: float) -> None:
        self._source = source
        # Written, so that memory is taken now.
        self.ages_us = np.ones(round(foreign) + ROOM, dtype=np.float32)
        self.own = self.foreign = self.rss_warm = self.diagnoses = self.before = 0
        self.elapsed = 0.0

    def read(self, seconds: float, diagnose: bool) -> None:
        """Read until the time is up, from the moment on that both senders are there."""
        experiment = reference_experiment() if diagnose else None
        if experiment is not None:
            identify([experiment])  # compiles, or loads, what it runs
        limit = time.monotonic() + START_S
        while not (self.own and self.foreign):
            self.take_all(SILENCE_S)
            if time.monotonic() > limit:
                raise BusLostError(f"{self._source.name}: no frames within {START_S:g} s")
        self.before = self.own + self.foreign
        begin = time.monotonic()
        warm = min(60.0, seconds / 2)  # caches are full by then
        while self.elapsed < seconds:
            if experiment is not None:
                identify([experiment])
                self.diagnoses += 1
            self.take_all(SILENCE_S)
            self.elapsed = time.monotonic() - begin
            if not self.rss_warm and self.elapsed >= warm:
                self.rss_warm = _resident()

    def take_all(self, timeout: float) -> bool:
        """Wait for a frame, then take those that are there; false after a silence."""
        frame = self._source.receive(timeout)
        end = time.monotonic() + timeout
        while frame is not None and time.monotonic() < end:
            self._take(frame)
            frame = self._source.receive(0.0)
            if frame is None:
                return True
        return frame is not None

    def _take(self, frame: Frame) -> None:
        if frame.can_id < FOREIGN:
            self.own += 1
            return
        age_us = time.monotonic_ns() // 1000 - int.from_bytes(frame.data[:6], "little")
        self.ages_us[self.foreign % len(self.ages_us)] = age_us
        self.foreign += 1


def _resident() -> int:
    """Memory of this process that is in use, bytes."""
    return int(psutil.Process().memory_info().rss)


def send_actuator(options: BusOptions, stop: Event, sent: Synchronized[int]) -> None:
    """Be the computer of an actuator that moves as in the closed-loop test, again and again."""
    plant, encoder = Plant(default_actuator(), Faults(*FAULTS), seed=1), Encoder()
    mode, commands = CommandMode.POSITION, resolve_test("closed").command().tolist()
    # Moved beforehand: a tick of the plant takes longer than the reader that is tried. The second
    # of two tests is repeated: it begins as it ends.
    codes, length = [plant.tick(x, mode).tolist() for x in 2 * commands], len(commands)
    with PythonCanTransport(options, transmit=True) as bus:
        for tick in _ticks(stop):
            k, counter, now = tick % length, tick % 256, time.time_ns()
            sample = codes[tick if tick < length else length + k]
            for frame in (
                *encoder.command(mode, commands[k], 0, now, counter),
                *encoder.telemetry(sample, now, counter),
            ):
                bus.send(frame)
                sent.value += 1


def send_foreign(options: BusOptions, stop: Event, sent: Synchronized[int], rate: float) -> None:
    """Send frames of other devices, `rate` of them a second, each millisecond those of it.

    So an adapter on USB hands them over. Their payload begins with microseconds on the monotonic
    clock, which all processes share, in 48 bits.
    """
    count = 0
    with PythonCanTransport(options, transmit=True) as bus:
        for tick in _ticks(stop):
            stamp = (time.monotonic_ns() // 1000 & (1 << 48) - 1).to_bytes(6, "little")
            while count < (tick + 1) * PERIOD_NS * 1e-9 * rate:
                data = stamp + struct.pack("<H", count & 0xFFFF)
                bus.send(Frame(0, FOREIGN + count % 256, data))
                count += 1
            sent.value = count


def _ticks(stop: Event) -> Iterator[int]:
    """Numbers of ticks, each at its time; what is late follows at once."""
    started, tick = time.monotonic_ns(), 0
    while not stop.is_set():
        left = started + tick * PERIOD_NS - time.monotonic_ns()
        if left > 0:
            time.sleep(left * 1e-9)
        yield tick
        tick += 1


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("-i", "--interface", required=True, help="as python-can names it")
    add("-c", "--channel", help="as the interface names it")
    add("--minutes", type=float, default=10.0, help="(%(default)g)")
    add("--load", type=float, default=0.8, help="share of 1 Mbit/s (%(default)g)")
    add("--diagnose", action="store_true", help="diagnose in the main thread meanwhile")


def _cases(options: Options) -> list[SoakCase]:
    return [case_of(SoakCase, options)]


def _report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    """Settings and figures; percentiles are p50, p99, p99.9 and the largest."""
    (record,) = records
    yield from markdown(("figure", "value"), ((name, _text(of)) for name, of in record.items()))


def _text(value: object) -> str:
    if isinstance(value, list):
        return ", ".join(map(_text, value))
    return f"{value:.5g}" if isinstance(value, float) else str(value)


SOAK = Study(
    "soak",
    "Minutes on a loaded bus: frames lost, memory, age of samples, time of the monitor's push.",
    _cases, soak, _report, _options, count=None, measures_time=True,
    failed=lambda item: item["own_lost"] + item["foreign_lost"] > 0,
)  # fmt: skip
