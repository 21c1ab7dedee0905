"""XCP slave of the emulated computer: measurement only, by polling and by dynamic DAQ lists.

It offers neither stimulation nor calibration: every command that would write is unknown to it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from firmware_iface.transport.frames import Frame
from firmware_iface.xcp import (
    BASE_ADDRESS,
    CLOCK_STEP_NS,
    ERROR,
    IDENTITY,
    MAX_DTO_BYTES,
    MAX_ENTRY_BYTES,
    MAX_ODTS,
    RESPONSE,
    TICK_EVENT,
    TICK_EVENT_NAME,
    Command,
    ErrorCode,
    Measurement,
    XcpIds,
    event_cycle,
    is_extended,
    memory_of,
)

MAX_ENTRIES = 1024
"""Entries of all ODTs together: more is refused as a memory overflow."""
TIMESTAMP_BYTES = 4
DAQ_RESOURCE = 0x04
DAQ_BY_EVENT = 0x84
"""Properties of the event channel: measurement, all lists sampled at one instant."""
DAQ_RUNNING = 0x40
LIST_TIMESTAMP = 0x10
"""Mode of a DAQ list: its first ODT begins with a time stamp."""
DYNAMIC_WITH_PRESCALER_AND_STAMPS = 0x13
"""Properties of the DAQ processor."""


class _CommandError(Exception):
    """Ends a command by an error."""

    def __init__(self, code: ErrorCode) -> None:
        self.code = code


@dataclass(slots=True, eq=False)
class _DaqList:
    """One list: per ODT its entries, address and size; None: allocated, not yet written."""

    odts: list[list[tuple[int, int] | None]] = field(default_factory=list)
    stamped: bool = False
    prescaler: int = 1
    running: bool = False
    selected: bool = False


class XcpSlave:
    """Answers the commands of one master, and sends its DAQ lists at the end of each tick.

    ids: identifiers of both directions; period_ns: length of a tick, ns.
    """

    def __init__(self, measurements: Sequence[Measurement], ids: XcpIds, period_ns: int) -> None:
        self._measurements, self._ids, self._period_ns = measurements, ids, period_ns
        self._memory = memory_of(measurements, dict.fromkeys((m.name for m in measurements), 0))
        self._connected = False
        self._lists: list[_DaqList] = []
        self._pointer: tuple[int, int, int] | None = None
        self._transfer: tuple[bytes, int] | int = BASE_ADDRESS
        """Where UPLOAD reads on: an address, or a text and the place in it."""
        self._ticks = self._now_ns = 0
        self._answers: list[bytes] = []

    def take(self, frame: Frame) -> None:
        """Take a frame off the bus; only a command of the master counts."""
        extended = is_extended(self._ids.request)
        if frame.can_id != self._ids.request or frame.extended != extended or not frame.data:
            return
        data = frame.data
        if data[0] == Command.CONNECT:
            self._reset()
            self._connected = True
        elif not self._connected:
            return
        try:
            content = self._answer(data)
        except _CommandError as error:
            self._answers.append(bytes((ERROR, error.code)))
        except (struct.error, IndexError):  # shorter than the command
            self._answers.append(bytes((ERROR, ErrorCode.CMD_SYNTAX)))
        else:
            self._answers.append(bytes((RESPONSE,)) + content)

    def tick(self, values: Mapping[str, int], now_ns: int) -> list[Frame]:
        """End a tick: sample the measurements; return answers and what DAQ lists send.

        values: raw, by the names of the measurements; now_ns: time of the tick's end, ns.
        """
        self._now_ns = now_ns
        if self._connected:
            self._memory = memory_of(self._measurements, values)
        out, self._answers = self._answers, []
        first = 0
        for item in self._lists:
            if item.running and self._ticks % item.prescaler == 0:
                out += self._sampled(item, first)
            first += len(item.odts)
        self._ticks += 1
        extended = is_extended(self._ids.response)
        return [Frame(0, self._ids.response, data, extended) for data in out]

    def _sampled(self, item: _DaqList, first: int) -> list[bytes]:
        out = []
        for number, odt in enumerate(item.odts):
            content = bytearray((first + number,))
            if number == 0 and item.stamped:
                content += struct.pack("<I", self._clock)
            for entry in odt:
                if entry is not None:
                    content += self._read(*entry)
            out.append(bytes(content))
        return out

    @property
    def _clock(self) -> int:
        return self._now_ns // CLOCK_STEP_NS & 0xFFFFFFFF

    def _reset(self) -> None:
        """Forget the former master's lists."""
        self._connected = False
        self._lists, self._pointer = [], None

    def _read(self, address: int, size: int) -> bytes:
        begin = address - BASE_ADDRESS
        if begin < 0 or begin + size > len(self._memory):
            raise _CommandError(ErrorCode.ACCESS_DENIED)
        return self._memory[begin : begin + size]

    def _answer(self, data: bytes) -> bytes:
        handlers: dict[int, Callable[[bytes], bytes | None]] = {
            Command.CONNECT: self._connect,
            Command.DISCONNECT: lambda _: self._reset(),
            Command.GET_STATUS: self._status,
            Command.SYNCH: self._synchronise,
            Command.GET_COMM_MODE_INFO: lambda _: bytes((0, 0, 0, 0, 0, 0, 0x10)),
            Command.GET_ID: self._identify,
            Command.SET_MTA: self._set_address,
            Command.UPLOAD: lambda item: self._upload(item[1]),
            Command.SHORT_UPLOAD: self._short_upload,
            Command.CLEAR_DAQ_LIST: self._clear,
            Command.SET_DAQ_PTR: self._set_pointer,
            Command.WRITE_DAQ: self._write_entry,
            Command.SET_DAQ_LIST_MODE: self._set_mode,
            Command.START_STOP_DAQ_LIST: self._start_stop_list,
            Command.START_STOP_SYNCH: self._start_stop,
            Command.GET_DAQ_CLOCK: lambda _: struct.pack("<xxxI", self._clock),
            Command.GET_DAQ_PROCESSOR_INFO: self._processor,
            Command.GET_DAQ_RESOLUTION_INFO: self._resolution,
            Command.GET_DAQ_EVENT_INFO: self._event,
            Command.FREE_DAQ: self._free,
            Command.ALLOC_DAQ: self._allocate_lists,
            Command.ALLOC_ODT: self._allocate_odts,
            Command.ALLOC_ODT_ENTRY: self._allocate_entries,
        }
        handler = handlers.get(data[0])
        if handler is None:
            raise _CommandError(ErrorCode.CMD_UNKNOWN)
        return handler(data) or b""

    def _connect(self, data: bytes) -> bytes:
        if data[1] > 1:
            raise _CommandError(ErrorCode.OUT_OF_RANGE)
        return struct.pack("<BBBHBB", DAQ_RESOURCE, 0x80, MAX_DTO_BYTES, MAX_DTO_BYTES, 1, 1)

    def _status(self, _: bytes) -> bytes:
        running = any(item.running for item in self._lists)
        return struct.pack("<BBBH", DAQ_RUNNING if running else 0, 0, 0, 0)

    def _synchronise(self, _: bytes) -> bytes:
        raise _CommandError(ErrorCode.CMD_SYNCH)

    def _identify(self, data: bytes) -> bytes:
        if data[1] > 1:
            return bytes(7)  # no identification of that kind
        self._transfer = IDENTITY.encode(), 0
        return struct.pack("<BHI", 0, 0, len(IDENTITY))

    def _set_address(self, data: bytes) -> None:
        extension, address = struct.unpack_from("<BI", data, 3)
        if extension:
            raise _CommandError(ErrorCode.OUT_OF_RANGE)
        self._transfer = address

    def _upload(self, size: int) -> bytes:
        if not 0 < size <= MAX_ENTRY_BYTES:
            raise _CommandError(ErrorCode.OUT_OF_RANGE)
        if isinstance(self._transfer, int):
            content = self._read(self._transfer, size)
            self._transfer += size
            return content
        text, place = self._transfer
        if place + size > len(text):
            raise _CommandError(ErrorCode.ACCESS_DENIED)
        self._transfer = text, place + size
        return text[place : place + size]

    def _short_upload(self, data: bytes) -> bytes:
        self._set_address(data)
        return self._upload(data[1])

    def _list(self, data: bytes) -> _DaqList:
        (number,) = struct.unpack_from("<H", data, 2)
        if number >= len(self._lists):
            raise _CommandError(ErrorCode.OUT_OF_RANGE)
        return self._lists[number]

    def _idle_list(self, data: bytes) -> _DaqList:
        found = self._list(data)
        if found.running:
            raise _CommandError(ErrorCode.DAQ_ACTIVE)
        return found

    def _clear(self, data: bytes) -> None:
        found = self._list(data)
        found.running = found.selected = False
        found.odts = [[None] * len(odt) for odt in found.odts]

    def _set_pointer(self, data: bytes) -> None:
        found = self._idle_list(data)
        number, odt, entry = struct.unpack_from("<HBB", data, 2)
        if odt >= len(found.odts) or entry >= len(found.odts[odt]):
            raise _CommandError(ErrorCode.OUT_OF_RANGE)
        self._pointer = number, odt, entry

    def _write_entry(self, data: bytes) -> None:
        bit, size, extension, address = struct.unpack_from("<BBBI", data, 1)
        if self._pointer is None:
            raise _CommandError(ErrorCode.SEQUENCE)
        number, odt, entry = self._pointer
        found = self._lists[number]
        if found.running:
            raise _CommandError(ErrorCode.DAQ_ACTIVE)
        if bit != 0xFF or extension or not 0 < size <= MAX_ENTRY_BYTES:
            raise _CommandError(ErrorCode.OUT_OF_RANGE)
        if entry >= len(found.odts[odt]):
            raise _CommandError(ErrorCode.DAQ_CONFIG)
        self._read(address, size)
        found.odts[odt][entry] = address, size
        self._pointer = number, odt, entry + 1

    def _set_mode(self, data: bytes) -> None:
        found = self._idle_list(data)
        event, prescaler = struct.unpack_from("<HB", data, 4)
        if data[1] & ~LIST_TIMESTAMP:
            raise _CommandError(ErrorCode.MODE_NOT_VALID)
        if event != TICK_EVENT or prescaler < 1:
            raise _CommandError(ErrorCode.OUT_OF_RANGE)
        found.stamped, found.prescaler = bool(data[1] & LIST_TIMESTAMP), prescaler

    def _start_stop_list(self, data: bytes) -> bytes:
        found = self._list(data)
        if data[1] > 2:  # 0 stopped, 1 running, 2 selected
            raise _CommandError(ErrorCode.MODE_NOT_VALID)
        if data[1]:
            self._refuse_overlong(found)
        found.running = data[1] == 1 or (found.running and data[1] != 0)
        found.selected = data[1] == 2
        first = sum(len(item.odts) for item in self._lists[: self._lists.index(found)])
        return bytes((first,))

    def _start_stop(self, data: bytes) -> None:
        if data[1] > 2:
            raise _CommandError(ErrorCode.MODE_NOT_VALID)
        for item in self._lists:
            if data[1] == 1 and item.selected:  # it may have changed since it was selected
                self._refuse_overlong(item)
        for item in self._lists:
            if data[1] == 0:
                item.running = False
            elif item.selected:
                item.running = data[1] == 1
            item.selected = False

    def _refuse_overlong(self, found: _DaqList) -> None:
        """Refuse a list that is incomplete, or an ODT of which is longer than a frame."""
        if not found.odts:
            raise _CommandError(ErrorCode.DAQ_CONFIG)
        for number, odt in enumerate(found.odts):
            stamp = TIMESTAMP_BYTES if found.stamped and number == 0 else 0
            sizes = [entry[1] for entry in odt if entry is not None]
            if len(sizes) < len(odt) or 1 + stamp + sum(sizes) > MAX_DTO_BYTES:
                raise _CommandError(ErrorCode.DAQ_CONFIG)

    def _processor(self, _: bytes) -> bytes:
        return struct.pack("<BHHBB", DYNAMIC_WITH_PRESCALER_AND_STAMPS, len(self._lists), 1, 0, 0)

    def _resolution(self, _: bytes) -> bytes:
        stamp = TIMESTAMP_BYTES | event_cycle(CLOCK_STEP_NS)[1] << 4
        return struct.pack("<BBBBBH", 1, MAX_ENTRY_BYTES, 0, 0, stamp, 1)

    def _event(self, data: bytes) -> bytes:
        if struct.unpack_from("<H", data, 2)[0] != TICK_EVENT:
            raise _CommandError(ErrorCode.OUT_OF_RANGE)
        self._transfer = TICK_EVENT_NAME.encode(), 0
        cycle, unit = event_cycle(self._period_ns)
        return struct.pack("<BBBBBB", DAQ_BY_EVENT, 0xFF, len(TICK_EVENT_NAME), cycle, unit, 0xFF)

    def _free(self, _: bytes) -> None:
        self._lists, self._pointer = [], None

    def _allocate_lists(self, data: bytes) -> None:
        (count,) = struct.unpack_from("<H", data, 2)
        if self._lists:
            raise _CommandError(ErrorCode.SEQUENCE)
        if not 0 < count <= MAX_ODTS:
            raise _CommandError(ErrorCode.MEMORY_OVERFLOW)
        self._lists = [_DaqList() for _ in range(count)]

    def _allocate_odts(self, data: bytes) -> None:
        found = self._idle_list(data)
        if found.odts:
            raise _CommandError(ErrorCode.SEQUENCE)
        if sum(len(item.odts) for item in self._lists) + data[4] > MAX_ODTS:
            raise _CommandError(ErrorCode.MEMORY_OVERFLOW)
        found.odts = [[] for _ in range(data[4])]

    def _allocate_entries(self, data: bytes) -> None:
        found = self._idle_list(data)
        if data[4] >= len(found.odts):
            raise _CommandError(ErrorCode.OUT_OF_RANGE)
        if found.odts[data[4]]:
            raise _CommandError(ErrorCode.SEQUENCE)
        taken = sum(len(odt) for item in self._lists for odt in item.odts)
        if taken + data[5] > MAX_ENTRIES:
            raise _CommandError(ErrorCode.MEMORY_OVERFLOW)
        found.odts[data[4]] = [None] * data[5]
