"""Measures by XCP: the telemetry of a bus comes from a DAQ list of the computer's XCP slave."""

from __future__ import annotations

import contextlib
import struct
from collections import deque
from collections.abc import Iterator

import msgspec

from firmware_iface.bus_map import BusMap
from firmware_iface.codec import TickEncoder
from firmware_iface.errors import ConfigurationError, InputOutputError
from firmware_iface.recording import CHANNEL_NAMES, Channels, CommandMode
from firmware_iface.transport.base import Transport, TransportState
from firmware_iface.transport.frames import Frame
from firmware_iface.xcp import (
    ERROR,
    FORMATS,
    MAX_ENTRY_BYTES,
    MAX_ODTS,
    RESPONSE,
    TICK_EVENT,
    Command,
    ErrorCode,
    Measurement,
    XcpIds,
    is_extended,
    measurements_of,
)

ANSWER_TIMEOUT_S = 2.0
"""Longest wait for an answer, s: what the A2L file states as T1."""
COMMAND_SCALE = 1e-9
"""SI value of one step of the measured commands."""


class _Entry(msgspec.Struct, frozen=True):
    """A measurement in an ODT, or the first byte of one."""

    measurement: Measurement
    size: int


def refuse_taken_identifiers(ids: XcpIds, bus_map: BusMap, *, uds: bool) -> None:
    """Refuse identifiers that the bus has already.

    uds: whether UDS is spoken on it. ConfigurationError: a message, or UDS, has one of them.
    """
    messages = (*bus_map.messages.values(), *bus_map.onboard)
    taken = {(item.can_id, item.extended): f"message {item.name}" for item in messages}
    if uds:
        other = bus_map.uds_identifiers
        taken |= {
            (can_id, other.extended): "UDS" for can_id in (other.request_id, other.response_id)
        }
    for can_id in ids:
        owner = taken.get((can_id, is_extended(can_id)))
        if owner is not None:
            raise ConfigurationError(f"XCP identifier {can_id:#x}: {owner} has it")


class XcpTransport(Transport):
    """A bus as its reader expects it, with commands and channels measured by XCP.

    What the DAQ lists bring is handed on as the bus's own messages of commands and channels, with
    the tick as their counter; those that the computer sends itself are left out. All other frames
    pass. An ODT that is missing loses its tick.

    bus: opened to send; it stays open when this one is closed; channels: converters of the
    computer; mode: what the test commands; uds: whether the test is requested by UDS.
    ConfigurationError: the bus listens only, has commands and channels in messages with other
    signals, or one of the identifiers; InputOutputError: no slave answers, or it refuses.
    """

    def __init__(
        self,
        bus: Transport,
        bus_map: BusMap,
        channels: Channels,
        mode: CommandMode,
        ids: XcpIds,
        *,
        uds: bool = False,
    ) -> None:
        super().__init__(f"{bus.name} by XCP", transmit=True)
        if not bus.transmits:
            raise ConfigurationError("XCP: measures on command, and needs a bus that sends")
        refuse_taken_identifiers(ids, bus_map, uds=uds)
        self._bus, self._ids, self._mode = bus, ids, mode
        self._encoder = TickEncoder(bus_map, channels)
        self._replaced = frozenset(_replaced_identifiers(bus_map))
        self._waiting: deque[Frame] = deque()
        measured = {item.name: item for item in measurements_of(channels)}
        command = "command_current" if mode is CommandMode.CURRENT else "command_position"
        wanted = [measured[name] for name in (*CHANNEL_NAMES, command, "command_mode", "test_id")]
        self._command = command
        self._odts = tuple(_odts(measured["tick"], wanted))
        self._sample: list[Frame] = []
        self._start()

    @property
    def state(self) -> TransportState:
        """That of the bus, until this one is closed."""
        return self._bus.state if self._state is TransportState.OPEN else self._state

    @property
    def detail(self) -> str:
        """That of the bus."""
        return self._bus.detail

    @property
    def at_end(self) -> bool:
        """Whether no frame can come any more."""
        return self._bus.at_end

    @property
    def real_time(self) -> bool:
        """Whether frames come when the bus brings them."""
        return self._bus.real_time

    def now_ns(self) -> int:
        """Present time of the bus, ns."""
        return self._bus.now_ns()

    def stamp_ns(self) -> int:
        """Time stamp for a frame that is sent now, ns."""
        return self._bus.stamp_ns()

    def _receive(self, timeout: float) -> Frame | None:
        limit = self.now_ns() + round(timeout * 1e9)
        while not self._waiting:
            frame = self._bus.receive(max(limit - self.now_ns(), 0) / 1e9)
            if frame is None:
                return None
            if self._is_answer(frame):
                if frame.data and frame.data[0] < MAX_ODTS:
                    self._measure(frame)
            elif (frame.can_id, frame.extended) not in self._replaced:
                return frame
        return self._waiting.popleft()

    def _send(self, frame: Frame) -> None:
        self._bus.send(frame)

    def _close(self) -> None:
        for command, content in ((Command.START_STOP_SYNCH, bytes(1)), (Command.DISCONNECT, b"")):
            with contextlib.suppress(InputOutputError, ConfigurationError):
                self._request(command, content)

    def _is_answer(self, frame: Frame) -> bool:
        ours = self._ids.response
        return frame.can_id == ours and frame.extended == is_extended(ours)

    def _start(self) -> None:
        """Connect, and start one list of all measurements, in each tick."""
        self._request(Command.CONNECT, bytes(1))
        self._request(Command.FREE_DAQ)
        self._request(Command.ALLOC_DAQ, struct.pack("<xH", 1))
        self._request(Command.ALLOC_ODT, struct.pack("<xHB", 0, len(self._odts)))
        for number, odt in enumerate(self._odts):
            content = struct.pack("<xHBB", 0, number, len(odt))
            self._request(Command.ALLOC_ODT_ENTRY, content)
        for number, odt in enumerate(self._odts):
            self._request(Command.SET_DAQ_PTR, struct.pack("<xHBB", 0, number, 0))
            for entry in odt:
                content = struct.pack("<BBBI", 0xFF, entry.size, 0, entry.measurement.address)
                self._request(Command.WRITE_DAQ, content)
        self._request(Command.SET_DAQ_LIST_MODE, struct.pack("<BHHBB", 0, 0, TICK_EVENT, 1, 0))
        try:
            answer = self._request(Command.START_STOP_DAQ_LIST, struct.pack("<BH", 1, 0))
        except BaseException:  # the list may send all the same
            self._close()
            raise
        self._first = answer[1] if len(answer) > 1 else 0

    def _request(self, command: Command, content: bytes = b"") -> bytes:
        """Send a command; return its answer."""
        ids = self._ids
        data = bytes((command,)) + content
        self._bus.send(Frame(self.stamp_ns(), ids.request, data, is_extended(ids.request)))
        limit = self.now_ns() + round(ANSWER_TIMEOUT_S * 1e9)
        while (left := limit - self.now_ns()) > 0:
            frame = self._bus.receive(left / 1e9)
            if frame is None or not self._is_answer(frame) or not frame.data:
                continue
            if frame.data[0] == RESPONSE:
                return frame.data
            if frame.data[0] == ERROR:
                code = frame.data[1] if len(frame.data) > 1 else -1
                known = code in ErrorCode.__members__.values()
                why = ErrorCode(code).name if known else f"error {code:#x}"
                raise InputOutputError(f"{self._bus.name}: XCP slave refuses {command.name}: {why}")
        raise InputOutputError(
            f"{self._bus.name}: no XCP slave answers {command.name} on {ids.request:X}:"
            f"{ids.response:X}; is it switched on (ehadiag sim --xcp)?"
        )

    def _measure(self, frame: Frame) -> None:
        """Take an ODT; with the last one of a tick hand its sample on."""
        number = frame.data[0] - self._first
        if number != len(self._sample):
            self._sample.clear()
        if number != len(self._sample):
            return
        self._sample.append(frame)
        if len(self._sample) < len(self._odts):
            return
        frames, self._sample = self._sample, []
        values, ticks = {}, set()
        for item, odt in zip(frames, self._odts, strict=True):
            if len(item.data) < 1 + sum(entry.size for entry in odt):
                return
            place = 1
            for entry in odt:
                raw = item.data[place : place + entry.size]
                place += entry.size
                if entry.measurement.name == "tick":
                    ticks.add(raw[0])
                if entry.size == entry.measurement.size:
                    layout = FORMATS[entry.measurement.datatype]
                    (values[entry.measurement.name],) = struct.unpack(layout, raw)
        if len(ticks) == 1 and all(
            values[entry.measurement.name] <= entry.measurement.raw_ends[1]
            for odt in self._odts for entry in odt
        ):  # fmt: skip
            self._waiting += self._messages(values, frames[0].time_ns)

    def _messages(self, values: dict[str, int], time_ns: int) -> tuple[Frame, ...]:
        tick = values["tick"]
        if values["command_mode"] == self._mode:
            value = values[self._command] * COMMAND_SCALE
            self._encoder.command(self._mode, value, values["test_id"], time_ns)
        else:
            self._encoder.clear("command")
        self._encoder.telemetry([values[name] for name in CHANNEL_NAMES], time_ns)
        return self._encoder.frames(time_ns, tick)


def _odts(tick: Measurement, wanted: list[Measurement]) -> Iterator[list[_Entry]]:
    """Distribute measurements among ODTs, each of which begins with its tick, or its last byte."""
    odt = [_Entry(tick, tick.size)]
    for item in wanted:
        if sum(entry.size for entry in odt) + item.size > MAX_ENTRY_BYTES:
            yield odt
            odt = [_Entry(tick, 1)]
        odt.append(_Entry(item, item.size))
    yield odt


def _replaced_identifiers(bus_map: BusMap) -> Iterator[tuple[int, bool]]:
    """Give identifiers of the messages of commands and channels."""
    for message in bus_map.messages.values():
        ours = [item.name.startswith(("channels.", "command.")) for item in message.roles]
        if any(ours) and not all(ours):
            raise ConfigurationError(
                f"XCP: message {message.name} has commands or channels beside other signals; name"
                " a mapping whose messages have them apart"
            )
        if any(ours):
            yield message.can_id, message.extended
