"""`ehadiag monitor`: watches an actuator on a bus, and says when it is no longer as it was."""

from __future__ import annotations

import argparse
import contextlib
import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.cli import argument_types, asked_for, bus_options, options
from ehadiag.cli.history_file import add_history_file, history_place
from ehadiag.cli.interrupt import stop_on_signals
from ehadiag.cli.output import say, say_if_compiling
from ehadiag.cli.overwriting import Output, refuse_overwriting
from ehadiag.cli.screen.show import add_screen_options, shown
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.false_alarms import HOURS_BETWEEN

if TYPE_CHECKING:
    from collections.abc import Callable

    from ehadiag.cli.watch.known import KnownUnit
    from ehadiag.core.actuator import Actuator
    from firmware_iface.transport.interface import Transport

__all__ = ["ALARM", "add_parser", "run"]

ALARM = 40
NOT_MONITORED = 30
BUS_LOST = 3


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "monitor",
        help="watch an actuator on a bus, and raise an alarm when it changes",
        description="Watch an actuator on a bus without sending anything: the monitoring model"
        " runs beside it with the severities last identified, through tests and between them."
        " Where the residuals are no longer noise an alarm is raised. It says that something"
        " changed; a built-in test says what. Exit code 40 after an alarm, 0 without, 30 where"
        " there was nothing to monitor.",
        allow_abbrev=False,
    )
    group = parser.add_argument_group(
        "what is known of the unit", "without any of them it is taken as new"
    )
    group.add_argument(
        "--from",
        dest="from_result",
        metavar="RESULT.json",
        help="result of a diagnosis: severities, offsets, noise and effects of the unit",
    )
    add_history_file(parser)
    group.add_argument(
        "--no-history", action="store_true", help="look nothing up in any health history"
    )
    group.add_argument(
        "--serial-number",
        type=argument_types.unit_serial,
        metavar="N",
        help="of the unit, to find it in the health history (default: as the bus says)",
    )
    group = parser.add_argument_group("alarms")
    group.add_argument(
        "--hours",
        type=argument_types.positive,
        default=HOURS_BETWEEN,
        metavar="H",
        help="mean time between false alarms of the sums (default %(default)g); between tests only"
        " what lasts is an alarm",
    )
    group.add_argument(
        "--log-file", metavar="FILE", help="append alarms to this file, JSON lines with their time"
    )
    group.add_argument(
        "--record",
        metavar="DIR",
        help="record the seconds around each alarm to a BLF in this folder",
    )
    group.add_argument(
        "--around",
        type=argument_types.positive,
        default=5.0,
        metavar="S",
        help="seconds to record before and after an alarm (default 5)",
    )
    group.add_argument(
        "--on-alarm",
        metavar="COMMAND",
        help="command to call for each alarm, its words quoted as for a shell but called without"
        " one; the alarm's JSON object is on its standard input",
    )
    parser.add_argument(
        "--duration",
        type=argument_types.positive,
        metavar="S",
        help="end after this time (default: at Ctrl-C)",
    )
    parser.add_argument(
        "--log", metavar="LOG", help="watch a recording instead of a bus, as fast as it goes"
    )
    parser.add_argument(
        "--test",
        action="append",
        default=[],
        metavar=options.TEST,
        help="further test that the computer may run, to call it by its name; repeatable",
    )
    add_screen_options(parser)
    options.add_actuator_options(parser)
    options.add_mapping_options(parser)
    options.add_log_options(parser)
    bus_options.add_bus_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Watch until the end, and say how it was."""
    bus_options.need_bus_or_log(arguments)
    actuator, bus_map = asked_for.the_actuator(arguments), asked_for.the_bus_map(arguments)
    tests = asked_for.known_tests(arguments.test)
    reads = [("the log", arguments.log), ("--from", arguments.from_result)]
    outputs = [Output("--log-file", arguments.log_file)] if arguments.log_file else []
    refuse_overwriting(arguments, outputs, [(kind, name) for kind, name in reads if name])
    say_if_compiling(identification=False)
    unit, find = _known(arguments, actuator)
    from ehadiag.cli.watch.alarm_log import AlarmLog  # noqa: PLC0415
    from ehadiag.cli.watch.call import AlarmCommand  # noqa: PLC0415
    from ehadiag.cli.watch.session import Outlets, WatchSession  # noqa: PLC0415
    from ehadiag.cli.watch.surroundings import Surroundings  # noqa: PLC0415
    from ehadiag.cli.watch.watcher import Watcher  # noqa: PLC0415 - loads numba
    from ehadiag.live.traffic import Traffic  # noqa: PLC0415
    from firmware_iface.transport.receiver import open_source  # noqa: PLC0415

    with contextlib.ExitStack() as stack:
        traffic = Traffic(bus_options.the_bitrate(arguments, bus_map))
        outlets = Outlets(
            AlarmLog(Path(arguments.log_file) if arguments.log_file else None),
            Surroundings(
                Path(arguments.record) if arguments.record else None,
                arguments.around,
                bus_map.channel,
            ),
            AlarmCommand(_words(arguments.on_alarm)),
        )
        stack.callback(outlets.close)
        session = WatchSession(actuator.name, traffic, outlets, find)
        session.watcher = Watcher(actuator, bus_map, unit, tests, arguments.hours, session.alarm)
        with (
            _transport(arguments) as transport,
            stop_on_signals() as stop,
            open_source(transport) as source,
            shown(session.look, plain=arguments.plain, snapshots=arguments.snapshots) as publisher,
        ):
            session.tell = publisher.refresh
            session.run(source, stop, arguments.duration)
    watcher = session.watcher
    say(
        f"{watcher.pushed} ticks monitored, {watcher.lost} lost; {watcher.alarms} alarms"
        + (f", {watcher.again} repeated" if watcher.again else "")
    )
    if watcher.alarms:
        return ALARM
    if session.lost_bus:
        return BUS_LOST
    return 0 if watcher.pushed else NOT_MONITORED


def _known(
    arguments: argparse.Namespace, actuator: Actuator
) -> tuple[KnownUnit, Callable[[int], KnownUnit | None] | None]:
    """What is known of the unit now, and how more is found out once the bus says which it is."""
    from ehadiag.cli.watch.known import as_new, from_history, from_result  # noqa: PLC0415

    if arguments.from_result:
        if arguments.history:
            raise ConfigurationError("--from and --history exclude each other: name one of them")
        return from_result(Path(arguments.from_result), actuator), None
    place = None if arguments.no_history else history_place(arguments)
    if place is None:
        if arguments.serial_number is not None:
            raise ConfigurationError("--serial-number: no health history to find it in: --history")
        return as_new(actuator), None
    find = partial(_found, place, actuator=actuator)
    if arguments.serial_number is None:
        from ehadiag.history.store import History  # noqa: PLC0415

        History(place).close()  # what is wrong with it is said before the bus is opened
        return as_new(actuator), find
    unit = from_history(place, arguments.serial_number, actuator)
    if unit is None:
        raise ConfigurationError(
            f"history {place}: no diagnosis of serial number {arguments.serial_number}"
        )
    return unit, None


def _words(command: str | list[str] | None) -> list[str]:
    """Words of a command: a list in a file of defaults is one already."""
    if not isinstance(command, str):
        return command or []
    try:
        return shlex.split(command)
    except ValueError as error:
        raise ConfigurationError(f"--on-alarm {command}: {error}") from None


def _found(place: Path, serial: int, actuator: Actuator) -> KnownUnit | None:
    from ehadiag.cli.watch.known import from_history  # noqa: PLC0415

    return from_history(place, serial, actuator)


def _transport(arguments: argparse.Namespace) -> Transport:
    if arguments.log is None:
        return bus_options.open_transport(arguments, transmit=False)
    from firmware_iface.logs.reader import read_frames  # noqa: PLC0415
    from firmware_iface.logs.replay import ReplayTransport  # noqa: PLC0415

    return ReplayTransport(
        read_frames(arguments.log, asked_for.the_budget(arguments)), str(arguments.log)
    )
