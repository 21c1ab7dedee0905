"""`ehadiag bit`: requests a built-in test, records it, diagnoses it."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.cli import options
from ehadiag.cli.command_parser import show_help
from ehadiag.cli.options import add_actuators_options, add_history_options, arguments_of_actuators
from ehadiag.cli.result_output import (
    OutputFile,
    ResultWriter,
    open_output_folder,
    refuse_overwriting,
)
from ehadiag.cli.simulator_options import add_simulator_options, simulator_settings
from ehadiag.core.interruption import stop_on_signals
from ehadiag.request import TEST
from ehadiag.session.bit_run import (
    BitSettings,
    BitTest,
    listen_for_tests,
    measured_by_xcp,
    recording_path,
    refuse_untestable,
)
from ehadiag.session.bus_calls import ONBOARD_WAIT_S
from ehadiag.terminal.output import print_compiling_notice, print_status, worst_exit_code
from ehadiag.terminal.screen import SessionScreen, can_show_screen
from firmware_iface.errors import ConfigurationError
from firmware_iface.stored_test import StoredTest, resolve_test

if TYPE_CHECKING:
    from ehadiag.live import Snapshot
    from ehadiag.session.monitor_session import BitMonitor
    from ehadiag.setup import Setup
    from ehadiag_sim.emulator import Pace
    from firmware_iface.logs.recorder import Recorder
    from firmware_iface.transport.base import Transport

LIMIT_OPTIONS = (
    ("position", "mm", "jack position", 1e-3),
    ("pressure", "MPa", "differential pressure", 1e6),
    ("current", "mA", "servovalve current", 1e-3),
)
"""Channels with a limit: unit of the option, meaning, SI value of one unit."""


def define_bit(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Request a built-in test on a bus, record it to disk while it runs, diagnose"
        " it. The request makes the surface move. Ctrl-C requests an abort."
    )
    parser.add_argument(
        "--test",
        required=True,
        metavar=TEST,
        help="stored test by name or number, or a test file",
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
    for name, unit, what, _ in LIMIT_OPTIONS:
        parser.add_argument(
            f"--max-{name}",
            type=options.positive_number,
            metavar=unit,
            help=f"abort the test when the {what} goes beyond ±{unit} (default: not watched)",
        )
    parser.add_argument(
        "--onboard-wait",
        type=options.positive_number,
        default=ONBOARD_WAIT_S,
        metavar="S",
        help="wait after the test for the flight-control computer's own result, s (default 60)",
    )
    options.add_xcp_option(parser, "measure command and channels by XCP, not by telemetry")
    options.add_screen_options(parser)
    add_actuators_options(parser)
    options.add_request_options(parser, *options.SEARCH)
    options.add_json_option(parser)
    add_history_options(parser)
    options.add_result_options(parser)
    options.add_bus_options(parser)
    options.add_protocol_option(parser)
    add_simulator_options(parser)
    show_help(
        parser,
        "ehadiag bit --test closed --simulate --FSS 0.6",
        "ehadiag bit --test closed --interface socketcan --channel can0 --report",
        usual="--test --simulate --fast --FSS --interface --channel --out --report --actuator "
        "--history --help-all",
    )


def run_bit(
    arguments: argparse.Namespace, snapshots: Callable[[Snapshot], None] | None = None
) -> int:
    """Run the test and print the verdict, or that of each actuator listened to.

    snapshots: takes the snapshots instead of the screen.
    """
    test = resolve_test(arguments.test)
    setups = _setups(arguments, test)
    if arguments.record:
        refuse_overwriting(arguments, [OutputFile("--record", arguments.record)])
    folder = open_output_folder(arguments.out)
    print_compiling_notice(simulation=bool(arguments.simulate))
    results = ResultWriter(arguments, folder)
    path = Path(arguments.record) if arguments.record else recording_path(folder.path, test)
    with ExitStack() as stack:
        screen = stack.enter_context(
            SessionScreen(plain=arguments.plain, snapshots=arguments.snapshots)
        )
        single = len(setups) == 1  # no screen shows several
        show = (snapshots or screen.take) if single else None
        shown = bool(snapshots or arguments.snapshots or can_show_screen(plain=arguments.plain))
        monitor = (
            _bit_monitor(setups[0], test, results.history.place, shown=shown) if single else None
        )
        simulation = _Simulation()
        runs = [
            stack.enter_context(
                BitTest(
                    setup,
                    _settings(arguments, setup, simulation),
                    monitor=monitor,
                    snapshots=show,
                )
            )
            for setup in setups
        ]
        results.load()
        with stop_on_signals() as stop:
            if single:
                connection = _connection(arguments, setups[0], test, path, simulation)
                runs[0].acquire(connection, str(path), stop)
            else:
                from firmware_iface.logs.recorder import Recorder  # noqa: PLC0415 - loads python-can

                names = ", ".join(item.label for item in setups)
                print_status(f"listening for test {test.name!r} of {names}, recording to {path}")
                with options.open_transport(arguments, transmit=False) as bus:
                    recorder = Recorder(path, channel=setups[0].bus_map.channel)
                    listen_for_tests(runs, bus, recorder, str(path), stop)
        found = [item.diagnose(stop) for item in runs]
    codes = set()
    for result, setup in zip(found, setups, strict=True):
        name = f"{path.stem}-{setup.label}" if setup.label else path.stem
        codes.add(results.deliver(result, name))
    return worst_exit_code(codes) if len(codes) > 1 else codes.pop()


def _setups(arguments: argparse.Namespace, test: StoredTest) -> Sequence[Setup]:
    """Return what is diagnosed, one for each actuator; refuse what could not end in a verdict."""
    named = arguments_of_actuators(arguments)
    if len(named) > 1 and not arguments.listen:
        raise ConfigurationError(
            "--mapping: a test is requested of one actuator; name one mapping, or --listen"
        )
    setups = [options.setup_of(item.arguments, item.label) for item in named]
    _refuse_contradictions(arguments)
    for setup in setups:
        refuse_untestable(
            test,
            setup.actuator,
            setup.bus_map,
            transmit=not arguments.listen,
            protocol=arguments.protocol,
        )
    return setups


@dataclass
class _Simulation:
    """The simulated computer of a call, if any."""

    pace: Pace | None = None

    def own_fault(self) -> str:
        """Say whether this computer is too busy to simulate."""
        # Telemetry that is later than this counts as lost.
        if self.pace is None or self.pace.behind_s < 0.25:
            return ""
        return (
            "this computer is too busy to simulate in real time: the simulated actuator fell"
            f" {self.pace.behind_s:.1f} s behind; close other programs, or add --fast"
        )


def _settings(arguments: argparse.Namespace, setup: Setup, simulation: _Simulation) -> BitSettings:
    from firmware_iface.handshake import ChannelLimits  # noqa: PLC0415 - loads cantools

    limits = {
        name: getattr(arguments, f"max_{name}") * scale
        for name, _, _, scale in LIMIT_OPTIONS
        if getattr(arguments, f"max_{name}") is not None
    }
    return BitSettings(
        transmit=not arguments.listen,
        limits=ChannelLimits(**limits),
        onboard_wait_s=arguments.onboard_wait,
        protocol=arguments.protocol,
        bitrate=options.bitrate_from_options(arguments, setup.bus_map),
        own_fault=simulation.own_fault,
    )


@contextmanager
def _connection(
    arguments: argparse.Namespace,
    setup: Setup,
    test: StoredTest,
    path: Path,
    simulation: _Simulation,
) -> Iterator[tuple[Transport, Recorder]]:
    """Open the bus and the recording; begin the emulated computer with `--simulate`."""
    from firmware_iface.logs.recorder import Recorder  # noqa: PLC0415 - loads python-can

    with ExitStack() as stack:
        if not arguments.simulate:
            bus = stack.enter_context(
                options.open_transport(arguments, transmit=not arguments.listen)
            )
        else:
            from ehadiag_sim.emulator import (  # noqa: PLC0415 - loads kernels
                EmulatorTransport,
                emulated_computer,
                emulator_in_thread,
            )

            settings = simulator_settings(arguments) | {"protocol": arguments.protocol}
            xcp = options.xcp_ids(arguments)
            core = emulated_computer(setup.actuator, [test], setup.bus_map, xcp=xcp, **settings)
            if arguments.fast:
                bus = stack.enter_context(EmulatorTransport(core))
            else:
                if not options.has_bus(arguments):
                    arguments.interface, arguments.channel = "virtual", f"ehadiag-{id(arguments):x}"
                computer, bus = (
                    stack.enter_context(options.open_transport(arguments, transmit=True))
                    for _ in range(2)
                )
                simulation.pace = stack.enter_context(emulator_in_thread(core, computer))
        ids = options.xcp_ids(arguments)
        if ids is not None:
            bus = stack.enter_context(measured_by_xcp(bus, setup, test, ids, arguments.protocol))
        recorder = Recorder(path, channel=setup.bus_map.channel)
        print_status(f"test {test.name!r} on {bus.name}, recording to {path}")
        yield bus, recorder


def _bit_monitor(
    setup: Setup, test: StoredTest, history: Path | None, *, shown: bool
) -> BitMonitor | None:
    """Return the monitor whose residuals are shown; None where they are not.

    Plain lines have only alarms, and those only of a unit with a history or a calibration.
    """
    if not (shown or history is not None or setup.actuator.calibration is not None):
        return None
    from ehadiag.session.monitor_session import BitMonitor  # noqa: PLC0415 - loads kernels
    from ehadiag.session.unit_state import unit_state_from_history  # noqa: PLC0415

    find = None
    if history is not None and history.exists():
        find = partial(unit_state_from_history, history, actuator=setup.actuator)
    monitor = BitMonitor(setup.actuator, setup.bus_map, [test], find)
    return monitor if shown or not monitor.why else None


def _refuse_contradictions(arguments: argparse.Namespace) -> None:
    if options.xcp_ids(arguments) is not None and arguments.listen:
        raise ConfigurationError("--xcp: measures on command, and --listen sends nothing")
    if arguments.simulate and arguments.listen:
        raise ConfigurationError("--simulate and --listen exclude each other")
    if arguments.fast and not arguments.simulate:
        raise ConfigurationError("--fast: only the simulated actuator can hurry, add --simulate")
    if arguments.fast and options.has_bus(arguments):
        named = next(name for name in ("port", "interface", "context") if getattr(arguments, name))
        raise ConfigurationError(f"--fast: a bus has its own time, leave --{named} out")
    if arguments.simulate and arguments.port:
        raise ConfigurationError(
            "--simulate: a serial link has two ends, run ehadiag sim on the other one"
        )
    if arguments.simulate:
        options.refuse_two_buses(arguments)
    else:
        options.require_one_bus(arguments)
