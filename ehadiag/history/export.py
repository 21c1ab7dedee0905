"""The health history as CSV: one line for each severity of each diagnosis."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from ehadiag.history.records import Entry

__all__ = ["COLUMNS", "csv_of"]

COLUMNS = (
    "number", "when", "actuator", "serial", "hours", "cycles", "test", "verdict", "severity",
    "estimate", "std", "low95", "high95", "at_bound", "shown", "recording", "sha256", "withdrawn",
)  # fmt: skip
FORMULA = ("=", "+", "-", "@", "\t", "\r")


def csv_of(entries: Sequence[Entry]) -> str:
    """Write entries as CSV (RFC 4180); one line without a severity where nothing was identified.

    Parameters
    ----------
    entries : Sequence[Entry]
        What is written.

    Returns
    -------
    str
        With a head; empty cells where there is no number. A text that a spreadsheet would take for
        a formula begins with an apostrophe.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerow(COLUMNS)
    for entry in entries:
        head = (
            entry.number, entry.when, _text(entry.actuator), entry.serial, entry.usage.hours,
            entry.usage.cycles, _text(entry.test or ""), entry.verdict,
        )  # fmt: skip
        source = entry.sources[0] if entry.sources else None
        recording = (_text(source.path), source.sha256) if source else ("", "")
        tail = (*recording, _text(entry.withdrawn or ""))
        for item in entry.severities:
            numbers = (item.estimate, item.std, item.low, item.high)
            flags = (int(item.at_bound), int(item.shown))
            writer.writerow((*head, item.name, *numbers, *flags, *tail))
        if not entry.severities:
            writer.writerow((*head, *[""] * 7, *tail))
    return out.getvalue()


def _text(value: str) -> str:
    return f"'{value}" if value.startswith(FORMULA) else value
