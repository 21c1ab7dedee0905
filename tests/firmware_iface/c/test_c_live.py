"""The C programs as live peers of the tester: over the serial link, and over SocketCAN."""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from ehadiag import Recording, bundled_tests
from firmware_iface import tester
from firmware_iface.alignment.align import assemble
from firmware_iface.bus_map import default_map
from firmware_iface.recording import BitReason, BitState
from firmware_iface.tester import BitProgress, run_test
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.base import Transport
from firmware_iface.transport.frames import Frame, FrameTable
from firmware_iface.transport.python_can import PythonCanTransport
from firmware_iface.transport.serial_link import SerialTransport

BUS = default_map()
REFUSALS = [
    ((), 3, BitReason.UNKNOWN_TEST, "refused: unknown test"),
    (("--supply-MPa", "9"), 1, BitReason.SUPPLY_PRESSURE_LOW, "refused: supply pressure low"),
    (("--oil-degC", "-30"), 1, BitReason.OIL_TOO_COLD, "refused: oil too cold"),
    (("--interlock-open",), 1, BitReason.INTERLOCK_OPEN, "refused: interlock open"),
    (("--interlock-open", "--uds"), 1, BitReason.INTERLOCK_OPEN, "refused: interlock open"),
]


@contextmanager
def running(*command: str | Path) -> Iterator[subprocess.Popen[str]]:
    """A node that must end well when it is told to."""
    process = subprocess.Popen([str(item) for item in command], stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.terminate()
        _, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (0, "")


def wait_for_frames(transport: Transport) -> None:
    while transport.receive(1.0) is None:
        pass


def run(
    transport: Transport,
    test_id: int,
    stop: threading.Event | None = None,
    progress: Callable[[BitProgress], None] | None = None,
    protocol: tester.RequestProtocol = "native",
) -> tuple[tester.RequestOutcome, Recording]:
    frames: list[Frame] = []
    outcome = run_test(
        transport,
        test_id=test_id,
        duration=5.5,
        transmit=True,
        bus_map=BUS,
        on_frame=frames.append,
        stop=stop,
        progress=progress,
        protocol=protocol,
    )
    return outcome, assemble(FrameTable.from_frames(frames), BUS, "here")[0]


ATTEMPTS = 3
STARVED_S = 0.2
"""Time, s, that a process waited for a processor in a test and may have lost telemetry by it."""


def waited_for_processor(pid: int) -> float:
    """Time that the threads of a process could run and did not, s; 0 where the system says none."""
    waited = 0
    for file in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        with suppress(OSError):
            waited += int(file.read_text().split()[1])
    return waited * 1e-9


@contextmanager
def starvation(*pids: int) -> Iterator[list[float]]:
    """List, once the block has ended, how long each process waited for a processor in it, s."""
    waited = [waited_for_processor(pid) for pid in pids]
    waits: list[float] = []
    yield waits
    waits += [waited_for_processor(pid) - before for pid, before in zip(pids, waited, strict=True)]


Node = subprocess.Popen[str]
Ends = AbstractContextManager[tuple[Transport, Node]]
Outcome = tuple[tester.RequestOutcome, Recording]


def run_unstarved(ends: Callable[[], Ends], test: Callable[[Transport], Outcome]) -> Outcome:
    """Run a test from new ends on; again where one got no processor, skipped in the end."""
    for _ in range(ATTEMPTS):
        with ends() as (transport, process):
            wait_for_frames(transport)
            with starvation(process.pid, os.getpid()) as waits:
                outcome, recording = test(transport)
        if not outcome.why.startswith("telemetry lost") or max(waits) < STARVED_S:
            return outcome, recording
    pytest.skip(f"no processor for this test {ATTEMPTS} times")


def assert_whole(outcome: tester.RequestOutcome, recording: Recording) -> None:
    assert outcome.why == ""
    assert outcome.outcome.state is BitState.COMPLETE
    assert (outcome.test_id, outcome.serial) == (1, 4711)
    quality = recording.quality
    assert [quality.total(kind) for kind in ("lost", "crc_errors", "repeated")] == [0, 0, 0]
    samples = recording.samples
    assert samples is not None
    wanted = bundled_tests()["open"].command()
    assert np.abs(samples.command - wanted).max() <= 0.25e-6 + 1e-12
    # The stand-in's current is the command at once: half a code, half a step of the command.
    assert np.abs(samples.current - wanted).max() <= 3.2e-6


def assert_aborted(outcome: tester.RequestOutcome, recording: Recording) -> None:
    assert outcome.why == "stopped by the user"
    assert outcome.abort_confirmed is True
    assert recording.outcome.state is BitState.ABORTED
    samples = recording.samples
    assert samples is not None
    # The test has 5500 ticks, and what came after the abort does not belong to it.
    played = np.flatnonzero(~np.isnan(samples.command))
    assert 300 <= len(played) < 3000


def abort(transport: Transport) -> tuple[tester.RequestOutcome, Recording]:
    stop = threading.Event()

    def watch(progress: BitProgress) -> None:
        if progress.elapsed > 0.5:
            stop.set()

    return run(transport, 1, stop, watch)


class TestSerialLink:
    @staticmethod
    @contextmanager
    def ends(program: Path, wire: tuple[str, str]) -> Iterator[tuple[Transport, Node]]:
        with (
            SerialTransport(wire[0], transmit=True) as transport,
            running(program, wire[1], "--serial", "4711") as process,
        ):
            yield transport, process
            assert transport.bad_packets == 0

    def test_a_whole_test(self, c_build: Path, wire: tuple[str, str]) -> None:
        ends = partial(self.ends, c_build / "fcc-serial", wire)
        assert_whole(*run_unstarved(ends, partial(run, test_id=1)))

    def test_an_abort_is_obeyed(self, c_build: Path, wire: tuple[str, str]) -> None:
        ends = partial(self.ends, c_build / "fcc-serial", wire)
        assert_aborted(*run_unstarved(ends, abort))

    @pytest.mark.parametrize(("options", "test_id", "reason", "why"), REFUSALS)
    def test_refusals(
        self,
        c_build: Path,
        wire: tuple[str, str],
        options: tuple[str, ...],
        test_id: int,
        reason: BitReason,
        why: str,
    ) -> None:
        with (
            SerialTransport(wire[0], transmit=True) as transport,
            running(c_build / "fcc-serial", wire[1], *options),
        ):
            wait_for_frames(transport)
            protocol = "uds" if "--uds" in options else "native"
            outcome, _ = run(transport, test_id, protocol=protocol)
        assert (outcome.why, outcome.outcome.reason) == (why, reason)

    def test_requests_behind_noise_get_through(self, c_build: Path, wire: tuple[str, str]) -> None:
        with (
            SerialTransport(wire[0], transmit=True) as transport,
            running(c_build / "fcc-serial", wire[1], "--interlock-open"),
        ):
            wait_for_frames(transport)
            with open(wire[0], "wb", buffering=0) as line:
                line.write(bytes(range(1, 256)) * 3 + b"\0\0\x05\0")
            outcome, _ = run(transport, 1)
        assert outcome.why == "refused: interlock open"


@pytest.mark.socketcan
class TestSocketCan:
    @pytest.fixture
    def transport(self) -> Iterator[Transport]:
        options = BusOptions("socketcan", channel="vcan0")
        with PythonCanTransport(options, transmit=True) as transport:
            yield transport

    @staticmethod
    @contextmanager
    def ends(program: Path, transport: Transport) -> Iterator[tuple[Transport, Node]]:
        with running(program, "vcan0", "--serial", "4711") as process:
            yield transport, process

    def test_a_whole_test(self, c_build: Path, transport: Transport) -> None:
        ends = partial(self.ends, c_build / "fcc-can", transport)
        assert_whole(*run_unstarved(ends, partial(run, test_id=1)))

    def test_an_abort_is_obeyed(self, c_build: Path, transport: Transport) -> None:
        ends = partial(self.ends, c_build / "fcc-can", transport)
        assert_aborted(*run_unstarved(ends, abort))

    @pytest.mark.parametrize(("options", "test_id", "reason", "why"), REFUSALS)
    def test_refusals(
        self,
        c_build: Path,
        transport: Transport,
        options: tuple[str, ...],
        test_id: int,
        reason: BitReason,
        why: str,
    ) -> None:
        with running(c_build / "fcc-can", "vcan0", *options):
            wait_for_frames(transport)
            protocol = "uds" if "--uds" in options else "native"
            outcome, _ = run(transport, test_id, protocol=protocol)
        assert (outcome.why, outcome.outcome.reason) == (why, reason)


@pytest.mark.parametrize("program", ["fcc-serial", "fcc-can"])
@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        ((), 2, "usage:"),
        (("--serial", "1"), 2, "usage:"),
        (("nowhere", "--serial", "65536"), 2, "usage:"),
        (("nowhere", "--oil-degC", "warm"), 2, "usage:"),
        (("nowhere", "--oil-degC"), 2, "usage:"),
        (("nowhere", "--jack", "1"), 2, "usage:"),
        (("nowhere",), 1, "nowhere: No such "),
    ],
)
def test_wrong_options(
    c_build: Path, program: str, arguments: tuple[str, ...], status: int, text: str
) -> None:
    done = subprocess.run(
        [c_build / program, *arguments], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == status
    assert text in done.stderr


def test_a_line_that_goes_away_ends_the_node(c_build: Path, wire: tuple[str, str]) -> None:
    import os
    import tty

    far, near = os.openpty()
    tty.setraw(near)
    process = subprocess.Popen(
        [c_build / "fcc-serial", os.ttyname(near)], stderr=subprocess.PIPE, text=True
    )
    assert os.read(far, 1)
    os.close(near)
    os.close(far)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "bus lost" in error
