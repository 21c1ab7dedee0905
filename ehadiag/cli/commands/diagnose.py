"""`ehadiag diagnose`: diagnoses recordings."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.cli import asked_for, options
from ehadiag.cli.batch.call import add_batch_options, diagnose_all, finish
from ehadiag.cli.batch.inputs import Input, expand
from ehadiag.cli.batch.job import Job
from ehadiag.cli.exit_codes import code_of_inputs, worst_code
from ehadiag.cli.history_file import add_keeping_options
from ehadiag.cli.interrupt import keep_signals
from ehadiag.cli.output import say, say_if_compiling
from ehadiag.cli.overwriting import (
    Output,
    names_taken,
    refuse_overwriting,
    refuse_unwritable,
)
from ehadiag.cli.report_page import add_report_option
from ehadiag.cli.results import Results, make_folder
from ehadiag.cli.units import Unit, add_unit_options, units_of
from ehadiag.core.errors import ConfigurationError, EhadiagError, InputOutputError
from ehadiag.core.stored_test import resolve_test
from ehadiag.report.spent import Spent

if TYPE_CHECKING:
    from ehadiag.core.recording import Recording
    from ehadiag.report.asked import LogFile

__all__ = ["add_parser", "run"]

NOT_LISTED = (
    "joint", "out", "report", "history", "hours", "cycles", "results", "resume", "junit", "summary",
)  # fmt: skip
"""Options that say what becomes of a diagnosis."""
UNUSED: tuple[object, ...] = (None, False, [])


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "diagnose",
        help="diagnose recordings (BLF, ASC, CSV, TRC, MF4, candump; .gz)",
        description="Diagnose actuators from recordings of their bus.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "logs",
        nargs="+",
        metavar="LOG",
        help="recording, folder of recordings, pattern, or - for a list of names on standard"
        " input; a log with several tests gives its last complete one",
    )
    parser.add_argument(
        "--test",
        action="append",
        default=[],
        metavar=options.TEST,
        help="test that a log may be of, besides the stored ones; repeatable."
        " Given once, it also stands for logs that carry no test number",
    )
    parser.add_argument(
        "--joint",
        action="store_true",
        help="the logs are of one actuator: one estimate from all of them",
    )
    parser.add_argument("--all", action="store_true", help="every test in a log, not its last one")
    parser.add_argument(
        "--list", action="store_true", help="list the tests that each log holds, diagnose none"
    )
    options.add_when_options(parser)
    parser.add_argument("--out", metavar="DIR", help="write a JSON file and a picture for each")
    add_unit_options(parser)
    options.add_column_options(parser)
    options.add_log_options(parser)
    options.add_diagnosis_options(parser)
    add_keeping_options(parser)
    options.add_result_options(parser)
    add_report_option(parser)
    add_batch_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Diagnose each log; return the worst exit code."""
    inputs = expand(arguments.logs)
    if not inputs:
        raise ConfigurationError("no recording named: the list on standard input is empty")
    if arguments.list:
        return code_of_inputs([_list(unit, inputs) for unit in units_of(arguments)])
    # What is wrong with the options is said before anything slow is loaded.
    _refuse_contradictions(arguments)
    jobs = [_job(unit) for unit in units_of(arguments)]
    if arguments.joint and len(jobs) > 1:
        raise ConfigurationError("--mapping: --joint is of one actuator, name one mapping")
    outputs = _outputs(arguments)
    reads = [("the log", item.name) for item in inputs]
    reads += [("the DBC", job.bus_map.name) for job in jobs]
    refuse_overwriting(arguments, outputs, reads)
    refuse_unwritable(outputs)
    folder = make_folder(arguments.out) if arguments.out else None
    results = Results(arguments, folder, names_taken(folder.path, outputs) if folder else ())
    say_if_compiling()
    if arguments.merge:
        codes = {_merged(job, results, inputs) for job in jobs}
        code = worst_code(codes) if len(codes) > 1 else codes.pop()
    elif arguments.joint:
        code = _joint(jobs[0], results, inputs)
    else:
        code = diagnose_all(arguments, jobs, results, inputs)
    keep_signals()
    return code


def _refuse_contradictions(arguments: argparse.Namespace) -> None:
    several = {
        "--results": arguments.results,
        "--resume": arguments.resume,
        "--junit": arguments.junit,
        "--summary": arguments.summary,
        "--cluster": arguments.cluster,
        "--jobs": arguments.jobs,
    }
    if arguments.joint and arguments.merge:
        raise ConfigurationError("--merge: with --joint each log is a recording of its own")
    alone = "--joint" if arguments.joint else "--merge" if arguments.merge else ""
    for name, value in several.items():
        if alone and value:
            raise ConfigurationError(f"{name}: {alone} gives one result, and has no use for it")
    for name in ("--jobs", "--cluster"):
        if arguments.report and several[name]:
            raise ConfigurationError(f"{name}: --report draws samples, which workers do not send")
    if arguments.cluster and arguments.jobs:
        raise ConfigurationError("--jobs: a cluster has its own number of workers")


def _outputs(arguments: argparse.Namespace) -> list[Output]:
    """Files that hold the results of the whole call."""
    named = [("--results", name) for name in arguments.results]
    named += [(f"--{key}", getattr(arguments, key)) for key in ("resume", "junit", "summary")]
    return [Output(option, name) for option, name in named if name]


def _job(unit: Unit) -> Job:
    """Return what all logs of the call have in common for one actuator."""
    arguments = unit.arguments
    only = arguments.test[0] if len(arguments.test) == 1 else None
    default = resolve_test(only) if only else None
    bus_map, actuator = asked_for.the_bus_map(arguments), asked_for.the_actuator(arguments)
    tests = asked_for.known_tests(arguments.test)
    return Job(
        asked=asked_for.the_asked(arguments, bus_map, (default,) if default else tests),
        actuator=actuator,
        tests=tests,
        default=default,
        bus_map=bus_map,
        columns=asked_for.the_columns(arguments),
        sought=asked_for.the_sought(arguments, (default,) if default else tests, actuator),
        budget=asked_for.the_budget(arguments),
        every=arguments.all,
        draw=arguments.out is not None and not arguments.no_picture,
        folder=str(Path.cwd()),
        label=unit.label,
    )


def _joint(job: Job, results: Results, inputs: Sequence[Input]) -> int:
    """Make one estimate from all logs."""
    together: list[Recording] = []
    files: list[LogFile | None] = []
    spent, codes = 0.0, []
    for item in inputs:
        try:
            if item.why:
                raise InputOutputError(item.why)
            reading = job.read(item.name)
        except EhadiagError as error:
            say(str(error))
            codes.append(error.exit_code)
            continue
        codes.append(0)
        together += reading.recordings
        files += [file for _, file, _ in reading.each()]
        spent += reading.seconds
    if any(codes):
        say("no joint estimate: not all of the logs could be read")
        return code_of_inputs(codes)
    return finish(job, results, together, files, Spent(spent), "joint")


def _merged(job: Job, results: Results, inputs: Sequence[Input]) -> int:
    """Diagnose one recording that lies in several files."""
    for item in inputs:
        if item.why:
            raise InputOutputError(item.why)
    reading = job.read(*(item.name for item in inputs))
    first = inputs[0].name
    codes = [
        finish(job, results, [recording], [file], Spent(reading.seconds), job.name(first, suffix))
        for recording, file, suffix in reading.each()
    ]
    return worst_code(codes)


def _list(unit: Unit, inputs: Sequence[Input]) -> int:
    """Print what the logs hold of one actuator."""
    arguments, of = unit.arguments, f" ({unit.label})" if unit.label else ""
    from ehadiag.cli.listing import print_list  # noqa: PLC0415
    from firmware_iface.logs.any_recording import Meaning, recorded_tests  # noqa: PLC0415

    if unused := [name for name in NOT_LISTED if getattr(arguments, name) not in UNUSED]:
        told = ", ".join(f"--{name}" for name in unused)
        say(f"--list diagnoses none, and has no use for {told}")
    bus_map, budget = asked_for.the_bus_map(arguments), asked_for.the_budget(arguments)
    tests = asked_for.known_tests(arguments.test)
    sought = asked_for.the_sought(arguments, tests, asked_for.the_actuator(arguments))
    meaning = Meaning(bus_map, asked_for.the_columns(arguments), sought)
    codes = []
    groups = [list(inputs)] if arguments.merge else [[item] for item in inputs]
    for group in groups:
        try:
            for item in group:
                if item.why:
                    raise InputOutputError(item.why)
            names = [item.name for item in group]
            found = recorded_tests(names, meaning, budget)
            print_list(", ".join(names) + of, found, as_json=arguments.json)
        except EhadiagError as error:
            say(str(error))
            codes.append(error.exit_code)
        else:
            codes.append(0)
    return code_of_inputs(codes)
