"""One call of `ehadiag diagnose` over its recordings: here, in workers, or from an earlier call."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from ehadiag.cli.argument_types import count
from ehadiag.cli.batch.inputs import Input
from ehadiag.cli.batch.job import Finding, Job, failure, work
from ehadiag.cli.batch.resume import Journal
from ehadiag.cli.batch.sinks import (
    Take,
    csv_table,
    junit_report,
    kind_of_table,
    parquet_table,
)
from ehadiag.cli.batch.summary import FAILED, Summary, summary_lines, worst_code, write_summary
from ehadiag.cli.batch.workers import Workers, processors_for
from ehadiag.cli.drawing import can_be_drawn, drawn
from ehadiag.cli.interrupt import interrupt_on_signals
from ehadiag.cli.output import counting_bar, progress_bar, say
from ehadiag.cli.results import Results
from ehadiag.core.errors import EhadiagError, InputOutputError, NotTestedError
from ehadiag.core.stored_test import SAME_RATE
from ehadiag.facade.compiling import compiling_notice
from ehadiag.report.spent import Spent

if TYPE_CHECKING:
    from ehadiag.core.recording import Recording
    from ehadiag.report.asked import LogFile

__all__ = ["add_batch_options", "diagnose_all", "finish"]

TOLD_FROM = 5
"""Recordings from which on a summary is told unasked."""
TABLES = {".csv": csv_table, ".parquet": parquet_table}


def add_batch_options(parser: argparse.ArgumentParser) -> None:
    """Add workers, and the files that hold the results of all recordings."""
    group = parser.add_argument_group("many recordings")
    group.add_argument(
        "--jobs",
        type=count,
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
        help="write all results to it: .jsonl, .csv or .parquet; repeatable",
    )
    group.add_argument(
        "--resume",
        metavar="FILE",
        help="as --results with a .jsonl of an earlier call, whose results are not found anew",
    )
    group.add_argument("--junit", metavar="FILE", help="write a JUnit report for build servers")
    group.add_argument("--summary", metavar="FILE", help="write the counts of all as JSON")


def diagnose_all(
    arguments: argparse.Namespace, jobs: Sequence[Job], results: Results, inputs: Sequence[Input]
) -> int:
    """Diagnose each recording by itself; return the exit code of all.

    Parameters
    ----------
    arguments : argparse.Namespace
        The parsed command line.
    jobs : Sequence[Job]
        What is wanted, of each actuator on the bus.
    results : Results
        Where each result goes.
    inputs : Sequence[Input]
        The recordings.

    Returns
    -------
    int
        That of one; the worst of several, see `worst_code`.
    """
    call = _Call(arguments, jobs, results, inputs)
    return call.run()


def finish(
    job: Job,
    results: Results,
    recordings: Sequence[Recording],
    files: Sequence[LogFile | None],
    spent: Spent,
    name: str,
    take: Callable[[dict[str, Any], str], None] | None = None,
) -> int:
    """Diagnose in this process, and deliver the result; return its exit code.

    Parameters
    ----------
    job : Job
        What is wanted.
    results : Results
        Where the result goes.
    recordings : Sequence[Recording]
        Of one actuator.
    files : Sequence[LogFile | None]
        Log of each.
    spent : Spent
        On reading.
    name : str
        Of the files, without suffix.
    take : Callable[[dict[str, Any], str], None] | None
        Is handed the object, and the line that it was read from.

    Returns
    -------
    int
        The verdict's, or 3 where something could not be written and that is worse.
    """
    from ehadiag.report.json_line import json_line  # noqa: PLC0415 - loads the model's names

    try:
        interrupt_on_signals()
        if results.stopped:
            raise KeyboardInterrupt
        with progress_bar() as progress:
            found = job.diagnose(recordings, progress)
    except KeyboardInterrupt:
        results.stopped = True
        found = job.not_tested(recordings, "stopped by the user")
    line = json_line(found, spent, job.asked, files)
    draw = partial(drawn, found, job.asked.levels) if can_be_drawn(found) else None
    code = results.deliver(found, line, spent, name, draw)
    if take is not None:
        take(json.loads(line), line)
    return code


@dataclass(frozen=True, slots=True)
class _Task:
    """One recording to diagnose for one of the actuators on its bus."""

    job: int
    """Place of the actuator's job."""
    item: Input


class _Call:
    """What the recordings of one call share."""

    def __init__(
        self,
        arguments: argparse.Namespace,
        jobs: Sequence[Job],
        results: Results,
        inputs: Sequence[Input],
    ) -> None:
        self._arguments = arguments
        self._jobs = tuple(jobs)
        self._results = results
        self._inputs = [_Task(number, item) for item in inputs for number in range(len(jobs))]
        self._summary = Summary(len(self._inputs))
        self._takes: list[Take] = [self._summary.take]
        self._journals: list[Journal] = []
        self._reusable: dict[tuple[int, str], bool] = {}
        """Logs that were asked for, by whether an earlier call's results stand for them."""
        self._came = 0

    def run(self) -> int:
        """Diagnose all; a file that cannot be written keeps no verdict from being printed."""
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
            say(str(error))
            self._summary.codes.add(FAILED)
            self._summary.left = len(self._inputs) - self._came
        return self._conclude(workers)

    def _workers(self) -> int:
        """Return how many processes; 1: only this one."""
        # A report draws samples, which no worker sends back.
        if len(self._inputs) < 2 or self._arguments.cluster or self._arguments.report:
            return 1
        asked = self._arguments.jobs
        return min(asked, len(self._inputs)) if asked else processors_for(len(self._inputs))

    def _open(self, stack: ExitStack) -> None:
        """Open the files of results."""
        tables = {name: kind_of_table(name) for name in self._arguments.results}
        for name, kind in tables.items():
            if kind == ".jsonl":
                journal = Journal(name, self._jobs, resume=False)
                self._journals.append(stack.enter_context(journal))
            else:
                self._takes.append(stack.enter_context(TABLES[kind](name)))
        if self._arguments.resume:
            journal = Journal(self._arguments.resume, self._jobs, resume=True)
            if journal.replaced:
                say(journal.replaced)
            self._journals.insert(0, stack.enter_context(journal))
        if self._arguments.junit:
            self._takes.append(stack.enter_context(junit_report(self._arguments.junit)))

    def _here(self) -> None:
        """Diagnose one after the other in this process, each result out before the next is read."""
        for at, task in enumerate(self._inputs):
            job, item = self._jobs[task.job], task.item
            if self._results.stopped:
                self._stop(at)
                return
            if self._reuse(task):
                continue
            try:
                interrupt_on_signals()
                if item.why:
                    raise InputOutputError(item.why)
                reading = job.read(item.name)
            except EhadiagError as error:
                self._fail(failure(job, item.name, str(error), error.exit_code))
                continue
            for recording, file, suffix in reading.each():
                code = finish(
                    job,
                    self._results,
                    [recording],
                    [file],
                    Spent(reading.seconds),
                    job.name(item.name, suffix),
                    partial(self._take, job=task.job),
                )
                self._summary.codes.add(code)
            self._came += 1

    def _among(self, jobs: int) -> int:
        """Diagnose in workers; return how many there were."""
        interrupt_on_signals()
        self._compile_once()
        new = [task for task in self._inputs if not (task.item.why or self._known(task))]
        with (
            Workers(jobs, self._arguments.cluster) as workers,
            counting_bar(len(self._inputs)) as tell,
        ):
            made = workers.over(
                partial(_in_worker, self._jobs), new, partial(_given_up, self._jobs)
            )
            try:
                for task in self._inputs:
                    item = task.item
                    if item.why:
                        self._fail(failure(self._jobs[task.job], item.name, item.why, FAILED))
                    elif not self._reuse(task):
                        self._deliver(task, next(made))
                    tell()
                    if self._results.stopped:
                        raise KeyboardInterrupt
                    interrupt_on_signals()
            except KeyboardInterrupt:
                self._results.stopped = True
                self._stop(self._came)
            finally:
                made.close()
            return workers.count

    def _compile_once(self) -> None:
        """Fill the cache of kernels, where it is empty, before several workers would do so."""
        if not compiling_notice():
            return
        from ehadiag.identify.warmup import warm_up  # noqa: PLC0415 - loads numba

        job = self._jobs[0]
        for test in {test.rate: test for test in job.tests}.values():
            if abs(test.rate / job.actuator.controller.rate - 1.0) <= SAME_RATE:
                warm_up(job.actuator, test)

    def _deliver(self, task: _Task, findings: Sequence[Finding]) -> None:
        for found in findings:
            if found.diagnosis is None or found.spent is None:
                self._fail(found)
                return
            picture = found.picture
            draw = None if picture is None else lambda content=picture: content
            code = self._results.deliver(found.diagnosis, found.line, found.spent, found.name, draw)
            self._take(json.loads(found.line), found.line, job=task.job)
            self._summary.codes.add(code)
        self._came += 1

    def _known(self, task: _Task) -> list[str]:
        """Return what an earlier call found of a log; nothing where it must be diagnosed.

        That is also where something that this call is to write of it is not there yet: pictures,
        reports and entries of a history are not made from a line of results.
        """
        if not self._arguments.resume:
            return []
        name, job = task.item.name, self._jobs[task.job]
        lines = self._journals[0].found(name, task.job)
        if (task.job, name) not in self._reusable:
            names = [job.name(name, _suffix(line)) for line in lines]
            self._reusable[task.job, name] = all(map(self._results.has, lines, names))
        return lines if self._reusable[task.job, name] else []

    def _reuse(self, task: _Task) -> bool:
        """Bring out what an earlier call found, if it did."""
        from ehadiag.assess.verdict import Verdict  # noqa: PLC0415

        lines = self._known(task)
        for line in lines:
            tree = json.loads(line)
            self._results.repeat(line, tree)
            self._take(tree, line, job=task.job, reused=True)
            self._summary.reused += 1
            self._summary.codes.add(int(Verdict[tree["verdict"]]))
        self._came += bool(lines)
        return bool(lines)

    def _fail(self, found: Finding) -> None:
        self._results.refuse(found.line, found.error)
        self._take(json.loads(found.line), found.line)
        self._summary.codes.add(found.exit_code)
        self._came += 1

    def _take(self, tree: dict[str, Any], line: str, *, job: int = 0, reused: bool = False) -> None:
        """Hand a result to all files."""
        for number, journal in enumerate(self._journals):
            journal.add(line, job, reused=reused and number == 0)
        for take in self._takes:
            take(tree)

    def _stop(self, at: int) -> None:
        """Say what is left undone by the user's wish."""
        left = self._inputs[at:]
        self._summary.left = len(left)
        if not left:
            return
        if len(left) < TOLD_FROM:
            for task in left:
                say(f"stopped by the user: log {task.item.name} is not diagnosed")
        else:
            first = left[0].item.name
            say(f"stopped by the user: {len(left)} logs are not diagnosed, {first} the first")
        self._summary.codes.add(NotTestedError.exit_code)

    def _conclude(self, workers: int) -> int:
        """Tell of all; return the exit code."""
        codes = self._summary.codes
        code = (
            next(iter(codes), 0) if len(self._inputs) == 1 and len(codes) < 2 else worst_code(codes)
        )
        tree = self._summary.tree(code, workers)
        if len(self._inputs) >= TOLD_FROM:
            for text in summary_lines(tree):
                say(text)
        if self._arguments.summary:
            try:
                write_summary(tree, self._arguments.summary)
            except InputOutputError as error:
                say(str(error))
                code = worst_code({code, FAILED})
        return code


def _suffix(line: str) -> str:
    """What the files of a result are called more than its log, see `Reading.each`."""
    log = json.loads(line)["recordings"][0]["log"]
    return f"-{log['result']}" if log["results"] > 1 else ""


def _in_worker(jobs: Sequence[Job], task: _Task) -> tuple[Finding, ...]:
    return work(jobs[task.job], task.item.name)


def _given_up(jobs: Sequence[Job], task: _Task) -> tuple[Finding, ...]:
    name = task.item.name
    text = f"log {name}: the process that diagnosed it ended, twice; not enough memory?"
    return (failure(jobs[task.job], name, text, FAILED),)
