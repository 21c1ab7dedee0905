"""Cuts a long stream of frames into windows of whole tests, so that memory stays constant."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.find_test import Sought
from ehadiag.core.recording import BitState, Recording
from firmware_iface.alignment.align import assemble
from firmware_iface.codec.channel import channels_in
from firmware_iface.codec.decode import decode
from firmware_iface.codec.validity import rows_of
from firmware_iface.mapping.bus_map import BusMap
from firmware_iface.transport.frames import FrameTable, concatenate

__all__ = ["recordings_of"]

WINDOW = 200_000
"""Frames from which on a window is closed where no test runs: two minutes of the default bus."""
QUIET = 1000
"""Frames in a row that tell of no test, half a second or less: a window may end in their midst."""
ACTIVE = (BitState.ARMING, BitState.RUNNING)


def recordings_of(
    tables: Iterable[FrameTable],
    bus_map: BusMap,
    source: str,
    held: int,
    least: int = WINDOW,
    sought: Sought | None = None,
) -> Iterator[Recording]:
    """Tests of a stream of frames in order of time; one recording without samples if there is none.

    Parameters
    ----------
    tables : Iterable[FrameTable]
        Blocks of frames in order of arrival.
    bus_map : BusMap
        What they mean.
    source : str
        File or bus, for reports.
    held : int
        Frames that a window may have at most; a test beyond that is cut, and said to be.
    least : int
        Frames from which on a window is closed where no test runs.
    sought : Sought | None
        What to look for where the bus does not say when which test ran.

    Yields
    ------
    Recording
        Each test as soon as it is complete.
    """
    reading = _Reading(bus_map, source, sought)
    empty: Recording | None = None
    found = False
    for window, cut in _windows(tables, reading, held, least):
        for recording in reading.recordings(window, cut):
            if recording.samples is not None or recording.test_id is not None:
                found = True
                yield recording
            elif empty is None or _says_more(recording, empty):
                empty = recording
    if not found and empty is not None:
        yield empty


def _says_more(new: Recording, old: Recording) -> bool:
    return new.outcome.state is not None or old.outcome.state is None


def _windows(
    tables: Iterable[FrameTable], reading: _Reading, held: int, least: int
) -> Iterator[tuple[FrameTable, bool]]:
    """Windows, and whether one was cut for its length."""
    pending: list[FrameTable] = []
    size, look_at = 0, least
    for table in tables:
        pending.append(table)
        size += len(table)
        if size < look_at:
            continue
        window = concatenate(pending)
        end = reading.quiet_row(window)
        if end:
            yield window.rows(slice(0, end)), False
            pending, size, look_at = [window.rows(slice(end, None))], size - end, least
        elif size >= held:
            yield window, True
            pending, size, look_at = [], 0, least
        else:
            pending, look_at = [window], min(2 * size, held)
    if size:
        yield concatenate(pending), False


class _Reading:
    """What is known of a recording from the windows read so far."""

    def __init__(self, bus_map: BusMap, source: str, sought: Sought | None = None) -> None:
        self._map = bus_map
        self._sought = sought
        self._source = source
        self._told = False
        self._channels: frozenset[int] = frozenset()
        telling = ("command.test_id", "status.state")
        messages = {
            name: replace(item, roles=tuple(role for role in item.roles if role.name in telling))
            for name, item in bus_map.messages.items()
        }
        self._telling = replace(
            bus_map, messages={name: item for name, item in messages.items() if item.roles}
        )

    def recordings(self, window: FrameTable, cut: bool) -> tuple[Recording, ...]:
        """Tests of a window."""
        self._channels |= channels_in(window, self._map)
        notes = (f"cut off at {len(window)} frames, the most that are held at once",) if cut else ()
        return assemble(
            window,
            self._map,
            self._source,
            notes,
            channels=self._channels,
            unsaid_is_test=not self._told,
            sought=self._sought,
        )

    def quiet_row(self, window: FrameTable) -> int:
        """Row at which a window may end: amidst the longest stretch of its second half without a
        test, or where only foreign frames came; 0 if there is none."""
        told = self._rows_of_a_test(window)
        half = len(window) // 2
        told = told[told >= half]
        edges = np.concatenate(([half], told, [len(window)]))
        quiet = np.diff(edges)
        longest = int(quiet.argmax())
        if quiet[longest] < QUIET:
            return 0
        return int(edges[longest] + quiet[longest] // 2)

    def _rows_of_a_test(self, window: FrameTable) -> NDArray[np.int64]:
        decoded = decode(window, self._telling)
        rows: list[NDArray[np.int64]] = []
        for item in decoded.messages.values():
            self._told |= len(item.row) > 0
            for role, value in item.values.items():
                if role == "command.test_id":
                    rows.append(item.row[value > 0])
                else:
                    active = [key for key, state in self._map.states.items() if state in ACTIVE]
                    rows.append(item.row[np.isin(value, active)])
        if not self._told:
            # Without commands and status all that is recorded is one test.
            measured = (item for item in self._map.messages.values() if item.measures)
            rows += [rows_of(window, item) for item in measured]
        return np.sort(np.concatenate(rows)) if rows else np.empty(0, dtype=np.int64)
