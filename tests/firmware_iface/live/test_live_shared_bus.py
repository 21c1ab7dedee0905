"""One bus that several listeners read, recorded once."""

from __future__ import annotations

import queue
import time
from pathlib import Path

import pytest

from ehadiag.core.errors import BusLostError, ConfigurationError
from firmware_iface.logs.reader import read_frames
from firmware_iface.logs.recorder import Recorder
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.interface import Transport, TransportState
from firmware_iface.transport.shared import SharedBus

FRAMES = [Frame(1_700_000_000_000_000_000 + k, 0x100 + k, bytes([k])) for k in range(50)]


class Scripted(Transport):
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


def received(branch: Transport, count: int) -> list[Frame]:
    """Frames that a branch brings, each within a second."""
    found: list[Frame] = []
    deadline = time.monotonic() + 10.0
    while len(found) < count:
        assert time.monotonic() < deadline
        frame = branch.receive(0.05)
        found += [frame] if frame is not None else []
    return found


def test_each_branch_gets_every_frame_and_the_recording_has_each_once(tmp_path: Path) -> None:
    path = tmp_path / "bus.blf"
    with SharedBus(Scripted(FRAMES), 3, Recorder(path)) as shared:
        for branch in shared.branches:
            assert [f.can_id for f in received(branch, 50)] == [f.can_id for f in FRAMES]
            assert branch.receive(0.0) is None
            with pytest.raises(ConfigurationError, match="listen only"):
                branch.send(FRAMES[0])
    assert read_frames(str(path)).can_id.tolist() == [frame.can_id for frame in FRAMES]


def test_a_bus_that_fails_ends_each_branch_after_its_last_frame(tmp_path: Path) -> None:
    bus = Scripted(FRAMES, fails=True)
    with SharedBus(bus, 2, Recorder(tmp_path / "bus.blf")) as shared:
        for branch in shared.branches:
            assert len(received(branch, 50)) == 50
            with pytest.raises(BusLostError, match=r"^scripted bus: unplugged$"):
                received(branch, 1)
            assert branch.state is TransportState.FAILED


def test_a_listener_that_reads_nothing_does_not_hold_up_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("firmware_iface.transport.shared.CAPACITY", 40)
    bus = Scripted([])
    with SharedBus(bus, 2, Recorder(tmp_path / "bus.blf")) as shared:
        first, second = shared.branches
        for frame in FRAMES:
            bus.bring(frame)
            assert received(first, 1) == [frame]
        assert len(received(second, 40)) == 40
        assert second.receive(0.0) is None
        assert second.state is TransportState.DEGRADED
        assert "10 frames came faster" in second.detail
        assert first.state is TransportState.OPEN
