"""`ehadiag serve`: a web page on this machine that shows what the bus and the tests do."""

from __future__ import annotations

import argparse
import contextlib
import secrets
import threading
from collections.abc import Sequence
from functools import partial

from ehadiag.assess.verdict import Levels
from ehadiag.cli import asked_for, bus_options, options
from ehadiag.cli.history_file import add_keeping_options, history_place
from ehadiag.cli.output import say
from ehadiag.cli.report_page import need_report_library
from ehadiag.cli.results import make_folder
from ehadiag.core.errors import ConfigurationError, InputOutputError
from ehadiag.core.stored_test import resolve_test

__all__ = ["add_parser", "run"]

PORT = 8756
OWN = ("port", "allow_tests", "tests", "simulate", "out")
"""Options that are not handed on as they are."""
WATCHING = (
    "actuator", "mapping", "dbc", "interface", "channel", "bitrate", "fd", "data_bitrate",
    "app_name", "bus_kwargs", "serial", "baud", "allow_multicast",
)  # fmt: skip
"""Options that `monitor` knows too."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "serve",
        help="show the bus, tests, reports and history on a local web page",
        description="Serve a web page on the loopback address of this machine: bus, test, signals,"
        " residuals and severities as they come, beside reports and health history. It listens"
        " only, unless --allow-tests is given; then whoever has the printed address may start and"
        " abort tests. Needs ehadiag[report]. Ctrl-C ends it; a running test is aborted.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--port", type=_port, default=PORT, metavar="N", help=f"0: any that is free ({PORT})"
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
        metavar=options.TEST,
        help="test that may be started, repeatable (default: open and closed)",
    )
    parser.add_argument(
        "--simulate",
        action="store_true",
        help="tests run on the emulated flight-control computer",
    )
    parser.add_argument(
        "--out",
        default="ehadiag-out",
        metavar="DIR",
        help="recordings, results and reports (default ehadiag-out)",
    )
    options.add_actuator_options(parser)
    options.add_mapping_options(parser)
    bus_options.add_bus_options(parser)
    add_keeping_options(parser)
    options.add_level_options(parser)
    parser.set_defaults(run=partial(run, parser=parser))


def run(arguments: argparse.Namespace, parser: argparse.ArgumentParser) -> int:
    """Serve until Ctrl-C.

    parser: that the arguments are from.
    """
    need_report_library()
    watched = bus_options.has_bus(arguments)
    if arguments.simulate and not arguments.allow_tests:
        raise ConfigurationError("--simulate: nothing is simulated without --allow-tests")
    if not watched and not arguments.simulate:
        bus_options.need_one_bus(arguments)
    names = arguments.tests or ["open", "closed"]
    tests = {resolve_test(name).name: name for name in names}
    asked_for.the_actuator(arguments)
    asked_for.the_bus_map(arguments)
    if watched:
        _try_bus(arguments)
    folder = make_folder(arguments.out)
    from ehadiag.serve.pages import Pages  # noqa: PLC0415 - bokeh is slow
    from ehadiag.serve.server import HOST, Site, serve  # noqa: PLC0415
    from ehadiag.serve.sessions import Sessions  # noqa: PLC0415

    token = secrets.token_urlsafe(16) if arguments.allow_tests else None
    everything = handed_on(arguments, parser)
    watch = ["monitor", "--snapshots", *handed_on(arguments, parser, WATCHING)] if watched else None
    asked = {
        name: _test_command(arguments, given, everything)
        for name, given in tests.items()
        if token is not None
    }
    history = None if arguments.no_history else history_place(arguments)
    levels = Levels(arguments.advisory, arguments.limit)
    with Sessions(watch, asked) as sessions:
        pages = Pages(folder.path, history, levels, tuple(asked))
        server = serve(Site(pages, sessions, token), arguments.port)
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        address = f"http://{HOST}:{server.server_port}/"
        say(f"serving {address}{'' if token is None else f'#token={token}'} (Ctrl-C ends)")
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
        server.shutdown()
        server.server_close()
    return 0


def _try_bus(arguments: argparse.Namespace) -> None:
    """Refuse wrong options of the bus at once; a bus that is not there yet may come."""
    with (
        contextlib.suppress(InputOutputError),
        bus_options.open_transport(arguments, transmit=False),
    ):
        pass


def _test_command(arguments: argparse.Namespace, test: str, others: Sequence[str]) -> list[str]:
    kind = ["--simulate"] if arguments.simulate else []
    return [
        "bit", "--snapshots", "--test", test, "--out", arguments.out, "--report", "--no-picture",
        *kind, *others,
    ]  # fmt: skip


def handed_on(
    arguments: argparse.Namespace,
    parser: argparse.ArgumentParser,
    only: Sequence[str] | None = None,
) -> list[str]:
    """Return options as they were given, for the command line of a session.

    Parameters
    ----------
    arguments : argparse.Namespace
        The parsed command line of `serve`.
    parser : argparse.ArgumentParser
        That parsed it.
    only : Sequence[str] | None
        Names of the options that the session knows; None: all but those of `serve` itself.

    Returns
    -------
    list[str]
        Options and their values.
    """
    out: list[str] = []
    for action in parser._actions:
        name = action.dest
        if not action.option_strings or name in (*OWN, "help"):
            continue
        if only is not None and name not in only:
            continue
        value = getattr(arguments, name, None)
        flag = action.option_strings[-1]
        if value is True:
            out.append(flag)
        elif isinstance(value, list) and value:
            out += [flag, *value]
        elif value not in (None, False, []):
            out.append(f"{flag}={value}")
    return out


def _port(text: str) -> int:
    if text.isdecimal() and text.isascii() and len(text) < 6 and int(text) < 1 << 16:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r}: need a port, 0 … 65535")
