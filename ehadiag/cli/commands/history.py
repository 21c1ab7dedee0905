"""`ehadiag history`: shows, exports and draws the health history, and adds maintenance events."""

from __future__ import annotations

import argparse
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.cli.argument_types import unit_serial
from ehadiag.cli.history_file import (
    add_history_file,
    add_usage_options,
    open_history,
    the_usage,
)
from ehadiag.cli.output import emit, put, rendered, say
from ehadiag.cli.overwriting import Output, refuse_overwriting
from ehadiag.core.errors import ConfigurationError, InputOutputError, reason_of
from ehadiag.core.folder import RESULT_MODE, Folder
from ehadiag.core.printable import printable, valid_text
from ehadiag.history.records import DIAGNOSIS, EVENT

if TYPE_CHECKING:
    from ehadiag.history.records import Entry, Event

__all__ = ["add_parser", "run"]

KINDS = (DIAGNOSIS, EVENT)
COLUMNS = ("no.", "when", "serial", "hours", "cycles", "test", "verdict", "severities, ± 95 %")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "history",
        help="health history: list, show, export, plot, init, event, withdraw",
        description="The health history: every diagnosis of every unit, appended to one SQLite"
        " file by `bit` and `diagnose`, and never changed.",
        allow_abbrev=False,
    )
    add_history_file(parser)
    verbs = parser.add_subparsers(metavar="VERB", required=True, dest="verb")

    def verb(name: str, what: str) -> argparse.ArgumentParser:
        made = verbs.add_parser(name, help=what, description=f"{what}.", allow_abbrev=False)
        add_history_file(made, again=True)
        return made

    verb("init", "begin a history: the named one, else the user's own")
    listed = verb("list", "list diagnoses and maintenance events")
    shown = verb("show", "show all that is kept of one diagnosis, as one JSON object")
    shown.add_argument("number", type=int, metavar="NUMBER", help="of the diagnosis, as in list")
    exported = verb("export", "write the severities of all diagnoses as CSV")
    drawn = verb("plot", "draw the severities of a unit over its hours")
    event = verb("event", "append a maintenance event")
    for parser_ in (listed, exported):
        _add_serial(parser_, required=False)
        parser_.add_argument(
            "--all", action="store_true", help="also what was withdrawn, and what a later diagnosis"
            " of the same recording has replaced"
        )  # fmt: skip
    listed.add_argument("--json", action="store_true", help="one JSON object a line")
    exported.add_argument("--out", metavar="FILE", help="CSV file (default: standard output)")
    _add_serial(drawn, required=True)
    drawn.add_argument("--out", metavar="FILE", required=True, help="picture, PNG")
    _add_serial(event, required=True)
    event.add_argument("text", metavar="TEXT", help='what was done, such as "filter changed"')
    event.add_argument(
        "--resets",
        action="append",
        default=[],
        metavar="NAME",
        help="severity that begins anew (Kintas, FSS, FDJ); repeatable (default: those that fall)",
    )
    event.add_argument("--when", metavar="TIME", help="ISO 8601; without a zone UTC (default: now)")
    add_usage_options(event)
    withdrawn = verb("withdraw", "append that a diagnosis or an event counts no more")
    withdrawn.add_argument("kind", choices=KINDS, metavar="KIND", help=" or ".join(KINDS))
    withdrawn.add_argument("number", type=int, metavar="NUMBER", help="its number, as in list")
    withdrawn.add_argument("text", metavar="TEXT", help='why, such as "of another unit"')
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Do what the verb says."""
    if getattr(arguments, "out", None):
        refuse_overwriting(arguments, [Output("--out", arguments.out)])
    {
        "init": _init,
        "list": _list,
        "show": _show,
        "export": _export,
        "plot": _plot,
        "event": _event,
        "withdraw": _withdraw,
    }[arguments.verb](arguments)
    return 0


def _add_serial(parser: argparse.ArgumentParser, *, required: bool) -> None:
    parser.add_argument(
        "--serial",
        type=unit_serial,
        metavar="N",
        required=required,
        help="serial number of the unit",
    )


def _init(arguments: argparse.Namespace) -> None:
    from ehadiag.cli.history_file import VARIABLE, history_place  # noqa: PLC0415
    from ehadiag.history.place import own_history  # noqa: PLC0415
    from ehadiag.history.store import History  # noqa: PLC0415

    place = history_place(arguments) or own_history()
    if place is None:
        raise ConfigurationError(f"no home folder is known: name a file by --history or {VARIABLE}")
    there = place.exists()
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputOutputError(f"history {place}: {reason_of(error)}") from None
    History(place, create=True).close()
    put(f"history {place}: {'was there already' if there else 'begun'}")


def _list(arguments: argparse.Namespace) -> None:
    entries, events = _read(arguments)
    if arguments.json:
        for entry in entries:
            put(json.dumps(_object(entry, brief=True)))
        for event in events:
            put(json.dumps(_event_object(event)))
        return
    from rich.table import Table  # noqa: PLC0415 - only who prints tables needs it

    table = Table(*COLUMNS, box=None, pad_edge=False)
    rows = [(item.when, _row(item)) for item in entries]
    rows += [(item.when, _event_row(item)) for item in events]
    for _, row in sorted(rows):
        table.add_row(*(printable(cell) for cell in row))
    emit(rendered(lambda console: console.print(table, crop=False)))


def _show(arguments: argparse.Namespace) -> None:
    with open_history(arguments) as history:
        kept = history.entries(withdrawn=True)
        found = [item for item in kept if item.number == arguments.number]
        if not found:
            raise ConfigurationError(
                f"history {history.path}: has no diagnosis {arguments.number};"
                " see ehadiag history list"
            )
    put(json.dumps(_object(found[0], brief=False), indent=2))


def _export(arguments: argparse.Namespace) -> None:
    from ehadiag.history.export import csv_of  # noqa: PLC0415

    entries, _ = _read(arguments)
    text = csv_of(entries)
    if arguments.out is None:
        emit(text)
    else:
        _write(arguments.out, text.encode())


def _plot(arguments: argparse.Namespace) -> None:
    from ehadiag.cli.matplotlib_alone import matplotlib_alone  # noqa: PLC0415

    arguments.all = False
    entries, events = _read(arguments)
    if not any(entry.severities for entry in entries):
        raise ConfigurationError(f"serial {arguments.serial}: no diagnosis with severities to draw")
    with matplotlib_alone():
        from ehadiag.report.history_picture import draw_history  # noqa: PLC0415 - matplotlib
    _write(arguments.out, draw_history(entries, events))


def _event(arguments: argparse.Namespace) -> None:
    from ehadiag.history.keep import now  # noqa: PLC0415
    from ehadiag.history.records import Event  # noqa: PLC0415
    from ehadiag.model.parameters import FAULT_NAMES  # noqa: PLC0415 - loads numpy

    strangers = [name for name in arguments.resets if name not in FAULT_NAMES]
    if strangers:
        raise ConfigurationError(f"--resets {strangers[0]}: there is {', '.join(FAULT_NAMES)}")
    event = Event(
        appended=now(),
        when=_when(arguments.when) if arguments.when else now(),
        serial=arguments.serial,
        actuator=None,
        usage=the_usage(arguments),
        text=valid_text(arguments.text),
        resets=tuple(arguments.resets),
    )
    with open_history(arguments) as history:
        number = history.append_event(event)
    put(f"event {number} of serial {arguments.serial}: {event.text}")


def _withdraw(arguments: argparse.Namespace) -> None:
    from ehadiag.history.keep import now  # noqa: PLC0415

    kind, number, text = arguments.kind, arguments.number, valid_text(arguments.text)
    with open_history(arguments) as history:
        history.withdraw(kind, number, now(), text)
    put(f"{kind} {number} counts no more: {text}")


def _when(text: str) -> str:
    from ehadiag.core.dates import utc_text  # noqa: PLC0415

    try:
        moment = datetime.fromisoformat(text)
        return utc_text(moment if moment.tzinfo else moment.replace(tzinfo=UTC))
    except (ValueError, OverflowError):
        raise ConfigurationError(
            f"--when {text}: need ISO 8601, such as 2026-03-01T12:00"
        ) from None


def _read(arguments: argparse.Namespace) -> tuple[list[Entry], list[Event]]:
    """Read the unit that was named, or all; what counts, or all."""
    from ehadiag.history.counted import counted  # noqa: PLC0415

    whole = arguments.all
    with open_history(arguments) as history:
        entries = history.entries(arguments.serial, withdrawn=whole)
        events = history.events(arguments.serial, withdrawn=whole)
    return (entries if whole else counted(entries)), events


def _row(entry: Entry) -> tuple[str, ...]:
    severities = ", ".join(
        f"{item.name} {item.estimate:.4f} ± {1.96 * item.std:.4f}"
        for item in entry.severities
        if item.estimate is not None and item.std is not None
    )
    return (
        str(entry.number),
        entry.when,
        _cell(entry.serial),
        _cell(entry.usage.hours),
        _cell(entry.usage.cycles),
        _cell(entry.test),
        entry.verdict.replace("_", " ") + _withdrawn(entry),
        severities or "; ".join(entry.reasons),
    )


def _event_row(event: Event) -> tuple[str, ...]:
    resets = f" (begins anew: {', '.join(event.resets)})" if event.resets else ""
    usage = (_cell(event.usage.hours), _cell(event.usage.cycles))
    kind = f"event {event.number}{_withdrawn(event)}"
    return ("", event.when, str(event.serial), *usage, "", kind, event.text + resets)


def _withdrawn(item: Entry | Event) -> str:
    return "" if item.withdrawn is None else f" (withdrawn: {item.withdrawn})"


def _cell(value: float | str | None) -> str:
    return "-" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _object(entry: Entry, *, brief: bool) -> dict[str, object]:
    tree: dict[str, object] = {
        "schema": "ehadiag.history/1",
        "kind": "diagnosis",
        "number": entry.number,
        "appended": entry.appended,
        "tested": entry.tested,
        "actuator": entry.actuator,
        "serial": entry.serial,
        "test": entry.test,
        "verdict": entry.verdict,
        "withdrawn": entry.withdrawn,
        "hours": entry.usage.hours,
        "cycles": entry.usage.cycles,
        "severities": {
            item.name: {
                "estimate": item.estimate,
                "std": item.std,
                "interval95": [item.low, item.high],
                "at_bound": item.at_bound,
                "shown": item.shown,
            }
            for item in entry.severities
        },
    }
    if brief:
        return tree
    return tree | {
        "reasons": list(entry.reasons),
        "covariance": entry.covariance,
        "effects": {
            item.name: {"value": item.value, "std": item.std, "at_bound": item.at_bound}
            for item in entry.effects
        },
        "recordings": [
            {"path": item.path, "sha256": item.sha256, "samples": item.samples}
            for item in entry.sources
        ],
        "version": entry.version,
        "simulated": entry.simulated,
        "result": json.loads(entry.result),
    }


def _event_object(event: Event) -> dict[str, object]:
    return {
        "schema": "ehadiag.history/1",
        "kind": "event",
        "number": event.number,
        "appended": event.appended,
        "when": event.when,
        "serial": event.serial,
        "hours": event.usage.hours,
        "cycles": event.usage.cycles,
        "text": event.text,
        "withdrawn": event.withdrawn,
        "resets": list(event.resets),
    }


def _write(name: str, content: bytes) -> None:
    path = Path(name)
    try:
        with Folder.at(path.parent, RESULT_MODE, follow=True) as folder:
            folder.write(path.name, content)
    except (OSError, ValueError) as error:
        reason = reason_of(error)
        raise InputOutputError(f"file {name}: {reason}") from None
    say(f"wrote {name}")
