"""Opens any python-can interface by its name, with errors that say what to do.

Options that a call leaves out are taken from python-can's own configuration.
"""

from __future__ import annotations

import configparser
import contextlib
import importlib
import ipaddress
import logging
import os
import socket
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from firmware_iface.errors import (
    ConfigurationError,
    EhadiagError,
    InputOutputError,
    install_command,
)

if TYPE_CHECKING:
    import can

MULTICAST_GROUP = "239.74.163.2"
"""Default channel of udp_multicast; python-can's own is IPv6 and needs a route few hosts have."""
ROUTES_FILE = Path("/proc/net/route")
LISTEN_ONLY_OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "slcan": {"listen_only": True},
    "vector": {"listen_only": True},
    "nixnet": {"listen_only": True},
    "kvaser": {"driver_mode": False},
}
"""Options that silence an adapter. PCAN and Systec take a bus state instead."""
CHECKED_OPTIONS = frozenset(("interface", "channel", "bitrate", "data_bitrate", "fd", "app_name"))
"""Options that may not hide among the further arguments: what is checked must be what is opened."""
PASSIVE_STATE_INTERFACES = ("pcan", "systec")
CHANNEL_EXAMPLES: Mapping[str, str] = {
    "slcan": "/dev/ttyACM0",
    "socketcan": "can0",
    "pcan": "PCAN_USBBUS1",
    "kvaser": "0",
    "vector": "0",
    "ixxat": "0",
}
"""Interfaces that say nothing plain of a missing channel, with an example of one."""
INTERFACE_ADVICE: Mapping[str, str] = {
    "pcan": "install PEAK's driver with the PCAN-Basic library; on Linux the kernel's own driver"
    " makes the adapter a socketcan interface",
    "kvaser": "install Kvaser's driver with the CANlib library; on Linux the kernel's own driver"
    " makes the adapter a socketcan interface",
    "vector": "install Vector's driver with the XL library (Windows only)",
    "ixxat": "install HMS's VCI driver (Windows only)",
    "systec": "install SYS TEC's driver (Windows only)",
    "socketcan": "it needs Linux with CAN drivers, and the interface has to be up: ip link set"
    " CHANNEL up type can bitrate N",
    "socketcand": "is the daemon running, and does a firewall let its port through?",
    "udp_multicast": "it needs msgpack",
    "slcan": "is the adapter plugged in, the port the right one and not in use?",
}
"""What to do where an interface cannot be opened."""
DEFAULT_INTERFACE_ADVICE = (
    "install the driver of the interface and, where it has one, its Python module"
)


class BusOptions(msgspec.Struct, frozen=True):
    """Options of a bus, named as python-can names them; None leaves its default."""

    interface: str
    """Socketcan, virtual, udp_multicast, slcan, pcan, kvaser, vector, ixxat, …"""
    channel: str | None = None
    """As the interface understands it."""
    bitrate: int | None = None
    """bit/s."""
    data_bitrate: int | None = None
    fd: bool = False
    """Accept CAN FD frames."""
    app_name: str | None = None
    """Vector's application name."""
    extra: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """Further keyword arguments of the interface (python-can's `--bus-kwargs`)."""
    allow_multicast: bool = False
    """Let udp_multicast join a group beyond the loopback interface."""


def open_bus(options: BusOptions, *, transmit: bool) -> can.BusABC:
    """Open a bus, silenced where the adapter can be unless it shall transmit.

    options: which bus, and how to open it; transmit: whether the bus may be sent to; otherwise it
    is opened listen-only where the adapter can be. Returns the open bus. ConfigurationError:
    unknown interface, missing driver or module, a wrong option, multicast that would leave the
    machine without leave; InputOutputError: the channel is absent, busy or refused.
    """
    import can  # noqa: PLC0415 - costs half a second

    name = f"{options.interface} {options.channel or ''}".strip()
    arguments = bus_arguments(options, transmit)
    if options.interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise ConfigurationError(f"interface {options.interface!r} unknown, need one of {known}")
    if options.channel is None and options.interface in CHANNEL_EXAMPLES:
        example = CHANNEL_EXAMPLES[options.interface]
        raise ConfigurationError(f"{name}: name the channel, such as --channel {example}")
    if options.interface == "socketcand":
        _check_daemon(arguments, name)
    mend = INTERFACE_ADVICE.get(options.interface, DEFAULT_INTERFACE_ADVICE)
    if options.interface == "udp_multicast":
        mend += f": {install_command('multicast')}"
    try:
        with _quiet():
            return can.Bus(**arguments)
    except EhadiagError:
        raise
    except NameError:  # python-can's Kvaser interface without its library
        raise ConfigurationError(f"{name}: the driver's library is missing; {mend}") from None
    except (can.CanInterfaceNotImplementedError, ImportError) as error:
        raise ConfigurationError(
            f"{name}: driver or Python module is missing: {one_line(error)}; {mend}"
        ) from None
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigurationError(f"{name}: wrong option: {one_line(error)}") from None
    except Exception as error:
        raise InputOutputError(f"{name}: cannot open: {one_line(error)}; {mend}") from None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what python-can logs of missing drivers off the terminal: the error says it."""
    log, silent = logging.getLogger("can"), logging.NullHandler()
    log.addHandler(silent)
    try:
        yield
    finally:
        log.removeHandler(silent)


def _check_daemon(arguments: Mapping[str, Any], name: str) -> None:
    """Try the daemon's port once."""
    host, port = arguments.get("host"), arguments.get("port")
    if host is None or not isinstance(port, int) or not 0 < port < 1 << 16:
        raise ConfigurationError(
            f"{name}: name the daemon, such as --bus-kwargs host=192.0.2.7 port=29536"
        )
    try:
        # python-can itself asks for ten seconds, with a line on the terminal each time.
        socket.create_connection((str(host), port), 2.0).close()
    except OSError as error:
        raise InputOutputError(
            f"{name}: no daemon at {host}:{port}: {one_line(error)}; "
            f"{INTERFACE_ADVICE['socketcand']}"
        ) from None


def bus_arguments(options: BusOptions, transmit: bool) -> dict[str, Any]:
    """Keyword arguments of python-can's `Bus`.

    options: which bus, and how to open it; transmit: whether the bus may be sent to; otherwise it
    is opened listen-only where the adapter can be. Returns keyword arguments of `can.Bus`.
    ConfigurationError: an option that may not be given, or multicast that would leave the machine.
    """
    if options.extra.get("receive_own_messages"):
        raise ConfigurationError(
            f"{options.interface}: receive_own_messages is not supported: own requests are "
            "recorded as they are sent, and an echo would look like another tester's"
        )
    for key in CHECKED_OPTIONS & options.extra.keys():
        raise ConfigurationError(f"{options.interface}: give {key} as an option of its own")
    arguments: dict[str, Any] = dict(options.extra)
    arguments |= {"interface": options.interface, "ignore_config": True}
    for key in ("channel", "bitrate", "data_bitrate", "app_name"):
        value = getattr(options, key)
        if value is not None:
            arguments[key] = value
    if options.fd:
        arguments["fd"] = True
    if options.interface == "udp_multicast":
        arguments |= _multicast(options)
    if not transmit:
        arguments |= LISTEN_ONLY_OPTIONS.get(options.interface, {})
        if options.interface in PASSIVE_STATE_INTERFACES:
            arguments["state"] = importlib.import_module("can").BusState.PASSIVE
    return arguments


def _multicast(options: BusOptions) -> dict[str, Any]:
    """Keep the group on this machine unless the user lets it out.

    Without leave the kernel's own route must be the loopback interface: a hop limit of zero alone
    keeps frames in, but the group's membership report goes out and foreign frames come in.
    """
    group = options.channel or MULTICAST_GROUP
    if options.allow_multicast:
        return {"channel": group}
    try:
        address = ipaddress.ip_address(group)
    except ValueError:
        raise ConfigurationError(
            f"udp_multicast {group}: not an IP address; need a group such as {MULTICAST_GROUP}"
        ) from None
    interface = _route(address)
    if interface != "lo":
        where = f"leave the machine through {interface}" if interface else "find no loopback route"
        raise ConfigurationError(
            f"udp_multicast {group}: would {where}; run inside tools/loopnet.sh, or allow it "
            "with --allow-multicast"
        )
    return {"channel": group, "hop_limit": 0}


def _route(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> str | None:
    """Interface that the kernel sends to an IPv4 address through; None where it cannot be told."""
    try:
        lines = ROUTES_FILE.read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return None
    found: tuple[int, str] | None = None
    for line in lines:
        columns = line.split()
        # The kernel prints addresses as hexadecimal words of this machine's byte order.
        target, mask = (int(columns[i], 16).to_bytes(4, sys.byteorder) for i in (1, 7))
        bits = int.from_bytes(mask, "big")
        same = int(address) & bits == int.from_bytes(target, "big")
        if address.version == 4 and same and (found is None or bits > found[0]):
            found = (bits, columns[0])
    return None if found is None else found[1]


def one_line(error: BaseException) -> str:
    """Text of an error of somebody else's, on one line and without its full stop."""
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__


def configures_a_bus() -> bool:
    """Tell whether python-can's variables or files name an interface.

    Returns of the default context. ConfigurationError: they cannot be read.
    """
    return "interface" in {**_file_options(None), **_environment_options(None)}


def with_configuration(options: BusOptions, context: str | None) -> BusOptions:
    """Complete the options of a bus by python-can's configuration.

    What is given comes first, then `CAN_INTERFACE`, `CAN_CHANNEL`, `CAN_BITRATE` and `CAN_CONFIG`,
    each with `_CONTEXT` before the plain one, then the file's section of that name, then
    `[default]`: https://python-can.readthedocs.io/en/stable/configuration.html

    options: what was given; an empty interface: none; context: section of python-can's file, and
    end of its variables; None: the default one. Returns with an interface. ConfigurationError: the
    configuration cannot be read, has nothing of that context, or names no interface.
    """
    import can.util  # noqa: PLC0415 - costs half a second

    if context is not None and not (_file_options(context) or _environment_options(context)):
        files = ", ".join(can.util.CONFIG_FILES)
        raise ConfigurationError(
            f"--context {context}: no section [{context}] in {files}, nor a variable"
            f" CAN_INTERFACE_{context}, CAN_CHANNEL_{context} or CAN_CONFIG_{context}"
        )
    # What only a plain variable said comes after the context's own ones.
    plain = {"interface": "CAN_INTERFACE", "channel": "CAN_CHANNEL"}
    given = {
        key: value
        for key in CHECKED_OPTIONS
        if (value := getattr(options, key)) and str(value) != os.environ.get(plain.get(key, ""))
    }
    given |= options.extra
    try:
        # Also makes one object of bit timings that are given by their parts.
        found = dict(can.util.load_config(config=given, context=context))
    except (ValueError, TypeError, configparser.Error, can.CanError) as error:
        raise ConfigurationError(f"python-can's configuration: {one_line(error)}") from None
    own = {key: found.pop(key) for key in CHECKED_OPTIONS & found.keys()}
    return replace(options, **_typed_options(own), extra=found)


def _typed_options(own: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a file, where all is text or number, as ours take them."""
    out = dict(own)
    if out.get("channel") is not None:
        out["channel"] = str(out["channel"])
    return out


def _file_options(context: str | None) -> dict[str, str]:
    import can.util  # noqa: PLC0415

    try:
        return can.util.load_file_config(section=context or "default")
    except (configparser.Error, UnicodeDecodeError) as error:
        raise ConfigurationError(f"python-can's configuration file: {one_line(error)}") from None


def _environment_options(context: str | None) -> dict[str, str]:
    import can.util  # noqa: PLC0415

    try:
        return dict(can.util.load_environment_config(context))
    except (ValueError, TypeError) as error:
        name = f"CAN_CONFIG_{context}" if context else "CAN_CONFIG"
        raise ConfigurationError(f"variable {name}: no JSON object: {one_line(error)}") from None


def interface_options(pairs: Iterable[str]) -> dict[str, Any]:
    """Read an adapter's own options, each KEY=VALUE, as of `--bus-kwargs`."""
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
