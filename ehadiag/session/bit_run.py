"""A built-in test on a bus: requested or awaited, recorded, identified meanwhile, diagnosed.

Its snapshots show the test while it runs.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import msgspec
from msgspec.structs import replace

from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import finite, utc_text
from ehadiag.estimate import Severity
from ehadiag.live import (
    BusState,
    BusTraffic,
    Ending,
    RunningTest,
    SignalTrace,
    Snapshot,
    publish,
)
from ehadiag.records import log_of
from ehadiag.setup import Deadline, Setup
from firmware_iface.bus_map import BusMap
from firmware_iface.errors import ConfigurationError, InputOutputError, plain_name
from firmware_iface.files import unused_path
from firmware_iface.recording import (
    BitOutcome,
    BitState,
    Environment,
    Quality,
    Recording,
)
from firmware_iface.stored_test import RATE_TOLERANCE, StoredTest

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import DiagnosisSession
    from ehadiag.result import Result
    from ehadiag.session.monitor_session import BitMonitor
    from firmware_iface.handshake import ChannelLimits
    from firmware_iface.logs.recorder import Recorder
    from firmware_iface.tester import Assembler, BitProgress, RequestOutcome, RequestProtocol
    from firmware_iface.transport.base import Transport
    from firmware_iface.transport.frames import Frame, FrameTable
    from firmware_iface.xcp import XcpIds

STOPPED_REASON = "stopped by the user"
STOPPED_TWICE_REASON = "stopped by the user; the abort was requested, its answer not waited for"

Connection = AbstractContextManager[tuple["Transport", "Recorder | None"]]
"""Opens a bus and the recording of its frames; the test closes the recording."""


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
        with suppress(queue.Empty):
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
            with suppress(Exception):
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
        self._mode = test.command_mode
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
        from ehadiag.report.head import head_of  # noqa: PLC0415 - loads what prints

        head = head_of(result)
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


class BitSettings(msgspec.Struct, frozen=True, kw_only=True):
    """How a test is run."""

    transmit: bool
    """Whether the test is requested; otherwise one that somebody else starts is awaited."""
    limits: ChannelLimits | None = None
    """Values beyond which the test is aborted; None: none."""
    onboard_wait_s: float = 0.0
    """Time after the test in which the computer's own result is awaited, s."""
    bitrate: float | None = None
    """Of the bus, bit/s; None: unknown."""
    protocol: RequestProtocol = "native"
    """How the test is requested and watched."""
    own_fault: Callable[[], str] = str
    """Says after an incomplete test why this computer is the cause; empty where it is not."""


class BitTest:
    """One test of one actuator: `acquire`, then `diagnose`, within the context.

    setup: actuator, bus and options; its one test is run; settings: how the test is run; monitor:
    monitors the unit during the test; None: there are no residuals; progress: called with the stage
    and the share of it that is done, 0 … 1; snapshots: called four times a second while the bus is
    open and until the verdict, in a thread of its own.
    """

    def __init__(
        self,
        setup: Setup,
        settings: BitSettings,
        *,
        monitor: BitMonitor | None = None,
        progress: Callable[[str, float], None] | None = None,
        snapshots: Callable[[Snapshot], None] | None = None,
    ) -> None:
        from ehadiag.identify.identification_session import warm_up  # noqa: PLC0415 - loads kernels

        assert setup.default is not None
        self.setup, self.test, self._settings = setup, setup.default, settings
        self._progress, self._snapshots = progress, snapshots
        # Before the test: a verdict must not wait for the compiler.
        warm_up(setup.actuator, self.test)
        self._begin = time.perf_counter()
        self._session = setup.session([self.test])
        self._view = BitView(
            setup.actuator, self.test, self._session, settings.bitrate, monitor,
            by_status=settings.protocol == "native",
        )  # fmt: skip
        self._published = ExitStack()
        self._recording: Recording | None = None
        self._why = ""
        self._ended_at: float | None = None
        self._read_s = 0.0
        self._deadline = Deadline(math.inf)
        self.interrupted = False
        """Whether KeyboardInterrupt ended the acquisition or the diagnosis."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._published.close()

    def acquire(self, connection: Connection, source: str, stop: threading.Event) -> None:
        """Run the test on a bus, or wait for it; the recording is closed at the end.

        connection: bus and recording; entered here; source: name of the recording; stop: when set,
        the abort is requested. KeyboardInterrupt does not wait for its answer. EhadiagError: bus or
        recording cannot be opened, nothing may be sent on the bus.
        """
        from firmware_iface.tester import Assembler, run_test  # noqa: PLC0415 - loads python-can

        setup, settings, view, test = self.setup, self._settings, self._view, self.test
        assembler = Assembler(source, setup.bus_map)
        outcome, why, listened, bus = None, STOPPED_REASON, 0.0, ""
        with early_identification(self._session, assembler, test) as ahead:

            def on_progress(progress: BitProgress) -> None:
                ahead.watch(progress)
                view.progress(progress)
                self._report(f"test {test.name}", min(progress.elapsed / test.duration, 1.0))

            def on_frame(frame: Frame) -> None:
                assembler.add(frame)
                view.take(frame)

            try:
                with connection as (transport, recorder):
                    bus = transport.name
                    self._publish(transport)
                    began = time.monotonic()
                    # From here on a second signal does not wait for the answer to the abort.
                    why = STOPPED_TWICE_REASON if settings.transmit else STOPPED_REASON
                    try:
                        outcome = run_test(
                            transport,
                            test_id=test.id,
                            duration=test.duration,
                            transmit=settings.transmit,
                            recorder=recorder,
                            bus_map=setup.bus_map,
                            limits=settings.limits,
                            on_frame=on_frame,
                            stop=stop,
                            progress=on_progress,
                            all_there=ahead.all_there,
                            onboard_wait=settings.onboard_wait_s,
                            protocol=settings.protocol,
                        )
                    except InputOutputError as error:  # of the recording; the abort was requested
                        why = str(error)
                    listened = time.monotonic() - began
            except KeyboardInterrupt:
                self.interrupted = True
            self._deadline = Deadline(setup.request.time_limit_s or math.inf)
            if ahead.complete_recording is not None:
                recording = ahead.complete_recording
            elif len(assembler):
                recording = assembler.recording()
            else:
                state = BitOutcome() if outcome is None else outcome.outcome
                recording = Recording(source, None, None, None, state, Environment(), Quality())
            if outcome is not None:
                recording = _with_outcome(recording, outcome)
                why = outcome.why
                if outcome.degraded:
                    view.notes = (outcome.degraded,)
            if outcome is None or not outcome.complete:
                ahead.abandon()
            if outcome is not None and not outcome.complete:
                why = ("" if stop.is_set() else settings.own_fault()) or (
                    why + _traffic_text(recording, bus, listened)
                )
            elif outcome is not None and not _finish_identification(ahead, self._deadline, stop):
                ahead.abandon()
                passed = self._deadline.passed
                why = self._deadline.reason("work ahead") if passed else STOPPED_REASON
        self._recording, self._why = setup.labelled(recording), why
        self._ended_at = ahead.ended_at
        self._read_s = time.perf_counter() - self._begin

    def diagnose(self, stop: threading.Event) -> Result:
        """Return the result of the acquired test; NOT TESTED after a stop."""
        assert self._recording is not None
        recordings, why, source = [self._recording], self._why, self._recording.source
        recorded = log_of(source)
        origin: Any = {
            "files": [source] if recorded else [],
            "logs": [recorded],
            "read_s": self._read_s,
            "ended_at": self._ended_at,
        }
        result = None
        if stop.is_set() and not why:
            why = STOPPED_REASON
        if not why:
            try:
                result = self.setup.diagnose(
                    recordings,
                    session=self._session,
                    deadline=self._deadline,
                    progress=self._report_stage,
                    **origin,
                )
            except KeyboardInterrupt:
                self.interrupted, why = True, STOPPED_REASON
        if result is None:
            result = self.setup.not_tested(recordings, why, **origin)
        self._view.ended(result)
        self._published.close()
        return result

    def _publish(self, transport: Transport) -> None:
        self._view.connected(transport)
        if self._snapshots is not None:
            self._published.enter_context(publish(self._view.look, self._snapshots))

    def _report_stage(self, stage: str, share: float) -> None:
        self._view.working(stage, share)
        self._report(stage, share)

    def _report(self, stage: str, share: float) -> None:
        if self._progress is not None:
            self._progress(stage, share)


def listen_for_tests(
    tests: Sequence[BitTest],
    transport: Transport,
    recorder: Recorder,
    source: str,
    stop: threading.Event,
) -> None:
    """Let several actuators' tests listen to one bus, each in a thread of its own.

    transport: the bus; to be closed by the caller; recorder: gets each frame once; closed at the
    end; stop: ends all; set where one of them fails. EhadiagError: the bus or a listener failed.
    """
    from firmware_iface.logs.recorder import SharedBus  # noqa: PLC0415 - loads python-can

    with (
        SharedBus(transport, len(tests), recorder) as shared,
        ThreadPoolExecutor(len(tests), thread_name_prefix="ehadiag-listen") as pool,
    ):
        futures = [
            pool.submit(test.acquire, nullcontext((branch, None)), source, stop)
            for test, branch in zip(tests, shared.branches, strict=True)
        ]
        try:
            for future in futures:
                future.result()
        except BaseException:
            stop.set()
            raise


def measured_by_xcp(
    bus: Transport, setup: Setup, test: StoredTest, ids: XcpIds, protocol: RequestProtocol
) -> Transport:
    """Return a bus whose commands and channels are those that XCP measures.

    bus: opened to send, it stays open; ids: identifiers of the computer's slave; protocol: by which
    the test is requested. ConfigurationError, InputOutputError: see `XcpTransport`.
    """
    from ehadiag_sim.simulation import scales_of  # noqa: PLC0415 - loads numpy
    from firmware_iface.xcp_master import XcpTransport  # noqa: PLC0415 - loads cantools

    channels = scales_of(setup.bus_map, setup.actuator).channels
    return XcpTransport(bus, setup.bus_map, channels, test.command_mode, ids, uds=protocol == "uds")


def recording_path(folder: Path, test: StoredTest) -> Path:
    """Return a file name for the recording of a test, now, that does not exist yet."""
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    return unused_path(folder, f"{stamp}-{plain_name(test.name)}", ".blf")


def refuse_untestable(
    test: StoredTest,
    actuator: Actuator,
    bus_map: BusMap,
    *,
    transmit: bool,
    protocol: RequestProtocol = "native",
) -> None:
    """Refuse a test that could not end in a verdict, before the surface moves.

    bus_map: the bus that will carry the test. ConfigurationError: different rates, a bus on which
    the test cannot be requested, or its end not seen.
    """
    from firmware_iface.handshake import HandshakeAction  # noqa: PLC0415 - loads cantools
    from firmware_iface.tester import requester_of  # noqa: PLC0415 - loads cantools

    rates = {
        f"test {test.name!r}": test.rate,
        f"controller of actuator {actuator.name!r}": actuator.controller.rate,
        "mapping of the bus": 1e9 / bus_map.tick_ns,
    }
    if max(rates.values()) > min(rates.values()) * (1.0 + RATE_TOLERANCE):
        each = ", ".join(f"{name} {rate:g} Hz" for name, rate in rates.items())
        raise ConfigurationError(f"different rates: {each}")
    if protocol != "native" and not transmit:
        raise ConfigurationError(
            f"--listen sends nothing, --protocol {protocol} asks: leave one out"
        )
    if transmit:
        requester = requester_of(bus_map, protocol)
        for action in HandshakeAction:
            requester.request(action, test.id, 0)
    elif bus_map.find("status.state") is None:
        raise ConfigurationError(
            f"--listen: the mapping {bus_map.name} has no status.state, and nothing else tells when"
            " a test begins and ends: record with another tool, and find the test by ehadiag"
            " diagnose"
        )


def _finish_identification(
    ahead: EarlyIdentification, deadline: Deadline, stop: threading.Event
) -> bool:
    """Wait for the identification under way; a signal or the time limit ends the wait."""
    with suppress(KeyboardInterrupt):
        return ahead.finish(deadline, stop)
    return False


def _with_outcome(recording: Recording, outcome: RequestOutcome) -> Recording:
    """Return a recording with what its outcome says of the computer and its unit."""
    from firmware_iface.alignment.episodes import NO_STATUS_NOTE  # noqa: PLC0415 - loads python-can

    serial = outcome.serial if recording.serial is None else recording.serial
    onboard = outcome.onboard if outcome.onboard is not None else recording.onboard
    notes, ended = [*recording.quality.notes, *outcome.notes], recording.outcome
    if ended.state is None and outcome.outcome.state is not None:  # no status but on request
        ended = outcome.outcome
        notes = [note for note in notes if note != NO_STATUS_NOTE]
    quality = replace(recording.quality, notes=tuple(notes))
    return replace(recording, serial=serial, onboard=onboard, outcome=ended, quality=quality)


def _traffic_text(recording: Recording, bus: str, listened: float) -> str:
    """Return what tells a silent bus from a foreign one, for the end of a reason."""
    quality = recording.quality
    if quality.total("received"):
        return ""
    if not quality.foreign:
        return f"; {bus} was silent for {listened:.1f} s"
    return (
        f"; {quality.foreign} frames heard on {bus} in {listened:.1f} s, none that the mapping "
        "knows: see ehadiag check-bus"
    )
