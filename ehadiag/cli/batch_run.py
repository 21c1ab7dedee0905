"""One call of `ehadiag diagnose` over its recordings: here, in workers, or from an earlier call."""

from __future__ import annotations

import argparse
import contextlib
import os
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import NamedTuple

import msgspec

from ehadiag.batch.journal import ResultJournal
from ehadiag.batch.result_files import (
    JUNIT_NOT_TESTED,
    RESULT_SUFFIXES,
    TABLE_FORMATS,
    ResultSink,
    junit_report,
    result_file_suffix,
    write_summary,
)
from ehadiag.batch.workers import Workers, worker_count
from ehadiag.cli.options import positive_count
from ehadiag.cli.result_output import ResultWriter
from ehadiag.core.interruption import (
    INTERRUPTED_EXIT_CODE,
    defer_signals,
    ignore_interrupt_in_worker,
    interrupt_on_signals,
)
from ehadiag.report.rendering import diagnosis_png
from ehadiag.result import Log, Result
from ehadiag.setup import Setup
from ehadiag.terminal.output import (
    INPUT_OUTPUT_EXIT_CODE,
    BatchSummary,
    counting_bar,
    exit_code_of_inputs,
    print_compiling_notice,
    print_status,
    progress_bar,
    report_failure,
    summary_lines,
    worst_exit_code,
)
from firmware_iface.errors import (
    EhadiagError,
    InputOutputError,
)
from firmware_iface.recording import Recording

MIN_RECORDINGS_FOR_SUMMARY = 5
"""Recordings from which on a summary is told unasked."""


def add_batch_options(parser: argparse.ArgumentParser) -> None:
    """Add workers, and the files that hold the results of all recordings."""
    group = parser.add_argument_group("many recordings")
    group.add_argument(
        "--jobs",
        type=positive_count,
        metavar="N",
        help="worker processes (default: as many as there are processors, fewer for a few"
        " recordings; 1: none beside this one)",
    )
    group.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="use the Dask cluster whose scheduler is there, such as tcp://host:8786; its workers"
        " read the logs under the same paths",
    )
    group.add_argument(
        "--results",
        action="append",
        default=[],
        metavar="FILE",
        help=f"write all results to it: {', '.join(RESULT_SUFFIXES)}; repeatable",
    )
    group.add_argument(
        "--resume",
        metavar="FILE",
        help="as --results with a .jsonl of an earlier call, whose results are not found anew",
    )
    group.add_argument("--junit", metavar="FILE", help="write a JUnit report for build servers")
    group.add_argument(
        "--junit-not-tested",
        choices=JUNIT_NOT_TESTED,
        default=JUNIT_NOT_TESTED[0],
        help="what NOT TESTED is in it (default %(default)s)",
    )
    group.add_argument("--summary", metavar="FILE", help="write the counts of all as JSON")


def diagnose_and_deliver(
    setup: Setup,
    results: ResultWriter,
    recordings: Sequence[Recording],
    files: Sequence[str],
    logs: Sequence[Log | None],
    read_s: float,
    name: str | None = None,
) -> tuple[Result, int]:
    """Diagnose in this process, and deliver the result; return it and its exit code.

    recordings: of one actuator; files: that they were read from; read_s: time of reading, s; name:
    of the files, without suffix; None: after the log. Returns the code is the verdict's, or 3 where
    something could not be written and that is worse.
    """
    try:
        interrupt_on_signals()
        if results.stopped:
            raise KeyboardInterrupt
        with progress_bar() as progress:
            found = setup.diagnose(
                recordings, files=files, logs=logs, read_s=read_s, progress=progress
            )
    except KeyboardInterrupt:
        results.stopped = True
        found = setup.not_tested(
            recordings, "stopped by the user", files=files, logs=logs, read_s=read_s
        )
    return found, results.deliver(found, name or setup.name(files[0], found))


class Finding(NamedTuple):
    """What a worker sends back of one recording, or of a log that could not be read."""

    result: Result
    picture: bytes | None = None
    """PNG; None where none was wanted, or none can be drawn."""


def _run_task(
    setups: Sequence[Setup], folder: str, task: _BatchTask, *, draw: bool
) -> tuple[Finding, ...]:
    """Read and diagnose one log in a worker; whatever is wrong with it becomes a finding.

    setups: what is wanted, of each actuator; folder: working folder of the call, which names of
    logs start from; task: log and actuator. Returns at least one.
    """
    setup, log = setups[task.unit], task.item.name
    ignore_interrupt_in_worker()
    with contextlib.suppress(OSError):  # a cluster's worker may not have it
        os.chdir(folder)
    os.environ.setdefault("EHADIAG_THREADS", "1")  # the processors are shared by the workers
    try:
        return tuple(
            Finding(result, diagnosis_png(result) if draw and result.can_be_drawn else None)
            for result in setup.each(log)
        )
    except Exception as error:
        return (Finding(_unexpected(setup, log, error)),)


def _unexpected(setup: Setup, log: str, error: Exception) -> Result:
    """Return the result of a log that an error of the program kept from being diagnosed."""
    text = f"log {log}: unexpected {type(error).__name__}: {error}; diagnose it alone to see where"
    return setup.failure(log, text, InputOutputError.exit_code)


class _BatchTask(msgspec.Struct, frozen=True):
    """One recording to diagnose for one of the actuators on its bus."""

    unit: int
    """Place of the actuator's setup."""
    item: LogInput


class BatchRun:
    """One call that diagnoses each recording by itself, or all as files of one, or jointly.

    setups: what is wanted, of each actuator on the bus; results: where each result goes.
    """

    def __init__(
        self,
        arguments: argparse.Namespace,
        setups: Sequence[Setup],
        results: ResultWriter,
        inputs: Sequence[LogInput],
    ) -> None:
        self._arguments = arguments
        self._setups = tuple(setups)
        self._results = results
        self._logs = inputs
        self._inputs = [
            _BatchTask(number, item) for item in inputs for number in range(len(setups))
        ]
        self._summary = BatchSummary(len(self._inputs))
        self._takes: list[ResultSink] = [self._summary.take]
        self._journals: list[ResultJournal] = []
        self._reusable: dict[tuple[int, str], bool] = {}
        """Logs that were asked for, by whether an earlier call's results stand for them."""
        self._came = 0
        self._interrupted = False

    def run(self) -> int:
        """Diagnose all; return the exit code: that of one, the worst of several.

        A file that cannot be written keeps no verdict from being printed.
        """
        print_compiling_notice()
        if self._arguments.merge:
            merged = {self._merged(setup) for setup in self._setups}
            return worst_exit_code(merged) if len(merged) > 1 else merged.pop()
        if self._arguments.joint:
            return self._joint(self._setups[0])
        workers = self._workers()
        try:
            with ExitStack() as stack:
                self._open(stack)
                if workers > 1 or self._arguments.cluster:
                    workers = self._among(workers)
                else:
                    self._here()
                if not self._summary.left:
                    for journal in self._journals:
                        journal.settle()
        except InputOutputError as error:
            print_status(str(error))
            self._summary.codes.add(INPUT_OUTPUT_EXIT_CODE)
            self._summary.left = len(self._inputs) - self._came
        return self._conclude(workers)

    def _joint(self, setup: Setup) -> int:
        """Make one estimate from all logs."""
        together: list[Recording] = []
        logs: list[Log | None] = []
        read_s = 0.0
        codes: list[int] = []
        for item in self._logs:
            with report_failure(codes, EhadiagError), progress_bar() as progress:
                reading = setup.read(readable_name(item), progress=progress)
                for recording, log in reading.each():
                    together.append(recording)
                    logs.append(log)
                read_s += reading.seconds
        if any(codes):
            print_status("no joint estimate: not all of the logs could be read")
            return exit_code_of_inputs(codes)
        files = [item.name for item in self._logs]
        return diagnose_and_deliver(setup, self._results, together, files, logs, read_s, "joint")[1]

    def _merged(self, setup: Setup) -> int:
        """Diagnose one recording that is split over several files."""
        with progress_bar() as progress:
            reading = setup.read(*map(readable_name, self._logs), progress=progress)
        files, read_s = reading.files, reading.seconds
        return worst_exit_code(
            diagnose_and_deliver(setup, self._results, [recording], files, [log], read_s)[1]
            for recording, log in reading.each()
        )

    def _workers(self) -> int:
        """Return how many processes; 1: only this one."""
        # Reports and signals need samples, which no worker sends back.
        needs_samples = self._arguments.report or self._arguments.signals
        if len(self._inputs) < 2 or self._arguments.cluster or needs_samples:
            return 1
        jobs = self._arguments.jobs
        return min(jobs, len(self._inputs)) if jobs else worker_count(len(self._inputs))

    def _open(self, stack: ExitStack) -> None:
        """Open the files of results."""
        tables = {name: result_file_suffix(name) for name in self._arguments.results}
        for name, kind in tables.items():
            if kind == ".jsonl":
                journal = ResultJournal(name, self._setups, resume=False)
                self._journals.append(stack.enter_context(journal))
            else:
                self._takes.append(stack.enter_context(TABLE_FORMATS[kind].write(name)))
        if self._arguments.resume:
            journal = ResultJournal(self._arguments.resume, self._setups, resume=True)
            if journal.replaced:
                print_status(journal.replaced)
            self._journals.insert(0, stack.enter_context(journal))
        if self._arguments.junit:
            report = junit_report(self._arguments.junit, self._arguments.junit_not_tested)
            self._takes.append(stack.enter_context(report))

    def _here(self) -> None:
        """Diagnose one after the other in this process, each result out before the next is read."""
        for at, task in enumerate(self._inputs):
            setup, item = self._setups[task.unit], task.item
            if self._results.stopped:
                self._stop(at)
                return
            if self._reuse(task):
                continue
            try:
                interrupt_on_signals()
                if item.why:
                    raise InputOutputError(item.why)
                with progress_bar() as progress:
                    reading = setup.read(item.name, progress=progress)
            except EhadiagError as error:
                self._fail(setup.failure(item.name, str(error), error.exit_code))
                continue
            except Exception as error:
                if len(self._inputs) == 1:
                    raise  # nothing else is lost, and the place is shown
                self._fail(_unexpected(setup, item.name, error))
                continue
            if at == 0:
                # Printing's libraries take 25 ms to load, beside kernels that need no interpreter.
                threading.Thread(target=self._results.load, daemon=True).start()
            for recording, log in reading.each():
                found, code = diagnose_and_deliver(
                    setup, self._results, [recording], reading.files, [log], reading.seconds
                )
                self._take(found, unit=task.unit)
                self._summary.codes.add(code)
            self._came += 1

    def _among(self, jobs: int) -> int:
        """Diagnose in workers; return how many there were."""
        interrupt_on_signals()
        new = [task for task in self._inputs if not (task.item.why or self._known(task))]
        with (
            Workers(jobs, self._arguments.cluster) as workers,
            counting_bar(len(self._inputs)) as count,
        ):
            draw = self._results.pictures
            made = workers.over(
                partial(_run_task, self._setups, str(Path.cwd()), draw=draw),
                new,
                partial(_abandoned_task, self._setups),
            )
            try:
                for task in self._inputs:
                    item = task.item
                    if item.why:
                        self._fail(
                            self._setups[task.unit].failure(
                                item.name, item.why, INPUT_OUTPUT_EXIT_CODE
                            )
                        )
                    elif not self._reuse(task):
                        self._deliver(task, next(made))
                    count()
                    if self._results.stopped:
                        raise KeyboardInterrupt
                    interrupt_on_signals()
            except KeyboardInterrupt:
                self._results.stopped = True
                self._stop(self._came)
            finally:
                made.close()
            return workers.count

    def _deliver(self, task: _BatchTask, findings: Sequence[Finding]) -> None:
        setup = self._setups[task.unit]
        for result, picture in findings:
            if result.error is not None:
                self._fail(result)
                return
            name = setup.name(task.item.name, result)
            code = self._results.deliver(result, name, picture, alone=False)
            self._take(result, unit=task.unit)
            self._summary.codes.add(code)
        self._came += 1

    def _known(self, task: _BatchTask) -> list[Result]:
        """Return what an earlier call found of a log; nothing where it must be diagnosed.

        That is also where something that this call is to write of it is not there yet: pictures,
        reports and entries of a history are not made from a line of results.
        """
        if not self._arguments.resume:
            return []
        name, setup = task.item.name, self._setups[task.unit]
        found = self._journals[0].found(name, task.unit)
        if (task.unit, name) not in self._reusable:
            names = [setup.name(name, item) for item in found]
            self._reusable[task.unit, name] = all(map(self._results.has, found, names))
        return found if self._reusable[task.unit, name] else []

    def _reuse(self, task: _BatchTask) -> bool:
        """Bring out what an earlier call found, if it did."""
        found = self._known(task)
        for result in found:
            self._results.repeat(result)
            self._take(result, unit=task.unit, reused=True)
            self._summary.reused += 1
            self._summary.codes.add(result.exit_code)
        self._came += bool(found)
        return bool(found)

    def _fail(self, result: Result) -> None:
        self._results.refuse(result)
        self._take(result)
        self._summary.codes.add(result.exit_code)
        self._came += 1

    def _take(self, result: Result, *, unit: int = 0, reused: bool = False) -> None:
        """Hand a result to all files."""
        for number, journal in enumerate(self._journals):
            journal.add(result, unit, reused=reused and number == 0)
        for take in self._takes:
            take(result)

    def _stop(self, at: int) -> None:
        """Say what is left undone by the user's wish."""
        left = self._inputs[at:]
        self._summary.left = len(left)
        if not left:
            return
        if len(left) < MIN_RECORDINGS_FOR_SUMMARY:
            for task in left:
                print_status(f"stopped by the user: log {task.item.name} is not diagnosed")
        else:
            first = left[0].item.name
            print_status(
                f"stopped by the user: {len(left)} logs are not diagnosed, {first} the first"
            )
        self._interrupted = True

    def _conclude(self, workers: int) -> int:
        """Tell of all; return the exit code, which no signal changes any more."""
        defer_signals()
        codes = self._summary.codes
        code = (
            next(iter(codes), 0)
            if len(self._inputs) == 1 and len(codes) < 2
            else worst_exit_code(codes)
        )
        if self._interrupted:
            code = INTERRUPTED_EXIT_CODE
        tree = self._summary.tree(code, workers)
        if len(self._inputs) >= MIN_RECORDINGS_FOR_SUMMARY:
            for text in summary_lines(tree):
                print_status(text)
        if self._arguments.summary:
            try:
                write_summary(tree, self._arguments.summary)
            except InputOutputError as error:
                print_status(str(error))
                if not self._interrupted:
                    code = worst_exit_code({code, INPUT_OUTPUT_EXIT_CODE})
        return code


def _abandoned_task(setups: Sequence[Setup], task: _BatchTask) -> tuple[Finding, ...]:
    name = task.item.name
    text = f"log {name}: the process that diagnosed it ended, twice; not enough memory?"
    return (Finding(setups[task.unit].failure(name, text, INPUT_OUTPUT_EXIT_CODE)),)


class LogInput(msgspec.Struct, frozen=True):
    """One recording to diagnose."""

    name: str
    """As it was named, or as it was found."""
    why: str = ""
    """Why there is none; empty for a recording."""


def readable_name(item: LogInput) -> str:
    """Name of an input; InputOutputError: it was found unreadable when the names were expanded."""
    if item.why:
        raise InputOutputError(item.why)
    return item.name
