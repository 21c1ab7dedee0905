"""Reads the status frames of the built-in test into columns."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.recording import BitState
from firmware_iface.alignment.ticks import TickAxis
from firmware_iface.codec.decode import Decoded, DecodedTable
from firmware_iface.mapping.bus_map import BusMap

__all__ = ["Status", "read_status", "resolve_turns"]

HOLE = 3
"""Ticks without a frame up to which the next frame still tells the present tick."""


@dataclass(frozen=True, slots=True, eq=False)
class Status:
    """Status frames as columns, shape (n,); NaN or -1 where the bus does not say.

    Attributes
    ----------
    row : NDArray[np.int64]
        Row of the frame table.
    state : NDArray[np.int64]
        BitState, -1 unknown.
    reason : NDArray[np.int64]
        Numbers, -1 unknown.
    test_id : NDArray[np.int64]
        See `reason`.
    serial : NDArray[np.int64]
        See `reason`.
    elapsed : NDArray[np.float64]
        Ticks, NaN unknown.
    following : NDArray[np.int64]
        Tick of the next telemetry or command frame.
    """

    row: NDArray[np.int64]
    state: NDArray[np.int64]
    reason: NDArray[np.int64]
    test_id: NDArray[np.int64]
    serial: NDArray[np.int64]
    elapsed: NDArray[np.float64]
    following: NDArray[np.int64]

    @property
    def start(self) -> NDArray[np.float64]:
        """First tick of the test that each frame implies."""
        return self.following - self.elapsed


def read_status(decoded: DecodedTable, axis: TickAxis | None, bus_map: BusMap) -> Status:
    """Collect the status frames; the message that carries the state leads."""
    lead = bus_map.find("status.state") or bus_map.find("status.elapsed")
    if lead is None:
        return _status_of(None, axis, bus_map)
    return _status_of(decoded.messages[lead[0].name], axis, bus_map)


def _status_of(item: Decoded | None, axis: TickAxis | None, bus_map: BusMap) -> Status:
    count = 0 if item is None else len(item.row)

    def column(key: str) -> NDArray[np.float64]:
        if item is None or f"status.{key}" not in item.values:
            return np.full(count, np.nan)
        return item.values[f"status.{key}"]

    def numbers(key: str) -> NDArray[np.int64]:
        return np.nan_to_num(column(key), nan=-1.0).astype(np.int64)

    raw = numbers("state")
    state = np.full(count, -1, dtype=np.int64)
    for number, meaning in bus_map.states.items():
        state[raw == number] = int(meaning)
    row = np.empty(0, dtype=np.int64) if item is None else item.row
    following = np.zeros(count, dtype=np.int64)
    if axis is not None and item is not None:
        following = _next_tick(axis, item, bus_map.tick_ns)
    return Status(
        row=row,
        state=state,
        reason=numbers("reason"),
        test_id=numbers("test_id"),
        serial=numbers("serial"),
        elapsed=np.rint(column("elapsed") * 1e9 / bus_map.tick_ns),
        following=following,
    )


def _next_tick(axis: TickAxis, item: Decoded, tick_ns: int) -> NDArray[np.int64]:
    """Tick that begins after each status frame; by time where the frames around it are missing."""
    fraction, following = axis.at(item.row, item.time_ns, tick_ns)
    after = np.searchsorted(axis.row, item.row)
    before = np.maximum(after - 1, 0)
    hole = np.abs(following - axis.tick[before]) > HOLE
    wait = axis.time_ns[np.minimum(after, len(axis.row) - 1)] - item.time_ns
    by_time = np.ceil(fraction).astype(np.int64)
    return np.where(hole & (after > 0) & (np.abs(wait) > HOLE * tick_ns), by_time, following)


def resolve_turns(axis: TickAxis, status: Status) -> TickAxis:
    """Take back counter turns that the elapsed time of a running test contradicts.

    Host time chooses the turns that a gap hides; a host clock that steps by nearly whole turns
    looks like a gap. The computer's own elapsed time tells them apart.
    """
    running = np.flatnonzero((status.state == BitState.RUNNING) & np.isfinite(status.elapsed))
    start, elapsed = status.start[running], status.elapsed[running]
    offset = np.diff(start)
    turns = np.rint(offset / max(axis.turn, 1))
    wrong = (turns != 0) & (np.abs(offset - axis.turn * turns) <= HOLE)
    wrong &= (np.diff(elapsed) >= 0) & (np.diff(status.test_id[running]) == 0)
    if not axis.turn or not wrong.any():
        return axis
    tick = axis.tick.copy()
    shift_from: list[tuple[int, int]] = []
    for index in np.flatnonzero(wrong):
        low, high = np.searchsorted(axis.row, status.row[running[index : index + 2]])
        low = max(int(low), 1)
        if high < low:
            continue
        jumps = np.diff(axis.tick[low - 1 : high + 1])
        if len(jumps):
            place = low + int(np.argmax(np.abs(jumps)))
            shift_from.append((int(axis.row[place]), int(turns[index]) * axis.turn))
    ticks = dict(axis.ticks)
    for row, shift in shift_from:
        tick[axis.row >= row] -= shift
        ticks = {
            name: np.where(axis.rows[name] >= row, values - shift, values)
            for name, values in ticks.items()
        }
    note = "the computer's elapsed time took back a gap that the host clock suggested"
    return replace(axis, tick=tick, ticks=ticks, notes=(*axis.notes, note))
