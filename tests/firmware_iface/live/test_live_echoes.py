"""A sender's own frames that an interface echoes are not taken for somebody else's."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import can
import pytest

from firmware_iface.transport import python_can as pythoncan
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.python_can import BusOptions, PythonCanTransport, message_of


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
