"""Command-line options that several commands share, and the objects made from them."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehadiag.assess.verdict import Levels, Rule
from ehadiag.cli.effects import add_effect_options
from ehadiag.core.actuator import MOST_TOLERANCE, Actuator, with_tolerance
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.find_test import Sought
from ehadiag.core.fingerprint import fingerprint
from ehadiag.core.stored_test import StoredTest
from ehadiag.facade import inputs
from ehadiag.report.asked import Asked

if TYPE_CHECKING:
    from firmware_iface.logs.budget import Budget
    from firmware_iface.mapping.bus_map import BusMap
    from firmware_iface.signals.columns import ColumnMap
    from firmware_iface.transport.interface import Transport

__all__ = [
    "TEST",
    "add_actuator_options",
    "add_bus_options",
    "add_column_options",
    "add_diagnosis_options",
    "add_fault_options",
    "add_json_option",
    "add_level_options",
    "add_log_options",
    "add_mapping_options",
    "add_result_options",
    "add_seed_option",
    "add_when_options",
    "count",
    "has_bus",
    "known_tests",
    "need_one_bus",
    "open_transport",
    "positive",
    "refuse_two_buses",
    "the_actuator",
    "the_asked",
    "the_bitrate",
    "the_budget",
    "the_bus_map",
    "the_columns",
    "the_sought",
    "unit_serial",
]

TEST = "open|closed|NUMBER|FILE"
"""How every command lets a test be named."""
DEFAULT_BAUD = 921600
DEFAULT_BITRATE = 1e6
"""Of the default bus (BUS-1)."""
MOST_SERIAL = (1 << 63) - 1
"""That a history can hold."""
TIME_LIMIT_S = 600.0
"""Some ten thousand times what a sound recording takes."""


def add_actuator_options(parser: argparse.ArgumentParser) -> None:
    """Add `--actuator`."""
    parser.add_argument(
        "--actuator", metavar="FILE", help="actuator data, TOML (default: the reference actuator)"
    )


def add_tolerance_option(parser: argparse.ArgumentParser) -> None:
    """Add `--tolerance`."""
    parser.add_argument(
        "--tolerance",
        type=_share,
        metavar="SHARE",
        help="each datum of the actuator file may be off by this share, 0 … 0.3"
        " (default: as the file says)",
    )


def add_mapping_options(parser: argparse.ArgumentParser) -> None:
    """Add `--mapping` and `--dbc`."""
    parser.add_argument(
        "--mapping",
        metavar="FILE",
        help="which signals of a DBC are which channels, TOML (default: the FCC's own bus)",
    )
    parser.add_argument(
        "--dbc",
        metavar="FILE",
        help="DBC to use instead of the mapping's own, or one of the default names",
    )


def add_column_options(parser: argparse.ArgumentParser) -> None:
    """Add the columns of decoded signals, and several files of one recording."""
    parser.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="ROLE=NAME[:UNIT]",
        help="column of a recording of decoded signals (CSV, Parquet, MF4), as"
        " position='Stroke':mm; repeatable (default: the mapping's, else by name)",
    )
    parser.add_argument(
        "--merge",
        action="store_true",
        help="the logs are files of one recording: split in time, or one for each bus",
    )


def add_log_options(parser: argparse.ArgumentParser) -> None:
    """Add the channel of a recording, and what reading one may cost."""
    parser.add_argument(
        "--log-channel",
        type=count,
        metavar="N",
        help="adapter channel of the recording that is the actuator's, from 1"
        " (default: the mapping's, else the only one)",
    )
    parser.add_argument(
        "--max-frames",
        type=count,
        default=20_000_000,
        metavar="N",
        help="frames that a recording may have (default 20000000, some three hours)",
    )
    parser.add_argument(
        "--max-log-size",
        type=positive,
        default=4096.0,
        metavar="MiB",
        help="size of a recording, and of what it unpacks to (default 4096)",
    )
    parser.add_argument(
        "--max-read-time",
        type=positive,
        default=900.0,
        metavar="S",
        help="time that reading one recording may take (default 900)",
    )


def add_level_options(parser: argparse.ArgumentParser) -> None:
    """Add `--advisory` and `--limit`."""
    parser.add_argument(
        "--advisory",
        type=float,
        default=0.25,
        metavar="K",
        help="DEGRADED at or above this severity (default 0.25)",
    )
    parser.add_argument(
        "--limit",
        type=float,
        default=0.75,
        metavar="K",
        help="FAULT at or above this severity (default 0.75)",
    )


def add_seed_option(parser: argparse.ArgumentParser, what: str) -> None:
    """Add `--seed`; `what` says what is drawn by it."""
    parser.add_argument(
        "--seed",
        type=seed,
        default=0,
        metavar="N",
        help=f"{what} (default 0); the same seed, the same answer",
    )


def add_when_options(parser: argparse.ArgumentParser) -> None:
    """Add where in a recording the test lies, for buses that do not say."""
    for name, what in (("start", "begins"), ("end", "has ended")):
        parser.add_argument(
            f"--{name}",
            type=_instant,
            metavar="S",
            help=f"where the test {what}, s from the first sample of the recording, on a bus that"
            " does not say (default: found by its command or current)",
        )


def add_diagnosis_options(parser: argparse.ArgumentParser) -> None:
    """Add solver, seed, levels, time limit and output."""
    parser.add_argument(
        "--solver",
        choices=("cga", "pygad"),
        default="cga",
        help="search: compact GA (default) or pygad",
    )
    parser.add_argument(
        "--nuisances",
        choices=("auto", "none", "all"),
        default="auto",
        help="estimate null bias, gain, hysteresis and backlash beside the faults: where the faults"
        " alone do not explain a recording (auto, the default), never, or always",
    )
    add_tolerance_option(parser)
    add_seed_option(parser, "seed of the search")
    add_level_options(parser)
    parser.add_argument(
        "--rule",
        choices=("interval", "estimate"),
        default="interval",
        help="verdict by the chance that a severity is at or above a level (default), or by the"
        " estimates alone",
    )
    parser.add_argument(
        "--time-limit",
        type=positive,
        default=TIME_LIMIT_S,
        metavar="S",
        help="NOT TESTED where the identification takes longer, wall clock"
        f" (default {TIME_LIMIT_S:g})",
    )
    add_json_option(parser)


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Add `--json`."""
    parser.add_argument(
        "--json",
        action="store_true",
        help="print one JSON object a line to standard output, nothing else there",
    )


def add_result_options(parser: argparse.ArgumentParser) -> None:
    """Add how a result is written."""
    parser.add_argument(
        "--json-version",
        type=int,
        choices=(1, 2),
        default=2,
        help="of the JSON objects (default 2); 1: without what 2 added, none for unreadable logs",
    )
    parser.add_argument("--no-picture", action="store_true", help="draw nothing")


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


def add_fault_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the simulated actuator."""
    group = parser.add_argument_group("simulated actuator")
    for name, meaning in (
        ("Kintas", "clogging of the first-stage filter"),
        ("FSS", "spool-sleeve friction"),
        ("FDJ", "jack-cylinder friction"),
    ):
        group.add_argument(
            f"--{name}",
            f"--{name.lower()}",
            dest=name,
            type=float,
            default=0.0,
            metavar="K",
            help=f"{meaning}, 0 … 1 (default 0)",
        )
    group.add_argument(
        "--noise",
        type=float,
        default=0.5,
        metavar="LSB",
        help="rms noise of the converters (default 0.5)",
    )
    group.add_argument(
        "--offsets",
        type=float,
        nargs=4,
        default=(0.0, 0.0, 0.0, 0.0),
        metavar="LSB",
        help="offsets of current, spool, pressure, position",
    )
    group.add_argument(
        "--oil-temperature", type=float, default=40.0, metavar="degC", help="(default 40)"
    )
    group.add_argument(
        "--supply",
        type=float,
        default=20.7,
        metavar="MPa",
        help="supply pressure (default 20.7; return 0.7)",
    )
    group.add_argument(
        "--simulator-seed",
        type=seed,
        default=1,
        metavar="N",
        help="seed of the simulated noise (default 1)",
    )
    group.add_argument(
        "--serial-number",
        type=int,
        default=1,
        metavar="N",
        help="of the simulated actuator (default 1)",
    )
    add_effect_options(parser)


def the_actuator(arguments: argparse.Namespace) -> Actuator:
    """Return the actuator that was asked for."""
    found = inputs.the_actuator(arguments.actuator or None)
    tolerance = getattr(arguments, "tolerance", None)
    return found if tolerance is None else with_tolerance(found, tolerance)


def the_bus_map(arguments: argparse.Namespace) -> BusMap:
    """Return the meaning of the bus's frames."""
    if arguments.mapping and _maps_columns(arguments):
        found = inputs.the_bus_map(None, None)
    else:
        found = inputs.the_bus_map(arguments.mapping or None, arguments.dbc or None)
    channel = getattr(arguments, "log_channel", None)
    return found if channel is None else replace(found, channel=channel)


def the_columns(arguments: argparse.Namespace) -> ColumnMap | None:
    """Return the meaning of the columns of decoded signals; None where none are named."""
    from firmware_iface.signals.columns import (  # noqa: PLC0415
        ColumnMap,
        load_columns,
        named_columns,
    )

    known = load_columns(arguments.mapping) if _maps_columns(arguments) else None
    if known is None and not arguments.column:
        return None
    return named_columns(arguments.column, known or ColumnMap())


def _maps_columns(arguments: argparse.Namespace) -> bool:
    """Whether the mapping file is one of columns."""
    if not arguments.mapping or not hasattr(arguments, "column"):
        return False
    from ehadiag.core.small_file import read_small_file  # noqa: PLC0415
    from ehadiag.core.toml_file import MAX_BYTES  # noqa: PLC0415
    from firmware_iface.signals.columns import SCHEMA  # noqa: PLC0415

    text = read_small_file(Path(arguments.mapping), MAX_BYTES, "mapping file")
    return f'"{SCHEMA}"'.encode() in text


def the_budget(arguments: argparse.Namespace) -> Budget:
    """Return what reading a recording may cost."""
    from firmware_iface.logs.budget import Budget  # noqa: PLC0415

    return Budget(
        frames=arguments.max_frames,
        size=round(arguments.max_log_size * (1 << 20)),
        seconds=arguments.max_read_time,
    )


def the_asked(arguments: argparse.Namespace, bus_map: BusMap, tests: Sequence[StoredTest]) -> Asked:
    """Return the options of a diagnosis, for its JSON result.

    tests: that a recording may be of; the one that stands for all the others comes first.
    """
    columns = the_columns(arguments) if hasattr(arguments, "column") else None
    return Asked(
        solver=arguments.solver,
        seed=arguments.seed,
        levels=Levels(arguments.advisory, arguments.limit, Rule(arguments.rule)),
        nuisances=arguments.nuisances,
        time_limit_s=arguments.time_limit,
        every=getattr(arguments, "all", False),
        mapping=bus_map.name,
        mapping_sha256=fingerprint(bus_map),
        mapping_file=arguments.mapping or None,
        tests_sha256=fingerprint(tuple(tests)),
        columns_sha256=None if columns is None else fingerprint(columns),
        start_s=getattr(arguments, "start", None),
        end_s=getattr(arguments, "end", None),
    )


def the_sought(
    arguments: argparse.Namespace, tests: Sequence[StoredTest], actuator: Actuator
) -> Sought:
    """Return what to look for in a recording whose bus does not say when which test ran."""
    start, end = arguments.start, arguments.end
    if start is not None and end is not None and end <= start:
        raise ConfigurationError(f"--end {end:g}: not after --start {start:g}")
    return Sought(tuple(tests), actuator.controller, start, end)


def the_bitrate(arguments: argparse.Namespace, bus_map: BusMap) -> float | None:
    """Return the bit rate of the bus, bit/s: the named one, or the default bus's; None: unknown."""
    if arguments.serial or getattr(arguments, "log", None) is not None:
        return None
    from firmware_iface.mapping.bus_map import default_map  # noqa: PLC0415

    default = DEFAULT_BITRATE if bus_map.name == default_map().name else None
    return arguments.bitrate or default


def known_tests(names: list[str]) -> tuple[StoredTest, ...]:
    """Return the bundled tests and the named ones; of one number the one named last."""
    return inputs.the_tests(names)


def has_bus(arguments: argparse.Namespace) -> bool:
    """Whether a bus or a serial port was named; python-can's default one is not."""
    return bool(arguments.interface or arguments.serial or arguments.context)


def refuse_two_buses(arguments: argparse.Namespace) -> None:
    """Raise ConfigurationError where a serial port and a bus of python-can were both named."""
    if arguments.serial and arguments.interface not in (None, os.environ.get("CAN_INTERFACE")):
        raise ConfigurationError("--serial and --interface exclude each other: name one bus")
    if arguments.serial and arguments.context:
        raise ConfigurationError("--serial and --context exclude each other: name one bus")


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


def positive(text: str) -> float:
    """Read a number above zero."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}: need a number above 0")
    return value


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= MOST_TOLERANCE:
        raise argparse.ArgumentTypeError(f"{text!r}: need a share, 0 … {MOST_TOLERANCE:g}")
    return value


def _instant(text: str) -> float:
    """Read a number from zero on."""
    return 0.0 if text.strip() in ("0", "0.0") else positive(text)


def count(text: str) -> int:
    """Read a whole number above zero."""
    if not (text.isascii() and text.isdigit()) or int(text) == 0:
        raise argparse.ArgumentTypeError(f"{text!r}: need a whole number above 0")
    return int(text)


def unit_serial(text: str) -> int:
    """Read a serial number of a unit, as far as buses and histories carry them."""
    if not (text.isascii() and text.isdigit()) or len(text) > 19 or int(text) > MOST_SERIAL:
        raise argparse.ArgumentTypeError(
            f"{text!r}: a serial number is a whole number, 0 … {MOST_SERIAL}"
        )
    return int(text)


def seed(text: str) -> int:
    if not (text.isascii() and text.isdigit()) or int(text) >= 1 << 32:
        raise argparse.ArgumentTypeError(f"{text!r}: a seed is a whole number, 0 … 4294967295")
    return int(text)
