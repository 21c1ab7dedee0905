"""A built-in test while it runs: identification before its end, and its snapshots."""

from __future__ import annotations

import contextlib
import math
import queue
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from ehadiag.assess.verdict import Levels
from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import utc_text
from ehadiag.estimate import Severity, finite
from ehadiag.live import BusState, BusTraffic, Ending, RunningTest, SignalTrace, Snapshot
from ehadiag.report.head import head_of
from firmware_iface.recording import BitState, CommandMode, Recording
from firmware_iface.stored_test import StoredTest

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import DiagnosisSession
    from ehadiag.result import Result
    from ehadiag.session.monitor_session import BitMonitor
    from ehadiag.setup import Deadline
    from firmware_iface.tester import Assembler, BitProgress
    from firmware_iface.transport.base import Transport
    from firmware_iface.transport.frames import Frame, FrameTable


class EarlyIdentification:
    """Identifies from the frames of a running test, in a thread of its own."""

    def __init__(self, session: DiagnosisSession, assembler: Assembler, test: StoredTest) -> None:
        self._session = session
        self._assembler = assembler
        self._test = test
        self._due = list(session.due_s(test))
        self._abandoned = False
        self._work: queue.SimpleQueue[FrameTable | None] = queue.SimpleQueue()
        self.ended_at: float | None = None
        """Time of the computer's message that the test is complete, `time.perf_counter`, s."""
        self.complete_recording: Recording | None = None
        """The test at that time if no frame was missing."""
        self._thread = threading.Thread(target=self._run, name="ehadiag-ahead", daemon=True)
        self._thread.start()

    def watch(self, progress: BitProgress) -> None:
        """Begin a stage once its frames are there; in the thread that collects frames."""
        due = False
        # Frames arrive within 20 ms after their tick.
        while self._due and progress.elapsed >= self._due[0] + 0.02:
            self._due.pop(0)
            due = True
        if due:
            self._work.put(self._assembler.table())

    def all_there(self) -> bool:
        """Assemble the complete test; return whether no frame of it can still arrive."""
        from ehadiag.assess.acceptance import is_complete_recording  # noqa: PLC0415 - loads kernels

        self.ended_at = time.perf_counter()
        recording = self._assembler.recording()
        if is_complete_recording(recording, self._test):
            self.complete_recording = recording
        return self.complete_recording is not None

    def finish(self, deadline: Deadline, stop: threading.Event) -> bool:
        """Identify from the newest frames, and wait; return whether it ended in time."""
        newest = None
        with contextlib.suppress(queue.Empty):
            while True:
                newest = self._work.get_nowait()
        if newest is not None:
            self._work.put(newest)
        self._work.put(None)
        while self._thread.is_alive() and not (deadline.passed or stop.is_set()):
            self._thread.join(0.05)
        return not self._thread.is_alive()

    def abandon(self) -> None:
        """Begin no further stage; the present one ends by itself."""
        self._abandoned = True
        self._work.put(None)

    def _run(self) -> None:
        while (table := self._work.get()) is not None:
            if self._abandoned:
                return
            # Errors of the recording are those of its diagnosis, which follows.
            with contextlib.suppress(Exception):
                self._session.feed(self._assembler.recording_of(table))


@contextmanager
def early_identification(
    session: DiagnosisSession, assembler: Assembler, test: StoredTest
) -> Iterator[EarlyIdentification]:
    """Identify during a test; an exception that ends the block abandons the identification."""
    ahead = EarlyIdentification(session, assembler, test)
    try:
        yield ahead
    except BaseException:
        ahead.abandon()
        raise


class BitView:
    """State of one test for its snapshots, which another thread makes.

    actuator: its data; test: the test; session: session that identifies while the test runs;
    bitrate: of the bus, bit/s; None: unknown; monitor: monitors the unit while the test runs; None:
    there are no residuals; by_status: whether the bus's own messages say that the test runs.
    """

    def __init__(
        self,
        actuator: Actuator,
        test: StoredTest,
        session: DiagnosisSession,
        bitrate: float | None,
        monitor: BitMonitor | None = None,
        *,
        by_status: bool = True,
    ) -> None:
        self._actuator, self._test, self._session = actuator, test, session
        self._monitor, self._by_status = monitor, by_status
        self._traffic = BusTraffic(bitrate)
        self._trace = SignalTrace()
        self._mode = CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT
        self._transport: Transport | None = None
        self._progress: BitProgress | None = None
        self._working = ""
        self._result: Result | None = None
        self.notes: tuple[str, ...] = ()

    def connected(self, transport: Transport) -> None:
        """Take the open bus."""
        self._transport = transport

    def take(self, frame: Frame) -> None:
        """Count a frame, and monitor it."""
        self._traffic.take(len(frame.data), extended=frame.extended)
        if self._monitor is not None:
            self._monitor.take(frame)

    def progress(self, progress: BitProgress) -> None:
        """Take the progress of the test."""
        self._progress = progress
        if self._monitor is not None and not self._by_status:
            from firmware_iface.live_decode import BitStatus  # noqa: PLC0415 - loads cantools

            running = progress.phase.name == BitState.RUNNING.name
            state = BitState.RUNNING if running else BitState.IDLE
            self._monitor.take_status(
                BitStatus(state, test_id=self._test.id, elapsed=progress.elapsed)
            )
        sample = progress.sample
        if sample is not None:  # for a bus without a monitor; frames alone do not tell its command
            values = (sample.current, sample.spool, sample.pressure, sample.position)
            self._trace.take(progress.elapsed, None, math.nan, values)

    def working(self, stage: str, share: float) -> None:
        """Take the progress of the identification."""
        self._working = f"identification: {stage} {share:.0%}"

    def ended(self, result: Result) -> None:
        """Take the verdict."""
        self._result = result

    def look(self, number: int) -> Snapshot:
        """Return a snapshot."""
        monitor = self._monitor
        count, alarms = (0, ()) if monitor is None else monitor.alarms
        trace = None if monitor is None else monitor.trace
        return Snapshot(
            number=number,
            time=utc_text(datetime.now(UTC)),
            command="bit",
            actuator=self._actuator.name,
            serial=self._serial(),
            bus=self._bus(),
            test=self._running(),
            mode=self._mode.name.lower(),
            signals=(self._trace if trace is None else trace).signals(),
            residuals=None if monitor is None else monitor.residuals,
            alarms=alarms,
            alarm_count=count,
            severities=self._severities(),
            working="" if self._result is not None else self._working,
            ending=self._ending(),
            notes=(*self.notes, monitor.why) if monitor is not None and monitor.why else self.notes,
        )

    def _ending(self) -> Ending | None:
        result = self._result
        if result is None:
            return None
        head = head_of(result, Levels(result.request.advisory, result.request.limit))
        return Ending(verdict=head.word, reasons=head.lines)

    def _serial(self) -> int | None:
        serial = None if self._monitor is None else self._monitor.serial
        if self._result is None or self._result.serial is None:
            return serial
        return self._result.serial

    def _bus(self) -> BusState:
        if self._transport is None:
            return BusState(name="", state="connecting")
        rate, load, silent = self._traffic.measure()
        state, result = self._transport.state.value, self._result
        return BusState(
            name=self._transport.name,
            state="silent" if silent and state == "open" else state,
            detail=self._transport.detail,
            frames=self._traffic.frames,
            rate_per_s=rate,
            load=load,
            lost=None if result is None or result.quality is None else result.quality.lost,
        )

    def _running(self) -> RunningTest:
        progress, duration = self._progress, self._test.duration
        elapsed = 0.0 if progress is None else min(progress.elapsed, duration)
        return RunningTest(
            name=self._test.name,
            number=self._test.id,
            phase="" if progress is None else progress.phase.name.lower(),
            elapsed_s=elapsed,
            duration_s=duration,
            left_s=duration - elapsed if elapsed and self._result is None else None,
        )

    def _severities(self) -> tuple[Severity, ...]:
        if self._result is not None and self._result.identified:
            return tuple(self._result.as_shown.severities.values())
        so_far = self._session.so_far
        if so_far is None or self._result is not None:
            return ()
        std: Mapping[str, float] = so_far.std or {}
        return tuple(
            Severity(name=name, estimate=value, std=finite(std.get(name)), source=so_far.stage)
            for name, value in so_far.values.items()
            if math.isfinite(value)
        )
