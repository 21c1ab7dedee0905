"""Decodes frames in bulk into SI values: one set of columns for each message."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.channels import Stated, near_ends
from firmware_iface.codec.validity import rows_of, sound_rows
from firmware_iface.mapping.bus_map import BusMap, MessageMap, Role
from firmware_iface.mapping.signal_layout import SignalLayout
from firmware_iface.transport.frames import FrameTable

__all__ = ["Decoded", "DecodedTable", "decode", "raw_ends", "value_ends"]

Rows = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Decoded:
    """The frames of one message; n of them passed the checks.

    Attributes
    ----------
    message : MessageMap
        What it is.
    received : Rows
        Rows of the table with its identifier, good or bad.
    crc_bad : Rows
        Rows that failed a check.
    length_bad : Rows
        See `crc_bad`.
    range_bad : Rows
        See `crc_bad`.
    row : Rows
        Rows that passed length and check sum, shape (n,), ascending.
    data : NDArray[np.uint8]
        Their payloads, shape (n, width).
    time_ns : NDArray[np.int64]
        Host time, shape (n,).
    counter : NDArray[np.int64] | None
        Counter values, shape (n,); None without a counter.
    values : Mapping[str, NDArray[np.float64]]
        SI value per role, shape (n,); NaN where a multiplexed signal is absent or its value
        lies outside the range of the DBC.
    saturated : Mapping[str, NDArray[np.bool_]]
        Per channel role, value at an end of its range, shape (n,).
    stream : NDArray[np.int64]
        Which set of multiplexed signals the frame carries, shape (n,); 0 without multiplexers.
    """

    message: MessageMap
    received: Rows
    crc_bad: Rows
    length_bad: Rows
    range_bad: Rows
    row: Rows
    data: NDArray[np.uint8]
    time_ns: NDArray[np.int64]
    counter: NDArray[np.int64] | None
    values: Mapping[str, NDArray[np.float64]]
    saturated: Mapping[str, NDArray[np.bool_]]
    stream: NDArray[np.int64]

    def without(self, dropped: NDArray[np.bool_]) -> Decoded:
        """The same with some of the frames that passed left out after all; shape (n,)."""
        keep = ~dropped
        return replace(
            self,
            row=self.row[keep],
            data=self.data[keep],
            time_ns=self.time_ns[keep],
            counter=None if self.counter is None else self.counter[keep],
            values={name: value[keep] for name, value in self.values.items()},
            saturated={name: value[keep] for name, value in self.saturated.items()},
            stream=self.stream[keep],
        )


@dataclass(frozen=True, slots=True, eq=False)
class DecodedTable:
    """All messages of a frame table; rows of frames that belong to none, and of error frames."""

    messages: Mapping[str, Decoded]
    foreign: Rows
    errors: Rows


def decode(table: FrameTable, bus_map: BusMap) -> DecodedTable:
    """Check and decode all frames of the mapped messages on the actuator's channel."""
    foreign = ~(table.error | table.remote)
    messages = {}
    for message in bus_map.messages.values():
        mine = rows_of(table, message)
        if bus_map.channel is not None:
            channel = table.channel[mine]
            mine = mine[(channel == bus_map.channel) | (channel == 0)]
        foreign[mine] = False
        messages[message.name] = _decode_message(
            table,
            mine,
            message,
            bus_map.policy.crc == "flag",
            bus_map.policy.range == "flag",
        )
    for message in bus_map.onboard:
        foreign[rows_of(table, message)] = False
    return DecodedTable(messages, np.flatnonzero(foreign), np.flatnonzero(table.error))


def _decode_message(
    table: FrameTable, received: Rows, message: MessageMap, keep_bad_crc: bool, keep_range: bool
) -> Decoded:
    row, data, length_bad, crc_bad = sound_rows(
        table, received, message, keep_bad_sums=keep_bad_crc
    )
    values, saturated = {}, {}
    outside = np.zeros(len(row), dtype=np.bool_)
    stream = np.zeros(len(row), dtype=np.int64)
    streams: dict[tuple[tuple[str, frozenset[int]], ...], int] = {}
    for role in message.roles:
        physical = role.signal.physical(data)
        present = role.signal.present(data)
        wrong = _outside(physical, role.signal)
        if wrong is not None:
            outside |= wrong if present is None else wrong & present
        if role.name.startswith("channels."):
            saturated[role.name] = _at_end(physical, role.signal)
        value = _to_si(physical, role)
        if isinstance(role.stated, Stated):
            saturated[role.name] |= _at_stated_end(value, role, role.stated)
        if wrong is not None and not keep_range:
            value[wrong] = np.nan
        if present is not None:
            value[~present] = np.nan
            key = tuple((item.name, chosen) for item, chosen in role.signal.selectors)
            stream[present] |= 1 << streams.setdefault(key, len(streams))
        values[role.name] = value
    return Decoded(
        message=message,
        received=received,
        crc_bad=crc_bad,
        length_bad=length_bad,
        range_bad=row[outside],
        row=row,
        data=data,
        time_ns=table.time_ns[row],
        counter=_integers(message.counter, data),
        values=values,
        saturated=saturated,
        stream=stream,
    )


def _integers(signal: SignalLayout | None, data: NDArray[np.uint8]) -> NDArray[np.int64] | None:
    return None if signal is None else signal.bits(data).astype(np.int64)


def _to_si(physical: NDArray[np.float64], role: Role) -> NDArray[np.float64]:
    value = physical * role.gain
    if role.bias != 0.0:
        value += role.bias
    return value


def raw_ends(signal: SignalLayout) -> tuple[float, float]:
    """Physical values of the smallest and the largest raw number, in ascending order."""
    low = -(1 << (signal.length - 1)) if signal.signed else 0
    high = low + (1 << signal.length) - 1
    ends = sorted((low * signal.scale + signal.offset, high * signal.scale + signal.offset))
    return ends[0], ends[1]


def _outside(physical: NDArray[np.float64], signal: SignalLayout) -> NDArray[np.bool_] | None:
    """Values outside the DBC's range, or not finite; None where that cannot be."""
    slack = 0.5 * abs(signal.scale)
    if signal.is_float:
        wrong = ~np.isfinite(physical)
        slack = 0.0
    else:
        ends = raw_ends(signal)
        if signal.minimum is None or signal.maximum is None:
            return None
        if signal.minimum - slack < ends[0] and ends[1] < signal.maximum + slack:
            return None
        wrong = np.zeros(len(physical), dtype=np.bool_)
    if signal.minimum is not None and signal.maximum is not None:
        wrong |= (physical < signal.minimum - slack) | (physical > signal.maximum + slack)
    return wrong


def value_ends(signal: SignalLayout) -> tuple[float, float]:
    """Physical values at and beyond which a converter stands at its end: those of the DBC's range,
    or of the raw number where it gives none."""
    step = 0.0 if signal.is_float else abs(signal.scale)
    low, high = -np.inf, np.inf
    if not signal.is_float:
        low, high = raw_ends(signal)
    if signal.minimum is not None and signal.maximum is not None:
        low, high = max(low, signal.minimum), min(high, signal.maximum)
    return near_ends(low, high, step)


def _at_end(physical: NDArray[np.float64], signal: SignalLayout) -> NDArray[np.bool_]:
    low, high = value_ends(signal)
    return (physical <= low) | (physical >= high)


def _at_stated_end(value: NDArray[np.float64], role: Role, stated: Stated) -> NDArray[np.bool_]:
    """Values at the ends that the mapping states, SI, but for half a step."""
    if stated.low is None or stated.high is None:
        return np.zeros(len(value), dtype=np.bool_)
    step = stated.step or abs(role.signal.scale * role.gain)
    low, high = near_ends(stated.low, stated.high, step)
    return (value <= low) | (value >= high)
