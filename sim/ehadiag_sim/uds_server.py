"""The emulated computer's side of UDS: its built-in test, its own result, its trouble codes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from ehadiag.core.criteria import VERDICT
from firmware_iface.bus_map import ONBOARD_SEVERITIES
from firmware_iface.live_decode import BitStatus
from firmware_iface.mapping_file import UdsIdentifiers
from firmware_iface.recording import (
    ACTIVE_BIT_STATES,
    CHANNELS,
    BitReason,
    BitState,
    OnboardState,
)
from firmware_iface.transport.frames import Frame
from firmware_iface.uds.client import IsoTpLink
from firmware_iface.uds.services import (
    DATA_RECORDS,
    FAILED_STATUS,
    NEGATIVE_RESPONSE,
    OFFSETS,
    ONBOARD_RESULT,
    POSITIVE_OFFSET,
    REFUSALS,
    SERIAL,
    SNAPSHOT_RECORD,
    SOFTWARE,
    STATUS_AVAILABILITY,
    TEST_OPTION,
    TEST_STATUS,
    TROUBLE_CODES,
    DtcReport,
    DtcStatus,
    OnboardVerdict,
    ResponseCode,
    RoutineAction,
    ServiceId,
)

if TYPE_CHECKING:
    from ehadiag_sim.emulator import FccCore

SEVERITY_STD = 1e-3
"""Standard deviation, 1, that the computer states for the severities, which it knows exactly."""
ENDED = (BitState.COMPLETE, BitState.ABORTED, BitState.REFUSED)


class NegativeResponseError(Exception):
    """A request is refused by a code."""

    def __init__(self, code: ResponseCode) -> None:
        super().__init__(code.name)
        self.code = code


class UdsServer:
    """Answers the requests that come in a tick at its beginning, one after the other.

    The result that it serves as its own is the simulated truth; of a foreign plant it has none.
    """

    def __init__(self, computer: FccCore, identifiers: UdsIdentifiers) -> None:
        self._computer = computer
        self._link = IsoTpLink(identifiers.response_id, identifiers.request_id)
        self._last: BitStatus | None = None
        self._services = {
            ServiceId.ROUTINE_CONTROL: self._routine,
            ServiceId.READ_DATA_BY_IDENTIFIER: self._data,
            ServiceId.READ_DTC_INFORMATION: self._trouble_codes,
        }

    def take(self, frame: Frame) -> None:
        """Take any frame of the bus."""
        self._link.take(frame)

    def step(self) -> list[Frame]:
        """Answer what has come, and return the frames of this tick."""
        if self._computer.state not in (BitState.IDLE, BitState.REFUSED):
            self._last = self._computer.status
        while (payload := self._link.message()) is not None:
            self._link.send(self._answer(payload))
        return self._link.frames()

    def _answer(self, payload: bytes) -> bytes:
        service = payload[0]
        try:
            if service not in self._services:
                raise NegativeResponseError(ResponseCode.SERVICE_NOT_SUPPORTED)
            answer = self._services[ServiceId(service)](payload[1:])
        except NegativeResponseError as refusal:
            return bytes([NEGATIVE_RESPONSE, service, refusal.code])
        return bytes([service + POSITIVE_OFFSET]) + answer

    def _routine(self, data: bytes) -> bytes:
        if len(data) < 3:
            raise NegativeResponseError(ResponseCode.INCORRECT_LENGTH)
        action, number, option = data[0], int.from_bytes(data[1:3], "big"), data[3:]
        if action not in set(RoutineAction):
            raise NegativeResponseError(ResponseCode.SUBFUNCTION_NOT_SUPPORTED)
        if number != TEST_STATUS.number:
            raise NegativeResponseError(ResponseCode.REQUEST_OUT_OF_RANGE)
        if len(option) != (TEST_OPTION.size if action == RoutineAction.START else 0):
            raise NegativeResponseError(ResponseCode.INCORRECT_LENGTH)
        if action == RoutineAction.START:
            self._start(round(TEST_OPTION.numbers(option)["test_id"]))
        elif action == RoutineAction.STOP:
            if self._computer.state not in ACTIVE_BIT_STATES:
                raise NegativeResponseError(ResponseCode.REQUEST_SEQUENCE_ERROR)
            self._computer.abort()
            self._last = self._computer.status
        if self._last is None:
            raise NegativeResponseError(ResponseCode.REQUEST_SEQUENCE_ERROR)
        return data[:3] + TEST_STATUS.encode(_values(self._last))

    def _start(self, test_id: int) -> None:
        computer = self._computer
        running = computer.state in ACTIVE_BIT_STATES
        reason = computer.start(test_id)
        if reason is BitReason.NONE:
            self._last = computer.status
            return
        if not running:
            serial = computer.status.serial
            self._last = BitStatus(BitState.REFUSED, reason, test_id, 0.0, serial)
        raise NegativeResponseError(REFUSALS[reason])

    def _data(self, data: bytes) -> bytes:
        if not data or len(data) % 2:
            raise NegativeResponseError(ResponseCode.INCORRECT_LENGTH)
        answer = b""
        for at in range(0, len(data), 2):
            record = DATA_RECORDS.get(int.from_bytes(data[at : at + 2], "big"))
            if record is None:
                raise NegativeResponseError(ResponseCode.REQUEST_OUT_OF_RANGE)
            answer += data[at : at + 2] + record.encode(self._record(record.number))
        return answer

    def _record(self, number: int) -> Mapping[str, float | str]:
        if number == SERIAL.number:
            return {"serial": self._computer.status.serial or 0}
        if number == SOFTWARE.number:
            return {"software": _software()}
        if number == OFFSETS.number:
            pairs = zip(CHANNELS, self._computer.offsets, strict=True)
            return {channel.name: value / channel.per_unit for channel, value in pairs}
        assert number == ONBOARD_RESULT.number
        return self._onboard()

    def _onboard(self) -> dict[str, float | str]:
        """Return the computer's own result of its last test."""
        last, truth = self._last, self._computer.faults
        done = last is not None and last.state is BitState.COMPLETE and truth is not None
        state = OnboardState.DONE if done else OnboardState.GIVEN_UP
        if last is None:
            state = OnboardState.NOTHING
        elif last.state in ACTIVE_BIT_STATES:
            state = OnboardState.RECORDING
        verdict = self._verdict()
        faults = {name: getattr(truth, name, 0.0) for name in ONBOARD_SEVERITIES}
        return {
            "state": state,
            "test_id": (last.test_id or 0) if last else 0,
            "verdict": OnboardVerdict.NOT_TESTED if verdict is None else verdict,
            "runs": 0,
            **{name: value if done else 0.0 for name, value in faults.items()},
            **{f"std_{name}": SEVERITY_STD if done else 0.0 for name in faults},
        }

    def _verdict(self) -> OnboardVerdict | None:
        """Return the verdict of the last test; None where none has ended."""
        last = self._last
        if last is None or last.state not in ENDED:
            return None
        if last.state is not BitState.COMPLETE:
            return OnboardVerdict.NOT_TESTED
        if self._computer.faults is None:
            return None
        worst = max(astuple(self._computer.faults))
        if worst < VERDICT.advisory:
            return OnboardVerdict.HEALTHY
        return OnboardVerdict.DEGRADED if worst < VERDICT.limit else OnboardVerdict.FAULT

    def _trouble_codes(self, data: bytes) -> bytes:
        report, rest = data[:1], data[1:]
        lengths = {DtcReport.BY_STATUS_MASK: 1, DtcReport.SNAPSHOT: 4, DtcReport.SUPPORTED: 0}
        if not report:
            raise NegativeResponseError(ResponseCode.INCORRECT_LENGTH)
        if report[0] not in lengths:
            raise NegativeResponseError(ResponseCode.SUBFUNCTION_NOT_SUPPORTED)
        if len(rest) != lengths[DtcReport(report[0])]:
            raise NegativeResponseError(ResponseCode.INCORRECT_LENGTH)
        verdict = self._verdict()
        unknown = DtcStatus.NOT_COMPLETED_SINCE_CLEAR
        status = {
            item.number: unknown if verdict is None else FAILED_STATUS * (verdict is item.verdict)
            for item in TROUBLE_CODES
        }
        if report[0] == DtcReport.SNAPSHOT:
            return report + self._snapshot(rest, status)
        mask = rest[0] if rest else None
        chosen = {k: v for k, v in status.items() if mask is None or v & mask}
        return report + bytes([STATUS_AVAILABILITY]) + b"".join(map(_dtc, chosen.items()))

    def _snapshot(self, data: bytes, status: Mapping[int, int]) -> bytes:
        """Return code and status, and the snapshot where the code is set."""
        number, record = int.from_bytes(data[:3], "big"), data[3]
        if number not in status or record not in (SNAPSHOT_RECORD, 0xFF):
            raise NegativeResponseError(ResponseCode.REQUEST_OUT_OF_RANGE)
        answer = _dtc((number, status[number]))
        if status[number] & DtcStatus.TEST_FAILED:
            answer += bytes([SNAPSHOT_RECORD, 1]) + ONBOARD_RESULT.number.to_bytes(2, "big")
            answer += ONBOARD_RESULT.encode(self._onboard())
        return answer


def _values(status: BitStatus) -> dict[str, float | str]:
    return {
        "state": status.state,
        "reason": status.reason,
        "test_id": status.test_id or 0,
        "elapsed": status.elapsed,
        "serial": status.serial or 0,
    }


def _dtc(pair: tuple[int, int]) -> bytes:
    number, status = pair
    return number.to_bytes(3, "big") + bytes([status])


def _software() -> str:
    try:
        return f"ehadiag {version('ehadiag')}"
    except PackageNotFoundError:
        return "ehadiag"
