"""Reads the tests of a log: all of them, or the one to be diagnosed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from ehadiag.core.errors import InputOutputError
from ehadiag.core.find_test import Sought
from ehadiag.core.recording import BitState, Recording
from firmware_iface.alignment.windows import recordings_of
from firmware_iface.logs.blocks import SUFFIXES, LogReader
from firmware_iface.logs.budget import Budget
from firmware_iface.mapping.bus_map import BusMap, default_map
from firmware_iface.transport.frames import FrameTable, concatenate

__all__ = [
    "SUFFIXES",
    "choose",
    "describe",
    "iterate_recordings",
    "read_frames",
    "read_recording",
    "read_recordings",
]

MOST_NAMED = 3
"""Tests passed over that are told one by one."""


def iterate_recordings(
    path: Path | str,
    bus_map: BusMap | None = None,
    budget: Budget | None = None,
    sought: Sought | None = None,
) -> Iterator[Recording]:
    """Read a log and give its tests in order of time, each as soon as it is complete.

    Memory is that of the longest test, whatever the length of the log. A log without a test gives
    one recording without samples.

    Parameters
    ----------
    path : Path | str
        File to read.
    bus_map : BusMap | None
        Which message and signal plays which role.
    budget : Budget | None
        Bytes, frames and seconds that reading may cost; None: the default.
    sought : Sought | None
        What to look for where the bus does not say when which test ran.

    Yields
    ------
    Recording
        Each test as soon as it is complete.

    Raises
    ------
    InputOutputError
        The file is missing, unreadable, not what its suffix says, or beyond its budget.
    ConfigurationError
        Unknown kind of log.
    """
    budget = budget or Budget()
    reader = LogReader(path, budget)
    tests = recordings_of(reader, bus_map or default_map(), str(path), budget.held, sought=sought)
    for recording in tests:
        yield _with_notes(recording, reader.notes)


def read_recordings(
    path: Path | str,
    bus_map: BusMap | None = None,
    budget: Budget | None = None,
    sought: Sought | None = None,
) -> tuple[Recording, ...]:
    """Read all tests in a log, in order of time; see `iterate_recordings`."""
    return tuple(iterate_recordings(path, bus_map, budget, sought))


def read_recording(
    path: Path | str,
    bus_map: BusMap | None = None,
    budget: Budget | None = None,
    sought: Sought | None = None,
) -> Recording:
    """Read the last complete test of a log; the last one begun if none was completed.

    Its notes say what was passed over. Where tests lie on several adapter channels and none was
    chosen, it is refused.
    """
    return choose(iterate_recordings(path, bus_map, budget, sought))


def choose(recordings: Iterable[Recording]) -> Recording:
    """Return the last complete test, or the last with samples, or the last.

    Its notes name the other tests. Only the best so far is held.

    Parameters
    ----------
    recordings : Iterable[Recording]
        Tests of one log, in order of time.

    Returns
    -------
    Recording
        The chosen one, with notes on the others.

    Raises
    ------
    ValueError
        No recording at all.
    """
    best: Recording | None = None
    place, count = 0, 0
    others: list[str] = []
    channels: set[int] = set()
    for count, item in enumerate(recordings, start=1):
        others.append(describe(item, count))
        if item.samples is not None and item.channel:
            channels.add(item.channel)
        if best is None or _worth(item) >= _worth(best):
            best, place = item, count
    if best is None:
        raise ValueError("no recording to choose from")
    del others[place - 1]
    notes = tuple(f"passed over: {item}" for item in others[-MOST_NAMED:])
    if len(others) > MOST_NAMED:
        notes = (f"{len(others) - MOST_NAMED} earlier tests of the recording passed over", *notes)
    best = _with_notes(best, notes)
    return _refused(best, sorted(channels)) if len(channels) > 1 else best


def _worth(item: Recording) -> int:
    if item.samples is None:
        return 0
    return 2 if item.outcome.state is BitState.COMPLETE else 1


def _with_notes(item: Recording, notes: tuple[str, ...]) -> Recording:
    if not notes:
        return item
    return replace(item, quality=replace(item.quality, notes=(*item.quality.notes, *notes)))


def _refused(item: Recording, channels: Sequence[int]) -> Recording:
    listed = ", ".join(map(str, channels))
    why = f"tests on the adapter channels {listed}: choose the actuator's by --log-channel"
    return replace(item, quality=replace(item.quality, refused=(*item.quality.refused, why)))


def describe(item: Recording, number: int) -> str:
    """A test of a log in one clause: number, length, outcome, serial number, channel."""
    state = item.outcome.state
    how = "how it ended is not said" if state is None else state.name.lower().replace("_", " ")
    if state is BitState.RUNNING:
        how = "without the word of its end"
    test = "unnamed" if item.test_id is None else str(item.test_id)
    length = "" if item.samples is None else f", {item.duration:.3f} s"
    serial = "" if item.serial is None else f", serial {item.serial}"
    channel = f", channel {item.channel}" if item.channel else ""
    return f"test {test} (no. {number} of the recording{length}{serial}{channel}): {how}"


def read_frames(path: Path | str, budget: Budget | None = None) -> FrameTable:
    """Read all frames of a log at once; a log that breaks off is read up to the break.

    Parameters
    ----------
    path : Path | str
        File to read.
    budget : Budget | None
        Bytes, frames and seconds that reading may cost; None: the default.

    Returns
    -------
    FrameTable
        The frames in columns, in order of arrival.

    Raises
    ------
    InputOutputError, ConfigurationError
        See `LogReader`; also where there are more frames than the budget allows to hold at
        once.
    """
    budget = budget or Budget()
    tables: list[FrameTable] = []
    count = 0
    for table in LogReader(path, budget):
        tables.append(table)
        count += len(table)
        if count > budget.held:
            raise InputOutputError(
                f"log {path}: more than {budget.held} frames, too many to hold at once; cut it"
            )
    return concatenate(tables)
