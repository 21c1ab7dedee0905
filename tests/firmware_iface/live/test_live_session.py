"""Tester and emulated computer together: recording, stop, limits, listening, lost bus."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from damaged_bus import FaultyTransport, bus_failure
from live_ends import LOADED_MACHINE, computer_on

from ehadiag import CommandMode, ConfigurationError, InputOutputError, StoredTest
from ehadiag_sim.emulator import EmulatorTransport, FccCore
from firmware_iface import tester
from firmware_iface.alignment.align import assemble
from firmware_iface.bus_map import default_map
from firmware_iface.codec import Encoder
from firmware_iface.handshake import ChannelLimits, Phase, TimeLimits
from firmware_iface.logs.reader import read_frames
from firmware_iface.logs.recorder import Recorder, ReplayTransport
from firmware_iface.recording import BitReason, BitState
from firmware_iface.signals.recordings import read_recording
from firmware_iface.tester import BitProgress, run_test
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.base import Transport
from firmware_iface.transport.frames import Frame, FrameTable
from firmware_iface.transport.python_can import PythonCanTransport
from firmware_iface.transport.serial_link import SerialTransport

CoreFactory = Callable[..., FccCore]


def test_live_frames_and_their_recording_give_the_same_samples(
    make_core: CoreFactory, tmp_path: Path
) -> None:
    live: list[Frame] = []
    seen: list[BitProgress] = []
    recorder = Recorder(tmp_path / "live.blf")
    with EmulatorTransport(make_core(start_ns=1_700_000_000_000_000_000)) as transport:
        outcome = run_test(
            transport,
            test_id=9,
            duration=0.4,
            transmit=True,
            recorder=recorder,
            on_frame=live.append,
            progress=seen.append,
        )
    assert outcome == tester.RequestOutcome(
        complete=True,
        why="",
        outcome=outcome.outcome,
        test_id=9,
        serial=77,
        abort_confirmed=None,
        frames=len(live),
        dropped=0,
        degraded="",
        recorded=(tmp_path / "live.blf",),
    )
    assert outcome.outcome.state is BitState.COMPLETE
    assert recorder.frames == len(live) + 1  # the request
    assert {Phase.SETTLING, Phase.RUNNING} <= {item.phase for item in seen}
    assert max(item.elapsed for item in seen) <= 0.45
    direct = assemble(FrameTable.from_frames(live), default_map(), "bus")[0]
    read = read_recording(tmp_path / "live.blf")
    assert direct.samples is not None
    assert read.samples is not None
    for name in ("current", "spool", "pressure", "position", "command"):
        assert np.array_equal(getattr(direct.samples, name), getattr(read.samples, name)), name
    assert read.quality.total("lost") == 0
    sent = read_frames(tmp_path / "live.blf")
    assert [hex(item) for item in sent.can_id[sent.sent]] == ["0x200"]


def test_the_same_seed_gives_the_same_recording_to_the_byte(
    make_core: CoreFactory, tmp_path: Path
) -> None:
    for name in ("a.csv", "b.csv"):
        with EmulatorTransport(make_core()) as transport:
            recorder = Recorder(tmp_path / name)
            run_test(transport, test_id=9, duration=0.4, transmit=True, recorder=recorder)
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


@pytest.mark.parametrize("whole", [True, False])
def test_the_trail_is_listened_to_where_something_is_missing(
    whole: bool, make_core: CoreFactory
) -> None:
    asked: list[int] = []

    def all_there() -> bool:
        asked.append(transport.now_ns())
        return whole

    with EmulatorTransport(make_core()) as transport:
        outcome = run_test(transport, test_id=9, duration=0.4, transmit=True, all_there=all_there)
        listened = (transport.now_ns() - asked[0]) / 1e9
    assert outcome.complete
    assert len(asked) == 1
    assert (listened < TimeLimits().trail) == whole


def test_two_tests_in_a_row_on_one_bus(make_core: CoreFactory) -> None:
    with EmulatorTransport(make_core()) as transport:
        for _ in range(2):
            assert run_test(transport, test_id=9, duration=0.4, transmit=True).why == ""
            while transport.receive(0.01) and transport.now_ns() % 1_000_000_000 < 990_000_000:
                pass


def test_a_refusal_is_an_outcome_with_its_reason(make_core: CoreFactory) -> None:
    core = make_core()
    core.interlock_open = True
    with EmulatorTransport(core) as transport:
        outcome = run_test(transport, test_id=9, duration=0.4, transmit=True)
    assert not outcome.complete
    assert outcome.why == "refused: interlock open"
    assert outcome.outcome.reason is BitReason.INTERLOCK_OPEN


def test_an_exceeded_limit_aborts_and_the_current_is_gone(make_core: CoreFactory) -> None:
    core = make_core()
    with EmulatorTransport(core) as transport:
        outcome = run_test(
            transport, test_id=9, duration=0.4, transmit=True, limits=ChannelLimits(current=1.5e-3)
        )
    assert re.fullmatch(r"current 1\.5\d+ mA beyond its limit ±1\.5 mA", outcome.why)
    assert outcome.abort_confirmed is True
    assert outcome.outcome.state is BitState.ABORTED
    assert core.plant.truth[0] == 0.0


def test_a_stop_aborts_and_closes_the_recording(make_core: CoreFactory, tmp_path: Path) -> None:
    stop = threading.Event()
    core = make_core()

    def watch(progress: BitProgress) -> None:
        if progress.elapsed > 0.1:
            stop.set()

    with EmulatorTransport(core) as transport:
        outcome = run_test(
            transport,
            test_id=9,
            duration=0.4,
            transmit=True,
            recorder=Recorder(tmp_path / "x.blf"),
            stop=stop,
            progress=watch,
        )
    assert outcome.why == "stopped by the user"
    assert outcome.abort_confirmed is True
    assert core.state is BitState.ABORTED
    recording = read_recording(tmp_path / "x.blf")
    assert recording.outcome.state is BitState.ABORTED


def test_a_lost_bus_is_an_outcome_and_closes_the_recording(
    make_core: CoreFactory, tmp_path: Path
) -> None:
    inner = EmulatorTransport(make_core())
    with FaultyTransport(inner, [bus_failure(0.3, "adapter unplugged")]) as transport:
        outcome = run_test(
            transport, test_id=9, duration=0.4, transmit=True, recorder=Recorder(tmp_path / "x.blf")
        )
    assert not outcome.complete
    assert "adapter unplugged" in outcome.why
    assert len(read_frames(tmp_path / "x.blf")) == outcome.frames + 1


def test_a_recording_that_fails_asks_for_an_abort_on_the_way_out(
    make_core: CoreFactory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder(tmp_path / "x.blf")
    write = Recorder.write

    def failing(self: Recorder, frame: Frame) -> None:
        if self.frames >= 600:
            raise InputOutputError("disk full")
        write(self, frame)

    monkeypatch.setattr(Recorder, "write", failing)
    core = make_core()
    with EmulatorTransport(core) as transport:
        with pytest.raises(InputOutputError, match="disk full"):
            run_test(transport, test_id=9, duration=0.4, transmit=True, recorder=recorder)
        transport.receive(0.01)
        assert core.state is BitState.ABORTED


def test_nothing_is_requested_unless_asked(make_core: CoreFactory) -> None:
    core = make_core()
    with EmulatorTransport(core) as transport:
        outcome = run_test(transport, test_id=None, duration=0.4, times=TimeLimits(wait=1.0))
    assert outcome.why == "no test was started within 1 s"
    assert core.tests_started == 0
    listening = EmulatorTransport(make_core(), transmit=False)
    with pytest.raises(ConfigurationError, match="listen only"):
        run_test(listening, test_id=9, duration=0.4, transmit=True)
    with pytest.raises(ConfigurationError, match="number"):
        run_test(EmulatorTransport(core), test_id=None, duration=0.4, transmit=True)


def test_a_listener_follows_a_test_that_another_tester_requested(make_core: CoreFactory) -> None:
    core = make_core()
    for _ in range(50):
        core.step()
    core.take(Encoder().request("start", 9)[0])
    with EmulatorTransport(core, transmit=False) as transport:
        outcome = run_test(transport, test_id=None, duration=0.4)
    assert outcome.complete
    assert (outcome.test_id, outcome.serial) == (9, 77)


def test_a_log_can_be_listened_to_like_a_bus(make_core: CoreFactory, tmp_path: Path) -> None:
    with EmulatorTransport(make_core()) as transport:
        run_test(
            transport, test_id=9, duration=0.4, transmit=True, recorder=Recorder(tmp_path / "x.blf")
        )
    table = read_frames(tmp_path / "x.blf")
    with ReplayTransport(table, "x.blf") as transport:
        assert run_test(transport, test_id=None, duration=0.4).why == ""
    half = FrameTable.from_frames(
        [
            Frame(t, i, bytes(d))
            for t, i, d in zip(
                table.time_ns[:600].tolist(),
                table.can_id[:600].tolist(),
                table.data[:600],
                strict=True,
            )
        ]
    )
    with ReplayTransport(half, "half.blf") as transport:
        outcome = run_test(transport, test_id=None, duration=0.4)
    assert outcome.why == "the recording ends before the test does"


def virtual(channel: str, *, transmit: bool) -> Transport:
    return PythonCanTransport(BusOptions("virtual", channel=channel), transmit=transmit)


def recorded_test(ours: Transport, path: Path) -> tester.RequestOutcome:
    """Request the short test and record it."""
    recorder = Recorder(path)
    return run_test(
        ours, test_id=9, duration=0.4, transmit=True, recorder=recorder, times=LOADED_MACHINE
    )


def session_on(
    options: BusOptions, core: FccCore, path: Path
) -> tuple[tester.RequestOutcome, tester.RequestOutcome]:
    """Run the short test in real time, the computer and a listener in threads beside it."""
    heard: list[tester.RequestOutcome] = []
    with ExitStack() as stack:
        bus = stack.enter_context(PythonCanTransport(options, transmit=True))
        ours = stack.enter_context(PythonCanTransport(options, transmit=True))
        third = stack.enter_context(PythonCanTransport(options))

        def listen() -> None:
            heard.append(run_test(third, test_id=None, duration=0.4, times=LOADED_MACHINE))

        stack.enter_context(computer_on(bus, core))
        listener = threading.Thread(target=listen)
        listener.start()
        outcome = recorded_test(ours, path)
        listener.join()
    return outcome, heard[0]


def assert_whole(path: Path, test: StoredTest) -> None:
    recording = read_recording(path)
    assert recording.quality.total("lost") == 0
    assert recording.samples is not None
    assert recording.samples.ticks == test.ticks
    assert recording.samples.mode is CommandMode.CURRENT


def test_in_real_time_over_a_virtual_bus_with_a_listener(
    make_core: CoreFactory, short_test: StoredTest, tmp_path: Path
) -> None:
    options = BusOptions("virtual", channel=str(uuid.uuid4()))
    path = tmp_path / "live.blf"
    outcome, heard = session_on(options, make_core(), path)
    assert outcome.why == ""
    assert outcome.dropped == 0
    assert (heard.why, heard.test_id, heard.serial) == ("", 9, 77)
    assert_whole(path, short_test)


@pytest.mark.socketcan
def test_in_real_time_over_socketcan_with_a_listener(
    make_core: CoreFactory, short_test: StoredTest, tmp_path: Path
) -> None:
    options = BusOptions("socketcan", channel="vcan0")
    path = tmp_path / "live.blf"
    outcome, heard = session_on(options, make_core(), path)
    assert outcome.why == ""
    assert heard.why == ""
    assert_whole(path, short_test)


def test_in_real_time_over_the_serial_link(
    make_core: CoreFactory, short_test: StoredTest, wire: tuple[str, str], tmp_path: Path
) -> None:
    path = tmp_path / "live.blf"
    with (
        SerialTransport(wire[0], transmit=True) as bus,
        SerialTransport(wire[1], transmit=True) as ours,
        computer_on(bus, make_core()),
    ):
        outcome = recorded_test(ours, path)
    assert outcome.why == ""
    assert outcome.degraded == ""
    assert_whole(path, short_test)


def test_in_real_time_over_slcan(
    make_core: CoreFactory, short_test: StoredTest, wire: tuple[str, str], tmp_path: Path
) -> None:
    path = tmp_path / "live.blf"
    near, far = (BusOptions("slcan", channel=end, extra={"sleep_after_open": 0.0}) for end in wire)
    with (
        PythonCanTransport(near, transmit=True) as bus,
        PythonCanTransport(far, transmit=True) as ours,
        computer_on(bus, make_core()),
    ):
        outcome = recorded_test(ours, path)
    assert outcome.why == ""
    assert outcome.degraded == ""
    assert_whole(path, short_test)


def test_a_silent_bus_ends_within_its_time_limits(tmp_path: Path) -> None:
    times = TimeLimits(settle=0.02, status=0.1, abort=0.1)
    with virtual(str(uuid.uuid4()), transmit=True) as bus:
        outcome = run_test(
            bus,
            test_id=9,
            duration=0.4,
            transmit=True,
            times=times,
            recorder=Recorder(tmp_path / "x.blf"),
        )
    assert outcome.why == "no answer within 0.1 s of the request; the abort was not confirmed"
    assert outcome.frames == 0
    assert read_frames(tmp_path / "x.blf").sent.all()


@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
def test_a_signal_in_another_process_aborts_and_leaves_a_whole_recording(tmp_path: Path) -> None:
    """The tester as a command line runs it: SIGTERM sets the stop event."""
    path = tmp_path / "x.blf"
    code = f"""
        import signal, sys, threading
        from ehadiag.core.actuator import default_actuator
        from firmware_iface.stored_test import bundled_tests
        from ehadiag_sim.emulator import run_emulator
        from ehadiag_sim.emulator import FccCore
        from firmware_iface.transport.python_can import BusOptions, PythonCanTransport
        from firmware_iface.logs.recorder import Recorder
        from firmware_iface.handshake import TimeLimits
        from firmware_iface.tester import run_test

        times = TimeLimits(status=100, arming=100, telemetry=100, finish=100, abort=100)
        stop, end = threading.Event(), threading.Event()
        signal.signal(signal.SIGTERM, lambda *_: stop.set())
        core = FccCore(default_actuator(), bundled_tests().values())
        core.step()
        options = BusOptions("virtual", channel="x")
        with PythonCanTransport(options, transmit=True) as bus:
            node = threading.Thread(target=run_emulator, args=(core, bus, end))
            node.start()
            def show(progress):
                if progress.elapsed > 0.2:
                    print("running", flush=True)
            with PythonCanTransport(options, transmit=True) as ours:
                outcome = run_test(ours, test_id=1, duration=5.5, transmit=True, stop=stop,
                                   times=times, recorder=Recorder({str(path)!r}), progress=show)
            end.set()
            node.join()
        print(outcome.why, outcome.abort_confirmed, flush=True)
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "running\n"
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=120)
    assert output.splitlines()[-1] == "stopped by the user True"
    recording = read_recording(path)
    assert recording.outcome.state is BitState.ABORTED
