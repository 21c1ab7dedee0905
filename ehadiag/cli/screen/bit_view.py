"""What a running `ehadiag bit` looks like: made from what its threads keep anyway."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from ehadiag.core.actuator import Actuator
from ehadiag.core.dates import utc_text
from ehadiag.core.recording import CommandMode
from ehadiag.core.stored_test import StoredTest
from ehadiag.live.snapshot import Bus, Ending, RunningTest, Severity, Snapshot, known
from ehadiag.live.trace import Trace
from ehadiag.live.traffic import Traffic

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis, DiagnosisSession
    from ehadiag.cli.watch.in_test import InTest
    from firmware_iface.session.tester import Progress
    from firmware_iface.transport.frames import Frame
    from firmware_iface.transport.interface import Transport

__all__ = ["BitView"]


class BitView:
    """Keeps what is seen of one test; the thread of the publisher looks.

    Parameters
    ----------
    actuator : Actuator
        Its data.
    test : StoredTest
        The test.
    session : DiagnosisSession
        Works ahead while the test runs.
    begin : Callable[[], None]
        Called once the bus is open: from then on somebody may look.
    bitrate : float | None
        Of the bus, bit/s; None where it is not known.
    beside : InTest | None
        Monitors the unit while the test runs; None: nobody looks at residuals.
    """

    def __init__(
        self,
        actuator: Actuator,
        test: StoredTest,
        session: DiagnosisSession,
        begin: Callable[[], None],
        bitrate: float | None,
        beside: InTest | None = None,
    ) -> None:
        self._actuator, self._test, self._session, self._begin = actuator, test, session, begin
        self._beside = beside
        self._traffic = Traffic(bitrate)
        self._trace = Trace()
        self._command = test.command()
        self._mode = CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT
        self._transport: Transport | None = None
        self._progress: Progress | None = None
        self._working = ""
        self._diagnosis: Diagnosis | None = None
        self.notes: tuple[str, ...] = ()

    def connected(self, transport: Transport) -> None:
        """Show the session from now on."""
        self._transport = transport
        self._begin()

    def take(self, frame: Frame) -> None:
        """Count a frame, and monitor it."""
        self._traffic.take(len(frame.data), extended=frame.extended)
        if self._beside is not None:
            self._beside.take(frame)

    def progress(self, progress: Progress) -> None:
        """Take how far the test is."""
        self._progress = progress
        sample = progress.sample
        if sample is None:
            return
        place = round(progress.elapsed * self._test.rate)
        running = progress.elapsed > 0.0 and place < len(self._command)
        self._trace.take(
            progress.elapsed,
            self._mode if running else None,
            float(self._command[place]) if running else math.nan,
            (sample.current, sample.spool, sample.pressure, sample.position),
        )

    def working(self, stage: str, share: float) -> None:
        """Take what the identification does."""
        self._working = f"identification: {stage} {share:.0%}"

    def ended(self, diagnosis: Diagnosis) -> None:
        """Take the verdict."""
        self._diagnosis = diagnosis

    def look(self, number: int) -> Snapshot:
        """Return a snapshot."""
        beside = self._beside
        count, alarms = (0, ()) if beside is None else beside.alarms
        return Snapshot(
            number=number,
            time=utc_text(datetime.now(UTC)),
            command="bit",
            actuator=self._actuator.name,
            serial=self._serial(),
            bus=self._bus(),
            test=self._running(),
            mode=self._mode.name.lower(),
            signals=self._trace.signals(),
            residuals=None if beside is None else beside.residuals,
            alarms=alarms,
            alarm_count=count,
            severities=self._severities(),
            working=self._working,
            ending=self._ending(),
            notes=(*self.notes, beside.why) if beside is not None and beside.why else self.notes,
        )

    def _ending(self) -> Ending | None:
        diagnosis = self._diagnosis
        if diagnosis is None:
            return None
        verdict = diagnosis.verdict.name.replace("_", " ")
        return Ending(verdict=verdict, reasons=diagnosis.reasons)

    def _serial(self) -> int | None:
        heard = None if self._beside is None else self._beside.serial
        if self._diagnosis is None:
            return heard
        serials = (item.serial for item in self._diagnosis.recordings)
        return next((item for item in serials if item is not None), heard)

    def _bus(self) -> Bus:
        if self._transport is None:
            return Bus(name="", state="connecting")
        rate, load, silent = self._traffic.measure()
        state = self._transport.state.value
        return Bus(
            name=self._transport.name,
            state="silent" if silent and state == "open" else state,
            detail=self._transport.detail,
            frames=self._traffic.frames,
            rate_per_s=rate,
            load=load,
            lost=None if self._diagnosis is None else _lost(self._diagnosis),
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
            left_s=duration - elapsed if elapsed else None,
        )

    def _severities(self) -> tuple[Severity, ...]:
        if self._diagnosis is not None and self._diagnosis.identification is not None:
            estimates = self._diagnosis.identification.estimates
            return tuple(
                Severity(name=item.name, estimate=item.value, std=known(item.std), source="final")
                for item in estimates
            )
        so_far = self._session.so_far
        if so_far is None or self._diagnosis is not None:
            return ()
        std: Mapping[str, float] = so_far.std or {}
        return tuple(
            Severity(name=name, estimate=value, std=known(std.get(name)), source=so_far.stage)
            for name, value in so_far.values.items()
            if math.isfinite(value)
        )


def _lost(diagnosis: Diagnosis) -> int:
    return sum(item.quality.total("lost") for item in diagnosis.recordings)
