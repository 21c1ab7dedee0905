"""Receive thread: order, overflow, errors that reach the reader, a clean stop.

One bus that several listeners read, recorded once.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from pathlib import Path

import pytest

from ehadiag import BusLostError, ConfigurationError, InputOutputError
from firmware_iface.logs.reader import read_frames
from firmware_iface.logs.recorder import Recorder, SharedBus
from firmware_iface.transport.base import (
    DirectReader,
    Receiver,
    Transport,
    TransportState,
    open_source,
)
from firmware_iface.transport.frames import Frame


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
    deadline = time.monotonic() + 60.0
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
        assert idle.wait(60.0)
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


FRAMES = [Frame(1_700_000_000_000_000_000 + k, 0x100 + k, bytes([k])) for k in range(50)]


class Fed(Transport):
    """Brings frames, then fails if told to."""

    def __init__(self, frames: list[Frame], *, fails: bool = False) -> None:
        super().__init__("scripted bus", transmit=False)
        self._frames: queue.SimpleQueue[Frame] = queue.SimpleQueue()
        self._fails = fails
        for frame in frames:
            self.bring(frame)

    def bring(self, frame: Frame) -> None:
        """Let one more frame come."""
        self._frames.put(frame)

    def _receive(self, timeout: float) -> Frame | None:
        try:
            return self._frames.get(timeout=min(timeout, 0.01))
        except queue.Empty:
            if self._fails:
                raise self._fail("unplugged") from None
            return None

    def _send(self, frame: Frame) -> None:
        raise AssertionError(frame)

    def _close(self) -> None:
        pass


def taken(branch: Transport, count: int) -> list[Frame]:
    """Frames that a branch brings, each within a second."""
    found: list[Frame] = []
    deadline = time.monotonic() + 60.0
    while len(found) < count:
        assert time.monotonic() < deadline
        frame = branch.receive(0.05)
        found += [frame] if frame is not None else []
    return found


def test_each_branch_gets_every_frame_and_the_recording_has_each_once(tmp_path: Path) -> None:
    path = tmp_path / "bus.blf"
    with SharedBus(Fed(FRAMES), 3, Recorder(path)) as shared:
        for branch in shared.branches:
            assert [f.can_id for f in taken(branch, 50)] == [f.can_id for f in FRAMES]
            assert branch.receive(0.0) is None
            with pytest.raises(ConfigurationError, match="listen only"):
                branch.send(FRAMES[0])
    assert read_frames(str(path)).can_id.tolist() == [frame.can_id for frame in FRAMES]


def test_a_bus_that_fails_ends_each_branch_after_its_last_frame(tmp_path: Path) -> None:
    bus = Fed(FRAMES, fails=True)
    with SharedBus(bus, 2, Recorder(tmp_path / "bus.blf")) as shared:
        for branch in shared.branches:
            assert len(taken(branch, 50)) == 50
            with pytest.raises(BusLostError, match=r"^scripted bus: unplugged$"):
                taken(branch, 1)
            assert branch.state is TransportState.FAILED


def test_a_listener_that_reads_nothing_does_not_hold_up_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("firmware_iface.logs.recorder.QUEUE_CAPACITY", 40)
    bus = Fed([])
    with SharedBus(bus, 2, Recorder(tmp_path / "bus.blf")) as shared:
        first, second = shared.branches
        for frame in FRAMES:
            bus.bring(frame)
            assert taken(first, 1) == [frame]
        assert len(taken(second, 40)) == 40
        assert second.receive(0.0) is None
        assert second.state is TransportState.DEGRADED
        assert "10 frames came faster" in second.detail
        assert first.state is TransportState.OPEN
