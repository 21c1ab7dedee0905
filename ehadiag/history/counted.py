"""Which diagnoses of a history count: of each recording the last one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime

from ehadiag.history.records import Entry, Usage

__all__ = ["counted"]

NEAR_S = 2.0
"""Formats round dates."""
ZONE_S = 900.0
"""Time zones differ by multiples of it."""
DAY_S = 86400.0


@dataclass(frozen=True, slots=True)
class _Recording:
    """What tells a recording from others."""

    samples: str
    date: datetime | None

    def same(self, other: _Recording) -> bool:
        """Whether the samples are the same, and the dates may be."""
        if self.samples != other.samples:
            return False
        if self.date is None or other.date is None:
            return True
        apart = abs((self.date - other.date).total_seconds())
        off = apart % ZONE_S
        return apart < DAY_S + NEAR_S and min(off, ZONE_S - off) < NEAR_S


def counted(entries: Sequence[Entry]) -> list[Entry]:
    """Return the diagnoses that count, oldest first.

    A recording that was diagnosed again counts with its last diagnosis alone, also where this took
    several recordings together. Hours and cycles that only an earlier one was told are kept.

    Parameters
    ----------
    entries : Sequence[Entry]
        In the order in which they were appended.

    Returns
    -------
    list[Entry]
        A part of them, in the same order.
    """
    recordings = [_recordings(entry) for entry in entries]
    last: dict[str, list[tuple[_Recording, Usage]]] = {}
    usages: list[Usage] = []
    for entry, named in zip(entries, recordings, strict=True):
        usage = entry.usage
        for item in named:
            for before, told in reversed(last.get(item.samples, [])):
                if item.same(before):
                    usage = _newer(usage, told)
        usages.append(usage)
        for item in named:
            last.setdefault(item.samples, []).append((item, usage))
    seen: dict[str, list[_Recording]] = {}
    out = []
    for entry, named, usage in list(zip(entries, recordings, usages, strict=True))[::-1]:
        if any(item.same(other) for item in named for other in seen.get(item.samples, [])):
            continue
        for item in named:
            seen.setdefault(item.samples, []).append(item)
        out.append(replace(entry, usage=usage))
    return out[::-1]


def _newer(first: Usage, second: Usage) -> Usage:
    return Usage(
        second.hours if first.hours is None else first.hours,
        second.cycles if first.cycles is None else first.cycles,
    )


def _recordings(entry: Entry) -> list[_Recording]:
    """What tells them from others; those without samples are like none."""
    names = [item.samples or item.sha256 or "" for item in entry.sources]
    # The date of an entry is that of its first recording.
    date = None if entry.tested is None else datetime.fromisoformat(entry.tested)
    return [
        _Recording(name, date if place == 0 else None) for place, name in enumerate(names) if name
    ]
