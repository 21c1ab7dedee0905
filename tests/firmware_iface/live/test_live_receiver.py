"""Receive thread: order, overflow, errors that reach the reader, a clean stop."""

from __future__ import annotations

import threading
import time
from collections import deque

import pytest

from ehadiag.core.errors import BusLostError, InputOutputError
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.interface import Transport, TransportState
from firmware_iface.transport.receiver import DirectReader, Receiver, open_source


def frame(number: int) -> Frame:
    return Frame(number, 0x100, number.to_bytes(4, "big"))


class Scripted(Transport):
    """Hands out frames, then an error or silence."""

    def __init__(self, frames: int, error: Exception | None = None) -> None:
        super().__init__("scripted", transmit=False)
        self._frames = deque(frame(k) for k in range(frames))
        self._error = error

    def _receive(self, timeout: float) -> Frame | None:
        if self._frames:
            return self._frames.popleft()
        if self._error is not None:
            raise self._error
        time.sleep(min(timeout, 0.005))
        return None

    def _send(self, frame: Frame) -> None:
        raise AssertionError(f"not asked to send {frame}")

    def _close(self) -> None:
        self._frames.clear()


def drain(receiver: Receiver | DirectReader, count: int) -> list[Frame]:
    got = []
    deadline = time.monotonic() + 5
    while len(got) < count and time.monotonic() < deadline:
        item = receiver.receive(0.2)
        if item is not None:
            got.append(item)
    return got


def test_frames_come_in_order_and_all() -> None:
    with Receiver(Scripted(5000)) as receiver:
        assert drain(receiver, 5000) == [frame(k) for k in range(5000)]
        assert receiver.receive(0.0) is None
        assert receiver.state is TransportState.OPEN
        assert receiver.overflow == 0
    assert receiver.state is TransportState.CLOSED


def test_an_overflow_is_counted_and_said_and_the_sink_still_sees_every_frame() -> None:
    seen: list[Frame] = []
    idle = threading.Event()
    with Receiver(Scripted(100), sink=seen.append, idle=idle.set, capacity=10) as receiver:
        assert idle.wait(5)
        assert receiver.overflow == 90
        assert receiver.state is TransportState.DEGRADED
        assert "90 frames dropped" in receiver.detail
        assert drain(receiver, 10) == [frame(k) for k in range(10)]
    assert len(seen) == 100


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (BusLostError("scripted: unplugged"), "unplugged"),
        (ZeroDivisionError("a driver's own"), "ZeroDivisionError: a driver's own"),
    ],
)
def test_an_error_in_the_thread_reaches_the_reader_after_the_frames(
    error: Exception, text: str
) -> None:
    with Receiver(Scripted(3, error)) as receiver:
        assert len(drain(receiver, 3)) == 3
        with pytest.raises(BusLostError, match=text):
            drain(receiver, 1)
        assert receiver.state is TransportState.FAILED
        assert text in receiver.detail
        with pytest.raises(BusLostError, match=text):
            receiver.receive(0.0)


def test_a_failing_sink_reaches_the_reader() -> None:
    def full(_: Frame) -> None:
        raise InputOutputError("disk full")

    with (
        Receiver(Scripted(3), sink=full) as receiver,
        pytest.raises(InputOutputError, match="full"),
    ):
        drain(receiver, 1)


def test_a_waiting_reader_is_woken_by_the_error() -> None:
    scripted = Scripted(0, BusLostError("gone"))
    with Receiver(scripted) as receiver, pytest.raises(BusLostError, match="gone"):
        receiver.receive(60.0)


def test_stop_may_be_called_twice_and_ends_the_thread() -> None:
    receiver = Receiver(Scripted(10)).start()
    receiver.stop()
    receiver.stop()
    assert not any(item.name == "receive scripted" for item in threading.enumerate())


def test_a_transport_in_real_time_gets_a_thread_others_none() -> None:
    class Simulated(Scripted):
        real_time = False

    assert isinstance(open_source(Scripted(0)), Receiver)
    assert isinstance(open_source(Simulated(0)), DirectReader)
    seen: list[Frame] = []
    with open_source(Simulated(3), sink=seen.append) as reader:
        assert drain(reader, 3) == seen == [frame(k) for k in range(3)]
        assert (reader.name, reader.state, reader.detail) == ("scripted", TransportState.OPEN, "")
