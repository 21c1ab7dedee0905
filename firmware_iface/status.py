"""Status frames of the built-in test as columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.busmap import BusMap
from firmware_iface.decode import Decoded, DecodedTable
from firmware_iface.ticks import TickAxis

__all__ = ["Status", "read_status"]


@dataclass(frozen=True, slots=True, eq=False)
class Status:
    """Status frames as columns, shape (n,); NaN or -1 where the bus does not say.

    Attributes
    ----------
    row: row of the frame table.
    state: BitState, -1 unknown.
    reason, test_id, serial: numbers, -1 unknown.
    elapsed: ticks, NaN unknown.
    following: tick of the next telemetry or command frame.
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
    before = axis.tick[np.maximum(np.searchsorted(axis.row, item.row) - 1, 0)]
    by_time = np.ceil(fraction).astype(np.int64)
    hole = (following - before > 3) | (following <= before - 3)
    return np.where(hole & (item.row > axis.row[0]), by_time, following)
