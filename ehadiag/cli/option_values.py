"""Makes what options name: actuator, bus map, tests, limits of reading, transport.

For one actuator, or for several on one bus with a mapping each.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from ehadiag.cli import options
from ehadiag.cli.options import positive_count
from firmware_iface.errors import ConfigurationError

if TYPE_CHECKING:
    from firmware_iface.bus_map import BusMap
    from firmware_iface.transport.base import Transport


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
    options.add_request_options(parser, "dbc", "id_offset")


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
    from firmware_iface.transport.adapters import BusOptions  # noqa: PLC0415
    from firmware_iface.transport.python_can import PythonCanTransport  # noqa: PLC0415

    named = {
        "interface": arguments.interface or "",
        "extra": _interface_options(arguments.bus_kwargs),
    }
    others = [name for name in BusOptions.__struct_fields__ if name not in named]
    options = BusOptions(**{name: getattr(arguments, name) for name in others} | named)
    if arguments.context or not arguments.interface:
        from firmware_iface.transport.adapters import with_configuration  # noqa: PLC0415

        options = with_configuration(options, arguments.context)
    return PythonCanTransport(options, transmit=transmit)


def _interface_options(pairs: list[str]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for pair in pairs:
        key, separator, text = pair.partition("=")
        if not separator or not key.isidentifier():
            raise ConfigurationError(f"--bus-kwargs {pair}: need KEY=VALUE")
        out[key] = _interface_value(text)
    return out


def _interface_value(text: str) -> bool | int | float | str:
    if text in ("True", "true", "False", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
