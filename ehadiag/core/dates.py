"""Time stamps of recordings as text: a date where the stamp has one."""

from __future__ import annotations

from datetime import UTC, datetime

__all__ = ["date_text", "start_text", "utc_text"]

DATED_NS = 10**17
"""Stamps beyond are times of day, those before it seconds since a log without a date began."""


def date_text(time_ns: int | None) -> str | None:
    """Return date and time of day in UTC (ISO 8601, ms); None for a stamp without a date.

    Parameters
    ----------
    time_ns : int | None
        Nanoseconds since 1970, or since a log without a date began.

    Returns
    -------
    str | None
        Such as `2026-03-01T12:00:00.000Z`.
    """
    if time_ns is None or time_ns < DATED_NS:
        return None
    try:
        moment = datetime.fromtimestamp(time_ns / 1e9, UTC)
    except (OverflowError, ValueError, OSError):
        return None
    return utc_text(moment)


def utc_text(moment: datetime) -> str:
    """Write a moment in UTC (ISO 8601, ms): two of them compare as text.

    Parameters
    ----------
    moment : datetime
        With its time zone.

    Returns
    -------
    str
        Such as `2026-03-01T12:00:00.000Z`.
    """
    return moment.astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def start_text(time_ns: int | None) -> str | None:
    """As `date_text`, but seconds since the log began where it has no date."""
    if time_ns is None:
        return None
    return date_text(time_ns) or f"{time_ns * 1e-9:.3f} s"
