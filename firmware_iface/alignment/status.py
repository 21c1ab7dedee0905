"""What the flight-control computer says of a built-in test: status columns, its own findings."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec
import numpy as np
from msgspec.structs import replace

from firmware_iface.alignment.ticks import TickAxis
from firmware_iface.bus_map import ONBOARD_SEVERITIES, BusMap
from firmware_iface.codec import Decoded, DecodedTable
from firmware_iface.live_decode import checked_values
from firmware_iface.protection import rows_of
from firmware_iface.recording import BitState, FloatArray, IntArray, OnboardResult, OnboardState
from firmware_iface.transport.frames import Frame, FrameTable

MAX_HOLE_TICKS = 3
"""Ticks without a frame up to which the next frame still tells the present tick."""


class StatusTable(msgspec.Struct, frozen=True, eq=False):
    """Status frames as columns, shape (n,); NaN or -1 where the bus does not say."""

    row: IntArray
    """Row of the frame table."""
    state: IntArray
    """BitState, -1 unknown."""
    reason: IntArray
    """Numbers, -1 unknown."""
    test_id: IntArray
    serial: IntArray
    elapsed: FloatArray
    """Ticks, NaN unknown."""
    following: IntArray
    """Tick of the next telemetry or command frame."""

    @property
    def start(self) -> FloatArray:
        """First tick of the test that each frame implies."""
        return self.following - self.elapsed


def read_status(decoded: DecodedTable, axis: TickAxis | None, bus_map: BusMap) -> StatusTable:
    """Collect the status frames; the message that carries the state leads."""
    lead = bus_map.find("status.state") or bus_map.find("status.elapsed")
    if lead is None:
        return _status_of(None, axis, bus_map)
    return _status_of(decoded.messages[lead[0].name], axis, bus_map)


def _status_of(item: Decoded | None, axis: TickAxis | None, bus_map: BusMap) -> StatusTable:
    count = 0 if item is None else len(item.row)

    def column(key: str) -> FloatArray:
        if item is None or f"status.{key}" not in item.values:
            return np.full(count, np.nan)
        return item.values[f"status.{key}"]

    def numbers(key: str) -> IntArray:
        return np.nan_to_num(column(key), nan=-1.0).astype(np.int64)

    raw = numbers("state")
    state = np.full(count, -1, dtype=np.int64)
    for number, meaning in bus_map.states.items():
        state[raw == number] = int(meaning)
    row = np.empty(0, dtype=np.int64) if item is None else item.row
    following = np.zeros(count, dtype=np.int64)
    if axis is not None and item is not None:
        following = _next_tick(axis, item, bus_map.tick_ns)
    return StatusTable(
        row=row,
        state=state,
        reason=numbers("reason"),
        test_id=numbers("test_id"),
        serial=numbers("serial"),
        elapsed=np.rint(column("elapsed") * 1e9 / bus_map.tick_ns),
        following=following,
    )


def _next_tick(axis: TickAxis, item: Decoded, tick_ns: int) -> IntArray:
    """Tick that begins after each status frame; by time where the frames around it are missing."""
    fraction, following = axis.at(item.row, item.time_ns, tick_ns)
    after = np.searchsorted(axis.row, item.row)
    before = np.maximum(after - 1, 0)
    hole = np.abs(following - axis.tick[before]) > MAX_HOLE_TICKS
    wait = axis.time_ns[np.minimum(after, len(axis.row) - 1)] - item.time_ns
    by_time = np.ceil(fraction).astype(np.int64)
    return np.where(
        hole & (after > 0) & (np.abs(wait) > MAX_HOLE_TICKS * tick_ns), by_time, following
    )


def resolve_turns(axis: TickAxis, status: StatusTable) -> TickAxis:
    """Take back counter turns that the elapsed time of a running test contradicts.

    Host time chooses the turns that a gap hides; a host clock that steps by nearly whole turns
    looks like a gap. The computer's own elapsed time tells them apart.
    """
    running = np.flatnonzero((status.state == BitState.RUNNING) & np.isfinite(status.elapsed))
    start, elapsed = status.start[running], status.elapsed[running]
    offset = np.diff(start)
    turns = np.rint(offset / max(axis.turn, 1))
    wrong = (turns != 0) & (np.abs(offset - axis.turn * turns) <= MAX_HOLE_TICKS)
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


BUSY_ONBOARD_STATES = (OnboardState.RECORDING, OnboardState.IDENTIFYING)


class OnboardReader:
    """Puts a result together of its messages, in order of arrival.

    The severities count that come while the computer says that it is done.

    result: the last whole result; None when a later test has begun.
    """

    result: OnboardResult | None

    def __init__(self, bus_map: BusMap) -> None:
        self._messages = {(item.can_id, item.extended): item for item in bus_map.onboard}
        self._state: int | None = None
        self._progress: dict[str, float] = {}
        self._values: dict[str, float] = {}
        self.result = None

    @property
    def awaited(self) -> bool:
        """Whether the computer is about to find something, or has and not yet said all of it."""
        return self._state in BUSY_ONBOARD_STATES or (
            self._state == OnboardState.DONE and self.result is None
        )

    def of_test(self, test_id: int | None) -> OnboardResult | None:
        """Return the result if it can be that of a test; None: the number is not known."""
        found = self.result
        return found if found is not None and found.is_of(test_id) else None

    def take(self, frame: Frame) -> None:
        """Take any frame."""
        if not (frame.error or frame.remote):
            self.take_payload(frame.can_id, frame.extended, frame.data)

    def take_payload(self, can_id: int, extended: bool, data: bytes) -> None:
        """Take the payload of a data frame."""
        message = self._messages.get((can_id, extended))
        values = None if message is None else checked_values(message, data)
        if values is not None:
            self._take_values(
                {name.removeprefix("onboard."): value for name, value in values.items()}
            )

    def _take_values(self, values: Mapping[str, float]) -> None:
        if "state" in values:
            self._state = round(values["state"])
            if values != self._progress:
                self._values, self.result, self._progress = {}, None, dict(values)
        if self._state != OnboardState.DONE:
            return
        self._values |= values
        if self.result is None and all(
            name in self._values for key in ONBOARD_SEVERITIES for name in (key, f"std_{key}")
        ):
            std = {key: self._values[f"std_{key}"] for key in ONBOARD_SEVERITIES}
            # A deviation of 0 says that the computer has no estimate.
            self.result = OnboardResult(
                test_id=self._number("test_id"),
                verdict=self._number("verdict"),
                runs=self._number("runs"),
                severities={k: self._values[k] if std[k] > 0.0 else math.nan for k in std},
                std={k: value if value > 0.0 else math.nan for k, value in std.items()},
            )

    def _number(self, key: str) -> int | None:
        return round(self._values[key]) if key in self._values else None


def onboard_results(table: FrameTable, bus_map: BusMap) -> list[tuple[int, OnboardResult]]:
    """Find all results in a frame table.

    table: frames in order of arrival; bus_map: what they mean. Returns the row at which each was
    whole, ascending, and the result.
    """
    rows = [rows_of(table, message) for message in bus_map.onboard]
    reader, found = OnboardReader(bus_map), []
    before = None
    for row in np.sort(np.concatenate(rows)).tolist() if rows else ():
        if bus_map.channel is not None and table.channel[row] not in (0, bus_map.channel):
            continue
        payload = table.data[row, : table.length[row]].tobytes()
        reader.take_payload(int(table.can_id[row]), bool(table.extended[row]), payload)
        if reader.result is not before:
            before = reader.result
            if before is not None:
                found.append((row, before))
    return found
