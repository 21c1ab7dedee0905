"""Decodes single frames as they arrive, for the handshake, the limits and the emulator.

Diagnosis does not read through here: it works on columns of the whole test (`decode`).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

from ehadiag.core.recording import BitReason, BitState
from firmware_iface.codec.live_messages import BitStatus, Request, Sample
from firmware_iface.codec.validity import SenderWatch, intact
from firmware_iface.mapping.bus_map import BusMap, MessageMap, Role, default_map
from firmware_iface.mapping.signal_layout import SignalLayout
from firmware_iface.transport.frames import Frame

__all__ = ["LiveDecoder", "bit_pattern", "checked_values", "counter_key"]

FLOAT_FORMATS = {2: "<e", 4: "<f", 8: "<d"}
REASONS = frozenset(BitReason)
CHANNELS = {f"channels.{key}": key for key in ("current", "spool", "pressure", "position")}
"""Roles in the order of `Sample`'s fields."""
USUAL_CYCLE_NS = 20_000_000
"""Between two frames of a message whose cycle the DBC does not tell."""


class LiveDecoder:
    """Decodes single frames of the mapped messages, good ones only.

    Keeps the last value of each channel, for buses that spread a sample over several messages.
    Telemetry whose counter was just used with another payload is left out, and said to be.

    Parameters
    ----------
    bus_map : BusMap | None
        Which message and signal plays which role.

    Attributes
    ----------
    second_sender : str
        What gives away that somebody else sends as the computer does; empty if nothing.
    """

    second_sender: str

    def __init__(self, bus_map: BusMap | None = None) -> None:
        self._map = bus_map or default_map()
        sections = ("channels", "status", "request")
        self._messages = {
            (item.can_id, item.extended): item
            for item in self._map.messages.values()
            if any(role.name.split(".")[0] in sections for role in item.roles)
        }
        self._codes = {number: name for name, number in self._map.requests.items()}
        self._last = dict.fromkeys(CHANNELS, math.nan)
        self._watches = {
            item.name: SenderWatch(item.modulus, _period_ns(item, self._map))
            for item in self._messages.values()
            if item.counter is not None and not _requests(item)
        }
        self._channel = self._map.channel or 0
        self.second_sender = ""

    @property
    def conflicts(self) -> int:
        """Counter values that came with different payloads so far."""
        return sum(item.conflicts for item in self._watches.values())

    def decode(self, frame: Frame) -> BitStatus | Sample | Request | None:
        """Content of a frame; None for foreign, damaged and all other frames."""
        message = self._messages.get((frame.can_id, frame.extended))
        if message is None or frame.error or frame.remote or not intact(message, frame.data):
            return None
        if self._of_another(message, frame):
            return None
        values = _values(message, frame.data)
        if any(name in self._last for name in values):
            self._last |= {name: values[name] for name in CHANNELS if name in values}
            brought = frozenset(key for name, key in CHANNELS.items() if name in values)
            current, spool, pressure, position = (self._last[name] for name in CHANNELS)
            return Sample(current, spool, pressure, position, brought)
        if "status.state" in values:
            return self._status(values)
        if "request.code" in values:
            code = self._codes.get(round(values["request.code"]), "")
            return Request(code, round(values.get("request.test_id", 0.0)))
        return None

    def _of_another(self, message: MessageMap, frame: Frame) -> bool:
        """Whether a sound frame is another channel's, or in conflict with one before."""
        if frame.channel not in (0, self._channel) and not _requests(message):
            if self._channel:
                if self._map.channel is None:
                    self.second_sender = (
                        f"frames of the actuator's on the channels {self._channel} and"
                        f" {frame.channel}: choose one by channel in the mapping"
                    )
                return True
            self._channel = frame.channel
        watch = self._watches.get(message.name)
        key = counter_key(message, message.counter, frame.data)
        if watch is None or key is None:
            return False
        conflict = watch.take(key, frame.data, frame.time_ns)
        if conflict and watch.second_sender:
            self.second_sender = (
                f"a second sender of {message.name} ({message.can_id:#x}): counters come with"
                " different payloads"
            )
        return conflict and message.measures  # what a status says, the handshake has to hear

    def _status(self, values: Mapping[str, float]) -> BitStatus | None:
        state = self._map.states.get(round(values["status.state"]))
        if state is None:
            return None
        reason = round(values.get("status.reason", 0.0))
        serial = values.get("status.serial")
        test_id = values.get("status.test_id")
        return BitStatus(
            state=BitState(state),
            reason=BitReason(reason) if reason in REASONS else BitReason.NONE,
            test_id=None if test_id is None else round(test_id),
            elapsed=values.get("status.elapsed", 0.0),
            serial=None if serial is None else round(serial),
        )


def counter_key(
    message: MessageMap, counter: SignalLayout | None, data: bytes
) -> tuple[int, ...] | None:
    """Counter of a payload and the page that it counts; None where it carries no counter."""
    if counter is None:
        return None
    selectors = {item: chosen for role in message.roles for item, chosen in role.signal.selectors}
    pages = tuple(bit_pattern(item, data) for item in selectors)
    if any(bit_pattern(item, data) not in chosen for item, chosen in counter.selectors):
        return None
    return (bit_pattern(counter, data), *pages)


def _requests(message: MessageMap) -> bool:
    return all(role.name.startswith("request.") for role in message.roles)


def _period_ns(message: MessageMap, bus_map: BusMap) -> int:
    """Usual time between two counts."""
    if message.counts_ticks or message.measures:
        return bus_map.tick_ns
    return message.cycle_ns or USUAL_CYCLE_NS


def checked_values(message: MessageMap, data: bytes) -> dict[str, float] | None:
    """SI value of each role in a payload; None where its length or its check sum is wrong."""
    return _values(message, data) if intact(message, data) else None


def bit_pattern(signal: SignalLayout, data: bytes) -> int:
    """Bits of a signal in a payload, as an unsigned number."""
    words = {True: int.from_bytes(data, "big"), False: int.from_bytes(data, "little")}
    return _pattern(signal, words, 8 * len(data))


def _values(message: MessageMap, data: bytes) -> dict[str, float]:
    """SI value of each role that is present."""
    words = {True: int.from_bytes(data, "big"), False: int.from_bytes(data, "little")}
    bits = 8 * len(data)
    return {
        role.name: _si(role, words, bits)
        for role in message.roles
        if all(_pattern(item, words, bits) in chosen for item, chosen in role.signal.selectors)
    }


def _pattern(signal: SignalLayout, words: Mapping[bool, int], bits: int) -> int:
    big = signal.big_endian
    shift = bits - signal.lead - signal.length if big else signal.start
    return words[big] >> shift & ((1 << signal.length) - 1)


def _si(role: Role, words: Mapping[bool, int], bits: int) -> float:
    signal = role.signal
    pattern = _pattern(signal, words, bits)
    raw: float = pattern
    if signal.is_float:
        size = signal.length // 8
        raw = struct.unpack(FLOAT_FORMATS[size], pattern.to_bytes(size, "little"))[0]
    elif signal.signed and pattern >> (signal.length - 1):
        raw = pattern - (1 << signal.length)
    return (raw * signal.scale + signal.offset) * role.gain + role.bias
