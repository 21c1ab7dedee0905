"""`ehadiag diagnose`: recordings in, verdicts out."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

from ehadiag.cli import options
from ehadiag.cli.output import make_folder, progress_bar, say, say_if_compiling, show, write_report
from ehadiag.diagnosis import Diagnosis, diagnose
from ehadiag.errors import EhadiagError
from ehadiag.identify.solvers import make_solver
from ehadiag.recording import Recording
from ehadiag.verdict import Levels

__all__ = ["add_parser", "run"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "diagnose",
        help="diagnose recordings (BLF, ASC, CSV, TRC, MF4)",
        description="Diagnose actuators from recordings of their bus.",
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
        help="test file that a log may be of, besides the stored ones; repeatable",
    )
    parser.add_argument(
        "--joint",
        action="store_true",
        help="the logs are of one actuator: one estimate from all of them",
    )
    parser.add_argument("--all", action="store_true", help="every test in a log, not its last one")
    parser.add_argument("--out", metavar="DIR", help="write a JSON file and a picture for each")
    options.add_actuator_options(parser)
    options.add_mapping_options(parser)
    options.add_diagnosis_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Diagnose each log; return the worst exit code."""
    actuator = options.the_actuator(arguments)
    tests = options.known_tests(arguments.test)
    levels = Levels(arguments.advisory, arguments.limit)
    bus_map = options.the_bus_map(arguments)
    solver = make_solver(arguments.solver)
    folder = make_folder(arguments.out) if arguments.out else None
    say_if_compiling()
    from firmware_iface.logs import choose, read_recordings  # noqa: PLC0415 - loads python-can

    worst = 0
    groups: list[tuple[list[Recording], float]] = []

    def finish(recordings: Sequence[Recording], read_s: float, name: str) -> None:
        nonlocal worst
        with progress_bar() as progress:
            result: Diagnosis = diagnose(
                recordings,
                actuator,
                tests,
                levels=levels,
                solver=solver,
                seed=arguments.seed,
                progress=progress,
            )
        show(result, arguments, read_s)
        if folder is not None:
            write_report(result, folder / name, arguments, read_s)
        worst = max(worst, int(result.verdict))

    for log in arguments.logs:
        begin = time.perf_counter()
        try:
            found = read_recordings(log, bus_map)
        except EhadiagError as error:
            say(str(error))
            worst = max(worst, error.exit_code)
            continue
        chosen = list(found) if arguments.all else [choose(found)]
        read_s = time.perf_counter() - begin
        if arguments.joint:
            groups.append((chosen, read_s))
            continue
        for number, recording in enumerate(chosen, start=1):
            suffix = f"-{number}" if len(chosen) > 1 else ""
            finish([recording], read_s, Path(log).stem + suffix)
    if groups:
        together = [recording for chosen, _ in groups for recording in chosen]
        finish(together, sum(read_s for _, read_s in groups), "joint")
    return worst
