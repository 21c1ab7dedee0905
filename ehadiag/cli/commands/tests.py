"""`ehadiag tests`: lists the stored tests, or prints one's command."""

from __future__ import annotations

import argparse
import csv
import sys

from ehadiag.cli import options
from ehadiag.cli.output import emit, rendered
from ehadiag.core.stored_test import UNITS, bundled_tests, resolve_test

__all__ = ["add_parser", "run"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "tests",
        help="list the stored tests",
        description="List the stored tests; --csv prints time and command of one.",
        allow_abbrev=False,
    )
    parser.add_argument("--csv", metavar=options.TEST, help="test to print as CSV")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """List the tests or print one."""
    if arguments.csv:
        test = resolve_test(arguments.csv)
        writer = csv.writer(sys.stdout, lineterminator="\n")
        writer.writerow(["time_s", f"command_{test.unit}"])
        scale = UNITS[test.mode][test.unit]
        for time, value in zip(test.time(), test.command() / scale, strict=True):
            writer.writerow([f"{time:.9g}", f"{value:.9g}"])
        return 0
    from rich.table import Table  # noqa: PLC0415 - not for CSV

    table = Table(box=None, pad_edge=False)
    for name in ("id", "name", "command", "length", "rate", "description"):
        table.add_column(name, justify="right" if name in ("id", "length", "rate") else "left")
    for test in sorted(bundled_tests().values(), key=lambda item: item.id):
        table.add_row(
            str(test.id),
            test.name,
            f"{test.mode}, {test.unit}",
            f"{test.duration:g} s",
            f"{test.rate:g} Hz",
            test.description,
        )
    emit(rendered(lambda console: console.print(table)))
    return 0
