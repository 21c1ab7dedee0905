"""Conventions that all results share: dates, display units, configuration hash, alarm rate."""

from __future__ import annotations

import hashlib
import math
from datetime import UTC, datetime
from typing import Any, Final

import msgspec

__version__ = "0.2.0"
EXPONENT_NAME = "clogging_exponent"
FRICTION_NAME = "FSS"
"""Effect and severity that a recording shows by their ratio alone."""
MAX_RESULT_BYTES = 1 << 20
"""Size of the largest JSON result that is read, bytes."""
MAX_HISTORY_SERIAL = (1 << 63) - 1
"""Largest serial number that a history can hold, 1."""
PIPE_COLUMNS = 10_000
"""Columns of a table that no terminal bounds: its lines are not broken."""
SIGNAL_FILE_KINDS = ("mf4", "mcap")
"""Formats of files with recorded and modelled signals."""
SIGNAL_FILE_SUFFIXES = tuple(f".signals.{kind}" for kind in SIGNAL_FILE_KINDS)
"""What follows the name of a result in those of its signals."""


def date_text(time_ns: int | None) -> str | None:
    """Return date and time of day in UTC (ISO 8601, ms); None for a stamp without a date.

    time_ns: nanoseconds since 1970, or since a log without a date began. Returns such as
    `2026-03-01T12:00:00.000Z`.
    """
    # Smaller ones are seconds since a log without a date began.
    if time_ns is None or time_ns < 10**17:
        return None
    try:
        moment = datetime.fromtimestamp(time_ns / 1e9, UTC)
    except (OverflowError, ValueError, OSError):
        return None
    return utc_text(moment)


def utc_text(moment: datetime) -> str:
    """Write a moment in UTC (ISO 8601, ms): two of them compare as text.

    moment: with its time zone. Returns such as `2026-03-01T12:00:00.000Z`.
    """
    return moment.astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def utc_time_text(text: str) -> str:
    """Write a time of ISO 8601 in UTC; without a zone it is UTC already.

    text: such as `2026-03-01T13:00+01:00`. Returns as `utc_text`. ValueError: it is none.
    """
    moment = datetime.fromisoformat(text)
    try:
        return utc_text(moment if moment.tzinfo else moment.replace(tzinfo=UTC))
    except OverflowError:
        raise ValueError(text) from None


def start_text(time_ns: int | None) -> str | None:
    """As `date_text`, but seconds since the log began where it has no date."""
    if time_ns is None:
        return None
    return date_text(time_ns) or f"{time_ns * 1e-9:.3f} s"


DISPLAY_UNITS = {
    "A": (1e3, "mA"),
    "m": (1e6, "µm"),
    "s": (1e3, "ms"),
    "1": (1e2, "%"),
    "m/s": (1e3, "mm/s"),
    "N/m": (1e-3, "N/mm"),
    "N m/A": (1.0, "N mm/mA"),
    "Pa": (1e-6, "MPa"),
    "Pa/m": (1e-9, "MPa/mm"),
    "m³": (1e6, "cm³"),
    "m²/s": (60.0, "L/min/mm"),
}
"""Factor and unit by the SI unit; others are shown as they are."""
SMALL_PRESSURE_PA = 1e5
"""Pa, below which a pressure is read in kPa."""


def display_unit(unit: str, size: float) -> tuple[float, str]:
    """Return what turns a number in an SI unit into one for people, and the unit of that.

    unit: SI unit; `1` for a share; size: the number, or the largest of those that are to be shown
    together. Returns factor and unit.
    """
    if unit == "Pa" and abs(size) < SMALL_PRESSURE_PA:
        return 1e-3, "kPa"
    return DISPLAY_UNITS.get(unit, (1.0, unit))


def with_unit(value: float, unit: str) -> str:
    """Write a number with the unit that people read.

    value: in the SI unit; unit: SI unit; `1` for a share. Returns such as `0.4 mA`.
    """
    factor, name = display_unit(unit, value)
    return f"{factor * value:.4g} {name}"


def to_precision(std: float, *values: float) -> list[str]:
    """Write values to the second digit of their standard deviation, without powers of ten."""
    if not std > 0.0 or math.isinf(std):
        return [f"{value:.4g}" for value in values]
    digits = max(1 - math.floor(math.log10(std)), 0)
    return [f"{value:.{digits}f}" for value in values]


def fingerprint(content: Any) -> str:
    """Return the SHA-256 of a structure's content, 64 hexadecimal digits.

    content: an actuator, a stored test, the meaning of a bus: structures and data classes of plain
    values. Two files that say the same have the same hash. Returns hash of the content as JSON with
    sorted keys.
    """
    plain = msgspec.to_builtins(content, str_keys=True)
    if isinstance(plain, dict):
        plain.pop("advice", None)  # words for people change no diagnosis
    return hashlib.sha256(msgspec.json.encode(plain, order="deterministic")).hexdigest()


LEAST_MONITORED: Final = 0.5
"""Share of the ticks below which too little was monitored, 1: what is left is no majority."""
FALSE_ALARM_INTERVAL_H: Final = 100.0
"""Mean time between false alarms of a monitor as a whole, h."""


def finite(value: float | None) -> float | None:
    """Return a number as results hold it: None for NaN and the infinite."""
    return None if value is None or not math.isfinite(value) else float(value)


def shown_date(date: str) -> str:
    """Return a date of a result, UTC and ISO 8601, as people read it."""
    return f"{date[:10]} {date[11:16]} UTC"
