"""Foreign programs on the same bus: can-utils, python-can's tools, the kernel's SLCAN."""

from __future__ import annotations

import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import numpy as np
import pytest
from live_ends import LOADED_MACHINE, cable

from ehadiag import Recording
from ehadiag_sim.emulator import EmulatorTransport, FccCore
from firmware_iface import tester
from firmware_iface.alignment.align import assemble
from firmware_iface.bus_map import default_map
from firmware_iface.codec import Encoder
from firmware_iface.logs.reader import read_frames
from firmware_iface.logs.recorder import Recorder
from firmware_iface.recording import BitState
from firmware_iface.signals.recordings import read_recording
from firmware_iface.tester import run_test
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.base import Transport
from firmware_iface.transport.frames import Frame, FrameTable
from firmware_iface.transport.python_can import PythonCanTransport, frame_of, message_of

pytestmark = pytest.mark.socketcan

Until = Callable[[Callable[[], object]], None]
BUS = default_map()
LAST = Frame(0, 0x7FF, b"")
"""Comes after all frames of a test."""
CHANNELS = ("current", "spool", "pressure", "position", "command")


def request_and_listen(transport: Transport) -> tuple[tester.RequestOutcome, list[Frame]]:
    while transport.receive(0.0):
        pass  # what came while the other program started
    frames: list[Frame] = []
    outcome = run_test(
        transport, test_id=9, duration=0.4, transmit=True, on_frame=frames.append, bus_map=BUS,
        times=LOADED_MACHINE,
    )  # fmt: skip
    return outcome, frames


def recording_of(frames: list[Frame]) -> Recording:
    return assemble(FrameTable.from_frames(frames), BUS, "here")[0]


def content(frames: list[Frame]) -> bytes:
    """All identifiers and payloads in a row."""
    return b"".join(item.can_id.to_bytes(4, "big") + item.data for item in frames)


def read_candump(path: Path) -> list[Frame]:
    return [frame_of(message) for message in can.CanutilsLogReader(path)]


def assert_same_samples(ours: Recording, theirs: Recording) -> None:
    assert ours.samples is not None
    assert theirs.samples is not None
    for name in CHANNELS:
        a, b = getattr(ours.samples, name), getattr(theirs.samples, name)
        assert np.array_equal(a, b), name
    assert theirs.quality.total("lost") == 0
    assert theirs.quality.total("crc_errors") == 0


def test_candump_sees_what_we_see(
    node: FccCore, ours: Transport, peer: Callable[..., object], until: Until, log: Path
) -> None:
    with log.open("wb") as file, peer("candump", "-L", "vcan0", stdout=file):
        until(lambda: log.stat().st_size > 0)
        outcome, frames = request_and_listen(ours)
        ours.send(LAST)
        until(lambda: b"7FF#" in log.read_bytes())
    assert outcome.why == ""
    dumped = read_candump(log)
    requests = [item for item in dumped if item.can_id == 0x200]
    assert len(requests) == 1
    dumped.remove(requests[0])
    assert content(frames) in content(dumped)
    assert_same_samples(recording_of(frames), recording_of(dumped))


def test_a_test_goes_on_beside_foreign_traffic(
    node: FccCore, ours: Transport, peer: Callable[..., object], until: Until
) -> None:
    # 29-bit identifiers, which no message of ours has; a frame in a millisecond.
    with peer("cangen", "vcan0", "-e", "-g", "1", "-i"):
        until(lambda: (frame := ours.receive(0.1)) is not None and frame.extended)
        outcome, frames = request_and_listen(ours)
    assert outcome.why == ""
    assert outcome.dropped == 0
    foreign = sum(item.extended for item in frames)
    assert foreign > 200
    recording = recording_of(frames)
    assert recording.quality.total("lost") == 0
    assert 100 < recording.quality.foreign <= foreign  # those beside the test alone


def test_foreign_frames_with_our_identifiers_do_not_pass_for_ours(
    node: FccCore, ours: Transport, peer: Callable[..., object], until: Until
) -> None:
    # One in 256 has the right check sum by chance; status and request must not be guessed.
    with peer("cangen", "vcan0", "-I", "110", "-L", "8", "-g", "5"):
        outcome, frames = request_and_listen(ours)
    assert outcome.why == ""
    quality = recording_of(frames).quality
    assert quality.total("crc_errors") > 20


def test_canplayer_replays_our_recording(
    core: FccCore, ours: Transport, log: Path, tmp_path: Path
) -> None:
    if shutil.which("canplayer") is None:
        pytest.skip("no canplayer on this machine: Debian package can-utils")
    path = tmp_path / "ours.blf"
    with EmulatorTransport(core) as transport:
        run_test(transport, test_id=9, duration=0.4, transmit=True, recorder=Recorder(path))
    table = read_frames(path)
    with can.CanutilsLogWriter(log, channel="vcan0") as writer:
        for i in range(len(table)):
            data = table.data[i, : table.length[i]].tobytes()
            frame = Frame(int(table.time_ns[i]), int(table.can_id[i]), data)
            writer.on_message_received(message_of(frame))
    player = subprocess.Popen(["canplayer", "-I", str(log)])
    played = []
    while len(played) < len(table):
        item = ours.receive(5.0)
        assert item is not None
        played.append(item)
    assert player.wait(10) == 0
    assert ours.receive(0.05) is None
    assert_same_samples(read_recording(path), recording_of(played))


def cansend(frame: Frame) -> None:
    if shutil.which("cansend") is None:
        pytest.skip("no cansend on this machine: Debian package can-utils")
    subprocess.run(["cansend", "vcan0", f"{frame.can_id:03X}#{frame.data.hex()}"], check=True)


def test_cansend_starts_a_test_with_the_right_check_sum_only(node: FccCore, until: Until) -> None:
    good = Encoder(BUS).request("start", 9)[0]
    for bit in (0, 8, 48, 56, 63):
        data = bytearray(good.data)
        data[bit // 8] ^= 1 << bit % 8
        cansend(Frame(0, good.can_id, bytes(data)))
    before = node.now_ns
    until(lambda: node.now_ns > before + 200_000_000)
    assert (node.state, node.tests_started) == (BitState.IDLE, 0)
    cansend(good)
    until(lambda: node.tests_started == 1)
    until(lambda: node.state is BitState.COMPLETE)


def test_python_cans_logger_records_our_bus(
    node: FccCore, ours: Transport, peer: Callable[..., object], until: Until, tmp_path: Path
) -> None:
    path = tmp_path / "theirs.asc"
    command = (sys.executable, "-m", "can.logger", "-i", "socketcan", "-c", "vcan0", "-f", path)
    with peer(*command, stdout=subprocess.DEVNULL):
        until(lambda: path.exists() and path.stat().st_size > 2000)
        outcome, frames = request_and_listen(ours)
        ours.send(LAST)
        until(lambda: b" 7FF " in path.read_bytes())
    assert outcome.why == ""
    assert_same_samples(recording_of(frames), read_recording(path))


def test_python_cans_viewer_shows_our_messages(node: FccCore, until: Until) -> None:
    far, near = os.openpty()
    screen = bytearray()
    environment = dict(os.environ, TERM="xterm", LINES="40", COLUMNS="120")
    viewer = subprocess.Popen(
        [sys.executable, "-m", "can.viewer", "-i", "socketcan", "-c", "vcan0"],
        stdin=near,
        stdout=near,
        stderr=near,
        env=environment,
    )
    os.close(near)

    def shown() -> bool:
        if select.select([far], [], [], 0.0)[0]:
            screen.extend(os.read(far, 65536))
        return all(name in screen for name in (b"0x110", b"0x111", b"0x201"))

    try:
        until(shown)
    finally:
        os.write(far, b"q")
        deadline = time.monotonic() + 10
        while viewer.poll() is None and time.monotonic() < deadline:
            shown()
            time.sleep(0.02)
        viewer.kill()
        viewer.wait()
        os.close(far)


@contextmanager
def kernel_slcan(until: Until) -> Iterator[str]:
    """slcan0 of the kernel on a pseudo-terminal, and the path of the line's other end."""
    if shutil.which("slcand") is None:
        pytest.skip("no slcand on this machine: Debian package can-utils")
    with cable() as (kernels, ours):
        daemon = subprocess.Popen(
            ["slcand", "-F", "-o", "-s8", kernels, "slcan0"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        try:
            link = Path("/sys/class/net/slcan0")
            until(lambda: link.exists() or daemon.poll() is not None)
            if daemon.poll() is not None:
                assert daemon.stderr is not None
                pytest.skip(f"the kernel has no SLCAN: {daemon.stderr.read().decode()!r}")
            up = ["ip", "link", "set", "slcan0", "txqueuelen", "1000", "up"]
            subprocess.run(up, check=True)
            yield ours
        finally:
            daemon.terminate()
            daemon.communicate(timeout=10)


def test_a_recorded_test_through_the_kernels_slcan_and_a_serial_line(
    core: FccCore, until: Until
) -> None:
    with EmulatorTransport(core) as transport:
        _, frames = request_and_listen(transport)
    request = Encoder(BUS).request("start", 9)[0]
    with kernel_slcan(until) as line:
        far = BusOptions("socketcan", channel="slcan0")
        near = BusOptions("slcan", channel=line, extra={"sleep_after_open": 0.0})
        with (
            PythonCanTransport(far, transmit=True) as bus,
            PythonCanTransport(near, transmit=True) as ours,
        ):
            heard = []
            for item in frames:  # one by one: SLCAN in Python is slower than a control tick
                bus.send(item)
                got = ours.receive(5.0)
                assert got is not None
                heard.append(got)
            ours.send(request)
            back = bus.receive(5.0)
    assert content(heard) == content(frames)
    assert_same_samples(recording_of(frames), recording_of(heard))
    assert back is not None
    assert content([back]) == content([request])
