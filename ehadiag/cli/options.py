"""Command-line options that several commands share, and what they name: bus, request, history."""

from __future__ import annotations

import argparse
import math
import os
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from ehadiag.core.conventions import MAX_HISTORY_SERIAL, SIGNAL_FILE_KINDS
from ehadiag.request import Option, Request, request_options
from ehadiag.setup import Setup
from firmware_iface.errors import ConfigurationError

if TYPE_CHECKING:
    from ehadiag.history.records import Usage
    from ehadiag.history.store import History
    from firmware_iface.bus_map import BusMap
    from firmware_iface.transport.base import Transport
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
        if not option.flag:
            parser.add_argument(**settings, nargs="+", metavar="LOG")
            continue
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


class ActuatorArguments(msgspec.Struct, frozen=True):
    """One of the actuators that a command line names."""

    arguments: argparse.Namespace
    """As if it were the only one."""
    label: str
    """Name of its mapping, which tells its results from the others'; empty of the only one."""


def add_actuators_options(parser: argparse.ArgumentParser) -> None:
    """Add actuator, mapping, DBC and identifiers; the first two once for each actuator."""
    parser.add_argument(
        "--actuator",
        action="append",
        default=[],
        metavar="FILE",
        help="actuator data, TOML (default: the reference actuator); with several --mapping one"
        " for all of them, or one for each",
    )
    parser.add_argument(
        "--mapping",
        action="append",
        default=[],
        metavar="FILE",
        help="which signals of a DBC are which channels, TOML (default: the FCC's own bus); once"
        " for each actuator on the bus, and each is diagnosed",
    )
    add_request_options(parser, "dbc", "id_offset")


def add_protocol_option(parser: argparse.ArgumentParser) -> None:
    """Add `--protocol`."""
    parser.add_argument(
        "--protocol",
        choices=("native", "uds"),
        default="native",
        help="how a test is requested and watched: by the bus's own messages (default), or by UDS"
        " over ISO-TP, identifiers as the mapping's [uds] says, else 0x7E0 and 0x7E8",
    )


def arguments_of_actuators(arguments: argparse.Namespace) -> list[ActuatorArguments]:
    """Return the command line of each actuator.

    arguments: the parsed command line, of a command with `add_actuators_options`. Returns at least
    one, in the order of the mappings; the namespaces hold one file's name each, or None.
    ConfigurationError: a mapping named twice, actuators that do not pair with the mappings, one DBC
    for several.
    """
    mappings: list[str | None] = [*arguments.mapping] or [None]
    actuators: list[str | None] = [*arguments.actuator] or [None]
    if len(actuators) == 1:
        actuators *= len(mappings)
    if len(actuators) != len(mappings):
        raise ConfigurationError(
            f"--actuator named {len(actuators)} times, --mapping {len(mappings)} times: name one"
            " actuator for all, or one for each mapping, in the same order"
        )
    twice = [name for name, count in Counter(mappings).items() if count > 1]
    if twice:
        raise ConfigurationError(f"--mapping {twice[0]}: named twice")
    for flag, value in (("--dbc", arguments.dbc), ("--id-offset", arguments.id_offset)):
        if len(mappings) > 1 and value is not None:
            raise ConfigurationError(f"{flag}: with several --mapping each names its own")
    return [
        ActuatorArguments(argparse.Namespace(**{**vars(arguments), "mapping": mapping,
        "actuator": actuator}),
             label)
        for mapping, actuator, label in zip(mappings, actuators, _mapping_labels(mappings),
        strict=True)
    ]  # fmt: skip


def _mapping_labels(mappings: list[str | None]) -> list[str]:
    """Short names of the mappings: of two alike the folders too."""
    if len(mappings) == 1:
        return [""]
    names = [str(name) for name in mappings]
    stems = [Path(name).stem for name in names]
    if len(set(stems)) == len(stems):
        return stems
    return [str(Path(name).with_suffix("")) for name in names]


DEFAULT_BAUD_RATE = 921600


def add_bus_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a bus, named as in python-can's own tools."""
    group = parser.add_argument_group("bus", "options as in python-can's tools")
    group.add_argument(
        "-i",
        "--interface",
        metavar="NAME",
        default=os.environ.get("CAN_INTERFACE"),
        help="socketcan, virtual, udp_multicast, slcan, pcan, kvaser, vector, …"
        " (default: CAN_INTERFACE)",
    )
    group.add_argument(
        "-c",
        "--channel",
        metavar="NAME",
        default=os.environ.get("CAN_CHANNEL"),
        help="channel as the interface names it (default: CAN_CHANNEL)",
    )
    group.add_argument(
        "--context",
        metavar="NAME",
        help="section of python-can's configuration file, and end of its variables, that names the"
        " bus (default: without --interface its default section)",
    )
    group.add_argument("-b", "--bitrate", type=positive_count, metavar="N", help="bit/s")
    group.add_argument("--fd", action="store_true", help="accept CAN FD frames")
    group.add_argument(
        "--data-bitrate",
        "--data_bitrate",
        type=positive_count,
        metavar="N",
        help="bit/s of CAN FD data",
    )
    group.add_argument("--app-name", metavar="NAME", help="application name (Vector)")
    group.add_argument(
        "--bus-kwargs",
        nargs="*",
        default=[],
        metavar="KEY=VALUE",
        help="further options of the interface",
    )
    group.add_argument(
        "--port",
        metavar="URL",
        help="the project's serial link on this port or pyserial URL instead of CAN",
    )
    group.add_argument(
        "--baud",
        type=positive_count,
        metavar="N",
        default=DEFAULT_BAUD_RATE,
        help=f"of the serial link (default {DEFAULT_BAUD_RATE})",
    )
    group.add_argument(
        "--allow-multicast", action="store_true", help="let udp_multicast send beyond this machine"
    )


def bitrate_from_options(arguments: argparse.Namespace, bus_map: BusMap) -> float | None:
    """Return the bit rate of the bus, bit/s: the named one, or the default bus's; None: unknown."""
    if arguments.port or getattr(arguments, "log", None) is not None:
        return None
    from firmware_iface.bus_map import default_map  # noqa: PLC0415

    # BUS-1.
    default = 1e6 if bus_map.name == default_map().name else None
    return arguments.bitrate or default


def has_bus(arguments: argparse.Namespace) -> bool:
    """Whether a bus or a serial port was named; python-can's default one is not."""
    return bool(arguments.interface or arguments.port or arguments.context)


def refuse_two_buses(arguments: argparse.Namespace) -> None:
    """Raise ConfigurationError where a serial port and a bus of python-can were both named."""
    if arguments.port and arguments.interface not in (None, os.environ.get("CAN_INTERFACE")):
        raise ConfigurationError("--port and --interface exclude each other: name one bus")
    if arguments.port and arguments.context:
        raise ConfigurationError("--port and --context exclude each other: name one bus")


def require_bus_or_log(arguments: argparse.Namespace) -> None:
    """Raise ConfigurationError unless either `--log` or one bus or serial port was named."""
    if arguments.log is None:
        require_one_bus(arguments)
    elif arguments.port or arguments.interface not in (None, os.environ.get("CAN_INTERFACE")):
        raise ConfigurationError("--log is of a recording: name it or a bus, not both")


def require_one_bus(arguments: argparse.Namespace) -> None:
    """Raise ConfigurationError unless one bus or serial port was named, here or for python-can."""
    refuse_two_buses(arguments)
    if has_bus(arguments):
        return
    from firmware_iface.transport.adapters import configures_a_bus  # noqa: PLC0415

    if not configures_a_bus():
        others = ", or --simulate" if hasattr(arguments, "simulate") else ""
        raise ConfigurationError(f"no bus named: give --interface and --channel, or --port{others}")


def open_transport(arguments: argparse.Namespace, *, transmit: bool) -> Transport:
    """Open the bus or serial port that was named; one of them was, see `require_one_bus`."""
    if arguments.port:
        from firmware_iface.transport.serial_link import SerialTransport  # noqa: PLC0415

        return SerialTransport(arguments.port, baudrate=arguments.baud, transmit=transmit)
    from firmware_iface.transport.adapters import BusOptions, interface_options  # noqa: PLC0415
    from firmware_iface.transport.python_can import PythonCanTransport  # noqa: PLC0415

    named = {
        "interface": arguments.interface or "",
        "extra": interface_options(arguments.bus_kwargs),
    }
    others = [name for name in BusOptions.__struct_fields__ if name not in named]
    options = BusOptions(**{name: getattr(arguments, name) for name in others} | named)
    if arguments.context or not arguments.interface:
        from firmware_iface.transport.adapters import with_configuration  # noqa: PLC0415

        options = with_configuration(options, arguments.context)
    return PythonCanTransport(options, transmit=transmit)


HISTORY_VARIABLE = "EHADIAG_HISTORY"


def add_history_option(parser: argparse.ArgumentParser, *, again: bool = False) -> None:
    """Add `--history`.

    parser: of a command, or of a verb of one; again: the command has it already: without it here
    what was said there holds.
    """
    parser.add_argument(
        "--history",
        metavar="FILE",
        default=argparse.SUPPRESS if again else None,
        help=f"health history, SQLite (default: {HISTORY_VARIABLE}, else the user's own once"
        " `ehadiag history init` was called)",
    )


def add_usage_options(
    parser: argparse.ArgumentParser, when: str = "since it was new, for the health history"
) -> None:
    """Add `--hours` and `--cycles`; when: at what time the unit has them."""
    for name, what in (("hours", "operating hours"), ("cycles", "cycles")):
        parser.add_argument(
            f"--{name}",
            type=partial(positive_number, or_zero=True),
            metavar="N",
            help=f"{what} of the unit {when}",
        )


def add_history_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of commands that append their diagnoses to a history."""
    add_history_option(parser)
    parser.add_argument(
        "--no-history", action="store_true", help="append nothing to any health history"
    )
    add_usage_options(parser)


def usage_from_options(arguments: argparse.Namespace) -> Usage:
    """Return the hours and cycles that were named."""
    from ehadiag.history.records import Usage  # noqa: PLC0415

    return Usage(arguments.hours, arguments.cycles)


def history_path(arguments: argparse.Namespace) -> Path | None:
    """Return the file that was named, else the user's own if there is one."""
    named = arguments.history or os.environ.get(HISTORY_VARIABLE)
    if named:
        return Path(named)
    own = user_history_path()
    return own if own is not None and own.exists() else None


def open_named_history(arguments: argparse.Namespace) -> History:
    """Open the history that there is; ConfigurationError where there is none."""
    place = history_path(arguments)
    if place is None:
        raise ConfigurationError(
            f"no health history: name one by --history or {HISTORY_VARIABLE}, or begin one by"
            " ehadiag history init"
        )
    from ehadiag.history.store import History  # noqa: PLC0415

    return History(place)


def units_of(history: History, actuator: str | None) -> list[tuple[str, int]]:
    """Return actuator and serial number of all units, or of those of an actuator that was named."""
    units = history.units()
    if actuator is not None and all(kind != actuator for kind, _ in units):
        known = ", ".join(dict.fromkeys(kind for kind, _ in units)) or "none"
        raise ConfigurationError(f"--actuator {actuator}: there is {known}")
    return [unit for unit in units if actuator in (None, unit[0])]


HISTORY_FILE_NAME = "history.sqlite"


def user_history_path() -> Path | None:
    """File of the user's own history, whether or not it exists; None where no home is known.

    In `$XDG_DATA_HOME/ehadiag`, else `~/.local/share/ehadiag`; on Windows in `%LOCALAPPDATA%`.
    """
    if (xdg := os.environ.get("XDG_DATA_HOME")) and os.path.isabs(xdg):
        return Path(xdg, "ehadiag", HISTORY_FILE_NAME)
    if home := os.environ.get("HOME"):
        return Path(os.path.abspath(home), ".local", "share", "ehadiag", HISTORY_FILE_NAME)
    if local := os.environ.get("LOCALAPPDATA"):  # Windows
        return Path(local, "ehadiag", HISTORY_FILE_NAME)
    return None
