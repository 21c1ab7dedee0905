"""Command-line options that several commands share, and the numbers that they take."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from ehadiag.core.conventions import MAX_HISTORY_SERIAL, SIGNAL_FILE_KINDS
from ehadiag.request import Option, Request, request_options
from ehadiag.setup import Setup

if TYPE_CHECKING:
    from firmware_iface.xcp import XcpIds


def positive_number(text: str, *, or_zero: bool = False, most: float = math.inf) -> float:
    """Read a number above zero, or zero where that will do, and of at most so much."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if (0.0 < value < math.inf and value <= most) or (or_zero and value == 0.0):
        return value
    needed = ("of at least 0" if or_zero else "above 0") + f", {most:g} at most" * (most < math.inf)
    raise argparse.ArgumentTypeError(f"{text!r}: need a number {needed}")


def integer_number(text: str, needed: str, least: int, largest: int = MAX_HISTORY_SERIAL) -> int:
    """Read a whole number between two; `needed` says in words which one will do."""
    digits = text.isascii() and text.isdigit() and len(text) <= len(str(MAX_HISTORY_SERIAL))
    if digits and least <= int(text) <= largest:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r}: {needed}")


positive_count = partial(integer_number, needed="need a whole number above 0", least=1)
port_number = partial(integer_number, needed="need a port, 0 … 65535", least=0, largest=65535)
seed_number = partial(
    integer_number, needed="a seed is a whole number, 0 … 4294967295", least=0, largest=4294967295
)


def unit_number(text: str) -> int:
    """Read a serial number of a unit, as far as buses and histories carry them."""
    if text in ("hours", "cycles"):
        raise argparse.ArgumentTypeError(f"{text!r}: the unit of the answer is --in {text} now")
    needed = f"a serial number is a whole number, 0 … {MAX_HISTORY_SERIAL}"
    return integer_number(text, needed, least=0)


BUS = ("mapping", "dbc", "id_offset")
"""Fields of a request: what the frames of a bus mean."""
READING = ("log_channel", "max_frames", "max_log_size_MiB", "max_read_time_s")
"""Fields of a request: the channel of a recording, and what reading one may cost."""
LEVELS = ("advisory", "limit")
"""Fields of a request: levels of a verdict."""
SEARCH = ("solver", "nuisances", "tolerance", "seed", *LEVELS, "rule", "time_limit_s")
"""Fields of a request: all that decides an identification and its verdict."""


def add_request_options(
    parser: argparse.ArgumentParser, *names: str, help: str | None = None
) -> None:
    """Add the options of fields of a request.

    parser: of a command; names: fields, in the order of the help; help: in place of what the fields
    say of themselves.
    """
    for name in names:
        option = request_options()[name]
        text = help or option.help
        settings: dict[str, Any] = {"dest": name, "help": text.replace("%", "%%")}
        if option.kind is bool:
            parser.add_argument(option.flag, action="store_true", **settings)
            continue
        if option.many:
            settings |= {"action": "append", "default": []}
        else:
            settings |= {"default": option.default, "type": _reader(option)}
        if option.choices:
            settings["choices"] = option.choices
        parser.add_argument(option.flag, metavar=option.metavar, **settings)


def _reader(option: Option) -> Callable[[str], Any]:
    def read(text: str) -> Any:
        try:
            return option.read(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return str if option.choices or option.kind is str else read


def request_of(arguments: argparse.Namespace, **changes: Any) -> Request:
    """Return what a command line asks for.

    arguments: the parsed command line; fields that its command has no option for keep their
    defaults; changes: fields with other values. ConfigurationError: values that contradict each
    other.
    """
    given = vars(arguments)
    fields = {name: given[name] for name in Request.__struct_fields__ if name in given}
    for name in ("actuator", "mapping", "dbc"):
        fields[name] = fields.get(name) or None
    return Request(**fields | changes)


def setup_of(arguments: argparse.Namespace, label: str = "", **changes: Any) -> Setup:
    """Return what a command line names; `label`, `changes`: see `Setup` and `request_of`."""
    return Setup(request_of(arguments, **changes), label=label)


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Add `--json`."""
    parser.add_argument(
        "--json",
        action="store_true",
        help="print one JSON object a line to standard output, nothing else there",
    )


def add_result_options(parser: argparse.ArgumentParser) -> None:
    """Add what is written of a result beside its JSON object."""
    parser.add_argument("--no-picture", action="store_true", help="draw nothing")
    add_report_option(parser)
    parser.add_argument(
        "--signals",
        action="append",
        choices=SIGNAL_FILE_KINDS,
        default=[],
        metavar="KIND",
        help="also write recorded and modelled signals, residuals and events to the output folder:"
        " mf4 (ASAM MDF4) or mcap (Foxglove, PlotJuggler); repeatable",
    )


def add_screen_options(parser: argparse.ArgumentParser) -> None:
    """Add `--plain` and `--snapshots`."""
    parser.add_argument(
        "--plain",
        action="store_true",
        help="plain lines instead of the live view (so anyway where standard error is no terminal)",
    )
    parser.add_argument(
        "--snapshots",
        action="store_true",
        help="write what the live view shows to standard output, four JSON lines a second; all else"
        " goes to standard error. The session ends as by Ctrl-C when nobody reads any more",
    )


def add_xcp_option(parser: argparse.ArgumentParser, help: str) -> None:
    """Add `--xcp`."""
    parser.add_argument(
        "--xcp",
        nargs="?",
        const=True,
        metavar="REQ:RES",
        help=f"{help}; identifiers in hexadecimal (default 6F0:6F1)",
    )


def xcp_ids(arguments: argparse.Namespace) -> XcpIds | None:
    """Return the identifiers of `--xcp`; None without it."""
    if arguments.xcp is None:
        return None
    from firmware_iface.xcp import XcpIds, parse_xcp_ids  # noqa: PLC0415 - loads numpy

    return XcpIds() if arguments.xcp is True else parse_xcp_ids(arguments.xcp)


def add_report_option(parser: argparse.ArgumentParser, place: str = "to the output folder") -> None:
    """Add `--report`; `place` says where the page goes."""
    parser.add_argument(
        "--report",
        action="store_true",
        help=f"also write a report, one HTML page that needs no network, {place}",
    )
