"""`ehadiag rul`: how long until a unit's severities reach their levels, from the health history."""

from __future__ import annotations

import argparse
import json

from ehadiag.assess.verdict import Levels
from ehadiag.cli import argument_types, options
from ehadiag.cli.history_file import add_history_file, open_history
from ehadiag.cli.output import emit, put, rendered

__all__ = ["add_parser", "run"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "rul",
        help="remaining useful life of a unit, from the health history",
        description="Remaining useful life: hours or cycles until each severity of a unit reaches"
        " the advisory level and the limit, from its health history and its fleet's. No number"
        " where the history cannot carry one; it is then said why.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--serial",
        type=argument_types.unit_serial,
        required=True,
        metavar="N",
        help="serial number of the unit",
    )
    parser.add_argument(
        "--unit",
        choices=("hours", "cycles"),
        help="of the answer (default: what more of the diagnoses say)",
    )
    add_history_file(parser)
    options.add_level_options(parser)
    options.add_seed_option(parser, "seed of the draws")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the forecasts; 0 also where there is no number."""
    levels = Levels(arguments.advisory, arguments.limit)
    with open_history(arguments) as history:
        entries, events = history.entries(), history.events()
    from ehadiag.prognosis.unit import prognosis_of  # noqa: PLC0415 - loads scipy
    from ehadiag.report.prognosis_table import (  # noqa: PLC0415
        print_prognosis,
        prognosis_object,
    )

    found = prognosis_of(
        arguments.serial,
        entries,
        events,
        (levels.advisory, levels.limit),
        arguments.unit,
        arguments.seed,
    )
    if arguments.json:
        put(json.dumps(prognosis_object(found), allow_nan=False))
    else:
        emit(rendered(lambda console: print_prognosis(found, console)))
    return 0
