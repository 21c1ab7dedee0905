"""The serial link on all kinds of ports: unread ones, network ports, pyserial URLs."""

from __future__ import annotations

import os
import select
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace

import pytest
from live_ends import LOADED_MACHINE
from serial import rfc2217, serial_for_url

from ehadiag import BusLostError
from ehadiag_sim.emulator import FccCore, run_emulator
from firmware_iface.tester import run_test
from firmware_iface.transport import serial_link
from firmware_iface.transport.base import Transport, TransportState
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.serial_link import Framer, SerialTransport

tty = pytest.importorskip("tty", reason="no pseudo-terminals here")


def frame(k: int) -> Frame:
    return Frame(k * 1_000_000, 0x110, k.to_bytes(8, "big"))


def numbers(frames: list[Frame]) -> list[int]:
    return [int.from_bytes(item.data, "big") for item in frames]


@pytest.fixture
def unread() -> Iterator[tuple[int, str]]:
    """A pseudo-terminal whose other end is read by the test alone: descriptor and name."""
    far, near = os.openpty()
    for item in (far, near):
        tty.setraw(item)
    yield far, os.ttyname(near)
    for item in (far, near):
        os.close(item)


def emptied(descriptor: int, framer: Framer, least: int) -> list[Frame]:
    """Read so many frames, and all else that waits: a busy kernel hands it over late."""
    frames: list[Frame] = []
    while select.select([descriptor], [], [], 0.05)[0] or len(frames) < least:
        if select.select([descriptor], [], [], 1.0)[0]:
            frames += framer.feed(os.read(descriptor, 4096))
    return frames


def test_frames_that_nobody_reads_are_dropped_and_counted(unread: tuple[int, str]) -> None:
    far, name = unread
    framer = Framer()
    with SerialTransport(name, transmit=True) as bus:
        assert bus.state is TransportState.OPEN
        for k in range(5000):
            bus.send(frame(k))
        assert bus.state is TransportState.DEGRADED
        unsent = bus.unsent
        assert f"{unsent} frames not sent" in bus.detail
        waited = numbers(emptied(far, framer, 5000 - unsent))
        for k in range(5000, 5050):
            bus.send(frame(k))
        waited += numbers(emptied(far, framer, 50))
        assert bus.unsent == unsent
        # What did go out is the beginning, whole and in order; at most the last packet is cut.
        count = len(waited) - 50
        assert waited == [*range(count), *range(5000, 5050)]
        # pyserial's time-out does not tell whether the packet went out after all, and a busy
        # machine gives some of them.
        assert unsent - (5000 - count) in range(5)
        assert framer.bad <= 1
        assert bus.state is TransportState.DEGRADED


def test_a_long_stall_does_not_cost_its_patience_for_each_frame(unread: tuple[int, str]) -> None:
    with SerialTransport(unread[1], transmit=True) as bus:
        for k in range(5000):
            bus.send(frame(k))
        assert bus.unsent
        before = time.process_time(), time.monotonic()
        for k in range(20_000):
            bus.send(frame(k))
        # Five seconds if only one frame in a thousand waited; all this takes a tenth of one.
        assert time.monotonic() - before[1] < 5.0 + 10.0 * (time.process_time() - before[0])


def test_a_port_that_cannot_be_asked_for_room_drops_as_well(
    unread: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    far, name = unread
    framer, now = Framer(), 100.0

    def refuse() -> int:
        raise OSError("no descriptor")

    # A port is tried again after a while: by a clock that a busy machine does not move on.
    clock = SimpleNamespace(monotonic=lambda: now, time_ns=time.time_ns)
    monkeypatch.setattr(serial_link, "time", clock)
    with SerialTransport(name, transmit=True) as bus:
        monkeypatch.setattr(bus._port, "fileno", refuse)
        for k in range(5000):
            bus.send(frame(k))
        assert bus.unsent
        waited = numbers(emptied(far, framer, 5000 - bus.unsent))
        assert waited == list(range(len(waited)))
        unsent = bus.unsent
        bus.send(frame(6000))
        assert bus.unsent == unsent + 1
        now += serial_link.PORT_TIMES.retry
        bus.send(frame(7000))
        assert numbers(emptied(far, framer, 1)) == [7000]
        assert bus.unsent == unsent + 1
        assert framer.bad <= 1


def test_a_computer_without_a_reader_serves_the_tester_that_comes_later(
    make_core: Callable[..., FccCore],
) -> None:
    (a, a_end), (b, b_end) = os.openpty(), os.openpty()
    for item in (a, b, a_end, b_end):
        tty.setraw(item)
    core, stop, told = make_core(), threading.Event(), list[str]()
    core.step()

    def join() -> None:
        while not stop.is_set():
            for source in select.select([a, b], [], [], 0.02)[0]:
                os.write(b if source == a else a, os.read(source, 4096))

    with ExitStack() as stack:
        for item in (a, b, a_end, b_end):
            stack.callback(os.close, item)
        bus = stack.enter_context(SerialTransport(os.ttyname(a_end), transmit=True))
        node = threading.Thread(
            target=run_emulator, args=(core, bus, stop), kwargs={"on_degraded": told.append}
        )
        joint = threading.Thread(target=join)
        node.start()
        try:
            while bus.unsent < 1000:
                assert node.is_alive()
                time.sleep(0.01)
            ours = stack.enter_context(SerialTransport(os.ttyname(b_end), transmit=True))
            joint.start()
            outcome = run_test(ours, test_id=9, duration=0.4, transmit=True, times=LOADED_MACHINE)
        finally:
            stop.set()
            node.join()
            if joint.ident is not None:
                joint.join()
    assert outcome.why == ""
    assert len(told) == 1  # said once, not at each frame
    assert "nobody read" in told[0]


@contextmanager
def accepting(count: int, serve: Callable[[list[socket.socket]], None]) -> Iterator[int]:
    """A server on the loopback interface for `count` connections; gives its port."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(60.0)

        def work() -> None:
            with ExitStack() as stack:
                serve([stack.enter_context(server.accept()[0]) for _ in range(count)])

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            thread.join()


def joined(ends: list[socket.socket]) -> None:
    """Hand over bytes from one connection to the other until one is closed."""
    while True:
        for source in select.select(ends, [], [], 60.0)[0]:
            chunk = source.recv(4096)
            if not chunk:
                return
            ends[1 - ends.index(source)].sendall(chunk)


def received(bus: Transport, count: int) -> list[int]:
    got: list[Frame] = []
    while len(got) < count:
        item = bus.receive(1.0)
        if item is not None:
            got.append(item)
    return numbers(got)


def test_a_network_port_carries_frames() -> None:
    with accepting(2, joined) as port:
        url = f"socket://127.0.0.1:{port}"
        with SerialTransport(url, transmit=True) as far, SerialTransport(url) as ours:
            for k in range(200):
                far.send(frame(k))
            assert received(ours, 200) == list(range(200))
            assert ours.state is TransportState.OPEN


def test_a_network_port_that_nobody_reads_drops_as_well() -> None:
    release = threading.Event()

    def deaf(_: list[socket.socket]) -> None:
        release.wait()

    with accepting(1, deaf) as port:
        try:
            with SerialTransport(f"socket://127.0.0.1:{port}", transmit=True) as bus:
                bus._port._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
                k = 0
                while not bus.unsent and k < 3_000_000:
                    bus.send(frame(k))
                    k += 1
                assert bus.unsent
                assert bus.state is TransportState.DEGRADED
        finally:
            release.set()


def test_a_network_port_that_is_closed_is_a_lost_bus() -> None:
    with (
        accepting(1, lambda _: None) as port,
        SerialTransport(f"socket://127.0.0.1:{port}") as bus,
        pytest.raises(BusLostError),
    ):
        received(bus, 1)


class _Telnet:
    """What pyserial's own RFC 2217 server side wants of a connection."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    def write(self, data: bytes) -> None:
        self._end.sendall(data)


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # pyserial's own
def test_a_port_behind_rfc2217_carries_frames() -> None:
    def serve(ends: list[socket.socket]) -> None:
        (end,) = ends
        port = serial_for_url("loop://", timeout=0)
        manager = rfc2217.PortManager(port, _Telnet(end))
        while select.select([end], [], [], 60.0)[0]:
            chunk = end.recv(4096)
            if not chunk:
                break
            port.write(b"".join(manager.filter(chunk)))
            end.sendall(b"".join(manager.escape(port.read(port.in_waiting))))
        port.close()

    with (
        accepting(1, serve) as port,
        SerialTransport(f"rfc2217://127.0.0.1:{port}", transmit=True) as bus,
    ):
        for k in range(50):
            bus.send(frame(k))
        assert received(bus, 50) == list(range(50))
