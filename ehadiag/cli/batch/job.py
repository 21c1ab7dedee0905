"""Reads and diagnoses one log: what this process and each worker of many do alike."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.cli.deadline import Deadline
from ehadiag.cli.interrupt import leave_interrupt_to_parent
from ehadiag.core.errors import EhadiagError, InputOutputError, NotTestedError
from ehadiag.facade.inputs import log_file
from ehadiag.report.asked import Asked, LogFile
from ehadiag.report.spent import Spent

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.core.actuator import Actuator
    from ehadiag.core.find_test import Sought
    from ehadiag.core.recording import Recording
    from ehadiag.core.stored_test import StoredTest
    from firmware_iface.logs.budget import Budget
    from firmware_iface.mapping.bus_map import BusMap
    from firmware_iface.signals.columns import ColumnMap

__all__ = ["Finding", "Job", "Reading", "failure", "labelled", "work"]


@dataclass(frozen=True, slots=True)
class Job:
    """What all logs of one call have in common; it is sent to the workers."""

    asked: Asked
    actuator: Actuator
    tests: tuple[StoredTest, ...]
    default: StoredTest | None
    """Test of recordings that do not say which they are of."""
    bus_map: BusMap
    columns: ColumnMap | None
    """Of recordings of decoded signals."""
    sought: Sought
    """What to look for where the bus does not say which test ran, and when."""
    budget: Budget
    every: bool
    """Every test of a log, not its last complete one."""
    draw: bool
    """Whether a picture is wanted."""
    folder: str
    """Working folder of the call, which names of logs start from."""
    label: str = ""
    """Tells its results from those of other actuators on the same bus; empty of the only one."""

    def read(self, *logs: str) -> Reading:
        """Read what is to be diagnosed of one recording.

        Parameters
        ----------
        *logs : str
            Files to read; several hold one recording.

        Returns
        -------
        Reading
            At least one recording, and the time that it took.

        Raises
        ------
        InputOutputError
            The log cannot be read.
        ConfigurationError
            Its kind is unknown.
        """
        from firmware_iface.logs.any_recording import (  # noqa: PLC0415 - loads cantools
            Meaning,
            recorded_tests,
        )
        from firmware_iface.logs.reader import choose  # noqa: PLC0415

        begin = time.perf_counter()
        meaning = Meaning(self.bus_map, self.columns, self.sought)
        tests = recorded_tests(logs, meaning, self.budget)
        # Of a long log's tests only one is held, unless all are wanted.
        found = tuple(tests) if self.every else (choose(tests),)
        if self.label:
            found = tuple(labelled(item, self.label) for item in found)
        return Reading(found, log_file(logs[0]), time.perf_counter() - begin)

    def diagnose(
        self, recordings: Sequence[Recording], progress: Callable[[str, float], None]
    ) -> Diagnosis:
        """Diagnose one actuator.

        Parameters
        ----------
        recordings : Sequence[Recording]
            Of the same actuator.
        progress : Callable[[str, float], None]
            Told each stage and the share of it that is done.

        Returns
        -------
        Diagnosis
            NOT TESTED where the time limit was reached.

        Raises
        ------
        KeyboardInterrupt
            The user does not want to wait.
        """
        from ehadiag.assess.diagnosis import diagnose  # noqa: PLC0415 - loads numba
        from ehadiag.identify.search.solvers import make_solver  # noqa: PLC0415
        from ehadiag.identify.session import Nuisances  # noqa: PLC0415

        begin = time.perf_counter()
        limit = self.asked.time_limit_s
        try:
            return diagnose(
                recordings,
                self.actuator,
                self.tests,
                default=self.default,
                levels=self.asked.levels,
                solver=make_solver(self.asked.solver),
                seed=self.asked.seed,
                nuisances=Nuisances(self.asked.nuisances),
                progress=progress if limit is None else Deadline(limit).watch(progress),
            )
        except NotTestedError as error:
            return self.not_tested(recordings, str(error), time.perf_counter() - begin)

    def not_tested(
        self, recordings: Sequence[Recording], why: str, elapsed: float = 0.0
    ) -> Diagnosis:
        """Return the verdict NOT TESTED of recordings that were not judged."""
        from ehadiag.assess.diagnosis import match_tests, not_tested  # noqa: PLC0415

        tests = match_tests(recordings, self.tests, self.default)
        return not_tested(recordings, tests, self.actuator, [why], elapsed)

    def name(self, log: str, suffix: str = "") -> str:
        """Return the name of a recording's files, without suffix."""
        return Path(log).stem + suffix + (f"-{self.label}" if self.label else "")


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What was read of one log."""

    recordings: tuple[Recording, ...]
    log: LogFile | None
    seconds: float

    def each(self) -> list[tuple[Recording, LogFile | None, str]]:
        """Each recording with its log, and what its files are called more than the log."""
        count = len(self.recordings)
        out = []
        for number, recording in enumerate(self.recordings, start=1):
            log = self.log and replace(self.log, number=number, results=count)
            out.append((recording, log, f"-{number}" if count > 1 else ""))
        return out


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """What came of one recording, or of a log that could not be read; small enough to be sent."""

    line: str
    """JSON object."""
    name: str
    """Of its files, without suffix."""
    error: str = ""
    """Why the log could not be read; empty where it was."""
    exit_code: int = 0
    diagnosis: Diagnosis | None = None
    """Without its samples; None where the log could not be read, or where it was done before."""
    spent: Spent | None = None
    picture: bytes | None = None
    """PNG; None where none was wanted, or none can be drawn."""


def work(job: Job, log: str) -> tuple[Finding, ...]:
    """Read and diagnose one log in a worker; whatever is wrong with it becomes a finding.

    Parameters
    ----------
    job : Job
        What is wanted.
    log : str
        File to read.

    Returns
    -------
    tuple[Finding, ...]
        At least one.
    """
    leave_interrupt_to_parent()
    with contextlib.suppress(OSError):  # a cluster's worker may not have it
        os.chdir(job.folder)
    os.environ.setdefault("EHADIAG_THREADS", "1")  # the processors are shared by the workers
    try:
        return _findings(job, log)
    except EhadiagError as error:
        return (failure(job, log, str(error), error.exit_code),)
    except Exception as error:
        text = (
            f"log {log}: unexpected {type(error).__name__}: {error}; diagnose it alone to see where"
        )
        return (failure(job, log, text, InputOutputError.exit_code),)


def failure(job: Job, log: str, error: str, exit_code: int) -> Finding:
    """Return the finding of a log that could not be read."""
    from ehadiag.report.json_line import error_line  # noqa: PLC0415 - loads the model's names

    line = error_line(log, error, exit_code, job.asked, job.actuator, log_file(log))
    return Finding(line, job.name(log), error, exit_code)


def _findings(job: Job, log: str) -> tuple[Finding, ...]:
    from ehadiag.report.json_line import json_line  # noqa: PLC0415

    reading = job.read(log)
    spent = Spent(reading.seconds)
    out = []
    for recording, file, suffix in reading.each():
        found = job.diagnose([recording], lambda _stage, _share: None)
        line = json_line(found, spent, job.asked, [file])
        picture = _picture(found, job) if job.draw else None
        small = replace(
            found,
            recordings=tuple(replace(item, samples=None) for item in found.recordings),
            experiments=(),
        )
        out.append(
            Finding(line, job.name(log, suffix), "", int(found.verdict), small, spent, picture)
        )
    return tuple(out)


def labelled(recording: Recording, label: str) -> Recording:
    """Return a recording with a note that tells it from those of other actuators on its bus."""
    notes = (*recording.quality.notes, f"actuator of mapping {label}")
    return replace(recording, quality=replace(recording.quality, notes=notes))


def _picture(diagnosis: Diagnosis, job: Job) -> bytes | None:
    from ehadiag.cli.drawing import can_be_drawn, drawn  # noqa: PLC0415

    return drawn(diagnosis, job.asked.levels) if can_be_drawn(diagnosis) else None
