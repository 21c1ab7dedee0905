"""Opens any python-can interface by its name, with errors that say what to do."""

from __future__ import annotations

import contextlib
import importlib
import ipaddress
import logging
import socket
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehadiag.core.errors import ConfigurationError, EhadiagError, InputOutputError

if TYPE_CHECKING:
    import can

__all__ = ["BusOptions", "one_line", "open_bus"]

MULTICAST_GROUP = "239.74.163.2"
"""Default channel of udp_multicast; python-can's own is IPv6 and needs a route few hosts have."""
ROUTES = Path("/proc/net/route")
LISTEN_ONLY: Mapping[str, Mapping[str, Any]] = {
    "slcan": {"listen_only": True},
    "vector": {"listen_only": True},
    "nixnet": {"listen_only": True},
    "kvaser": {"driver_mode": False},
}
"""Options that silence an adapter. PCAN and Systec take a bus state instead."""
OWN_OPTIONS = frozenset(("interface", "channel", "bitrate", "data_bitrate", "fd", "app_name"))
"""Options that may not hide among the further arguments: what is checked must be what is opened."""
PASSIVE_STATE = ("pcan", "systec")
NEEDS_CHANNEL: Mapping[str, str] = {
    "slcan": "/dev/ttyACM0",
    "socketcan": "can0",
    "pcan": "PCAN_USBBUS1",
    "kvaser": "0",
    "vector": "0",
    "ixxat": "0",
}
"""Interfaces that say nothing plain of a missing channel, with an example of one."""
MEND: Mapping[str, str] = {
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
    "udp_multicast": "it needs msgpack: pip install 'ehadiag[multicast]'",
    "slcan": "is the adapter plugged in, the port the right one and not in use?",
}
"""What to do where an interface cannot be opened."""
MEND_OTHERS = "install the driver of the interface and, where it has one, its Python module"
DAEMON_TIMEOUT = 2.0
"""s; python-can itself asks for ten, without a pause and with a line on the terminal each time."""


@dataclass(frozen=True, slots=True)
class BusOptions:
    """Options of a bus, named as python-can names them; None leaves its default.

    Attributes
    ----------
    interface : str
        Socketcan, virtual, udp_multicast, slcan, pcan, kvaser, vector, ixxat, …
    channel : str | None
        As the interface understands it.
    bitrate : int | None
        bit/s.
    data_bitrate : int | None
        See `bitrate`.
    fd : bool
        Accept CAN FD frames.
    app_name : str | None
        Vector's application name.
    extra : Mapping[str, Any]
        Further keyword arguments of the interface (python-can's `--bus-kwargs`).
    allow_multicast : bool
        Let udp_multicast join a group beyond the loopback interface.
    """

    interface: str
    channel: str | None = None
    bitrate: int | None = None
    data_bitrate: int | None = None
    fd: bool = False
    app_name: str | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)
    allow_multicast: bool = False


def open_bus(options: BusOptions, *, transmit: bool) -> can.BusABC:
    """Open a bus, silenced where the adapter can be unless it shall transmit.

    Parameters
    ----------
    options : BusOptions
        Which bus, and how to open it.
    transmit : bool
        Whether the bus may be sent to; otherwise it is opened listen-only where the adapter can
        be.

    Returns
    -------
    can.BusABC
        The open bus.

    Raises
    ------
    ConfigurationError
        Unknown interface, missing driver or module, a wrong option, multicast that would leave
        the machine without leave.
    InputOutputError
        The channel is absent, busy or refused.
    """
    import can  # noqa: PLC0415 - costs half a second

    name = f"{options.interface} {options.channel or ''}".strip()
    arguments = bus_arguments(options, transmit)
    if options.interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise ConfigurationError(f"interface {options.interface!r} unknown, need one of {known}")
    if options.channel is None and options.interface in NEEDS_CHANNEL:
        example = NEEDS_CHANNEL[options.interface]
        raise ConfigurationError(f"{name}: name the channel, such as --channel {example}")
    if options.interface == "socketcand":
        _reach_daemon(arguments, name)
    mend = MEND.get(options.interface, MEND_OTHERS)
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


def _reach_daemon(arguments: Mapping[str, Any], name: str) -> None:
    """Try the daemon's port once."""
    host, port = arguments.get("host"), arguments.get("port")
    if host is None or not isinstance(port, int) or not 0 < port < 1 << 16:
        raise ConfigurationError(
            f"{name}: name the daemon, such as --bus-kwargs host=192.0.2.7 port=29536"
        )
    try:
        socket.create_connection((str(host), port), DAEMON_TIMEOUT).close()
    except OSError as error:
        raise InputOutputError(
            f"{name}: no daemon at {host}:{port}: {one_line(error)}; {MEND['socketcand']}"
        ) from None


def bus_arguments(options: BusOptions, transmit: bool) -> dict[str, Any]:
    """Keyword arguments of python-can's `Bus`.

    Parameters
    ----------
    options : BusOptions
        Which bus, and how to open it.
    transmit : bool
        Whether the bus may be sent to; otherwise it is opened listen-only where the adapter can
        be.

    Returns
    -------
    dict[str, Any]
        Keyword arguments of `can.Bus`.

    Raises
    ------
    ConfigurationError
        An option that may not be given, or multicast that would leave the machine.
    """
    if options.extra.get("receive_own_messages"):
        raise ConfigurationError(
            f"{options.interface}: receive_own_messages is not supported: own requests are "
            "recorded as they are sent, and an echo would look like another tester's"
        )
    for key in OWN_OPTIONS & options.extra.keys():
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
        arguments |= LISTEN_ONLY.get(options.interface, {})
        if options.interface in PASSIVE_STATE:
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
        lines = ROUTES.read_text(encoding="ascii").splitlines()[1:]
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
