"""From a request to a result: the one way, of commands, workers and Python alike."""

from __future__ import annotations

import copy
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypedDict, TypeVar, Unpack

import msgspec
from msgspec.structs import replace

from ehadiag.assess.verdict import Verdict
from ehadiag.core.actuator import Actuator, default_actuator, load_actuator, with_tolerance
from ehadiag.core.conventions import fingerprint
from ehadiag.core.interruption import COMPUTING_THREAD_NAME
from ehadiag.estimate import Severity
from ehadiag.records import failed_result, log_of, result_of, sources_of
from ehadiag.request import Request
from ehadiag.result import Log, Origin, Result, Sources, load_result
from firmware_iface import FREE_MOTION
from firmware_iface.errors import ConfigurationError, EhadiagError, NotTestedError, valid_text
from firmware_iface.find_test import CandidateTests
from firmware_iface.stored_test import StoredTest, bundled_tests, resolve_test

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis, DiagnosisSession
    from ehadiag.history.store import HistorySnapshot
    from ehadiag.identify.identification_session import EarlierEstimate
    from ehadiag.identify.solvers import Solver
    from firmware_iface.bus_map import BusMap
    from firmware_iface.logs.log_files import Budget
    from firmware_iface.recording import Recording
    from firmware_iface.signals.columns import ColumnMap

Progress = Callable[[str, float], None]
"""Is called with a stage and its share done, 0 … 1."""
MAX_OVERTIME_S = 0.5
"""Seconds after its time in which a computation may end by itself, at its next report."""

T = TypeVar("T")


PathLike: TypeAlias = str | os.PathLike[str]


def resolve_actuator(given: Actuator | PathLike | None) -> Actuator:
    """Return the actuator itself, or that of a file (`load_actuator`); None: the reference."""
    if given is None:
        return default_actuator()
    return given if isinstance(given, Actuator) else load_actuator(os.fspath(given))


def resolve_stored_test(given: StoredTest | PathLike) -> StoredTest:
    """Return the test itself, the stored one of that name, or that of a file (`resolve_test`)."""
    return given if isinstance(given, StoredTest) else resolve_test(os.fspath(given))


def stored_tests_with(given: Iterable[StoredTest | PathLike]) -> tuple[StoredTest, ...]:
    """Return the stored tests and the given ones; of one number the one given last."""
    tests = {test.id: test for test in bundled_tests().values()}
    for item in given:
        test = resolve_stored_test(item)
        tests[test.id] = test
    return tuple(tests.values())


def resolve_bus_map(mapping: BusMap | PathLike | None, dbc: PathLike | None) -> BusMap:
    """Return the meaning of the bus's frames (`load_map`); None: of the computer's own bus.

    Parameters
    ----------
    mapping : BusMap | PathLike | None
        The meaning itself, or a mapping file.
    dbc : PathLike | None
        DBC to use instead of the mapping file's own; without a mapping file, one with the default
        names.

    Returns
    -------
    BusMap
        What each signal is.

    Raises
    ------
    ConfigurationError
        A DBC beside a meaning, or one of other names without a mapping file.
    """
    from firmware_iface.bus_map import default_map, load_map  # noqa: PLC0415

    other = None if dbc is None else os.fspath(dbc)
    if isinstance(mapping, str | os.PathLike):
        return load_map(os.fspath(mapping), other)
    if mapping is None:
        return default_map(other)
    if other is not None:
        raise ConfigurationError("dbc: the meaning of the frames is given already")
    return mapping


class RecordingOrigin(TypedDict, total=False):
    """Where the recordings of a diagnosis are from."""

    files: Sequence[str]
    """That they were read from; empty where they were at hand."""
    logs: Sequence[Log | None]
    read_s: float
    """Time of reading or acquiring them, s."""
    ended_at: float | None
    """When a live test ended, on `time.perf_counter`."""


class Deadline:
    """A number of seconds, wall clock, from now on: the time limit of an identification.

    The identification reports its progress between two generations of a search and two rounds of a
    refinement, 16 to 32 runs of the model apart; it ends there.

    seconds: how long; clock: gives the time, s; another one than the system's only in tests.
    """

    def __init__(self, seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._seconds = seconds
        self._clock = clock
        self._end = clock() + seconds

    @property
    def passed(self) -> bool:
        """Whether the time is over."""
        return self._clock() >= self._end

    def watch(self, progress: Progress) -> Progress:
        """Return a progress report that ends what reports to it when the time is over.

        progress: report that it hands on to. Returns report of a stage and the share of it that is
        done; it raises NotTestedError once the time is over.
        """

        def report(stage: str, share: float) -> None:
            if self.passed:
                raise NotTestedError(self.reason(stage))
            progress(stage, share)

        return report

    def run(self, work: Callable[[Progress], T], progress: Progress) -> T:
        """Call a function in a thread of its own, and wait for it until the time is over.

        The caller goes on then, whether or not the function reports its progress. One that is
        left behind ends at its next report.

        work: function, called with the progress report that it is to use. Returns result of the
        function, whose exceptions are raised here too. NotTestedError: the time is over.
        """
        stages = ["beginning"]
        left_behind = threading.Event()
        watched = self.watch(progress)
        result: Future[T] = Future()

        def report(stage: str, share: float) -> None:
            stages[0] = stage
            if left_behind.is_set():
                raise NotTestedError(self.reason(stage))
            watched(stage, share)

        def compute() -> None:
            try:
                result.set_result(work(report))
            except BaseException as error:
                result.set_exception(error)

        threading.Thread(target=compute, name=COMPUTING_THREAD_NAME, daemon=True).start()
        try:
            # On Windows a longer wait holds up Ctrl-C.
            while not wait([result], 0.1).done:
                if self._clock() > self._end + MAX_OVERTIME_S:
                    raise NotTestedError(self.reason(stages[0]))
        finally:
            left_behind.set()
        return result.result()

    def reason(self, stage: str) -> str:
        """Say why there is no estimate."""
        return f"no estimate within {self._seconds:g} s: given up in the {stage} (see --time-limit)"


class RecordedTest(msgspec.Struct, frozen=True, eq=False):
    """What was read of one recording's files."""

    recordings: tuple[Recording, ...]
    files: tuple[str, ...]
    log: Log | None
    seconds: float

    def each(self) -> list[tuple[Recording, Log | None]]:
        """Each recording with its log."""
        count = len(self.recordings)
        return [
            (item, self.log and msgspec.structs.replace(self.log, result=number, results=count))
            for number, item in enumerate(self.recordings, start=1)
        ]


@dataclass(frozen=True, eq=False)
class Setup:
    """What a request names, loaded when it is first used; it can be sent to workers."""

    request: Request
    objects: Mapping[str, Any] = field(default_factory=dict)
    """Given as objects, not by name, by the fields of the request: `actuator`, `test`, `mapping`,
    `columns`, `solver`, `prior`; and `candidates`, tests to look for."""
    history: HistorySnapshot | None = None
    """Health history whose last diagnosis of a unit a new one may begin from."""
    label: str = ""
    """Tells its results from those of other actuators on the same bus; empty of the only one."""

    def with_history(self, history: HistorySnapshot | None) -> Setup:
        """Return the same with a health history; what is loaded already is kept."""
        found = copy.copy(self)
        vars(found)["history"] = history
        return found

    @cached_property
    def actuator(self) -> Actuator:
        """Data of the actuator, with the tolerance that was asked for."""
        found = resolve_actuator(self.objects.get("actuator", self.request.actuator))
        tolerance = self.request.tolerance
        return found if tolerance is None else with_tolerance(found, tolerance)

    @cached_property
    def named_tests(self) -> tuple[StoredTest, ...]:
        """Tests that the request names besides the stored ones."""
        return tuple(map(resolve_stored_test, self.objects.get("test", self.request.test)))

    @cached_property
    def tests(self) -> tuple[StoredTest, ...]:
        """All tests that a recording may be of; of one number the one named last."""
        return stored_tests_with(self.named_tests)

    @property
    def default(self) -> StoredTest | None:
        """Test of recordings that do not say which they are of."""
        return self.named_tests[0] if len(self.named_tests) == 1 else None

    @cached_property
    def bus_map(self) -> BusMap:
        """Meaning of the bus's frames."""
        given = self.objects.get("mapping", None if self._maps_columns else self.request.mapping)
        found = resolve_bus_map(given, None if self._maps_columns else self.request.dbc)
        if self.request.id_offset is not None:
            found = found.shifted(self.request.id_offset)
        channel = self.request.log_channel
        return found if channel is None else replace(found, channel=channel)

    @cached_property
    def columns(self) -> ColumnMap | None:
        """Meaning of the columns of decoded signals; None: by their names."""
        if "columns" in self.objects:
            found: ColumnMap = self.objects["columns"]
            return found
        if not (self._maps_columns or self.request.columns):
            return None
        from firmware_iface.signals.columns import ColumnMap, load_columns, named_columns  # noqa: PLC0415 - loads numpy

        known = load_columns(self.request.mapping or "") if self._maps_columns else ColumnMap()
        return named_columns(list(self.request.columns), known)

    @cached_property
    def _maps_columns(self) -> bool:
        """Whether the mapping file is one of columns."""
        if self.request.mapping is None or "mapping" in self.objects:
            return False
        from firmware_iface.files import (  # noqa: PLC0415
            MAX_TOML_BYTES,
            read_small_file,
        )
        from firmware_iface.signals.columns import COLUMNS_SCHEMA  # noqa: PLC0415

        text = read_small_file(Path(self.request.mapping), MAX_TOML_BYTES, "mapping file")
        return f'"{COLUMNS_SCHEMA}"'.encode() in text

    @property
    def budget(self) -> Budget:
        """What reading a recording may cost."""
        from firmware_iface.logs.log_files import Budget  # noqa: PLC0415

        return Budget(
            frames=self.request.max_frames,
            size=self.request.max_log_bytes,
            seconds=self.request.max_read_time_s,
        )

    @property
    def candidate_tests(self) -> CandidateTests:
        """What to look for in a recording whose bus does not say when which test ran."""
        if "candidates" in self.objects:
            found: CandidateTests = self.objects["candidates"]
            return found
        tests = (self.default,) if self.default else self.tests
        request = self.request
        return CandidateTests(tests, self.actuator.controller, request.start_s, request.end_s)

    @cached_property
    def solver(self) -> Solver:
        """The search."""
        from ehadiag.identify.solvers import make_solver  # noqa: PLC0415 - loads kernels

        found: Solver = self.objects.get("solver") or make_solver(self.request.solver)
        return found

    @cached_property
    def sources(self) -> Sources:
        """Fingerprints of what the request names."""
        tests = (self.default,) if self.default else self.tests
        solver = self.solver.name if "solver" in self.objects else None
        names = self.bus_map.name, self.request.mapping
        return sources_of(tests, self.columns, self.bus_map, *names, solver)

    @cached_property
    def prior(self) -> Result | None:
        """Result that was named to begin from.

        ConfigurationError: nothing can begin from it.
        """
        found: Result | None = self.objects.get("prior")
        if found is None and self.request.prior is not None:
            found = load_result(Path(self.request.prior))
        if found is not None:
            reason = self._objection_to_prior(found)
            if reason:
                raise ConfigurationError(f"prior {self.request.prior or 'result'}: {reason}")
        return found

    def _objection_to_prior(self, found: Result) -> str:
        """Why nothing can begin from a result; empty if it can."""
        if not found.identified or found.verdict is Verdict.NOT_TESTED:
            return "NOT TESTED, name a result with a verdict"
        if found.actuator_sha256 != fingerprint(self.actuator):
            return "by other actuator data than this diagnosis"
        return ""

    def earlier(self, recordings: Sequence[Recording]) -> EarlierEstimate | None:
        """Return what the last diagnosis of the recordings' unit found; None where none is known.

        The result that was named, else the last one in the history: of the same serial number, by
        the same actuator data, and not of these recordings.
        """
        serial = next((item.serial for item in recordings if item.serial is not None), None)
        found, words = self.prior, f"result {self.request.prior or 'given'}"
        if found is None and self.history is not None and serial is not None:
            found, words = self.history.last_result(serial, self.actuator.name, recordings)
        if found is None or found.serial != serial or self._objection_to_prior(found):
            return None
        from ehadiag.identify.identification_session import EarlierEstimate  # noqa: PLC0415 - loads kernels

        values = {name: item.value for name, item in found.severities.items()}
        return EarlierEstimate(values, words)

    def session(
        self,
        tests: Sequence[StoredTest] | None = None,
        earlier: EarlierEstimate | None = None,
    ) -> DiagnosisSession:
        """Begin a diagnosis that can be fed a running test.

        tests: that a recording may be of; None: all; earlier: see `DiagnosisSession`. Returns for
        `diagnose`.
        """
        from ehadiag.assess.diagnosis import DiagnosisSession  # noqa: PLC0415 - loads kernels
        from ehadiag.identify.identification_session import NuisanceMode  # noqa: PLC0415

        return DiagnosisSession(
            self.actuator,
            self.tests if tests is None else tests,
            default=self.default,
            levels=self.request.levels,
            solver=self.solver,
            seed=self.request.seed,
            nuisances=NuisanceMode(self.request.nuisances),
            earlier=earlier,
        )

    def open(self, *files: PathLike, progress: Progress | None = None) -> Iterator[Recording]:
        """Read the tests that one recording holds, in order of time.

        files: files to read; several hold one recording; progress: called with the stage and the
        share of a file that is read. Returns at least one; without samples where there is no test.
        InputOutputError: a file cannot be read; ConfigurationError: its kind is unknown.
        """
        from firmware_iface.signals.recordings import Interpretation, recorded_tests  # noqa: PLC0415 - loads cantools

        meaning = Interpretation(self.bus_map, self.columns, self.candidate_tests)
        budget = self.budget
        if progress is not None:
            budget = replace(budget, progress=partial(progress, "reading"))
        return iter(recorded_tests([os.fspath(item) for item in files], meaning, budget))

    def read(self, *files: PathLike, progress: Progress | None = None) -> RecordedTest:
        """Read what is to be diagnosed of one recording; see `open`.

        files: files to read; several hold one recording; progress: called with the stage and the
        share of a file that is read. Returns at least one recording, and the time that it took.
        """
        from firmware_iface.signals.recordings import choose_recording  # noqa: PLC0415 - loads cantools

        begin = time.perf_counter()
        tests = self.open(*files, progress=progress)
        # Of a long log's tests only one is held, unless all are wanted.
        found = tuple(tests) if self.request.every_test else (choose_recording(tests),)
        if self.label:
            found = tuple(self.labelled(item) for item in found)
        names = tuple(os.fspath(item) for item in files)
        return RecordedTest(found, names, log_of(names[0]), time.perf_counter() - begin)

    def labelled(self, recording: Recording) -> Recording:
        """Return a recording with a note that tells it from those of other units on its bus."""
        if not self.label:
            return recording
        notes = (*recording.quality.notes, f"actuator of mapping {self.label}")
        return replace(recording, quality=replace(recording.quality, notes=notes))

    def diagnose(
        self,
        recordings: Sequence[Recording],
        *,
        progress: Progress | None = None,
        session: DiagnosisSession | None = None,
        deadline: Deadline | None = None,
        **origin: Unpack[RecordingOrigin],
    ) -> Result:
        """Diagnose one actuator.

        progress: called with each stage and the share of it that is done; where there is a
        deadline, in another thread; session: that was fed while the test ran; deadline: that has
        begun already; None: the request's time limit from now on. Returns NOT TESTED where the time
        limit was reached. KeyboardInterrupt: the progress report raised it.
        """
        begin = time.perf_counter()
        limit = self.request.time_limit_s
        report = progress or _silent
        if deadline is None and limit is not None:
            deadline = Deadline(limit)
        try:
            session = session or self.session(earlier=self.earlier(recordings))
            work = partial(session.finish, recordings)
            found = work(report) if deadline is None else deadline.run(work, report)
        except NotTestedError as error:
            found = self._not_tested(recordings, str(error), time.perf_counter() - begin)
        return self.result(found, **origin)

    def not_tested(
        self, recordings: Sequence[Recording], why: str, **origin: Unpack[RecordingOrigin]
    ) -> Result:
        """Return the result NOT TESTED of recordings that were not judged; as `diagnose`."""
        return self.result(self._not_tested(recordings, why), **origin)

    def result(self, diagnosis: Diagnosis, **origin: Unpack[RecordingOrigin]) -> Result:
        """Put a diagnosis down with what it was asked for; as `diagnose`."""
        files, logs = origin.get("files", ()), origin.get("logs", ())
        ended_at = origin.get("ended_at")
        merge = self.request.merge
        joint = len(diagnosis.recordings) > 1 and not merge
        request = msgspec.structs.replace(
            self.request, logs=tuple(files), joint=joint, merge=merge and len(files) > 1
        )
        at_hand = not files and not any(logs)
        return result_of(
            diagnosis,
            request,
            sources=self._sources_at_hand if at_hand else self.sources,
            logs=logs,
            read_s=origin.get("read_s", 0.0),
            after_test_s=None if ended_at is None else time.perf_counter() - ended_at,
        )

    def monitored(
        self,
        source: str,
        date: str | None,
        serial: int | None,
        severities: Sequence[Severity],
        why: tuple[str, ...],
    ) -> Result:
        """Return severities by free motion as a result: NOT TESTED, for no test ran.

        source: bus or log; date: of its beginning; serial: of the unit; why: some have no number.
        """
        empty = failed_result(source, "", 0, self.request, self.actuator, sources=self.sources)
        advised = {
            item.name: msgspec.structs.replace(item, advice=empty.severities[item.name].advice)
            for item in severities
        }
        return msgspec.structs.replace(
            empty, test=FREE_MOTION, serial=serial, state="NOT_TESTED", reasons=why,
            severities=empty.severities | advised, error=None, date=date,
            origins=(Origin(
                source=valid_text(source), date=date, length_s=None, serial=serial, channel=None,
                test=None, oil_temperature_degC=None, supply_pressure_MPa=None,
                return_pressure_MPa=None, log=log_of(source), onboard=None,
            ),),
        )  # fmt: skip

    def failure(self, log: str, error: str, exit_code: int) -> Result:
        """Return the result of a log that could not be read."""
        request = msgspec.structs.replace(self.request, logs=(log,), joint=False, merge=False)
        return failed_result(
            log, error, exit_code, request, self.actuator, sources=self.sources, log=log_of(log)
        )

    def each(self, *files: str, progress: Progress | None = None) -> Iterator[Result]:
        """Read and diagnose one recording; what cannot be read has a result too.

        files: files to read; several hold one recording; progress: called with each stage and the
        share of it that is done. Yields at least one; several where every test is asked for.
        """
        try:
            reading = self.read(*files, progress=progress)
        except EhadiagError as error:
            yield self.failure(files[0], str(error), error.exit_code)
            return
        for recording, log in reading.each():
            yield self.diagnose(
                [recording],
                files=reading.files,
                logs=[log],
                read_s=reading.seconds,
                progress=progress,
            )

    def name(self, log: str, result: Result) -> str:
        """Return the name of a result's files, without suffix."""
        of = result.origins[0].log if len(result.origins) == 1 else None
        number = f"-{of.result}" if of is not None and of.results > 1 else ""
        return Path(log).stem + number + (f"-{self.label}" if self.label else "")

    @property
    def _sources_at_hand(self) -> Sources:
        tests = (self.default,) if self.default else self.tests
        solver = self.solver.name if "solver" in self.objects else None
        return Sources(tests_sha256=fingerprint(tests), solver=solver)

    def _not_tested(
        self, recordings: Sequence[Recording], why: str, elapsed: float = 0.0
    ) -> Diagnosis:
        from ehadiag.assess.diagnosis import match_tests, not_tested  # noqa: PLC0415

        tests = match_tests(recordings, self.tests, self.default)
        return not_tested(recordings, tests, self.actuator, [why], elapsed)


def _silent(_stage: str, _share: float) -> None:
    """Report nothing."""
