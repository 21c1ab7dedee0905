"""Translates between frames and SI values: decodes tables of frames, encodes single frames.

Of a recording with several adapter channels the one that carries the actuator's bus is chosen.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from firmware_iface.bus_map import BusMap, MessageMap, Role, default_map
from firmware_iface.dbc import FLOAT_FORMATS, SignalLayout
from firmware_iface.errors import ConfigurationError
from firmware_iface.protection import crc8, rows_of, sound_rows
from firmware_iface.recording import (
    CHANNEL_ROLES,
    CHANNELS,
    BitReason,
    BitState,
    BoolArray,
    Channel,
    Channels,
    CommandMode,
    FloatArray,
    IntArray,
    StatedConverter,
    end_thresholds,
)
from firmware_iface.transport.frames import Frame, FrameTable


def channels_in(table: FrameTable, bus_map: BusMap) -> frozenset[int]:
    """Channels on which a sound frame of the actuator's came; 0, where none is said, left out.

    Requests do not count: they are the tester's.
    """
    numbers = np.flatnonzero(np.bincount(table.channel))
    if len(numbers) == 1:
        return frozenset(numbers[numbers > 0].tolist())
    found: set[int] = set()
    for message in bus_map.messages.values():
        if not all(role.name.startswith("request.") for role in message.roles):
            row, *_ = sound_rows(table, rows_of(table, message), message)
            found.update(np.flatnonzero(np.bincount(table.channel[row])).tolist())
    return frozenset(found - {0})


def choose_channel(chosen: int | None, present: frozenset[int]) -> tuple[int | None, str]:
    """Channel to decode (None: all there are), and why none can be; empty if one can.

    chosen: by the mapping or by `--log-channel`; None: not at all; present: what `channels_in`
    found in the recording. Returns the channel, and the reason why there is none (empty: there is
    one).
    """
    listed = ", ".join(map(str, sorted(present)))
    if chosen is None:
        if len(present) > 1:
            return None, (
                f"frames of the actuator's on the adapter channels {listed}: choose one by"
                " --log-channel, or by channel in the mapping"
            )
        return next(iter(present), None), ""
    if present and chosen not in present:
        return chosen, (
            f"no frame of the actuator's on adapter channel {chosen}, which was chosen; there are"
            f" on {listed}"
        )
    return chosen, ""


class Decoded(msgspec.Struct, frozen=True, eq=False):
    """The frames of one message; n of them passed the checks."""

    message: MessageMap
    received: IntArray
    """Rows of the table with its identifier, good or bad."""
    crc_bad: IntArray
    """Rows that failed a check."""
    length_bad: IntArray
    range_bad: IntArray
    row: IntArray
    """Rows that passed length and check sum, shape (n,), ascending."""
    data: NDArray[np.uint8]
    """Their payloads, shape (n, width)."""
    time_ns: IntArray
    """Host time, shape (n,)."""
    counter: IntArray | None
    """Counter values, shape (n,); None without a counter."""
    modulus: int
    """Counts per turn of the counter; 0 without one."""
    counted: BoolArray | None
    """Which frames carry the counter, shape (n,); None: all of them, or there is none."""
    values: Mapping[str, FloatArray]
    """SI value per role, shape (n,); NaN where a multiplexed signal is absent or its value lies
    outside the range of the DBC.
    """
    saturated: Mapping[str, BoolArray]
    """Per channel role, value at an end of its range, shape (n,)."""
    stream: IntArray
    """Which set of multiplexed signals the frame carries, shape (n,); 0 without multiplexers."""

    def without(self, dropped: BoolArray) -> Decoded:
        """The same with some of the frames that passed left out after all; shape (n,)."""
        keep = ~dropped
        return replace(
            self,
            row=self.row[keep],
            data=self.data[keep],
            time_ns=self.time_ns[keep],
            counter=None if self.counter is None else self.counter[keep],
            counted=None if self.counted is None else self.counted[keep],
            values={name: value[keep] for name, value in self.values.items()},
            saturated={name: value[keep] for name, value in self.saturated.items()},
            stream=self.stream[keep],
        )


class DecodedTable(msgspec.Struct, frozen=True, eq=False):
    """All messages of a frame table; rows of frames that belong to none, and of error frames."""

    messages: Mapping[str, Decoded]
    message_of: Mapping[str, str]
    """Name of the message that brings each role, as `command.mode`."""
    onboard: IntArray
    """Rows of what the computer has found by itself, ascending."""
    foreign: IntArray
    errors: IntArray


def decode(table: FrameTable, bus_map: BusMap) -> DecodedTable:
    """Check and decode all frames of the mapped messages on the actuator's channel."""
    foreign = ~(table.error | table.remote)
    messages = {}
    message_of: dict[str, str] = {}
    for message in bus_map.messages.values():
        message_of |= {role.name: message.name for role in message.roles}
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
    onboard = np.zeros_like(foreign)
    for message in bus_map.onboard:
        onboard[rows_of(table, message)] = True
    foreign &= ~onboard
    if bus_map.channel is not None:
        onboard &= (table.channel == bus_map.channel) | (table.channel == 0)
    rows = map(np.flatnonzero, (onboard, foreign, table.error))
    return DecodedTable(messages, message_of, *rows)


def _decode_message(
    table: FrameTable, received: IntArray, message: MessageMap, keep_bad_crc: bool, keep_range: bool
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
        wrong = _out_of_range(physical, role.signal)
        if wrong is not None:
            outside |= wrong if present is None else wrong & present
        if role.name.startswith("channels."):
            saturated[role.name] = _at_end(physical, role.signal)
        value = _to_si(physical, role)
        if isinstance(role.stated, StatedConverter):
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
        modulus=message.modulus,
        counted=None if message.counter is None else message.counter.present(data),
        values=values,
        saturated=saturated,
        stream=stream,
    )


def _integers(signal: SignalLayout | None, data: NDArray[np.uint8]) -> IntArray | None:
    return None if signal is None else signal.bits(data).astype(np.int64)


def _to_si(physical: FloatArray, role: Role) -> FloatArray:
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


def _out_of_range(physical: FloatArray, signal: SignalLayout) -> BoolArray | None:
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
    return end_thresholds(low, high, step)


def _at_end(physical: FloatArray, signal: SignalLayout) -> BoolArray:
    low, high = value_ends(signal)
    return (physical <= low) | (physical >= high)


def _at_stated_end(value: FloatArray, role: Role, stated: StatedConverter) -> BoolArray:
    """Values at the ends that the mapping states, SI, but for half a step."""
    if stated.low is None or stated.high is None:
        return np.zeros(len(value), dtype=np.bool_)
    step = stated.step or abs(role.signal.scale * role.gain)
    low, high = end_thresholds(stated.low, stated.high, step)
    return (value <= low) | (value >= high)


SENT_SECTIONS = ("channels", "command", "environment", "status")
"""Sections of a mapping whose signals the computer sends."""


class Encoder:
    """Builds frames and keeps the counter of each message.

    Every method returns a tuple of frames: a bus may spread one group of signals over several
    messages. With the default bus each tuple holds exactly one frame. A message of which only a
    part belongs to the group is sent with the rest zero.

    Not for use from several threads at once.

    bus_map: which message and signal plays which role; None: the default bus; channels: converters
    of which telemetry sends the codes.
    """

    def __init__(self, bus_map: BusMap | None = None, channels: Channels = CHANNELS) -> None:
        self._map = bus_map if bus_map is not None else default_map()
        self._counters: dict[str, int] = {}
        self._writers = {
            section: tuple(
                _Writer(item, roles, self._counters)
                for item in self._map.messages.values()
                for roles in _by_multiplexer(item, section)
            )
            for section in (*SENT_SECTIONS, "request")
        }
        self._modes = {mode: number for number, mode in self._map.modes.items()}
        self._states = {state: number for number, state in self._map.states.items()}
        # Codes to raw numbers, each worked out once, when it is first sent.
        self._codes = {
            key: _Codes(role[1], channel)
            for key, channel in zip(CHANNEL_ROLES, channels, strict=True)
            if (role := self._map.find(key)) is not None
        }

    def telemetry(
        self, codes: Sequence[int], time_ns: int, counter: int | None = None
    ) -> tuple[Frame, ...]:
        """Frames of one sample.

        codes: converter codes of current, spool, pressure, position (0 … 4095 of 12 bits); they
        survive decoding exactly where the signals are as fine as the converters; time_ns: time
        stamp of the frames; counter: counter value; None continues each message's own.
        """
        raw = {
            key: self._codes[key][int(code)] for key, code in zip(CHANNEL_ROLES, codes, strict=True)
        }
        return self._frames("channels", raw, time_ns, counter)

    def command(
        self,
        mode: CommandMode | int,
        value: float,
        test_id: int,
        time_ns: int,
        counter: int | None = None,
    ) -> tuple[Frame, ...]:
        """Frames of the command active in a tick: A in current mode, m in position mode."""
        values = {"command.mode": float(self._modes.get(CommandMode(mode), int(mode)))}
        values["command.test_id"] = float(test_id)
        values["command.current"] = value if mode == CommandMode.CURRENT else 0.0
        values["command.position"] = value if mode == CommandMode.POSITION else 0.0
        return self._send("command", values, time_ns, counter)

    def environment(
        self,
        supply_pressure: float,
        return_pressure: float,
        oil_temperature: float,
        time_ns: int,
    ) -> tuple[Frame, ...]:
        """Frames of supply and return pressure, Pa, and oil temperature, degC."""
        values = {
            "environment.supply_pressure": supply_pressure,
            "environment.return_pressure": return_pressure,
            "environment.oil_temperature": oil_temperature,
        }
        return self._send("environment", values, time_ns, None)

    def status(
        self,
        state: BitState | int,
        reason: BitReason | int,
        test_id: int,
        elapsed: float,
        serial: int,
        time_ns: int,
    ) -> tuple[Frame, ...]:
        """Frames of the test's state; elapsed in s."""
        values = {
            "status.state": float(self._states[BitState(state)]),
            "status.reason": float(reason),
            "status.test_id": float(test_id),
            "status.elapsed": elapsed,
            "status.serial": float(serial),
        }
        return self._send("status", values, time_ns, None)

    def request(self, code: str | int, test_id: int, time_ns: int = 0) -> tuple[Frame, ...]:
        """Frames that ask for a test: code `start` or `abort`, or its number on the bus.

        time_ns: time stamp of the frames, ns. ConfigurationError: the mapping has no such request.
        """
        if isinstance(code, str):
            if code not in self._map.requests:
                raise ConfigurationError(f"bus {self._map.name}: no request code {code!r}")
            code = self._map.requests[code]
        values = {"request.code": float(code), "request.test_id": float(test_id)}
        return self._send("request", values, time_ns, None)

    def _send(
        self, section: str, values: Mapping[str, float], time_ns: int, counter: int | None
    ) -> tuple[Frame, ...]:
        writers = self._writers[section]
        if not writers:
            raise ConfigurationError(f"bus {self._map.name}: the mapping has no [{section}]")
        raw = {name: item for writer in writers for name, item in writer.raw(values).items()}
        return self._frames(section, raw, time_ns, counter)

    def _frames(
        self, section: str, raw: Mapping[str, int], time_ns: int, counter: int | None
    ) -> tuple[Frame, ...]:
        """Frames of a group of signals, from bit patterns by role."""
        return tuple(writer.frame(raw, time_ns, counter) for writer in self._writers[section])


class TickEncoder(Encoder):
    """Builds the frames of a tick: each message once, with all groups of signals that it carries.

    The methods of `Encoder` take the values, which stay until the next ones, and return no frame:
    `frames` does. A group without values yet is sent as zero.
    """

    def __init__(self, bus_map: BusMap | None = None, channels: Channels = CHANNELS) -> None:
        super().__init__(bus_map, channels)
        writers = [
            _Writer(item, roles, self._counters)
            for item in self._map.messages.values()
            for roles in _by_multiplexer(item, *SENT_SECTIONS)
        ]
        self._sent = {
            section: [item for item in writers if item.carries(section)]
            for section in SENT_SECTIONS
        }
        self._raw = {role.name: 0 for item in self._map.messages.values() for role in item.roles}
        self._due: list[str] = []

    def frames(self, time_ns: int, counter: int | None = None) -> tuple[Frame, ...]:
        """Frames of the groups that have new values; see `telemetry` for the arguments."""
        due = dict.fromkeys(writer for section in self._due for writer in self._sent[section])
        self._due.clear()
        return tuple(writer.frame(self._raw, time_ns, counter) for writer in due)

    def clear(self, section: str) -> None:
        """Let a group of signals be sent as zero again, in messages that it shares."""
        self._raw.update({name: 0 for name in self._raw if name.startswith(f"{section}.")})

    def _frames(
        self, section: str, raw: Mapping[str, int], time_ns: int, counter: int | None
    ) -> tuple[Frame, ...]:
        del time_ns, counter
        self._raw.update(raw)
        self._due.append(section)
        return ()


class _Codes(dict[int, int]):
    """Bit patterns by converter code."""

    def __init__(self, role: Role, channel: Channel) -> None:
        super().__init__()
        self._role, self._channel = role, channel

    def __missing__(self, code: int) -> int:
        channel = self._channel
        if not 0 <= code < 2 * channel.half:
            raise IndexError(f"code {code} of {channel.name}: outside 0 … {2 * channel.half - 1}")
        pattern = _to_raw(self._role, (code - channel.half) * channel.lsb)
        self[code] = pattern
        return pattern


class _Writer:
    """Packs one message; counters are shared by all writers of a message."""

    def __init__(
        self, message: MessageMap, roles: Mapping[str, Role], counters: dict[str, int]
    ) -> None:
        self._message = message
        self._counters = counters
        self._roles = roles
        self._places = {name: _place(role.signal, message) for name, role in self._roles.items()}
        # Signals of one frame share their multiplexers.
        self._constant = 0
        for selector, values in next(iter(roles.values())).signal.selectors:
            shift, big, size = _place(selector, message)
            pattern = min(values)
            self._constant |= pattern << shift if big else _swap(pattern, shift, size)
        self._counter_place = _place(message.counter, message) if message.counter else None
        self._header = struct.pack("<H", message.can_id & 0xFFFF)

    def raw(self, values: Mapping[str, float]) -> dict[str, int]:
        """Bit patterns of SI values."""
        return {name: _to_raw(role, values[name]) for name, role in self._roles.items()}

    def carries(self, section: str) -> bool:
        """Whether it has a signal of a section of the mapping."""
        return any(name.partition(".")[0] == section for name in self._roles)

    def frame(self, raw: Mapping[str, int], time_ns: int, counter: int | None) -> Frame:
        """One frame from bit patterns by role."""
        message = self._message
        word = self._constant
        for name, (shift, big, size) in self._places.items():
            word |= raw[name] << shift if big else _swap(raw[name], shift, size)
        if self._counter_place is not None and message.counter is not None:
            if counter is None:
                counter = self._counters.get(message.name, 0)
            count = counter % message.modulus
            self._counters[message.name] = count + 1
            shift, big, size = self._counter_place
            word |= count << shift if big else _swap(count, shift, size)
        data = word.to_bytes(message.length, "big")
        if message.crc is not None:
            at = message.crc.lead // 8
            check = crc8(self._header + data[:at] + data[at + 1 :])
            data = data[:at] + bytes((check,)) + data[at + 1 :]
        return Frame(time_ns, message.can_id, data, extended=message.extended, fd=message.fd)


def _by_multiplexer(message: MessageMap, *sections: str) -> list[dict[str, Role]]:
    """Roles of sections by the frame that carries them: one frame per multiplexer setting."""
    groups: dict[tuple[tuple[str, int], ...], dict[str, Role]] = {}
    for role in message.roles:
        if role.name.partition(".")[0] in sections:
            setting = tuple((item.name, min(values)) for item, values in role.signal.selectors)
            groups.setdefault(setting, {})[role.name] = role
    return list(groups.values())


def _place(signal: SignalLayout, message: MessageMap) -> tuple[int, bool, int]:
    """Shift of a signal in the payload read as one number, whether big-endian, payload size."""
    if signal.big_endian:
        return 8 * message.length - signal.lead - signal.length, True, message.length
    return signal.start, False, message.length


def _swap(value: int, shift: int, size: int) -> int:
    return int.from_bytes((value << shift).to_bytes(size, "little"), "big")


def _to_raw(role: Role, value: float) -> int:
    """Bit pattern of an SI value, rounded to the nearest and held within the signal's range."""
    signal = role.signal
    physical = (value - role.bias) / role.gain
    number = (physical - signal.offset) / signal.scale
    if signal.is_float:
        pattern = struct.pack(FLOAT_FORMATS[signal.length], number)
        return int.from_bytes(pattern, "little")
    low = -(1 << (signal.length - 1)) if signal.signed else 0
    high = low + (1 << signal.length) - 1
    nearest = low if math.isnan(number) else int(min(max(round(number), low), high))
    return nearest & ((1 << signal.length) - 1)
