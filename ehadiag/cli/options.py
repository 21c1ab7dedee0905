"""Command-line options that several commands share."""

from __future__ import annotations

import argparse

from ehadiag.cli.argument_types import count, instant, positive, seed, share
from ehadiag.cli.effects import add_effect_options

__all__ = [
    "TEST",
    "add_actuator_options",
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
]

TEST = "open|closed|NUMBER|FILE"
"""How every command lets a test be named."""
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
        type=share,
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
            type=instant,
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
