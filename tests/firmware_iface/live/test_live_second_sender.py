"""A second sender while a test runs: the test is aborted, and the answer names it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import pytest
from fault_cases import DURATION, NUMBER, TELEMETRY

from ehadiag.core.recording import BitState
from ehadiag_sim.fcc.computer import FccCore
from ehadiag_sim.fcc.emulator import EmulatorTransport
from firmware_iface.codec.encode import Encoder
from firmware_iface.codec.live_messages import BitStatus
from firmware_iface.session import tester
from firmware_iface.session.handshake import Action, Handshake, Phase
from firmware_iface.transport.frames import Frame

STATUS = 0x201
MS = 1_000_000
Beside = Callable[[Frame], Iterable[Frame]]


class SharedBus(EmulatorTransport):
    """The computer's bus, with what somebody else sends after each of its frames."""

    def __init__(self, core: FccCore, beside: Beside) -> None:
        super().__init__(core)
        self._beside = beside
        self._waiting: list[Frame] = []

    def _receive(self, timeout: float) -> Frame | None:
        if self._waiting:
            return self._waiting.pop(0)
        frame = super()._receive(timeout)
        if frame is not None:
            self._waiting = list(self._beside(frame))
        return frame


def outcome_of(make_core: Callable[..., FccCore], beside: Beside) -> tester.TesterOutcome:
    with SharedBus(make_core(), beside) as bus:
        return tester.run_test(bus, test_id=NUMBER, duration=DURATION, transmit=True)


OURS = Encoder()


def equal(frame: Frame) -> Iterator[Frame]:
    if frame.can_id == TELEMETRY:
        yield OURS.telemetry((9, 9, 9, 9), frame.time_ns + 50_000, frame.data[6])[0]


def shifted(frame: Frame) -> Iterator[Frame]:
    if frame.can_id == TELEMETRY:
        yield OURS.telemetry((9, 9, 9, 9), frame.time_ns + 50_000, (frame.data[6] + 60) % 256)[0]


def other_serial(frame: Frame) -> Iterator[Frame]:
    if frame.can_id == STATUS and frame.data[0] == BitState.RUNNING:
        yield OURS.status(2, 0, NUMBER, 0.001 * frame.data[2], 78, frame.time_ns + 50_000)[0]


def repeated(frame: Frame) -> Iterator[Frame]:
    yield replace(frame, time_ns=frame.time_ns + 50_000)


@pytest.mark.parametrize("beside", [equal, shifted])
def test_telemetry_of_a_second_sender_ends_the_test(make_core, beside: Beside) -> None:
    outcome = outcome_of(make_core, beside)
    assert not outcome.complete
    assert "a second sender of ServoTelemetry (0x110)" in outcome.why


def test_status_of_a_second_actuator_ends_the_test(make_core) -> None:
    outcome = outcome_of(make_core, other_serial)
    assert not outcome.complete
    assert "status of two actuators, serial" in outcome.why
    assert outcome.abort_confirmed is not None


def test_repeated_frames_end_nothing(make_core) -> None:
    assert outcome_of(make_core, repeated).why == ""


def running() -> Handshake:
    machine = Handshake(test_id=1, duration=5.0, transmit=True, now=0)
    machine.on_time(100 * MS)
    machine.on_status(110 * MS, BitStatus(BitState.RUNNING, test_id=1, serial=7))
    assert machine.phase is Phase.RUNNING
    return machine


def test_a_second_time_base_is_named() -> None:
    machine, actions = running(), []
    for k in range(1, 6):
        for ahead in (0.0, 0.4):
            status = BitStatus(BitState.RUNNING, test_id=1, elapsed=0.02 * k + ahead, serial=7)
            actions += machine.on_status(110 * MS + 20 * k * MS, status)
    assert actions == [Action.ABORT]
    machine.on_status(300 * MS, BitStatus(BitState.ABORTED, test_id=1, serial=7))
    assert machine.verdict is not None
    assert "two time bases" in machine.verdict.why


def test_one_damaged_status_is_borne() -> None:
    machine = running()
    odd = BitStatus(BitState.RUNNING, test_id=1, elapsed=0.02, serial=9)
    sound = BitStatus(BitState.RUNNING, test_id=1, elapsed=0.04, serial=7)
    assert machine.on_status(130 * MS, odd) == []
    assert machine.on_status(150 * MS, sound) == []
    assert machine.phase is Phase.RUNNING


@pytest.mark.parametrize("phase", [Phase.SETTLING, Phase.TRAILING])
def test_before_and_after_a_test_nothing_is_aborted(phase: Phase) -> None:
    machine = Handshake(test_id=1, duration=5.0, transmit=True, now=0)
    machine.phase = phase
    assert machine.on_second_sender(0, "a second sender") == []
    assert machine.verdict is not None
    assert machine.verdict.why == "a second sender"
