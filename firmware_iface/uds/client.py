"""A tester's side of UDS: requests of a built-in test, answers of the flight-control computer.

It has no bus and no clock: `firmware_iface.tester` passes it frames and the time, sends its frames.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Sequence

import msgspec
from msgspec.structs import replace

from firmware_iface.bus_map import ONBOARD_SEVERITIES
from firmware_iface.errors import ConfigurationError, install_command
from firmware_iface.handshake import MIN_CONTRADICTIONS, HandshakeAction
from firmware_iface.live_decode import BitRequest, BitStatus
from firmware_iface.mapping_file import UdsIdentifiers
from firmware_iface.recording import (
    CHANNELS,
    MAX_STANDARD_CAN_ID,
    BitReason,
    BitState,
    OnboardResult,
    OnboardState,
)
from firmware_iface.transport.frames import Frame
from firmware_iface.uds.services import (
    FAILED_STATUS,
    OFFSETS,
    ONBOARD_RESULT,
    REFUSALS,
    SERIAL,
    SOFTWARE,
    TEST_OPTION,
    TEST_STATUS,
    TROUBLE_CODES,
    DataRecord,
    DtcReport,
    ResponseCode,
    RoutineAction,
    ServiceId,
)

try:
    import isotp
    from udsoncan.Request import Request
    from udsoncan.Response import Response
    from udsoncan.services.ReadDataByIdentifier import ReadDataByIdentifier
    from udsoncan.services.RoutineControl import RoutineControl
except ImportError:
    raise ConfigurationError(
        f"protocol uds: needs can-isotp and udsoncan: {install_command('uds')}"
    ) from None

LOGGER = logging.getLogger(__name__)
LOGGER.addHandler(logging.NullHandler())  # keeps damaged messages off standard error
PADDING = 0xCC
"""Byte that fills up a frame of 8 bytes (ISO 15765-2)."""
MAX_MESSAGE_BYTES = 1024
"""Longest message that is received; the computer's longest answer has some 30 bytes."""


class IsoTpLink:
    """Carries messages in frames of one identifier each way (ISO 15765-2), padded to 8 bytes.

    send_id: identifier of the frames sent; receive_id: of the frames received; if one is above
    0x7FF, both have 29 bits.
    """

    def __init__(self, send_id: int, receive_id: int) -> None:
        self._extended = max(send_id, receive_id) > MAX_STANDARD_CAN_ID
        modes = isotp.AddressingMode
        mode = modes.Normal_29bits if self._extended else modes.Normal_11bits
        self._received: deque[isotp.CanMessage] = deque()
        self._sent: list[Frame] = []
        self._layer = isotp.TransportLayerLogic(
            rxfn=lambda _: self._received.popleft() if self._received else None,
            txfn=self._send_frame,
            address=isotp.Address(mode, txid=send_id, rxid=receive_id),
            error_handler=lambda _: None,  # a damaged or cut-off message is dropped
            params={
                "tx_padding": PADDING,
                "max_frame_size": MAX_MESSAGE_BYTES,
                "blocksize": 0,
                "logger_name": LOGGER.name,
            },
        )
        self._receive_id = receive_id

    def take(self, frame: Frame) -> bool:
        """Take a frame of the receive identifier; return False for any other."""
        if (frame.can_id, frame.extended) != (self._receive_id, self._extended):
            return False
        if not (frame.error or frame.remote or frame.fd):
            data = frame.data
            self._received.append(
                isotp.CanMessage(frame.can_id, len(data), data, extended_id=frame.extended)
            )
        return True

    def send(self, payload: bytes) -> None:
        """Queue a message; `frames` returns its frames."""
        self._layer.send(payload)

    def frames(self) -> list[Frame]:
        """Advance the transport, and return the frames to send now, without time stamps."""
        self._layer.process()
        sent, self._sent = self._sent, []
        return sent

    def message(self) -> bytes | None:
        """Return the next message that arrived whole; None: there is none yet."""
        self._layer.process()
        payload = self._layer.recv()
        return None if payload is None else bytes(payload)

    def _send_frame(self, message: isotp.CanMessage) -> None:
        self._sent.append(
            Frame(0, message.arbitration_id, bytes(message.data), message.is_extended_id)
        )


POLL_PERIOD_NS = 20_000_000
"""Time between requests of the routine's results: the period of `BitStatus` (BUS-4)."""
RESPONSE_LIMIT_NS, MAX_RESPONSE_LIMIT_NS = 150_000_000, 1_000_000_000
"""First and largest limit of the wait for an answer: 50 ms for the computer (P2 of ISO 14229-2) and
100 ms of reserve; each answer that does not come doubles the limit."""
PENDING_LIMIT_NS = 5_000_000_000
"""Longest wait for the answer after `RESPONSE_PENDING` (P2* of ISO 14229-2)."""
ONBOARD_PERIOD_NS = 100_000_000
"""Time between requests of the computer's own result while it identifies."""
MAX_ATTEMPTS = 3
"""Requests of one record without an answer, 1, after which it is left out."""

REFUSAL_REASONS: dict[int, BitReason] = {REFUSALS[reason]: reason for reason in REFUSALS}
REFUSAL_REASONS[ResponseCode.CONDITIONS_NOT_CORRECT] = BitReason.NONE
"""Reason behind a negative response to a start; NONE: the routine's results state the reason."""
BUSY_ONBOARD = (OnboardState.RECORDING, OnboardState.IDENTIFYING)


class _Exchange(msgspec.Struct, frozen=True):
    """A request, and the answer that it expects; not_before: earliest time to send it, ns."""

    service: ServiceId
    payload: bytes
    echo: bytes = b""
    """First bytes of the positive answer after its service identifier."""
    action: RoutineAction | None = None
    record: DataRecord | None = None
    attempts: int = 1
    not_before: int = 0


class UdsClient:
    """Requests a test by RoutineControl (0x31) and polls its results; one request at a time.

    A stop is sent at once, though an answer is still due. Any frame on the request identifier that
    comes from the bus is another tester's.

    second_sender: evidence that another node answers in the computer's place; empty if there is
    none; pending: the last frame postponed the answer to the start; notes: identification data of
    the computer after a test, one sentence each.
    """

    second_sender: str
    pending: bool
    notes: tuple[str, ...]

    def __init__(self, identifiers: UdsIdentifiers) -> None:
        self._identifiers = identifiers
        self._link = IsoTpLink(identifiers.request_id, identifiers.response_id)
        self._queue: deque[_Exchange] = deque()
        self._open: _Exchange | None = None
        self._open_until = 0
        self._answer_limit = RESPONSE_LIMIT_NS
        self._next_poll = 0
        self._polls = True
        self._started = False
        self._start_unanswered = False
        self._refused: ResponseCode | None = None
        self._test_id = 0
        self._last_answer = b""
        self._unsolicited = 0
        self._given_up = 0
        self._onboard: OnboardResult | None = None
        self._facts: dict[str, str] = {}
        self.second_sender, self.pending, self.notes = "", False, ()

    def request(self, action: HandshakeAction, test_id: int, now: int) -> Sequence[Frame]:
        """Return the frames that stop a test; a start waits for its turn in `due`."""
        option = b""
        if action is HandshakeAction.START:
            self._test_id = test_id
            option = TEST_OPTION.encode({"test_id": test_id})
            self._queue.append(_routine(RoutineAction.START, option))
            return ()
        self._queue.clear()
        self._start_unanswered, self._refused = False, None
        self._given_up += self._open is not None
        self._send(_routine(RoutineAction.STOP), now)
        return self._link.frames()

    def take(self, frame: Frame, now: int) -> list[BitStatus | BitRequest]:
        """Take a frame of the bus, and return the statuses and requests of a test in it."""
        ids, self.pending = self._identifiers, False
        if (frame.can_id, frame.extended) == (ids.request_id, ids.extended):
            return [BitRequest("", 0)]
        found: list[BitStatus | BitRequest] = []
        if self._link.take(frame):
            self._open_until = max(self._open_until, now + self._answer_limit)
            while (payload := self._link.message()) is not None:
                found += self._answered(payload, now)
        return found

    def due(self, now: int) -> Sequence[Frame]:
        """Return the frames to send now; to be called after each frame and when time passes."""
        unanswered = self._open
        if unanswered is not None and now >= self._open_until:
            self._open, self._given_up = None, self._given_up + 1
            # Else each answer of a slow computer would be cut off by the next request.
            self._answer_limit = min(2 * self._answer_limit, MAX_RESPONSE_LIMIT_NS)
            if unanswered.action is None and unanswered.attempts < MAX_ATTEMPTS:
                self._queue.append(replace(unanswered, attempts=unanswered.attempts + 1))
        if self._open is None:
            if self._queue and now >= self._queue[0].not_before:
                self._send(self._queue.popleft(), now)
            elif self._polls and now >= self._next_poll:
                self._next_poll = now + POLL_PERIOD_NS
                self._send(_routine(RoutineAction.RESULTS), now)
        return self._link.frames()

    def request_results(self) -> None:
        """Queue requests of the computer's own result, sensor offsets, identity, trouble codes."""
        self._polls = False
        self._queue.clear()
        self._queue.extend(_data(item) for item in (ONBOARD_RESULT, OFFSETS, SERIAL, SOFTWARE))
        report, mask = DtcReport.BY_STATUS_MASK, FAILED_STATUS
        self._queue.append(
            _Exchange(
                ServiceId.READ_DTC_INFORMATION,
                bytes([ServiceId.READ_DTC_INFORMATION, report, mask]),
                bytes([report]),
            )
        )

    @property
    def awaited(self) -> bool:
        """Whether a request still waits for its turn or its answer."""
        return bool(self._queue) or self._open is not None

    def onboard(self, test_id: int | None) -> OnboardResult | None:
        """Return the computer's own result of a test; None: there is none."""
        found = self._onboard
        return found if found is not None and found.is_of(test_id) else None

    def withdraw(self) -> None:
        """Remove a start that still waits for its turn."""
        waiting = [item for item in self._queue if item.action is not RoutineAction.START]
        self._queue = deque(waiting)

    def _send(self, exchange: _Exchange, now: int) -> None:
        if exchange.action is RoutineAction.START:
            self._started = self._start_unanswered = True
        self._open, self._open_until = exchange, now + self._answer_limit
        self._link.send(exchange.payload)

    def _answered(self, payload: bytes, now: int) -> list[BitStatus | BitRequest]:
        """Take an answer of the computer, and return the statuses of the test in it."""
        exchange = self._open
        response = Response.from_payload(payload)
        repeated, self._last_answer = payload == self._last_answer, payload
        if exchange is None or not _answers(exchange, response):
            if not repeated:
                self._count_unsolicited()
            return []
        code = response.code
        if code == ResponseCode.RESPONSE_PENDING:
            self._open_until = now + PENDING_LIMIT_NS
            self.pending = exchange.action is RoutineAction.START
            return []
        self._open, self._answer_limit = None, RESPONSE_LIMIT_NS
        data = (response.data or b"")[len(exchange.echo) :]
        if exchange.action is not None:
            return self._of_routine(exchange.action, data if response.positive else None, code)
        if response.positive:
            self._keep(exchange, data, now)
        return []

    def _count_unsolicited(self) -> None:
        """Count an answer without a request, unless it may be a late one that was given up."""
        if self._given_up:
            self._given_up -= 1
            return
        self._unsolicited += 1
        if self._unsolicited >= MIN_CONTRADICTIONS:
            self.second_sender = (
                f"unsolicited answers of {self._identifiers.response_id:#x}: a second sender on the"
                " bus"
            )

    def _of_routine(
        self, action: RoutineAction, data: bytes | None, code: int | None
    ) -> list[BitStatus | BitRequest]:
        status = None if data is None else _status(data)
        nothing_runs = data is None and code == ResponseCode.REQUEST_SEQUENCE_ERROR
        of_start = action is RoutineAction.START
        # A negative response names no action; results are refused by REQUEST_SEQUENCE_ERROR alone.
        if data is None and (of_start or (self._start_unanswered and not nothing_runs)):
            return self._refusal(code or 0)
        self._start_unanswered = self._start_unanswered and not of_start
        if nothing_runs:
            status = BitStatus(BitState.IDLE, test_id=None)
        refused, self._refused = self._refused, None
        if refused is not None and (status is None or status.reason is BitReason.NONE):
            return [_refused(self._test_id, refused)]
        if status is None:
            return []
        if status.state is BitState.REFUSED and not self._started:
            status = replace(status, state=BitState.IDLE)  # it refused an earlier request
        return [status]

    def _refusal(self, code: int) -> list[BitStatus | BitRequest]:
        reason, self._start_unanswered = REFUSAL_REASONS.get(code), False
        if reason is BitReason.NONE:
            self._refused, self.pending = ResponseCode(code), True
            self._queue.append(_routine(RoutineAction.RESULTS))
            return []
        if reason is not None:
            return [BitStatus(BitState.REFUSED, reason, self._test_id)]
        return [_refused(self._test_id, code)]

    def _keep(self, exchange: _Exchange, data: bytes, now: int) -> None:
        """Keep a record of the computer's result or identity; a damaged one is left out."""
        try:
            if exchange.record is None:
                self._facts["trouble codes"] = _trouble_codes(data[1:])
            elif exchange.record is ONBOARD_RESULT:
                values = ONBOARD_RESULT.numbers(data)
                if values["state"] in BUSY_ONBOARD:
                    self._queue.append(replace(exchange, not_before=now + ONBOARD_PERIOD_NS))
                elif values["state"] == OnboardState.DONE:
                    self._onboard = _onboard_result(values)
            elif exchange.record is OFFSETS:
                offsets = OFFSETS.numbers(data)
                self._facts["sensor offsets"] = ", ".join(
                    f"{item.name} {offsets[item.name]:.4g} {item.unit}" for item in CHANNELS
                )
            else:
                (name, value), *_ = exchange.record.decode(data).items()
                self._facts[name] = str(value)
        except ValueError:
            return
        text = "; ".join(f"{name} {value}" for name, value in sorted(self._facts.items()) if value)
        self.notes = (f"flight-control computer: {text}",) if text else ()


def _routine(action: RoutineAction, option: bytes = b"") -> _Exchange:
    request = RoutineControl.make_request(TEST_STATUS.number, action, option)
    payload = bytes(request.get_payload())
    return _Exchange(ServiceId.ROUTINE_CONTROL, payload, payload[1:4], action=action)


def _data(record: DataRecord) -> _Exchange:
    number = record.number.to_bytes(2, "big")
    request = Request(ReadDataByIdentifier, data=number)
    return _Exchange(
        ServiceId.READ_DATA_BY_IDENTIFIER, bytes(request.get_payload()), number, record=record
    )


def _answers(exchange: _Exchange, response: Response) -> bool:
    """Whether a response can be the answer to a request."""
    if not response.valid or response.service is None:
        return False
    if response.service.request_id() != exchange.service:
        return False
    return not response.positive or (response.data or b"").startswith(exchange.echo)


def _status(data: bytes) -> BitStatus | None:
    """Return the status in a routine's answer; None: it is damaged."""
    try:
        values = TEST_STATUS.numbers(data)
        return BitStatus(
            BitState(round(values["state"])),
            BitReason(round(values["reason"])),
            round(values["test_id"]),
            values["elapsed"],
            round(values["serial"]),
        )
    except ValueError:
        return None


def _refused(test_id: int, code: int) -> BitStatus:
    """Return a refusal whose only reason is the code of a negative response."""
    known = code in set(ResponseCode)
    name = ResponseCode(code).name.lower().replace("_", " ") if known else "negative response"
    return BitStatus(BitState.REFUSED, test_id=test_id, refusal=f"{name} ({code:#04x})")


def _onboard_result(values: dict[str, float]) -> OnboardResult:
    std = {name: values[f"std_{name}"] for name in ONBOARD_SEVERITIES}
    return OnboardResult(
        test_id=round(values["test_id"]),
        verdict=round(values["verdict"]),
        runs=round(values["runs"]),
        severities={name: values[name] if std[name] > 0.0 else math.nan for name in std},
        std={name: value if value > 0.0 else math.nan for name, value in std.items()},
    )


def _trouble_codes(data: bytes) -> str:
    """Return the codes that are set, from pairs of a code and its status."""
    known = {item.number: item for item in TROUBLE_CODES}
    texts = []
    for at in range(0, len(data) - len(data) % 4, 4):
        number = int.from_bytes(data[at : at + 3], "big")
        code = known.get(number)
        texts.append(
            f"{number:06X}"
            if code is None
            else f"{code.code} {code.verdict.name.replace('_', ' ')}"
        )
    return ", ".join(texts)
