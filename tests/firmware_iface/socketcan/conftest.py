"""A node on a real SocketCAN interface, and the foreign programs that talk to it."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
from live_ends import computer_on

from ehadiag import StoredTest, default_actuator
from ehadiag_sim.conditions import Faults
from ehadiag_sim.emulator import FccCore
from firmware_iface.stored_test import Line, SearchWindows
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.base import Transport
from firmware_iface.transport.python_can import PythonCanTransport

CHANNEL = "vcan0"
DURATION = 0.4

Peer = Callable[..., AbstractContextManager[subprocess.Popen[bytes]]]


@pytest.fixture(scope="session", autouse=True)
def interface() -> None:
    if CHANNEL not in [name for _, name in socket.if_nameindex()]:
        pytest.skip(f"no interface {CHANNEL}: run inside tools/with-vcan.sh")


@pytest.fixture
def test_of_9() -> StoredTest:
    """0.4 s of current."""
    span = ((0.0, DURATION),)
    points = ((0.0, 0.0), (0.1, 2.0), (0.3, -2.0), (DURATION, 0.0))
    return StoredTest(
        name="short",
        id=9,
        mode="current",
        unit="mA",
        segment=(Line(points=points),),
        windows=SearchWindows(FDJ=span, Kintas=span, FSS=span, refinement=span),
    )


@pytest.fixture
def core(test_of_9: StoredTest) -> FccCore:
    made = FccCore(default_actuator(), [test_of_9], faults=Faults(0.3, 0.3, 0.3), serial=77)
    made.step()  # compiles
    return made


@pytest.fixture
def node(core: FccCore) -> Iterator[FccCore]:
    """The emulated computer on vcan0."""
    options = BusOptions("socketcan", channel=CHANNEL)
    with PythonCanTransport(options, transmit=True) as transport, computer_on(transport, core):
        yield core


@pytest.fixture
def ours() -> Iterator[Transport]:
    """Our own end on vcan0."""
    options = BusOptions("socketcan", channel=CHANNEL)
    with PythonCanTransport(options, transmit=True) as transport:
        yield transport


@pytest.fixture
def peer() -> Peer:
    """Run a foreign program beside the block; it is told to end as a user would, by Ctrl-C."""

    @contextmanager
    def run(*command: object, **options: object) -> Iterator[subprocess.Popen[bytes]]:
        words = [str(item) for item in command]
        if shutil.which(words[0]) is None:
            pytest.skip(f"no {words[0]} on this machine: Debian package can-utils")
        process = subprocess.Popen(words, **options)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    return run


@pytest.fixture
def until() -> Callable[[Callable[[], object]], None]:
    """Wait until something has come to be."""

    def wait(condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + 15
        while not condition():
            assert time.monotonic() < deadline, "it did not come to be"
            time.sleep(0.02)

    return wait


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "bus.log"
