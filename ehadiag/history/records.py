"""Records of the health history, diagnoses and maintenance events, and their table for others.

A record is made from a diagnosis with hashes of its recordings. Of several diagnoses of one
recording only the last one counts. The table has a row for each severity: CSV, Parquet, and CSV
read in.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import stat
from collections.abc import Collection, Iterator, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from ehadiag.core.conventions import MAX_HISTORY_SERIAL, utc_text, utc_time_text
from ehadiag.core.criteria import NORMAL_HALF_WIDTH_95
from ehadiag.estimate import AT_BOUND, NOT_SHOWN, Effect, Severity
from firmware_iface import FREE_MOTION
from firmware_iface.errors import ConfigurationError, install_command, valid_text

if TYPE_CHECKING:
    from ehadiag.result import Result

DIAGNOSIS_TABLE, EVENT_TABLE = "diagnosis", "event"
"""Kinds of what can be withdrawn, and their tables."""


class Usage(msgspec.Struct, frozen=True):
    """How long a unit had been in use.

    Attributes
    ----------
    hours : float | None
        Operating hours since the unit was new, h; None where unknown.
    cycles : float | None
        Cycles (flights, or what the operator counts) since the unit was new.

    Raises
    ------
    ConfigurationError
        One of them is negative or no number.
    """

    hours: float | None = None
    cycles: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("hours", self.hours), ("cycles", self.cycles)):
            if value is not None and not 0.0 <= value < math.inf:
                raise ConfigurationError(f"{name} {value:g}: need a number of at least 0")

    def amount(self, unit: str) -> float | None:
        """Hours or cycles, by the name of the unit; None of days."""
        return {"hours": self.hours, "cycles": self.cycles}.get(unit)

    @property
    def known(self) -> bool:
        """Whether there is any of them."""
        return self.hours is not None or self.cycles is not None


class SourceRecord(msgspec.Struct, frozen=True):
    """A recording that a diagnosis was made from."""

    path: str
    """As it was named."""
    sha256: str | None
    """Of the file's bytes, hexadecimal; None where there is no file."""
    samples: str | None
    """Hash of the decoded samples, the same in whatever format they were kept; None without any."""


class Entry(msgspec.Struct, frozen=True):
    """One diagnosis."""

    appended: str
    """When it was appended: UTC, ISO 8601."""
    tested: str | None
    """When the test began: UTC, ISO 8601; None where the recording does not say."""
    actuator: str
    serial: int | None
    test: str | None
    verdict: str
    reasons: tuple[str, ...]
    usage: Usage
    sources: tuple[SourceRecord, ...]
    severities: tuple[Severity, ...]
    """Empty where nothing was identified."""
    covariance: tuple[tuple[float, ...], ...] | None
    """Of the severities, in their order."""
    effects: tuple[Effect, ...]
    version: str
    """Of the program that made the diagnosis."""
    simulated: bool
    """Whether the unit was a simulated one, as far as the program knew."""
    result: str
    """The JSON result, one line."""
    number: int = 0
    """In its history, from 1; 0: not appended yet."""
    withdrawn: str | None = None
    """Why it counts no more; None: it counts."""

    @property
    def when(self) -> str:
        """Time of the test, else of the diagnosis; UTC, ISO 8601."""
        return self.tested or self.appended

    @property
    def by_test(self) -> bool:
        """Whether it is of a test; else of a monitor, which gives no verdict."""
        return self.test != FREE_MOTION

    @property
    def relied_on(self) -> bool:
        """Whether stated intervals hold: not those of a test that its best fit does not explain."""
        return self.verdict != "NOT_TESTED" or not self.by_test


class MaintenanceEvent(msgspec.Struct, frozen=True):
    """What was done to a unit."""

    appended: str
    """When it was appended: UTC, ISO 8601."""
    when: str
    """When it was done: UTC, ISO 8601."""
    serial: int
    actuator: str | None
    """None: whatever actuator has this serial number."""
    usage: Usage
    text: str
    resets: tuple[str, ...]
    """Severities that begin anew; empty: those that fell."""
    number: int = 0
    """In its history, from 1; 0: not appended yet."""
    withdrawn: str | None = None
    """Why it counts no more; None: it counts."""


RESTARTED_SHARE = 0.5
"""Share of a unit's hours, 1, below which those after a swap are another unit's; rounded hours and
typing errors are above it."""
MAX_DATE_ROUNDING_S = 2.0
"""Time, s, by which formats of logs round dates."""


class _RecordingIdentity(msgspec.Struct, frozen=True):
    """Identity of a recording, whatever file it is in."""

    samples: str
    date: datetime | None

    def same(self, other: _RecordingIdentity) -> bool:
        """Whether the samples are the same, and the dates may be."""
        if self.samples != other.samples:
            return False
        if self.date is None or other.date is None:
            return True
        apart = abs((self.date - other.date).total_seconds())
        # Time zones differ by quarters of an hour, by a day at most.
        step, day = 900.0, 86400.0
        off = apart % step
        return apart < day + MAX_DATE_ROUNDING_S and min(off, step - off) < MAX_DATE_ROUNDING_S


def counted_entries(entries: Sequence[Entry]) -> list[Entry]:
    """Return the diagnoses that count, oldest first.

    A recording that was diagnosed again counts with its last diagnosis alone, also where this took
    several recordings together. Hours and cycles that only an earlier one has are kept.

    entries: in the order in which they were appended.
    """
    recordings = [_recording_identities(entry) for entry in entries]
    last: dict[str, list[tuple[_RecordingIdentity, Usage]]] = {}
    usages: list[Usage] = []
    for entry, named in zip(entries, recordings, strict=True):
        usage = entry.usage
        for item in named:
            for before, earlier in reversed(last.get(item.samples, [])):
                if item.same(before):
                    usage = _merged_usage(usage, earlier)
        usages.append(usage)
        for item in named:
            last.setdefault(item.samples, []).append((item, usage))
    seen: dict[str, list[_RecordingIdentity]] = {}
    out = []
    for entry, named, usage in list(zip(entries, recordings, usages, strict=True))[::-1]:
        if any(item.same(other) for item in named for other in seen.get(item.samples, [])):
            continue
        for item in named:
            seen.setdefault(item.samples, []).append(item)
        out.append(entry if usage is entry.usage else replace(entry, usage=usage))
    return out[::-1]


def of_unit(
    entries: Sequence[Entry], events: Sequence[MaintenanceEvent], serial: int, actuator: str | None
) -> tuple[list[Entry], list[MaintenanceEvent]]:
    """Diagnoses and maintenance of one unit among those of others.

    serial, actuator: of the unit; an event without an actuator is of every one.
    """
    return (
        [item for item in entries if (item.serial, item.actuator) == (serial, actuator)],
        [i for i in events if i.serial == serial and i.actuator in (None, actuator)],
    )


def is_swap(event: MaintenanceEvent, names: Collection[str]) -> bool:
    """Whether an event renews all severities, by their names."""
    return bool(event.resets) and {*names} <= {*event.resets}


def continued_usage(
    entries: Sequence[Entry], events: Sequence[MaintenanceEvent], names: Collection[str]
) -> tuple[list[Entry], list[MaintenanceEvent], dict[int, Usage]]:
    """Count hours and cycles on where those of a unit that was swapped begin anew.

    entries: diagnoses of units of one actuator; events: their maintenance; after one that renews
    all severities less than half of the hours before it are those of the new unit; other falls are
    rounding; names: of all severities. Returns both in the same order, and what each serial
    number's usage was counted on by at last.
    """
    swaps = {id(item) for item in events if is_swap(item, names)}
    if not swaps:
        return list(entries), list(events), {}
    pairs: list[Entry | MaintenanceEvent] = [*entries, *events]
    usages = [item.usage for item in pairs]
    state: dict[tuple[int | None, str], tuple[float, float, bool]] = {}
    # A diagnosis at the very time of an event was made before the work.
    for place in sorted(range(len(pairs)), key=lambda at: (pairs[at].when, at >= len(entries))):
        item, amounts = pairs[place], dict[str, float]()
        for unit in ("hours", "cycles"):
            base, last, before = state.get((item.serial, unit), (0.0, 0.0, False))
            swap, amount = id(item) in swaps, item.usage.amount(unit)
            swapped = before or swap
            if amount is not None:
                if swapped and amount < RESTARTED_SHARE * last:
                    base, swapped = base + last, before and swap
                last, swapped = amount, swapped and place >= len(entries)
                amounts[unit] = base + amount
            state[item.serial, unit] = base, last, swapped
        usages[place] = Usage(**amounts)
    bases = {
        serial: Usage(*(state[serial, unit][0] for unit in ("hours", "cycles")))
        for serial in {item.serial for item in events}
    }
    return (
        [replace(item, usage=usage) for item, usage in zip(entries, usages, strict=False)],
        [replace(item, usage=usage)
         for item, usage in zip(events, usages[len(entries) :], strict=True)],
        bases,
    )  # fmt: skip


def _merged_usage(first: Usage, second: Usage) -> Usage:
    return Usage(
        second.hours if first.hours is None else first.hours,
        second.cycles if first.cycles is None else first.cycles,
    )


def _recording_identities(entry: Entry) -> list[_RecordingIdentity]:
    """Identities of an entry's recordings; those without samples or file have none."""
    names = [item.samples or item.sha256 or "" for item in entry.sources]
    # The date of an entry is that of its first recording.
    date = None if entry.tested is None else datetime.fromisoformat(entry.tested)
    return [
        _RecordingIdentity(name, date if place == 0 else None)
        for place, name in enumerate(names)
        if name
    ]


def hash_of_file(path: str) -> str | None:
    """Return the SHA-256 of a file's bytes, hexadecimal; None without such a regular file."""
    try:
        # Opening a FIFO must not block.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except (OSError, ValueError):
        return None
    with open(handle, "rb") as file:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            return None
        try:
            return hashlib.file_digest(file, "sha256").hexdigest()
        except OSError:
            return None


def current_utc_text() -> str:
    """Time of day: UTC, ISO 8601, to the millisecond."""
    return utc_text(datetime.now(UTC))


def history_entry(result: Result, usage: Usage, *, simulated: bool) -> Entry:
    """Return what is kept of a result.

    usage: of the unit when the test was made; simulated: whether the unit is known to be a
    simulated one.
    """
    # A name that is not UTF-8 is a file's name only where the recordings are at hand.
    names = [item.source for item in (result.recordings if result.at_hand else result.origins)]
    return Entry(
        appended=current_utc_text(),
        tested=result.origins[0].date if result.origins else None,
        actuator=valid_text(result.actuator),
        serial=result.serial,
        test=result.test and valid_text(result.test),
        verdict=result.verdict.name,
        reasons=result.reasons,
        usage=usage,
        sources=tuple(
            SourceRecord(item.source, hash_of_file(name), item.samples_sha256)
            for item, name in zip(result.origins, names, strict=True)
        ),
        severities=tuple(result.severities.values()) if result.estimated else (),
        covariance=result.covariance,
        effects=result.effects,
        version=result.package.version,
        simulated=simulated,
        result=result.to_json(),
    )


HISTORY_OBJECT_SCHEMA = "ehadiag.history/1"


def entry_object(entry: Entry, *, brief: bool) -> dict[str, Any]:
    """Return the JSON object of a diagnosis; `brief` leaves out effects, recordings and result."""
    tree: dict[str, Any] = {
        "schema": HISTORY_OBJECT_SCHEMA,
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
                "interval95": list(item.interval95 or (None, None)),
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


def event_object(event: MaintenanceEvent) -> dict[str, Any]:
    """Return the JSON object of a maintenance event."""
    return {
        "schema": HISTORY_OBJECT_SCHEMA,
        "kind": "event",
        "number": event.number,
        "appended": event.appended,
        "when": event.when,
        "serial": event.serial,
        "actuator": event.actuator,
        "hours": event.usage.hours,
        "cycles": event.usage.cycles,
        "text": event.text,
        "withdrawn": event.withdrawn,
        "resets": list(event.resets),
    }


HISTORY_COLUMNS: dict[str, type] = {
    "number": int, "when": str, "actuator": str, "serial": int, "hours": float, "cycles": float,
    "test": str, "verdict": str, "severity": str, "estimate": float, "std": float,
    "low95": float, "high95": float, "at_bound": int, "shown": int, "recording": str,
    "sha256": str, "withdrawn": str,
}  # fmt: skip
"""Columns with the types of their values."""
NEEDED_COLUMNS = ("when", "actuator", "serial", "verdict", "severity", "estimate", "std")
COLUMN_RANGES = {
    "hours": (0.0, 1e9), "cycles": (0.0, 1e9), "estimate": (0.0, 1.0), "std": (1e-9, 1e3),
    "low95": (-1e4, 1e4), "high95": (-1e4, 1e4),
}  # fmt: skip
"""Ranges of the numbers that are read; wide for intervals: a test may not show a severity."""
FORMULA_PREFIXES = ("=", "+", "-", "@", "\t", "\r")
IMPORT_SCHEMA = "ehadiag.history-import/1"
KNOWN_VERDICTS = ("HEALTHY", "DEGRADED", "FAULT", "NOT_TESTED")


def history_csv(entries: Sequence[Entry]) -> str:
    """Write entries as CSV (RFC 4180); one line without a severity where nothing was identified.

    Returns with a row of column names; a missing number is an empty cell. A text that a spreadsheet
    would take for a formula begins with an apostrophe.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerow(HISTORY_COLUMNS)
    for row in _rows(entries):
        writer.writerow(_cell(value) for value in row)
    return out.getvalue()


def history_parquet(entries: Sequence[Entry]) -> bytes:
    """Write entries as Parquet with the columns of the CSV file.

    ConfigurationError: pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: PLC0415 - optional, and slow
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError:
        raise ConfigurationError(
            f"history: Parquet needs pyarrow: {install_command('parquet')}"
        ) from None
    kinds = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64()}
    schema = pyarrow.schema([(name, kinds[kind]) for name, kind in HISTORY_COLUMNS.items()])
    rows = [dict(zip(HISTORY_COLUMNS, row, strict=True)) for row in _rows(entries)]
    out = io.BytesIO()
    parquet.write_table(pyarrow.Table.from_pylist(rows, schema=schema), out)
    return out.getvalue()


def _rows(entries: Sequence[Entry]) -> Iterator[tuple[Any, ...]]:
    for entry in entries:
        head = (
            entry.number, entry.when, entry.actuator, entry.serial, entry.usage.hours,
            entry.usage.cycles, entry.test, entry.verdict,
        )  # fmt: skip
        source = entry.sources[0] if entry.sources else None
        tail = (source and source.path, source and source.sha256, entry.withdrawn)
        for item in entry.severities:
            numbers = (item.estimate, item.std, *(item.interval95 or (None, None)))
            yield (*head, item.name, *numbers, int(item.at_bound), int(item.shown), *tail)
        if not entry.severities:
            yield (*head, *[None] * 7, *tail)


def _cell(value: Any) -> Any:
    if isinstance(value, str) and value.startswith(FORMULA_PREFIXES):
        return f"'{value}"
    return value


def entries_from_csv(text: str, name: str, severities: Sequence[str]) -> list[Entry]:
    """Read diagnoses of another system, in the columns of an exported CSV file.

    text: rows of one number, time, actuator and serial number are one diagnosis; name: of the file,
    for errors; severities: the known names. Returns entries that are not appended yet; withdrawn
    rows are left out. ConfigurationError: a column is missing, or a cell does not fit its column.
    """
    reader = csv.DictReader(io.StringIO(text, newline=""))
    missing = [item for item in NEEDED_COLUMNS if item not in (reader.fieldnames or ())]
    if missing:
        raise ConfigurationError(f"{name}: has no column {missing[0]}; see ehadiag history export")
    diagnoses: dict[tuple[str | int | None, ...], Entry] = {}
    try:
        for row in reader:
            if row.get("withdrawn"):
                continue
            entry = _entry_of(row, severities)
            key = (row.get("number"), entry.tested, entry.actuator, entry.serial)
            if (before := diagnoses.get(key)) is not None:
                both = before.severities + entry.severities
                if len({item.name for item in both}) < len(both):
                    raise ConfigurationError(f"severity {row['severity']}: twice in one diagnosis")
                entry = replace(before, severities=both)
            diagnoses[key] = entry
    except (csv.Error, ConfigurationError) as error:
        raise ConfigurationError(f"{name}, line {reader.line_num}: {error}") from None
    return list(diagnoses.values())


def _entry_of(row: dict[str, str], severities: Sequence[str]) -> Entry:
    if (short := next((name for name in NEEDED_COLUMNS if row[name] is None), None)) is not None:
        raise ConfigurationError(f"{short}: the row ends before it")
    verdict = _text(row["verdict"])
    if verdict not in KNOWN_VERDICTS:
        raise ConfigurationError(f"verdict: there is {', '.join(KNOWN_VERDICTS)}")
    if not (actuator := _text(row["actuator"])).strip():
        raise ConfigurationError("actuator: is empty")
    found = [_severity_of(row, severities)] if row["severity"] else []
    path, sha256 = _text(row.get("recording") or ""), row.get("sha256") or None
    origin = {"schema": IMPORT_SCHEMA, "number": row.get("number")}
    return Entry(
        appended=current_utc_text(),
        tested=_time(row["when"]),
        actuator=actuator,
        serial=_serial(row["serial"]),
        test=_text(row.get("test") or "") or None,
        verdict=verdict,
        reasons=(),
        usage=Usage(_number(row, "hours"), _number(row, "cycles")),
        sources=(SourceRecord(path, sha256, None),) if path else (),
        severities=tuple(found),
        covariance=None,
        effects=(),
        version="",
        simulated=False,
        result=json.dumps(origin),
    )


def _severity_of(row: dict[str, str], severities: Sequence[str]) -> Severity:
    if row["severity"] not in severities:
        raise ConfigurationError(f"severity {row['severity']}: there is {', '.join(severities)}")
    estimate, std = _number(row, "estimate"), _number(row, "std")
    low, high = _number(row, "low95"), _number(row, "high95")
    if estimate is not None and std is not None and None in (low, high):
        low, high = estimate - NORMAL_HALF_WIDTH_95 * std, estimate + NORMAL_HALF_WIDTH_95 * std
    return Severity(
        name=row["severity"],
        estimate=estimate,
        std=std,
        interval95=None if low is None or high is None else (low, high),
        flags=(AT_BOUND,) * (row.get("at_bound") == "1")
        + (NOT_SHOWN,) * (row.get("shown", "1") == "0"),
    )


def _number(row: dict[str, str], name: str) -> float | None:
    if not (text := row.get(name)):
        return None
    low, high = COLUMN_RANGES[name]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise ConfigurationError(f"{name} {text}: need a number, {low:g} … {high:g}")
    return value


def _serial(text: str) -> int:
    number = int(text) if text.isascii() and text.isdecimal() and len(text) < 20 else -1
    if not 0 <= number <= MAX_HISTORY_SERIAL:
        raise ConfigurationError(f"serial {text}: need a whole number, 0 … {MAX_HISTORY_SERIAL}")
    return number


def _time(text: str) -> str:
    try:
        when = utc_time_text(text)
    except (ValueError, OverflowError):
        raise ConfigurationError(f"when {text}: need ISO 8601, such as 2026-03-01T12:00") from None
    if when > current_utc_text():
        raise ConfigurationError(f"when {text}: is in the future")
    return when


def _text(text: str) -> str:
    """Text of a cell, without the apostrophe that an export puts before a formula."""
    plain = text[1:] if text.startswith("'") and text[1:].startswith(FORMULA_PREFIXES) else text
    return valid_text(plain)
