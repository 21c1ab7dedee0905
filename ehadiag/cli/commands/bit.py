"""`ehadiag bit`: requests a built-in test, records it, diagnoses it."""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.assess.verdict import Levels, Rule
from ehadiag.cli import argument_types, asked_for, bus_options, options
from ehadiag.cli.acquire import STOPPED, Heard, acquire, recording_path
from ehadiag.cli.batch.job import labelled
from ehadiag.cli.beforehand import refuse_beforehand
from ehadiag.cli.drawing import can_be_drawn, drawn
from ehadiag.cli.exit_codes import worst_code
from ehadiag.cli.history_file import add_keeping_options
from ehadiag.cli.interrupt import stop_on_signals
from ehadiag.cli.output import say, say_if_compiling
from ehadiag.cli.overwriting import Output, refuse_overwriting
from ehadiag.cli.report_page import add_report_option
from ehadiag.cli.results import Results, make_folder
from ehadiag.cli.screen.bit_view import BitView
from ehadiag.cli.screen.show import add_screen_options, shown, wants_screen
from ehadiag.cli.together import Listener, listen_together
from ehadiag.cli.units import Unit, add_unit_options, units_of
from ehadiag.core.actuator import Actuator
from ehadiag.core.errors import ConfigurationError, NotTestedError
from ehadiag.core.stored_test import StoredTest, resolve_test
from ehadiag.facade.inputs import log_file
from ehadiag.report.spent import Spent

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.cli.watch.in_test import InTest
    from firmware_iface.mapping.bus_map import BusMap
    from firmware_iface.transport.interface import Transport

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
        help="send nothing: wait up to a minute for the test that somebody else starts; with"
        " several --mapping for that of each actuator",
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
            type=argument_types.positive,
            metavar=unit,
            help=f"abort the test when the {what} goes beyond ±{unit} (default: not watched)",
        )
    parser.add_argument(
        "--onboard-wait",
        type=argument_types.positive,
        default=60.0,
        metavar="S",
        help="how long to wait after the test for what the flight-control computer finds itself,"
        " where it says that it is at it (default 60)",
    )
    add_screen_options(parser)
    add_unit_options(parser)
    options.add_diagnosis_options(parser)
    add_keeping_options(parser)
    options.add_result_options(parser)
    add_report_option(parser)
    bus_options.add_bus_options(parser)
    options.add_fault_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the test and print the verdict, or that of each actuator listened to."""
    named = units_of(arguments)
    test = resolve_test(arguments.test)
    if len(named) > 1 and not arguments.listen:
        raise ConfigurationError(
            "--mapping: a test is requested of one actuator; name one mapping, or --listen"
        )
    described = [
        (unit, asked_for.the_actuator(unit.arguments), asked_for.the_bus_map(unit.arguments))
        for unit in named
    ]
    for unit, actuator, bus_map in described:
        refuse_beforehand(unit.arguments, test, actuator, bus_map)
    if arguments.record:
        refuse_overwriting(arguments, [Output("--record", arguments.record)])
    folder = make_folder(arguments.out)
    say_if_compiling(simulation=arguments.simulate)
    results = Results(arguments, folder)
    runs = [
        _Run(unit, test, actuator, bus_map, results.history)
        for unit, actuator, bus_map in described
    ]
    results.load()
    with ExitStack() as stack:
        with stop_on_signals() as stop:
            if len(runs) == 1:
                runs[0].hear(folder.path, stop, partial(_begin, stack, arguments))
            else:
                _hear_all(runs, arguments, folder.path, test, described[0][2].channel, stop)
        for item in runs:
            item.judge(stop)
    codes = {item.deliver(results) for item in runs}
    return worst_code(codes) if len(codes) > 1 else codes.pop()


def _hear_all(
    runs: Sequence[_Run],
    arguments: argparse.Namespace,
    folder: Path,
    test: StoredTest,
    channel: int | None,
    stop: threading.Event,
) -> None:
    """Listen for the test of each actuator at once; no screen shows several."""
    path = recording_path(arguments, folder, test)
    names = ", ".join(item.unit.label for item in runs)
    say(f"listening for test {test.name!r} of {names}, recording to {path}")

    def hearing(item: _Run) -> Listener:
        return lambda bus, path: item.hear(folder, stop, lambda _view: None, (bus, path))

    listen_together(arguments, path, channel, [hearing(item) for item in runs], stop)


class _Run:
    """The test of one actuator: listened to or requested, then judged."""

    def __init__(
        self,
        unit: Unit,
        test: StoredTest,
        actuator: Actuator,
        bus_map: BusMap,
        history: Path | None,
    ) -> None:
        from ehadiag.assess.diagnosis import DiagnosisSession  # noqa: PLC0415 - loads numba
        from ehadiag.identify.search.solvers import make_solver  # noqa: PLC0415
        from ehadiag.identify.session import Nuisances  # noqa: PLC0415
        from ehadiag.identify.warmup import warm_up  # noqa: PLC0415

        self.unit, self._test, self._actuator, self._bus_map = unit, test, actuator, bus_map
        arguments = unit.arguments
        self._levels = Levels(arguments.advisory, arguments.limit, Rule(arguments.rule))
        # Before the test: a verdict must not wait for the compiler.
        warm_up(actuator, test)
        self._begin = time.perf_counter()
        self._session = DiagnosisSession(
            actuator,
            [test],
            default=test,
            levels=self._levels,
            solver=make_solver(arguments.solver),
            seed=arguments.seed,
            nuisances=Nuisances(arguments.nuisances),
        )
        self._beside = _monitor_beside(unit, actuator, bus_map, test, history)
        # What comes of it, one after the other.
        self._heard: Heard | None = None
        self._view: BitView | None = None
        self._result: Diagnosis | None = None
        self._read_s = 0.0

    def hear(
        self,
        folder: Path,
        stop: threading.Event,
        show: Callable[[BitView], None],
        shared: tuple[Transport, Path] | None = None,
    ) -> Heard:
        """Acquire the test, on a bus of its own or on one that others listen to as well."""
        arguments = self.unit.arguments
        # Not shown before the bus is open: until then lines are printed.
        view = BitView(
            self._actuator,
            self._test,
            self._session,
            lambda: show(view),
            bus_options.the_bitrate(arguments, self._bus_map),
            self._beside,
        )
        heard = acquire(
            arguments, self._actuator, self._test, self._bus_map, folder, self._session, stop,
            view, shared,
        )  # fmt: skip
        self._read_s = time.perf_counter() - self._begin
        if self.unit.label:
            heard = replace(heard, recording=labelled(heard.recording, self.unit.label))
        self._heard, self._view = heard, view
        return heard

    def judge(self, stop: threading.Event) -> None:
        """Diagnose what was heard."""
        from ehadiag.assess.diagnosis import not_tested  # noqa: PLC0415

        heard, view = self._heard, self._view
        assert heard is not None
        assert view is not None
        recordings, why = [heard.recording], heard.why
        try:
            if stop.is_set() and not why:
                raise KeyboardInterrupt
            if not why:
                result = self._session.finish(recordings, heard.deadline.watch(view.working))
        except KeyboardInterrupt:
            why = STOPPED
        except NotTestedError as error:
            why = str(error)
        if why:
            result = not_tested(recordings, [self._test], self._actuator, [why])
        view.ended(result)
        self._result = result

    def deliver(self, results: Results) -> int:
        """Bring the result out; return its exit code."""
        from ehadiag.report.json_line import json_line  # noqa: PLC0415

        heard, result = self._heard, self._result
        assert heard is not None
        assert result is not None
        ended_at = heard.ended_at
        spent = Spent(self._read_s, None if ended_at is None else time.perf_counter() - ended_at)
        asked = asked_for.the_asked(self.unit.arguments, self._bus_map, [self._test])
        line = json_line(result, spent, asked, [log_file(heard.recording.source)])
        draw = partial(drawn, result, self._levels) if can_be_drawn(result) else None
        name = f"{heard.name}-{self.unit.label}" if self.unit.label else heard.name
        return results.deliver(result, line, spent, name, draw)


def _monitor_beside(
    unit: Unit,
    actuator: Actuator,
    bus_map: BusMap,
    test: StoredTest,
    history: Path | None,
) -> InTest | None:
    """Return the monitor whose residuals are shown; None where nobody would see them."""
    if unit.label:
        return None
    arguments = unit.arguments
    seen = arguments.snapshots or wants_screen(plain=arguments.plain)
    # Plain lines tell alarms only, and those only of a unit of which something is known.
    if not (seen or history is not None or actuator.calibration is not None):
        return None
    from ehadiag.cli.watch.in_test import InTest  # noqa: PLC0415 - loads numba
    from ehadiag.cli.watch.known import from_history  # noqa: PLC0415

    find = None
    if history is not None and history.exists():
        find = partial(from_history, history, actuator=actuator)
    beside = InTest(actuator, bus_map, [test], find)
    return beside if seen or not beside.why else None


def _begin(stack: ExitStack, arguments: argparse.Namespace, view: BitView) -> None:
    stack.enter_context(shown(view.look, plain=arguments.plain, snapshots=arguments.snapshots))
