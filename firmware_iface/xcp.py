"""XCP on CAN (ASAM MCD-1 XCP 1.1): what a flight-control computer offers for measurement.

`MEASUREMENTS` is the one description: the emulated computer serves it, the A2L file and the DAQ
lists of a recording are made of it.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import NamedTuple

from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import MAX_CAN_ID, MAX_STANDARD_CAN_ID, Channels

BASE_ADDRESS = 0x1000
"""Address of the first measurement."""
FORMATS = {"UBYTE": "<B", "UWORD": "<H", "SWORD": "<h", "ULONG": "<I", "SLONG": "<i"}
"""Layout of a data type of ASAM MCD-2 MC; the least significant byte comes first."""
MAX_DTO_BYTES = 8
MAX_ENTRY_BYTES = MAX_DTO_BYTES - 1
TICK_EVENT = 0
"""Number of the only event channel: the end of a control tick."""
TICK_EVENT_NAME = "tick"
IDENTITY = "ehadiag_fcc"
"""What GET_ID answers: the A2L file's name without its suffix."""


class XcpIds(NamedTuple):
    """Identifiers of the two directions; those above 0x7FF have 29 bits."""

    request: int = 0x6F0
    """Of the master's commands."""
    response: int = 0x6F1
    """Of the slave's answers and measurements."""


def parse_xcp_ids(text: str) -> XcpIds:
    """Read a pair of hexadecimal identifiers, such as `6F0:6F1`."""
    try:
        request, response = (int(part, 16) for part in text.split(":"))
    except ValueError:
        request = response = -1
    return checked_xcp_ids(request, response, text)


def checked_xcp_ids(request: int, response: int, text: str = "") -> XcpIds:
    """Refuse a pair that no bus carries; text: as it was given."""
    if request == response or not all(0 <= item <= MAX_CAN_ID for item in (request, response)):
        given = repr(text) if text else f"{request:#x}, {response:#x}"
        raise ConfigurationError(
            f"XCP identifiers {given}: need two different ones in hexadecimal, such as 6F0:6F1"
        )
    return XcpIds(request, response)


def is_extended(can_id: int) -> bool:
    """Whether an identifier needs 29 bits."""
    return can_id > MAX_STANDARD_CAN_ID


class Measurement(NamedTuple):
    """One quantity in the computer's memory; value = step * (raw - zero)."""

    name: str
    meaning: str
    datatype: str
    """See `FORMATS`."""
    unit: str = ""
    step: float = 1.0
    zero: int = 0
    most: int | None = None
    """Largest raw value; None: as its type."""
    address: int = 0

    @property
    def size(self) -> int:
        """Bytes."""
        return struct.calcsize(FORMATS[self.datatype])

    @property
    def raw_ends(self) -> tuple[int, int]:
        """Least and greatest raw value."""
        bits = 8 * self.size
        low = -(1 << bits - 1) if self.datatype.startswith("S") else 0
        return low, low + (1 << bits) - 1 if self.most is None else self.most


MEASUREMENTS = (
    Measurement("tick", "control ticks since the computer started", "ULONG"),
    Measurement("bit_state", "state of the built-in test: 0 idle, 1 arming, 2 running, 3 complete,"
                " 4 aborted, 5 refused", "UBYTE"),
    Measurement("test_id", "number of the built-in test that is played; 0: none", "UBYTE"),
    Measurement("command_mode", "what is commanded: 1 a current, 2 a position", "UBYTE"),
    Measurement("command_current", "commanded current, or 0", "SLONG", "mA", 1e-6),
    Measurement("command_position", "commanded position, or 0", "SLONG", "mm", 1e-6),
    Measurement("current", "servovalve current", "UWORD"),
    Measurement("spool", "spool position", "UWORD"),
    Measurement("pressure", "differential pressure", "UWORD"),
    Measurement("position", "jack position", "UWORD"),
    Measurement("supply_pressure", "supply pressure", "ULONG", "MPa", 1e-6),
    Measurement("return_pressure", "return pressure", "ULONG", "MPa", 1e-6),
    Measurement("oil_temperature", "oil temperature", "SWORD", "degC", 0.01),
)  # fmt: skip
"""All measurements in the order of their addresses; units of the channels are of their converters,
see `measurements_of`."""


def measurements_of(channels: Channels) -> tuple[Measurement, ...]:
    """Return the measurements with addresses, the channels as their converters count."""
    out, address = [], BASE_ADDRESS
    for item in MEASUREMENTS:
        given = item
        converter = getattr(channels, item.name, None)
        if converter is not None:
            given = item._replace(
                datatype="UWORD" if converter.half <= 1 << 15 else "ULONG",
                unit=converter.unit, step=converter.lsb / converter.per_unit, zero=converter.half,
                most=2 * converter.half - 1,
            )  # fmt: skip
        address += -address % given.size
        out.append(given._replace(address=address))
        address += given.size
    return tuple(out)


def memory_of(measurements: Sequence[Measurement], values: Mapping[str, int]) -> bytes:
    """Return the computer's memory from `BASE_ADDRESS` on; values beyond their type's ends stop."""
    last = measurements[-1]
    memory = bytearray(last.address + last.size - BASE_ADDRESS)
    for item in measurements:
        low, high = item.raw_ends
        raw = min(max(values[item.name], low), high)
        struct.pack_into(FORMATS[item.datatype], memory, item.address - BASE_ADDRESS, raw)
    return bytes(memory)


class Command(IntEnum):
    """Codes of the commands that a slave answers."""

    CONNECT = 0xFF
    DISCONNECT = 0xFE
    GET_STATUS = 0xFD
    SYNCH = 0xFC
    GET_COMM_MODE_INFO = 0xFB
    GET_ID = 0xFA
    SET_MTA = 0xF6
    UPLOAD = 0xF5
    SHORT_UPLOAD = 0xF4
    CLEAR_DAQ_LIST = 0xE3
    SET_DAQ_PTR = 0xE2
    WRITE_DAQ = 0xE1
    SET_DAQ_LIST_MODE = 0xE0
    START_STOP_DAQ_LIST = 0xDE
    START_STOP_SYNCH = 0xDD
    GET_DAQ_CLOCK = 0xDC
    GET_DAQ_PROCESSOR_INFO = 0xDA
    GET_DAQ_RESOLUTION_INFO = 0xD9
    GET_DAQ_EVENT_INFO = 0xD7
    FREE_DAQ = 0xD6
    ALLOC_DAQ = 0xD5
    ALLOC_ODT = 0xD4
    ALLOC_ODT_ENTRY = 0xD3


class ErrorCode(IntEnum):
    """Why a slave refuses a command."""

    CMD_SYNCH = 0x00
    DAQ_ACTIVE = 0x11
    CMD_UNKNOWN = 0x20
    CMD_SYNTAX = 0x21
    OUT_OF_RANGE = 0x22
    ACCESS_DENIED = 0x24
    MODE_NOT_VALID = 0x27
    SEQUENCE = 0x29
    DAQ_CONFIG = 0x2A
    MEMORY_OVERFLOW = 0x30


RESPONSE, ERROR = 0xFF, 0xFE
"""First byte of an answer."""
MAX_ODTS = 0xFC
"""First bytes below are those of measurements: so many ODTs in all DAQ lists together."""
CLOCK_STEP_NS = 1000
"""Of the DAQ clock, ns."""


def event_cycle(period_ns: int) -> tuple[int, int]:
    """Return cycle and unit (10^unit ns) of an event channel; (0, 0) where a byte cannot say it."""
    for unit in range(9, -1, -1):
        cycle, rest = divmod(period_ns, 10**unit)
        if not rest and 0 < cycle < 256:
            return cycle, unit
    return 0, 0
