"""The health history as a table with one row for each severity: CSV, Parquet, and CSV read in."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator, Sequence
from typing import Any

from msgspec.structs import replace

from ehadiag.core.conventions import MAX_HISTORY_SERIAL, utc_time_text
from ehadiag.core.criteria import NORMAL_HALF_WIDTH_95
from ehadiag.estimate import AT_BOUND, NOT_SHOWN, Severity
from ehadiag.history.records import Entry, SourceRecord, Usage, current_utc_text
from firmware_iface.errors import ConfigurationError, install_command, valid_text

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
