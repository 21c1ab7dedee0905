"""The command `rul`: remaining useful life of a unit, or of all by urgency."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from ehadiag.assess.verdict import Levels
from ehadiag.cli import options
from ehadiag.cli.command_parser import show_help
from ehadiag.cli.options import (
    add_history_option,
    add_usage_options,
    open_named_history,
    units_of,
    usage_from_options,
)
from ehadiag.core.interruption import ignore_interrupt_in_worker
from ehadiag.terminal.output import counting_bar, print_text, terminal_console, write_drawn
from firmware_iface.errors import ConfigurationError, InputOutputError

if TYPE_CHECKING:
    from ehadiag.history.store import History
    from ehadiag.prognosis.units import Prognosis

MAX_TIME = 1e9
"""Hours, cycles or days until an inspection, at most: no unit lasts as long."""


def define_rul(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Remaining useful life: hours, cycles or days until each severity of a unit"
        " reaches the advisory level and the limit, from its health history and its fleet's. Where"
        " the history cannot carry a number, the reason is given."
    )
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument(
        "--unit", type=options.unit_number, metavar="N", help="serial number of the unit"
    )
    which.add_argument("--all", action="store_true", help="all units, by urgency")
    parser.add_argument(
        "--actuator",
        metavar="NAME",
        help="of the unit, where several have its serial number; with --all: only units of it",
    )
    parser.add_argument(
        "--in",
        dest="in_unit",
        choices=("hours", "cycles", "days"),
        help="of the answer (default: hours or cycles, what more of the diagnoses say)",
    )
    parser.add_argument(
        "--before",
        metavar="TIME",
        help="chance to reach the limit before the next inspection: a date, or hours (cycles, days)"
        " from now",
    )
    add_usage_options(parser, "today (default: by its use a day since its last test)")
    add_history_option(parser)
    options.add_request_options(parser, *options.LEVELS)
    options.add_request_options(
        parser, "seed", help="seed of the draws (default 0); the same seed, the same answer"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object a unit")
    show_help(
        parser,
        "ehadiag rul --unit 7 --history fleet.sqlite",
        "ehadiag rul --all --before 200 --history fleet.sqlite",
        usual="--unit --all --in --before --history --advisory --limit --json --help-all",
    )


def run_rul(arguments: argparse.Namespace) -> int:
    """Print the forecasts; 0 also where there is no number."""
    from ehadiag.prognosis.units import forecast  # noqa: PLC0415 - numpy
    from ehadiag.report.prognosis_tables import (  # noqa: PLC0415
        print_prognosis,
        print_urgencies,
        prognosis_tree,
    )

    levels = Levels(arguments.advisory, arguments.limit)
    usage = usage_from_options(arguments)
    if arguments.all and usage.known:
        raise ConfigurationError("--hours, --cycles: of one unit, not of --all")
    with open_named_history(arguments) as history:
        if arguments.all:
            found = sorted(_of_all(history, arguments, levels), key=_urgency)
        else:
            found = [
                forecast(
                    history, arguments.unit, advisory=levels.advisory, limit=levels.limit,
                    unit=arguments.in_unit, today=usage, actuator=arguments.actuator,
                    seed=arguments.seed,
                )
            ]  # fmt: skip
    text, ahead = arguments.before, None
    if text is not None:
        ahead = [_time_before(item, text, alone=not arguments.all) for item in found]
    if arguments.json:
        for place, item in enumerate(found):
            before = (text, ahead[place]) if ahead else None
            print_text(json.dumps(prognosis_tree(item, before), allow_nan=False))
        return 0
    console = terminal_console()
    if arguments.all:
        print_urgencies(found, console, ahead)
    else:
        print_prognosis(found[0], console, (text, ahead[0]) if ahead else None)
    write_drawn(console)
    return 0


def _of_all(history: History, arguments: argparse.Namespace, levels: Levels) -> Iterator[Prognosis]:
    """Forecast all units, on all processors where there are many."""
    from ehadiag.batch.workers import Workers, worker_count  # noqa: PLC0415
    from ehadiag.history.records import current_utc_text  # noqa: PLC0415
    from ehadiag.prognosis.units import prognosis_in  # noqa: PLC0415

    units = units_of(history, arguments.actuator)
    both = (levels.advisory, levels.limit)
    jobs = worker_count(len(units))
    make = prognosis_in if jobs == 1 else _in_worker
    work = partial(make, history.path, both, arguments.in_unit, arguments.seed, current_utc_text())
    with Workers(jobs) as workers, counting_bar(len(units), "unit") as count:
        for item in workers.over(work, units, _given_up) if jobs > 1 else map(work, units):
            yield item
            count()


def _in_worker(
    path: Path, levels: Sequence[float], unit: str | None, seed: int, now: str,
    which: tuple[str, int],
) -> Prognosis:  # fmt: skip
    from ehadiag.prognosis.units import prognosis_in  # noqa: PLC0415

    ignore_interrupt_in_worker()
    return prognosis_in(path, levels, unit, seed, now, which)


def _given_up(which: tuple[str, int]) -> Prognosis:
    raise InputOutputError(f"serial {which[1]} of {which[0]}: the process that forecast it ended")


def _urgency(item: Prognosis) -> tuple[bool, bool, float, str, int]:
    first = item.first()
    reached, left = (first[1].reached, first[1].median or 0.0) if first else (False, 0.0)
    return first is None, not reached, left, item.actuator or "", item.serial


def _time_before(item: Prognosis, text: str, *, alone: bool) -> float | None:
    """Hours, cycles or days until the next inspection; None: one of many has no use a day."""
    from ehadiag.report.prognosis_tables import is_number  # noqa: PLC0415

    if is_number(text):
        if not 0.0 <= (time := float(text)) <= MAX_TIME:
            raise ConfigurationError(f"--before {text}: need 0 … {MAX_TIME:g}, or a date")
        return time
    known = bool(item.per_day)
    dated = item if known or alone else replace(item, per_day=1.0)
    try:
        time = dated.time_until(text)
    except ConfigurationError as error:
        raise ConfigurationError(f"--before {error}") from None
    return time if known else None
