"""Which diagnoses of a history count: of each recording the last one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ehadiag.history.records import Entry, Source, Usage

__all__ = ["counted"]


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
    seen: set[str] = set()
    told: dict[str, Usage] = {}
    for entry in entries:
        for name in _recordings(entry):
            before = told.get(name, Usage())
            told[name] = _newer(entry.usage, before)
    out = []
    for entry in reversed(entries):
        names = _recordings(entry)
        if seen.intersection(names):
            continue
        seen.update(names)
        usage = entry.usage
        for name in names:
            usage = _newer(usage, told[name])
        out.append(replace(entry, usage=usage))
    return out[::-1]


def _newer(first: Usage, second: Usage) -> Usage:
    return Usage(
        second.hours if first.hours is None else first.hours,
        second.cycles if first.cycles is None else first.cycles,
    )


def _recordings(entry: Entry) -> list[str]:
    """Names by which recordings are the same; those without samples are never."""
    return [name for name in map(_same, entry.sources) if name]


def _same(source: Source) -> str:
    return source.samples or source.sha256 or ""
