"""`ehadiag diagnose`: diagnoses recordings."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.assess.verdict import Levels, Rule
from ehadiag.cli import options
from ehadiag.cli.deadline import Deadline
from ehadiag.cli.history_file import add_keeping_options
from ehadiag.cli.interrupt import interrupt_on_signals, keep_signals
from ehadiag.cli.output import progress_bar, say, say_if_compiling
from ehadiag.cli.report_page import add_report_option
from ehadiag.cli.results import Results, make_folder
from ehadiag.core.errors import EhadiagError, NotTestedError
from ehadiag.core.stored_test import resolve_test
from ehadiag.report.spent import Spent

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.core.recording import Recording

__all__ = ["add_parser", "run"]


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
        help="recording; a log with several tests gives its last complete one",
    )
    parser.add_argument(
        "--test",
        action="append",
        default=[],
        metavar="FILE",
        help="test (file) that a log may be of, besides the stored ones; repeatable."
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
    parser.add_argument("--out", metavar="DIR", help="write a JSON file and a picture for each")
    options.add_actuator_options(parser)
    options.add_mapping_options(parser)
    options.add_log_options(parser)
    options.add_diagnosis_options(parser)
    add_keeping_options(parser)
    add_report_option(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Diagnose each log; return the worst exit code."""
    if arguments.list:
        return _list(arguments)
    # What is wrong with the options is said before anything slow is loaded.
    diagnosis = _Diagnosis(arguments)
    codes = [0]
    together: list[Recording] = []
    spent = 0.0
    for log in arguments.logs:
        if diagnosis.stopped:
            say(f"stopped by the user: log {log} is not diagnosed")
            codes.append(NotTestedError.exit_code)
            continue
        begin = time.perf_counter()
        try:
            found = diagnosis.read(log)
        except EhadiagError as error:
            say(str(error))
            codes.append(error.exit_code)
            continue
        read_s = time.perf_counter() - begin
        if arguments.joint:
            together += found
            spent += read_s
            continue
        for number, recording in enumerate(found, start=1):
            suffix = f"-{number}" if len(found) > 1 else ""
            codes.append(diagnosis.finish([recording], read_s, Path(log).stem + suffix))
    if arguments.joint and max(codes) > 0:
        say("no joint estimate: not all of the logs could be read")
    elif arguments.joint:
        codes.append(diagnosis.finish(together, spent, "joint"))
    keep_signals()
    return max(codes)


def _list(arguments: argparse.Namespace) -> int:
    """Print what the logs hold."""
    from ehadiag.cli.listing import print_list  # noqa: PLC0415
    from firmware_iface.logs.reader import iterate_recordings  # noqa: PLC0415

    bus_map, budget = options.the_bus_map(arguments), options.the_budget(arguments)
    code = 0
    for log in arguments.logs:
        try:
            found = iterate_recordings(log, bus_map, budget)
            print_list(log, found, as_json=arguments.json)
        except EhadiagError as error:
            say(str(error))
            code = max(code, error.exit_code)
    return code


class _Diagnosis:
    """What all logs of one call have in common."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._arguments = arguments
        self._actuator = options.the_actuator(arguments)
        self._tests = options.known_tests(arguments.test)
        only = arguments.test[0] if len(arguments.test) == 1 else None
        self._default = resolve_test(only) if only else None
        self._levels = Levels(arguments.advisory, arguments.limit, Rule(arguments.rule))
        self._bus_map = options.the_bus_map(arguments)
        self._budget = options.the_budget(arguments)
        self._results = Results(arguments, make_folder(arguments.out) if arguments.out else None)
        self.stopped = False
        """Whether a signal came: nothing further is diagnosed."""
        say_if_compiling()

    def read(self, log: str) -> list[Recording]:
        """Read what is to be diagnosed of one log."""
        from firmware_iface.logs.reader import (  # noqa: PLC0415 - loads cantools
            read_recording,
            read_recordings,
        )

        interrupt_on_signals()
        if self._arguments.all:
            return list(read_recordings(log, self._bus_map, self._budget))
        return [read_recording(log, self._bus_map, self._budget)]

    def finish(self, recordings: Sequence[Recording], read_s: float, name: str) -> int:
        """Diagnose, write and print one result; return its exit code."""
        from ehadiag.assess.diagnosis import match_tests, not_tested  # noqa: PLC0415 - loads numba

        begin = time.perf_counter()
        try:
            interrupt_on_signals()
            if self.stopped:
                raise KeyboardInterrupt
            result = self._diagnose(recordings)
        except KeyboardInterrupt:
            self.stopped, why = True, "stopped by the user"
        except NotTestedError as error:
            why = str(error)
        else:
            why = ""
        if why:
            tests = match_tests(recordings, self._tests, self._default)
            elapsed = time.perf_counter() - begin
            result = not_tested(recordings, tests, self._actuator, [why], elapsed)
        code = self._results.deliver(result, Spent(read_s), name)
        self.stopped = self.stopped or self._results.stopped
        return code

    def _diagnose(self, recordings: Sequence[Recording]) -> Diagnosis:
        from ehadiag.assess.diagnosis import diagnose  # noqa: PLC0415 - loads numba
        from ehadiag.identify.search.solvers import make_solver  # noqa: PLC0415
        from ehadiag.identify.session import Nuisances  # noqa: PLC0415

        with progress_bar() as progress:
            return diagnose(
                recordings,
                self._actuator,
                self._tests,
                default=self._default,
                levels=self._levels,
                solver=make_solver(self._arguments.solver),
                seed=self._arguments.seed,
                nuisances=Nuisances(self._arguments.nuisances),
                progress=Deadline(self._arguments.time_limit).watch(progress),
            )
