"""Reads what a computer that identifies by itself says it has found (BUS-17, BUS-18)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ehadiag.core.recording import OnboardResult, OnboardState
from firmware_iface.codec.live_decode import checked_values
from firmware_iface.codec.validity import rows_of
from firmware_iface.mapping.bus_map import SEVERITIES, BusMap
from firmware_iface.transport.frames import Frame, FrameTable

__all__ = ["OnboardReader", "onboard_results"]

AT_IT = (OnboardState.RECORDING, OnboardState.IDENTIFYING)


class OnboardReader:
    """Puts a result together of its messages, in order of arrival.

    The severities count that come while the computer says that it is done.

    Parameters
    ----------
    bus_map : BusMap
        Which message and signal plays which role.

    Attributes
    ----------
    result : OnboardResult | None
        The last whole result; None when a later test has begun.
    """

    result: OnboardResult | None

    def __init__(self, bus_map: BusMap) -> None:
        self._messages = {(item.can_id, item.extended): item for item in bus_map.onboard}
        self._state: int | None = None
        self._said: dict[str, float] = {}
        self._heard: dict[str, float] = {}
        self.result = None

    @property
    def awaited(self) -> bool:
        """Whether the computer is about to find something, or has and not yet said all of it."""
        return self._state in AT_IT or (self._state == OnboardState.DONE and self.result is None)

    def of_test(self, test_id: int | None) -> OnboardResult | None:
        """Return the result if it can be that of a test; None: the number is not known."""
        found = self.result
        return found if found is not None and found.is_of(test_id) else None

    def take(self, frame: Frame) -> None:
        """Take any frame."""
        if not (frame.error or frame.remote):
            self.hear(frame.can_id, frame.extended, frame.data)

    def hear(self, can_id: int, extended: bool, data: bytes) -> None:
        """Take the payload of a data frame."""
        message = self._messages.get((can_id, extended))
        values = None if message is None else checked_values(message, data)
        if values is not None:
            self._hear({name.removeprefix("onboard."): value for name, value in values.items()})

    def _hear(self, values: Mapping[str, float]) -> None:
        if "state" in values:
            self._state = round(values["state"])
            if values != self._said:
                self._heard, self.result, self._said = {}, None, dict(values)
        if self._state != OnboardState.DONE:
            return
        self._heard |= values
        if self.result is None and all(
            name in self._heard for key in SEVERITIES for name in (key, f"std_{key}")
        ):
            self.result = OnboardResult(
                test_id=self._number("test_id"),
                verdict=self._number("verdict"),
                runs=self._number("runs"),
                severities={key: self._heard[key] for key in SEVERITIES},
                std={key: self._heard[f"std_{key}"] for key in SEVERITIES},
            )

    def _number(self, key: str) -> int | None:
        return round(self._heard[key]) if key in self._heard else None


def onboard_results(table: FrameTable, bus_map: BusMap) -> list[tuple[int, OnboardResult]]:
    """Find all results in a frame table.

    Parameters
    ----------
    table : FrameTable
        Frames in order of arrival.
    bus_map : BusMap
        What they mean.

    Returns
    -------
    list[tuple[int, OnboardResult]]
        The row at which each was whole, ascending, and the result.
    """
    rows = [rows_of(table, message) for message in bus_map.onboard]
    reader, found = OnboardReader(bus_map), []
    before = None
    for row in np.sort(np.concatenate(rows)).tolist() if rows else ():
        if bus_map.channel is not None and table.channel[row] not in (0, bus_map.channel):
            continue
        payload = table.data[row, : table.length[row]].tobytes()
        reader.hear(int(table.can_id[row]), bool(table.extended[row]), payload)
        if reader.result is not before:
            before = reader.result
            if before is not None:
                found.append((row, before))
    return found
