"""What `Transport` promises, tested on every transport."""

from __future__ import annotations

import errno
import os
import select
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

import can
import pytest
import serial
import stored_test
from fault_diagnosis import content as judged_by
from places import ROOT

from ehadiag import BusLostError, ConfigurationError, InputOutputError, Verdict
from firmware_iface.logs.reader import read_frames
from firmware_iface.logs.recorder import Recorder, ReplayTransport, play_log
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.base import Transport, TransportState
from firmware_iface.transport.frames import Frame, FrameTable
from firmware_iface.transport.python_can import PythonCanTransport, frame_of
from firmware_iface.transport.serial_link import SerialTransport

COUNT = 500


def frame(k: int) -> Frame:
    return Frame(1_700_000_000_000_000_000 + k * 1_000_000, 0x100 + k % 0x300, k.to_bytes(8, "big"))


FRAMES = [frame(k) for k in range(COUNT)]


def content(frames: list[Frame]) -> list[tuple[int, bytes]]:
    return [(item.can_id, item.data) for item in frames]


def collect(transport: Transport, count: int) -> list[Frame]:
    """Read so many frames; fewer only where none comes for 20 s."""
    return stored_test.received(transport, count)


class Contract:
    """What every transport keeps. A subclass gives three fixtures:

    `receiving`, the transport that gets the frames; `passed`, which lets FRAMES through it and
    returns what came; `carried`, the frames of a stored test as they came through the transport.
    """

    def test_a_stored_test_comes_with_the_same_samples(self, carried: list[Frame]) -> None:
        sound = stored_test.recording(stored_test.frames())
        came = stored_test.recording(carried)
        assert judged_by(came) == judged_by(sound)
        assert came.quality.messages == sound.quality.messages

    @pytest.mark.slow
    def test_a_stored_test_gives_the_same_diagnosis(self, carried: list[Frame]) -> None:
        came = stored_test.diagnosis(stored_test.recording(carried))
        assert stored_test.figures(came) == stored_test.figures(stored_test.expected())
        assert came.verdict is Verdict.DEGRADED

    def test_every_frame_comes_once_and_in_order(
        self, receiving: Transport, passed: Callable[[], list[Frame]]
    ) -> None:
        got = passed()
        assert content(got) == content(FRAMES)
        assert not any(item.sent for item in got)
        assert receiving.receive(0.05) is None
        assert receiving.state is TransportState.OPEN
        assert receiving.detail == ""

    def test_times_are_whole_nanoseconds_that_do_not_run_backwards(
        self, passed: Callable[[], list[Frame]]
    ) -> None:
        times = [item.time_ns for item in passed()]
        assert all(type(item) is int for item in times)
        assert times == sorted(times)

    def test_a_transport_that_listens_only_sends_nothing(self, receiving: Transport) -> None:
        assert not receiving.transmits
        with pytest.raises(ConfigurationError, match="listen only"):
            receiving.send(FRAMES[0])
        assert receiving.state is TransportState.OPEN

    def test_closing_twice_is_well_and_use_afterwards_is_an_error(
        self, receiving: Transport
    ) -> None:
        receiving.close()
        receiving.close()
        assert receiving.state is TransportState.CLOSED
        with pytest.raises(BusLostError, match="closed"):
            receiving.receive(0.0)
        with pytest.raises(BusLostError, match="closed"):
            receiving.send(FRAMES[0])

    def test_silence_is_none_and_no_end(self, receiving: Transport) -> None:
        if not receiving.at_end and receiving.real_time:
            assert receiving.receive(0.0) is None
            assert receiving.receive(0.02) is None
            assert receiving.state is TransportState.OPEN

    def test_asking_without_waiting_does_not_wait(self, receiving: Transport) -> None:
        """A computer asks at each control tick whether anything came."""
        if not receiving.real_time:
            return
        begin = time.monotonic(), time.thread_time()
        descriptors = len(os.listdir("/proc/self/fd")) if sys.platform == "linux" else 0
        for _ in range(1000):
            assert receiving.receive(0.0) is None
        if sys.platform == "linux":
            assert len(os.listdir("/proc/self/fd")) <= descriptors + 10
        waited = time.monotonic() - begin[0]
        # Each wait of a millisecond would make one second; a loaded machine makes this slow too.
        assert waited < 0.5 + 20.0 * (time.thread_time() - begin[1])

    def test_the_clock_of_time_limits_runs_on(
        self, receiving: Transport, passed: Callable[[], list[Frame]]
    ) -> None:
        before = receiving.now_ns()
        passed()
        assert receiving.now_ns() > before


class TwoWay(Contract):
    """Transports with another end that can be written to, and read: the fixture `other`.

    Both ends are of the fixture `options`, where a subclass does not give them.
    """

    @pytest.fixture
    def other(self, options: BusOptions) -> Iterator[Transport]:
        with PythonCanTransport(options, transmit=True) as transport:
            yield transport

    @pytest.fixture
    def receiving(self, options: BusOptions) -> Iterator[Transport]:
        with PythonCanTransport(options) as transport:
            yield transport

    @pytest.fixture
    def passed(self, receiving: Transport, other: Transport) -> Callable[[], list[Frame]]:
        return lambda: stored_test.carry(FRAMES, other, receiving)

    @pytest.fixture
    def carried(self, receiving: Transport, other: Transport) -> list[Frame]:
        return stored_test.carry(stored_test.frames(), other, receiving)

    def test_own_frames_do_not_come_back(self, receiving: Transport, other: Transport) -> None:
        for item in FRAMES[:50]:
            other.send(item)
        assert len(collect(receiving, 50)) == 50
        assert other.receive(0.1) is None

    def test_one_thread_sends_while_another_receives(
        self, receiving: Transport, other: Transport
    ) -> None:
        room = threading.Semaphore(100)  # frames on their way

        def send() -> None:
            for item in FRAMES:
                room.acquire()
                other.send(item)

        sender = threading.Thread(target=send)
        sender.start()
        got: list[Frame] = []
        for _ in FRAMES:
            got += collect(receiving, 1)
            room.release()
        sender.join()
        assert content(got) == content(FRAMES)


class TestVirtual(TwoWay):
    @pytest.fixture
    def options(self) -> BusOptions:
        return BusOptions("virtual", channel=str(uuid.uuid4()))


@pytest.mark.parametrize(
    "chosen", ["not slow", pytest.param("slow", marks=pytest.mark.slow)], ids=["quick", "slow"]
)
def test_multicast_keeps_the_contract_in_a_namespace_of_its_own(chosen: str) -> None:
    loopnet = str(ROOT / "tools" / "loopnet.sh")
    if subprocess.run([loopnet, "true"], capture_output=True, check=False).returncode == 125:
        pytest.skip("no network namespace can be made here")
    inside = str(Path(__file__).with_name("inside_loopnet.py"))
    done = subprocess.run(
        [loopnet, sys.executable, "-m", "pytest", "-q", "-n0", "-m", chosen,
         "-p", "no:cacheprovider", inside],
        capture_output=True, text=True, timeout=300, check=False, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:]
    assert " passed" in done.stdout
    assert "skipped" not in done.stdout


def test_multicast_that_would_leave_the_machine_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from firmware_iface.transport import adapters

    routes = tmp_path / "route"
    header = "Iface Destination Gateway Flags RefCnt Use Metric Mask MTU Window IRTT\n"
    default = "eth7 00000000 00000000 0003 0 0 0 00000000 0 0 0\n"
    loopback = "lo 000000EF 00000000 0001 0 0 0 000000FF 0 0 0\n"
    if sys.byteorder == "big":
        pytest.skip("the table above is that of a little-endian machine")
    monkeypatch.setattr(adapters, "ROUTES_FILE", routes)
    for text, why in ((header + default, "through eth7"), (header, "no loopback route")):
        routes.write_text(text)
        with pytest.raises(ConfigurationError, match=why):
            PythonCanTransport(BusOptions("udp_multicast"))
    routes.write_text(header + default + loopback)
    with pytest.raises(ConfigurationError, match="no loopback route"):
        PythonCanTransport(BusOptions("udp_multicast", channel="ff15::1"))
    with pytest.raises(ConfigurationError, match="not an IP address"):
        PythonCanTransport(BusOptions("udp_multicast", channel="can0"))
    assert adapters.bus_arguments(BusOptions("udp_multicast"), True)["hop_limit"] == 0
    allowed = BusOptions("udp_multicast", allow_multicast=True)
    assert "hop_limit" not in adapters.bus_arguments(allowed, True)


class TestSerial(TwoWay):
    @pytest.fixture
    def other(self, wire: tuple[str, str]) -> Iterator[Transport]:
        with SerialTransport(wire[1], transmit=True) as transport:
            yield transport

    @pytest.fixture
    def receiving(self, wire: tuple[str, str]) -> Iterator[Transport]:
        with SerialTransport(wire[0]) as transport:
            yield transport

    def test_damage_degrades_and_the_next_frame_comes(
        self, receiving: Transport, other: Transport
    ) -> None:
        other.send(FRAMES[0])
        other._port.write(b"\x03\x41")
        other._port.write(b"\x00")
        other.send(FRAMES[1])
        assert content(collect(receiving, 2)) == content(FRAMES[:2])
        assert receiving.state is TransportState.DEGRADED
        assert "1 damaged" in receiving.detail

    def test_times_keep_the_senders_spacing(self, passed: Callable[[], list[Frame]]) -> None:
        times = [item.time_ns for item in passed()]
        assert [item - times[0] for item in times] == [k * 1_000_000 for k in range(COUNT)]


class TestSlcan(TwoWay):
    """Two SLCAN ends on one line: each takes the other for its adapter."""

    quick: ClassVar[dict[str, float]] = {"sleep_after_open": 0.0}

    @pytest.fixture
    def other(self, wire: tuple[str, str]) -> Iterator[Transport]:
        options = BusOptions("slcan", channel=wire[1], extra=self.quick)
        with PythonCanTransport(options, transmit=True) as transport:
            yield transport

    @pytest.fixture
    def receiving(self, wire: tuple[str, str]) -> Iterator[Transport]:
        options = BusOptions("slcan", channel=wire[0], extra=self.quick)
        with PythonCanTransport(options) as transport:
            yield transport


def test_what_is_no_slcan_line_is_skipped_and_counted(wire: tuple[str, str]) -> None:
    quick = {"sleep_after_open": 0.0}
    with (
        PythonCanTransport(BusOptions("slcan", channel=wire[0], extra=quick)) as receiving,
        serial.Serial(wire[1]) as line,
    ):
        damage = b"t1108001t11\r", b"tZZZ8\r", b"t1\r", b"T12\r", b"\xff\xfe\r", b"t110x\r"
        for k, item in enumerate(damage):
            line.write(item + b"t20180102030405060708\r")
            # Bytes that are no text take with them what waits behind them.
            got = collect(receiving, 1) if item[0] != 0xFF else []
            assert content(got) in ([(0x201, bytes(range(1, 9)))], []), item
            while f"{k + 1} messages on the line" not in receiving.detail:
                receiving.receive(0.05)
            while receiving.receive(0.05) is not None:
                pass
            assert f"{k + 1} messages on the line" in receiving.detail, item
        assert receiving.state is TransportState.DEGRADED
        line.write(b"t20180102030405060708\r")
        assert content(collect(receiving, 1)) == [(0x201, bytes(range(1, 9)))]


def test_an_slcan_line_that_nobody_reads_drops_frames_and_goes_on() -> None:
    tty = pytest.importorskip("tty", reason="no pseudo-terminals on this system")
    far, near = os.openpty()
    for item in (far, near):
        tty.setraw(item)
    options = BusOptions("slcan", channel=os.ttyname(near), extra={"sleep_after_open": 0.0})
    with PythonCanTransport(options, transmit=True) as bus:
        for k in range(2000):
            bus.send(frame(k))
        assert bus.state is TransportState.DEGRADED
        assert f"{bus.unsent} frames not sent" in bus.detail
        while select.select([far], [], [], 0.05)[0]:
            os.read(far, 65536)
        sent = b""
        while b"t1FF80000000000000000\r" not in sent:
            bus.send(Frame(0, 0x1FF, bytes(8)))
            if select.select([far], [], [], 0.01)[0]:
                sent += os.read(far, 65536)
    for item in (far, near):
        os.close(item)


@pytest.mark.parametrize(
    ("failures", "dropped"), [(3, 0), (10**9, 20)], ids=["for a moment", "for ever"]
)
def test_a_full_queue_of_the_kernel_is_waited_for_and_then_dropped(
    failures: int, dropped: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody acknowledges on a real bus: the adapter's queue is full and stays so."""
    left = failures
    sent: list[can.Message] = []

    def send(message: can.Message, timeout: float) -> None:
        nonlocal left
        if left:
            left -= 1
            raise can.CanOperationError("Failed to transmit", errno.ENOBUFS)
        sent.append(message)

    options = BusOptions("virtual", channel=str(uuid.uuid4()))
    with PythonCanTransport(options, transmit=True) as bus:
        monkeypatch.setattr(bus._bus, "send", send)
        for item in FRAMES[:20]:
            bus.send(item)
        assert (bus.unsent, len(sent)) == (dropped, 20 - dropped)
        assert (bus.state is TransportState.OPEN) == (dropped == 0)
        left = 0
        while len(sent) < 20 - dropped + 1:
            bus.send(FRAMES[20])
        assert content([frame_of(sent[-1])]) == content([FRAMES[20]])


def test_a_bus_that_refuses_for_another_reason_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    def send(message: can.Message, timeout: float) -> None:
        raise can.CanOperationError("Failed to transmit: Network is down", errno.ENETDOWN)

    options = BusOptions("virtual", channel=str(uuid.uuid4()))
    with PythonCanTransport(options, transmit=True) as bus:
        monkeypatch.setattr(bus._bus, "send", send)
        with pytest.raises(BusLostError, match="cannot send: Failed to transmit: Network is down"):
            bus.send(FRAMES[0])
        assert bus.state is TransportState.FAILED


def test_a_serial_line_that_goes_away_is_a_lost_bus() -> None:
    if not hasattr(os, "openpty"):
        pytest.skip("no pseudo-terminals on this system")
    far, near = os.openpty()
    transport = SerialTransport(os.ttyname(near), transmit=True)
    os.close(near)
    os.close(far)
    with pytest.raises(BusLostError):
        collect(transport, 1)
    assert transport.state is TransportState.FAILED
    with pytest.raises(BusLostError):
        transport.send(FRAMES[0])
    transport.close()


class ReplayContract(Contract):
    suffix = ""

    @pytest.fixture
    def receiving(self, tmp_path: Path) -> Iterator[Transport]:
        path = tmp_path / f"log{self.suffix}"
        with Recorder(path) as recorder:
            for item in FRAMES:
                recorder.write(item)
        with ReplayTransport(read_frames(path), path.name) as transport:
            yield transport

    @pytest.fixture
    def passed(self, receiving: Transport) -> Callable[[], list[Frame]]:
        return lambda: collect(receiving, COUNT)

    @pytest.fixture
    def carried(self, tmp_path: Path) -> list[Frame]:
        path = tmp_path / f"test{self.suffix}"
        with Recorder(path) as recorder:
            for item in stored_test.frames():
                recorder.write(item)
        with ReplayTransport(read_frames(path), path.name) as transport:
            return stored_test.received(transport, len(stored_test.frames()))

    def test_the_end_is_known(self, receiving: Transport) -> None:
        assert not receiving.at_end
        collect(receiving, COUNT)
        assert receiving.at_end


class TestBlf(ReplayContract):
    suffix = ".blf"


class TestAsc(ReplayContract):
    suffix = ".asc"


class TestCsv(ReplayContract):
    suffix = ".csv"


class TestTrc(ReplayContract):
    suffix = ".trc"


class TestMf4(ReplayContract):
    suffix = ".mf4"

    @pytest.fixture(autouse=True)
    def _library(self) -> None:
        pytest.importorskip("asammdf", reason="MF4 needs the extra ehadiag[mf4]")


def test_replay_in_its_own_time_is_not_faster_than_the_log() -> None:
    table = FrameTable.from_frames([frame(0), frame(100)])
    with ReplayTransport(table, "log", speed=1.0) as transport:
        started = time.monotonic()
        assert len(collect(transport, 2)) == 2
        assert time.monotonic() - started >= 0.099
        assert transport.real_time


def test_playing_onto_a_bus_keeps_order_skips_errors_and_stops() -> None:
    options = BusOptions("virtual", channel=str(uuid.uuid4()))
    log = [*FRAMES[:20], Frame(FRAMES[20].time_ns, 8, b"", error=True), *FRAMES[20:40]]
    table = FrameTable.from_frames(log)
    with PythonCanTransport(options) as listener, PythonCanTransport(options, transmit=True) as bus:
        assert play_log(table, bus, speed=None) == 40
        assert content(collect(listener, 40)) == content(FRAMES[:40])
        stop = threading.Event()
        stop.set()
        assert play_log(table, bus, stop=stop) == 0
        with pytest.raises(ConfigurationError, match="listen only"):
            play_log(table, listener)
        with pytest.raises(ConfigurationError, match="speed"):
            play_log(table, bus, speed=0.0)
    with pytest.raises(ConfigurationError, match="speed"):
        ReplayTransport(table, "log", speed=-1.0)


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        (BusOptions("no_such_bus"), ConfigurationError, "unknown, need one of"),
        (BusOptions("pcan", channel="PCAN_USBBUS1"), InputOutputError, "install PEAK's driver"),
        (BusOptions("kvaser", channel="0"), ConfigurationError, "install Kvaser's driver"),
        (BusOptions("vector", channel="0", app_name="x"), ConfigurationError, "install Vector's"),
        (BusOptions("ixxat", channel="0"), ConfigurationError, "install HMS's VCI driver"),
        (BusOptions("neovi", channel="1"), ConfigurationError, "its Python module"),
        (BusOptions("pcan"), ConfigurationError, "name the channel, such as --channel PCAN"),
        (BusOptions("slcan"), ConfigurationError, "name the channel, such as --channel /dev/tty"),
        (BusOptions("slcan", channel="/dev/no-such-port"), InputOutputError, "the right one"),
        (BusOptions("socketcan", channel="nocan7"), InputOutputError, "ip link set"),
        (BusOptions("socketcand", channel="can0"), ConfigurationError, "--bus-kwargs host="),
        (
            BusOptions("socketcand", channel="can0", extra={"host": "127.0.0.1", "port": 9}),
            InputOutputError,
            "no daemon at 127.0.0.1:9: .*is the daemon running",
        ),
        (
            BusOptions("virtual", extra={"receive_own_messages": True}),
            ConfigurationError,
            "not supported",
        ),
        (
            BusOptions("udp_multicast", extra={"channel": "239.1.1.1"}),
            ConfigurationError,
            "an option of its own",
        ),
    ],
)
def test_a_bus_that_cannot_be_opened_is_one_line(
    options: BusOptions, error: type[Exception], text: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(error, match=text) as caught:
        PythonCanTransport(options)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")  # python-can's own lines would bury it
    assert options.interface in str(caught.value)


def test_a_serial_port_that_cannot_be_opened_is_one_line() -> None:
    with pytest.raises(InputOutputError, match="cannot open"):
        SerialTransport("/dev/no-such-port")
    with pytest.raises(ConfigurationError, match="wrong option"):
        SerialTransport("nothing://x")


def test_adapters_are_silenced_unless_asked_to_transmit() -> None:
    from firmware_iface.transport.adapters import bus_arguments

    for interface, option in (("slcan", "listen_only"), ("vector", "listen_only")):
        assert bus_arguments(BusOptions(interface), False)[option] is True
        assert option not in bus_arguments(BusOptions(interface), True)
    loud = BusOptions("slcan", extra={"listen_only": False})
    assert bus_arguments(loud, False)["listen_only"] is True
    assert bus_arguments(BusOptions("kvaser"), False)["driver_mode"] is False
    assert bus_arguments(BusOptions("pcan"), False)["state"].name == "PASSIVE"
    assert "state" not in bus_arguments(BusOptions("pcan"), True)


def test_bus_off_ends_the_bus() -> None:
    options = BusOptions("virtual", channel=str(uuid.uuid4()))
    with PythonCanTransport(options) as listener, PythonCanTransport(options, transmit=True) as bus:
        bus.send(Frame(0, 0x004, bytes(8), error=True))
        item = collect(listener, 1)[0]
        assert item.error
        assert listener.state is TransportState.OPEN
        bus.send(Frame(0, 0x040, bytes(8), error=True))
        with pytest.raises(BusLostError, match="bus off"):
            collect(listener, 1)
        assert listener.state is TransportState.FAILED


@pytest.mark.socketcan
class TestSocketCan(TwoWay):
    @pytest.fixture
    def options(self) -> BusOptions:
        if "vcan0" not in {name for _, name in socket.if_nameindex()}:
            pytest.skip("no vcan0 here")
        return BusOptions("socketcan", channel="vcan0")


@pytest.mark.skipif(sys.platform != "linux", reason="Linux tells what a socket dropped")
def test_frames_that_the_kernel_drops_degrade_the_transport(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    options = BusOptions("virtual", channel=str(uuid.uuid4()))
    with (
        PythonCanTransport(options) as listener,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as full,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        assert listener.dropped is None  # no socket behind it
        full.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        full.bind(("127.0.0.1", 0))
        monkeypatch.setattr(listener._bus, "fileno", full.fileno)
        assert listener.dropped == 0
        assert listener.receive(0.0) is None
        assert listener.state is TransportState.OPEN
        for _ in range(1000):
            sender.sendto(bytes(16), full.getsockname())
        assert listener.receive(0.0) is None
        assert listener.state is TransportState.DEGRADED
        assert listener.dropped is not None
        assert 0 < listener.dropped < 1000
        assert listener.detail.startswith(f"{listener.dropped} frames dropped by the kernel")
