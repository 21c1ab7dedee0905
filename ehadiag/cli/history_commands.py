"""The command `history` with its verbs."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

from msgspec.structs import replace

from ehadiag.assess.verdict import Levels
from ehadiag.cli.command_parser import show_help
from ehadiag.cli.options import (
    HISTORY_VARIABLE,
    add_history_option,
    add_usage_options,
    history_path,
    open_named_history,
    unit_number,
    units_of,
    usage_from_options,
    user_history_path,
)
from ehadiag.cli.result_output import OutputFile, refuse_overwriting
from ehadiag.core.conventions import shown_date, utc_time_text
from ehadiag.core.criteria import NORMAL_HALF_WIDTH_95
from ehadiag.history.records import (
    DIAGNOSIS_TABLE,
    EVENT_TABLE,
    Entry,
    MaintenanceEvent,
    counted_entries,
    current_utc_text,
    entries_from_csv,
    entry_object,
    event_object,
    history_csv,
    history_parquet,
    of_unit,
)
from ehadiag.model.severities import FAULT_LAWS
from ehadiag.report.rendering import isolated_png
from ehadiag.terminal.output import (
    print_status,
    print_text,
    terminal_console,
    write_drawn,
    write_output,
)
from firmware_iface.errors import (
    ConfigurationError,
    InputOutputError,
    printable,
    reason_of,
    valid_text,
)
from firmware_iface.files import read_small_file, write_file

WITHDRAWABLE_KINDS = (DIAGNOSIS_TABLE, EVENT_TABLE)
REPLACED_PARTS = {
    part: tuple(name for name, law in FAULT_LAWS.items() if part in (*law.parts, "unit"))
    for part in (*dict.fromkeys(part for law in FAULT_LAWS.values() for part in law.parts), "unit")
}
"""Severities that begin anew where a part is replaced; the first stage's filter is in the valve."""
HISTORY_COLUMNS = (
    "no.",
    "when",
    "serial",
    "actuator",
    "hours",
    "cycles",
    "test",
    "verdict",
    "severities, ± 95 %",
)


def define_history(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "The health history: every diagnosis of every unit, appended to one SQLite"
        " file by `bit` and `diagnose`, and never changed."
    )
    add_history_option(parser)
    show_help(
        parser,
        "ehadiag history init --history fleet.sqlite",
        "ehadiag history list --history fleet.sqlite --unit 7",
    )
    verbs = parser.add_subparsers(metavar="VERB", required=True, dest="verb")

    def verb(
        name: str, what: str, function: Callable[[argparse.Namespace], None]
    ) -> argparse.ArgumentParser:
        made = verbs.add_parser(
            name, help=what, description=f"{what[0].upper()}{what[1:]}.", allow_abbrev=False
        )
        add_history_option(made, again=True)
        made.set_defaults(verb_function=function)
        return made

    verb("init", "begin a history: the named one, else the user's own", _init)
    listed = verb("list", "list diagnoses and maintenance events", _list)
    shown = verb("show", "show all that is kept of one diagnosis, as one JSON object", _show)
    shown.add_argument("number", type=int, metavar="NUMBER", help="of the diagnosis, as in list")
    exported = verb("export", "write the severities of all diagnoses as CSV or Parquet", _export)
    imported = verb("import", "append diagnoses of another system from a CSV file", _import)
    imported.add_argument(
        "file", metavar="FILE", help="CSV in the columns of export; number, cycles, low95, high95,"
        " at_bound, shown, recording and sha256 may be missing"
    )  # fmt: skip
    drawn = verb("plot", "draw the severities of a unit over its hours", _plot)
    event = verb("event", "append a maintenance event", _event)
    for parser_ in (listed, exported):
        _add_unit(parser_, required=False)
        parser_.add_argument(
            "--all", action="store_true", help="also what was withdrawn, and what a later diagnosis"
            " of the same recording has replaced"
        )  # fmt: skip
    listed.add_argument("--json", action="store_true", help="one JSON object a line")
    exported.add_argument(
        "--out", metavar="FILE", help="file, .csv or .parquet (default: CSV on standard output)"
    )
    _add_unit(drawn, required=True)
    drawn.add_argument("--out", metavar="FILE", required=True, help="picture, PNG")
    _add_unit(event, required=True)
    event.add_argument("text", metavar="TEXT", help='what was done, such as "filter changed"')
    event.add_argument(
        "--resets",
        action="append",
        default=[],
        metavar="NAME",
        help=f"severity that begins anew ({', '.join(FAULT_LAWS)}); repeatable (default: those"
        " that fall)",
    )
    event.add_argument(
        "--replaced",
        action="append",
        default=[],
        choices=REPLACED_PARTS,
        help="part that was replaced, whose severities alone begin anew; `unit`: the actuator was"
        " swapped for another one, all begin anew, and so may its hours; repeatable",
    )
    event.add_argument("--when", metavar="TIME", help="ISO 8601; without a zone UTC (default: now)")
    add_usage_options(event)
    withdrawn = verb("withdraw", "append that a diagnosis or an event counts no more", _withdraw)
    withdrawn.add_argument(
        "kind", choices=WITHDRAWABLE_KINDS, metavar="KIND", help=" or ".join(WITHDRAWABLE_KINDS)
    )
    withdrawn.add_argument("number", type=int, metavar="NUMBER", help="its number, as in list")
    withdrawn.add_argument("text", metavar="TEXT", help='why, such as "of another unit"')


def run_history(arguments: argparse.Namespace) -> int:
    """Do what the verb says."""
    if getattr(arguments, "out", None):
        suffixes = (".png",) if arguments.verb == "plot" else (".csv", ".parquet")
        if Path(arguments.out).suffix.lower() not in suffixes:
            raise ConfigurationError(f"--out {arguments.out}: need {' or '.join(suffixes)}")
        refuse_overwriting(arguments, [OutputFile("--out", arguments.out)])
    arguments.verb_function(arguments)
    return 0


def _add_unit(parser: argparse.ArgumentParser, *, required: bool) -> None:
    parser.add_argument(
        "--unit",
        type=unit_number,
        metavar="N",
        required=required,
        help="serial number of the unit",
    )
    parser.add_argument(
        "--actuator",
        metavar="NAME",
        help="of the unit, where its serial number is another actuator's too",
    )


def _init(arguments: argparse.Namespace) -> None:
    from ehadiag.history.store import History  # noqa: PLC0415

    place = history_path(arguments) or user_history_path()
    if place is None:
        raise ConfigurationError(
            f"no home folder is known: name a file by --history or {HISTORY_VARIABLE}"
        )
    there = place.exists()
    try:
        place.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
    except OSError as error:
        raise InputOutputError(f"history {place}: {reason_of(error)}") from None
    History(place, create=True).close()
    print_text(f"history {place}: {'was there already' if there else 'begun'}")


def _list(arguments: argparse.Namespace) -> None:
    entries, events = _read(arguments)
    if arguments.json:
        for entry in entries:
            print_text(json.dumps(entry_object(entry, brief=True)))
        for event in events:
            print_text(json.dumps(event_object(event)))
        return
    from rich.table import Table  # noqa: PLC0415 - only who prints tables needs it

    # Of one type the name is in no need of a column.
    kinds = {item.actuator for item in entries}
    shown = [at for at, name in enumerate(HISTORY_COLUMNS) if len(kinds) > 1 or name != "actuator"]
    table = Table(*(HISTORY_COLUMNS[at] for at in shown), box=None, pad_edge=False)
    rows = [(item.when, _entry_row(item)) for item in entries]
    rows += [(item.when, _event_row(item)) for item in events]
    for _, row in sorted(rows):
        table.add_row(*(printable(row[at]) for at in shown))
    console = terminal_console()
    console.print(table, crop=False)
    write_drawn(console)


def _show(arguments: argparse.Namespace) -> None:
    with open_named_history(arguments) as history:
        found = history.entry(arguments.number)
    print_text(json.dumps(entry_object(found, brief=False), indent=2))


def _export(arguments: argparse.Namespace) -> None:
    entries, _ = _read(arguments)
    if arguments.out is None:
        write_output(history_csv(entries))
        return
    path = Path(arguments.out)
    parquet = path.suffix.lower() == ".parquet"
    content = history_parquet(entries) if parquet else history_csv(entries).encode()
    write_file(path, content, "file")
    print_status(f"wrote {arguments.out}")


def _import(arguments: argparse.Namespace) -> None:
    # A million rows.
    content = read_small_file(Path(arguments.file), 200_000_000, "table")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ConfigurationError(f"{arguments.file}: is not UTF-8") from None
    entries = entries_from_csv(text, arguments.file, tuple(FAULT_LAWS))
    with open_named_history(arguments) as history:
        number = history.append_new(entries)
    there = len(entries) - number
    more = f"; {there} more were there already" if there else ""
    print_text(f"{number} diagnoses of {arguments.file}{more}")


def _plot(arguments: argparse.Namespace) -> None:
    from ehadiag.prognosis.units import prognosis_of  # noqa: PLC0415 - slow
    from ehadiag.report.trend_bus_pictures import has_trend, history_picture  # noqa: PLC0415

    levels = Levels()
    with open_named_history(arguments) as history:
        kind = history.actuator_of(arguments.unit, arguments.actuator)
        whole, changes = history.alike(arguments.unit, kind)
    own, events = of_unit(whole, changes, arguments.unit, kind)
    entries = counted_entries(own)
    if not has_trend(entries):
        raise ConfigurationError(f"serial {arguments.unit}: no diagnosis with severities to draw")
    both = (levels.advisory, levels.limit)
    future = prognosis_of(arguments.unit, whole, changes, both, actuator=kind)
    picture = history_picture(entries, events, future)
    write_file(Path(arguments.out), isolated_png(picture), "file")
    print_status(f"wrote {arguments.out}")


def _event(arguments: argparse.Namespace) -> None:

    strangers = [name for name in arguments.resets if name not in FAULT_LAWS]
    if strangers:
        raise ConfigurationError(f"--resets {strangers[0]}: there is {', '.join(FAULT_LAWS)}")
    if not arguments.text.strip():
        raise ConfigurationError("TEXT: is empty; say what was done")
    when, now = arguments.when and _when(arguments.when), current_utc_text()
    if when and when > now:
        raise ConfigurationError(f"--when {arguments.when}: is in the future")
    renewed = {name for part in arguments.replaced for name in REPLACED_PARTS[part]}
    event = MaintenanceEvent(
        appended=now,
        when=when or now,
        serial=arguments.unit,
        actuator=arguments.actuator,
        usage=usage_from_options(arguments),
        text=valid_text(arguments.text),
        resets=tuple(name for name in FAULT_LAWS if name in renewed.union(arguments.resets)),
    )
    with open_named_history(arguments) as history:
        event = replace(event, actuator=history.actuator_of(event.serial, event.actuator))
        number = history.append_event(event)
    print_text(f"event {number} of serial {arguments.unit}: {event.text}")


def _withdraw(arguments: argparse.Namespace) -> None:
    kind, number, text = arguments.kind, arguments.number, valid_text(arguments.text)
    with open_named_history(arguments) as history:
        history.withdraw(kind, number, current_utc_text(), text)
    print_text(f"{kind} {number} counts no more: {text}")


def _when(text: str) -> str:
    try:
        return utc_time_text(text)
    except ValueError:
        raise ConfigurationError(
            f"--when {text}: need ISO 8601, such as 2026-03-01T12:00"
        ) from None


def _read(arguments: argparse.Namespace) -> tuple[list[Entry], list[MaintenanceEvent]]:
    """Read the unit that was named, or all; what counts, or all."""

    whole, serial, kind = arguments.all, arguments.unit, arguments.actuator
    with open_named_history(arguments) as history:
        if serial is not None:
            history.actuator_of(serial, kind or next((of for of, _ in history.units(serial)), None))
        elif kind is not None:
            units_of(history, kind)
        entries = history.entries(serial, withdrawn=whole, brief=True)
        events = history.events(serial, withdrawn=whole)
    if kind is not None:
        entries = [item for item in entries if item.actuator == kind]
        events = [item for item in events if item.actuator in (None, kind)]
    return (entries if whole else counted_entries(entries)), events


def _entry_row(entry: Entry) -> tuple[str, ...]:
    severities = ", ".join(
        f"{item.name} {item.estimate:.4f}"
        + f" ± {NORMAL_HALF_WIDTH_95 * item.std:.4f}" * entry.relied_on
        for item in entry.severities
        if item.estimate is not None and item.std is not None
    )
    return (
        str(entry.number),
        shown_date(entry.when),
        _cell(entry.serial),
        entry.actuator,
        _cell(entry.usage.hours),
        _cell(entry.usage.cycles),
        _cell(entry.test),
        entry.verdict.replace("_", " ") + _withdrawn(entry),
        severities or "; ".join(entry.reasons),
    )


def _event_row(event: MaintenanceEvent) -> tuple[str, ...]:
    resets = f" (begins anew: {', '.join(event.resets)})" if event.resets else ""
    usage = (_cell(event.usage.hours), _cell(event.usage.cycles))
    kind = f"event {event.number}{_withdrawn(event)}"
    unit = (str(event.serial), _cell(event.actuator))
    return ("", shown_date(event.when), *unit, *usage, "", kind, event.text + resets)


def _withdrawn(item: Entry | MaintenanceEvent) -> str:
    return "" if item.withdrawn is None else f" (withdrawn: {item.withdrawn})"


def _cell(value: float | str | None) -> str:
    return "-" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
