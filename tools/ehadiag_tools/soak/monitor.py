"""Soak of the monitor in the receive thread of a live bus, with diagnoses beside it.

One more process is the flight-control computer: the detailed simulator in closed loop, telemetry
and command at 1 kHz. This one is the product: its receive thread decodes the frames, puts them
together into ticks and pushes each into the monitor, while diagnoses run without a pause in the
main thread, where they share the interpreter lock with it, or in a process of their own.
"""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np

from ehadiag.cli.screen.show import shown
from ehadiag.core.actuator import default_actuator
from ehadiag.core.dates import utc_text
from ehadiag.core.errors import BusLostError, ConfigurationError
from ehadiag.core.recording import CommandMode
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.session import identify
from ehadiag.live.snapshot import Bus, Residuals, Severity, Snapshot, known
from ehadiag.live.trace import Trace
from ehadiag.live.traffic import Traffic
from ehadiag.monitor import Monitor
from ehadiag_sim.plant.conditions import Faults
from ehadiag_sim.plant.simulator import Plant
from ehadiag_tools.bench.problem import experiment
from ehadiag_tools.soak.load import COMMAND, PERIOD_NS, TELEMETRY
from firmware_iface.alignment.live_ticks import LiveTicks
from firmware_iface.codec.encode import Encoder
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.python_can import BusOptions, PythonCanTransport
from firmware_iface.transport.receiver import Receiver

__all__ = ["BESIDE", "MonitorSoak", "monitor_soak", "monitor_text"]

BESIDE = ("thread", "process", "none", "view")
"""Where diagnoses run; `view`: the live view instead of them, in every other `SPAN_S`."""
SPAN_S = 3.0
LOGS = Path(__file__).parents[3] / "tests" / "data" / "logs"
FAULTS = (0.3, 0.3, 0.3)
SHARES = (50.0, 99.0, 99.9)
QUIET_S = 1.0
LONGEST_START_S = 120.0
"""For the sender's first frame: it may have to compile the simulator."""
IDLE_S = 0.05


@dataclass(frozen=True, slots=True)
class MonitorSoak:
    """What came of it; latencies in µs at p50, p99, p99.9 and the largest.

    Attributes
    ----------
    sent, received: frames of telemetry and command.
    lost: frames sent and not seen by the receive thread.
    ticks_lost: ticks that the monitor was told as lost.
    unread: frames that the queue behind the receive thread had no room for.
    wall: of the call of `push`, by the clock.
    cpu: the same by the thread's processor time, the reading of both clocks included.
    take: of the receive thread's whole work on a frame that completes a tick, by the clock.
    residual: rms of the residuals of spool and pressure, in units of noise.
    unseen_wall: as `wall`, while the live view rests; `wall` is then that while it is shown. None
        without a live view.
    unseen_take: as `take`, the same.
    """

    interface: str
    seconds: float
    beside: str
    diagnoses: int
    sent: int
    received: int
    lost: int
    ticks_lost: int
    unread: int
    pushes: int
    wall: tuple[float, ...]
    cpu: tuple[float, ...]
    take: tuple[float, ...]
    alarms: int
    residual: tuple[float, float]
    switch_ms: float
    unseen_wall: tuple[float, ...] | None = None
    unseen_take: tuple[float, ...] | None = None


def monitor_soak(
    options: BusOptions, seconds: float, beside: str = "thread", switch_s: float | None = None
) -> MonitorSoak:
    """Send, receive, monitor and diagnose for a while.

    Parameters
    ----------
    beside: one of `BESIDE`.
    switch_s: how long a thread may keep the interpreter lock that another waits for, s; None leaves
        it as it is (5 ms).

    Raises
    ------
    ConfigurationError: less than a second, an unknown `beside`.
    BusLostError: the bus failed, or nothing came.
    """
    if not seconds >= 1.0 or beside not in BESIDE:
        raise ConfigurationError(f"soak of {seconds:g} s beside {beside!r}: need at least 1 s")
    context = multiprocessing.get_context("spawn")
    stop, sent = context.Event(), context.Value("q", 0, lock=False)
    done = context.Value("q", 0, lock=False)
    sender = context.Process(target=send_actuator, args=(options, stop, sent))
    watch = _Watch(seconds)
    item = experiment(LOGS) if beside == "thread" else None
    if item is not None:
        identify([item])  # compiles, or loads, what it runs
    processes = [sender]
    if beside == "process":
        processes.append(context.Process(target=diagnose_on, args=(stop, done)))
    with (
        _switch_interval(switch_s),
        PythonCanTransport(options) as bus,
        Receiver(bus, sink=watch.take) as source,
        shown(watch.look, plain=False) if beside == "view" else contextlib.nullcontext(),
    ):
        for process in processes:
            process.start()
        try:
            _wait_for_frames(watch, source)
            begin = time.monotonic()
            while (elapsed := time.monotonic() - begin) < seconds:
                if beside == "view":
                    watch.show(int(elapsed / SPAN_S) % 2 == 0)
                if item is None:
                    time.sleep(IDLE_S)
                else:
                    identify([item])
                    done.value += 1
                _drain(source)
        finally:
            stop.set()
            watch.show(True)
            for process in processes:
                process.join()
        _drain(source, QUIET_S)
        return watch.result(bus.name, elapsed, beside, done.value, sent.value, source.overflow)


class _Watch:
    """The receive thread's sink: monitors, and notes how long that takes. Its memory is fixed."""

    def __init__(self, seconds: float) -> None:
        self._ticks = LiveTicks()
        self._monitor = Monitor(default_actuator(), FAULTS, mode=CommandMode.POSITION)
        room = round(seconds * 1e9 / PERIOD_NS) + 600_000
        self._wall, self._cpu, self._take = np.zeros((3, room), dtype=np.int64)
        self._seen_at = np.ones(room, dtype=np.bool_)
        self._showing = threading.Event()
        self._showing.set()
        self._squares, self._seen = np.zeros(2), np.zeros(2)
        self._breaks = self._alarms = self._pushes = 0
        self._trace, self._traffic = Trace(), Traffic(1e6)
        self.received = 0

    def take(self, frame: Frame) -> None:
        """One frame."""
        clock = time.perf_counter_ns
        begin = clock()
        self.received += frame.can_id in (TELEMETRY, COMMAND)
        self._traffic.take(len(frame.data))
        for tick in self._ticks.take(frame):
            if self._ticks.breaks != self._breaks:
                self._breaks = self._ticks.breaks
                self._monitor.reset()
            cpu = time.thread_time_ns()
            wall = clock()
            reading = self._monitor.push(tick)
            k = self._pushes % len(self._wall)
            self._wall[k] = clock() - wall
            self._cpu[k] = time.thread_time_ns() - cpu
            self._pushes += 1
            self._alarms += bool(reading.alarmed.any())
            known = np.isfinite(reading.residual)
            self._seen += known
            self._squares += np.where(known, reading.residual, 0.0) ** 2
            self._trace.take(self._pushes / 1e3, CommandMode.POSITION, tick[0], tick[1:])
            self._take[k] = clock() - begin
            self._seen_at[k] = self._showing.is_set()

    def show(self, shown: bool) -> None:
        """Let the live view go on, or rest."""
        if shown:
            self._showing.set()
        else:
            self._showing.clear()

    def look(self, number: int) -> Snapshot:
        """Return what the live view shows; waits while it rests."""
        self._showing.wait()
        rate, load, _ = self._traffic.measure()
        spool, pressure = self._monitor.reading.residual.tolist()
        return Snapshot(
            number=number,
            time=utc_text(datetime.now(UTC)),
            command="monitor",
            actuator="soak",
            serial=None,
            bus=Bus(
                name="soak",
                state="open",
                frames=self.received,
                rate_per_s=rate,
                load=load,
                lost=self._ticks.lost,
            ),
            mode="position",
            signals=self._trace.signals(),
            residuals=Residuals(spool=known(spool), pressure=known(pressure)),
            severities=tuple(
                Severity(name=name, estimate=value, source="soak")
                for name, value in zip(("Kintas", "FSS", "FDJ"), FAULTS, strict=True)
            ),
        )

    def result(
        self, name: str, seconds: float, beside: str, diagnoses: int, sent: int, unread: int
    ) -> MonitorSoak:
        """All figures."""
        if self._pushes == 0:
            raise BusLostError(f"{name}: no tick arrived whole")
        rms = np.sqrt(self._squares / np.maximum(self._seen, 1.0))
        some = slice(min(self._pushes, len(self._wall)))
        seen = self._seen_at[some]
        rested = not seen.all()
        return MonitorSoak(
            interface=name,
            seconds=seconds,
            beside=beside,
            diagnoses=diagnoses,
            sent=sent,
            received=self.received,
            lost=sent - self.received,
            ticks_lost=self._ticks.lost,
            unread=unread,
            pushes=self._pushes,
            wall=_figures(self._wall[some][seen]),
            cpu=_figures(self._cpu[some][seen]),
            take=_figures(self._take[some][seen]),
            alarms=self._alarms,
            residual=(float(rms[0]), float(rms[1])),
            switch_ms=sys.getswitchinterval() * 1e3,
            unseen_wall=_figures(self._wall[some][~seen]) if rested else None,
            unseen_take=_figures(self._take[some][~seen]) if rested else None,
        )


def _figures(nanoseconds: np.ndarray) -> tuple[float, ...]:
    shares = np.percentile(nanoseconds, SHARES)
    return (*(float(value) / 1e3 for value in shares), float(nanoseconds.max()) / 1e3)


def _wait_for_frames(watch: _Watch, source: Receiver) -> None:
    limit = time.monotonic() + LONGEST_START_S
    while watch.received == 0:
        _drain(source)
        if time.monotonic() > limit:
            raise BusLostError(f"{source.name}: no frame within {LONGEST_START_S:g} s")
        time.sleep(IDLE_S)


def _drain(source: Receiver, patience: float = 0.0) -> None:
    """Read what the queue holds, as the product's reader does."""
    while source.receive(patience) is not None:
        pass


@contextmanager
def _switch_interval(seconds: float | None) -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(before if seconds is None else seconds)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def send_actuator(options: BusOptions, stop: Event, sent: Synchronized[int]) -> None:
    """Be the computer of an actuator that moves as in the closed-loop test, over and over."""
    plant, encoder = Plant(default_actuator(), Faults(*FAULTS), seed=1), Encoder()
    commands = resolve_test("closed").command().tolist()
    mode, tick = CommandMode.POSITION, 0
    with PythonCanTransport(options, transmit=True) as bus:
        started = time.monotonic_ns()
        while not stop.is_set():
            command = commands[tick % len(commands)]
            codes = plant.tick(command, mode).tolist()
            frames = (*encoder.command(mode, command, 0, 0), *encoder.telemetry(codes, 0))
            tick += 1
            left = started + tick * PERIOD_NS - time.monotonic_ns()
            if left > 0:
                time.sleep(left * 1e-9)
            for frame in frames:
                bus.send(dataclasses.replace(frame, time_ns=time.time_ns()))
                sent.value += 1


def diagnose_on(stop: Event, done: Synchronized[int]) -> None:
    """Diagnose the same recording until told to stop."""
    item = experiment(LOGS)
    while not stop.is_set():
        identify([item])
        done.value += 1


def monitor_text(result: MonitorSoak) -> str:
    """Print a result for people."""
    p50, p99, p999, most = range(4)

    def told(name: str, values: tuple[float, ...]) -> str:
        return (
            f"{name}: p50 {values[p50]:.2f} µs, p99 {values[p99]:.1f} µs, "
            f"p99.9 {values[p999]:.1f} µs, most {values[most]:.0f} µs"
        )

    rested = []
    if result.unseen_wall is not None and result.unseen_take is not None:
        rested = [
            told("push while the view rests", result.unseen_wall),
            told("whole work while the view rests", result.unseen_take),
        ]
    return "\n".join(
        (
            f"{result.interface}: {result.seconds:.0f} s, {result.diagnoses} diagnoses beside "
            f"(in: {result.beside}), switch interval {result.switch_ms:g} ms",
            f"frames sent {result.sent}, received {result.received}, lost {result.lost} "
            f"(ticks lost {result.ticks_lost}, not read from the queue {result.unread})",
            told(f"push, {result.pushes} calls, by the clock", result.wall),
            told("push, processor time, both clocks included", result.cpu),
            told("a frame that completes a tick, whole work, by the clock", result.take),
            *rested,
            f"alarms {result.alarms}, residuals rms {result.residual[0]:.2f} (spool) and "
            f"{result.residual[1]:.2f} (pressure) of the noise",
        )
    )
