"""Options that name a bus, and the transport that they open."""

from __future__ import annotations

import argparse
import os
from typing import TYPE_CHECKING, Any

from ehadiag.cli.argument_types import count
from ehadiag.core.errors import ConfigurationError

if TYPE_CHECKING:
    from firmware_iface.mapping.bus_map import BusMap
    from firmware_iface.transport.interface import Transport

__all__ = [
    "add_bus_options",
    "has_bus",
    "need_bus_or_log",
    "need_one_bus",
    "open_transport",
    "refuse_two_buses",
    "the_bitrate",
]

DEFAULT_BAUD = 921600
DEFAULT_BITRATE = 1e6
"""Of the default bus (BUS-1)."""


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
    group.add_argument("-b", "--bitrate", type=count, metavar="N", help="bit/s")
    group.add_argument("--fd", action="store_true", help="accept CAN FD frames")
    group.add_argument(
        "--data-bitrate", "--data_bitrate", type=count, metavar="N", help="bit/s of CAN FD data"
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
        "--serial",
        metavar="URL",
        help="the project's serial link on this port or pyserial URL instead of CAN",
    )
    group.add_argument(
        "--baud",
        type=count,
        metavar="N",
        default=DEFAULT_BAUD,
        help=f"of the serial link (default {DEFAULT_BAUD})",
    )
    group.add_argument(
        "--allow-multicast", action="store_true", help="let udp_multicast send beyond this machine"
    )


def the_bitrate(arguments: argparse.Namespace, bus_map: BusMap) -> float | None:
    """Return the bit rate of the bus, bit/s: the named one, or the default bus's; None: unknown."""
    if arguments.serial or getattr(arguments, "log", None) is not None:
        return None
    from firmware_iface.mapping.bus_map import default_map  # noqa: PLC0415

    default = DEFAULT_BITRATE if bus_map.name == default_map().name else None
    return arguments.bitrate or default


def has_bus(arguments: argparse.Namespace) -> bool:
    """Whether a bus or a serial port was named; python-can's default one is not."""
    return bool(arguments.interface or arguments.serial or arguments.context)


def refuse_two_buses(arguments: argparse.Namespace) -> None:
    """Raise ConfigurationError where a serial port and a bus of python-can were both named."""
    if arguments.serial and arguments.interface not in (None, os.environ.get("CAN_INTERFACE")):
        raise ConfigurationError("--serial and --interface exclude each other: name one bus")
    if arguments.serial and arguments.context:
        raise ConfigurationError("--serial and --context exclude each other: name one bus")


def need_bus_or_log(arguments: argparse.Namespace) -> None:
    """Raise ConfigurationError unless either `--log` or one bus or serial port was named."""
    if arguments.log is None:
        need_one_bus(arguments)
    elif arguments.serial or arguments.interface not in (None, os.environ.get("CAN_INTERFACE")):
        raise ConfigurationError("--log is of a recording: name it or a bus, not both")


def need_one_bus(arguments: argparse.Namespace) -> None:
    """Raise ConfigurationError unless one bus or serial port was named, here or for python-can."""
    refuse_two_buses(arguments)
    if has_bus(arguments):
        return
    from firmware_iface.transport.configuration import configures_a_bus  # noqa: PLC0415

    if not configures_a_bus():
        others = ", or --simulate" if hasattr(arguments, "simulate") else ""
        raise ConfigurationError(
            f"no bus named: give --interface and --channel, or --serial{others}"
        )


def open_transport(arguments: argparse.Namespace, *, transmit: bool) -> Transport:
    """Open the bus or serial port that was named; one of them was, see `need_one_bus`."""
    if arguments.serial:
        from firmware_iface.transport.serial_link import SerialTransport  # noqa: PLC0415

        return SerialTransport(arguments.serial, baudrate=arguments.baud, transmit=transmit)
    from firmware_iface.transport.python_can import BusOptions, PythonCanTransport  # noqa: PLC0415

    options = BusOptions(
        interface=arguments.interface or "",
        channel=arguments.channel,
        bitrate=arguments.bitrate,
        data_bitrate=arguments.data_bitrate,
        fd=arguments.fd,
        app_name=arguments.app_name,
        extra=_extra(arguments.bus_kwargs),
        allow_multicast=arguments.allow_multicast,
    )
    if arguments.context or not arguments.interface:
        from firmware_iface.transport.configuration import configured  # noqa: PLC0415

        options = configured(options, arguments.context)
    return PythonCanTransport(options, transmit=transmit)


def _extra(pairs: list[str]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for pair in pairs:
        key, separator, text = pair.partition("=")
        if not separator or not key.isidentifier():
            raise ConfigurationError(f"--bus-kwargs {pair}: need KEY=VALUE")
        out[key] = _value(text)
    return out


def _value(text: str) -> bool | int | float | str:
    if text in ("True", "true", "False", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
