"""Commands on a bus without a test of their own: `monitor`, `check-bus`, `replay`, `sim`."""

from __future__ import annotations

import argparse
import json
import shlex
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.cli import options
from ehadiag.cli.command_parser import show_help
from ehadiag.cli.options import add_history_option, history_path
from ehadiag.cli.result_output import OutputFile, append_result, refuse_overwriting
from ehadiag.cli.simulator_options import add_simulator_options, simulator_settings
from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H, LEAST_MONITORED
from ehadiag.core.conversion import conversion_of
from ehadiag.core.criteria import NORMAL_HALF_WIDTH_95
from ehadiag.core.interruption import stop_on_signals
from ehadiag.report.rendering import isolated_png
from ehadiag.terminal.output import (
    INPUT_OUTPUT_EXIT_CODE,
    print_compiling_notice,
    print_status,
    print_text,
    progress_bar,
    report_failure,
    transport_losses,
)
from ehadiag.terminal.screen import SessionScreen
from firmware_iface.errors import ConfigurationError
from firmware_iface.files import write_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ehadiag.live import Snapshot
    from ehadiag.session.unit_state import UnitState
    from ehadiag_sim.control import SimulatorControl
    from firmware_iface.transport.base import Transport


def define_monitor(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Watch an actuator on a bus without sending anything: the monitoring model"
        " runs beside it with the severities last identified, through tests and between them."
        " A change that lasts is an alarm, with what changed most likely and by how much; a"
        " built-in test says it more closely. Exit code 40 after an alarm, 0 without, 30 where too"
        " little was monitored."
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
    add_history_option(parser)
    group.add_argument(
        "--no-history", action="store_true", help="look nothing up in any health history"
    )
    group.add_argument(
        "--unit",
        type=options.unit_number,
        metavar="N",
        help="of the unit, to find it in the health history (default: as the bus says)",
    )
    for name, what in (("hours", "operating hours"), ("cycles", "cycles")):
        group.add_argument(
            f"--unit-{name}",
            type=options.positive_number,
            metavar="N",
            help=f"{what} of the unit, for its severities in the file of --history",
        )
    group = parser.add_argument_group("alarms")
    group.add_argument(
        "--hours",
        type=options.positive_number,
        default=FALSE_ALARM_INTERVAL_H,
        metavar="H",
        help="mean time between false alarms (default %(default)g; between tests at least 2)",
    )
    group.add_argument(
        "--least",
        type=options.positive_number,
        metavar="CHANGE",
        help="least change of a severity worth an alarm between tests (default 0.02)",
    )
    group.add_argument(
        "--least-monitored",
        type=partial(options.positive_number, most=1.0),
        default=LEAST_MONITORED,
        metavar="SHARE",
        help="share of the ticks below which the exit code is 30 (default %(default)g)",
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
        type=options.positive_number,
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
        type=options.positive_number,
        metavar="S",
        help="end after this time (default: at Ctrl-C)",
    )
    parser.add_argument(
        "--log",
        metavar="LOG",
        help="watch a recording, of decoded signals too, in place of a bus, as fast as it goes",
    )
    options.add_request_options(
        parser,
        "test",
        help="further test that the computer may run, to call it by its name; repeatable",
    )
    options.add_screen_options(parser)
    options.add_request_options(parser, "actuator", *options.BUS, "columns", *options.READING)
    options.add_bus_options(parser)
    show_help(
        parser,
        "ehadiag monitor --interface socketcan --channel can0 --history fleet.sqlite",
        "ehadiag monitor --log flight.blf --from results/flight.json",
        usual="--interface --channel --port --from --history --actuator --mapping --log-file "
        "--record --on-alarm --help-all",
    )


def run_monitor(
    arguments: argparse.Namespace, snapshots: Callable[[Snapshot], None] | None = None
) -> int:
    """Watch until the end, and say how it was.

    snapshots: takes the snapshots instead of the screen.
    """
    options.require_bus_or_log(arguments)
    setup = options.setup_of(arguments)
    actuator, bus_map = setup.actuator, setup.bus_map
    reads = [("the log", arguments.log), ("--from", arguments.from_result)]
    outputs = [OutputFile("--log-file", arguments.log_file)] if arguments.log_file else []
    refuse_overwriting(arguments, outputs, [(kind, name) for kind, name in reads if name])
    print_compiling_notice(identification=False)
    unit, find = _initial_unit_state(arguments, actuator)
    from ehadiag.history.records import Usage  # noqa: PLC0415
    from ehadiag.session.alarm_outlets import (  # noqa: PLC0415
        AlarmCommand,
        AlarmLog,
        AlarmRecorder,
    )
    from ehadiag.session.bus_calls import watch  # noqa: PLC0415
    from ehadiag.session.monitor_session import AlarmOutlets  # noqa: PLC0415 - loads kernels

    folder = Path(arguments.record) if arguments.record else None
    outlets = AlarmOutlets(
        AlarmLog(Path(arguments.log_file) if arguments.log_file else None),
        AlarmRecorder(folder, arguments.around, bus_map.channel),
        AlarmCommand(_command_words(arguments.on_alarm), print_status),
    )
    with (
        SessionScreen(plain=arguments.plain, snapshots=arguments.snapshots) as screen,
        stop_on_signals() as stop,
    ):
        found = watch(
            _bus_or_log(arguments),
            request=setup.request,
            unit=unit,
            find=find,
            hours=arguments.hours,
            least=arguments.least,
            least_monitored=arguments.least_monitored,
            duration_s=arguments.duration,
            stop=stop,
            bitrate=options.bitrate_from_options(arguments, bus_map),
            outlets=outlets,
            snapshots=snapshots or screen.take,
        )
    print_status(
        f"{found.monitored} of {found.ticks} ticks monitored, {found.share:.0%}; {found.lost} lost;"
        f" {found.alarm_count} alarms" + (f", {found.repeated} repeated" if found.repeated else "")
    )
    assert found.result is not None
    stated = [
        f"{item.name} {item.estimate:.3f} ± {NORMAL_HALF_WIDTH_95 * item.std:.3f}"
        for item in found.result.severities.values()
        if item.estimate is not None and item.std is not None
    ]
    print_status("; ".join(
        [f"severities by free motion: {', '.join(stated) or 'none'}", *found.result.reasons]
    ))  # fmt: skip
    codes = [0]
    if stated and arguments.history:
        with report_failure(codes):
            usage = Usage(arguments.unit_hours, arguments.unit_cycles)
            append_result(Path(arguments.history), found.result, usage, create=False)
    if found.alarm_count:
        return 40
    if found.bus_lost:
        return INPUT_OUTPUT_EXIT_CODE
    return codes[-1] or (0 if found.enough else 30)


def _initial_unit_state(
    arguments: argparse.Namespace, actuator: Actuator
) -> tuple[UnitState, Callable[[int], UnitState | None] | None]:
    """Return the state of the unit, and how it is looked up once the bus has its serial number."""
    from ehadiag.session.unit_state import (  # noqa: PLC0415
        new_unit_state,
        unit_state_from_history,
        unit_state_of,
    )

    if arguments.history and arguments.no_history:
        raise ConfigurationError("--history and --no-history exclude each other")
    if not arguments.history and (arguments.unit_hours, arguments.unit_cycles) != (None, None):
        raise ConfigurationError(
            "--unit-hours, --unit-cycles: no health history to keep them in: name one by --history"
        )
    if arguments.from_result:
        if arguments.history:
            raise ConfigurationError("--from and --history exclude each other: name one of them")
        return unit_state_of(arguments.from_result, actuator), None
    place = None if arguments.no_history else history_path(arguments)
    if place is None:
        if arguments.unit is not None:
            raise ConfigurationError("--unit: no health history to find it in: --history")
        return new_unit_state(actuator), None
    if arguments.unit is None:
        from ehadiag.history.store import History  # noqa: PLC0415

        History(place).close()  # what is wrong with it is said before the bus is opened
        return new_unit_state(actuator), partial(unit_state_from_history, place, actuator=actuator)
    unit = unit_state_from_history(place, arguments.unit, actuator)
    if unit is None:
        raise ConfigurationError(f"history {place}: no diagnosis of serial number {arguments.unit}")
    return unit, None


def _bus_or_log(arguments: argparse.Namespace) -> str | Callable[..., Transport]:
    """Return the name of the log, else what opens the bus."""
    if arguments.log is not None:
        return str(arguments.log)
    return partial(options.open_transport, arguments)


def _command_words(command: str | list[str] | None) -> list[str]:
    """Words of a command: a list in a file of defaults is one already."""
    if not isinstance(command, str):
        return command or []
    try:
        return shlex.split(command)
    except ValueError as error:
        raise ConfigurationError(f"--on-alarm {command}: {error}") from None


def define_check_bus(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Listen to a bus (or read a recording) without sending anything, and report"
        " what maps, what is missing, rates, gaps, and the range use of each channel."
        " Exit code 30 where something stands in the way of a diagnosis."
    )
    parser.add_argument("--log", metavar="LOG", help="check a recording instead of a bus")
    parser.add_argument(
        "--duration",
        type=options.positive_number,
        default=3.0,
        metavar="S",
        help="how long to listen (default 3)",
    )
    parser.add_argument("--json", action="store_true", help="print the report as one JSON object")
    parser.add_argument(
        "--plot", metavar="FILE", help="draw each channel over time, PNG; a file there is replaced"
    )
    options.add_request_options(parser, "actuator", *options.BUS, *options.READING)
    options.add_bus_options(parser)
    show_help(
        parser,
        "ehadiag check-bus --interface socketcan --channel can0",
        "ehadiag check-bus --log recording.blf --mapping rig.toml",
        usual="--interface --channel --port --log --duration --mapping --plot --json --help-all",
    )


def run_check_bus(arguments: argparse.Namespace) -> int:
    """Listen and report."""
    options.require_bus_or_log(arguments)
    setup = options.setup_of(arguments)
    from ehadiag.session.bus_calls import check_bus  # noqa: PLC0415

    with stop_on_signals() as stop, progress_bar() as display:
        found = check_bus(
            _bus_or_log(arguments),
            request=setup.request,
            duration_s=arguments.duration,
            stop=stop,
            progress=display,
        )
    print_text(json.dumps(found.to_dict()) if arguments.json else str(found))
    if arguments.plot and found.samples is None:
        print_status(f"--plot {arguments.plot}: no sample of a channel was heard, nothing is drawn")
    elif arguments.plot and found.samples is not None:
        from ehadiag.report.trend_bus_pictures import bus_picture  # noqa: PLC0415 - loads numpy

        picture = bus_picture(
            found.samples, conversion_of(found.samples, setup.actuator), found.source
        )
        write_file(Path(arguments.plot), isolated_png(picture), "picture")
        print_status(f"wrote {arguments.plot}")
    return 0 if found.usable else 30


def define_replay(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Play a recording onto a bus in its own rhythm. This transmits. The recording's"
        " requests of a test are left out: a flight-control computer would move the surface."
    )
    parser.add_argument("log", metavar="LOG")
    parser.add_argument(
        "--speed",
        type=_speed_factor,
        default=1.0,
        metavar="X",
        help="times its own rhythm (default 1); 0: as fast as the bus takes it",
    )
    parser.add_argument(
        "--with-requests",
        action="store_true",
        help="also send the recording's request frames; a flight-control computer on the bus starts"
        " the test, and the surface moves",
    )
    options.add_request_options(parser, *options.BUS, *options.READING)
    options.add_bus_options(parser)
    show_help(
        parser,
        "ehadiag replay recording.blf --interface socketcan --channel vcan0",
        "ehadiag replay recording.blf --interface socketcan --channel vcan0 --speed 2",
        usual="log --interface --channel --port --speed --with-requests --help-all",
    )


def run_replay(arguments: argparse.Namespace) -> int:
    """Play the log."""
    options.require_one_bus(arguments)
    from firmware_iface.logs.recorder import StoredLog, play_log  # noqa: PLC0415 - loads python-can

    # Errors of the log are reported before anything is sent.
    setup = options.setup_of(arguments)
    excluded = () if arguments.with_requests else setup.bus_map.request_identifiers
    log = StoredLog(arguments.log, arguments.log_channel, setup.budget, excluded)
    with (
        options.open_transport(arguments, transmit=True) as transport,
        stop_on_signals() as stop,
        progress_bar() as display,
    ):
        sent = play_log(
            log,
            transport,
            speed=arguments.speed or None,
            stop=stop,
            progress=lambda done: display("replay", done / max(log.frames, 1)),
        )
    left_out = f", {log.left_out} requests left out (--with-requests)" if log.left_out else ""
    print_status(
        f"played {sent} of {log.frames} frames on {transport.name}{left_out}"
        f"{transport_losses(transport)}"
    )
    return 0


def _speed_factor(text: str) -> float:
    return 0.0 if text.strip() in ("0", "0.0") else options.positive_number(text)


def define_sim(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Run the emulated flight-control computer and its actuator on a bus until"
        " Ctrl-C, SIGTERM or --duration."
    )
    options.add_request_options(
        parser, "test", help="further test that the computer stores; repeatable"
    )
    parser.add_argument(
        "--duration", type=options.positive_number, metavar="S", help="stop after so many seconds"
    )
    parser.add_argument(
        "--control",
        type=options.port_number,
        metavar="PORT",
        help="take changes of the simulated unit as lines of JSON on this port of the loopback"
        " address; 0: any free one",
    )
    options.add_xcp_option(parser, "serve XCP on CAN, for measurement only")
    options.add_request_options(parser, "actuator", *options.BUS)
    options.add_bus_options(parser)
    options.add_protocol_option(parser)
    add_simulator_options(parser)
    show_help(
        parser,
        "ehadiag sim --interface socketcan --channel vcan0 --FSS 0.6",
        "ehadiag sim -i virtual -c 1 --simulate scenario.toml --script wear.toml",
        usual="--interface --channel --port --simulate --script --control --Kintas --FSS --FDJ "
        "--unit --duration --help-all",
    )


@contextmanager
def _control_port(control: SimulatorControl | None, port: int | None) -> Iterator[None]:
    """Open the control port, if one is wanted, and print its number."""
    if control is None or port is None:
        yield
        return
    from ehadiag_sim.control import control_port  # noqa: PLC0415 - loads numpy

    with control_port(control, port) as number:
        print_status(f"control port {number} of the loopback address takes lines of JSON")
        yield


def run_sim(arguments: argparse.Namespace) -> int:
    """Run until stopped."""
    options.require_one_bus(arguments)
    setup = options.setup_of(arguments)
    actuator, tests, bus_map = setup.actuator, setup.tests, setup.bus_map
    print_compiling_notice(simulation=True, identification=False)
    from ehadiag_sim.emulator import emulated_computer, run_emulator  # noqa: PLC0415 - loads kernels

    settings = simulator_settings(arguments) | {"protocol": arguments.protocol}
    xcp = options.xcp_ids(arguments)
    core = emulated_computer(actuator, tests, bus_map, xcp=xcp, **settings)
    with (
        _control_port(settings["control"], arguments.control),
        options.open_transport(arguments, transmit=True) as transport,
        stop_on_signals(after_s=arguments.duration) as stop,
    ):
        names = ", ".join(
            f"{test.id} {test.name}" for test in sorted(tests, key=lambda item: item.id)
        )
        print_status(f"flight-control computer on {transport.name}, tests {names}; Ctrl-C stops it")
        ticks = run_emulator(core, transport, stop, on_degraded=print_status)
    print_status(
        f"stopped after {ticks} ticks, {core.tests_started} tests "
        f"started{transport_losses(transport)}"
    )
    return 0
