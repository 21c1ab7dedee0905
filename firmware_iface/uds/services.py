"""What a flight-control computer serves by UDS: routine, data, trouble codes, negative responses.

Server, client, PDX and the reference page are all made of these records.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum

import msgspec

from firmware_iface.bus_map import ONBOARD_SEVERITIES
from firmware_iface.recording import CHANNELS, BitReason, BitState, OnboardState

TEXT_FILL = b"\0"
"""What follows a text in its field."""


class DataField(msgspec.Struct, frozen=True):
    """One value of a record, big-endian: value = number * scale, or a text."""

    name: str
    size: int
    """Bytes."""
    scale: float = 1.0
    unit: str = ""
    signed: bool = False
    text: bool = False
    names: type[IntEnum] | None = None
    """Meanings of the numbers; None: it is a quantity."""
    meaning: str = ""

    def encode(self, value: float | str) -> bytes:
        """Return the bytes of a value, which ends at the largest that fits."""
        if isinstance(value, str):
            return value.encode("ascii", "replace")[: self.size].ljust(self.size, TEXT_FILL)
        low = -(1 << 8 * self.size - 1) if self.signed else 0
        most = low + (1 << 8 * self.size) - 1
        number = min(max(round(value / self.scale), low), most)
        return number.to_bytes(self.size, "big", signed=self.signed)

    def decode(self, data: bytes) -> float | str:
        """Return the value of the bytes."""
        if self.text:
            return data.rstrip(TEXT_FILL).decode("ascii", "replace")
        number = int.from_bytes(data, "big", signed=self.signed)
        return number if self.scale == 1.0 else number * self.scale


class DataRecord(msgspec.Struct, frozen=True):
    """Fields that follow one another in a payload, under a number of their own."""

    name: str
    number: int
    fields: tuple[DataField, ...]
    meaning: str = ""

    @property
    def size(self) -> int:
        """Length of all fields, bytes."""
        return sum(item.size for item in self.fields)

    def encode(self, values: Mapping[str, float | str]) -> bytes:
        """Return the payload of the values, which all have to be there."""
        return b"".join(item.encode(values[item.name]) for item in self.fields)

    def decode(self, data: bytes) -> dict[str, float | str]:
        """Return the values of a payload; ValueError: it is shorter or longer than the record."""
        if len(data) != self.size:
            raise ValueError(f"{self.name}: {len(data)} bytes, need {self.size}")
        values, at = {}, 0
        for item in self.fields:
            values[item.name] = item.decode(data[at : at + item.size])
            at += item.size
        return values

    def numbers(self, data: bytes) -> dict[str, float]:
        """Return the values of a payload without its texts; ValueError: see `decode`."""
        return {
            key: value for key, value in self.decode(data).items() if not isinstance(value, str)
        }


class ServiceId(IntEnum):
    """Services of the computer, all in the default session."""

    READ_DTC_INFORMATION = 0x19
    READ_DATA_BY_IDENTIFIER = 0x22
    ROUTINE_CONTROL = 0x31


NEGATIVE_RESPONSE = 0x7F
"""First byte of a negative response; the service and its `ResponseCode` follow."""
POSITIVE_OFFSET = 0x40
"""What the first byte of a positive response is above the service."""


class RoutineAction(IntEnum):
    """What 0x31 does with the routine."""

    START = 0x01
    STOP = 0x02
    RESULTS = 0x03


class DtcReport(IntEnum):
    """Reports of 0x19."""

    BY_STATUS_MASK = 0x02
    SNAPSHOT = 0x04
    SUPPORTED = 0x0A


class OnboardVerdict(IntEnum):
    """Verdict of the computer itself (BUS-18)."""

    HEALTHY = 0
    DEGRADED = 10
    FAULT = 20
    NOT_TESTED = 30


_TEST_ID = DataField("test_id", 1, meaning="number of the stored test")

TEST_OPTION = DataRecord("BuiltInTestOption", 0x0201, (_TEST_ID,), "option of a start")
"""Routine 0x0201 and what its start takes."""
TEST_STATUS = DataRecord(
    "BuiltInTest",
    TEST_OPTION.number,
    (
        DataField("state", 1, names=BitState, meaning="state of the test (BUS-10)"),
        DataField("reason", 1, names=BitReason, meaning="why it was refused (BUS-11)"),
        _TEST_ID,
        DataField("elapsed", 2, 1e-3, "s", meaning="since the test began to run"),
        DataField("serial", 2, meaning="serial number of the actuator"),
    ),
    "state of the last test",
)
"""What start, stop and results of the routine answer."""

SERIAL = DataRecord(
    "ActuatorSerialNumber", 0xF18C, (TEST_STATUS.fields[-1],), "identity of the actuator"
)
SOFTWARE = DataRecord(
    "SoftwareVersion",
    0xF195,
    (DataField("software", 16, text=True, meaning="ASCII, filled up by 0"),),
    "version of the computer's software",
)
ONBOARD_RESULT = DataRecord(
    "OnboardResult",
    0x0120,
    (
        DataField("state", 1, names=OnboardState, meaning="how far it is (BUS-17)"),
        _TEST_ID,
        DataField("verdict", 1, names=OnboardVerdict, meaning="verdict of the computer"),
        DataField("runs", 2, meaning="runs of the model"),
        *(DataField(name, 3, 1e-7, "1", meaning="severity") for name in ONBOARD_SEVERITIES),
        *(
            DataField(f"std_{name}", 3, 1e-7, "1", meaning="standard deviation; 0: no estimate")
            for name in ONBOARD_SEVERITIES
        ),
    ),
    "what the computer has found itself in its last test",
)
OFFSETS = DataRecord(
    "SensorOffsets",
    0x0121,
    tuple(
        DataField(channel.name, 2, scale, channel.unit, signed=True, meaning="offset of the sensor")
        for channel, scale in zip(CHANNELS, (5e-4, 2e-5, 1e-3, 2e-3), strict=True)
    ),
    "offsets of the sensors that the computer knows",
)
DATA_RECORDS = {item.number: item for item in (ONBOARD_RESULT, OFFSETS, SERIAL, SOFTWARE)}
"""Answers of 0x22 by their identifiers."""

SNAPSHOT_RECORD = 1
"""Number of the only snapshot of a trouble code; it holds `ONBOARD_RESULT`."""


class TroubleCode(msgspec.Struct, frozen=True):
    """A trouble code of 0x19: set while the computer's last test ended so."""

    number: int
    """Three bytes, the last one the failure type."""
    verdict: OnboardVerdict
    meaning: str

    @property
    def code(self) -> str:
        """Return the code as it is displayed, such as `C1A01-00`."""
        high = self.number >> 16
        low = f"{self.number >> 8 & 0xFF:02X}-{self.number & 0xFF:02X}"
        return f"{'PCBU'[high >> 6]}{high >> 4 & 3}{high & 0xF:X}{low}"


TROUBLE_CODES = (
    TroubleCode(0x5A0100, OnboardVerdict.DEGRADED, "a severity is above its advisory level"),
    TroubleCode(0x5A0200, OnboardVerdict.FAULT, "a severity is above its limit"),
    TroubleCode(0x5A0300, OnboardVerdict.NOT_TESTED, "the last test was refused or aborted"),
)


class DtcStatus(IntEnum):
    """Bits of a trouble code's status that the computer knows."""

    TEST_FAILED = 0x01
    CONFIRMED = 0x08
    NOT_COMPLETED_SINCE_CLEAR = 0x10


STATUS_AVAILABILITY = sum(DtcStatus)
FAILED_STATUS = DtcStatus.TEST_FAILED | DtcStatus.CONFIRMED


class ResponseCode(IntEnum):
    """Negative responses of the computer."""

    SERVICE_NOT_SUPPORTED = 0x11
    SUBFUNCTION_NOT_SUPPORTED = 0x12
    INCORRECT_LENGTH = 0x13
    BUSY_REPEAT_REQUEST = 0x21
    CONDITIONS_NOT_CORRECT = 0x22
    REQUEST_SEQUENCE_ERROR = 0x24
    REQUEST_OUT_OF_RANGE = 0x31
    RESPONSE_PENDING = 0x78


REFUSALS = {
    BitReason.ALREADY_RUNNING: ResponseCode.BUSY_REPEAT_REQUEST,
    BitReason.UNKNOWN_TEST: ResponseCode.REQUEST_OUT_OF_RANGE,
    BitReason.SUPPLY_PRESSURE_LOW: ResponseCode.CONDITIONS_NOT_CORRECT,
    BitReason.OIL_TOO_COLD: ResponseCode.CONDITIONS_NOT_CORRECT,
    BitReason.NOT_CENTRED: ResponseCode.CONDITIONS_NOT_CORRECT,
    BitReason.INTERLOCK_OPEN: ResponseCode.CONDITIONS_NOT_CORRECT,
}
"""Negative response to a start that is refused; the routine's results then say the reason."""
