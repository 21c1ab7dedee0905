"""A second sender while a test runs: the test is aborted, and the answer names it.

A sender's own frames that an interface echoes are not taken for somebody else's.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator

import can
import pytest
from fault_cases import DURATION, NUMBER, TELEMETRY
from msgspec.structs import replace

from ehadiag_sim.emulator import EmulatorTransport, FccCore
from firmware_iface import tester
from firmware_iface.codec import Encoder
from firmware_iface.handshake import Handshake, HandshakeAction, Phase
from firmware_iface.live_decode import BitStatus
from firmware_iface.recording import BitState
from firmware_iface.transport import python_can as pythoncan
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.python_can import PythonCanTransport, message_of

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


def outcome_of(make_core: Callable[..., FccCore], beside: Beside) -> tester.RequestOutcome:
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
    assert actions == [HandshakeAction.ABORT]
    machine.on_status(300 * MS, BitStatus(BitState.ABORTED, test_id=1, serial=7))
    machine.on_time(400 * MS)
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


class ScriptedBus:
    """Gives what the test put in; remembers with which time limits it was asked."""

    def __init__(self) -> None:
        self.incoming: deque[can.Message] = deque()
        self.waits: list[float] = []
        self.sent: list[can.Message] = []

    def recv(self, timeout: float) -> can.Message | None:
        self.waits.append(timeout)
        return self.incoming.popleft() if self.incoming else None

    def send(self, message: can.Message, **_: float) -> None:
        self.sent.append(message)

    def shutdown(self) -> None:
        return


Opened = Callable[[str], tuple[PythonCanTransport, ScriptedBus]]


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Opened:
    def make(interface: str) -> tuple[PythonCanTransport, ScriptedBus]:
        bus = ScriptedBus()
        monkeypatch.setattr(pythoncan, "open_bus", lambda *_, **__: bus)
        return PythonCanTransport(BusOptions(interface), transmit=True), bus

    return make


def frame(k: int) -> Frame:
    return Frame(k * 1000, 0x200, bytes([k] * 8))


def read(transport: PythonCanTransport) -> list[int]:
    """Numbers of the frames until the transport says that no more came."""
    got = []
    while (item := transport.receive(0.5)) is not None:
        got.append(item.data[0])
    return got


def test_own_frames_are_skipped_and_those_of_others_behind_them_come(opened: Opened) -> None:
    transport, bus = opened("udp_multicast")
    for k in (1, 2, 3):
        transport.send(frame(k))
    bus.incoming.extend(message_of(frame(k)) for k in (1, 2, 9, 3, 8))
    # None means an empty bus: a reader that gets it before 9 would wait while 9 grows old.
    assert transport.receive(0.5) == frame(9)
    assert transport.receive(0.5) == frame(8)
    assert transport.receive(0.5) is None


def test_nothing_is_waited_for_behind_an_own_frame(opened: Opened) -> None:
    transport, bus = opened("udp_multicast")
    transport.send(frame(1))
    bus.incoming.append(message_of(frame(1)))
    assert transport.receive(0.5) is None
    assert bus.waits == [0.5, 0.0]


def test_a_frame_like_an_own_one_is_skipped_only_as_often_as_it_was_sent(opened: Opened) -> None:
    transport, bus = opened("udp_multicast")
    transport.send(frame(5))
    bus.incoming.extend(message_of(frame(5)) for _ in range(3))
    assert read(transport) == [5, 5]  # another sender's


def test_echoes_that_were_lost_do_not_stand_in_the_way(opened: Opened) -> None:
    transport, bus = opened("udp_multicast")
    for k in range(6):
        transport.send(frame(k))
    bus.incoming.extend(message_of(frame(k)) for k in (2, 5, 7))
    assert read(transport) == [7]
    # 0, 1, 3 and 4 were lost: a frame like one of them now is another sender's.
    bus.incoming.append(message_of(frame(1)))
    assert read(transport) == [1]


def test_the_same_payload_under_another_identifier_is_none_of_ours(opened: Opened) -> None:
    transport, bus = opened("udp_multicast")
    transport.send(frame(1))
    bus.incoming.append(message_of(Frame(0, 0x201, frame(1).data)))
    assert read(transport) == [1]


def test_interfaces_without_echoes_hand_on_every_frame(opened: Opened) -> None:
    transport, bus = opened("socketcan")
    transport.send(frame(1))
    bus.incoming.append(message_of(frame(1)))
    assert read(transport) == [1]


def test_echoes_that_never_come_are_forgotten(opened: Opened) -> None:
    transport, _ = opened("udp_multicast")
    for k in range(5000):
        transport.send(frame(k % 256))
    assert transport._echoes is not None
    assert len(transport._echoes._expected) == 4096
