"""`ehadiag bit`: requests a built-in test, records it, diagnoses it."""

from __future__ import annotations

import argparse
import time
from contextlib import ExitStack
from functools import partial

from ehadiag.assess.verdict import Levels, Rule
from ehadiag.cli import options
from ehadiag.cli.acquire import STOPPED, acquire
from ehadiag.cli.beforehand import refuse_beforehand
from ehadiag.cli.drawing import can_be_drawn, drawn
from ehadiag.cli.history_file import add_keeping_options
from ehadiag.cli.interrupt import stop_on_signals
from ehadiag.cli.output import say_if_compiling
from ehadiag.cli.overwriting import Output, refuse_overwriting
from ehadiag.cli.report_page import add_report_option
from ehadiag.cli.results import Results, make_folder
from ehadiag.cli.screen.bit_view import BitView
from ehadiag.cli.screen.show import add_screen_options, shown
from ehadiag.core.errors import NotTestedError
from ehadiag.core.stored_test import resolve_test
from ehadiag.facade.inputs import log_file
from ehadiag.report.spent import Spent

__all__ = ["add_parser", "run"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "bit",
        help="request a built-in test on a bus, record and diagnose it",
        description="Request a built-in test on a bus, record it to disk while it runs, diagnose"
        " it. The request makes the surface move. Ctrl-C requests an abort.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--test",
        required=True,
        metavar=options.TEST,
        help="stored test by name or number, or a test file",
    )
    parser.add_argument(
        "--simulate",
        action="store_true",
        help="run the emulated flight-control computer for it; without"
        " --interface on a virtual bus of this process",
    )
    parser.add_argument(
        "--fast",
        action="store_true",
        help="with --simulate: simulated time and no bus between, as fast as it goes",
    )
    parser.add_argument(
        "--listen",
        action="store_true",
        help="send nothing: wait up to a minute for the test that somebody else starts",
    )
    parser.add_argument(
        "--record",
        metavar="FILE",
        help="recording, .blf .asc .csv .trc .mf4 (default: a BLF in the output folder)",
    )
    parser.add_argument(
        "--out",
        default="ehadiag-out",
        metavar="DIR",
        help="recording, JSON and picture go here (default ehadiag-out)",
    )
    for name, unit, what in (
        ("position", "mm", "jack position"),
        ("pressure", "MPa", "differential pressure"),
        ("current", "mA", "servovalve current"),
    ):
        parser.add_argument(
            f"--max-{name}",
            type=options.positive,
            metavar=unit,
            help=f"abort the test when the {what} goes beyond ±{unit} (default: not watched)",
        )
    add_screen_options(parser)
    options.add_actuator_options(parser)
    options.add_mapping_options(parser)
    options.add_diagnosis_options(parser)
    add_keeping_options(parser)
    options.add_result_options(parser)
    add_report_option(parser)
    options.add_bus_options(parser)
    options.add_fault_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the test and print the verdict."""
    actuator = options.the_actuator(arguments)
    test = resolve_test(arguments.test)
    levels = Levels(arguments.advisory, arguments.limit, Rule(arguments.rule))
    bus_map = options.the_bus_map(arguments)
    refuse_beforehand(arguments, test, actuator, bus_map)
    if arguments.record:
        refuse_overwriting(arguments, [Output("--record", arguments.record)])
    folder = make_folder(arguments.out)
    say_if_compiling(simulation=arguments.simulate)
    from ehadiag.assess.diagnosis import (  # noqa: PLC0415 - loads numba
        DiagnosisSession,
        not_tested,
    )
    from ehadiag.identify.search.solvers import make_solver  # noqa: PLC0415
    from ehadiag.identify.session import Nuisances  # noqa: PLC0415
    from ehadiag.identify.warmup import warm_up  # noqa: PLC0415
    from ehadiag.report.json_line import json_line  # noqa: PLC0415

    # Before the test: a verdict must not wait for the compiler.
    warm_up(actuator, test)
    results = Results(arguments, folder)
    results.load()
    begin = time.perf_counter()
    session = DiagnosisSession(
        actuator,
        [test],
        default=test,
        levels=levels,
        solver=make_solver(arguments.solver),
        seed=arguments.seed,
        nuisances=Nuisances(arguments.nuisances),
    )
    with ExitStack() as stack:
        # Not before the bus is open: until then lines are printed.
        view = BitView(
            actuator,
            test,
            session,
            lambda: _begin(stack, view, arguments),
            options.the_bitrate(arguments, bus_map),
        )
        with stop_on_signals() as stop:
            heard = acquire(arguments, actuator, test, bus_map, folder.path, session, stop, view)
        read_s = time.perf_counter() - begin
        recordings, why = [heard.recording], heard.why
        try:
            if stop.is_set() and not why:
                raise KeyboardInterrupt
            if not why:
                result = session.finish(recordings, heard.deadline.watch(view.working))
        except KeyboardInterrupt:
            why = STOPPED
        except NotTestedError as error:
            why = str(error)
        if why:
            result = not_tested(recordings, [test], actuator, [why])
        view.ended(result)
    ended_at = heard.ended_at
    spent = Spent(read_s, None if ended_at is None else time.perf_counter() - ended_at)
    line = json_line(
        result, spent, options.the_asked(arguments, bus_map), [log_file(heard.recording.source)]
    )
    draw = partial(drawn, result, levels) if can_be_drawn(result) else None
    return results.deliver(result, line, spent, heard.name, draw)


def _begin(stack: ExitStack, view: BitView, arguments: argparse.Namespace) -> None:
    stack.enter_context(shown(view.look, plain=arguments.plain, snapshots=arguments.snapshots))
