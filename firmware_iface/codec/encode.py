"""Encodes SI values as frames, for the emulated computer and for the tester's requests."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence

from ehadiag.core.channels import CHANNELS, Channel, Channels
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.recording import BitReason, BitState, CommandMode
from firmware_iface.codec.protection import crc8
from firmware_iface.mapping.bus_map import BusMap, MessageMap, Role, default_map
from firmware_iface.mapping.signal_layout import SignalLayout
from firmware_iface.transport.frames import Frame

__all__ = ["Encoder"]

CHANNEL_KEYS = ("channels.current", "channels.spool", "channels.pressure", "channels.position")
FLOAT_FORMATS = {16: "<e", 32: "<f", 64: "<d"}


class Encoder:
    """Builds frames and keeps the counter of each message.

    Every method returns a tuple of frames: a bus may spread one group of signals over several
    messages. With the default bus each tuple holds exactly one frame. A message of which only a
    part belongs to the group is sent with the rest zero.

    Not for use from several threads at once.

    Parameters
    ----------
    bus_map : BusMap | None
        Which message and signal plays which role; None: the default bus.
    channels : Channels
        Converters of which telemetry sends the codes.
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
            for section in ("channels", "command", "environment", "status", "request")
        }
        self._modes = {mode: number for number, mode in self._map.modes.items()}
        self._states = {state: number for number, state in self._map.states.items()}
        # Codes to raw numbers, each worked out once, when it is first sent.
        self._codes = {
            key: _Codes(role[1], channel)
            for key, channel in zip(CHANNEL_KEYS, channels, strict=True)
            if (role := self._map.find(key)) is not None
        }

    def telemetry(
        self, codes: Sequence[int], time_ns: int, counter: int | None = None
    ) -> tuple[Frame, ...]:
        """Frames of one sample.

        Parameters
        ----------
        codes : Sequence[int]
            Converter codes of current, spool, pressure, position (0 … 4095 of 12 bits); they
            survive decoding exactly where the signals are as fine as the converters.
        time_ns : int
            Time stamp of the frames.
        counter : int | None
            Counter value; None continues each message's own.

        Returns
        -------
        tuple[Frame, ...]
            The frames of one sample.
        """
        raw = {
            key: self._codes[key][int(code)] for key, code in zip(CHANNEL_KEYS, codes, strict=True)
        }
        return tuple(writer.frame(raw, time_ns, counter) for writer in self._writers["channels"])

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

        Parameters
        ----------
        code : str | int
            "start" or "abort".
        test_id : int
            Number of the test.
        time_ns : int
            Time stamp of the frames, ns.

        Returns
        -------
        tuple[Frame, ...]
            The frames of the request.

        Raises
        ------
        ConfigurationError
            The mapping has no such request.
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
        return tuple(writer.frame(writer.raw(values), time_ns, counter) for writer in writers)


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


def _by_multiplexer(message: MessageMap, section: str) -> list[dict[str, Role]]:
    """Roles of a section by the frame that carries them: one frame per multiplexer setting."""
    groups: dict[tuple[tuple[str, int], ...], dict[str, Role]] = {}
    for role in message.roles:
        if role.name.startswith(section + "."):
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
