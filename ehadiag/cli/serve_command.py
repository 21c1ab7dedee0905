"""`ehadiag serve`: a web page on this machine that shows what the bus and the tests do."""

from __future__ import annotations

import argparse
import contextlib
import secrets
import threading
from collections.abc import Iterable, Mapping
from functools import partial

from ehadiag.assess.verdict import Levels
from ehadiag.cli import bit_command, bus_commands, options
from ehadiag.cli.command_parser import show_help
from ehadiag.cli.options import add_history_options, history_path
from ehadiag.cli.result_output import open_output_folder
from ehadiag.request import TEST
from ehadiag.terminal.output import print_status
from ehadiag_sim.conditions import Faults, condition_options
from firmware_iface.errors import ConfigurationError, InputOutputError
from firmware_iface.stored_test import resolve_test

DEFAULT_PORT = 8756
SERVE_OPTIONS = ("http_port", "allow_tests", "tests", "simulate", "out", "run", "verbose")
"""Options that a test does not take from `serve` as they are."""
MONITOR_OPTIONS = (
    "actuator", "mapping", "dbc", "interface", "channel", "context", "bitrate", "fd",
    "data_bitrate", "app_name", "bus_kwargs", "port", "baud", "allow_multicast",
)  # fmt: skip
"""Options that `monitor` has with the same meaning."""


def define_serve(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Serve a web page on the loopback address of this machine: bus, test, signals,"
        " residuals and severities as they come, beside reports and health history. It listens"
        " only, unless --allow-tests is given; then whoever has the printed address may start and"
        " abort tests. Ctrl-C ends it; a running test is aborted."
    )
    parser.add_argument(
        "--http-port",
        type=options.port_number,
        default=DEFAULT_PORT,
        metavar="N",
        help=f"port on 127.0.0.1 (default {DEFAULT_PORT}); 0: any free one",
    )
    parser.add_argument(
        "--allow-tests",
        action="store_true",
        help="let the page start and abort tests; the surface moves",
    )
    parser.add_argument(
        "--test",
        dest="tests",
        action="append",
        metavar=TEST,
        help="test that may be started, repeatable (default: open and closed)",
    )
    parser.add_argument(
        "--simulate",
        nargs="?",
        const=True,
        metavar="FILE",
        help="tests run on the simulated computer and actuator; FILE: a scenario, as for bit",
    )
    parser.add_argument(
        "--out",
        default="ehadiag-out",
        metavar="DIR",
        help="recordings, results and reports (default ehadiag-out)",
    )
    options.add_xcp_option(parser, "tests measure command and channels by XCP, not by telemetry")
    options.add_request_options(parser, "actuator", *options.BUS)
    options.add_bus_options(parser)
    options.add_protocol_option(parser)
    add_history_options(parser)
    options.add_request_options(parser, *options.LEVELS)
    show_help(
        parser,
        "ehadiag serve --simulate --allow-tests",
        "ehadiag serve --interface socketcan --channel can0 --history fleet.sqlite",
        usual="--interface --channel --port --allow-tests --simulate --test --history --out "
        "--http-port --actuator --help-all",
    )


def run_serve(arguments: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    if (arguments.port or "").isdecimal():
        raise ConfigurationError(
            f"--port {arguments.port}: names a serial port now; the page's is --http-port"
        )
    watched = options.has_bus(arguments)
    if arguments.simulate and not arguments.allow_tests:
        raise ConfigurationError("--simulate: nothing is simulated without --allow-tests")
    if not arguments.allow_tests and (arguments.xcp or arguments.protocol != "native"):
        named = "xcp" if arguments.xcp else "protocol"
        raise ConfigurationError(f"--{named}: no test is requested without --allow-tests")
    if not watched and not arguments.simulate:
        options.require_one_bus(arguments)
    names = arguments.tests or ["open", "closed"]
    tests = {resolve_test(name).name: name for name in names}
    setup = options.setup_of(arguments)
    _ = setup.actuator, setup.bus_map
    if watched:
        _check_bus_options(arguments)
    folder = open_output_folder(arguments.out)
    from ehadiag.serve.pages import Pages  # noqa: PLC0415 - bokeh is slow
    from ehadiag.serve.server import LOOPBACK_ADDRESS, Site, serve  # noqa: PLC0415
    from ehadiag.serve.sessions import Session, SessionRunner  # noqa: PLC0415

    token = secrets.token_urlsafe(16) if arguments.allow_tests else None
    watch = None
    if watched:
        settings = monitor_arguments(arguments)
        watch = Session("watching the bus", bus_commands.run_monitor, (settings,))
    sessions = {}
    for name, given in tests.items() if token is not None else ():
        settings = bit_arguments(arguments, given)
        adjust = partial(_with_severities, settings) if arguments.simulate else None
        sessions[name] = Session(f"test {name}", bit_command.run_bit, (settings,), adjust)
    history = None if arguments.no_history else history_path(arguments)
    levels = Levels(arguments.advisory, arguments.limit)
    with SessionRunner(watch, sessions) as runner:
        simulated = bool(arguments.simulate)
        pages = Pages(folder.path, history, levels, tuple(sessions), simulated=simulated)
        server = serve(Site(pages, runner, token), arguments.http_port)
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        address = f"http://{LOOPBACK_ADDRESS}:{server.server_port}/"
        print_status(f"serving {address}{'' if token is None else f'#token={token}'} (Ctrl-C ends)")
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
        server.shutdown()
        server.server_close()
    return 0


def _with_severities(
    settings: argparse.Namespace, severities: Mapping[str, float]
) -> tuple[argparse.Namespace]:
    """Return the arguments of a test on a simulated unit with other severities."""
    strangers = severities.keys() - {item.field for item in condition_options(Faults)}
    if strangers:
        raise ValueError(f"severities: there is no fault {min(strangers)}")
    return (argparse.Namespace(**vars(settings) | dict(severities)),)


def _check_bus_options(arguments: argparse.Namespace) -> None:
    """Refuse wrong options of the bus at once; a bus that is not there yet may come."""
    with (
        contextlib.suppress(InputOutputError),
        options.open_transport(arguments, transmit=False),
    ):
        pass


def monitor_arguments(arguments: argparse.Namespace) -> argparse.Namespace:
    """Return the options of `monitor` that watches the bus for `serve`."""
    from ehadiag.cli.main import parse_arguments  # noqa: PLC0415 - it has this module's parser

    return _with_options(parse_arguments(["monitor"]), arguments, MONITOR_OPTIONS)


def bit_arguments(arguments: argparse.Namespace, test: str) -> argparse.Namespace:
    """Return the options of `bit` that runs a test, by its name, for `serve`."""
    from ehadiag.cli.main import parse_arguments  # noqa: PLC0415 - it has this module's parser

    session = parse_arguments(["bit", "--test", test])
    session.out, session.simulate = arguments.out, arguments.simulate
    session.report = session.no_picture = True
    return _with_options(session, arguments, vars(arguments).keys() - set(SERVE_OPTIONS))


def _with_options(
    session: argparse.Namespace, arguments: argparse.Namespace, names: Iterable[str]
) -> argparse.Namespace:
    """Return a command's options, its own defaults replaced by what `serve` was given."""
    for name in names:
        value = getattr(arguments, name, None)
        if value not in (None, False, []):
            several = isinstance(getattr(session, name), list) and not isinstance(value, list)
            setattr(session, name, [value] if several else value)
    return session
